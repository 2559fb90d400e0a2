"""The stage of `plot`: the figures of any file of ours, as PDF or PNG."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.hdf5 import format_of
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.pictures import ensure_drawing, write_pages, write_picture
from lfpiv_cli.stages.plot_sources import ON_IMAGES, READERS, Drawn

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Drawn", "PlotOptions", "figures_of", "plot"]

SUFFIXES = (".png", ".pdf")


@dataclass(frozen=True, kw_only=True)
class PlotOptions:
    """What `plot` draws: names of figures, none for all; and the raw image that the file was made from, to draw on."""

    only: tuple[str, ...] = ()
    raw: Path | None = None


NO_OPTIONS = PlotOptions()


def figures_of(path: Path, raw: Path | None = None) -> dict[str, Drawn]:
    """Return the figures of a file of ours, by name in the order of display; nothing is drawn yet.

    Parameters
    ----------
    raw : image to draw on: for particles the one they were found in, for a calibration its white image

    Raises
    ------
    InputError : the file is missing, broken or of no format that has figures, or the image does not fit it
    UsageError : there is no figure on an image in it
    """
    of_format = format_of(path)
    if of_format in ON_IMAGES:
        return ON_IMAGES[of_format](path, raw)
    if of_format not in READERS:
        raise InputError(f"{path}: {of_format} has no figures, only {', '.join(sorted({*READERS, *ON_IMAGES}))}")
    if raw is not None:
        raise UsageError(f"--raw: figures of {of_format} show no image, only {' and '.join(ON_IMAGES)} do")
    return READERS[of_format](path)


def plot(
    file: Path, output: Path, options: PlotOptions = NO_OPTIONS, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Draw the figures of a file: as pages of one PDF, or as PNG, one for each.

    Raises
    ------
    UsageError : the output is neither, or a name is not one of the file's figures
    """
    if output.suffix not in SUFFIXES:
        raise UsageError(f"{output}: pictures are written as {' or '.join(SUFFIXES)}")
    ensure_drawing()
    figures = figures_of(file, options.raw)
    unknown = [name for name in options.only if name not in figures]
    if unknown:
        raise UsageError(f"--only {unknown[0]}: {file} has the figures {', '.join(figures)}")
    chosen = {name: drawn for name, drawn in figures.items() if not options.only or name in options.only}
    targets = _targets(output, list(chosen))
    for target in targets.values():
        ensure_writable(target, overwrite, given(file=file, raw=options.raw).values())
    with console.progress(len(chosen), "figures") as advance:
        drawn = _drawn(chosen, advance)
        if output.suffix == ".pdf":
            write_pages(output, drawn, overwrite)
        else:
            for target, figure in zip(targets.values(), drawn, strict=True):
                write_picture(target, figure, overwrite)
    return {"figures": list(chosen), "files": [str(target) for target in dict.fromkeys(targets.values())]}


def _targets(output: Path, names: list[str]) -> dict[str, Path]:
    """Return where each figure goes: a PDF holds all, a PNG one; of several each has its name at the end."""
    if output.suffix == ".pdf" or len(names) == 1:
        return dict.fromkeys(names, output)
    return {name: output.with_name(f"{output.stem}_{name}{output.suffix}") for name in names}


def _drawn(figures: Mapping[str, Drawn], advance: Callable[[int], None]) -> Iterator[Figure]:
    """Draw one figure after the other, so that few are in memory."""
    for each in figures.values():
        yield each.draw()
        advance(1)
