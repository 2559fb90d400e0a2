"""Velocities at scattered points with all that is known of their errors: what a field is fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

# Of the middle of two places with independent errors, whose difference is the displacement.
OF_MIDDLES = 0.25


@dataclass(frozen=True, eq=False)
class Samples:
    """Displacements at points, of tracks or of interrogation windows.

    Attributes
    ----------
    points_mm : (n, 3) where
    value_mm : (n, 3) displacement from one frame to the next
    covariance_mm2 : (n, 3, 3) of its error
    probability : (n,) that it belongs to the flow at all, as of a link
    place_share : (n,) or for all: the covariance of the points themselves, as a share; a quarter for the middle of two
        places whose difference is the displacement, 0 for windows
    """

    points_mm: NDArray[np.float64]
    value_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64]
    probability: NDArray[np.float64]
    place_share: NDArray[np.float64] | float = OF_MIDDLES

    def __len__(self) -> int:
        return len(self.points_mm)

    def subset(self, which: NDArray[np.bool_] | NDArray[np.int64]) -> Samples:
        """Return some of them."""
        return replace(
            self,
            points_mm=self.points_mm[which],
            value_mm=self.value_mm[which],
            covariance_mm2=self.covariance_mm2[which],
            probability=self.probability[which],
            place_share=self.place_share if np.ndim(self.place_share) == 0 else np.asarray(self.place_share)[which],
        )


def joined(parts: Sequence[Samples]) -> Samples:
    """Return the samples of several sources."""
    shares = [np.broadcast_to(part.place_share, len(part)) for part in parts]
    return Samples(
        np.concatenate([part.points_mm for part in parts]),
        np.concatenate([part.value_mm for part in parts]),
        np.concatenate([part.covariance_mm2 for part in parts]),
        np.concatenate([part.probability for part in parts]),
        np.concatenate(shares),
    )


def with_places(samples: Samples, gradient: NDArray[np.float64]) -> Samples:
    """Return the samples with the errors that follow from those of their places.

    `gradient` : (n, 3, 3) of the displacement, the component, then the direction
    """
    of_places = np.reshape(samples.place_share, (-1, 1, 1)) * samples.covariance_mm2
    through = np.einsum("nij,njk,nlk->nil", gradient, of_places, gradient)
    return replace(samples, covariance_mm2=samples.covariance_mm2 + through)
