"""Fields of known flows, fitted to their tracks: errors beside those of local polynomials and kriging (`track --grid`).

    python -m benchmarks fields [--seeds N] [--first SEED] [--counts N ...] [--flows NAME ...]

Tracks have the errors that `track` states of a light-field camera, drawn anew for each seed; random modes have two
wrong links of a hundred.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.field_tracks import Tracks, tracks_of, true_displacement_mm
from lfpiv_cli.fields.fit import fit_field
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.synthetic.flows import Flow, abc, random_modes, source, taylor_green, vortex_ring
from lfpiv_cli.tracks.gridding import on_grid

SIZE_MM = np.array([13.0, 10.0, 10.0])
# As `correlate` places its vectors in the paper's channel: 16 x 12 x 12.
SPACING_MM, VOXEL_MM = 0.8, 0.1
REACH_MM = 3.2
COUNTS, SEEDS, FIRST_SEED = (500, 2000, 8000, 20000), 1, 100
WRONG_SHARE = 0.02
WITHIN = 1.96


def flow_of(name: str, seed: int) -> Flow:
    """Return a flow whose place, or modes, depend on the seed."""
    centre = np.random.default_rng(seed).uniform(-2.0, 2.0, 3)
    if name == "taylor-green":
        return taylor_green(0.1, 10.0, centre, third_amplitude_m_s=0.1)
    if name == "abc":
        return abc((0.1, 0.08, 0.06), 12.0, centre)
    if name == "vortex-ring":
        return vortex_ring(0.2, 3.0, 1.5, "y", centre)
    if name == "source":
        return source(40.0, 3.0, centre)
    return random_modes(0.05, 20.0, 0.7, 50, seed)


FLOWS = ("taylor-green", "abc", "vortex-ring", "random-modes", "source")


@dataclass(frozen=True)
class Judged:
    """Errors of vectors on a grid.

    Attributes
    ----------
    rms_voxel : (3,) of each component
    covered : (3,) share of the errors within 1.96 of the stated ones
    seconds : of the process
    """

    rms_voxel: NDArray[np.float64]
    covered: NDArray[np.float64]
    seconds: float


def nodes_mm() -> NDArray[np.float64]:
    """Return the places of vectors (m, 3)."""
    axes = [(np.arange(int(size / SPACING_MM)) + 0.5) * SPACING_MM - 0.5 * size for size in SIZE_MM]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def judged(
    value: NDArray[np.float64], sigma: NDArray[np.float64], truth: NDArray[np.float64], seconds: float
) -> Judged:
    """Return the errors of those vectors that are known."""
    known = np.isfinite(value).all(axis=1)
    error = value[known] - truth[known]
    covered = np.mean(np.abs(error) <= WITHIN * sigma[known], axis=0)
    return Judged(np.sqrt(np.mean(error**2, axis=0)) / VOXEL_MM, covered, seconds)


def by_grid(tracks: Tracks, nodes: NDArray[np.float64], truth: NDArray[np.float64]) -> Judged:
    """Return the errors of `track --grid`."""
    begun = time.process_time()
    sigma = np.sqrt(np.einsum("nii->ni", tracks.covariance_mm2))
    value, error = on_grid(tracks.middle_mm, tracks.displacement_mm, sigma, nodes, REACH_MM)
    return judged(value, error, truth, time.process_time() - begun)


def by_field(
    tracks: Tracks, nodes: NDArray[np.float64], truth: NDArray[np.float64], divergence: str = "penalised"
) -> tuple[Judged, float, dict[str, object]]:
    """Return the errors of `field`, the rms of the divergence over that of the gradients, and its figures."""
    begun = time.process_time()
    samples = Samples(tracks.middle_mm, tracks.displacement_mm, tracks.covariance_mm2, np.ones(len(tracks.middle_mm)))
    field = fit_field(samples, -0.5 * SIZE_MM, 0.5 * SIZE_MM, divergence)
    value, variance = field.estimate_at(nodes)
    seconds = time.process_time() - begun
    gradient = field.gradient_at(nodes)
    divergence_mean2 = np.mean(np.einsum("nii->n", gradient) ** 2)
    share = float(np.sqrt(divergence_mean2 / np.mean(gradient**2)))
    return judged(value, np.sqrt(variance), truth, seconds), share, dict(field.reported())


def bench_fields(arguments: Sequence[str] = ()) -> None:
    """Print the errors of fields beside those of `track --grid` on the same tracks."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks fields")
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--first", type=int, default=FIRST_SEED)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--flows", nargs="+", choices=FLOWS, default=FLOWS)
    parser.add_argument("--divergence", choices=("penalised", "free", "off"), default="penalised")
    chosen = parser.parse_args(arguments)
    print(
        "flow, tracks, seed: rms u v w of track --grid -> of field, voxel of 0.1 mm (ratios); within 1.96 sigma; "
        "divergence / gradients; chi-squared; CPU s"
    )
    nodes = nodes_mm()
    for name in chosen.flows:
        for count in chosen.counts:
            for seed in range(chosen.first, chosen.first + chosen.seeds):
                print_one(name, count, seed, nodes, chosen.divergence)


def print_one(name: str, count: int, seed: int, nodes: NDArray[np.float64], divergence: str) -> None:
    """Print a line for one flow and one draw of its tracks."""
    flow = flow_of(name, seed)
    wrong = WRONG_SHARE if name == "random-modes" else 0.0
    tracks = tracks_of(flow, count, np.random.default_rng(seed), tuple(SIZE_MM), wrong_share=wrong)
    truth = true_displacement_mm(flow, nodes, tracks.dt_s)
    before = by_grid(tracks, nodes, truth)
    after, share, reported = by_field(tracks, nodes, truth, divergence)

    def row(values: NDArray[np.float64], digits: int) -> str:
        return " ".join(f"{value:.{digits}f}" for value in values)

    print(
        f"{name:12} {count:6} {seed}: {row(before.rms_voxel, 4)} -> {row(after.rms_voxel, 4)} "
        f"({row(after.rms_voxel / before.rms_voxel, 2)}); {row(after.covered, 3)}; {share:.4f}; "
        f"{reported['reduced_chi2']:.2f}; {before.seconds:.1f} -> {after.seconds:.1f}",
        flush=True,
    )
