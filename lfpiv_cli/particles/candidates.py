"""Where particles may be: peaks of a volume that explains what the particles found so far do not.

The volume comes from expectation maximisation with these particles' light as a fixed background, in the frame of the
weights; `points_in_raw_frame` takes its peaks to the raw image's axes.

Axes: volumes [z, y, x], points (x, y, z) in mm; images [row, column].
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.reconstruction.equations import Normalisers, Problem
from lfpiv_cli.reconstruction.solvers import em_step
from lfpiv_cli.reconstruction.starts import uniform_start
from lfpiv_cli.weights.model import Weights

# Light-field volumes are sharp laterally and long in depth: a peak is the largest sum over three planes among its
# neighbours; smoothing laterally as well merges every second particle with another.
PEAK_SUM = (3, 1, 1)
PEAK_BOX = (3, 3, 3)
# A particle's light lies in about so many voxels (z, y, x) around its peak.
LIGHT_BOX = (5, 3, 3)


def explain_rest(
    weights: Weights,
    image: NDArray[np.float32],
    background: NDArray[np.float32],
    sums: Normalisers,
    iterations: int,
    progress: Callable[[int], None] | None = None,
) -> NDArray[np.float32]:
    """Return the volume E of the padded grid that with the background explains the image: W E + background = image.

    Parameters
    ----------
    image, background : (rows, columns) in the weights' frame
    sums : `normalisers` of the padded weights
    """
    operator = weights.padded
    background = np.maximum(background, 0.0)
    problem = Problem.of(operator, image, sums)
    volume = uniform_start(Problem.of(operator, image - background, sums))
    for _ in range(iterations):
        volume = em_step(problem, volume, operator.forward(volume) + background, 1.0)
        if progress:
            progress(1)
    return volume


def find_peaks(volume: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the peaks of a volume, brightest first: fractional indices (n, 3) as (x, y, z), and their light (n,)."""
    height = ndimage.uniform_filter(volume, PEAK_SUM, mode="constant")
    peak = (height == ndimage.maximum_filter(height, PEAK_BOX, mode="constant")) & (height > 0.0)
    # Running sums leave traces of bright planes in dark ones behind them: a peak must have light of its own.
    peak &= ndimage.maximum_filter(volume, PEAK_SUM, mode="constant") > 0.0
    at = np.argwhere(peak)
    light, centres = _light_and_centres(volume, at)
    order = np.lexsort((at[:, 2], at[:, 1], at[:, 0], -light))
    return centres[order, ::-1], light[order]


def _light_and_centres(
    volume: NDArray[np.float32], at: NDArray[np.int64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the light (n,) and its centre (n, 3) within the box around each index (z, y, x)."""
    half = [n // 2 for n in LIGHT_BOX]
    padded = np.pad(volume, [(h, h) for h in half])
    light = np.zeros(len(at))
    moment = np.zeros((len(at), 3))
    for offset in np.ndindex(*LIGHT_BOX):
        value = padded[tuple((at + offset).T)].astype(np.float64)
        light += value
        moment += value[:, np.newaxis] * (np.array(offset) - half)
    return light, at + moment / light[:, np.newaxis]


def points_in_raw_frame(weights: Weights, index_xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points (n, 3) in world axes, mm, of fractional indices in the padded grid."""
    points = weights.padded.grid.voxel_to_mm(index_xyz)
    if weights.calibration is None:
        return points
    return weights.calibration.rectification.to_world(points, weights.column_axis)
