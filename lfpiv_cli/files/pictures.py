"""Pictures to look at, written like every other output. Drawing needs the optional package matplotlib."""

from __future__ import annotations

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
