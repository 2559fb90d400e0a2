"""`export`: what its formats have of their own; that each comes back to the last bit `test_matrix` holds."""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, netcdf_file

from lfpiv_cli.errors import InputError, OutputError, UsageError
from lfpiv_cli.files import export_formats as formats
from lfpiv_cli.files.export_formats import Content, columns_of, read_content
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, Points, write_points
from lfpiv_cli.files.vtkhdf import write_vectors, write_volume
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.names import ExportFormat
from lfpiv_cli.verbs.export import FORMATS
from tests.commands import run
from tests.vector_fields import points_of
from tests.written_files import same

GRID = Grid((4, 3, 2), (0.1, 0.3, 0.7), (-0.15, 1 / 3, 2.0))
REFERENCE = Reference("mid_plane", 0.1 + 0.2)
MADE = {"command": "correlate", "inputs": {"a": {"name": "a.tif", "sha256": "00"}}}


def write_field(path: Path, rng: np.random.Generator, grid: Grid = GRID, dt_s: float = 0.002) -> None:
    shape = grid.shape_zyx
    flag = np.zeros(shape, np.uint8)
    flag[0, 0, 0] = 3
    displacement = rng.normal(size=(*shape, 3))
    scalars = [rng.random(shape) for _ in range(3)]
    field = VectorField(grid, displacement, displacement + 0.1, *scalars, flag, None, (0.1, 0.1, 0.1), dt_s, (8, 8, 8))
    extra = {"vorticity": (rng.normal(size=(*shape, 3)), "1/s"), "divergence": (rng.normal(size=shape), "1/s")}
    write_vectors(path, field, REFERENCE, provenance=MADE, overwrite=False, extra=extra)


def five_of(name: str, rng: np.random.Generator) -> Points:
    """Return five points; in a sequence a track of three frames and one of two, and no light in frame 1."""
    arrays: dict[str, Any] = points_of(name, rng, 5).arrays
    if name == PARTICLES_FORMAT:
        arrays["flag"] = np.array([0, 1, 0, 0, 1], np.uint8)
    else:
        arrays["link_probability"][0] = np.nan
    if name == TRAJECTORIES_FORMAT:
        arrays |= {"track": np.array([0, 0, 0, 4, 4]), "frame": np.array([0, 2, 3, 2, 3])}
    return Points(rng.normal(size=(5, 3)), arrays, REFERENCE, {"dt_s": 0.002}, MADE)


def write_kind(kind: str, folder: Path, rng: np.random.Generator) -> Path:
    path = folder / f"{kind}.vtkhdf"
    if kind == "volume":
        array = rng.random(GRID.shape_zyx).astype(np.float32)
        reported = {"residual": np.array([1.0, 0.1]), "excluded_pixels": 3}
        write_volume(path, array, GRID, REFERENCE, provenance=MADE, attributes=reported, overwrite=False)
    elif kind == "vectors":
        write_field(path, rng)
    else:
        name = {"particles": PARTICLES_FORMAT, "tracks": TRACKS_FORMAT, "trajectories": TRAJECTORIES_FORMAT}[kind]
        write_points(path, name, five_of(name, rng), overwrite=False)
    return path


def exported(source: Path, to: ExportFormat) -> tuple[Path, Content]:
    """Return what `export` writes of a file, and what was in it."""
    run("export", source, "--to", to)
    return source.with_name(source.stem + FORMATS[to].ending), read_content(source)


def test_tecplot_is_understood_by_the_reader_of_vtk(tmp_path: Path, rng: np.random.Generator) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOGeometry")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    path, content = exported(write_kind("vectors", tmp_path, rng), "tecplot")
    reader = vtk.vtkTecplotReader()
    reader.SetFileName(str(path))
    reader.Update()
    zone = reader.GetOutput().GetBlock(0)
    # It keeps 32 bits.
    places, columns = vtk_to_numpy(zone.GetPoints().GetData()), columns_of(content)[0]
    np.testing.assert_allclose(places, np.stack([columns[axis] for axis in "xyz"], axis=1), rtol=1e-6)
    np.testing.assert_allclose(vtk_to_numpy(zone.GetPointData().GetArray("u")), columns["u"], rtol=1e-6)


def test_sequences_have_a_zone_or_a_step_for_each_frame_with_its_time(tmp_path: Path, rng: np.random.Generator) -> None:
    path, _ = exported(write_kind("trajectories", tmp_path, rng), "tecplot")
    zones = [line for line in path.read_text().splitlines() if line.startswith("ZONE")]
    assert zones == [
        'ZONE T="frame 0", STRANDID=1, SOLUTIONTIME=0.0, I=1, J=1, K=1, DATAPACKING=POINT',
        'ZONE T="frame 2", STRANDID=1, SOLUTIONTIME=0.004, I=2, J=1, K=1, DATAPACKING=POINT',
        'ZONE T="frame 3", STRANDID=1, SOLUTIONTIME=0.006, I=2, J=1, K=1, DATAPACKING=POINT',
    ]
    source = tmp_path / "trajectories.vtkhdf"
    run("export", source, "--to", "vtkhdf-series", "-o", tmp_path / "playback.vtkhdf")
    with h5py.File(tmp_path / "playback.vtkhdf") as file:
        assert file.attrs["format"] == b"lfpiv-playback"
        np.testing.assert_array_equal(file["VTKHDF/NumberOfPoints"], [1, 0, 2, 2])
        np.testing.assert_allclose(file["VTKHDF/Steps/Values"], [0.0, 0.002, 0.004, 0.006])


@pytest.mark.thorough
@pytest.mark.parametrize("planes", [1, 2])
def test_vtk_plays_vectors(planes: int, tmp_path: Path, rng: np.random.Generator) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    paths = [tmp_path / f"{number}.vtkhdf" for number in range(3)]
    grid = Grid((4, 3, planes), GRID.spacing_mm, GRID.origin_mm)
    for path in paths:
        write_field(path, rng, grid)
    run("export", *paths, "--to", "vtkhdf-series", "--step-s", "0.5", "-o", tmp_path / "series.vtkhdf")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "series.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 3
    for step, path in enumerate(paths):
        reader.SetStep(step)
        reader.Update()
        assert reader.GetTimeValue() == 0.5 * step
        image, content = reader.GetOutput(), read_content(path)
        assert (image.GetDimensions(), image.GetOrigin()) == ((4, 3, planes), grid.origin_mm)
        assert image.GetPointData().GetVectors().GetName() == "velocity"
        for name, array in content.arrays.items():
            same(vtk_to_numpy(image.GetPointData().GetArray(name)).reshape(array.shape), array)
    with h5py.File(tmp_path / "series.vtkhdf") as file:
        assert file.attrs["format"] == b"lfpiv-series"
        assert json.loads(file.attrs["provenance"])["inputs"]["file_0002"]["name"] == "2.vtkhdf"


@pytest.mark.thorough
def test_xarray_opens_vectors_of_several_times(tmp_path: Path, rng: np.random.Generator) -> None:
    xarray = pytest.importorskip("xarray")
    paths = [tmp_path / f"{number}.vtkhdf" for number in range(2)]
    for path in paths:
        write_field(path, rng)
    run("export", *paths, "--to", "netcdf", "--step-s", "0.25", "-o", tmp_path / "run.nc")
    with xarray.open_dataset(tmp_path / "run.nc") as found:
        assert found["u"].dims == ("z", "y", "x", "t")
        assert found["t"].values.tolist() == [0.0, 0.25]
        assert (found["u"].units, found["t"].units, found["x"].units) == ("m/s", "s", "mm")
        assert found.attrs["delta_t"] == 0.002
        for number, path in enumerate(paths):
            same(found["displacement_voxel"].values[:, :, :, number], read_content(path).arrays["displacement_voxel"])
        # One plane has what pivpy's schema asks for, its dimensions in that order.
        plane = found.isel(z=1)
        assert plane["u"].dims == plane["v"].dims == plane["chc"].dims == ("y", "x", "t")


@pytest.mark.thorough
def test_flowtracks_reads_the_tracks_of_a_sequence(tmp_path: Path, rng: np.random.Generator) -> None:
    flowtracks = pytest.importorskip("flowtracks.io")
    path, content = exported(write_kind("trajectories", tmp_path, rng), "mat")
    found = flowtracks.trajectories_mat(str(path))
    assert [track.trajid() for track in found] == [0, 4]
    assert [track.time().tolist() for track in found] == [[0, 2, 3], [2, 3]]
    # It converts mm to m.
    same(np.concatenate([track.pos() for track in found]), content.arrays["position_mm"] / 1000.0)
    velocity = np.concatenate([track.velocity() for track in found])
    np.testing.assert_allclose(velocity, content.arrays["velocity"], rtol=1e-15)


@pytest.mark.thorough
@pytest.mark.parametrize("name", [PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT])
def test_no_points_are_no_fault(name: str, tmp_path: Path, rng: np.random.Generator) -> None:
    full = five_of(name, rng)
    arrays = {each: array[:0] for each, array in full.arrays.items()}
    none = Points(np.empty((0, 3)), arrays, REFERENCE, full.attributes, MADE)
    write_points(tmp_path / "none.vtkhdf", name, none, overwrite=False)
    for to, each in FORMATS.items():
        if name in each.takes:
            run("export", tmp_path / "none.vtkhdf", "--to", to)
    with netcdf_file(tmp_path / "none.nc", mmap=False) as file:
        assert file.variables["position_mm"].shape == (0, 3)
    assert (tmp_path / "none.csv").read_text().splitlines()[-1].startswith("x,y,z,")
    assert loadmat(tmp_path / "none.mat")["position_mm"].shape == (0, 3)
    reader = pytest.importorskip("vtkmodules.vtkIOXML").vtkXMLPolyDataReader()
    reader.SetFileName(str(tmp_path / "none.vtp"))
    reader.Update()
    assert (reader.GetErrorCode(), reader.GetOutput().GetNumberOfPoints()) == (0, 0)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("changes", "words"),
    [({"grid": Grid((4, 3, 3), GRID.spacing_mm, GRID.origin_mm)}, "on Grid"), ({"dt_s": 0.003}, "'dt_s': 0.003")],
)
@pytest.mark.parametrize("to", ["netcdf", "vtkhdf-series"])
def test_times_that_do_not_belong_together_are_refused(
    to: ExportFormat, changes: list[tuple[str, str]], words: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    write_field(tmp_path / "a.vtkhdf", rng)
    write_field(tmp_path / "b.vtkhdf", rng, **changes)
    with pytest.raises(InputError, match=words):
        run("export", tmp_path / "a.vtkhdf", tmp_path / "b.vtkhdf", "--to", to, "-o", tmp_path / "all")
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("vectors vectors --to netcdf", "whose name -o has to say"),
        ("vectors vectors --to vti -o all.vti", "several go into netcdf, vtkhdf-series"),
        ("vectors --to vti --plane 2", "--plane 2: .* has 2 planes"),
        ("tracks --to csv --plane 0", "no planes"),
    ],
)
def test_what_formats_and_files_do_not_have_is_told(
    words: str, said: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    files = {kind: write_kind(kind, tmp_path, rng) for kind in ("vectors", "tracks")}
    with pytest.raises(UsageError, match=said):
        run("export", *(files.get(word, word) for word in words.split()))


@pytest.mark.parametrize(("limit", "to"), [("LARGEST_BYTES", "mat"), ("LARGEST_VARIABLE", "netcdf")])
def test_arrays_that_are_too_large_are_refused(
    limit, to: ExportFormat, tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = write_kind("volume", tmp_path, rng)
    monkeypatch.setattr(formats, limit, 40)
    with pytest.raises(OutputError, match="intensity has 96 bytes"):
        run("export", source, "--to", to)
    assert sorted(tmp_path.iterdir()) == [source]
