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
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import lsqr

from lfpiv_cli.particles.cells import rim_table
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import UNKNOWNS, lit_by, observation_of, respond_all, room_for
from lfpiv_cli.particles.noise import Noise
from lfpiv_cli.particles.view import View, entry_capacity, with_radius
from lfpiv_cli.self_calibration.movable_scene import MovableScene, moved_places
from lfpiv_cli.threads import blocks, in_threads

# A round with this many sweeps over the particles leaves a sixth of an error, four leave 1e-3 of it. They end earlier
# when a step is within what the optics model gets wrong.
ROUNDS, SWEEPS = 4, 3
# What is not explained yet counts for little, as in the last sweeps of the search.
UNEXPLAINED = 0.02
# Least squares: the columns are good to a thousandth after some forty steps.
LEAST_SQUARES_STEPS, LEAST_SQUARES_TOLERANCE = 50, 1e-4
# Differences: shift as a share of the pitch, shares of aperture and particle radius, and distortion in stretch at the
# sensor's corner.
SHIFT_STEP, SHARE_STEP, STRETCH_STEP = 2.5e-3, 0.004, 1e-4
# What the optics model itself gets wrong: on an image traced ray by ray by another program, true to 4e-5 of the pitch,
# aperture, radius and distortion came out 0.05 %, 0.7 % and 8e-5 (of stretch at the corner) off.
MODEL_SHARE_OF_PITCH, MODEL_SHARE_OF_APERTURE, MODEL_SHARE_OF_RADIUS, MODEL_STRETCH = 1e-4, 6e-4, 0.01, 1.5e-4
# Of the scene in mm and rad: over a field of 10 mm both move light by a tenth of a pixel and less.
SCENE_STEPS = (2e-3, 2e-3, 5e-4, 5e-4)
MODEL_SCENE = (1e-3, 1e-3, 2e-4, 2e-4)
# The camera's unknowns stand before those of the scene.
OF_CAMERA = 5
# Particles whose columns are made at a time.
BLOCK = 64
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
    axis_across_mm, axis_away_mm, tilt_across_rad, tilt_away_rad : of a scene, see `movable_scene`
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
    def values(self) -> NDArray[np.float64]:
        """Those of camera and particles as an array (5,), in the order of the attributes."""
        return self.whole[:OF_CAMERA]

    @property
    def scene(self) -> NDArray[np.float64]:
        """Those of a scene (4,)."""
        return self.whole[OF_CAMERA:]

    @property
    def whole(self) -> NDArray[np.float64]:
        """All of them as an array (9,), in the order of the attributes."""
        return np.array([getattr(self, field.name) for field in fields(self)])

    @classmethod
    def of(cls, values: NDArray[np.float64]) -> Nuisances:
        """Return them from an array in the order of the attributes."""
        return cls(*(float(value) for value in values))

    def applied(self, view: View, scene: MovableScene | None = None) -> View:
        """Return the view with these changes; those of a scene where there is one, from where it is said to be."""
        camera, shift = view.camera, np.array([self.shift_x_mm, self.shift_y_mm])
        radius, table, reach = camera.aperture_radius_mm, view.table, view.table_reach
        if self.aperture_radius_mm != 0.0:
            radius += self.aperture_radius_mm
            table, reach = rim_table(radius, camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm)
        camera = camera._replace(
            origin_mm=camera.origin_mm + shift,
            aperture_radius_mm=radius,
            distortion_per_mm2=camera.distortion_per_mm2 + self.distortion_per_mm2,
        )
        if self.particle_radius_mm != 0.0:
            view = with_radius(view, view.particle_radius_mm + self.particle_radius_mm)
        return view._replace(
            camera=camera,
            centres_mm=view.centres_mm + shift,
            table=table,
            table_reach=reach,
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
    particles: NDArray[np.float64]


def fit_nuisances(
    image: NDArray[np.float64],
    view: View,
    particles: NDArray[np.float64],
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
    model, known = _model_errors(view, scene), Nuisances() if start is None else start
    particles, total, sigma = particles.copy(), known.whole, model
    changed = known.applied(view, scene)
    for _ in range(ROUNDS):
        residual, weight = _refined(image, changed, particles, noise, depths_mm)
        lit = image - residual > LIT_SIGMAS * noise.read_counts
        unknowns = _Unknowns(view, scene, total, depths_mm)
        step, sigma = _gauss_newton(unknowns, particles, residual, np.sqrt(weight), lit)
        total = total + step
        before, changed = changed, Nuisances.of(total).applied(view, scene)
        if scene is not None:
            particles = _moved(particles, before, changed)
        if np.all(np.abs(step) <= model):
            break
    found, error = Nuisances.of(total), Nuisances.of(np.hypot(sigma, model))
    if view.lines.table.shape[0] > 0:
        error = replace(error, aperture_radius_mm=float("nan"))
    _refined(image, changed, particles, noise, depths_mm)
    return NuisanceFit(found, error, changed, particles)


class _Unknowns(NamedTuple):
    """What is sought of a view: all of `Nuisances`, but those of a scene only where there is one."""

    view: View
    scene: MovableScene | None
    values: NDArray[np.float64]
    depths_mm: tuple[float, float]

    @property
    def steps(self) -> NDArray[np.float64]:
        """The steps (9,) of the differences, 0 of what is not sought: line responses are of one aperture."""
        shares = SHARE_STEP * np.array([self.view.camera.aperture_radius_mm, self.view.particle_radius_mm])
        if self.view.lines.table.shape[0] > 0:
            shares[0] = 0.0
        shift = 2.0 * SHIFT_STEP * np.array([self.view.half_x_mm, self.view.half_y_mm])
        scene = np.zeros(len(SCENE_STEPS)) if self.scene is None else np.array(SCENE_STEPS)
        return np.array([*shift, *shares, STRETCH_STEP / _corner_mm(self.view) ** 2, *scene])

    def with_change(self, change: NDArray[np.float64] | float) -> View:
        """Return the view with the values, changed by (9,)."""
        return Nuisances.of(self.values + change).applied(self.view, self.scene)


def _model_errors(view: View, scene: MovableScene | None) -> NDArray[np.float64]:
    """Return what the optics model gets wrong of the unknowns (9,)."""
    return np.array(
        [
            2.0 * MODEL_SHARE_OF_PITCH * view.half_x_mm,
            2.0 * MODEL_SHARE_OF_PITCH * view.half_y_mm,
            MODEL_SHARE_OF_APERTURE * view.camera.aperture_radius_mm,
            MODEL_SHARE_OF_RADIUS * view.particle_radius_mm,
            MODEL_STRETCH / _corner_mm(view) ** 2,
            *(np.zeros(len(MODEL_SCENE)) if scene is None else MODEL_SCENE),
        ]
    )


def _refined(
    image: NDArray[np.float64],
    view: View,
    particles: NDArray[np.float64],
    noise: Noise,
    depths_mm: tuple[float, float],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Refine particles in place; return what they leave of the image, and the weights of its pixels."""
    residual = image - _light(view, particles, image.size, depths_mm)
    for _ in range(SWEEPS):
        weight = noise.weights(image - residual, residual, UNEXPLAINED)
        refine(observation_of(view, residual, weight, depths_mm), particles)
    return residual, noise.weights(image - residual, residual, UNEXPLAINED)


def _light(
    view: View, particles: NDArray[np.float64], pixels: int, depths_mm: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the light (pixels,) of all particles."""
    image = np.zeros(pixels)
    add_all(view, particles, 1.0, image, depths_mm)
    return image


def _gauss_newton(
    unknowns: _Unknowns,
    particles: NDArray[np.float64],
    residual: NDArray[np.float64],
    root_weight: NDArray[np.float64],
    lit: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the next step of the unknowns and their standard errors, (9,) each, 0 of what is not sought."""
    view, depths, unit = unknowns.with_change(0.0), unknowns.depths_mm, unknowns.steps
    own = _columns(view, particles, root_weight, entry_capacity(view, *depths))
    sought, free = np.flatnonzero(unit), []
    for step in np.diag(unit)[sought]:
        difference = np.zeros(residual.size)
        for sign in (1.0, -1.0):
            changed = unknowns.with_change(sign * step)
            # Least squares would take long to free a scene's motion of what the particles' places make up for.
            seen = particles if unknowns.scene is None else _moved(particles, view, changed)
            difference += sign * _light(changed, seen, residual.size, depths)
        free.append(_freed(own, 0.5 * root_weight * difference))
    left = _freed(own, root_weight * residual)
    design = np.stack(free, axis=1)
    covariance = np.linalg.inv(design.T @ design)
    # What neighbours leave unexplained is as large an error as noise: the scatter says how large.
    scatter = float(left[lit] @ left[lit]) / max(1, int(lit.sum()))
    step, sigma = np.zeros(unit.size), np.zeros(unit.size)
    step[sought] = covariance @ (design.T @ left)
    sigma[sought] = np.sqrt(np.diag(covariance) * max(scatter, 1.0))
    return step * unit, sigma * unit


def _moved(particles: NDArray[np.float64], before: View, after: View) -> NDArray[np.float64]:
    """Return particles (n, 4) where they lie behind the faces of another view, their rays being the same."""
    places, _ = moved_places(particles[:, :3], before.faces, after.faces, before.camera.aperture_radius_mm)
    return np.column_stack([places, particles[:, 3]])


def _freed(own: csc_matrix, column: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what of a column no particle can make up for."""
    solution = lsqr(
        own,
        column.astype(np.float32),
        atol=LEAST_SQUARES_TOLERANCE,
        btol=LEAST_SQUARES_TOLERANCE,
        iter_lim=LEAST_SQUARES_STEPS,
    )[0]
    return np.asarray(column - own @ solution, dtype=np.float64)


def _corner_mm(view: View) -> float:
    """Return how far the sensor's corner is from the axis."""
    return 0.5 * view.camera.pixel_mm * float(np.hypot(view.camera.columns, view.camera.rows))


def _columns(view: View, particles: NDArray[np.float64], root_weight: NDArray[np.float64], capacity: int) -> csc_matrix:
    """Return the weighted derivatives by x, y, z and light of each particle, scaled to length 1, as sparse columns."""

    def of(part: slice) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]:
        counts, pixels, values = _entries(view, particles[part], capacity)
        return counts, *_scaled(counts, pixels, values, root_weight)

    parts = in_threads(of, blocks(len(particles), BLOCK))
    counts, rows, data = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    starts = np.concatenate([[0], np.cumsum(np.repeat(counts, UNKNOWNS))])
    return csc_matrix((data, rows, starts), shape=(root_weight.size, UNKNOWNS * len(particles)))


@njit(cache=True, nogil=True)
def _entries(
    view: View, particles: NDArray[np.float64], capacity: int
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64]]:
    """Return of particles (n, 4) how many pixels each lights, which, and the values (pixels, 4) of unit light."""
    counts, end = np.zeros(len(particles), np.int64), 0
    pixels, values = np.empty(len(particles) * capacity, np.int32), np.empty((len(particles) * capacity, UNKNOWNS))
    responses = room_for(1, capacity, 0)
    for n in range(len(particles)):
        respond_all(view, particles[n : n + 1], responses)
        lit, light = lit_by(responses, 0)
        counts[n] = lit.size
        for k in range(lit.size):
            pixels[end + k] = lit[k]
            for m in range(UNKNOWNS):
                values[end + k, m] = light[m, k]
        end += lit.size
    return counts, pixels[:end].copy(), values[:end].copy()


@njit(cache=True, nogil=True)
def _scaled(
    counts: NDArray[np.int64],
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
    root_weight: NDArray[np.float64],
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Return rows and values of the columns of some particles, from their entries."""
    data, rows = np.empty(UNKNOWNS * pixels.size, np.float32), np.empty(UNKNOWNS * pixels.size, np.int32)
    begin = at = 0
    for count in counts:
        for k in range(UNKNOWNS):
            length2 = 0.0
            for entry in range(begin, begin + count):
                length2 += (root_weight[pixels[entry]] * values[entry, k]) ** 2
            scale = 1.0 / np.sqrt(length2) if length2 > 0.0 else 0.0
            for entry in range(begin, begin + count):
                rows[at] = pixels[entry]
                data[at] = scale * root_weight[pixels[entry]] * values[entry, k]
                at += 1
        begin += count
    return rows, data
