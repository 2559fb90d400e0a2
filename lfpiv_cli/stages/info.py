"""The stage of `info`: what is in a file, and the pixels that one voxel of the weights lights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.describe import describe
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.validation.weights_pictures import column_figure


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """What `info` draws of weights: a picture to write, and which voxel (ix, iy, iz), by default the middle one."""

    picture: Path | None = None
    voxel: tuple[int, int, int] | None = None


NO_OPTIONS = InfoOptions()


def info(
    file: Path, options: InfoOptions = NO_OPTIONS, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Tell what is in a file of ours; of weights, draw the column of one voxel."""
    picture, voxel = options.picture, options.voxel
    if picture is None:
        if voxel is not None:
            raise UsageError("--voxel needs --picture")
        return describe(file)
    ensure_writable(picture, overwrite, [file])
    ensure_drawing()
    found = describe(file)
    weights = open_weights(file).weights
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
