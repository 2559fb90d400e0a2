"""Bubbles that stick to a channel's wall, as in the paper's Fig. 17: balls that shine and do not move.

A bubble is lit as brightly as a ball that glows in the middle and fades to its rim. Its depth does not count: it is the
disc of its rim, square to the optical axis. The light of tracers goes through it.

Axes: world axes, z away from the camera from the nominal focal point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.names import BubbleWall
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.synthetic.board import light_per_area, sunflower
from lfpiv_cli.synthetic.render import Balls, Space
from lfpiv_cli.synthetic.scenes import Box
from lfpiv_cli.synthetic.wave_images import render_balls

# A bubble is made of points this dense, as the dots of boards are; with so many rays each, those add less noise than
# light does.
POINTS_PER_MICROLENS = 8
RAYS_PER_POINT = 1_000


@dataclass(frozen=True, eq=False)
class Bubbles:
    """Balls at rest: their centres (n, 3) and diameters (n,) in mm."""

    centres_mm: Floats
    diameters_mm: Floats

    def truth(self) -> list[list[float]]:
        """Return x, y, z and diameter of each, mm, ready for JSON."""
        return np.column_stack([self.centres_mm, self.diameters_mm]).tolist()


def bubbles_at_wall(
    count: int,
    diameter_mm: tuple[float, float],
    wall: BubbleWall,
    seen: Box,
    walls: Box,
    rng: np.random.Generator,
) -> Bubbles:
    """Return balls that touch a wall of a square channel, evenly spread over the part of it that is seen.

    Parameters
    ----------
    diameter_mm : smallest and largest, evenly spread between them
    seen : box with tracers
    walls : inside of the channel, endless along its flow

    Raises
    ------
    ConfigError : a bubble is wider than the channel
    """
    diameters = rng.uniform(*diameter_mm, count)
    radii = 0.5 * diameters[:, np.newaxis]
    low, high = np.maximum(seen.low_mm, walls.low_mm + radii), np.minimum(seen.high_mm, walls.high_mm - radii)
    if np.any(low > high):
        raise ConfigError(f"bubbles of {diameters.max():g} mm do not fit into the channel that is seen, {seen}")
    centres = rng.uniform(low, high)
    axis = 2 if wall in ("near", "far") else int(np.flatnonzero(np.isfinite(walls.low_mm))[0])
    if wall in ("near", "low"):
        centres[:, axis] = walls.low_mm[axis] + radii[:, 0]
    else:
        centres[:, axis] = walls.high_mm[axis] - radii[:, 0]
    return Bubbles(centres, diameters)


def render_bubbles(
    camera: Camera,
    space: Space,
    bubbles: Bubbles,
    level: float,
    rng: np.random.Generator,
    waves: Waves | None = None,
) -> Floats:
    """Render bubbles whose middle gives `level` expected counts in a pixel that sees nothing else, fading to the rim.

    Returns
    -------
    (rows, columns) float64, expected counts
    """
    spacing = float(camera.lattice.pitch[0]) / (POINTS_PER_MICROLENS * abs(camera.magnification))
    points, light = [np.empty((0, 3))], [np.empty(0)]
    for centre, diameter in zip(bubbles.centres_mm, bubbles.diameters_mm, strict=True):
        inside = sunflower(max(round((diameter / spacing) ** 2), 1), 0.5 * diameter)
        share = np.maximum(1.0 - (inside**2).sum(axis=1) / (0.5 * diameter) ** 2, 0.0)
        placed = centre + np.column_stack([inside, np.zeros(len(inside))])
        area = 0.25 * np.pi * diameter**2 / len(inside)
        points.append(placed)
        light.append(area * share * light_per_area(camera, space.media, placed[:, 2], level))
    balls = Balls(np.concatenate(points), np.concatenate(light), spacing if waves is None else 0.0)
    return render_balls(camera, space, balls, rng, waves, rays=RAYS_PER_POINT)
