"""Whether a result can be relied on, as far as it tells itself: good, look, or no, with reasons.

Three parts of the chain are judged: the calibration, the images and what was found in them, and the vectors. What was
warned of when files were made counts, and for vectors what the flow says against them (`flow.field`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.light_checks import MOST_SATURATED
from lfpiv_cli.flow.field import MASKED, REJECTED, VectorField, difference_over_stated, divergence_over_stated
from lfpiv_cli.notice import written

Word = Literal["good", "look", "no"]
Part = Literal["calibration", "images", "vectors"]
# From the best to the worst.
WORDS: tuple[Word, ...] = ("good", "look", "no")
PARTS: tuple[Part, ...] = ("calibration", "images", "vectors")

# What makes a result worthless, and what is said for information.
WORTHLESS = {
    "light-off-lens-images",
    "dark-lit",
    "frame-uniform",
    "frame-dark",
    "light-unexplained",
    "no-particles",
    "no-tracks",
    "frames-alike",
    "other-calibration",
    "volumes-alike",
    "volumes-unlike",
}
FOR_INFORMATION = {"heavy-work", "particle-diameter-limit"}
# What does so where it measures more than this: of four tracers for each microlens one in seven is found by tracks, of
# six hardly any, however much of the light is explained.
WORTHLESS_BEYOND = {"frame-saturated": MOST_SATURATED, "particles-crowded": 6.0}
# The commands whose warnings are of the calibration, and of the images; those of all others are of the vectors.
CALIBRATES = ("calibrate-snapshot", "refine-calibration")
OF_CALIBRATION = (*CALIBRATES, "build-weights")
OF_IMAGES = ("reconstruct", "find_particles", "follow")
# Errors are taken for larger than stated from here on: the ratios scatter by some tenths where windows share tracers.
LARGEST_OVER_STATED = 3.0
# Vectors that are shorter than so many standard deviations on every axis show no flow.
SHORTEST_SIGMAS = 3.0
# A component tells little whose usual stated error is a larger share of the usual displacement.
LARGEST_SHARE = 0.25


@dataclass(frozen=True)
class Verdict:
    """What is thought of a part: the worst of its reasons' words."""

    part: Part
    word: Word
    reasons: tuple[str, ...]


@dataclass(frozen=True)
class Reason:
    """One thing that speaks for or against a part."""

    part: Part
    word: Word
    text: str


def verdicts(reasons: Iterable[Reason], made: Iterable[Part]) -> list[Verdict]:
    """Return the verdict of each part that was made, its worst reasons first."""
    by_part = {part: [each for each in reasons if each.part == part] for part in PARTS}
    found = []
    for part in made:
        worst_first = sorted(by_part[part], key=lambda each: -WORDS.index(each.word))
        word = worst_first[0].word if worst_first else "good"
        found.append(Verdict(part, word, tuple(each.text for each in worst_first)))
    return found


def of_warnings(records: Mapping[str, Mapping[str, Any]]) -> list[Reason]:
    """Return what the warnings say that the records of files hold, by the files' names; each once, with its count."""
    seen: dict[tuple[Part, str], list[tuple[str, Mapping[str, Any]]]] = {}
    for name, made in records.items():
        for warning in made.get("warnings", ()):
            seen.setdefault((_part_of(verb_of(made)), warning["code"]), []).append((name, warning))
    return [
        Reason(part, _worst_of(warnings), _told(warnings, len({name for name, _ in those})))
        for (part, _), those in seen.items()
        if (warnings := [warning for _, warning in those])
    ]


def _told(warnings: Sequence[Mapping[str, Any]], files: int) -> str:
    first = warnings[0]
    more = f" (and {files - 1} more)" if files > 1 else ""
    return f"{first['about']}: {first['text']}{more}; {first['remedy']}"


def verb_of(made: Mapping[str, Any]) -> str:
    """Return the command of a record without its options."""
    return str(made.get("command")).split(" ")[0]


def _part_of(verb: str) -> Part:
    if verb in OF_CALIBRATION:
        return "calibration"
    return "images" if verb in OF_IMAGES else "vectors"


def _worst_of(warnings: Iterable[Mapping[str, Any]]) -> Word:
    return max((word_of(each) for each in warnings), key=WORDS.index)


def word_of(warning: Mapping[str, Any]) -> Word:
    """Return what is thought of a result by one warning's record alone."""
    code, measured = warning["code"], warning.get("measured")
    if code in WORTHLESS or (code in WORTHLESS_BEYOND and measured is not None and measured > WORTHLESS_BEYOND[code]):
        return "no"
    return "good" if code in FOR_INFORMATION else "look"


def of_vectors(field: VectorField, name: str) -> list[Reason]:
    """Return what a field says of itself."""
    used, there = field.flag < MASKED, field.flag < REJECTED
    if not there.any():
        return [Reason("vectors", "no", f"{name}: no vector is left")]
    share = np.count_nonzero(there) / np.count_nonzero(used)
    reasons = [Reason("vectors", "good", f"{name}: {np.count_nonzero(there)} vectors, {share:.0%} of the places")]
    if field.uncertainty_voxel is not None:
        long = np.abs(field.displacement_voxel[there]) > SHORTEST_SIGMAS * field.uncertainty_voxel[there]
        if np.mean(long.any(axis=1)) < 0.5:
            text = f"{name}: most displacements are within {SHORTEST_SIGMAS:g} standard deviations of zero"
            reasons.append(Reason("vectors", "look", f"{text}; a longer time between the images would show the flow"))
        else:
            reasons += _components(field, there, field.uncertainty_voxel[there], name)
    ratio = divergence_over_stated(field)
    if ratio is not None and ratio > LARGEST_OVER_STATED:
        text = f"{name}: the divergence is {ratio:.1f} times what the stated errors make, and a liquid has none"
        reasons.append(
            Reason("vectors", "look", f"{text}: errors are larger than stated, or the flow finer than windows")
        )
    return reasons


def _components(
    field: VectorField, there: NDArray[np.bool_], sigma_voxel: NDArray[np.float64], name: str
) -> list[Reason]:
    """Return which components are known too badly to tell much of the flow."""
    usual_mm = float(np.median(np.linalg.norm(field.displacement_voxel[there] * field.voxel_mm, axis=1)))
    known = sigma_voxel[np.isfinite(sigma_voxel).all(axis=1)]
    if not len(known):
        return []
    sigma_mm = np.median(known, axis=0) * field.voxel_mm
    return [
        Reason(
            "vectors",
            "look",
            f"{name}: {component} is known to {written(sigma, 2)} mm, {sigma / usual_mm:.0%} of the usual "
            "displacement; particles in place of volumes, or a longer time between the images, tell more",
        )
        for component, sigma in zip("uvw", sigma_mm, strict=True)
        if sigma > LARGEST_SHARE * usual_mm > 0.0
    ]


def of_two_ways(one: VectorField, other: VectorField, names: tuple[str, str]) -> list[Reason]:
    """Return what two measurements of one flow say of each other."""
    ratios = difference_over_stated(one, other)
    if ratios is None:
        return []
    told = ", ".join(f"{ratio:.1f}" for ratio in ratios)
    text = f"{names[0]} and {names[1]} differ by {told} (u, v, w) times what their stated errors let expect"
    return [Reason("vectors", "look" if max(ratios) > LARGEST_OVER_STATED else "good", text)]
