"""What every reader asks of a file, and every command of memory and disk, before it begins; its share, and its time."""

from __future__ import annotations

import os
import re
import stat
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BufferedReader
from pathlib import Path

from lfpiv_cli.errors import InputError, OutputError, StoppedEarlyError, UsageError

# Where the system does not tell its memory (Windows), files that declare more than this are refused.
MEMORY_WHERE_UNKNOWN = 16 * 1024**3

# With 0.8 GiB numerical libraries end by SIGSEGV as they are loaded, with 1.2 GiB small work is done.
LEAST_ADDRESS_SPACE = 5 * 2**28

# How HDF5 tells the system's number of an error, among words of its own.
NUMBER_IN_HDF5 = re.compile(r"\berrno = (\d+)")

# A file, and what of it is meant: a dataset in it, or how its frames are laid out; and which of these, counted from 0.
PART = re.compile(r"(.+?\.[A-Za-z][A-Za-z0-9]*):(.+)", re.DOTALL)
PAGE = re.compile(r"(?:(.+):)?page=(\d{1,9})", re.DOTALL)


def split_part(path: Path) -> tuple[Path, str | None]:
    """Return the file that `FILE.h5:/PATH` or `FILE.raw:LAYOUT` names, and the part; of any other path, itself."""
    found = PART.fullmatch(path.as_posix())
    if found is None or os.path.lexists(path):
        return path, None
    return Path(found[1]), found[2]


def split_page(part: str | None) -> tuple[str | None, int | None]:
    """Return a part without the page that it names at its end, and this page."""
    found = None if part is None else PAGE.fullmatch(part)
    return (part, None) if found is None else (found[1], int(found[2]))


@contextmanager
def reading_from(path: Path) -> Iterator[None]:
    """Read from a file or folder; what the system refuses meanwhile is an `InputError` that names it."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {reason(error)}") from error


@contextmanager
def opened(path: Path) -> Iterator[BufferedReader]:
    """Open a file for reading its bytes; see `reading_from`."""
    with reading_from(path), open(path, "rb") as file:
        yield file


def content_of(path: Path) -> bytes:
    """Return all bytes of a regular file.

    Raises
    ------
    InputError : see `ensure_regular_file`
    """
    ensure_regular_file(path)
    with opened(path) as file:
        return file.read()


def given(**inputs: Path | str | None) -> dict[str, Path]:
    """Return the inputs of a command that were given, by their role."""
    return {role: Path(path) for role, path in inputs.items() if path is not None}


def ensure_regular_file(path: Path) -> int:
    """Return the size of a readable regular file in bytes.

    A FIFO would hang its reader and a folder gives each library another message, so both are named here.

    Raises
    ------
    InputError : the file is missing, not a regular file, empty or not readable
    """
    try:
        status = os.stat(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read: {reason(error)}") from None
    if not stat.S_ISREG(status.st_mode):
        kind = "a folder" if stat.S_ISDIR(status.st_mode) else "a pipe or device"
        raise InputError(f"{path}: is {kind}, expected a regular file")
    if status.st_size == 0:
        raise InputError(f"{path}: is empty")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: cannot be read: permission denied")
    return status.st_size


def reason(error: BaseException) -> str:
    """Return the cause of an error in one line: the system's words where it has a number, else its first line."""
    if isinstance(error, OSError) and error.errno:
        return os.strerror(error.errno)
    if (reported := NUMBER_IN_HDF5.search(str(error))) is not None:
        return os.strerror(int(reported[1]))
    lines = str(error).strip().splitlines()
    return lines[0] if lines else type(error).__name__


def address_space() -> int | None:
    """Return the limit of this process's address space in bytes, None where there is none."""
    try:
        import resource
    except ImportError:  # of Unix alone
        return None
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return None if limit == resource.RLIM_INFINITY else limit


def ensure_address_space() -> None:
    """Refuse to begin where the libraries would end the process, without a word, for want of addresses."""
    limit = address_space()
    if limit is not None and limit < LEAST_ADDRESS_SPACE:
        raise OutputError(
            f"too little memory: the address space of this process is limited to {limit / 1e9:.2f} GB (ulimit -v), and "
            f"the libraries alone need {LEAST_ADDRESS_SPACE / 1e9:.2f} GB"
        )


def physical_memory() -> int:
    """Return the machine's memory in bytes, or what of it this process may use."""
    limit = address_space()
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        memory = MEMORY_WHERE_UNKNOWN
    return memory if limit is None else min(memory, limit)


# Whether memory and disk suffice for what is about to be done, as far as that is known: an `OutputError` with the size.

# What the program takes with its libraries and compiled code.
PROGRAM_BYTES = 300e6
GB, KILO = 1e9, 1024
PROCESS, MACHINE, CONTROL_GROUPS = Path("/proc/self"), Path("/proc/meminfo"), Path("/sys/fs/cgroup")


def ensure_room(held_bytes: float, work: str, remedy: str = "a smaller volume, or fewer windows, need less") -> None:
    """Refuse to begin what holds more in memory than this process can still get.

    Parameters
    ----------
    held_bytes : arrays that are yet to be made
    work : what makes them
    remedy : what needs less
    """
    own, limit, machine = _told(PROCESS / "status"), address_space(), _told(MACHINE)
    # What this process can still get by each limit that it has, in bytes, and what sets the limit.
    rooms: list[tuple[float, str]] = []
    if limit is not None:
        rooms.append((max(limit - own.get("VmSize", 0), 0), "this process's address space (ulimit -v)"))
    for line in _text(PROCESS / "cgroup").splitlines():
        _, controllers, group = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        # Both versions of control groups; a limit on a group holds for all groups in it.
        base, name = CONTROL_GROUPS, "memory.max"
        if controllers:
            base, name = CONTROL_GROUPS / "memory", "memory.limit_in_bytes"
        place = base / group.lstrip("/")
        for folder in (place, *place.parents):
            if (folder == base or base in folder.parents) and (text := _text(folder / name).strip()).isdecimal():
                rooms.append((max(int(text) - own.get("VmRSS", 0), 0), "this job's limit (its control group)"))
    if "MemAvailable" in machine:
        rooms.append((machine["MemAvailable"] + machine.get("SwapFree", 0), "this machine"))
    for left, by in rooms:
        if held_bytes > left:
            raise OutputError(
                f"too little memory: {work} needs {_gb(PROGRAM_BYTES + held_bytes)} GB, {_gb(held_bytes)} of them for "
                f"its arrays, and {_gb(left)} GB are left of {by}; {remedy}"
            )


def _told(path: Path) -> dict[str, int]:
    """Return the sizes of a file of the kernel's, which has a name and kilobytes on each line, in bytes."""
    rows = (line.split() for line in _text(path).splitlines())
    return {row[0].rstrip(":"): KILO * int(row[1]) for row in rows if len(row) == 3 and row[2] == "kB"}


def _text(path: Path) -> str:
    """Return what a file of the kernel's says; nothing where it is not there, as on other systems than Linux."""
    try:
        return os.fsdecode(path.read_bytes())
    except OSError:
        return ""


def _gb(size: float) -> str:
    return f"{size / GB:.2f}"


# Shares of a batch: the frames that one job of many does, and in what time.
#
# A share is a run of frames that follow each other, not every n-th one: pairs and the frames that a background is made
# from then lie in one share, but for its ends, and are read and searched once. It is a share of all frames, whatever
# is complete already: so each job's share stays the same when it is started again.

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
