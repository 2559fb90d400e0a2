"""What a person wants to know of a file first: its figures, by its format."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files import calibration_file, images, vtkhdf
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.hdf5 import RESERVED, format_of, from_attribute, member, open_h5, read_provenance
from lfpiv_cli.files.images import frames
from lfpiv_cli.files.inputs import ensure_regular_file, split_page, split_part
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT, open_tracks, read_points
from lfpiv_cli.files.recording_formats import HDF5_START
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, VALID, derived_fields

# What `info` tells of a file of frames.


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


# What is in a file of ours, without its numbers.

# Arrays that are told whole: places, sizes, a lattice's basis.
TOLD_SHAPES = ((2,), (3,), (2, 2))
# Groups that show our data to other programs once more.
VIEWS = ("VTKHDF",)


def describe(path: Path) -> dict[str, Any]:
    """Return format, version, how the file was made, and the scalars and the shapes of the arrays in it."""
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
    return found


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
