"""A velocity field kriged from samples as vectors: the best linear unbiased estimate where the flow is rough.

In turbulence the velocity differs between neighbouring tracks by more than a spline on any affordable lattice follows.
How much it differs, and that what differs is free of divergence, the tracks themselves tell: the structure function
under which they are likeliest. The estimate at a place is the best combination of the nearest samples, all components
of all of them together, by their full covariances: what is known of u and v tells of w.

Samples further off what the others let expect than they should be are outliers; wrong links are.

Axes: points (m, 3) and displacements in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import gammaincinv

from lfpiv_cli.fields.likelihood import (
    FEW_NEIGHBOURHOODS,
    NEIGHBOURHOODS,
    POTENTIAL_SHARES,
    likeliest_structure,
    spacing_of,
)
from lfpiv_cli.fields.neighbourhood_equations import (
    Estimates,
    estimated,
    estimated_slopes,
    unknown_variance,
)
from lfpiv_cli.fields.samples import Samples
from lfpiv_cli.fields.structure import INDEPENDENT, VectorStructure
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.tracks.gridding import FEWEST_OF_STRUCTURE, ROUGH_EXPONENT

# Samples that an estimate is made of, and those that show whether one of them is an outlier. With twice as many the
# errors are 1 to 6 % smaller, and it takes four times as long.
USED, USED_FOR_OUTLIERS = 60, 12
# What is worked on at a time bounds the memory to some 100 MB.
PLACES_AT_ONCE = 100
# Rounds in which samples that the outliers left alone come back.
OUTLIER_ROUNDS = 2
# However certain a link is said to be: one in a hundred is wrong.
LARGEST_PROBABILITY = 0.99
# Neighbours in all directions are so many times as far away as the nearest one.
SPACINGS_APART = 2.0
# Samples around a place that show how large errors are there.
AROUND = 40
# The median of chi-squared of three degrees of freedom.
CHI_SQUARED_MEDIAN = 2.0 * float(gammaincinv(1.5, 0.5))
# The shares of potential flow to choose from.
SHARES = {"free": (0.0,), "penalised": POTENTIAL_SHARES, "off": (INDEPENDENT,)}


@dataclass(frozen=True, eq=False)
class KrigedField:
    """A velocity field that is kriged from samples.

    Attributes
    ----------
    samples : those that are no outliers
    structure : of the flow
    off_by : (n, 3) how far each sample is off what the others let expect, in its expected standard deviations
    kept : (n,) which of all samples these are
    """

    samples: Samples
    structure: VectorStructure
    off_by: NDArray[np.float64]
    kept: NDArray[np.bool_]

    @property
    def probability(self) -> NDArray[np.float64]:
        """The probability (n,) of each sample to belong to the field: 1, or 0 of outliers."""
        return self.kept.astype(np.float64)

    def value_at(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return displacements (m, 3) in mm."""
        return self.estimates_at(points_mm).value_mm

    def variance_at(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the variances (m, 3) in mm^2 of what the displacements are off by."""
        return np.asarray(np.einsum("mii->mi", self.estimates_at(points_mm).covariance_mm2))

    def estimates_at(self, points_mm: NDArray[np.float64]) -> Estimates:
        """Return displacements and their covariances at once, in the time that either takes."""
        unknown = unknown_variance(self.samples)
        parts = [
            estimated(points_mm[part], near, self.samples, self.structure, unknown)
            for part, near in _nearest(self.samples.points_mm, points_mm, USED)
        ]
        covariance = np.concatenate([part.covariance_mm2 for part in parts])
        factor = self._error_factor(points_mm)
        scaled = covariance * factor[:, :, np.newaxis] * factor[:, np.newaxis]
        return Estimates(np.concatenate([part.value_mm for part in parts]), scaled)

    def estimate_at(self, points_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return displacements and their variances (m, 3)."""
        found = self.estimates_at(points_mm)
        return found.value_mm, np.asarray(np.einsum("mii->mi", found.covariance_mm2))

    def gradient_at(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient (m, 3, 3) per mm [component, direction], each of its nearest samples held fixed."""
        unknown = unknown_variance(self.samples)
        parts = [
            estimated_slopes(points_mm[part], near, self.samples, self.structure, unknown)
            for part, near in _nearest(self.samples.points_mm, points_mm, USED)
        ]
        return np.concatenate(parts)

    def told(self) -> dict[str, Any]:
        """Return how the field was fitted: figures with their units in their names."""
        return {
            "method": "kriging",
            "belonging": float(np.sum(self.kept)),
            "reduced_chi2": float(np.mean(self.off_by**2)),
            "power": self.structure.power,
            "inner_length_mm": self.structure.inner_mm,
            "outer_length_mm": self.structure.outer_mm,
            "nugget_mm": float(np.sqrt(self.structure.nugget_mm2)),
            "error_over_stated": float(np.sqrt(self.structure.error_factor)),
            "potential_share": self.structure.potential_share,
        }

    def _error_factor(self, points_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how large errors (m, 3) are around places over what the equations say."""
        everywhere = MAD_TO_SIGMA * np.median(self.off_by, axis=0)
        count = min(AROUND, len(self.samples))
        near = KDTree(self.samples.points_mm).query(points_mm, k=np.arange(1, count + 1))[1]
        return np.maximum(everywhere, MAD_TO_SIGMA * np.median(self.off_by[near], axis=1))


def not_outliers(samples: Samples) -> NDArray[np.bool_]:
    """Return which samples (n,) are not far off what their neighbours let expect, in a flow of any roughness.

    What is told of each by a dozen others can be bent by one or two of them, not by what is wrong elsewhere.
    """
    return _told(samples, SHARES["free"], FEW_NEIGHBOURHOODS)[1]


def is_rough(samples: Samples) -> bool:
    """Tell whether the flow differs so much between neighbouring samples that kriging is to be used, not splines.

    The mean square difference grows with less than nearly the square of the distance there, and is more than errors.
    The samples are without outliers.
    """
    if len(samples) < FEWEST_OF_STRUCTURE:
        return False
    structure = likeliest_structure(samples, SHARES["free"], FEW_NEIGHBOURHOODS)
    apart = SPACINGS_APART * spacing_of(samples.points_mm)
    stated = np.median(np.einsum("nii->ni", samples.covariance_mm2), axis=0).min()
    by_errors = 2.0 * (structure.error_factor * float(stated) + structure.nugget_mm2)
    return structure.steepness(apart) < ROUGH_EXPONENT and structure.mean_at(apart) > by_errors


def kriged_field(samples: Samples, divergence: str) -> KrigedField:
    """Return the field that samples tell, two at least.

    Parameters
    ----------
    samples : with outliers among them
    divergence : "free": none; "penalised": as much as makes the samples clearly likelier; "off": components apart
    """
    structure, kept, off_by = _told(samples, SHARES[divergence], NEIGHBOURHOODS)
    return KrigedField(samples.subset(kept), structure, off_by, kept)


def _told(
    samples: Samples, shares: Sequence[float], size: tuple[int, int]
) -> tuple[VectorStructure, NDArray[np.bool_], NDArray[np.float64]]:
    """Return the structure function that samples tell, which (n,) are no outliers, and how far off these are.

    Outliers make a first structure function too rough: by it the far ones go. Shares and size are those of
    `likeliest_structure`.
    """
    rough = likeliest_structure(samples, shares[:1], FEW_NEIGHBOURHOODS)
    kept, _ = _without_outliers(samples, rough, np.ones(len(samples), dtype=bool), rounds=1)
    structure = likeliest_structure(samples.subset(kept), shares, size)
    return structure, *_without_outliers(samples, structure, kept, OUTLIER_ROUNDS)


def _without_outliers(
    samples: Samples, structure: VectorStructure, kept: NDArray[np.bool_], rounds: int
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which samples (n,) belong to the flow, and how far off (kept, 3) these are in standard deviations.

    Of each it is the `kept` ones, and in later rounds those of the round before, that let expect something.
    """
    for _ in range(rounds):
        off, covariance = _left_out(samples, kept, structure)
        kept = _belongs(samples, off, covariance)
    return kept, np.abs(off[kept]) / np.sqrt(np.einsum("nii->ni", covariance[kept]))


def _left_out(
    samples: Samples, kept: NDArray[np.bool_], structure: VectorStructure
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what each sample is off the nearest kept others by (n, 3), and the covariances (n, 3, 3) expected."""
    others = samples.subset(kept)
    unknown = unknown_variance(others)
    number = np.where(kept, np.cumsum(kept) - 1, -1)
    count = min(USED_FOR_OUTLIERS, len(others) - 1)
    value, covariance = np.empty((len(samples), 3)), np.empty((len(samples), 3, 3))
    for part, near in _nearest(others.points_mm, samples.points_mm, count + 1):
        is_own = near == number[part, np.newaxis]
        drop = np.where(is_own.any(axis=1), is_own.argmax(axis=1), count)
        near = near[np.arange(count + 1) != drop[:, np.newaxis]].reshape(len(near), -1)
        found = estimated(samples.points_mm[part], near, others, structure, unknown)
        value[part], covariance[part] = found.value_mm, found.covariance_mm2
    own = structure.error_factor * samples.covariance_mm2 + structure.nugget_mm2 * np.eye(3)
    return samples.value_mm - value, covariance + own


def _belongs(samples: Samples, off: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which samples (n,) belong to the flow rather than being off by the order of their neighbours' distance."""
    spacing = spacing_of(samples.points_mm)
    of_flow = np.einsum("ni,ni->n", off, np.linalg.solve(covariance, off[..., np.newaxis])[..., 0])
    times = max(float(np.median(of_flow)) / CHI_SQUARED_MEDIAN, 1.0)
    wide = covariance * times + spacing**2 * np.eye(3)
    of_wrong = np.einsum("ni,ni->n", off, np.linalg.solve(wide, off[..., np.newaxis])[..., 0])
    log_density_ratio = 0.5 * (
        np.linalg.slogdet(wide)[1] - np.linalg.slogdet(covariance * times)[1] + of_wrong - of_flow / times
    )
    probability = np.clip(samples.probability, 1.0 - LARGEST_PROBABILITY, LARGEST_PROBABILITY)
    return np.asarray(log_density_ratio + np.log(probability / (1.0 - probability)) > 0.0)


def _nearest(
    points: NDArray[np.float64], places: NDArray[np.float64], count: int
) -> list[tuple[slice, NDArray[np.int64]]]:
    """Return slices of the places, and the numbers (b, k) of the points nearest to each of them."""
    near = KDTree(points).query(places, k=np.arange(1, min(count, len(points)) + 1))[1]
    parts = [slice(start, start + PLACES_AT_ONCE) for start in range(0, len(places), PLACES_AT_ONCE)]
    return [(part, near[part]) for part in parts]
