"""The stage of `refine-calibration`: images of particles in, the calibration's remaining error and a mended one out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import frames_of
from lfpiv_cli.files.calibration_file import read_calibration, write_calibration
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.places import ensure_apart
from lfpiv_cli.files.provenance import record
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.reconstruction.images import light
from lfpiv_cli.self_calibration.refinement import STEPS, ChannelFlow
from lfpiv_cli.self_calibration.refinement import refine_calibration as refine


@dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """What `refine_calibration` takes off the images and what it writes; without `output` it only reports.

    Attributes
    ----------
    dark : image taken with the cap on
    background : image without tracers, in place of the dark one
    output : mended calibration to write
    picture : of the particles' depths and the walls, to write
    """

    dark: Path | None = None
    background: Path | None = None
    output: Path | None = None
    picture: Path | None = None


NO_OPTIONS = RefineOptions()


def refine_calibration(
    config: Path,
    images: Sequence[Path],
    calibration: Path,
    options: RefineOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Find the channel's walls by the particles, report where they are, and write the calibration with them."""
    dark, background, output, picture = options.dark, options.background, options.output, options.picture
    named = {"image" if k == 0 else f"image_{k + 1}": path for k, path in enumerate(images)}
    inputs = given(config=config, calibration=calibration, dark=dark, background=background) | named
    outputs = [path for path in (output, picture) if path is not None]
    ensure_apart(outputs, inputs.values())
    for target in outputs:
        ensure_writable(target, overwrite)
    if picture:
        ensure_drawing()
    settings = load_config(config)
    if settings.channel is None:
        raise ConfigError(f"{config}: channel: is missing; the walls are known by the channel's width")
    frames, shape = frames_of(images), settings.image_shape()
    before = read_calibration(calibration)
    window = settings.window_model(before.mid_plane_z_mm or 0.0)
    dark_image, empty = (image_files.read_reference(path, shape) if path else None for path in (dark, background))
    lit = [light(image_files.read_page(frame.path, frame.page, shape), dark_image, empty) for frame in frames]
    with console.progress(len(lit) * STEPS + 1, "refine") as advance:
        found = refine(
            lit,
            before,
            settings.camera_model(),
            ObjectSpace(settings.media_model(), window, "exact"),
            ChannelFlow(settings.grid(), settings.channel.width_mm, settings.reconstruction.particle_diameter_mm),
            advance,
        )
    if output:
        made_by = record("refine-calibration", settings.resolved(), inputs)
        write_calibration(output, found.applied(before), made_by, overwrite)
    if picture:
        from lfpiv_cli.pictures.walls import walls_figure

        write_picture(picture, walls_figure(found), overwrite)
    return found.summary()
