"""The lattice of lenses: distances and turns of its vectors, and the nearest lens by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from lfpiv_cli.optics.camera import Lattice, nearest_point


def lattice_of(layout, rotation_rad=0.02, origin=(0.013, -0.027)):
    return Lattice.regular(0.1, layout, rotation_rad, origin)


def brute_force(lattice, points, reach=12):
    """Return the nearest of all lattice points with indices within `reach`, by distance."""
    steps = np.arange(-reach, reach + 1)
    indices = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(lattice.points(indices)[np.newaxis] - points[:, np.newaxis], axis=2)
    return indices[np.argmin(distance, axis=1)]


def test_basis_lengths_and_angle(layout):
    lattice = lattice_of(layout)
    assert lattice.pitch == pytest.approx([0.1, 0.1])
    cosine = lattice.basis[0] @ lattice.basis[1] / 0.01
    assert cosine == pytest.approx({"square": 0.0, "hexagonal": 0.5}[layout], abs=1e-12)


def test_a_hexagon_has_six_neighbours_at_the_pitch():
    lattice = lattice_of("hexagonal")
    steps = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), axis=-1).reshape(-1, 2)
    distance = np.linalg.norm(lattice.points(steps) - lattice.points((0, 0)), axis=1)
    assert np.sum(np.isclose(distance, 0.1)) == 6


def test_rotation_goes_from_the_columns_towards_the_rows(layout):
    # 0.12 degrees turn (1, 0) into (cos, sin): ten lenses along the columns rise by 1.0 mm * 0.0020944 along the rows
    lattice = Lattice.regular(0.1, layout, np.deg2rad(0.12))
    assert lattice.points((10, 0)) == pytest.approx([0.9999978, 0.0020944], abs=1e-7)
    assert np.rad2deg(lattice.rotation_rad) == pytest.approx(0.12, rel=1e-12)


def test_nearest_by_brute_force(layout, rng):
    lattice = lattice_of(layout)
    points = rng.uniform(-0.5, 0.5, (2000, 2))
    assert np.array_equal(lattice.nearest(points), brute_force(lattice, points))


def test_rounding_would_name_the_wrong_hexagon_for_one_point_in_six(rng):
    """That the neighbours must be compared: the test above can fail."""
    points = rng.uniform(-0.5, 0.5, (20000, 2))
    for layout, share in (("square", 0.0), ("hexagonal", 1 / 6)):
        lattice = lattice_of(layout)
        wrong = np.any(np.rint(lattice.coordinates(points)) != lattice.nearest(points), axis=1).mean()
        assert wrong == pytest.approx(share, abs=0.01)  # 4 standard deviations of 20,000 trials


def test_kernel_names_the_same_lens_as_the_lattice(layout, rng):
    lattice = lattice_of(layout)
    points = rng.uniform(-0.5, 0.5, (500, 2))
    expected = lattice.points(lattice.nearest(points))
    found = np.array([nearest_point(x, y, lattice.origin, lattice.basis) for x, y in points])
    assert found == pytest.approx(expected, abs=1e-15)


def test_coordinates_invert_points(layout, rng):
    lattice = lattice_of(layout)
    indices = rng.integers(-50, 50, (20, 2))
    assert lattice.coordinates(lattice.points(indices)) == pytest.approx(indices, abs=1e-10)


def test_transformed_and_scaled_move_the_points(layout, rng):
    lattice = lattice_of(layout)
    indices = rng.integers(-50, 50, (20, 2))
    matrix, shift = np.array([[0.9, 0.2], [-0.1, 1.1]]), np.array([3.0, -4.0])
    assert lattice.transformed(matrix, shift).points(indices) == pytest.approx(
        lattice.points(indices) @ matrix.T + shift
    )
    assert lattice.scaled(2.5).points(indices) == pytest.approx(2.5 * lattice.points(indices))
