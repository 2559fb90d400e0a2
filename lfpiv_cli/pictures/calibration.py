"""A picture of a calibration to look at: does the lattice sit on the lens images, was the board found?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.calibration.dlfc import RayFit
from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.pictures.style import DIVERGING, SEQUENTIAL, SKY_BLUE, VERMILION, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def draw_zoom(axis: Any, image: NDArray[np.float64], fit: LatticeFit, centre: tuple[float, float], half: float) -> None:
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
