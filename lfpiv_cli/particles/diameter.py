"""The tracers' diameter by the images of single ones.

Bright tracers whose light lies apart are fitted in x, y, z and light with balls of several sizes. The size on which
most agree is refined with the light around them taken off, as two rounds of the search find it. How well a tracer's
light is explained is nearly quadratic in the square of the diameter, which is what blurs an image: the vertex and
curvature are the tracer's squared diameter and its standard error. Their median is taken, so that a few that are two,
or larger than the others, do not matter.

Tracers that overlap others which were not found look larger than they are. So only those count around which noise is
all that is left, as it is around one that stands alone; an image that has too few of them shows no size, nor does one
that half or twice the size explains as well.

By waves charge diffusion is measured along with it, see `camera_light`.

Axes: see `search`. Diameters in this module are in microlenses as the scene shows them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.kernels import njit
from lfpiv_cli.particles.camera_light import NO_FORMS, Forms, Together, forms_of, together_of
from lfpiv_cli.particles.fitting import NO_FURTHER, Choice, Fitter, begin_at, fitter_of, judge
from lfpiv_cli.particles.least_squares import (
    SMALLEST_GAIN,
    UNKNOWNS,
    Effort,
    Observation,
    add_light,
    lit_by,
    observation_of,
    room_for,
)
from lfpiv_cli.particles.rounds import (
    CANDIDATE_GAIN,
    ROUNDS,
    Round,
    accepted,
    candidates_of,
    explained,
    with_candidates,
)
from lfpiv_cli.particles.search import (
    LAST_UNEXPLAINED,
    State,
    Task,
    blank,
    judged,
    noise_with,
    observed,
    rebuilt,
    sweep,
    with_measured_noise,
    with_typical_light,
)
from lfpiv_cli.particles.view import by_waves, footprint_radius_mm, on_array_mm, over_tiles, with_radius
from lfpiv_cli.reconstruction.solvers import normalisers
from lfpiv_cli.robust import of_half_the_sum, weighted_median

# Sizes that are tried first, in microlenses: each about twice the one before, from what no camera resolves on.
FIRST_DIAMETERS = (0.06, 0.12, 0.25, 0.5, 0.9, 1.5, 2.4, 3.8)
# Then sizes that are these shares apart, and so many microlenses at least: with the light of the first candidates taken
# off, and with all that two rounds find.
WIDE, NARROW, SMALLEST_STEP = (0.25, 0.1), (0.06, 0.04, 0.03), 0.03
# A diameter that grows beyond is that of no tracer: of light that crowds, balls as wide as all of it explain most.
LARGEST = 1.5 * FIRST_DIAMETERS[-1]
# So many candidates around the middle of all are enough, and all others only take time. They are sought first within
# this share of the volume's shorter side, where that has at least this share of the light that all of the image has.
MOST_CANDIDATES, PART, LIT = 400, 0.2, 0.7
# Parabolas are believed up to so many times as far from the middle as sizes were tried.
FURTHEST = 2.0
# Tracers that are fitted with all sizes. A candidate's light lies apart where it is most of the light around it.
MOST_TRACERS = 40
# What else is within so many microlenses around a tracer's light counts as around it.
AROUND_LENSES = 2.0
# Candidates have at least this share of a typical tracer's light, and of it so much meets the sensor.
BRIGHT, WELL_SEEN = 0.3, 0.9
# The rounds of the search. A wrong size finds less of its light, so that less is asked for.
SEARCH = tuple(replace(settings, claimed_share=ROUNDS[-1].claimed_share) for settings in ROUNDS[:2])
# It is made anew, at most so many times, with the diameter that its tracers show until that stays.
SEARCHES = 6
# Where they crowd, the first diameter is one of these: the unknown one times powers of `LADDER`, at most so many.
LADDER, MOST_STEPS = 1.6, 5
# Starts of the first fits beside a candidate's own depth, in depths over which light spreads by one lens.
START_DEPTHS = (0.0, -0.4, 0.4)
STEPS = 12
# Sweeps of refinement with each diameter.
SWEEPS = 2
# What calibration and model get wrong of a diameter: a share of it, and microlenses.
MODEL_SHARE, MODEL_LENSES = 0.01, 0.025
# Of a diameter that is below so many of its standard errors only an upper limit is known.
LIMIT_SIGMAS = 3.0
# Tracers that are enough, of so many images where there are as many; and where there are none, the diameter that is
# taken.
ENOUGH, FEWEST_FRAMES, UNKNOWN_LENSES = 10, 2, 0.5
# The share of the brightest tracers that must stand alone: of ten of forty that do so where six lie before each
# microlens, the others are more, and what they lack made 0.72 microlenses of 0.5. Of up to 1.5 all do, of four none.
ALONE_SHARE = 0.5
# Only noise is left around a tracer whose chi-squared per pixel is at most this: .6 to 2.3 with the right size and the
# neighbours found, 4 to 500 where neighbours are missing.
NOISE_ALONE = 3.0
# By waves: squares of diffusion that are tried beside the best, px^2, and of the diameter, as a share and
# microlenses^2; and how often they are tried anew about a better one.
DIFFUSION_STEP, SQUARE_STEPS, TRIALS = 0.035, (0.15, 0.01), 4
NINE = np.array([(a, b) for a in (-1.0, 0.0, 1.0) for b in (-1.0, 0.0, 1.0)])


class Sizes(NamedTuple):
    """What single tracers show.

    Attributes
    ----------
    square : (n,) squared diameters in microlenses, below 0 where noise makes an image sharper than a point's
    sigma : (n,) their standard errors
    forms : (m,) what tracers show of size and diffusion together, by waves
    candidates : among how many tracers those that show it were sought
    """

    square: NDArray[np.float64]
    sigma: NDArray[np.float64]
    forms: Forms = NO_FORMS
    candidates: int = 0


NO_SIZES = Sizes(np.zeros(0), np.zeros(0))


@dataclass(frozen=True)
class Diameter:
    """The tracers' diameter.

    Attributes
    ----------
    lenses, sigma_lenses : in microlenses as the scene shows them, and its standard error
    tracers : by how many
    shown : by waves, with diffusion, by the images alone
    held : the same with what is given
    frames : what single images show of it, where several do
    """

    lenses: float
    sigma_lenses: float
    tracers: int
    shown: Together | None = None
    held: Together | None = None
    frames: tuple[Diameter, ...] = ()

    @property
    def resolved(self) -> bool:
        """Whether it is more than an upper limit."""
        return self.lenses > LIMIT_SIGMAS * self.sigma_lenses


def diameter_by(
    tasks: Iterable[Task], lenses: float | None = None, diffusion_px: float | None = None
) -> Diameter | None:
    """Return the diameter that the tracers of the first images show, of as many as are needed; None without tracers.

    By waves with diffusion, either as it is given where it is.
    """
    frames: list[Sizes] = []
    for task in tasks:
        before = diameter_of(frames)
        frames.append(measured_sizes(task, lenses if before is None else before.lenses))
        # Where none of so many stands alone, with any size, in the next image none does either.
        if not frames[-1].square.size and frames[-1].candidates >= MOST_TRACERS:
            break
        # The two images of a pair must agree.
        if len(frames) >= FEWEST_FRAMES and sum(sizes.square.size for sizes in frames) >= ENOUGH:
            break
    showing = [sizes for sizes in frames if sizes.square.size]
    found = _pooled(showing, lenses, diffusion_px)
    if found is None or len(showing) == 1:
        return found
    single = (_pooled([sizes], lenses, diffusion_px) for sizes in showing)
    return replace(found, frames=tuple(each for each in single if each is not None))


def _pooled(frames: Sequence[Sizes], lenses: float | None, diffusion_px: float | None) -> Diameter | None:
    """Return the diameter that the tracers of some frames show together, by waves with diffusion."""
    found, forms = diameter_of(frames), [sizes.forms for sizes in frames]
    if found is None or not sum(len(each.matrix) for each in forms):
        return found
    shown, held = together_of(forms), together_of(forms, lenses, diffusion_px)
    size = held if lenses is None else shown
    return Diameter(size.lenses, size.sigma_lenses, found.tracers, shown, held)


def diameter_of(frames: Sequence[Sizes]) -> Diameter | None:
    """Return the diameter that the tracers of some frames show by their squares; None where there are none."""
    square = np.concatenate([sizes.square for sizes in frames]) if frames else np.zeros(0)
    if not square.size:
        return None
    middle, error = weighted_median(square, np.concatenate([sizes.sigma for sizes in frames]))
    diameter = float(np.sqrt(max(middle, 0.0)))
    # From squares to diameters, also where the diameter is 0: how far up or down the square may be.
    ends = np.sqrt(np.maximum(max(middle, 0.0) + LIMIT_SIGMAS * error * np.array([-1.0, 1.0]), 0.0))
    spread = float(np.abs(ends - diameter).max())
    model = np.hypot(MODEL_SHARE * diameter, MODEL_LENSES)
    return Diameter(diameter, float(np.hypot(spread / LIMIT_SIGMAS, model)), int(square.size))


def measured_sizes(task: Task, diameter: float | None = None) -> Sizes:
    """Return what the tracers of an image show of their sizes; `task` may be of any size.

    Where a `diameter` is given, or known by another image, the search begins with it; it may still lead to another
    one. The middle of the volume is looked at alone where it is lit and has enough candidates, which takes a tenth of
    the time.
    """
    ends = np.array([task.weights.grid.bounds_mm(axis) for axis in range(2)])
    middle = Region(task.camera.to_image_axes(ends.mean(axis=1)), PART * float(np.diff(ends).min()))
    part = _about(task, middle)
    if part is not task and task.prepared[part.weights.window].mean() > LIT * task.prepared.mean():
        candidates = _first_candidates(part, middle)
        if len(candidates) >= MOST_CANDIDATES:
            return _sizes_of(part, candidates, diameter)
    return _sizes_of(task, _first_candidates(task, Region(middle.middle_mm, np.inf)), diameter)


def _first_candidates(task: Task, within: Region) -> NDArray[np.float64]:
    """Return the candidates (n, 4) of the first round in a part of the image."""
    candidates, _ = candidates_of(task, blank(task), ROUNDS[0].iterations, None)
    return candidates[within.holds(candidates)]


def _sizes_of(task: Task, candidates: NDArray[np.float64], diameter: float | None) -> Sizes:
    """Return `measured_sizes` by the first candidates (n, 4), those in their middle where they are many."""
    region = Region(np.zeros(2), 0.0)
    if len(candidates):
        middle = np.median(candidates[:, :2], axis=0)
        distances = np.sort(np.linalg.norm(candidates[:, :2] - middle, axis=1))
        region = Region(middle, float(distances[min(MOST_CANDIDATES, len(distances)) - 1]))
        candidates, task = candidates[region.holds(candidates)], _about(task, region)
    # Typical is the light that most of the candidates' comes from.
    state = blank(task)
    *_, seen = judge(observed(task, state, LAST_UNEXPLAINED), candidates)
    bright = candidates[seen > WELL_SEEN, 3]
    typical = of_half_the_sum(bright) if bright.size else 0.0
    state = replace(state, typical_light=typical, noise=noise_with(task, typical))
    if diameter is not None:
        sizes = _settled_sizes(Sought(task, state, candidates, region), diameter, SEARCH)
        if sizes.square.size:
            return sizes
    diameter, apart = _first_diameter(task, state, _apart(task, state, candidates))
    if not len(apart):
        return NO_SIZES
    sought = Sought(task, state, np.concatenate([apart, candidates]), region)
    for share in WIDE:
        task = _of_diameter(task, diameter)
        found = accepted(task, _begun(task, state), sought.candidates.copy(), SEARCH[0])
        diameter = _tried(task, found, _steps(diameter, share), SEARCH[0].unexplained).diameter
    sizes = _settled_sizes(sought, diameter, SEARCH)
    sizes = sizes if sizes.square.size else _crowded_sizes(sought)
    return sizes._replace(candidates=len(candidates))


class Region(NamedTuple):
    """The part of the image that is looked at, about a point (x, y), mm in image axes."""

    middle_mm: NDArray[np.float64]
    radius_mm: float

    @property
    def inner(self) -> Region:
        """The half as wide one about the same point."""
        return Region(self.middle_mm, 0.5 * self.radius_mm)

    def holds(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which points (n, 2 or more) lie in it."""
        return np.asarray(np.linalg.norm(points[:, :2] - self.middle_mm, axis=1) <= self.radius_mm)


def _about(task: Task, region: Region) -> Task:
    """Return the task with the volume of those voxels alone that light what the region does."""
    view = task.view
    ends = np.array([[*region.middle_mm, depth_mm] for depth_mm in task.depths_mm])
    # Once to the pixels that the region lights, and once more to what else lights them.
    spread = 2.0 * footprint_radius_mm(view, ends).max() * view.scale.lens_mm / (2.0 * view.half_x_mm)
    middle, calibration = task.camera.to_image_axes(region.middle_mm), task.weights.calibration
    if calibration is not None:
        middle = calibration.rectification.from_world(middle, task.weights.column_axis)
    weights = task.weights.around(middle, region.radius_mm + float(spread))
    if weights is task.weights:
        return task
    return replace(task, weights=weights, sums=normalisers(weights.padded, task.sums.inverse_row_sum == 0.0))


class Sought(NamedTuple):
    """What the search of a part of an image begins with.

    Attributes
    ----------
    state : without particles
    candidates : (n, 4) of the first round
    """

    task: Task
    state: State
    candidates: NDArray[np.float64]
    region: Region


# A task with a diameter, and what was found with it.
Found: TypeAlias = tuple[Task, State]


def _found(sought: Sought, diameter: float, rounds: Sequence[Round]) -> Found:
    """Return what rounds of the search find in the region with a diameter."""
    task = _of_diameter(sought.task, diameter)
    state = explained(task, _begun(task, sought.state), sought.candidates.copy(), rounds[0])
    for settings in rounds[1:]:
        more, light = candidates_of(task, state, settings.iterations, None)
        inside = sought.region.holds(more)
        state = explained(task, *with_candidates(task, state, more[inside], light[inside]), settings)
    return task, state


def _crowded_sizes(sought: Sought) -> Sizes:
    """Return the sizes of crowded tracers, whose neighbours all rounds are needed for.

    Of the diameter with which they explain the image best, to half of `LADDER`, where the unknown one does not lead
    there by itself: with a wrong one neighbours are not found, and chi-squared is several times as large.
    """

    def trial(step: int) -> tuple[float, Found]:
        task, state = first if step == 0 else _found(sought, UNKNOWN_LENSES * LADDER**step, ROUNDS)
        fits = judged(task, state, 0.0)
        bright = _bright(state, fits.seen)
        return float(np.median(fits.chi2[bright])) if bright.any() else np.inf, (task, state)

    first = _found(sought, UNKNOWN_LENSES, ROUNDS)
    sizes = _settled_sizes(sought, UNKNOWN_LENSES, ROUNDS, first)
    if sizes.square.size:
        return sizes
    best, (misfit, found) = 0, trial(0)
    for way in (-1, 1):
        while abs(best) < MOST_STEPS and (other := trial(best + way))[0] < misfit:
            best, (misfit, found) = best + way, other
        if best != 0:
            break
    return sizes if best == 0 else _settled_sizes(sought, UNKNOWN_LENSES * LADDER**best, ROUNDS, found)


def _settled_sizes(sought: Sought, diameter: float, rounds: Sequence[Round], first: Found | None = None) -> Sizes:
    """Return the sizes of tracers that stand alone, with the search made anew until the diameter stays.

    `first` is what was found with the diameter that it begins with, where that is known.
    """
    for _ in range(SEARCHES):
        if diameter > LARGEST:
            return NO_SIZES
        searched_with = diameter
        task, found = first or _found(sought, diameter, rounds)
        first = None
        for share in NARROW:
            diameters = _steps(diameter, share)
            trial = _tried(task, found, diameters, LAST_UNEXPLAINED)
            diameter = trial.diameter
        # Where neighbours are missing everywhere, what explains most of their light is no tracer's size.
        settled = abs(diameter - searched_with) < max(NARROW[0] * searched_with, SMALLEST_STEP)
        if settled or not trial.alone.any():
            break
    if not _enough(trial.alone):
        return NO_SIZES
    sizes = _vertices(np.square(diameters), trial.losses[:, trial.alone])
    best = _tried(task, found, diameter * np.array([0.5, 1.0, 2.0]), LAST_UNEXPLAINED).diameter
    # Half of what is too small to be seen looks the same.
    unseen = best < diameter and (pooled := diameter_of([sizes])) is not None and not pooled.resolved
    if best != diameter and not unseen:
        return NO_SIZES
    if not by_waves(task.view):
        return sizes
    # In the inner half of the region, which the image holds.
    near = np.count_nonzero(sought.region.inner.holds(found.particles))
    lenses = np.pi * (sought.region.inner.radius_mm / task.view.scale.lens_mm) ** 2
    return sizes._replace(forms=_forms(task, found, diameter)._replace(crowd=near / lenses))


def _enough(alone: NDArray[np.bool_]) -> bool:
    """Return whether noise is all that is left around enough of the tracers (n,)."""
    return bool(alone.any() and np.count_nonzero(alone) >= ALONE_SHARE * alone.size)


def _forms(task: Task, found: State, diameter: float) -> Forms:
    """Return what tracers that stand alone lose with squares of diameter and diffusion about those that are best."""
    middle = np.square([diameter, task.view.diffusion_px])
    forms = NO_FORMS
    for _ in range(TRIALS):
        steps = np.array([SQUARE_STEPS[0] * middle[0] + SQUARE_STEPS[1], DIFFUSION_STEP])
        middle = np.maximum(middle, steps)
        squares = middle + steps * NINE
        trial = _tried(task, found, np.sqrt(squares), LAST_UNEXPLAINED)
        if not _enough(trial.alone):
            break
        forms = forms_of(squares, trial.losses[:, trial.alone])
        best = together_of([forms])
        moved = (np.square([best.lenses, best.diffusion_px]) - middle) / steps
        if np.all(np.abs(moved) < 1.0):
            break
        middle = middle + steps * np.clip(moved, -2.0, 2.0)
    return forms


def _begun(task: Task, state: State) -> State:
    """Return the state without particles, with a residual of its own, which is worked on in place."""
    return rebuilt(task, state, state.particles[:0])


def _steps(diameter: float, share: float) -> NDArray[np.float64]:
    """Return diameters (m,) around one, a share of it apart."""
    step = max(share * diameter, SMALLEST_STEP)
    return max(diameter, 2.0 * step) + step * np.arange(-2.0, 3.0)


def _common(diameters: NDArray[np.float64], losses: NDArray[np.float64]) -> float:
    """Return the diameter that most tracers agree on, by what each loses (m, n) with each; without any, the middle one.

    Losses count by their logarithms, so that a tracer that is two or has another size loses little more the more wrong
    it is.
    """
    if not losses.size:
        return float(diameters[len(diameters) // 2])
    return float(diameters[np.argmin(np.sum(np.log1p(losses), axis=1))])


def _of_diameter(task: Task, diameter: float, diffusion_px: float | None = None) -> Task:
    """Return the task with tracers of a diameter, and with another diffusion by waves."""
    view = task.view if diffusion_px is None else task.view._replace(diffusion_px=diffusion_px)
    return replace(task, view=with_radius(view, 0.5 * diameter * view.scale.lens_mm))


def _apart(task: Task, state: State, candidates: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return bright candidates (n, 4), those first whose light is most of what is around them."""
    *_, seen = judge(observed(task, state, 0.0), candidates)
    bright = candidates[(candidates[:, 3] > BRIGHT * state.typical_light) & (seen > WELL_SEEN)]
    # The light in squares of the image that hold theirs and what is around it.
    view, camera = task.view, task.view.camera
    size = np.array([camera.columns, camera.rows])
    image = np.where(task.usable, task.light, 0.0).reshape(camera.rows, camera.columns)
    sums = np.pad(image.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    reach = footprint_radius_mm(view, bright) + 2.0 * AROUND_LENSES * max(view.half_x_mm, view.half_y_mm)
    middle, reach = on_array_mm(view, bright) / camera.pixel_mm + 0.5 * size, reach[:, np.newaxis] / camera.pixel_mm
    left, top = np.clip(np.rint(middle - reach), 0, size).astype(np.int64).T
    right, bottom = np.clip(np.rint(middle + reach), 0, size).astype(np.int64).T
    around = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    share = bright[:, 3] / np.maximum(around, bright[:, 3])
    return bright[np.argsort(-share, kind="stable")[:MOST_TRACERS]]


def _first_diameter(task: Task, state: State, apart: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the one of the first sizes that candidates fitted alone agree on, and these as fitted, without noise."""
    # The image in place of a model that is not known yet; nothing has been taken off it.
    weight = state.noise.weights(task.image, np.zeros_like(task.image), 0.0)
    weight, image = np.where(task.usable, weight, 0.0), task.light.copy()
    tracers = apart * (1.0, 1.0, 1.0, 0.0)
    starts = apart[:, 2:3] + np.array(START_DEPTHS) * task.view.scale.depth_mm
    fits = []
    for diameter in FIRST_DIAMETERS:
        task = _of_diameter(task, diameter)
        observation = observation_of(task.view, image, weight, task.depths_mm)
        fits.append(_fitted(observation, observation, tracers, starts))
    change = np.stack([each for each, _ in fits])
    real = change.min(axis=0) < -CANDIDATE_GAIN
    diameter = _common(np.array(FIRST_DIAMETERS), (change - change.min(axis=0))[:, real])
    return diameter, fits[FIRST_DIAMETERS.index(diameter)][1][real]


@dataclass(frozen=True, eq=False)
class Trial:
    """What bright tracers say of some diameters.

    Attributes
    ----------
    diameter : the one that they agree on
    losses : (m, n) of each with each, in chi-squared, in units of what is left of a tracer's own, at least 1
    task, state : with the middle one
    tracers : (n, 4)
    """

    diameter: float
    losses: NDArray[np.float64]
    task: Task
    state: State
    tracers: NDArray[np.float64]

    @cached_property
    def alone(self) -> NDArray[np.bool_]:
        """Whether noise is all that is left around a tracer (n,)."""
        noisy = with_measured_noise(self.task, self.state)
        return judge(observed(self.task, noisy, 0.0), self.tracers)[0] <= NOISE_ALONE


def _tried(task: Task, state: State, diameters: NDArray[np.float64], unexplained: float) -> Trial:
    """Return what bright tracers say of diameters (m,), or of diameters and diffusions (m, 2), the middle ones best."""
    trials = diameters.reshape(len(diameters), -1)
    task = _of_diameter(task, *trials[len(trials) // 2])
    state = rebuilt(task, state, state.particles)
    sweep(task, state, unexplained, SWEEPS)
    state = with_typical_light(task, state, judged(task, state, LAST_UNEXPLAINED))
    observation = observed(task, state, unexplained)
    chi2, _, _, seen = judge(observation, state.particles)
    bright = _bright(state, seen)
    good = np.flatnonzero(bright)[np.argsort(chi2[bright], kind="stable")[:MOST_TRACERS]]
    tracers, change = state.particles[good], np.zeros((len(trials), good.size))
    seen_by = observation.residual, observation.weight, task.depths_mm
    for number, trial in enumerate(trials):
        sized = observation_of(_of_diameter(task, *trial).view, *seen_by)
        change[number], _ = _fitted(observation, sized, tracers, tracers[:, 2:3])
    losses = (change - change.min(axis=0)) / np.maximum(chi2[good], 1.0)
    return Trial(_common(trials[:, 0], losses), losses, task, state, tracers)


def _bright(state: State, seen: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which particles are as bright as tracers and wholly seen, by the shares (n,) of their light that are."""
    return np.asarray((state.particles[:, 3] > BRIGHT * state.typical_light) & (seen > WELL_SEEN))


def _vertices(square: NDArray[np.float64], losses: NDArray[np.float64]) -> Sizes:
    """Return the squares where parabolas through losses (m, n) are lowest, and how far from there they rise by 1.

    Tracers whose parabola opens downwards, or is lowest far from all squares (m,) that were tried, are left out.
    """
    middle, half = 0.5 * (square[0] + square[-1]), 0.5 * (square[-1] - square[0])
    if not losses.size:
        return NO_SIZES
    curvature, slope, _ = np.polyfit((square - middle) / half, losses, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = -0.5 * slope / curvature
        sigma = 1.0 / np.sqrt(curvature)
    near = (curvature > 0.0) & (np.abs(vertex) < FURTHEST)
    return Sizes(middle + half * vertex[near], half * sigma[near])


def _fitted(
    observation: Observation, sized: Observation, tracers: NDArray[np.float64], depths_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what each tracer adds to chi-squared when it is fitted with another size, (n,), and the fits (n, 4).

    Parameters
    ----------
    observation : whose residual lacks the tracers' light, of the size that they have there; in place again on return
    sized : the same with the other size
    tracers : (n, 4) where fits begin
    depths_mm : (n, k) their depths
    """
    fitter = fitter_of(sized)
    change, fitted, starts = np.zeros(len(tracers)), tracers.copy(), np.clip(depths_mm, *observation.depths_mm)
    larger = max(observation.optics, sized.optics, key=lambda view: view.particle_radius_mm)
    arguments = observation, fitter, tracers, starts, change, fitted
    over_tiles(_fit_each, larger, tracers, observation.depths_mm, *arguments)
    return change, fitted


@njit(cache=True, nogil=True)
def _fit_each(
    numbers: NDArray[np.int64],
    observation: Observation,
    fitter: Fitter,
    tracers: NDArray[np.float64],
    depths_mm: NDArray[np.float64],
    change: NDArray[np.float64],
    fitted: NDArray[np.float64],
) -> None:
    """Do the work of `_fitted` for the tracers of a tile."""
    residual, (sized, _) = observation.residual, fitter.to
    own, responses = room_for(1, observation.capacity, 0), room_for(1, sized.capacity, 0)
    starts, prior = np.empty((depths_mm.shape[1], 1, UNKNOWNS)), np.zeros((1, 2 * UNKNOWNS))
    effort = Effort(STEPS, SMALLEST_GAIN)
    choice = Choice(effort, NO_FURTHER, len(starts), 0.0, np.inf)
    for number in numbers:
        observation.respond(observation.optics, tracers[number : number + 1], own)
        pixels, values = lit_by(own, 0)
        add_light(pixels, values, tracers[number, 3], residual)
        begin_at(sized.optics, tracers[number], depths_mm[number], starts)
        best = fitted[number : number + 1]
        change[number] = fitter.best(fitter.to, starts, prior, responses, choice, (0.0, 0.0), best)
        add_light(pixels, values, -tracers[number, 3], residual)
