"""Commands that measure: the whole chain, volumes and particles, vectors, tracks and fields."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any

import click

from lfpiv_cli.cli import options
from lfpiv_cli.cli.options import CONFIGS, FILE, POSITIVE, command, option
from lfpiv_cli.errors import UsageError
from lfpiv_cli.names import Divergence, GridMethod, Kept, RunMethod, Start, Weighting
from lfpiv_cli.reconstruction.registry import SolverName


def particles_in(_context: click.Context, _option: click.Parameter, folder: Path | None) -> tuple[Path, ...] | None:
    """Return the files of particles in a folder, if it is given."""
    from lfpiv_cli.files.batch import expanded

    return None if folder is None else tuple(expanded([folder], "results"))


@command("field")
@click.argument("samples", type=FILE, nargs=-1, required=True)
@options.dt_option
@option(
    "--divergence",
    Divergence,
    "Held down as far as the data ask for (penalised, the default), none (free), or not known (off).",
)
@option("--frame", click.IntRange(min=0), "Frame of a sequence's tracks, from 0; the middle one.")
@option("--derived", bool, "Also write vorticity, divergence, strain rate, Q criterion, gradients.")
@option("--at", FILE, "File of points (x, y, z in mm a line); velocities there go to OUTPUT's name with _at.csv.")
@option(
    "--pressure",
    FILE,
    "Folder of the particles of all frames of a sequence: the pressure is found by its tracks' accelerations.",
    callback=particles_in,
)
@options.output_option("File of vectors to write (.vtkhdf).")
@options.common_options
@options.calls("field.fit_flow", "FieldOptions", "samples", "output")
def field() -> None:
    """Fit one velocity field to tracks and vectors of a flow, each weighed by its error.

    The field is smooth and, in a liquid, free of divergence as far as the data ask for; where no track is near, the
    vector is rejected. It is written on correlate's grid.

    \b
    Example: lfpiv field tracks.vtkhdf -o field.vtkhdf
             lfpiv field tracks.vtkhdf vectors.vtkhdf --derived -o field.vtkhdf
             lfpiv field run/tracks.vtkhdf --pressure run/particles -o field.vtkhdf
    """


@command("track")
@options.inputs_argument("particles", "results")
@options.dt_option
@option("--search", POSITIVE, "Largest displacement, voxels.", "search_voxel", show_default="found from the particles")
@option(
    "--shortest",
    click.IntRange(min=2),
    "Sequence: fewest frames of a track, shorter ones are ghosts.",
    show_default="3",
)
@option("--grid", bool, "Also write vectors on correlate's grid, as OUTPUT's name with _grid.")
@option("--by", GridMethod, "With --grid: local polynomials (the default), or one field of splines, as of field.")
@options.pairing_options
@options.batch_options
@options.output_option("File of tracks to write (.vtkhdf), folder for several pairs.")
@options.common_options
@options.calls("track.track_particles", "TrackOptions", "particles", "output")
def track() -> None:
    """Follow particles from one frame to the next, or over a sequence: particle tracking velocimetry (PTV).

    Two files give a displacement for each particle that is in both. More than two, in the order of time, give tracks:
    each place with the number of its track and frame and with a velocity by a local polynomial in time; --grid then
    writes one file for each interval between frames (OUTPUT's name with _grid_0000, ...). With --pairing ab they are
    separate pairs by their names, and each gives a file.

    \b
    Example: lfpiv track particles/a.vtkhdf particles/b.vtkhdf -o tracks.vtkhdf --grid
             lfpiv track particles/frame_*.vtkhdf -o tracks.vtkhdf --grid
             lfpiv track particles --pairing ab --grid --resume --keep-going -o tracks
    with particles from
             lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif --solver particles -o particles
    """


@command("follow")
@click.argument("weights", type=FILE)
@options.inputs_argument("frames")
@options.dark_option
@options.background_option
@options.mask_option
@options.dt_option
@option(
    "--search",
    POSITIVE,
    "Largest displacement from the first frame to the second, voxels.",
    "search_voxel",
    show_default="found from the particles",
)
@option("--shortest", click.IntRange(min=2), "Fewest frames of a track, shorter ones are ghosts.", default=4)
@option("--both-ways", bool, "Go a second time through the frames, each by its tracks before and after it.")
@option("--residuals", bool, "Also write what the particles leave of each image.")
@options.work_options
@options.output_option("Folder for the particles of each frame and the tracks.")
@options.common_options
@options.raw_option
@options.calls("follow.follow_particles", "FollowOptions", "weights", "frames", "output")
def follow() -> None:
    """Find and track the particles of a time-resolved sequence together, as in Shake-The-Box.

    The first two frames are searched as a pair. Then each track predicts where its particle is in the next frame, the
    predicted particles are refined together on the image, and only what they leave of it is searched for others. Frames
    are taken in the order of their numbers, or the pages of one file. With --keep-going, tracks end before a frame that
    cannot be read, and others begin behind it.

    \b
    Writes OUTPUT/particles/STEM.vtkhdf for each frame, as reconstruct does, OUTPUT/tracks.vtkhdf, as track does,
    and OUTPUT/playback.vtkhdf, in which ParaView plays the tracks in time.

    \b
    Example: lfpiv follow weights.h5 run.tif --dark dark.tif -o run
             lfpiv follow weights.h5 frame_*.tif --dark dark.tif --both-ways -o run
    before the limit of a job it stops, and the same command goes on:
             lfpiv follow weights.h5 run.tif --dark dark.tif --time-limit 50m --resume -o run
    """


def parse_sides(text: str) -> tuple[float, float, float]:
    """Return the sides of bins in mm, given as 1 or 1x1x2."""
    try:
        sides = [float(each) for each in text.lower().split("x")]
    except ValueError:
        sides = []
    if len(sides) not in (1, 3) or not all(0.0 < side < float("inf") for side in sides):
        raise UsageError(f"--bin-mm: {text!r} is neither a length in mm nor three of them, as 1x1x2")
    return (sides[0], sides[len(sides) // 2], sides[-1])


def parse_windows(text: str) -> tuple[int | tuple[int, ...], ...]:
    """Return windows given as 32,16 or 32x32x16,16x16x8."""
    windows: list[int | tuple[int, ...]] = []
    for part in text.split(","):
        try:
            sizes = tuple(int(size) for size in part.lower().split("x"))
        except ValueError as error:
            raise UsageError(
                f"--windows: {part!r} is neither a number of voxels nor three of them as 32x32x16"
            ) from error
        windows.append(sizes[0] if len(sizes) == 1 else sizes)
    return tuple(windows)


@command("correlate")
@options.inputs_argument("volumes", "results")
@option("--config", FILE, "In place of the config carried by the volumes.")
@options.dt_option
@option("--windows", parse_windows, "Interrogation windows in voxels, coarse to fine, as 32,16.")
@option("--overlap", click.FloatRange(min=0.0, max=1.0, max_open=True), "Of neighbouring windows.")
@option("--weighting", Weighting, "How voxels count by their place in a window.")
@options.pairing_options
@option("--mask", FILE, "Volume on the same grid: voxels of 0 are left out.", "mask_volume")
@option("--ensemble", bool, "One field of all pairs together, for a flow that does not change.")
@option("--derived", bool, "Also write vorticity, divergence, strain rate and Q criterion.")
@option(
    "--mean",
    FILE,
    "File of the pairs' mean and fluctuations to write (.vtkhdf); of vectors or tracks that are there, too.",
)
@options.batch_options
@options.watch_options("60")
@options.output_option("File for one pair, folder for several.", required=False)
@options.common_options
@options.calls("correlate.correlate_files", "CorrelateOptions", "volumes", "output")
def correlate() -> None:
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


@command("combine")
@click.argument("vectors_a", type=FILE)
@click.argument("vectors_b", type=FILE)
@options.output_option("File of combined vectors to write (.vtkhdf).")
@options.common_options
@options.calls("combine.combine_vectors", None, "vectors_a", "vectors_b", "output")
def combine() -> None:
    """Weight two vector fields on one grid by their uncertainties, those of correlate and of track --grid.

    A vector that has none, or that disagrees with the other and with those around it, is left out; share_a is the
    weight of the first file in each component, disagreement how many standard errors lie between the two.

    \b
    Example: lfpiv combine vectors.vtkhdf tracks_grid.vtkhdf -o combined.vtkhdf
    """


@command("statistics")
@options.inputs_argument("samples", "results")
@option(
    "--bin-mm",
    parse_sides,
    "Of tracks: sides of the bins that they are sorted into, as 1 or 1x1x2.",
    show_default="the final windows'",
)
@option("--fewest", click.IntRange(min=5), "Of tracks: bins with fewer have no statistics.", show_default="20")
@option(
    "--profile",
    str,
    "Along an axis (z), a line (z@x=0,y=1.5), or by the distance from an axis (r@x).",
    show_default="z",
)
@options.resume_option
@options.output_option("File of statistics to write (.vtkhdf).")
@options.common_options
@options.calls("statistics.statistics_of_files", "StatisticsOptions", "samples", "output")
def statistics() -> None:
    """Mean, rms, Reynolds stresses, skewness and kinetic energy of a flow over many pairs, with standard errors.

    Vectors count at the nodes of their grid, tracks where they are, in bins (ensemble PTV), in which a linear trend is
    no fluctuation. The measurement's stated noise is taken out of the stresses; they are there with it, too. Errors are
    by block bootstrap over the pairs, in the order of their names: how long the flow remembers is estimated from them.

    `lfpiv report` makes a page of the file, `lfpiv plot` its pictures.

    \b
    Example: lfpiv statistics vectors -o statistics.vtkhdf
             lfpiv statistics tracks --bin-mm 1x1x2 --profile z@x=0,y=0 -o statistics.vtkhdf
             lfpiv statistics run/tracks.vtkhdf --profile r@x -o statistics.vtkhdf
    """


def named_images(command: Callable[..., Any]) -> Callable[..., Any]:
    """Let a command take its images by the option --images, too."""

    @option("--images", FILE, "The same: images of the flow.", "named", multiple=True)
    @wraps(command)
    def run(named: tuple[Path, ...], images: tuple[Path, ...], **arguments: Any) -> Any:
        return command(images=(*named, *images), **arguments)

    return run


@command("run")
@options.config_argument
@named_images
@options.inputs_argument("images")
@options.white_option
@options.dark_option
@options.board_option
@options.depth_option
@options.background_option
@options.mask_option
@option("--method", RunMethod, "By what the flow is measured.", show_default="auto")
@options.pairing_options
@options.dt_option
@option("--combine", bool, "With both: also one field that weights their vectors.")
@option("--follow", bool, "Time-resolved sequence: find and track particles together.")
@option(
    "--keep",
    Kept,
    "results: drop volumes, and particles of separate pairs, as soon as their vectors stand.",
    show_default="all",
)
@options.batch_options
@option("--report/--no-report", bool, "Make OUTPUT/report.html, a page of all of it.", default=True)
@options.watch_options("by Ctrl-C")
@options.output_option("Folder for all that is made.")
@options.common_options
@options.raw_option
@options.calls("run.run", "RunOptions", "config", "output")
def run() -> None:
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
    all of them by eight workers on this machine, or by those of a cluster's scheduler:
             lfpiv run rig.yaml images --pairing ab --white white.tif --dark dark.tif --board board.tif \\
                 --dask local:8 -o results
    at the camera, each pair as it is written: a line for it, and OUTPUT/latest.html for the browser:
             lfpiv run rig.yaml --watch images --white white.tif --dark dark.tif --board board.tif -o results
    """


@command("reconstruct")
@click.argument("weights", type=FILE)
@options.inputs_argument("images")
@option("--solver", SolverName, "Of volumes, or particles.", show_default=CONFIGS)
@option("--iterations", click.IntRange(min=1), "Steps of the solver.", show_default=CONFIGS)
@option("--relaxation", click.FloatRange(min=0.0, min_open=True, max=2.0), "mu of Eq. 12.", show_default=CONFIGS)
@option("--accelerate/--no-accelerate", bool, "Extrapolate between steps.", default=None, show_default=CONFIGS)
@option("--start", Start, "First volume.", show_default=CONFIGS)
@options.dark_option
@options.background_option
@options.mask_option
@options.pairing_options
@option(
    "--residual/--no-residual",
    bool,
    "Of particles, also write what they leave of each image, as OUTPUT's name with _residual.tif; written when "
    "not given.",
    default=None,
)
@options.batch_options
@options.watch_options("60")
@options.output_option("File for one image, folder for several.")
@options.common_options
@options.raw_option
@options.calls("reconstruct.reconstruct_files", "ReconstructOptions", "weights", "images", "output")
def reconstruct() -> None:
    """Reconstruct the volume of tracer particles behind each image (tomographic reconstruction).

    With --solver particles it finds the particles themselves by iterative particle reconstruction: each is fitted to
    the raw image, and ghost particles are removed; with --pairing, neighbouring frames help each other. Hot and dead
    pixels of the dark image are left out.

    \b
    Example: lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif -o volumes
    particles of a pair:
             lfpiv reconstruct weights.h5 a.tif b.tif --dark dark.tif --solver particles --pairing ab -o particles
    frames without a header:
             lfpiv reconstruct weights.h5 shot.raw --raw 2352x1768x12:packing=low-first -o volumes
    over a long sequence, the background of each frame from the fifteen around it:
             lfpiv reconstruct weights.h5 run.tif --background minimum:15 --mask mask.png -o volumes
    all images of a folder, in the order of their numbers, and those of a list:
             lfpiv reconstruct weights.h5 images --files-from more.txt --resume --keep-going -o volumes
    on a cluster, a third of them; on this machine, by four processes; while the camera still writes them:
             lfpiv reconstruct weights.h5 images --shard 2/3 --time-limit 50m --resume -o volumes
             lfpiv reconstruct weights.h5 images --dask local:4 -o volumes
             lfpiv reconstruct weights.h5 images --watch --idle-s 30 -o volumes
    """
