"""What came of a rig's experiment, held against the truth that its images were rendered from.

Lateral lengths in microlenses as they appear in the scene, depths in a tenth of what light spreads over by one lens:
for the paper's camera both are about 0.1 mm, within which its particles count as found.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.rig_drawing import DT_S, DrawnRig
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.config import Config
from lfpiv_cli.files.particle_file import PARTICLES_FORMAT, TRACKS_FORMAT, read_particles, read_points
from lfpiv_cli.files.vtkhdf import open_vectors
from lfpiv_cli.flow.field import REJECTED
from lfpiv_cli.grid import Grid
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.synthetic.flows import MM_PER_M, Flow, advect
from lfpiv_cli.synthetic.render import RAYS
from lfpiv_cli.validation.planning import Bound, cramer_rao_bound, expected_image, pixel_variance, slopes
from lfpiv_cli.validation.volume import COVERED_SIGMAS, match
from lfpiv_cli.verbs.checks import MOST_WRONG
from lfpiv_cli.verbs.simulate import readout_of, real_camera, simulated_reference

Figures = dict[str, float]

# A tenth of the depth over which light spreads by one lens: the paper's voxel is 0.094 of it.
DEPTH_VOXEL = 0.1
# Where places are off by a constant (a wrong focal plane) partners are sought this many times further away first.
WIDER = 4.0
# A tracer is bright where its light is known to a twentieth, alone.
BRIGHT = 20.0
# Beyond so many standard errors of the bound it is another tracer, or another depth that explains the light as well.
ASTRAY = 10.0
AXES = "xyz"
# Stated errors are too small where fewer errors lie within 1.96 of them; light is not what the model says where errors
# are so many times what light allows.
SMALLEST_COVERAGE, BEYOND_LIGHT = 0.8, 3.0


@dataclass(frozen=True, eq=False)
class Truth:
    """The first image's tracers in the coordinates of files, which count z from the reference.

    Attributes
    ----------
    position_mm, later_mm : (n, 3) in the first image and in the second
    inside : (n,) which lie in the volume
    stays : (n,) which lie there in the second image, too
    bound : of their places
    light_over_sigma : (n,) of each alone
    flow : velocities in m/s at points in these coordinates
    """

    position_mm: NDArray[np.float64]
    later_mm: NDArray[np.float64]
    inside: NDArray[np.bool_]
    stays: NDArray[np.bool_]
    bound: Bound
    light_over_sigma: NDArray[np.float64]
    flow: Flow


def true_warnings(figures: Figures) -> set[str]:
    """Return the codes of warnings that are true by the figures, of results that are no worse than is allowed.

    That an image shows no tracers, where none lies in the volume; that links are wrong, where they are; and that light
    is another than the model's and stated errors may be too small, where errors are beyond both in some direction, of
    fewer tracers than coverage is asked of.
    """
    true = {"frame-uniform"} if figures.get("tracers") == 0.0 else set()
    if figures.get("wrong_links", 0.0) > MOST_WRONG:
        true.add("wrong-links")
    for axis in AXES:
        uncovered = figures.get(f"coverage_{axis}", 1.0) < SMALLEST_COVERAGE
        if uncovered and figures.get(f"over_{axis}", 1.0) > BEYOND_LIGHT:
            true.add("light-model")
    return true


def judge_calibration(rig: DrawnRig, calibration: Path) -> Figures:
    """Return how far the board's magnification is off, as a share, and standard errors of it and of its depth."""
    pose = open_calibration(calibration).pose
    true = rig.true["camera"]["main_lens"]["magnification"]
    if pose is None:
        return {}
    return {
        "magnification_off": pose.magnification / true - 1.0,
        "magnification_sigma": pose.magnification_sigma / abs(true),
        "depth_sigma": pose.z0_sigma_mm / float(voxel_mm(rig)[2]),
    }


def truth_of(settings: Config, images: Path, grid: Grid) -> Truth:
    """Return the truth of the first image of a simulated pair; `grid` is of the volume that is measured."""
    reference = simulated_reference(settings)
    seeded = read_particles(images / "particles.npz")
    moved = advect(settings.simulated_flow(reference), seeded.positions_mm, -0.5 * DT_S)
    camera, scene = real_camera(settings), settings.simulation
    light = scene.particle_counts * seeded.brightness
    view = raw_view(camera, settings.media_model(), 0.5 * scene.particle_diameter_mm)
    tracers = np.column_stack([camera.to_image_axes(moved), light])
    slope = slopes(view, tracers)
    per_ray = scene.particle_counts / (scene.rays or RAYS)
    bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, tracers), readout_of(settings), per_ray))
    later = advect(settings.simulated_flow(reference), seeded.positions_mm, 0.5 * DT_S)
    position, after = (reference.points_from_focal_point(places) for places in (moved, later))
    low, high = np.array([grid.bounds_mm(axis) for axis in range(3)]).T
    inside, stays = (np.all((at >= low) & (at <= high), axis=1) for at in (position, after))
    with np.errstate(invalid="ignore"):
        certainty = light / np.sqrt(bound.alone[:, 3, 3])
    return Truth(position, after, inside, inside & stays, bound, certainty, settings.simulated_flow())


def voxel_mm(rig: DrawnRig) -> NDArray[np.float64]:
    """Return the lengths (3,) in which places are judged."""
    return np.array([rig.lens_mm, rig.lens_mm, DEPTH_VOXEL * rig.depth_mm])


def judge_particles(rig: DrawnRig, truth: Truth, particles: Path) -> Figures:
    """Return recall, precision, errors over the bound and coverage of the first image's particles."""
    found = read_points(particles, PARTICLES_FORMAT)
    scale = 1.0 / voxel_mm(rig)
    figures = {
        "tracers": float(truth.inside.sum()),
        "bright": float(np.mean(truth.light_over_sigma[truth.inside] > BRIGHT)) if truth.inside.any() else 0.0,
        "found": float(np.count_nonzero(found.arrays["flag"] == 0)),
    }
    if not len(found.position_mm) or not truth.inside.any():
        return figures | {"recall": 0.0, "precision": float("nan")}
    there, here = truth.position_mm * scale, found.position_mm * scale
    coarse = match(here, there, WIDER)
    offset = np.median(coarse.error_voxel * WIDER, axis=0) if len(coarse.found) else np.zeros(3)
    pairs = match(here - offset, there, 1.0)
    figures["recall"] = float(truth.inside[pairs.true].sum() / truth.inside.sum())
    figures["staying"] = float(truth.stays[pairs.true].sum())
    own = found.arrays["flag"] == 0
    figures["precision"] = float(own[pairs.found].sum() / max(own.sum(), 1))
    for axis, name in enumerate(AXES):
        figures[f"offset_{name}"] = float(offset[axis])
    judged = truth.inside[pairs.true]
    error = (pairs.error_voxel / scale)[judged]
    sigma = np.sqrt(found.arrays["covariance_mm2"][pairs.found[judged], :3])
    bound = truth.bound.sigma_mm(joint=True)[pairs.true[judged]]
    for axis, name in enumerate(AXES):
        if len(error):
            over = error[:, axis] / bound[:, axis]
            near = np.abs(over) <= ASTRAY
            figures[f"over_{name}"] = float(np.sqrt(np.mean(over[near] ** 2))) if near.any() else float("nan")
            figures[f"median_over_{name}"] = float(np.median(np.abs(over)) / 0.6745)
            figures[f"astray_{name}"] = float(np.mean(~near))
            figures[f"rms_{name}"] = float(np.sqrt(np.mean(error[:, axis] ** 2)) * scale[axis])
            figures[f"coverage_{name}"] = float(np.mean(np.abs(error[:, axis]) <= COVERED_SIGMAS * sigma[:, axis]))
    return figures


def offset_mm(rig: DrawnRig, figures: Figures) -> NDArray[np.float64]:
    """Return how far (3,) all particles lie off together: an error of the calibration, which is judged by itself."""
    offset = np.array([figures.get(f"offset_{axis}", 0.0) for axis in AXES])
    return offset * voxel_mm(rig)


def judge_tracks(rig: DrawnRig, truth: Truth, tracks: Path, offset: NDArray[np.float64]) -> Figures:
    """Return the slopes of measured on true displacements of tracks, by their stated errors, and how sure these are.

    And the share of links whose ends are no one tracer's.
    """
    found = read_points(tracks, TRACKS_FORMAT)
    figures: Figures = {"tracks": float(len(found.position_mm))}
    if len(found.position_mm):
        true = truth.flow(found.position_mm - offset)
        sigma = found.arrays["velocity_sigma"]
        figures |= _slopes(found.arrays["velocity"], true, np.where(sigma > 0.0, sigma, np.inf))
        scale, tracer = 1.0 / voxel_mm(rig), []
        for end, there in ((-0.5, truth.position_mm), (0.5, truth.later_mm)):
            here = found.position_mm - offset + end * found.arrays["displacement_mm"]
            pairs = match(here * scale, there * scale, 1.0)
            tracer.append(np.full(len(here), -1))
            tracer[-1][pairs.found] = pairs.true
        figures["wrong_links"] = float(np.mean((tracer[0] != tracer[1]) | (tracer[0] < 0)))
    return figures


def judge_vectors(truth: Truth, vectors: Path, prefix: str, offset: NDArray[np.float64]) -> Figures:
    """Return the slopes of measured on true velocities of windows, and the share that was found."""
    field = open_vectors(vectors)
    z, y, x = np.meshgrid(*(field.grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    true = truth.flow(np.stack([x, y, z], axis=-1).reshape(-1, 3) - offset).reshape(*field.flag.shape, 3)
    kept = field.flag < REJECTED
    figures: Figures = {f"{prefix}_valid": float(np.mean(kept))}
    if kept.any():
        spread = np.ones((int(kept.sum()), 3))
        slopes_found = _slopes(field.velocity[kept], true[kept], spread)
        figures |= {f"{prefix}_{name}": value for name, value in slopes_found.items() if not name.endswith("sigma")}
    if field.uncertainty_voxel is not None and kept.any():
        sigma = field.uncertainty_voxel[kept] * field.voxel_mm / MM_PER_M / DT_S
        error = np.abs(field.velocity[kept] - true[kept])
        known = np.isfinite(sigma).all(axis=1)
        figures[f"{prefix}_sigma_known"] = float(np.mean(known))
        for axis, name in enumerate("uvw"):
            if known.any():
                covered = error[known, axis] <= COVERED_SIGMAS * sigma[known, axis]
                figures[f"{prefix}_coverage_{name}"] = float(np.mean(covered))
    return figures


def _slopes(measured: NDArray[np.float64], true: NDArray[np.float64], sigma: NDArray[np.float64]) -> Figures:
    """Return the slope through zero of each component that flows at all, and its standard error."""
    figures: Figures = {}
    for axis, name in enumerate("uvw"):
        weight = 1.0 / sigma[:, axis] ** 2
        power = float(np.sum(weight * true[:, axis] ** 2))
        if power > 0.0 and np.isfinite(power):
            figures[f"slope_{name}"] = float(np.sum(weight * measured[:, axis] * true[:, axis]) / power)
            figures[f"slope_{name}_sigma"] = float(power**-0.5)
    return figures
