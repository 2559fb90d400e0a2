"""The command that takes all steps from raw images to vectors."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import (
    FILE,
    background_option,
    board_option,
    common_options,
    config_argument,
    dark_option,
    depth_option,
    dt_option,
    inputs_argument,
    mask_option,
    output_option,
    pairing_options,
    raw_option,
    white_option,
    work_options,
)
from lfpiv_cli.console import Console
from lfpiv_cli.names import Kept, RunMethod, names_in


def named_images(command: Callable[..., Any]) -> Callable[..., Any]:
    """Let a command take its images by the option --images, too."""

    @click.option("--images", "named", type=FILE, multiple=True, help="The same: images of the flow.")
    @wraps(command)
    def run(named: tuple[Path, ...], images: tuple[Path, ...], **arguments: Any) -> Any:
        return command(images=(*named, *images), **arguments)

    return run


@click.command("run")
@config_argument
@named_images
@inputs_argument("images")
@white_option
@dark_option
@board_option
@depth_option
@background_option
@mask_option
@click.option(
    "--method", type=click.Choice(names_in(RunMethod)), help="By what the flow is measured; auto when not given."
)
@pairing_options
@dt_option
@click.option("--combine", is_flag=True, help="With both: also one field that weights their vectors.")
@click.option("--follow", is_flag=True, help="Time-resolved sequence: find and track particles together.")
@click.option(
    "--keep",
    type=click.Choice(names_in(Kept)),
    help="results: drop volumes, and particles of separate pairs, as soon as their vectors stand; all when not given.",
)
@work_options
@click.option("--report/--no-report", default=True, help="Make OUTPUT/report.html, a page of all of it.")
@output_option("Folder for all that is made.")
@common_options
@raw_option
def run(
    config: Path,
    images: tuple[Path, ...],
    output: Path,
    overwrite: bool,
    console: Console,
    **chosen: Any,
) -> dict[str, Any]:
    """Go from raw images to vectors: calibrate, build weights, measure the flow.

    Every step writes what its own command does, into OUTPUT. By itself it counts the tracers for each microlens, and
    measures by particles up to about two, where these err less, and by volumes beyond; OUTPUT/run.json says which and
    why, and OUTPUT/report.html shows all of it. Run it again, and it keeps what is complete and made alike, and goes on
    from there, with --resume or without; with --overwrite it makes anew what was made from other inputs or settings.
    More than two images need --pairing or --follow; thousands of pairs take no more disk than their vectors with --keep
    results. A --shard makes the files of its pairs; the same command without it then makes run.json and the page.

    \b
    Example: lfpiv run rig.yaml a.tif b.tif --white white.tif --dark dark.tif --board board.tif -o results
    by both ways, and one field of the two:
             lfpiv run rig.yaml a.tif b.tif --white white.tif --dark dark.tif --board board.tif \\
                 --method both --combine -o results
    a folder of pairs, whatever becomes of single ones:
             lfpiv run rig.yaml images --pairing ab --white white.tif --dark dark.tif --board board.tif \\
                 --keep results --keep-going -o results
    a third of its pairs, as a job of its own, that stops before the limit of the job:
             lfpiv run rig.yaml images --pairing ab --white white.tif --dark dark.tif --board board.tif \\
                 --shard 2/3 --time-limit 50m -o results
    """
    from lfpiv_cli.stages import run as stage

    options = stage.RunOptions(images=images, **chosen)
    return stage.run(config, output, options, overwrite=overwrite, console=console)
