"""Pressure from simulated sequences of seven frames, beside the truth: places as `field_tracks` draws them.

python -m benchmarks pressure
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.field_tracks import Floats, stated_covariance
from lfpiv_cli.arrays import root_of_squares
from lfpiv_cli.fields.pressure import knots_for, pressure_field, pressure_gradients
from lfpiv_cli.fields.stencils import Lattice
from lfpiv_cli.synthetic.flows import MM_PER_M, KnownFlow, abc, advect, taylor_green
from lfpiv_cli.tracks.candidates import Seen, Trajectories
from lfpiv_cli.tracks.in_time import high_derivatives_in, motions_at

SIZE_MM = np.array([13.0, 10.0, 10.0])
FRAMES, MIDDLE = 7, 3
DENSITY_KG_M3 = 998.2
NODE_MM = 0.8
TRACERS, SEEDS = 8000, 3
# Rms displacements from frame to frame: one to four voxels of 0.1 mm.
STEPS_MM = (0.1, 0.25, 0.4)


@dataclass(frozen=True, eq=False)
class Sequence:
    """Places of tracers in all frames, their true trajectories, and the time between frames."""

    seen: list[Seen]
    found: Trajectories
    dt_s: float


@dataclass(frozen=True)
class Outcome:
    """Rms error and rms stated error over the pressure's rms, and the share within 1.96 stated errors."""

    error_share: float
    sigma_share: float
    covered: float


def sequence_of(flow: KnownFlow, count: int, rng: np.random.Generator, step_mm: float) -> Sequence:
    """Return a sequence of tracers that are evenly spread over the box in its middle frame."""
    half = 0.5 * SIZE_MM
    middle = rng.uniform(-half, half, (count, 3))
    dt_s = step_mm / (MM_PER_M * float(np.sqrt(np.mean(np.sum(flow(middle) ** 2, axis=1)))))
    covariance = 0.5 * stated_covariance(middle, float(half[2]), rng)
    root = np.linalg.cholesky(covariance)
    seen = []
    for frame in range(FRAMES):
        noise = np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3)))
        seen.append(
            Seen(
                advect(flow, middle, (frame - MIDDLE) * dt_s) + noise,
                covariance[:, [0, 1, 2, 0, 1, 0], [0, 1, 2, 1, 2, 2]],
            )
        )
    labels = tuple(np.arange(count) for _ in range(FRAMES))
    return Sequence(seen, Trajectories(labels, count, tuple(np.ones(count) for _ in range(FRAMES))), dt_s)


def trial(flow: KnownFlow, count: int, step_mm: float, seed: int) -> Outcome:
    """Return how good the pressure of a flow is at nodes within the box."""
    sequence = sequence_of(flow, count, np.random.default_rng(seed), step_mm)
    derivatives = high_derivatives_in(sequence.found, sequence.seen)
    if derivatives is None or flow.pressure is None:
        raise ValueError("too few tracers, or a flow without a known pressure")
    _, motion = motions_at(sequence.found, sequence.seen, MIDDLE, derivatives)
    to_m_s2 = 1.0 / (MM_PER_M * sequence.dt_s**2)
    samples = pressure_gradients(
        motion.position_mm, to_m_s2 * motion.acceleration, to_m_s2**2 * motion.covariance, DENSITY_KG_M3
    )
    lattice = Lattice.affordable(-0.5 * SIZE_MM, 0.5 * SIZE_MM, knots_for(samples.points_mm))
    neglected = root_of_squares(motion.neglected) / root_of_squares(motion.acceleration)
    field = pressure_field(samples, lattice, np.random.default_rng(0), neglected)
    at = nodes()
    found, true = field.value_at(at), flow.pressure(at, DENSITY_KG_M3)
    error, sigma, rms = found - found.mean() - (true - true.mean()), np.sqrt(field.variance_at(at)), np.std(true)
    covered = np.mean(np.abs(error) < 1.96 * sigma)
    return Outcome(float(np.std(error) / rms), float(np.sqrt(np.mean(sigma**2)) / rms), float(covered))


def nodes() -> Floats:
    """Return nodes (m, 3) half a window within the box."""
    axes = [np.arange(-0.5 * size + 0.5 * NODE_MM, 0.5 * size, NODE_MM) for size in SIZE_MM]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def bench_pressure() -> None:
    """Print a row for each flow, displacement and seed."""
    print(f"{TRACERS} tracers; shares of the pressure's rms")
    for name, flow in (("Taylor-Green", taylor_green(0.1, 10.0)), ("ABC", abc((0.1, 0.1, 0.1), 10.0))):
        for step in STEPS_MM:
            for seed in range(SEEDS):
                found = trial(flow, TRACERS, step, seed)
                reported = f"error {found.error_share:.3f}  stated {found.sigma_share:.3f}  covered {found.covered:.2f}"
                print(f"{name:13s} {step:.2f} mm  seed {seed}  {reported}", flush=True)
