"""The command that makes a page of results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import FILE, common_options, output_option
from lfpiv_cli.console import Console


@click.command("report")
@click.argument("folder", type=FILE)
@click.option("--raw", type=FILE, multiple=True, help="Raw images, white ones too, to show what was found on them.")
@output_option("Page to write (.html).")
@common_options
def report(folder: Path, output: Path, overwrite: bool, console: Console, **chosen: Any) -> dict[str, Any]:
    """Make one page of a folder of results: verdict, pictures, figures, settings and warnings.

    It needs no truth, holds all its pictures and loads nothing, so that it can be handed on as it is; tracks can be
    turned in it, and it prints. The verdict is of calibration, images and vectors: good, look (at the reasons) or no.

    \b
    Example: lfpiv report results -o results/report.html
             lfpiv report results --raw a.tif --raw white.tif -o results/report.html
    """
    from lfpiv_cli.stages import report as stage

    return stage.report(folder, output, stage.ReportOptions(**chosen), overwrite=overwrite, console=console)
