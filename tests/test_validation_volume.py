"""Figures of volumes whose particles are known."""

from __future__ import annotations

import json
from pathlib import Path

import click
import numpy as np
import pytest

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.particles import Particles, write_particles
from lfpiv_cli.files.vtkhdf import write_volume
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import Reference
from lfpiv_cli.validation.volume import (
    known_volume,
    near_a_particle,
    normalised_correlation,
    shared_among_voxels,
    volume_figures,
)

CONFIG = Path(__file__).parent.parent / "configs" / "sample.yaml"
GRID = Grid.centred((30, 24, 40), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
SIGMA = np.array([0.1, 0.1, 0.1])


@pytest.fixture
def particles(rng) -> np.ndarray:
    """Ten particles 0.4 mm apart in depth, none of them half way between two voxels."""
    x, y = rng.uniform(-1.0, 1.0, (2, 10))
    return np.stack([x, y, np.linspace(-1.77, 1.83, 10)], axis=1)


def test_a_gaussian_particle_has_its_centre_width_and_height():
    volume = known_volume(GRID, np.array([[0.23, -0.11, 0.4]]), np.array([3.0]), np.array([0.1, 0.15, 0.2]))
    z, y, x = np.meshgrid(*(GRID.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    exponent = ((x - 0.23) / 0.1) ** 2 + ((y + 0.11) / 0.15) ** 2 + ((z - 0.4) / 0.2) ** 2
    # cut at 4.3 standard deviations along each axis, where 1e-4 is left
    np.testing.assert_allclose(volume, 3.0 * np.exp(-0.5 * exponent), atol=3.5e-4)


def test_shared_light_keeps_sum_and_centre():
    place = np.array([[0.23, -0.11, 0.4]])
    volume = shared_among_voxels(GRID, place, np.array([3.0]))
    assert volume.sum() == pytest.approx(3.0, rel=1e-6)
    at = np.argwhere(volume)
    centre = (volume[tuple(at.T)][:, np.newaxis] * at[:, ::-1]).sum(axis=0) / 3.0
    np.testing.assert_allclose(GRID.voxel_to_mm(centre), place[0], atol=1e-6)
    assert not shared_among_voxels(GRID, np.array([[9.0, 0.0, 0.0]]), np.array([3.0])).any()


def test_correlation_is_a_cosine(rng):
    volume = rng.random((3, 4, 5), dtype=np.float32)
    assert normalised_correlation(volume, 7.0 * volume) == pytest.approx(1.0)
    assert normalised_correlation(np.eye(3, dtype=np.float32)[0], np.eye(3, dtype=np.float32)[1]) == 0.0
    assert normalised_correlation(volume, np.zeros_like(volume)) == 0.0


def test_what_belongs_to_a_particle_is_an_ellipsoid():
    near = near_a_particle(GRID, np.array([[0.05, 0.05, 0.05]]), 0.11)
    # within 0.11 mm laterally: the voxel and its four neighbours; within 0.44 in depth: four up and down
    assert near[20].sum() == 5
    assert near[:, 12, 15].sum() == 9


def test_the_true_volume_has_no_ghosts(particles):
    light = np.linspace(0.6, 1.4, 10)
    figures = volume_figures(known_volume(GRID, particles, light, SIGMA), GRID, particles, light, 0.1)
    assert figures["q_gaussian"] == pytest.approx(1.0)
    assert figures["completeness"] == figures["precision"] == 1.0
    # exp(-z^2 / 2 s^2) = 1/e at s sqrt 2; samples a standard deviation apart
    assert figures["elongation_mm"] == pytest.approx(2.0 * np.sqrt(2.0) * 0.1, rel=0.1)
    assert figures["particles"] == figures["peaks"] == 10


def test_ghosts_and_missing_particles_are_counted(particles):
    light = np.ones(10)
    ghosts = particles + [0.0, 0.9, 0.0]
    ghosts[:, 1] = np.where(ghosts[:, 1] > 1.1, ghosts[:, 1] - 2.0, ghosts[:, 1])
    # the last ghost is as faint as noise and does not count as a peak
    seen, height = np.concatenate([particles[:8], ghosts[:5]]), np.array([1.0] * 12 + [0.05])
    volume = known_volume(GRID, seen, height, np.array([0.04, 0.04, 0.1]))
    figures = volume_figures(volume, GRID, particles, light, 0.1)
    assert figures["completeness"] == pytest.approx(0.8)
    assert figures["precision"] == pytest.approx(8 / 12)
    assert figures["ghost_light"] == pytest.approx(4 / 12, abs=0.1)
    assert figures["ghost_light_uniform"] > 0.9
    with pytest.raises(InputError, match="none of the true particles"):
        volume_figures(volume, GRID, particles + 50.0, light, 0.1)


def test_validate_volume_moves_the_particles_to_the_frame(particles, tmp_path):
    speed = np.tile([0.1, 0.0, 0.0], (10, 1))
    dt_s = 0.002
    moved = particles + 0.5 * dt_s * 1000.0 * speed
    write_volume(
        tmp_path / "b.vtkhdf",
        known_volume(GRID, moved, np.ones(10), SIGMA),
        GRID,
        Reference("mid_plane", 0.5),
        provenance={},
        attributes={"residual": np.array([0.4, 0.3, 0.2])},
        overwrite=False,
    )
    true = Particles(particles + [0.0, 0.0, 0.5], speed, np.ones(10))
    write_particles(tmp_path / "true.npz", true, overwrite=False)
    known = ("--volume", str(tmp_path / "b.vtkhdf"), "--particles", str(tmp_path / "true.npz"))
    for frame in ("a", "b"):
        arguments = ["validate", "volume", str(CONFIG), *known, "--frame", frame, "-o", str(tmp_path / frame)]
        cli.main(arguments, standalone_mode=False)
    figures = {f: json.loads((tmp_path / f / "volume.json").read_text())["figures"] for f in ("a", "b")}
    assert figures["b"]["q_gaussian"] == pytest.approx(1.0)
    assert figures["a"]["q_gaussian"] < 0.9
    assert (figures["b"]["residual"], figures["b"]["iterations"]) == (0.2, 2)
    with pytest.raises(click.UsageError, match="--frame"):
        cli.main(["validate", "volume", str(CONFIG), *known, "-o", str(tmp_path / "c")], standalone_mode=False)
