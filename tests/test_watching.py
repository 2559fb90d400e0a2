"""Folders that are being filled: files are taken when they are complete, in order."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.files import listing
from lfpiv_cli.files.listing import LOOK_S, SETTLED_S, as_they_come

WHOLE = b"a whole image"


class Camera:
    """A clock, and what is written to a folder as it goes on."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.now_s = folder, 0.0
        self.plan: list[tuple[float, str, bytes]] = []

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.write()

    def write(self) -> None:
        for written in [each for each in self.plan if each[0] <= self.now_s]:
            self.plan.remove(written)
            with open(self.folder / written[1], "ab") as file:
                file.write(written[2])

    def listed(self) -> list[Path]:
        return sorted(self.folder.iterdir())

    def groups(self, idle_s: float) -> Iterator[list[str]]:
        self.write()
        for group in as_they_come(self.listed, read, idle_s):
            yield [path.name for path in group]


def read(path: Path) -> None:
    if path.read_bytes() != WHOLE:
        raise InputError(f"{path}: is cut")


@pytest.fixture
def camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Camera:
    camera = Camera(tmp_path)
    monkeypatch.setattr(listing, "time", camera)
    return camera


def test_what_is_there_is_taken_at_once_and_the_rest_as_it_comes(camera: Camera) -> None:
    camera.plan = [(0.0, "1", WHOLE), (0.0, "2", WHOLE), (6.0, "3", WHOLE)]
    assert list(camera.groups(10.0)) == [["1", "2"], ["3"]]
    # the third file's time and the idle time, seen at the next look
    assert 16.0 <= camera.now_s <= 16.0 + 2 * LOOK_S


def test_a_file_that_is_being_written_is_waited_for_and_so_are_those_behind_it(camera: Camera) -> None:
    camera.plan = [(0.0, "1", WHOLE[:5]), (0.0, "2", WHOLE), (4.0, "1", WHOLE[5:8]), (8.0, "1", WHOLE[8:])]
    assert list(camera.groups(5.0)) == [["1", "2"]]
    assert camera.now_s >= 8.0 + SETTLED_S


def test_a_file_is_not_taken_while_it_grows_though_it_can_be_read(camera: Camera, monkeypatch) -> None:
    camera.plan = [(0.5 * step, "run", b"page") for step in range(12)]
    sizes = [path.stat().st_size for (path,) in as_they_come(camera.listed, len_of, 5.0)]
    assert sizes == [4 * 12]


def len_of(path: Path) -> int:
    return path.stat().st_size


def test_what_never_becomes_complete_comes_last(camera: Camera) -> None:
    camera.plan = [(0.0, "1", WHOLE), (0.0, "2", b""), (0.0, "3", WHOLE)]
    assert list(camera.groups(5.0)) == [["1"], ["2", "3"]]


def test_a_file_that_goes_away_is_forgotten(camera: Camera) -> None:
    camera.plan = [(0.0, "1", b"half"), (0.0, "2", WHOLE)]
    groups = as_they_come(camera.listed, read, 5.0)
    camera.write()
    camera.sleep = lambda seconds: leave_out(camera, seconds)  # type: ignore[method-assign]
    assert [[path.name for path in group] for group in groups] == [["2"]]


def leave_out(camera: Camera, seconds: float) -> None:
    camera.now_s += seconds
    if camera.now_s >= 3.0:
        (camera.folder / "1").unlink(missing_ok=True)


def test_an_empty_folder_ends_after_the_idle_time(camera: Camera) -> None:
    assert not list(camera.groups(3.0))
    assert 3.0 <= camera.now_s <= 3.0 + LOOK_S
