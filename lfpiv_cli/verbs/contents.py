"""What a file holds, its figures by its format; a folder of results, and what speaks for and against these."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files import calibration_file, images, vtkhdf, weights_file
from lfpiv_cli.files.batch import natural
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.hdf5 import RESERVED, format_of, from_attribute, member, open_h5, read_provenance
from lfpiv_cli.files.images import frames
from lfpiv_cli.files.inputs import ensure_regular_file, split_page, split_part
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, open_tracks, read_points
from lfpiv_cli.files.recording_formats import HDF5_START
from lfpiv_cli.files.vtkhdf import VECTORS_FORMAT, VOLUME_FORMAT
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, VALID, VectorField, derived_fields
from lfpiv_cli.verbs import checks

# What `info` tells of a file of frames, and of ours without its numbers.

# Arrays that are told whole: places, sizes, a lattice's basis.
TOLD_SHAPES = ((2,), (3,), (2, 2))
# Groups that show our data to other programs once more.
VIEWS = ("VTKHDF",)


def recording_figures(path: Path) -> dict[str, Any]:
    """Return what the header of a file of frames says, and the steps between their times.

    Raises
    ------
    InputError, UsageError : see `images.frames`
    """
    file, part = split_part(path)
    recording = frames(path)
    found: dict[str, Any] = {
        "file_bytes": file.stat().st_size,
        "format": images.format_of(file, split_page(part)[0]).name,
        "pages": recording.pages,
        "columns": recording.shape[1],
        "rows": recording.shape[0],
        "bits": recording.bits,
    }
    if recording.time_s is not None and recording.pages > 1:
        steps_s = np.diff(recording.time_s)
        found |= {"shortest_step_s": float(steps_s.min()), "longest_step_s": float(steps_s.max())}
        duration_s = float(recording.time_s[-1] - recording.time_s[0])
        if duration_s > 0.0:
            found |= {"duration_s": duration_s, "frame_rate_hz": (recording.pages - 1) / duration_s}
    return found


def is_recording(path: Path) -> bool:
    """Return whether a file holds frames, by its first bytes or its name; of HDF5, what is not in a format of ours.

    Raises
    ------
    InputError : the file is missing, not a regular file, or empty
    """
    file, part = split_part(path)
    ensure_regular_file(file)
    try:
        kind = images.format_of(file, split_page(part)[0])
    except InputError:
        return False
    if kind.starts != (HDF5_START,) or part is not None:
        return True
    with open_h5(file) as content:
        return "format" not in content.attrs


def describe(path: Path) -> dict[str, Any]:
    """Return what there is to say of a file of frames, or of ours.

    Of ours that is format, version, how it was made, the scalars and the shapes of the arrays in it, and its figures.
    """
    if is_recording(path):
        return recording_figures(path)
    file_format = format_of(path)
    with open_h5(path) as file:
        record = read_provenance(file)
        found: dict[str, Any] = {
            "file_bytes": path.stat().st_size,
            "format": file_format,
            "format_version": int(file.attrs["format_version"]),
            "command": record.get("command"),
            "program_version": record.get("version"),
            "inputs": [f"{role} {entry['name']}" for role, entry in record.get("inputs", {}).items()],
        }
        # What was warned of when the inputs were made, and then the file itself, each with the command.
        warnings = [
            f"{each['command']}: {warning['about']}: {warning['text']}; {warning['remedy']} [{warning['code']}]"
            for each in [*record.get("made_from", {}).values(), record]
            for warning in each.get("warnings", ())
        ]
        if warnings:
            found["warnings_recorded"] = warnings
        weights = (record.get("config") or {}).get("weights")
        if weights:
            found |= {name: weights.get(name) for name in ("method", "refraction", "sampling")}
        _list_group(file, "", found)
    return found | FIGURES.get(file_format, lambda _: {})(path)


def _list_group(group: h5py.Group, prefix: str, found: dict[str, Any]) -> None:
    """Add the scalars and arrays of a group and of those in it."""
    for name, value in group.attrs.items():
        if (prefix or name not in RESERVED) and getattr(value, "ndim", 0) == 0 and name not in ("CLASS", "NAME"):
            scalar = from_attribute(name, value)
            if not isinstance(scalar, float) or math.isfinite(scalar):
                found[prefix + name] = scalar
    for name in group:
        if not prefix and name in VIEWS:
            continue
        item = member(group, name)
        if isinstance(item, h5py.Group):
            _list_group(item, f"{prefix}{name}/", found)
        elif item.shape in TOLD_SHAPES and np.isfinite(item[()]).all():
            found[prefix + name] = item[()].tolist()
        else:
            found[prefix + name] = f"{item.dtype} {list(item.shape)}"


def _of_vectors(path: Path) -> dict[str, Any]:
    field = vtkhdf.open_vectors(path)
    found: dict[str, Any] = {"vectors": field.flag.size, "valid_share": float(np.mean(field.flag == VALID))}
    found |= {f"vectors_{name.replace(' ', '_')}": count for name, count in field.flag_counts.items()}
    kept = field.flag < REJECTED
    sigma = field.uncertainty_voxel
    found["median_displacement_voxel"] = medians(field.displacement_voxel[kept])
    found["median_sigma_voxel"] = None if sigma is None else medians(sigma[kept])
    if field.dt_s is not None:
        to_velocity = np.asarray(field.voxel_mm) * MM_TO_M / field.dt_s
        found["median_velocity_m_s"] = medians(field.velocity[kept])
        found["median_velocity_sigma_m_s"] = None if sigma is None else medians(to_velocity * sigma[kept])
        found["divergence_rms_per_s"] = derived_fields(field).divergence_rms
    return found


def medians(values: NDArray[np.floating[Any]]) -> list[float | None]:
    """Return the median of each column of values (n, m), over those that are known; None where none is."""
    known = [column[np.isfinite(column)] for column in values.T]
    return [float(np.median(column)) if column.size else None for column in known]


def _of_particles(path: Path) -> dict[str, Any]:
    points = read_points(path, PARTICLES_FORMAT)
    arrays = points.arrays
    outside = int(np.count_nonzero(arrays["flag"]))
    return {
        "particles": len(points.position_mm),
        "particles_outside": outside,
        "depths_mm": _range(points.position_mm[:, 2]),
        "median_sigma_mm": medians(np.sqrt(arrays["covariance_mm2"][:, :3])),
        "median_light_counts": medians(arrays["intensity"][:, np.newaxis])[0],
        "median_chi2": medians(arrays["chi2"][:, np.newaxis])[0],
    }


def _range(values: NDArray[np.float64]) -> list[float] | None:
    return [float(values.min()), float(values.max())] if values.size else None


def _of_tracks(path: Path) -> dict[str, Any]:
    tracks = open_tracks(path)
    arrays, places = tracks.arrays, tracks.position_mm
    found: dict[str, Any] = {"tracks": len(places)}
    if "track" in arrays:
        lengths = np.unique(arrays["track"], return_counts=True)[1]
        found = {
            "tracks": len(lengths),
            "frames": len(np.unique(arrays["frame"])),
            "median_frames_of_a_track": medians(lengths[:, np.newaxis].astype(np.float64))[0],
        }
    found |= {
        "depths_mm": _range(places[:, 2]),
        "median_velocity_m_s": medians(arrays["velocity"]),
        "median_velocity_sigma_m_s": medians(arrays["velocity_sigma"]),
        "expected_wrong_links": float(np.nansum(1.0 - arrays["link_probability"])),
    }
    if "track" not in arrays:
        found["links_of_unknown_probability"] = int(np.count_nonzero(np.isnan(arrays["link_probability"])))
    return found


def _of_volume(path: Path) -> dict[str, Any]:
    volume = vtkhdf.open_volume(path)
    return {
        "voxels_xyz": list(volume.grid.shape_xyz),
        "voxel_mm": list(volume.grid.spacing_mm),
        "bounds_mm": [list(volume.grid.bounds_mm(axis)) for axis in range(3)],
        "lit_share": float(np.mean(volume.array > 0.0)),
        "largest_intensity": float(volume.array.max()),
    }


# The figures of a file of a format, units in their names, None where unknown.
FIGURES: dict[str, Callable[[Path], dict[str, Any]]] = {
    vtkhdf.VECTORS_FORMAT: _of_vectors,
    vtkhdf.VOLUME_FORMAT: _of_volume,
    PARTICLES_FORMAT: _of_particles,
    TRACKS_FORMAT: _of_tracks,
    TRAJECTORIES_FORMAT: _of_tracks,
    calibration_file.FORMAT: lambda path: {
        name: value for name, value in open_calibration(path).summary().items() if value is not None
    },
}


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
    reasons = checks.of_warnings(records)
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
    reasons.sort(key=lambda line: -checks.ORDER.index(line.verdict))
    return {part: [line for line in reasons if line.about == part] for part, _, _ in counted}


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
