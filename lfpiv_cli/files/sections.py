"""The sections of the rig: every key, its unit (in its name), its range and its default, and what a section stands for.

A key that a section does not know is an error, and so are NaN and infinity. Sequences are tuples. What involves several
keys is checked in `files.checks`. What a section leaves out and another of its keys implies (an aperture from an
f-number) is worked out by the section, once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, Tag
from pydantic_core import PydanticCustomError

from lfpiv_cli.flow.windows import LARGEST_TILT_DEG, RoundWall
from lfpiv_cli.grid import Grid, Reference, Scale
from lfpiv_cli.names import ColumnAxis, Facing, Layout, Medium, Pattern, Polarity, ReferenceName
from lfpiv_cli.optics.camera import Camera, Lattice, thin_lens
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.surfaces import SURFACES

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

UM_TO_MM, NM_TO_MM = 1e-3, 1e-6
DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}
# Voxels as wide as a microlens lock depth to the array's grid and swallow its velocity: of 0.6 mm EM volumes give 0.22
# with them. With half of one laterally and two along the axis they give nine tenths, with a third 0.98 to 1.02 and a
# third less spread; a quarter gains no more. Along the axis the depth over which light spreads by one lens counts: two
# microlenses of Table 2 are 0.2 mm of 1.064 mm.
LATERAL_VOXELS_PER_MICROLENS = 3.0
VOXELS_PER_DEPTH = 1.064 / 0.2

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


class _Face(Section):
    def index_behind(self, media: Media) -> float:
        """Return the refractive index behind the face."""
        behind: str | float = self.behind  # type: ignore[attr-defined]
        return getattr(media, behind) if isinstance(behind, str) else behind

    def model(self, media: Media) -> Face:
        """Return the surface, and the index behind it.

        Raises
        ------
        ConfigError : heights that are no grid
        """
        reported = {name: getattr(self, name) for name in type(self).model_fields if name not in ("behind", "file")}
        if isinstance(reported.get("axis"), str):
            reported["axis"] = DIRECTIONS[reported["axis"]]
        return Face(SURFACES[reported.pop("kind")](**reported), self.index_behind(media))


class PlaneFace(_Face):
    """A plane square to the optical axis at z_mm. behind: what is behind each face, window, fluid or an index."""

    kind: Literal["plane"]
    z_mm: float
    behind: Behind


class TiltedPlaneFace(_Face):
    """A plane through point_mm, square to the direction `normal` (x, y, z); behind as of every face."""

    kind: Literal["tilted_plane"]
    point_mm: Vector
    normal: Vector
    behind: Behind


class CylinderFace(_Face):
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


class SphereFace(_Face):
    """A sphere of radius_mm about centre_mm; facing as of a cylinder, behind as of every face."""

    kind: Literal["sphere"]
    radius_mm: Positive
    centre_mm: Vector = (0.0, 0.0, 0.0)
    facing: Facing = "convex"
    behind: Behind


class HeightMapFace(_Face):
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


def scene_of(faces: Sequence[FaceSection], media: Media) -> CurvedSpace:
    """Return what lies in front of the lens, face by face.

    Raises
    ------
    ConfigError : light cannot cross the faces in this order
    """
    return CurvedSpace(media, tuple(face.model(media) for face in faces))


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

    @property
    def known_focal_length_mm(self) -> float | None:
        """F_m, given or from S_i = F_m (P - M)."""
        if self.focal_length_mm is not None or self.image_distance_mm is None:
            return self.focal_length_mm
        return self.image_distance_mm / (self.pupil_ratio - self.magnification)

    @property
    def known_aperture_mm(self) -> float | None:
        """p_m, given or from the f-number F_m / p_m."""
        focal_length = self.known_focal_length_mm
        if self.aperture_mm is not None or self.f_number is None or focal_length is None:
            return self.aperture_mm
        return focal_length / self.f_number


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

    @property
    def known_focal_length_mm(self) -> float | None:
        """f_m, given or from the f-number f_m / p_l."""
        if self.focal_length_mm is not None or self.f_number is None:
            return self.focal_length_mm
        return self.f_number * self.pitch_mm


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

    @property
    def missing(self) -> str | None:
        """The first key that a whole camera lacks, None where nothing is missing."""
        if self.main_lens is None:
            return "main_lens"
        if self.main_lens.known_focal_length_mm is None:
            return "main_lens.focal_length_mm"
        if self.main_lens.known_aperture_mm is None:
            return "main_lens.aperture_mm"
        return "microlenses.focal_length_mm" if self.microlenses.known_focal_length_mm is None else None

    def model(self) -> Camera | None:
        """Return the camera, a lens centre on the axis, its thin lens for the real one; None where a key is missing."""
        lens, microlenses, sensor = self.main_lens, self.microlenses, self.sensor
        if lens is None or self.missing is not None:
            return None
        microlens_focal_length = microlenses.known_focal_length_mm or 0.0
        real = Camera(
            magnification=lens.magnification,
            focal_length_mm=lens.known_focal_length_mm or 0.0,
            aperture_mm=lens.known_aperture_mm or 0.0,
            microlens_focal_length_mm=microlens_focal_length,
            microlens_distance_mm=sensor.microlens_distance_mm or microlens_focal_length,
            lattice=Lattice.regular(microlenses.pitch_mm, microlenses.layout or "square"),
            pixel_mm=sensor.pixel_um * UM_TO_MM,
            columns=sensor.columns,
            rows=sensor.rows,
            column_axis=sensor.column_axis,
            diffusion_px=sensor.diffusion_px,
        )
        # 1/P, 0 of a lens that is telecentric towards the array.
        return thin_lens(real, 0.0 if lens.image_distance == "infinite" else 1.0 / lens.pupil_ratio)


class MediaSection(Section):
    """Refractive indices in front of the lens: of the air, the window and the fluid.

    fluid_density_kg_m3, fluid_viscosity_pa_s: of the fluid; only pressure and dissipation read them.
    """

    air: Index = 1.0
    window: Index = 1.0
    fluid: Index = 1.0
    fluid_density_kg_m3: Positive | None = None
    fluid_viscosity_pa_s: Positive | None = None

    def model(self) -> Media:
        """Return the refractive indices."""
        return Media(self.air, self.window, self.fluid)


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

    def grid(self, scale: Scale | None, reference: Reference) -> Grid:
        """Return the volume's grid, z from the focal point, where the section counts z from a reference.

        The camera's `scale` is needed only where the section leaves the voxels to the program.
        """
        shape, voxel = self.shape_xyz, self.voxel_mm
        if shape is None or voxel is None:
            if self.size_mm is None or scale is None:
                raise ValueError("neither shape_xyz and voxel_mm nor size_mm with a camera")
            # What serves the velocity best: near a third of a microlens laterally, as it appears in the scene, and a
            # fifth of the depth over which light spreads by one lens; voxels divide the size.
            lateral, depth = scale.lens_mm / LATERAL_VOXELS_PER_MICROLENS, scale.depth_mm / VOXELS_PER_DEPTH
            sides = zip(self.size_mm, (lateral, lateral, depth), strict=True)
            nx, ny, nz = (max(1, round(size / target)) for size, target in sides)
            x, y, z = self.size_mm
            shape, voxel = (nx, ny, nz), (x / nx, y / ny, z / nz)
        x, y, z = self.centre_mm
        return Grid.centred(shape, voxel, (x, y, reference.depth_to_focal_point(z)))


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

    def wall(self) -> RoundWall:
        """Return the inside of the pipe, in the volume's coordinates."""
        return RoundWall(self.radius_mm, self.centre_mm, self.axis)
