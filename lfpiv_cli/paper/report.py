"""The page about the paper, made of what its parts have found."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lfpiv_cli.files.pages import Page, Picture, Section, Table
from lfpiv_cli.names import PaperPart, Size
from lfpiv_cli.notice import written
from lfpiv_cli.paper.parts import Row, rows_of

TITLE = "Equivalent ray tracing for light-field PIV: the paper's tables and figures, computed"
HEAD = (
    "quantity",
    "paper, DLFC",
    "paper, ERT",
    "ours, DLFC as the paper did it",
    "ours, ERT as the paper did it",
    "ours at its best",
    "limit",
    "verdict",
    "source",
)
SIZES: dict[Size, str] = {
    "full": "Everything was computed at the paper's sizes.",
    "quick": (
        "This is the quick report: sizes, numbers of boards, tracers and iterations are reduced, so that its figures "
        "show that the chain works and are not those of the full report."
    ),
    "tiny": "This is a test of the report's making: sizes are far too small for its figures to mean anything.",
}


def page_of(
    parts: Mapping[PaperPart, Mapping[str, Any]],
    titles: Mapping[PaperPart, str],
    folder: Path,
    size: Size,
    made: Mapping[str, Any],
) -> Page:
    """Return the page of parts, whose pictures lie below a folder."""
    rows = [row for part in parts.values() for row in rows_of(part["rows"])]
    met = sum(row.verdict == "met" for row in rows)
    minutes = sum(part["seconds"] for part in parts.values()) / 60.0
    text = (
        f"{SIZES[size]} {met} of {len(rows)} limits are met. DLFC stands for rays fitted to boards that are moved "
        "through the flow, ERT for equivalent ray tracing from one snapshot. As the paper did it means SART with 200 "
        "iterations on voxels of 0.1 mm; at its best means this program's own choice (fine voxels, or particles "
        "instead of voxels). The verdict is of our best where there is one; the limit is the paper's value by ERT "
        "where nothing else is said. All images are simulated; each part says with which faults.",
        f"The parts took {minutes:.0f} minutes.",
    )
    notes = tuple(f"{row.quantity} ({row.source}): {row.reason}" for row in rows if row.reason)
    table = Table("All quantities", HEAD, tuple(_cells(row) for row in rows))
    sections = [_section(name, titles[name], part, folder, size) for name, part in parts.items()]
    libraries = ", ".join(f"{name} {version}" for name, version in made["libraries"].items())
    foot = f"Made by lfpiv {made['version']} ({libraries})."
    if notes:
        sections.append(Section("Where ours as the paper did it differs, and why", "reasons", notes))
    return Page(TITLE, text, (table,), tuple(sections), foot)


def _section(name: PaperPart, title: str, part: Mapping[str, Any], folder: Path, size: Size) -> Section:
    tables = [Table(each["caption"], tuple(each["head"]), tuple(map(tuple, each["rows"]))) for each in part["tables"]]
    seeds = f"Seeds {', '.join(map(str, part['seeds']))}. " if part["seeds"] else ""
    return Section(
        title,
        name,
        (*part["text"], f"{seeds}This part took {_duration(part['seconds'])}."),
        tuple(tables),
        tuple(Picture(folder / each["path"], each["caption"]) for each in part["pictures"]),
        (*part["commands"], f"lfpiv validate paper {'--quick ' if size == 'quick' else ''}-o . --resume --only {name}"),
    )


def _cells(row: Row) -> tuple[str, ...]:
    values = (row.paper_dlfc, row.paper_ert, row.dlfc, row.ert, row.best)
    sense = "≤" if row.sense == "at most" else "≥"
    return (row.quantity, *map(_number, values), f"{sense} {written(row.limit, 4)}", row.verdict, row.source)


def _number(value: float | None) -> str:
    return "–" if value is None else written(value)


def _duration(seconds: float) -> str:
    return f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"
