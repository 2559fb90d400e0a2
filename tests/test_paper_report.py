"""`validate paper`: rows and their verdicts, the page made of parts, and what is kept of interrupted work."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import asdict, replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
import yaml
from click.testing import CliRunner

from lfpiv_cli.cli.main import cli
from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, LimitMissedError, OutputExistsError, UsageError
from lfpiv_cli.files.pages import Table, ensure_pages
from lfpiv_cli.names import PaperPart, names_in
from lfpiv_cli.paper import run
from lfpiv_cli.paper.parts import TABLE_2, Drawing, Findings, Row, Work, read_json, rows_of, sections
from lfpiv_cli.paper.run import PARTS, PaperOptions, Part, validate_paper

ROOT = Path(__file__).parents[1]
TINY = PaperOptions(size="tiny")
QUIET = Console(quiet=True)
GOOD = Row(quantity="error <of> a|b (mm)", source="Table 9", limit=0.2, paper_ert=0.2, best=0.1)


class Page(HTMLParser):
    """What a page would load, its text by element, and the headings of its tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loads: list[str] = []
        self.cells: list[str] = []
        self._inside = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self._inside = tag
        named = dict(attributes)
        self.loads += [str(named[name]) for name in ("src", "data", "srcset") if name in named]
        if tag in ("link", "script", "iframe"):
            self.loads.append(tag)

    def handle_data(self, data: str) -> None:
        if self._inside == "td":
            self.cells.append(data.strip())


def drawn() -> Drawing:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(1.0, 1.0))
    figure.subplots().plot([0, 1])
    return Drawing("line", "A line (after Fig. 0).", figure)


@pytest.fixture
def parts(monkeypatch) -> dict[str, Any]:
    """Two parts in place of the paper's, which count how often they and their step are made."""
    made: dict[str, Any] = {"table1": 0, "step": 0, "row": GOOD, "fails": False}

    def first(work: Work) -> Findings:
        made["table1"] += 1

        def step() -> dict[str, float]:
            made["step"] += 1
            return {"value": float("nan"), "number": 3}

        found = work.step("piece", step)
        if made["fails"]:
            raise InputError("the power went out")
        table = Table("A table", ("number", "x|y"), ((str(found["number"]), "a|b"),))
        return Findings((made["row"],), (drawn(),), (table,), ("Some words.",), ("lfpiv --version",), (7,))

    def second(work: Work) -> Findings:
        return Findings((replace(GOOD, quantity="other"),))

    chosen = {"table1": Part(first, "First <part>", 0.1, 0.1), "table2": Part(second, "Second part", 0.1, 0.1)}
    monkeypatch.setattr(run, "PARTS", chosen)
    return made


@pytest.mark.parametrize(
    ("changes", "verdict"),
    [
        ({}, "met"),
        ({"best": 0.2}, "met"),
        ({"best": 0.2000001}, "missed"),
        ({"best": 0.1, "sense": "at least"}, "missed"),
        ({"best": 0.3, "sense": "at least"}, "met"),
        ({"best": None}, "unknown"),
        ({"best": float("nan")}, "unknown"),
        ({"judged": "ert"}, "unknown"),
        ({"judged": "ert", "ert": 0.1, "best": 9.0}, "met"),
        ({"judged": "dlfc", "dlfc": 0.3}, "missed"),
    ],
)
def test_verdicts(changes: dict[str, Any], verdict: str) -> None:
    row = replace(GOOD, **changes)
    assert row.verdict == verdict
    if changes.get("best") == changes.get("best"):  # nan does not equal itself
        assert rows_of([asdict(row) | {"verdict": row.verdict}]) == (row,)


def test_a_page_holds_its_pictures_and_loads_nothing(parts, tmp_path) -> None:
    summary = validate_paper(tmp_path / "report", TINY, console=QUIET)
    assert summary == {"parts": 2, "rows": 2, "met": 2, "missed": 0, "unknown": 0}
    text = (tmp_path / "report" / "index.html").read_text(encoding="utf-8")
    page = Page(text)
    assert len(page.loads) == 1
    assert page.loads[0].startswith("data:image/png;base64,iVBOR")
    assert not re.search(r"https?://|url\(|@import", text)
    assert page.cells[:9] == ["error <of> a|b (mm)", "–", "0.2", "–", "–", "0.1", "≤ 0.2", "met", "Table 9"]
    assert "First <part>" not in text
    assert "First &lt;part&gt;" in text


def test_the_same_as_markdown_and_json(parts, tmp_path) -> None:
    validate_paper(tmp_path, TINY, console=QUIET)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "| error <of> a\\|b (mm) | – | 0.2 | – | – | 0.1 | ≤ 0.2 | met | Table 9 |" in text
    linked = re.search(r"!\[A line \(after Fig\. 0\)\.\]\((.+?)\)", text)
    assert linked
    assert (tmp_path / linked[1]).read_bytes().startswith(b"\x89PNG")
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["parts"]["table1"]["rows"][0]["verdict"] == "met"
    assert report["parts"]["table1"]["seeds"] == [7]
    assert report["provenance"]["command"] == "validate paper, tiny"


@pytest.mark.parametrize(("best", "told"), [(0.3, "0.3"), (None, "unknown")])
def test_a_missed_or_unknown_row_fails_and_the_report_is_there(parts, tmp_path, best, told) -> None:
    parts["row"] = replace(GOOD, best=best)
    with pytest.raises(LimitMissedError, match=f"is {told}, expected at most 0.2") as missed:
        validate_paper(tmp_path, TINY, console=QUIET)
    assert missed.value.figures["met"] == 1
    assert (tmp_path / "index.html").exists()


def test_what_is_made_is_kept(parts, tmp_path) -> None:
    parts["fails"] = True
    with pytest.raises(InputError):
        validate_paper(tmp_path, TINY, console=QUIET)
    parts["fails"] = False
    resumed = replace(TINY, resume=True)
    # what is kept is told with the time that it took
    piece = tmp_path / "work" / "table1" / "piece.json"
    piece.write_text(json.dumps(json.loads(piece.read_text()) | {"seconds": 5000.0}))
    validate_paper(tmp_path, resumed, console=QUIET)
    assert (parts["table1"], parts["step"]) == (2, 1)
    assert "This part took 83 min" in (tmp_path / "report.md").read_text(encoding="utf-8")
    validate_paper(tmp_path, resumed, console=QUIET)
    assert (parts["table1"], parts["step"]) == (2, 1)
    # another size is another report; without resuming all is made anew
    validate_paper(tmp_path, replace(resumed, size="quick"), console=QUIET)
    assert (parts["table1"], parts["step"]) == (3, 2)
    validate_paper(tmp_path, TINY, overwrite=True, console=QUIET)
    assert (parts["table1"], parts["step"]) == (4, 3)


def test_one_part_alone_leaves_the_others_in_the_report(parts, tmp_path) -> None:
    validate_paper(tmp_path, replace(TINY, only=("table2",)), console=QUIET)
    assert parts["table1"] == 0
    summary = validate_paper(tmp_path, replace(TINY, only=("table1",), resume=True), console=QUIET)
    assert summary["parts"] == 2


def test_a_report_is_not_replaced_unasked(parts, tmp_path) -> None:
    validate_paper(tmp_path, TINY, console=QUIET)
    with pytest.raises(OutputExistsError):
        validate_paper(tmp_path, TINY, console=QUIET)
    assert parts["table1"] == 1


def test_pages_need_jinja(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(UsageError, match=r"lfpiv\[report\]"):
        ensure_pages()


@pytest.mark.parametrize("text", ["", "[1]", "{"])
def test_a_broken_part_is_named(tmp_path, text: str) -> None:
    path = tmp_path / "table1.json"
    path.write_text(text)
    with pytest.raises(InputError, match=r"table1\.json"):
        read_json(path)


def test_parts_have_names() -> None:
    assert tuple(name for name in names_in(PaperPart) if name in PARTS) == tuple(PARTS)


def test_the_camera_is_that_of_the_shipped_config() -> None:
    shipped = yaml.safe_load((ROOT / "configs" / "table2.yaml").read_text())
    lens = shipped["camera"]["main_lens"]
    for name, value in TABLE_2["camera"]["main_lens"].items():
        assert lens[name] == value
    for name in ("microlenses", "sensor"):
        assert shipped["camera"][name] == TABLE_2["camera"][name]
    for name in ("media", "window", "volume"):
        assert shipped[name] == TABLE_2[name]
    assert sections(window=None, volume={"voxel_mm": 0.2})["volume"] == TABLE_2["volume"] | {"voxel_mm": 0.2}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["paper", "rig.yaml"], "takes no CONFIG"),
        (["flow"], "needs a CONFIG"),
        (["flow", "rig.yaml", "--quick"], "validate flow takes no --quick"),
        (["paper", "--only", "table9"], "table9"),
    ],
)
def test_the_command_line(arguments: list[str], words: str, tmp_path) -> None:
    result = CliRunner().invoke(cli, ["validate", *arguments, "-o", str(tmp_path)])
    assert result.exit_code == 2
    assert words in result.output


@pytest.mark.slow
def test_the_quick_report(tmp_path) -> None:
    summary = validate_paper(tmp_path, PaperOptions(size="quick"), console=QUIET)
    assert summary["parts"] == len(PARTS)
    assert summary["met"] == summary["rows"]
    page = Page((tmp_path / "index.html").read_text(encoding="utf-8"))
    assert len(page.loads) > 20
    assert all(each.startswith("data:image/png;base64,") for each in page.loads)


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["table1", "table2", "focal-plane", "sensitivities", "faults"])
def test_parts_at_a_tiny_size(name: PaperPart, tmp_path) -> None:
    chosen = PaperOptions(only=(name,), size="tiny")
    summary = validate_paper(tmp_path, chosen, console=QUIET)
    assert summary["met"] == summary["rows"] > 0
