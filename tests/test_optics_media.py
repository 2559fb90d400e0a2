"""Plane layers: equivalent points against direct tracing, exact refraction against bisection and its paraxial limit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import brentq

from lfpiv_cli.optics.media import (
    Media,
    Window,
    equivalent_object_distance,
    exact_lateral_mm,
    fluid_path_to_focus,
    object_space_matrix,
    snell_invariant,
)

FOCUS = 200.0  # F_m (M - 1)/M of Table 2: 100 * (-2)/(-1)


def test_eq6_focal_point_in_air_is_the_focus_distance():
    assert equivalent_object_distance(0.0, FOCUS, Media(1.0, 1.49, 1.33)) == FOCUS


def test_eq9_depth_in_the_fluid_counts_n_a_over_n_w():
    # 8 mm of water behind the focal point look like 8/1.33 = 6.01504 mm of air
    distance = equivalent_object_distance([-8.0, 8.0], FOCUS, Media(1.0, 1.49, 1.33))
    assert distance == pytest.approx([200.0 - 6.0150376, 200.0 + 6.0150376], abs=1e-6)


def test_eq3_fluid_path_by_hand(water, window):
    # left behind d1 = 98 mm and the 2 mm window: 200 - 98 - 2/1.49 = 100.657718 in air; in water 1.33 times: 133.874765
    assert fluid_path_to_focus(window, FOCUS, water) == pytest.approx(133.874765, abs=1e-6)


def test_in_air_has_one_index(water):
    assert water.in_air() == Media(1.0, 1.0, 1.0)
    assert water.depth_ratio == pytest.approx(1 / 1.33)


@pytest.mark.parametrize("window", [Window(98.0, 2.0), Window(192.5, 5.0), Window(10.0, 0.0)])
@pytest.mark.parametrize("z", [-5.0, -2.0, 0.0, 3.0, 8.0])
def test_eqs14_15_direct_tracing_equals_equivalent_points_to_rounding(window, z, media):
    """The object-space matrix of the layers is that of the equivalent distance in air, its angle turned by n_w/n_a."""
    matrix = object_space_matrix(z, window, FOCUS, media)
    distance = equivalent_object_distance(z, FOCUS, media)
    ratio = media.fluid / media.air
    expected = np.array([[1.0, distance], [0.0, 1.0]]) @ np.diag([1.0, ratio])
    assert matrix == pytest.approx(expected, rel=1e-13, abs=1e-13)


def test_eq10_a_ray_keeps_its_lateral_position(water, window):
    """A ray parallel to the axis meets the lens at the point's own x: the equivalent point keeps it."""
    assert object_space_matrix(4.0, window, FOCUS, water)[:, 0] == pytest.approx([1.0, 0.0])


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
    assert snell_invariant(distance, thicknesses, indices) == pytest.approx(found, rel=1e-11)


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


def test_aberration_at_the_edge_of_the_lens_through_the_paper_s_water(water, window):
    """About 0.085 mm of apparent depth at f/4, in the 133.9 mm of water of the paper's simulation."""
    path = fluid_path_to_focus(window, FOCUS, water)
    assert path == pytest.approx(134.0, abs=0.2)
    layers, indices = np.array([98.0, 2.0, path]), np.array([1.0, 1.49, 1.33])
    invariant = snell_invariant(12.5, layers, indices)
    slope = invariant / np.sqrt(1.0 - invariant**2)
    # the outer ray, drawn on straight, crosses the axis this much nearer than the paraxial 200 mm
    assert FOCUS - 12.5 / slope == pytest.approx(0.085, abs=0.002)


def test_aberration_does_not_depend_on_the_distance_of_the_window(water):
    """Air in front of the window adds 1 mm of apparent distance to each mm, at all angles."""
    near = exact_lateral_mm(0.06, [50.0, 2.0, 100.0], [1.0, 1.49, 1.33], 1.0)
    far = exact_lateral_mm(0.06, [90.0, 2.0, 100.0], [1.0, 1.49, 1.33], 1.0)
    assert far - near == pytest.approx(0.06 * 40.0, rel=1e-12)


def test_exact_lateral_inverts_snell_invariant(rng):
    for thicknesses, indices in LAYERS[:3]:
        slope = rng.uniform(0.0, 0.3)
        sideways = float(exact_lateral_mm(slope, thicknesses, indices, 1.0))
        assert snell_invariant(sideways, thicknesses, indices) == pytest.approx(slope / np.hypot(1, slope), rel=1e-12)
