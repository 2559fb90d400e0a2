"""Shares of a batch: the frames that one job of many does, in what time, and claims on what workers make now.

A share is a run of frames that follow each other, not every n-th one: pairs and the frames that a background is made
from then lie in one share, but for its ends, and are read and searched once. It is a share of all frames, whatever is
complete already: so each job's share stays the same when it is started again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from lfpiv_cli.errors import OutputError, StoppedEarlyError, UsageError
from lfpiv_cli.files.atomic import KEPT_CHARACTERS, create_alone, folder_of, is_running
from lfpiv_cli.files.inputs import reason

# Claims: which output of a folder some worker makes now, so that several workers share a batch.
#
# A claim is a small hidden file beside the output, which only one worker can create. A claim that a dead worker left
# is taken over; should two take it over at once, both make the output, which is written whole and the same by either.

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

    def keep_touching() -> None:
        while not ended.wait(TOUCHED_EVERY_S):
            with contextlib.suppress(OSError):
                os.utime(claim)

    with folder_of(target):
        try:
            granted = _create(claim)
            if not granted and _is_dead(claim):
                claim.unlink(missing_ok=True)
                granted = _create(claim)
            if granted:
                threading.Thread(target=keep_touching, daemon=True).start()
            yield granted
        finally:
            ended.set()
            if granted:
                claim.unlink(missing_ok=True)


@contextmanager
def awaited(target: Path) -> Iterator[None]:
    """Claim an output, after another worker that makes it now has ended."""
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


# In place of i/n: what Slurm tells each job of an array.
SLURM = "slurm"
SECONDS = {"": 1.0, "s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
# A share that has no end would be a loop in somebody's script.
MOST_SHARES = 1_000_000


@dataclass(frozen=True)
class Shard:
    """Part `number` of `count` parts of a batch, counted from 1."""

    number: int = 1
    count: int = 1

    @classmethod
    def parse(cls, text: str, environment: Mapping[str, str] = os.environ) -> Shard:
        """Return the share that is written as `2/3`, or as `slurm`: the one of this job in its array.

        Raises
        ------
        UsageError : it is neither, or Slurm's array is not a run of numbers at equal steps.
        """
        if text == SLURM:
            task, first, count = (_slurms(environment, name) for name in ("ID", "MIN", "COUNT"))
            step = _slurms(environment, "STEP", 1)
            place, beside = divmod(task - first, max(step, 1))
            if beside or not 0 <= place < count:
                raise UsageError(
                    f"--shard {SLURM}: task {task} is none of {count} that begin at {first} in steps of {step}; give "
                    "a range, as --array=1-20"
                )
            return cls(place + 1, count)
        found = re.fullmatch(r"(\d{1,7})/(\d{1,7})", text, re.ASCII)
        if found is None:
            raise UsageError(f"--shard {text}: is neither i/n, as 2/3, nor {SLURM}")
        number, count = int(found[1]), int(found[2])
        if not 1 <= number <= count <= MOST_SHARES:
            raise UsageError(f"--shard {text}: i goes from 1 to n, and n to {MOST_SHARES}")
        return cls(number, count)

    @property
    def is_last(self) -> bool:
        """True of the last part."""
        return self.number == self.count

    def numbers(self, total: int) -> range:
        """Return the numbers of the frames of this share, of `total` frames counted from 0."""
        return range((self.number - 1) * total // self.count, self.number * total // self.count)

    def of(self, order: Sequence[int]) -> Sequence[int]:
        """Return those of this share, of the numbers of frames in the order in which they are divided."""
        places = self.numbers(len(order))
        return order[places.start : places.stop]


def _slurms(environment: Mapping[str, str], name: str, default: int | None = None) -> int:
    """Return what Slurm tells a job of its array."""
    variable = f"SLURM_ARRAY_TASK_{name}"
    text = environment.get(variable, "" if default is None else str(default))
    if not re.fullmatch(r"\d{1,9}", text, re.ASCII):
        raise UsageError(f"--shard {SLURM}: {variable} is {text or 'not set'}; sbatch --array sets it to a number")
    return int(text)


def parse_time_limit(text: str) -> float:
    """Return the seconds of a time as `3600`, `50m`, `1.5h`, or as Slurm writes it: `00:50:00`, `1-12:00:00`.

    Raises
    ------
    UsageError : it is none of these, or no time at all.
    """
    clock = re.fullmatch(r"(?:(\d{1,3})-)?(\d{1,3}):([0-5]\d):([0-5]\d)", text, re.ASCII)
    number = re.fullmatch(r"(\d{1,9}(?:\.\d{1,9})?)([smhd]?)", text, re.ASCII)
    if clock is not None:
        days, hours, minutes, seconds = (int(part or 0) for part in clock.groups())
        limit = 86400.0 * days + 3600.0 * hours + 60.0 * minutes + seconds
    elif number is not None:
        limit = float(number[1]) * SECONDS[number[2]]
    else:
        raise UsageError(f"--time-limit {text}: is no time, as 3600, 50m, 1.5h or 00:50:00")
    if limit == 0.0:
        raise UsageError(f"--time-limit {text}: leaves no time at all")
    return limit


@dataclass
class Deadline:
    """When a command has to be done, and how long a frame of it takes at most; begins when it is made.

    Attributes
    ----------
    limit_s : seconds from its begin, None for no limit
    longest_s : what the longest frame so far took
    """

    limit_s: float | None = None
    longest_s: float = 0.0
    begun: float = field(default_factory=time.monotonic)

    def took(self, seconds: float) -> None:
        """Remember the longest frame: by it the next one is judged."""
        self.longest_s = max(self.longest_s, seconds)

    def leaves_time(self, frames: int = 1) -> bool:
        """Return whether so many frames, each as long as the longest one so far, would be done in time."""
        return self.limit_s is None or self._left_s() > frames * self.longest_s

    def error(self, done: int, total: int, unit: str) -> StoppedEarlyError:
        """Return the error of a batch that stops for lack of time."""
        return StoppedEarlyError(
            f"stopped before the time limit of {self.limit_s:g} s: {max(self._left_s(), 0.0):.0f} s are left, and a "
            f"{unit} took up to {self.longest_s:.1f} s; {done} of {total} {unit}s are done; the same command with "
            "--resume goes on"
        )

    def _left_s(self) -> float:
        return (self.limit_s or 0.0) - (time.monotonic() - self.begun)


class Runs:
    """Frames that are left, for workers of which each goes on with the next frame after its last.

    So what neighbouring frames have in common, a pair or the frames of a background, is mostly read by one worker.
    """

    def __init__(self, numbers: Sequence[int]) -> None:
        """Take the numbers of the frames, in their order."""
        self._numbers = list(numbers)
        self._left = set(range(len(self._numbers)))
        # The place in the order that each worker was given last.
        self._last: dict[str, int] = {}

    def __len__(self) -> int:
        """Return how many frames are left."""
        return len(self._left)

    def next_for(self, worker: str) -> int:
        """Return the next frame for a worker, of which there are some left."""
        place = self._last.get(worker, -1) + 1
        if worker not in self._last or place not in self._left:
            # Where the longest run that is left begins, or its middle if somebody else comes to its begin.
            runs: list[list[int]] = []
            for left in sorted(self._left):
                if runs and left == runs[-1][-1] + 1:
                    runs[-1].append(left)
                else:
                    runs.append([left])
            longest = max(runs, key=len)
            place = longest[len(longest) // 2 if longest[0] - 1 in self._last.values() else 0]
        self._last[worker] = place
        self._left.remove(place)
        return self._numbers[place]

    def put_back(self, number: int) -> None:
        """Take back a frame that a worker was given."""
        self._left.add(self._numbers.index(number))
