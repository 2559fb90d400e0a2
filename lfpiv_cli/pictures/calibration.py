"""Pictures of a rig: does its lattice sit on the lens images, are its views alike, what will it see?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.dlfc import RayFit
from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.views import refocused_stack, views_across
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.pictures.style import (
    AXIS_NAMES,
    BLUE,
    DIVERGING,
    GREEN,
    GREY,
    MARKERS,
    SEQUENTIAL,
    SKY_BLUE,
    VERMILION,
    new_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


COLOURS = (GREEN, VERMILION, BLUE)


@styled
def planning_figure(told: Mapping[str, Floats], bounds_mm: Floats) -> Figure:
    """Return errors over depth, and the volume within the field of view seen from above and from the side.

    Parameters
    ----------
    told : `depth_mm` (n,), `sigma_mm` (n, 3), half the fields of view `full_view_mm` and `any_view_mm` (n, 2)
    bounds_mm : (3, 2) of the volume, z from the focal point
    """
    figure = new_figure(9.5, 3.6)
    errors, *views = figure.subplots(1, 3)
    for axis, name in enumerate(AXIS_NAMES):
        errors.semilogy(
            told["depth_mm"], 1e3 * told["sigma_mm"][:, axis], color=COLOURS[axis], marker=MARKERS[axis], label=name
        )
    errors.set(xlabel="z from the focal plane (mm)", ylabel="smallest error of a tracer alone (µm)")
    errors.grid(alpha=0.3, which="both")
    errors.legend()
    for axis, axes in enumerate(views):
        _draw_view(axes, told, bounds_mm, axis)
    views[0].legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3)
    return figure


def _draw_view(axes: Axes, told: Mapping[str, Floats], bounds_mm: Floats, axis: int) -> None:
    """Draw what is in view across one axis, and the volume."""
    depth = told["depth_mm"]
    for name, label, shade in (("any_view_mm", "seen in part", 0.85), ("full_view_mm", "seen in full", 0.65)):
        half = told[name][:, axis]
        axes.fill_between(depth, -half, half, color=str(shade), label=label)
    (left, right), (low, high) = bounds_mm[2], bounds_mm[axis]
    axes.plot([left, right, right, left, left], [low, low, high, high, low], color=VERMILION, label="volume")
    axes.axvline(0.0, color=GREY, linestyle=":")
    axes.set(xlabel="z from the focal plane (mm)", ylabel=f"{AXIS_NAMES[axis]} (mm)")


# Enough views to see vignetting and a wrong lattice at the rim, few enough to see dots in each.
VIEWS_PER_SIDE = 5
# Depths of the stack, in units over which the main lens's rim moves a point by a microlens.
STEPS = (-4.0, -2.0, 0.0, 2.0, 4.0)


@styled
def views_figure(calibration: Calibration, camera: Camera, media: Media, image: ArrayLike) -> Figure:
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
    figure = new_figure(13.0, 12.5)
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


@styled
def summary_figure(calibration: Calibration) -> Figure:
    """Return what a calibration tells without its pictures: residuals, transmission, and the board or the rays."""
    figure = new_figure(11.0, 8.0)
    along_columns, along_rows, passed, board = figure.subplots(2, 2).ravel()
    for axis, direction in ((along_columns, 0), (along_rows, 1)):
        draw_residual(figure, axis, calibration.fit, direction, calibration.image_shape)
    draw_transmission(figure, passed, calibration.transmission)
    if calibration.ray_fit is None:
        draw_board(figure, board, calibration, None)
    else:
        draw_ray_fit(board, calibration.ray_fit)
    figure.suptitle(lattice_words(calibration.fit))
    return figure


def lattice_words(fit: LatticeFit) -> str:
    """Return how many lenses the lattice has, its pitch and its rotation."""
    pitch, turn = fit.lattice_px.pitch, np.rad2deg(fit.lattice_px.rotation_rad)
    return f"{fit.lenses} lenses, pitch {pitch[0]:.4f} and {pitch[1]:.4f} px, rotation {turn:z.4f} degrees"


@styled
def calibration_figure(calibration: Calibration, white: ArrayLike, board: ArrayLike | None = None) -> Figure:
    """Return a figure with the lattice on the white image (middle and two corners), the residuals, and the board.

    `white` and `board` are the raw pictures (rows, columns). Needs matplotlib.
    """
    figure = new_figure(14.0, 8.8)
    axes = figure.subplots(2, 3).ravel()
    image = np.asarray(white, dtype=np.float64)
    rows, columns = image.shape
    fit = calibration.fit
    half = 0.5 * LENSES_ACROSS * float(fit.lattice_px.pitch.max())
    zooms = {
        "middle": (columns / 2, rows / 2),
        "first corner": (half, half),
        "last corner": (columns - half, rows - half),
    }
    for axis, (name, centre) in zip(axes, zooms.items(), strict=False):
        draw_zoom(axis, image, fit, centre, half)
        axis.set_title(f"white image, {name}")
    axes[0].legend(loc="upper right", framealpha=0.9)
    for axis, direction in ((axes[3], 0), (axes[4], 1)):
        draw_residual(figure, axis, fit, direction, (rows, columns))
    if calibration.ray_fit is None:
        draw_board(figure, axes[5], calibration, board)
    else:
        draw_ray_fit(axes[5], calibration.ray_fit)
    figure.suptitle(lattice_words(fit))
    return figure


def draw_zoom(axis: Any, image: Floats, fit: LatticeFit, centre: tuple[float, float], half: float) -> None:
    """Show a part of the white image with the modelled and the measured centres in it."""
    middle = fit.lattice_px.nearest(np.array(centre))
    reach = np.arange(-int(LENSES_ACROSS), int(LENSES_ACROSS) + 1)
    model = fit.centres(middle + np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2))
    axis.imshow(image, cmap="gray", interpolation="nearest")
    axis.plot(*model.T, "+", color=VERMILION, markersize=14, zorder=3, label="lattice")
    axis.plot(*fit.centres_px.T, "o", mfc="none", color=SKY_BLUE, markersize=8, label="measured")
    axis.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] + half, centre[1] - half))
    axis.set(xlabel="column (px)", ylabel="row (px)")


def draw_residual(figure: Any, axis: Any, fit: LatticeFit, direction: int, shape: tuple[int, int]) -> None:
    """Map measured less modelled centres along the columns (0) or the rows (1)."""
    residual = (fit.centres_px - fit.centres(fit.indices))[:, direction]
    limit = max(3.0 * float(np.median(np.abs(residual))), 1e-3) if fit.lenses else 1.0
    dots = axis.scatter(*fit.centres_px.T, c=residual, s=4, cmap=DIVERGING, vmin=-limit, vmax=limit, linewidths=0)
    figure.colorbar(dots, ax=axis, label="measured less modelled (px)", shrink=0.8)
    along = ("columns", "rows")[direction]
    rms = (fit.residual_px if fit.cubic_used else fit.residual_affine_px)[direction]
    axis.set_title(f"off the lattice along the {along}: rms {rms:.3f} px")
    axis.set(xlim=(0, shape[1]), ylim=(shape[0], 0), aspect="equal", xlabel="column (px)", ylabel="row (px)")


def draw_ray_fit(axis: Any, fit: RayFit) -> None:
    """Show how far the polynomials miss the dots of each board."""
    order = np.argsort(fit.depths_mm)
    for residual, name in zip(fit.residual_mm.T, ("columns", "rows"), strict=True):
        axis.plot(fit.depths_mm[order], 1e3 * residual[order], "o-", label=f"along the {name}")
    axis.legend()
    axis.set(xlabel="depth of the board (mm)", ylabel="rms misfit on the array (µm)", ylim=(0.0, None))
    axis.set_title(f"polynomials of degree {fit.rays.degree} through {fit.sightings} sightings of dots")


def draw_transmission(figure: Any, axis: Any, transmission: NDArray[np.float32] | None) -> None:
    """Map the share of light that pixels pass; nothing where it was not measured."""
    if transmission is None:
        _draw_nothing(axis, "transmission not measured")
        return
    shown = axis.imshow(transmission, cmap=SEQUENTIAL, vmin=0.0, interpolation="nearest")
    figure.colorbar(shown, ax=axis, label="share of light passed", shrink=0.8)
    axis.set(title="transmission, upright; 0 where unusable", xlabel="column (px)", ylabel="row (px)")


def draw_board(figure: Any, axis: Any, calibration: Calibration, board: ArrayLike | None) -> None:
    """Show the dots that were found, coloured by depth, over the picture of the board where it is given."""
    pose = calibration.pose
    if pose is None:
        _draw_nothing(axis, "no board")
        return
    if board is not None:
        image = np.asarray(board, dtype=np.float64)
        axis.imshow(image, cmap="gray", vmin=np.percentile(image, 1.0), vmax=np.percentile(image, 99.9))
    dots = axis.scatter(*pose.dots_px.T, c=pose.dots_mm[:, 2], s=120, cmap=SEQUENTIAL, marker="+", linewidths=2)
    figure.colorbar(dots, ax=axis, label="depth (mm)", shrink=0.8)
    tilt = " and ".join(f"{angle:z.2f}" for angle in pose.tilt_deg)
    axis.set_title(f"board: z = {pose.z0_mm:z.3f} mm, M = {pose.magnification:.4f},\ntilt {tilt} degrees")
    rows, columns = calibration.image_shape
    axis.set(xlabel="column (px)", ylabel="row (px)", xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    axis.set_aspect("equal")


def _draw_nothing(axis: Any, why: str) -> None:
    axis.set_axis_off()
    axis.text(0.5, 0.5, why, ha="center", va="center", transform=axis.transAxes)
