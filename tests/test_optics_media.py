"""Plane layers and rays from the scene to the sensor: equations by hand, exact refraction, kernels as their twins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from lfpiv_cli.optics import media as of_media
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.optics.media import Media, Window, equivalent_object_distance, exact_lateral_mm, fluid_path_to_focus
from lfpiv_cli.optics.tracing import disc_points, exact_slope, trace, trace_ray
from tests.known_rays import slopes_equivalent, slopes_exact

FOCUS = 200.0  # F_m (M - 1)/M of Table 2: 100 * (-2)/(-1)


def test_eq10_a_ray_keeps_its_lateral_position_and_eqs3_6_9_by_hand(water, window):
    assert equivalent_object_distance(0.0, FOCUS, Media(1.0, 1.49, 1.33)) == FOCUS
    # 8 mm of water behind the focal point look like 8/1.33 = 6.01504 mm of air
    distance = equivalent_object_distance([-8.0, 8.0], FOCUS, Media(1.0, 1.49, 1.33))
    assert distance == pytest.approx([200.0 - 6.0150376, 200.0 + 6.0150376], abs=1e-6)
    # left behind d1 = 98 mm and the 2 mm window: 200 - 98 - 2/1.49 = 100.657718 in air; in water 1.33 times: 133.874765
    assert fluid_path_to_focus(window, FOCUS, water) == pytest.approx(133.874765, abs=1e-6)
    assert water.in_air() == Media(1.0, 1.0, 1.0)
    assert water.depth_ratio == pytest.approx(1 / 1.33)
    # A ray parallel to the axis meets the lens at the point's own x: the equivalent point keeps it.
    assert of_media.object_space_matrix(4.0, window, FOCUS, water)[:, 0] == pytest.approx([1.0, 0.0])


@pytest.mark.parametrize("window", [Window(98.0, 2.0), Window(192.5, 5.0), Window(10.0, 0.0)])
@pytest.mark.parametrize("z", [-5.0, -2.0, 0.0, 3.0, 8.0])
def test_eqs14_15_direct_tracing_equals_equivalent_points_to_rounding(window, z, media):
    """The object-space matrix of the layers is that of the equivalent distance in air, its angle turned by n_w/n_a."""
    matrix = of_media.object_space_matrix(z, window, FOCUS, media)
    distance = equivalent_object_distance(z, FOCUS, media)
    ratio = media.fluid / media.air
    expected = np.array([[1.0, distance], [0.0, 1.0]]) @ np.diag([1.0, ratio])
    assert matrix == pytest.approx(expected, rel=1e-13, abs=1e-13)


LAYERS = [
    (np.array([98.0, 2.0, 133.87]), np.array([1.0, 1.49, 1.33])),
    (np.array([192.5, 5.0, 5.0]), np.array([1.0, 1.49, 1.33])),
    (np.array([50.0]), np.array([1.0])),
    (np.array([1.0, 10.0]), np.array([1.6, 1.2])),
    (np.array([30.0, 0.0, 10.0]), np.array([1.0, 1.5, 1.33])),
]


def lateral(invariant, thicknesses, indices):
    return np.sum(thicknesses * np.tan(np.arcsin(invariant / indices)))


@pytest.mark.parametrize("layers", LAYERS)
@pytest.mark.parametrize("share", [1e-6, 0.01, 0.0625, 0.5, 3.0])
def test_eq4_exact_snell_against_bisection(layers, share):
    """n_i sin(angle_i) is the same in all layers and the layers' t_i tan(angle_i) add up to the lateral distance."""
    thicknesses, indices = layers
    distance = share * thicknesses.sum()
    top = np.nextafter(indices.min(), 0.0)
    found = brentq(lambda s: lateral(s, thicknesses, indices) - distance, 0.0, top * (1 - 1e-12), xtol=1e-15)
    assert of_media.snell_invariant(distance, thicknesses, indices) == pytest.approx(found, rel=1e-11)


def test_exact_snell_tends_to_the_paraxial_ray(water, window):
    """Lateral distance over slope tends to the equivalent distance; the difference falls with the slope squared."""
    z = 3.0
    depth = fluid_path_to_focus(window, FOCUS, water) + z
    layers, indices = [window.distance_mm, window.thickness_mm, depth], [1.0, 1.49, 1.33]
    equivalent = equivalent_object_distance(z, FOCUS, water)
    slopes = np.array([1e-2, 1e-3, 1e-4])
    difference = exact_lateral_mm(slopes, layers, indices, 1.0) / slopes - equivalent
    # t (1 - 1/n^2)/(2 n) slope^2 for each layer, from the series of tan(asin(s/n))
    leading = sum(t * (1 / n**2 - 1) / (2 * n) for t, n in zip(layers, indices, strict=True))
    assert difference[:2] == pytest.approx(leading * slopes[:2] ** 2, rel=1e-3)
    assert abs(difference[2]) < 1e-6


def test_aberration_at_the_edge_of_the_lens_through_the_paper_s_water_wherever_the_window_is(water, window):
    # About 0.085 mm of apparent depth at f/4, in the 133.9 mm of water of the paper's simulation.
    path = fluid_path_to_focus(window, FOCUS, water)
    assert path == pytest.approx(134.0, abs=0.2)
    layers, indices = np.array([98.0, 2.0, path]), np.array([1.0, 1.49, 1.33])
    invariant = of_media.snell_invariant(12.5, layers, indices)
    slope = invariant / np.sqrt(1.0 - invariant**2)
    # the outer ray, drawn on straight, crosses the axis this much nearer than the paraxial 200 mm
    assert FOCUS - 12.5 / slope == pytest.approx(0.085, abs=0.002)
    # Air in front of the window adds 1 mm of apparent distance to each mm, at all angles.
    near = exact_lateral_mm(0.06, [50.0, 2.0, 100.0], [1.0, 1.49, 1.33], 1.0)
    far = exact_lateral_mm(0.06, [90.0, 2.0, 100.0], [1.0, 1.49, 1.33], 1.0)
    assert far - near == pytest.approx(0.06 * 40.0, rel=1e-12)


def strewn(rng, camera, n=200):
    """Return points within the volume of Table 1 and crossings of the aperture."""
    points = rng.uniform((-4, -4, -8), (4, 4, 8), (n, 3))
    return points, disc_points(n, camera.aperture_radius_mm, rng)


def travel(distance):
    return np.array([[1.0, distance], [0.0, 1.0]])


def lens_matrix(focal_length):
    return np.array([[1.0, 0.0], [-1.0 / focal_length, 1.0]])


@pytest.mark.parametrize("microlens_distance", [0.8, 0.75])
def test_eq1_against_matrices_multiplied_explicitly(camera, media, rng, microlens_distance):
    camera = replace(camera, microlens_distance_mm=microlens_distance, magnification=-0.9)
    points, lens = strewn(rng, camera)
    hits = trace(camera, lens, slopes_equivalent(points, lens, camera, media))
    s_i, s_mu, f_m = camera.image_distance_mm, camera.microlens_distance_mm, camera.microlens_focal_length_mm
    ends = zip(points, lens, hits.array_mm, hits.sensor_mm, hits.lens_mm, strict=True)
    for point, crossing, array, sensor, centre in ends:
        s_o = equivalent_object_distance(point[2], camera.focus_distance_mm, media)
        for axis in (0, 1):
            theta = (crossing[axis] - point[axis]) / s_o
            main = travel(s_i) @ lens_matrix(camera.focal_length_mm) @ travel(s_o)
            ray = travel(s_mu) @ lens_matrix(f_m) @ main @ [point[axis], theta]
            ray += travel(s_mu) @ [0.0, centre[axis] / f_m]
            # lengths of up to 10 mm, some twenty roundings
            assert sensor[axis] == pytest.approx(ray[0], abs=1e-12)
            assert array[axis] == pytest.approx((main @ [point[axis], theta])[0], abs=1e-12)
    assert hits.lens_mm == pytest.approx(camera.lattice.points(camera.lattice.nearest(hits.array_mm)))
    # no point is further from its lens than the corner of a square cell, or of a hexagon
    corner = {"square": np.sqrt(0.5), "hexagonal": np.sqrt(1 / 3)}[camera.lattice.layout]
    assert np.hypot(*(hits.array_mm - hits.lens_mm).T).max() <= corner * 0.1 * (1 + 1e-12)


def test_rays_by_hand(table2, rng):
    # Point (1.03, -0.52, 0) in air, through the lens's point (5, 0), M = -1.
    #
    # slope x = (5 - 1.03)/200 = 0.01985, behind the lens 0.01985 - 5/100 = -0.03015; at the array
    # 5 - 0.03015 * 200 = -1.03: M x, whatever X. Nearest lens -1.0;
    # sensor -1.03 + 0.8 (-0.03015 - (-1.03 + 1.0)/0.8) = -1.02412.
    # slope y = 0.52/200 = 0.0026, at the array +0.52, nearest 0.5, sensor 0.52 + 0.8 (0.0026 - 0.02/0.8) = 0.50208.
    points, lens = np.array([[1.03, -0.52, 0.0]]), np.array([[5.0, 0.0]])
    hits = trace(table2, lens, slopes_equivalent(points, lens, table2, Media()))
    assert hits.array_mm[0] == pytest.approx([-1.03, 0.52], abs=1e-12)
    assert hits.sensor_mm[0] == pytest.approx([-1.02412, 0.50208], abs=1e-12)
    # World (0.3, 1.0): with columns along y the image lies at column -1.0 mm and row -0.3 mm.
    camera = replace(table2, column_axis="y")
    points = camera.to_image_axes([[0.3, 1.0, 0.0]])
    array = trace(camera, [[2.0, 1.0]], slopes_equivalent(points, np.array([[2.0, 1.0]]), camera, Media())).array_mm
    assert array[0] == pytest.approx([-1.0, -0.3], abs=1e-12)
    # at r = 5 mm, k1 = 2e-5: 5 (1 + 2e-5 * 25) = 5.0025; the direction is left alone, so only x and the lens change
    camera = replace(table2, distortion_per_mm2=2e-5)
    lens, slopes = np.array([[0.0, 0.0]]), np.array([[0.015, 0.020]])  # meets the array at (3, 4)
    hits = trace(camera, lens, slopes)
    assert hits.array_mm[0] == pytest.approx([3.0015, 4.002], abs=1e-12)
    # f_m = s_mu: the sensor point is the lens's centre plus the direction times s_mu, 3.0 + 0.012 and 4.0 + 0.016
    assert hits.sensor_mm[0] == pytest.approx([3.012, 4.016], abs=1e-12)
    hits = trace(table2, [[12.4, 0.0], [12.6, 0.0], [9.0, 9.0]], np.zeros((3, 2)))
    assert hits.valid.tolist() == [True, False, False]
    assert exact_slope(0.0, 0.0, np.array([98.0, 2.0, 130.0]), np.array([1.0, 1.49, 1.33])) == (0.0, 0.0)


@pytest.mark.parametrize("magnification", [-0.5, -1.0, -2.0])
def test_a_point_at_plus_x_lights_m_x(table2, media, rng, magnification):
    camera = replace(table2, magnification=magnification)
    lens = disc_points(50, camera.aperture_radius_mm, rng)
    points = np.tile([0.7, -0.4, 0.0], (50, 1))
    array = trace(camera, lens, slopes_equivalent(points, lens, camera, media)).array_mm
    assert array == pytest.approx(magnification * points[:, :2], abs=1e-12)


def test_micro_images_are_centred_behind_the_aperture_s_centre(camera, rng):
    """Rays through the lens's centre and a microlens's centre meet the sensor at s_u (1 + s_mu/s_i)."""
    centre = camera.lattice.points(rng.integers(-30, 30, (20, 2)))
    crossing = np.zeros((20, 2))
    # in front of the main lens the ray through its centre has the slope it has behind it
    hits = trace(camera, crossing, centre / camera.image_distance_mm)
    assert hits.sensor_mm == pytest.approx(centre * 1.004, abs=1e-12)
    assert camera.mm_to_px(hits.sensor_mm) == pytest.approx(
        camera.micro_image_lattice_px().points(camera.lattice.nearest(centre)), abs=1e-9
    )


def test_exact_slopes_meet_the_point(camera, water, window, rng):
    """Forward and reverse: the ray with that slope, bent by sines at each face, arrives at the point it came from."""
    points, lens = strewn(rng, camera, 30)
    path = 133.8747651  # in the fluid to the focal point, see the media
    for point, crossing, slope in zip(points, lens, slopes_exact(points, lens, camera, water, window), strict=True):
        direction = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1 + slope @ slope)
        place = np.array([crossing[0], crossing[1], 0.0])
        for index_before, index, thickness in [(1, 1, 98.0), (1, 1.49, 2.0), (1.49, 1.33, path + point[2])]:
            sideways = direction[:2] * index_before / index
            direction = np.array([*sideways, np.sqrt(1 - sideways @ sideways)])
            place = place + direction * thickness / direction[2]
        assert place[:2] == pytest.approx(point[:2], abs=1e-8)


def test_kernel_traces_as_its_twin(camera, water, rng):
    camera = replace(
        camera,
        lattice=Lattice.regular(0.1, camera.lattice.layout, 0.002, (0.019, -0.012)),
        distortion_per_mm2=2e-5,
        microlens_distance_mm=0.78,
    )
    points, lens = strewn(rng, camera)
    slopes = slopes_equivalent(points, lens, camera, water)
    expected = trace(camera, lens, slopes).sensor_mm
    found = np.array([trace_ray(camera.for_kernels(), *x, *s) for x, s in zip(lens, slopes, strict=True)])
    assert found == pytest.approx(expected, abs=1e-12)


def test_disc_points_fill_the_disc_evenly(rng):
    points = disc_points(20000, 12.5, rng)
    r = np.hypot(*points.T)
    assert r.max() <= 12.5
    # half of them within R/sqrt(2), a quarter in each quadrant: 4 standard deviations of 20,000 trials
    assert np.mean(r < 12.5 / np.sqrt(2)) == pytest.approx(0.5, abs=0.015)
    assert np.mean((points[:, 0] > 0) & (points[:, 1] > 0)) == pytest.approx(0.25, abs=0.013)
