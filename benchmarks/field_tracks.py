"""Tracks as `track` gives them, of known flows, without images: to judge what makes fields of them.

Axes: world (x, y, z) in mm, z away from the camera from the focal plane, the box of the tracks centred on the origin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.synthetic.flows import MM_PER_M, Flow, advect

Floats = NDArray[np.float64]

# Where all rays of a particle come from: errors in depth lie along the line from here.
LENS_MM = np.array([0.0, 0.0, -200.0])
# Standard errors of a displacement at the focal plane and what is added at the box's ends in depth. Those that `track`
# states on rendered images have medians of 0.0003 and 0.008 mm, and twentieths below 0.0002 and 0.005.
LATERAL_MM = (0.0003, 0.0004)
DEPTH_MM = (0.005, 0.01)
# Particles differ in light: each one's errors are larger by a factor of up to this.
FAINTEST = 1.4
# Near the focal plane all microlenses see a particle alike, and depth is known worst.
BLIND_MM, BLIND_FACTOR = 0.5, 3.0
# A false partner is that of one of so many nearest particles.
NEIGHBOURS = 6
# The middle of a path's ends differs from its place at half time by some hundredths of a mm, which each round divides
# by ten or more.
MIDDLE_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Tracks:
    """Tracks of one pair of frames.

    Attributes
    ----------
    middle_mm, displacement_mm : (n, 3), of the ends as they were measured
    covariance_mm2 : (n, 3, 3) as stated of the displacements; of the middles it is a quarter
    wrong : (n,) which of them lead to another particle
    dt_s : time between the frames
    """

    middle_mm: Floats
    displacement_mm: Floats
    covariance_mm2: Floats
    wrong: NDArray[np.bool_]
    dt_s: float


def tracks_of(
    flow: Flow,
    count: int,
    rng: np.random.Generator,
    size_mm: tuple[float, float, float] = (13.0, 10.0, 10.0),
    displacement_mm_rms: float = 0.4,
    wrong_share: float = 0.0,
    sigma_scale: float = 1.0,
) -> Tracks:
    """Return tracks whose places at half time are evenly spread over a box.

    Parameters
    ----------
    displacement_mm_rms : of the displacements' lengths; it sets the time between the frames
    wrong_share : of the tracks that end at a neighbour's partner, which their covariance does not tell
    sigma_scale : on all standard errors, as drawn and as stated
    """
    half = 0.5 * np.asarray(size_mm)
    place = rng.uniform(-half, half, (count, 3))
    dt_s = displacement_mm_rms / (MM_PER_M * float(np.sqrt(np.mean(np.sum(flow(place) ** 2, axis=1)))))
    covariance = sigma_scale**2 * stated_covariance(place, float(half[2]), rng)
    root = np.linalg.cholesky(0.5 * covariance)
    first, second = (
        advect(flow, place, sign * 0.5 * dt_s) + np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3)))
        for sign in (-1.0, 1.0)
    )
    wrong = np.zeros(count, dtype=np.bool_)
    wrong[rng.choice(count, round(wrong_share * count), replace=False)] = True
    if wrong.any():
        second[wrong] = second[_neighbours(first, wrong, rng)]
    return Tracks(0.5 * (first + second), second - first, covariance, wrong, dt_s)


def stated_covariance(points_mm: Floats, half_depth_mm: float, rng: np.random.Generator) -> Floats:
    """Return the covariances (n, 3, 3), mm^2, of displacements: long towards the lens, longest near the focal plane."""
    depth = np.abs(points_mm[:, 2])
    fainter = rng.uniform(1.0, FAINTEST, len(points_mm))
    lateral, along = (fainter * (low + more * depth / half_depth_mm) for low, more in (LATERAL_MM, DEPTH_MM))
    along = np.where(depth < BLIND_MM, BLIND_FACTOR, 1.0) * along
    ray = points_mm - LENS_MM
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    outer = ray[:, :, np.newaxis] * ray[:, np.newaxis]
    lateral2, along2 = (sigma[:, np.newaxis, np.newaxis] ** 2 for sigma in (lateral, along))
    return np.asarray(lateral2 * np.eye(3) + (along2 - lateral2) * outer)


def true_displacement_mm(flow: Flow, points_mm: Floats, dt_s: float) -> Floats:
    """Return the displacements (n, 3) over `dt_s` of the paths whose ends have their middles at the points."""
    place = points_mm
    for _ in range(MIDDLE_ROUNDS):
        first, second = (advect(flow, place, sign * 0.5 * dt_s) for sign in (-1.0, 1.0))
        place = place + points_mm - 0.5 * (first + second)
    first, second = (advect(flow, place, sign * 0.5 * dt_s) for sign in (-1.0, 1.0))
    return second - first


def _neighbours(places_mm: Floats, of: NDArray[np.bool_], rng: np.random.Generator) -> NDArray[np.intp]:
    """Return for each place that is asked `of` one of its nearest others."""
    near = KDTree(places_mm).query(places_mm[of], k=np.arange(2, NEIGHBOURS + 2))[1]
    return np.asarray(near[np.arange(len(near)), rng.integers(NEIGHBOURS, size=len(near))])
