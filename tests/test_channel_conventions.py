"""Every convention against an experiment that an independent program rendered, and against rays calculated by hand.

Each test shows what its convention is worth: the pictures agree with ours, and agree clearly less with the convention
turned round. Nothing here uses a picture of our own as the truth.
"""

import json
import math
from dataclasses import dataclass

import numpy as np
import pytest
import tifffile

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window, channel_window, fluid_path_to_focus
from lfpiv_cli.optics.tracing import ObjectSpace, trace
from lfpiv_cli.synthetic import board as board_module
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.flows import advect, square_duct
from lfpiv_cli.synthetic.render import Balls, render_points, render_white
from tests.commands import WATER
from tests.known_rays import slopes_equivalent

AIR = ObjectSpace(Media())
TRACER_MM = 0.05
MEAN_M_S = 0.1082


@dataclass(frozen=True, eq=False)
class Experiment:
    """The data: truth, images less the dark level, tracers at the middle of the pair."""

    truth: dict
    images: dict
    positions_mm: np.ndarray
    velocities_m_s: np.ndarray

    def camera(self, rotation=1.0, shift=(1.0, 1.0), distortion=1.0, moved_px=(0.0, 0.0)):
        """Return the true camera; factors turn single imperfections round, `moved_px` moves the array."""
        true = self.truth["camera"]
        offset = (np.asarray(true["shift_px"]) * shift + moved_px) * true["pixel"]
        lattice = Lattice.regular(true["pitch"], "square", rotation * np.deg2rad(true["rotation_deg"]), offset)
        optics, sensor = ("M", "F", "aperture", "f_ml", "s_mu"), ("pixel", "cols", "rows")
        reported = [*(true[name] for name in optics), lattice, *(true[name] for name in sensor)]
        return Camera(*reported, distortion_per_mm2=distortion * true["k1"])

    def window(self):
        return Window(self.truth["window_distance_mm"], self.truth["wall_mm"])

    def frame_a(self, direction=-0.5):
        """Return where the tracers are `direction` delays after the middle of the pair."""
        return self.positions_mm + direction * 1e3 * self.truth["dt_s"] * self.velocities_m_s


@pytest.fixture(scope="module")
def experiment(data_folder):
    folder = data_folder / "channel"
    dark = 96.0  # the data's dark level, by its description
    images = {name: tifffile.imread(folder / f"{name}.tif") - dark for name in ("pair_a", "pair_b", "white", "board")}
    tracers = np.load(folder / "particles.npz")
    truth, position = json.loads((folder / "truth.json").read_text()), tracers["position_mm"].astype(float)
    return Experiment(truth, images, position, 1e-3 * tracers["velocity_mm_s"].astype(float))


def hand_pixel(points_mm, lens_mm, rotation_deg=0.12, shift_mm=(0.0187, -0.01155), k1=2e-5):
    """Return the (column, row) that rays strike, worked out line by line with Table 2's numbers."""
    x, y, z = np.asarray(points_mm, dtype=float).T
    big_x, big_y = lens_mm
    s_o = 200.0 + z / 1.33
    alpha = 200.0 / s_o - 1.0
    x_m, y_m = alpha * big_x - 200.0 / s_o * x, alpha * big_y - 200.0 / s_o * y
    stretch = 1.0 + k1 * (x_m**2 + y_m**2)
    cosine, sine = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    across, down = x_m * stretch - shift_mm[0], y_m * stretch - shift_mm[1]
    i = np.round((across * cosine + down * sine) / 0.1)
    j = np.round((down * cosine - across * sine) / 0.1)
    lens_x = shift_mm[0] + 0.1 * (i * cosine - j * sine)
    lens_y = shift_mm[1] + 0.1 * (i * sine + j * cosine)
    # f_m = s_mu: what leaves a microlens meets the sensor s_mu times its slope beside the lens's centre
    x_s, y_s = lens_x + 0.8 * (x_m - big_x) / 200.0, lens_y + 0.8 * (y_m - big_y) / 200.0
    return np.stack([x_s / 0.0055 + 1175.5, y_s / 0.0055 + 883.5], axis=-1)


# A tracer of the experiment, 0.9 ms before the middle of the pair: x = -3.56967 - 119.01 mm/s * 0.0009 s = -3.676779.
HAND_POINT = (-3.676779, 2.8659, 2.2977)
# s_o = 200 + 2.2977/1.33 = 201.727594, alpha = 200/201.727594 - 1 = -0.00856399.
# Through the centre of the main lens:
#   x_m = 3.676779 * 0.991436 = 3.645291, y_m = -2.8659 * 0.991436 = -2.841356
#   1 + 2e-5 * (13.288149 + 8.073305) = 1.00042723: distorted to (3.646848, -2.842570)
#   less the shift of 3.4, -2.1 px = (0.0187, -0.01155) mm, turned back by 0.12 degrees: (3.622211, -2.838613)
#   that is lens 36, -28; turned forth and shifted,
#   its centre is 3.6 c + 2.8 s + 0.0187 = 3.624556 and
#   3.6 s - 2.8 c - 0.01155 = -2.804004
#   on the sensor 3.624556 + 0.8 * 3.645291/200 = 3.639138 and -2.804004 - 0.8 * 2.841356/200 = -2.815369
#   column 3.639138/0.0055 + 1175.5 = 1837.161, row -2.815369/0.0055 + 883.5 = 371.615
# Through X = 9 mm:
#   x_m = -0.00856399 * 9 + 3.645291 = 3.568215; distorted by 1.00041611 to (3.569700, -2.842539)
#   (3.545063, -2.838420) in the array: lens 35, -28 at (3.524557, -2.804213)
#   on the sensor 3.524557 + 0.8 * (3.568215 - 9)/200 = 3.502829 and -2.815579: column 1812.378, row 371.577
HAND_RAYS = [((0.0, 0.0), (1837.161, 371.615)), ((9.0, 0.0), (1812.378, 371.577))]


@pytest.mark.parametrize(("lens", "pixel"), HAND_RAYS)
def test_a_ray_by_hand(experiment, lens, pixel):
    assert hand_pixel([HAND_POINT], lens)[0] == pytest.approx(pixel, abs=2e-3)
    camera = experiment.camera()
    point, crossing = np.array([HAND_POINT]), np.array([lens])
    hits = trace(camera, crossing, slopes_equivalent(point, crossing, camera, WATER))
    assert camera.mm_to_px(hits.sensor_mm)[0] == pytest.approx(pixel, abs=2e-3)
    column, row = np.rint(pixel).astype(int)
    # the data's tracer lights the pixel: the median pixel has 277 counts
    assert experiment.images["pair_a"][row, column] > 1000.0


def brightness_where(image, pixels):
    """Return the mean of an image at (column, row), over that of the whole image."""
    column, row = np.rint(pixels).astype(int).T
    inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
    return image[row[inside], column[inside]].mean() / image.mean()


HAND_TURNS = {
    "x": lambda p: (p * (-1, 1, 1), {}),
    "y": lambda p: (p * (1, -1, 1), {}),
    "z about the mid plane": lambda p: (p * (1, 1, -1) + (0, 0, -2 * 0.4655), {}),
    "x and y exchanged": lambda p: (p[:, [1, 0, 2]], {}),
    "rotation": lambda p: (p, {"rotation_deg": -0.12}),
    "shift": lambda p: (p, {"shift_mm": (-0.0187, 0.01155)}),
}


@pytest.mark.parametrize("lens", [(9.0, 0.0), (-9.0, 0.0), (0.0, 9.0), (0.0, -9.0)])
def test_rays_by_hand_meet_the_light_of_all_tracers(experiment, lens):
    """Where plain arithmetic sends a ray of each of the 8,300 tracers there is light; elsewhere if a sign is turned."""
    image, places = experiment.images["pair_a"], experiment.frame_a()
    found = brightness_where(image, hand_pixel(places, lens))
    assert found > 2.0
    for name, turn in HAND_TURNS.items():
        turned, camera = turn(places)
        assert brightness_where(image, hand_pixel(turned, lens, **camera)) < 0.75 * found, name


# A corner of the sensor, where rotation and distortion show most: the part that tracers with x 3.5 to 6.3 mm and y
# 2.2 to 4.7 mm light, by M = -1.
CORNER_MM = ((3.5, 6.3), (2.2, 4.7))
# Light spreads by 0.25 mm at most, distortion and refraction by 0.01 mm.
REACH_MM = 0.4
RAYS = 3000


def likeness(experiment, name, camera=None, places=None, refraction="exact"):
    """Return the correlation of a corner of an image of the pair with our rendering of the tracers at `places`."""
    camera = experiment.camera() if camera is None else camera
    places = experiment.frame_a() if places is None else places
    (x0, x1), (y0, y1) = CORNER_MM
    off = np.abs(places[:, :2] - np.mean(CORNER_MM, axis=1))
    near = np.all(off < np.array([x1 - x0, y1 - y0]) / 2 + REACH_MM, axis=1)
    space = ObjectSpace(WATER, experiment.window(), refraction)
    picture = render_points(camera, space, Balls(places[near], 1.0, TRACER_MM), np.random.default_rng(1), rays=RAYS)
    (c0, r0), (c1, r1) = np.rint(camera.mm_to_px([(-x1, -y1), (-x0, -y0)])).astype(int)
    part = (slice(r0, r1), slice(c0, c1))
    return np.corrcoef(picture[part].ravel(), experiment.images[name][part].ravel())[0, 1]


@pytest.fixture(scope="module")
def true_likeness(experiment):
    return likeness(experiment, "pair_a")


def test_the_data_s_window_and_tracers_are_where_and_move_as_they_say(experiment):
    # The path in the fluid to the mid plane is half the channel: 5 mm, from window_distance_mm and mid_plane_z_mm.
    camera = experiment.camera()
    path = fluid_path_to_focus(experiment.window(), camera.focus_distance_mm, WATER)
    mid_plane = experiment.truth["mid_plane_z_mm"]
    assert path + mid_plane == pytest.approx(5.0, abs=1e-9)
    window = channel_window(camera.focus_distance_mm, WATER, 10.0, experiment.truth["wall_mm"], mid_plane)
    assert window.distance_mm == pytest.approx(experiment.window().distance_mm, abs=1e-9)
    flow = square_duct(10.0, MEAN_M_S, (0.0, 0.0, experiment.truth["mid_plane_z_mm"]))
    # the data's mean over the section was taken on some grid: 2e-5 of the peak of 0.23 m/s
    assert flow(experiment.positions_mm) == pytest.approx(experiment.velocities_m_s, abs=6e-6)
    half = 0.5 * experiment.truth["dt_s"]
    assert advect(flow, experiment.positions_mm, -half) == pytest.approx(experiment.frame_a(), abs=1e-5)


def test_rendered_tracers_are_those_of_the_data(true_likeness):
    # what is missing from 1: unknown brightness of each tracer (0.6 to 1.4), shot noise, 3,000 rays
    assert true_likeness > 0.95


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("name", "turn"),
    [
        ("x", lambda p, mid: p * (-1, 1, 1)),
        ("y", lambda p, mid: p * (1, -1, 1)),
        ("x and y exchanged", lambda p, mid: p[:, [1, 0, 2]]),
        ("z about the mid plane", lambda p, mid: p * (1, 1, -1) + (0, 0, 2 * mid)),
    ],
)
def test_a_turned_axis_is_not_the_data_s(experiment, true_likeness, name, turn):
    turned = turn(experiment.frame_a(), experiment.truth["mid_plane_z_mm"])
    assert likeness(experiment, "pair_a", places=turned) < 0.4


@pytest.mark.thorough
def test_depth_s_origin_is_the_focal_point(experiment, true_likeness):
    """Tracers 0.2 mm nearer or further, or measured from the mid plane (0.4655 mm), fit less."""
    losses = []
    for offset in (-0.4655, -0.2, 0.2, 0.4655):
        places = experiment.frame_a() + (0, 0, offset)
        places = places[places[:, 2] > -5.465]  # behind the wall
        losses.append(true_likeness - likeness(experiment, "pair_a", places=places))
    assert min(losses) > 0.008
    assert losses[0] > 0.04
    assert losses[3] > 0.04


@pytest.mark.thorough
def test_frame_a_is_half_a_delay_before_the_middle(experiment, true_likeness):
    assert likeness(experiment, "pair_b", places=experiment.frame_a(0.5)) == pytest.approx(true_likeness, abs=0.01)
    assert likeness(experiment, "pair_a", places=experiment.frame_a(0.5)) < 0.6
    assert likeness(experiment, "pair_a", places=experiment.frame_a(0.0)) < 0.5


def test_rotation_goes_from_the_columns_towards_the_rows(experiment, true_likeness):
    assert likeness(experiment, "pair_a", experiment.camera(rotation=-1.0)) < 0.5


@pytest.mark.thorough
def test_shift_moves_the_array_along_columns_and_rows(experiment, true_likeness):
    for shift in ((-1.0, 1.0), (1.0, -1.0)):
        assert likeness(experiment, "pair_a", experiment.camera(shift=shift)) < 0.6


@pytest.mark.thorough
@pytest.mark.parametrize("half_px", [(0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)])
def test_the_axis_meets_the_middle_of_the_sensor(experiment, true_likeness, half_px):
    """A sensor counted from its pixels' corners, or from one pixel further, would be half a pixel off."""
    camera = experiment.camera(moved_px=half_px)
    # array and images move together, M = -1
    places = experiment.frame_a() - camera.pixel_mm * np.array([*half_px, 0.0])
    assert likeness(experiment, "pair_a", camera, places) < true_likeness - 0.02


@pytest.mark.thorough
def test_distortion_moves_rays_outwards_before_the_lens_is_chosen(experiment, true_likeness):
    without, turned = (likeness(experiment, "pair_a", experiment.camera(distortion=k)) for k in (0.0, -1.0))
    assert without < true_likeness - 0.003
    assert turned < true_likeness - 0.015


@pytest.mark.thorough
def test_the_white_image_shows_lattice_and_half_pixels(experiment):
    def likeness_of(camera):
        return np.corrcoef(render_white(camera, 1.0, 2).ravel(), experiment.images["white"].ravel())[0, 1]

    true = likeness_of(experiment.camera())
    assert true > 0.97  # the data's own noise of 8 % per pixel, four samples of ours
    assert likeness_of(experiment.camera(rotation=-1.0)) < 0.6
    for moved in ((0.5, 0.0), (-0.5, 0.0), (0.0, 0.5), (0.0, -0.5)):
        assert likeness_of(experiment.camera(moved_px=moved)) < true - 0.04, moved
    for shift in ((-1.0, 1.0), (1.0, -1.0)):
        assert likeness_of(experiment.camera(shift=shift)) < true - 0.2, shift


def board_misfit(experiment, camera, z_factor=1.0, tilt=(1.0, 1.0), offset=(1.0, 1.0), rotation_deg=0.0):
    """Return the share of the board picture's variance that our board, turned round as told, leaves unexplained."""
    true = experiment.truth
    offset, tilt = np.multiply(true["board"]["offset"], offset), np.multiply(true["board"]["tilt_deg"], tilt)
    placement = BoardPlacement(z_factor * true["board_z_mm"], tuple(offset), tuple(tilt), rotation_deg)
    board = BoardGeometry((7, 7), 1.0, 0.2)
    picture = render_board(camera, AIR, board, placement, 1000.0, np.random.default_rng(1))
    part = (slice(250, 1518), slice(530, 1822))  # +-3.5 mm about the axis
    return 1.0 - np.corrcoef(picture[part].ravel(), experiment.images["board"][part].ravel())[0, 1] ** 2


@pytest.mark.thorough
def test_the_board_stands_as_the_data_s(experiment, monkeypatch):
    monkeypatch.setattr(board_module, "RAYS_PER_POINT", 600)
    camera = experiment.camera()
    true = board_misfit(experiment, camera)
    assert true < 0.01
    assert board_misfit(experiment, camera, z_factor=-1.0) > 10 * true
    for offset in ((-1.0, 1.0), (1.0, -1.0)):
        assert board_misfit(experiment, camera, offset=offset) > 0.8
    # the outer dots move by 0.04 and 0.03 mm in depth, a hundredth of a microlens at the aperture's edge
    assert board_misfit(experiment, camera, tilt=(-1.0, 1.0)) > 1.03 * true
    assert board_misfit(experiment, camera, tilt=(1.0, -1.0)) > 1.01 * true
    # half a pixel of the array, a tenth of a degree of the board
    assert board_misfit(experiment, experiment.camera(moved_px=(0.5, 0.0))) > 1.5 * true
    assert board_misfit(experiment, camera, rotation_deg=0.1) > 1.3 * true
    assert board_misfit(experiment, experiment.camera(distortion=-1.0)) > 1.03 * true


@pytest.mark.slow
def test_the_whole_pair_is_the_data_s(experiment):
    """All tracers at full size, through the whole window: both frames, the crossed ones as a measure."""
    space = ObjectSpace(WATER, experiment.window())
    for direction, same, other in ((-0.5, "pair_a", "pair_b"), (0.5, "pair_b", "pair_a")):
        places = experiment.frame_a(direction)
        balls = Balls(places, 1.0, TRACER_MM)
        picture = render_points(experiment.camera(), space, balls, np.random.default_rng(1)).ravel()
        assert np.corrcoef(picture, experiment.images[same].ravel())[0, 1] > 0.965
        assert np.corrcoef(picture, experiment.images[other].ravel())[0, 1] < 0.3
