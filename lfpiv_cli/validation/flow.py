"""Figures of merit of a measured flow against a known one.

Streamwise figures take the component along the mean of the true flow, v for the measured one and u for the true one.
A vector that is NaN is a miss: it lowers every share and is counted; means are over the vectors that were found. A
figure that cannot be given is None, never NaN.

Axes: arrays `[z, y, x]` with components (u, v, w) along (x, y, z) last; velocities in m/s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.errors import InputError
from lfpiv_cli.flow.field import FLAG_NAMES, MM_TO_M, VectorField
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.notice import written
from lfpiv_cli.synthetic.flows import Flow

# The paper's Fig. 18: the share of vectors within a quarter of the truth.
TOLERANCE = 0.25
# The cumulative distribution is given at every per cent of relative error up to 100.
CUMULATIVE_STEPS = 101
# A mean flow slower than this share of the mean speed is the remainder of a flow that has no direction (a vortex).
SMALLEST_MEAN_FLOW = 0.05
# How figures end whose limit is the largest size allowed, of flows and of weights; of the others it is the smallest.
LARGEST_ALLOWED = ("mean_error", "rmse_grey_largest", "l1_mean", "l1_largest")
# Particles that a local linear fit takes: seven times its four unknowns, and close enough to the size of a window.
FIT_PARTICLES = 28
# Figures of each component, and their units.
COMPONENT_FIGURES = {"rms": "_voxel", "bias": "_voxel", "slope": ""}


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured and true velocities of the n windows inside, in m/s, and where each one lies.

    Attributes
    ----------
    measured, true : (n, 3); `measured` is NaN for a miss
    index_zyx : (n, 3) indices of the windows
    direction : (3,) unit vector of the mean true flow, or None where it has no direction
    """

    measured: Floats
    true: Floats
    index_zyx: Integers
    direction: Floats | None

    @property
    def found(self) -> Flags:
        """Which windows are no miss, (n,)."""
        return np.asarray(np.isfinite(self.measured).all(axis=1))


@dataclass(frozen=True, eq=False)
class Measured:
    """A measured flow and what it is held against.

    Attributes
    ----------
    truth : (nz, ny, nx, 3) m/s at the window centres
    inside : (nz, ny, nx) True for the windows that are judged
    flow : the analytic flow that the truth is of, in the field's coordinates; None where it is of particles
    """

    field: VectorField
    truth: Floats
    inside: Flags
    flow: Flow | None = None

    @cached_property
    def pairs(self) -> Comparison:
        """Measured and true velocities at the windows that are judged; the truth may be anything elsewhere.

        Raises
        ------
        InputError
            The truth or the mask has another shape than the field, no window is inside, or the truth is not finite
            there.
        """
        shape = self.field.flag.shape
        if self.truth.shape != (*shape, 3) or self.inside.shape != shape:
            raise InputError(
                f"truth {self.truth.shape} and mask {self.inside.shape} do not fit vectors of shape {shape}"
            )
        if not self.inside.any():
            raise InputError("none of the window centres lies inside the flow")
        true = self.truth[self.inside]
        if not np.isfinite(true).all():
            raise InputError("the true velocity is not finite at some window centres inside the flow")
        mean = true.mean(axis=0)
        speed = float(np.linalg.norm(mean))
        has_direction = speed > SMALLEST_MEAN_FLOW * float(np.linalg.norm(true, axis=1).mean())
        return Comparison(
            self.field.velocity[self.inside], true, np.argwhere(self.inside), mean / speed if has_direction else None
        )

    @property
    def found(self) -> Flags:
        """Which windows (nz, ny, nx) are judged and no miss."""
        return np.asarray(self.inside & np.isfinite(self.field.velocity).all(axis=-1))

    def judged(self, values: Floats) -> Floats:
        """Return vectors where they are judged, else NaN."""
        return np.where(self.inside[..., np.newaxis], values, np.nan)

    def figures(self, duct: Duct | None, pipe: RoundWall | None = None) -> dict[str, Any]:
        """Return the figures of `flow_figures`, with Table 4's for a duct, or those by radius for a pipe."""
        figures = flow_figures(self)
        if duct is not None:
            figures["table_4"] = table_4(self, duct)
            # the largest of the six slices, a share and not per cent
            errors = [row["ours_percent"] for name, row in figures["table_4"].items() if name != "overall"]
            figures["slice_mean_error"] = None if None in errors else 0.01 * max(errors)
        if pipe is not None:
            figures |= pipe_figures(self, pipe)
        return figures


def flow_figures(measured: Measured) -> dict[str, Any]:
    """Return the figures of a measured flow, ready for JSON.

    Returns
    -------
    dict
        Counts; `streamwise_mean_error` (sum v / sum u - 1); `within_25_percent_streamwise` and `..._vector` (shares of
        all windows inside); `rms_u_voxel`, `bias_u_voxel`, `slope_u` (of measured on true through zero) and so on for
        v, w, and the smallest of these; `slices` along each axis; `cumulative`.
    """
    field, inside, pairs = measured.field, measured.inside, measured.pairs
    streamwise, vector = relative_errors(pairs)
    flags = field.flag[inside]
    figures: dict[str, Any] = {"vectors": int(field.flag.size), "vectors_inside": int(flags.size)}
    figures |= {f"vectors_{name.replace(' ', '_')}": int(np.sum(flags == flag)) for flag, name in FLAG_NAMES.items()}
    figures["vectors_missing"] = int(np.sum(~np.isfinite(field.velocity[inside]).all(axis=1)))
    figures["streamwise_direction"] = None if pairs.direction is None else pairs.direction.tolist()
    figures["streamwise_mean_error"] = _mean_error(*_streamwise_sums(pairs, pairs.found))
    figures["within_25_percent_streamwise"] = None if streamwise is None else float(np.mean(streamwise < TOLERANCE))
    figures["within_25_percent_vector"] = float(np.mean(vector < TOLERANCE))

    # of each component, over the vectors found; unknown without them or without a time
    figures |= {f"{name}_{c}{unit}": None for c in "uvw" for name, unit in COMPONENT_FIGURES.items()}
    if field.dt_s is not None and pairs.found.any():
        to_voxel = field.dt_s / (np.asarray(field.voxel_mm) * MM_TO_M)
        found, true = pairs.measured[pairs.found], pairs.true[pairs.found]
        error = (found - true) * to_voxel
        rms, bias = np.sqrt(np.mean(error**2, axis=0)), np.mean(error, axis=0)
        power = np.sum(true**2, axis=0)
        for k, c in enumerate("uvw"):
            figures[f"rms_{c}_voxel"], figures[f"bias_{c}_voxel"] = float(rms[k]), float(bias[k])
            if power[k] > 0.0:
                figures[f"slope_{c}"] = float(found[:, k] @ true[:, k] / power[k])
    slopes = [figures[f"slope_{c}"] for c in "uvw" if figures[f"slope_{c}"] is not None]
    figures["smallest_slope"] = min(slopes, default=None)
    # the streamwise mean error of every plane of windows across each axis
    figures["slices"] = {}
    for axis, name in enumerate("xyz"):
        plane, positions = pairs.index_zyx[:, 2 - axis], field.grid.axis_mm(axis)
        errors = [_mean_error(*_streamwise_sums(pairs, plane == k)) for k in range(field.grid.shape_xyz[axis])]
        figures["slices"][name] = {"position_mm": [float(p) for p in positions], "streamwise_mean_error": errors}
    figures["cumulative"] = cumulative_distribution(pairs)
    return figures


def relative_errors(pairs: Comparison) -> tuple[Floats | None, Floats]:
    """Return |v - u|/|u| streamwise (None without a direction) and of the whole vector, (n,); infinite for a miss.

    Where the truth is zero, only an exact zero is right, and every error infinite.
    """
    difference = pairs.measured - pairs.true
    vector = _ratio(np.linalg.norm(difference, axis=1), np.linalg.norm(pairs.true, axis=1))
    if pairs.direction is None:
        return None, vector
    return _ratio(np.abs(difference @ pairs.direction), np.abs(pairs.true @ pairs.direction)), vector


def _ratio(error: Floats, size: Floats) -> Floats:
    """Return error / size; 0 for 0/0, infinite for a NaN error or a zero size."""
    ratio = np.where(error == 0.0, 0.0, np.inf)
    np.divide(error, size, out=ratio, where=(size > 0.0) & np.isfinite(error))
    return ratio


def _streamwise_sums(pairs: Comparison, chosen: Flags) -> tuple[float, float]:
    """Return the sums of v and u over chosen windows that were found; both 0 where the flow has no direction."""
    chosen = chosen & pairs.found
    if pairs.direction is None:
        return 0.0, 0.0
    return float(np.sum(pairs.measured[chosen] @ pairs.direction)), float(np.sum(pairs.true[chosen] @ pairs.direction))


def _mean_error(measured_sum: float, true_sum: float) -> float | None:
    """Return sum v / sum u - 1, or None where the true sum is not positive."""
    return measured_sum / true_sum - 1.0 if true_sum > 0.0 else None


def cumulative_distribution(pairs: Comparison) -> dict[str, Any]:
    """Return the shares of all windows whose relative error is at most 0, 1, ... 100 per cent (the paper's Fig. 18)."""
    limits = np.linspace(0.0, 1.0, CUMULATIVE_STEPS)
    streamwise, vector = relative_errors(pairs)

    def shares(errors: Floats) -> list[float]:
        return (np.searchsorted(np.sort(errors), limits, side="right") / errors.size).tolist()

    return {
        "relative_error": limits.tolist(),
        "streamwise_share": None if streamwise is None else shares(streamwise),
        "vector_share": shares(vector),
    }


def truth_at_points(positions_mm: Floats, velocities: Floats, centres_mm: Floats) -> Floats:
    """Return the velocity of a list of true particles at given points, by a linear fit to the nearest ones of each.

    Parameters
    ----------
    positions_mm, velocities : (n, 3) of the particles, half-way between the exposures; m/s
    centres_mm : (..., 3) points, for instance window centres

    Returns
    -------
    (..., 3) m/s; exact for a linear flow wherever the particles are enough and not in one plane

    Raises
    ------
    InputError
        There are no particles, or the two lists differ in shape.
    """
    if positions_mm.shape != velocities.shape or positions_mm.ndim != 2 or positions_mm.shape[0] == 0:
        raise InputError(f"{positions_mm.shape} positions and {velocities.shape} velocities make no list of particles")
    points = centres_mm.reshape(-1, 3)
    count = min(FIT_PARTICLES, positions_mm.shape[0])
    distance, nearest = KDTree(positions_mm).query(points, k=np.arange(1, count + 1))
    # Offsets in units of the fit's reach: the columns of the fit are then comparable, and a rank can be judged.
    reach = np.where(distance[:, -1:] > 0.0, distance[:, -1:], 1.0)[..., np.newaxis]
    offsets = (positions_mm[nearest] - points[:, np.newaxis, :]) / reach
    design = np.concatenate([np.ones((*offsets.shape[:2], 1)), offsets], axis=-1)
    # The pseudo-inverse's first row is the value at the point; with too few particles it is the smallest solution.
    fitted = np.einsum("mk,mkc->mc", np.linalg.pinv(design)[:, 0], velocities[nearest])
    return fitted.reshape(centres_mm.shape)


def limits_missed(figures: Mapping[str, Any], limits: Mapping[str, float | None]) -> list[str]:
    """Return a sentence for each figure that misses its limit; a figure that is unknown misses.

    Parameters
    ----------
    limits : by the name of the figure: the largest size of those that end as in `LARGEST_ALLOWED`, the smallest of
        others; None where there is no limit
    """
    missed = []
    for name, limit in limits.items():
        figure = figures.get(name)
        if limit is None:
            continue
        largest = name.endswith(LARGEST_ALLOWED)
        if figure is None or (abs(figure) > limit if largest else figure < limit):
            allowed = f"at most {limit} is allowed" if largest else f"at least {limit} is asked for"
            missed.append(f"{name} is {'unknown' if figure is None else written(figure, 6)}, {allowed}")
    return missed


# The paper's channel flow: its six slices (Figs. 15 and 16) and their errors beside its own (Table 4).
#
# The paper's slices lie across the depth, z/D counted from the camera's side of the duct, and across the lateral
# axis, x/D. Its flow runs along its y; ours along x or y, so that its x is our other lateral axis.

# Places and mean velocity errors in per cent: DLFC's, ERT's.
PAPER_SLICES = {
    "z/D": {0.3: (4.35, 3.51), 0.54: (4.46, 1.42), 0.78: (0.13, 0.73)},
    "x/D": {0.24: (7.28, 10.43), 0.48: (2.06, 4.00), 0.72: (12.01, 12.37)},
}
PAPER_OVERALL = (6.25, 6.77)
# The paper's duct: its width, and its mean velocity, which its 40 L/h through 1 cm2 meet to 3 %.
PAPER_WIDTH_MM, PAPER_MEAN_VELOCITY_M_S, VELOCITY_TOLERANCE = 10.0, 0.1082, 0.03


@dataclass(frozen=True)
class Duct:
    """A square duct: its width, its centre in the vectors' coordinates, the axis that the flow follows, its mean."""

    width_mm: float
    centre_mm: tuple[float, float, float]
    axis: Literal["x", "y"]
    mean_velocity_m_s: float

    @property
    def is_the_papers(self) -> bool:
        """Whether the paper's figures are of this duct."""
        return math.isclose(self.width_mm, PAPER_WIDTH_MM) and math.isclose(
            abs(self.mean_velocity_m_s), PAPER_MEAN_VELOCITY_M_S, rel_tol=VELOCITY_TOLERANCE
        )

    @property
    def across(self) -> dict[str, int]:
        """The axes (0 for x) of the paper's slices by their names in Table 4."""
        return {"z/D": 2, "x/D": 1 if self.axis == "x" else 0}

    def position_mm(self, axis: int, share: float) -> float:
        """Return where a slice lies along an axis, given as a share of the width."""
        return self.centre_mm[axis] + (share - 0.5) * self.width_mm


def table_4(measured: Measured, duct: Duct) -> dict[str, Any]:
    """Return the sizes of the mean velocity errors in per cent, of the six slices and of the whole, beside the paper's.

    By the slice (`overall`, `z/D 0.3` ...): `ours`, `paper_dlfc` and `paper_ert`. Of a slice between planes of windows
    the sums of v and of u, not their ratio, are interpolated; beyond the outer planes the outer one is taken. Ours is
    None where it has none.
    """
    grid, pairs = measured.field.grid, measured.pairs
    found = pairs.measured[pairs.found].sum(axis=0), pairs.true[pairs.found].sum(axis=0)
    overall = None
    if pairs.direction is not None and pairs.found.any():
        overall = float(found[0] @ pairs.direction / (found[1] @ pairs.direction) - 1.0)
    table = {"overall": _row(overall, *PAPER_OVERALL)}
    for name, axis in duct.across.items():
        plane = pairs.index_zyx[:, 2 - axis]
        sums = np.array([_streamwise_sums(pairs, plane == k) for k in range(grid.shape_xyz[axis])])
        for share, paper in PAPER_SLICES[name].items():
            position = duct.position_mm(axis, share)
            v, u = (float(np.interp(position, grid.axis_mm(axis), each)) for each in sums.T)
            table[f"{name} {share}"] = _row(_mean_error(v, u), *paper)
    return table


def _row(error: float | None, paper_dlfc: float, paper_ert: float) -> dict[str, float | None]:
    ours = None if error is None else 100.0 * abs(error)
    return {"ours_percent": ours, "paper_dlfc_percent": paper_dlfc, "paper_ert_percent": paper_ert}


# Rings of nearly as many windows each, the outer ones thinner: beyond the last but one edge windows of a tenth of the
# diameter reach beyond the wall.
RING_EDGES = (0.0, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0)
# Figures of the inner pipe leave out the last ring.
INNER = RING_EDGES[-2]


def pipe_figures(measured: Measured, pipe: RoundWall) -> dict[str, Any]:
    """Return the figures of windows by their distance from the axis, ready for JSON.

    Returns
    -------
    dict
        `within_25_percent_vector_inner`, the share of the windows up to 0.9 of the radius whose whole vector errs by
        less than a quarter; `rings`, for each two edges (shares of the radius) their `vectors`, `streamwise_mean_error`
        (sum v / sum u - 1) and `within_25_percent_vector`. None where there is no window.
    """
    pairs = measured.pairs
    share = (pipe.distances_mm(measured.field.grid.centres_mm()) / pipe.radius_mm)[measured.inside]
    right = relative_errors(pairs)[1] < TOLERANCE
    inner = share <= INNER
    ring, rings = np.searchsorted(RING_EDGES[1:-1], share), []
    for number, edges in enumerate(zip(RING_EDGES, RING_EDGES[1:], strict=False)):
        chosen = ring == number
        found = chosen & pairs.found
        sums = [float(each[found, pipe.along].sum()) for each in (pairs.measured, pairs.true)]
        rings.append(
            {
                "radius_shares": list(edges),
                "vectors": int(chosen.sum()),
                "streamwise_mean_error": sums[0] / sums[1] - 1.0 if sums[1] else None,
                "within_25_percent_vector": _share(right[chosen]),
            }
        )
    return {"within_25_percent_vector_inner": _share(right[inner]), "rings": rings}


def _share(right: Flags) -> float | None:
    """Return how many of some are right, None of none."""
    return float(right.mean()) if right.size else None
