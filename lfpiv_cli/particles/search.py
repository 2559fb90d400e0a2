"""The state of an iterative particle reconstruction, and the steps that keep it in order.

Axes: particles are rows (x, y, z, light) in image axes, mm and counts, and images flat.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.particles.fitting import add_all, judge, nothing_expected, refine
from lfpiv_cli.particles.least_squares import SMALLEST_GAIN, Observation, observation_of
from lfpiv_cli.particles.noise import (
    LEAST_SHARE_OF_LIT,
    PHOTONS_PER_PARTICLE,
    ROUNDING_COUNTS,
    Noise,
    measured_noise,
    pixel_weights,
    read_noise,
)
from lfpiv_cli.particles.view import View, footprint_radius_mm, lens_pixels, on_array_mm
from lfpiv_cli.reconstruction.solvers import Normalisers, Problem
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


def disturbance(view: View, particles: Floats, gain: Floats) -> Floats:
    """Return what each of particles (n, 4) sees of its neighbours' gains (n,).

    The more of it, the closer their middles and their radii are.
    """
    on_array = on_array_mm(view, particles)
    # Light that touches a lens's cell spreads over it.
    radius = footprint_radius_mm(view, particles) + 2.0 * max(view.half_x_mm, view.half_y_mm)
    seen = np.zeros(gain.size)
    _add_seen(np.argsort(on_array[:, 0], kind="stable"), on_array, radius, float(radius.max(initial=0.0)), gain, seen)
    return seen


@njit(cache=True)
def _add_seen(
    order: NDArray[np.int64], on_array: Floats, radius: Floats, widest: float, gain: Floats, seen: Floats
) -> None:
    """Add what particles in an order along x see of those that may overlap with them, none wider than `widest`."""
    for place in range(order.size):
        one = order[place]
        for k in range(place + 1, order.size):
            other = order[k]
            x = on_array[other, 0] - on_array[one, 0]
            if x > radius[one] + widest:
                break
            y, reach = on_array[other, 1] - on_array[one, 1], radius[one] + radius[other]
            if x * x + y * y < reach * reach:
                near = 1.0 - np.sqrt(x * x + y * y) / reach
                share = (near * min(radius[one], radius[other]) / max(radius[one], radius[other])) ** 2
                seen[one] += share * gain[other]
                seen[other] += share * gain[one]


# Sweeps at the end, where light that is not explained counts for little more than noise.
LAST_SWEEPS, LAST_UNEXPLAINED = 4, 0.02
# Share of a typical particle's light that a particle must have.
SMALLEST_LIGHT = 0.3
# In its pixels a particle is brighter than haze may still be by this many of its standard errors: of 0.2 counts left in
# a 10-bit image one was found five microlenses wide.
HAZE_SIGMAS = 2.0
# Where noise is less than rounding, this makes a count of smooth light here and none there: 75 particles beside two
# tracers, of haze of half a count. A particle's brightest pixel has more counts there.
LEAST_OF_QUIET = 1.2
# A particle stays while at least this much of it meets the sensor.
SMALLEST_SEEN = 0.1
# A good particle's chi-squared is the one at this percentile.
GOOD_PERCENTILE = 20.0
# Lengths are in the camera's own units (`Scale`): microlenses laterally, depths over which light spreads by one lens
# (Table 2: 0.04, 0.25 and 0.3 mm).
# Two particles this close, laterally and in depth, are in one place.
SAME_LENSES, SAME_DEPTHS = 0.4, 0.25 / 1.064
# Particles this far in front of and behind the volume are kept, as they light it, in front at most this share of the
# way to the lens: within 0.3 depths alone, tracers from further away end there, and with 30 % of all outside the
# velocity in depth was 10 % too small.
MARGIN_DEPTHS, MARGIN_SHARE = 1.5, 0.25


@dataclass(frozen=True, eq=False)
class Task:
    """An image to be explained, with all that does not change.

    Attributes
    ----------
    view : the raw image's optics
    image : (rows * columns,) dark-subtracted counts
    usable : (rows * columns,) which pixels take part
    read_counts : the read noise of those, which of whole counts what fills gaps is not
    prepared : (rows, columns) the image in the weights' frame
    depths_mm : between which particles may lie
    photons_per_count : of the camera; None: not known
    light_covariance : (2, 2) of the squares of size and diffusion, see `diffusion`; None: both are right
    haze, haze_error : (rows * columns,) what of the image is smooth over the sensor and no tracer's, and what all
        pixels together may have more of it, standard errors; None: nothing
    offset_counts : what rounding adds to light, as particles show it; None: not looked for
    """

    view: View
    weights: Weights
    camera: Camera
    sums: Normalisers
    image: Floats
    usable: NDArray[np.bool_]
    read_counts: float
    prepared: NDArray[np.float32]
    depths_mm: tuple[float, float]
    photons_per_count: float | None = None
    light_covariance: Floats | None = None
    haze: Floats | None = None
    haze_error: Floats | None = None
    offset_counts: float | None = None

    @cached_property
    def light(self) -> Floats:
        """The tracers' light (rows * columns,): the image without haze."""
        return self.image if self.haze is None else self.image - self.haze

    @cached_property
    def problem(self) -> Problem:
        """What a volume is to explain of the image."""
        return Problem.of(self.weights.padded, self.prepared, self.sums)

    @cached_property
    def least_light(self) -> float:
        """The light (counts) below which a particle may be haze that was not taken off; 0 where nothing is known."""
        error = 0.0 if self.haze_error is None else float(self.haze_error.max())
        return HAZE_SIGMAS * error * lens_pixels(self.view)

    @cached_property
    def least_brightest(self) -> float:
        """The counts below which a particle's brightest pixel may be rounding's; 0 where noise hides its steps."""
        return LEAST_OF_QUIET if self.read_counts <= ROUNDING_COUNTS else 0.0


class Fits(NamedTuple):
    """How well particles fit, see `fitting.judge`.

    Attributes
    ----------
    chi2, share : (n,) local chi-squared, claimed share
    brightest : (n,) counts in the brightest pixel
    seen : (n,) share of the light that is seen
    """

    chi2: Floats
    share: Floats
    brightest: Floats
    seen: Floats

    def of(self, chosen: NDArray[np.bool_]) -> Fits:
        """Return those of some particles."""
        return Fits(*(each[chosen] for each in self))


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
    expected : (m, 8) what is known beforehand of the first m particles, see `least_squares.fit`
    """

    particles: Floats
    residual: Floats
    typical_light: float
    noise: Noise
    unsplit: Floats
    unmoved: Floats
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
    in_image, error = (None if light is None else light.astype(np.float64).ravel() for light in (haze, haze_error))
    counts = np.ascontiguousarray(image, dtype=np.float64).ravel()
    usable = np.ones(image.size, np.bool_) if excluded is None else ~excluded.ravel()
    return Task(
        view,
        weights,
        camera,
        sums,
        counts,
        usable,
        read_noise(counts[usable]),
        weights.prepare(image.astype(np.float32)),
        _depths_mm(view, *weights.grid.bounds_mm(2)),
        photons_per_count,
        light_covariance,
        in_image,
        error,
    )


def _depths_mm(view: View, low_mm: float, high_mm: float) -> tuple[float, float]:
    """Return between which depths particles of a volume between two may lie."""
    margin = MARGIN_DEPTHS * view.scale.depth_mm
    to_lens = view.camera.focus_distance_mm / view.depth_ratio + low_mm
    return low_mm - min(margin, MARGIN_SHARE * to_lens), high_mm + margin


def blank(task: Task) -> State:
    """Return the state in which nothing has been found."""
    nobody, none, noise = np.zeros((0, 4)), np.zeros((0, 5)), noise_with(task, 0.0)
    return State(nobody, task.light.copy(), 0.0, noise, none, none, nothing_expected(0))


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

    The first sweep fits all, the others those whose last fit, or their neighbours' since, changed more than `enough`,
    to pixels that weigh what they did before the first.
    """
    observation = observed(task, state, unexplained)
    active, disturbed, prior = np.ones(len(state.particles), np.bool_), np.zeros(len(state.particles)), state.prior
    for number in range(sweeps):
        gain = refine(observation, state.particles, enough, active, prior)
        if number < sweeps - 1:
            disturbed = np.where(active, 0.0, disturbed) + disturbance(task.view, state.particles, gain)
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
    keep &= (fits.share > claimed_share) & (fits.brightest > task.least_brightest)
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
    model, columns = task.image - state.residual, task.view.camera.columns
    noise = measured_noise(model, state.residual, task.usable, assumed, columns, rims=rims)
    return replace(state, noise=noise)


def usual_chi2(chi2: Floats) -> float:
    """Return chi-squared of a particle that fits well, as it is; 1 where there is none."""
    return float(np.percentile(chi2, GOOD_PERCENTILE)) if chi2.size else 1.0
