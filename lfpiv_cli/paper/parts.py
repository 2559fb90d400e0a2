"""What a part of the report is given and what it returns."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.atomic import write_json, write_text
from lfpiv_cli.files.inputs import ensure_regular_file, reason
from lfpiv_cli.files.pages import Table
from lfpiv_cli.names import Size
from lfpiv_cli.pictures.style import Figure, caption_of

TABLE_2: dict[str, Any] = {
    "camera": {
        "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
        "microlenses": {"focal_length_mm": 0.8, "pitch_mm": 0.1, "columns": 252, "rows": 252, "layout": "square"},
        "sensor": {"pixel_um": 5.5, "columns": 2352, "rows": 1768, "microlens_distance_mm": 0.8, "column_axis": "x"},
    },
    "media": {"air": 1.0, "window": 1.49, "fluid": 1.33},
    "window": {"distance_mm": 98.0, "thickness_mm": 2.0},
    "volume": {"shape_xyz": [80, 80, 240], "voxel_mm": 0.1, "centre_mm": [0.0, 0.0, 0.0], "reference": "focal_point"},
}

# How the paper reconstructs (Section 3.3).
AS_PAPER: dict[str, Any] = {"solver": "sart", "iterations": 200, "relaxation": 1.0, "accelerate": False}
# The board (Section 3.3), whatever it stands in.
BOARD: dict[str, Any] = {"dots": [7, 7], "spacing_mm": 1.0, "dot_diameter_mm": 0.2, "polarity": "bright"}
# How the array and the board on the wall depart from where they should be.
MISALIGNED: dict[str, Any] = {
    "board_tilt_deg": [-0.3, 0.2],
    "board_offset_mm": [-0.1, 0.15],
    "rotation_deg": 0.2,
    "shift_px": [-1.5, 4.0],
}


def sections(**changes: Any) -> dict[str, Any]:
    """Return the sections of the paper's config with changes: those of a section's keys, or whole values.

    A section or key that is None is left out.
    """
    return merged(TABLE_2, changes)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested sections with changes, which leave out what they set to None."""
    result = deepcopy(dict(base))
    for name, value in changes.items():
        if isinstance(value, Mapping):
            earlier = result.get(name)
            result[name] = merged(earlier if isinstance(earlier, Mapping) else {}, value)
        elif value is None:
            result.pop(name, None)
        else:
            result[name] = deepcopy(value)
    return result


Value = TypeVar("Value")
Verdict = Literal["met", "missed", "unknown"]


@dataclass(frozen=True)
class Row:
    """One quantity: the paper's values, ours, and what ours are held to.

    Attributes
    ----------
    quantity : in words, with its unit
    source : the table or figure of the paper
    limit, sense : what `judged` is held to, by default the paper's own value by equivalent ray tracing
    paper_dlfc, paper_ert : the paper's, by volumetric calibration and by equivalent ray tracing; None: it has none
    dlfc, ert : ours as the paper did it (SART, 200 iterations, 0.1 mm voxels); None: not measured
    best : ours at its best
    judged : which of ours the verdict is of
    reason : why ours as the paper did it falls short of the paper's, where it does
    """

    quantity: str
    source: str
    limit: float
    sense: Literal["at most", "at least"] = "at most"
    paper_dlfc: float | None = None
    paper_ert: float | None = None
    dlfc: float | None = None
    ert: float | None = None
    best: float | None = None
    judged: Literal["dlfc", "ert", "best"] = "best"
    reason: str = ""

    @property
    def verdict(self) -> Verdict:
        """Whether the judged value meets the limit; unknown where there is none."""
        value = getattr(self, self.judged)
        if value is None or value != value:
            return "unknown"
        return "met" if (value <= self.limit if self.sense == "at most" else value >= self.limit) else "missed"


@dataclass(frozen=True, eq=False)
class Drawing:
    """A picture that is to be written, `name` in lower case without spaces; the caption names the paper's figure."""

    name: str
    caption: str
    figure: Figure

    @classmethod
    def of(cls, name: str, draw: Callable[..., Figure], *given: Any) -> Drawing:
        """Return what a function draws, which says the caption in its first paragraph."""
        return cls(name, caption_of(draw), draw(*given))


@dataclass(frozen=True, eq=False)
class Findings:
    """What a part has found.

    Attributes
    ----------
    text : paragraphs: what was done, at which size, and what to read from it
    commands : what a person types in the report's folder to make the same figures
    seeds : of the random numbers
    """

    rows: tuple[Row, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    tables: tuple[Table, ...] = ()
    text: tuple[str, ...] = ()
    commands: tuple[str, ...] = ()
    seeds: tuple[int, ...] = ()


@dataclass(frozen=True)
class Work:
    """Where and how large a part works.

    Attributes
    ----------
    folder : of the part alone, below that of the report
    made : what a kept result must have been made with to be used again
    resume : use what is kept
    spared : how long, in seconds, what was kept had taken; each step adds to it
    """

    folder: Path
    size: Size
    console: Console
    made: Mapping[str, Any]
    resume: bool = False
    spared: list[float] = field(default_factory=list)

    def by_size(self, tiny: Value, quick: Value, full: Value) -> Value:
        """Return the value for the size."""
        return {"tiny": tiny, "quick": quick, "full": full}[self.size]

    def config(self, name: str, sections: Mapping[str, Any]) -> Path:
        """Write a config of the part's own and return its path."""
        path = self.folder / f"{name}.yaml"
        text = yaml.safe_dump(dict(sections), sort_keys=False, default_flow_style=None, width=110)
        write_text(path, text, overwrite=True)
        return path

    def step(self, name: str, make: Callable[[], Mapping[str, Any]]) -> dict[str, Any]:
        """Return what `make` gives, as JSON has it; kept, so that interrupted work goes on from there."""
        path = self.folder / f"{name}.json"
        begun = time.monotonic()
        result, seconds = kept(path, self.made, self.resume, make)
        self.spared.append(max(seconds - (time.monotonic() - begun), 0.0))
        return result


def kept(
    path: Path, made: Mapping[str, Any], resume: bool, make: Callable[[], Mapping[str, Any]]
) -> tuple[dict[str, Any], float]:
    """Return the result in a file that was made alike, or make it and write the file; and how long it took, s."""
    if resume and path.exists():
        found = read_json(path)
        if found.get("made") == made:
            return dict(found["result"]), float(found.get("seconds", 0.0))
    begun = time.monotonic()
    result = make()
    write_json(path, {"result": result, "seconds": time.monotonic() - begun, "made": made}, overwrite=True)
    found = read_json(path)
    return dict(found["result"]), float(found["seconds"])


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file of ours.

    Raises
    ------
    InputError : it is missing or not such a file
    """
    ensure_regular_file(path)
    try:
        value = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: is not a JSON file: {reason(error)}") from error
    if not isinstance(value, dict):
        raise InputError(f"{path}: holds no JSON object")
    return value


def rows_of(values: Sequence[Mapping[str, Any]]) -> tuple[Row, ...]:
    """Return the rows that plain data hold."""
    return tuple(Row(**{name: value for name, value in each.items() if name != "verdict"}) for each in values)
