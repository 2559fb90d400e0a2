"""Where a scene lies: how far from where the config says, as one rigid body, and how well that is known.

Axes: world axes, z away from the camera from the nominal focal point, mm and degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.optics.rigid_motion import RigidMotion


@dataclass(frozen=True, eq=False)
class ScenePose:
    """How a scene lies beside the one of the config.

    Attributes
    ----------
    shift_mm, turn_deg : (3,) of all its faces, turned about the pivot first; the turn is a vector along its axis
    pivot_mm : (3,)
    shift_sigma_mm, turn_sigma_deg : (3,) standard errors; 0 of what nothing shows and stays as the config has it
    faces_sha256 : of the config's scene that it is counted from
    """

    shift_mm: NDArray[np.float64]
    turn_deg: NDArray[np.float64]
    pivot_mm: NDArray[np.float64]
    shift_sigma_mm: NDArray[np.float64]
    turn_sigma_deg: NDArray[np.float64]
    faces_sha256: str

    @property
    def motion(self) -> RigidMotion:
        """The motion from where the config has the scene."""
        shift, turn, pivot = (each.tolist() for each in (self.shift_mm, np.deg2rad(self.turn_deg), self.pivot_mm))
        return RigidMotion(tuple(shift), tuple(turn), tuple(pivot))

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain lists, units in their names."""
        return {
            "scene_shift_mm": self.shift_mm.tolist(),
            "scene_shift_mm_sigma": self.shift_sigma_mm.tolist(),
            "scene_turn_deg": self.turn_deg.tolist(),
            "scene_turn_deg_sigma": self.turn_sigma_deg.tolist(),
        }

    def to_tree(self) -> dict[str, Any]:
        """Return everything as a dict of arrays and strings."""
        return {name: getattr(self, name) for name in NAMES}

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any]) -> ScenePose:
        """Return the pose that `to_tree` took apart.

        Raises
        ------
        KeyError, ValueError : something is missing, or is no place
        """
        found = {name: tree[name] for name in NAMES}
        for name in NAMES[:-1]:
            found[name] = np.asarray(found[name], dtype=np.float64)
            if found[name].shape != (3,) or not np.all(np.isfinite(found[name])):
                raise ValueError(f"scene/{name} is no place")
        return cls(**found)


NAMES = ("shift_mm", "turn_deg", "pivot_mm", "shift_sigma_mm", "turn_sigma_deg", "faces_sha256")
