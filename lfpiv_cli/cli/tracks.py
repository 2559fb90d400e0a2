"""The commands that track particles: particle tracking velocimetry."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import (
    FILE,
    POSITIVE,
    background_option,
    batch_options,
    common_options,
    dark_option,
    dt_option,
    inputs_argument,
    mask_option,
    output_option,
    pairing_options,
    raw_option,
    work_options,
)
from lfpiv_cli.console import Console
from lfpiv_cli.names import GridMethod, names_in


@click.command("track")
@inputs_argument("particles", "results")
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
@click.option(
    "--by",
    type=click.Choice(names_in(GridMethod)),
    help="With --grid: local polynomials (the default), or one field of splines, as of field.",
)
@pairing_options
@batch_options
@output_option("File of tracks to write (.vtkhdf), folder for several pairs.")
@common_options
def track(
    particles: tuple[Path, ...], output: Path, overwrite: bool, console: Console, **chosen: Any
) -> dict[str, Any]:
    """Follow particles from one frame to the next, or over a sequence: particle tracking velocimetry (PTV).

    Two files give a displacement for each particle that is in both. More than two, in the order of time, give tracks:
    each place with the number of its track and frame and with a velocity by a local polynomial in time; --grid then
    writes one file for each interval between frames (OUTPUT's name with _grid_0000, ...). With --pairing ab they are
    separate pairs by their names, and each gives a file.

    \b
    Example: lfpiv track particles/a.vtkhdf particles/b.vtkhdf -o tracks.vtkhdf --grid
             lfpiv track particles/frame_*.vtkhdf -o tracks.vtkhdf --grid
             lfpiv track particles --pairing ab --grid --resume --keep-going -o tracks
    with particles from
             lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif --solver particles -o particles
    """
    from lfpiv_cli.stages import track as stage

    options = stage.TrackOptions(**chosen)
    return stage.track_particles(particles, output, options, overwrite=overwrite, console=console)


@click.command("follow")
@click.argument("weights", type=FILE)
@inputs_argument("frames")
@dark_option
@background_option
@mask_option
@dt_option
@click.option(
    "--search",
    "search_voxel",
    type=POSITIVE,
    help="Largest displacement from the first frame to the second, voxels; six microlenses when not given.",
)
@click.option(
    "--shortest", type=click.IntRange(min=2), default=4, help="Fewest frames of a track, shorter ones are ghosts; 4."
)
@click.option(
    "--both-ways", is_flag=True, help="Go a second time through the frames, each by its tracks before and after it."
)
@click.option("--residuals", is_flag=True, help="Also write what the particles leave of each image.")
@work_options
@output_option("Folder for the particles of each frame and the tracks.")
@common_options
@raw_option
def follow(
    weights: Path, frames: tuple[Path, ...], output: Path, overwrite: bool, console: Console, **chosen: Any
) -> dict[str, Any]:
    """Find and track the particles of a time-resolved sequence together, as in Shake-The-Box.

    The first two frames are searched as a pair. Then each track predicts where its particle is in the next frame, the
    predicted particles are refined together on the image, and only what they leave of it is searched for others. Frames
    are taken in the order of their numbers, or the pages of one file. With --keep-going, tracks end before a frame that
    cannot be read, and others begin behind it.

    \b
    Writes OUTPUT/particles/STEM.vtkhdf for each frame, as reconstruct does, OUTPUT/tracks.vtkhdf, as track does,
    and OUTPUT/playback.vtkhdf, in which ParaView plays the tracks in time.

    \b
    Example: lfpiv follow weights.h5 run.tif --dark dark.tif -o run
             lfpiv follow weights.h5 frame_*.tif --dark dark.tif --both-ways -o run
    before the limit of a job it stops, and the same command goes on:
             lfpiv follow weights.h5 run.tif --dark dark.tif --time-limit 50m --resume -o run
    """
    from lfpiv_cli.stages import follow as stage

    options = stage.FollowOptions(**chosen)
    return stage.follow_particles(weights, frames, output, options, overwrite=overwrite, console=console)
