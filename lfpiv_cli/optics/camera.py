"""The light-field camera of Table 2: main lens, microlens array, sensor.

Image frame: (x, y) in mm about the optical axis, x along the sensor's columns, y along its rows; the axis meets the
sensor's centre, so pixel c of n columns is centred at (c - (n - 1)/2) times the pixel size. With M < 0 the image is
inverted: a point at +x lights the sensor at M x. Points are given in world axes; `to_image_axes` exchanges x and y
where the sensor's columns follow world y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.grid import Scale
from lfpiv_cli.kernels import njit
from lfpiv_cli.names import ColumnAxis, Layout
from lfpiv_cli.optics.media import Media
from lfpiv_cli.threads import share_out

# Undoing r' = r (1 + k1 r^2) by repetition: each round gains a factor 3 k1 r^2, below 0.01 for usable lenses.
UNDISTORT_ROUNDS = 6


@dataclass(frozen=True, eq=False)
class Lattice:
    """A plane lattice: point (i, j) lies at origin + i * basis[0] + j * basis[1].

    It describes the microlens array (mm about the optical axis) or the centres of its micro-images (pixels, column and
    row); each holder says which. Components are always (image x, image y), that is along the columns first.

    Attributes
    ----------
    origin : (2,) position of point (0, 0)
    basis : (2, 2) the two basis vectors as rows, the first one nearest to the direction of the columns
    layout : square (vectors at 90 degrees) or hexagonal (at 60 degrees)
    """

    origin: Floats
    basis: Floats
    layout: Layout = "square"

    @classmethod
    def regular(
        cls, pitch: float, layout: Layout = "square", rotation_rad: float = 0.0, origin: ArrayLike = (0.0, 0.0)
    ) -> Lattice:
        """Return an ideal lattice, rotated from the columns (image x) towards the rows (image y)."""
        second = (0.0, 1.0) if layout == "square" else (0.5, np.sqrt(0.75))
        cosine, sine = np.cos(rotation_rad), np.sin(rotation_rad)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        return cls(np.asarray(origin, dtype=np.float64), pitch * np.array([(1.0, 0.0), second]) @ turn, layout)

    @property
    def rotation_rad(self) -> float:
        """Angle of the lattice, from the columns towards the rows: the mean over the basis vectors."""
        ideal = Lattice.regular(1.0, self.layout).basis
        turns = np.arctan2(self.basis[:, 1], self.basis[:, 0]) - np.arctan2(ideal[:, 1], ideal[:, 0])
        return float(np.mean(np.arctan2(np.sin(turns), np.cos(turns))))

    @property
    def pitch(self) -> Floats:
        """Lengths of the two basis vectors, shape (2,)."""
        return np.hypot(self.basis[:, 0], self.basis[:, 1])

    @property
    def cell_area(self) -> float:
        """Area of the plane for each point."""
        return abs(float(np.linalg.det(self.basis)))

    def points(self, indices: ArrayLike) -> Floats:
        """Return the positions of lattice points, indices of shape (..., 2)."""
        return self.origin + np.asarray(indices, dtype=np.float64) @ self.basis

    def coordinates(self, points: ArrayLike) -> Floats:
        """Return the fractional indices of positions, shape (..., 2)."""
        return (np.asarray(points, dtype=np.float64) - self.origin) @ np.linalg.inv(self.basis)

    def nearest(self, points: ArrayLike) -> Integers:
        """Return the indices of the lattice point nearest to each position, shape (..., 2).

        Rounding the oblique coordinates is right on squares and names the wrong neighbour for one point in six on
        hexagons, so the neighbours are compared.
        """
        rounded = np.rint(self.coordinates(points)).astype(np.int64)
        steps = np.array([(i, j) for i in (0, -1, 1) for j in (0, -1, 1)])
        ways = steps @ self.basis
        off = np.asarray(points, dtype=np.float64) - self.points(rounded)
        # What a neighbour's squared distance is more by than that of the rounded one.
        more = np.sum(ways**2, axis=-1) - 2.0 * off @ ways.T
        return rounded + steps[np.argmin(more, axis=-1)]

    def scaled(self, factor: float) -> Lattice:
        """Return the lattice with all lengths multiplied by `factor` about the coordinate origin."""
        return Lattice(self.origin * factor, self.basis * factor, self.layout)

    def transformed(self, matrix: ArrayLike, shift: ArrayLike = (0.0, 0.0)) -> Lattice:
        """Return the lattice of the points `matrix @ p + shift`."""
        matrix = np.asarray(matrix, dtype=np.float64)
        return Lattice(matrix @ self.origin + np.asarray(shift), self.basis @ matrix.T, self.layout)


@njit(cache=True)
def nearest_index(x: float, y: float, origin: Floats, basis: Floats) -> tuple[float, float]:
    """Return the indices of the lattice point nearest to (x, y): `Lattice.nearest` for kernels."""
    dx = x - origin[0]
    dy = y - origin[1]
    determinant = basis[0, 0] * basis[1, 1] - basis[0, 1] * basis[1, 0]
    i0 = np.rint((dx * basis[1, 1] - dy * basis[1, 0]) / determinant)
    j0 = np.rint((dy * basis[0, 0] - dx * basis[0, 1]) / determinant)
    best = np.inf
    best_i = 0.0
    best_j = 0.0
    for di in (0.0, -1.0, 1.0):
        for dj in (0.0, -1.0, 1.0):
            px = (i0 + di) * basis[0, 0] + (j0 + dj) * basis[1, 0]
            py = (i0 + di) * basis[0, 1] + (j0 + dj) * basis[1, 1]
            distance2 = (px - dx) ** 2 + (py - dy) ** 2
            if distance2 < best:
                best = distance2
                best_i = i0 + di
                best_j = j0 + dj
    return best_i, best_j


@njit(cache=True)
def nearest_point(x: float, y: float, origin: Floats, basis: Floats) -> tuple[float, float]:
    """Return the position of the lattice point nearest to (x, y)."""
    i, j = nearest_index(x, y, origin, basis)
    return origin[0] + (i * basis[0, 0] + j * basis[1, 0]), origin[1] + (i * basis[0, 1] + j * basis[1, 1])


def nearest_on_grid(
    x: NDArray[np.floating], y: NDArray[np.floating], origin: Floats, basis: NDArray[np.floating]
) -> NDArray[np.int32]:
    """Return `Lattice.nearest` (2, rows, columns) for all places that a grid's columns x and rows y make."""
    found = np.empty((2, y.size, x.size), np.int32)
    share_out(_write_nearest, y.size, x, y, origin, basis, found)
    return found


@njit(cache=True, nogil=True)
def _write_nearest(
    part: tuple[int, int], x: Floats, y: Floats, origin: Floats, basis: Floats, found: NDArray[np.int32]
) -> None:
    """Write rows `part` of `nearest_on_grid`."""
    for row in range(part[0], part[1]):
        for column in range(x.size):
            i, j = nearest_index(x[column], y[row], origin, basis)
            found[0, row, column], found[1, row, column] = int(i), int(j)


def undistorted(
    points_mm: Floats, distortion_per_mm2: float, scale: float = 1.0, rounds: int = UNDISTORT_ROUNDS
) -> Floats:
    """Return the points (..., 2) that r' = r (scale + k1 r^2) carries to the given ones."""
    ideal = points_mm / scale
    for _ in range(rounds if distortion_per_mm2 else 0):
        ideal = points_mm / (scale + distortion_per_mm2 * np.sum(ideal**2, axis=-1, keepdims=True))
    return ideal


class KernelCamera(NamedTuple):
    """The camera as compiled kernels take it.

    Attributes
    ----------
    focal_length_mm, image_distance_mm, focus_distance_mm : F_m, s_i and F_m (M - 1)/M of the main lens
    microlens_focal_length_mm, microlens_distance_mm, bend : f_m, s_mu and 1 - s_mu/f_m of the array
    distortion_per_mm2 : k1
    aperture_radius_mm : of the main lens
    pixel_mm, columns, rows : of the sensor
    origin_mm, basis_mm : (2,), (2, 2) of the lattice of lens centres
    """

    focal_length_mm: float
    image_distance_mm: float
    focus_distance_mm: float
    microlens_focal_length_mm: float
    microlens_distance_mm: float
    bend: float
    distortion_per_mm2: float
    aperture_radius_mm: float
    pixel_mm: float
    columns: int
    rows: int
    origin_mm: Floats
    basis_mm: Floats


class Objective(NamedTuple):
    """How light departs from a thin lens before an array that is parallel to the sensor; h is the place on the array.

    Attributes
    ----------
    stop_shift : the aperture is cut by one as large, this times -h beside it on the main lens: the rim of a barrel
    falloff_per_mm2 : share of the light that is lost, times h^2
    curvature_per_mm2 : spread on the array per unit of main-lens position, times h^2
    astigmatism_per_mm2 : the same, besides, of the part of the main-lens position along h
    tilt : (along the columns, along the rows) growth of the microlenses' distance from the sensor, mm per mm
    """

    stop_shift: float = 0.0
    falloff_per_mm2: float = 0.0
    curvature_per_mm2: float = 0.0
    astigmatism_per_mm2: float = 0.0
    tilt: tuple[float, float] = (0.0, 0.0)

    def aberration(self, lens_mm: Floats, array_mm: Floats) -> Floats:
        """Return how far (n, 2) beside `array_mm`, where a thin lens leads, rays through `lens_mm` meet the array."""
        along = self.astigmatism_per_mm2 * np.sum(lens_mm * array_mm, axis=-1, keepdims=True)
        height2 = np.sum(array_mm**2, axis=-1, keepdims=True)
        return np.asarray(self.curvature_per_mm2 * height2 * lens_mm + along * array_mm)


@dataclass(frozen=True, eq=False)
class Camera:
    """Everything between the scene and the pixels, with a thin main lens; see `thin_lens` for one that is not thin.

    Attributes
    ----------
    magnification : M of the main lens, negative
    focal_length_mm, aperture_mm : F_m and the diameter p_m of the main lens
    microlens_focal_length_mm : f_m
    microlens_distance_mm : s_mu, array to sensor
    lattice : lens centres on the array, in mm about the axis, image axes
    pixel_mm : pixel pitch on the sensor
    columns, rows : sensor size in pixels
    column_axis : world axis that the sensor's columns follow
    distortion_per_mm2 : k1 of r' = r (1 + k1 r^2), about the axis, on where rays meet the array
    entrance_over_exit : 1/P of the lens that the thin one stands for, see `thin_lens`; nothing here needs it
    diffusion_px : standard deviation of the Gaussian by which charge diffuses; only what `synthetic` renders has it
    objective : how it departs from this; only what `synthetic` renders does
    """

    magnification: float
    focal_length_mm: float
    aperture_mm: float
    microlens_focal_length_mm: float
    microlens_distance_mm: float
    lattice: Lattice
    pixel_mm: float
    columns: int
    rows: int
    column_axis: ColumnAxis = "x"
    distortion_per_mm2: float = 0.0
    entrance_over_exit: float = 1.0
    diffusion_px: float = 0.0
    objective: Objective = Objective()

    @property
    def image_distance_mm(self) -> float:
        """S_i, main lens to array: F_m (1 - M)."""
        return self.focal_length_mm * (1.0 - self.magnification)

    @property
    def focus_distance_mm(self) -> float:
        """Main lens to the equivalent of the nominal focal point: F_m (M - 1)/M (Eq. 6)."""
        return self.focal_length_mm * (self.magnification - 1.0) / self.magnification

    @property
    def aperture_radius_mm(self) -> float:
        """Radius of the main lens's aperture."""
        return 0.5 * self.aperture_mm

    @property
    def bend(self) -> float:
        """What a microlens leaves of a distance from its centre on the way to the sensor, 1 - s_mu/f_m."""
        return 1.0 - self.microlens_distance_mm / self.microlens_focal_length_mm

    @property
    def micro_image_scale(self) -> float:
        """Ratio of a micro-image's centre to its lens's centre, 1 + s_mu/s_i, both from the axis."""
        return 1.0 + self.microlens_distance_mm / self.image_distance_mm

    @property
    def lens_image_width(self) -> float:
        """Diameter of a lens image over the pitch of the lenses: how the two f-numbers compare, 1 where they match."""
        return self.microlens_distance_mm / self.image_distance_mm * self.aperture_mm / float(self.lattice.pitch.mean())

    @property
    def lens_image_fill(self) -> float:
        """Diameter of a lens image over the pitch of lens images, which lie further apart than the lenses."""
        return self.lens_image_width / self.micro_image_scale

    @property
    def sensor_centre_px(self) -> Floats:
        """Where the optical axis meets the sensor: (column, row)."""
        return np.array([(self.columns - 1) / 2, (self.rows - 1) / 2])

    def scale(self, media: Media) -> Scale:
        """Return the camera's lengths in the scene."""
        pitch, f_number = float(self.lattice.pitch.mean()), self.image_distance_mm / self.aperture_mm
        return Scale(pitch / abs(self.magnification), pitch * f_number / self.magnification**2 / media.depth_ratio)

    def for_kernels(self) -> KernelCamera:
        """Return the camera as compiled kernels take it."""
        figures = [getattr(self, name) for name in KernelCamera._fields[:-2]]
        return KernelCamera._make([*figures, self.lattice.origin, self.lattice.basis])

    def defocus(self, object_distance_mm: ArrayLike) -> Floats:
        """Return alpha = 1 + s_i/s_o - s_i/F_m, the spread on the array per unit of main-lens position; 0 in focus."""
        s_i = self.image_distance_mm
        return 1.0 + s_i / np.asarray(object_distance_mm, dtype=np.float64) - s_i / self.focal_length_mm

    def px_to_mm(self, px: ArrayLike) -> Floats:
        """Convert (column, row) to mm about the axis, shape (..., 2)."""
        return (np.asarray(px, dtype=np.float64) - self.sensor_centre_px) * self.pixel_mm

    def mm_to_px(self, mm: ArrayLike) -> Floats:
        """Convert mm about the axis to (column, row), shape (..., 2)."""
        return np.asarray(mm, dtype=np.float64) / self.pixel_mm + self.sensor_centre_px

    def micro_image_lattice_px(self) -> Lattice:
        """Return the centres of the micro-images as (column, row) in pixels."""
        scale = self.micro_image_scale / self.pixel_mm
        return self.lattice.scaled(scale).transformed(np.eye(2), self.sensor_centre_px)

    def with_micro_images(self, lattice_px: Lattice) -> Camera:
        """Return the camera whose micro-images are centred on `lattice_px`: the array moves, the axis stays."""
        scale = self.pixel_mm / self.micro_image_scale
        return replace(self, lattice=lattice_px.transformed(np.eye(2), -self.sensor_centre_px).scaled(scale))

    def to_image_axes(self, points_xyz: ArrayLike) -> Floats:
        """Return points (..., 2 or 3) with their first two components along the columns and the rows."""
        points = np.array(points_xyz, dtype=np.float64)
        if self.column_axis == "y":
            points[..., [0, 1]] = points[..., [1, 0]]
        return points


# A main lens whose pupils differ in size, as the thin lens that stands for it.
#
# Seen from behind, the aperture of a real lens is P times as wide as seen from the front, and elsewhere: P > 1 of
# retrofocus lenses, P < 1 of telephoto ones; behind a lens that is telecentric towards the array the exit pupil is
# infinitely far away. Of a ray from x, at a distance s before the entrance pupil, through X in that pupil, paraxial
# optics makes
#
#     x_m = (M + beta) X - beta x,   beta = L / s,   L = F_m (1 - M/P)       its place on the array
#     (x_m / P - X) / L                                                      its slope there
#
# with the exit pupil F_m (P - M) in front of the array and the focal plane F_m (1/P - 1/M) in front of the entrance
# pupil. The first line is that of a thin lens in the place of the entrance pupil, of the same M and of the image
# distance L; its slopes, (x_m - X) / L, differ from those of the second by (1 - 1/P) x_m / L. On a plane behind the
# array that is a matter of scale: the thin lens throws the same picture on a sensor that is k times as large and k
# times as far away,
#
#     k = 1 / (1 - (1 - 1/P) s_mu / L)
#
# pixel by pixel. So a camera with a thin lens stands for the real one exactly, and nothing in the scene changes:
# depths, refraction, the diameter of the entrance pupil. (What a distortion, which moves rays on the array and leaves
# their directions alone, does on the sensor is off by k - 1 of itself.) All is written by 1/P, which is 0 for a
# telecentric lens and 1 for a thin one.


def thin_lens(real: Camera, entrance_over_exit: float) -> Camera:
    """Return the camera whose thin lens stands for a main lens with pupils.

    Parameters
    ----------
    real : with the lengths of the real lens, sensor and array
    entrance_over_exit : 1/P, diameter of the entrance pupil over that of the exit pupil
    """
    magnification = real.magnification
    narrowing = (1.0 - magnification * entrance_over_exit) / (1.0 - magnification)
    focal_length = real.focal_length_mm * narrowing
    lever = real.microlens_distance_mm / (focal_length * (1.0 - magnification))
    larger = 1.0 / (1.0 - (1.0 - entrance_over_exit) * lever)
    return replace(
        real,
        focal_length_mm=focal_length,
        microlens_distance_mm=real.microlens_distance_mm * larger,
        pixel_mm=real.pixel_mm * larger,
        entrance_over_exit=entrance_over_exit,
    )


def real_lens(thin: Camera) -> Camera:
    """Return the camera with the lengths of the real lens, sensor and array: the way back from `thin_lens`."""
    narrowing = (1.0 - thin.magnification * thin.entrance_over_exit) / (1.0 - thin.magnification)
    larger = 1.0 + (1.0 - thin.entrance_over_exit) * thin.microlens_distance_mm / thin.image_distance_mm
    return replace(
        thin,
        focal_length_mm=thin.focal_length_mm / narrowing,
        microlens_distance_mm=thin.microlens_distance_mm / larger,
        pixel_mm=thin.pixel_mm / larger,
    )


def with_entrance_pupil(camera: Camera, distance_mm: float) -> Camera:
    """Return the camera with its entrance pupil so far from the focal plane's equivalent in air: F_m (1/P - 1/M)."""
    real = real_lens(camera)
    return thin_lens(real, distance_mm / real.focal_length_mm + 1.0 / real.magnification)


def refocused(camera: Camera, magnification: float) -> Camera:
    """Return the camera with the same lens at another magnification."""
    return thin_lens(replace(real_lens(camera), magnification=magnification), camera.entrance_over_exit)
