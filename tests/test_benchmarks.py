"""The benchmarks at a tiny size."""

import json
import random
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from benchmarks import faults as planted
from benchmarks import rigs, timing
from benchmarks.batches import Figures, digests, killed, print_throughput, print_workers, small_experiment
from benchmarks.calibration import report, run_series
from benchmarks.correlation import accuracy_series, against_openpiv, openpiv_pass, time_and_memory
from benchmarks.depth import CAMERA, LATERAL_MM, Case, response
from benchmarks.faults import FAULTS, STAGES, Bench, Experiment, benches, prepare, told_by
from benchmarks.fuzz import READERS, Reader, bench_fuzz, case, meant, outcome
from benchmarks.particles import calibrated, errors_over_bound, print_errors_over_bound, print_figures
from benchmarks.rig_drawing import DT_S, draw, hardened
from benchmarks.rigs import ADVICE, Outcome, Step, codes, row, run_rig, summary, verdict
from benchmarks.sequences import print_sequence
from benchmarks.solvers import SparseOperator, against_sparse_matrix, catching_up
from benchmarks.surfaces import rates
from benchmarks.volumes import Seeding, volume_pair
from benchmarks.weights import sparse_matrix
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.images import read_image
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.weights.build import factorise


def test_growth_is_that_of_the_last_quarter_over_the_second() -> None:
    # The first quarter is when things are loaded.
    memory = [50.0, 90.0, 100.0, 100.0, 104.0, 105.0, 110.0, 110.0]
    figures = Figures(wall_s=10.0, own_s=9.5, memory_mb=memory, files=[5, 6])
    assert figures.growth() == pytest.approx(0.1)
    assert figures.share() == 0.95
    assert "growth +10.0%" in figures.reported()


@pytest.mark.slow
def test_the_cost_of_a_batch_and_of_workers_is_printed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    experiment = small_experiment(tmp_path, pairs=2)
    assert len(set(digests(tmp_path / "images").values())) == 4
    print_throughput(experiment, tmp_path)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(":")[0] for line in lines[:2]] == ["2 pairs, volumes", "2 pairs, fields"]
    for line in lines[:2]:
        assert 0.3 < float(re.search(r": ([\d.]+) \(limit 0.9\)", line)[1]) <= 1.0
    print_workers(experiment, tmp_path)
    assert len(re.findall(r"[\d.]+ times", capsys.readouterr().out)) == 4


@pytest.mark.slow
def test_a_batch_that_is_killed_and_resumed_gives_the_same_files(tmp_path: Path) -> None:
    assert killed(small_experiment(tmp_path, pairs=2), tmp_path, 2, np.random.default_rng(1))[0] == 0


@pytest.mark.thorough
def test_every_case_of_the_accuracy_has_figures() -> None:
    series = accuracy_series((40, 40, 40), [(16, 16, 16)], per_window=(8.0,), flows=("channel", "taylor_green"))
    assert len(series) == 8
    for figures in series.values():
        assert np.all(np.isfinite(figures["rms"]))
        assert np.all(figures["coverage"] <= 1.0)
    # 95 % by its definition. (Vortices of 40 voxels are more than windows of 16 can tell.)
    assert np.mean([series[f"A 8 {noise} channel"]["coverage"] for noise in ("clean", "noisy")]) > 0.9
    # Along y nothing moves in the vortices, and nothing but noise is in the way.
    assert series["A 8 clean taylor_green"]["rms"][1] < 0.1
    assert series["A 8 clean taylor_green"]["rms"][1] < series["A 8 noisy taylor_green"]["rms"][1]


def test_memory_is_measured_where_the_system_tells() -> None:
    seconds, memory = time_and_memory((40, 40, 40), [(16, 16, 16)])
    assert seconds > 0.0
    assert memory is None or memory >= 0.0


def test_openpiv_s_signs_are_turned_round(rng: np.random.Generator) -> None:
    pytest.importorskip("openpiv", reason="OpenPIV is not installed: it is only a benchmark's peer")
    shift = np.array([1.3, -0.7, 0.4])
    a, b = volume_pair(lambda points: np.tile(shift, (len(points), 1)), (32, 32, 32), Seeding(20.0, (1.0,) * 3), rng)
    # It is biased by 0.15 voxel towards zero.
    np.testing.assert_allclose(np.median(openpiv_pass(a, b, 16), axis=(0, 1, 2)), shift[::-1], atol=0.3)
    assert set(against_openpiv(a, b, [(16, 16, 16)], repeats=1)) == {"ours_s", "one_pass", "four_passes"}


@pytest.mark.slow
def test_a_displacement_in_depth_comes_back() -> None:
    case = Case(tracers=450, depth_mm=0.3, noisy=False)
    mean, spread = response(case, replace(CAMERA, columns=760, rows=760), box_mm=(3.2, 3.2, 4.8))
    assert mean[:2] == pytest.approx(LATERAL_MM, abs=0.01)
    assert mean[2] == pytest.approx(0.3, abs=0.03)  # few windows, each 0.025 mm from their mean
    assert (spread < (0.02, 0.02, 0.06)).all()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planted, "LENSES", (18, 14))
        tiny = next(benches(planted.SEED, 1, planted.clear, tmp_path_factory.mktemp("bench")))
    # which is too small for its board
    return replace(tiny, good=planted.without("board")(tiny.good))


def test_faults_are_spoilt_experiments() -> None:
    names = [fault.name for fault in FAULTS]
    assert len(set(names)) == len(names) > 20
    pictures = {name: np.full((20, 24), 100.0) + k for k, name in enumerate(("dark", "pair_a", "pair_b"))}
    good = Experiment({"media": {"fluid": 1.33}}, pictures, 255.0)
    by_name = {fault.name: fault.spoil for fault in FAULTS}
    assert by_name["index 5 % off"](good).reported["media"]["fluid"] == pytest.approx(1.33 * 1.05)
    assert good.reported["media"]["fluid"] == 1.33
    assert "dark" not in by_name["no dark"](good).pictures
    assert by_name["frame overexposed"](good).pictures["pair_a"].max() == 255.0
    assert by_name["pair exchanged"](good).pictures["pair_a"].max() == 102.0


def test_what_was_said() -> None:
    line = "lfpiv: warning: white image: is dim; light it [white-dim]"
    done = Step("calibrate-snapshot", 0, "", [line, line, "RuntimeWarning: overflow"], 0.0)
    assert codes([done]) == ["white-dim", "RuntimeWarning: overflow"]
    advice = Step("build-weights", 0, "", [f"lfpiv: warning: a: b; c [{min(ADVICE)}]"], 0.0)
    assert told_by([advice]) == ""
    assert told_by([done, Step("track", 4, "no particles", [], 0.0)]) == "refused: no particles"
    assert told_by([Step("track", 1, "KeyError: 'a'", [], 0.0)]) == "CRASH: KeyError: 'a'"


@pytest.mark.thorough
def test_a_fault_is_told_and_a_good_picture_is_not(bench: Bench) -> None:
    by_name = {fault.name: fault for fault in FAULTS}
    assert told_by([bench.calibrate(bench.good)]) == ""
    overexposed = by_name["white overexposed"].spoil(bench.good)
    assert "of the white image is saturated" in STAGES["calibrate"](bench, overexposed)
    prepare(bench, "frame")
    assert told_by([bench.look(bench.good)]) == ""
    assert STAGES["frame"](bench, by_name["no dark"].spoil(bench.good)) == "dark-level"
    assert "frame-given-before" in STAGES["frame"](bench, by_name["white as frame"].spoil(bench.good))


@pytest.mark.slow
def test_figures_of_particles_and_sequences_are_printed(capsys: pytest.CaptureFixture[str]) -> None:
    # The least that shows enough of the board's dots.
    bench = calibrated((880, 880), (26, 20, 20), seed=1)
    # A volume about the focal plane, where light stays within one lens, is the hardest: 0.81 and 0.98 when written.
    for spread, text in ((None, "40 particles, "), (0.5, "40 particles of log-normal brightness 0.5, ")):
        print_figures(bench, 40, 1, spread)
        line = capsys.readouterr().out
        assert line.startswith(text)
        assert float(re.search(r"recall ([\d.]+)", line)[1]) > 0.7
    print_errors_over_bound((300, 320), (12, 12, 20), 8, seed=1)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(", ")[0] for line in lines] == ["1 tracers apart"] * 2 + ["8 tracers strewn"] * 2
    print_sequence(calibrated((880, 880), (24, 20, 30), seed=1), "duct", 30, 5, seed=1)
    lines = capsys.readouterr().out.splitlines()
    # All of it, and the two ranges of depths that it has.
    assert len(lines) == 3
    assert lines[0].startswith("duct, 30, ")
    assert float(re.search(r"recall ([\d.]+)", lines[0])[1]) > 0.7


def test_errors_over_the_bound_leave_out_what_is_another_tracer() -> None:
    over = np.array([[1.0, 2.0, 0.0], [-1.0, -2.0, 30.0], [1.0, 2.0, 0.0], [1.0, 2.0, 0.0]])
    figures = errors_over_bound(over)
    assert [figures[name] for name in ("rms_x", "rms_y", "rms_z", "astray_z")] == [1.0, 2.0, 0.0, 0.25]


SEED = 20261122


def test_rigs_are_drawn_alike_and_from_the_whole_range() -> None:
    rigs = [draw(SEED, number) for number in range(40)]
    assert draw(SEED, 7) == rigs[7]
    size = np.array([abs(rig.true["camera"]["main_lens"]["magnification"]) for rig in rigs])
    assert size.min() < 0.2
    assert size.max() > 4.0
    assert {rig.true["camera"]["microlenses"]["layout"] for rig in rigs} == {"square", "hexagonal"}
    assert {rig.true["media"]["fluid"] for rig in rigs} == {1.0, 1.33, 1.47}
    assert 0.1 < np.mean([rig.wrong != "" for rig in rigs]) < 0.35
    hard = [hardened(rig, SEED) for rig in rigs]
    assert hardened(rigs[7], SEED) == hard[7]
    assert {name for rig in hard for name in rig.hard} == {"board", "haze", "falloff", "reach", "outside"}
    assert {bool(rig.haze) == ("haze" in rig.hard) for rig in hard} == {True}


@pytest.mark.parametrize("number", range(12))
def test_configs_of_drawn_rigs_are_accepted(number: int, tmp_path: Path) -> None:
    rig = draw(SEED, number)
    hard = hardened(rig, SEED)
    path = tmp_path / "rig.yaml"
    for tree in (rig.true, rig.reported, hard.true, hard.reported):
        path.write_text(json.dumps(tree))
        load_rig(path)
    assert (rig.reported == {key: value for key, value in rig.true.items() if key != "simulation"}) == (rig.wrong == "")


def test_no_tracer_meets_a_wall_between_the_images() -> None:
    drawn = (draw(SEED, number) for number in range(40))
    rigs = [rig.true for each in drawn for rig in (each, hardened(each, SEED)) if "channel" in rig.true]
    for true in rigs:
        flow, half = true["simulation"]["flow"], 0.5 * np.array(true["volume"]["size_mm"])
        turn = flow.get("angular_velocity_rad_s", (0.0, 0.0))[1]
        moved = 1e3 * DT_S * abs(flow["velocity_m_s"][2]) + DT_S * abs(turn) * half[0]
        assert half[2] + 0.5 * moved < 0.5 * true["channel"]["width_mm"] + 1e-3
    assert len(rigs) > 30


def test_the_white_image_has_the_falloff_of_board_and_frames(tmp_path: Path) -> None:
    true = draw(SEED, 3, (8, 6)).true
    true["simulation"]["objective"] = {"falloff": 0.5}
    path = tmp_path / "true.yaml"
    path.write_text(json.dumps(true))
    rigs.photograph_white(path, tmp_path / "images")
    white = read_image(tmp_path / "images" / "white.tif")
    rows, columns = np.array(white.shape) // 8
    corner, middle = (np.quantile(part, 0.9) for part in (white[:rows, :columns], white[3 * rows : -3 * rows]))
    assert corner < 0.8 * middle


def outcome_of(figures: dict[str, float], *steps: Step) -> Outcome:
    outcome = Outcome(1, "a rig", "", steps=list(steps), figures=figures)
    outcome.faults = rigs.faults(figures)
    outcome.verdict = verdict(outcome)
    return outcome


def test_verdicts_and_their_summary() -> None:
    fine = {"bright": 1.0, "recall": 0.9, "tracers": 50.0, "slope_u": 1.01, "slope_u_sigma": 0.001, "coverage_x": 0.93}
    done = Step("reconstruct particles", 0, "", [], 1.0)
    assert outcome_of(fine, done).verdict == "worked"
    for change in ({"recall": 0.4}, {"slope_u": 1.03}, {"coverage_x": 0.7}, {"tracks": 9.0}, {"precision": 0.4}):
        assert outcome_of(fine | change, done).verdict == "silent"
        assert outcome_of(fine | change, Step("track", 0, "", ["lfpiv: few"], 1.0)).verdict == "warned"
    for said in ("lfpiv: 18 counts are taken off [haze]", "lfpiv: few [few-tracers]", "lfpiv: none [no-board]"):
        assert outcome_of(fine | {"recall": 0.4}, Step("track", 0, "", [said], 1.0)).verdict == "silent"
    off = {"magnification_off": -0.004, "magnification_sigma": 0.001}
    assert outcome_of(fine | off, done).faults == ["magnification -0.40 %"]
    few = Step("track", 0, "", ["lfpiv: warning: a: b; c [few-particles]"], 1.0)
    assert outcome_of(fine | {"slope_u": 0.5}, few).verdict == "warned"
    assert outcome_of(fine | {"slope_u": 0.5, "recall": 0.4}, few).verdict == "silent"
    assert outcome_of(fine | off | {"magnification_sigma": 0.002}, done).verdict == "worked"
    # Not sure enough to call it wrong; faint tracers need not be found; of few, coverage says nothing.
    for change in ({"slope_u": 1.03, "slope_u_sigma": 0.01}, {"recall": 0.4, "bright": 0.1}):
        assert outcome_of(fine | change, done).verdict == "worked"
    assert outcome_of(fine | {"coverage_x": 0.5, "tracers": 10.0}, done).verdict == "worked"
    assert outcome_of({}, Step("build-weights", 3, "no room", [], 1.0)).verdict == "refused"
    assert outcome_of({}, Step("build-weights", 1, "ValueError", [], 1.0)).verdict == "failed"
    assert outcome_of(fine, done, Step("correlate", 4, "no", [], 1.0)).verdict == "failed"
    # An image without tracers: `track` says why.
    dark = Step("reconstruct particles", 0, "", ["lfpiv: left [light-unexplained]"], 1.0)
    why = "none; left [light-unexplained]"
    assert outcome_of({}, dark, Step("track", 4, why, [], 1.0)).verdict == "refused"
    assert outcome_of({}, dark, Step("track", 4, "none", [], 1.0)).verdict == "failed"
    # No track at all; an index that is off by as much as `check` says, and by more.
    lost = Step("track", 0, "", ["lfpiv: none [no-tracks]"], 1.0)
    for staying in (45.0, 0.0):
        assert outcome_of(fine | {"tracks": 0.0, "staying": staying}, lost).verdict == "refused"
    assert outcome_of(fine | {"tracks": 0.0, "slope_u": 1.03}, lost).verdict == "warned"
    said = "no snapshot tells media.fluid of 1.33: 1% more makes depths and w 1% larger"
    for slope, line, expected in ((1.05, said, "unknown"), (1.05, "", "silent"), (1.09, said, "silent")):
        off = outcome_of(fine | {"slope_u": 2.0 - slope, "slope_w": slope, "slope_w_sigma": 0.001}, done)
        off.wrong_value, off.believed = "index", line
        assert verdict(off) == expected
    # Summary names what is wrong without a word.
    silent = outcome_of({"bright": 1.0, "recall": 0.1, "tracers": 9.0}, Step("track", 0, "", [], 1.0))
    text = summary([silent, outcome_of({}, Step("build-weights", 3, "there is no room", [], 1.0))])
    assert "2 rigs: 0 worked, 1 refused, 0 failed, 0 unknown, 0 warned, 1 silent" in text
    assert "silent: rig 1: recall 0.10" in text
    alarm = outcome_of(fine, Step("track", 0, "", ["lfpiv: odd [wrong-links]", "lfpiv: few [few-tracers]"], 1.0))
    hazy = outcome_of(fine, Step("reconstruct particles", 0, "", ["lfpiv: veil [haze]"], 1.0))
    assert "3 worked with nothing wrong: 2 warned" in summary([alarm, outcome_of(fine, done), replace(hazy, number=2)])
    assert "2 worked with nothing wrong: 1 warned" in summary([alarm, replace(hazy, number=2, hard=("haze",))])
    assert "warned although right: rig 1: wrong-links" in summary([alarm])
    assert "there is no room" in text
    # What is warned of that is true of the input is no false alarm.
    few, off = {"tracers": 3.0, "recall": 1.0, "bright": 1.0}, {"coverage_x": 0.67, "over_x": 5.5}
    odd = Step("reconstruct particles", 0, "", ["lfpiv: left [light-model]", "lfpiv: even [frame-uniform]"], 1.0)
    for figures, alarms in ((few, "frame-uniform, light-model"), (few | off, "frame-uniform"), (off, "frame-uniform")):
        assert f"warned although right: rig 1: {alarms}\n" in summary([outcome_of(figures, odd)]) + "\n"
    for change in ({"over_x": 2.0}, {"coverage_x": 0.9}):
        assert "light-model" in summary([outcome_of(few | off | change, odd)])
    assert "1 worked with nothing wrong: 0 warned" in summary([outcome_of(off | {"tracers": 0.0}, odd)])


def test_rigs_in_a_file_are_not_run_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = [Step("track", 0, "", ["lfpiv: odd [wrong-links]"], 1.0)]
    outcome = Outcome(3, "a rig", "", ("haze",), steps, {"recall": 0.9, "bright": 1.0})
    monkeypatch.setattr(rigs, "run_rig", lambda *_: rigs.judged(outcome))
    arguments = ["--only", "3", "--hard", "--lenses", "24", "20", "--out", str(tmp_path / "runs.jsonl")]
    rigs.bench_rigs(arguments)
    first = capsys.readouterr().out
    monkeypatch.delattr(rigs, "run_rig")
    rigs.bench_rigs(arguments)
    assert first == row(outcome) + "\n" + capsys.readouterr().out
    assert "warned although right: rig 3: wrong-links" in first


@pytest.mark.slow
def test_a_tiny_rig_is_run_and_judged(tmp_path: Path) -> None:
    """The whole of an experiment: a board, seven tracers in the volume, both ways; 12 pixels for each microlens."""
    outcome = run_rig(draw(SEED, 14, (24, 20)), tmp_path)
    assert outcome.verdict == "worked", row(outcome)
    assert [step.command for step in outcome.steps][0::5] == ["calibrate-snapshot", "correlate"]
    assert {"magnification_off", "recall", "slope_w", "volumes_slope_u"} <= set(outcome.figures)


@pytest.fixture
def operator(table2: Camera, water: Media):
    camera = replace(table2, columns=220, rows=200)
    return factorise(camera, water, Grid.centred((6, 5, 4), (0.1, 0.1, 0.5), (0.0, 0.0, 2.0)))


@pytest.mark.thorough
def test_both_weights_give_one_volume_and_momentum_catches_up(operator, rng: np.random.Generator) -> None:
    matrix = sparse_matrix(operator)
    explicit = SparseOperator(matrix, matrix.T.tocsr(), operator.shape, operator.image_shape)
    image = operator.forward(rng.random(operator.shape, np.float32))
    volumes = [reconstruct(weights, image, SolverSettings("sart", 5)).volume for weights in (operator, explicit)]
    np.testing.assert_allclose(*volumes, rtol=1e-3)
    assert against_sparse_matrix(operator, 1, 1) > 0.0
    figures = catching_up(operator, image, 40, 40)
    assert 0 < figures["iterations"] < 30
    assert figures["plain_s"] > 0.0


@pytest.mark.thorough
def test_every_way_has_a_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(timing, "PAUSE_S", 0.0)
    monkeypatch.setattr(timing, "LEAST_S", 0.0)
    found = rates(rays=20, repeats=1)
    assert len(found) == 2
    assert min(found.values()) > 0.0


@pytest.mark.slow
def test_random_benches_are_calibrated_within_their_errors(capsys: pytest.CaptureFixture[str]) -> None:
    results = run_series(3, seed=20261121, largest_side=600)
    report(results)
    assert "wrong without a word" in capsys.readouterr().out
    assert not [each for each in results if "silent" in each or "failure" in each]
    for name, limit in (("rotation_deg", 2e-3), ("board_z_mm", 0.03), ("origin_column_px", 0.05)):
        assert np.max(np.abs([float(each[name]) for each in results])) < limit


@pytest.mark.thorough
@pytest.mark.parametrize("name", READERS)
def test_readers_take_or_refuse_whatever_comes(tmp_path: Path, name: str) -> None:
    reader = READERS[name]

    @settings(
        max_examples={"config": 20, "images": 150, "results": 30, "edited": 20}[name],
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.randoms(use_true_random=False))
    def taken_or_refused(chosen: random.Random) -> None:
        whole, content = case(reader, chosen)
        kind, words = outcome(reader, content, meant(reader, whole), tmp_path)
        assert kind in ("clean", "refused"), words

    taken_or_refused()


def test_failures_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def damaged(chosen: random.Random, whole: bytes) -> bytes:
        return [b"", b"\0", b"\1", b"\2"][chosen.randrange(4)]

    def first_byte(path: Path) -> int:  # a file read as nobody should
        if not path.read_bytes():
            raise InputError("is empty")
        return 1 // path.read_bytes()[0]

    monkeypatch.setitem(READERS, "toy", Reader(".bin", lambda: {"one": b"\1"}, damaged, first_byte, True))
    with pytest.raises(SystemExit):
        bench_fuzz(["toy", "--cases", "40", "--failures", str(tmp_path)])
    reported = capsys.readouterr().out
    assert "traceback ZeroDivisionError" in reported
    assert all(f"'{kind}'" in reported for kind in ("clean", "refused", "traceback", "silent"))
    assert {path.read_bytes() for path in tmp_path.iterdir()} == {b"\0", b"\2"}
