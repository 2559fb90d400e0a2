"""`export`: results in the formats of other programs, nothing rounded."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import atomic, export_vtk, provenance
from lfpiv_cli.files import export_formats as formats
from lfpiv_cli.files.export_formats import Content, read_content, write_netcdf
from lfpiv_cli.files.particle_file import TRAJECTORIES_FORMAT
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import ExportFormat


@dataclass(frozen=True)
class Format:
    """A format: what follows the stem of its files, and what it takes.

    Attributes
    ----------
    ending : of the file's name
    takes : names of our formats
    several : of these, those of which several times go into one file
    write : writes one file; None where `export` says how, as times or records come into it
    """

    ending: str
    takes: tuple[str, ...]
    several: tuple[str, ...] = ()
    write: Callable[[Path, Content], None] | None = None


# A volume has millions of voxels: as rows of text it serves nobody.
FORMATS: dict[ExportFormat, Format] = {
    "netcdf": Format(".nc", formats.ON_GRIDS + formats.OF_POINTS, several=(VECTORS_FORMAT,)),
    "tecplot": Format(".dat", formats.ON_GRIDS + formats.OF_POINTS, write=formats.write_tecplot),
    "csv": Format(".csv", (VECTORS_FORMAT, *formats.OF_POINTS), write=formats.write_csv),
    "mat": Format(".mat", formats.ON_GRIDS + formats.OF_POINTS, write=formats.write_mat),
    "vti": Format(".vti", formats.ON_GRIDS, write=export_vtk.write_vti),
    "vtp": Format(".vtp", formats.OF_POINTS, write=export_vtk.write_vtp),
    "vtkhdf-series": Format("_series.vtkhdf", (*formats.ON_GRIDS, TRAJECTORIES_FORMAT), several=formats.ON_GRIDS),
}


def ensure_fits(path: Path, format_name: str, to: ExportFormat, count: int) -> None:
    """Refuse what a format does not take, with the formats that do.

    Parameters
    ----------
    path, format_name : of the first file and of what it holds
    count : how many files there are

    Raises
    ------
    InputError : the format takes no such file
    UsageError : it takes one at a time
    """
    kind, fitting = formats.KINDS[format_name], [name for name, each in FORMATS.items() if format_name in each.takes]
    if to not in fitting:
        raise InputError(f"{path}: holds {kind}, which {to} does not take; {', '.join(fitting)} do")
    if count > 1 and format_name not in FORMATS[to].several:
        fitting = [name for name, each in FORMATS.items() if format_name in each.several]
        where = f"several go into {', '.join(fitting)}" if fitting else "give one file at a time"
        raise UsageError(f"{path}: holds {kind}, of which {to} takes one file, got {count}; {where}")


# What the files of several times have to agree in, besides grid and arrays.
SHARED = ("reference", "reference_z_mm", "dt_s", "voxel_mm", "window_voxel")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """What `export` is given besides the files.

    Attributes
    ----------
    to : the format
    plane : of vectors or a volume only this plane across z, counted from 0
    step_s : time from one file to the next; where None they are numbered
    """

    to: ExportFormat
    plane: int | None = None
    step_s: float | None = None


def export(
    files: Sequence[Path],
    output: Path | None,
    options: ExportOptions,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Write what is in a file, or in the files of several times, in the format of another program.

    Parameters
    ----------
    output : the file to write; where None, beside the file and named like it
    """
    if output is None and len(files) > 1:
        raise UsageError(f"{len(files)} files go into one, whose name -o has to say")
    to = options.to
    target = output or files[0].with_name(files[0].stem + FORMATS[to].ending)
    atomic.ensure_writable(target, overwrite, files)
    first = _read(files[0], options.plane)
    ensure_fits(files[0], first.format_name, to, len(files))
    inputs = {"file": files[0]} if len(files) == 1 else {f"file_{k:04d}": path for k, path in enumerate(files)}
    words = f"export {to}" if options.plane is None else f"export {to} plane {options.plane}"
    made = provenance.record(words, None, inputs)
    first = replace(first, provenance=made)

    def read(number: int) -> Content:
        """Return the content of one time, which has the same arrays on the same grid as that of the first."""
        if number == 0:
            return first
        path, other = files[number], _read(files[number], options.plane)
        if (other.format_name, other.grid) != (first.format_name, first.grid):
            raise InputError(f"{path}: holds {other.format_name} on {other.grid}, and {files[0]} does not")
        if set(other.arrays) != set(first.arrays):
            differing = ", ".join(sorted(set(other.arrays) ^ set(first.arrays)))
            raise InputError(f"{path}: has other arrays than {files[0]}: {differing}")
        ours, theirs = ({k: v for k, v in each.attributes.items() if k in SHARED} for each in (first, other))
        if ours != theirs:
            raise InputError(f"{path}: says {theirs}, and {files[0]} {ours}")
        return other

    times = None if options.step_s is None else [options.step_s * number for number in range(len(files))]
    write = FORMATS[to].write
    if to == "vtkhdf-series":
        export_vtk.write_series(target, first, read, len(files), times, made, overwrite=overwrite)
    elif write is None:
        contents = [read(number) for number in range(len(files))]
        with atomic.written_atomically(target, overwrite=overwrite) as path:
            write_netcdf(path, contents, times)
    else:
        with atomic.written_atomically(target, overwrite=overwrite) as path:
            write(path, first)
    return {
        "output": target.name,
        "format": first.format_name,
        "files": len(files),
        "arrays": list(first.arrays),
        "file_bytes": target.stat().st_size,
    }


def _read(path: Path, plane: int | None) -> Content:
    """Return a file's content, or one plane of it."""
    content = read_content(path)
    if plane is None:
        return content
    if content.grid is None:
        raise UsageError(f"{path}: holds points, which have no planes for --plane")
    count = content.grid.shape_xyz[2]
    if plane >= count:
        raise UsageError(f"--plane {plane}: {path} has {count} planes across z, counted from 0")
    (nx, ny, _), (x, y, _) = content.grid.shape_xyz, content.grid.origin_mm
    grid = Grid((nx, ny, 1), content.grid.spacing_mm, (x, y, float(content.grid.axis_mm(2)[plane])))
    return replace(content, grid=grid, arrays={name: each[plane : plane + 1] for name, each in content.arrays.items()})
