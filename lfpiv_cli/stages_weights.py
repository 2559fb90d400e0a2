"""The stages that look at weights: `validate weights` and `info`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, LimitMissedError, UsageError
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.batch import prepare_folder
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.describe import describe
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record as provenance_record
from lfpiv_cli.files.sections import WeightsSection
from lfpiv_cli.files.weights_file import read_weights
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.optics.polynomial_rays import PolynomialRays
from lfpiv_cli.validation.weights import TABLE1_MM, in_view, limits_missed, make_columns, sample_voxels, weights_figures
from lfpiv_cli.validation.weights_pictures import column_figure, columns_figure, similarity_figure
from lfpiv_cli.weights.columns import ColumnOperator, OnDemandOperator, operator_of
from lfpiv_cli.weights.model import WeightsOperator
from lfpiv_cli.weights.rays import count_columns
from lfpiv_cli.weights.scene import Source

# Half an hour on two cores; a core counts about four million rays a second.
MOST_RAYS = 3e10
RAYS_PER_CORE_HOUR = 1.5e10
# Cubic polynomials are good to a third of their range beyond it: the paper's volume reaches a quarter beyond boards.
FARTHEST_BEYOND = 0.3
# Some 1,500 pixels of 8 bytes.
BYTES_PER_COLUMN = 12_000


def validate_weights(config: Path, output: Path, overwrite: bool, console: Console) -> dict[str, Any]:
    """Hold the weights of the paper's voxels and of a random sample against each other and against integrals."""
    paths = {name: output / f"weights{name}" for name in (".json", "_columns.png", "_similarity.png")}
    prepare_folder(list(paths.values()))
    for target in paths.values():
        ensure_writable(target, overwrite, [config])
    ensure_drawing()
    settings = load_config(config)
    chosen = settings.validation.weights
    camera, grid = settings.camera_model(), settings.grid()
    rng = np.random.default_rng(chosen.seed)
    known = [centre for centre in TABLE1_MM if in_view(camera, _space(settings), centre, grid.spacing_mm)]
    centres = np.concatenate([np.array(known).reshape(-1, 3), sample_voxels(grid, chosen.sample, rng)])
    long_count = np.where(np.arange(len(centres)) < len(known), chosen.long_count_rays, 0)
    with console.progress(len(centres), "validate weights") as advance:
        columns = make_columns(camera, _space(settings), centres, grid.spacing_mm, rng, long_count, advance)
    figures = weights_figures(columns, long_count)
    missed = limits_missed(figures, chosen.limits.model_dump())
    record = provenance_record("validate weights", settings.resolved(), {"config": config})
    write_json(paths[".json"], {"figures": figures, "limits_missed": missed, "provenance": record}, overwrite)
    shown = min(len(TABLE1_MM), len(columns))
    write_picture(paths["_columns.png"], columns_figure(columns[:shown]), overwrite)
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


def info(
    file: Path, picture: Path | None, voxel: tuple[int, int, int] | None, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Tell what is in a file of ours; of weights, draw the column of one voxel (ix, iy, iz), by default the middle."""
    if picture is None:
        if voxel is not None:
            raise UsageError("--voxel needs --picture")
        return describe(file)
    ensure_writable(picture, overwrite, [file])
    ensure_drawing()
    found = describe(file)
    weights = read_weights(file).weights
    nx, ny, nz = weights.grid.shape_xyz
    ix, iy, iz = voxel or (nx // 2, ny // 2, nz // 2)
    if not (0 <= ix < nx and 0 <= iy < ny and 0 <= iz < nz):
        raise UsageError(f"--voxel {ix} {iy} {iz}: there are {nx} x {ny} x {nz} voxels, counted from 0")
    rows, columns, shares = weights.column(iz, iy, ix)
    if not shares.size:
        raise InputError(f"{file}: voxel {ix} {iy} {iz} lights no pixel")
    place = ", ".join(f"{axis:.4g}" for axis in weights.grid.voxel_to_mm(np.array([ix, iy, iz], dtype=np.float64)))
    title = f"voxel {ix}, {iy}, {iz} at ({place}) mm: {shares.size} pixels, sum {shares.sum():.4f}"
    write_picture(picture, column_figure(rows, columns, shares, title), overwrite)
    return found


def ray_source(settings: Config, found: Calibration | None, grid: Grid, console: Console) -> Source:
    """Return how rays are found: traced through the configured object space, or as a calibration fitted them.

    Raises
    ------
    ConfigError : fitted rays are asked for and there are none
    """
    if settings.weights.method != "dlfc":
        return settings.object_space(found.mid_plane_z_mm if found else None)
    if found is None or found.ray_fit is None:
        raise ConfigError(
            "weights.method: dlfc needs a --calibration from boards at several depths: calibrate-snapshot with --board "
            "and --depth-mm, repeated in pairs"
        )
    fit = found.ray_fit
    lateral = fit.reach_mm if settings.camera_model().column_axis == "x" else fit.reach_mm[:, ::-1]
    for axis, (low, high) in enumerate([*lateral.T, (fit.depths_mm.min(), fit.depths_mm.max())]):
        beyond = max(low - grid.bounds_mm(axis)[0], grid.bounds_mm(axis)[1] - high)
        if beyond > FARTHEST_BEYOND * (high - low):
            console.say(
                f"lfpiv: the volume reaches {beyond:.3g} mm beyond the dots along {'xyz'[axis]}, where the fitted rays "
                "are a guess"
            )
    return fit.rays


def make_operator(
    chosen: WeightsSection, camera: Camera, source: Source, grid: Grid, console: Console
) -> WeightsOperator:
    """Return the weights of a grid: factorised where the axes separate, else on demand; or counted where asked for.

    Raises
    ------
    ConfigError : counting would take too long
    """
    if chosen.sampling == "exact" or isinstance(source, PolynomialRays):
        operator = operator_of(camera, source, grid)
        if isinstance(operator, OnDemandOperator):
            console.say("lfpiv: array or rays do not separate into axes; columns are made on demand, for what is lit")
        return operator
    layout = OnDemandOperator(camera, source, grid)
    voxels = math.prod(layout.shape)
    rays = voxels * chosen.points * chosen.rays_per_point
    if rays > MOST_RAYS:
        raise ConfigError(
            f"weights.sampling: counting {rays:.3g} rays for {voxels} voxels (padding included) would take about "
            f"{rays / RAYS_PER_CORE_HOUR:.2g} core hours and {voxels * BYTES_PER_COLUMN / 1e9:.2g} GB; at most "
            f"{MOST_RAYS:.3g} are counted, use sampling: exact"
        )
    centres, rng = layout.centres_mm(np.arange(voxels)), np.random.default_rng(chosen.seed)
    number = (chosen.points, chosen.rays_per_point)
    with console.progress(voxels, "count rays") as advance:
        columns = count_columns(camera, source, centres, layout.sides_mm, rng, *number, advance)
    return ColumnOperator(layout.shape, layout.image_shape, np.arange(voxels), columns)


def _space(settings: Config) -> ObjectSpace:
    """Return media and window; without the section `window` there is nothing to trace directly."""
    try:
        window = settings.window_model()
    except ConfigError:
        window = None
    return ObjectSpace(settings.media_model(), window)
