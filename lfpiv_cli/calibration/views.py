"""Decoding: sub-aperture views, what the scene looks like from one point of the main lens, and refocused pictures.

Axes: images are [row, column]; places on the main lens are (X, Y) in mm in image axes, X along the columns. A view has
one sample per microlens; neighbouring microlenses are neighbours in it.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.shape_fit import lens_crossings, pixel_rays, scene_points
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media

# Chessboards and ChArUco boards in a picture of grey levels, found by OpenCV, and what is known of their pattern.
# Places are (column, row) in the picture's pixels; corners are numbered along the board's columns and rows.

# Grey levels of 255 between the brightest black and the darkest white square.
LEAST_CONTRAST = 60.0


def board_corners(picture: NDArray[np.uint8], board: BoardGeometry) -> tuple[Integers, Floats] | None:
    """Return numbers and places (n, 2) of a board's inner corners.

    All those of a chessboard, None where it is not wholly there; those of a ChArUco board that are seen, None where
    none is.
    """
    across, down = board.dots
    # Their numbers (n, 2) along the columns and rows, row by row.
    every = np.stack(np.meshgrid(np.arange(across), np.arange(down)), axis=-1).reshape(-1, 2).astype(np.int64)
    if board.pattern == "chessboard":
        # CALIB_CB_NORMALIZE_IMAGE would equalise the histogram, which draws corners of small boards off by a square
        flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
        there, corners = cv2.findChessboardCornersSB(picture, board.dots, flags=flags)
        place = np.asarray(corners, dtype=np.float64).reshape(-1, 2) if there else np.zeros((0, 2))
        return (every, place) if there and alternating(picture, place.reshape(down, across, 2)) else None
    settings = cv2.aruco.CharucoParameters()
    settings.minMarkers = 1  # of the two beside a corner: at the picture's edge one is cut
    corners, identity, _, _ = cv2.aruco.CharucoDetector(charuco_board(board), settings).detectBoard(picture)
    if corners is None or len(corners) == 0:
        return None
    row, column = np.divmod(np.asarray(identity, dtype=np.int64).ravel(), across)
    found = np.stack([column, row], axis=1)
    if np.linalg.matrix_rank(found - found[0]) < 2:
        return None
    # OpenCV leaves out corners whose markers are cut; the others tell where they are
    terms = np.column_stack([np.ones(len(found)), found])
    grid = np.linalg.lstsq(terms, np.asarray(corners, dtype=np.float64).reshape(-1, 2), rcond=None)[0]
    place = np.asarray(grid[0] + every @ grid[1:], dtype=np.float64)
    inside = ((place >= 0.0) & (place <= np.array(picture.shape[::-1]) - 1.0)).all(axis=1)
    return every[inside], place[inside]


def alternating(picture: NDArray[np.uint8], corners: Floats) -> bool:
    """Return whether the squares about corners (rows, columns, 2) are black and white by turns.

    OpenCV finds a grid of three by three corners in many pictures, of particles or of white light.
    """
    rows, columns = corners.shape[:2]
    j, i = np.mgrid[:rows, :columns]
    terms = np.column_stack([np.ones(corners.shape[0] * corners.shape[1]), i.ravel(), j.ravel()])
    grid = np.linalg.lstsq(terms, corners.reshape(-1, 2), rcond=None)[0]
    down, across = np.mgrid[: rows + 1, : columns + 1]
    middles = grid[0] + np.stack([across - 0.5, down - 0.5], axis=-1) @ grid[1:]
    column, row = np.rint(middles).astype(np.int64).reshape(-1, 2).T
    inside = (column >= 0) & (column < picture.shape[1]) & (row >= 0) & (row < picture.shape[0])
    level = picture[row[inside], column[inside]].astype(np.float64)
    even = ((across + down) % 2 == 0).ravel()[inside]
    apart = max(level[even].min() - level[~even].max(), level[~even].min() - level[even].max())
    return bool(apart > LEAST_CONTRAST)


def charuco_board(board: BoardGeometry) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's description of a ChArUco board."""
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    squares = tuple(n + 1 for n in board.dots)
    return cv2.aruco.CharucoBoard(squares, board.spacing_mm, board.marker_mm, words)


def clear_mm(board: BoardGeometry) -> float:
    """Return how far about a corner there is nothing but its four squares: markers stand in the middle of theirs."""
    to_marker = np.sqrt(0.5) * (board.spacing_mm - board.marker_mm)
    return float(min(0.5 * board.spacing_mm, to_marker))


def described(board: BoardGeometry) -> str:
    """Return what the board is said to be."""
    across, down = board.dots
    if board.pattern == "dots":
        return f"a board of {across} x {down} dots"
    kind = "chessboard" if board.pattern == "chessboard" else "ChArUco board"
    return f"a {kind} of {across + 1} x {down + 1} squares"


# Refocused pictures: the light of pixels carried back along their rays to a plane of the scene and added up there. They
# are [row, column], the middle sample on the optical axis, x and y growing with columns and rows.


def refocusing(
    camera: Camera,
    media: Media,
    pixels: tuple[Integers, Integers],
    samples_per_lens: int,
    half_width: float,
    smoothing: float,
) -> tuple[float, tuple[int, int], Callable[..., list[Floats]]]:
    """Return what carries the light of pixels (row, column), (n,) each, to planes.

    That is the side of the planes' samples, mm, how many rows and columns of them lie on either side of the axis, and
    what gives the pictures at a depth of each kind of light (n,).

    Parameters
    ----------
    camera : with the lattice of the rectified frame
    media : what lies before the planes
    samples_per_lens : samples in the width of a microlens
    half_width : of the pictures to either side of the axis, in widths of the sensor as the focal plane has it
    smoothing : standard deviation of the Gaussian that softens the pictures, in samples
    """
    row, column = pixels
    rays = pixel_rays(camera, column, row)
    through = np.hypot(*lens_crossings(rays, camera).T) <= camera.aperture_radius_mm
    sample_mm = float(camera.lattice.pitch.min()) / samples_per_lens / abs(camera.magnification)
    size = np.array([camera.rows, camera.columns]) * camera.pixel_mm / abs(camera.magnification)
    rows, columns = (int(n) for n in np.ceil(half_width * size / sample_mm))
    shape = 2 * rows + 1, 2 * columns + 1

    def pictures(z_mm: float, *light: Floats) -> list[Floats]:
        points = scene_points(rays, camera, media, z_mm)
        place = np.rint(points[:, ::-1] / sample_mm).astype(np.int64) + (rows, columns)
        seen = through & ((place >= 0) & (place < shape)).all(axis=1)
        flat = np.ravel_multi_index(tuple(place[seen].T), shape)
        # bincount makes whole numbers of no light at all
        sums = [np.bincount(flat, values[seen], minlength=shape[0] * shape[1]).astype(np.float64) for values in light]
        return [ndimage.gaussian_filter(each.reshape(shape), smoothing) for each in sums]

    return sample_mm, (rows, columns), pictures


# Refocused pictures have one sample per microlens, the detail that the array records, softened by half of that so that
# the gaps between microlenses do not beat with the samples.
REFOCUS_SMOOTHING = 0.5
# Samples that see less than this share of the usual light lie beyond the sensor.
LEAST_SEEN = 0.1


def lens_table(camera: Camera) -> Integers:
    """Return the lattice indices (rows, columns, 2) of the lenses whose images are centred on the sensor.

    The table is rectangular: on hexagons, whose second vector leans, each row starts where the leaning has led it.
    """
    lattice = camera.micro_image_lattice_px()
    corners = np.array([(0, 0), (camera.columns - 1, 0), (0, camera.rows - 1), (camera.columns - 1, camera.rows - 1)])
    j = lattice.coordinates(corners)[:, 1]
    rows = np.arange(int(np.ceil(j.min())), int(np.floor(j.max())) + 1)
    lean = rows // 2 if lattice.layout == "hexagonal" else np.zeros_like(rows)
    left = (0.0 - lattice.points(np.stack([-lean, rows], axis=1))[:, 0]) / lattice.basis[0, 0]
    right = left + (camera.columns - 1) / lattice.basis[0, 0]
    columns = np.arange(int(np.ceil(left.max())), int(np.floor(right.min())) + 1)
    table = np.stack(np.broadcast_arrays(columns[np.newaxis, :] - lean[:, np.newaxis], rows[:, np.newaxis]), axis=-1)
    return table.astype(np.int64)


def view_crossings(camera: Camera, rim_px: float) -> Floats:
    """Return points (n, 2) of the main lens, a square grid about its middle, a pixel apart and some inside its rim."""
    step_mm = camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
    radius_mm = camera.aperture_radius_mm - rim_px * step_mm
    count = int(radius_mm / step_mm)
    line = step_mm * np.arange(-count, count + 1)
    points = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= radius_mm]


def sub_aperture_view(image: ArrayLike, camera: Camera, crossing_mm: ArrayLike) -> Floats:
    """Return the view (lens rows, lens columns) from the point (X, Y) of the main lens, linearly interpolated.

    The ray through (X, Y) and a lens's centre is not bent there, s_ux = x_m in Eq. 1: x_s = s_ux + s_mu (s_ux - X)/s_i.

    Parameters
    ----------
    image : (rows, columns), rectified
    camera : with the lattice of the rectified frame
    crossing_mm : (2,) X, Y
    """
    lens = camera.lattice.points(lens_table(camera))
    step = (lens - np.asarray(crossing_mm, dtype=np.float64)) / camera.image_distance_mm
    places = camera.mm_to_px(lens + camera.microlens_distance_mm * step)
    pixels = np.asarray(image, dtype=np.float64)
    return ndimage.map_coordinates(pixels, [places[..., 1], places[..., 0]], order=1, mode="nearest")


def views_across(image: ArrayLike, camera: Camera, views_per_side: int) -> dict[tuple[int, int], tuple[Floats, Floats]]:
    """Return the points (X, Y) in mm and the views from a square grid of them, by its row and column.

    The grid's cells cover the main lens; a cell whose middle lies beyond the rim has no view. X grows with the columns
    and Y with the rows.
    """
    line = (2.0 * np.arange(views_per_side) - (views_per_side - 1)) / views_per_side * camera.aperture_radius_mm
    places = {(row, column): np.array([x, y]) for row, y in enumerate(line) for column, x in enumerate(line)}
    return {
        cell: (point, sub_aperture_view(image, camera, point))
        for cell, point in places.items()
        if np.hypot(*point) <= camera.aperture_radius_mm
    }


def refocused_stack(
    image: ArrayLike, camera: Camera, media: Media, depths_mm: ArrayLike, passed: ArrayLike | None = None
) -> Floats:
    """Return what the scene looks like when focused at depths: (depths, rows, columns), one sample per microlens.

    Every pixel's light is carried back along its ray to the plane and averaged there. The pictures are centred on the
    axis, x and y grow with columns and rows; samples that no pixel sees are 0.

    Parameters
    ----------
    image : (rows, columns), rectified
    camera : with the lattice of the rectified frame
    passed : (rows, columns) share of light that pixels pass, 0 where unusable; default: all the same
    """
    pixels = np.asarray(image, dtype=np.float64)
    share = np.ones(pixels.shape) if passed is None else np.asarray(passed, dtype=np.float64)
    row, column = np.nonzero(share > 0.0)
    _, _, pictures = refocusing(camera, media, (row, column), 1, 0.5, REFOCUS_SMOOTHING)

    def refocused(z_mm: float) -> Floats:
        light, passing = pictures(z_mm, pixels[row, column], share[row, column])
        enough = passing > LEAST_SEEN * np.median(passing)
        return np.where(enough, light / np.where(enough, passing, 1.0), 0.0)

    return np.stack([refocused(float(z)) for z in np.asarray(depths_mm, dtype=np.float64)])
