"""Where the entrance pupil lies, by how a board shrinks on the array as it moves away.

A board at a distance s before the entrance pupil is shown beta = L / s times as large (see `optics.pupils`): 1/beta
grows by 1/L for each millimetre in air. At the focal plane, where its pictures through all points of the pupil
coincide, beta is -M, and the distance of that plane is L / |M| = F_m (1/P - 1/M). One board alone cannot tell it; of
several, the scale of the crossings does not matter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Two make a line whatever they are.
FEWEST_BOARDS = 3
# What all dots of a board have in common does not show in their scatter: rendered ones were shown up to this share too
# large or too small.
COMMON_SHARE = 1e-4


@dataclass(frozen=True)
class Shown:
    """How a board is shown on the array.

    Attributes
    ----------
    z_mm : its depth, from any origin
    alpha : by how much its picture moves per length between crossings of the main lens
    beta, beta_sigma : how large it is shown, and the standard error
    """

    z_mm: float
    alpha: float
    beta: float
    beta_sigma: float


def shown(
    z_mm: float,
    plate_mm: NDArray[np.float64],
    dot: NDArray[np.int64],
    crossing_mm: NDArray[np.float64],
    array_mm: NDArray[np.float64],
) -> Shown:
    """Fit x_m = alpha X - beta x to what was seen of a board, turned and placed as it is.

    Parameters
    ----------
    plate_mm : (dots, 2) of the dots on the board
    dot, crossing_mm, array_mm : (n,), (n, 2), (n, 2) of sightings: which dot, through where, and its picture's place
    """
    x, y = plate_mm[dot].T
    zero, one = np.zeros(len(dot)), np.ones(len(dot))
    terms = np.concatenate(
        [
            np.column_stack([crossing_mm[:, 0], -x, y, one, zero]),
            np.column_stack([crossing_mm[:, 1], -y, -x, zero, one]),
        ]
    )
    values = array_mm.T.ravel()
    found = np.linalg.lstsq(terms, values, rcond=None)[0]
    off = (values - terms @ found).reshape(2, -1)
    # Sightings of a dot err together, by its phase against the microlenses.
    count = np.bincount(dot, minlength=len(plate_mm))
    seen = count > 0
    mean = np.array([np.bincount(dot, each, minlength=len(plate_mm)) for each in off])[:, seen] / count[seen]
    spread = plate_mm[seen] - plate_mm[seen].mean(axis=0)
    sigma = np.sqrt(np.sum(mean**2) / max(mean.size - 4, 1) / np.sum(spread**2))
    beta = float(np.hypot(found[1], found[2]))
    return Shown(z_mm, float(found[0]), beta, float(np.hypot(sigma, COMMON_SHARE * beta)))


def entrance_pupil_mm(boards: Sequence[Shown], depth_ratio: float) -> tuple[float, float] | None:
    """Return how far the entrance pupil lies from the focal plane, in air, and the standard error.

    None where the boards do not tell it: fewer than three, or none that is shown the larger the nearer it is.

    Parameters
    ----------
    boards : at different depths
    depth_ratio : apparent depth in air of a unit of the boards' depths
    """
    if len(boards) < FEWEST_BOARDS:
        return None
    z, alpha, beta, sigma = np.array([(each.z_mm, each.alpha, each.beta, each.beta_sigma) for each in boards]).T
    weight = (beta**2 / sigma) ** 2  # of 1/beta
    from_mean = z - np.average(z, weights=weight)
    spread = np.sum(weight * from_mean**2)
    per_mm = np.sum(weight * from_mean / beta) / spread
    spreading, unfocused = np.polyfit(beta, alpha, 1)
    if per_mm <= 0.0 or spreading <= 0.0 or unfocused >= 0.0:
        return None
    distance = depth_ratio / per_mm * spreading / -unfocused
    relative = np.hypot(1.0 / np.sqrt(spread) / per_mm, 1.0 / np.sqrt(np.sum((beta / sigma) ** 2)))
    return float(distance), float(distance * relative)
