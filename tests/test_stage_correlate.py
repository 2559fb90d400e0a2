"""The stage of `correlate`: masks, ensembles, derived fields and means, through files."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from benchmarks.volumes import Seeding, volume_pair
from lfpiv_cli import open_vectors
from lfpiv_cli.cli import cli
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import write_volume
from lfpiv_cli.flow.field import MASKED
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import Reference

CONFIG = Path(__file__).parent.parent / "configs" / "sample.yaml"
SHAPE = (30, 22, 40)
GRID = Grid.centred(SHAPE, (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
SHIFT = (0.9, -0.5, 0.3)
REFERENCE = Reference("mid_plane", 0.0)


def run(*arguments: object) -> None:
    cli.main([str(argument) for argument in arguments], standalone_mode=False)


@pytest.fixture(scope="module")
def volumes(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two pairs of volumes that move by SHIFT, and one of a mask that leaves out x < 0."""
    folder = tmp_path_factory.mktemp("volumes")
    rng = np.random.default_rng(5)
    made_by = record("test", load_config(CONFIG).resolved(), {})
    arrays = {}
    for number in range(2):
        pair = volume_pair(
            lambda points: np.tile(SHIFT, (len(points), 1)), SHAPE, Seeding(40.0, (1.0,) * 3, lost=0.2), rng
        )
        arrays |= {f"{name}{number}": volume for name, volume in zip("ab", pair, strict=True)}
    arrays["mask"] = np.broadcast_to(GRID.axis_mm(0) >= 0.0, GRID.shape_zyx).astype(np.float32)
    paths = []
    for name, array in arrays.items():
        paths.append(folder / f"{name}.vtkhdf")
        write_volume(paths[-1], array, GRID, REFERENCE, provenance=made_by, attributes={}, overwrite=False)
    return paths


def test_a_mask_volume_masks_its_windows(volumes: list[Path], tmp_path: Path) -> None:
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


def test_the_channel_s_walls_mask_what_lies_beyond(volumes: list[Path], tmp_path: Path) -> None:
    config = tmp_path / "narrow.yaml"
    text = CONFIG.read_text().replace("dt_s: 0.002", "dt_s: 0.002, mask: channel")
    config.write_text(text.replace("width_mm: 4.0", "width_mm: 2.0"))
    run("correlate", *volumes[:2], "--config", config, "-o", tmp_path / "v.vtkhdf")
    field = open_vectors(tmp_path / "v.vtkhdf")
    beyond = np.abs(field.grid.axis_mm(2)) > 1.4
    assert beyond.any()
    assert np.all(field.flag[beyond] == MASKED)
    assert np.all(field.flag[np.abs(field.grid.axis_mm(2)) < 0.9] != MASKED)


def test_an_ensemble_is_one_field_and_a_batch_has_a_mean(volumes: list[Path], tmp_path: Path, capsys) -> None:
    run("correlate", *volumes[:4], "--pairing", "ab", "--ensemble", "-o", tmp_path / "together.vtkhdf")
    together = open_vectors(tmp_path / "together.vtkhdf")
    folder, mean = tmp_path / "each", tmp_path / "mean.vtkhdf"
    capsys.readouterr()
    run("correlate", *volumes[:4], "--pairing", "ab", "--derived", "--mean", mean, "-o", folder, "--json")
    summary = json.loads(capsys.readouterr().out)
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


def test_a_mean_needs_pairs_of_their_own(volumes: list[Path], tmp_path: Path) -> None:
    for extra in ((*volumes[:2],), (*volumes[:4], "--pairing", "ab", "--ensemble")):
        with pytest.raises(UsageError, match="--mean"):
            run("correlate", *extra, "--mean", tmp_path / "m.vtkhdf", "-o", tmp_path / "v.vtkhdf")
