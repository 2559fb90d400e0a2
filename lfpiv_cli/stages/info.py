"""The stage of `info`: what is in a file, and the pixels that one voxel of the weights lights."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import UsageError
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.describe import describe
from lfpiv_cli.files.figures import file_figures
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.recordings.figures import is_recording, recording_figures
from lfpiv_cli.files.weights_file import FORMAT, open_weights
from lfpiv_cli.stages.plot_sources import column_of


@dataclass(frozen=True, kw_only=True)
class InfoOptions:
    """What `info` draws of weights: a picture to write, and which voxel (ix, iy, iz), by default the middle one."""

    picture: Path | None = None
    voxel: tuple[int, int, int] | None = None


NO_OPTIONS = InfoOptions()


def info(
    file: Path, options: InfoOptions = NO_OPTIONS, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Tell what is in a file of ours or of frames, its figures last; of weights, draw the column of one voxel."""
    picture, voxel = options.picture, options.voxel
    if picture is None:
        if voxel is not None:
            raise UsageError("--voxel needs --picture")
        return _told(file)
    ensure_writable(picture, overwrite, [file])
    ensure_drawing()
    found = _told(file)
    if found["format"] != FORMAT:
        others = "" if is_recording(file) else f"; for the figures of {found['format']}: lfpiv plot {file}"
        raise UsageError(f"--picture draws a voxel of weights{others}")
    content = open_weights(file)
    nx, ny, nz = content.weights.grid.shape_xyz
    ix, iy, iz = voxel or (nx // 2, ny // 2, nz // 2)
    if not (0 <= ix < nx and 0 <= iy < ny and 0 <= iz < nz):
        raise UsageError(f"--voxel {ix} {iy} {iz}: there are {nx} x {ny} x {nz} voxels, counted from 0")
    write_picture(picture, column_of(content, (ix, iy, iz)), overwrite)
    return found


def _told(file: Path) -> dict[str, Any]:
    if is_recording(file):
        return recording_figures(file)
    found = describe(file)
    return found | file_figures(file, found["format"])
