"""What the images of tracers show of the camera: how far charge diffuses, and how far its microlenses are from focus.

Diffusion, where light goes by waves, together with the tracers' size, by maximum likelihood. Either blurs an image by
its square: a size as far as it is seen magnified, diffusion by the same wherever light falls. What each tracer loses in
chi-squared with other squares q = (diameter^2, diffusion^2) is nearly a quadratic form,

    q^T M q - 2 b^T q,

and that of all tracers is their sum, together with what is known of diffusion before an image is looked at. Tracers
that are two, or of another size, contradict the others by more than chance, and count for less the more they do.

The microlenses' focal length: the main lens's light converges before or behind the array, and each microlens that it
lights shows a patch of it on the sensor. With another focal length patches become wider on one side of the focal plane
and narrower on the other. Nothing else does that: diffraction, diffusion and a tracer's size widen them on both, and a
white image, whose light comes evenly from everywhere, hardly changes. Each particle shows by how much, in one
Gauss-Newton step with its own place and light free, the others being as found.

Units: microlenses as the scene shows them, and pixels. Axes: image axes, mm; see `fitting`.

References
----------
Huber, Robust Statistics, chapter 3 (weights).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.particles.least_squares import UNKNOWNS, lit_by, respond_all, room_for
from lfpiv_cli.particles.view import View, entry_capacity
from lfpiv_cli.robust import weighted_median

# How far charge diffuses in a sensor may differ from what is usual.
USUAL_SIGMA_PX = 0.1
# Where the images leave this much of that uncertainty, they hardly show diffusion.
TOLD = 0.7
# What is given is held by so small a standard error.
HELD = 1e-6
# A tracer counts for less where it contradicts the others by more than so many times the usual, in chi-squared.
CONTRADICTING, REWEIGHTINGS = 4.0, 20
# Median of chi-squared of two unknowns.
MEDIAN_OF_TWO = 1.386
# A form that opens downwards is taken as this much of its size.
LEAST_CURVATURE = 1e-3
# What the model of light gets wrong: a share of the diameter, and of the squares, which take up what it lacks. On ten
# images by waves, of 10 and 50 um and .2 to .45 px, these were -.002 to .005 lens^2 and .001 to .009 px^2 too large.
MODEL_SHARE, MODEL_SQUARES = 0.01, (0.005, 0.006)
# From so many tracers found for each microlens on, what neighbours that were not found add to it grows with their
# number's square: in an image of 2 for each microlens, diffusion of .3 px seemed .19.
CROWDED = 0.8
# So many particles tell the focal length to a thousandth: those nearest to the axis, where lenses are at their best.
MOST_PARTICLES = 100
# With fewer their scatter is not known.
FEWEST_PARTICLES = 10
# The difference that is tried, a share of it: patches change by less than a fifth of a pixel.
STEP = 0.01


class Forms(NamedTuple):
    """What single tracers lose: M (n, 2, 2) and b (n, 2); and how many were found around them for each microlens."""

    matrix: NDArray[np.float64]
    right: NDArray[np.float64]
    crowd: float = 0.0


NO_FORMS = Forms(np.zeros((0, 2, 2)), np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class Together:
    """Size and diffusion.

    Attributes
    ----------
    lenses, diffusion_px : diameter and diffusion
    covariance : (2, 2) of their squares, what the model gets wrong included
    """

    lenses: float
    diffusion_px: float
    covariance: NDArray[np.float64]

    @property
    def sigma_lenses(self) -> float:
        """Standard error of the diameter."""
        return float(_of_root(self.lenses, np.sqrt(self.covariance[0, 0])))

    @property
    def sigma_px(self) -> float:
        """Standard error of diffusion."""
        return float(_of_root(self.diffusion_px, np.sqrt(self.covariance[1, 1])))

    @property
    def reported(self) -> bool:
        """Whether diffusion is by the images, not what is usual."""
        return bool(self.sigma_px < TOLD * USUAL_SIGMA_PX)


def together_of(frames: Sequence[Forms], lenses: float | None = None, diffusion_px: float | None = None) -> Together:
    """Return what the tracers of some frames show together, with the diameter or diffusion held where it is given."""
    matrix = np.concatenate([each.matrix for each in frames])
    right = np.concatenate([each.right for each in frames])
    crowded = max(max(each.crowd for each in frames) / CROWDED, 1.0) ** 2
    expected = np.array([lenses or 0.0, USUAL_DIFFUSION_PX if diffusion_px is None else diffusion_px]) ** 2
    sure = np.array(
        [
            0.0 if lenses is None else HELD**-2,
            (2.0 * USUAL_DIFFUSION_PX * USUAL_SIGMA_PX) ** -2 if diffusion_px is None else HELD**-2,
        ]
    )
    weight, spread = np.ones(len(matrix)), 1.0
    # What opens downwards is turned up, in units in which the forms' mean is round.
    unit = np.sqrt(np.abs(np.einsum("nii->ni", matrix)).mean(axis=0))
    values, vectors = np.linalg.eigh(matrix / np.outer(unit, unit))
    values = np.maximum(values, LEAST_CURVATURE * np.abs(values).max(axis=1, keepdims=True))
    single = np.einsum("nik,nk,njk->nij", vectors, values, vectors) * np.outer(unit, unit)
    for _ in range(REWEIGHTINGS):
        whole = np.einsum("n,nij->ij", weight, matrix) + np.diag(sure)
        square = _lowest(whole, weight @ right + sure * expected)
        pull = right - matrix @ square
        against = np.einsum("ni,ni->n", pull, np.linalg.solve(single, pull[..., np.newaxis])[..., 0])
        spread = max(float(np.median(against)) / MEDIAN_OF_TWO, 1.0)
        weight = np.minimum(1.0, np.sqrt(CONTRADICTING * spread / np.maximum(against, 1e-300)))
    # As they scatter, not only as each one states.
    covariance = np.linalg.inv(whole) * spread
    # What is wrong in the images' own answer comes through as far as they are heard beside what is known.
    model = crowded * np.array([np.hypot(2.0 * MODEL_SHARE * square[0], MODEL_SQUARES[0]), MODEL_SQUARES[1]])
    through = np.linalg.solve(whole, np.einsum("n,nij->ij", weight, matrix) * model)
    covariance += through @ through.T
    diameter, diffusion = np.sqrt(square)
    return Together(float(diameter), float(diffusion), covariance)


def forms_of(squares: NDArray[np.float64], losses: NDArray[np.float64]) -> Forms:
    """Return the quadratic forms through losses (m, n) with squares (m, 2)."""
    middle = squares.mean(axis=0)
    unit = np.ptp(squares, axis=0) / 2.0
    x, y = ((squares - middle) / unit).T
    terms = np.column_stack([x * x, y * y, x * y, x, y, np.ones_like(x)])
    (xx, yy, xy, by_x, by_y, _), *_ = np.linalg.lstsq(terms, losses, rcond=None)
    matrix = np.stack([xx, 0.5 * xy, 0.5 * xy, yy], axis=-1).reshape(-1, 2, 2) / np.outer(unit, unit)
    slope = np.stack([by_x, by_y], axis=-1) / unit
    return Forms(matrix, matrix @ middle - 0.5 * slope)


def _lowest(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the squares (2,), not below 0, where a form is lowest."""
    square = np.linalg.solve(matrix, right)
    for k in range(2):
        if square[k] < 0.0:
            square[k], square[1 - k] = 0.0, max(right[1 - k] / matrix[1 - k, 1 - k], 0.0)
    return np.asarray(square)


def _of_root(root: float, error: float) -> float:
    """Return the standard error of a root by that of its square, also where the root is 0."""
    return float(np.sqrt(root**2 + error) - root)


class FocalLength(NamedTuple):
    """By how much the microlenses' focal length is off what is said, a share of it, and the standard error."""

    off: float
    sigma: float


def focal_length_of(view: View, particles: Floats, residual: Floats, weight: Floats) -> FocalLength | None:
    """Return the focal length by particles (n, 4); None where too few show it.

    Parameters
    ----------
    view : by rays; where the particles were found by waves half of what is off is seen
    residual, weight : (pixels,) what all particles leave of the image, and the inverse variances
    """
    if len(particles) < FEWEST_PARTICLES:
        return None
    camera, length = view.camera, (1.0 + STEP) * view.camera.microlens_focal_length_mm
    bend = 1.0 - camera.microlens_distance_mm / length
    views = (view, view._replace(camera=camera._replace(microlens_focal_length_mm=length, bend=bend)))
    depth = particles[:, 2]
    room = max(entry_capacity(each, depth.min(), depth.max()) for each in views)
    nearest = np.argsort(np.hypot(particles[:, 0], particles[:, 1]), kind="stable")[:MOST_PARTICLES]
    steps = [_step(views, particle, residual, weight, room) for particle in particles[nearest]]
    found = np.array([step for step in steps if step is not None]).reshape(-1, 2)
    if len(found) < FEWEST_PARTICLES:
        return None
    middle, error = weighted_median(*(STEP * found.T))
    return FocalLength(middle, error)


def _step(
    views: tuple[View, View], particle: Floats, residual: Floats, weight: Floats, room: int
) -> tuple[float, float] | None:
    """Return the step from the first view that a particle (4,) shows, and its standard error.

    In differences of the other one; None where it shows nothing.
    """
    lit = []
    for view in views:
        responses = room_for(1, room, 0)
        respond_all(view, particle[np.newaxis], responses)
        own_pixels, values = lit_by(responses, 0)
        lit.append((own_pixels, values[:UNKNOWNS, : own_pixels.size]))
    pixels = np.unique(np.concatenate([each for each, _ in lit]))
    root = np.sqrt(weight[pixels])
    # Light and its derivatives by x, y and z (4, pixels), summed where a pixel is named twice.
    own, longer = (
        np.stack([np.bincount(np.searchsorted(pixels, at), row, pixels.size) for row in values]) * root
        for at, values in lit
    )
    kept = np.linalg.qr(own.T)[0]
    design, rest = particle[3] * (longer[0] - own[0]), residual[pixels] * root
    design, rest = (each - kept @ (kept.T @ each) for each in (design, rest))
    information, freedom = float(np.sum(design**2)), np.count_nonzero(root) - UNKNOWNS - 1
    if not information > 0.0 or freedom < 1:
        return None
    scatter = max(float(np.sum(rest**2)) / freedom, 1.0)
    return float(np.sum(design * rest)) / information, float(np.sqrt(scatter / information))
