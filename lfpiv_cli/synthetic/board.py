"""Expected images of calibration targets: round dots, or what is printed on a plate.

Axes: world axes, z away from the camera from the nominal focal point. The board is turned in its plane (from x towards
y), tilted, and moved to its place, in this order, as a rigid plate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, Objective
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.synthetic.printed import printed_plate, render_plate
from lfpiv_cli.synthetic.render import Balls, Space
from lfpiv_cli.synthetic.wave_images import lens_blur_mm, render_balls, white_image

# A dot is made of this many points in a sunflower's order, small balls that close the gaps between them: 0.2 mm dots of
# 0.0125 mm points, an eighth of a microlens. By waves they are points: 1 % of their light (L1) is astray.
POINTS_PER_DOT = 256
GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))

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

    def to_world(self, plate_mm: ArrayLike) -> NDArray[np.float64]:
        """Return points of the plate, (..., 2) about its centre, in world axes, (..., 3)."""
        plate = np.asarray(plate_mm, dtype=np.float64)
        turn = np.deg2rad(self.rotation_deg)
        axes = np.array([[np.cos(turn), np.sin(turn), 0.0], [-np.sin(turn), np.cos(turn), 0.0]])
        return plate @ axes @ self._tilt_matrix().T + np.array([*self.offset_mm, self.z_mm])

    def _tilt_matrix(self) -> NDArray[np.float64]:
        """Return the shortest rotation that brings the z axis onto the plate's normal."""
        normal = np.array([*-np.tan(np.deg2rad(self.tilt_deg)), 1.0])
        normal /= np.linalg.norm(normal)
        x, y, z = normal
        spin = np.array([[0.0, 0.0, x], [0.0, 0.0, y], [-x, -y, 0.0]])
        return np.eye(3) + spin + spin @ spin / (1.0 + z)


def dot_centres(board: BoardGeometry, placement: BoardPlacement) -> NDArray[np.float64]:
    """Return the dots' centres in world axes, (n, 3) mm, the first index along x running fastest."""
    return placement.to_world(_plate_centres(board))


def _plate_centres(board: BoardGeometry) -> NDArray[np.float64]:
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
) -> NDArray[np.float64]:
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
        steps = placement.to_world([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        blur = None if waves is None else lens_blur_mm(camera, waves) / camera.pixel_mm
        return render_plate(camera, space, printed_plate(camera, board, steps), level, blur)
    plate = _plate_centres(board)
    if shown is not None:
        plate = plate[np.asarray(shown, dtype=bool)]
    inside = sunflower(POINTS_PER_DOT, 0.5 * board.dot_diameter_mm)
    points = placement.to_world(plate[:, np.newaxis, :] + inside).reshape(-1, 3)
    area = 0.25 * np.pi * board.dot_diameter_mm**2 / POINTS_PER_DOT
    light = area * light_per_area(camera, space.media, points[:, 2], level)
    size = board.dot_diameter_mm / np.sqrt(POINTS_PER_DOT) if waves is None else 0.0
    dots = render_balls(camera, space, Balls(points, light, size), rng, waves, rays=RAYS_PER_POINT, progress=progress)
    if board.polarity != "dark":
        return dots
    # the rays' noise may ask for more than there is
    return np.maximum(white_image(camera, waves, level) - dots, 0.0)


def light_per_area(camera: Camera, media: Media, z_mm: ArrayLike, level: float) -> NDArray[np.float64]:
    """Return the light of a plane at depth z that gives pixels `level` counts where it fills the aperture, per mm^2.

    A micro-image has `level` times its pixels; it comes from one lens's cell of the array, which is that of the plane
    magnified by s_i/s_o.
    """
    distance = equivalent_object_distance(z_mm, camera.focus_distance_mm, media)
    micro_image_radius = camera.aperture_radius_mm * camera.microlens_distance_mm / camera.image_distance_mm
    per_lens = level * np.pi * micro_image_radius**2 / camera.pixel_mm**2
    return per_lens / camera.lattice.cell_area * (camera.image_distance_mm / distance) ** 2


def sunflower(count: int, radius: float) -> NDArray[np.float64]:
    """Return points that fill a disc evenly, (count, 2), their mean at its centre: the order alone is off by 0.2 %."""
    k = np.arange(count)
    r = radius * np.sqrt((k + 0.5) / count)
    points = np.stack([r * np.cos(k * GOLDEN_ANGLE), r * np.sin(k * GOLDEN_ANGLE)], axis=1)
    return np.asarray(points - points.mean(axis=0), dtype=np.float64)
