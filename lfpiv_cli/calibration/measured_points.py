"""The points of a calibration target as they were measured one by one.

Axes: image axes (x along the columns, y along the rows), mm, z away from the camera in the medium of the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.shape_fit import ShapeFit


@dataclass(frozen=True, eq=False)
class MeasuredPoints:
    """Points of a target.

    Attributes
    ----------
    places_mm, sigmas_mm : (n, 3) and their standard errors
    numbers : (n, 2) which point of the target each is, the target turned in any way; None where the grid tells
    """

    places_mm: NDArray[np.float64]
    sigmas_mm: NDArray[np.float64]
    numbers: NDArray[np.int64] | None = None


def measured_points(fits: Sequence[ShapeFit | None], numbers: NDArray[np.int64] | None = None) -> MeasuredPoints:
    """Return the points of the fits that came to an end."""
    kept = [k for k, fit in enumerate(fits) if fit is not None and fit.converged]
    good = [fit for fit in fits if fit is not None and fit.converged]
    places = np.array([fit.position_mm for fit in good]).reshape(-1, 3)
    sigmas = np.sqrt(np.array([np.diag(fit.covariance_mm2) for fit in good])).reshape(-1, 3)
    return MeasuredPoints(places, sigmas, None if numbers is None else numbers[kept])
