"""`field`: one velocity field fitted to tracks and vectors of a flow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Floats, root_of_squares
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.fields import pressure
from lfpiv_cli.fields.fit import SEED, Field, fit_field
from lfpiv_cli.fields.spline_field import SplineField
from lfpiv_cli.fields.stencils import Lattice
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.files import atomic, hdf5, vtkhdf
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.inputs import content_of
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRAJECTORIES_FORMAT, Points, open_tracks, read_points
from lfpiv_cli.files.provenance import OF_COORDINATES, record, with_warnings
from lfpiv_cli.flow.field import MASKED, MM_TO_M, REJECTED, VectorField
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import Divergence
from lfpiv_cli.tracks.candidates import NO_TRACK, Trajectories
from lfpiv_cli.tracks.in_time import high_derivatives_in, motions_at
from lfpiv_cli.verbs import fields
from lfpiv_cli.verbs.tracks import seen_in, settings_of, windows_of

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
    settings.fluid_density_kg_m3(), settings.fluid_viscosity_pa_s()  # before any work
    number = len(particles) // 2 if frame is None else frame
    if not 0 <= number < len(particles):
        raise UsageError(f"frame {number} is none of {len(particles)}, which are counted from 0")
    dt_s = float(trajectories.attributes["dt_s"])
    seen = [seen_in(each) for each in particles]
    found = trajectories_from(trajectories, [len(each) for each in seen])
    derivatives = high_derivatives_in(found, seen)
    if derivatives is None:
        raise InputError(f"{len(particles)} frames: too few tracks pass five of them, which accelerations need")
    tracks, motion = motions_at(found, seen, number, derivatives)
    sure = link_probability(trajectories)[tracks]
    # The covariances (n, 3, 3) of the tracks' velocities in the frame, mm^2 per frame^2, as the file states.
    here = np.flatnonzero(trajectories.arrays["frame"] == number)
    row = here[np.searchsorted(trajectories.arrays["track"][here], tracks)]
    sigma = trajectories.arrays["velocity_sigma"][row] * dt_s / MM_TO_M
    moving = Samples(motion.position_mm, motion.velocity, sigma[:, :, np.newaxis] ** 2 * np.eye(3), sure)
    low, high = motion.position_mm.min(axis=0), motion.position_mm.max(axis=0)
    flow = fit_field(moving, low, high)
    # How much of the accelerations is wrong alike among neighbours.
    neglected = root_of_squares(motion.neglected) / root_of_squares(motion.acceleration)
    accelerated = motion.position_mm, motion.acceleration, motion.covariance, sure
    samples, reported = _gradients(flow, *accelerated, settings, dt_s)
    figures = {"frame": number, "tracks": len(tracks), **reported, "neglected_share": neglected}
    return _on_windows(samples, settings, pressure.knots_for(samples.points_mm), neglected, figures)


def pressure_of_steady_flow(field: Field, dt_s: float, settings: Config) -> PressureResult:
    """Return the pressure of a steady flow by its velocities alone, which need be of one pair only.

    Raises
    ------
    ConfigError
        Density or viscosity are missing.
    UsageError
        The field is not of splines, whose gradients alone have known errors.
    """
    settings.fluid_density_kg_m3(), settings.fluid_viscosity_pa_s()  # before any work
    if not isinstance(field, SplineField):
        raise UsageError("the pressure of a steady flow needs a field of splines")
    samples, figures = _gradients(field, *pressure.steady_accelerations(field), None, settings, dt_s)
    return _on_windows(samples, settings, max(field.lattice.cell_mm), 0.0, figures)


def _gradients(
    flow: Field,
    points_mm: Floats,
    acceleration: Floats,
    covariance: Floats,
    sure: Floats | None,
    settings: Config,
    dt_s: float,
) -> tuple[Samples, dict[str, Any]]:
    """Return the gradients of the pressure at points of a flow, by accelerations in mm per frame^2; and figures."""
    density, viscosity = settings.fluid_density_kg_m3(), settings.fluid_viscosity_pa_s()
    # mm^2/s times s per frame times mm per frame per mm^2
    friction = viscosity / density * MM2_PER_M2 * dt_s * pressure.laplacian_at(flow, points_mm)
    to_m_s2 = MM_TO_M / dt_s**2
    samples = pressure.pressure_gradients(
        points_mm, to_m_s2 * (acceleration - friction), to_m_s2**2 * covariance, density, sure
    )
    return samples, {
        "acceleration_rms_m_s2": (to_m_s2 * np.sqrt(np.mean(acceleration**2, axis=0))).tolist(),
        "friction_share": root_of_squares(friction) / root_of_squares(acceleration),
    }


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


def _on_windows(
    samples: Samples, settings: Config, knot_mm: float, wrong_share: float, figures: dict[str, Any]
) -> PressureResult:
    """Fit the pressure and return it at the centres of the windows."""
    grid = windows_of(settings, None).centres
    nodes = grid.centres_mm()
    everywhere = np.concatenate([samples.points_mm, nodes.reshape(-1, 3)])
    lattice = Lattice.affordable(everywhere.min(axis=0), everywhere.max(axis=0), knot_mm)
    field = pressure.pressure_field(samples, lattice, np.random.default_rng(SEED), wrong_share)
    found = field.value_at(nodes.reshape(-1, 3)).reshape(grid.shape_zyx)
    sigma = np.sqrt(field.variance_at(nodes.reshape(-1, 3))).reshape(grid.shape_zyx)
    reported = {
        "pressure_rms_pa": float(np.std(found)),
        "pressure_sigma_median_pa": float(np.median(sigma)),
        "pressure_knots_mm": list(lattice.cell_mm),
        "pressure_reduced_chi2": field.reduced_chi2,
        "pressure_belonging": float(np.sum(field.probability)),
    }
    return PressureResult(grid, found, sigma, figures | reported)


@dataclass(frozen=True, kw_only=True)
class FieldOptions:
    """What `field` is given besides its files.

    Attributes
    ----------
    dt_s : time from one frame to the next, in place of the config's
    divergence : what is known of it
    frame : of a sequence of tracks, counted from 0; the middle one where None
    pressure : files of the particles of a sequence, by which its pressure is found, too
    derived : vorticity, divergence, strain rate, Q criterion and gradients, too
    at : file with points in mm where velocities are asked for, too, beside the output
    """

    dt_s: float | None = None
    divergence: Divergence = "penalised"
    frame: int | None = None
    pressure: Sequence[Path] = ()
    derived: bool = False
    at: Path | None = None


def fit_flow(
    paths: Sequence[Path],
    output: Path,
    options: FieldOptions = FieldOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Fit a field to files of tracks of pairs and of vectors, and write it on the grid of the correlation windows."""
    places = output.with_name(f"{output.stem}_at.csv")
    atomic.ensure_writable(output, overwrite, paths)
    if options.at is not None:
        atomic.ensure_writable(places, overwrite, [*paths, options.at])
    points = None if options.at is None else read_places(options.at)
    headers, names = [vtkhdf.read_header(path) for path in paths], [str(path) for path in paths]
    for header, name in zip(headers, names, strict=True):
        if header.reference != headers[0].reference:
            raise InputError(f"{name}: its coordinates have another origin than those of {names[0]}")
    fields.ensure_one_time(header.attributes.get("dt_s") for header in headers)
    settings = settings_of([header.provenance for header in headers], names, options.dt_s, OF_COORDINATES)
    pressed = _pressure(paths, settings, options)
    parts = [
        fields.samples_of_vectors(vtkhdf.open_vectors(path), str(path))
        if hdf5.format_of(path) == vtkhdf.VECTORS_FORMAT
        else fields.samples_of_tracks(open_tracks(path), options.frame)
        for path in paths
    ]
    found = fields.fitted(parts, settings, options.divergence, names[0])
    notices = fields.fit_notices(found.summary, options.divergence, paths[0].name)
    console.warn(notices)
    inputs = {f"samples_{number:04d}": path for number, path in enumerate(paths)}
    inputs |= {f"particles_{number:04d}": path for number, path in enumerate(options.pressure)}
    chosen = {"divergence": options.divergence, "frame": options.frame, "derived": options.derived}
    made = with_warnings(record("field", settings.resolved() | {"field": chosen}, inputs), notices)
    vectors = found.vectors()
    extra: fields.Extra = {}
    if options.derived:
        # What follows from the field's gradients, and these, row by row.
        gradients = found.gradients()
        flat = gradients.reshape(*gradients.shape[:3], 9)
        extra = fields.arrays_of(found.derived())
        extra |= {f"gradient_{name}": (flat[..., 3 * row : 3 * row + 3], "1/s") for row, name in enumerate("uvw")}
    if pressed is not None:
        extra |= {"pressure": (pressed.pressure_pa, "Pa"), "pressure_sigma": (pressed.pressure_sigma_pa, "Pa")}
    vtkhdf.write_vectors(output, vectors, headers[0].reference, provenance=made, overwrite=overwrite, extra=extra)
    if points is not None:
        atomic.write_text(places, _table(points, found), overwrite)
    figures = {} if pressed is None else pressed.figures
    if options.derived:
        density, viscosity = settings.media.fluid_density_kg_m3, settings.media.fluid_viscosity_pa_s
        kinematic = None if density is None or viscosity is None else viscosity / density
        figures = figures | found.turbulence(kinematic)
    return found.summary | figures | _counts(vectors)


def _pressure(paths: Sequence[Path], settings: Config, options: FieldOptions) -> PressureResult | None:
    """Return the pressure of a sequence, if it is asked for."""
    if not options.pressure:
        return None
    if len(paths) != 1 or hdf5.format_of(paths[0]) != TRAJECTORIES_FORMAT:
        raise UsageError("--pressure is for the tracks of one sequence, from follow or track")
    particles = [read_points(path, PARTICLES_FORMAT) for path in options.pressure]
    try:
        return pressure_of(open_tracks(paths[0]), particles, settings, options.frame)
    except InputError as error:
        raise InputError(f"{paths[0]} with {options.pressure[0].parent}: {error}") from error


def _counts(vectors: VectorField) -> dict[str, Any]:
    """Return how many vectors there are, and how well they are known."""
    kept, sigma = vectors.flag < REJECTED, vectors.uncertainty_voxel
    known = sigma is not None and kept.any()
    return {
        "vectors": vectors.flag.size,
        "rejected": int(np.count_nonzero(vectors.flag == REJECTED)),
        "masked": int(np.count_nonzero(vectors.flag == MASKED)),
        "uncertainty_voxel_median": np.median(sigma[kept], axis=0).tolist() if known and sigma is not None else None,
    }


def read_places(path: Path) -> Floats:
    """Read points (n, 3), mm: x, y, z in a line, by commas; lines that begin with a letter or # are passed over.

    Raises
    ------
    InputError
    """
    rows = []
    for number, line in enumerate(content_of(path).decode("utf-8", errors="replace").splitlines(), start=1):
        if not line.strip() or line.lstrip()[0] in '#"' or line.lstrip()[0].isalpha():
            continue
        try:
            row = [float(word) for word in line.split(",")]
        except ValueError:
            row = []
        if len(row) != 3 or not np.all(np.isfinite(row)):
            raise InputError(f"{path}: line {number}: {line[:40]!r}, expected x, y, z in mm by commas")
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: holds no points; expected x, y, z in mm, one point a line")
    return np.array(rows)


def _table(points: Floats, found: fields.FittedField) -> str:
    """Return velocities and standard deviations at points as text."""
    rows = np.concatenate([points, found.at(points), found.sigma(points)], axis=1)
    lines = [",".join(repr(float(value)) for value in row) for row in rows]
    return "\n".join(["x_mm,y_mm,z_mm,u_m_s,v_m_s,w_m_s,u_sigma_m_s,v_sigma_m_s,w_sigma_m_s", *lines, ""])
