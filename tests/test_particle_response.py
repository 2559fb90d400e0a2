"""The response of one particle against rays, finite differences and conservation of light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lfpiv_cli.names import Layout
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.cells import cell_shares, covered_share, level_at, rim_table, share_at
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import observation_of
from lfpiv_cli.particles.view import View, entry_capacity, raw_view
from lfpiv_cli.synthetic.render import Balls, render_points
from tests.particle_twin import respond

RADIUS_MM = 0.025
# In, near and out of focus, on both sides, off the axis; light goes through 1 to 50 lenses.
PLACES = [(0.31, -0.2, 3.0), (0.53, 0.21, 0.02), (-0.62, 0.4, 0.4), (0.2, 0.3, -4.0)]


@pytest.fixture(scope="module", params=["square", "hexagonal"])
def small(table2: Camera, request: pytest.FixtureRequest) -> Camera:
    """The paper's camera with a small sensor and an array that is turned, shifted and seen through distortion."""
    lattice = Lattice.regular(0.1, request.param, np.deg2rad(0.12), (0.013, -0.02))
    return replace(table2, lattice=lattice, columns=400, rows=360, distortion_per_mm2=2e-4)


@pytest.fixture(scope="module")
def view(small: Camera, water: Media) -> View:
    """What the small camera sees: its tables for hexagons take longer than the tests."""
    return raw_view(small, water, RADIUS_MM)


def entries(view: View, point: tuple[float, float, float]) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    capacity = entry_capacity(view, -5.0, 5.0)
    pixels, values = np.empty(capacity, np.int32), np.empty((capacity, 4))
    count = respond(view, *point, pixels, values)
    assert count < capacity
    return pixels[:count], values[:count]


def images(view: View, point: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return light and derivatives as images (pixels, 4)."""
    pixels, values = entries(view, point)
    result = np.zeros((view.camera.rows * view.camera.columns, 4))
    np.add.at(result, pixels, values)
    return result


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_response_is_what_rays_make(small: Camera, view: View, water: Media, place: tuple[float, float, float]) -> None:
    response = images(view, place)
    rays = 1_000_000
    space = ObjectSpace(water, None, "paraxial")
    traced = render_points(
        small, space, Balls([place], 1.0, 2 * RADIUS_MM), np.random.default_rng(1), rays=rays
    ).ravel()
    assert response[:, 0].sum() == pytest.approx(1.0, abs=1e-3)
    # The rays' own noise is 0.8 sqrt(f/n) a pixel, summed over the pixels; the model may add half of a per cent.
    noise = 0.8 * np.sqrt(traced / rays).sum()
    assert np.abs(response[:, 0] - traced).sum() < noise + 0.005
    if abs(place[2]) < 0.1:
        return  # all light passes one lens, whichever way the particle moves within it: no position to compare
    lit = (response[:, 0] > 0.0) | (traced > 0.0)
    bias = np.linalg.lstsq(
        np.column_stack([response[lit, 1:], response[lit, 0]]), (traced - response[:, 0])[lit], rcond=None
    )[0]
    # A fit to the rays would move by this: a thousandth of a voxel's width, and three hundredths in depth.
    assert np.abs(bias[:2]).max() < 3e-4
    assert abs(bias[2]) < 3e-3


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_derivatives_are_finite_differences(
    small: Camera, view: View, place: tuple[float, float, float], axis: int
) -> None:
    hexagonal = small.lattice.layout == "hexagonal"
    # Smaller steps would see where entries of the hexagons' table meet.
    step = np.zeros(3)
    step[axis] = (1e-3 if axis < 2 else 1e-2) if hexagonal else 1e-4
    ahead, behind = (images(view, tuple(np.array(place) + sign * step))[:, 0] for sign in (1, -1))
    difference = (ahead - behind) / (2.0 * step[axis])
    analytic = images(view, place)[:, 1 + axis]
    # The first moments' own slopes are left out: a hundredth of all, seen where a particle in focus hardly changes.
    # Hexagonal cells take a patch's mean slope for the slope of its middle: another hundredth.
    share = 0.02 if hexagonal else 0.01
    assert np.abs(analytic - difference).sum() < share * np.abs(difference).sum() + 0.005


def test_distortion_moves_the_light(view: View) -> None:
    place = (0.6, -0.5, 2.0)
    straight = view._replace(camera=view.camera._replace(distortion_per_mm2=0.0))
    with_it, without = (images(v, place)[:, 0] for v in (view, straight))
    # k1 r^3 = 1e-4 mm of a lens of 0.1 mm: about 2e-3 of the light changes lenses.
    assert 1e-4 < np.abs(with_it - without).sum() < 1e-2


def test_each_lens_has_its_own_centre(view: View) -> None:
    moved = view._replace(centres_mm=view.centres_mm + np.array([0.004, 0.0]))
    place = (0.3, 0.1, 3.0)
    before, after = images(view, place)[:, 0], images(moved, place)[:, 0]
    columns = np.arange(before.size) % view.camera.columns
    shift_px = (after @ columns) / after.sum() - (before @ columns) / before.sum()
    # The light's centre stays (the same rays), moved by the little that the micro-images shift beneath it.
    assert abs(shift_px) < 1.0
    assert np.abs(before - after).sum() > 0.1


def test_rim_shares_are_areas() -> None:
    table, reach = rim_table(12.5, 1.375)
    rng = np.random.default_rng(3)
    for x, y in rng.uniform(-13.0, 13.0, (30, 2)):
        u, v = np.meshgrid(*[(np.arange(200) + 0.5) / 100 - 1.0] * 2)
        covered = np.hypot(x + u * 0.6875, y + v * 0.6875) <= 12.5
        share, mean_x, mean_y, *_ = covered_share(x, y, 1.375, 12.5, table, reach)
        assert share == pytest.approx(covered.mean(), abs=4e-3)
        assert mean_x == pytest.approx((u * covered).mean(), abs=6e-3)
        assert mean_y == pytest.approx((v * covered).mean(), abs=6e-3)


def test_rim_shares_of_narrower_patches() -> None:
    table, reach = rim_table(12.5, 1.375)
    for at in (12.1, 12.3, 12.5, 12.8):
        share, _, _, slope, _ = covered_share(at, 0.0, 1.2, 12.5, table, reach)
        # The rim is 0.005 of a patch lower at its ends; patches of the table's own width would be off by up to 0.04.
        assert share == pytest.approx(0.5 + (12.5 - at) / 1.2, abs=0.01)
        assert slope == pytest.approx(-1.0 / 1.2, rel=0.05)


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_depths_before_a_slow_lens_are_true(layout: Layout) -> None:
    # At f/14 and M = -0.38 one lens more spreads the rays by a fortieth: rays that strike one place on the sensor
    # crossed the main lens at places that depend on where in the ball they come from.
    lattice = Lattice.regular(0.11, layout)
    camera = Camera(-0.383, 60.0, 4.25, 1.9, 1.9, lattice, 0.0074, 200, 200)
    media, rng = Media(), np.random.default_rng(5)
    view = raw_view(camera, media, 0.07)
    for depths in (-0.8, 1.5, 2.0):
        true = np.array([[0.3, 0.2, depths * view.scale.depth_mm, 1e6]])
        image = render_points(camera, ObjectSpace(media), Balls(true[:, :3], true[:, 3], 0.14), rng, rays=2_000_000)
        found, residual, limits = true.copy(), image.ravel().copy(), (-60.0, 60.0)
        add_all(view, found, -1.0, residual, limits)
        for _ in range(4):
            refine(observation_of(view, residual, 1.0 / (image.ravel() + 100.0), limits), found)
        # Noise of so many rays: 5e-4 of a depth. With all of the ball taken for its middle the error is 0.02, and 0.01
        # with hexagons, where what is seen of the ball is taken from the slopes of P.
        within = 2e-3 if layout == "square" else 4e-3
        assert abs(found[0, 2] - true[0, 2]) < within * view.scale.depth_mm
        assert np.abs(found[0, :2] - true[0, :2]).max() < 2e-3 * view.scale.lens_mm


@pytest.mark.thorough
def test_hexagonal_cells_share_out_all_light() -> None:
    lattice = Lattice.regular(0.1, "hexagonal", np.deg2rad(0.7))
    table, side2, step, radius = cell_shares(lattice, RADIUS_MM)
    assert radius == RADIUS_MM
    i, j = np.meshgrid(np.arange(-4, 5), np.arange(-4, 5))
    lenses = lattice.points(np.stack([i.ravel(), j.ravel()], axis=1))
    for side in (0.0, 0.02, 0.07, 0.1):
        level, blend = level_at(side * side, side2)
        for place in np.random.default_rng(4).uniform(-0.1, 0.1, (20, 2)):
            shares = [share_at(*(place - lens), table[level], table[level + 1], blend, step) for lens in lenses]
            # Second-order terms between entries leave a quarter of (1/16)^3, chords 1e-4 of each of three cells.
            assert sum(share[0] for share in shares) == pytest.approx(1.0, abs=5e-4)
