"""Lists of particles: positions and velocities, as NumPy's npz.

Arrays: `position_mm` (n, 3) and `velocity_mm_s` (n, 3), float32, world axes (x, y, z), z from the nominal focal point.
Those of a simulated pair or sequence are at its middle, and there are `brightness` (n,) and `diameter_mm` (n,), and of
each frame `frame_position_mm` (frames, n, 3) and `frame_brightness` (frames, n), 0 where there is no light.
"""

from __future__ import annotations

import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.atomic import written_atomically
from lfpiv_cli.files.inputs import ensure_regular_file, reason
from lfpiv_cli.notice import written

MM_PER_M = 1000.0

# What a list need not tell, in the order of the attributes of `Particles`.
OPTIONAL = ("brightness", "diameter_mm", "frame_position_mm", "frame_brightness")
# Places, which deflate can hardly shrink, tell how large the others may be, which can all be alike.
PLACES, LARGEST_PLACES_RATIO = "position_mm", 300
# Arrays are of 8 bytes a number at most, float64 in memory.
NUMBER_BYTES = 8
# Of what is measured in mm, mm/s and counts; squares of more leave the range of float32.
LARGEST_VALUE = 1e15


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
        with zipfile.ZipFile(path) as stored:
            arrays: dict[str, NDArray[np.float64]] = {}
            # A name in the archive's list must be that before the array itself, of arrays that are not read, too: one
            # that is damaged would be an array that is not told.
            for entry in stored.infolist():
                stored.open(entry).close()
            there = set(stored.namelist())
            told_names = [name for name in OPTIONAL if f"{name}.npy" in there]
            # Places first, by which the size of the others is judged.
            for name in sorted(
                ["position_mm", "velocity_mm_s", *told_names], key=lambda name: not name.endswith(PLACES)
            ):
                arrays[name] = _read_array(stored, name, max((array.size for array in arrays.values()), default=0))
    except Exception as error:  # a damaged archive can raise anything in zipfile and NumPy
        raise InputError(f"{path}: not a list of particles: {reason(error)}") from error
    position, velocity = arrays.pop("position_mm"), arrays.pop("velocity_mm_s")
    reported = arrays
    if position.ndim != 2 or position.shape[1:] != (3,) or position.shape != velocity.shape or not position.size:
        raise InputError(f"{path}: positions {position.shape} and velocities {velocity.shape}, expected twice (n, 3)")
    reported.setdefault("brightness", np.ones(len(position)))
    frames = reported["frame_position_mm"].shape[:1] if "frame_position_mm" in reported else ()
    for name, array in reported.items():
        of_frames = frames if name.startswith("frame") else ()
        expected = of_frames + (position.shape if name == "frame_position_mm" else position.shape[:1])
        if array.shape != expected:
            raise InputError(f"{path}: {name} {array.shape} for {len(position)} particles, expected {expected}")
    if not all((np.abs(values) < LARGEST_VALUE).all() for values in (position, velocity, *reported.values())):
        raise InputError(
            f"{path}: a position, velocity, brightness or diameter is not a finite number below "
            f"{written(LARGEST_VALUE)}"
        )
    return Particles(
        position, velocity / MM_PER_M, reported["brightness"], *(reported.get(name) for name in OPTIONAL[1:])
    )


def _read_array(stored: zipfile.ZipFile, name: str, largest: int) -> NDArray[np.float64]:
    """Return an array of an archive, after asking its header whether it is what the archive's list says.

    Parameters
    ----------
    largest : numbers of the largest array before it

    Raises
    ------
    ValueError : it is of no real numbers, of another size than it declares, or too large
    """
    entry = stored.getinfo(f"{name}.npy")
    with stored.open(entry) as file:
        if np.lib.format.read_magic(file) != (1, 0):
            raise ValueError(f"{name} has another version of NumPy's format than 1.0")
        shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        if dtype.kind not in "fiu" or dtype.itemsize > NUMBER_BYTES or min(shape, default=0) < 0:
            raise ValueError(f"{name} is of {dtype} {shape}, expected real numbers")
        begin, count = file.tell(), math.prod(shape)
        if entry.file_size - begin != count * dtype.itemsize:
            raise ValueError(f"{name} declares {shape} numbers of {dtype}, it has {entry.file_size - begin} bytes")
        allowed = LARGEST_PLACES_RATIO * entry.compress_size // dtype.itemsize if name.endswith(PLACES) else largest
        if count > allowed:
            raise ValueError(f"{name} declares {shape} numbers, more than the {allowed} that are possible")
    with stored.open(entry) as file:
        return np.asarray(np.lib.format.read_array(file, allow_pickle=False), np.float64)


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
    with written_atomically(path, overwrite=overwrite) as target, open(target, "wb") as file:
        np.savez_compressed(file, **known)
