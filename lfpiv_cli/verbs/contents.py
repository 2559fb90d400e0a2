"""What a folder of results holds, and what speaks for and against it: the verdict in a report and of a run."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.errors import InputError
from lfpiv_cli.files import calibration_file, weights_file
from lfpiv_cli.files.batch import natural
from lfpiv_cli.files.hdf5 import open_h5, read_provenance
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT, VOLUME_FORMAT
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.verbs import checks

# By the formats of our files, in the order of the chain.
KINDS = {
    calibration_file.FORMAT: "calibration",
    weights_file.FORMAT: "weights",
    VOLUME_FORMAT: "volumes",
    PARTICLES_FORMAT: "particles",
    VECTORS_FORMAT: "vectors",
    TRACKS_FORMAT: "tracks",
    TRAJECTORIES_FORMAT: "tracks",
}
SUFFIXES = (".h5", ".vtkhdf")
# Folders below the one that is given: of volumes, of particles, of a batch's vectors.
DEEPEST = 2
# So many reasons of one kind are told.
MOST_REASONS = 3
# Commands, by their records, whose vectors are made of others that stand beside them.
MEAN = "correlate mean"
MADE_OF_OTHERS = (MEAN, "statistics", "combine")
# Vectors by their files.
Fields = Mapping[Path, VectorField]


@dataclass(frozen=True)
class Contents:
    """The files of ours in a folder by what they are, and the record of each by its name in the folder.

    `earlier` are the records of what they were made from that is not in the folder, as volumes that were not kept.
    """

    folder: Path
    files: Mapping[str, list[Path]]
    records: Mapping[str, Mapping[str, Any]]
    earlier: Mapping[str, Mapping[str, Any]]

    def of(self, kind: str) -> list[Path]:
        """Return the files of a kind, in the order of their names."""
        return self.files.get(kind, [])

    def record(self, path: Path) -> Mapping[str, Any]:
        """Return the record of a file."""
        return self.records[path.relative_to(self.folder).as_posix()]

    @property
    def all_records(self) -> Mapping[str, Mapping[str, Any]]:
        """The records of all that the results come from, whether it is in the folder or not."""
        return {**self.earlier, **self.records}

    @property
    def last(self) -> Mapping[str, Any]:
        """The record of the file that was made last."""
        return list(self.records.values())[-1]


def contents_of(folder: Path, only: Iterable[Path] | None = None) -> Contents:
    """Return what a folder holds, and the folders in it; or `only` some of its files, as far as they are there.

    Raises
    ------
    InputError : it is no folder, holds nothing of ours, or a broken file
    """
    if not os.path.isdir(folder):
        raise InputError(f"{folder}: is no folder of results")
    files: dict[str, list[Path]] = {}
    records: dict[str, Mapping[str, Any]] = {}
    paths = folder.rglob("*") if only is None else (path for path in only if path.exists())
    ours = (path for path in paths if path.suffix in SUFFIXES)
    for path in sorted(ours, key=lambda path: (natural(path.as_posix()), path)):
        parts = path.relative_to(folder).parts
        if len(parts) > DEEPEST or any(part.startswith(".") for part in parts):
            continue
        with open_h5(path) as file:
            format_name = file.attrs.get("format", b"")
            kind = KINDS.get(format_name.decode() if isinstance(format_name, bytes) else "")
            if kind is None:
                continue
            records["/".join(parts)] = read_provenance(file)
        files.setdefault(kind, []).append(path)
    if not records:
        raise InputError(f"{folder}: holds no file of lfpiv; expected what calibrate-snapshot and the others write")
    order = list(dict.fromkeys(KINDS.values()))
    in_order = {kind: files[kind] for kind in order if kind in files}
    names = [path.relative_to(folder).as_posix() for kind in in_order.values() for path in kind]
    # What files were made from, by name and hash, but for what is among these files.
    there = [{name: value for name, value in made.items() if name != "made_from"} for made in records.values()]
    behind = {digest: made for each in records.values() for digest, made in each.get("made_from", {}).items()}
    inputs = [given for made in (*there, *behind.values()) for given in made.get("inputs", {}).values()]
    called = {given["sha256"]: given["name"] for given in inputs}
    known = {json.dumps(made, sort_keys=True) for made in there}
    earlier = {
        f"{called.get(digest, '')} ({digest[:8]}, not in the folder)": made
        for digest, made in behind.items()
        if json.dumps(made, sort_keys=True) not in known
    }
    return Contents(folder, in_order, {name: records[name] for name in names}, earlier)


def judged(contents: Contents, fields: Fields) -> dict[checks.Part, list[checks.Line]]:
    """Return what speaks for and against each part of the chain, the worst first."""
    ours = by_command(contents, fields)
    others = list(ours)[1:]
    of_others = {name: made for name, made in contents.all_records.items() if checks.verb_of(made) in others}
    records = {name: made for name, made in contents.all_records.items() if name not in of_others}
    reasons = [*checks.of_warnings(records)]
    faulty: set[Path] = set()
    # What speaks against vectors that better ones by another command stand beside is told, and not counted.
    for number, paths in enumerate(ours.values()):
        found = [each for path in paths for each in checks.of_vectors(fields[path], path.name)]
        against = [each for each in found if each.verdict != "good"]
        warned = checks.of_warnings({str(path): contents.record(path) for path in paths})
        faulty |= {path for path in paths if checks.worst([*against, *warned], "good") != "good"}
        reasons += [replace(each, verdict="good") if number else each for each in against[:MOST_REASONS]]
        if len(against) > MOST_REASONS:
            text = f"{len(against) - MOST_REASONS} more reasons like these in other files"
            reasons.append(checks.Line("vectors", "good" if number else "look", text))
        reasons += [each for each in found if each.verdict == "good"][:1]
    if all(len(paths) == 1 for paths in ours.values()):
        for one, other in combinations([path for paths in ours.values() for path in paths], 2):
            differ = checks.of_two_ways(fields[one], fields[other], (one.name, other.name))
            # From vectors that are told to be poor others may differ.
            reasons += [replace(each, verdict="good") if {one, other} & faulty else each for each in differ]
    reasons += [replace(each, verdict="good") for each in checks.of_warnings(of_others)]
    if others:
        text = f"the verdict on vectors is of those by {next(iter(ours))}; what is said of those by"
        reasons.append(checks.Line("vectors", "good", f"{text} {' and '.join(others)} does not count in it"))
    made_by = {checks.verb_of(record) for record in contents.all_records.values()}
    counted: list[tuple[checks.Part, bool, str]] = [
        (
            "calibration",
            not made_by.isdisjoint(checks.CALIBRATES),
            "no calibration: lengths are as the data sheet has them",
        ),
        ("images", not made_by.isdisjoint(checks.OF_IMAGES), "no volumes and no particles"),
        ("vectors", bool(contents.of("vectors") or contents.of("tracks")), "no vectors and no tracks"),
    ]
    reasons += [checks.Line(part, "look", text) for part, there, text in counted if not there]
    return {part: checks.worst_first(reasons, part) for part, _, _ in counted}


def by_command(contents: Contents, fields: Fields) -> dict[str, list[Path]]:
    """Return the files of vectors by the command that made them, those that the verdict is of first.

    These are the ones that least speaks against, of several the ones with the smallest stated errors. What is made of
    them, combined or as a mean, comes last.
    """
    found: dict[str, list[Path]] = {}
    for path in fields:
        made = contents.record(path)
        found.setdefault(MEAN if made.get("command") == MEAN else checks.verb_of(made), []).append(path)

    def rank(command: str) -> tuple[bool, int, float]:
        paths = found[command]
        lines = [line for path in paths for line in checks.of_vectors(fields[path], path.name)]
        lines += checks.of_warnings({str(path): contents.record(path) for path in paths})
        # Of each its usual stated error, mm; infinite where none is stated.
        sizes = []
        for field in (fields[path] for path in paths):
            sigma = checks.quality_of(field).summary()["uncertainty_voxel_median"]
            sizes.append(np.inf if sigma is None else float(np.linalg.norm(np.multiply(sigma, field.voxel_mm))))
        return command in MADE_OF_OTHERS, checks.ORDER.index(checks.worst(lines)), float(np.median(sizes))

    return {command: found[command] for command in sorted(found, key=rank)}
