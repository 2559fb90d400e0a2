"""The tracers' diameter by their images: true sizes come out whatever was assumed, and contradictions are told."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.files.config import load_config
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.diameter import NO_SIZES, Diameter, Sizes, Trial, _settled_sizes, diameter_by, diameter_of
from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.search import Task, task_of
from lfpiv_cli.particles.view import Light, entry_capacity, raw_view, with_radius
from lfpiv_cli.reconstruction.solvers import normalisers
from lfpiv_cli.verbs.tracers import Diffusion, TracerSize, size_notices
from lfpiv_cli.weights.build import default_padding, factorise
from lfpiv_cli.weights.model import Weights
from tests.particle_twin import entries_of

ROOT = Path(__file__).parent.parent
LENS_MM = 0.1
DEPTHS_MM = (0.4, 2.1)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def image_of(
    camera: Camera, media: Media, tracers: NDArray[np.float64], lenses: float, waves: Light | None = None
) -> NDArray[np.float64]:
    """Return what tracers (n, 4) of a diameter in microlenses show, without noise."""
    image = np.zeros(camera.rows * camera.columns)
    add_all(raw_view(camera, media, 0.5 * lenses * LENS_MM, light=waves), tracers, 1.0, image, DEPTHS_MM)
    return image.reshape(camera.rows, camera.columns)


def tasks_of(
    camera: Camera,
    media: Media,
    images: list[NDArray[np.float64]],
    rng: np.random.Generator,
    assumed: float = 0.5,
    waves: Light | None = None,
) -> list[Task]:
    """Return the tasks that images set whose tracers are taken to be so many microlenses wide."""
    grid = Grid.centred((11, 10, 9), (0.1, 0.1, 0.2), (0.0, 0.0, 1.25))
    padding = default_padding(camera, media, grid)
    operator = factorise(camera, media, grid.padded(padding))
    weights = Weights(grid, padding, operator, camera.column_axis)
    view, sums = raw_view(camera, media, 0.5 * assumed * LENS_MM, light=waves), normalisers(weights.padded)
    noisy = [rng.poisson(0.5 * image) / 0.5 + rng.normal(0.0, 6.0, image.shape) for image in images]
    return [task_of(image.astype(np.float32), view, weights, camera, sums) for image in noisy]


@pytest.mark.thorough
@pytest.mark.parametrize(("lenses", "assumed"), [(0.1, 2.0), (0.5, 0.1), (2.0, 0.5)])
def test_the_diameter_is_found_whatever_was_assumed(
    table2: Camera, water: Media, rng: np.random.Generator, lenses: float, assumed: float
) -> None:
    camera = replace(table2, columns=260, rows=240)
    tracers = rng.uniform((-0.5, -0.45, 0.5, 0.0), (0.5, 0.45, 2.0, 0.0), (14, 4))
    tracers[:, 3] = 4e5 * rng.lognormal(0.0, 0.5, 14)
    # One of another size must not matter.
    image = image_of(camera, water, tracers[1:], lenses) + image_of(camera, water, tracers[:1], 3.0 * lenses)
    found = diameter_by(tasks_of(camera, water, [image], rng, assumed))
    assert found is not None
    assert found.tracers >= 4
    assert found.resolved
    assert found.lenses == pytest.approx(lenses, abs=3.0 * found.sigma_lenses)
    assert found.lenses == pytest.approx(lenses, rel=0.02, abs=0.01)


@pytest.mark.thorough
def test_by_waves_diffusion_is_found_along_with_the_diameter(
    table2: Camera, water: Media, rng: np.random.Generator
) -> None:
    camera = replace(table2, columns=260, rows=240)
    tracers = rng.uniform((-0.5, -0.45, 0.5, 2e5), (0.5, 0.45, 2.0, 6e5), (14, 4))
    image = image_of(camera, water, tracers, 0.6, Light(532e-6, 0.42, DEPTHS_MM))
    found = diameter_by(tasks_of(camera, water, [image], rng, 0.3, Light(532e-6, 0.3, DEPTHS_MM)))
    assert found is not None
    assert found.held is not None
    # Of so many tracers, by the model that made them; what a model gets wrong is in the stated errors alone.
    assert found.lenses == pytest.approx(0.6, abs=0.01)
    assert found.held.diffusion_px == pytest.approx(0.42, abs=0.01)
    assert found.held.told


@pytest.mark.thorough
@pytest.mark.parametrize("number", [60, 400])
def test_the_diameter_of_crowded_tracers_is_right_or_none(
    table2: Camera, water: Media, rng: np.random.Generator, number: int
) -> None:
    # Some .9 and 6 tracers for each microlens.
    camera = replace(table2, columns=260, rows=240)
    tracers = rng.uniform((-0.7, -0.65, 0.5, 3e5), (0.7, 0.65, 2.0, 7e5), (number, 4))
    found = diameter_by(tasks_of(camera, water, [image_of(camera, water, tracers, 0.5)], rng))
    assert (found is None) == (number > 100)
    if found is not None:
        assert found.lenses == pytest.approx(0.5, abs=2.0 * found.sigma_lenses)


@pytest.mark.thorough
def test_frames_are_taken_until_they_hold_enough_tracers(
    table2: Camera, water: Media, rng: np.random.Generator
) -> None:
    camera = replace(table2, columns=260, rows=240)
    dark = np.zeros((camera.rows, camera.columns))
    assert diameter_by(tasks_of(camera, water, [dark], rng)) is None
    places = rng.uniform((-0.3, -0.3, 0.5, 4e5), (0.3, 0.3, 2.0, 6e5), (2, 4))
    images = [dark, *(image_of(camera, water, place[np.newaxis], 0.8) for place in places)]
    found = diameter_by(tasks_of(camera, water, images, rng))
    assert found is not None
    assert found.tracers == 2
    assert found.lenses == pytest.approx(0.8, abs=0.03)


def test_sizes_of_frames_are_pooled_and_a_point_has_a_limit() -> None:
    assert diameter_of([NO_SIZES]) is None
    square, sigma = np.array([0.25, 0.26, 0.24, 0.25, 4.0]), np.full(5, 0.01)
    found = diameter_of([Sizes(square[:2], sigma[:2]), NO_SIZES, Sizes(square[2:], sigma[2:])])
    assert found is not None
    assert found.tracers == 5
    assert found.resolved
    assert found.lenses == pytest.approx(0.5, abs=0.01)
    point = diameter_of([Sizes(np.array([-0.01, 0.0, 0.01]), np.full(3, 0.02))])
    assert point is not None
    assert not point.resolved
    # Three tracers know a square to 0.012.
    assert 0.1 < point.lenses + 3.0 * point.sigma_lenses < 0.25


@pytest.mark.thorough
def test_a_view_of_other_balls_is_that_made_for_them(table2: Camera, water: Media) -> None:
    for layout in ("square", "hexagonal"):
        camera = replace(table2, columns=120, rows=110, lattice=Lattice.regular(0.1, layout))
        tracer = np.array([[0.02, -0.03, 1.3, 1.0]])
        small, large = (raw_view(camera, water, radius) for radius in (0.04, 0.1))
        lit = []
        for view in (with_radius(small, 0.1), large):
            image = np.zeros(camera.rows * camera.columns)
            _, pixels, values = entries_of(view, tracer, entry_capacity(view, *DEPTHS_MM))
            np.add.at(image, pixels, values[:, 0])
            lit.append(image)
        np.testing.assert_allclose(lit[0], lit[1], atol=1e-12)


@pytest.mark.parametrize(
    ("given", "size", "codes"),
    [
        (0.05, TracerSize(0.05, 0.051, 0.002, True), []),
        (0.05, TracerSize(0.05, 0.1, 0.003, True), ["particle-diameter"]),
        (0.05, TracerSize(0.05, 0.001, 0.004), ["particle-diameter"]),
        (0.01, TracerSize(0.01, 0.001, 0.004), []),
        (None, TracerSize(0.1, 0.1, 0.003, True), []),
        (None, TracerSize(0.001, 0.001, 0.004), ["particle-diameter-limit"]),
        (None, TracerSize(0.05), ["particle-diameter-unknown"]),
        (0.05, TracerSize(0.05), []),
    ],
)
def test_notices_of_the_diameter(given: float | None, size: TracerSize, codes: list[str]) -> None:
    settings = load_config(ROOT / "configs" / "table2.yaml").overridden("reconstruction", particle_diameter_mm=given)
    assert [notice.code for notice in size_notices(settings, size)] == codes


def test_a_size_that_grows_beyond_all_tracers_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    searched = []

    def grown(task: None, found: None, diameters: NDArray[np.float64], unexplained: float) -> Trial:
        return Trial(1.2 * float(diameters.max()), np.zeros((5, 12)), np.ones(12, np.bool_))

    monkeypatch.setattr("lfpiv_cli.particles.diameter._found", lambda _, size, __: (None, searched.append(size)))
    monkeypatch.setattr("lfpiv_cli.particles.diameter._tried", grown)
    assert _settled_sizes(None, 3.8, ()) is NO_SIZES  # type: ignore[arg-type]
    assert searched == [3.8]
    # Where a size is found with which no tracer holds, none stands alone.
    monkeypatch.setattr(
        "lfpiv_cli.particles.diameter._tried", lambda *_: Trial(0.5, np.zeros((5, 0)), np.zeros(0, np.bool_))
    )
    assert _settled_sizes(None, 0.5, ()) is NO_SIZES  # type: ignore[arg-type]


def test_images_that_contradict_each_other_are_told() -> None:
    settings = load_config(ROOT / "configs" / "table2.yaml")
    frames = [TracerSize(0.05, mm, 0.002, True, Diffusion(0.3, px, 0.02)) for mm, px in ((0.05, 0.3), (0.058, 0.5))]
    for alike in (frames[:1], [frames[0]] * 2):
        size = TracerSize(0.05, 0.05, 0.002, True, frames=tuple(alike))
        assert size_notices(settings, size) == []
    (told,) = size_notices(settings, TracerSize(0.05, 0.05, 0.002, True, frames=tuple(frames)))
    assert (told.code, told.about) == ("images-differ", "reconstruction.diffusion_px")
    assert "0.3 ± 0.02 px by one image and 0.5 ± 0.02 px by another" in told.text
    apart = (frames[0], replace(frames[1], measured_mm=0.07))
    both = size_notices(settings, TracerSize(0.05, 0.05, 0.002, True, frames=apart))
    assert [each.about for each in both] == ["reconstruction.particle_diameter_mm", "reconstruction.diffusion_px"]


def test_the_two_images_of_a_pair_are_looked_at(monkeypatch: pytest.MonkeyPatch) -> None:
    """The second search begins with what the first one showed."""
    squares, begun = iter([0.25, 0.36, 0.49]), []
    enough = np.full(10, 0.01)

    def measured(_: object, diameter: float | None) -> Sizes:
        begun.append(diameter)
        return Sizes(next(squares) + 0 * enough, enough)

    monkeypatch.setattr("lfpiv_cli.particles.diameter.measured_sizes", measured)
    found = diameter_by([None, None, None])  # type: ignore[list-item]
    assert found is not None
    assert [each.lenses for each in found.frames] == pytest.approx([0.5, 0.6])
    assert found.tracers == 20
    assert begun == [None, pytest.approx(0.5)]


def test_files_state_an_error_where_the_diameter_is_by_the_images() -> None:
    assert TracerSize(0.05, 0.051, 0.002, True).attributes() == {"particle_diameter_mm": 0.05}
    by_images = {"particle_diameter_mm": 0.051, "particle_diameter_sigma_mm": 0.002}
    assert TracerSize(0.051, 0.051, 0.002, True).attributes() == by_images
    assert TracerSize(0.05, 0.051, 0.002).summary()["particle_diameter_measured_mm"] == 0.051


def test_a_limit_is_told_in_units_of_the_scene() -> None:
    assert TracerSize(0.01, 0.01, 0.02).at_most_mm == pytest.approx(0.07)
    assert TracerSize(0.05).at_most_mm is None
    assert Diameter(0.5, 0.1, 3).resolved
