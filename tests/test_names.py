"""Each list of names stands once: what configuration, commands, comments and documents say is held against it."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from itertools import takewhile
from typing import Any, Literal, get_args, get_origin

import click
import numpy as np
import pytest

from lfpiv_cli import names as of_names
from lfpiv_cli.cli.main import cli
from lfpiv_cli.console import readable
from lfpiv_cli.files.sections import Section
from lfpiv_cli.files.sections_work import CorrelationSection, FlowSection, Sections
from lfpiv_cli.names import BoardMethod, Method, names_in
from lfpiv_cli.notice import written
from lfpiv_cli.reconstruction.registry import PARTICLES, SOLVER_NAMES, SOLVERS
from lfpiv_cli.synthetic.flows import FLOWS
from tests.commands import ROOT

TABLE2 = ROOT / "configs" / "table2.yaml"
# Documents that may list names: README, the guide for contributors, and the pages.
DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Names that are no words of plain English: where two of them stand side by side in a text, it lists names.
LISTED = [SOLVER_NAMES, names_in(Method), names_in(BoardMethod), tuple(FLOWS)]
JOINTS = re.compile(r",? and |,? or |, |/|\|")


def choices(annotation: Any) -> tuple[str, ...]:
    """Return the names that a type allows, those of a flow's `kind` for flows; none where it is no choice of names."""
    if get_origin(annotation) is Literal:
        return get_args(annotation)
    return tuple(name for inner in get_args(annotation) for name in choices(inner))


def keys() -> Iterator[tuple[tuple[str, ...], type[Section], tuple[str, ...]]]:
    """Yield every key of the configuration: its path, its section and the names that it may have."""
    sections: list[tuple[tuple[str, ...], type[Section]]] = [((), Sections)]
    for path, section in sections:
        for name, field in section.model_fields.items():
            sections += [((*path, name), inner) for inner in sections_in(field.annotation)]
            # Single letters are axes.
            yield (*path, name), section, tuple(n for n in choices(field.annotation) if len(n) > 2)


def sections_in(annotation: Any) -> list[type[Section]]:
    """Return the sections that a type holds."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [section for inner in get_args(annotation) for section in sections_in(inner)]


def flow_kinds() -> tuple[str, ...]:
    """Return the kinds of flows that the configuration knows."""
    return tuple(choices(kind.model_fields["kind"].annotation)[0] for kind in get_args(get_args(FlowSection)[0]))


def explained(path: tuple[str, ...]) -> str:
    """Return the line of a key in table2.yaml, commented out or not, with the comment that goes on below it."""
    place: list[tuple[int, str]] = []
    lines = TABLE2.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines):
        found = re.match(r"(# {0,2})?( *)([a-z_0-9]+):", line)
        if not found:
            continue
        depth = len(found[1] or "") + len(found[2])
        place = [*(above for above in place if above[0] < depth), (depth, found[3])]
        if tuple(name for _, name in place) == path:
            below = takewhile(lambda rest: re.match(r" {4,}#", rest), lines[number + 1 :])
            return " ".join([line, *below])
    raise AssertionError(f"{TABLE2.name} does not explain {'.'.join(path)}")


def lists_in(text: str) -> Iterator[list[str]]:
    """Yield what a text lists, word by word, where two names or more of `LISTED` stand side by side."""
    plain = re.sub(r"\s+", " ", re.sub(r"[`*\"'#]", "", text))
    # What stands in brackets interrupts a list, and may be one.
    parts = [re.sub(r" ?\([^()]*\)", "", plain), *re.findall(r"\(([^()]*)\)", plain)]
    for run in re.finditer(rf"[a-z_]+(?:(?:{JOINTS.pattern})[a-z_]+)+", "\n".join(parts)):
        words = JOINTS.split(run[0])
        if any(len(set(words) & set(names)) >= 2 for names in LISTED):
            yield words


def commands() -> Iterator[tuple[str, click.Command]]:
    for name in cli.list_commands(click.Context(cli)):
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        yield name, command


# Of the kinds of flows and of faces, which share their keys, the kind is not among them.
KEYS = [(path, section, names) for path, section, names in keys() if names and "kind" not in section.model_fields]


def test_every_key_is_explained() -> None:
    for path, section, _ in keys():
        assert re.search(rf"\b{path[-1]}\b", TABLE2.read_text() + (section.__doc__ or "")), path


def test_flows_and_keys_are_those_of_the_registry() -> None:
    found = {path for path, _, _ in KEYS}
    assert {("reconstruction", "solver"), ("weights", "method"), ("validation", "board", "methods")} <= found
    assert len(found) >= 14
    assert set(flow_kinds()) == set(FLOWS)
    assert all(re.search(rf"\b{kind}\b", explained(("simulation", "flow"))) for kind in FLOWS)


@pytest.mark.parametrize(("path", "section", "names"), KEYS, ids=[".".join(path) for path, _, _ in KEYS])
def test_section_and_table2_explain_every_name(path: tuple[str, ...], section: type[Section], names: tuple) -> None:
    for text in (section.__doc__ or "", explained(path)):
        missing = [name for name in names if not re.search(rf"\b{name}\b", text)]
        assert not missing, f"{'.'.join(path)}: {missing} not in {text}"


def test_options_offer_the_shared_names() -> None:
    shared = {get_args(each) for each in vars(of_names).values() if get_origin(each) is Literal} | {SOLVER_NAMES}
    offered = {
        f"{name} --{option.name}": tuple(option.type.choices)
        for name, command in commands()
        for option in command.params
        if isinstance(option, click.Option) and isinstance(option.type, click.Choice)
    }
    assert len(offered) > 10
    assert {option for option, choices in offered.items() if choices not in shared} == set()


def test_what_texts_list_are_names() -> None:
    # A list of names that holds a word which is none has outlived a change, or was never right.
    texts = {str(path.relative_to(ROOT)): path.read_text(encoding="utf-8") for path in (TABLE2, *DOCUMENTS)}
    texts |= {f"lfpiv {name}": command.help or "" for name, command in commands()}
    texts |= {section.__name__: section.__doc__ or "" for _, section, _ in KEYS}
    listed = [(place, words) for place, text in texts.items() for words in lists_in(text)]
    assert len(listed) >= 4
    for place, words in listed:
        assert any(set(words) <= set(names) for names in LISTED), f"{place} lists {words}"
    assert list(lists_in("the default, em (here), `smart` and artt; sart")) == [["default", "em", "smart", "artt"]]
    assert not list(lists_in("sart, which the paper has; em"))
    own = sorted(name for name, solver in SOLVERS.items() if solver.exponent != 1.0)
    for text in (CorrelationSection.__doc__ or "", explained(("correlation", "exponent"))):
        assert own in [sorted(words) for words in lists_in(text)], text


def test_every_solver_has_its_step_and_names_load_nothing_heavy() -> None:
    assert all(callable(solver.step()) for solver in SOLVERS.values())
    assert PARTICLES not in SOLVERS
    code = "import sys, lfpiv_cli.names, lfpiv_cli.reconstruction.registry; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT).stdout
    assert not {"numpy", "numba", "pydantic", "scipy"} & set(loaded.split())


PACKAGE = ROOT / "lfpiv_cli"
# What becomes part of a file's name, or a number again.
NOT_FOR_PEOPLE = {"paper/sensitivities.py", "pictures/vectors.py"}
TABLE = [
    (0.0, 3, "0"),
    (-0.0, 3, "0"),
    (110.0, 2, "110"),
    (5e5, 2, "500000"),
    (2345.0, 2, "2300"),
    (99999.5, 3, "100000"),
    (999999.0, 3, "1 million"),
    (1.25e7, 3, "12.5 million"),
    (-6.4e10, 2, "-64 billion"),
    (2.5e12, 2, "2.5 trillion"),
    (3.2e15, 2, "3.2 x 10^15"),
    (0.5, 3, "0.5"),
    (0.05004, 3, "0.05"),
    (1.23e-5, 3, "0.0000123"),
    (-2e-5, 2, "-0.00002"),
    (4.56e-9, 2, "4.6 x 10^-9"),
    (9.999, 3, "10"),
    (1.5, 6, "1.5"),
    (74915.7, 6, "74915.7"),
    (1.0, 1, "1"),
    (np.inf, 3, "inf"),
    (np.nan, 3, "nan"),
]


def test_numbers_are_written_as_people_do_and_those_of_usual_size_as_python_does() -> None:
    for value, digits, text in TABLE:
        assert written(value, digits) == written(np.float32(value), digits) == text
        assert readable([value, value], digits) == f"{text}, {text}"
    for value in 10.0 ** np.linspace(-4.0, 2.99, 100):
        assert written(value) == f"{value:.3g}"
        assert written(-value) == f"{-value:.3g}"


def test_no_text_has_numbers_that_computers_write() -> None:
    # With few digits Python writes 110 as 1.1e+02, and with a fixed number of decimals -0.0001 as -0.000.
    found = [
        f"{name}: {ast.unparse(node)}"
        for module in sorted(PACKAGE.rglob("*.py"))
        if (name := module.relative_to(PACKAGE).as_posix()) not in NOT_FOR_PEOPLE
        and re.search(r"\.\dg", text := module.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.FormattedValue)
        and node.format_spec is not None
        and re.search(r"\.\dg'$", ast.unparse(node.format_spec))
    ]
    assert not found
