"""What these documents take from the code and from the sample, made anew when either has changed.

Everything goes into `docs/_generated`, which is not kept: the sample's chain with its pictures and what it prints, a
page for each command, the Python interface, the tree of the package, the drawings of the light's way and of a pipe's
board, a tracer's light by rays and waves, statistics of a turbulent channel, the figures, and the gallery.
"""

from __future__ import annotations

import ast
import contextlib
import hashlib
import inspect
import io
import re
import runpy
import shutil
import typing
from collections.abc import Iterator
from pathlib import Path

import click_commands
import drawing
import figures
import light_figure
import matplotlib
import matplotlib.pyplot as plt
import statistics_figure
from click.testing import CliRunner

import lfpiv_cli
from lfpiv_cli.cli.main import cli

# Scripts of the gallery draw into files, whatever screen there is.
matplotlib.use("Agg")

DOCS = Path(__file__).parent
ROOT = DOCS.parent
PACKAGE = ROOT / "lfpiv_cli"
GENERATED = DOCS / "_generated"
SAMPLE = GENERATED / "sample"
GALLERY = ROOT / "examples" / "gallery"
# Its scripts, in the order of the page: from one voxel to statistics.
SCRIPTS = (
    *("one_voxel", "tracer_by_depth", "another_camera", "calibration_residuals", "covariance_ellipses"),
    *("seeding_and_error", "profile", "tracks_by_speed", "kriging_and_bins", "divergence_and_pressure", "convergence"),
)

RIG = "--dark dark.tif"
# The sample's chain as the page Start types it, and the pictures that other pages show.
CHAIN = {
    "calibrate": f"calibrate-snapshot rig.yaml --white white.tif {RIG} --board board.tif -o calibration.h5 "
    "--picture calibration.png --views views.png",
    "weights": "build-weights rig.yaml --calibration calibration.h5 -o weights.h5",
    "reconstruct": f"reconstruct weights.h5 a.tif b.tif {RIG} -o volumes",
    "correlate": "correlate volumes/a.vtkhdf volumes/b.vtkhdf -o vectors.vtkhdf",
    "flow": "validate flow rig.yaml --vectors vectors.vtkhdf -o report",
    "info": "info weights.h5 --picture column.png --voxel 15 11 30",
    "particles": f"reconstruct weights.h5 a.tif b.tif {RIG} --solver particles --pairing ab -o particles",
    "track": "track particles/a.vtkhdf particles/b.vtkhdf -o tracks.vtkhdf --grid",
    "flow_particles": "validate flow rig.yaml --vectors tracks_grid.vtkhdf -o report_particles",
    "plot": "plot tracks_grid.vtkhdf --only planes -o planes.png",
    "refine": f"refine-calibration rig.yaml a.tif b.tif --calibration calibration.h5 {RIG} --picture walls.png",
}
# The sample's files under the names that the pages use.
INPUTS = {
    "rig.yaml": ROOT / "configs" / "sample.yaml",
    "white.tif": ROOT / "sample_data" / "white.tif",
    "dark.tif": ROOT / "sample_data" / "dark.tif",
    "board.tif": ROOT / "sample_data" / "board.tif",
    "a.tif": ROOT / "sample_data" / "pair_a.tif",
    "b.tif": ROOT / "sample_data" / "pair_b.tif",
}


def everything() -> None:
    """Make all that is generated."""
    GENERATED.mkdir(exist_ok=True)
    (GENERATED / "light.svg").write_text(drawing.light(), encoding="utf-8")
    (GENERATED / "pipe_board.svg").write_text(drawing.board_of_a_pipe(), encoding="utf-8")
    print("docs: light by waves, statistics of a channel", flush=True)
    light_figure.write_figure(ROOT / "configs" / "table2.yaml", GENERATED / "light_by_waves.png")
    statistics_figure.write_figure(INPUTS["rig.yaml"], GENERATED / "statistics.png")
    (GENERATED / "tree.md").write_text("\n".join(tree()) + "\n", encoding="utf-8")
    (GENERATED / "gallery.md").write_text("\n".join(gallery()) + "\n", encoding="utf-8")
    (GENERATED / "interface.md").write_text("\n".join(interface()) + "\n", encoding="utf-8")
    write_command_pages()
    run_sample()


def run_sample() -> None:
    """Run the sample's chain and draw the figures, unless that was done with the same code and the same data."""
    stamp = SAMPLE / "made_from"
    made_from = fingerprint()
    if stamp.exists() and stamp.read_text() == made_from:
        return
    shutil.rmtree(SAMPLE, ignore_errors=True)
    SAMPLE.mkdir(parents=True)
    for name, source in INPUTS.items():
        shutil.copyfile(source, SAMPLE / name)
    with contextlib.chdir(SAMPLE):
        for name, arguments in CHAIN.items():
            print(f"docs: lfpiv {arguments}", flush=True)
            # In this process: to load all anew for each would take as long as the work.
            done = CliRunner().invoke(cli, arguments.split())
            if done.exit_code:
                raise RuntimeError(f"lfpiv {arguments}: exit code {done.exit_code}: {done.output}")
            # As a terminal shows it: words at work and the answer in their order.
            Path(f"{name}.txt").write_text(f"$ lfpiv {arguments}\n{done.output}", encoding="utf-8")
    figures.write_all(GENERATED / "figures", SAMPLE)
    for name in SCRIPTS:
        print(f"docs: gallery {name}", flush=True)
        with contextlib.chdir(SAMPLE), contextlib.redirect_stdout(io.StringIO()):
            runpy.run_path(str(GALLERY / f"{name}.py"))
        plt.close("all")
    stamp.write_text(made_from)


def fingerprint() -> str:
    """Return a hash of the package, the figures, the sample and the chain."""
    digest = hashlib.sha256(repr(CHAIN).encode())
    drawn_from = [DOCS / "figures.py", *sorted((DOCS / "accuracy").iterdir()), *sorted(GALLERY.glob("*.py"))]
    for path in [*sorted(PACKAGE.rglob("*.py")), *drawn_from, *INPUTS.values()]:
        digest.update(path.read_bytes())
    return digest.hexdigest()


def gallery() -> Iterator[str]:
    """Yield the scripts of the gallery: what each is about, its picture and its code."""
    for name in SCRIPTS:
        text = (GALLERY / f"{name}.py").read_text(encoding="utf-8")
        title, about = (ast.get_docstring(ast.parse(text)) or "").split("\n\n", 1)
        yield from (f"## {title.rstrip('.')}\n", f"{about}\n", f"```{{image}} /_generated/sample/{name}.png")
        yield from (f":alt: {title}\n```\n", f"```{{literalinclude}} /../examples/gallery/{name}.py")
        yield from (":language: python", ":start-at: import", "```\n")


def write_command_pages() -> None:
    """Write a page for each command, which sphinx-click fills."""
    folder = GENERATED / "commands"
    folder.mkdir(exist_ok=True)
    names = click_commands.names()
    for old in folder.iterdir():
        if old.stem not in names:
            old.unlink()
    for name in names:
        page = f".. click:: click_commands:{name.replace('-', '_')}\n   :prog: lfpiv {name}\n   :nested: full\n"
        (folder / f"{name}.rst").write_text(page, encoding="utf-8")


def example(lines: list[str]) -> Iterator[str]:
    """Yield a help's example as reStructuredText: commands with what continues them as code, words between as text."""
    code: list[str] = []
    for line in (line.removeprefix("|").strip() for line in lines):
        goes_on = bool(code) and code[-1].endswith("\\")
        words, command = ("", line) if goes_on else re.fullmatch(r"(.*?)\s*((?:lfpiv .*)?)", line).groups()
        if words:
            yield from code_block(code)
            code = []
            yield from (words, "")
        if command:
            code.append(f"    {command}" if goes_on else command)
    yield from code_block(code)


def code_block(code: list[str]) -> Iterator[str]:
    """Yield lines as a block of code, if there are any."""
    if code:
        yield from (".. code-block:: text", "", *(f"   {line}" for line in code), "")


def interface() -> Iterator[str]:
    """Yield what the package promises to Python, as directives: its functions, its classes, and what those return."""
    promised = [getattr(lfpiv_cli, name) for name in lfpiv_cli.__all__]
    functions = [thing for thing in promised if inspect.isfunction(thing)]
    classes = [thing for thing in promised if inspect.isclass(thing)]
    returned = {typing.get_type_hints(function)["return"] for function in functions}
    ours = {thing for thing in returned if inspect.isclass(thing) and thing.__module__.startswith("lfpiv_cli.")}
    # What all of them can do, once.
    ours |= {base for thing in ours for base in thing.__mro__ if base.__module__ == "lfpiv_cli.results"}
    yield "```{eval-rst}"
    for function in functions:
        yield f".. autofunction:: lfpiv_cli.{function.__name__}\n"
    for thing in [*classes, *sorted(ours, key=lambda thing: thing.__name__)]:
        yield f".. autoclass:: {thing.__module__}.{thing.__qualname__}\n   :members:\n"
    yield "```"


def tree() -> Iterator[str]:
    """Yield the package's folders and modules with the first sentence of their docstrings."""
    yield from module_lines(PACKAGE, sorted(PACKAGE.glob("*.py")))
    for folder in sorted(path for path in PACKAGE.iterdir() if (path / "__init__.py").exists()):
        yield f"\n### {folder.name}/\n"
        own = first_sentence(folder / "__init__.py")
        if own:
            yield f"{own}\n"
        modules = sorted(path for path in folder.rglob("*.py") if path != folder / "__init__.py")
        yield from module_lines(folder, modules)


def module_lines(folder: Path, modules: list[Path]) -> Iterator[str]:
    """Yield a table of modules."""
    if modules:
        yield "| module | what it does |\n|---|---|"
    for path in modules:
        yield f"| `{path.relative_to(folder).as_posix()}` | {first_sentence(path) or ''} |"


def first_sentence(module: Path) -> str | None:
    """Return the first line of a module's docstring, as text in which nothing is markup."""
    text = ast.get_docstring(ast.parse(module.read_text(encoding="utf-8")))
    return (
        text.split("\n\n")[0].replace("\n", " ").replace("|", r"\|").replace("*.vtkhdf", r"\*.vtkhdf") if text else None
    )
