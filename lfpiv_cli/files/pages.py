"""A report for people: one HTML page that holds its pictures, prints and needs no network, and the same as Markdown.

The layout is that of the templates beside this module; Jinja2, which fills them, is an optional extra.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.atomic import write_text, written_atomically
from lfpiv_cli.files.inputs import content_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


# Pictures to look at, written like every other output.

DOTS_PER_INCH = 110


def package(name: str, extra: str, what: str = "this") -> Any:
    """Return an optional package, in whose absence the error names which of our extras has it (UsageError)."""
    try:
        return import_module(name)
    except ImportError as error:
        raise UsageError(f'{what} needs {name}: pip install "lfpiv[{extra}]"') from error


# To refuse pictures and pages before anything is computed.
ensure_drawing = partial(package, "matplotlib", "plot", "a picture")
ensure_pages = partial(package, "jinja2", "report", "a report")


def write_picture(path: Path, figure: Figure, overwrite: bool) -> None:
    """Write a figure as PNG; without time stamps, so that the same figure gives the same bytes."""
    with written_atomically(path, overwrite=overwrite) as target:
        figure.savefig(target, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})


def write_pdf(path: Path, figures: Iterable[Figure], overwrite: bool) -> None:
    """Write figures as the pages of a PDF; without time stamps, so that the same figures give the same bytes."""
    from matplotlib.backends.backend_pdf import PdfPages

    with (
        written_atomically(path, overwrite=overwrite) as target,
        PdfPages(target, metadata={"CreationDate": None, "Creator": None, "Producer": None}) as pages,
    ):
        for figure in figures:
            pages.savefig(figure)


@dataclass(frozen=True)
class Table:
    """A table of text; cells that are verdicts (met, missed, unknown; good, look, no) are coloured."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Picture:
    """A PNG file and what it shows; on paper alone where a view stands for it on a screen."""

    path: Path
    caption: str
    on_paper: bool = False


@dataclass(frozen=True)
class Section:
    """A part of a page.

    Attributes
    ----------
    anchor : its name in links
    points : what is said, a line each, with a verdict or nothing before it
    commands : what a person types to make its figures, or settings as they stand in a file
    view : an interactive picture as HTML that loads nothing; on paper, and in Markdown, its pictures stand for it
    """

    title: str
    anchor: str
    text: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()
    commands: tuple[str, ...] = ()
    view: str = ""
    points: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class Page:
    """A page: first words and tables, sections, the line at the foot; how often a browser reads it anew, if it does."""

    title: str
    text: tuple[str, ...]
    tables: tuple[Table, ...]
    sections: tuple[Section, ...]
    foot: str
    reload_s: int | None = None


def write_pages(page: Page, targets: Iterable[Path], overwrite: bool) -> None:
    """Write a page as HTML with its pictures inside, or as Markdown that links to them, as each target's name ends."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    places = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=lambda name: name is not None and name.endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    places.filters |= {
        # A PNG file as an address that holds the picture itself.
        "data_uri": lambda path: "data:image/png;base64," + base64.b64encode(content_of(path)).decode("ascii"),
        "cell": lambda text: text.replace("|", "\\|"),
    }
    for target in targets:
        folder = target.parent
        places.filters["relative"] = lambda path, folder=folder: path.relative_to(folder).as_posix()
        write_text(target, places.get_template(f"page{target.suffix}").render(page=page), overwrite)
