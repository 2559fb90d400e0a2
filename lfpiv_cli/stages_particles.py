"""The stages of particles: their part of `reconstruct`, and `track`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, Points, read_points, symmetric, write_points
from lfpiv_cli.files.provenance import record
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, VALID, VectorField
from lfpiv_cli.flow.windows import layout_windows
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.particles.gridding import on_grid
from lfpiv_cli.particles.refraction import places_by_snell
from lfpiv_cli.particles.rounds import ROUNDS, find_particles
from lfpiv_cli.particles.tracking import Tracks, track
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.equations import Normalisers

# A vector needs its twelve nearest tracks within this many windows of its centre.
REACH_WINDOWS = 1.0
# Displacements are sought up to this many voxels along each axis unless told otherwise.
SEARCH_VOXEL = 6.0

# Units of progress that `write_frame` reports.
STEPS = sum(settings.iterations + 1 for settings in ROUNDS)


def ensure_solvable(content: WeightsFile, settings: Config) -> None:
    """Refuse weights of a kind that particles cannot follow.

    Raises
    ------
    ConfigError
    """
    if settings.weights.method == "dlfc":
        raise ConfigError("weights.method: particles are fitted with traced rays; build weights by ert for them")
    raw_view(content.camera, settings.media_model(), 0.0, content.weights.calibration)


@dataclass(frozen=True, eq=False)
class Frame:
    """An image and what of it takes part.

    Attributes
    ----------
    image : (rows, columns) raw but for dark and background
    unusable : (rows, columns) pixels that are not believed
    sums : of the padded weights without what these touch
    """

    image: NDArray[np.float32]
    unusable: NDArray[np.bool_]
    sums: Normalisers


def residual_path(particles: Path) -> Path:
    """Return where the residual image of a file of particles goes."""
    return particles.with_name(f"{particles.stem}_residual.tif")


def write_frame(
    content: WeightsFile,
    settings: Config,
    frame: Frame,
    path: Path,
    provenance: Mapping[str, Any],
    overwrite: bool,
    progress: Callable[[int], None],
) -> float:
    """Find the particles behind an image and write them and what they leave of it; return the relative residual."""
    radius = 0.5 * settings.reconstruction.particle_diameter_mm
    view = raw_view(content.camera, settings.media_model(), radius, content.weights.calibration)
    found = find_particles(
        frame.image,
        view,
        content.weights,
        content.camera,
        frame.sums,
        progress=progress,
        excluded=frame.unusable,
    )
    space = _space(content, settings)
    places = places_by_snell(found.position_mm, space, content.camera)
    left = np.where(frame.unusable, 0.0, found.residual)
    norm = float(np.linalg.norm(np.where(frame.unusable, 0.0, frame.image)))
    residual = float(np.linalg.norm(left)) / norm if norm > 0.0 else 0.0
    # Made again whenever the particles are: an interrupted batch may have left one without them.
    write_tiff(residual_path(path), left.astype(np.float32), overwrite=True)
    write_points(
        path,
        PARTICLES_FORMAT,
        places - np.array([0.0, 0.0, content.reference_z_mm]),
        {
            "intensity": found.light_counts,
            "covariance_mm2": symmetric(found.covariance_mm2),
            "chi2": found.chi2,
            "seen": found.seen,
            "flag": _outside(places, content.weights.grid),
        },
        provenance=provenance,
        attributes={
            "reference": content.reference,
            "reference_z_mm": content.reference_z_mm,
            "refraction": "paraxial" if space.straight else "exact",
            "residual": residual,
            "residual_rms_counts": float(np.sqrt(np.mean(left[~frame.unusable] ** 2))),
            "excluded_pixels": int(np.count_nonzero(frame.unusable)),
            "read_noise_counts": found.noise.read_counts,
        },
        overwrite=overwrite,
    )
    return residual


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


def _space(content: WeightsFile, settings: Config) -> ObjectSpace:
    """Return what lies before the particles: by Snell's law where the window's thickness and place are known."""
    calibration = content.weights.calibration
    mid_plane = calibration.mid_plane_z_mm if calibration else None
    if (settings.channel is None or mid_plane is None) and settings.sections.window is None:
        return ObjectSpace(settings.media_model(), None, "paraxial")
    return ObjectSpace(settings.media_model(), settings.window_model(mid_plane), "exact")


def _outside(position_mm: NDArray[np.float64], grid: Grid) -> NDArray[np.uint8]:
    """Return 1 for particles outside the volume, kept because they light it, 0 for those inside."""
    bounds = np.array([grid.bounds_mm(axis) for axis in range(3)])
    inside = np.all((position_mm >= bounds[:, 0]) & (position_mm <= bounds[:, 1]), axis=1)
    return (~inside).astype(np.uint8)


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
