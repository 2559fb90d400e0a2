"""The tracers' diameter and the sensor's diffusion by images: what is true comes out, and what contradicts is told."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.camera_light import MODEL_SHARE, MODEL_SQUARES, Forms, forms_of, together_of
from lfpiv_cli.particles.diameter import NO_SIZES, Diameter, Sizes, _settled_sizes, diameter_by, diameter_of
from lfpiv_cli.particles.search import Task
from lfpiv_cli.particles.view import Light, raw_view, with_radius
from lfpiv_cli.verbs.tracers import Diffusion, TracerSize, size_notices
from tests.commands import ROOT
from tests.particle_images import light_on, task_for
from tests.particle_twin import twin_image

LENS_MM = 0.1
DEPTHS_MM = (0.4, 2.1)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def image_of(camera: Camera, media: Media, tracers: Floats, lenses: float, waves: Light | None = None) -> Floats:
    """Return what tracers (n, 4) of a diameter in microlenses show, without noise."""
    image = light_on(raw_view(camera, media, 0.5 * lenses * LENS_MM, light=waves), tracers, DEPTHS_MM)
    return image.reshape(camera.rows, camera.columns)


def tasks_of(
    camera: Camera,
    media: Media,
    images: list[Floats],
    rng: np.random.Generator,
    assumed: float = 0.5,
    photons: float = 0.5,
    **how: Light,
) -> list[Task]:
    """Return the tasks that images set whose tracers are taken to be so many microlenses wide; photons per count."""
    grid = Grid.centred((11, 10, 9), (0.1, 0.1, 0.2), (0.0, 0.0, 1.25))
    noisy = [rng.poisson(photons * image) / photons + rng.normal(0.0, 6.0, image.shape) for image in images]
    return [task_for(image, camera, media, grid, 0.5 * assumed * LENS_MM, **how) for image in noisy]


@pytest.mark.thorough
@pytest.mark.parametrize(("lenses", "assumed"), [(0.1, 2.0), (0.5, 0.1), (2.0, 0.5)])
def test_the_diameter_is_found(
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
def test_the_diameter_is_found_where_light_is_few_photons(
    table2: Camera, water: Media, rng: np.random.Generator
) -> None:
    camera = replace(table2, columns=260, rows=240)
    tracers = rng.uniform((-0.5, -0.45, 0.5, 4e5), (0.5, 0.45, 2.0, 6e5), (14, 4))
    # A twentieth of the photons that are taken to be usual until noise has been seen.
    found = diameter_by(tasks_of(camera, water, [image_of(camera, water, tracers, 0.8)], rng, photons=0.025))
    assert found is not None
    assert found.tracers >= 4
    assert found.lenses == pytest.approx(0.8, abs=2.0 * found.sigma_lenses)


@pytest.mark.thorough
def test_by_waves_diffusion_is_found_too(table2: Camera, water: Media, rng: np.random.Generator) -> None:
    camera = replace(table2, columns=260, rows=240)
    tracers = rng.uniform((-0.5, -0.45, 0.5, 2e5), (0.5, 0.45, 2.0, 6e5), (14, 4))
    image = image_of(camera, water, tracers, 0.6, Light(532e-6, 0.42, DEPTHS_MM))
    found = diameter_by(tasks_of(camera, water, [image], rng, 0.3, light=Light(532e-6, 0.3, DEPTHS_MM)))
    assert found is not None
    assert found.held is not None
    # Of so many tracers, by the model that made them; what a model gets wrong is in the stated errors alone.
    assert found.lenses == pytest.approx(0.6, abs=0.01)
    assert found.held.diffusion_px == pytest.approx(0.42, abs=0.01)
    assert found.held.reported


@pytest.mark.thorough
@pytest.mark.parametrize("number", [60, 400])
def test_crowded_diameters_are_right(table2: Camera, water: Media, rng: np.random.Generator, number: int) -> None:
    # Some .9 and 6 tracers for each microlens.
    camera = replace(table2, columns=260, rows=240)
    tracers = rng.uniform((-0.7, -0.65, 0.5, 3e5), (0.7, 0.65, 2.0, 7e5), (number, 4))
    tasks = iter(tasks_of(camera, water, [image_of(camera, water, tracers, 0.5)] * (3 if number < 100 else 2), rng))
    found = diameter_by(tasks)
    assert (found is None) == (number > 100)
    # The two images of a pair are looked at, and no more; where none stands alone, one.
    assert len(list(tasks)) == 1
    if found is not None:
        assert found.lenses == pytest.approx(0.5, abs=2.0 * found.sigma_lenses)
        assert len(found.frames) == 2


@pytest.mark.thorough
def test_frames_are_taken_until_tracers_suffice(table2: Camera, water: Media, rng: np.random.Generator) -> None:
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


def test_squares_that_scatter_less_than_they_err_are_of_one_thing(rng: np.random.Generator) -> None:
    alike, independent = (diameter_of([Sizes(rng.normal(1.7, s, 36), np.full(36, 0.6))]) for s in (0.08, 0.6))
    assert alike is not None
    assert independent is not None
    assert independent.sigma_lenses == pytest.approx(0.125 / 2.0 / 1.3, rel=0.5)
    # Down to nothing by three of them.
    assert alike.sigma_lenses == pytest.approx(1.3 / 3.0, rel=0.1)
    assert not alike.resolved


@pytest.mark.thorough
def test_a_view_of_other_balls_is_that_made_for_them(table2: Camera, water: Media) -> None:
    for layout in ("square", "hexagonal"):
        camera = replace(table2, columns=120, rows=110, lattice=Lattice.regular(0.1, layout))
        small, large = (raw_view(camera, water, radius) for radius in (0.04, 0.1))
        lit = [twin_image(view, (0.02, -0.03, 1.3))[:, 0] for view in (with_radius(small, 0.1), large)]
        np.testing.assert_allclose(lit[0], lit[1], atol=1e-12)


def of_diffusion(*found: float, **known: bool) -> TracerSize:
    """Return a size that is certain, with this diffusion."""
    return TracerSize(0.05, 0.05, 0.002, True, Diffusion(*found, **known))


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
        (None, of_diffusion(0.2, 0.21, 0.02, given=True, reported=True), []),
        (None, of_diffusion(0.2, 0.31, 0.02, given=True, reported=True), ["diffusion"]),
        (None, of_diffusion(0.31, 0.31, 0.02, reported=True), []),
        (None, of_diffusion(0.31, 0.31, 0.09), ["diffusion-unknown"]),
        (None, of_diffusion(USUAL_DIFFUSION_PX), ["diffusion-unknown"]),
        # What is given is used where the images do not tell.
        (None, of_diffusion(0.2, given=True), []),
    ],
)
def test_notices_of_diameter_and_diffusion(given: float | None, size: TracerSize, codes: list[str]) -> None:
    settings = load_rig(ROOT / "configs" / "table2.yaml").overridden("reconstruction", particle_diameter_mm=given)
    assert [notice.code for notice in size_notices(settings, size)] == codes


@pytest.mark.parametrize(("count", "enough"), [(40, True), (20, True), (19, False), (10, False), (0, False)])
def test_a_size_is_that_of_half_the_tracers(monkeypatch: pytest.MonkeyPatch, count: int, enough: bool) -> None:
    losses = np.square(np.arange(-2.0, 3.0))[:, np.newaxis] * np.ones(40)
    trial = SimpleNamespace(diameter=0.5, losses=losses, alone=np.arange(40) < count)
    found = SimpleNamespace(view=None), None
    for name, answer in (("_found", found), ("_tried", trial), ("by_waves", False)):
        monkeypatch.setattr(f"lfpiv_cli.particles.diameter.{name}", lambda *_, answer=answer: answer)
    # Six for each microlens, of which ten of forty seemed to stand alone, showed 0.72 microlenses in place of 0.5.
    assert (_settled_sizes(None, 0.5, ()).square.size == count > 0) == enough  # type: ignore[arg-type]


def test_images_that_contradict_each_other_are_told() -> None:
    settings = load_rig(ROOT / "configs" / "table2.yaml")
    frames = [TracerSize(0.05, mm, 0.002, True, Diffusion(0.3, px, 0.02)) for mm, px in ((0.05, 0.3), (0.058, 0.5))]
    for alike in (frames[:1], [frames[0]] * 2):
        size = TracerSize(0.05, 0.05, 0.002, True, frames=tuple(alike))
        assert size_notices(settings, size) == []
    (reported,) = size_notices(settings, TracerSize(0.05, 0.05, 0.002, True, frames=tuple(frames)))
    assert (reported.code, reported.about) == ("images-differ", "reconstruction.diffusion_px")
    assert "0.3 ± 0.02 px by one image and 0.5 ± 0.02 px by another" in reported.text
    apart = (frames[0], replace(frames[1], measured_mm=0.07))
    both = size_notices(settings, TracerSize(0.05, 0.05, 0.002, True, frames=apart))
    assert [each.about for each in both] == ["reconstruction.particle_diameter_mm", "reconstruction.diffusion_px"]


def test_files_state_errors_of_diameters_and_limits_in_units_of_the_scene() -> None:
    assert TracerSize(0.05, 0.051, 0.002, True).attributes() == {"particle_diameter_mm": 0.05}
    by_images = {"particle_diameter_mm": 0.051, "particle_diameter_sigma_mm": 0.002}
    assert TracerSize(0.051, 0.051, 0.002, True).attributes() == by_images
    assert TracerSize(0.05, 0.051, 0.002).summary()["particle_diameter_measured_mm"] == 0.051
    assert TracerSize(0.01, 0.01, 0.02).at_most_mm == pytest.approx(0.07)
    assert TracerSize(0.05).at_most_mm is None
    assert Diameter(0.5, 0.1, 3).resolved


SIZE, BLUR_PX = 0.5, 0.25
SQUARES = np.square([SIZE, BLUR_PX])


def forms(count: int, rng: np.random.Generator, sure: float = 1.0) -> Forms:
    """Return what tracers that scatter as they state say of the squares, each of one mixture of both or another."""
    turn = rng.uniform(0.2, 1.2, count)
    ways = np.stack([np.cos(turn), np.sin(turn)], axis=-1) / 0.01 * sure
    matrix = np.einsum("ni,nj->nij", ways, ways) + 25.0 * sure**2 * np.eye(2)
    noise = np.linalg.cholesky(matrix) @ rng.normal(size=(count, 2, 1))
    return Forms(matrix, matrix @ SQUARES + noise[..., 0])


def test_both_are_found_and_their_errors_are_those_of_the_scatter(rng: np.random.Generator) -> None:
    away = []
    # What the model gets wrong is in the covariance and not in these forms.
    model = np.square([np.hypot(2.0 * MODEL_SHARE * SQUARES[0], MODEL_SQUARES[0]), MODEL_SQUARES[1]])
    for _ in range(200):
        found = together_of([forms(15, rng), forms(15, rng)])
        noise = found.covariance - np.diag(model)
        miss = np.square([found.lenses, found.diffusion_px]) - SQUARES
        away.append(miss @ np.linalg.solve(noise, miss))
    # Chi-squared of two, its mean of 200 known to 7 %; the scatter of 30 and their weights make errors larger.
    assert np.mean(away) == pytest.approx(2.0, abs=0.5)


def test_tracers_that_contradict_the_others_hardly_matter() -> None:
    right = forms(30, np.random.default_rng(20260101))
    wrong = Forms(right.matrix[:3], right.matrix[:3] @ (SQUARES + (0.5, 0.0)))
    alone, both = together_of([right]), together_of([right, wrong])
    assert abs(both.lenses - alone.lenses) < 0.01
    # All alike they move it by .03 and more.
    pooled = Forms(*(np.concatenate(parts) for parts in ((right.matrix, wrong.matrix), (right.right, wrong.right))))
    square = np.linalg.solve(pooled.matrix.sum(axis=0), pooled.right.sum(axis=0))
    assert np.sqrt(square[0]) - alone.lenses > 0.03


def test_what_is_given_is_held_and_the_other_found_with_it_and_its_error(rng: np.random.Generator) -> None:
    shown = [forms(40, rng)]
    by_size = together_of(shown, lenses=SIZE)
    assert by_size.lenses == pytest.approx(SIZE, abs=1e-6)
    assert by_size.diffusion_px == pytest.approx(BLUR_PX, abs=0.01)
    wrong = together_of(shown, diffusion_px=0.4)
    assert wrong.diffusion_px == pytest.approx(0.4, abs=1e-6)
    # More blur than there is asks for smaller tracers.
    assert wrong.lenses < SIZE - 0.02
    assert wrong.covariance[1, 1] < 1e-9
    # What the model gets wrong of the size is in the diffusion's error where the size is given.
    matrix = np.tile(np.array([[1e4, 9e3], [9e3, 1e4]]), (20, 1, 1))
    shown = Forms(matrix, matrix @ (SQUARES + (MODEL_SQUARES[0], 0.0)))
    found = together_of([shown], lenses=SIZE)
    away = 0.9 * np.hypot(2.0 * MODEL_SHARE * SIZE**2, MODEL_SQUARES[0])
    assert found.diffusion_px**2 - BLUR_PX**2 == pytest.approx(0.9 * MODEL_SQUARES[0], rel=0.05)
    assert found.covariance[1, 1] == pytest.approx(away**2 + MODEL_SQUARES[1] ** 2, rel=0.1)
    assert found.covariance[0, 0] < 1e-9


def test_crowded_tracers_tell_diffusion_less_surely_and_others_what_is_usual(rng: np.random.Generator) -> None:
    shown = forms(40, rng)
    alone, few, many = (together_of([shown._replace(crowd=crowd)]) for crowd in (0.0, 0.5, 1.7))
    assert few.sigma_px == alone.sigma_px
    assert many.diffusion_px == alone.diffusion_px
    # At 2 for each microlens, of which 1.7 are found, diffusion of 0.3 px seemed 0.19.
    assert many.sigma_px > 0.03
    # The most crowded of some images counts.
    both = together_of([shown, shown._replace(crowd=1.7)])
    assert both.sigma_px == pytest.approx(many.sigma_px, rel=0.05)
    # What images do not tell is taken as usual.
    reported, untold = together_of([forms(20, rng)]), together_of([forms(20, rng, sure=1e-3)])
    assert reported.reported
    assert not untold.reported
    assert untold.diffusion_px == pytest.approx(USUAL_DIFFUSION_PX, abs=0.05)
    # Sizes of points are not below 0, and diffusion is then that of points.
    point = Forms(np.tile(1e4 * np.eye(2), (5, 1, 1)), np.tile(1e4 * np.array([-0.01, 0.04]), (5, 1)))
    found = together_of([point])
    assert found.lenses == 0.0
    assert found.diffusion_px == pytest.approx(0.2, abs=0.01)


def test_files_state_diffusion_and_its_error_where_it_is_not_given() -> None:
    assert Diffusion(0.2, 0.31, 0.02, given=True, reported=True).attributes() == {"diffusion_px": 0.2}
    by_images = Diffusion(0.31, 0.31, 0.02, reported=True)
    assert by_images.attributes() == {"diffusion_px": 0.31, "diffusion_sigma_px": 0.02}
    assert Diffusion(USUAL_DIFFUSION_PX).attributes()["diffusion_sigma_px"] == 0.1
    size = TracerSize(0.05, 0.051, 0.002, True, by_images)
    assert size.attributes() == {"particle_diameter_mm": 0.05, **by_images.attributes()}
    assert size.summary()["diffusion_measured_px"] == 0.31
    # Forms are those of the losses.
    grid = np.array([(a, b) for a in (0.2, 0.25, 0.3) for b in (0.05, 0.09, 0.13)])
    matrix, best = np.array([[300.0, 120.0], [120.0, 500.0]]), np.array([0.27, 0.06])
    losses = np.einsum("mi,ij,mj->m", grid - best, matrix, grid - best)[:, np.newaxis] + 7.0
    found = forms_of(grid, losses)
    np.testing.assert_allclose(found.matrix[0], matrix, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.solve(found.matrix[0], found.right[0]), best, rtol=1e-6)
