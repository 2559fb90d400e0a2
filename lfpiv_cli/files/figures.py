"""What a person wants to know of a file first: its figures, by its format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files import calibration_file, vtkhdf
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.particle_file import (
    PARTICLES_FORMAT,
    TRACKS_FORMAT,
    TRAJECTORIES_FORMAT,
    Points,
    read_points,
)
from lfpiv_cli.flow.derived import derived_fields
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, VALID


def file_figures(path: Path, file_format: str) -> dict[str, Any]:
    """Return the figures of a file of a format, units in their names, None where unknown; none of other formats.

    Raises
    ------
    InputError : the file is broken
    """
    return READERS[file_format](path) if file_format in READERS else {}


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
    tracks = read_points(path, TRACKS_FORMAT)
    unknown = int(np.count_nonzero(np.isnan(tracks.arrays["link_probability"])))
    return {"tracks": len(tracks.position_mm)} | _of_all_tracks(tracks) | {"links_of_unknown_probability": unknown}


def _of_trajectories(path: Path) -> dict[str, Any]:
    tracks = read_points(path, TRAJECTORIES_FORMAT)
    lengths = np.unique(tracks.arrays["track"], return_counts=True)[1]
    found = {
        "tracks": len(lengths),
        "frames": len(np.unique(tracks.arrays["frame"])),
        "median_frames_of_a_track": medians(lengths[:, np.newaxis].astype(np.float64))[0],
    }
    return found | _of_all_tracks(tracks)


def _of_all_tracks(tracks: Points) -> dict[str, Any]:
    arrays = tracks.arrays
    return {
        "depths_mm": _range(tracks.position_mm[:, 2]),
        "median_velocity_m_s": medians(arrays["velocity"]),
        "median_velocity_sigma_m_s": medians(arrays["velocity_sigma"]),
        "expected_wrong_links": float(np.nansum(1.0 - arrays["link_probability"])),
    }


def _of_volume(path: Path) -> dict[str, Any]:
    volume = vtkhdf.open_volume(path)
    return {
        "voxels_xyz": list(volume.grid.shape_xyz),
        "voxel_mm": list(volume.grid.spacing_mm),
        "bounds_mm": [list(volume.grid.bounds_mm(axis)) for axis in range(3)],
        "lit_share": float(np.mean(volume.array > 0.0)),
        "largest_intensity": float(volume.array.max()),
    }


def _of_calibration(path: Path) -> dict[str, Any]:
    return {name: value for name, value in read_calibration(path).summary().items() if value is not None}


READERS: dict[str, Callable[[Path], dict[str, Any]]] = {
    vtkhdf.VECTORS_FORMAT: _of_vectors,
    vtkhdf.VOLUME_FORMAT: _of_volume,
    PARTICLES_FORMAT: _of_particles,
    TRACKS_FORMAT: _of_tracks,
    TRAJECTORIES_FORMAT: _of_trajectories,
    calibration_file.FORMAT: _of_calibration,
}
