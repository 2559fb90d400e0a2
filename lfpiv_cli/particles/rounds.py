"""From a raw image to its particles: rounds of candidates, acceptance, splitting, refinement and pruning.

Each round explains what is left of the image by a volume, takes its peaks as candidates, fits and accepts those whose
light is there, tells merged ones apart and refines all. Early rounds accept only what is plainly there and let
unexplained light count for little; later ones ask for less, doubt every particle that fits badly, and try other depths.

Axes: inside, particles are rows (x, y, z, light) in image axes, mm and counts, and images flat; results are in world
axes of the raw sensor, z from the nominal focal point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.particles.candidates import explain_rest, find_peaks, points_in_raw_frame
from lfpiv_cli.particles.covariance import joint_covariance
from lfpiv_cli.particles.fitting import accept, add_all, judge, refine
from lfpiv_cli.particles.jumping import jump
from lfpiv_cli.particles.noise import Noise, error_correlation, estimate_noise, measured_noise
from lfpiv_cli.particles.splitting import split
from lfpiv_cli.particles.tiles import footprint_px, share_out
from lfpiv_cli.particles.view import View, entry_capacity, footprint_radius_mm
from lfpiv_cli.reconstruction.equations import Normalisers
from lfpiv_cli.weights.model import Weights


@dataclass(frozen=True)
class Round:
    """One round.

    Attributes
    ----------
    iterations : of expectation maximisation
    claimed_share : least share of its claimed light that a candidate must find
    unexplained : weight of light above the model in a pixel's variance
    thorough : whether particles of usual brightness are doubted, too, and other depths tried
    """

    iterations: int
    claimed_share: float
    unexplained: float
    thorough: bool


# As long as half the light is unexplained most particles fit badly, and doubting them all is in vain.
ROUNDS = (
    Round(20, 0.9, 0.3, thorough=False),
    Round(12, 0.85, 0.2, thorough=False),
    Round(12, 0.8, 0.1, thorough=True),
    Round(12, 0.75, 0.07, thorough=True),
    Round(12, 0.7, 0.05, thorough=True),
    Round(12, 0.6, 0.05, thorough=True),
)
# Sweeps of refinement after candidates, after splitting, and at the end (with less weight on unexplained light).
SWEEPS, SWEEPS_AFTER_SPLIT, LAST_SWEEPS = 4, 2, 4
LAST_UNEXPLAINED = 0.02
# Before any particle is known, its light is taken from the peaks: one in ten is brighter than a typical particle.
FIRST_TYPICAL_PERCENTILE = 90.0
# Shares of a typical particle's light: the least of a peak to be tried, of a particle to stay.
CANDIDATE_LIGHT, SMALLEST_LIGHT = 0.1, 0.3
# A particle stays while it finds this much less of its light than a candidate had to, and this much meets the sensor.
PRUNING_SLACK, SMALLEST_SEEN = 0.3, 0.1
# Two particles this close, laterally and in depth, are one.
MERGE_MM = np.array([0.04, 0.04, 0.25])
# Particles this far in front of and behind the volume are kept: they light it.
DEPTH_MARGIN_MM = 0.3
# A good particle's chi-squared is the one at this percentile; particles that fit worse by this factor are doubted.
GOOD_PERCENTILE, SUSPECT_CHI2 = 20.0, 1.5
# Suspected to be two: brighter than typical by this factor, or, in thorough rounds, bright enough for two.
BRIGHT, ENOUGH_FOR_TWO = 1.2, 2.0 * SMALLEST_LIGHT
# What chi-squared must fall by, in units of a good particle's, where one becomes two, and where it jumps in depth.
SPLIT_GAIN, JUMP_GAIN = 40.0, 10.0
# A particle that could not be split or moved is not tried again until it has changed by this much: mm laterally, mm in
# depth, and by these shares in light and in chi-squared.
CHANGED = np.array([0.005, 0.005, 0.05, 0.05, 0.2])


@dataclass(frozen=True, eq=False)
class Particles:
    """The particles of an image.

    Attributes
    ----------
    position_mm : (n, 3) world axes
    light_counts : (n,) all that passes the main lens
    covariance_mm2 : (n, 3, 3) of the position, the camera taken to be as calibrated
    chi2 : (n,) mean of residual^2 / variance over the particle's light, about 1 where all is explained
    seen : (n,) share of its light that meets the sensor
    residual : (rows, columns) what the particles leave of the image, counts
    noise : of the image
    """

    position_mm: NDArray[np.float64]
    light_counts: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64]
    chi2: NDArray[np.float64]
    seen: NDArray[np.float64]
    residual: NDArray[np.float64]
    noise: Noise


@dataclass(frozen=True, eq=False)
class Task:
    """An image to be explained, with all that does not change.

    Attributes
    ----------
    view : the raw image's optics
    image : (rows * columns,) dark-subtracted counts
    believed : (rows * columns,) which pixels take part
    prepared : (rows, columns) the same in the weights' frame
    depths_mm : between which particles may lie
    """

    view: View
    weights: Weights
    camera: Camera
    sums: Normalisers
    image: NDArray[np.float64]
    believed: NDArray[np.bool_]
    prepared: NDArray[np.float32]
    depths_mm: tuple[float, float]

    @property
    def capacity(self) -> int:
        """Entries that a particle can have at most."""
        return entry_capacity(self.view, *self.depths_mm)


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
    """

    particles: NDArray[np.float64]
    residual: NDArray[np.float64]
    typical_light: float
    noise: Noise
    unsplit: NDArray[np.float64]
    unmoved: NDArray[np.float64]


def find_particles(
    image: NDArray[np.float32],
    view: View,
    weights: Weights,
    camera: Camera,
    sums: Normalisers,
    rounds: tuple[Round, ...] = ROUNDS,
    progress: Callable[[int], None] | None = None,
    excluded: NDArray[np.bool_] | None = None,
) -> Particles:
    """Return the particles that explain a raw image.

    Parameters
    ----------
    image : (rows, columns) raw, dark and background taken off, counts
    weights, sums : of the volume in which particles are looked for, and their `normalisers` on the padded grid
    camera : says which world axis the columns follow
    progress : called with 1 after each iteration and each round
    excluded : (rows, columns) raw pixels that are not believed; `sums` must leave out what they touch; default: none
    """
    task = _task(image, view, weights, camera, sums, excluded)
    none = np.zeros((0, 5))
    state = State(np.zeros((0, 4)), task.image.copy(), 0.0, estimate_noise(task.image, 0.0), none, none)
    for settings in rounds:
        state = _one_round(task, state, settings, progress)
        if progress:
            progress(1)
    noise = measured_noise(task.image - state.residual, state.residual, task.believed, state.noise)
    state = replace(state, noise=noise)
    _sweep(task, state, LAST_UNEXPLAINED, LAST_SWEEPS)
    state = _prune(task, state, rounds[-1])
    return _result(task, state, image.shape)


def _task(
    image: NDArray[np.float32],
    view: View,
    weights: Weights,
    camera: Camera,
    sums: Normalisers,
    excluded: NDArray[np.bool_] | None,
) -> Task:
    low, high = weights.grid.bounds_mm(2)
    return Task(
        view,
        weights,
        camera,
        sums,
        np.ascontiguousarray(image, dtype=np.float64).ravel(),
        np.ones(image.size, np.bool_) if excluded is None else ~excluded.ravel(),
        weights.prepare(image.astype(np.float32)),
        (low - DEPTH_MARGIN_MM, high + DEPTH_MARGIN_MM),
    )


def _one_round(task: Task, state: State, settings: Round, progress: Callable[[int], None] | None) -> State:
    """Return the state after one round."""
    candidates, light = _candidates(task, state, settings.iterations, progress)
    typical = state.typical_light
    if typical == 0.0:
        typical = float(np.percentile(light, FIRST_TYPICAL_PERCENTILE)) if light.size else 0.0
    candidates = candidates[light > CANDIDATE_LIGHT * typical]
    state = replace(state, typical_light=typical, noise=estimate_noise(task.image, typical))
    state = _accept(task, state, candidates, settings)
    _sweep(task, state, settings.unexplained, SWEEPS)
    state = _with_typical_light(task, state)
    if settings.thorough:
        state = _jump(task, state, settings.unexplained)
    state = _split(task, state, settings)
    _sweep(task, state, settings.unexplained, SWEEPS_AFTER_SPLIT)
    state = _prune(task, _merge(task, state), settings)
    return _with_typical_light(task, state)


def _candidates(
    task: Task, state: State, iterations: int, progress: Callable[[int], None] | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return candidates (n, 4), brightest first, and their light (n,)."""
    model = (task.image - state.residual).reshape(task.prepared.shape).astype(np.float32)
    background = task.weights.prepare(model)
    volume = explain_rest(task.weights, task.prepared, background, task.sums, iterations, progress)
    index, light = find_peaks(volume)
    points = task.camera.to_image_axes(points_in_raw_frame(task.weights, index))
    return np.column_stack([points, light]), light


def _weight(task: Task, state: State, unexplained: float) -> NDArray[np.float64]:
    return np.where(task.believed, state.noise.weights(task.image - state.residual, state.residual, unexplained), 0.0)


def _sweep(task: Task, state: State, unexplained: float, sweeps: int) -> None:
    """Refine all particles in place, the residual along with them."""
    for _ in range(sweeps):
        tiles = share_out(task.view, state.particles, *task.depths_mm)
        weight = _weight(task, state, unexplained)
        refine(task.view, state.particles, tiles, state.residual, weight, *task.depths_mm, task.capacity)


def _accept(task: Task, state: State, candidates: NDArray[np.float64], settings: Round) -> State:
    """Return the state with those candidates that hold."""
    accepted = accept(
        task.view,
        candidates,
        share_out(task.view, candidates, *task.depths_mm),
        state.residual,
        _weight(task, state, settings.unexplained),
        *task.depths_mm,
        SMALLEST_LIGHT * state.typical_light,
        settings.claimed_share,
        task.capacity,
    )
    return replace(state, particles=np.concatenate([state.particles, candidates[accepted]]))


def _jump(task: Task, state: State, unexplained: float) -> State:
    """Return the state with particles at other depths that explain the light better, the residual in place."""
    weight = _weight(task, state, unexplained)
    chi2, *_ = judge(task.view, state.particles, state.residual, weight, task.capacity)
    good = _good(chi2)
    # Light that stays within about one lens fits well at many depths.
    near_focus = footprint_radius_mm(task.view, state.particles[:, 2]) < 2.0 * task.view.half_x_mm
    signature = _signature(state.particles, chi2)
    suspects = (near_focus | (chi2 > SUSPECT_CHI2 * good)) & ~_among(state.unmoved, signature)
    moved = jump(
        task.view,
        state.particles,
        suspects,
        share_out(task.view, state.particles, *task.depths_mm),
        state.residual,
        weight,
        *task.depths_mm,
        SMALLEST_LIGHT * state.typical_light,
        JUMP_GAIN * good,
        task.capacity,
    )
    return replace(state, unmoved=np.concatenate([state.unmoved, signature[suspects & ~moved]]))


def _split(task: Task, state: State, settings: Round) -> State:
    """Return the state with particles that are plainly two told apart."""
    weight = _weight(task, state, settings.unexplained)
    chi2, *_ = judge(task.view, state.particles, state.residual, weight, task.capacity)
    good = _good(chi2)
    bright = state.particles[:, 3] > (ENOUGH_FOR_TWO if settings.thorough else BRIGHT) * state.typical_light
    signature = _signature(state.particles, chi2)
    suspects = bright & (chi2 > SUSPECT_CHI2 * good) & ~_among(state.unsplit, signature)
    twins = split(
        task.view,
        state.particles,
        suspects,
        share_out(task.view, state.particles, *task.depths_mm),
        state.residual,
        weight,
        *task.depths_mm,
        SMALLEST_LIGHT * state.typical_light,
        SPLIT_GAIN * good,
        task.capacity,
        footprint_px(task.view, *task.depths_mm),
    )
    found = twins[:, 3] > 0.0
    return replace(
        state,
        particles=np.concatenate([state.particles, twins[found]]),
        unsplit=np.concatenate([state.unsplit, signature[suspects & ~found]]),
    )


def _good(chi2: NDArray[np.float64]) -> float:
    """Return chi-squared of a particle that fits well."""
    return max(float(np.percentile(chi2, GOOD_PERCENTILE)), 1.0) if chi2.size else 1.0


def _signature(particles: NDArray[np.float64], chi2: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 5) numbers that differ by 1 where a particle has changed enough to be looked at again."""
    tiny = np.finfo(np.float64).tiny
    return (
        np.column_stack([particles[:, :3], np.log(np.maximum(np.column_stack([particles[:, 3], chi2]), tiny))])
        / CHANGED
    )


def _among(tried: NDArray[np.float64], signature: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Tell which particles were tried before and have hardly changed since."""
    if not len(tried):
        return np.zeros(len(signature), dtype=bool)
    distance, _ = KDTree(tried).query(signature, p=np.inf, distance_upper_bound=1.0)
    return np.isfinite(distance)


def _merge(task: Task, state: State) -> State:
    """Return the state with particles that have become one added up, and its residual computed anew."""
    particles = state.particles.copy()
    pairs = KDTree(particles[:, :3] / MERGE_MM).query_pairs(1.0, output_type="ndarray")
    gone = np.zeros(len(particles), dtype=bool)
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]:
        if not (gone[a] or gone[b]):
            brighter, other = (a, b) if particles[a, 3] >= particles[b, 3] else (b, a)
            particles[brighter, 3] += particles[other, 3]
            gone[other] = True
    return _rebuilt(task, state, particles[~gone])


def _prune(task: Task, state: State, settings: Round) -> State:
    """Return the state without particles that are too faint, hardly seen, or do not find their light."""
    weight = _weight(task, state, settings.unexplained)
    _, share, seen = judge(task.view, state.particles, state.residual, weight, task.capacity)
    keep = (state.particles[:, 3] > SMALLEST_LIGHT * state.typical_light) & (seen > SMALLEST_SEEN)
    keep &= share > settings.claimed_share - PRUNING_SLACK
    return _rebuilt(task, state, state.particles[keep])


def _rebuilt(task: Task, state: State, particles: NDArray[np.float64]) -> State:
    """Return the state with other particles, its residual computed from the image."""
    residual = task.image.copy()
    tiles = share_out(task.view, particles, *task.depths_mm)
    add_all(task.view, particles, tiles, -1.0, residual, task.capacity)
    return replace(state, particles=particles, residual=residual)


def _with_typical_light(task: Task, state: State) -> State:
    """Return the state with the median light of the better fitting half, which holds fewer merged particles."""
    if not len(state.particles):
        return state
    weight = _weight(task, state, LAST_UNEXPLAINED)
    chi2, *_ = judge(task.view, state.particles, state.residual, weight, task.capacity)
    typical = float(np.median(state.particles[chi2 <= np.median(chi2), 3]))
    return replace(state, typical_light=typical, noise=estimate_noise(task.image, typical))


def _result(task: Task, state: State, shape: tuple[int, int]) -> Particles:
    """Return the particles in world axes, brightest first."""
    order = np.argsort(-state.particles[:, 3], kind="stable")
    particles = state.particles[order]
    weight = _weight(task, state, 0.0)
    chi2, _, seen = judge(task.view, particles, state.residual, weight, task.capacity)
    # What neighbours leave unexplained is as large an error as noise: the scatter says how large.
    model, left, trust = (values.reshape(shape) for values in (task.image - state.residual, state.residual, weight))
    correlation = error_correlation(model, left, trust, state.noise)
    joint = joint_covariance(task.view, particles, weight, correlation, task.capacity)
    covariance = joint * np.maximum(chi2, 1.0)[:, np.newaxis, np.newaxis]
    to_world = task.camera.to_image_axes(np.eye(3))
    return Particles(
        position_mm=task.camera.to_image_axes(particles[:, :3]),
        light_counts=particles[:, 3].copy(),
        covariance_mm2=to_world @ covariance[:, :3, :3] @ to_world.T,
        chi2=chi2,
        seen=seen,
        residual=state.residual.reshape(shape),
        noise=state.noise,
    )
