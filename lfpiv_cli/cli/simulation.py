"""The command that simulates recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import common_options, config_argument, output_option
from lfpiv_cli.console import Console


@click.command("simulate")
@click.argument("what", type=click.Choice(["white", "board", "particles"]))
@config_argument
@click.option("--depth-mm", type=float, multiple=True, help="With board: in the fluid at this depth; repeatable.")
@output_option("Folder for the images and their truth.")
@common_options
def simulate(
    what: str, config: Path, depth_mm: tuple[float, ...], output: Path, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Render raw images through the exact optics, ray by ray, with their truth beside them.

    White light, the calibration target, or tracers in the configured flow at the configured seeding density.

    \b
    Example: lfpiv simulate particles rig.yaml -o simulated
             lfpiv simulate board rig.yaml --depth-mm -4 --depth-mm 0 --depth-mm 4 -o simulated
    """
    from lfpiv_cli.stages import simulate as stage

    if depth_mm:
        if what != "board":
            raise click.UsageError(f"simulate {what} takes no --depth-mm")
        return stage.simulate_boards(config, output, depth_mm, overwrite=overwrite, console=console)
    return stage.SCENES[what](config, output, overwrite=overwrite, console=console)
