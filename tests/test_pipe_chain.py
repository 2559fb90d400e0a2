"""Whole chains at a small size: the shipped pipes, oblique faces, a mid plane that is wrong on purpose."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from scipy.spatial import KDTree

from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.calibration_file import open_calibration, write_calibration
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.hdf5 import open_h5, read_provenance
from lfpiv_cli.files.particle_file import open_particles, read_particles
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.flow.field import MASKED
from lfpiv_cli.self_calibration import refinement
from lfpiv_cli.weights.strips import StripOperator
from tests.commands import AT_FOCUS, CONFIG, ROOT, SAMPLE, changed, run, sample_rig, summary_of

CONFIGS = ROOT / "configs"
# What stands in the files, and what makes of them a section of the pipe's middle on a part of the sensor.
SMALL = {
    r"columns: 2352, rows: 1768": "columns: 1000, rows: 1000",
    r"shape_xyz: \[\d+, 100, 100\]": "shape_xyz: [24, 32, 32]",
    r"centre_mm: \[0, 0, 0\]}$": "centre_mm: [0, 0, {z}]}}",
    r"windows: \[32, 16\]": "windows: [16]",
    r"particles: \d+ .*": "particles: 220\n  rays: 6000",
}


def small(folder: Path, name: str, z_mm: float) -> Path:
    """Write a shipped config with a volume that begins at the camera's side of the pipe's section."""
    text = (CONFIGS / f"{name}.yaml").read_text()
    for old, new in SMALL.items():
        text, count = re.subn(old, new.format(z=z_mm) if "{z}" in new else new, text, flags=re.MULTILINE)
        assert count == 1, old
    (folder / f"{name}.yaml").write_text(text)
    return folder / f"{name}.yaml"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pipe", "pipe_box"])
def test_a_pipes_flow_is_measured_through_its_walls(tmp_path: Path, name: str) -> None:
    rig = small(tmp_path, name, -3.8)
    run("simulate", "particles", rig, "-o", tmp_path / "sim")
    run("build-weights", rig, "-o", tmp_path / "weights.h5")
    images = (tmp_path / "sim" / f"pair_{k}.tif" for k in "ab")
    run("reconstruct", tmp_path / "weights.h5", *images, "-o", tmp_path / "vol", "--iterations", "12")
    volumes = (tmp_path / "vol" / f"pair_{k}.vtkhdf" for k in "ab")
    run("correlate", *volumes, "-o", tmp_path / "vectors.vtkhdf")
    run("validate", "flow", rig, "--vectors", tmp_path / "vectors.vtkhdf", "-o", tmp_path / "report")
    field = open_vectors(tmp_path / "vectors.vtkhdf")
    # corners of windows lie in the wall, and count as far as they are inside
    assert not np.isfinite(field.velocity[field.flag == MASKED]).any()
    figures = json.loads((tmp_path / "report" / "flow.json").read_text())["figures"]
    assert figures["vectors_missing"] == 0
    assert abs(figures["streamwise_mean_error"]) < 0.1
    assert figures["within_25_percent_streamwise"] > 0.7


@pytest.mark.slow
def test_a_pipes_wall_may_be_given_by_its_heights(tmp_path: Path) -> None:
    """Frames, weights and found particles are those of the cylinder that the heights were taken from."""
    y = np.arange(-48, 49) / 10.0
    np.savetxt(tmp_path / "wall.csv", np.repeat(-np.sqrt(49.0 - y[:, np.newaxis] ** 2), 20, axis=1), delimiter=",")
    rig, heights = small(tmp_path, "pipe", 0.3), tmp_path / "heights.yaml"
    wall = "kind: cylinder, axis: x, radius_mm: 7.0, centre_mm: [0, 0, 0]"
    text = rig.read_text().replace("columns: 1000, rows: 1000", "columns: 500, rows: 400")
    text = text.replace("shape_xyz: [24, 32, 32]", "shape_xyz: [8, 10, 8]").replace("particles: 220", "particles: 5")
    rig.write_text(text)
    assert wall in text
    heights.write_text(text.replace(wall, "kind: height_map, file: wall.csv, spacing_mm: [0.5, 0.1]"))
    images, light, places = [], [], []
    for config in (rig, heights):
        folder = tmp_path / config.stem
        run("simulate", "particles", config, "-o", folder)
        run("build-weights", config, "-o", folder / "weights.h5")
        images.append(tifffile.imread(folder / "pair_a.tif").astype(float))
        weights = open_weights(folder / "weights.h5")
        volume = np.zeros(weights.shape, np.float32)
        volume[4, 5, 4] = 1000.0
        light.append(weights.forward(volume))
        found = folder / "found.vtkhdf"
        run("reconstruct", folder / "weights.h5", folder / "pair_a.tif", "-o", found, "--solver", "particles")
        places.append(open_particles(found).position_mm)
    # slopes differ by 1e-9: hardly a ray strikes the neighbouring pixel, none moves by a nanometre
    assert np.abs(images[1] - images[0]).sum() < 1e-3 * images[0].sum()
    np.testing.assert_allclose(light[1], light[0], atol=1e-4 * light[0].max())
    assert len(places[0]) > 3
    np.testing.assert_allclose(places[1], places[0], atol=1e-3)


# Where a pipe is said to be, and where it is: aside, and tilted in the image and away from the camera by 0.25 degrees.
REPORTED, BESIDE = "centre_mm: [0, 0, 0]", "centre_mm: [0, -0.1, 0.15]"
TILT_DEG = (-0.25, 0.25)
ASLANT = "axis: [1, -0.0043634, 0.0043634]"


@pytest.mark.slow
def test_a_pipe_that_lies_elsewhere_is_found(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Images of one pipe, the rig file of another: its axis is found, and with it the flow is right."""
    fewer = ("shape_xyz: [100, 100, 100]", "shape_xyz: [22, 100, 100]"), ("particles: 5000", "particles: 1100")
    text = changed("pipe", ("rows: 1768", "rows: 500"), *fewer, ("seed: 7", "seed: 23"))
    true, faces = re.subn(f"axis: x, (radius_mm: .*), {re.escape(REPORTED)}", rf"{ASLANT}, \1, {BESIDE}", text)
    true, sections = re.subn(r"axis: x([,}])", rf"{ASLANT}, {BESIDE}\1", true)
    assert (faces, sections) == (2, 3)  # of these the pipe, the flow and what it is judged by
    # Whole: the true pipe reaches beyond the volume that is told.
    true = true.replace("shape_xyz: [22, 100, 100]", "shape_xyz: [22, 106, 106]")
    for name, each in (("told", text), ("true", true)):
        (tmp_path / f"{name}.yaml").write_text(each)
    run("simulate", "particles", tmp_path / "true.yaml", "-o", tmp_path / "sim")
    run("simulate", "white", tmp_path / "true.yaml", "-o", tmp_path)
    lattice, refined, images = tmp_path / "lattice.h5", tmp_path / "refined.h5", tmp_path / "sim"
    dark = ("--dark", tmp_path / "dark.tif")
    run("calibrate-snapshot", tmp_path / "told.yaml", "--white", tmp_path / "white.tif", *dark, "-o", lattice)
    words = ("--calibration", lattice, *dark, "-o", refined, "--picture", tmp_path / "walls.png")
    figures = summary_of(capsys, "refine-calibration", tmp_path / "told.yaml", images / "pair_a.tif", *words)
    # Measured: within 2 um and 0.01 degrees by the images; by the wall of so little pipe within its error, some 40 um.
    np.testing.assert_allclose(figures["axis_shift_mm"], (-0.1, 0.15), atol=0.01)
    np.testing.assert_allclose(figures["axis_tilt_deg"], TILT_DEG, atol=0.06)
    by_wall, sigma = np.array(figures["axis_by_wall_shift_mm"]), np.array(figures["axis_by_wall_shift_mm_sigma"])
    assert np.all(np.abs(by_wall - (-0.1, 0.15)) < 3.0 * sigma)
    assert (tmp_path / "walls.png").stat().st_size > 10_000
    pipe = load_rig(tmp_path / "told.yaml").with_scene_of(open_calibration(refined)).pipe
    assert pipe is not None
    np.testing.assert_allclose(pipe.centre_mm[1:], (-0.1, 0.15), atol=0.01)

    run("build-weights", tmp_path / "told.yaml", "--calibration", refined, "-o", tmp_path / "weights.h5")
    assert isinstance(open_weights(tmp_path / "weights.h5").weights.solver_operator, StripOperator)
    pair = [images / f"pair_{k}.tif" for k in "ab"]
    words = ("--solver", "particles", "--pairing", "ab", "--no-residual")
    run("reconstruct", tmp_path / "weights.h5", *pair, *dark, *words, "-o", tmp_path / "found")
    run("track", *(tmp_path / "found" / f"pair_{k}.vtkhdf" for k in "ab"), "-o", tmp_path / "tracks.vtkhdf", "--grid")
    vectors = tmp_path / "tracks_grid.vtkhdf"
    run("validate", "flow", tmp_path / "true.yaml", "--vectors", vectors, "-o", tmp_path / "report")
    figures = json.loads((tmp_path / "report" / "flow.json").read_text())["figures"]
    # Measured: 0.0002; behind the scene as it is told more than 0.01.
    assert abs(figures["streamwise_mean_error"]) < 0.003
    assert figures["within_25_percent_vector_inner"] > 0.98


WRONG_MM = 0.3


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample's calibration with its mid plane too far away."""
    folder = tmp_path_factory.mktemp("refine")
    stills = ("--white", SAMPLE / "white.tif", "--dark", SAMPLE / "dark.tif", "--board", SAMPLE / "board.tif")
    run("calibrate-snapshot", CONFIG, *stills, "-o", folder / "calibration.h5")
    right = open_calibration(folder / "calibration.h5")
    assert right.mid_plane_z_mm is not None
    path = folder / "wrong.h5"
    write_calibration(path, replace(right, mid_plane_z_mm=right.mid_plane_z_mm + WRONG_MM), {}, False)
    return path


@pytest.mark.slow
def test_a_wrong_mid_plane_is_found_and_mended(wrong: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image, dark = SAMPLE / "pair_a.tif", ("--dark", SAMPLE / "dark.tif")
    output, picture = tmp_path / "refined.h5", tmp_path / "walls.png"
    targets = ("-o", output, "--picture", picture)
    summary = summary_of(capsys, "refine-calibration", CONFIG, image, "--calibration", wrong, *dark, *targets)
    truth = json.loads((SAMPLE / "particles.json").read_text())["reference_z_mm"]
    assert abs(summary["mid_plane_z_mm"] - truth) < 3 * summary["mid_plane_z_mm_sigma"]
    assert summary["mid_plane_z_mm_sigma"] < 0.03
    assert summary["mid_plane_correction_mm"] == pytest.approx(-WRONG_MM, abs=0.06)
    mended = open_calibration(output)
    assert mended.mid_plane_z_mm == summary["mid_plane_z_mm"]
    assert mended.pose is not None
    moved = mended.fit.centres((3, -2)) - open_calibration(wrong).fit.centres((3, -2))
    np.testing.assert_allclose(moved, summary["lattice_shift_px"], atol=1e-12)
    # The shipped images belong together: nothing has moved, and the tracers are 0.05 mm wide.
    assert np.abs(moved).max() < 0.01
    assert abs(summary["particle_diameter_mm"] - 0.05) < 3 * summary["particle_diameter_mm_sigma"]
    with open_h5(output) as file:
        made_by = read_provenance(file)
    assert made_by["command"] == "refine-calibration"
    assert {"calibration", "image", "dark"} <= set(made_by["inputs"])
    assert picture.stat().st_size > 10_000


@pytest.mark.slow
def test_half_a_millimetre_on_the_pair(data_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, config = data_folder / "channel", ROOT / "configs" / "channel.yaml"
    dark, off = ("--dark", data / "dark.tif"), tmp_path / "off.h5"
    stills = ("--white", data / "white.tif", "--board", data / "board.tif")
    run("calibrate-snapshot", config, *stills, *dark, "-o", tmp_path / "calibration.h5")
    right = open_calibration(tmp_path / "calibration.h5")
    assert right.mid_plane_z_mm is not None
    moved = replace(right.rectification, fit=right.fit.shifted(np.array([0.2, -0.1])))
    write_calibration(off, replace(right, rectification=moved, mid_plane_z_mm=right.mid_plane_z_mm + 0.5), {}, False)
    summary = summary_of(capsys, "refine-calibration", config, data / "pair_a.tif", "--calibration", off, *dark)
    truth = json.loads((data / "truth.json").read_text())
    # Measured: 0.002 mm and 0.0004 px are left.
    left = summary["mid_plane_z_mm"] - truth["mid_plane_z_mm"]
    assert abs(left) < min(0.02, 2 * summary["mid_plane_z_mm_sigma"])
    np.testing.assert_allclose(summary["lattice_shift_px"], (-0.2, 0.1), atol=4e-3)
    assert np.all(np.abs(summary["wall_tilt_deg"]) < 2 * np.array(summary["wall_tilt_deg_sigma"]))
    for name, true in (("magnification", -1.0), ("aperture_mm", 25.0), ("particle_diameter_mm", 0.05)):
        assert abs(summary[name] - true) < 2 * summary[f"{name}_sigma"], name
    assert abs(summary["k1_per_mm2"] - truth["camera"]["k1"]) < 2 * summary["k1_per_mm2_sigma"]


@pytest.mark.thorough
def test_a_config_without_a_channel_is_refused(wrong: Path, tmp_path: Path) -> None:
    config = sample_rig(tmp_path, AT_FOCUS, ("\nchannel:", "\n# channel:"))
    with pytest.raises(ConfigError, match="channel: is missing"):
        run("refine-calibration", config, SAMPLE / "pair_a.tif", "--calibration", wrong)


RIG = """\
camera:
  main_lens:   {{magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}}
  microlenses: {{focal_length_mm: 0.8, pitch_mm: 0.1, columns: 252, rows: 252, layout: square}}
  sensor:      {{pixel_um: 5.5, columns: 460, rows: 420, microlens_distance_mm: 0.8}}
media: {{air: 1.0, window: 1.52, fluid: 1.33}}
scene:
  - {{{outer}, behind: window}}
  - {{{inner}, behind: fluid}}
volume: {{shape_xyz: [14, 12, 30], voxel_mm: 0.1, centre_mm: [{centre}]}}
reconstruction: {{solver: particles, particle_diameter_mm: 0.05}}
correlation:    {{windows: [8], overlap: 0.5, dt_s: 0.001}}
simulation:
  flow: {{kind: uniform, velocity_m_s: [0.06, -0.04, 0.09]}}
  particles: 24
  particle_diameter_mm: 0.05
  seed: {seed}
"""
TILTED = "kind: tilted_plane, normal: [0.3, 0.12, 1], point_mm: [0, 0, {z}]"
BOWL = "kind: sphere, centre_mm: [2, -1, 8], radius_mm: {radius}"
SCENES = {
    # Oblique water moves what is in view to the side.
    "tilted": (TILTED.format(z=-8), TILTED.format(z=-5), "1.0, 0.4, 2.7"),
    "bowl": (BOWL.format(radius=15), BOWL.format(radius=13), "0, 0, 2.7"),
}
PLANES = "kind: plane, z_mm: -2.8", "kind: plane, z_mm: -2.0"


def tube(radius_mm: float) -> tuple[str, str]:
    """The faces of a tube with 0.8 mm of wall."""
    face = "kind: cylinder, axis: x, radius_mm: {}, centre_mm: [0, 0, 0]"
    return face.format(radius_mm + 0.8), face.format(radius_mm)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shown", "said", "words"),
    [
        (PLANES, tube(2.0), r"of the image's light is not that of the \d+ tracers .* at most 45%"),
        (tube(2.0), tube(2.6), r"98% of the tracers lie within [12]\.\d+ mm .* radius_mm is 2\.6"),
        (tube(2.0), tube(2.0), "searched on"),
    ],
)
def test_images_that_are_not_of_the_pipe_are_refused_before_the_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: tuple[str, str], said: tuple[str, str], words: str
) -> None:
    """What fits is searched on; steps of the scene are not tried on what does not."""

    def on(*_: object) -> None:
        raise InputError("searched on")

    monkeypatch.setattr(refinement, "fit_nuisances", on)
    for name, (outer, inner) in (("shown", shown), ("told", said)):
        text = RIG.format(outer=outer, inner=inner, centre="0, 0, 0", seed=31).replace("[14, 12, 30]", "[24, 20, 40]")
        pipe = f"pipe: {{{inner.split(', ')[2]}}}\n" if "cylinder" in inner else ""
        (tmp_path / f"{name}.yaml").write_text(text.replace("particles: 24", "particles: 250\n  rays: 8000") + pipe)
    run("simulate", "particles", tmp_path / "shown.yaml", "-o", tmp_path / "sim")
    run("simulate", "white", tmp_path / "told.yaml", "-o", tmp_path)
    stills = ("--white", tmp_path / "white.tif", "--dark", tmp_path / "dark.tif")
    run("calibrate-snapshot", tmp_path / "told.yaml", *stills, "-o", tmp_path / "lattice.h5")
    words_of = ("--calibration", tmp_path / "lattice.h5", "--dark", tmp_path / "dark.tif")
    with pytest.raises(InputError, match=words):
        run("refine-calibration", tmp_path / "told.yaml", tmp_path / "sim" / "pair_a.tif", *words_of)


# Of one particle in x, y and z, several of their errors.
NEAR_MM = np.array([0.03, 0.03, 0.15])


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_tracers_are_found_where_they_are(tmp_path: Path, scene: str) -> None:
    outer, inner, centre = SCENES[scene]
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.format(outer=outer, inner=inner, centre=centre, seed=8140))
    run("simulate", "particles", rig, "-o", tmp_path / "sim")
    run("simulate", "white", rig, "-o", tmp_path / "white")
    run("build-weights", rig, "-o", tmp_path / "weights.h5")
    images, dark = (tmp_path / "sim" / f"pair_{k}.tif" for k in "ab"), tmp_path / "white" / "dark.tif"
    run("reconstruct", tmp_path / "weights.h5", *images, "--dark", dark, "-o", tmp_path / "parts")
    truth = read_particles(tmp_path / "sim" / "particles.npz").frame_positions_mm
    middle, inside = np.array([float(each) for each in centre.split(",")]), np.array([0.7, 0.6, 1.5])
    there, found = [], []
    for k, name in enumerate(("pair_a", "pair_b")):
        here = truth[k][np.all(np.abs(truth[k] - middle) < inside, axis=1)]
        points = open_particles(tmp_path / "parts" / f"{name}.vtkhdf").position_mm
        points_here = points[np.all(np.abs(points - middle) < inside, axis=1)]
        there.append(KDTree(points / NEAR_MM).query(here / NEAR_MM)[0] < 1.0)
        found.append(KDTree(truth[k] / NEAR_MM).query(points_here / NEAR_MM)[0] < 1.0)
    # All of it lies on one side of the focus, where light tells depth; an edge of the volume may still cut some off.
    assert np.concatenate(there).mean() >= 0.95
    assert np.concatenate(found).mean() >= 0.95
