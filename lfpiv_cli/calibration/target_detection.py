"""Chessboards and ChArUco boards in a picture of grey levels, found by OpenCV, and what is known of their pattern.

Axes: places are (column, row) in the picture's pixels; corners are numbered along the board's columns and rows.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry

# Grey levels of 255 between the brightest black and the darkest white square.
LEAST_CONTRAST = 60.0


def chessboard_corners(
    picture: NDArray[np.uint8], board: BoardGeometry
) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Return numbers and places (n, 2) of all inner corners of a chessboard; None where it is not wholly there."""
    # CALIB_CB_NORMALIZE_IMAGE would equalise the histogram, which draws corners of small boards off by a square
    flags = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    there, corners = cv2.findChessboardCornersSB(picture, board.dots, flags=flags)
    across, down = board.dots
    if not there or not alternating(picture, np.asarray(corners, dtype=np.float64).reshape(down, across, 2)):
        return None
    return board_numbers(board), np.asarray(corners, dtype=np.float64).reshape(-1, 2)


def alternating(picture: NDArray[np.uint8], corners: NDArray[np.float64]) -> bool:
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


def board_numbers(board: BoardGeometry) -> NDArray[np.int64]:
    """Return the numbers (n, 2) of all corners along the board's columns and rows, row by row."""
    return np.stack(np.meshgrid(*(np.arange(n) for n in board.dots)), axis=-1).reshape(-1, 2).astype(np.int64)


def charuco_corners(
    picture: NDArray[np.uint8], board: BoardGeometry
) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Return numbers and places (n, 2) of the inner corners of a ChArUco board that are seen; None where none is."""
    settings = cv2.aruco.CharucoParameters()
    settings.minMarkers = 1  # of the two beside a corner: at the picture's edge one is cut
    corners, identity, _, _ = cv2.aruco.CharucoDetector(charuco_board(board), settings).detectBoard(picture)
    if corners is None or len(corners) == 0:
        return None
    row, column = np.divmod(np.asarray(identity, dtype=np.int64).ravel(), board.dots[0])
    found = np.stack([column, row], axis=1)
    if np.linalg.matrix_rank(found - found[0]) < 2:
        return None
    # OpenCV leaves out corners whose markers are cut; the others tell where they are
    terms = np.column_stack([np.ones(len(found)), found])
    grid = np.linalg.lstsq(terms, np.asarray(corners, dtype=np.float64).reshape(-1, 2), rcond=None)[0]
    every = board_numbers(board)
    place = np.asarray(grid[0] + every @ grid[1:], dtype=np.float64)
    there = ((place >= 0.0) & (place <= np.array(picture.shape[::-1]) - 1.0)).all(axis=1)
    return every[there], place[there]


def charuco_board(board: BoardGeometry) -> cv2.aruco.CharucoBoard:
    """Return OpenCV's description of a ChArUco board."""
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    squares = tuple(n + 1 for n in board.dots)
    return cv2.aruco.CharucoBoard(squares, board.spacing_mm, board.marker_mm, words)


def marker_modules(board: BoardGeometry) -> int:
    """Return how many squares a marker of the board's dictionary has along its side, the black border among them."""
    return int(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary)).markerSize) + 2


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
