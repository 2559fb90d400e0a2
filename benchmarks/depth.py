"""How much of a displacement in depth comes back: uniform motions of tracers through the whole chain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.field import REJECTED
from lfpiv_cli.flow.windows import CorrelationSettings
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.render import Balls, Readout, render_points
from lfpiv_cli.weights.build import default_padding, factorise

CAMERA = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 1200, 1200)
WATER = Media(1.0, 1.49, 1.33)
BOX_MM = (6.0, 6.0, 10.0)
LATERAL_MM = (0.13, 0.07)
WINDOW_MM = 1.6
TRACER_COUNTS = 5e5
DARK_COUNTS = 96.0


@dataclass(frozen=True)
class Case:
    """One set-up: tracers in the box, displacement in depth, noise; voxels and solver as by default."""

    tracers: int
    depth_mm: float
    noisy: bool
    voxel_mm: tuple[float, float, float] = (0.1 / 3.0, 0.1 / 3.0, 0.2)
    solver: str = "em"
    iterations: int = 24
    accelerate: bool = True
    exponent: float = 0.5


def bench_depth() -> None:
    """Print mean and spread of each component over the inner windows, beside the truth."""
    print(f"box {BOX_MM} mm, windows of {WINDOW_MM} mm, lengths in mm")
    print("tracers  noise  true x, y, z    depth: of it   mean x, y, z           spread x, y, z")
    for tracers in (2800, 1000):
        for noisy in (False, True):
            for depth in (0.1, 0.3, 0.6):
                mean, spread = response(Case(tracers, depth, noisy))
                words = "  ".join(" ".join(f"{value:6.3f}" for value in triple) for triple in (mean, spread))
                true = f"{LATERAL_MM[0]} {LATERAL_MM[1]} {depth:.1f}"
                share = mean[2] / depth
                print(f"{tracers:7d}  {'yes' if noisy else ' no':>5}  {true}   {share:12.3f}   {words}", flush=True)


def response(
    case: Case, camera: Camera = CAMERA, box_mm: tuple[float, float, float] = BOX_MM
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation (x, y, z) in mm of the vectors whose windows lie inside the box."""
    shape = tuple(round(size / voxel) for size, voxel in zip(box_mm, case.voxel_mm, strict=True))
    grid = Grid.centred((shape[0], shape[1], shape[2]), case.voxel_mm, (0.0, 0.0, 0.0))
    volumes = [solve(case, camera, grid, image) for image in images(case, camera, box_mm)]
    final = [max(4, round(WINDOW_MM / voxel)) for voxel in case.voxel_mm]
    windows = [(2 * final[0], 2 * final[1], 2 * final[2]), (final[0], final[1], final[2])]
    field = correlate(
        [(volumes[0], volumes[1])], grid, CorrelationSettings(windows, (0.5, 0.5, 0.5), None, case.exponent)
    )
    inner = (slice(1, -1),) * 3
    vectors = field.displacement_voxel[inner][field.flag[inner] < REJECTED] * np.asarray(case.voxel_mm)
    return vectors.mean(axis=0), vectors.std(axis=0)


def images(case: Case, camera: Camera, box_mm: tuple[float, float, float]) -> list[np.ndarray]:
    """Return the two images, dark level subtracted; tracers that leave the box on one side enter on the other."""
    rng = np.random.default_rng(case.tracers)
    half = 0.5 * np.asarray(box_mm)
    middle = rng.uniform(-half, half, (case.tracers, 3))
    light = TRACER_COUNTS * rng.uniform(0.6, 1.4, case.tracers)
    move = np.array([*LATERAL_MM, case.depth_mm])
    readout = Readout() if case.noisy else replace(Readout(), photons_per_count=None, read_noise_counts=0.0)
    pair = []
    for sign in (-0.5, 0.5):
        points = (middle + sign * move + half) % (2.0 * half) - half
        expected = render_points(camera, ObjectSpace(WATER, None, "paraxial"), Balls(points, light, 0.05), rng)
        pair.append(readout.record(expected, rng).astype(np.float32) - np.float32(DARK_COUNTS))
    return pair


def solve(case: Case, camera: Camera, grid: Grid, image: np.ndarray) -> np.ndarray:
    """Return the volume of an image, the padding cut off."""
    padding = default_padding(camera, WATER, grid)
    operator = factorise(camera, WATER, grid.padded(padding))
    result = reconstruct(operator, image, SolverSettings(case.solver, case.iterations, accelerate=case.accelerate))
    nx, ny, nz = grid.shape_xyz
    px, py, pz = padding
    return np.ascontiguousarray(result.volume[pz : pz + nz, py : py + ny, px : px + nx])
