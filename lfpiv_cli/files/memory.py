"""Whether the memory suffices for what is about to be done, as far as that is known: said before, with the size."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from lfpiv_cli.errors import OutputError
from lfpiv_cli.files.inputs import address_space

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

    Raises
    ------
    OutputError
    """
    for left, by in _rooms():
        if held_bytes > left:
            raise OutputError(
                f"too little memory: {work} needs {_gb(PROGRAM_BYTES + held_bytes)} GB, {_gb(held_bytes)} of them for "
                f"its arrays, and {_gb(left)} GB are left of {by}; {remedy}"
            )


def ensure_disk(file_bytes: float, target: Path) -> None:
    """Refuse to begin what makes a file that the disk has no room for.

    Raises
    ------
    OutputError
    """
    left = shutil.disk_usage(target.parent).free
    if file_bytes > left:
        raise OutputError(f"{target}: needs {_gb(file_bytes)} GB, and {_gb(left)} GB are free on the disk")


def _rooms() -> Iterator[tuple[float, str]]:
    """Yield what this process can still get by each limit that it has, in bytes, and what sets the limit."""
    own = _told(PROCESS / "status")
    limit = address_space()
    if limit is not None:
        yield max(limit - own.get("VmSize", 0), 0), "this process's address space (ulimit -v)"
    for path in _group_limits():
        if (text := _text(path).strip()).isdecimal():
            yield max(int(text) - own.get("VmRSS", 0), 0), "this job's limit (its control group)"
    machine = _told(MACHINE)
    if "MemAvailable" in machine:
        yield machine["MemAvailable"] + machine.get("SwapFree", 0), "this machine"


def _group_limits() -> Iterator[Path]:
    """Yield the files that hold the memory limits of this process's control groups, for both of their versions."""
    for line in _text(PROCESS / "cgroup").splitlines():
        _, controllers, group = line.split(":", 2)
        if controllers == "" or "memory" in controllers.split(","):
            second = controllers == ""
            base = CONTROL_GROUPS if second else CONTROL_GROUPS / "memory"
            place = base / group.lstrip("/")
            # A limit on a group holds for all groups in it.
            for folder in (place, *place.parents):
                if folder == base or base in folder.parents:
                    yield folder / ("memory.max" if second else "memory.limit_in_bytes")


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
