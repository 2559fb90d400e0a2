"""The mean of vector fields, just made or there before, and the fields derived from vectors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import Console, Frames
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.batch import Target
from lfpiv_cli.files.config import carried_config
from lfpiv_cli.files.hdf5 import format_of
from lfpiv_cli.files.particle_file import TRACKS_FORMAT, TRAJECTORIES_FORMAT, read_tracks
from lfpiv_cli.files.provenance import OF_COORDINATES, ensure_agreement, record
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, Derived, VectorField, derived_fields, statistics_of
from lfpiv_cli.verbs.batches import Batch, BatchOptions, work_through
from lfpiv_cli.verbs.checks import quality_of
from lfpiv_cli.verbs.fields import paths_of
from lfpiv_cli.verbs.tracks import TracksOf

Extra = dict[str, tuple[NDArray[Any], str]]


def arrays_of(derived: Derived) -> Extra:
    """Return derived fields with the names and units that files give them."""
    return {
        "vorticity": (derived.vorticity, "1/s"),
        "divergence": (derived.divergence, "1/s"),
        "strain_rate": (derived.strain_rate, "1/s"),
        "q_criterion": (derived.q_criterion, "1/s2"),
    }


class Mean(Batch[None]):
    """The mean of a batch's vectors, with their fluctuations as `velocity_rms` and `displacement_rms_voxel`."""

    label, unit = "mean", "file"

    def __init__(
        self, path: Path, fields: Sequence[Path], resolved: Mapping[str, Any], derived: bool, overwrite: bool
    ) -> None:
        """Take where it goes, the files of vectors, and their settings."""
        self.inputs, self._resolved, self._derived, self.overwrite = fields, resolved, derived, overwrite
        self.targets = [Target(path, self._record)]

    def make(self, number: int, _work: Frames) -> None:
        """Write it."""
        found = statistics_of(field for path in self.inputs for field in _fields_in(path))
        extra: Extra = {"displacement_rms_voxel": (found.rms_voxel, "voxel"), "samples": (found.samples, "1")}
        if found.mean.dt_s is not None:
            to_velocity = np.asarray(found.mean.voxel_mm) * MM_TO_M / found.mean.dt_s
            extra["velocity_rms"] = (found.rms_voxel * to_velocity, "m/s")
        if self._derived:
            extra |= arrays_of(derived_fields(found.mean))
        vtkhdf.write_vectors(
            self.targets[number].path,
            found.mean,
            vtkhdf.read_header(self.inputs[0]).reference,
            provenance=self.targets[number].record,
            overwrite=True,
            extra=extra,
        )

    def _record(self) -> dict[str, Any]:
        inputs = {f"vectors_{number:04d}": field for number, field in enumerate(self.inputs)}
        return record("correlate mean", self._resolved, inputs)


def are_measured(files: Sequence[Path]) -> bool:
    """Return whether files are vectors or tracks, by the first that can be read: no volumes."""
    for path in files:
        try:
            return format_of(path) in (vtkhdf.VECTORS_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT)
        except InputError:
            continue
    return False


def mean_of_measured(
    files: Sequence[Path], mean: Path, options: BatchOptions, derived: bool, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Write the mean of vectors and tracks that are there; return what is told of it.

    Raises
    ------
    InputError : they were not made alike
    """
    # Tracks whose vectors on a grid (`track --grid`) are among the files are left out.
    gridded = {path.parent / path.stem.rpartition("_grid")[0] for path in files}
    files = [path for path in files if path.with_suffix("") not in gridded or format_of(path) == vtkhdf.VECTORS_FORMAT]
    headers = [vtkhdf.read_header(path) for path in files]
    for header, path in zip(headers, files, strict=True):
        if header.reference != headers[0].reference:
            raise InputError(f"{path}: its coordinates have another origin than those of {files[0]}")
        command, first = header.provenance.get("command"), headers[0].provenance.get("command")
        if command != first:
            raise InputError(f"{path}: was made by {command}, but {files[0]} by {first}; a mean is of one kind")
    records = [header.provenance for header in headers]
    ensure_agreement(records, [str(path) for path in files], OF_COORDINATES)
    batch = Mean(mean, files, records[0].get("config") or {}, derived, overwrite)
    worked = work_through(batch, options, console)
    found = vtkhdf.open_vectors(mean)
    told = {"files": len(files), "skipped": worked.skipped, "vectors": found.flag.size}
    return told | {"rejected": int(np.count_nonzero(found.flag >= REJECTED))} | quality_of(found).summary()


def _fields_in(path: Path) -> Iterator[VectorField]:
    """Yield the vectors in a file, of tracks those on the grid of the interrogation windows, a field a frame."""
    if format_of(path) == vtkhdf.VECTORS_FORMAT:
        yield vtkhdf.open_vectors(path)
        return
    tracks = read_tracks(path)
    settings = carried_config(tracks.provenance, path)
    yield from TracksOf(tracks, TRACKS_FORMAT, paths_of(tracks), {}, settings).fields()
