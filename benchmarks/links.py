"""Links between two frames in turbulence: how many are right, how many wrong, and how many are expected to be wrong.

Particles as they are found in images, with places and light that have errors, some lost and some false; no images are
rendered, so that what is judged is the links alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.grid import Scale
from lfpiv_cli.synthetic.flows import advect, random_modes
from lfpiv_cli.tracks.candidates import Light, Seen
from lfpiv_cli.tracks.tracking import track

# Table 2's camera.
SCALE = Scale(0.1, 1.064)
VOXEL_MM = 0.1
DT_S = 1e-3
SEEDS = (101, 102, 103)


@dataclass(frozen=True)
class Turbulence:
    """Tracers in turbulence and how they are found.

    Attributes
    ----------
    rms_mm : of each component of the displacement
    density_per_mm3, side_mm : of the tracers, and of the cube that is seen
    recall, ghosts : share of tracers that a frame has, and of false particles
    sigma_mm : standard errors of the places
    light_spread, light_change : of the tracers' light, and of one tracer's from frame to frame
    """

    rms_mm: float = 0.15
    density_per_mm3: float = 8.0
    side_mm: float = 10.0
    recall: float = 0.95
    ghosts: float = 0.05
    sigma_mm: tuple[float, float, float] = (0.001, 0.001, 0.01)
    light_spread: float = 0.29
    light_change: float = 0.02

    def frames(self, seed: int) -> tuple[Seen, Seen, NDArray[np.int64], NDArray[np.int64]]:
        """Return two frames, the second a fifth brighter, and each particle's tracer, below 0 for false ones."""
        rng = np.random.default_rng([seed, 7])
        flow, half = random_modes(self.rms_mm / (1e3 * DT_S), seed=seed), 0.5 * self.side_mm
        count = round(self.density_per_mm3 * (self.side_mm + 2.0) ** 3)
        start = rng.uniform(-half - 1.0, half + 1.0, (count, 3))
        light = np.exp(rng.normal(0.0, self.light_spread, count))
        seen, numbers = [], []
        for time_s, bright in ((-0.5 * DT_S, 1.0), (0.5 * DT_S, 1.2)):
            places = advect(flow, start, time_s)
            inside = np.all(np.abs(places) < half, axis=1)
            there = np.flatnonzero(inside & (rng.uniform(size=count) < self.recall))
            false = round(self.ghosts * len(there))
            found = places[there] + rng.normal(0.0, self.sigma_mm, (len(there), 3))
            own = light[there] * rng.normal(1.0, self.light_change, len(there))
            position = np.concatenate([found, rng.uniform(-half, half, (false, 3))])
            order = rng.permutation(len(position))
            covariance = np.tile([*np.square(self.sigma_mm), 0.0, 0.0, 0.0], (len(position), 1))
            lights = bright * np.concatenate([own, rng.uniform(0.2, 0.8, false)])
            seen.append(Seen(position[order], covariance, Light(lights[order])))
            numbers.append(np.concatenate([there, np.full(false, -1)])[order])
        return seen[0], seen[1], numbers[0], numbers[1]


def without_light(seen: Seen) -> Seen:
    """Return particles whose light is not known."""
    return Seen(seen.position_mm, seen.covariance_mm2)


def shares(case: Turbulence, seed: int, with_light: bool = True) -> tuple[float, float, float]:
    """Return right links over the tracers in both frames, and wrong ones, true and expected, over all links."""
    first, second, number_a, number_b = case.frames(seed)
    if not with_light:
        first, second = without_light(first), without_light(second)
    links = track(first, second, SCALE)
    right = (number_a[links.first] == number_b[links.second]) & (number_a[links.first] >= 0)
    both = len(np.intersect1d(number_a[number_a >= 0], number_b))
    return float(right.sum() / both), float(1.0 - right.mean()), float(1.0 - links.probability.mean())


def bench_links() -> None:
    """Print the shares of right and wrong links, median and worst of three flows."""
    usual = Turbulence()
    cases = {
        "rms 0.5 voxel": (replace(usual, rms_mm=0.05), True),
        "rms 1.5 voxels": (usual, True),
        "rms 1.5 voxels, light not known": (usual, False),
        "rms 2.5 voxels": (replace(usual, rms_mm=0.25), True),
        "rms 1.5 voxels, a sixth lost, a sixth false": (replace(usual, recall=0.83, ghosts=0.2), True),
        "rms 1.5 voxels, three times as dense": (replace(usual, density_per_mm3=24.0, side_mm=7.0), True),
    }
    print(f"voxels of {VOXEL_MM} mm, neighbours {0.55 * usual.density_per_mm3 ** (-1 / 3):.2f} mm apart; in per cent")
    print("case                                            right, worst   wrong, worst   expected wrong")
    for name, (case, with_light) in cases.items():
        right, wrong, expected = 100.0 * np.array([shares(case, seed, with_light) for seed in SEEDS]).T
        reported = f"{np.median(right):5.1f}  {right.min():5.1f}    {np.median(wrong):5.2f}  {wrong.max():5.2f}"
        print(f"{name:46}  {reported}    {np.median(expected):5.2f}", flush=True)
