"""Rays of small glowing balls: evenly spread sequences of them, what a real objective does to them, and curved faces.

For one ball the slope at the lens is a smooth function of four numbers: where the ray crosses the lens and where in the
ball it starts, seen along the axis. A polynomial in these is fitted to exact rays of each ball through curved faces and
tried on others; where it is not right within `TOLERANCE_MM`, close to where light grazes a wall, every ray is aimed for
itself.

Axes: image axes, mm about the optical axis, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq
from scipy.special import ndtri

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.optics.camera import Camera, KernelCamera, Objective
from lfpiv_cli.optics.curved_space import CurvedSpace, aim, aim_all
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.optics.tracing import struck_pixel, trace_ray

# Additive recurrence in four dimensions (aperture and ball): powers of the inverse of the root of x^5 = x + 1, whose
# multiples fill the unit cube more evenly than random points do.
SEQUENCE = 1.1673039782614187 ** -np.arange(1.0, 5.0)

# Another one, by the root of x^7 = x + 1, for what moves a ray's end: it goes with none of the numbers above.
BLUR_SEQUENCE = 1.1127756842787 ** -np.arange(1.0, 7.0)
# Pairs of ends that rays take in turn, opposite to each other: a blur moves no light as a whole.
BLUR_PAIRS = 8_192
# The turn from one point of a sunflower to the next.
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@njit(cache=True)
def ray_places(shifts: Floats, i: int, k: int) -> tuple[float, float, float, float]:
    """Return ray k of ball i as `on_disc` and `in_ball` take it, the first two numbers and the last ones."""
    return (
        shifts[i, 0] + k * SEQUENCE[0],
        shifts[i, 1] + k * SEQUENCE[1],
        shifts[i, 2] + k * SEQUENCE[2],
        shifts[i, 3] + k * SEQUENCE[3],
    )


@njit(cache=True)
def on_disc(radius: float, radial: float, turn: float) -> tuple[float, float]:
    """Return the point of an evenly filled disc for two numbers, evenly spread between any integers."""
    r = radius * np.sqrt(radial % 1.0)
    return r * np.cos(2.0 * np.pi * turn), r * np.sin(2.0 * np.pi * turn)


@njit(cache=True)
def in_ball(radius: float, radial: float, turn: float) -> tuple[float, float]:
    """Return a point of an evenly filled ball, seen along the axis: the share 1 - (1 - r^2/R^2)^(3/2) lies within r."""
    r = radius * np.sqrt(1.0 - (radial % 1.0) ** (2.0 / 3.0))
    return r * np.cos(2.0 * np.pi * turn), r * np.sin(2.0 * np.pi * turn)


@njit(cache=True)
def blur_place(shifts: Floats, i: int, k: int, count: int) -> int:
    """Return which of `count` places ray k of ball i takes beside where it would end."""
    return (int(shifts[i, 0] * count) + k) % count


def diffused_mm(camera: Camera) -> Floats:
    """Return places (n, 2) on the sensor beside a ray's end to which charge diffuses: one, 0, where it does not."""
    if camera.diffusion_px == 0.0:
        return np.zeros((1, 2))
    return in_pairs(camera.diffusion_px * camera.pixel_mm * ndtri(blur_numbers()[:, :2]))


def blur_numbers() -> Floats:
    """Return numbers (`BLUR_PAIRS`, 6) that fill the open unit cube evenly."""
    return ((np.arange(BLUR_PAIRS) + 0.5)[:, np.newaxis] * BLUR_SEQUENCE) % 1.0


def in_pairs(places: Floats) -> Floats:
    """Return places (n, 2), each followed by the opposite one."""
    return np.stack([places, -places], axis=1).reshape(-1, 2)


# What a real objective, and an array that is not parallel to the sensor, do to rays; see `optics.camera.Objective`.


def objective_of(
    camera: Camera,
    *,
    vignetting: float = 0.0,
    falloff: float = 0.0,
    field_curvature_mm: float = 0.0,
    astigmatism_mm: float = 0.0,
    array_tilt_deg: tuple[float, float] = (0.0, 0.0),
) -> Objective:
    """Return an objective by what it does in the corners of the sensor.

    Parameters
    ----------
    vignetting, falloff : shares of the aperture that is cut off, and of the light that is lost besides
    field_curvature_mm, astigmatism_mm : how far behind the array the image lies, and how much further the one of the
        aperture's radial diameter
    array_tilt_deg : angles by which the microlenses' distance grows along the columns and the rows
    """
    corner = 0.5 * camera.pixel_mm * float(np.hypot(camera.columns, camera.rows))
    per_mm2 = 1.0 / corner**2
    # how far apart, in diameters, two circles are that have what is not cut off of their area in common
    apart = 0.0
    if vignetting != 0.0:
        apart = float(
            brentq(lambda u: 2.0 / np.pi * (np.arccos(u) - u * np.sqrt(1.0 - u * u)) - (1.0 - vignetting), 0.0, 1.0)
        )
    along_columns, along_rows = np.tan(np.deg2rad(array_tilt_deg)).tolist()
    return Objective(
        stop_shift=camera.aperture_mm * apart / corner,
        falloff_per_mm2=falloff * per_mm2,
        curvature_per_mm2=field_curvature_mm / camera.image_distance_mm * per_mm2,
        astigmatism_per_mm2=astigmatism_mm / camera.image_distance_mm * per_mm2,
        tilt=(along_columns, along_rows),
    )


def passed_light(camera: Camera) -> Floats:
    """Return the share (rows, columns) of the light that falloff leaves."""
    x, y = camera.px_to_mm(np.stack(np.meshgrid(np.arange(camera.columns), np.arange(camera.rows)), axis=-1)).T
    return np.asarray(np.maximum(1.0 - camera.objective.falloff_per_mm2 * (x**2 + y**2), 0.0).T)


@njit(cache=True)
def passes_barrel(camera: KernelCamera, objective: Objective, X: float, Y: float, x: float, y: float) -> bool:
    """Return whether a ray through (X, Y) of the main lens to the place (x, y) on the array passes both apertures."""
    beside_x, beside_y = X + objective.stop_shift * x, Y + objective.stop_shift * y
    furthest2 = max(X * X + Y * Y, beside_x * beside_x + beside_y * beside_y)
    return furthest2 <= camera.aperture_radius_mm * camera.aperture_radius_mm


@njit(cache=True)
def trace_real_ray(
    camera: KernelCamera, objective: Objective, X: float, Y: float, slope_x: float, slope_y: float
) -> tuple[float, float, bool]:
    """Return where a ray that crosses the main lens at (X, Y) strikes the sensor, mm, and whether it passes."""
    x = X + camera.image_distance_mm * (slope_x - X / camera.focal_length_mm)
    y = Y + camera.image_distance_mm * (slope_y - Y / camera.focal_length_mm)
    curved = objective.curvature_per_mm2 * (x * x + y * y)
    along = objective.astigmatism_per_mm2 * (X * x + Y * y)
    off_x, off_y = curved * X + along * x, curved * Y + along * y
    on_x, on_y = trace_ray(
        camera, X, Y, slope_x + off_x / camera.image_distance_mm, slope_y + off_y / camera.image_distance_mm
    )
    x, y = x + off_x, y + off_y
    passes = passes_barrel(camera, objective, X, Y, x, y)
    stretch = 1.0 + camera.distortion_per_mm2 * (x * x + y * y)
    x, y = stretch * x, stretch * y
    further = (objective.tilt[0] * x + objective.tilt[1] * y) / camera.microlens_distance_mm
    return on_x + further * (on_x - x), on_y + further * (on_y - y), passes


# Rays through curved faces.

# Balls are small, the lens is not: degree of the polynomial in the place on the lens, by that in the place in the ball.
# In a tube of 10 mm seen by an f/4 lens 97 of 100 balls of 50 um then need no rays of their own.
LENS_DEGREES = (5, 3, 2, 0)
# Terms of the lens' place up to a degree.
TERMS_TO_DEGREE = (1, 3, 6, 10, 15, 21)
TERMS = sum((order + 1) * TERMS_TO_DEGREE[degree] for order, degree in enumerate(LENS_DEGREES))
# Rays that are aimed for a ball's polynomial, three for each term, and those that it is tried on.
FITTED, TRIED = 3 * TERMS, 64
# On the microlens array, in front of pixels of some 5 um. Between the rays that are tried it may err by twice this.
TOLERANCE_MM = 5e-7
# A tracer is seen where a ray from it reaches one of so many places on the lens.
LENS_PLACES = 24


@njit(cache=True, nogil=True)
def trace_curved(
    part: tuple[int, int],
    placed: tuple[Floats, Floats, Floats],
    between: tuple[Faces, tuple[Floats, Floats]],
    camera: KernelCamera,
    objective: Objective,
    blur_mm: Floats,
    pixels: NDArray[np.int32],
) -> None:
    """Write the flat pixel number that each ray of the balls `part` strikes, (n, rays), -1 off the sensor or lost.

    Parameters
    ----------
    placed : all balls' centres, their radii, and the shifts of their rays
    between : the faces, and what `fit_of_slopes` gives
    blur_mm : (m, 2) what rays take in turn to end beside where they would
    """
    (points, radii, shifts), (faces, fit) = placed, between
    aperture_radius = camera.aperture_radius_mm
    terms = np.empty(TERMS)
    for i in range(part[0], part[1]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        coefficients, fits = fitted_slopes(x, y, z, radii[i], faces, camera, fit)
        for k in range(pixels.shape[1]):
            radial, turn, ball_radial, ball_turn = ray_places(shifts, i, k)
            lens_x, lens_y = on_disc(1.0, radial, turn)
            ball_x, ball_y = in_ball(1.0, ball_radial, ball_turn)
            X, Y = aperture_radius * lens_x, aperture_radius * lens_y
            if fits:
                write_terms(lens_x, lens_y, ball_x, ball_y, terms)
                slope_x, slope_y = _sum_of_terms(terms, coefficients)
            else:
                slope_x, slope_y, leaves = aim(faces, x + radii[i] * ball_x, y + radii[i] * ball_y, z, X, Y)
                if not leaves:
                    pixels[i, k] = -1
                    continue
            on_x, on_y, passes = trace_real_ray(camera, objective, X, Y, slope_x, slope_y)
            beside = blur_place(shifts, i, k, blur_mm.shape[0])
            struck = struck_pixel(camera, on_x + blur_mm[beside, 0], on_y + blur_mm[beside, 1])
            pixels[i, k] = struck if passes else -1


@njit(cache=True)
def fitted_slopes(
    x: float, y: float, z: float, radius: float, faces: Faces, camera: KernelCamera, fit: tuple[Floats, Floats]
) -> tuple[Floats, bool]:
    """Return the coefficients (TERMS, 2) of a ball's slopes, and whether they are right within the tolerance."""
    places, inverse = fit
    coefficients = np.zeros((TERMS, 2))
    start, crossing = np.empty((FITTED + TRIED, 3)), camera.aperture_radius_mm * places[:, :2]
    for k in range(FITTED + TRIED):
        start[k, 0], start[k, 1], start[k, 2] = x + radius * places[k, 2], y + radius * places[k, 3], z
    slopes, leaves = aim_all(faces, start, crossing)
    if not leaves.all():
        return coefficients, False
    for term in range(TERMS):
        for k in range(FITTED):
            coefficients[term, 0] += inverse[term, k] * slopes[k, 0]
            coefficients[term, 1] += inverse[term, k] * slopes[k, 1]
    terms = np.empty(TERMS)
    for k in range(FITTED, FITTED + TRIED):
        write_terms(places[k, 0], places[k, 1], places[k, 2], places[k, 3], terms)
        fitted_x, fitted_y = _sum_of_terms(terms, coefficients)
        error = max(abs(fitted_x - slopes[k, 0]), abs(fitted_y - slopes[k, 1]))
        if error * camera.image_distance_mm > TOLERANCE_MM:
            return coefficients, False
    return coefficients, True


@njit(cache=True, **COUNT_NO_REFERENCES)
def write_terms(lens_x: float, lens_y: float, ball_x: float, ball_y: float, terms: Floats) -> None:
    """Write the polynomial's terms (TERMS,) at a place on the lens and in the ball, both in units of their radius."""
    # the lens' terms by their degree, each of one degree less times x, and the last one times y
    terms[0] = 1.0
    done = 1
    for degree in range(1, len(TERMS_TO_DEGREE)):
        for k in range(degree):
            terms[done + k] = lens_x * terms[done - degree + k]
        terms[done + degree] = lens_y * terms[done - 1]
        done += degree + 1
    for order in range(1, len(LENS_DEGREES)):
        count = TERMS_TO_DEGREE[LENS_DEGREES[order]]
        for power in range(order + 1):
            ball = ball_x ** (order - power) * ball_y**power
            for k in range(count):
                terms[done + k] = ball * terms[k]
            done += count


@njit(cache=True, **COUNT_NO_REFERENCES)
def _sum_of_terms(terms: Floats, coefficients: Floats) -> tuple[float, float]:
    """Return the slopes along both axes."""
    x = y = 0.0
    for k in range(TERMS):
        x += terms[k] * coefficients[k, 0]
        y += terms[k] * coefficients[k, 1]
    return x, y


@cache
def fit_of_slopes() -> tuple[Floats, Floats]:
    """Return places on lens and ball (FITTED + TRIED, 4), and what makes coefficients of the slopes at the first ones.

    The second array (TERMS, FITTED) is the terms' pseudo-inverse, the same for all balls.
    """
    places = np.empty((FITTED + TRIED, 4))
    terms = np.empty((FITTED, TERMS))
    start = np.zeros((1, 4))
    for k in range(len(places)):
        radial, turn, ball_radial, ball_turn = ray_places(start, 0, k)
        places[k] = *on_disc(1.0, radial, turn), *on_disc(1.0, ball_radial, ball_turn)
        if k < FITTED:
            write_terms(*places[k], terms[k])
    return places, np.asarray(np.linalg.pinv(terms), dtype=np.float64)


def unseen(camera: Camera, space: CurvedSpace, points_mm: ArrayLike) -> Flags:
    """Return which points (n, 3), world axes, no ray leads from to the lens: not in the fluid, or behind a rim."""
    points = camera.to_image_axes(points_mm).reshape(-1, 3)
    is_unseen = np.ones(len(points), dtype=np.bool_)
    for k in range(LENS_PLACES):
        radial, turn, _, _ = ray_places(np.zeros((1, 4)), 0, k)
        place = np.array(on_disc(camera.aperture_radius_mm, radial, turn))
        left = np.flatnonzero(is_unseen)
        is_unseen[left] = ~space.slopes(camera, points[left], np.tile(place, (left.size, 1)))[1]
    return is_unseen
