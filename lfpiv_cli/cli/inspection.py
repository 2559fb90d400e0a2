"""The command that describes files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import FILE, common_options
from lfpiv_cli.console import Console


@click.command("info")
@click.argument("file", type=FILE)
@click.option("--picture", type=FILE, help="weights: picture of one voxel's pixels to write (.png).")
@click.option("--voxel", type=int, nargs=3, metavar="IX IY IZ", help="weights: which voxel; default the middle one.")
@common_options
def info(file: Path, overwrite: bool, console: Console, **chosen: Any) -> dict[str, Any]:
    """Describe a file that lfpiv wrote; of weights, draw the point-spread function of one voxel.

    \b
    Example: lfpiv info weights.h5 --picture column.png --voxel 50 40 120
    """
    from lfpiv_cli.stages import info as stage

    return stage.info(file, stage.InfoOptions(**chosen), overwrite=overwrite, console=console)
