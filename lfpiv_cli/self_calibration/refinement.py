"""Volume self-calibration from the particles of a flow: where the channel's walls are, by the particles between them.

Where the particles end gives the depth of the mid plane, the walls' tilt, and the scale of depths, which goes with
the square of the magnification. Their images show none of these: unknown places absorb them. What the images do show
(`nuisances`) is asked of the first one.

Axes: world axes of the raw sensor, z from the nominal focal point; lengths in mm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.board_pose import lens_in_scene_mm
from lfpiv_cli.calibration.model import Calibration, known
from lfpiv_cli.calibration.wave_shapes import WaveLight
from lfpiv_cli.errors import InputError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.diameter import UNKNOWN_LENSES, diameter_by
from lfpiv_cli.particles.refraction import places_by_snell
from lfpiv_cli.particles.rounds import ROUNDS, after_rounds, find_particles, finished, steps_of
from lfpiv_cli.particles.search import Task, blank, task_of
from lfpiv_cli.particles.stated import Particles, light_left, result
from lfpiv_cli.particles.view import Light, View, raw_view, with_radius
from lfpiv_cli.reconstruction.solvers import normalisers
from lfpiv_cli.self_calibration.nuisances import MovableScene, NuisanceFit, Nuisances, fit_nuisances
from lfpiv_cli.self_calibration.walls import Walls, find_walls, refuse_few
from lfpiv_cli.weights.model import Weights

# What the images of particles tell of the camera, as figures.


def shift_px(camera: Camera, change: Nuisances) -> Floats:
    """Return how far (2,) all lens images have moved since the white image, (columns, rows)."""
    shift = np.array([change.shift_x_mm, change.shift_y_mm])
    return np.asarray(shift * camera.micro_image_scale / camera.pixel_mm, dtype=np.float64)


def camera_figures(camera: Camera, particle_diameter_mm: float, change: Nuisances, error: Nuisances) -> dict[str, Any]:
    """Return the figures of a camera and its particles with what was found, and their standard errors."""
    return {
        "lattice_shift_px": shift_px(camera, change).tolist(),
        "lattice_shift_px_sigma": shift_px(camera, error).tolist(),
        "aperture_mm": camera.aperture_mm + 2.0 * change.aperture_radius_mm,
        "aperture_mm_sigma": known(2.0 * error.aperture_radius_mm),
        "particle_diameter_mm": particle_diameter_mm + 2.0 * change.particle_radius_mm,
        "particle_diameter_mm_sigma": 2.0 * error.particle_radius_mm,
        "k1_per_mm2": camera.distortion_per_mm2 + change.distortion_per_mm2,
        "k1_per_mm2_sigma": error.distortion_per_mm2,
    }


# Three rounds find nine particles in ten; the walls of six rounds lie within two micrometres of theirs.
REFINING_ROUNDS = ROUNDS[:3]
# Behind a scene that lies up to 8 % of the radius beside where it is said to, tracers explain most of an image by the
# second round: 0.26 to 0.29 of the light were left, 0.31 at twice the seeding; 0.60 of a flat channel's image, and 0.51
# where the scene's radius was a fifth too small. What follows would take minutes, and wander.
EARLY_ROUNDS, MOST_LEFT_EARLY = 2, 0.45
# Light tells no radius that is said to be too large: of tracers in all of a pipe all but this share reach this far, in
# radii, wherever its axis is; the wall itself is taken for the pipe's own up to `walls.WIDTH_TOLERANCE`.
OUTERMOST_SHARE, LEAST_REACH = 0.02, 0.9
# Units of progress for each image; there is one more for the first.
STEPS = steps_of(REFINING_ROUNDS)
# Particles are looked for this share of the channel's width beyond the walls on each side.
MARGIN_PER_WIDTH = 0.15
# Candidates' depths need planes only this far apart, in depths over which light spreads by one lens (Table 2: 0.2 mm);
# the fit finds the rest.
PLANES_APART = 0.2 / 1.064
# What all particles' depths have in common (the lens's rim, best focus of refracted rays) was 1 to 3 um on an image
# traced through 5 mm of acrylic and up to 10 mm of water: this share of the depth over which the main lens's rim moves
# a point by a microlens, with room for as much again.
COMMON_SHARE_OF_LENS_DEPTH = 2.5e-3


@dataclass(frozen=True, eq=False)
class Refinement:
    """What the particles show.

    Attributes
    ----------
    walls : where they end
    nuisances, nuisances_sigma : changes of the camera and of the particles' size by their images
    position_mm : (n, 3) of the particles, all images together
    depths_mm : between which they were looked for
    frames : number of images
    expected_z_mm, expected_sigma_mm : depth of the mid plane before and its standard error, None where not known
    common_depth_mm : standard error that all depths share
    width_mm, particle_diameter_mm : true width of the channel, diameter of the particles before
    camera : that the particles were found with
    """

    walls: Walls
    nuisances: Nuisances
    nuisances_sigma: Nuisances
    position_mm: Floats
    depths_mm: tuple[float, float]
    frames: int
    expected_z_mm: float | None
    expected_sigma_mm: float | None
    common_depth_mm: float
    width_mm: float
    particle_diameter_mm: float
    camera: Camera

    @property
    def middle_sigma_mm(self) -> float:
        """Standard error of the mid plane's depth, what all particles have in common included."""
        return float(np.hypot(self.walls.middle_sigma_mm, self.common_depth_mm))

    @property
    def width_sigma_mm(self) -> float:
        """Standard error of the apparent width; centres of particles may stay a radius off each wall."""
        return float(np.linalg.norm([self.walls.width_sigma_mm, self.common_depth_mm, self.particle_diameter_mm]))

    def applied(self, calibration: Calibration) -> Calibration:
        """Return the calibration with mid plane and lens images where the particles have them."""
        fit = calibration.fit.shifted(shift_px(self.camera, self.nuisances))
        return replace(
            calibration,
            rectification=replace(calibration.rectification, fit=fit),
            mid_plane_z_mm=self.walls.middle_mm,
            mid_plane_z_sigma_mm=self.middle_sigma_mm,
            mid_plane_given=False,
        )

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain numbers and lists, units in their names; None where unknown."""
        walls, camera = self.walls, self.camera
        half_span = np.sqrt(np.var(self.position_mm[:, :2], axis=0))
        slope_sigma = np.hypot(walls.slope_sigma, self.common_depth_mm / half_span)
        scale, before, before_sigma = walls.width_mm / self.width_mm, self.expected_z_mm, self.expected_sigma_mm
        return {
            "frames": self.frames,
            "particles": len(self.position_mm),
            "mid_plane_z_mm": walls.middle_mm,
            "mid_plane_z_mm_sigma": self.middle_sigma_mm,
            "mid_plane_z_mm_before": before,
            "mid_plane_correction_mm": None if before is None else walls.middle_mm - before,
            "mid_plane_correction_mm_sigma": (
                None if before_sigma is None else np.hypot(self.middle_sigma_mm, before_sigma)
            ),
            "wall_tilt_deg": np.rad2deg(np.arctan(walls.slope)).tolist(),
            "wall_tilt_deg_sigma": np.rad2deg(slope_sigma / (1.0 + walls.slope**2)).tolist(),
            "apparent_width_mm": walls.width_mm,
            "apparent_width_mm_sigma": self.width_sigma_mm,
            "magnification": camera.magnification * float(np.sqrt(scale)),
            "magnification_sigma": 0.5 * abs(camera.magnification) * self.width_sigma_mm / self.width_mm,
            **camera_figures(camera, self.particle_diameter_mm, self.nuisances, self.nuisances_sigma),
            "edge_blur_mm": walls.blur_mm,
            "stray_share": walls.stray_share,
        }


@dataclass(frozen=True)
class ChannelFlow:
    """What is known of a flow between a channel's walls.

    Attributes
    ----------
    volume : says where particles are looked for laterally, and how fine
    width_mm : of the channel
    particle_diameter_mm : of the tracers; None: by their images
    light : waves that tracers send; None: rays
    """

    volume: Grid
    width_mm: float
    particle_diameter_mm: float | None
    light: WaveLight | None = None


def refine_calibration(
    images: Sequence[Singles],
    calibration: Calibration,
    sheet: Camera,
    space: ObjectSpace,
    flow: ChannelFlow,
    progress: Callable[[int], None] | None = None,
) -> Refinement:
    """Find the particles of images and the channel's walls by them.

    Parameters
    ----------
    images : (rows, columns) raw, dark and background taken off, counts
    sheet : camera as the data sheet has it
    space : what lies before the particles, by the calibration

    Raises
    ------
    InputError
        The particles do not show the channel.
    ConfigError
        The array is hexagonal.
    """
    camera = calibration.camera(sheet)
    media = space.media
    given, scale = flow.particle_diameter_mm, camera.scale(media)
    # A grid as wide as the volume, and deeper than the channel.
    (columns, rows, _), (dx, dy, _), deep = flow.volume.shape_xyz, flow.volume.spacing_mm, PLANES_APART * scale.depth_mm
    count = int(np.ceil(flow.width_mm * (1.0 + 2.0 * MARGIN_PER_WIDTH) / deep))
    x, y = (0.5 * sum(flow.volume.bounds_mm(axis)) for axis in (0, 1))
    grid = Grid.centred((columns, rows, count), (dx, dy, deep), (x, y, calibration.mid_plane_z_mm or 0.0))
    reported = flow.light
    waves = None if reported is None else Light(reported.wavelength_mm, reported.diffusion_px, grid.bounds_mm(2))
    view = raw_view(camera, media, 0.5 * (given or UNKNOWN_LENSES * scale.lens_mm), calibration, light=waves)
    weights = Weights.factorised(camera, media, grid, calibration)
    task = partial(task_of, weights=weights, camera=camera, sums=normalisers(weights.padded))
    if given is None and (measured := diameter_by([task(images[0], view)])):
        view = with_radius(view, 0.5 * scale.lens_mm * measured.lenses)
    fit, first = first_image(task(images[0], view), view, grid.bounds_mm(2), progress)
    found = [first, *(find_particles(task(image, fit.view), REFINING_ROUNDS, progress) for image in images[1:])]
    position = np.concatenate([each.position_mm for each in found])
    variance = np.concatenate([each.covariance_mm2[:, 2, 2] for each in found])
    # A particle that hardly lights the sensor may have no depth that can be determined.
    known = np.isfinite(variance) & (variance > 0.0)
    behind_walls = view._replace(layers=space.layers(camera))
    position, sigma = places_by_snell(position[known], behind_walls), np.sqrt(variance[known])
    return Refinement(
        walls=find_walls(position, sigma, grid.bounds_mm(2), flow.width_mm, len(images)),
        nuisances=fit.found,
        nuisances_sigma=fit.sigma,
        position_mm=position,
        depths_mm=grid.bounds_mm(2),
        frames=len(images),
        expected_z_mm=calibration.mid_plane_z_mm,
        expected_sigma_mm=calibration.mid_plane_z_sigma_mm,
        common_depth_mm=COMMON_SHARE_OF_LENS_DEPTH * (lens_in_scene_mm(camera)[1] / media.depth_ratio),
        width_mm=flow.width_mm,
        particle_diameter_mm=2.0 * view.particle_radius_mm,
        camera=camera,
    )


def first_image(
    task: Task,
    view: View,
    depths_mm: tuple[float, float],
    progress: Callable[[int], None] | None,
    scene: MovableScene | None = None,
    start: Nuisances | None = None,
) -> tuple[NuisanceFit, Particles]:
    """Return what the first image tells of the camera, and of a scene, and its particles so seen.

    `view`, `scene`, `start` are those of `fit_nuisances`, with which the task's view was made.

    Raises
    ------
    InputError
        There are too few particles, or behind the scene they leave most of the light, or end far from its wall.
    """
    state = after_rounds(task, blank(task), REFINING_ROUNDS[:EARLY_ROUNDS], progress)
    if scene is not None:
        left = light_left(task.image, state.residual, task.read_counts)
        if left > MOST_LEFT_EARLY:
            raise InputError(
                f"{left:.0%} of the image's light is not that of the {len(state.particles)} tracers found behind the "
                f"scene, at most {MOST_LEFT_EARLY:.0%} where they are seen through it: is the image one of this pipe? "
                "Check radii and indices of the scene and where it lies, particle_diameter_mm and --dark"
            )
    state = after_rounds(task, state, REFINING_ROUNDS[EARLY_ROUNDS:], progress)
    found = result(task, finished(task, state, REFINING_ROUNDS[-1]))
    refuse_few(len(found.position_mm))
    if scene is not None:
        own, radius = scene.about_axis(found.position_mm, (start or Nuisances()).scene), scene.wall.radius_mm
        reach = float(np.quantile(np.hypot(own[:, 1], own[:, 2]), 1.0 - OUTERMOST_SHARE))
        if reach < LEAST_REACH * radius:
            raise InputError(
                f"{1.0 - OUTERMOST_SHARE:.0%} of the tracers lie within {reach:.3f} mm of the pipe's axis, and the "
                f"wall's radius_mm is {radius:g}, of which they reach {LEAST_REACH:.0%} at least where all of the "
                "pipe is seeded and lit: measure the radius, and put it into the scene"
            )
    rows = np.column_stack([task.camera.to_image_axes(found.position_mm), found.light_counts])
    fit = fit_nuisances(task.image, view, rows, found.noise, depths_mm, scene, start)
    if progress:
        progress(1)
    return fit, replace(found, position_mm=task.camera.to_image_axes(fit.particles[:, :3]))
