"""VTK's XML files: images (`.vti`) and points (`.vtp`), for programs that do not read VTKHDF.

The arrays lie behind the XML as raw bytes, each after its length, so that nothing is rounded.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.exports.content import Content
from lfpiv_cli.files.particle_file import POSITION, lines_of

LENGTH = np.dtype("<u8")


class _Appended:
    """The arrays that lie behind the XML."""

    def __init__(self) -> None:
        """Begin with none."""
        self.arrays: list[NDArray[Any]] = []
        self._offset = 0

    def element(self, name: str, array: NDArray[Any], unit: str | None = None) -> str:
        """Add an array, a row for each place; return the element that speaks of it."""
        kind = {"f": "Float", "i": "Int", "u": "UInt"}[array.dtype.kind]
        components = array.shape[1] if array.ndim == 2 else 1
        head = (
            f'<DataArray type="{kind}{8 * array.itemsize}" Name={quoteattr(name)} NumberOfComponents="{components}" '
            f'format="appended" offset="{self._offset}"'
        )
        self.arrays.append(np.ascontiguousarray(array, array.dtype.newbyteorder("<")))
        self._offset += LENGTH.itemsize + array.nbytes
        if unit is None:
            return f"{head}/>\n"
        label = f'<InformationKey name="UNITS_LABEL" location="vtkDataArray">{unit}</InformationKey>'
        return f"{head}>{label}</DataArray>\n"


def write_vti(path: Path, content: Content) -> None:
    """Write a volume or vectors as an image of VTK, a point for each voxel or window."""
    if content.grid is None:
        raise ValueError("points are no image")
    grid, appended = content.grid, _Appended()
    extent = " ".join(f"0 {count - 1}" for count in grid.shape_xyz)
    vectors = ' Vectors="velocity"' if "velocity" in content.arrays else ""
    arrays = "".join(
        appended.element(name, array.reshape(-1, *array.shape[3:]), content.units[name])
        for name, array in content.arrays.items()
    )
    origin, spacing = (" ".join(map(repr, map(float, each))) for each in (grid.origin_mm, grid.spacing_mm))
    body = (
        f'<ImageData WholeExtent="{extent}" Origin="{origin}" Spacing="{spacing}">\n{_field_data(content)}'
        f'<Piece Extent="{extent}">\n<PointData{vectors}>\n{arrays}</PointData>\n</Piece>\n</ImageData>\n'
    )
    _write(path, "ImageData", body, appended)


def write_vtp(path: Path, content: Content) -> None:
    """Write particles or tracks as points of VTK: a vertex for each, and a line for each track of a sequence."""
    appended, position = _Appended(), content.arrays[POSITION]
    arrays = {name: array for name, array in content.arrays.items() if name != POSITION}
    lines = lines_of(arrays["track"]) if "track" in arrays else np.zeros(1, np.int64)
    data = "".join(appended.element(name, array, content.units[name]) for name, array in arrays.items())
    points = appended.element("Points", position, content.units[POSITION])
    vertices = _cells("Verts", np.arange(len(position) + 1), appended)
    body = (
        f'<PolyData>\n{_field_data(content)}<Piece NumberOfPoints="{len(position)}" NumberOfVerts="{len(position)}" '
        f'NumberOfLines="{len(lines) - 1}" NumberOfStrips="0" NumberOfPolys="0">\n'
        f"<PointData>\n{data}</PointData>\n<Points>\n{points}</Points>\n{vertices}{_cells('Lines', lines, appended)}"
        "</Piece>\n</PolyData>\n"
    )
    _write(path, "PolyData", body, appended)


def _cells(name: str, begins: NDArray[np.int64], appended: _Appended) -> str:
    """Return the element of cells of consecutive points, each of which begins where the one before ends."""
    connectivity = appended.element("connectivity", np.arange(begins[-1], dtype=np.int64))
    offsets = appended.element("offsets", begins[1:].astype(np.int64))
    return f"<{name}>\n{connectivity}{offsets}</{name}>\n"


def _field_data(content: Content) -> str:
    """Return what the file says about itself, as arrays of text and numbers."""
    return f"<FieldData>\n{''.join(_field(name, value) for name, value in content.told().items())}</FieldData>\n"


def _field(name: str, value: Any) -> str:
    head = f"<DataArray Name={quoteattr(name)}"
    if isinstance(value, str):
        # Text is stored as the numbers of its bytes, and ends with a zero.
        numbers = " ".join(str(byte) for byte in [*value.encode(), 0])
        return f'{head} type="String" NumberOfTuples="1" format="ascii">{numbers}</DataArray>\n'
    array = np.atleast_1d(np.asarray(value))
    kind = "Float64" if array.dtype.kind == "f" else "Int64"
    numbers = " ".join(repr(each) for each in array.tolist())
    return f'{head} type="{kind}" NumberOfTuples="{array.size}" format="ascii">{numbers}</DataArray>\n'


def _write(path: Path, kind: str, body: str, appended: _Appended) -> None:
    head = (
        f'<?xml version="1.0"?>\n<VTKFile type="{kind}" version="1.0" byte_order="LittleEndian" '
        f'header_type="UInt64">\n{body}<AppendedData encoding="raw">\n_'
    )
    with open(path, "wb") as file:
        file.write(head.encode())
        for array in appended.arrays:
            file.write(np.array(array.nbytes, LENGTH).tobytes())
            file.write(array.tobytes())
        file.write(b"\n</AppendedData>\n</VTKFile>\n")
