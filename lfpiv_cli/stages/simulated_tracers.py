"""What the configured scene is seeded with: tracers about the volume and between the walls, bubbles on a wall."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.config import Config
from lfpiv_cli.flow.masks import RoundWall
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.reference import Reference
from lfpiv_cli.synthetic import scenes
from lfpiv_cli.synthetic.bubbles import Bubbles, bubbles_at_wall
from lfpiv_cli.synthetic.render import RAYS
from lfpiv_cli.synthetic.seeding import seeded_boxes
from lfpiv_cli.weights.build import blur_radius_mm
from lfpiv_cli.weights.curved_reach import spread_mm


def tracers_of(settings: Config, camera: Camera, reference: Reference, motion: scenes.Motion) -> scenes.Tracers:
    """Return the tracers: as many in the volume as configured, and as dense around it as their light reaches.

    Those that are carried into the volume before a longer sequence ends, or out of it, are there too; where the light
    ends, those that come into it from the first frame on.
    """
    scene, volume = settings.simulation, settings.grid(reference)
    light = light_z_mm_of(settings, reference)
    lit = volume if light is None else _between(volume, light)
    reach = _reach_mm(settings, camera, lit)
    # Laterally the reach covers half the time between two frames; an edge of the light is sharp.
    carrying = motion if light is not None else replace(motion, frames=motion.frames - 1)
    carried_s = max(abs(time_s) for time_s in carrying.carried_s())
    box, inside = seeded_boxes(lit, reach, motion.flow, carried_s, _walls(settings, reference))
    measured = inside.within(scenes.Box.around(volume, (0.0, 0.0, 0.0)))
    pipe = _pipe(settings, reference)
    return scenes.Tracers(
        round(scene.particles * box.volume_in_mm3(pipe) / measured.volume_in_mm3(pipe)),
        box,
        scene.particle_diameter_mm,
        scene.particle_counts,
        scene.brightness,
        scene.brightness_log_sigma,
        scene.rays or RAYS,
        scene.particle_diameter_log_sigma,
        scene.brightness_flicker,
        light,
        pipe,
    )


def _reach_mm(settings: Config, camera: Camera, lit: Grid) -> float:
    """Return how far beside the volume a tracer still lights its pixels."""
    scene = settings.scene_space()
    if scene is None:
        return blur_radius_mm(camera, settings.media_model(), lit)
    return float(spread_mm(camera, scene, lit).max())


def light_z_mm_of(settings: Config, reference: Reference) -> tuple[float, float] | None:
    """Return between which depths from the focal point there is light, not beyond a channel's walls; None: everywhere.

    Raises
    ------
    ConfigError : the light lies beyond a wall
    """
    light, channel = settings.simulation.light_z_mm, settings.channel
    if light is None:
        return None
    half = np.inf if channel is None else 0.5 * channel.width_mm
    low, high = max(light[0], -half), min(light[1], half)
    if low >= high:
        raise ConfigError(f"simulation.light_z_mm: is {list(light)}, beyond a wall {half:g} mm from the mid plane")
    return reference.depth_to_focal_point(low), reference.depth_to_focal_point(high)


def _between(volume: Grid, z_mm: tuple[float, float]) -> Grid:
    """Return the volume between other depths, one voxel deep."""
    (nx, ny, _), (dx, dy, _), (x, y, _) = volume.shape_xyz, volume.spacing_mm, volume.origin_mm
    return Grid((nx, ny, 1), (dx, dy, z_mm[1] - z_mm[0]), (x, y, 0.5 * (z_mm[0] + z_mm[1])))


def _walls(settings: Config, reference: Reference) -> scenes.Box | None:
    """Return the inside of the channel, or the box around the pipe, that the flow runs through; None: neither is."""
    flow, pipe = settings.simulation.flow, _pipe(settings, reference)
    if pipe is not None:
        return scenes.pipe_bounds(pipe)
    if flow is None or flow.kind != "square_duct":
        return None
    return scenes.channel_walls(flow.width_mm, reference.depth_to_focal_point(flow.centre_mm[2]), flow.axis)


def _pipe(settings: Config, reference: Reference) -> RoundWall | None:
    """Return the inside of the pipe that the flow runs through, z from the focal point; None: it is another flow."""
    flow = settings.simulation.flow
    if flow is None or flow.kind != "pipe":
        return None
    x, y, z = flow.centre_mm
    return RoundWall(flow.radius_mm, (x, y, reference.depth_to_focal_point(z)), flow.axis)


def bubbles_walls_of(settings: Config, reference: Reference) -> scenes.Box | None:
    """Return the walls that bubbles stick to, None where there are no bubbles.

    Raises
    ------
    ConfigError : there is no channel that they could stick to
    """
    scene = settings.simulation
    if scene.bubbles == 0:
        return None
    walls = _walls(settings, reference)
    if walls is None or scene.flow is None or scene.flow.kind != "square_duct":
        raise ConfigError("simulation.bubbles: bubbles stick to a channel's wall; simulation.flow is no square_duct")
    return walls


def bubbles_of(settings: Config, seen: scenes.Box, reference: Reference, rng: np.random.Generator) -> Bubbles | None:
    """Return the bubbles at the channel's wall, None where there are none."""
    scene, walls = settings.simulation, bubbles_walls_of(settings, reference)
    if walls is None:
        return None
    return bubbles_at_wall(scene.bubbles, scene.bubble_diameter_mm, scene.bubble_wall, seen, walls, rng)
