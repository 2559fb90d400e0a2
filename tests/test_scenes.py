"""Simulated scenes: what the truth says is what the images show; `simulate` as a command, through pipes, by waves."""

import copy
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.particle_file import Particles, read_particles, write_particles
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.media import Media, channel_window, fluid_path_to_focus
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic import scenes
from lfpiv_cli.synthetic.board import BoardPlacement
from lfpiv_cli.synthetic.flows import Pulsation, advect, random_modes, rigid_rotation, uniform
from lfpiv_cli.synthetic.render import Balls, Readout, render_points
from lfpiv_cli.synthetic.scenes import Box, Motion, RecordingCamera, Tracers, channel_walls, simulate_particles
from tests.commands import CONFIG, run, sample_rig

AIR = ObjectSpace(Media())
NOISELESS = Readout(None, 0.0, 96.0)


@pytest.fixture
def small(camera):
    return replace(camera, columns=150, rows=120)


def recorded(camera, tracers: Tracers, motion: Motion, seed: int = 4, readout: Readout = NOISELESS):
    """Return what a camera in air records of tracers."""
    return simulate_particles(RecordingCamera(camera, readout), AIR, tracers, motion, np.random.default_rng(seed))


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
    found = recorded(small, tracers, Motion(uniform(velocity), 2e-3, frames))
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
    sizes = {"diameter_mm": 0.1, "diameter_log_sigma": 0.5, "brightness_flicker": 0.4, "light_z_mm": (-0.5, 0.5)}
    tracers = Tracers(8, Box((-0.2, -0.2, -1.0), (0.2, 0.2, 1.0)), light_counts=1e6, rays=80_000, **sizes)
    motion = Motion(uniform((0.05, -0.02, 0.3)), 2e-3, 3, Pulsation(0.5, 100.0))
    found = recorded(small, tracers, motion)
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
    _, _, sizes, flicker = tracers.drawn(3, rng)
    logarithm = np.log(sizes)
    # standard errors of 4000 and 12000: 0.005 and 0.0034, 0.002 and 0.0014
    assert (logarithm.mean(), logarithm.std()) == (pytest.approx(0.0, abs=0.02), pytest.approx(0.3, abs=0.014))
    assert (flicker.mean(), flicker.std()) == (pytest.approx(1.0, abs=0.008), pytest.approx(0.2, abs=0.008))
    # each frame has its own
    assert abs(np.corrcoef(flicker)[0, 1]) < 0.06
    _, brightness, _, _ = Tracers(4000, Box((0, 0, 0), (1, 1, 1)), brightness_log_sigma=0.5).drawn(2, rng)
    assert np.mean(np.log(brightness)) == pytest.approx(0.0, abs=0.03)  # 0.5/sqrt(4000) is 0.008
    assert np.std(np.log(brightness)) == pytest.approx(0.5, abs=0.02)
    # those that do not differ take nothing from the random numbers but their places and brightness
    again, tracers = copy.deepcopy(rng), Tracers(3, Box((0, 0, 0), (1, 1, 1)))
    places, brightness, sizes, flicker = tracers.drawn(2, rng)
    assert np.array_equal(sizes, np.ones(3))
    assert np.array_equal(flicker, np.ones((2, 3)))
    assert np.array_equal(places, again.uniform(0.0, 1.0, (3, 3)))
    assert np.array_equal(brightness, again.uniform(0.6, 1.4, 3))
    assert rng.bit_generator.state == again.bit_generator.state


def test_tracers_fill_the_box_and_come_into_the_light_and_leave_it(small):
    box = Box((-1.0, -2.0, -3.0), (1.0, 2.0, 4.0))
    tracers = Tracers(2000, box, light_counts=100.0, rays=1)
    pair = recorded(small, tracers, Motion(rigid_rotation((0, 0, 5.0)), 1e-3))
    for axis in range(3):
        low, high = box.low_mm[axis], box.high_mm[axis]
        assert np.histogram(pair.positions_mm[:, axis], 4, (low, high))[0] == pytest.approx([500] * 4, abs=80)
    assert (pair.brightness.min(), pair.brightness.max()) == pytest.approx((0.6, 1.4), abs=0.01)
    tracers = Tracers(9, Box((0, 0, 0), (0.1, 0.1, 1)), 0.1, brightness=(2.0, 2.0), rays=1, diameter_log_sigma=0.5)
    found = recorded(small, tracers, Motion(uniform((0, 0, 0)), 1e-3))
    assert found.diameters_mm.max() > 1.5 * found.diameters_mm.min()
    assert found.frame_brightness == pytest.approx(np.tile(2.0 * (found.diameters_mm / 0.1) ** 2, (2, 1)))
    tracers = Tracers(40, Box((-0.2, -0.2, -3.0), (0.2, 0.2, 3.0)), light_counts=1.0, rays=1, light_z_mm=(-1.0, 1.0))
    found = recorded(small, tracers, Motion(uniform((0.0, 0.0, 0.5)), 2e-3, 3))
    start = found.positions_mm[:, 2]
    for shown, moved in zip(found.frame_brightness, (-1.0, 0.0, 1.0), strict=True):
        assert np.array_equal(shown > 0.0, np.abs(start + moved) < 1.0)
    assert np.array_equal(found.brightness, found.frame_brightness[1])


def test_tracers_fill_a_pipe_and_go_round_in_circles(rng):
    for axis, half_mm in (("x", 1.0), ((1.0, 0.05, 0.0), 4.0)):
        pipe = RoundWall(2.0, (0.0, 0.5, -0.4), axis)
        box = Box((-half_mm, -9.0, -9.0), (half_mm, 9.0, 9.0)).within(scenes.pipe_bounds(pipe))
        places, _, _, _ = Tracers(4000, box, walls=pipe).drawn(2, rng)
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
    tracers = Tracers(3, Box((-0.1, -0.1, 0.0), (0.1, 0.1, 1.0)), rays=100)
    pairs = [recorded(small, tracers, Motion(uniform((0, 0, 0)), 1e-3), 6, Readout()) for _ in range(2)]
    assert np.array_equal(pairs[0].images[1], pairs[1].images[1])
    assert np.array_equal(pairs[0].positions_mm, pairs[1].positions_mm)


def simulated(folder: Path, text: str, what: str = "particles") -> Path:
    """Simulate what a config tells; return the folder of it."""
    (folder / "rig.yaml").write_text(text)
    run("simulate", what, folder / "rig.yaml", "-o", folder / "out", "--overwrite")
    return folder / "out"


def with_flow(flow: str) -> str:
    """Return the sample's config with another flow."""
    text, count = re.subn(r"^  flow: \{.*$", f"  flow: {{{flow}}}", CONFIG.read_text(), flags=re.MULTILINE)
    assert count == 2
    return text


@pytest.mark.thorough
def test_tracers_of_a_sequence_are_there_before_they_are_carried_in(tmp_path: Path) -> None:
    ends, names = {}, {}
    for frames in (2, 6):
        (tmp_path / str(frames)).mkdir()
        text = CONFIG.read_text().replace("rate_per_s: 30.0", "rate_per_s: 0.0")
        few = f"simulation:\n  frames: {frames}\n  rays: 1\n"
        output = simulated(tmp_path / str(frames), text.replace("simulation:\n", few))
        x = read_particles(output / "particles.npz").positions_mm[:, 0]
        ends[frames], names[frames] = (x.min(), x.max()), sorted(path.name for path in output.glob("*.tif"))
    # 0.12 m/s for four times 2 ms, half of it upstream; a few hundred tracers fill 5 mm to some 0.02 mm.
    assert ends[6] == pytest.approx((ends[2][0] - 0.48, ends[2][1] + 0.48), abs=0.1)
    assert names == {2: ["pair_a.tif", "pair_b.tif"], 6: [f"frame_{number:04d}.tif" for number in range(6)]}
    assert np.ptp(read_image(output / names[6][-1])) > 0


FLOWS_OF_FIELDS = {
    "cellular": "kind: taylor_green, amplitude_m_s: 0.05, wavelength_mm: 4.0, third_amplitude_m_s: 0.05",
    "abc": "kind: abc, amplitudes_m_s: [0.05, 0.04, 0.03], wavelength_mm: 4.0",
    "ring": "kind: vortex_ring, speed_m_s: 0.05, radius_mm: 1.0, core_mm: 0.5, axis: x",
    "source": "kind: source, rate_per_s: 60.0, radius_mm: 1.0, velocity_m_s: [0.02, 0.0, 0.0]",
    "modes": "kind: random_modes, rms_m_s: 0.05, shortest_mm: 2.0, modes: 50",
}


@pytest.mark.thorough
@pytest.mark.parametrize("name", FLOWS_OF_FIELDS)
def test_every_flow_is_rendered_with_its_velocities(tmp_path: Path, name: str) -> None:
    output = simulated(tmp_path, with_flow(FLOWS_OF_FIELDS[name]).replace("particles: 400", "particles: 40\n  rays: 1"))
    truth = read_particles(output / "particles.npz")
    moved = np.diff(truth.frame_positions_mm, axis=0)[0]
    assert np.abs(moved).max() > 0.01
    # 2 ms between frames; what the velocity changes on the way is of third order in time: some per cent
    assert 1e3 * 0.002 * truth.velocities_m_s == pytest.approx(moved, abs=0.01)
    assert np.ptp(read_image(output / "pair_b.tif")) > 0


def sequence_of(folder: Path, keys: str, velocity_m_s: str = "[0, 0, 0.2]", layers: int = 40) -> Particles:
    """Simulate tracers that all move by 0.4 mm between six frames, with few rays; return their truth."""
    few = f"simulation:\n  frames: 6\n  rays: 1\n  mid_plane_z_mm: 2.926\n{keys}"
    text = with_flow(f"kind: uniform, velocity_m_s: {velocity_m_s}").replace("simulation:\n", few)
    text = text.replace("particles: 400", "particles: 2000").replace("[30, 22, 40]", f"[30, 22, {layers}]")
    return read_particles(simulated(folder, text) / "particles.npz")


def lit_depths(truth: Particles, frame: int) -> np.ndarray:
    """Return how far behind the mid plane those tracers are that a frame shows."""
    return truth.frame_positions_mm[frame, truth.frame_brightness[frame] > 0.0, 2] - 2.926


@pytest.mark.thorough
@pytest.mark.parametrize(("light", "edges"), [("[-1.0, 1.5]", (-1.0, 1.5)), ("[-3.0, 1.0]", (-2.0, 1.0))])
def test_lit_depths_are_full_in_every_frame(tmp_path: Path, light: str, edges: tuple[float, float]) -> None:
    """The flow carries tracers through the light's edges and a porous wall: no layer empties behind them."""
    truth = sequence_of(tmp_path, f"  light_z_mm: {light}\n")
    for depth in (lit_depths(truth, 0), lit_depths(truth, 5)):
        assert (depth.min(), depth.max()) == pytest.approx(edges, abs=0.02)
        found = np.histogram(depth, 5, edges)[0]
        # 2000 in the volume's lit depths, and as dense in the margin about it; 5 standard deviations
        assert np.abs(found - found.mean()).max() < 5.0 * np.sqrt(found.mean())


@pytest.mark.thorough
@pytest.mark.parametrize("light", ["[-0.5, 0.5]", "[-2.0, 2.0]"])
def test_particles_are_counted_in_the_lit_part_of_the_volume(tmp_path: Path, light: str) -> None:
    truth = sequence_of(tmp_path, f"  light_z_mm: {light}\n", layers=20)
    inside = np.all(np.abs(truth.positions_mm - (0.0, 0.0, 2.926)) < (1.5, 1.1, 1.0), axis=1)
    assert np.count_nonzero(inside & (truth.brightness > 0.0)) == pytest.approx(2000, abs=225)  # 5 standard deviations


def test_keys_of_the_scene_reach_the_tracers_and_light_beyond_the_wall_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="beyond a wall 2 mm from the mid plane"):
        sequence_of(tmp_path, "  light_z_mm: [2.5, 3.0]\n")
    keys = "  pulsation: {amplitude: 0.5, frequency_hz: 50}\n  particle_diameter_log_sigma: 0.3\n"
    truth = sequence_of(tmp_path, keys + "  brightness_flicker: 0.1\n", "[0.2, 0, 0]")
    assert np.std(np.log(np.asarray(truth.diameters_mm))) == pytest.approx(0.3, rel=0.1)
    assert (truth.frame_brightness / truth.brightness).std() == pytest.approx(0.1, rel=0.1)
    # t + 0.5 (1 - cos(100 pi t)) / (100 pi): to 1, 3 and 5 ms as far as steadily in 1.0779, 3.6561 and 6.5915 ms
    along = truth.frame_positions_mm[3:, 0, 0] - truth.positions_mm[0, 0]
    assert along == pytest.approx([0.2 * 1.0779, 0.2 * 3.6561, 0.2 * 6.5915], abs=1e-3)


def test_lists_of_particles_whose_arrays_disagree_are_refused(tmp_path: Path) -> None:
    whole = Particles(np.zeros((3, 3)), np.ones((3, 3)), np.ones(3), np.ones(3), np.zeros((2, 3, 3)), np.ones((2, 3)))
    path = tmp_path / "true.npz"
    write_particles(path, whole, overwrite=False)
    assert np.shape(read_particles(path).frame_brightness) == (2, 3)
    with np.load(path) as stored:
        arrays = {key: stored[key] for key in stored}
    for name in ("brightness", "diameter_mm", "frame_position_mm", "frame_brightness"):
        np.savez(path, **arrays | {name: arrays[name][..., :-1]})
        with pytest.raises(InputError, match=f"{name} .* for 3 particles"):
            read_particles(path)


def simulated_pipe(folder: Path, name: str, *replaced: str) -> tuple[Particles, dict[str, Any]]:
    """Simulate a shipped pipe with few tracers and rays; return the truth."""
    few = re.sub(r"particles: \d+ .*", "particles: 60\n  rays: 200", (CONFIG.parent / f"{name}.yaml").read_text())
    output = simulated(folder, few.replace(*replaced) if replaced else few)
    return read_particles(output / "particles.npz"), json.loads((output / "particles.json").read_text())


@pytest.mark.thorough
@pytest.mark.parametrize(("name", "seen_as"), [("pipe", 1.33), ("pipe_box", 1.0)])
def test_a_pipe_is_seeded_and_seen_through_its_walls(tmp_path: Path, name: str, seen_as: float) -> None:
    truth, reported = simulated_pipe(tmp_path, name)
    distance = np.hypot(truth.positions_mm[:, 1], truth.positions_mm[:, 2])
    assert distance.max() <= 5.0
    # 60 in the volume's pipe, and some beside it along the pipe
    assert 60 <= len(distance) <= 75
    assert reported["particles_unseen"] == 0
    axis = 1.0 - (distance / 5.0) ** 2
    # places are stored with seven digits
    assert truth.velocities_m_s == pytest.approx(np.outer(2.0 * 0.1082 * axis, [1.0, 0.0, 0.0]), abs=1e-6)
    # light across the pipe: a tube is a lens, in a box of water hardly
    image = read_image(tmp_path / "out" / "pair_a.tif").astype(float)
    assert image.max() > 1000.0
    across = 1 if name == "pipe" else 0
    camera = load_rig(tmp_path / "rig.yaml").camera_model()
    pixels = np.flatnonzero((image > 1000.0).any(axis=1 - across))
    reach_mm = 0.5 * (pixels.max() - pixels.min()) * camera.pixel_mm
    half_mm = 0.5 * image.shape[across] * camera.pixel_mm
    farthest = np.abs(truth.positions_mm[:, 1]).max()
    # at most a millimetre of blur beside what is seen
    assert min(seen_as * farthest, half_mm) - 0.5 < reach_mm <= min(seen_as * farthest + 1.0, half_mm)


@pytest.mark.thorough
def test_tracers_that_no_light_comes_from_are_counted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Behind a wall of half a millimetre water is hidden beyond R_out / n."""
    truth, reported = simulated_pipe(tmp_path, "pipe", "radius_mm: 7.0", "radius_mm: 5.5")
    distance = np.hypot(truth.positions_mm[:, 1], truth.positions_mm[:, 2])
    assert 0 < reported["particles_unseen"] <= np.sum(distance > 5.5 / 1.33)
    assert "send no light to the lens" in capsys.readouterr().err


def test_what_is_not_simulated_through_a_scene_is_refused(tmp_path: Path) -> None:
    text = (CONFIG.parent / "pipe.yaml").read_text()
    with pytest.raises(ConfigError, match="obey Snell's law"):
        simulated(tmp_path, text.replace("seed: 7", "refraction: paraxial"))
    board = "board: {pattern: chessboard, squares: [5, 4], spacing_mm: 1.0, medium: fluid}\n"
    with pytest.raises(ConfigError, match="only dots are simulated"):
        simulated(tmp_path, text + board, "board")


@pytest.mark.thorough
def test_a_board_of_dots_is_seen_in_a_pipe_and_in_front_of_it(tmp_path: Path) -> None:
    """In the fluid its columns across the tube are seen 1.33 times as far apart, in air as they are."""
    apart = {}
    for medium in ("fluid", "air"):
        board = f"board: {{dots: [3, 3], spacing_mm: 2.0, dot_diameter_mm: 0.3, medium: {medium}, polarity: bright}}\n"
        output = simulated(tmp_path, (CONFIG.parent / "pipe.yaml").read_text() + board, "board")
        light = np.maximum(read_image(output / "board.tif").astype(float) - 150.0, 0.0)
        # along the columns, which follow y across the tube: the outer two of three stripes
        stripes = light.sum(axis=0)
        place = (np.arange(stripes.size) - 0.5 * (stripes.size - 1)) * 0.0055
        outer = np.abs(place) > 1.0
        apart[medium] = 2.0 * float(np.sum(np.abs(place[outer]) * stripes[outer]) / stripes[outer].sum())
    # the dots stand on the tube's axis, in the focal plane: a cylinder's centre is seen n_w times as large
    assert apart["fluid"] == pytest.approx(2.0 * 2.0 * 1.33, rel=0.02)
    assert apart["air"] == pytest.approx(2.0 * 2.0, rel=0.02)


@pytest.mark.thorough
def test_light_of_waves_shows_the_same_scene(tmp_path: Path) -> None:
    """What is seeded and how it moves does not go with what light is made of; the images do, their light does not."""
    text = CONFIG.read_text().replace("particles: 400", "particles: 4").replace("dots: [5, 4]", "dots: [2, 2]")
    images, truths = {}, []
    for light in ("rays", "waves"):
        for what, name in (("white", "white"), ("board", "board"), ("particles", "pair_b")):
            out = simulated(tmp_path, text.replace("simulation:\n", f"simulation:\n  light: {{kind: {light}}}\n"), what)
            images[f"{light} {name}"] = read_image(out / f"{name}.tif").astype(float) - 96.0
        truths.append(read_particles(out / "particles.npz"))
    assert np.array_equal(truths[0].positions_mm, truths[1].positions_mm)
    assert np.array_equal(truths[0].brightness, truths[1].brightness)
    # 2e5 pixels of 6 counts of noise; lenses lose no light but at the sensor's rims
    for name in ("white", "board", "pair_b"):
        rays, waves = images[f"rays {name}"], images[f"waves {name}"]
        assert waves.sum() == pytest.approx(rays.sum(), rel=0.01), name
        assert 0.03 < np.abs(waves - rays)[rays + waves > 200.0].sum() / rays.sum() < 0.6, name


@pytest.mark.parametrize(
    ("light", "match"),
    [
        ("{kind: rays, points: 3}", "light.points: unknown key"),
        ("{kind: beams}", "light.kind: is 'beams', expected one of 'rays', 'waves'"),
        ("{kind: waves, wavelength_nm: 0.532}", "light.wavelength_nm: .* 200"),
    ],
)
def test_light_that_cannot_be_is_refused(tmp_path: Path, light: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        load_rig(sample_rig(tmp_path, ("simulation:\n", f"simulation:\n  light: {light}\n")))
