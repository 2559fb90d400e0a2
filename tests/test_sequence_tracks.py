"""Tracks of a sequence a frame at a time: as all of them together."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.files.particle_file import POSITION
from lfpiv_cli.tracks.candidates import NO_TRACK, Seen, Trajectories
from lfpiv_cli.tracks.in_time import scatter_of
from lfpiv_cli.tracks.sequences import states_at
from lfpiv_cli.verbs.tracks import SequenceTracks

FRAMES, TRACKS, OTHERS = 7, 50, 5
DT_S = 0.5


@pytest.fixture
def sequence(rng: np.random.Generator) -> SequenceTracks:
    """Particles that move evenly, each missed once, and some of no track, in any order."""
    start, moved = rng.random((TRACKS, 3)), 0.1 * rng.random((TRACKS, 3))
    frames, labels, probability = [], [], []
    for number in range(FRAMES):
        track = rng.permutation(np.append(np.delete(np.arange(TRACKS), number), np.full(OTHERS, NO_TRACK)))
        place = np.where(track[:, np.newaxis] == NO_TRACK, 5.0, start[track] + number * moved[track])
        covariance = np.tile([1e-6, 1e-6, 1e-6, 0.0, 0.0, 0.0], (len(track), 1))
        frames.append(Seen(place + rng.normal(0.0, 1e-3, place.shape), covariance))
        labels.append(track)
        probability.append(np.where((track == NO_TRACK) | (number == 0), np.nan, rng.random(len(track))))
    return SequenceTracks.of(Trajectories(tuple(labels), TRACKS, tuple(probability)), frames, DT_S)


def test_rows_are_those_of_all_frames_by_track(sequence: SequenceTracks) -> None:
    every = [sequence.at(number) for number in range(FRAMES)]
    order = np.lexsort([np.concatenate([rows[name] for rows in every]) for name in ("frame", "track")])
    arrays = sequence.by_track()
    assert set(arrays) == set(every[0])
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, np.concatenate([rows[name] for rows in every])[order])
    assert sequence.summary()["tracked"] == len(arrays["track"]) == FRAMES * (TRACKS - 1)


def test_each_place_is_its_particle_s(sequence: SequenceTracks) -> None:
    for number in range(FRAMES):
        rows = sequence.at(number)
        np.testing.assert_array_equal(sequence.found.labels[number][rows["particle"]], rows["track"])
        np.testing.assert_allclose(
            rows[POSITION], sequence.frames[number].position_mm[rows["particle"]], rtol=0.0, atol=6e-3
        )


def test_links_are_as_wrong_as_all_places_say(sequence: SequenceTracks) -> None:
    probability = np.concatenate([sequence.at(number)["link_probability"] for number in range(FRAMES)])
    assert sequence.found.expected_wrong_links() == float(np.nansum(1.0 - probability))


def test_paths_are_the_states_half_way(sequence: SequenceTracks) -> None:
    paths = list(sequence.paths())
    assert len(paths) == FRAMES - 1
    for number, path in enumerate(paths):
        state = states_at(sequence.found, sequence.frames, number + 0.5, sequence.scatter, sequence.half_frames)[1]
        np.testing.assert_array_equal(path.middle_mm, state.position_mm)
        np.testing.assert_array_equal(path.displacement_mm, state.velocity)


@pytest.mark.parametrize("cuts", [[], [3], [40, 41, 200], [0, 290]])
def test_scatter_is_that_of_all_pieces(cuts: list[int], rng: np.random.Generator) -> None:
    time = np.arange(5.0)
    position = rng.random((300, 1, 3)) + time[:, np.newaxis] ** 2 * 0.01 + rng.normal(0.0, 1e-2, (300, 5, 3))
    sigma = rng.uniform(5e-3, 2e-2, position.shape)
    missed = rng.random((300, 5)) < 0.3
    position[missed], sigma[missed] = np.nan, np.nan
    whole = scatter_of([(position, sigma)], time)
    pieces = scatter_of(zip(np.split(position, cuts), np.split(sigma, cuts), strict=True), time)
    assert whole.noise_known
    assert whole.bending_known
    np.testing.assert_array_equal(pieces.noise, whole.noise)
    np.testing.assert_array_equal(pieces.bending, whole.bending)
