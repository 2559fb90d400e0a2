"""Kernels on the smallest arrays that use every loop, compiled in the quick suite and interpreted in its own run.

Interpreted (`NUMBA_DISABLE_JIT=1`, `make test-interpreted`), readable twins stand in place of the vectorised loops,
and an index outside an array is an error.
"""

from dataclasses import replace
from inspect import isfunction

import numpy as np
import pytest
from numba import config

from lfpiv_cli import simd
from lfpiv_cli.flow.deformation import deform_pair, spline_coefficients
from lfpiv_cli.flow.moments import MOMENTS, pair_moments
from lfpiv_cli.flow.sums import map_sums, margins
from lfpiv_cli.flow.windows import layout_windows
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import Layout
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.synthetic.render import Balls, render_points
from lfpiv_cli.weights.build import factorise
from lfpiv_cli.weights.operators import adjoint_reference, forward_reference
from lfpiv_cli.weights.quadrature import RayCount, count_rays, integrate_columns, sampling_error
from tests.particle_images import light_on

# Off the axis and out of focus: a point's light goes through several lenses.
PLACE_MM, POINT_MM = (0.02, -0.01, 1.8), (1e-3, 1e-3, 1e-3)


def test_readable_twins_stand_for_intrinsics_where_nothing_is_compiled() -> None:
    assert (simd.turn is simd.turn_reference) == bool(config.DISABLE_JIT)
    assert isfunction(simd.combine_long) == bool(config.DISABLE_JIT)


def test_operators_are_matrix_products(water: Media, table2: Camera, rng: np.random.Generator) -> None:
    camera = replace(table2, columns=45, rows=40, lattice=Lattice.regular(0.1, origin=(0.01, -0.02)))
    operator = factorise(camera, water, Grid.centred((2, 1, 3), (0.1, 0.1, 0.3), (0.0, 0.1, 0.0)))
    volume, image = rng.random(operator.shape, np.float32), rng.random(operator.image_shape, np.float32)
    np.testing.assert_allclose(operator.forward(volume), forward_reference(operator, volume), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(operator.adjoint(image), adjoint_reference(operator, image), rtol=1e-5, atol=1e-6)


def test_a_field_at_rest_deforms_nothing(rng: np.random.Generator) -> None:
    a, b = rng.random((2, 4, 4, 5), np.float32)
    rest, at_windows = np.zeros((1, 1, 1, 3)), np.ones((5, 1), np.float32)
    everywhere = np.zeros((0, 0, 0), np.bool_)
    to_voxels = (at_windows, at_windows[:4], at_windows[:4])
    splined = (spline_coefficients(a), spline_coefficients(b))
    found_a, found_b, valid = deform_pair(*splined, everywhere, rest, to_voxels, (0, 0, 1), (0, 0, 0))
    assert valid[:, :, 1:].all()
    # float32, and taps of a weight of 2e-7 are left out
    np.testing.assert_allclose(found_a[:, :, 1:], a / a.max(), atol=2e-6)
    np.testing.assert_allclose(found_b[:, :, 1:], b / b.max(), atol=2e-6)


def test_maps_and_moments_are_sums_over_a_window(rng: np.random.Generator) -> None:
    a, b = rng.random((2, 2, 3, 4), np.float32)
    layout = layout_windows((4, 3, 2), (4, 3, 2), (0.0, 0.0, 0.0))
    before, after = margins(layout, a.shape, 1)
    margin = list(zip(before, after, strict=True))
    padded_a, padded_b = (np.pad(one, margin) for one in (a, b))
    maps = map_sums(padded_a, padded_b, layout, before, 1).correlation()
    assert maps[0, 0, 0, 1, 1, 1] == pytest.approx(2.0 * np.sum(a * b) / (2.0 * np.sqrt(np.sum(a**2) * np.sum(b**2))))
    found = pair_moments(padded_a, padded_b, np.ones(padded_a.shape, np.uint8), layout, before)
    assert found.shape == (2, 3, 4, MOMENTS)
    total = found.sum(axis=(0, 1, 2))
    # the last of the ten products among gradient and mean, and the last of those with the difference
    mean = 0.5 * (a + b)
    np.testing.assert_allclose(total[[9, 13]], [np.sum(mean**2), np.sum(mean * (b - a))], rtol=1e-5)


@pytest.fixture
def coarse(table2: Camera) -> Camera:
    """Micro-images of 4.5 pixels, 20 lenses."""
    return replace(table2, columns=20, rows=20, pixel_mm=0.022)


# The random numbers' counter is to overflow; an errstate would not reach the threads on which rays are counted.
@pytest.mark.filterwarnings("ignore:overflow encountered:RuntimeWarning")
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_columns_are_what_rays_make(water: Media, coarse: Camera, rng: np.random.Generator, layout: Layout) -> None:
    camera, space = replace(coarse, lattice=Lattice.regular(0.1, layout)), ObjectSpace(water, None, "paraxial")
    column = integrate_columns(camera, space, [PLACE_MM], POINT_MM, 12, 1).image(0, (20, 20))
    assert column.sum() == pytest.approx(1.0, abs=1e-5)
    rendered = render_points(camera, space, Balls(PLACE_MM, 1.0, 0.0), rng, rays=1000)
    counted = count_rays(camera, space, PLACE_MM, POINT_MM, rng, RayCount(2, 500))
    # 1,000 rays over some 50 pixels, evenly spread and random ones
    assert np.abs(rendered - column).sum() < 0.12
    assert np.abs(counted - column).sum() < 1.3 * sampling_error(column, 1000)


@pytest.mark.thorough
def test_particles_are_balls_as_rays_make_them(water: Media, coarse: Camera, rng: np.random.Generator) -> None:
    view, particles = raw_view(coarse, water, 0.025), np.array([(*PLACE_MM, 1.0)])
    image = light_on(view, particles, (1.0, 2.0))
    space = ObjectSpace(water, None, "paraxial")
    rendered = render_points(coarse, space, Balls(PLACE_MM, 1.0, 0.05), rng, rays=4000).ravel()
    # 4,000 rays over some 50 pixels
    assert np.abs(image - rendered).sum() < 0.06
