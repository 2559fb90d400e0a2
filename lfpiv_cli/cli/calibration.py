"""Commands that calibrate: from photographs, and from the particles of a flow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli.options import (
    FILE,
    board_option,
    common_options,
    config_argument,
    dark_option,
    depth_option,
    output_option,
    raw_option,
    white_option,
)
from lfpiv_cli.console import Console


@click.command("calibrate-snapshot")
@config_argument
@white_option
@dark_option
@board_option
@depth_option
@output_option("Calibration file to write (.h5).")
@click.option("--picture", type=FILE, help="Picture of the fitted lattice and board to write (.png).")
@click.option("--views", type=FILE, help="Picture of views and refocused depths to write (.png).")
@common_options
@raw_option
def calibrate_snapshot(config: Path, output: Path, overwrite: bool, console: Console, **chosen: Any) -> dict[str, Any]:
    """Find microlenses and focal plane from a white image and one snapshot of a calibration target.

    \b
    Example: lfpiv calibrate-snapshot rig.yaml --white white.tif --dark dark.tif --board board.tif \\
                 -o calibration.h5 --picture calibration.png
    for `build-weights --method dlfc`, with targets at several depths in the fluid:
             lfpiv calibrate-snapshot rig.yaml --white white.tif --board b1.tif --depth-mm -8 \\
                 --board b2.tif --depth-mm 0 --board b3.tif --depth-mm 8 -o calibration.h5
    without a target, with a camera known to be focused on the channel's mid plane:
             lfpiv calibrate-snapshot rig.yaml --white white.tif --depth-mm 0 -o calibration.h5
    """
    from lfpiv_cli.stages import calibrate as stage

    options = stage.CalibrateOptions(**chosen)
    return stage.calibrate_snapshot(config, output, options, overwrite=overwrite, console=console)


@click.command("refine-calibration")
@config_argument
@click.argument("images", type=FILE, nargs=-1, required=True)
@click.option("--calibration", type=FILE, required=True, help="From calibrate-snapshot.")
@dark_option
@click.option("--background", type=FILE, help="Image without tracers to subtract, in place of the dark one.")
@output_option("Corrected calibration to write (.h5); without it, only report.", required=False)
@click.option("--picture", type=FILE, help="Picture of the particles and the walls they end at to write (.png).")
@common_options
@raw_option
def refine_calibration(
    config: Path, images: tuple[Path, ...], calibration: Path, overwrite: bool, console: Console, **chosen: Any
) -> dict[str, Any]:
    """Correct a calibration by the tracers of a flow: volume self-calibration.

    The particles end at the channel's walls, which gives the mid plane, and their images say how far the lens images
    have moved since the white image. Behind the curved faces of a scene they tell where the pipe's axis lies and how it
    is tilted; build-weights moves the scene so.

    \b
    Example: lfpiv refine-calibration rig.yaml a.tif b.tif --calibration calibration.h5 --dark dark.tif \\
                 -o refined.h5 --picture walls.png
    """
    from lfpiv_cli.stages import refine as stage

    options = stage.RefineOptions(**chosen)
    return stage.refine_calibration(config, images, calibration, options, overwrite=overwrite, console=console)
