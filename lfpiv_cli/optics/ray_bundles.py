"""Many rays through refracting faces: as many at once as a register of the vector unit holds.

`face_tracing` follows one ray; what is here does the same for arrays of them. Faces that are given by their heights are
met by one ray after the other.

Axes: image axes, z away from the camera from the nominal focal point, mm; slopes as in `face_tracing`.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.optics.face_tracing import (
    CLOSE_MM,
    MOST_STEPS,
    aim,
    in_fluid,
    slope_turns,
    start_at_lens,
    trace_in,
    trace_out,
    trace_pencil,
)
from lfpiv_cli.optics.height_map import Reliefs
from lfpiv_cli.optics.shapes import Vector, row
from lfpiv_cli.optics.surfaces import Faces
from lfpiv_cli.simd.faces import (
    AIM_ROWS,
    BEHIND,
    LENS_X,
    LENS_Y,
    MARGIN,
    MISSED,
    PLACE_X,
    PLACE_Y,
    POINT_X,
    POINT_Y,
    POINT_Z,
    ROUNDING_MM,
    SHARE,
    SLOPE_X,
    SLOPE_Y,
    STEP_X,
    STEP_Y,
    TRACE_ROWS,
    aim_lanes,
    trace_lanes,
)
from lfpiv_cli.simd.formulas import DOUBLES
from lfpiv_cli.threads import COUNT_NO_REFERENCES

Rays = NDArray[np.float64]
Flags = NDArray[np.bool_]


@njit(cache=True)
def trace_all_in(faces: Faces, crossing: Rays, slopes: Rays, z: Rays) -> tuple[Rays, Flags]:
    """Return `trace_in` of each ray: places (n, 2) and whether they are valid (n,)."""
    return _trace_all_in(faces.reliefs, faces, crossing, slopes, z)


# As in `surfaces`: what takes the heights as an argument of its own is compiled without them where there are none.
@njit(cache=True)
def _trace_all_in(reliefs: Reliefs | None, faces: Faces, crossing: Rays, slopes: Rays, z: Rays) -> tuple[Rays, Flags]:
    if reliefs is None:
        return _trace_lanes_in(faces, crossing, slopes, z)
    places, valid = np.empty((len(z), 2)), np.empty(len(z), dtype=np.bool_)
    for i in range(len(z)):
        places[i, 0], places[i, 1], valid[i] = trace_in(
            faces, crossing[i, 0], crossing[i, 1], slopes[i, 0], slopes[i, 1], z[i]
        )
    return places, valid


@njit(cache=True)
def _trace_lanes_in(faces: Faces, crossing: Rays, slopes: Rays, z: Rays) -> tuple[Rays, Flags]:
    places, valid = np.empty((len(z), 2)), np.empty(len(z), dtype=np.bool_)
    table = np.zeros(TRACE_ROWS * DOUBLES)
    for first in range(0, len(z), DOUBLES):
        count = min(DOUBLES, len(z) - first)
        for lane in range(count):
            i = first + lane
            table[lane], table[DOUBLES + lane] = crossing[i, 0], crossing[i, 1]
            table[2 * DOUBLES + lane], table[3 * DOUBLES + lane] = slopes[i, 0], slopes[i, 1]
            table[4 * DOUBLES + lane] = z[i]
        trace_lanes(
            table,
            faces.lens_z_mm,
            faces.vertices_mm,
            faces.normals,
            faces.axes,
            faces.curvatures_per_mm,
            faces.ratios,
        )
        for lane in range(count):
            i, through = first + lane, table[MARGIN * DOUBLES + lane] > 0.0
            places[i, 0] = table[PLACE_X * DOUBLES + lane] if through else np.nan
            places[i, 1] = table[PLACE_Y * DOUBLES + lane] if through else np.nan
            valid[i] = through and table[BEHIND * DOUBLES + lane] >= -ROUNDING_MM
    return places, valid


@njit(cache=True)
def trace_all_out(
    faces: Faces, points: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return `trace_out` of each ray: crossings (n, 2), slopes (n, 2) and whether they are valid (n,)."""
    crossing, slopes, valid = np.empty((len(points), 2)), np.empty((len(points), 2)), np.empty(len(points), np.bool_)
    for i in range(len(points)):
        crossing[i, 0], crossing[i, 1], slopes[i, 0], slopes[i, 1], valid[i] = trace_out(
            faces, row(points, i), row(directions, i)
        )
    return crossing, slopes, valid


@njit(cache=True)
def aim_all(faces: Faces, points: Rays, crossing: Rays) -> tuple[Rays, Flags]:
    """Return `aim` from each point through each crossing: slopes (n, 2) and whether they are valid (n,)."""
    return _aim_all(faces.reliefs, faces, points, crossing)


@njit(cache=True)
def _aim_all(reliefs: Reliefs | None, faces: Faces, points: Rays, crossing: Rays) -> tuple[Rays, Flags]:
    if reliefs is None:
        return _aim_lanes_all(faces, points, crossing)
    slopes, valid = np.empty((len(points), 2)), np.empty(len(points), dtype=np.bool_)
    for i in range(len(points)):
        slopes[i, 0], slopes[i, 1], valid[i] = aim(
            faces, points[i, 0], points[i, 1], points[i, 2], crossing[i, 0], crossing[i, 1]
        )
    return slopes, valid


@njit(cache=True)
def _aim_lanes_all(faces: Faces, points: Rays, crossing: Rays) -> tuple[Rays, Flags]:
    """Return `aim_all`; a lane whose ray is found takes the next one, so that none waits for the slowest."""
    slopes, valid = np.full((len(points), 2), np.nan), np.zeros(len(points), dtype=np.bool_)
    table = np.zeros(AIM_ROWS * DOUBLES)
    ray, steps = np.full(DOUBLES, -1), np.zeros(DOUBLES, np.int64)
    following, running = 0, 0
    while True:
        for lane in range(DOUBLES):
            while ray[lane] < 0 and following < len(points):
                if in_fluid(faces, row(points, following)):
                    _begin(faces, row(points, following), crossing[following, 0], crossing[following, 1], table, lane)
                    ray[lane], steps[lane] = following, 0
                    running += 1
                following += 1
        if running == 0:
            return slopes, valid
        aim_lanes(
            table,
            faces.lens_z_mm,
            faces.vertices_mm,
            faces.normals,
            faces.axes,
            faces.curvatures_per_mm,
            faces.ratios,
        )
        for lane in range(DOUBLES):
            i = ray[lane]
            if i < 0:
                continue
            steps[lane] += 1
            if table[MISSED * DOUBLES + lane] <= CLOSE_MM:
                slopes[i, 0] = table[SLOPE_X * DOUBLES + lane] + table[STEP_X * DOUBLES + lane]
                slopes[i, 1] = table[SLOPE_Y * DOUBLES + lane] + table[STEP_Y * DOUBLES + lane]
                valid[i] = True
            if valid[i] or steps[lane] == MOST_STEPS:
                ray[lane] = -1
                running -= 1


@njit(cache=True, **COUNT_NO_REFERENCES)
def _begin(faces: Faces, point: Vector, X: float, Y: float, table: Rays, lane: int) -> None:
    """Put a ray into a lane of the table of `aim_lanes`, from where `aim` begins."""
    distance = faces.focus_distance_mm + faces.depth_ratio * point[2]
    table[POINT_X * DOUBLES + lane], table[POINT_Y * DOUBLES + lane] = point[0], point[1]
    table[POINT_Z * DOUBLES + lane] = point[2]
    table[LENS_X * DOUBLES + lane], table[LENS_Y * DOUBLES + lane] = X, Y
    table[SLOPE_X * DOUBLES + lane], table[SLOPE_Y * DOUBLES + lane] = X / distance, Y / distance
    table[STEP_X * DOUBLES + lane], table[STEP_Y * DOUBLES + lane] = -point[0] / distance, -point[1] / distance
    table[MISSED * DOUBLES + lane], table[SHARE * DOUBLES + lane] = np.inf, 1.0


@njit(cache=True)
def pencils(
    faces: Faces, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Return, for the ray from each point through the lens' middle, its slopes (n, 2) and their growth (n, 2, 2).

    The growth [k, l] is how slope k grows with the crossing along axis l.
    """
    slopes, growth = np.full((len(points), 2), np.nan), np.full((len(points), 2, 2), np.nan)
    valid = np.empty(len(points), dtype=np.bool_)
    still = (0.0, 0.0, 0.0)
    for i in range(len(points)):
        slopes[i, 0], slopes[i, 1], valid[i] = aim(faces, points[i, 0], points[i, 1], points[i, 2], 0.0, 0.0)
        if not valid[i]:
            continue
        point, direction = start_at_lens(faces, 0.0, 0.0, slopes[i, 0], slopes[i, 1])
        turns, sideways = slope_turns(direction), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
        _, _, a, b, _ = trace_pencil(faces, point, direction, (still, still), turns, points[i, 2])
        _, _, c, d, _ = trace_pencil(faces, point, direction, sideways, (still, still), points[i, 2])
        determinant = a[0] * b[1] - b[0] * a[1]
        # The place stays: [a b] growth + [c d] = 0.
        growth[i, 0, 0] = (b[0] * c[1] - b[1] * c[0]) / determinant
        growth[i, 0, 1] = (b[0] * d[1] - b[1] * d[0]) / determinant
        growth[i, 1, 0] = (a[1] * c[0] - a[0] * c[1]) / determinant
        growth[i, 1, 1] = (a[1] * d[0] - a[0] * d[1]) / determinant
    return slopes, growth, valid
