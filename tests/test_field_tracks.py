"""Tracks that are drawn without images: errors as stated, false partners, and the truth at any point."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.field_tracks import BLIND_MM, LENS_MM, stated_covariance, tracks_of, true_displacement_mm
from lfpiv_cli.synthetic.flows import rigid_rotation, taylor_green

FLOW = taylor_green(0.1, 12.0)


def off_truth(tracks):
    return tracks.displacement_mm - true_displacement_mm(FLOW, tracks.middle_mm, tracks.dt_s)


def exact_and_drawn(count, scale=1.0):
    return (tracks_of(FLOW, count, np.random.default_rng(3), sigma_scale=each) for each in (1e-9, scale))


def test_errors_are_those_that_are_stated():
    exact, drawn = exact_and_drawn(3000)
    root = np.linalg.cholesky(drawn.covariance_mm2)
    for name, share in (("displacement_mm", 1.0), ("middle_mm", 0.5)):
        off = (getattr(drawn, name) - getattr(exact, name))[..., np.newaxis]
        whitened = np.linalg.solve(share * root, off)[..., 0]
        # of 3000 draws a variance is known to 0.026 and a correlation to 0.018
        np.testing.assert_allclose(np.cov(whitened.T), np.eye(3), atol=0.09)


def test_displacements_without_errors_are_the_truth():
    exact, _ = exact_and_drawn(200)
    assert np.abs(off_truth(exact)).max() < 1e-7
    assert np.sqrt(np.mean(np.sum(exact.displacement_mm**2, axis=1))) == pytest.approx(0.4, rel=0.02)


def test_scaled_errors_scale_as_stated():
    (none, half), (_, whole) = exact_and_drawn(50, 0.5), exact_and_drawn(50)
    assert half.covariance_mm2 == pytest.approx(0.25 * whole.covariance_mm2)
    np.testing.assert_allclose(
        half.middle_mm - none.middle_mm, 0.5 * (whole.middle_mm - none.middle_mm), rtol=1e-6, atol=1e-10
    )


def test_stated_errors_point_to_the_lens_and_are_largest_near_the_focal_plane(rng):
    points = np.array([(6.0, -4.0, 4.0), (0.0, 0.0, 1.0), (0.0, 0.0, 4.0), (0.0, 0.0, 0.5 * BLIND_MM)])
    covariance = np.mean([stated_covariance(points, 5.0, rng) for _ in range(200)], axis=0)
    ray = (points[0] - LENS_MM) / np.linalg.norm(points[0] - LENS_MM)
    assert np.abs(np.linalg.eigh(covariance[0])[1][:, 2] @ ray) == pytest.approx(1.0)
    # an error of 0.01 mm in depth is one of 6/204 of it along x
    assert covariance[0, 0, 2] / covariance[0, 2, 2] == pytest.approx(6.0 / 204.0, rel=0.01)
    near, far, blind = np.sqrt(covariance[1:, 2, 2])
    assert 0.005 < near < far < 0.02 < 1.5 * blind
    assert blind > 2.0 * near
    assert np.all((np.sqrt(covariance[:, 1, 1]) > 0.0003) & (np.sqrt(covariance[:, 1, 1]) < 0.001))


def test_wrong_links_lead_to_neighbours(rng):
    tracks = tracks_of(FLOW, 1000, rng, wrong_share=0.1)
    off = np.linalg.norm(off_truth(tracks), axis=1)
    assert tracks.wrong.sum() == 100
    # 1000 in 1300 mm^3 are 0.6 mm apart
    assert 0.3 < np.median(off[tracks.wrong]) < 2.0
    assert np.median(off[~tracks.wrong]) < 0.02
    assert not tracks_of(FLOW, 20, rng).wrong.any()


def test_true_displacement_is_the_chord_of_a_circle(rng):
    # turned by half an angle each way about z; the chord's middle is nearer to the centre by its cosine
    points, angle = rng.uniform(-5.0, 5.0, (20, 3)), 0.3
    found = true_displacement_mm(rigid_rotation((0.0, 0.0, angle / 1e-3)), points, 1e-3)
    expected = 2.0 * np.tan(0.5 * angle) * np.cross((0.0, 0.0, 1.0), points)
    # four steps of 0.04 rad each: 1e-8 of the distance
    assert found == pytest.approx(expected, abs=1e-6)
