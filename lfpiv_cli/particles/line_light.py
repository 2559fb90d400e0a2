"""The light of one particle by line responses: under each lens a sum of products of a row's and a column's.

Each pixel belongs to one lens's cell, whose light is that of all lenses, so that no pixel is lit twice. Along each axis
the responses are cubic splines of the spot's place about the lens, of depth and of the pixel's place under the lens;
derivatives are those of the same splines.

Axes and values: see `response`; `optics.line_responses` has the theory.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.kernels import COUNT_NO_REFERENCES, COUNT_REFERENCES, njit
from lfpiv_cli.optics.line_responses import spline_slopes, spline_weights
from lfpiv_cli.optics.tracing import slope_ratio
from lfpiv_cli.particles.refraction import Bend, displaced
from lfpiv_cli.particles.response import Along, Projection, lenses_of, part_of_lens, project
from lfpiv_cli.particles.view import View
from lfpiv_cli.simd import LANES, ROWS, combine_rows

# Responses along one axis: the light's, and its derivatives by the spot's place and by depth.
LIGHT, BY_OFFSET, BY_DEPTH = range(3)
KINDS = 3
# What is written of a pixel: light and its derivatives by x, y and z.
VALUES = 4
# Pixels are left out that get less than this share of the light, a count or two of a bright particle beside a noise of
# several: a thousandth of all, which disturbs no neighbour.
DARK = 1.5e-6
# Lenses that show less than this share tell nothing of where the particle is.
FAINT = 1e-5
Lines = NDArray[np.float32]


class Cell(NamedTuple):
    """Pixels of a lens's cell along one axis.

    Attributes
    ----------
    first, number : the first one, and how many
    place : of the first from the middle of the lens image, pixels
    moved_mm : how much further the spot lies from the lens than from the one whose responses are known
    """

    first: int
    number: int
    place: float
    moved_mm: float


class Oblique(NamedTuple):
    """What Snell's law makes of a particle's rays beside the optical axis.

    Attributes
    ----------
    z_x, z_y : depths at which a particle on the axis has rays that spread as this one's do along x, and along y
    further_x, further_y : how much further its light lies on the array than that of its chief ray, mm
    coma_x, coma_y : the same of rays through (X, Y) of the aperture, as (of its radius)^2: of X^2, Y^2 and X Y
    """

    z_x: float
    z_y: float
    further_x: float
    further_y: float
    coma_x: tuple[float, float, float]
    coma_y: tuple[float, float, float]


class Room(NamedTuple):
    """Room for one lens, each flat.

    Attributes
    ----------
    across, down : (KINDS, terms, length) responses of its columns and its rows; beyond its pixels, of no meaning
    light : (VALUES, length, length) its pixels' light, and this by the spot's place along x, along y, and by depth
    lit : (length, 2) of each row the first pixel that is lit, and their number
    terms : (terms,) numbers of the products
    length : of a line, a multiple of `LANES`
    """

    across: Lines
    down: Lines
    light: Lines
    lit: NDArray[np.int64]
    terms: NDArray[np.int32]
    length: int


@njit(cache=True, **COUNT_REFERENCES)
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
    oblique = _oblique(view, bend, z)
    of_columns = _responses(view, x, oblique.z_x, centres[middle_j, low_i : high_i + 1, 0] - oblique.further_x)
    of_rows = _responses(view, y, oblique.z_y, centres[low_j : high_j + 1, middle_i, 1] - oblique.further_y)
    reach_x, reach_y = _reach(view, x), _reach(view, y)
    room = _room_for(view)
    count = 0
    for j in range(low_j, high_j + 1):
        for i in range(low_i, high_i + 1):
            s_x, s_y = centres[j, i, 0], centres[j, i, 1]
            beside_x = max(abs(s_x - x.at) - x.half, 0.0) / reach_x
            beside_y = max(abs(s_y - y.at) - y.half, 0.0) / reach_y
            if beside_x * beside_x + beside_y * beside_y > 1.0:
                continue
            before, behind = centres[j, i - 1, 0], centres[j, i + 1, 0]
            of_x = _cell(view, (before, s_x, behind), x.pixels, centres[middle_j, i, 0] - s_x)
            before, behind = centres[j - 1, i, 1], centres[j + 1, i, 1]
            of_y = _cell(view, (before, s_y, behind), y.pixels, centres[j, middle_i, 1] - s_y)
            if of_x.number > 0 and of_y.number > 0 and count + of_x.number * of_y.number <= pixels.size:
                responses = of_columns[i - low_i], of_rows[j - low_j]
                number = _write_lens(view, projection, (of_x, of_y), responses, room, pixels[count:], values[:, count:])
                _add_moved(view, projection, oblique, (s_x, s_y), (of_x, of_y), room.lit, values[:, count:])
                count += number
    return count


@njit(cache=True, **COUNT_NO_REFERENCES)
def _oblique(view: View, bend: Bend, z: float) -> Oblique:
    """Return what bends rays beside the axis otherwise than on it: astigmatism and coma.

    0.01 mm of depth and 0.0006 mm aside 6 mm beside the axis of Table 2's camera behind 1 cm of water. They are those
    of rays through opposite ends of the aperture. Coma displaces light as the gradient of (X^2 + Y^2) (a X + b Y) does,
    whose mean over the aperture is half of that over its rim.
    """
    if bend.nodes.size == 0:
        return Oblique(z, z, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    radius, half_far = view.camera.aperture_radius_mm, 0.5 * view.camera.image_distance_mm
    on_axis = slope_ratio(radius * radius, bend.nodes, bend.factors)
    right, left = displaced(bend, radius, 0.0), displaced(bend, -radius, 0.0)
    top, bottom = displaced(bend, 0.0, radius), displaced(bend, 0.0, -radius)
    per_slope = 1.0 / (view.depth_ratio * on_axis * on_axis)
    rise_x = 0.5 * (right[0] - left[0]) / radius + 1.0 / bend.distance_x - on_axis
    rise_y = 0.5 * (top[1] - bottom[1]) / radius + 1.0 / bend.distance_y - on_axis
    along_x, across_x = half_far * (right[0] + left[0]), half_far * (top[0] + bottom[0])
    across_y, along_y = half_far * (right[1] + left[1]), half_far * (top[1] + bottom[1])
    return Oblique(
        z - rise_x * per_slope,
        z - rise_y * per_slope,
        0.25 * (along_x + across_x),
        0.25 * (along_y + across_y),
        (along_x, across_x, 2.0 * across_y),
        (across_y, along_y, 2.0 * across_x),
    )


@njit(cache=True)
def _room_for(view: View) -> Room:
    """Return the room for a lens."""
    terms, width = view.lines.table.shape[3], view.lines.table.shape[4]
    length = LANES * ((width + ROWS) // LANES + 1)
    across, down = np.zeros(KINDS * terms * length, np.float32), np.zeros(KINDS * terms * length, np.float32)
    light, lit = np.empty(VALUES * length * length, np.float32), np.empty((length, 2), np.int64)
    return Room(across, down, light, lit, np.arange(terms).astype(np.int32), length)


@njit(cache=True, **COUNT_NO_REFERENCES)
def _reach(view: View, along: Along) -> float:
    """Return how far from the spot's middle on the array there is light, along one axis."""
    return abs(along.alpha) * view.camera.aperture_radius_mm * along.stretch + along.radius


@njit(cache=True, **COUNT_NO_REFERENCES)
def _cell(view: View, lenses_mm: tuple[float, float, float], pixels: int, moved_mm: float) -> Cell:
    """Return the pixels of a lens's cell along one axis of the sensor; it is the second of three on the array."""
    camera, middle = view.camera, 0.5 * (pixels - 1)
    to_px = (1.0 + camera.microlens_distance_mm / camera.image_distance_mm) / camera.pixel_mm
    before, lens, behind = lenses_mm
    # Splines need a value more on either side.
    centre, reach = lens * to_px + middle, 0.5 * view.lines.table.shape[4] - 1.0
    low = max(0.5 * (before + lens) * to_px + middle, centre - reach)
    high = min(0.5 * (lens + behind) * to_px + middle, centre + reach)
    first = max(int(np.ceil(low)), 0)
    return Cell(first, min(int(np.ceil(high)), pixels) - first, first - centre, moved_mm)


@njit(cache=True)
def _responses(view: View, along: Along, z: float, lenses_mm: NDArray[np.float64]) -> Lines:
    """Return responses (lenses, KINDS, phases, terms, pixels) under lenses at these places along one axis.

    A stretched spot is that of a stretched depth; beyond the table's depths it is that of its ends.
    """
    lines = view.lines
    depths, offsets, phases, terms, width = lines.table.shape
    size = phases * terms * width
    found = np.zeros((lenses_mm.size, KINDS, size), np.float32)
    deep = (along.stretch * z - lines.first_depth_mm) / lines.depth_step_mm
    deep = min(max(deep, 1.0), depths - 2.001)
    first_z = int(deep)
    by_z, d_z = spline_weights(deep - first_z), spline_slopes(deep - first_z)
    per_mm, per_depth = 1.0 / lines.offset_step_mm, along.stretch / lines.depth_step_mm
    for lens in range(lenses_mm.size):
        beside = (along.at - lenses_mm[lens]) * per_mm + 0.5 * (offsets - 1)
        if beside < 1.0 or beside >= offsets - 2.0:
            continue
        first_x = int(beside)
        p, q, r, t = spline_weights(beside - first_x)
        a, b, c, d = np.float32(p), np.float32(q), np.float32(r), np.float32(t)
        p, q, r, t = spline_slopes(beside - first_x)
        e, f, g, h = np.float32(p * per_mm), np.float32(q * per_mm), np.float32(r * per_mm), np.float32(t * per_mm)
        light, by_offset, by_depth = found[lens, LIGHT], found[lens, BY_OFFSET], found[lens, BY_DEPTH]
        for plane in range(4):
            source = lines.table[first_z - 1 + plane, first_x - 1 : first_x + 3].reshape(4 * size)
            one, two, three, four = (
                source[:size],
                source[size : 2 * size],
                source[2 * size : 3 * size],
                source[3 * size :],
            )
            w, w_z = np.float32(by_z[plane]), np.float32(d_z[plane] * per_depth)
            for n in range(size):
                here = a * one[n] + b * two[n] + c * three[n] + d * four[n]
                light[n] += w * here
                by_depth[n] += w_z * here
                by_offset[n] += w * (e * one[n] + f * two[n] + g * three[n] + h * four[n])
    return found.reshape((lenses_mm.size, KINDS, phases, terms, width))


@njit(cache=True, **COUNT_NO_REFERENCES)
def _place(responses: Lines, kind: int, cell: Cell, signs: Lines, out: Lines, length: int) -> None:
    """Fill in the responses of a kind (KINDS, terms, length) of a cell's pixels, each term with a sign."""
    _, phases, terms, width = responses.shape
    place = (cell.place + 0.5 * width) * phases
    first = int(np.floor(place))
    p, q, r, t = spline_weights(place - first)
    moved = np.float32(cell.moved_mm if kind == LIGHT else 0.0)
    # Of two phases, the first of the four values belongs to the one, the next to the other.
    one, other = (first - 1) % phases, first % phases
    from_one, from_other = (first - 1) // phases, first // phases
    for k in range(terms):
        sign = signs[k]
        a, b, c, d = sign * np.float32(p), sign * np.float32(q), sign * np.float32(r), sign * np.float32(t)
        target = out[(kind * terms + k) * length : (kind * terms + k + 1) * length]
        before, behind = responses[kind, one, k, from_one:], responses[kind, other, k, from_other:]
        for n in range(cell.number):
            target[n] = a * before[n] + b * behind[n] + c * before[n + 1] + d * behind[n + 1]
        if moved != 0.0:
            before, behind = responses[BY_OFFSET, one, k, from_one:], responses[BY_OFFSET, other, k, from_other:]
            for n in range(cell.number):
                target[n] += moved * (a * before[n] + b * behind[n] + c * before[n + 1] + d * behind[n + 1])


@njit(cache=True, **COUNT_NO_REFERENCES)
def _multiply(room: Room, size: tuple[int, int], kinds: tuple[int, int], value: int, added: int) -> None:
    """Write or add the sums of products of a kind of response of columns and one of rows (columns, rows `size`)."""
    terms, length = room.terms.size, room.length
    for row in range(0, size[1], ROWS):
        for column in range(0, size[0], LANES):
            combine_rows(
                room.light,
                ((value * length + row) * length + column, length, added),
                room.across,
                room.terms,
                (kinds[0] * terms * length + column, length, 0, terms),
                room.down,
                (kinds[1] * terms * length + row, length, 1),
            )


@njit(cache=True, **COUNT_NO_REFERENCES)
def _write_lens(
    view: View,
    projection: Projection,
    cells: tuple[Cell, Cell],
    responses: tuple[Lines, Lines],
    room: Room,
    pixels: NDArray[np.int32],
    values: NDArray[np.float64],
) -> int:
    """Write the entries of one lens from its responses along both axes; return their number."""
    x, y, (columns, rows), length = projection.x, projection.y, responses, room.length
    of_x, of_y = cells
    size, dark = (of_x.number, of_y.number), np.float32(DARK)
    _place(columns, LIGHT, of_x, view.lines.ones, room.across, length)
    _place(rows, LIGHT, of_y, view.lines.signs, room.down, length)
    _multiply(room, size, (LIGHT, LIGHT), 0, 0)
    # Of each row the pixels from the first that is lit to the last.
    count, shown = 0, np.float32(0.0)
    for m in range(of_y.number):
        light = room.light[m * length : m * length + of_x.number]
        first, last = 0, of_x.number
        while first < last and light[first] < dark:
            first += 1
        while last > first and light[last - 1] < dark:
            last -= 1
        room.lit[m, 0], room.lit[m, 1] = first, last - first
        begin = (of_y.first + m) * view.camera.columns + of_x.first + first
        # A few sums of products are below 0 beside the light.
        for n in range(last - first):
            pixels[count + n] = begin + n
            values[0, count + n] = max(light[first + n], np.float32(0.0))
            shown += light[first + n]
        count += last - first
    if shown < FAINT:
        for value in range(1, VALUES):
            values[value, :count] = 0.0
        return count
    for kind in (BY_OFFSET, BY_DEPTH):
        _place(columns, kind, of_x, view.lines.ones, room.across, length)
        _place(rows, kind, of_y, view.lines.signs, room.down, length)
    _multiply(room, size, (BY_OFFSET, LIGHT), 1, 0)
    _multiply(room, size, (LIGHT, BY_OFFSET), 2, 0)
    _multiply(room, size, (LIGHT, BY_DEPTH), 3, 0)
    _multiply(room, size, (BY_DEPTH, LIGHT), 3, 1)
    # The spot moves by these with x and y, and by these with z.
    move_x, move_y = -x.beta * x.stretch, -y.beta * y.stretch
    drift_x, drift_y = -x.slope * x.x * x.stretch, -y.slope * y.x * y.stretch
    at, area = 0, length * length
    for m in range(of_y.number):
        begin, number = m * length + room.lit[m, 0], room.lit[m, 1]
        by_x = room.light[area + begin : area + begin + number]
        by_y = room.light[2 * area + begin : 2 * area + begin + number]
        by_z = room.light[3 * area + begin : 3 * area + begin + number]
        for n in range(number):
            values[1, at + n] = move_x * by_x[n]
            values[2, at + n] = move_y * by_y[n]
            values[3, at + n] = by_z[n] + drift_x * by_x[n] + drift_y * by_y[n]
        at += number
    return count


@njit(cache=True, error_model="numpy", fastmath={"contract"}, **COUNT_NO_REFERENCES)
def _add_moved(
    view: View,
    projection: Projection,
    oblique: Oblique,
    lens_mm: tuple[float, float],
    cells: tuple[Cell, Cell],
    lit: NDArray[np.int64],
    values: Lines,
) -> None:
    """Add what coma moves of a lens's light, and where the sides of its cell lean, to first order.

    A pixel sees one place of the aperture, as far as rays from there meet the lens. But what depends on where light is
    comes through the lens's edges, which diffract that of all places that the lens sees: the more of the aperture these
    are, the less a pixel's light moves as its own place's, down to half of it (by images of waves).
    """
    (x_xx, x_yy, x_xy), (y_xx, y_yy, y_xy) = oblique.coma_x, oblique.coma_y
    if x_xx == 0.0 and y_yy == 0.0 and view.lean_x == 0.0 and view.lean_y == 0.0:
        return
    camera, x, y, (s_x, s_y), (of_x, of_y) = view.camera, projection.x, projection.y, lens_mm, cells
    radius, single = camera.aperture_radius_mm, np.float32
    low_x, high_x = part_of_lens(x.stretch * x.alpha, x.at - s_x, x.half, radius)
    low_y, high_y = part_of_lens(y.stretch * y.alpha, y.at - s_y, y.half, radius)
    own = 1.0 - 0.125 * (max(high_x - low_x, 0.0) + max(high_y - low_y, 0.0)) / radius
    shift_x = (1.0 - camera.bend) * s_x - x.lever * x.beta * x.x
    shift_y = (1.0 - camera.bend) * s_y - y.lever * y.beta * y.x
    # In radii of the aperture: the place of the first column of the cell, and the step to the next.
    step_x, step_y = camera.pixel_mm / (x.scale * radius), camera.pixel_mm / (y.scale * radius)
    first_x = (of_x.first + 0.5 - 0.5 * camera.columns) * step_x - shift_x / (x.scale * radius)
    first_y = (of_y.first + 0.5 - 0.5 * camera.rows) * step_y - shift_y / (y.scale * radius)
    # From derivatives by x and y to those by the place on the array. How far up in its cell the lens shows the ball is
    # by how much the sides are further right there.
    per_x, per_y = -1.0 / x.beta, -1.0 / y.beta
    to_x, to_y = own * per_x, own * per_y
    up, right = view.lean_x * y.stretch * y.alpha * radius, view.lean_y * x.stretch * x.alpha * radius
    whole_x = single(per_x * view.lean_x * (y.at - s_y) - to_x * oblique.further_x)
    whole_y = single(per_y * view.lean_y * (x.at - s_x) - to_y * oblique.further_y)
    a_xx, a_yy, a_xy, a_y = single(to_x * x_xx), single(to_x * x_yy), single(to_x * x_xy), single(per_x * up)
    b_xx, b_yy, b_xy, b_x = single(to_y * y_xx), single(to_y * y_yy), single(to_y * y_xy), single(per_y * right)
    low, high, step, one, none = single(low_x / radius), single(high_x / radius), single(step_x), single(1), single(0)
    begin = 0
    for m in range(of_y.number):
        number, row = lit[m, 1], min(max(first_y + m * step_y, low_y / radius), high_y / radius)
        first, v = single(first_x + lit[m, 0] * step_x), single(row)
        light = values[0, begin : begin + number]
        by_x, by_y = values[1, begin : begin + number], values[2, begin : begin + number]
        for n in range(number):
            u = min(max(first + single(n) * step, low), high)
            # What diffraction spreads beyond the aperture's image is of its rim.
            within = one / max(np.sqrt(u * u + v * v), one)
            at_x, at_y = within * u, within * v
            moved_x = at_x * (a_xx * at_x + a_xy * at_y) + at_y * (a_yy * at_y + a_y) + whole_x
            moved_y = at_x * (b_xx * at_x + b_xy * at_y + b_x) + b_yy * at_y * at_y + whole_y
            light[n] = max(light[n] + moved_x * by_x[n] + moved_y * by_y[n], none)
        begin += number
