"""Figures of particles, tracks, volumes, weights and vector fields: what they show, where, on what scale."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.flow.field import MASKED, REJECTED, VALID, VectorField
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.pictures import points as of_points
from lfpiv_cli.pictures import style
from lfpiv_cli.pictures import vectors as of_volume
from lfpiv_cli.pictures import vectors as pictures
from lfpiv_cli.pictures.points import convergence_figure
from lfpiv_cli.pictures.style import COLOURS, MARKERS, SETTINGS, percentiles_by_depth, scale_of, symmetric_limit
from lfpiv_cli.verbs.plot import figures_of
from tests.commands import CONFIG
from tests.known_rays import tube_of
from tests.vector_fields import field_on

matplotlib = pytest.importorskip("matplotlib")
from matplotlib.quiver import Quiver, QuiverKey  # noqa: E402


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
    (seen, hidden) = of_points.places_px(np.array([[0.3, 0.5, 0.0], [0.0, 5.5, 0.0]]), table2, water, tube_of(water))
    along, across = (seen - table2.sensor_centre_px) * table2.pixel_mm / table2.micro_image_scale / table2.magnification
    # about its axis a tube is a lens: what is near it seems wider by the fluid's index, 1.33, and along it as it is
    assert along == pytest.approx(0.3, rel=0.03)
    assert across == pytest.approx(1.33 * 0.5, rel=0.02)
    assert np.isnan(hidden).all()


def test_particles_and_what_they_leave() -> None:
    image = np.arange(12.0).reshape(3, 4)
    places, depths = np.array([[0.0, 1.0], [3.0, 2.0]]), np.array([-1.0, 2.0])
    axes = of_points.image_figure(image, places, depths).axes[0]
    np.testing.assert_array_equal(axes.images[0].get_array(), image)
    np.testing.assert_array_equal(axes.collections[0].get_offsets(), places)
    np.testing.assert_array_equal(axes.collections[0].get_array(), depths)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("column (px)", "row (px)")
    axes = of_points.residual_figure(np.array([[3.0, -4.0], [0.0, 0.0]])).axes[0]
    low, high = axes.images[0].get_clim()
    assert low == -high
    assert axes.get_title() == "residual, rms 2.5 counts"
    z = np.repeat([0.0, 10.0], 4)
    light = np.array([1.0, 2.0, 3.0, 100.0, 10.0, 20.0, 30.0, 40.0])
    covariance = np.tile([1e-6, 4e-6, 1e-4, 0.0, 0.0, 0.0], (8, 1))
    counts, lights, sigmas = of_points.depths_figure(z, light, covariance).axes
    assert [bar.get_height() for bar in counts.patches] == [4.0] + [0.0] * 18 + [4.0]
    np.testing.assert_allclose(lights.lines[0].get_ydata()[[0, -1]], [2.5, 25.0])
    last = [line.get_ydata()[-1] for line in sigmas.lines]
    np.testing.assert_allclose(last, [1e-3, 2e-3, 1e-2])
    assert [text.get_text() for text in sigmas.get_legend().get_texts()] == ["along x", "along y", "along z"]
    places, medians = percentiles_by_depth(np.array([0.0, 0.1, 0.2, 20.0]), np.array([1.0, np.nan, 3.0, 9.0]), 50.0)
    assert np.isnan(medians).all()
    np.testing.assert_allclose(places[[0, -1]], [0.5, 19.5])
    assert percentiles_by_depth(np.full(3, 2.0), np.array([1.0, 2.0, 3.0]), 50.0)[1][10] == 2.0
    axes = of_points.chi2_figure(np.array([0.9, 1.1, 70.0, 80.0])).axes[0]
    assert axes.patches[-1].get_height() == 2.0
    assert axes.get_title() == "median 35.55, 2 beyond 5"
    position = np.array([[0.0, 1.0, 2.0], [3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])
    front, side = of_points.places_figure(position, np.array([10.0, 20.0, 0.0])).axes[:2]
    np.testing.assert_array_equal(front.collections[0].get_offsets(), position[:2, :2])
    np.testing.assert_array_equal(side.collections[0].get_offsets(), position[:2, [0, 2]])


@pytest.mark.parametrize("shape", [(448, 600), (600, 448), (100, 600)])
def test_labels_of_an_image_lie_within_its_picture(shape: tuple[int, int]) -> None:
    figure = of_points.residual_figure(np.random.default_rng(0).normal(0.0, 100.0, shape))
    figure.draw_without_rendering()
    left, bottom, right, top = figure.axes[0].get_tightbbox().extents
    assert min(left, bottom) >= 0.0
    assert right <= figure.bbox.width
    assert top <= figure.bbox.height


def test_space_shows_tracks_by_their_speed_some_of_many_and_none() -> None:
    position = np.arange(15.0).reshape(5, 3)
    lines = of_points.trajectory_lines(position, np.array([0, 0, 4, 4, 4]))
    assert [len(line) for line in lines] == [2, 3]
    axes = of_points.space_figure(lines, np.array([0.1, 0.4]), "2 trajectories").axes[0]
    (drawn,) = axes.collections
    np.testing.assert_array_equal(drawn.get_array(), [0.1, 0.4])
    assert drawn.get_clim() == (0.1, 0.4)
    np.testing.assert_array_equal(drawn._segments3d[1], position[2:][:, [2, 0, 1]])
    assert [axes.get_xlabel(), axes.get_ylabel(), axes.get_zlabel()] == ["z (mm)", "x (mm)", "y (mm)"]
    position = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    lines, stretch = of_points.displacement_lines(position, np.array([[0.0, 0.1, 0.0], [0.0, 0.0, 0.05]]))
    assert stretch == pytest.approx(12.0)
    np.testing.assert_allclose(lines[0], [[0.0, -0.6, 0.0], [0.0, 0.6, 0.0]])
    np.testing.assert_allclose(lines[1].mean(axis=0), position[1])
    lines, stretch = of_points.displacement_lines(np.zeros((0, 3)), np.zeros((0, 3)))
    assert (lines, stretch) == ([], 1.0)
    of_points.space_figure(lines, np.zeros(0), "none").draw_without_rendering()
    assert of_points.trajectory_lines(np.zeros((0, 3)), np.zeros(0, int)) == []
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


def test_projections_are_the_largest_along_each_axis_and_columns_have_pixels_and_mm() -> None:
    volume = np.random.default_rng(1).random((4, 3, 2)).astype(np.float32)
    grid = Grid.centred((2, 3, 4), (0.1, 0.1, 0.2), (0.0, 0.0, 5.0))
    panels = of_volume.projections_figure(volume, grid).axes[:3]
    for axes, along in zip(panels, (0, 1, 2), strict=True):
        np.testing.assert_array_equal(axes.images[0].get_array(), volume.max(axis=along))
    assert len({axes.images[0].get_clim() for axes in panels}) == 1
    assert panels[1].images[0].get_extent() == pytest.approx([-0.1, 0.1, 4.6, 5.4])
    (curve,) = of_volume.depths_figure(volume, grid).axes[0].lines
    np.testing.assert_allclose(curve.get_ydata(), volume.mean(axis=(1, 2)), rtol=1e-6)
    rows, columns = np.array([10, 10, 11]), np.array([20, 22, 21])
    figure = of_volume.column_figure((rows, columns), np.array([0.2, 0.3, 0.5], np.float32), 0.01, "a voxel")
    axes = figure.axes[0]
    np.testing.assert_allclose(axes.images[0].get_array(), [[0.2, 0.0, 0.3], [0.0, 0.5, 0.0]])
    assert axes.images[0].get_extent() == [19.5, 22.5, 11.5, 9.5]
    figure.draw_without_rendering()
    beside = axes.child_axes
    assert [axis.get_xlabel() or axis.get_ylabel() for axis in beside] == ["mm, from the first pixel lit"] * 2
    np.testing.assert_allclose(beside[0].get_xlim(), [0.0, 0.03])
    axes = of_volume.light_figure(np.array([0.0, 1.0]), {"middle": np.array([1.0, 0.9]), "corner": np.zeros(2)}).axes[0]
    assert [line.get_label() for line in axes.lines] == ["middle", "corner"]
    assert axes.get_ylim() == (0.0, 1.05)


def test_the_style_holds_within_and_leaves_the_callers_settings() -> None:
    @style.styled
    def draw():
        figure = style.new_figure(3.0, 2.0)
        axis = figure.subplots()
        lines = [axis.plot([0, 1], [k, k])[0] for k in range(2)]
        return figure, axis, lines

    with matplotlib.rc_context({"axes.titlesize": 33.0, "font.size": 44.0, "lines.linewidth": 7.0, "axes.grid": True}):
        figure, axis, lines = draw()
        assert matplotlib.rcParams["font.size"] == 44.0
    assert axis.title.get_fontsize() == SETTINGS["axes.titlesize"]
    assert [line.get_color() for line in lines] == list(COLOURS[:2])
    assert lines[0].get_linewidth() == SETTINGS["lines.linewidth"]
    assert not axis.xaxis.get_gridlines()[0].get_visible()
    assert tuple(figure.get_size_inches()) == (3.0, 2.0)
    assert len(set(MARKERS)) == len(set(COLOURS)) == len(COLOURS) == len(MARKERS)
    assert symmetric_limit([1.0, -3.0, np.nan], np.array([[2.0, np.inf]])) == 3.0
    assert symmetric_limit([0.0, np.nan]) == symmetric_limit() == 1.0


AT_FOCUS = Reference("focal_point", 0.0)
SHAPE = (5, 4, 3)  # z, y, x


@pytest.fixture
def field() -> VectorField:
    """A turn about z and a steady stream along x, one missing vector in the middle of all planes."""
    grid = Grid.centred(SHAPE[::-1], (0.5, 0.5, 1.0), (0.0, 0.0, 2.0))
    x, y = grid.centres_mm()[..., 0], grid.centres_mm()[..., 1]
    displacement = np.stack([3.0 - y, x, np.zeros(SHAPE)], axis=-1)
    flag = np.full(SHAPE, VALID, dtype=np.uint8)
    flag[2, 2, 1], flag[0, 0, 0] = REJECTED, MASKED
    return field_on(grid, displacement, flag, np.broadcast_to([0.01, 0.02, 0.3], displacement.shape).copy())


def panels(figure):
    return [axes for axes in figure.axes if axes.get_xlabel().endswith("(mm)") and axes.get_ylabel().endswith("(mm)")]


def image_of(axes) -> np.ndarray:
    return np.ma.filled(axes.images[0].get_array().astype(float), np.nan)


def test_planes_have_arrows_in_them_and_the_component_across_on_one_scale(field: Floats) -> None:
    figure = pictures.planes_figure(field)
    first, second, third = panels(figure)
    titles = ["w\nx-y at z = 2.00 mm", "v\nx-z at y = 0.25 mm", "u\ny-z at x = 0.00 mm"]
    assert [axes.get_title() for axes in (first, second, third)] == titles
    velocity = field.velocity
    np.testing.assert_array_equal(image_of(second), velocity[:, 2, :, 1])
    np.testing.assert_array_equal(image_of(third), velocity[:, :, 1, 0])
    limits = {axes.images[0].get_clim() for axes in (first, second, third)}
    assert limits == {(-np.nanmax(velocity[:, :, 1, 0]), np.nanmax(velocity[:, :, 1, 0]))}
    arrows = [next(c for c in axes.collections if isinstance(c, Quiver)) for axes in (first, second, third)]
    assert len({a.scale for a in arrows}) == 1
    known = np.isfinite(velocity[2]).all(axis=-1)
    np.testing.assert_array_equal(arrows[0].U, velocity[2][known][:, 0])
    np.testing.assert_array_equal(arrows[1].V, velocity[:, 2][np.isfinite(velocity[:, 2]).all(axis=-1)][:, 2])
    # the missing one of the plane is a cross at its place
    np.testing.assert_allclose(first.lines[0].get_xydata(), [[0.0, 0.25]], atol=1e-12)
    key = next(artist for axes in figure.axes for artist in axes.artists if isinstance(artist, QuiverKey))
    assert key.text.get_text() == "0.3 m/s"


def test_slow_flows_are_told_in_mm_per_s_and_gradients_show_the_turn(field: Floats) -> None:
    slow = pictures.shown(replace(field, dt_s=0.1))
    assert slow.unit == "mm/s"
    np.testing.assert_allclose(slow.values[2, 1, 1], field.displacement_voxel[2, 1, 1])
    np.testing.assert_allclose(slow.sigma[2, 1, 1], [0.01, 0.02, 0.3])
    timeless = pictures.shown(replace(field, dt_s=None))
    assert timeless.unit == "voxel"
    assert np.isnan([timeless.values[2, 2, 1], timeless.sigma[2, 2, 1]]).all()
    np.testing.assert_array_equal(timeless.values[2, 1, 1], field.displacement_voxel[2, 1, 1])
    whole = replace(field, flag=np.zeros(SHAPE, np.uint8))
    rows = np.array(panels(pictures.gradients_figure(whole))).reshape(2, 3)
    # displacements of 1 voxel per mm of 0.1 mm in 1 ms: rates of 100/s, twice that as vorticity
    np.testing.assert_allclose(image_of(rows[0, 0]), 200.0)
    np.testing.assert_allclose(image_of(rows[1, 2]), 0.0, atol=1e-9)
    assert len({axes.images[0].get_clim() for axes in rows.ravel()}) == 1
    with pytest.raises(ValueError, match="time"):
        pictures.gradients_figure(replace(field, dt_s=None))


def test_components_and_sigma_have_one_scale_and_flags_are_counted(field: Floats) -> None:
    figure = pictures.components_figure(field)
    rows = np.array(panels(figure)).reshape(3, 3)
    np.testing.assert_array_equal(image_of(rows[1, 2]), field.velocity[:, :, 1, 1])
    for row in rows:
        (limits,) = {axes.images[0].get_clim() for axes in row}
        shown = np.concatenate([image_of(axes).ravel() for axes in row])
        low, high = np.nanmin(shown), np.nanmax(shown)
        one_sign = (low, high if high > low else low + 1.0)
        assert limits == ((-max(-low, high), max(-low, high)) if low < 0.0 < high else one_sign)
    assert [row[-1].child_axes[0].get_ylabel() for row in rows] == [f"{name} (m/s)" for name in "uvw"]
    rows = np.array(panels(pictures.sigma_figure(field))).reshape(3, 3)
    assert len({axes.images[0].norm for axes in rows.ravel()}) == 1
    np.testing.assert_allclose(np.nanmax(image_of(rows[2, 0])), 0.03)
    assert np.isnan(image_of(rows[2, 0])[2, 1])
    with pytest.raises(ValueError, match="uncertainty"):
        pictures.sigma_figure(replace(field, uncertainty_voxel=None))
    figure = pictures.flags_figure(field)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["valid: 58", "rejected: 1", "masked: 1"]
    np.testing.assert_array_equal(image_of(panels(figure)[0]), field.flag[2])
    # Profiles are means over planes, with a band of sigma.
    axes = np.array(pictures.profiles_figure(field).axes).reshape(3, 3)
    along_y = axes[0, 1].lines[1]
    np.testing.assert_allclose(along_y.get_xdata(), field.grid.axis_mm(1))
    np.testing.assert_allclose(along_y.get_ydata(), np.nanmean(field.velocity[..., 0], axis=(0, 2)))
    band = axes[2, 0].collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (pytest.approx(-0.03), pytest.approx(0.03))


@pytest.mark.thorough
def test_displacements_show_their_parts_beyond_whole_voxels_and_microlenses(field: Floats) -> None:
    axes = np.array(pictures.displacements_figure(field, lens_mm=0.4).axes).reshape(3, 3)
    valid = field.displacement_voxel[field.flag == VALID]
    for row, size in ((1, 1.0), (2, 4.0)):
        parts = valid[:, 0] / size
        counts, _ = np.histogram(parts - np.round(parts), bins=20, range=(-0.5, 0.5))
        np.testing.assert_array_equal([bar.get_height() for bar in axes[row, 0].patches], counts)
    assert sum(bar.get_height() for bar in axes[0, 1].patches) == len(valid)
    assert pictures.displacements_figure(field).axes[-1].get_xlabel() == "w beyond whole voxels (voxels)"


@pytest.mark.thorough
def test_figures_of_a_file_follow_what_it_knows(field: Floats, tmp_path: Path) -> None:
    path = tmp_path / "vectors.vtkhdf"
    varied = replace(field, correlation=np.linspace(0.2, 0.9, 60).reshape(SHAPE))
    write_vectors(path, varied, AT_FOCUS, provenance={}, overwrite=True)
    figures = figures_of(path)
    assert ", ".join(figures) == "planes, components, profiles, sigma, flags, quality, displacements, gradients"
    assert "correlation at the peak." in figures["quality"].caption
    drawn = figures["quality"].draw()
    np.testing.assert_array_equal(image_of(panels(drawn)[0]), varied.correlation[2])
    assert len(figures["displacements"].draw().axes) == 6
    # With the camera known, what displacements are beyond whole microlenses (0.1 mm) is shown, too.
    write_vectors(path, varied, AT_FOCUS, provenance={"config": load_rig(CONFIG).resolved()}, overwrite=True)
    below = figures_of(path)["displacements"].draw().axes[-3:]
    assert [axes.get_xlabel() for axes in below] == [f"{name} beyond whole microlenses (microlenses)" for name in "uvw"]
    parts = field.displacement_voxel[field.flag == VALID][:, 0]
    counts, _ = np.histogram(parts - np.round(parts), bins=20, range=(-0.5, 0.5))
    np.testing.assert_array_equal([bar.get_height() for bar in below[0].patches], counts)
    write_vectors(path, varied, AT_FOCUS, provenance={"config": {"of": "another version"}}, overwrite=True)
    assert len(figures_of(path)["displacements"].draw().axes) == 6
    poor = replace(field, uncertainty_voxel=None, dt_s=None)
    write_vectors(path, poor, AT_FOCUS, provenance={}, overwrite=True)
    assert list(figures_of(path)) == ["planes", "components", "profiles", "flags", "displacements"]


def test_colours_are_about_zero_where_there_are_both_signs_and_begin_at_the_least_elsewhere() -> None:
    two = scale_of(np.array([-1.0, np.nan]), np.array([3.0]))
    assert (two["vmin"], two["vmax"], two["cmap"]) == (-3.0, 3.0, style.DIVERGING)
    one = scale_of(np.array([0.07, 0.16]))
    assert (one["vmin"], one["vmax"], one["cmap"]) == (0.07, 0.16, style.SEQUENTIAL)
    for flat in (np.zeros(3), np.full(3, np.nan)):
        assert scale_of(flat)["vmax"] > scale_of(flat)["vmin"]


def test_bars_of_colours_are_as_high_as_their_panels(field: Floats) -> None:
    figure = pictures.components_figure(field)
    figure.draw_without_rendering()
    bars = [(axes, bar) for axes in figure.axes for bar in axes.child_axes]
    assert len(bars) == 3
    for axes, bar in bars:
        panel, place = axes.get_window_extent(), bar.get_window_extent()
        np.testing.assert_allclose([place.y0, place.y1], [panel.y0, panel.y1], atol=0.5)
        assert place.x0 > panel.x1


def test_a_series_shows_the_means_of_pairs_in_their_order_with_sigma() -> None:
    mean = np.arange(12.0).reshape(4, 3)
    panels = pictures.series_figure(["a", "b", "c", "d"], mean, np.full((4, 3), 0.5)).axes
    for component, panel in enumerate(panels):
        np.testing.assert_array_equal(panel.lines[0].get_xydata(), np.stack([[1, 2, 3, 4], mean[:, component]], 1))
        band = panel.collections[0].get_paths()[0].get_extents()
        assert (band.y0, band.y1) == (mean[0, component] - 0.5, mean[-1, component] + 0.5)
    assert panels[-1].get_xlabel() == "pair, from a to d"


def test_labels_of_convergence_are_those_of_decades_where_there_are_several() -> None:
    pairs = np.array([2, 8, 32])
    scatter = pairs[:, None] ** -0.5 * np.array([1.0, 0.1, 0.001])
    for spread, labelled in ((scatter, False), (scatter[:, [0, 0, 0]], True)):
        figure = convergence_figure(pairs, spread, np.hstack([spread, spread]))
        figure.draw_without_rendering()
        assert any(each.get_text() for each in figure.axes[0].yaxis.get_minorticklabels()) == labelled


def test_panels_of_a_deep_volume_have_room_for_their_numbers_and_bars() -> None:
    grid = Grid.centred((5, 4, 12), (0.5, 0.5, 1.5), (0.0, 0.0, 0.0))
    figure = pictures.compared_figure(grid, {"": np.ones((12, 4, 5, 3))}, "m/s")
    figure.draw_without_rendering()
    *_, narrow, bar = sorted(figure.axes, key=lambda axes: axes.get_position().x0)
    shown = [each.get_window_extent() for each in narrow.get_xticklabels() if each.get_text()]
    assert all(left.x1 < right.x0 for left, right in pairwise(shown))
    assert narrow.title.get_window_extent().y1 < figure.bbox.height - 15
    assert bar.get_window_extent().width > 0.1 * figure.dpi
