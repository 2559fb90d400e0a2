"""What is wrong with a configuration, as sentences about places: `rig.yaml:5:16: camera.x: is 3, expected ...`."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import Any

from pydantic_core import ErrorDetails

from lfpiv_cli.files.sections import Sections
from lfpiv_cli.files.yaml_nodes import Document, KeyPath, Problem, key_name
from lfpiv_cli.notice import written

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
    "and give channel: {width_mm: ..., wall_mm: ...}, whose calibrated mid plane tells the distance",
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
    path = _path_in(document.data, details["loc"])
    kind, value, context = details["type"], details["input"], details.get("ctx", {})
    place = place_of(document, path)
    if kind == "extra_forbidden":
        place = document.keys.get(path, (0, 0))
        text = _unknown(path)
    elif kind in ("missing", "union_tag_not_found"):
        if kind == "union_tag_not_found":
            path = (*path, "kind")
        text = MISSING.get(path, "is missing")
    elif kind == "too_long" or kind == "too_short":
        text = (
            f"has {context['actual_length']} entries, expected {context.get('max_length', context.get('min_length'))}"
        )
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


def _unknown(path: KeyPath) -> str:
    """Return the sentence about a key that its section does not know."""
    known = _known_keys(path[:-1])
    near = difflib.get_close_matches(str(path[-1]), known, n=1)
    return f"unknown key; did you mean '{near[0]}'?" if near else f"unknown key; known are {', '.join(known)}"


def _known_keys(path: KeyPath) -> list[str]:
    """Return the keys of the section at a place."""
    models: list[Any] = [Sections]
    for part in path:
        if isinstance(part, int):
            continue
        fields = [model.model_fields[part] for model in models if part in model.model_fields]
        models = [inner for field in fields for inner in _models_in(field.annotation)]
    return list(dict.fromkeys(name for model in models for name in model.model_fields))


def _models_in(annotation: Any) -> list[Any]:
    """Return the section classes inside a type."""
    if hasattr(annotation, "model_fields"):
        return [annotation]
    return [model for inner in getattr(annotation, "__args__", ()) for model in _models_in(inner)]


def _path_in(data: Any, location: tuple[int | str, ...]) -> KeyPath:
    """Return pydantic's place without the names of union members, which are not in the data."""
    path: list[int | str] = []
    for number, part in enumerate(location):
        inside = part in data if isinstance(data, Mapping) else isinstance(data, tuple) and isinstance(part, int)
        if inside:
            data = data[part] if isinstance(data, Mapping) or part < len(data) else None  # type: ignore[operator]
            path.append(part)
        elif number == len(location) - 1 and isinstance(data, Mapping):
            path.append(part)
    return tuple(path)


def place_of(document: Document, path: KeyPath) -> tuple[int, int]:
    """Return line and column of a value, or of the nearest section around it."""
    while path and path not in document.values:
        path = path[:-1]
    return document.values.get(path, (0, 0)) if path else document.values.get((), (0, 0))


def _shown(value: Any) -> str:
    """Return a value as it would stand in the file, cut where it is long."""
    words: dict[Any, str] = {None: "empty", True: "true", False: "false"}
    if value is None or isinstance(value, bool):
        return words[value]
    if isinstance(value, Mapping):
        return "a section"
    text = repr(list(value)) if isinstance(value, tuple) else repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
