"""The command that builds weights."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import FILE, common_options, config_argument, output_option
from lfpiv_cli.console import Console
from lfpiv_cli.names import Method, Refraction, Sampling, names_in


@click.command("build-weights")
@config_argument
@click.option("--calibration", type=FILE, help="From calibrate-snapshot; without it the data sheet holds.")
@click.option(
    "--method", type=click.Choice(names_in(Method)), help="Equivalent, traced or fitted rays; default from the config."
)
@click.option("--refraction", type=click.Choice(names_in(Refraction)), help="Snell's law; default from the config.")
@click.option("--sampling", type=click.Choice(names_in(Sampling)), help="Integrals or rays; default from the config.")
@click.option("--dry-run", is_flag=True, help="Check everything and estimate time and memory; write nothing.")
@output_option("Weights file to write (.h5).")
@common_options
def build_weights(config: Path, output: Path, overwrite: bool, console: Console, **chosen: Any) -> dict[str, Any]:
    """Calculate how every voxel lights every pixel: its point-spread function behind main lens and microlenses.

    \b
    Example: lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5
             lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5 --dry-run
    """
    from lfpiv_cli.stages import build_weights as stage

    options = stage.BuildWeightsOptions(**chosen)
    return stage.build_weights(config, output, options, overwrite=overwrite, console=console)
