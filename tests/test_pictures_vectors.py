"""Figures of vector fields: what they show, on what scale, under which names."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.flow.field import MASKED, REJECTED, VALID, VectorField
from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures import vectors as pictures
from lfpiv_cli.reference import Reference
from lfpiv_cli.verbs.plot import figures_of

pytest.importorskip("matplotlib")
from matplotlib.quiver import Quiver, QuiverKey  # noqa: E402

AT_FOCUS = Reference("focal_point", 0.0)
SAMPLE = Path(__file__).parents[1] / "configs" / "sample.yaml"
SHAPE = (5, 4, 3)  # z, y, x


@pytest.fixture
def field() -> VectorField:
    """A turn about z and a steady stream along x, one missing vector in the middle of all planes."""
    grid = Grid.centred(SHAPE[::-1], (0.5, 0.5, 1.0), (0.0, 0.0, 2.0))
    x, y = grid.centres_mm()[..., 0], grid.centres_mm()[..., 1]
    displacement = np.stack([3.0 - y, x, np.zeros(SHAPE)], axis=-1)
    flag = np.full(SHAPE, VALID, dtype=np.uint8)
    flag[2, 2, 1], flag[0, 0, 0] = REJECTED, MASKED
    ones = np.ones(SHAPE)
    sigma = np.broadcast_to([0.01, 0.02, 0.3], displacement.shape).copy()
    return VectorField(
        grid, displacement, displacement, 0.9 * ones, 2.0 * ones, ones, flag, sigma, (0.1,) * 3, 1e-3, (8,) * 3
    )


def panels(figure):
    return [axes for axes in figure.axes if axes.get_xlabel().endswith("(mm)") and axes.get_ylabel().endswith("(mm)")]


def image_of(axes) -> np.ndarray:
    return np.ma.filled(axes.images[0].get_array().astype(float), np.nan)


def test_planes_have_arrows_in_them_and_the_component_across_on_one_scale(field) -> None:
    figure = pictures.planes_figure(field)
    first, second, third = panels(figure)
    assert [axes.get_title() for axes in (first, second, third)] == [
        "w\nx-y at z = 2.00 mm",
        "v\nx-z at y = 0.25 mm",
        "u\ny-z at x = 0.00 mm",
    ]
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


def test_slow_flows_are_told_in_mm_per_s_and_those_without_a_time_in_voxels(field) -> None:
    slow = pictures.shown(replace(field, dt_s=0.1))
    assert slow.unit == "mm/s"
    np.testing.assert_allclose(slow.values[2, 1, 1], field.displacement_voxel[2, 1, 1])
    np.testing.assert_allclose(slow.sigma[2, 1, 1], [0.01, 0.02, 0.3])
    timeless = pictures.shown(replace(field, dt_s=None))
    assert timeless.unit == "voxel"
    assert np.isnan([timeless.values[2, 2, 1], timeless.sigma[2, 2, 1]]).all()
    np.testing.assert_array_equal(timeless.values[2, 1, 1], field.displacement_voxel[2, 1, 1])


def test_components_have_one_symmetric_scale_each(field) -> None:
    figure = pictures.components_figure(field)
    rows = np.array(panels(figure)).reshape(3, 3)
    np.testing.assert_array_equal(image_of(rows[1, 2]), field.velocity[:, :, 1, 1])
    for row in rows:
        (limits,) = {axes.images[0].get_clim() for axes in row}
        assert limits[0] == -limits[1]
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert [f"{name} (m/s)" in labels for name in "uvw"] == [True] * 3


def test_sigma_has_one_scale_and_blanks_what_is_missing(field) -> None:
    figure = pictures.sigma_figure(field)
    rows = np.array(panels(figure)).reshape(3, 3)
    assert len({axes.images[0].norm for axes in rows.ravel()}) == 1
    np.testing.assert_allclose(np.nanmax(image_of(rows[2, 0])), 0.03)
    assert np.isnan(image_of(rows[2, 0])[2, 1])
    with pytest.raises(ValueError, match="uncertainty"):
        pictures.sigma_figure(replace(field, uncertainty_voxel=None))


def test_flags_are_counted_by_name(field) -> None:
    figure = pictures.flags_figure(field)
    (legend,) = figure.legends
    texts = [text.get_text() for text in legend.get_texts()]
    assert texts == ["valid: 58", "rejected: 1", "masked: 1"]
    np.testing.assert_array_equal(image_of(panels(figure)[0]), field.flag[2])


def test_profiles_are_means_over_planes_with_a_band_of_sigma(field) -> None:
    figure = pictures.profiles_figure(field)
    axes = np.array(figure.axes).reshape(3, 3)
    along_y = axes[0, 1].lines[1]
    np.testing.assert_allclose(along_y.get_xdata(), field.grid.axis_mm(1))
    np.testing.assert_allclose(along_y.get_ydata(), np.nanmean(field.velocity[..., 0], axis=(0, 2)))
    band = axes[2, 0].collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == (pytest.approx(-0.03), pytest.approx(0.03))


@pytest.mark.thorough
def test_displacements_show_their_parts_beyond_whole_voxels_and_microlenses(field) -> None:
    axes = np.array(pictures.displacements_figure(field, lens_mm=0.4).axes).reshape(3, 3)
    valid = field.displacement_voxel[field.flag == VALID]
    for row, size in ((1, 1.0), (2, 4.0)):
        parts = valid[:, 0] / size
        counts, _ = np.histogram(parts - np.round(parts), bins=20, range=(-0.5, 0.5))
        np.testing.assert_array_equal([bar.get_height() for bar in axes[row, 0].patches], counts)
    assert sum(bar.get_height() for bar in axes[0, 1].patches) == len(valid)
    assert pictures.displacements_figure(field).axes[-1].get_xlabel() == "w beyond whole voxels (voxels)"


def test_gradients_show_the_turn_and_no_divergence_on_one_scale(field) -> None:
    whole = replace(field, flag=np.zeros(SHAPE, np.uint8))
    rows = np.array(panels(pictures.gradients_figure(whole))).reshape(2, 3)
    # displacements of 1 voxel per mm of 0.1 mm in 1 ms: rates of 100/s, twice that as vorticity
    np.testing.assert_allclose(image_of(rows[0, 0]), 200.0)
    np.testing.assert_allclose(image_of(rows[1, 2]), 0.0, atol=1e-9)
    assert len({axes.images[0].get_clim() for axes in rows.ravel()}) == 1
    with pytest.raises(ValueError, match="time"):
        pictures.gradients_figure(replace(field, dt_s=None))


@pytest.mark.thorough
def test_figures_of_a_file_follow_what_it_knows(field, tmp_path) -> None:
    path = tmp_path / "vectors.vtkhdf"
    varied = replace(field, correlation=np.linspace(0.2, 0.9, 60).reshape(SHAPE))
    write_vectors(path, varied, AT_FOCUS, provenance={}, overwrite=True)
    figures = figures_of(path)
    assert list(figures) == [
        "planes",
        "components",
        "profiles",
        "sigma",
        "flags",
        "quality",
        "displacements",
        "gradients",
    ]
    assert "correlation at the peak." in figures["quality"].caption
    drawn = figures["quality"].draw()
    np.testing.assert_array_equal(image_of(panels(drawn)[0]), varied.correlation[2])
    assert len(figures["displacements"].draw().axes) == 6
    # With the camera known, what displacements are beyond whole microlenses (0.1 mm) is shown, too.
    write_vectors(path, varied, AT_FOCUS, provenance={"config": load_config(SAMPLE).resolved()}, overwrite=True)
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
