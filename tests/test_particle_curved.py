"""Particles behind curved faces: their response against rays counted through a pipe, its derivatives, and fits."""

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.surfaces import Plane
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points, trace
from lfpiv_cli.particles.fitting import add_all, refine
from lfpiv_cli.particles.least_squares import observation_of
from lfpiv_cli.particles.pencil import MEAN_SQUARE, NODES, WEIGHTS, cubic_at, pencil_of
from lfpiv_cli.particles.refraction import on_line_of_sight, places_by_snell
from lfpiv_cli.particles.view import View, footprint_radius_mm, on_array_mm, raw_view, tile_side_mm
from tests.known_rays import image_of, tube_of
from tests.particle_images import fit_moved, light_on, rows_image
from tests.particle_twin import twin_image

RADIUS_MM = 0.025
DEPTHS = (-4.5, 4.5)
# On the axis of the pipe, in focus along it and across it; at its sides, near both depths; close to the wall.
PLACES = [(0.3, 0.1, 3.0), (0.3, 0.1, -1.2), (-0.5, 3.0, 1.0), (-0.5, 3.0, -2.0)]
PLACES += [(0.4, 4.5, 0.5), (0.4, -4.5, -1.2), (0.4, -4.3, -2.0)]


@pytest.fixture(scope="module")
def camera(table2: Camera) -> Camera:
    """The paper's camera, its sensor tall enough for a pipe, the array turned, shifted and a little distorted."""
    lattice = Lattice.regular(0.1, "square", np.deg2rad(0.12), (0.013, -0.02))
    return replace(table2, lattice=lattice, columns=500, rows=2700, distortion_per_mm2=1e-5)


@pytest.fixture(scope="module")
def view(camera: Camera, water: Media) -> View:
    return raw_view(camera, water, RADIUS_MM, space=tube_of(water))


def counted(camera: Camera, space: CurvedSpace, point: tuple[float, float, float], rays: int) -> Floats:
    """Return the share of the rays of a glowing ball that strike each pixel, traced one by one."""
    rng = np.random.default_rng(1)
    away = rng.normal(size=(rays, 3))
    away *= (RADIUS_MM * rng.random(rays) ** (1.0 / 3.0) / np.linalg.norm(away, axis=1))[:, np.newaxis]
    crossing = disc_points(rays, camera.aperture_radius_mm, rng)
    slopes, there = space.slopes(camera, np.array(point) + away, crossing)
    assert there.all()
    return image_of(camera, trace(camera, crossing, slopes).sensor_mm, 1.0 / rays).ravel()


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("turned", [False, True], ids=["along x", "along y"])
def test_response_is_what_rays_through_the_pipe_make(
    camera: Camera, water: Media, place: tuple[float, float, float], turned: bool
) -> None:
    space = tube_of(water)
    if turned:
        camera, place = replace(camera, columns=camera.rows, rows=camera.columns), (place[1], place[0], place[2])
        space = tube_of(water, (0.0, 1.0, 0.0))
    view = raw_view(camera, water, RADIUS_MM, space=space)
    response = rows_image(view, place)
    rays = 500_000
    traced = counted(camera, space, place, rays)
    assert response[:, 0].sum() == pytest.approx(1.0, abs=1e-3)
    # The rays' own noise is 0.8 sqrt(f/n) a pixel; the model may add half of a per cent, as behind planes.
    noise = 0.8 * np.sqrt(traced / rays).sum()
    assert np.abs(response[:, 0] - traced).sum() < noise + 0.005
    if footprint_radius_mm(view, np.array([place]))[0] < 2.0 * view.half_x_mm:
        return  # one lens's width: next to nothing tells the place from the depth
    # A fit to the rays would move by this.
    assert np.all(fit_moved(response, traced) < (5e-4, 5e-4, 4e-3))


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_derivatives_by_true_coordinates_are_finite_differences(view: View, place: tuple[float, float, float]) -> None:
    analytic = rows_image(view, place)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-4
        ahead, behind = (rows_image(view, np.array(place) + sign * step)[:, 0] for sign in (1.0, -1.0))
        difference = (ahead - behind) / 2e-4
        # Behind planes a hundredth. Here slopes are those of the light before what moves it by up to 9 um, a third of
        # the ball's radius: along x close to the wall, where the light hardly depends on it, a tenth.
        assert np.abs(analytic[:, 1 + axis] - difference).sum() < 0.13 * np.abs(difference).sum()
        # Of all that is wrong none is along another axis, as it would be with a place in air for the true one.
        along = analytic[:, 1 + axis] @ difference / (difference @ difference)
        assert along == pytest.approx(1.0, abs=0.03)


@pytest.mark.thorough
@pytest.mark.parametrize("place", PLACES)
def test_rows_are_the_pixels_one_by_one(view: View, place: tuple[float, float, float]) -> None:
    slowly, quickly = twin_image(view, place), rows_image(view, place)
    assert slowly.any()
    # Rows are in single precision.
    assert np.all(np.abs(quickly - slowly) < 1e-4 * np.abs(slowly).max(axis=0))


@pytest.mark.thorough
def test_faces_that_are_plane_are_the_layers(table2: Camera, water: Media) -> None:
    camera = replace(table2, columns=400, rows=360)
    distance = camera.focus_distance_mm - 5.0 / 1.33 - 5.0 / 1.49
    layers = ObjectSpace(water, Window(distance, 5.0), "exact")
    faces = CurvedSpace(water, (Face(Plane(-10.0), 1.49), Face(Plane(-5.0), 1.33)))
    for place in ((0.31, -0.2, 3.0), (0.2, 0.3, -4.0)):
        by_layers, by_faces = (rows_image(raw_view(camera, water, RADIUS_MM, space=s), place) for s in (layers, faces))
        # Layers take the slope's line from two places, faces from the disc: both differ from the rays by far less.
        assert np.abs(by_layers[:, 0] - by_faces[:, 0]).sum() < 1e-3
        for axis in (1, 2, 3):
            assert np.abs(by_layers[:, axis] - by_faces[:, axis]).sum() < 1e-2 * np.abs(by_layers[:, axis]).sum()


def test_the_line_is_closest_to_the_slopes(camera: Camera, water: Media) -> None:
    np.testing.assert_allclose(WEIGHTS.sum(), 1.0, rtol=1e-14)
    np.testing.assert_allclose(WEIGHTS @ NODES**2, MEAN_SQUARE, rtol=1e-14)
    # Mean of u^6 over the disc: 5/64.
    np.testing.assert_allclose(WEIGHTS @ NODES**6, 5.0 / 64.0, rtol=1e-14)
    space, radius = tube_of(water), camera.aperture_radius_mm
    crossing = disc_points(2000, radius, np.random.default_rng(2))
    for place in ((0.4, 3.0, 1.0), (-0.3, -4.8, 0.0)):
        pencil = pencil_of(space.for_kernels(camera), radius, *place)
        slopes, _ = space.slopes(camera, np.tile(place, (len(crossing), 1)), crossing)
        straight = (crossing - pencil.line[:, 0]) / pencil.line[:, 1]
        cubic = np.array([[cubic_at(pencil.cubic[k], *each) for k in range(2)] for each in crossing])
        moved_um = 1e3 * camera.image_distance_mm * np.abs(slopes - straight)
        left_um = 1e3 * camera.image_distance_mm * np.abs(slopes - straight - cubic)
        assert moved_um.max() < 10.0
        assert left_um.max() < (0.3 if abs(place[1]) < 4.0 else 0.6)
        # The two points in air are a millimetre and more apart at y = 3, and swap towards the wall.
        assert abs(np.diff(pencil.line[:, 1])[0]) > 0.5
        # Moves of the line are its differences.
        for axis in range(3):
            step = 1e-4 * np.eye(3)[axis]
            ahead, behind = (
                pencil_of(space.for_kernels(camera), radius, *(np.array(place) + sign * step)).line for sign in (1, -1)
            )
            np.testing.assert_allclose(pencil.line_moves[:, :, axis], (ahead - behind) / 2e-4, atol=1e-3)


def test_what_the_wall_hides_has_no_light_and_footprints_hold_the_rest(view: View, camera: Camera) -> None:
    for place in ((0.1, 4.9, 3.0), (0.0, 5.5, 0.0), (0.0, 0.0, -6.0)):
        assert not rows_image(view, place).any()
    points = np.array([(0.1, 4.9, 3.0), (0.1, 3.0, 1.0)])
    assert np.isfinite(on_array_mm(view, points)).all()
    assert np.isfinite(footprint_radius_mm(view, points)).all()
    np.testing.assert_array_equal(places_by_snell(points, view), points)
    # From the middle of the pipe no line of sight reaches a depth outside it.
    assert on_line_of_sight(view, 0.1, 0.2, 0.0, 6.0) == (0.1, 0.2)
    columns = np.arange(view.camera.rows * view.camera.columns)
    for place in PLACES:
        lit = np.flatnonzero(rows_image(view, place)[:, 0])
        row, column = np.divmod(columns[lit], view.camera.columns)
        point = np.array([place])
        on_array = camera.px_to_mm(np.column_stack([column, row])) - on_array_mm(view, point)
        # A lens's cell is lit as a whole, wherever in it light falls.
        reach = footprint_radius_mm(view, point)[0] + 4.0 * max(view.half_x_mm, view.half_y_mm)
        assert np.abs(on_array).max() < reach
        assert reach < tile_side_mm(view, *DEPTHS)


@pytest.mark.thorough
def test_lines_of_sight_are_rays(camera: Camera, water: Media, view: View) -> None:
    x, y = on_line_of_sight(view, 0.4, 4.0, 0.5, -1.5)
    ends = np.array([(0.4, 4.0, 0.5), (x, y, -1.5)])
    slopes, _ = tube_of(water).slopes(camera, ends, np.zeros((2, 2)))
    np.testing.assert_allclose(slopes[0], slopes[1], atol=1e-9)


# Its fits take half a minute to compile.
@pytest.mark.thorough
def test_fits_return_to_the_truth_and_scatter_as_stated(camera: Camera, water: Media) -> None:
    rng = np.random.default_rng(8)
    view = raw_view(replace(camera, columns=260), water, RADIUS_MM, space=tube_of(water))
    for place in ((0.1, 0.2, 2.5), (-0.1, 3.0, 1.5), (0.1, 4.3, 1.2)):
        true = np.array([[*place, 4e4]])
        model = light_on(view, true, DEPTHS)
        sigma = np.sqrt(model + 36.0)
        values = rows_image(view, place)
        slopes = np.column_stack([4e4 * values[:, 1:], values[:, 0]])
        stated = np.linalg.inv(slopes.T @ (slopes / sigma[:, np.newaxis] ** 2))
        errors = []
        for _ in range(120):
            start = true + rng.normal(0.0, 1.0, (1, 4)) * (0.02, 0.02, 0.1, 4e3)
            image = model + rng.normal(0.0, sigma)
            add_all(view, start, -1.0, image, DEPTHS)
            for _ in range(3):
                refine(observation_of(view, image, 1.0 / sigma**2, DEPTHS), start)
            errors.append(start[0] - true[0])
        error = np.array(errors) / np.sqrt(np.diag(stated))
        # 120 fits: their scatter is known to 6.5 %, their mean to 0.09 of it; slopes are right to some per cent.
        np.testing.assert_allclose(error.std(axis=0), 1.0, atol=0.25)
        assert np.abs(error.mean(axis=0)).max() < 0.35
        # Chi-squared of four unknowns, correlated as stated.
        whole = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(stated), errors)
        assert whole.mean() == pytest.approx(4.0, abs=1.2)


def test_hexagonal_arrays_are_refused(table2: Camera, water: Media) -> None:
    hexagonal = replace(table2, lattice=Lattice.regular(0.1, "hexagonal"))
    with pytest.raises(ConfigError, match="square microlenses alone; these are hexagonal"):
        raw_view(hexagonal, water, RADIUS_MM, space=tube_of(water))
