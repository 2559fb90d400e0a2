"""The stage of `validate weights`: single voxels' weights against integrals, direct ray tracing and counted rays."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError, LimitMissedError
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record as provenance_record
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.validation.curved_weights import make_curved_columns, seen_voxels
from lfpiv_cli.validation.weights import TABLE1_MM, in_view, limits_missed, make_columns, sample_voxels, weights_figures
from lfpiv_cli.validation.weights_pictures import SHOWN, SHOWN_BEHIND_FACES, columns_figure, similarity_figure


def validate_weights(
    config: Path, output: Path, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Hold the weights of the paper's voxels and of a random sample against each other and against integrals.

    Through a scene all voxels are random ones of the fluid.
    """
    paths = {name: output / f"weights{name}" for name in (".json", "_columns.png", "_similarity.png")}
    for target in paths.values():
        ensure_writable(target, overwrite, [config])
    ensure_drawing()
    settings = load_config(config)
    chosen = settings.validation.weights
    camera, grid = settings.camera_model(), settings.grid()
    rng = np.random.default_rng(chosen.seed)
    scene = settings.scene_space()
    if scene is not None:
        voxels = seen_voxels(camera, scene, grid, len(TABLE1_MM) + chosen.sample, rng)
        long_count = np.where(np.arange(len(voxels)) < len(TABLE1_MM), chosen.long_count_rays, 0)
        with console.progress(len(voxels), "validate weights") as advance:
            columns = make_curved_columns(camera, scene, grid, voxels, rng, long_count, advance)
    else:
        space = _space(settings)
        known = [centre for centre in TABLE1_MM if in_view(camera, space, centre, grid.spacing_mm)]
        centres = np.concatenate([np.array(known).reshape(-1, 3), sample_voxels(grid, chosen.sample, rng)])
        long_count = np.where(np.arange(len(centres)) < len(known), chosen.long_count_rays, 0)
        with console.progress(len(centres), "validate weights") as advance:
            columns = make_columns(camera, space, centres, grid.spacing_mm, rng, long_count, advance)
    figures = weights_figures(columns, long_count)
    missed = limits_missed(figures, chosen.limits.model_dump())
    record = provenance_record("validate weights", settings.resolved(), {"config": config})
    write_json(paths[".json"], {"figures": figures, "limits_missed": missed, "provenance": record}, overwrite)
    shown = min(len(TABLE1_MM), len(columns))
    names = SHOWN if scene is None else SHOWN_BEHIND_FACES
    write_picture(paths["_columns.png"], columns_figure(columns[:shown], names), overwrite)
    write_picture(paths["_similarity.png"], similarity_figure(figures, shown), overwrite)
    summary = {
        f"{name}.{figure}": each[figure]
        for name, each in figures.items()
        if isinstance(each, dict)
        for figure in ("ssim_smallest", "rmse_grey_largest", "l1_mean", "l1_largest")
    }
    if missed:
        raise LimitMissedError(f"{paths['.json']}: {'; '.join(missed)}", summary)
    return {"voxels": len(columns)} | summary


def _space(settings: Config) -> ObjectSpace:
    """Return media and window; without the section `window` there is nothing to trace directly."""
    try:
        window = settings.window_model()
    except ConfigError:
        window = None
    return ObjectSpace(settings.media_model(), window)
