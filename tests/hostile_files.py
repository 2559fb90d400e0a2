"""Files that are damaged or made to do harm, and how a command ends that is given one."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import h5py

from lfpiv_cli.cli.main import cli
from lfpiv_cli.cli.options import outcome_of
from lfpiv_cli.files.hdf5 import DIGEST, write_digest


def ended(*arguments: object) -> tuple[int, str]:
    """Run a command in this process; return its exit code and what it would say of it."""
    try:
        cli.main([str(argument) for argument in arguments], standalone_mode=False)
    except BaseException as error:
        message, code = outcome_of(error)
        return code, message
    return 0, ""


def make_no_file(path: Path, kind: str) -> None:
    """Put at a path what is no file of ours: a `folder`, a `pipe`, an `empty` file, `text`, or else nothing."""
    if kind == "folder":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "empty":
        path.touch()
    elif kind == "text":
        path.write_text("hello")


@contextmanager
def edited(path: Path) -> Iterator[h5py.File]:
    """Open a file of ours for an edit by somebody who knows of its check sum."""
    with h5py.File(path, "r+") as file:
        del file.attrs[DIGEST]
        yield file
        with suppress(ValueError, TypeError):  # of what is hostile there is none
            write_digest(file)
