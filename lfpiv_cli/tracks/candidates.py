"""Which particle of one frame may be which of the next: pairs within reach, and what their light says of them.

Axes: points (n, 3) in mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.tracks.light import Light, light_ratio


@dataclass(frozen=True, eq=False)
class Seen:
    """The particles of a frame.

    Attributes
    ----------
    position_mm : (n, 3)
    covariance_mm2 : (n, 6) of the places as xx, yy, zz, xy, yz, xz; None: not known
    light : of each; None: not known
    """

    position_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64] | None = None
    light: Light | None = None

    def __len__(self) -> int:
        """Return how many particles there are."""
        return len(self.position_mm)

    def light_value(self) -> NDArray[np.float64]:
        """Return the light of each, 1 where it is not known."""
        return np.ones(len(self)) if self.light is None else self.light.value

    def covariance(self) -> NDArray[np.float64]:
        """Return the covariances of the places, 0 where they are not known."""
        return np.zeros((len(self), 6)) if self.covariance_mm2 is None else np.nan_to_num(self.covariance_mm2)

    def sigma_mm(self) -> NDArray[np.float64]:
        """Return the standard errors (n, 3) of the places, NaN where they are not known."""
        if self.covariance_mm2 is None:
            return np.full(self.position_mm.shape, np.nan)
        return np.asarray(np.sqrt(self.covariance_mm2[:, :3]))


@dataclass(frozen=True, eq=False)
class Candidates:
    """Pairs of particles that may be one, in the order of the first frame's.

    Attributes
    ----------
    first, second : (c,) numbers of the particles in the two frames
    displacement_mm : (c, 3)
    light_ratio : (c,) how much more likely their light is if they are one than if they are any two
    """

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    displacement_mm: NDArray[np.float64]
    light_ratio: NDArray[np.float64]

    def part(self, chosen: NDArray[np.bool_]) -> Candidates:
        """Return some of the pairs."""
        return Candidates(
            self.first[chosen], self.second[chosen], self.displacement_mm[chosen], self.light_ratio[chosen]
        )


def candidates_of(
    first: Seen, second: Seen, middle_mm: NDArray[np.float64], reach_mm: NDArray[np.float64]
) -> Candidates:
    """Return the pairs whose displacement is within `reach_mm` (n,) along each axis of `middle_mm` (n, 3)."""
    at = first.position_mm + middle_mm
    near = KDTree(second.position_mm).query_ball_point(at, reach_mm, p=np.inf, return_sorted=True)
    owner = np.repeat(np.arange(len(first)), [len(each) for each in near])
    target = np.array([k for each in near for k in each], dtype=np.int64)
    displacement = second.position_mm[target] - first.position_mm[owner]
    return Candidates(owner, target, displacement, light_ratio(first.light, second.light, owner, target))
