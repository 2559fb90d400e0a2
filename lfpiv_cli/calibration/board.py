"""From one picture of a dot board to where the focal plane is, how the board is tilted, and the magnification.

Axes: the picture is rectified and its microlenses stand upright; the pose is given in world axes, those of the raw
sensor: x, y lateral, z away from the camera from the focal plane, in the medium the board stands in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose, on_the_grid, pose_of_dots
from lfpiv_cli.calibration.dot_model import (
    DiscFit,
    checked_disc_radius,
    fit_disc,
    lens_crossings,
    pixel_rays,
    scene_points,
)
from lfpiv_cli.calibration.rectification import turned
from lfpiv_cli.calibration.refocusing import Refocusing
from lfpiv_cli.calibration.spots import find_spots
from lfpiv_cli.errors import InputError
from lfpiv_cli.neighbourhoods import opened
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, equivalent_object_distance
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
# Pixels at the rim of a micro-image are lit in part, by light that does not come from where their middle sees, and
# rectification mixes neighbours; a pixel is used when the main lens's rim is more than half its patch's diagonal and a
# pixel away. Without that pixel depths are 0.2 % too large.
RIM_PER_PATCH = np.sqrt(0.5) + 1.0
# Fewer pixels than these are a dot at the sensor's edge: five unknowns need several times as many.
FEWEST_PIXELS = 50
# More pixels than these make a dot's fit slower and hardly better: the model's own errors are larger than their noise.
MOST_PIXELS = 10_000
# What is wider than this share of the dots' distance in the refocused picture is light on the board, not a dot.
DOT_PER_SPACING = 0.5
# Magnification and distortion enter the place of each dot; one repetition with the measured ones leaves the square of
# their errors.
LENS_ROUNDS = 2
# Below this a change of scale at the board's corner moves nothing by a micrometre over a board of 10 mm.
SCALE_TOLERANCE = 1e-4


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
    """

    signal: NDArray[np.float64]
    passed: NDArray[np.float32]
    medium: Media
    radius_mm: float
    start_mm: NDArray[np.float64]
    depth_mm: float

    def fits(
        self, camera: Camera, board: BoardGeometry, start_mm: NDArray[np.float64], depth_mm: float
    ) -> list[DiscFit | None]:
        """Fit a disc to each dot from a first guess of all."""
        scene = (self.signal, self.passed, camera, board, self.medium)
        return [fit_one_dot(*scene, (x, y, depth_mm), self.radius_mm) for x, y in start_mm]


def first_look(
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
) -> BoardPose:
    """Find the dots of a board in depth by fitting each one's rendering, and the board through them.

    Parameters
    ----------
    image : (rows, columns) rectified picture less the dark frame
    camera : with the lattice of the rectified frame
    rotation_rad : angle that rectification took out
    transmission : (rows, columns) share of light that pixels pass, rectified; default: all the same

    Raises
    ------
    InputError
        when too few dots are found to make a board
    """
    look = first_look(image, camera, board, media, transmission)
    start, depth = look.start_mm, look.depth_mm
    micro_images = camera.micro_image_lattice_px()
    for _ in range(LENS_ROUNDS):
        fits = look.fits(camera, board, start, depth)
        places, sigmas = world_places(fits, camera, rotation_rad)
        array = array_places(places, camera, look.medium)
        pose = pose_of_dots(places, sigmas, array, camera, board)
        ratio = pose.magnification / camera.magnification
        bend = pose.distortion_per_mm2 - camera.distortion_per_mm2
        if max(abs(ratio - 1.0), abs(bend) * float(np.sum(array**2, axis=1).max())) < SCALE_TOLERANCE:
            break
        camera = replace(
            camera, magnification=pose.magnification, distortion_per_mm2=pose.distortion_per_mm2
        ).with_micro_images(micro_images)
        start, depth = start / ratio, pose.z0_mm
    return pose


def dots_in_world(
    image: NDArray[np.float32], camera: Camera, board: BoardGeometry, media: Media, rotation_rad: float = 0.0
) -> NDArray[np.float64]:
    """Return where the camera, believed as it is, sees each dot: (dots along y, dots along x, 3); NaN where none is.

    Parameters and errors are those of `locate_board`, which believes in the spacing and asks what the camera is.
    """
    look = first_look(image, camera, board, media)
    places, _ = world_places(look.fits(camera, board, look.start_mm, look.depth_mm), camera, rotation_rad)
    kept, index = on_the_grid(places, board)
    dots = np.full((board.dots[1], board.dots[0], 3), np.nan)
    dots[index[:, 1], index[:, 0]] = places[kept]
    return dots


def world_places(
    fits: list[DiscFit | None], camera: Camera, rotation_rad: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return places and standard errors (n, 3) of the fitted dots, turned back to the raw sensor's axes."""
    good = [fit for fit in fits if fit is not None and fit.converged and fit.brightness > 0.0]
    places = np.array([fit.position_mm for fit in good]).reshape(-1, 3)
    sigmas = np.sqrt(np.array([np.diag(fit.covariance_mm2) for fit in good])).reshape(-1, 3)
    return camera.to_image_axes(turned(places, rotation_rad)), camera.to_image_axes(sigmas)


def array_places(places_mm: NDArray[np.float64], camera: Camera, media: Media) -> NDArray[np.float64]:
    """Return where an ideal main lens shows places (n, 3) on the array (n, 2), seen through its middle, image axes."""
    distance = equivalent_object_distance(places_mm[:, 2], camera.focus_distance_mm, media)
    forward = camera.image_distance_mm / distance
    return -forward[:, np.newaxis] * camera.to_image_axes(places_mm)[:, :2]


def dot_signal(image: NDArray[np.float32], passed: NDArray[np.float32], board: BoardGeometry) -> NDArray[np.float64]:
    """Return the picture with the dots bright on a dim ground; dark dots are what the lit board lacks of full light."""
    if board.polarity == "bright":
        return image.astype(np.float64)
    usable = passed > 0.0
    level = np.median(image[usable] / passed[usable])
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
) -> DiscFit | None:
    """Fit a disc to the pixels that see the surroundings of its first guess, in image axes; None off the sensor."""
    x, y, z = start_mm
    distance = float(equivalent_object_distance(z, camera.focus_distance_mm, media))
    forward = camera.image_distance_mm / distance
    pitch = float(camera.lattice.pitch.max())
    reach = min(0.5 * board.spacing_mm, radius_mm + MARGIN_LENSES * pitch / forward)
    blur = abs(float(camera.defocus(distance))) * camera.aperture_radius_mm
    half = (forward * reach + blur + pitch) / camera.pixel_mm
    middle = camera.mm_to_px(-forward * np.array([x, y]))
    low = np.maximum(np.floor(middle - half), 0).astype(np.int64)
    high = np.minimum(np.ceil(middle + half) + 1, [camera.columns, camera.rows]).astype(np.int64)
    row, column = (axis.ravel() for axis in np.mgrid[low[1] : high[1], low[0] : high[0]])
    rays = pixel_rays(camera, column, row)
    near = np.hypot(*(scene_points(rays, camera, media, z) - (x, y)).T) <= reach
    rim = RIM_PER_PATCH * camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
    through = np.hypot(*lens_crossings(rays, camera).T) <= camera.aperture_radius_mm - rim
    kept = np.nonzero(near & through & (passed[row, column] > 0.0))[0]
    if len(kept) < FEWEST_PIXELS:
        return None
    kept = kept[:: -(-len(kept) // MOST_PIXELS)]
    chosen = replace(rays, place_mm=rays.place_mm[kept], lens_mm=rays.lens_mm[kept], ideal_mm=rays.ideal_mm[kept])
    light = passed[row, column][kept].astype(np.float64)
    return fit_disc(
        signal[row, column][kept], light, chosen, np.array(start_mm, dtype=np.float64), radius_mm, camera, media
    )
