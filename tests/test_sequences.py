"""Tracks over many frames: ghosts and losses whose answer is known, and what the velocities' errors promise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.scale import Scale
from lfpiv_cli.synthetic.flows import advect, rigid_rotation
from lfpiv_cli.tracks.candidates import NO_TRACK, Seen, Trajectories
from lfpiv_cli.tracks.in_time import Scatter, fit_in_time, scatter_of
from lfpiv_cli.tracks.sequences import follow, scatter_in, states_at
from lfpiv_cli.tracks.tracking import Forecast, track

BOX_MM, DT_S = 4.0, 0.002
NOISE_MM = np.array([0.003, 0.003, 0.02])
FRAMES = 6
# Table 2's camera.
SCALE = Scale(0.1, 1.064)
# Up to 0.26 mm a frame, where particles are 0.5 mm apart.
FLOW = rigid_rotation((0.0, 20.0, 0.0), (2.0, 2.0, 2.0), (0.05, 0.0, 0.06))


@dataclass(frozen=True, eq=False)
class Recorded:
    """Frames of places, and of each place its true one and its true particle, -1 for a ghost."""

    points: list[NDArray[np.float64]]
    true_mm: list[NDArray[np.float64]]
    true_number: list[NDArray[np.int64]]

    noise_mm: NDArray[np.float64]

    @property
    def seen(self) -> list[Seen]:
        return [seen(points, self.noise_mm) for points in self.points]

    def follow(self, frames: int, shortest: int) -> Trajectories:
        return follow(self.seen[:frames], 0.4, shortest, SCALE)


def seen(points: NDArray[np.float64], noise_mm: NDArray[np.float64] = NOISE_MM) -> Seen:
    """Return places with the covariance of their noise."""
    return Seen(points, np.tile([*noise_mm**2, 0.0, 0.0, 0.0], (len(points), 1)))


def record(rng: np.random.Generator, ghosts: float, noise: float) -> Recorded:
    """Return frames of some 500 particles, a tenth lost in each, and a share of ghosts, elsewhere in every frame."""
    start = rng.uniform(-1.0, BOX_MM + 1.0, (1700, 3))
    frames: list[tuple[NDArray[np.float64], ...]] = []
    for number in range(FRAMES):
        places = advect(FLOW, start, number * DT_S)
        inside = np.all((places > 0.0) & (places < BOX_MM), axis=1)
        there = np.flatnonzero(inside & (rng.uniform(size=len(places)) > 0.1))
        alone = rng.uniform(0.0, BOX_MM, (round(ghosts * inside.sum()), 3))
        found = places[there] + rng.normal(0.0, noise * NOISE_MM, (len(there), 3))
        order = rng.permutation(len(there) + len(alone))
        truth = np.concatenate([there, np.full(len(alone), -1)])
        frames.append((np.concatenate([found, alone]), np.concatenate([places[there], alone]), truth))
        frames[-1] = tuple(array[order] for array in frames[-1])
    points, true_mm, number = (list(each) for each in zip(*frames, strict=True))
    return Recorded(points, true_mm, number, noise * NOISE_MM)


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return record(np.random.default_rng(5), ghosts=0.3, noise=1.0)


@pytest.fixture(scope="module")
def followed(recorded: Recorded) -> Trajectories:
    return recorded.follow(FRAMES, 3)


def error_over_sigma(recorded: Recorded, found: Trajectories, frames: int) -> NDArray[np.float64]:
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
def test_errors_fall_with_the_number_of_frames_and_are_stated(recorded: Recorded, followed: Trajectories) -> None:
    pair = track(*recorded.seen[:2], 0.4, SCALE)
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


@pytest.mark.thorough
def test_ghosts_fall_with_the_length_of_tracks() -> None:
    """As many ghosts as particles, which are known so badly that a ghost is often where one is expected."""
    crowd = record(np.random.default_rng(6), ghosts=1.0, noise=4.0)
    pair = track(*crowd.seen[:2], 0.4, SCALE)
    of_pair = np.mean((crowd.true_number[0][pair.first] < 0) | (crowd.true_number[1][pair.second] < 0))
    found = crowd.follow(5, 2)
    labels, truth = np.concatenate(found.labels), np.concatenate(crowd.true_number[:5])
    length = np.append(np.bincount(labels[labels != NO_TRACK]), 0)[labels]
    shares = [np.mean(truth[length >= shortest] < 0) for shortest in (3, 4, 5)]
    assert of_pair > 0.05
    assert shares[0] < of_pair
    assert shares[1] < 0.5 * of_pair
    assert shares[2] < 0.25 * of_pair


@pytest.mark.thorough
def test_short_tracks_hold_few_particles() -> None:
    """As many ghosts as particles, known half as badly: nine of ten are there in each frame, and gaps are bridged."""
    crowd = record(np.random.default_rng(6), ghosts=1.0, noise=2.0)
    labels, truth = np.concatenate(crowd.follow(5, 2).labels), np.concatenate(crowd.true_number[:5])
    length = np.append(np.bincount(labels[labels != NO_TRACK]), 0)[labels]
    assert np.mean(length[truth >= 0] >= 3) > 0.85


@pytest.mark.thorough
def test_tracks_go_on_over_a_frame_that_has_lost_them(recorded: Recorded, followed: Trajectories) -> None:
    before, lost, after = recorded.true_number[2:5]
    gone = np.setdiff1d(np.intersect1d(before[before >= 0], after), lost)
    of_track = [dict(zip(n, t, strict=True)) for n, t in zip(recorded.true_number, followed.labels, strict=True)]
    # Only a track that has begun can be continued.
    begun = [p for p in gone if of_track[2][p] != NO_TRACK and (of_track[2][p] == followed.labels[1]).any()]
    assert len(begun) > 20
    assert np.mean([of_track[2][p] == of_track[4][p] for p in begun]) > 0.85


def test_tracks_are_of_one_particle_each(recorded: Recorded, followed: Trajectories) -> None:
    labels, truth = np.concatenate(followed.labels), np.concatenate(recorded.true_number)
    order = np.argsort(labels, kind="stable")
    starts = np.searchsorted(labels[order], np.arange(followed.count))
    of_one = [np.unique(each).size == 1 for each in np.split(truth[order], starts[1:]) if each.size]
    assert np.mean(of_one) > 0.97
    # None has two places in a frame, and none fewer than were asked for.
    assert all(np.unique(each[each != NO_TRACK]).size == np.sum(each != NO_TRACK) for each in followed.labels)
    assert np.bincount(labels[labels != NO_TRACK]).min() >= 3


def test_frames_of_nothing_give_no_tracks() -> None:
    empty = [seen(np.zeros((0, 3)))] * 4
    found = follow(empty, 0.4, 3, SCALE)
    assert found.count == 0
    assert states_at(found, empty, 1.5, *scatter_in(found, empty))[0].size == 0


@pytest.mark.parametrize("frames", [3, 7])
def test_parabolas_are_taken_exactly_and_lines_are_lines(frames: int, rng: np.random.Generator) -> None:
    time = np.arange(frames) - 1.0
    start, velocity, bend = rng.normal(0.0, 1.0, (3, 200, 1, 3)) * np.array([5.0, 0.2, 0.02]).reshape(3, 1, 1, 1)
    places = start + velocity * time[:, np.newaxis] + 0.5 * bend * time[:, np.newaxis] ** 2
    sigma = np.full(places.shape, 1e-6)
    state = fit_in_time(places, sigma, time, scatter_of([(places, sigma)], time))
    np.testing.assert_allclose(state.velocity, velocity[:, 0], atol=1e-6)
    straight = places - 0.5 * bend * time[:, np.newaxis] ** 2
    noisy, sigma = straight + rng.normal(0.0, 0.01, straight.shape), np.full(straight.shape, 0.01)
    scatter = scatter_of([(noisy, sigma)], time)
    # Of 200 tracks the noise is known to 8 %; what that leaves of a bending is half of the noise of one, at most.
    assert np.all(np.sqrt(scatter.bending) < 0.5 * 0.01 * {3: 2.45, 7: 0.218}[frames])
    state = fit_in_time(noisy, sigma, time, Scatter.unknown())
    # The slope of a line through equally good places.
    expected = 0.01 / np.sqrt(np.sum((time - time.mean()) ** 2))
    np.testing.assert_allclose(state.velocity_sigma, expected, rtol=1e-3)


def test_noise_that_is_not_as_stated_is_found(rng: np.random.Generator) -> None:
    noisy, sigma, time = rng.normal(0.0, 0.02, (400, 7, 3)), np.full((400, 7, 3), 0.01), np.arange(7.0) - 3.0
    scatter = scatter_of([(noisy, sigma)], time)
    # 1,600 degrees of freedom a component: 3 %, and medians tell half as much.
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
    assert scatter.twisting[1] < 1e-9
    assert np.median(state.velocity_sigma[:, 1]) < 1.3 * 5e-4 / np.sqrt(np.sum(time**2))


def test_a_track_s_own_past_goes_before_its_neighbours(rng: np.random.Generator) -> None:
    """Each particle moves in its own way, as in a flow with vortices smaller than the particles' distance."""
    start = rng.uniform(0.0, BOX_MM, (400, 3))
    moved = rng.normal(0.0, 0.25, start.shape)
    noise = rng.normal(0.0, NOISE_MM, start.shape)
    forecast = Forecast(moved + noise, np.broadcast_to(NOISE_MM, start.shape))
    for prediction, least, most in ((forecast, 0.95, 1.0), (None, 0.0, 0.5)):
        links = track(Seen(start), Seen(start + moved), 0.8, SCALE, prediction)
        assert least * 400 <= np.sum(links.first == links.second) <= most * 400


@pytest.mark.parametrize(("turn_rad", "half_frames"), [(0.0, 3), (0.8, 2)])
def test_velocities_take_fewer_frames_where_parabolas_do_not_follow(
    turn_rad: float, half_frames: int, rng: np.random.Generator
) -> None:
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
        whole = np.roll(labels, 1) if number == 3 else labels
        np.testing.assert_array_equal(whole, [NO_TRACK, *range(1, count)] if number == 3 else range(count))
    # Neither noise nor bending is known of so few.
    scatter, _ = scatter_in(found, frames)
    assert not scatter.noise_known
    assert not scatter.bending_known


def test_tracks_go_on_over_a_frame_without_particles(rng: np.random.Generator) -> None:
    start = rng.uniform(-2.0, 2.0, (100, 3))
    frames = [seen(start + k * np.array([0.1, 0.0, 0.0]) + rng.normal(0.0, 0.001, start.shape)) for k in range(5)]
    found = follow([*frames[:3], seen(np.zeros((0, 3))), frames[4]], 0.4, 4, SCALE)
    assert found.count == 100
    assert found.lengths().tolist() == [4] * 100
