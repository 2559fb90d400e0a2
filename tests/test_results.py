"""What results do of themselves in Python: describe, save and draw themselves, and give labelled arrays and tables."""

import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import lfpiv_cli as lf
from lfpiv_cli.errors import OutputExistsError, UsageError
from lfpiv_cli.results import ArrayResult, Result
from lfpiv_cli.verbs.plot import figures_of
from lfpiv_cli.verbs.results import KINDS
from tests.written_files import WrittenFiles

# The kinds of files that are opened, and what opens them.
OPENED = {
    **dict.fromkeys(("calibration", "fitted rays", "refined calibration"), lf.open_calibration),
    **dict.fromkeys(
        ("weights", "weights without calibration", "weights on demand", "counted weights", "weights in strips"),
        lf.open_weights,
    ),
    "volume": lf.open_volume,
    "tracks on a grid": lf.open_vectors,
    **dict.fromkeys(("particles", "followed particles"), lf.open_particles),
    **dict.fromkeys(("tracks", "tracks of a sequence"), lf.open_tracks),
}


DERIVED = ("vorticity", "divergence", "strain_rate", "q_criterion")


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> WrittenFiles:
    """The files of a chain on a small rig."""
    return WrittenFiles(tmp_path_factory.mktemp("files"))


def inside(path: Path, *left_out: str) -> dict[str, Any]:
    """Return all datasets and attributes of a file, but for what HDF5 keeps itself and the sums over attributes."""
    found: dict[str, Any] = {}

    def take(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            found[name] = (item.dtype, item.shape, np.asarray(item).tobytes())
        for each, value in item.attrs.items():
            if each not in ("REFERENCE_LIST", "DIMENSION_LIST", "attributes_sha256", *left_out):
                found[f"{name}@{each}"] = repr(value)

    with h5py.File(path) as file:
        take("", file)
        file.visititems(take)
    return found


@pytest.mark.thorough
@pytest.mark.parametrize("kind", OPENED)
def test_what_is_opened_is_described_saved_and_drawn_as_its_file(
    files: WrittenFiles, kind: str, tmp_path: Path
) -> None:
    path, saved = files.path(kind), tmp_path / "saved.h5"
    result = OPENED[kind](path)
    said = repr(result).splitlines()
    assert len(said) == 2
    assert max(map(len, said)) < 180
    result.save(saved)
    assert inside(saved) == inside(path)
    with pytest.raises(OutputExistsError):
        result.save(str(saved))
    OPENED[kind](saved).save(str(saved), overwrite=True)
    assert inside(saved) == inside(path)
    figure = result.plot(list(figures_of(saved))[-1])
    assert len(figure.axes)
    with pytest.raises(UsageError, match="has the figures"):
        result.plot("nothing of the kind")


@pytest.mark.thorough
def test_what_functions_return_is_saved_as_commands_write_it(files: WrittenFiles, tmp_path: Path) -> None:
    volumes = [lf.open_volume(files.path(name)) for name in ("first volume", "volume")]
    particles = [lf.open_particles(files.path(name)) for name in ("first particles", "particles")]
    vectors, on_grid = (lf.open_vectors(files.path(name)) for name in ("vectors", "tracks on a grid"))
    tracks, pairs = lf.track(*particles), sorted(files.path("mean/vectors").iterdir())
    second = [lf.open_volume(files.path(f"volumes/frame_{number:04d}.vtkhdf")) for number in (1, 2)]
    made = {
        "mean/vectors/frame_0001.vtkhdf": lf.correlate(*second),
        "tracks": tracks,
        "tracks on a grid": tracks.vectors()[0],
        "combined vectors": lf.combine(vectors, on_grid),
        "statistics": lf.statistics(*map(lf.open_vectors, pairs)),
        "field": lf.fit_field(tracks, vectors),
    }
    assert lf.correlate(*volumes).provenance["config"] == vectors.provenance["config"]
    for kind, result in made.items():
        result.save(tmp_path / "saved.vtkhdf", overwrite=True)
        found, expected = (inside(path, "provenance") for path in (tmp_path / "saved.vtkhdf", files.path(kind)))
        # The command was asked for derived quantities, too.
        asked = {name for name in expected if name.rpartition("/")[2].startswith(("gradient_", *DERIVED))}
        assert found == {name: each for name, each in expected.items() if name not in asked}, kind
        assert bool(asked) == (kind in ("field", "mean/vectors/frame_0001.vtkhdf"))
        assert len(repr(result).splitlines()) == 2
    assert {type(each).__name__ for each in made.values()} < set(KINDS)
    # Statistics have the figures of theirs, a field those of vectors.
    assert len(made["statistics"].plot("convergence").axes) == 2
    assert made["field"].plot().axes


@pytest.mark.thorough
def test_arrays_are_labelled_and_tables_have_units(files: WrittenFiles) -> None:
    xarray = pytest.importorskip("xarray")
    for kind, opened in (("volume", lf.open_volume), ("tracks on a grid", lf.open_vectors)):
        found = opened(files.path(kind)).to_xarray()
        with xarray.open_dataset(files.path(kind), engine="h5netcdf") as stored:
            assert set(found) == set(stored)
            for name in stored:
                assert found[name].dims == stored[name].dims
                np.testing.assert_array_equal(found[name], stored[name])
                assert found[name].units == stored[name].attrs["units"]
                assert found[name].long_name
            np.testing.assert_array_equal(found.z, stored.z)
        assert found.attrs["reference"] == "mid_plane"
    tracks = lf.open_tracks(files.path("tracks"))
    table, labelled = tracks.to_pandas(), tracks.to_xarray()
    assert table.attrs["units"]["u"] == labelled.velocity.units == "m/s"
    assert table.attrs["long_name"]["link_probability"] == "probability that the link is right"
    np.testing.assert_array_equal(table[["u", "v", "w"]], tracks.arrays["velocity"])
    depths = labelled.displacement_covariance_mm2.sel(component_6="zz")
    np.testing.assert_array_equal(depths, tracks.arrays["displacement_covariance_mm2"][:, 2])
    grid = lf.open_vectors(files.path("tracks on a grid"))
    rows = grid.to_pandas()
    np.testing.assert_array_equal(rows["w"], grid.velocity[..., 2].ravel())
    np.testing.assert_allclose(rows[["x", "y", "z"]], grid.grid.centres_mm().reshape(-1, 3))


@pytest.mark.parametrize(("name", "extra"), [("xarray", "arrays"), ("pandas", "arrays"), ("matplotlib", "plot")])
def test_what_is_not_installed_is_named(name: str, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    volume = lf.correlate(*np.random.default_rng(1).random((2, 12, 12, 12)), voxel_mm=(0.1, 0.1, 0.1), windows=(6,))
    do = {"xarray": volume.to_xarray, "pandas": volume.to_pandas, "matplotlib": volume.plot}[name]
    with pytest.raises(lf.LfpivError, match=rf"{name}.*lfpiv\[{extra}\]"):
        do()


def test_each_result_has_its_kind() -> None:
    def under(kind: type) -> set[str]:
        return {kind.__name__}.union(*map(under, kind.__subclasses__()))

    assert under(Result) - {"Result", "ArrayResult"} == set(KINDS)
    assert {name for name, kind in KINDS.items() if kind.content} == under(ArrayResult) - {"ArrayResult"}
