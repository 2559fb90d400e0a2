"""`refine-calibration`: images of particles in, the calibration's remaining error and a mended one out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files import atomic, batch, calibration_file, pages, provenance
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.inputs import given
from lfpiv_cli.notice import Notice
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.images import light
from lfpiv_cli.self_calibration.refinement import STEPS, ChannelFlow, Refinement
from lfpiv_cli.self_calibration.refinement import refine_calibration as refine
from lfpiv_cli.self_calibration.scene_refinement import AGREEING_CHI2, STEPS_OF_FIRST, SceneRefinement, refine_scene


@dataclass(frozen=True, kw_only=True)
class RefineOptions:
    """What `refine_calibration` takes off the images and what it writes; without `output` it only reports.

    Attributes
    ----------
    dark : image taken with the cap on
    background : image without tracers, in place of the dark one
    output : mended calibration to write
    picture : of the particles and the walls that they end at, to write
    """

    dark: Path | None = None
    background: Path | None = None
    output: Path | None = None
    picture: Path | None = None


def refine_calibration(
    config: Path,
    images: Sequence[Path],
    calibration: Path,
    options: RefineOptions = RefineOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Find a channel's walls, or a pipe's axis, by the particles, report it, and write the calibration with it."""
    dark, background, output, picture = options.dark, options.background, options.output, options.picture
    named = {"image" if k == 0 else f"image_{k + 1}": path for k, path in enumerate(images)}
    inputs = given(config=config, calibration=calibration, dark=dark, background=background) | named
    outputs = [path for path in (output, picture) if path is not None]
    atomic.ensure_apart(outputs, inputs.values())
    for target in outputs:
        atomic.ensure_writable(target, overwrite)
    if picture:
        pages.ensure_drawing()
    before = calibration_file.open_calibration(calibration)
    reported = load_rig(config)
    settings = reported.with_scene_of(before)
    # What the walls are known by.
    known = settings.scene_space() or settings.channel
    if known is None:
        raise ConfigError(f"{config}: channel: is missing; the walls are known by the channel's width, or by a scene")
    frames, shape, camera = batch.frames_of(images), settings.image_shape(), settings.camera_model()
    dark_image, empty = (image_files.read_reference(path, shape) if path else None for path in (dark, background))
    lit = [light(image_files.read_image(frame.path, frame.page, shape), dark_image, empty) for frame in frames]
    grid, diameter_mm = settings.grid(), settings.reconstruction.particle_diameter_mm
    found: Refinement | SceneRefinement
    if isinstance(known, CurvedSpace):
        with console.progress(STEPS_OF_FIRST + (len(lit) - 1) * STEPS, "refine") as advance:
            found = refine_scene(lit, before, camera, known, grid, diameter_mm, advance)
        console.warn(scene_notices(found))
        mended = found.applied(before, reported.scene_fingerprint())
    else:
        space = ObjectSpace(settings.media_model(), settings.window_model(before.mid_plane_z_mm or 0.0), "exact")
        flow = ChannelFlow(grid, known.width_mm, diameter_mm, settings.reconstruction.wave_light())
        with console.progress(len(lit) * STEPS + 1, "refine") as advance:
            found = refine(lit, before, camera, space, flow, advance)
        mended = found.applied(before)
    if output:
        made_by = provenance.record("refine-calibration", reported.resolved(), inputs)
        calibration_file.write_calibration(output, mended, made_by, overwrite)
    if picture:
        from lfpiv_cli.pictures.calibration import round_wall_figure, walls_figure

        drawn = walls_figure(found) if isinstance(found, Refinement) else round_wall_figure(found)
        pages.write_picture(picture, drawn, overwrite)
    return found.summary()


def scene_notices(found: SceneRefinement) -> list[Notice]:
    """Return where images, the wall that tracers end at, and the scene as it was given contradict each other."""
    notices, remedy = [], "measure radii and refractive indices of the scene"
    if not found.agree:
        images, wall = (
            " and ".join(f"{value:z.3f} ± {error:.3f}" for value, error in zip(axis[:2], sigma[:2], strict=True))
            for axis, sigma in (
                (found.nuisances.scene, found.nuisances_sigma.scene),
                (found.by_wall, np.sqrt(np.diag(found.by_wall_covariance))),
            )
        )
        text = (
            f"the tracers' images tell of a pipe whose axis lies {images} mm (across, away) from where it is said to, "
            f"the wall that they end at of one at {wall} mm, more apart than chance explains; the wall is believed"
        )
        expected = f"at most {AGREEING_CHI2:g}"
        notices.append(Notice("scene-contradicts", "scene", text, remedy, found.disagreement, expected))
    if found.radius_off_mm:
        radius, told = found.wall.radius_mm, found.scene.wall.radius_mm
        text = (
            f"tracers end {radius:.3f} ± {found.radius_sigma_mm:.3f} mm from the pipe's axis, and its radius_mm is "
            f"{told:g}: what images say of the axis is taken to be {found.radius_off_mm:.3f} mm uncertain, and the "
            "flow behind such a scene is wrong"
        )
        notices.append(Notice("scene-radius", "scene", text, f"{remedy}, and refine again", radius, f"{told:g} mm"))
    return notices
