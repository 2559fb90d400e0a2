"""Correlating volumes in memory."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files.config import Config, carried_config
from lfpiv_cli.files.provenance import OF_FRAMES, ensure_agreement
from lfpiv_cli.files.vtkhdf import Volume
from lfpiv_cli.flow import correlation
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.locking import with_locking
from lfpiv_cli.flow.masks import inside
from lfpiv_cli.grid import Grid
from lfpiv_cli.interface.notices import warn_of
from lfpiv_cli.interface.vectors_checks import field_notices, pair_notices, quality_of, window_notices
from lfpiv_cli.reference import FOCAL_POINT
from lfpiv_cli.scale import Scale


def correlate(
    a: Volume | NDArray[Any],
    b: Volume | NDArray[Any],
    *,
    mask: NDArray[Any] | None = None,
    voxel_mm: tuple[float, float, float] | None = None,
    **settings: Any,
) -> VectorField:
    """Measure the displacements between two volumes by three-dimensional cross-correlation.

    Parameters
    ----------
    a, b : Volume or (nz, ny, nx) array
        First and second volume, from `reconstruct` or `open_volume`; or light on a regular grid of your own.
    mask : (nz, ny, nx), optional
        0 where the volumes are left out.
    voxel_mm : (x, y, z) mm, optional
        Size of a voxel where `a` and `b` are plain arrays; their middle is then the origin.
    **settings
        Keys of the rig's section `correlation`, in their place: windows=((32, 32, 32), (16, 16, 16)),
        overlap=(0.5, 0.5, 0.5), dt_s=0.001, exponent and so on.

    Returns
    -------
    VectorField
        `velocity` (nz, ny, nx, 3) m/s as (u, v, w), NaN where there is no vector or no `dt_s`; `displacement_voxel`,
        `uncertainty_voxel` and `flag` likewise; `grid` has the centres of the interrogation windows, mm.

    Raises
    ------
    InputError
        The volumes or the mask do not belong together.
    ConfigError
        The settings are not possible.
    UsageError
        Plain arrays are given without `voxel_mm`.
    """
    first, second = (_as_volume(each, voxel_mm) for each in (a, b))
    ensure_alike(first, second, ("the first volume", "the second volume"))
    config = first.provenance.get("config")
    carried = carried_config(first.provenance, "the volume") if config else Config.from_resolved({})
    chosen = carried.overridden("correlation", **settings)
    windows = chosen.correlation_settings(first.grid.spacing_mm)
    usable = usable_voxels(chosen, first.grid, mask)
    field = correlation.correlate([(first.array, second.array)], first.grid, windows, mask=usable)
    if config:
        # Of light that no camera recorded nothing is known.
        field = with_locking(field, first.reference, scale_of(chosen))
    quality, name = quality_of(field), "the field"
    against_field = [*field_notices(quality, name), *pair_notices(field, quality, name)]
    warn_of([*window_notices(first, windows, "the first volume"), *against_field])
    return field


def scale_of(settings: Config) -> Scale:
    """Return the lengths in the scene of the camera that volumes were made of."""
    return settings.camera_model().scale(settings.media_model())


def usable_voxels(settings: Config, grid: Grid, mask: NDArray[Any] | None) -> NDArray[np.bool_] | None:
    """Return where volumes may be used (nz, ny, nx): between walls and where a mask is above 0; None: everywhere."""
    walls = settings.masking_walls()
    usable = None if walls is None else inside(grid, walls)
    if mask is not None:
        drawn = np.asarray(mask) > 0.0
        usable = drawn if usable is None else usable & drawn
    return usable


def ensure_alike(first: Volume, second: Volume, names: tuple[str, str]) -> None:
    """Refuse two volumes that were not made alike.

    Raises
    ------
    InputError
    """
    if first.grid != second.grid:
        raise InputError(f"{names[1]}: its grid {second.grid} differs from that of {names[0]}, {first.grid}")
    if first.reference.name != second.reference.name:
        raise InputError(f"{names[1]}: its coordinates have another origin than those of {names[0]}")
    ensure_agreement([first.provenance, second.provenance], names, OF_FRAMES)


def _as_volume(volume: Volume | NDArray[Any], voxel_mm: tuple[float, float, float] | None) -> Volume:
    """Return a volume as such, a plain array about the origin."""
    if isinstance(volume, Volume):
        return volume
    if voxel_mm is None:
        raise UsageError("correlate: plain arrays need voxel_mm, the size of a voxel along x, y, z")
    array = np.asarray(volume, dtype=np.float32)
    if array.ndim != 3:
        raise InputError(f"a volume of shape {array.shape}, expected (nz, ny, nx)")
    nz, ny, nx = array.shape
    return Volume(array, Grid.centred((nx, ny, nz), voxel_mm, (0.0, 0.0, 0.0)), FOCAL_POINT, {}, {})
