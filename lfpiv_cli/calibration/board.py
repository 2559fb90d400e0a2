"""From one picture of a calibration target to where the focal plane is, how the board is tilted, and the magnification.

Axes: the picture is rectified and its microlenses stand upright; the pose is given in world axes, those of the raw
sensor: x, y lateral, z away from the camera from the focal plane, in the medium the board stands in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose, on_the_grid, pose_of_dots
from lfpiv_cli.calibration.corners import Look, ViewGrid, enlarged_view, evenly_lit, first_corners
from lfpiv_cli.calibration.shape_fit import PointShape, covered_shares
from lfpiv_cli.calibration.views import alternating, described, refocusing
from lfpiv_cli.calibration.wave_shapes import WaveLight, disc_strips
from lfpiv_cli.calibration.white import find_spots
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.names import Pattern
from lfpiv_cli.neighbourhoods import opened
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera, refocused
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.robust import BRIGHTEST_PERCENTILE

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


def another_kind(signal: Floats, camera: Camera, board: BoardGeometry) -> str | None:
    """Return a sentence that names the target in an evenly lit picture where it is not the board's; else None."""
    picture, scale = enlarged_view(signal, camera)
    # Out of focus dots and the gaps between them are the squares of a chessboard that stands on a corner.
    per_mm = abs(camera.magnification) / float(ViewGrid.of(camera).step_mm[0]) * float(scale[0])
    between = np.sqrt(0.5) * board.spacing_mm * per_mm if board.pattern == "dots" else None
    for pattern, look in (LOOKS_LIKE | {"chessboard": partial(chessboard, not_px=between)}).items():
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


def chessboard(picture: NDArray[np.uint8], not_px: float | None = None) -> str | None:
    """Return what a picture of a chessboard shows, with the number of its squares, if these have not a given side."""
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    there, corners, meta = cv2.findChessboardCornersSBWithMeta(picture, FEWEST_CORNERS, flags)
    if not there or meta is None:
        return None
    shape = (int(meta.shape[0]), int(meta.shape[1]))
    places = np.asarray(corners, dtype=np.float64).reshape(*shape, 2)
    side = float(np.mean(np.hypot(*np.moveaxis(np.diff(places, axis=1), -1, 0))))
    if not alternating(picture, places) or (not_px is not None and abs(side / not_px - 1.0) < SAME_DISTANCE):
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
        if len(places) < FEWEST_SPOTS:
            continue
        distance = np.hypot(*np.moveaxis(places[:, np.newaxis] - places, -1, 0))
        nearest = np.min(distance + np.diag(np.full(len(places), np.inf)), axis=1)
        if np.mean(np.abs(nearest / np.median(nearest) - 1.0) < SAME_DISTANCE) >= EVEN_SHARE:
            return f"a board of {len(places)} {polarity} dots"
    return None


# In this order: a ChArUco board is a chessboard, too, and a chessboard's squares are round once they are out of focus.
LOOKS_LIKE = {"charuco": markers, "chessboard": chessboard, "dots": dots}

# A pixel shows a dot when it is brighter than this share of the brightest thousandth of the picture.
BRIGHT_SHARE = 0.2
# Depths are tried in steps over which the rim of the main lens moves a dot by half a microlens, up to ten microlenses
# either way: there the blur is as wide as usual dots are apart.
FOCUS_STEPS_PER_LENS = 2
FOCUS_LENSES = 10
# The refocused picture has two samples per microlens, smoothed by one microlens: finer, the gaps between microlenses
# that the focal plane has would pass for sharpness.
SAMPLES_PER_LENS = 2
# The refocused picture reaches this many widths of the sensor to either side: a tenth more than the focal plane has, as
# what lies behind it is seen wider.
HALF_WIDTH = 0.6
# Pixels that see the plane of the dots within this many microlenses of a dot's rim belong to its fit.
MARGIN_LENSES = 2.5
# What is wider than this share of the dots' distance in the refocused picture is light on the board, not a dot.
DOT_PER_SPACING = 0.5
# Magnification and distortion enter the place of each dot; one repetition with the measured ones leaves the square of
# their errors.
LENS_ROUNDS = 2
# Below this a change of scale at the board's corner moves nothing by a micrometre over a board of 10 mm.
SCALE_TOLERANCE = 1e-4


@dataclass(frozen=True, eq=False)
class DotLook(Look):
    """The dots of a board, to within a dot's radius.

    Attributes
    ----------
    radius_mm : of the dots
    start_mm : (n, 2) their lateral places, image axes
    depth_mm : of all of them
    """

    radius_mm: float
    start_mm: Floats
    depth_mm: float

    most_pixels = 10_000

    def moved(self, scale: float, depth_mm: float) -> DotLook:
        """Return the look with its dots nearer the axis by a scale, at another depth."""
        return replace(self, start_mm=self.start_mm / scale, depth_mm=depth_mm)

    def begun(self, camera: Camera, board: BoardGeometry) -> tuple[Floats, None, PointShape]:
        """Return where the dots were first seen; their grid tells which is which."""
        start = np.column_stack([self.start_mm, np.full(len(self.start_mm), self.depth_mm)])
        return start, None, disc_shape(self.radius_mm)

    def reach_mm(self, camera: Camera, board: BoardGeometry, z_mm: float) -> float:
        """Return how far some microlenses beyond the rim are, but not half-way to the next dot."""
        distance = float(equivalent_object_distance(z_mm, camera.focus_distance_mm, self.medium))
        forward = camera.image_distance_mm / distance
        return min(0.5 * board.spacing_mm, self.radius_mm + MARGIN_LENSES * float(camera.lattice.pitch.max()) / forward)


def disc_shape(radius_mm: float) -> PointShape:
    """Return the shape of a round dot."""
    return PointShape(radius_mm, radius_mm, covered_shares, radius_mm, partial(disc_strips, radius_mm))


def dots_look(image: Singles, passed: Singles, camera: Camera, board: BoardGeometry, media: Media) -> DotLook:
    """Find the dots of a board; errors are those of `locate_board`."""
    radius = 0.5 * board.dot_diameter_mm
    seen, pitch = abs(camera.magnification) * radius, float(camera.lattice.pitch.min())
    if seen < 0.25 * pitch:
        raise InputError(
            f"the board's dots are {written(2 * seen)} mm wide on the microlens array, less than half a microlens "
            f"({written(pitch)} mm); use a board with larger dots"
        )
    signal = dot_signal(image, passed, board)
    return DotLook(signal, passed, media, radius, *first_dots(signal, camera, board, media))


class PictureFrame(NamedTuple):
    """How a rectified picture was taken from the raw one.

    Attributes
    ----------
    rotation_rad : angle that was taken out
    off_px : (rows, columns, 2) where pixels lie beside their places, column first; None: there
    """

    rotation_rad: float = 0.0
    off_px: Singles | None = None


UNTURNED = PictureFrame()


def locate_board(
    image: Singles,
    camera: Camera,
    board: BoardGeometry,
    media: Media,
    frame: PictureFrame = UNTURNED,
    transmission: Singles | None = None,
    light: WaveLight | None = None,
) -> BoardPose:
    """Find the dots of a board in depth by fitting each one's rendering, and the board through them.

    Parameters
    ----------
    image : (rows, columns) rectified picture less the dark frame
    camera : with the lattice of the rectified frame
    frame : of image and transmission
    transmission : (rows, columns) share of light that pixels pass, rectified; default: all the same
    light : waves, behind square microlenses; default: rays

    Raises
    ------
    InputError : when too few dots are found to make a board
    ConfigError : light is waves and the array is hexagonal
    """
    if light is not None and camera.lattice.layout != "square":
        raise ConfigError(
            "reconstruction.wavelength_nm: by waves targets are fitted behind square lenses alone; leave it out"
        )
    passed = np.ones(image.shape, dtype=np.float32) if transmission is None else transmission
    sheet, micro_images, medium = camera, camera.micro_image_lattice_px(), board.seen_through(media)

    def seen(look: Look, by: WaveLight | None = None) -> tuple[BoardPose, Floats]:
        """Return the pose as the camera sees it, and where an ideal one has the points on the array (n, 2)."""
        places, sigmas, numbers = look.measured(camera, board, frame.rotation_rad, by)
        forward = camera.image_distance_mm / equivalent_object_distance(places[:, 2], camera.focus_distance_mm, medium)
        array = -forward[:, np.newaxis] * camera.to_image_axes(places)[:, :2]
        return pose_of_dots(places, sigmas, array, camera, board, numbers, medium), array

    try:
        look = replace(LOOKS[board.pattern](image, passed, camera, board, medium), off_px=frame.off_px)
        # Again with the magnification and the distortion that the first pose tells. Rays are near enough for these;
        # waves then take one look more.
        for _ in range(LENS_ROUNDS):
            pose, array = seen(look)
            ratio = pose.magnification / camera.magnification
            bend = pose.distortion_per_mm2 - camera.distortion_per_mm2
            if max(abs(ratio - 1.0), abs(bend) * float(np.sum(array**2, axis=1).max())) < SCALE_TOLERANCE:
                break
            camera = replace(refocused(camera, pose.magnification), distortion_per_mm2=pose.distortion_per_mm2)
            camera = camera.with_micro_images(micro_images)
            look = look.moved(ratio, pose.z0_mm)
        return pose if light is None else seen(look, light)[0]
    except InputError as error:
        if named := another_kind(evenly_lit(image, passed), sheet, board):
            raise InputError(f"{named}; correct the section board") from error
        raise


def dots_in_world(
    image: Singles, camera: Camera, board: BoardGeometry, media: Media, rotation_rad: float = 0.0
) -> Floats:
    """Return where the camera, believed as it is, sees each dot: (dots along y, dots along x, 3); NaN where none is.

    Parameters and errors are those of `locate_board`, which believes in the spacing and asks what the camera is.
    """
    look = dots_look(image, np.ones(image.shape, dtype=np.float32), camera, board, board.seen_through(media))
    places, _, _ = look.measured(camera, board, rotation_rad)
    kept, index = on_the_grid(places, board)
    dots = np.full((board.dots[1], board.dots[0], 3), np.nan)
    dots[index[:, 1], index[:, 0]] = places[kept]
    return dots


def dot_signal(image: Singles, passed: Singles, board: BoardGeometry) -> Floats:
    """Return the picture with the dots bright on a dim ground; dark dots are what the lit board lacks of full light.

    Dots cover the smaller part of a board: where the polarity is not known, most of the picture is the board.
    """
    if board.polarity == "bright":
        return image.astype(np.float64)
    usable = passed > 0.0
    light = image[usable] / passed[usable]
    level = np.median(light)
    dim, bright = np.percentile(light, [100.0 - BRIGHTEST_PERCENTILE, BRIGHTEST_PERCENTILE])
    if board.polarity == "auto" and level - dim < bright - level:
        return image.astype(np.float64)
    return np.asarray(level * passed - image, dtype=np.float64)


def first_dots(signal: Floats, camera: Camera, board: BoardGeometry, media: Media) -> tuple[Floats, float]:
    """Return the lateral places (n, 2) of the dots in image axes and their common depth, to within a dot's radius.

    The rays of all bright pixels are carried back to planes at equal steps of defocus alpha about the focal plane;
    where the dots are smallest, the sum of squares of the refocused picture is largest.
    """
    row, column = np.nonzero(signal > BRIGHT_SHARE * np.percentile(signal, BRIGHTEST_PERCENTILE))
    light = signal[row, column]
    if not light.size or light.min() <= 0.0:
        raise InputError("the board's picture shows no dots; check the exposure and board.polarity")
    sample_mm, half, pictures = refocusing(
        camera, media, (row, column), SAMPLES_PER_LENS, HALF_WIDTH, smoothing=SAMPLES_PER_LENS
    )
    widest = max(3, round(DOT_PER_SPACING * board.spacing_mm / sample_mm))

    step = float(camera.lattice.pitch.min()) / camera.aperture_radius_mm / FOCUS_STEPS_PER_LENS
    count, s_i = FOCUS_LENSES * FOCUS_STEPS_PER_LENS, camera.image_distance_mm
    distance = s_i / (step * np.arange(-count, count + 1) - 1.0 + s_i / camera.focal_length_mm)
    depths = (distance[distance > 0.0] - camera.focus_distance_mm) / media.depth_ratio

    def refocused(z_mm: float) -> Floats:
        (smooth,) = pictures(z_mm, light)
        return smooth - opened(smooth, widest)

    depth = float(depths[np.argmax([np.sum(refocused(z) ** 2) for z in depths])])
    spots = find_spots(refocused(depth), board.spacing_mm / sample_mm)
    return (spots - half[::-1]) * sample_mm, depth


# How the points of each pattern are found, by `board.pattern`.
LOOKS: dict[Pattern, Callable[..., Look]] = {"dots": dots_look, "chessboard": first_corners, "charuco": first_corners}
