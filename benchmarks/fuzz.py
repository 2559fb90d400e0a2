"""Readers fed with what nobody meant: configs, images and HDF5 files that are damaged, edited or made up.

    python -m benchmarks fuzz [READER ...] [--cases N] [--first K] [--failures DIR]

A case is made from a file that is whole and a number, so that it can be made again. Each is read as the commands read
it, and falls into one class: clean (read as it is meant), refused (an error of ours, which gives exit code 3 or 4),
traceback (any other exception), hang (longer than `SECONDS`), silent (read as other data although the format has check
sums). The last three are failures, whose files are kept.
"""

from __future__ import annotations

import argparse
import io
import random
import re
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import imagecodecs
import numpy as np
import tifffile
import yaml

from lfpiv_cli.errors import LfpivError
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.hdf5 import DIGEST, write_digest
from lfpiv_cli.files.images import count_pages, read_image
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, UNITS, Points, read_points, write_points
from lfpiv_cli.files.vtkhdf import open_volume, write_volume
from lfpiv_cli.files.weights_file import open_weights
from lfpiv_cli.grid import FOCAL_POINT, Grid
from lfpiv_cli.verbs.build_weights import build_weights_file
from lfpiv_cli.verbs.plot import info

CASES = 1_000_000
# A reader of a small file takes milliseconds.
SECONDS = 10
CONFIG = Path(__file__).parent.parent / "configs" / "sample.yaml"
# Of bytes and of numbers: ends of ranges, and what programs get wrong.
BYTES = (0x00, 0x01, 0x7F, 0x80, 0xFF)
NUMBERS = (0, 1, -1, 2**15, 2**16 - 1, 2**31 - 1, 2**32 - 1, 2**63 - 1)
VALUES: tuple[Any, ...] = (
    0,
    -1,
    1e300,
    1e-300,
    float("nan"),
    float("inf"),
    10**30,
    "",
    "a",
    None,
    True,
    [],
    [1],
    {},
    [[1]],
)
TOKENS = (
    *(
        "~",
        "yes",
        "12:30",
        "1e-3",
        ".nan",
        ".inf",
        "1e400",
        "0x" + "f" * 5000,
        "-0",
        "'",
        '"',
        "[",
        "]",
        "{",
        "}",
        ": ",
    ),
    *("- ", "\t", "\n", "#", "&a ", "*a", "!!int ", "---\n", "\ufeff", "\x00", "|", ">", "%", "@", "? ", "<<: ", "é"),
)


@dataclass(frozen=True)
class Reader:
    """A reader under test.

    Attributes
    ----------
    suffix : of its files
    whole : the names of the whole files that cases are made from, and their bytes
    damaged : makes a case of a whole file's bytes
    read : reads a file; what it returns tells whether two files are read alike
    has_sums : damage never gives other data
    """

    suffix: str
    whole: Callable[[], dict[str, bytes]]
    damaged: Callable[[random.Random, bytes], bytes]
    read: Callable[[Path], object]
    has_sums: bool


def with_flips(chosen: random.Random, whole: bytes) -> bytes:
    """Return bytes with some flipped, zeroed, doubled, moved or cut off."""
    content = bytearray(whole)
    for _ in range(chosen.randint(1, 4)):
        if not content:
            break
        at, kind, length = chosen.randrange(len(content)), chosen.randrange(6), 1 << chosen.randrange(9)
        if kind == 0:
            content[at] ^= 1 << chosen.randrange(8)
        elif kind == 1:
            content[at] = chosen.choice(BYTES)
        elif kind == 2:
            content[at : at + length] = bytes(len(content[at : at + length]))
        elif kind == 3:
            number = chosen.choice(NUMBERS) % 2**32
            content[at : at + 4] = number.to_bytes(4, chosen.choice(("little", "big")))
        elif kind == 4:
            there = chosen.randrange(len(content))
            content[at : at + length] = content[there : there + length]
        elif chosen.random() < 0.3:
            del content[at:]
    return bytes(content)


def with_words(chosen: random.Random, whole: bytes) -> bytes:
    """Return a config with other values, keys or characters."""
    if chosen.random() < 0.3:
        return with_flips(chosen, whole)
    if chosen.random() < 0.5:
        tree = yaml.safe_load(whole)
        for _ in range(chosen.randint(1, 3)):
            section, key = tree, None
            while isinstance(section, dict) and section and (key is None or chosen.random() < 0.8):
                parent, key = section, chosen.choice(sorted(section))
                section = parent[key]
            if key is not None:
                parent[key] = chosen.choice(
                    (*VALUES, *(section * scale for scale in (0.1, 3, -1) if _is_number(section)))
                )
        return yaml.safe_dump(tree).encode()
    lines = whole.decode().splitlines(keepends=True)
    for _ in range(chosen.randint(1, 3)):
        at = chosen.randrange(len(lines))
        place, token = chosen.randrange(len(lines[at]) + 1), chosen.choice(TOKENS)
        lines[at] = lines[at][:place] + token * chosen.choice((1, 1, 1, 30)) + lines[at][place + chosen.randrange(4) :]
        if chosen.random() < 0.2:
            lines.insert(chosen.randrange(len(lines)), lines[at])
    return "".join(lines).encode()


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def with_tags(chosen: random.Random, whole: bytes) -> bytes:
    """Return an image with other numbers in its tags, or other bytes."""
    if whole[:4] != b"II*\0" or chosen.random() < 0.4:
        return with_flips(chosen, whole)
    content = bytearray(whole)
    first = int.from_bytes(content[4:8], "little")
    count = int.from_bytes(content[first : first + 2], "little")
    for _ in range(chosen.randint(1, 3)):
        entry = first + 2 + 12 * chosen.randrange(max(count, 1))
        field, size = chosen.choice(((0, 2), (2, 2), (4, 4), (8, 4), (8, 2)))
        number = chosen.choice((*NUMBERS, chosen.randrange(70), chosen.randrange(len(content)))) % 256**size
        content[entry + field : entry + field + size] = number.to_bytes(size, "little")
    return bytes(content)


def with_edits(chosen: random.Random, whole: bytes) -> bytes:
    """Return an HDF5 file in which somebody has put other arrays, attributes or groups, its check sum made again."""
    kept = io.BytesIO(whole)
    with h5py.File(kept, "r+") as file:
        names = ["/"]
        file.visit(names.append)
        del file.attrs[DIGEST]
        for _ in range(chosen.randint(1, 2)):
            _edit(chosen, file, chosen.choice(names))
        write_digest(file)
    return kept.getvalue()


def _edit(chosen: random.Random, file: h5py.File, name: str) -> None:
    item = file.get(name)
    if item is None:
        return
    kind = chosen.randrange(4)
    reported = sorted(item.attrs)
    if reported and kind < 2:
        attribute = chosen.choice(reported)
        if attribute in ("DIMENSION_LIST", "REFERENCE_LIST"):
            return
        del item.attrs[attribute]
        if kind == 0:
            item.attrs[attribute] = chosen.choice(_ARRAYS)
    elif name != "/":
        old = item[()] if isinstance(item, h5py.Dataset) else np.zeros(2)
        del file[name]
        if kind == 2:
            others = (
                old * 0,
                -old,
                old.astype(np.float64) * np.nan,
                old.ravel()[:1],
                old[..., np.newaxis],
                old.astype("i1"),
            )
            file[name] = chosen.choice((*others, *_NUMERIC))
        elif chosen.random() < 0.5:
            file.create_group(name)


_NUMERIC = tuple(np.array(value) for value in (0, -1, 1e300, np.nan, np.inf, [1, 2, 3], [[1.5]], 2**62))
_ARRAYS = (*_NUMERIC, np.bytes_("x"), np.bytes_(b"\xff"), np.bytes_("[1]"), np.bytes_('{"inputs": 3}'))


@lru_cache(maxsize=1)
def whole_configs() -> dict[str, bytes]:
    """Return the configs that ship."""
    return {path.stem: path.read_bytes() for path in sorted(CONFIG.parent.glob("*.yaml"))}


@lru_cache(maxsize=1)
def whole_images() -> dict[str, bytes]:
    """Return small images of every packing."""
    picture = np.random.default_rng(3).integers(0, 4096, (24, 20)).astype(np.uint16)
    found = {"png": imagecodecs.png_encode(picture)}
    ways: dict[str, dict[str, Any]] = {
        "plain": {},
        "big": {"bigtiff": True},
        "swapped": {"byteorder": ">"},
        "tiles": {"tile": (16, 16), "compression": "zlib"},
        "pages": {"photometric": "minisblack"},
    } | {name: {"compression": name, "predictor": name == "lzw"} for name in ("lzw", "packbits", "zstd")}
    for name, options in ways.items():
        file = io.BytesIO()
        tifffile.imwrite(file, np.stack([picture] * 3) if name == "pages" else picture, metadata=None, **options)
        found[name] = file.getvalue()
    return found


@lru_cache(maxsize=1)
def whole_results() -> dict[str, bytes]:
    """Return a small volume, particles and weights."""
    rng, grid = np.random.default_rng(1), Grid.centred((4, 3, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
    record = {"command": "test", "config": {"numbers": list(range(1500))}, "inputs": {}, "made_from": {}}
    with tempfile.TemporaryDirectory() as name:
        paths = {kind: Path(name) / kind for kind in ("volume", "particles", "weights")}
        reported = {"residual": np.ones(3), "excluded_pixels": 0, "support_voxels": 24}
        array = rng.random(grid.shape_zyx)
        write_volume(paths["volume"], array, grid, FOCAL_POINT, provenance=record, attributes=reported, overwrite=False)
        arrays = {unit: rng.random((9, 6) if unit == "covariance_mm2" else 9) for unit in UNITS[PARTICLES_FORMAT]}
        points = Points(rng.random((9, 3)), arrays, FOCAL_POINT, {"residual": 0.1, "refraction": "exact"}, record)
        write_points(paths["particles"], PARTICLES_FORMAT, points, overwrite=False)
        rig = yaml.safe_load(CONFIG.read_text())
        rig["volume"] |= {"shape_xyz": [3, 2, 2], "reference": "focal_point"}
        rig["camera"]["sensor"] |= {"columns": 80, "rows": 64}
        (Path(name) / "rig.yaml").write_text(yaml.safe_dump(rig))
        build_weights_file(Path(name) / "rig.yaml", paths["weights"])
        return {kind: path.read_bytes() for kind, path in paths.items()}


def read_config(path: Path) -> object:
    """Read a config and make of it what the commands do."""
    config = load_rig(path)
    camera, media = config.camera_model(), config.media_model()
    return repr((config.resolved(), camera.scale(media), config.grid()))


def read_frames(path: Path) -> object:
    """Read all frames of a file."""
    return [read_image(path, page).tobytes() for page in range(count_pages(path))]


def read_results(path: Path) -> object:
    """Read a result as its command does, and describe it."""
    found = info(path)
    if found["format"] == PARTICLES_FORMAT:
        points = read_points(path, PARTICLES_FORMAT)
        return repr((points.reference, points.attributes, points.provenance)), points.position_mm.tobytes(), repr(found)
    if found["format"] == "lfpiv-volume":
        volume = open_volume(path)
        return repr((volume.grid, volume.reference, volume.attributes, volume.provenance)), volume.array.tobytes()
    weights = open_weights(path)
    return repr((weights.weights.grid, weights.camera.for_kernels(), weights.reference, weights.provenance))


READERS = {
    "config": Reader(".yaml", whole_configs, with_words, read_config, False),
    "images": Reader(".tif", whole_images, with_tags, read_frames, False),
    "results": Reader(".h5", whole_results, with_flips, read_results, True),
    "edited": Reader(".h5", whole_results, with_edits, read_results, False),
}


def outcome(reader: Reader, content: bytes, expected: object, folder: Path) -> tuple[str, str]:
    """Return the class of a case, and what there is to say of a failure."""
    path = folder / f"case{reader.suffix}"
    path.write_bytes(content)
    try:
        with _alarm():
            found = reader.read(path)
    except LfpivError:
        return "refused", ""
    except TimeoutError as error:
        return "hang", repr(error)
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {error}"
    return ("silent", "") if reader.has_sums and found != expected else ("clean", "")


@contextmanager
def _alarm() -> Iterator[None]:
    """Raise where a reader takes too long; of Unix alone, and in the first thread."""
    if not hasattr(signal, "SIGALRM"):
        yield
        return

    def ring(*_: object) -> None:
        raise TimeoutError(f"longer than {SECONDS} s")

    before = signal.signal(signal.SIGALRM, ring)
    signal.alarm(SECONDS)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def case(reader: Reader, chosen: random.Random) -> tuple[str, bytes]:
    """Return the name of the whole file that a case is made from, and the case."""
    whole = reader.whole()
    name = chosen.choice(sorted(whole))
    return name, reader.damaged(chosen, whole[name])


@lru_cache
def meant(reader: Reader, name: str) -> object:
    """Return what a whole file is read as; None where it is refused, as a config without a lens is."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"whole{reader.suffix}"
        path.write_bytes(reader.whole()[name])
        try:
            return reader.read(path)
        except LfpivError:
            return None


def fuzz(reader_name: str, cases: int, first: int, failures: Path) -> Counter[str]:
    """Read so many cases; print how far it is, keep the files of failures, and return how many fell into each class."""
    reader, counts, begun = READERS[reader_name], Counter[str](), time.monotonic()
    reported, said = begun, set[str]()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(first, first + cases):
            name, content = case(reader, random.Random(number))
            kind, words = outcome(reader, content, meant(reader, name), Path(folder))
            counts[kind] += 1
            if kind in ("traceback", "hang", "silent"):
                short = f"{kind} {re.sub(r'[0-9]+', '0', words)[:60]}"
                if short not in said:
                    said.add(short)
                    failures.mkdir(parents=True, exist_ok=True)
                    kept = failures / f"{reader_name}_{number}{reader.suffix}"
                    kept.write_bytes(content)
                    print(f"{reader_name} {number} ({name}): {kind} {words[:150]}, kept as {kept}", flush=True)
            if time.monotonic() - reported > 10.0:
                reported = time.monotonic()
                rate = (number + 1 - first) / (reported - begun)
                print(
                    f"{reader_name}: {number + 1 - first} of {cases}, {rate:.0f} a second, {dict(counts)}", flush=True
                )
    return counts


def bench_fuzz(words: Sequence[str] = ()) -> None:
    """Fuzz the readers that are named, or all of them; exits with 1 where there were failures."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks fuzz")
    parser.add_argument("readers", nargs="*", metavar="READER")
    parser.add_argument("--cases", type=int, default=CASES)
    parser.add_argument("--first", type=int, default=0, help="Number of the first case; each number makes one case.")
    parser.add_argument("--failures", type=Path, default=Path("out/fuzz"))
    given = parser.parse_args(words)
    if unknown := set(given.readers) - set(READERS):
        parser.error(f"no reader is called {', '.join(unknown)}; there are {', '.join(READERS)}")
    failed = 0
    for name in given.readers or READERS:
        counts = fuzz(name, given.cases, given.first, given.failures)
        print(f"{name}: {dict(counts)}")
        failed += sum(counts[kind] for kind in ("traceback", "hang", "silent"))
    if failed:
        raise SystemExit(1)
