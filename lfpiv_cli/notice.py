"""What speaks against a result without keeping it from being made: one form for terminal, JSON, files and Python."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


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
