"""Weights behind curved faces: columns against counted rays, strips against columns, the fluid's end, files."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.hdf5 import read_tree, write_tree
from lfpiv_cli.files.vtkhdf import open_volume
from lfpiv_cli.files.weights_file import FORMAT, UNITS, VERSION, WeightsFile, open_weights, write_weights
from lfpiv_cli.grid import FOCAL_POINT, Grid
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Window, fluid_path_to_focus
from lfpiv_cli.optics.shapes import HeightMap
from lfpiv_cli.optics.surfaces import Plane, Sphere, TiltedPlane
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.verbs.build_weights import BuildWeightsOptions, build_weights_file, misfit_notices
from lfpiv_cli.verbs.reconstruct import reconstruct_files as reconstruct_images
from lfpiv_cli.weights import strip_blocks
from lfpiv_cli.weights.build import blur_radius_mm, factorise_through
from lfpiv_cli.weights.columns import OnDemandOperator, operator_of, seen_share
from lfpiv_cli.weights.kernels import STRIP
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.quadrature import RayCount, count_rays, integrate_columns, sampling_error
from lfpiv_cli.weights.scene import aimed_misfit_mm, curved_padding, lit_voxels
from lfpiv_cli.weights.strips import StripOperator, evenly_spread, mixed_shares
from tests.commands import table2_rig
from tests.known_rays import assert_adjoint, column_image, tube_of

VOXEL = (0.1, 0.1, 0.1)
# Tiles across the aperture: with as many a column's own error is far below what chance makes of a count.
FINE = 64
# All over the part of the tube that the sensor sees: near its middle, beside it, near both walls, off the focal plane.
PLACES = [(0.05, 0.05, 0.05), (1.05, 0.55, 3.05), (-2.05, 2.05, -4.05), (3.05, -3.05, 2.05), (2.55, 3.45, -2.55)]
PLACES += [(1.05, -3.45, 0.05), (-3.05, 3.05, 1.95), (2.05, -3.35, -1.95), (-1.05, -2.05, 4.35), (0.55, 0.05, -4.85)]
# Beside the axis of a tube along x, up to the wall and beyond it.
BESIDE = Grid.centred((4, 20, 7), (0.1, 0.1, 0.4), (0.6, 2.6, 2.6))


@pytest.fixture
def tube(water):
    """A tube of 10 mm with a wall of 2 mm, along x."""
    return tube_of(water)


@pytest.fixture(scope="module")
def beside(table2, water):
    """A camera, and its weights in strips beside the axis of such a tube."""
    camera = replace(table2, columns=300)
    return camera, operator_of(camera, tube_of(water), BESIDE)


def differences_from_counts(camera, space, places, rays):
    """L1 between columns and counted rays, and what chance makes of that."""
    shape = camera.rows, camera.columns
    for place in places:
        counted = count_rays(camera, space, place, VOXEL, np.random.default_rng(7), RayCount(rays // 5, 5))
        column = integrate_columns(camera, space, [place], VOXEL, FINE).image(0, shape)
        yield np.abs(column - counted).sum(), sampling_error(column, rays)


@pytest.mark.thorough
def test_columns_are_those_of_counted_rays(table2, tube, water):
    ((off, chance),) = differences_from_counts(table2, tube, [(3.05, -3.05, 2.05)], 500_000)
    assert off < 0.01 + chance
    plane = ObjectSpace(water, Window(180.0, 2.0), "exact")
    shape = table2.rows, table2.columns
    wrong = integrate_columns(table2, plane, [(3.05, -3.05, 2.05)], VOXEL).image(0, shape)
    right = integrate_columns(table2, tube, [(3.05, -3.05, 2.05)], VOXEL).image(0, shape)
    assert np.abs(wrong - right).sum() > 1.0  # of 2


@pytest.mark.thorough
def test_columns_through_heights_are_those_through_the_cylinder_they_were_taken_from(table2, tube):
    y = np.arange(-48, 49) / 10.0
    rows = tuple((float(z),) * 20 for z in -np.sqrt(49.0 - y**2))
    heights = replace(tube, faces=(Face(HeightMap(rows, (0.5, 0.1)), 1.49), tube.faces[1]))
    places, shape = [(1.05, -0.55, 2.05), (-1.05, 2.05, -3.05)], (table2.rows, table2.columns)
    expected, found = (integrate_columns(table2, space, places, VOXEL) for space in (tube, heights))
    for k in range(len(places)):
        # slopes differ by 1e-8, 2 nm on the array beside pixels of 5.5 um
        assert np.abs(found.image(k, shape) - expected.image(k, shape)).sum() < 2e-3


@pytest.mark.slow
def test_columns_all_over_a_tube_are_those_of_counted_rays(table2, tube):
    off = [found for found, _ in differences_from_counts(table2, tube, PLACES, 10_000_000)]
    assert np.max(off) < 0.02  # half of it chance


@pytest.fixture
def planes(table2, water, window):
    """Plane faces where `window` has them, and the window as plane layers have it."""
    path = fluid_path_to_focus(window, table2.focus_distance_mm, water)
    inner = Face(Plane(-path), water.fluid)
    return CurvedSpace(water, (Face(Plane(-path - window.thickness_mm), water.window), inner))


@pytest.mark.thorough
def test_plane_faces_have_the_weights_of_plane_layers(table2, water, window, planes):
    camera = replace(table2, columns=500, rows=420)
    layers = ObjectSpace(water, window, "exact")
    grid = Grid.centred((3, 3, 3), (0.1, 0.1, 2.0), (0.2, -0.3, 0.5))
    shape = camera.rows, camera.columns
    for place in [(0.3, -0.4, 2.5), (-0.2, 0.1, -3.0)]:
        columns = [integrate_columns(camera, each, [place], VOXEL).image(0, shape) for each in (layers, planes)]
        assert np.abs(columns[0] - columns[1]).sum() < 1e-4
    strips, whole = operator_of(camera, planes, grid), factorise_through(camera, layers, grid)
    assert isinstance(strips, StripOperator)
    assert strips.blocks.plane.size == 1  # one strip, one part
    for index in np.ndindex(*whole.shape):
        # Means over the aperture and the voxels against a fit through them.
        assert np.abs(column_image(strips, *index) - column_image(whole, *index)).sum() < 0.005


def column_errors(strips, columns, voxels):
    """L1 (n,) between the columns of strips, which light as they say, and converged ones."""
    errors = []
    for voxel in voxels:
        alone = np.zeros(strips.shape, np.float32)
        alone.flat[voxel] = 1.0
        column = column_image(strips, *map(int, np.unravel_index(voxel, strips.shape)))
        np.testing.assert_allclose(strips.forward(alone), column, atol=1e-8)
        centre = columns.centres_mm(np.array([voxel]))
        converged = integrate_columns(columns.camera, columns.source, centre, columns.sides_mm, 128, 5)
        errors.append(np.abs(column - converged.image(0, strips.image_shape)).sum())
    return errors


@pytest.mark.thorough
@pytest.mark.parametrize("column_axis", ["x", "y"])
@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)])
def test_strips_are_adjoint_and_light_what_columns_say(table2, water, rng, column_axis, axis):
    camera = replace(table2, columns=2000, rows=2000, column_axis=column_axis)
    grid = BESIDE if axis[0] else Grid(*((each[1], each[0], each[2]) for each in vars(BESIDE).values()))
    operator = operator_of(camera, tube_of(water, axis), grid)
    assert isinstance(operator, StripOperator)
    assert operator.turned == ((column_axis == "x") != bool(axis[0]))
    weights = Weights(grid, (0, 0, 0), operator, column_axis)
    assert_adjoint(weights, rng)
    errors = column_errors(
        operator, OnDemandOperator(camera, tube_of(water, axis), grid), range(0, operator.lit.size, 41)
    )
    # Beside the axis, where the two axes know most of each other; in the middle of the tube it is 0.005 to 0.02.
    assert np.median(errors) < 0.025
    assert np.max(errors) < 0.035
    assert operator.misfit_l1.max() == pytest.approx(np.max(errors), abs=0.008)  # what it says of itself


@pytest.mark.thorough
def test_strips_are_the_sum_of_their_columns(beside, rng, one_thread):
    _, operator = beside
    volume, image = rng.random(operator.shape, np.float32), rng.random(operator.image_shape, np.float32)
    assert np.unique(operator.blocks.line).size > 1
    assert operator.blocks.plane.size > np.unique(operator.blocks.line).size  # parts of the aperture
    expected, back = np.zeros(operator.image_shape), np.zeros(operator.shape)
    for index in np.ndindex(*operator.shape):
        column = column_image(operator, *index)
        expected += column * np.float64(volume[index])
        back[index] = np.vdot(column, image)
    np.testing.assert_allclose(operator.forward(volume), expected, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(operator.adjoint(image), back, rtol=1e-4, atol=1e-5)
    with one_thread():
        alone = operator.forward(volume), operator.adjoint(image)
    for one, other in zip((operator.forward(volume), operator.adjoint(image)), alone, strict=True):
        np.testing.assert_array_equal(one, other)


# Half a degree beside x in the image, and a third of it away from the camera, as tubes are mounted.
ASLANT = (1.0, np.tan(np.deg2rad(0.5)), np.tan(np.deg2rad(-0.3)))


@pytest.mark.thorough
def test_strips_follow_a_tube_that_runs_a_little_aslant(table2, water, rng, monkeypatch):
    camera, tube = replace(table2, columns=1000, rows=2000), tube_of(water, ASLANT)
    grid = Grid.centred((32, 20, 5), (0.1, 0.1, 0.4), (0.6, 2.6, 2.6))
    operator = operator_of(camera, tube, grid)
    assert isinstance(operator, StripOperator)
    assert_adjoint(operator, rng)
    errors = column_errors(operator, OnDemandOperator(camera, tube, grid), np.flatnonzero(operator.lit)[::97])
    straight = operator_of(camera, tube_of(water), grid)
    for of in (np.median, np.max):
        assert of(errors) < of(straight.misfit_l1) + 0.004  # what mixing may cost
        assert of(operator.misfit_l1) == pytest.approx(of(errors), abs=0.01)  # what it says of itself
    # One factor across each strip would not do: the light at its ends lies beside it.
    monkeypatch.setattr(strip_blocks, "WORTH_DRIFT", 0.0)
    assert isinstance(operator_of(camera, tube, grid), OnDemandOperator)


def test_factors_are_mixed_linearly_between_their_places():
    places, along = np.array([-1.0, 0.5, 2.0]), np.linspace(-1.0, 2.0, 13)
    shares = mixed_shares(along, places)
    assert shares.min() >= 0.0  # no factor takes light away
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    np.testing.assert_allclose(shares @ (3.0 * places + 1.0), 3.0 * along + 1.0)
    np.testing.assert_array_equal(mixed_shares(np.array([-9.0, 9.0]), places), [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    # Points fill the cube evenly.
    for count in (100, 1000):
        points = evenly_spread(count, 3)
        boxes, _ = np.histogramdd(points, 4, [(0.0, 1.0)] * 3)
        assert boxes.sum() == count
        # Of random ones the mean square would be `count / 64`.
        assert np.mean((boxes - count / 64) ** 2) < 0.5 * count / 64


@pytest.mark.thorough
def test_strips_meet_at_their_seams(table2, tube):
    operator = operator_of(table2, tube, BESIDE)
    # The light over the sensor's columns, which changes with the depth that the line of voxels is seen at.
    profiles = [column_image(operator, 1, line, 2).sum(axis=0) for line in range(operator.shape[1])]
    steps = [np.abs(one - other).sum() for one, other in pairwise(profiles)]
    seam = STRIP - 1
    assert steps[seam] < 1.2 * max(steps[seam - 1], steps[seam + 1]) + 0.01


@pytest.mark.thorough
def test_voxels_outside_the_fluid_stay_dark(table2, tube, rng):
    grid = Grid.centred((3, 10, 12), (0.1, 0.1, 1.0), (0.0, 3.0, 0.0))
    camera = replace(table2, columns=400, rows=2200)
    y, z = np.meshgrid(grid.axis_mm(1), grid.axis_mm(2))
    inside = np.broadcast_to((y**2 + z**2 < 25.0)[:, :, np.newaxis], grid.shape_zyx)
    assert 0 < inside.sum() < inside.size
    np.testing.assert_array_equal(lit_voxels(camera, tube, grid), inside)
    for operator in (operator_of(camera, tube, grid), OnDemandOperator(camera, tube, grid)):
        assert Weights(grid, (0, 0, 0), operator, "x").voxels_outside_fluid == np.count_nonzero(~inside)
        back = operator.adjoint(np.ones(operator.image_shape, np.float32))
        assert not back[~inside].any()
        assert (back[inside] > 0.9).all()
        assert not operator.forward((~inside).astype(np.float32)).any()
    strips = operator_of(camera, tube, grid)
    for solver in ("sart", "em"):
        image = strips.forward(rng.random(grid.shape_zyx, np.float32))
        found = reconstruct(strips, image, SolverSettings(solver, 3, 1.0))
        assert np.isfinite(found.volume).all()
        assert not found.volume[~inside].any()
        assert found.volume[inside].any()


@pytest.mark.thorough
def test_what_does_not_separate_is_made_on_demand(table2, tube, water):
    grid = Grid.centred((2, 2, 2), VOXEL, (0.1, 0.2, 0.3))
    turned = replace(table2, lattice=Lattice.regular(0.1, "hexagonal"))
    assert isinstance(operator_of(turned, tube, grid), OnDemandOperator)
    # The tube across the image, which no strips of rows or columns follow.
    oblique = Grid.centred((30, 30, 5), (0.2, 0.2, 1.5), (0.0, 0.0, 0.0))
    assert isinstance(operator_of(table2, tube_of(water, (1.0, 1.0, 0.0)), oblique), OnDemandOperator)


@pytest.mark.thorough
@pytest.mark.parametrize("operator_kind", ["strips", "on demand"])
def test_a_weights_file_holds_them(beside, tube, tmp_path, operator_kind):
    camera, operator = beside
    operator = operator if operator_kind == "strips" else OnDemandOperator(camera, tube, BESIDE)
    path = tmp_path / "weights.h5"
    content = WeightsFile(Weights(BESIDE, (0, 0, 0), operator, "x"), camera, FOCAL_POINT, {})
    write_weights(path, content, False)
    found = open_weights(path)
    for index in [(3, 5, 1), (6, 19, 0)]:
        for one, other in zip(found.column(*index), content.column(*index), strict=True):
            np.testing.assert_array_equal(one, other)
    assert found.weights.voxels_outside_fluid == content.weights.voxels_outside_fluid > 0
    assert read_tree(path, FORMAT, VERSION)[0]["grid"]["voxels_outside_fluid"] == found.weights.voxels_outside_fluid
    if operator_kind == "on demand":
        assert found.weights.solver_operator.source == tube
        return
    np.testing.assert_array_equal(found.weights.solver_operator.misfit_l1, operator.misfit_l1)
    assert misfit_notices(found) == []
    worse = replace(content.weights, solver_operator=replace(operator, misfit_l1=np.array([0.01, 0.05])))
    (notice,) = misfit_notices(replace(content, weights=worse))
    assert (notice.code, notice.measured) == ("weights-inexact", 0.05)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("group", "name", "value"),
    [
        ("strips", "block_line", "shifted by 400"),
        ("strips", "block_plane", "shifted by 400"),
        ("strips", "block_plane", "shifted by -1"),
        ("strips", "block_planes", "shifted by 8"),
        ("strips", "turned", 3),
        ("strips", "misfit_l1", np.array([float("nan")])),
        ("strips", "order", np.zeros(3, np.int32)),
        ("strips", "order", np.arange(3, dtype=np.int32)),
        ("strips", "lit", np.ones((1, 2, 3), np.uint8)),
    ],
)
def test_strips_that_contradict_themselves_are_refused(beside, tmp_path, group, name, value):
    camera, operator = beside
    content = WeightsFile(Weights(BESIDE, (0, 0, 0), operator, "x"), camera, FOCAL_POINT, {})
    write_weights(tmp_path / "weights.h5", content, False)
    tree, provenance = read_tree(tmp_path / "weights.h5", FORMAT, VERSION)
    tree[group][name] = tree[group][name] + int(value.split()[-1]) if isinstance(value, str) else value
    form = {"format_name": FORMAT, "format_version": VERSION, "units": UNITS}
    write_tree(tmp_path / "edited.h5", tree, **form, provenance=provenance, overwrite=False)
    with pytest.raises(InputError, match="not a whole weights file"):
        open_weights(tmp_path / "edited.h5")


@pytest.mark.parametrize(
    "surface",
    [
        Plane(-5.0),
        TiltedPlane((0.0, 0.0, -5.0), (0.1, 0.0, 1.0)),
        Sphere((0.0, 0.0, 1.0), 6.0),
        HeightMap(((-5.0, -5.1, -5.2, -5.4, -5.7),) * 4, (2.0, 3.0), (0.5, 0.0, 0.1)),
    ],
    ids=["plane", "tilted", "sphere", "heights"],
)
def test_a_weights_file_holds_every_kind_of_face(table2, water, tmp_path, surface):
    space = CurvedSpace(water, (Face(surface, water.fluid),))
    grid = Grid.centred((2, 2, 2), VOXEL, (0.0, 0.0, 0.0))
    path = tmp_path / "weights.h5"
    weights = Weights(grid, (0, 0, 0), OnDemandOperator(table2, space, grid), "x")
    write_weights(path, WeightsFile(weights, table2, FOCAL_POINT, {}), False)
    assert open_weights(path).weights.solver_operator.source == space


@pytest.mark.thorough
def test_transmission_scales_pixels_of_turned_strips(table2, water, rng):
    camera = replace(table2, columns=1768, rows=300)
    grid = Grid.centred((20, 4, 3), (0.1, 0.1, 1.0), (2.6, 0.1, 0.0))
    operator = operator_of(camera, tube_of(water, (0.0, 1.0, 0.0)), grid)
    assert operator.turned
    passing, volume = rng.random(operator.image_shape, np.float32), rng.random(operator.shape, np.float32)
    dimmed = operator.behind(passing).forward(volume)
    np.testing.assert_allclose(dimmed, operator.forward(volume) * passing, rtol=1e-5, atol=1e-6)


def test_padding_reaches_as_light_spreads_and_ends_with_the_fluid(table2, tube, water, planes):
    grid = Grid.centred((20, 20, 40), VOXEL, (0.0, 0.0, 0.0))
    radius = blur_radius_mm(table2, water, grid)
    # The spread behind plane faces, which `blur_radius_mm` tells without Snell's law.
    np.testing.assert_allclose(np.array(curved_padding(table2, planes, grid)[:2]), radius / 0.1, atol=1.0)
    wide = Grid.centred((20, 100, 100), VOXEL, (0.0, 0.0, 0.0))
    x, y, z = curved_padding(table2, tube, wide)
    assert x >= 3
    assert (y, z) == (0, 0)


def test_rays_made_for_a_voxel_follow_the_traced_ones(table2, tube):
    grid = Grid.centred((60, 100, 100), VOXEL, (0.0, 0.0, 0.0))
    assert aimed_misfit_mm(table2, tube, grid) < 1e-5
    # What is out of the fluid does not count as out of view.
    smallest, largest = seen_share(table2, tube, Grid.centred((20, 50, 100), VOXEL, (0.0, 0.0, 0.0)))
    assert 0.9 < smallest <= largest < 1.01
    assert seen_share(table2, tube, Grid.centred((2, 2, 2), VOXEL, (0.0, 6.0, 0.0))) == (0.0, 0.0)


@pytest.mark.thorough
@pytest.mark.parametrize("layout", ["square", "hexagonal"])
def test_a_volume_behind_a_tube_is_reconstructed(tube, tmp_path, monkeypatch, layout):
    monkeypatch.setattr(Config, "object_space", lambda *_: tube)
    rig, output = tmp_path / "rig.yaml", tmp_path / "weights.h5"
    volume = {"shape_xyz": [6, 20, 6], "voxel_mm": [0.1, 0.1, 0.5], "centre_mm": [0.0, 1.5, 3.5]}
    solver = {"solver": "em", "iterations": 30}
    rig.write_text(table2_rig(360, 1200, layout, volume=volume, reconstruction=solver))
    reported = build_weights_file(rig, output)
    weights = open_weights(output)
    assert reported["voxels_outside_fluid"] == weights.weights.voxels_outside_fluid > 0
    if layout == "square":
        assert reported["column_misfit_l1_median"] <= reported["column_misfit_l1_largest"] < 0.035
    else:
        assert reported["ray_misfit_mm"] < 1e-5
    assert isinstance(weights.weights.solver_operator, StripOperator if layout == "square" else OnDemandOperator)
    volume = np.zeros(weights.shape, np.float32)
    volume[2, 13, 3] = 1000.0
    image, found = tmp_path / "image.tif", tmp_path / "volume.vtkhdf"
    tifffile.imwrite(image, weights.forward(volume))
    reconstruct_images(output, [image], found)
    light = open_volume(found).array
    assert np.unravel_index(np.argmax(light), light.shape) == (2, 13, 3)
    dry = build_weights_file(rig, tmp_path / "dry.h5", BuildWeightsOptions(dry_run=True))
    assert dry["estimated_weights_bytes"] >= 0.0
    # Fits to traced rays take seconds however small the volume is; columns on demand take nothing beforehand.
    assert (dry["estimated_weights_core_s"] > 1.0) == (layout == "square")
