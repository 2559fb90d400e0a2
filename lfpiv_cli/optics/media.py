"""Plane layers between the camera and the flow: paraxial and exact Snell refraction, equivalent points.

Axes: z along the optical axis, positive away from the camera, zero at the nominal focal point in the fluid. Slopes are
tangents of the angle with the axis, positive when the ray moves towards larger |lateral| position on its way to the
lens. Lengths in mm, refractive indices relative to vacuum. Equation numbers are those of the equivalent-ray-tracing
paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit

# Newton's iteration for the exact refraction starts from the paraxial ray and converges quadratically; below f/1.4 and
# for n < 2 six steps reach 1e-15, the limit only guards against a ray that grazes.
NEWTON_STEPS = 30
NEWTON_TOLERANCE = 1e-15


@dataclass(frozen=True)
class Media:
    """Refractive indices of what lies in front of the lens."""

    air: float = 1.0
    window: float = 1.0
    fluid: float = 1.0

    @property
    def depth_ratio(self) -> float:
        """Apparent depth in air of a unit of depth in the fluid, n_a / n_w (Eq. 9)."""
        return self.air / self.fluid

    def in_air(self) -> Media:
        """Return the media of a scene without window and fluid."""
        return Media(self.air, self.air, self.air)


@dataclass(frozen=True)
class Window:
    """A plane window: its distance from the main lens (d1) and its thickness (d2), in mm."""

    distance_mm: float
    thickness_mm: float


class Layers(NamedTuple):
    """Plane layers, from the lens on: their thicknesses (n,), mm, and refractive indices (n,)."""

    thicknesses_mm: Floats
    indices: Floats


def equivalent_object_distance(z_mm: ArrayLike, focus_distance_mm: float, media: Media) -> Floats:
    """Return the object distance in air of a point at depth z in the fluid (Eqs. 6 and 9); x and y stay (Eq. 10).

    `focus_distance_mm` is F_m (M - 1)/M, the distance of the focal point's equivalent from the lens.
    """
    return focus_distance_mm + media.depth_ratio * np.asarray(z_mm, dtype=np.float64)


def fluid_path_to_focus(window: Window, focus_distance_mm: float, media: Media) -> float:
    """Return d3 + d4: how deep in the fluid the nominal focal point lies behind the window (Eqs. 3 and 6), in mm."""
    apparent = focus_distance_mm - window.distance_mm - window.thickness_mm * media.air / media.window
    return apparent * media.fluid / media.air


def channel_window(
    focus_distance_mm: float, media: Media, width_mm: float, wall_mm: float, mid_plane_z_mm: float
) -> Window:
    """Return the window of a channel whose mid plane lies at a depth, half the width behind the wall (Eq. 6)."""
    path = 0.5 * width_mm - mid_plane_z_mm
    distance = focus_distance_mm - path * media.depth_ratio - wall_mm * media.air / media.window
    return Window(distance, wall_mm)


def object_space_matrix(z_mm: float, window: Window, focus_distance_mm: float, media: Media) -> Floats:
    """Return the 2x2 transfer matrix from a point at depth z to the main lens, paraxial refraction (Eqs. 14, 15)."""

    def travel(distance: float) -> Floats:
        return np.array([[1.0, distance], [0.0, 1.0]])

    def refract(index_from: float, index_to: float) -> Floats:
        return np.array([[1.0, 0.0], [0.0, index_from / index_to]])

    depth = fluid_path_to_focus(window, focus_distance_mm, media) + z_mm
    return (
        travel(window.distance_mm)
        @ refract(media.window, media.air)
        @ travel(window.thickness_mm)
        @ refract(media.fluid, media.window)
        @ travel(depth)
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def snell_invariant(lateral_mm: float, thicknesses_mm: Floats, indices: Floats, deeper_mm: float = 0.0) -> float:
    """Return n sin(angle), the same in all layers, of the ray that moves `lateral_mm` >= 0 sideways through them.

    The last layer is by `deeper_mm` thicker. Solves sum t_i s / sqrt(n_i^2 - s^2) = lateral by Newton's method from the
    paraxial ray. The left side is convex and rises to infinity where s meets the smallest index, so a solution always
    exists below it.
    """
    paraxial = deeper_mm / indices[-1]
    smallest = indices[0]
    for i in range(thicknesses_mm.size):
        paraxial += thicknesses_mm[i] / indices[i]
        smallest = min(smallest, indices[i])
    s = min(lateral_mm / paraxial, 0.999 * smallest)
    for _ in range(NEWTON_STEPS):
        value = -lateral_mm
        slope = 0.0
        for i in range(thicknesses_mm.size):
            cosine2 = indices[i] * indices[i] - s * s
            root = np.sqrt(cosine2)
            thickness = thicknesses_mm[i] + (deeper_mm if i == thicknesses_mm.size - 1 else 0.0)
            value += thickness * s / root
            slope += thickness * indices[i] * indices[i] / (cosine2 * root)
        step = value / slope
        s = min(max(s - step, 0.0), 0.5 * (s + smallest))
        if abs(step) <= NEWTON_TOLERANCE:
            break
    return s


def exact_lateral_mm(air_slope: ArrayLike, thicknesses_mm: ArrayLike, indices: ArrayLike, air: float) -> Floats:
    """Return how far sideways a ray of given slope in air moves through plane layers: sum t_i tan(angle_i).

    The ray is the one that leaves the layers into `air` with tangent `air_slope`; n_i sin(angle_i) is conserved (Eq.
    4).
    """
    slope = np.asarray(air_slope, dtype=np.float64)[..., np.newaxis]
    index = np.asarray(indices, dtype=np.float64)
    invariant = air * slope / np.sqrt(1.0 + slope**2)
    return np.sum(np.asarray(thicknesses_mm) * invariant / np.sqrt(index**2 - invariant**2), axis=-1)
