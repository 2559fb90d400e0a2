"""Lists of particles: positions and velocities, as NumPy's npz.

Arrays: `position_mm` (n, 3) and `velocity_mm_s` (n, 3), float32, world axes (x, y, z), z from the nominal focal point;
those of a simulated pair are at the middle of the pair, and `brightness` (n,) is there too.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.atomic import write_atomically
from lfpiv_cli.files.inputs import ensure_regular_file, reason

MM_PER_M = 1000.0


@dataclass(frozen=True, eq=False)
class Particles:
    """Particles: positions (n, 3) in mm, velocities (n, 3) in m/s, brightness (n,), 1 where the file tells none."""

    positions_mm: NDArray[np.float64]
    velocities_m_s: NDArray[np.float64]
    brightness: NDArray[np.float64]


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
            brightness = np.asarray(
                stored["brightness"] if "brightness" in stored else np.ones(len(position)), np.float64
            )
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not a list of particles: {reason(error)}") from error
    if position.ndim != 2 or position.shape[1:] != (3,) or position.shape != velocity.shape or not position.size:
        raise InputError(f"{path}: positions {position.shape} and velocities {velocity.shape}, expected twice (n, 3)")
    if brightness.shape != position.shape[:1]:
        raise InputError(f"{path}: {brightness.shape} values of brightness for {len(position)} particles")
    if not all(np.isfinite(values).all() for values in (position, velocity, brightness)):
        raise InputError(f"{path}: a position, velocity or brightness is not a finite number")
    return Particles(position, velocity / MM_PER_M, brightness)


def write_particles(
    path: Path,
    positions_mm: NDArray[np.float64],
    velocities_m_s: NDArray[np.float64],
    brightness: NDArray[np.float64],
    overwrite: bool,
) -> None:
    """Write the particles of a simulated pair."""

    def save(target: Path) -> None:
        with open(target, "wb") as file:
            np.savez_compressed(
                file,
                position_mm=positions_mm.astype(np.float32),
                velocity_mm_s=(velocities_m_s * MM_PER_M).astype(np.float32),
                brightness=brightness.astype(np.float32),
            )

    write_atomically(path, save, overwrite=overwrite)
