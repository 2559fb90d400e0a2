"""How far samples lie off a field, and with which probability each belongs to it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.fields.samples import Samples

# Stated probabilities are not believed beyond these: a wrong link may look like a sure one, a doubtful one be right.
LEAST_PROBABLE, MOST_PROBABLE = 0.3, 0.98


def error_covariance(samples: Samples, scale: float, unresolved_mm: float) -> NDArray[np.float64]:
    """Return the covariances (n, 3, 3) of samples about a field that leaves something unresolved."""
    return np.asarray(scale**2 * samples.covariance_mm2 + unresolved_mm**2 * np.eye(samples.value_mm.shape[1]))


def squares(error_mm: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squared Mahalanobis distances (n,) of errors (n, 3) by their covariances (n, 3, 3)."""
    return np.asarray(np.einsum("ni,nij,nj->n", error_mm, np.linalg.inv(covariance), error_mm))


def without_itself(
    error_mm: NDArray[np.float64],
    field: NDArray[np.float64],
    weight: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def belonging(
    samples: Samples, error_mm: NDArray[np.float64], covariance: NDArray[np.float64], spread_mm: float
) -> NDArray[np.float64]:
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
