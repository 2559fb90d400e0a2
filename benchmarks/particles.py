"""Particles as unknowns: renderings with known tracers, found with a camera calibrated from rendered pictures.

The camera of Table 2 with an array that is turned, shifted and seen through distortion; tracers of 50 um in water
behind the channel's wall, by Snell's law, brightness 0.6 to 1.4; the volume of the paper's flow at full size.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import Calibration, Rig, calibrate
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.microlenses import Lattice
from lfpiv_cli.particles.refraction import places_by_snell
from lfpiv_cli.particles.rounds import find_particles
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.equations import normalisers
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.render import ObjectSpace, render_points, render_white
from lfpiv_cli.synthetic.scenes import Misalignment, channel_window
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.validation.particles import particle_figures
from lfpiv_cli.weights.build import default_padding, factorise
from lfpiv_cli.weights.model import Weights

WATER = Media(1.0, 1.49, 1.33)
SHAPE = (1768, 2352)
VOLUME_XYZ = (130, 100, 100)
COUNTS = (300, 1000, 3000, 8300, 16000)
REALISATIONS = 3
# Figures are also given for these distances from the focal plane, mm: light stays within one lens, few, many.
DISTANCES_MM = ((0.0, 0.5), (0.5, 2.0), (2.0, np.inf))
WALL_MM, CHANNEL_MM = 5.0, 10.0
DIAMETER_MM, VOXEL_MM, LIGHT_COUNTS = 0.05, 0.1, 5e5
MISALIGNMENT = Misalignment(-0.31, (2.2, -1.7), -2e-5)
BOARD = BoardGeometry((7, 7), 1.0, 0.2)


def bench_particles() -> None:
    """Print recall, precision, errors, their coverage and time for growing numbers of tracers at full size."""
    for count in COUNTS:
        print_figures(count, SHAPE, VOLUME_XYZ, seed=count)


def bench_particles_thrice() -> None:
    """Print the same for three realisations of each number."""
    for count in COUNTS:
        for number in range(REALISATIONS):
            print_figures(count, SHAPE, VOLUME_XYZ, seed=count + number)


def print_figures(count: int, shape: tuple[int, int], volume_xyz: tuple[int, int, int], seed: int) -> None:
    """Render, calibrate, search and print a line for the whole volume and one for each range of depths."""
    rng = np.random.default_rng(seed)
    sheet = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, shape[1], shape[0])
    real = MISALIGNMENT.apply(sheet)
    calibration = _calibration(sheet, real, rng)
    grid = Grid.centred(volume_xyz, (VOXEL_MM,) * 3, (0.0, 0.0, 0.0))
    low, high = (np.array([grid.bounds_mm(axis)[side] for axis in range(3)]) for side in (0, 1))
    margin = np.array([0.4, 0.4, 0.0])
    around = round(count * np.prod(high - low + 2.0 * margin) / np.prod(high - low))
    true = rng.uniform(low - margin, high + margin, (around, 3))
    light = LIGHT_COUNTS * rng.uniform(0.6, 1.4, around)
    readout = Readout()
    window = channel_window(sheet, WATER, CHANNEL_MM, WALL_MM, mid_plane_z_mm=0.0)
    space = ObjectSpace(WATER, window, "exact")
    expected = render_points(real, space, true, light, DIAMETER_MM, rng)
    image = readout.record(expected, rng).astype(np.float32) - np.float32(readout.dark_level_counts)

    camera = calibration.camera(sheet)
    padding = default_padding(camera, WATER, grid)
    weights = Weights(grid, padding, factorise(camera, WATER, grid.padded(padding)), camera.column_axis, calibration)
    view = raw_view(camera, WATER, 0.5 * DIAMETER_MM, calibration)
    sums = normalisers(weights.padded)
    began = time.perf_counter()
    found = find_particles(image, view, weights, camera, sums)
    seconds = time.perf_counter() - began
    places = places_by_snell(found.position_mm, space, camera)
    sigma = np.sqrt(np.diagonal(found.covariance_mm2, axis1=1, axis2=2))
    for distances in ((0.0, np.inf), *DISTANCES_MM):
        figures = particle_figures(places, true, low, high, VOXEL_MM, sigma, distances)
        text = "  ".join(f"{name} {value:.4f}" for name, value in figures.items())
        print(f"{count} particles, {seconds:.1f} s, |z| {distances[0]:g} to {distances[1]:g} mm: {text}", flush=True)


def _calibration(sheet: Camera, real: Camera, rng: np.random.Generator) -> Calibration:
    """Return what a white image and a board in air at the focal plane tell of the camera."""
    readout = replace(Readout(), dark_level_counts=0.0)
    white = readout.record(render_white(real, 28_000.0), rng)
    placement = BoardPlacement(-0.3, (0.1, -0.1), (0.3, -0.2), 0.0)
    space = ObjectSpace(WATER.in_air(), None, "paraxial")
    board = readout.record(render_board(real, space, BOARD, placement, 28_000.0, rng), rng)
    return calibrate([white], None, board, rig=Rig(sheet, WATER, BOARD))
