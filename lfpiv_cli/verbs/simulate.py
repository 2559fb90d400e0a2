"""`simulate`: the configured scene rendered into raw images, with the truth beside them.

File names are those of an experiment: white.tif, dark.tif, board.tif (at a depth: board_+4mm.tif), pair_a.tif,
pair_b.tif (of a longer sequence: frame_0000.tif and so on); the truth is in white.json, board.json, particles.json,
particles.npz.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import mid_plane_z_mm
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.inputs import ensure_room
from lfpiv_cli.files.particle_file import Particles, write_particles
from lfpiv_cli.files.provenance import record
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.grid import FOCAL_POINT, Grid, Reference
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic import scenes
from lfpiv_cli.synthetic.board import BoardPlacement, points_of
from lfpiv_cli.synthetic.flows import STEADY, Pulsation
from lfpiv_cli.synthetic.rays import objective_of, unseen
from lfpiv_cli.synthetic.render import RAYS, Readout, Space
from lfpiv_cli.synthetic.scenes import Bubbles, bubbles_at_wall, render_bubbles, seeded_boxes
from lfpiv_cli.verbs.frames import Progress
from lfpiv_cli.verbs.weights_cost import LONG_S, MUCH_BYTES
from lfpiv_cli.weights.build import blur_radius_mm
from lfpiv_cli.weights.scene import spread_mm

# What the configured scene is seeded with: tracers about the volume and between the walls, bubbles on a wall.


def tracers_of(settings: Config, camera: Camera, reference: Reference, motion: scenes.Motion) -> scenes.Tracers:
    """Return the tracers: as many in the volume as configured, and as dense around it as their light reaches.

    Those that are carried into the volume before a longer sequence ends, or out of it, are there too; where the light
    ends, those that come into it from the first frame on.
    """
    scene, volume = settings.simulation, settings.grid(reference)
    light = light_z_mm_of(settings, reference)
    lit = volume
    if light is not None:
        # The volume between other depths, one voxel deep.
        (nx, ny, _), (dx, dy, _), (x, y, _) = volume.shape_xyz, volume.spacing_mm, volume.origin_mm
        lit = Grid((nx, ny, 1), (dx, dy, light[1] - light[0]), (x, y, 0.5 * (light[0] + light[1])))
    # How far beside the volume a tracer still lights its pixels.
    if (through := settings.scene_space()) is None:
        reach = blur_radius_mm(camera, settings.media_model(), lit)
    else:
        reach = float(spread_mm(camera, through, lit).max())
    # Laterally the reach covers half the time between two frames; an edge of the light is sharp.
    carrying = motion if light is not None else replace(motion, frames=motion.frames - 1)
    carried_s = max(abs(time_s) for time_s in carrying.carried_s())
    box, inside = seeded_boxes(lit, reach, motion.flow, carried_s, _walls(settings, reference))
    measured = inside.within(scenes.Box.around(volume, (0.0, 0.0, 0.0)))
    pipe = _pipe(settings, reference)
    return scenes.Tracers(
        round(scene.particles * box.volume_mm3(pipe) / measured.volume_mm3(pipe)),
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


# Measured on one core: a white image, of 0.1 to 6 million pixels. An image of tracers takes longer with their number.
PIXEL_S, HELD_BYTES_A_PIXEL = 0.9e-6, 34


def simulate_white(
    config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Render a white image and a dark one."""
    settings, paths = _begin(config, output, ("white.tif", "dark.tif", "white.json"), overwrite, console)
    still = scenes.simulate_white(_recording(settings), settings.simulation.peak_counts, _generator(settings, 0))
    write_tiff(paths["white.tif"], still.image, overwrite)
    write_tiff(paths["dark.tif"], still.dark, overwrite)
    return _write_truth(paths["white.json"], "simulate white", still.truth, settings, config, overwrite)


def simulate_board(
    config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Render the snapshot of the board."""
    settings, paths = _begin(config, output, ("board.tif", "board.json"), overwrite, console)
    board, z_mm = settings.rig().board, settings.simulation.board_z_mm
    with console.progress(points_of(board), "simulate") as advance:
        still = _board_still(settings, board, _board_space(settings), z_mm, _generator(settings, 1), advance)
    write_tiff(paths["board.tif"], still.image, overwrite)
    return _write_truth(paths["board.json"], "simulate board", still.truth, settings, config, overwrite)


def simulate_boards(
    config: Path, output: Path, depth_mm: Sequence[float], *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Render the board moved through the fluid, at depths from the origin of the volume's coordinates."""
    names = {depth: board_at(depth) for depth in depth_mm}
    settings, paths = _begin(config, output, tuple(names.values()), overwrite, console)
    reference = simulated_reference(settings)
    rng, space = _generator(settings, 3), _flow_space(settings, reference)
    board = replace(settings.rig().board, medium="fluid")
    with console.frames(len(names), points_of(board), "simulate", "board") as work:
        for depth, name in names.items():
            write_tiff(
                paths[name],
                _board_still(settings, board, space, reference.depth_to_focal_point(depth), rng, work.advance).image,
                overwrite,
            )
            work.done(name)
    return {"boards": len(names), "reference_z_mm": reference.z_mm}


def board_at(depth_mm: float) -> str:
    """Return the name of the picture of a board at a depth."""
    return f"board_{depth_mm:+g}mm.tif"


def simulate_particles(
    config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Render images of tracers that follow the configured flow: a pair, or a longer sequence."""
    images = frame_names(load_rig(config).simulation.frames)
    settings, paths = _begin(config, output, (*images, "particles.npz", "particles.json"), overwrite, console)
    scene = settings.simulation
    reference = simulated_reference(settings)
    camera, space = _recording(settings), _flow_space(settings, reference)
    motion = _motion(settings, reference)
    tracers = tracers_of(settings, camera.optics, reference, motion)
    walls = bubbles_walls_of(settings, reference)
    bubbles: Bubbles | None = None
    still: Floats | float = 0.0
    if walls is not None:
        rng = _generator(settings, 4)
        bubbles = bubbles_at_wall(scene.bubbles, scene.bubble_diameter_mm, scene.bubble_wall, tracers.box, walls, rng)
        still = render_bubbles(
            camera.optics, space, bubbles, scene.bubble_counts, _generator(settings, 5), camera.waves
        )
    with console.progress(scene.frames * tracers.count, "simulate") as advance:
        found = scenes.simulate_particles(
            camera, space, tracers, motion, _generator(settings, 2), still=still, progress=advance
        )
    for name, image in zip(images, found.images, strict=True):
        write_tiff(paths[name], image, overwrite)
    motions = (found.positions_mm, found.velocities_m_s, found.brightness, found.diameters_mm)
    particles = Particles(*motions, found.frame_positions_mm, found.frame_brightness)
    write_particles(paths["particles.npz"], particles, overwrite)
    truth = found.truth | {"reference_z_mm": reference.z_mm}
    if isinstance(space, CurvedSpace):
        dark = int(unseen(camera.optics, space, found.positions_mm).sum())
        truth["particles_unseen"] = dark
        if dark:
            text = (
                f"{dark} of {tracers.count} tracers send no light to the lens: outside the fluid, or hidden by a "
                "curved wall"
            )
            remedy = "scene, and where simulation.flow is seeded"
            console.warn([Notice("tracers-unseen", config.name, text, remedy, dark)])
    if bubbles is not None:
        truth["bubbles_mm"] = bubbles.truth()
    return _write_truth(paths["particles.json"], "simulate particles", truth, settings, config, overwrite)


def ensure_experiment(settings: Config) -> None:
    """Refuse a config from which no white image, board and flow can be simulated, before anything is (ConfigError)."""
    reference = simulated_reference(settings)
    _motion(settings, reference)
    _flow_space(settings, reference)
    light_z_mm_of(settings, reference)
    bubbles_walls_of(settings, reference)
    _board_space(settings)
    settings.rig()
    settings.grid(reference)


# Boards over the depth of the volume: cubic polynomials need four, a fifth tells how well they fit. They leave this
# share of the depth free at both ends: there may be walls, and boards are tilted.
DLFC_BOARDS = 5
DLFC_MARGIN = 0.05


def simulate_images(config: Path, images: Path, *, overwrite: bool = False, console: Console = CONSOLE) -> None:
    """Simulate all images of the config's experiment, boards at several depths where its weights need them."""
    settings = load_rig(config)
    common: dict[str, Any] = {"overwrite": overwrite, "console": console}
    simulate_white(config, images, **common)
    simulate_particles(config, images, **common)
    if settings.weights.method == "dlfc":
        simulate_boards(config, images, board_depths(settings), **common)
    else:
        simulate_board(config, images, **common)


def board_depths(settings: Config) -> list[float]:
    """Return the depths of the boards that rays are fitted to, from the origin of the volume's coordinates."""
    low, high = settings.grid().bounds_mm(2)
    margin = DLFC_MARGIN * (high - low)
    return [float(depth) for depth in np.linspace(low + margin, high - margin, DLFC_BOARDS).round(2)]


# What can be simulated, by the name that the command has for it.
SCENES = {"white": simulate_white, "board": simulate_board, "particles": simulate_particles}


def frame_names(frames: int) -> tuple[str, ...]:
    """Return the names of the images of a flow: of a pair, or of a longer sequence."""
    if frames == 2:
        return "pair_a.tif", "pair_b.tif"
    return tuple(f"frame_{number:04d}.tif" for number in range(frames))


def real_camera(settings: Config) -> Camera:
    """Return the data sheet's camera with the imperfections that are simulated.

    Raises
    ------
    ConfigError : waves through an objective that is rendered by rays alone
    """
    section = settings.simulation.objective
    by_rays = section.vignetting > 0.0 or section.array_tilt_deg != (0.0, 0.0)
    if by_rays and settings.simulation.light.kind == "waves":
        raise ConfigError(
            f"{settings.source}: simulation.objective: vignetting and array_tilt_deg are simulated with "
            "simulation.light: {kind: rays} alone"
        )
    camera = misalignment_of(settings).apply(settings.camera_model())
    return replace(camera, objective=objective_of(camera, **section.model_dump()))


def _recording(settings: Config) -> scenes.RecordingCamera:
    return scenes.RecordingCamera(real_camera(settings), readout_of(settings), settings.simulation.light.waves())


def misalignment_of(settings: Config) -> scenes.Misalignment:
    """Return how the simulated camera departs from its data sheet."""
    scene = settings.simulation
    return scenes.Misalignment(scene.rotation_deg, scene.shift_px, scene.distortion_per_mm2)


def simulated_reference(settings: Config) -> Reference:
    """Return the origin of the volume's coordinates in the simulated scene."""
    scene, name = settings.simulation, settings.volume.reference
    if name == "focal_point":
        return FOCAL_POINT
    if scene.mid_plane_z_mm is not None:
        return Reference(name, scene.mid_plane_z_mm)
    rig = settings.rig()
    if rig.channel is None:
        raise ConfigError("volume.reference: mid_plane needs simulation.mid_plane_z_mm or the section `channel`")
    return Reference(name, mid_plane_z_mm(rig.board, rig.channel, rig.media, scene.board_z_mm))


def _board_still(
    settings: Config, board: BoardGeometry, space: Space, z_mm: float, rng: np.random.Generator, progress: Progress
) -> scenes.SimulatedStill:
    placement, level = placement_of(settings, z_mm), settings.simulation.peak_counts
    return scenes.simulate_board(_recording(settings), space, board, placement, level, rng, progress)


def placement_of(settings: Config, z_mm: float) -> BoardPlacement:
    """Return where the simulated board stands at a depth from the focal plane."""
    scene = settings.simulation
    return BoardPlacement(z_mm, scene.board_offset_mm, scene.board_tilt_deg, scene.board_rotation_deg)


def _begin(
    config: Path, output: Path, names: tuple[str, ...], overwrite: bool, console: Console
) -> tuple[Config, dict[str, Path]]:
    """Read the config and make sure that the outputs can be made and written."""
    settings, paths = load_rig(config), {name: output / name for name in names}
    pixels = math.prod(settings.image_shape())
    seconds, held = PIXEL_S * pixels * sum(name.endswith(".tif") for name in names), float(HELD_BYTES_A_PIXEL * pixels)
    ensure_room(held, f"simulate, for images of {written(pixels)} pixels,", "a sensor with fewer pixels needs less")
    if seconds > LONG_S or held > MUCH_BYTES:
        minutes, size = written(seconds / 60.0, 2), written(held / 1e9, 2)
        text = f"its images will take about {minutes} minutes of a core at least, and {size} GB"
        share = max(seconds / LONG_S, held / MUCH_BYTES)
        console.warn([Notice("heavy-work", "camera.sensor", text, "fewer columns and rows", share)])
    for path in paths.values():
        ensure_writable(path, overwrite, [config])
    return settings, paths


def _write_truth(
    path: Path, command: str, truth: dict[str, Any], settings: Config, config: Path, overwrite: bool
) -> dict[str, Any]:
    provenance = record(command, settings.resolved(), {"config": config})
    write_json(path, truth | {"provenance": provenance}, overwrite)
    return {name: value for name, value in truth.items() if not isinstance(value, list) or len(value) <= 3}


def _generator(settings: Config, stream: int) -> np.random.Generator:
    """Return the random numbers of one kind of image: independent streams of one seed."""
    return np.random.default_rng([settings.simulation.seed, stream])


def readout_of(settings: Config) -> Readout:
    scene = settings.simulation
    return Readout(scene.photons_per_count, scene.read_noise_counts, scene.dark_level_counts, scene.bits)


def _board_space(settings: Config) -> Space:
    """Return what the board is seen through: air, or window and fluid."""
    media = settings.media_model()
    if settings.board.medium == "air":
        return ObjectSpace(media.in_air(), None, settings.simulation.refraction)
    return _flow_space(settings, simulated_reference(settings))


def _flow_space(settings: Config, reference: Reference) -> Space:
    """Return what the tracers are seen through (ConfigError: paraxial rays through a scene)."""
    scene = settings.scene_space()
    if scene is not None and settings.simulation.refraction == "paraxial":
        raise ConfigError(
            f"{settings.source}: simulation.refraction: is paraxial, but through a scene rays obey Snell's law (exact)"
        )
    if scene is not None:
        return scene
    media, refraction = settings.media_model(), settings.simulation.refraction
    if refraction == "paraxial" or media == media.in_air():
        return ObjectSpace(media, None, refraction)
    return ObjectSpace(media, settings.window_model(reference.z_mm), refraction)


def _motion(settings: Config, reference: Reference) -> scenes.Motion:
    """Return how the tracers move (ConfigError: there is no flow, or no time between its images)."""
    scene, dt_s = settings.simulation, settings.correlation.dt_s
    if dt_s is None:
        raise ConfigError(f"{settings.source}: correlation.dt_s: is missing, and images of a flow need it")
    pulsation = Pulsation(**scene.pulsation.model_dump()) if scene.pulsation else STEADY
    return scenes.Motion(settings.simulated_flow(reference), dt_s, scene.frames, pulsation)
