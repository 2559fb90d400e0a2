"""Rays through planes, cylinders and spheres, written for the vector unit: as many rays at once as a register holds.

`optics.ray_bundles` has the same formulas for one ray, and says what they mean: how far a ray goes to a face, Snell's
law, and how rays beside it are shifted to first order. Rays that miss do not end the work of the others: of what must
be positive for a ray to get through, the smallest is kept as its margin.

Rays are columns of a flat table, `DOUBLES` in a row. Faces are the arrays of `optics.surfaces.Faces`, contiguous.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numpy.typing import NDArray

from lfpiv_cli.simd.vectors import (
    DOUBLE_VECTOR,
    DOUBLES,
    Lanes,
    at_least,
    at_most,
    in_place_of,
    index,
    lanes,
    load_lanes,
    load_one,
    pointers,
    root,
    store_lanes,
    where_above,
)

Doubles = NDArray[np.float64]
# Numbers, or `Lanes` of them.
Three = tuple[Any, Any, Any]

# What a point may lie in front of the face that it touches, and a path go backwards, by rounding.
ROUNDING_MM = 1e-9
# Rows of the table of `aim_lanes`: point and crossing; the slopes of the best ray yet, by how much it misses the point
# (infinite where none has been tried), the step from it to the next, and the share of this that is tried.
AIM_ROWS = 11
POINT_X, POINT_Y, POINT_Z, LENS_X, LENS_Y, SLOPE_X, SLOPE_Y, MISSED, STEP_X, STEP_Y, SHARE = range(AIM_ROWS)


class FaceNumbers(NamedTuple):
    """One face, see `optics.surfaces.Faces`."""

    vertex: Three
    normal: Three
    axis: Three
    curvature: Any
    ratio: Any


class Crossing(NamedTuple):
    """What a ray meets at a face, and how it goes on behind it."""

    path: Any
    place: Three
    normal: Three
    cosine: Any
    cosine_behind: Any
    behind: Three
    margin: Any


def _dot(a: Three, b: Three) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _plus(a: Three, factor: Any, b: Three) -> Three:
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def _scaled(factor: Any, a: Three) -> Three:
    return factor * a[0], factor * a[1], factor * a[2]


def _across(face: FaceNumbers, a: Three) -> Three:
    """Return what of a vector is square to the axis of a face."""
    return _plus(a, -1.0 * _dot(face.axis, a), face.axis)


def _start(slope_x: Any, slope_y: Any) -> Three:
    """Return the direction of a ray into the scene."""
    shortening = 1.0 / root(slope_x * slope_x + slope_y * slope_y + 1.0)
    return -1.0 * slope_x * shortening, -1.0 * slope_y * shortening, shortening


def _cross(face: FaceNumbers, point: Three, direction: Three, margin: Any) -> Crossing:
    """Return what `surfaces.meet` and `ray_bundles.refracted` say of a face."""
    ahead = (face.vertex[2] - point[2]) / direction[2]
    start = _plus(point, ahead, direction)
    offset = _plus(start, -1.0, face.vertex)
    normal = _plus(face.normal, face.curvature, _across(face, offset))
    height = 0.5 * (_dot(face.normal, offset) + _dot(normal, offset))
    rise, across = _dot(normal, direction), _across(face, direction)
    discriminant = rise * rise - 2.0 * face.curvature * _dot(across, across) * height
    cosine = root(at_least(discriminant, 0.0))
    further = -2.0 * height / (rise + cosine)
    normal = _plus(normal, face.curvature * further, across)
    squared = 1.0 - face.ratio * face.ratio * (1.0 - cosine * cosine)
    cosine_behind = root(at_least(squared, 0.0))
    behind = _plus(_scaled(face.ratio, direction), cosine_behind - face.ratio * cosine, normal)
    path = ahead + further
    for needed in (rise, discriminant, path + ROUNDING_MM, squared, behind[2]):
        margin = at_most(margin, needed)
    return Crossing(path, _plus(start, further, direction), normal, cosine, cosine_behind, behind, margin)


def _neighbour(face: FaceNumbers, met: Crossing, direction: Three, shift: Three, turn: Three) -> tuple[Three, Three]:
    """Return what `ray_bundles` says of the shift and the turn, to first order, of a ray beside another."""
    shift = _plus(shift, met.path, turn)
    shift = _plus(shift, -1.0 * _dot(met.normal, shift) / met.cosine, direction)
    tilt = _scaled(face.curvature, _across(face, shift))
    cosine_change = _dot(tilt, direction) + _dot(met.normal, turn)
    bend_change = face.ratio * (face.ratio * met.cosine / met.cosine_behind - 1.0) * cosine_change
    turned = _plus(_scaled(face.ratio, turn), bend_change, met.normal)
    return shift, _plus(turned, met.cosine_behind - face.ratio * met.cosine, tilt)


class _PlainFaces:
    """Faces met by one ray, for the readable twins."""

    def __init__(self, faces: Sequence[Doubles]) -> None:
        vertices, normals, axes, curvatures, ratios = faces
        self._all = [
            FaceNumbers(tuple(vertices[k]), tuple(normals[k]), tuple(axes[k]), curvatures[k], ratios[k])
            for k in range(len(ratios))
        ]

    def each(self, state: Sequence[Any], step: Callable[[FaceNumbers, Sequence[Any]], Sequence[Any]]) -> Sequence[Any]:
        """Return what a step at each face, one after the other, makes of some numbers."""
        for face in self._all:
            state = step(face, state)
        return state


class _LaneFaces:
    """Faces met by many rays at once: code is generated that does what `_PlainFaces` does."""

    def __init__(self, builder: ir.IRBuilder, arrays: Sequence[Any], count: Any) -> None:
        self._builder, self._arrays, self._count = builder, arrays, count

    def each(self, state: Sequence[Any], step: Callable[[FaceNumbers, Sequence[Any]], Sequence[Any]]) -> Sequence[Any]:
        """Return what a step at each face, one after the other, makes of some numbers."""
        builder = self._builder
        slots = [cgutils.alloca_once(builder, DOUBLE_VECTOR) for _ in state]
        for slot, number in zip(slots, state, strict=True):
            builder.store(lanes(builder, number).value, slot)
        with cgutils.for_range(builder, self._count) as loop:
            here = step(self._face(loop.index), [Lanes(builder, builder.load(slot)) for slot in slots])
            for slot, number in zip(slots, here, strict=True):
                builder.store(lanes(builder, number).value, slot)
        return [Lanes(builder, builder.load(slot)) for slot in slots]

    def _face(self, k: Any) -> FaceNumbers:
        vertices, normals, axes, curvatures, ratios = self._arrays
        return FaceNumbers(
            self._row(vertices, k),
            self._row(normals, k),
            self._row(axes, k),
            *(self._at(a, k) for a in (curvatures, ratios)),
        )

    def _row(self, array: Any, k: Any) -> Three:
        first = self._builder.mul(k, index(3))
        x, y, z = (self._at(array, self._builder.add(first, index(axis))) for axis in range(3))
        return x, y, z

    def _at(self, array: Any, place: Any) -> Lanes:
        return lanes(self._builder, load_one(self._builder, array, place))


Faces = _PlainFaces | _LaneFaces


def _aim(faces: Faces, lens_z: Any, rows: Sequence[Any]) -> Sequence[Any]:
    """Return what rows of `aim_lanes` change, from `SLOPE_X` on: a step of Newton's iteration."""
    x, y, z, lens_x, lens_y, slope_x, slope_y, missed, step_x, step_y, share = rows
    tried_x, tried_y = slope_x + share * step_x, slope_y + share * step_y
    start = _start(tried_x, tried_y)
    turn_x = _plus((-1.0 * start[2], 0.0, 0.0), start[2] * start[0], start)
    turn_y = _plus((0.0, -1.0 * start[2], 0.0), start[2] * start[1], start)
    still = (0.0, 0.0, 0.0)

    def step(face: FaceNumbers, state: Sequence[Any]) -> Sequence[Any]:
        direction = _three(state, 3)
        met = _cross(face, _three(state, 0), direction, state[6])
        first = _neighbour(face, met, direction, _three(state, 7), _three(state, 10))
        second = _neighbour(face, met, direction, _three(state, 13), _three(state, 16))
        return *met.place, *met.behind, met.margin, *first[0], *first[1], *second[0], *second[1]

    state = faces.each((lens_x, lens_y, lens_z, *start, 1.0, *still, *turn_x, *still, *turn_y), step)
    direction = _three(state, 3)
    path = (z - state[2]) / direction[2]
    end = _plus(_three(state, 0), path, direction)
    beside = [_plus(_three(state, at), path, _three(state, at + 3)) for at in (7, 13)]
    first, second = (_plus(shift, -1.0 * shift[2] / direction[2], direction) for shift in beside)
    left_x, left_y = x - end[0], y - end[1]
    now = root(left_x * left_x + left_y * left_y)
    determinant = first[0] * second[1] - second[0] * first[1]
    next_x = (second[1] * left_x - second[0] * left_y) / determinant
    next_y = (first[0] * left_y - first[1] * left_x) / determinant
    # Nearer than the best ray yet, and through all faces; else a shorter step is tried.
    better = where_above(state[6], 0.0, missed - now, -1.0)
    found = (tried_x, tried_y, now, next_x, next_y, 1.0)
    before = (slope_x, slope_y, missed, step_x, step_y, 0.5 * share)
    return [where_above(better, 0.0, new, old) for new, old in zip(found, before, strict=True)]


def _three(state: Sequence[Any], first: int) -> Three:
    return state[first], state[first + 1], state[first + 2]


def aim_lanes_reference(table: Doubles, lens_z: float, *faces: Doubles) -> None:
    """Try rays from the lens to points in the fluid, and say what to try next: readable twin of `aim_lanes`.

    Parameters
    ----------
    table : (AIM_ROWS * DOUBLES,) see above
    lens_z, faces : depth of the lens; vertices, normals and axes (m, 3), curvatures and ratios (m,)
    """
    by_row, plain = table.reshape(AIM_ROWS, DOUBLES), _PlainFaces(faces)
    # Rays that miss divide by 0, and say so by how far they miss the point.
    with np.errstate(all="ignore"):
        for lane in range(DOUBLES):
            by_row[SLOPE_X:, lane] = _aim(plain, lens_z, list(by_row[:, lane]))


@in_place_of(aim_lanes_reference)
def aim_lanes(
    typing_context: Any,
    table: Any,
    lens_z: Any,
    vertices: Any,
    normals: Any,
    axes: Any,
    curvatures: Any,
    ratios: Any,
) -> Any:
    """Try rays from the lens to points in the fluid, and say what to try next; see `aim_lanes_reference`."""
    return types.void(table, types.float64, vertices, normals, axes, curvatures, ratios), _generate


def _generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    table, *arrays = pointers(context, builder, signature, arguments, (0, 2, 3, 4, 5, 6))
    ratios = context.make_array(signature.args[6])(context, builder, arguments[6])
    (count,) = cgutils.unpack_tuple(builder, ratios.shape, 1)
    known = [load_lanes(builder, table, index(row * DOUBLES)) for row in range(AIM_ROWS)]
    found = _aim(_LaneFaces(builder, arrays, count), lanes(builder, arguments[1]), known)
    for row, numbers in enumerate(found, start=SLOPE_X):
        store_lanes(builder, lanes(builder, numbers), table, index(row * DOUBLES))
    return context.get_dummy_value()
