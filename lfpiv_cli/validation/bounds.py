"""How well the particles of a raw image can be known at best: the Cramer-Rao bound.

With f the expected image, V the variance of each pixel and J = df/d(x, y, z, light) of every particle, the Fisher
information of an image with read and shot noise is

    F = J^T V^-1 J                                                  (Kay 1993, Eq. 3.31, V taken as known)

and no estimate without bias has a smaller covariance than F^-1. F is sparse: particles that share no pixel have no
block in common. Each *alone*, the others known exactly, has the inverse of its own block; *jointly*, its block of the
inverse of the whole.

Axes: image axes, see `particles.view`; a particle is a row (x, y, z, light), mm and counts; images are flat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from lfpiv_cli.particles.least_squares import lit_by, respond_all, room_for
from lfpiv_cli.particles.view import View, entry_capacity
from lfpiv_cli.synthetic.sensor import Readout

UNKNOWNS = 4
# Rounding to whole counts adds the variance of an even spread over one.
ROUNDING_VARIANCE = 1.0 / 12.0
# Variance that evenly spread rays give a fitted place, over that which as many photons would: of tracers of 50 um at
# 0.8 to 4 mm from the paper's focal plane it is 0.2 to 0.4.
RAY_VARIANCE = 0.3
# Two particles in one place make F singular. So little more than F, whose diagonal is scaled to 1, makes their errors
# large in place of infinite.
RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class Bound:
    """Smallest covariances (n, 4, 4) of each particle, its neighbours known (`alone`) or to be found (`joint`)."""

    alone: NDArray[np.float64]
    joint: NDArray[np.float64]

    def sigma_mm(self, joint: bool) -> NDArray[np.float64]:
        """Return the smallest standard errors (n, 3) of x, y and z."""
        chosen = self.joint if joint else self.alone
        return np.asarray(np.sqrt(np.diagonal(chosen, axis1=1, axis2=2)[:, :3]))


def slopes(view: View, particles: NDArray[np.float64]) -> sparse.csc_array:
    """Return J (pixels, 4 n): what each particle's x, y, z and light do to the expected image."""
    capacity = entry_capacity(view, *_depths(particles))
    room = room_for(1, capacity, 0)
    rows, columns, entries = [], [], []
    for number, particle in enumerate(particles):
        respond_all(view, particle[np.newaxis], room)
        pixels, values = lit_by(room, 0)
        light, count = particle[3], pixels.size
        rows.append(np.tile(pixels, UNKNOWNS))
        columns.append(np.repeat(UNKNOWNS * number + np.arange(UNKNOWNS), count))
        entries.append((values[[1, 2, 3, 0], :count] * [[light], [light], [light], [1.0]]).ravel())
    shape = (view.camera.rows * view.camera.columns, UNKNOWNS * len(particles))
    if not rows:
        return sparse.csc_array(shape)
    # A pixel that is lit through two lenses may be named twice and is added up here.
    indices = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csc_array(sparse.coo_array((np.concatenate(entries), indices), shape=shape))


def _depths(particles: NDArray[np.float64]) -> tuple[float, float]:
    return (float(particles[:, 2].min()), float(particles[:, 2].max())) if len(particles) else (0.0, 0.0)


def expected_image(slope: sparse.csc_array, particles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the expected counts (pixels,) of particles from their `slopes`."""
    return np.asarray(slope[:, 3::UNKNOWNS] @ particles[:, 3])


def pixel_variance(
    expected_counts: NDArray[np.float64], readout: Readout, counts_per_ray: float = 0.0
) -> NDArray[np.float64]:
    """Return the variance (pixels,) of recorded pixels: read noise, rounding, light's own noise, and that of its rays.

    Parameters
    ----------
    counts_per_ray : of an image that was rendered ray by ray
    """
    shot = 0.0 if readout.photons_per_count is None else 1.0 / readout.photons_per_count
    gain = shot + RAY_VARIANCE * counts_per_ray
    return np.asarray(readout.read_noise_counts**2 + ROUNDING_VARIANCE + gain * np.maximum(expected_counts, 0.0))


def cramer_rao_bound(slope: sparse.csc_array, variance: NDArray[np.float64]) -> Bound:
    """Return the bound of each particle from the `slopes` of all and the variance (pixels,) of the image.

    Jointly, the particles that share pixels with a particle are free and those further away held: what these would add
    is of second order, a thousandth at the paper's seeding.
    """
    weighted = slope.multiply(1.0 / variance[:, np.newaxis])
    information = sparse.csr_array(slope.T @ weighted)
    count = information.shape[0] // UNKNOWNS
    alone, joint = np.empty((count, UNKNOWNS, UNKNOWNS)), np.empty((count, UNKNOWNS, UNKNOWNS))
    for number in range(count):
        own = UNKNOWNS * number + np.arange(UNKNOWNS)
        overlapping = np.setdiff1d(information[own].indices // UNKNOWNS, number)
        others = (UNKNOWNS * overlapping[:, np.newaxis] + np.arange(UNKNOWNS)).ravel()
        members = np.concatenate([own, others])
        matrix = information[members][:, members].toarray()
        alone[number] = _first_block_of_inverse(matrix[:UNKNOWNS, :UNKNOWNS])
        joint[number] = _first_block_of_inverse(matrix)
    return Bound(alone, joint)


def errors_alone_mm(
    view: View, particles: NDArray[np.float64], readout: Readout, counts_per_ray: float = 0.0
) -> NDArray[np.float64]:
    """Return the bound (n, 3) of x, y and z of particles each of which is alone in an image of its own."""
    errors = np.empty((len(particles), 3))
    for number, particle in enumerate(particles):
        slope = slopes(view, particle[np.newaxis])
        variance = pixel_variance(expected_image(slope, particle[np.newaxis]), readout, counts_per_ray)
        errors[number] = cramer_rao_bound(slope, variance).sigma_mm(joint=False)[0]
    return errors


def _first_block_of_inverse(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the first (4, 4) of a symmetric matrix's inverse; a diagonal of 0 is of something that cannot be known."""
    diagonal = np.diag(matrix)
    known = diagonal > 0.0
    scale = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 0.0)
    scaled = matrix * scale * scale[:, np.newaxis] + np.diag(np.where(known, RIDGE, 1.0))
    solved = cho_solve(cho_factor(scaled), np.eye(len(matrix), UNKNOWNS))[:UNKNOWNS]
    block = solved * scale[:UNKNOWNS] * scale[:UNKNOWNS, np.newaxis]
    block[np.diag_indices(UNKNOWNS)] += np.where(known[:UNKNOWNS], 0.0, np.inf)
    return np.asarray(block)
