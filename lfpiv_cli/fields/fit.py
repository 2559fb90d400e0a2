"""A velocity field from samples: by splines where many tell a smooth flow, by kriging elsewhere."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from lfpiv_cli.fields.kriging import is_rough, kriged_field, not_outliers
from lfpiv_cli.fields.samples import Samples
from lfpiv_cli.fields.spline_field import SplineField, lattice_for, spline_field

# The weights are told by boxes that are drawn: always the same ones.
SEED = 0
NO_POINTS = np.zeros((0, 3))
# Splines that leave more of the samples than this, over their stated errors, are too wide for the flow's small parts:
# vortices of 3 mm that 9,000 unknowns could not follow left 20 to 100, flows that they followed 0.3 to 1.6.
UNRESOLVED_CHI2 = 3.0
# Fewer samples are kriged. Of 500 in smooth flows, kriging is a fifth nearer in u and v, equal in w, and free of
# divergence, of which the splines' wide knots leave up to 4 % of the gradients; of 1,000, splines are nearer in w.
FEW_SAMPLES = 600


class Field(Protocol):
    """A velocity field that is known everywhere in a box, as displacements from one frame to the next."""

    @property
    def probability(self) -> NDArray[np.float64]:
        """The probability (n,) of each sample to belong to the field."""
        ...

    def value_at(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return displacements (m, 3), mm."""
        ...

    def estimate_at(self, points_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return displacements and their variances at once."""
        ...

    def variance_at(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variances (m, 3) of the displacements, mm^2."""
        ...

    def gradient_at(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradients (m, 3, 3) of the displacements per mm: the component, then the direction."""
        ...

    def told(self) -> dict[str, Any]:
        """Return how the field was fitted: figures with their units in their names."""
        ...


def fit_field(
    samples: Samples,
    low_mm: ArrayLike,
    high_mm: ArrayLike,
    divergence: str = "penalised",
    still_mm: NDArray[np.float64] = NO_POINTS,
) -> Field:
    """Fit a field: splines, or kriging where samples are few, or the flow is rough or too fine for splines.

    Walls, and a flow that is held free of divergence, are for splines alone.

    Parameters
    ----------
    samples : what is known of it
    low_mm, high_mm : corners (3,) of the box in which the field is asked for; it is enlarged to hold the samples
    divergence : "penalised": as far as the samples ask for; "free": there is none; "off": nothing is known of it
    still_mm : (k, 3) points of walls, where the displacement is 0
    """
    # The same bits on every machine, and boxes that are worked on at once do not take more threads than there are.
    with threadpool_limits(limits=1, user_api="blas"):
        kept = not_outliers(samples)
        inside = samples.subset(kept)
        splines_alone = divergence == "free" or len(still_mm) > 0
        if not splines_alone and (len(inside) < FEW_SAMPLES or is_rough(inside)):
            return kriged_field(samples, divergence)
        splines = _splined(inside, low_mm, high_mm, divergence, still_mm)
        if not splines_alone and splines.reduced_chi2 >= UNRESOLVED_CHI2:
            return kriged_field(samples, divergence)
        probability = np.zeros(len(samples))
        probability[kept] = splines.probability
        return replace(splines, probability=probability)


def _splined(
    samples: Samples, low_mm: ArrayLike, high_mm: ArrayLike, divergence: str, still_mm: NDArray[np.float64]
) -> SplineField:
    """Return a field of splines."""
    places = np.concatenate([samples.points_mm, still_mm, np.atleast_2d(low_mm), np.atleast_2d(high_mm)])
    lattice = lattice_for(len(samples), places.min(axis=0), places.max(axis=0))
    return spline_field(samples, lattice, divergence, np.random.default_rng(SEED), still_mm)
