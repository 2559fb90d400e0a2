"""A small piece of the paper's camera before its channel, so that a measurement takes seconds, and wrong ideas of it.

The lenses, pixels and tracers are the paper's, the sensor sees some 24 by 24 microlenses. Images are made of the rig as
it is, by Snell's law; places are measured with the rig as somebody believes it to be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import Channel, advised_move_mm, mid_plane_z_mm
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import Refraction
from lfpiv_cli.optics.camera import Camera, Lattice, refocused
from lfpiv_cli.optics.media import Media, channel_window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.rounds import ROUNDS, Round, find_particles
from lfpiv_cli.particles.search import task_of
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.equations import normalisers
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.reference import Reference
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.synthetic.render import Balls, render_points
from lfpiv_cli.synthetic.scenes import Misalignment
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.validation.volume import DEPTH_VOXEL, LATERAL_VOXEL, Matches, match
from lfpiv_cli.weights.build import default_padding, factorise, factorise_through
from lfpiv_cli.weights.model import Weights

# Tracers in a channel, photographed by a camera as it is and found with the camera as it is believed to be.
#
# Axes: (x, y, z) in mm, z away from the camera from where the channel's mid plane is (or is believed to be).

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
    light_counts: Floats
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


# Errors of measured places as a map of space: shifted, stretched, turned, slanted, twisted, and what is left.
#
# With e = measured - true at the true place (x, y, z), z from where depth is counted,
#
#     e_k = b_k + B_kx x + B_ky y + B_kz z + C_kx x z + C_ky y z
#
# is fitted for each component k, without outliers. A velocity is a difference of places, so that 1 + B is also what
# happens to velocities: B_zz is the relative error of w, B_xz the share of w that leaks into u.
#
# Axes: points (n, 3), x, y, z in mm.

# Depths may be wrong by so many times what lateral places may: an error of the focal plane is one of depth alone.
DEPTH_TO_LATERAL_GATE = 40.0
# Errors so many robust standard deviations from the fit are other tracers, or another depth that explains the light as
# well; looked for so many times.
OUTLIER_SIGMAS, OUTLIER_ROUNDS = 5.0, 3
TERMS, FEWEST = 6, 10


@dataclass(frozen=True, eq=False)
class PlaceErrors:
    """The fitted map.

    Attributes
    ----------
    coefficients, sigma : (6, 3) b, B_x, B_y, B_z, C_x, C_y of each component, and standard errors
    spread_mm : (3,) standard deviation of what is left
    count : of the tracers fitted
    """

    coefficients: Floats
    sigma: Floats
    spread_mm: Floats
    count: int

    def figures(self) -> dict[str, float]:
        """Return the figures by name, lengths in mm, stretches and angles as ratios (twist: per mm of depth)."""
        return self._named(self.coefficients, np.subtract) | {
            f"spread_{name}": float(value) for name, value in zip("xyz", self.spread_mm, strict=True)
        }

    def standard_errors(self) -> dict[str, float]:
        """Return the standard errors of the same figures."""
        return self._named(self.sigma, np.hypot) | {
            f"spread_{name}": float(value / np.sqrt(2.0 * max(self.count, 1)))
            for name, value in zip("xyz", self.spread_mm, strict=True)
        }

    @staticmethod
    def _named(table: Floats, combine: np.ufunc) -> dict[str, float]:
        """Return a table's entries by name; `combine` takes the two halves of a turn."""
        offset, along, twist = table[0], table[1:4], table[4:]
        named = {f"offset_{name}": offset[axis] for axis, name in enumerate("xyz")}
        named |= {f"stretch_{name}": along[axis, axis] for axis, name in enumerate("xyz")}
        named |= {"slant_x": along[2, 0], "slant_y": along[2, 1]}
        named |= {"turn": 0.5 * combine(along[0, 1], along[1, 0]), "twist": 0.5 * combine(twist[0, 1], twist[1, 0])}
        return {name: float(value) for name, value in named.items()}


def pairs_of(measured_mm: Points, true_mm: Points, gate_mm: float) -> Matches:
    """Pair measured with true tracers that stand apart: nearest first, laterally within a gate, nearly any depth.

    Errors are returned in mm.
    """
    scale = np.array([1.0, 1.0, DEPTH_VOXEL / LATERAL_VOXEL / DEPTH_TO_LATERAL_GATE])
    found = match(measured_mm * scale, true_mm * scale, gate_mm / LATERAL_VOXEL)
    return Matches(found.found, found.true, measured_mm[found.found] - true_mm[found.true])


def fit_errors(true_mm: Points, error_mm: Points) -> PlaceErrors:
    """Fit the map to errors (n, 3) at true places (n, 3); NaN where there are hardly more of them than terms."""
    if len(true_mm) < FEWEST:
        unknown = np.full((TERMS, 3), np.nan)
        return PlaceErrors(unknown, unknown, unknown[0], 0)
    x, y, z = true_mm.T
    design = np.stack([np.ones_like(x), x, y, z, x * z, y * z], axis=1)
    kept = np.ones(len(x), dtype=bool)
    for _ in range(OUTLIER_ROUNDS):
        coefficients = np.linalg.lstsq(design[kept], error_mm[kept], rcond=None)[0]
        left = np.abs(error_mm - design @ coefficients)
        width = MAD_TO_SIGMA * np.median(left[kept], axis=0)
        kept = np.all(left <= OUTLIER_SIGMAS * width, axis=1)
    coefficients = np.linalg.lstsq(design[kept], error_mm[kept], rcond=None)[0]
    left, count = (error_mm - design @ coefficients)[kept], int(kept.sum())
    spread = np.sqrt(np.sum(left**2, axis=0) / max(count - TERMS, 1))
    scatter = np.sqrt(np.diag(np.linalg.pinv(design[kept].T @ design[kept])))
    return PlaceErrors(coefficients, scatter[:, np.newaxis] * spread, spread, count)


@dataclass(frozen=True)
class Line:
    """A straight line through measured points."""

    slope: float
    offset: float


def straight_line(x: Floats, y: Floats) -> Line:
    """Fit a straight line to the points that are known; NaN where there are not two."""
    known = np.isfinite(y)
    if np.count_nonzero(known) < 2:
        return Line(np.nan, np.nan)
    offset, slope = np.polynomial.polynomial.polyfit(x[known], y[known], 1)
    return Line(float(slope), float(offset))


Points = Floats
Figures = dict[str, float]

FOCAL_LENGTH_MM, PITCH_MM, PIXEL_MM = 100.0, 0.1, 0.0055
F_NUMBER = 4.0
SENSOR_PX = 448
WATER = Media(1.0, 1.49, 1.33)
CHANNEL = Channel(10.0, 5.0)
# Counts of a tracer's light: 2.5e5 photons, some 1,900 counts in a lit pixel.
LIGHT_COUNTS = 5e5
BRIGHTNESS = (0.6, 1.4)
# Tracers stand apart by this much, so that each measured place has one true one whatever is wrong, in this square and
# between these depths: within the channel, and light stays on the sensor.
APART_MM, JITTER_MM, HALF_WIDTH_MM, HALF_DEPTH_MM = 0.3, 0.05, 0.9, 4.0
# Lateral errors up to this leave no doubt about which tracer it is.
GATE_MM = 0.09
# Beside the tracers, what is searched is this much wider.
MARGIN_MM = 0.2


def sheet(f_number: float = F_NUMBER, pixels: int = SENSOR_PX) -> Camera:
    """Return the camera of the data sheet; the microlenses follow the f-number, so that lens images touch."""
    aperture = FOCAL_LENGTH_MM / f_number
    distance = PITCH_MM * 2.0 * FOCAL_LENGTH_MM / aperture
    lattice = Lattice.regular(PITCH_MM)
    return Camera(-1.0, FOCAL_LENGTH_MM, aperture, distance, distance, lattice, PIXEL_MM, pixels, pixels)


@dataclass(frozen=True, eq=False)
class Case:
    """A rig as it is and as it is believed to be, and how deep around the middle of the channel is looked."""

    true: Rig
    believed: Rig
    search_depth_mm: float = 2.0 * HALF_DEPTH_MM + 1.0


def rig(camera: Camera, media: Media = WATER, channel: Channel = CHANNEL, refraction: Refraction = "exact") -> Rig:
    """Return a rig focused on the middle of its channel."""
    return Rig(camera, media, channel, 0.0, refraction)


def aimed(true: Rig, believed: Rig, search_depth_mm: float = 2.0 * HALF_DEPTH_MM + 1.0) -> Case:
    """Return the case in which the camera was moved by what Eq. 21 advises from what is believed."""
    move = advised_move_mm(BOARD, believed.channel, believed.media)
    return Case(replace(true, channel=replace(true.channel, camera_move_mm=move)), believed, search_depth_mm)


def index_wrong(fluid: float) -> Case:
    """Return water taken for a fluid of another index."""
    camera = sheet()
    return aimed(rig(camera), rig(camera, Media(WATER.air, WATER.window, fluid)))


def wall_wrong(by_mm: float) -> Case:
    """Return a wall taken to be thicker than it is."""
    camera = sheet()
    return aimed(rig(camera), rig(camera, channel=replace(CHANNEL, wall_mm=CHANNEL.wall_mm + by_mm)))


def focus_wrong(by_mm: float) -> Case:
    """Return a lens whose plane of focus is taken to be farther away than it is, by so much in air.

    The believed plane is brought to the middle of the channel.
    """
    camera = sheet()
    focal, distance = camera.focal_length_mm, camera.focus_distance_mm - by_mm
    real = refocused(camera, -focal / (distance - focal))
    believed = camera.with_micro_images(real.micro_image_lattice_px())
    deeper = abs(by_mm) * WATER.fluid / WATER.air
    return Case(Rig(real, WATER, CHANNEL, by_mm), rig(believed), 2.0 * (HALF_DEPTH_MM + deeper))


def lattice_shifted(by_px: float) -> Case:
    """Return lens images taken to lie further along the columns than they do."""
    camera = sheet()
    return Case(rig(Misalignment(shift_px=(-by_px, 0.0)).apply(camera)), rig(camera))


def lattice_turned(by_deg: float) -> Case:
    """Return lens images taken to be turned further than they are, from the columns towards the rows."""
    camera = sheet()
    return Case(rig(Misalignment(rotation_deg=-by_deg).apply(camera)), rig(camera))


def strewn_apart(rng: np.random.Generator, depth_mm: tuple[float, float], half_width_mm: float) -> Tracers:
    """Return tracers that stand apart laterally, at any depth between two."""
    line = np.arange(-half_width_mm + 0.5 * APART_MM, half_width_mm, APART_MM)
    lateral = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    lateral += rng.uniform(-JITTER_MM, JITTER_MM, lateral.shape)
    position = np.column_stack([lateral, rng.uniform(*depth_mm, len(lateral))])
    return Tracers(position, LIGHT_COUNTS * rng.uniform(*BRIGHTNESS, len(position)))


def place_figures(case: Case, tracers: Tracers, readout: Readout, rng: np.random.Generator) -> Figures:
    """Return the figures of the map from true to measured places, and the shares of tracers found and of those true.

    The map is NaN where too few are found to know it.
    """
    image = photograph(case.true, tracers, readout, rng)
    return judged(search_of(case).particles(image), tracers)


def search_of(case: Case) -> Search:
    """Return the search of a case, somewhat wider than tracers stand."""
    width = 2.0 * (HALF_WIDTH_MM + MARGIN_MM)
    return Search(case.believed, (width, width, case.search_depth_mm))


def judged(found: Points, tracers: Tracers) -> Figures:
    """Return the figures of measured places (n, 3) of tracers that stand apart."""
    pairs = pairs_of(found, tracers.position_mm, GATE_MM)
    shares = {
        "recall": len(pairs.true) / len(tracers.position_mm),
        "precision": len(pairs.found) / max(len(found), 1),
    }
    return fit_errors(tracers.position_mm[pairs.true], pairs.error_voxel).figures() | shares
