"""The configuration: one strict YAML file, and what the commands ask of it.

All errors are reported in one run, each with its place: `rig.yaml:5:16: camera.microlenses.layuot: unknown key; did you
mean 'layout'?`
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.model import Calibration, Channel, Rig
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.files import sections as of_rig
from lfpiv_cli.files import sections_work as of_work
from lfpiv_cli.files.checks import validated
from lfpiv_cli.files.sections import UM_TO_MM, PipeSection, scene_of
from lfpiv_cli.files.sections_work import Sections, flow_of
from lfpiv_cli.files.yaml_nodes import Document, read_rig
from lfpiv_cli.flow.windows import CorrelationSettings, ParallelWalls, Triple, Walls
from lfpiv_cli.grid import FOCAL_POINT, Grid, Reference
from lfpiv_cli.names import Refraction
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media, Window, channel_window
from lfpiv_cli.optics.surfaces import SURFACES, Surface
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.registry import SOLVERS
from lfpiv_cli.reconstruction.solvers import SolverSettings, Stopping
from lfpiv_cli.synthetic.flows import Flow
from lfpiv_cli.weights.scene import Source

# Of the paper's final window along the axis with the smallest voxels; the coarse one is twice as large: a displacement
# of a quarter of its side does not leave it.
DEFAULT_WINDOW = 16
# Along an axis with longer voxels, where particle images are long: two of them fit.
SMALLEST_DEFAULT_WINDOW = 8
SMALLEST_WINDOW = 4

Lengths = tuple[float, float, float]


@dataclass(frozen=True)
class Config:
    """A configuration without contradictions.

    A section that the file leaves out and a command asks for is a `ConfigError` that names it.

    Attributes
    ----------
    sections : as they stand in the file, defaults filled in
    source : the file's name, for messages
    channel, pipe, weights, reconstruction, correlation, simulation, validation : the sections that may be left out
    """

    sections: Sections
    source: str
    channel: of_rig.ChannelSection | None = field(init=False)
    pipe: PipeSection | None = field(init=False)
    weights: of_work.WeightsSection = field(init=False)
    reconstruction: of_work.ReconstructionSection = field(init=False)
    correlation: of_work.CorrelationSection = field(init=False)
    simulation: of_work.SimulationSection = field(init=False)
    validation: of_work.ValidationSection = field(init=False)

    def __post_init__(self) -> None:
        """Take these out of the sections."""
        for each in fields(self)[2:]:
            object.__setattr__(self, each.name, getattr(self.sections, each.name))

    @classmethod
    def from_resolved(cls, resolved: Mapping[str, Any], source: str = "the stored config") -> Config:
        """Return the configuration that `resolved` described."""
        return Config(validated(Document(data=_tuples(resolved)), source), source)

    def resolved(self) -> dict[str, Any]:
        """Return everything, defaults included, as plain data for JSON."""
        return self.sections.model_dump(mode="json")

    def overridden(self, section: str, **options: Any) -> Config:
        """Return the configuration with the options of a section replaced; None leaves a value as it is.

        Raises
        ------
        ConfigError : the options contradict the rest
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
            section, **{each.name: getattr(options, each.name) for each in fields(options) if each.name in keys}
        )

    @property
    def camera(self) -> of_rig.CameraSection:
        """The section `camera`."""
        return self._needed("camera", self.sections.camera)

    @property
    def media(self) -> of_rig.MediaSection:
        """The section `media`."""
        return self._needed("media", self.sections.media)

    @property
    def volume(self) -> of_rig.VolumeSection:
        """The section `volume`."""
        return self._needed("volume", self.sections.volume)

    @property
    def board(self) -> of_rig.BoardSection:
        """The section `board`."""
        return self._needed("board", self.sections.board)

    def image_shape(self) -> tuple[int, int]:
        """Return the sensor's (rows, columns)."""
        return self.camera.sensor.rows, self.camera.sensor.columns

    def camera_model(self) -> Camera:
        """Return the camera as the data sheet has it, a lens centre on the axis."""
        camera: Camera = self._needed(f"camera.{self.camera.missing}", self.camera.model())
        return camera

    def micro_image_pitch_px(self) -> float:
        """Return the pitch of the lens images by the data sheet, of parallel light where the lens is not known."""
        camera, section = self.camera.model(), self.camera
        if camera is not None:
            return float(camera.micro_image_lattice_px().pitch.mean())
        return section.microlenses.pitch_mm / (section.sensor.pixel_um * UM_TO_MM)

    def media_model(self) -> Media:
        """Return the refractive indices."""
        return self.media.model()

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
        ConfigError : there is none, or a `scene` in its place
        """
        self.ensure_plane_layers("this command")
        if self.channel is None or mid_plane_z_mm is None:
            section = self._needed("window", self.sections.window)
            return Window(section.distance_mm, section.thickness_mm)
        wall = self.channel.width_mm, self.channel.wall_mm
        return channel_window(self.camera_model().focus_distance_mm, self.media_model(), *wall, mid_plane_z_mm)

    def object_space(self, mid_plane_z_mm: float | None = None) -> ObjectSpace | CurvedSpace:
        """Return what rays cross on their way to the lens: the faces of `scene`, else what `plane_space` gives.

        Through a scene rays are traced by Snell's law, whatever `weights` says of method (ert, drt) and refraction.

        Raises
        ------
        ConfigError : rays are fitted (dlfc), not traced
        """
        scene = self.scene_space()
        if scene is not None and self.weights.method != "dlfc":
            return scene
        return self.plane_space("tracing rays", mid_plane_z_mm)

    def ray_source(self, found: Calibration | None) -> Source:
        """Return how rays are found: traced through the configured object space, or as a calibration fitted them.

        Raises
        ------
        ConfigError : fitted rays are asked for and there are none
        """
        if self.weights.method != "dlfc":
            return self.object_space(found.mid_plane_z_mm if found else None)
        if found is None or found.ray_fit is None:
            raise ConfigError(
                "weights.method: dlfc needs a --calibration from boards at several depths: calibrate-snapshot with "
                "--board and --depth-mm, repeated in pairs"
            )
        return found.ray_fit.rays

    def scene_space(self) -> CurvedSpace | None:
        """Return the faces of `scene`, None where there is none."""
        scene = self.sections.scene
        return None if scene is None else scene_of(scene, self.media_model())

    def scene_fingerprint(self) -> str:
        """Return what tells the scene from another one: the SHA-256 of its faces."""
        faces = self._needed("scene", self.sections.scene)
        plain = [face.model_dump(mode="json", exclude={"file"}) for face in faces]
        return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()

    def with_scene_of(self, found: Calibration | None) -> Config:
        """Return the config with its scene where a calibration has found it to lie: moved as one body.

        The wall of its pipe is moved with the faces.

        Raises
        ------
        ConfigError : the calibration's is another scene, or a face cannot be turned
        """
        if found is None or found.scene is None:
            return self
        scene, motion = self.sections.scene, found.scene.motion
        if scene is None:
            raise ConfigError(f"{self.source}: scene: is missing, and the calibration tells where it lies")
        if self.scene_fingerprint() != found.scene.faces_sha256:
            raise ConfigError(
                f"{self.source}: scene: is not the one whose place the calibration tells; refine-calibration again, "
                "from a calibration that knows of no scene"
            )
        resolved, kinds = self.resolved(), {surface: kind for kind, surface in SURFACES.items()}
        resolved["scene"] = []
        for section in scene:
            surface: Surface = section.model(self.media_model()).surface
            moved: Any = surface.moved(motion)
            resolved["scene"].append({"kind": kinds[type(moved)], **asdict(moved), "behind": section.behind})
        if self.pipe is not None:
            axis = motion.direction(self.pipe.wall().direction.tolist())
            resolved["pipe"] |= {"centre_mm": motion.point(self.pipe.centre_mm), "axis": axis}
        return Config.from_resolved(resolved, f"{self.source} with the calibration's scene")

    def plane_space(self, what: str, mid_plane_z_mm: float | None = None) -> ObjectSpace:
        """Return plane layers, as `weights` has them; the window only where it is read.

        Raises
        ------
        ConfigError : rays are fitted (dlfc), not traced; or if there is a `scene`, which `what` cannot be done through
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
        """Refuse what is worked out for plane windows alone where the config has a `scene`."""
        if self.sections.scene is not None:
            raise ConfigError(
                f"{self.source}: scene: {what} is possible through plane windows (section window or channel) alone, "
                "not through the faces of a scene"
            )

    def grid(self, reference: Reference = FOCAL_POINT) -> Grid:
        """Return the volume's grid: z as in the config, or from the focal point where its reference is given."""
        chosen = self.volume.size_mm is not None
        return self.volume.grid(self.camera_model().scale(self.media_model()) if chosen else None, reference)

    def rig(self) -> Rig:
        """Return what must be known to read the picture of a board; a chessboard's points are its inner corners."""
        camera, media, board, channel = self.camera_model(), self.media_model(), self.board, self.channel
        points = board.dots if board.squares is None else (board.squares[0] - 1, board.squares[1] - 1)
        if points is None:
            raise ValueError("board.dots or board.squares is missing")
        reported = board.model_dump(exclude={"dots", "squares"})
        reported |= {name: reported[name] or 0.0 for name in ("dot_diameter_mm", "marker_mm")}
        return Rig(
            camera,
            media,
            BoardGeometry(dots=points, **reported),
            None if channel is None else Channel(**channel.model_dump(exclude={"no_slip"})),
            self.reconstruction.wave_light(),
        )

    def windows_voxel(self, voxel_mm: Lengths) -> tuple[Triple, ...]:
        """Return the correlation windows (x, y, z) in voxels, coarse to fine; `window_mm` is the final one of two.

        By default they are as long along all axes, as far as voxels of different sides allow.
        """
        section = self.correlation
        if section.windows is not None:
            return section.windows
        lengths, smallest = section.window_mm, SMALLEST_WINDOW
        if lengths is None:
            side = DEFAULT_WINDOW * min(voxel_mm)
            lengths, smallest = (side, side, side), SMALLEST_DEFAULT_WINDOW
        final = [max(smallest, round(length / voxel)) for length, voxel in zip(lengths, voxel_mm, strict=True)]
        return (2 * final[0], 2 * final[1], 2 * final[2]), (final[0], final[1], final[2])

    def overlap(self, voxel_mm: Lengths) -> Lengths:
        """Return the overlap of the final windows in voxels along x, y, z.

        Windows given as `window_mm` are whole voxels only nearly; their overlap is then what leaves the distance
        between them, and with it their number, as in mm.
        """
        section = self.correlation
        if section.window_mm is None:
            return section.overlap
        *_, final = self.windows_voxel(voxel_mm)
        x, y, z = (
            max(0.0, 1.0 - length * (1.0 - overlap) / (voxel * size))
            for length, overlap, voxel, size in zip(section.window_mm, section.overlap, voxel_mm, final, strict=True)
        )
        return x, y, z

    def masking_walls(self) -> Walls | None:
        """Return the walls beyond which `correlation.mask` leaves voxels and vectors out, None where it does not."""
        mask = self.correlation.mask
        if mask is None:
            return None
        section = self._needed(mask, getattr(self.sections, mask))
        return section.wall() if isinstance(section, PipeSection) else ParallelWalls(section.width_mm)

    def walls(self) -> Walls | None:
        """Return the walls about the fluid in the volume's coordinates, None where the config does not place them."""
        if self.pipe is not None:
            return self.pipe.wall()
        if self.channel is None or self.volume.reference != "mid_plane":
            return None
        return ParallelWalls(self.channel.width_mm)

    def still_walls(self) -> Walls | None:
        """Return the walls at which the fluid stands still, the pipe's or the channel's, None where neither is said."""
        if self.pipe is not None and self.pipe.no_slip:
            return self.pipe.wall()
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

    def correlation_settings(self, voxel_mm: Lengths) -> CorrelationSettings:
        """Return how volumes of such voxels are correlated: by a configured power, or the solver's default."""
        solver = SOLVERS.get(self.reconstruction.solver)
        chosen = {field.name: getattr(self.correlation, field.name) for field in fields(CorrelationSettings)}
        chosen["exponent"] = self.correlation.exponent or (solver.exponent if solver else 1.0)
        chosen |= {"windows": self.windows_voxel(voxel_mm), "overlap": self.overlap(voxel_mm)}
        return CorrelationSettings(**chosen)

    def simulated_flow(self, reference: Reference = FOCAL_POINT) -> Flow:
        """Return the flow to render, a function of points: z as in the config, or from the focal point as in `grid`."""
        return flow_of(self._needed("simulation.flow", self.simulation.flow), reference)

    def true_flow(self) -> Flow:
        """Return the flow to compare with, in the volume's coordinates: `validation.flow`, else the simulation's."""
        flow: of_work.FlowSection | None = self.validation.flow or self.simulation.flow
        return flow_of(self._needed("validation.flow", flow), FOCAL_POINT)

    def flow_methods(self) -> tuple[str, ...]:
        """Return how a simulated flow is measured: as `validation.flow_methods` has it, else every possible way.

        Raises
        ------
        ConfigError : volumes are asked for and the solver makes none
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
            raise ConfigError(f"{self.source}: {key}: is missing, and this command needs it")
        return section


def load_rig(path: Path | str) -> Config:
    """Read a rig: the YAML file of camera, media, volume and settings that the commands take as CONFIG.

    Heights of faces are read from the files beside it.

    Returns
    -------
    Config
        With every default filled in; `resolved()` gives it as plain data.

    Raises
    ------
    ConfigError
        Anything in it is malformed, unknown, contradictory or impossible; all errors at once, each with its line.
    InputError
        The file is missing or not a file.
    """
    return Config(validated(read_rig(Path(path)), str(path)), str(path))


def carried_config(record: Mapping[str, Any], source: Path | str) -> Config:
    """Return the resolved configuration in the record that one of our files carries.

    What tracking chose beside it stands in the same place of the record, and is left out.

    Raises
    ------
    InputError : there is none
    """
    config = record.get("config")
    if not config:
        raise InputError(f"{source}: carries no config; give one with --config")
    return Config.from_resolved({name: value for name, value in config.items() if name in Sections.model_fields})


def _tuples(value: Any) -> Any:
    """Return plain data with its lists as tuples, as the YAML reader gives them."""
    if isinstance(value, Mapping):
        return {key: _tuples(item) for key, item in value.items()}
    return tuple(_tuples(item) for item in value) if isinstance(value, (list, tuple)) else value
