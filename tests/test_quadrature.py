"""Weights of single voxels: quadrature against counted rays, convergence, conservation, the two methods."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.tracing import ObjectSpace, PolynomialRays, complete_exponents
from lfpiv_cli.weights.lens_cells import MOST_CORNERS, neighbours, shared_rectangle
from lfpiv_cli.weights.quadrature import TILES, RayCount, count_rays, integrate_columns, sampling_error
from lfpiv_cli.weights.scene import aperture_tiles, kernel_scene, on_array, rays_from

VOXEL = (0.1, 0.1, 0.1)
SMALL = (260, 380)


def small_camera(layout: str, rotation_rad: float = 0.0, focal_length_mm: float = 0.8) -> Camera:
    lattice = Lattice.regular(0.1, layout, rotation_rad, (0.013, -0.021))
    return Camera(-1.0, 100.0, 25.0, focal_length_mm, 0.8, lattice, 0.0055, SMALL[1], SMALL[0], "x", 1e-4)


def quadrature_image(camera, source, centre, voxel=VOXEL, tiles=128):
    return integrate_columns(camera, source, [centre], voxel, tiles, 5).image(0, SMALL)


@pytest.mark.thorough
@pytest.mark.parametrize("focal_length_mm", [0.8, 0.7])
@pytest.mark.parametrize("refraction", ["paraxial", "exact"])
@pytest.mark.parametrize("rotation_rad", [0.0, 0.02])
def test_quadrature_agrees_with_counted_rays_eq_13(
    layout, rotation_rad, refraction, focal_length_mm, water, window, rng
):
    camera = small_camera(layout, rotation_rad, focal_length_mm)
    space = ObjectSpace(water, window, refraction)
    for centre, voxel in [((0.31, -0.22, 3.0), VOXEL), ((-0.2, 0.1, -4.5), (0.05, 0.05, 0.2))]:
        exact = quadrature_image(camera, space, centre, voxel)
        counted = count_rays(camera, space, centre, voxel, rng, RayCount(100_000, 5))
        # A sum over hundreds of pixels stays within some per cent of its mean; the 5 rays of a point add to it.
        assert np.abs(exact - counted).sum() < 1.3 * sampling_error(exact, 500_000)


def test_halving_the_tiles_converges_in_second_order(layout, water):
    camera = small_camera(layout)
    images = [
        quadrature_image(camera, ObjectSpace(water, None, "paraxial"), (0.2, 0.1, 2.0), tiles=n) for n in (32, 64, 128)
    ]
    coarse, fine = (np.abs(a - b).sum() for a, b in zip(images, images[1:], strict=False))
    assert fine < 0.4 * coarse
    assert fine < 0.005


def test_no_light_is_lost_inside_the_sensor(layout, water, window):
    for space in (ObjectSpace(water, window, "exact"), ObjectSpace(water, window, "paraxial", "drt")):
        image = quadrature_image(small_camera(layout), space, (0.0, 0.1, 1.0), tiles=TILES)
        assert image.sum() == pytest.approx(1.0, abs=1e-4)  # shares below 1e-7 are left out


@pytest.mark.parametrize("z_mm", [-8.0, 0.0, 5.0])
def test_direct_ray_tracing_equals_equivalent_points_eqs_9_14_15(table2, water, z_mm):
    # The window's place must not matter; a wrong matrix changes the distance in its third digit.
    for window in (Window(98.0, 2.0), Window(150.0, 10.0)):
        direct = ObjectSpace(water, window, "paraxial", "drt").distance(table2, z_mm)
        assert direct == pytest.approx(ObjectSpace(water).distance(table2, z_mm), rel=1e-14)


def test_direct_ray_tracing_needs_a_window(table2, water):
    with pytest.raises(ConfigError, match="needs a window"):
        ObjectSpace(water, None, "paraxial", "drt").distance(table2, 0.0)


def test_a_voxel_in_front_of_the_fluid_is_refused(table2, water):
    space = ObjectSpace(water, Window(198.0, 2.0))
    with pytest.raises(ConfigError, match="in front of the fluid"):
        integrate_columns(table2, space, [(0.0, 0.0, -5.0)], VOXEL)


def test_a_voxel_outside_the_view_has_an_empty_column(water):
    columns = integrate_columns(small_camera("square"), ObjectSpace(water, None, "paraxial"), [(9.0, 0.0, 0.0)], VOXEL)
    assert columns.share.size == 0


def test_counted_rays_repeat_with_their_seed(water):
    camera = small_camera("square")
    images = [
        count_rays(camera, ObjectSpace(Media()), (0.1, 0.0, 1.0), VOXEL, np.random.default_rng(3), RayCount(50, 40))
        for _ in range(2)
    ]
    assert np.array_equal(*images)
    assert images[0].sum() == pytest.approx(1.0)


def test_tiles_fill_the_disc():
    tiles = aperture_tiles(12.5, 9)
    assert tiles.share.sum() == pytest.approx(1.0, rel=1e-12)
    assert np.hypot(*tiles.middle_mm.T).max() < 12.5
    # The mean square distance from the axis of a disc is R^2 / 2, of a square about its middle side^2 / 6.
    spread = np.sum(tiles.share * np.sum(tiles.middle_mm**2, axis=1)) + tiles.side_mm**2 / 6.0
    assert spread == pytest.approx(12.5**2 / 2.0, rel=5e-3)


def test_lens_regions_share_out_a_rectangle(layout, rng):
    lattice = Lattice.regular(0.1, layout, 0.1)
    low, high = np.array([-0.13, 0.02]), np.array([0.11, 0.09])
    work = np.empty((2, MOST_CORNERS, 2))
    centres = lattice.points([(i, j) for i in range(-4, 5) for j in range(-4, 5)])
    parts = [
        shared_rectangle((low[0], low[1]), (high[0], high[1]), x, y, neighbours(lattice), work) for x, y in centres
    ]
    area = float(np.prod(high - low))
    assert sum(part[0] for part in parts) == pytest.approx(area, rel=1e-12)
    points = low + rng.random((20_000, 2)) * (high - low)
    nearest = lattice.points(lattice.nearest(points))
    for centre, part in zip(centres, parts, strict=True):
        inside = np.all(np.abs(nearest - centre) < 1e-9, axis=1)
        assert part[0] / area == pytest.approx(inside.mean(), abs=0.015)  # four standard errors
        if inside.sum() > 1000:
            np.testing.assert_allclose(part[1:3], points[inside].mean(axis=0), atol=0.003)


def test_twisted_camera_keeps_its_column_axis_out_of_it(water):
    # Quadrature works in image axes; a camera that names its columns y must give the same pixels there.
    camera = small_camera("square")
    space = ObjectSpace(water, None, "paraxial")
    images = [
        quadrature_image(c, space, (0.2, -0.1, 1.0), tiles=16) for c in (camera, replace(camera, column_axis="y"))
    ]
    assert np.array_equal(*images)


@pytest.mark.parametrize("z_mm", [0.5, 3.0])
def test_fitted_rays_give_the_columns_of_traced_ones(layout, water, z_mm):
    # At one depth paraxial rays are linear: x_m = alpha X - x s_i/s_o; a flat voxel sees no other depth.
    camera = replace(small_camera(layout), distortion_per_mm2=0.0)
    space = ObjectSpace(water, None, "paraxial")
    distance = float(space.distance(camera, z_mm))
    alpha, scale = float(camera.defocus(distance)), camera.image_distance_mm / distance
    exponents = np.array([(1, 0, 0, 0, 0), (0, 0, 0, 1, 0), (0, 1, 0, 0, 0), (0, 0, 0, 0, 1)], np.int64)
    units = np.array([2.0, 3.0, 5.0, 10.0, 12.5])
    along = np.array([-scale * units[0], alpha * units[3], 0.0, 0.0])
    across = np.array([0.0, 0.0, -scale * units[1], alpha * units[4]])
    fitted = PolynomialRays(units, exponents, np.stack([along, across], axis=1))
    images = [quadrature_image(camera, each, (0.2, -0.1, z_mm), (0.1, 0.1, 1e-9), 24) for each in (space, fitted)]
    np.testing.assert_allclose(*images, atol=1e-9)
    assert images[0].sum() == pytest.approx(1.0, abs=1e-4)


def test_the_kernels_polynomial_is_its_array_twin(water, rng):
    exponents = complete_exponents(3)
    fitted = PolynomialRays(np.array([4.0, 3.0, 8.0, 12.0, 11.0]), exponents, rng.normal(size=(len(exponents), 2)))
    points, crossings = rng.uniform(-4.0, 4.0, (50, 3)), rng.uniform(-12.0, 12.0, (50, 2))
    scene = kernel_scene(small_camera("square"), fitted, points, np.array(VOXEL), 4, 1)
    kernel = [
        on_array(scene, point, rays_from(scene, point, 0, 0), *crossing)
        for point, crossing in zip(points, crossings, strict=True)
    ]
    np.testing.assert_allclose(kernel, fitted.on_array(points, crossings), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("degree", "terms"), [(2, 21), (3, 56)])
def test_complete_polynomials_have_the_terms_of_hall_et_al(degree, terms):
    exponents = complete_exponents(degree)
    assert exponents.shape == (terms, 5)
    assert len(np.unique(exponents, axis=0)) == terms
