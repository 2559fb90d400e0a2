"""Batches: which frames a command was given, where each result goes, and which of them are there already."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv_cli.errors import InputError, OutputExistsError, UsageError
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.hdf5 import replace_provenance
from lfpiv_cli.files.images import count_pages
from lfpiv_cli.files.provenance import bear_alike, carried_record, without_warnings
from lfpiv_cli.names import Pairing

VTKHDF_SUFFIX = ".vtkhdf"


@dataclass(frozen=True)
class Frame:
    """One image of a batch: page `page` of the `pages` of a file."""

    path: Path
    page: int
    pages: int

    @property
    def stem(self) -> str:
        """The file's stem, numbered where the file holds a sequence."""
        return self.path.stem if self.pages == 1 else f"{self.path.stem}_{self.page:04d}"


@dataclass(frozen=True)
class Target:
    """One output of a batch: where it goes and the provenance record it will carry."""

    path: Path
    record: Mapping[str, Any]


def frames_of(paths: Iterable[Path]) -> list[Frame]:
    """Return the frames of image files in order, every page of a sequence."""
    frames = []
    for path in paths:
        pages = count_pages(path)
        frames += [Frame(path, page, pages) for page in range(pages)]
    return frames


def output_paths(output: Path, stems: Sequence[str]) -> list[Path]:
    """Return where the results go: `output` itself for one result, a folder of `stem.vtkhdf` for several.

    An existing folder takes a single result too.

    Raises
    ------
    UsageError : two inputs would give the same output, or several results meet an output that is a file.
    """
    if len(stems) == 1 and not output.is_dir():
        if output.suffix != VTKHDF_SUFFIX:
            raise UsageError(f"{output}: a single result is one file, whose name ends in {VTKHDF_SUFFIX}")
        return [output]
    if len(stems) > 1 and output.exists() and not output.is_dir():
        raise UsageError(f"{output}: {len(stems)} results need a folder, and this is a file")
    twice = sorted({stem for stem in stems if stems.count(stem) > 1}) if len(set(stems)) < len(stems) else []
    if twice:
        raise UsageError(f"{output}: two inputs are called {twice[0]!r} and would give the same output")
    return [output / f"{stem}{VTKHDF_SUFFIX}" for stem in stems]


def prepare_folder(paths: Sequence[Path]) -> None:
    """Make the folder of a batch where only its last part is missing."""
    folder = paths[0].parent
    if not folder.exists() and folder.parent.is_dir():
        ensure_writable(folder, overwrite=False)
        folder.mkdir(exist_ok=True)


def pending(
    targets: Sequence[Target],
    inputs: Iterable[Path],
    overwrite: bool,
    resume: bool,
    read_record: Callable[[Path], Mapping[str, Any]],
) -> list[int]:
    """Return the numbers of the targets that have to be made.

    With `resume`, a target that is complete and carries the very record that it would get is left as it is; with
    `overwrite` besides, one whose record differs in nothing that it depends on gets the new record, and keeps its data.

    Raises
    ------
    OutputExistsError : a target is there and neither `overwrite` nor a matching `resume` covers it.
    """
    inputs = list(inputs)
    needed = []
    for number, target in enumerate(targets):
        if resume and target.path.exists() and _made_alike(target, read_record):
            continue
        if resume and overwrite and target.path.exists() and _recorded_anew(target, read_record):
            continue
        if resume and target.path.exists() and not overwrite:
            raise OutputExistsError(
                f"{target.path}: exists and was made from other inputs or settings; --overwrite makes it anew"
            )
        ensure_writable(target.path, overwrite, inputs)
        needed.append(number)
    return needed


def is_kept(
    paths: Sequence[Path], made: Mapping[str, Any], inputs: Iterable[Path], overwrite: bool, resume: bool
) -> bool:
    """Return whether all results of a step, which carry one record, are there already, see `pending`.

    Raises
    ------
    OutputExistsError : as `pending`
    """
    return not pending([Target(path, made) for path in paths], inputs, overwrite, resume, carried_record)


def _recorded_anew(target: Target, read_record: Callable[[Path], Mapping[str, Any]]) -> bool:
    """Give a target its new record, if the old one differs in nothing that it depends on; return whether it does."""
    try:
        old = read_record(target.path)
    except InputError:
        return False
    if not bear_alike(old, target.record):
        return False
    warnings = {name: old[name] for name in ("warnings",) if name in old}
    replace_provenance(target.path, dict(target.record) | warnings)
    return True


def _made_alike(target: Target, read_record: Callable[[Path], Mapping[str, Any]]) -> bool:
    try:
        return without_warnings(read_record(target.path)) == target.record
    except InputError:
        return False


def frames_beside(count: int, pairing: Pairing) -> list[tuple[int, ...]]:
    """Return for each frame the numbers of those it belongs with: its partner (`ab`), or the one before and after.

    Raises
    ------
    UsageError : there is only one frame, or one of the last pair is missing.
    """
    if count < 2 or (pairing == "ab" and count % 2):
        raise UsageError(
            f"--pairing {pairing}: needs {'pairs' if pairing == 'ab' else 'two or more'}, got {count} frames"
        )
    if pairing == "ab":
        return [(number ^ 1,) for number in range(count)]
    return [tuple(k for k in (number - 1, number + 1) if 0 <= k < count) for number in range(count)]
