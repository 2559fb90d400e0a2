"""A calibration held against the particles of a flow: where the channel's walls are, by the particles between them.

Told by where the particles end: the depth of the mid plane, the walls' tilt, and the scale of depths, which goes with
the square of the magnification. The images of the particles alone tell none of these: unknown places absorb them.

Axes: world axes of the raw sensor, z from the nominal focal point; lengths in mm.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.particles.rounds import ROUNDS, Particles, find_particles
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.particles.walls import Walls, find_walls
from lfpiv_cli.reconstruction.equations import normalisers
from lfpiv_cli.weights.build import default_padding, factorise
from lfpiv_cli.weights.model import Weights

# Three rounds find nine particles in ten; the walls of six rounds lie within two micrometres of theirs.
REFINING_ROUNDS = ROUNDS[:3]
# Units of progress for one image.
STEPS = sum(settings.iterations + 1 for settings in REFINING_ROUNDS)
# Particles are looked for this share of the channel's width beyond the walls on each side.
MARGIN_PER_WIDTH = 0.15
# Candidates' depths need planes only this many lateral voxels apart; the fit finds the rest.
DEPTH_PER_LATERAL = 2.0
# What all particles' depths have in common (rays bent more at the rim than paraxial ones, the rim's own model) was 4 to
# 13 um on an image traced through 5 mm of acrylic and up to 10 mm of water: this share of the depth over which the main
# lens's rim moves a point by a microlens.
COMMON_SHARE_OF_LENS_DEPTH = 5e-3


@dataclass(frozen=True, eq=False)
class Refinement:
    """What the particles told.

    Attributes
    ----------
    walls : where they end
    position_mm : (n, 3) of the particles, all images together
    depths_mm : between which they were looked for
    frames : number of images
    expected_z_mm, expected_sigma_mm : depth of the mid plane before, and its standard error where it was known
    common_depth_mm : standard error that all depths share
    width_mm, particle_diameter_mm : true width of the channel, diameter of the particles
    magnification : that the depths were found with
    """

    walls: Walls
    position_mm: NDArray[np.float64]
    depths_mm: tuple[float, float]
    frames: int
    expected_z_mm: float
    expected_sigma_mm: float | None
    common_depth_mm: float
    width_mm: float
    particle_diameter_mm: float
    magnification: float

    @property
    def middle_sigma_mm(self) -> float:
        """Standard error of the mid plane's depth, what all particles have in common included."""
        return float(np.hypot(self.walls.middle_sigma_mm, self.common_depth_mm))

    @property
    def width_sigma_mm(self) -> float:
        """Standard error of the apparent width; centres of particles may stay a radius off each wall."""
        return float(np.linalg.norm([self.walls.width_sigma_mm, self.common_depth_mm, self.particle_diameter_mm]))

    def applied(self, calibration: Calibration) -> Calibration:
        """Return the calibration with the mid plane where the particles have it."""
        return replace(calibration, mid_plane_z_mm=self.walls.middle_mm, mid_plane_z_sigma_mm=self.middle_sigma_mm)

    def summary(self) -> dict[str, Any]:
        """Return the figures as plain numbers and lists, units in their names; None where unknown."""
        walls = self.walls
        half_span = np.sqrt(np.var(self.position_mm[:, :2], axis=0))
        slope_sigma = np.hypot(walls.slope_sigma, self.common_depth_mm / half_span)
        scale, before = walls.width_mm / self.width_mm, self.expected_sigma_mm
        return {
            "frames": self.frames,
            "particles": len(self.position_mm),
            "mid_plane_z_mm": walls.middle_mm,
            "mid_plane_z_mm_sigma": self.middle_sigma_mm,
            "mid_plane_z_mm_before": self.expected_z_mm if before is not None else None,
            "mid_plane_correction_mm": walls.middle_mm - self.expected_z_mm if before is not None else None,
            "mid_plane_correction_mm_sigma": np.hypot(self.middle_sigma_mm, before) if before is not None else None,
            "wall_tilt_deg": np.rad2deg(np.arctan(walls.slope)).tolist(),
            "wall_tilt_deg_sigma": np.rad2deg(slope_sigma / (1.0 + walls.slope**2)).tolist(),
            "apparent_width_mm": walls.width_mm,
            "apparent_width_mm_sigma": self.width_sigma_mm,
            "magnification": self.magnification * float(np.sqrt(scale)),
            "magnification_sigma": 0.5 * abs(self.magnification) * self.width_sigma_mm / self.width_mm,
            "edge_blur_mm": walls.blur_mm,
            "stray_share": walls.stray_share,
        }


def refine_calibration(
    images: Sequence[NDArray[np.float32]],
    calibration: Calibration,
    sheet: Camera,
    media: Media,
    volume: Grid,
    width_mm: float,
    particle_diameter_mm: float,
    progress: Callable[[int], None] | None = None,
) -> Refinement:
    """Find the particles of images and the channel's walls by them.

    Parameters
    ----------
    images : (rows, columns) raw, dark and background taken off, counts
    sheet : camera as the data sheet has it
    volume : says where particles are looked for laterally, and how fine
    width_mm : of the channel

    Raises
    ------
    InputError
        The particles do not show the channel.
    ConfigError
        The array is hexagonal.
    """
    camera = calibration.camera(sheet)
    view = raw_view(camera, media, 0.5 * particle_diameter_mm, calibration)
    expected = 0.0 if calibration.mid_plane_z_mm is None else calibration.mid_plane_z_mm
    grid = _deep_grid(volume, expected, width_mm)
    padding = default_padding(camera, media, grid)
    operator = factorise(camera, media, grid.padded(padding))
    weights = Weights(grid, padding, operator, camera.column_axis, calibration)
    sums = normalisers(weights.padded)
    found = [find_particles(image, view, weights, camera, sums, REFINING_ROUNDS, progress=progress) for image in images]
    position = np.concatenate([each.position_mm for each in found])
    sigma = np.concatenate([_depth_sigma_mm(each) for each in found])
    lens_depth = float(camera.lattice.pitch.max() / abs(camera.magnification)) / camera.aperture_radius_mm
    lens_depth *= camera.focus_distance_mm / media.depth_ratio
    return Refinement(
        walls=find_walls(position, sigma, grid.bounds_mm(2), width_mm, len(images)),
        position_mm=position,
        depths_mm=grid.bounds_mm(2),
        frames=len(images),
        expected_z_mm=expected,
        expected_sigma_mm=calibration.mid_plane_z_sigma_mm,
        common_depth_mm=COMMON_SHARE_OF_LENS_DEPTH * lens_depth,
        width_mm=width_mm,
        particle_diameter_mm=particle_diameter_mm,
        magnification=camera.magnification,
    )


def _deep_grid(volume: Grid, middle_mm: float, width_mm: float) -> Grid:
    """Return a grid as wide as the volume and deeper than the channel."""
    shape, spacing = volume.shape_xyz, volume.spacing_mm
    deep = DEPTH_PER_LATERAL * max(spacing[:2])
    count = int(np.ceil(width_mm * (1.0 + 2.0 * MARGIN_PER_WIDTH) / deep))
    x, y = (0.5 * sum(volume.bounds_mm(axis)) for axis in (0, 1))
    return Grid.centred((shape[0], shape[1], count), (spacing[0], spacing[1], deep), (x, y, middle_mm))


def _depth_sigma_mm(found: Particles) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(found.covariance_mm2[:, 2, 2]), dtype=np.float64)
