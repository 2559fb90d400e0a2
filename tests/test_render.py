"""The renderer against the readable tracer, what a sensor makes of it, and boards by hand and as rigid plates."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Layers, Media, Window, fluid_path_to_focus
from lfpiv_cli.optics.tracing import (
    SLOPE_NODES,
    ObjectSpace,
    disc_points,
    exact_slope,
    set_slope_polynomial,
    slope_ratio,
    trace,
)
from lfpiv_cli.synthetic import render
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres, render_board
from lfpiv_cli.synthetic.rays import in_ball
from lfpiv_cli.synthetic.render import Balls, Readout, pixel_places, render_points, render_white
from tests.known_rays import image_of, slopes_equivalent, slopes_exact


@pytest.fixture
def small(camera):
    """A corner of the camera, its array turned, shifted and distorted, with either kind of array."""
    lattice = Lattice.regular(0.1, camera.lattice.layout, 0.01, (0.013, -0.021))
    return replace(camera, columns=150, rows=120, lattice=lattice, distortion_per_mm2=1e-3)


@pytest.fixture(params=["paraxial", "exact"])
def space(request, media, window):
    return ObjectSpace(media, window, request.param)


def test_renderer_equals_the_readable_tracer(small, space, rng):
    points = np.array([[0.05, -0.1, 3.0], [-0.2, 0.1, -4.0]])
    light, rays, diameters = np.array([1.0, 3.0]), 400, np.array([0.05, 0.2])
    found = render_points(small, space, Balls(points, light, diameters), np.random.default_rng(5), rays=rays)

    expected = np.zeros_like(found)
    shifts = np.random.default_rng(5).random((2, 4))
    for point, brightness, diameter, shift in zip(points, light, diameters, shifts, strict=True):
        a, b, c, d = ((shift + np.arange(rays)[:, np.newaxis] * render.SEQUENCE) % 1.0).T
        lens = 12.5 * np.sqrt(a)[:, np.newaxis] * np.stack([np.cos(2 * np.pi * b), np.sin(2 * np.pi * b)], axis=1)
        r = 0.5 * diameter * np.sqrt(1 - c ** (2 / 3))
        starts = point + np.stack([r * np.cos(2 * np.pi * d), r * np.sin(2 * np.pi * d), 0 * r], axis=1)
        if space.refraction == "exact":
            slopes = slopes_exact(starts, lens, small, space.media, space.window)
        else:
            slopes = slopes_equivalent(starts, lens, small, space.media)
        expected += image_of(small, trace(small, lens, slopes).sensor_mm, brightness / rays)
    assert found.sum() > 3.8  # some rays miss the small sensor
    # a ray on the edge of a pixel may fall on either side: none is expected among 800
    assert np.abs(found - expected).sum() < 1e-9


def test_column_axis_is_applied_once_and_light_off_the_sensor_is_lost(small, space, rng):
    point = np.array([[0.2, -0.05, 2.0]])
    along_x = render_points(small, space, Balls(point, 1.0, 0.05), np.random.default_rng(1), rays=100)
    turned = replace(small, column_axis="y")
    along_y = render_points(turned, space, Balls(point[:, [1, 0, 2]], 1.0, 0.05), np.random.default_rng(1), rays=100)
    assert np.array_equal(along_x, along_y)
    inside, beyond = np.array([[0.0, 0.0, 1.0]]), np.array([[3.0, 0.0, 1.0]])
    assert render_points(small, space, Balls(inside, 7.0, 0.0), rng, rays=1000).sum() == pytest.approx(7.0)
    assert render_points(small, space, Balls(beyond, 7.0, 0.0), rng, rays=1000).sum() == 0.0
    assert render_points(small, space, Balls(np.empty((0, 3)), 1.0, 0.05), rng).sum() == 0.0


def test_balls_and_pixels_are_sampled_evenly_and_slopes_obey_snell(rng):
    points = np.array([in_ball(2.0, *u) for u in rng.random((20000, 2))])
    assert np.hypot(*points.T).max() <= 2.0
    # 0.8 +- 0.8 sqrt(8/7)/sqrt(20000): three standard deviations are 0.02
    assert np.mean(points**2, axis=0) == pytest.approx([0.8, 0.8], abs=0.02)
    assert np.array_equal(pixel_places(8, 0.0), (np.arange(8) + 0.5) / 8 - 0.5)
    places = pixel_places(400, 0.5)
    # the variances of the pixel and of the Gaussian; the outermost places stand for what lies beyond them
    assert places.var() == pytest.approx(1.0 / 12.0 + 0.25, rel=0.01)
    assert places == pytest.approx(-places[::-1], abs=1e-9)
    layers, indices = np.array([98.0, 2.0, 140.0]), np.array([1.0, 1.49, 1.33])
    shallower = Layers(np.array([98.0, 2.0, 100.0]), indices)
    nodes, factors = np.empty((2, SLOPE_NODES))
    for reach in (20.0, 70.0):  # f/4 and a corner; f/1.4
        set_slope_polynomial(reach, shallower, 40.0, nodes, factors)
        for lateral in np.linspace(0.01, 1.0, 50) * reach:
            exact = exact_slope(lateral, 0.0, layers, indices)[0]
            found = lateral * slope_ratio(lateral**2, nodes, factors)
            assert found == pytest.approx(exact, rel=1e-7 * (reach / 70) ** 8)


def test_same_bits_for_any_number_of_threads_and_any_batch(small, space, rng, monkeypatch, one_thread):
    points = rng.uniform(-0.2, 0.2, (7, 3))

    def picture():
        return render_points(small, space, Balls(points, 1.0, 0.05), np.random.default_rng(3), rays=500)

    expected = picture()
    with one_thread():
        assert np.array_equal(picture(), expected)
    monkeypatch.setattr(render, "RAYS_AT_ONCE", 1000)
    assert np.array_equal(picture(), expected)
    done = []
    render_points(small, space, Balls(points, 1.0, 0.05), rng, rays=500, progress=done.append)
    assert sum(done) == 7


def test_windows_that_are_needed_or_ignored(small, water, rng):
    with pytest.raises(ConfigError, match=r"1\.33 needs a window"):
        render_points(small, ObjectSpace(water, None, "exact"), Balls(np.zeros((1, 3)), 1.0, 0.05), rng)
    window = Window(195.0, 1.0)
    path = fluid_path_to_focus(window, small.focus_distance_mm, water)
    with pytest.raises(ConfigError, match="in front of the fluid"):
        render_points(small, ObjectSpace(water, window), Balls(np.array([[0, 0, -path - 0.5]]), 1.0, 0.05), rng)
    thicknesses, indices = ObjectSpace(water, Window(50.0, 9.0), "paraxial").layers(small)
    assert (thicknesses.tolist(), indices.tolist()) == ([200.0], [1.0])
    assert ObjectSpace(Media()).layers(small)[0].tolist() == [200.0]


@pytest.mark.thorough
@pytest.mark.parametrize("microlens_distance", [0.8, 0.7])
def test_white_light_backwards_equals_forwards(small: Camera, rng: np.random.Generator, microlens_distance) -> None:
    """Rays from points evenly on the aperture to points evenly on the array, against the backward count."""
    camera = replace(small, distortion_per_mm2=0.0, microlens_distance_mm=microlens_distance, columns=60, rows=50)
    count, area = 500_000, (0.7, 0.6)
    lens = disc_points(count, camera.aperture_radius_mm, rng)
    array = (rng.random((count, 2)) - 0.5) * area
    hits = trace(camera, lens, (array - lens) / camera.image_distance_mm + lens / camera.focal_length_mm)
    # a fully lit pixel is the image of (pixel s_i/s_mu)^2 of the aperture through one cell of the array
    share = (camera.pixel_mm * camera.image_distance_mm / microlens_distance / 12.5) ** 2 / np.pi
    per_pixel = count * share * 0.01 * abs(np.linalg.det(camera.lattice.basis / 0.1)) / (area[0] * area[1])
    forwards = image_of(camera, hits.sensor_mm, 1.0 / per_pixel)
    difference = forwards - render_white(camera, 1.0)
    # noise of per_pixel (some 50) rays on lit pixels, 64 samples on the micro-images' edges; no bias
    assert np.sqrt(np.mean(difference**2)) < 1.3 / np.sqrt(per_pixel)
    assert abs(difference.mean()) < 0.003


def test_white_light_centres_micro_images_on_their_lattice_and_shows_no_distortion(small):
    camera = replace(small, aperture_mm=10.0)  # stopped down: round spots apart from each other
    image = render_white(camera, 1000.0)
    lattice = camera.micro_image_lattice_px()
    row, column = np.indices(image.shape)
    pixels = np.stack([column, row], axis=-1)
    owner = lattice.nearest(pixels)
    for index in [(0, 0), (1, 0), (0, -1)]:
        mine = np.all(owner == index, axis=-1)
        centre = (pixels[mine] * image[mine][:, np.newaxis]).sum(axis=0) / image[mine].sum()
        # the grid's share of each of 25 pixels on the edge
        assert centre == pytest.approx(lattice.points(index), abs=0.01)
    assert image.max() == pytest.approx(1000.0)
    assert np.array_equal(render_white(small, 1.0, 2), render_white(replace(small, distortion_per_mm2=0.0), 1.0, 2))


@pytest.mark.parametrize("point", [(0.05, -0.1, 1.0), (0.0, 0.03, 0.0)])
def test_charge_diffuses_as_a_gaussian(small, media, window, rng, point):
    """Rays on a sensor of eight times as many pixels, and the Gaussian on these."""
    camera, space, fine = replace(small, diffusion_px=0.5), ObjectSpace(media, window), 8
    finer = replace(small, pixel_mm=small.pixel_mm / fine, columns=fine * small.columns, rows=fine * small.rows)
    ball = Balls(np.array([point]), 1.0, 0.01)
    found = render_points(camera, space, ball, rng, rays=100_000)
    expected = gaussian_filter(render_points(finer, space, ball, rng, rays=100_000), 0.5 * fine, mode="constant")
    expected = expected.reshape(small.rows, fine, small.columns, fine).sum(axis=(1, 3))
    assert found.sum() == pytest.approx(1.0, abs=1e-3)
    # of 100,000 rays on some 300 pixels
    sharp = render_points(small, space, ball, rng, rays=100_000)
    assert np.abs(found - expected).sum() < 0.05
    assert np.abs(found - expected).sum() < 0.6 * np.abs(sharp - expected).sum()
    row, column = np.indices(found.shape)
    for axis in (row, column):
        # places on either side of a ray's end are as many
        assert (found * axis).sum() == pytest.approx((expected * axis).sum(), abs=0.03)


@pytest.mark.parametrize("photons_per_count", [0.5, 4.0])
def test_mean_and_variance(rng, photons_per_count):
    recorded = Readout(photons_per_count, 6.0, 96.0).record(np.full(40_000, 500.0), rng)
    # shot noise: counts / photons per count; read noise 6^2; rounding 1/12
    variance = 500.0 / photons_per_count + 36.0 + 1 / 12
    assert recorded.mean() == pytest.approx(596.0, abs=4 * np.sqrt(variance / 40_000))
    assert recorded.var() == pytest.approx(variance, rel=4 * np.sqrt(2 / 40_000))


@pytest.mark.parametrize(("bits", "top"), [(12, 4095), (16, 65535)])
def test_counts_end_at_the_bits(rng, bits, top):
    readout = Readout(None, 0.0, 0.0, bits)
    recorded = readout.record(np.array([0.0, 0.4, 0.6, top - 0.6, top + 10.0, 1e9]), rng)
    assert recorded.tolist() == [0, 0, 1, top - 1, top, top]
    assert recorded.dtype == np.uint16


def test_noise_is_below_zero_clipped_and_decided_by_its_seed(rng):
    assert Readout(None, 50.0, 0.0).record(np.zeros(1000), rng).max() < 400
    expected = np.linspace(0, 100, 50)
    first, second = (Readout().record(expected, np.random.default_rng(8)) for _ in range(2))
    assert np.array_equal(first, second)
    dark = Readout(0.5, 6.0, 96.0).record(np.zeros(40_000), rng)
    assert (dark.mean(), dark.std()) == (pytest.approx(96.0, abs=0.15), pytest.approx(6.0, abs=0.1))


BOARD = BoardGeometry(dots=(3, 2), spacing_mm=1.0, dot_diameter_mm=0.2)
AIR = ObjectSpace(Media())


def test_boards_by_hand_and_as_rigid_plates(rng):
    found = dot_centres(BOARD, BoardPlacement(-0.35, (0.13, -0.07)))
    assert found == pytest.approx(np.array([(x + 0.13, y - 0.07, -0.35) for y in (-0.5, 0.5) for x in (-1, 0, 1)]))
    first, second = dot_centres(replace(BOARD, dots=(2, 1)), BoardPlacement(0.0, rotation_deg=30.0))
    assert second - first == pytest.approx([np.sqrt(0.75), 0.5, 0.0])
    placement = BoardPlacement(0.5, (0.2, 0.1), (12.0, -7.0), 20.0)
    dots = dot_centres(BOARD, placement)
    x, y = (dots[:, :2] - placement.offset_mm).T
    assert dots[:, 2] == pytest.approx(0.5 + np.tan(np.deg2rad(12.0)) * x - np.tan(np.deg2rad(7.0)) * y)
    plate = rng.uniform(-3, 3, (10, 2))
    moved = placement.to_world(plate)
    distances = np.linalg.norm(moved[:, np.newaxis] - moved, axis=2)
    assert distances == pytest.approx(np.linalg.norm(plate[:, np.newaxis] - plate, axis=2))


@pytest.mark.thorough
def test_a_wide_dot_is_as_bright_as_white_light(camera, rng):
    """Where a dot fills the field of a lens, its pixels are those of a white image of the same level."""
    camera = replace(camera, columns=90, rows=90)
    dot = BoardGeometry((1, 1), 1.0, 1.6)
    for z in (0.0, 2.0):
        image = render_board(camera, AIR, dot, BoardPlacement(z), 1000.0, rng)
        white = render_white(camera, 1000.0)
        lit = white > 999.0
        # rays: a million on 50,000 pixels' worth of light, 20 to a pixel of the mean of a thousand pixels
        assert image[lit].mean() == pytest.approx(1000.0, rel=0.01), z


@pytest.mark.thorough
def test_a_dark_dot_is_what_a_bright_one_leaves_of_white_light(camera):
    camera = replace(camera, columns=90, rows=90)
    bright = BoardGeometry((1, 1), 1.0, 0.2)
    images = [
        render_board(camera, AIR, board, BoardPlacement(-1.0), 1000.0, np.random.default_rng(2))
        for board in (bright, replace(bright, polarity="dark"))
    ]
    white = render_white(camera, 1000.0)
    clipped = images[1] == 0.0
    assert (images[0] + images[1])[~clipped] == pytest.approx(white[~clipped])
    assert images[0].sum() > 0.0
