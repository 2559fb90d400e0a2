"""Batches through the real commands: what is skipped, fails, is listed, is shared by two workers; and dry runs."""

import json
import os
import shlex
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import InputError, OutputExistsError, PartialError, UsageError
from lfpiv_cli.files import atomic
from lfpiv_cli.files.atomic import DEAD_AFTER_S, EventLog, claimed, ignores_case
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, read_points
from lfpiv_cli.files.vtkhdf import open_volume
from tests.commands import CONFIG, ROOT, SAMPLE, run, summary_of

QUICK = ("--iterations", 1, "--dark", SAMPLE / "dark.tif")


def stamps(folder: Path) -> dict[str, tuple[int, bytes]]:
    """Return when each file of a folder was written, and what is in it."""
    return {path.name: (path.stat().st_mtime_ns, path.read_bytes()) for path in folder.iterdir()}


def spoil(path: Path, kind: str) -> None:
    """Make a frame that cannot be read."""
    content = path.read_bytes()
    if kind == "missing":
        path.unlink()
    elif kind == "size":
        tifffile.imwrite(path, np.ones((20, 30), np.uint16))
    else:
        path.write_bytes({"empty": b"", "cut": content[: len(content) // 2], "no image": b"no image at all"}[kind])


@pytest.mark.thorough
def test_a_finished_batch_is_skipped_and_stays_as_it_is(weights, images, tmp_path, capsys) -> None:
    command = ("reconstruct", weights, *images, *QUICK, "-o", tmp_path / "out")
    assert summary_of(capsys, *command)["reconstructed"] == 3
    before = stamps(tmp_path / "out")
    assert sorted(before) == ["f0.vtkhdf", "f1.vtkhdf", "f2.vtkhdf"]
    with pytest.raises(OutputExistsError):
        run(*command)
    again = summary_of(capsys, *command, "--resume")
    assert (again["reconstructed"], again["skipped"]) == (0, 3)
    with pytest.raises(OutputExistsError, match="other inputs or settings"):
        run(*command, "--resume", "--iterations", 3)
    assert stamps(tmp_path / "out") == before


@pytest.mark.thorough
def test_a_damaged_result_is_made_anew(weights, images, tmp_path, capsys) -> None:
    command = ("reconstruct", weights, *images[:2], *QUICK, "-o", tmp_path / "out")
    run(*command)
    before, damaged = stamps(tmp_path / "out"), tmp_path / "out" / "f1.vtkhdf"
    with h5py.File(damaged) as file:
        data = file["intensity"].id.get_chunk_info(0).byte_offset
    # Its first bytes, its record, its data, and its end.
    for at in (9, before["f1.vtkhdf"][1].index(b'"command"'), data, None):
        content = bytearray(before["f1.vtkhdf"][1])
        if at is None:
            del content[-100:]
        else:
            content[at] ^= 0x10
        damaged.write_bytes(content)
        summary = summary_of(capsys, *command, "--resume")
        assert (summary["reconstructed"], summary["skipped"]) == (1, 1)
        after = stamps(tmp_path / "out")
        assert after["f0.vtkhdf"] == before["f0.vtkhdf"]
        assert after["f1.vtkhdf"][1] == before["f1.vtkhdf"][1]


@pytest.mark.parametrize("whose", ["ours", "another program's"])
def test_what_somebody_else_put_there_is_not_replaced(weights, images, pairs, tmp_path, whose) -> None:
    (tmp_path / "out").mkdir()
    there = tmp_path / "out" / "f1.vtkhdf"
    if whose == "ours":
        there.write_bytes(pairs[0].read_bytes())
    else:
        with h5py.File(there, "w") as file:
            file["names"] = ["a", "b"]
    before = there.read_bytes()
    with pytest.raises(OutputExistsError, match=r"f1.vtkhdf: exists and was made from other inputs"):
        run("reconstruct", weights, *images, *QUICK, "-o", tmp_path / "out", "--resume")
    assert there.read_bytes() == before


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["missing", "empty", "cut", "size", "no image"])
def test_one_bad_frame_stops_the_batch_or_is_listed(weights, images, tmp_path, capsys, kind) -> None:
    spoil(images[1], kind)
    command = ("reconstruct", weights, *images, *QUICK, "-o")
    with pytest.raises(InputError, match=r"f1\.tif: "):
        run(*command, tmp_path / "stop")
    listed, go = tmp_path / "failed.json", tmp_path / "go"
    with pytest.raises(PartialError, match=r"1 of 3 frames failed, the first because .*f1\.tif: "):
        run(*command, go, "--keep-going", "--failures", listed)
    (failed,) = json.loads(listed.read_text())
    assert failed["name"] == "f1"
    assert "f1.tif: " in failed["error"]
    before = stamps(go)
    assert sorted(before) == ["f0.vtkhdf", "f2.vtkhdf"]
    # the same again: what is there stays as it is, and the frame is listed again
    listed.unlink()
    with pytest.raises(PartialError) as error:
        run(*command, go, "--keep-going", "--resume", "--failures", listed)
    assert stamps(go) == before
    assert error.value.figures["skipped"] == 2
    assert error.value.figures["failures"] == json.loads(listed.read_text()) == [failed]


@pytest.mark.thorough
def test_what_was_written_before_a_bad_page_is_said(weights, raw, tmp_path, capsys) -> None:
    with tifffile.TiffWriter(tmp_path / "run.tif") as writer:
        for number in range(3):
            writer.write(raw + np.uint16(number), compression="zlib", metadata=None)
    with tifffile.TiffFile(tmp_path / "run.tif") as tiff:
        last, length = tiff.pages[2].dataoffsets[-1], tiff.pages[2].databytecounts[-1]
    content = bytearray((tmp_path / "run.tif").read_bytes())
    content[last : last + length] = bytes(length)
    (tmp_path / "run.tif").write_bytes(content)
    command = ("reconstruct", weights, tmp_path / "run.tif", *QUICK, "-o")
    with pytest.raises(InputError, match="2 of 3 frames were written before: run_0000 to run_0001"):
        run(*command, tmp_path / "stop")
    assert sorted(stamps(tmp_path / "stop")) == ["run_0000.vtkhdf", "run_0001.vtkhdf"]
    with pytest.raises(PartialError, match="1 of 3"):
        run(*command, tmp_path / "go", "--keep-going")
    assert stamps(tmp_path / "go").keys() == stamps(tmp_path / "stop").keys()


@pytest.mark.thorough
@pytest.mark.parametrize("kind", ["empty", "cut"])
def test_a_bad_frame_is_left_out_of_the_background_of_others(weights, images, raw, tmp_path, kind) -> None:
    spoil(images[1], kind)
    output = ("--background", "minimum", "--iterations", 1, "-o", tmp_path / "out", "--keep-going")
    with pytest.raises(PartialError):
        run("reconstruct", weights, *images, *output)
    run("reconstruct", weights, images[0], images[2], *output[:-2], tmp_path / "two")
    for name in ("f0", "f2"):
        found, expected = (open_volume(tmp_path / folder / f"{name}.vtkhdf") for folder in ("out", "two"))
        np.testing.assert_array_equal(found.array, expected.array)


@pytest.mark.thorough
def test_a_finished_mean_is_kept(pairs, tmp_path, capsys) -> None:
    mean = tmp_path / "mean.vtkhdf"
    command = ("correlate", *pairs, "--pairing", "ab", "--windows", 8, "--mean", mean, "-o", tmp_path / "out")
    assert summary_of(capsys, *command)["skipped"] == 0
    before, at = stamps(tmp_path / "out"), mean.stat().st_mtime_ns
    assert summary_of(capsys, *command, "--resume")["skipped"] == 2
    assert (stamps(tmp_path / "out"), mean.stat().st_mtime_ns) == (before, at)
    # a damaged field is made again as it was, and the mean of the same fields stays
    (tmp_path / "out" / "a1.vtkhdf").write_bytes(before["a1.vtkhdf"][1][:-9])
    assert summary_of(capsys, *command, "--resume")["skipped"] == 1
    assert mean.stat().st_mtime_ns == at
    third = [path.with_name(f"{name}2.vtkhdf") for name, path in zip("ab", pairs, strict=False)]
    for path, other in zip(third, pairs, strict=False):
        path.write_bytes(other.read_bytes())
    with pytest.raises(OutputExistsError, match=r"mean.vtkhdf: exists and was made from other inputs"):
        run("correlate", *pairs, *third, *command[5:], "--resume")


def test_a_bad_volume_is_listed(pairs, tmp_path, capsys) -> None:
    bad = tmp_path / "b1.vtkhdf"
    bad.write_bytes(pairs[3].read_bytes()[:-300])
    command = ("correlate", *pairs[:3], bad, "--pairing", "ab", "--windows", 8, "-o")
    with pytest.raises(InputError, match="b1.vtkhdf"):
        run(*command, tmp_path / "stop")
    assert not (tmp_path / "stop").exists()
    with pytest.raises(PartialError, match="1 of 2 pairs failed"):
        run(*command, tmp_path / "go", "--keep-going", "--mean", tmp_path / "mean.vtkhdf")
    assert sorted(stamps(tmp_path / "go")) == ["a0.vtkhdf"]


def claims_in(folder: Path) -> list[str]:
    return [path.name for path in folder.glob(".*.claim")]


def claim_of(target: Path) -> Path:
    with claimed(target):
        (name,) = claims_in(target.parent)
    return target.with_name(name)


@pytest.mark.thorough
def test_what_another_worker_makes_is_left_to_it(weights, images, tmp_path, capsys) -> None:
    command = ("reconstruct", weights, *images, *QUICK, "-o")
    run(*command, tmp_path / "before")
    out = tmp_path / "out"
    out.mkdir()

    def other() -> None:
        with claimed(out / "f1.vtkhdf") as granted:
            claiming.set()
            assert granted
            while not (out / "f2.vtkhdf").exists():
                time.sleep(0.01)
            (tmp_path / "before" / "f1.vtkhdf").rename(out / "f1.vtkhdf")

    claiming, worker = threading.Event(), threading.Thread(target=other)
    worker.start()
    assert claiming.wait(10)
    summary = summary_of(capsys, *command, out)
    worker.join()
    assert (summary["reconstructed"], summary["skipped"]) == (2, 1)
    assert sorted(stamps(out)) == ["f0.vtkhdf", "f1.vtkhdf", "f2.vtkhdf"]


@pytest.mark.thorough
@pytest.mark.parametrize("fate", ["dead", "silent", "half written"])
def test_the_claim_of_a_dead_worker_is_taken_over(weights, images, tmp_path, capsys, fate) -> None:
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    claim = claim_of(tmp_path / "f0.vtkhdf")
    host = socket.gethostname() if fate == "dead" else "another"
    claim.write_text("" if fate == "half written" else json.dumps({"host": host, "process": dead.pid}))
    if fate != "dead":
        os.utime(claim, (time.time() - 2 * DEAD_AFTER_S,) * 2)
    summary = summary_of(capsys, "reconstruct", weights, images[0], *QUICK, "-o", tmp_path / "f0.vtkhdf")
    assert summary["reconstructed"] == 1
    assert not claims_in(tmp_path)


def test_a_living_worker_is_respected_and_shows_that_it_is_alive(tmp_path, monkeypatch) -> None:
    claim = claim_of(tmp_path / "f0.vtkhdf")
    for host, process in ((socket.gethostname(), os.getpid()), ("another", 1)):
        claim.write_text(json.dumps({"host": host, "process": process}))
        with claimed(tmp_path / "f0.vtkhdf") as granted:
            assert not granted
        assert claim.exists()
    # A worker shows that it is alive.
    monkeypatch.setattr(atomic, "TOUCHED_EVERY_S", 0.01)
    claim.unlink()
    with claimed(tmp_path / "f0.vtkhdf") as granted:
        assert granted
        os.utime(claim, (0, 0))
        for _ in range(500):
            if claim.stat().st_mtime > 0:
                break
            time.sleep(0.01)
        assert claim.stat().st_mtime > 0
    assert not claim.exists()


MEAN = "correlate {pairs[0]} {pairs[1]} {pairs[2]} {pairs[3]} --pairing ab -o out"
STILLS = f"calibrate-snapshot '{CONFIG}' --white '{SAMPLE}/white.tif' --dark '{SAMPLE}/dark.tif' -o c.h5"


# Commands two of whose files are one: names that differ by their folder, a page, case; inputs, lists, logs, pictures.
@pytest.mark.parametrize(
    "words",
    [
        "reconstruct {weights} f0.tif other/f0.tif -o out",
        "reconstruct {weights} run.tif other/run_0001.tif -o out",
        "reconstruct {weights} f0.tif other/F0.tif -o out",
        "reconstruct {weights} f0.vtkhdf -o .",
        "reconstruct {weights} f0.tif f0_residual.tif --solver particles -o .",
        "reconstruct {weights} f0.tif other/F0.tif -o out --failures out/f0.vtkhdf",
        "reconstruct {weights} f0.tif other/F0.tif -o out --log out/f0.vtkhdf",
        f"{MEAN} --mean out/a0.vtkhdf",
        f"{MEAN} --mean {{pairs[0]}}",
        "correlate {pairs[0]} {pairs[1]} -o out --log ./out",
        f"{STILLS} --picture c.h5",
        f"{STILLS} --picture x.png --views x.png",
        f"refine-calibration '{CONFIG}' f0.tif --calibration z.h5 --picture c.h5 -o c.h5",
    ],
)
def test_outputs_of_one_name_are_refused_at_once(weights, images, raw, pairs, tmp_path, monkeypatch, words) -> None:
    monkeypatch.chdir(tmp_path)
    Path("other").mkdir()
    for name in ("other/f0.tif", "other/F0.tif", "other/run_0001.tif", "f0.vtkhdf", "f0_residual.tif"):
        Path(name).write_bytes(images[0].read_bytes())
    tifffile.imwrite("run.tif", np.stack([raw] * 2), photometric="minisblack")
    if "log" not in words and "failures" not in words:
        monkeypatch.setattr(atomic, "ignores_case", lambda folder: True)
    refused = "would give the same output|two outputs of this command|is also an input|is the log, and another file"
    with pytest.raises(UsageError, match=refused):
        run(*shlex.split(words.format(weights=weights, pairs=pairs)), "--overwrite")
    log = {Path("out/f0.vtkhdf")} if "log" in words else set()
    assert {*Path().glob("out/*.vtkhdf"), *Path().glob("c.h5")} <= log


def test_a_folder_tells_whether_it_minds_case(tmp_path, monkeypatch) -> None:
    ignores_case.cache_clear()
    (tmp_path / "Folder").mkdir()
    minds = not (tmp_path / "fOLDER").exists()
    assert (atomic.folded("A", tmp_path / "Folder") == "A") == minds
    assert ignores_case(tmp_path / "Folder") == ignores_case(tmp_path / "Folder" / "not yet") == (not minds)
    monkeypatch.setattr(atomic, "ignores_case", lambda folder: True)
    assert atomic.folded("Ü.tif", tmp_path) == atomic.folded("u\u0308.TIF", tmp_path)


@pytest.mark.slow
def test_a_pair_with_a_bad_frame_stays_as_it_is(tmp_path, capsys) -> None:
    given = ("--white", SAMPLE / "white.tif", "--dark", SAMPLE / "dark.tif", "--board", SAMPLE / "board.tif")
    run("calibrate-snapshot", CONFIG, *given, "-o", tmp_path / "calibration.h5", "-q")
    run("build-weights", CONFIG, "--calibration", tmp_path / "calibration.h5", "-o", tmp_path / "weights.h5", "-q")
    images = [tmp_path / f"pair_{name}.tif" for name in "ab"]
    for image in images:
        image.write_bytes((SAMPLE / image.name).read_bytes())
    whole = images[0].read_bytes()
    spoil(images[0], "cut")
    out = tmp_path / "out"
    dark = ("--dark", SAMPLE / "dark.tif", "--solver", "particles", "--no-residual")
    beside = ("reconstruct", tmp_path / "weights.h5", *images, *dark, "--pairing", "ab", "--resume", "-o", out)
    with pytest.raises(PartialError, match=r"1 of 2 frames failed, the first because .*pair_a\.tif"):
        run(*beside, "--keep-going")
    assert "pair_b: is found without the help of pair_a" in capsys.readouterr().err
    before = stamps(out)
    with pytest.raises(PartialError):
        run(*beside, "--keep-going")
    assert stamps(out) == before
    paths = out / "pair_b.vtkhdf", tmp_path / "alone.vtkhdf"
    summary = summary_of(capsys, "reconstruct", tmp_path / "weights.h5", images[1], *dark, "-o", paths[1])
    assert summary["particle_diameter_measured_mm"] == pytest.approx(0.05, rel=0.2)
    found, alone = (read_points(path, PARTICLES_FORMAT) for path in paths)
    assert len(found.position_mm) > 500
    np.testing.assert_array_equal(found.position_mm, alone.position_mm)
    images[0].write_bytes(whole)
    with pytest.raises(OutputExistsError, match="pair_b.vtkhdf: exists and was made from other inputs"):
        run(*beside)


@pytest.mark.slow
def test_two_workers_share_a_folder_and_a_killed_one_is_replaced(weights, raw, tmp_path) -> None:
    folder, out = tmp_path / "images", tmp_path / "out"
    folder.mkdir()
    for number in range(12):
        tifffile.imwrite(folder / f"f{number}.tif", raw + np.uint16(number))
    base = [sys.executable, "-m", "lfpiv_cli", "reconstruct", str(weights), str(folder)]
    command = [*base, *map(str, QUICK), "--iterations", "40", "-q"]

    def start(to: Path, *options: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen([*command, *options, "-o", str(to)], cwd=ROOT, stderr=subprocess.PIPE)

    assert start(tmp_path / "one").wait(120) == 0
    killed = start(out, "--resume")
    while not list(out.glob("f*.vtkhdf")) and killed.poll() is None:
        time.sleep(0.01)
    killed.kill()
    killed.wait()
    workers = [start(out, "--resume") for _ in range(2)]
    assert [worker.wait(120) for worker in workers] == [0, 0], [worker.communicate()[1] for worker in workers]
    assert claims_in(out) == []
    assert {name: content for name, (_, content) in stamps(out).items() if not name.startswith(".")} == {
        name: content for name, (_, content) in stamps(tmp_path / "one").items()
    }


@pytest.mark.parametrize("command", ["reconstruct", "correlate"])
def test_a_dry_run_tells_and_writes_nothing(weights, images, pairs, tmp_path, capsys, command) -> None:
    fields = (*pairs, "--pairing", "ab", "--windows", 8, "--derived")
    given = (weights, *images, *QUICK) if command == "reconstruct" else fields
    words = (command, *given, "-o", tmp_path / "out", "--failures", tmp_path / "failed.json")
    before = stamps(tmp_path)
    summary = summary_of(capsys, *words, "--log", tmp_path / "log", "--dry-run")
    assert stamps(tmp_path) == before
    made = ["f0", "f1", "f2"] if command == "reconstruct" else ["a0", "a1"]
    assert (summary["to_make"], summary["skipped"], summary["unreadable"]) == (len(made), 0, 0)
    assert summary["would_make"] == [str(tmp_path / "out" / f"{name}.vtkhdf") for name in made]
    assert (summary["seconds"], summary["seconds_by"]) == (None, None)
    assert summary["disk_by"] == "at most, uncompressed"
    assert command == "reconstruct" or 300.0 < summary["memory_mb"] < 310.0
    run(*words)
    written = sum(path.stat().st_size for path in (tmp_path / "out").iterdir()) / 1e6
    assert written < summary["disk_mb"] < 10.0 * written


@pytest.mark.thorough
def test_a_dry_run_believes_what_is_there_and_the_log(weights, images, tmp_path, capsys) -> None:
    command = ("reconstruct", weights, *images, *QUICK, "-o", tmp_path / "out", "--log", tmp_path / "log", "--resume")
    run(*command)
    victim = tmp_path / "out" / "f1.vtkhdf"
    size = victim.stat().st_size
    victim.unlink()
    before = [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()]
    frames = [each for each in before if each["event"] == "frame"]
    summary = summary_of(capsys, *command, "--dry-run")
    assert [json.loads(line) for line in (tmp_path / "log").read_text().splitlines()] == before
    assert (summary["to_make"], summary["skipped"]) == (1, 2)
    assert summary["would_make"] == [str(victim)]
    assert summary["disk_mb"] == pytest.approx(size / 1e6, rel=0.2)
    assert summary["seconds"] == frames[-1]["seconds_each"]
    assert summary["memory_mb"] == frames[-1]["memory_mb"] > 50.0
    run(*command[:-1], "--dry-run", "--overwrite", "-v")
    said = capsys.readouterr().out
    assert said.count("would make") == 3
    assert "would_make" not in said


def test_a_dry_run_ends_as_the_batch_would(weights, images, pairs, tmp_path, capsys) -> None:
    output = (*QUICK, "-o", tmp_path / "out")
    run("reconstruct", weights, *images[1:], *output)
    with pytest.raises(OutputExistsError):
        run("reconstruct", weights, *images, *output, "--dry-run")
    with pytest.raises(UsageError, match="same output"):
        run("reconstruct", weights, images[0], images[0], *output, "--dry-run")
    spoil(images[0], "empty")
    with pytest.raises(InputError, match="f0.tif: is empty"):
        run("reconstruct", weights, *images, *output, "--dry-run")
    summary = summary_of(capsys, "reconstruct", weights, *images, *output, "--keep-going", "--resume", "--dry-run")
    assert (summary["to_make"], summary["skipped"], summary["unreadable"]) == (0, 2, 1)
    (tmp_path / "b1.vtkhdf").write_bytes(pairs[3].read_bytes()[:-200])
    words = ("correlate", *pairs[:3], tmp_path / "b1.vtkhdf", "--pairing", "ab", "--windows", 8, "-o", tmp_path / "two")
    summary = summary_of(capsys, *words, "--keep-going", "--dry-run")
    assert (summary["to_make"], summary["unreadable"]) == (1, 1)


def test_the_last_event_of_a_command_is_found(tmp_path: Path) -> None:
    log = EventLog(tmp_path / "log", "reconstruct")
    assert log.last("frame") is None
    for number in (1, 2):
        log.write("frame", {"step": "reconstruct", "done": number})
    EventLog(tmp_path / "log", "correlate").write("frame", {"step": "reconstruct", "done": 3})
    log.write("frame", {"step": "other", "done": 4})
    with open(tmp_path / "log", "a") as file:
        file.write('{"cut')
    found = log.last("frame", step="reconstruct")
    assert found is not None
    assert found["done"] == 2
