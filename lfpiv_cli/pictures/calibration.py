"""Pictures of a rig: does its lattice sit on lens images, are its views alike, what will it see, where are walls?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.views import refocused_stack, views_across
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.pictures import style
from lfpiv_cli.self_calibration.refinement import Refinement
from lfpiv_cli.self_calibration.scene_refinement import SceneRefinement

COLOURS = (style.GREEN, style.VERMILION, style.BLUE)


@style.styled
def planning_figure(reported: Mapping[str, Floats], bounds_mm: Floats) -> style.Figure:
    """Return errors over depth, and the volume within the field of view seen from above and from the side.

    Parameters
    ----------
    reported : `depth_mm` (n,), `sigma_mm` (n, 3), half the fields of view `full_view_mm` and `any_view_mm` (n, 2)
    bounds_mm : (3, 2) of the volume, z from the focal point
    """
    figure, (errors, *views) = style.new_panels(9.5, 3.6, 1, 3)
    depth = reported["depth_mm"]
    for axis, name in enumerate(style.AXIS_NAMES):
        sigma_um = 1e3 * reported["sigma_mm"][:, axis]
        errors.semilogy(depth, sigma_um, color=COLOURS[axis], marker=style.MARKERS[axis], label=name)
    errors.set(xlabel="z from the focal plane (mm)", ylabel="smallest error of a tracer alone (µm)")
    errors.grid(alpha=0.3, which="both")
    errors.legend()
    for axis, axes in enumerate(views):
        for key, label, shade in (("any_view_mm", "seen in part", 0.85), ("full_view_mm", "seen in full", 0.65)):
            half = reported[key][:, axis]
            axes.fill_between(depth, -half, half, color=str(shade), label=label)
        (left, right), (low, high) = bounds_mm[2], bounds_mm[axis]
        axes.plot([left, right, right, left, left], [low, low, high, high, low], color=style.VERMILION, label="volume")
        axes.axvline(0.0, color=style.GREY, linestyle=":")
        axes.set(xlabel="z from the focal plane (mm)", ylabel=f"{style.AXIS_NAMES[axis]} (mm)")
    views[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return figure


# Enough views to see vignetting and a wrong lattice at the rim, few enough to see dots in each.
VIEWS_PER_SIDE = 5
# Depths of the stack, in units over which the main lens's rim moves a point by a microlens.
STEPS = (-4.0, -2.0, 0.0, 2.0, 4.0)


@style.styled
def views_figure(calibration: Calibration, camera: Camera, media: Media, image: ArrayLike) -> style.Figure:
    """Return a figure with the views of a raw picture less its dark frame, and the same refocused about the board.

    `camera` is the data sheet's and `media` what the picture was taken in. Needs matplotlib.
    """
    measured = calibration.camera(camera)
    rectified = calibration.rectification.apply(image)
    unit = float(measured.lattice.pitch.max()) / measured.aperture_radius_mm * measured.focus_distance_mm
    middle = 0.0 if calibration.pose is None else calibration.pose.z0_mm
    depths = middle + np.array(STEPS) * unit * abs(1.0 / measured.magnification) / media.depth_ratio
    stack = refocused_stack(rectified, measured, media, depths, calibration.transmission)

    views = views_across(rectified, measured, VIEWS_PER_SIDE)
    brightest = max(float(view.max()) for _, view in views.values())
    figure = style.new_figure(13.0, 12.5)
    grid = figure.add_gridspec(VIEWS_PER_SIDE + 1, len(STEPS), height_ratios=(1.0,) * VIEWS_PER_SIDE + (1.3,))
    for (row, column), (point, view) in views.items():
        axis = figure.add_subplot(grid[row, column])
        axis.imshow(view, cmap="gray", vmin=0.0, vmax=brightest, interpolation="nearest")
        axis.set_title(f"X = {written(point[0], 2)}, Y = {written(point[1], 2)} mm")
        axis.set_axis_off()
    for k, (depth, picture) in enumerate(zip(depths, stack, strict=True)):
        axis = figure.add_subplot(grid[-1, k])
        axis.imshow(picture, cmap="gray", interpolation="nearest", vmin=0.0, vmax=float(stack.max()))
        axis.set_title(f"refocused at z = {depth:z.2f} mm")
        axis.set_axis_off()
    figure.suptitle("views from points (X, Y) of the main lens, one sample per microlens; below, refocused")
    return figure


# Zooms show six lenses across: enough to see the order, few enough to see a tenth of the pitch.
LENSES_ACROSS = 6.0


@style.styled
def summary_figure(calibration: Calibration) -> style.Figure:
    """How far the lens images lie off the lattice, what pixels pass, and where the board was found."""
    figure, ((along_columns, along_rows), (passed, board)) = style.new_panels(11.0, 8.0, 2, 2)
    for axis, direction in ((along_columns, 0), (along_rows, 1)):
        draw_residual(figure, axis, calibration.fit, direction, calibration.image_shape)
    if calibration.transmission is None:
        _draw_nothing(passed, "transmission not measured")
    else:
        shown = passed.imshow(calibration.transmission, cmap=style.SEQUENTIAL, vmin=0.0, interpolation="nearest")
        style.colour_bar(figure, shown, passed, "share of light passed")
        passed.set(title="transmission, upright; 0 where unusable", xlabel="column (px)", ylabel="row (px)")
    draw_board_or_rays(figure, board, calibration)
    figure.suptitle(lattice_words(calibration.fit))
    return figure


def lattice_words(fit: LatticeFit) -> str:
    """Return how many lenses the lattice has, its pitch and its rotation."""
    pitch, turn = fit.lattice_px.pitch, np.rad2deg(fit.lattice_px.rotation_rad)
    return f"{fit.lenses} lenses, pitch {pitch[0]:.4f} and {pitch[1]:.4f} px, rotation {turn:z.4f} degrees"


@style.styled
def calibration_figure(calibration: Calibration, white: ArrayLike, board: ArrayLike | None = None) -> style.Figure:
    """The lattice on the white image, in the middle and in two corners.

    Besides, the residuals, and the board.

    `white` and `board` are the raw pictures (rows, columns). Needs matplotlib.
    """
    figure, panels = style.new_panels(14.0, 8.8, 2, 3)
    axes = panels.ravel()
    image = np.asarray(white, dtype=np.float64)
    rows, columns = image.shape
    fit = calibration.fit
    half = 0.5 * LENSES_ACROSS * float(fit.lattice_px.pitch.max())
    zooms = {
        "middle": (columns / 2, rows / 2),
        "first corner": (half, half),
        "last corner": (columns - half, rows - half),
    }
    line = np.arange(-int(LENSES_ACROSS), int(LENSES_ACROSS) + 1)
    reach = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    for axis, (name, centre) in zip(axes, zooms.items(), strict=False):
        model = fit.centres(fit.lattice_px.nearest(np.array(centre)) + reach)
        axis.imshow(image, cmap="gray", interpolation="nearest")
        axis.plot(*model.T, "+", color=style.VERMILION, markersize=14, zorder=3, label="lattice")
        axis.plot(*fit.centres_px.T, "o", mfc="none", color=style.SKY_BLUE, markersize=8, label="measured")
        axis.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] + half, centre[1] - half))
        axis.set(title=f"white image, {name}", xlabel="column (px)", ylabel="row (px)")
    axes[0].legend(loc="upper right", framealpha=0.9)
    for axis, direction in ((axes[3], 0), (axes[4], 1)):
        draw_residual(figure, axis, fit, direction, (rows, columns))
    draw_board_or_rays(figure, axes[5], calibration, board)
    figure.suptitle(lattice_words(fit))
    return figure


def draw_residual(figure: Any, axis: Any, fit: LatticeFit, direction: int, shape: tuple[int, int]) -> None:
    """Map measured less modelled centres along the columns (0) or the rows (1)."""
    residual = (fit.centres_px - fit.centres(fit.indices))[:, direction]
    limit = max(3.0 * float(np.median(np.abs(residual))), 1e-3) if fit.lenses else 1.0
    dots = axis.scatter(*fit.centres_px.T, c=residual, s=4, cmap=style.DIVERGING, vmin=-limit, vmax=limit, linewidths=0)
    style.colour_bar(figure, dots, axis, "measured less modelled (px)")
    along = ("columns", "rows")[direction]
    rms = (fit.residual_px if fit.cubic_used else fit.residual_affine_px)[direction]
    axis.set_title(f"off the lattice along the {along}:\nrms {rms:.3f} px")
    axis.set(xlim=(0, shape[1]), ylim=(shape[0], 0), aspect="equal", xlabel="column (px)", ylabel="row (px)")


def draw_board_or_rays(figure: Any, axis: Any, calibration: Calibration, board: ArrayLike | None = None) -> None:
    """Show the dots that were found, coloured by depth, over the picture of the board where it is given.

    Of a calibration by boards at several depths, show how far the polynomials miss the dots of each.
    """
    pose, fit = calibration.pose, calibration.ray_fit
    if fit is not None:
        order = np.argsort(fit.depths_mm)
        for residual, name in zip(fit.residual_mm.T, ("columns", "rows"), strict=True):
            axis.plot(fit.depths_mm[order], 1e3 * residual[order], "o-", label=f"along the {name}")
        axis.legend()
        axis.set(xlabel="depth of the board (mm)", ylabel="rms misfit on the array (µm)", ylim=(0.0, None))
        axis.set_title(f"polynomials of degree {fit.rays.degree}\nthrough {fit.sightings} sightings of dots")
        return
    if pose is None:
        _draw_nothing(axis, "no board")
        return
    if board is not None:
        image = np.asarray(board, dtype=np.float64)
        axis.imshow(image, cmap="gray", vmin=np.percentile(image, 1.0), vmax=np.percentile(image, 99.9))
    dots = axis.scatter(*pose.dots_px.T, c=pose.dots_mm[:, 2], s=120, cmap=style.SEQUENTIAL, marker="+", linewidths=2)
    style.colour_bar(figure, dots, axis, "depth (mm)")
    tilt = " and ".join(f"{angle:z.2f}" for angle in pose.tilt_deg)
    axis.set_title(f"board: z = {pose.z0_mm:z.3f} mm, M = {pose.magnification:.4f},\ntilt {tilt} degrees")
    rows, columns = calibration.image_shape
    axis.set(xlabel="column (px)", ylabel="row (px)", xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    axis.set_aspect("equal")


def _draw_nothing(axis: Any, why: str) -> None:
    axis.set_axis_off()
    axis.text(0.5, 0.5, why, ha="center", va="center", transform=axis.transAxes)


# Pictures to believe in walls by: where particles lie, and where they end, in depth or around a pipe's axis.

BARS_AT_ROUND_WALL = 60
# Shown beside the wall: the ring's outer part and as much beyond the wall as was searched.
ZOOM_PER_RADIUS = 0.08


@style.styled
def round_wall_figure(refinement: SceneRefinement) -> style.Figure:
    """Return a figure of the particles beside the pipe's wall, in its section, by angle, along the axis, and counted.

    Distances are those from the axis that was told before. Needs matplotlib.
    """
    scene, wall = refinement.scene, refinement.wall
    radius = scene.wall.radius_mm
    own = scene.about_axis(refinement.position_mm, np.zeros(4))
    angle, distance = np.arctan2(own[:, 2], own[:, 1]), np.hypot(own[:, 1], own[:, 2])
    limits = radius * (1.0 - ZOOM_PER_RADIUS), radius * (1.0 + ZOOM_PER_RADIUS)
    figure, ((section, around), (along, counted)) = style.new_panels(12.0, 9.0, 2, 2)
    fine = np.linspace(-np.pi, np.pi, 400)
    found = _wall(refinement, fine)
    section.plot(own[:, 1], own[:, 2], ",", color=style.SKY_BLUE)
    section.plot(found * np.cos(fine), found * np.sin(fine), color=style.VERMILION, linewidth=1.0)
    section.plot(radius * np.cos(fine), radius * np.sin(fine), color=style.GREY, linestyle=":")
    section.set(xlabel="across (mm)", ylabel="away from the camera (mm)", aspect="equal")
    section.invert_yaxis()
    section.set_title(f"{len(own)} of {refinement.particles} particles, whose wall is in view")
    around.plot(np.rad2deg(angle), distance, ".", color=style.SKY_BLUE, markersize=2.0, label="particles")
    around.plot(np.rad2deg(fine), found, color=style.VERMILION, label="wall by the particles")
    around.axhline(radius, color=style.GREY, linestyle=":", label="wall before")
    around.set(
        xlabel="angle about the axis, from across to away from the camera (degrees)",
        ylabel="distance from the axis before (mm)",
        xlim=(-180.0, 180.0),
        ylim=limits,
    )
    around.legend(loc="lower right")
    moved = distance - (_wall(refinement, angle, own[:, 0]) - wall.radius_mm)
    along.plot(own[:, 0], moved, ".", color=style.SKY_BLUE, markersize=2.0)
    along.axhline(wall.radius_mm, color=style.VERMILION)
    along.axhline(radius, color=style.GREY, linestyle=":")
    along.set(xlabel="place along the axis (mm)", ylabel="distance from the axis found (mm)", ylim=limits)
    edges = np.linspace(*limits, BARS_AT_ROUND_WALL + 1)
    counted.stairs(np.histogram(moved, edges)[0], edges, fill=True, color=style.SKY_BLUE)
    counted.axvline(wall.radius_mm, color=style.VERMILION, label=f"{wall.radius_mm:.3f} mm, found")
    counted.axvline(radius, color=style.BLACK, linestyle=":", label="of the scene")
    counted.set(xlabel="distance from the axis found (mm)", ylabel="particles", xlim=limits)
    counted.legend(loc="upper right")
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


# Bars over the whole depth, and beside a wall.
BARS, BARS_AT_WALL = 100, 60
# The zooms show this share of the width to both sides of a wall.
ZOOM_PER_WIDTH = 0.06


@style.styled
def walls_figure(refinement: Refinement) -> style.Figure:
    """Return a figure with the depths of the particles: all, beside each wall, and across the channel.

    Needs matplotlib.
    """
    walls = refinement.walls
    place = refinement.position_mm
    depth = place[:, 2] - place[:, :2] @ walls.slope - walls.middle_mm
    half = 0.5 * walls.width_mm
    searched = refinement.depths_mm[1] - refinement.depths_mm[0]
    figure, ((whole, across), (near, far)) = style.new_panels(12.0, 8.0, 2, 2)
    _draw_depths(whole, refinement, depth, (-0.5 * searched, 0.5 * searched), BARS)
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
    across.plot(place[:, 0], place[:, 2], ",", color=style.SKY_BLUE)
    x = np.array([place[:, 0].min(), place[:, 0].max()])
    for end in (-0.5, 0.5):
        across.plot(x, walls.middle_mm + end * walls.width_mm + walls.slope[0] * x, color=style.VERMILION)
    across.set(xlabel="x (mm)", ylabel="z (mm)", title="from the side, and the walls at y = 0")
    middle, sigma = walls.middle_mm, refinement.middle_sigma_mm
    tilt = " and ".join(f"{angle:z.2f}" for angle in np.rad2deg(np.arctan(walls.slope)))
    figure.suptitle(f"mid plane at z = {middle:z.3f} +- {sigma:.3f} mm, walls tilted by {tilt} degrees")
    return figure


def _draw_depths(axes: Any, refinement: Refinement, depth: Floats, limits: tuple[float, float], bars: int) -> None:
    """Draw how many particles lie at each depth behind the mid plane, and the fitted profile."""
    axes.hist(depth, bins=bars, range=limits, color=style.SKY_BLUE, label="particles")
    fine = np.linspace(*limits, 1000)
    width = (limits[1] - limits[0]) / bars
    expected = refinement.walls.density(fine, refinement.depths_mm[1] - refinement.depths_mm[0]) * len(depth) * width
    axes.plot(fine, expected, color=style.VERMILION, label="fitted")
    axes.set(xlabel="depth behind the mid plane, tilt taken out (mm)", ylabel="particles", xlim=limits)
