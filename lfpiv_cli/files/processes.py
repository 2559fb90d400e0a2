"""Which process a file belongs to that some process left: of this host or another one, running or dead."""

from __future__ import annotations

import hashlib
import os
import socket
from functools import lru_cache


@lru_cache(maxsize=1)
def host_digest() -> str:
    """Return what stands for this host in the names of files."""
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def is_running(process: int) -> bool:
    """Return whether a process of this host runs."""
    if os.name != "posix":  # where asking with a signal would send it
        return True
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True
