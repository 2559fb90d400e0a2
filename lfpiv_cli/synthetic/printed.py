"""Expected images of calibration targets printed on a plate: chessboards and ChArUco boards.

Each pixel's rays are followed backwards, through the microlens and the main lens (Eq. 1) to the plate, through window
and fluid by Snell's law (Eq. 4); the pixel shows the share of them that ends on something bright.

Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.dot_model import nearest_points, undistorted
from lfpiv_cli.calibration.target_detection import charuco_board
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import exact_lateral_mm
from lfpiv_cli.optics.microlenses import Lattice
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.synthetic.ray_sequence import SEQUENCE, diffused_mm

# Samples along a square's side: a marker's side is known to a hundredth of it.
SQUARE_SAMPLES = 120
# Around the squares the plate is white for this many of them; beyond it there is nothing.
MARGIN_SQUARES = 1.0
# A pixel is sampled on a grid this wide: an edge is known to a few per cent of a pixel's light, unlike in each.
SAMPLES_PER_SIDE = 4
# Where light is blurred, it comes from further around, and evenly: more of them.
BLURRED_SAMPLES_PER_SIDE = 8
# Each pixel starts its places on the microlens elsewhere (the same sequence in two more dimensions, by column and row):
# with the same few for all, an edge in focus would be drawn to them.
PIXEL_STEPS = np.array([[SEQUENCE[2], SEQUENCE[3]], [SEQUENCE[0], SEQUENCE[1]]])
# Where a ray meets a tilted plate is found by repetition: each round gains its slope times the tilt, 0.05 or less.
PLANE_ROUNDS = 8
PLANE_TOLERANCE_MM = 1e-6
# Rows of pixels that are followed at once: so few that they stay near the processor.
ROWS_AT_ONCE = 16


@dataclass(frozen=True, eq=False)
class Plate:
    """A printed plate: its middle and unit vectors along its x and y (3, each), and what is printed, 0 to 1."""

    middle_mm: NDArray[np.float64]
    along_x: NDArray[np.float64]
    along_y: NDArray[np.float64]
    picture: NDArray[np.float32]
    samples_per_mm: float


def printed_plate(camera: Camera, board: BoardGeometry, plate_mm: NDArray[np.float64]) -> Plate:
    """Return the plate of a target.

    Parameters
    ----------
    plate_mm : (3, 3) world axes: the plate's middle, and the points a millimetre from it along x and along y
    """
    middle, x, y = camera.to_image_axes(plate_mm)
    # a print is read from the front, whatever the sensor's axes are called
    along_x = x - middle if camera.column_axis == "x" else middle - x
    samples = SQUARE_SAMPLES / board.spacing_mm
    return Plate(middle, along_x, y - middle, target_picture(board).astype(np.float32) / 255.0, samples)


def target_picture(board: BoardGeometry) -> NDArray[np.uint8]:
    """Return what is printed, 255 where bright, (rows along y, columns along x), `SQUARE_SAMPLES` to a square."""
    across, down = (n + 1 for n in board.dots)
    margin = round(MARGIN_SQUARES * SQUARE_SAMPLES)
    if board.pattern == "charuco":
        size = (across * SQUARE_SAMPLES + 2 * margin, down * SQUARE_SAMPLES + 2 * margin)
        return np.asarray(charuco_board(board).generateImage(size, marginSize=margin), dtype=np.uint8)
    squares = np.indices((down, across)).sum(axis=0) % 2
    picture = np.kron(255 * squares, np.ones((SQUARE_SAMPLES, SQUARE_SAMPLES))).astype(np.uint8)
    return np.asarray(cv2.copyMakeBorder(picture, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255))


def render_plate(
    camera: Camera, space: ObjectSpace, plate: Plate, level: float, blur_px: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    """Render a lit plate, (rows, columns) float64 expected counts; light outside a pixel's own micro-image is left out.

    Parameters
    ----------
    level : expected counts of a pixel that sees only what is bright
    blur_px : (n, 2) places beside where rays would end on the sensor, which they take in turn; default: as charge
        diffuses

    Raises
    ------
    ConfigError : no window for exact refraction
    """
    blur = diffused_mm(camera) / camera.pixel_mm if blur_px is None else blur_px
    samples = SAMPLES_PER_SIDE if len(blur) == 1 else BLURRED_SAMPLES_PER_SIDE
    line = (np.arange(samples) + 0.5) / samples - 0.5
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) - blur[np.arange(samples**2) % len(blur)]
    image = np.empty((camera.rows, camera.columns))
    for top in range(0, camera.rows, ROWS_AT_ONCE):
        row, column = np.mgrid[top : min(top + ROWS_AT_ONCE, camera.rows), : camera.columns]
        px = np.stack([column, row], axis=-1).astype(np.float64)
        image[top : top + len(px)] = level * _bright_share(px, places, camera, space, plate)
    return image


def _bright_share(
    px: NDArray[np.float64], places: NDArray[np.float64], camera: Camera, space: ObjectSpace, plate: Plate
) -> NDArray[np.float64]:
    """Return the share (rows, columns) of the rays to pixels, (rows, columns, 2), that start on something bright.

    `places` (n, 2) are those about the middle of a pixel where rays would end but for the blur.
    """
    centred = Lattice(np.zeros(2), camera.lattice.basis, camera.lattice.layout)
    first = (px @ PIXEL_STEPS).reshape(-1, 2)
    total = np.zeros(px.shape[:2])
    for k, place in enumerate(places):
        cell = ((first + k * SEQUENCE[:2]) % 1.0) @ centred.basis
        offset = cell - nearest_points(cell, centred.origin, centred.basis)
        crossing, slope = _rays_to((px + place).reshape(-1, 2), offset, camera)
        passes = np.flatnonzero(np.hypot(crossing[:, 0], crossing[:, 1]) <= camera.aperture_radius_mm)
        on_plate = _on_plate(crossing[passes], slope[passes], camera, space, plate)
        total.ravel()[passes] += _printed_at(on_plate, plate)
    return total / len(places)


def _printed_at(on_plate_mm: NDArray[np.float64], plate: Plate) -> NDArray[np.float32]:
    """Return what is printed (n,) at places (n, 2) about the plate's middle, 0 beyond the plate."""
    size = np.array(plate.picture.shape[::-1])
    column, row = np.floor(on_plate_mm * plate.samples_per_mm + size / 2.0).astype(np.int64).T
    there = (column >= 0) & (column < size[0]) & (row >= 0) & (row < size[1])
    return np.where(there, plate.picture[np.where(there, row, 0), np.where(there, column, 0)], np.float32(0.0))


def _rays_to(
    px: NDArray[np.float64], offset_mm: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return where rays cross the main lens (n, 2) and their slopes in front of it (n, 2).

    They end at places on the sensor, under the nearest microlens, beside whose centre they pass by `offset_mm` (n, 2).
    """
    micro_images = camera.micro_image_lattice_px()
    lens = camera.px_to_mm(nearest_points(px, micro_images.origin, micro_images.basis)) / camera.micro_image_scale
    # Eq. 1, solved for X: x_s = x_m + s_mu ((x_ideal - X)/s_i - (x_m - s_u)/f_m), x_ideal without the distortion
    ideal = undistorted(lens + offset_mm, camera.distortion_per_mm2)
    bent = offset_mm * (1.0 - camera.microlens_distance_mm / camera.microlens_focal_length_mm)
    behind = (camera.px_to_mm(px) - lens - bent) / camera.microlens_distance_mm
    crossing = ideal - camera.image_distance_mm * behind
    return crossing, behind + crossing / camera.focal_length_mm


def _on_plate(
    crossing_mm: NDArray[np.float64], slope: NDArray[np.float64], camera: Camera, space: ObjectSpace, plate: Plate
) -> NDArray[np.float64]:
    """Return where on the plate (n, 2), about its middle, rays start that cross the main lens with given slopes."""
    thicknesses, indices = space.layers(camera)
    per_depth = space.media.depth_ratio if len(indices) == 1 else 1.0
    steepness = np.hypot(slope[:, 0], slope[:, 1])
    direction = slope / np.where(steepness > 0.0, steepness, 1.0)[:, np.newaxis]
    fixed = exact_lateral_mm(steepness, thicknesses, indices, space.media.air)
    last = exact_lateral_mm(steepness, [per_depth], indices[-1:], space.media.air)
    normal = np.cross(plate.along_x, plate.along_y)
    depth = np.full(len(slope), plate.middle_mm[2])
    for _ in range(PLANE_ROUNDS):
        lateral = crossing_mm - direction * (fixed + last * depth)[:, np.newaxis]
        before, depth = depth, plate.middle_mm[2] - (lateral - plate.middle_mm[:2]) @ normal[:2] / normal[2]
        if np.abs(depth - before).max(initial=0.0) < PLANE_TOLERANCE_MM:
            break
    off = np.column_stack([lateral, depth]) - plate.middle_mm
    return np.stack([off @ plate.along_x, off @ plate.along_y], axis=1)
