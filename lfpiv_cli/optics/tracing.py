"""Ray-by-ray tracing from a point in the scene to the sensor: the reference for everything that is computed otherwise.

Axes: image axes (x along the columns, y along the rows, see `camera`), z away from the camera from the nominal focal
point. A ray is named by the point it starts from and by where it crosses the main lens; it fails by flag, never by
exception.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.names import Refraction, TracedMethod
from lfpiv_cli.optics.camera import Camera, KernelCamera, nearest_point
from lfpiv_cli.optics.media import (
    Layers,
    Media,
    Window,
    equivalent_object_distance,
    fluid_path_to_focus,
    object_space_matrix,
    snell_invariant,
)

# Rays as a polynomial has them: where they meet the microlens array, fitted instead of traced.
#
# Direct light-field calibration (DLFC, Hall et al. 2018) knows no main lens and no window: it has seen dots at known
# places through known points of the aperture, and a polynomial of both tells where any other ray goes.

# x, y, z of where a ray starts, X, Y of where it crosses the main lens.
VARIABLES = 5
# Of degree 3 a polynomial has 56 terms, and lenses need no more.
LARGEST_DEGREE = 3


@dataclass(frozen=True, eq=False)
class PolynomialRays:
    """Where rays meet the array, as polynomials of where they come from and cross the main lens.

    Attributes
    ----------
    scale_mm : (5,) what x, y, z, X, Y are divided by
    exponents : (terms, 5) int64
    coefficients_mm : (terms, 2) of both coordinates on the array
    """

    scale_mm: Floats
    exponents: Integers
    coefficients_mm: Floats

    @property
    def degree(self) -> int:
        """Largest sum of exponents."""
        return int(self.exponents.sum(axis=1).max(initial=0))

    def on_array(self, start_mm: ArrayLike, crossing_mm: ArrayLike) -> Floats:
        """Return where rays from (n, 3) through (n, 2) meet the array, (n, 2)."""
        rays = np.concatenate([np.atleast_2d(start_mm), np.atleast_2d(crossing_mm)], axis=1) / self.scale_mm
        return np.ascontiguousarray(polynomial_terms(rays, self.exponents)) @ self.coefficients_mm


def polynomial_terms(variables: Floats, exponents: Integers) -> Floats:
    """Return each term (n, terms) of variables (n, k), by the exponents (terms, k)."""
    powers = variables[:, :, np.newaxis] ** np.arange(exponents.max(initial=0) + 1)
    terms = powers[:, 0, exponents[:, 0]]
    for k in range(1, variables.shape[1]):
        terms = terms * powers[:, k, exponents[:, k]]
    return terms


@cache
def complete_exponents(degree: int, *highest: int) -> Integers:
    """Return the exponents of all terms up to a degree, of `VARIABLES` variables or of each up to a highest power.

    Of five variables there are 21 of degree 2 and 56 of degree 3.
    """
    all_of_them = product(*(range(power + 1) for power in highest or VARIABLES * [degree]))
    return np.array([powers for powers in all_of_them if sum(powers) <= degree], dtype=np.int64)


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays ended.

    Attributes
    ----------
    sensor_mm : (n, 2) on the sensor, image axes
    array_mm : (n, 2) on the microlens array
    lens_mm : (n, 2) centre of the microlens that was struck
    valid : (n,) the ray passes the aperture
    """

    sensor_mm: Floats
    array_mm: Floats
    lens_mm: Floats
    valid: Flags


@njit(cache=True, **COUNT_NO_REFERENCES)
def exact_slope(
    dx: float, dy: float, thicknesses_mm: Floats, indices: Floats, deeper_mm: float = 0.0
) -> tuple[float, float]:
    """Return the slopes in the first layer of the ray that moves (dx, dy) sideways through the layers.

    The last of them is by `deeper_mm` thicker.
    """
    lateral = np.sqrt(dx * dx + dy * dy)
    if lateral == 0.0:
        return 0.0, 0.0
    invariant = snell_invariant(lateral, thicknesses_mm, indices, deeper_mm)
    tangent = invariant / np.sqrt(indices[0] * indices[0] - invariant * invariant)
    return tangent * dx / lateral, tangent * dy / lateral


def trace(camera: Camera, lens: ArrayLike, slopes: ArrayLike) -> Hits:
    """Trace rays from the main lens to the sensor (Eq. 1).

    Parameters
    ----------
    lens : (n, 2) where the rays cross the main lens, mm
    slopes : (n, 2) their tangents in air in front of it

    Notes
    -----
    The main lens turns the slope by -X/F_m; at the array the microlens that is struck, the nearest one, turns it by
    -(x_m - s_u)/f_m. The distortion moves the point on the array before the lens is chosen and leaves directions alone.
    """
    crossing = np.asarray(lens, dtype=np.float64)
    behind = np.asarray(slopes, dtype=np.float64) - crossing / camera.focal_length_mm
    array = crossing + camera.image_distance_mm * behind
    array = array * (1.0 + camera.distortion_per_mm2 * np.sum(array**2, axis=1, keepdims=True))
    centre = camera.lattice.points(camera.lattice.nearest(array))
    sensor = array + camera.microlens_distance_mm * (behind - (array - centre) / camera.microlens_focal_length_mm)
    valid = np.hypot(crossing[:, 0], crossing[:, 1]) <= camera.aperture_radius_mm
    return Hits(sensor, array, centre, valid)


@njit(cache=True)
def trace_ray(
    camera: KernelCamera, lens_x: float, lens_y: float, slope_x: float, slope_y: float
) -> tuple[float, float]:
    """Return where one ray strikes the sensor, mm: `trace` for kernels."""
    behind_x = slope_x - lens_x / camera.focal_length_mm
    behind_y = slope_y - lens_y / camera.focal_length_mm
    x = lens_x + camera.image_distance_mm * behind_x
    y = lens_y + camera.image_distance_mm * behind_y
    stretch = 1.0 + camera.distortion_per_mm2 * (x * x + y * y)
    x *= stretch
    y *= stretch
    centre_x, centre_y = nearest_point(x, y, camera.origin_mm, camera.basis_mm)
    return behind_microlens(camera, x, centre_x, behind_x), behind_microlens(camera, y, centre_y, behind_y)


@njit(cache=True)
def behind_microlens(camera: KernelCamera, place: float, centre: float, slope: float) -> float:
    """Return one coordinate on the sensor of a ray that meets the array at `place` under the microlens at `centre`.

    The last part of Eq. 1; `slope` is the ray's between main lens and array.
    """
    return place + camera.microlens_distance_mm * (slope - (place - centre) / camera.microlens_focal_length_mm)


@njit(cache=True)
def struck_pixel(camera: KernelCamera, x: float, y: float) -> int:
    """Return the flat number of the pixel at a place on the sensor, mm; -1 off the sensor."""
    column = int(np.floor(x / camera.pixel_mm + 0.5 * camera.columns))
    row = int(np.floor(y / camera.pixel_mm + 0.5 * camera.rows))
    return row * camera.columns + column if 0 <= column < camera.columns and 0 <= row < camera.rows else -1


def disc_points(count: int, radius: float, rng: np.random.Generator) -> Floats:
    """Return `count` random points (n, 2), uniform over a disc."""
    r = radius * np.sqrt(rng.random(count))
    angle = 2.0 * np.pi * rng.random(count)
    return np.stack([r * np.cos(angle), r * np.sin(angle)], axis=1)


# What lies between the scene and the main lens, and how rays are bent there.
#
# A ray is straight within each plane layer; seen from the lens it comes in at a slope that is nearly proportional to
# how far sideways it has moved. Paraxial rays are straight in one layer of air, from the equivalent point (Eqs. 6,
# 9). Lateral distances are those from the point to the crossing of the main lens.

# The slope of a refracted ray over its lateral distance is an analytic function of that distance squared, nearly
# constant: through five points of it, a polynomial is right to 1e-10 for lenses up to f/1.4.
SLOPE_NODES = 5
# Just behind the window is so far behind its face, in depths over which light spreads by one lens.
SHALLOWEST_DEPTHS = 1e-6


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

    def distance(self, camera: Camera, z_mm: ArrayLike) -> Floats:
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

    def last_layers_mm(self, camera: Camera, z_mm: ArrayLike) -> Floats:
        """Return how thick the last of `layers` is in front of points at depth z; not above 0 in front of the fluid.

        Raises
        ------
        ConfigError : exact refraction in a fluid without a window
        """
        growth = self.media.depth_ratio if self.straight else 1.0
        return self.layers(camera).thicknesses_mm[-1] + growth * np.asarray(z_mm, dtype=np.float64)

    def slope_polynomials(self, camera: Camera, z_mm: ArrayLike, reach_mm: float) -> tuple[Floats, Floats]:
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

    def slopes(self, camera: Camera, points_mm: ArrayLike, crossing_mm: Floats) -> tuple[Floats, Flags]:
        """Return the slopes (n, 2) at the lens of the rays from points (n, 3) that cross it at (n, 2): all of them do.

        Raises
        ------
        ConfigError : a point in front of the fluid, or no window where one is needed
        """
        points = np.atleast_2d(np.asarray(points_mm, dtype=np.float64))
        reach = camera.aperture_radius_mm + float(np.hypot(points[:, 0], points[:, 1]).max())
        lateral = crossing_mm - points[:, :2]
        lateral2 = lateral[:, :1] ** 2 + lateral[:, 1:] ** 2
        ratio = slope_ratios(lateral2, *self.slope_polynomials(camera, points[:, 2], reach))
        return ratio * lateral, np.ones(len(lateral), dtype=np.bool_)


@njit(cache=True, **COUNT_NO_REFERENCES)
def shallowest_mm(layers: Layers, depth_mm: float) -> float:
    """Return the depth just behind the window: what is sought in front of it lights like what is there.

    Parameters
    ----------
    depth_mm : over which light spreads by one lens
    """
    return SHALLOWEST_DEPTHS * depth_mm - float(layers.thicknesses_mm[-1])


@njit(cache=True)
def _polynomials_at(last_layers_mm: Floats, reach_mm: float, layers: Layers) -> tuple[Floats, Floats]:
    """Return nodes and factors for points behind as much of the last layer as given."""
    nodes, factors = np.empty((last_layers_mm.size, SLOPE_NODES)), np.empty((last_layers_mm.size, SLOPE_NODES))
    for k in range(last_layers_mm.size):
        set_slope_polynomial(reach_mm, layers, last_layers_mm[k] - layers.thicknesses_mm[-1], nodes[k], factors[k])
    return nodes, factors


@njit(cache=True, **COUNT_NO_REFERENCES)
def set_slope_polynomial(reach_mm: float, layers: Layers, deeper_mm: float, nodes: Floats, factors: Floats) -> None:
    """Fill in nodes and divided differences of slope / lateral over lateral^2, up to the lateral distance `reach_mm`.

    The last layer is by `deeper_mm` thicker.
    """
    for i in range(SLOPE_NODES):
        nodes[i] = reach_mm**2 * 0.5 * (1.0 - np.cos(np.pi * (i + 0.5) / SLOPE_NODES))
        lateral = np.sqrt(nodes[i])
        factors[i] = exact_slope(lateral, 0.0, layers.thicknesses_mm, layers.indices, deeper_mm)[0] / lateral
    for order in range(1, SLOPE_NODES):
        for i in range(SLOPE_NODES - 1, order - 1, -1):
            factors[i] = (factors[i] - factors[i - 1]) / (nodes[i] - nodes[i - order])


@njit(cache=True, **COUNT_NO_REFERENCES)
def slope_ratio(lateral2_mm2: float, nodes: Floats, factors: Floats) -> float:
    """Return slope / lateral distance from `set_slope_polynomial`."""
    value = factors[-1]
    for i in range(SLOPE_NODES - 2, -1, -1):
        value = factors[i] + (lateral2_mm2 - nodes[i]) * value
    return value


def slope_ratios(lateral2_mm2: Floats, nodes: Floats, factors: Floats) -> Floats:
    """Return `slope_ratio` of lateral distances squared that spread against nodes (n, SLOPE_NODES), one row a point."""
    values = factors[:, -1:] + np.zeros_like(lateral2_mm2)
    for i in range(SLOPE_NODES - 2, -1, -1):
        values = factors[:, i : i + 1] + (lateral2_mm2 - nodes[:, i : i + 1]) * values
    return values


# How far paraxial optics is from the truth at the rim of the aperture, in light's place on the array.
#
# Two things bend the outer rays more than the equivalent point does: Snell's law at the faces of window and fluid,
# and the lens itself, which images a volume's points only if it keeps the sines of the angles, not the tangents of a
# thin lens (Abbe's condition). Both are worst for points off the focal plane, or deep in the fluid; here they lie on
# the axis.

# Light that is further off falls into another pixel. The paper's channel and the sample are off by a tenth of this, its
# simulation behind 134 mm of water by twice this.
LARGEST_ERROR_PX = 0.5
# A thin lens makes depths wrong by as large a share as the rim's ray at most, of which less does no harm.
LARGEST_DEPTH_ERROR = 0.01


def refraction_error_mm(camera: Camera, media: Media, window: Window | None, depths_mm: Floats) -> float:
    """Return how far from a paraxial ray's the place of a refracted one on the array is at most, at the rim.

    Parameters
    ----------
    window : what is before the fluid; None: not known, the fluid begins at the nearest of the depths
    depths_mm : of points on the axis; those in front of the fluid do not count
    """
    if window is None:
        window = Window(camera.focus_distance_mm + depths_mm.min() * media.depth_ratio, 0.0)
    exact = ObjectSpace(media, window, "exact")
    rim, layers = camera.aperture_radius_mm, exact.layers(camera)
    thicknesses, last = layers.thicknesses_mm.copy(), exact.last_layers_mm(camera, depths_mm)
    paraxial = rim / equivalent_object_distance(depths_mm, camera.focus_distance_mm, media)
    error = 0.0
    for thickness, slope in zip(last, paraxial, strict=True):
        if thickness > 0.0:
            thicknesses[-1] = thickness
            error = max(error, abs(exact_slope(rim, 0.0, thicknesses, layers.indices)[0] - slope))
    return camera.image_distance_mm * error


def rim_tangent(camera: Camera) -> float:
    """Return the tangent of the angle under which the rim of the lens is seen from the focal point, in air."""
    return camera.aperture_radius_mm / camera.focus_distance_mm


def sine_error_mm(camera: Camera, media: Media, depths_mm: Floats) -> float:
    """Return how far a thin lens is at most from one that keeps sines, in the place of a rim ray on the array."""
    tangent = rim_tangent(camera)
    defocus = media.depth_ratio * float(np.abs(depths_mm).max())
    return abs(camera.magnification) * defocus * (tangent - tangent / np.hypot(1.0, tangent))
