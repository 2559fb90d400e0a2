"""The Python interface: what is promised, and the chain on the sample, which gives what the commands write."""

from __future__ import annotations

import inspect
import pydoc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lfpiv_cli as lf
from lfpiv_cli.errors import ConfigError, InputError, UsageError
from lfpiv_cli.files.images import write_tiff
from tests.commands import CONFIG, SAMPLE, run

FEW = {"solver": "sart", "iterations": 2}


def image(name: str) -> np.ndarray:
    return lf.read_image(SAMPLE / f"{name}.tif")


def corner() -> np.ndarray:
    """Return a mask that leaves a part of the image, with few particles to look for."""
    mask = np.zeros((448, 600), np.uint8)
    mask[100:300, 150:400] = 1
    return mask


@pytest.fixture(scope="module")
def by_commands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of what the commands write."""
    out = tmp_path_factory.mktemp("commands")
    white, dark, board, *pair = (SAMPLE / f"{name}.tif" for name in ("white", "dark", "board", "pair_a", "pair_b"))
    pictures = ("--white", white, "--dark", dark, "--board", board)
    run("calibrate-snapshot", CONFIG, *pictures, "-o", out / "calibration.h5", "-q")
    run("build-weights", CONFIG, "--calibration", out / "calibration.h5", "-o", out / "weights.h5", "-q")
    few = ("--solver", "sart", "--iterations", 2)
    run("reconstruct", out / "weights.h5", *pair, "--dark", dark, *few, "-o", out / "volumes", "-q")
    volumes = [out / "volumes" / f"{path.stem}.vtkhdf" for path in pair]
    run("correlate", *volumes, "-o", out / "vectors.vtkhdf", "-q")
    write_tiff(out / "mask.tif", corner(), overwrite=False)
    searched = ("--dark", dark, "--mask", out / "mask.tif", "--solver", "particles")
    run("reconstruct", out / "weights.h5", *pair, *searched, "-o", out / "particles", "-q")
    particles = [out / "particles" / f"{path.stem}.vtkhdf" for path in pair]
    run("track", *particles, "--grid", "-o", out / "tracks.vtkhdf", "-q")
    return out


@pytest.mark.thorough
def test_calibration_and_weights_are_those_of_the_commands(by_commands: Path) -> None:
    rig = lf.load_rig(CONFIG)
    calibration = lf.calibrate(image("white"), image("board"), rig, dark=image("dark"))
    written = lf.open_calibration(by_commands / "calibration.h5")
    assert calibration.summary() == written.summary()
    np.testing.assert_array_equal(calibration.transmission, written.transmission)
    weights, stored = lf.build_weights(rig, calibration), lf.open_weights(by_commands / "weights.h5")
    volume = np.random.default_rng(1).random(weights.shape, dtype=np.float32)
    np.testing.assert_array_equal(weights.forward(volume), stored.forward(volume))
    assert weights.reference == stored.reference


@pytest.mark.thorough
def test_volumes_and_vectors_are_those_of_the_commands(by_commands: Path) -> None:
    weights = lf.open_weights(by_commands / "weights.h5")
    pair = [lf.reconstruct(weights, image(name), dark=image("dark"), **FEW) for name in ("pair_a", "pair_b")]
    for volume, name in zip(pair, ("pair_a", "pair_b"), strict=True):
        written = lf.open_volume(by_commands / "volumes" / f"{name}.vtkhdf")
        np.testing.assert_array_equal(volume.array, written.array)
        assert volume.grid == written.grid
        assert volume.attributes["residual"].tolist() == list(written.attributes["residual"])
    field, written_field = lf.correlate(*pair), lf.open_vectors(by_commands / "vectors.vtkhdf")
    np.testing.assert_array_equal(field.velocity, written_field.velocity)
    np.testing.assert_array_equal(field.uncertainty_voxel, written_field.uncertainty_voxel)
    # Plain arrays with the settings in the call: the same displacements.
    rig, arrays = lf.load_rig(CONFIG), [volume.array for volume in pair]
    settings = rig.resolved()["correlation"] | {"exponent": 1.0}
    plain = lf.correlate(*arrays, voxel_mm=pair[0].grid.spacing_mm, **settings)
    np.testing.assert_array_equal(plain.displacement_voxel, written_field.displacement_voxel)


@pytest.mark.thorough
def test_particles_and_tracks_are_those_of_the_commands(by_commands: Path) -> None:
    weights = lf.open_weights(by_commands / "weights.h5")
    found = [
        lf.find_particles(weights, image(name), dark=image("dark"), mask=corner()) for name in ("pair_a", "pair_b")
    ]
    for points, name in zip(found, ("pair_a", "pair_b"), strict=True):
        written = lf.open_particles(by_commands / "particles" / f"{name}.vtkhdf")
        np.testing.assert_array_equal(points.position_mm, written.position_mm)
        assert points.attributes == written.attributes
        for array in written.arrays:
            np.testing.assert_array_equal(points.arrays[array], written.arrays[array])
    tracks, written = lf.track(*found), lf.open_tracks(by_commands / "tracks.vtkhdf")
    np.testing.assert_array_equal(tracks.points.position_mm, written.position_mm)
    np.testing.assert_array_equal(tracks.points.arrays["velocity"], written.arrays["velocity"])
    on_grid, written_grid = tracks.vectors()[0], lf.open_vectors(by_commands / "tracks_grid.vtkhdf")
    np.testing.assert_array_equal(on_grid.velocity, written_grid.velocity)
    correlated = lf.open_vectors(by_commands / "vectors.vtkhdf")
    assert lf.combine(correlated, on_grid).field.flag.shape == correlated.flag.shape
    field = lf.fit_field(tracks, correlated)
    known = field.vectors().flag == 0
    assert known.any()
    nodes = on_grid.grid.centres_mm()[known]
    np.testing.assert_allclose(field.at(nodes), field.vectors().velocity[known], rtol=1e-9)
    with pytest.raises(InputError, match="times between frames differ: 0.002 and 0.005 s"):
        lf.fit_field(tracks, replace(correlated, dt_s=0.005))


@pytest.mark.thorough
def test_what_cannot_be_is_refused(by_commands: Path) -> None:
    weights, rig = lf.open_weights(by_commands / "weights.h5"), lf.load_rig(str(CONFIG))
    with pytest.raises(ConfigError, match="iteratoins"):
        lf.reconstruct(weights, image("pair_a"), iteratoins=3)
    with pytest.raises(UsageError, match="find_particles"):
        lf.reconstruct(weights, image("pair_a"), solver="particles")
    with pytest.raises(InputError, match="shape|pixels"):
        lf.reconstruct(weights, image("pair_a")[:-1])
    with pytest.raises(UsageError, match="sensor"):
        lf.calibrate(image("white")[:-1], None, rig)
    with pytest.raises(UsageError, match="voxel_mm"):
        lf.correlate(np.zeros((8, 8, 8)), np.zeros((8, 8, 8)))
    with pytest.raises(UsageError, match="two frames"):
        lf.track(lf.open_particles(by_commands / "particles" / "pair_a.vtkhdf"))


@pytest.mark.parametrize("name", sorted(set(lf.__all__) - {"__version__", "LfpivError", "LfpivWarning"}))
def test_what_is_promised_is_documented(name: str) -> None:
    function = getattr(lf, name)
    words = inspect.getdoc(function) or ""
    assert words.splitlines()[0].endswith((".", ":", ","))
    assert "Raises" in words
    for parameter in inspect.signature(function).parameters.values():
        assert parameter.annotation is not inspect.Parameter.empty


def test_help_names_all_that_is_promised() -> None:
    words = pydoc.plain(pydoc.render_doc(lf))
    for name in set(lf.__all__) - {"__version__", "LfpivError", "LfpivWarning"}:
        assert name in words
