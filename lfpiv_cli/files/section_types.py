"""What the keys of the configuration can be: numbers within ranges, one for each axis, and what all sections share."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Index = Annotated[float, Field(ge=1.0, le=5.0)]
Angle = Annotated[float, Field(gt=-90.0, lt=90.0)]
# Of charge in a sensor: beyond this pixels would tell nothing apart.
Diffusion = Annotated[float, Field(ge=0.0, le=3.0)]
# Of light in air, nm.
Wavelength = Annotated[float, Field(ge=200.0, le=20_000.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Pair = tuple[float, float]
Vector = tuple[float, float, float]

# Sizes above these are slips of the keyboard; they would ask for more memory than any machine has.
MOST_PIXELS_PER_SIDE = 100_000
MOST_VOXELS_PER_SIDE = 10_000
MOST_PARTICLES = 10_000_000
MOST_FRAMES = 10_000
MOST_BUBBLES = 10_000


def _each_axis(value: Any) -> Any:
    """Let one number stand for the three axes."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return (value, value, value)
    return value


def _each_window(value: Any) -> Any:
    return tuple(_each_axis(item) for item in value) if isinstance(value, tuple) else value


# What the JSON schema says of a key that takes one number for all three axes.
PerAxis = Annotated[
    tuple[Positive, Positive, Positive],
    BeforeValidator(_each_axis, json_schema_input_type=Positive | tuple[Positive, Positive, Positive]),
]
Voxels = Annotated[int, Field(ge=1, le=MOST_VOXELS_PER_SIDE)]
WindowSide = Annotated[int, Field(ge=4, le=MOST_VOXELS_PER_SIDE)]
Overlap = Annotated[float, Field(ge=0.0, lt=1.0)]
Window = tuple[WindowSide, WindowSide, WindowSide]
Windows = Annotated[
    tuple[Window, ...], BeforeValidator(_each_window, json_schema_input_type=tuple[WindowSide | Window, ...])
]
Overlaps = Annotated[
    tuple[Overlap, Overlap, Overlap],
    BeforeValidator(_each_axis, json_schema_input_type=Overlap | tuple[Overlap, Overlap, Overlap]),
]
Pixels = Annotated[int, Field(ge=1, le=MOST_PIXELS_PER_SIDE)]


class Section(BaseModel):
    """What all sections share."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)
