"""The commands that describe files and draw what is in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import FILE, common_options, output_option, raw_option
from lfpiv_cli.console import Console


@click.command("info")
@click.argument("file", type=FILE)
@click.option("--picture", type=FILE, help="weights: picture of one voxel's pixels to write (.png).")
@click.option("--voxel", type=int, nargs=3, metavar="IX IY IZ", help="weights: which voxel; default the middle one.")
@common_options
@raw_option
def info(file: Path, overwrite: bool, console: Console, **chosen: Any) -> dict[str, Any]:
    """Describe a file that lfpiv wrote, or a recording; of weights, draw the point-spread function of one voxel.

    \b
    Example: lfpiv info weights.h5 --picture column.png --voxel 50 40 120
    of a camera's recording, its pages, size, bits and frame rate:
             lfpiv info shot.cine
    """
    from lfpiv_cli.stages import info as stage

    return stage.info(file, stage.InfoOptions(**chosen), overwrite=overwrite, console=console)


@click.command("plot")
@click.argument("file", type=FILE)
@output_option("PDF with a page for each figure, or PNG: one figure, or of several P_NAME.png for each.")
@click.option("--only", multiple=True, metavar="NAME", help="This figure only; may be repeated. Default: all.")
@click.option(
    "--raw", type=FILE, help="Image to draw on: the raw one that particles were found in, a calibration's white image."
)
@common_options
def plot(file: Path, output: Path, overwrite: bool, console: Console, **chosen: Any) -> dict[str, Any]:
    """Draw what is in a file: vectors, tracks, particles, a volume, a calibration or weights.

    \b
    Example: lfpiv plot vectors.vtkhdf -o vectors.pdf
    Example: lfpiv plot vectors.vtkhdf --only planes -o planes.png
    """
    from lfpiv_cli.stages import plot as stage

    return stage.plot(file, output, stage.PlotOptions(**chosen), overwrite=overwrite, console=console)


@click.command("warm-up")
@click.option("--cache", type=FILE, help="Folder to fill; where lfpiv keeps compiled code when not given.")
@common_options
def warm_up(overwrite: bool, console: Console, cache: Path | None = None) -> dict[str, Any]:
    """Compile all that lfpiv would compile when it is used for the first time, in a minute or two.

    For images of containers and for clusters: fill a folder once, and set NUMBA_CACHE_DIR to it where lfpiv runs, on
    processors of the same kind. The folder may be read-only there.

    \b
    Example: lfpiv warm-up
             lfpiv warm-up --cache /opt/lfpiv-kernels
    """
    from lfpiv_cli.files import kernel_cache

    if cache is not None:
        kernel_cache.use(cache)
    from lfpiv_cli.stages import warm_up as stage

    return stage.warm_up(console=console)
