"""What lies between the scene and the main lens, and how rays are bent there.

A ray is straight within each plane layer; seen from the lens it comes in at a slope that is nearly proportional to how
far sideways it has moved. Paraxial rays are straight in one layer of air, from the equivalent point (Eqs. 6, 9).

Axes: z away from the camera from the nominal focal point; lateral distances from the point to the crossing of the main
lens, mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.names import Refraction, TracedMethod
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import (
    Layers,
    Media,
    Window,
    equivalent_object_distance,
    fluid_path_to_focus,
    object_space_matrix,
)
from lfpiv_cli.optics.tracing import exact_slope
from lfpiv_cli.threads import COUNT_NO_REFERENCES

# The slope of a refracted ray over its lateral distance is an analytic function of that distance squared, nearly
# constant: through five points of it, a polynomial is right to 1e-10 for lenses up to f/1.4.
SLOPE_NODES = 5


@dataclass(frozen=True)
class ObjectSpace:
    """What lies in front of the lens.

    Attributes
    ----------
    media : refractive indices
    window : the window, needed for exact refraction unless all is air, and for direct ray tracing
    refraction : paraxial, or Snell's law at each face (Eq. 4)
    method : equivalent points (ert, Eqs. 6 and 9) or rays traced through the layers (drt, Eqs. 14 and 15)
    """

    media: Media
    window: Window | None = None
    refraction: Refraction = "exact"
    method: TracedMethod = "ert"

    @property
    def straight(self) -> bool:
        """True where rays are straight from the equivalent point: paraxial refraction, or nothing but air."""
        return self.refraction == "paraxial" or self.media == self.media.in_air()

    def distance(self, camera: Camera, z_mm: ArrayLike) -> NDArray[np.float64]:
        """Return how far from the lens, in air, points at depth z appear to paraxial rays.

        Raises
        ------
        ConfigError : direct ray tracing without a window
        """
        if self.method == "ert":
            return equivalent_object_distance(z_mm, camera.focus_distance_mm, self.media)
        if self.window is None:
            raise ConfigError("direct ray tracing needs a window (its distance and thickness), none was given")
        depths = np.asarray(z_mm, dtype=np.float64)
        window = self.window
        matrices = [object_space_matrix(z, window, camera.focus_distance_mm, self.media) for z in depths.ravel()]
        return np.array([matrix[0, 1] / matrix[1, 1] for matrix in matrices]).reshape(depths.shape)

    def layers(self, camera: Camera) -> Layers:
        """Return the layers from the lens to the focal point; the last one grows with z.

        Paraxial rays and rays in air are straight in one layer, the equivalent one.

        Raises
        ------
        ConfigError : exact refraction in a fluid without a window
        """
        media = self.media
        if self.straight:
            return Layers(np.array([camera.focus_distance_mm]), np.array([media.air]))
        if self.window is None:
            raise ConfigError(f"exact refraction into a fluid of index {media.fluid} needs a window, none was given")
        path = fluid_path_to_focus(self.window, camera.focus_distance_mm, media)
        wall = self.window.thickness_mm
        if self.method == "drt":
            air = self.window.distance_mm
        else:  # what window and fluid, the only ones that aberrate, leave of the equivalent distance
            air = camera.focus_distance_mm - wall * media.air / media.window - path * media.depth_ratio
        return Layers(np.array([air, wall, path]), np.array([media.air, media.window, media.fluid]))

    def last_layers_mm(self, camera: Camera, z_mm: ArrayLike) -> NDArray[np.float64]:
        """Return how thick the last of `layers` is in front of points at depth z; not above 0 in front of the fluid.

        Raises
        ------
        ConfigError : exact refraction in a fluid without a window
        """
        growth = self.media.depth_ratio if self.straight else 1.0
        return self.layers(camera).thicknesses_mm[-1] + growth * np.asarray(z_mm, dtype=np.float64)

    def slope_polynomials(
        self, camera: Camera, z_mm: ArrayLike, reach_mm: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return nodes and factors (n, SLOPE_NODES) of `slope_ratio` for points at depths z (n,).

        Parameters
        ----------
        reach_mm : largest lateral distance from a point to where its ray crosses the main lens

        Raises
        ------
        ConfigError : a depth in front of the fluid, or no window where one is needed
        """
        depths = np.asarray(z_mm, dtype=np.float64)
        if self.straight:
            nodes, factors = np.zeros((2, depths.size, SLOPE_NODES))
            factors[:, 0] = 1.0 / self.distance(camera, depths)
            return nodes, factors
        last_layers = self.last_layers_mm(camera, depths)
        if last_layers.min() <= 0.0:
            raise ConfigError(f"a point at z = {depths.min():g} mm lies in front of the fluid")
        return _polynomials_at(last_layers, reach_mm, self.layers(camera))


@njit(cache=True)
def _polynomials_at(
    last_layers_mm: NDArray[np.float64], reach_mm: float, layers: Layers
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and factors for points behind as much of the last layer as given."""
    nodes, factors = np.empty((last_layers_mm.size, SLOPE_NODES)), np.empty((last_layers_mm.size, SLOPE_NODES))
    thicknesses = layers.thicknesses_mm.copy()
    for k in range(last_layers_mm.size):
        thicknesses[-1] = last_layers_mm[k]
        nodes[k], factors[k] = slope_polynomial(reach_mm, thicknesses, layers.indices)
    return nodes, factors


@njit(cache=True)
def slope_polynomial(
    reach_mm: float, layers: NDArray[np.float64], indices: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return nodes and divided differences of slope / lateral over lateral^2, up to the lateral distance `reach_mm`."""
    nodes = np.empty(SLOPE_NODES)
    factors = np.empty(SLOPE_NODES)
    for i in range(SLOPE_NODES):
        nodes[i] = reach_mm**2 * 0.5 * (1.0 - np.cos(np.pi * (i + 0.5) / SLOPE_NODES))
        lateral = np.sqrt(nodes[i])
        factors[i] = exact_slope(lateral, 0.0, layers, indices)[0] / lateral
    for order in range(1, SLOPE_NODES):
        for i in range(SLOPE_NODES - 1, order - 1, -1):
            factors[i] = (factors[i] - factors[i - 1]) / (nodes[i] - nodes[i - order])
    return nodes, factors


@njit(cache=True, **COUNT_NO_REFERENCES)
def slope_ratio(lateral2_mm2: float, nodes: NDArray[np.float64], factors: NDArray[np.float64]) -> float:
    """Return slope / lateral distance from `slope_polynomial`."""
    value = factors[-1]
    for i in range(SLOPE_NODES - 2, -1, -1):
        value = factors[i] + (lateral2_mm2 - nodes[i]) * value
    return value
