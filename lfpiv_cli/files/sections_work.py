"""The sections of what is done with a rig, flows, what `simulate` and `validate` do; and all sections together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from inspect import getdoc, signature
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_type_hints

from pydantic import Field, create_model

from lfpiv_cli import names
from lfpiv_cli.calibration.wave_shapes import WaveLight
from lfpiv_cli.files import sections as of_rig
from lfpiv_cli.files.sections import NM_TO_MM, Diffusion, NotNegative, Pair, Positive, Section, Share, Vector
from lfpiv_cli.grid import Reference
from lfpiv_cli.names import Refraction
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.reconstruction.registry import SolverName
from lfpiv_cli.synthetic.flows import FLOWS, Flow

# Each point is carried by all of them: of more, a frame of many tracers takes gigabytes.
MOST_MODES = 2000
# Of the aperture: beyond this the corners see next to nothing.
MOST_VIGNETTING = 0.9


class WeightsSection(Section):
    """How weights are made.

    method: equivalent points (ert); rays traced through window and fluid (drt), which reads the window's distance; or
    polynomials fitted to boards at several depths (dlfc), which the calibration holds.
    refraction: paraxial, or Snell's law with its aberration (exact), which needs the thickness of what lies before the
    points: the section window, or channel with a calibrated mid plane. sampling: integrals (exact), or the paper's
    count of rays_per_point rays from each of `points` random points of a voxel (rays), seeded; for small volumes only.
    """

    method: names.Method = "ert"
    refraction: Refraction = "paraxial"
    sampling: names.Sampling = "exact"
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
    start: names.Start = "uniform"
    stop_change: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    stop_noise: Positive | None = None
    photons_per_count: Positive | None = None
    saturation_counts: Positive | None = None
    particle_diameter_mm: Positive | None = None
    wavelength_nm: of_rig.Wavelength | None = None
    diffusion_px: Diffusion | None = None
    iterations: Annotated[int, Field(ge=1, le=100_000)] = 24
    relaxation: Annotated[float, Field(gt=0.0, le=2.0)] = 1.0
    accelerate: bool = True
    padding_voxel: (
        tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] | None
    ) = None

    def wave_light(self) -> WaveLight | None:
        """Return the waves that images are read by, None where they are read by rays."""
        if self.wavelength_nm is None:
            return None
        diffusion_px = USUAL_DIFFUSION_PX if self.diffusion_px is None else self.diffusion_px
        return WaveLight(self.wavelength_nm * NM_TO_MM, diffusion_px)


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

    windows: of_rig.Windows | None = None
    window_mm: of_rig.PerAxis | None = None
    overlap: of_rig.Overlaps = (0.5, 0.5, 0.5)
    dt_s: Positive | None = None
    mask: names.Mask | None = None
    exponent: Annotated[float, Field(gt=0.0, le=1.0)] | None = None
    weighting: names.Weighting = "uniform"


@dataclass(frozen=True, kw_only=True)
class CorrelationKeys:
    """Keys of the section `correlation` that options take the place of; None leaves a key as it is."""

    dt_s: float | None = None
    windows: Sequence[int | Sequence[int]] | None = None
    overlap: float | Sequence[float] | None = None
    weighting: names.Weighting | None = None


# What a flow's parameter may be, by its name; by its type in the factory's signature. Lengths are positive.
OF_FLOWS: dict[str, Any] = {
    "rms_m_s": NotNegative,
    "modes": Annotated[int, Field(ge=1, le=MOST_MODES)],
    "seed": Annotated[int, Field(ge=0)],
}
OF_TYPES: dict[Any, Any] = {Sequence[float]: Vector, Literal["x", "y"] | Sequence[float]: of_rig.PipeAxis}


def flow_section(factory: Callable[..., Flow]) -> type[Section]:
    """Return the section of a flow: its `kind`, the factory's name, and the factory's parameters with their defaults.

    What it says of itself is the factory's docstring, up to its notes.
    """
    hints, fields = get_type_hints(factory), dict[str, Any](kind=(Literal[factory.__name__], ...))
    for name, parameter in signature(factory).parameters.items():
        by_type = Positive if hints[name] is float and name.endswith("_mm") else OF_TYPES.get(hints[name], hints[name])
        default = ... if parameter.default is parameter.empty else parameter.default
        fields[name] = (OF_FLOWS.get(name, by_type), default)
    title = factory.__name__.title().replace("_", "")
    said = (getdoc(factory) or "").partition("\n\nNotes\n")[0]
    return create_model(title, __base__=Section, __doc__=said, **fields)


if TYPE_CHECKING:
    FlowSection = Any
else:
    FlowSection = Annotated[Union[tuple(map(flow_section, FLOWS.values()))], Field(discriminator="kind")]  # noqa: UP007


def flow_of(section: FlowSection, reference: Reference) -> Flow:
    """Return a flow as a function of points, z from the focal point, where the section counts z from a reference."""
    parameters = section.model_dump(exclude={"kind"})
    if "centre_mm" in parameters:
        x, y, z = parameters["centre_mm"]
        parameters["centre_mm"] = (x, y, reference.depth_to_focal_point(z))
    return FLOWS[section.kind](**parameters)


class PulsationSection(Section):
    """A flow that is faster and slower by turns, everywhere alike: times 1 + amplitude sin(2 pi frequency_hz t).

    t counts from the middle of the pair or sequence, where the flow is as its own keys say and accelerates most.
    """

    amplitude: float
    frequency_hz: Positive


class RaysSection(Section):
    """Light as rays, which geometry alone leads."""

    kind: Literal["rays"] = "rays"

    def waves(self) -> Waves | None:
        """Return the waves that light is made of: none."""
        return None


class WavesSection(Section):
    """Light of one wavelength_nm (in air) as scalar waves, which main lens and microlenses diffract.

    points: of each tracer, which shine for themselves, evenly spread over its ball; one where its diameter is 0.
    Default: as many as the camera does not resolve, 62 of 0.05 mm with Table 2's; of fewer two tracers may be found.
    """

    kind: Literal["waves"]
    wavelength_nm: of_rig.Wavelength = 532.0
    points: Annotated[int, Field(ge=3, le=1000)] | None = None

    def waves(self) -> Waves | None:
        """Return the waves that light is made of."""
        return Waves(self.wavelength_nm * NM_TO_MM, self.points)


class ObjectiveSection(Section):
    """How the simulated camera departs from a thin lens before an array that is parallel to the sensor.

    In the corners of the sensor: vignetting (share of the aperture that the barrel cuts off, which begins in the
    middle), falloff (share of the light that is lost besides, as the square of the image height), field_curvature_mm
    (how far behind the array the image lies, as the square of the image height) and astigmatism_mm (how much further
    that of the aperture's radial diameter). array_tilt_deg: by which the array's distance from the sensor grows along
    the columns and along the rows, about the sensor's middle.
    """

    vignetting: Annotated[float, Field(ge=0.0, le=MOST_VIGNETTING)] = 0.0
    falloff: Annotated[float, Field(ge=0.0, lt=1.0)] = 0.0
    field_curvature_mm: float = 0.0
    astigmatism_mm: float = 0.0
    array_tilt_deg: tuple[of_rig.Angle, of_rig.Angle] = (0.0, 0.0)


LightSection = Annotated[RaysSection | WavesSection, Field(discriminator="kind")]


class SimulationSection(Section):
    """What `simulate` renders.

    Scene: flow (its centre in the volume's coordinates), frames (images of it, correlation.dt_s apart; 2 are a pair),
    pulsation (how the flow changes in time; null: it is steady), light_z_mm (range of depths that are lit, in the
    volume's coordinates and between a channel's walls: tracers come into the light and leave it; null: those seeded
    about the volume shine wherever they are), particles (their number in the volume, where it is lit),
    particle_diameter_mm, particle_diameter_log_sigma (diameters are log-normal, of that median, and light goes with
    their squares), brightness_flicker (relative standard deviation of a particle's light from frame to frame),
    brightness (range of each particle's light relative to particle_counts) or brightness_log_sigma (log-normal instead,
    of median 1), particle_counts (counts of a whole particle of brightness 1), mid_plane_z_mm (where the origin of a
    mid_plane volume lies behind the focal point; by default where Eq. 21 puts it for the board at board_z_mm).
    Bubbles that stick to a wall of a square duct: bubbles (their number), bubble_diameter_mm (range), bubble_counts (of
    a pixel that sees only the middle of one), bubble_wall (near or far across the depth, low or high across the other
    axis).
    Board: board_z_mm, board_tilt_deg, board_offset_mm, board_rotation_deg.
    Camera as it really is: rotation_deg of the array (from the columns towards the rows), shift_px (columns, rows),
    distortion_per_mm2 and objective.
    Sensor: peak_counts (of a pixel that sees only light, in white and board images), photons_per_count (null: no shot
    noise), read_noise_counts, dark_level_counts, bits.
    Tracing: light (made of rays, or of waves), refraction (exact or paraxial), rays per particle (null: as many as the
    noise needs), seed.
    """

    flow: FlowSection | None = None
    frames: Annotated[int, Field(ge=2, le=of_rig.MOST_FRAMES)] = 2
    pulsation: PulsationSection | None = None
    light_z_mm: Pair | None = None
    particles: Annotated[int, Field(ge=0, le=of_rig.MOST_PARTICLES)] = 1000
    particle_diameter_mm: NotNegative = 0.05
    particle_diameter_log_sigma: NotNegative = 0.0
    brightness: tuple[NotNegative, NotNegative] = (0.6, 1.4)
    brightness_log_sigma: NotNegative | None = None
    brightness_flicker: NotNegative = 0.0
    particle_counts: Positive = 500_000.0
    mid_plane_z_mm: float | None = None
    bubbles: Annotated[int, Field(ge=0, le=of_rig.MOST_BUBBLES)] = 0
    bubble_diameter_mm: tuple[Positive, Positive] = (0.3, 0.8)
    bubble_counts: Positive = 200_000.0
    bubble_wall: names.BubbleWall = "high"
    board_z_mm: float = 0.0
    board_tilt_deg: tuple[of_rig.Angle, of_rig.Angle] = (0.0, 0.0)
    board_offset_mm: Pair = (0.0, 0.0)
    board_rotation_deg: of_rig.Angle = 0.0
    rotation_deg: of_rig.Angle = 0.0
    shift_px: Pair = (0.0, 0.0)
    distortion_per_mm2: float = 0.0
    objective: ObjectiveSection = ObjectiveSection()
    peak_counts: Positive = 28_000.0
    photons_per_count: Positive | None = 0.5
    read_noise_counts: NotNegative = 6.0
    dark_level_counts: NotNegative = 96.0
    bits: Annotated[int, Field(ge=1, le=16)] = 16
    light: LightSection = RaysSection()
    refraction: Refraction = "exact"
    rays: Annotated[int, Field(ge=1)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0


class Limits(Section):
    """What `validate flow` must reach: shares, 0.05 for 5 %.

    streamwise_mean_error: largest |sum v / sum u - 1|; slice_mean_error: that of the worst of Table 4's six slices of a
    duct. smallest_slope: of measured on true, over the components that flow at all. within_25_percent_streamwise,
    within_25_percent_vector: smallest share of the windows with an error below a quarter of the true velocity;
    within_25_percent_vector_inner: of those up to 0.9 of a pipe's radius.
    """

    streamwise_mean_error: NotNegative | None = None
    slice_mean_error: NotNegative | None = None
    smallest_slope: NotNegative | None = None
    within_25_percent_streamwise: Share | None = None
    within_25_percent_vector: Share | None = None
    within_25_percent_vector_inner: Share | None = None


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

    images: names.BoardImages = "ideal"
    methods: Annotated[tuple[names.BoardMethod, ...], Field(min_length=1)] = ("ert",)


class ValidationSection(Section):
    """The analytic flow that vectors are compared with (default: the simulation's), the limits, weights and boards.

    flow_methods: how `validate flow` measures what it simulates, by volumes and their correlation (volumes), by fitted
    tracers that are followed (particles), or both (default: both, but for particles where the weights are dlfc and
    for volumes where the solver is particles).
    """

    flow: FlowSection | None = None
    flow_methods: Annotated[tuple[names.FlowMethod, ...], Field(min_length=1)] | None = None
    limits: Limits = Limits()
    weights: WeightsValidation = WeightsValidation()
    board: BoardValidation = BoardValidation()


class Sections(Section):
    """The whole configuration as it stands in the file; `files.config.Config` says what is missing."""

    camera: of_rig.CameraSection | None = None
    media: of_rig.MediaSection | None = None
    window: of_rig.WindowSection | None = None
    scene: Annotated[tuple[of_rig.FaceSection, ...], Field(min_length=1)] | None = None
    volume: of_rig.VolumeSection | None = None
    board: of_rig.BoardSection | None = None
    channel: of_rig.ChannelSection | None = None
    pipe: of_rig.PipeSection | None = None
    weights: WeightsSection = WeightsSection()
    reconstruction: ReconstructionSection = ReconstructionSection()
    correlation: CorrelationSection = CorrelationSection()
    simulation: SimulationSection = SimulationSection()
    validation: ValidationSection = ValidationSection()
