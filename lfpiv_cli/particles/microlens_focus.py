"""The focal length of the microlenses by the images of tracers.

The main lens's light converges before or behind the array, and each microlens that it lights shows a patch of it on the
sensor. With another focal length patches become wider on one side of the focal plane and narrower on the other. Nothing
else does that: diffraction, diffusion and a tracer's size widen them on both, and a white image, whose light comes
evenly from everywhere, hardly changes.

Each particle tells by how much, in one Gauss-Newton step with its own place and light free, the others being as found.

Axes: image axes, mm; see `fitting`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.particles.diameter import Sizes, middle_of
from lfpiv_cli.particles.least_squares import UNKNOWNS, lit_by, respond_all, room_for
from lfpiv_cli.particles.view import View, entry_capacity

# So many particles tell it to a thousandth: those nearest to the optical axis, where lenses are at their best.
MOST_PARTICLES = 100
# With fewer their scatter is not known.
FEWEST_PARTICLES = 10
# Difference of the focal length, a share of it: patches change by less than a fifth of a pixel.
STEP = 0.01


class FocalLength(NamedTuple):
    """By how much the microlenses' focal length is off what is said, a share of it, and the standard error."""

    off: float
    sigma: float


def focal_length_of(view: View, particles: Floats, residual: Floats, weight: Floats) -> FocalLength | None:
    """Return what particles (n, 4) tell of the focal length; None where too few do.

    Parameters
    ----------
    view : by rays; where the particles were found by waves they tell half of what is off
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
    middle, error = middle_of(Sizes(*(STEP * found.T)))
    return FocalLength(middle, error)


def _step(
    views: tuple[View, View], particle: Floats, residual: Floats, weight: Floats, room: int
) -> tuple[float, float] | None:
    """Return the step from the first view that a particle (4,) tells, and its standard error.

    In differences of the other one; None where it tells nothing.
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
