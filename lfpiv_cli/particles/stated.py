"""What is stated of the particles of an image once the search ends: where they are, how surely, and what is left.

Axes: inside, particles are rows (x, y, z, light) in image axes, mm and counts, and images flat; results are in world
axes of the raw sensor, z from the nominal focal point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import ndtri

from lfpiv_cli.arrays import Floats
from lfpiv_cli.particles.covariance import change_shown, joint_covariance
from lfpiv_cli.particles.fitting import add_all, judge, other_ends
from lfpiv_cli.particles.least_squares import CHOICE_GAIN, Effort, Observation
from lfpiv_cli.particles.noise import LIT_SIGMAS, ROUNDING_COUNTS, Noise, error_correlation, mean_whole
from lfpiv_cli.particles.search import (
    LAST_SWEEPS,
    LAST_UNEXPLAINED,
    MARGIN_DEPTHS,
    State,
    Task,
    disturbance,
    observed,
    prune,
    rebuilt,
    sweep,
    with_measured_noise,
)
from lfpiv_cli.particles.view import View, by_waves, footprint_radius_mm, lens_pixels, on_array_mm, with_diffusion
from lfpiv_cli.robust import MAD_TO_SIGMA

# For errors it is that of the particles that fit best, at most 1: crowds make noise seem larger than it is. What others
# exceed it by is light of neighbours that were not found, or wrongly. A particle takes up most of what is like its own
# light, and shows the less of it; so their variance grows with the root of chi-squared, by this factor: of tracers at
# twice the best ones' chi-squared it is five times as large, of those at a hundred times a hundred times. Roots that
# exceed the best one by less may still be noise, and count for less: what is stated weighs tracks against each other.
BEST_PERCENTILE, TAKEN_UP, DOUBTFUL_EXCESS = 5.0, 12.0, 0.15
# Noise that grows with a particle's light is none of its neighbours: the best ones are those of so many classes of
# light, of at least so many particles.
CLASSES, SMALLEST_CLASS = 8, 60
# What raises chi-squared further is plain in each particle that it concerns, and concerns others no more.
PLAIN_CHI2 = 3.0
# Particles of which so much is seen tell what fits best.
LEAST_SEEN = 0.5
# Pixels at the rim of lens images are lit in part, which the model of light by rays knows to first order. Of tracers of
# up to this radius, in lenses, depths are wrong by this share where a lens has so many pixels, and by less the larger
# tracers are and by its square the more pixels there are: of 16 single bright ones by 0.0015, rms.
RIM_SHARE, RIM_PIXELS, RIM_LENSES = 1.8e-3, 64.0, 0.1
# Counts are coarse where noise is this at most: 0.3 that is rounded, in an image and its dark one. Light above so many
# is rounded up as often as down. Haze too faint to be certain is uneven by this share. How light of about a
# count is rounded follows from where particles are, and these from that: after so many rounds their errors are noise's.
COARSE_COUNTS, LIT_COUNTS, UNEVEN_SHARE, OFFSET_ROUNDS = 0.6, 4.0, 0.3, 2


@dataclass(frozen=True, eq=False)
class Particles:
    """The particles of an image.

    Attributes
    ----------
    position_mm : (n, 3) world axes
    light_counts : (n,) all that passes the main lens
    light_sigma_counts : (n,) its standard error
    covariance_mm2 : (n, 3, 3) of the position, the camera taken to be as calibrated
    chi2 : (n,) mean of residual^2 / variance over the particle's light, about 1 where all is explained
    seen : (n,) share of its light that meets the sensor
    ambiguous : (n,) whether another depth explains its light about as well
    beyond : (n,) whether it ends at the first or last depth that it may have: it lies there or further out
    residual : (rows, columns) what the particles leave of the image, counts
    left, alike : share of the light that it is where particles light pixels, and of that what is alike in pixels side
        by side, as noise is not
    noise : of the image
    offset_counts : what rounding adds to light, as the particles show it; None: not looked for
    """

    position_mm: Floats
    light_counts: Floats
    light_sigma_counts: Floats
    covariance_mm2: Floats
    chi2: Floats
    seen: Floats
    ambiguous: NDArray[np.bool_]
    beyond: NDArray[np.bool_]
    residual: Floats
    left: float
    alike: float
    noise: Noise
    offset_counts: float | None


def missing_light(chi2: Floats, light: Floats, known: NDArray[np.bool_], pixels: float | Floats) -> Floats:
    """Return by what factor light that was not found raises the variance of particles (n,), 1 or more.

    Parameters
    ----------
    chi2, light, known : (n,) of the particles, and whether they are well seen
    pixels : over which that light is spread, of each (n,) or of all: of as many, noise alone scatters chi-squared
    """
    scatter = np.sqrt(2.0 / pixels)
    best, noisier = np.ones((2, len(chi2)))
    if known.any():
        fit_best = float(np.percentile(chi2[known], BEST_PERCENTILE))
        # The best ones of many are by chance below what noise makes.
        best = np.minimum(fit_best / (1.0 + scatter * ndtri(0.01 * BEST_PERCENTILE)), 1.0)
        number = int(np.clip(np.count_nonzero(known) // SMALLEST_CLASS, 1, CLASSES))
        classes = np.array_split(np.flatnonzero(known)[np.argsort(light[known], kind="stable")], number)
        of_classes = [float(np.percentile(chi2[members], BEST_PERCENTILE)) for members in classes]
        middles = [float(np.median(light[members])) for members in classes]
        noisier = np.interp(light, middles, of_classes) / max(fit_best, np.finfo(np.float64).tiny)
    over = np.sqrt(np.maximum(chi2 / (noisier * best * (1.0 + scatter)), 1.0)) - 1.0
    return np.asarray(np.maximum(noisier, 1.0) * (1.0 + TAKEN_UP * over**2 / (over + DOUBTFUL_EXCESS)))


def missing_around(view: View, particles: Floats, chi2: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return `missing_light` of particles (n, 4) by chi-squared (n,) of each, or of all around where that says more.

    What is missing may hide in noise in each of them, and shows in all together.
    """
    light, pixels = particles[:, 3], lens_pixels(view)
    number = 1.0 + disturbance(view, particles, np.ones(len(particles)))
    together = (chi2 + disturbance(view, particles, np.minimum(chi2, PLAIN_CHI2))) / number
    return np.maximum(missing_light(chi2, light, known, pixels), missing_light(together, light, known, pixels * number))


def rim_error(view: View) -> float:
    """Return by what share of their depths particles are wrong where lens images are few pixels wide."""
    larger = max(view.particle_radius_mm / (RIM_LENSES * view.scale.lens_mm), 1.0)
    return RIM_SHARE / larger * (RIM_PIXELS / lens_pixels(view)) ** 2


def with_offset_known(task: Task, state: State) -> tuple[Task, State]:
    """Return the task with what rounding adds to light or takes off it, as particles show it, and the state with that.

    With little noise a dark level between two counts is recorded as one of them, and where light varies from pixel to
    pixel as either: all light is up to half a count off, and no dark pixel shows it.
    """
    if task.read_counts > COARSE_COUNTS or not len(state.particles):
        return task, state
    image = task.image[task.usable]
    if 2 * np.count_nonzero(image == np.rint(image)) <= image.size:
        return task, state
    model, observation = task.light - state.residual, observed(task, state, LAST_UNEXPLAINED)
    lit = observation._replace(weight=np.where(model > LIT_COUNTS, observation.weight, 0.0))
    shown, error = change_shown(lit, state.particles, np.ones_like(model))
    # Between two counts it lies without any light.
    variance = 1.0 / (ROUNDING_COUNTS**-2 + error**-2)
    offset = variance / error**2 * shown
    dark = task.usable & (model <= 0.0)
    uneven = UNEVEN_SHARE * float(np.mean(state.residual[dark])) if dark.any() else 0.0
    before = np.zeros_like(model) if task.haze_error is None else task.haze_error
    after = np.sqrt(np.maximum(before**2 - ROUNDING_COUNTS**2, 0.0) + variance + uneven**2)
    task = replace(task, haze_error=after, offset_counts=offset)
    haze = task.haze
    for _ in range(OFFSET_ROUNDS):
        light = np.maximum(task.light - state.residual, 0.0)
        sigma = np.sqrt(task.read_counts**2 - ROUNDING_COUNTS**2 + state.noise.gain_counts * light)
        # Dark pixels are as the dark image has them.
        added = np.where(light > 0.0, np.maximum(mean_whole(light + offset, sigma), 0.0) - light, 0.0)
        task = replace(task, haze=added if haze is None else haze + added)
        state = rebuilt(task, state, state.particles.copy())
        sweep(task, state, LAST_UNEXPLAINED, LAST_SWEEPS)
        state = with_measured_noise(task, state, rims=True)
    # With less light a particle may have none left.
    return task, prune(task, state, 0.0, LAST_UNEXPLAINED)[0]


def result(task: Task, state: State) -> Particles:
    """Return the particles in world axes, brightest first."""
    task, state = with_offset_known(task, state)
    shape = task.prepared.shape
    order = np.argsort(-state.particles[:, 3], kind="stable")
    particles = state.particles[order]
    observation = observed(task, state, 0.0)
    chi2, _, _, seen = judge(observation, particles)
    images = (task.light - state.residual, state.residual, observation.weight)
    model, left, trust = (values.reshape(shape) for values in images)
    correlation = error_correlation(model, left, trust, state.noise)
    changes = [] if task.haze_error is None else [task.haze_error]
    if task.light_covariance is not None:
        changes.extend(changes_of_light(task.view, particles, task.light_covariance, task.depths_mm))
    missing = missing_around(task.view, particles, chi2, seen > LEAST_SEEN)
    covariance = joint_covariance(observation, particles, correlation, missing, np.array(changes) if changes else None)
    # Where there is a model: elsewhere is the light of particles that were not found.
    lit = task.usable & (task.light - state.residual > LIT_SIGMAS * state.noise.read_counts)
    noise = state.noise.of_dark(None if task.haze is None else task.haze[lit])
    share = light_left(task.light[lit], state.residual[lit], noise)
    covariance = grown(task.view, particles, covariance, share, correlation.share)
    covariance, ambiguous = with_other_places(observation, particles, covariance, chi2, correlation.share)
    covariance = covariance + of_two(task.view, particles, seen > LEAST_SEEN)
    if not by_waves(task.view):
        covariance[:, 2, 2] += (rim_error(task.view) * particles[:, 2]) ** 2
    beyond = np.isin(particles[:, 2], task.depths_mm)
    covariance[beyond, 2, 2] += (MARGIN_DEPTHS * task.view.scale.depth_mm) ** 2
    to_world = task.camera.to_image_axes(np.eye(3))
    return Particles(
        position_mm=task.camera.to_image_axes(particles[:, :3]),
        light_counts=particles[:, 3].copy(),
        light_sigma_counts=np.sqrt(covariance[:, 3, 3]),
        covariance_mm2=to_world @ covariance[:, :3, :3] @ to_world.T,
        chi2=chi2,
        seen=seen,
        ambiguous=ambiguous,
        beyond=beyond,
        residual=state.residual.reshape(shape),
        left=share,
        alike=correlation.share,
        noise=state.noise,
        offset_counts=task.offset_counts,
    )


# Errors that particles share: of their size and the sensor's charge diffusion, of haze, and of the model of light.
#
# They move the particles of an image all in one way: no fit shows them as noise.


# Where particles leave this share of an image's light, its noise taken off, more than at any crowd at which most are
# found, the model of light is wrong, or tracers are missing. Beyond, its errors are alike in all lenses, first in part.
MUCH_LEFT = 0.1
# Where less than this share of it is alike in pixels side by side, it is noise in part.
MUCH_ALIKE = 0.2


def changes_of_light(view: View, particles: Floats, covariance: Floats, depths_mm: tuple[float, float]) -> Floats:
    """Return what the light of all particles (n, 4) changes by with each independent error, (2, pixels), by waves.

    Parameters
    ----------
    covariance : (2, 2) of the squares of diameter, microlenses^2, and of diffusion, px^2
    """
    squares = np.square([2.0 * view.particle_radius_mm / view.scale.lens_mm, view.diffusion_px])

    def image(square: Floats) -> Floats:
        diameter, diffusion_px = np.sqrt(np.maximum(square, 0.0))
        sized = view._replace(particle_radius_mm=0.5 * float(diameter) * view.scale.lens_mm)
        lit = np.zeros(view.camera.rows * view.camera.columns)
        add_all(with_diffusion(sized, float(diffusion_px)), particles, 1.0, lit, depths_mm)
        return lit

    # Of independent errors: none is larger than what it is of. A square that is as small as its error only grows.
    sides = [(squares + error, squares - error) for error in np.linalg.cholesky(covariance).T]
    return np.stack(
        [
            0.5 * (image(more) - image(less)) if less.min() >= 0.0 else image(more) - image(squares)
            for more, less in sides
        ]
    )


def light_left(image: Floats, residual: Floats, read_counts: float) -> float:
    """Return the share of an image's light (pixels,) that particles leave, its read noise taken off."""
    light = float(np.sum(image**2))
    return float(np.sqrt(max(np.sum(residual**2) - residual.size * read_counts**2, 0.0) / light)) if light else 0.0


def grown(view: View, particles: Floats, covariance: Floats, left: float, likeness: float = 1.0) -> Floats:
    """Return covariances (n, 4, 4) of particles (n, 4) that leave a share of the light, larger where it is much.

    `likeness` is the share of that which is alike in pixels side by side: what a model gets wrong is, noise is not.

    What a model gets wrong is alike in all lenses that a particle lights: for depth and light it adds up from lens to
    lens. Sideways lenses on either side of the spot make up for each other, and as much is taken to be left as goes
    with the spot's diameter.
    """
    alike = float(np.clip((left / MUCH_LEFT) ** 2 - 1.0, 0.0, 1.0)) * min(likeness / MUCH_ALIKE, 1.0)
    radius = 0.5 * footprint_radius_mm(view, particles) / np.sqrt(view.half_x_mm * view.half_y_mm)
    # Cells that a disc touches, on the mean.
    lenses = 1.0 + 4.0 * radius + np.pi * radius**2
    deep, sideways = np.sqrt(1.0 + alike * lenses), np.sqrt(1.0 + alike * np.sqrt(lenses))
    growth = np.stack([sideways, sideways, deep, deep], axis=-1)
    return np.asarray(covariance * growth[:, :, np.newaxis] * growth[:, np.newaxis, :])


# Other places that explain a particle's light about as well.
#
# Near the focal plane, where one lens or two hold most of a particle's light, either sign of depth may explain it, and
# within one lens any place sideways that lights no other. What is stated is to cover them all: a fit that ends in
# another place with little more chi-squared is weighed by its likelihood.
#
# Axes: image axes, mm.


# Particles nearer to the focal plane than this, in depths over which light spreads by one lens, are tried at their
# place mirrored in the middle of their lens along either axis, from their mirrored depth and from these others.
NEAR_DEPTHS, OTHER_DEPTHS = 0.9, np.array([-0.6, 0.0, 0.6])
# Steps of each of these fits.
OTHER_STEPS = 6
# Another place is one beyond so many stated errors, squared, where chi-squared rises by less than half of what they
# predict, and by so much at most: it is one in twenty that the particle is there.
ELSEWHERE_SIGMAS2, LARGEST_RISE = 4.0, 6.0


def with_other_places(
    observation: Observation, particles: Floats, covariance: Floats, chi2: Floats, alike: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return covariances (n, 4, 4) that cover the other places of particles (n, 4), and which have another depth (n,).

    Parameters
    ----------
    chi2 : (n,) local ones
    alike : share of what is left that is alike in pixels side by side: what the model gets wrong. It is taken to be
        alike in all pixels of a lens, and what they say of one place against another counts for as much less
    """
    view = observation.optics
    near = np.abs(particles[:, 2]) < NEAR_DEPTHS * view.scale.depth_mm
    if not near.any():
        return covariance, near
    centres, on_array = view.centres_mm.reshape(-1, 2), on_array_mm(view, particles)
    beside = on_array - centres[KDTree(centres).query(on_array)[1]]
    places = np.repeat(particles[:, np.newaxis, :3], 3 + OTHER_DEPTHS.size, axis=1)
    for axis in range(2):
        # The image of a place moves against it.
        places[:, axis, axis] += 2.0 * beside[:, axis] * view.camera.focus_distance_mm / view.camera.image_distance_mm
    places[:, 2, 2] *= -1.0
    places[:, 3:, 2] = OTHER_DEPTHS * view.scale.depth_mm
    places[:, :, 2] = np.clip(places[:, :, 2], *observation.depths_mm)

    # Sideways also as they are: within a lens hardly anything leads a fit back.
    still = other_ends(observation, particles, near, np.ascontiguousarray(places[:, :2]), Effort(0, 0.0))
    fitted = other_ends(observation, particles, near, places, Effort(OTHER_STEPS, CHOICE_GAIN))
    ends, rises = (np.concatenate(both, axis=1) for both in zip(still, fitted, strict=True))

    rises = np.maximum(rises, 0.0) / (np.maximum(chi2, 1.0) * (1.0 + alike * lens_pixels(view)))[:, np.newaxis]
    off = ends - particles[:, np.newaxis]
    sigmas2 = np.einsum("nki,nij,nkj->nk", off, np.linalg.inv(covariance), off)
    other = (sigmas2 > ELSEWHERE_SIGMAS2) & (rises < np.minimum(0.5 * sigmas2, LARGEST_RISE))
    likely = np.where(other, 1.0 / (1.0 + np.exp(0.5 * np.minimum(rises, LARGEST_RISE))), 0.0)
    wider = covariance.copy()
    # Several may be one place: along each axis the one that matters most counts.
    for axis, starts in enumerate((slice(0, 4, 2), slice(1, 4, 2), slice(4, None))):
        matters = likely[:, starts] * off[:, starts, axis] ** 2
        most = np.argmax(matters, axis=1)[:, np.newaxis]
        step = np.take_along_axis(off[:, starts], most[:, :, np.newaxis], axis=1)[:, 0]
        wider += np.take_along_axis(likely[:, starts], most, axis=1)[:, :, np.newaxis] * (
            step[:, :, np.newaxis] * step[:, np.newaxis, :]
        )
    return wider, other[:, 4:].any(axis=1)


# Two tracers in one place.
#
# Near the focal plane two in a lens, or in two lenses side by side, look like one: on the lenses' boundary, where it
# would be known to a hundredth of a lens. Only its light says that it is two.
#
# Axes: image axes, mm.


# Where one of two may lie beside what looks like one: across in lenses, along in depths over which light spreads by one
# lens.
OF_TWO_LENSES, OF_TWO_DEPTHS = 0.3, 0.5
# Tracers' light scatters by this share at least, as far as this is asked; so many of them say by how much.
LEAST_LIGHT_SCATTER, ENOUGH_LIGHTS = 0.1, 20


def of_two(view: View, particles: Floats, known: NDArray[np.bool_]) -> Floats:
    """Return what is added to covariances (n, 4, 4) of particles (n, 4) near the focal plane that are rather two.

    The odds, for light that scatters in proportion, are the tracers that there are for each lens, times how probable
    the light is of two of them, over how probable it is of one. Where one is likelier nothing is added: among those are
    the brightest tracers, which are known best.

    Parameters
    ----------
    known : (n,) which ones are well seen
    """
    near, wider = np.abs(particles[:, 2]) < NEAR_DEPTHS * view.scale.depth_mm, np.zeros((len(particles), 4, 4))
    enough = [usual for usual in (known & ~near, known) if np.count_nonzero(usual) >= ENOUGH_LIGHTS]
    if not near.any() or not enough:
        return wider
    usual = enough[0]
    light = np.log(particles[:, 3] / np.median(particles[usual, 3]))
    scatter = max(MAD_TO_SIGMA * float(np.median(np.abs(light[usual]))), LEAST_LIGHT_SCATTER)
    per_lens = np.count_nonzero(near) / view.centres_mm[..., 0].size
    # Of two the logarithm scatters by less, by the root of two.
    odds = 0.5 * (light / scatter) ** 2 - ((light - np.log(2.0)) / scatter) ** 2
    odds += np.log(np.sqrt(2.0) * per_lens)
    side = view.scale.box_mm(OF_TWO_LENSES, OF_TWO_DEPTHS)
    for axis in range(3):
        wider[near & (odds > 0.0), axis, axis] = side[axis] ** 2
    return wider
