"""Pressure from material accelerations: the scalar whose gradient is nearest to what accelerates the fluid.

Navier and Stokes: grad p = -rho (a - nu lap u). The pressure p of cubic B-splines for which the sum of the squares of
grad p + rho (a - nu lap u), by the accelerations' covariances, is the least solves Poisson's equation in its weak form:
for every spline q the sum of grad q . (grad p + rho (a - nu lap u)) is 0, which at the box' faces holds the pressure's
normal derivative to the acceleration there and asks for no boundary values. What of the accelerations is no gradient
falls away. Penalties on second and third derivatives are weighed by the samples' evidence, as a velocity field's are.
What these take from the pressure is seen in what is left of the accelerations, and is put back once (twicing: Tukey,
Exploratory Data Analysis, 1977, section 16); what they may still have taken is part of the stated error.
Pressure is known up to a constant: its mean over the box is 0.

Axes: points (n, 3) in mm; gradients in Pa/mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.fields import stencils
from lfpiv_cli.fields.fit import Field
from lfpiv_cli.fields.spline_field import (
    LAST_CHANGE,
    POINTS_AT_ONCE,
    ROUNDS,
    Box,
    SplineField,
    first_expectation,
    gradient_covariance_at,
    most_probable,
)
from lfpiv_cli.fields.structure import Samples, belonging, error_covariance, inverse_covariances, squares
from lfpiv_cli.kernels import njit
from lfpiv_cli.robust import MAD_TO_SIGMA

# Gradients of a scalar as samples: what each spline has of them, and their part of the normal equations.
#
# Axes: a gradient's components (x, y, z), per mm.


def gradient_at(points_mm: Floats, lattice: stencils.Lattice, coefficients: Floats) -> Floats:
    """Return the gradients (n, 3) of the scalar with coefficients (nx, ny, nz)."""
    columns, rows = stencils.gradient_rows(lattice, points_mm)
    return np.asarray(np.einsum("nik,nk->ni", rows, coefficients.ravel()[columns]))


@dataclass(frozen=True, eq=False)
class GradientBox(Box):
    """A part of the samples, which are gradients, and those of the splines at them, (n, 3, k)."""

    components: ClassVar[int] = 1
    integrals: ClassVar[int] = 1

    @classmethod
    def around(cls, lattice: stencils.Lattice, samples: Samples) -> Self:
        """Return the box of a lattice and the samples in it."""
        columns, values = stencils.gradient_rows(lattice, samples.points_mm)
        splines = np.zeros((len(samples), 3, int(np.prod(lattice.shape))))
        np.put_along_axis(splines, columns[:, np.newaxis], values, axis=2)
        return cls(lattice, samples, splines)

    def normal(self, weight: Floats) -> tuple[Floats, Floats]:
        """Return the normal equations of samples with weights (n, 3, 3)."""
        count = self.splines.shape[2]
        rows, weighted = self.splines.reshape(-1, count), (weight @ self.splines).reshape(-1, count)
        return rows.T @ weighted, self.samples.value_mm.ravel() @ weighted

    def field(self, coefficients: Floats) -> Floats:
        """Return the gradients (n, 3) at the samples."""
        return np.asarray(self.splines @ coefficients)

    def covariance(self, inverse: Floats) -> Floats:
        """Return the covariances (n, 3, 3) of the gradients at the samples."""
        return np.asarray(np.einsum("nik,njk->nij", self.splines @ inverse, self.splines, optimize=True))


def add_gradients(matrix: stencils.Stencil, lattice: stencils.Lattice, points_mm: Floats, weight: Floats) -> None:
    """Add the normal equations' matrix of gradients at points (n, 3) with weights (n, 3, 3), inverse covariances."""
    _, rows = stencils.gradient_rows(lattice, points_mm)
    first, _ = lattice.splines_at(points_mm)
    _add_rows(matrix, first, np.linalg.cholesky(weight).swapaxes(1, 2) @ rows)


def right_hand_side(lattice: stencils.Lattice, points_mm: Floats, weighted: Floats) -> Floats:
    """Return the normal equations' right-hand side (nx ny nz,) of weighted gradients (n, 3)."""
    columns, rows = stencils.gradient_rows(lattice, points_mm)
    parts = np.einsum("nik,ni->nk", rows, weighted)
    size = int(np.prod(lattice.shape))
    return np.asarray(np.bincount(columns.ravel(), parts.ravel(), minlength=size), dtype=np.float64)


@njit(cache=True, nogil=True)
def _add_rows(matrix, first, rows):  # type: ignore[no-untyped-def]  # numba
    """Add the squares of rows (n, m, 64), m of each sample, to the matrix of a scalar."""
    size = stencils.SUPPORT * stencils.SUPPORT * stencils.SUPPORT
    for sample in range(len(first)):
        for p in range(size):
            a, b, c = p // stencils.SUPPORT**2, p // stencils.SUPPORT % stencils.SUPPORT, p % stencils.SUPPORT
            row = matrix[first[sample, 0] + a, 0, first[sample, 1] + b, first[sample, 2] + c]
            for q in range(size):
                d, e, f = q // stencils.SUPPORT**2, q // stencils.SUPPORT % stencils.SUPPORT, q % stencils.SUPPORT
                total = 0.0
                for each in range(rows.shape[1]):
                    total += rows[sample, each, p] * rows[sample, each, q]
                row[d - a + stencils.DEGREE, 0, e - b + stencils.DEGREE, f - c + stencils.DEGREE] += total


MM_PER_M = 1000.0
# Knots are so many times the samples' mean distance apart, as a velocity field's.
KNOTS_OF_DISTANCE = 1.8
# Gradients are not known better than to this share of their spread: the constant that they do not tell would drown.
LEAST_ERROR = 1e-3
# Differences over so many mm give second derivatives; fields have none within less.
STEP_MM = 0.05


@dataclass(frozen=True, eq=False)
class PressureField:
    """A fitted pressure.

    Attributes
    ----------
    lattice : of the knots
    coefficients : (nx, ny, nz) Pa
    missed : (nx, ny, nz) Pa, what the penalties may still have taken
    factor : of the inverse covariance of the coefficients
    mean : (nx ny nz,) each spline's mean over the box
    wrong_share : of the pressure, by what its gradients have in common that is wrong
    expected : the penalties' weights and the errors' scales
    probability : (n,) of each sample to belong to the pressure
    reduced_chi2 : mean square of the samples' errors over that of the stated ones
    """

    lattice: stencils.Lattice
    coefficients: Floats
    missed: Floats
    factor: stencils.Factor
    mean: Floats
    wrong_share: float
    expected: stencils.Expectation
    probability: Floats
    reduced_chi2: float

    def value_at(self, points_mm: Floats) -> Floats:
        """Return the pressure (m,) in Pa at points, less its mean over the box."""
        return self._of(self.coefficients, points_mm)

    def _of(self, coefficients: Floats, points_mm: Floats) -> Floats:
        columns, values = stencils.rows_of(self.lattice, points_mm)
        flat = coefficients.ravel()
        return np.asarray(np.sum(values * flat[columns], axis=1) - self.mean @ flat)

    def variance_at(self, points_mm: Floats) -> Floats:
        """Return the variances (m,) of the pressure less its mean over the box, in Pa^2."""
        found = np.empty(len(points_mm))
        for start in range(0, len(points_mm), POINTS_AT_ONCE):
            part = slice(start, start + POINTS_AT_ONCE)
            columns, values = stencils.rows_of(self.lattice, points_mm[part])
            rows = np.tile(-self.mean, (len(columns), 1))
            rows[np.arange(len(columns))[:, np.newaxis], columns] += values
            found[part] = np.sum(rows.T * self.factor.solve(rows.T), axis=0)
        in_common = self._of(self.missed, points_mm) ** 2 + (self.wrong_share * self.value_at(points_mm)) ** 2
        return found + in_common


def pressure_gradients(
    points_mm: Floats,
    acceleration_m_s2: Floats,
    covariance: Floats,
    density_kg_m3: float,
    probability: Floats | None = None,
) -> Samples:
    """Return the gradients of the pressure in Pa/mm that go with accelerations, of viscosity too, and their errors.

    Parameters
    ----------
    points_mm : (n, 3)
    acceleration_m_s2, covariance : (n, 3), (n, 3, 3) m^2/s^4; a - nu lap u
    probability : (n,) that each belongs to the flow; 1 where not given
    """
    to_gradient = -density_kg_m3 / MM_PER_M
    sure = np.ones(len(points_mm)) if probability is None else probability
    return Samples(points_mm, to_gradient * acceleration_m_s2, to_gradient**2 * covariance, sure, 0.0)


def laplacian_at(field: Field, points_mm: Floats) -> Floats:
    """Return the Laplacian (m, 3) of a field's displacements at points, per mm, by differences of its gradients."""
    found = np.zeros(points_mm.shape)
    for axis, step in enumerate(STEP_MM * np.eye(3)):
        after, before = (field.gradient_at(points_mm + sign * step)[:, :, axis] for sign in (1.0, -1.0))
        found += (after - before) / (2.0 * STEP_MM)
    return found


def steady_accelerations(field: SplineField) -> tuple[Floats, Floats, Floats]:
    """Return (u . grad) u where the flow is steady: points (n, 3), accelerations (n, 3), covariances (n, 3, 3).

    They are mm per frame^2, at the middles of the cells between knots: within one, a fit's errors are alike, and those
    of more points would tell no more.
    """
    axes = [
        low + cell * (np.arange(count) + 0.5)
        for low, cell, count in zip(field.lattice.low_mm, field.lattice.cell_mm, field.lattice.cells, strict=True)
    ]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    velocity, gradient = field.value_at(points), field.gradient_at(points)
    of_gradient = gradient_covariance_at(field, points).reshape(-1, 3, 3, 3, 3)
    covariance = np.einsum("nij,nj,nkj->nik", gradient, field.variance_at(points), gradient)
    covariance += np.einsum("nj,nijkl,nl->nik", velocity, of_gradient, velocity)
    return points, np.einsum("nij,nj->ni", gradient, velocity), covariance


def knots_for(points_mm: Floats) -> float:
    """Return how far the pressure's knots are apart by the number of samples and the box that holds them."""
    size = np.maximum(np.ptp(points_mm, axis=0), np.finfo(np.float64).tiny)
    return KNOTS_OF_DISTANCE * float(np.prod(size) / max(len(points_mm), 1)) ** (1.0 / 3.0)


def pressure_field(
    samples: Samples, lattice: stencils.Lattice, rng: np.random.Generator, wrong_share: float = 0.0
) -> PressureField:
    """Fit the pressure to its gradients.

    Parameters
    ----------
    lattice : the knots, over all samples
    rng : draws the boxes that tell the penalties' weights
    wrong_share : of the accelerations that is wrong alike among neighbours, so that no fit lessens it
    """
    expected = first_expectation(samples, lattice, (stencils.SECOND, stencils.THIRD), GradientBox)
    least = (LEAST_ERROR * expected.spread_mm) ** 2 * np.eye(3)
    samples = replace(samples, covariance_mm2=samples.covariance_mm2 + least)
    # The first probabilities are those to belong to a pressure of wide knots, which no single sample can bend.
    wide = lattice.wide()
    unresolved, probability = expected.unresolved_mm, samples.probability
    for _ in range(ROUNDS):
        covariance = error_covariance(samples, 1.0, unresolved)
        *_, error = _fitted(samples, wide, expected, covariance, probability)
        last, probability = probability, belonging(samples, error, covariance, expected.spread_mm)
        unresolved = MAD_TO_SIGMA * float(np.median(np.abs(error).max(axis=1)))
        if np.mean(np.abs(probability - last)) < LAST_CHANGE:
            break
    expected, _ = most_probable(replace(samples, probability=probability), lattice, expected, rng, GradientBox)
    covariance = error_covariance(samples, expected.scale, expected.unresolved_mm)
    for _ in range(ROUNDS):
        factor, weight, coefficients, error = _fitted(samples, lattice, expected, covariance, probability)
        last, probability = probability, belonging(samples, error, covariance, expected.spread_mm)
        if np.mean(np.abs(probability - last)) < LAST_CHANGE:
            break
    # Each spline's mean over the box; the splines' sum is 1 everywhere.
    x, y, z = (
        lattice.integrals(axis, 0, 0).sum(axis=1) / (lattice.cells[axis] * lattice.cell_mm[axis]) for axis in range(3)
    )
    # What penalties have taken, by the errors that are left: a fit to these.
    put_back = _coefficients(factor, lattice, samples.points_mm, weight, error)
    error = error - gradient_at(samples.points_mm, lattice, put_back)
    chi2 = squares(error, samples.covariance_mm2)
    return PressureField(
        lattice,
        coefficients + put_back,
        _coefficients(factor, lattice, samples.points_mm, weight, error),
        factor,
        (x[:, None, None] * y[:, None] * z).ravel(),
        wrong_share,
        expected,
        probability,
        float(np.sum(probability * chi2) / (3.0 * np.sum(probability))),
    )


def _coefficients(
    factor: stencils.Factor, lattice: stencils.Lattice, points_mm: Floats, weight: Floats, gradient: Floats
) -> Floats:
    right = right_hand_side(lattice, points_mm, np.einsum("nij,nj->ni", weight, gradient))
    return factor.solve(right).reshape(lattice.shape)


def _fitted(
    samples: Samples, lattice: stencils.Lattice, expected: stencils.Expectation, covariance: Floats, probability: Floats
) -> tuple[stencils.Factor, Floats, Floats, Floats]:
    """Return the pressure of the least sum of squares and penalties.

    Factor, weights (n, 3, 3) of the samples, coefficients (nx, ny, nz) and errors (n, 3) of the samples.
    """
    matrix = stencils.expected_inverse(
        lattice, replace(expected, spread_mm=lattice.smallest_mm * expected.spread_mm), 1
    )
    weight = inverse_covariances(covariance, probability)
    add_gradients(matrix, lattice, samples.points_mm, weight)
    factor = stencils.factorised(matrix)
    found = _coefficients(factor, lattice, samples.points_mm, weight, samples.value_mm)
    return factor, weight, found, samples.value_mm - gradient_at(samples.points_mm, lattice, found)
