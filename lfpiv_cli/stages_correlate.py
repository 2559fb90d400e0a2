"""The stage of `correlate`: displacements between pairs of volumes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import Console
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.batch import Target, output_paths, pending, prepare_folder
from lfpiv_cli.files.config import carried_config, load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record
from lfpiv_cli.flow.correlation import correlate as correlate_volumes
from lfpiv_cli.flow.correlation import count_passes
from lfpiv_cli.flow.field import REJECTED


def correlate(
    volumes: Sequence[Path],
    config: Path | None,
    dt_s: float | None,
    windows: str | None,
    overlap: float | None,
    pairing: str | None,
    resume: bool,
    output: Path,
    overwrite: bool,
    console: Console,
) -> dict[str, Any]:
    """Measure the displacements between pairs of volumes."""
    pairs = _pairs(volumes, pairing)
    paths = output_paths(output, [first.stem for first, _ in pairs])
    prepare_folder(paths)
    told = load_config(config) if config else None
    sizes = [_window(text) for text in windows.split(",")] if windows else None
    rejected = total = 0
    settings_of = []
    for first, _ in pairs:
        settings = told or carried_config(vtkhdf.read_header(first).provenance, first)
        settings_of.append(settings.overridden("correlation", dt_s=dt_s, windows=sizes, overlap=overlap))
    targets = [
        Target(path, record("correlate", settings.resolved(), given(config=config, volume_a=pair[0], volume_b=pair[1])))
        for path, pair, settings in zip(paths, pairs, settings_of, strict=True)
    ]
    inputs = [*volumes, *filter(None, [config])]
    for number in pending(targets, inputs, overwrite, resume, _record_of):
        volume_a, volume_b = (vtkhdf.open_volume(path) for path in pairs[number])
        _ensure_alike(pairs[number], volume_a, volume_b)
        chosen = settings_of[number].correlation
        grid = volume_a.grid
        sizes_xyz = settings_of[number].windows_voxel(grid.spacing_mm)
        with console.progress(count_passes(sizes_xyz), "correlate") as advance:
            field = correlate_volumes(
                volume_a.array,
                volume_b.array,
                grid,
                sizes_xyz,
                settings_of[number].overlap(grid.spacing_mm),
                chosen.dt_s,
                progress=advance,
                exponent=settings_of[number].correlation_exponent(),
            )
        vtkhdf.write_vectors(
            targets[number].path,
            field,
            provenance=targets[number].record,
            attributes={name: volume_a.attributes[name] for name in ("reference", "reference_z_mm")},
            overwrite=overwrite,
        )
        rejected += int(np.count_nonzero(field.flag >= REJECTED))
        total += field.flag.size
    return {"pairs": len(pairs), "vectors": total, "rejected": rejected}


def _record_of(path: Path) -> dict[str, Any]:
    return vtkhdf.read_header(path).provenance


def _pairs(volumes: Sequence[Path], pairing: str | None) -> list[tuple[Path, Path]]:
    """Return the pairs to correlate: (1, 2), (3, 4) ... for `ab`, (1, 2), (2, 3) ... for `sequence`."""
    if len(volumes) < 2 or (pairing != "sequence" and len(volumes) % 2):
        raise UsageError(f"correlate needs pairs of volumes, got {len(volumes)}")
    if len(volumes) > 2 and pairing is None:
        raise UsageError(
            f"{len(volumes)} volumes need --pairing: ab for separate pairs or sequence for each with the next"
        )
    step = 1 if pairing == "sequence" else 2
    return [(volumes[k], volumes[k + 1]) for k in range(0, len(volumes) - 1, step)]


def _window(text: str) -> int | list[int]:
    """Return a window given as 32 or 32x32x16."""
    try:
        sizes = [int(part) for part in text.lower().split("x")]
    except ValueError as error:
        raise UsageError(f"--windows: {text!r} is neither a number of voxels nor three of them as 32x32x16") from error
    return sizes[0] if len(sizes) == 1 else sizes


def _ensure_alike(paths: tuple[Path, Path], first: vtkhdf.Volume, second: vtkhdf.Volume) -> None:
    """Refuse two volumes that were not made alike."""
    if first.grid != second.grid:
        raise InputError(f"{paths[1]}: its grid {second.grid} differs from that of {paths[0]}, {first.grid}")
    if first.attributes["reference"] != second.attributes["reference"]:
        raise InputError(f"{paths[1]}: its coordinates have another origin than those of {paths[0]}")
    if first.provenance.get("config") != second.provenance.get("config"):
        raise InputError(f"{paths[1]}: was made with another config than {paths[0]}")
