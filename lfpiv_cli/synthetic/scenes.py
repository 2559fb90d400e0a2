"""Recorded images of known scenes, with their truth: white light, a board, tracers in a flow, bubbles on its wall.

Axes: world axes, origin at the nominal focal point in the medium that the scene stands in, z away from the camera. The
truth of tracers is that of the middle of the pair or sequence.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.flow.windows import RoundWall, Walls
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import BubbleWall
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres, light_per_area, render_board, sunflower
from lfpiv_cli.synthetic.flows import MM_PER_M, STEADY, Flow, Pulsation, advect
from lfpiv_cli.synthetic.rays import passed_light
from lfpiv_cli.synthetic.render import RAYS, Balls, Readout, Space, render_points, render_white

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Misalignment:
    """How a real camera departs from its data sheet.

    Attributes
    ----------
    rotation_deg : of the microlens array about the axis, from the columns towards the rows
    shift_px : of the array, (columns, rows), in pixels at the array
    distortion_per_mm2 : k1
    """

    rotation_deg: float = 0.0
    shift_px: tuple[float, float] = (0.0, 0.0)
    distortion_per_mm2: float = 0.0

    def apply(self, camera: Camera) -> Camera:
        """Return the camera, turned first, then shifted, with this distortion."""
        cosine, sine = np.cos(np.deg2rad(self.rotation_deg)), np.sin(np.deg2rad(self.rotation_deg))
        shift = np.asarray(self.shift_px) * camera.pixel_mm
        lattice = camera.lattice.transformed([[cosine, -sine], [sine, cosine]], shift)
        return replace(camera, lattice=lattice, distortion_per_mm2=self.distortion_per_mm2)


@dataclass(frozen=True)
class Box:
    """A box of space, from `low_mm` to `high_mm`, (x, y, z)."""

    low_mm: Triple
    high_mm: Triple

    @classmethod
    def of(cls, low_mm: ArrayLike, high_mm: ArrayLike) -> Box:
        """Return the box between two corners (3,)."""
        (a, b, c), (d, e, f) = np.asarray(low_mm, np.float64).tolist(), np.asarray(high_mm, np.float64).tolist()
        return cls((a, b, c), (d, e, f))

    @classmethod
    def around(cls, volume: Grid, margin_mm: Triple) -> Box:
        """Return the volume's box with a margin on both sides of each axis: tracers beyond it light its pixels too."""
        low, high = np.transpose([volume.bounds_mm(axis) for axis in range(3)])
        return cls.of(low, high).wider(margin_mm)

    def wider(self, margin_mm: Triple) -> Box:
        """Return the box with a margin on both sides of each axis."""
        return Box.of(np.subtract(self.low_mm, margin_mm), np.add(self.high_mm, margin_mm))

    def volume_mm3(self, walls: Walls | None = None) -> float:
        """Return the volume between walls, all of it where there are none, in cubic millimetres."""
        if walls is None:
            return float(np.prod(np.subtract(self.high_mm, self.low_mm)))
        return float(walls.volumes_mm3(np.asarray(self.low_mm), np.asarray(self.high_mm)))

    def within(self, other: Box) -> Box:
        """Return the part that lies in another box.

        Raises
        ------
        ConfigError : they have no part in common
        """
        low = np.maximum(self.low_mm, other.low_mm)
        high = np.minimum(self.high_mm, other.high_mm)
        if np.any(low >= high):
            raise ConfigError(f"the tracers' box {self} and {other}, of the channel or volume, have no part in common")
        return Box.of(low, high)


@dataclass(frozen=True)
class Tracers:
    """What is seeded: `count` tracers, evenly spread over the box, or what walls leave of it, at the sequence's middle.

    Attributes
    ----------
    light_counts : expected counts of a tracer of brightness 1 that pass the aperture
    brightness : brightness is evenly spread between these two
    brightness_log_sigma : log-normal instead, of median 1, with this standard deviation of the logarithm
    rays : traced of each
    diameter_log_sigma : diameters are log-normal, of median `diameter_mm`, with this standard deviation of the
        logarithm; the light goes with their squares
    brightness_flicker : relative standard deviation of a tracer's light from frame to frame, log-normal
    light_z_mm : between these depths there is light; None: everywhere
    walls : that the box goes beyond, in world axes; None: there are none
    """

    count: int
    box: Box
    diameter_mm: float = 0.05
    light_counts: float = 6.0e5
    brightness: tuple[float, float] = (0.6, 1.4)
    brightness_log_sigma: float | None = None
    rays: int = RAYS
    diameter_log_sigma: float = 0.0
    brightness_flicker: float = 0.0
    light_z_mm: tuple[float, float] | None = None
    walls: Walls | None = None

    def drawn(self, frames: int, rng: np.random.Generator) -> tuple[Floats, Floats, Floats, Floats]:
        """Return what chance decides of the tracers; numbers are drawn only for what differs between them.

        Returns
        -------
        places : (count, 3), where they are at the sequence's middle
        brightness : (count,)
        sizes : (count,), their diameters over the median
        flicker : (frames, count), the light of each in each frame over its own, of mean 1
        """
        places = rng.uniform(self.box.low_mm, self.box.high_mm, (self.count, 3))
        while self.walls is not None and (beyond := ~self.walls.contain(places)).any():
            places[beyond] = rng.uniform(self.box.low_mm, self.box.high_mm, (int(beyond.sum()), 3))
        if self.brightness_log_sigma is None:
            brightness = rng.uniform(*self.brightness, self.count)
        else:
            brightness = rng.lognormal(0.0, self.brightness_log_sigma, self.count)
        sizes, flicker = np.ones(self.count), np.ones((frames, self.count))
        if self.diameter_log_sigma != 0.0:
            sizes = rng.lognormal(0.0, self.diameter_log_sigma, self.count)
        if self.brightness_flicker != 0.0:
            variance = np.log1p(self.brightness_flicker**2)
            flicker = rng.lognormal(-0.5 * variance, np.sqrt(variance), (frames, self.count))
        return places, brightness, sizes, flicker

    def lit(self, points_mm: Floats) -> Flags:
        """Return which of the points (..., 3) lie in the light."""
        if self.light_z_mm is None:
            return np.ones(points_mm.shape[:-1], dtype=np.bool_)
        low, high = self.light_z_mm
        return (points_mm[..., 2] > low) & (points_mm[..., 2] < high)


@dataclass(frozen=True, eq=False)
class RecordingCamera:
    """A camera with the sensor that records what it sees, by light of rays, or of waves where they are given."""

    optics: Camera
    readout: Readout
    waves: Waves | None = None

    def record(self, expected: Floats, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return an image recorded of the counts (rows, columns) that an objective without falloff would make."""
        return self.readout.record(expected * passed_light(self.optics), rng)

    def dark_frame(self, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return an image recorded without light."""
        return self.readout.record(np.zeros((self.optics.rows, self.optics.columns)), rng)


@dataclass(frozen=True)
class Motion:
    """How tracers move while they are recorded: a flow, the time between frames, and how many there are.

    `flow` is that of the middle of the sequence, from where time counts.
    """

    flow: Flow
    dt_s: float
    frames: int = 2
    pulsation: Pulsation = STEADY

    def times_s(self) -> list[float]:
        """Return when the frames are taken, counted from the middle of the sequence."""
        return [(number - 0.5 * (self.frames - 1)) * self.dt_s for number in range(self.frames)]

    def carried_s(self) -> list[float]:
        """Return for how long the flow of the middle would carry tracers to where each frame finds them."""
        return [self.pulsation.carried_s(time_s) for time_s in self.times_s()]

    def places_mm(self, middle_mm: Floats) -> Floats:
        """Return where the frames find tracers (frames, n, 3) that are at these places (n, 3) at the middle.

        From the middle on they go from frame to frame: over a whole sequence the steps of `advect` would be too long.
        """
        places, carried_s = np.empty((self.frames, *middle_mm.shape)), self.carried_s()
        later = range(self.frames // 2, self.frames)
        for numbers in (later, reversed(range(later.start))):
            place, reached_s = middle_mm, 0.0
            for number in numbers:
                place = advect(self.flow, place, carried_s[number] - reached_s)
                places[number], reached_s = place, carried_s[number]
        return places


@dataclass(frozen=True, eq=False)
class SimulatedStill:
    """An image, uint16, a dark frame of the same sensor, and the truth."""

    image: NDArray[np.uint16]
    dark: NDArray[np.uint16]
    truth: dict[str, Any]


@dataclass(frozen=True, eq=False)
class SimulatedFrames:
    """Images of moving tracers, uint16, a dark frame, and the truth: tracers at the middle of the sequence.

    Attributes
    ----------
    images : in the order of time
    positions_mm : (n, 3), world axes
    velocities_m_s : (n, 3)
    brightness : (n,), without flicker, 0 where there is no light at the middle of the sequence
    diameters_mm : (n,)
    frame_positions_mm : (frames, n, 3)
    frame_brightness : (frames, n), 0 where there is no light
    """

    images: tuple[NDArray[np.uint16], ...]
    dark: NDArray[np.uint16]
    positions_mm: Floats
    velocities_m_s: Floats
    brightness: Floats
    diameters_mm: Floats
    frame_positions_mm: Floats
    frame_brightness: Floats
    truth: dict[str, Any]


def channel_walls(width_mm: float, mid_plane_z_mm: float, axis: str = "x") -> Box:
    """Return the inside of a square channel, endless along `axis` (x or y), its mid plane at the given depth."""
    half = 0.5 * width_mm
    across = 1 if axis == "x" else 0
    low, high = [-np.inf, -np.inf, mid_plane_z_mm - half], [np.inf, np.inf, mid_plane_z_mm + half]
    low[across], high[across] = -half, half
    return Box.of(low, high)


def pipe_bounds(pipe: RoundWall) -> Box:
    """Return the box around a round pipe, endless along it; without bounds around one that is tilted."""
    reach = np.full(3, np.inf if pipe.tilt_deg > 0.0 else pipe.radius_mm)
    reach[pipe.along] = np.inf
    low, high = pipe.centre_mm - reach, pipe.centre_mm + reach
    return Box.of(low, high)


def simulate_white(camera: RecordingCamera, level: float, rng: np.random.Generator) -> SimulatedStill:
    """Simulate an image of uniform light, `level` expected counts where a pixel sees nothing but the aperture."""
    image = camera.record(render_white(camera.optics, level, waves=camera.waves), rng)
    return SimulatedStill(image, camera.dark_frame(rng), camera_truth(camera.optics))


def simulate_board(
    camera: RecordingCamera,
    space: Space,
    board: BoardGeometry,
    placement: BoardPlacement,
    level: float,
    rng: np.random.Generator,
    progress: Callable[[int], None] | None = None,
) -> SimulatedStill:
    """Simulate an image of a board, `level` expected counts in a pixel that sees only what is bright."""
    expected = render_board(camera.optics, space, board, placement, level, rng, waves=camera.waves, progress=progress)
    image = camera.record(expected, rng)
    truth = {
        **camera_truth(camera.optics),
        "board_z_mm": placement.z_mm,
        "tilt_deg": list(placement.tilt_deg),
        "offset_mm": list(placement.offset_mm),
        "board_rotation_deg": placement.rotation_deg,
        "dots_mm": dot_centres(board, placement).tolist(),
    }
    return SimulatedStill(image, camera.dark_frame(rng), truth)


def simulate_particles(
    camera: RecordingCamera,
    space: Space,
    tracers: Tracers,
    motion: Motion,
    rng: np.random.Generator,
    *,
    still: Floats | float = 0.0,
    progress: Callable[[int], None] | None = None,
) -> SimulatedFrames:
    """Simulate images of tracers, half of them before the time of the truth's positions and half after.

    Parameters
    ----------
    still : expected counts (rows, columns) of light that does not move, in all frames
    progress : called with the number of tracers rendered, for each frame those that are lit
    """
    positions, brightness, sizes, flicker = tracers.drawn(motion.frames, rng)
    brightness, diameters = brightness * sizes**2, tracers.diameter_mm * sizes
    places = motion.places_mm(positions)
    lit = tracers.lit(places)
    shown = brightness * flicker * lit
    images = []
    for place, seen, light in zip(places, lit, tracers.light_counts * shown, strict=True):
        balls = Balls(place[seen], light[seen], diameters[seen])
        how: dict[str, Any] = {"waves": camera.waves, "rays": tracers.rays, "progress": progress}
        expected = render_points(camera.optics, space, balls, rng, **how)
        images.append(camera.record(expected + still, rng))
    window = space.window if isinstance(space, ObjectSpace) else None
    truth = {
        **camera_truth(camera.optics),
        "dt_s": motion.dt_s,
        "particles": tracers.count,
        "window_distance_mm": None if window is None else window.distance_mm,
    }
    dark, at_middle = camera.dark_frame(rng), brightness * tracers.lit(positions)
    velocities = motion.flow(positions)
    return SimulatedFrames(tuple(images), dark, positions, velocities, at_middle, diameters, places, shown, truth)


def camera_truth(camera: Camera) -> dict[str, Any]:
    """Return what a calibration should find of a camera, by the names it reports, and the lattice on the array."""
    micro_images = camera.micro_image_lattice_px()
    centre = micro_images.points(micro_images.nearest(camera.sensor_centre_px))
    return {
        "pitch_px": micro_images.pitch.tolist(),
        "rotation_deg": float(np.rad2deg(camera.lattice.rotation_rad)),
        "origin_px": centre.tolist(),
        "k1_per_mm2": camera.distortion_per_mm2,
        "magnification": camera.magnification,
        "lattice_origin_mm": camera.lattice.origin.tolist(),
        "lattice_basis_mm": camera.lattice.basis.tolist(),
        "layout": camera.lattice.layout,
    }


# Where tracers are seeded, so that images of a volume hold all the light that real ones would.
#
# Axes: (x, y, z) in mm, z away from the camera from the nominal focal point.

# Points along each side of the volume at which the flow is asked for its speed: smooth flows change less than this
# resolves, and the faster tracer that it misses is one at the rim of a sequence's first or last frame.
SPEED_POINTS = 21


def seeded_boxes(volume: Grid, reach_mm: float, flow: Flow, carried_s: float, walls: Box | None) -> tuple[Box, Box]:
    """Return the box to seed, and the part of the measured volume that holds tracers.

    Parameters
    ----------
    volume : that is measured
    reach_mm : how far beside the volume a tracer still lights its pixels
    flow, carried_s : tracers are carried by it for this long before and after the time of the seeding; those that come
        into the volume so, or leave it, are seeded too
    walls : between which there are tracers; None: everywhere
    """
    inside = Box.around(volume, (0.0, 0.0, 0.0))
    sides = [np.linspace(low, high, SPEED_POINTS) for low, high in zip(inside.low_mm, inside.high_mm, strict=True)]
    points = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    carried = carried_s * (MM_PER_M * np.abs(flow(points)).max(axis=0))
    box = inside.wider((reach_mm + carried[0], reach_mm + carried[1], carried[2]))
    return (box, inside) if walls is None else (box.within(walls), inside.within(walls))


# Bubbles that stick to a channel's wall, as in the paper's Fig. 17: balls that shine and do not move.
#
# A bubble is lit as brightly as a ball that glows in the middle and fades to its rim. Its depth does not count: it is
# the disc of its rim, square to the optical axis. The light of tracers goes through it.

# A bubble is made of points this dense, as the dots of boards are; with so many rays each, those add less noise than
# light does.
POINTS_PER_MICROLENS = 8
RAYS_PER_BUBBLE_POINT = 1_000


@dataclass(frozen=True, eq=False)
class Bubbles:
    """Balls at rest: their centres (n, 3) and diameters (n,) in mm."""

    centres_mm: Floats
    diameters_mm: Floats

    def truth(self) -> list[list[float]]:
        """Return x, y, z and diameter of each, mm, ready for JSON."""
        return np.column_stack([self.centres_mm, self.diameters_mm]).tolist()


def bubbles_at_wall(
    count: int, diameter_mm: tuple[float, float], wall: BubbleWall, seen: Box, walls: Box, rng: np.random.Generator
) -> Bubbles:
    """Return balls that touch a wall of a square channel, evenly spread over the part of it that is seen.

    Parameters
    ----------
    diameter_mm : smallest and largest, evenly spread between them
    seen : box with tracers
    walls : inside of the channel, endless along its flow

    Raises
    ------
    ConfigError : a bubble is wider than the channel
    """
    diameters = rng.uniform(*diameter_mm, count)
    radii = 0.5 * diameters[:, np.newaxis]
    low, high = np.maximum(seen.low_mm, walls.low_mm + radii), np.minimum(seen.high_mm, walls.high_mm - radii)
    if np.any(low > high):
        raise ConfigError(f"bubbles of {diameters.max():g} mm do not fit into the channel that is seen, {seen}")
    centres = rng.uniform(low, high)
    axis = 2 if wall in ("near", "far") else int(np.flatnonzero(np.isfinite(walls.low_mm))[0])
    if wall in ("near", "low"):
        centres[:, axis] = walls.low_mm[axis] + radii[:, 0]
    else:
        centres[:, axis] = walls.high_mm[axis] - radii[:, 0]
    return Bubbles(centres, diameters)


def render_bubbles(
    camera: Camera, space: Space, bubbles: Bubbles, level: float, rng: np.random.Generator, waves: Waves | None = None
) -> Floats:
    """Render bubbles whose middle gives `level` expected counts in a pixel that sees nothing else, fading to the rim.

    Returns
    -------
    (rows, columns) float64, expected counts
    """
    spacing = float(camera.lattice.pitch[0]) / (POINTS_PER_MICROLENS * abs(camera.magnification))
    points, light = [np.empty((0, 3))], [np.empty(0)]
    for centre, diameter in zip(bubbles.centres_mm, bubbles.diameters_mm, strict=True):
        inside = sunflower(max(round((diameter / spacing) ** 2), 1), 0.5 * diameter)
        share = np.maximum(1.0 - (inside**2).sum(axis=1) / (0.5 * diameter) ** 2, 0.0)
        placed = centre + np.column_stack([inside, np.zeros(len(inside))])
        area = 0.25 * np.pi * diameter**2 / len(inside)
        points.append(placed)
        light.append(area * share * light_per_area(camera, space.media, placed[:, 2], level))
    balls = Balls(np.concatenate(points), np.concatenate(light), spacing if waves is None else 0.0)
    return render_points(camera, space, balls, rng, waves=waves, rays=RAYS_PER_BUBBLE_POINT)
