"""Tracers in a channel, photographed by a camera as it is and found with the camera as it is believed to be.

Axes: (x, y, z) in mm, z away from the camera from where the channel's mid plane is (or is believed to be).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import Channel, mid_plane_z_mm
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import Refraction
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, channel_window
from lfpiv_cli.particles.rounds import ROUNDS, Round, find_particles
from lfpiv_cli.particles.search import task_of
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.equations import normalisers
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.reference import Reference
from lfpiv_cli.synthetic.render import Balls, ObjectSpace, render_points
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.weights.build import default_padding, factorise, factorise_through
from lfpiv_cli.weights.model import Weights

Points = NDArray[np.float64]
Image = NDArray[np.float32]

# The snapshot of Eq. 21 is of a board without thickness, on the outer wall.
BOARD = BoardGeometry((7, 7), 1.0, 0.2)
# Voxels in which particles are sought before they are fitted: a microlens wide, a quarter of its depth long.
SEARCH_VOXEL_MM = (0.1, 0.1, 0.25)


@dataclass(frozen=True, eq=False)
class Rig:
    """A camera before a channel.

    Attributes
    ----------
    channel : with the move that the camera made after the snapshot of the board (Eq. 21)
    board_z_mm : depth of the board in that snapshot, in air, from the focal plane
    refraction : of the rays: by Snell's law, or paraxial
    """

    camera: Camera
    media: Media
    channel: Channel
    board_z_mm: float = 0.0
    refraction: Refraction = "exact"

    @property
    def reference(self) -> Reference:
        """Where z is counted from: the mid plane that the snapshot tells."""
        return Reference("mid_plane", mid_plane_z_mm(BOARD, self.channel, self.media, self.board_z_mm))

    @property
    def space(self) -> ObjectSpace:
        """What lies before the lens."""
        distance, width, wall = self.camera.focus_distance_mm, self.channel.width_mm, self.channel.wall_mm
        window = channel_window(distance, self.media, width, wall, self.reference.z_mm)
        return ObjectSpace(self.media, window, self.refraction)

    def grid(self, size_mm: tuple[float, float, float], voxel_mm: tuple[float, float, float]) -> Grid:
        """Return voxels around the middle of the channel, z from the focal point as weights have it."""
        nx, ny, nz = (max(1, round(size / voxel)) for size, voxel in zip(size_mm, voxel_mm, strict=True))
        return Grid.centred((nx, ny, nz), voxel_mm, (0.0, 0.0, self.reference.z_mm))


@dataclass(frozen=True, eq=False)
class Tracers:
    """Tracers (n, 3) of a diameter, and the light (n,) of each that passes the main lens, in counts."""

    position_mm: Points
    light_counts: NDArray[np.float64]
    diameter_mm: float = 0.05

    def moved(self, by_mm: Points) -> Tracers:
        """Return the tracers, each (n, 3) moved."""
        return Tracers(self.position_mm + by_mm, self.light_counts, self.diameter_mm)


def photograph(rig: Rig, tracers: Tracers, readout: Readout, rng: np.random.Generator) -> Image:
    """Return the recorded image (rows, columns) of tracers, the dark level taken off."""
    places = rig.reference.points_to_focal_point(tracers.position_mm)
    balls = Balls(places, tracers.light_counts, tracers.diameter_mm)
    recorded = readout.record(render_points(rig.camera, rig.space, balls, rng), rng)
    return recorded.astype(np.float32) - np.float32(readout.dark_level_counts)


@dataclass(frozen=True, eq=False)
class Search:
    """A rig as it is believed to be, and the box (x, y, z) around the middle of its channel in which is measured."""

    rig: Rig
    size_mm: tuple[float, float, float]
    diameter_mm: float = 0.05
    search_voxel_mm: tuple[float, float, float] = SEARCH_VOXEL_MM
    rounds: tuple[Round, ...] = ROUNDS

    @cached_property
    def _weights(self) -> Weights:
        camera, media = self.rig.camera, self.rig.media
        grid = self.rig.grid(self.size_mm, self.search_voxel_mm)
        padding = default_padding(camera, media, grid)
        return Weights(grid, padding, factorise(camera, media, grid.padded(padding)), camera.column_axis)

    def particles(self, image: Image) -> Points:
        """Return the places (n, 3) of the particles behind an image, those a little outside the box as well."""
        rig, weights = self.rig, self._weights
        view = raw_view(rig.camera, rig.media, 0.5 * self.diameter_mm, None, rig.space)
        found = find_particles(task_of(image, view, weights, rig.camera, normalisers(weights.padded)), self.rounds)
        return rig.reference.points_from_focal_point(found.position_mm)

    def volume(
        self, image: Image, voxel_mm: tuple[float, float, float], settings: SolverSettings
    ) -> tuple[NDArray[np.float32], Grid]:
        """Return the volume (z, y, x) behind an image, and its voxels."""
        rig, grid = self.rig, self.rig.grid(self.size_mm, voxel_mm)
        px, py, pz = padding = default_padding(rig.camera, rig.media, grid)
        solved = reconstruct(factorise_through(rig.camera, rig.space, grid.padded(padding)), image, settings)
        (nz, ny, nx), reference = grid.shape_zyx, rig.reference
        inner = solved.volume[pz : pz + nz, py : py + ny, px : px + nx]
        return np.ascontiguousarray(inner), reference.grid_from_focal_point(grid)
