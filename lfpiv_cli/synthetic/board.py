"""Expected images of calibration targets: round dots, or what is printed on a plate.

Axes: world axes, z away from the camera from the nominal focal point. The board is turned in its plane (from x towards
y), tilted, and moved to its place, in this order, as a rigid plate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.shape_fit import nearest_points
from lfpiv_cli.calibration.views import charuco_board
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, Objective, undistorted
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media, equivalent_object_distance, exact_lateral_mm
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.synthetic.rays import GOLDEN_ANGLE, SEQUENCE, diffused_mm
from lfpiv_cli.synthetic.render import Balls, Space, lens_blur_mm, render_points, render_white

# Expected images of calibration targets printed on a plate: chessboards and ChArUco boards.
#
# Each pixel's rays are followed backwards, through the microlens and the main lens (Eq. 1) to the plate, through
# window and fluid by Snell's law (Eq. 4); the pixel shows the share of them that ends on something bright.
#
# Axes: image axes (x along the columns), mm, z away from the camera from the nominal focal point.

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

    middle_mm: Floats
    along_x: Floats
    along_y: Floats
    picture: Singles
    samples_per_mm: float


def printed_plate(camera: Camera, board: BoardGeometry, placement: BoardPlacement) -> Plate:
    """Return the plate of a target: what is printed, rows along y and columns along x, `SQUARE_SAMPLES` to a square."""
    # the plate's middle, and the points a millimetre from it along x and along y
    middle, x, y = camera.to_image_axes(placement.to_world([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    # a print is read from the front, whatever the sensor's axes are called
    along_x = x - middle if camera.column_axis == "x" else middle - x
    across, down = (n + 1 for n in board.dots)
    margin = round(MARGIN_SQUARES * SQUARE_SAMPLES)
    if board.pattern == "charuco":
        size = (across * SQUARE_SAMPLES + 2 * margin, down * SQUARE_SAMPLES + 2 * margin)
        picture = np.asarray(charuco_board(board).generateImage(size, marginSize=margin), dtype=np.uint8)
    else:
        squares = np.kron(255 * (np.indices((down, across)).sum(axis=0) % 2), np.ones((SQUARE_SAMPLES, SQUARE_SAMPLES)))
        around = (squares.astype(np.uint8), margin, margin, margin, margin)
        picture = np.asarray(cv2.copyMakeBorder(*around, cv2.BORDER_CONSTANT, value=255))
    printed = picture.astype(np.float32) / 255.0
    return Plate(middle, along_x, y - middle, printed, SQUARE_SAMPLES / board.spacing_mm)


def render_plate(camera: Camera, space: ObjectSpace, plate: Plate, level: float, blur_px: Floats) -> Floats:
    """Render a lit plate, (rows, columns) float64 expected counts; light outside a pixel's own micro-image is left out.

    Parameters
    ----------
    level : expected counts of a pixel that sees only what is bright
    blur_px : (n, 2) places beside where rays would end on the sensor, which they take in turn

    Raises
    ------
    ConfigError : no window for exact refraction
    """
    samples = SAMPLES_PER_SIDE if len(blur_px) == 1 else BLURRED_SAMPLES_PER_SIDE
    line = (np.arange(samples) + 0.5) / samples - 0.5
    # about the middle of a pixel, where rays would end but for the blur
    places = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2) - blur_px[np.arange(samples**2) % len(blur_px)]
    basis, size = camera.lattice.basis, np.array(plate.picture.shape[::-1])
    image = np.empty((camera.rows, camera.columns))
    for top in range(0, camera.rows, ROWS_AT_ONCE):
        row, column = np.mgrid[top : min(top + ROWS_AT_ONCE, camera.rows), : camera.columns]
        px = np.stack([column, row], axis=-1).astype(np.float64)
        first, total = (px @ PIXEL_STEPS).reshape(-1, 2), np.zeros(px.shape[:2])
        for k, place in enumerate(places):
            cell = ((first + k * SEQUENCE[:2]) % 1.0) @ basis
            offset = cell - nearest_points(cell, np.zeros(2), basis)
            crossing, slope = _rays_to((px + place).reshape(-1, 2), offset, camera)
            passes = np.flatnonzero(np.hypot(crossing[:, 0], crossing[:, 1]) <= camera.aperture_radius_mm)
            on_plate = _on_plate(crossing[passes], slope[passes], camera, space, plate)
            x, y = np.floor(on_plate * plate.samples_per_mm + size / 2.0).astype(np.int64).T
            there = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
            printed = plate.picture[np.where(there, y, 0), np.where(there, x, 0)]
            total.ravel()[passes] += np.where(there, printed, np.float32(0.0))
        image[top : top + len(px)] = level * (total / len(places))
    return image


def _rays_to(px: Floats, offset_mm: Floats, camera: Camera) -> tuple[Floats, Floats]:
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


def _on_plate(crossing_mm: Floats, slope: Floats, camera: Camera, space: ObjectSpace, plate: Plate) -> Floats:
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


# A dot is made of this many points in a sunflower's order, small balls that close the gaps between them: 0.2 mm dots of
# 0.0125 mm points, an eighth of a microlens. By waves they are points: 1 % of their light (L1) is astray.
POINTS_PER_DOT = 256

# A dot as bright as a white image sends some 5e6 photons: these rays add about half of its shot noise.
RAYS_PER_POINT = 4_000


@dataclass(frozen=True)
class BoardPlacement:
    """Where a board stands.

    Attributes
    ----------
    z_mm : depth of its centre, in the medium it stands in
    offset_mm : (x0, y0) of its centre
    tilt_deg : (a, b) with z = z_mm + tan a (x - x0) + tan b (y - y0)
    rotation_deg : of its rows, from x towards y
    """

    z_mm: float
    offset_mm: tuple[float, float] = (0.0, 0.0)
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    rotation_deg: float = 0.0

    def to_world(self, plate_mm: ArrayLike) -> Floats:
        """Return points of the plate, (..., 2) about its centre, in world axes, (..., 3)."""
        plate = np.asarray(plate_mm, dtype=np.float64)
        turn = np.deg2rad(self.rotation_deg)
        axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0]])
        # the shortest rotation that brings the z axis onto the plate's normal
        normal = np.array([*-np.tan(np.deg2rad(self.tilt_deg)), 1.0])
        normal /= np.linalg.norm(normal)
        x, y, z = normal
        spin = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
        tilt = np.eye(3) + spin + spin @ spin / (1.0 + z)
        return plate @ axes @ tilt.T + np.array([*self.offset_mm, self.z_mm])


def dot_centres(board: BoardGeometry, placement: BoardPlacement) -> Floats:
    """Return the dots' centres in world axes, (n, 3) mm, the first index along x running fastest."""
    return placement.to_world(_plate_centres(board))


def _plate_centres(board: BoardGeometry) -> Floats:
    x, y = (board.spacing_mm * (np.arange(n) - (n - 1) / 2) for n in board.dots)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def points_of(board: BoardGeometry) -> int:
    """Return of how many points a board's picture is made, 0 of a print."""
    return POINTS_PER_DOT * board.dots[0] * board.dots[1] if board.pattern == "dots" else 0


def render_board(
    camera: Camera,
    space: Space,
    board: BoardGeometry,
    placement: BoardPlacement,
    level: float,
    rng: np.random.Generator,
    shown: ArrayLike | None = None,
    *,
    waves: Waves | None = None,
    progress: Callable[[int], None] | None = None,
) -> Floats:
    """Render bright dots on dark ground, dark dots on ground that fills the view, or a lit print.

    Parameters
    ----------
    level : expected counts of a pixel that sees only what is bright, as in a white image
    shown : (n,) bool, which dots there are, the first index along x running fastest; default: all
    waves : what light is made of; default: rays. A print is then shown by rays that are blurred by what lenses diffract
    progress : called with the number of `points_of` that are done

    Returns
    -------
    (rows, columns) float64, expected counts; dots behind curved faces are as bright as behind plane ones

    Raises
    ------
    ConfigError : a printed plate behind curved faces, or by an objective that does more than lose light
    """
    if board.pattern != "dots":
        if camera.objective != Objective(falloff_per_mm2=camera.objective.falloff_per_mm2):
            raise ConfigError(
                f"board.pattern: is {board.pattern}; by a simulation.objective with more than falloff only dots are "
                "simulated"
            )
        if isinstance(space, CurvedSpace):
            raise ConfigError(f"board.pattern: is {board.pattern}; behind the faces of a scene only dots are simulated")
        blur = diffused_mm(camera) if waves is None else lens_blur_mm(camera, waves)
        return render_plate(camera, space, printed_plate(camera, board, placement), level, blur / camera.pixel_mm)
    plate = _plate_centres(board)
    if shown is not None:
        plate = plate[np.asarray(shown, dtype=bool)]
    inside = sunflower(POINTS_PER_DOT, 0.5 * board.dot_diameter_mm)
    points = placement.to_world(plate[:, np.newaxis, :] + inside).reshape(-1, 3)
    area = 0.25 * np.pi * board.dot_diameter_mm**2 / POINTS_PER_DOT
    light = area * light_per_area(camera, space.media, points[:, 2], level)
    size = board.dot_diameter_mm / np.sqrt(POINTS_PER_DOT) if waves is None else 0.0
    balls = Balls(points, light, size)
    dots = render_points(camera, space, balls, rng, waves=waves, rays=RAYS_PER_POINT, progress=progress)
    if board.polarity != "dark":
        return dots
    # the rays' noise may ask for more than there is
    return np.maximum(render_white(camera, level, waves=waves) - dots, 0.0)


def light_per_area(camera: Camera, media: Media, z_mm: ArrayLike, level: float) -> Floats:
    """Return the light of a plane at depth z that gives pixels `level` counts where it fills the aperture, per mm^2.

    A micro-image has `level` times its pixels; it comes from one lens's cell of the array, which is that of the plane
    magnified by s_i/s_o.
    """
    distance = equivalent_object_distance(z_mm, camera.focus_distance_mm, media)
    micro_image_radius = camera.aperture_radius_mm * camera.microlens_distance_mm / camera.image_distance_mm
    per_lens = level * np.pi * micro_image_radius**2 / camera.pixel_mm**2
    return per_lens / camera.lattice.cell_area * (camera.image_distance_mm / distance) ** 2


def sunflower(count: int, radius: float) -> Floats:
    """Return points that fill a disc evenly, (count, 2), their mean at its centre: the order alone is off by 0.2 %."""
    k = np.arange(count)
    r = radius * np.sqrt((k + 0.5) / count)
    points = np.stack([r * np.cos(k * GOLDEN_ANGLE), r * np.sin(k * GOLDEN_ANGLE)], axis=1)
    return np.asarray(points - points.mean(axis=0), dtype=np.float64)
