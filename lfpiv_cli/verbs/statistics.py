"""`statistics`: moments of a flow over the vectors, or the tracks, of many pairs; the means of a batch by the same."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.console import CONSOLE, Console, Frames
from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import atomic, config, hdf5, inputs, vtkhdf
from lfpiv_cli.files.batch import Target, is_kept, natural
from lfpiv_cli.files.particle_file import TRACKS_FORMAT, TRAJECTORIES_FORMAT, open_tracks
from lfpiv_cli.files.provenance import OF_COORDINATES, ensure_agreement, record, with_warnings
from lfpiv_cli.flow.combining import Paths, vectors_from_paths
from lfpiv_cli.flow.field import REJECTED, VectorField, derived_fields
from lfpiv_cli.verbs.batches import Batch, Worked
from lfpiv_cli.verbs.checks import quality_of
from lfpiv_cli.verbs.fields import arrays_of, samples_of_tracks
from lfpiv_cli.verbs.moments import notices_of, of_fields, of_tracks, parse_profile
from lfpiv_cli.verbs.results import Vectors
from lfpiv_cli.verbs.tracks import windows_of

MEASURED = (vtkhdf.VECTORS_FORMAT, TRACKS_FORMAT, TRAJECTORIES_FORMAT)
# What is held of files in memory, over the arrays in them.
HELD_OVER_FILES = 4.0


class Mean(Batch[None]):
    """The mean of a batch's vectors, with their fluctuations."""

    label, unit = "mean", "file"

    def __init__(
        self, path: Path, fields: Sequence[Path], resolved: Mapping[str, Any] | None, derived: bool, overwrite: bool
    ) -> None:
        """Take where it goes, the files of vectors, and their settings; without these, they are asked to be alike."""
        if resolved is None:
            fields, records = _alike(fields, in_bins=False)
            resolved = records[0].get("config") or {}
        self.inputs, self._derived, self.overwrite = fields, derived, overwrite
        self.targets = [Target(path, partial(record, "correlate mean", resolved, _named(fields)))]

    def begin(self, numbers: Sequence[int], _console: Console) -> float:
        """Refuse what is too large for the memory."""
        if numbers:
            _ensure_room(self.inputs)
        return 1.0

    def make(self, number: int, _work: Frames) -> None:
        """Write it."""
        found, target = of_fields(field for path in self.inputs for field in _fields_in(path)), self.targets[number]
        extra = arrays_of(derived_fields(found.mean)) if self._derived else {}
        mean = replace(found.mean, provenance=dict(target.record))
        Vectors(mean, found.arrays() | extra, found.tables(), found.attributes()).write(target.path, overwrite=True)

    def summary(self, worked: Worked[None]) -> dict[str, Any]:
        """Return what is told of it."""
        found = vtkhdf.open_vectors(self.targets[0].path)
        reported = {"files": len(self.inputs), "skipped": worked.skipped, "vectors": found.flag.size}
        return reported | {"rejected": int(np.count_nonzero(found.flag >= REJECTED))} | quality_of(found).summary()


def _ensure_room(files: Sequence[Path]) -> None:
    """Refuse files whose samples do not fit into the memory together (OutputError)."""
    inputs.ensure_room(HELD_OVER_FILES * sum(map(hdf5.unpacked_bytes, files)), "statistics", "fewer files need less")


def _named(files: Sequence[Path]) -> dict[str, Path]:
    return {f"vectors_{number:04d}": path for number, path in enumerate(files)}


def are_measured(files: Sequence[Path]) -> bool:
    """Return whether files are vectors or tracks, by the first that can be read: no volumes."""
    for path in files:
        try:
            return hdf5.format_of(path) in MEASURED
        except InputError:
            continue
    return False


def _alike(files: Sequence[Path], in_bins: bool) -> tuple[list[Path], list[dict[str, Any]]]:
    """Return files in the natural order of their names, and their records; of tracks and their vectors, one of the two.

    Raises
    ------
    InputError : they were not made alike, or are no vectors and no tracks
    """
    formats = {path: hdf5.format_of(path) for path in sorted(files, key=lambda path: natural(str(path)))}
    for path, name in formats.items():
        if name not in MEASURED:
            raise InputError(f"{path}: holds {name}, expected vectors or tracks")
    grids = {path: path.parent / path.stem.rpartition("_grid")[0] for path in formats}
    tracks = {path.with_suffix("") for path, name in formats.items() if name != vtkhdf.VECTORS_FORMAT}
    if in_bins:
        kept = [path for path in formats if grids[path] not in tracks]
    else:
        kept = [path for path in formats if path.with_suffix("") not in tracks & set(grids.values())]
    headers = [vtkhdf.read_header(path) for path in kept]
    for header, path in zip(headers, kept, strict=True):
        if header.reference != headers[0].reference:
            raise InputError(f"{path}: its coordinates have another origin than those of {kept[0]}")
        command, first = header.provenance.get("command"), headers[0].provenance.get("command")
        if command != first:
            raise InputError(f"{path}: was made by {command}, but {kept[0]} by {first}; a mean is of one kind")
    records = [header.provenance for header in headers]
    ensure_agreement(records, [str(path) for path in kept], OF_COORDINATES)
    return kept, records


def _fields_in(path: Path) -> Iterator[VectorField]:
    """Yield the vectors in a file, of tracks those on the grid of the interrogation windows, a field a frame."""
    if hdf5.format_of(path) == vtkhdf.VECTORS_FORMAT:
        yield vtkhdf.open_vectors(path)
        return
    tracks = open_tracks(path)
    settings = config.carried_config(tracks.provenance, path)
    windows = windows_of(settings, settings.masking_walls())
    frames: Iterable[int | None] = [None]
    if "frame" in tracks.arrays:
        frames = range(int(tracks.arrays["frame"].max(initial=-1)) + 1)
    for each in [samples_of_tracks(tracks, frame) for frame in frames]:
        sigma_mm = np.sqrt(np.diagonal(each.covariance_mm2, axis1=1, axis2=2))
        paths = Paths(each.points_mm, each.value_mm, sigma_mm)
        yield replace(vectors_from_paths(paths, windows, settings.correlation.dt_s), reference=tracks.reference)


@dataclass(frozen=True, kw_only=True)
class StatisticsOptions:
    """What `statistics` is given besides its files.

    Attributes
    ----------
    bin_mm : sides of the bins of tracks along x, y, z; those of the interrogation windows where None
    fewest : bins with fewer tracks have no statistics
    profile : where one is taken, see `parse_profile`
    resume : keep what was made from the same files with the same settings
    """

    bin_mm: tuple[float, float, float] | None = None
    fewest: int = 20
    profile: str = "z"
    resume: bool = False


def statistics_of_files(
    files: Sequence[Path],
    output: Path,
    options: StatisticsOptions = StatisticsOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Write the statistics of files of vectors, or of tracks in bins.

    Raises
    ------
    InputError : they are not of one kind, or were not made alike
    """
    atomic.ensure_writable(output, overwrite or options.resume, files)
    parse_profile(options.profile)
    files, records = _alike(files, in_bins=options.bin_mm is not None)
    by_fields = hdf5.format_of(files[0]) == vtkhdf.VECTORS_FORMAT
    if by_fields and options.bin_mm is not None:
        raise UsageError(f"--bin-mm: bins are of tracks, and {files[0]} has vectors on a grid")
    chosen: dict[str, Any] = {"profile": options.profile}
    if not by_fields:
        chosen |= {"bin_mm": options.bin_mm, "fewest": options.fewest}
    made = record("statistics", (records[0].get("config") or {}) | {"statistics": chosen}, _named(files))
    kept = options.resume and is_kept([output], made, files, overwrite)
    summary: dict[str, Any] = {"files": len(files)}
    if not kept:
        _ensure_room(files)
        if by_fields:
            found = of_fields(map(vtkhdf.open_vectors, files), options.profile)
        else:
            found = of_tracks(map(open_tracks, files), options.bin_mm, options.fewest, options.profile)
        if found.mean.dt_s is None:
            raise InputError(f"{files[0]}: does not tell the time between frames; make it with --dt-s")
        summary |= found.summary()
        notices = notices_of(summary, output.name)
        console.warn(notices)
        made = with_warnings(made, notices)
        Vectors.of(replace(found, mean=replace(found.mean, provenance=made))).write(output, overwrite or options.resume)
    return summary | {"skipped": int(kept)}
