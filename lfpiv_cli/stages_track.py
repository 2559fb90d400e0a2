"""The stage of `track`: particles followed from frame to frame, and their vectors on a grid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, Points, read_points, write_points
from lfpiv_cli.files.provenance import record
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, VALID, VectorField
from lfpiv_cli.flow.windows import layout_windows
from lfpiv_cli.grid import Grid
from lfpiv_cli.particles.gridding import on_grid
from lfpiv_cli.particles.tracking import Tracks, track

# A vector needs its twelve nearest tracks within this many windows of its centre.
REACH_WINDOWS = 1.0
# Displacements are sought up to this many voxels along each axis unless told otherwise.
SEARCH_VOXEL = 6.0


def track_particles(
    particles_a: Path,
    particles_b: Path,
    dt_s: float | None,
    search_voxel: float | None,
    grid: bool,
    output: Path,
    overwrite: bool,
    console: Console,
) -> dict[str, Any]:
    """Follow particles from one frame to the next; with `grid`, also write vectors on the windows' grid."""
    inputs = {"particles_a": particles_a, "particles_b": particles_b}
    gridded = output.with_name(f"{output.stem}_grid{output.suffix}")
    for target in (output, gridded) if grid else (output,):
        ensure_writable(target, overwrite, inputs.values())
    first, second = (read_points(path, PARTICLES_FORMAT) for path in (particles_a, particles_b))
    if first.provenance.get("config") != second.provenance.get("config"):
        raise InputError(f"{particles_b}: was made with another config than {particles_a}")
    settings = Config.from_resolved(first.provenance["config"]).overridden("correlation", dt_s=dt_s)
    if settings.correlation.dt_s is None:
        raise InputError(f"{particles_a}: its config has no correlation.dt_s; give --dt-s")
    search = SEARCH_VOXEL if search_voxel is None else search_voxel
    volume = settings.grid()
    found = track(first.position_mm, second.position_mm, search * max(volume.spacing_mm))
    provenance = record("track", settings.resolved() | {"search_voxel": search}, inputs)
    attributes = {name: first.attributes[name] for name in ("reference", "reference_z_mm")}
    middle, displacement, sigma = _paths(first, second, found)
    to_m_s = MM_TO_M / settings.correlation.dt_s
    write_points(
        output,
        TRACKS_FORMAT,
        middle,
        {
            "velocity": displacement * to_m_s,
            "velocity_sigma": sigma * to_m_s,
            "displacement_mm": displacement,
            "particle_a": found.first,
            "particle_b": found.second,
        },
        provenance=provenance,
        attributes=attributes | {"dt_s": settings.correlation.dt_s},
        overwrite=overwrite,
    )
    summary: dict[str, Any] = {
        "particles_a": len(first.position_mm),
        "particles_b": len(second.position_mm),
        "tracks": len(found.first),
    }
    if grid:
        field = _vectors(settings, volume, middle, displacement, sigma)
        vtkhdf.write_vectors(gridded, field, provenance=provenance, attributes=attributes, overwrite=overwrite)
        summary |= {"vectors": field.flag.size, "rejected": int(np.count_nonzero(field.flag >= REJECTED))}
    return summary


def _paths(
    first: Points, second: Points, tracks: Tracks
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the middles of the tracks, their displacements and standard errors, (n, 3) in mm."""
    start, end = first.position_mm[tracks.first], second.position_mm[tracks.second]
    variance = first.arrays["covariance_mm2"][tracks.first, :3] + second.arrays["covariance_mm2"][tracks.second, :3]
    return 0.5 * (start + end), end - start, np.sqrt(variance)


def _vectors(
    settings: Config,
    volume: Grid,
    middle_mm: NDArray[np.float64],
    displacement_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
) -> VectorField:
    """Return the vectors at the centres of the correlation windows."""
    size = settings.windows_voxel(volume.spacing_mm)[-1]
    grid = layout_windows(volume.shape_xyz, size, settings.overlap(volume.spacing_mm)).grid(volume)
    z, y, x = np.meshgrid(*(grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    nodes = np.stack([x, y, z], axis=-1)
    reach = REACH_WINDOWS * max(n * d for n, d in zip(size, volume.spacing_mm, strict=True))
    values, errors = on_grid(middle_mm, displacement_mm, sigma_mm, nodes.reshape(-1, 3), reach)
    displacement = values.reshape(nodes.shape) / volume.spacing_mm
    found = np.isfinite(displacement).all(axis=-1)
    unknown = np.full(found.shape, np.nan)
    return VectorField(
        grid=grid,
        displacement_voxel=displacement,
        displacement_raw_voxel=displacement,
        correlation=unknown,
        peak_ratio=unknown,
        valid_fraction=np.where(found, 1.0, 0.0),
        flag=np.where(found, VALID, REJECTED).astype(np.uint8),
        uncertainty_voxel=errors.reshape(nodes.shape) / volume.spacing_mm,
        voxel_mm=volume.spacing_mm,
        dt_s=settings.correlation.dt_s,
        window_voxel=size,
    )
