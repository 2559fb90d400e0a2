"""What `info` tells of a file of frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import open_h5
from lfpiv_cli.files.images import frames
from lfpiv_cli.files.inputs import ensure_regular_file, split_page, split_part
from lfpiv_cli.files.recordings import stack
from lfpiv_cli.files.recordings.formats import format_of


def recording_figures(path: Path) -> dict[str, Any]:
    """Return what the header of a file of frames says, and the steps between their times.

    Raises
    ------
    InputError, UsageError : see `images.frames`
    """
    file, part = split_part(path)
    recording = frames(path)
    found: dict[str, Any] = {
        "file_bytes": file.stat().st_size,
        "format": format_of(file, split_page(part)[0]).name,
        "pages": recording.pages,
        "columns": recording.shape[1],
        "rows": recording.shape[0],
        "bits": recording.bits,
    }
    if recording.time_s is not None and recording.pages > 1:
        steps_s = np.diff(recording.time_s)
        found |= {"shortest_step_s": float(steps_s.min()), "longest_step_s": float(steps_s.max())}
        duration_s = float(recording.time_s[-1] - recording.time_s[0])
        if duration_s > 0.0:
            found |= {"duration_s": duration_s, "frame_rate_hz": (recording.pages - 1) / duration_s}
    return found


def is_recording(path: Path) -> bool:
    """Return whether a file holds frames, by its first bytes or its name; of HDF5, what is not in a format of ours.

    Raises
    ------
    InputError : the file is missing, not a regular file, or empty
    """
    file, part = split_part(path)
    ensure_regular_file(file)
    try:
        kind = format_of(file, split_page(part)[0])
    except InputError:
        return False
    if kind.starts != (stack.START,) or part is not None:
        return True
    with open_h5(file) as content:
        return "format" not in content.attrs
