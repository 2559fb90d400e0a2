"""YAML without its traps: one document of mappings, sequences and YAML 1.2 scalars, and where each of them stands.

PyYAML would read `1e-3` as text, `12:30` as a number and `yes` as a truth value, keep the last of repeated keys without
a word, and run out of stack on deep nesting. So its node tree is read here, by the core schema of YAML 1.2.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import yaml

# Libyaml's loader is the same parser in C, ten times as fast; both are safe, as only their nodes are used.
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)

LARGEST_BYTES = 2**20
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


class YamlError(Exception):
    """The text is not YAML of the kind that is read here; holds the one `Problem` that ended the reading."""

    def __init__(self, line: int, column: int, message: str) -> None:
        super().__init__(message)
        self.problem = Problem(line, column, "", message)


def read_document(content: bytes) -> Document:
    """Read a YAML document whose root is a mapping.

    Raises
    ------
    YamlError
        If it is too large, not UTF-8, not YAML, too deep, or uses aliases, tags or several documents.
    """
    if len(content) > LARGEST_BYTES:
        raise YamlError(1, 1, f"has {len(content)} bytes, expected at most {LARGEST_BYTES}")
    text = _decode(content)
    try:
        _ensure_plain(text)
        root = yaml.compose(text, Loader=LOADER)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line, column = (mark.line + 1, mark.column + 1) if mark else (1, 1)
        tab = text.splitlines()[line - 1 : line] and text.splitlines()[line - 1][column - 1 :].startswith("\t")
        problem = "a tab where only spaces may indent" if tab else error.problem or error.context
        raise YamlError(line, column, f"is not YAML: {problem}") from error
    except yaml.YAMLError as error:
        raise YamlError(1, 1, f"is not YAML: {str(error).splitlines()[0]}") from error
    document = Document()
    if root is None:
        return document
    if not isinstance(root, yaml.MappingNode):
        raise YamlError(*_place(root), "is not a mapping of sections")
    document.data = _plain(root, (), document)
    return document


def _decode(content: bytes) -> str:
    """Return the text, refusing what is not UTF-8 and control characters, which no editor shows."""
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        before = content[: error.start]
        line = before.count(b"\n") + 1
        raise YamlError(line, error.start - before.rfind(b"\n"), "is not UTF-8 text") from error
    if found := re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f]", text):
        line = text.count("\n", 0, found.start()) + 1
        column = found.start() - text.rfind("\n", 0, found.start())
        raise YamlError(line, column, f"holds the control character {ord(found.group()):#04x}")
    return text


def _ensure_plain(text: str) -> None:
    """Refuse aliases, tags, depth and further documents on the flat stream of events, before any tree is built."""
    depth = documents = 0
    for event in yaml.parse(text, Loader=LOADER):
        place = _place(event)
        if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
            raise YamlError(*place, "uses an anchor or alias (& or *), which are not read here")
        if (tag := getattr(event, "tag", None)) is not None:
            raise YamlError(*place, f"uses the tag {tag}, which is not read here")
        if isinstance(event, yaml.DocumentStartEvent):
            documents += 1
        if documents > 1:
            raise YamlError(*place, "holds a second document, expected one")
        if isinstance(event, (yaml.MappingStartEvent, yaml.SequenceStartEvent)):
            depth += 1
        elif isinstance(event, (yaml.MappingEndEvent, yaml.SequenceEndEvent)):
            depth -= 1
        if depth > DEEPEST:
            raise YamlError(*place, f"is nested deeper than {DEEPEST} levels")


def _plain(node: yaml.Node, path: KeyPath, document: Document) -> Any:
    """Return a node as plain data, noting where everything stands."""
    document.values[path] = _place(node)
    if isinstance(node, yaml.MappingNode):
        return _plain_mapping(node, path, document)
    if isinstance(node, yaml.SequenceNode):
        return tuple(_plain(item, (*path, k), document) for k, item in enumerate(node.value))
    plain = isinstance(node, yaml.ScalarNode) and not node.style
    try:
        return _scalar(node.value) if plain else node.value
    except ValueError:
        document.problems.append(Problem(*_place(node), key_name(path), "is too long a number"))
        return 0


def _plain_mapping(node: yaml.MappingNode, path: KeyPath, document: Document) -> dict[str, Any]:
    mapping: dict[str, Any] = {}
    for key_node, value_node in node.value:
        place = _place(key_node)
        if not isinstance(key_node, yaml.ScalarNode):
            document.problems.append(Problem(*place, key_name(path), "a key must be a word"))
            continue
        key = key_node.value
        if key in mapping:
            first = document.keys[*path, key][0]
            document.problems.append(Problem(*place, key_name((*path, key)), f"repeated key, first on line {first}"))
            continue
        document.keys[*path, key] = place
        mapping[key] = _plain(value_node, (*path, key), document)
    return mapping


def _scalar(text: str) -> Any:
    """Return what an unquoted scalar means by the core schema of YAML 1.2.

    Raises
    ------
    ValueError : it is an integer of more digits than any of ours has
    """
    for pattern, convert in SCALARS:
        if pattern.fullmatch(text):
            value = convert(text)
            # Python prints no integer of more than 4300 digits, and none of ours needs more than 64 bits.
            if isinstance(value, int) and abs(value) > LARGEST_INTEGER:
                raise ValueError
            return value
    return text


def _place(node: yaml.Node | yaml.Event) -> tuple[int, int]:
    mark = node.start_mark
    assert mark is not None, "nodes of a parsed text have a place"
    return mark.line + 1, mark.column + 1


def key_name(path: KeyPath) -> str:
    """Return a place as users write it: `correlation.windows[0]`."""
    name = ""
    for part in path:
        if isinstance(part, int):
            name += f"[{part}]"
        else:
            name += f".{part}" if name else part
    return name
