"""Heights on a grid that a face of `scene` names a file of: read with the configuration, and then part of it.

So results carry them, and are the same wherever the file has gone.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.config_problems import place_of, sentence
from lfpiv_cli.files.images import read_image
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, reason
from lfpiv_cli.files.yaml_nodes import Document, KeyPath, Problem, key_name

# Every result carries them, in its record and in those of what it was made from. A smooth surface needs few: through
# heights 1 mm apart of a lens of 40 mm radius a tracer is seen where the lens shows it to 20 nm.
MOST_HEIGHTS = 2**14
# A picometre; further digits of a float would only make records longer.
DIGITS = 9
SEPARATORS = re.compile(r"[,;\s]+")

Rows = tuple[tuple[float, ...], ...]


def with_heights(document: Document, source: Path) -> Document:
    """Return a configuration with the heights of each file that a face names, beside `source`, in the file's place.

    Raises
    ------
    ConfigError : one cannot be read
    """
    scene = document.data.get("scene")
    if not isinstance(scene, tuple):
        return document
    faces = tuple(_with_heights(face, ("scene", k, "file"), document, source) for k, face in enumerate(scene))
    return replace(document, data=document.data | {"scene": faces})


def _with_heights(face: Any, path: KeyPath, document: Document, source: Path) -> Any:
    """Return one face, its file read; any other as it is, to be judged with the rest."""
    if not isinstance(face, Mapping) or face.get("kind") != "height_map" or "heights_mm" in face:
        return face
    file = face.get("file")
    if not isinstance(file, str):
        return face
    try:
        heights = read_heights(source.parent / file)
    except InputError as error:
        problem = Problem(*place_of(document, path), key_name(path), str(error))
        raise ConfigError(sentence(str(source), problem)) from error
    return {name: value for name, value in face.items() if name != "file"} | {"heights_mm": heights}


def read_heights(path: Path) -> Rows:
    """Read rows of heights in mm: a table of numbers (text), an array (.npy), or an image (.tif).

    Raises
    ------
    InputError
        If the file is missing, broken, or holds no rows of numbers, gaps, or more than a smooth surface needs.
    """
    ensure_regular_file(path)
    ending = path.suffix.lower()
    if ending in (".tif", ".tiff"):
        rows = _rows_of(read_image(path), path)
    else:
        rows = _rows_of(_array(path), path) if ending == ".npy" else tuple(_table(path))
    bad = [(r, c) for r, row in enumerate(rows, start=1) for c, z in enumerate(row, start=1) if not math.isfinite(z)]
    if bad:
        row, column = bad[0]
        raise InputError(f"{path}: {len(bad)} heights are no numbers, the first one in row {row}, column {column}")
    return tuple(tuple(round(z, DIGITS) for z in row) for row in rows)


def _array(path: Path) -> NDArray[Any]:
    """Return a NumPy array, its size held against the file's."""
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # a damaged header can raise anything in NumPy
        raise InputError(f"{path}: is no NumPy array: {reason(error)}") from error
    return np.asarray(array)


def _rows_of(array: NDArray[Any], path: Path) -> Rows:
    """Return an array (rows, columns) as rows."""
    if array.ndim != 2 or array.dtype.kind not in "fiu":
        raise InputError(f"{path}: is {array.dtype} of the shape {array.shape}, expected numbers (rows, columns)")
    _ensure_few(array.size, path)
    return tuple(tuple(row) for row in array.astype(np.float64).tolist())


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
