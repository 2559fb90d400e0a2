"""Commands run in this process, how they end, and what they are run on: the sample, Table 2's camera, no files."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import h5py
import pytest
import yaml

from lfpiv_cli.cli.main import cli
from lfpiv_cli.cli.options import outcome_of
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import DIGEST, write_digest
from lfpiv_cli.optics.media import Media

ROOT = Path(__file__).parent.parent
SAMPLE, CONFIG = ROOT / "sample_data", ROOT / "configs" / "sample.yaml"
WATER = Media(1.0, 1.49, 1.33)
# Of the sample's text: with it no calibration is needed.
AT_FOCUS = ("reference: mid_plane", "reference: focal_point")


def run(*arguments: object) -> None:
    """Run a command; errors come out as exceptions."""
    cli.main([str(argument) for argument in arguments], standalone_mode=False)


def hear_interrupts() -> None:
    """Have a new process hear SIGINT, which shells have their background jobs ignore, and SIGHUP, as nohup has it."""
    for sent in (signal.SIGINT, signal.SIGHUP):
        signal.signal(sent, signal.SIG_DFL)


def summary_of(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Run a command; return its summary."""
    capsys.readouterr()
    try:
        run(*arguments, "--json")
    finally:
        out = capsys.readouterr().out
    return dict(json.loads(out))


def contents(path: Path) -> dict[str, bytes]:
    """Return what is in a file, or in all files of a folder and below, hidden ones too."""
    files = [each for each in path.rglob("*") if each.is_file()] if path.is_dir() else [path]
    return {str(file.relative_to(path)): file.read_bytes() for file in files}


def changed(name: str, *changes: tuple[str, str]) -> str:
    """Return the text of a shipped config with pieces of it replaced, each of which must be there."""
    text = (ROOT / "configs" / f"{name}.yaml").read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    return text


def sample_rig(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the sample's config with such changes."""
    (folder / "rig.yaml").write_text(changed("sample", *changes))
    return folder / "rig.yaml"


def sample_weights(folder: Path, *changes: tuple[str, str]) -> Path:
    """Write the weights of such a config about the focal point; return their file."""
    run("build-weights", sample_rig(folder, AT_FOCUS, *changes), "-o", folder / "weights.h5", "-q")
    return folder / "weights.h5"


def table2_rig(columns: int, rows: int, layout: str = "square", **sections: dict[str, Any]) -> str:
    """Return the text of a config: Table 2's optics, in water, and other sections."""
    camera = {
        "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
        "microlenses": {"pitch_mm": 0.1, "focal_length_mm": 0.8, "layout": layout},
        "sensor": {"pixel_um": 5.5, "columns": columns, "rows": rows},
    }
    return str(yaml.safe_dump({"camera": camera, "media": {"air": 1.0, "window": 1.49, "fluid": 1.33}} | sections))


def refused(read: Callable[[], object], *words: str) -> bool:
    """Return whether a read is refused with an `InputError` that holds the words; other exceptions pass through."""
    try:
        read()
    except InputError as error:
        message = str(error)
    else:
        return False
    assert all(word in message for word in words), message
    return True


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
