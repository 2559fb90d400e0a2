"""The command line: parse, call a stage, print its summary; errors become exit codes.

Heavy imports happen inside the commands, so that `--help` answers at once.
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn

import click

from lfpiv_cli import __version__
from lfpiv_cli.errors import LfpivError, LimitMissedError

EXIT_BUG = 1
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143

INPUT = click.Path(path_type=Path)


class Terminated(BaseException):
    """SIGTERM arrived; unwinds like KeyboardInterrupt so that temporary files are removed."""


def common_options(command: Callable[..., dict[str, Any]]) -> Callable[..., None]:
    """Give a command the options that all share, and print the summary it returns."""

    @click.option("--overwrite", is_flag=True, help="Replace outputs that exist.")
    @click.option("--threads", type=click.IntRange(min=1), help="Threads to use; all cores when not given.")
    @click.option("--json", "as_json", is_flag=True, help="Print one JSON object to stdout and nothing else.")
    @click.option("-v", "--verbose", is_flag=True, help="Say more on stderr.")
    @click.option("-q", "--quiet", is_flag=True, help="Say nothing on stderr but errors.")
    @click.option("--debug", is_flag=True, expose_value=False, help="Show the traceback of an error.")
    @wraps(command)
    def run(threads: int | None, as_json: bool, verbose: bool, quiet: bool, **arguments: Any) -> None:
        from lfpiv_cli.console import Console

        console = Console(verbose=verbose, quiet=quiet or as_json)
        if threads is not None:
            from lfpiv_cli.threads import use_threads

            use_threads(threads)
        missed: LimitMissedError | None = None
        try:
            summary = command(console=console, **arguments)
        except LimitMissedError as error:
            missed, summary = error, error.figures
        if as_json:
            click.echo(json.dumps(summary, allow_nan=False, sort_keys=True))
        else:
            console.summary(summary)
        if missed:
            raise missed

    return run


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="lfpiv")
def cli() -> None:
    """From raw light-field camera images to three-dimensional velocity fields.

    \b
    lfpiv calibrate-snapshot rig.yaml --white white.tif --board board.tif -o calibration.h5
    lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5
    lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif -o volumes
    lfpiv correlate volumes/a.vtkhdf volumes/b.vtkhdf -o vectors.vtkhdf
    lfpiv validate flow rig.yaml --vectors vectors.vtkhdf -o report
    """


@cli.command("calibrate-snapshot")
@click.argument("config", type=INPUT)
@click.option("--white", type=INPUT, multiple=True, help="White image, uniform light; twice: stopped down and not.")
@click.option("--dark", type=INPUT, help="Dark image, taken with the cap on.")
@click.option("--board", type=INPUT, multiple=True, help="Snapshot of the dot board; or several, each with its depth.")
@click.option("--depth-mm", type=float, multiple=True, help="Depth of each board in the fluid, for dlfc.")
@click.option("-o", "--output", type=INPUT, required=True, help="Calibration file to write (.h5).")
@click.option("--picture", type=INPUT, help="Picture of the fitted lattice and board to write (.png).")
@click.option("--views", type=INPUT, help="Picture of views and refocused depths to write (.png).")
@common_options
def calibrate_snapshot(**arguments: Any) -> dict[str, Any]:
    """Find the microlenses and the focal plane from a white image and one snapshot of the board.

    \b
    Example: lfpiv calibrate-snapshot rig.yaml --white white.tif --dark dark.tif --board board.tif \\
                 -o calibration.h5 --picture calibration.png
    for `build-weights --method dlfc`, with boards moved through the fluid:
             lfpiv calibrate-snapshot rig.yaml --white white.tif --board b1.tif --depth-mm -8 \\
                 --board b2.tif --depth-mm 0 --board b3.tif --depth-mm 8 -o calibration.h5
    """
    from lfpiv_cli.stages import calibrate

    return calibrate.calibrate_snapshot(**arguments)


@cli.command("refine-calibration")
@click.argument("config", type=INPUT)
@click.argument("images", type=INPUT, nargs=-1, required=True)
@click.option("--calibration", type=INPUT, required=True, help="From calibrate-snapshot.")
@click.option("--dark", type=INPUT, help="Dark image to subtract.")
@click.option("--background", type=INPUT, help="Image without tracers to subtract, in place of the dark one.")
@click.option("-o", "--output", type=INPUT, help="Mended calibration to write (.h5); without it, only report.")
@click.option("--picture", type=INPUT, help="Picture of the particles' depths and the walls to write (.png).")
@common_options
def refine_calibration(**arguments: Any) -> dict[str, Any]:
    """Find the channel's walls by the particles between them, and with them what the calibration got wrong.

    \b
    Example: lfpiv refine-calibration rig.yaml a.tif b.tif --calibration calibration.h5 --dark dark.tif \\
                 -o refined.h5 --picture walls.png
    """
    from lfpiv_cli.stages import refine

    return refine.refine_calibration(**arguments)


@cli.command("build-weights")
@click.argument("config", type=INPUT)
@click.option("--calibration", type=INPUT, help="From calibrate-snapshot; without it the data sheet is believed.")
@click.option("--method", type=click.Choice(["ert", "drt", "dlfc"]), help="How rays go; default from the config.")
@click.option("--refraction", type=click.Choice(["paraxial", "exact"]), help="Snell's law; default from the config.")
@click.option("--sampling", type=click.Choice(["exact", "rays"]), help="Integrals or rays; default from the config.")
@click.option("-o", "--output", type=INPUT, required=True, help="Weights file to write (.h5).")
@common_options
def build_weights(**arguments: Any) -> dict[str, Any]:
    """Calculate how every voxel lights every pixel.

    \b
    Example: lfpiv build-weights rig.yaml --calibration calibration.h5 -o weights.h5
    """
    from lfpiv_cli.stages import build_weights

    return build_weights.build_weights(**arguments)


@cli.command("reconstruct")
@click.argument("weights", type=INPUT)
@click.argument("images", type=INPUT, nargs=-1, required=True)
@click.option(
    "--solver", type=click.Choice(["em", "sart", "smart", "mart", "particles"]), help="Default from the config."
)
@click.option("--iterations", type=click.IntRange(min=1), help="Default from the config.")
@click.option("--relaxation", type=click.FloatRange(min=0.0, min_open=True, max=2.0), help="Default from the config.")
@click.option("--accelerate/--no-accelerate", default=None, help="Extrapolate between steps; default from the config.")
@click.option("--start", type=click.Choice(["uniform", "line_of_sight"]), help="Default from the config.")
@click.option("--dark", type=INPUT, help="Dark image to subtract; its hot and dead pixels are left out.")
@click.option("--background", help="Image to subtract, or minimum or mean over the images given, or as minimum:15.")
@click.option("--mask", type=INPUT, help="Image that is black where pixels are to be left out (reflections, bubbles).")
@click.option(
    "--pairing", type=click.Choice(["ab", "sequence"]), help="Find particles with the help of the frames beside."
)
@click.option("--resume", is_flag=True, help="Skip outputs that are complete and made from the same inputs.")
@click.option("--keep-going", is_flag=True, help="Go on with the next frame when one fails.")
@click.option("-o", "--output", type=INPUT, required=True, help="File for one image, folder for several.")
@common_options
def reconstruct(**arguments: Any) -> dict[str, Any]:
    """Reconstruct the volume of tracer particles behind each image, or (--solver particles) the particles themselves.

    \b
    Example: lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif -o volumes
    over a long sequence, the background of each frame from the fifteen around it:
             lfpiv reconstruct weights.h5 run.tif --background minimum:15 --mask mask.png -o volumes
    """
    from lfpiv_cli.stages import reconstruct

    return reconstruct.reconstruct(**arguments)


@cli.command("correlate")
@click.argument("volumes", type=INPUT, nargs=-1, required=True)
@click.option("--config", type=INPUT, help="In place of the config carried by the volumes.")
@click.option("--dt-s", type=click.FloatRange(min=0.0, min_open=True), help="Time between the two volumes.")
@click.option("--windows", help="Window sizes in voxels, coarse to fine, as 32,16.")
@click.option("--overlap", type=click.FloatRange(min=0.0, max=1.0, max_open=True), help="Of neighbouring windows.")
@click.option("--pairing", type=click.Choice(["ab", "sequence"]), help="How more than two volumes are paired.")
@click.option("--mask", type=INPUT, help="Volume on the same grid: voxels of 0 are left out.")
@click.option("--ensemble", is_flag=True, help="One field of all pairs together, for a flow that does not change.")
@click.option("--derived", is_flag=True, help="Also write vorticity, divergence, strain rate and Q criterion.")
@click.option("--mean", type=INPUT, help="File of the pairs' mean and fluctuations to write (.vtkhdf).")
@click.option("--resume", is_flag=True, help="Skip outputs that are complete and made from the same inputs.")
@click.option("-o", "--output", type=INPUT, required=True, help="File for one pair, folder for several.")
@common_options
def correlate(**arguments: Any) -> dict[str, Any]:
    """Measure the displacement between two volumes by three-dimensional cross-correlation.

    \b
    Example: lfpiv correlate volumes/a.vtkhdf volumes/b.vtkhdf -o vectors.vtkhdf
             lfpiv correlate volumes/*.vtkhdf --pairing sequence --mean mean.vtkhdf -o vectors
    """
    from lfpiv_cli.stages import correlate

    return correlate.correlate(**arguments)


@cli.command("track")
@click.argument("particles", type=INPUT, nargs=-1, required=True)
@click.option("--dt-s", type=click.FloatRange(min=0.0, min_open=True), help="Time from one frame to the next.")
@click.option("--search", "search_voxel", type=click.FloatRange(min=0.0, min_open=True), help="Largest move, voxels.")
@click.option("--shortest", type=click.IntRange(min=2), help="Sequence: fewest frames of a track; 3 when not given.")
@click.option("--grid", is_flag=True, help="Also write vectors on correlate's grid, as OUTPUT's name with _grid.")
@click.option("-o", "--output", type=INPUT, required=True, help="File of tracks to write (.vtkhdf).")
@common_options
def track(**arguments: Any) -> dict[str, Any]:
    """Follow particles from one frame to the next, or over a sequence of frames.

    Two files give a displacement for each particle that is in both. More than two, in the order of time, give tracks:
    each place with the number of its track and frame and with a velocity by a local polynomial in time; --grid then
    writes one file for each interval between frames (OUTPUT's name with _grid_0000, ...).

    \b
    Example: lfpiv track particles/a.vtkhdf particles/b.vtkhdf -o tracks.vtkhdf --grid
             lfpiv track particles/frame_*.vtkhdf -o tracks.vtkhdf --grid
    after    lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif --solver particles -o particles
    """
    from lfpiv_cli.stages import track

    return track.track_particles(**arguments)


@cli.command("combine")
@click.argument("vectors_a", type=INPUT)
@click.argument("vectors_b", type=INPUT)
@click.option("-o", "--output", type=INPUT, required=True, help="File of combined vectors to write (.vtkhdf).")
@common_options
def combine(**arguments: Any) -> dict[str, Any]:
    """Weight two vector fields on one grid by their uncertainties, those of correlate and of track --grid.

    A vector that has none, or that disagrees with the other and with those around it, is left out; share_a tells the
    weight of the first file in each component, disagreement how many standard errors the two are apart.

    \b
    Example: lfpiv combine vectors.vtkhdf tracks_grid.vtkhdf -o combined.vtkhdf
    """
    from lfpiv_cli.stages import combine

    return combine.combine_vectors(**arguments)


@cli.command("validate")
@click.argument("what", type=click.Choice(["flow", "weights", "board", "volume", "all"]))
@click.argument("config", type=INPUT)
@click.option("--vectors", type=INPUT, help="flow: vectors to judge, not those of a simulation.")
@click.option("--volume", type=INPUT, help="volume: volume to judge.")
@click.option("--particles", type=INPUT, help="volume, flow: true particles (.npz) to judge by; flow needs none.")
@click.option("--frame", type=click.Choice(["a", "middle", "b"]), help="volume: when in the pair it was taken.")
@click.option("-o", "--output", type=INPUT, required=True, help="Folder for the report.")
@common_options
def validate(
    what: str, vectors: Path | None, volume: Path | None, particles: Path | None, frame: str | None, **arguments: Any
) -> dict[str, Any]:
    """Compare a result with what is known: figures as JSON, and pictures.

    \b
    Example: lfpiv validate flow rig.yaml --vectors vectors.vtkhdf -o report
             lfpiv validate flow rig.yaml -o report    (simulates the rig's experiment first)
             lfpiv validate weights rig.yaml -o report
             lfpiv validate board rig.yaml -o report
             lfpiv validate all rig.yaml -o report     (weights, board, and flow as it is simulated)
             lfpiv validate volume rig.yaml --volume a.vtkhdf --particles true.npz --frame a -o report
    """
    if (volume is not None or frame is not None) and what != "volume":
        raise click.UsageError(f"validate {what} takes neither --volume nor --frame")
    if what == "volume":
        if volume is None or particles is None or frame is None or vectors is not None:
            raise click.UsageError("validate volume needs --volume, --particles and --frame, and takes no --vectors")
        from lfpiv_cli.stages import validate_volume

        return validate_volume.validate_volume(volume=volume, particles=particles, frame=frame, **arguments)
    if what == "flow":
        from lfpiv_cli.stages import validate_flow

        return validate_flow.validate_flow(vectors=vectors, particles=particles, **arguments)
    if vectors is not None or particles is not None:
        raise click.UsageError(f"validate {what} takes neither --vectors nor --particles")
    if what == "all":
        from lfpiv_cli.stages import validate_all

        return validate_all.validate_all(**arguments)
    if what == "board":
        from lfpiv_cli.stages import validate_board

        return validate_board.validate_board(**arguments)
    from lfpiv_cli.stages import validate_weights

    return validate_weights.validate_weights(**arguments)


@cli.command("info")
@click.argument("file", type=INPUT)
@click.option("--picture", type=INPUT, help="weights: picture of one voxel's column to write (.png).")
@click.option("--voxel", type=int, nargs=3, metavar="IX IY IZ", help="weights: which voxel; default the middle one.")
@common_options
def info(**arguments: Any) -> dict[str, Any]:
    """Tell what is in a file of ours; of weights, draw the pixels that one voxel lights.

    \b
    Example: lfpiv info weights.h5 --picture column.png --voxel 50 40 120
    """
    from lfpiv_cli.stages import info as stage

    return stage.info(**arguments)


@cli.command("simulate")
@click.argument("what", type=click.Choice(["white", "board", "particles"]))
@click.argument("config", type=INPUT)
@click.option("--depth-mm", type=float, multiple=True, help="With board: in the fluid at this depth; repeatable.")
@click.option("-o", "--output", type=INPUT, required=True, help="Folder for the images and their truth.")
@common_options
def simulate(what: str, depth_mm: tuple[float, ...], **arguments: Any) -> dict[str, Any]:
    """Render raw images through the exact optics, ray by ray, with their truth beside them.

    \b
    Example: lfpiv simulate particles rig.yaml -o simulated
             lfpiv simulate board rig.yaml --depth-mm -4 --depth-mm 0 --depth-mm 4 -o simulated
    """
    from lfpiv_cli.stages import simulate

    if depth_mm:
        if what != "board":
            raise click.UsageError(f"simulate {what} takes no --depth-mm")
        return simulate.simulate_boards(depth_mm=depth_mm, **arguments)
    stage = {
        "white": simulate.simulate_white,
        "board": simulate.simulate_board,
        "particles": simulate.simulate_particles,
    }[what]
    return stage(**arguments)


def main() -> NoReturn:
    """Run the command line and leave with the exit code of the outcome."""
    debug = "--debug" in sys.argv[1:]
    signal.signal(signal.SIGTERM, _terminate)
    try:
        cli.main(standalone_mode=False)
        code = 0
        sys.stdout.flush()
    except click.ClickException as error:
        error.show()
        code = error.exit_code
    except (KeyboardInterrupt, click.Abort):
        code = EXIT_INTERRUPTED
    except Terminated:
        code = EXIT_TERMINATED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    except LfpivError as error:
        if debug:
            raise
        _complain(str(error))
        code = error.exit_code
    except Exception as error:
        if debug:
            raise
        _complain(f"a bug: {type(error).__name__}: {error} (run again with --debug to see where)")
        code = EXIT_BUG
    sys.exit(code)


def _terminate(_signal: int, _frame: FrameType | None) -> None:
    raise Terminated


def _complain(message: str) -> None:
    click.echo(f"lfpiv: {message}".encode("utf-8", "surrogateescape").decode("utf-8", "replace"), err=True)
