"""Drawings as SVG: the light's way from a point in the fluid, or its equivalent point, to the sensor; a pipe's board.

The lengths along the axis are chosen for the eye; the refractions are Snell's law with the paper's indices, and the
lenses are thin ones, so that the rays meet where they should.
"""

from __future__ import annotations

import math

# Where things stand along the drawing's axis, light going from left to right, in its own units.
FOCUS, WALL_INNER, WALL_OUTER, MAIN_LENS, ARRAY, SENSOR = 90.0, 210.0, 245.0, 520.0, 800.0, 850.0
AXIS, APERTURE, PITCH, WIDTH, HEIGHT = 170.0, 92.0, 36.0, 940.0, 350.0
AIR, WINDOW, FLUID = 1.0, 1.49, 1.33

REAL, EQUIVALENT, INK = "#0a7ea4", "#c2410c", "#334155"


def light() -> str:
    """Return the drawing."""
    parts = [_media(), _lenses()]
    for share in (-0.9, -0.45, 0.45, 0.9):
        parts += _ray(share * APERTURE)
    parts += [_dot(FOCUS, REAL), _dot(_equivalent(0.45 * APERTURE), EQUIVALENT), *_labels()]
    title = "Rays from a point in the fluid through window, air, main lens and microlens to the sensor"
    return _svg(WIDTH, HEIGHT, title, parts)


def _svg(width: float, height: float, title: str, parts: list[str]) -> str:
    """Return a drawing of its parts."""
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:g} {height:g}" role="img">'
    ground = f'<rect width="{width:g}" height="{height:g}" fill="#ffffff"/>'
    return "\n".join([head, f"<title>{title}</title>", ground, *parts, "</svg>"]) + "\n"


# The pipes of configs/pipe.yaml and pipe_box.yaml, in mm, and how many units of the drawing these are.
OUTER_MM, INNER_MM, BOX_MM, BOX_WALL_MM, UNITS_PER_MM = 7.0, 5.0, 13.0, 3.0, 9.0
BOARD_MM, PIPE_AT, LENS_AT = 1.2, 190.0, 560.0


def board_of_a_pipe() -> str:
    """Return where the board of a pipe stands, alone and in a box, and how far the camera then moves; light goes right.

    The moves are to scale: what lies between board and axis, each part over its refractive index.
    """
    wall = (OUTER_MM - INNER_MM) / WINDOW + INNER_MM / FLUID
    box = BOX_WALL_MM / WINDOW + (BOX_MM - BOX_WALL_MM - OUTER_MM) / FLUID + wall
    parts = [*_pipe_row(150.0, OUTER_MM, BOARD_MM + wall), *_pipe_row(430.0, BOX_MM, BOARD_MM + box)]
    return _svg(820.0, 600.0, "Boards on a pipe and on its box, and the camera's move after their picture", parts)


def _pipe_row(middle: float, front_mm: float, move_mm: float) -> list[str]:
    """Return a pipe's section, its box if its front is not the pipe's own, the board on it, and the camera's places."""

    def circle(radius_mm: float, fill: str) -> str:
        drawn = f'r="{radius_mm * UNITS_PER_MM:g}" fill="{fill}" stroke="{INK}"'
        return f'<circle cx="{PIPE_AT:g}" cy="{middle:g}" {drawn}/>'

    def square(half_mm: float, fill: str) -> str:
        half = half_mm * UNITS_PER_MM
        place = f'x="{PIPE_AT - half:g}" y="{middle - half:g}" width="{2 * half:g}" height="{2 * half:g}"'
        return f'<rect {place} fill="{fill}" stroke="{INK}"/>'

    def lens(at: float, colour: str, dashes: str) -> str:
        dash = f' stroke-dasharray="{dashes}"' if dashes else ""
        drawn = f'fill="none" stroke="{colour}"{dash}/>'
        shape = f'<ellipse cx="{at:.1f}" cy="{middle:g}" rx="9" ry="62" {drawn}'
        return shape + f'<rect x="{at + 22:.1f}" y="{middle - 45:g}" width="110" height="90" {drawn}'

    fluid, window = "#dbeafe", "#93b4de"
    boxed = front_mm > OUTER_MM
    front, move = PIPE_AT + front_mm * UNITS_PER_MM, move_mm * UNITS_PER_MM
    focus = front + BOARD_MM * UNITS_PER_MM
    board = f'<rect x="{front:g}" y="{middle - 50:g}" width="{focus - front:g}" height="100" fill="{EQUIVALENT}"/>'
    faces = [circle(OUTER_MM, window), circle(INNER_MM, fluid)]
    if boxed:
        faces = [square(front_mm, window), square(front_mm - BOX_WALL_MM, fluid), *faces]
    axis = f'<path d="M20 {middle:g} H790" stroke="#94a3b8" stroke-dasharray="10 4 2 4"/>'
    before = [(LENS_AT, 55.0), (focus, 0.0), (LENS_AT, -55.0)]
    lines = [
        f'<polyline points="{" ".join(f"{x:.1f},{middle - y:.1f}" for x, y in before)}" fill="none" '
        f'stroke="{EQUIVALENT}" stroke-dasharray="5 4"/>',
        f'<circle cx="{PIPE_AT:g}" cy="{middle:g}" r="4" fill="{REAL}"/>',
    ]
    at, end, tick = middle + 88.0, LENS_AT - move, f"V{middle + 93:g}"
    ends = f"M{LENS_AT:.1f} {at - 14:g} {tick} M{end:.1f} {at - 14:g} {tick}"
    arrow = f'<path d="{ends} M{LENS_AT:.1f} {at:g} H{end:.1f} m8 -4 l-8 4 l8 4" stroke="{INK}" fill="none"/>'
    words = [
        _text(PIPE_AT, middle - front_mm * UNITS_PER_MM - 12, "box, water and pipe" if boxed else "pipe"),
        _text(front + 62, middle - 58, "board", colour=EQUIVALENT),
        _text(PIPE_AT, middle + 24, "focus after", colour=REAL),
        _text(LENS_AT + 77, middle - 80, "camera: focused on the board", colour=EQUIVALENT),
        _text(LENS_AT + 77, middle + 78, "then nearer by d", "m", REAL),
    ]
    camera = [lens(LENS_AT, EQUIVALENT, "5 4"), lens(end, REAL, ""), arrow]
    return [*faces, axis, board, *lines, *camera, *words]


def _slopes(height: float) -> tuple[float, float, float]:
    """Return a ray's slopes in fluid, window and air when it meets the main lens at this height.

    The slope in the fluid is found by bisection: the height it leads to grows with it.
    """
    low, high = 0.0, 0.75
    for _ in range(60):
        fluid = 0.5 * (low + high)
        sine = FLUID * math.sin(math.atan(fluid))
        window, air = (math.tan(math.asin(sine / index)) for index in (WINDOW, AIR))
        reached = (WALL_INNER - FOCUS) * fluid + (WALL_OUTER - WALL_INNER) * window + (MAIN_LENS - WALL_OUTER) * air
        low, high = (fluid, high) if reached < abs(height) else (low, fluid)
    sign = math.copysign(1.0, height)
    return sign * fluid, sign * window, sign * air


def _equivalent(height: float) -> float:
    """Return where a ray that meets the main lens at this height comes from if there were only air."""
    return MAIN_LENS - height / _slopes(height)[2]


def _ray(height: float) -> list[str]:
    """Return a ray's way from the point in focus through the middle microlens to its pixel, and its equivalent's."""
    fluid, window, _ = _slopes(height)
    inner = fluid * (WALL_INNER - FOCUS)
    outer = inner + window * (WALL_OUTER - WALL_INNER)
    # In focus all rays meet at the middle of the microlens, which bends none of them.
    pixel = -height * (SENSOR - ARRAY) / (ARRAY - MAIN_LENS)
    way = [(FOCUS, 0.0), (WALL_INNER, inner), (WALL_OUTER, outer), (MAIN_LENS, height), (ARRAY, 0.0), (SENSOR, pixel)]
    back = [(_equivalent(height), 0.0), (WALL_OUTER, outer)]
    return [_line(way, REAL), _line(back, EQUIVALENT, "5 4")]


def _line(points: list[tuple[float, float]], colour: str, dashes: str = "") -> str:
    corners = " ".join(f"{x:.1f},{AXIS - y:.1f}" for x, y in points)
    dash = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'<polyline points="{corners}" fill="none" stroke="{colour}" stroke-width="1.6"{dash}/>'


def _dot(x: float, colour: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{AXIS:g}" r="5" fill="{colour}"/>'


def _media() -> str:
    """Return fluid, window and axis."""
    fluid = f'<rect x="20" y="40" width="{WALL_INNER - 20:g}" height="260" fill="#dbeafe"/>'
    window = f'<rect x="{WALL_INNER:g}" y="40" width="{WALL_OUTER - WALL_INNER:g}" height="260" fill="#bfdbfe"/>'
    axis = f'<path d="M20 {AXIS:g} H{SENSOR:g}" stroke="#94a3b8" stroke-dasharray="10 4 2 4"/>'
    return "\n".join([fluid, window, axis])


def _lenses() -> str:
    """Return the main lens, seven microlenses and the sensor."""
    top, bottom = AXIS - APERTURE - 12, AXIS + APERTURE + 12
    main = (
        f'<path d="M{MAIN_LENS:g} {top:g} Q{MAIN_LENS + 22:g} {AXIS:g} {MAIN_LENS:g} {bottom:g} '
        f'Q{MAIN_LENS - 22:g} {AXIS:g} {MAIN_LENS:g} {top:g}Z" fill="#e0f2fe" stroke="{INK}"/>'
    )
    lens = f'rx="5" ry="{0.5 * PITCH:g}" fill="#e0f2fe" stroke="{INK}"'
    array = [f'<ellipse cx="{ARRAY:g}" cy="{AXIS + number * PITCH:g}" {lens}/>' for number in range(-3, 4)]
    sensor = f'<rect x="{SENSOR:g}" y="{AXIS - 3.5 * PITCH:g}" width="8" height="{7 * PITCH:g}" fill="{INK}"/>'
    return "\n".join([main, *array, sensor])


def _labels() -> list[str]:
    """Return the names of things above them, and the distances below."""
    above = 30.0
    seen_from = _equivalent(0.45 * APERTURE)
    return [
        _text(115.0, above, "fluid n", "w"),
        _text(0.5 * (WALL_INNER + WALL_OUTER), above, "window n", "ag"),
        _text(380.0, above, "air n", "a"),
        _text(MAIN_LENS, above, "main lens F", "m"),
        _text(ARRAY - 22, above, "microlenses f", "m"),
        _text(SENSOR + 38, AXIS + 5, "sensor"),
        _text(FOCUS - 12, AXIS - 14, "p", colour=REAL),
        _text(seen_from + 2, AXIS - 16, "m", colour=EQUIVALENT),
        _distance(seen_from, MAIN_LENS, "s", "o", EQUIVALENT),
        _distance(MAIN_LENS, ARRAY, "s", "i"),
        _distance(ARRAY, SENSOR, "s", "\u00b5"),
    ]


def _distance(start: float, end: float, name: str, index: str, colour: str = INK) -> str:
    """Return a line from one place on the axis to another, below all, with its name."""
    at = 312.0
    ends = "".join(f"M{x:.1f} {at - 5:g} V{at + 5:g} " for x in (start, end))
    line = f'<path d="{ends}M{start:.1f} {at:g} H{end:.1f}" stroke="{colour}" fill="none"/>'
    return line + "\n" + _text(0.5 * (start + end), at + 22, name, index, colour)


def _text(x: float, y: float, name: str, index: str = "", colour: str = INK) -> str:
    """Return a label, centred, with its index lowered."""
    lowered = f'<tspan dy="4" font-size="11">{index}</tspan>' if index else ""
    return (
        f'<text x="{x:.0f}" y="{y:.0f}" fill="{colour}" font-family="sans-serif" font-size="15" '
        f'text-anchor="middle">{name}{lowered}</text>'
    )
