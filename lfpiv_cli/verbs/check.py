"""`check`: what a rig and its images are good for, before any work."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Singles
from lfpiv_cli.calibration import light_checks
from lfpiv_cli.calibration.lens_light import LensImages, dark_level
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files import atomic, calibration_file, pages
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.images import read_reference, read_single
from lfpiv_cli.files.inputs import given
from lfpiv_cli.notice import written
from lfpiv_cli.particles.counting import Seeded, tracers_in_image
from lfpiv_cli.particles.noise import read_noise
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.images import FULL_SCALES, Mask, defects, light, saturated
from lfpiv_cli.validation import planning
from lfpiv_cli.validation.planning import share_beyond
from lfpiv_cli.verbs import planning as of_rigs
from lfpiv_cli.verbs.calibrate import NO_BOARD, calibration_notices, calibration_of, photographs
from lfpiv_cli.verbs.checks import Line, Verdict, word_of, worst
from lfpiv_cli.verbs.planning import Bench
from lfpiv_cli.weights.build import default_padding
from lfpiv_cli.weights.lens_cells import aligned

# What images tell of an experiment before anything is made of them: a verdict a line.
#
# The lines are those of `verbs.planning`. Images are raw, [row, column], in counts.


Image = Singles

# The brightest pixels but so many show what tracers' light is; noise alone reaches five standard deviations there.
BRIGHTEST, GOOD_SIGNAL, LEAST_SIGNAL = 200, 20.0, 7.0
# Shares of the pitch by which lens images may have moved since the white image: beyond, light is given to other lenses.
MOST_MOVED = 0.1
# Of the light in the middle of an image, so much may be put before and behind the volume.
GOOD_BEYOND, MOST_BEYOND = 0.25, 0.6
# Of full scale, for a white image.
BRIGHTEST_WHITE = 0.95


@dataclass(frozen=True, eq=False)
class Pictures:
    """What is checked: images by name, and the white and dark image where there are any."""

    images: Mapping[str, Image]
    white: Image | None = None
    dark: Image | None = None


@dataclass(frozen=True, eq=False)
class Seen:
    """One image: raw, less its dark one, its background's level and noise, and the lens images where they are known.

    Of the raw one `saturated` pixels are as bright as they can be; defects of the dark image are none of them.
    """

    name: str
    raw: Image
    saturated: Mask
    less_dark: Image
    level: float
    noise: float
    lens_images: LensImages | None


def lattice_of(settings: Config, pictures: Pictures) -> tuple[Calibration | None, list[Line]]:
    """Return the microlenses that a white image shows, and what it says of itself."""
    if pictures.white is None:
        return None, []
    photographed = photographs([pictures.white], [], pictures.dark, ())
    try:
        found = calibration_of(settings, photographed)
    except (ConfigError, InputError) as error:
        return None, [Line("white image", "no", str(error))]
    notices = calibration_notices(settings, photographed, found)
    reported = [each for each in notices if each != NO_BOARD and each.code != "f-numbers"]
    share = float(np.nanmax(pictures.white)) / full_scale(pictures.white, settings)
    reason = f"{found.fit.lenses} lens images {written(float(found.fit.lattice_px.pitch.mean()), 4)} px apart"
    verdict: Verdict = "good"
    if share > BRIGHTEST_WHITE:
        verdict, reason = "look", f"{reason}; it reaches {share:.0%} of full scale, two thirds are good"
    if reported:
        verdict, reason = "look", "; ".join([reason, *(f"{each.text}: {each.remedy}" for each in reported)])
    return found, [Line("white image", verdict, reason)]


def image_lines(bench: Bench, pictures: Pictures, lattice: Calibration | None) -> tuple[list[Line], dict[str, Any]]:
    """Return what speaks for and against images, the worst of them for each question, and their figures.

    Parameters
    ----------
    lattice : the microlenses by a white image or a calibration; None: nobody knows where they lie
    """
    asked: list[list[Line]] = []
    figures: list[dict[str, Any]] = []
    for name, image in pictures.images.items():
        seen = _seen(bench, name, image, pictures.dark, lattice)
        number, tracer_light = _counted(bench, seen)
        asked.append([question(bench, seen) for question in QUESTIONS] + [_tracers(bench, seen, number)])
        asked[-1].append(_precision(bench, seen, tracer_light))
        known = bool(np.isfinite(number))
        figures.append(
            {
                "image": name,
                "background_counts": seen.level,
                "noise_counts": seen.noise,
                "signal_to_noise": _signal(seen),
                "tracers_per_lens": number if known else None,
                "tracer_counts": tracer_light if known else None,
            }
        )
    # The first of the worst answers to each question.
    lines = [next(line for line in every if line.verdict == worst(every)) for every in zip(*asked, strict=True)]
    return lines, {name: [each[name] for each in figures] for name in figures[0]} if figures else {}


def full_scale(image: Image, settings: Config) -> float:
    """Return the counts at which a sensor ends: as configured, else the least number of bits that holds an image."""
    given = settings.reconstruction.saturation_counts
    largest = float(np.max(image, initial=0.0, where=np.isfinite(image)))
    return given or next((scale for scale in FULL_SCALES if largest <= scale), largest)


def _seen(bench: Bench, name: str, raw: Image, dark: Image | None, lattice: Calibration | None) -> Seen:
    less_dark, too_bright = light(raw, dark), saturated(raw, bench.settings.reconstruction.saturation_counts)
    if dark is not None:
        hot = defects(dark)
        less_dark, too_bright = np.where(hot, np.float32(0.0), less_dark), too_bright & ~hot
    lens_images = None
    if lattice is not None:
        width = bench.camera.lens_image_fill
        lens_images = LensImages.of(lattice.rectification, lattice.transmission, width)
    # Of the background, between the lens images where it is known where they lie.
    if lens_images is not None:
        level, noise = lens_images.background(less_dark)
    elif dark is not None:
        level, noise = 0.0, read_noise(less_dark.astype(np.float64))
    else:
        level, noise = dark_level(less_dark.ravel())
    return Seen(name, raw, too_bright, less_dark, level, noise, lens_images)


def _counted(bench: Bench, seen: Seen) -> tuple[float, float]:
    """Return tracers for each lens that looks at the volume, and the light of one."""
    level = max(light_checks.LIT_SIGMAS * seen.noise, 0.5)
    part = planning.part_in_front(bench.camera, bench.media, bench.bounds_mm)
    rest = seen.less_dark[part] - np.float32(seen.level)
    lit = float(np.mean(rest > level)), level, float(np.mean(rest, dtype=np.float64))
    # Dark pixels count tracers of any light, up to where all are lit; unevenness any number, of tracers that are alike.
    number, tracer_light = planning.tracers_per_lens(bench.camera, bench.seen[0], lit)
    if np.isfinite(number):
        return number, tracer_light
    # Where hardly a pixel is dark; None where nobody can tell.
    camera, padding = bench.camera, default_padding(bench.camera, bench.media, bench.grid)
    view = raw_view(camera, bench.media, bench.tracer().radius_mm, bench.found)
    lattice_px = camera.micro_image_lattice_px() if bench.found is None else bench.found.fit.lattice_px
    seeded = Seeded(view, camera, bench.grid.padded(padding), bench.grid, bench.grid.bounds_mm(2))
    crowded = tracers_in_image(seeded, seen.less_dark.astype(np.float64), np.isfinite(seen.less_dark), lattice_px)
    if crowded is None:
        return number, tracer_light
    return crowded, lit[2] * float(bench.camera.micro_image_lattice_px().cell_area) / crowded


def _exposure(bench: Bench, seen: Seen) -> Line:
    share = light_checks.saturated_share(seen.less_dark, seen.saturated, (seen.level, seen.noise))
    is_known = np.isfinite(seen.raw)
    if not is_known.any():
        return Line("exposure", "no", f"{seen.name}: none of its pixels is a number")
    scale = full_scale(seen.raw, bench.settings)
    reason = (
        f"{seen.name}: the brightest pixel is at {float(seen.raw[is_known].max()) / scale:.0%} of {scale:g} counts, "
        f"{share:.2%} of the lit ones are saturated"
    )
    notices = light_checks.exposure_notices(share, seen.name)
    if not notices:
        return Line("exposure", "good", reason)
    return Line("exposure", word_of(notices[0].record()), f"{reason}: {notices[0].remedy}")


def _light(_bench: Bench, seen: Seen) -> Line:
    signal = _signal(seen)
    reason = (
        f"{seen.name}: bright pixels stand {signal:.0f} times the noise of {written(seen.noise, 2)} counts above the "
        "background"
    )
    verdict = of_rigs.graded(signal, GOOD_SIGNAL, LEAST_SIGNAL)
    return Line("light", verdict, reason + {"look": ": more light", "no": ": no tracers are seen"}.get(verdict, ""))


def _signal(seen: Seen) -> float:
    """Return the light of bright pixels in standard deviations of the noise."""
    rest = seen.less_dark.ravel() - seen.level
    place = max(rest.size - BRIGHTEST, 0)
    return float(np.partition(rest, place)[place] / max(seen.noise, np.sqrt(1.0 / 12.0)))


def _lens_images(_bench: Bench, seen: Seen) -> Line:
    about = "drift"
    if seen.lens_images is None:
        return Line(about, "unknown", "where they lie nobody has told: --white, or --calibration")
    found = seen.lens_images.beside(seen.less_dark)
    sizes = [(float(np.hypot(*place.shift_px)), place.sigma_px) for place in found.places]
    pitch = float(seen.lens_images.lattice_px.pitch.mean())
    size, sigma = max(sizes, default=(0.0, np.inf))
    if not found.lit or not np.isfinite(sigma):
        return Line(about, "unknown", f"{seen.name}: too little light tells whether they have moved")
    remedy = "take white image and frames with the camera as it is"
    notices = light_checks.position_notices(seen.lens_images, seen.less_dark, seen.name, remedy)
    if not notices:
        return Line(about, "good", f"{seen.name}: moved by {size:.2f} +- {sigma:.2f} px since the white image")
    off = notices[0].code == "light-off-lens-images" or size - light_checks.CERTAIN_SIGMAS * sigma > MOST_MOVED * pitch
    return Line(about, "no" if off else "look", f"{notices[0].about}: {notices[0].text}; {notices[0].remedy}")


def _background(_bench: Bench, seen: Seen) -> Line:
    """Say whether it is dark between the lens images, and tracers are on the lens images."""
    if seen.lens_images is None:
        reason = (
            f"{seen.name}: {written(seen.level)} counts, with noise of {written(seen.noise, 2)}; --white tells more"
        )
        return Line("background", "unknown", reason)
    notices = light_checks.level_notices(seen.lens_images, seen.less_dark, seen.name)
    if notices:
        return Line("background", "look", f"{seen.name}: {notices[0].text}; {notices[0].remedy}")
    return Line("background", "good", f"{seen.name}: {written(seen.level, 2)} counts beside the dark image")


def _beyond(bench: Bench, seen: Seen) -> Line:
    about = "light outside"
    if bench.found is None and not aligned(bench.camera):
        return Line(about, "unknown", "the array is not aligned with the sensor: --calibration, or --white")
    knows_mid_plane = bench.found is not None and bench.found.mid_plane_z_mm is not None
    if bench.settings.volume.reference == "mid_plane" and not knows_mid_plane:
        return Line(about, "unknown", "where the volume lies a calibration with a board tells: --calibration")
    # Light above the background, 0 where it is within noise.
    rest = seen.less_dark - np.float32(seen.level)
    picture = np.where(rest > light_checks.LIT_SIGMAS * seen.noise, rest, np.float32(0.0))
    if bench.found is not None:
        picture = bench.found.rectification.apply(picture).astype(np.float32)
    low, high = bench.bounds_mm[2]
    share = share_beyond(bench.camera, bench.media, (float(low), float(high)), np.maximum(picture, np.float32(0.0)))
    reason = f"{seen.name}: {share:.0%} of the light in its middle comes from before or behind the volume"
    verdict = of_rigs.graded(share, GOOD_BEYOND, MOST_BEYOND)
    return Line(about, verdict, reason + ("" if verdict == "good" else ": a deeper volume, or thinner illumination"))


def _tracers(bench: Bench, seen: Seen, number: float) -> Line:
    if seen.lens_images is not None and bench.found is not None:
        for notice in light_checks.uniform_notices(seen.lens_images, bench.found.fit, seen.less_dark, seen.name):
            return Line("tracers", "no", f"{notice.about}: {notice.text}; {notice.remedy}")
    if not np.isfinite(number):
        reason = "hardly a pixel is dark: two tracers per microlens or more, or haze; volumes err less than particles"
        return Line("tracers", "look", f"{seen.name}: {reason}")
    line = of_rigs.seeding_line(bench, number, "in the image")
    return replace(line, about="tracers", reason=f"{seen.name}: {line.reason}")


def _precision(bench: Bench, seen: Seen, tracer_light: float) -> Line:
    about = "precision, measured"
    if not 0.0 < tracer_light < np.inf:
        return Line(about, "unknown", f"{seen.name}: no tracer could be told from others")
    # The median smallest errors (3,) of tracers of this light, with the noise of the image.
    plain = bench.tracer()
    tracer = replace(plain, light_counts=tracer_light, readout=replace(plain.readout, read_noise_counts=seen.noise))
    errors = np.median(bench.errors_of(tracer), axis=0)
    reason = (
        f"{seen.name}: a tracer alone of {written(tracer_light, 2)} counts, as here, is placed to "
        f"{written(1e3 * errors[0], 2)} um across and {written(1e3 * errors[2], 2)} um in depth at best, "
        f"{of_rigs.by_which_light(bench)}"
    )
    return Line(about, of_rigs.error_verdict(bench, errors[2]), reason)


QUESTIONS: Sequence[Callable[[Bench, Seen], Line]] = (_exposure, _light, _background, _lens_images, _beyond)


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """What `check` is given besides the config and images.

    Attributes
    ----------
    white, dark : images of uniform light, and of none
    calibration : file of `calibrate_snapshot`
    velocity_m_s : to expect; None: the configured flow's
    picture : of errors and field of view by depth, to write
    """

    white: Path | None = None
    dark: Path | None = None
    calibration: Path | None = None
    velocity_m_s: float | None = None
    picture: Path | None = None


def check(
    config: Path,
    images: Sequence[Path] = (),
    options: CheckOptions = CheckOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Return the verdict on a rig and on images, the lines that it comes from, and their figures."""
    inputs = given(config=config, white=options.white, dark=options.dark, calibration=options.calibration)
    if options.picture is not None:
        atomic.ensure_writable(options.picture, overwrite, [*inputs.values(), *images])
        pages.ensure_drawing()
    settings = load_rig(config)
    shape = settings.image_shape()
    pictures = Pictures(
        {path.name: read_single(path, shape) for path in images},
        None if options.white is None else read_reference(options.white, shape),
        None if options.dark is None else read_reference(options.dark, shape),
    )
    found = None if options.calibration is None else calibration_file.open_calibration(options.calibration)
    of_white, lines = lattice_of(settings, pictures)
    found = found or of_white
    bench = of_rigs.bench_of(settings, found, options.velocity_m_s)
    lines = [*of_rigs.rig_lines(bench), *lines]
    figures = of_rigs.rig_figures(bench)
    if images:
        of_images, measured = image_lines(bench, pictures, found)
        lines, figures = [*lines, *of_images], figures | measured
    if options.picture is not None:
        from lfpiv_cli.pictures.calibration import planning_figure

        pages.write_picture(options.picture, planning_figure(of_rigs.by_depth(bench), bench.bounds_mm), overwrite)
    return {"verdicts": [asdict(line) for line in lines], **figures, "verdict": worst(lines)}
