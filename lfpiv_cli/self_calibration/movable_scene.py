"""A scene that lies a little elsewhere than it is said to, as one rigid body, known by the pipe's inner wall.

Of the six ways to move a body the wall of a round pipe shows four: two shifts and two tilts of its axis. A shift along
the axis and a turn about it leave the wall as it is, and are left alone.

Axes: world axes, z away from the camera from the nominal focal point; lengths in mm. `along` runs along the pipe,
`across` is square to it and to the optical axis, `away` square to both, away from the camera.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv_cli.arrays import Flags, Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.shapes import RigidMotion
from lfpiv_cli.optics.surfaces import Cylinder, Faces
from lfpiv_cli.particles.pencil import MEAN_SQUARE, lines_of

# Where particles lie behind faces that are not where they were thought to be.
#
# What an image shows of a particle are its rays over the main lens; along image axis k their slopes are a straight
# line, (X_k - place_k) / distance_k, and a small rest (see `particles.pencil`). Behind other faces the same rays
# belong to another place: the one whose lines are closest to those of the first over the aperture's disc. As behind a
# pipe both distances differ and a place has only one depth, something is left where the faces are wrong.
#
# Axes: image axes, z away from the camera from the nominal focal point, mm.


# Gauss-Newton's iteration: faces that are shifted by 0.2 mm leave 1e-9 mm after four.
STEPS = 5


def moved_places(points_mm: Floats, before: Faces, after: Faces, radius_mm: float) -> tuple[Floats, Flags]:
    """Return where particles lie behind other faces, their rays being the same.

    Parameters
    ----------
    points_mm : (n, 3) behind the faces as they were
    radius_mm : of the main lens

    Returns
    -------
    Places (n, 3), and (n,) whether there are any; those that have none stay.
    """
    shown, _, seen = _lines(points_mm, before, radius_mm)
    places = points_mm.copy()
    for _ in range(STEPS):
        lines, moves, there = _lines(places, after, radius_mm)
        seen &= there
        places[seen] += _solved(moves[seen], (shown - lines)[seen])
    return np.where(seen[:, np.newaxis], places, points_mm), seen


def place_changes(points_mm: Floats, ahead: Faces, behind: Faces, here: Faces, radius_mm: float) -> Floats:
    """Return how far (n, 3) places move, their rays being the same, from faces `behind` to `ahead`; first order."""
    _, moves, seen = _lines(points_mm, here, radius_mm)
    first, _, seen_ahead = _lines(points_mm, ahead, radius_mm)
    second, _, seen_behind = _lines(points_mm, behind, radius_mm)
    seen &= seen_ahead & seen_behind
    changes = np.zeros_like(points_mm)
    changes[seen] = _solved(moves[seen], (second - first)[seen])
    return changes


def _solved(moves: Floats, wanted: Floats) -> Floats:
    """Return the steps (n, 3) that change lines (n, 4) by what is wanted, as nearly as they can."""
    turned = np.swapaxes(moves, 1, 2)
    return np.asarray(np.linalg.solve(turned @ moves, turned @ wanted[:, :, np.newaxis])[..., 0])


def _lines(points_mm: Floats, faces: Faces, radius_mm: float) -> tuple[Floats, Floats, Flags]:
    """Return the straight lines of the slopes of points (n, 4), their derivatives (n, 4, 3), and which are seen.

    The lines are slopes in the lens's middle, and by how much these grow to the root of the mean square over its disc.
    """
    lines, moves, _ = lines_of(faces, radius_mm, np.ascontiguousarray(points_mm))
    seen = np.all(lines[:, :, 1] > 0.0, axis=1)
    place, distance = lines[:, :, 0], np.where(seen[:, np.newaxis], lines[:, :, 1], 1.0)
    reach = radius_mm * np.sqrt(MEAN_SQUARE)
    further = moves[:, :, 1] / distance[..., np.newaxis] ** 2
    middle_moves = place[..., np.newaxis] * further - moves[:, :, 0] / distance[..., np.newaxis]
    shown = np.concatenate([-place / distance, reach / distance], axis=1)
    return shown, np.concatenate([middle_moves, -reach * further], axis=1), seen


# Seen from further along its axis, too little of a pipe's wall shows where it lies.
LEAST_ANGLE_TO_VIEW_DEG = 45.0
# Of a wall that is not where it was said to be particles may lie behind the said one: so much of its radius.
BEYOND_SHARE = 0.08
# The unknowns of a motion: the axis's place across the view and away from the camera, and its tilts towards both.
ACROSS, AWAY, TILT_ACROSS, TILT_AWAY = range(4)


@dataclass(frozen=True, eq=False)
class MovableScene:
    """A scene, and what of its place is not known.

    Attributes
    ----------
    space, camera : as they are said to be
    wall : the pipe's inner wall, the last face
    pivot_mm : the point of its axis that is nearest to the optical axis, about which it is tilted
    along, across, away : (3,) unit vectors
    """

    space: CurvedSpace
    camera: Camera
    wall: Cylinder
    pivot_mm: Floats
    along: Floats
    across: Floats
    away: Floats

    @classmethod
    def of(cls, space: CurvedSpace, camera: Camera) -> MovableScene:
        """Return the scene, to be moved.

        Raises
        ------
        ConfigError : particles do not tell where its wall is
        """
        wall = space.faces[-1].surface
        if not isinstance(wall, Cylinder) or wall.facing != "convex":
            raise ConfigError(
                "where particles end tells where a scene lies if its last face is a cylinder around the fluid, a "
                "pipe's inner wall; this one is not"
            )
        along = np.array(wall.axis) / np.linalg.norm(wall.axis)
        along = along if along[np.argmax(np.abs(along))] > 0.0 else -along
        angle = float(np.rad2deg(np.arccos(min(1.0, abs(along[2])))))
        if angle < LEAST_ANGLE_TO_VIEW_DEG:
            raise ConfigError(
                f"the pipe's axis lies {angle:.0f} degrees from the view; particles tell where its wall is from "
                f"{LEAST_ANGLE_TO_VIEW_DEG:g} degrees on"
            )
        across = np.cross((0.0, 0.0, 1.0), along)
        across /= np.linalg.norm(across)
        centre = np.array(wall.centre_mm)
        pivot = centre - (centre[:2] @ along[:2]) / (along[:2] @ along[:2]) * along
        return cls(space, camera, wall, pivot, along, across, np.cross(along, across))

    @property
    def beyond_mm(self) -> float:
        """How far beyond the wall particles are looked for."""
        return BEYOND_SHARE * self.wall.radius_mm

    def motion(self, values: Floats) -> RigidMotion:
        """Return the motion by unknowns (4,): mm across and away, rad towards across and away."""
        shift = values[ACROSS] * self.across + values[AWAY] * self.away
        turn = values[TILT_ACROSS] * self.away - values[TILT_AWAY] * self.across
        return RigidMotion(_vector(shift), _vector(turn), _vector(self.pivot_mm))

    def moved(self, values: Floats) -> CurvedSpace:
        """Return the scene moved by unknowns (4,).

        Raises
        ------
        ConfigError : the optical axis misses a face then
        """
        return self.space.moved(self.motion(values))

    def faces(self, values: Floats) -> Faces:
        """Return the faces moved by unknowns (4,), the fluid going on a little beyond its wall."""
        return self.moved(values).for_kernels(self.camera)._replace(beyond_mm=self.beyond_mm)

    def frame(self, values: Floats) -> Floats:
        """Return the directions along, across and away (3, 3) of the pipe moved by unknowns (4,)."""
        return self.motion(values).directions(np.stack([self.along, self.across, self.away]))

    def about_axis(self, points_mm: Floats, values: Floats) -> Floats:
        """Return points (n, 3), world axes, in the moved pipe's frame (n, 3): along, across and away from the pivot."""
        return np.asarray((points_mm - self.motion(values).points(self.pivot_mm)) @ self.frame(values).T)

    def on_axis(self, along_mm: Floats, values: Floats) -> Floats:
        """Return the points (n, 3), world axes, of the moved pipe's axis at places (n,) along it."""
        return self.motion(values).points(self.pivot_mm) + np.outer(along_mm, self.frame(values)[0])


def _vector(values: Floats) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
