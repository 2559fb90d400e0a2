"""The weights' verbs given what does not fit: refused, as compiled loops would read beyond it."""

from __future__ import annotations

import multiprocessing
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import yaml

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.weights_file import WeightsFile, open_weights
from tests.hostile_files import ended

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"


def weights_of(folder: Path, layout: str, padding: int) -> WeightsFile:
    config = yaml.safe_load(SAMPLE.read_text())
    config["volume"] |= {"shape_xyz": [4, 3, 2], "reference": "focal_point"}
    config["camera"]["microlenses"]["layout"] = layout
    config["reconstruction"]["padding_voxel"] = [padding, padding, 0]
    (folder / "rig.yaml").write_text(yaml.safe_dump(config))
    assert ended("build-weights", folder / "rig.yaml", "-o", folder / "w.h5") == (0, "")
    return open_weights(folder / "w.h5")


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def weights(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> WeightsFile:
    """Factorised weights with padding, and those on demand without."""
    return weights_of(tmp_path_factory.mktemp("weights"), request.param, 2 if request.param == "square" else 0)


@pytest.mark.thorough
@pytest.mark.parametrize("shape", [(), (600,), (448, 1), (447, 600), (448, 601), (600, 448), (1, 448, 600)])
def test_images_of_another_shape_are_refused(weights: WeightsFile, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="does not fit weights made for"):
        weights.adjoint(np.ones(shape, np.float32))
    with pytest.raises(InputError, match="does not fit weights made for"):
        weights.weights.solver_operator.adjoint(np.ones(shape, np.float32))


@pytest.mark.parametrize("shape", [(), (4,), (3, 4), (1, 3, 4), (2, 3, 5), (4, 3, 2), (1, 2, 3, 4)])
def test_volumes_of_another_shape_are_not_stretched(weights: WeightsFile, shape: tuple[int, ...]) -> None:
    with pytest.raises(InputError, match="does not fit weights made for"):
        weights.forward(np.ones(shape, np.float32))
    with pytest.raises(InputError, match="does not fit weights made for"):
        weights.weights.solver_operator.forward(np.ones(shape, np.float32))


@pytest.mark.parametrize("kind", [complex, object, "U1"])
def test_what_is_no_real_number_is_refused(weights: WeightsFile, kind: type) -> None:
    for verb, shape in ((weights.forward, weights.shape), (weights.adjoint, weights.image_shape)):
        with pytest.raises(InputError, match="expected real numbers"):
            verb(np.zeros(shape, kind))
        with pytest.raises(InputError, match="expected real numbers"):
            verb(None)
    with pytest.raises(InputError, match="expected real numbers"):
        weights.prepare(np.zeros(weights.image_shape, complex))


@pytest.mark.parametrize("index", [(-1, 0, 0), (0, -1, 0), (0, 0, -1), (2, 0, 0), (0, 3, 0), (0, 0, 4)])
def test_voxels_outside_the_volume_have_no_column(weights: WeightsFile, index: tuple[int, int, int]) -> None:
    with pytest.raises(IndexError, match="outside a volume"):
        weights.column(*index)
    with pytest.raises(TypeError):
        weights.column(0.5, 0, 0)


@pytest.mark.thorough
def test_whole_numbers_and_lists_are_taken(weights: WeightsFile) -> None:
    volume = np.ones(weights.shape, np.int64)
    np.testing.assert_array_equal(weights.forward(volume.tolist()), weights.forward(volume.astype(np.float32)))


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="workers are not forked")
def test_a_forked_worker_says_that_it_has_lost_its_threads(tmp_path: Path) -> None:
    found = weights_of(tmp_path, "square", 0)
    volume = np.ones(found.shape, np.float32)
    found.forward(volume)
    if numba.threading_layer() != "omp":
        pytest.skip("these threads outlive a fork, or begin anew")
    with multiprocessing.get_context("fork").Pool(1) as pool:
        waiting = pool.apply_async(found.forward, [volume])
        with pytest.raises(UsageError, match="spawn"):
            waiting.get(10.0)
