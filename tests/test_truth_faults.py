"""Lists of true particles that are damaged or made to do harm, through the command that reads them."""

from __future__ import annotations

import io
import json
import random
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from lfpiv_cli.errors import InputError
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.files.vtkhdf import write_vectors
from lfpiv_cli.reference import FOCAL_POINT
from tests.hostile_files import ended
from tests.vector_fields import SHAPE, field_of

SAMPLE = Path(__file__).parent.parent / "configs" / "sample.yaml"


def arrays(count: int = 20) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(4)
    moved = {"frame_position_mm": rng.random((2, count, 3)), "frame_brightness": np.ones((2, count))}
    return {"position_mm": rng.random((count, 3)), "velocity_mm_s": rng.random((count, 3))} | moved


def packed(content: dict[str, np.ndarray]) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **content)
    return file.getvalue()


def header(shape: str) -> bytes:
    """Return NumPy's header of float64 numbers of a shape."""
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def with_member(name: str, content: bytes) -> bytes:
    """Return a list of particles with other bytes in place of an array."""
    file = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(packed(arrays()))) as old, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as new:
        for each in old.namelist():
            new.writestr(each, content if each == f"{name}.npy" else old.read(each))
    return file.getvalue()


def encrypted() -> bytes:
    """Return a list whose members say that they are encrypted."""
    content = bytearray(packed(arrays()))
    for mark, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        place = content.find(mark)
        while place >= 0:
            content[place + at] |= 1
            place = content.find(mark, place + 4)
    return bytes(content)


def misnamed() -> bytes:
    """Return a list in which a bit of an optional array's name is flipped, in the archive's list of names."""
    content = bytearray(packed(arrays() | {"diameter_mm": np.ones(20)}))
    content[content.rfind(b"diameter_mm")] ^= 1
    return bytes(content)


HARM: dict[str, Callable[[], bytes]] = {
    "no dimensions": lambda: packed({name: np.array(1.0) for name in arrays()}),
    "frames of no dimensions": lambda: packed(arrays() | {"frame_position_mm": np.array(1.0)}),
    "too large a number": lambda: packed(arrays() | {"velocity_mm_s": np.full((20, 3), 1e300)}),
    "no number": lambda: packed(arrays() | {"position_mm": np.full((20, 3), np.nan)}),
    "complex": lambda: packed(arrays() | {"position_mm": np.full((20, 3), 1j)}),
    "text": lambda: packed(arrays() | {"position_mm": np.full((20, 3), "a")}),
    "objects": lambda: packed(arrays() | {"position_mm": np.full((20, 3), None)}),
    "one array": lambda: header("(20, 3)") + bytes(480),
    "encrypted": encrypted,
    "misnamed": misnamed,
    "bomb": lambda: with_member("position_mm", header("(2500000, 3)") + bytes(60_000_000)),
    "bomb beside": lambda: with_member("frame_brightness", header("(375000, 20)") + bytes(60_000_000)),
    "declares a terabyte": lambda: with_member("position_mm", header("(50000000000, 3)") + bytes(480)),
    "negative": lambda: with_member("position_mm", header("(-20, -3)") + bytes(480)),
    "no header": lambda: with_member("position_mm", b""),
    "code for a header": lambda: with_member("position_mm", header("(" * 2000)),
    "empty": lambda: packed({name: array[:0] for name, array in arrays().items()}),
}


@pytest.mark.thorough
@pytest.mark.parametrize("harm", HARM)
def test_what_is_no_list_of_particles_is_refused(tmp_path: Path, harm: str) -> None:
    vectors, particles = tmp_path / "v.vtkhdf", tmp_path / "true.npz"
    field = field_of(np.random.default_rng(1).normal(size=(*SHAPE, 3)), None)
    write_vectors(vectors, field, FOCAL_POINT, provenance={}, overwrite=False)
    particles.write_bytes(HARM[harm]())
    code, said = ended(
        "validate", "flow", SAMPLE, "--vectors", vectors, "--particles", particles, "-o", tmp_path / "report"
    )
    assert code == 4
    assert f"{particles}: " in said
    json.dumps(said)


def test_no_damage_is_anything_but_refused(tmp_path: Path) -> None:
    path, whole = tmp_path / "true.npz", packed(arrays())
    path.write_bytes(whole)
    expected = read_particles(path)
    chosen, refused = random.Random(5), 0
    for _ in range(300):
        content = bytearray(whole)
        for _ in range(chosen.randint(1, 4)):
            content[chosen.randrange(len(content))] ^= 1 << chosen.randrange(8)
        path.write_bytes(content[: chosen.randrange(len(content))] if chosen.random() < 0.2 else content)
        try:
            found = read_particles(path)
        except InputError:
            refused += 1
        else:
            np.testing.assert_array_equal(found.positions_mm, expected.positions_mm)
            np.testing.assert_array_equal(found.velocities_m_s, expected.velocities_m_s)
    assert refused > 200
