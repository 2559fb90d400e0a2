"""`simulate particles` as a command: a sequence of frames."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.particle_file import Particles, read_particles, write_particles
from tests.commands import CONFIG, run, sample_rig


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
    truth, told = simulated_pipe(tmp_path, name)
    distance = np.hypot(truth.positions_mm[:, 1], truth.positions_mm[:, 2])
    assert distance.max() <= 5.0
    # 60 in the volume's pipe, and some beside it along the pipe
    assert 60 <= len(distance) <= 75
    assert told["particles_unseen"] == 0
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
    truth, told = simulated_pipe(tmp_path, "pipe", "radius_mm: 7.0", "radius_mm: 5.5")
    distance = np.hypot(truth.positions_mm[:, 1], truth.positions_mm[:, 2])
    assert 0 < told["particles_unseen"] <= np.sum(distance > 5.5 / 1.33)
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
