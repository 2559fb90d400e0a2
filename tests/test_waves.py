"""Light as waves: against a plain quadrature, Airy's disc, sinc², rays, mirrors; dots and corners by waves."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import j1

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.board import DotLook, disc_shape, locate_board
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.shape_fit import pixels_near
from lfpiv_cli.calibration.wave_shapes import WaveLight, WaveShapes, corner_strips, disc_strips
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics import waves
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, Window
from lfpiv_cli.optics.tracing import ObjectSpace, disc_points
from lfpiv_cli.optics.waves import DEGREE, Waves, WavesInCamera, pixel_response
from lfpiv_cli.synthetic.board import BoardPlacement, render_board, sunflower
from lfpiv_cli.synthetic.render import (
    Balls,
    enough_points,
    lens_blur_mm,
    lens_spread,
    points_in_ball,
    render_points,
    render_white,
)
from tests.commands import WATER
from tests.known_rays import tube_of

GREEN = Waves(532e-6)
# Four times as long: a hundredth of the work.
INFRARED = Waves(2128e-6)
NO_RAYS = np.random.default_rng(0)
AIR = ObjectSpace(Media(), None, "paraxial")


@pytest.fixture
def small(camera: Camera) -> Camera:
    """The middle of the camera, its array turned and shifted, with either kind of array."""
    lattice = Lattice.regular(0.1, camera.lattice.layout, 0.01, (0.013, -0.021))
    return replace(camera, columns=400, rows=400, lattice=lattice)


@pytest.fixture
def square(table2: Camera) -> Camera:
    return replace(table2, columns=400, rows=400)


def by_waves(camera: Camera, point: tuple[float, float, float], light: Waves = GREEN, space=AIR, diameter=0.0):
    return render_points(camera, space, Balls(np.array([point]), 1.0, diameter), NO_RAYS, waves=light)


def by_rays(camera: Camera, point: tuple[float, float, float], space=AIR, diameter=0.0, rays=400_000):
    return render_points(camera, space, Balls(np.array([point]), 1.0, diameter), np.random.default_rng(0), rays=rays)


def apart(a: Floats, b: Floats) -> float:
    """Return L1, the light of images of light 1 that lies elsewhere, twice."""
    return float(np.abs(a - b).sum())


def centre(image: Floats) -> Floats:
    row, column = np.indices(image.shape)
    return np.array([(image * column).sum(), (image * row).sum()]) / image.sum()


def per_lens(camera: Camera, image: Floats) -> Floats:
    """Return the light under each microlens."""
    pixels = np.stack(np.indices(image.shape)[::-1], axis=-1)
    index = camera.micro_image_lattice_px().nearest(pixels).reshape(-1, 2)
    _, lens = np.unique(index, axis=0, return_inverse=True)
    return np.bincount(lens.ravel(), image.ravel())


def quadrature(camera: Camera, point: tuple[float, float, float], wavelength: float, step: float, pupil_step: float):
    """Return the image of a point in air: both of Fresnel's integrals as plain sums, in coordinates about the axis.

    Nothing of it is periodic, and its samples (mm) lie anywhere on the pixels. From the array to the sensor light goes
    so far sideways as the samples follow it; the integral ends softly there.
    """
    x0, y0, z = point
    k, s_i, s_mu = 2.0 * np.pi / wavelength, camera.image_distance_mm, camera.microlens_distance_mm
    s_o, radius = camera.focus_distance_mm + z, camera.aperture_radius_mm
    pupil = np.arange(-radius - pupil_step, radius + 2 * pupil_step, pupil_step)
    X, Y = np.meshgrid(pupil, pupil)
    amplitude = np.clip((radius - np.hypot(X, Y)) / pupil_step + 0.5, 0.0, 1.0)
    path = ((X - x0) ** 2 + (Y - y0) ** 2) / (2 * s_o) - (X**2 + Y**2) / (2 * camera.focal_length_mm)
    wave = amplitude * np.exp(1j * k * (path + (X**2 + Y**2) / (2 * s_i)))
    half = 0.07 * abs(z) + 0.5
    x, y = (np.arange(-half, half, step) - at * s_i / s_o for at in (x0, y0))

    def to_array(place: Floats) -> NDArray[np.complex128]:
        return np.exp(-1j * k * np.outer(place, pupil) / s_i) * np.exp(1j * k * place**2 / (2 * s_i))[:, np.newaxis]

    places = np.stack(np.meshgrid(x, y), axis=-1)
    off = places - camera.lattice.points(camera.lattice.nearest(places))
    lenses = np.exp(-1j * k * np.sum(off**2, axis=-1) / (2 * camera.microlens_focal_length_mm))
    field = (to_array(y) @ wave @ to_array(x).T) * lenses
    samples = 6
    fine = (np.arange(samples * camera.columns) + 0.5) / samples - 0.5
    on_sensor = camera.px_to_mm(np.stack([fine, fine], axis=-1))
    reach = wavelength * s_mu / step

    def to_sensor(there: Floats, here: Floats) -> NDArray[np.complex128]:
        beside = there[:, np.newaxis] - here
        soft = np.cos(0.5 * np.pi * np.clip((np.abs(beside) / reach - 0.35) / 0.1, 0.0, 1.0)) ** 2
        return soft * np.exp(1j * k * beside**2 / (2 * s_mu))

    light = np.abs(to_sensor(on_sensor[:, 1], y) @ field @ to_sensor(on_sensor[:, 0], x).T) ** 2
    size = (step**2 * pupil_step**2 / (wavelength**2 * s_i * s_mu)) ** 2
    light *= size * (camera.pixel_mm / samples) ** 2 / (np.sum(amplitude**2) * pupil_step**2)
    return light.reshape(camera.rows, samples, camera.columns, samples).sum(axis=(1, 3))


@pytest.mark.thorough
@pytest.mark.parametrize(("light", "z"), [(INFRARED, 0.0), (INFRARED, 4.0), (GREEN, 0.3), (GREEN, 1.0), (GREEN, 4.0)])
def test_waves_are_those_of_a_plain_quadrature(small: Camera, light: Waves, z: float) -> None:
    """Five samples a pixel are within .01 of eleven on squares; `quadrature` itself within .004 of these."""
    camera, point = replace(small, columns=220, rows=220), (0.083, -0.041, z)
    steps = (0.0055 / 9.3, 0.045) if light is GREEN else (0.0055 / 3.3, 0.12)
    expected = quadrature(camera, point, light.wavelength_mm, *steps)
    # at the infrared's wavelength two samples lie on a pixel, and lenses diffract beyond the window
    assert apart(by_waves(camera, point, light), expected) < (0.02 if light is GREEN else 0.05)
    if light is INFRARED:
        assert apart(by_rays(camera, point), expected) > 0.3


def test_main_lens_makes_airys_disc_and_one_lens_a_sinc(square: Camera, monkeypatch: pytest.MonkeyPatch) -> None:
    # On a sensor right behind an array without power: (2 J1(v) / v)², v = k R r / s_i.
    monkeypatch.setattr(waves, "MARGIN_PITCHES", 3.0)
    no_lenses = {"microlens_focal_length_mm": 1e6, "microlens_distance_mm": 1e-6}
    bare = replace(square, pixel_mm=0.001, columns=401, rows=401, **no_lenses)
    found = by_waves(bare, (0.0, 0.0, 0.0))
    mm = bare.px_to_mm(np.stack(np.indices(found.shape)[::-1], axis=-1))
    v = 2 * np.pi / GREEN.wavelength_mm * 12.5 / 200.0 * np.hypot(mm[..., 0], mm[..., 1]) + 1e-9
    peak = np.pi * (12.5 * bare.pixel_mm / (GREEN.wavelength_mm * 200.0)) ** 2
    # samples of the intensity itself; 0.4 % of the light falls beyond the window, and is made up for within it
    assert np.abs(found - peak * (2.0 * j1(v) / v) ** 2).max() < 5e-3 * peak
    focused = replace(square, microlens_focal_length_mm=1.0 / (1.0 / 0.8 + 1.0 / 200.0))
    beside = 0.0005 * np.arange(-400, 400)
    found = lens_spread(focused, GREEN, beside)
    along = np.sinc(0.1 * beside / (GREEN.wavelength_mm * 0.8)) ** 2 * 0.0005 * 0.1 / (GREEN.wavelength_mm * 0.8)
    # 0.6 % of the light falls beyond these samples
    assert np.abs(found - np.outer(along, along)).max() < 8e-3 * found.max()


@pytest.mark.parametrize("diffusion_px", [0.0, 0.3])
def test_energy_is_conserved(small: Camera, diffusion_px: float) -> None:
    camera = replace(small, diffusion_px=diffusion_px)
    for point in [(0.1, -0.05, 3.0), (-0.2, 0.1, 0.0), (0.3, 0.2, -2.0)]:
        image = by_waves(camera, point, diameter=0.05)
        assert image.sum() == pytest.approx(1.0, abs=2e-4)


def test_sensors_mirrors_and_axes(small: Camera) -> None:
    point = (0.35, -0.3, 3.0)
    whole, part = by_waves(small, point), by_waves(replace(small, columns=120, rows=140), point)
    assert 0.1 < part.sum() < 0.9
    assert np.array_equal(part, whole[130:270, 140:260])
    assert WavesInCamera(replace(small, columns=60, rows=60), AIR, GREEN).patch([[1.5, 0.0, 1.0]]) is None
    along_x = by_waves(small, (0.2, -0.05, 2.0))
    along_y = by_waves(replace(small, column_axis="y"), (-0.05, 0.2, 2.0))
    assert np.array_equal(along_x, along_y)


def test_mirrored_points_make_mirrored_images_and_charge_diffuses(square: Camera) -> None:
    point = (0.113, -0.287, 2.0)
    images = [by_waves(square, (sign * point[0], *point[1:])) for sign in (1, -1)]
    # the window may lie a pixel elsewhere, and what goes beyond it returns elsewhere
    assert apart(images[1][:, ::-1], images[0]) < 1e-3
    turned = by_waves(square, (point[1], point[0], point[2]))
    assert apart(turned.T, images[0]) < 1e-3
    for diffusion in (0.0, 0.1, 0.3, 1.0):
        response = pixel_response(5, diffusion)
        assert response.size % 2 == 1
        # of one sample's charge, over the pixels that lie a whole number of pixels from it
        of_sample = [response[first::5].sum() for first in range(5)]
        assert of_sample == pytest.approx(np.ones(5), abs=1e-6)
    sharp, blurred = (by_waves(replace(square, diffusion_px=px), (0.0, 0.0, 1.0)) for px in (0.0, 0.8))
    variance = []
    for image in (sharp, blurred):
        column = np.arange(image.shape[1]) - centre(image)[0]
        variance.append((image.sum(axis=0) * column**2).sum())
    assert variance[1] - variance[0] == pytest.approx(0.64, abs=0.02)


@pytest.mark.thorough
@pytest.mark.parametrize("z", [1.0, 4.0])
def test_ever_shorter_waves_approach_rays(small: Camera, z: float) -> None:
    point = (0.083, -0.041, z)
    rays = by_rays(small, point, rays=4_000_000)
    found = [apart(by_waves(small, point, Waves(532e-6 / part)), rays) for part in (1, 2, 4, 8)]
    assert np.all(np.diff(found) < -0.02), found
    assert found[-1] < 0.5 * found[0], found


@pytest.mark.thorough
def test_rays_and_waves_differ_as_measured_elsewhere(square: Camera) -> None:
    """Of another program, points and a sphere of .05 mm: .48 .35 .08 at 4, 1, .3 mm, and .34 .16 at 4, 1 mm."""
    places = [(0.0, 0.0), (0.21, -0.13), (0.32, 0.11)]  # near focus within one lens: on an edge it is .6
    for z, diameter, expected in [(4.0, 0, 0.48), (1.0, 0, 0.35), (0.3, 0, 0.09), (4.0, 0.05, 0.34), (1.0, 0.05, 0.15)]:
        found, lenses, moved = [], [], []
        for place in places:
            image = by_waves(square, (*place, z), diameter=diameter)
            rays = by_rays(square, (*place, z), diameter=diameter, rays=2_000_000)
            found.append(apart(image, rays))
            lenses.append(np.abs(per_lens(square, image) - per_lens(square, rays)).sum())
            moved.append(centre(image) - centre(rays))
        # a point's light changes with its place within a microlens
        assert np.mean(found) == pytest.approx(expected, abs=0.06), (z, found)
        assert np.mean(lenses) < 0.08, (z, lenses)
        assert np.abs(moved).max() < (0.2 if diameter else 0.5), (z, moved)


@pytest.mark.thorough
@pytest.mark.parametrize("distortion", [0.0, 1e-3])
def test_light_lies_where_rays_end(table2: Camera, distortion: float) -> None:
    """Far off the axis, behind a window: the phase has the refracted and distorted rays for normals."""
    camera = replace(table2, distortion_per_mm2=distortion)
    point, space = (3.1, -2.2, 3.0), ObjectSpace(WATER, Window(98.0, 2.0), "exact")
    found, rays = by_waves(camera, point, space=space), by_rays(camera, point, space)
    # the distortion moves them by 10 pixels; fringes by a tenth of one
    assert centre(found) == pytest.approx(centre(rays), abs=0.3)
    assert apart(found, rays) < 0.6


@pytest.mark.parametrize("point", [(0.1, 0.3, 0.5), (0.0, 2.5, 2.0), (0.4, -3.5, -2.0)])
def test_phase_through_a_tube_has_the_rays_for_normals(table2: Camera, point: tuple[float, float, float]) -> None:
    seen = WavesInCamera(table2, tube_of(WATER), GREEN)
    array, lit = seen._rays(np.array(point))  # noqa: SLF001
    middle = array.mean(axis=0)
    phase = seen._phase(array - middle, lit)  # noqa: SLF001
    crossing = disc_points(200, 1.0, np.random.default_rng(0))
    slopes, _ = tube_of(WATER).slopes(table2, np.tile(point, (200, 1)), 12.5 * crossing)
    exact = 12.5 * crossing + 200.0 * (slopes - 12.5 * crossing / 100.0) - middle
    power = np.arange(DEGREE + 1)
    x, y = (crossing[:, [axis]] ** power for axis in (0, 1))
    steeper = [power * crossing[:, [axis]] ** np.maximum(power - 1, 0) for axis in (0, 1)]
    scale = 200.0 / (12.5 * 2 * np.pi / GREEN.wavelength_mm)
    terms = (y, phase, steeper[0]), (steeper[1], phase, x)
    found = scale * np.stack([np.einsum("nj,ji,ni->n", *each) for each in terms], axis=-1)
    # a tenth of a micrometre is a fiftieth of the main lens's own diffraction
    assert np.abs(found - exact).max() < 1e-4


@pytest.mark.thorough
def test_what_a_wall_hides_is_dark(table2: Camera) -> None:
    """Behind a thin wall light from near the rim is totally reflected, from some points a part of it."""
    camera, thin, rays = replace(table2, columns=400, rows=2352), tube_of(WATER, outer_mm=5.5), []
    for y in (3.2, 3.3, 3.4):
        rays.append(by_rays(camera, (0.0, y, 2.5), thin, rays=20_000).sum())
        assert by_waves(camera, (0.0, y, 2.5), space=thin).sum() == pytest.approx(rays[-1], abs=0.02)
    assert rays[0] == pytest.approx(1.0)
    assert 0.05 < rays[1] < 0.95
    assert rays[2] == 0.0


@pytest.mark.parametrize("count", [3, 16, 25])
def test_points_of_a_ball_spread_as_its_glow(count: int) -> None:
    points = points_in_ball(count)
    assert points.mean(axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    assert points.T @ points / count == pytest.approx(np.diag([0.2, 0.2, 0.0]), abs=1e-12)
    assert np.linalg.norm(points, axis=1).max() < 1.1


@pytest.mark.thorough
def test_a_ball_has_as_many_points_as_are_not_resolved(square: Camera) -> None:
    """By the L1 norm 0.5 % of their light is elsewhere, of as few as half the width has twice that."""
    assert enough_points(square, GREEN, 0.05) == 62
    assert enough_points(square, GREEN, 0.1) == pytest.approx(4 * 62, abs=3)
    assert enough_points(square, GREEN, 0.001) == enough_points(square, GREEN, 0.02) == 16
    for z in (0.3, 1.0, 4.0):
        light = [replace(GREEN, points=points) for points in (None, 16, 250)]
        by_default, few, many = (by_waves(square, (0.21, -0.13, z), each, diameter=0.05) for each in light)
        assert apart(by_default, many) < min(0.005, 0.5 * apart(few, many))


def test_same_bits_for_any_number_of_threads(small: Camera, rng: np.random.Generator, one_thread) -> None:
    balls = Balls(rng.uniform(-0.4, 0.4, (7, 3)), rng.uniform(1.0, 2.0, 7), 0.05)
    done: list[int] = []
    image = render_points(small, AIR, balls, NO_RAYS, waves=Waves(2e-3, 5), progress=done.append)
    assert sum(done) == 7
    with one_thread():
        assert np.array_equal(render_points(small, AIR, balls, NO_RAYS, waves=Waves(2e-3, 5)), image)


def test_white_light_is_that_of_each_place_on_the_aperture(square: Camera) -> None:
    """Places of the aperture glow independently; each lights all lenses at once, whose fields interfere."""
    camera, wavelength = replace(square, columns=29, rows=29), INFRARED.wavelength_mm
    k, s_i, s_mu, step = 2 * np.pi / wavelength, 200.0, 0.8, 0.0055 / 6
    x = np.arange(-0.25, 0.25, step) + 0.5 * step
    lens = np.exp(-1j * k * (x - 0.1 * np.rint(x / 0.1)) ** 2 / (2 * 0.8))
    fine = ((np.arange(29 * 6) + 0.5) / 6 - 0.5 - 14.0) * 0.0055
    beside, reach = fine[:, np.newaxis] - x, wavelength * s_mu / step
    soft = np.cos(0.5 * np.pi * np.clip((np.abs(beside) / reach - 0.35) / 0.1, 0.0, 1.0)) ** 2
    pupil = np.arange(-12.7, 12.71, 0.1)
    incident = lens[:, np.newaxis] * np.exp(1j * k * (x[:, np.newaxis] - pupil) ** 2 / (2 * s_i))
    field = (soft * np.exp(1j * k * beside**2 / (2 * s_mu))) @ incident * step
    along = (np.abs(field) ** 2).reshape(29, 6, -1).sum(axis=1) * (0.0055 / 6) / (wavelength * s_mu)
    disc = np.clip((12.5 - np.hypot(pupil[:, np.newaxis], pupil)) / 0.1 + 0.5, 0.0, 1.0)
    expected = along @ disc @ along.T * (0.1 / (0.0055 * s_i / s_mu * 0.1)) ** 2
    found = render_white(camera, 1.0, waves=INFRARED)
    # of what reaches a pixel through two lenses, some per cent interferes with waves of 2 um (0.3 % with green light)
    assert np.abs(found - expected).mean() < 0.02
    assert np.abs(found - expected).mean() < 0.2 * np.abs(render_white(camera, 1.0) - expected).mean()


@pytest.mark.thorough
def test_white_light_of_short_waves_is_that_of_rays_and_diffuses_alike(small: Camera) -> None:
    camera = replace(small, columns=60, rows=50)
    sharp = render_white(camera, 1.0, 16)
    found = [np.abs(render_white(camera, 1.0, waves=Waves(532e-6 / part)) - sharp).mean() for part in (1, 3)]
    assert found[1] < 0.5 * found[0] < 0.03
    camera = replace(camera, diffusion_px=0.5)
    blurred = render_white(camera, 1.0, waves=Waves(532e-6 / 3))
    # sixteen places of a pixel along each axis, and what is left of the waves' own blur
    assert np.abs(blurred - render_white(camera, 1.0)).mean() < 0.01
    assert np.abs(blurred - sharp).mean() > 0.03


@pytest.mark.thorough
def test_rays_with_a_lens_blur_are_half_of_the_way_to_a_dot_by_waves(square: Camera) -> None:
    """For prints, which are not made of points: figures of `lens_blur_mm`."""
    for z, plain, blurred in [(0.3, 0.06, 0.034), (2.2, 0.11, 0.057), (4.0, 0.15, 0.077)]:
        points = np.array([0.21, -0.13, z]) + np.column_stack([sunflower(256, 0.1), np.zeros(256)])
        dot = render_points(square, AIR, Balls(points, 1 / 256, 0.0), NO_RAYS, waves=GREEN)
        balls = Balls(points, 1 / 256, 0.2 / 16)
        rng = np.random.default_rng(0)
        assert apart(render_points(square, AIR, balls, rng, rays=20_000), dot) == pytest.approx(plain, abs=0.015)
        rays = render_points(square, AIR, balls, rng, rays=20_000, blur_mm=lens_blur_mm(square, GREEN))
        assert apart(rays, dot) == pytest.approx(blurred, abs=0.012)
        assert centre(rays) == pytest.approx(centre(dot), abs=0.03)


LIGHT = WaveLight(532e-6, 0.3)
PLACE = np.array([0.13, 0.07, 0.3])
BOARD = BoardGeometry((1, 1), 0.6, 0.2)
RADIUS = 0.5 * BOARD.dot_diameter_mm


@pytest.fixture(scope="module")
def near_camera() -> Camera:
    """Table 2's optics before a small sensor."""
    return Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1, "square"), 0.0055, 160, 150, diffusion_px=0.3)


@pytest.fixture(scope="module")
def shapes(near_camera: Camera) -> WaveShapes:
    """Shapes at the depth of the dot."""
    return WaveShapes.of(near_camera, Media(), LIGHT, np.array([PLACE[2]]))


@pytest.fixture(scope="module")
def picture(near_camera: Camera) -> tuple[Floats, Singles]:
    """A dot's light and that of a white image."""
    light = Waves(LIGHT.wavelength_mm)
    place = BoardPlacement(0.3, (0.13, 0.07))
    seen = render_board(near_camera, ObjectSpace(Media()), BOARD, place, 1.0, np.random.default_rng(1), waves=light)
    return seen, render_white(near_camera, 1.0, waves=light).astype(np.float32)


@pytest.mark.thorough
def test_a_dot_by_waves_is_in_place(near_camera: Camera, shapes: WaveShapes, picture: tuple[Floats, Singles]) -> None:
    """By rays it does not: near focus its light comes through few lenses, of which some are lit in part."""
    look, start = DotLook(*picture, Media(), RADIUS, PLACE[np.newaxis, :2], PLACE[2]), PLACE + (0.004, -0.004, 0.02)
    by_rays, by_waves = (look.fitted(start, near_camera, BOARD, disc_shape(RADIUS), light) for light in (None, shapes))
    assert by_rays is not None
    assert by_waves is not None
    # A dot of 256 points, 1 % of whose light is astray, is known to some 3 um of depth.
    assert np.all(np.abs(by_waves.position_mm - PLACE) < (3e-4, 3e-4, 5e-3))
    assert abs(by_rays.position_mm[2] - PLACE[2]) > 0.015
    assert by_waves.brightness == pytest.approx(1.0, abs=0.02)


def test_a_disc_that_fills_the_scene_is_uniform_light(near_camera: Camera, shapes: WaveShapes) -> None:
    # Its share is 1 of every pixel, whatever the depth: what reaches a pixel comes from within a few lenses.
    dark = np.zeros((near_camera.rows, near_camera.columns))
    near = pixels_near((dark, dark.astype(np.float32) + 1.0), near_camera, Media(), PLACE, 0.2, 10_000)
    assert near is not None
    shares = shapes.shares(near.rays, PLACE, disc_strips(1.0, shapes.lens_mm))
    np.testing.assert_allclose(shares, 1.0, atol=2e-3)
    # Line responses are of square cells.
    hexagonal = replace(near_camera, lattice=Lattice.regular(0.1, "hexagonal"))
    with pytest.raises(ConfigError, match="wavelength_nm"):
        locate_board(np.ones((150, 160), np.float32), hexagonal, BOARD, Media(), light=LIGHT)
    # And its mean square along both axes, a quarter of the radius's, to the square of the strips' distance.
    begin, end, aside, width = disc_strips(0.1, 0.1)
    area = np.sum((end - begin) * width)
    assert area == pytest.approx(np.pi * 0.1**2, rel=1e-3)
    assert np.sum((end**3 - begin**3) / 3.0 * width) / area == pytest.approx(0.1**2 / 4.0, rel=2e-3)
    assert np.sum((end - begin) * width * aside**2) / area == pytest.approx(0.1**2 / 4.0, rel=2e-3)


@pytest.mark.parametrize("turn_deg", [0.0, 0.4, -25.0, 45.0, 80.0])
def test_corners_are_two_squares(turn_deg: float) -> None:
    """Within a square's side of the corner a strip holds what lies in either quadrant, and no more."""
    turn = np.deg2rad(turn_deg)
    edges = 0.6 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    strips = corner_strips(edges, 0.1)
    points = np.random.default_rng(3).uniform(-0.4, 0.4, (500, 2))
    inside = np.prod(points @ np.linalg.inv(edges), axis=1) > 0.0
    # Which points lie on the strip nearest to them.
    near = np.abs(strips.aside_mm - points[:, 1:]) <= 0.5 * strips.width_mm
    held = np.any(near & (strips.begin_mm <= points[:, :1]) & (points[:, :1] < strips.end_mm), axis=1)
    assert np.mean(held == inside) > 0.98
