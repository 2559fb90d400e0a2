"""Vectors on the grid of the interrogation windows, from the tracks of particles instead of a correlation.

Axes: arrays [z, y, x], components (u, v, w) along (x, y, z) last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.flow.correlation import SMALLEST_VALID_FRACTION
from lfpiv_cli.flow.field import MASKED, REJECTED, VALID, VectorField
from lfpiv_cli.flow.windows import Triple, Walls, layout_windows
from lfpiv_cli.grid import Grid
from lfpiv_cli.tracks.gridding import on_grid

# A vector needs its twelve nearest tracks within this many windows of its centre: in sparse images tracks are further
# apart than windows, and what a wide fit misses of the flow is in the stated error.
REACH_WINDOWS = 2.0
# A vector lies in a region without tracers where so many tracks would be expected nearer than the nearest one is: by
# chance alone one vector in a million would; where half of the tracers are found, one in a thousand.
EXPECTED_TRACKS = 14.0
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


def vectors_from_paths(paths: Paths, windows: WindowGrid, dt_s: float | None) -> VectorField:
    """Return the vectors at the centres of windows; what only a correlation knows is NaN."""
    grid, voxel_mm = windows.centres, windows.volume.spacing_mm
    nodes = grid.centres_mm()
    reach = REACH_WINDOWS * max(n * d for n, d in zip(windows.size, voxel_mm, strict=True))
    values, errors = on_grid(paths.middle_mm, paths.displacement_mm, paths.sigma_mm, nodes.reshape(-1, 3), reach)
    inside = windows.inside()
    masked = inside < SMALLEST_VALID_FRACTION
    displacement = np.where(masked[..., np.newaxis], np.nan, values.reshape(nodes.shape) / voxel_mm)
    displacement[without_tracks(paths.middle_mm, nodes.reshape(-1, 3), windows).reshape(masked.shape)] = np.nan
    found = np.isfinite(displacement).all(axis=-1)
    unknown = np.full(found.shape, np.nan)
    return VectorField(
        grid=grid,
        displacement_voxel=displacement,
        displacement_raw_voxel=displacement,
        correlation=unknown,
        peak_ratio=unknown,
        valid_fraction=np.where(found | masked, inside, 0.0),
        flag=np.where(masked, MASKED, np.where(found, VALID, REJECTED)).astype(np.uint8),
        uncertainty_voxel=errors.reshape(nodes.shape) / voxel_mm,
        voxel_mm=voxel_mm,
        dt_s=dt_s,
        window_voxel=windows.size,
    )


def without_tracks(middle_mm: Floats, nodes_mm: Floats, windows: WindowGrid) -> NDArray[np.bool_]:
    """Return which nodes (m,) lie in a region without tracks, where tracks elsewhere are as dense as they are.

    A fit to the nearest tracks would only extend what the flow does beside the region. Nearness is counted in boxes of
    the windows' proportions, as far as these lie in the volume and between the walls.
    """
    if len(middle_mm) <= DENSITY_NEIGHBOURS:
        return np.ones(len(nodes_mm), dtype=np.bool_)
    low, high = np.array([windows.volume.bounds_mm(axis) for axis in range(3)]).T
    side_mm, walls = windows.sides_mm, windows.walls

    def volume_around(points_mm: Floats, reach: Floats) -> Floats:
        """Return the volume, mm^3, of boxes that reach so many windows far to each side."""
        half = reach[:, np.newaxis] * side_mm
        first, last = np.maximum(points_mm - half, low), np.minimum(points_mm + half, high)
        if walls is not None:
            return walls.volumes_mm3(first, last)
        return np.asarray(np.prod(np.maximum(last - first, 0.0), axis=1))

    tree = KDTree(middle_mm / side_mm)
    # Its own place is each track's nearest.
    sixth = tree.query(middle_mm / side_mm, k=[DENSITY_NEIGHBOURS + 1], p=np.inf)[0][:, 0]
    around = volume_around(middle_mm, sixth)
    density = np.median(DENSITY_NEIGHBOURS / around[around > 0.0])
    nearest = tree.query(nodes_mm / side_mm, p=np.inf)[0]
    return np.asarray(density * volume_around(nodes_mm, nearest) > EXPECTED_TRACKS)
