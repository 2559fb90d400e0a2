"""Volume self-calibration of the camera from an image of particles: Gauss-Newton on camera and particles at once.

The unknowns of the camera change the light of all particles, those of a particle (x, y, z, light) its own alone. With
the columns of the former freed of all that the latter can do (the Schur complement, by least squares with one sparse
matrix), a small system is left. Found this way are the mean shift of the lens images against those of the white image,
the main lens's aperture, the particles' size and the radial distortion. Focus and magnification are not: the particles'
places make up for them. Where the particles lie in a pipe, its place is found, too: behind its wall their light is
astigmatic by how they lie to its axis, which no place makes up for.

Axes: image axes, mm; see `view`. Particles are rows (x, y, z, light), images flat.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import lsqr

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.shapes import RigidMotion, vector
from lfpiv_cli.optics.surfaces import Cylinder, Faces
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import UNKNOWNS, Respond, lit_by, observation_of, respond_of, room_for
from lfpiv_cli.particles.noise import Noise
from lfpiv_cli.particles.pencil import MEAN_SQUARE, lines_of
from lfpiv_cli.particles.view import View, entry_capacity, with_radius
from lfpiv_cli.threads import blocks, in_threads

# A scene that lies a little elsewhere than it is said to, as one rigid body, known by the pipe's inner wall.
#
# Of the six ways to move a body the wall of a round pipe shows four: two shifts and two tilts of its axis. A shift
# along the axis and a turn about it leave the wall as it is, and are left alone.
#
# Axes: world axes, z away from the camera from the nominal focal point; lengths in mm. `along` runs along the pipe,
# `across` is square to it and to the optical axis, towards +x or +y, whichever is nearer to it; `away` is square to
# both, away from the camera. Of a pipe along y these three are left-handed.

# Where particles lie behind faces that are not where they were thought to be.
#
# What an image shows of a particle are its rays over the main lens; along image axis k their slopes are a straight
# line, (X_k - place_k) / distance_k, and a small rest (see `particles.pencil`). Behind other faces the same rays
# belong to another place: the one whose lines are closest to those of the first over the aperture's disc. As behind a
# pipe both distances differ and a place has only one depth, something is left where the faces are wrong.

# Gauss-Newton's iteration: faces that are shifted by 0.2 mm leave 1e-9 mm after four.
NEWTON_STEPS = 5


def moved_places(points_mm: Floats, before: Faces, after: Faces, radius_mm: float) -> tuple[Floats, Flags]:
    """Return where particles lie behind other faces, their rays being the same.

    Parameters
    ----------
    points_mm : (n, 3) behind the faces as they were
    radius_mm : of the main lens

    Returns
    -------
    Places (n, 3), and (n,) whether there are any; those that have none stay.
    """
    shown, _, seen = _lines(points_mm, before, radius_mm)
    places = points_mm.copy()
    for _ in range(NEWTON_STEPS):
        lines, moves, there = _lines(places, after, radius_mm)
        seen &= there
        places[seen] += _solved(moves[seen], (shown - lines)[seen])
    return np.where(seen[:, np.newaxis], places, points_mm), seen


def place_changes(points_mm: Floats, ahead: Faces, behind: Faces, here: Faces, radius_mm: float) -> Floats:
    """Return how far (n, 3) places move, their rays being the same, from faces `behind` to `ahead`; first order."""
    _, moves, seen = _lines(points_mm, here, radius_mm)
    first, _, seen_ahead = _lines(points_mm, ahead, radius_mm)
    second, _, seen_behind = _lines(points_mm, behind, radius_mm)
    seen &= seen_ahead & seen_behind
    changes = np.zeros_like(points_mm)
    changes[seen] = _solved(moves[seen], (second - first)[seen])
    return changes


def _solved(moves: Floats, wanted: Floats) -> Floats:
    """Return the steps (n, 3) that change lines (n, 4) by what is wanted, as nearly as they can."""
    turned = np.swapaxes(moves, 1, 2)
    return np.asarray(np.linalg.solve(turned @ moves, turned @ wanted[:, :, np.newaxis])[..., 0])


def _lines(points_mm: Floats, faces: Faces, radius_mm: float) -> tuple[Floats, Floats, Flags]:
    """Return the straight lines of the slopes of points (n, 4), their derivatives (n, 4, 3), and which are seen.

    The lines are slopes in the lens's middle, and by how much these grow to the root of the mean square over its disc.
    """
    lines, moves, _ = lines_of(faces, radius_mm, np.ascontiguousarray(points_mm))
    seen = np.all(lines[:, :, 1] > 0.0, axis=1)
    place, distance = lines[:, :, 0], np.where(seen[:, np.newaxis], lines[:, :, 1], 1.0)
    reach = radius_mm * np.sqrt(MEAN_SQUARE)
    further = moves[:, :, 1] / distance[..., np.newaxis] ** 2
    middle_moves = place[..., np.newaxis] * further - moves[:, :, 0] / distance[..., np.newaxis]
    shown = np.concatenate([-place / distance, reach / distance], axis=1)
    return shown, np.concatenate([middle_moves, -reach * further], axis=1), seen


# Seen from further along its axis, too little of a pipe's wall shows where it lies.
LEAST_ANGLE_TO_VIEW_DEG = 45.0
# Of a wall that is not where it was said to be particles may lie behind the said one: so much of its radius.
BEYOND_SHARE = 0.08
# The unknowns of a motion: the axis's place across the view and away from the camera, and its tilts towards both.
ACROSS, AWAY, TILT_ACROSS, TILT_AWAY = range(4)


@dataclass(frozen=True, eq=False)
class MovableScene:
    """A scene, and what of its place is not known.

    Attributes
    ----------
    space, camera : as they are said to be
    wall : the pipe's inner wall, the last face
    pivot_mm : the point of its axis that is nearest to the optical axis, about which it is tilted
    along, across, away : (3,) unit vectors
    """

    space: CurvedSpace
    camera: Camera
    wall: Cylinder
    pivot_mm: Floats
    along: Floats
    across: Floats
    away: Floats

    @classmethod
    def of(cls, space: CurvedSpace, camera: Camera) -> MovableScene:
        """Return the scene, to be moved.

        Raises
        ------
        ConfigError : particles do not tell where its wall is
        """
        wall = space.faces[-1].surface
        if not isinstance(wall, Cylinder) or wall.facing != "convex":
            raise ConfigError(
                "where particles end tells where a scene lies if its last face is a cylinder around the fluid, a "
                "pipe's inner wall; this one is not"
            )
        along = np.array(wall.axis) / np.linalg.norm(wall.axis)
        along = along if along[np.argmax(np.abs(along))] > 0.0 else -along
        angle = float(np.rad2deg(np.arccos(min(1.0, abs(along[2])))))
        if angle < LEAST_ANGLE_TO_VIEW_DEG:
            raise ConfigError(
                f"the pipe's axis lies {angle:.0f} degrees from the view; particles tell where its wall is from "
                f"{LEAST_ANGLE_TO_VIEW_DEG:g} degrees on"
            )
        across = np.cross((0.0, 0.0, 1.0), along)
        across /= np.linalg.norm(across) * np.sign(across[np.argmax(np.abs(across))])
        away = np.cross(along, across)
        away *= np.sign(away[2])
        centre = np.array(wall.centre_mm)
        pivot = centre - (centre[:2] @ along[:2]) / (along[:2] @ along[:2]) * along
        return cls(space, camera, wall, pivot, along, across, away)

    @property
    def turns(self) -> Floats:
        """Directions (2, 3) of the turns that tilt the axis across and away."""
        return np.cross(self.along, [self.across, self.away])

    @property
    def beyond_mm(self) -> float:
        """How far beyond the wall particles are looked for."""
        return BEYOND_SHARE * self.wall.radius_mm

    def motion(self, values: Floats) -> RigidMotion:
        """Return the motion by unknowns (4,): mm across and away, rad towards across and away."""
        shift = values[ACROSS] * self.across + values[AWAY] * self.away
        turn = values[[TILT_ACROSS, TILT_AWAY]] @ self.turns
        return RigidMotion(vector(shift), vector(turn), vector(self.pivot_mm))

    def moved(self, values: Floats) -> CurvedSpace:
        """Return the scene moved by unknowns (4,).

        Raises
        ------
        ConfigError : the optical axis misses a face then
        """
        return self.space.moved(self.motion(values))

    def faces(self, values: Floats) -> Faces:
        """Return the faces moved by unknowns (4,), the fluid going on a little beyond its wall."""
        return self.moved(values).for_kernels(self.camera)._replace(beyond_mm=self.beyond_mm)

    def frame(self, values: Floats) -> Floats:
        """Return the directions along, across and away (3, 3) of the pipe moved by unknowns (4,)."""
        return self.motion(values).directions(np.stack([self.along, self.across, self.away]))

    def about_axis(self, points_mm: Floats, values: Floats) -> Floats:
        """Return points (n, 3), world axes, in the moved pipe's frame (n, 3): along, across and away from the pivot."""
        return np.asarray((points_mm - self.motion(values).points(self.pivot_mm)) @ self.frame(values).T)

    def on_axis(self, along_mm: Floats, values: Floats) -> Floats:
        """Return the points (n, 3), world axes, of the moved pipe's axis at places (n,) along it."""
        return self.motion(values).points(self.pivot_mm) + np.outer(along_mm, self.frame(values)[0])


# What the images of particles tell of camera, particles and scene.

# A round with this many sweeps over the particles leaves a sixth of an error, four leave 1e-3 of it. They end earlier
# when a step is within what the optics model gets wrong.
ROUNDS, SWEEPS = 4, 3
# What is not explained yet counts for little, as in the last sweeps of the search.
UNEXPLAINED = 0.02
# Least squares: the columns are good to a thousandth after some forty steps.
LEAST_SQUARES_STEPS, LEAST_SQUARES_TOLERANCE = 50, 1e-4
# Of the scene in mm and rad: over a field of 10 mm both move light by a tenth of a pixel and less.
SCENE_STEPS = (2e-3, 2e-3, 5e-4, 5e-4)
MODEL_SCENE = (1e-3, 1e-3, 2e-4, 2e-4)
# Differences: shift as a share of the pitch, shares of aperture and particle radius, and distortion in stretch at the
# sensor's corner.
STEPS = np.array([2.5e-3, 2.5e-3, 0.004, 0.004, 1e-4, *SCENE_STEPS])
# What the optics model itself gets wrong, likewise: on an image traced ray by ray by another program, true to 4e-5 of
# the pitch, aperture, radius and distortion came out 0.05 %, 0.7 % and 8e-5 (of stretch at the corner) off.
MODEL_ERRORS = np.array([1e-4, 1e-4, 6e-4, 0.01, 1.5e-4, *MODEL_SCENE])
# The camera's unknowns stand before those of the scene.
OF_CAMERA = 5
# Particles whose columns are made at a time.
BLOCK = 64
# A particle whose centre is found within this many of its radii of a pipe's wall touches it: what the wall does to its
# light no place makes up for, and of 860 particles 30 such moved the axis by 0.007 mm, thirty of its standard errors.
TOUCHING_RADII = 2.0
# Noise about zero is no light: pixels count as lit above this many standard deviations of the read noise.
LIT_SIGMAS = 5.0


@dataclass(frozen=True)
class Nuisances:
    """Unknowns of the camera, as changes of a view or as their standard errors.

    Attributes
    ----------
    shift_x_mm, shift_y_mm : of all lens centres, on the array
    aperture_radius_mm, particle_radius_mm : of main lens and particles
    distortion_per_mm2 : k1
    axis_across_mm, axis_away_mm, tilt_across_rad, tilt_away_rad : of a scene, see `MovableScene`
    """

    shift_x_mm: float = 0.0
    shift_y_mm: float = 0.0
    aperture_radius_mm: float = 0.0
    particle_radius_mm: float = 0.0
    distortion_per_mm2: float = 0.0
    axis_across_mm: float = 0.0
    axis_away_mm: float = 0.0
    tilt_across_rad: float = 0.0
    tilt_away_rad: float = 0.0

    @property
    def scene(self) -> Floats:
        """Those of a scene (4,)."""
        return self.whole[OF_CAMERA:]

    @property
    def whole(self) -> Floats:
        """All of them as an array (9,), in the order of the attributes."""
        return np.array([getattr(self, field.name) for field in fields(self)])

    @classmethod
    def of(cls, values: Floats) -> Nuisances:
        """Return them from an array in the order of the attributes."""
        return cls(*(float(value) for value in values))

    def applied(self, view: View, scene: MovableScene | None = None) -> View:
        """Return the view with these changes; those of a scene where there is one, from where it is said to be."""
        camera, shift = view.camera, np.array([self.shift_x_mm, self.shift_y_mm])
        camera = camera._replace(
            origin_mm=camera.origin_mm + shift,
            aperture_radius_mm=camera.aperture_radius_mm + self.aperture_radius_mm,
            distortion_per_mm2=camera.distortion_per_mm2 + self.distortion_per_mm2,
        )
        if self.particle_radius_mm != 0.0:
            view = with_radius(view, view.particle_radius_mm + self.particle_radius_mm)
        return view._replace(
            camera=camera,
            centres_mm=view.centres_mm + shift,
            faces=view.faces if scene is None else scene.faces(self.scene),
        )


@dataclass(frozen=True, eq=False)
class NuisanceFit:
    """What was found.

    Attributes
    ----------
    found, sigma : changes of the view that was given, and their standard errors; by waves that of the aperture, which
        is not sought, is NaN
    view : with these changes
    particles : (n, 4) refined with it
    """

    found: Nuisances
    sigma: Nuisances
    view: View
    particles: Floats


def fit_nuisances(
    image: Floats,
    view: View,
    particles: Floats,
    noise: Noise,
    depths_mm: tuple[float, float],
    scene: MovableScene | None = None,
    start: Nuisances | None = None,
) -> NuisanceFit:
    """Find what explains an image better, the camera and all particles free.

    Parameters
    ----------
    image : (rows * columns,) raw, dark and background taken off, counts
    particles : (n, 4) that explain it with the view as it is
    depths_mm : between which they may lie
    scene : through whose faces the particles are seen, free as well; None: what is seen through is as it is
    start : what is known before; the particles explain the image with it
    """
    by_waves = view.lines.table.shape[0] > 0
    corner_mm = 0.5 * view.camera.pixel_mm * float(np.hypot(view.camera.columns, view.camera.rows))
    radii = view.camera.aperture_radius_mm, view.particle_radius_mm
    of_scene = np.full(4, 0.0 if scene is None else 1.0)
    size = np.array([2.0 * view.half_x_mm, 2.0 * view.half_y_mm, *radii, 1.0, *of_scene])
    over = np.array([1.0, 1.0, 1.0, 1.0, corner_mm**2, *np.ones(4)])
    model, unit = MODEL_ERRORS * size / over, STEPS * size / over
    if by_waves:
        # Line responses are of one aperture.
        unit[2] = 0.0
    sought = np.flatnonzero(unit)
    known = Nuisances() if start is None else start
    particles, total, sigma = particles.copy(), known.whole, model
    changed = known.applied(view, scene)
    for _ in range(ROUNDS):
        residual, weight = _refined(image, changed, particles, noise, depths_mm)
        lit = image - residual > LIT_SIGMAS * noise.read_counts
        if scene is not None:
            at_wall = _light(changed, particles[_touching(particles, changed, scene, total)], image.size, depths_mm)
            weight, lit = np.where(at_wall > 0.0, 0.0, weight), lit & (at_wall <= 0.0)
        root = np.sqrt(weight)
        own, free = _columns(changed, particles, root, entry_capacity(changed, *depths_mm)), []
        for change in np.diag(unit)[sought]:
            difference = np.zeros(residual.size)
            for sign in (1.0, -1.0):
                ahead = Nuisances.of(total + sign * change).applied(view, scene)
                # Least squares would take long to free a scene's motion of what the particles' places make up for.
                seen = particles if scene is None else _moved(particles, changed, ahead)
                difference += sign * _light(ahead, seen, residual.size, depths_mm)
            free.append(_freed(own, 0.5 * root * difference))
        left, design = _freed(own, root * residual), np.stack(free, axis=1)
        covariance = np.linalg.inv(design.T @ design)
        # What neighbours leave unexplained is as large an error as noise: the scatter says how large.
        scatter = float(left[lit] @ left[lit]) / max(1, int(lit.sum()))
        step, sigma = np.zeros(unit.size), np.zeros(unit.size)
        step[sought] = covariance @ (design.T @ left)
        sigma[sought] = np.sqrt(np.diag(covariance) * max(scatter, 1.0))
        step, sigma = step * unit, sigma * unit
        total = total + step
        before, changed = changed, Nuisances.of(total).applied(view, scene)
        if scene is not None:
            particles = _moved(particles, before, changed)
        if np.all(np.abs(step) <= model):
            break
    found, error = Nuisances.of(total), Nuisances.of(np.hypot(sigma, model))
    if by_waves:
        error = replace(error, aperture_radius_mm=float("nan"))
    _refined(image, changed, particles, noise, depths_mm)
    return NuisanceFit(found, error, changed, particles)


def _refined(
    image: Floats, view: View, particles: Floats, noise: Noise, depths_mm: tuple[float, float]
) -> tuple[Floats, Floats]:
    """Refine particles in place; return what they leave of the image, and the weights of its pixels."""
    residual = image - _light(view, particles, image.size, depths_mm)
    for _ in range(SWEEPS):
        weight = noise.weights(image - residual, residual, UNEXPLAINED)
        refine(observation_of(view, residual, weight, depths_mm), particles)
    return residual, noise.weights(image - residual, residual, UNEXPLAINED)


def _light(view: View, particles: Floats, pixels: int, depths_mm: tuple[float, float]) -> Floats:
    """Return the light (pixels,) of all particles."""
    image = np.zeros(pixels)
    add_all(view, particles, 1.0, image, depths_mm)
    return image


def _touching(particles: Floats, view: View, scene: MovableScene, total: Floats) -> Flags:
    """Return which particles (n, 4) touch the wall of a pipe that lies where all unknowns (9,) have it."""
    own = scene.about_axis(scene.camera.to_image_axes(particles[:, :3]), total[OF_CAMERA:])
    inside = scene.wall.radius_mm - TOUCHING_RADII * view.particle_radius_mm
    return np.asarray(np.hypot(own[:, 1], own[:, 2]) > inside)


def _moved(particles: Floats, before: View, after: View) -> Floats:
    """Return particles (n, 4) where they lie behind the faces of another view, their rays being the same."""
    places, _ = moved_places(particles[:, :3], before.faces, after.faces, before.camera.aperture_radius_mm)
    return np.column_stack([places, particles[:, 3]])


def _freed(own: csc_matrix, column: Floats) -> Floats:
    """Return what of a column no particle can make up for."""
    solution = lsqr(
        own,
        column.astype(np.float32),
        atol=LEAST_SQUARES_TOLERANCE,
        btol=LEAST_SQUARES_TOLERANCE,
        iter_lim=LEAST_SQUARES_STEPS,
    )[0]
    return np.asarray(column - own @ solution, dtype=np.float64)


def _columns(view: View, particles: Floats, root_weight: Floats, capacity: int) -> csc_matrix:
    """Return the weighted derivatives by x, y, z and light of each particle, scaled to length 1, as sparse columns."""
    respond = respond_of(view)
    parts = in_threads(
        lambda part: _entries(respond, view, particles[part], root_weight, capacity), blocks(len(particles), BLOCK)
    )
    counts, rows, data = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    starts = np.concatenate([[0], np.cumsum(np.repeat(counts, UNKNOWNS))])
    return csc_matrix((data, rows, starts), shape=(root_weight.size, UNKNOWNS * len(particles)))


@njit(cache=True, nogil=True)
def _entries(
    respond: Respond, view: View, particles: Floats, root_weight: Floats, capacity: int
) -> tuple[Integers, NDArray[np.int32], Singles]:
    """Return of particles (n, 4) how many pixels each lights, and rows and values of their columns."""
    counts, at = np.zeros(len(particles), np.int64), 0
    size = UNKNOWNS * len(particles) * capacity
    data, rows = np.empty(size, np.float32), np.empty(size, np.int32)
    responses = room_for(1, capacity, 0)
    for n in range(len(particles)):
        respond(view, particles[n : n + 1], responses)
        lit, light = lit_by(responses, 0)
        counts[n] = lit.size
        for k in range(UNKNOWNS):
            length2 = 0.0
            for entry in range(lit.size):
                length2 += (root_weight[lit[entry]] * light[k, entry]) ** 2
            scale = 1.0 / np.sqrt(length2) if length2 > 0.0 else 0.0
            for entry in range(lit.size):
                rows[at] = lit[entry]
                data[at] = scale * root_weight[lit[entry]] * light[k, entry]
                at += 1
    return counts, rows[:at].copy(), data[:at].copy()
