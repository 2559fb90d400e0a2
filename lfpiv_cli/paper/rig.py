"""The paper's camera and media (Section 3.1, Table 2) as the sections of a config."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from typing import Any

TABLE_2: dict[str, Any] = {
    "camera": {
        "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
        "microlenses": {"focal_length_mm": 0.8, "pitch_mm": 0.1, "columns": 252, "rows": 252, "layout": "square"},
        "sensor": {
            "pixel_um": 5.5,
            "columns": 2352,
            "rows": 1768,
            "microlens_distance_mm": 0.8,
            "column_axis": "x",
        },
    },
    "media": {"air": 1.0, "window": 1.49, "fluid": 1.33},
    "window": {"distance_mm": 98.0, "thickness_mm": 2.0},
    "volume": {"shape_xyz": [80, 80, 240], "voxel_mm": 0.1, "centre_mm": [0.0, 0.0, 0.0], "reference": "focal_point"},
}

# How the paper reconstructs (Section 3.3).
AS_PAPER: dict[str, Any] = {"solver": "sart", "iterations": 200, "relaxation": 1.0, "accelerate": False}
# The board (Section 3.3), whatever it stands in.
BOARD: dict[str, Any] = {"dots": [7, 7], "spacing_mm": 1.0, "dot_diameter_mm": 0.2, "polarity": "bright"}
# How the array and the board on the wall depart from where they should be.
MISALIGNED: dict[str, Any] = {
    "board_tilt_deg": [-0.3, 0.2],
    "board_offset_mm": [-0.1, 0.15],
    "rotation_deg": 0.2,
    "shift_px": [-1.5, 4.0],
}


def sections(**changes: Any) -> dict[str, Any]:
    """Return the sections of the paper's config with changes: those of a section's keys, or whole values.

    A section or key that is None is left out.
    """
    return merged(TABLE_2, changes)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested sections with changes, which leave out what they set to None."""
    result = deepcopy(dict(base))
    for name, value in changes.items():
        if isinstance(value, Mapping):
            earlier = result.get(name)
            result[name] = merged(earlier if isinstance(earlier, Mapping) else {}, value)
        elif value is None:
            result.pop(name, None)
        else:
            result[name] = deepcopy(value)
    return result
