"""Files of frames as cameras write them, byte by byte from the formats' descriptions and apart from what reads them."""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

# Seconds since 1970 at which the recordings here begin, and between two frames.
BEGIN_S, STEP_US = 1_600_000_000, 500
RATE_HZ = 2000


def bits_high_first(numbers: np.ndarray, bits: int) -> bytes:
    """Pack numbers one bit after the other, the highest first and into the highest bit of a byte."""
    text = "".join(f"{int(number):0{bits}b}" for number in numbers.ravel())
    text += "0" * (-len(text) % 8)
    return bytes(int(text[k : k + 8], 2) for k in range(0, len(text), 8))


def bits_low_first(numbers: np.ndarray, bits: int) -> bytes:
    """Pack numbers one bit after the other, the lowest first and into the lowest bit of a byte."""
    total = 0
    for place, number in enumerate(numbers.ravel()):
        total |= int(number) << (place * bits)
    return total.to_bytes(-(-numbers.size * bits // 8), "little")


def gige(numbers: np.ndarray, bits: int) -> bytes:
    """Pack pairs into three bytes: the high 8 bits of one, the low bits of both (the second's higher), the other's."""
    flat = [int(number) for number in numbers.ravel()]
    flat += [0] * (len(flat) % 2)
    low = bits - 8
    packed = []
    for first, second in zip(flat[::2], flat[1::2], strict=True):
        packed += [first >> low, (first % 2**low) + ((second % 2**low) << 4), second >> low]
    return bytes(packed)


def write_cine(
    path: Path,
    stack: np.ndarray,
    *,
    packed: int = 0,
    times: bool = True,
    filters: int = 0,
    notes: bytes = b"",
    version: int = 1,
    tight: bool = False,
) -> None:
    """Write a Phantom recording of frames (frame, row, column), 8 or 16 bits, or packed to 10 or 12."""
    count, rows, columns = stack.shape
    stored = 8 * stack.dtype.itemsize
    if packed:
        frames = [bits_high_first(frame, packed) for frame in stack]
    else:
        gap = 0 if tight else -columns * stack.dtype.itemsize % 4
        frames = [b"".join(row.tobytes() + bytes(gap) for row in frame[::-1]) for frame in stack]
    packing = {0: 0, 10: 256, 12: 1024}[packed]
    bitmap = struct.pack("<IiiHHIIiiII", 40, columns, rows, 1, stored, packing, len(frames[0]), 0, 0, 0, 0)
    setup = bytearray(11_000)
    setup[140:144] = struct.pack("<2sH", b"ST", len(setup))
    setup[768:772] = struct.pack("<I", RATE_HZ)
    setup[808:812] = struct.pack("<I", filters)
    setup[896:900] = struct.pack("<I", packed or (12 if stored == 16 else 8))
    blocks = struct.pack("<IHH4x", 12, 1007, int(times))
    if times:
        ticks = [((BEGIN_S << 32) + round(k * STEP_US * 2**32 / 1e6)) | 1 for k in range(count)]
        blocks += struct.pack("<IHH", 8 + 8 * count, 1002, 1) + struct.pack(f"<{count}Q", *ticks)
        blocks += struct.pack("<IHH", 8 + 4 * count, 1003, 0) + struct.pack(f"<{count}I", *[2**20] * count)
    places_at = 44 + len(bitmap) + len(setup) + len(blocks)
    kind = "q" if version else "I"
    first = places_at + count * struct.calcsize("<" + kind)
    wrapped = [struct.pack("<I", 8 + len(notes)) + notes + struct.pack("<I", len(f)) + f for f in frames]
    places = [first + sum(map(len, wrapped[:k])) for k in range(count)]
    parts = (44, 44 + len(bitmap), places_at, BEGIN_S << 32)
    header = struct.pack("<2sHHHiIiIIIIQ", b"CI", 44, 2 if filters else 0, version, -5, 100, -5, count, *parts)
    path.write_bytes(b"".join([header, bitmap, setup, blocks, struct.pack(f"<{count}{kind}", *places), *wrapped]))


def write_seq(path: Path, stack: np.ndarray, *, version: int = 5) -> None:
    """Write a Norpix sequence of frames (frame, row, column) of 8 or 16 bits."""
    count, rows, columns = stack.shape
    bits, frame_bytes = 8 * stack.dtype.itemsize, stack[0].nbytes
    size = 8192 if version >= 5 else 1024
    step = -(-(frame_bytes + 8) // 512) * 512
    header = bytearray(size)
    header[:36] = struct.pack("<I24sii", 0xFEED, "Norpix seq\n".encode("utf-16-le"), version, 1024)
    header[548:584] = struct.pack("<9I", columns, rows, bits, bits, frame_bytes, 100, count, 0, step)
    header[584:592] = struct.pack("<d", RATE_HZ)
    body = b""
    for k, frame in enumerate(stack):
        micro = k * STEP_US
        stamp = struct.pack("<IHH", BEGIN_S + micro // 1_000_000, micro // 1000 % 1000, micro % 1000)
        body += (frame.tobytes() + stamp).ljust(step, b"\0")
    path.write_bytes(bytes(header) + body)


def write_mraw(path: Path, stack: np.ndarray, *, bits: int, xml: bool = True) -> None:
    """Write a Photron recording of frames (frame, row, column) of 8 or 16 bits, or packed to 10 or 12; its header."""
    count, rows, columns = stack.shape
    frames = [frame.tobytes() if bits in (8, 16) else bits_high_first(frame, bits) for frame in stack]
    path.write_bytes(b"".join(frames))
    if xml:
        path.with_suffix(".cihx").write_bytes(
            b"\0\x01camera\0"
            + f"""
<cih><frameInfo><totalFrame>{count}</totalFrame><recordedFrame>{count}</recordedFrame>
<skipFrame>1</skipFrame></frameInfo>
<recordInfo><recordRate>{RATE_HZ}</recordRate><shutterSpeed>0.0001</shutterSpeed></recordInfo>
<fileInfo><date>2026/1/1</date></fileInfo><deviceInfo><deviceName>FASTCAM</deviceName></deviceInfo>
<basicInfo><comment>test</comment></basicInfo>
<imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo>
<imageDataInfo><resolution><width>{columns}</width><height>{rows}</height></resolution>
<effectiveBit><depth>{bits}</depth><side>Lower</side></effectiveBit>
<colorInfo><type>Mono</type><bit>{bits}</bit></colorInfo></imageDataInfo></cih>
""".encode()
            + b"\0\0"
        )
    else:
        path.with_suffix(".cih").write_text(
            "#Camera Information Header\nDate : 2026/1/1\n"
            f"Record Rate(fps) : {RATE_HZ}\nTotal Frame : {count}\nOriginal Total Frame : {count}\n"
            f"Image Width : {columns}\nImage Height : {rows}\nColor Type : Mono\nColor Bit : {bits}\n"
            f"File Format : MRaw\nEffectiveBit Depth : {bits}\nEffectiveBit Side : Lower\n"
        )


def write_im7(path: Path, stack: np.ndarray) -> None:
    """Write a DaVis recording of frames (frame, row, column) of 16 bits, packed."""
    count, rows, columns = stack.shape
    header = struct.pack("<4h4i3h", 0, 2, -4, 0, columns, rows, 1, count, 0, 1, 0).ljust(256, b"\0")
    packed = zlib.compress(stack.tobytes())
    path.write_bytes(header + struct.pack("<I", len(packed)) + packed + struct.pack("<2i", 1, 4) + b"1 0\0")


def write_set(path: Path, stacks: Sequence[np.ndarray], first: int = 1) -> None:
    """Write a DaVis set: its text, and beside it the folder of its images, each of frames (frame, row, column)."""
    # As LaVision's own library begins it.
    path.write_text(f"// set file <{path.name}> created by DaVis\n\n#GROUP Sets\nSetType = 256;\nSetStart = {first};\n")
    folder = path.with_suffix("")
    folder.mkdir()
    for number, stack in enumerate(stacks, start=first):
        write_im7(folder / f"B{number:05d}.im7", stack)


def write_stack(path: Path, stack: np.ndarray, name: str = "entry/data/frames") -> None:
    """Write an HDF5 file with a dataset of frames and their times."""
    with h5py.File(path, "w") as file:
        data = file.create_dataset(name, data=stack, chunks=(1, *stack.shape[1:]), compression="gzip")
        data.parent["time_s"] = np.arange(len(stack)) * STEP_US / 1e6
