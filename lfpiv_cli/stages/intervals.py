"""What is said where the time between frames that is stated is not the one that their recording tells."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from lfpiv_cli.files.batch import Frame
from lfpiv_cli.files.provenance import seconds_between
from lfpiv_cli.notice import Notice, written

# Beyond so much the two are not the same.
CONTRADICTING_SHARE = 0.01


def dt_notices(stated_s: float | None, pairs: Iterable[Sequence[Mapping[str, Any]]], name: str) -> list[Notice]:
    """Return where a stated time between frames contradicts the recorded one, by the records of pairs of results."""
    return _notices(stated_s, [seconds_between(first, second) for first, second in pairs], name)


def frames_dt_notices(stated_s: float | None, frames: Sequence[Frame]) -> list[Notice]:
    """Return where a stated time between frames contradicts the recorded one of frames in a row."""
    times = [frame.time_s if frame.path == frames[0].path else None for frame in frames]
    steps = [None if a is None or b is None else b - a for a, b in pairwise(times)]
    return _notices(stated_s, steps, str(frames[0].path))


def _notices(stated_s: float | None, recorded_s: Sequence[float | None], name: str) -> list[Notice]:
    known = [step for step in recorded_s if step is not None]
    if stated_s is None or not known:
        return []
    worst = max(known, key=lambda step: abs(step - stated_s))
    if abs(worst - stated_s) <= CONTRADICTING_SHARE * stated_s:
        return []
    text = f"its frames were recorded {written(worst, 6)} s apart, and {written(stated_s, 6)} s are stated"
    remedy = "correct correlation.dt_s, or leave it out: then the recorded time is taken"
    return [Notice("time-between-frames", name, text, remedy, worst, f"{stated_s:g}")]
