"""Pictures to believe in walls by: where particles lie, and where they end, in depth or around a pipe's axis."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.pictures.style import BLACK, GREY, SKY_BLUE, VERMILION, new_figure, styled
from lfpiv_cli.self_calibration.refinement import Refinement
from lfpiv_cli.self_calibration.scene_refinement import SceneRefinement

if TYPE_CHECKING:
    from matplotlib.figure import Figure


BARS_AT_ROUND_WALL = 60
# Shown beside the wall: the ring's outer part and as much beyond the wall as was searched.
ZOOM_PER_RADIUS = 0.08


@styled
def round_wall_figure(refinement: SceneRefinement) -> Figure:
    """Return a figure of the particles beside the pipe's wall, in its section, by angle, along the axis, and counted.

    Distances are those from the axis that was told before. Needs matplotlib.
    """
    scene, wall = refinement.scene, refinement.wall
    radius = scene.wall.radius_mm
    own = scene.about_axis(refinement.position_mm, np.zeros(4))
    angle, distance = np.arctan2(own[:, 2], own[:, 1]), np.hypot(own[:, 1], own[:, 2])
    limits = radius * (1.0 - ZOOM_PER_RADIUS), radius * (1.0 + ZOOM_PER_RADIUS)
    figure = new_figure(12.0, 9.0)
    (section, around), (along, counted) = figure.subplots(2, 2)
    _draw_section(section, refinement, own, radius)
    fine = np.linspace(-np.pi, np.pi, 400)
    around.plot(np.rad2deg(angle), distance, ".", color=SKY_BLUE, markersize=2.0, label="particles")
    around.plot(np.rad2deg(fine), _wall(refinement, fine), color=VERMILION, label="wall by the particles")
    around.axhline(radius, color=GREY, linestyle=":", label="wall before")
    around.set(
        xlabel="angle about the axis, from across to away from the camera (degrees)",
        ylabel="distance from the axis before (mm)",
        xlim=(-180.0, 180.0),
        ylim=limits,
    )
    around.legend(loc="lower right")
    moved = distance - (_wall(refinement, angle, own[:, 0]) - wall.radius_mm)
    along.plot(own[:, 0], moved, ".", color=SKY_BLUE, markersize=2.0)
    along.axhline(wall.radius_mm, color=VERMILION)
    along.axhline(radius, color=GREY, linestyle=":")
    along.set(xlabel="place along the axis (mm)", ylabel="distance from the axis found (mm)", ylim=limits)
    _draw_counted(counted, moved, refinement, limits)
    sigma = np.sqrt(np.diag(refinement.covariance))
    shift = " and ".join(f"{1e3 * refinement.axis[k]:z.1f} +- {1e3 * sigma[k]:.1f}" for k in (0, 1))
    tilt = " and ".join(f"{np.rad2deg(refinement.axis[k]):z.3f} +- {np.rad2deg(sigma[k]):.3f}" for k in (2, 3))
    figure.suptitle(f"axis {shift} um across and away from the camera beside the one before, tilted by {tilt} degrees")
    return figure


def _wall(refinement: SceneRefinement, angle: Floats, along_mm: Floats | float = 0.0) -> Floats:
    """Return the distance (n,) of the wall, by its own place and apparent radius, from the axis before."""
    across, away, tilt_across, tilt_away = refinement.by_wall
    shift = (across + tilt_across * along_mm) * np.cos(angle) + (away + tilt_away * along_mm) * np.sin(angle)
    return np.asarray(refinement.wall.radius_mm + shift, dtype=np.float64)


def _draw_section(axes: Any, refinement: SceneRefinement, own: Floats, radius: float) -> None:
    """Draw the particles whose wall is in view in the pipe's section, with the wall before and as it was found."""
    fine = np.linspace(-np.pi, np.pi, 400)
    axes.plot(own[:, 1], own[:, 2], ",", color=SKY_BLUE)
    found = _wall(refinement, fine)
    axes.plot(found * np.cos(fine), found * np.sin(fine), color=VERMILION, linewidth=1.0)
    axes.plot(radius * np.cos(fine), radius * np.sin(fine), color=GREY, linestyle=":")
    axes.set(xlabel="across (mm)", ylabel="away from the camera (mm)", aspect="equal")
    axes.invert_yaxis()
    axes.set_title(f"{len(own)} of {refinement.particles} particles, whose wall is in view")


def _draw_counted(axes: Any, distance: Floats, refinement: SceneRefinement, limits: tuple[float, float]) -> None:
    """Draw how many particles lie at each distance, over the area there, beside the wall."""
    edges = np.linspace(*limits, BARS_AT_ROUND_WALL + 1)
    number, _ = np.histogram(distance, edges)
    axes.stairs(number, edges, fill=True, color=SKY_BLUE)
    axes.axvline(refinement.wall.radius_mm, color=VERMILION, label=f"{refinement.wall.radius_mm:.3f} mm, found")
    axes.axvline(refinement.scene.wall.radius_mm, color=BLACK, linestyle=":", label="of the scene")
    axes.set(xlabel="distance from the axis found (mm)", ylabel="particles", xlim=limits)
    axes.legend(loc="upper right")


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


def _draw_depths(axes: Any, refinement: Refinement, depth: Floats, limits: tuple[float, float], bars: int) -> None:
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
