"""From one picture of a calibration target to where the focal plane is, how the board is tilted, and the magnification.

Axes: the picture is rectified and its microlenses stand upright; the pose is given in world axes, those of the raw
sensor: x, y lateral, z away from the camera from the focal plane, in the medium the board stands in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose, on_the_grid, pose_of_dots
from lfpiv_cli.calibration.corners import first_corners
from lfpiv_cli.calibration.dot_model import (
    checked_disc_radius,
    fit_disc,
)
from lfpiv_cli.calibration.measured_points import MeasuredPoints, measured_points
from lfpiv_cli.calibration.near_pixels import pixels_near
from lfpiv_cli.calibration.rectification import turned
from lfpiv_cli.calibration.refocusing import Refocusing
from lfpiv_cli.calibration.shape_fit import ShapeFit
from lfpiv_cli.calibration.spots import find_spots
from lfpiv_cli.calibration.target_kinds import another_kind
from lfpiv_cli.calibration.wave_shapes import WaveLight, WaveShapes, disc_strips, together
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.names import Pattern
from lfpiv_cli.neighbourhoods import opened
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.pupils import refocused
from lfpiv_cli.robust import BRIGHTEST_PERCENTILE

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
# Pixels that see the plane of the dots within this many microlenses of a dot's rim, but not half-way to the next dot,
# belong to its fit.
MARGIN_LENSES = 2.5
# What is wider than this share of the dots' distance in the refocused picture is light on the board, not a dot.
DOT_PER_SPACING = 0.5
# Magnification and distortion enter the place of each dot; one repetition with the measured ones leaves the square of
# their errors.
LENS_ROUNDS = 2
# Below this a change of scale at the board's corner moves nothing by a micrometre over a board of 10 mm.
SCALE_TOLERANCE = 1e-4


class Look(Protocol):
    """A picture of a target and the points in it, roughly; `medium` is what the target stands in."""

    @property
    def medium(self) -> Media: ...

    def moved(self, scale: float, depth_mm: float) -> Look:
        """Return the look with its points nearer the axis by a scale, at another depth."""

    def by_waves(self, light: WaveLight) -> Look:
        """Return the look with points that are measured by waves."""

    def measured(self, camera: Camera, board: BoardGeometry) -> MeasuredPoints:
        """Measure the points."""


@dataclass(frozen=True, eq=False)
class FirstLook:
    """A picture of a board and the dots in it, to within a dot's radius.

    Attributes
    ----------
    signal : (rows, columns), dots bright
    passed : (rows, columns) share of light that pixels pass
    medium : what the board stands in
    radius_mm : of the dots
    start_mm : (n, 2) their lateral places, image axes
    depth_mm : of all of them
    light : waves that the dots send; None: rays
    """

    signal: NDArray[np.float64]
    passed: NDArray[np.float32]
    medium: Media
    radius_mm: float
    start_mm: NDArray[np.float64]
    depth_mm: float
    light: WaveLight | None = None

    def moved(self, scale: float, depth_mm: float) -> FirstLook:
        """Return the look with its dots nearer the axis by a scale, at another depth."""
        return replace(self, start_mm=self.start_mm / scale, depth_mm=depth_mm)

    def by_waves(self, light: WaveLight) -> FirstLook:
        """Return the look with dots that are fitted by waves, from where rays have them."""
        return replace(self, light=light)

    def measured(self, camera: Camera, board: BoardGeometry) -> MeasuredPoints:
        """Fit a disc to each dot."""
        start = np.column_stack([self.start_mm, np.full(len(self.start_mm), self.depth_mm)])
        found = self._fitted(start, camera, board)
        if self.light is None or not len(found.places_mm):
            return found
        start = found.places_mm[together(found.places_mm[:, 2], camera, self.medium)]
        return self._fitted(start, camera, board, WaveShapes.of(camera, self.medium, self.light, start[:, 2]))

    def _fitted(
        self, start_mm: NDArray[np.float64], camera: Camera, board: BoardGeometry, waves: WaveShapes | None = None
    ) -> MeasuredPoints:
        """Fit discs from first guesses (n, 3), by rays or by waves."""
        scene = (self.signal, self.passed, camera, board, self.medium)
        fits = [fit_one_dot(*scene, (x, y, z), self.radius_mm, waves) for x, y, z in start_mm]
        return measured_points([fit if fit is not None and fit.brightness > 0.0 else None for fit in fits])


def first_dots_look(
    image: NDArray[np.float32],
    camera: Camera,
    board: BoardGeometry,
    media: Media,
    transmission: NDArray[np.float32] | None = None,
) -> FirstLook:
    """Find the dots of a board; parameters and errors are those of `locate_board`."""
    medium = media.in_air() if board.medium == "air" else media
    radius = checked_disc_radius(0.5 * board.dot_diameter_mm, camera)
    passed = np.ones(image.shape, dtype=np.float32) if transmission is None else transmission
    signal = dot_signal(image, passed, board)
    return FirstLook(
        signal, passed, medium, radius, *first_dots(signal, camera, board, medium, candidate_depths(camera, medium))
    )


def locate_board(
    image: NDArray[np.float32],
    camera: Camera,
    board: BoardGeometry,
    media: Media,
    rotation_rad: float = 0.0,
    transmission: NDArray[np.float32] | None = None,
    light: WaveLight | None = None,
) -> BoardPose:
    """Find the dots of a board in depth by fitting each one's rendering, and the board through them.

    Parameters
    ----------
    image : (rows, columns) rectified picture less the dark frame
    camera : with the lattice of the rectified frame
    rotation_rad : angle that rectification took out
    transmission : (rows, columns) share of light that pixels pass, rectified; default: all the same
    light : waves, behind square microlenses; default: rays

    Raises
    ------
    InputError
        when too few dots are found to make a board
    ConfigError
        light is waves and the array is hexagonal
    """
    if light is not None and camera.lattice.layout != "square":
        raise ConfigError(
            "reconstruction.wavelength_nm: by waves targets are fitted behind square lenses alone; leave it out"
        )
    try:
        return _pose(
            LOOKS[board.pattern](image, camera, board, media, transmission), camera, board, rotation_rad, light
        )
    except InputError as error:
        if named := another_kind(image, camera, board, transmission):
            raise InputError(f"{named}; correct the section board") from error
        raise


def _pose(
    look: Look, camera: Camera, board: BoardGeometry, rotation_rad: float, light: WaveLight | None = None
) -> BoardPose:
    """Return the pose of a target, again with the magnification and the distortion that the first one tells.

    Rays are near enough for these; waves then take one look more.
    """
    micro_images = camera.micro_image_lattice_px()
    for _ in range(LENS_ROUNDS):
        pose, array = _seen(look, camera, board, rotation_rad)
        ratio = pose.magnification / camera.magnification
        bend = pose.distortion_per_mm2 - camera.distortion_per_mm2
        if max(abs(ratio - 1.0), abs(bend) * float(np.sum(array**2, axis=1).max())) < SCALE_TOLERANCE:
            break
        camera = replace(refocused(camera, pose.magnification), distortion_per_mm2=pose.distortion_per_mm2)
        camera = camera.with_micro_images(micro_images)
        look = look.moved(ratio, pose.z0_mm)
    return pose if light is None else _seen(look.by_waves(light), camera, board, rotation_rad)[0]


def _seen(
    look: Look, camera: Camera, board: BoardGeometry, rotation_rad: float
) -> tuple[BoardPose, NDArray[np.float64]]:
    """Return the pose as a camera sees it, and where an ideal one has the points on the array (n, 2)."""
    found = look.measured(camera, board)
    places, sigmas = world_places(found, camera, rotation_rad)
    array = array_places(places, camera, look.medium)
    return pose_of_dots(places, sigmas, array, camera, board, found.numbers), array


def dots_in_world(
    image: NDArray[np.float32], camera: Camera, board: BoardGeometry, media: Media, rotation_rad: float = 0.0
) -> NDArray[np.float64]:
    """Return where the camera, believed as it is, sees each dot: (dots along y, dots along x, 3); NaN where none is.

    Parameters and errors are those of `locate_board`, which believes in the spacing and asks what the camera is.
    """
    found = first_dots_look(image, camera, board, media).measured(camera, board)
    places, _ = world_places(found, camera, rotation_rad)
    kept, index = on_the_grid(places, board)
    dots = np.full((board.dots[1], board.dots[0], 3), np.nan)
    dots[index[:, 1], index[:, 0]] = places[kept]
    return dots


def world_places(
    found: MeasuredPoints, camera: Camera, rotation_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places and standard errors (n, 3) of the measured points, turned back to the raw sensor's axes."""
    places, sigmas = found.places_mm, found.sigmas_mm
    return camera.to_image_axes(turned(places, rotation_rad)), camera.to_image_axes(sigmas)


def array_places(places_mm: NDArray[np.float64], camera: Camera, media: Media) -> NDArray[np.float64]:
    """Return where an ideal main lens shows places (n, 3) on the array (n, 2), seen through its middle, image axes."""
    distance = equivalent_object_distance(places_mm[:, 2], camera.focus_distance_mm, media)
    forward = camera.image_distance_mm / distance
    return -forward[:, np.newaxis] * camera.to_image_axes(places_mm)[:, :2]


def dot_signal(image: NDArray[np.float32], passed: NDArray[np.float32], board: BoardGeometry) -> NDArray[np.float64]:
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


def first_dots(
    signal: NDArray[np.float64], camera: Camera, board: BoardGeometry, media: Media, depths_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return the lateral places (n, 2) of the dots in image axes and their common depth, to within a dot's radius.

    The rays of all bright pixels are carried back to planes at `depths_mm`; where the dots are smallest, the sum of
    squares of the refocused picture is largest.
    """
    row, column = np.nonzero(signal > BRIGHT_SHARE * np.percentile(signal, BRIGHTEST_PERCENTILE))
    light = signal[row, column]
    if not light.size or light.min() <= 0.0:
        raise InputError("the board's picture shows no dots; check the exposure and board.polarity")
    planes = Refocusing.of(camera, media, (row, column), SAMPLES_PER_LENS, HALF_WIDTH)
    widest = max(3, round(DOT_PER_SPACING * board.spacing_mm / planes.sample_mm))

    def refocused(z_mm: float) -> NDArray[np.float64]:
        (smooth,) = planes.pictures(z_mm, (light,), SAMPLES_PER_LENS)
        return smooth - opened(smooth, widest)

    depth = float(depths_mm[np.argmax([np.sum(refocused(z) ** 2) for z in depths_mm])])
    spots = find_spots(refocused(depth), board.spacing_mm / planes.sample_mm)
    return (spots - planes.half[::-1]) * planes.sample_mm, depth


def candidate_depths(camera: Camera, media: Media) -> NDArray[np.float64]:
    """Return depths in the medium at equal steps of defocus alpha about the focal plane."""
    step = float(camera.lattice.pitch.min()) / camera.aperture_radius_mm / FOCUS_STEPS_PER_LENS
    count = FOCUS_LENSES * FOCUS_STEPS_PER_LENS
    alpha = step * np.arange(-count, count + 1)
    s_i = camera.image_distance_mm
    distance = s_i / (alpha - 1.0 + s_i / camera.focal_length_mm)
    depths = (distance[distance > 0.0] - camera.focus_distance_mm) / media.depth_ratio
    return np.asarray(depths, dtype=np.float64)


def fit_one_dot(
    signal: NDArray[np.float64],
    passed: NDArray[np.float32],
    camera: Camera,
    board: BoardGeometry,
    media: Media,
    start_mm: tuple[float, float, float],
    radius_mm: float,
    waves: WaveShapes | None = None,
) -> ShapeFit | None:
    """Fit a disc to the pixels that see the surroundings of its first guess, in image axes; None off the sensor."""
    distance = float(equivalent_object_distance(start_mm[2], camera.focus_distance_mm, media))
    forward = camera.image_distance_mm / distance
    pitch = float(camera.lattice.pitch.max())
    reach = min(0.5 * board.spacing_mm, radius_mm + MARGIN_LENSES * pitch / forward)
    near = pixels_near((signal, passed), camera, media, start_mm, reach)
    if near is None:
        return None
    start = np.array(start_mm, dtype=np.float64)
    if waves is None:
        return fit_disc(near.signal, near.passed, near.rays, start, radius_mm, camera, media)
    return waves.fit(near, start, radius_mm, disc_strips(radius_mm, waves.lens_mm))


# How the points of each pattern are found, by `board.pattern`.
LOOKS: dict[Pattern, Callable[..., Look]] = {
    "dots": first_dots_look,
    "chessboard": first_corners,
    "charuco": first_corners,
}
