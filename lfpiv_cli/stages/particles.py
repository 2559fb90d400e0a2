"""The part of `reconstruct` that finds particles."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.images import write_tiff
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, symmetric, write_points
from lfpiv_cli.files.weights_file import WeightsFile
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.particles.neighbour_frames import second_pass
from lfpiv_cli.particles.refraction import places_by_snell
from lfpiv_cli.particles.rounds import ROUNDS, first_pass
from lfpiv_cli.particles.search import Particles, Task, result, task_of
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.reconstruction.equations import Normalisers
from lfpiv_cli.tracks.tracking import SEARCH_VOXEL
from lfpiv_cli.weights.build import factorise_bricks
from lfpiv_cli.weights.columns import OnDemandOperator
from lfpiv_cli.weights.model import behind_transmission

# Units of progress that `find` and `find_first` report.
STEPS = sum(settings.iterations + 1 for settings in ROUNDS)


def searchable(content: WeightsFile, settings: Config) -> WeightsFile:
    """Return weights to look for particles with: where an array is hexagonal, those of bricks for its cells.

    Raises
    ------
    ConfigError
        Rays are fitted, or the array does not stand upright.
    """
    if settings.weights.method == "dlfc":
        raise ConfigError("weights.method: particles are fitted with traced rays; build weights by ert for them")
    weights, operator = content.weights, content.weights.solver_operator
    if not isinstance(operator, OnDemandOperator):
        return content
    bricks = factorise_bricks(content.camera, settings.media_model(), weights.padded.grid)
    passing = bricks if operator.transmission is None else behind_transmission(bricks, operator.transmission)
    return replace(content, weights=replace(weights, solver_operator=passing))


@dataclass(frozen=True, eq=False)
class Frame:
    """An image and what of it takes part.

    Attributes
    ----------
    image : (rows, columns) raw but for dark and background
    unusable : (rows, columns) pixels that take no part
    sums : of the padded weights without what these touch
    """

    image: NDArray[np.float32]
    unusable: NDArray[np.bool_]
    sums: Normalisers


def residual_path(particles: Path) -> Path:
    """Return where the residual image of a file of particles goes."""
    return particles.with_name(f"{particles.stem}_residual.tif")


def find(content: WeightsFile, settings: Config, frame: Frame, progress: Callable[[int], None]) -> Particles:
    """Return the particles behind an image."""
    task = _task(content, settings, frame)
    return result(task, first_pass(task, progress=progress))


def find_first(
    content: WeightsFile, settings: Config, frame: Frame, progress: Callable[[int], None]
) -> NDArray[np.float64]:
    """Return the particles (n, 4) of a frame's first pass, for its own second pass and those of its neighbours."""
    return first_pass(_task(content, settings, frame), progress=progress).particles


def find_beside(
    content: WeightsFile,
    settings: Config,
    frame: Frame,
    own: NDArray[np.float64],
    neighbours: Sequence[NDArray[np.float64]],
) -> Particles:
    """Return the particles behind an image with the help of the first passes of it and of the frames beside it."""
    task = _task(content, settings, frame)
    search_mm = SEARCH_VOXEL * max(content.weights.grid.spacing_mm)
    return result(task, second_pass(task, own, neighbours, search_mm))


def _task(content: WeightsFile, settings: Config, frame: Frame) -> Task:
    radius = 0.5 * settings.reconstruction.particle_diameter_mm
    view = raw_view(content.camera, settings.media_model(), radius, content.weights.calibration)
    return task_of(frame.image, view, content.weights, content.camera, frame.sums, frame.unusable)


def write_frame(
    content: WeightsFile,
    settings: Config,
    frame: Frame,
    found: Particles,
    path: Path,
    provenance: Mapping[str, Any],
    overwrite: bool,
) -> float:
    """Write the particles found behind an image and what they leave of it; return the relative residual."""
    space = _space(content, settings)
    places = places_by_snell(found.position_mm, space, content.camera)
    left = np.where(frame.unusable, 0.0, found.residual)
    norm = float(np.linalg.norm(np.where(frame.unusable, 0.0, frame.image)))
    residual = float(np.linalg.norm(left)) / norm if norm > 0.0 else 0.0
    # Made again whenever the particles are: an interrupted batch may have left one without them.
    write_tiff(residual_path(path), left.astype(np.float32), overwrite=True)
    write_points(
        path,
        PARTICLES_FORMAT,
        content.reference.points_from_focal_point(places),
        {
            "intensity": found.light_counts,
            "covariance_mm2": symmetric(found.covariance_mm2),
            "chi2": found.chi2,
            "seen": found.seen,
            "flag": _outside(places, content.weights.grid),
        },
        content.reference,
        provenance=provenance,
        attributes={
            "refraction": "paraxial" if space.straight else "exact",
            "residual": residual,
            "residual_rms_counts": float(np.sqrt(np.mean(left[~frame.unusable] ** 2))),
            "excluded_pixels": int(np.count_nonzero(frame.unusable)),
            "read_noise_counts": found.noise.read_counts,
        },
        overwrite=overwrite,
    )
    return residual


def _space(content: WeightsFile, settings: Config) -> ObjectSpace:
    """Return what lies before the particles: by Snell's law where the window's thickness and place are known."""
    calibration = content.weights.calibration
    mid_plane = calibration.mid_plane_z_mm if calibration else None
    if (settings.channel is None or mid_plane is None) and settings.sections.window is None:
        return ObjectSpace(settings.media_model(), None, "paraxial")
    return ObjectSpace(settings.media_model(), settings.window_model(mid_plane), "exact")


def _outside(position_mm: NDArray[np.float64], grid: Grid) -> NDArray[np.uint8]:
    """Return 1 for particles outside the volume, kept because they light it, 0 for those inside."""
    bounds = np.array([grid.bounds_mm(axis) for axis in range(3)])
    inside = np.all((position_mm >= bounds[:, 0]) & (position_mm <= bounds[:, 1]), axis=1)
    return (~inside).astype(np.uint8)
