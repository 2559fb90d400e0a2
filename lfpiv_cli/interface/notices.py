"""What functions tell besides their result, when they are called from Python: as warnings, and nothing else."""

from __future__ import annotations

import warnings
from collections.abc import Iterable

from lfpiv_cli.console import Console
from lfpiv_cli.notice import Notice

# From `warn_of` through the function of the interface to who called that.
CALLER = 3
SILENT = Console(quiet=True)


class LfpivWarning(UserWarning):
    """What speaks against a result; `notice` has its code, what it is about, figure, expectation and remedy."""

    def __init__(self, notice: Notice) -> None:
        super().__init__(str(notice))
        self.notice = notice


def warn_of(notices: Iterable[Notice]) -> None:
    """Give each notice as a Python warning; to be called by a function of the interface itself."""
    for notice in notices:
        warnings.warn(LfpivWarning(notice), stacklevel=CALLER)
