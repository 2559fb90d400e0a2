"""The section `scene`: the faces that refract light between the lens and the fluid, one entry each."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

from lfpiv_cli.files.section_types import Index, Positive, Section, Vector
from lfpiv_cli.flow.masks import LARGEST_TILT_DEG, RoundWall
from lfpiv_cli.names import Facing

# What is behind a face: named as in `media`, or its refractive index.
Behind = Annotated[
    Annotated[Literal["window", "fluid"], Tag("name")] | Annotated[Index, Tag("number")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "number"),
]
# A lateral world axis, or any direction.
Direction = Annotated[
    Annotated[Literal["x", "y"], Tag("name")] | Annotated[Vector, Tag("direction")],
    Discriminator(lambda value: "name" if isinstance(value, str) else "direction"),
]


def _nearly_lateral(axis: str | tuple[float, float, float]) -> str | tuple[float, float, float]:
    """Refuse a pipe's axis that is tilted too far from both lateral ones."""
    if not isinstance(axis, str) and not (any(axis) and RoundWall(1.0, axis=axis).tilt_deg <= LARGEST_TILT_DEG):
        raise PydanticCustomError("pipe_axis", f"a direction within {LARGEST_TILT_DEG:g} degrees of x or y")
    return axis


# Of a round pipe: x, y, or a direction that is tilted from one of them by a few degrees.
PipeAxis = Annotated[Direction, AfterValidator(_nearly_lateral)]


class PlaneFace(Section):
    """A plane square to the optical axis at z_mm. behind: what is behind each face, window, fluid or an index."""

    kind: Literal["plane"]
    z_mm: float
    behind: Behind


class TiltedPlaneFace(Section):
    """A plane through point_mm, square to the direction `normal` (x, y, z); behind as of every face."""

    kind: Literal["tilted_plane"]
    point_mm: Vector
    normal: Vector
    behind: Behind


class CylinderFace(Section):
    """A circular cylinder of radius_mm; its axis, x, y or a direction [x, y, z], goes through centre_mm.

    facing: convex, the side nearer to the camera, behind which is the inside; or concave, the farther side, from inside
    to outside. behind as of every face.
    """

    kind: Literal["cylinder"]
    radius_mm: Positive
    axis: Direction = "x"
    centre_mm: Vector = (0.0, 0.0, 0.0)
    facing: Facing = "convex"
    behind: Behind


class SphereFace(Section):
    """A sphere of radius_mm about centre_mm; facing as of a cylinder, behind as of every face."""

    kind: Literal["sphere"]
    radius_mm: Positive
    centre_mm: Vector = (0.0, 0.0, 0.0)
    facing: Facing = "convex"
    behind: Behind


class HeightMapFace(Section):
    """A smooth surface through heights on a grid in a file: text, .npy or .tif, rows along y of heights along x, in mm.

    The file's folder is the rig file's; results carry heights_mm in its place. spacing_mm (x, y) lies between heights;
    centre_mm is the grid's middle, from whose z they count away from the camera. behind as of every face.
    """

    kind: Literal["height_map"]
    file: str | None = None
    heights_mm: tuple[tuple[float, ...], ...] | None = None
    spacing_mm: tuple[Positive, Positive]
    centre_mm: Vector = (0.0, 0.0, 0.0)
    behind: Behind


FaceSection = Annotated[
    PlaneFace | TiltedPlaneFace | CylinderFace | SphereFace | HeightMapFace, Field(discriminator="kind")
]


def parameters_of(face: FaceSection) -> dict[str, Any]:
    """Return what the surface of a face is made of, by the names that `optics.surfaces` has."""
    others = ("kind", "behind", "file")
    return {name: getattr(face, name) for name in type(face).model_fields if name not in others}
