"""How far a pixel may lie from the model: read noise, light's own noise, what the optics model gets wrong.

Light that is not explained yet is no noise: it lies above the model, and counts for little until it is found. Variances
are in counts squared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# The optics model of a pixel's light is trusted to this share.
MODEL_ERROR = 0.03
# Photons of a typical tracer. Only the ratio of bright to dark pixels' weights depends on it, and positions hardly do:
# a fourth or four times of it leaves their spread the same.
PHOTONS_PER_PARTICLE = 2.5e5
# Median of |x| of a normal distribution, in standard deviations.
HALF_NORMAL_MEDIAN = 0.6745
# Rounding to whole counts alone makes this standard deviation.
ROUNDING_COUNTS = 0.29


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel: read^2 + gain M + (MODEL_ERROR M)^2, with the model M and the gain in counts per photon."""

    read_counts: float
    gain_counts: float

    def weights(
        self, model: NDArray[np.float64], residual: NDArray[np.float64], unexplained: float
    ) -> NDArray[np.float64]:
        """Return 1/variance of each pixel; light above the model adds `unexplained` times its square."""
        model = np.maximum(model, 0.0)
        variance = self.read_counts**2 + self.gain_counts * model + (MODEL_ERROR * model) ** 2
        return 1.0 / (variance + unexplained * np.maximum(residual, 0.0) ** 2)


def estimate_noise(image: NDArray[np.float64], typical_light: float) -> Noise:
    """Return the noise of a dark-subtracted image whose particles have a typical light in counts.

    Read noise is the spread below zero, where no light hides it.
    """
    below = image[image < 0.0]
    read = float(np.median(-below)) / HALF_NORMAL_MEDIAN if below.size else 0.0
    return Noise(max(read, ROUNDING_COUNTS), typical_light / PHOTONS_PER_PARTICLE)
