"""The state of an iterative particle reconstruction, and the steps that keep it in order.

Axes: inside, particles are rows (x, y, z, light) in image axes, mm and counts, and images flat; results are in world
axes of the raw sensor, z from the nominal focal point.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.special import ndtri

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.particles.covariance import change_shown, joint_covariance
from lfpiv_cli.particles.fitting import add_all, judge, nothing_expected, other_ends, refine
from lfpiv_cli.particles.least_squares import CHOICE_GAIN, SMALLEST_GAIN, Effort, Observation, observation_of
from lfpiv_cli.particles.noise import (
    LEAST_SHARE_OF_LIT,
    LIT_SIGMAS,
    PHOTONS_PER_PARTICLE,
    ROUNDING_COUNTS,
    Noise,
    beside_neighbours,
    error_correlation,
    mean_whole,
    measured_noise,
    pixel_weights,
    read_noise,
)
from lfpiv_cli.particles.view import View, by_waves, footprint_radius_mm, lens_pixels, on_array_mm, with_diffusion
from lfpiv_cli.reconstruction.solvers import Normalisers
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.weights.model import Weights

# Active sets: which particles the next sweep fits again, because their last fit or neighbours' fits changed
# something.
#
# A fit that lowers chi-squared by g changes a particle's light by g, in pixels' variances. Of that a neighbour sees
# what their light has in common.
#
# Axes: image axes, mm; a particle is a row (x, y, z, light).


# A particle is fitted again where its neighbours' gains, as far as their light overlaps with its own, exceed by this
# factor what ends a fit. What is left undone so is less than a thousandth of what sweeps gain.
DISTURBING = 20.0


class Overlaps(NamedTuple):
    """Pairs of particles whose footprints overlap, and the share of a gain that the other of the two sees."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]
    share: Floats


def overlaps_of(view: View, particles: Floats) -> Overlaps:
    """Return which particles (n, 4) disturb each other: the more, the closer their middles and their radii are."""
    on_array = on_array_mm(view, particles)
    # Light that touches a lens's cell spreads over it.
    radius = footprint_radius_mm(view, particles) + 2.0 * max(view.half_x_mm, view.half_y_mm)
    pairs = KDTree(on_array).query_pairs(2.0 * float(radius.max(initial=0.0)), output_type="ndarray")
    first, second = pairs[:, 0].astype(np.int64), pairs[:, 1].astype(np.int64)
    distance = np.hypot(*(on_array[first] - on_array[second]).T)
    one, other = radius[first], radius[second]
    near = np.maximum(1.0 - distance / (one + other), 0.0)
    return Overlaps(first, second, (near * np.minimum(one, other) / np.maximum(one, other)) ** 2)


def disturbance(overlaps: Overlaps, gain: Floats) -> Floats:
    """Return what each particle (n,) sees of its neighbours' gains (n,)."""
    first, second, share = overlaps
    seen = np.zeros(gain.size)
    for one, other in ((first, second), (second, first)):
        seen += np.bincount(one, share * gain[other], gain.size)
    return seen


# Sweeps at the end, where light that is not explained counts for little more than noise.
LAST_SWEEPS, LAST_UNEXPLAINED = 4, 0.02
# Share of a typical particle's light that a particle must have.
SMALLEST_LIGHT = 0.3
# In its pixels a particle is brighter than haze may still be by this many of its standard errors: of 0.2 counts left in
# a 10-bit image one was found five microlenses wide.
HAZE_SIGMAS = 2.0
# A particle stays while at least this much of it meets the sensor.
SMALLEST_SEEN = 0.1
# A good particle's chi-squared is the one at this percentile.
GOOD_PERCENTILE = 20.0
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
# Lengths are in the camera's own units (`Scale`): microlenses laterally, depths over which light spreads by one lens
# (Table 2: 0.04, 0.25 and 0.3 mm).
# Two particles this close, laterally and in depth, are in one place.
SAME_LENSES, SAME_DEPTHS = 0.4, 0.25 / 1.064
# Pixels at the rim of lens images are lit in part, which the model of light by rays knows to first order. Of tracers of
# up to this radius, in lenses, depths are wrong by this share at most where a lens has so many pixels, and by less the
# larger tracers are and by its square the more pixels there are: of a tenth of a lens and 64, 144 and 400 pixels depths
# are too small by 0.002, 0.0008 and 0.0002 in the mean over places, of 0.3 by 0.0008, 0.0002 and 0.00005.
RIM_SHARE, RIM_PIXELS, RIM_LENSES = 4.0e-3, 64.0, 0.1
# Counts are coarse where noise is this at most: 0.3 that is rounded, in an image and its dark one. Light above so many
# is rounded up as often as down. Haze too faint to be told from none is uneven by this share. How light of about a
# count is rounded follows from where particles are, and these from that: after so many rounds their errors are noise's.
COARSE_COUNTS, LIT_COUNTS, UNEVEN_SHARE, OFFSET_ROUNDS = 0.6, 4.0, 0.3, 2
# Particles this far in front of and behind the volume are kept, as they light it, in front at most this share of the
# way to the lens: within 0.3 depths alone, tracers from further away end there, and with 30 % of all outside the
# velocity in depth was 10 % too small.
MARGIN_DEPTHS, MARGIN_SHARE = 1.5, 0.25


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


@dataclass(frozen=True, eq=False)
class Task:
    """An image to be explained, with all that does not change.

    Attributes
    ----------
    view : the raw image's optics
    image : (rows * columns,) dark-subtracted counts
    usable : (rows * columns,) which pixels take part
    prepared : (rows, columns) the same in the weights' frame
    depths_mm : between which particles may lie
    photons_per_count : of the camera; None: not known
    light_covariance : (2, 2) of the squares of size and diffusion, see `diffusion`; None: both are right
    haze, haze_error : (rows * columns,) what of the image is smooth over the sensor and no tracer's, and what all
        pixels together may have more of it, standard errors; None: nothing
    """

    view: View
    weights: Weights
    camera: Camera
    sums: Normalisers
    image: Floats
    usable: NDArray[np.bool_]
    prepared: NDArray[np.float32]
    depths_mm: tuple[float, float]
    photons_per_count: float | None = None
    light_covariance: Floats | None = None
    haze: Floats | None = None
    haze_error: Floats | None = None

    @cached_property
    def light(self) -> Floats:
        """The tracers' light (rows * columns,): the image without haze."""
        return self.image if self.haze is None else self.image - self.haze

    @cached_property
    def least_light(self) -> float:
        """The light (counts) below which a particle may be haze that was not taken off; 0 where nothing is known."""
        error = 0.0 if self.haze_error is None else float(self.haze_error.max())
        return HAZE_SIGMAS * error * lens_pixels(self.view)

    @cached_property
    def read_counts(self) -> float:
        """The image's read noise, which every step asks for: of whole counts, which what fills gaps is not."""
        return read_noise(self.image[self.usable])


class Fits(NamedTuple):
    """How well particles fit, see `fitting.judge`.

    Attributes
    ----------
    chi2, share, seen : (n,) local chi-squared, claimed share, share of the light that is seen
    """

    chi2: Floats
    share: Floats
    seen: Floats

    def of(self, chosen: NDArray[np.bool_]) -> Fits:
        """Return those of some particles."""
        return Fits(self.chi2[chosen], self.share[chosen], self.seen[chosen])


@dataclass(frozen=True, eq=False)
class State:
    """How far the search has come.

    Attributes
    ----------
    particles : (n, 4)
    residual : (rows * columns,) what they leave of the image
    typical_light : of a particle
    noise : of the image
    unsplit, unmoved : (m, 5) those that could not be split, and not be moved in depth, as `_signature` gives them
    settled : (m, 4) those that are suspected of neither, whatever their chi-squared; without it
    expected : (m, 8) what is known beforehand of the first m particles, see `least_squares.fit`
    """

    particles: Floats
    residual: Floats
    typical_light: float
    noise: Noise
    unsplit: Floats
    unmoved: Floats
    settled: Floats
    expected: Floats

    @property
    def prior(self) -> Floats:
        """What is known beforehand of all particles (n, 8)."""
        return np.concatenate([self.expected, nothing_expected(len(self.particles) - len(self.expected))])


def task_of(
    image: NDArray[np.float32],
    view: View,
    weights: Weights,
    camera: Camera,
    sums: Normalisers,
    excluded: NDArray[np.bool_] | None = None,
    photons_per_count: float | None = None,
    light_covariance: Floats | None = None,
    haze: NDArray[np.float32] | None = None,
    haze_error: NDArray[np.float32] | None = None,
) -> Task:
    """Return the task that an image sets.

    Parameters
    ----------
    image : (rows, columns) raw, dark and background taken off, counts
    weights, sums : of the volume in which particles are looked for, and their `normalisers` on the padded grid
    camera : says which world axis the columns follow
    excluded : (rows, columns) raw pixels that take no part; `sums` must leave out what they touch; None: none
    photons_per_count : of the camera; None: taken from how bright particles are, until the fit shows it
    light_covariance : see `Task`
    haze, haze_error : (rows, columns) in the image, and see `Task`; None: nothing
    """
    return Task(
        view,
        weights,
        camera,
        sums,
        np.ascontiguousarray(image, dtype=np.float64).ravel(),
        np.ones(image.size, np.bool_) if excluded is None else ~excluded.ravel(),
        weights.prepare(image.astype(np.float32)),
        _depths_mm(view, *weights.grid.bounds_mm(2)),
        photons_per_count,
        light_covariance,
        *(None if light is None else light.astype(np.float64).ravel() for light in (haze, haze_error)),
    )


def _depths_mm(view: View, low_mm: float, high_mm: float) -> tuple[float, float]:
    """Return between which depths particles of a volume between two may lie."""
    margin = MARGIN_DEPTHS * view.scale.depth_mm
    to_lens = view.camera.focus_distance_mm / view.depth_ratio + low_mm
    return low_mm - min(margin, MARGIN_SHARE * to_lens), high_mm + margin


def blank(task: Task) -> State:
    """Return the state in which nothing has been found."""
    nobody, none, noise = np.zeros((0, 4)), np.zeros((0, 5)), noise_with(task, 0.0)
    return State(nobody, task.light.copy(), 0.0, noise, none, none, nobody, nothing_expected(0))


def noise_with(task: Task, typical_light: float) -> Noise:
    """Return the noise to seek particles with."""
    # A particle's light is spread over about as many pixels as a micro-image has.
    least = LEAST_SHARE_OF_LIT * typical_light / lens_pixels(task.view)
    noise = Noise(max(task.read_counts, least), typical_light / PHOTONS_PER_PARTICLE)
    return noise if task.photons_per_count is None else replace(noise, gain_counts=1.0 / task.photons_per_count)


def observed(task: Task, state: State, unexplained: float) -> Observation:
    """Return what particles are fitted to: pixels that are not usable weigh nothing, light above the model less."""
    weight = pixel_weights(state.noise, task.image, state.residual, task.usable, unexplained)
    return observation_of(task.view, state.residual, weight, task.depths_mm)


def sweep(task: Task, state: State, unexplained: float, sweeps: int, enough: float = SMALLEST_GAIN) -> None:
    """Refine particles in place, the residual along with them; see `refine`.

    The first sweep fits all, the others those whose last fit, or their neighbours' since, changed more than `enough`.
    """
    overlaps = overlaps_of(task.view, state.particles) if sweeps > 1 else None
    active, disturbed, prior = np.ones(len(state.particles), np.bool_), np.zeros(len(state.particles)), state.prior
    for _ in range(sweeps):
        gain = refine(observed(task, state, unexplained), state.particles, enough, active, prior)
        if overlaps is not None:
            disturbed = np.where(active, 0.0, disturbed) + disturbance(overlaps, gain)
            active = (gain > enough) | (disturbed > DISTURBING * enough)


def merge(task: Task, state: State) -> State:
    """Return the state with particles that are in one place added up, and its residual along with them."""
    particles = state.particles.copy()
    merging = task.view.scale.box_mm(SAME_LENSES, SAME_DEPTHS)
    pairs = KDTree(particles[:, :3] / merging).query_pairs(1.0, output_type="ndarray")
    merged, grown = np.zeros((2, len(particles)), dtype=bool)
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        if not (merged[a] or merged[b]):
            brighter, other = (a, b) if particles[a, 3] >= particles[b, 3] else (b, a)
            particles[brighter, 3] += particles[other, 3]
            merged[other] = grown[brighter] = True
    residual = state.residual.copy()
    add_all(task.view, state.particles[merged | grown], 1.0, residual, task.depths_mm)
    add_all(task.view, particles[grown & ~merged], -1.0, residual, task.depths_mm)
    return replace(state, particles=particles[~merged], expected=state.prior[~merged], residual=residual)


def prune(task: Task, state: State, claimed_share: float, unexplained: float) -> tuple[State, Fits]:
    """Return the state without particles that are too faint, hardly seen, or do not find their light.

    And how well those that stay fitted beside them.
    """
    fits = judged(task, state, unexplained)
    least = max(SMALLEST_LIGHT * state.typical_light, task.least_light)
    keep = (state.particles[:, 3] > least) & (fits.seen > SMALLEST_SEEN)
    keep &= fits.share > claimed_share
    return kept(task, state, keep), fits.of(keep)


def kept(task: Task, state: State, keep: NDArray[np.bool_]) -> State:
    """Return the state with some of its particles, the light of the others put back."""
    residual = state.residual.copy()
    add_all(task.view, state.particles[~keep], 1.0, residual, task.depths_mm)
    return replace(state, particles=state.particles[keep], expected=state.prior[keep], residual=residual)


def rebuilt(task: Task, state: State, particles: Floats) -> State:
    """Return the state with other particles, its residual computed from the image."""
    residual = task.light.copy()
    add_all(task.view, particles, -1.0, residual, task.depths_mm)
    return replace(state, particles=particles, residual=residual)


def judged(task: Task, state: State, unexplained: float) -> Fits:
    """Return how well particles fit."""
    return Fits(*judge(observed(task, state, unexplained), state.particles))


def with_typical_light(task: Task, state: State, fits: Fits) -> State:
    """Return the state with the light of a typical particle, and the noise that goes with it."""
    typical = usual_light(state, fits, 50.0)
    return replace(state, typical_light=typical, noise=noise_with(task, typical))


def usual_light(state: State, fits: Fits, percentile: float) -> float:
    """Return a percentile of the light of the better fitting half, which holds fewer merged particles.

    Those that are hardly seen fit anything; where there are no others, the light is not known: 0.
    """
    seen = fits.seen > SMALLEST_SEEN
    light, chi2 = state.particles[seen, 3], fits.chi2[seen]
    return float(np.percentile(light[chi2 <= np.median(chi2)], percentile)) if light.size else 0.0


def with_measured_noise(task: Task, state: State, *, rims: bool = False) -> State:
    """Return the state with the noise that its particles leave of the image, neighbours' light not counted.

    `rims` as in `measured_noise`.
    """
    assumed = replace(state.noise, read_counts=task.read_counts)
    beside = beside_neighbours(state.residual, task.view.camera.columns)
    noise = measured_noise(task.image - state.residual, beside, task.usable, assumed, rims=rims)
    return replace(state, noise=noise)


def usual_chi2(chi2: Floats) -> float:
    """Return chi-squared of a particle that fits well, as it is; 1 where there is none."""
    return float(np.percentile(chi2, GOOD_PERCENTILE)) if chi2.size else 1.0


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
    overlaps, pixels = overlaps_of(view, particles), lens_pixels(view)
    number = 1.0 + disturbance(overlaps, np.ones(len(particles)))
    together = (chi2 + disturbance(overlaps, np.minimum(chi2, PLAIN_CHI2))) / number
    light = particles[:, 3]
    return np.maximum(missing_light(chi2, light, known, pixels), missing_light(together, light, known, pixels * number))


def rim_error(view: View) -> float:
    """Return by what share of their depths particles are wrong where lens images are few pixels wide, at most."""
    larger = max(view.particle_radius_mm / (RIM_LENSES * view.scale.lens_mm), 1.0)
    return RIM_SHARE / larger * (RIM_PIXELS / lens_pixels(view)) ** 2


def with_offset_known(task: Task, state: State) -> tuple[Task, State]:
    """Return the task with what rounding adds to light or takes off it, as particles show it, and the state with that.

    With little noise a dark level between two counts is recorded as one of them, and where light varies from pixel to
    pixel as either: all light is up to half a count off, and no dark pixel shows it.
    """
    image = task.image[task.usable]
    whole = 2 * np.count_nonzero(image == np.rint(image)) > image.size
    if task.read_counts > COARSE_COUNTS or not whole or not len(state.particles):
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
    task = replace(task, haze_error=after)
    haze = task.haze
    for _ in range(OFFSET_ROUNDS):
        light = np.maximum(task.light - state.residual, 0.0)
        sigma = np.sqrt(task.read_counts**2 - ROUNDING_COUNTS**2 + state.noise.gain_counts * light)
        added = mean_whole(light + offset, sigma) - light
        task = replace(task, haze=added if haze is None else haze + added)
        state = rebuilt(task, state, state.particles.copy())
        sweep(task, state, LAST_UNEXPLAINED, LAST_SWEEPS)
        state = with_measured_noise(task, state, rims=True)
    return task, state


def result(task: Task, state: State) -> Particles:
    """Return the particles in world axes, brightest first."""
    task, state = with_offset_known(task, state)
    shape = task.prepared.shape
    order = np.argsort(-state.particles[:, 3], kind="stable")
    particles = state.particles[order]
    observation = observed(task, state, 0.0)
    chi2, _, seen = judge(observation, particles)
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
# let expect, and by so much at most: it is one in twenty that the particle is there.
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
