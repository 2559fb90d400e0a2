"""A picture of a calibration to look at: does the lattice sit on the lens images, was the board found?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.calibration.dlfc import RayFit
from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.model import Calibration

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Zooms show six lenses across: enough to see the order, few enough to see a tenth of the pitch.
LENSES_ACROSS = 6.0


def calibration_figure(calibration: Calibration, white: ArrayLike, board: ArrayLike | None = None) -> Figure:
    """Return a figure with the lattice on the white image (middle and two corners), the residuals, and the board.

    `white` and `board` are the raw pictures (rows, columns). Needs matplotlib.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(18.0, 11.0), layout="constrained")
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
    pitch, turn = fit.lattice_px.pitch, np.rad2deg(fit.lattice_px.rotation_rad)
    figure.suptitle(f"{fit.lenses} lenses, pitch {pitch[0]:.4f} and {pitch[1]:.4f} px, rotation {turn:.4f} degrees")
    return figure


def draw_zoom(axis: Any, image: NDArray[np.float64], fit: LatticeFit, centre: tuple[float, float], half: float) -> None:
    """Show a part of the white image with the modelled and the measured centres in it."""
    middle = fit.lattice_px.nearest(np.array(centre))
    reach = np.arange(-int(LENSES_ACROSS), int(LENSES_ACROSS) + 1)
    model = fit.centres(middle + np.stack(np.meshgrid(reach, reach), axis=-1).reshape(-1, 2))
    axis.imshow(image, cmap="gray", interpolation="nearest")
    axis.plot(*model.T, "+", color="tab:red", markersize=14, zorder=3, label="lattice")
    axis.plot(*fit.centres_px.T, "o", mfc="none", color="tab:cyan", markersize=8, label="measured")
    axis.set(xlim=(centre[0] - half, centre[0] + half), ylim=(centre[1] + half, centre[1] - half))
    axis.set(xlabel="column, px", ylabel="row, px")


def draw_residual(figure: Any, axis: Any, fit: LatticeFit, direction: int, shape: tuple[int, int]) -> None:
    """Map measured less modelled centres along the columns (0) or the rows (1)."""
    residual = (fit.centres_px - fit.centres(fit.indices))[:, direction]
    limit = max(3.0 * float(np.median(np.abs(residual))), 1e-3) if fit.lenses else 1.0
    dots = axis.scatter(*fit.centres_px.T, c=residual, s=4, cmap="coolwarm", vmin=-limit, vmax=limit, linewidths=0)
    figure.colorbar(dots, ax=axis, label="px", shrink=0.8)
    along = ("columns", "rows")[direction]
    rms = (fit.residual_px if fit.cubic_used else fit.residual_affine_px)[direction]
    axis.set_title(f"off the lattice along the {along}: rms {rms:.3f} px")
    axis.set(xlim=(0, shape[1]), ylim=(shape[0], 0), aspect="equal", xlabel="column, px", ylabel="row, px")


def draw_ray_fit(axis: Any, fit: RayFit) -> None:
    """Show how far the polynomials miss the dots of each board."""
    order = np.argsort(fit.depths_mm)
    for residual, name in zip(fit.residual_mm.T, ("columns", "rows"), strict=True):
        axis.plot(fit.depths_mm[order], 1e3 * residual[order], "o-", label=f"along the {name}")
    axis.legend()
    axis.set(xlabel="depth of the board, mm", ylabel="rms misfit on the array, um", ylim=(0.0, None))
    axis.set_title(f"polynomials of degree {fit.rays.degree} through {fit.sightings} sightings of dots")


def draw_board(figure: Any, axis: Any, calibration: Calibration, board: ArrayLike | None) -> None:
    """Show the board with the dots that were found, coloured by depth."""
    pose = calibration.pose
    if board is None or pose is None:
        axis.set_axis_off()
        axis.text(0.5, 0.5, "no board", ha="center", va="center", transform=axis.transAxes)
        return
    image = np.asarray(board, dtype=np.float64)
    axis.imshow(image, cmap="gray", vmin=np.percentile(image, 1.0), vmax=np.percentile(image, 99.9))
    dots = axis.scatter(*pose.dots_px.T, c=pose.dots_mm[:, 2], s=120, cmap="viridis", marker="+", linewidths=2)
    figure.colorbar(dots, ax=axis, label="depth, mm", shrink=0.8)
    tilt = " and ".join(f"{angle:.2f}" for angle in pose.tilt_deg)
    axis.set_title(f"board: z = {pose.z0_mm:.3f} mm, M = {pose.magnification:.4f},\ntilt {tilt} degrees")
    axis.set(xlabel="column, px", ylabel="row, px")
