"""How well a volume shows the particles that were there: correlation with the truth, ghosts, length in depth.

Two lengths stand for the instrument: a microlens as it appears in the scene, and four of them in depth. A peak or some
light belongs to a particle when it lies in the ellipsoid of these half axes around it.

Axes: volumes [z, y, x] on a grid in mm; points (x, y, z).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.errors import InputError
from lfpiv_cli.grid import Grid
from lfpiv_cli.kernels import njit
from lfpiv_cli.particles.joining import Boxes, find_peaks
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.validation.board import elongation_mm

# A particle counts as found within so many voxels laterally and in depth.
LATERAL_VOXEL, DEPTH_VOXEL = 0.5, 2.0
DEPTH_TO_LATERAL = DEPTH_VOXEL / LATERAL_VOXEL
# Of normal errors 95 % lie within so many standard deviations.
COVERED_SIGMAS = 1.96


@dataclass(frozen=True, eq=False)
class Matches:
    """Numbers of found and true particles that belong together, (n,) each, and their errors (n, 3) in voxels."""

    found: Integers
    true: Integers
    error_voxel: Floats


def match(found_mm: Floats, true_mm: Floats, voxel_mm: float) -> Matches:
    """Pair found with true particles, nearest first, each at most once."""
    scale = voxel_mm * np.array([LATERAL_VOXEL, LATERAL_VOXEL, DEPTH_VOXEL])
    near = KDTree(true_mm / scale).query_ball_point(found_mm / scale, np.sqrt(2.0), return_sorted=True)
    found = np.repeat(np.arange(len(found_mm)), [len(k) for k in near])
    true = np.array([k for some in near for k in some], dtype=np.int64)
    offset = (found_mm[found] - true_mm[true]) / scale
    lateral2, depth2 = np.sum(offset[:, :2] ** 2, axis=1), offset[:, 2] ** 2
    free_found, free_true = np.ones(len(found_mm), dtype=bool), np.ones(len(true_mm), dtype=bool)
    kept = []
    for k in np.argsort(lateral2 + depth2, kind="stable"):
        if lateral2[k] < 1.0 and depth2[k] < 1.0 and free_found[found[k]] and free_true[true[k]]:
            free_found[found[k]] = free_true[true[k]] = False
            kept.append(k)
    error = (found_mm[found[kept]] - true_mm[true[kept]]) / voxel_mm
    return Matches(found[kept], true[kept], error)


def particle_figures(
    found_mm: Floats,
    true_mm: Floats,
    low_mm: Floats,
    high_mm: Floats,
    voxel_mm: float,
    sigma_mm: Floats | None = None,
    distances_mm: tuple[float, float] = (0.0, np.inf),
) -> dict[str, float]:
    """Return recall, precision, and per component bias, rms and robust spread (1.48 median deviation) in voxels.

    Parameters
    ----------
    found_mm, true_mm : (n, 3), (m, 3)
    low_mm, high_mm : (3,) of the volume that is judged; what lies outside may be matched and is not counted
    sigma_mm : (n, 3) standard errors; they add the share of errors within 1.96 of them
    distances_mm : only what lies this far from z = 0, the focal plane, on either side is judged
    """

    def inside(points: Floats) -> Flags:
        distance = np.abs(points[:, 2])
        band = (distance >= distances_mm[0]) & (distance < distances_mm[1])
        return np.asarray(band & np.all((points >= low_mm) & (points <= high_mm), axis=1))

    pairs = match(found_mm, true_mm, voxel_mm)
    figures = {
        "recall": inside(true_mm[pairs.true]).sum() / max(inside(true_mm).sum(), 1),
        "precision": inside(found_mm[pairs.found]).sum() / max(inside(found_mm).sum(), 1),
    }
    judged = inside(true_mm[pairs.true])
    error = pairs.error_voxel[judged]
    for axis, (name, values) in enumerate(zip("xyz", error.T, strict=True)):
        if values.size:
            middle = np.median(values)
            figures[f"bias_{name}_voxel"] = middle
            figures[f"rms_{name}_voxel"] = np.sqrt(np.mean(values**2))
            figures[f"spread_{name}_voxel"] = MAD_TO_SIGMA * np.median(np.abs(values - middle))
            if sigma_mm is not None:
                covered = COVERED_SIGMAS * sigma_mm[pairs.found[judged], axis] / voxel_mm
                figures[f"coverage_{name}"] = np.mean(np.abs(values) <= covered)
    return {name: float(value) for name, value in figures.items()}


# Errors of measured places as a map of space: shifted, stretched, turned, slanted, twisted, and what is left.
#
# With e = measured - true at the true place (x, y, z), z from where depth is counted,
#
#     e_k = b_k + B_kx x + B_ky y + B_kz z + C_kx x z + C_ky y z
#
# is fitted for each component k, without outliers. A velocity is a difference of places, so that 1 + B is also what
# happens to velocities: B_zz is the relative error of w, B_xz the share of w that leaks into u.
#
# Axes: points (n, 3), x, y, z in mm.

# Depths may be wrong by so many times what lateral places may: an error of the focal plane is one of depth alone.
DEPTH_TO_LATERAL_GATE = 40.0
# Errors so many robust standard deviations from the fit are other tracers, or another depth that explains the light as
# well; looked for so many times.
OUTLIER_SIGMAS, OUTLIER_ROUNDS = 5.0, 3
TERMS, FEWEST = 6, 10


def pairs_of(measured_mm: Floats, true_mm: Floats, gate_mm: float) -> Matches:
    """Pair measured with true tracers that stand apart: nearest first, laterally within a gate, nearly any depth.

    Errors are returned in mm.
    """
    scale = np.array([1.0, 1.0, DEPTH_TO_LATERAL / DEPTH_TO_LATERAL_GATE])
    found = match(measured_mm * scale, true_mm * scale, gate_mm / LATERAL_VOXEL)
    return Matches(found.found, found.true, measured_mm[found.found] - true_mm[found.true])


def fit_errors(true_mm: Floats, error_mm: Floats) -> tuple[dict[str, float], dict[str, float]]:
    """Fit the map to errors (n, 3) at true places (n, 3); NaN where there are hardly more of them than terms.

    Returns
    -------
    figures, sigma : by name, and their standard errors; lengths in mm, stretches and angles as ratios (twist: per mm of
        depth)
    """
    # b, B_x, B_y, B_z, C_x, C_y of each component, their standard errors, and the standard deviation of what is left
    coefficients = sigma = np.full((TERMS, 3), np.nan)
    spread, count = sigma[0], 0
    if len(true_mm) >= FEWEST:
        x, y, z = true_mm.T
        design = np.stack([np.ones_like(x), x, y, z, x * z, y * z], axis=1)
        kept = np.ones(len(x), dtype=bool)
        for _ in range(OUTLIER_ROUNDS):
            coefficients = np.linalg.lstsq(design[kept], error_mm[kept], rcond=None)[0]
            left = np.abs(error_mm - design @ coefficients)
            width = MAD_TO_SIGMA * np.median(left[kept], axis=0)
            kept = np.all(left <= OUTLIER_SIGMAS * width, axis=1)
        coefficients = np.linalg.lstsq(design[kept], error_mm[kept], rcond=None)[0]
        left, count = (error_mm - design @ coefficients)[kept], int(kept.sum())
        spread = np.sqrt(np.sum(left**2, axis=0) / max(count - TERMS, 1))
        sigma = np.sqrt(np.diag(np.linalg.pinv(design[kept].T @ design[kept])))[:, np.newaxis] * spread

    def named(table: Floats, combine: np.ufunc, spreads: Floats) -> dict[str, float]:
        """Return a table's entries by name; `combine` takes the two halves of a turn."""
        offset, along, twist = table[0], table[1:4], table[4:]
        found = {f"offset_{name}": offset[axis] for axis, name in enumerate("xyz")}
        found |= {f"stretch_{name}": along[axis, axis] for axis, name in enumerate("xyz")}
        found |= {"slant_x": along[2, 0], "slant_y": along[2, 1]}
        found |= {"turn": 0.5 * combine(along[0, 1], along[1, 0]), "twist": 0.5 * combine(twist[0, 1], twist[1, 0])}
        found |= {f"spread_{name}": value for name, value in zip("xyz", spreads, strict=True)}
        return {name: float(value) for name, value in found.items()}

    errors = named(sigma, np.hypot, spread / np.sqrt(2.0 * max(count, 1)))
    return named(coefficients, np.subtract, spread), errors


# Beyond this many standard deviations a Gaussian particle is below 1e-4 of its peak.
REACH = 4.3
# Peaks with less light than this share of a typical particle's are noise to any later step.
FAINTEST = 0.2
# A peak is the highest of its neighbouring voxels, three planes taken together; its light lies within two of them.
BOXES = Boxes(sum=(3, 1, 1), peak=(3, 3, 3), light=(5, 3, 3))


def volume_figures(
    volume: Singles, grid: Grid, position_mm: Floats, brightness: Floats, microlens_mm: float
) -> dict[str, float | int]:
    """Return the figures of a volume whose true particles are known.

    Parameters
    ----------
    position_mm, brightness : (n, 3) and (n,) of the true particles, those beyond the volume included
    microlens_mm : pitch of the microlenses as it appears in the scene

    Returns
    -------
    dict
        `q_gaussian`, `q_box`: normalised correlation with the true particles, as Gaussians of a standard deviation of
        one microlens, and as points shared out among their eight nearest voxels; `completeness` and `precision`: shares
        of the particles with a peak and of the peaks with a particle; `ghost_light`: share of the light that belongs to
        no particle, and `ghost_light_uniform`, that of a uniform volume; `elongation_mm`: median depth over which the
        particles found exceed 1/e of their peak; `peaks`, `particles` (in the volume).

    Raises
    ------
    InputError : no particle lies in the volume
    """
    low, high = (np.array([grid.bounds_mm(axis)[side] for axis in range(3)]) for side in (0, 1))
    inside = np.all((position_mm >= low) & (position_mm <= high), axis=1)
    if not inside.any():
        raise InputError("none of the true particles lies in the volume")
    sigma = np.full(3, microlens_mm)
    figures: dict[str, float | int] = {
        "q_gaussian": normalised_correlation(volume, known_volume(grid, position_mm, brightness, sigma)),
        "q_box": normalised_correlation(volume, shared_among_voxels(grid, position_mm, brightness)),
    }
    index, light = find_peaks(volume, BOXES)
    typical = np.median(light[: int(inside.sum())]) if light.size else 0.0
    index = index[light > FAINTEST * typical]
    pairs = match(grid.voxel_to_mm(index), position_mm, microlens_mm / LATERAL_VOXEL)
    lengths = []
    for ix, iy, iz in np.rint(index[pairs.found]).astype(int):
        height = volume[:, iy, ix].astype(np.float64)
        if height[iz] > 0.0:
            lengths.append(elongation_mm(grid.axis_mm(2), height, iz))
    figures |= {
        "completeness": float(inside[pairs.true].sum() / inside.sum()),
        "precision": float(len(pairs.found) / max(len(index), 1)),
        "elongation_mm": float(np.median(lengths)) if lengths else 0.0,
        "peaks": len(index),
        "particles": int(inside.sum()),
    }
    near = near_a_particle(grid, position_mm, microlens_mm)
    total = float(volume.sum(dtype=np.float64))
    figures["ghost_light"] = float(volume[~near].sum(dtype=np.float64)) / total if total > 0.0 else 0.0
    figures["ghost_light_uniform"] = float(np.mean(~near))
    return figures


def normalised_correlation(first: Singles, second: Singles) -> float:
    """Return Q = sum(E F) / sqrt(sum(E^2) sum(F^2)), 0 where a volume is dark."""
    product = np.sum(np.multiply(first, second, dtype=np.float64))
    squares = np.sum(np.square(first, dtype=np.float64)) * np.sum(np.square(second, dtype=np.float64))
    return float(product / np.sqrt(squares)) if squares > 0.0 else 0.0


def known_volume(grid: Grid, position_mm: Floats, brightness: Floats, sigma_mm: Floats) -> Singles:
    """Return particles (n, 3) as Gaussians of standard deviations sigma (3,), each as high as it is bright (n,)."""
    volume = np.zeros(grid.shape_zyx, np.float32)
    add_gaussians(volume, grid.mm_to_voxel(position_mm), brightness, sigma_mm / np.asarray(grid.spacing_mm))
    return volume


def shared_among_voxels(grid: Grid, position_mm: Floats, brightness: Floats) -> Singles:
    """Return particles (n, 3) with their light (n,) shared out among their eight nearest voxels, by distance."""
    volume = np.zeros(grid.shape_zyx)
    index = grid.mm_to_voxel(position_mm)
    corner = np.floor(index).astype(np.int64)
    for offset in np.ndindex(2, 2, 2):
        at = corner + offset
        share = brightness * np.prod(1.0 - np.abs(index - at), axis=1)
        inside = np.all((at >= 0) & (at < grid.shape_xyz), axis=1)
        np.add.at(volume, tuple(at[inside, ::-1].T), share[inside])
    return volume.astype(np.float32)


def near_a_particle(grid: Grid, position_mm: Floats, microlens_mm: float) -> Flags:
    """Return which voxels (z, y, x) have their centre in the ellipsoid around a particle."""
    scale = microlens_mm * np.array([1.0, 1.0, DEPTH_TO_LATERAL])
    tree = KDTree(position_mm / scale)
    y, x = np.meshgrid(grid.axis_mm(1), grid.axis_mm(0), indexing="ij")
    near = np.empty(grid.shape_zyx, np.bool_)
    for k, z in enumerate(grid.axis_mm(2)):
        points = np.stack([x, y, np.full_like(x, z)], axis=-1) / scale
        near[k] = np.isfinite(tree.query(points, distance_upper_bound=1.0)[0])
    return near


@njit(cache=True)
def add_gaussians(volume: Singles, centres: Floats, height: Floats, sigma: Floats) -> None:
    """Add Gaussians of heights (n,) to a volume [z, y, x]; `centres` (n, 3) and `sigma` (3,) in voxels (x, y, z)."""
    shape = (volume.shape[2], volume.shape[1], volume.shape[0])
    profile = np.empty((3, int(2.0 * REACH * sigma.max()) + 3))
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for n in range(centres.shape[0]):
        for axis in range(3):
            low[axis] = max(0, int(np.ceil(centres[n, axis] - REACH * sigma[axis])))
            high[axis] = min(shape[axis], int(np.floor(centres[n, axis] + REACH * sigma[axis])) + 1)
            for k in range(low[axis], high[axis]):
                profile[axis, k - low[axis]] = np.exp(-0.5 * ((k - centres[n, axis]) / sigma[axis]) ** 2)
        for z in range(low[2], high[2]):
            for y in range(low[1], high[1]):
                beside = height[n] * profile[2, z - low[2]] * profile[1, y - low[1]]
                for x in range(low[0], high[0]):
                    volume[z, y, x] += beside * profile[0, x - low[0]]
