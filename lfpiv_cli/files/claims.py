"""Claims: which output of a folder some worker makes now, so that several workers share a batch.

A claim is a small hidden file beside the output, which only one worker can create. A claim that a dead worker left is
taken over; should two take it over at once, both make the output, which is written whole and the same by either.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lfpiv_cli.errors import OutputError
from lfpiv_cli.files.atomic import KEPT_CHARACTERS, create_alone, folder_of
from lfpiv_cli.files.inputs import reason
from lfpiv_cli.files.processes import is_running

# A worker touches its claim this often; one that was not touched for so long belongs to a worker that is dead, on
# whatever host. The clocks of hosts that share a disk differ by less.
TOUCHED_EVERY_S, DEAD_AFTER_S = 20.0, 300.0
# How often a worker looks at what others have claimed, where it waits for it.
SECONDS_BETWEEN_LOOKS = 0.5


@contextmanager
def claimed(target: Path) -> Iterator[bool]:
    """Claim an output while it is made; yields whether the claim was granted.

    Raises
    ------
    OutputError : the folder takes no file, or cannot be made
    """
    claim, granted, ended = claim_path(target), False, threading.Event()
    with folder_of(target):
        try:
            granted = _create(claim) or (_is_dead(claim) and _take_over(claim))
            if granted:
                threading.Thread(target=_keep_touching, args=(claim, ended), daemon=True).start()
            yield granted
        finally:
            ended.set()
            if granted:
                claim.unlink(missing_ok=True)


@contextmanager
def awaited(target: Path) -> Iterator[None]:
    """Claim an output, after another worker that makes it now has ended.

    Raises
    ------
    OutputError : as `claimed`
    """
    while True:
        with claimed(target) as granted:
            if granted:
                yield
                return
        time.sleep(SECONDS_BETWEEN_LOOKS)


def claim_path(target: Path) -> Path:
    """Return where the claim of an output lies: beside it, under a name that is not longer than the system allows."""
    digest = hashlib.sha256(os.fsencode(target.name)).hexdigest()[:8]
    return target.with_name(f".{target.stem[:KEPT_CHARACTERS]}.{digest}.claim")


def _create(claim: Path) -> bool:
    """Create a claim; return whether there was none."""
    try:
        descriptor = create_alone(claim)
    except FileExistsError:
        return False
    except OSError as error:
        raise OutputError(f"{claim.parent}: cannot be written into: {reason(error)}") from error
    try:
        os.write(descriptor, json.dumps({"host": socket.gethostname(), "process": os.getpid()}).encode())
    finally:
        os.close(descriptor)
    return True


def _take_over(claim: Path) -> bool:
    """Put a claim in the place of a dead worker's; return whether nobody else was quicker."""
    claim.unlink(missing_ok=True)
    return _create(claim)


def _is_dead(claim: Path) -> bool:
    """Return whether a claim's worker is dead: no process of this host, or silent for long."""
    try:
        silent_s = time.time() - claim.stat().st_mtime
        worker = json.loads(claim.read_bytes())
        host, process = worker["host"], int(worker["process"])
    except FileNotFoundError:
        return False  # its worker has just ended; the next look finds what it made
    except (OSError, ValueError, KeyError, TypeError):
        return silent_s > DEAD_AFTER_S  # it is being written, or its worker was killed while it was
    return silent_s > DEAD_AFTER_S or (host == socket.gethostname() and not is_running(process))


def _keep_touching(claim: Path, ended: threading.Event) -> None:
    """Show that the claim's worker is alive, until the work has ended."""
    while not ended.wait(TOUCHED_EVERY_S):
        with contextlib.suppress(OSError):
            os.utime(claim)
