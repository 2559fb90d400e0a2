"""`validate paper`: the parts of the report one after the other, and the page that is made of them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import LimitMissedError
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.pages import ensure_pages, write_pages
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record
from lfpiv_cli.names import PaperPart, Size
from lfpiv_cli.notice import written
from lfpiv_cli.paper.parts import Findings, Row, Work, kept, plain, read_json, rows_of
from lfpiv_cli.paper.registry import PARTS
from lfpiv_cli.paper.report import page_of


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
    ensure_drawing()
    ensure_pages()
    made = record(f"validate paper, {options.size}", None, {})
    _make_parts(output, options, made, console)
    parts = _parts_there(output, made)
    page = page_of(parts, {name: PARTS[name].title for name in parts}, output, options.size, made)
    write_pages(page, paths["index.html"], paths["report.md"], again)
    write_json(paths["report.json"], {"parts": parts, "provenance": made}, again)
    return _judged(paths["index.html"], parts)


def _make_parts(output: Path, options: PaperOptions, made: Mapping[str, Any], console: Console) -> None:
    """Make the parts that are asked for, and say how far the work is."""
    chosen = [name for name in PARTS if name in options.only or not options.only]
    minutes = {name: _minutes(name, options.size) for name in chosen}
    begun, expected = time.monotonic(), 0.0
    for number, name in enumerate(chosen):
        left = sum(minutes[later] for later in chosen[number:])
        # the machine's pace, by the parts that are done
        pace = (time.monotonic() - begun) / 60.0 / expected if expected > 1.0 else 1.0
        console.say(f"{name} ({number + 1} of {len(chosen)}): {PARTS[name].title}; about {pace * left:.0f} min left")
        work = Work(output / "work" / name, options.size, console, made, options.resume)
        kept(output / "parts" / f"{name}.json", made, options.resume, partial(_made, name, work))
        expected += minutes[name]


def _minutes(name: PaperPart, size: Size) -> float:
    return {"tiny": 0.1, "quick": PARTS[name].quick_minutes, "full": PARTS[name].full_minutes}[size]


def _made(name: PaperPart, work: Work) -> dict[str, Any]:
    """Make a part, write its pictures and return the rest as plain data."""
    begun = time.monotonic()
    found = PARTS[name].find(work)
    seconds = time.monotonic() - begun + sum(work.spared)
    pictures = []
    for drawing in found.drawings:
        path = work.folder.parents[1] / "pictures" / f"{name}_{drawing.name}.png"
        write_picture(path, drawing.figure, overwrite=True)
        pictures.append({"path": f"pictures/{path.name}", "caption": drawing.caption})
    return _plain(found) | {"pictures": pictures, "seconds": round(seconds, 1)}


def _plain(found: Findings) -> dict[str, Any]:
    return {
        "rows": plain(found.rows),
        "tables": [asdict(table) for table in found.tables],
        "text": found.text,
        "commands": found.commands,
        "seeds": found.seeds,
    }


def _parts_there(output: Path, made: Mapping[str, Any]) -> dict[PaperPart, dict[str, Any]]:
    """Return the parts that were made alike, in their order."""
    found = {}
    for name in PARTS:
        path = output / "parts" / f"{name}.json"
        if path.exists():
            part = read_json(path)
            if part.get("made") == made:
                found[name] = part["result"]
    return found


def _judged(report: Path, parts: Mapping[PaperPart, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the count of verdicts; raise where one is not met."""
    rows: list[Row] = [row for part in parts.values() for row in rows_of(part["rows"])]
    count = {verdict: sum(row.verdict == verdict for row in rows) for verdict in ("met", "missed", "unknown")}
    summary: dict[str, Any] = {"parts": len(parts), "rows": len(rows)} | count
    short = [_short(row) for row in rows if row.verdict != "met"]
    if short:
        raise LimitMissedError(f"{report}: {'; '.join(short)}", summary)
    return summary


def _short(row: Row) -> str:
    """Return in words what a row that is not met has."""
    value = getattr(row, row.judged)
    told = "unknown" if value is None else written(value)
    return f"{row.quantity} ({row.source}) is {told}, expected {row.sense} {row.limit:g}"
