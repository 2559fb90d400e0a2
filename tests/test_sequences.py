"""Tracks of pairs and over many frames: flows, ghosts and losses whose answer is known, and what errors promise."""

from dataclasses import dataclass

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.files.particle_file import POSITION
from lfpiv_cli.grid import Scale
from lfpiv_cli.synthetic.flows import advect, rigid_rotation, taylor_green
from lfpiv_cli.tracks.candidates import NO_TRACK, Seen, Trajectories
from lfpiv_cli.tracks.gridding import on_grid
from lfpiv_cli.tracks.in_time import Scatter, fit_in_time, scatter_of
from lfpiv_cli.tracks.sequences import follow, scatter_in, states_at
from lfpiv_cli.tracks.tracking import Forecast, track
from lfpiv_cli.verbs.tracks import SequenceTracks

# Table 2's camera.
SCALE = Scale(0.1, 1.064)
NOISE_MM = np.array([0.003, 0.003, 0.02])
BOX_MM, DT_S = 4.0, 0.002


def moved(points: Floats) -> Floats:
    """Return displacements of a sheared flow that is also turned: up to 0.5 mm, more than the particles' distance."""
    x, y, z = (points - 2.0).T
    return np.stack([0.3 + 0.05 * z, 0.04 * x, -0.1 + 0.03 * y], axis=1)


@pytest.fixture
def frames(rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Two frames of 500 particles in 64 mm3, a tenth of each frame alone in it; the first 450 belong together."""
    both = rng.uniform(0.0, BOX_MM, (450, 3))
    lone = rng.uniform(0.0, BOX_MM, (2, 50, 3))
    noise = rng.normal(0.0, NOISE_MM, (2, 450, 3))
    return np.concatenate([both + noise[0], lone[0]]), np.concatenate([both + moved(both) + noise[1], lone[1]])


def test_particles_are_followed_beyond_their_distance(frames: tuple[Floats, Floats], rng: np.random.Generator) -> None:
    tracks = track(*map(Seen, frames), SCALE, 0.6)
    right = (tracks.first == tracks.second) & (tracks.first < 450)
    assert right.sum() > 0.9 * 450
    assert right.mean() > 0.98
    assert np.unique(tracks.second).size == tracks.second.size
    first, second = (Seen(points) for points in rng.uniform(0.0, BOX_MM, (2, 300, 3)))
    assert len(track(first, second, SCALE, 0.3).first) < 60
    for counts in ((0, 3), (3, 0)):
        assert not track(*(Seen(np.zeros((count, 3))) for count in counts), SCALE, 0.5).first.size


@pytest.mark.thorough
@pytest.mark.parametrize("count", [1, 2, 5, 12, 27])
def test_few_particles_are_followed_among_ghosts(count: int, rng: np.random.Generator) -> None:
    """A fifth as many ghosts, at least one, in each frame; forty pairs of frames for the few."""
    ghosts, right, linked, pairs = -(-count // 5), 0, 0, 40
    for _ in range(pairs):
        both = rng.uniform(0.0, BOX_MM, (count, 3))
        start, end = (each + rng.normal(0.0, NOISE_MM, each.shape) for each in (both, both + moved(both)))
        alone = rng.uniform(0.0, BOX_MM, (2, ghosts, 3))
        frames = np.concatenate([start, alone[0]]), np.concatenate([end, alone[1]])
        links = track(*map(Seen, frames), SCALE, 0.6)
        right += np.count_nonzero((links.first == links.second) & (links.first < count))
        linked += len(links.first)
    # A ghost has another within reach in one frame of forty for each particle there.
    assert right > 0.9 * count * pairs
    assert right > 0.93 * linked


@pytest.mark.parametrize("factor", [10.0, 0.2])
@pytest.mark.parametrize("count", [4, 20, 500])
def test_a_world_of_another_size_has_the_same_links(count: int, factor: float, frames: tuple[Floats, Floats]) -> None:
    some = slice(max(0, 448 - count), 452)
    first, second = frames[0][some], frames[1][some]
    here = track(Seen(first), Seen(second), SCALE, 0.6)
    there = track(Seen(factor * first), Seen(factor * second), Scale(factor * 0.1, factor * 1.064), factor * 0.6)
    np.testing.assert_array_equal(there.first, here.first)
    np.testing.assert_array_equal(there.second, here.second)
    np.testing.assert_allclose(there.probability, here.probability, atol=1e-9)


def test_grid_takes_a_quadratic_flow_exactly_and_has_no_vector_without_tracks(rng: np.random.Generator) -> None:
    points, nodes = rng.uniform(0.0, BOX_MM, (800, 3)), rng.uniform(0.5, 3.5, (20, 3))

    def flow(at: Floats) -> Floats:
        x, y, z = at.T
        return np.stack([1.0 - x**2 + x * z, 0.3 * y + z**2, x * y - y * z], axis=1)

    sigma = np.full(points.shape, 0.01)
    value, error = on_grid(points, flow(points), sigma, np.concatenate([nodes, [[12.0] * 3]]), 1.0)
    np.testing.assert_allclose(value[:-1], flow(nodes), atol=1e-9)
    assert error[:-1].max() < 1e-9
    assert np.isnan([value[-1], error[-1]]).all()


def test_grid_states_its_error_and_ignores_strays(rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, BOX_MM, (1500, 3))
    sigma = np.broadcast_to((0.002, 0.002, 0.02), points.shape)
    values = moved(points) + rng.normal(0.0, sigma)
    values[::25] += rng.uniform(-0.5, 0.5, values[::25].shape)
    nodes = rng.uniform(0.5, 3.5, (200, 3))
    value, error = on_grid(points, values, sigma, nodes, 1.0)
    ratio = np.sqrt(np.mean(((value - moved(nodes)) / error) ** 2, axis=0))
    # A linear flow: nothing is missed, and what is stated for it is what chance makes of nothing. Neighbouring nodes
    # share tracks, so 200 nodes make some 60 independent ones: 10 %.
    assert np.all((ratio > 0.55) & (ratio < 1.2))
    # As well as the sixty tracks of the widest line, and not the ten unknowns of a parabola, let it.
    assert np.all(np.median(np.abs(value - moved(nodes)), axis=0) < 0.25 * sigma[0])


@pytest.mark.thorough
@pytest.mark.parametrize(("wavelength_mm", "tracks"), [(4.0, 1500), (8.0, 300), (2.5, 1500)])
def test_errors_are_stated_at_any_density(wavelength_mm: float, tracks: int, rng: np.random.Generator) -> None:
    """Vortices seen by many tracks and by few: a component that is all noise, and two that bend."""
    flow = taylor_green(0.1, wavelength_mm, (2.0, 2.0, 2.0), "xy")
    points = rng.uniform(0.0, BOX_MM, (tracks, 3))
    sigma = np.full(points.shape, 0.001)
    nodes = np.stack(np.meshgrid(*[np.linspace(0.4, 3.6, 7)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    value, error = on_grid(points, 2.0 * flow(points) + rng.normal(0.0, sigma), sigma, nodes, 4.0)
    covered = np.mean(np.abs(value - 2.0 * flow(nodes)) < 1.96 * error, axis=0)
    # One fit for all, a parabola through 45, covers about .82 of x and y, and has nearly twice the noise in z.
    assert np.all(covered > 0.88)
    assert np.sqrt(np.mean(value[:, 2] ** 2)) < 0.5 * sigma[0, 2]


FRAMES = 6
# Up to 0.26 mm a frame, where particles are 0.5 mm apart.
FLOW = rigid_rotation((0.0, 20.0, 0.0), (2.0, 2.0, 2.0), (0.05, 0.0, 0.06))


@dataclass(frozen=True, eq=False)
class Recorded:
    """Frames of places, and of each place its true one and its true particle, -1 for a ghost."""

    points: list[Floats]
    true_mm: list[Floats]
    true_number: list[Integers]

    noise_mm: Floats

    @property
    def seen(self) -> list[Seen]:
        return [seen(points, self.noise_mm) for points in self.points]

    def follow(self, frames: int, shortest: int) -> Trajectories:
        return follow(self.seen[:frames], 0.4, shortest, SCALE)


def seen(points: Floats, noise_mm: Floats = NOISE_MM) -> Seen:
    """Return places with the covariance of their noise."""
    return Seen(points, np.tile([*noise_mm**2, 0.0, 0.0, 0.0], (len(points), 1)))


def lengths_of(tracks: Trajectories) -> Integers:
    """Return the length of each place's track, 0 where it is of none."""
    labels = np.concatenate(tracks.labels)
    return np.append(np.bincount(labels[labels != NO_TRACK]), 0)[labels]


def record(rng: np.random.Generator, ghosts: float, noise: float) -> Recorded:
    """Return frames of some 500 particles, a tenth lost in each, and a share of ghosts, elsewhere in every frame."""
    start = rng.uniform(-1.0, BOX_MM + 1.0, (1700, 3))
    frames: list[tuple[Floats, ...]] = []
    for number in range(FRAMES):
        places = advect(FLOW, start, number * DT_S)
        inside = np.all((places > 0.0) & (places < BOX_MM), axis=1)
        there = np.flatnonzero(inside & (rng.uniform(size=len(places)) > 0.1))
        alone = rng.uniform(0.0, BOX_MM, (round(ghosts * inside.sum()), 3))
        found = places[there] + rng.normal(0.0, noise * NOISE_MM, (len(there), 3))
        order = rng.permutation(len(there) + len(alone))
        truth = np.concatenate([there, np.full(len(alone), -1)])
        frame = np.concatenate([found, alone]), np.concatenate([places[there], alone]), truth
        frames.append(tuple(array[order] for array in frame))
    points, true_mm, number = (list(each) for each in zip(*frames, strict=True))
    return Recorded(points, true_mm, number, noise * NOISE_MM)


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return record(np.random.default_rng(5), ghosts=0.3, noise=1.0)


@pytest.fixture(scope="module")
def followed(recorded: Recorded) -> Trajectories:
    return recorded.follow(FRAMES, 3)


def error_over_sigma(recorded: Recorded, found: Trajectories, frames: int) -> Floats:
    """Return errors of velocity and these over their stated standard errors, (2, n, 3), of what is no ghost."""
    there = recorded.seen[:frames]
    (scatter, half), both = scatter_in(found, there), []
    for number in range(frames):
        tracks, state = states_at(found, there, float(number), scatter, half)
        particle = found.particles(number, tracks)
        error = state.velocity - FLOW(recorded.true_mm[number][particle]) * DT_S * 1e3
        real = recorded.true_number[number][particle] >= 0
        both.append(np.stack([error, error / state.velocity_sigma])[:, real])
    return np.concatenate(both, axis=1)


@pytest.mark.thorough
def test_errors_fall_with_frames_and_tracks_outlive_lost_ones(recorded: Recorded, followed: Trajectories) -> None:
    pair = track(*recorded.seen[:2], SCALE, 0.4)
    moved = recorded.points[1][pair.second] - recorded.points[0][pair.first]
    middle = 0.5 * (recorded.true_mm[0][pair.first] + recorded.true_mm[1][pair.second])
    spread = [np.median(np.abs(moved - FLOW(middle) * DT_S * 1e3), axis=0)]
    for frames, found in ((3, recorded.follow(3, 3)), (FRAMES, followed)):
        error, ratio = error_over_sigma(recorded, found, frames)
        spread.append(np.median(np.abs(error), axis=0))
        # Velocities of a track share places, and there are 1,000 places a component or more: 4 %; in three frames
        # neither noise nor bending is known well.
        assert np.all(np.abs(np.median(np.abs(ratio), axis=0) / 0.6745 - 1.0) < (0.25 if frames == 3 else 0.12))
    # A pair's velocity has sqrt(2) of a place's error, one over three frames half of that where tracks are straight (y)
    # or at their middle; at the ends of bent ones (x) little is won.
    assert np.all(spread[1] < np.array([0.9, 0.65, 0.75]) * spread[0])
    assert np.all(spread[2] < 0.75 * spread[1])
    before, lost, after = recorded.true_number[2:5]
    gone = np.setdiff1d(np.intersect1d(before[before >= 0], after), lost)
    of_track = [dict(zip(n, t, strict=True)) for n, t in zip(recorded.true_number, followed.labels, strict=True)]
    # Only a track that has begun can be continued.
    begun = [p for p in gone if of_track[2][p] != NO_TRACK and (of_track[2][p] == followed.labels[1]).any()]
    assert len(begun) > 20
    assert np.mean([of_track[2][p] == of_track[4][p] for p in begun]) > 0.85


@pytest.mark.thorough
def test_ghosts_fall_with_the_length_of_tracks() -> None:
    """As many ghosts as particles, which are known so badly that a ghost is often where one is expected."""
    crowd = record(np.random.default_rng(6), ghosts=1.0, noise=4.0)
    pair = track(*crowd.seen[:2], SCALE, 0.4)
    of_pair = np.mean((crowd.true_number[0][pair.first] < 0) | (crowd.true_number[1][pair.second] < 0))
    length, truth = lengths_of(crowd.follow(5, 2)), np.concatenate(crowd.true_number[:5])
    shares = [np.mean(truth[length >= shortest] < 0) for shortest in (3, 4, 5)]
    assert of_pair > 0.05
    assert np.all(np.array(shares) < of_pair * np.array([1.0, 0.5, 0.25]))
    # Known half as badly, nine of ten are there in each frame, and gaps are bridged.
    crowd = record(np.random.default_rng(6), ghosts=1.0, noise=2.0)
    assert np.mean(lengths_of(crowd.follow(5, 2))[np.concatenate(crowd.true_number[:5]) >= 0] >= 3) > 0.85


def test_tracks_are_of_one_particle_each(recorded: Recorded, followed: Trajectories, rng: np.random.Generator) -> None:
    labels, truth = np.concatenate(followed.labels), np.concatenate(recorded.true_number)
    order = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[order], np.arange(followed.count))
    of_one = [np.unique(each).size == 1 for each in np.split(truth[order], starts[1:]) if each.size]
    assert np.mean(of_one) > 0.97
    # None has two places in a frame, and none fewer than were asked for.
    assert all(np.unique(each[each != NO_TRACK]).size == np.sum(each != NO_TRACK) for each in followed.labels)
    assert np.bincount(labels[labels != NO_TRACK]).min() >= 3
    # Each particle moves in its own way, as in a flow with vortices smaller than the particles' distance.
    start = rng.uniform(0.0, BOX_MM, (400, 3))
    moved = rng.normal(0.0, 0.25, start.shape)
    noise = rng.normal(0.0, NOISE_MM, start.shape)
    forecast = Forecast(moved + noise, np.broadcast_to(NOISE_MM, start.shape))
    for prediction, least, most in ((forecast, 0.95, 1.0), (None, 0.0, 0.5)):
        links = track(Seen(start), Seen(start + moved), SCALE, 0.8, prediction)
        assert least * 400 <= np.sum(links.first == links.second) <= most * 400


@pytest.mark.parametrize("frames", [3, 7])
def test_parabolas_are_exact_lines_are_lines_and_noise_is_found(frames: int, rng: np.random.Generator) -> None:
    time = np.arange(frames) - 1.0
    start, velocity, bend = rng.normal(0.0, 1.0, (3, 200, 1, 3)) * np.array([5.0, 0.2, 0.02]).reshape(3, 1, 1, 1)
    straight = start + velocity * time[:, np.newaxis]
    places, sigma = straight + 0.5 * bend * time[:, np.newaxis] ** 2, np.full(straight.shape, 1e-6)
    state = fit_in_time(places, sigma, time, scatter_of([(places, sigma)], time))
    np.testing.assert_allclose(state.velocity, velocity[:, 0], atol=1e-6)
    noisy, sigma = straight + rng.normal(0.0, 0.01, straight.shape), np.full(straight.shape, 0.01)
    scatter = scatter_of([(noisy, sigma)], time)
    # Of 200 tracks the noise is known to 8 %; what that leaves of a bending is half of the noise of one, at most.
    assert np.all(np.sqrt(scatter.bending) < 0.5 * 0.01 * {3: 2.45, 7: 0.218}[frames])
    state = fit_in_time(noisy, sigma, time, Scatter.unknown())
    # The slope of a line through equally good places.
    expected = 0.01 / np.sqrt(np.sum((time - time.mean()) ** 2))
    np.testing.assert_allclose(state.velocity_sigma, expected, rtol=1e-3)
    # Noise that is twice as stated: of 1,600 degrees of freedom a component 3 %, and medians tell half as much.
    noisy, sigma, time = rng.normal(0.0, 0.02, (400, 7, 3)), np.full((400, 7, 3), 0.01), np.arange(7.0) - 3.0
    scatter = scatter_of([(noisy, sigma)], time)
    np.testing.assert_allclose(scatter.noise, 2.0, rtol=0.1)
    state = fit_in_time(noisy, sigma, time, scatter)
    assert np.std(state.velocity / state.velocity_sigma) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("frames", [4, 5, 7])
def test_velocities_on_circles_are_within_their_errors(rng: np.random.Generator, frames: int) -> None:
    """A parabola through seven places of circles that turn by 0.17 rad a frame is off by ten errors of the noise."""
    time, sigma_mm = np.arange(frames) - (frames - 1) / 2.0, np.array([5e-4, 5e-4, 5e-3])
    phase, radius = rng.uniform(0.0, 2.0 * np.pi, (2000, 1)), rng.uniform(0.2, 2.5, (2000, 1))
    angle = phase + 0.17 * time
    places = np.stack([radius * np.cos(angle), 0.0 * angle, radius * np.sin(angle)], axis=2)
    noisy, sigma = places + sigma_mm * rng.normal(size=places.shape), np.broadcast_to(sigma_mm, places.shape)
    scatter = scatter_of([(noisy, sigma)], time)
    state = fit_in_time(noisy, sigma, time, scatter)
    truth = 0.17 * radius * np.stack([-np.sin(phase), 0.0 * phase, np.cos(phase)], axis=2)[:, 0]
    covered = np.mean(np.abs(state.velocity - truth) < 1.96 * state.velocity_sigma, axis=0)
    # 0.005 by chance; the circles are not all of one size, whose spread stands for all
    assert np.all(covered > 0.88)
    # where nothing bends, nothing is allowed for
    assert scatter.jerk[1] < 1e-9
    assert np.median(state.velocity_sigma[:, 1]) < 1.3 * 5e-4 / np.sqrt(np.sum(time**2))


@pytest.mark.parametrize(("turn_rad", "half_frames"), [(0.0, 3), (0.8, 2)])
def test_velocities_take_fewer_frames_in_turns(turn_rad: float, half_frames: int, rng: np.random.Generator) -> None:
    """Particles on circles of 0.05 mm that turn by so much from frame to frame."""
    phase, centre = rng.uniform(0.0, 2.0 * np.pi, 300), rng.uniform(0.0, BOX_MM, (300, 3))
    points = []
    for number in range(7):
        angle = phase + number * turn_rad
        circle = 0.05 * np.stack([np.cos(angle), np.sin(angle), np.zeros(300)], axis=1)
        points.append(centre + circle + rng.normal(0.0, NOISE_MM, centre.shape))
    found = Trajectories((np.arange(300),) * 7, 300, (np.full(300, np.nan),) * 7)
    assert scatter_in(found, [seen(each) for each in points])[1] == half_frames


@pytest.mark.parametrize("count", [1, 2, 5, 12])
def test_few_particles_are_followed_through_a_frame_that_lost_one(count: int, rng: np.random.Generator) -> None:
    start = np.concatenate([np.array([[2.0, 2.0, 2.0]]), rng.uniform(0.5, BOX_MM - 0.5, (count - 1, 3))])
    points = [advect(FLOW, start, number * DT_S) + rng.normal(0.0, NOISE_MM, start.shape) for number in range(FRAMES)]
    # Nobody but a ghost takes the place of the first one in the fourth frame.
    points[3] = np.concatenate([points[3][1:], [[0.1, 0.1, 0.1]]])
    frames = [seen(each) for each in points]
    found = follow(frames, 0.4, 3, SCALE)
    assert found.count == count
    for number, labels in enumerate(found.labels):
        np.testing.assert_array_equal(labels, [*range(1, count), NO_TRACK] if number == 3 else range(count))
    # Neither noise nor bending is known of so few.
    scatter, _ = scatter_in(found, frames)
    assert not scatter.noise_known
    assert not scatter.bending_known


def test_tracks_go_on_over_a_frame_without_particles_and_nothing_gives_none(rng: np.random.Generator) -> None:
    start, empty = rng.uniform(-2.0, 2.0, (100, 3)), seen(np.zeros((0, 3)))
    frames = [seen(start + k * np.array([0.1, 0.0, 0.0]) + rng.normal(0.0, 0.001, start.shape)) for k in range(5)]
    found = follow([*frames[:3], empty, frames[4]], 0.4, 4, SCALE)
    assert found.count == 100
    assert found.lengths().tolist() == [4] * 100
    found = follow([empty] * 4, 0.4, 3, SCALE)
    assert found.count == 0
    assert states_at(found, [empty] * 4, 1.5, *scatter_in(found, [empty] * 4))[0].size == 0


EVEN_FRAMES, EVEN_TRACKS, OTHERS = 7, 50, 5
EVEN_DT_S = 0.5


@pytest.fixture
def sequence(rng: np.random.Generator) -> SequenceTracks:
    """Particles that move evenly, each missed once, and some of no track, in any order."""
    start, moved = rng.random((EVEN_TRACKS, 3)), 0.1 * rng.random((EVEN_TRACKS, 3))
    frames, labels, probability = [], [], []
    for number in range(EVEN_FRAMES):
        track = rng.permutation(np.append(np.delete(np.arange(EVEN_TRACKS), number), np.full(OTHERS, NO_TRACK)))
        place = np.where(track[:, np.newaxis] == NO_TRACK, 5.0, start[track] + number * moved[track])
        covariance = np.tile([1e-6, 1e-6, 1e-6, 0.0, 0.0, 0.0], (len(track), 1))
        frames.append(Seen(place + rng.normal(0.0, 1e-3, place.shape), covariance))
        labels.append(track)
        probability.append(np.where((track == NO_TRACK) | (number == 0), np.nan, rng.random(len(track))))
    return SequenceTracks.of(Trajectories(tuple(labels), EVEN_TRACKS, tuple(probability)), frames, EVEN_DT_S)


def test_a_frame_at_a_time_is_as_all_of_them_together(sequence: SequenceTracks) -> None:
    every = [sequence.at(number) for number in range(EVEN_FRAMES)]
    together = {name: np.concatenate([rows[name] for rows in every]) for name in every[0]}
    arrays, order = sequence.by_track(), np.lexsort([together[name] for name in ("frame", "track")])
    assert set(arrays) == set(together)
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, together[name][order])
    assert sequence.summary()["tracked"] == len(arrays["track"]) == EVEN_FRAMES * (EVEN_TRACKS - 1)
    # Each place is its particle's, and links are as wrong as all places say.
    for number, rows in enumerate(every):
        here = rows["particle"]
        np.testing.assert_array_equal(sequence.found.labels[number][here], rows["track"])
        np.testing.assert_allclose(rows[POSITION], sequence.frames[number].position_mm[here], rtol=0.0, atol=6e-3)
    assert sequence.found.expected_wrong_links() == float(np.nansum(1.0 - together["link_probability"]))
    # Paths are the states half way.
    paths = list(sequence.paths())
    assert len(paths) == EVEN_FRAMES - 1
    for number, path in enumerate(paths):
        state = states_at(sequence.found, sequence.frames, number + 0.5, sequence.scatter, sequence.half_frames)[1]
        np.testing.assert_array_equal(path.middle_mm, state.position_mm)
        np.testing.assert_array_equal(path.displacement_mm, state.velocity)


@pytest.mark.parametrize("cuts", [[], [3], [40, 41, 200], [0, 290]])
def test_scatter_is_that_of_all_pieces(cuts: list[int], rng: np.random.Generator) -> None:
    time = np.arange(5.0)
    position = rng.random((300, 1, 3)) + time[:, np.newaxis] ** 2 * 0.01 + rng.normal(0.0, 1e-2, (300, 5, 3))
    sigma = rng.uniform(5e-3, 2e-2, position.shape)
    position[rng.random((300, 5)) < 0.3] = np.nan
    sigma[np.isnan(position)] = np.nan
    whole = scatter_of([(position, sigma)], time)
    pieces = scatter_of(zip(np.split(position, cuts), np.split(sigma, cuts), strict=True), time)
    assert (whole.noise_known, whole.bending_known) == (True, True)
    np.testing.assert_array_equal([pieces.noise, pieces.bending], [whole.noise, whole.bending])
