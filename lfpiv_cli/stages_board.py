"""The stage of `validate board`: boards at seventeen depths, rendered, reconstructed and measured (Section 3.3)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import Console
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.batch import prepare_folder
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record
from lfpiv_cli.reconstruction.equations import normalisers
from lfpiv_cli.reconstruction.solvers import reconstruct
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres, render_board
from lfpiv_cli.synthetic.render import ObjectSpace
from lfpiv_cli.validation.board import DEPTHS_MM, board_figures, measure_dots
from lfpiv_cli.validation.board_pictures import board_figure
from lfpiv_cli.weights.build import factorise


def validate_board(config: Path, output: Path, overwrite: bool, console: Console) -> dict[str, Any]:
    """Reconstruct the configured board at the paper's depths from noise-free images of the data sheet's camera.

    The images are traced ray by ray with paraxial refraction, as the paper's; the solver is the configured one.
    """
    paths = output / "board.json", output / "board.png"
    prepare_folder(list(paths))
    for path in paths:
        ensure_writable(path, overwrite, [config])
    ensure_drawing()
    settings = load_config(config)
    camera, media, grid, board = settings.camera_model(), settings.media_model(), settings.grid(), settings.rig().board
    operator = factorise(camera, media, grid)
    sums = normalisers(operator)
    options = settings.reconstruction.model_dump(include={"solver", "iterations", "relaxation", "accelerate"})
    rng = np.random.default_rng(settings.simulation.seed)
    dots, nearest = [], np.zeros(grid.shape_zyx, np.float32)
    with console.progress(len(DEPTHS_MM) * options["iterations"], "boards") as advance:
        for depth in DEPTHS_MM:
            placement = BoardPlacement(depth)
            space = ObjectSpace(media, None, "paraxial")
            image = render_board(camera, space, board, placement, settings.simulation.peak_counts, rng)
            result = reconstruct(operator, image.astype(np.float32), **options, sums=sums, progress=advance)
            volume = result.volume if camera.column_axis == "x" else result.volume.swapaxes(1, 2)
            dots.append(measure_dots(volume, grid, dot_centres(board, placement)[:, :2], 0.5 * board.spacing_mm))
            nearest = volume if depth == 0.0 else nearest
            console.detail(f"board at {depth:+.0f} mm: residual {result.residual[-1]:.3f}")
    figures = board_figures(dots, DEPTHS_MM, board.dots, board.spacing_mm)
    provenance = record("validate board", settings.resolved(), {"config": config})
    write_json(paths[0], {"figures": figures, "provenance": provenance}, overwrite)
    write_picture(paths[1], board_figure(figures, nearest, grid), overwrite)
    return {name: value for name, value in figures.items() if name != "by_depth"}
