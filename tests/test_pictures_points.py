"""Figures of particles, tracks, volumes and weights: what they show, where, on what scale."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.surfaces import Cylinder
from lfpiv_cli.pictures import points as of_points
from lfpiv_cli.pictures import vectors as of_volume
from lfpiv_cli.pictures.style import SLABS, percentiles_by_depth

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_particles_are_seen_where_the_camera_sees_them(table2: Camera, water: Media, column_axis: str) -> None:
    camera = replace(table2, column_axis=column_axis)
    focal, lateral = of_points.places_px(np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 0.0]]), camera, water, None)
    np.testing.assert_allclose(focal, camera.sensor_centre_px)
    # in focus the array has M times the place, the sensor a little more of it behind each lens's centre
    seen = np.array([0.3, -0.2] if column_axis == "x" else [-0.2, 0.3]) * camera.magnification
    expected = camera.sensor_centre_px + seen * camera.micro_image_scale / camera.pixel_mm
    np.testing.assert_allclose(lateral, expected)
    # further away, smaller: by the apparent depth
    (far,) = of_points.places_px(np.array([[0.3, -0.2, 13.3]]), camera, water, None)
    ratio = camera.focus_distance_mm / (camera.focus_distance_mm + 13.3 * water.depth_ratio)
    np.testing.assert_allclose(far - camera.sensor_centre_px, ratio * (expected - camera.sensor_centre_px))


def test_particles_in_a_tube_are_seen_through_its_walls(table2: Camera, water: Media) -> None:
    tube = CurvedSpace(
        water,
        (
            Face(Cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 7.0), 1.49),
            Face(Cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 5.0), 1.33),
        ),
    )
    (seen, hidden) = of_points.places_px(np.array([[0.3, 0.5, 0.0], [0.0, 5.5, 0.0]]), table2, water, tube)
    along, across = (seen - table2.sensor_centre_px) * table2.pixel_mm / table2.micro_image_scale / table2.magnification
    # about its axis a tube is a lens: what is near it seems wider by the fluid's index, 1.33, and along it as it is
    assert along == pytest.approx(0.3, rel=0.03)
    assert across == pytest.approx(1.33 * 0.5, rel=0.02)
    assert np.isnan(hidden).all()


def test_the_image_shows_places_coloured_by_depth() -> None:
    image = np.arange(12.0).reshape(3, 4)
    places, depths = np.array([[0.0, 1.0], [3.0, 2.0]]), np.array([-1.0, 2.0])
    axes = of_points.image_figure(image, places, depths).axes[0]
    np.testing.assert_array_equal(axes.images[0].get_array(), image)
    np.testing.assert_array_equal(axes.collections[0].get_offsets(), places)
    np.testing.assert_array_equal(axes.collections[0].get_array(), depths)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("column (px)", "row (px)")


def test_a_residual_has_a_scale_about_zero_and_tells_its_rms() -> None:
    axes = of_points.residual_figure(np.array([[3.0, -4.0], [0.0, 0.0]])).axes[0]
    low, high = axes.images[0].get_clim()
    assert low == -high
    assert axes.get_title() == "residual, rms 2.5 counts"


def test_particles_by_depth() -> None:
    z = np.repeat([0.0, 10.0], 4)
    light = np.array([1.0, 2.0, 3.0, 100.0, 10.0, 20.0, 30.0, 40.0])
    covariance = np.tile([1e-6, 4e-6, 1e-4, 0.0, 0.0, 0.0], (8, 1))
    counts, lights, sigmas = of_points.depths_figure(z, light, covariance).axes
    assert [bar.get_height() for bar in counts.patches] == [4.0] + [0.0] * (SLABS - 2) + [4.0]
    np.testing.assert_allclose(lights.lines[0].get_ydata()[[0, -1]], [2.5, 25.0])
    last = [line.get_ydata()[-1] for line in sigmas.lines]
    np.testing.assert_allclose(last, [1e-3, 2e-3, 1e-2])
    assert [text.get_text() for text in sigmas.get_legend().get_texts()] == ["along x", "along y", "along z"]


def test_a_slab_with_few_points_tells_nothing() -> None:
    places, medians = percentiles_by_depth(np.array([0.0, 0.1, 0.2, 20.0]), np.array([1.0, np.nan, 3.0, 9.0]), 50.0)
    assert np.isnan(medians).all()
    np.testing.assert_allclose(places[[0, -1]], [0.5, 19.5])
    assert percentiles_by_depth(np.full(3, 2.0), np.array([1.0, 2.0, 3.0]), 50.0)[1][SLABS // 2] == 2.0


def test_chi2_beyond_the_axis_is_in_the_last_bar() -> None:
    axes = of_points.chi2_figure(np.array([0.9, 1.1, 70.0, 80.0])).axes[0]
    assert axes.patches[-1].get_height() == 2.0
    assert axes.get_title() == "median 35.55, 2 beyond 5"


def test_places_of_particles_from_two_sides() -> None:
    position = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])
    front, side = of_points.places_figure(position, np.array([10.0, 20.0, 0.0])).axes[:2]
    np.testing.assert_array_equal(front.collections[0].get_offsets(), position[:2, :2])
    np.testing.assert_array_equal(side.collections[0].get_offsets(), position[:2, [0, 2]])


def test_displacements_are_drawn_about_their_middles_and_long_enough_to_be_seen() -> None:
    position = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    lines, stretch = of_points.displacement_lines(position, np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.05]]))
    assert stretch == pytest.approx(12.0)
    np.testing.assert_allclose(lines[0], [[0.0, -0.6, 0.0], [0.0, 0.6, 0.0]])
    np.testing.assert_allclose(lines[1].mean(axis=0), position[1])


def test_space_shows_each_trajectory_by_its_speed() -> None:
    position = np.arange(15.0).reshape(5, 3)
    lines = of_points.trajectory_lines(position, np.array([0, 0, 4, 4, 4]))
    assert [len(line) for line in lines] == [2, 3]
    axes = of_points.space_figure(lines, np.array([0.1, 0.4]), "2 trajectories").axes[0]
    (drawn,) = axes.collections
    np.testing.assert_array_equal(drawn.get_array(), [0.1, 0.4])
    assert drawn.get_clim() == (0.0, 0.4)
    np.testing.assert_array_equal(drawn._segments3d[1], position[2:][:, [2, 0, 1]])
    assert [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()] == ["z (mm)", "x (mm)", "y (mm)"]


def test_space_without_tracks_is_empty() -> None:
    lines, stretch = of_points.displacement_lines(np.zeros((0, 3)), np.zeros((0, 3)))
    assert (lines, stretch) == ([], 1.0)
    of_points.space_figure(lines, np.zeros(0), "none").draw_without_rendering()
    assert of_points.trajectory_lines(np.zeros((0, 3)), np.zeros(0, int)) == []


def test_many_tracks_are_thinned_out_and_it_is_said() -> None:
    lines = [np.array([[k, 0.0, 0.0], [k, 1.0, 1.0]]) for k in range(2 * of_points.LINES_DRAWN)]
    axes = of_points.space_figure(lines, np.ones(len(lines)), "many").axes[0]
    assert len(axes.collections[0]._segments3d) == of_points.LINES_DRAWN
    assert axes.get_title() == "many; one in 2 drawn"


def test_links_lengths_and_sigma_of_tracks() -> None:
    links = of_points.links_figure(np.array([1.0, 0.5, 0.75, np.nan])).axes[0]
    assert links.get_title() == "3 links, 0.8 wrong ones expected"
    assert sum(bar.get_height() for bar in links.patches) == 3
    lengths = of_points.lengths_figure(np.array([7, 7, 9, 9, 9, 11])).axes[0]
    assert [bar.get_height() for bar in lengths.patches] == [1.0, 1.0, 1.0]
    z, sigma = np.repeat([0.0, 1.0], 3), np.tile([0.1, 0.2, 0.7], (6, 1))
    curves = of_points.sigma_figure(z, sigma).axes[0].lines
    np.testing.assert_allclose([line.get_ydata()[0] for line in curves], [0.1, 0.2, 0.7])
    speeds = of_points.velocities_figure(np.array([[1.0, 2.0, 3.0]])).axes
    assert [axes.get_xlabel() for axes in speeds] == ["u (m/s)", "v (m/s)", "w (m/s)"]


def test_projections_are_the_largest_along_each_axis_on_one_scale() -> None:
    volume = np.random.default_rng(1).random((4, 3, 2)).astype(np.float32)
    grid = Grid.centred((2, 3, 4), (0.1, 0.1, 0.2), (0.0, 0.0, 5.0))
    panels = of_volume.projections_figure(volume, grid).axes[:3]
    for axes, along in zip(panels, (0, 1, 2), strict=True):
        np.testing.assert_array_equal(axes.images[0].get_array(), volume.max(axis=along))
    assert len({axes.images[0].get_clim() for axes in panels}) == 1
    assert panels[1].images[0].get_extent() == pytest.approx([-0.1, 0.1, 4.6, 5.4])
    (curve,) = of_volume.depths_figure(volume, grid).axes[0].lines
    np.testing.assert_allclose(curve.get_ydata(), volume.mean(axis=(1, 2)), rtol=1e-6)


def test_a_column_has_its_pixels_and_mm() -> None:
    rows, columns = np.array([10, 10, 11]), np.array([20, 22, 21])
    figure = of_volume.column_figure((rows, columns), np.array([0.2, 0.3, 0.5], np.float32), 0.01, "a voxel")
    axes = figure.axes[0]
    np.testing.assert_allclose(axes.images[0].get_array(), [[0.2, 0.0, 0.3], [0.0, 0.5, 0.0]])
    assert axes.images[0].get_extent() == [19.5, 22.5, 11.5, 9.5]
    figure.draw_without_rendering()
    beside = axes.child_axes
    assert [axis.get_xlabel() or axis.get_ylabel() for axis in beside] == ["mm, from the first pixel lit"] * 2
    np.testing.assert_allclose(beside[0].get_xlim(), [0.0, 0.03])


def test_light_by_depth_has_a_curve_a_place() -> None:
    axes = of_volume.light_figure(np.array([0.0, 1.0]), {"middle": np.array([1.0, 0.9]), "corner": np.zeros(2)}).axes[0]
    assert [line.get_label() for line in axes.lines] == ["middle", "corner"]
    assert axes.get_ylim() == (0.0, 1.05)
