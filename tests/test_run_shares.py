"""`run` over pairs in parts: shards, a time limit, a dry run, several workers in one folder."""

import json
import shutil
import threading
from pathlib import Path
from typing import Any

import pytest

from lfpiv_cli.errors import StoppedEarlyError, UsageError
from lfpiv_cli.files import atomic
from lfpiv_cli.files.inputs import Deadline
from lfpiv_cli.verbs import run_steps
from tests.commands import run as lfpiv
from tests.test_run import PAIR, PHOTOGRAPHS, rig_in

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
    told = json.loads((with_weights / "run.json").read_text())
    assert {step["state"] for step in told["steps"].values()} == {"kept"}
    assert told["figures"] == json.loads((whole / "run.json").read_text())["figures"]
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
    told = planned(rig, tmp_path / "out", capsys, "--shard", "1/3")
    assert not (tmp_path / "out").exists()
    assert told["steps_to_make"] == ["calibrate-snapshot", "build-weights"]
    assert (told["frames"], told["pairs"], told["to_make"]) == (2, 1, {"volumes": 2, "vectors": 1})
    assert 0.0 < told["disk_mb"] < 3.0
    with pytest.raises(UsageError, match="a sequence is followed from frame to frame"):
        lfpiv("run", rig / "rig.yaml", rig / "images", *PHOTOGRAPHS, "--follow", "--shard", "1/2", "-o", tmp_path)


@pytest.mark.thorough
def test_a_dry_run_tells_what_is_left_and_writes_nothing(
    rig: Path, whole: Path, with_weights: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = ("--log", tmp_path / "log")
    run(rig, with_weights, "--shard", "1/3", *log)
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    told = planned(rig, with_weights, capsys, *log)
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before
    assert (told["steps_to_make"], told["method"]) == ([], "volumes")
    assert (told["to_make"], told["skipped"]) == ({"volumes": 4, "vectors": 2}, {"volumes": 2, "vectors": 1})
    assert [Path(path).name for path in told["would_make"][4:]] == ["p1_a.vtkhdf", "p2_a.vtkhdf"]
    written = sum(len(data) for name, data in data_of(whole).items() if name.startswith(("volumes", "vectors")))
    assert told["disk_mb"] == pytest.approx(written * 2 / 3 / 1e6, rel=0.2)
    assert told["seconds"] > 0.0
    told = planned(rig, whole, capsys)
    assert (told["to_make"], told["disk_mb"]) == ({"volumes": 0, "vectors": 0}, 0.0)


@pytest.mark.thorough
def test_a_dry_run_without_volumes(rig: Path, with_weights: Path, capsys: pytest.CaptureFixture[str]) -> None:
    keep = ("--keep", "results")
    assert planned(rig, with_weights, capsys, *keep)["to_make"] == {"vectors": 3}
    run(rig, with_weights, "--shard", "2/3", *keep)
    told = planned(rig, with_weights, capsys, *keep)
    assert (told["to_make"], told["skipped"]) == ({"vectors": 2}, {"vectors": 1})
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
