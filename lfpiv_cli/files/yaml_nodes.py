"""A rig file as text: YAML without its traps, where each key stands, what is wrong there, and heights beside it.

PyYAML would read `1e-3` as text, `12:30` as a number and `yes` as a truth value, keep the last of repeated keys without
a word, and run out of stack on deep nesting. So its node tree is read here, by the core schema of YAML 1.2.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray
from pydantic_core import ErrorDetails

from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.images import format_of, read_single
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, opened, reason
from lfpiv_cli.files.sections_work import Sections
from lfpiv_cli.notice import written

# Libyaml's loader is the same parser in C, ten times as fast; both are safe, as only their nodes are used.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

LARGEST_BYTES = 2**20
# Images and HDF5 files have a zero byte among their first ones, and no text has.
BEGINNING_BYTES = 512
DEEPEST = 20
LARGEST_INTEGER = 2**63 - 1

KeyPath = tuple[str | int, ...]
"""A place in the tree: the keys and positions that lead to it."""

SCALARS: tuple[tuple[re.Pattern[str], Callable[[str], Any]], ...] = (
    (re.compile(r"null|Null|NULL|~|"), lambda text: None),
    (re.compile(r"true|True|TRUE"), lambda text: True),
    (re.compile(r"false|False|FALSE"), lambda text: False),
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"0o[0-7]+"), lambda text: int(text[2:], 8)),
    (re.compile(r"0x[0-9a-fA-F]+"), lambda text: int(text[2:], 16)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)"), lambda text: float(text.replace(".", ""))),
    (re.compile(r"\.(nan|NaN|NAN)"), lambda text: float("nan")),
)


@dataclass(frozen=True)
class Problem:
    """Something wrong at a place of the text; line and column count from 1, 0 where there is no text."""

    line: int
    column: int
    key: str
    message: str


@dataclass
class Document:
    """A document as plain data, sequences as tuples.

    Attributes
    ----------
    data : the root mapping
    keys, values : line and column, counted from 1, of the key and of the value at each place
    problems : repeated keys and keys that are not words
    """

    data: dict[str, Any] = field(default_factory=dict)
    keys: dict[KeyPath, tuple[int, int]] = field(default_factory=dict)
    values: dict[KeyPath, tuple[int, int]] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)


def _broken(source: str, line: int, column: int, message: str) -> ConfigError:
    """Return the error of a text that is not YAML of the kind that is read here, at the place where reading ended."""
    return ConfigError(sentence(source, Problem(line, column, "", message)))


def read_rig(path: Path) -> Document:
    """Read a rig file, and the heights of each file that a face names, beside it, in the file's place.

    Raises
    ------
    ConfigError : it is no YAML of the kind that is read here, or heights cannot be read
    InputError : the file is missing or not a file
    """
    size = ensure_regular_file(path)
    with opened(path) as file:
        is_text = b"\0" not in file.read(BEGINNING_BYTES)
    if not is_text:  # an image, or a file that commands take in other places; else it is told where it is read
        with suppress(InputError):
            kind = format_of(path).name
            what = "an HDF5 file" if kind == "HDF5" else f"an image ({kind})"
            raise ConfigError(f"{path}: is {what}; expected a rig file")
    if size > LARGEST_BYTES:
        raise ConfigError(f"{path}: has {size} bytes, expected at most {LARGEST_BYTES}")
    document = _read_document(content_of(path), str(path))
    scene = document.data.get("scene")
    faces = list(scene) if isinstance(scene, tuple) else []
    for k, face in enumerate(faces):
        if not isinstance(face, Mapping) or face.get("kind") != "height_map" or "heights_mm" in face:
            continue
        if isinstance(face.get("file"), str):  # else it is judged with the rest
            try:
                heights = read_heights(path.parent / face["file"])
            except InputError as error:
                place: KeyPath = ("scene", k, "file")
                problem = Problem(*place_of(document, place), key_name(place), str(error))
                raise ConfigError(sentence(str(path), problem)) from error
            faces[k] = {name: value for name, value in face.items() if name != "file"} | {"heights_mm": heights}
    if faces:
        document.data["scene"] = tuple(faces)
    return document


def _read_document(content: bytes, source: str) -> Document:
    """Read a YAML document whose root is a mapping.

    Raises
    ------
    ConfigError : it is not UTF-8, not YAML, too deep, or uses aliases, tags or several documents
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = content[: error.start]
        place = before.count(b"\n") + 1, error.start - before.rfind(b"\n")
        raise _broken(source, *place, "is not UTF-8 text") from error
    if found := re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", text):  # no editor shows them
        line, column = text.count("\n", 0, found.start()) + 1, found.start() - text.rfind("\n", 0, found.start())
        raise _broken(source, line, column, f"holds the control character {ord(found.group()):#04x}")
    try:
        # On the flat stream of events, before any tree is built.
        depth = documents = 0
        for event in yaml.parse(text, Loader=LOADER):
            documents += isinstance(event, yaml.DocumentStartEvent)
            depth += isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent))
            depth -= isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent))
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                fault = "uses an anchor or alias (& or *), which are not read here"
            elif (tag := getattr(event, "tag", None)) is not None:
                fault = f"uses the tag {tag}, which is not read here"
            elif documents > 1:
                fault = "holds a second document, expected one"
            elif depth > DEEPEST:
                fault = f"is nested deeper than {DEEPEST} levels"
            else:
                continue
            raise _broken(source, *_place(event), fault)
        root = yaml.compose(text, Loader=LOADER)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        tab = text.splitlines()[line - 1 : line] and text.splitlines()[line - 1][column - 1 :].startswith("\t")
        problem = "a tab where only spaces may indent" if tab else error.problem or error.context
        raise _broken(source, line, column, f"is not YAML: {problem}") from error
    except yaml.YAMLError as error:
        raise _broken(source, 1, 1, f"is not YAML: {str(error).splitlines()[0]}") from error
    document = Document()
    if root is not None and not isinstance(root, yaml.MappingNode):
        raise _broken(source, *_place(root), "is not a mapping of sections")
    if root is not None:
        document.data = _plain(root, (), document)
    return document


def _plain(node: yaml.Node, path: KeyPath, document: Document) -> Any:
    """Return a node as plain data, noting where everything stands; unquoted scalars by the core schema of YAML 1.2."""
    document.values[path] = _place(node)
    if isinstance(node, yaml.SequenceNode):
        return tuple(_plain(item, (*path, k), document) for k, item in enumerate(node.value))
    if isinstance(node, yaml.MappingNode):
        mapping: dict[str, Any] = {}
        for key_node, value_node in node.value:
            place, key = _place(key_node), key_node.value
            if not isinstance(key_node, yaml.ScalarNode):
                document.problems.append(Problem(*place, key_name(path), "a key must be a word"))
            elif key in mapping:
                text = f"repeated key, first on line {document.keys[*path, key][0]}"
                document.problems.append(Problem(*place, key_name((*path, key)), text))
            else:
                document.keys[*path, key] = place
                mapping[key] = _plain(value_node, (*path, key), document)
        return mapping
    if not isinstance(node, yaml.ScalarNode) or node.style:
        return node.value
    convert = next((convert for pattern, convert in SCALARS if pattern.fullmatch(node.value)), str)
    try:
        value = convert(node.value)
        # Python reads and prints no integer of more than 4300 digits, and none of ours needs more than 64 bits.
        if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
            raise ValueError
    except ValueError:
        document.problems.append(Problem(*_place(node), key_name(path), "is too long a number"))
        return 0
    return value


def _place(node: yaml.Node | yaml.Event) -> tuple[int, int]:
    mark = node.start_mark
    assert mark is not None, "nodes of a parsed text have a place"
    return mark.line + 1, mark.column + 1


def key_name(path: KeyPath) -> str:
    """Return a place as users write it: `correlation.windows[0]`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")


# What is wrong with a configuration, as sentences about places: `rig.yaml:5:16: camera.x: is 3, expected ...`.

# More than this many errors at once are one mistake repeated.
MOST_PROBLEMS = 20
COMPARISONS = {
    "greater_than": ("gt", "more than"),
    "greater_than_equal": ("ge", "at least"),
    "less_than": ("lt", "less than"),
    "less_than_equal": ("le", "at most"),
}
KINDS = {
    "float_type": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "bool_type": "true or false",
    "string_type": "a word",
    "tuple_type": "a list in brackets",
    "finite_number": "a finite number",
    "model_type": "a section of keys",
    "model_attributes_type": "a section of keys",
    "dict_type": "a section of keys",
}
# Keys without which another section may be what was meant.
MISSING: dict[KeyPath, str] = {
    ("window", "distance_mm"): "is missing; where only the thickness of a channel's wall is known, leave window out "
    "and give channel: {width_mm: ..., wall_mm: ...}, whose calibrated mid plane tells the distance"
}


def report(source: str, problems: Iterable[Problem]) -> str:
    """Return one line for each problem, in the order of the file."""
    lines = [sentence(source, problem) for problem in sorted(set(problems), key=lambda p: (p.line, p.column, p.key))]
    if len(lines) > MOST_PROBLEMS:
        lines[MOST_PROBLEMS:] = [f"{source}: and {len(lines) - MOST_PROBLEMS} more errors"]
    return "\n".join(lines)


def sentence(source: str, problem: Problem) -> str:
    place = f"{source}:{problem.line}:{problem.column}" if problem.line else source
    return f"{place}: {problem.key}: {problem.message}" if problem.key else f"{place}: {problem.message}"


def problem_of(document: Document, details: ErrorDetails) -> Problem:
    """Return a validation error as a sentence about a place."""
    # pydantic's place, without the names of union members, which are not in the data.
    path: KeyPath = ()
    data: Any = document.data
    for number, part in enumerate(details["loc"]):
        inside = part in data if isinstance(data, Mapping) else isinstance(data, tuple) and isinstance(part, int)
        if inside:
            data = data[part] if isinstance(data, Mapping) or part < len(data) else None  # type: ignore[operator]
        if inside or (number == len(details["loc"]) - 1 and isinstance(data, Mapping)):
            path = (*path, part)
    kind, value, context = details["type"], details["input"], details.get("ctx", {})
    place = place_of(document, path)
    if kind == "extra_forbidden":
        place = document.keys.get(path, (0, 0))
        models: list[Any] = [Sections]
        for part in (part for part in path[:-1] if isinstance(part, str)):
            inner = [model.model_fields[part] for model in models if part in model.model_fields]
            models = [model for field in inner for model in _models_in(field.annotation)]
        known = list(dict.fromkeys(name for model in models for name in model.model_fields))
        near = difflib.get_close_matches(str(path[-1]), known, n=1)
        text = f"unknown key; did you mean '{near[0]}'?" if near else f"unknown key; known are {', '.join(known)}"
    elif kind in ("missing", "union_tag_not_found"):
        if kind == "union_tag_not_found":
            path = (*path, "kind")
        text = MISSING.get(path, "is missing")
    elif kind == "too_long" or kind == "too_short":
        expected = context.get("max_length", context.get("min_length"))
        text = f"has {context['actual_length']} entries, expected {expected}"
    elif kind == "literal_error":
        text = f"is {_shown(value)}, expected {context['expected']}"
    elif kind == "union_tag_invalid":
        path = (*path, "kind")
        place = place_of(document, path)
        text = f"is '{context['tag']}', expected one of {context['expected_tags']}"
    elif kind in COMPARISONS:
        limit, words = COMPARISONS[kind]
        text = f"is {_shown(value)}, expected {words} {written(context[limit], 6)}"
    else:
        text = f"is {_shown(value)}, expected {KINDS.get(kind, details['msg'])}"
    return Problem(*place, key_name(path), text)


def _models_in(annotation: Any) -> list[Any]:
    """Return the section classes inside a type."""
    if hasattr(annotation, "model_fields"):
        return [annotation]
    return [model for inner in getattr(annotation, "__args__", ()) for model in _models_in(inner)]


def place_of(document: Document, path: KeyPath) -> tuple[int, int]:
    """Return line and column of a value, or of the nearest section around it."""
    while path and path not in document.values:
        path = path[:-1]
    return document.values.get(path, (0, 0))


def _shown(value: Any) -> str:
    """Return a value as it would stand in the file, cut where it is long."""
    if value is None or isinstance(value, bool):
        return {None: "empty", True: "true", False: "false"}[value]
    if isinstance(value, Mapping):
        return "a section"
    text = repr(list(value)) if isinstance(value, tuple) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."


# Heights on a grid that a face of `scene` names a file of: read with the configuration, and then part of it.
#
# So results carry them, and are the same wherever the file has gone.

# Every result carries them, in its record and in those of what it was made from. A smooth surface needs few: through
# heights 1 mm apart of a lens of 40 mm radius a tracer is seen where the lens shows it to 20 nm.
MOST_HEIGHTS = 2**14
# A picometre; further digits of a float would only make records longer.
DIGITS = 9
SEPARATORS = re.compile(r"[,;\s]+")


def read_heights(path: Path) -> tuple[tuple[float, ...], ...]:
    """Read rows of heights in mm: a table of numbers (text), an array (.npy), or an image (.tif).

    Raises
    ------
    InputError : the file is missing, broken, or holds no rows of numbers, gaps, or more than a smooth surface needs
    """
    ensure_regular_file(path)
    ending = path.suffix.lower()
    array: NDArray[Any] | None = None
    if ending in (".tif", ".tiff"):
        array = read_single(path)
    elif ending == ".npy":
        try:
            # Its size is held against the file's.
            array = np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))
        except Exception as error:  # a damaged header can raise anything in NumPy
            raise InputError(f"{path}: is no NumPy array: {reason(error)}") from error
    if array is None:
        rows = list(_table(path))
    else:
        if array.ndim != 2 or array.dtype.kind not in "fiu":
            raise InputError(f"{path}: is {array.dtype} of the shape {array.shape}, expected numbers (rows, columns)")
        _ensure_few(array.size, path)
        rows = array.astype(np.float64).tolist()
    bad = [(r, c) for r, row in enumerate(rows, start=1) for c, z in enumerate(row, start=1) if not math.isfinite(z)]
    if bad:
        row, column = bad[0]
        raise InputError(f"{path}: {len(bad)} heights are no numbers, the first one in row {row}, column {column}")
    return tuple(tuple(round(z, DIGITS) for z in row) for row in rows)


def _table(path: Path) -> Iterator[tuple[float, ...]]:
    """Yield the rows of a table of numbers between commas, semicolons or spaces; lines with # in front say nothing."""
    text, count = content_of(path).decode("utf-8-sig", errors="replace"), 0
    for number, line in enumerate(text.splitlines(), start=1):
        words = [word for word in SEPARATORS.split(line) if word]
        if not words or words[0].startswith("#"):
            continue
        count += len(words)
        _ensure_few(count, path)
        try:
            yield tuple(map(float, words))
        except ValueError as error:
            raise InputError(f"{path}: line {number}: {reason(error)}") from error


def _ensure_few(count: int, path: Path) -> None:
    """Refuse more heights than a smooth surface needs."""
    if count > MOST_HEIGHTS:
        raise InputError(f"{path}: holds {count} heights or more, expected at most {MOST_HEIGHTS}; leave some rows out")
