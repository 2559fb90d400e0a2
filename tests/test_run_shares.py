"""`run` over pairs in parts, in shares, by several workers; and while a camera writes them, with the files of `run`."""

import json
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, PartialError, StoppedEarlyError, UsageError
from lfpiv_cli.files import atomic, batch
from lfpiv_cli.files.batch import Frame, images_seen
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.inputs import Deadline
from lfpiv_cli.verbs import particles, run_steps
from lfpiv_cli.verbs import run as watching
from lfpiv_cli.verbs.checks import Line, Part
from lfpiv_cli.verbs.contents import Contents, Fields
from lfpiv_cli.verbs.pairs import PairOptions, coming_pairs
from lfpiv_cli.verbs.particles import Sized
from lfpiv_cli.verbs.run import RIG
from lfpiv_cli.verbs.simulate import frame_names
from tests.commands import SAMPLE, hear_interrupts, sample_rig
from tests.commands import run as lfpiv
from tests.test_batch_shares import Filling
from tests.test_report import WARNING, put, record
from tests.test_run import PAIR, PHOTOGRAPHS, rig_in
from tests.vector_fields import steady_mm

SMALL = (("shape_xyz: [30, 22, 40]", "shape_xyz: [12, 10, 14]"), ("windows: [24, 12]", "windows: [8]"))


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a small rig, the images of three pairs."""
    folder = tmp_path_factory.mktemp("rig")
    rig_in(folder, *SMALL)
    (folder / "images").mkdir()
    (folder / "in_time").mkdir()
    for number in range(3):
        for letter, source in zip("ab", PAIR, strict=True):
            shutil.copyfile(source, folder / "images" / f"p{number}_{letter}.tif")
        shutil.copyfile(PAIR[number % 2], folder / "in_time" / f"f{number}.tif")
    return folder


def run(rig: Path, output: Path, *options: object, images: str = "images") -> None:
    how = ("--pairing", "ab" if images == "images" else "sequence", "--method", "volumes", "--no-report", "-q")
    lfpiv("run", rig / "rig.yaml", rig / images, *PHOTOGRAPHS, *how, *options, "-o", output)


@pytest.fixture(scope="module")
def whole(rig: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("whole") / "out"
    run(rig, output)
    return output


def data_of(output: Path) -> dict[str, bytes]:
    """Return what is in all files of data, hidden ones too."""
    files = [path for path in output.rglob("*") if path.is_file() and path.suffix != ".json"]
    return {path.relative_to(output).as_posix(): path.read_bytes() for path in sorted(files)}


@pytest.fixture
def with_weights(whole: Path, tmp_path: Path) -> Path:
    """A folder that has the weights, and nothing else yet."""
    output = tmp_path / "out"
    output.mkdir()
    for name in ("calibration.h5", "calibration.png", "weights.h5"):
        shutil.copy2(whole / name, output / name)
    return output


@pytest.mark.thorough
@pytest.mark.parametrize(("order", "keep"), [((3, 1, 2), "all"), ((1, 2, 3, 4, 5), "results")])
def test_shards_together_give_what_one_command_gives(rig, whole, with_weights, order, keep):
    for number in order:
        run(rig, with_weights, "--shard", f"{number}/{len(order)}", "--keep", keep)
        assert not (with_weights / "run.json").exists()
    expected = {name: data for name, data in data_of(whole).items() if keep == "all" or "volumes" not in name}
    assert data_of(with_weights) == expected
    run(rig, with_weights, "--keep", keep)
    reported = json.loads((with_weights / "run.json").read_text())
    assert {step["state"] for step in reported["steps"].values()} == {"kept"}
    assert reported["figures"] == json.loads((whole / "run.json").read_text())["figures"]
    assert data_of(with_weights) == expected


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_workers_give_one_command_s_files(rig: Path, whole: Path, with_weights: Path, in_process: str) -> None:
    run(rig, with_weights, "--dask", in_process, "--keep", "results")
    assert data_of(with_weights) == {name: data for name, data in data_of(whole).items() if "volumes" not in name}
    shutil.rmtree(with_weights / "vectors")
    run(rig, with_weights, "--dask", in_process)
    assert data_of(with_weights) == data_of(whole)
    # frames that wait for those before them, and pairs that come one by one, are not divided
    for words, options in (("frame to frame", ("--follow",)), ("as it comes", ("--watch", "--idle-s", 1))):
        with pytest.raises(UsageError, match=f"--dask: .*{words}"):
            lfpiv("run", rig / "rig.yaml", rig / "images", *PHOTOGRAPHS, "--dask", "local", *options, "-o", rig / "no")


@pytest.mark.thorough
def test_weights_and_volumes_that_another_worker_makes_are_waited_for(
    rig: Path, whole: Path, with_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(atomic, "SECONDS_BETWEEN_LOOKS", 0.05)
    waiting, sleep = threading.Event(), atomic.time.sleep
    monkeypatch.setattr(atomic.time, "sleep", lambda seconds: (waiting.set(), sleep(seconds)))
    weights, shared = with_weights / "weights.h5", with_weights / "volumes" / "f0.vtkhdf"
    moved = weights.rename(with_weights.parent / "weights.h5")
    shared.parent.mkdir()
    for path, options in ((weights, ("--shard", "1/3")), (shared, ("--shard", "1/2", "--keep", "results"))):
        waiting.clear()
        other = atomic.claimed(path)
        assert other.__enter__()
        images = "images" if path == weights else "in_time"
        worker = threading.Thread(target=run, args=(rig, with_weights, *options), kwargs={"images": images})
        worker.start()
        while worker.is_alive() and not waiting.is_set():
            waiting.wait(0.05)
        assert waiting.is_set()
        if path == weights:
            shutil.copy2(moved, weights)
        made = weights.stat().st_ino
        other.__exit__(None, None, None)
        worker.join()
        assert weights.stat().st_ino == made
    assert (with_weights / "vectors" / "f0.vtkhdf").exists()


@pytest.mark.thorough
def test_it_stops_before_its_time_limit_and_goes_on(
    rig: Path, whole: Path, with_weights: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    with monkeypatch.context() as patch:
        # Time for the two steps before, and for two volumes.
        patch.setattr(Deadline, "leaves_time", lambda *_: asked.append(1) is None and len(asked) <= 5)
        with pytest.raises(StoppedEarlyError, match="2 of 6 frames are done"):
            run(rig, with_weights, "--time-limit", "1h")
    assert len(list((with_weights / "volumes").iterdir())) == 2
    with monkeypatch.context() as patch:
        patch.setattr(Deadline, "leaves_time", lambda *_: False)
        with pytest.raises(StoppedEarlyError, match="step 1, calibrate-snapshot: the time limit of 60 s is over"):
            run(rig, with_weights, "--time-limit", "1m")
    run(rig, with_weights, "--time-limit", "1h", "--resume")
    assert data_of(with_weights) == data_of(whole)


def planned(rig: Path, output: Path, capsys: pytest.CaptureFixture[str], *options: object) -> dict[str, Any]:
    """Return what a run says that it would do."""
    capsys.readouterr()
    run(rig, output, "--dry-run", "--json", *options)
    return dict(json.loads(capsys.readouterr().out))


def test_a_dry_run_before_there_is_anything(rig: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    reported = planned(rig, tmp_path / "out", capsys, "--shard", "1/3")
    assert not (tmp_path / "out").exists()
    assert reported["steps_to_make"] == ["calibrate-snapshot", "build-weights"]
    assert (reported["frames"], reported["pairs"], reported["to_make"]) == (2, 1, {"volumes": 2, "vectors": 1})
    assert 0.0 < reported["disk_mb"] < 3.0
    with pytest.raises(UsageError, match="a sequence is followed from frame to frame"):
        lfpiv("run", rig / "rig.yaml", rig / "images", *PHOTOGRAPHS, "--follow", "--shard", "1/2", "-o", tmp_path)


@pytest.mark.thorough
def test_a_dry_run_tells_what_is_left_and_writes_nothing(
    rig: Path, whole: Path, with_weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = ("--log", tmp_path / "log")
    run(rig, with_weights, "--shard", "1/3", *log)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    reported = planned(rig, with_weights, capsys, *log)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    assert (reported["steps_to_make"], reported["method"]) == ([], "volumes")
    assert (reported["to_make"], reported["skipped"]) == ({"volumes": 4, "vectors": 2}, {"volumes": 2, "vectors": 1})
    assert [Path(path).name for path in reported["would_make"][4:]] == ["p1_a.vtkhdf", "p2_a.vtkhdf"]
    written = sum(len(data) for name, data in data_of(whole).items() if name.startswith(("volumes", "vectors")))
    assert reported["disk_mb"] == pytest.approx(written * 2 / 3 / 1e6, rel=0.2)
    assert reported["seconds"] > 0.0
    reported = planned(rig, whole, capsys)
    assert (reported["to_make"], reported["disk_mb"]) == ({"volumes": 0, "vectors": 0}, 0.0)


@pytest.mark.thorough
def test_a_dry_run_without_volumes(rig: Path, with_weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep = ("--keep", "results")
    assert planned(rig, with_weights, capsys, *keep)["to_make"] == {"vectors": 3}
    run(rig, with_weights, "--shard", "2/3", *keep)
    reported = planned(rig, with_weights, capsys, *keep)
    assert (reported["to_make"], reported["skipped"]) == ({"vectors": 2}, {"vectors": 1})
    assert not any((with_weights / "volumes").iterdir())


@pytest.mark.thorough
def test_volumes_that_another_worker_needs_stay(rig: Path, with_weights: Path) -> None:
    keep, shared = ("--keep", "results"), with_weights / "volumes" / "f1.vtkhdf"
    run(rig, with_weights, "--shard", "1/2", *keep, images="in_time")
    assert [path.name for path in shared.parent.iterdir()] == [shared.name]
    before = shared.stat().st_ino
    inode: list[int] = []
    measured = run_steps.Correlation.make

    def make(batch: Any, number: int, work: Any) -> Any:
        inode.append(shared.stat().st_ino)
        return measured(batch, number, work)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(run_steps.Correlation, "make", make)
        run(rig, with_weights, "--shard", "2/2", *keep, images="in_time")
    assert inode == [before]
    assert sorted(path.name for path in (with_weights / "vectors").iterdir()) == ["f0.vtkhdf", "f1.vtkhdf"]
    assert not (with_weights / "volumes").exists()


@pytest.mark.thorough
def test_the_folder_of_volumes_may_go(rig: Path, with_weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create, removed = atomic.create_alone, []

    def created(path: Path) -> int:
        if path.parent.name == "volumes" and not removed:
            path.parent.rmdir()
            removed.append(True)
        return create(path)

    monkeypatch.setattr(atomic, "create_alone", created)
    run(rig, with_weights, "--shard", "1/2", "--keep", "results", images="in_time")
    assert (with_weights / "vectors" / "f0.vtkhdf").exists()


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


def coming(*names: str) -> tuple[list[tuple[str, ...]], list[str]]:
    """Return the pairs, by name, that are told of frames that come one by one, and which of these are passed over."""
    console, reported = Console(quiet=True, warned=[]), []
    frames = [[Frame(Path(f"{name}.tif"), 0, 1)] for name in names]
    for pairs in coming_pairs(frames, images_seen, PairOptions(pairing="ab"), console, []):
        reported += [tuple(frame.stem for frame in pair) for pair in pairs]
    return reported, [Path(notice.about).stem for notice in console.warned or ()]


def test_pairs_of_running_numbers_begin_as_the_first_two_and_a_lost_one_shifts_nothing() -> None:
    assert coming("f1", "f2", "f3", "f4")[0] == [("f1", "f2"), ("f3", "f4")]
    assert coming("f1", "f2", "f4", "f5", "f6")[0] == [("f1", "f2"), ("f5", "f6")]
    assert coming("f0", "f1", "f3", "f4", "f5")[0] == [("f0", "f1"), ("f4", "f5")]
    # whether 3 is a first is not known: 2 may be its first
    assert coming("f3", "f4", "f5", "f6")[0] == []


def test_a_frame_is_passed_over_when_a_pair_behind_it_is_there_and_not_while_its_own_is_coming() -> None:
    assert coming("f1", "f2", "f3", "f4", "f5")[1] == []
    assert coming("1a", "1b", "2a", "3a", "3b", "4a")[1] == ["2a"]
    assert coming("f1", "f2", "f4", "f5", "f6")[1] == ["f4"]
    # once, where nothing pairs: names that go on so pair nothing at all
    assert coming("f3", "f4", "f5", "f6", "f7")[1] == ["f3"]


def watch(config: Path, folder: Path, output: Path, *options: object) -> None:
    lfpiv("run", config, "--watch", folder, *PHOTOGRAPHS, *HOW, *options, "-o", output)


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
        watch(rig / "rig.yaml", camera.folder, tmp_path / "out", "--idle-s", 20)
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
    lfpiv("run", rig / "rig.yaml", good, "--pairing", "ab", *PHOTOGRAPHS, *HOW, "-q", "-o", tmp_path / "one")
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
        watch(rig / "rig.yaml", camera.folder, tmp_path / "out", "--idle-s", 6)
    lines = [line for line in capsys.readouterr().out.splitlines() if re.match(r"\d[ab]", line)]
    assert re.match(r"1a.tif  failed: .*1[ab].tif: .*6 x 5 pixels", lines[0]), lines
    assert lines[1].startswith("2a  ")


def test_the_verdict_of_a_pair_knows_of_its_vectors_by_both_methods(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [tmp_path / f"{name}.vtkhdf" for name in ("vectors", "tracks_grid")]
    for path, made in zip(paths, (record("correlate", WARNING), record("track")), strict=True):
        put(path, steady_mm(), made)
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


def begun(config: Path, folder: Path, output: Path, *options: object) -> subprocess.Popen[str]:
    """Start a command that watches."""
    words = ["run", config, "--watch", folder, *PHOTOGRAPHS, "--method", "volumes", *options, "-o", output]
    command, heard = [sys.executable, "-m", "lfpiv_cli", *map(str, words)], {"stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, stderr=subprocess.DEVNULL, preexec_fn=hear_interrupts, **heard)


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
    process = begun(rig / "rig.yaml", images, output)
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
    again = begun(rig / "rig.yaml", images, output, "--idle-s", 3)
    reported, _ = again.communicate(timeout=300.0)
    assert again.returncode == 0, reported
    assert not any(line.startswith("1a  ") for line in reported.splitlines())
    assert any(line.startswith("2a  ") for line in reported.splitlines())
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
        watch(rig / "rig.yaml", camera.folder, tmp_path / "out", "--idle-s", 5)
