"""The stage of `validate board`: boards at seventeen depths, rendered, reconstructed and measured (Section 3.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Singles
from lfpiv_cli.calibration.board import dots_in_world
from lfpiv_cli.calibration.dlfc import fit_rays
from lfpiv_cli.calibration.model import Photographs, Rig, calibrate
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.pages import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.images import Image, Mask, light
from lfpiv_cli.reconstruction.solvers import ALL_ITERATIONS, Reconstruction, normalisers, reconstruct
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres, render_board
from lfpiv_cli.synthetic.scenes import RecordingCamera, simulate_board, simulate_white
from lfpiv_cli.validation import board as of_boards
from lfpiv_cli.verbs.frames import Progress
from lfpiv_cli.verbs.simulate import misalignment_of, placement_of, readout_of
from lfpiv_cli.weights.build import factorise_through, scene_distortion
from lfpiv_cli.weights.columns import operator_of
from lfpiv_cli.weights.model import Weights

# The ideal one is the data sheet's, its pictures free of noise and their light refracted paraxially. The real one has
# an array that is turned and shifted, a main lens that distorts, a sensor with noise, and light refracted exactly; it
# is calibrated from a white picture and one of a board in air, and nothing else is known of it. Weights are those of
# equivalent points, or of rays fitted to the very boards (DLFC).

# The board that calibrates the real camera stands so far behind the focal plane, in air, where depth shows well.
CALIBRATION_BOARD_Z_MM = 0.3


@dataclass(frozen=True, eq=False)
class BoardBench:
    """A camera before which boards are held.

    Attributes
    ----------
    rig : its camera with the lattice of the weights' frame
    weights : of the volume in which boards are reconstructed
    picture : gives the picture (rows, columns) of a board in its place, in the weights' frame, dark taken off
    excluded : pixels (rows, columns) of that frame that lie off the sensor
    """

    rig: Rig
    weights: Weights
    picture: Callable[[BoardPlacement], Image]
    excluded: Mask

    def with_voxels(self, grid: Grid, assumed: ObjectSpace) -> BoardBench:
        """Return the bench with weights of equivalent points on another grid."""
        camera = self.rig.camera
        bend = None if self.weights.calibration is None else scene_distortion(camera, self.rig.media, grid)
        operator = factorise_through(camera, assumed, grid)
        weights = replace(self.weights, grid=grid, solver_operator=operator, scene_distortion_per_mm2=bend)
        return replace(self, weights=weights)

    def with_fitted_rays(self, pictures: Sequence[Image], depths_mm: Sequence[float]) -> BoardBench:
        """Return the bench with weights of rays fitted to pictures of its board at depths."""
        rays = fit_rays(pictures, depths_mm, self.rig.camera, self.rig.board, self.rig.media).rays
        operator = operator_of(self.rig.camera, rays, self.weights.grid)
        return replace(self, weights=replace(self.weights, solver_operator=operator, scene_distortion_per_mm2=None))


BoardSolver = Callable[[Singles, Progress], Reconstruction]

# Two make a step in depth, a third the polynomials of fitted rays.
FEWEST_DEPTHS = 3


def validate_board(
    config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Reconstruct the configured board at the paper's depths, with the configured solver.

    The pictures are those of the data sheet's camera without noise (ideal), of one with the faults that the section
    simulation gives it (recorded), or both, as validation.board.images has it.
    """
    settings = load_rig(config)
    chosen = settings.validation.board
    halves = ("ideal", "recorded") if chosen.images == "both" else (chosen.images,)
    depths = depths_in_volume(settings)
    solved = [method for method in chosen.methods if method != "discs"]
    report = output / "board.json"
    drawings = {(half, method): output / f"board_{half}_{method}.png" for half in halves for method in solved}
    for path in (report, *drawings.values()):
        ensure_writable(path, overwrite, [config])
    ensure_drawing()
    figures: dict[str, dict[str, Any]] = {half: {} for half in halves}
    drawn = np.zeros(settings.grid().shape_zyx, np.float32)
    steps = len(halves) * (len(solved) * settings.reconstruction.iterations + len(chosen.methods) - len(solved))
    with console.progress(steps * len(depths), "boards") as advance:
        for half in halves:
            bench = bench_of(settings, half)
            board = bench.rig.board
            pictures = [bench.picture(placement_of(settings, depth)) for depth in depths]
            for method in chosen.methods:
                if method == "discs":
                    # The errors of place of dots that are fitted to the pictures as discs.
                    calibration, places = bench.weights.calibration, []
                    rotation = 0.0 if calibration is None else calibration.rectification.rotation_rad
                    for picture in pictures:
                        places.append(dots_in_world(picture, bench.rig.camera, board, bench.rig.media, rotation))
                        advance(1)
                    x, z = ([each[..., axis] for each in places] for axis in (0, 2))
                    figures[half][method] = of_boards.place_figures(x, z, depths, board.spacing_mm)
                    continue
                judged = bench if method == "ert" else bench.with_fitted_rays(pictures, depths)
                solve, dots = board_solver(judged, settings), []
                for depth, picture in zip(depths, pictures, strict=True):
                    found, volume, residual = board_in(judged, solve, picture, placement_of(settings, depth), advance)
                    dots.append(found)
                    drawn = volume if depth == 0.0 else drawn
                    console.detail(f"board at {depth:+z.0f} mm: residual {residual:z.3f}")
                measured = of_boards.board_figures(dots, depths, board.dots, board.spacing_mm)
                figures[half][method] = measured | {"paper": of_boards.PAPER[half, method]}
                write_picture(
                    drawings[half, method], of_boards.board_figure(measured, drawn, settings.grid()), overwrite
                )
    provenance = record("validate board", settings.resolved(), {"config": config})
    write_json(report, {"figures": figures, "provenance": provenance}, overwrite)
    return {
        f"{half}.{method}.{name}": value
        for half, methods in figures.items()
        for method, measured in methods.items()
        for name, value in measured.items()
        if isinstance(value, float)
    }


def depths_in_volume(settings: Config) -> tuple[float, ...]:
    """Return those of the paper's depths that lie in the volume (ConfigError: they are too few)."""
    low, high = settings.grid().bounds_mm(2)
    depths = tuple(depth for depth in of_boards.DEPTHS_MM if low < depth < high)
    if len(depths) < FEWEST_DEPTHS:
        raise ConfigError(
            f"{settings.source}: volume: reaches from z = {low:g} to {high:g} mm and holds {len(depths)} of the "
            f"boards, 1 mm apart each; expected at least {FEWEST_DEPTHS}"
        )
    return depths


def bench_of(settings: Config, half: str) -> BoardBench:
    """Return the camera before which the boards of a half of Table 3 are held.

    The ideal one is the data sheet's; the other one departs from it, and is calibrated from pictures that it took.
    """
    scene, level = settings.simulation, settings.simulation.peak_counts
    settings.ensure_plane_layers("validating boards")
    rig, grid, rng = settings.rig(), settings.grid(), np.random.default_rng(scene.seed)
    if half == "ideal":
        paraxial = ObjectSpace(rig.media, None, "paraxial")
        weights = Weights(grid, (0, 0, 0), factorise_through(rig.camera, paraxial, grid), rig.camera.column_axis)
        rendered = partial(render_board, rig.camera, paraxial, rig.board, level=level, rng=rng)
        nothing = np.zeros(weights.image_shape, np.bool_)
        return BoardBench(rig, weights, lambda placement: rendered(placement).astype(np.float32), nothing)
    space = ObjectSpace(rig.media, settings.window_model(), scene.refraction)
    assumed = settings.plane_space("validating boards")
    real = RecordingCamera(misalignment_of(settings).apply(rig.camera), readout_of(settings), scene.light.waves())
    dark = real.dark_frame(rng)
    white = simulate_white(real, level, rng).image
    board = replace(rig.board, medium="air")
    air = ObjectSpace(rig.media.in_air(), None, "paraxial")
    snapshot = simulate_board(real, air, board, BoardPlacement(CALIBRATION_BOARD_Z_MM), level, rng).image
    calibration = calibrate(Photographs([white], dark, snapshot), replace(rig, board=board))
    camera = calibration.camera(rig.camera)
    bend, operator = scene_distortion(camera, rig.media, grid), factorise_through(camera, assumed, grid)
    calibrated = Weights(grid, (0, 0, 0), operator, camera.column_axis, calibration, bend)

    def picture(placement: BoardPlacement) -> Image:
        recorded = simulate_board(real, space, rig.board, placement, level, rng).image
        return calibrated.prepare(light(recorded.astype(np.float32), dark.astype(np.float32)))

    return BoardBench(replace(rig, camera=camera), calibrated, picture, ~calibration.rectification.inside)


def board_in(
    bench: BoardBench, solve: BoardSolver, picture: Singles, placement: BoardPlacement, advance: Progress
) -> tuple[of_boards.DotFigures, Singles, float]:
    """Return what is measured of the board in a picture, its volume [z, y, x], and the solver's last residual."""
    board, result = bench.rig.board, solve(picture, advance)
    volume = bench.weights.to_world(result.volume)
    centres = dot_centres(board, placement)[:, :2]
    dots = of_boards.measure_dots(volume, bench.weights.grid, centres, 0.5 * board.spacing_mm)
    return dots, volume, float(result.residual[-1])


def board_solver(bench: BoardBench, settings: Config) -> BoardSolver:
    """Return what reconstructs a picture of the bench with the configured solver and calls back at each iteration.

    The volume is in the solver's axes. All iterations are made, so that methods and depths can be compared.
    """
    solver = replace(settings.solver_settings(), stopping=ALL_ITERATIONS)
    sums = None if bench.weights.on_demand else normalisers(bench.weights.padded, bench.excluded)

    def solve(picture: Singles, advance: Progress) -> Reconstruction:
        operator = bench.weights.padded.for_image(picture)
        return reconstruct(
            operator, picture, solver, sums=sums or normalisers(operator, bench.excluded), progress=advance
        )

    return solve
