"""Where the correlation windows lie in a volume.

Axes: triples are ordered (x, y, z). Positions are voxel indices; voxel k covers k - 0.5 to k + 0.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from math import gcd
from typing import Literal

import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid

# Where there is fluid, and vectors can be measured: between the walls of a channel, or in a round pipe.
#
# Axes: points and sides (x, y, z) in mm, arrays [z, y, x]. The kinds of `Walls` have the same methods.

# Pipes that are tilted further from x or y are other pipes than `RoundWall` knows.
LARGEST_TILT_DEG = 5.0


@dataclass(frozen=True)
class ParallelWalls:
    """Two walls across z, half the width from z = 0, the channel's mid plane."""

    width_mm: float

    def contain(self, points_mm: Floats) -> Flags:
        """Return which points (..., 3) lie between the walls or on them."""
        return np.asarray(np.abs(points_mm[..., 2]) <= 0.5 * self.width_mm)

    def shares(self, centres_mm: Floats, sides_mm: Floats) -> Floats:
        """Return the share (...) of the depth of boxes with sides (3,) about centres (..., 3) between the walls."""
        z, half, wall = centres_mm[..., 2], 0.5 * sides_mm[2], 0.5 * self.width_mm
        return np.clip(np.minimum(z + half, wall) - np.maximum(z - half, -wall), 0.0, None) / sides_mm[2]

    def volumes_mm3(self, low_mm: Floats, high_mm: Floats) -> Floats:
        """Return the volume (...) between the walls of boxes from one corner (..., 3) to the other."""
        wall = np.array([np.inf, np.inf, 0.5 * self.width_mm])
        return np.asarray(np.prod(np.maximum(np.minimum(high_mm, wall) - np.maximum(low_mm, -wall), 0.0), axis=-1))

    def points(self, low_mm: Floats, high_mm: Floats, step_mm: Floats) -> Floats:
        """Return points (k, 3) on those walls that a box holds, at most a step (3,) apart."""
        along = [spaced(low_mm[axis], high_mm[axis], step_mm[axis]) for axis in range(2)]
        depths = [z for z in (-0.5 * self.width_mm, 0.5 * self.width_mm) if low_mm[2] <= z <= high_mm[2]]
        return np.stack(np.meshgrid(*along, np.asarray(depths), indexing="ij"), axis=-1).reshape(-1, 3)


@dataclass(frozen=True)
class RoundWall:
    """The inside of a round pipe along `axis` through its centre (x, y, z).

    The axis is x, y or a direction of any length near one of them: sections across x or y are taken for circles, which
    at `LARGEST_TILT_DEG` makes boxes 0.4 % too small.
    """

    radius_mm: float
    centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: Literal["x", "y"] | tuple[float, float, float] = "x"

    @property
    def direction(self) -> Floats:
        """Unit vector (3,) along the pipe."""
        if isinstance(self.axis, str):
            return np.eye(3)["xy".index(self.axis)]
        return np.asarray(np.array(self.axis) / np.linalg.norm(self.axis))

    @property
    def along(self) -> int:
        """The axis that the pipe follows, or nearly, 0 for x."""
        return int(np.abs(self.direction[1]) > np.abs(self.direction[0]))

    @property
    def tilt_deg(self) -> float:
        """How far the pipe is tilted from the axis that it nearly follows."""
        return float(np.rad2deg(np.arccos(min(1.0, abs(self.direction[self.along])))))

    def distances_mm(self, points_mm: Floats) -> Floats:
        """Return the distance (...) of points (..., 3) from the pipe's axis."""
        relative, direction = points_mm - np.asarray(self.centre_mm), self.direction
        return np.asarray(np.linalg.norm(relative - (relative @ direction)[..., np.newaxis] * direction, axis=-1))

    def contain(self, points_mm: Floats) -> Flags:
        """Return which points (..., 3) lie in the pipe or on its wall."""
        return np.asarray(self.distances_mm(points_mm) <= self.radius_mm)

    def shares(self, centres_mm: Floats, sides_mm: Floats) -> Floats:
        """Return the share (...) of boxes with sides (3,) about centres (..., 3) that lies in the pipe."""
        half = 0.5 * sides_mm
        return self.volumes_mm3(centres_mm - half, centres_mm + half) / np.prod(sides_mm)

    def volumes_mm3(self, low_mm: Floats, high_mm: Floats) -> Floats:
        """Return the volume (...) in the pipe of boxes from one corner (..., 3) to the other, 0 of empty ones."""
        high = np.maximum(low_mm, high_mm)
        middle = self._axis_at(0.5 * (low_mm + high)[..., self.along])
        first, second = (
            np.moveaxis((corner - middle)[..., self._across] / self.radius_mm, -1, 0) for corner in (low_mm, high)
        )
        x0, y0, x1, y1 = *first, *second
        corners = [_from_origin(x1, y1), _from_origin(x0, y0), _from_origin(x1, y0), _from_origin(x0, y1)]
        area = np.maximum(corners[0] + corners[1] - corners[2] - corners[3], 0.0) * self.radius_mm**2
        return np.asarray(area * (high - low_mm)[..., self.along])

    def points(self, low_mm: Floats, high_mm: Floats, step_mm: Floats) -> Floats:
        """Return points (k, 3) on the wall that a box holds, at most a step (3,) apart."""
        along, others = self.along, self._across
        turns = int(np.ceil(2.0 * np.pi * self.radius_mm / step_mm[others].min()))
        angle = 2.0 * np.pi * np.arange(turns) / turns
        ring = np.zeros((turns, 3))
        ring[:, others] = self.radius_mm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        places = spaced(low_mm[along], high_mm[along], step_mm[along])
        found = (self._axis_at(places)[:, np.newaxis] + ring).reshape(-1, 3)
        return found[np.all((found >= low_mm) & (found <= high_mm), axis=1, where=np.arange(3) != along)]

    @property
    def _across(self) -> list[int]:
        """The two axes across the pipe."""
        return [1 - self.along, 2]

    def _axis_at(self, along_mm: Floats) -> Floats:
        """Return the points (..., 3) of the pipe's axis at places (...) along the axis that it nearly follows."""
        centre, direction = np.asarray(self.centre_mm, dtype=np.float64), self.direction
        share = (np.asarray(along_mm, dtype=np.float64) - centre[self.along]) / direction[self.along]
        points = np.asarray(centre + share[..., np.newaxis] * direction)
        points[..., self.along] = along_mm
        return points


Walls = ParallelWalls | RoundWall


def inside(grid: Grid, walls: Walls) -> Flags:
    """Return the voxels (nz, ny, nx) whose centres lie in the fluid."""
    # plane by plane: the places of all voxels together take more memory than the volume
    plane = Grid((*grid.shape_xyz[:2], 1), grid.spacing_mm, (*grid.origin_mm[:2], 0.0)).centres_mm()[0]
    return np.stack([walls.contain(plane + np.array([0.0, 0.0, z])) for z in grid.axis_mm(2)])


def spaced(low: float, high: float, step: float) -> Floats:
    """Return evenly spaced numbers from one end to the other, at most a step apart."""
    return np.linspace(low, high, int(np.ceil((high - low) / step)) + 1)


def _from_origin(x: Floats, y: Floats) -> Floats:
    """Return the area inside the circle of radius 1 of rectangles from the origin to (x, y), with the sign of x y."""
    width, height = np.minimum(np.abs(x), 1.0), np.minimum(np.abs(y), 1.0)
    # up to here the rectangle's upper side lies in the circle, then the circle bounds it
    bend = np.minimum(np.sqrt(1.0 - height**2), width)
    return np.asarray(np.sign(x) * np.sign(y) * (height * bend + _under_arc(width) - _under_arc(bend)))


def _under_arc(x: Floats) -> Floats:
    """Return the area under the circle from 0 to x."""
    return np.asarray(0.5 * (x * np.sqrt(1.0 - x**2) + np.arcsin(x)))


Triple = tuple[int, int, int]

# A quotient of lengths that should be a whole number may fall short of it by this.
ROUNDING = 1e-9

# The standard deviation of a Gaussian weighting, in sizes of the window: at the middle of a face it is exp(-2). The
# spread of its weights along an axis is 0.22 of the size, that of uniform ones 0.29.
GAUSSIAN_SIGMA = 0.25


def gaussian(offset: Floats) -> Floats:
    """Return the weights of a Gaussian about a window's middle, 1 there; offsets are in sizes of the window."""
    return np.asarray(np.exp(-0.5 * (offset / GAUSSIAN_SIGMA) ** 2))


# How voxels count in what is summed over a window: the weight along one axis by the offset from the window's middle in
# sizes of the window, -0.5 to 0.5. A voxel has the product of its three.
WEIGHTINGS: dict[str, Callable[[Floats], Floats]] = {"uniform": np.ones_like, "gaussian": gaussian}


@dataclass(frozen=True)
class WindowLayout:
    """A regular arrangement of equal windows; window k along an axis covers voxels first + k step ... + size - 1.

    Windows may overhang the volume: `first` is then negative. Their voxels count by a `weighting` of `WEIGHTINGS`.
    """

    size: Triple
    step: Triple
    count: Triple
    first: Triple
    weighting: str = "uniform"

    @property
    def is_weighted(self) -> bool:
        """Whether voxels of a window count differently."""
        return self.weighting != "uniform"

    def weights(self, axis: int) -> Floats:
        """Return the weights (size,) of a window's voxels along axis 0 (x), 1 (y) or 2 (z)."""
        size = self.size[axis]
        return WEIGHTINGS[self.weighting]((np.arange(size) - 0.5 * (size - 1)) / size)

    def centres_voxel(self, axis: int) -> Floats:
        """Return the window centres along axis 0 (x), 1 (y) or 2 (z) as (fractional) voxel indices."""
        first_centre = self.first[axis] + 0.5 * (self.size[axis] - 1)
        return first_centre + self.step[axis] * np.arange(self.count[axis], dtype=np.float64)

    def grid(self, volume: Grid) -> Grid:
        """Return the grid of the window centres, in mm, for windows in a volume on the grid `volume`."""
        x, y, z = (s * d for s, d in zip(self.step, volume.spacing_mm, strict=True))
        x0, y0, z0 = volume.voxel_to_mm(np.array([self.centres_voxel(axis)[0] for axis in range(3)])).tolist()
        return Grid(self.count, (x, y, z), (x0, y0, z0))


def layout_windows(shape_xyz: Triple, size_xyz: Triple, overlap: tuple[float, float, float]) -> WindowLayout:
    """Return the windows that fill a volume: floor(N / [size (1 - overlap)]) an axis, the remainder split evenly.

    Each window sits in the middle of a cell of `step` voxels, and the cells fill the volume as far as whole cells can.
    The windows therefore overhang the volume where they are larger than their cell.

    Parameters
    ----------
    shape_xyz : voxels of the volume
    size_xyz : voxels of a window
    overlap : share of a window that it has in common with the next one, 0 <= overlap < 1; the step is then rounded to
        whole voxels, or rounded down where so many windows would not fit
    """
    steps, counts, firsts = [], [], []
    for voxels, size, share in zip(shape_xyz, size_xyz, overlap, strict=True):
        exact = size * (1.0 - share)
        count = max(1, math.floor(voxels / exact + ROUNDING))
        # Of whole voxels, and no more than leave all windows' cells inside the volume.
        step = max(1, min(math.floor(exact + 0.5), voxels // count))
        steps.append(step)
        counts.append(count)
        # Doubled, to stay in whole numbers; an odd remainder leaves its last voxel at the far end.
        firsts.append(((voxels - count * step) + step - size) // 2)
    return WindowLayout(size_xyz, triple(steps), triple(counts), triple(firsts))


def triple(values: Iterable[int]) -> Triple:
    """Return three numbers as a triple, which a tuple of any length is not for the type checker."""
    x, y, z = values
    return x, y, z


# Blocks narrower than this cost more in sums of sums than the products they save.
SMALLEST_BLOCK = 4
# Cells along an axis of a window, at least, where it has as many voxels: groups enough for a variance.
CELLS_PER_WINDOW = 4

Starts = tuple[Integers, Integers, Integers]


@dataclass(frozen=True, eq=False)
class Cells:
    """How the windows of one layout are made of cells, along (z, y, x).

    Cell k along an axis covers `size[k]` voxels from `start[k]` on, counted from the first window's first voxel; window
    k is the sum of cells k hop ... k hop + per_window - 1.
    """

    start: Starts
    size: Starts
    per_window: Triple
    hop: Triple


def cells_of(layout: WindowLayout, least: int = CELLS_PER_WINDOW, alone: Sequence[int] = ()) -> Cells:
    """Return the cells that make up the windows, axis by axis.

    Windows share cells of their step's and size's common divisor, or parts of these; where it is small or windows are
    weighted, and along the axes `alone` of (z, y, x), each window has cells of its own. A window has `least` along each
    axis, or its voxels.
    """
    starts, sizes, per_window, hops = [], [], [], []
    for axis, (size, step, count) in enumerate(zip(layout.size, layout.step, layout.count, strict=True)):
        shared = gcd(size, step)
        if shared < SMALLEST_BLOCK or step >= size or layout.is_weighted or 2 - axis in alone:
            length, stride, blocks, hop = size, step, count, 1
        else:
            length, stride, blocks, hop = shared, shared, ((count - 1) * step + size) // shared, step // shared
        parts = min(length, -(-least * length // size))
        edges = np.arange(parts + 1) * length // parts
        starts.append((stride * np.arange(blocks)[:, np.newaxis] + edges[:-1]).ravel())
        sizes.append(np.tile(np.diff(edges), blocks))
        per_window.append(parts * (size // length))
        hops.append(parts * hop)
    (x, y, z), (width, height, depth) = starts, sizes
    return Cells((z, y, x), (depth, height, width), triple(per_window[::-1]), triple(hops[::-1]))


@dataclass(frozen=True)
class CorrelationSettings:
    """How two volumes are correlated.

    Attributes
    ----------
    windows : sizes of the interrogation windows in voxels along (x, y, z), coarse to fine; the last gives the vectors
    overlap : share of a window in common with the next one along (x, y, z), 0 <= overlap < 1
    dt_s : time from the first volume to the second, or None where it is not known
    exponent : power of the intensities that is correlated, 0 < exponent <= 1, negative ones being zero where it is
        below 1. In volumes of a solver that sharpens, as EM does, the brightest particles outweigh all others and are
        narrower than a voxel: the root lets the others speak and makes peaks wide enough to be located. In volumes with
        a noisy background it raises that, and harms.
    weighting : how voxels count by their place in a window, of `WEIGHTINGS`
    """

    windows: Sequence[Triple]
    overlap: tuple[float, float, float]
    dt_s: float | None = None
    exponent: float = 1.0
    weighting: str = "uniform"

    def layout(self, shape_xyz: Triple, size_xyz: Triple | None = None) -> WindowLayout:
        """Return windows in a volume of so many voxels: those of a size, or the final ones, which give the vectors.

        Raises
        ------
        ConfigError
            The weighting is none of those that there are.
        """
        if self.weighting not in WEIGHTINGS:
            raise ConfigError(f"the weighting of the windows is {self.weighting}; it must be one of {list(WEIGHTINGS)}")
        layout = layout_windows(shape_xyz, size_xyz or self.windows[-1], self.overlap)
        return replace(layout, weighting=self.weighting)
