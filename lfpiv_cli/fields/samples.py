"""Velocities at scattered points with all that is known of their errors: what a field is fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats

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

    points_mm: Floats
    value_mm: Floats
    covariance_mm2: Floats
    probability: Floats
    place_share: Floats | float = OF_MIDDLES

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


def with_places(samples: Samples, gradient: Floats) -> Samples:
    """Return the samples with the errors that follow from those of their places.

    `gradient` : (n, 3, 3) of the displacement, the component, then the direction
    """
    of_places = np.reshape(samples.place_share, (-1, 1, 1)) * samples.covariance_mm2
    through = np.einsum("nij,njk,nlk->nil", gradient, of_places, gradient)
    return replace(samples, covariance_mm2=samples.covariance_mm2 + through)


# How far samples lie off a field, and with which probability each belongs to it.


# Stated probabilities are not believed beyond these: a wrong link may look like a sure one, a doubtful one be right.
LEAST_PROBABLE, MOST_PROBABLE = 0.3, 0.98


def error_covariance(samples: Samples, scale: float, unresolved_mm: float) -> Floats:
    """Return the covariances (n, 3, 3) of samples about a field that leaves something unresolved."""
    return np.asarray(scale**2 * samples.covariance_mm2 + unresolved_mm**2 * np.eye(samples.value_mm.shape[1]))


def squares(error_mm: Floats, covariance: Floats) -> Floats:
    """Return the squared Mahalanobis distances (n,) of errors (n, 3) by their covariances (n, 3, 3)."""
    return np.asarray(np.einsum("ni,nij,nj->n", error_mm, np.linalg.inv(covariance), error_mm))


def without_itself(error_mm: Floats, field: Floats, weight: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """Return how far each sample lies off the field that the others alone make, and the covariance of that.

    Parameters
    ----------
    error_mm : (n, 3) off the field of all
    field : (n, 3, 3) covariance of the field of all at the samples
    weight : (n, 3, 3) with which each has taken part
    covariance : (n, 3, 3) of the sample's own error
    """
    left = np.eye(error_mm.shape[1]) - np.einsum("nij,njk->nik", field, weight)
    alone = np.linalg.solve(left, np.concatenate([error_mm[..., np.newaxis], field], axis=2))
    of_field = 0.5 * (alone[..., 1:] + alone[..., 1:].swapaxes(1, 2))
    return alone[..., 0], covariance + of_field


def belonging(samples: Samples, error_mm: Floats, covariance: Floats, spread_mm: float) -> Floats:
    """Return the probability (n,) of each sample to belong to the field, by Bayes' rule.

    One that does not belong may be anything that displacements are: Gaussian of their spread about the field.
    """
    prior = np.clip(samples.probability, LEAST_PROBABLE, MOST_PROBABLE)
    size = error_mm.shape[1]
    near = squares(error_mm, covariance) + np.linalg.slogdet(covariance)[1]
    wide = covariance + spread_mm**2 * np.eye(size)
    far = squares(error_mm, wide) + np.linalg.slogdet(wide)[1]
    odds = np.log(prior) - np.log1p(-prior) + 0.5 * (far - near)
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(odds, -500.0, 500.0))))
