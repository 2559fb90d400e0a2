"""Where particles lie behind faces that are not where they were thought to be.

What an image shows of a particle are its rays over the main lens; along image axis k their slopes are a straight line,
(X_k - place_k) / distance_k, and a small rest (see `particles.pencil`). Behind other faces the same rays belong to
another place: the one whose lines are closest to those of the first over the aperture's disc. As behind a pipe both
distances differ and a place has only one depth, something is left where the faces are wrong.

Axes: image axes, z away from the camera from the nominal focal point, mm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.particles.pencil import MEAN_SQUARE, lines_of

# Gauss-Newton's iteration: faces that are shifted by 0.2 mm leave 1e-9 mm after four.
STEPS = 5


def moved_places(
    points_mm: NDArray[np.float64], before: Faces, after: Faces, radius_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return where particles lie behind other faces, their rays being the same.

    Parameters
    ----------
    points_mm : (n, 3) behind the faces as they were
    radius_mm : of the main lens

    Returns
    -------
    Places (n, 3), and (n,) whether there are any; those that have none stay.
    """
    shown, _, seen = _lines(points_mm, before, radius_mm)
    places = points_mm.copy()
    for _ in range(STEPS):
        lines, moves, there = _lines(places, after, radius_mm)
        seen &= there
        places[seen] += _solved(moves[seen], (shown - lines)[seen])
    return np.where(seen[:, np.newaxis], places, points_mm), seen


def place_changes(
    points_mm: NDArray[np.float64], ahead: Faces, behind: Faces, here: Faces, radius_mm: float
) -> NDArray[np.float64]:
    """Return how far (n, 3) places move, their rays being the same, from faces `behind` to `ahead`; first order."""
    _, moves, seen = _lines(points_mm, here, radius_mm)
    first, _, seen_ahead = _lines(points_mm, ahead, radius_mm)
    second, _, seen_behind = _lines(points_mm, behind, radius_mm)
    seen &= seen_ahead & seen_behind
    changes = np.zeros_like(points_mm)
    changes[seen] = _solved(moves[seen], (second - first)[seen])
    return changes


def _solved(moves: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the steps (n, 3) that change lines (n, 4) by what is wanted, as nearly as they can."""
    turned = np.swapaxes(moves, 1, 2)
    return np.asarray(np.linalg.solve(turned @ moves, turned @ wanted[:, :, np.newaxis])[..., 0])


def _lines(
    points_mm: NDArray[np.float64], faces: Faces, radius_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return the straight lines of the slopes of points (n, 4), their derivatives (n, 4, 3), and which are seen.

    The lines are slopes in the lens's middle, and by how much these grow to the root of the mean square over its disc.
    """
    lines, moves, _ = lines_of(faces, radius_mm, np.ascontiguousarray(points_mm))
    seen = np.all(lines[:, :, 1] > 0.0, axis=1)
    place, distance = lines[:, :, 0], np.where(seen[:, np.newaxis], lines[:, :, 1], 1.0)
    reach = radius_mm * np.sqrt(MEAN_SQUARE)
    further = moves[:, :, 1] / distance[..., np.newaxis] ** 2
    middle_moves = place[..., np.newaxis] * further - moves[:, :, 0] / distance[..., np.newaxis]
    shown = np.concatenate([-place / distance, reach / distance], axis=1)
    return shown, np.concatenate([middle_moves, -reach * further], axis=1), seen
