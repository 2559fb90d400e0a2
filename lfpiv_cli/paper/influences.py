"""What a measurement is sensitive to: each influence, how it is varied, and which numbers a user wants of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lfpiv_cli.paper.small_rig import Figures
from lfpiv_cli.validation.sensitivity_pictures import Panel

Values = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class Sensitivity:
    """A number that a user can use.

    Attributes
    ----------
    figure : whose straight line over the influence has the sensitivity as its slope, or whose value is taken
    text, unit, factor : of what, in which unit, and what turns the slope or value into that
    typical, typical_text : how wrong the influence typically is, in its own unit, and in words
    reach, reach_text : what turns the figure into an error of places, mm, and where that holds
    at : take the value there in place of a slope; None: the slope
    expected, tolerance : by theory, as the slope is; and by which share the measured one may differ; None: no theory
    power : of the influence in which the figure is a straight line
    """

    figure: str
    text: str
    unit: str
    factor: float
    typical: float
    typical_text: str
    reach: float = 1.0
    reach_text: str = "everywhere"
    at: float | None = None
    expected: float | None = None
    tolerance: float = 0.05
    power: float = 1.0


@dataclass(frozen=True)
class Influence:
    """Something that makes errors.

    Attributes
    ----------
    label : of the horizontal axis
    values : at which it is measured: tiny, quick, full
    measure : figures at a value, by seed
    advice : what to take care of; {error} is the error that typically follows
    repeats : realisations in full, where scatter matters
    """

    name: str
    label: str
    values: Values
    measure: Callable[[float, int], Figures]
    panels: tuple[Panel, Panel]
    sensitivities: tuple[Sensitivity, ...]
    advice: str
    repeats: int = 1
    logarithmic: bool = False


def around(largest: float, middle: float = 0.0) -> Values:
    """Return values on both sides of a middle: 2, 3 and 7."""
    tiny, quick, full = (tuple(float(middle + x) for x in np.linspace(-largest, largest, n)) for n in (2, 3, 7))
    return tiny, quick, full
