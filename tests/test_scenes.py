"""Simulated scenes: what the truth says is what the images show."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.media import Media, channel_window, fluid_path_to_focus
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic import scenes
from lfpiv_cli.synthetic.board import BoardPlacement
from lfpiv_cli.synthetic.flows import Pulsation, advect, random_modes, rigid_rotation, uniform
from lfpiv_cli.synthetic.render import Balls, Readout, render_points
from lfpiv_cli.synthetic.scenes import Box, Motion, RecordingCamera, Tracers, channel_walls, simulate_particles

AIR = ObjectSpace(Media())
NOISELESS = Readout(None, 0.0, 96.0)


@pytest.fixture
def small(camera):
    return replace(camera, columns=150, rows=120)


def test_boxes_and_windows_of_a_channel(table2, water, camera):
    volume = Grid.centred((130, 100, 100), (0.1, 0.1, 0.1), (0.0, 0.0, -0.5))
    box = Box.around(volume, (0.5, 0.5, 0.5)).within(channel_walls(10.0, -0.4655))
    assert box.low_mm == pytest.approx((-7.0, -5.0, -5.4655))
    assert box.high_mm == pytest.approx((7.0, 5.0, 4.5345))
    along_y = channel_walls(10.0, 0.0, "y")
    assert (along_y.low_mm, along_y.high_mm) == ((-5.0, -np.inf, -5.0), (5.0, np.inf, 5.0))
    with pytest.raises(ConfigError, match="no part in common"):
        Box((0, 0, 8), (1, 1, 9)).within(channel_walls(10.0, 0.0))
    window = channel_window(table2.focus_distance_mm, water, 10.0, 5.0, -0.4655)
    assert fluid_path_to_focus(window, table2.focus_distance_mm, water) - 0.4655 == pytest.approx(5.0)
    # by hand: 200 - 5/1.49 - 5.4655/1.33 = 200 - 3.355705 - 4.109398
    assert window.distance_mm == pytest.approx(192.534897, abs=1e-6)
    found = scenes.Misalignment(0.12, (3.4, -2.1), 2e-5).apply(camera)
    # the lens on the axis goes to 3.4 px and -2.1 px of 0.0055 mm
    assert found.lattice.origin == pytest.approx([0.0187, -0.01155])
    assert np.rad2deg(found.lattice.rotation_rad) == pytest.approx(0.12)
    assert found.distortion_per_mm2 == 2e-5


def test_white_image_and_board_have_light_dark_and_truth(small, rng):
    camera = scenes.Misalignment(0.3, (2.0, -1.0)).apply(small)
    still = scenes.simulate_white(RecordingCamera(camera, NOISELESS), 1000.0, rng)
    assert (still.image.max(), still.dark.min(), still.dark.max()) == (1096, 96, 96)
    assert still.truth["rotation_deg"] == pytest.approx(0.3)
    assert still.truth["pitch_px"] == pytest.approx([18.2545, 18.2545], abs=1e-4)
    board = BoardGeometry((1, 1), 1.0, 0.2)
    still = scenes.simulate_board(
        RecordingCamera(small, NOISELESS), AIR, board, BoardPlacement(-0.35, (0.1, 0.05)), 1000.0, rng
    )
    assert still.truth["dots_mm"] == [pytest.approx([0.1, 0.05, -0.35])]
    light = still.image.astype(float) - still.dark
    row, column = np.indices(light.shape)
    # the image is inverted; within a micro-image light may lie anywhere: a third of a pitch
    centre = small.px_to_mm([(column * light).sum() / light.sum(), (row * light).sum() / light.sum()])
    assert centre == pytest.approx([-0.1, -0.05], abs=0.03)


@pytest.mark.parametrize("frames", [2, 3])
def test_frames_lie_evenly_about_the_time_of_the_truth(small, frames):
    """Each frame is the truth's tracers carried back or forth: rendered again from the truth alone."""
    box = Box((-0.2, -0.2, -1.0), (0.2, 0.2, 1.0))
    tracers = Tracers(5, box, light_counts=1e5, rays=20_000)
    velocity = np.array([0.05, -0.02, 0.1])
    rng = np.random.default_rng(4)
    found = simulate_particles(
        RecordingCamera(small, NOISELESS), AIR, tracers, Motion(uniform(velocity), 2e-3, frames), rng
    )
    assert found.velocities_m_s == pytest.approx(np.tile(velocity, (5, 1)))
    # 1 ms: metres per second are mm
    for image, time_ms in zip(found.images, {2: (-1, 1), 3: (-2, 0, 2)}[frames], strict=True):
        places, light = found.positions_mm + time_ms * velocity, 1e5 * found.brightness
        expected = render_points(small, AIR, Balls(places, light, 0.05), np.random.default_rng(9), rays=20_000)
        # two sets of rays of the same tracers
        assert np.corrcoef(image.ravel(), expected.ravel())[0, 1] > 0.97


@pytest.mark.thorough
def test_frames_show_what_their_truth_says(small):
    """Tracers of different sizes flicker in a flow that accelerates through lit depths: rendered from the truth."""
    tracers = Tracers(
        8,
        Box((-0.2, -0.2, -1.0), (0.2, 0.2, 1.0)),
        diameter_mm=0.1,
        light_counts=1e6,
        rays=80_000,
        diameter_log_sigma=0.5,
        brightness_flicker=0.4,
        light_z_mm=(-0.5, 0.5),
    )
    motion = Motion(uniform((0.05, -0.02, 0.3)), 2e-3, 3, Pulsation(0.5, 100.0))
    found = simulate_particles(RecordingCamera(small, NOISELESS), AIR, tracers, motion, np.random.default_rng(4))
    assert found.frame_positions_mm.shape == (3, 8, 3)
    # over 2 ms the factor 1 + 0.5 sin(2 pi 100 t) adds 0.5 (1 - cos 0.4 pi) / (200 pi) s: forth 2.55 ms, back 1.45 ms
    steps = np.diff(found.frame_positions_mm, axis=0)[:, 0, 2]
    assert steps == pytest.approx([0.3 * 1.4502, 0.3 * 2.5498], abs=1e-4)
    depth = found.frame_positions_mm[..., 2]
    assert np.array_equal(found.frame_brightness > 0.0, (depth > -0.5) & (depth < 0.5))
    change = np.diff(np.sign(found.frame_brightness), axis=0)
    assert (change.max(), change.min()) == (1.0, -1.0)  # some come into the light, others leave it
    for image, places, brightness in zip(found.images, found.frame_positions_mm, found.frame_brightness, strict=True):
        balls = Balls(places, 1e6 * brightness, found.diameters_mm)
        expected = render_points(small, AIR, balls, np.random.default_rng(9), rays=80_000)
        # two sets of rays of the same tracers: 0.997; with balls of one size 0.97
        assert np.corrcoef(image.ravel(), expected.ravel())[0, 1] > 0.99
        assert image.sum() - 96.0 * image.size == pytest.approx(expected.sum(), rel=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize("frames", [2, 3, 12])
def test_tracers_of_a_long_sequence_stay_on_their_paths(frames, rng):
    """In turbulence that moves by 0.15 mm rms between frames, held against a hundred times as many steps."""
    motion, start = Motion(random_modes(0.15, seed=2), 1e-3, frames), rng.uniform(-3.0, 3.0, (50, 3))
    for place, time_s in zip(motion.places_mm(start), motion.times_s(), strict=True):
        expected = start
        for _ in range(100):
            expected = advect(motion.flow, expected, time_s / 100)
        # over one interval four steps of order 4: 1e-5 mm; one call for 5.5 intervals errs by 0.01 mm and more
        assert place == pytest.approx(expected, abs=2e-4)


def test_sizes_flicker_and_brightness_have_their_spread(rng):
    tracers = Tracers(4000, Box((0, 0, 0), (1, 1, 1)), diameter_log_sigma=0.3, brightness_flicker=0.2)
    logarithm, flicker = np.log(tracers.draw_sizes(rng)), tracers.draw_flicker(3, rng)
    # standard errors of 4000 and 12000: 0.005 and 0.0034, 0.002 and 0.0014
    assert (logarithm.mean(), logarithm.std()) == (pytest.approx(0.0, abs=0.02), pytest.approx(0.3, abs=0.014))
    assert (flicker.mean(), flicker.std()) == (pytest.approx(1.0, abs=0.008), pytest.approx(0.2, abs=0.008))
    # each frame has its own
    assert abs(np.corrcoef(flicker)[0, 1]) < 0.06
    brightness = Tracers(4000, Box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), brightness_log_sigma=0.5).draw_brightness(rng)
    assert np.mean(np.log(brightness)) == pytest.approx(0.0, abs=0.03)  # 0.5/sqrt(4000) is 0.008
    assert np.std(np.log(brightness)) == pytest.approx(0.5, abs=0.02)
    before, tracers = rng.bit_generator.state, Tracers(3, Box((0, 0, 0), (1, 1, 1)))
    assert np.array_equal(tracers.draw_sizes(rng), np.ones(3))
    assert np.array_equal(tracers.draw_flicker(2, rng), np.ones((2, 3)))
    assert rng.bit_generator.state == before


def test_tracers_fill_the_box_and_come_into_the_light_and_leave_it(small, rng):
    box = Box((-1.0, -2.0, -3.0), (1.0, 2.0, 4.0))
    tracers = Tracers(2000, box, light_counts=100.0, rays=1)
    pair = simulate_particles(
        RecordingCamera(small, Readout()), AIR, tracers, Motion(rigid_rotation((0, 0, 5.0)), 1e-3), rng
    )
    for axis in range(3):
        low, high = box.low_mm[axis], box.high_mm[axis]
        assert np.histogram(pair.positions_mm[:, axis], 4, (low, high))[0] == pytest.approx([500] * 4, abs=80)
    assert (pair.brightness.min(), pair.brightness.max()) == (
        pytest.approx(0.6, abs=0.01),
        pytest.approx(1.4, abs=0.01),
    )
    tracers = Tracers(9, Box((0, 0, 0), (0.1, 0.1, 1)), 0.1, brightness=(2.0, 2.0), rays=1, diameter_log_sigma=0.5)
    motion = Motion(uniform((0, 0, 0)), 1e-3)
    found = simulate_particles(RecordingCamera(small, NOISELESS), AIR, tracers, motion, rng)
    assert found.diameters_mm.max() > 1.5 * found.diameters_mm.min()
    assert found.frame_brightness == pytest.approx(np.tile(2.0 * (found.diameters_mm / 0.1) ** 2, (2, 1)))
    tracers = Tracers(40, Box((-0.2, -0.2, -3.0), (0.2, 0.2, 3.0)), light_counts=1.0, rays=1, light_z_mm=(-1.0, 1.0))
    motion = Motion(uniform((0.0, 0.0, 0.5)), 2e-3, 3)
    found = simulate_particles(RecordingCamera(small, NOISELESS), AIR, tracers, motion, np.random.default_rng(4))
    start = found.positions_mm[:, 2]
    for shown, moved in zip(found.frame_brightness, (-1.0, 0.0, 1.0), strict=True):
        assert np.array_equal(shown > 0.0, np.abs(start + moved) < 1.0)
    assert np.array_equal(found.brightness, found.frame_brightness[1])


def test_tracers_fill_a_pipe_and_go_round_in_circles(rng):
    for axis, half_mm in (("x", 1.0), ((1.0, 0.05, 0.0), 4.0)):
        pipe = RoundWall(2.0, (0.0, 0.5, -0.4), axis)
        box = Box((-half_mm, -9.0, -9.0), (half_mm, 9.0, 9.0)).within(scenes.pipe_bounds(pipe))
        places = Tracers(4000, box, walls=pipe).draw_places(rng)
        assert places.shape == (4000, 3)
        share = (pipe.distances_mm(places) / 2.0) ** 2
        assert share.max() <= 1.0
        # evenly spread over the section, squares of the distance are evenly spread: 1000 with a spread of 27
        assert np.histogram(share, 4, (0.0, 1.0))[0] == pytest.approx([1000] * 4, abs=120)
        if axis == "x":
            assert box.volume_mm3(pipe) == pytest.approx(box.volume_mm3() * np.pi / 4)
    # at the ends of the box the tilted pipe is 0.2 mm beside its middle: nothing of it is cut off
    assert places[places[:, 0] > 3.0, 1].max() > 0.5 + 2.0 + 0.1
    # Their velocity turns along the path: 0.3 rad from frame to frame, against the rotation itself.
    omega, start = np.array([0.0, 180.0, 240.0]), rng.uniform(-3.0, 3.0, (10, 3))
    motion = Motion(rigid_rotation(omega), 1e-3, 7)
    for place, time_s in zip(motion.places_mm(start), motion.times_s(), strict=True):
        # four steps of 0.075 rad a frame, (0.075)^5/120 of 5 mm each: 1e-6 mm over three frames
        assert place == pytest.approx(Rotation.from_rotvec(omega * time_s).apply(start), abs=2e-6)


def test_a_pair_is_decided_by_its_seed(small):
    pairs = [
        simulate_particles(
            RecordingCamera(small, Readout()),
            AIR,
            Tracers(3, Box((-0.1, -0.1, 0.0), (0.1, 0.1, 1.0)), rays=100),
            Motion(uniform((0, 0, 0)), 1e-3),
            np.random.default_rng(6),
        )
        for _ in range(2)
    ]
    assert np.array_equal(pairs[0].images[1], pairs[1].images[1])
    assert np.array_equal(pairs[0].positions_mm, pairs[1].positions_mm)
