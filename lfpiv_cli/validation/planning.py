"""What a rig will see and how much it can tell, before it records anything: lengths, seeding, times.

Axes: world x, y, z in mm, z away from the camera from the nominal focal point; pairs of lengths are along world (x, y).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.flow.windows import ROUNDING
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.particles.least_squares import lit_by, respond_all, room_for
from lfpiv_cli.particles.view import Light, View, entry_capacity, raw_view
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.render import Readout
from lfpiv_cli.weights.build import default_padding, factorise

# What is looked at: the middle of an image, so many microlenses wide.
LENSES = 36
# Voxels in microlenses, and planes in depths of one lens: coarse, as only depths are asked for.
VOXEL_LENSES, PLANE_DEPTHS = 0.5, 0.5
# The volume is made longer at either end by this share of it, by two depths of one lens at least, and by ten at most.
LONGER, LEAST_DEPTHS, MOST_DEPTHS = 0.75, 3.0, 10.0
# Light this near to the volume, in depths of one lens, may be from within it.
NEAR_DEPTHS = 1.0
# Of the way to the lens volumes keep clear.
CLEAR = 0.5
SOLVER = SolverSettings("em", 8, accelerate=True)


def share_beyond(camera: Camera, media: Media, z_mm: tuple[float, float], light: Singles) -> float:
    """Return the share of an image's light that a longer volume puts before or behind the volume.

    Parameters
    ----------
    camera : aligned with the image, as rectified
    z_mm : ends of the volume, from the focal point
    light : (rows, columns) without background and noise
    """
    side = int(round(LENSES * float(camera.micro_image_lattice_px().pitch.mean())))
    rows, columns = (min(size, side + (size - side) % 2) for size in light.shape)
    top, left = (light.shape[0] - rows) // 2, (light.shape[1] - columns) // 2
    small = replace(camera, rows=rows, columns=columns)
    image = np.ascontiguousarray(light[top : top + rows, left : left + columns])
    if not image.any():
        return 0.0
    # coarse voxels in all that is seen, at the depths of the volume and beyond
    scale = camera.scale(media)
    length = z_mm[1] - z_mm[0]
    longer = float(np.clip(LONGER * length, LEAST_DEPTHS * scale.depth_mm, MOST_DEPTHS * scale.depth_mm))
    low = max(z_mm[0] - longer, -CLEAR * camera.focus_distance_mm / media.depth_ratio)
    high = z_mm[1] + longer
    lateral, plane = VOXEL_LENSES * scale.lens_mm, PLANE_DEPTHS * scale.depth_mm
    sides = np.array([small.columns, small.rows]) * camera.pixel_mm / abs(camera.magnification)
    if camera.column_axis == "y":
        sides = sides[::-1]
    nx, ny = (max(1, round(side / lateral)) for side in sides)
    nz = max(1, round((high - low) / plane))
    grid = Grid.centred((nx, ny, nz), (lateral, lateral, (high - low) / nz), (0.0, 0.0, 0.5 * (low + high)))
    grid = grid.padded(default_padding(small, media, grid))
    volume = reconstruct(factorise(small, media, grid), image, SOLVER).volume
    by_depth, depths = volume.sum(axis=(1, 2), dtype=np.float64), grid.axis_mm(2)
    near = NEAR_DEPTHS * scale.depth_mm
    beyond = (depths < z_mm[0] - near) | (depths > z_mm[1] + near)
    return float(by_depth[beyond].sum() / max(float(by_depth.sum()), np.finfo(np.float64).tiny))


# How well the particles of a raw image can be known at best: the Cramer-Rao bound.
#
# With f the expected image, V the variance of each pixel and J = df/d(x, y, z, light) of every particle, the Fisher
# information of an image with read and shot noise is
#
#     F = J^T V^-1 J                                                  (Kay 1993, Eq. 3.31, V taken as known)
#
# and no estimate without bias has a smaller covariance than F^-1. F is sparse: particles that share no pixel have no
# block in common. Each *alone*, the others known exactly, has the inverse of its own block; *jointly*, its block of
# the inverse of the whole.
#
# Axes: image axes, see `particles.view`; a particle is a row (x, y, z, light), mm and counts; images are flat.

UNKNOWNS = 4
# Rounding to whole counts adds the variance of an even spread over one.
ROUNDING_VARIANCE = 1.0 / 12.0
# Variance that evenly spread rays give a fitted place, over that which as many photons would: of tracers of 50 um at
# 0.8 to 4 mm from the paper's focal plane it is 0.2 to 0.4.
RAY_VARIANCE = 0.3
# Two particles in one place make F singular. So little more than F, whose diagonal is scaled to 1, makes their errors
# large in place of infinite.
RIDGE = 1e-10


@dataclass(frozen=True, eq=False)
class Bound:
    """Smallest covariances (n, 4, 4) of each particle, its neighbours known (`alone`) or to be found (`joint`)."""

    alone: Floats
    joint: Floats

    def sigma_mm(self, joint: bool) -> Floats:
        """Return the smallest standard errors (n, 3) of x, y and z."""
        chosen = self.joint if joint else self.alone
        return np.asarray(np.sqrt(np.diagonal(chosen, axis1=1, axis2=2)[:, :3]))


def slopes(view: View, particles: Floats) -> sparse.csc_array:
    """Return J (pixels, 4 n): what each particle's x, y, z and light do to the expected image."""
    depths = (float(particles[:, 2].min()), float(particles[:, 2].max())) if len(particles) else (0.0, 0.0)
    capacity = entry_capacity(view, *depths)
    room = room_for(1, capacity, 0)
    rows, columns, entries = [], [], []
    for number, particle in enumerate(particles):
        respond_all(view, particle[np.newaxis], room)
        pixels, values = lit_by(room, 0)
        light, count = particle[3], pixels.size
        rows.append(np.tile(pixels, UNKNOWNS))
        columns.append(np.repeat(UNKNOWNS * number + np.arange(UNKNOWNS), count))
        entries.append((values[[1, 2, 3, 0], :count] * [[light], [light], [light], [1.0]]).ravel())
    shape = (view.camera.rows * view.camera.columns, UNKNOWNS * len(particles))
    if not rows:
        return sparse.csc_array(shape)
    # A pixel that is lit through two lenses may be named twice and is added up here.
    indices = (np.concatenate(rows), np.concatenate(columns))
    return sparse.csc_array(sparse.coo_array((np.concatenate(entries), indices), shape=shape))


def expected_image(slope: sparse.csc_array, particles: Floats) -> Floats:
    """Return the expected counts (pixels,) of particles from their `slopes`."""
    return np.asarray(slope[:, 3::UNKNOWNS] @ particles[:, 3])


def pixel_variance(expected_counts: Floats, readout: Readout, counts_per_ray: float = 0.0) -> Floats:
    """Return the variance (pixels,) of recorded pixels: read noise, rounding, light's own noise, and that of its rays.

    Parameters
    ----------
    counts_per_ray : of an image that was rendered ray by ray
    """
    shot = 0.0 if readout.photons_per_count is None else 1.0 / readout.photons_per_count
    gain = shot + RAY_VARIANCE * counts_per_ray
    return np.asarray(readout.read_noise_counts**2 + ROUNDING_VARIANCE + gain * np.maximum(expected_counts, 0.0))


def cramer_rao_bound(slope: sparse.csc_array, variance: Floats) -> Bound:
    """Return the bound of each particle from the `slopes` of all and the variance (pixels,) of the image.

    Jointly, the particles that share pixels with a particle are free and those further away held: what these would add
    is of second order, a thousandth at the paper's seeding.
    """
    weighted = slope.multiply(1.0 / variance[:, np.newaxis])
    information = sparse.csr_array(slope.T @ weighted)
    count = information.shape[0] // UNKNOWNS
    alone, joint = np.empty((count, UNKNOWNS, UNKNOWNS)), np.empty((count, UNKNOWNS, UNKNOWNS))
    for number in range(count):
        own = UNKNOWNS * number + np.arange(UNKNOWNS)
        overlapping = np.setdiff1d(information[own].indices // UNKNOWNS, number)
        others = (UNKNOWNS * overlapping[:, np.newaxis] + np.arange(UNKNOWNS)).ravel()
        members = np.concatenate([own, others])
        matrix = information[members][:, members].toarray()
        alone[number] = _first_block_of_inverse(matrix[:UNKNOWNS, :UNKNOWNS])
        joint[number] = _first_block_of_inverse(matrix)
    return Bound(alone, joint)


def errors_alone_mm(view: View, particles: Floats, readout: Readout, counts_per_ray: float = 0.0) -> Floats:
    """Return the bound (n, 3) of x, y and z of particles each of which is alone in an image of its own."""
    errors = np.empty((len(particles), 3))
    for number, particle in enumerate(particles):
        slope = slopes(view, particle[np.newaxis])
        variance = pixel_variance(expected_image(slope, particle[np.newaxis]), readout, counts_per_ray)
        errors[number] = cramer_rao_bound(slope, variance).sigma_mm(joint=False)[0]
    return errors


def _first_block_of_inverse(matrix: Floats) -> Floats:
    """Return the first (4, 4) of a symmetric matrix's inverse; a diagonal of 0 is of something that cannot be known."""
    diagonal = np.diag(matrix)
    known = diagonal > 0.0
    scale = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 0.0)
    scaled = matrix * scale * scale[:, np.newaxis] + np.diag(np.where(known, RIDGE, 1.0))
    solved = cho_solve(cho_factor(scaled), np.eye(len(matrix), UNKNOWNS))[:UNKNOWNS]
    block = solved * scale[:UNKNOWNS] * scale[:UNKNOWNS, np.newaxis]
    block[np.diag_indices(UNKNOWNS)] += np.where(known[:UNKNOWNS], 0.0, np.inf)
    return np.asarray(block)


# Tracers for each microlens in view that serve velocity best: each lights about as many pixels as a microlens has, so
# that with one of them the pixels of neighbours overlap, and particles go wrong from two on.
BEST_PER_LENS = 0.5
SPARSE_PER_LENS, CROWDED_PER_LENS, MOST_PER_LENS = 0.05, 1.3, 3.0
# Interrogation windows of the paper's channel, in microlenses and depths of one lens: at the best seeding some twenty
# tracers.
WINDOW_LENSES, WINDOW_DEPTHS = 16.0, 1.5
# A field is worth looking at from so many vectors along each axis on. Windows are smaller for them as long as they hold
# so many tracers, and a fifth more as they come in whole voxels; and no shallower than tracers are in a volume, about a
# depth of one lens.
WORTH_VECTORS, FEWEST_TRACERS, TRACERS_AIMED_AT, LEAST_WINDOW_DEPTHS = 10, 5.0, 6.0, 1.0
# Displacements in voxels that are large against the errors and small against a coarse window.
SMALLEST_STEP, BEST_STEP, LARGEST_STEP = 3.0, 5.0, 8.0
# Places in front of a lens that stand for all: multiples of two irrational numbers lie evenly. In the middle of the
# camera, where lenses are whole.
PLACES, STEPS = 8, np.array([0.7548776662466927, 0.5698402909980532])
# Beyond the light of a tracer a camera in miniature has so many lenses.
LENSES_AROUND = 3
# Before and behind a depth alone, in depths over which light spreads by one lens: waves are computed about it.
ABOUT_DEPTH = 1e-3
# Planes of a box in which its share in view is looked at.
VIEW_PLANES = 41
# Rounds in which light and number of an image's tracers are told from each other.
ROUNDS = 4
# Pixels are lit that a lens image's rim only touches.
RIM_PX = 0.43
# Of the pixels that lens images reach; where more are lit, tracers cannot be counted.
MOST_LIT = 0.98


@dataclass(frozen=True)
class Tracer:
    """A tracer alone: its light in counts, its radius in mm, and the sensor that records it."""

    light_counts: float
    radius_mm: float
    readout: Readout


class Miniature(NamedTuple):
    """The view of a sensor just large enough for the light of tracers in its middle, at depths (n,)."""

    view: View
    depths_mm: Floats


def half_view_mm(camera: Camera, media: Media, z_mm: ArrayLike, rim: float = -1.0) -> Floats:
    """Return half the field of view (n, 2) along x and y at depths (n,), 0 where there is none.

    Parameters
    ----------
    rim : radii of a point's light on the array that may lie beyond the sensor's edge: -1, all of a point's light is
        seen; 0, half of it; 1, it is seen at all
    """
    distance = equivalent_object_distance(z_mm, camera.focus_distance_mm, media)
    # A lens at the sensor's edge is cut.
    blur = np.abs(camera.defocus(distance)) * camera.aperture_radius_mm + 0.5 * float(camera.lattice.pitch.max())
    half = 0.5 * camera.pixel_mm * np.array([camera.columns, camera.rows]) / camera.micro_image_scale
    on_array = half + rim * blur[..., np.newaxis]
    seen = np.maximum(on_array, 0.0) * (distance / camera.image_distance_mm)[..., np.newaxis]
    return np.asarray(seen if camera.column_axis == "x" else seen[..., ::-1])


def share_in_view(camera: Camera, media: Media, bounds_mm: Floats) -> float:
    """Return the share of a box's volume in which all of a point's light is seen.

    Parameters
    ----------
    bounds_mm : (3, 2) lowest and highest x, y, z of the box
    """
    half = half_view_mm(camera, media, np.linspace(bounds_mm[2, 0], bounds_mm[2, 1], VIEW_PLANES))
    low, high = np.maximum(bounds_mm[:2, 0], -half), np.minimum(bounds_mm[:2, 1], half)
    sides = np.maximum(high - low, 0.0) / np.diff(bounds_mm[:2])[:, 0]
    return float(np.mean(np.prod(sides, axis=1)))


def part_in_front(camera: Camera, media: Media, bounds_mm: Floats) -> tuple[slice, slice]:
    """Return the rows and columns of an image that look at the middle of a box, bounds (3, 2)."""
    middle = float(bounds_mm[2].mean())
    distance = float(equivalent_object_distance(middle, camera.focus_distance_mm, media))
    corners = camera.to_image_axes(bounds_mm[:2].T) * (-camera.image_distance_mm / distance)
    ends = np.sort(camera.mm_to_px(corners), axis=0)
    low = np.clip(np.rint(ends[0]), 0, [camera.columns - 1, camera.rows - 1]).astype(int)
    high = np.maximum(np.rint(ends[1]).astype(int), low + 1)
    return slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0]))


def depth_of_field_mm(camera: Camera, media: Media) -> float:
    """Return how far before and behind the focal plane points can be refocused.

    There their light reaches as many lenses across as a lens has pixels, and each lens sees it in one pixel.
    """
    return camera.scale(media).depth_mm * pixels_per_lens(camera)


def pixels_per_lens(camera: Camera) -> float:
    """Return the pixels across a lens image: the views from across the aperture."""
    return float(camera.micro_image_lattice_px().pitch.mean())


def tracers_in(camera: Camera, per_lens: float, sides_mm: ArrayLike) -> float:
    """Return the tracers in a box of sides (2 or 3,) for so many in front of each microlens that looks into it."""
    width, height = np.asarray(sides_mm, dtype=np.float64)[:2] * abs(camera.magnification)
    return float(per_lens * width * height / camera.lattice.cell_area)


def proposed_window_mm(camera: Camera, media: Media, sides_mm: ArrayLike, overlap: ArrayLike) -> Floats:
    """Return the sides (3,) of the final interrogation windows in a volume of sides (3,), at the best seeding.

    They are the paper's, or smaller where these give fewer than ten vectors along an axis, as far as tracers allow it;
    in three digits.
    """
    scale, sides = camera.scale(media), np.asarray(sides_mm, dtype=np.float64)
    papers = np.array([WINDOW_LENSES * scale.lens_mm] * 2 + [WINDOW_DEPTHS * scale.depth_mm])
    for_ten = sides / (WORTH_VECTORS * (1.0 - np.asarray(overlap)))
    least = np.array([0.0, 0.0, LEAST_WINDOW_DEPTHS * scale.depth_mm])
    share = np.minimum(np.maximum(np.minimum(papers, for_ten), least) / sides, 1.0)
    needed = TRACERS_AIMED_AT / tracers_in(camera, BEST_PER_LENS, sides)
    for free in range(3, 0, -1):  # along one axis after the other they may reach the whole volume
        if (missing := needed / float(np.prod(share))) > 1.0:
            share = np.where(share < 1.0, np.minimum(share * missing ** (1.0 / free), 1.0), 1.0)
    digit = 10.0 ** (np.floor(np.log10(share * sides)) - 2.0)
    return np.asarray(np.round(np.floor(share * sides / digit + ROUNDING) * digit, 9))


def time_step_s(velocity_m_s: float, voxel_mm: float) -> float:
    """Return the time in which a velocity crosses the best number of voxels."""
    return BEST_STEP * voxel_mm / (abs(velocity_m_s) * 1e3)


def errors_by_depth_mm(seen: Sequence[Miniature], tracer: Tracer, counts_per_ray: float = 0.0) -> Floats:
    """Return the smallest errors (n, 3) of x, y and z, rms over places, of a tracer alone at depths (n,).

    The Cramer-Rao bound; no image tells more. `counts_per_ray` is of images that are rendered ray by ray.
    """
    particles = [_particles(each, tracer.light_counts) for each in seen]
    each = zip(seen, particles, strict=True)
    errors = [errors_alone_mm(one.view, some, tracer.readout, counts_per_ray) for one, some in each]
    return np.asarray(np.sqrt(np.mean(np.concatenate(errors).reshape(-1, PLACES, 3) ** 2, axis=1)))


def tracers_per_lens(camera: Camera, seen: Sequence[Miniature], lit: tuple[float, float, float]) -> tuple[float, float]:
    """Return how many tracers for each lens lit an image, and the light of one; infinitely many where all is lit.

    Unlike the unevenness of the light (`particles.counting`) this needs few lenses and tracers, which may differ in
    their light, and ends where hardly a pixel is dark.
    Tracers lie about at random, so that the share of pixels that stay dark falls exponentially with their number.

    Parameters
    ----------
    seen : of tracers as they are
    lit : share of the pixels above a level, that level in counts, mean counts of a pixel above the background
    """
    share, level, mean = lit
    pitch, cell = pixels_per_lens(camera), camera.micro_image_lattice_px().cell_area
    radius = 0.5 * pitch * min(camera.lens_image_fill, 1.0) + RIM_PX
    most = min(float(np.pi * radius**2 / cell), 1.0)
    if share >= MOST_LIT * most:
        return np.inf, 0.0
    number, light = -np.log(1.0 - share / most), 0.0
    if number <= 0.0:
        return 0.0, 0.0
    for _ in range(ROUNDS):
        light = mean * cell / number
        counts = []
        for one in seen:
            room = room_for(1, entry_capacity(one.view, float(one.depths_mm.min()), float(one.depths_mm.max())), 0)
            for particle in _particles(one, light):
                respond_all(one.view, particle[np.newaxis], room)
                pixels, values = lit_by(room, 0)
                image = np.bincount(pixels, light * values[0, : pixels.size])
                counts.append(int(np.count_nonzero(image > level)))
        each = float(np.mean(counts))
        number = -np.log(1.0 - share / most) * most * cell / max(each, 1.0)
    return float(number), float(light)


def in_miniature(
    camera: Camera, media: Media, depths_mm: ArrayLike, radius_mm: float, light: Light | None = None
) -> list[Miniature]:
    """Return how tracers at depths (n,) are seen: by rays by one view, by waves by a view of each depth.

    Parameters
    ----------
    light : as waves, whatever its depths; None: by rays
    """
    depths = np.asarray(depths_mm, dtype=np.float64)
    seen, about = [(depths, light)], ABOUT_DEPTH * camera.scale(media).depth_mm
    if light is not None:
        lights = [replace(light, depths_mm=(float(depth) - about, float(depth) + about)) for depth in depths]
        seen = [(depths[n : n + 1], each) for n, each in enumerate(lights)]
    found = []
    for own, each in seen:
        distance = equivalent_object_distance(own, camera.focus_distance_mm, media)
        blur = np.abs(camera.defocus(distance)) * camera.aperture_radius_mm
        reach = float(np.max(blur + radius_mm * camera.image_distance_mm / distance))
        reach += LENSES_AROUND * float(camera.lattice.pitch.max())
        # As many more as there are fewer on the other side: lenses stay where they are.
        columns, rows = (2 * int(np.ceil(reach / camera.pixel_mm)) + side % 2 for side in (camera.columns, camera.rows))
        view = raw_view(replace(camera, columns=columns, rows=rows), media, radius_mm, light=each)
        found.append(Miniature(view, own))
    return found


def _particles(seen: Miniature, light: float) -> Floats:
    """Return particles (depths * PLACES, 4) whose light is at places all over a lens."""
    view, depths_mm = seen
    cell = (np.outer(np.arange(PLACES) + 0.5, STEPS) % 1.0 - 0.5) @ np.linalg.inv(view.inverse_basis)
    beta = view.camera.image_distance_mm / (view.camera.focus_distance_mm + view.depth_ratio * depths_mm)
    lateral = -cell[np.newaxis] / beta[:, np.newaxis, np.newaxis]
    columns = np.broadcast_to(depths_mm[:, np.newaxis, np.newaxis], (depths_mm.size, PLACES, 1))
    lights = np.full_like(columns, light)
    return np.concatenate([lateral, columns, lights], axis=2).reshape(-1, 4)
