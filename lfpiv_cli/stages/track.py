"""The stage of `track`: particles followed from frame to frame, and their vectors on a grid."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.particle_file import (
    PARTICLES_FORMAT,
    TRACKS_FORMAT,
    TRAJECTORIES_FORMAT,
    Points,
    read_points,
    write_points,
)
from lfpiv_cli.files.provenance import record
from lfpiv_cli.flow.correlation import SMALLEST_VALID_FRACTION
from lfpiv_cli.flow.field import MASKED, MM_TO_M, REJECTED, VALID, VectorField
from lfpiv_cli.flow.windows import layout_windows
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import Reference
from lfpiv_cli.tracks.gridding import on_grid
from lfpiv_cli.tracks.sequences import SHORTEST, follow, scatter_in, states_at
from lfpiv_cli.tracks.tracking import SEARCH_VOXEL, Tracks, track

# A vector needs its twelve nearest tracks within this many windows of its centre: in sparse images tracks are further
# apart than windows, and what a wide fit misses of the flow is in the stated error.
REACH_WINDOWS = 2.0
ROLES_OF_TWO = ["particles_a", "particles_b"]


@dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """What `track_particles` is given besides the particles.

    Attributes
    ----------
    dt_s : time from one frame to the next, in place of the config's
    search_voxel : displacements are sought up to this along each axis
    shortest : fewest frames of a track in a sequence, `SHORTEST` where None
    grid : vectors on the grid of the correlation windows, too
    """

    dt_s: float | None = None
    search_voxel: float = SEARCH_VOXEL
    shortest: int | None = None
    grid: bool = False


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
    if len(particles) < 2:
        raise UsageError("track needs the particles of two frames at least")
    if len(particles) == 2 and options.shortest is not None:
        raise UsageError("--shortest is for sequences: two frames make tracks of two")
    intervals = len(particles) - 1
    names = [f"_grid_{number:04d}" for number in range(intervals)] if intervals > 1 else ["_grid"]
    grids = [output.with_name(f"{output.stem}{name}{output.suffix}") for name in names] if options.grid else []
    roles = [f"particles_{number:04d}" for number in range(len(particles))] if intervals > 1 else ROLES_OF_TWO
    inputs = dict(zip(roles, particles, strict=True))
    for target in (output, *grids):
        ensure_writable(target, overwrite, inputs.values())
    frames = [read_points(path, PARTICLES_FORMAT) for path in particles]
    for path, frame in zip(particles[1:], frames[1:], strict=True):
        if frame.provenance.get("config") != frames[0].provenance.get("config"):
            raise InputError(f"{path}: was made with another config than {particles[0]}")
    settings = Config.from_resolved(frames[0].provenance["config"]).overridden_by("correlation", options)
    if settings.correlation.dt_s is None:
        raise InputError(f"{particles[0]}: its config has no correlation.dt_s; give --dt-s")
    told = {"search_voxel": options.search_voxel}
    search_mm = told["search_voxel"] * max(settings.grid().spacing_mm)
    if intervals > 1:
        told["shortest"] = SHORTEST if options.shortest is None else options.shortest
        found = _sequence(frames, search_mm, int(told["shortest"]), settings.correlation.dt_s)
    else:
        found = _pair(frames[0], frames[1], search_mm, settings.correlation.dt_s)
    files = Files(
        record("track", settings.resolved() | told, inputs),
        frames[0].reference,
        overwrite,
    )
    write_points(
        output,
        found.format_name,
        found.position_mm,
        found.arrays,
        files.reference,
        provenance=files.provenance,
        attributes={"dt_s": settings.correlation.dt_s},
        overwrite=overwrite,
    )
    return found.summary | _write_grids(grids, found.paths, settings, files)


@dataclass(frozen=True, eq=False)
class Paths:
    """Middles, displacements and standard errors (n, 3), mm, of the tracks that pass from one frame to the next."""

    middle_mm: NDArray[np.float64]
    displacement_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Found:
    """What is written of tracks: points with their arrays, what to tell of them, and the paths in each interval."""

    format_name: str
    position_mm: NDArray[np.float64]
    arrays: dict[str, NDArray[Any]]
    summary: dict[str, Any]
    paths: Sequence[Paths]


@dataclass(frozen=True)
class Files:
    """What all files that are written share."""

    provenance: dict[str, Any]
    reference: Reference
    overwrite: bool


def _pair(first: Points, second: Points, search_mm: float, dt_s: float) -> Found:
    """Follow particles from one frame to the next."""
    found = track(first.position_mm, second.position_mm, search_mm)
    paths = _paths(first, second, found)
    arrays = {
        "velocity": paths.displacement_mm * MM_TO_M / dt_s,
        "velocity_sigma": paths.sigma_mm * MM_TO_M / dt_s,
        "displacement_mm": paths.displacement_mm,
        "particle_a": found.first,
        "particle_b": found.second,
    }
    summary = {
        "particles_a": len(first.position_mm),
        "particles_b": len(second.position_mm),
        "tracks": len(found.first),
    }
    return Found(TRACKS_FORMAT, paths.middle_mm, arrays, summary, [paths])


def _sequence(frames: Sequence[Points], search_mm: float, shortest: int, dt_s: float) -> Found:
    """Follow particles over many frames."""
    points = [frame.position_mm for frame in frames]
    sigma = [np.sqrt(frame.arrays["covariance_mm2"][:, :3]) for frame in frames]
    found = follow(points, sigma, search_mm, shortest)
    scatter, half = scatter_in(found, points, sigma)
    rows: list[tuple[NDArray[Any], ...]] = []
    for number in range(len(frames)):
        tracks, state = states_at(found, points, sigma, float(number), scatter, half)
        frame = np.full(len(tracks), number)
        particle = found.particles(number, tracks)
        rows.append((state.position_mm, state.velocity, state.velocity_sigma, tracks, frame, particle))
    position, velocity, error, tracks, frame, particle = (np.concatenate(each) for each in zip(*rows, strict=True))
    order = np.lexsort((frame, tracks))
    arrays = {
        "velocity": velocity[order] * MM_TO_M / dt_s,
        "velocity_sigma": error[order] * MM_TO_M / dt_s,
        "track": tracks[order],
        "frame": frame[order],
        "particle": particle[order],
    }
    between = [states_at(found, points, sigma, number + 0.5, scatter, half)[1] for number in range(len(frames) - 1)]
    paths = [Paths(state.position_mm, state.velocity, state.velocity_sigma) for state in between]
    summary = {
        "frames": len(frames),
        "particles": sum(len(each) for each in points),
        "tracked": len(tracks),
        "tracks": found.count,
        "noise_over_stated": scatter.noise.tolist(),
        "acceleration_m_s2": (np.sqrt(scatter.bending) * MM_TO_M / dt_s**2).tolist(),
    }
    return Found(TRAJECTORIES_FORMAT, position[order], arrays, summary, paths)


def _write_grids(grids: Sequence[Path], paths: Sequence[Paths], settings: Config, files: Files) -> dict[str, Any]:
    """Write the vectors of each interval; return how many there are."""
    if not grids:
        return {}
    summary = {"vectors": 0, "rejected": 0}
    for target, passing in zip(grids, paths, strict=True):
        field = _vectors(settings, settings.grid(), passing)
        vtkhdf.write_vectors(target, field, files.reference, provenance=files.provenance, overwrite=files.overwrite)
        summary["vectors"] += field.flag.size
        summary["rejected"] += int(np.count_nonzero(field.flag >= REJECTED))
    return summary


def _paths(first: Points, second: Points, tracks: Tracks) -> Paths:
    """Return the paths of a pair's tracks."""
    start, end = first.position_mm[tracks.first], second.position_mm[tracks.second]
    variance = first.arrays["covariance_mm2"][tracks.first, :3] + second.arrays["covariance_mm2"][tracks.second, :3]
    return Paths(0.5 * (start + end), end - start, np.sqrt(variance))


def _vectors(settings: Config, volume: Grid, paths: Paths) -> VectorField:
    """Return the vectors at the centres of the correlation windows."""
    size = settings.windows_voxel(volume.spacing_mm)[-1]
    grid = layout_windows(volume.shape_xyz, size, settings.overlap(volume.spacing_mm)).grid(volume)
    z, y, x = np.meshgrid(*(grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    nodes = np.stack([x, y, z], axis=-1)
    reach = REACH_WINDOWS * max(n * d for n, d in zip(size, volume.spacing_mm, strict=True))
    values, errors = on_grid(paths.middle_mm, paths.displacement_mm, paths.sigma_mm, nodes.reshape(-1, 3), reach)
    inside = _share_between_walls(settings, grid, size[2] * volume.spacing_mm[2])
    masked = inside < SMALLEST_VALID_FRACTION
    displacement = np.where(masked[..., np.newaxis], np.nan, values.reshape(nodes.shape) / volume.spacing_mm)
    found = np.isfinite(displacement).all(axis=-1)
    unknown = np.full(found.shape, np.nan)
    return VectorField(
        grid=grid,
        displacement_voxel=displacement,
        displacement_raw_voxel=displacement,
        correlation=unknown,
        peak_ratio=unknown,
        valid_fraction=np.where(found | masked, inside, 0.0),
        flag=np.where(masked, MASKED, np.where(found, VALID, REJECTED)).astype(np.uint8),
        uncertainty_voxel=errors.reshape(nodes.shape) / volume.spacing_mm,
        voxel_mm=volume.spacing_mm,
        dt_s=settings.correlation.dt_s,
        window_voxel=size,
    )


def _share_between_walls(settings: Config, grid: Grid, window_mm: float) -> NDArray[np.float64]:
    """Return the share of each window's depth (nz, ny, nx) between the channel's walls; 1 where these mask nothing."""
    share = np.ones(grid.shape_xyz[2])
    if settings.correlation.mask == "channel":
        wall, half = 0.5 * settings.channel_width_mm(), 0.5 * window_mm
        z = grid.axis_mm(2)
        share = np.clip(np.minimum(z + half, wall) - np.maximum(z - half, -wall), 0.0, None) / window_mm
    return np.broadcast_to(share[:, np.newaxis, np.newaxis], grid.shape_zyx).copy()
