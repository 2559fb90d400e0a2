"""Many rays at once beside the same rays one by one, those that get through and those that do not."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.face_tracing import aim, trace_in
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.ray_bundles import aim_all, trace_all_in
from lfpiv_cli.optics.surfaces import Cylinder, Plane, Sphere, TiltedPlane
from lfpiv_cli.optics.tracing import disc_points
from lfpiv_cli.simd.faces import (
    AIM_ROWS,
    MISSED,
    SHARE,
    SLOPE_X,
    TRACE_ROWS,
    aim_lanes,
    aim_lanes_reference,
    trace_lanes,
    trace_lanes_reference,
)
from lfpiv_cli.simd.formulas import DOUBLES

WATER = Media(1.0, 1.49, 1.33)
# A tube that is tilted; a thin-walled one, whose sides light never leaves; and one face of each other kind.
TUBE = CurvedSpace(
    WATER,
    tuple(Face(Cylinder((0.1, 0.2, 0.3), (1.0, 0.2, -0.1), r), n) for r, n in ((7.0, 1.49), (5.0, 1.33))),
)
THIN = CurvedSpace(
    WATER, tuple(Face(Cylinder((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), r), n) for r, n in ((5.2, 1.49), (5.0, 1.33)))
)
OTHERS = CurvedSpace(
    WATER,
    (
        Face(Sphere((0.0, 0.0, -60.0), 40.0, "concave"), 1.49),
        Face(TiltedPlane((0.0, 0.0, -12.0), (0.2, 0.1, 1.0)), 1.0),
        Face(Plane(-9.0), 1.6),
        Face(Sphere((0.0, 0.0, 2.0), 6.5), 1.33),
    ),
)
SPACES = pytest.mark.parametrize("space", [TUBE, THIN, OTHERS], ids=["tube", "thin", "others"])


def everywhere(rng: np.random.Generator, count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points all about a tube, in its fluid, in its wall and beyond, and crossings."""
    return rng.uniform((-6, -6, -7), (6, 6, 6), (count, 3)), disc_points(count, 12.5, rng)


@SPACES
def test_rays_traced_together_are_those_traced_one_by_one(
    table2: Camera, rng: np.random.Generator, space: CurvedSpace
) -> None:
    faces, count = space.for_kernels(table2), 501
    crossing = disc_points(count, 12.5, rng)
    slopes = crossing / 185.0 + rng.uniform(-0.045, 0.045, (count, 2))
    slopes[5] = np.nan
    depths = rng.uniform(-5, 5, count)
    places, valid = trace_all_in(faces, crossing, slopes, depths)
    for i in range(count):
        x, y, seen = trace_in(faces, *crossing[i], *slopes[i], depths[i])
        assert valid[i] == seen
        # roundings of 200 mm, which grazing light magnifies
        np.testing.assert_allclose(places[i], (x, y), atol=1e-10)
    assert 0.1 < valid.mean() < 0.9
    assert np.isnan(places).any()


@SPACES
def test_rays_aimed_together_are_those_aimed_one_by_one(
    table2: Camera, rng: np.random.Generator, space: CurvedSpace
) -> None:
    faces = space.for_kernels(table2)
    points, crossing = everywhere(rng, 501)
    slopes, valid = aim_all(faces, points, crossing)
    for i in range(len(points)):
        slope_x, slope_y, seen = aim(faces, *points[i], *crossing[i])
        assert valid[i] == seen
        # a step of Newton's from 1e-6 mm, more where light grazes
        np.testing.assert_allclose(slopes[i], (slope_x, slope_y), atol=1e-11)
    assert 0.1 < valid.mean() < 0.9


@pytest.mark.parametrize("count", [0, 1, DOUBLES - 1, DOUBLES, DOUBLES + 1, 3 * DOUBLES + 2])
def test_a_ray_does_not_depend_on_its_neighbours(table2: Camera, rng: np.random.Generator, count: int) -> None:
    """To the last bit: the same work in other shares makes the same."""
    faces = TUBE.for_kernels(table2)
    points, crossing = everywhere(rng, 60)
    slopes, valid = aim_all(faces, points, crossing)
    some, also = aim_all(faces, points[-count:] if count else points[:0], crossing[-count:] if count else crossing[:0])
    np.testing.assert_array_equal(some, slopes[60 - count :])
    np.testing.assert_array_equal(also, valid[60 - count :])
    places, there = trace_all_in(faces, crossing, slopes, points[:, 2].copy())
    parts = slice(60 - count, 60)
    some, also = trace_all_in(faces, crossing[parts], slopes[parts], points[parts, 2].copy())
    np.testing.assert_array_equal(some, places[parts])
    np.testing.assert_array_equal(also, there[parts])


@njit
def traced(table, lens_z, vertices, normals, axes, curvatures, ratios):
    trace_lanes(table, lens_z, vertices, normals, axes, curvatures, ratios)


@njit
def aimed(table, lens_z, vertices, normals, axes, curvatures, ratios):
    aim_lanes(table, lens_z, vertices, normals, axes, curvatures, ratios)


@SPACES
@pytest.mark.parametrize(
    ("intrinsic", "twin", "rows"),
    [(traced, trace_lanes_reference, TRACE_ROWS), (aimed, aim_lanes_reference, AIM_ROWS)],
    ids=["trace", "aim"],
)
def test_lanes_do_as_their_readable_twins(
    table2: Camera, rng: np.random.Generator, space: CurvedSpace, intrinsic, twin, rows: int
) -> None:
    faces = space.for_kernels(table2)
    arrays = faces.vertices_mm, faces.normals, faces.axes, faces.curvatures_per_mm, faces.ratios
    for _ in range(20):
        table = np.zeros((rows, DOUBLES))
        if rows == AIM_ROWS:
            points, crossing = everywhere(rng, DOUBLES)
            table[:SLOPE_X] = np.concatenate([points, crossing], axis=1).T
            table[SLOPE_X:MISSED] = rng.uniform(-0.05, 0.05, (2, DOUBLES))
            table[MISSED], table[SHARE] = np.inf, 1.0
        else:
            table[:2], table[2:4] = disc_points(DOUBLES, 12.5, rng).T, rng.uniform(-0.06, 0.06, (2, DOUBLES))
        expected = table.copy()
        twin(expected.ravel(), faces.lens_z_mm, *arrays)
        found = table.copy()
        intrinsic(found.ravel(), faces.lens_z_mm, *arrays)
        # products and sums are fused, over 200 mm and where light grazes; what a ray that misses leaves is of no matter
        through = expected[2] > 0.0 if rows == TRACE_ROWS else np.isfinite(expected[MISSED])
        np.testing.assert_allclose(found[:, through], expected[:, through], rtol=1e-9, atol=1e-10)
        kept = found[2] > 0.0 if rows == TRACE_ROWS else np.isfinite(found[MISSED])
        np.testing.assert_array_equal(kept, through)
