"""`validate paper`: the parts of the report one after the other, and the page that is made of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.files import pages
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.provenance import record
from lfpiv_cli.names import PaperPart, Size
from lfpiv_cli.notice import written
from lfpiv_cli.paper.bubbles import bubbles
from lfpiv_cli.paper.camera import discussion, focal_plane, table1, table2
from lfpiv_cli.paper.faults import faults
from lfpiv_cli.paper.parts import Findings, Work, kept, read_json, rows_of
from lfpiv_cli.paper.sensitivities import sensitivities
from lfpiv_cli.paper.table3 import table3
from lfpiv_cli.paper.table4 import table4


@dataclass(frozen=True)
class Part:
    """A part: what makes it, what of the paper it covers, and how long it takes on two cores, quick and full."""

    find: Callable[[Work], Findings]
    title: str
    quick_minutes: float
    full_minutes: float


# The parts of the report, in the order in which they are made and shown; a new one is a line here and in `names`.
PARTS: dict[PaperPart, Part] = {
    "table1": Part(table1, "Weights of single voxels (Table 1, Figs. 5 and 6)", 0.5, 4.0),
    "table2": Part(table2, "The camera (Table 2)", 0.01, 0.01),
    "table3": Part(
        partial(table3, half="ideal"), "Boards, an ideal camera (Table 3, numerical; Figs. 8 to 11)", 0.8, 20.0
    ),
    "table3-experiment": Part(
        partial(table3, half="recorded"),
        "Boards, a camera as real ones are, simulated (Table 3, experiment; Figs. 12 and 13)",
        0.8,
        22.0,
    ),
    "focal-plane": Part(focal_plane, "The focal plane from one snapshot (Eq. 21)", 0.5, 3.0),
    "table4": Part(table4, "The laminar channel flow (Section 4.2, Figs. 14-16 and 18, Table 4)", 1.2, 15.0),
    "bubbles": Part(bubbles, "Bubbles on the wall (Fig. 17)", 0.5, 2.5),
    "discussion": Part(discussion, "Depth resolution and seeding (the paper's discussion)", 0.1, 0.5),
    "sensitivities": Part(sensitivities, "What matters, and how much", 2.0, 8.0),
    "faults": Part(faults, "Planted mistakes", 0.3, 0.3),
}

# The page about the paper, made of what its parts have found.

TITLE = "Equivalent ray tracing for light-field PIV: the paper's tables and figures, computed"
OURS = ("ours, DLFC as the paper did it", "ours, ERT as the paper did it", "ours at its best")
HEAD = ("quantity", "paper, DLFC", "paper, ERT", *OURS, "limit", "verdict", "source")
SIZES: dict[Size, str] = {
    "full": "Everything was computed at the paper's sizes.",
    "quick": (
        "This is the quick report: sizes, numbers of boards, tracers and iterations are reduced, so that its figures "
        "show that the chain works and are not those of the full report."
    ),
    "tiny": "This is a test of the report's making: sizes are far too small for its figures to mean anything.",
}


def page_of(
    parts: Mapping[PaperPart, Mapping[str, Any]], folder: Path, size: Size, made: Mapping[str, Any]
) -> pages.Page:
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
    lines = []
    for row in rows:
        values = (row.paper_dlfc, row.paper_ert, row.dlfc, row.ert, row.best)
        limit = f"{'≤' if row.sense == 'at most' else '≥'} {written(row.limit, 4)}"
        reported = ("–" if value is None else written(value) for value in values)
        lines.append((row.quantity, *reported, limit, row.verdict, row.source))
    sections = []
    for name, part in parts.items():
        tables = [pages.Table(t["caption"], tuple(t["head"]), tuple(map(tuple, t["rows"]))) for t in part["tables"]]
        seeds = f"Seeds {', '.join(map(str, part['seeds']))}. " if part["seeds"] else ""
        seconds = part["seconds"]
        took = f"{seconds:.0f} s" if seconds < 100.0 else f"{seconds / 60.0:.0f} min"
        paragraphs = (*part["text"], f"{seeds}This part took {took}.")
        pictures = [pages.Picture(folder / each["path"], each["caption"]) for each in part["pictures"]]
        again = f"lfpiv validate paper {'--quick ' if size == 'quick' else ''}-o . --resume --only {name}"
        commands = (*part["commands"], again)
        sections.append(pages.Section(PARTS[name].title, name, paragraphs, tuple(tables), tuple(pictures), commands))
    libraries = ", ".join(f"{name} {version}" for name, version in made["libraries"].items())
    foot = f"Made by lfpiv {made['version']} ({libraries})."
    if notes:
        sections.append(pages.Section("Where ours as the paper did it differs, and why", "reasons", notes))
    return pages.Page(TITLE, text, (pages.Table("All quantities", HEAD, tuple(lines)),), tuple(sections), foot)


@dataclass(frozen=True, kw_only=True)
class PaperOptions:
    """What `validate paper` makes: which parts (all, where none is named), at which size, and whether it goes on."""

    only: tuple[PaperPart, ...] = ()
    size: Size = "full"
    resume: bool = False


FULL = PaperOptions()


def validate_paper(
    output: Path, options: PaperOptions = FULL, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Compute the paper's tables and figures and write the report: index.html, report.md and report.json.

    With `resume`, parts and pieces of parts are kept that were made at the same size by the same program; the report
    holds all parts that are there.

    Raises
    ------
    LimitMissedError : a row's verdict is missed or unknown
    """
    paths = {name: output / name for name in ("index.html", "report.md", "report.json")}
    again = overwrite or options.resume
    for path in paths.values():
        ensure_writable(path, again)
    pages.ensure_drawing()
    pages.ensure_pages()
    made = record(f"validate paper, {options.size}", None, {})
    chosen = [name for name in PARTS if name in options.only or not options.only]
    minutes = {
        name: {"tiny": 0.1, "quick": PARTS[name].quick_minutes, "full": PARTS[name].full_minutes}[options.size]
        for name in chosen
    }
    begun, expected = time.monotonic(), 0.0
    for number, name in enumerate(chosen):
        left = sum(minutes[later] for later in chosen[number:])
        # the machine's pace, by the parts that are done
        pace = (time.monotonic() - begun) / 60.0 / expected if expected > 1.0 else 1.0
        console.say(f"{name} ({number + 1} of {len(chosen)}): {PARTS[name].title}; about {pace * left:.0f} min left")
        work = Work(output / "work" / name, options.size, console, made, options.resume)
        kept(output / "parts" / f"{name}.json", made, options.resume, partial(_made, name, work))
        expected += minutes[name]
    # in their order, those that were made alike
    parts = {}
    for name in PARTS:
        path = output / "parts" / f"{name}.json"
        if path.exists() and (part := read_json(path)).get("made") == made:
            parts[name] = part["result"]
    page = page_of(parts, output, options.size, made)
    pages.write_pages(page, (paths["index.html"], paths["report.md"]), again)
    write_json(paths["report.json"], {"parts": parts, "provenance": made}, again)
    rows = [row for part in parts.values() for row in rows_of(part["rows"])]
    count = {verdict: sum(row.verdict == verdict for row in rows) for verdict in ("met", "missed", "unknown")}
    summary: dict[str, Any] = {"parts": len(parts), "rows": len(rows)} | count
    short = []
    for row in rows:
        value = getattr(row, row.judged)
        reported = "unknown" if value is None else written(value)
        if row.verdict != "met":
            short.append(f"{row.quantity} ({row.source}) is {reported}, expected {row.sense} {row.limit:g}")
    if short:
        raise LimitMissedError(f"{paths['index.html']}: {'; '.join(short)}", summary)
    return summary


def _made(name: PaperPart, work: Work) -> dict[str, Any]:
    """Make a part, write its pictures and return the rest as plain data."""
    begun = time.monotonic()
    found = PARTS[name].find(work)
    seconds = time.monotonic() - begun + sum(work.spared)
    pictures = []
    for drawing in found.drawings:
        path = work.folder.parents[1] / "pictures" / f"{name}_{drawing.name}.png"
        pages.write_picture(path, drawing.figure, overwrite=True)
        pictures.append({"path": f"pictures/{path.name}", "caption": drawing.caption})
    return {
        "rows": [asdict(row) | {"verdict": row.verdict} for row in found.rows],
        "tables": [asdict(table) for table in found.tables],
        **{name: getattr(found, name) for name in ("text", "commands", "seeds")},
        "pictures": pictures,
        "seconds": round(seconds, 1),
    }
