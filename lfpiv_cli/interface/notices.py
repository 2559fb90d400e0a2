"""What functions tell besides their result, when they are called from Python: as warnings, and nothing else."""

from __future__ import annotations

import warnings

from lfpiv_cli.console import Console

# From `Notices.warn` through the function that warns and the one of the interface to who called that.
CALLER = 4


class Notices(Console):
    """A console whose warnings are Python's."""

    def warn(self, text: str) -> None:
        """Warn of what went otherwise than one would expect."""
        warnings.warn(text, stacklevel=CALLER)


NOTICES = Notices(quiet=True)
