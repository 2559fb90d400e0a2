"""Where particles may be: peaks of a volume that explains what the particles found so far do not.

The volume comes from expectation maximisation with these particles' light as a fixed background, in the frame of the
weights; `points_in_raw_frame` takes its peaks to the raw image's axes.

Axes: volumes [z, y, x], points (x, y, z) in mm; images [row, column].
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.reconstruction.equations import Normalisers, Problem
from lfpiv_cli.reconstruction.solvers import em_step
from lfpiv_cli.reconstruction.starts import uniform_start
from lfpiv_cli.scale import Scale
from lfpiv_cli.weights.model import Weights

# Light-field volumes are sharp laterally and long in depth: a peak is the largest sum over a few planes among its
# neighbours; smoothing laterally as well merges every second particle with another. Lengths are from the middle of a
# box to its outermost voxels, laterally in microlenses as the scene shows them, in depth in depths over which light
# spreads by one lens (Table 2: 0.1 and 0.2 mm), and a voxel at least; light, which iterations spread in depth, two.
SUM_DEPTHS = 0.1 / 1.064
PEAK_LENSES, PEAK_DEPTHS = 1.0, 0.1 / 1.064
# A particle's light lies about so far around its peak.
LIGHT_LENSES, LIGHT_DEPTHS = 1.0, 0.2 / 1.064


class Boxes(NamedTuple):
    """Voxels (z, y, x): of a peak's height, those among which it is the highest, and those that hold its light."""

    sum: tuple[int, int, int]
    peak: tuple[int, int, int]
    light: tuple[int, int, int]


def boxes_of(scale: Scale, spacing_mm: tuple[float, float, float]) -> Boxes:
    """Return the boxes for voxels of this size (x, y, z)."""

    def box(lenses: float, depths: float, least_planes: int) -> tuple[int, int, int]:
        x, y, z = np.rint(scale.box_mm(lenses, depths) / spacing_mm).astype(int)
        return 2 * max(z, least_planes) + 1, 2 * max(y, 1) + 1, 2 * max(x, 1) + 1

    tall = box(PEAK_LENSES, SUM_DEPTHS, 1)[0]
    return Boxes((tall, 1, 1), box(PEAK_LENSES, PEAK_DEPTHS, 1), box(LIGHT_LENSES, LIGHT_DEPTHS, 2))


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


def find_peaks(volume: NDArray[np.float32], boxes: Boxes) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the peaks of a volume, brightest first: fractional indices (n, 3) as (x, y, z), and their light (n,)."""
    height = ndimage.uniform_filter(volume, boxes.sum, mode="constant")
    peak = (height == ndimage.maximum_filter(height, boxes.peak, mode="constant")) & (height > 0.0)
    # Running sums leave traces of bright planes in dark ones behind them: a peak must have light of its own.
    peak &= ndimage.maximum_filter(volume, boxes.sum, mode="constant") > 0.0
    at = np.argwhere(peak)
    light, centres = _light_and_centres(volume, at, boxes.light)
    order = np.lexsort((at[:, 2], at[:, 1], at[:, 0], -light))
    return centres[order, ::-1], light[order]


def _light_and_centres(
    volume: NDArray[np.float32], at: NDArray[np.int64], box: tuple[int, int, int]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the light (n,) and its centre (n, 3) within the box around each index (z, y, x)."""
    half = [n // 2 for n in box]
    padded = np.pad(volume, [(h, h) for h in half])
    light = np.zeros(len(at))
    moment = np.zeros((len(at), 3))
    for offset in np.ndindex(*box):
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
