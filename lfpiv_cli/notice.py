"""What speaks against a result without keeping it from being made: one form for terminal, JSON, files and Python."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

# Numbers from the first on are so many of a word; beyond the second, and below the third, they are powers of ten.
WORDS = ((1e12, "trillion"), (1e9, "billion"), (1e6, "million"))
LARGEST_WRITTEN, SMALLEST_WRITTEN = 1e15, 1e-6
# From `warn_of` through the function of the interface to who called that.
CALLER = 3


@dataclass(frozen=True)
class Notice:
    """A warning.

    Attributes
    ----------
    code : kebab-case, the same in all versions; the page Troubleshooting lists all of them
    about : the key of the config, the file or the picture that it is about
    text : what was found and what was expected, a sentence without its full stop
    remedy : what to do
    measured : the figure that was found; None where there is none
    expected : the figure, or the range, that was expected; None where there is none
    """

    code: str
    about: str
    text: str
    remedy: str
    measured: float | None = None
    expected: str | None = None

    def __str__(self) -> str:
        """Return it on one line."""
        return f"{self.about}: {self.text}; {self.remedy} [{self.code}]"

    def record(self) -> dict[str, Any]:
        """Return it as plain data, as JSON and provenance have it."""
        return asdict(self)


def written(value: float, digits: int = 3) -> str:
    """Return a number of so many digits as people write it: 110 and 0.00002, where a computer has 1.1e+02 and 2e-05."""
    rounded = float(f"{value:.{digits}g}")
    size = abs(rounded)
    if size == 0.0 or not math.isfinite(size):
        return f"{size if size == 0.0 else rounded:g}"
    if not SMALLEST_WRITTEN <= size < LARGEST_WRITTEN:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{float(mantissa):g} x 10^{int(exponent)}"
    for unit, word in WORDS:
        if size >= unit:
            return f"{written(rounded / unit, digits)} {word}"
    text = f"{rounded:.{max(digits - 1 - math.floor(math.log10(size)), 0)}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def with_error(value: float, error: float) -> str:
    """Return a number and its standard error, both to the second digit of that: 0.1200 ± 0.0055."""
    if not (math.isfinite(error) and error > 0.0):
        return f"{written(value)} ± {written(error)}"
    decimals = max(1 - math.floor(math.log10(float(f"{error:.1e}"))), 0)
    return f"{value:z.{decimals}f} ± {error:.{decimals}f}"


class LfpivWarning(UserWarning):
    """What speaks against a result; `notice` has its code, what it is about, figure, expectation and remedy."""

    def __init__(self, notice: Notice) -> None:
        super().__init__(str(notice))
        self.notice = notice


def warn_of(notices: Iterable[Notice]) -> None:
    """Give each notice as a Python warning; to be called by a function of the interface itself."""
    for notice in notices:
        warnings.warn(LfpivWarning(notice), stacklevel=CALLER)
