"""The stage of `track`: particles followed from frame to frame, and their vectors on a grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import is_kept
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, read_points, read_tracks, write_points
from lfpiv_cli.files.provenance import record, with_warnings
from lfpiv_cli.flow.field import REJECTED
from lfpiv_cli.interface.tracks import (
    Tracked,
    ensure_frames,
    ensure_particles,
    few_notices,
    settings_of,
    tracked,
    tracking_of,
)
from lfpiv_cli.interface.vectors_checks import calibration_notices, field_notices, quality_of, quality_of_all

ROLES_OF_TWO = ["particles_a", "particles_b"]


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """What `track_particles` is given besides the particles.

    Attributes
    ----------
    dt_s : time from one frame to the next, in place of the config's
    search_voxel : displacements are sought up to this along each axis, six microlenses in the scene where None
    shortest : fewest frames of a track in a sequence, three where None
    grid : vectors on the grid of the correlation windows, too
    resume : keep what is complete and made from the same particles with the same settings
    """

    dt_s: float | None = None
    search_voxel: float | None = None
    shortest: int | None = None
    grid: bool = False
    resume: bool = False


NO_OPTIONS = TrackOptions()


def track_particles(
    particles: Sequence[Path],
    output: Path,
    options: TrackOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Follow particles from frame to frame."""
    ensure_frames(len(particles), options.shortest)
    inputs = dict(zip(_roles(len(particles)), particles, strict=True))
    grids = grid_paths(output, len(particles) - 1) if options.grid else []
    for target in (output, *grids):
        ensure_writable(target, overwrite or options.resume, inputs.values())
    frames, names = [read_points(path, PARTICLES_FORMAT) for path in particles], [str(path) for path in particles]
    settings = settings_of(frames, names).overridden_by("correlation", options)
    counts = [len(frame.position_mm) for frame in frames]
    ensure_particles(counts, names)
    chosen = tracking_of(settings, options.search_voxel, options.shortest, len(frames), names[0])
    made = record("track", settings.resolved() | chosen.told(), inputs)
    if options.resume:
        if is_kept([output, *grids], made, inputs.values(), overwrite, resume=True):
            return {"tracks": count_tracks(output)}
        overwrite = True
    found = tracked(frames, settings, chosen, made)
    short = [path.name for path in particles]
    records = {
        f"{role} {path.name}": frame.provenance for (role, path), frame in zip(inputs.items(), frames, strict=True)
    }
    notices = [*calibration_notices(records), *few_notices(counts, short, found)]
    console.warn(notices)
    provenance = with_warnings(found.points.provenance, notices)
    write_points(output, found.format_name, replace(found.points, provenance=provenance), overwrite=overwrite)
    return found.summary | _sigmas(found) | _write_grids(grids, found, provenance, overwrite, console)


def count_tracks(path: Path) -> int:
    """Return how many tracks a file holds, of two frames or of a sequence."""
    points = read_tracks(path)
    number = points.arrays.get("track")
    return len(points.position_mm) if number is None else len(np.unique(number))


def grid_paths(output: Path, intervals: int) -> list[Path]:
    """Return where the vectors of each interval between frames go, beside the tracks."""
    names = ["_grid"] if intervals == 1 else [f"_grid_{number:04d}" for number in range(intervals)]
    return [output.with_name(f"{output.stem}{name}{output.suffix}") for name in names]


def _roles(frames: int) -> list[str]:
    return ROLES_OF_TWO if frames == 2 else [f"particles_{number:04d}" for number in range(frames)]


def _sigmas(found: Tracked) -> dict[str, Any]:
    """Return the median of the tracks' standard deviations, and the share of those without one."""
    sigma = found.points.arrays["velocity_sigma"]
    known = np.isfinite(sigma).all(axis=1)
    return {
        "velocity_sigma_m_s_median": np.median(sigma[known], axis=0).tolist() if known.any() else None,
        "tracks_without_uncertainty_share": float(np.mean(~known)) if len(known) else None,
    }


def _write_grids(
    grids: Sequence[Path], found: Tracked, provenance: Mapping[str, Any], overwrite: bool, console: Console
) -> dict[str, Any]:
    """Write the vectors of each interval; return how many there are and how good."""
    if not grids:
        return {}
    qualities, rejected = [], 0
    for target, field in zip(grids, found.vectors(), strict=True):
        quality = quality_of(field)
        notices = list(field_notices(quality, target.name))
        console.warn(notices)
        made = with_warnings(provenance, notices)
        vtkhdf.write_vectors(target, field, found.points.reference, provenance=made, overwrite=overwrite)
        qualities.append(quality)
        rejected += int(np.count_nonzero(field.flag >= REJECTED))
    all_of_them = quality_of_all(qualities)
    return {"vectors": all_of_them.vectors, "rejected": rejected} | all_of_them.summary()
