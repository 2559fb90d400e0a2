"""Files of frames: each format read as it is laid out, refused by its name where it is cut or hostile."""

import hashlib
import itertools
import os
import re
import shutil
import struct
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile

from lfpiv_cli.errors import InputError, UsageError
from lfpiv_cli.files import images
from lfpiv_cli.files.inputs import split_part
from lfpiv_cli.files.provenance import record, sha256
from lfpiv_cli.files.recording import Packing, Pixels, green_of
from tests import camera_files


def test_a_sequence_is_looked_through_and_again_when_it_changes(tmp_path: Path) -> None:
    stack, path = np.arange(5 * 12, dtype=np.uint8).reshape(5, 3, 4), tmp_path / "t.tif"
    tifffile.imwrite(path, stack, photometric="minisblack", metadata=None)
    for page in (3, 0, 4):
        np.testing.assert_array_equal(images.read_image(path, page, (3, 4)), stack[page])
    with pytest.raises(InputError, match="has no page -1, it holds 5"):
        images.read_image(path, -1)
    before = path.stat()
    tifffile.imwrite(path, stack[::-1], photometric="minisblack", metadata=None)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    np.testing.assert_array_equal(images.read_image(path, 3), stack[1])


def stack_of(rng: np.random.Generator, bits: int, shape: tuple[int, int, int] = (3, 5, 7)) -> np.ndarray:
    return rng.integers(0, 2**bits, shape, dtype=np.uint8 if bits == 8 else np.uint16)


def read_all(path: Path) -> None:
    for page in range(images.count_pages(path)):
        images.read_image(path, page)


KINDS: dict[str, tuple[int, Callable[..., object], str]] = {
    "c16.cine": (16, partial(camera_files.write_cine, notes=b"range data"), ""),
    "c8.cine": (8, partial(camera_files.write_cine, version=0), ""),
    "c12.cine": (12, partial(camera_files.write_cine, packed=12), ""),
    "s16.seq": (16, camera_files.write_seq, ""),
    "s8.seq": (8, partial(camera_files.write_seq, version=3), ""),
    "m16.mraw": (16, partial(camera_files.write_mraw, bits=16), ""),
    "m8.mraw": (8, partial(camera_files.write_mraw, bits=8, xml=False), ""),
    "m12.mraw": (12, partial(camera_files.write_mraw, bits=12), ""),
    "m10.mraw": (10, partial(camera_files.write_mraw, bits=10, xml=False), ""),
    "h.h5": (16, camera_files.write_stack, ""),
    "h.h5 named": (16, camera_files.write_stack, ":/entry/data/frames"),
    "r.raw": (
        12,
        lambda path, stack: path.write_bytes(b"".join(camera_files.bits_low_first(frame, 12) for frame in stack)),
        ":7x5x12:packing=low-first:rate=2000",
    ),
}


def written(kind: str, folder: Path, rng: np.random.Generator) -> tuple[Path, np.ndarray]:
    """Write a recording of a kind; return where, and what is in it."""
    bits, write, part = KINDS[kind]
    path, stack = folder / kind.split()[0], stack_of(rng, bits)
    write(path, stack)
    return Path(f"{path}{part}"), stack


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_each_format_gives_its_counts_times_and_pages(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    path, stack = written(kind, tmp_path, rng)
    found = images.frames(path)
    assert (found.pages, found.shape) == (3, (5, 7))
    for page in range(3):
        image = images.read_image(path, page, (5, 7))
        assert image.dtype == np.float32
        np.testing.assert_array_equal(image, stack[page])
    # Norpix' older versions have milliseconds.
    times_s = [0.0, 0.0 if kind == "s8.seq" else 0.0005, 0.001]
    np.testing.assert_allclose(images.frames(path).time_s, times_s, rtol=0, atol=1e-9)
    with pytest.raises(InputError, match=r"7 x 5 pixels.*, expected the sensor's 8 x 5"):
        images.read_image(path, 0, (5, 8))
    with pytest.raises(InputError, match="holds 3 pages, expected a single image; .*:page=0 is the first one"):
        images.read_single(path)
    one = Path(f"{path}:page=2")
    np.testing.assert_array_equal(images.read_single(one, (5, 7)), stack[2])
    np.testing.assert_array_equal(images.frames(one).time_s, images.frames(path).time_s[2:])
    with pytest.raises(InputError, match="has no page 3, it holds 3"):
        images.read_single(Path(f"{path}:page=3"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_recording_cut_anywhere_is_refused_by_its_name(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    given, _ = written(kind, tmp_path, rng)
    path, _ = split_part(given)
    content = path.read_bytes()
    # A sequence's frames are padded, and what is cut off the last one's padding is not missed; frames without a header
    # are whole where the file ends with one.
    padding = 469 if kind == "s8.seq" else 434 if kind == "s16.seq" else 0
    end = len(content) - padding
    for kept in {*range(1, end, max(end // 40, 1)), end - 1}:
        if kind == "r.raw" and kept % 53 == 0:
            continue
        path.write_bytes(content[:kept])
        # Before the first frame is read, so that nothing is made of a part.
        with pytest.raises(InputError, match=path.name):
            images.frames(given)


PACKERS: dict[Packing, Callable[[np.ndarray, int], bytes]] = {
    "high-first": camera_files.bits_high_first,
    "low-first": camera_files.bits_low_first,
    # Two pixels in three bytes.
    "gige": camera_files.gige,
}


@pytest.mark.parametrize("bits", [10, 12])
@pytest.mark.parametrize("packing", PACKERS)
@pytest.mark.parametrize("columns", [1, 4, 7, 8])
def test_packed_pixels_are_their_bits(rng: np.random.Generator, bits: int, packing: Packing, columns: int) -> None:
    (image,), pixels = stack_of(rng, bits, (1, 3, columns)), Pixels((3, columns), bits, packing)
    data = PACKERS[packing](image, bits)
    assert pixels.frame_bytes == len(data)
    np.testing.assert_array_equal(pixels.decode(data), image)


def test_a_cine_packed_to_ten_bits_has_linear_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    codes = np.arange(1024, dtype=np.uint16).reshape(1, 32, 32)
    camera_files.write_cine(tmp_path / "t.cine", codes, packed=10)
    assert images.frames(tmp_path / "t.cine").bits == 12
    counts = images.read_image(tmp_path / "t.cine", 0).ravel()
    # The manufacturer's anchors: black stays, white is at 4064 of 4095; and more light is never darker.
    assert (counts[64], counts[1014], counts[1023]) == (64, 4064, 4095)
    assert (np.diff(counts) >= 0).all()
    images.read_image.__globals__["_frames"].cache_clear()
    monkeypatch.setitem(sys.modules, "cine_reader.unpack", None)
    with pytest.raises(UsageError, match=re.escape('t.cine: is packed to 10 bits: pip install "lfpiv[cameras]"')):
        images.frames(tmp_path / "t.cine")


def test_images_and_sets_of_davis(tmp_path: Path, rng: np.random.Generator) -> None:
    lvpyio = pytest.importorskip("lvpyio")
    path = tmp_path / "B00001.im7"
    for packed, kind in itertools.product((True, False), (np.uint16, np.float32)):
        stack = stack_of(rng, 12, (2, 30, 40)).astype(kind)
        lvpyio.write_buffer(lvpyio.arrays_to_buffer(list(stack)), str(path), compress=packed)
        found = images.frames(path)
        assert (found.pages, found.shape, found.bits, found.time_s) == (2, (30, 40), 8 * stack.itemsize, None)
        for page in range(2):
            np.testing.assert_array_equal(images.read_image(path, page, (30, 40)), stack[page])
        content = path.read_bytes()
        # After the counts the file has attributes.
        end = 260 + struct.unpack_from("<I", content, 256)[0] if packed else 256 + stack.nbytes
        for kept in (*range(1, end, end // 20), end - 1):
            path.write_bytes(content[:kept])
            with pytest.raises(InputError, match="B00001.im7"):
                images.frames(path)
        if packed:
            edited(path, end // 2, "B", content[end // 2] ^ 1, content)
            with pytest.raises(InputError, match=r"B00001\.im7: (cannot be unpacked|does not unpack)"):
                images.read_image(path, 0)
    stacks = [stack_of(rng, 12, (2, 30, 40)) for _ in range(3)]
    lvpyio.write_set([lvpyio.arrays_to_buffer(list(stack)) for stack in stacks], str(tmp_path / "run.set"))
    for page, expected in enumerate(np.concatenate(stacks)):
        np.testing.assert_array_equal(images.read_image(tmp_path / "run.set", page), expected)


def test_packed_images_of_davis_end_with_their_check_sum(tmp_path: Path, rng: np.random.Generator) -> None:
    path, stack = tmp_path / "t.im7", stack_of(rng, 16)
    camera_files.write_im7(path, stack)
    np.testing.assert_array_equal(images.read_image(path, 1), stack[1])
    (length,) = struct.unpack_from("<I", path.read_bytes(), 256)
    edited(path, 256, "<I", length - 2)
    with pytest.raises(InputError, match="does not unpack to 3 frames"):
        images.read_image(path, 1)
    # As if they were not packed, and more than the file holds.
    edited(path, 2, "<h", 0)
    edited(path, 20, "<i", 9)
    with pytest.raises(InputError, match=r"end at byte 886 of \d+"):
        images.read_image(path, 1)
    path, _ = written("c8.cine", tmp_path, rng)
    with pytest.raises(UsageError, match="have no parts or layouts"):
        images.frames(path.with_name("c8.cine:7x5x8"))
    (tmp_path / "t.dat").write_bytes(b"?")
    with pytest.raises(InputError, match="neither a TIFF nor a PNG image, nor a recording of HDF5, Phantom cine"):
        images.frames(tmp_path / "t.dat:/entry")


def test_a_set_of_davis_is_the_frames_of_its_images_one_after_the_other(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    path = tmp_path / "run.set"
    # Ten images, so that by letters B10 would come before B2; the second has a frame more.
    stacks = [stack_of(rng, 12, (1 + (k == 1), 5, 7)) for k in range(10)]
    camera_files.write_set(path, stacks)
    for number in range(10):
        (tmp_path / "run" / f"B{number + 1:05d}.im7").rename(tmp_path / "run" / f"b{number + 1}.IM7")
    found = images.frames(path)
    assert (found.pages, found.shape, found.bits, found.time_s) == (11, (5, 7), 16, None)
    for page, expected in enumerate(np.concatenate(stacks)):
        np.testing.assert_array_equal(images.read_image(path, page, (5, 7)), expected)
    np.testing.assert_array_equal(images.read_single(Path(f"{path}:page=2")), stacks[1][1])
    camera_files.write_im7(tmp_path / "run" / "b11.im7", stacks[0])
    assert images.count_pages(path) == 12
    camera_files.write_im7(tmp_path / "run" / "b2.IM7", stacks[0])
    with pytest.raises(InputError, match=r"b2\.IM7: holds 1 frames, fewer than"):
        images.read_image(path, 2)


SETS: dict[str, tuple[Callable[[Path], object], str]] = {
    "no folder": (lambda folder: folder.rename(folder.with_name("other")), "folder of its images, run, is not beside"),
    "gap": (lambda folder: (folder / "B00002.im7").unlink(), r"B00003\.im7 is not the next image after B00001\.im7"),
    "first": (lambda folder: (folder / "B00001.im7").unlink(), r"first image is B00002\.im7, and those before"),
    "twice": (lambda folder: (folder / "B2.im7").write_bytes(b"x"), r"im7 has the same number as B.*2\.im7"),
    "empty": (lambda folder: [file.unlink() for file in folder.iterdir()], r"no images B00001\.im7, .*: save it from"),
    "vectors": (
        lambda folder: [file.rename(file.with_suffix(".vc7")) for file in folder.iterdir()],
        r"but \.vc7 files: save it from DaVis as a set of \.im7 images, or as TIFF",
    ),
    "sets": (
        lambda folder: shutil.copytree(folder, folder / "S00001") and [f.unlink() for f in folder.glob("*.*")],
        "holds several sets: give one of these folders, as .*S00001",
    ),
    "archive": (lambda folder: folder.with_suffix(".set").write_bytes(b"PK\3\4\0\0"), "is no text .*or as TIFF"),
    "size": (
        lambda folder: camera_files.write_im7(folder / "B00002.im7", np.zeros((1, 5, 8), np.uint16)),
        r"B00002\.im7: has .*\(5, 8\), the first image of its set \(5, 7\)",
    ),
    "cut": (lambda folder: os.truncate(folder / "B00003.im7", os.path.getsize(folder / "B00003.im7") - 20), "cut off"),
}


@pytest.mark.parametrize("fault", SETS)
def test_sets_that_are_not_whole_are_refused(tmp_path: Path, fault: str) -> None:
    spoil, words = SETS[fault]
    camera_files.write_set(tmp_path / "run.set", [np.zeros((1, 5, 7), np.uint16)] * 3)
    spoil(tmp_path / "run")
    with pytest.raises(InputError, match=words):
        images.frames(tmp_path / "run.set")


def test_the_record_of_a_set_changes_with_each_of_its_images(tmp_path: Path) -> None:
    path = tmp_path / "run.set"
    camera_files.write_set(path, [np.zeros((1, 5, 7), np.uint16)] * 2)

    def beside() -> dict[str, str]:
        return record("reconstruct", None, {"image": path})["inputs"]["image"]["beside"]

    (tmp_path / "run" / ".hidden").write_text("not of the set")
    lines = [f"{sha256(tmp_path / 'run' / name)}  {name}\n" for name in ("B00001.im7", "B00002.im7")]
    first = beside()
    assert first == {"run": hashlib.sha256("".join(lines).encode()).hexdigest()}
    camera_files.write_im7(tmp_path / "run" / "B00002.im7", np.ones((1, 5, 7), np.uint16))
    assert beside() != first


def edited(path: Path, place: int, layout: str, value: int, content: bytes | None = None) -> None:
    """Put a number into a file, or into what was in it."""
    changed = bytearray(path.read_bytes() if content is None else content)
    struct.pack_into(layout, changed, place, value)
    path.write_bytes(changed)


# Where a header has a number, as in `camera_files`, what a hostile one says, and how it is refused.
HOSTILE = {
    "cine, frames": ("c16.cine", 20, "<I", 2**31, "ends at byte"),
    "cine, no frames": ("c16.cine", 20, "<I", 0, "no frames"),
    "cine, place of the bitmap": ("c16.cine", 24, "<I", 2**32 - 1, "ends at byte"),
    "cine, place of the setup": ("c16.cine", 28, "<I", 2**32 - 1, "ends at byte"),
    "cine, place of the places": ("c16.cine", 32, "<I", 2**32 - 1, "ends at byte"),
    "cine, width": ("c16.cine", 48, "<i", 2**31 - 1, "bytes a frame"),
    "cine, negative width": ("c16.cine", 48, "<i", -7, "-7 x 5"),
    "cine, no setup": ("c16.cine", 84 + 140, "<H", 0, "no SETUP"),
    "cine, compression": ("c16.cine", 4, "<H", 1, "raw cine"),
    "cine, bits": ("c16.cine", 58, "<H", 24, "24 bits a pixel"),
    "seq, width": ("s16.seq", 548, "<I", 400_000, "expected 4000000 for 400000 x 5"),
    "seq, frames": ("s16.seq", 572, "<I", 2**32 - 1, "of which the last ends"),
    "seq, no frames": ("s16.seq", 572, "<I", 0, "no frames"),
    "seq, bits": ("s16.seq", 556, "<I", 12, "expected them in 8 or 16"),
    "seq, step": ("s16.seq", 580, "<I", 8, "every 8 bytes"),
    "seq, compressed": ("s16.seq", 620, "<I", 1, "compressed"),
    "seq, colour": ("s16.seq", 568, "<I", 101, "bayer=RGGB"),
    "davis, vectors": ("d16.im7", 4, "<h", 3, "expected images: save it from DaVis"),
    "davis, planes": ("d16.im7", 16, "<i", 2, "2 planes"),
    "davis, packing": ("d16.im7", 2, "<h", 1, "packed in a way of its own"),
    "davis, negative width": ("d16.im7", 8, "<i", -7, "-7 x 5"),
    "davis, huge": ("d16.im7", 20, "<i", 2**30, "expected at most"),
    "davis, more frames": ("d16.im7", 20, "<i", 4, "does not unpack to 4 frames"),
    "davis, fewer frames": ("d16.im7", 20, "<i", 1, "does not unpack to 1 frames"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_hostile_headers_are_refused_quickly(tmp_path: Path, rng: np.random.Generator, what: str) -> None:
    name, place, layout, value, words = HOSTILE[what]
    path = tmp_path / name
    (KINDS | {"d16.im7": (16, camera_files.write_im7, "")})[name][1](path, stack_of(rng, 16))
    edited(path, place, layout, value)
    began = time.monotonic()
    with pytest.raises(InputError, match=rf"{name}.*{words}"):
        read_all(path)
    assert time.monotonic() - began < 1.0


def test_ways_of_writing_a_cine_and_what_must_lie_in_it(tmp_path: Path, rng: np.random.Generator) -> None:
    path, stack = tmp_path / "t.cine", stack_of(rng, 8, (2, 4, 5))
    camera_files.write_cine(path, stack, times=False, tight=True)
    np.testing.assert_array_equal(images.read_image(path, 1), stack[1])
    np.testing.assert_allclose(images.frames(path).time_s, [0.0, 1 / camera_files.RATE_HZ])
    edited(path, 52, "<i", -4)
    np.testing.assert_array_equal(images.read_image(path, 1), stack[1, ::-1])
    camera_files.write_cine(path, stack, filters=3)
    with pytest.raises(InputError, match="frames of a colour sensor.*bayer=RGGB"):
        images.frames(path)
    path, stack = tmp_path / "t.cine", stack_of(rng, 16, (2, 4, 6))
    camera_files.write_cine(path, stack)
    content = path.read_bytes()
    (places_at,) = struct.unpack_from("<I", content, 32)
    first, second = struct.unpack_from("<2q", content, places_at)
    for wrong in (-1, 2**40):
        edited(path, places_at, "<q", wrong, content)
        with pytest.raises(InputError, match=r"t\.cine: declares 2 frames"):
            images.frames(path)
    for place, value, words in (
        (0, 0, "notes of the frame"),
        (0, 2**31, "ends at byte"),
        (4, 3, "declares 3 bytes, expected 48"),
    ):
        # Of the last frame before any is read, of others in their turn.
        edited(path, second + place, "<I", value, content)
        with pytest.raises(InputError, match=words):
            images.frames(path)
        edited(path, first + place, "<I", value, content)
        np.testing.assert_array_equal(images.read_image(path, 1), stack[1])
        with pytest.raises(InputError, match=words):
            images.read_image(path, 0)


CIH = "Total Frame : 1\nImage Width : 7\nImage Height : 5\nColor Type : Mono\nColor Bit : 8\n"


@pytest.mark.parametrize(
    ("header", "words"),
    [
        (CIH.replace("7", "-7"), "Image Width is -7"),
        (CIH.replace("7", "7e3"), "Image Width is 7e3"),
        (CIH.replace("Bit : 8", "Bit : 9"), "Color Bit is 9"),
        (CIH.replace("Total Frame : 1", "Total Frame : 99999999"), "of which the last ends"),
        (CIH.replace("Mono", "Bayer"), "bayer=RGGB"),
        (CIH.replace("Image Height : 5\n", ""), "Image Height is None"),
        ("", "is empty"),
        ("\0" * (2**20 + 1), "no header"),
    ],
)
def test_headers_of_photron_that_do_not_fit(tmp_path: Path, header: str, words: str) -> None:
    path = tmp_path / "t.mraw"
    path.write_bytes(bytes(35))
    with pytest.raises(InputError, match=r"t\.cihx or \.cih is not beside it"):
        images.frames(path)
    (tmp_path / "t.cih").write_text(header)
    with pytest.raises(InputError, match=words):
        images.frames(path)


def test_a_header_is_looked_through_once_and_again_when_it_changes(tmp_path: Path) -> None:
    path = tmp_path / "t.mraw"
    path.write_bytes(bytes(35))
    path.with_suffix(".cih").write_text(CIH)
    assert images.frames(path).shape == (5, 7)
    path.with_suffix(".cih").write_text(CIH.replace("Width : 7", "Width : 5") + "\n")
    assert images.frames(path).shape == (5, 5)
    (tmp_path / "t.mraw").write_bytes(bytes(70))
    (tmp_path / "t.cih").write_text(CIH.replace("e : 1", "e : 2") + "Record Rate(fps) : 1000\nSave Step : 5\n")
    np.testing.assert_allclose(images.frames(tmp_path / "t.mraw").time_s, [0.0, 0.005])
    (tmp_path / "t.mraw").write_bytes(bytes(35))
    for text in ("<cih><frameInfo>", "<cih><a></cih>", '<!DOCTYPE cih [<!ENTITY a "b">]><cih>&a;</cih>'):
        (tmp_path / "t.cihx").write_text(text)
        with pytest.raises(InputError, match=r"t\.cihx: "):
            images.frames(tmp_path / "t.mraw")


@pytest.mark.parametrize(
    ("layout", "words"),
    [
        ("7x5", "is no layout of frames; a layout is WIDTHxHEIGHTxBITS"),
        ("7x5x17", "17 bits a pixel"),
        ("0x5x8", "is no layout"),
        ("7x5x8:packing=high-first", "8 bits are not packed"),
        ("7x5x12:packing=other", "packing is 'other', expected whole, high-first, low-first, gige"),
        ("7x5x8:header=-1", "header is '-1', expected a number of bytes"),
        ("7x5x8:rate=nan", "rate is 'nan', expected frames in a second"),
        ("7x5x8:rate=5:rate=5", "'rate' is no option, or there twice"),
        ("7x5x8:size=5", "'size' is no option"),
        ("7x5x8:bayer=RGB", "expected RGGB, BGGR, GRBG, GBRG"),
    ],
)
def test_a_layout_that_is_none(tmp_path: Path, layout: str, words: str) -> None:
    (tmp_path / "t.raw").write_bytes(bytes(35))
    with pytest.raises(UsageError, match=words):
        images.frames(tmp_path / f"t.raw:{layout}")
    with pytest.raises(UsageError, match="has no header: state its layout with --raw"):
        images.frames(tmp_path / "t.raw")


def test_frames_without_a_header_lie_as_stated(tmp_path: Path, rng: np.random.Generator) -> None:
    stack, path = stack_of(rng, 16), tmp_path / "t.bin"
    gap = b"--"
    path.write_bytes(b"head" + gap.join(frame.astype(">u2").tobytes() for frame in stack))
    layout = "7x5x16:header=4:gap=2:order=big"
    for content in (path.read_bytes(), path.read_bytes() + gap):
        path.write_bytes(content)
        assert images.count_pages(tmp_path / f"t.bin:{layout}") == 3
        np.testing.assert_array_equal(images.read_image(tmp_path / f"t.bin:{layout}", 2), stack[2])
    with pytest.raises(InputError, match=r"3\.\d\d frames .*expected a whole number"):
        images.frames(tmp_path / "t.bin:7x5x16:header=4")
    with pytest.raises(InputError, match="frames"):
        images.frames(tmp_path / "t.bin:7x5x16:header=400000")


@pytest.mark.parametrize("pattern", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_green_of_a_colour_sensor(tmp_path: Path, rng: np.random.Generator, pattern: str) -> None:
    """Green pixels stay as they are; an even light behind all filters is even, whatever red and blue see."""
    mosaic = stack_of(rng, 16, (1, 5, 6))[0]
    green = np.array([[pattern[2 * (row % 2) + column % 2] == "G" for column in range(6)] for row in range(5)])
    (tmp_path / "t.raw").write_bytes(mosaic.tobytes())
    seen = images.read_image(tmp_path / f"t.raw:6x5x16:bayer={pattern}", 0)
    np.testing.assert_array_equal(seen[green], mosaic[green])
    row, column = np.argwhere(~green)[np.argmax(np.all(np.argwhere(~green) % 4 > 0, axis=1))]
    beside = mosaic[[row - 1, row + 1, row, row], [column, column, column - 1, column + 1]]
    assert seen[row, column] == beside.mean()
    even = np.where(green, 100, mosaic).astype(np.float32)
    np.testing.assert_array_equal(green_of(even, pattern), np.full((5, 6), 100))


def test_stacks_that_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    path, other = tmp_path / "t.h5", tmp_path / "other.h5"
    stack = stack_of(rng, 16)
    camera_files.write_stack(other, stack, "frames")
    with h5py.File(path, "w") as file:
        file["a"] = file["b"] = stack
        file["flat"], file["line"], file["text"] = stack[0], stack[0, 0], np.bytes_("x")
        file["link"] = h5py.ExternalLink("other.h5", "frames")
        file.create_dataset("unwritten", stack.shape, "u2", chunks=(1, 5, 7))
        file.create_dataset("huge", (1, 400_000, 400_000), "u2", chunks=(1, 10, 10))
        file.create_dataset("outside", stack.shape, "u2", external=[("raw.bin", 0, stack.nbytes)])
        layout = h5py.VirtualLayout(stack.shape, "u2")
        layout[:] = h5py.VirtualSource("other.h5", "frames", stack.shape)
        file.create_virtual_dataset("virtual", layout)
    np.testing.assert_array_equal(images.read_single(tmp_path / "t.h5:/flat"), stack[0])
    for name, words in {
        "": "holds 6 datasets of frames, expected one, or to be told which: t.h5:/a, t.h5:/b",
        ":/line": "expected numbers of (frames, rows, columns)",
        ":/text": "expected numbers of (frames, rows, columns)",
        ":/none": "holds no dataset /none",
        ":/link": "link",
        ":/unwritten": "0 of its 3 chunks",
        ":/huge": "400000 x 400000",
        ":/outside": "another file",
        ":/virtual": "another file",
    }.items():
        with pytest.raises(InputError, match=re.escape(words)) as raised:
            images.frames(tmp_path / f"t.h5{name}")
        assert "t.h5" in str(raised.value)


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="the system does not list what is open")
def test_nothing_stays_open(tmp_path: Path, rng: np.random.Generator) -> None:
    recordings = [written(kind, tmp_path, rng)[0] for kind in KINDS]
    read_all(recordings[0])
    before = len(list(Path("/proc/self/fd").iterdir()))
    for path in recordings:
        read_all(path)
    assert len(list(Path("/proc/self/fd").iterdir())) <= before


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_mutated_headers_raise_nothing_else(tmp_path: Path, rng: np.random.Generator, kind: str) -> None:
    given, _ = written(kind, tmp_path, rng)
    path, _ = split_part(given)
    header = path if path.suffix != ".mraw" else next(path.parent.glob(f"{path.stem}.cih*"))
    content = header.read_bytes()
    telling = np.concatenate([np.arange(min(700, len(content))), np.arange(min(6_000, len(content)))])
    for _ in range(60):
        mutated = bytearray(content)
        for place in rng.choice(telling, 3):
            mutated[place] = rng.choice([0, 1, 0x7F, 0x80, 0xFF, rng.integers(256)])
        header.write_bytes(mutated)
        with suppress(InputError, UsageError):
            read_all(given)
