"""Tables of text: CSV, and Tecplot's ASCII format. Numbers have as many digits as bring back the same bits."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.exports.content import KINDS, Content, column_units, columns_of, frames_of
from lfpiv_cli.files.particle_file import TRAJECTORIES_FORMAT


def write_csv(path: Path, content: Content) -> None:
    """Write one row for each place below the columns' names; lines of comments before them begin with #."""
    columns = columns_of(content)
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.writelines(_comments(content))
        file.write(",".join(columns) + "\n")
        file.writelines(",".join(row) + "\n" for row in _rows(columns))


def write_tecplot(path: Path, content: Content) -> None:
    """Write an ordered zone on a grid, one of points, or of a sequence's tracks one for each frame with its time.

    Names of variables have no units, by which readers would not know coordinates as such: comments have them.
    """
    columns = columns_of(content)
    with open(path, "w", encoding="utf-8", newline="\n") as file:
        file.writelines(_comments(content))
        file.write(f'TITLE = "{KINDS[content.format_name]}"\n')
        file.write("VARIABLES = " + " ".join(f'"{name}"' for name in columns) + "\n")
        for head, rows in _zones(content):
            file.write(f"ZONE {head}, DATAPACKING=POINT\nDT=({'DOUBLE ' * len(columns)})\n")
            here = columns if rows is None else {name: column[rows] for name, column in columns.items()}
            file.writelines(" ".join(row) + "\n" for row in _rows(here))


def _comments(content: Content) -> Iterator[str]:
    """Yield what the file says about itself as lines that begin with #; the units are the last."""
    yield from (f"{line}\n" for line in content.comments())
    yield f"# units: {json.dumps(column_units(content))}\n"


def _zones(content: Content) -> Iterator[tuple[str, NDArray[np.int64] | None]]:
    """Yield the head and the rows of each zone, None where it has all."""
    kind = KINDS[content.format_name]
    if content.grid is not None:
        nx, ny, nz = content.grid.shape_xyz
        yield f'T="{kind}", I={nx}, J={ny}, K={nz}', None
    elif content.format_name == TRAJECTORIES_FORMAT:
        dt_s = float(content.attributes["dt_s"])
        for number, rows in enumerate(frames_of(content)):
            if rows.size:
                yield f'T="frame {number}", STRANDID=1, SOLUTIONTIME={number * dt_s!r}, I={rows.size}, J=1, K=1', rows
    else:
        yield f'T="{kind}", I={len(content.arrays["position_mm"])}, J=1, K=1', None


def _rows(columns: dict[str, NDArray[np.generic]]) -> Iterator[tuple[str, ...]]:
    """Yield the rows of columns as text."""
    return zip(*(map(repr, column.tolist()) for column in columns.values()), strict=True)
