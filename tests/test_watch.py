"""Pairs that a camera writes while `run --watch` looks on: measured as they come, with the files of `run`."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, PartialError
from lfpiv_cli.files import batch
from lfpiv_cli.files.batch import Frame, images_seen
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.verbs import particles
from lfpiv_cli.verbs import run as watching
from lfpiv_cli.verbs.batches import Failure
from lfpiv_cli.verbs.checks import Line, Part
from lfpiv_cli.verbs.contents import Contents, Fields
from lfpiv_cli.verbs.pairs import PairOptions, coming_pairs
from lfpiv_cli.verbs.particles import Sized
from lfpiv_cli.verbs.run import RIG
from lfpiv_cli.verbs.simulate import frame_names
from tests.commands import SAMPLE, sample_rig
from tests.commands import run as lfpiv
from tests.test_batch_shares import Filling
from tests.test_report import REFERENCE, WARNING, record
from tests.test_run import PAIR, PHOTOGRAPHS, rig_in
from tests.test_run_shares import SMALL, data_of
from tests.vector_fields import SHAPE, SIGMA_VOXEL, field_of

HOW = ("--method", "volumes", "--no-report")
# What `run` adds when all pairs have come, and the last pair's picture.
BESIDE = ("run.json", "latest.png", "latest.html", "report.html")


def named(folder: Path, *names: str, whole: bool = True) -> list[Path]:
    """Write images of the sample's pair, first or second by the letter that a name ends in; or halves of them."""
    folder.mkdir(exist_ok=True)
    paths = [folder / f"{name}.tif" for name in names]
    for path in paths:
        content = PAIR[path.stem.endswith("b")].read_bytes()
        path.write_bytes(content if whole else content[: len(content) // 2])
    return paths


def in_order(*names: str) -> list[tuple[str, ...]]:
    """Return the pairs, by name, that are told of frames that come one by one."""
    told: list[tuple[str, ...]] = []
    frames = [[Frame(Path(f"{name}.tif"), 0, 1)] for name in names]
    for pairs in coming_pairs(frames, images_seen, PairOptions(pairing="ab"), Console(quiet=True), []):
        told += [tuple(frame.stem for frame in pair) for pair in pairs]
    return told


def warned_of(*names: str) -> list[str]:
    """Return which frames are passed over, by name, as frames come one by one."""
    console = Console(quiet=True, warned=[])
    frames = [[Frame(Path(f"{name}.tif"), 0, 1)] for name in names]
    left_out: list[Failure] = []
    for _ in coming_pairs(frames, images_seen, PairOptions(pairing="ab"), console, left_out):
        pass
    return [Path(notice.about).stem for notice in console.warned or ()]


def test_pairs_of_running_numbers_begin_as_the_first_two_and_a_lost_one_shifts_nothing() -> None:
    assert in_order("f1", "f2", "f3", "f4") == [("f1", "f2"), ("f3", "f4")]
    assert in_order("f1", "f2", "f4", "f5", "f6") == [("f1", "f2"), ("f5", "f6")]
    assert in_order("f0", "f1", "f3", "f4", "f5") == [("f0", "f1"), ("f4", "f5")]
    # whether 3 is a first is not known: 2 may be its first
    assert in_order("f3", "f4", "f5", "f6") == []


def test_a_frame_is_passed_over_when_a_pair_behind_it_is_there_and_not_while_its_own_is_coming() -> None:
    assert warned_of("f1", "f2", "f3", "f4", "f5") == []
    assert warned_of("1a", "1b", "2a", "3a", "3b", "4a") == ["2a"]
    assert warned_of("f1", "f2", "f4", "f5", "f6") == ["f4"]
    # once, where nothing pairs: names that go on so pair nothing at all
    assert warned_of("f3", "f4", "f5", "f6", "f7") == ["f3"]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return rig_in(tmp_path_factory.mktemp("rig"), *SMALL)


def watch(rig: Path, folder: Path, output: Path, *options: object) -> None:
    lfpiv("run", rig, "--watch", folder, *PHOTOGRAPHS, *HOW, *options, "-o", output)


def results_of(output: Path) -> dict[str, bytes]:
    return {name: data for name, data in data_of(output).items() if name not in BESIDE}


@pytest.mark.thorough
def test_files_are_those_of_run_and_what_is_lost_or_broken_is_told_and_passed_over(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = named(tmp_path / "source", "1a", "1b", "2a", "3a", "3b", "4a", "5a", "5b")
    (broken,) = named(tmp_path / "source", "4b", whole=False)
    plan = dict(zip((1.0, 2.0, 4.0, 6.0, 7.0, 9.0, 30.0, 31.0), source, strict=True)) | {10.0: broken}
    camera = Filling(tmp_path / "images", plan)
    monkeypatch.setattr(batch, "time", camera)
    with pytest.raises(PartialError, match="2 frames or pairs failed") as caught:
        watch(rig, camera.folder, tmp_path / "out", "--idle-s", 20)
    captured = capsys.readouterr()
    lines = [line.split("  ") for line in captured.out.splitlines() if "per microlens" in line and "," not in line]
    assert [line[0] for line in lines] == ["1a", "3a", "5a"]
    pattern = r"0\.\d+ per microlens  \d+ vectors  u 0\.1\d+ ± 0\.\d+  v .*  w .* m/s  (good|look|no)  \d+\.\d s"
    assert re.fullmatch(pattern, "  ".join(lines[0][1:]))
    lost = "2a.tif: the second frame of its pair is missing; it is passed over"
    assert captured.err.count(lost) == 1
    assert captured.err.index(lost) < captured.err.index("3a.vtkhdf")
    assert captured.err.count("4b: cannot be read so far") == 1
    failed = {each["name"].rpartition("/")[2]: each["error"] for each in caught.value.figures["failures"]}
    assert sorted(failed) == ["2a.tif", "4b"]
    # of the good pairs the very bytes, by one command
    good = tmp_path / "good"
    named(good, "1a", "1b", "3a", "3b", "5a", "5b")
    lfpiv("run", rig, good, "--pairing", "ab", *PHOTOGRAPHS, *HOW, "-q", "-o", tmp_path / "one")
    one, watched = results_of(tmp_path / "one"), results_of(tmp_path / "out")
    assert {name: data for name, data in watched.items() if name != "volumes/4a.vtkhdf"} == one
    assert len(one) == 3 + 3 + 6


@pytest.mark.thorough
def test_a_first_pair_that_cannot_be_measured_is_told_and_the_next_one_is(
    rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = named(tmp_path / "source", "1a", "1b", "2a", "2b")
    for path in source[:2]:
        tifffile.imwrite(path, np.arange(30, dtype=np.uint16).reshape(5, 6))
    camera = Filling(tmp_path / "images", dict(zip((1.0, 2.0, 8.0, 9.0), source, strict=True)))
    monkeypatch.setattr(batch, "time", camera)
    with pytest.raises(PartialError, match="1a"):
        watch(rig, camera.folder, tmp_path / "out", "--idle-s", 6)
    lines = [line for line in capsys.readouterr().out.splitlines() if re.match(r"\d[ab]", line)]
    assert re.match(r"1a.tif  failed: .*1[ab].tif: .*6 x 5 pixels", lines[0]), lines
    assert lines[1].startswith("2a  ")


def test_the_verdict_of_a_pair_knows_of_its_vectors_by_both_methods(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    flow = np.zeros((*SHAPE, 3))
    flow[..., 0] = 1.0
    paths = [tmp_path / f"{name}.vtkhdf" for name in ("vectors", "tracks_grid")]
    for path, command in zip(paths, ("correlate", "track"), strict=True):
        made = record(command, *((WARNING,) if command == "correlate" else ()))
        write_vectors(path, field_of(flow, SIGMA_VOXEL), REFERENCE, provenance=made, overwrite=False)
    verdicts: list[str] = []
    known = watching.judged

    def noted(contents: Contents, fields: Fields) -> dict[Part, list[Line]]:
        parts = known(contents, fields)
        verdicts.extend({line.verdict for line in parts["vectors"]})
        return parts

    monkeypatch.setattr(watching, "judged", noted)
    watching.Latest(tmp_path, Console(), draws=False).measured("p1_a", 0.5, paths, paths[1], 2.0)
    assert verdicts == ["good"]
    # 1 mm in 1 ms; of 0.05, 0.02 and 0.4 voxel of 0.1, 0.2 and 0.3 mm
    words = "0.5 per microlens  990 vectors  u 1.0000 ± 0.0050  v 0.0000 ± 0.0040  w 0.00 ± 0.12 m/s  look  2.0 s"
    assert capsys.readouterr().out == f"p1_a  {words}\n"


def begun(rig: Path, folder: Path, output: Path, *options: object) -> subprocess.Popen[str]:
    """Start a command that watches."""
    words = ["run", rig, "--watch", folder, *PHOTOGRAPHS, "--method", "volumes", *options, "-o", output]
    command = [sys.executable, "-m", "lfpiv_cli", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True, env=os.environ)


def lines_until(process: subprocess.Popen[str], name: str) -> list[str]:
    """Return what a command prints, to the line of a pair."""
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if line.startswith(f"{name}  "):
            return lines
    pytest.fail(f"no line of {name}: {lines}")


@pytest.mark.thorough
def test_an_interrupted_watch_keeps_what_is_done_and_goes_on(rig: Path, tmp_path: Path) -> None:
    images, output = tmp_path / "images", tmp_path / "out"
    named(images, "1a")
    process = begun(rig, images, output)
    try:
        # the second image of the first pair in two halves, as it is copied
        named(images, "1b", whole=False)
        time.sleep(1.0)
        named(images, "1b")
        lines_until(process, "1a")
        first = output / "vectors" / "1a.vtkhdf"
        before = first.stat().st_mtime_ns
        until = time.monotonic() + 120.0
        while not (output / "latest.html").exists() and time.monotonic() < until:
            time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        # That a signal is answered within seconds is tested of all commands; here others may keep the processor busy.
        assert process.wait(timeout=20.0) == 130
    finally:
        process.kill()
        process.communicate()
    page = (output / "latest.html").read_text()
    assert '<meta http-equiv="refresh" content="2">' in page
    assert "data:image/png;base64," in page
    assert (output / "latest.png").read_bytes().startswith(b"\x89PNG")
    assert not [path for path in output.rglob("*") if "partial" in path.name or "claim" in path.name]
    named(images, "2a", "2b")
    again = begun(rig, images, output, "--idle-s", 3)
    told, _ = again.communicate(timeout=300.0)
    assert again.returncode == 0, told
    assert not any(line.startswith("1a  ") for line in told.splitlines())
    assert any(line.startswith("2a  ") for line in told.splitlines())
    assert first.stat().st_mtime_ns == before
    steps = json.loads((output / "run.json").read_text())["steps"]
    assert {name: step["state"] for name, step in steps.items() if name != "report"}.keys() >= {"correlate"}
    assert (output / "report.html").exists()


@pytest.mark.thorough
def test_particles_are_those_of_run_and_pairs_wait_until_the_tracers_size_is_known(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    config, images = tmp_path / "rig.yaml", tmp_path / "images"
    config.write_text(RIG.replace("frames: 4", "frames: 6"))
    for what in ("white", "board", "particles"):
        lfpiv("simulate", what, config, "-o", tmp_path, "-q")
    images.mkdir()
    for number, name in enumerate(frame_names(6)):
        shutil.copyfile(tmp_path / name, images / f"p{number // 2}_{'ab'[number % 2]}.tif")
    photographs = [word for name in ("white", "dark", "board") for word in (f"--{name}", tmp_path / f"{name}.tif")]
    how = (*photographs, "--method", "particles", "--no-report")
    lfpiv("run", config, images, "--pairing", "ab", *how, "-q", "-o", tmp_path / "one")
    camera = Filling(tmp_path / "camera", dict(enumerate(sorted(images.iterdir()), start=1)))
    monkeypatch.setattr(batch, "time", camera)
    seen: list[int] = []
    known = particles.size_of

    def uncertain(bench: particles.Bench, frames: Sequence[particles.Frame]) -> Sized:
        looked_at = list(frames)
        seen.append(len(looked_at))
        return known(bench, looked_at)._replace(is_certain=False)

    monkeypatch.setattr(particles, "size_of", uncertain)
    lfpiv("run", config, "--watch", camera.folder, *how, "--idle-s", 9, "-o", tmp_path / "out")
    assert seen == [2, 4, 5]
    assert capsys.readouterr().err.count("waits for the next pair") == 2
    assert results_of(tmp_path / "out") == results_of(tmp_path / "one")


def test_a_watch_without_a_time_between_frames_is_refused_at_once(tmp_path: Path) -> None:
    rig = sample_rig(tmp_path, (", dt_s: 0.002", ""))
    with pytest.raises(ConfigError, match=r"correlation\.dt_s: is missing"):
        watch(rig, SAMPLE, tmp_path / "out")
    assert load_rig(rig).correlation.dt_s is None


@pytest.mark.thorough
def test_images_without_a_pair_are_told_at_the_end(rig: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Filling(tmp_path / "images", dict(enumerate(named(tmp_path / "source", "1a", "2a"), start=1)))
    monkeypatch.setattr(batch, "time", camera)
    with pytest.raises(InputError, match=r"1a.tif: the second frame of its pair is missing"):
        watch(rig, camera.folder, tmp_path / "out", "--idle-s", 5)
