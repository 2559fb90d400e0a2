"""Image files: every kind that is read, and what is damaged, absurd or no counts, through the commands that read it."""

import contextlib
import hashlib
import io
import os
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile

import lfpiv_cli as lf
from lfpiv_cli.errors import InputError
from lfpiv_cli.files import recording_formats as formats
from lfpiv_cli.files.images import count_pages, read_image, read_single, write_tiff
from lfpiv_cli.files.provenance import ensure_verified
from tests import camera_files
from tests.commands import CONFIG, ROOT, SAMPLE, ended, refused

ROWS, COLUMNS = 448, 600


def picture(path: Path, value: float) -> Path:
    """Write an image with one pixel of a value among others of 100 counts."""
    counts = np.full((ROWS, COLUMNS), 100.0)
    counts[3, 4] = value
    tifffile.imwrite(path, counts)
    return path


CALIBRATE = ("calibrate-snapshot", CONFIG, "--white", SAMPLE / "white.tif")


@pytest.mark.thorough
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e30])
@pytest.mark.parametrize(
    ("command", "option"),
    [("reconstruct", option) for option in ("--dark", "--background", "--mask")]
    + [("calibrate", option) for option in ("--white", "--dark", "--board")],
)
def test_a_reference_without_counts_is_refused(
    tmp_path: Path, weights: Path, command: str, option: str, value: float
) -> None:
    image = picture(tmp_path / "reference.tif", value)
    target = tmp_path / ("out.h5" if command == "calibrate" else "out.vtkhdf")
    words = CALIBRATE if command == "calibrate" else ("reconstruct", weights, SAMPLE / "pair_a.tif")
    code, said = ended(*words, option, image, "-o", target)
    assert (code, "reference.tif: 1 of its 268800 pixels are not counts" in said) == (4, True), said
    assert not target.exists()


@pytest.mark.thorough
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300, 1e30])
def test_frames_with_such_pixels_give_volumes_of_numbers(tmp_path: Path, weights: Path, value: float) -> None:
    frame = picture(tmp_path / "frame.tif", value)
    code, said = ended("reconstruct", weights, frame, "-o", tmp_path / "v.vtkhdf")
    assert (code, said) == (0, "")
    assert ended("info", tmp_path / "v.vtkhdf") == (0, "")


def pages_of(path: Path, shape: tuple[int, int] | None = None) -> list[np.ndarray]:
    """Every page of an image file, as a batch reads them."""
    return [read_image(path, page, shape) for page in range(count_pages(path))]


# Images

FRAMES = np.random.default_rng(1).integers(0, 4096, (3, 40, 50)).astype(np.uint16)

TIFF_KINDS = [
    {},
    {"byteorder": ">"},
    {"bigtiff": True},
    {"tile": (16, 16)},
    {"tile": (16, 16), "compression": "zlib"},
    {"compression": "zlib", "predictor": True},
    {"compression": "lzw", "predictor": True},
    {"compression": "zstd"},
    {"compression": "packbits"},
    {"rowsperstrip": 7, "compression": "lzw", "byteorder": ">"},
    {"imagej": True},
]


@pytest.mark.thorough
@pytest.mark.parametrize("options", TIFF_KINDS, ids=str)
def test_every_kind_of_tiff_gives_the_same_frames_and_none_is_lost(tmp_path: Path, options: dict) -> None:
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, FRAMES, photometric="minisblack", **options)
    assert count_pages(path) == 3
    np.testing.assert_array_equal(pages_of(path, (40, 50)), FRAMES)
    assert read_image(path, 2).dtype == np.float32
    whole = path.read_bytes()
    for percent in range(1, 100):
        path.write_bytes(whole[: len(whole) * percent // 100])
        assert refused(lambda: pages_of(path), "t.tif: "), percent


@pytest.mark.parametrize("kind", ["u1", "u2", "u4", "i2", "f4", "f8"])
def test_kinds_of_pixels(tmp_path: Path, kind: str) -> None:
    image = FRAMES[0].astype(kind)
    if kind == "f8":  # what is no number, or more than 32 bits hold, is passed on
        image[0, :3] = np.nan, np.inf, 1e300
    tifffile.imwrite(tmp_path / "t.tif", image, photometric="minisblack")
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(read_single(tmp_path / "t.tif"), image.astype(np.float32))


@pytest.mark.parametrize("bits", [8, 16])
def test_png(tmp_path: Path, bits: int) -> None:
    path = tmp_path / "t.png"
    image = FRAMES[0].astype(f"u{bits // 8}")
    path.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    np.testing.assert_array_equal(read_single(path, (40, 50)), image)
    assert count_pages(path) == 1
    whole = path.read_bytes()
    for percent in range(1, 100):
        path.write_bytes(whole[: len(whole) * percent // 100])
        assert refused(lambda: read_single(path), "t.png: "), percent
    path.write_bytes(whole[:100] + bytes([whole[100] ^ 1]) + whole[101:])
    assert refused(lambda: read_single(path), "check sum")


GREY = FRAMES[0].astype(np.uint8)
# As other programs save a grey image: its channel three times, together or apart, an opaque one beside, or a palette.
IN_COLOUR = {
    "rgb": (np.stack([GREY] * 3, axis=-1), {"photometric": "rgb"}),
    "apart": (np.stack([GREY] * 3), {"photometric": "rgb", "planarconfig": "separate"}),
    "16 bits": (np.stack([FRAMES[0]] * 3, axis=-1), {"photometric": "rgb"}),
    "opaque": (np.stack([GREY] * 3 + [np.full_like(GREY, 255)], axis=-1), {"photometric": "rgb", "extrasamples": [2]}),
    "palette": (GREY, {"photometric": "palette", "colormap": np.tile(np.arange(256) * 257, (3, 1)).astype(np.uint16)}),
}


@pytest.mark.parametrize("kind", IN_COLOUR)
def test_grey_saved_as_colour_is_read(tmp_path: Path, kind: str) -> None:
    image, options = IN_COLOUR[kind]
    tifffile.imwrite(tmp_path / "t.tif", image, **options)
    grey = FRAMES[0] if kind == "16 bits" else GREY
    np.testing.assert_array_equal(read_single(tmp_path / "t.tif", (40, 50)), grey)
    if kind in ("rgb", "16 bits", "opaque"):
        (tmp_path / "t.png").write_bytes(imagecodecs.png_encode(image))
        np.testing.assert_array_equal(read_single(tmp_path / "t.png", (40, 50)), grey)


@pytest.mark.parametrize("kind", ["rgb", "apart", "opaque", "palette", "miniswhite"])
def test_colour_is_refused_with_a_hint(tmp_path: Path, kind: str) -> None:
    image, options = IN_COLOUR.get(kind, (GREY, {"photometric": kind}))
    if kind == "palette":
        options = options | {"colormap": options["colormap"] // np.array([[1], [1], [2]], np.uint16)}
    elif kind != "miniswhite":
        image = image.copy()
        # one pixel's blue, or how transparent it is
        image[(2, 5, 7) if kind == "apart" else (5, 7, -1)] ^= 1
    tifffile.imwrite(tmp_path / "t.tif", image, **options)
    assert refused(lambda: read_single(tmp_path / "t.tif"), "save the sensor's raw image as greyscale")
    if kind in ("rgb", "opaque"):
        (tmp_path / "t.png").write_bytes(imagecodecs.png_encode(image))
        assert refused(lambda: read_single(tmp_path / "t.png"), "save the sensor's raw image as greyscale")


def test_another_size_is_refused_with_both(tmp_path: Path) -> None:
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, FRAMES[0], photometric="minisblack")
    tifffile.imwrite(path, FRAMES[0, :30], photometric="minisblack", append=True)
    assert refused(lambda: pages_of(path, (40, 50)), "page 1 is 50 x 30 pixels", "50 x 40")
    assert refused(lambda: read_image(path, 0, (1768, 2352)), "page 0 is 50 x 40", "2352 x 1768")
    assert refused(lambda: read_image(path, 2), "no page 2, it holds 2")
    assert refused(lambda: read_single(path), "holds 2 pages, expected a single image")


@pytest.mark.parametrize("options", [{}, {"imagej": True}])
def test_frames_hidden_behind_one_page_are_not_lost_in_silence(tmp_path: Path, options: dict) -> None:
    tifffile.imwrite(tmp_path / "t.tif", FRAMES, photometric="minisblack", truncate=True, **options)
    assert refused(lambda: count_pages(tmp_path / "t.tif"), "holds 1 pages and says 3 frames")


def tiff_file(
    columns: int, rows: int, data: bytes, compression: int, following: int = 0, software_at: int = 8
) -> bytes:
    """Return a TIFF file of one 16-bit strip that declares what it likes; its program's name has 8 letters."""
    entries = [(256, 1, columns), (257, 1, rows), (258, 1, 16), (259, 1, compression), (262, 1, 1)]
    entries += [(273, 1, 8 + 2 + 10 * 12 + 4), (277, 1, 1), (278, 1, rows), (279, 1, len(data)), (305, 8, software_at)]
    kinds = [2 if tag == 305 else 4 for tag, _, _ in entries]
    packed = [struct.pack("<HHII", tag, kind, *rest) for (tag, *rest), kind in zip(entries, kinds, strict=True)]
    directory = struct.pack("<H", len(entries)) + b"".join(packed)
    return b"II*\0" + struct.pack("<I", 8) + directory + struct.pack("<I", following) + data


def png(columns: int, rows: int, data: bytes, bits: int = 16) -> bytes:
    """Return a PNG file with right check sums that declares what it likes."""

    def part(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", columns, rows, bits, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + part(b"IHDR", header) + part(b"IDAT", data) + part(b"IEND", b"")


NOTHING = zlib.compress(bytes(20_000))


# What is no image that could be, and words of what is said of it.
ABSURD_IMAGES = [
    (tiff_file(400_000, 400_000, NOTHING, 8), "declares 400000 x 400000"),
    (tiff_file(12_000, 12_000, NOTHING, 8), "more than"),
    (tiff_file(100, 100, zlib.compress(bytes(10**8)), 8), "cannot be decoded"),
    (tiff_file(100, 100, imagecodecs.zstd_encode(bytes(10**8)), 50_000), "cannot be decoded"),
    (tiff_file(100, 100, zlib.compress(bytes(100)), 8), "cannot be decoded"),
    (tiff_file(100, 100, imagecodecs.lzw_encode(bytes(100)), 5), "cannot be decoded"),
    (tiff_file(100, 100, bytes(100), 1), "has 100 bytes, its pixels take 20000"),
    (tiff_file(100, 100, NOTHING, 8, following=8), "circle"),
    (tiff_file(100, 100, NOTHING, 8, following=10**9), "page 1 lies at byte"),
    (tiff_file(100, 100, NOTHING, 8, software_at=10**9), "tag 305 of page 0 ends at byte 1000000008"),
    (tiff_file(100, 100, b"", 1), "the data of page 0"),
    (tiff_file(100, 0, NOTHING, 8), "declares 100 x 0"),
    (b"II*\0\0\0\0\0", "no pages"),
    (b"II*\0\x08\0", "header"),
    (b"II+\0" + b"\xff" * 100, "t.img"),
    (png(400_000, 400_000, NOTHING), "declares 400000 x 400000"),
    (png(100, 100, zlib.compress(bytes(100))), "cannot be decoded"),
    (b"\x89PNG\r\n\x1a\n", "cut off"),
    (b"BM" + bytes(100), "neither a TIFF nor a PNG"),
]


@pytest.mark.thorough
def test_flipped_bits_in_a_tiff_lose_no_page_and_raise_nothing_else(tmp_path: Path, rng: np.random.Generator) -> None:
    path = tmp_path / "t.tif"
    tifffile.imwrite(path, FRAMES, photometric="minisblack", compression="zlib", rowsperstrip=16)
    whole = path.read_bytes()
    for place in [*range(0, 300, 2), *rng.integers(300, len(whole), 50)]:
        content = bytearray(whole)
        content[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(content)
        with contextlib.suppress(InputError):
            assert len(pages_of(path, (40, 50))) == 3


@pytest.mark.thorough
def test_written_images_read_back_and_hold_no_time(tmp_path: Path) -> None:
    for dtype in (np.uint8, np.uint16):
        image = FRAMES[0].astype(dtype)
        write_tiff(tmp_path / "a.tif", image, overwrite=True)
        time.sleep(0.01)
        write_tiff(tmp_path / "b.tif", image, overwrite=True)
        np.testing.assert_array_equal(read_single(tmp_path / "a.tif"), image)
        assert (tmp_path / "a.tif").read_bytes() == (tmp_path / "b.tif").read_bytes()
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        assert not {"DateTime", "Software"} & {tag.name for tag in file.pages[0].tags}


def directories(count: int, tags: tuple[int, ...] = (256, 257, 273)) -> bytes:
    """Return a TIFF of many directories of few tags."""
    size = 2 + 12 * len(tags) + 4
    parts = [b"II*\0", struct.pack("<I", 8)]
    for number in range(count):
        following = 8 + (number + 1) * size if number + 1 < count else 0
        entries = b"".join(struct.pack("<HHII", tag, 4, 1, 4) for tag in tags)
        parts.append(struct.pack("<H", len(tags)) + entries + struct.pack("<I", following))
    return b"".join(parts)


def written(**options: object) -> bytes:
    """Return a TIFF as others write it."""
    tifffile.imwrite(file := io.BytesIO(), np.full((ROWS, COLUMNS), 100, np.uint8), photometric="minisblack", **options)
    return file.getvalue()


def retagged(content: bytes, tag: int, value: int) -> bytes:
    """Return a TIFF with another value of a tag, of a list its first."""
    with tifffile.TiffFile(file := io.BytesIO(content), mode="r+b") as tiff:
        found = tiff.pages[0].tags[tag]
        found.overwrite([value, *found.value[1:]] if isinstance(found.value, tuple) else value)
        return file.getvalue()


OF_STRIPS, OF_TILES = 279, 325
WITHOUT_AN_END = [
    (directories(100, (256,)), "the directory of page 0 is of no image"),
    (directories(51), "it holds more than 50 pages"),
    (retagged(written(), 259, 4), "for black and white alone"),
    (png(600, 448, zlib.compress(bytes(20_000_000)), 8), "more than the 600 x 448 pixels"),
    (retagged(written(), OF_STRIPS, 999), "strip or tile 0 of page 0 has"),
    (retagged(written(rowsperstrip=64), OF_STRIPS, 999), "strip or tile 0 of page 0 has"),
    (retagged(written(tile=(64, 64)), OF_TILES, 999), "strip or tile 0 of page 0 has"),
]


@pytest.mark.parametrize(("content", "words"), WITHOUT_AN_END, ids=lambda each: each if isinstance(each, str) else "")
def test_images_of_the_sensor_s_size_that_go_on_or_end_too_early_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: bytes, words: str
) -> None:
    """Pages without end, a fax, more than was declared, and bytes after what is too short, which are no pixels."""
    monkeypatch.setattr(formats, "MOST_PAGES", 50)
    (tmp_path / "t.img").write_bytes(content)
    code, said = ended("check", CONFIG, tmp_path / "t.img")
    assert (code, f"t.img: {words}" in said or words in said) == (4, True), said


def test_honest_images_of_those_kinds_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formats, "MOST_PAGES", 50)
    path = tmp_path / "t.img"
    for content in (tiff_file(100, 100, NOTHING, 8), png(7, 5, zlib.compress(bytes(5 * 8)), 8)):
        path.write_bytes(content)
        assert not read_single(path).any()
    path.write_bytes(directories(50))
    assert count_pages(path) == 50


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
    tifffile.imwrite(frame, read_single(SAMPLE / "pair_a.tif").astype(np.uint16), compression=packed)
    listed = sums(tmp_path, "a.tif", "rig.yaml")
    assert ended("check", config, frame, "--verify", listed, "-q") == (0, "")
    content = bytearray(frame.read_bytes())
    content[len(content) // 2] ^= 1
    frame.write_bytes(content)
    code, said = ended("check", config, frame, "--verify", listed)
    assert (code, f"{frame}: has the SHA-256" in said) == (4, True), said


def test_a_list_of_sums_has_all_inputs(tmp_path: Path) -> None:
    config, listed = tmp_path / "rig.yaml", tmp_path / "SHA256SUMS"
    config.write_bytes(CONFIG.read_bytes())
    for text, words in (
        ("", ""),
        ("# nothing\n", f"{config}: is not in {listed}"),
        ("12ab  a\n", "SUMS:1: is no line"),
    ):
        listed.write_text(text)
        code, said = ended("check", config, "--verify", listed)
        assert (code, words in said) == (4, True), said
    assert ended("check", config, "--verify", tmp_path / "none")[0] == 4
    (tmp_path / "other").write_text("mine")
    options = ("--dry-run", "-o", tmp_path / "w.h5", "--verify", sums(tmp_path, "other"))
    assert "rig.yaml: is not in" in ended("build-weights", config, *options)[1]
    # And what a recording is read with is verified, too.
    camera_files.write_set(tmp_path / "run.set", [np.zeros((1, 5, 7), np.uint16)] * 2)
    listed = sums(tmp_path, "run.set", "run/B00001.im7", "run/B00002.im7")
    assert ensure_verified(listed, [tmp_path / "run.set"]) == 3
    camera_files.write_im7(tmp_path / "run" / "B00002.im7", np.ones((1, 5, 7), np.uint16))
    with pytest.raises(InputError, match=r"B00002\.im7: has the SHA-256"):
        ensure_verified(listed, [tmp_path / "run.set"])


def test_what_a_decoder_complains_of_is_a_warning(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frame = tmp_path / "a.tif"
    tifffile.imwrite(frame, read_single(SAMPLE / "pair_a.tif").astype(np.uint16), software="x" * 40)
    content = bytearray(frame.read_bytes())
    place = content.index(struct.pack("<HH", 305, 2))
    content[place + 2 : place + 4] = struct.pack("<H", 99)  # a kind of tag that there is not
    frame.write_bytes(content)
    assert ended("check", CONFIG, frame) == (0, "")
    assert "a.tif: the decoder says: " in capsys.readouterr().err
    with pytest.warns(lf.LfpivWarning, match=r"a\.tif: the decoder says: "):
        read_single(frame)
    assert ended("check", CONFIG, SAMPLE / "pair_a.tif") == (0, "")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("kind", ["a strip that is too long", "a PNG that is too long", "no image"])
def test_gigabytes_of_no_image_are_refused_unread(tmp_path: Path, kind: str) -> None:
    path = tmp_path / ("big.png" if "PNG" in kind else "big.tif")
    image = np.full((ROWS, COLUMNS), 100, np.uint16)
    if kind == "a strip that is too long":
        tifffile.imwrite(path, image, photometric="minisblack", compression="zlib", rowsperstrip=ROWS)
        with tifffile.TiffFile(path, mode="r+") as file:
            file.pages[0].tags["StripByteCounts"].overwrite([3_000_000_000])
    else:
        path.write_bytes(imagecodecs.png_encode(image) if "PNG" in kind else b"II*\0\x08\0\0\0")
    os.truncate(path, 3 * 2**30)  # sparse
    # Neither its bytes are read nor, for a record that nobody will get, their SHA-256 made: that takes seconds.
    begun = time.thread_time()
    code, said = ended("calibrate-snapshot", CONFIG, "--white", path, "-o", tmp_path / "c.h5")
    assert (code, f"{path.name}: " in said) == (4, True), said
    assert time.thread_time() - begun < 1.0


@pytest.mark.parametrize(("content", "words"), ABSURD_IMAGES, ids=[words for _, words in ABSURD_IMAGES])
def test_absurd_images_are_refused_quickly(tmp_path: Path, content: bytes, words: str) -> None:
    """As images of any size, and by a command that knows its sensor."""
    path, begun = tmp_path / "t.img", time.thread_time()
    path.write_bytes(content)
    assert refused(lambda: read_single(path), words)
    code, said = ended("calibrate-snapshot", CONFIG, "--white", path, "-o", tmp_path / "c.h5")
    assert (code, "t.img" in said, (tmp_path / "c.h5").exists()) == (4, True, False), said
    assert time.thread_time() - begun < 1.0


def read_all_absurd(folder: Path) -> None:
    """Have a command read each absurd image, in a process of its own, and print the most memory in MB that it had."""
    for content, _ in ABSURD_IMAGES:
        (folder / "t.img").write_bytes(content)
        assert ended("check", CONFIG, folder / "t.img")[0] == 4
    # getrusage would count what the process that began this one had
    status = Path("/proc/self/status").read_text(encoding="ascii")
    print(int(status.partition("VmHWM:")[2].split()[0]) / 1024)


@pytest.mark.thorough
@pytest.mark.skipif(sys.platform != "linux", reason="Linux tells the most memory that a process had")
def test_absurd_images_take_no_memory(tmp_path: Path) -> None:
    code = "import sys, pathlib; from tests.test_image_files import read_all_absurd\n"
    code += "read_all_absurd(pathlib.Path(sys.argv[1]))"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert float(done.stdout.split()[-1]) < 500.0
