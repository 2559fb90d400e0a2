"""What the section `scene` cannot be, by itself and beside other sections that tell of walls."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.bench import (
    camera_of,
    face_of,
    index_behind,
    media_of,
    missing_for_camera,
    round_wall_of,
    scene_of,
)
from lfpiv_cli.files.sections import Sections
from lfpiv_cli.files.sections_scene import CylinderFace, HeightMapFace
from lfpiv_cli.files.yaml_nodes import KeyPath
from lfpiv_cli.flow.masks import RoundWall

Found = Iterator[tuple[KeyPath, str]]

# Of lengths that are given twice: drawings give three or four digits, and a tenth of a micron is nothing.
AGREEMENT, AGREEMENT_MM = 1e-3, 1e-4


def scene_faults(sections: Sections) -> Found:
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
    media = media_of(sections.media)
    last = len(scene) - 1
    if index_behind(scene[last], media) != media.fluid:
        yield ("scene", last, "behind"), f"is {scene[last].behind}, expected fluid behind the last face"
        return
    missed = False
    for k, section in enumerate(scene):
        if isinstance(section, HeightMapFace) and (section.file is None) == (section.heights_mm is None):
            yield ("scene", k), "expected a file of heights, or heights_mm, and not both"
            missed = True
            continue
        try:
            face_of(section, media).surface.shape()
        except ConfigError as error:
            yield ("scene", k), str(error)
            missed = True
    if missed:
        return
    try:
        space = scene_of(scene, media)
        if sections.camera is not None and missing_for_camera(sections.camera) is None:
            space.lens_z_mm(camera_of(sections.camera))
    except ConfigError as error:
        yield ("scene",), str(error)
        return
    yield from _pipe(sections)


def _pipe(sections: Sections) -> Found:
    """Yield a pipe's wall that is not the cylinder in front of the fluid; its depth is known from the focal point."""
    pipe, face = sections.pipe, sections.scene[-1] if sections.scene else None
    if pipe is None or not isinstance(face, CylinderFace):
        return
    if not math.isclose(pipe.radius_mm, face.radius_mm, rel_tol=AGREEMENT):
        yield ("pipe", "radius_mm"), f"is {pipe.radius_mm:g}, but that of the last face in scene is {face.radius_mm:g}"
    inside = round_wall_of(pipe)
    axis = RoundWall(face.radius_mm, axis=face.axis).direction
    if np.linalg.norm(np.cross(inside.direction, axis)) > AGREEMENT:
        yield ("pipe", "axis"), f"is {_told(pipe.axis)}, but that of the last face in scene is {_told(face.axis)}"
    from_focal_point = sections.volume is not None and sections.volume.reference == "focal_point"
    if from_focal_point and inside.distances_mm(np.array(face.centre_mm)) > AGREEMENT_MM:
        yield (
            ("pipe", "centre_mm"),
            f"is {list(pipe.centre_mm)}, but that of the last face in scene is {list(face.centre_mm)}",
        )


def _told(axis: str | tuple[float, ...]) -> str:
    return axis if isinstance(axis, str) else str(list(axis))
