"""A small piece of the paper's camera before its channel, so that a measurement takes seconds, and wrong ideas of it.

The lenses, pixels and tracers are the paper's, the sensor sees some 24 by 24 microlenses. Images are made of the rig as
it is, by Snell's law; places are measured with the rig as somebody believes it to be.

What scatters places and velocities is measured with a camera that is known exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import Channel, advised_move_mm, mid_plane_z_mm
from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.field import REJECTED
from lfpiv_cli.flow.windows import CorrelationSettings
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.names import Refraction
from lfpiv_cli.optics.camera import Camera, Lattice, refocused
from lfpiv_cli.optics.media import Media, channel_window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.rounds import ROUNDS, Round, find_particles
from lfpiv_cli.particles.search import task_of
from lfpiv_cli.particles.view import lens_pixels, raw_view
from lfpiv_cli.reconstruction.solvers import SolverSettings, normalisers, reconstruct
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.synthetic.render import Balls, Readout, render_points
from lfpiv_cli.synthetic.scenes import Misalignment
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.tracking import track
from lfpiv_cli.validation.planning import cramer_rao_bound, expected_image, pixel_variance, slopes
from lfpiv_cli.validation.volume import Matches, fit_errors, match, pairs_of, particle_figures
from lfpiv_cli.weights.build import default_padding, factorise_through
from lfpiv_cli.weights.model import Weights

# Axes: (x, y, z) in mm, z away from the camera from where the channel's mid plane is (or is believed to be).

Image = Singles
Points = Floats
Figures = dict[str, float]

FOCAL_LENGTH_MM, PITCH_MM, PIXEL_MM = 100.0, 0.1, 0.0055
F_NUMBER = 4.0
SENSOR_PX = 448
WATER = Media(1.0, 1.49, 1.33)
CHANNEL = Channel(10.0, 5.0)
# Counts of a tracer's light: 2.5e5 photons, some 1,900 counts in a lit pixel.
LIGHT_COUNTS, DIAMETER_MM = 5e5, 0.05
BRIGHTNESS = (0.6, 1.4)
# Tracers stand apart by this much, so that each measured place has one true one whatever is wrong, in this square and
# between these depths: within the channel, and light stays on the sensor.
APART_MM, JITTER_MM, HALF_WIDTH_MM, HALF_DEPTH_MM = 0.3, 0.05, 0.9, 4.0
# Lateral errors up to this leave no doubt about which tracer it is.
GATE_MM = 0.09
# Beside the tracers, what is searched is this much wider.
MARGIN_MM = 0.2
READOUT = Readout()
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
    media: Media = WATER
    channel: Channel = CHANNEL
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
    """Places (n, 3) of tracers, and the light (n,) of each that passes the main lens, in counts."""

    position_mm: Points
    light_counts: Floats

    def moved(self, by_mm: Points) -> Tracers:
        """Return the tracers, each (n, 3) moved."""
        return Tracers(self.position_mm + by_mm, self.light_counts)


def photograph(rig: Rig, tracers: Tracers, readout: Readout, rng: np.random.Generator) -> Image:
    """Return the recorded image (rows, columns) of tracers, the dark level taken off."""
    places = rig.reference.points_to_focal_point(tracers.position_mm)
    balls = Balls(places, tracers.light_counts, DIAMETER_MM)
    recorded = readout.record(render_points(rig.camera, rig.space, balls, rng), rng)
    return recorded.astype(np.float32) - np.float32(readout.dark_level_counts)


def sheet(f_number: float = F_NUMBER) -> Camera:
    """Return the camera of the data sheet; the microlenses follow the f-number, so that lens images touch."""
    aperture = FOCAL_LENGTH_MM / f_number
    distance = PITCH_MM * 2.0 * FOCAL_LENGTH_MM / aperture
    lattice = Lattice.regular(PITCH_MM)
    return Camera(-1.0, FOCAL_LENGTH_MM, aperture, distance, distance, lattice, PIXEL_MM, SENSOR_PX, SENSOR_PX)


# Where tracers that stand apart are sought: somewhat wider than they stand.
WIDTH_MM, DEPTH_MM = 2.0 * (HALF_WIDTH_MM + MARGIN_MM), 2.0 * HALF_DEPTH_MM + 1.0


@dataclass(frozen=True, eq=False)
class Case:
    """A rig as it is and as it is believed to be, by which particles are sought.

    Attributes
    ----------
    size_mm : of the box (x, y, z) around the middle of the believed channel in which is looked
    voxel_mm : in which particles are sought before they are fitted
    """

    true: Rig
    believed: Rig
    size_mm: tuple[float, float, float] = (WIDTH_MM, WIDTH_MM, DEPTH_MM)
    voxel_mm: tuple[float, float, float] = SEARCH_VOXEL_MM
    rounds: tuple[Round, ...] = ROUNDS

    @cached_property
    def _weights(self) -> Weights:
        rig = self.believed
        return Weights.factorised(rig.camera, rig.media, rig.grid(self.size_mm, self.voxel_mm))

    def particles(self, image: Image) -> Points:
        """Return the places (n, 3) of the particles behind an image, those a little outside the box as well."""
        rig, weights = self.believed, self._weights
        view = raw_view(rig.camera, rig.media, 0.5 * DIAMETER_MM, None, rig.space)
        found = find_particles(task_of(image, view, weights, rig.camera, normalisers(weights.padded)), self.rounds)
        return rig.reference.points_from_focal_point(found.position_mm)


def aimed(believed: Rig) -> Case:
    """Return the case in which the camera was moved by what Eq. 21 advises from what is believed."""
    move = advised_move_mm(BOARD, believed.channel, believed.media)
    return Case(Rig(sheet(), channel=replace(CHANNEL, camera_move_mm=move)), believed)


def index_wrong(fluid: float) -> Case:
    """Return water taken for a fluid of another index."""
    return aimed(Rig(sheet(), Media(WATER.air, WATER.window, fluid)))


def wall_wrong(by_mm: float) -> Case:
    """Return a wall taken to be thicker than it is."""
    return aimed(Rig(sheet(), channel=replace(CHANNEL, wall_mm=CHANNEL.wall_mm + by_mm)))


def focus_wrong(by_mm: float) -> Case:
    """Return a lens whose plane of focus is taken to be farther away than it is, by so much in air.

    The believed plane is brought to the middle of the channel.
    """
    camera = sheet()
    focal, distance = camera.focal_length_mm, camera.focus_distance_mm - by_mm
    real = refocused(camera, -focal / (distance - focal))
    believed = camera.with_micro_images(real.micro_image_lattice_px())
    deeper = abs(by_mm) * WATER.fluid / WATER.air
    depth = 2.0 * (HALF_DEPTH_MM + deeper)
    return Case(Rig(real, board_z_mm=by_mm), Rig(believed), (WIDTH_MM, WIDTH_MM, depth))


def lattice_shifted(by_px: float) -> Case:
    """Return lens images taken to lie further along the columns than they do."""
    camera = sheet()
    return Case(Rig(Misalignment(shift_px=(-by_px, 0.0)).apply(camera)), Rig(camera))


def lattice_turned(by_deg: float) -> Case:
    """Return lens images taken to be turned further than they are, from the columns towards the rows."""
    camera = sheet()
    return Case(Rig(Misalignment(rotation_deg=-by_deg).apply(camera)), Rig(camera))


def strewn_apart(rng: np.random.Generator, depth_mm: tuple[float, float] = (-HALF_DEPTH_MM, HALF_DEPTH_MM)) -> Tracers:
    """Return tracers that stand apart laterally, at any depth between two."""
    line = np.arange(-HALF_WIDTH_MM + 0.5 * APART_MM, HALF_WIDTH_MM, APART_MM)
    lateral = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    lateral += rng.uniform(-JITTER_MM, JITTER_MM, lateral.shape)
    position = np.column_stack([lateral, rng.uniform(*depth_mm, len(lateral))])
    return Tracers(position, LIGHT_COUNTS * rng.uniform(*BRIGHTNESS, len(position)))


def place_figures(case: Case, tracers: Tracers, rng: np.random.Generator, readout: Readout = READOUT) -> Figures:
    """Return the figures of the map from true to measured places, and the shares of tracers found and of those true.

    The map is NaN where too few are found to know it.
    """
    return judged(case.particles(photograph(case.true, tracers, readout, rng)), tracers)


def judged(found: Points, tracers: Tracers) -> Figures:
    """Return the figures of measured places (n, 3) of tracers that stand apart."""
    pairs = pairs_of(found, tracers.position_mm, GATE_MM)
    figures, _ = fit_errors(tracers.position_mm[pairs.true], pairs.error_voxel)
    return figures | found_shares(pairs, found, tracers)


def found_shares(pairs: Matches, found: Points, tracers: Tracers) -> Figures:
    """Return the shares of the tracers that were found, and of what was found that is true."""
    counts = {"recall": len(tracers.position_mm), "precision": max(len(found), 1)}
    return {name: len(pairs.found) / count for name, count in counts.items()}


# What scatters places and velocities: aperture, noise, depth and the number of tracers, the camera known exactly.

# Table 2's tank: the focal plane 134 mm deep in water, behind 2 mm of acrylic 98 mm from the lens.
TANK = Channel(2.0 * 133.867, 2.0)
# Room for tracers up to 10 mm before and behind the focal plane.
WIDE_CHANNEL = Channel(25.0, 5.0)
BAND_MM = 0.25
# A crowded scene fills the paper's channel but for what tracers move, and reaches so far beyond what the sensor sees.
CROWD_DEPTH_MM, BEYOND_MM = 9.6, 0.15
# Displacement of a tracer at (x, y, z): (0.13 + 0.01 z, 0.07, 0.2 + 0.1 x), mm.
UNIFORM_MM, DEPTH_SHEAR, LATERAL_SHEAR = (0.13, 0.07, 0.2), 0.01, 0.1
SEARCH_MM = 0.6
# As benchmarks of the correlation have it: voxels of a third of a microlens, accelerated EM.
VOXEL_MM, WINDOW_VOXELS, EXPONENT = (0.1 / 3.0, 0.1 / 3.0, 0.2), (24, 24, 8), 0.5
CROWD_VOXEL_MM = (0.1, 0.1, 0.1)
EM = SolverSettings("em", 24)


def at_f_number(f_number: float, seed: int) -> Figures:
    """Return the figures behind the paper's tank, rays taken as they are (exact) and as paraxial ones."""
    rng = np.random.default_rng([seed, 2])
    exact = Rig(sheet(f_number), WATER, TANK)
    tracers = strewn_apart(rng)
    image = photograph(exact, tracers, READOUT, rng)
    figures: Figures = {}
    for name, seen in (("exact", exact), ("paraxial", replace(exact, refraction="paraxial"))):
        places = judged(Case(exact, seen).particles(image), tracers)
        figures |= {f"{name}_{figure}": value for figure, value in places.items()}
    return figures


def spherical_aberration_mm(f_number: float) -> float:
    """Return how much nearer paraxial rays see what lies in the middle of the tank, to third order.

    A layer t of index n moves a ray of slope u sideways by t (u/n) (1 - (1 - 1/n^2) u^2/2); over a disc u^3 has its
    least-squares line at 2/3 of the rim's u^2.
    """
    camera = sheet(f_number)
    rim2 = (camera.aperture_radius_mm / camera.focus_distance_mm) ** 2
    layers = ((TANK.wall_mm, WATER.window), (0.5 * TANK.width_mm, WATER.fluid))
    apparent = sum(t / n * (1.0 - n**-2) for t, n in layers) * 0.5 * (2.0 / 3.0) * rim2
    return float(apparent / WATER.depth_ratio)


def in_noise(read_over_light: float, seed: int) -> Figures:
    """Return the figures with read noise of so many times the light of a lit pixel, and the bound of their scatter."""
    rng = np.random.default_rng([seed, 7])
    known = Rig(sheet())
    view = raw_view(known.camera, WATER, 0.5 * DIAMETER_MM, None, known.space)
    readout = replace(READOUT, read_noise_counts=read_over_light * LIGHT_COUNTS / lens_pixels(view))
    tracers = strewn_apart(rng)
    places = np.column_stack([known.reference.points_to_focal_point(tracers.position_mm), tracers.light_counts])
    slope = slopes(view, places)
    bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, places), readout)).sigma_mm(joint=True)
    figures = place_figures(Case(known, known), tracers, rng, readout)
    return figures | {f"bound_{name}": float(np.median(values)) for name, values in zip("xyz", bound.T, strict=True)}


def at_depth(distance_mm: float, seed: int) -> Figures:
    """Return errors of tracers this far before and behind the focal plane: robust spread and rms along x and z."""
    rng = np.random.default_rng([seed, 8])
    known = Rig(sheet(), WATER, WIDE_CHANNEL)
    tracers = strewn_apart(rng, (max(distance_mm - BAND_MM, 0.0), distance_mm + BAND_MM))
    tracers.position_mm[:, 2] *= rng.choice([-1.0, 1.0], len(tracers.position_mm))
    found = Case(known, known, (WIDTH_MM, WIDTH_MM, 22.0)).particles(photograph(known, tracers, READOUT, rng))
    pairs = match(found, tracers.position_mm, PITCH_MM)
    error_mm = pairs.error_voxel * PITCH_MM if len(pairs.found) else np.full((1, 3), np.nan)
    spread, rms = MAD_TO_SIGMA * np.median(np.abs(error_mm), axis=0), np.sqrt(np.mean(error_mm**2, axis=0))
    figures = {"spread_x": spread[0], "spread_z": spread[2], "rms_x": rms[0], "rms_z": rms[2]}
    return {name: float(value) for name, value in figures.items()} | found_shares(pairs, found, tracers)


def crowded(per_lens: float, seed: int) -> Figures:
    """Return errors of places, and of displacements by tracks and by volumes, of so many tracers a microlens."""
    rng = np.random.default_rng([seed, 1])
    known = Rig(sheet())
    tracers = strewn(per_lens, rng)
    pair = [tracers.moved(sign * 0.5 * displacement(tracers.position_mm)) for sign in (-1.0, 1.0)]
    images = [photograph(known, each, READOUT, rng) for each in pair]
    seen = SENSOR_PX * PIXEL_MM
    search = Case(known, known, (seen, seen, CROWD_DEPTH_MM), CROWD_VOXEL_MM)
    found = [search.particles(image) for image in images]
    inner = np.array([HALF_WIDTH_MM, HALF_WIDTH_MM, 0.5 * CROWD_DEPTH_MM])
    places = particle_figures(found[0], pair[0].position_mm, -inner, inner, PITCH_MM)
    figures = {name: places[name] for name in ("recall", "precision")}
    figures |= {f"rms_{name}": places.get(f"rms_{name}_voxel", np.nan) * PITCH_MM for name in "xz"}

    middle, moved = tracks_between(found[0], found[1], known)
    inside = np.all(np.abs(middle) <= inner, axis=1)
    by_tracks = _velocity_figures("tracks", moved[inside], displacement(middle[inside]))
    grid = known.grid(search.size_mm, VOXEL_MM)
    (nz, ny, nx), padding = grid.shape_zyx, default_padding(known.camera, known.media, grid)
    px, py, pz = padding
    operator = factorise_through(known.camera, known.space, grid.padded(padding))
    whole = [reconstruct(operator, image, EM).volume for image in images]
    first, second = (np.ascontiguousarray(v[pz : pz + nz, py : py + ny, px : px + nx]) for v in whole)
    settings = CorrelationSettings([WINDOW_VOXELS], (0.5, 0.5, 0.5), None, EXPONENT)
    field = correlate([(first, second)], known.reference.grid_from_focal_point(grid), settings)
    centres = field.grid.centres_mm()
    kept = (field.flag < REJECTED) & np.all(np.abs(centres) <= inner, axis=-1)
    by_volumes = field.displacement_voxel[kept] * VOXEL_MM, displacement(centres[kept])
    return figures | by_tracks | _velocity_figures("volumes", *by_volumes)


def strewn(per_lens: float, rng: np.random.Generator) -> Tracers:
    """Return tracers strewn at random before and beside what the sensor sees."""
    half = np.array([0.5 * SENSOR_PX * PIXEL_MM + BEYOND_MM] * 2 + [0.5 * CROWD_DEPTH_MM])
    count = max(1, round(per_lens * (2.0 * half[0] / PITCH_MM) ** 2))
    return Tracers(rng.uniform(-half, half, (count, 3)), LIGHT_COUNTS * rng.uniform(*BRIGHTNESS, count))


def displacement(points_mm: Points) -> Points:
    """Return by how much tracers at points (n, 3) move in a pair."""
    moved = np.tile(np.asarray(UNIFORM_MM), (len(points_mm), 1))
    moved[:, 0] += DEPTH_SHEAR * points_mm[:, 2]
    moved[:, 2] += LATERAL_SHEAR * points_mm[:, 0]
    return moved


def tracks_between(first: Points, second: Points, known: Rig) -> tuple[Points, Points]:
    """Return the middles (n, 3) of a pair's tracks and their displacements (n, 3)."""
    tracks = track(Seen(first), Seen(second), known.camera.scale(known.media), SEARCH_MM)
    a, b = first[tracks.first], second[tracks.second]
    return 0.5 * (a + b), b - a


def _velocity_figures(by: str, moved: Points, true: Points) -> Figures:
    """Return the slope through zero and the rms error of displacements (n, 3) along x and z, mm, by the way taken."""
    slope = rms = np.full(3, np.nan)
    if len(moved):
        slope = np.sum(moved * true, axis=0) / np.sum(true**2, axis=0)
        rms = np.sqrt(np.mean((moved - true) ** 2, axis=0))
    figures = {"slope_u": slope[0], "slope_w": slope[2], "rms_u": rms[0], "rms_w": rms[2]}
    return {f"{by}_{name}": float(value) for name, value in figures.items()}
