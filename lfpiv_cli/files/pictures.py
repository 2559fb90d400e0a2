"""Pictures to look at, written like every other output. Drawing needs the optional package matplotlib."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.atomic import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DOTS_PER_INCH = 110


def ensure_drawing() -> None:
    """Refuse pictures, before anything is computed, where matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise UsageError('pictures need matplotlib: pip install "lfpiv[plot]"') from error


def write_picture(path: Path, figure: Figure, overwrite: bool) -> None:
    """Write a figure as PNG; without time stamps, so that the same figure gives the same bytes."""

    def save(target: Path) -> None:
        figure.savefig(target, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})

    write_atomically(path, save, overwrite=overwrite)


def write_pages(path: Path, figures: Iterable[Figure], overwrite: bool) -> None:
    """Write figures as the pages of a PDF; without time stamps, so that the same figures give the same bytes."""
    from matplotlib.backends.backend_pdf import PdfPages

    def save(target: Path) -> None:
        with PdfPages(target, metadata={"CreationDate": None, "Creator": None, "Producer": None}) as pages:
            for figure in figures:
                pages.savefig(figure)

    write_atomically(path, save, overwrite=overwrite)
