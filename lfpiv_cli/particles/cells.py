"""How much of a ball's light falls into a lens's cell where the cell is no rectangle, or rays are bent far.

In a rectangle the share is a product of two of the ball's marginal distributions, and that of bent rays is near it.
Otherwise it is tabulated over the ball's place, as a mean over square patches of several sizes: a pixel sees the ball
from everywhere in such a patch.

Axes: image axes on the array, mm from the lens's centre.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from lfpiv_cli.arrays import Floats, Real
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.names import Layout
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.weights.lens_cells import neighbours

# How a pixel's patch of the main lens meets the round aperture: its covered share and where that share lies.
#
# A patch that straddles the rim is lit only in part, and from one side; without the second fact, the first moments,
# all depths shrink by half a per cent.
#
# Axes: (X, Y) on the main lens, in mm about the axis; xi and eta run from -1 to 1 across a patch.


# The rim is straight across a patch but for its sagitta, taken as its mean: the share is right to 6e-3 where the rim
# enters a patch by its corner, to 1e-3 on average. An edge that runs along a patch's side is taken to lean by so much,
# as much as single precision can tell from none. Less than the least share is none, by no rounding some.
LEAST_LEAN, LEAST_SHARE = np.float32(1e-2), np.float32(1e-6)
# Of lengths that divide, mm.
TINY = np.float32(1e-12)
# In single precision, as what they meet may be: a plain number is in double, and all that follows from it.
ZERO, QUARTER, HALF, ONE, TWO, THREE, FOUR, SIX = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0], np.float32)
THIRD = ONE / THREE


@njit(cache=True, error_model="numpy", inline="always", **COUNT_NO_REFERENCES)
def covered_share(x: Real, y: Real, width: Real, radius: Real) -> tuple[Real, Real, Real, Real, Real]:
    """Return C, the means of xi and eta, and the slopes of C along X and Y (per mm) of the patch centred at (x, y).

    Means are per whole patch, not per covered part. A point of a square of half its width h is inside where
    a xi + b eta < t: a and b are h times the cosines of where the rim is, t its distance. With d_n the second
    difference of max(t +- a +- b, 0)^n / n!, C = d_2/(4 a b), its derivative by t d_1/(4 a b), and integrals by parts
    give the means.
    """
    half = HALF * width
    away = max(np.sqrt(x * x + y * y), TINY)
    per_away = ONE / away
    to_x, to_y = abs(x) * per_away, abs(y) * per_away
    a, b = half * max(to_x, LEAST_LEAN), half * max(to_y, LEAST_LEAN)
    t = min(max(radius - away - half * half / (SIX * radius), -(a + b)), a + b)
    p, q = t + a + b, max(t + a - b, ZERO)
    r, s = max(t - a + b, ZERO), max(t - a - b, ZERO)
    p2, q2, r2, s2 = HALF * p * p, HALF * q * q, HALF * r * r, HALF * s * s
    per = QUARTER / (a * b)
    per_a, per_b = FOUR * b * per, FOUR * a * per
    per = per if per * (p2 - q2 - r2 + s2) > LEAST_SHARE else ZERO
    share, dense = per * (p2 - q2 - r2 + s2), per * (p - q - r + s)
    third = THIRD * (p * p2 - q * q2 - r * r2 + s * s2)
    mean_x = per * (per_a * third - (p2 - q2 + r2 - s2))
    mean_y = per * (per_b * third - (p2 + q2 - r2 - s2))
    by_a, by_b = per * (p - q + r - s) - per_a * share, per * (p + q - r - s) - per_b * share
    turning = (by_a * to_y - by_b * to_x) * half * per_away
    slope_x, slope_y = turning * to_y - dense * to_x, -turning * to_x - dense * to_y
    right, above = -ONE if x < ZERO else ONE, -ONE if y < ZERO else ONE
    return share, right * mean_x, above * mean_y, right * slope_x, above * slope_y


# Entries per radius of the ball. Between them second-order terms do: what is left is a quarter of (1/16)^3.
ENTRIES_PER_RADIUS = 8
# Points between entries at which shares are computed, and their means over patches taken.
FINER = 4
# Sides of the patches: none, then from this share of the ball's radius on, each longer by this factor, up to the pitch
# of the lenses. Shares are almost linear in the side's square. Beyond, two pixels see more than two lenses apart.
FIRST_SIDE, NEXT_SIDE = 0.5, 1.35
# Where particles are far from focus their balls are seen up to so much smaller than in it. Blur makes a ball larger,
# nothing makes it smaller: the first table is that of a smaller one, by what its square lacks.
SMALLER_BALL = 0.85
# Balls whose images are smaller than this share of the pitch are taken as this large: their shares are almost steps.
SMALLEST_SHARE_OF_PITCH = 1.0 / 16.0
# Chords into which a ball is cut; Gauss's rule on them is right to 1e-4 where an edge ends within the ball.
CHORDS = 96
# Of a ball of radius 1 along an axis; a patch of side 1 has 1/12.
BALL_VARIANCE = 0.2
# Columns of the table: the share, its first and its second derivatives.
SHARE, BY_U, BY_V, BY_UU, BY_UV, BY_VV = range(6)
COLUMNS = 6


class CellShares(NamedTuple):
    """Shares of a ball's light that fall into a cell.

    Attributes
    ----------
    table : (levels, n, n, 6), index [level, v, u] of the ball's centre, the middle entry the lens's; empty where
        rectangles do
    side2_mm2 : (levels,) the patches' sides squared, below 0 for the smaller ball: 12 times the variance that it lacks
    step_mm : distance of entries
    radius_mm : the ball's radius on the array
    """

    table: Floats
    side2_mm2: Floats
    step_mm: float
    radius_mm: float


# The empty table, of cells that need none.
NO_SHARES = CellShares(np.zeros((0, 0, 0, COLUMNS)), np.zeros(0), 1.0, 1.0)


def cell_radius(lattice: Lattice) -> float:
    """Return how far the corners of a cell are from its lens."""
    return float(lattice.pitch.max()) / np.sqrt(2.0 if lattice.layout == "square" else 3.0)


def smallest_ball_mm(lattice: Lattice) -> float:
    """Return the radius on the array of the smallest balls that have a table of their own."""
    return SMALLEST_SHARE_OF_PITCH * float(lattice.pitch.min())


def cell_shares(lattice: Lattice, radius_mm: float) -> CellShares:
    """Return the shares for the cells of a lattice and a ball whose image has about this radius."""
    return _cell_shares(lattice.basis.tobytes(), lattice.layout, max(radius_mm, smallest_ball_mm(lattice)))


@lru_cache(maxsize=4)
def _cell_shares(basis: bytes, layout: Layout, radius: float) -> CellShares:
    """Return `cell_shares`, of which all images of a camera ask for the same."""
    lattice = Lattice(np.zeros(2), np.frombuffer(basis).reshape(2, 2), layout)
    step, pitch = radius / ENTRIES_PER_RADIUS, float(lattice.pitch.max())
    steps = max(int(np.ceil(np.log(pitch / (FIRST_SIDE * radius)) / np.log(NEXT_SIDE))), 0)
    sides = np.array([0.0, *(FIRST_SIDE * radius * NEXT_SIDE**n for n in range(steps)), pitch])
    count = int(np.ceil((cell_radius(lattice) + 1.5 * radius + 0.75 * pitch) / step))
    axis = step * np.arange(-count, count + 1, dtype=np.float64)
    fine = step / FINER * np.arange(-count * FINER, count * FINER + 1, dtype=np.float64)
    smaller, usual = (_sums(_with_derivatives(_share(lattice, fine, r), fine)) for r in (SMALLER_BALL * radius, radius))
    table = np.stack([_mean_over(smaller, axis, fine, 0.0), *(_mean_over(usual, axis, fine, side) for side in sides)])
    lacking = 12.0 * BALL_VARIANCE * (1.0 - SMALLER_BALL**2) * radius**2
    return CellShares(table, np.array([-lacking, *sides**2]), step, radius)


def _with_derivatives(share: Floats, axis_mm: Floats) -> list[Floats]:
    """Return the columns of the table for shares on an axis."""
    step = axis_mm[1] - axis_mm[0]
    by_v, by_u = np.gradient(share, step)
    by_uv, by_uu = np.gradient(by_u, step)
    return [share, by_u, by_v, by_uu, by_uv, np.gradient(by_v, step, axis=0)]


def _sums(values: list[Floats]) -> Floats:
    """Return the sums (m + 1, m + 1, columns) of values (m, m) over the points before each along both axes."""
    return np.pad(np.stack(values, axis=-1), ((1, 0), (1, 0), (0, 0))).cumsum(axis=0).cumsum(axis=1)


def _mean_over(sums: Floats, axis: Floats, fine: Floats, side: float) -> Floats:
    """Return the means (n, n, columns) over squares of that side around the points of an axis, from a fine one's sums.

    Each fine point has the interval around it; the least square is one such interval.
    """
    step = fine[1] - fine[0]
    side = max(side, step)
    for _ in range(2):
        ends = (np.clip((axis + half - fine[0]) / step + 0.5, 0.0, fine.size) for half in (-0.5 * side, 0.5 * side))
        below, above = (_between(sums, at) for at in ends)
        sums = ((above - below) * (step / side)).swapaxes(0, 1)
    return sums


def _between(sums: Floats, at: Floats) -> Floats:
    """Return values between those of the first axis, by lines."""
    first = np.minimum(at.astype(np.int64), len(sums) - 2)
    share = (at - first)[:, np.newaxis, np.newaxis]
    return sums[first] * (1.0 - share) + sums[first + 1] * share


def _share(lattice: Lattice, axis_mm: Floats, radius_mm: float) -> Floats:
    """Return the share (n, n) of a ball's light inside the cell, index [v, u] of its centre.

    The ball is cut into chords along u; where each enters and leaves the cell is known, and so is its light between.
    """
    eta, weight = np.polynomial.legendre.leggauss(CHORDS)
    light = 0.75 * weight * (1.0 - eta**2)
    half = radius_mm * np.sqrt(1.0 - eta**2)
    # Further away the ball is outside.
    near = np.abs(axis_mm) < cell_radius(lattice) + radius_mm
    height = axis_mm[near, np.newaxis] + radius_mm * eta
    low, high = np.full(height.shape, -np.inf), np.full(height.shape, np.inf)
    for a, b in neighbours(lattice):
        rest = 0.5 * (a * a + b * b) - b * height
        if abs(a) <= 1e-12 * abs(b):
            high = np.where(rest < 0.0, -np.inf, high)
        elif a > 0.0:
            high = np.minimum(high, rest / a)
        else:
            low = np.maximum(low, rest / a)
    high = np.maximum(high, low)
    u = axis_mm[near, np.newaxis]
    # The cell is the same turned by half a turn, and so is the axis.
    rows = [
        (_below((b - u) / half) - _below((a - u) / half)) @ light
        for a, b in zip(low[: u.size // 2 + 1], high[: u.size // 2 + 1], strict=True)
    ]
    return np.pad(np.stack(rows + [row[::-1] for row in rows[-2::-1]]), (axis_mm.size - u.size) // 2)


def _below(t: Floats) -> Floats:
    """Return the share of a chord's light on its part below t, from -1 to 1 along it."""
    t = np.clip(t, -1.0, 1.0)
    return np.asarray(0.5 + (t * np.sqrt(1.0 - t * t) + np.arcsin(t)) / np.pi)


@njit(cache=True, **COUNT_NO_REFERENCES)
def level_at(square_mm2: float, side2_mm2: Floats) -> tuple[int, float]:
    """Return the table's level below a patch's side squared and the share of the next one."""
    level = 0
    square = min(max(square_mm2, side2_mm2[0]), side2_mm2[-1])
    while level < side2_mm2.size - 2 and side2_mm2[level + 1] < square:
        level += 1
    return level, (square - side2_mm2[level]) / (side2_mm2[level + 1] - side2_mm2[level])


@njit(cache=True, **COUNT_NO_REFERENCES)
def share_at(
    u: float, v: float, low: Floats, high: Floats, blend: float, step: float
) -> tuple[float, float, float, float, float, float]:
    """Return the share, its first and its second derivatives for a ball centred at (u, v).

    Parameters
    ----------
    low, high : (n, n, 6) two levels of the table
    blend : share of the second
    """
    middle = low.shape[0] // 2
    i, j = int(np.rint(u / step)) + middle, int(np.rint(v / step)) + middle
    if not (0 <= i < low.shape[0] and 0 <= j < low.shape[0]):
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    p, q = u - (i - middle) * step, v - (j - middle) * step
    a, b = low[j, i], high[j, i]
    by_uu = a[BY_UU] + blend * (b[BY_UU] - a[BY_UU])
    by_uv = a[BY_UV] + blend * (b[BY_UV] - a[BY_UV])
    by_vv = a[BY_VV] + blend * (b[BY_VV] - a[BY_VV])
    at_u = a[BY_U] + blend * (b[BY_U] - a[BY_U])
    at_v = a[BY_V] + blend * (b[BY_V] - a[BY_V])
    by_u, by_v = at_u + by_uu * p + by_uv * q, at_v + by_uv * p + by_vv * q
    share = a[SHARE] + blend * (b[SHARE] - a[SHARE]) + 0.5 * ((at_u + by_u) * p + (at_v + by_v) * q)
    return share, by_u, by_v, by_uu, by_uv, by_vv
