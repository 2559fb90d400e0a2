"""Which format takes what, the ending of its files, and how one is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.exports import mat, text, vtk_xml
from lfpiv_cli.files.exports.content import KINDS, OF_POINTS, ON_GRIDS, Content
from lfpiv_cli.files.particle_file import TRAJECTORIES_FORMAT
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT
from lfpiv_cli.names import ExportFormat


@dataclass(frozen=True)
class Format:
    """A format: what follows the stem of its files, and what it takes.

    Attributes
    ----------
    ending : of the file's name
    takes : names of our formats
    several : of these, those of which several times go into one file
    write : writes one file; None where `stages.export` says how, as times or records come into it
    """

    ending: str
    takes: tuple[str, ...]
    several: tuple[str, ...] = ()
    write: Callable[[Path, Content], None] | None = None


# A volume has millions of voxels: as rows of text it serves nobody.
FORMATS: dict[ExportFormat, Format] = {
    "netcdf": Format(".nc", ON_GRIDS + OF_POINTS, several=(VECTORS_FORMAT,)),
    "tecplot": Format(".dat", ON_GRIDS + OF_POINTS, write=text.write_tecplot),
    "csv": Format(".csv", (VECTORS_FORMAT, *OF_POINTS), write=text.write_csv),
    "mat": Format(".mat", ON_GRIDS + OF_POINTS, write=mat.write_mat),
    "vti": Format(".vti", ON_GRIDS, write=vtk_xml.write_vti),
    "vtp": Format(".vtp", OF_POINTS, write=vtk_xml.write_vtp),
    "vtkhdf-series": Format("_series.vtkhdf", (*ON_GRIDS, TRAJECTORIES_FORMAT), several=ON_GRIDS),
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
    kind, fitting = KINDS[format_name], [name for name, each in FORMATS.items() if format_name in each.takes]
    if to not in fitting:
        raise InputError(f"{path}: holds {kind}, which {to} does not take; {', '.join(fitting)} do")
    if count > 1 and format_name not in FORMATS[to].several:
        fitting = [name for name, each in FORMATS.items() if format_name in each.several]
        where = f"several go into {', '.join(fitting)}" if fitting else "give one file at a time"
        raise UsageError(f"{path}: holds {kind}, of which {to} takes one file, got {count}; {where}")
