"""Bright spots in an image: where they are, to a hundredth of a pixel, and which lattice point each one is.

Axes: positions are (column, row) in pixels, pixel centres at integers.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from lfpiv_cli.neighbourhoods import largest_around, smallest_around

# Smoothing by a sixth of the pitch leaves one maximum per lens image and does not merge neighbours.
SMOOTHING_PER_PITCH = 1.0 / 6.0
# Two maxima closer than this share of the pitch belong to one spot.
SEPARATION_PER_PITCH = 0.6
# A spot must stand out of its surroundings by this share of the typical spot: vignetted lens images count, noise not.
CONTRAST_SHARE = 0.15
# Between these shares of a spot's height above its surroundings a pixel's weight rises from 0 to 1: below lies the
# noise of the gaps, above it speckle, dust and saturation, which say nothing about where the spot's rim is.
CLIP_LOW = 0.25
CLIP_HIGH = 0.75
# Clipping an image as sharp as its pixels makes centroids beat with the pixels by 0.05 px; this smoothing halves
# it, and does not yet mix neighbouring lens images.
CENTROID_SMOOTHING_PX = 0.8
# The window follows the centroid. Each round at least halves the rest, so this reaches 1e-4 px from half a pixel.
CENTROID_ROUNDS = 30
CENTROID_TOLERANCE_PX = 1e-4
# A neighbour is taken when it lies within this share of the pitch from where the last steps predict it.
WALK_TOLERANCE = 0.25
# Share of a new step in the running prediction of the next one: follows distortion, damps the noise of one spot.
WALK_GAIN = 0.25


def find_spots(image: NDArray[np.float64], pitch_px: float) -> NDArray[np.float64]:
    """Return the centres (n, 2) of the bright spots that lie wholly inside the image, in no particular order."""
    smooth = ndimage.gaussian_filter(image, SMOOTHING_PER_PITCH * pitch_px, mode="nearest")
    size = max(3, int(np.rint(SEPARATION_PER_PITCH * pitch_px)))
    row, column = np.nonzero(smooth == largest_around(smooth, size))
    base = smallest_around(smooth, int(np.ceil(pitch_px)))[row, column]
    height = smooth[row, column] - base
    if not (height > 0.0).any():
        return np.zeros((0, 2))
    strong = height > CONTRAST_SHARE * np.percentile(height[height > 0.0], 90.0)
    start = np.stack([column, row], axis=1)[strong].astype(np.float64)
    softened = ndimage.gaussian_filter(image, CENTROID_SMOOTHING_PX, mode="nearest")
    centres, good = spot_centroids(softened, start, base[strong], height[strong], 0.5 * pitch_px)
    return centres[good]


@njit(cache=True)
def spot_centroids(
    image: NDArray[np.float64],
    start: NDArray[np.float64],
    base: NDArray[np.float64],
    height: NDArray[np.float64],
    radius_px: float,
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return clipped centroids (n, 2) in a disc that follows them, and whether each converged inside the image."""
    rows, columns = image.shape
    centres = start.copy()
    good = np.zeros(start.shape[0], dtype=np.bool_)
    for k in range(start.shape[0]):
        low = base[k] + CLIP_LOW * height[k]
        span = (CLIP_HIGH - CLIP_LOW) * height[k]
        x, y = start[k, 0], start[k, 1]
        for _ in range(CENTROID_ROUNDS):
            if x < radius_px - 0.5 or y < radius_px - 0.5:
                break
            if x > columns - 0.5 - radius_px or y > rows - 0.5 - radius_px:
                break
            total = 0.0
            sum_x = 0.0
            sum_y = 0.0
            for row in range(max(0, int(y - radius_px)), min(rows, int(y + radius_px) + 2)):
                for column in range(max(0, int(x - radius_px)), min(columns, int(x + radius_px) + 2)):
                    distance = np.sqrt((column - x) ** 2 + (row - y) ** 2)
                    window = min(1.0, max(0.0, radius_px + 0.5 - distance))
                    weight = window * min(1.0, max(0.0, (image[row, column] - low) / span))
                    total += weight
                    sum_x += weight * column
                    sum_y += weight * row
            if total == 0.0:
                break
            moved = abs(sum_x / total - x) + abs(sum_y / total - y)
            x, y = sum_x / total, sum_y / total
            if moved < CENTROID_TOLERANCE_PX:
                good[k] = True
                break
        centres[k, 0], centres[k, 1] = x, y
    return centres, good


def index_spots(
    points: NDArray[np.float64], start: int, basis: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Number the points by walking outward over a lattice whose vectors may change slowly on the way.

    Parameters
    ----------
    points : (n, 2)
    start : which point is lattice point (0, 0)
    basis : (2, 2) lattice vectors there, as rows

    Returns
    -------
    indices : (n, 2) lattice indices, meaningless where not reached
    reached : (n,) the walk came to this point, and first to it among those of the same index
    """
    tree = cKDTree(points)
    tolerance = WALK_TOLERANCE * float(np.min(np.hypot(basis[:, 0], basis[:, 1])))
    indices = np.zeros((len(points), 2), dtype=np.int64)
    local = np.broadcast_to(basis, (len(points), 2, 2)).copy()
    reached = np.zeros(len(points), dtype=bool)
    reached[start] = True
    front = np.array([start])
    while front.size:
        arrived = []
        for axis in (0, 1):
            for sign in (1, -1):
                distance, neighbour = tree.query(points[front] + sign * local[front, axis])
                fresh = (distance < tolerance) & ~reached[neighbour]
                neighbour, first = np.unique(neighbour[fresh], return_index=True)
                origin = front[fresh][first]
                observed = sign * (points[neighbour] - points[origin])
                indices[neighbour] = indices[origin]
                indices[neighbour, axis] += sign
                local[neighbour] = local[origin]
                local[neighbour, axis] += WALK_GAIN * (observed - local[origin, axis])
                reached[neighbour] = True
                arrived.append(neighbour)
        front = np.concatenate(arrived)
    return indices, reached & first_of_each(indices, reached)


def first_of_each(indices: NDArray[np.int64], chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the mask (n,) of the first chosen point of each index."""
    where = np.nonzero(chosen)[0]
    _, first = np.unique(indices[where], axis=0, return_index=True)
    mask = np.zeros(len(indices), dtype=bool)
    mask[where[first]] = True
    return mask
