"""What the decoders of images complain of, kept until the command tells it: formats without check sums have no more."""

from __future__ import annotations

import logging
from contextvars import ContextVar
from pathlib import Path

from lfpiv_cli.notice import Notice

# Of a damaged file there can be one for each page.
MOST_KEPT = 20

# The file that is read.
reading: ContextVar[Path | None] = ContextVar("reading", default=None)
_kept: list[Notice] = []


class _Keeper(logging.Handler):
    """Keeps what a decoder logs."""

    def emit(self, record: logging.LogRecord) -> None:
        """Keep a message, each once."""
        path = reading.get()
        notice = Notice(
            "decoder-complains",
            "an image" if path is None else path.name,
            f"the decoder says: {record.getMessage().splitlines()[0]}",
            "compare the file with the camera's; --verify SHA256SUMS does",
        )
        if len(_kept) < MOST_KEPT and notice not in _kept:
            _kept.append(notice)


def keep_complaints(logger_name: str) -> None:
    """Keep what a decoder logs, in place of printing it."""
    logger = logging.getLogger(logger_name)
    logger.addHandler(_Keeper(logging.WARNING))
    logger.propagate = False


def taken_complaints() -> list[Notice]:
    """Return what was complained of since the last time."""
    taken, _kept[:] = list(_kept), []
    return taken
