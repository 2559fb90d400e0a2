"""The section `scene`: what it becomes, what it cannot be, who refuses it; distortion undone on writing a volume."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import tifffile

from lfpiv_cli.calibration import model
from lfpiv_cli.console import CONSOLE
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.calibration_file import open_calibration, write_calibration
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.sections import FaceSection
from lfpiv_cli.files.yaml_nodes import read_heights
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import SurfaceKind
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.shapes import HeightMap, ScenePose
from lfpiv_cli.optics.surfaces import Cylinder, Plane, Sphere, TiltedPlane
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.verbs import validate
from lfpiv_cli.verbs.build_weights import plan_of, weights_of
from lfpiv_cli.verbs.particles import searchable
from lfpiv_cli.verbs.planning import bench_of
from lfpiv_cli.weights.build import factorise, scene_distortion
from lfpiv_cli.weights.model import Weights
from tests.commands import ROOT, WATER
from tests.known_rays import points_counted
from tests.test_config import RIG as WITHOUT_BOARD

RIG = WITHOUT_BOARD + "board: {dots: [7, 7], spacing_mm: 1.0, dot_diameter_mm: 0.2, medium: fluid}\n"
TUBE = """\
scene:
  - {kind: cylinder, axis: x, radius_mm: 7.0, centre_mm: [0, 0, 0], behind: window}
  - {kind: cylinder, axis: x, radius_mm: 5.0, behind: fluid}
"""


@pytest.fixture
def configured(tmp_path: Path) -> Callable[[str], Config]:
    def config_of(text: str) -> Config:
        path = tmp_path / "rig.yaml"
        path.write_text(text)
        return load_rig(path)

    return config_of


def test_a_scene_becomes_faces(configured: Callable[[str], Config]) -> None:
    scene = """\
scene:
  - {kind: plane, z_mm: -30, behind: 1.52}
  - {kind: tilted_plane, point_mm: [0, 0, -20], normal: [0.1, 0, 1], behind: 1.4}
  - {kind: sphere, radius_mm: 40, centre_mm: [0, 0, -50], facing: concave, behind: window}
  - {kind: cylinder, axis: [1, 0.1, 0], radius_mm: 5.0, behind: fluid}
"""
    config = configured(RIG + scene)
    expected = (
        Face(Plane(-30.0), 1.52),
        Face(TiltedPlane((0.0, 0.0, -20.0), (0.1, 0.0, 1.0)), 1.4),
        Face(Sphere((0.0, 0.0, -50.0), 40.0, "concave"), 1.49),
        Face(Cylinder((0.0, 0.0, 0.0), (1.0, 0.1, 0.0), 5.0), 1.33),
    )
    assert config.object_space() == CurvedSpace(WATER, expected)
    # as files carry it
    assert Config.from_resolved(config.resolved()).object_space() == CurvedSpace(WATER, expected)
    for name, axis in (("x", (1.0, 0.0, 0.0)), ("y", (0.0, 1.0, 0.0))):
        space = configured(RIG + TUBE.replace("axis: x", f"axis: {name}")).object_space()
        assert space.faces[0].surface == Cylinder((0.0, 0.0, 0.0), axis, 7.0)
    # Rays through a scene are exact and need no window.
    for weights in ("method: drt", "refraction: exact", "refraction: paraxial"):
        config = configured(RIG + TUBE + f"weights: {{{weights}}}\n")
        assert isinstance(config.object_space(), CurvedSpace)
        assert config.refraction() == "exact"


HEIGHTS = np.array([[-8.0, -7.75, -7.5, -7.75, -8.0]] * 4)
MOULD = "scene:\n  - {kind: height_map, file: mould/FILE, spacing_mm: [2, 3], centre_mm: [0, 0, 1], behind: window}\n"
IN_MOULD = RIG + MOULD + TUBE.splitlines(keepends=True)[2]
# As people have them.
WRITERS: dict[str, Callable[[Path], object]] = {
    "heights.csv": lambda path: np.savetxt(path, HEIGHTS + 1e-14, delimiter=", ", header="mm from the flange"),
    "heights.txt": lambda path: np.savetxt(path, HEIGHTS + 1e-14, delimiter="\t", header="mm from the flange"),
    "heights.npy": lambda path: np.save(path, HEIGHTS),
    "heights.tif": lambda path: tifffile.imwrite(path, HEIGHTS.astype(np.float32)),
}


@pytest.mark.parametrize("file", WRITERS)
def test_heights_beside_the_rig_become_its_part(configured: Callable[[str], Config], tmp_path: Path, file: str) -> None:
    (tmp_path / "mould").mkdir()
    WRITERS[file](tmp_path / "mould" / file)
    config = configured(IN_MOULD.replace("FILE", file))
    expected = (
        Face(HeightMap(tuple(map(tuple, HEIGHTS.tolist())), (2.0, 3.0), (0.0, 0.0, 1.0)), 1.49),
        Face(Cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5.0), 1.33),
    )
    assert config.object_space() == CurvedSpace(WATER, expected)
    # as files carry it, wherever the heights have gone
    (tmp_path / "mould" / file).unlink()
    again = Config.from_resolved(json.loads(json.dumps(config.resolved(), allow_nan=False)))
    assert again.object_space() == CurvedSpace(WATER, expected)
    assert "mould" not in json.dumps(config.resolved())


@pytest.mark.parametrize(
    ("file", "content", "words"),
    [
        ("a.csv", None, ":9:30: scene[0].file: {path}: no such file"),
        ("a.csv", b"1, 2\n3, x", "scene[0].file: {path}: line 2: could not convert string to float: 'x'"),
        ("a.csv", b"# nothing", "scene[0]: 0 rows of no heights are no grid"),
        ("a.csv", b"1 2 3 4\n1 2 3\n1 2 3 4\n1 2 3 4", "scene[0]: 4 rows of 3 or 4 heights are no grid"),
        (
            "a.csv",
            b"1;2;3;4\n" * 3 + b"1;2;nan;4",
            "{path}: 1 heights are no numbers, the first one in row 4, column 3",
        ),
        ("a.csv", b"1 " * 20_000, "scene[0].file: {path}: holds 20000 heights or more, expected at most 16384"),
        ("a.npy", b"no array", "scene[0].file: {path}: is no NumPy array"),
        ("a.npy", b"\x93NUMPY\x01\x00\x10\x00{'shape': (4, 4\xa6\n", "scene[0].file: {path}: is no NumPy array: "),
        ("a.tif", b"no image", "scene[0].file: {path}: "),
    ],
)
def test_what_is_no_file_of_heights_is_named(
    configured: Callable[[str], Config], tmp_path: Path, file: str, content: bytes | None, words: str
) -> None:
    path = tmp_path / "mould" / file
    path.parent.mkdir()
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError) as refused:
        configured(IN_MOULD.replace("FILE", file))
    assert words.format(path=path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_heights_that_are_none_or_given_twice_are_named(tmp_path: Path, configured: Callable[[str], Config]) -> None:
    for shape, kind in (((4,), "f8"), ((3, 4, 5), "f8"), ((4, 4), "c16"), ((200, 200), "f4")):
        np.save(tmp_path / "a.npy", np.zeros(shape, kind))
        with pytest.raises(InputError, match="expected numbers \\(rows, columns\\)|holds 40000 heights"):
            read_heights(tmp_path / "a.npy")
    for keys in ("", "file: a.csv, heights_mm: [[1, 2], [3, 4]], "):
        with pytest.raises(ConfigError, match=r"scene\[0\]: expected a file of heights, or heights_mm, and not both"):
            configured(RIG + MOULD.replace("file: mould/FILE, ", keys).replace("behind: window", "behind: fluid"))


def test_without_a_scene_layers_are_plane_and_weights_are_made_through_one(configured: Callable[[str], Config]) -> None:
    assert configured(RIG).object_space() == ObjectSpace(WATER, None, "paraxial")
    assert isinstance(configured(RIG + TUBE).ray_source(None), CurvedSpace)
    kinds = [get_args(section.model_fields["kind"].annotation)[0] for section in get_args(get_args(FaceSection)[0])]
    assert kinds == list(get_args(SurfaceKind))
    assert configured(RIG + TUBE + "pipe: {radius_mm: 5.0, centre_mm: [3, 0, 0]}").pipe is not None
    tilted = TUBE.replace("axis: x", "axis: [1, 0.01, -0.02]")
    assert configured(RIG + tilted + "pipe: {radius_mm: 5, centre_mm: [1, 0.01, -0.02], axis: [2, 0.02, -0.04]}").pipe
    with pytest.raises(ConfigError, match="scene: has 0 entries, expected 1"):
        configured(RIG + "scene: []")
    with pytest.raises(ConfigError, match="scene: needs the section media"):
        configured(RIG.replace("media:  {air: 1.0, window: 1.49, fluid: 1.33}", "") + TUBE)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("behind: fluid", "behind: glass", ":10:55: scene[1].behind: is 'glass', expected 'window' or 'fluid'"),
        ("behind: fluid", "behind: 0.9", "scene[1].behind: is 0.9, expected at least 1"),
        ("behind: fluid", "behind: window", ":10:55: scene[1].behind: is window, expected fluid behind the last face"),
        ("behind: fluid", "behind: 1.34", "scene[1].behind: is 1.34, expected fluid"),
        (", behind: fluid", "", "scene[1].behind: is missing"),
        ("axis: x, radius_mm: 5", "axis: z, radius_mm: 5", "scene[1].axis: is 'z', expected 'x' or 'y'"),
        ("axis: x, radius_mm: 5", "axis: 1, radius_mm: 5", "scene[1].axis: is 1, expected a list in brackets"),
        ("axis: x, radius_mm: 5", "axis: [0, 0, 1], radius_mm: 5", "scene[1]: the optical axis misses the cylinder"),
        ("radius_mm: 5.0", "radius_mm: 5.0, centre_mm: [0, 6, 0]", ":10:5: scene[1]: the optical axis misses"),
        ("radius_mm: 5.0", "radius_mm: 8.0", "scene: face 2 meets the optical axis at z = -8 mm, face 1 at -7"),
        ("radius_mm: 5.0", "radius_mm: 5.0, facng: concave", "scene[1].facng: unknown key; did you mean 'facing'?"),
        ("kind: cylinder, axis: x, radius_mm: 5.0", "kind: tube", "scene[1].kind: is 'tube', expected one of 'plane'"),
        ("kind: cylinder, axis: x, radius_mm: 5.0", "z_mm: 5.0", "scene[1].kind: is missing"),
        ("centre_mm: [0, 0, 0]", "centre_mm: [0, 0, -400]", "z = -407 mm, lies behind the lens"),
        # walls that contradict it
        ("", "window: {distance_mm: 98.0, thickness_mm: 2.0}", "window: contradicts scene"),
        ("", "channel: {width_mm: 10.0, wall_mm: 2.0}", "channel: contradicts scene"),
        ("", "pipe: {radius_mm: 4.0}", "pipe.radius_mm: is 4, but that of the last face in scene is 5"),
        ("", "pipe: {radius_mm: 5.0, axis: y}", "pipe.axis: is y, but that of the last face in scene is x"),
        ("", "pipe: {radius_mm: 5, centre_mm: [0, 0, 1]}", "pipe.centre_mm: is [0.0, 0.0, 1.0], but that of the last"),
        ("", "pipe: {radius_mm: 5, axis: [1, 0.01, 0]}", "pipe.axis: is [1.0, 0.01, 0.0], but that of the last"),
        ("", "pipe: {radius_mm: 5, axis: [1, 0.1, 0]}", "expected a direction within 5 degrees of x or y"),
        ("", "pipe: {radius_mm: 5, axis: [0, 0, 0]}", "expected a direction within 5 degrees of x or y"),
    ],
)
def test_what_cannot_be_is_named(configured: Callable[[str], Config], old: str, new: str, words: str) -> None:
    with pytest.raises(ConfigError) as refused:
        configured(RIG + (TUBE.replace(old, new) if old else TUBE + new))
    assert words in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def test_what_knows_plane_windows_alone_refuses_a_scene(configured: Callable[[str], Config]) -> None:
    flow = "simulation: {flow: {kind: uniform, velocity_m_s: [0.1, 0, 0]}}\ncorrelation: {dt_s: 0.001}\n"
    config = configured(RIG + TUBE + flow)
    for what, work in (
        ("planning an experiment", lambda: bench_of(config, None)),
        ("validating boards", lambda: validate.bench_of(config, "ideal")),
        ("this command", config.window_model),
    ):
        with pytest.raises(ConfigError, match=f"rig.yaml: scene: {what} is possible through plane windows"):
            work()


def test_particles_are_fitted_through_a_scene_behind_square_lenses_alone(configured: Callable[[str], Config]) -> None:
    config = configured(RIG.replace("board:", "reconstruction: {padding_voxel: [0, 0, 0]}\nboard:") + TUBE)
    weights = weights_of(plan_of(config, None), {}, CONSOLE)
    assert searchable(weights, config) is weights
    camera = replace(weights.camera, lattice=Lattice.regular(0.1, "hexagonal"))
    with pytest.raises(ConfigError, match="through a scene particles are fitted behind square microlenses alone"):
        searchable(replace(weights, camera=camera), config)


@pytest.mark.slow
def test_weights_are_validated_through_a_scene(configured: Callable[[str], Config], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    configured(RIG + TUBE + "validation: {weights: {sample: 1}}\n")
    reported = validate.validate_weights(tmp_path / "rig.yaml", tmp_path / "report")
    assert reported["voxels"] == 6
    # Near the tube's axis; 5 million rays alone are off by 0.045.
    assert reported["factorised_to_converged.l1_largest"] < 0.03
    assert reported["on_demand_to_converged.l1_largest"] < 0.03
    assert 0.03 < reported["ray_count_to_converged.l1_mean"] < 0.07
    assert (tmp_path / "report" / "weights_columns.png").stat().st_size > 10_000
    configured(RIG.replace("voxel_mm: 0.1", "voxel_mm: 0.1, centre_mm: [0, 20, 0]") + TUBE)
    with pytest.raises(ConfigError, match="no voxel of the volume lies wholly in the fluid"):
        validate.validate_weights(tmp_path / "rig.yaml", tmp_path / "none")


def test_a_calibration_moves_the_scene_and_the_pipe(configured: Callable[[str], Config], tmp_path: Path) -> None:
    """Faces, and the pipe with them, lie in the resolved config where the calibration has them."""
    reported = configured(RIG + TUBE + "pipe: {radius_mm: 5.0}")
    camera = reported.camera_model()
    still, turn = np.zeros(3), np.array([0.0, 0.2, 0.3])
    pose = ScenePose(np.array([0.0, 0.15, -0.2]), turn, still, still, still, reported.scene_fingerprint())
    found = replace(model.calibrate(model.Photographs(), None, model.DataSheet(camera=camera)), scene=pose)
    write_calibration(tmp_path / "refined.h5", found, {}, False)
    read = open_calibration(tmp_path / "refined.h5")
    assert read.scene is not None
    assert read.summary()["scene_turn_deg"] == turn.tolist()
    config = reported.with_scene_of(read)
    moved, before = config.scene_space(), reported.scene_space()
    assert moved is not None
    assert before is not None
    assert moved == before.moved(pose.motion)
    assert config.pipe is not None
    np.testing.assert_allclose(config.pipe.centre_mm, (0.0, 0.15, -0.2))
    # to the right seen along the axis is towards +y, and nearer to the camera
    axis = np.array(config.pipe.axis)
    np.testing.assert_allclose(axis[1:], np.deg2rad((0.3, -0.2)), rtol=1e-4)
    # what is moved is not moved again
    with pytest.raises(ConfigError, match="is not the one whose place the calibration tells"):
        config.with_scene_of(read)
    with pytest.raises(ConfigError, match="scene: is missing"):
        configured(RIG).with_scene_of(read)
    assert reported.with_scene_of(replace(read, scene=None)) is reported
    assert plan_of(config, None).source == moved


RAYS = 200_000
# Far more than a real lens has, as the sensor is small: at 2 mm from the axis 1.2 % or 0.03 mm.
K1_PER_MM2 = 3e-3


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_a_point_off_the_axis_comes_back(
    table2: Camera, water: Media, rng: np.random.Generator, column_axis: str
) -> None:
    lattice = Lattice.regular(0.1, origin=(0.013, -0.021))
    camera = replace(table2, columns=900, rows=900, lattice=lattice, column_axis=column_axis)
    camera = replace(camera, distortion_per_mm2=K1_PER_MM2)
    true = (1.62, -1.13, 2.5)
    grid = Grid.centred((30, 30, 1), (0.05, 0.05, 0.1), true)
    assert scene_distortion(table2, water, grid) is None
    bend = scene_distortion(camera, water, grid)
    assert bend is not None
    # (s_i/s_o)^2 by hand: 200 / (200 + 2.5/1.33), squared.
    assert bend[0] == pytest.approx(K1_PER_MM2 * (200.0 / (200.0 + 2.5 / 1.33)) ** 2)
    weights = Weights(grid, (0, 0, 0), factorise(camera, water, grid), column_axis, None, bend)
    points = camera.to_image_axes(np.broadcast_to(true, (RAYS, 3)))
    volume = weights.adjoint(points_counted(points, camera, water, rng).astype(np.float32))
    # The centre of the bright part of a plane.
    found, (y, x) = [], np.meshgrid(grid.axis_mm(1), grid.axis_mm(0), indexing="ij")
    for taken in (volume, weights.to_world(volume)):
        plane = np.clip(taken[0] - 0.3 * taken[0].max(), 0.0, None)
        found.append([float((plane * axis).sum() / plane.sum()) for axis in (x, y)])
    off = np.hypot(*(np.array(found) - true[:2]).T)
    assert off[0] == pytest.approx(bend[0] * np.hypot(*true[:2]) ** 3, rel=0.3)
    # The adjoint is a blur as wide as a microlens, 0.1 mm; its middle is known to a tenth of that.
    assert off[1] < 0.2 * off[0]


@pytest.mark.parametrize(("name", "radius"), [("pipe", 7.0), ("pipe_box", 13.0)])
def test_the_camera_is_moved_from_a_pipes_board_to_its_axis_as_the_recipe_says(name: str, radius: float) -> None:
    """The recipe's figures, from a board on the outermost face or in the axis's place, are the scene's own."""
    settings = load_rig(ROOT / "configs" / f"{name}.yaml")
    space, camera = settings.scene_space(), settings.camera_model()
    assert space is not None
    to_face = space.shapes()[0].vertex_mm[2] - space.lens_z_mm(camera)
    move, recipe = camera.focus_distance_mm - to_face, (ROOT / "docs" / "curved-windows.md").read_text(encoding="utf-8")
    assert f"{move:.3f} mm" in recipe
    assert f"{move:.3f} − {radius:g} = −{radius - move:.3f} mm" in recipe
