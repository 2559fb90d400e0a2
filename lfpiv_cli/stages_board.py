"""The stage of `validate board`: boards at seventeen depths, rendered, reconstructed and measured (Section 3.3)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import Console
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.batch import prepare_folder
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.reconstruction.equations import normalisers
from lfpiv_cli.reconstruction.solvers import reconstruct
from lfpiv_cli.stages_simulate import misalignment_of, readout_of
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres
from lfpiv_cli.validation.board import DEPTHS_MM, PAPER, DotFigures, board_figures, measure_dots
from lfpiv_cli.validation.board_bench import BoardBench, ideal_bench, recorded_bench
from lfpiv_cli.validation.board_pictures import board_figure


def validate_board(config: Path, output: Path, overwrite: bool, console: Console) -> dict[str, Any]:
    """Reconstruct the configured board at the paper's depths, with the configured solver.

    The pictures are those of the data sheet's camera without noise (ideal), of one with the faults that the section
    simulation gives it (recorded), or both, as validation.board.images has it.
    """
    settings = load_config(config)
    chosen = settings.validation.board.images
    halves = ("ideal", "recorded") if chosen == "both" else (chosen,)
    report = output / "board.json"
    pictures = {half: output / f"board_{half}.png" for half in halves}
    prepare_folder([report])
    for path in (report, *pictures.values()):
        ensure_writable(path, overwrite, [config])
    ensure_drawing()
    figures: dict[str, dict[str, Any]] = {}
    with console.progress(len(halves) * len(DEPTHS_MM) * settings.reconstruction.iterations, "boards") as advance:
        for half in halves:
            dots, drawn = _boards(_bench(settings, half), settings, console, advance)
            board = settings.rig().board
            figures[half] = board_figures(dots, DEPTHS_MM, board.dots, board.spacing_mm) | {"paper": PAPER[half]}
            write_picture(pictures[half], board_figure(figures[half], drawn, settings.grid()), overwrite)
    provenance = record("validate board", settings.resolved(), {"config": config})
    write_json(report, {"figures": figures, "provenance": provenance}, overwrite)
    return {f"{half}.{name}": figures[half][name] for half in halves for name in (*PAPER[half], "depth_error_mass")}


def _bench(settings: Config, half: str) -> BoardBench:
    """Return the camera before which the boards of a half of Table 3 are held."""
    scene = settings.simulation
    rig, grid, rng = settings.rig(), settings.grid(), np.random.default_rng(scene.seed)
    if half == "ideal":
        return ideal_bench(rig, grid, scene.peak_counts, rng)
    true = ObjectSpace(rig.media, settings.window_model(), scene.refraction)
    return recorded_bench(
        rig,
        settings.object_space(),
        true,
        misalignment_of(settings),
        readout_of(settings),
        grid,
        scene.peak_counts,
        rng,
    )


def _boards(
    bench: BoardBench, settings: Config, console: Console, advance: Callable[[int], None]
) -> tuple[list[DotFigures], NDArray[np.float32]]:
    """Return what is measured of the boards at all depths, and the volume of the one in the focal plane."""
    board, scene, solver = settings.rig().board, settings.simulation, settings.reconstruction
    operator = bench.weights.padded
    sums = normalisers(operator, bench.excluded)
    dots, drawn = [], np.zeros(bench.weights.shape, np.float32)
    for depth in DEPTHS_MM:
        placement = BoardPlacement(depth, scene.board_offset_mm, scene.board_tilt_deg, scene.board_rotation_deg)
        result = reconstruct(
            operator,
            bench.picture(placement),
            solver.solver,
            solver.iterations,
            solver.relaxation,
            solver.accelerate,
            sums,
            advance,
            solver.start,
        )
        volume = bench.weights.to_world(result.volume)
        centres = dot_centres(board, placement)[:, :2]
        dots.append(measure_dots(volume, bench.weights.grid, centres, 0.5 * board.spacing_mm))
        drawn = volume if depth == 0.0 else drawn
        console.detail(f"board at {depth:+.0f} mm: residual {result.residual[-1]:.3f}")
    return dots, drawn
