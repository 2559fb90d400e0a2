"""Reading what the commands read and write."""

from __future__ import annotations

from pathlib import Path

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.files import images, particle_file
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, Points


def load_rig(path: Path | str) -> Config:
    """Read a rig: the YAML file of camera, media, volume and settings that the commands take as CONFIG.

    Returns
    -------
    Config
        With every default filled in; `resolved()` gives it as plain data.

    Raises
    ------
    ConfigError
        Anything in it is malformed, unknown, contradictory or impossible; all errors at once, each with its line.
    InputError
        The file is missing or not a file.
    """
    return load_config(Path(path))


def read_image(path: Path | str, page: int = 0) -> images.Image:
    """Read an image of a TIFF or PNG file or of a camera's recording, or one page of a sequence.

    `FILE.h5:/PATH` names a dataset, `FILE.raw:LAYOUT` the layout of frames without a header.

    Returns
    -------
    (rows, columns) float32
        Counts.

    Raises
    ------
    InputError
        The file is missing or broken, in colour, or has no such page.
    """
    return images.read_page(Path(path), page)


def open_calibration(path: Path | str) -> Calibration:
    """Read a calibration.

    Returns
    -------
    Calibration
        As `calibrate` gives it.

    Raises
    ------
    InputError
        The file is missing, broken, or of another format or version.
    """
    return read_calibration(Path(path))


def open_particles(path: Path | str) -> Points:
    """Read the particles of a frame.

    Returns
    -------
    Points
        As `find_particles` gives them.

    Raises
    ------
    InputError
        The file is missing, broken, or of another format or version.
    """
    return particle_file.read_points(path, PARTICLES_FORMAT)


def open_tracks(path: Path | str) -> Points:
    """Read the tracks of two frames or of a sequence.

    Returns
    -------
    Points
        As the `points` that `track` gives.

    Raises
    ------
    InputError
        The file is missing, broken, or of another format or version.
    """
    return particle_file.read_tracks(path)
