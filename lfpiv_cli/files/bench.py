"""From the sections of the configuration to the objects that the core works with.

What a section leaves out and another of its keys implies (an aperture from an f-number) is worked out here, once.
"""

from __future__ import annotations

from collections.abc import Sequence

from lfpiv_cli.calibration.wave_shapes import WaveLight
from lfpiv_cli.files import sections
from lfpiv_cli.files.sections_simulated import FlowSection, LightSection
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice, thin_lens
from lfpiv_cli.optics.curved_space import CurvedSpace, Face
from lfpiv_cli.optics.line_responses import USUAL_DIFFUSION_PX
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.surfaces import SURFACES
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.reference import Reference
from lfpiv_cli.scale import Scale
from lfpiv_cli.synthetic.flows import FLOWS
from lfpiv_cli.synthetic.vortices import Flow

UM_TO_MM, NM_TO_MM = 1e-3, 1e-6
DIRECTIONS = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0)}
# Voxels as wide as a microlens lock depth to the array's grid and swallow its velocity: of 0.6 mm EM volumes give 0.22
# with them. With half of one laterally and two along the axis they give nine tenths, with a third 0.98 to 1.02 and a
# third less spread; a quarter gains no more. Along the axis the depth over which light spreads by one lens counts: two
# microlenses of Table 2 are 0.2 mm of 1.064 mm.
LATERAL_VOXELS_PER_MICROLENS = 3.0
VOXELS_PER_DEPTH = 1.064 / 0.2


def focal_length_mm(lens: sections.MainLens) -> float | None:
    """Return F_m, given or from S_i = F_m (P - M)."""
    if lens.focal_length_mm is not None or lens.image_distance_mm is None:
        return lens.focal_length_mm
    return lens.image_distance_mm / (lens.pupil_ratio - lens.magnification)


def entrance_over_exit(lens: sections.MainLens) -> float:
    """Return 1/P, 0 of a lens that is telecentric towards the array."""
    return 0.0 if lens.image_distance == "infinite" else 1.0 / lens.pupil_ratio


def aperture_mm(lens: sections.MainLens) -> float | None:
    """Return p_m, given or from the f-number F_m / p_m."""
    focal_length = focal_length_mm(lens)
    if lens.aperture_mm is not None or lens.f_number is None or focal_length is None:
        return lens.aperture_mm
    return focal_length / lens.f_number


def microlens_focal_length_mm(lens: sections.Microlenses) -> float | None:
    """Return f_m, given or from the f-number f_m / p_l."""
    if lens.focal_length_mm is not None or lens.f_number is None:
        return lens.focal_length_mm
    return lens.f_number * lens.pitch_mm


def missing_for_camera(section: sections.CameraSection) -> str | None:
    """Return the first key that a whole camera lacks, None where nothing is missing."""
    lens = section.main_lens
    if lens is None:
        return "main_lens"
    if focal_length_mm(lens) is None:
        return "main_lens.focal_length_mm"
    if aperture_mm(lens) is None:
        return "main_lens.aperture_mm"
    return "microlenses.focal_length_mm" if microlens_focal_length_mm(section.microlenses) is None else None


def camera_of(section: sections.CameraSection) -> Camera:
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


def media_of(section: sections.MediaSection) -> Media:
    """Return the refractive indices."""
    return Media(section.air, section.window, section.fluid)


def face_of(section: sections.FaceSection, media: Media) -> Face:
    """Return a face: its surface, and the index behind it.

    Raises
    ------
    ConfigError : heights that are no grid
    """
    others = ("kind", "behind", "file")
    parameters = {name: getattr(section, name) for name in type(section).model_fields if name not in others}
    if isinstance(parameters.get("axis"), str):
        parameters["axis"] = DIRECTIONS[parameters["axis"]]
    return Face(SURFACES[section.kind](**parameters), index_behind(section, media))


def index_behind(section: sections.FaceSection, media: Media) -> float:
    """Return the refractive index behind a face."""
    return getattr(media, section.behind) if isinstance(section.behind, str) else section.behind


def scene_of(faces: Sequence[sections.FaceSection], media: Media) -> CurvedSpace:
    """Return what lies in front of the lens, face by face.

    Raises
    ------
    ConfigError : light cannot cross the faces in this order
    """
    return CurvedSpace(media, tuple(face_of(section, media) for section in faces))


def round_wall_of(section: sections.PipeSection) -> RoundWall:
    """Return the inside of the pipe, in the volume's coordinates."""
    return RoundWall(section.radius_mm, section.centre_mm, section.axis)


def grid_of(section: sections.VolumeSection, scale: Scale | None, reference: Reference) -> Grid:
    """Return the volume's grid, z from the focal point, where the section counts z from a reference.

    The camera's `scale` is needed only where the section leaves the voxels to the program.
    """
    shape, voxel = section.shape_xyz, section.voxel_mm
    if shape is None or voxel is None:
        if section.size_mm is None or scale is None:
            raise ValueError("neither shape_xyz and voxel_mm nor size_mm with a camera")
        # What serves the velocity best: near a third of a microlens laterally, as it appears in the scene, and a fifth
        # of the depth over which light spreads by one lens; voxels divide the size.
        lateral, depth = scale.lens_mm / LATERAL_VOXELS_PER_MICROLENS, scale.depth_mm / VOXELS_PER_DEPTH
        sides = zip(section.size_mm, (lateral, lateral, depth), strict=True)
        nx, ny, nz = (max(1, round(size / target)) for size, target in sides)
        x, y, z = section.size_mm
        shape, voxel = (nx, ny, nz), (x / nx, y / ny, z / nz)
    x, y, z = section.centre_mm
    return Grid.centred(shape, voxel, (x, y, reference.depth_to_focal_point(z)))


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


def wave_light_of(section: sections.ReconstructionSection) -> WaveLight | None:
    """Return the waves that images are read by, None where they are read by rays."""
    if section.wavelength_nm is None:
        return None
    diffusion_px = USUAL_DIFFUSION_PX if section.diffusion_px is None else section.diffusion_px
    return WaveLight(section.wavelength_nm * NM_TO_MM, diffusion_px)
