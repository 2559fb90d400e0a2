"""The configuration: what is refused, where the message points, and what the core gets."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.flow.windows import ParallelWalls, RoundWall, layout_windows
from lfpiv_cli.grid import Reference
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import fluid_path_to_focus
from lfpiv_cli.verbs.reconstruct import ReconstructOptions
from tests.commands import CONFIG, ROOT, ended

CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))

RIG = """\
camera:
  main_lens:   {magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}
  microlenses: {focal_length_mm: 0.8, pitch_mm: 0.1}
  sensor:      {pixel_um: 5.5, columns: 235, rows: 177}
media:  {air: 1.0, window: 1.49, fluid: 1.33}
volume: {shape_xyz: [8, 6, 4], voxel_mm: 0.1}
"""


@pytest.fixture
def write(tmp_path: Path) -> Callable[[str], Path]:
    """Write a config and return its path."""

    def written(text: str) -> Path:
        (tmp_path / "rig.yaml").write_text(text)
        return tmp_path / "rig.yaml"

    return written


def refusal(path: Path) -> str:
    """Return the message with which a config is refused."""
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    return str(caught.value)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_shipped_configs_load_and_return_from_json(path: Path) -> None:
    config = load_rig(path)
    again = Config.from_resolved(json.loads(json.dumps(config.resolved(), allow_nan=False)))
    assert again.sections == config.sections


def test_table2_is_shipped_and_gives_the_papers_camera(table2: Camera) -> None:
    assert {path.stem for path in CONFIGS} >= {"table2", "channel", "sample", "seaurchin", "guv"}
    camera = load_rig(CONFIGS[[path.stem for path in CONFIGS].index("table2")]).camera_model()
    for name in ("image_distance_mm", "focus_distance_mm", "aperture_mm", "pixel_mm", "columns", "rows"):
        assert getattr(camera, name) == pytest.approx(getattr(table2, name))
    np.testing.assert_array_equal(camera.lattice.basis, table2.lattice.basis)


@pytest.mark.parametrize(
    ("old", "new", "place", "words"),
    [
        ("pitch_mm: 0.1", "pitch_mm: 0.1, layuot: square", "3:54: camera.microlenses.layuot", "did you mean 'layout'?"),
        ("media:", "mediums:", "5:1: mediums", "did you mean 'media'?"),
        ("rows: 177", "rows: 177, rows: 178", "4:57: camera.sensor.rows", "repeated key, first on line 4"),
        ("rows: 177", "rows: 177.5", "4:52: camera.sensor.rows", "is 177.5, expected a whole number"),
        ("rows: 177", "rows: '177'", "4:52: camera.sensor.rows", "is '177', expected a whole number"),
        ("rows: 177", "rows: yes", "4:52: camera.sensor.rows", "is 'yes', expected a whole number"),
        ("rows: 177", "rows: true", "4:52: camera.sensor.rows", "is true, expected a whole number"),
        ("rows: 177", "rows: 12:30", "4:52: camera.sensor.rows", "is '12:30', expected a whole number"),
        ("5.5", ".nan", "4:27: camera.sensor.pixel_um", "is nan, expected a finite number"),
        ("5.5", "1e400", "4:27: camera.sensor.pixel_um", "is inf, expected a finite number"),
        ("5.5", "-5.5", "4:27: camera.sensor.pixel_um", "is -5.5, expected more than 0"),
        ("-1.0", "0.5", "2:32: camera.main_lens.magnification", "is 0.5, expected less than 0"),
        ("1.33", "0.9", "5:41: media.fluid", "is 0.9, expected at least 1"),
        ("[8, 6, 4]", "[8, 6]", "6:21: volume.shape_xyz", "is missing"),
        ("[8, 6, 4]", "[8, 6, x]", "6:28: volume.shape_xyz[2]", "is 'x', expected a whole number"),
        ("voxel_mm: 0.1", "voxel_mm: 0.1, reference: focus", "6:58: volume.reference", "expected 'focal_point' or"),
        ("{shape_xyz: [8, 6, 4], voxel_mm: 0.1}", "[1]", "6:9: volume", "is [1], expected a section of keys"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(write, old: str, new: str, place: str, words: str) -> None:
    path = write(RIG.replace(old, new))
    message = refusal(path)
    assert message.startswith(f"{path}:{place}"), message
    assert words in message


def test_all_errors_come_in_one_run_in_the_order_of_the_file(write) -> None:
    text = RIG.replace("-1.0", "1.0").replace("5.5", "x").replace("media:", "media: {}\nmedia:") + "voulme: 3\n"
    lines = refusal(write(text)).splitlines()
    assert [line.split(":")[1] for line in lines] == ["2", "4", "6", "8"]


@pytest.mark.parametrize(
    ("addition", "words"),
    [
        ("window: {distance_mm: 250.0, thickness_mm: 2.0}", "window's far face"),
        ("window: {thickness_mm: 2.0}", "window.distance_mm: is missing; where only the thickness of a channel's wall"),
        ("board: {dots: [7, 7], spacing_mm: 0.2, dot_diameter_mm: 0.2}", "less than the spacing of 0.2"),
        ("board: {spacing_mm: 0.2, dot_diameter_mm: 0.1}", "dots: is missing for pattern dots"),
        ("board: {pattern: chessboard, squares: [5, 4], marker_mm: 0.1, spacing_mm: 1}", "not for pattern chessboard"),
        ("board: {pattern: chessboard, squares: [5, 3], spacing_mm: 1}", "squares: is (5, 3), expected 4 or more"),
        ("correlation: {windows: [16, 32]}", "expected coarse to fine"),
        ("correlation: {windows: [16], window_mm: 1.6}", "contradicts window_mm"),
        ("channel: {width_mm: 9, wall_mm: 2, board_from_mid_plane_mm: 1}", "is for a board in the fluid"),
        ("correlation: {windows: []}", "at least one window"),
        ("correlation: {mask: pipe}", "correlation.mask: is pipe, which needs the section pipe"),
        ("pipe: {radius_mm: 5.0}\nchannel: {width_mm: 9, wall_mm: 2}", "radius_mm: is 5, but channel.width_mm is 9"),
        ("correlation: {overlap: 1.0}", "less than 1"),
        ("simulation: {brightness: [2, 1]}", "expected a range"),
        ("simulation: {light_z_mm: [1, 1]}", "light_z_mm: is [1.0, 1.0], expected a range"),
        ("simulation: {brightness: [1, 2], brightness_log_sigma: 0.5}", "contradicts brightness"),
        ("validation: {flow_methods: [volumes, volumes]}", "expected each method once"),
        ("weights: {method: dlfc}\nvalidation: {flow_methods: [particles]}", "fitted with traced rays"),
        ("window: {distance_mm: 98, thickness_mm: 2}\nchannel: {width_mm: 9, wall_mm: 5}", "but channel.wall_mm is 5"),
    ],
)
def test_contradictions_are_named(write, addition: str, words: str) -> None:
    assert words in refusal(write(RIG + addition + "\n"))


# What stands in the rig, what stands there instead (`&` for the old), and words of what is said of it.
APERTURE = "aperture_mm: 25.0"
IMPOSSIBLE = [
    (APERTURE, "&, f_number: 5.6", "focal_length_mm / aperture_mm is 4"),
    (APERTURE, "&, image_distance_mm: 210", "focal_length_mm (1 - magnification) is 200"),
    (APERTURE, "&, image_distance_mm: 200, pupil_ratio: 1.3", "focal_length_mm (1.3 - magnification) is 230"),
    (APERTURE, "&, image_distance_mm: 200, image_distance: infinite", "is 200, but image_distance is infinite"),
    (APERTURE, "&, pupil_ratio: 2, image_distance: infinite", "pupil_ratio: is 2, but image_distance is infinite"),
    (APERTURE, "f_number: null", "needs aperture_mm or f_number"),
    ("focal_length_mm: 100.0, aperture_mm", "image_distance: infinite, aperture_mm", "needs focal_length_mm"),
    ("pitch_mm: 0.1", "&, f_number: 4.0", "focal_length_mm / pitch_mm is 8"),
    ("shape_xyz: [8, 6, 4]", "size_mm: [1, 1, 1]", "contradicts size_mm"),
    ("shape_xyz: [8, 6, 4], ", "", "needs shape_xyz and voxel_mm, or size_mm"),
    ("voxel_mm: 0.1", "&, reference: mid_plane", "needs the section channel"),
    ("voxel_mm: 0.1", "&, centre_mm: [0, 0, -300]", "behind the lens, which is 200 mm away"),
    ("fluid: 1.33", "fluid: 0.9", "media.fluid: is 0.9, expected at least 1"),
]


@pytest.mark.parametrize(("old", "new", "words"), IMPOSSIBLE)
def test_impossible_physics_is_named_with_its_numbers(tmp_path: Path, old: str, new: str, words: str) -> None:
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.replace(old, new.replace("&", old)))
    code, said = ended("build-weights", rig, "-o", tmp_path / "w.h5")
    assert (code, words in said, (tmp_path / "w.h5").exists()) == (3, True, False), said


def test_total_reflection_is_named_with_its_numbers(write) -> None:
    """At the rim of a lens of radius 225 mm, 200 mm away, sin is 0.747: in oil (1.5), n sin = 1.12."""
    wide = RIG.replace("25.0", "450.0")
    load_rig(write(wide))
    message = refusal(write(wide.replace("air: 1.0, window: 1.49, fluid: 1.33", "air: 1.5, window: 1.49, fluid: 1.1")))
    assert "media.fluid: is 1.1" in message
    assert "n sin = 1.12" in message


# What is no config, and words of what is said of it.
HOSTILE_TEXT = [
    (b"camera:\n\tmain_lens: 1\n", "2:1: is not YAML: a tab"),
    (b"a: &x [1]\nb: [*x, *x]\n", "alias"),
    (b"a0: &a0 [x, x]\n" + b"".join(b"a%d: &a%d [*a%d, *a%d]\n" % (k, k, k - 1, k - 1) for k in range(1, 60)), "alias"),
    (b"a: !!python/object:os.system {}\n", "tag"),
    (b"a: " + b"[" * 5000 + b"]" * 5000, "deeper than 20"),
    (b"a: " + b"{a: " * 5000, "deeper than 20"),
    (b"a: 1 \0\n", "control character"),
    (b"camera: \xff\xfe\n", "1:9: is not UTF-8"),
    (b"# " + b"x" * 10_000_000, "expected at most 1048576"),
    (b"- 1\n", "is not a mapping"),
    (b"a: 1\n---\nb: 1\n", "second document"),
    (b"a: [1, 2\n", "is not YAML"),
    *((b"a: " + digits + b"\n", "too long a number") for digits in (b"9" * 4000, b"-" + b"9" * 20_000)),
    *((b"a: " + digits + b"\n", "too long a number") for digits in (b"0x" + b"f" * 20_000, b"0o" + b"7" * 20_000)),
    (b"camera: {}\n" + b"".join(b"k%d: 1\n" % k for k in range(1000)), "more errors"),
    (b"steps: {}\nfigures: {}\n", "is no rig file: it has steps, figures, expected camera, "),
]


@pytest.mark.parametrize(("content", "words"), HOSTILE_TEXT, ids=[words for _, words in HOSTILE_TEXT])
def test_hostile_text_is_refused_quickly(tmp_path: Path, content: bytes, words: str) -> None:
    (tmp_path / "rig.yaml").write_bytes(content)
    begun = time.thread_time()
    code, said = ended("check", tmp_path / "rig.yaml")
    assert (code, words in said, len(said) < 5000) == (3, True, True), said
    assert time.thread_time() - begun < 1.0


def test_what_a_lattice_alone_and_numbers_of_yaml_1_2_mean(write) -> None:
    config = load_rig(write(RIG.replace("0.8,", "8e-1,").replace("177", "0xB1")))
    assert config.camera_model().microlens_focal_length_mm == 0.8
    assert config.image_shape() == (177, 235)
    # A lattice alone needs no main lens.
    config = load_rig(write("camera: {microlenses: {pitch_mm: 0.1}, sensor: {pixel_um: 5, columns: 9, rows: 7}}\n"))
    assert config.image_shape() == (7, 9)
    with pytest.raises(ConfigError, match="camera.main_lens: is missing"):
        config.camera_model()


@pytest.mark.parametrize(
    ("section", "ask"),
    [
        ("camera", Config.camera_model),
        ("camera", Config.image_shape),
        ("media", Config.media_model),
        ("volume", Config.grid),
        ("window", Config.window_model),
        ("simulation.flow", Config.simulated_flow),
        ("validation.flow", Config.true_flow),
    ],
)
def test_what_a_command_needs_and_the_file_lacks_is_named(write, section: str, ask) -> None:
    config = load_rig(write("weights: {}\n"))
    with pytest.raises(ConfigError, match=f"rig.yaml: {section}: is missing"):
        ask(config)


def test_lengths_follow_from_f_numbers_pupils_and_the_image_distance(write, table2: Camera) -> None:
    text = RIG.replace("focal_length_mm: 100.0, aperture_mm: 25.0", "image_distance_mm: 200, f_number: 4")
    camera = load_rig(write(text.replace("{focal_length_mm: 0.8", "{f_number: 8"))).camera_model()
    assert (camera.focal_length_mm, camera.aperture_mm) == (100.0, 25.0)
    assert camera.microlens_distance_mm == camera.microlens_focal_length_mm == pytest.approx(0.8)
    # With P = 1.25 the array lies 100 (1.25 + 1) mm behind the exit pupil, the focus 180 mm before the entrance.
    for reported in ("focal_length_mm: 100, pupil_ratio: 1.25", "image_distance_mm: 225, pupil_ratio: 1.25"):
        camera = load_rig(write(RIG.replace("focal_length_mm: 100.0", reported))).camera_model()
        assert camera.focus_distance_mm == pytest.approx(180.0)
        assert camera.micro_image_lattice_px().pitch * 5.5 == pytest.approx(100.0 * (1.0 + 0.8 / 225.0))
        assert camera.aperture_mm == 25.0
    telecentric = RIG.replace("focal_length_mm: 100.0", "focal_length_mm: 100, image_distance: infinite")
    camera = load_rig(write(telecentric)).camera_model()
    assert camera.focus_distance_mm == pytest.approx(100.0)
    assert camera.micro_image_lattice_px().pitch * 5.5 == pytest.approx(100.0)


def test_grid_is_centred_and_moved_and_voxels_chosen_by_the_program_fill_the_size(write) -> None:
    grid = load_rig(write(RIG.replace("voxel_mm: 0.1", "voxel_mm: [0.1, 0.2, 0.3], centre_mm: [1, 2, 3]"))).grid(
        Reference("mid_plane", -0.5)
    )
    assert grid.spacing_mm == (0.1, 0.2, 0.3)
    middle = [np.mean(grid.bounds_mm(axis)) for axis in range(3)]
    assert middle == pytest.approx([1.0, 2.0, 2.5])
    text = RIG.replace("shape_xyz: [8, 6, 4], voxel_mm: 0.1", "size_mm: [1.3, 1.0, 1.03]")
    grid = load_rig(write(text)).grid()
    assert np.multiply(grid.shape_xyz, grid.spacing_mm) == pytest.approx([1.3, 1.0, 1.03])
    assert grid.spacing_mm[0] == pytest.approx(0.1 / 3.0)
    assert 0.15 < grid.spacing_mm[2] < 0.25


def test_windows_in_voxels_and_millimetres(write) -> None:
    config = load_rig(write("correlation: {window_mm: 1.6}\n"))
    assert config.windows_voxel((0.1, 0.1, 0.2))[-1] == (16, 16, 8)
    config = load_rig(write("correlation: {windows: [32, [16, 16, 8]]}\n"))
    assert config.windows_voxel((1, 1, 1)) == ((32, 32, 32), (16, 16, 8))
    # Cubes by default, as far as long voxels allow.
    config = load_rig(write("correlation: {dt_s: 0.001}\n"))
    assert config.windows_voxel((0.1, 0.1, 0.1)) == ((32, 32, 32), (16, 16, 16))
    assert config.windows_voxel((0.1, 0.1, 0.15)) == ((32, 32, 22), (16, 16, 11))
    # as the program chooses voxels: 16 of them would be 8 mm deep
    assert config.windows_voxel((0.083, 0.083, 0.5)) == ((32, 32, 16), (16, 16, 8))


@pytest.mark.parametrize("voxel_mm", np.linspace(0.04, 0.22, 37))
def test_windows_in_millimetres_always_give_the_paper_s_number(write, voxel_mm: float) -> None:
    config = load_rig(write("correlation: {window_mm: 1.6}\n"))
    voxel = (voxel_mm,) * 3
    shape = tuple(round(length / voxel_mm) for length in (10.0, 13.0, 10.0))
    layout = layout_windows(shape, config.windows_voxel(voxel)[-1], config.overlap(voxel))
    # Where rounding has made the volume shorter than it takes, a window is missing.
    expected = tuple(int(n * voxel_mm / 0.8 + 1e-9) for n in shape)
    assert layout.count == expected
    assert expected[0] == 12
    for axis in range(3):
        cells = layout.count[axis] * layout.step[axis]
        assert cells <= shape[axis] < cells + layout.count[axis] + layout.step[axis]


def test_the_channels_wall_puts_the_focal_point_where_it_is(write) -> None:
    """The window implied by wall, channel and mid plane must give back the fluid path width/2 - mid_plane_z."""
    config = load_rig(write(RIG + "channel: {width_mm: 10.0, wall_mm: 5.0}\n"))
    window = config.window_model(mid_plane_z_mm=-0.4655)
    assert window.thickness_mm == 5.0
    path = fluid_path_to_focus(window, config.camera_model().focus_distance_mm, config.media_model())
    assert path == pytest.approx(5.4655)


def test_walls_are_those_of_the_section_that_is_named(write) -> None:
    sections = "channel: {width_mm: 10, wall_mm: 2, no_slip: true}\npipe: {radius_mm: 5.0, centre_mm: [0, 0, 0.1]}\n"
    config = load_rig(write(RIG + sections))
    assert config.masking_walls() is None
    assert config.still_walls() == ParallelWalls(10.0)
    config = load_rig(write(RIG + sections.replace("0.1]", "0.1], no_slip: true") + "correlation: {mask: pipe}\n"))
    assert config.masking_walls() == config.still_walls() == RoundWall(5.0, (0.0, 0.0, 0.1), "x")


def test_options_override_and_are_checked(write) -> None:
    config = load_rig(write("reconstruction: {solver: sart, iterations: 200}\ncorrelation: {window_mm: 1.6}\n"))
    assert config.overridden("reconstruction", solver=None, iterations=5).reconstruction.iterations == 5
    options = ReconstructOptions(iterations=7, solver=None, mask=Path("mask.png"))
    assert config.overridden_by("reconstruction", options) == config.overridden("reconstruction", iterations=7)
    assert config.overridden("reconstruction", iterations=None) is config
    assert config.overridden("correlation", windows=[32, [16, 16, 8]]).correlation.windows == ((32,) * 3, (16, 16, 8))
    with pytest.raises(ConfigError, match="correlation.windows"):
        config.overridden("correlation", windows=[16, 32])


def test_flow_centres_move_with_the_origin(write) -> None:
    text = "simulation: {flow: {kind: shear, rate_per_s: 1000, centre_mm: [0, 0, 0.5]}}\n"
    config = load_rig(write(text))
    points = np.array([[0.0, 0.0, 2.5]])
    assert config.true_flow()(points)[0] == pytest.approx([2.0, 0.0, 0.0])
    assert config.simulated_flow(Reference("mid_plane", 1.0))(points)[0] == pytest.approx([1.0, 0.0, 0.0])


def test_what_follows_from_other_sections_unless_given(write) -> None:
    exponents = {"reconstruction: {solver: em}": 0.5, "reconstruction: {solver: sart}": 1.0}
    for sections, exponent in (exponents | {"correlation: {exponent: 0.75}": 0.75}).items():
        assert load_rig(write(RIG + sections)).correlation_settings((1.0, 1.0, 1.0)).exponent == exponent
    for sections, methods in (
        ("", ("volumes", "particles")),
        ("weights: {method: dlfc}", ("volumes",)),
        ("reconstruction: {solver: particles}", ("particles",)),
        ("validation: {flow_methods: [particles]}", ("particles",)),
    ):
        assert load_rig(write(RIG + sections)).flow_methods() == methods
    text = "reconstruction: {solver: particles}\nvalidation: {flow_methods: [volumes, particles]}\n"
    with pytest.raises(ConfigError, match="flow_methods: holds volumes"):
        load_rig(write(RIG + text)).flow_methods()


def changed(folder: Path, keys: str, value: Any, **others: Any) -> Path:
    """Write the sample's config with another value of a key, and other sections' keys."""
    config = yaml.safe_load(CONFIG.read_text())
    config["volume"] |= {"shape_xyz": [3, 2, 2], "reference": "focal_point"}
    for name, new in {keys: value, **others}.items():
        *sections, key = name.split(".")
        section = config
        for each in sections:
            section = section.setdefault(each, {})
        section[key] = new
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    return folder / "rig.yaml"


LENS = "camera.main_lens."


@pytest.mark.parametrize("value", [1e300, 1e-300])
@pytest.mark.parametrize(
    "keys",
    [f"{LENS}aperture_mm", f"{LENS}magnification", f"{LENS}focal_length_mm", "camera.microlenses.focal_length_mm"]
    + ["camera.sensor.microlens_distance_mm", "volume.voxel_mm", "correlation.dt_s", "simulation.distortion_per_mm2"],
)
def test_numbers_that_no_bench_has_are_named(tmp_path: Path, keys: str, value: float) -> None:
    code, said = ended("check", changed(tmp_path, keys, -value if keys.endswith("magnification") else value))
    assert (code, keys in said) == (3, True), said


def test_light_that_only_the_volumes_corners_lose_is_named(tmp_path: Path) -> None:
    lens = {"magnification": -8.0, "focal_length_mm": 100.0, "aperture_mm": 112.5}
    others = {"camera.main_lens": lens, "volume.voxel_mm": [4.0, 4.0, 0.01]}
    rig = changed(tmp_path, "media", {"air": 2.2, "window": 1.0, "fluid": 1.0}, **others)
    code, said = ended("simulate", "particles", rig, "-o", tmp_path / "simulated")
    assert (code, "totally reflected" in said) == (3, True), said


@pytest.mark.parametrize(
    ("keys", "value"), [("camera.microlenses.focal_length_mm", 1e-9), ("camera.main_lens.aperture_mm", 25_000.0)]
)
def test_lens_images_that_cannot_be_are_named(tmp_path: Path, keys: str, value: float) -> None:
    rig = changed(tmp_path, keys, value)
    assert ended("build-weights", rig, "--dry-run", "-o", tmp_path / "w.h5")[0] == 3
    assert ended("check", rig)[0] == 3
