"""The command that writes results in the formats of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import FILE, POSITIVE, common_options, output_option
from lfpiv_cli.console import Console
from lfpiv_cli.names import ExportFormat, names_in


@click.command("export")
@click.argument("files", type=FILE, nargs=-1, required=True)
@click.option("--to", type=click.Choice(names_in(ExportFormat)), required=True, help="Format to write.")
@click.option("--plane", type=click.IntRange(min=0), help="Only this plane across z, counted from 0.")
@click.option(
    "--step-s", type=POSITIVE, help="Time from one file to the next; without it they are numbered 0, 1, 2, ..."
)
@output_option("File to write; beside FILE and named like it when not given.", required=False)
@common_options
def export(
    files: tuple[Path, ...], overwrite: bool, console: Console, output: Path | None = None, **chosen: Any
) -> dict[str, Any]:
    """Write vectors, volumes, particles or tracks in the format of another program, to the last bit.

    \b
    netcdf         all: vectors for pivpy and xarray, of several times, too
    tecplot        all, as text
    csv            all but volumes
    mat            all: Matlab, and the tracks of a sequence for flowtracks
    vti            volumes, vectors: VTK, PyVista
    vtp            particles, tracks: VTK, PyVista
    vtkhdf-series  vectors or volumes of several times, or the tracks of a sequence, for ParaView to play

    \b
    Example: lfpiv export vectors.vtkhdf --to netcdf
             lfpiv export vectors/*.vtkhdf --to vtkhdf-series --step-s 0.002 -o series.vtkhdf
             lfpiv export tracks.vtkhdf --to mat -o tracks.mat
    """
    from lfpiv_cli.stages import export as stage

    return stage.export(files, output, stage.ExportOptions(**chosen), overwrite=overwrite, console=console)
