"""The files that commands write on a small rig, each kind once; and exports read back by other programs."""

import csv
import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.io import loadmat, netcdf_file

from lfpiv_cli.files.export_formats import Content, columns_of
from lfpiv_cli.files.export_vtk import SHOWN
from lfpiv_cli.files.particle_file import POSITION
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT
from lfpiv_cli.flow.field import REJECTED
from tests.commands import ended

# The shipped sample on a quarter of its sensor and in half its depth, six frames long.
RIG = """
camera:
  main_lens:   {magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}
  microlenses: {focal_length_mm: 0.8, pitch_mm: 0.1, layout: square}
  sensor:      {pixel_um: 5.5, columns: 300, rows: 224, microlens_distance_mm: 0.8, column_axis: x}
media:   {air: 1.0, window: 1.49, fluid: 1.33, fluid_density_kg_m3: 998.0, fluid_viscosity_pa_s: 0.001}
channel: {width_mm: 2.0, wall_mm: 2.0}
board:   {dots: [3, 3], spacing_mm: 0.4, dot_diameter_mm: 0.15, thickness_mm: 0.0, medium: air, polarity: bright}
volume:  {shape_xyz: [14, 10, 20], voxel_mm: 0.1, centre_mm: [0, 0, 0], reference: mid_plane}
reconstruction: {solver: em, iterations: 16, accelerate: true, particle_diameter_mm: 0.05}
correlation:    {windows: [6], overlap: 0.5, dt_s: 0.002}
simulation:
  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}
  particles: 80
  particle_diameter_mm: 0.05
  board_z_mm: 2.2
  rotation_deg: 0.3
  shift_px: [2.5, -1.5]
  frames: 6
  seed: 3
validation:
  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}
"""
SCENE = """scene:
  - {kind: cylinder, axis: x, radius_mm: 7.0, centre_mm: [0, 0, 0], behind: window}
  - {kind: cylinder, axis: x, radius_mm: 5.0, centre_mm: [0, 0, 0], behind: fluid}
"""
# What a person writes, by the name of the file: rigs for the weights of each kind, and points to ask a field at. The
# name of the first stands in every record, and has what not every format holds as it is.
BY_HAND = {
    "rig ü&.yaml": RIG,
    "plain.yaml": RIG.replace("mid_plane", "focal_point"),
    "counted.yaml": RIG.replace("[14, 10, 20]", "[3, 3, 3]")
    + "weights: {sampling: rays, points: 20, rays_per_point: 100}\n",
    "fluid_board.yaml": RIG.replace("medium: air", "medium: fluid"),
    "curved.yaml": re.sub("channel:.*\n", "", RIG).replace("mid_plane", "focal_point") + SCENE,
    "points.csv": "x,y,z\n0.1,0.0,0.2\n0.0,0.1,0.0\n",
}
PHOTOGRAPHS = "--white {white image} --dark {dark image}"
FRAMES = " ".join(f"{{simulated/frame_{number:04d}.tif}}" for number in range(6))
FOUND = " ".join(f"{{particles/frame_{number:04d}.vtkhdf}}" for number in range(6))
BOARDS = " ".join(f"--board {{boards/board_{depth}mm.tif}} --depth-mm {depth}" for depth in ("-0.6", "+0", "+0.6"))
# How the folders of files are written, a folder for each command: `{}` stands for it, names in braces for files.
STEPS = {
    "schema": "init --schema -o {}/rig.schema.json",
    "again": "init --from {calibration} -o {}/again.yaml",
    "white": "simulate white {rig} -o {}",
    "board": "simulate board {rig} -o {}",
    "boards": "simulate board {fluid_board.yaml} --depth-mm -0.6 --depth-mm 0 --depth-mm 0.6 -o {}",
    "simulated": "simulate particles {rig} -o {}",
    "calibration": f"calibrate-snapshot {{rig}} {PHOTOGRAPHS} --board {{board image}} -o {{}}/calibration.h5 "
    "--picture {}/calibration.png",
    "fitted": f"calibrate-snapshot {{fluid_board.yaml}} {PHOTOGRAPHS} {BOARDS} -o {{}}/fitted.h5",
    "refined": "refine-calibration {rig} {simulated/frame_0000.tif} {simulated/frame_0001.tif} "
    "--calibration {calibration} --dark {dark image} -o {}/refined.h5",
    "weights": "build-weights {rig} --calibration {calibration} -o {}/weights.h5",
    "plain": "build-weights {plain.yaml} -o {}/plain.h5",
    "on_demand": "build-weights {fluid_board.yaml} --calibration {fitted rays} --method dlfc -o {}/on_demand.h5",
    "counted": "build-weights {counted.yaml} --calibration {calibration} -o {}/counted.h5",
    "strips": "build-weights {curved.yaml} -o {}/strips.h5",
    "volumes": f"reconstruct {{weights}} {FRAMES} --dark {{dark image}} -o {{}}",
    "particles": f"reconstruct {{weights}} {FRAMES} --dark {{dark image}} --solver particles -o {{}}",
    "vectors": "correlate {first volume} {volume} --derived -o {}/vectors.vtkhdf",
    "mean": "correlate {volumes/frame_0000.vtkhdf} {volumes/frame_0001.vtkhdf} {volumes/frame_0002.vtkhdf} "
    "--pairing sequence --derived --mean {}/mean.vtkhdf -o {}/vectors",
    "statistics": "statistics {mean/vectors} -o {}/statistics.vtkhdf",
    "tracks": "track {first particles} {particles} --grid -o {}/tracks.vtkhdf",
    "sequence": f"track {FOUND} -o {{}}/sequence.vtkhdf",
    "combined": "combine {vectors} {tracks on a grid} -o {}/combined.vtkhdf",
    "field": "field {tracks} {vectors} --derived --at {points.csv} -o {}/field.vtkhdf",
    "followed": f"follow {{weights}} {FRAMES} --dark {{dark image}} -o {{}}",
    "pressure": "field {followed tracks} --pressure {followed/particles} -o {}/pressure.vtkhdf",
    "run": "run {rig} {simulated/frame_0000.tif} {simulated/frame_0001.tif} --white {white image} "
    "--dark {dark image} --board {board image} --method both -o {}",
    "judged": "validate flow {rig} --vectors {vectors} -o {}",
    "drawn": "plot {volume} -o {}/volume.pdf",
    "exported_volumes": "export {first volume} {volume} --to vtkhdf-series -o {}/volumes_series.vtkhdf",
    "exported": "export {vectors} --to netcdf -o {}/vectors.nc",
    "exported_mat": "export {tracks} --to mat -o {}/tracks.mat",
    "exported_csv": "export {tracks} --to csv -o {}/tracks.csv",
    "exported_text": "export {vectors} --to tecplot -o {}/vectors.dat",
    "exported_image": "export {vectors} --to vti -o {}/vectors.vti",
    "exported_points": "export {tracks} --to vtp -o {}/tracks.vtp",
}
# The kinds of files: where each lies, in the folder of the step that writes it.
KINDS = {
    "rig": "rig ü&.yaml",
    "rig by init": "again/again.yaml",
    "schema": "schema/rig.schema.json",
    "white image": "white/white.tif",
    "dark image": "white/dark.tif",
    "board image": "board/board.tif",
    "frame": "simulated/frame_0001.tif",
    "residual image": "particles/frame_0001_residual.tif",
    "truth": "simulated/particles.npz",
    "figures of truth": "simulated/particles.json",
    "calibration": "calibration/calibration.h5",
    "fitted rays": "fitted/fitted.h5",
    "refined calibration": "refined/refined.h5",
    "weights": "weights/weights.h5",
    "weights without calibration": "plain/plain.h5",
    "weights on demand": "on_demand/on_demand.h5",
    "counted weights": "counted/counted.h5",
    "weights in strips": "strips/strips.h5",
    "volume": "volumes/frame_0001.vtkhdf",
    "vectors": "vectors/vectors.vtkhdf",
    "mean vectors": "mean/mean.vtkhdf",
    "statistics": "statistics/statistics.vtkhdf",
    "tracks on a grid": "tracks/tracks_grid.vtkhdf",
    "combined vectors": "combined/combined.vtkhdf",
    "field": "field/field.vtkhdf",
    "field with pressure": "pressure/pressure.vtkhdf",
    "particles": "particles/frame_0001.vtkhdf",
    "followed particles": "followed/particles/frame_0001.vtkhdf",
    "tracks": "tracks/tracks.vtkhdf",
    "tracks of a sequence": "sequence/sequence.vtkhdf",
    "followed tracks": "followed/tracks.vtkhdf",
    "playback": "followed/playback.vtkhdf",
    "series": "exported_volumes/volumes_series.vtkhdf",
    "run.json": "run/run.json",
    "report": "run/report.html",
    "flow.json": "judged/flow.json",
    "picture": "calibration/calibration.png",
    "pages": "drawn/volume.pdf",
    "values at points": "field/field_at.csv",
    "NetCDF": "exported/vectors.nc",
    "MAT": "exported_mat/tracks.mat",
    "CSV": "exported_csv/tracks.csv",
    "Tecplot": "exported_text/vectors.dat",
    "VTK image": "exported_image/vectors.vti",
    "VTK points": "exported_points/tracks.vtp",
}
# Files that kinds are used together with.
OTHERS = {
    "first frame": "simulated/frame_0000.tif",
    "third frame": "simulated/frame_0002.tif",
    "first volume": "volumes/frame_0000.vtkhdf",
    "first particles": "particles/frame_0000.vtkhdf",
}


class WrittenFiles:
    """The files of a chain in a folder, each written when it is asked for."""

    def __init__(self, folder: Path) -> None:
        """Take an empty folder, and write into it what a person does."""
        self.folder = folder
        for name, text in BY_HAND.items():
            (folder / name).write_text(text)

    def path(self, name: str) -> Path:
        """Return the file of a kind, or at a place in the folder; the command that writes it is run once."""
        place = (KINDS | OTHERS).get(name, name)
        step = place.split("/")[0]
        if step in STEPS and not (self.folder / step).exists():
            words = self.words(STEPS[step], self.folder / f"{step}.part")
            (self.folder / f"{step}.part").mkdir()
            code, said = ended(*words, "-q")
            assert code == 0, (words, said)
            shutil.move(self.folder / f"{step}.part", self.folder / step)
        return self.folder / place

    def words(self, command: str, place: Path | str) -> list[str]:
        """Return the words of a command, with files in place of their names in braces, and `place` of `{}`."""

        def filled(word: re.Match[str]) -> str:
            return shlex.quote(str(self.path(word[1]) if word[1] else place))

        return shlex.split(re.sub(r"\{(.*?)\}", filled, command))


def same(found: np.ndarray, expected: np.ndarray) -> None:
    """Assert that two arrays are the same to the last bit, in floating point also by type."""
    if expected.dtype.kind == "f":
        assert found.dtype.newbyteorder("=") == expected.dtype
    assert np.array_equal(found, expected, equal_nan=expected.dtype.kind == "f")


def ensure_record(text: str, content: Content) -> None:
    """Assert that a record is that of the export, with the record of what was exported in it."""
    made = json.loads(text)
    assert made["command"].startswith("export ")
    assert {name: value for name, value in content.provenance.items() if name != "made_from"} in made[
        "made_from"
    ].values()


def by_hdf5(path: Path, content: Content) -> None:
    """Assert that the content is all that is in a file of ours, but for tables, which are groups (of statistics)."""
    with h5py.File(path) as file:
        arrays = {name for name, member in file.items() if isinstance(member, h5py.Dataset)}
        assert set(content.arrays) == arrays - {"x", "y", "z", "component"}
        for name, array in content.arrays.items():
            same(array, file[name][()])
            assert content.units[name] == file[name].attrs["units"].decode()


def by_netcdf(path: Path, content: Content) -> None:
    with netcdf_file(path, mmap=False) as file:
        ensure_record(file.provenance.decode(), content)
        assert file.format.decode() == content.format_name
        assert file.reference_z_mm.item() == content.attributes["reference_z_mm"]
        found = {name: variable[...].copy() for name, variable in file.variables.items()}
        units = {name: variable.units.decode() for name, variable in file.variables.items()}
    if content.grid is not None:
        for k, axis in enumerate("xyz"):
            same(found[axis], content.grid.axis_mm(k))
    of_vectors = content.format_name == VECTORS_FORMAT
    for name, array in content.arrays.items():
        if name == "velocity" and of_vectors:
            same(np.stack([found[each][..., 0] for each in "uvw"], axis=-1), array)
            continue
        same(found[name][:, :, :, 0] if of_vectors else found[name], array)
        assert units[name] == content.units[name]
    if of_vectors:
        same(found["chc"][..., 0], (content.arrays["flag"] < REJECTED).astype(np.uint8))


def by_matlab(path: Path, content: Content) -> None:
    assert path.read_bytes()[:128].startswith(b"MATLAB 5.0 MAT-file, written by lfpiv  ")
    found = loadmat(path)
    ensure_record(found["provenance"].item(), content)
    assert found["reference_z_mm"].item() == content.attributes["reference_z_mm"]
    for name, array in content.arrays.items():
        same(found[name].reshape(array.shape), array)
        assert found["units"][name].item().item() == content.units[name]


def by_csv(path: Path, content: Content) -> None:
    lines, units = _without_comments(path, content)
    head, *rows = csv.reader(lines)
    _ensure_columns(head, rows, units, content)


def by_tecplot(path: Path, content: Content) -> None:
    lines, units = _without_comments(path, content)
    names = next(line for line in lines if line.startswith("VARIABLES"))
    rows = [line.split() for line in lines if line[0] in "-0123456789n"]
    # The rows of a sequence stand in the order of its frames.
    order = np.argsort(content.arrays["frame"], kind="stable") if "frame" in content.arrays else None
    _ensure_columns(names.split('"')[1::2], rows, units, content, order)


def _without_comments(path: Path, content: Content) -> tuple[list[str], dict[str, str]]:
    """Return the lines of a text but for its comments, and the units that these say."""
    lines = path.read_text(encoding="utf-8").splitlines()
    comments = [line.removeprefix("# ") for line in lines if line.startswith("#")]
    ensure_record("".join(comments[comments.index("provenance:") + 1 : -1]), content)
    return [line for line in lines if not line.startswith("#")], json.loads(comments[-1].removeprefix("units: "))


def _ensure_columns(
    head: list[str], rows: list[list[str]], units: dict[str, str], content: Content, order: np.ndarray | None = None
) -> None:
    expected, _ = columns_of(content)
    assert head == list(expected) == list(units)
    assert (units["x"], units.get("u", "m/s")) == ("mm", "m/s")
    found = dict(zip(head, np.array(rows).reshape(-1, len(head)).T, strict=True))
    for name, column in expected.items():
        same(found[name].astype(column.dtype), column if order is None else column[order])


def by_vtk(path: Path, content: Content) -> None:
    vtk = pytest.importorskip("vtkmodules.vtkIOXML")
    from vtkmodules.util.numpy_support import vtk_to_numpy

    reader = vtk.vtkXMLPolyDataReader() if content.grid is None else vtk.vtkXMLImageDataReader()
    reader.SetFileName(str(path))
    reader.Update()
    assert reader.GetErrorCode() == 0
    data = reader.GetOutput()
    reported = data.GetFieldData()
    ensure_record(reported.GetAbstractArray("provenance").GetValue(0), content)
    assert reported.GetArray("reference_z_mm").GetValue(0) == content.attributes["reference_z_mm"]
    if content.grid is not None:
        place = data.GetDimensions(), data.GetOrigin(), data.GetSpacing()
        assert place == (content.grid.shape_xyz, content.grid.origin_mm, content.grid.spacing_mm)
    for name, array in content.arrays.items():
        stored = data.GetPoints().GetData() if name == POSITION else data.GetPointData().GetArray(name)
        same(vtk_to_numpy(stored).reshape(array.shape), array)
    if content.grid is None:
        count = len(content.arrays[POSITION])
        assert data.GetNumberOfVerts() == count
        lines = [data.GetCell(count + k).GetNumberOfPoints() for k in range(data.GetNumberOfLines())]
        lengths = (
            np.unique(content.arrays["track"], return_counts=True)[1].tolist() if "track" in content.arrays else []
        )
        assert lines == lengths


def vtk_opened(path: Path) -> Any:
    """Return VTK's reader of its own HDF5 files, which has read a file."""
    vtk = pytest.importorskip("vtkmodules.vtkIOHDF")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader


def by_playing(path: Path, content: Content) -> None:
    reader = vtk_opened(path)
    from vtkmodules.util.numpy_support import vtk_to_numpy

    frames = content.arrays.get("frame", np.zeros(1, int))
    assert reader.GetNumberOfSteps() == frames.max() + 1
    for step in range(reader.GetNumberOfSteps()):
        reader.SetStep(step)
        reader.Update()
        here = ... if content.grid is not None else np.flatnonzero(frames == step)
        data = reader.GetOutput().GetPointData()
        for name in content.arrays if content.grid is not None else SHOWN:
            array = content.arrays[name][here]
            same(vtk_to_numpy(data.GetArray(name)).reshape(array.shape), array)
    with h5py.File(path) as file:
        ensure_record(file.attrs["provenance"], content)


READERS = {
    "netcdf": by_netcdf,
    "tecplot": by_tecplot,
    "csv": by_csv,
    "mat": by_matlab,
    "vti": by_vtk,
    "vtp": by_vtk,
    "vtkhdf-series": by_playing,
}
