"""The command that fits velocity fields."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import FILE, common_options, dt_option, output_option
from lfpiv_cli.console import Console
from lfpiv_cli.names import Divergence, names_in


@click.command("field")
@click.argument("samples", type=FILE, nargs=-1, required=True)
@dt_option
@click.option(
    "--divergence",
    type=click.Choice(names_in(Divergence)),
    help="Held down as far as the data ask for (penalised, the default), none (free), or not known (off).",
)
@click.option("--frame", type=click.IntRange(min=0), help="Frame of a sequence's tracks, from 0; the middle one.")
@click.option("--derived", is_flag=True, help="Also write vorticity, divergence, strain rate, Q criterion, gradients.")
@click.option(
    "--at", type=FILE, help="File of points (x, y, z in mm a line); velocities there go to OUTPUT's name with _at.csv."
)
@click.option(
    "--pressure",
    type=FILE,
    help="Folder of the particles of all frames of a sequence: the pressure is found by its tracks' accelerations.",
)
@output_option("File of vectors to write (.vtkhdf).")
@common_options
def field(
    samples: tuple[Path, ...],
    output: Path,
    overwrite: bool,
    console: Console,
    pressure: Path | None = None,
    **chosen: Any,
) -> dict[str, Any]:
    """Fit one velocity field to tracks and vectors of a flow, each weighed by its error.

    The field is smooth and, in a liquid, free of divergence as far as the data ask for; where no track is near, the
    vector is rejected. It is written on correlate's grid.

    \b
    Example: lfpiv field tracks.vtkhdf -o field.vtkhdf
             lfpiv field tracks.vtkhdf vectors.vtkhdf --derived -o field.vtkhdf
             lfpiv field run/tracks.vtkhdf --pressure run/particles -o field.vtkhdf
    """
    from lfpiv_cli.files.listing import expanded
    from lfpiv_cli.stages import field as stage

    particles = [] if pressure is None else expanded([pressure], "results")
    options = stage.FieldOptions(pressure=particles, **chosen)
    return stage.fit_flow(samples, output, options, overwrite=overwrite, console=console)
