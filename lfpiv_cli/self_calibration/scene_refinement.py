"""Volume self-calibration of a pipe from the particles in it: where its axis lies, and how it is tilted.

Two things tell. The particles end at the wall, whose radius is known. And their images are astigmatic behind it by how
they lie to the axis, so that a scene that lies elsewhere leaves more of the images unexplained (`nuisances`): it tells
first, and the particles are looked for again behind the scene so moved. Where both agree they are taken together; where
they do not, indices or radii of the scene are wrong, which the images cannot know, and the wall is believed.

As the places of particles come from rays through the scene, they move with it, less than it does. The wall is sought
among particles that are put anew behind each scene that is tried, until it is the scene's own.

Axes: world axes of the raw sensor, z from the nominal focal point; lengths in mm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.errors import InputError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.shapes import ScenePose
from lfpiv_cli.particles.diameter import UNKNOWN_LENSES, diameter_by
from lfpiv_cli.particles.rounds import find_particles
from lfpiv_cli.particles.search import task_of
from lfpiv_cli.particles.view import View, footprint_radius_mm, on_array_mm, raw_view, with_radius
from lfpiv_cli.reconstruction.solvers import normalisers
from lfpiv_cli.self_calibration import nuisances
from lfpiv_cli.self_calibration import refinement as of_channel
from lfpiv_cli.self_calibration.nuisances import MovableScene, Nuisances, moved_places
from lfpiv_cli.self_calibration.refinement import PLANES_APART, REFINING_ROUNDS
from lfpiv_cli.self_calibration.walls import RING_FROM, RoundWallFit, find_round_wall
from lfpiv_cli.weights.columns import operator_of
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.scene import curved_padding

# Particles are looked for again where the wall has moved by more than this share of its radius, at most so often.
SETTLED_SHARE, SEARCHES = 0.01, 3
# Units of progress for the first image; the others take `refinement.STEPS`.
STEPS_OF_FIRST = SEARCHES * (of_channel.STEPS + 1)
# The wall is the scene's own once it is found less than this share of the radius, or of a radian, beside it.
FOUND_SHARE, MOST_STEPS = 1e-5, 8
# Wall and images agree where the chi-squared of their four differences is below that which chance exceeds in 1e-4.
AGREEING_CHI2 = 23.5
# The wall is not the scene's own where its radius is so many of its standard errors off. What images then say of shifts
# is off by about as much as the radius is: behind one that is 1 % wrong, with an index 0.002 wrong, 0.058 mm in depth.
CONTRADICTING_SIGMAS = 4.0
# Of simulated tubes the images told the axis' place by up to 0.005 mm wrong, 0.0025 rms, with 0.001 by the noise of the
# pixels: what the responses leave out counts as much in other images. In microlenses; tilts were as their noise says.
NOT_NOISE_LENSES = 0.025


@dataclass(frozen=True, eq=False)
class SceneRefinement:
    """What the particles show.

    Attributes
    ----------
    scene : as the config, and an earlier refinement, have it
    axis, covariance : (4,), (4, 4) where it lies, by all that tells; see `nuisances.MovableScene`
    by_wall, by_wall_covariance : by where the particles end
    wall : the same, from `by_wall` on: what is left, radius and blur
    nuisances, nuisances_sigma : changes of the camera and of the particles' size by their images, and of the scene
    position_mm : (n, 3) of the particles whose wall is in view, world axes
    frames : number of images
    particles : all that were found
    particle_diameter_mm : of the particles before
    camera : that they were found with
    """

    scene: MovableScene
    axis: Floats
    covariance: Floats
    by_wall: Floats
    by_wall_covariance: Floats
    wall: RoundWallFit
    nuisances: Nuisances
    nuisances_sigma: Nuisances
    position_mm: Floats
    frames: int
    particles: int
    particle_diameter_mm: float
    camera: Camera

    @property
    def disagreement(self) -> float:
        """Chi-squared of the four differences between the scene by the wall and by the images."""
        off = self.by_wall - self.nuisances.scene
        return float(off @ np.linalg.solve(self.by_wall_covariance + np.diag(self.nuisances_sigma.scene**2), off))

    @property
    def agree(self) -> bool:
        """Whether wall and images tell of the same scene."""
        return self.disagreement < AGREEING_CHI2

    @property
    def radius_sigma_mm(self) -> float:
        """Standard error of the wall's apparent radius; centres of particles may stay a radius off it."""
        return float(np.hypot(self.wall.radius_sigma_mm, 0.5 * self.particle_diameter_mm))

    @property
    def radius_off_mm(self) -> float:
        """How far the wall's apparent radius is off the scene's, where chance does not explain it; else 0."""
        off = abs(self.wall.radius_mm - self.scene.wall.radius_mm)
        return off if off > CONTRADICTING_SIGMAS * self.radius_sigma_mm else 0.0

    @property
    def focal_point_shift_mm(self) -> float:
        """How far the focal point, from which z is counted, comes to lie further from the camera."""
        before, after = (space.lens_z_mm(self.camera) for space in (self.scene.space, self.scene.moved(self.axis)))
        return before - after

    def pose(self, before: ScenePose | None, faces_sha256: str) -> ScenePose:
        """Return where the scene lies, from the config's, which was moved by `before`."""
        motion, scene = self.scene.motion(self.axis), self.scene
        if before is not None:
            motion = before.motion.then(motion)
        shift = np.stack([scene.across, scene.away], axis=1)
        return ScenePose(
            shift_mm=np.array(motion.shift_mm),
            turn_deg=np.rad2deg(motion.turn_rad),
            pivot_mm=np.array(motion.pivot_mm),
            shift_sigma_mm=_spread(shift, self.covariance[:2, :2]),
            turn_sigma_deg=np.rad2deg(_spread(scene.turns.T, self.covariance[2:, 2:])),
            faces_sha256=faces_sha256,
        )

    def applied(self, calibration: Calibration, faces_sha256: str) -> Calibration:
        """Return the calibration with the scene and the lens images where the particles have them."""
        fit = calibration.fit.shifted(of_channel.shift_px(self.camera, self.nuisances))
        return replace(
            calibration,
            rectification=replace(calibration.rectification, fit=fit),
            scene=self.pose(calibration.scene, faces_sha256),
        )

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain numbers and lists, units in their names."""
        motion = self.scene.motion(self.axis)
        wall = np.sqrt(np.diag(self.by_wall_covariance))
        images, images_sigma = self.nuisances.scene, self.nuisances_sigma.scene
        return {
            "frames": self.frames,
            "particles": self.particles,
            "particles_at_wall": self.wall.particles,
            "axis_point_mm": motion.points(self.scene.pivot_mm).tolist(),
            "axis_direction": motion.directions(self.scene.along).tolist(),
            "focal_point_shift_mm": self.focal_point_shift_mm,
            **_told("axis", self.axis, np.sqrt(np.diag(self.covariance))),
            **_told("axis_by_wall", self.by_wall, wall),
            **_told("axis_by_images", images, images_sigma),
            "disagreement_chi2": self.disagreement,
            "apparent_radius_mm": self.wall.radius_mm,
            "apparent_radius_mm_sigma": self.radius_sigma_mm,
            **of_channel.camera_figures(self.camera, self.particle_diameter_mm, self.nuisances, self.nuisances_sigma),
            "edge_blur_mm": self.wall.blur_mm,
            "stray_share": self.wall.stray_share,
        }


def _told(name: str, axis: Floats, sigma: Floats) -> dict[str, Any]:
    """Return the corrections of an axis (4,) and their standard errors, tilts in degrees."""
    tilt, tilt_sigma = (
        np.rad2deg(each[[nuisances.TILT_ACROSS, nuisances.TILT_AWAY]]).tolist() for each in (axis, sigma)
    )
    return {
        f"{name}_shift_mm": axis[[nuisances.ACROSS, nuisances.AWAY]].tolist(),
        f"{name}_shift_mm_sigma": sigma[[nuisances.ACROSS, nuisances.AWAY]].tolist(),
        f"{name}_tilt_deg": tilt,
        f"{name}_tilt_deg_sigma": tilt_sigma,
    }


def _spread(directions: Floats, covariance: Floats) -> Floats:
    """Return the standard errors (3,) along the world axes of what is known along two directions (3, 2)."""
    return np.asarray(np.sqrt(np.diag(directions @ covariance @ directions.T)), dtype=np.float64)


def refine_scene(
    images: Sequence[Singles],
    calibration: Calibration,
    sheet: Camera,
    space: CurvedSpace,
    volume: Grid,
    particle_diameter_mm: float | None,
    progress: Callable[[int], None] | None = None,
) -> SceneRefinement:
    """Find the particles of images and the pipe that they are in.

    Parameters
    ----------
    images : (rows, columns) raw, dark and background taken off, counts
    sheet : camera as the data sheet has it
    space : what lies before the particles, by config and calibration
    volume : says where along the pipe particles are looked for, and how fine
    particle_diameter_mm : of the tracers; None: by their images

    Raises
    ------
    InputError
        The particles do not show the pipe.
    ConfigError
        The scene is not one whose place they can show.
    """
    camera = calibration.camera(sheet)
    scene = MovableScene.of(space, camera)
    given, lens_mm = particle_diameter_mm, camera.scale(space.media).lens_mm
    view = raw_view(camera, space.media, 0.5 * (given or UNKNOWN_LENSES * lens_mm), calibration, space)
    start = Nuisances()
    for number in range(SEARCHES):
        seen = start.applied(view, scene)
        weights = _weights(scene, start.scene, volume, calibration, seen)
        task = partial(task_of, weights=weights, camera=camera, sums=normalisers(weights.padded))
        if number == 0 and given is None and (measured := diameter_by([task(images[0], seen)])):
            view = with_radius(view, 0.5 * lens_mm * measured.lenses)
            seen = start.applied(view, scene)
        work = task(images[0], seen)
        fit, first = of_channel.first_image(work, view, work.depths_mm, progress, scene, start)
        moved = np.abs(fit.found.scene - start.scene)
        start = fit.found
        if np.all(moved[:2] < SETTLED_SHARE * scene.wall.radius_mm):
            break
    else:
        raise InputError(
            f"the images fit no scene near the config's: after {SEARCHES} searches its axis still moves by "
            f"{moved[:2].max():.3f} mm; measure where the pipe is, and put it into the scene"
        )
    found = [first, *(find_particles(task(image, fit.view), REFINING_ROUNDS, progress) for image in images[1:])]
    position = np.concatenate([each.position_mm for each in found])
    covariance = np.concatenate([each.covariance_mm2 for each in found])
    known = np.all(np.isfinite(covariance), axis=(1, 2)) & np.all(covariance.diagonal(0, 1, 2) > 0.0, axis=1)
    seen_wall = known.copy()
    seen_wall[known] = _wall_in_view(fit.view, scene, start.scene, position[known])
    axis, axis_covariance, wall, placed = wall_by_places(
        position[seen_wall], covariance[seen_wall], scene, start.scene, len(images)
    )
    across, away = np.hypot(fit.sigma.scene[:2], NOT_NOISE_LENSES * lens_mm).tolist()
    images_sigma = replace(fit.sigma, axis_across_mm=across, axis_away_mm=away)
    refinement = SceneRefinement(
        scene=scene,
        axis=axis,
        covariance=axis_covariance,
        by_wall=axis,
        by_wall_covariance=axis_covariance,
        wall=wall,
        nuisances=fit.found,
        nuisances_sigma=images_sigma,
        position_mm=placed,
        frames=len(images),
        particles=len(position),
        particle_diameter_mm=2.0 * view.particle_radius_mm,
        camera=camera,
    )
    return together(refinement)


def together(found: SceneRefinement) -> SceneRefinement:
    """Return the scene by wall and images, weighed by what is known of them; by the wall alone where they disagree.

    A radius that is not the scene's makes what images say of shifts as uncertain as it is off.
    """
    sigma = found.nuisances_sigma
    across, away = np.hypot(sigma.scene[:2], found.radius_off_mm).tolist()
    found = replace(found, nuisances_sigma=replace(sigma, axis_across_mm=across, axis_away_mm=away))
    if not found.agree:
        return found
    by_wall, by_images = np.linalg.inv(found.by_wall_covariance), np.diag(found.nuisances_sigma.scene**-2)
    covariance = np.asarray(np.linalg.inv(by_wall + by_images), dtype=np.float64)
    axis = covariance @ (by_wall @ found.by_wall + by_images @ found.nuisances.scene)
    return replace(found, axis=axis, covariance=covariance)


def wall_by_places(
    position_mm: Floats, covariance_mm2: Floats, scene: MovableScene, start: Floats, frames: int = 1
) -> tuple[Floats, Floats, RoundWallFit, Floats]:
    """Return where the scene lies by the wall that particles end at: unknowns (4,), their covariance, wall and places.

    Parameters
    ----------
    position_mm, covariance_mm2 : (n, 3), (n, 3, 3) particles found behind the scene moved by `start`, world axes

    Raises
    ------
    InputError
        The particles do not show the wall.
    """
    camera, radius = scene.camera, scene.wall.radius_mm
    axis = start.copy()
    places, faces = camera.to_image_axes(position_mm), scene.faces(axis)
    for _ in range(MOST_STEPS):
        own = scene.about_axis(camera.to_image_axes(places), axis)
        # Distances from the axis err as places do along their direction from it.
        outward = camera.to_image_axes(places) - scene.on_axis(own[:, 0], axis)
        outward /= np.maximum(np.linalg.norm(outward, axis=1), np.finfo(np.float64).tiny)[:, np.newaxis]
        sigma = np.sqrt(np.einsum("ni,nij,nj->n", outward, covariance_mm2, outward))
        wall = find_round_wall(own, sigma, radius, radius + scene.beyond_mm, frames)
        less = np.linalg.inv(np.eye(4) - _following(places, own, scene, axis))
        step, covariance = less @ wall.axis, np.asarray(less @ wall.covariance @ less.T, dtype=np.float64)
        if np.all(np.abs(step) < FOUND_SHARE * np.array([radius, radius, 1.0, 1.0])):
            break
        axis = axis + step
        before, faces = faces, scene.faces(axis)
        places, _ = moved_places(places, before, faces, camera.aperture_radius_mm)
    return axis, covariance, wall, camera.to_image_axes(places)


def _following(places_mm: Floats, own_mm: Floats, scene: MovableScene, axis: Floats) -> Floats:
    """Return how far the wall that particles end at follows the scene: (4, 4), 0 where places stay as they are.

    Column j is the motion of the wall, by its unknowns, that unknown j of the scene takes along.
    """
    camera = scene.camera
    outer = np.hypot(own_mm[:, 1], own_mm[:, 2]) > np.sqrt(0.5 * (1.0 + RING_FROM**2)) * scene.wall.radius_mm
    places, own, here = places_mm[outer], own_mm[outer], scene.faces(axis)
    angle, along, frame = np.arctan2(own[:, 2], own[:, 1]), own[:, 0], scene.frame(axis)
    cosine, sine = np.cos(angle), np.sin(angle)
    outward = cosine[:, np.newaxis] * frame[1] + sine[:, np.newaxis] * frame[2]
    design = np.stack([cosine, sine, along * cosine, along * sine, np.ones(len(own))], axis=1)
    follows = np.empty((4, 4))
    for unknown, step in enumerate(nuisances.SCENE_STEPS):
        change = step * np.eye(4)[unknown]
        ahead, behind = scene.faces(axis + change), scene.faces(axis - change)
        by = nuisances.place_changes(places, ahead, behind, here, camera.aperture_radius_mm) / (2.0 * step)
        grown = np.sum(camera.to_image_axes(by) * outward, axis=1)
        follows[:, unknown] = np.linalg.lstsq(design, grown, rcond=None)[0][:4]
    return follows


def _weights(scene: MovableScene, values: Floats, volume: Grid, calibration: Calibration, view: View) -> Weights:
    """Return the weights of a volume that holds the pipe's section, as long as the given one, behind a moved scene."""
    space, camera = scene.moved(values), scene.camera
    deep = PLANES_APART * view.scale.depth_mm
    middle = scene.motion(values).points(scene.pivot_mm)
    reach = scene.wall.radius_mm + scene.beyond_mm
    (dx, dy, _), centre, lengths = volume.spacing_mm, middle.tolist(), [2.0 * reach] * 3
    # Along the pipe the volume's own length, across it all of the section.
    along = int(np.argmax(np.abs(scene.along)))
    low, high = volume.bounds_mm(along)
    centre[along], lengths[along] = 0.5 * (low + high), high - low
    nx, ny, nz = (max(1, int(np.ceil(length / step))) for length, step in zip(lengths, (dx, dy, deep), strict=True))
    grid = Grid.centred((nx, ny, nz), (dx, dy, deep), (centre[0], centre[1], centre[2]))
    padding = curved_padding(camera, space, grid)
    return Weights(grid, padding, operator_of(camera, space, grid.padded(padding)), camera.column_axis, calibration)


def _wall_in_view(view: View, scene: MovableScene, values: Floats, position_mm: Floats) -> Flags:
    """Return of which particles (n,) the light of the wall behind them, seen from the axis, falls on the sensor."""
    own = scene.about_axis(position_mm, values)
    distance = np.maximum(np.hypot(own[:, 1], own[:, 2]), np.finfo(np.float64).tiny)
    on_axis = scene.on_axis(own[:, 0], values)
    share = (scene.wall.radius_mm + scene.beyond_mm) / distance
    inner = scene.wall.radius_mm / distance
    half = 0.5 * view.camera.pixel_mm * np.array([view.camera.columns, view.camera.rows])
    seen = np.ones(len(own), dtype=np.bool_)
    for factor in (inner, 0.5 * (inner + share)):
        points = scene.camera.to_image_axes(on_axis + factor[:, np.newaxis] * (position_mm - on_axis))
        reach = np.abs(on_array_mm(view, points)) + footprint_radius_mm(view, points)[:, np.newaxis]
        seen &= np.all(reach < half, axis=1)
    return seen
