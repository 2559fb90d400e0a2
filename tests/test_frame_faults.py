"""Frames that are damaged, or made to do harm: formats without check sums, and what they can declare."""

from __future__ import annotations

import hashlib
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.images import count_pages, read_image
from lfpiv_cli.files.listing import ensure_verified
from lfpiv_cli.files.recordings import tiff
from lfpiv_cli.files.recordings.recording import taken_complaints
from tests import camera_files
from tests.hostile_files import ended

ROOT = Path(__file__).parent.parent
SAMPLE = ROOT / "sample_data"
CONFIG = ROOT / "configs" / "sample.yaml"


def directories(count: int, tags: tuple[int, ...] = (256, 257, 273)) -> bytes:
    """Return a TIFF of many directories of few tags."""
    size = 2 + 12 * len(tags) + 4
    parts = [b"II*\0", struct.pack("<I", 8)]
    for number in range(count):
        following = 8 + (number + 1) * size if number + 1 < count else 0
        entries = b"".join(struct.pack("<HHII", tag, 4, 1, 4) for tag in tags)
        parts.append(struct.pack("<H", len(tags)) + entries + struct.pack("<I", following))
    return b"".join(parts)


def test_directories_without_an_image_are_no_pages(tmp_path: Path) -> None:
    path = tmp_path / "many.tif"
    path.write_bytes(directories(100, (256,)))
    code, said = ended("check", CONFIG, path)
    assert code == 4
    assert "many.tif: the directory of page 0 is of no image" in said


def test_a_chain_without_an_end_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tiff, "MOST_PAGES", 50)
    path = tmp_path / "many.tif"
    path.write_bytes(directories(51))
    code, said = ended("check", CONFIG, path)
    assert code == 4
    assert "many.tif: it holds more than 50 pages" in said
    path.write_bytes(directories(50))
    assert count_pages(path) == 50


def test_counts_that_say_they_are_a_fax_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "fax.tif"
    tifffile.imwrite(path, np.ones((448, 600), np.uint8))
    content = path.read_bytes()
    plain = struct.pack("<HHIHH", 259, 3, 1, 1, 0)
    assert content.count(plain) == 1
    path.write_bytes(content.replace(plain, struct.pack("<HHIHH", 259, 3, 1, 4, 0)))
    code, said = ended("check", CONFIG, path)
    assert code == 4
    assert "for black and white alone" in said


def png(rows: int, columns: int, data: bytes, interlaced: int = 0) -> bytes:
    """Return a PNG of 8-bit grey with such packed lines."""

    def part(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    head = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, interlaced)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", head) + part(b"IDAT", zlib.compress(data)) + part(b"IEND", b"")


def test_a_png_that_unpacks_to_more_than_it_declares_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.png"
    path.write_bytes(png(448, 600, bytes(20_000_000)))
    code, said = ended("check", CONFIG, path)
    assert code == 4
    assert "more than the 600 x 448 pixels" in said
    path.write_bytes(png(5, 7, bytes(5 * 8)))
    assert not read_image(path).any()


def sums(folder: Path, *names: str) -> Path:
    """Write the list that sha256sum would."""
    lines = [f"{hashlib.sha256((folder / name).read_bytes()).hexdigest()}  {name}\n" for name in names]
    (folder / "SHA256SUMS").write_text("".join(lines))
    return folder / "SHA256SUMS"


@pytest.mark.thorough
@pytest.mark.parametrize("packed", ["lzw", "packbits", "zstd"])
def test_a_list_of_sums_tells_what_the_format_cannot(tmp_path: Path, packed: str) -> None:
    frame, config = tmp_path / "a.tif", tmp_path / "rig.yaml"
    config.write_bytes(CONFIG.read_bytes())
    tifffile.imwrite(frame, read_image(SAMPLE / "pair_a.tif").astype(np.uint16), compression=packed)
    listed = sums(tmp_path, "a.tif", "rig.yaml")
    assert ended("check", config, frame, "--verify", listed, "-q") == (0, "")
    content = bytearray(frame.read_bytes())
    content[len(content) // 2] ^= 1
    frame.write_bytes(content)
    code, said = ended("check", config, frame, "--verify", listed)
    assert code == 4
    assert f"{frame}: has the SHA-256" in said


def test_a_list_of_sums_has_all_inputs(tmp_path: Path) -> None:
    config, listed = tmp_path / "rig.yaml", tmp_path / "SHA256SUMS"
    config.write_bytes(CONFIG.read_bytes())
    listed.write_text("")
    code, said = ended("check", config, "--verify", listed)
    assert code == 4
    listed.write_text("# nothing\n")
    code, said = ended("check", config, "--verify", listed)
    assert code == 4
    assert f"{config}: is not in {listed}" in said
    listed.write_text("12ab  rig.yaml\n")
    assert "SHA256SUMS:1: is no line" in ended("check", config, "--verify", listed)[1]
    assert ended("check", config, "--verify", tmp_path / "none")[0] == 4
    (tmp_path / "other").write_text("mine")
    listed = sums(tmp_path, "other")
    code, said = ended("build-weights", config, "--dry-run", "-o", tmp_path / "w.h5", "--verify", listed)
    assert "rig.yaml: is not in" in said


def test_what_a_recording_is_read_with_is_verified_too(tmp_path: Path) -> None:
    camera_files.write_set(tmp_path / "run.set", [np.zeros((1, 5, 7), np.uint16)] * 2)
    listed = sums(tmp_path, "run.set", "run/B00001.im7", "run/B00002.im7")
    assert ensure_verified(listed, [tmp_path / "run.set"]) == 3
    camera_files.write_im7(tmp_path / "run" / "B00002.im7", np.ones((1, 5, 7), np.uint16))
    with pytest.raises(InputError, match=r"B00002\.im7: has the SHA-256"):
        ensure_verified(listed, [tmp_path / "run.set"])


def test_what_a_decoder_complains_of_is_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame = tmp_path / "a.tif"
    tifffile.imwrite(frame, read_image(SAMPLE / "pair_a.tif").astype(np.uint16), software="x" * 40)
    content = bytearray(frame.read_bytes())
    place = content.index(struct.pack("<HH", 305, 2))
    content[place + 2 : place + 4] = struct.pack("<H", 99)  # a kind of tag that there is not
    frame.write_bytes(content)
    taken_complaints()
    assert ended("check", CONFIG, frame) == (0, "")
    assert "a.tif: the decoder says: " in capsys.readouterr().err
