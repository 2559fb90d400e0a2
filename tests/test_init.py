"""A configuration to begin with: what it is made from, that it holds, and its schema."""

import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
import yaml
from click.testing import CliRunner, Result

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import ConfigError, OutputExistsError, UsageError
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.grid import Grid
from lfpiv_cli.validation import planning
from lfpiv_cli.validation.planning import half_view_mm
from lfpiv_cli.verbs.build_weights import plan_of
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.verbs.init import LATTICES, SCHEMA_NAME, InitOptions, RigNumbers, init, rig_text, schema, tree_of
from lfpiv_cli.verbs.planning import bench_of, windows_line
from lfpiv_cli.weights.columns import seen_share
from tests.commands import ROOT

CONFIGS = sorted((ROOT / "configs").glob("*.yaml"))
OWN = RigNumbers(magnification=-0.5, pitch_mm=0.125, columns=3000, rows=2000)
RIGS = {
    "table 2": RigNumbers(),
    "own": OWN,
    "a third of its sensor": RigNumbers(magnification=-0.5, pitch_mm=0.125, columns=1000, rows=668),
    "channel": RigNumbers(channel_mm=10.0, wall_mm=5.0),
    "air": RigNumbers(fluid=1.0),
    "small sensor, large lenses": RigNumbers(magnification=-2.0, pitch_mm=0.2, pixel_um=10.0, columns=640, rows=480),
}


def typed(answers: str, *arguments: str) -> Result:
    return CliRunner().invoke(cli, ["init", *arguments], input=answers)


@pytest.mark.parametrize("numbers", RIGS.values(), ids=RIGS)
def test_a_rig_of_few_numbers_has_no_contradictions_and_sees_its_volume(numbers: RigNumbers, tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    init(path, InitOptions(numbers=numbers))
    settings = load_rig(path)
    assert settings.resolved() == Config.from_resolved(tree_of(numbers)).resolved()
    if numbers.channel_mm is None:
        assert plan_of(settings, None).notices == []
    camera = settings.camera_model()
    assert camera.lens_image_width == pytest.approx(1.0, abs=0.01)
    board, view = settings.board, 2.0 * half_view_mm(camera, settings.media_model(), [0.0])[0]
    assert board.dots is not None
    assert min(board.dots) >= 4
    assert all((count - 1) * board.spacing_mm < 0.9 * side for count, side in zip(board.dots, view, strict=True))
    grid = settings.grid()
    half = half_view_mm(camera, settings.media_model(), grid.bounds_mm(2)).min(axis=0)
    assert all(grid.bounds_mm(axis)[1] <= half[axis] for axis in (0, 1))


@pytest.mark.parametrize("numbers", [*RIGS.values(), RigNumbers(channel_mm=3.0)], ids=[*RIGS, "shallow channel"])
def test_windows_give_ten_vectors_along_each_axis_where_tracers_allow_it(
    numbers: RigNumbers, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "rig.yaml"
    init(path, InitOptions(numbers=numbers))
    bench = bench_of(load_rig(path), None)
    window, vectors = np.array(bench.settings.correlation.window_mm), np.array(bench.window_layout.count)
    tracers = bench.settings.simulation.particles * np.prod(window / bench.sides_mm)
    # Windows are written in three digits, and rounded down.
    assert tracers >= 0.97 * planning.TRACERS_AIMED_AT
    few = [axis for axis in range(3) if vectors[axis] < 10]
    shallow = few == [2] and window[2] <= 1.001 * bench.scale.depth_mm
    assert not few or shallow or tracers <= planning.TRACERS_AIMED_AT
    reported, line = capsys.readouterr().err, windows_line(bench)
    assert line.verdict == ("look" if few else "good")
    assert ("tracers allow fewer than 10 along" in reported) == bool(few)
    assert "set correlation.window_mm" not in line.reason


def test_full_view_is_what_the_weights_see() -> None:
    settings = Config.from_resolved(tree_of(RigNumbers(columns=600, rows=448, size_mm=(1.0, 1.0, 8.0))))
    camera, media = settings.camera_model(), settings.media_model()
    for z in (-4.0, 4.0):
        # Points at the rims of full view and of any view, and in the middle between them.
        for rim, expected in ((-1.0, 1.0), (0.0, 0.5), (1.0, 0.0)):
            half = half_view_mm(camera, media, [z], rim)[0]
            grid = Grid.centred((1, 1, 1), (0.01, 0.01, 0.01), (float(half[0]), 0.0, z))
            share, _ = seen_share(camera, settings.object_space(), grid)
            # A lens's cell is square, and a part of the light in its corners.
            assert share == pytest.approx(expected, abs=0.03)


def test_answers_that_cannot_be_are_asked_again_and_a_magnification_is_negative(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    for answer, expected in (("-0.5", -0.5), ("0.5", -0.5), ("0\n2", -2.0)):
        done = typed(answer + 15 * "\n", str(path), "--overwrite")
        assert done.exit_code == 0, done.output
        assert load_rig(path).sections.camera.main_lens.magnification == expected
    for answer in ("105 furlongs", "0 mm", "mm", "-5 cm", "1e400 m"):
        done = typed(f"\n{answer}\n10.5 cm\n" + 15 * "\n", str(path), "--overwrite")
        assert done.exit_code == 0, done.output
        assert "expected a number above 0" in done.stderr or "is no number" in done.stderr
        assert load_rig(path).sections.camera.main_lens.focal_length_mm == 105.0
    done = typed(8 * "\n" + "448\n1.4\n" + 9 * "\n", str(path), "--overwrite")
    assert "448: expected a refractive index, from 1 to 5" in done.stderr
    assert load_rig(path).sections.media.fluid == 1.4
    done = typed("\n\n", str(path), "--overwrite")
    assert "the answers end before all is asked; --camera" in str(done.exception)


# Magnification, focal length, pitch, microlenses, aperture, pixels, columns, rows, fluid, wall, its thickness, channel,
# volume and velocity, in other units and as plain numbers.
SPELLED = {
    "no units": "-0.7 105 0.125 1 18.75 5.5 3000 2000 1.33 1.49 5 12 10,10,12 0.2 633",
    "millimetres": "0.7|105 mm|0.125mm|1 mm|18.75 mm|0.0055 mm|3000|2000|"
    "1.33|1.49|5 mm|12 mm|10 x 10 x 12 mm|0.2 m/s|633 nm",
    "others": "-0.7|10.5 cm|125 um|0.1 cm|1.875cm|5.5 µm|3000|2000|"
    "1.33|1.49|.005 m|1.2 cm|1 cm, 10 mm 12 mm|20 cm/s|.633 µm",
}


@pytest.mark.parametrize("spelled", SPELLED)
def test_lengths_are_understood_with_their_units_and_a_turned_sign_is_said(spelled: str, tmp_path: Path) -> None:
    path, words = tmp_path / "rig.yaml", SPELLED[spelled]
    done = typed("\n".join(words.split("|") if "|" in words else words.split()) + "\n", str(path))
    assert done.exit_code == 0, done.output
    reported = yaml.safe_load(path.read_text())
    main_lens = {"magnification": -0.7, "focal_length_mm": 105.0, "f_number": 105.0 / 18.75}
    assert reported["camera"]["main_lens"] == main_lens
    assert reported["camera"]["microlenses"] == {"focal_length_mm": 1.0, "pitch_mm": 0.125}
    assert reported["camera"]["sensor"]["pixel_um"] == 5.5
    assert reported["channel"] == {"width_mm": 12.0, "wall_mm": 5.0}
    assert reported["volume"]["size_mm"] == [10.0, 10.0, 12.0]
    assert reported["simulation"]["flow"]["velocity_m_s"] == [0.2, 0.0, 0.0]
    # Five voxels, a third of a microlens wide each, at 0.2 m/s.
    assert reported["correlation"]["dt_s"] == pytest.approx(5 * 0.125 / 0.7 / 3 / 200, rel=5e-3)
    # Simulated and fitted by the same light.
    assert reported["reconstruction"]["wavelength_nm"] == reported["simulation"]["light"]["wavelength_nm"] == 633.0
    assert ("magnification: taken as -0.7, because the image is inverted" in done.stderr) == (words[0] != "-")


def test_nothing_is_asked_before_an_existing_file_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.yaml"
    path.write_text("mine")
    done = typed("", str(path))
    assert isinstance(done.exception, OutputExistsError)
    assert "magnification" not in done.output
    with pytest.raises(OutputExistsError):
        init(path, InitOptions(camera="table2"))
    assert path.read_text() == "mine"


def test_cameras_are_those_of_the_configs(tmp_path: Path) -> None:
    def written(name: Any) -> tuple[Config, Config]:
        init(tmp_path / f"{name}.yaml", InitOptions(camera=name))
        return load_rig(tmp_path / f"{name}.yaml"), load_rig(ROOT / "configs" / f"{name}.yaml")

    for name in LATTICES:
        ours, shipped = written(name)
        assert ours.resolved() == shipped.resolved()
    ours, papers = written("table2")
    first, second = ours.camera_model(), papers.camera_model()
    for name in ("magnification", "focal_length_mm", "aperture_mm", "microlens_distance_mm", "pixel_mm", "columns"):
        assert getattr(first, name) == getattr(second, name)
    assert ours.media == papers.media
    assert [ours.grid().bounds_mm(k) for k in range(3)] == [pytest.approx(papers.grid().bounds_mm(k)) for k in range(3)]


@pytest.mark.thorough
def test_what_a_calibration_was_made_with_is_written_again(tmp_path: Path) -> None:
    sample, data = ROOT / "configs" / "sample.yaml", ROOT / "sample_data"
    made = tmp_path / "calibration.h5"
    calibrate_snapshot(sample, made, CalibrateOptions(white=[data / "white.tif"], dark=data / "dark.tif"))
    init(tmp_path / "rig.yaml", InitOptions(calibration=made))
    assert load_rig(tmp_path / "rig.yaml").resolved() == load_rig(sample).resolved()


def test_one_source_is_needed_and_a_volume_that_the_sensor_sees(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="2 of them"):
        init(tmp_path / "rig.yaml", InitOptions(camera="guv", numbers=RigNumbers()))
    with pytest.raises(UsageError, match="one file"):
        raise typed("", "a.yaml", "-o", "b.yaml").exception
    with pytest.raises(ConfigError, match="sees no point"):
        tree_of(RigNumbers(columns=40, rows=40, channel_mm=20.0))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_configs_follow_the_schema(path: Path) -> None:
    # As editors read it: lists, and numbers where the schema says so.
    tree = yaml.safe_load(path.read_text())
    # PyYAML takes 1e-3 without a dot for a string, which the program's reader and editors do not.
    jsonschema.Draft202012Validator(schema()).validate(json.loads(json.dumps(tree)))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("camera", "sensor", "pixels_um"), 5.5),
        (("camera", "main_lens", "magnification"), 1.0),
        (("volume", "voxel_mm"), [0.1, 0.1]),
        (("correlation", "windows"), [32, "16"]),
        (("weights", "method"), "art"),
    ],
)
def test_the_schema_refuses_what_the_program_refuses(path: tuple[str, ...], value: Any) -> None:
    tree = yaml.safe_load((ROOT / "configs" / "table2.yaml").read_text())
    place = tree
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    assert not jsonschema.Draft202012Validator(schema()).is_valid(tree)


def test_a_rig_names_the_schema_that_lies_beside_it(tmp_path: Path) -> None:
    init(tmp_path / "before.yaml", InitOptions(camera="guv"))
    assert typed("", "--schema", "-o", str(tmp_path / SCHEMA_NAME)).exit_code == 0
    init(tmp_path / "after.yaml", InitOptions(camera="guv"))
    line = f"# yaml-language-server: $schema={SCHEMA_NAME}"
    assert line not in (tmp_path / "before.yaml").read_text()
    assert (tmp_path / "after.yaml").read_text().splitlines()[0] == line
    jsonschema.Draft202012Validator.check_schema(json.loads((tmp_path / SCHEMA_NAME).read_text()))


def test_text_says_what_was_given() -> None:
    tree = {"camera": {"sensor": {"pixel_um": 1e-05, "rows": 3}}, "x": {"a": [1, 2.5], "b": None, "c": True}}
    assert "pixel_um: 1e-05" in rig_text(tree, "title")
    tree["camera"]["sensor"]["pixel_um"] = 0.25
    assert yaml.safe_load(rig_text(tree, "title")) == tree
    assert np.all([len(line) < 121 for line in rig_text(tree_of(OWN), "title").splitlines()])
