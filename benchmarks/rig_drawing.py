"""Rigs at random, from what laboratories have: the configuration by which a rig is simulated and the one its owner has.

Magnifications of -0.1 to -6, lenses of f/2.8 to f/16 that match the microlenses, pitches of 8 to 40 px, square and
hexagonal arrays, pixels of 3.45 to 10 um, air, water or glycerine behind walls of 1 to 20 mm, sensors of 8 to 16 bits,
0.002 to 2 tracers for each microlens. One owner in five believes a wrong value of the data sheet.

Lengths in the scene come in two units: a microlens as it appears there, p/|M|, and the depth over which a point's light
spreads by one microlens, n p N/M^2 with N the lens's f-number towards the array.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Tree = dict[str, Any]

MAGNIFICATION = (0.1, 6.0)
F_NUMBER = (2.8, 16.0)
# Towards the array; beyond, light spreads more by diffraction than pixels resolve.
LARGEST_WORKING_F_NUMBER = 25.0
FOCAL_LENGTHS_MM = (25.0, 35.0, 50.0, 60.0, 85.0, 100.0, 105.0, 180.0)
PITCH_PX = (8.0, 40.0)
PIXELS_UM = (3.45, 4.5, 4.8, 5.5, 6.5, 7.4, 10.0)
BITS = (8, 10, 12, 14, 16)
FULL_WELL, READ_ELECTRONS = (8e3, 4e4), (2.0, 8.0)
DENSITY = (0.002, 2.0)
WALL_MM = (1.0, 20.0)
# Index of the fluid and of the window before it; air has none.
FLUIDS = {"air": (1.0, 1.0), "water": (1.33, 1.49), "glycerine": (1.47, 1.52)}
# Microlenses along a sensor's sides, and the longest side in pixels.
LENSES, LONGEST_SIDE_PX = ((40, 56), (30, 40)), 800
# Depths of a volume, in units of the depth over which light spreads by one lens; no deeper than this share of the way
# to the focal point.
DEPTH_UNITS, DEEPEST = (3.0, 8.0), 0.35
# Share of the field that the volume fills: at the sensor's rim a tracer is seen from one side only.
FILLED = 0.8
# Rays of each tracer, and of all of an image's: where tracers are many, neighbours cost more accuracy than rays' noise.
# Of brighter ones as many more as their photons ask for, up to so many for an image.
RAYS, ALL_RAYS, MOST_RAYS = (8_000, 40_000), 2e7, 1e8
# Photons of each of a tracer's rays, as far as its light is more than so many counts and this share of full scale. Rays
# that fill the aperture evenly err where lens images end, by a quarter of what as many photons would: of more light
# their errors, not photons, would be the noise, which is of no camera.
PHOTONS_OF_RAY, LEAST_COUNTS, LEAST_SHARE = 2.0, 12.0, 0.02
DT_S = 1e-3
# Hard conditions, each on this share of the rigs. Of a board: how wide its dots are and how far apart at least, in
# microlenses, and how far off the focal plane it stands, in depth units. Haze in its brightest place, over the
# brightest pixels of tracers; what the sensor's corners lose of the light; moves, in microlenses across and depth units
# along; the share of the lit depth that the owner takes for the volume.
HARD_SHARE = 0.35
DOT_LENSES, LEAST_SPACING_LENSES, BOARD_UNITS = (0.4, 3.0), 2.4, 3.0
# Dots along a side that any board has in view, and of hard ones at most: rendering each takes a fifth of a second.
LEAST_DOTS, MOST_DOTS = 3, 8
HAZE, FALLOFF, SHALLOW = (0.02, 0.5), (0.1, 0.6), (0.6, 0.9)
REACH_LENSES, REACH_UNITS = (2.0, 15.0), (0.3, 1.2)
# What one owner in five has wrong, and by how much.
WRONG_SHARE = 0.2
WRONG = {
    "index": (("media", "fluid"), 0.05),
    "focal length": (("camera", "main_lens", "focal_length_mm"), 0.03),
    "magnification": (("camera", "main_lens", "magnification"), 0.03),
    "microlens focal length": (("camera", "microlenses", "focal_length_mm"), 0.1),
}


@dataclass(frozen=True)
class DrawnRig:
    """A rig and what its owner has of it.

    Attributes
    ----------
    true, reported : configurations: the one that is simulated, and the owner's
    wrong : what the owner has wrong, empty where nothing
    board : whether there is a snapshot of a board
    dirt : specks on the sensor
    lens_mm, depth_mm : the units of lengths in the scene, see above
    density : tracers for each microlens
    hard : the conditions that make it hard
    haze : counts of haze behind the lenses of the tracers' images, where it is brightest
    """

    number: int
    true: Tree
    reported: Tree
    wrong: str
    board: bool
    dirt: int
    lens_mm: float
    depth_mm: float
    density: float
    hard: tuple[str, ...] = ()
    haze: float = 0.0

    def name(self) -> str:
        """Return a line that tells what rig it is."""
        camera, scene = self.true["camera"], self.true["simulation"]
        lens, array, sensor = camera["main_lens"], camera["microlenses"], camera["sensor"]
        pitch_px = array["pitch_mm"] / sensor["pixel_um"] * 1e3
        seen = f"{self.density:.3f}/lens{'' if self.board else ', no board'}"
        return (
            f"M {lens['magnification']:.2f} f/{lens['focal_length_mm'] / lens['aperture_mm']:.1f} {pitch_px:.0f} px "
            f"{array['layout'][:3]} {sensor['pixel_um']} um, n {self.true['media']['fluid']:.2f}, {scene['bits']} bit, "
            f"{seen}{', wrong ' + self.wrong if self.wrong else ''}"
            f"{', hard: ' + ', '.join(self.hard) if self.hard else ''}"
        )


def draw(seed: int, number: int, lenses: tuple[int, int] | None = None) -> DrawnRig:
    """Return rig `number` of a seed; `lenses` along the sensor's sides take the place of drawn ones, for tests."""
    rng = np.random.default_rng([seed, number])
    while True:
        rig = _drawn(rng, number, lenses)
        if rig is not None:
            return rig


def hardened(rig: DrawnRig, seed: int) -> DrawnRig:
    """Return the rig under hard conditions, which the seed draws; its owner knows of none of them but the board."""
    rng = np.random.default_rng([seed, rig.number, 1])
    true, reported = copy.deepcopy(rig.true), copy.deepcopy(rig.reported)
    scene, lens_mm, depth_mm, index = true["simulation"], rig.lens_mm, rig.depth_mm, true["media"]["fluid"]
    hard = {name for name in ("board", "haze", "falloff", "reach", "outside") if rng.random() < HARD_SHARE}
    if rig.board and "board" in hard:
        camera = true["camera"]
        sides = np.array([camera["sensor"][side] for side in ("columns", "rows")])
        array = camera["microlenses"]
        field = sides * camera["sensor"]["pixel_um"] * 1e-3 / array["pitch_mm"] * lens_mm
        diameter = lens_mm * _log_uniform(rng, *DOT_LENSES)
        spacing = max(diameter * rng.uniform(3.5, 5.0), LEAST_SPACING_LENSES * lens_mm)
        spacing = min(spacing, float(field.min()) / LEAST_DOTS)
        dots = np.clip(np.floor(field / spacing), LEAST_DOTS, MOST_DOTS).astype(int).tolist()
        lengths = {"dots": dots, "spacing_mm": round(spacing, 5), "dot_diameter_mm": round(diameter, 5)}
        for tree in (true, reported):
            tree["board"] |= lengths
        scene["board_z_mm"] = round(float(rng.uniform(-BOARD_UNITS, BOARD_UNITS)) * depth_mm / index, 4)
    if "falloff" in hard:
        scene["objective"] = {"falloff": round(float(rng.uniform(*FALLOFF)), 3)}
    if "reach" in hard:
        per_s = 1e-3 / DT_S
        across = _log_uniform(rng, *REACH_LENSES) * lens_mm * per_s
        along = _log_uniform(rng, *REACH_UNITS) * depth_mm * per_s
        turn = rng.uniform(0.0, 2.0 * np.pi)
        moved = np.array([across * np.cos(turn), across * np.sin(turn), along * rng.choice([-1.0, 1.0])])
        scene["flow"]["velocity_m_s"] = moved.round(6).tolist()
        for tree in (true, reported):
            _deepen(tree, along * DT_S * 1e3)
    if "outside" in hard:
        size = reported["volume"]["size_mm"]
        size[2] = round(size[2] * float(rng.uniform(*SHALLOW)), 4)
    # A tracer's light where it stays within one lens.
    pitch_px = true["camera"]["microlenses"]["pitch_mm"] / true["camera"]["sensor"]["pixel_um"] * 1e3
    brightest = scene["particle_counts"] / (0.25 * np.pi * pitch_px**2)
    haze = round(brightest * _log_uniform(rng, *HAZE), 1) if "haze" in hard else 0.0
    met = tuple(sorted(hard if rig.board else hard - {"board"}))
    return replace(rig, true=true, reported=reported, hard=met, haze=haze)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _drawn(rng: np.random.Generator, number: int, lenses: tuple[int, int] | None) -> DrawnRig | None:
    """Return a rig, or None where what was drawn does not fit together: no room before the lens, or no depth."""
    camera, f_number = _camera(rng, lenses)
    fluid = str(rng.choice(list(FLUIDS), p=[0.25, 0.5, 0.25]))
    index, window = FLUIDS[fluid]
    magnification = abs(camera["main_lens"]["magnification"])
    focal_length, pitch = camera["main_lens"]["focal_length_mm"], camera["microlenses"]["pitch_mm"]
    lens_mm, depth_mm = pitch / magnification, index * pitch * f_number / magnification**2
    to_focus = focal_length * (1.0 + 1.0 / magnification)
    depth = min(depth_mm * rng.uniform(*DEPTH_UNITS), DEEPEST * index * to_focus)
    wall = 0.0 if fluid == "air" else _log_uniform(rng, *WALL_MM)
    if depth < 2.0 * depth_mm or 0.5 * depth / index + wall / window > 0.8 * to_focus:
        return None
    sensor = camera["sensor"]
    field = np.array([sensor["columns"], sensor["rows"]]) * sensor["pixel_um"] * 1e-3 / magnification
    size = [*(FILLED * field).round(4).tolist(), round(depth, 4)]
    board = bool(rng.random() < 0.75)
    density = _log_uniform(rng, *DENSITY)
    true: Tree = {
        "camera": camera,
        "media": {"air": 1.0, "window": window, "fluid": index},
        "volume": {"size_mm": size, "centre_mm": [0.0, 0.0, 0.0], "reference": "focal_point"},
        "reconstruction": {"particle_diameter_mm": round(lens_mm * _log_uniform(rng, 0.15, 0.8), 5)},
        "correlation": {
            "window_mm": [round(9.0 * lens_mm, 4), round(9.0 * lens_mm, 4), round(0.25 * depth, 4)],
            "overlap": 0.5,
            "dt_s": DT_S,
        },
    }
    if board:
        true["board"] = _board(rng, lens_mm, field)
    flow, deepest_mm = _flow(rng, lens_mm, depth_mm, size)
    if fluid != "air":
        # No tracer meets a wall between the images, half of the way before and half after.
        _place_behind_a_wall(true, depth + deepest_mm, wall, to_focus, board)
    scene = {"flow": flow} | _scene(rng, true, density, lens_mm, depth_mm, field)
    reported, wrong = _told(rng, true)
    return DrawnRig(
        number,
        true | {"simulation": scene},
        reported,
        wrong,
        board,
        int(rng.integers(0, 30)),
        lens_mm,
        depth_mm,
        density,
    )


def _camera(rng: np.random.Generator, lenses: tuple[int, int] | None) -> tuple[Tree, float]:
    """Return the section `camera`, and the lens's f-number towards the array."""
    magnification = _log_uniform(rng, *MAGNIFICATION)
    pitch_px, pixel_um = _log_uniform(rng, *PITCH_PX), float(rng.choice(PIXELS_UM))
    pitch_mm = pitch_px * pixel_um * 1e-3
    low, high = ((1.0 + magnification) * number for number in F_NUMBER)
    f_number = _log_uniform(rng, min(low, LARGEST_WORKING_F_NUMBER - 1.0), min(high, LARGEST_WORKING_F_NUMBER))
    focal_length = float(rng.choice(FOCAL_LENGTHS_MM if magnification < 2.0 else FOCAL_LENGTHS_MM[:4]))
    # People stop the lens down until micro-images nearly touch.
    fill = rng.uniform(0.85, 1.0)
    sides = lenses or tuple(int(rng.integers(*limits)) for limits in LENSES)
    columns, rows = (min(round(side * pitch_px), LONGEST_SIDE_PX) for side in sides)
    camera: Tree = {
        "main_lens": {
            "magnification": -round(magnification, 4),
            "focal_length_mm": focal_length,
            "aperture_mm": round(focal_length * (1.0 + magnification) / f_number, 4),
        },
        "microlenses": {
            "focal_length_mm": round(fill * f_number * pitch_mm, 5),
            "pitch_mm": round(pitch_mm, 6),
            "layout": "square" if rng.random() < 0.6 else "hexagonal",
        },
        "sensor": {"pixel_um": pixel_um, "columns": columns, "rows": rows, "column_axis": "x"},
    }
    return camera, f_number


def _board(rng: np.random.Generator, lens_mm: float, field: NDArray[np.float64]) -> Tree:
    """Return the section `board`: dots that the array resolves, on a board that nearly fills the view."""
    diameter = lens_mm * rng.uniform(1.5, 2.0)
    spacing = min(diameter * rng.uniform(3.5, 5.0), float(field.min()) / LEAST_DOTS)
    dots = np.clip(np.floor(field / spacing), LEAST_DOTS, 9).astype(int)
    return {
        "dots": dots.tolist(),
        "spacing_mm": round(float(spacing), 5),
        "dot_diameter_mm": round(float(diameter), 5),
        "medium": "air",
        "polarity": "bright" if rng.random() < 0.8 else "dark",
    }


def _place_behind_a_wall(true: Tree, depth: float, wall: float, to_focus: float, board: bool) -> None:
    """Put the fluid's `depth` into a channel that a board tells the place of, or behind a window at a known place."""
    if board:
        true["channel"] = {"width_mm": round(depth, 4), "wall_mm": round(wall, 4)}
        true["volume"]["reference"] = "mid_plane"
        return
    media = true["media"]
    distance = to_focus - 0.5 * depth / media["fluid"] - wall / media["window"]
    # Rounded downwards: no tracer lies in the window.
    true["window"] = {"distance_mm": round(distance - 1e-4, 4), "thickness_mm": round(wall, 4)}


def _deepen(tree: Tree, by_mm: float) -> None:
    """Let the fluid reach further, half of it to the front, so that tracers that move by so much meet no wall."""
    if "channel" in tree:
        tree["channel"]["width_mm"] = round(tree["channel"]["width_mm"] + by_mm, 4)
    if "window" in tree:
        tree["window"]["distance_mm"] = round(tree["window"]["distance_mm"] - 0.5 * by_mm / tree["media"]["fluid"], 4)


def _scene(
    rng: np.random.Generator,
    true: Tree,
    density: float,
    lens_mm: float,
    depth_mm: float,
    field: NDArray[np.float64],
) -> Tree:
    """Return the section `simulation` but for the flow: tracers, sensor, how the camera departs from its sheet."""
    array, sensor = true["camera"]["microlenses"], true["camera"]["sensor"]
    pitch_px = array["pitch_mm"] / sensor["pixel_um"] * 1e3
    bits = int(rng.choice(BITS))
    full = 2.0**bits - 1.0
    photons = _log_uniform(rng, *FULL_WELL) / full
    read = rng.uniform(*READ_ELECTRONS) / photons
    # Where light stays within one lens a tracer fills a micro-image up to this share of the counts; many tracers share.
    share = min(_log_uniform(rng, 0.05, 0.5), 0.25 / density)
    cell = 1.0 if array["layout"] == "square" else np.sqrt(0.75)
    lenses = FILLED**2 * np.prod(field) / lens_mm**2 / cell
    particles = max(1, round(density * float(lenses)))
    rays, lens_px = float(np.clip(ALL_RAYS / particles, *RAYS)), 0.25 * np.pi * pitch_px**2
    least = max(LEAST_COUNTS, LEAST_SHARE * full) * lens_px
    light = min(share * full * lens_px, max(PHOTONS_OF_RAY * rays / photons, least))
    rays = max(rays, min(light * photons / PHOTONS_OF_RAY, MOST_RAYS / particles))
    return {
        "particles": particles,
        "rays": round(rays),
        "particle_diameter_mm": true["reconstruction"]["particle_diameter_mm"],
        "particle_counts": round(light, 1),
        "board_z_mm": round(float(rng.uniform(-0.4, 0.4)) * depth_mm / true["media"]["fluid"], 4),
        "board_tilt_deg": rng.uniform(-1.5, 1.5, 2).round(3).tolist(),
        "board_offset_mm": (rng.uniform(-1.0, 1.0, 2) * lens_mm).round(4).tolist(),
        "rotation_deg": round(float(rng.uniform(-1.0, 1.0)), 3),
        "shift_px": (rng.uniform(-0.5, 0.5, 2) * pitch_px).round(2).tolist(),
        "peak_counts": round(rng.uniform(0.5, 0.85) * full, 1),
        "photons_per_count": float(f"{photons:.4g}"),
        "read_noise_counts": float(f"{read:.4g}"),
        "dark_level_counts": round(max(0.01 * full, 4.0 * read, 2.0), 1),
        "bits": bits,
        "seed": int(rng.integers(2**31)),
    }


def _flow(rng: np.random.Generator, lens_mm: float, depth_mm: float, size_mm: Sequence[float]) -> tuple[Tree, float]:
    """Return a shear, or a rotation about y, either with a velocity in depth, and the longest move in depth.

    Tracers move by some microlenses between the images; `size_mm` is the volume's.
    """
    per_s = 1e-3 / DT_S
    at_face = rng.uniform(0.5, 2.5) * lens_mm * rng.choice([-1.0, 1.0])
    in_depth = min(rng.uniform(0.05, 0.3) * depth_mm, 6.0 * lens_mm) * rng.choice([-1.0, 1.0])
    along = rng.uniform(-1.0, 1.0, 2) * lens_mm
    velocity = [round(float(v) * per_s, 6) for v in (*along, in_depth)]
    a_turn = at_face / (0.5 * size_mm[2])
    rate = round(float(a_turn / DT_S), 6)
    if rng.random() < 0.5:
        shear = {"kind": "shear", "along": "x", "across": "z", "rate_per_s": rate, "velocity_m_s": velocity}
        return shear, float(abs(in_depth))
    rotation = {"kind": "rigid_rotation", "angular_velocity_rad_s": [0.0, rate, 0.0], "velocity_m_s": velocity}
    return rotation, float(abs(in_depth) + 0.5 * abs(a_turn) * size_mm[0])


def _told(rng: np.random.Generator, true: Tree) -> tuple[Tree, str]:
    """Return the owner's configuration and what is wrong with it."""
    reported = copy.deepcopy(true)
    if rng.random() >= WRONG_SHARE:
        return reported, ""
    name = str(rng.choice([each for each in WRONG if each != "index" or true["media"]["fluid"] > 1.0]))
    keys, by = WRONG[name]
    section = reported
    for key in keys[:-1]:
        section = section[key]
    section[keys[-1]] = round(section[keys[-1]] * (1.0 + by * float(rng.choice([-1.0, 1.0]))), 5)
    return reported, name
