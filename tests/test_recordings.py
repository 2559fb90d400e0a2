"""Files of frames: each format read as it is laid out, refused by its name where it is cut or hostile."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import InputError
from lfpiv_cli.files import images
from lfpiv_cli.files.recordings import tiff


def test_a_sequence_is_looked_through_once_and_again_when_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = np.arange(5 * 12, dtype=np.uint8).reshape(5, 3, 4)
    path, walks = tmp_path / "t.tif", []
    monkeypatch.setattr(tiff, "directories", lambda *given, walk=tiff.directories: walks.append(1) or walk(*given))
    tifffile.imwrite(path, stack, photometric="minisblack", metadata=None)
    for page in (3, 0, 4):
        np.testing.assert_array_equal(images.read_page(path, page, (3, 4)), stack[page])
    assert images.count_pages(path) == 5
    assert len(walks) == 1
    for page in (-1, 5):
        with pytest.raises(InputError, match=f"has no page {page}, it holds 5"):
            images.read_page(path, page)
    before = path.stat()
    tifffile.imwrite(path, stack[::-1], photometric="minisblack", metadata=None)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    np.testing.assert_array_equal(images.read_page(path, 3), stack[1])
    assert len(walks) == 2


def test_a_header_tells_shape_and_bits(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "t.tif", np.zeros((2, 3, 4), np.uint16), photometric="minisblack", metadata=None)
    recording = images.frames(tmp_path / "t.tif")
    assert (recording.pages, recording.shape, recording.bits) == (2, (3, 4), 16)
    assert images.times_of(tmp_path / "t.tif") is None
