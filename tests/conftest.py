"""Fixtures shared by all tests: cameras in both lattice kinds, media with and without a window, the data folder."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest

from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window

TABLE2 = Camera(
    magnification=-1.0,
    focal_length_mm=100.0,
    aperture_mm=25.0,
    microlens_focal_length_mm=0.8,
    microlens_distance_mm=0.8,
    lattice=Lattice.regular(0.1),
    pixel_mm=0.0055,
    columns=2352,
    rows=1768,
)


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


@contextmanager
def _one_thread() -> Iterator[None]:
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        yield
    finally:
        numba.set_num_threads(threads)


@pytest.fixture
def one_thread() -> Callable[[], AbstractContextManager[None]]:
    """A context in which kernels run on one thread, for the bits that must not depend on their number."""
    return _one_thread


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """The folder of the experiment and the photographs, named by LFPIV_DATA."""
    folder = os.environ.get("LFPIV_DATA")
    if not folder:
        pytest.skip("LFPIV_DATA is not set: the experiment and the photographs are not here")
    return Path(folder)
