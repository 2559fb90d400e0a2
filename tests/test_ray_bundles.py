"""Many rays at once beside the same rays one by one, those that get through and those that do not."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.ray_bundles import aim, aim_all
from lfpiv_cli.optics.surfaces import Cylinder, Plane, Sphere, TiltedPlane
from lfpiv_cli.optics.tracing import disc_points
from lfpiv_cli.simd.faces import (
    AIM_ROWS,
    MISSED,
    SHARE,
    SLOPE_X,
    aim_lanes,
    aim_lanes_reference,
)
from lfpiv_cli.simd.vectors import DOUBLES

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


@njit
def aimed(table, lens_z, vertices, normals, axes, curvatures, ratios):
    aim_lanes(table, lens_z, vertices, normals, axes, curvatures, ratios)


@SPACES
def test_lanes_do_as_their_readable_twins(table2: Camera, rng: np.random.Generator, space: CurvedSpace) -> None:
    faces = space.for_kernels(table2)
    arrays = faces.vertices_mm, faces.normals, faces.axes, faces.curvatures_per_mm, faces.ratios
    for _ in range(20):
        table = np.zeros((AIM_ROWS, DOUBLES))
        points, crossing = everywhere(rng, DOUBLES)
        table[:SLOPE_X] = np.concatenate([points, crossing], axis=1).T
        table[SLOPE_X:MISSED] = rng.uniform(-0.05, 0.05, (2, DOUBLES))
        table[MISSED], table[SHARE] = np.inf, 1.0
        expected = table.copy()
        aim_lanes_reference(expected.ravel(), faces.lens_z_mm, *arrays)
        found = table.copy()
        aimed(found.ravel(), faces.lens_z_mm, *arrays)
        # products and sums are fused, over 200 mm and where light grazes; what a ray that misses leaves is of no matter
        through = np.isfinite(expected[MISSED])
        np.testing.assert_allclose(found[:, through], expected[:, through], rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(np.isfinite(found[MISSED]), through)
