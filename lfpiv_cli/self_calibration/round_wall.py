"""The wall of a round pipe from the particles in it: where they end, seen from near its axis.

Along each direction from the axis, at angle a and at s along it, the wall is at

    r = R + (d_1 + t_1 s) cos a + (d_2 + t_2 s) sin a

with d the shift and t the tilt of the true axis, small against R. Only the outer ring of the pipe's section is looked
at, and each particle's distance for its own angle: where the wall cannot be seen, at a sensor's sides, particles are
left out, and a seeding that grows across the pipe does no harm.

Axes: the pipe's frame (along, across, away), see `movable_scene`; lengths in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtr

from lfpiv_cli.errors import InputError
from lfpiv_cli.self_calibration.likelihood import covariance_of, improved
from lfpiv_cli.self_calibration.walls import LEAST_BLUR_SPACINGS, LEAST_DENSITY, LIMIT_BLURS, WIDTH_TOLERANCE

# The ring begins at this share of the radius: it holds half of the section, in which seeding changes evenly.
RING_FROM = 0.7
# Fewer particles in the ring leave gaps that pass for the wall.
FEWEST_IN_RING = 200
# The edge is sought blurred by these shares of the radius, coarse to fine.
BLURS_PER_RADIUS = (0.02, 0.006)
# Blurs that are so many times as large or small as the last are not expected (as a standard deviation, logarithm).
BLUR_FACTOR = 0.5
# Particles whose places along the pipe spread (rms) by less than this share of its radius say nothing of its tilt. It
# is left as it is then, and known to so many rad, which any mount is better than.
LEAST_SPAN_SHARE, UNKNOWN_TILT = 0.3, 0.1
# An axis that is not known better than to this share of the radius is as good as not found.
LARGEST_SIGMA_SHARE = 0.02

# Packed: shifts over R, tilts times the rms of s over R, the logarithm of R over what is told, the change of the
# seeding over the ring, alike at all angles and with the cosine and sine, the logarithm of the blur over R, and the
# logit of the strays' share.
RADIUS, EVEN, COSINE, SINE, BLUR, STRAY = range(4, 10)
PARAMETERS, OF_AXIS = 10, 4


@dataclass(frozen=True, eq=False)
class RoundWallFit:
    """A wall around a pipe's axis.

    Attributes
    ----------
    axis, covariance : (4,), (4, 4) shift across and away, mm, and tilt towards both, rad, from the frame's own axis
    radius_mm, radius_sigma_mm : apparent distance of the wall from the axis
    blur_mm : of the edge: the common part of the particles' errors
    stray_share : of particles that are spread over all that was searched
    particles : in the ring
    place_mm : (n, 3) of these
    """

    axis: NDArray[np.float64]
    covariance: NDArray[np.float64]
    radius_mm: float
    radius_sigma_mm: float
    blur_mm: float
    stray_share: float
    place_mm: NDArray[np.float64]

    @property
    def particles(self) -> int:
        """How many there are in the ring."""
        return len(self.place_mm)

    def distance_mm(self, place_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far (n,) behind the wall, from the axis, places (n, 3) lie; negative inside."""
        angle, radius = _polar(place_mm)
        return np.asarray(radius - self.wall_mm(angle, place_mm[:, 0]), dtype=np.float64)

    def wall_mm(self, angle: NDArray[np.float64], along_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the wall's distance (n,) from the frame's axis at angles and places along it."""
        return _wall(self.radius_mm, self.axis, angle, along_mm)


def find_round_wall(
    place_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    radius_mm: float,
    searched_mm: float,
    frames: int = 1,
) -> RoundWallFit:
    """Find the wall by maximum likelihood.

    Parameters
    ----------
    place_mm, sigma_mm : (n, 3), (n,) particles in directions in which the wall is seen, and the standard errors of
        their distances from the axis
    radius_mm, searched_mm : of the wall, and up to where particles were looked for
    frames : that the particles come from; they may be the same ones again, and say no more than those of one frame

    Raises
    ------
    InputError
        There are too few particles near the wall, or they do not end at one of this radius, or do not tell its place.
    """
    inner = RING_FROM * radius_mm
    _, distance = _polar(place_mm)
    ring = (distance > inner) & (distance < searched_mm)
    place, sigma = place_mm[ring], sigma_mm[ring]
    if len(place) < FEWEST_IN_RING:
        raise InputError(
            f"only {len(place)} particles were found in the outer half of the pipe's section, where its wall is in "
            f"view; at least {FEWEST_IN_RING} are needed to see where they end"
        )
    span = float(np.sqrt(np.mean(place[:, 0] ** 2)))
    least = LEAST_BLUR_SPACINGS * (radius_mm**2 - inner**2) / (2.0 * radius_mm * len(place))
    likelihood = partial(
        _log_likelihood, place=place, sigma=np.hypot(sigma, least), told=radius_mm, searched=searched_mm, span=span
    )
    best = np.zeros(PARAMETERS)
    best[STRAY] = -4.0
    of_axis = list(range(OF_AXIS)) if span > LEAST_SPAN_SHARE * radius_mm else [0, 1]
    first = [*of_axis, RADIUS, STRAY]
    for blur in BLURS_PER_RADIUS:
        best[BLUR] = np.log(blur)
        best = improved(best, first, _units(best), likelihood)
    free = [*of_axis, *range(OF_AXIS, PARAMETERS)]
    best = improved(best, free, _units(best), likelihood)
    covariance = covariance_of(best, np.where(np.isin(np.arange(PARAMETERS), free), _units(best), 0.0), likelihood)
    covariance *= frames
    unit = radius_mm * np.array([1.0, 1.0, 1.0 / span, 1.0 / span])
    axis, radius, blur, stray = _unpacked(best, radius_mm, span)
    of_place = covariance[:OF_AXIS, :OF_AXIS] * np.outer(unit, unit)
    if len(of_axis) < OF_AXIS:
        of_place[[2, 3], [2, 3]] = UNKNOWN_TILT**2
    found = RoundWallFit(
        axis=axis,
        covariance=of_place,
        radius_mm=radius,
        radius_sigma_mm=radius * float(np.sqrt(covariance[RADIUS, RADIUS])),
        blur_mm=float(np.hypot(blur, least)),
        stray_share=stray,
        place_mm=place,
    )
    _ensure_wall(found, radius_mm, searched_mm)
    return found


def _ensure_wall(found: RoundWallFit, radius_mm: float, searched_mm: float) -> None:
    """Raise where what was found is not the pipe's wall, or hardly found."""
    seen = f"the particles end {found.radius_mm:.3f} mm from the pipe's axis"
    if abs(found.radius_mm / radius_mm - 1.0) > WIDTH_TOLERANCE:
        raise InputError(f"{seen}, and the wall's radius_mm is {radius_mm:g}; is all of the pipe seeded, and lit?")
    shift, sigma = float(np.hypot(*found.axis[:2])), np.sqrt(np.diag(found.covariance))[:2]
    if found.radius_mm + shift > searched_mm - LIMIT_BLURS * found.blur_mm:
        raise InputError(
            f"{seen}, which lies {shift:.3f} mm beside the scene's: further than this can mend; measure where the pipe "
            "is, and put it into the scene"
        )
    if np.any(sigma > LARGEST_SIGMA_SHARE * radius_mm):
        raise InputError(
            f"{len(found.place_mm)} particles near the pipe's wall tell where its axis lies to {sigma[0]:.3f} mm "
            f"across and {sigma[1]:.3f} mm in depth, not to {LARGEST_SIGMA_SHARE * radius_mm:g} mm: more of the wall "
            "has to be in view, and seeded"
        )


def _polar(place_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the angles from across towards away (n,) of places (n, 3), and their distances from the axis (n,)."""
    return np.arctan2(place_mm[:, 2], place_mm[:, 1]), np.hypot(place_mm[:, 1], place_mm[:, 2])


def _wall(
    radius: float, axis: NDArray[np.float64], angle: NDArray[np.float64], along: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the wall's distance (n,) from the frame's axis."""
    across, away = axis[0] + axis[2] * along, axis[1] + axis[3] * along
    return np.asarray(radius + across * np.cos(angle) + away * np.sin(angle), dtype=np.float64)


def _units(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much each packed parameter may change before the likelihood's slope does."""
    blur = float(np.exp(packed[BLUR]))
    return np.array([blur] * (OF_AXIS + 1) + [0.1] * 3 + [0.3] * 2)


def _unpacked(packed: NDArray[np.float64], told: float, span: float) -> tuple[NDArray[np.float64], float, float, float]:
    """Return the axis (4,), the radius and the blur in mm, and the share of strays."""
    axis = told * packed[:OF_AXIS] / np.array([1.0, 1.0, span, span])
    return axis, told * float(np.exp(packed[RADIUS])), told * float(np.exp(packed[BLUR])), float(expit(packed[STRAY]))


def _log_likelihood(
    packed: NDArray[np.float64],
    place: NDArray[np.float64],
    sigma: NDArray[np.float64],
    told: float,
    searched: float,
    span: float,
) -> NDArray[np.float64]:
    """Return the logarithm (n,) of each particle's density along its direction from the axis."""
    axis, radius, blur, stray = _unpacked(packed, told, span)
    angle, distance = _polar(place)
    inner = RING_FROM * told
    middle, half = 0.5 * (inner + told), 0.5 * (told - inner)
    wall = _wall(radius, axis, angle, place[:, 0])
    change = packed[EVEN] + packed[COSINE] * np.cos(angle) + packed[SINE] * np.sin(angle)
    t, end = np.clip((distance - middle) / half, -1.0, 1.0), (wall - middle) / half
    seeding = np.maximum(1.0 + change * t, LEAST_DENSITY)
    # The integral of r (1 + change t) over the ring.
    whole = half * (
        middle * (end + 1.0) + 0.5 * (half + middle * change) * (end**2 - 1.0) + half * change * (end**3 + 1.0) / 3.0
    )
    inside = distance * seeding * ndtr((wall - distance) / np.hypot(sigma, blur)) / np.maximum(whole, LEAST_DENSITY)
    density = (1.0 - stray) * inside + stray / (searched - inner)
    # Few particles do not tell how blurred the edge is.
    unlikely = 0.5 * ((packed[BLUR] - np.log(BLURS_PER_RADIUS[-1])) / BLUR_FACTOR) ** 2 / len(distance)
    return np.asarray(np.log(density) - unlikely, dtype=np.float64)
