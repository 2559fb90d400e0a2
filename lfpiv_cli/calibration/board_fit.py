"""The flat regular board that fits given dots best, and the radial distortion that bends it.

Axes: those of the dots: x, y lateral about the optical axis, z along it. Lengths in mm. The distortion acts on the
microlens array, r' = r (1 + k1 r^2); seen through an ideal camera it moves a dot sideways by the same share.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.robust import MAD_TO_SIGMA

if TYPE_CHECKING:
    from lfpiv_cli.calibration.board_pose import BoardGeometry

# A dot whose place or depth is this many robust deviations off the common board is dirt.
OUTLIER_SIGMAS = 6.0
# Terms of which one is this close to a sum of the others, each scaled to 1, cannot be separated.
LEAST_RANK = 1e-6
# Six numbers place the board sideways, a seventh is the distortion; with fewer dots than these it has little check.
FEWEST_DOTS_FOR_DISTORTION = 12


@dataclass(frozen=True, eq=False)
class FlatFit:
    """A flat regular board through dots.

    Attributes
    ----------
    coefficients : (3, 3) rows: the centre, and the change of (x, y, z) per mm along the board's rows and columns
    residual_mm : (n, 3) dots less the board
    sigma : (3, 3) standard errors of the coefficients
    half_span_mm : rms distance of the dots from their middle
    k1_per_mm2, k1_sigma_per_mm2 : the distortion and its standard error; None where it was left out
    """

    coefficients: NDArray[np.float64]
    residual_mm: NDArray[np.float64]
    sigma: NDArray[np.float64]
    half_span_mm: float
    k1_per_mm2: float | None = None
    k1_sigma_per_mm2: float | None = None


def bent_fit(
    dots_mm: NDArray[np.float64],
    indices: NDArray[np.int64],
    array_radius_mm: NDArray[np.float64],
    board: BoardGeometry,
) -> FlatFit:
    """Return the fit with the distortion, or without it where the dots cannot tell it from the magnification."""
    if len(indices) >= FEWEST_DOTS_FOR_DISTORTION:
        bending = dots_mm[:, :2] * array_radius_mm[:, np.newaxis] ** 2
        try:
            return flat_fit(dots_mm, indices, board, bending)
        except InputError:
            pass
    return flat_fit(dots_mm, indices, board)


def flat_fit(
    dots_mm: NDArray[np.float64],
    indices: NDArray[np.int64],
    board: BoardGeometry,
    bending: NDArray[np.float64] | None = None,
) -> FlatFit:
    """Fit a flat regular board, and the coefficient of `bending` (n, 2) in the lateral places where it is given.

    Raises
    ------
    InputError
        when the dots stand in one line, or the bending looks like a board
    """
    count = len(indices)
    along = (indices - (np.array(board.dots) - 1) / 2.0) * board.spacing_mm
    terms = np.column_stack([np.ones(count), along])
    sideways = np.asarray(np.kron(np.eye(2), terms), dtype=np.float64)
    if bending is not None:
        sideways = np.column_stack([sideways, bending.T.ravel()])
    places, place_sigma, shifts = least_squares(sideways, dots_mm[:, :2].T.ravel())
    depths, depth_sigma, rises = least_squares(terms, dots_mm[:, 2])
    return FlatFit(
        coefficients=np.column_stack([places[0:3], places[3:6], depths]),
        residual_mm=np.column_stack([shifts.reshape(2, count).T, rises]),
        sigma=np.column_stack([place_sigma[0:3], place_sigma[3:6], depth_sigma]),
        half_span_mm=float(np.sqrt(np.sum(np.var(along, axis=0)))),
        k1_per_mm2=None if bending is None else float(places[6]),
        k1_sigma_per_mm2=None if bending is None else float(place_sigma[6]),
    )


def least_squares(
    terms: NDArray[np.float64], values: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return coefficients, their standard errors by the scatter of the values, and the residuals."""
    scale = np.abs(terms).max(axis=0)
    if np.any(scale == 0.0) or np.linalg.matrix_rank(terms / scale, tol=LEAST_RANK * len(terms)) < terms.shape[1]:
        raise InputError("the board's dots that were found stand in one line; a plane needs more of the board in view")
    scaled = terms / scale
    coefficients = np.asarray(np.linalg.lstsq(scaled, values, rcond=None)[0] / scale, dtype=np.float64)
    residual = values - terms @ coefficients
    variance = float(residual @ residual) / max(1, len(values) - terms.shape[1])
    sigma = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled)) * variance) / scale
    return coefficients, sigma, residual


def outliers(residual: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which dots (n,) are off the board sideways or in depth by far more than most."""
    distance = np.stack([np.hypot(residual[:, 0], residual[:, 1]), np.abs(residual[:, 2])], axis=1)
    limit = OUTLIER_SIGMAS * MAD_TO_SIGMA * np.median(distance, axis=0)
    return (distance > limit).any(axis=1) & (distance > 0.0).any(axis=1)
