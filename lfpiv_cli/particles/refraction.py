"""Where particles are by Snell's law, from where paraxial rays have them.

Particles are fitted with paraxial rays, which all come from one point. Behind plane faces those through the rim of the
main lens come from nearer by: some 6 um behind 5 mm of acrylic and 5 mm of water at f/4, a tenth of a millimetre behind
10 cm of water. What a fit returns is the point whose rays are closest to the real ones, by least squares over the main
lens: its distance from the slopes along the lens, its lateral place from their mean (Eqs. 4, 6, 9).

Axes: world or image axes, z away from the camera from the nominal focal point; lengths in mm.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.object_space import ObjectSpace, slope_ratio

# Rings of equal area and rays on each: the slope is a cubic in the place on the lens, its moments are right to 0.4 %.
RINGS, RAYS_PER_RING = 8, 8
# The shift changes by some 1e-3 of what a point moves: twice leaves a millionth of it.
REPEATS = 2
# Points in the window are shifted like those this far behind its face, in depths over which light spreads by one lens.
SHALLOWEST_DEPTHS = 1e-6


def places_by_snell(points_mm: NDArray[np.float64], space: ObjectSpace, camera: Camera) -> NDArray[np.float64]:
    """Return the points (n, 3) that paraxial rays see at the given ones, mm."""
    places = points_mm
    for _ in range(REPEATS):
        places = points_mm - paraxial_shift(places, space, camera)
    return places


def paraxial_shift(points_mm: NDArray[np.float64], space: ObjectSpace, camera: Camera) -> NDArray[np.float64]:
    """Return how far (n, 3) from their places points are seen by who takes rays for paraxial, mm.

    Raises
    ------
    ConfigError
        Refraction is exact and the thickness of the window unknown.
    """
    if space.straight or not len(points_mm):
        return np.zeros_like(points_mm)
    in_fluid = points_mm.copy()
    shallowest = SHALLOWEST_DEPTHS * camera.scale(space.media).depth_mm
    in_fluid[:, 2] = np.maximum(points_mm[:, 2], shallowest - space.layers(camera)[0][-1])
    lens = _rays_on_lens(camera.aperture_radius_mm)
    reach = camera.aperture_radius_mm + float(np.linalg.norm(in_fluid[:, :2], axis=1).max())
    nodes, factors = space.slope_polynomials(camera, in_fluid[:, 2], reach)
    seen = _seen_at(in_fluid, lens, nodes, factors)
    seen[:, 2] = (seen[:, 2] - camera.focus_distance_mm) / space.media.depth_ratio
    return seen - in_fluid


def _rays_on_lens(radius_mm: float) -> NDArray[np.float64]:
    """Return points (m, 2) that stand for equal areas of the main lens, mm; their mean is zero."""
    radius = radius_mm * np.sqrt((np.arange(RINGS) + 0.5) / RINGS)
    angle = 2.0 * np.pi * np.arange(RAYS_PER_RING) / RAYS_PER_RING
    return np.stack([np.outer(radius, f(angle)).ravel() for f in (np.cos, np.sin)], axis=1)


@njit(cache=True)
def _seen_at(
    points: NDArray[np.float64], lens: NDArray[np.float64], nodes: NDArray[np.float64], factors: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the points in air, (x, y, distance from the lens), whose rays have most nearly the slopes of the real."""
    seen = np.empty_like(points)
    for n in range(points.shape[0]):
        mean_x = mean_y = along = spread = 0.0
        for x, y in lens:
            dx, dy = x - points[n, 0], y - points[n, 1]
            ratio = slope_ratio(dx * dx + dy * dy, nodes[n], factors[n])
            mean_x += ratio * dx / lens.shape[0]
            mean_y += ratio * dy / lens.shape[0]
            along += ratio * (dx * x + dy * y)
            spread += x * x + y * y
        distance = spread / along
        seen[n] = -mean_x * distance, -mean_y * distance, distance
    return seen
