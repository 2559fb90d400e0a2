"""Commands given cameras' own files do what they do with TIFF, bit for bit; and take the time between frames there."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.batch import frames_of
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, open_tracks, read_points, write_points
from lfpiv_cli.files.provenance import carried_record, even_step_s, seconds_between, sha256
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume
from lfpiv_cli.verbs import run as run_stage
from lfpiv_cli.verbs.frames import dt_notices
from lfpiv_cli.verbs.run_steps import RunOptions
from tests import camera_files
from tests.camera_files import STEP_US, write_cine
from tests.commands import CONFIG, ended, run, sample_rig, table2_rig
from tests.test_particle_stage import write_frame

ROWS, COLUMNS = 100, 120
PACKED = f"{COLUMNS}x{ROWS}x12:packing=low-first"


def printed(*arguments: object) -> str:
    """Return what a command prints; raise what it raises."""
    return CliRunner().invoke(cli, [str(each) for each in arguments], catch_exceptions=False).stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames of 12 bits in each format, and weights that read them."""
    made = tmp_path_factory.mktemp("cameras")
    stack = np.random.default_rng(5).integers(0, 4096, (2, ROWS, COLUMNS)).astype(np.uint16)
    tifffile.imwrite(made / "tiff.tif", stack, photometric="minisblack", metadata=None)
    camera_files.write_cine(made / "cine.cine", stack)
    camera_files.write_cine(made / "packed.cine", stack, packed=12)
    camera_files.write_seq(made / "seq.seq", stack)
    camera_files.write_mraw(made / "mraw.mraw", stack, bits=12)
    camera_files.write_stack(made / "hdf5.h5", stack)
    (made / "raw.raw").write_bytes(b"".join(camera_files.bits_low_first(frame, 12) for frame in stack))
    camera_files.write_im7(made / "davis.im7", stack)
    camera_files.write_set(made / "set.set", [stack[:1], stack[1:]])
    (made / "rig.yaml").write_text(
        table2_rig(COLUMNS, ROWS, volume={"shape_xyz": [8, 8, 4], "voxel_mm": [0.1, 0.1, 0.4]})
    )
    printed("build-weights", made / "rig.yaml", "-o", made / "weights.h5")
    return made


IMAGES = ("tiff.tif", "cine.cine", "packed.cine", "seq.seq", "mraw.mraw", "davis.im7", "set.set")
IMAGES += ("hdf5.h5:/entry/data/frames",)


@pytest.mark.thorough
def test_volumes_are_the_same_from_every_format(folder: Path) -> None:
    paths = [folder / name for name in (*IMAGES, "raw.raw")]
    printed("reconstruct", folder / "weights.h5", *paths, "--raw", PACKED, "--iterations", 1, "-o", folder / "volumes")
    for page in range(2):
        expected = open_volume(folder / "volumes" / f"tiff_000{page}.vtkhdf").array
        assert expected.any()
        for name in ("cine", "packed", "seq", "mraw", "hdf5", "davis", "set", "raw"):
            found = open_volume(folder / "volumes" / f"{name}_000{page}.vtkhdf").array
            np.testing.assert_array_equal(found, expected, err_msg=name)
    records = {
        name: [carried_record(folder / "volumes" / f"{name}_000{page}.vtkhdf") for page in range(2)]
        for name in ("tiff", "cine", "hdf5", "raw")
    }
    assert records["raw"][0]["inputs"]["image"]["name"] == f"raw.raw:{PACKED}"
    assert seconds_between(*records["cine"]) == pytest.approx(camera_files.STEP_US / 1e6, abs=1e-9)
    assert seconds_between(*records["hdf5"]) == pytest.approx(camera_files.STEP_US / 1e6)
    assert seconds_between(*records["tiff"]) is None
    assert seconds_between(records["cine"][0], records["hdf5"][1]) is None
    mraw = carried_record(folder / "volumes" / "mraw_0000.vtkhdf")["inputs"]["image"]
    assert mraw["beside"] == {"mraw.cihx": sha256(folder / "mraw.cihx")}
    assert "beside" not in records["tiff"][0]["inputs"]["image"]
    assert "time_s" not in records["tiff"][0]["inputs"]["image"]


FORMATS = {
    "tiff.tif": ("TIFF", 16, False),
    "cine.cine": ("Phantom cine", 12, True),
    "packed.cine": ("Phantom cine", 12, True),
    "seq.seq": ("Norpix seq", 16, True),
    "mraw.mraw": ("Photron mraw", 12, True),
    "hdf5.h5": ("HDF5", 16, True),
    "davis.im7": ("LaVision im7", 16, False),
    "set.set": ("LaVision set", 16, False),
    f"raw.raw:{PACKED}:rate=2000": ("raw", 12, True),
}


@pytest.mark.parametrize("name", FORMATS)
def test_info_tells_pages_size_bits_and_rate(folder: Path, name: str) -> None:
    kind, bits, timed = FORMATS[name]
    found = json.loads(printed("info", folder / name, "--json"))
    assert (found["format"], found["bits"]) == (kind, bits)
    assert (found["pages"], found["columns"], found["rows"]) == (2, COLUMNS, ROWS)
    assert ("frame_rate_hz" in found) == timed
    if timed:
        assert found["frame_rate_hz"] == pytest.approx(camera_files.RATE_HZ, rel=1e-6)
        assert found["longest_step_s"] == pytest.approx(0.0005, abs=1e-9)


@pytest.mark.thorough
def test_the_recording_tells_the_time_between_frames(folder: Path, tmp_path: Path) -> None:
    def correlated(name: str, *options: object) -> dict[str, Any]:
        printed("reconstruct", folder / "weights.h5", folder / name, "--iterations", 1, "-o", tmp_path / name)
        stem = Path(name).stem
        pair = [tmp_path / name / f"{stem}_000{page}.vtkhdf" for page in range(2)]
        output = tmp_path / f"{name}.vtkhdf"
        windows = ("--windows", "4", "--overlap", "0")
        printed("correlate", *pair, *windows, *options, "-o", output)
        return {"pair": pair, "record": carried_record(output), "field": open_vectors(output)}

    timed = correlated("cine.cine")
    assert timed["record"]["config"]["correlation"]["dt_s"] == pytest.approx(0.0005, abs=1e-9)
    assert timed["field"].dt_s == pytest.approx(0.0005, abs=1e-9)
    assert correlated("tiff.tif")["field"].dt_s is None
    given = correlated("seq.seq", "--dt-s", 0.25)
    assert given["field"].dt_s == 0.25
    code, said = ended("correlate", *reversed(timed["pair"]), "-o", tmp_path / "back.vtkhdf")
    assert (code, "do not increase" in said) == (4, True)


def test_steps_between_frames_are_even_or_refused(tmp_path: Path) -> None:
    def steps(*times: float | None) -> list[float | None]:
        records = [{"inputs": {"image": {"sha256": "0", "time_s": time}}} for time in times]
        return [seconds_between(*pair) for pair in pairwise(records)]

    names = ["a", "b", "c"]
    assert even_step_s(steps(0.0, 0.1, 0.201), names) == pytest.approx(0.1005)
    assert even_step_s(steps(0.0, 0.1, None), names) is None
    with pytest.raises(InputError, match=r"a to c: .* are 0\.1 to 0\.2 s apart.*--dt-s"):
        even_step_s(steps(0.0, 0.1, 0.3), names)
    camera_files.write_cine(tmp_path / "t.cine", np.zeros((3, 2, 4), np.uint8))
    first, second, third = frames_of([tmp_path / "t.cine"])
    assert even_step_s([first.seconds_to(second), second.seconds_to(third)], names) == pytest.approx(0.0005, abs=1e-9)
    assert even_step_s([], names) is None


def test_info_still_tells_of_results_and_of_nothing_else(folder: Path) -> None:
    assert json.loads(printed("info", folder / "weights.h5", "--json"))["format"] == "lfpiv-weights"
    (folder / "notes.txt").write_text("notes")
    assert ended("info", folder / "notes.txt")[0] == 4
    drawn = ended("info", folder / "tiff.tif", "--picture", folder / "p.png")
    assert drawn == (2, "--picture draws a voxel of weights")


@pytest.mark.parametrize(
    ("name", "kept", "words", "code"),
    [
        ("cine.cine", 0.9, "cut off or damaged", 4),
        ("set.set", 1.0, "the folder of its images, set, is not beside it", 4),
        ("raw.raw", 1.0, "state its layout with --raw", 2),
    ],
)
def test_commands_refuse_a_recording_by_its_name(
    folder: Path, tmp_path: Path, name: str, kept: float, words: str, code: int
) -> None:
    whole = (folder / name).read_bytes()
    (tmp_path / name).write_bytes(whole[: int(len(whole) * kept)])
    found, said = ended("reconstruct", folder / "weights.h5", tmp_path / name, "-o", tmp_path / "v.vtkhdf")
    assert (found, name in said, words in said, (tmp_path / "v.vtkhdf").exists()) == (code, True, True, False), said


@pytest.mark.thorough
def test_other_commands_take_the_layout_and_folders_hold_recordings(folder: Path, tmp_path: Path) -> None:
    one = f"{folder / 'raw.raw'}:page=0"
    single = tmp_path / "one.tif"
    tifffile.imwrite(single, tifffile.imread(folder / "tiff.tif", key=0), photometric="minisblack")
    expected = json.loads(printed("check", folder / "rig.yaml", single, "--dark", single, "--json"))
    found = json.loads(printed("check", folder / "rig.yaml", one, "--dark", one, "--raw", PACKED, "--json"))
    assert json.dumps(found).replace(f"raw.raw:{PACKED}:page=0", "one.tif") == json.dumps(expected)
    assert ended("check", folder / "rig.yaml", one, "--raw", "12")[0] == 2
    # A camera's folder holds its recordings.
    (tmp_path / "run").mkdir()
    for name in ("cine.cine", "mraw.mraw", "mraw.cihx", "weights.h5", "hdf5.h5"):
        (tmp_path / "run" / name).write_bytes((folder / name).read_bytes())
    printed("reconstruct", folder / "weights.h5", tmp_path / "run", "--iterations", 1, "-o", tmp_path / "v")
    made = ["cine_0000", "cine_0001", "mraw_0000", "mraw_0001"]
    assert sorted(path.stem for path in (tmp_path / "v").glob("*.vtkhdf")) == made


def made(time_s: float | None, digest: str = "x") -> dict[str, Any]:
    timed = {} if time_s is None else {"time_s": time_s}
    return {"inputs": {"image": {"name": "run.cine", "sha256": digest} | timed}}


def test_frames_of_a_recording_tell_their_time(tmp_path: Path) -> None:
    write_cine(tmp_path / "run.cine", np.arange(24, dtype=np.uint16).reshape(4, 2, 3))
    frames, dt_s = frames_of([tmp_path / "run.cine"]), STEP_US * 1e-6

    def frames_dt_notices(stated_s, frames):
        return dt_notices(stated_s, [one.seconds_to(other) for one, other in pairwise(frames)], "run.cine")

    for stated, codes in ((dt_s, []), (1.005 * dt_s, []), (1.02 * dt_s, ["time-between-frames"]), (None, [])):
        assert [notice.code for notice in frames_dt_notices(stated, frames)] == codes
    # One that was dropped is found among the others.
    (notice,) = frames_dt_notices(dt_s, [*frames[:2], frames[3]])
    assert notice.measured == pytest.approx(2.0 * dt_s, rel=1e-6)
    assert not frames_dt_notices(2.0 * dt_s, [frames[0], replace(frames[1], fault="lost")])


@pytest.fixture
def pair(tmp_path: Path, rng: np.random.Generator) -> list[Path]:
    """Particles of two frames that were recorded 4 ms apart, and whose config has no time."""
    start = rng.uniform((-1.5, -1.1, -2.0), (1.5, 1.1, 2.0), (40, 3))
    paths = [tmp_path / "a.vtkhdf", tmp_path / "b.vtkhdf"]
    resolved = load_rig(CONFIG).resolved()
    for k, path in enumerate(paths):
        write_frame(path, start + 0.1 * k, correlation=resolved["correlation"] | {"dt_s": None})
        points = read_points(path, PARTICLES_FORMAT)
        provenance = points.provenance | made(0.25 + 0.004 * k)
        write_points(path, PARTICLES_FORMAT, replace(points, provenance=provenance), overwrite=True)
    return paths


def test_track_takes_the_recorded_time(pair: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("track", *pair, "--grid", "-o", tmp_path / "tracks.vtkhdf")
    tracks = open_tracks(tmp_path / "tracks.vtkhdf")
    np.testing.assert_allclose(tracks.arrays["velocity"], 0.025)
    assert open_vectors(tmp_path / "tracks_grid.vtkhdf").dt_s == pytest.approx(0.004)
    capsys.readouterr()
    run("track", *pair, "--dt-s", 0.00401, "-o", tmp_path / "near.vtkhdf", "--json")
    assert "time-between-frames" not in capsys.readouterr().out
    run("track", *pair, "--dt-s", 0.002, "-o", tmp_path / "stated.vtkhdf", "--json")
    (warning,) = json.loads(capsys.readouterr().out)["warnings"]
    assert (warning["code"], warning["expected"]) == ("time-between-frames", "0.002")
    assert warning["measured"] == pytest.approx(0.004)
    np.testing.assert_allclose(open_tracks(tmp_path / "stated.vtkhdf").arrays["velocity"], 0.05)
    points = read_points(pair[1], PARTICLES_FORMAT)
    unknown = points.provenance | made(None)
    write_points(pair[1], PARTICLES_FORMAT, replace(points, provenance=unknown), overwrite=True)
    with pytest.raises(InputError, match="--dt-s"):
        run("track", *pair, "-o", tmp_path / "none.vtkhdf")


def test_run_needs_no_time_where_the_images_tell_it(tmp_path: Path) -> None:
    settings = sample_rig(tmp_path, (", dt_s: 0.002", ""), ("columns: 600, rows: 448", "columns: 60, rows: 45"))
    stack = np.random.default_rng(1).integers(0, 4000, (4, 45, 60)).astype(np.uint16)
    write_cine(tmp_path / "run.cine", stack)
    options = RunOptions(images=[tmp_path / "run.cine"], white=[tmp_path / "run.cine"], report=False, pairing="ab")
    _, pairs = run_stage._ensure_possible(load_rig(settings), options)
    assert pairs.pairs == ((0, 1), (2, 3))
    followed = run_stage._ensure_possible(load_rig(settings), replace(options, follow=True))[1]
    assert followed.pairs == ((0, 1), (1, 2), (2, 3))
    tifffile.imwrite(tmp_path / "run.tif", stack, photometric="minisblack")
    with pytest.raises(ConfigError, match="dt_s: is missing"):
        run_stage._ensure_possible(load_rig(settings), replace(options, images=[tmp_path / "run.tif"]))
