"""The figure of a tracer's light under nine microlenses: by rays, by rays that one lens blurs, and by waves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.config import load_rig
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.pictures.style import new_figure, styled
from lfpiv_cli.synthetic.render import Balls, lens_blur_mm, render_points

# Table 2's camera, a tracer in its fluid; nine lenses are some 55 pixels wide.
DIAMETERS_MM, DEPTH_MM, PLACE_MM, SIDE_PX = (0.0, 0.05), 3.0, (0.012, 0.021), 56
GREEN = Waves(532e-6, 64)
RAYS = 2_000_000


def images(config: Path, diameter_mm: float) -> dict[str, NDArray[np.float64]]:
    """Return what rays, blurred rays and waves make of one tracer, by their names."""
    settings = load_rig(config)
    camera = replace(settings.camera_model(), columns=SIDE_PX, rows=SIDE_PX)
    space = ObjectSpace(settings.media_model(), settings.window_model(), "exact")
    ball = Balls(np.array([[*PLACE_MM, DEPTH_MM]]), 1.0, diameter_mm)
    blur = lens_blur_mm(camera, GREEN)
    return {
        "rays": render_points(camera, space, ball, np.random.default_rng(0), rays=RAYS),
        "rays, blurred as by one lens": render_points(
            camera, space, ball, np.random.default_rng(0), rays=RAYS, blur_mm=blur
        ),
        "waves": render_points(camera, space, ball, np.random.default_rng(0), waves=GREEN),
    }


@styled
def write_figure(config: Path, path: Path) -> None:
    """Draw the images of a point and of a tracer of 50 um, each row in one scale."""
    figure = new_figure(7.2, 5.0)
    axes = figure.subplots(len(DIAMETERS_MM), 3)
    for row, diameter in zip(axes, DIAMETERS_MM, strict=True):
        found = images(config, diameter)
        brightest = max(image.max() for image in found.values())
        for axis, (name, image) in zip(row, found.items(), strict=True):
            axis.imshow(np.sqrt(image), vmin=0.0, vmax=np.sqrt(brightest), interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
            if diameter == DIAMETERS_MM[0]:
                axis.set_title(name)
        row[0].set_ylabel("a point" if diameter == 0.0 else f"{1e3 * diameter:g} µm")
    figure.savefig(path, dpi=150)
