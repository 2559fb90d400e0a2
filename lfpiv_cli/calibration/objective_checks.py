"""What is not a thin lens before a parallel array: an aperture that is cut aslant, a tilted array, a curved field.

Lens images show the aperture. A barrel cuts it towards the corners to the shape that two circles have in common (cat's
eye), narrower along the image height than across; their second moments tell both, without a threshold of brightness.
Where the microlenses are further from the sensor their images are larger. A board's dots tell where the focus is.

Axes: (column, row); image heights over that of the sensor's corners.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import COMMON_SHARE_OF_LENS_DEPTH, BoardPose, lens_in_scene_mm
from lfpiv_cli.calibration.lens_light import LensImages, cell_places, part_middles
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.microlenses import Lattice

# Lens images of an ideal camera differ by 0.1 to 0.3 %. With a twentieth of the aperture cut off in the corners places
# erred by four stated errors, with a fifth a sixth of the tracers was found; with microlenses 1.2 % further from the
# sensor there depths erred by two, with 2.9 % by three. Of photographs one differs by 1.0 % from side to side.
LARGEST_CUT, LARGEST_GROWTH = 0.02, 0.01
# Five times what dots have in common anyway, over the depth in which light spreads by one microlens.
LARGEST_FIELD_DEPTH = 5.0 * COMMON_SHARE_OF_LENS_DEPTH
CERTAIN_SIGMAS = 5.0
# What lies above the mean of the brightest tenth of a lens image's cell is its plateau.
BRIGHTEST_SHARE = 0.1
# Dots beyond the four numbers that are fitted: fewer know their scatter badly.
FEWEST_SPARE_DOTS = 5


class Fitted(NamedTuple):
    """A number and its standard error."""

    value: float
    sigma: float

    def beyond(self, largest: float) -> bool:
        """Return whether its size is above a limit, and not by chance."""
        return abs(self.value) > max(largest, CERTAIN_SIGMAS * self.sigma)


class Shapes(NamedTuple):
    """How lens images change from the middle to the corners.

    Attributes
    ----------
    cut : share of the light-giving area that is lost
    oblong : mean square width along the image height over that across, less 1
    growth : (along the columns, along the rows) of their width
    """

    cut: Fitted
    oblong: Fitted
    growth: tuple[Fitted, Fitted]


def shapes_of(images: LensImages, image_shape: tuple[int, int]) -> Shapes:
    """Return how the lens images of uniform light change over a picture (rows, columns)."""
    size = np.array(image_shape[::-1], dtype=np.float64)
    place = part_middles() * size / np.hypot(*size)
    height2 = np.sum(place**2, axis=1)
    terms = np.column_stack([np.ones(len(place)), place, height2])
    along_x, along_y, across = _moments(images)
    width2 = along_x + along_y
    middle = float(np.median(width2))
    area, *_, lost = _fit(terms, _areas(images.pattern))
    growth = _fit(terms, 0.5 * width2 / middle)
    (x, y), ones, none = place.T, np.ones(len(place)), np.zeros(len(place))
    aslant = np.concatenate([np.column_stack([ones, none, x**2 - y**2]), np.column_stack([none, ones, 2.0 * x * y])])
    oblong = _fit(aslant, np.concatenate([along_x - along_y, 2.0 * across]) / middle)
    return Shapes(Fitted(-lost.value / area.value, lost.sigma / area.value), oblong[2], (growth[1], growth[2]))


def shape_notices(shapes: Shapes) -> Iterator[Notice]:
    """Say where the aperture is cut towards the corners, or else where the microlenses' distance changes."""
    if shapes.cut.beyond(LARGEST_CUT) and shapes.oblong.beyond(0.0) and shapes.oblong.value < 0.0 < shapes.cut.value:
        yield Notice(
            "aperture-cut",
            "white image",
            f"lens images are lens-shaped towards the corners: {shapes.cut.value:.0%} of the aperture is cut off "
            f"there, at most {LARGEST_CUT:.0%} of a good one; pitch, places and depths are off by it",
            "stop the main lens down until lens images are alike everywhere",
            shapes.cut.value,
            f"at most {LARGEST_CUT:g}",
        )
        return
    most = max(shapes.growth, key=lambda side: abs(side.value))
    if most.beyond(LARGEST_GROWTH):
        yield Notice(
            "array-tilted",
            "white image",
            f"lens images are {abs(most.value):.1%} wider half a diagonal from the middle along the "
            f"{'columns' if most is shapes.growth[0] else 'rows'}, and as much narrower on the other side, at most "
            f"{LARGEST_GROWTH:.1%} of a good camera: microlenses are not everywhere as far from the sensor",
            "mount the array parallel to the sensor, or use what is near the middle",
            most.value,
            f"within {LARGEST_GROWTH:g}",
        )


def field_depth(pose: BoardPose, camera: Camera) -> Fitted | None:
    """Return how much further a flat board seems to be in the corners of the sensor than in its middle, mm.

    None where there are too few dots to tell.
    """
    if pose.dots_found < 4 + FEWEST_SPARE_DOTS:
        return None
    corner = 0.5 * camera.pixel_mm * float(np.hypot(camera.columns, camera.rows))
    height = camera.px_to_mm(pose.dots_px) / corner
    terms = np.column_stack([np.ones(len(height)), height, np.sum(height**2, axis=1)])
    return _fit(terms, pose.residual_mm[:, 2])[3]


def field_notices(pose: BoardPose, camera: Camera) -> Iterator[Notice]:
    """Say where the focus changes with the image height by more than what places in depth may be off."""
    depth, largest = field_depth(pose, camera), LARGEST_FIELD_DEPTH * lens_in_scene_mm(camera)[1]
    if depth is None or not depth.beyond(largest):
        return
    yield Notice(
        "field-curved",
        "board image",
        f"a flat board seems {written(abs(depth.value))} mm {'further' if depth.value > 0.0 else 'nearer'} in the "
        f"corners than in the middle (field curvature, or a bent board), at most {written(largest, 2)} mm may be: "
        "depths are off by it, as the square of the image height",
        "a flat board, a volume near the axis, another objective; for volumes boards at several --depth-mm and "
        "method dlfc",
        depth.value,
        f"within {written(largest, 2)} mm",
    )


def _areas(pattern: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the areas of lens images (parts,), their light over their plateau, in bins."""
    light = np.sort(pattern.reshape(len(pattern), -1), axis=1)
    count = max(1, int(BRIGHTEST_SHARE * light.shape[1]))
    return np.asarray(light.sum(axis=1) / np.maximum(light[:, -count:].mean(axis=1), np.finfo(np.float64).tiny))


def _moments(images: LensImages) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the second moments (parts,) of lens images along the columns, the rows, and of both, in square pixels."""
    lattice, pattern = images.lattice_px, images.pattern
    place = cell_places(pattern.shape[-1]) @ lattice.basis
    cell = Lattice(np.zeros(2), lattice.basis, lattice.layout)
    place = place - cell.points(cell.nearest(place))
    share = pattern / np.maximum(pattern.sum(axis=(1, 2), keepdims=True), np.finfo(np.float64).tiny)
    mean = np.einsum("pij,ijk->pk", share, place)
    square = np.einsum("pij,ijk,ijl->pkl", share, place, place) - mean[:, :, np.newaxis] * mean[:, np.newaxis]
    return square[:, 0, 0], square[:, 1, 1], square[:, 0, 1]


def _fit(terms: NDArray[np.float64], values: NDArray[np.float64]) -> list[Fitted]:
    """Return the coefficients (k,) of terms (n, k) that fit values (n,) best, and standard errors by the scatter."""
    found = np.linalg.lstsq(terms, values, rcond=None)[0]
    freedom = max(1, len(values) - terms.shape[1])
    variance = np.sum((values - terms @ found) ** 2) / freedom * np.diag(np.linalg.pinv(terms.T @ terms))
    return [Fitted(float(value), float(np.sqrt(square))) for value, square in zip(found, variance, strict=True)]
