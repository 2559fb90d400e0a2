"""The filter between passes, and what it says of the scales that a field does not resolve.

Fields are (nz, ny, nx, 3) without NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d


def smooth_field(displacement: NDArray[np.float64], is_elongated: bool = False) -> NDArray[np.float64]:
    """Return 2 F d - F F d of a field d, F being a (1/4, 1/2, 1/4) filter along x, y and z; F d for long particles.

    Noise from one window to the next vanishes, as with F alone, but what F takes from a curved flow is given back to
    the second order. Measured on known volumes, it leaves two thirds of the error of F at 0.7 of its strength in clean
    ones, and less noise in noisy ones. Particle images that are elongated are located so much less well that F alone
    is better.
    """
    once = _filter(displacement)
    return once if is_elongated else 2.0 * once - _filter(once)


def unresolved(displacement: NDArray[np.float64], is_elongated: bool = False) -> NDArray[np.float64]:
    """Return how large the part of a field is that `smooth_field` takes away: its rms over a vector and its neighbours.

    It measures what a window's own equations cannot know: the curvature within a window that the predictor missed, and
    the noise of the neighbours that deformed it. Shape (nz, ny, nx, 3).
    """
    mean = (displacement - smooth_field(displacement, is_elongated)) ** 2
    for axis in range(3):
        mean = correlate1d(mean, np.full(3, 1.0 / 3.0), axis=axis, mode="nearest")
    return np.sqrt(mean)


def _filter(displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a field after a (1/4, 1/2, 1/4) filter along x, y and z.

    The first and the last value of a line become those of the straight line fitted to the outer three: linear flows
    pass unchanged, and noise at the ends does not.
    """
    filtered = displacement
    for axis in range(3):
        if filtered.shape[axis] > 2:
            moved = np.moveaxis(filtered, axis, 0)
            line = np.empty_like(moved)
            line[1:-1] = 0.25 * moved[:-2] + 0.5 * moved[1:-1] + 0.25 * moved[2:]
            line[0] = (5.0 * moved[0] + 2.0 * moved[1] - moved[2]) / 6.0
            line[-1] = (5.0 * moved[-1] + 2.0 * moved[-2] - moved[-3]) / 6.0
            filtered = np.moveaxis(line, 0, axis)
    return filtered
