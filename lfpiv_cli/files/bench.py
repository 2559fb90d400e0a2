"""From the sections of the configuration to the objects that the core works with.

What a section leaves out and another of its keys implies (an aperture from an f-number) is worked out here, once.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.wave_shapes import WaveLight
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.sections import (
    BoardSection,
    CameraSection,
    CorrelationSection,
    FaceSection,
    MainLens,
    MediaSection,
    Microlenses,
    PipeSection,
    ReconstructionSection,
    VolumeSection,
    parameters_of,
)
from lfpiv_cli.files.sections_simulated import FlowSection, LightSection
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice, thin_lens
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.shapes import RigidMotion
from lfpiv_cli.optics.surfaces import SURFACES
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.reference import Reference
from lfpiv_cli.scale import Scale
from lfpiv_cli.synthetic.flows import FLOWS, Flow

UM_TO_MM, NM_TO_MM = 1e-3, 1e-6
# Of the paper's final window along the axis with the smallest voxels; the coarse one is twice as large: a displacement
# of a quarter of its side does not leave it.
DEFAULT_WINDOW = 16
# Along an axis with longer voxels, where particle images are long: two of them fit.
SMALLEST_DEFAULT_WINDOW = 8
SMALLEST_WINDOW = 4
DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}
# Voxels as wide as a microlens lock depth to the array's grid and swallow its velocity: of 0.6 mm EM volumes give 0.22
# with them. With half of one laterally and two along the axis they give nine tenths, with a third 0.98 to 1.02 and a
# third less spread; a quarter gains no more. Along the axis the depth over which light spreads by one lens counts: two
# microlenses of Table 2 are 0.2 mm of 1.064 mm.
LATERAL_VOXELS_PER_MICROLENS = 3.0
VOXELS_PER_DEPTH = 1.064 / 0.2

Triple = tuple[int, int, int]
Lengths = tuple[float, float, float]


def focal_length_mm(lens: MainLens) -> float | None:
    """Return F_m, given or from S_i = F_m (P - M)."""
    if lens.focal_length_mm is not None or lens.image_distance_mm is None:
        return lens.focal_length_mm
    return lens.image_distance_mm / (lens.pupil_ratio - lens.magnification)


def entrance_over_exit(lens: MainLens) -> float:
    """Return 1/P, 0 of a lens that is telecentric towards the array."""
    return 0.0 if lens.image_distance == "infinite" else 1.0 / lens.pupil_ratio


def aperture_mm(lens: MainLens) -> float | None:
    """Return p_m, given or from the f-number F_m / p_m."""
    focal_length = focal_length_mm(lens)
    if lens.aperture_mm is not None or lens.f_number is None or focal_length is None:
        return lens.aperture_mm
    return focal_length / lens.f_number


def microlens_focal_length_mm(lens: Microlenses) -> float | None:
    """Return f_m, given or from the f-number f_m / p_l."""
    if lens.focal_length_mm is not None or lens.f_number is None:
        return lens.focal_length_mm
    return lens.f_number * lens.pitch_mm


def missing_for_camera(section: CameraSection) -> str | None:
    """Return the first key that a whole camera lacks, None where nothing is missing."""
    lens = section.main_lens
    if lens is None:
        return "main_lens"
    if focal_length_mm(lens) is None:
        return "main_lens.focal_length_mm"
    if aperture_mm(lens) is None:
        return "main_lens.aperture_mm"
    return "microlenses.focal_length_mm" if microlens_focal_length_mm(section.microlenses) is None else None


def camera_of(section: CameraSection) -> Camera:
    """Return the camera of a section that lacks nothing, a lens centre on the axis, its thin lens for the real one."""
    lens, microlenses, sensor = section.main_lens, section.microlenses, section.sensor
    missing = missing_for_camera(section)
    if lens is None or missing is not None:
        raise ValueError(f"camera.{missing} is missing")
    microlens_focal_length = microlens_focal_length_mm(microlenses)
    real = Camera(
        magnification=lens.magnification,
        focal_length_mm=focal_length_mm(lens) or 0.0,
        aperture_mm=aperture_mm(lens) or 0.0,
        microlens_focal_length_mm=microlens_focal_length or 0.0,
        microlens_distance_mm=sensor.microlens_distance_mm or microlens_focal_length or 0.0,
        lattice=Lattice.regular(microlenses.pitch_mm, microlenses.layout or "square"),
        pixel_mm=sensor.pixel_um * UM_TO_MM,
        columns=sensor.columns,
        rows=sensor.rows,
        column_axis=sensor.column_axis,
        diffusion_px=sensor.diffusion_px,
    )
    return thin_lens(real, entrance_over_exit(lens))


def micro_image_pitch_px(section: CameraSection) -> float:
    """Return how far apart the data sheet's micro-images lie, those of parallel light where the lens is not known."""
    if missing_for_camera(section) is None:
        return float(camera_of(section).micro_image_lattice_px().pitch.mean())
    return section.microlenses.pitch_mm / (section.sensor.pixel_um * UM_TO_MM)


def media_of(section: MediaSection) -> Media:
    """Return the refractive indices."""
    return Media(section.air, section.window, section.fluid)


def face_of(section: FaceSection, media: Media) -> Face:
    """Return a face: its surface, and the index behind it.

    Raises
    ------
    ConfigError : heights that are no grid
    """
    parameters = parameters_of(section)
    if isinstance(parameters.get("axis"), str):
        parameters["axis"] = DIRECTIONS[parameters["axis"]]
    return Face(SURFACES[section.kind](**parameters), index_behind(section, media))


def index_behind(section: FaceSection, media: Media) -> float:
    """Return the refractive index behind a face."""
    return getattr(media, section.behind) if isinstance(section.behind, str) else section.behind


def scene_of(sections: Sequence[FaceSection], media: Media) -> CurvedSpace:
    """Return what lies in front of the lens, face by face.

    Raises
    ------
    ConfigError : light cannot cross the faces in this order
    """
    return CurvedSpace(media, tuple(face_of(section, media) for section in sections))


def board_of(section: BoardSection) -> BoardGeometry:
    """Return the board; a chessboard's points are the corners between its squares."""
    points = section.dots if section.squares is None else (section.squares[0] - 1, section.squares[1] - 1)
    if points is None:
        raise ValueError("board.dots or board.squares is missing")
    return BoardGeometry(
        dots=points,
        spacing_mm=section.spacing_mm,
        dot_diameter_mm=section.dot_diameter_mm or 0.0,
        thickness_mm=section.thickness_mm,
        polarity=section.polarity,
        medium=section.medium,
        pattern=section.pattern,
        marker_mm=section.marker_mm or 0.0,
        dictionary=section.dictionary,
    )


def round_wall_of(section: PipeSection) -> RoundWall:
    """Return the inside of the pipe, in the volume's coordinates."""
    return RoundWall(section.radius_mm, section.centre_mm, section.axis)


def grid_of(section: VolumeSection, scale: Scale | None, reference: Reference) -> Grid:
    """Return the volume's grid, z from the focal point, where the section counts z from a reference.

    The camera's `scale` is needed only where the section leaves the voxels to the program.
    """
    shape, voxel = section.shape_xyz, section.voxel_mm
    if shape is None or voxel is None:
        if section.size_mm is None or scale is None:
            raise ValueError("neither shape_xyz and voxel_mm nor size_mm with a camera")
        shape, voxel = choose_voxels(scale, section.size_mm)
    x, y, z = section.centre_mm
    return Grid.centred(shape, voxel, (x, y, reference.depth_to_focal_point(z)))


def choose_voxels(scale: Scale, size_mm: Lengths) -> tuple[Triple, Lengths]:
    """Return the number and size of the voxels that fill `size_mm` and serve the velocity best.

    They are near a third of a microlens laterally, as it appears in the scene, and a fifth of the depth over which
    light spreads by one lens, and divide the size.
    """
    lateral, depth = scale.lens_mm / LATERAL_VOXELS_PER_MICROLENS, scale.depth_mm / VOXELS_PER_DEPTH
    counts = [max(1, round(size / target)) for size, target in zip(size_mm, (lateral, lateral, depth), strict=True)]
    voxel = [size / count for size, count in zip(size_mm, counts, strict=True)]
    return (counts[0], counts[1], counts[2]), (voxel[0], voxel[1], voxel[2])


def windows_of(section: CorrelationSection, voxel_mm: Lengths) -> tuple[Triple, ...]:
    """Return the correlation windows in voxels, coarse to fine; `window_mm` is the final one of two.

    By default they are as long along all axes, as far as voxels of different sides allow.
    """
    if section.windows is not None:
        return section.windows
    lengths, smallest = section.window_mm, SMALLEST_WINDOW
    if lengths is None:
        side = DEFAULT_WINDOW * min(voxel_mm)
        lengths, smallest = (side, side, side), SMALLEST_DEFAULT_WINDOW
    final = [max(smallest, round(length / voxel)) for length, voxel in zip(lengths, voxel_mm, strict=True)]
    return (2 * final[0], 2 * final[1], 2 * final[2]), (final[0], final[1], final[2])


def overlap_of(section: CorrelationSection, voxel_mm: Lengths) -> Lengths:
    """Return the overlap of the final windows in voxels along x, y, z.

    Windows given as `window_mm` are whole voxels only nearly; their overlap is then what leaves the distance between
    them, and with it their number, as in mm.
    """
    if section.window_mm is None:
        return section.overlap
    *_, final = windows_of(section, voxel_mm)
    x, y, z = (
        max(0.0, 1.0 - length * (1.0 - overlap) / (voxel * size))
        for length, overlap, voxel, size in zip(section.window_mm, section.overlap, voxel_mm, final, strict=True)
    )
    return x, y, z


def flow_of(section: FlowSection, reference: Reference) -> Flow:
    """Return a flow as a function of points, z from the focal point, where the section counts z from a reference."""
    parameters = section.model_dump(exclude={"kind"})
    if "centre_mm" in parameters:
        x, y, z = parameters["centre_mm"]
        parameters["centre_mm"] = (x, y, reference.depth_to_focal_point(z))
    return FLOWS[section.kind](**parameters)


def waves_of(section: LightSection) -> Waves | None:
    """Return the waves that light is made of, None where it is made of rays."""
    return None if section.kind == "rays" else Waves(section.wavelength_nm * NM_TO_MM, section.points)


def wave_light_of(section: ReconstructionSection) -> WaveLight | None:
    """Return the waves that images are read by, None where they are read by rays."""
    if section.wavelength_nm is None:
        return None
    diffusion_px = USUAL_DIFFUSION_PX if section.diffusion_px is None else section.diffusion_px
    return WaveLight(section.wavelength_nm * NM_TO_MM, diffusion_px)


# The config with its scene where a calibration has it: faces, and the pipe's wall with them, moved as one body.


def fingerprint(scene: tuple[FaceSection, ...]) -> str:
    """Return what tells a scene from another: the SHA-256 of its faces."""
    plain = [face.model_dump(mode="json", exclude={"file"}) for face in scene]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def moved_faces(scene: tuple[FaceSection, ...], media: MediaSection, motion: RigidMotion) -> list[dict[str, Any]]:
    """Return the sections of a scene that is moved as one body.

    Raises
    ------
    ConfigError : a face cannot be turned
    """
    kinds = {surface: kind for kind, surface in SURFACES.items()}
    moved = []
    for section in scene:
        surface: Any = face_of(section, media_of(media)).surface.moved(motion)
        moved.append({"kind": kinds[type(surface)], **asdict(surface), "behind": section.behind})
    return moved


def moved_pipe(pipe: PipeSection, motion: RigidMotion) -> dict[str, Any]:
    """Return the section of a pipe that is moved with its scene."""
    resolved = pipe.model_dump(mode="json")
    return resolved | {
        "centre_mm": motion.point(pipe.centre_mm),
        "axis": motion.direction(round_wall_of(pipe).direction.tolist()),
    }


def ensure_same(scene: tuple[FaceSection, ...] | None, faces_sha256: str, source: str) -> None:
    """Raise where a scene is not the one that a calibration's motion is counted from.

    Raises
    ------
    ConfigError
    """
    if scene is None:
        raise ConfigError(f"{source}: scene: is missing, and the calibration tells where it lies")
    if fingerprint(scene) != faces_sha256:
        raise ConfigError(
            f"{source}: scene: is not the one whose place the calibration tells; refine-calibration again, from a "
            "calibration that knows of no scene"
        )
