"""What is wrong with a configuration: keys by themselves, and together contradictions and physics that cannot be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from pydantic import ValidationError

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.sections import CylinderFace, HeightMapFace, scene_of
from lfpiv_cli.files.sections_work import Sections, SimulationSection
from lfpiv_cli.files.yaml_nodes import Document, KeyPath, Problem, key_name, place_of, problem_of, report
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.grid import FOCAL_POINT
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Window, equivalent_object_distance, fluid_path_to_focus

Found = Iterator[tuple[KeyPath, str]]

# What the board of each pattern needs besides its spacing; the other keys here are not for it.
BOARD_KEYS = {"dots": ("dots", "dot_diameter_mm"), "chessboard": ("squares",), "charuco": ("squares", "marker_mm")}
# OpenCV finds three by three inner corners and more.
FEWEST_SQUARES = 4
# Data sheets give three or four digits; of lengths in a scene that are given twice a tenth of a micron is nothing.
AGREEMENT, AGREEMENT_MM = 1e-3, 1e-4
# Three pixels tell the middle of a lens image from its rims; the widest lens images in use are some 100 px wide.
FEWEST_PIXELS_A_LENS, MOST_PIXELS_A_LENS = 3.0, 1000.0
# The sensor stands at the microlenses' focal length or, in focused cameras, not far from it; and lens images that are
# many pitches wide can be told apart by nothing.
MOST_FOCAL_LENGTHS, MOST_PITCHES = 20.0, 50.0
# No length on a bench, in mm, nor any other number here, is as large or as small; squares of these are still numbers.
LARGEST_NUMBER, SMALLEST_NUMBER = 1e12, 1e-12


def validated(document: Document, source: str) -> Sections:
    """Return the sections of a document.

    Raises
    ------
    ConfigError : all that is wrong with it
    """
    if document.data and not document.problems and not document.data.keys() & Sections.model_fields.keys():
        first = ", ".join(map(str, list(document.data)[:3]))
        raise ConfigError(f"{source}: is no rig file: it has {first}, expected {', '.join(Sections.model_fields)}")
    problems, sections = list(document.problems), None
    try:
        sections = Sections.model_validate(document.data)
    except ValidationError as error:
        problems += [problem_of(document, details) for details in error.errors()]
    if sections is not None:
        # Nothing can be calculated with numbers that are beyond all others.
        found = list(_beyond_numbers(sections.model_dump(), ()))
        for faults in () if found else FAULTS:
            found += faults(sections)
        problems += [Problem(*place_of(document, path), key_name(path), text) for path, text in found]
    if problems or sections is None:
        raise ConfigError(report(source, problems))
    return sections


def _beyond_numbers(value: Any, path: KeyPath) -> Found:
    """Yield numbers so large, or so close to 0, that nothing can be calculated with them."""
    if isinstance(value, dict):
        for name, item in value.items():
            yield from _beyond_numbers(item, (*path, name))
    elif isinstance(value, (tuple, list)):
        for place, item in enumerate(value):
            yield from _beyond_numbers(item, (*path, place))
    elif isinstance(value, float) and value and not SMALLEST_NUMBER <= abs(value) <= LARGEST_NUMBER:
        sizes = f"{written(SMALLEST_NUMBER)} to {written(LARGEST_NUMBER)}"
        yield path, f"is {written(value, 6)}, expected a size of {sizes}"


def _twice(place: KeyPath, given: float, expected: float, what: str) -> Found:
    """Yield what is given twice and differs."""
    if not math.isclose(given, expected, rel_tol=AGREEMENT):
        yield place, f"is {given:g}, but {what} is {expected:g}"


def _camera(sections: Sections) -> Found:
    """Yield what is given twice and differs (S_i = F_m (P - M), f-numbers), and lens images nobody could tell apart."""
    if sections.camera is None:
        return
    lens, microlenses, sensor = sections.camera.main_lens, sections.camera.microlenses, sections.camera.sensor
    if lens is not None:
        place = ("camera", "main_lens")
        focal_length = lens.known_focal_length_mm
        if lens.image_distance is not None:
            if lens.focal_length_mm is None:
                yield place, "needs focal_length_mm, which an infinite image distance does not tell"
            if lens.image_distance_mm is not None:
                yield (*place, "image_distance_mm"), f"is {lens.image_distance_mm:g}, but image_distance is infinite"
            if lens.pupil_ratio != 1.0:
                text = f"is {lens.pupil_ratio:g}, but image_distance is infinite and so is the ratio"
                yield (*place, "pupil_ratio"), text
        elif focal_length is None:
            yield place, "needs focal_length_mm or image_distance_mm"
        elif lens.image_distance_mm is not None:
            expected = focal_length * (lens.pupil_ratio - lens.magnification)
            what = f"focal_length_mm ({lens.pupil_ratio:g} - magnification)"
            yield from _twice((*place, "image_distance_mm"), lens.image_distance_mm, expected, what)
        if lens.aperture_mm is None and lens.f_number is None:
            yield place, "needs aperture_mm or f_number"
        if lens.aperture_mm and lens.f_number and focal_length:
            expected = focal_length / lens.aperture_mm
            yield from _twice((*place, "f_number"), lens.f_number, expected, "focal_length_mm / aperture_mm")
    if microlenses.f_number and microlenses.focal_length_mm:
        place, expected = ("camera", "microlenses"), microlenses.focal_length_mm / microlenses.pitch_mm
        yield from _twice((*place, "f_number"), microlenses.f_number, expected, "focal_length_mm / pitch_mm")
    pitch_mm = microlenses.pitch_mm
    pitch_px = pitch_mm * 1e3 / sensor.pixel_um
    if not FEWEST_PIXELS_A_LENS <= pitch_px <= MOST_PIXELS_A_LENS:  # most often a slip in the unit
        text = f"lens images would be {written(pitch_px, 4)} px apart (pitch_mm is {pitch_mm:g}), expected "
        text += f"{FEWEST_PIXELS_A_LENS:g} to {MOST_PIXELS_A_LENS:g}: pixels in um, the pitch in mm"
        yield ("camera", "sensor", "pixel_um"), f"is {sensor.pixel_um:g}: {text}"
    camera = sections.camera.model()
    for inside, text in () if camera is None else lens_image_faults(camera):
        yield ("camera", *inside), text


def lens_image_faults(camera: Camera) -> Found:
    """Yield the place in `camera` and the sentence of lens images that nobody could tell apart."""
    ratio = camera.microlens_distance_mm / camera.microlens_focal_length_mm
    if not 1.0 / MOST_FOCAL_LENGTHS <= ratio <= MOST_FOCAL_LENGTHS:
        yield (
            ("sensor", "microlens_distance_mm"),
            f"is {camera.microlens_distance_mm:g}, {written(ratio, 4)} times the microlenses' focal length of "
            f"{camera.microlens_focal_length_mm:g}, expected {1.0 / MOST_FOCAL_LENGTHS:g} to {MOST_FOCAL_LENGTHS:g}",
        )
    if camera.lens_image_width > MOST_PITCHES:
        yield (
            ("main_lens",),
            f"is open {camera.aperture_mm:g} mm wide: lens images would be {written(camera.lens_image_width, 4)} of "
            f"their pitch wide, expected at most {MOST_PITCHES:g}, and best 1",
        )


def _volume(sections: Sections) -> Found:
    """Yield a volume that is given twice or by half."""
    volume = sections.volume
    if volume is None:
        return
    if volume.size_mm is not None:
        for name in ("shape_xyz", "voxel_mm"):
            if getattr(volume, name) is not None:
                yield ("volume", name), "contradicts size_mm, which leaves the voxels to the program"
        if sections.camera is None or sections.camera.missing is not None or sections.media is None:
            yield (
                ("volume", "size_mm"),
                "needs the sections media and camera, with all of its main lens, for the voxels",
            )
    elif volume.shape_xyz is None or volume.voxel_mm is None:
        yield ("volume",), "needs shape_xyz and voxel_mm, or size_mm"
    if volume.reference == "mid_plane" and sections.channel is None:
        yield ("volume", "reference"), "is mid_plane, which needs the section channel"


def _board(sections: Sections) -> Found:
    """Yield what a board's pattern lacks or does not have, and dots or markers that are too large."""
    board = sections.board
    if board is None:
        return
    has = BOARD_KEYS[board.pattern]
    for name in dict.fromkeys(key for keys in BOARD_KEYS.values() for key in keys):
        given = getattr(board, name) is not None
        if given != (name in has):
            yield ("board", name), f"is {'not for' if given else 'missing for'} pattern {board.pattern}"
    if board.pattern == "chessboard" and min(board.squares or (FEWEST_SQUARES,)) < FEWEST_SQUARES:
        yield ("board", "squares"), f"is {board.squares}, expected {FEWEST_SQUARES} or more along each side"
    for name in ("dot_diameter_mm", "marker_mm"):
        size = getattr(board, name)
        if size is not None and size >= board.spacing_mm:
            yield ("board", name), f"is {size:g}, expected less than the spacing of {board.spacing_mm:g}"


def _walls(sections: Sections) -> Found:
    """Yield walls that are not each other, and a board's place in the fluid that is in air."""
    board, window, channel = sections.board, sections.window, sections.channel
    in_fluid = board is not None and board.medium == "fluid"
    if channel is not None and channel.board_from_mid_plane_mm is not None and not in_fluid:
        yield ("channel", "board_from_mid_plane_mm"), "is for a board in the fluid; one in air stands on the outer wall"
    if window is not None and channel is not None:
        yield from _twice(("window", "thickness_mm"), window.thickness_mm, channel.wall_mm, "channel.wall_mm")
    pipe = sections.pipe
    if pipe and channel and not math.isclose(2.0 * pipe.radius_mm, channel.width_mm, rel_tol=AGREEMENT):
        yield ("pipe", "radius_mm"), f"is {pipe.radius_mm:g}, but channel.width_mm is {channel.width_mm:g}"


def _scene(sections: Sections) -> Found:
    """Yield the place and the sentence of faces that light cannot cross in order, and of walls that contradict them."""
    scene = sections.scene
    if scene is None:
        return
    for name, why in (("window", "the faces are the window"), ("channel", "its walls are plane")):
        if getattr(sections, name) is not None:
            yield (name,), f"contradicts scene: {why}"
    if sections.media is None:
        yield ("scene",), "needs the section media"
        return
    media = sections.media.model()
    last = len(scene) - 1
    if scene[last].index_behind(media) != media.fluid:
        yield ("scene", last, "behind"), f"is {scene[last].behind}, expected fluid behind the last face"
        return
    faults: list[tuple[KeyPath, str]] = []
    for k, section in enumerate(scene):
        if isinstance(section, HeightMapFace) and (section.file is None) == (section.heights_mm is None):
            faults.append((("scene", k), "expected a file of heights, or heights_mm, and not both"))
            continue
        try:
            section.model(media).surface.shape()
        except ConfigError as error:
            faults.append((("scene", k), str(error)))
    yield from faults
    if faults:
        return
    try:
        space = scene_of(scene, media)
        camera = None if sections.camera is None else sections.camera.model()
        if camera is not None:
            space.lens_z_mm(camera)
    except ConfigError as error:
        yield ("scene",), str(error)
        return

    # A pipe's wall is the cylinder in front of the fluid; its depth is known from the focal point.
    pipe, face = sections.pipe, scene[-1]
    if pipe is None or not isinstance(face, CylinderFace):
        return
    yield from _twice(("pipe", "radius_mm"), pipe.radius_mm, face.radius_mm, "that of the last face in scene")
    inside = pipe.wall()
    axis = RoundWall(face.radius_mm, axis=face.axis).direction
    if np.linalg.norm(np.cross(inside.direction, axis)) > AGREEMENT:
        ours, theirs = (each if isinstance(each, str) else list(each) for each in (pipe.axis, face.axis))
        yield ("pipe", "axis"), f"is {ours}, but that of the last face in scene is {theirs}"
    from_focal_point = sections.volume is not None and sections.volume.reference == "focal_point"
    if from_focal_point and inside.distances_mm(np.array(face.centre_mm)) > AGREEMENT_MM:
        ours, theirs = list(pipe.centre_mm), list(face.centre_mm)
        yield ("pipe", "centre_mm"), f"is {ours}, but that of the last face in scene is {theirs}"


def _processing(sections: Sections) -> Found:
    """Yield windows not from coarse to fine, a mask without walls, and ranges upside down."""
    correlation, brightness = sections.correlation, sections.simulation.brightness
    place: KeyPath = ("correlation", "windows")
    if correlation.windows is not None:
        if correlation.window_mm is not None:
            yield place, "contradicts window_mm"
        if not correlation.windows:
            yield place, "is empty, expected at least one window"
        for k, (coarse, fine) in enumerate(zip(correlation.windows, correlation.windows[1:], strict=False)):
            if any(a < b for a, b in zip(coarse, fine, strict=True)):
                yield (*place, k + 1), f"is {list(fine)} after {list(coarse)}, expected coarse to fine"
    if correlation.mask == "channel" and (sections.volume is None or sections.volume.reference != "mid_plane"):
        yield ("correlation", "mask"), "is channel, which needs volume.reference: mid_plane"
    if correlation.mask == "pipe" and sections.pipe is None:
        yield ("correlation", "mask"), "is pipe, which needs the section pipe"
    if brightness[0] > brightness[1] or brightness[1] == 0.0:
        yield ("simulation", "brightness"), f"is {list(brightness)}, expected a range [smallest, largest]"
    light = sections.simulation.light_z_mm
    if light is not None and light[0] >= light[1]:
        yield ("simulation", "light_z_mm"), f"is {list(light)}, expected a range [nearest, farthest]"
    if sections.simulation.brightness_log_sigma is not None and brightness != SimulationSection().brightness:
        yield ("simulation", "brightness_log_sigma"), "contradicts brightness, expected one of the two"


def _rays(sections: Sections) -> Found:
    """Yield what polynomials of rays cannot be, and particles with them."""
    chosen = sections.weights
    if chosen.method == "dlfc":
        if chosen.refraction == "exact":
            yield ("weights", "refraction"), "is exact, but method dlfc knows no refraction besides what the boards saw"
        if chosen.sampling == "rays":
            yield ("weights", "sampling"), "is rays, but method dlfc has none to count; expected exact"
    methods, place = sections.validation.flow_methods or (), ("validation", "flow_methods")
    if len(set(methods)) < len(methods):
        yield place, f"is {list(methods)}, expected each method once"
    if chosen.method == "dlfc" and "particles" in methods:
        yield place, "holds particles, which are fitted with traced rays; weights.method is dlfc"


def _object_space(sections: Sections) -> Found:
    """Yield a volume or a window that lies where light cannot come from.

    With a mid-plane volume the origin is not known yet; it lies within millimetres of the focal point.
    """
    volume, section = sections.volume, sections.camera
    camera = None if section is None else section.model()
    if volume is None or camera is None or sections.media is None:
        return
    if volume.size_mm is None and (volume.shape_xyz is None or volume.voxel_mm is None):
        return
    media = sections.media.model()
    grid = volume.grid(camera.scale(media), FOCAL_POINT)
    nearest = grid.bounds_mm(2)[0]
    distance = float(equivalent_object_distance(nearest, camera.focus_distance_mm, media))
    if distance <= 0.0:
        yield (
            ("volume",),
            f"begins at z = {nearest:g} mm, behind the lens, which is {camera.focus_distance_mm:g} mm away",
        )
        return
    # The steepest ray is that from a corner of the volume to the far side of the lens.
    aside = math.hypot(*(max(map(abs, grid.bounds_mm(axis))) for axis in (0, 1)))
    sine = math.sin(math.atan((camera.aperture_radius_mm + aside) / distance)) * media.air
    for name in ("window", "fluid"):
        if getattr(media, name) <= sine:
            yield (
                ("media", name),
                f"is {getattr(media, name):g}: light at the rim of the lens (n sin = {sine:.3f}) is totally reflected",
            )
    if sections.window is not None and sections.channel is None:
        window = Window(sections.window.distance_mm, sections.window.thickness_mm)
        path = fluid_path_to_focus(window, camera.focus_distance_mm, media)
        if path + nearest < 0.0:
            yield (
                ("window", "distance_mm"),
                f"puts the window's far face at z = {written(-path, 4)} mm, inside the volume that begins at "
                f"{written(nearest, 4)}",
            )


# All that several keys can say together.
FAULTS = (_camera, _volume, _board, _walls, _scene, _processing, _rays, _object_space)
