"""Statistics of a flow over many pairs in memory: of fields on one grid, or of tracks in bins."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.console import readable
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.files.atomic import without_nan
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.particle_file import Points, symmetric
from lfpiv_cli.files.provenance import record
from lfpiv_cli.flow import statistics as flow_statistics
from lfpiv_cli.flow.correlation import SMALLEST_VALID_FRACTION
from lfpiv_cli.flow.field import MASKED, MM_TO_M, REJECTED, SECOND_PEAK, VALID, VectorField
from lfpiv_cli.flow.statistics import ENERGY, MEAN, RMS, SKEWNESS, STRESS, STRESSES, Ensemble, Moments, Profile
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import Notice, warn_of, written
from lfpiv_cli.pictures.vectors import mean_of_known
from lfpiv_cli.results import ArrayResult
from lfpiv_cli.verbs.fields import Extra, ensure_one_time, samples_of_tracks
from lfpiv_cli.verbs.tracks import Tracked, windows_of

# Links that are more likely wrong than right take no part.
LEAST_PROBABILITY = 0.5
# Of fewer independent pairs errors of stresses are stated too small: with 16, 1.96 of them cover 80 %.
FEWEST_INDEPENDENT = 20.0
# Of variances of nothing but noise, whose errors are the smaller the smaller they are by chance, one in twenty is so
# many standard errors negative with 20 to 40 pairs; neighbours are alike, so that it may be more.
NEGATIVE_SIGMAS, MOST_NEGATIVE = 3.0, 0.2
MOST_SPARSE, MOST_CURVED = 0.5, 0.1
# A profile's name: an axis, or r@ and the axis about which; places of other axes.
PROFILE = re.compile(r"(?:(?P<along>[xyz])(?:@|$)|r@(?P<about>[xyz])(?:,|$))(?P<places>(?:[xyz]=[^,=]+(?:,(?=.)|$))*)")


def parse_profile(text: str) -> tuple[int, bool, dict[int, float]]:
    """Return a profile by its name, as z, z@x=0,y=1.5, r@x or r@x,y=0.2,z=-1.

    Returns
    -------
    tuple
        Along or about which axis (0 for x), whether about it, and the places of other axes, mm.

    Raises
    ------
    UsageError
        It is no name of one.
    """
    found = PROFILE.fullmatch(text.replace(" ", ""))
    try:
        if found is None:
            raise ValueError
        axis, places = "xyz".index(found["along"] or found["about"]), re.findall("(.)=([^,]+)", found["places"])
        at_mm = {"xyz".index(name): float(place) for name, place in places}
        if axis in at_mm or len(at_mm) < len(places):
            raise ValueError
    except ValueError as error:
        expected = "an axis, as z, a line, as z@x=0,y=1.5 (mm), or the distance from one, as r@x,y=0,z=0"
        raise UsageError(f"--profile: {text!r}, expected {expected}") from error
    return axis, found["about"] is not None, at_mm


def profile_on(grid: Grid, text: str) -> Profile:
    """Return a profile over the places of a grid by its name; along an axis, what is not named is averaged over.

    Raises
    ------
    UsageError
        It lies outside.
    """
    along, is_about, at_mm = parse_profile(text)
    points = grid.centres_mm().reshape(-1, 3)
    for axis, place in at_mm.items():
        low, high = grid.bounds_mm(axis)
        if not low <= place <= high:
            raise UsageError(f"--profile {text}: {'xyz'[axis]} is {low:g} to {high:g} mm")
    if not is_about:
        near = [np.argmin(np.abs(grid.axis_mm(axis) - place)) for axis, place in at_mm.items()]
        index = np.rint(grid.mm_to_voxel(points)).astype(np.int64)
        on = np.all(index[:, list(at_mm)] == near, axis=1)
        return Profile(text, ("u", "v", "w"), grid.axis_mm(along), np.where(on, index[:, along], -1))
    others = [k for k in range(3) if k != along]
    outward = points - [at_mm.get(axis, 0.0) for axis in range(3)]
    outward[:, along] = 0.0
    distance = np.linalg.norm(outward, axis=1)
    ring = np.floor(distance / max(grid.spacing_mm[k] for k in others)).astype(np.int64)
    _, point, count = np.unique(ring, return_inverse=True, return_counts=True)
    axial = np.broadcast_to(np.eye(3)[along], points.shape)
    # On the axis any direction is radial.
    radial = np.where(distance[:, np.newaxis] > 0.0, outward, np.eye(3)[others[0]])
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    turn = np.stack([axial, radial, np.cross(axial, radial)], axis=1)
    return Profile(text, ("axial", "radial", "azimuthal"), np.bincount(point, distance) / count, point, turn)


@dataclass(frozen=True, eq=False, repr=False)
class FlowStatistics(ArrayResult):
    """Statistics of a flow over many pairs.

    Attributes
    ----------
    mean : the mean, with its standard errors, on the grid of the vectors or bins
    found : all moments, of displacements in mm, by place in the order of `mean.flag.ravel()`
    pairs : of how many pairs, or frames of a sequence
    profile : where one is taken; None: there is none
    left_out : links that are more likely wrong than right
    curved_mm2 : (places, 3) of bins, what a mean that is curved across them adds to the variances
    """

    mean: VectorField
    found: flow_statistics.Statistics
    pairs: int
    profile: Profile | None = None
    left_out: int = 0
    curved_mm2: Floats | None = None

    @property
    def scales(self) -> Floats:
        """What moments (16,) are to be multiplied with to be in m/s, m^2/s^2 or 1; NaN where the time is not known."""
        scale = np.full(len(flow_statistics.FACTORS), np.nan if self.mean.dt_s is None else MM_TO_M / self.mean.dt_s)
        scale[STRESS] **= 2
        scale[ENERGY] **= 2
        scale[SKEWNESS] = 1.0
        return scale

    def named(self, found: Moments, each: str = "") -> dict[str, tuple[NDArray[Any], str]]:
        """Return moments by name, with their units; stresses one by one where `each` is the name of one."""
        value, sigma = found.values * self.scales, found.sigma * self.scales
        stress, energy = found.stress * self.scales[STRESS], found.energy * self.scales[ENERGY]
        named = {
            "velocity_sigma": (sigma[:, MEAN], "m/s"),
            "velocity_rms": (value[:, RMS], "m/s"),
            "velocity_rms_sigma": (sigma[:, RMS], "m/s"),
            "kinetic_energy": (energy, "m^2/s^2"),
            "kinetic_energy_sigma": (sigma[:, ENERGY][:, 0], "m^2/s^2"),
            "kinetic_energy_with_noise": (value[:, ENERGY][:, 0], "m^2/s^2"),
        }
        stresses = {"": stress, "_sigma": sigma[:, STRESS], "_with_noise": value[:, STRESS]}
        for end, array in stresses.items():
            if each:
                named |= {f"{each}_{name}{end}": (array[:, k], "m^2/s^2") for k, name in enumerate(STRESSES)}
            else:
                named[f"reynolds_stress{end}"] = (array, "m^2/s^2")
        return named

    def arrays(self) -> Extra:
        """Return the arrays on the grid besides the mean, with the names and units that files give them."""
        found, shape = self.found.moments, self.mean.flag.shape
        columns: dict[str, tuple[NDArray[Any], str]] = {"samples": (found.samples, "1")}
        columns["displacement_rms_voxel"] = (found.values[:, RMS] / self.mean.voxel_mm, "voxel")
        columns |= {"skewness": (found.values[:, SKEWNESS], "1"), "skewness_sigma": (found.sigma[:, SKEWNESS], "1")}
        if self.mean.dt_s is not None:
            columns |= self.named(found, "reynolds_stress")
        return {name: (array.reshape(*shape, *array.shape[1:]), unit) for name, (array, unit) in columns.items()}

    def attributes(self) -> dict[str, Any]:
        """Return what a file says of them, besides what it says of their mean."""
        said = {"pairs": self.pairs, "integral_time_pairs": 0.5 * self.found.tau, "block_pairs": self.found.block}
        line = self.profile
        return said | ({} if line is None else {"profile": line.name, "profile_components": ", ".join(line.components)})

    def tables(self) -> dict[str, Extra]:
        """Return the profile and the convergence, as the groups of a file; none where the time is not known."""
        if self.mean.dt_s is None:
            return {}
        spread = self.found.spread * self.scales
        tables: dict[str, Extra] = {
            "convergence": {
                "pairs": (self.found.pairs, "1"),
                "velocity_spread": (spread[:, MEAN], "m/s"),
                "reynolds_stress_spread": (spread[:, STRESS], "m^2/s^2"),
            }
        }
        line = self.found.profile
        if self.profile is not None and line is not None:
            at = {"at_mm": (self.profile.at_mm, "mm"), "samples": (line.samples, "1")}
            tables["profile"] = at | {"velocity": (line.values[:, MEAN] * self.scales[MEAN], "m/s")} | self.named(line)
        return tables

    def summary(self) -> dict[str, Any]:
        """Return counts and figures, units in their names; stresses are means over all places."""
        found, there = self.found.moments, self.mean.flag < REJECTED
        normal, noise, sigma = found.stress[:, :3], found.noise[:, :3], found.sigma[:, STRESS][:, :3]
        with np.errstate(invalid="ignore", divide="ignore"):
            shares = noise / found.values[:, STRESS][:, :3]
            curved = (0.0 if self.curved_mm2 is None else self.curved_mm2) / found.values[:, STRESS][:, :3]
            far = np.where(np.isfinite(normal / sigma), normal < -NEGATIVE_SIGMAS * sigma, np.nan)
        mean_stress = mean_of_known(found.stress, (0,)) * self.scales[STRESS]
        reported = {
            "pairs": self.pairs,
            "places": there.size,
            "rejected": int(np.count_nonzero(self.mean.flag == REJECTED)),
            "masked": int(np.count_nonzero(self.mean.flag == MASKED)),
            "samples_median": float(np.median(found.samples[there.ravel()])) if there.any() else None,
            "links_left_out": self.left_out,
            "integral_time_pairs": (0.5 * self.found.tau).tolist(),
            "independent_pairs": self.pairs / float(self.found.tau.max()),
            "block_pairs": self.found.block,
            "noise_share": mean_of_known(shares, (0,)).tolist(),
            "curvature_share": None if self.curved_mm2 is None else mean_of_known(curved, (0,)).tolist(),
            "negative_variances": np.count_nonzero(normal < 0.0, axis=0).tolist(),
            "negative_beyond_chance_share": mean_of_known(far, (0,)).tolist(),
            "reynolds_stresses_m2_s2": mean_stress.tolist(),
            "kinetic_energy_m2_s2": 0.5 * float(mean_stress[:3].sum()),
            "kinetic_energy_with_noise_m2_s2": float(
                mean_of_known(found.values[:, ENERGY], (0,))[0] * self.scales[ENERGY][0]
            ),
        }
        return dict(without_nan(reported))


def statistics(
    *given: VectorField | Points | Tracked,
    bin_mm: tuple[float, float, float] | None = None,
    fewest: int = 20,
    profile: str = "z",
) -> FlowStatistics:
    """Return the statistics of a flow over many pairs.

    Parameters
    ----------
    *given : VectorField, Points or Tracked
        In the order of time: fields on one grid, from `correlate`, `fit_field` or `open_vectors`; or tracks of pairs
        or sequences, from `track` or `open_tracks`, each of which counts where it is.
    bin_mm : (x, y, z), optional
        Sides of the bins that tracks are sorted into; those of the interrogation windows when not given.
    fewest : int, optional
        Bins with fewer tracks than this have no statistics.
    profile : str, optional
        Along an axis ("z"), a line ("z@x=0,y=1") or by the distance from an axis ("r@x").

    Returns
    -------
    FlowStatistics
        `mean`, a field whose uncertainties are standard errors; `arrays()` and `tables()`, all moments with theirs by
        the names that files have, and their units; `summary()`.

    Raises
    ------
    InputError
        Nothing is given, or it does not belong together.
    UsageError
        Fields and tracks are mixed, bins are asked for of fields, or the profile lies outside.
    """
    fields = [each for each in given if isinstance(each, VectorField)]
    tracks = [each if isinstance(each, Points) else each.points for each in given if not isinstance(each, VectorField)]
    if fields and (tracks or bin_mm is not None):
        raise UsageError("statistics are of fields, or of tracks in bins, not of both")
    found = of_fields(fields, profile) if fields else of_tracks(tracks, bin_mm, fewest, profile)
    warn_of(notices_of(found.summary(), "the statistics"))
    chosen = {"profile": profile} | ({} if fields else {"bin_mm": bin_mm, "fewest": fewest})
    made = record("statistics", (found.mean.provenance.get("config") or {}) | {"statistics": chosen}, {})
    return replace(found, mean=replace(found.mean, provenance=made))


def of_fields(fields: Iterable[VectorField], profile: str | None = None) -> FlowStatistics:
    """Return the statistics of the measured vectors of fields on one grid, read one by one; replaced ones are none.

    Raises
    ------
    InputError
        There are no fields, or one differs from the first in its grid, its time or its voxels.
    """
    first: VectorField | None = None
    kept: list[tuple[NDArray[Any], ...]] = []
    for number, field in enumerate(fields):
        if first is None:
            first, masked, quality = field, field.flag == MASKED, np.zeros((3, *field.flag.shape))
        elif (field.grid, field.dt_s, field.voxel_mm) != (first.grid, first.dt_s, first.voxel_mm):
            raise InputError("the vector fields of a batch differ in grid, time or voxels, and have no mean")
        place = np.flatnonzero((field.flag == VALID) | (field.flag == SECOND_PEAK))
        noise = np.zeros((len(place), 6))
        noise[:, :3] = np.nan
        if field.uncertainty_voxel is not None:
            noise[:, :3] = (field.uncertainty_voxel * field.voxel_mm).reshape(-1, 3)[place] ** 2
        value = (field.displacement_voxel * field.voxel_mm).reshape(-1, 3)[place]
        kept.append((place, np.full(len(place), number), value, noise))
        masked &= field.flag == MASKED
        quality += (field.correlation, field.peak_ratio, field.valid_fraction)
    if first is None:
        raise InputError("there are no vector fields to take a mean of")
    place, frame, value, noise = map(np.concatenate, zip(*kept, strict=True))
    ensemble = Ensemble(first.flag.size, len(kept), place, frame, value, noise, np.zeros((len(place), 0)))
    line = None if profile is None else profile_on(first.grid, profile)
    found = flow_statistics.statistics_of(ensemble, 1, line)
    mean = _mean_field(first, found, masked, quality / len(kept))
    return FlowStatistics(mean, found, len(kept), line)


def of_tracks(
    tracks: Iterable[Points], bin_mm: tuple[float, float, float] | None, fewest: int, profile: str
) -> FlowStatistics:
    """Return the statistics of tracks in bins, which lie in the middle of the volume of the first one's config.

    Raises
    ------
    InputError
        There are none, or their times or origins differ.
    """
    kept: list[Samples] = []
    first: Points | None = None
    for points in tracks:
        if first is None:
            first, settings = points, carried_config(points.provenance, "the tracks")
        ensure_one_time(each.attributes.get("dt_s") for each in (first, points))
        if points.reference != first.reference:
            raise InputError("the tracks' coordinates have different origins")
        # Of a sequence without tracks the first frame alone, with none.
        frames = range(int(points.arrays["frame"].max(initial=0)) + 1) if "frame" in points.arrays else [None]
        kept += [samples_of_tracks(points, frame) for frame in frames]
    if first is None:
        raise InputError("there are no tracks to take statistics of")
    windows = windows_of(settings, settings.masking_walls())
    grid = bins_of(settings, tuple(windows.sides_mm) if bin_mm is None else bin_mm)
    sides = np.asarray(grid.spacing_mm)
    at = np.concatenate([grid.mm_to_voxel(each.points_mm) for each in kept])
    index = np.rint(at).astype(np.int64)
    sure = np.concatenate([each.probability for each in kept]) >= LEAST_PROBABILITY
    inside = np.all((index >= 0) & (index < grid.shape_xyz), axis=1)
    used = sure & inside
    nx, ny, _ = grid.shape_xyz
    ensemble = Ensemble(
        int(np.prod(grid.shape_xyz)),
        len(kept),
        (index @ (1, nx, nx * ny))[used],
        np.repeat(np.arange(len(kept)), [len(each) for each in kept])[used],
        np.concatenate([each.value_mm for each in kept])[used],
        symmetric(np.concatenate([each.covariance_mm2 for each in kept])[used]),
        (at - index)[used],
    )
    line = profile_on(grid, profile)
    found = flow_statistics.statistics_of(ensemble, fewest, line)
    unknown = np.full(grid.shape_zyx, np.nan)
    share = np.ones(grid.shape_zyx)
    if windows.walls is not None:
        share = windows.walls.shares(grid.centres_mm(), sides)
    voxel = settings.grid().spacing_mm
    size = [max(round(side / length), 1) for side, length in zip(sides, voxel, strict=True)]
    zeros, flag = np.zeros((*grid.shape_zyx, 3)), np.zeros(grid.shape_zyx, np.uint8)
    empty = VectorField(
        *(grid, zeros, zeros, unknown, unknown, share, flag, zeros, voxel),
        float(first.attributes["dt_s"]),
        (size[0], size[1], size[2]),
        first.reference,
        first.provenance,
    )
    mean = _mean_field(empty, found, share < SMALLEST_VALID_FRACTION, np.stack([unknown, unknown, share]))
    left_out = int(np.count_nonzero(inside & ~sure))
    return FlowStatistics(mean, found, len(kept), line, left_out, curved_across(mean) * np.square(voxel))


def curved_across(mean: VectorField) -> Floats:
    """Return the variances (places, 3), voxel^2, by which a mean scatters about linear trends within the bins.

    Of samples spread evenly over a bin of side h, a second derivative c leaves c^2 h^4 / 720; c h^2 is the second
    difference of neighbouring bins. NaN where a bin has none along an axis of three or more.
    """
    total = np.zeros(mean.displacement_voxel.shape)
    for axis, count in enumerate(mean.flag.shape):
        if count > 2:
            inner = [slice(None)] * 4
            inner[axis] = slice(1, -1)
            second = np.full(total.shape, np.nan)
            second[tuple(inner)] = np.diff(mean.displacement_voxel, 2, axis=axis)
            total += second**2 / 720.0
    return total.reshape(-1, 3)


def bins_of(settings: Config, sides_mm: tuple[float, ...]) -> Grid:
    """Return the bins in the middle of a config's volume, as many as fit in, one at least along each axis."""
    volume = settings.grid()
    bounds = [volume.bounds_mm(axis) for axis in range(3)]
    nx, ny, nz = (max(int((high - low) / side + 1e-6), 1) for (low, high), side in zip(bounds, sides_mm, strict=True))
    x, y, z = (0.5 * (low + high) for low, high in bounds)
    return Grid.centred((nx, ny, nz), (sides_mm[0], sides_mm[1], sides_mm[2]), (x, y, z))


def _mean_field(first: VectorField, found: flow_statistics.Statistics, masked: Flags, quality: Floats) -> VectorField:
    """Return the mean as a field like the first one: masked where all are, rejected where there is none."""
    shape = (*first.flag.shape, 3)
    mean = found.moments.values[:, MEAN].reshape(shape) / first.voxel_mm
    mean[masked] = np.nan
    without = ~np.isfinite(mean).all(axis=-1)
    correlation, peak_ratio, valid_fraction = quality
    return replace(
        first,
        displacement_voxel=mean,
        displacement_raw_voxel=mean,
        correlation=correlation,
        peak_ratio=peak_ratio,
        valid_fraction=valid_fraction,
        flag=np.where(masked, MASKED, np.where(without, REJECTED, VALID)).astype(np.uint8),
        uncertainty_voxel=np.where(masked[..., np.newaxis], np.nan, found.moments.sigma[:, MEAN].reshape(shape))
        / first.voxel_mm,
    )


def notices_of(summary: Mapping[str, Any], name: str) -> list[Notice]:
    """Return what speaks against statistics."""
    notices, independent = [], summary["independent_pairs"]
    if independent < FEWEST_INDEPENDENT:
        times = readable(summary["integral_time_pairs"], 3)
        text = (
            f"{summary['pairs']} pairs are worth {written(independent)} independent ones (integral times: {times}): "
            "the errors of stresses are themselves known badly, and stated too small"
        )
        remedy = "more pairs, further apart in time; a flow that drifts has no mean, take parts of it"
        expected = f"at least {FEWEST_INDEPENDENT:g}"
        notices.append(Notice("few-independent", name, text, remedy, independent, expected))
    negative = max(share or 0.0 for share in summary["negative_beyond_chance_share"])
    if negative > MOST_NEGATIVE:
        text = f"{negative:.0%} of the variances are negative without noise, far beyond their errors"
        remedy = "stated errors are larger than vectors scatter: take the stresses with noise for upper bounds"
        notices.append(Notice("noise-above-scatter", name, text, remedy, negative, f"at most {MOST_NEGATIVE:g}"))
    curved = max(share or 0.0 for share in summary["curvature_share"] or [0.0])
    if curved > MOST_CURVED:
        text = f"{curved:.0%} of the variance is the mean's own, which is curved across the bins"
        remedy = "smaller --bin-mm across the flow, longer ones along it"
        notices.append(Notice("bins-curved", name, text, remedy, curved, f"at most {MOST_CURVED:g}"))
    sparse = summary["rejected"] / max(summary["places"] - summary["masked"], 1)
    if sparse > MOST_SPARSE:
        text = f"{sparse:.0%} of the places have too few samples and no statistics"
        notices.append(
            Notice("places-sparse", name, text, "more pairs, or larger --bin-mm", sparse, f"at most {MOST_SPARSE:g}")
        )
    return notices
