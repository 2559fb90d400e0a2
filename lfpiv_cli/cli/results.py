"""Commands of results: what is in them, drawn, on a page, for other programs and beside the truth; and simulations."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any, Literal, cast

import click

from lfpiv_cli.cli import options
from lfpiv_cli.cli.options import FILE, POSITIVE, command, option
from lfpiv_cli.console import Console
from lfpiv_cli.names import ExportFormat, Moment, PaperPart


@command("simulate")
@click.argument("what", type=click.Choice(["white", "board", "particles"]))
@options.config_argument
@option("--depth-mm", float, "With board: in the fluid at this depth; repeatable.", multiple=True)
@options.output_option("Folder for the images and their truth.")
@options.common_options
def simulate(
    what: str, config: Path, depth_mm: tuple[float, ...], output: Path, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Render raw images through the exact optics, ray by ray, with their truth beside them.

    White light, the calibration target, or tracers in the configured flow at the configured seeding density.

    \b
    Example: lfpiv simulate particles rig.yaml -o simulated
             lfpiv simulate board rig.yaml --depth-mm -4 --depth-mm 0 --depth-mm 4 -o simulated
    """
    from lfpiv_cli.verbs import simulate as stage

    if depth_mm:
        if what != "board":
            raise click.UsageError(f"simulate {what} takes no --depth-mm")
        return stage.simulate_boards(config, output, depth_mm, overwrite=overwrite, console=console)
    return stage.SCENES[what](config, output, overwrite=overwrite, console=console)


# The options that each kind of validation takes, and those that it cannot do without.
TAKEN: dict[str, set[str]] = {
    "flow": {"vectors", "particles"},
    "weights": set(),
    "board": set(),
    "volume": {"volume", "particles", "frame"},
    "all": set(),
    "paper": {"quick", "only", "resume"},
}
NEEDED = {"volume": ("volume", "particles", "frame")}


@command("validate")
@click.argument("what", type=click.Choice(list(TAKEN)))
@click.argument("config", type=FILE, required=False)
@option("--vectors", FILE, "flow: vectors to judge, not those of a simulation.")
@option("--volume", FILE, "volume: volume to judge.")
@option(
    "--particles", FILE, "volume, flow: true particles (.npz) to judge by; a flow that the config names comes first."
)
@option("--frame", Moment, "volume: when in the pair it was taken.")
@option("--quick", bool, "paper: reduced sizes, at most ten minutes on two cores.")
@option("--only", PaperPart, "paper: one part; repeatable.", multiple=True)
@options.resume_option
@options.output_option("Folder for the report.")
@options.common_options
def validate(
    what: str, output: Path, overwrite: bool, console: Console, config: Path | None = None, **chosen: Any
) -> dict[str, Any]:
    """Compare a result with what is known: figures as JSON, and pictures.

    \b
    Example: lfpiv validate flow rig.yaml --vectors vectors.vtkhdf -o report
             lfpiv validate flow rig.yaml -o report    (simulates the rig's experiment first)
             lfpiv validate weights rig.yaml -o report
             lfpiv validate board rig.yaml -o report
             lfpiv validate all rig.yaml -o report     (weights, board, and flow as it is simulated)
             lfpiv validate volume rig.yaml --volume a.vtkhdf --particles true.npz --frame a -o report
             lfpiv validate paper --quick -o report    (the paper's tables and figures on one page; takes no CONFIG)
    """
    chosen = {name: value for name, value in chosen.items() if value not in (False, ())}
    misplaced = [f"--{name}" for name in chosen if name not in TAKEN[what]]
    if misplaced:
        raise click.UsageError(f"validate {what} takes no {' and no '.join(misplaced)}")
    missing = [f"--{name}" for name in NEEDED.get(what, ()) if name not in chosen]
    if missing:
        raise click.UsageError(f"validate {what} needs {' and '.join(missing)}")
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    if what == "paper":
        from lfpiv_cli.paper.run import PaperOptions, validate_paper

        if config is not None:
            raise click.UsageError(f"validate paper takes no CONFIG, got {config}")
        size: Literal["quick", "full"] = "quick" if chosen.pop("quick", False) else "full"
        return validate_paper(output, PaperOptions(size=size, **chosen), **common)
    if config is None:
        raise click.UsageError(f"validate {what} needs a CONFIG")
    stage = getattr(import_module("lfpiv_cli.verbs.validate"), f"validate_{what}")
    return cast(dict[str, Any], stage(config, output, **common, **chosen))


@command("report")
@click.argument("folder", type=FILE)
@option("--raw", FILE, "Raw images, white ones too, to show what was found on them.", multiple=True)
@options.output_option("Page to write (.html).")
@options.common_options
@options.calls("report.report", "ReportOptions", "folder", "output")
def report() -> None:
    """Make one page of a folder of results, or of one of its files: verdict, pictures, figures, settings and warnings.

    It needs no truth, holds all its pictures and loads nothing, so that it can be handed on as it is; tracks can be
    turned in it, and it prints. The verdict is of calibration, images and vectors: good, look (at the reasons) or no.

    \b
    Example: lfpiv report results -o results/report.html
             lfpiv report results --raw a.tif --raw white.tif -o results/report.html
    """


@command("export")
@click.argument("files", type=FILE, nargs=-1, required=True)
@option("--to", ExportFormat, "Format to write.", required=True)
@option("--plane", click.IntRange(min=0), "Only this plane across z, counted from 0.")
@option("--step-s", POSITIVE, "Time from one file to the next; without it they are numbered 0, 1, 2, ...")
@options.output_option("File to write; beside FILE and named like it when not given.", required=False)
@options.common_options
@options.calls("export.export", "ExportOptions", "files", "output")
def export() -> None:
    """Write vectors, volumes, particles or tracks in the format of another program, to the last bit.

    \b
    netcdf         all: vectors for pivpy and xarray, of several times, too
    tecplot        all, as text
    csv            all but volumes
    mat            all: Matlab, and the tracks of a sequence for flowtracks
    vti            volumes, vectors: VTK, PyVista
    vtp            particles, tracks: VTK, PyVista
    vtkhdf-series  vectors or volumes of several times, or the tracks of a sequence, for ParaView to play

    \b
    Example: lfpiv export vectors.vtkhdf --to netcdf
             lfpiv export vectors/*.vtkhdf --to vtkhdf-series --step-s 0.002 -o series.vtkhdf
             lfpiv export tracks.vtkhdf --to mat -o tracks.mat
    """


@command("info")
@click.argument("file", type=FILE)
@option("--picture", FILE, "weights: picture of one voxel's pixels to write (.png).")
@option("--voxel", int, "weights: which voxel; default the middle one.", nargs=3, metavar="IX IY IZ")
@options.common_options
@options.raw_option
@options.calls("plot.info", "InfoOptions", "file")
def info() -> None:
    """Describe a file that lfpiv wrote, or a recording; of weights, draw the point-spread function of one voxel.

    \b
    Example: lfpiv info weights.h5 --picture column.png --voxel 50 40 120
    of a camera's recording, its pages, size, bits and frame rate:
             lfpiv info shot.cine
    """


@command("plot")
@click.argument("file", type=FILE)
@options.output_option("PDF with a page for each figure, or PNG: one figure, or of several P_NAME.png for each.")
@option("--only", str, "This figure only; may be repeated. Default: all.", multiple=True, metavar="NAME")
@option("--raw", FILE, "Image to draw on: the raw one that particles were found in, a calibration's white image.")
@options.common_options
@options.calls("plot.plot", "PlotOptions", "file", "output")
def plot() -> None:
    """Draw what is in a file: vectors, tracks, particles, a volume, a calibration or weights.

    \b
    Example: lfpiv plot vectors.vtkhdf -o vectors.pdf
    Example: lfpiv plot vectors.vtkhdf --only planes -o planes.png
    """


@command("warm-up")
@option("--cache", FILE, "Folder to fill.", show_default="where lfpiv keeps compiled code")
@options.common_options
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
    from lfpiv_cli.verbs import run as stage

    return stage.warm_up(console=console)
