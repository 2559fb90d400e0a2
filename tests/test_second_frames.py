"""The second frame of a pair begins with what is beyond doubt in the first, where the flow lets it be expected."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.files.batch import Frame
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles import neighbour_frames
from lfpiv_cli.particles.neighbour_frames import Predicted, beyond_doubt, predicted_by, second_frame
from lfpiv_cli.particles.rounds import first_pass
from lfpiv_cli.scale import Scale
from lfpiv_cli.verbs import particles as particles_interface
from lfpiv_cli.verbs.particles import STEPS, Finder
from tests.particle_images import found, task_with

# The fits take half a minute to compile.
pytestmark = pytest.mark.thorough

SEARCH_MM, SCALE = 0.6, Scale(0.1, 1.064)
MOVED = np.array([0.12, -0.05, 0.04, 0.0])


def scene(rng: np.random.Generator, count: int = 30) -> NDArray[np.float64]:
    return rng.uniform((-0.9, -0.7, 1.2, 4e5), (0.9, 0.7, 2.6, 6e5), (count, 4))


def ghosts(rng: np.random.Generator) -> NDArray[np.float64]:
    return scene(rng, 3)


def test_what_fits_and_finds_its_light_is_beyond_doubt(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    true = scene(rng)
    true[1] = true[0] + (0.03, -0.02, 0.2, 0.0)
    task = task_with(table2, water, true, rng)
    as_one = [*(0.5 * (true[0] + true[1]))[:3], true[0, 3] + true[1, 3]]
    sure = beyond_doubt(task, np.concatenate([true[2:], [as_one], ghosts(rng)]))
    assert sure[:28].mean() > 0.8
    assert not sure[28:].any()


def test_particles_are_expected_where_the_flow_takes_them(rng: np.random.Generator) -> None:
    trusted = scene(rng, 60)
    # Half of them are seen already, all of them brighter, and none of the rest is anywhere near.
    seen = (trusted[:30] + MOVED) * (1.0, 1.0, 1.0, 1.2)
    seen[:, :2] += rng.normal(0.0, 2e-4, (30, 2))
    predicted = predicted_by(trusted, seen, SEARCH_MM, SCALE)
    assert len(predicted.particles) == 60
    np.testing.assert_allclose(predicted.particles[:30, :3], seen[:, :3])
    np.testing.assert_allclose(predicted.particles[30:, :3], (trusted + MOVED)[30:, :3], atol=2e-3)
    np.testing.assert_allclose(predicted.particles[:, 3], 1.2 * trusted[:, 3])


def test_particles_are_not_expected_where_neighbours_move_otherwise(rng: np.random.Generator) -> None:
    trusted = scene(rng, 60)
    seen = trusted[:30] + MOVED
    seen[:, :3] += rng.normal(0.0, (0.05, 0.05, 0.05), (30, 3))
    assert len(predicted_by(trusted, seen, SEARCH_MM, SCALE).particles) <= 30
    nothing = np.zeros((0, 4))
    for first, second in ((trusted, nothing), (nothing, seen), (nothing, nothing)):
        assert not len(predicted_by(first, second, SEARCH_MM, SCALE).particles)


def test_the_second_frame_goes_on_from_the_first(
    table2: Camera, water: Media, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    true, new = scene(rng), scene(rng, 2)
    before, task = (
        task_with(table2, water, true - MOVED, rng),
        task_with(table2, water, np.concatenate([true, new]), rng),
    )
    first = np.concatenate([true - MOVED, ghosts(rng)])
    told: list[int] = []
    search = neighbour_frames.find_predicted
    expected: list[Predicted] = []

    def watched(*arguments: object) -> object:
        expected.append(arguments[1])
        return search(*arguments)

    monkeypatch.setattr(neighbour_frames, "find_predicted", watched)
    particles = second_frame(task, before, first, SEARCH_MM, told.append)
    assert found(particles, np.concatenate([true, new])).all()
    assert len(particles) == 32
    assert len(expected) == 1
    assert sum(told) == STEPS
    # Particles of another scene predict nothing: all is as without a first frame.
    told.clear()
    other = second_frame(task, before, scene(rng), SEARCH_MM, told.append)
    np.testing.assert_array_equal(other, first_pass(task).particles)
    assert len(expected) == 1
    assert sum(told) == STEPS


@pytest.mark.parametrize("order", [(0, 1), (1, 0), (1,), (0,)])
def test_the_order_of_a_pairs_frames_does_not_matter(order: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    def first_of(bench: None, frame: int, advance: None) -> str:
        return f"first {frame}"

    def second_of(bench: None, frame: int, before: int, made: str, advance: None) -> str:
        return f"second {frame} after {before}, {made}"

    monkeypatch.setattr(particles_interface, "frame_of", lambda bench, raw, lit: raw)
    monkeypatch.setattr(particles_interface, "find_first", first_of)
    monkeypatch.setattr(particles_interface, "find_second", second_of)
    monkeypatch.setattr(particles_interface, "find_beside", lambda bench, frame, own, beside: (own, beside))
    monkeypatch.setattr(particles_interface, "check_frame", lambda bench, raw, name: None)
    frames = [Frame(Path(f"{number}.tif"), 0, 1) for number in range(4)]

    def finder(beside: list[tuple[int, ...]], first_of: dict[int, int]) -> Finder:
        return Finder(None, lambda number: (number, number), frames, beside, first_of, keep_going=False)

    second = "second 3 after 2, first 2"
    wanted = {0: ("first 2", [second]), 1: (second, ["first 2"])}
    pairs = finder([(1,), (0,), (3,), (2,)], {1: 0, 3: 2})
    for number in order:
        assert pairs.find(2 + number, 2 + number, None) == (wanted[number], [])
    # A sequence's frames stand alone at first.
    assert finder([(1,), (0,)], {}).find(1, 1, None) == (("first 1", ["first 0"]), [])
