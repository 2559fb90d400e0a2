"""A picture to believe in walls by: where the particles lie in depth, and where they were found to end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.pictures.style import SKY_BLUE, VERMILION, new_figure, styled
from lfpiv_cli.self_calibration.refinement import Refinement

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Bars over the whole depth, and beside a wall.
BARS, BARS_AT_WALL = 100, 60
# The zooms show this share of the width to both sides of a wall.
ZOOM_PER_WIDTH = 0.06


@styled
def walls_figure(refinement: Refinement) -> Figure:
    """Return a figure with the depths of the particles: all, beside each wall, and across the channel.

    Needs matplotlib.
    """
    walls = refinement.walls
    depth = walls.depth_from_middle(refinement.position_mm)
    half = 0.5 * walls.width_mm
    searched = refinement.depths_mm[1] - refinement.depths_mm[0]
    figure = new_figure(12.0, 8.0)
    (whole, across), (near, far) = figure.subplots(2, 2)
    limits = (0.5 * searched * np.array([-1.0, 1.0])).tolist()
    _draw_depths(whole, refinement, depth, (limits[0], limits[1]), BARS)
    expected = (refinement.expected_z_mm or 0.0) - walls.middle_mm
    for side in (-1.0, 1.0):
        before = expected + side * 0.5 * refinement.width_mm
        whole.axvline(before, color="0.5", linestyle=":", label="walls before" if side < 0.0 else None)
    whole.set_title(f"{len(depth)} particles in {refinement.frames} images")
    whole.legend()
    for axes, side, name in ((near, -1.0, "near"), (far, 1.0, "far")):
        zoom = ZOOM_PER_WIDTH * refinement.width_mm
        _draw_depths(axes, refinement, depth, (side * half - zoom, side * half + zoom), BARS_AT_WALL)
        axes.set_title(f"{name} wall, at z = {walls.middle_mm + side * half:z.3f} mm on the axis")
    _draw_across(across, refinement)
    middle, sigma = walls.middle_mm, refinement.middle_sigma_mm
    tilt = " and ".join(f"{angle:z.2f}" for angle in np.rad2deg(np.arctan(walls.slope)))
    figure.suptitle(f"mid plane at z = {middle:z.3f} +- {sigma:.3f} mm, walls tilted by {tilt} degrees")
    return figure


def _draw_depths(
    axes: Any, refinement: Refinement, depth: NDArray[np.float64], limits: tuple[float, float], bars: int
) -> None:
    """Draw how many particles lie at each depth behind the mid plane, and the fitted profile."""
    axes.hist(depth, bins=bars, range=limits, color=SKY_BLUE, label="particles")
    fine = np.linspace(*limits, 1000)
    width = (limits[1] - limits[0]) / bars
    expected = refinement.walls.density(fine, refinement.depths_mm[1] - refinement.depths_mm[0]) * len(depth) * width
    axes.plot(fine, expected, color=VERMILION, label="fitted")
    axes.set(xlabel="depth behind the mid plane, tilt taken out (mm)", ylabel="particles", xlim=limits)


def _draw_across(axes: Any, refinement: Refinement) -> None:
    """Draw the particles from the side, with the walls on the axis's plane."""
    position, walls = refinement.position_mm, refinement.walls
    axes.plot(position[:, 0], position[:, 2], ",", color=SKY_BLUE)
    x = np.array([position[:, 0].min(), position[:, 0].max()])
    for side in (-0.5, 0.5):
        axes.plot(x, walls.middle_mm + side * walls.width_mm + walls.slope[0] * x, color=VERMILION)
    axes.set(xlabel="x (mm)", ylabel="z (mm)", title="from the side, and the walls at y = 0")
