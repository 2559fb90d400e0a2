"""From expected counts to what the sensor records: shot noise, read noise, dark level, quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats


@dataclass(frozen=True)
class Readout:
    """How the sensor turns light into counts.

    Attributes
    ----------
    photons_per_count : photons that make one count; None leaves shot noise out
    read_noise_counts : standard deviation of the noise that does not depend on light
    dark_level_counts : counts without light
    bits : counts end at 2^bits - 1; 12-bit counts are stored unshifted
    """

    photons_per_count: float | None = 0.5
    read_noise_counts: float = 6.0
    dark_level_counts: float = 96.0
    bits: int = 16

    def record(self, expected_counts: Floats, rng: np.random.Generator) -> NDArray[np.uint16]:
        """Return the recorded image of expected counts (without the dark level), rounded and clipped."""
        counts = expected_counts
        if self.photons_per_count is not None:
            counts = rng.poisson(expected_counts * self.photons_per_count) / self.photons_per_count
        counts = counts + self.dark_level_counts
        if self.read_noise_counts > 0.0:
            counts = counts + rng.normal(0.0, self.read_noise_counts, counts.shape)
        return np.clip(np.rint(counts), 0, 2**self.bits - 1).astype(np.uint16)
