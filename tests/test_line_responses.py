"""Line responses: the light of particles as waves, against images of waves that are propagated whole."""

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.line_responses import PHASES, LineResponses
from lfpiv_cli.optics.media import Window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.optics.waves import Waves, WavesInCamera
from lfpiv_cli.particles.least_squares import respond_all, room_for
from lfpiv_cli.particles.view import Light, View, entry_capacity, raw_view
from tests.commands import WATER

PIXELS, GREEN_MM, DIFFUSION_PX = 240, 532e-6, 0.3
DEPTHS = (-0.5, 4.5)
SPACE = ObjectSpace(WATER, refraction="paraxial")
POINTS = ((0.02, 0.013, 4.0), (-0.03, 0.041, 1.7), (0.012, -0.024, 0.5))


def camera_of(turn_deg: float = 0.0) -> Camera:
    """Return Table 2's optics on a small sensor, the array turned."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    lattice = Lattice(np.array([0.011, -0.007]), 0.1 * np.array([[c, s], [-s, c]]), "square")
    return Camera(-1.0, 100.0, 25.0, 0.8, 0.8, lattice, 0.0055, PIXELS, PIXELS)


@pytest.fixture(scope="module")
def view() -> View:
    """Return the view of points of light as waves."""
    return raw_view(camera_of(), WATER, 0.0, None, SPACE, Light(GREEN_MM, DIFFUSION_PX, DEPTHS))


def response(view: View, point: tuple[float, float, float]) -> Floats:
    """Return the light and its derivatives (4, rows, columns) of a particle."""
    room = room_for(1, entry_capacity(view, *DEPTHS), 0)
    respond_all(view, np.array([[*point, 1.0]]), room)
    count = room.counts[0]
    found = np.zeros((4, PIXELS * PIXELS))
    assert len(set(room.pixels[0, :count])) == count, "a pixel is named twice"
    found[:, room.pixels[0, :count]] = room.values[0, :, :count]
    return found.reshape(4, PIXELS, PIXELS)


def by_waves(camera: Camera, points: Floats) -> Floats:
    """Return the light of points by waves that are propagated over the whole image."""
    image = np.zeros((PIXELS, PIXELS))
    patch = WavesInCamera(replace(camera, diffusion_px=DIFFUSION_PX), SPACE, Waves(GREEN_MM)).patch(points)
    assert patch is not None
    patch.add_to(image, 1.0)
    return image


@pytest.mark.thorough
@pytest.mark.parametrize("point", POINTS)
def test_light_is_that_of_waves(view: View, point: tuple[float, float, float]) -> None:
    whole = by_waves(camera_of(), np.array([point]))
    by_rays = raw_view(camera_of(), WATER, 0.0, None, SPACE)
    light = response(view, point)[0]
    # Pixels that get next to nothing are left out, and so are products beyond the first; the waves' own samples are
    # .007 off.
    assert 0.99 < light.sum() < 1.001
    assert np.abs(light - whole).sum() < 0.025
    assert np.abs(response(by_rays, point)[0] - whole).sum() > 10.0 * np.abs(light - whole).sum()


@pytest.mark.thorough
@pytest.mark.parametrize("point", POINTS)
def test_turned_array(point: tuple[float, float, float]) -> None:
    """Lenses of a column then lie at different places across, and their cells lean: both are taken to first order."""
    camera = camera_of(1.0)
    turned = raw_view(camera, WATER, 0.0, None, SPACE, Light(GREEN_MM, DIFFUSION_PX, DEPTHS))
    assert np.abs(response(turned, point)[0] - by_waves(camera, np.array([point]))).sum() < 0.028


@pytest.mark.thorough
@pytest.mark.parametrize("point", POINTS)
def test_derivatives_are_differences(view: View, point: tuple[float, float, float]) -> None:
    derivatives = response(view, point)[1:]
    for axis, step in enumerate((1e-4, 1e-4, 1e-3)):
        move = step * np.eye(3)[axis]
        ahead, behind = (response(view, tuple(np.array(point) + sign * move))[0] for sign in (1.0, -1.0))
        # Where both have the pixel: what is lit at all changes with the place.
        both = (ahead > 0.0) & (behind > 0.0)
        difference = (ahead - behind)[both] / (2.0 * step)
        assert np.abs(derivatives[axis][both] - difference).sum() < 0.02 * np.abs(difference).sum()


def _line(lines: LineResponses, offset: float, depth: float, u_px: float) -> Floats:
    """Return the response (terms,) at one place, read from the table as it is described."""
    table = np.asarray(lines.table, np.float64)

    def spline(t: float) -> Floats:  # weights of four coefficients of a cubic one, by B-splines about each
        away = np.abs(np.array([1.0, 0.0, -1.0, -2.0]) + t)
        return np.where(away < 1.0, 2.0 / 3.0 - away**2 + 0.5 * away**3, np.maximum(2.0 - away, 0.0) ** 3 / 6.0)

    places = (
        (depth - lines.first_depth_mm) / lines.depth_step_mm,
        offset / lines.offset_step_mm + 0.5 * (table.shape[1] - 1),
        (u_px + 0.5 * table.shape[4]) * PHASES,
    )
    (z, x, u), by = np.floor(places).astype(int), [spline(place % 1.0) for place in places]
    fine = table[z - 1 : z + 3, x - 1 : x + 3].transpose(0, 1, 4, 2, 3).reshape(4, 4, -1, table.shape[3])
    return np.asarray(np.einsum("a,b,c,abck->k", *by, fine[:, :, u - 1 : u + 3]))


@pytest.mark.thorough
def test_pixels_are_sums_of_products_of_lines(view: View) -> None:
    """The readable twin: one pixel at a time, the lens nearest to it."""
    point, camera = POINTS[1], camera_of()
    light, s_i = response(view, point)[0], camera.image_distance_mm
    spot = -s_i / (camera.focus_distance_mm + WATER.depth_ratio * point[2]) * np.array(point[:2])
    for row, column in np.argwhere(light > 0.05 * light.max())[::7]:
        on_sensor = camera.px_to_mm((column, row))
        lens = camera.lattice.points(camera.lattice.nearest(on_sensor / camera.micro_image_scale))
        u = (on_sensor - lens * camera.micro_image_scale) / camera.pixel_mm
        x, y = (_line(view.lines, spot[k] - lens[k], point[2], u[k]) for k in range(2))
        assert light[row, column] == pytest.approx(float(x * view.lines.signs @ y), rel=1e-3)


@pytest.mark.thorough
def test_ball_is_the_mean_of_its_points() -> None:
    radius, rng = 0.025, np.random.default_rng(4)
    balls = raw_view(camera_of(), WATER, radius, None, SPACE, Light(GREEN_MM, DIFFUSION_PX, DEPTHS))
    inside = rng.uniform(-radius, radius, (300, 3))
    inside = inside[np.linalg.norm(inside, axis=1) < radius]
    whole = by_waves(camera_of(), np.array(POINTS[0]) + inside)
    # Some 150 points' own scatter, and the corners of the product of two distributions.
    assert np.abs(response(balls, POINTS[0])[0] - whole).sum() < 0.09


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("distance_mm", "point", "depth_mm"), [(185.0, (6.0, 0.03, 3.0), 0.002), (100.0, (2.47, 0.23, 2.8), 0.003)]
)
def test_oblique_rays_are_bent_more(distance_mm: float, point: tuple[float, ...], depth_mm: float) -> None:
    """Far from the axis Snell's law shows a point nearer than on it, and aside; the first derivatives show how much.

    Behind 95 mm of water each place of the aperture shows it aside by another length.
    """
    exact = ObjectSpace(WATER, Window(distance_mm, 5.0), "exact")
    camera = replace(camera_of(), columns=2400)
    view = raw_view(camera, WATER, 0.0, None, exact, Light(GREEN_MM, DIFFUSION_PX, (2.5, 3.5)))
    patch = WavesInCamera(replace(camera, diffusion_px=DIFFUSION_PX), exact, Waves(GREEN_MM)).patch(np.array(point))
    whole = np.zeros((PIXELS, 2400))
    assert patch is not None
    patch.add_to(whole, 1.0)
    room = room_for(1, entry_capacity(view, 2.5, 3.5), 0)
    respond_all(view, np.array([[*point, 1.0]]), room)
    count = room.counts[0]
    light, by_z = np.zeros(PIXELS * 2400), np.zeros(PIXELS * 2400)
    light[room.pixels[0, :count]], by_z[room.pixels[0, :count]] = room.values[0, [0, 3], :count]
    left = whole.ravel() - light
    weight = 1.0 / (1e-5 + whole.ravel())
    # One step of a fit of depth alone: 0.007 mm without coma behind 1 cm of water.
    assert abs(np.sum(weight * by_z * left) / np.sum(weight * by_z**2)) < depth_mm
    assert np.abs(left).sum() < 0.025


def test_points_in_the_window_light_like_those_behind_it() -> None:
    # Depths are tried beyond the volume, which may begin at the window.
    camera, exact = camera_of(), ObjectSpace(WATER, Window(198.0, 5.0), "exact")
    front = -float(exact.layers(camera).thicknesses_mm[-1])
    view = raw_view(camera, WATER, 0.0, None, exact, Light(GREEN_MM, DIFFUSION_PX, (front - 0.6, front + 0.2)))
    within, behind = (response(view, (0.02, 0.013, front + off))[0] for off in (-0.5, 0.0))
    # The spline along the depth smooths the bend at the face: 1.5 % of the brightest pixel.
    np.testing.assert_allclose(within, behind, atol=0.02 * behind.max())
    assert behind.sum() == pytest.approx(1.0, abs=0.02)


def test_hexagons_are_refused() -> None:
    camera = replace(camera_of(), lattice=Lattice.regular(0.1, "hexagonal"))
    with pytest.raises(ConfigError, match="wavelength_nm"):
        raw_view(camera, WATER, 0.02, None, SPACE, Light(GREEN_MM, DIFFUSION_PX, DEPTHS))
