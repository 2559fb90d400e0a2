"""Vector fields of tracks on the grid of the interrogation windows, and of two that measure the same flow differently.

A volume's correlation errs by its particles' elongation, a fit of tracks by where no track is near: errors of different
origin, so that each component takes the weighted mean of both. Measured vectors that state no uncertainty have the one
that their distances from the other field's show; where these are too few to tell, they serve only where the other field
has none. A vector that neighbours replaced serves only where nothing was measured.

The differences of the two are a check of what they state. Where these are larger than stated, all over the field or
about a vector, it is the field with the larger uncertainties that makes most of them, and those above all are widened
until they explain them. Two vectors that lie further apart than all over the field cannot both be right, and their mean
would be wrong for certain: the one that fits the vectors around it is kept, as a whole.

Axes: arrays `[z, y, x]`, components last; displacements in voxels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.errors import InputError
from lfpiv_cli.flow.correlation import SMALLEST_VALID_FRACTION
from lfpiv_cli.flow.field import MASKED, REJECTED, REPLACED, SECOND_PEAK, VALID, VectorField
from lfpiv_cli.flow.outliers import NEEDED_SHARE, predict
from lfpiv_cli.flow.windows import Triple, Walls, layout_windows
from lfpiv_cli.grid import Grid
from lfpiv_cli.results import ArrayResult
from lfpiv_cli.tracks.gridding import on_grid

# Vectors further apart than this, in units of the uncertainty of their difference, are not of one flow: by chance one
# of a hundred has a component that far out.
LARGEST_DISAGREEMENT = 3.0
# The spread of differences is that within which nine of ten lie: it sees more of wide tails than a median does, and
# outliers, up to a tenth, leave it as it is.
SPREAD_SHARE, SPREAD_SIGMAS = 0.9, 1.645
# Fewer vectors than this tell no spread of their differences.
FEWEST_DIFFERENCES = 30
# No vector is known better than this.
SMALLEST_SIGMA_VOXEL = 1e-6
# Positions that should be the same differ by the rounding of sums: far less than this share of a voxel.
SAME_PLACE_VOXEL = 1e-5

# How far a vector can be relied on: measured with an uncertainty, with none to be had, only replaced, not there.
WEIGHED, UNWEIGHED, FILLED, NONE = 3, 2, 1, 0


@dataclass(frozen=True, eq=False, repr=False)
class Combined(ArrayResult):
    """A combined field, and how it came about.

    Attributes
    ----------
    field : the vectors
    first_share : (nz, ny, nx, 3) the weight of the first field in each component, 0 to 1; NaN where there is no vector
    disagreement : (nz, ny, nx) largest difference of the two over its uncertainty, over the components; NaN where one
        has no vector or states no uncertainty
    left_out : (nz, ny, nx) one of the two was left out because they disagree
    widened : (2, 3) by how much the uncertainties of each field were widened all over, by component
    """

    field: VectorField
    first_share: Floats
    disagreement: Floats
    left_out: Flags
    widened: Floats

    def arrays(self) -> dict[str, tuple[Floats, str]]:
        """Return the arrays on the grid besides the field's, with the names and units that files give them."""
        return {"share_a": (self.first_share, "1"), "disagreement": (self.disagreement, "1")}


def combine(first: VectorField, second: VectorField) -> Combined:
    """Return the combined field of two on one grid.

    Masked is what either masks; rejected is where neither has a vector. Correlation and peak ratio are those of a field
    that takes part and knows them. The raw displacement is the mean before a vector was left out for disagreeing.

    Raises
    ------
    InputError
        The fields differ in grid, voxels or time.
    """
    fields = first, second
    lengths = [np.array([field.grid.spacing_mm, field.grid.origin_mm, field.voxel_mm]) for field in fields]
    alike = (first.grid.shape_xyz, first.dt_s) == (second.grid.shape_xyz, second.dt_s)
    if not alike or np.abs(lengths[0] - lengths[1]).max() > SAME_PLACE_VOXEL * min(first.voxel_mm):
        reported = [f"{field.grid}, voxels of {field.voxel_mm} mm, {field.dt_s} s" for field in fields]
        raise InputError(f"the two vector fields differ in grid, voxels or time: {reported[0]} and {reported[1]}")
    masked = (first.flag == MASKED) | (second.flag == MASKED)
    values = np.stack([field.displacement_voxel for field in fields])
    stated, ranks = np.full(values.shape, np.nan), np.full((2, *masked.shape), NONE)
    for field, sigma, rank in zip(fields, stated, ranks, strict=True):
        rank[field.flag == REPLACED] = FILLED
        measured = (field.flag == VALID) | (field.flag == SECOND_PEAK)
        rank[measured] = UNWEIGHED
        if field.uncertainty_voxel is not None:
            sigma[:] = field.uncertainty_voxel
            rank[measured & np.all(sigma > 0.0, axis=-1)] = WEIGHED
    _estimate_unstated(values, stated, np.where(masked, NONE, ranks))
    ranks[np.isfinite(stated).all(axis=-1) & (ranks == UNWEIGHED)] = WEIGHED
    used = (ranks == ranks.max(axis=0)) & (ranks > NONE) & ~masked
    # Of two that cannot be weighed the first one is taken.
    used[1] &= ~(used.all(axis=0) & (ranks[0] < WEIGHED))
    both = used.all(axis=0)
    widened = _widening_of_all(values[0] - values[1], stated, both)
    sigma = stated * widened[:, np.newaxis, np.newaxis, np.newaxis]
    apart = np.abs(values[0] - values[1]) / np.hypot(*sigma)
    disagreement = np.where(both, apart.max(axis=-1), np.nan)
    left_out = both & (disagreement > LARGEST_DISAGREEMENT)
    raw, _ = _mean(np.stack([first.displacement_raw_voxel, second.displacement_raw_voxel]), sigma, used)
    second_is_kept = _second_fits_better(values, sigma, used, left_out, masked)
    used[0] &= ~(left_out & second_is_kept)
    used[1] &= ~(left_out & ~second_is_kept)
    sigma = sigma * _widening_around(apart, sigma, both)
    displacement, share = _mean(values, sigma, used)
    flag = np.where(used[0], first.flag, np.where(used[1], second.flag, REJECTED))
    flag = np.where(used.all(axis=0), VALID, np.where(masked, MASKED, flag))
    # The uncertainty of the mean of what is used: that of one, or that of independent errors of both.
    known = used[..., np.newaxis] & (sigma > 0.0)
    total = np.where(known, np.where(known, sigma, 1.0) ** -2.0, 0.0).sum(axis=0)
    field = replace(
        first,
        displacement_voxel=displacement,
        displacement_raw_voxel=raw,
        correlation=_of_one(first.correlation, second.correlation, used),
        peak_ratio=_of_one(first.peak_ratio, second.peak_ratio, used),
        valid_fraction=np.maximum(np.where(used[0], first.valid_fraction, 0.0), used[1] * second.valid_fraction),
        flag=flag.astype(np.uint8),
        uncertainty_voxel=np.asarray(np.where(total > 0.0, total, np.nan) ** -0.5),
    )
    return Combined(field, share, disagreement, left_out, widened)


def _estimate_unstated(values: Floats, stated: Floats, ranks: Integers) -> None:
    """Give measured vectors without an uncertainty the one that their distances from the other field's show.

    It is no smaller than that of a typical vector of their field that states one.
    """
    for own, other in ((0, 1), (1, 0)):
        silent = (ranks[own] == UNWEIGHED) & (ranks[other] == WEIGHED)
        if np.count_nonzero(silent) < FEWEST_DIFFERENCES:
            continue
        variance = _spread((values[0] - values[1])[silent]) ** 2 - np.median(stated[other, silent] ** 2, axis=0)
        known = stated[own, ranks[own] == WEIGHED]
        typical = np.median(known, axis=0) if len(known) else np.zeros(3)
        stated[own, silent] = np.sqrt(np.maximum(variance, np.maximum(typical, SMALLEST_SIGMA_VOXEL) ** 2))


def _spread(difference: Floats) -> Floats:
    """Return the standard deviation (3,) of differences (n, 3), or of ratios, whatever the largest tenth."""
    return np.asarray(np.quantile(np.abs(difference), SPREAD_SHARE, axis=0) / SPREAD_SIGMAS)


def _widening_of_all(difference: Floats, stated: Floats, both: Flags) -> Floats:
    """Return the factors (2, 3), one or more, with which the uncertainties of two fields explain their differences.

    What is missing in the variance is shared as the squares of the stated variances: alike between equals, and almost
    all of it for the one that makes almost all of the difference.
    """
    if np.count_nonzero(both) < FEWEST_DIFFERENCES:
        return np.ones((2, 3))
    variance = stated[:, both] ** 2
    total = variance.sum(axis=0)
    spread = _spread(difference[both] / np.sqrt(total))
    return _widening(spread**2, np.median(variance / total, axis=1))


def _widening_around(apart: Floats, sigma: Floats, both: Flags) -> Floats:
    """Return the factors (2, nz, ny, nx, 3), one or more, that explain the differences about each vector.

    Where a volume's light is worse than its correlation knows, as near the focal plane, neighbours err alike.

    Parameters
    ----------
    apart : (nz, ny, nx, 3) differences over their standard deviations
    """
    counted = both[..., np.newaxis]
    # One that cannot be right says little of those around it.
    squares = np.where(counted, np.minimum(apart, LARGEST_DISAGREEMENT), 0.0) ** 2
    of_squares, of_counted = (
        uniform_filter(values, (3, 3, 3, 1), mode="constant") for values in (squares, counted.astype(np.float64))
    )
    mean = of_squares / np.where(counted, of_counted, 1.0)
    variance = np.where(counted, sigma**2, 1.0)
    return np.where(counted, _widening(mean, variance / variance.sum(axis=0)), 1.0)


def _widening(spread2: Floats, share: Floats) -> Floats:
    """Return the factors for variances of differences over the stated ones, by each field's share (2, …) of these."""
    return np.asarray(np.sqrt(1.0 + np.maximum(spread2 - 1.0, 0.0) * share / np.sum(share**2, axis=0)))


def _mean(values: Floats, sigma: Floats, used: Flags) -> tuple[Floats, Floats]:
    """Return the mean of two fields' values, weighted where both are used, and the first one's weight; NaN for none."""
    both = np.all(used, axis=0, keepdims=True)[0][..., np.newaxis]
    variance = np.where(both, sigma**2, 1.0)
    share = np.where(both, variance[1] / variance.sum(axis=0), used[0][..., np.newaxis])
    parts = np.where(used[..., np.newaxis], values, 0.0) * np.stack([share, 1.0 - share])
    some = np.any(used, axis=0, keepdims=True)[0][..., np.newaxis]
    return np.where(some, parts.sum(axis=0), np.nan), np.where(some, share, np.nan)


def _second_fits_better(values: Floats, sigma: Floats, used: Flags, disagree: Flags, masked: Flags) -> Flags:
    """Return where, of two that disagree, the second is nearer to what the vectors around both let expect.

    Around them count the vectors that are not in doubt themselves; where too few are at hand, the smaller stated
    uncertainty decides.
    """
    sure = used.any(axis=0) & ~disagree
    mean, _ = _mean(values, sigma, used)
    predicted, spread, share = predict(mean, sure, ~masked, np.flatnonzero(disagree))
    sigmas = sigma[:, disagree]
    off = np.sum(((values[:, disagree] - predicted) / (spread + sigmas.min(axis=0))) ** 2, axis=-1)
    stated = sigmas.prod(axis=-1)
    second = np.zeros(disagree.shape, dtype=np.bool_)
    second[disagree] = np.where(share >= NEEDED_SHARE, off[1] < off[0], stated[1] < stated[0])
    return second


def _of_one(first: Floats, second: Floats, used: Flags) -> Floats:
    """Return the first field's values where it is used and knows them, else the second's; NaN where neither does."""
    return np.asarray(np.where(used[0] & np.isfinite(first), first, np.where(used[1], second, np.nan)))


# Vectors at the centres of windows from the tracks of particles, instead of a correlation.

# A vector needs its twelve nearest tracks within this many windows of its centre: in sparse images tracks are further
# apart than windows, and what a wide fit misses of the flow is in the stated error.
REACH_WINDOWS = 2.0
# A vector lies in a region without tracers where so many tracks would be expected in a box that holds none: by chance
# alone one box in a million would; where half of the tracers are found, one in a thousand. Boxes reach as far as one
# that lets expect as many, and further, where the volume ends.
EXPECTED_TRACKS = 14.0
REACHES = np.array([1.0, 1.4, 2.0, 2.8, 4.0])
# The density at a track is that of the box which reaches its sixth neighbour.
DENSITY_NEIGHBOURS = 6


@dataclass(frozen=True, eq=False)
class Paths:
    """Middles, displacements and standard errors (n, 3), mm, of the tracks that pass from one frame to the next."""

    middle_mm: Floats
    displacement_mm: Floats
    sigma_mm: Floats


@dataclass(frozen=True)
class WindowGrid:
    """The windows whose centres get vectors.

    Attributes
    ----------
    volume : the voxels
    size : of a window in voxels along x, y, z
    overlap : share of a window in common with the next one along x, y, z
    walls : beyond which windows are masked; None: nothing is
    """

    volume: Grid
    size: Triple
    overlap: tuple[float, float, float]
    walls: Walls | None = None

    @property
    def centres(self) -> Grid:
        """The windows' centres."""
        return layout_windows(self.volume.shape_xyz, self.size, self.overlap).grid(self.volume)

    @property
    def sides_mm(self) -> Floats:
        """The sides of a window (3,), mm."""
        return np.array(self.size) * self.volume.spacing_mm

    def inside(self) -> Floats:
        """Return the share of each window (nz, ny, nx) between the walls; 1 where these mask nothing."""
        if self.walls is None:
            return np.ones(self.centres.shape_zyx)
        return self.walls.shares(self.centres.centres_mm(), self.sides_mm)

    def masked(self) -> Flags:
        """Return which windows (nz, ny, nx) lie beyond the walls."""
        return np.asarray(self.inside() < SMALLEST_VALID_FRACTION)

    def vectors(self, displacement_mm: Floats, sigma_mm: Floats, dt_s: float | None) -> VectorField:
        """Return the field of displacements (m, 3) at the centres, NaN where there is none, and their standard errors.

        What only a correlation knows is NaN.
        """
        inside, masked, voxel_mm = self.inside(), self.masked(), self.volume.spacing_mm
        found = np.isfinite(displacement_mm).all(axis=-1).reshape(masked.shape) & ~masked
        displacement, sigma = (
            np.where(found[..., np.newaxis], values.reshape(*masked.shape, 3) / voxel_mm, np.nan)
            for values in (displacement_mm, sigma_mm)
        )
        unknown = np.full(masked.shape, np.nan)
        return VectorField(
            grid=self.centres,
            displacement_voxel=displacement,
            displacement_raw_voxel=displacement,
            correlation=unknown,
            peak_ratio=unknown,
            valid_fraction=np.where(found | masked, inside, 0.0),
            flag=np.where(masked, MASKED, np.where(found, VALID, REJECTED)).astype(np.uint8),
            uncertainty_voxel=sigma,
            voxel_mm=voxel_mm,
            dt_s=dt_s,
            window_voxel=self.size,
        )


def vectors_from_paths(paths: Paths, windows: WindowGrid, dt_s: float | None) -> VectorField:
    """Return the vectors at the centres of windows; what only a correlation knows is NaN."""
    nodes = windows.centres.centres_mm().reshape(-1, 3)
    reach = REACH_WINDOWS * float(windows.sides_mm.max())
    values, errors = on_grid(paths.middle_mm, paths.displacement_mm, paths.sigma_mm, nodes, reach)
    values[without_tracks(paths.middle_mm, nodes, windows)] = np.nan
    return windows.vectors(values, errors, dt_s)


def without_tracks(middle_mm: Floats, nodes_mm: Floats, windows: WindowGrid) -> Flags:
    """Return which nodes (m,) lie in a region without tracks, where tracks elsewhere are as dense as they are.

    A fit to the nearest tracks would only extend what the flow does beside the region. A window without tracks lies in
    one if a box does that holds it and that would hold many: about it, or to one side of it; boxes count as far as they
    lie in the volume and between the walls.
    """
    if len(middle_mm) <= DENSITY_NEIGHBOURS:
        return np.ones(len(nodes_mm), dtype=np.bool_)
    low, high = np.array([windows.volume.bounds_mm(axis) for axis in range(3)]).T
    side_mm, walls = windows.sides_mm, windows.walls

    def volume_of(centres_mm: Floats, half: Floats) -> Floats:
        """Return the volume, mm^3, of boxes that reach so many windows far to each side of their centres."""
        first, last = np.maximum(centres_mm - half * side_mm, low), np.minimum(centres_mm + half * side_mm, high)
        if walls is not None:
            return walls.volumes_mm3(first, last)
        return np.asarray(np.prod(np.maximum(last - first, 0.0), axis=1))

    # Its own place is each track's nearest.
    tracks, nodes = middle_mm / side_mm, nodes_mm / side_mm
    sixth = KDTree(tracks).query(tracks, k=[DENSITY_NEIGHBOURS + 1], p=np.inf)[0]
    around = volume_of(middle_mm, sixth)
    density = np.median(DENSITY_NEIGHBOURS / around[around > 0.0])
    # How far a cube reaches that lets expect as many.
    reach = 0.5 * (EXPECTED_TRACKS / (density * float(np.prod(side_mm)))) ** (1.0 / 3.0)
    without, none = np.zeros(len(nodes), dtype=np.bool_), np.zeros(3)
    for wide in REACHES * max(reach, 1.0):
        # About the window, no wider than it along any axes; and from its far side to one side.
        boxes = [(np.array(half), none) for half in product((0.5, wide), repeat=3) if max(half) > 0.5]
        for axis in np.eye(3):
            half, aside = np.where(axis > 0.0, 0.5 * (wide + 0.5), wide), 0.5 * (wide - 0.5) * axis
            boxes += [(half, -aside), (half, aside)]
        for half, aside in boxes:
            centres = nodes + aside
            many = density * volume_of(centres * side_mm, half) > EXPECTED_TRACKS
            empty = KDTree(tracks / half).query(centres / half, p=np.inf, distance_upper_bound=1.0)[0] > 1.0
            without |= empty & many
    return without
