"""The config with its scene where a calibration has it: faces, and the pipe's wall with them, moved as one body."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Any

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.bench import face_of, media_of, round_wall_of
from lfpiv_cli.files.sections import MediaSection, PipeSection
from lfpiv_cli.files.sections_scene import FaceSection
from lfpiv_cli.optics.rigid_motion import RigidMotion
from lfpiv_cli.optics.surfaces import SURFACES


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
