"""What scatters places and velocities on the small rig: aperture, noise, depth and the number of tracers.

The camera is known exactly in all of these. Lengths in mm, depths from the middle of the channel.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import Channel
from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.field import REJECTED
from lfpiv_cli.flow.windows import CorrelationSettings
from lfpiv_cli.paper.small_rig import (
    BRIGHTNESS,
    HALF_DEPTH_MM,
    HALF_WIDTH_MM,
    LIGHT_COUNTS,
    PITCH_MM,
    PIXEL_MM,
    SENSOR_PX,
    WATER,
    Case,
    Figures,
    Points,
    Rig,
    Search,
    Tracers,
    judged,
    photograph,
    place_figures,
    rig,
    search_of,
    sheet,
    strewn_apart,
)
from lfpiv_cli.particles.view import lens_pixels, raw_view
from lfpiv_cli.reconstruction.solvers import SolverSettings
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.tracks.candidates import Seen
from lfpiv_cli.tracks.tracking import track
from lfpiv_cli.validation.planning import cramer_rao_bound, expected_image, pixel_variance, slopes
from lfpiv_cli.validation.volume import match, particle_figures

# Table 2's tank: the focal plane 134 mm deep in water, behind 2 mm of acrylic 98 mm from the lens.
TANK = Channel(2.0 * 133.867, 2.0)
# Room for tracers up to 10 mm before and behind the focal plane.
WIDE_CHANNEL = Channel(25.0, 5.0)
BAND_MM = 0.25
# A crowded scene fills the paper's channel but for what tracers move, and reaches so far beyond what the sensor sees.
CROWD_DEPTH_MM, BEYOND_MM = 9.6, 0.15
# Displacement of a tracer at (x, y, z): (0.13 + 0.01 z, 0.07, 0.2 + 0.1 x), mm.
UNIFORM_MM, DEPTH_SHEAR, LATERAL_SHEAR = (0.13, 0.07, 0.2), 0.01, 0.1
SEARCH_MM = 0.6
# As benchmarks of the correlation have it: voxels of a third of a microlens, accelerated EM.
VOXEL_MM, WINDOW_VOXELS, EXPONENT = (0.1 / 3.0, 0.1 / 3.0, 0.2), (24, 24, 8), 0.5
CROWD_VOXEL_MM = (0.1, 0.1, 0.1)
EM = SolverSettings("em", 24)


def at_f_number(f_number: float, seed: int) -> Figures:
    """Return the figures behind the paper's tank, rays taken as they are (exact) and as paraxial ones."""
    rng = np.random.default_rng([seed, 2])
    exact = rig(sheet(f_number), WATER, TANK)
    paraxial = replace(exact, refraction="paraxial")
    tracers = strewn_apart(rng, (-HALF_DEPTH_MM, HALF_DEPTH_MM), HALF_WIDTH_MM)
    image = photograph(exact, tracers, Readout(), rng)
    found = {
        name: judged(search_of(Case(exact, seen)).particles(image), tracers)
        for name, seen in (("exact", exact), ("paraxial", paraxial))
    }
    return {f"{name}_{figure}": value for name, figures in found.items() for figure, value in figures.items()}


def spherical_aberration_mm(f_number: float) -> float:
    """Return how much nearer paraxial rays see what lies in the middle of the tank, to third order.

    A layer t of index n moves a ray of slope u sideways by t (u/n) (1 - (1 - 1/n^2) u^2/2); over a disc u^3 has its
    least-squares line at 2/3 of the rim's u^2.
    """
    camera = sheet(f_number)
    rim2 = (camera.aperture_radius_mm / camera.focus_distance_mm) ** 2
    layers = ((TANK.wall_mm, WATER.window), (0.5 * TANK.width_mm, WATER.fluid))
    apparent = sum(t / n * (1.0 - n**-2) for t, n in layers) * 0.5 * (2.0 / 3.0) * rim2
    return float(apparent / WATER.depth_ratio)


def in_noise(read_over_light: float, seed: int) -> Figures:
    """Return the figures with read noise of so many times the light of a lit pixel, and the bound of their scatter."""
    rng = np.random.default_rng([seed, 7])
    known = rig(sheet())
    view = raw_view(known.camera, WATER, 0.025, None, known.space)
    readout = replace(Readout(), read_noise_counts=read_over_light * LIGHT_COUNTS / lens_pixels(view))
    tracers = strewn_apart(rng, (-HALF_DEPTH_MM, HALF_DEPTH_MM), HALF_WIDTH_MM)
    places = np.column_stack([known.reference.points_to_focal_point(tracers.position_mm), tracers.light_counts])
    slope = slopes(view, places)
    bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, places), readout)).sigma_mm(joint=True)
    figures = place_figures(Case(known, known), tracers, readout, rng)
    return figures | {f"bound_{name}": float(np.median(values)) for name, values in zip("xyz", bound.T, strict=True)}


def at_depth(distance_mm: float, seed: int) -> Figures:
    """Return errors of tracers this far before and behind the focal plane."""
    rng = np.random.default_rng([seed, 8])
    known = rig(sheet(), WATER, WIDE_CHANNEL)
    tracers = strewn_apart(rng, (max(distance_mm - BAND_MM, 0.0), distance_mm + BAND_MM), HALF_WIDTH_MM)
    tracers.position_mm[:, 2] *= rng.choice([-1.0, 1.0], len(tracers.position_mm))
    image = photograph(known, tracers, Readout(), rng)
    found = search_of(Case(known, known, 22.0)).particles(image)
    pairs = match(found, tracers.position_mm, PITCH_MM)
    return _scatter(pairs.error_voxel * PITCH_MM) | {
        "recall": len(pairs.true) / len(tracers.position_mm),
        "precision": len(pairs.found) / max(len(found), 1),
    }


def crowded(per_lens: float, seed: int) -> Figures:
    """Return errors of places, and of displacements by tracks and by volumes, of so many tracers a microlens."""
    rng = np.random.default_rng([seed, 1])
    known = rig(sheet())
    tracers = strewn(per_lens, rng)
    pair = [tracers.moved(sign * 0.5 * displacement(tracers.position_mm)) for sign in (-1.0, 1.0)]
    images = [photograph(known, each, Readout(), rng) for each in pair]
    seen = SENSOR_PX * PIXEL_MM
    search = Search(known, (seen, seen, CROWD_DEPTH_MM), search_voxel_mm=CROWD_VOXEL_MM)
    found = [search.particles(image) for image in images]
    inner = np.array([HALF_WIDTH_MM, HALF_WIDTH_MM, 0.5 * CROWD_DEPTH_MM])
    places = particle_figures(found[0], pair[0].position_mm, -inner, inner, PITCH_MM)
    kept = {name: places.get(f"rms_{name}_voxel", np.nan) * PITCH_MM for name in "xz"}
    figures = {"recall": places["recall"], "precision": places["precision"], "rms_x": kept["x"], "rms_z": kept["z"]}
    by_tracks = _tracked(found[0], found[1], known, inner)
    by_volumes = _correlated(search, images, inner)
    named = (("tracks", by_tracks), ("volumes", by_volumes))
    return figures | {f"{name}_{key}": value for name, each in named for key, value in each.items()}


def strewn(per_lens: float, rng: np.random.Generator, depth_mm: float = CROWD_DEPTH_MM) -> Tracers:
    """Return tracers strewn at random before and beside what the sensor sees."""
    half = np.array([0.5 * SENSOR_PX * PIXEL_MM + BEYOND_MM] * 2 + [0.5 * depth_mm])
    count = max(1, round(per_lens * (2.0 * half[0] / PITCH_MM) ** 2))
    return Tracers(rng.uniform(-half, half, (count, 3)), LIGHT_COUNTS * rng.uniform(*BRIGHTNESS, count))


def displacement(points_mm: Points) -> Points:
    """Return by how much tracers at points (n, 3) move in a pair."""
    moved = np.tile(np.asarray(UNIFORM_MM), (len(points_mm), 1))
    moved[:, 0] += DEPTH_SHEAR * points_mm[:, 2]
    moved[:, 2] += LATERAL_SHEAR * points_mm[:, 0]
    return moved


def tracks_between(first: Points, second: Points, known: Rig) -> tuple[Points, Points]:
    """Return the middles (n, 3) of a pair's tracks and their displacements (n, 3)."""
    tracks = track(Seen(first), Seen(second), SEARCH_MM, known.camera.scale(known.media))
    a, b = first[tracks.first], second[tracks.second]
    return 0.5 * (a + b), b - a


def _tracked(first: Points, second: Points, known: Rig, inner: NDArray[np.float64]) -> Figures:
    middle, moved = tracks_between(first, second, known)
    inside = np.all(np.abs(middle) <= inner, axis=1)
    return _velocity_figures(moved[inside], displacement(middle[inside]))


def _correlated(search: Search, images: list[NDArray[np.float32]], inner: NDArray[np.float64]) -> Figures:
    (first, grid), (second, _) = (search.volume(image, VOXEL_MM, EM) for image in images)
    settings = CorrelationSettings([WINDOW_VOXELS], (0.5, 0.5, 0.5), None, EXPONENT)
    field = correlate([(first, second)], grid, settings)
    centres = field.grid.centres_mm()
    kept = (field.flag < REJECTED) & np.all(np.abs(centres) <= inner, axis=-1)
    return _velocity_figures(field.displacement_voxel[kept] * VOXEL_MM, displacement(centres[kept]))


def _velocity_figures(moved: Points, true: Points) -> Figures:
    """Return the slope through zero and the rms error of displacements (n, 3) along x and z, mm."""
    if not len(moved):
        return {name: float("nan") for name in ("slope_u", "slope_w", "rms_u", "rms_w")}
    slope = np.sum(moved * true, axis=0) / np.sum(true**2, axis=0)
    rms = np.sqrt(np.mean((moved - true) ** 2, axis=0))
    named = (("slope_u", slope[0]), ("slope_w", slope[2]), ("rms_u", rms[0]), ("rms_w", rms[2]))
    return {name: float(value) for name, value in named}


def _scatter(error_mm: Points) -> Figures:
    """Return robust spread and rms of errors (n, 3) along x and z."""
    if not len(error_mm):
        return {name: float("nan") for name in ("spread_x", "spread_z", "rms_x", "rms_z")}
    spread, rms = MAD_TO_SIGMA * np.median(np.abs(error_mm), axis=0), np.sqrt(np.mean(error_mm**2, axis=0))
    named = (("spread_x", spread[0]), ("spread_z", spread[2]), ("rms_x", rms[0]), ("rms_z", rms[2]))
    return {name: float(value) for name, value in named}
