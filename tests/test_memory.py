"""Too little memory: said before work begins, with the size that it needs, whatever sets the limit."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.errors import OutputError
from lfpiv_cli.files import inputs
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.vtkhdf import write_volume
from lfpiv_cli.flow.correlation import held_bytes
from lfpiv_cli.flow.windows import CorrelationSettings
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import FOCAL_POINT
from lfpiv_cli.validation.planning import depth_of_field_mm
from lfpiv_cli.verbs import planning
from tests.commands import AT_FOCUS, CONFIG, SAMPLE, sample_rig
from tests.hostile_files import ended
from tests.test_batches import QUICK

STATUS = "Name:\tpython\nVmSize:\t 1000000 kB\nVmRSS:\t 500000 kB\n"
PAIR = (SAMPLE / "pair_a.tif", SAMPLE / "pair_b.tif")


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A system that says how much memory there is: 10 GB on the machine, no other limit."""
    folder = tmp_path / "system"
    (folder / "self").mkdir(parents=True)
    (folder / "self" / "status").write_text(STATUS)
    (folder / "meminfo").write_text("MemTotal: 20000000 kB\nMemAvailable: 9000000 kB\nSwapFree: 1000000 kB\n")
    for name, place in (("PROCESS", "self"), ("MACHINE", "meminfo"), ("CONTROL_GROUPS", "groups")):
        monkeypatch.setattr(inputs, name, folder / place)
    monkeypatch.setattr(inputs, "address_space", lambda: None)
    return folder


def volume(path: Path, offset: int) -> Path:
    """Write an empty volume but for some particles."""
    grid = Grid.centred((16, 16, 16), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    array = np.zeros(grid.shape_zyx)
    array[4:12:4, 4:12:4, 4 + offset : 12 + offset : 4] = 1.0
    told = {"residual": np.ones(1), "excluded_pixels": 0, "support_voxels": 1}
    write_volume(path, array, grid, FOCAL_POINT, provenance={}, attributes=told, overwrite=False)
    return path


def test_each_limit_counts(system: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    inputs.ensure_room(10e9, "work")
    with pytest.raises(OutputError, match=r"work needs 11\.30 GB.* 10\.24 GB are left of this machine"):
        inputs.ensure_room(11e9, "work")
    monkeypatch.setattr(inputs, "address_space", lambda: 3_024_000_000)
    inputs.ensure_room(1.9e9, "work")
    with pytest.raises(OutputError, match=r"2\.00 GB are left of this process's address space"):
        inputs.ensure_room(2.1e9, "work")


@pytest.mark.parametrize(
    ("line", "file"),
    [("0::/jobs/7", "jobs/7/memory.max"), ("0::/jobs/7", "jobs/memory.max"), ("0::/jobs/7", "memory.max")]
    + [("9:memory:/jobs/7", f"memory/{place}memory.limit_in_bytes") for place in ("jobs/7/", "")],
)
def test_a_jobs_limit_holds_for_all_in_it(system: Path, line: str, file: str) -> None:
    (system / "self" / "cgroup").write_text(f"3:cpu:/other\n{line}\n")
    place = system / "groups" / file
    place.parent.mkdir(parents=True)
    place.write_text("max\n")
    inputs.ensure_room(3e9, "work")
    place.write_text("2512000000\n")
    inputs.ensure_room(1.9e9, "work")
    with pytest.raises(OutputError, match=r"2\.00 GB are left of this job's limit"):
        inputs.ensure_room(2.1e9, "work")


def test_other_systems_set_no_limit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("PROCESS", "MACHINE", "CONTROL_GROUPS"):
        monkeypatch.setattr(inputs, name, tmp_path / "none")
    monkeypatch.setattr(inputs, "address_space", lambda: None)
    inputs.ensure_room(1e18, "work")


def test_work_that_does_not_fit_is_not_begun(system: Path, tmp_path: Path, weights: Path, images: list[Path]) -> None:
    pair = volume(tmp_path / "a.vtkhdf", 0), volume(tmp_path / "b.vtkhdf", 1)
    target = tmp_path / "v.vtkhdf"
    command = ("correlate", *pair, "--config", CONFIG, "--dt-s", 0.001, "--windows", 8, "-o", target)
    (system / "meminfo").write_text("MemAvailable: 100 kB\n")
    code, said = ended(*command)
    assert code == 7
    assert "too little memory: correlate needs 0.30 GB" in said
    assert not target.exists()
    command = ("reconstruct", weights, images[0], *QUICK, "-o", tmp_path / "v.vtkhdf")
    for kilobytes, words in ((0, f"reading {weights} needs"), (1000, "reconstruct needs")):
        (system / "meminfo").write_text(f"MemAvailable: {kilobytes} kB\n")
        code, said = ended(*command)
        assert (code, words in said) == (7, True), said
    assert not (tmp_path / "v.vtkhdf").exists()


@pytest.mark.parametrize(
    ("shape", "windows", "overlap", "measured_mb"),
    [
        ((40, 40, 40), (24, 12), 0.5, 4),
        ((80, 80, 120), (24, 12), 0.5, 50),
        ((128, 128, 160), (24, 12), 0.5, 158),
        ((240, 200, 160), (24, 12), 0.5, 497),
        ((80, 80, 120), (16, 8), 0.75, 1382),
    ],
)
def test_a_correlation_takes_what_was_measured(
    shape: tuple[int, int, int], windows: tuple[int, int], overlap: float, measured_mb: float
) -> None:
    settings = CorrelationSettings([(n, n, n) for n in windows], (overlap, overlap, overlap))
    assert 1 / 1.3 < held_bytes(shape, settings) / 1e6 / measured_mb < 1.3


@pytest.mark.parametrize(
    ("old", "new", "words", "said_of"),
    [
        ("[30, 22, 40]", "[4000, 4000, 4000]", ("build-weights", "{rig}"), "4000 x 4000 x 4000 voxels needs 512.30"),
        ("[30, 22, 40]", "[4000, 4000, 4000]", ("run", "{rig}", *PAIR), "4000 x 4000 x 4000 voxels needs 512.30"),
        ("[30, 22, 40]", "[800, 800, 800]", ("run", "{rig}", *PAIR, "--method", "volumes"), "needs 16.70 GB"),
        ("columns: 600, rows: 448", "columns: 20000, rows: 20000", ("simulate", "white", "{rig}"), "needs 13.90 GB"),
        ("columns: 600, rows: 448", "columns: 20000, rows: 20000", ("simulate", "board", "{rig}"), "needs 13.90 GB"),
    ],
)
def test_work_that_does_not_fit_is_refused_before_any(
    system: Path, tmp_path: Path, old: str, new: str, words: tuple[object, ...], said_of: str
) -> None:
    rig, output = sample_rig(tmp_path, AT_FOCUS, (old, new)), tmp_path / "output"
    white = ("--white", SAMPLE / "white.tif") if words[0] == "run" else ()
    code, said = ended(*(str(word).format(rig=rig) for word in words), *white, "-o", output)
    assert (code, said_of in said, "10.24 GB are left of this machine" in said) == (7, True, True), said
    assert not output.exists()


@pytest.mark.thorough
def test_weights_that_the_disk_has_no_room_for_are_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(inputs.shutil, "disk_usage", lambda _: usage._replace(free=1_000))
    rig = sample_rig(tmp_path, AT_FOCUS)
    code, said = ended("build-weights", rig, "-o", tmp_path / "w.h5")
    assert (code, "w.h5: needs 0.00 GB, and 0.00 GB are free on the disk" in said) == (7, True), said


def test_a_volume_far_beyond_what_can_be_refocused_is_judged_at_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        planning.planning, "in_miniature", lambda _camera, _media, depths_mm, *_: asked.append(depths_mm)
    )
    monkeypatch.setattr(planning.planning, "errors_by_depth_mm", lambda *_: np.ones((len(asked[0]), 3)))
    settings = load_config(CONFIG).overridden("volume", reference="focal_point", shape_xyz=(4000, 4000, 4000))
    bench = planning.bench_of(settings, None)
    assert bench.errors_mm.shape == (planning.DEPTHS, 3)
    far = planning.FARTHEST_FIELDS * depth_of_field_mm(bench.camera, bench.media)
    assert bench.bounds_mm[2, 1] > far == pytest.approx(asked[0].max())
