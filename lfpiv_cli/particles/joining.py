"""Two particles that the image does not tell from one: one tracer that was found twice.

Two searches may find one tracer. Near the focal plane it lights one lens or two, and two particles beside each other
share its light in any proportion: what was split once, or was expected from an earlier frame, would stay so. So one
particle takes the place of two where chi-squared hardly rises. How near they are says little: at other depths two
tracers a third of a microlens apart differ from one by thousands. Two that overlap so much that they look like one are
as bright as two: what would be brighter than others stays two, unless they are in one place, where no two solid tracers
can be.

Where the model of light is wrong, what it leaves of particles that fit well is allowed for, see `suspects.lacking`. In
one place near the focal plane there is one particle, unless two are expected: what the model of the light of so few
lenses lacks is as much as what tells two from one.

Axes: image axes, mm; light in counts; residual and weights as flat images. A particle is a row (x, y, z, light).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import Scale
from lfpiv_cli.kernels import njit
from lfpiv_cli.particles.fitting import NO_FURTHER, Choice, Fitter, begin_at, fitter_of, nothing_expected
from lfpiv_cli.particles.least_squares import (
    CHOICE_GAIN,
    UNKNOWNS,
    Effort,
    Observation,
    add_light,
    change_by,
    copy_rows,
    lit_by,
    room_for,
)
from lfpiv_cli.particles.search import SAME_DEPTHS, SAME_LENSES, State, Task, observed
from lfpiv_cli.particles.suspects import good_chi2
from lfpiv_cli.particles.view import footprint_radius_mm, over_tiles
from lfpiv_cli.reconstruction.solvers import Problem, em_step, uniform_start
from lfpiv_cli.weights.model import Weights

# Where particles may be: peaks of a volume that explains what the particles found so far do not.
#
# The volume comes from expectation maximisation with these particles' light as a fixed background, in the frame of
# the weights; `points_in_raw_frame` takes its peaks to the raw image's axes.
#
# Axes: volumes [z, y, x], points (x, y, z) in mm; images [row, column].


# Light-field volumes are sharp laterally and long in depth: a peak is the largest sum over a few planes among its
# neighbours; smoothing laterally as well merges every second particle with another. Lengths are from the middle of a
# box to its outermost voxels, laterally in microlenses as the scene shows them, in depth in depths over which light
# spreads by one lens (Table 2: 0.1 and 0.2 mm), and a voxel at least; light, which iterations spread in depth, two.
SUM_DEPTHS = 0.1 / 1.064
PEAK_LENSES, PEAK_DEPTHS = 1.0, 0.1 / 1.064
# A particle's light lies about so far around its peak.
LIGHT_LENSES, LIGHT_DEPTHS = 1.0, 0.2 / 1.064
# A step that goes half as far again shows in two iterations what takes three: in crowds as many tracers are found so.
RELAXATION = 1.5


class Boxes(NamedTuple):
    """Voxels (z, y, x): of a peak's height, those among which it is the highest, and those that hold its light."""

    sum: tuple[int, int, int]
    peak: tuple[int, int, int]
    light: tuple[int, int, int]


def boxes_of(scale: Scale, spacing_mm: tuple[float, float, float]) -> Boxes:
    """Return the boxes for voxels of this size (x, y, z)."""

    def box(lenses: float, depths: float, least_planes: int) -> tuple[int, int, int]:
        x, y, z = np.rint(scale.box_mm(lenses, depths) / spacing_mm).astype(int)
        return 2 * max(z, least_planes) + 1, 2 * max(y, 1) + 1, 2 * max(x, 1) + 1

    tall = box(PEAK_LENSES, SUM_DEPTHS, 1)[0]
    return Boxes((tall, 1, 1), box(PEAK_LENSES, PEAK_DEPTHS, 1), box(LIGHT_LENSES, LIGHT_DEPTHS, 2))


def explain_rest(
    problem: Problem,
    background: NDArray[np.float32],
    iterations: int,
    progress: Callable[[int], None] | None = None,
) -> NDArray[np.float32]:
    """Return the volume E of the padded grid that with the background explains the image: W E + background = image.

    Parameters
    ----------
    problem : of the image, by the padded weights
    background : (rows, columns) in the weights' frame, worked on
    """
    operator = problem.operator
    np.maximum(background, 0.0, out=background)
    volume = uniform_start(Problem.of(operator, problem.image - background, problem.sums))
    for _ in range(iterations):
        projection = operator.forward(volume)
        projection += background
        volume = em_step(problem, volume, projection, RELAXATION)
        if progress:
            progress(1)
    return volume


def find_peaks(volume: NDArray[np.float32], boxes: Boxes) -> tuple[Floats, Floats]:
    """Return the peaks of a volume, brightest first: fractional indices (n, 3) as (x, y, z), and their light (n,)."""
    height = ndimage.uniform_filter(volume, boxes.sum, mode="constant")
    peak = (height == ndimage.maximum_filter(height, boxes.peak, mode="constant")) & (height > 0.0)
    # Running sums leave traces of bright planes in dark ones behind them: a peak must have light of its own.
    peak &= ndimage.maximum_filter(volume, boxes.sum, mode="constant") > 0.0
    at = np.argwhere(peak)
    # Their light and its centre within a box.
    half = [n // 2 for n in boxes.light]
    padded = np.pad(volume, [(h, h) for h in half])
    light, moment = np.zeros(len(at)), np.zeros((len(at), 3))
    for offset in np.ndindex(*boxes.light):
        value = padded[tuple((at + offset).T)].astype(np.float64)
        light += value
        moment += value[:, np.newaxis] * (np.array(offset) - half)
    centres = at + moment / light[:, np.newaxis]
    order = np.lexsort((at[:, 2], at[:, 1], at[:, 0], -light))
    return centres[order, ::-1], light[order]


def points_in_raw_frame(weights: Weights, index_xyz: Floats) -> Floats:
    """Return points (n, 3) in world axes, mm, of fractional indices in the padded grid."""
    points = weights.padded.grid.voxel_to_mm(index_xyz)
    if weights.calibration is None:
        return points
    return weights.calibration.rectification.to_world(points, weights.column_axis)


# Particles may be one tracer that are no further apart: laterally in microlenses, and in depths over which light
# spreads by one lens (Table 2: 0.1 and 1 mm).
APART_LENSES, APART_DEPTHS = 1.0, 1.0 / 1.064
# Radii, in lenses, of footprints near the focal plane.
NEAR_FOCUS_LENSES = 1.0
# What chi-squared may rise by, in units of a good particle's: six standard errors of the light of the second.
LARGEST_LOSS = 40.0
# One in twenty particles is brighter than what two may be joined to.
BRIGHTEST_PERCENTILE = 95.0
STEPS = 12
# The light of a particle that is there at all, counts.
LEAST_LIGHT = 1e-9


def with_twins_joined(task: Task, state: State, unexplained: float, chi2: Floats, lacks: Floats | float = 0.0) -> State:
    """Return the state with one particle for two that the image does not tell from one.

    Parameters
    ----------
    chi2 : of its particles, see `judge`, to tell how large a good one's is
    lacks : (n,) what the model of light lacks of each, see `suspects.lacking`
    """
    if len(state.particles) < 2:
        return state
    # Pairs that may be one tracer, the nearest first.
    particles, scale = state.particles.copy(), task.view.scale
    places = particles[:, :3] / scale.box_mm(APART_LENSES, APART_DEPTHS)
    pairs = KDTree(places).query_pairs(1.0, output_type="ndarray").astype(np.int64)
    distance = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0], distance))]

    # What one may lose, and its most light.
    off = (particles[pairs[:, 0], :3] - particles[pairs[:, 1], :3]) / scale.box_mm(SAME_LENSES, SAME_DEPTHS)
    close = np.linalg.norm(off, axis=1) < 1.0
    radius = footprint_radius_mm(task.view, particles)[pairs].max(axis=1)
    near_focus = radius < NEAR_FOCUS_LENSES * 2.0 * task.view.half_x_mm
    two_expected = np.asarray(state.prior[:, UNKNOWNS:].any(axis=1))[pairs].all(axis=1)
    loss = np.where(close & near_focus & ~two_expected, np.inf, LARGEST_LOSS)
    usual = np.percentile(particles[:, 3], BRIGHTEST_PERCENTILE)
    brightest = np.where(close & ~(near_focus & two_expected), np.inf, usual)
    possible = particles[pairs, 3].sum(axis=1) < brightest
    pairs, loss, brightest = pairs[possible], loss[possible], brightest[possible]
    if not len(pairs):
        return state

    largest = np.maximum(loss * good_chi2(chi2), np.full(len(particles), lacks)[pairs].sum(axis=1))
    joined = join(observed(task, state, unexplained), particles, pairs, largest, brightest)
    stays, expected = np.ones(len(particles), np.bool_), state.prior
    stays[pairs[joined, 1]], expected[pairs[joined, 0]] = False, nothing_expected(1)
    return replace(state, particles=particles[stays], expected=expected[stays])


def join(
    observation: Observation, particles: Floats, pairs: NDArray[np.int64], largest_loss: Floats, brightest: Floats
) -> NDArray[np.bool_]:
    """Put one particle in place of the first of two where chi-squared rises by less than `largest_loss` (m,).

    The residual is kept up to date; none becomes brighter than its pair's `brightest` (m,). Returns which of the pairs
    (m, 2) of particles (n, 4) are joined, each particle once at most.
    """
    joined, free = np.zeros(len(pairs), np.bool_), np.ones(len(particles), np.bool_)
    light, fitter = particles[pairs, 3:], fitter_of(observation)
    middle = np.sum(particles[pairs] * light, axis=1) / np.maximum(light.sum(axis=1), np.finfo(np.float64).tiny)
    # Starts lie in the middle: from there fits move no further than tiles allow.
    limits = np.column_stack([largest_loss, brightest])
    arguments = fitter, particles, middle, pairs, limits, free, joined
    over_tiles(_join, observation.optics, middle, observation.depths_mm, *arguments)
    return joined


@njit(cache=True, nogil=True)
def _join(
    numbers: NDArray[np.int64],
    fitter: Fitter,
    particles: Floats,
    middle: Floats,
    pairs: NDArray[np.int64],
    limits: Floats,
    free: NDArray[np.bool_],
    joined: NDArray[np.bool_],
) -> None:
    """Do the work of `join` for the pairs of a tile, and fill in which are joined.

    `limits` (m, 2) are the largest loss and the most light, `free` particles that no pair has taken yet.
    """
    observation, _ = fitter.to
    view, residual, weight = observation.optics, observation.residual, observation.weight
    responses, prior = room_for(1, observation.capacity, 0), np.zeros((1, 2 * UNKNOWNS))
    depths, starts, best = np.empty(3), np.empty((3, 1, UNKNOWNS)), np.empty((1, UNKNOWNS))
    effort = Effort(STEPS, CHOICE_GAIN)
    for number in numbers:
        first, second = pairs[number]
        if not (free[first] and free[second]):
            continue
        two = 0.0
        for member in (second, first):
            observation.respond(view, particles[member : member + 1], responses)
            pixels, values = lit_by(responses, 0)
            add_light(pixels, values, particles[member, 3], residual)
            two += change_by(pixels, values, particles[member, 3], residual, weight)
        depths[0], depths[1], depths[2] = middle[number, 2], particles[first, 2], particles[second, 2]
        begin_at(view, middle[number], depths, starts)
        choice = Choice(effort, NO_FURTHER, len(starts), LEAST_LIGHT, limits[number, 1])
        highest = two + limits[number, 0]
        lowest = fitter.best(fitter.to, starts, prior, responses, choice, (np.inf, highest), best)
        joined[number] = lowest < highest
        if joined[number]:
            copy_rows(best, particles[first : first + 1])
            free[first] = free[second] = False
        for member in (first, second):
            if member == first or not joined[number]:
                observation.respond(view, particles[member : member + 1], responses)
                pixels, values = lit_by(responses, 0)
                add_light(pixels, values, -particles[member, 3], residual)
