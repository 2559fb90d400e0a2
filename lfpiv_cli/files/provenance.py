"""Where a result comes from: a record that says the same whenever and wherever the same work is done.

It holds no time, folder, host or user, so that the same work gives the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np

import lfpiv_cli
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.atomic import without_nan, written_atomically
from lfpiv_cli.files.hdf5 import LIBRARY_VERSIONS, open_h5, read_provenance, write_digest
from lfpiv_cli.files.images import files_beside
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, opened, reading_from, split_part
from lfpiv_cli.notice import Notice

# What has changed is not written out where it takes more characters.
LONGEST_CHANGE = 150
# Files whose hash is remembered: those that a batch has in common are few.
FILES_REMEMBERED = 64
# The libraries that the figures pass through.
LIBRARIES = ("numpy", "scipy", "numba", "h5py", "tifffile", "imagecodecs", "opencv-contrib-python-headless")

# Steps between frames that differ by this share of their mean are not even: a dropped frame, or stamps too coarse.
UNEVEN = 0.02

# Sections of the config that a command does not read: whatever they say, it makes the same.
AFTER_VOLUMES = ("correlation", "simulation", "validation")
UNREAD = {
    "calibrate-snapshot": ("volume", "reconstruction", *AFTER_VOLUMES),
    "build-weights": AFTER_VOLUMES,
    "reconstruct": AFTER_VOLUMES,
}
# What coordinates follow from: results of one flow agree in these, in whatever ways they were measured.
OF_COORDINATES = ("camera", "media", "window", "scene", "weights.method", "weights.refraction")
# What frames agree in that are measured together: all but what says nothing of them.
OF_FRAMES = (
    *("camera", "media", "window", "scene", "volume", "board", "channel", "pipe"),
    *("weights", "reconstruction", "correlation"),
)


@dataclass(frozen=True)
class Gone:
    """An input that is no longer there, or will carry another record: its SHA-256 and that record."""

    sha256: str
    record: Mapping[str, Any]


def record(
    command: str,
    config: Mapping[str, Any] | None,
    inputs: Mapping[str, Path],
    taken_s: Mapping[str, float | None] | None = None,
    gone: Mapping[Path, Gone] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the record of a result.

    Parameters
    ----------
    command : the subcommand and the options that bear on the result
    config : the resolved config, as plain data, or None where there is none
    inputs : the files that the result is made from, by their role
    taken_s : when images among these were taken, in s from a moment of their file's own, where it tells
    gone : of these, those that are no longer there, or will carry another record

    Returns
    -------
    dict
        `program`, `version`, `libraries`, `command`, `config`, `inputs` (by role: name without folder and SHA-256; of
        images that have them the time, and the SHA-256 of a header or folder `beside`) and `made_from`: the records of
        those inputs, and of what these were made from, that are results of this program, by SHA-256.

    Raises
    ------
    InputError : an input cannot be read
    """
    named: dict[str, dict[str, Any]] = {}
    made_from: dict[str, Any] = {}
    for role, path in sorted(inputs.items()):
        file, part = split_part(path)
        known = gone.get(path)
        digest = sha256(path) if known is None else known.sha256
        named[role] = {"name": file.name if part is None else f"{file.name}:{part}", "sha256": digest}
        taken = (taken_s or {}).get(role)
        if taken is not None:
            named[role]["time_s"] = taken
        for other in files_beside(file):
            named[role].setdefault("beside", {})[other.name] = sha256(other)
        earlier = earlier_record(file) if known is None else dict(known.record)
        if earlier is not None:
            made_from.update(earlier.pop("made_from", {}))
            made_from[digest] = earlier
    return {
        "program": "lfpiv",
        "version": lfpiv_cli.__version__,
        "libraries": dict(_libraries()),
        "command": command,
        "config": None if config is None else without_nan(config),
        "inputs": named,
        "made_from": dict(sorted(made_from.items())),
    }


@cache
def _libraries() -> dict[str, str]:
    """Return the versions of what figures pass through: to ask the system takes longer than the rest of a record."""
    return {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}}


def with_warnings(made: Mapping[str, Any], notices: Iterable[Notice]) -> dict[str, Any]:
    """Return a record with what, besides what it holds, was warned of when the result was made."""
    warnings = [*made.get("warnings", ()), *(without_nan(notice.record()) for notice in notices)]
    return dict(made) | ({"warnings": warnings} if warnings else {})


def without_warnings(made: Mapping[str, Any]) -> dict[str, Any]:
    """Return a record as it stood before the work: what it was made of and how."""
    return {name: value for name, value in made.items() if name != "warnings"}


def replace_provenance(path: Path, provenance: Mapping[str, Any]) -> None:
    """Give a file another record, its data as they are."""
    with written_atomically(path, overwrite=True, check=carried_record) as temporary:
        shutil.copyfile(path, temporary)
        with h5py.File(temporary, "r+", libver=LIBRARY_VERSIONS) as file:
            file.attrs["provenance"] = np.bytes_(json.dumps(provenance, allow_nan=False))
            write_digest(file)


def also_used_as(made: Mapping[str, Any], role: str) -> str | None:
    """Return as what else the input of a role was given, to this command or to one before; None if as nothing else.

    Of several inputs of a role the names end in a number: `image`, `image_2`.
    """

    def identity(given: Mapping[str, str]) -> tuple[str, str | None]:
        return given["sha256"], split_part(Path(given["name"]))[1]  # the content, and which part of it is meant

    asked = identity(made["inputs"][role])
    for each in (made, *made["made_from"].values()):
        for name, given in each["inputs"].items():
            if identity(given) == asked and name.partition("_")[0] != role:
                return f"{name} of {each['command'].split()[0]}"
    return None


def seconds_between(first: Mapping[str, Any], second: Mapping[str, Any]) -> float | None:
    """Return the time from the image of one record to that of another; None where it is not told.

    Times count from a moment of the recording's own: only those of one file can be compared.
    """
    images = [made.get("inputs", {}).get("image", {}) for made in (first, second)]
    before, after = (image.get("time_s") for image in images)
    if before is None or after is None or images[0]["sha256"] != images[1]["sha256"]:
        return None
    return float(after) - float(before)


def even_step_s(steps_s: Sequence[float | None], names: Sequence[str]) -> float | None:
    """Return the time from one frame to the next, of several that are to be alike; None where one is not told.

    Raises
    ------
    InputError : frames are not in the order in which they were taken, or not evenly spaced in time
    """
    reported = [step for step in steps_s if step is not None]
    if not reported or len(reported) < len(steps_s):
        return None
    mean_s, span = sum(reported) / len(reported), f"{names[0]} to {names[-1]}: the recording's times"
    if min(reported) <= 0.0:
        raise InputError(f"{span} do not increase from frame to frame; give them in order, or --dt-s")
    if max(reported) - min(reported) > UNEVEN * mean_s:
        raise InputError(f"{span} are {min(reported):g} to {max(reported):g} s apart, expected even steps; give --dt-s")
    return mean_s


def calibrated_with(made: Mapping[str, Any]) -> str | None:
    """Return the SHA-256 of the calibration that a volume's or particles' weights are of, or of weights without one.

    None where the record does not say.
    """
    weights = made.get("inputs", {}).get("weights", {}).get("sha256")
    earlier = made.get("made_from", {}).get(weights, {}).get("inputs", {})
    return str(earlier["calibration"]["sha256"]) if "calibration" in earlier else weights


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits; of the whole file where a part of it is named.

    Of a folder, that of the list of its files with the SHA-256 of each, as `sha256sum` prints it.
    """
    file, _ = split_part(path)
    if os.path.isdir(file):
        with reading_from(file), os.scandir(file) as entries:
            files = [each for each in entries if each.is_file() and not each.name.startswith(".")]
            states = sorted((each.name, each.stat().st_size, each.stat().st_mtime_ns) for each in files)
        return _sha256_of_all(file, tuple(states))
    size = ensure_regular_file(file)
    return _sha256(file, size, file.stat().st_mtime_ns)


@lru_cache(maxsize=FILES_REMEMBERED)
def _sha256(path: Path, size: int, modified_ns: int) -> str:
    """Hash a file once as long as it does not change: what all frames of a batch share is an input of each."""
    with opened(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@lru_cache(maxsize=FILES_REMEMBERED)
def _sha256_of_all(folder: Path, states: Sequence[tuple[str, int, int]]) -> str:
    """Hash the files of a folder once as long as none of them changes."""
    lines = (f"{_sha256(folder / name, size, modified_ns)}  {name}\n" for name, size, modified_ns in states)
    return hashlib.sha256(os.fsencode("".join(lines))).hexdigest()


def same_result(first: Mapping[str, Any], second: Mapping[str, Any]) -> bool:
    """Return whether two records are of the same result: alike but for settings that it does not depend on."""
    try:
        return _bearing(first, first["made_from"]) == _bearing(second, second["made_from"])
    except (KeyError, AttributeError, TypeError):  # one of them is no record of a result
        return False


def _bearing(made: Mapping[str, Any], earlier: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a record, and of those that it is made from, a result depends on."""
    unread = UNREAD.get(made["command"].split()[0], ())
    inputs = {
        role: _bearing(earlier[given["sha256"]], earlier) if given["sha256"] in earlier else given
        for role, given in made["inputs"].items()
        if role != "config"
    }
    config = {name: value for name, value in (made["config"] or {}).items() if name not in unread}
    same = {name: made[name] for name in ("program", "version", "libraries", "command")}
    return same | {"config": config, "inputs": inputs}


def differences(carried: Mapping[str, Any], made: Mapping[str, Any]) -> list[str]:
    """Return in words what has changed since a result was made, by the record that it carries and that it would get."""
    before, now = _facts(carried), _facts(made)
    reported = []
    for name in dict.fromkeys([*now, *before]):
        was, is_now = before.get(name), now.get(name)
        if isinstance(was, dict) or isinstance(is_now, dict):  # an input, which is no plain value
            words = f"{name} is another file"
        else:
            words = f"{name} was {was}, is {is_now}".replace("None", "not given")
        if was != is_now:
            reported.append(words if len(words) <= LONGEST_CHANGE else f"{name} has changed")
    configs = [made.get("inputs", {}).get("config") for made in (carried, made)]
    return reported or (["the config is another file, which says the same"] if configs[0] != configs[1] else [])


def _facts(made: Mapping[str, Any]) -> dict[str, Any]:
    """Return what of a record can change, by its name: keys of the config, inputs, the command and all versions."""
    inputs = _bearing(made, made["made_from"])["inputs"] if "made_from" in made else {}
    versions = {"lfpiv": made.get("version"), **made.get("libraries", {})}
    return {**_values(made.get("config") or {}), **inputs, "the command": made.get("command"), **versions}


def ensure_agreement(records: Sequence[Mapping[str, Any]], names: Sequence[str], keys: Sequence[str]) -> None:
    """Refuse results whose configs differ in sections, or in keys of them, as far as their records have a config.

    Parameters
    ----------
    names : of the results, for messages
    keys : `OF_COORDINATES` or `OF_FRAMES`
    """
    known = [(_values(made["config"]), name) for made, name in zip(records, names, strict=True) if made.get("config")]
    for (first, first_name), (config, name) in ((known[0], each) for each in known[1:]):
        for key in sorted(config.keys() | first.keys()):
            ours, theirs = config.get(key), first.get(key)
            if ours != theirs and any(key == part or key.startswith(f"{part}.") for part in keys):
                raise InputError(
                    f"{name}: was made with another config than {first_name}: {key} is {ours}, expected {theirs}"
                )


def _values(config: Mapping[str, Any], place: str = "") -> dict[str, Any]:
    """Return the values of a config by their keys, `camera.sensor.rows`; lists are values."""
    values: dict[str, Any] = {}
    for name, value in config.items():
        key = f"{place}{name}"
        values |= _values(value, f"{key}.") if isinstance(value, dict) else {key: value}
    return values


def carried_record(path: Path) -> dict[str, Any]:
    """Return the record that a file of ours carries.

    Raises
    ------
    InputError : there is none, or the file is broken
    """
    with open_h5(path) as file:
        return read_provenance(file)


def earlier_record(path: Path) -> dict[str, Any] | None:
    """Return the record that a file of ours carries, None for any other file."""
    size = ensure_regular_file(path)
    text = _earlier_record(path, size, path.stat().st_mtime_ns)
    return None if text is None else json.loads(text)


@lru_cache(maxsize=FILES_REMEMBERED)
def _earlier_record(path: Path, _size: int, _modified_ns: int) -> str | None:
    """Read a record once as long as its file does not change, as JSON: whoever asks gets one of his own."""
    if not h5py.is_hdf5(path):
        return None
    with open_h5(path) as file:
        return json.dumps(read_provenance(file)) if "provenance" in file.attrs else None


# Inputs against a list of their SHA-256, as `sha256sum` writes it: most cameras' formats have no check sum.

# `sha256sum` writes a star before the names of files that are read as bytes.
LINE = re.compile(r"([0-9a-fA-F]{64}) [ *](.+)")
LARGEST_LIST_BYTES = 2**28


def ensure_verified(listed: Path, inputs: Iterable[Path]) -> int:
    """Refuse inputs that are not as a list says, or not in it; return how many files were read for that.

    Parameters
    ----------
    listed : the list; names in it count from its folder
    inputs : files, and folders of which all that is listed is asked
    """
    expected = _sums_in(listed)
    given = [split_part(path)[0] for path in inputs]
    read = [each for path in given for each in (path, *(() if os.path.isdir(path) else files_beside(path)))]
    # The name that each file was given under, by its resolved name.
    asked: dict[Path, Path] = {}
    for path in read:
        resolved = path.resolve()
        inside = [file for file in expected if resolved in file.parents] if os.path.isdir(resolved) else [resolved]
        if not inside or (inside == [resolved] and resolved not in expected):
            raise InputError(f"{path}: is not in {listed}, which lists {len(expected)} files")
        asked |= {file: path if file == resolved else file for file in inside}
    for file, name in asked.items():
        found = sha256(file)
        if found != expected[file]:
            raise InputError(
                f"{name}: has the SHA-256 {found}, {listed} says {expected[file]}: it is damaged, or another"
            )
    return len(asked)


def _sums_in(listed: Path) -> dict[Path, str]:
    """Return the SHA-256 of each file in a list, by its resolved name."""
    size = ensure_regular_file(listed)
    if size > LARGEST_LIST_BYTES:
        raise InputError(f"{listed}: has {size} bytes, expected a list of at most {LARGEST_LIST_BYTES}")
    lines = content_of(listed).decode("utf-8", errors="surrogateescape").splitlines()
    found: dict[Path, str] = {}
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.startswith("#"):
            continue
        match = LINE.fullmatch(line)
        if match is None:
            raise InputError(f"{listed}:{number}: is no line of sha256sum: 64 digits, two spaces, a file's name")
        name = (listed.parent / match[2]).resolve()
        if found.setdefault(name, match[1].lower()) != match[1].lower():
            raise InputError(f"{listed}:{number}: {match[2]} has another SHA-256 further above")
    return found
