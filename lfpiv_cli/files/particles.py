"""Lists of particles: positions and velocities, as NumPy's npz.

Arrays: `position_mm` (n, 3) and `velocity_mm_s` (n, 3), float32, world axes (x, y, z), z from the nominal focal point.
Those of a simulated pair or sequence are at its middle, and there are `brightness` (n,) and `diameter_mm` (n,), and of
each frame `frame_position_mm` (frames, n, 3) and `frame_brightness` (frames, n), 0 where there is no light.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.atomic import write_atomically
from lfpiv_cli.files.inputs import ensure_regular_file, reason

MM_PER_M = 1000.0

# What a list need not tell, in the order of the attributes of `Particles`.
OPTIONAL = ("brightness", "diameter_mm", "frame_position_mm", "frame_brightness")


@dataclass(frozen=True, eq=False)
class Particles:
    """Particles, and where they are in each frame.

    Attributes
    ----------
    positions_mm, velocities_m_s : (n, 3)
    brightness : (n,), 1 where the file tells none
    diameters_mm : (n,), None where the file tells none
    frame_positions_mm, frame_brightness : (frames, n, 3) and (frames, n), None where the file tells none
    """

    positions_mm: NDArray[np.float64]
    velocities_m_s: NDArray[np.float64]
    brightness: NDArray[np.float64]
    diameters_mm: NDArray[np.float64] | None = None
    frame_positions_mm: NDArray[np.float64] | None = None
    frame_brightness: NDArray[np.float64] | None = None


def read_particles(path: Path) -> Particles:
    """Read a list of particles.

    Raises
    ------
    InputError : the file is missing or broken, an array is missing, or their shapes or values make no list.
    """
    ensure_regular_file(path)
    try:
        with np.load(path, allow_pickle=False) as stored:
            position, velocity = (np.asarray(stored[name], np.float64) for name in ("position_mm", "velocity_mm_s"))
            told = {name: np.asarray(stored[name], np.float64) for name in OPTIONAL if name in stored}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a list of particles: {reason(error)}") from error
    if position.ndim != 2 or position.shape[1:] != (3,) or position.shape != velocity.shape or not position.size:
        raise InputError(f"{path}: positions {position.shape} and velocities {velocity.shape}, expected twice (n, 3)")
    told.setdefault("brightness", np.ones(len(position)))
    frames = told["frame_position_mm"].shape[:1] if "frame_position_mm" in told else ()
    for name, array in told.items():
        of_frames = frames if name.startswith("frame") else ()
        expected = of_frames + (position.shape if name == "frame_position_mm" else position.shape[:1])
        if array.shape != expected:
            raise InputError(f"{path}: {name} {array.shape} for {len(position)} particles, expected {expected}")
    if not all(np.isfinite(values).all() for values in (position, velocity, *told.values())):
        raise InputError(f"{path}: a position, velocity, brightness or diameter is not a finite number")
    return Particles(position, velocity / MM_PER_M, told["brightness"], *(told.get(name) for name in OPTIONAL[1:]))


def write_particles(path: Path, particles: Particles, overwrite: bool) -> None:
    """Write the particles of a simulated pair or sequence."""
    arrays = {
        "position_mm": particles.positions_mm,
        "velocity_mm_s": particles.velocities_m_s * MM_PER_M,
        "brightness": particles.brightness,
        "diameter_mm": particles.diameters_mm,
        "frame_position_mm": particles.frame_positions_mm,
        "frame_brightness": particles.frame_brightness,
    }
    known: dict[str, Any] = {name: array.astype(np.float32) for name, array in arrays.items() if array is not None}

    def save(target: Path) -> None:
        with open(target, "wb") as file:
            np.savez_compressed(file, **known)

    write_atomically(path, save, overwrite=overwrite)
