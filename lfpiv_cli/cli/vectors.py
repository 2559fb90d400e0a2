"""Commands that measure vector fields and put them together."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import (
    FILE,
    batch_options,
    common_options,
    dt_option,
    inputs_argument,
    output_option,
    pairing_options,
    watch_options,
)
from lfpiv_cli.console import Console
from lfpiv_cli.errors import UsageError


def parse_windows(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> tuple[int | tuple[int, ...], ...] | None:
    """Return windows given as 32,16 or 32x32x16,16x16x8."""
    return None if text is None else tuple(_window(part) for part in text.split(","))


def _window(text: str) -> int | tuple[int, ...]:
    try:
        sizes = tuple(int(part) for part in text.lower().split("x"))
    except ValueError as error:
        raise UsageError(f"--windows: {text!r} is neither a number of voxels nor three of them as 32x32x16") from error
    return sizes[0] if len(sizes) == 1 else sizes


@click.command("correlate")
@inputs_argument("volumes", "results")
@click.option("--config", type=FILE, help="In place of the config carried by the volumes.")
@dt_option
@click.option("--windows", callback=parse_windows, help="Interrogation windows in voxels, coarse to fine, as 32,16.")
@click.option("--overlap", type=click.FloatRange(min=0.0, max=1.0, max_open=True), help="Of neighbouring windows.")
@pairing_options
@click.option("--mask", "mask_volume", type=FILE, help="Volume on the same grid: voxels of 0 are left out.")
@click.option("--ensemble", is_flag=True, help="One field of all pairs together, for a flow that does not change.")
@click.option("--derived", is_flag=True, help="Also write vorticity, divergence, strain rate and Q criterion.")
@click.option(
    "--mean",
    type=FILE,
    help="File of the pairs' mean and fluctuations to write (.vtkhdf); of vectors or tracks that are there, too.",
)
@batch_options
@watch_options
@output_option("File for one pair, folder for several.", required=False)
@common_options
def correlate(
    volumes: tuple[Path, ...], overwrite: bool, console: Console, output: Path | None = None, **chosen: Any
) -> dict[str, Any]:
    """Measure the displacements between two volumes by multi-pass three-dimensional cross-correlation.

    From pass to pass interrogation windows get finer and the volumes are deformed by what was found; false vectors are
    detected by a median test and replaced. More than two volumes need --pairing: ab pairs them by their names (img_1_a
    with img_1_b, or by numbers), sequence takes each with the next, none across a gap. Of vectors or tracks in place of
    volumes --mean is made, and nothing else.

    \b
    Example: lfpiv correlate volumes/a.vtkhdf volumes/b.vtkhdf -o vectors.vtkhdf
             lfpiv correlate volumes --pairing sequence --mean mean.vtkhdf -o vectors
             lfpiv correlate vectors --mean mean.vtkhdf
    """
    from lfpiv_cli.stages import correlate as stage

    options = stage.CorrelateOptions(**chosen)
    return stage.correlate(volumes, output, options, overwrite=overwrite, console=console)


@click.command("combine")
@click.argument("vectors_a", type=FILE)
@click.argument("vectors_b", type=FILE)
@output_option("File of combined vectors to write (.vtkhdf).")
@common_options
def combine(vectors_a: Path, vectors_b: Path, output: Path, overwrite: bool, console: Console) -> dict[str, Any]:
    """Weight two vector fields on one grid by their uncertainties, those of correlate and of track --grid.

    A vector that has none, or that disagrees with the other and with those around it, is left out; share_a is the
    weight of the first file in each component, disagreement how many standard errors lie between the two.

    \b
    Example: lfpiv combine vectors.vtkhdf tracks_grid.vtkhdf -o combined.vtkhdf
    """
    from lfpiv_cli.stages import combine as stage

    return stage.combine_vectors(vectors_a, vectors_b, output, overwrite=overwrite, console=console)
