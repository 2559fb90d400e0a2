"""Refocused pictures: the light of pixels carried back along their rays to a plane of the scene and added up there.

Axes: pictures are [row, column], centred on the optical axis, x and y growing with columns and rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.calibration.dot_model import PixelRays, lens_crossings, pixel_rays, scene_points
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media


@dataclass(frozen=True, eq=False)
class Refocusing:
    """Pixels and the samples of the planes that their light is carried to.

    Attributes
    ----------
    camera : with the lattice of the rectified frame
    media : what lies before the planes
    rays : of the pixels
    through : (n,) which of the rays pass the main lens
    sample_mm : side of a sample
    half : rows and columns of samples on either side of the axis
    """

    camera: Camera
    media: Media
    rays: PixelRays
    through: NDArray[np.bool_]
    sample_mm: float
    half: tuple[int, int]

    @classmethod
    def of(
        cls,
        camera: Camera,
        media: Media,
        pixels: tuple[NDArray[np.int64], NDArray[np.int64]],
        samples_per_lens: int,
        half_width: float,
    ) -> Refocusing:
        """Return the refocusing of pixels (row, column), (n,) each.

        Parameters
        ----------
        samples_per_lens : samples in the width of a microlens
        half_width : of the pictures to either side of the axis, in widths of the sensor as the focal plane has it
        """
        row, column = pixels
        rays = pixel_rays(camera, column, row)
        through = np.hypot(*lens_crossings(rays, camera).T) <= camera.aperture_radius_mm
        sample_mm = float(camera.lattice.pitch.min()) / samples_per_lens / abs(camera.magnification)
        size = np.array([camera.rows, camera.columns]) * camera.pixel_mm / abs(camera.magnification)
        rows, columns = np.ceil(half_width * size / sample_mm).astype(int)
        return cls(camera, media, rays, through, sample_mm, (int(rows), int(columns)))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the pictures; the middle sample lies on the axis."""
        return 2 * self.half[0] + 1, 2 * self.half[1] + 1

    def pictures(
        self, z_mm: float, light: tuple[NDArray[np.float64], ...], smoothing: float
    ) -> list[NDArray[np.float64]]:
        """Return what each kind of the pixels' light (n,) makes on the plane at a depth.

        Parameters
        ----------
        smoothing : standard deviation of the Gaussian that softens the pictures, in samples
        """
        points = scene_points(self.rays, self.camera, self.media, z_mm)
        place = np.rint(points[:, ::-1] / self.sample_mm).astype(np.int64) + self.half
        seen = self.through & ((place >= 0) & (place < self.shape)).all(axis=1)
        flat = np.ravel_multi_index(tuple(place[seen].T), self.shape)
        length = self.shape[0] * self.shape[1]
        # bincount makes whole numbers of no light at all
        sums = [np.bincount(flat, values[seen], minlength=length).astype(np.float64) for values in light]
        return [ndimage.gaussian_filter(each.reshape(self.shape), smoothing) for each in sums]
