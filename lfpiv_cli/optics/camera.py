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

from lfpiv_cli.names import ColumnAxis
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.microlenses import Lattice
from lfpiv_cli.scale import Scale


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
    origin_mm: NDArray[np.float64]
    basis_mm: NDArray[np.float64]


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

    def aberration(self, lens_mm: NDArray[np.float64], array_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far (n, 2) beside `array_mm`, where a thin lens leads, rays through `lens_mm` meet the array."""
        along = self.astigmatism_per_mm2 * np.sum(lens_mm * array_mm, axis=-1, keepdims=True)
        height2 = np.sum(array_mm**2, axis=-1, keepdims=True)
        return np.asarray(self.curvature_per_mm2 * height2 * lens_mm + along * array_mm)


@dataclass(frozen=True, eq=False)
class Camera:
    """Everything between the scene and the pixels, with a thin main lens; see `pupils` for one that is not thin.

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
    entrance_over_exit : 1/P of the lens that the thin one stands for, see `pupils`; nothing here needs it
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
    def sensor_centre_px(self) -> NDArray[np.float64]:
        """Where the optical axis meets the sensor: (column, row)."""
        return np.array([(self.columns - 1) / 2, (self.rows - 1) / 2])

    def scale(self, media: Media) -> Scale:
        """Return the camera's lengths in the scene."""
        pitch, f_number = float(self.lattice.pitch.mean()), self.image_distance_mm / self.aperture_mm
        return Scale(pitch / abs(self.magnification), pitch * f_number / self.magnification**2 / media.depth_ratio)

    def for_kernels(self) -> KernelCamera:
        """Return the camera as compiled kernels take it."""
        return KernelCamera(
            focal_length_mm=self.focal_length_mm,
            image_distance_mm=self.image_distance_mm,
            focus_distance_mm=self.focus_distance_mm,
            microlens_focal_length_mm=self.microlens_focal_length_mm,
            microlens_distance_mm=self.microlens_distance_mm,
            bend=self.bend,
            distortion_per_mm2=self.distortion_per_mm2,
            aperture_radius_mm=self.aperture_radius_mm,
            pixel_mm=self.pixel_mm,
            columns=self.columns,
            rows=self.rows,
            origin_mm=self.lattice.origin,
            basis_mm=self.lattice.basis,
        )

    def defocus(self, object_distance_mm: ArrayLike) -> NDArray[np.float64]:
        """Return alpha = 1 + s_i/s_o - s_i/F_m, the spread on the array per unit of main-lens position; 0 in focus."""
        s_i = self.image_distance_mm
        return 1.0 + s_i / np.asarray(object_distance_mm, dtype=np.float64) - s_i / self.focal_length_mm

    def px_to_mm(self, px: ArrayLike) -> NDArray[np.float64]:
        """Convert (column, row) to mm about the axis, shape (..., 2)."""
        return (np.asarray(px, dtype=np.float64) - self.sensor_centre_px) * self.pixel_mm

    def mm_to_px(self, mm: ArrayLike) -> NDArray[np.float64]:
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

    def to_image_axes(self, points_xyz: ArrayLike) -> NDArray[np.float64]:
        """Return points (..., 2 or 3) with their first two components along the columns and the rows."""
        points = np.array(points_xyz, dtype=np.float64)
        if self.column_axis == "y":
            points[..., [0, 1]] = points[..., [1, 0]]
        return points
