"""Parts of the paper's report: bubbles on a channel's wall, what a mask finds of them; how well depth can be told."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import yaml

from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.vtkhdf import open_volume
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.surfaces import Surface
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.paper import camera as of_camera
from lfpiv_cli.paper.bubbles import _rows, bubbles
from lfpiv_cli.paper.camera import discussion, elongations_mm, geometric_depth_mm, smallest_errors_mm
from lfpiv_cli.paper.parts import Work, read_json
from lfpiv_cli.paper.table4 import TINY, channel_sections
from lfpiv_cli.reconstruction.images import LARGEST_STILL, still_light
from lfpiv_cli.reconstruction.solvers import SolverSettings
from lfpiv_cli.synthetic.render import Readout
from lfpiv_cli.synthetic.scenes import Box, Bubbles, bubbles_at_wall, channel_walls, render_bubbles
from tests.commands import SAMPLE, WATER, run, sample_weights

AIR = ObjectSpace(Media())
MARGIN_PX = 3


@pytest.mark.parametrize("axis", ["x", "y"])
@pytest.mark.parametrize(
    ("wall", "is_deep", "sign"), [("near", True, -1), ("far", True, 1), ("low", False, -1), ("high", False, 1)]
)
def test_bubbles_touch_their_wall_alone(rng: np.random.Generator, axis: int, wall: Surface, is_deep, sign) -> None:
    walls = channel_walls(4.0, -0.3, axis)
    seen = Box((-1.0, -2.0, -2.3), (1.0, 2.0, 1.7)) if axis == "x" else Box((-2.0, -1.0, -2.3), (2.0, 1.0, 1.7))
    found = bubbles_at_wall(50, (0.2, 0.6), wall, seen, walls, rng)
    across, middle = (2, -0.3) if is_deep else ({"x": 1, "y": 0}[axis], 0.0)
    reach = sign * (found.centres_mm[:, across] - middle) + 0.5 * found.diameters_mm
    assert reach == pytest.approx(np.full(50, 2.0))
    radii = 0.5 * found.diameters_mm[:, np.newaxis]
    assert (found.centres_mm - radii >= np.array(walls.low_mm) - 1e-9).all()
    assert (found.centres_mm + radii <= np.array(walls.high_mm) + 1e-9).all()
    assert found.diameters_mm.min() < 0.25
    assert found.diameters_mm.max() > 0.55
    with pytest.raises(ConfigError, match="do not fit"):
        bubbles_at_wall(5, (4.1, 4.2), wall, seen, walls, rng)


@pytest.mark.thorough
def test_a_bubble_gives_its_level_in_the_middle_and_fades_to_its_rim(camera: Camera, rng: np.random.Generator) -> None:
    small = replace(camera, columns=220, rows=180)
    bubble = Bubbles(np.array([[0.1, -0.05, 0.0]]), np.array([0.6]))
    image = render_bubbles(small, AIR, bubble, 1000.0, rng)
    # in focus a micro-image has the light of its lens's place: 1 - r^2/R^2 of the level in the middle of it
    rows, columns = np.indices(image.shape)
    x, y = np.moveaxis(small.px_to_mm(np.stack([columns, rows], axis=-1).astype(float)), -1, 0)
    r = np.hypot(x + 0.1, y - 0.05)
    lit = image[r < 0.05]
    assert np.percentile(lit, 90) == pytest.approx(1000.0, rel=0.1)
    assert image[r > 0.42].max() == 0.0
    # of a paraboloid half of what fills the disc
    lenses = 0.5 * np.pi * 0.3**2 / small.lattice.cell_area
    radius_mm = small.aperture_radius_mm * small.microlens_distance_mm / small.image_distance_mm
    assert image.sum() == pytest.approx(lenses * np.pi * radius_mm**2 / small.pixel_mm**2 * 1000.0, rel=0.02)


def simulated(folder: Path, name: str, **simulation: object) -> Path:
    sections = channel_sections(TINY, simulation={"particles": 20, "rays": 500})
    sections["simulation"] |= simulation
    config = folder / f"{name}.yaml"
    config.write_text(yaml.safe_dump(sections))
    run("simulate", "particles", config, "-o", folder / name)
    return folder / name


def test_both_frames_show_the_same_bubbles_which_need_a_channel_beside_the_same_tracers(tmp_path: Path) -> None:
    noiseless = {"photons_per_count": None, "read_noise_counts": 0.0}
    plain = simulated(tmp_path, "plain", **noiseless)
    bubbly = simulated(tmp_path, "bubbly", **noiseless, bubbles=3, bubble_counts=9000.0, bubble_diameter_mm=[0.3, 0.4])
    difference = [
        read_image(bubbly / f"pair_{k}.tif").astype(float) - read_image(plain / f"pair_{k}.tif") for k in "ab"
    ]
    # counts are rounded
    np.testing.assert_allclose(*difference, atol=1.0)
    assert difference[0].max() > 8000.0
    told = read_json(bubbly / "particles.json")["bubbles_mm"]
    assert np.shape(told) == (3, 4)
    assert np.array(told)[:, 1] + 0.5 * np.array(told)[:, 3] == pytest.approx(np.full(3, 0.8))
    assert "bubbles_mm" not in read_json(plain / "particles.json")
    # Bubbles need a channel.
    sections = channel_sections(TINY, simulation={"bubbles": 1})
    sections["simulation"]["flow"] = {"kind": "uniform", "velocity_m_s": [0.1, 0.0, 0.0]}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump(sections))
    with pytest.raises(ConfigError, match=r"simulation.bubbles: .* no square_duct"):
        run("simulate", "particles", tmp_path / "rig.yaml", "-o", tmp_path / "x")


def frames(rng, bright: float) -> tuple[list[np.ndarray], np.ndarray]:
    """Return two frames of moved spots with noise and one bright thing that rests, and where that is."""
    spots = (rng.random((120, 120)) < 0.01) * 900.0
    rest = np.zeros((120, 120))
    rest[40:60, 70:95] = bright
    still = [np.roll(spots, 6 * k, axis=1) + rest + rng.normal(96.0, 6.0, rest.shape) for k in range(2)]
    return [image.astype(np.float32) for image in still], rest > 0.0


def test_still_light_is_what_rests_and_outshines_what_moves(rng: np.random.Generator) -> None:
    images, rest = frames(rng, 20_000.0)
    side = 2 * MARGIN_PX + 1
    expected = cv2.dilate(rest.astype(np.uint8), np.ones((side, side), np.uint8)) > 0
    np.testing.assert_array_equal(still_light(images, MARGIN_PX), expected)
    # what moves is not believed to rest, nor is what rests but is no brighter
    assert not still_light(frames(rng, 0.0)[0], MARGIN_PX).any()
    assert not still_light(frames(rng, 500.0)[0], MARGIN_PX).any()
    # Frames that hardly differ show no bubbles.
    image = (96.0 + 5000.0 * (rng.random((50, 50)) < 1.3 * LARGEST_STILL)).astype(np.float32)
    with pytest.raises(InputError, match="hardly differ"):
        still_light([image, image + 1.0], MARGIN_PX)
    with pytest.raises(InputError, match="at least two"):
        still_light([image], MARGIN_PX)


@pytest.mark.thorough
def test_a_mask_of_what_is_still_is_that_of_its_image(tmp_path: Path) -> None:
    sample_weights(tmp_path, ("[30, 22, 40]", "[16, 12, 20]"))
    pair = []
    for name in "ab":
        image = read_image(SAMPLE / f"pair_{name}.tif").astype(np.uint16)
        image[180:230, 250:320] = 50_000
        tifffile.imwrite(tmp_path / f"{name}.tif", image)
        pair.append(image.astype(np.float32))
    # from lens to lens 0.1 mm of 0.0055 mm pixels, up to the next whole one
    tifffile.imwrite(tmp_path / "mask.tif", np.where(still_light(pair, 19), 0, 255).astype(np.uint8))
    images = [tmp_path / f"{name}.tif" for name in "ab"]
    common = ("reconstruct", tmp_path / "weights.h5", *images, "--iterations", 2)
    for name, mask in (("still", "still"), ("file", tmp_path / "mask.tif")):
        (tmp_path / name).mkdir()
        run(*common, "--mask", mask, "-o", tmp_path / name)
    found, given = (open_volume(tmp_path / name / "a.vtkhdf") for name in ("still", "file"))
    np.testing.assert_array_equal(found.array, given.array)
    assert found.attributes["excluded_pixels"] == (50 + 2 * 19) * (70 + 2 * 19)
    assert "mask: still over 2 frames, SHA-256" in found.provenance["command"]


@pytest.mark.thorough
def test_the_part_measures_beside_bubbles_in_all_ways(tmp_path: Path) -> None:
    found = bubbles(Work(tmp_path, "tiny", Console(only_warnings=True), {}))
    kept = {path.stem: read_json(path)["result"] for path in tmp_path.glob("*_figures.json")}
    assert set(kept) == {f"{name}_figures" for name in ("clean", "hidden", "paper", "bubbles", "background", "mask")}
    clean, hidden, masked = (kept[f"{name}_figures"] for name in ("clean", "hidden", "mask"))
    error, share = found.rows
    assert error.limit == pytest.approx(100.0 * (abs(hidden["mean_error"]) + 2.0 * hidden["mean_sigma"]))
    assert error.best == pytest.approx(100.0 * abs(masked["mean_error"]))
    assert share.limit == pytest.approx(100.0 * (hidden["within_25"] - 2.0 * hidden["within_sigma"]))
    # the mask leaves out what is saturated in any case, and the rims
    left_out = [figures["excluded_pixels"] for figures in (hidden, masked, kept["bubbles_figures"], clean)]
    assert left_out[0] == left_out[1] > left_out[2] > left_out[3]
    assert [drawing.name for drawing in found.drawings] == ["raw", "vectors", "profile"]


def test_bubbles_that_a_mask_does_not_make_good_miss_the_limit() -> None:
    figures = {"mean_error": -0.02, "mean_sigma": 0.01, "within_25": 0.9, "within_sigma": 0.02}
    found = {"hidden": figures, "mask": figures, "paper": figures | {"mean_error": -0.4, "within_25": 0.4}}
    assert [row.verdict for row in _rows(found)] == ["met", "met"]
    assert [row.verdict for row in _rows(found | {"mask": found["paper"]})] == ["missed", "missed"]
    assert [row.ert for row in _rows(found)] == pytest.approx([40.0, 40.0])


@pytest.fixture
def small_camera() -> Camera:
    """The paper's camera with a small_camera sensor."""
    return Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 300, 300)


def test_geometric_depth_moves_the_outermost_views_by_a_microlens(small_camera) -> None:
    depth = geometric_depth_mm(small_camera, WATER)
    near, far = equivalent_object_distance([0.0, depth], small_camera.focus_distance_mm, WATER)
    # a point on the axis, seen from both ends of the aperture, lies on the focal plane that far apart
    assert 2.0 * small_camera.aperture_radius_mm * (far - near) / near == pytest.approx(0.1, rel=0.01)


def test_depth_is_known_least_at_the_focal_plane_and_less_beside_neighbours(small_camera) -> None:
    sigma = smallest_errors_mm(small_camera, WATER, [-3.0, 0.0, 3.0], Readout())
    assert sigma[1, 2] > 10.0 * sigma[[0, 2], 2].max()
    # read noise alone: twice as much is twice the error
    quiet, loud = (
        smallest_errors_mm(small_camera, WATER, [2.0], Readout(None, noise, 96.0))[0, 2] for noise in (50.0, 100.0)
    )
    assert loud == pytest.approx(2.0 * quiet, rel=0.01)
    # Neighbours cost accuracy.
    crowd = replace(small_camera, columns=160, rows=160)
    few, many = (
        of_camera.smallest_errors_crowded_mm(crowd, WATER, each, 4.0, Readout(), np.random.default_rng(3))
        for each in (0.05, 1.0)
    )
    assert many[2] > 1.2 * few[2]


@pytest.mark.thorough
def test_more_iterations_make_a_tracer_shorter(small_camera) -> None:
    first, later = (elongations_mm(small_camera, WATER, [3.0], SolverSettings("sart", count))[0] for count in (2, 12))
    assert 0.5 < later < first < 8.0


@pytest.mark.thorough
def test_the_part_names_the_papers_seeding_per_microlens(tmp_path: Path) -> None:
    found = discussion(Work(tmp_path, "tiny", Console(only_warnings=True), {}))
    # 330.6 pixels each
    assert "0.66 per microlens" in found.text[1]
    assert [drawing.name for drawing in found.drawings] == ["depth", "seeding"]
    assert len(found.tables[0].rows) == 1
