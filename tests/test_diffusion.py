"""Size and charge diffusion together: what single tracers show is added up, and what they do not tell is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.files.config import load_config
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.particles.diffusion import MODEL_SHARE, MODEL_SQUARES, Forms, forms_of, together_of
from lfpiv_cli.verbs.tracers import Diffusion, TracerSize, size_notices

ROOT = Path(__file__).parent.parent
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


def test_tracers_that_contradict_the_others_hardly_matter(rng: np.random.Generator) -> None:
    right = forms(30, rng)
    wrong = Forms(right.matrix[:3], right.matrix[:3] @ (SQUARES + (0.5, 0.0)))
    alone, both = together_of([right]), together_of([right, wrong])
    assert abs(both.lenses - alone.lenses) < 0.01
    # All alike they move it by .03 and more.
    pooled = Forms(*(np.concatenate(parts) for parts in ((right.matrix, wrong.matrix), (right.right, wrong.right))))
    square = np.linalg.solve(pooled.matrix.sum(axis=0), pooled.right.sum(axis=0))
    assert np.sqrt(square[0]) - alone.lenses > 0.03


def test_what_is_given_is_held_and_the_other_found_with_it(rng: np.random.Generator) -> None:
    shown = [forms(40, rng)]
    by_size = together_of(shown, lenses=SIZE)
    assert by_size.lenses == pytest.approx(SIZE, abs=1e-6)
    assert by_size.diffusion_px == pytest.approx(BLUR_PX, abs=0.01)
    wrong = together_of(shown, diffusion_px=0.4)
    assert wrong.diffusion_px == pytest.approx(0.4, abs=1e-6)
    # More blur than there is asks for smaller tracers.
    assert wrong.lenses < SIZE - 0.02
    assert wrong.covariance[1, 1] < 1e-9


def test_what_the_model_gets_wrong_of_the_size_is_in_the_diffusion_s_error_where_the_size_is_given() -> None:
    matrix = np.tile(np.array([[1e4, 9e3], [9e3, 1e4]]), (20, 1, 1))
    shown = Forms(matrix, matrix @ (SQUARES + (MODEL_SQUARES[0], 0.0)))
    found = together_of([shown], lenses=SIZE)
    away = 0.9 * np.hypot(2.0 * MODEL_SHARE * SIZE**2, MODEL_SQUARES[0])
    assert found.diffusion_px**2 - BLUR_PX**2 == pytest.approx(0.9 * MODEL_SQUARES[0], rel=0.05)
    assert found.covariance[1, 1] == pytest.approx(away**2 + MODEL_SQUARES[1] ** 2, rel=0.1)
    assert found.covariance[0, 0] < 1e-9


def test_crowded_tracers_tell_diffusion_less_surely(rng: np.random.Generator) -> None:
    shown = forms(40, rng)
    alone, few, many = (together_of([shown._replace(crowd=crowd)]) for crowd in (0.0, 0.5, 1.7))
    assert few.sigma_px == alone.sigma_px
    assert many.diffusion_px == alone.diffusion_px
    # At 2 for each microlens, of which 1.7 are found, diffusion of 0.3 px seemed 0.19.
    assert many.sigma_px > 0.03
    # The most crowded of some images counts.
    both = together_of([shown, shown._replace(crowd=1.7)])
    assert both.sigma_px == pytest.approx(many.sigma_px, rel=0.05)


def test_what_images_do_not_tell_is_taken_as_usual(rng: np.random.Generator) -> None:
    told, untold = together_of([forms(20, rng)]), together_of([forms(20, rng, sure=1e-3)])
    assert told.told
    assert not untold.told
    assert untold.diffusion_px == pytest.approx(USUAL_DIFFUSION_PX, abs=0.05)
    # Sizes of points are not below 0, and diffusion is then that of points.
    point = Forms(np.tile(1e4 * np.eye(2), (5, 1, 1)), np.tile(1e4 * np.array([-0.01, 0.04]), (5, 1)))
    found = together_of([point])
    assert found.lenses == 0.0
    assert found.diffusion_px == pytest.approx(0.2, abs=0.01)


def test_forms_are_those_of_the_losses() -> None:
    grid = np.array([(a, b) for a in (0.2, 0.25, 0.3) for b in (0.05, 0.09, 0.13)])
    matrix, best = np.array([[300.0, 120.0], [120.0, 500.0]]), np.array([0.27, 0.06])
    losses = np.einsum("mi,ij,mj->m", grid - best, matrix, grid - best)[:, np.newaxis] + 7.0
    found = forms_of(grid, losses)
    np.testing.assert_allclose(found.matrix[0], matrix, rtol=1e-6)
    np.testing.assert_allclose(np.linalg.solve(found.matrix[0], found.right[0]), best, rtol=1e-6)


def test_files_state_diffusion_and_its_error_where_it_is_not_given() -> None:
    assert Diffusion(0.2, 0.31, 0.02, given=True, told=True).attributes() == {"diffusion_px": 0.2}
    by_images = Diffusion(0.31, 0.31, 0.02, told=True)
    assert by_images.attributes() == {"diffusion_px": 0.31, "diffusion_sigma_px": 0.02}
    assert Diffusion(USUAL_DIFFUSION_PX).attributes()["diffusion_sigma_px"] == 0.1
    size = TracerSize(0.05, 0.051, 0.002, True, by_images)
    assert size.attributes() == {"particle_diameter_mm": 0.05, **by_images.attributes()}
    assert size.summary()["diffusion_measured_px"] == 0.31


@pytest.mark.parametrize(
    ("diffusion", "codes"),
    [
        (Diffusion(0.2, 0.21, 0.02, given=True, told=True), []),
        (Diffusion(0.2, 0.31, 0.02, given=True, told=True), ["diffusion"]),
        (Diffusion(0.31, 0.31, 0.02, told=True), []),
        (Diffusion(0.31, 0.31, 0.09), ["diffusion-unknown"]),
        (Diffusion(USUAL_DIFFUSION_PX), ["diffusion-unknown"]),
        # What is given is used where the images do not tell.
        (Diffusion(0.2, given=True), []),
    ],
)
def test_notices_of_diffusion(diffusion: Diffusion, codes: list[str]) -> None:
    settings = load_config(ROOT / "configs" / "table2.yaml")
    size = TracerSize(0.05, 0.05, 0.002, True, diffusion)
    assert [notice.code for notice in size_notices(settings, size)] == codes
