"""The command that tracks particles: particle tracking velocimetry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import FILE, POSITIVE, common_options, dt_option, output_option
from lfpiv_cli.console import Console


@click.command("track")
@click.argument("particles", type=FILE, nargs=-1, required=True)
@dt_option
@click.option(
    "--search", "search_voxel", type=POSITIVE, help="Largest displacement, voxels; six microlenses when not given."
)
@click.option(
    "--shortest",
    type=click.IntRange(min=2),
    help="Sequence: fewest frames of a track, shorter ones are ghosts; 3 when not given.",
)
@click.option("--grid", is_flag=True, help="Also write vectors on correlate's grid, as OUTPUT's name with _grid.")
@output_option("File of tracks to write (.vtkhdf).")
@common_options
def track(
    particles: tuple[Path, ...], output: Path, overwrite: bool, console: Console, **chosen: Any
) -> dict[str, Any]:
    """Follow particles from one frame to the next, or over a sequence: particle tracking velocimetry (PTV).

    Two files give a displacement for each particle that is in both. More than two, in the order of time, give tracks:
    each place with the number of its track and frame and with a velocity by a local polynomial in time; --grid then
    writes one file for each interval between frames (OUTPUT's name with _grid_0000, ...).

    \b
    Example: lfpiv track particles/a.vtkhdf particles/b.vtkhdf -o tracks.vtkhdf --grid
             lfpiv track particles/frame_*.vtkhdf -o tracks.vtkhdf --grid
    with particles from
             lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif --solver particles -o particles
    """
    from lfpiv_cli.stages import track as stage

    options = stage.TrackOptions(**chosen)
    return stage.track_particles(particles, output, options, overwrite=overwrite, console=console)
