"""Pressure from a sequence's trajectories, in memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.fields import pressure
from lfpiv_cli.fields.acceleration import Motion, bends_in, motions_at
from lfpiv_cli.fields.fit import SEED, Field, fit_field
from lfpiv_cli.fields.samples import Samples
from lfpiv_cli.fields.spline_field import SplineField
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.particle_file import Points
from lfpiv_cli.flow.field import MM_TO_M
from lfpiv_cli.flow.from_tracks import WindowGrid
from lfpiv_cli.grid import Grid
from lfpiv_cli.interface.tracks import seen_in
from lfpiv_cli.tracks.trajectories import NO_TRACK, Trajectories

Floats = NDArray[np.float64]
MM2_PER_M2 = 1e6


@dataclass(frozen=True, eq=False)
class PressureResult:
    """The pressure at the centres of the interrogation windows.

    Attributes
    ----------
    grid : of the centres
    pressure_pa, pressure_sigma_pa : (nz, ny, nx), less its mean over the box, and its standard error
    figures : how it was found, units in their names
    """

    grid: Grid
    pressure_pa: Floats
    pressure_sigma_pa: Floats
    figures: dict[str, Any]


def pressure_of(
    trajectories: Points, particles: Sequence[Points], settings: Config, frame: int | None = None
) -> PressureResult:
    """Return the pressure in a frame of a sequence, by the accelerations of its tracks.

    Parameters
    ----------
    trajectories : as `track` gives them of a sequence
    particles : of all its frames, in their order
    settings : with `media.fluid_density_kg_m3` and `media.fluid_viscosity_pa_s`
    frame : counted from 0; that in the middle when not given

    Raises
    ------
    ConfigError
        Density or viscosity are missing.
    UsageError
        There is no such frame.
    InputError
        The particles are not those of the trajectories, or too few tracks pass five frames.
    """
    density, viscosity = settings.fluid_density_kg_m3(), settings.fluid_viscosity_pa_s()
    number = len(particles) // 2 if frame is None else frame
    if not 0 <= number < len(particles):
        raise UsageError(f"frame {number} is none of {len(particles)}, which are counted from 0")
    dt_s = float(trajectories.attributes["dt_s"])
    seen = [seen_in(each) for each in particles]
    found = trajectories_from(trajectories, [len(each) for each in seen])
    bends = bends_in(found, seen)
    if bends is None:
        raise InputError(f"{len(particles)} frames: too few tracks pass five of them, which accelerations need")
    tracks, motion = motions_at(found, seen, number, bends)
    sure = link_probability(trajectories)[tracks]
    moving = Samples(
        motion.position_mm, motion.velocity, _velocity_covariance(trajectories, number, tracks, dt_s), sure
    )
    low, high = motion.position_mm.min(axis=0), motion.position_mm.max(axis=0)
    # mm^2/s times s per frame times mm per frame per mm^2
    friction = viscosity / density * MM2_PER_M2 * dt_s * pressure.laplacian_at(
        fit_field(moving, low, high), motion.position_mm
    )  # fmt: skip
    to_m_s2 = MM_TO_M / dt_s**2
    samples = pressure.pressure_gradients(
        motion.position_mm, to_m_s2 * (motion.acceleration - friction), to_m_s2**2 * motion.covariance, density, sure
    )
    figures = {
        "frame": number,
        "tracks": len(tracks),
        "acceleration_rms_m_s2": (to_m_s2 * _rms(motion.acceleration)).tolist(),
        "friction_share": float(np.linalg.norm(friction) / np.linalg.norm(motion.acceleration)),
        "neglected_share": neglected_share(motion),
    }
    return _on_windows(samples, settings, pressure.knots_for(samples.points_mm), neglected_share(motion), figures)


def pressure_of_steady_flow(field: Field, dt_s: float, settings: Config) -> PressureResult:
    """Return the pressure of a steady flow by its velocities alone, which need be of one pair only.

    Raises
    ------
    ConfigError
        Density or viscosity are missing.
    UsageError
        The field is not of splines, whose gradients alone have known errors.
    """
    density, viscosity = settings.fluid_density_kg_m3(), settings.fluid_viscosity_pa_s()
    if not isinstance(field, SplineField):
        raise UsageError("the pressure of a steady flow needs a field of splines")
    points, acceleration, covariance = pressure.steady_accelerations(field)
    friction = viscosity / density * MM2_PER_M2 * dt_s * pressure.laplacian_at(field, points)
    to_m_s2 = MM_TO_M / dt_s**2
    samples = pressure.pressure_gradients(points, to_m_s2 * (acceleration - friction), to_m_s2**2 * covariance, density)
    figures = {
        "acceleration_rms_m_s2": (to_m_s2 * _rms(acceleration)).tolist(),
        "friction_share": float(np.linalg.norm(friction) / np.linalg.norm(acceleration)),
    }
    return _on_windows(samples, settings, max(field.lattice.cell_mm), 0.0, figures)


def trajectories_from(points: Points, counts: Sequence[int]) -> Trajectories:
    """Return which particles belong together, by the rows of trajectories and the numbers of particles in the frames.

    Raises
    ------
    InputError
        They are not of the same frames.
    """
    arrays = points.arrays
    frame, particle, track = (arrays[name].astype(np.int64) for name in ("frame", "particle", "track"))
    of_frame = np.asarray(counts)
    if len(frame) and (frame.max() >= len(counts) or np.any(particle >= of_frame[np.minimum(frame, len(counts) - 1)])):
        raise InputError(f"the trajectories are not of these {len(counts)} frames' particles")
    labels = [np.full(count, NO_TRACK) for count in counts]
    probability = [np.full(count, np.nan) for count in counts]
    for number in range(len(counts)):
        here = frame == number
        labels[number][particle[here]] = track[here]
        probability[number][particle[here]] = arrays["link_probability"][here]
    return Trajectories(tuple(labels), int(track.max(initial=-1)) + 1, tuple(probability))


def link_probability(trajectories: Points) -> Floats:
    """Return the probability (tracks,) that all links of a track are right."""
    track = trajectories.arrays["track"].astype(np.int64)
    found = np.ones(int(track.max(initial=-1)) + 1)
    np.multiply.at(found, track, np.nan_to_num(trajectories.arrays["link_probability"], nan=1.0))
    return found


def neglected_share(motion: Motion) -> float:
    """Return how much of the accelerations is wrong alike among neighbours."""
    return float(np.linalg.norm(motion.neglected) / np.linalg.norm(motion.acceleration))


def _velocity_covariance(points: Points, number: int, tracks: NDArray[np.int64], dt_s: float) -> Floats:
    """Return the covariances (n, 3, 3) of the tracks' velocities in a frame, mm^2 per frame^2, as the file states."""
    here = np.flatnonzero(points.arrays["frame"] == number)
    row = here[np.searchsorted(points.arrays["track"][here], tracks)]
    sigma = points.arrays["velocity_sigma"][row] * dt_s / MM_TO_M
    return np.asarray(sigma[:, :, np.newaxis] ** 2 * np.eye(3))


def _rms(vectors: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(vectors**2, axis=0)))


def _on_windows(
    samples: Samples, settings: Config, knot_mm: float, wrong_share: float, figures: dict[str, Any]
) -> PressureResult:
    """Fit the pressure and return it at the centres of the windows."""
    volume = settings.grid()
    windows = settings.windows_voxel(volume.spacing_mm)[-1]
    grid = WindowGrid(volume, windows, settings.overlap(volume.spacing_mm)).centres
    nodes = grid.centres_mm()
    everywhere = np.concatenate([samples.points_mm, nodes.reshape(-1, 3)])
    lattice = pressure.lattice_over(everywhere.min(axis=0), everywhere.max(axis=0), knot_mm)
    field = pressure.pressure_field(samples, lattice, np.random.default_rng(SEED), wrong_share)
    found = field.value_at(nodes.reshape(-1, 3)).reshape(grid.shape_zyx)
    sigma = np.sqrt(field.variance_at(nodes.reshape(-1, 3))).reshape(grid.shape_zyx)
    told = {
        "pressure_rms_pa": float(np.std(found)),
        "pressure_sigma_median_pa": float(np.median(sigma)),
        "pressure_knots_mm": list(lattice.cell_mm),
        "pressure_reduced_chi2": field.reduced_chi2,
        "pressure_belonging": float(np.sum(field.probability)),
    }
    return PressureResult(grid, found, sigma, figures | told)
