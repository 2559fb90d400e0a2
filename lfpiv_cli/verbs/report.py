"""`report`: one page of all that a folder holds, with a verdict, and no truth needed."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from lfpiv_cli.console import CONSOLE, Console, readable
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import calibration_file, weights_file
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.hdf5 import open_h5, read_provenance
from lfpiv_cli.files.images import count_pages
from lfpiv_cli.files.pages import (
    Page,
    Picture,
    Section,
    Table,
    ensure_drawing,
    ensure_pages,
    write_pages,
    write_picture,
)
from lfpiv_cli.files.particle_file import (
    PARTICLES_FORMAT,
    TRACKS_FORMAT,
    TRAJECTORIES_FORMAT,
    Points,
    open_tracks,
    read_points,
)
from lfpiv_cli.files.provenance import sha256
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT, VOLUME_FORMAT, open_vectors, read_header
from lfpiv_cli.flow.field import MASKED, REJECTED, VALID, VectorField
from lfpiv_cli.notice import written
from lfpiv_cli.pictures.points import MOST_LINES, has_views, lines_view, trajectory_lines
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs.plot import figures_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# By the formats of our files, in the order of the chain.
KINDS = {
    calibration_file.FORMAT: "calibration",
    weights_file.FORMAT: "weights",
    VOLUME_FORMAT: "volumes",
    PARTICLES_FORMAT: "particles",
    VECTORS_FORMAT: "vectors",
    TRACKS_FORMAT: "tracks",
    TRAJECTORIES_FORMAT: "tracks",
}
SUFFIXES = (".h5", ".vtkhdf")
# Folders below the one that is given: of volumes, of particles, of a batch's vectors.
DEEPEST = 2
# A table of a batch ends here, and pictures are of the first file of each kind, of vectors of so many.
LONGEST_TABLE, MOST_FIELDS = 100, 3
# What is drawn of vectors beside the best ones: a figure takes a second.
OF_OTHERS = ("planes", "profiles", "sigma")
# A cell of a figure that is not known.
UNKNOWN = "–"
# Vectors by their files.
Fields = Mapping[Path, VectorField]
TITLE = "Velocity from light-field images"


@dataclass(frozen=True, kw_only=True)
class ReportOptions:
    """What `report` is given besides the folder: raw images, of which it shows those that the files are made from."""

    raw: Sequence[Path] = ()


NO_OPTIONS = ReportOptions()


@dataclass(frozen=True)
class Contents:
    """The files of ours in a folder by what they are, and the record of each by its name in the folder.

    `earlier` are the records of what they were made from that is not in the folder, as volumes that were not kept.
    """

    folder: Path
    files: Mapping[str, list[Path]]
    records: Mapping[str, Mapping[str, Any]]
    earlier: Mapping[str, Mapping[str, Any]]

    def of(self, kind: str) -> list[Path]:
        """Return the files of a kind, in the order of their names."""
        return self.files.get(kind, [])

    def record(self, path: Path) -> Mapping[str, Any]:
        """Return the record of a file."""
        return self.records[path.relative_to(self.folder).as_posix()]

    @property
    def all_records(self) -> Mapping[str, Mapping[str, Any]]:
        """The records of all that the results come from, whether it is in the folder or not."""
        return {**self.earlier, **self.records}

    @property
    def last(self) -> Mapping[str, Any]:
        """The record of the file that was made last."""
        return list(self.records.values())[-1]


def report(
    folder: Path,
    output: Path,
    options: ReportOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Write a page of what a folder of results holds: verdict, pictures, figures, settings and warnings."""
    if output.suffix != ".html":
        raise UsageError(f"{output}: a report is a page, its name ends in .html")
    ensure_writable(output, overwrite, options.raw)
    for path in options.raw:
        count_pages(path)  # for its checks
    ensure_pages()
    ensure_drawing()
    contents = contents_of(folder)
    fields = {path: open_vectors(path) for path in contents.of("vectors")[:LONGEST_TABLE]}
    # Those with the smallest stated errors first.
    fields = dict(sorted(fields.items(), key=lambda item: _sigma(item[1])))
    judged_parts = judged(contents, fields)
    words = {part: checks.worst(lines, "good") for part, lines in judged_parts.items()}
    advice = "Nothing speaks against these vectors, as far as images and vectors tell it themselves."
    if "no" in words.values():
        advice = "Do not use these vectors before what is said below is mended."
    elif "look" in words.values():
        advice = "Look at what is said below before you use these vectors."
    reported = {part: "; ".join(each.reason for each in lines) for part, lines in judged_parts.items()}
    rows = tuple((part, words[part], reported[part] or "nothing speaks against it") for part in judged_parts)
    verdict = Table("Verdict: good, look (at the reasons), or no", ("part", "verdict", "reasons"), rows)
    with TemporaryDirectory() as pictures:
        drawer = Drawer(contents, Path(pictures), {sha256(path): path for path in options.raw})
        sections = [*_chain(contents, fields, drawer), *_records(contents)]
        if not has_views():
            console.say('the page has no view to turn: that needs plotly, pip install "lfpiv[report]"')
        made = contents.last
        foot = f"Made by lfpiv {made.get('version')} from the files in {folder.resolve().name}."
        write_pages(Page(TITLE, (advice,), (verdict,), tuple(sections), foot), [output], overwrite)
    return {"files": len(contents.records), "pictures": drawer.count, "verdict": words}


def judged(contents: Contents, fields: Fields) -> dict[checks.Part, list[checks.Line]]:
    """Return what speaks for and against each part of the chain, the worst first."""
    reasons = [*checks.of_warnings(contents.all_records), *_of_all_vectors(contents, fields)]
    made_by = {checks.verb_of(record) for record in contents.all_records.values()}
    counted: list[tuple[checks.Part, bool, str]] = [
        (
            "calibration",
            not made_by.isdisjoint(checks.CALIBRATES),
            "no calibration: lengths are as the data sheet has them",
        ),
        ("images", not made_by.isdisjoint(checks.OF_IMAGES), "no volumes and no particles"),
        ("vectors", bool(contents.of("vectors") or contents.of("tracks")), "no vectors and no tracks"),
    ]
    reasons += [checks.Line(part, "look", text) for part, there, text in counted if not there]
    return {part: checks.worst_first(reasons, part) for part, _, _ in counted}


def contents_of(folder: Path, only: Iterable[Path] | None = None) -> Contents:
    """Return what a folder holds, and the folders in it; or `only` some of its files, as far as they are there.

    Raises
    ------
    InputError : it is no folder, holds nothing of ours, or a broken file
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: is no folder of results")
    files: dict[str, list[Path]] = {}
    records: dict[str, Mapping[str, Any]] = {}
    paths = folder.rglob("*") if only is None else (path for path in only if path.exists())
    for path in sorted(path for path in paths if path.suffix in SUFFIXES):
        parts = path.relative_to(folder).parts
        if len(parts) > DEEPEST or any(part.startswith(".") for part in parts):
            continue
        with open_h5(path) as file:
            format_name = file.attrs.get("format", b"")
            kind = KINDS.get(format_name.decode() if isinstance(format_name, bytes) else "")
            if kind is None:
                continue
            records["/".join(parts)] = read_provenance(file)
        files.setdefault(kind, []).append(path)
    if not records:
        raise InputError(f"{folder}: holds no file of lfpiv; expected what calibrate-snapshot and the others write")
    order = list(dict.fromkeys(KINDS.values()))
    in_order = {kind: files[kind] for kind in order if kind in files}
    names = [path.relative_to(folder).as_posix() for kind in in_order.values() for path in kind]
    # What files were made from, by name and hash, but for what is among these files.
    there = [{name: value for name, value in made.items() if name != "made_from"} for made in records.values()]
    behind = {digest: made for each in records.values() for digest, made in each.get("made_from", {}).items()}
    inputs = [given for made in (*there, *behind.values()) for given in made.get("inputs", {}).values()]
    called = {given["sha256"]: given["name"] for given in inputs}
    known = {json.dumps(made, sort_keys=True) for made in there}
    earlier = {
        f"{called.get(digest, '')} ({digest[:8]}, not in the folder)": made
        for digest, made in behind.items()
        if json.dumps(made, sort_keys=True) not in known
    }
    return Contents(folder, in_order, {name: records[name] for name in names}, earlier)


@dataclass
class Drawer:
    """Draws the pictures of files into a folder, over the raw images that these are made from, known by their hash."""

    contents: Contents
    folder: Path
    raw: Mapping[str, Path]
    count: int = 0

    def pictures(self, path: Path, role: str = "", only: Sequence[str] = ()) -> list[Picture]:
        """Return all pictures of a file, or `only` those of some names; `role` is that of the input to draw on."""
        raw = None
        if role:
            given = self.contents.record(path).get("inputs", {}).get(role, {})
            raw = self.raw.get(given.get("sha256", ""))
        chosen = [each for name, each in figures_of(path, raw).items() if not only or name in only]
        return [self._drawn(f"{path.name}: {each.caption}", each.draw()) for each in chosen]

    def _drawn(self, caption: str, figure: Figure) -> Picture:
        target = self.folder / f"{self.count:04d}.png"
        self.count += 1
        write_picture(target, figure, overwrite=True)
        return Picture(target, caption)


def _of_all_vectors(contents: Contents, fields: Fields) -> list[checks.Line]:
    """Return what vectors say of themselves and of each other.

    What speaks against vectors that better ones by another command stand beside is told, and not counted.
    """
    by_command: dict[str, list[Path]] = {}
    for path in fields:
        by_command.setdefault(checks.verb_of(contents.record(path)), []).append(path)
    reasons: list[checks.Line] = []
    for number, paths in enumerate(by_command.values()):
        found = [each for path in paths for each in checks.of_vectors(fields[path], path.name)]
        against = [each for each in found if each.verdict != "good"]
        reasons += [replace(each, verdict="good") if number else each for each in against[:MOST_FIELDS]]
        if len(against) > MOST_FIELDS:
            text = f"{len(against) - MOST_FIELDS} more reasons like these in other files"
            reasons.append(checks.Line("vectors", "good" if number else "look", text))
        reasons += [each for each in found if each.verdict == "good"][:1]
    if all(len(paths) == 1 for paths in by_command.values()):
        for one, other in combinations(fields, 2):
            reasons += checks.of_two_ways(fields[one], fields[other], (one.name, other.name))
    return reasons


def _chain(contents: Contents, fields: Fields, drawer: Drawer) -> Iterable[Section]:
    """Yield the sections of vectors, tracks, images and calibration, as far as they are there."""
    if fields:
        best, *others = fields
        text, table = _batch_table(fields, len(contents.of("vectors")), map(_field_row, fields.values()))
        if others and np.isfinite(_sigma(fields[best])):
            text = (*text, f"The smallest stated errors are those of {best.name}, the first in the table.")
        pictures = drawer.pictures(best)
        for path in others[: MOST_FIELDS - 1]:
            pictures += drawer.pictures(path, only=OF_OTHERS)
        yield Section("Vectors", "vectors", text, (table,), tuple(pictures))
    for path in contents.of("tracks")[:1]:
        points = open_tracks(path)
        view = _view(points) if has_views() and len(points.position_mm) else ""
        text = (f"The view can be turned; it shows at most {MOST_LINES} tracks.",) if view else ()
        yield Section("Tracks", "tracks", text, (), tuple(drawer.pictures(path)), view=view)
    for kind, title, rows_of in (("particles", "Particles", _particle_row), ("volumes", "Volumes", _volume_row)):
        paths = contents.of(kind)
        if paths:
            shown = paths[:LONGEST_TABLE]
            text, table = _batch_table(shown, len(paths), map(rows_of, shown))
            role = "image" if kind == "particles" else ""
            yield Section(title, kind, text, (table,), tuple(drawer.pictures(paths[0], role)))
    for path in contents.of("calibration")[:1]:
        summary = open_calibration(path).summary()
        rows = tuple((name, _cell(value)) for name, value in summary.items() if value is not None)
        table = Table("What the white image and the board show", ("figure", "value"), rows)
        pictures = drawer.pictures(path, "white")
        # That `calibrate-snapshot --picture` has put beside it.
        if (beside := path.with_suffix(".png")).is_file():
            pictures = [Picture(beside, "lens images and board, as found"), *pictures]
        yield Section("Calibration", "calibration", (), (table,), tuple(pictures))
    for path in contents.of("weights")[:1]:
        yield Section("Weights", "weights", pictures=tuple(drawer.pictures(path)))


def _sigma(field: VectorField) -> float:
    """Return the size of the usual stated error of vectors, mm; infinite where none is stated."""
    sigma = checks.quality_of(field).summary()["uncertainty_voxel_median"]
    return float("inf") if sigma is None else float(np.linalg.norm(np.multiply(sigma, field.voxel_mm)))


Row = dict[str, str]


def _batch_table(paths: Iterable[Path], count: int, rows: Iterable[Row]) -> tuple[tuple[str, ...], Table]:
    """Return a table of files, and words where there are more of them."""
    named = [{"file": path.name} | row for path, row in zip(paths, rows, strict=True)]
    text = () if len(named) == count else (f"The first {len(named)} of {count} files.",)
    return text, Table("Files", tuple(named[0]), tuple(tuple(row.values()) for row in named))


def _volume_row(path: Path) -> Row:
    reported = read_header(path).attributes
    residual = reported.get("residual")
    return {
        "light not explained": UNKNOWN if residual is None else written(np.atleast_1d(residual)[-1]),
        "pixels left out": _cell(reported.get("excluded_pixels")),
    }


def _particle_row(path: Path) -> Row:
    points = read_points(path, PARTICLES_FORMAT)
    inside = points.arrays["flag"] == 0
    sigma = np.sqrt(points.arrays["covariance_mm2"][inside, :3])
    reported = points.attributes
    return {
        "particles": str(np.count_nonzero(inside)),
        "per microlens": _cell(reported.get("particles_per_lens")),
        "light not explained": _cell(reported.get("residual")),
        "median sigma x, y, z (mm)": _cell(np.median(sigma, axis=0).tolist()) if inside.any() else UNKNOWN,
        "diameter (mm)": _with_error(reported, "particle_diameter", "mm"),
        "diffusion (px)": _with_error(reported, "diffusion", "px"),
    }


def _with_error(reported: Mapping[str, Any], name: str, unit: str) -> str:
    """Return what a file tells of a number, with its standard error where it has one."""
    value, error = reported.get(f"{name}_{unit}"), reported.get(f"{name}_sigma_{unit}")
    return _cell(value) if value is None or error is None else f"{written(value)} ± {written(error, 2)}"


def _field_row(vectors: VectorField) -> Row:
    quality, there, used = checks.quality_of(vectors), vectors.flag < REJECTED, vectors.flag < MASKED
    moved = vectors.displacement_voxel[there]
    return {
        "vectors": str(quality.used),
        "valid": f"{np.mean(vectors.flag[used] == VALID):.1%}" if used.any() else UNKNOWN,
        "median u, v, w (voxel)": _cell(np.median(moved, axis=0).tolist()) if len(moved) else UNKNOWN,
        "median sigma (voxel)": _cell(quality.summary()["uncertainty_voxel_median"]),
    }


def _view(points: Points) -> str:
    """Return the view of tracks, coloured by speed; by displacement where no time is known."""
    speed = np.linalg.norm(points.arrays["velocity"], axis=1)
    if points.arrays.keys() >= {"track"}:
        track = points.arrays["track"]
        return lines_view(trajectory_lines(points.position_mm, track), trajectory_lines(speed, track), "speed (m/s)")
    # A link's place is half-way.
    half = 0.5 * points.arrays["displacement_mm"]
    lines = list(np.stack([points.position_mm - half, points.position_mm + half], axis=1))
    return lines_view(lines, [np.full(2, each) for each in speed], "speed (m/s)")


def _records(contents: Contents) -> Iterable[Section]:
    """Yield the sections of warnings, settings and where the files come from."""
    warned = [
        (name, str(made.get("command")), warning["code"], f"{warning['about']}: {warning['text']}")
        for name, made in contents.all_records.items()
        for warning in made.get("warnings", ())
    ]
    if warned:
        table = Table("As they were made", ("file", "command", "code", "warning"), tuple(warned[:LONGEST_TABLE]))
        yield Section("Warnings", "warnings", tables=(table,))
    last = contents.last
    if last.get("config"):
        settings = yaml.safe_dump(last["config"], sort_keys=False, allow_unicode=True, default_flow_style=None)
        yield Section("Settings", "settings", commands=tuple(settings.splitlines()))
    inputs = [
        (name, str(made.get("command")), f"{role} {given['name']}", given["sha256"][:16])
        for name, made in contents.all_records.items()
        for role, given in made.get("inputs", {}).items()
    ]
    libraries = ", ".join(f"{name} {version}" for name, version in last.get("libraries", {}).items())
    table = Table("Made from", ("file", "command", "input", "SHA-256 begins"), tuple(inputs[:LONGEST_TABLE]))
    yield Section("Provenance", "provenance", (f"lfpiv {last.get('version')}; {libraries}.",), (table,))


def _cell(value: Any) -> str:
    return readable(value, digits=4, unknown=UNKNOWN)
