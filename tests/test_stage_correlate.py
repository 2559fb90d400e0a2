"""The stage of `correlate`: masks, ensembles, derived fields and means, through files."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from benchmarks.volumes import Seeding, volume_pair
from lfpiv_cli.errors import InputError, PartialError, UsageError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import open_vectors, read_header, write_volume
from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.field import MASKED
from lfpiv_cli.flow.windows import CorrelationSettings, WindowLayout, layout_windows
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.verbs import checks
from lfpiv_cli.verbs.checks import Quality, calibration_notices, field_notices, pair_notices, tracers_per_window
from tests.commands import CONFIG, run, sample_rig, told

SHAPE = (30, 22, 40)
GRID = Grid.centred(SHAPE, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
SHIFT = (0.9, -0.5, 0.3)
REFERENCE = Reference("mid_plane", 0.0)


def moved(
    folder: Path,
    shape: tuple[int, int, int] = SHAPE,
    spacing: tuple[float, float, float] = (0.1, 0.1, 0.1),
    seeding: Seeding = Seeding(40.0, (1.0,) * 3),  # noqa: B008
    number: int = 0,
    times_s: tuple[float, ...] = (),
) -> list[Path]:
    """Write a pair of volumes in which tracers move by SHIFT."""
    arrays = volume_pair(lambda at: np.tile(SHIFT, (len(at), 1)), shape, seeding, np.random.default_rng(5 + number))
    grid, paths = Grid.centred(shape, spacing, (0.0, 0.0, 0.0)), [folder / f"{name}{number}.vtkhdf" for name in "ab"]
    for k, (path, array) in enumerate(zip(paths, arrays, strict=True)):
        made_by = record("test", load_rig(CONFIG).resolved(), {})
        if times_s:
            made_by["inputs"] = {"image": {"name": "run.cine", "sha256": "x", "time_s": times_s[k]}}
        write_volume(path, array, grid, REFERENCE, provenance=made_by, attributes={}, overwrite=False)
    return paths


@pytest.fixture(scope="module")
def volumes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two pairs of volumes that move by SHIFT, and one of a mask that leaves out x < 0."""
    folder, seeding = tmp_path_factory.mktemp("volumes"), Seeding(40.0, (1.0,) * 3, lost=0.2)
    paths = [path for number in (0, 1) for path in moved(folder, seeding=seeding, number=number)]
    mask = np.broadcast_to(GRID.axis_mm(0) >= 0.0, GRID.shape_zyx).astype(np.float32)
    write_volume(folder / "mask.vtkhdf", mask, GRID, REFERENCE, provenance={}, attributes={}, overwrite=False)
    return [*paths, folder / "mask.vtkhdf"]


def test_masks_and_walls_leave_windows_out_and_a_mean_needs_pairs(volumes: list[Path], tmp_path: Path) -> None:
    run("correlate", *volumes[:2], "--mask", volumes[4], "-o", tmp_path / "v.vtkhdf")
    field = open_vectors(tmp_path / "v.vtkhdf")
    assert np.all(field.flag[:, :, field.grid.axis_mm(0) < -0.6] == MASKED)
    kept = field.displacement_voxel[:, :, field.grid.axis_mm(0) > 0.3]
    np.testing.assert_allclose(np.median(kept, axis=(0, 1, 2)), SHIFT, atol=0.05)
    other = tmp_path / "other.vtkhdf"
    grid = Grid.centred((3, 3, 3), (0.1,) * 3, (0.0,) * 3)
    write_volume(other, np.ones((3, 3, 3)), grid, REFERENCE, provenance={}, attributes={}, overwrite=False)
    with pytest.raises(InputError, match="other.vtkhdf: its grid"):
        run("correlate", *volumes[:2], "--mask", other, "-o", tmp_path / "w.vtkhdf")
    rig = sample_rig(tmp_path, ("dt_s: 0.002", "dt_s: 0.002, mask: channel"), ("width_mm: 4.0", "width_mm: 2.0"))
    run("correlate", *volumes[:2], "--config", rig, "-o", tmp_path / "narrow.vtkhdf")
    field = open_vectors(tmp_path / "narrow.vtkhdf")
    beyond = np.abs(field.grid.axis_mm(2)) > 1.4
    assert beyond.any()
    assert np.all(field.flag[beyond] == MASKED)
    assert np.all(field.flag[np.abs(field.grid.axis_mm(2)) < 0.9] != MASKED)
    for extra in ((*volumes[:2],), (*volumes[:4], "--pairing", "ab", "--ensemble")):
        with pytest.raises(UsageError, match="--mean"):
            run("correlate", *extra, "--mean", tmp_path / "m.vtkhdf", "-o", tmp_path / "v.vtkhdf")
    with pytest.raises(UsageError, match="-o: is missing"):
        run("correlate", *volumes[:2])


@pytest.mark.thorough
def test_an_ensemble_is_one_field(volumes: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("correlate", *volumes[:4], "--pairing", "ab", "--ensemble", "-o", tmp_path / "together.vtkhdf")
    together = open_vectors(tmp_path / "together.vtkhdf")
    folder, mean = tmp_path / "each", tmp_path / "mean.vtkhdf"
    summary = told(capsys, "correlate", *volumes[:4], "--pairing", "ab", "--derived", "--mean", mean, "-o", folder)
    each = [open_vectors(folder / f"a{number}.vtkhdf") for number in range(2)]
    expected = np.mean([field.displacement_voxel for field in each], axis=0)
    np.testing.assert_allclose(open_vectors(mean).displacement_voxel, expected, atol=1e-12)
    errors = [np.sqrt(np.nanmean((field.displacement_voxel - SHIFT) ** 2)) for field in (together, *each)]
    assert errors[0] < min(errors[1:])
    with h5py.File(mean) as file:
        assert file["velocity_rms"].attrs["units"] == b"m/s"
        assert file["velocity_rms"].shape == (*each[0].flag.shape, 3)
        assert np.all(file["samples"][...] == 2)
    with h5py.File(folder / "a0.vtkhdf") as file:
        assert file["vorticity"].shape == (*each[0].flag.shape, 3)
        assert summary["divergence_rms_per_s"] > 0.0
        assert "q_criterion" in file["VTKHDF/PointData"]
    # The fields are there: their mean is the same, with and without the options that pairs need.
    for number, extra in enumerate(((), ("--pairing", "ab", "-o", tmp_path / "unused"))):
        run("correlate", folder, "--derived", "--mean", tmp_path / f"{number}.vtkhdf", *extra)
        assert (tmp_path / f"{number}.vtkhdf").read_bytes() == mean.read_bytes()
    assert not (tmp_path / "unused").exists()


def warned(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[dict[str, Any], list[str]]:
    """Run correlate; return its summary and the codes of what it warns of."""
    summary = told(capsys, "correlate", *arguments, "--overwrite")
    return summary, [each["code"] for each in summary["warnings"]]


def test_the_summary_says_how_good_it_is(
    volumes: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary, codes = warned(capsys, *volumes[:4], "--pairing", "ab", "-o", tmp_path)
    fields = [open_vectors(tmp_path / f"a{number}.vtkhdf") for number in range(2)]
    assert codes == []
    assert summary["vectors"] == sum(field.flag.size for field in fields)
    sigma = [field.uncertainty_voxel for field in fields]
    known = [np.isfinite(each).all(axis=-1) & (field.flag < 3) for each, field in zip(sigma, fields, strict=True)]
    medians = [np.median(each[here], axis=0) for each, here in zip(sigma, known, strict=True)]
    np.testing.assert_allclose(summary["uncertainty_voxel_median"], np.median(medians, axis=0))
    finite = sum(np.count_nonzero(field.flag < 3) for field in fields)
    assert summary["without_uncertainty_share"] == pytest.approx(1.0 - sum(each.sum() for each in known) / finite)
    in_doubt = sum(np.count_nonzero((field.flag > 0) & (field.flag < 4)) for field in fields)
    assert summary["in_doubt_share"] == pytest.approx(in_doubt / summary["vectors"])


def test_windows_that_do_not_fit_and_few_tracers_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair = moved(tmp_path, (40, 40, 20), (0.1, 0.1, 0.4))
    output = ("-o", tmp_path / "v.vtkhdf")
    assert warned(capsys, *pair, "--windows", "32,16", *output)[1] == ["windows-too-large"]
    assert warned(capsys, *pair, "--windows", "32x32x16,16x16x8", *output)[1] == []
    pair = moved(tmp_path, seeding=Seeding(1.0, (1.0,) * 3), number=1)
    summary, codes = warned(capsys, *pair, "-o", tmp_path / "v.vtkhdf")
    assert "few-tracers" in codes
    assert open_vectors(tmp_path / "v.vtkhdf").flag.size == summary["vectors"]
    assert [each["code"] for each in read_header(tmp_path / "v.vtkhdf").provenance["warnings"]] == codes


def made_with(calibration: str, weights: str = "w") -> dict:
    return {
        "inputs": {"weights": {"sha256": weights}},
        "made_from": {weights: {"inputs": {"calibration": {"sha256": calibration}} if calibration else {}}},
    }


def test_volumes_that_are_no_pair_or_of_different_calibrations_are_told(rng: np.random.Generator) -> None:
    shape = (24, 24, 24)
    grid, settings = (
        Grid.centred(shape, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)),
        CorrelationSettings([(12, 12, 12)], (0.5,) * 3),
    )
    one, other = (gaussian_filter((rng.random(shape) < 0.01).astype(np.float32), 1.0) for _ in range(2))
    for pair, codes in (
        ((one, one), ["volumes-alike"]),
        ((one, np.roll(one, 1, axis=2)), []),
        ((one, other), ["volumes-unlike"]),
    ):
        field = correlate([pair], grid, settings)
        assert [each.code for each in pair_notices(field, checks.quality_of(field), "v")] == codes
    assert calibration_notices({"a": made_with("1"), "b": made_with("1", "x"), "c": {}}) == []
    assert calibration_notices({"a": {}, "b": {}}) == []
    for other in (made_with("2"), made_with("", "x")):
        (notice,) = calibration_notices({"a": made_with("1"), "b": other})
        assert notice.code == "other-calibration"
        assert notice.about == "b"
    good = Quality(100, 90, 9, 85, 8, np.ones((1, 3)))
    assert list(field_notices(good, "v")) == []
    assert [each.code for each in field_notices(replace(good, without=60), "v")] == ["no-uncertainty"]
    assert [each.code for each in field_notices(replace(good, in_doubt=60), "v")] == ["vectors-in-doubt"]
    nothing = checks.quality_of_all([]).summary()
    assert nothing == {"uncertainty_voxel_median": None, "without_uncertainty_share": None, "in_doubt_share": None}
    volume = np.zeros((10, 10, 10), np.float32)
    volume[1::3, 1::3, 1::3] = 1.0
    # Along each axis they lie at 1, 4 and 7; the window in the middle holds two of these.
    assert tracers_per_window(volume, layout_windows((10, 10, 10), (6, 6, 6), (0.0, 0.0, 0.0))) == 8.0
    # The first windows hold two, the last ones one: 8, three times 4, three times 2, and 1.
    assert tracers_per_window(volume, WindowLayout((6, 6, 6), (6, 6, 6), (2, 2, 2), (-1, -1, -1))) == 3.0


@pytest.mark.thorough
def test_a_lost_frame_costs_its_pair_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pair, folder = moved(tmp_path), tmp_path / "vectors"
    for name in ("a1", "a2", "b2", "b3", "a4", "b4"):
        shutil.copyfile(pair[name[0] == "b"], tmp_path / f"{name}.vtkhdf")
    left = sorted(tmp_path.glob("*[1-9].vtkhdf"))
    with pytest.raises(InputError, match=r"a1.vtkhdf: the second frame of its pair is missing, and 1 more"):
        run("correlate", *left, "--pairing", "ab", "-o", folder)
    assert not folder.exists()
    capsys.readouterr()
    failures = tmp_path / "failures.json"
    with pytest.raises(PartialError, match="2 of 4 pairs failed"):
        run("correlate", *left, "--pairing", "ab", "--keep-going", "--failures", failures, "-o", folder, "--json")
    warnings = json.loads(capsys.readouterr().out)["warnings"]
    assert [each["about"][-9:-7] for each in warnings if each["code"] == "frame-unpaired"] == ["a1", "b3"]
    assert [Path(each["name"]).stem for each in json.loads(failures.read_text())] == ["a1", "b3"]
    assert sorted(path.name for path in folder.iterdir()) == ["a2.vtkhdf", "a4.vtkhdf"]
    for path in folder.iterdir():
        field = open_vectors(path)
        np.testing.assert_allclose(np.median(field.displacement_voxel, axis=(0, 1, 2)), SHIFT, atol=0.1)
    (tmp_path / "pairs.txt").write_text("a2 b3\n")
    run("correlate", *left, "--pairs", tmp_path / "pairs.txt", "-o", tmp_path / "listed.vtkhdf")
    assert open_vectors(tmp_path / "listed.vtkhdf").flag.size


def test_a_stated_time_against_the_recorded_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("correlate", *moved(tmp_path, times_s=(0.5, 0.504)), "-o", tmp_path / "v.vtkhdf")
    assert "recorded 0.004 s apart, and 0.002 s are stated" in capsys.readouterr().err
