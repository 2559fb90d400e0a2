"""Particles as unknowns: renderings with known tracers, found with a camera calibrated from rendered pictures.

And errors over the Cramer-Rao bound, of the search and the fit alone: a camera that is known exactly, images from the
response that is fitted.

The camera of Table 2 with an array that is turned, shifted and seen through distortion; tracers of 50 um in water
behind the channel's wall, by Snell's law, brightness 0.6 to 1.4 or log-normal; the volume of the paper's flow at full
size.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import Calibration, Photographs, Rig, calibrate
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media, channel_window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.particles.rounds import find_particles
from lfpiv_cli.particles.search import Task, task_of
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.solvers import Normalisers, normalisers
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.render import Balls, Readout, render_points, render_white
from lfpiv_cli.synthetic.scenes import Misalignment
from lfpiv_cli.validation.planning import cramer_rao_bound, expected_image, pixel_variance, slopes
from lfpiv_cli.validation.volume import match, particle_figures
from lfpiv_cli.weights.model import Weights

WATER = Media(1.0, 1.49, 1.33)
SHAPE = (1768, 2352)
VOLUME_XYZ = (130, 100, 100)
COUNTS = (300, 1000, 3000, 8300, 16000)
REALISATIONS = 3
# One more line: this number with brightness spread so much (standard deviation of the logarithm).
LOG_NORMAL = (8300, 0.5)
# Sensor and volume of the images that are held against the bound; their tracers, on a lattice that keeps their light
# apart and strewn as densely as the paper's 8300.
BOUND_SHAPE, BOUND_VOLUME_XYZ = (880, 880), (36, 36, 100)
APART_MM, BOUND_COUNT = 0.8, 830
# Beyond so many standard errors of the bound it is another tracer, or another depth that explains the light as well:
# counted, not averaged.
ASTRAY = 10.0
# Figures are also given for these distances from the focal plane, mm: light stays within one lens, few, many.
DISTANCES_MM = ((0.0, 0.5), (0.5, 2.0), (2.0, np.inf))
WALL_MM, CHANNEL_MM = 5.0, 10.0
# Tracers so near to the sides of the view are not judged: two microlenses, and what the camera is shifted by.
UNSEEN_MM = 0.25
DIAMETER_MM, VOXEL_MM, LIGHT_COUNTS = 0.05, 0.1, 5e5
MISALIGNMENT = Misalignment(-0.31, (2.2, -1.7), -2e-5)
BOARD = BoardGeometry((7, 7), 1.0, 0.2)


@dataclass(frozen=True, eq=False)
class Bench:
    """A camera that was calibrated from rendered pictures, and weights built for it.

    Attributes
    ----------
    sheet, real : the data sheet's camera and the one that takes the pictures
    grid : of the volume in which tracers are judged
    """

    sheet: Camera
    real: Camera
    calibration: Calibration
    grid: Grid
    weights: Weights
    sums: Normalisers

    @property
    def space(self) -> ObjectSpace:
        """What the tracers are seen through."""
        window = channel_window(self.sheet.focus_distance_mm, WATER, CHANNEL_MM, WALL_MM, mid_plane_z_mm=0.0)
        return ObjectSpace(WATER, window, "exact")

    def bounds_mm(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of the volume, lowest and highest."""
        low, high = np.array([self.grid.bounds_mm(axis) for axis in range(3)]).T
        return low, high

    def judged_mm(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the corners of the part of the volume that is judged.

        At full size the volume is wider than the sensor: the light of tracers at its sides meets none.
        """
        low, high = self.bounds_mm()
        camera = self.real
        half = 0.5 * camera.pixel_mm * np.array([camera.columns, camera.rows]) / -camera.magnification - UNSEEN_MM
        high[:2] = np.minimum(high[:2], half)
        low[:2] = np.maximum(low[:2], -half)
        return low, high

    def photograph(
        self, points_mm: NDArray[np.float64], light_counts: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Return the recorded image (rows, columns) of tracers (n, 3), the dark level taken off."""
        readout = Readout()
        expected = render_points(self.real, self.space, Balls(points_mm, light_counts, DIAMETER_MM), rng)
        return readout.record(expected, rng).astype(np.float32) - np.float32(readout.dark_level_counts)

    def task(self, image: NDArray[np.float32]) -> Task:
        """Return the task that an image sets."""
        camera = self.calibration.camera(self.sheet)
        view = raw_view(camera, WATER, 0.5 * DIAMETER_MM, self.calibration, self.space)
        return task_of(image, view, self.weights, camera, self.sums)


def bench_particles() -> None:
    """Print recall, precision, errors, their coverage and time for growing numbers of tracers at full size."""
    _print_all(1)


def bench_particles_thrice() -> None:
    """Print the same for three realisations of each number."""
    _print_all(REALISATIONS)


def _print_all(realisations: int) -> None:
    print_errors_over_bound(BOUND_SHAPE, BOUND_VOLUME_XYZ, BOUND_COUNT, seed=0)
    # One calibration for all: rendering its pictures takes as long as finding a thousand tracers.
    bench = calibrated(SHAPE, VOLUME_XYZ, seed=0)
    for count, spread in (*((count, None) for count in COUNTS), LOG_NORMAL):
        for number in range(realisations):
            print_figures(bench, count, count + number, spread)


def calibrated(shape: tuple[int, int], volume_xyz: tuple[int, int, int], seed: int) -> Bench:
    """Render a white image and a board, calibrate from them and build weights."""
    sheet = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, shape[1], shape[0])
    real = MISALIGNMENT.apply(sheet)
    calibration = _calibration(sheet, real, np.random.default_rng(seed))
    grid = Grid.centred(volume_xyz, (VOXEL_MM,) * 3, (0.0, 0.0, 0.0))
    camera = calibration.camera(sheet)
    weights = Weights.factorised(camera, WATER, grid, calibration)
    return Bench(sheet, real, calibration, grid, weights, normalisers(weights.padded))


def print_figures(bench: Bench, count: int, seed: int, log_spread: float | None = None) -> None:
    """Render tracers, search and print a line for the whole volume and one for each range of depths.

    Their brightness is log-normal of this standard deviation of its logarithm, or uniform from 0.6 to 1.4.
    """
    rng = np.random.default_rng(seed)
    low, high = bench.bounds_mm()
    margin = np.array([0.4, 0.4, 0.0])
    around = round(count * np.prod(high - low + 2.0 * margin) / np.prod(high - low))
    true = rng.uniform(low - margin, high + margin, (around, 3))
    brightness = rng.uniform(0.6, 1.4, around) if log_spread is None else rng.lognormal(0.0, log_spread, around)
    image = bench.photograph(true, LIGHT_COUNTS * brightness, rng)

    began = time.perf_counter()
    found = find_particles(bench.task(image))
    seconds = time.perf_counter() - began
    sigma = np.sqrt(np.diagonal(found.covariance_mm2, axis1=1, axis2=2))
    what = f"{count} particles" if log_spread is None else f"{count} particles of log-normal brightness {log_spread:g}"
    for distances in ((0.0, np.inf), *DISTANCES_MM):
        figures = particle_figures(found.position_mm, true, *bench.judged_mm(), VOXEL_MM, sigma, distances)
        text = "  ".join(f"{name} {value:.4f}" for name, value in figures.items())
        print(f"{what}, {seconds:.1f} s, |z| {distances[0]:g} to {distances[1]:g} mm: {text}", flush=True)


def print_errors_over_bound(shape: tuple[int, int], volume_xyz: tuple[int, int, int], count: int, seed: int) -> None:
    """Print the errors of tracers apart from each other, and of `count` strewn over the volume, over the bound."""
    camera = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, shape[1], shape[0])
    grid = Grid.centred(volume_xyz, (VOXEL_MM,) * 3, (0.0, 0.0, 0.0))
    weights = Weights.factorised(camera, WATER, grid)
    sums = normalisers(weights.padded)
    rng = np.random.default_rng(seed)
    low, high = (np.array([grid.bounds_mm(axis)[side] for axis in range(3)]) for side in (0, 1))
    sides = [np.arange(a + 0.5 * APART_MM, b, APART_MM) for a, b in zip(low[:2], high[:2], strict=True)]
    apart = np.stack(np.meshgrid(*sides), axis=-1).reshape(-1, 2)
    apart = apart + rng.uniform(-0.05, 0.05, apart.shape)
    places = {
        "apart": np.column_stack([apart, rng.uniform(low[2], high[2], len(apart))]),
        "strewn": rng.uniform(low, high, (count, 3)),
    }
    for name, true in places.items():
        light = LIGHT_COUNTS * rng.uniform(0.6, 1.4, len(true))
        view, readout = raw_view(camera, WATER, 0.5 * DIAMETER_MM), Readout()
        truth = np.column_stack([true, light])
        slope = slopes(view, truth)
        expected = expected_image(slope, truth)
        bound = cramer_rao_bound(slope, pixel_variance(expected, readout))
        counts = readout.record(expected.reshape(shape), rng).astype(np.float32)
        image = counts - np.float32(readout.dark_level_counts)
        found = find_particles(task_of(image, view, weights, camera, sums))
        pairs = match(found.position_mm, true, VOXEL_MM)
        error = pairs.error_voxel * VOXEL_MM
        for label, joint in (("neighbours known", False), ("neighbours to be found", True)):
            over = error / bound.sigma_mm(joint)[pairs.true]
            figures = errors_over_bound(over)
            text = "  ".join(f"{key} {value:.3f}" for key, value in figures.items())
            print(
                f"{len(true)} tracers {name}, recall {len(pairs.true) / len(true):.4f}, errors over the bound with "
                f"{label}: {text}",
                flush=True,
            )


def errors_over_bound(over: NDArray[np.float64]) -> dict[str, float]:
    """Return rms and robust spread of errors (n, 3) in units of the bound, and the share that is far astray."""
    figures = {}
    for name, values in zip("xyz", over.T, strict=True):
        near = np.abs(values) <= ASTRAY
        figures[f"rms_{name}"] = float(np.sqrt(np.mean(values[near] ** 2))) if near.any() else float("nan")
        figures[f"spread_{name}"] = float(MAD_TO_SIGMA * np.median(np.abs(values))) if values.size else float("nan")
        figures[f"astray_{name}"] = float(np.mean(~near)) if values.size else float("nan")
    return figures


def _calibration(sheet: Camera, real: Camera, rng: np.random.Generator) -> Calibration:
    """Return what a white image and a board in air at the focal plane tell of the camera."""
    readout = replace(Readout(), dark_level_counts=0.0)
    white = readout.record(render_white(real, 28_000.0), rng)
    placement = BoardPlacement(-0.3, (0.1, -0.1), (0.3, -0.2), 0.0)
    space = ObjectSpace(WATER.in_air(), None, "paraxial")
    board = readout.record(render_board(real, space, BOARD, placement, 28_000.0, rng), rng)
    return calibrate(Photographs([white], board=board), Rig(sheet, WATER, BOARD))
