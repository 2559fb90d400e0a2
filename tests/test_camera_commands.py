"""Commands given cameras' own files do what they do with the same frames in TIFF, bit for bit."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import yaml
from click.testing import CliRunner

from lfpiv_cli.cli.main import cli
from lfpiv_cli.cli.options import outcome_of
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.batch import frames_of
from lfpiv_cli.files.provenance import carried_record, even_step_s, seconds_between, sha256
from lfpiv_cli.files.vtkhdf import open_vectors, open_volume
from tests import camera_files

ROWS, COLUMNS = 100, 120
RIG = {
    "camera": {
        "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
        "microlenses": {"pitch_mm": 0.1, "focal_length_mm": 0.8},
        "sensor": {"pixel_um": 5.5, "columns": COLUMNS, "rows": ROWS},
    },
    "media": {"air": 1.0, "window": 1.49, "fluid": 1.33},
    "volume": {"shape_xyz": [8, 8, 4], "voxel_mm": [0.1, 0.1, 0.4]},
}
PACKED = f"{COLUMNS}x{ROWS}x12:packing=low-first"


def run(*arguments: object) -> str:
    """Return what a command prints; raise what it raises."""
    return CliRunner().invoke(cli, [str(each) for each in arguments], catch_exceptions=False).stdout


def fault_of(*arguments: object) -> tuple[str, int]:
    """Return what a command that fails says, and its exit code."""
    error = CliRunner().invoke(cli, [str(each) for each in arguments], standalone_mode=False).exception
    assert error is not None
    return outcome_of(error)


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
    (made / "rig.yaml").write_text(yaml.safe_dump(RIG))
    run("build-weights", made / "rig.yaml", "-o", made / "weights.h5")
    return made


IMAGES = (
    "tiff.tif",
    "cine.cine",
    "packed.cine",
    "seq.seq",
    "mraw.mraw",
    "hdf5.h5:/entry/data/frames",
    "davis.im7",
    "set.set",
)


@pytest.mark.thorough
def test_volumes_are_the_same_from_every_format(folder: Path) -> None:
    paths = [folder / name for name in (*IMAGES, "raw.raw")]
    run("reconstruct", folder / "weights.h5", *paths, "--raw", PACKED, "--iterations", 1, "-o", folder / "volumes")
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
    found = json.loads(run("info", folder / name, "--json"))
    assert (found["format"], found["bits"]) == (kind, bits)
    assert (found["pages"], found["columns"], found["rows"]) == (2, COLUMNS, ROWS)
    assert ("frame_rate_hz" in found) == timed
    if timed:
        assert found["frame_rate_hz"] == pytest.approx(camera_files.RATE_HZ, rel=1e-6)
        assert found["longest_step_s"] == pytest.approx(0.0005, abs=1e-9)


@pytest.mark.thorough
def test_the_recording_tells_the_time_between_frames(folder: Path, tmp_path: Path) -> None:
    def correlated(name: str, *options: object) -> dict[str, Any]:
        run("reconstruct", folder / "weights.h5", folder / name, "--iterations", 1, "-o", tmp_path / name)
        stem = Path(name).stem
        pair = [tmp_path / name / f"{stem}_000{page}.vtkhdf" for page in range(2)]
        output = tmp_path / f"{name}.vtkhdf"
        windows = ("--windows", "4", "--overlap", "0")
        run("correlate", *pair, *windows, *options, "-o", output)
        return {"pair": pair, "record": carried_record(output), "field": open_vectors(output)}

    timed = correlated("cine.cine")
    assert timed["record"]["config"]["correlation"]["dt_s"] == pytest.approx(0.0005, abs=1e-9)
    assert timed["field"].dt_s == pytest.approx(0.0005, abs=1e-9)
    assert correlated("tiff.tif")["field"].dt_s is None
    given = correlated("seq.seq", "--dt-s", 0.25)
    assert given["field"].dt_s == 0.25
    told, code = fault_of("correlate", *reversed(timed["pair"]), "-o", tmp_path / "back.vtkhdf")
    assert "do not increase" in told
    assert code == 4


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
    assert json.loads(run("info", folder / "weights.h5", "--json"))["format"] == "lfpiv-weights"
    (folder / "notes.txt").write_text("notes")
    assert fault_of("info", folder / "notes.txt")[1] == 4
    assert fault_of("info", folder / "tiff.tif", "--picture", folder / "p.png") == (
        "--picture draws a voxel of weights",
        2,
    )


# Copies, cut or wanting something: what is said, and the exit code.
def _cut(path: Path, kept: float) -> None:
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * kept)])


FAULTS: dict[str, tuple[Callable[[Path], None], str, int]] = {
    "cine.cine": (lambda path: _cut(path, 0.9), "cut off or damaged", 4),
    "packed.cine": (lambda path: _cut(path, 0.9), "cut off or damaged", 4),
    "seq.seq": (lambda path: _cut(path, 0.9), "cut off or damaged", 4),
    "mraw.mraw": (lambda path: _cut(path, 1.0), "mraw.cihx or .cih is not beside it", 4),
    "hdf5.h5": (lambda path: _cut(path, 0.9), "hdf5.h5", 4),
    "davis.im7": (lambda path: _cut(path, 0.9), "cut off or damaged", 4),
    "set.set": (lambda path: _cut(path, 1.0), "the folder of its images, set, is not beside it", 4),
    "raw.raw": (lambda path: _cut(path, 1.0), "state its layout with --raw", 2),
}


@pytest.mark.parametrize("name", FAULTS)
def test_commands_refuse_a_cut_recording_by_its_name(folder: Path, tmp_path: Path, name: str) -> None:
    spoil, words, code = FAULTS[name]
    copy = tmp_path / name
    copy.write_bytes((folder / name).read_bytes())
    spoil(copy)
    told, exit_code = fault_of("reconstruct", folder / "weights.h5", copy, "-o", tmp_path / "v.vtkhdf")
    assert name in told
    assert words in told
    assert exit_code == code
    assert not [path for path in tmp_path.rglob("*") if path.is_file() and path.suffix == ".vtkhdf"]


@pytest.mark.thorough
def test_other_commands_take_the_layout(folder: Path, tmp_path: Path) -> None:
    one = f"{folder / 'raw.raw'}:page=0"
    single = tmp_path / "one.tif"
    tifffile.imwrite(single, tifffile.imread(folder / "tiff.tif", key=0), photometric="minisblack")
    expected = json.loads(run("check", folder / "rig.yaml", single, "--dark", single, "--json"))
    found = json.loads(run("check", folder / "rig.yaml", one, "--dark", one, "--raw", PACKED, "--json"))
    assert json.dumps(found).replace(f"raw.raw:{PACKED}:page=0", "one.tif") == json.dumps(expected)
    assert fault_of("check", folder / "rig.yaml", one, "--raw", "12")[1] == 2


@pytest.mark.thorough
def test_a_folder_of_a_camera_holds_its_recordings(folder: Path, tmp_path: Path) -> None:
    for name in ("cine.cine", "mraw.mraw", "mraw.cihx", "weights.h5", "hdf5.h5"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    run("reconstruct", folder / "weights.h5", tmp_path, "--iterations", 1, "-o", tmp_path / "v")
    assert sorted(path.stem for path in (tmp_path / "v").glob("*.vtkhdf")) == [
        "cine_0000",
        "cine_0001",
        "mraw_0000",
        "mraw_0001",
    ]


@pytest.mark.thorough
def test_the_command_itself(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "t.cine"
    copy.write_bytes((folder / "cine.cine").read_bytes()[:-1000])
    done = subprocess.run(
        [sys.executable, "-m", "lfpiv_cli", "info", str(copy)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 4
    assert "t.cine: declares 2 frames" in done.stderr
    assert "Traceback" not in done.stderr
