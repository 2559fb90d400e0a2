"""Weights and what is prepared with them, kept from one step of a process to the next."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.memory import ensure_room
from lfpiv_cli.files.weights_file import WeightsFile, open_weights
from lfpiv_cli.files.whole import unpacked_bytes
from lfpiv_cli.interface.particles import searchable
from lfpiv_cli.interface.reconstruction import Bench, bench_of
from lfpiv_cli.reconstruction.images import Image


class Prepared:
    """Opens weights once, as long as their file stays as it is: of full size that takes as long as some frames."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self._opened = lru_cache(maxsize=1)(lambda path, _size, _modified_ns: open_weights_that_fit(path))
        self._searchable: tuple[WeightsFile, WeightsFile] | None = None
        self._bench: Bench | None = None

    def weights(self, path: Path) -> WeightsFile:
        """Return the weights of a file.

        Raises
        ------
        InputError : as `open_weights`
        """
        status = path.stat() if path.exists() else None
        return self._opened(path, status and status.st_size, status and status.st_mtime_ns)

    def searchable(self, path: Path, settings: Config) -> WeightsFile:
        """Return the weights of a file to look for particles with, see `interface.particles.searchable`."""
        content = self.weights(path)
        if self._searchable is None or self._searchable[0] is not content:
            self._searchable = content, searchable_weights(path, content, settings)
        return self._searchable[1]

    def bench(self, content: WeightsFile, settings: Config, dark: Image | None, mask: Image | None) -> Bench:
        """Return what all frames share, with the sums of the last one where these are the same."""
        self._bench = bench_of(content, settings, dark, mask, earlier=self._bench)
        return self._bench


def searchable_weights(path: Path, content: WeightsFile, settings: Config) -> WeightsFile:
    """Return the weights of a file to look for particles with.

    Raises
    ------
    InputError : they are none for that, see `interface.particles.searchable`
    """
    try:
        return searchable(content, settings)
    except ConfigError as error:
        raise InputError(f"{path}: {error}") from error


def open_weights_that_fit(path: Path) -> WeightsFile:
    """Open weights, where there is memory for them.

    Raises
    ------
    InputError : as `open_weights`
    OutputError : there is too little
    """
    ensure_room(unpacked_bytes(path), f"reading {path}")
    return open_weights(path)
