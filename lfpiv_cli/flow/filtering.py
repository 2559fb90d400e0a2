"""The filter between passes, and what it says of the scales that a field does not resolve.

Fields are (nz, ny, nx, 3) without NaN.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from lfpiv_cli.flow.windows import Triple

# The end of a straight line fitted to the outer three values. Linear flows pass unchanged, and noise does not.
LINE_END = np.array([5.0, 2.0, -1.0]) / 6.0
# Six tenths of the end of a parabola fitted to the outer four, the rest of that line: it keeps most of the curvature of
# a flow along a wall. The parabola alone lets more noise through, and where particle images are long even this does.
CURVED_END = 0.6 * np.array([19.0, 3.0, -3.0, 1.0]) / 20.0 + 0.4 * np.append(LINE_END, 0.0)
# Standard deviation of what cubic B-splines leave with the true predictor, .001 voxel where nothing moves to .003 where
# particles of 1 voxel move by 4.
INTERPOLATION_VOXEL = 0.002
# Windows nearer than the particles are long would tell the bend of the flow by differences of their noise.
LARGEST_MIXING = 0.25


def smooth_field(displacement: NDArray[np.float64], is_elongated: bool = False) -> NDArray[np.float64]:
    """Return a field d without what differs from one window to the next; F d for long particles.

    F is a (1/4, 1/2, 1/4) filter along x, y and z; for short particles the result is 2 F d - F F d. Noise from one
    window to the next vanishes, as with F alone, but what F takes from a curved flow is given back to the second order.
    Measured on known volumes, it leaves half of the error of F at 0.7 of its strength in clean ones, and less noise in
    noisy ones. Particle images that are elongated are located so much less well that F alone is better.
    """
    if is_elongated:
        return _filter(displacement, LINE_END)
    once = _filter(displacement, CURVED_END)
    return 2.0 * once - _filter(once, CURVED_END)


def unresolved(displacement: NDArray[np.float64], is_elongated: bool = False) -> NDArray[np.float64]:
    """Return what a window's own equations cannot know of its error: standard deviations (nz, ny, nx, 3) in voxels.

    The curvature within a window that the predictor missed, and the noise of the neighbours that deformed it, are as
    large as the part of a field that `smooth_field` takes away: its rms over a vector and its neighbours. And whatever
    the particles, splines err by `INTERPOLATION_VOXEL`.
    """
    mean = (displacement - smooth_field(displacement, is_elongated)) ** 2
    for axis in range(3):
        mean = correlate1d(mean, np.full(3, 1.0 / 3.0), axis=axis, mode="nearest")
    return np.sqrt(mean + INTERPOLATION_VOXEL**2)


def mixing(displacement: NDArray[np.float64], sigma_voxel: NDArray[np.float64], step: Triple) -> NDArray[np.float64]:
    """Return by how much long particles change the flow that a correlation sees, (nz, ny, nx, 3) in voxels.

    A particle image moves as a whole, by the flow d at its centre; a voxel away from that sees it all the same. In the
    product of two Gaussian images of standard deviation s the distances have s / sqrt(2), and the mean of d over these
    is d + s^2 / 4 d'' to the second order, along the image's length. Nothing at the ends, where particles may lie on
    one side only.

    Parameters
    ----------
    displacement : (nz, ny, nx, 3) without NaN
    sigma_voxel : (3,) standard deviation of a particle image along x, y, z; 0 where it is short
    step : distance of the windows along x, y, z, voxels
    """
    smooth = _filter(displacement, LINE_END)
    change = np.zeros(displacement.shape)
    for axis, sigma, distance in zip((2, 1, 0), sigma_voxel, step, strict=True):
        share = min(0.25 * (sigma / distance) ** 2, LARGEST_MIXING)
        if share > 0.0 and displacement.shape[axis] > 2:
            bend = correlate1d(smooth, (1.0, -2.0, 1.0), axis=axis)
            moved = np.moveaxis(bend, axis, 0)
            moved[0] = moved[-1] = 0.0
            change += share * bend
    return change


def _filter(displacement: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a field after a (1/4, 1/2, 1/4) filter along x, y and z.

    The first and the last value of a line become those that `end` makes of the outer ones; of the straight line where
    there are too few.
    """
    filtered = displacement
    for axis in range(3):
        if filtered.shape[axis] >= LINE_END.size:
            moved = np.moveaxis(filtered, axis, 0)
            weights = end if moved.shape[0] >= end.size else LINE_END
            line = np.empty_like(moved)
            line[1:-1] = 0.25 * moved[:-2] + 0.5 * moved[1:-1] + 0.25 * moved[2:]
            line[0] = sum(weight * value for weight, value in zip(weights, moved[: weights.size], strict=True))
            line[-1] = sum(
                weight * value for weight, value in zip(weights, moved[: -weights.size - 1 : -1], strict=True)
            )
            filtered = np.moveaxis(line, 0, axis)
    return filtered
