"""Columns on demand and kept: adjointness in both kinds of lattice, agreement of the operators, lines of sight."""

from dataclasses import replace

import numpy as np
import pytest
import tifffile
from click.testing import CliRunner

from lfpiv_cli.cli.main import cli
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.vtkhdf import open_volume
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics import tracing
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.optics.tracing import ObjectSpace, PolynomialRays, complete_exponents, disc_points, polynomial_terms
from lfpiv_cli.weights import columns as columns_module
from lfpiv_cli.weights.build import factorise, factorise_bricks
from lfpiv_cli.weights.columns import ColumnOperator, OnDemandOperator, operator_of
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.operators import FactorisedOperator
from lfpiv_cli.weights.quadrature import RayCount, count_columns, integrate_columns
from tests.commands import table2_rig
from tests.known_rays import assert_adjoint, column_image, slopes_equivalent

GRID = Grid.centred((4, 3, 5), (0.1, 0.12, 0.8), (0.1, -0.1, 0.5))
# As far across, with voxels enough to tell the axes apart.
FEW = Grid.centred((3, 2, 4), (0.15, 0.2, 1.0), (0.1, -0.1, 0.5))


@pytest.fixture
def turned(table2, layout):
    """Table 2 with a small sensor and a turned array of either kind."""
    return replace(table2, columns=380, rows=260, lattice=Lattice.regular(0.1, layout, 0.01, (0.013, -0.021)))


def cubic_rays():
    """Rays fitted somewhere: Table 2's in focus, bent by all terms of third degree."""
    exponents = complete_exponents(3)
    bent = np.random.default_rng(5).normal(0.0, 2e-3, (len(exponents), 2))
    for axis in range(2):
        bent[exponents[:, axis] * (exponents.sum(axis=1) == 1) == 1, axis] -= 1.0
    return PolynomialRays(np.array([1.0, 1.0, 4.0, 12.5, 12.5]), exponents, bent)


@pytest.mark.thorough
@pytest.mark.parametrize("method", ["ert", "drt", "dlfc"])
@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_forward_and_adjoint_are_adjoint(turned, water, window, rng, column_axis, method):
    camera = replace(turned, column_axis=column_axis)
    source = cubic_rays() if method == "dlfc" else ObjectSpace(water, window, "exact", method)
    on_demand = OnDemandOperator(camera, source, FEW)
    kept = on_demand.restricted(np.ones(on_demand.image_shape, np.float32))
    for operator in (on_demand, kept, Weights(FEW, (0, 0, 0), on_demand, column_axis)):
        assert_adjoint(operator, rng)


def fitted_to(space, camera, depths_mm=(-1.5, -0.5, 0.5, 1.5, 2.5), twist=0.0):
    """Polynomials through traced rays; `twist` lets x follow y on the array."""
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-0.6, 0.6, (4000, 2)), rng.choice(depths_mm, 4000)])
    lens = disc_points(4000, camera.aperture_radius_mm, rng)
    array = tracing.trace(camera, lens, slopes_equivalent(points, lens, camera, space.media)).array_mm
    array[:, 0] += twist * array[:, 1]
    scale, exponents = np.array([0.6, 0.6, 2.5, 12.5, 12.5]), complete_exponents(3)
    terms = polynomial_terms(np.column_stack([points, lens]) / scale, exponents)
    return PolynomialRays(scale, exponents, np.linalg.lstsq(terms, array, rcond=None)[0])


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_fitted_rays_factorise_where_their_axes_separate(table2, water, column_axis):
    camera = replace(table2, columns=380, rows=260, column_axis=column_axis, distortion_per_mm2=2e-3)
    space = ObjectSpace(water, None, "paraxial")
    rays = fitted_to(space, camera)
    operator = operator_of(camera, rays, GRID)
    assert isinstance(operator, FactorisedOperator)
    on_demand = OnDemandOperator(camera, rays, GRID)
    errors = []
    for index in list(np.ndindex(*operator.shape))[::7]:
        centre = on_demand.centres_mm(np.array([np.ravel_multi_index(index, operator.shape)]))
        converged = integrate_columns(camera, rays, centre, on_demand.sides_mm, 128, 5).image(0, operator.image_shape)
        errors.append(np.abs(converged - column_image(operator, *index)).sum())
    # The rim of the aperture, as for traced rays: 0.01 on average, 0.02 at most; a tenth more for the distortion.
    assert np.mean(errors) < 0.015
    assert np.max(errors) < 0.03
    assert isinstance(operator_of(camera, fitted_to(space, camera, twist=0.03), GRID), OnDemandOperator)


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_columns_agree_with_the_factorised_form(table2, water, rng, column_axis):
    camera = replace(table2, columns=380, rows=260, column_axis=column_axis)
    volume = rng.random(GRID.shape_zyx, dtype=np.float32)
    images = [
        Weights(GRID, (0, 0, 0), operator, column_axis).forward(volume)
        for operator in (
            factorise(camera, water, GRID),
            OnDemandOperator(camera, ObjectSpace(water, None, "paraxial"), GRID),
        )
    ]
    # Each column of either form is off by one to two per cent; errors of neighbours cancel in part.
    assert np.abs(images[0] - images[1]).sum() < 0.03 * images[0].sum()


@pytest.mark.thorough
def test_column_is_the_image_of_one_voxel_and_columns_that_are_too_many_are_refused(turned, water, monkeypatch):
    operator = OnDemandOperator(turned, ObjectSpace(water, None, "paraxial"), GRID)
    volume = np.zeros(operator.shape, np.float32)
    volume[3, 1, 2] = 1.0
    np.testing.assert_array_equal(operator.forward(volume), column_image(operator, 3, 1, 2))
    kept = operator.restricted(operator.forward(volume))
    for one, other in zip(kept.column(3, 1, 2), operator.column(3, 1, 2), strict=True):
        np.testing.assert_array_equal(one, other)
    monkeypatch.setattr(columns_module, "LARGEST_BYTES", 1000)
    with pytest.raises(InputError, match="60 voxels"):
        operator.restricted(np.ones(operator.image_shape, np.float32))


@pytest.mark.thorough
def test_lines_of_sight_keep_what_is_lit_and_leave_most_out(turned, water):
    grid = Grid.centred((12, 12, 12), (0.1, 0.1, 0.6), (0.0, 0.0, 0.0))
    operator = OnDemandOperator(turned, ObjectSpace(water, None, "paraxial"), grid)
    volume = np.zeros(operator.shape, np.float32)
    volume[2, 3, 4] = volume[8, 9, 2] = 1.0
    kept = operator.can_be_lit(operator.forward(volume)).reshape(operator.shape)
    assert kept[2, 3, 4]
    assert kept[8, 9, 2]
    assert kept.mean() < 0.1
    restricted = operator.restricted(operator.forward(volume))
    np.testing.assert_allclose(restricted.forward(volume), operator.forward(volume), atol=1e-7)


def test_columns_are_kept_for_many_steps_where_they_fit_and_a_dark_image_has_none(turned, water, rng, monkeypatch):
    operator = OnDemandOperator(turned, ObjectSpace(water, None, "paraxial"), GRID)
    kept = operator.kept()
    assert isinstance(kept, ColumnOperator)
    volume = rng.random(operator.shape, dtype=np.float32)
    # Sums in another order of float32.
    np.testing.assert_allclose(kept.forward(volume), operator.forward(volume), atol=1e-6)
    monkeypatch.setattr(columns_module, "LARGEST_BYTES", 1000)
    assert operator.kept() is operator
    dark = np.zeros(operator.image_shape, np.float32)
    restricted = operator.restricted(dark)
    assert restricted.voxel.size == 0
    assert not restricted.adjoint(dark + 1.0).any()


@pytest.mark.thorough
def test_same_bits_for_any_number_of_threads(turned, water, rng, one_thread):
    operator = OnDemandOperator(turned, ObjectSpace(water, None, "paraxial"), GRID)
    volume = rng.random(operator.shape, dtype=np.float32)
    with one_thread():
        image = operator.forward(volume)
        back = operator.adjoint(image)
    assert np.array_equal(image, operator.forward(volume))
    assert np.array_equal(back, operator.adjoint(image))


def test_counted_columns_agree_with_integrated_ones(turned, water, rng):
    grid = Grid.centred((2, 1, 2), (0.1, 0.1, 1.0), (0.0, 0.1, 2.0))
    operator = OnDemandOperator(turned, ObjectSpace(water, None, "paraxial"), grid)
    centres = operator.centres_mm(np.arange(4))
    counted = count_columns(
        turned, operator.source, centres, turned.to_image_axes(grid.spacing_mm), rng, RayCount(2000, 100)
    )
    for n in range(4):
        exact = operator.columns_of(np.array([n])).image(0, operator.image_shape)
        assert np.abs(counted.image(n, operator.image_shape) - exact).sum() < 0.12  # 2000 points: about 0.07


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
def test_bricks_are_adjoint_and_nearly_hexagons(table2, water, rng, column_axis):
    lattice = Lattice.regular(0.1, "hexagonal", 0.0, (0.013, -0.021))
    camera = replace(table2, columns=380, rows=260, lattice=lattice, column_axis=column_axis)
    bricks = factorise_bricks(camera, water, GRID)
    hexagons = OnDemandOperator(camera, ObjectSpace(water, None, "paraxial"), GRID)
    assert_adjoint(bricks, rng)
    alone = np.zeros(bricks.shape, np.float32)
    alone[2, 1, 1] = 1.0
    np.testing.assert_allclose(column_image(bricks, 2, 1, 1), bricks.forward(alone), atol=1e-8)
    # One ray in twelve goes to the next lens; a displaced row or half a pitch would move half of them and more.
    off = [np.abs(bricks.forward(unit) - hexagons.forward(unit)).sum() for unit in units(alone, rng)]
    assert np.mean(off) < 2.0 / 12.0 + 0.05
    assert bricks.forward(alone).sum() == pytest.approx(1.0, abs=1e-3)


def units(like, rng):
    """Ten volumes of one voxel each."""
    for flat in rng.choice(like.size, 10, replace=False):
        unit = np.zeros_like(like)
        unit.flat[flat] = 1.0
        yield unit


@pytest.mark.parametrize(
    "lattice", [Lattice.regular(0.1), Lattice.regular(0.1, "hexagonal", 0.01)], ids=["square", "turned"]
)
def test_bricks_need_an_upright_hexagonal_array(table2, water, lattice):
    with pytest.raises(ConfigError, match="rows along the sensor's"):
        factorise_bricks(replace(table2, lattice=lattice), water, GRID)


PLAIN = {"padding_voxel": [0, 0, 0], "iterations": 5}
VOLUME = {"shape_xyz": [5, 4, 3], "voxel_mm": [0.1, 0.1, 0.4]}


def rig_of(folder, volume=VOLUME, **sections):
    path = folder / "rig.yaml"
    path.write_text(table2_rig(240, 200, "hexagonal", volume=volume, reconstruction=PLAIN, **sections))
    return path


def build(path, *options):
    output = path.with_name("weights.h5")
    CliRunner().invoke(cli, ["build-weights", str(path), "-o", str(output), *options], catch_exceptions=False)
    return output


def test_a_hexagonal_rig_is_reconstructed_from_columns_on_demand(tmp_path):
    weights = open_weights(build(rig_of(tmp_path)))
    assert weights.weights.on_demand
    volume = np.zeros(weights.shape, np.float32)
    volume[1, 2, 3] = 1000.0
    image, output = tmp_path / "image.tif", tmp_path / "volume.vtkhdf"
    tifffile.imwrite(image, weights.forward(volume))
    arguments = ["reconstruct", str(tmp_path / "weights.h5"), str(image), "-o", str(output)]
    CliRunner().invoke(cli, arguments, catch_exceptions=False)
    found = open_volume(output).array
    assert np.unravel_index(np.argmax(found), found.shape) == (1, 2, 3)


@pytest.mark.thorough
def test_counted_rays_share_the_file_format(tmp_path):
    rig = rig_of(tmp_path, weights={"points": 400, "rays_per_point": 50})
    counted = open_weights(build(rig, "--sampling", "rays"))
    assert not counted.weights.on_demand
    assert isinstance(open_weights(build(rig, "--overwrite")).weights.solver_operator, OnDemandOperator)
    rows, columns, weights = counted.column(1, 2, 3)
    assert weights.sum() == pytest.approx(1.0, abs=1e-5)
    assert (rows.max(), columns.max()) < counted.image_shape


def test_counting_too_many_rays_is_refused_with_its_cost(tmp_path):
    rig = rig_of(tmp_path, {"shape_xyz": [80, 80, 240], "voxel_mm": 0.1})
    with pytest.raises(ConfigError, match="core hours"):
        build(rig, "--sampling", "rays")
