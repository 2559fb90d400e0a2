"""Tracers counted for each microlens by how uneven their light is, against images of known number."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lfpiv_cli as lf
from lfpiv_cli.calibration.white import vignetting_surface
from lfpiv_cli.files.config import carried_config
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.verbs.frames import Bench, bench_of, frame_notices
from lfpiv_cli.verbs.particles import find, frame_of, points_of, task_for, tracers_per_lens
from lfpiv_cli.verbs.tracers import TracerSize, light_notices

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"
CHANGES = (
    ("columns: 600, rows: 448", "columns: 420, rows: 380"),
    ("shape_xyz: [30, 22, 40]", "shape_xyz: [16, 14, 10]"),
    ("centre_mm: [0, 0, 0], reference: mid_plane", "centre_mm: [0, 0, 1.9], reference: focal_point"),
)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """What images of a small rig share: 20 x 23 microlenses on the sensor, 10 planes of 0.1 mm."""
    rig, text = tmp_path_factory.mktemp("rig") / "rig.yaml", SAMPLE.read_text()
    for old, new in CHANGES:
        assert old in text, old
        text = text.replace(old, new)
    rig.write_text(text)
    content: WeightsFile = lf.build_weights(lf.load_rig(rig))
    return bench_of(content, carried_config(content.provenance, "weights"), None, None)


def image_of(bench: Bench, number: float, seed: int) -> np.ndarray:
    """Return an image of so many tracers for each microlens, also around the volume."""
    content, rng = bench.content, np.random.default_rng(seed)
    low, high = np.array([-1.2, -1.1, 1.4]), np.array([1.2, 1.1, 2.4])
    count = rng.poisson(number * 2.4 * 2.2 / 0.1**2)
    view = raw_view(content.camera, bench.settings.media_model(), 0.025)
    places = content.camera.to_image_axes(rng.uniform(low, high, (count, 3)))
    image = rng.normal(100.0, 6.0, content.camera.rows * content.camera.columns)
    particles = np.column_stack([places, rng.uniform(3e5, 7e5, count)])
    add_all(view, particles, 1.0, image, content.weights.grid.bounds_mm(2))
    return image.reshape(content.image_shape).astype(np.float32)


def test_tracers_are_fitted_behind_the_vignetting_of_the_white_image(bench: Bench) -> None:
    vignetting = np.zeros((5, 5))
    vignetting[0, 0], vignetting[0, 2], vignetting[2, 0] = 1.0, -0.2, -0.3
    image, content = image_of(bench, 0.1, 0), replace(bench.content, vignetting=vignetting)
    frame = frame_of(bench, image, image)
    view, plain = (task_for(replace(bench, content=each), frame).view for each in (content, bench.content))
    particles, lit = np.array([[0.6, -0.5, 1.8, 1e5]]), np.zeros((2, image.size))
    for each, light in zip((view, plain), lit, strict=True):
        add_all(each, particles, 1.0, light, (1.4, 2.4))
    surface = vignetting_surface(vignetting, content.image_shape).ravel()
    np.testing.assert_allclose(lit[0], surface * lit[1], atol=1e-6 * lit[1].max())
    assert surface[lit[1] > 0.0].max() < 0.95


@pytest.mark.thorough
@pytest.mark.parametrize("number", [0.3, 3.0])
def test_few_and_crowded_tracers_are_counted(bench: Bench, number: float) -> None:
    counts = [tracers_per_lens(bench, frame_of(bench, *[image_of(bench, number, seed)] * 2)) for seed in range(3)]
    # Some 200 microlenses, some five of which share a tracer's light, tell the variance of one image to a fifth.
    assert np.mean(counts) == pytest.approx(number, rel=0.2)


@pytest.mark.thorough
def test_light_that_does_not_tell_is_not_counted(bench: Bench) -> None:
    image = image_of(bench, 0.5, 0)
    masked = np.full_like(image, np.nan)
    masked[:100, :100] = image[:100, :100]
    assert tracers_per_lens(bench, frame_of(bench, masked, np.nan_to_num(masked))) is None
    assert tracers_per_lens(bench, frame_of(bench, *[np.zeros_like(image)] * 2)) is None


@pytest.mark.thorough
def test_tracers_that_cannot_be_told_apart_are_counted(bench: Bench) -> None:
    image = image_of(bench, 12.0, 0) - np.float32(100.0)
    frame = frame_of(bench, image, image)
    points = points_of(bench, frame, find(bench, frame), TracerSize(0.05), {})
    # What they light is nearly explained, by particles that are not there.
    model, crowded = light_notices(points, "crowded")
    assert (model.code, crowded.code) == ("light-model", "particles-crowded")
    # Two standard errors of what one image of so few microlenses tells.
    assert crowded.measured == pytest.approx(12.0, rel=0.4)


def test_crowded_tracers_are_not_taken_for_noise(bench: Bench) -> None:
    # No pixel is as dark as without light, and most lie far from the median.
    crowd = image_of(bench, 12.0, 0)
    noise = np.random.default_rng(0).normal(0.0, 6.0, crowd.shape).astype(np.float32)
    for image, told in ((crowd, False), (noise, True), (noise + np.float32(100.0), True)):
        assert ("frame-dark" in {each.code for each in frame_notices(bench, image, image, "a")}) == told
