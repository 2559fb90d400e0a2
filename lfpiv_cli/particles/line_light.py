"""The light of one particle by line responses: under each lens a sum of products of a row's and a column's.

Each pixel belongs to one lens's cell, whose light is that of all lenses, so that no pixel is lit twice. Along each axis
the responses are interpolated by cubics in the spot's place about the lens, in depth and in the pixel's place under the
lens; derivatives are those of the same cubics.

Axes and values: see `response`; `optics.line_responses` has the theory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lfpiv_cli.particles.refraction import Bend
from lfpiv_cli.particles.response import Along, lenses_of, project
from lfpiv_cli.particles.view import View
from lfpiv_cli.threads import COUNT_NO_REFERENCES

# Responses along one axis: the light's, and its derivatives by the spot's place and by depth.
LIGHT, BY_OFFSET, BY_DEPTH = range(3)
KINDS = 3
# Pixels of a row that are worked on side by side.
LANES = 8
Lines = NDArray[np.float32]


class Cell(NamedTuple):
    """Pixels of a lens's cell along one axis.

    Attributes
    ----------
    first, number : the first one, and how many
    place : of the first from the middle of the lens image, pixels
    """

    first: int
    number: int
    place: float


@njit(cache=True)
def respond_by_lines(view: View, bend: Bend, z: float, pixels: NDArray[np.int32], values: NDArray[np.float64]) -> int:
    """Write the entries of a particle of unit light at depth z; see `rows.respond_rows`."""
    projection = project(view, bend)
    x, y = projection.x, projection.y
    low_i, high_i, low_j, high_j = lenses_of(view, projection, bend)
    centres = view.centres_mm
    # Cells end halfway to the neighbours, of which the outermost lenses, beyond the sensor, have none.
    low_i, high_i = max(low_i, 1), min(high_i, centres.shape[1] - 2)
    low_j, high_j = max(low_j, 1), min(high_j, centres.shape[0] - 2)
    if low_i > high_i or low_j > high_j:
        return 0
    # Lenses of a column, and of a row, have nearly the same place along one axis: that of the middle one.
    middle_i, middle_j = (low_i + high_i) // 2, (low_j + high_j) // 2
    room = np.empty((KINDS, view.lines.table.shape[3], LANES * (view.lines.table.shape[4] // LANES + 1)), np.float32)
    across, down = np.empty_like(room), np.empty_like(room)
    of_columns = _responses(view, x, z, centres[middle_j, low_i : high_i + 1, 0])
    of_rows = _responses(view, y, z, centres[low_j : high_j + 1, middle_i, 1])
    # What lies between a cell's last pixel and the end of its lanes is worked on, and not written.
    across[:] = np.float32(0.0)
    row = np.empty((4, room.shape[2]), np.float32)
    count = 0
    for j in range(low_j, high_j + 1):
        for i in range(low_i, high_i + 1):
            s_x, s_y = centres[j, i, 0], centres[j, i, 1]
            of_x = _cell(view, centres[j, i - 1, 0], s_x, centres[j, i + 1, 0], x.pixels)
            if of_x.number <= 0:
                continue
            of_y = _cell(view, centres[j - 1, i, 1], s_y, centres[j + 1, i, 1], y.pixels)
            if of_y.number <= 0 or count + of_x.number * of_y.number > pixels.size:
                continue
            _place(of_columns[i - low_i], of_x, centres[middle_j, i, 0] - s_x, across)
            _place(of_rows[j - low_j], of_y, centres[j, middle_i, 1] - s_y, down)
            _join(view, x, y, of_x, of_y, across, down, row, pixels[count:], values[:, count:])
            count += of_x.number * of_y.number
    return count


@njit(cache=True, **COUNT_NO_REFERENCES)
def _cell(view: View, before: float, lens: float, behind: float, pixels: int) -> Cell:
    """Return the pixels of a lens's cell along one axis of the sensor, by the places of three lenses on the array."""
    camera, middle = view.camera, 0.5 * (pixels - 1)
    to_px = (1.0 + camera.microlens_distance_mm / camera.image_distance_mm) / camera.pixel_mm
    # Cubics need a value more on either side.
    centre, reach = lens * to_px + middle, 0.5 * view.lines.table.shape[4] - 1.0
    low = max(0.5 * (before + lens) * to_px + middle, centre - reach)
    high = min(0.5 * (lens + behind) * to_px + middle, centre + reach)
    first = max(int(np.ceil(low)), 0)
    return Cell(first, min(int(np.ceil(high)), pixels) - first, first - centre)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _cubic(t: float) -> tuple[float, float, float, float]:
    """Return the weights of four neighbouring values for one that lies t, 0 to 1, behind the second (Catmull-Rom)."""
    return (
        t * (-0.5 + t * (1.0 - 0.5 * t)),
        1.0 + t * t * (-2.5 + 1.5 * t),
        t * (0.5 + t * (2.0 - 1.5 * t)),
        t * t * (-0.5 + 0.5 * t),
    )


@njit(cache=True, **COUNT_NO_REFERENCES)
def _slopes(t: float) -> tuple[float, float, float, float]:
    """Return the derivatives of `_cubic`."""
    return (
        -0.5 + t * (2.0 - 1.5 * t),
        t * (-5.0 + 4.5 * t),
        0.5 + t * (4.0 - 4.5 * t),
        t * (-1.0 + 1.5 * t),
    )


@njit(cache=True, fastmath=True)
def _responses(view: View, along: Along, z: float, lenses_mm: NDArray[np.float64]) -> Lines:
    """Return responses (lenses, KINDS, phases, terms, pixels) under lenses at these places along one axis.

    A stretched spot is that of a stretched depth; beyond the table's depths it is that of its ends.
    """
    lines = view.lines
    depths, offsets, phases, terms, width = lines.table.shape
    found = np.zeros((lenses_mm.size, KINDS, phases * terms * width), np.float32)
    deep = (along.stretch * z - lines.first_depth_mm) / lines.depth_step_mm
    deep = min(max(deep, 1.0), depths - 2.001)
    first_z = int(deep)
    by_z, d_z = _cubic(deep - first_z), _slopes(deep - first_z)
    for lens in range(lenses_mm.size):
        beside = (along.at - lenses_mm[lens]) / lines.offset_step_mm + 0.5 * (offsets - 1)
        if beside < 1.0 or beside >= offsets - 2.0:
            continue
        first_x = int(beside)
        by_x, d_x = _cubic(beside - first_x), _slopes(beside - first_x)
        light, by_offset, by_depth = found[lens, LIGHT], found[lens, BY_OFFSET], found[lens, BY_DEPTH]
        for a in range(4):
            for b in range(4):
                source = lines.table[first_z - 1 + a, first_x - 1 + b].ravel()
                w = np.float32(by_z[a] * by_x[b])
                w_x = np.float32(by_z[a] * d_x[b] / lines.offset_step_mm)
                w_z = np.float32(d_z[a] * by_x[b] * along.stretch / lines.depth_step_mm)
                for n in range(source.size):
                    light[n] += w * source[n]
                    by_offset[n] += w_x * source[n]
                    by_depth[n] += w_z * source[n]
    return found.reshape((lenses_mm.size, KINDS, phases, terms, width))


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def _place(responses: Lines, cell: Cell, moved_mm: float, out: Lines) -> None:
    """Fill in the responses of a cell's pixels (KINDS, terms, pixels), of a lens from which the spot lies further."""
    _, phases, terms, width = responses.shape
    place = (cell.place + 0.5 * width) * phases
    first = int(np.floor(place))
    p, q, r, t = _cubic(place - first)
    a, b, c, d = np.float32(p), np.float32(q), np.float32(r), np.float32(t)
    moved = np.float32(moved_mm)
    # Of two phases, the first of the four values belongs to the one, the next to the other.
    one, other = (first - 1) % phases, first % phases
    from_one, from_other = (first - 1) // phases, first // phases
    for k in range(terms):
        for kind in range(KINDS):
            target = out[kind, k]
            before, behind = responses[kind, one, k, from_one:], responses[kind, other, k, from_other:]
            for n in range(cell.number):
                target[n] = a * before[n] + b * behind[n] + c * before[n + 1] + d * behind[n + 1]
        target = out[LIGHT, k]
        for n in range(cell.number):
            target[n] += moved * out[BY_OFFSET, k, n]


@njit(cache=True, fastmath=True, **COUNT_NO_REFERENCES)
def _join(
    view: View,
    x: Along,
    y: Along,
    of_x: Cell,
    of_y: Cell,
    across: Lines,
    down: Lines,
    row: Lines,
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
) -> None:
    """Write the entries of one lens from its responses along both axes."""
    terms, columns = across.shape[1], of_x.number
    # The spot moves by these with x and y, and by these with z.
    move_x, move_y = -x.beta * x.stretch, -y.beta * y.stretch
    drift_x, drift_y = -x.slope * x.x * x.stretch, -y.slope * y.x * y.stretch
    groups = (columns + LANES - 1) // LANES
    at = 0
    for m in range(of_y.number):
        row[:] = np.float32(0.0)
        for k in range(terms):
            sign = view.lines.signs[k]
            b, b_y, b_z = sign * down[LIGHT, k, m], sign * down[BY_OFFSET, k, m], sign * down[BY_DEPTH, k, m]
            for group in range(groups):
                for lane in range(LANES):
                    n = LANES * group + lane
                    a = across[LIGHT, k, n]
                    row[0, n] += a * b
                    row[1, n] += across[BY_OFFSET, k, n] * b
                    row[2, n] += a * b_y
                    row[3, n] += a * b_z + across[BY_DEPTH, k, n] * b
        first = (of_y.first + m) * view.camera.columns + of_x.first
        for n in range(columns):
            pixels[at + n] = first + n
            by_x, by_y = float(row[1, n]), float(row[2, n])
            # A few products are below 0 beside the light.
            values[0, at + n] = max(row[0, n], np.float32(0.0))
            values[1, at + n] = move_x * by_x
            values[2, at + n] = move_y * by_y
            values[3, at + n] = row[3, n] + drift_x * by_x + drift_y * by_y
        at += columns
