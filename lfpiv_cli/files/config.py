"""The configuration: one strict YAML file, and what the commands ask of it.

All errors are reported in one run, each with its place: `rig.yaml:5:16: camera.microlenses.layuot: unknown key; did you
mean 'layout'?`
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from lfpiv_cli.calibration.model import Calibration, Channel, Rig
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files import bench
from lfpiv_cli.files.bench import ensure_same, fingerprint, moved_faces, moved_pipe
from lfpiv_cli.files.checks import contradictions
from lfpiv_cli.files.inputs import content_of, ensure_regular_file, opened
from lfpiv_cli.files.sections import (
    BoardSection,
    CameraSection,
    ChannelSection,
    CorrelationSection,
    MediaSection,
    PipeSection,
    ReconstructionSection,
    VolumeSection,
    WeightsSection,
)
from lfpiv_cli.files.sections_simulated import FlowSection, Sections, SimulationSection, ValidationSection
from lfpiv_cli.files.yaml_nodes import (
    LARGEST_BYTES,
    Document,
    Problem,
    YamlError,
    key_name,
    place_of,
    problem_of,
    read_document,
    report,
    sentence,
    with_heights,
)
from lfpiv_cli.flow.windows import CorrelationSettings, ParallelWalls, Walls
from lfpiv_cli.grid import Grid
from lfpiv_cli.names import Refraction
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media, Window, channel_window
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.registry import SOLVERS
from lfpiv_cli.reconstruction.solvers import SolverSettings, Stopping
from lfpiv_cli.reference import FOCAL_POINT, Reference
from lfpiv_cli.synthetic.vortices import Flow

# Images and HDF5 files have a zero byte among their first ones, and no text has.
BEGINNING_BYTES = 512


@dataclass(frozen=True)
class Config:
    """A configuration without contradictions.

    A section that the file leaves out and a command asks for is a `ConfigError` that names it.

    Attributes
    ----------
    sections : as they stand in the file, defaults filled in
    source : the file's name, for messages
    """

    sections: Sections
    source: str

    @classmethod
    def from_resolved(cls, resolved: Mapping[str, Any], source: str = "the stored config") -> Config:
        """Return the configuration that `resolved` described.

        Raises
        ------
        ConfigError
        """
        return _validated(Document(data=_tuples(resolved)), source)

    def resolved(self) -> dict[str, Any]:
        """Return everything, defaults included, as plain data for JSON."""
        return self.sections.model_dump(mode="json")

    def overridden(self, section: str, **options: Any) -> Config:
        """Return the configuration with the options of a section replaced; None leaves a value as it is.

        Raises
        ------
        ConfigError
            If the options contradict the rest.
        """
        given = {name: value for name, value in options.items() if value is not None}
        if not given:
            return self
        resolved = self.resolved()
        resolved[section] |= given
        if "windows" in given:
            resolved[section]["window_mm"] = None
        return Config.from_resolved(resolved, f"{self.source} with the options given")

    def overridden_by(self, section: str, options: Any) -> Config:
        """Return the configuration with a section's keys replaced by a dataclass's fields of the same names.

        A field that is None leaves its key as it is; other fields say nothing of the section.
        """
        keys = type(getattr(self.sections, section)).model_fields
        return self.overridden(
            section, **{field.name: getattr(options, field.name) for field in fields(options) if field.name in keys}
        )

    @property
    def camera(self) -> CameraSection:
        """The section `camera`."""
        return self._needed("camera", self.sections.camera)

    @property
    def media(self) -> MediaSection:
        """The section `media`."""
        return self._needed("media", self.sections.media)

    @property
    def volume(self) -> VolumeSection:
        """The section `volume`."""
        return self._needed("volume", self.sections.volume)

    @property
    def board(self) -> BoardSection:
        """The section `board`."""
        return self._needed("board", self.sections.board)

    @property
    def channel(self) -> ChannelSection | None:
        """The section `channel`, None where there is none."""
        return self.sections.channel

    @property
    def pipe(self) -> PipeSection | None:
        """The section `pipe`, None where there is none."""
        return self.sections.pipe

    @property
    def weights(self) -> WeightsSection:
        """The section `weights`."""
        return self.sections.weights

    @property
    def reconstruction(self) -> ReconstructionSection:
        """The section `reconstruction`."""
        return self.sections.reconstruction

    @property
    def correlation(self) -> CorrelationSection:
        """The section `correlation`."""
        return self.sections.correlation

    @property
    def simulation(self) -> SimulationSection:
        """The section `simulation`."""
        return self.sections.simulation

    @property
    def validation(self) -> ValidationSection:
        """The section `validation`."""
        return self.sections.validation

    def image_shape(self) -> tuple[int, int]:
        """Return the sensor's (rows, columns)."""
        return self.camera.sensor.rows, self.camera.sensor.columns

    def camera_model(self) -> Camera:
        """Return the camera as the data sheet has it, a lens centre on the axis."""
        section = self.camera
        missing = bench.missing_for_camera(section)
        if missing is not None:
            raise self._missing(f"camera.{missing}")
        return bench.camera_of(section)

    def complete_camera(self) -> Camera | None:
        """Return the camera as the data sheet has it, None where it lacks a length."""
        return None if bench.missing_for_camera(self.camera) is not None else bench.camera_of(self.camera)

    def micro_image_pitch_px(self) -> float:
        """Return the pitch of the lens images by the data sheet."""
        return bench.micro_image_pitch_px(self.camera)

    def media_model(self) -> Media:
        """Return the refractive indices."""
        return bench.media_of(self.media)

    def fluid_density_kg_m3(self) -> float:
        """Return the fluid's density."""
        return float(self._needed("media.fluid_density_kg_m3", self.media.fluid_density_kg_m3))

    def fluid_viscosity_pa_s(self) -> float:
        """Return the fluid's dynamic viscosity."""
        return float(self._needed("media.fluid_viscosity_pa_s", self.media.fluid_viscosity_pa_s))

    def window_model(self, mid_plane_z_mm: float | None = None) -> Window:
        """Return the window: the channel's wall where its mid plane's depth is given, else the section `window`.

        Raises
        ------
        ConfigError
            If there is none, or a `scene` in its place.
        """
        self.ensure_plane_layers("this command")
        if self.channel is not None and mid_plane_z_mm is not None:
            wall = self.channel.width_mm, self.channel.wall_mm
            return channel_window(self.camera_model().focus_distance_mm, self.media_model(), *wall, mid_plane_z_mm)
        section = self._needed("window", self.sections.window)
        return Window(section.distance_mm, section.thickness_mm)

    def object_space(self, mid_plane_z_mm: float | None = None) -> ObjectSpace | CurvedSpace:
        """Return what rays cross on their way to the lens: the faces of `scene`, else what `plane_space` gives.

        Through a scene rays are traced by Snell's law, whatever `weights` says of method (ert, drt) and refraction.

        Raises
        ------
        ConfigError
            If rays are fitted (dlfc), not traced.
        """
        scene = self.scene_space()
        if scene is not None and self.weights.method != "dlfc":
            return scene
        return self.plane_space("tracing rays", mid_plane_z_mm)

    def scene_space(self) -> CurvedSpace | None:
        """Return the faces of `scene`, None where there is none."""
        scene = self.sections.scene
        return None if scene is None else bench.scene_of(scene, self.media_model())

    def scene_fingerprint(self) -> str:
        """Return what tells the scene from another one.

        Raises
        ------
        ConfigError : there is none
        """
        return fingerprint(self._needed("scene", self.sections.scene))

    def with_scene_of(self, found: Calibration | None) -> Config:
        """Return the config with its scene, and the wall of its pipe, where a calibration has found them to lie.

        Raises
        ------
        ConfigError
            If the calibration's is another scene.
        """
        if found is None or found.scene is None:
            return self
        scene, motion = self.sections.scene, found.scene.motion
        ensure_same(scene, found.scene.faces_sha256, self.source)
        resolved = self.resolved()
        resolved["scene"] = moved_faces(scene or (), self.media, motion)
        if self.pipe is not None:
            resolved["pipe"] = moved_pipe(self.pipe, motion)
        return Config.from_resolved(resolved, f"{self.source} with the calibration's scene")

    def plane_space(self, what: str, mid_plane_z_mm: float | None = None) -> ObjectSpace:
        """Return plane layers, as `weights` has them; the window only where it is read.

        Raises
        ------
        ConfigError
            If rays are fitted (dlfc), not traced; or if there is a `scene`, which `what` cannot be done through.
        """
        chosen = self.weights
        if chosen.method == "dlfc":
            raise ConfigError(f"{self.source}: weights.method: is dlfc, which traces no rays; expected ert or drt")
        self.ensure_plane_layers(what)
        reads_window = chosen.method == "drt" or chosen.refraction == "exact"
        window = self.window_model(mid_plane_z_mm) if reads_window else None
        return ObjectSpace(self.media_model(), window, chosen.refraction, chosen.method)

    def refraction(self) -> Refraction:
        """Return how rays are refracted: through a scene exactly, else as `weights` has it."""
        return self.weights.refraction if self.sections.scene is None else "exact"

    def ensure_plane_layers(self, what: str) -> None:
        """Refuse what is worked out for plane windows alone where the config has a `scene`.

        Raises
        ------
        ConfigError
        """
        if self.sections.scene is not None:
            raise ConfigError(
                f"{self.source}: scene: {what} is possible through plane windows (section window or channel) alone, "
                "not through the faces of a scene"
            )

    def grid(self, reference: Reference = FOCAL_POINT) -> Grid:
        """Return the volume's grid: z as in the config, or from the focal point where its reference is given."""
        chosen = self.volume.size_mm is not None
        scale = self.camera_model().scale(self.media_model()) if chosen else None
        return bench.grid_of(self.volume, scale, reference)

    def rig(self) -> Rig:
        """Return what must be known to read the picture of a board."""
        channel = None if self.channel is None else Channel(**self.channel.model_dump(exclude={"no_slip"}))
        light = bench.wave_light_of(self.reconstruction)
        return Rig(self.camera_model(), self.media_model(), bench.board_of(self.board), channel, light)

    def windows_voxel(self, voxel_mm: tuple[float, float, float]) -> tuple[tuple[int, int, int], ...]:
        """Return the correlation windows (x, y, z) in voxels, coarse to fine."""
        return bench.windows_of(self.correlation, voxel_mm)

    def overlap(self, voxel_mm: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the overlap of the correlation windows along x, y, z."""
        return bench.overlap_of(self.correlation, voxel_mm)

    def masking_walls(self) -> Walls | None:
        """Return the walls beyond which `correlation.mask` leaves voxels and vectors out, None where it does not."""
        mask = self.correlation.mask
        if mask is None:
            return None
        section = self._needed(mask, getattr(self.sections, mask))
        return bench.round_wall_of(section) if isinstance(section, PipeSection) else ParallelWalls(section.width_mm)

    def still_walls(self) -> Walls | None:
        """Return the walls at which the fluid stands still, the pipe's or the channel's, None where neither is said."""
        if self.pipe is not None and self.pipe.no_slip:
            return bench.round_wall_of(self.pipe)
        return ParallelWalls(self.channel.width_mm) if self.channel is not None and self.channel.no_slip else None

    def solver_settings(self) -> SolverSettings:
        """Return how volumes are reconstructed."""
        chosen = self.reconstruction
        return SolverSettings(
            chosen.solver,
            chosen.iterations,
            chosen.relaxation,
            chosen.accelerate,
            chosen.start,
            Stopping(chosen.stop_change, None, chosen.stop_noise, chosen.photons_per_count),
        )

    def correlation_exponent(self) -> float:
        """Return the power of the intensities that is correlated: the configured one, or the solver's default."""
        solver = SOLVERS.get(self.reconstruction.solver)
        return self.correlation.exponent or (solver.exponent if solver else 1.0)

    def correlation_settings(self, voxel_mm: tuple[float, float, float]) -> CorrelationSettings:
        """Return how volumes of such voxels are correlated."""
        chosen = {field.name: getattr(self.correlation, field.name) for field in fields(CorrelationSettings)}
        chosen |= {"windows": self.windows_voxel(voxel_mm), "overlap": self.overlap(voxel_mm)}
        return CorrelationSettings(**chosen | {"exponent": self.correlation_exponent()})

    def simulated_flow(self, reference: Reference = FOCAL_POINT) -> Flow:
        """Return the flow to render, a function of points: z as in the config, or from the focal point as in `grid`."""
        return bench.flow_of(self._needed("simulation.flow", self.simulation.flow), reference)

    def true_flow(self) -> Flow:
        """Return the flow to compare with, in the volume's coordinates: `validation.flow`, else the simulation's."""
        flow: FlowSection | None = self.validation.flow or self.simulation.flow
        return bench.flow_of(self._needed("validation.flow", flow), FOCAL_POINT)

    def flow_methods(self) -> tuple[str, ...]:
        """Return how a simulated flow is measured: as `validation.flow_methods` has it, else every possible way.

        Raises
        ------
        ConfigError
            If volumes are asked for and the solver makes none.
        """
        asked, makes_volumes = self.validation.flow_methods, self.reconstruction.solver != "particles"
        if asked is None:
            fits_particles = self.weights.method != "dlfc"
            return ("volumes",) * makes_volumes + ("particles",) * fits_particles
        if "volumes" in asked and not makes_volumes:
            raise ConfigError(
                f"{self.source}: validation.flow_methods: holds volumes, but reconstruction.solver is particles"
            )
        return asked

    def _needed(self, key: str, section: Any) -> Any:
        if section is None:
            raise self._missing(key)
        return section

    def _missing(self, key: str) -> ConfigError:
        return ConfigError(f"{self.source}: {key}: is missing, and this command needs it")


def load_config(path: Path) -> Config:
    """Read a configuration, and the heights of faces in files beside it.

    Raises
    ------
    ConfigError
        If anything in it is malformed, unknown, contradictory or impossible; all errors at once.
    InputError
        If the file is missing or not a file.
    """
    size = ensure_regular_file(path)
    _ensure_text(path)
    if size > LARGEST_BYTES:
        raise ConfigError(f"{path}: has {size} bytes, expected at most {LARGEST_BYTES}")
    content = content_of(path)
    try:
        document = read_document(content)
    except YamlError as error:
        raise ConfigError(sentence(str(path), error.problem)) from error
    return _validated(with_heights(document, path), str(path))


def _ensure_text(path: Path) -> None:
    """Refuse an image, or another binary file of a kind that commands take in other places, by what it is.

    Raises
    ------
    ConfigError
    """
    with opened(path) as file:
        if b"\0" not in file.read(BEGINNING_BYTES):
            return
    from lfpiv_cli.files.images import format_of

    try:
        kind = format_of(path).name
    except InputError:
        return  # what is no text is told where it is read
    raise ConfigError(f"{path}: is {'an HDF5 file' if kind == 'HDF5' else f'an image ({kind})'}; expected a rig file")


def carried_config(record: Mapping[str, Any], source: Path | str) -> Config:
    """Return the resolved configuration in the record that one of our files carries.

    What tracking chose beside it stands in the same place of the record, and is left out.

    Raises
    ------
    InputError
        If there is none.
    """
    config = record.get("config")
    if not config:
        raise InputError(f"{source}: carries no config; give one with --config")
    return Config.from_resolved({name: value for name, value in config.items() if name in Sections.model_fields})


def _validated(document: Document, source: str) -> Config:
    """Return the configuration of a document, or raise all that is wrong with it."""
    if document.data and not document.problems and not document.data.keys() & Sections.model_fields.keys():
        first = ", ".join(map(str, list(document.data)[:3]))
        raise ConfigError(f"{source}: is no rig file: it has {first}, expected {', '.join(Sections.model_fields)}")
    problems = list(document.problems)
    sections = None
    try:
        sections = Sections.model_validate(document.data)
    except ValidationError as error:
        problems += [problem_of(document, details) for details in error.errors()]
    if sections is not None:
        problems += [
            Problem(*place_of(document, path), key_name(path), text) for path, text in contradictions(sections)
        ]
    if problems or sections is None:
        raise ConfigError(report(source, problems))
    return Config(sections, source)


def _tuples(value: Any) -> Any:
    """Return plain data with its lists as tuples, as the YAML reader gives them."""
    if isinstance(value, Mapping):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, (list, tuple)) else value
