"""Velocity fields fitted to tracks and vectors in memory, and what follows from one."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.fields import fit
from lfpiv_cli.fields.spline_field import SplineField, gradient_covariance_at
from lfpiv_cli.fields.structure import Samples, joined
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.particle_file import Points, matrices
from lfpiv_cli.files.provenance import record
from lfpiv_cli.flow import field as vector_field
from lfpiv_cli.flow.combining import WindowGrid, without_tracks
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, Derived, VectorField, derived_from
from lfpiv_cli.flow.windows import ParallelWalls
from lfpiv_cli.grid import FOCAL_POINT, Reference
from lfpiv_cli.names import Divergence
from lfpiv_cli.notice import Notice
from lfpiv_cli.results import ArrayResult
from lfpiv_cli.verbs.tracks import Tracked, TracksOf, windows_of

# Fewer samples do not tell a field of three components that varies along three axes.
FEWEST_SAMPLES = 20
# Points on walls are so far apart, as a share of the final windows: finer than the field's knots.
WALL_STEP = 0.5
# Fields of solenoidal flows were found with less than .04, also from 500 tracks of vortices; that of a source with 3.
LARGEST_DIVERGENCE = 0.15
# Of true fields the stated errors of tracks left .3 to 1.6.
LARGEST_CHI2 = 2.0
# Tracking leaves a few wrong links of a hundred.
LEAST_BELONGING = 0.85


@dataclass(frozen=True, eq=False, repr=False)
class FittedField(ArrayResult):
    """A velocity field that is known at any point.

    Attributes
    ----------
    field : the fit, displacements from one frame to the next
    windows : on whose centres vectors are asked for
    middles_mm : (n, 3) places of the samples
    dt_s : time from one frame to the next
    summary : counts and figures, units in their names
    reference : the origin of its coordinates
    provenance : the record of how it was made
    """

    field: fit.Field
    windows: WindowGrid
    middles_mm: Floats
    dt_s: float
    summary: dict[str, Any]
    reference: Reference = FOCAL_POINT
    provenance: dict[str, Any] = dataclasses.field(default_factory=dict)

    def at(self, points_mm: Floats) -> Floats:
        """Return velocities (m, 3) at points, m/s."""
        return self.field.value_at(points_mm) * (MM_TO_M / self.dt_s)

    def sigma(self, points_mm: Floats) -> Floats:
        """Return the velocities' standard deviations (m, 3), m/s."""
        return np.asarray(np.sqrt(self.field.variance_at(points_mm)) * (MM_TO_M / self.dt_s))

    def gradient(self, points_mm: Floats) -> Floats:
        """Return the velocities' gradients (m, 3, 3), 1/s: the component, then the direction."""
        return self.field.gradient_at(points_mm) / self.dt_s

    def derived(self) -> Derived:
        """Return what follows from the field's own gradients at the windows' centres."""
        return derived_from(self.gradients())

    def gradients(self) -> Floats:
        """Return the gradients (nz, ny, nx, 3, 3) at the windows' centres, 1/s; NaN where there is no vector."""
        grid = self.windows.centres
        gradient = self.gradient(grid.centres_mm().reshape(-1, 3)).reshape(*grid.shape_zyx, 3, 3)
        gradient[self.without()] = np.nan
        return gradient

    def turbulence(self, viscosity_m2_s: float | None = None) -> dict[str, Any]:
        """Return figures of the fluctuations about the mean velocity of the volume; NaN vectors are left out.

        The spectrum is known where all vectors are; the dissipation by splines alone and with a viscosity. What is
        smaller than the field resolves is in none of them.
        """
        vectors = self.vectors()
        known = vectors.flag < REJECTED
        if not known.any() or vectors.uncertainty_voxel is None:
            return {}
        about = vector_field.fluctuations(vectors.velocity, (0, 1, 2))
        sigma = vectors.uncertainty_voxel * np.asarray(vectors.voxel_mm) * (MM_TO_M / self.dt_s)
        stresses = vector_field.reynolds_stresses(about, sigma**2)
        reported = {
            "reynolds_stresses_m2_s2": stresses.tolist(),
            "kinetic_energy_m2_s2": vector_field.kinetic_energy(stresses),
        }
        if known.all() and min(known.shape) >= vector_field.FEWEST_PLANES:
            found = vector_field.spectrum(about, self.windows.centres.spacing_mm)
            reported |= {
                "spectrum_wavenumber_rad_m": found.wavenumber.tolist(),
                "spectrum_energy_m3_s2": found.energy.tolist(),
            }
        if viscosity_m2_s is not None and isinstance(self.field, SplineField):
            nodes = self.windows.centres.centres_mm()[known]
            covariance = gradient_covariance_at(self.field, nodes) / self.dt_s**2
            # as many parts of the volume as the splines have knots in it are independent
            rate, error = vector_field.dissipation(
                self.gradient(nodes), covariance, viscosity_m2_s, float(np.prod(self.field.lattice.cells))
            )
            reported |= {"dissipation_m2_s3": rate, "dissipation_m2_s3_sigma": error}
        return reported

    def without(self) -> Flags:
        """Return at which windows' centres (nz, ny, nx) there is no vector: none near, or beyond walls."""
        nodes, masked = self.windows.centres.centres_mm().reshape(-1, 3), self.windows.masked()
        return np.asarray(masked | without_tracks(self.middles_mm, nodes, self.windows).reshape(masked.shape))

    def vectors(self) -> VectorField:
        """Return the vectors at the windows' centres; none where no sample is near, and none beyond walls."""
        value, variance = self.field.estimate_at(self.windows.centres.centres_mm().reshape(-1, 3))
        value[self.without().reshape(-1)] = np.nan
        found = self.windows.vectors(value, np.sqrt(variance), self.dt_s)
        return replace(found, reference=self.reference, provenance=self.provenance)


def fit_field(
    *given: Tracked | VectorField, rig: Config | None = None, divergence: Divergence = "penalised"
) -> FittedField:
    """Fit one velocity field to tracks and vectors of the same flow.

    Parameters
    ----------
    *given : Tracked or VectorField
        Tracks of pairs, from `track`, and fields, from `correlate` or `open_vectors`.
    rig : Config, optional
        With the grid of windows; that of the tracks when not given.
    divergence : str, optional
        "penalised": held down as far as the data ask for; "free": there is none; "off": nothing is known of it.

    Returns
    -------
    FittedField
        `vectors()` on the grid of the interrogation windows; `at(points_mm)`, `sigma(points_mm)` and
        `gradient(points_mm)` anywhere.

    Raises
    ------
    InputError
        There are too few samples, the time between frames is not known, or they do not belong together.
    """
    settings = rig or next((each.settings for each in given if isinstance(each, Tracked)), None)
    if settings is None:
        raise InputError("vectors alone do not tell the grid: give the rig")
    times = (each.settings.correlation.dt_s if isinstance(each, Tracked) else each.dt_s for each in given)
    ensure_one_time([*times, settings.correlation.dt_s])
    references = {each.points.reference if isinstance(each, Tracked) else each.reference for each in given}
    if len(references) > 1:
        raise InputError("the coordinates of what is given have different origins")
    parts = [
        samples_of_tracks(each.points) if isinstance(each, Tracked) else samples_of_vectors(each, "vectors")
        for each in given
    ]
    made = record("field", settings.resolved() | {"field": {"divergence": divergence}}, {})
    return replace(fitted(parts, settings, divergence, "field"), reference=references.pop(), provenance=made)


def ensure_one_time(times_s: Iterable[float | None]) -> None:
    """Raise InputError where times between frames differ, as far as they are known: displacements in them do, too."""
    known = sorted({time for time in times_s if time is not None})
    if len(known) > 1:
        raise InputError(f"the times between frames differ: {' and '.join(f'{time:g}' for time in known)} s")


def fields_of(found: TracksOf[Any], name: str) -> Iterator[FittedField]:
    """Yield the field of each interval between frames, fitted to the tracks that pass it; `name` is the first frame's.

    Raises
    ------
    InputError
        Too few tracks pass it.
    """
    if isinstance(found.points, Points) and "displacement_mm" in found.points.arrays:
        yield fitted([samples_of_tracks(found.points)], found.settings, "penalised", name)
        return
    for path in found.paths():
        covariance = path.sigma_mm[:, :, np.newaxis] ** 2 * np.eye(3)
        sure = np.ones(len(path.middle_mm))
        samples = Samples(path.middle_mm, path.displacement_mm, covariance, sure, place_share=0.0)
        yield fitted([samples], found.settings, "penalised", name)


def samples_of_tracks(points: Points, frame: int | None = None) -> Samples:
    """Return tracks as samples; without full covariances, by standard errors.

    Those of a pair count at their middles, those of a sequence where they are in a frame, in the middle one when none
    is given.

    Raises
    ------
    UsageError
        There is no such frame.
    """
    arrays = points.arrays
    if "frame" in arrays:
        last = int(arrays["frame"].max(initial=-1))
        number = (last + 1) // 2 if frame is None else frame
        if not 0 <= number <= max(last, 0):
            raise UsageError(f"frame {number} is none of {last + 1}, which are counted from 0")
        # Places and velocities of fits in time.
        here, to_mm = arrays["frame"] == number, float(points.attributes["dt_s"]) / MM_TO_M
        sigma_mm = to_mm * arrays["velocity_sigma"][here]
        covariance = sigma_mm[:, :, np.newaxis] ** 2 * np.eye(3)
        probability = np.nan_to_num(arrays["link_probability"][here], nan=1.0)
        value_mm = to_mm * arrays["velocity"][here]
        return Samples(points.position_mm[here], value_mm, covariance, probability, place_share=0.0)
    if frame is not None:
        raise UsageError("a frame is of a sequence, and these are tracks of a pair")
    displacement = arrays["displacement_mm"]
    if "displacement_covariance_mm2" in arrays:
        covariance = matrices(arrays["displacement_covariance_mm2"])
    else:
        sigma_mm = arrays["velocity_sigma"] * float(points.attributes["dt_s"]) / MM_TO_M
        covariance = sigma_mm[:, :, np.newaxis] ** 2 * np.eye(3)
    probability = np.nan_to_num(arrays["link_probability"], nan=1.0)
    return Samples(points.position_mm, displacement, covariance, probability)


def samples_of_vectors(field: VectorField, name: str) -> Samples:
    """Return the vectors that are valid as samples at their windows' centres.

    Windows that overlap share tracers, so that their errors are alike: variances are enlarged by as many windows as
    share the tracers of one, along each axis a window's length over its distance from the next.

    Raises
    ------
    InputError
        Their uncertainty is not known.
    """
    if field.uncertainty_voxel is None:
        raise InputError(
            f"{name}: has no uncertainty_voxel, which weighs its vectors; make it by correlate or track --grid"
        )
    known = (field.flag < REJECTED) & np.isfinite(field.uncertainty_voxel).all(axis=-1)
    voxel = np.asarray(field.voxel_mm)
    shared = float(np.prod(voxel * field.window_voxel / field.grid.spacing_mm))
    variance = shared * (field.uncertainty_voxel[known] * voxel) ** 2
    points, covariance = field.grid.centres_mm()[known], variance[:, :, np.newaxis] * np.eye(3)
    return Samples(points, field.displacement_voxel[known] * voxel, covariance, np.ones(len(points)), 0.0)


def fitted(parts: Sequence[Samples], settings: Config, divergence: Divergence, name: str) -> FittedField:
    """Fit a field to samples from one or several sources.

    Raises
    ------
    InputError
        There are too few samples, or the time between frames is not known.
    """
    samples = joined(parts)
    dt_s = settings.correlation.dt_s
    if dt_s is None:
        raise InputError(f"{name}: its config has no correlation.dt_s; give --dt-s")
    if len(samples) < FEWEST_SAMPLES:
        raise InputError(f"{name}: {len(samples)} samples, expected at least {FEWEST_SAMPLES}")
    still = settings.still_walls()
    windows = windows_of(settings, still or settings.masking_walls())
    low, high = np.array([windows.volume.bounds_mm(axis) for axis in range(3)]).T
    if isinstance(still, ParallelWalls) and settings.volume.reference != "mid_plane":
        raise InputError(f"{name}: channel.no_slip needs volume.reference mid_plane, found {settings.volume.reference}")
    points = fit.NO_POINTS if still is None else still.points(low, high, WALL_STEP * windows.sides_mm)
    field = fit.fit_field(samples, low, high, divergence, points)
    gradient = field.gradient_at(windows.centres.centres_mm().reshape(-1, 3))
    size = float(np.sqrt(np.mean(gradient**2)))
    rms = float(np.sqrt(np.mean(np.trace(gradient, axis1=1, axis2=2) ** 2)))
    summary = {
        "samples": len(samples),
        "samples_belonging": float(np.sum(field.probability)),
        "divergence_rms_over_gradients_rms": rms / size if size else None,
    }
    return FittedField(field, windows, samples.points_mm, dt_s, summary | field.reported())


def fit_notices(summary: Mapping[str, Any], divergence: Divergence, name: str) -> list[Notice]:
    """Return what is said of a field that has sources, or that its samples contradict."""
    notices, share, chi2 = [], summary["divergence_rms_over_gradients_rms"], summary["reduced_chi2"]
    if divergence == "penalised" and share is not None and share > LARGEST_DIVERGENCE:
        text = f"the divergence's rms is {share:.2f} of the gradients': the samples ask for a flow with sources"
        remedy = "right for a compressible or two-phase flow; in a liquid look for wrong links or scaled depths"
        notices.append(
            Notice("flow-with-sources", name, text, remedy, share, f"at most {LARGEST_DIVERGENCE:g} in a liquid")
        )
    if chi2 > LARGEST_CHI2:
        bent = ", which without a divergence may mean that the flow has sources" if divergence == "free" else ""
        text = f"samples lie off the field by {chi2**0.5:.1f} times their stated errors{bent}"
        remedy = "compare --divergence free, penalised and off; look for wrong links or too small stated errors"
        notices.append(
            Notice("field-off-samples", name, text, remedy, chi2, f"a reduced chi-squared of at most {LARGEST_CHI2:g}")
        )
    belonging = summary["samples_belonging"] / summary["samples"]
    if belonging < LEAST_BELONGING:
        text = f"{1.0 - belonging:.0%} of the samples do not belong to the field and lose their weight"
        remedy = "look at where they are: wrong links, or a flow that changes within the distance of the knots"
        notices.append(Notice("samples-left-out", name, text, remedy, belonging, f"at least {LEAST_BELONGING:g}"))
    return notices


Extra = dict[str, tuple[NDArray[Any], str]]


def arrays_of(derived: Derived) -> Extra:
    """Return derived fields with the names and units that files give them."""
    return {
        "vorticity": (derived.vorticity, "1/s"),
        "divergence": (derived.divergence, "1/s"),
        "strain_rate": (derived.strain_rate, "1/s"),
        "q_criterion": (derived.q_criterion, "1/s2"),
    }
