"""The calibration file: what `calibration.model.Calibration.to_tree` holds, as HDF5.

Layout, version 1: `image_shape` (rows, columns), `lattice` (centres and model of the lens images, pixels as (column,
row)), `transmission` (rows, columns), `board` (pose, mm and degrees), and the channel's mid plane (mm).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.errors import InputError
from lfpiv_cli.files.hdf5 import read_tree, write_tree

FORMAT = "lfpiv-calibration"
VERSION = 1
# Of the arrays whose names do not say them.
UNITS = {"image_shape": "pixel", "transmission": "1", "indices": "1", "exponents": "1"}


def write_calibration(path: Path, calibration: Calibration, provenance: Mapping[str, Any], overwrite: bool) -> None:
    """Write a calibration."""
    write_tree(
        path,
        calibration.to_tree(),
        format_name=FORMAT,
        format_version=VERSION,
        provenance=provenance,
        overwrite=overwrite,
        units=UNITS,
    )


def read_calibration(path: Path) -> Calibration:
    """Read a calibration."""
    tree, _ = read_tree(path, FORMAT, (VERSION,))
    try:
        return Calibration.from_tree(tree)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error
