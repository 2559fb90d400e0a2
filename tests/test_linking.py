"""Links in turbulence: what light and the flow's structure tell, odds that come true, and where particles are next."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
import pytest
from scipy.spatial import KDTree

from benchmarks.links import SCALE, Turbulence, shares
from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.grid import Scale
from lfpiv_cli.synthetic.flows import Flow, advect, random_modes, rigid_rotation
from lfpiv_cli.tracks import tracking
from lfpiv_cli.tracks.candidates import NO_TRACK, Light, Seen, common_displacements, light_ratio, long_ones
from lfpiv_cli.tracks.gridding import Structure, kriged, on_grid, structure_of
from lfpiv_cli.tracks.sequences import PAST_FRAMES, REACH_FRAMES, PartialTracks, begun, expected_in, extended, follow
from lfpiv_cli.tracks.tracking import Forecast, marginals, track

# The paper's seeding in a corner of its volume: particles half a millimetre apart.
SMALL = Turbulence(side_mm=5.0)
SIGMA_MM = np.array(SMALL.sigma_mm)
# Table 2's camera.
TABLE2_SCALE = Scale(0.1, 1.064)


@pytest.mark.thorough
@pytest.mark.parametrize(("with_light", "least", "most_wrong"), [(True, 0.985, 0.01), (False, 0.95, 0.03)])
def test_links_hold_in_turbulence(with_light: bool, least: float, most_wrong: float) -> None:
    """Displacements of up to 0.6 mm, neighbours 0.5 mm apart whose displacements differ by half of their own."""
    for seed in (1, 2):
        right, wrong, expected = shares(SMALL, seed, with_light)
        assert right > least
        assert wrong < most_wrong
        # The expected share of wrong links is right within two points.
        assert abs(expected - wrong) < 0.02


def test_partners_are_sought_as_far_as_places_are_uncertain_but_not_ambiguous(rng: np.random.Generator) -> None:
    # One particle, two candidates alike in all: neither is more likely than not.
    first, second = Seen(np.zeros((1, 3))), Seen(np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]))
    assert len(track(first, second, SCALE, 0.4).first) == 0
    assert len(track(first, Seen(second.position_mm[:1]), SCALE, 0.4).first) == 1
    start = rng.uniform(-2.0, 2.0, (60, 3)) * (1.0, 1.0, 4.0)
    moved = np.array([0.3, 0.1, -0.05])
    # Near the focal plane: a depth is known to 0.15 mm where a well-known displacement is forecast.
    depth_sigma = np.where(np.arange(60) % 5 == 0, 0.15, 0.005)
    sigma = np.column_stack([np.full((60, 2), 0.002), depth_sigma])
    covariance = np.column_stack([sigma**2, np.zeros((60, 3))])
    end = start + moved
    end[::5, 2] += 0.3
    forecast = Forecast(np.tile(moved, (60, 1)), np.full((60, 3), 0.005))
    links = track(Seen(start, covariance), Seen(end, covariance), SCALE, 0.6, forecast)
    np.testing.assert_array_equal(links.first, np.arange(60))
    np.testing.assert_array_equal(links.second, np.arange(60))


@dataclass(frozen=True)
class Moved:
    """Tracers of a volume of 50 x 40 microlenses and three depth units, of which a fifth of each frame is alone."""

    scale: Scale
    first: Seen
    second: Seen
    both: int

    @classmethod
    def by(cls, scale: Scale, lenses: tuple[float, float, float], turn: float, rng: np.random.Generator) -> Moved:
        """Return tracers that move by so many microlenses, and by `turn` of where they are about the optical axis."""
        box, count, both = scale.box_mm(1.0, 1.0) * (50.0, 40.0, 3.0), 500, 400
        sigma = scale.box_mm(0.02, 0.05)
        start = rng.uniform(-0.5 * box, 0.5 * box, (count, 3))
        end = start + np.array(lenses) * scale.lens_mm + np.cross((0.0, 0.0, turn), start)
        frames = [at + rng.normal(0.0, sigma, start.shape) for at in (start, end)]
        frames[1][both:] = rng.uniform(-0.5 * box, 0.5 * box, (count - both, 3))
        covariance = np.tile([*sigma**2, 0.0, 0.0, 0.0], (count, 1))
        return cls(scale, Seen(frames[0], covariance), Seen(frames[1], covariance), both)

    def right(self, links: tracking.Tracks) -> tuple[float, float]:
        """Return right links over the tracers in both frames, and wrong ones over all links."""
        right = np.count_nonzero((links.first == links.second) & (links.first < self.both))
        return right / self.both, 1.0 - right / max(len(links.first), 1)


@pytest.mark.parametrize("scale", [TABLE2_SCALE, Scale(0.667, 27.2)], ids=["Table 2", "M -0.15"])
@pytest.mark.parametrize(
    ("lenses", "turn"),
    [((1.5, -1.0, 0.5), 0.0), ((16.0, -8.0, 6.0), 0.0), ((5.0, 9.0, 3.0), 0.25)],
    ids=["near", "far", "far and turning"],
)
def test_partners_are_found_as_far_as_tracers_go_at_any_magnification(
    scale: Scale, lenses: tuple[float, float, float], turn: float, rng: np.random.Generator
) -> None:
    """Up to 19 microlenses; turning, displacements differ by 12 from one side to the other."""
    moved = Moved.by(scale, lenses, turn, rng)
    right, wrong = moved.right(track(moved.first, moved.second, scale))
    # three of four hundred tracers have a depth that is off by four standard errors, or a stranger nearer
    assert right > 0.97
    assert wrong < 0.02
    # what is told of the search holds: within two microlenses nothing is found that moves by 19
    if turn == 0.0 and max(lenses) > 10.0:
        assert moved.right(track(moved.first, moved.second, scale, 2.0 * scale.lens_mm))[0] == 0.0


@pytest.mark.parametrize(("count", "least"), [(1, 0.0), (3, 0.0), (6, 0.9), (30, 0.97)])
def test_few_far_tracers_are_linked_rightly_or_not(count: int, least: float, rng: np.random.Generator) -> None:
    """They move by 11 of the view's 40 x 30 microlenses; half as many others are there."""
    box, sigma = TABLE2_SCALE.box_mm(1.0, 1.0) * (40.0, 30.0, 4.0), TABLE2_SCALE.box_mm(0.02, 0.05)
    right, wrong, trials = 0, 0, 40
    for _ in range(trials):
        start = rng.uniform(-0.5 * box, 0.5 * box - (1.1, 0.0, 0.0), (count, 3))
        end = start + (1.1, 0.3, 0.2) + 0.05 * start[:, ::-1]
        others = rng.uniform(-0.5 * box, 0.5 * box, (2, -(-count // 2), 3))
        frames = [np.concatenate([at, other]) for at, other in zip((start, end), others, strict=True)]
        covariance = np.tile([*sigma**2, 0.0, 0.0, 0.0], (len(frames[0]), 1))
        links = track(*(Seen(at + rng.normal(0.0, sigma, at.shape), covariance) for at in frames), TABLE2_SCALE)
        is_right = (links.first == links.second) & (links.first < count)
        right, wrong = right + int(is_right.sum()), wrong + int((~is_right).sum())
    assert right >= least * count * trials
    # in six frames of forty a stranger is as near as few are by chance; of many, it lies where a lost one is expected
    assert wrong <= max(0.15 * trials, 0.04 * right)


def test_regions_that_share_no_tracers_have_no_displacement_in_common(rng: np.random.Generator) -> None:
    box = TABLE2_SCALE.box_mm(50.0, 3.0)
    first, second = (rng.uniform(0.0, box, (900, 3)) for _ in range(2))
    assert np.isnan(common_displacements(first, second, TABLE2_SCALE)).all()
    # half of them move together, in microlenses, up to half a cell
    second[:450] = first[:450] + 0.1 * np.array([12.0, 5.0, -7.0])
    found = common_displacements(first, second, TABLE2_SCALE)
    assert np.abs(found - 0.1 * np.array([12.0, 5.0, -7.0])).max() <= 0.0801


def test_probabilities_are_those_of_all_exclusive_choices(rng: np.random.Generator) -> None:
    """Three particles and three, all pairs possible, against every way to choose."""
    first, second = (each.ravel() for each in np.meshgrid(np.arange(3), np.arange(3), indexing="ij"))
    odds = np.exp(rng.normal(0.0, 2.0, 9))
    total, of_pair = 0.0, np.zeros(9)
    for chosen in product((False, True), repeat=9):
        some = np.flatnonzero(chosen)
        if np.unique(first[some]).size == len(some) == np.unique(second[some]).size:
            weight = np.prod(odds[some])
            total += weight
            of_pair[some] += weight
    # Belief propagation is near the sum over all choices where pairs form loops ...
    np.testing.assert_allclose(marginals(first, second, odds, (3, 3)), of_pair / total, atol=0.06)
    # ... and exact where they form none: one particle with three candidates, of which one has another suitor.
    first, second, odds = np.array([0, 0, 0, 1]), np.array([0, 1, 2, 2]), np.array([2.0, 1.0, 3.0, 5.0])
    ways = 1.0 + 2.0 + 1.0 + 3.0 + 5.0 + 2.0 * 5.0 + 1.0 * 5.0
    exact = np.array([2.0 + 10.0, 1.0 + 5.0, 3.0, 5.0 + 10.0 + 5.0]) / ways
    np.testing.assert_allclose(marginals(first, second, odds, (2, 3)), exact, atol=1e-5)


def test_light_that_stays_tells_partners(rng: np.random.Generator) -> None:
    light = np.exp(rng.normal(0.0, 0.3, 400))
    owner = np.repeat(np.arange(400), 20)
    target = (owner + rng.integers(1, 400, len(owner))) % 400
    target[::20] = np.arange(400)
    later = 1.3 * light * rng.normal(1.0, 0.02, 400)
    ratio = light_ratio(Light(light), Light(later), owner, target).reshape(400, 20)
    # The peak of partners is 0.02 wide on a background of 0.3 * sqrt(2): where it stands it is twenty times as high.
    assert np.median(ratio[:, 0]) > 8.0
    assert np.median(ratio[:, 1:]) < 0.1
    # Light that changes from frame to frame tells nothing.
    np.testing.assert_array_equal(light_ratio(Light(light), Light(rng.permutation(light)), owner, target), 1.0)
    assert np.all(light_ratio(Light(light), None, owner, target) == 1.0)
    # A quarter of the particles, with light known to 20 %, beside others known to 0.7 %; errors stated three times.
    target = (owner + rng.integers(1, 400, len(owner))) % 400
    target[::20] = np.arange(400)
    light, error = np.exp(rng.normal(0.0, 0.3, 400)), np.where(np.arange(400) % 4 == 0, 0.2, 0.007)
    first, second = (light * np.exp(rng.normal(0.0, error)) for _ in range(2))
    stated = Light(first, 3.0 * error * first), Light(second, 3.0 * error * second)
    ratio = light_ratio(*stated, owner, target)[::20].reshape(100, 4)
    alike = light_ratio(Light(first), Light(second), owner, target)[::20].reshape(100, 4)
    # Partners whose light is known well are told as by themselves: 0.01 wide on 0.3 * sqrt(2), forty times as high.
    assert np.median(ratio[:, 1:]) > 15.0
    # The others are not taken for strangers, for whom it is 0.03, as they are where all errors are one.
    assert np.quantile(ratio[:, 0], 0.1) > 0.15
    assert np.median(alike[:, 0]) < 0.2


def test_kriging_takes_a_linear_flow_exactly_also_from_one_plane(rng: np.random.Generator) -> None:
    # What it misses is stated.
    points, at = rng.uniform(0.0, 4.0, (400, 3)), rng.uniform(0.5, 3.5, (50, 3))
    slope = rng.normal(size=(3, 3))
    structure = Structure(np.zeros(3), np.full(3, 0.01), 2.0 / 3.0)
    value, _ = kriged(at, np.full(50, -1), points, points @ slope, np.full((400, 3), 1e-6), structure)
    np.testing.assert_allclose(value, at @ slope, atol=1e-9)
    # Its own displacement takes no part in what is expected of a particle.
    values = points @ slope
    values[7] += 1.0
    value, _ = kriged(points[7:8], np.array([7]), points, values, np.full((400, 3), 1e-6), structure)
    np.testing.assert_allclose(value, points[7:8] @ slope, atol=1e-9)
    # As those do that are held at the end of a volume: their places tell no trend across it.
    points = np.column_stack([rng.uniform(-2.0, 2.0, (40, 2)), np.full(40, -3.3)])
    slope, at = np.array([[0.1, 0.0, 0.02], [-0.05, 0.03, 0.0], [0.0, 0.0, 0.0]]), points[:5] + 0.01
    at[:, 2] = -3.3
    structure = Structure(np.zeros(3), np.full(3, 1e-3), 1.6)
    value, variance = kriged(at, np.full(5, -1), points, points @ slope, np.full((40, 3), 1e-6), structure)
    np.testing.assert_allclose(value, at @ slope, atol=1e-6)
    assert np.all(variance > 0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_structure_of_turbulence_is_found_and_errors_are_stated(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # 3,000 tracks a millimetre apart, between the longest and the shortest wave
    flow = random_modes(0.15, shortest_mm=0.2, seed=seed)
    points = rng.uniform(0.0, 14.4, (3000, 3))
    sigma = np.full(points.shape, 0.003)
    moved = flow(points) + rng.normal(0.0, sigma)
    structure = structure_of(points, moved, sigma**2)
    assert 0.4 <= structure.exponent <= 1.0  # 2/3 in the inertial range
    nodes = rng.uniform(1.0, 13.4, (500, 3))
    value, error = on_grid(points, moved, sigma, nodes, 4.0)
    covered = np.mean(np.abs(value - flow(nodes)) < 1.96 * error, axis=0)
    # 500 nodes: 1 % each way, and neighbours share tracks
    assert np.all(covered > 0.88)
    assert np.all(covered < 0.985)


def test_noise_is_not_taken_for_turbulence(rng: np.random.Generator) -> None:
    """A uniform flow, whose differences are errors alone, keeps its wide fits."""
    points = rng.uniform(0.0, 5.0, (1000, 3))
    sigma = np.broadcast_to(SIGMA_MM, points.shape)
    value, error = on_grid(points, 0.3 + rng.normal(0.0, sigma), sigma, rng.uniform(1.0, 4.0, (100, 3)), 4.0)
    assert np.all(np.sqrt(np.mean((value - 0.3) ** 2, axis=0)) < 0.4 * SIGMA_MM)
    assert np.all(np.median(error, axis=0) < 0.5 * SIGMA_MM)


@pytest.mark.thorough
def test_false_tracks_do_not_mislead_rough_flows() -> None:
    """One track in twenty half a millimetre off: no worse than without them, and errors are still stated."""
    rng = np.random.default_rng(4)
    flow, points = random_modes(0.15, seed=4), rng.uniform(0.0, 8.0, (4000, 3))
    sigma, nodes = np.full(points.shape, 0.01), rng.uniform(1.0, 7.0, (400, 3))
    moved = flow(points) + rng.normal(0.0, sigma)
    clean, _ = on_grid(points, moved, sigma, nodes, 4.0)
    moved[::20] += rng.choice([-0.5, 0.5], (200, 3))
    value, error = on_grid(points, moved, sigma, nodes, 4.0)
    rms, of_clean = (np.sqrt(np.mean((each - flow(nodes)) ** 2, axis=0)) for each in (value, clean))
    # A twentieth fewer tracks: 2 %.
    assert np.all(rms < 1.1 * of_clean)
    covered = np.mean(np.abs(value - flow(nodes)) < 1.96 * error, axis=0)
    # 400 nodes: 1 % each way, and neighbours share tracks
    assert np.all(covered > 0.9)
    assert np.all(covered < 0.985)


BOX_MM, DT_S = 3.2, 0.002
SEARCH_MM = 0.4
NOISE_MM = np.array([0.003, 0.003, 0.02])
FRAMES = 7


@dataclass(frozen=True, eq=False)
class Recorded:
    """A sequence, and how far it was followed after each frame.

    Attributes
    ----------
    places : true places of all particles in each frame, those outside the box included
    frames : what is seen of them
    numbers : the true particle of each place that is seen
    steps : how far it is with two frames and more
    """

    places: list[Floats]
    frames: list[Seen]
    numbers: list[Integers]
    steps: list[PartialTracks]


def record(flow: Flow) -> Recorded:
    """Return frames with noise, a twentieth of the particles lost in each, followed from the first to the last."""
    rng = np.random.default_rng(9)
    start = rng.uniform(-1.0, BOX_MM + 1.0, (1200, 3))
    light = 1e5 * rng.uniform(0.6, 1.4, len(start))
    places = [advect(flow, start, number * DT_S) for number in range(FRAMES)]
    frames, numbers = [], []
    for where in places:
        there = np.flatnonzero(within(where) & (rng.uniform(size=len(where)) > 0.05))
        noisy = where[there] + rng.normal(0.0, NOISE_MM, (len(there), 3))
        frames.append(Seen(noisy, np.tile([*NOISE_MM**2, 0.0, 0.0, 0.0], (len(there), 1)), Light(light[there])))
        numbers.append(there)
    partial, steps = begun(frames), []
    for _ in frames[1:]:
        partial = extended(partial, frames, SEARCH_MM, TABLE2_SCALE)
        steps.append(partial)
    return Recorded(places, frames, numbers, steps)


def within(places: Floats) -> Flags:
    return np.all((places > 0.0) & (places < BOX_MM), axis=1)


@pytest.fixture(scope="module")
def vortex() -> Recorded:
    """Return particles 0.5 mm apart that move by up to 0.24 mm a frame."""
    return record(rigid_rotation((0.0, 20.0, 0.0), (1.6, 1.6, 1.6), (0.05, 0.0, 0.06)))


@pytest.fixture(scope="module")
def turbulence() -> Recorded:
    """Return the same in vortices of down to 0.7 mm, which they leave after a few frames: 0.15 mm rms a frame."""
    return record(random_modes(0.075, seed=2))


def ahead_of(recorded: Recorded, partial: PartialTracks) -> tuple[Integers, Integers]:
    """Return the true particles and the tracks of what is ahead: the last frame's, then those that it has lost."""
    last, labels = partial.last, partial.found.labels
    lost = np.flatnonzero((labels[last - 1] != NO_TRACK) & ~np.isin(labels[last - 1], labels[last]))
    lost = lost[: len(partial.ahead.position_mm) - len(labels[last])]
    return (
        np.concatenate([recorded.numbers[last], recorded.numbers[last - 1][lost]]),
        np.concatenate([labels[last], labels[last - 1][lost]]),
    )


def errors_over_stated(recorded: Recorded, partial: PartialTracks) -> Floats:
    """Return how far the particles are in the next frame from where they are expected, in stated errors."""
    true, _ = ahead_of(recorded, partial)
    return (partial.ahead.position_mm - recorded.places[partial.last + 1][true]) / partial.ahead.sigma_mm


@pytest.mark.thorough
@pytest.mark.parametrize(("flow", "least"), [("vortex", 0.9), ("turbulence", 0.85)])
def test_stated_errors_of_forecasts_cover(flow: str, least: float, request: pytest.FixtureRequest) -> None:
    """In turbulence errors have longer tails than normal ones: 0.87 to 0.89 were measured."""
    recorded = request.getfixturevalue(flow)
    ratio = np.concatenate([errors_over_stated(recorded, partial) for partial in recorded.steps[1:-1]])
    ratio = ratio[np.isfinite(ratio).all(axis=1)]
    assert len(ratio) > 1000
    covered = np.mean(np.abs(ratio) < 1.96, axis=0)
    assert np.all((covered > least) & (covered < 0.99))


@pytest.mark.thorough
def test_what_one_frame_lost_is_still_ahead(vortex: Recorded) -> None:
    gone, expected, ratios = [], [], []
    for partial in vortex.steps[2:-1]:
        last, numbers = partial.last, vortex.numbers
        true, _ = ahead_of(vortex, partial)
        before = np.intersect1d(numbers[last - 1], numbers[last - 2])
        lost = np.setdiff1d(before[within(vortex.places[last + 1])[before]], numbers[last])
        rows = len(numbers[last]) + np.flatnonzero(np.isin(true[len(numbers[last]) :], lost))
        gone += lost.tolist()
        expected += true[rows].tolist()
        ratios.append(errors_over_stated(vortex, partial)[rows])
    assert len(gone) > 30
    assert len(expected) > 0.9 * len(gone)
    assert np.mean(np.abs(np.concatenate(ratios)) < 3.0) > 0.95


@pytest.mark.thorough
def test_a_frame_is_expected_by_what_is_before_and_after_it(vortex: Recorded) -> None:
    found = long_ones(vortex.steps[-1].found, 3)
    lost, reported, ratios, ends = 0, 0, [], 0
    for number in range(FRAMES):
        near = {k: vortex.frames[k] for k in range(FRAMES) if abs(k - number) <= REACH_FRAMES}
        ahead = expected_in(found, near, number)
        true, inside = vortex.places[number], within(vortex.places[number])
        distance, who = KDTree(true[inside]).query(ahead.position_mm)
        who = np.flatnonzero(inside)[who]
        ratios.append(((ahead.position_mm - true[who]) / ahead.sigma_mm)[distance < 0.1])
        # Those that the frame has lost, of which others of the track's places are seen.
        tracked = np.concatenate([vortex.numbers[k][found.labels[k] != NO_TRACK] for k in near if k != number])
        gone = np.setdiff1d(np.flatnonzero(inside & np.isin(np.arange(len(true)), tracked)), vortex.numbers[number])
        lost, reported = lost + len(gone), reported + np.isin(gone, who[distance < 0.1]).sum()
        ends += np.isin(gone, who[distance < 0.1]).sum() if number in (0, FRAMES - 1) else 0
        # Light is that of the particle in other frames, here the same in all.
        assert np.all(ahead.light > 0.0)
        assert ahead.light_sigma == pytest.approx(0.0, abs=1e-12)
    assert lost > 100
    assert ends > 20  # Beyond the ends of tracks, too.
    assert reported > 0.85 * lost
    covered = np.mean(np.abs(np.concatenate(ratios)) < 1.96, axis=0)
    assert np.all((covered > 0.9) & (covered < 0.99))


@pytest.mark.thorough
def test_a_memory_of_few_frames_gives_the_same_tracks(turbulence: Recorded) -> None:
    recent = {0: turbulence.frames[0]}
    partial = begun(recent)
    for number in range(1, FRAMES):
        recent[number] = turbulence.frames[number]
        recent.pop(number - PAST_FRAMES - 2, None)
        partial = extended(partial, recent, SEARCH_MM, TABLE2_SCALE)
    few, every = long_ones(partial.found, 3), follow(turbulence.frames, SEARCH_MM, 3, TABLE2_SCALE)
    assert few.count == every.count > 200
    for one, other in zip((*few.labels, *few.probability), (*every.labels, *every.probability), strict=True):
        np.testing.assert_array_equal(one, other)
