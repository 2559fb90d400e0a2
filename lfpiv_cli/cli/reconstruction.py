"""The command that reconstructs volumes, or the particles themselves."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import (
    FILE,
    background_option,
    batch_options,
    common_options,
    dark_option,
    inputs_argument,
    mask_option,
    output_option,
    pairing_options,
    raw_option,
    watch_options,
)
from lfpiv_cli.console import Console
from lfpiv_cli.names import Start, names_in
from lfpiv_cli.reconstruction.registry import SOLVER_NAMES


@click.command("reconstruct")
@click.argument("weights", type=FILE)
@inputs_argument("images")
@click.option("--solver", type=click.Choice(SOLVER_NAMES), help="Of volumes, or particles; default from the config.")
@click.option("--iterations", type=click.IntRange(min=1), help="Steps of the solver; default from the config.")
@click.option(
    "--relaxation",
    type=click.FloatRange(min=0.0, min_open=True, max=2.0),
    help="mu of Eq. 12; default from the config.",
)
@click.option("--accelerate/--no-accelerate", default=None, help="Extrapolate between steps; default from the config.")
@click.option("--start", type=click.Choice(names_in(Start)), help="First volume; default from the config.")
@dark_option
@background_option
@mask_option
@pairing_options
@click.option(
    "--residual/--no-residual",
    default=None,
    help="Of particles, also write what they leave of each image, as OUTPUT's name with _residual.tif; written when "
    "not given.",
)
@batch_options
@watch_options
@output_option("File for one image, folder for several.")
@common_options
@raw_option
def reconstruct(
    weights: Path, images: tuple[Path, ...], output: Path, overwrite: bool, console: Console, **chosen: Any
) -> dict[str, Any]:
    """Reconstruct the volume of tracer particles behind each image (tomographic reconstruction).

    With --solver particles it finds the particles themselves by iterative particle reconstruction: each is fitted to
    the raw image, and ghost particles are removed; with --pairing, neighbouring frames help each other. Hot and dead
    pixels of the dark image are left out.

    \b
    Example: lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif -o volumes
    particles of a pair:
             lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif --solver particles --pairing ab -o particles
    frames without a header:
             lfpiv reconstruct weights.h5 shot.raw --raw 2352x1768x12:packing=low-first -o volumes
    over a long sequence, the background of each frame from the fifteen around it:
             lfpiv reconstruct weights.h5 run.tif --background minimum:15 --mask mask.png -o volumes
    all images of a folder, in the order of their numbers, and those of a list:
             lfpiv reconstruct weights.h5 images --files-from more.txt --resume --keep-going -o volumes
    on a cluster, a third of them; on this machine, by four processes; while the camera still writes them:
             lfpiv reconstruct weights.h5 images --shard 2/3 --time-limit 50m --resume -o volumes
             lfpiv reconstruct weights.h5 images --dask local:4 -o volumes
             lfpiv reconstruct weights.h5 images --watch --idle-s 30 -o volumes
    """
    from lfpiv_cli.stages import reconstruct as stage

    options = stage.ReconstructOptions(**chosen)
    return stage.reconstruct(weights, images, output, options, overwrite=overwrite, console=console)
