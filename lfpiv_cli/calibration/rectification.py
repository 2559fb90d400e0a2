"""Images as an upright lattice would have made them: rotation, shear and distortion of the lens images taken out.

Axes: (column, row) in pixels and angles from the columns towards the rows. The rectified frame is the raw one turned
back about the sensor's centre, the optical axis, by the lattice's rotation; the origin of the lattice turns along, so
that directions in the scene turn by the same angle, inverted image or not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage

from lfpiv_cli.arrays import EVERYWHERE, Flags, Floats, Integers, Singles
from lfpiv_cli.calibration.lattice import EXPONENTS, LatticeFit
from lfpiv_cli.errors import InputError
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.names import ColumnAxis
from lfpiv_cli.optics.camera import Lattice, nearest_point
from lfpiv_cli.optics.line_responses import spline_weights
from lfpiv_cli.threads import blocks, in_threads, share_out

# A pixel counts in the coefficients of a cubic spline so far away by less than rounding of single precision.
SPLINE_REACH_PX = 16
# Lines of an image that a thread filters at a time.
LINES = 512


@dataclass(frozen=True, eq=False)
class Rectification:
    """How raw pixels are carried into the frame of an upright lattice.

    Attributes
    ----------
    fit : the lattice of the raw image
    image_shape : (rows, columns)
    """

    fit: LatticeFit
    image_shape: tuple[int, int]

    @property
    def rotation_rad(self) -> float:
        """Angle that is taken out, from the columns towards the rows."""
        return self.fit.lattice_px.rotation_rad

    @cached_property
    def lattice_px(self) -> Lattice:
        """The upright lattice of the rectified frame: mean pitch along each axis, shear and distortion gone."""
        raw = self.fit.lattice_px
        centre = (np.array(self.image_shape[::-1]) - 1.0) / 2.0
        origin = centre + turn_matrix(-self.rotation_rad) @ (raw.origin - centre)
        along = float(raw.pitch[0])
        height = float(np.linalg.det(raw.basis)) / along
        side = 0.0 if raw.layout == "square" else 0.5 * along
        return Lattice(origin, np.array([[along, 0.0], [side, height]]), raw.layout)

    @cached_property
    def shift_px(self) -> Singles:
        """Where each rectified pixel is found in the raw image, less its own place: (rows, columns, 2), column first.

        Float32 holds these few pixels to 1e-6 px at half the memory.
        """
        shift = np.empty((*self.image_shape, 2), dtype=np.float32)
        upright, turn = self.lattice_px, turn_matrix(self.rotation_rad)
        model = (self.fit.coefficients_px, np.array(EXPONENTS, dtype=np.int64))
        share_out(write_shift, self.image_shape[0], upright.origin, upright.basis, model, turn, shift)
        return shift

    @cached_property
    def inside(self) -> Flags:
        """Rectified pixels (rows, columns) whose place in the raw image lies between the centres of its pixels."""
        rows, columns = self.image_shape
        column = np.arange(columns) + self.shift_px[..., 0]
        row = np.arange(rows)[:, np.newaxis] + self.shift_px[..., 1]
        return (column >= 0.0) & (column <= columns - 1) & (row >= 0.0) & (row <= rows - 1)

    def apply(self, image: ArrayLike, window: tuple[slice, slice] = EVERYWHERE) -> Singles:
        """Return the rectified image, same shape, by cubic splines; 0 outside the sensor and outside of a window.

        Parameters
        ----------
        window : rows and columns

        Raises
        ------
        InputError : when the image is not of the white image's shape
        """
        raw = np.asarray(image, dtype=np.float64)
        if raw.shape != self.image_shape:
            raise InputError(f"the image is {raw.shape} and the white image {self.image_shape} (rows, columns)")
        inside = np.zeros_like(self.inside)
        inside[window] = self.inside[window]
        ranges = [range(*each.indices(size)) for each, size in zip(window, self.image_shape, strict=True)]
        part = tuple([slice(max(each.start - self._reach_px, 0), each.stop + self._reach_px) for each in ranges])
        coefficients = _spline_filtered(raw[part])
        shift, sampled = np.ascontiguousarray(self.shift_px[part]), np.zeros(coefficients.shape, np.float32)
        share_out(sample_rows, len(sampled), coefficients, shift, np.ascontiguousarray(inside[part]), sampled)
        rectified = np.zeros(self.image_shape, np.float32)
        rectified[part] = sampled
        return rectified

    def nearest(self, image: ArrayLike) -> Singles:
        """Return the rectified image (rows, columns): for each pixel the nearest raw one, 0 outside the sensor."""
        column, row = np.moveaxis(self._nearest_px.astype(np.int64), -1, 0)
        return np.where(self.inside, np.asarray(image, dtype=np.float32)[row, column], np.float32(0.0))

    @property
    def off_px(self) -> Singles:
        """Where the pixels of `nearest` lie beside their places: (rows, columns, 2), column first."""
        rows, columns = np.indices(self.image_shape, dtype=np.float32)
        off = self._nearest_px - np.stack([columns, rows], axis=-1) - self.shift_px
        return np.asarray(off @ turn_matrix(self.rotation_rad), dtype=np.float32)

    @cached_property
    def _reach_px(self) -> int:
        """How far out of a window its shifts and splines reach."""
        return SPLINE_REACH_PX + math.ceil(np.abs(self.shift_px).max(initial=0.0))

    @cached_property
    def _nearest_px(self) -> Singles:
        """The raw pixel (rows, columns, 2) nearest to each rectified one, column first, on the sensor."""
        rows, columns = np.indices(self.image_shape, dtype=np.float32)
        last = np.array(self.image_shape[::-1], dtype=np.float32) - 1
        return np.clip(np.rint(np.stack([columns, rows], axis=-1) + self.shift_px), 0, last)

    def to_world(self, points: ArrayLike, column_axis: ColumnAxis = "x") -> Floats:
        """Turn lateral world coordinates (..., 2 or 3) from the rectified frame to the raw sensor's axes."""
        return turned(points, self.rotation_rad if column_axis == "x" else -self.rotation_rad)

    def from_world(self, points: ArrayLike, column_axis: ColumnAxis = "x") -> Floats:
        """Turn lateral world coordinates (..., 2 or 3) from the raw sensor's axes to the rectified frame."""
        return turned(points, -self.rotation_rad if column_axis == "x" else self.rotation_rad)


def turn_matrix(angle_rad: float) -> Floats:
    """Return the matrix that turns columns of (x, y) from x towards y."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cosine, -sine], [sine, cosine]])


def turned(points: ArrayLike, angle_rad: float) -> Floats:
    """Return points (..., 2 or more) with their first two components turned from x towards y."""
    result = np.array(points, dtype=np.float64)
    result[..., :2] = result[..., :2] @ turn_matrix(angle_rad).T
    return result


@njit(cache=True, nogil=True)
def write_shift(
    part: tuple[int, int], origin: Floats, basis: Floats, model: tuple[Floats, Integers], turn: Floats, shift: Singles
) -> None:
    """Write for each rectified pixel of rows `part` its raw place less its own (rows, columns, 2).

    The offset from its lens in the upright lattice is turned and added to the lens's centre in the raw image, of a
    model with coefficients and exponents.
    """
    coefficients, exponents = model
    for row in range(part[0], part[1]):
        for column in range(shift.shape[1]):
            lens_x, lens_y = nearest_point(float(column), float(row), origin, basis)
            j = np.rint((lens_y - origin[1]) / basis[1, 1])
            i = np.rint((lens_x - origin[0] - j * basis[1, 0]) / basis[0, 0])
            x = turn[0, 0] * (column - lens_x) + turn[0, 1] * (row - lens_y)
            y = turn[1, 0] * (column - lens_x) + turn[1, 1] * (row - lens_y)
            for k in range(exponents.shape[0]):
                term = i ** exponents[k, 0] * j ** exponents[k, 1]
                x += coefficients[k, 0] * term
                y += coefficients[k, 1] * term
            shift[row, column, 0] = x - column
            shift[row, column, 1] = y - row


def _spline_filtered(image: Floats) -> Floats:
    """Return the coefficients of an image's cubic spline, mirrored at its edges, lines shared out to threads."""
    filtered = np.empty_like(image)
    for axis, source in enumerate((image, filtered)):
        lines = [(np.s_[:], part) if axis == 0 else (part, np.s_[:]) for part in blocks(image.shape[1 - axis], LINES)]
        in_threads(partial(_filter_lines, source, filtered, axis), lines)
    return filtered


def _filter_lines(source: Floats, filtered: Floats, axis: int, lines: tuple[slice, slice]) -> None:
    """Filter some lines of an image along an axis."""
    ndimage.spline_filter1d(source[lines], order=3, axis=axis, output=filtered[lines], mode="mirror")


@njit(cache=True)
def mirrored(index: int, size: int) -> int:
    """Return the sample that stands for one beyond the ends: the image mirrored about its first and last pixel."""
    if index < 0:
        return -index
    if index >= size:
        return 2 * size - 2 - index
    return index


@njit(cache=True, nogil=True, **COUNT_NO_REFERENCES)
def sample_rows(part: tuple[int, int], coefficients: Floats, shift: Singles, inside: Flags, image: Singles) -> None:
    """Write rows `part` of a cubic spline at each pixel's place plus its shift, where inside."""
    rows, columns = coefficients.shape
    for row in range(part[0], part[1]):
        for column in range(columns):
            if inside[row, column]:
                x = column + np.float64(shift[row, column, 0])
                y = row + np.float64(shift[row, column, 1])
                left = int(np.floor(x))
                top = int(np.floor(y))
                across = spline_weights(x - left)
                down = spline_weights(y - top)
                total = 0.0
                if 1 <= left < columns - 2 and 1 <= top < rows - 2:
                    for m in range(4):
                        line = coefficients[top + m - 1, left - 1 : left + 3]
                        in_line = across[0] * line[0] + across[1] * line[1] + across[2] * line[2] + across[3] * line[3]
                        total += down[m] * in_line
                else:
                    for m in range(4):
                        line = coefficients[mirrored(top + m - 1, rows)]
                        in_line = 0.0
                        for n in range(4):
                            in_line += across[n] * line[mirrored(left + n - 1, columns)]
                        total += down[m] * in_line
                image[row, column] = total
