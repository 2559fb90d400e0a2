"""Weights: integrals against rays, operators against dense matrices, adjointness, conservation, conventions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points, trace
from lfpiv_cli.weights.build import blur_radius_mm, default_padding, factorise, factorise_through
from lfpiv_cli.weights.lens_cells import axis_optics, disc_area_below
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.operators import adjoint_reference, forward_reference
from lfpiv_cli.weights.quadrature import integrate_columns
from tests.known_rays import slopes_equivalent

RAYS = 400_000


@pytest.fixture
def small(table2: Camera) -> Camera:
    """Table 2 with a sensor of 380 x 260 pixels and an array that is off the axis by an odd amount."""
    return replace(table2, columns=380, rows=260, lattice=Lattice.regular(0.1, origin=(0.013, -0.021)))


def weights_of(camera: Camera, media: Media, grid: Grid, padding: tuple[int, int, int] = (0, 0, 0)) -> Weights:
    operator = factorise(camera, media, grid.padded(padding))
    return Weights(grid, padding, operator, camera.column_axis)


def ray_count(
    camera: Camera, media: Media, grid: Grid, voxel_xyz: tuple[int, int, int], rng: np.random.Generator
) -> np.ndarray:
    """Return Eq. 13 by counting: the share of the rays of one voxel that strike each pixel."""
    points = grid.voxel_to_mm(np.asarray(voxel_xyz) + rng.random((RAYS, 3)) - 0.5)
    points = camera.to_image_axes(points)
    lens = disc_points(RAYS, camera.aperture_radius_mm, rng)
    hits = trace(camera, lens, slopes_equivalent(points, lens, camera, media))
    column, row = np.rint(camera.mm_to_px(hits.sensor_mm)).astype(int).T
    seen = (column >= 0) & (column < camera.columns) & (row >= 0) & (row < camera.rows)
    counts = np.bincount(row[seen] * camera.columns + column[seen], minlength=camera.rows * camera.columns)
    return counts.reshape(camera.rows, camera.columns) / RAYS


@pytest.mark.thorough
@pytest.mark.parametrize("z_mm", [-4.0, -1.0, 0.0, 3.0])
@pytest.mark.parametrize("spacing", [(0.1, 0.1, 0.1), (0.05, 0.05, 0.2)])
def test_column_agrees_with_counted_rays_eq_13(small, water, rng, z_mm, spacing):
    grid = Grid.centred((3, 3, 1), spacing, (0.31, -0.22, z_mm))
    counted = ray_count(small, water, grid, (2, 0, 0), rng)
    rows, columns, weight = weights_of(small, water, grid).column(0, 0, 2)
    exact = np.zeros_like(counted)
    exact[rows, columns] = weight
    # The count itself errs by sum sqrt(2 w / (pi n)); the factorised rim adds up to 0.027 (the worst voxel measured).
    sampling = np.sum(np.sqrt(2.0 * exact / (np.pi * RAYS)))
    assert np.abs(exact - counted).sum() < 0.027 + sampling


@pytest.mark.thorough
def test_column_axis_y_exchanges_the_lateral_axes(small, water, rng):
    camera = replace(small, column_axis="y")
    grid = Grid.centred((2, 4, 1), (0.1, 0.1, 0.1), (0.4, -0.5, 2.0))
    counted = ray_count(camera, water, grid, (1, 3, 0), rng)
    rows, columns, weight = weights_of(camera, water, grid).column(0, 3, 1)
    at = [np.sum(counted * axis) for axis in np.indices(counted.shape)]
    # A micro-image is 18 pixels wide: centroids agree to a small part of a pixel only on the right side of the image.
    assert np.allclose(at, [np.sum(weight * rows) / weight.sum(), np.sum(weight * columns) / weight.sum()], atol=0.2)


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
@pytest.mark.parametrize("padding", [(0, 0, 0), (2, 1, 1)])
def test_forward_and_adjoint_are_adjoint(small, media, rng, column_axis, padding):
    camera = replace(small, column_axis=column_axis)
    weights = weights_of(camera, media, Grid.centred((7, 5, 6), (0.1, 0.12, 0.4), (0.1, 0.2, 0.3)), padding)
    volume = rng.random(weights.shape, dtype=np.float32)
    image = rng.random(weights.image_shape, dtype=np.float32)
    left = np.vdot(weights.forward(volume).astype(np.float64), image)
    right = np.vdot(volume.astype(np.float64), weights.adjoint(image))
    assert left == pytest.approx(right, rel=1e-5)  # float32 sums of some hundred terms


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 3, 4), (6, 9, 7)])
def test_kernels_equal_dense_products(small, water, rng, shape):
    operator = factorise(small, water, Grid.centred(shape, (0.1, 0.1, 0.3), (0.0, 0.1, 1.0)))
    volume = rng.random(operator.shape, dtype=np.float32)
    image = rng.random(operator.image_shape, dtype=np.float32)
    np.testing.assert_allclose(operator.forward(volume), forward_reference(operator, volume), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(operator.adjoint(image), adjoint_reference(operator, image), rtol=1e-5, atol=1e-6)


def test_same_bits_for_any_number_of_threads(small, water, rng, one_thread):
    operator = factorise(small, water, Grid.centred((9, 8, 7), (0.1, 0.1, 0.5), (0.0, 0.0, 0.0)))
    volume = rng.random(operator.shape, dtype=np.float32)
    with one_thread():
        image = operator.forward(volume)
        back = operator.adjoint(image)
    assert np.array_equal(image, operator.forward(volume))
    assert np.array_equal(back, operator.adjoint(image))


def test_column_is_the_image_of_one_voxel(small, water):
    weights = weights_of(small, water, Grid.centred((4, 3, 2), (0.1, 0.1, 0.1), (0.0, 0.0, -2.0)), (1, 2, 1))
    volume = np.zeros(weights.shape, np.float32)
    volume[1, 2, 3] = 1.0
    image = np.zeros(weights.image_shape, np.float32)
    rows, columns, weight = weights.column(1, 2, 3)
    image[rows, columns] = weight
    np.testing.assert_allclose(weights.forward(volume), image, atol=1e-9)


def test_no_light_is_lost_inside_the_sensor(small, water):
    operator = factorise(small, water, Grid.centred((3, 3, 5), (0.1, 0.1, 1.0), (0.0, 0.0, 0.0)))
    for axis in (operator.columns, operator.rows):
        sums = np.add.reduceat(axis.share, axis.start[:-1])
        np.testing.assert_allclose(sums, 1.0, rtol=1e-6)  # float32 shares


@pytest.mark.thorough
def test_one_pitch_in_focus_moves_the_image_by_one_micro_image(table2, water):
    # Table 2: 0.1 mm (1 + 0.8/200) / 5.5 um = 18.2545 px; M = -1 turns the direction round.
    grid = Grid.centred((3, 1, 1), (0.1, 0.1, 0.1), (0.05, 0.0, 0.0))
    weights = weights_of(table2, water, grid)
    centroids = []
    for ix in (0, 1, 2):
        _, columns, weight = weights.column(0, 0, ix)
        centroids.append(np.sum(weight * columns) / np.sum(weight))
    np.testing.assert_allclose(np.diff(centroids), -18.2545, atol=0.02)


@pytest.mark.thorough
def test_a_point_at_plus_x_lights_the_sensor_at_minus_x(table2, water):
    weights = weights_of(table2, water, Grid.centred((1, 1, 1), (0.1, 0.1, 0.1), (2.0, 1.0, 0.0)))
    rows, columns, weight = weights.column(0, 0, 0)
    # By hand: x_m = -2 mm, micro-image at -2 (1.004) mm, /5.5 um = -365.1 px from column 1175.5; rows at -182.5 of
    # 883.5.
    assert np.sum(weight * columns) / weight.sum() == pytest.approx(1175.5 - 365.1, abs=0.1)
    assert np.sum(weight * rows) / weight.sum() == pytest.approx(883.5 - 182.5, abs=0.1)


def test_hexagonal_or_turned_arrays_are_refused(table2, water):
    grid = Grid.centred((2, 2, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    for lattice in (Lattice.regular(0.1, "hexagonal"), Lattice.regular(0.1, rotation_rad=1e-3)):
        with pytest.raises(ConfigError, match="does not separate"):
            factorise(replace(table2, lattice=lattice), water, grid)


def test_disc_area_below_against_sampling():
    n = 2000
    x, y = np.meshgrid((np.arange(n) + 0.5) / n * 2 - 1, (np.arange(n) + 0.5) / n * 2 - 1)
    inside = np.hypot(x, y) <= 1.0
    for a, b in [(0.3, -0.5), (-0.8, 0.3), (0.9, 0.9), (-0.5, -0.5), (0.95, -0.2), (0.2, 2.0), (-1.1, 0.0)]:
        counted = np.sum(inside & (x <= a) & (y <= b)) * 4.0 / n**2
        assert disc_area_below(a, b, 1.0) == pytest.approx(counted, abs=4.0 / n)  # one line of cells at each edge


def test_padding_reaches_as_far_as_blur(table2, water):
    grid = Grid.centred((10, 10, 100), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    radius = blur_radius_mm(table2, water, grid)
    # At z = 5 mm: s_o = 203.76, alpha = -0.0184; 0.231 + 0.05 mm on the array, back to the flow by 1.0188.
    assert radius == pytest.approx(0.286, abs=0.002)
    assert default_padding(table2, water, grid) == (3, 3, 0)


def test_axis_optics_reads_both_axes(small):
    columns, rows = axis_optics(small)
    assert (columns.pixels, rows.pixels) == (380, 260)
    assert (columns.lens_origin_mm, rows.lens_origin_mm) == (0.013, -0.021)


def test_direct_ray_tracing_gives_the_weights_of_equivalent_points_eqs_14_15(small, water, window):
    grid = Grid.centred((3, 2, 4), (0.1, 0.1, 0.5), (0.2, 0.1, 1.0))
    direct = factorise_through(small, ObjectSpace(water, window, "paraxial", "drt"), grid)
    equivalent = factorise(small, water, grid)
    for one, other in ((direct.columns, equivalent.columns), (direct.rows, equivalent.rows)):
        np.testing.assert_array_equal(one.cell, other.cell)
        np.testing.assert_allclose(one.share, other.share, atol=2e-7)  # float32 rounding


@pytest.mark.parametrize("z_mm", [-2.0, 3.0])
def test_exact_refraction_comes_closer_to_exact_rays(small, water, window, z_mm):
    # 134 mm of water: the paraxial columns are off by 0.05 in L1, the separable exact ones by 0.02.
    grid = Grid.centred((1, 1, 1), (0.1, 0.1, 0.1), (0.31, -0.22, z_mm))
    exact = ObjectSpace(water, window, "exact")
    truth = integrate_columns(small, exact, [(0.31, -0.22, z_mm)], grid.spacing_mm, 96).image(0, (260, 380))
    errors = []
    for space in (exact, replace(exact, refraction="paraxial")):
        rows, columns, weight = factorise_through(small, space, grid).column(0, 0, 0)
        image = np.zeros_like(truth)
        image[rows, columns] = weight
        errors.append(np.abs(image - truth).sum())
    assert errors[0] < 0.03
    assert errors[0] < 0.6 * errors[1]
