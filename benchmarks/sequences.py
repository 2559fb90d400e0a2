"""Sequences: rendered frames of tracers in a flow, found and tracked together as by `lfpiv follow`, against the truth.

The camera of Table 2, a third of its sensor, calibrated from rendered pictures; tracers of 50 um in water behind the
channel's wall, by Snell's law, between two sharp edges of the light in depth; flows from steady to turbulent.

Axes: (x, y, z) in mm, z from the focal point; times in frames.
"""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from benchmarks.particles import DIAMETER_MM, LIGHT_COUNTS, VOXEL_MM, Bench, calibrated
from lfpiv_cli.files.particle_file import symmetric
from lfpiv_cli.particles.neighbour_frames import Predicted, find_predicted, second_pass
from lfpiv_cli.particles.rounds import first_pass
from lfpiv_cli.particles.stated import Particles, result
from lfpiv_cli.synthetic.flows import Flow, advect, random_modes, square_duct, taylor_green
from lfpiv_cli.tracks import sequences
from lfpiv_cli.tracks.candidates import Light, Seen, long_ones
from lfpiv_cli.tracks.sequences import PartialTracks, Prediction, begun, expected_in, extended, scatter_in, states_at
from lfpiv_cli.validation.volume import match

SHAPE, VOLUME_XYZ, COUNT, FRAMES = (880, 880), (36, 36, 100), 830, 12
# Light beside the volume that its pixels see, mm.
MARGIN_MM = np.array([0.4, 0.4, 0.0])
DT_S, VOXEL_M_S = 1e-3, 0.1
# Displacements up to half the mean distance of neighbours, and up to three times it.
FLOWS: dict[str, Flow] = {
    "duct": square_duct(10.0, 1.9 * VOXEL_M_S),
    "fast duct": square_duct(10.0, 4.5 * VOXEL_M_S),
    "Taylor-Green": taylor_green(3.0 * VOXEL_M_S, 8.0),
    "random modes": random_modes(1.5 * VOXEL_M_S, seed=1),
}
# Places of the tracks that are judged.
SHORTEST = 4
DISTANCES_MM = ((0.0, np.inf), (0.0, 0.5), (0.5, 2.0), (2.0, np.inf))

Points = NDArray[np.float64]


def bench_sequences() -> None:
    """Print recall, precision and errors of tracks in sequences, once and both ways, by the distance from focus."""
    bench = calibrated(SHAPE, VOLUME_XYZ, seed=0)
    for number, name in enumerate(FLOWS):
        print_sequence(bench, name, COUNT, FRAMES, seed=700 + number)


def print_sequence(bench: Bench, name: str, count: int, frames: int, seed: int) -> None:
    """Render a sequence, follow it and print a line for each range of depths."""
    images, true = photographs(bench, FLOWS[name], count, frames, np.random.default_rng(seed))
    began = time.process_time()
    found, partial = followed(bench, images)
    print_figures(f"{name}, {count}, forwards", bench, found, partial, true, time.process_time() - began)
    began = time.process_time()
    found, partial = followed_again(bench, images, found, partial)
    print_figures(f"{name}, {count}, both ways", bench, found, partial, true, time.process_time() - began)


def print_figures(
    name: str, bench: Bench, found: list[Seen], partial: PartialTracks, true: Points, seconds: float
) -> None:
    """Print a line for each range of depths."""
    for distances in DISTANCES_MM:
        figures = track_figures(bench, found, partial, true, distances)
        if figures is None:
            continue
        text = "  ".join(f"{key} {value:.4f}" for key, value in figures.items())
        near, far = distances
        print(f"{name}, {seconds / len(true):.1f} CPU s a frame, |z| {near:g} to {far:g} mm: {text}", flush=True)


def photographs(
    bench: Bench, flow: Flow, count: int, frames: int, rng: np.random.Generator
) -> tuple[list[NDArray[np.float32]], Points]:
    """Return the images and where each tracer is in each of them (frames, n, 3), NaN where it is not lit."""
    low, high = bench.bounds_mm()
    speed = 1e3 * DT_S * np.abs(flow(rng.uniform(low, high, (2000, 3)))).max(axis=0)
    wide = MARGIN_MM + 0.5 * frames * speed
    around = round(count * np.prod(high - low + 2.0 * wide) / np.prod(high - low))
    start, light = rng.uniform(low - wide, high + wide, (around, 3)), LIGHT_COUNTS * rng.uniform(0.6, 1.4, around)
    # Tracers are solid.
    within = KDTree(start).query_pairs(DIAMETER_MM, output_type="ndarray")[:, 1]
    start, light = np.delete(start, within, axis=0), np.delete(light, within)
    images, true = [], []
    at = advect(flow, start, -0.5 * (frames - 1) * DT_S)
    for _ in range(frames):
        lit = np.all((at > low - MARGIN_MM) & (at < high + MARGIN_MM), axis=1)
        images.append(bench.photograph(at[lit], light[lit], rng))
        true.append(np.where(lit[:, np.newaxis], at, np.nan))
        at = advect(flow, at, DT_S)
    return images, np.array(true)


def followed(bench: Bench, images: list[NDArray[np.float32]]) -> tuple[list[Seen], PartialTracks]:
    """Return the particles of each frame, and how they belong together."""
    tasks = [bench.task(image) for image in images]
    own = [first_pass(task).particles for task in tasks[:2]]
    found = [_seen(result(tasks[k], second_pass(tasks[k], own[k], [own[1 - k]]))) for k in range(2)]
    scale = tasks[0].view.scale
    partial = extended(begun(found), found, None, scale)
    for task in tasks[2:]:
        state = find_predicted(task, _predicted(bench, partial.ahead))
        found.append(_seen(result(task, first_pass(task) if state is None else state)))
        partial = extended(partial, found, None, scale)
    return found, partial


def followed_again(
    bench: Bench, images: list[NDArray[np.float32]], found: list[Seen], partial: PartialTracks
) -> tuple[list[Seen], PartialTracks]:
    """Return the same after a second pass, in which each frame is expected by its tracks before and after it."""
    confirmed, again = long_ones(partial.found, sequences.SHORTEST), []
    for number, image in enumerate(images):
        task = bench.task(image)
        state = find_predicted(task, _predicted(bench, expected_in(confirmed, found, number)))
        again.append(_seen(result(task, first_pass(task) if state is None else state)))
    partial, scale = begun(again), bench.task(images[0]).view.scale
    while partial.last < len(again) - 1:
        partial = extended(partial, again, None, scale)
    return again, partial


def track_figures(
    bench: Bench, found: list[Seen], partial: PartialTracks, true: Points, distances_mm: tuple[float, float]
) -> dict[str, float] | None:
    """Return recall, precision and errors in voxels of the places of confirmed tracks, this far from the focal plane.

    Recall is of tracers that as many frames hold as a track must have. None where no track is.
    """
    low, high = bench.judged_mm()

    def counted(points: Points) -> NDArray[np.bool_]:
        depth = np.abs(points[:, 2])
        inside = np.all((points > low) & (points < high), axis=1)
        return np.asarray(inside & (depth >= distances_mm[0]) & (depth < distances_mm[1]))

    inside = np.all((true > low) & (true < high), axis=2)
    tracks = long_ones(partial.found, SHORTEST)
    scatter, half = scatter_in(tracks, found)
    wanted = hit = shown = right = changed = links = 0
    errors, before = [], np.full(tracks.count, -1)
    for k, at in enumerate(true):
        numbers, state = states_at(tracks, found, float(k), scatter, half)
        lit = np.flatnonzero(np.isfinite(at[:, 0]))
        matches = match(state.position_mm, at[lit], VOXEL_MM)
        tracer = np.full(len(numbers), -1)
        tracer[matches.found] = lit[matches.true]
        of_interest = inside[k] & (inside.sum(axis=0) >= SHORTEST) & counted(np.nan_to_num(at, nan=np.inf))
        here = counted(state.position_mm)
        wanted, hit = wanted + int(of_interest.sum()), hit + int(np.isin(np.flatnonzero(of_interest), tracer).sum())
        shown, right = shown + int(here.sum()), right + int((here & (tracer >= 0)).sum())
        errors.append(matches.error_voxel[here[matches.found]])
        both = here & (tracer >= 0) & (before[numbers] >= 0)
        links, changed = links + int(both.sum()), changed + int((both & (before[numbers] != tracer)).sum())
        before[:] = -1
        before[numbers] = tracer
    if not shown:
        return None
    rms = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    figures = {"recall": hit / max(wanted, 1), "precision": right / max(shown, 1)}
    return figures | {"rms_x": rms[0], "rms_y": rms[1], "rms_z": rms[2], "wrong_links": changed / max(links, 1)}


def _seen(found: Particles) -> Seen:
    return Seen(found.position_mm, symmetric(found.covariance_mm2), Light(found.light_counts, found.light_sigma_counts))


def _predicted(bench: Bench, ahead: Prediction) -> Predicted:
    camera, known = bench.calibration.camera(bench.sheet), np.isfinite(ahead.sigma_mm).all(axis=1)
    rows = np.column_stack([camera.to_image_axes(ahead.position_mm[known]), ahead.light[known]])
    return Predicted(rows, np.abs(camera.to_image_axes(ahead.sigma_mm[known])), ahead.light_sigma)
