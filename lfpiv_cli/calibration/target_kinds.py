"""What kind of calibration target a picture shows, to name one that the config does not expect."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.corners import enlarged_view, evenly_lit
from lfpiv_cli.calibration.target_detection import alternating, described
from lfpiv_cli.optics.camera import Camera

# A chessboard is named by its size where at least this many corners along each side are seen.
FEWEST_CORNERS = (3, 3)
# The largest dictionaries of each size hold the smaller ones.
DICTIONARIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")
# Single markers turn up by chance in pictures of other things.
FEWEST_MARKERS = 2
# Round spots make a board of dots when they are as many, and most have a neighbour at the same distance.
FEWEST_SPOTS = 9
SAME_DISTANCE = 0.15
EVEN_SHARE = 0.8


def another_kind(
    image: NDArray[np.float32],
    camera: Camera,
    board: BoardGeometry,
    transmission: NDArray[np.float32] | None = None,
) -> str | None:
    """Return a sentence that names the target in a rectified picture where it is not the board's; else None."""
    passed = np.ones(image.shape, dtype=np.float32) if transmission is None else transmission
    picture, _ = enlarged_view(evenly_lit(image, passed), camera)
    for pattern, look in LOOKS_LIKE.items():
        if (found := look(picture)) is not None:
            return None if found == described(board) else sentence(found, pattern, board)
    return None


def sentence(found: str, pattern: str, board: BoardGeometry) -> str | None:
    """Return what to say of a target that was found where the config has another; None where that is not certain."""
    if pattern == "dots" and board.pattern == "charuco":
        # its own markers are even and round once they are out of focus
        return None
    if pattern != board.pattern:
        return f"this looks like {found}; board.pattern says {board.pattern}"
    if pattern == "chessboard":
        return f"this looks like {found}; the config says {described(board)}"
    if pattern == "charuco" and not found.endswith(board.dictionary.split("_")[1]):
        return f"this looks like {found}; board.dictionary says {board.dictionary}"
    # the same kind; how many dots or markers it has says nothing while some are not seen
    return None


def markers(picture: NDArray[np.uint8]) -> str | None:
    """Return what a picture with ArUco markers shows."""
    for name in DICTIONARIES:
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        _, identity, _ = cv2.aruco.ArucoDetector(words).detectMarkers(picture)
        if identity is not None and len(identity) >= FEWEST_MARKERS:
            return f"a ChArUco board with markers of {name.split('_')[1]}"
    return None


def chessboard(picture: NDArray[np.uint8]) -> str | None:
    """Return what a picture of a chessboard shows, with the number of its squares."""
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    there, corners, meta = cv2.findChessboardCornersSBWithMeta(picture, FEWEST_CORNERS, flags)
    if not there or meta is None:
        return None
    shape = (int(meta.shape[0]), int(meta.shape[1]))
    if not alternating(picture, np.asarray(corners, dtype=np.float64).reshape(*shape, 2)):
        return None
    down, across = (n + 1 for n in shape)
    return f"a chessboard of {max(across, down)} x {min(across, down)} squares"


def dots(picture: NDArray[np.uint8]) -> str | None:
    """Return what a picture of evenly spaced round dots shows, bright or dark."""
    for polarity, blob in (("bright", 255), ("dark", 0)):
        settings = cv2.SimpleBlobDetector.Params()
        settings.blobColor = blob
        settings.filterByArea, settings.minArea, settings.maxArea = True, 20.0, picture.size / FEWEST_SPOTS
        settings.minDistBetweenBlobs = 4.0
        places = np.array([spot.pt for spot in cv2.SimpleBlobDetector.create(settings).detect(picture)]).reshape(-1, 2)
        if len(places) >= FEWEST_SPOTS and _even(places):
            return f"a board of {len(places)} {polarity} dots"
    return None


def _even(places: NDArray[np.float64]) -> bool:
    """Return whether most places have their nearest neighbour at the same distance."""
    distance = np.hypot(*np.moveaxis(places[:, np.newaxis] - places, -1, 0))
    nearest = np.min(distance + np.diag(np.full(len(places), np.inf)), axis=1)
    return bool(np.mean(np.abs(nearest / np.median(nearest) - 1.0) < SAME_DISTANCE) >= EVEN_SHARE)


# In this order: a ChArUco board is a chessboard, too, and a chessboard's squares are round once they are out of focus.
LOOKS_LIKE = {"charuco": markers, "chessboard": chessboard, "dots": dots}
