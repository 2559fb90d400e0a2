"""The stage of `check`: what a rig and its images are good for, before any work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.images import read_image, read_reference
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.interface.image_planning import Pictures, image_lines, lattice_of
from lfpiv_cli.interface.planning import Bench, bench_of, by_depth, rig_figures, rig_lines, worst


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


NO_OPTIONS = CheckOptions()


def check(
    config: Path,
    images: Sequence[Path] = (),
    options: CheckOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Return the verdict on a rig and on images, the lines that it comes from, and their figures."""
    inputs = given(config=config, white=options.white, dark=options.dark, calibration=options.calibration)
    if options.picture is not None:
        ensure_writable(options.picture, overwrite, [*inputs.values(), *images])
        ensure_drawing()
    settings = load_config(config)
    shape = settings.image_shape()
    pictures = Pictures(
        {path.name: read_image(path, shape) for path in images},
        None if options.white is None else read_reference(options.white, shape),
        None if options.dark is None else read_reference(options.dark, shape),
    )
    found = None if options.calibration is None else read_calibration(options.calibration)
    of_white, lines = lattice_of(settings, pictures)
    found = found or of_white
    bench = bench_of(settings, found, options.velocity_m_s)
    lines = [*rig_lines(bench), *lines]
    figures = rig_figures(bench)
    if images:
        of_images, measured = image_lines(bench, pictures, found)
        lines, figures = [*lines, *of_images], figures | measured
    if options.picture is not None:
        _draw(options.picture, bench, overwrite)
    return {"verdicts": [line.row() for line in lines], **figures, "verdict": worst(lines)}


def _draw(path: Path, bench: Bench, overwrite: bool) -> None:
    from lfpiv_cli.pictures.planning import planning_figure

    write_picture(path, planning_figure(by_depth(bench), bench.bounds_mm), overwrite)
