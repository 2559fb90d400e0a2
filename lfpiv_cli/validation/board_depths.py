"""At what depth a reconstructed dot lies: definitions, all of which find the middle of a long, even dot.

Eq. 20 needs a depth and the paper says no more of it than "Gaussian peak fittings". Dots next to the focal plane are
not even: there definitions differ by tenths of a millimetre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Depths = NDArray[np.float64]
Profile = NDArray[np.float64]

# Below this share of the peak of a depth profile lies what is left of other dots' light.
SHARE = float(1.0 / np.e)
# Height, centre and width.
GAUSSIAN_PARAMETERS = 3


@dataclass(frozen=True)
class DepthDefinition:
    """A definition of the depth of a dot.

    Attributes
    ----------
    words : for people
    profile : what it is taken from, the sum or the maximum of each plane of a dot's column
    depth_mm : from the planes' depths and the profile
    """

    words: str
    profile: Literal["sum", "maximum"]
    depth_mm: Callable[[Depths, Profile], float]


def width_ends_mm(z_mm: Depths, profile: Profile, peak: int | None = None) -> tuple[float, float]:
    """Return where a profile around a peak, by default its highest, falls to 1/e of it.

    Between samples the profile is taken as linear.
    """
    peak = int(np.argmax(profile)) if peak is None else peak
    limit = profile[peak] * SHARE
    first, last = _run_above(profile, peak, limit)
    return _crossing_mm(z_mm, profile, limit, first, -1), _crossing_mm(z_mm, profile, limit, last, 1)


def _run_above(profile: Profile, peak: int, limit: float) -> tuple[int, int]:
    """Return the first and last sample of the run around the peak that is above the limit."""
    low = np.flatnonzero(profile[:peak] <= limit)
    high = np.flatnonzero(profile[peak + 1 :] <= limit)
    return int(low[-1]) + 1 if low.size else 0, peak + int(high[0]) if high.size else profile.size - 1


def _crossing_mm(z_mm: Depths, profile: Profile, limit: float, at: int, step: int) -> float:
    beyond = at + step
    if not 0 <= beyond < z_mm.size:
        return float(z_mm[at])
    share = (profile[at] - limit) / (profile[at] - profile[beyond])
    return float(z_mm[at] + share * (z_mm[beyond] - z_mm[at]))


def gaussian_centre_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the centre of the least-squares Gaussian through a profile, its peak where no fit is found."""
    peak = int(np.argmax(profile))
    if z_mm.size < GAUSSIAN_PARAMETERS:
        return float(z_mm[peak])
    ends = width_ends_mm(z_mm, profile)
    width = max((ends[1] - ends[0]) / (2.0 * np.sqrt(2.0)), float(z_mm[1] - z_mm[0]))

    def misfit(values: NDArray[np.float64]) -> NDArray[np.float64]:
        height, centre, sigma = values
        return np.asarray(height * np.exp(-0.5 * ((z_mm - centre) / sigma) ** 2) - profile)

    found = least_squares(misfit, (profile[peak], z_mm[peak], width), method="lm")
    return float(found.x[1] if found.success else z_mm[peak])


def gaussian_peak_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the centre of the least-squares Gaussian through the run of a profile above 1/e of its peak."""
    peak = int(np.argmax(profile))
    first, last = _run_above(profile, peak, profile[peak] * SHARE)
    run = slice(max(first - 1, 0), last + 2)
    return gaussian_centre_mm(z_mm[run], profile[run])


def three_point_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the peak of the Gaussian through the highest sample and its neighbours; at the ends, that sample."""
    peak = int(np.argmax(profile))
    near = profile[max(peak - 1, 0) : peak + 2]
    if near.size < 3 or near.min() <= 0.0:
        return float(z_mm[peak])
    before, top, after = np.log(near)
    bend = before - 2.0 * top + after
    return float(z_mm[peak] + (0.5 * (before - after) / bend * (z_mm[1] - z_mm[0]) if bend < 0.0 else 0.0))


def mass_centre_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the centre of mass of a profile where it exceeds 1/e of its peak."""
    high = profile > profile.max() * SHARE
    return float(profile[high] @ z_mm[high] / profile[high].sum())


def middle_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the middle between the depths where a profile falls to 1/e of its peak: that of the elongation."""
    return float(np.mean(width_ends_mm(z_mm, profile)))


DEPTH_DEFINITIONS = {
    "gaussian": DepthDefinition("Gaussian through the sum of each plane, all depths", "sum", gaussian_centre_mm),
    "gaussian_peak": DepthDefinition(
        "Gaussian through the sum of each plane, where it exceeds 1/e", "sum", gaussian_peak_mm
    ),
    "three_point": DepthDefinition("Gaussian through three samples at the peak of that sum", "sum", three_point_mm),
    "mass": DepthDefinition("centre of mass of that sum where it exceeds 1/e", "sum", mass_centre_mm),
    "middle": DepthDefinition("middle of where that sum exceeds 1/e", "sum", middle_mm),
    "maximum_gaussian": DepthDefinition(
        "Gaussian through the maximum of each plane, all depths", "maximum", gaussian_centre_mm
    ),
    "maximum_mass": DepthDefinition("centre of mass of that maximum where it exceeds 1/e", "maximum", mass_centre_mm),
    "maximum_middle": DepthDefinition("middle of the elongation", "maximum", middle_mm),
}
# What the paper's words, "Gaussian peak fittings", are taken to mean.
THE_PAPERS = "gaussian"
