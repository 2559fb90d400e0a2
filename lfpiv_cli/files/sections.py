"""The sections of the configuration: every key, its unit (in its name), its range and its default.

A key that a section does not know is an error, and so are NaN and infinity. Sequences are tuples. What involves several
keys is checked in `files.checks`.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=1)]
Index = Annotated[float, Field(ge=1.0, le=5.0)]
Angle = Annotated[float, Field(gt=-90.0, lt=90.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Pair = tuple[float, float]
Vector = tuple[float, float, float]

# Sizes above these are slips of the keyboard; they would ask for more memory than any machine has.
MOST_PIXELS_PER_SIDE = 100_000
MOST_VOXELS_PER_SIDE = 10_000
MOST_PARTICLES = 10_000_000
MOST_FRAMES = 10_000


def _each_axis(value: Any) -> Any:
    """Let one number stand for the three axes."""
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return (value, value, value)
    return value


def _each_window(value: Any) -> Any:
    return tuple(_each_axis(item) for item in value) if isinstance(value, tuple) else value


PerAxis = Annotated[tuple[Positive, Positive, Positive], BeforeValidator(_each_axis)]
Voxels = Annotated[int, Field(ge=1, le=MOST_VOXELS_PER_SIDE)]
WindowSide = Annotated[int, Field(ge=4, le=MOST_VOXELS_PER_SIDE)]
Overlap = Annotated[float, Field(ge=0.0, lt=1.0)]
Pixels = Annotated[int, Field(ge=1, le=MOST_PIXELS_PER_SIDE)]


class Section(BaseModel):
    """What all sections share."""

    model_config = ConfigDict(strict=True, extra="forbid", frozen=True, allow_inf_nan=False)


class MainLens(Section):
    """The main lens: M and two of its lengths; what is given twice must agree.

    magnification: M, negative, as the image is inverted. focal_length_mm: F_m; or image_distance_mm: S_i = F_m (1 - M).
    aperture_mm: the diameter p_m; or f_number: F_m / p_m.
    """

    magnification: Annotated[float, Field(lt=0.0)]
    focal_length_mm: Positive | None = None
    image_distance_mm: Positive | None = None
    aperture_mm: Positive | None = None
    f_number: Positive | None = None


class Microlenses(Section):
    """The microlens array: pitch p_l, focal length f_m or f_number (f_m / p_l), layout.

    columns and rows document the array; only the lenses that the sensor sees count. layout: default is what a white
    image shows, square where there is none.
    """

    pitch_mm: Positive
    focal_length_mm: Positive | None = None
    f_number: Positive | None = None
    columns: Count | None = None
    rows: Count | None = None
    layout: Literal["square", "hexagonal"] | None = None


class Sensor(Section):
    """The sensor: pixel pitch, size, and the world axis that its columns follow.

    microlens_distance_mm: s_mu, how far it lies behind the array (default: the microlenses' focal length).
    """

    pixel_um: Positive
    columns: Pixels
    rows: Pixels
    microlens_distance_mm: Positive | None = None
    column_axis: Literal["x", "y"] = "x"


class CameraSection(Section):
    """The camera; main_lens may be missing where only the lattice is sought."""

    main_lens: MainLens | None = None
    microlenses: Microlenses
    sensor: Sensor


class MediaSection(Section):
    """Refractive indices in front of the lens: of the air, the window and the fluid."""

    air: Index = 1.0
    window: Index = 1.0
    fluid: Index = 1.0


class WindowSection(Section):
    """The window: distance d1 from the main lens and thickness d2. Only exact refraction reads it."""

    distance_mm: Positive
    thickness_mm: NotNegative


class VolumeSection(Section):
    """The volume: shape_xyz and voxel_mm (a number or [x, y, z]), or size_mm, which leaves the voxels to the program.

    reference: the origin of its coordinates, the nominal focal point or the channel's mid plane on the optical axis.
    """

    shape_xyz: tuple[Voxels, Voxels, Voxels] | None = None
    voxel_mm: PerAxis | None = None
    size_mm: tuple[Positive, Positive, Positive] | None = None
    centre_mm: Vector = (0.0, 0.0, 0.0)
    reference: Literal["focal_point", "mid_plane"] = "focal_point"


class BoardSection(Section):
    """The calibration board: dots along x and y, their spacing and diameter, the board's thickness t_b.

    medium: what the board stands in. polarity: whether the dots are brighter or darker than the board.
    """

    dots: tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]]
    spacing_mm: Positive
    dot_diameter_mm: Positive
    thickness_mm: NotNegative = 0.0
    medium: Literal["air", "fluid"] = "air"
    polarity: Literal["bright", "dark"] = "bright"


class ChannelSection(Section):
    """The channel of Eq. 21: inner width D, wall t_w, and the camera's move after the board (default: Eq. 21's d_m).

    board_from_mid_plane_mm: how far behind the mid plane a board in the fluid stood; one in air: on the wall.
    """

    width_mm: Positive
    wall_mm: NotNegative
    camera_move_mm: float | None = None
    board_from_mid_plane_mm: float | None = None


class WeightsSection(Section):
    """How weights are made.

    method: equivalent points (ert); rays traced through window and fluid (drt), which reads the window's distance; or
    polynomials fitted to boards at several depths (dlfc), which the calibration holds.
    refraction: paraxial, or Snell's law with its aberration (exact), which needs the thickness of what lies before the
    points: the section window, or channel with a calibrated mid plane. sampling: integrals (exact), or the paper's
    count of rays_per_point rays from each of `points` random points of a voxel (rays), seeded; for small volumes only.
    """

    method: Literal["ert", "drt", "dlfc"] = "ert"
    refraction: Literal["paraxial", "exact"] = "paraxial"
    sampling: Literal["exact", "rays"] = "exact"
    points: Annotated[int, Field(ge=1, le=10_000_000)] = 500
    rays_per_point: Annotated[int, Field(ge=1, le=10_000_000)] = 10_000
    seed: Annotated[int, Field(ge=0)] = 0


class ReconstructionSection(Section):
    """The solver: em (default, better for velocity), sart (Eq. 12), smart, mart or particles; iterations; relaxation.

    start: uniform (as the paper), or line_of_sight, which also leaves out for good what no light can have come from.
    stop_change: end when an iteration lowers the residual by less than this share of it (default: never).
    stop_noise: end when the residual is this many times the image's noise (default: never): read noise and, with
    photons_per_count, light's own.
    saturation_counts: pixels as bright as this are left out (default: those at the end of 8 to 16 bits).
    particle_diameter_mm: of the tracers; only the solver `particles` reads it.
    accelerate: step from points extrapolated by Nesterov's momentum; a quarter of the iterations will do.
    padding_voxel: voxels [x, y, z] solved for beyond each side of the volume and cropped on writing (default: derived
    from how far light spreads).
    """

    solver: Literal["em", "sart", "smart", "mart", "particles"] = "em"
    start: Literal["uniform", "line_of_sight"] = "uniform"
    stop_change: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    stop_noise: Positive | None = None
    photons_per_count: Positive | None = None
    saturation_counts: Positive | None = None
    particle_diameter_mm: Positive = 0.05
    iterations: Annotated[int, Field(ge=1, le=100_000)] = 24
    relaxation: Annotated[float, Field(gt=0.0, le=2.0)] = 1.0
    accelerate: bool = True
    padding_voxel: (
        tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None
    ) = None


class CorrelationSection(Section):
    """The correlation windows, coarse to fine, in voxels (numbers or [x, y, z]), or the final one as window_mm.

    overlap: of neighbouring windows, a number or [x, y, z]. dt_s: time between the volumes of a pair.
    mask: channel leaves out what lies beyond the channel's walls across the depth (needs reference: mid_plane).
    exponent: power of the intensities that is correlated (default: 0.5 for volumes of the solvers em, smart and mart,
    whose brightest particles outweigh all others, and 1 for sart's).
    """

    windows: Annotated[tuple[tuple[WindowSide, WindowSide, WindowSide], ...], BeforeValidator(_each_window)] | None = (
        None
    )
    window_mm: PerAxis | None = None
    overlap: Annotated[tuple[Overlap, Overlap, Overlap], BeforeValidator(_each_axis)] = (0.5, 0.5, 0.5)
    dt_s: Positive | None = None
    mask: Literal["channel"] | None = None
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] | None = None


class SquareDuct(Section):
    """Fully developed laminar flow along axis (x or y) through a square duct of width_mm.

    mean_velocity_m_s: the mean over its section. centre_mm: of every flow, in the volume's coordinates (default: 0).
    """

    kind: Literal["square_duct"]
    width_mm: Positive
    mean_velocity_m_s: float
    centre_mm: Vector = (0.0, 0.0, 0.0)
    axis: Literal["x", "y"] = "x"


class RigidRotation(Section):
    """angular_velocity_rad_s x (r - centre_mm) + velocity_m_s, right-handed about x, y, z."""

    kind: Literal["rigid_rotation"]
    angular_velocity_rad_s: Vector
    centre_mm: Vector = (0.0, 0.0, 0.0)
    velocity_m_s: Vector = (0.0, 0.0, 0.0)


class TaylorGreen(Section):
    """Vortices of amplitude_m_s and wavelength_mm in a plane (xy, xz, yz), four around centre_mm, plus velocity_m_s."""

    kind: Literal["taylor_green"]
    amplitude_m_s: float
    wavelength_mm: Positive
    centre_mm: Vector = (0.0, 0.0, 0.0)
    plane: Literal["xy", "xz", "yz"] = "xz"
    velocity_m_s: Vector = (0.0, 0.0, 0.0)


class Shear(Section):
    """A velocity along one axis that grows by rate_per_s across another, zero at centre_mm, plus velocity_m_s."""

    kind: Literal["shear"]
    rate_per_s: float
    along: Literal["x", "y", "z"] = "x"
    across: Literal["x", "y", "z"] = "z"
    centre_mm: Vector = (0.0, 0.0, 0.0)
    velocity_m_s: Vector = (0.0, 0.0, 0.0)


class Uniform(Section):
    """The same velocity_m_s everywhere."""

    kind: Literal["uniform"]
    velocity_m_s: Vector


FlowSection = Annotated[SquareDuct | RigidRotation | TaylorGreen | Shear | Uniform, Field(discriminator="kind")]


class SimulationSection(Section):
    """What `simulate` renders.

    Scene: flow (its centre in the volume's coordinates), frames (images of it, correlation.dt_s apart; 2 are a pair),
    particles (their number in the volume), particle_diameter_mm,
    brightness (range of each particle's light relative to particle_counts) or brightness_log_sigma (log-normal instead,
    of median 1), particle_counts (counts of a whole particle of brightness 1), mid_plane_z_mm (where the origin of a
    mid_plane volume lies behind the focal point; by default where Eq. 21 puts it for the board at board_z_mm).
    Board: board_z_mm, board_tilt_deg, board_offset_mm, board_rotation_deg.
    Camera as it really is: rotation_deg of the array (from the columns towards the rows), shift_px (columns, rows) and
    distortion_per_mm2.
    Sensor: peak_counts (of a pixel that sees only light, in white and board images), photons_per_count (null: no shot
    noise), read_noise_counts, dark_level_counts, bits.
    Tracing: refraction, rays per particle (null: as many as the noise needs), seed.
    """

    flow: FlowSection | None = None
    frames: Annotated[int, Field(ge=2, le=MOST_FRAMES)] = 2
    particles: Annotated[int, Field(ge=0, le=MOST_PARTICLES)] = 1000
    particle_diameter_mm: NotNegative = 0.05
    brightness: tuple[NotNegative, NotNegative] = (0.6, 1.4)
    brightness_log_sigma: NotNegative | None = None
    particle_counts: Positive = 500_000.0
    mid_plane_z_mm: float | None = None
    board_z_mm: float = 0.0
    board_tilt_deg: tuple[Angle, Angle] = (0.0, 0.0)
    board_offset_mm: Pair = (0.0, 0.0)
    board_rotation_deg: Angle = 0.0
    rotation_deg: Angle = 0.0
    shift_px: Pair = (0.0, 0.0)
    distortion_per_mm2: float = 0.0
    peak_counts: Positive = 28_000.0
    photons_per_count: Positive | None = 0.5
    read_noise_counts: NotNegative = 6.0
    dark_level_counts: NotNegative = 96.0
    bits: Annotated[int, Field(ge=1, le=16)] = 16
    refraction: Literal["exact", "paraxial"] = "exact"
    rays: Annotated[int, Field(ge=1)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0


class Limits(Section):
    """What `validate flow` must reach: shares, 0.05 for 5 %.

    streamwise_mean_error: largest |sum v / sum u - 1|; slice_mean_error: that of the worst of Table 4's six slices of a
    duct. smallest_slope: of measured on true, over the components that flow at all. within_25_percent_streamwise,
    within_25_percent_vector: smallest share of the windows with an error below a quarter of the true velocity.
    """

    streamwise_mean_error: NotNegative | None = None
    slice_mean_error: NotNegative | None = None
    smallest_slope: NotNegative | None = None
    within_25_percent_streamwise: Share | None = None
    within_25_percent_vector: Share | None = None


class ColumnLimits(Section):
    """What columns must reach against their reference: Eq. 16's SSIM, RMSE in grey levels of 255, L1."""

    ssim_smallest: Share | None = None
    rmse_grey_largest: NotNegative | None = None
    l1_mean: NotNegative | None = None
    l1_largest: NotNegative | None = None


class WeightsLimits(Section):
    """What `validate weights` must reach, by comparison."""

    ert_to_drt_paraxial: ColumnLimits = ColumnLimits()
    ert_to_drt_exact: ColumnLimits = ColumnLimits()
    ert_exact_to_drt_exact: ColumnLimits = ColumnLimits()
    factorised_to_converged: ColumnLimits = ColumnLimits()
    factorised_exact_to_converged: ColumnLimits = ColumnLimits()
    ray_count_to_converged: ColumnLimits = ColumnLimits()
    coarser_to_converged: ColumnLimits = ColumnLimits()
    factorised_to_long_count: ColumnLimits = ColumnLimits()
    ert_exact_to_long_count: ColumnLimits = ColumnLimits()


class WeightsValidation(Section):
    """What `validate weights` looks at: the paper's five voxels and `sample` random ones of the volume.

    long_count_rays: rays of long counts of each of the five (0: none), the independent check of what is integrated.
    """

    sample: Annotated[int, Field(ge=0, le=10_000)] = 20
    seed: Annotated[int, Field(ge=0)] = 1
    long_count_rays: Annotated[int, Field(ge=0)] = 0
    limits: WeightsLimits = WeightsLimits()


class BoardValidation(Section):
    """What `validate board` does.

    images: without faults (ideal), with the simulation's (recorded), or both. methods: ways to the weights, equivalent
    points (ert) and rays fitted to the boards (dlfc); or no weights, the dots fitted to the pictures as discs (discs).
    """

    images: Literal["ideal", "recorded", "both"] = "ideal"
    methods: Annotated[tuple[Literal["ert", "dlfc", "discs"], ...], Field(min_length=1)] = ("ert",)


class ValidationSection(Section):
    """The analytic flow that vectors are compared with (default: the simulation's), the limits, weights and boards.

    flow_methods: how `validate flow` measures what it simulates, by volumes and their correlation (volumes), by fitted
    tracers that are followed (particles), or both (default: both, but for particles where the weights are dlfc and
    for volumes where the solver is particles).
    """

    flow: FlowSection | None = None
    flow_methods: Annotated[tuple[Literal["volumes", "particles"], ...], Field(min_length=1)] | None = None
    limits: Limits = Limits()
    weights: WeightsValidation = WeightsValidation()
    board: BoardValidation = BoardValidation()


class Sections(Section):
    """The whole configuration as it stands in the file; `files.config.Config` says what is missing."""

    camera: CameraSection | None = None
    media: MediaSection | None = None
    window: WindowSection | None = None
    volume: VolumeSection | None = None
    board: BoardSection | None = None
    channel: ChannelSection | None = None
    weights: WeightsSection = WeightsSection()
    reconstruction: ReconstructionSection = ReconstructionSection()
    correlation: CorrelationSection = CorrelationSection()
    simulation: SimulationSection = SimulationSection()
    validation: ValidationSection = ValidationSection()
