"""The calibration on random benches: rendered white image and board, calibrated from pictures alone, held to the truth.

Square and hexagonal arrays, pitches of 10 to 30 px, rotations within 3 degrees, sensors of 8 to 16 bits, boards between
-8 and 8 mm tilted by up to 3 degrees, of either polarity, with dots missing, dots too many and glare. Most sensors are
small to save time; every tenth bench is the paper's size.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import Calibration, DataSheet, Photographs, Rig, calibrate
from lfpiv_cli.errors import LfpivError
from lfpiv_cli.names import Layout
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres, render_board
from lfpiv_cli.synthetic.render import Readout, render_white
from lfpiv_cli.synthetic.scenes import Misalignment

BENCHES = 60
FULL_SIZE_EVERY = 10
FULL_SHAPE = (1768, 2352)
PIXEL_MM = 0.0055
WATER = Media(1.0, 1.49, 1.33)
# Bits, counts of a pixel that sees only light, read noise: a scientific camera well and poorly lit, 12 bits, 8 bits.
SENSORS = ((16, 28_000.0, 6.0), (16, 2_000.0, 6.0), (12, 3_000.0, 4.0), (8, 180.0, 0.7))
DARK_LEVEL = 12.0
# Beyond these a result that came without a complaint is a silent failure.
WRONG_DEPTH_MM = 0.5
WRONG_TILT_DEG = 1.5
WRONG_PITCH = 0.01


@dataclass(frozen=True, eq=False)
class Bench:
    """A random set-up and what it recorded.

    Attributes
    ----------
    sheet, real : camera by the data sheet and as it is
    placement : of the board
    white, dark, picture : (rows, columns) recorded
    """

    sheet: Camera
    real: Camera
    rotation_deg: float
    board: BoardGeometry
    placement: BoardPlacement
    white: NDArray[np.uint16]
    dark: NDArray[np.uint16]
    picture: NDArray[np.uint16]


def bench_calibration() -> None:
    """Print median and 95th percentile of every error, the coverage of the uncertainties, failures and times."""
    report(run_series(BENCHES, seed=20261121))


def run_series(count: int, seed: int, largest_side: int = 10_000) -> list[dict[str, float | str]]:
    """Return what was found on each bench; `largest_side` cuts the sensors, for tests."""
    results = []
    for number in range(count):
        rng = np.random.default_rng([seed, number])
        bench = random_bench(rng, number % FULL_SIZE_EVERY == FULL_SIZE_EVERY - 1, largest_side)
        results.append(judged(bench) | {"bench": number})
    return results


def random_bench(rng: np.random.Generator, full_size: bool, largest_side: int) -> Bench:
    """Return a random set-up with its recorded images."""
    layout: Layout = "square" if rng.random() < 0.5 else "hexagonal"
    pitch_px = rng.uniform(10.0, 30.0)
    rows, columns = FULL_SHAPE if full_size else (int(rng.integers(560, 760)), int(rng.integers(600, 900)))
    sheet = sheet_camera(pitch_px, layout, min(rows, largest_side), min(columns, largest_side), rng)
    misalignment = Misalignment(rng.uniform(-3.0, 3.0), tuple(rng.uniform(-0.5, 0.5, 2) * pitch_px), 0.0)
    true_magnification = sheet.magnification * (1.0 + rng.normal(0.0, 0.003))
    real = misalignment.apply(replace(sheet, magnification=true_magnification))
    board = random_board(sheet, rng)
    placement = BoardPlacement(
        rng.uniform(-8.0, 8.0),
        tuple(rng.uniform(-0.2, 0.2, 2)),
        tuple(rng.uniform(-3.0, 3.0, 2)),
        rng.uniform(-3.0, 3.0),
    )
    bits, level, read_noise = SENSORS[rng.integers(len(SENSORS))]
    readout = Readout(0.5 if bits > 8 else 50.0, read_noise, DARK_LEVEL, bits)
    light = render_white(real, level)
    shown = rng.random(board.dots[0] * board.dots[1]) > rng.uniform(0.0, 0.15)
    space = ObjectSpace(WATER.in_air())
    seen = render_board(real, space, board, placement, 0.9 * level, rng, shown=shown)
    if board.polarity == "bright" and rng.random() < 0.5:
        seen = seen + stray_dot(real, space, board, placement, level, rng)
    seen = seen + glare(light, rng)
    nothing = np.zeros_like(light)
    return Bench(
        sheet,
        real,
        misalignment.rotation_deg,
        board,
        placement,
        *(readout.record(image, rng) for image in (light, nothing, seen)),
    )


def sheet_camera(pitch_px: float, layout: Layout, rows: int, columns: int, rng: np.random.Generator) -> Camera:
    """Return Table 2's main lens before an array of f/8 lenses of about this pitch."""
    pitch_mm = pitch_px * PIXEL_MM
    return Camera(
        magnification=-1.0,
        focal_length_mm=100.0,
        aperture_mm=rng.uniform(20.0, 24.5),
        microlens_focal_length_mm=8.0 * pitch_mm,
        microlens_distance_mm=8.0 * pitch_mm,
        lattice=Lattice.regular(pitch_mm, layout),
        pixel_mm=PIXEL_MM,
        columns=columns,
        rows=rows,
    )


def random_board(camera: Camera, rng: np.random.Generator) -> BoardGeometry:
    """Return a board whose dots the array resolves and that nearly fills the view."""
    diameter = float(max(0.2, 1.5 * camera.lattice.pitch.max()) * rng.uniform(1.0, 1.3))
    spacing = diameter * float(rng.uniform(3.5, 5.0))
    size = np.array([camera.columns, camera.rows]) * camera.pixel_mm
    dots = np.clip(np.floor(size / spacing), 3, 9).astype(int)
    polarity = "bright" if rng.random() < 0.5 else "dark"
    return BoardGeometry((int(dots[0]), int(dots[1])), spacing, diameter, polarity=polarity)


def stray_dot(
    camera: Camera,
    space: ObjectSpace,
    board: BoardGeometry,
    placement: BoardPlacement,
    level: float,
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Return the light of one dot too many, smaller than the others and anywhere on the board."""
    dirt = BoardGeometry((1, 1), board.spacing_mm, 0.7 * board.dot_diameter_mm)
    aside = rng.uniform(-1.0, 1.0, 2) * board.spacing_mm
    place = replace(placement, offset_mm=(float(aside[0]), float(aside[1])))
    return render_board(camera, space, dirt, place, level, rng)


def glare(light: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return what light a reflection adds on every third bench: a wide bright patch under all lenses alike."""
    if rng.random() > 1.0 / 3.0:
        return np.zeros_like(light)
    row, column = np.indices(light.shape)
    middle = rng.random(2) * light.shape
    width = 0.15 * min(light.shape)
    patch = np.exp(-((row - middle[0]) ** 2 + (column - middle[1]) ** 2) / (2.0 * width**2))
    return np.asarray(0.3 * patch * light, dtype=np.float64)


def judged(bench: Bench) -> dict[str, float | str]:
    """Return the errors of a calibration, each also in its own standard errors, or why there is none."""
    start = time.perf_counter()
    try:
        found = calibrate(
            Photographs([bench.white], bench.dark, bench.picture),
            Rig(bench.sheet, WATER, bench.board),
            DataSheet(camera=bench.sheet),
        )
    except LfpivError as error:
        return {"failure": str(error)}
    seconds = time.perf_counter() - start
    result: dict[str, float | str] = {"seconds": seconds, "pixels": float(bench.white.size)}
    for name, (error, sigma) in (lattice_errors(bench, found) | pose_errors(bench, found)).items():
        result[name], result[f"{name}/sigma"] = error, error / sigma
    wrong = abs(float(result["board_z_mm"])) > WRONG_DEPTH_MM or abs(float(result["pitch_rel"])) > WRONG_PITCH
    tilted = max(abs(float(result["tilt_x_deg"])), abs(float(result["tilt_y_deg"]))) > WRONG_TILT_DEG
    if wrong or tilted or found.fit.lattice_px.layout != bench.sheet.lattice.layout:
        result["silent"] = f"wrong without a word: {result}"
    return result


def lattice_errors(bench: Bench, found: Calibration) -> dict[str, tuple[float, float]]:
    """Return errors of the lattice with their standard errors."""
    fit, truth = found.fit, bench.real.micro_image_lattice_px()
    origin = fit.centres((0, 0))
    off = origin - truth.points(truth.nearest(origin))
    return {
        "rotation_deg": (
            float(np.rad2deg(fit.lattice_px.rotation_rad) - bench.rotation_deg),
            float(np.rad2deg(fit.rotation_sigma_rad)),
        ),
        "pitch_rel": (
            float(fit.lattice_px.pitch[0] / truth.pitch[0] - 1.0),
            float(fit.pitch_sigma_px[0] / truth.pitch[0]),
        ),
        "origin_column_px": (float(off[0]), float(fit.origin_sigma_px[0])),
        "origin_row_px": (float(off[1]), float(fit.origin_sigma_px[1])),
    }


def pose_errors(bench: Bench, found: Calibration) -> dict[str, tuple[float, float]]:
    """Return errors of the board's pose with their standard errors.

    Depth and place are compared where the true centre is: which rows are missing at the rim cannot be known.
    """
    pose, placement = found.pose, bench.placement
    assert pose is not None
    aside = np.array(placement.offset_mm) - pose.offset_mm
    corner = dot_centres(replace(bench.board, dots=(2, 2)), placement)[:, :2]
    steps = corner[1:3] - corner[0]
    shift = aside - np.rint(aside @ np.linalg.inv(steps)) @ steps
    depth = pose.z0_mm + np.tan(np.deg2rad(pose.tilt_deg)) @ aside
    return {
        "board_z_mm": (float(depth - placement.z_mm), pose.z0_sigma_mm),
        "tilt_x_deg": (float(pose.tilt_deg[0] - placement.tilt_deg[0]), float(pose.tilt_sigma_deg[0])),
        "tilt_y_deg": (float(pose.tilt_deg[1] - placement.tilt_deg[1]), float(pose.tilt_sigma_deg[1])),
        "magnification": (float(pose.magnification - bench.real.magnification), pose.magnification_sigma),
        "offset_x_mm": (float(shift[0]), float(pose.offset_sigma_mm[0])),
        "offset_y_mm": (float(shift[1]), float(pose.offset_sigma_mm[1])),
    }


def report(results: list[dict[str, float | str]]) -> None:
    """Print the figures of a series."""
    done = [each for each in results if "failure" not in each and "silent" not in each]
    print(f"{'error':>18} {'median':>10} {'95 %':>10} {'within 1 s':>10} {'within 2 s':>10} {'worst/s':>8}")
    for name in [key for key in done[0] if f"{key}/sigma" in done[0]]:
        error = np.abs([float(each[name]) for each in done])
        own = np.abs([float(each[f"{name}/sigma"]) for each in done])
        print(
            f"{name:>18} {np.median(error):10.2g} {np.percentile(error, 95):10.2g} {np.mean(own < 1):10.2f} "
            f"{np.mean(own < 2):10.2f} {own.max():8.1f}"
        )
    failed = [each for each in results if "failure" in each]
    silent = [each for each in results if "silent" in each]
    print(f"{len(results)} benches, {len(failed)} refused, {len(silent)} wrong without a word")
    for each in failed + silent:
        print(f"  bench {each['bench']}: {each.get('failure') or each['silent']}")
    full = [float(each["seconds"]) for each in done if float(each["pixels"]) == np.prod(FULL_SHAPE)]
    small = [float(each["seconds"]) for each in done if float(each["pixels"]) < np.prod(FULL_SHAPE)]
    for name, times in (("small", small), ("full size", full)):
        if times:
            print(f"{name}: {np.median(times):.2f} s for white and board (median of {len(times)})")
