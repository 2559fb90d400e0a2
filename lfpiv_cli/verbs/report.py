"""`report`: one page of all that a folder holds, with a verdict, and no truth needed."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from lfpiv_cli.arrays import Floats
from lfpiv_cli.console import CONSOLE, Console, readable
from lfpiv_cli.errors import ConfigError, InputError, UsageError
from lfpiv_cli.files import pages, particle_file
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import natural
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.config import carried_config
from lfpiv_cli.files.images import count_pages
from lfpiv_cli.files.pages import Page, Picture, Section, Table, write_pages, write_picture
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, Points
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.files.vtkhdf import open_vectors, read_extra, read_header
from lfpiv_cli.flow.field import MASKED, MM_TO_M, REJECTED, VALID, VectorField
from lfpiv_cli.flow.statistics import PAIRS
from lfpiv_cli.notice import with_error, written
from lfpiv_cli.pictures.points import MOST_LINES, Lines, displacement_lines, has_views, lines_view, trajectory_lines
from lfpiv_cli.pictures.style import caption_of
from lfpiv_cli.pictures.vectors import planes_figure, profiles_figure, series_figure, sigma_figure, speed_unit
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs.contents import Contents, Fields, by_command, contents_of, judged
from lfpiv_cli.verbs.moments import of_fields
from lfpiv_cli.verbs.plot import figures_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Tables of vectors end here, and others.
LONGEST_TABLE, LONGEST_OTHER, LONGEST_INPUTS = 60, 8, 12
# So many files of vectors are read.
MOST_FIELDS = 1000
# What is drawn of the vectors that the verdict is of, of others, and of other files: a page of paper holds three.
OF_VECTORS, OF_OTHERS = ("planes", "profiles", "sigma"), ("planes",)
# Of the mean of many, in the order of what is left out first of others' means.
OF_BATCHES = (planes_figure, profiles_figure, sigma_figure)
OF_PARTICLES, OF_VOLUMES = ("image", "residual", "depths"), ("projections",)
OF_STATISTICS = ("moments", "stresses", "profile", "convergence")
OF_TRACKS, OF_WEIGHTS = ("space", "sigma"), ("light",)
FAINT_WORDS = "those of large stated errors faint, walls dotted"
# A cell of a figure that is not known.
UNKNOWN = "–"


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """What `report` is given besides the folder: raw images, of which it shows those that the files are made from."""

    raw: Sequence[Path] = ()


def report(
    folder: Path,
    output: Path,
    options: ReportOptions = ReportOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Write a page of a folder of results, or a file of one: verdict, pictures, figures, settings and warnings."""
    if output.suffix != ".html":
        raise UsageError(f"{output}: a report is a page, its name ends in .html")
    ensure_writable(output, overwrite, options.raw)
    for path in options.raw:
        count_pages(path)  # for its checks
    pages.ensure_pages()
    pages.ensure_drawing()
    contents = contents_of(folder.parent, [folder]) if os.path.isfile(folder) else contents_of(folder)
    fields = {path: open_vectors(path) for path in contents.of("vectors")[:MOST_FIELDS]}
    parts = judged(contents, fields)
    words = {part: checks.worst(lines, "good") for part, lines in parts.items()}
    # By the files that they are about, if they are about one.
    lines = (line for part in parts.values() for line in part)
    every = sorted(lines, key=lambda line: (":" not in line.reason, natural(line.reason)))
    faults = [line for line in every if line.verdict in ("no", "look")]
    advice = "Nothing speaks against these vectors, as far as images and vectors tell it themselves."
    if faults:
        use = "Do not use these vectors before" if "no" in words.values() else "Before you use these vectors, look at"
        advice = f"{use} what is said below" + (" is mended." if "no" in words.values() else ".")
    counts = {part: sum(line in faults for line in lines) for part, lines in parts.items()}
    rows = tuple((part, words[part], str(counts[part])) for part in parts)
    verdict = Table("Verdict: good, look (at the faults), or no", ("part", "verdict", "faults"), rows)
    points = tuple((line.verdict, line.reason) for line in faults)
    remarks = tuple(("", line.reason) for line in every if line not in faults)
    said = [Section("Faults", "faults", points=points), Section("Remarks", "remarks", points=remarks)]
    with TemporaryDirectory() as pictures:
        drawer = Drawer(contents, Path(pictures), {sha256(path): path for path in options.raw})
        sections = [*(each for each in said if each.points), *_chain(contents, fields, drawer), *_records(contents)]
        if not has_views():
            console.say('the page has no view to turn: that needs plotly, pip install "lfpiv[report]"')
        made = contents.last
        foot = f"Made by lfpiv {made.get('version')} from the files in {folder.resolve().name}."
        title = _sentence(contents, fields, len(faults))
        write_pages(Page(title, (advice,), (verdict,), tuple(sections), foot), [output], overwrite)
    return {"sentence": title, "files": len(contents.records), "pictures": drawer.count, "verdict": words}


def _sentence(contents: Contents, fields: Fields, faults: int) -> str:
    """Return how much was measured, where, how fast it is, how well that is known and what is against it.

    "Up to" leaves out the few percent at the end of a range, of which some are false.
    """
    against = "nothing contradicts it"
    if faults:
        against = f"{faults} faults speak against it" if faults > 1 else "one fault speaks against it"
    first, tracks = next(iter(by_command(contents, fields).values()), []), contents.of("tracks")
    if tracks and (not first or (len(first) == 1 and checks.verb_of(contents.record(first[0])) != "correlate")):
        points = particle_file.open_tracks(tracks[0])
        track = points.arrays.get("track")
        number = f"{len(points.position_mm) if track is None else len(np.unique(track)):,} tracks"
        size, velocity, sigma = points.position_mm, points.arrays["velocity"], points.arrays["velocity_sigma"]
        sides = np.ptp(size, axis=0) if len(size) else np.zeros(3)
    elif first:
        ours = [fields[path] for path in first]
        there = [field.flag < REJECTED for field in ours]
        pairs = f" of {len(first)} pairs" if len(first) > 1 else ""
        if len(first) == 1 and "pairs" in (said := read_header(first[0]).attributes):
            pairs = f", means of {said['pairs']} pairs,"
        number = f"{sum(map(np.count_nonzero, there)):,} vectors{pairs}"
        velocity = np.concatenate([field.velocity[known] for field, known in zip(ours, there, strict=True)])
        sigma = np.array([checks.velocity_of(field)[1] for field in ours])
        sides = np.array([np.ptp(field_axis) for field_axis in map(ours[0].grid.bounds_mm, range(3))])
    else:
        return f"No vectors and no tracks are in {contents.folder.resolve().name}; {against}."
    text = f"{number} in {' x '.join(written(side, 2) for side in sides)} mm"
    speed, known = (each[np.isfinite(each).all(axis=1)] for each in (np.abs(velocity), sigma))
    error = np.median(known, axis=0) if len(known) else np.ones(3)
    if len(speed):
        usual = np.percentile(speed, 100.0 - checks.LEFT_OUT_PERCENT, axis=0)
        # The component that is known best for its size: noise may be as large.
        shown = int(np.argmax(usual / np.maximum(error, np.finfo(float).tiny)))
        text += f"; {'uvw'[shown]} up to {written(usual[shown])} m/s"
    if len(known):
        text += f", known to {written(max(error[:2]), 2)} m/s across and {written(error[2], 2)} m/s in depth"
    return f"{text}; {against}."


@dataclass
class Drawer:
    """Draws the pictures of files into a folder, over the raw images that these are made from, known by their hash.

    And views of lines that can be turned, of which the first brings what turns them.
    """

    contents: Contents
    folder: Path
    raw: Mapping[str, Path]
    count: int = 0
    views: int = 0

    def pictures(self, path: Path, role: str = "", only: Sequence[str] = ()) -> list[Picture]:
        """Return all pictures of a file, or `only` those of some names; `role` is that of the input to draw on."""
        raw = None
        if role:
            given = self.contents.record(path).get("inputs", {}).get(role, {})
            raw = self.raw.get(given.get("sha256", ""))
        chosen = [each for name, each in figures_of(path, raw).items() if not only or name in only]
        return [self._drawn(f"{path.name}: {each.caption}", each.draw()) for each in chosen]

    def of_batch(
        self, command: str, fields: Mapping[str, VectorField], draws: Sequence[Callable[[VectorField], Figure]]
    ) -> tuple[VectorField | None, list[Picture]]:
        """Return the mean of fields by one command, by name, and pictures of means in order and of that."""
        mean, sigma = (np.array(each) for each in zip(*map(checks.velocity_of, fields.values()), strict=True))
        words = f"The mean of {len(fields)} fields by {command}"
        series = f"Fields by {command}: {caption_of(series_figure)}"
        found = [self._drawn(series, series_figure(list(fields), mean, sigma))]
        try:
            whole = of_fields(fields.values()).mean
        except InputError:  # they have no mean
            return None, found
        return whole, found + [self._drawn(f"{words}: {caption_of(draw)}", draw(whole)) for draw in draws]

    def view(self, lines: Lines, path: Path, words: str) -> str:
        """Return words and a view of the lines of a file and of the walls that its config has; "" without lines."""
        if not (has_views() and lines.places_mm):
            return ""
        try:
            walls = carried_config(self.contents.record(path), "").walls()
        except (InputError, ConfigError):  # it is not there, or of another version
            walls = None
        self.views += 1
        view = lines_view(lines, walls, name=f"view{self.views}", with_script=self.views == 1)
        return f"<p>{escape(words)}</p>{view}"

    def _drawn(self, caption: str, figure: Figure) -> Picture:
        target = self.folder / f"{self.count:04d}.png"
        self.count += 1
        write_picture(target, figure, overwrite=True)
        return Picture(target, caption)


def _chain(contents: Contents, fields: Fields, drawer: Drawer) -> Iterable[Section]:
    """Yield the sections of vectors, tracks, images and calibration, as far as they are there."""
    groups, pictures = by_command(contents, fields), list[Picture]()
    if fields:
        first = next(iter(groups.values()))
        # Of many pairs the pictures show what is by other commands, too.
        paths = first if len(first) > 1 else [path for group in groups.values() for path in group]
        shown = paths[:LONGEST_TABLE]
        text, table = _batch_table(shown, len(paths), (_field_row(fields[path]) for path in shown))
        field, named = fields[first[0]], first[0].name
        for number, (command, group) in enumerate(groups.items()):
            if len(group) > 1:
                by_name = {path.stem: fields[path] for path in group}
                mean, drawn = drawer.of_batch(command, by_name, OF_BATCHES[:1] if number else OF_BATCHES)
                pictures += drawn
                if number == 0 and mean is not None:
                    field, named = mean, "their mean"
            else:
                pictures += drawer.pictures(group[0], only=OF_OTHERS if number else OF_VECTORS)
        words = f"The view can be turned; it shows the vectors of {named}."
        view = "" if field.dt_s is None else drawer.view(_of_field(field), first[0], words)
        yield Section("Vectors", "vectors", text, tables=(table,), pictures=tuple(pictures), view=view)
    for path in [path for path in fields if "pairs" in read_header(path).attributes][:1]:
        pictures = drawer.pictures(path, only=OF_STATISTICS)
        yield Section("Statistics", "statistics", tables=tuple(_statistics(path)), pictures=tuple(pictures))
    tracks = contents.of("tracks")
    for path in tracks[:1]:
        points, which = (
            particle_file.open_tracks(path),
            f"the first of {len(tracks)} files, " if len(tracks) > 1 else "",
        )
        words = f"The view can be turned; it shows at most {MOST_LINES:,} tracks of {which}{path.name}, {FAINT_WORDS}."
        view = drawer.view(_of_points(points), path, words)
        pictures = drawer.pictures(path, only=OF_TRACKS)
        # On a screen the view shows what the first one does.
        pictures = [replace(each, on_paper=bool(view) and not number) for number, each in enumerate(pictures)]
        yield Section("Tracks", "tracks", pictures=tuple(pictures), view=view)
    for kind, title, rows_of in (("particles", "Particles", _particle_row), ("volumes", "Volumes", _volume_row)):
        paths = contents.of(kind)
        if paths:
            shown = paths[:LONGEST_OTHER]
            text, table = _batch_table(shown, len(paths), map(rows_of, shown))
            role, only = ("image", OF_PARTICLES) if kind == "particles" else ("", OF_VOLUMES)
            pictures = drawer.pictures(paths[0], role, only)
            yield Section(title, kind, text, tables=(table,), pictures=tuple(pictures))
    for path in contents.of("calibration")[:1]:
        summary = {name: value for name, value in open_calibration(path).summary().items() if value is not None}
        rows = []
        for name, value in summary.items():
            base = name.removesuffix("_sigma")
            if base == name or base not in summary:
                sigma = summary.get(f"{name}_sigma")
                each = zip(np.atleast_1d(value), np.atleast_1d(sigma), strict=True) if sigma is not None else ()
                rows.append((name, ", ".join(with_error(*one) for one in each) or _cell(value)))
        table = Table("What the white image and the board show", ("figure", "value"), tuple(rows))
        # That `calibrate-snapshot --picture` has put beside it shows all.
        beside = path.with_suffix(".png")
        found = [Picture(beside, "Lens images and board, as found")] if beside.is_file() else []
        pictures = found or drawer.pictures(path, "white")
        yield Section("Calibration", "calibration", tables=(table,), pictures=tuple(pictures))
    for path in contents.of("weights")[:1]:
        yield Section("Weights", "weights", pictures=tuple(drawer.pictures(path, only=OF_WEIGHTS)))


def _statistics(path: Path) -> Iterable[Table]:
    """Yield what statistics are made of, and their profile."""
    said, (_, tables) = read_header(path).attributes, read_extra(path)
    about = {
        "pairs": said["pairs"],
        "integral time of u, v, w (pairs)": said["integral_time_pairs"],
        "independent pairs": 0.5 * said["pairs"] / max(said["integral_time_pairs"]),
        "block of the bootstrap (pairs)": said["block_pairs"],
    }
    yield Table(path.name, ("figure", "value"), tuple((name, _cell(value)) for name, value in about.items()))
    if "profile" not in tables:
        return
    line, names = tables["profile"], said["profile_components"].split(", ")
    factor, unit = speed_unit(line["velocity_rms"])
    heads = [f"{name} ({unit})" for name in names] + [f"<{names[i]}' {names[j]}'> ({unit})²" for i, j in PAIRS]
    value, sigma = (
        np.hstack([factor * line[f"velocity{end}"], factor**2 * line[f"reynolds_stress{end}"]])
        for end in ("", "_sigma")
    )
    rows = (
        (written(at), *map(with_error, *each), str(samples))
        for at, *each, samples in zip(line["at_mm"], value, sigma, line["samples"], strict=True)
    )
    yield Table("Profile, without noise", (f"{said['profile']} (mm)", *heads, "samples"), tuple(rows))


Row = dict[str, str]


def _batch_table(paths: Iterable[Path], count: int, rows: Iterable[Row]) -> tuple[tuple[str, ...], Table]:
    """Return a table of files with what is known of any, and words where there are more of them."""
    named = [{"file": path.name} | row for path, row in zip(paths, rows, strict=True)]
    text = () if len(named) == count else (f"The first {len(named)} of {count} files.",)
    known = [head for head in named[0] if any(row[head] != UNKNOWN for row in named)]
    return text, Table("Files", tuple(known), tuple(tuple(row[head] for head in known) for row in named))


def _volume_row(path: Path) -> Row:
    reported = read_header(path).attributes
    residual = reported.get("residual")
    return {
        "light not explained": UNKNOWN if residual is None else written(np.atleast_1d(residual)[-1]),
        "pixels left out": _cell(reported.get("excluded_pixels")),
    }


def _particle_row(path: Path) -> Row:
    points = particle_file.read_points(path, PARTICLES_FORMAT)
    inside = points.arrays["flag"] == 0
    sigma = np.sqrt(points.arrays["covariance_mm2"][inside, :3])
    reported = points.attributes
    return {
        "particles": str(np.count_nonzero(inside)),
        "beside the volume": str(np.count_nonzero(~inside)),
        "per microlens": _cell(reported.get("particles_per_lens")),
        "light not explained": _cell(reported.get("residual")),
        "median sigma x, y, z (mm)": readable(np.median(sigma, axis=0).tolist(), 2) if inside.any() else UNKNOWN,
        "diameter (mm)": _with_error(reported, "particle_diameter", "mm"),
        "diffusion (px)": _with_error(reported, "diffusion", "px"),
    }


def _with_error(reported: Mapping[str, Any], name: str, unit: str) -> str:
    """Return what a file tells of a number, with its standard error where it has one."""
    value, error = reported.get(f"{name}_{unit}"), reported.get(f"{name}_sigma_{unit}")
    return _cell(value) if value is None or error is None else with_error(value, error)


def _field_row(vectors: VectorField) -> Row:
    quality, there, used = checks.quality_of(vectors), vectors.flag < REJECTED, vectors.flag < MASKED
    moved, (mean, sigma) = vectors.displacement_voxel[there].reshape(-1, 3), checks.velocity_of(vectors)
    voxels = np.median(moved, axis=0) if len(moved) else ()
    return {
        "vectors": str(quality.used),
        "valid": f"{np.mean(vectors.flag[used] == VALID):.1%}" if used.any() else UNKNOWN,
        **{
            f"mean {name} ± usual σ of one (m/s)": with_error(each, error) if math.isfinite(each) else UNKNOWN
            for name, each, error in zip("uvw", mean.tolist(), sigma.tolist(), strict=True)
        },
        "median moved (voxel)": ", ".join(f"{each:z.2f}" for each in voxels) or UNKNOWN,
    }


def _of_points(points: Points) -> Lines:
    """Return tracks as lines; of a pair those from one place to the other, which a link's place is half-way of."""
    speed, sigma = (np.linalg.norm(points.arrays[name], axis=1) for name in ("velocity", "velocity_sigma"))
    if "track" in points.arrays:
        track = points.arrays["track"]
        places, speeds, sigmas = (trajectory_lines(each, track) for each in (points.position_mm, speed, sigma))
        return Lines(places, speeds, np.array([np.median(each) for each in sigmas]))
    half = 0.5 * points.arrays["displacement_mm"]
    return Lines(list(np.stack([points.position_mm - half, points.position_mm + half], axis=1)), _twice(speed), sigma)


def _of_field(field: VectorField) -> Lines:
    """Return vectors as lines about their grid points, as long as their distances allow."""
    there, scale = field.flag < REJECTED, np.asarray(field.voxel_mm)
    moved = field.displacement_voxel[there] * scale
    lines, _ = displacement_lines(field.grid.centres_mm()[there], moved)
    sigma = np.full(moved.shape, np.nan) if field.uncertainty_voxel is None else field.uncertainty_voxel[there] * scale
    rate = 1.0 if field.dt_s is None else MM_TO_M / field.dt_s
    return Lines(lines, _twice(rate * np.linalg.norm(moved, axis=1)), rate * np.linalg.norm(sigma, axis=1))


def _twice(values: Floats) -> list[Floats]:
    return list(np.stack([values, values], axis=1))


def _records(contents: Contents) -> Iterable[Section]:
    """Yield the sections of warnings, settings and where the files come from."""
    # Of alike ones the first.
    warned: dict[tuple[str, str], list[tuple[str, str]]] = {}
    for name, made in contents.all_records.items():
        for warning in made.get("warnings", ()):
            alike = warned.setdefault((str(made.get("command")), warning["code"]), [])
            alike.append((name, f"{warning['about']}: {warning['text']}"))
    if warned:
        named = [
            (name if len(alike) == 1 else f"{name} and {len(alike) - 1} more", *each, text)
            for each, alike in warned.items()
            for name, text in alike[:1]
        ]
        table = Table("As they were made", ("file", "command", "code", "warning"), tuple(named))
        yield Section("Warnings", "warnings", tables=(table,))
    last = contents.last
    if last.get("config"):
        settings = yaml.safe_dump(_given(last["config"]), sort_keys=False, allow_unicode=True, default_flow_style=None)
        yield Section("Settings", "settings", commands=tuple(settings.splitlines()))
    # Each input once, with the first that is made from it.
    used: dict[tuple[str, str], list[str]] = {}
    for name, made in contents.all_records.items():
        for role, given in made.get("inputs", {}).items():
            used.setdefault((f"{role} {given['name']}", given["sha256"][:16]), []).append(name)
    rows = [
        (*given, f"{first} and {len(others)} more" if others else first) for given, (first, *others) in used.items()
    ]
    libraries = ", ".join(f"{name} {version}" for name, version in last.get("libraries", {}).items())
    left = f" The first {LONGEST_INPUTS} of {len(rows)} inputs; info tells those of a file."
    text = f"lfpiv {last.get('version')}; {libraries}.{left if len(rows) > LONGEST_INPUTS else ''}"
    table = Table("Made from", ("input", "SHA-256 begins", "for"), tuple(rows[:LONGEST_INPUTS]))
    yield Section("Provenance", "provenance", (text,), tables=(table,))


def _given(settings: Any) -> Any:
    """Return settings without those that are not given."""
    if isinstance(settings, dict):
        kept = {name: _given(value) for name, value in settings.items() if value is not None}
        return {name: value for name, value in kept.items() if value != {}}
    return [_given(each) for each in settings] if isinstance(settings, list) else settings


def _cell(value: Any) -> str:
    return readable(value, digits=4, unknown=UNKNOWN)
