"""`run`: the whole chain at once, gone on with, and what it refuses."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import tifffile

from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, LfpivError, OutputExistsError, PartialError, UsageError
from lfpiv_cli.files.provenance import carried_record, differences
from lfpiv_cli.verbs import particles, run_choice
from lfpiv_cli.verbs import report as report_stage
from lfpiv_cli.verbs import run as stage
from lfpiv_cli.verbs.report import report
from lfpiv_cli.verbs.run_steps import RunOptions
from tests.commands import SAMPLE, sample_rig
from tests.commands import run as lfpiv
from tests.commands import summary_of as told_of

PAIR = SAMPLE / "pair_a.tif", SAMPLE / "pair_b.tif"
PHOTOGRAPHS = [word for name in ("white", "dark", "board") for word in (f"--{name}", SAMPLE / f"{name}.tif")]
RIGHT = "0.55 tracers for each microlens, and particles err less up to about 3"
FILES = ("calibration.h5", "calibration.png", "weights.h5", "volumes/pair_a.vtkhdf", "volumes/pair_b.vtkhdf")
VECTORS = "vectors.vtkhdf"


def run(rig: Path, output: Path, *options: object, images: tuple[Path, ...] = PAIR) -> None:
    lfpiv("run", rig, *images, *PHOTOGRAPHS, "--method", "volumes", "--no-report", *options, "-o", output)


def rig_in(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the sample's rig, its volumes by two iterations."""
    return sample_rig(folder, ("iterations: 16", "iterations: 2"), *changes)


def told_by(folder: Path) -> dict[str, Any]:
    """Return what a run has written of itself."""
    return dict(json.loads((folder / "out" / "run.json").read_text(), parse_constant=pytest.fail))


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a rig and, in `out`, what a run by volumes has made of the sample with it."""
    folder = tmp_path_factory.mktemp("run")
    run(rig_in(folder), folder / "out", "-q")
    return folder


@pytest.fixture
def again(ran: Path, tmp_path: Path) -> Path:
    """A copy of it to run again in, with the times of its files."""
    shutil.copytree(ran, tmp_path, dirs_exist_ok=True)
    return tmp_path


def states(folder: Path) -> dict[str, str]:
    return {name: step["state"] for name, step in told_by(folder)["steps"].items()}


def stamps(folder: Path) -> dict[str, int]:
    return {name: (folder / "out" / name).stat().st_mtime_ns for name in (*FILES, VECTORS)}


@pytest.mark.thorough
def test_files_are_those_of_the_single_commands_and_it_says_what_was_chosen(ran: Path, tmp_path: Path) -> None:
    rig, calibration, weights = ran / "rig.yaml", tmp_path / "calibration.h5", tmp_path / "weights.h5"
    picture = ("--picture", tmp_path / "calibration.png")
    lfpiv("calibrate-snapshot", rig, *PHOTOGRAPHS, "-o", calibration, *picture, "-q")
    lfpiv("build-weights", rig, "--calibration", calibration, "-o", weights, "-q")
    lfpiv("reconstruct", weights, *PAIR, "--dark", SAMPLE / "dark.tif", "-o", tmp_path / "volumes", "-q")
    lfpiv("correlate", *(tmp_path / name for name in FILES[3:]), "-o", tmp_path / VECTORS, "-q")
    for name in (*FILES, VECTORS):
        assert (tmp_path / name).read_bytes() == (ran / "out" / name).read_bytes(), name
    reported = told_by(ran)
    assert (reported["method"], reported["reason"]) == ("volumes", f"as asked for; but there are {RIGHT}")
    # 400 tracers before 660 microlenses.
    assert reported["tracers_per_lens"] == pytest.approx(0.61, rel=0.2)
    assert list(reported["summaries"]) == ["calibrate-snapshot", "build-weights", "reconstruct", "correlate"]
    assert reported["figures"]["vectors"] == {"volumes": 90}
    assert reported["figures"]["u_from_voxel"]["volumes"] < reported["figures"]["u_to_voxel"]["volumes"]
    (tmp_path / "run.json").write_text("mine")
    with pytest.raises(OutputExistsError, match=r"run.json"):
        run(ran / "rig.yaml", tmp_path)


@pytest.mark.thorough
def test_what_is_done_is_kept_with_its_summary_and_what_is_lost_is_made_again(again: Path) -> None:
    before, earlier = stamps(again), told_by(again)
    run(again / "rig.yaml", again / "out")
    assert stamps(again) == before
    assert set(states(again).values()) == {"kept"}
    reported = told_by(again)
    assert reported["summaries"] == earlier["summaries"]
    assert reported["warnings"] == earlier["warnings"]
    (again / "out" / "calibration.png").unlink()
    run(again / "rig.yaml", again / "out")
    assert (again / "out" / "calibration.png").exists()
    assert states(again)["build-weights"] == "kept"


@pytest.mark.thorough
def test_a_person_is_told_what_was_made_and_a_program_all(again: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["run", again / "rig.yaml", *PAIR, *PHOTOGRAPHS, "--method", "volumes", "-o", again / "out"]
    capsys.readouterr()
    lfpiv(*words)
    sentence, by, made, kept, after, figures = capsys.readouterr().out.splitlines()
    size = "3 x 1.8 x 3.6 mm"
    told_first = rf"\d\d vectors in {size}; u up to 0\.\d+ m/s, known to 0\.\d+ m/s across and 0\.\d+ m/s in depth; .*"
    assert re.fullmatch(told_first, sentence)
    assert by.startswith("by volumes: as asked for")
    assert {"calibration.h5", "weights.h5", "volumes", VECTORS} <= set(kept.removeprefix("kept: ").split(", "))
    assert made == "made: report.html"
    assert after == f"open next: {again / 'out' / 'report.html'} in a browser, {again / 'out' / VECTORS} in ParaView"
    assert figures.startswith("all figures: --json")
    reported = told_of(capsys, *words)
    assert reported["sentence"] == sentence
    assert reported["steps_kept"] == 5
    assert reported["u_sigma_voxel"]["volumes"] > 0.0


@pytest.mark.thorough
def test_only_what_depends_on_a_change_is_made_anew(again: Path) -> None:
    with pytest.raises(OutputExistsError, match=r"step 4, correlate: .*vectors.vtkhdf") as caught:
        run(again / "rig.yaml", again / "out", "--dt-s", 0.001)
    assert "(correlation.dt_s was 0.002, is 0.001); --overwrite makes it anew; with it the run makes" in str(
        caught.value
    )
    before = stamps(again)
    run(again / "rig.yaml", again / "out", "--dt-s", 0.001, "--overwrite")
    after = stamps(again)
    assert {name for name in after if after[name] != before[name]} == {VECTORS}


@pytest.mark.thorough
def test_settings_of_a_later_step_leave_what_was_made_before(again: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = [name for name in FILES if name.endswith(("h5", "vtkhdf"))]
    text = (again / "rig.yaml").read_text()
    (again / "rig.yaml").write_text(text.replace("windows: [24, 12]", "windows: [24, 10]"))
    before = {name: data_of(again / "out" / name) for name in names}
    earlier = told_by(again)["summaries"]
    with pytest.raises(OutputExistsError) as caught:
        run(again / "rig.yaml", again / "out")
    reported = str(caught.value)
    assert (
        "calibration.h5: exists and was made from other inputs or settings (correlation.windows was [[24, 24"
        in reported
    )
    assert reported.endswith(
        "--overwrite keeps it, as it depends on none of that; with it the run makes vectors again and keeps "
        "calibration.h5, weights.h5 and volumes"
    )
    capsys.readouterr()
    run(again / "rig.yaml", again / "out", "--overwrite", "--dry-run", "--json")
    assert json.loads(capsys.readouterr().out)["to_make"] == {"volumes": 0, "vectors": 1}
    # Nor are volumes of other settings taken for those of a result.
    shutil.copytree(again / "out", again / "results")
    run(again / "rig.yaml", again / "results", "--keep", "results", "--overwrite")
    made = json.loads((again / "results" / "run.json").read_text())
    assert made["steps"]["correlate"]["state"] == "made"
    run(again / "rig.yaml", again / "out", "--overwrite")
    assert list(states(again).values()) == ["recorded anew"] * 3 + ["made"]
    assert {name: data_of(again / "out" / name) for name in names} == before
    reported = told_by(again)
    assert reported["summaries"]["reconstruct"] == earlier["reconstruct"]
    # What each carries is what a run from the beginning would have written, and it is kept from now on.
    carried = carried_record(again / "out" / "vectors.vtkhdf")
    assert {made["config"]["correlation"]["windows"][1][0] for made in carried["made_from"].values()} == {10}
    run(again / "rig.yaml", again / "out")
    assert set(states(again).values()) == {"kept"}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("change", "again_and_kept"),
    [
        (("iterations: 2", "iterations: 3"), "weights.h5 and what depends on it again and keeps calibration.h5"),
        (("pixel_um: 5.5", "pixel_um: 5.6"), "calibration.h5, weights.h5 and what depends on it again"),
    ],
)
def test_what_a_change_makes_again_is_said_before(again: Path, change: tuple[str, str], again_and_kept: str) -> None:
    text = (again / "rig.yaml").read_text()
    assert change[0] in text
    (again / "rig.yaml").write_text(text.replace(*change))
    with pytest.raises(OutputExistsError) as caught:
        run(again / "rig.yaml", again / "out")
    assert str(caught.value).endswith(f"with it the run makes {again_and_kept}")


def test_what_has_changed_since_a_result_was_made_is_named() -> None:
    config, image = {"name": "rig.yaml", "sha256": "1"}, {"name": "a.tif", "sha256": "2"}
    carried = {"program": "lfpiv", "version": "1", "libraries": {"numpy": "2"}, "command": "reconstruct page 0"}
    carried |= {"config": {"media": {"fluid": 1.33}, "window": None}, "made_from": {}}
    carried |= {"inputs": {"config": config, "image": image}}
    assert differences(carried, carried) == []
    for key, value, words in (
        ("config", {"media": {"fluid": 1.4}, "window": None}, "media.fluid was 1.33, is 1.4"),
        ("config", {"media": {"fluid": 1.33}, "window": 2.0}, "window was not given, is 2.0"),
        ("config", {"media": {"fluid": list(range(60))}, "window": None}, "media.fluid has changed"),
        ("inputs", {"config": config, "image": {"name": "b.tif", "sha256": "3"}}, "image is another file"),
        ("inputs", {"config": config | {"sha256": "4"}, "image": image}, "the config is another file, which"),
        ("libraries", {"numpy": "3"}, "numpy was 2, is 3"),
        ("version", "2", "lfpiv was 1, is 2"),
        ("command", "reconstruct page 1", "the command was reconstruct page 0, is reconstruct page 1"),
    ):
        (reported,) = differences(carried, carried | {key: value})
        assert reported.startswith(words)


def data_of(path: Path) -> dict[str, bytes]:
    """Return the bytes of all datasets in a file."""
    found: dict[str, bytes] = {}
    with h5py.File(path) as file:
        file.visititems(lambda name, h5: found.update({name: h5[()].tobytes()} if isinstance(h5, h5py.Dataset) else {}))
    return found


@pytest.mark.thorough
def test_a_torn_file_is_refused_or_made_again(again: Path) -> None:
    torn, whole = again / "out" / "weights.h5", (again / "out" / "weights.h5").read_bytes()
    torn.write_bytes(whole[:-1000])
    reported = told_by(again)["summaries"]
    with pytest.raises(OutputExistsError, match="step 2, build-weights"):
        run(again / "rig.yaml", again / "out")
    run(again / "rig.yaml", again / "out", "--overwrite")
    assert torn.read_bytes() == whole
    assert told_by(again)["summaries"] == reported
    assert [name for name, state in states(again).items() if state == "made"] == ["build-weights"]


@pytest.mark.thorough
def test_a_step_that_fails_leaves_those_before_it(again: Path) -> None:
    bad = again / "pair_b.tif"
    bad.write_bytes(PAIR[1].read_bytes()[:-5000])
    (again / "out" / "volumes" / "pair_b.vtkhdf").unlink()
    (again / "out" / "run.json").unlink()
    with pytest.raises(InputError, match=r"step 3, reconstruct: .*pair_b.*the same command goes on"):
        run(again / "rig.yaml", again / "out", images=(PAIR[0], bad))
    assert states(again) == {"calibrate-snapshot": "kept", "build-weights": "kept"}


@pytest.mark.thorough
def test_the_report_is_made_of_what_was_made(again: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = []

    def report(folder: Path, page: Path, options: Any, **_: Any) -> dict[str, Any]:
        made.append((folder, {path.name for path in options.raw}))
        page.write_text("<html>")
        return {"verdict": {"vectors": "good"}}

    monkeypatch.setattr(run_choice, "report", report)
    for _ in range(2):
        run(again / "rig.yaml", again / "out", "--report")
    assert made == [(again / "out", {"pair_a.tif", "pair_b.tif", "white.tif", "board.tif"})]
    reported = told_by(again)
    assert reported["summaries"]["report"] == {"verdict": {"vectors": "good"}}


@pytest.mark.thorough
def test_results_are_kept_without_volumes_whatever_fails(again: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    images = again / "images"
    images.mkdir()
    for name, source in (("pair_a", 0), ("pair_b", 1), ("next_a", 0), ("next_b", 1), ("lost_a", 0)):
        shutil.copyfile(PAIR[source], images / f"{name}.tif")
    (images / "next_b.tif").write_bytes(b"")
    out, failures = again / "out", again / "failures.json"
    options = ("--pairing", "ab", "--keep", "results", "--keep-going", "--failures", failures)

    def failed() -> list[str]:
        with pytest.raises(PartialError) as caught:
            run(again / "rig.yaml", out, *options, images=(images,))
        listed = json.loads(failures.read_text())
        assert listed == caught.value.figures["failures"]
        return [Path(each["name"]).stem for each in listed]

    # The second frame of one pair cannot be read, that of another is not there.
    assert failed() == ["lost_a", "next_a"]
    assert (out / "vectors" / "pair_a.vtkhdf").read_bytes() == (out / VECTORS).read_bytes()
    assert not (out / "volumes" / "pair_a.vtkhdf").exists()
    first = (out / "vectors" / "pair_a.vtkhdf").stat().st_mtime_ns
    shutil.copyfile(PAIR[1], images / "next_b.tif")
    assert failed() == ["lost_a"]
    assert sorted(path.name for path in (out / "vectors").iterdir()) == ["next_a.vtkhdf", "pair_a.vtkhdf"]
    assert not (out / "volumes").exists()
    # What stands is known without its volumes, and without the weights.
    monkeypatch.setattr(particles, "open_weights", lambda _: pytest.fail("weights were opened"))
    failed()
    assert set(states(again).values()) == {"kept"}
    assert (out / "vectors" / "pair_a.vtkhdf").stat().st_mtime_ns == first
    assert not (out / "volumes").exists()


@pytest.mark.thorough
def test_the_verdict_is_the_same_whether_volumes_are_kept_or_not(again: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_stage, "figures_of", lambda *_given: {})
    rig, out, images = again / "rig.yaml", again / "out", (again / "a.tif", again / "b.tif")
    for path, source in zip(images, PAIR, strict=True):
        frame = tifffile.imread(source)
        # 2 % of the pixels are clipped, which makes a warning in the records of volumes alone.
        tifffile.imwrite(path, np.minimum(frame * (4095.0 / np.percentile(frame, 98.0)), 4095.0).astype(np.uint16))
    shutil.rmtree(out / "volumes")
    reported = []
    for keep in ("results", "all"):
        run(rig, out, "--keep", keep, "--overwrite", images=images)
        assert (out / "volumes").exists() == (keep == "all")
        summary = report(out, out / "page.html", overwrite=True, console=Console(quiet=True))
        reported.append((summary["verdict"], (out / "page.html").read_text().count("of its lit pixels are saturated")))
    assert reported == [({"calibration": "good", "images": "look", "vectors": "look"}, reported[0][1])] * 2
    assert reported[0][1] > 0


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"images": PAIR[:1]}, UsageError, "1 frames"),
        ({"images": (*PAIR, PAIR[0])}, UsageError, "--pairing"),
        ({"images": (PAIR[0], PAIR[0])}, UsageError, "same output"),
        ({"white": (), "board": ()}, UsageError, "--white"),
        ({"dark": Path("missing.tif")}, InputError, "missing.tif"),
        ({"combine": True}, UsageError, "--method both"),
        ({"follow": True, "method": "volumes"}, UsageError, "--follow"),
        ({"follow": True, "method": "both", "combine": True}, UsageError, "--follow"),
        ({"change": (", dt_s: 0.002", "")}, ConfigError, "correlation.dt_s"),
        ({"change": (", dt_s: 0.002", ""), "images": (*PAIR, Path("no.tif")), "keep_going": True}, ConfigError, "dt_s"),
        ({"change": ("solver: em", "solver: particles"), "method": "both"}, ConfigError, "solver"),
        ({"change": ("correlation:", "weights: {method: dlfc}\ncorrelation:"), "method": "both"}, ConfigError, "dlfc"),
        ({"change": ("columns: 600", "columns: 599")}, InputError, "pair_a"),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_made(
    options: dict[str, Any], error: type[LfpivError], said: str, tmp_path: Path
) -> None:
    rig = rig_in(tmp_path, *filter(None, (options.pop("change", None),)))
    given = {"images": PAIR, "white": [SAMPLE / "white.tif"], "board": [SAMPLE / "board.tif"]} | options
    with pytest.raises(error, match=said):
        stage.run(rig, tmp_path / "out", RunOptions(**given), console=Console(quiet=True))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("count", "method", "methods", "said"),
    [
        (0.6, "auto", ("particles",), "0.6 tracers for each microlens"),
        (3.1, "auto", ("volumes",), "3.1 tracers for each microlens"),
        (None, "auto", ("particles",), "too little"),
        (3.1, "both", ("volumes", "particles"), "--method"),
        (3.1, "particles", ("particles",), "as asked for; but there are 3.1 tracers"),
        (0.6, "volumes", ("volumes",), "particles err less up to about 3"),
    ],
)
def test_the_method_is_what_errs_less(
    count: float | None, method: Any, methods: tuple[str, ...], said: str, tmp_path: Path
) -> None:
    settings = stage.load_rig(rig_in(tmp_path))
    choice = run_choice.chosen(settings, RunOptions(images=PAIR, method=method), lambda: count)
    assert choice.methods == methods
    assert said in choice.reason
    assert choice.tracers_per_lens == count
