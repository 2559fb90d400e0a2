"""Fixtures shared by all tests: cameras in both lattice kinds, media, weights and frames of the sample, the data."""

import os
from collections.abc import Callable
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.vtkhdf import write_volume
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window
from tests.commands import CONFIG, SAMPLE, sample_weights
from tests.written_files import WrittenFiles

# Magnification, focal length, aperture; microlenses' focal length and distance, their lattice; pixel, columns, rows.
TABLE2 = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 2352, 1768)


@pytest.fixture(params=["square", "hexagonal"])
def layout(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="session")
def table2() -> Camera:
    """The paper's camera."""
    return TABLE2


@pytest.fixture
def camera(layout: str) -> Camera:
    """The paper's camera with either kind of array."""
    return replace(TABLE2, lattice=Lattice.regular(0.1, layout))


@pytest.fixture(params=["air", "water behind a window"])
def media(request: pytest.FixtureRequest) -> Media:
    return Media() if request.param == "air" else Media(1.0, 1.49, 1.33)


@pytest.fixture(scope="session")
def water() -> Media:
    return Media(1.0, 1.49, 1.33)


@pytest.fixture
def window() -> Window:
    """The window of the paper's simulation: 98 mm in front of the lens, 2 mm thick."""
    return Window(98.0, 2.0)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260101)


@pytest.fixture
def one_thread() -> Callable[[], AbstractContextManager[None]]:
    """A context in which kernels run on one thread, for the bits that must not depend on their number."""

    @contextmanager
    def alone():
        threads = numba.get_num_threads()
        numba.set_num_threads(1)
        try:
            yield
        finally:
            numba.set_num_threads(threads)

    return alone


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory):
    """Weights of a small part of the sample's volume; their config lies beside them as `rig.yaml`."""
    small = ("shape_xyz: [30, 22, 40]", "shape_xyz: [8, 6, 12]"), ("iterations: 16", "iterations: 2")
    return sample_weights(tmp_path_factory.mktemp("weights"), *small)


@pytest.fixture(scope="session")
def raw():
    return read_image(SAMPLE / "pair_a.tif").astype(np.uint16)


@pytest.fixture
def images(tmp_path: Path, raw: NDArray[np.uint16]):
    """Three frames of the sample, each a little brighter than the one before."""
    paths = [tmp_path / f"f{number}.tif" for number in range(3)]
    for number, path in enumerate(paths):
        tifffile.imwrite(path, raw + np.uint16(number), compression="zlib")
    return paths


@pytest.fixture(scope="session")
def pairs(tmp_path_factory: pytest.TempPathFactory):
    """Two pairs of small volumes."""
    folder, rng = tmp_path_factory.mktemp("pairs"), np.random.default_rng(5)
    made = {"provenance": record("test", load_rig(CONFIG).resolved(), {}), "attributes": {}, "overwrite": False}
    grid = Grid.centred((12, 12, 12), (0.1,) * 3, (0.0,) * 3)
    paths = [folder / f"{name}.vtkhdf" for name in ("a0", "b0", "a1", "b1")]
    for path in paths:
        write_volume(path, rng.random((12, 12, 12)).astype(np.float32), grid, Reference("mid_plane", 0.0), **made)
    return paths


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory):
    """The files of a chain on a small rig, each made where it is first asked for."""
    return WrittenFiles(tmp_path_factory.mktemp("files"))


@pytest.fixture(scope="session")
def in_process():
    """The address of a scheduler with two workers in this process."""
    distributed = pytest.importorskip("distributed")
    local = {"n_workers": 2, "threads_per_worker": 1, "processes": False, "dashboard_address": None}
    with distributed.LocalCluster(**local) as cluster:
        yield cluster.scheduler_address


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of the experiment and the photographs, named by LFPIV_DATA."""
    folder = os.environ.get("LFPIV_DATA")
    if not folder:
        pytest.skip("LFPIV_DATA is not set: the experiment and the photographs are not here")
    return Path(folder)
