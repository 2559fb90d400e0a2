"""The pose of a flat board from the places of its dots.

Axes: world axes, those of the raw sensor: x, y lateral, z away from the camera from the focal plane, in the medium the
board stands in. Lengths in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.spots import index_spots
from lfpiv_cli.errors import InputError

# The plane, the spacing and their errors need more than their own unknowns.
FEWEST_DOTS = 6
# A dot whose place or depth is this many robust deviations off the common board is dirt; a second look settles it.
OUTLIER_SIGMAS = 6.0
OUTLIER_ROUNDS = 3
MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True)
class BoardGeometry:
    """A flat board with a square grid of round dots.

    Attributes
    ----------
    dots : number of dots along x and y
    spacing_mm, dot_diameter_mm : of the dots
    thickness_mm : of the board, t_b of Eq. 21
    polarity : whether the dots are brighter or darker than the board
    medium : what is in front of it
    """

    dots: tuple[int, int]
    spacing_mm: float
    dot_diameter_mm: float
    thickness_mm: float = 0.0
    polarity: Literal["bright", "dark"] = "bright"
    medium: Literal["air", "fluid"] = "air"


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Where a board was seen, in world axes.

    Attributes
    ----------
    indices : (n, 2) int, which dot of the grid, from 0, growing with world x and y
    dots_mm, dots_sigma_mm : (n, 3) measured places of the dots and their standard errors
    residual_mm : (n, 3) measured less the flat regular board
    dots_px : (n, 2) where the light through the middle of the main lens shows them on the raw sensor, (column, row)
    z0_mm : depth of the board's centre
    tilt_deg : (a, b) with z = z0 + tan a (x - x0) + tan b (y - y0)
    rotation_deg : of the board's rows from x towards y
    offset_mm : (x0, y0), the board's centre
    magnification : of the main lens, from the spacing of the dots
    ..._sigma... : standard errors
    """

    indices: NDArray[np.int64]
    dots_mm: NDArray[np.float64]
    dots_sigma_mm: NDArray[np.float64]
    residual_mm: NDArray[np.float64]
    dots_px: NDArray[np.float64]
    z0_mm: float
    z0_sigma_mm: float
    tilt_deg: NDArray[np.float64]
    tilt_sigma_deg: NDArray[np.float64]
    rotation_deg: float
    rotation_sigma_deg: float
    offset_mm: NDArray[np.float64]
    offset_sigma_mm: NDArray[np.float64]
    magnification: float
    magnification_sigma: float


def pose_of_dots(
    dots_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    dots_px: NDArray[np.float64],
    magnification: float,
    board: BoardGeometry,
) -> BoardPose:
    """Fit a flat regular board to dots.

    Parameters
    ----------
    dots_mm, sigma_mm : (n, 3) places of dots, world axes, in any order, and their standard errors
    dots_px : (n, 2) the same on the sensor, carried along
    magnification : that these places were computed with

    Raises
    ------
    InputError
        when fewer than six dots lie on a common grid
    """
    kept, indices = on_the_grid(dots_mm, board)
    for _ in range(OUTLIER_ROUNDS):
        coefficients, residual, covariance = flat_fit(dots_mm[kept], indices, board)
        good = ~outliers(residual)
        if good.all():
            break
        kept, indices = kept[good], indices[good]
        refuse_few(len(kept), board)
    lengths = lengths_and_angles(coefficients, residual, covariance, magnification)
    return BoardPose(indices, dots_mm[kept], sigma_mm[kept], residual, dots_px[kept], **lengths)


def on_the_grid(dots_mm: NDArray[np.float64], board: BoardGeometry) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which dots belong to the board (m,) and their indices on it (m, 2); dots may be missing."""
    refuse_few(len(dots_mm), board)
    lateral = dots_mm[:, :2]
    start = int(np.argmin(np.hypot(*(lateral - np.median(lateral, axis=0)).T)))
    indices, reached = index_spots(lateral, start, rows_direction(lateral, start, board.spacing_mm))
    kept = np.nonzero(reached)[0]
    indices = indices[kept]
    corner = best_window(indices, lateral[kept], board)
    within = ((indices >= corner) & (indices < corner + np.array(board.dots))).all(axis=1)
    refuse_few(int(within.sum()), board)
    return kept[within], indices[within] - corner


def refuse_few(count: int, board: BoardGeometry) -> None:
    """Raise when too few dots are left."""
    if count < FEWEST_DOTS:
        raise InputError(
            f"only {count} of the board's {board.dots[0]} x {board.dots[1]} dots were found, {board.spacing_mm:g} mm "
            f"apart, at least {FEWEST_DOTS} are needed; check board.spacing_mm, the exposure and the focus"
        )


def rows_direction(lateral: NDArray[np.float64], start: int, spacing_mm: float) -> NDArray[np.float64]:
    """Return the vectors (2, 2) from a dot to its neighbours, the first one nearest world x.

    The nearest dot about one spacing away tells the direction, up to quarter turns.
    """
    offset = np.delete(lateral - lateral[start], start, axis=0)
    nearest = offset[np.argmin(np.abs(np.hypot(offset[:, 0], offset[:, 1]) - spacing_mm))]
    angle = np.arctan2(nearest[1], nearest[0])
    angle -= np.pi / 2.0 * np.rint(angle / (np.pi / 2.0))
    cosine, sine = np.cos(angle), np.sin(angle)
    return spacing_mm * np.array([[cosine, sine], [-sine, cosine]])


def best_window(indices: NDArray[np.int64], lateral: NDArray[np.float64], board: BoardGeometry) -> NDArray[np.int64]:
    """Return the first index (2,) of the window of the board's size that holds most dots; of equals, the most central.

    Central means the dots' mean index nearest the window's middle: lost rows are shared between the two sides.
    """
    size = np.array(board.dots)
    low, high = indices.min(axis=0), indices.max(axis=0)
    best, best_rank = low, (-1, 0.0)
    for i in range(min(low[0], high[0] - size[0] + 1), max(low[0], high[0] - size[0] + 1) + 1):
        for j in range(min(low[1], high[1] - size[1] + 1), max(low[1], high[1] - size[1] + 1) + 1):
            corner = np.array([i, j])
            count = int(((indices >= corner) & (indices < corner + size)).all(axis=1).sum())
            off = float(np.hypot(*(corner + (size - 1) / 2.0 - indices.mean(axis=0))))
            if (count, -off) > best_rank:
                best, best_rank = corner, (count, -off)
    return best


def flat_fit(
    dots_mm: NDArray[np.float64], indices: NDArray[np.int64], board: BoardGeometry
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return centre and step vectors (3, 3), residuals (n, 3) and the coefficients' covariance for unit errors (3, 3).

    Rows of the coefficients: the board's centre, and the change of (x, y, z) per mm along its rows and columns.
    """
    along = (indices - (np.array(board.dots) - 1) / 2.0) * board.spacing_mm
    terms = np.column_stack([np.ones(len(indices)), along])
    solution, _, rank, _ = np.linalg.lstsq(terms, dots_mm, rcond=None)
    if rank < terms.shape[1]:
        raise InputError("the board's dots that were found stand in one line; a plane needs more of the board in view")
    coefficients = np.asarray(solution, dtype=np.float64)
    covariance = np.asarray(np.linalg.inv(terms.T @ terms), dtype=np.float64)
    return coefficients, dots_mm - terms @ coefficients, covariance


def outliers(residual: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which dots (n,) are off the board sideways or in depth by far more than most."""
    distance = np.stack([np.hypot(residual[:, 0], residual[:, 1]), np.abs(residual[:, 2])], axis=1)
    limit = OUTLIER_SIGMAS * MAD_TO_SIGMA * np.median(distance, axis=0)
    return (distance > limit).any(axis=1) & (distance > 0.0).any(axis=1)


def lengths_and_angles(
    coefficients: NDArray[np.float64],
    residual: NDArray[np.float64],
    covariance: NDArray[np.float64],
    magnification: float,
) -> dict[str, Any]:
    """Return the fitted centre and step vectors as the lengths and angles of `BoardPose` with their standard errors."""
    centre, steps = coefficients[0], coefficients[1:]
    spread = np.sqrt(np.sum(residual**2, axis=0) / max(1, len(residual) - 3))
    errors = np.sqrt(np.diag(covariance))[:, np.newaxis] * spread
    slope = np.linalg.solve(steps[:, :2], steps[:, 2])
    stretch = np.sqrt(np.sum(steps**2, axis=1))
    turn = np.array([np.arctan2(steps[0, 1], steps[0, 0]), np.arctan2(-steps[1, 0], steps[1, 1])])
    step_error = float(np.mean(errors[1:, :2])) / float(np.sqrt(2.0))
    return {
        "z0_mm": float(centre[2]),
        "z0_sigma_mm": float(errors[0, 2]),
        "tilt_deg": np.rad2deg(np.arctan(slope)),
        "tilt_sigma_deg": np.rad2deg(errors[1:, 2] / (1.0 + slope**2)),
        "rotation_deg": float(np.rad2deg(turn.mean())),
        "rotation_sigma_deg": float(np.rad2deg(step_error)),
        "offset_mm": centre[:2],
        "offset_sigma_mm": errors[0, :2],
        "magnification": magnification * float(stretch.mean()),
        "magnification_sigma": abs(magnification) * step_error,
    }
