"""The sections of the configuration: every key, its unit (in its name), its range and its default.

A key that a section does not know is an error, and so are NaN and infinity. Sequences are tuples. What involves several
keys is checked in `files.checks`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

from lfpiv_cli.flow.windows import LARGEST_TILT_DEG, RoundWall
from lfpiv_cli.names import (
    ColumnAxis,
    Facing,
    Layout,
    Mask,
    Medium,
    Method,
    Pattern,
    Polarity,
    ReferenceName,
    Refraction,
    Sampling,
    Start,
    Weighting,
)
from lfpiv_cli.reconstruction.registry import SolverName

# What the keys of the configuration can be: numbers within ranges, one for each axis, and what all sections share.


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
    tuple[Window, ...],
    BeforeValidator(
        lambda value: tuple(map(_each_axis, value)) if isinstance(value, tuple) else value,
        json_schema_input_type=tuple[WindowSide | Window, ...],
    ),
]
Overlaps = Annotated[
    tuple[Overlap, Overlap, Overlap],
    BeforeValidator(_each_axis, json_schema_input_type=Overlap | tuple[Overlap, Overlap, Overlap]),
]
Pixels = Annotated[int, Field(ge=1, le=MOST_PIXELS_PER_SIDE)]


class Section(BaseModel):
    """What all sections share."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


# The section `scene`: the faces that refract light between the lens and the fluid, one entry each.


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


class MainLens(Section):
    """The main lens: M and two of its lengths; what is given twice must agree.

    magnification: M, negative, as the image is inverted. focal_length_mm: F_m; or image_distance_mm: S_i = F_m (P - M),
    from the exit pupil to the array. pupil_ratio: P, diameter of the exit over that of the entrance pupil;
    image_distance: infinite in its place, of a lens that is telecentric towards the array.
    aperture_mm: the diameter p_m of the entrance pupil; or f_number: F_m / p_m.
    """

    magnification: Annotated[float, Field(lt=0.0)]
    focal_length_mm: Positive | None = None
    image_distance_mm: Positive | None = None
    image_distance: Literal["infinite"] | None = None
    pupil_ratio: Positive = 1.0
    aperture_mm: Positive | None = None
    f_number: Positive | None = None


class Microlenses(Section):
    """The microlens array: pitch p_l, focal length f_m or f_number (f_m / p_l), layout.

    columns and rows document the array; only the lenses that the sensor sees count. layout: square or hexagonal; by
    default as a white image shows, square where there is none.
    """

    pitch_mm: Positive
    focal_length_mm: Positive | None = None
    f_number: Positive | None = None
    columns: Count | None = None
    rows: Count | None = None
    layout: Layout | None = None


class Sensor(Section):
    """The sensor: pixel pitch, size, and the world axis that its columns follow.

    microlens_distance_mm: s_mu, how far it lies behind the array (default: the microlenses' focal length).
    diffusion_px: standard deviation of the Gaussian that charge diffuses by before a pixel collects it, 0.2 to 0.4 in
    many sensors; only `simulate` reads it.
    """

    pixel_um: Positive
    columns: Pixels
    rows: Pixels
    microlens_distance_mm: Positive | None = None
    diffusion_px: Diffusion = 0.0
    column_axis: ColumnAxis = "x"


class CameraSection(Section):
    """The camera; main_lens may be missing where only the lattice is sought."""

    main_lens: MainLens | None = None
    microlenses: Microlenses
    sensor: Sensor


class MediaSection(Section):
    """Refractive indices in front of the lens: of the air, the window and the fluid.

    fluid_density_kg_m3, fluid_viscosity_pa_s: of the fluid; only pressure and dissipation read them.
    """

    air: Index = 1.0
    window: Index = 1.0
    fluid: Index = 1.0
    fluid_density_kg_m3: Positive | None = None
    fluid_viscosity_pa_s: Positive | None = None


class WindowSection(Section):
    """The window: distance d1 from the main lens's entrance pupil and thickness d2. Only exact refraction reads it."""

    distance_mm: Positive
    thickness_mm: NotNegative


class VolumeSection(Section):
    """The volume: shape_xyz and voxel_mm (a number or [x, y, z]), or size_mm, which leaves the voxels to the program.

    reference: the origin of its coordinates, the nominal focal point (focal_point) or the channel's mid plane on the
    optical axis (mid_plane).
    """

    shape_xyz: tuple[Voxels, Voxels, Voxels] | None = None
    voxel_mm: PerAxis | None = None
    size_mm: tuple[Positive, Positive, Positive] | None = None
    centre_mm: Vector = (0.0, 0.0, 0.0)
    reference: ReferenceName = "focal_point"


# OpenCV's names of the dictionaries of ArUco markers.
DICTIONARIES = r"^DICT_((4X4|5X5|6X6|7X7)_(50|100|250|1000)|ARUCO_ORIGINAL)$"


class BoardSection(Section):
    """The calibration target: what is on it, how many, how far apart, and its thickness t_b.

    pattern: round dots, of dot_diameter_mm, as many along x and y as `dots` has; or a chessboard or a charuco board of
    `squares` along x and y, whose side is spacing_mm. marker_mm, dictionary: side of a ChArUco board's markers, and
    OpenCV's name of their dictionary. medium: what the board stands in, air or fluid. polarity: whether the dots are
    brighter (bright) or darker (dark) than the board, or as the picture shows them (auto).
    """

    pattern: Pattern = "dots"
    dots: tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]] | None = None
    squares: tuple[Annotated[int, Field(ge=3)], Annotated[int, Field(ge=3)]] | None = None
    spacing_mm: Positive
    dot_diameter_mm: Positive | None = None
    marker_mm: Positive | None = None
    dictionary: Annotated[str, Field(pattern=DICTIONARIES)] = "DICT_4X4_50"
    thickness_mm: NotNegative = 0.0
    medium: Medium = "air"
    polarity: Polarity = "auto"


class ChannelSection(Section):
    """The channel of Eq. 21: inner width D, wall t_w, and the camera's move after the board (default: Eq. 21's d_m).

    board_from_mid_plane_mm: how far behind the mid plane a board in the fluid stood; one in air: on the wall.
    no_slip: the fluid stands still at the walls across the depth (needs reference: mid_plane); `field` reads it.
    """

    width_mm: Positive
    wall_mm: NotNegative
    camera_move_mm: float | None = None
    board_from_mid_plane_mm: float | None = None
    no_slip: bool = False


class PipeSection(Section):
    """The inside of a round pipe along axis, of radius_mm, through centre_mm in the volume's coordinates.

    axis: x, y or a direction [x, y, z] within a few degrees of one of them. no_slip: the fluid stands still at its
    wall; `field` reads it.
    """

    radius_mm: Positive
    axis: PipeAxis = "x"
    centre_mm: Vector = (0.0, 0.0, 0.0)
    no_slip: bool = False


class WeightsSection(Section):
    """How weights are made.

    method: equivalent points (ert); rays traced through window and fluid (drt), which reads the window's distance; or
    polynomials fitted to boards at several depths (dlfc), which the calibration holds.
    refraction: paraxial, or Snell's law with its aberration (exact), which needs the thickness of what lies before the
    points: the section window, or channel with a calibrated mid plane. sampling: integrals (exact), or the paper's
    count of rays_per_point rays from each of `points` random points of a voxel (rays), seeded; for small volumes only.
    """

    method: Method = "ert"
    refraction: Refraction = "paraxial"
    sampling: Sampling = "exact"
    points: Annotated[int, Field(ge=1, le=10_000_000)] = 500
    rays_per_point: Annotated[int, Field(ge=1, le=10_000_000)] = 10_000
    seed: Annotated[int, Field(ge=0)] = 0


class ReconstructionSection(Section):
    """The solver: em (default, better for velocity), sart (Eq. 12), smart, mart or particles; iterations; relaxation.

    start: uniform (as the paper), or line_of_sight, which also leaves out for good what no light can have come from.
    stop_change: end when an iteration lowers the residual by less than this share of it (default: never).
    stop_noise: end when the residual is this many times the image's noise (default: never): read noise and, with
    photons_per_count, light's own; the solver `particles` begins with it.
    saturation_counts: pixels as bright as this are left out (default: those at the end of 8 to 16 bits).
    particle_diameter_mm: of the tracers (default: by their images); only the solver `particles` reads it.
    wavelength_nm: of the light, which lenses diffract: the solver `particles` and the fits of a target take waves
    (default: rays).
    diffusion_px: of charge in the sensor, as fits by waves take it (default: by the tracers' images,
    0.3 for a target's).
    accelerate: step from points extrapolated by Nesterov's momentum; a quarter of the iterations will do.
    padding_voxel: voxels [x, y, z] solved for beyond each side of the volume and cropped on writing (default: derived
    from how far light spreads).
    """

    solver: SolverName = "em"
    start: Start = "uniform"
    stop_change: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    stop_noise: Positive | None = None
    photons_per_count: Positive | None = None
    saturation_counts: Positive | None = None
    particle_diameter_mm: Positive | None = None
    wavelength_nm: Wavelength | None = None
    diffusion_px: Diffusion | None = None
    iterations: Annotated[int, Field(ge=1, le=100_000)] = 24
    relaxation: Annotated[float, Field(gt=0.0, le=2.0)] = 1.0
    accelerate: bool = True
    padding_voxel: (
        tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None
    ) = None


class CorrelationSection(Section):
    """The correlation windows, coarse to fine, in voxels (numbers or [x, y, z]), or the final one as window_mm.

    Default: 32 and 16 voxels, fewer where voxels are longer along an axis, but not below 16 and 8.

    overlap: of neighbouring windows, a number or [x, y, z]. dt_s: time between the volumes of a pair.
    mask: channel leaves out what lies beyond the channel's walls across the depth (needs reference: mid_plane), pipe
    what lies outside the section pipe.
    exponent: power of the intensities that is correlated (default: 0.5 for volumes of the solvers em, smart and mart;
    their brightest particles outweigh all others; and 1 for sart's).
    weighting: uniform counts all voxels of a window alike, gaussian those near its middle more.
    """

    windows: Windows | None = None
    window_mm: PerAxis | None = None
    overlap: Overlaps = (0.5, 0.5, 0.5)
    dt_s: Positive | None = None
    mask: Mask | None = None
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    weighting: Weighting = "uniform"


@dataclass(frozen=True, kw_only=True)
class CorrelationKeys:
    """Keys of the section `correlation` that options take the place of; None leaves a key as it is."""

    dt_s: float | None = None
    windows: Sequence[int | Sequence[int]] | None = None
    overlap: float | Sequence[float] | None = None
    weighting: Weighting | None = None
