"""The walls of a channel from the particles between them: where these begin and end in depth.

Evenly seeded water ends at the two walls, so the depths of the particles show where the channel lies from the focal
plane, how it is tilted, and by their extent whether depths have the right scale. The particles' own images cannot: a
point nearer to the focal plane and a camera focused further away look the same.

Axes: world axes of the raw sensor, z from the nominal focal point; lengths in mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit, ndtr

from lfpiv_cli.errors import InputError
from lfpiv_cli.self_calibration.likelihood import covariance_of, improved

# Fewer particles leave gaps in depth that pass for walls.
FEWEST_PARTICLES = 100
# The edges are sought blurred by these shares of the width, coarse to fine: a sharp edge pulls only on what lies at it.
BLURS_PER_WIDTH = (0.03, 0.01, 0.003)
# All but this share of the particles on each side give the first guess.
FIRST_TAIL = 0.03
# Between the walls the seeding may change by a parabola; it stays above this share of its mean.
LEAST_DENSITY = 1e-3
# Widths that differ by more from the true one are something else's.
WIDTH_TOLERANCE = 0.05
# Walls this many blurs from where particles were sought may be the end of the search.
LIMIT_BLURS = 5.0
# Edges sharper than this many spacings of the particles in depth lock to single ones; with it the edges of 300 to 8,000
# scatter as their standard errors say.
LEAST_BLUR_SPACINGS = 2.0

MIDDLE, HALF, SLOPE_X, SLOPE_Y, LINEAR, QUADRATIC, BLUR, STRAY = range(8)


@dataclass(frozen=True, eq=False)
class Walls:
    """Two parallel walls, at z = middle + slope . (x, y) -+ width / 2.

    Attributes
    ----------
    middle_mm, middle_sigma_mm : depth of the mid plane on the axis
    slope, slope_sigma : (2,) of the walls, dz/dx and dz/dy
    width_mm, width_sigma_mm : apparent distance of the walls
    linear, quadratic : seeding between the walls, 1 + linear t + quadratic (t^2 - 1/3), t from -1 to 1
    blur_mm : of the edges: the common part of the particles' errors in depth
    stray_share : of particles that are spread over the whole depth searched
    """

    middle_mm: float
    middle_sigma_mm: float
    slope: NDArray[np.float64]
    slope_sigma: NDArray[np.float64]
    width_mm: float
    width_sigma_mm: float
    linear: float
    quadratic: float
    blur_mm: float
    stray_share: float

    def depth_from_middle(self, position_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far (n,) behind the mid plane positions (n, 3) lie."""
        return np.asarray(position_mm[:, 2] - position_mm[:, :2] @ self.slope - self.middle_mm, dtype=np.float64)

    def density(self, depth_mm: NDArray[np.float64], searched_mm: float) -> NDArray[np.float64]:
        """Return the share of the particles per mm at depths (n,) behind the mid plane."""
        parameters = np.array([0.0, 0.5 * self.width_mm, 0.0, 0.0, self.linear, self.quadratic])
        edges = np.full(depth_mm.shape, self.blur_mm)
        return _density(depth_mm, parameters, edges, self.stray_share, searched_mm)


def find_walls(
    position_mm: NDArray[np.float64],
    depth_sigma_mm: NDArray[np.float64],
    depths_mm: tuple[float, float],
    width_mm: float,
    frames: int = 1,
) -> Walls:
    """Find the walls by maximum likelihood.

    Parameters
    ----------
    position_mm, depth_sigma_mm : (n, 3), (n,) particles and the standard errors of their depths
    depths_mm : between which they were looked for
    width_mm : true distance of the walls
    frames : that the particles come from; they may be the same ones again, and say no more than those of one frame

    Raises
    ------
    InputError
        There are too few particles, or they do not end at two walls as far apart as the channel is wide.
    """
    refuse_few(len(position_mm))
    searched = depths_mm[1] - depths_mm[0]
    best = _most_likely(position_mm, depth_sigma_mm, searched, width_mm)
    sigma = _standard_errors(best, position_mm, depth_sigma_mm, searched, width_mm) * np.sqrt(frames)
    parameters, blur, stray = _unpacked(best, width_mm)
    blur = float(np.hypot(blur, LEAST_BLUR_SPACINGS * width_mm / len(position_mm)))
    # The last particle before an edge is on average one spacing from it, however sharp the edge is.
    spacing = 2.0 * parameters[HALF] * frames / len(position_mm)
    walls = Walls(
        middle_mm=float(parameters[MIDDLE]),
        middle_sigma_mm=float(np.hypot(sigma[MIDDLE], spacing / np.sqrt(2.0))),
        slope=parameters[[SLOPE_X, SLOPE_Y]],
        slope_sigma=sigma[[SLOPE_X, SLOPE_Y]],
        width_mm=float(2.0 * parameters[HALF]),
        width_sigma_mm=float(np.hypot(2.0 * sigma[HALF], spacing * np.sqrt(2.0))),
        linear=float(parameters[LINEAR]),
        quadratic=float(parameters[QUADRATIC]),
        blur_mm=blur,
        stray_share=stray,
    )
    _ensure_walls(walls, depths_mm, width_mm)
    return walls


def refuse_few(count: int) -> None:
    """Raise where too few particles were found."""
    if count < FEWEST_PARTICLES:
        raise InputError(
            f"only {count} particles were found; at least {FEWEST_PARTICLES} are needed to see where they end at the "
            "walls"
        )


def _ensure_walls(walls: Walls, depths_mm: tuple[float, float], width_mm: float) -> None:
    """Raise where what was found is not the channel."""
    near, far = (walls.middle_mm + side * 0.5 * walls.width_mm for side in (-1.0, 1.0))
    found = f"the particles end at z = {near:z.3f} and {far:z.3f} mm"
    margin = LIMIT_BLURS * walls.blur_mm
    if near < depths_mm[0] + margin or far > depths_mm[1] - margin:
        raise InputError(
            f"{found}, where the search ended ({depths_mm[0]:z.3f} to {depths_mm[1]:z.3f} mm); the channel lies "
            "further from the calibrated mid plane than this can mend: check channel.camera_move_mm, or calibrate again"
        )
    if abs(walls.width_mm / width_mm - 1.0) > WIDTH_TOLERANCE:
        raise InputError(
            f"{found}, {walls.width_mm:.3f} mm apart, and channel.width_mm is {width_mm:g}; is the whole depth seeded?"
        )


def _most_likely(
    position: NDArray[np.float64], sigma: NDArray[np.float64], searched: float, width: float
) -> NDArray[np.float64]:
    """Return the parameters that make the particles most likely, packed as `_unpacked` reads them."""
    low, high = np.quantile(position[:, 2], (FIRST_TAIL, 1.0 - FIRST_TAIL))
    best = np.zeros(8)
    best[MIDDLE] = 0.5 * (low + high) / width
    best[HALF] = np.log((high - low) / (1.0 - 2.0 * FIRST_TAIL) / width)
    best[STRAY] = -4.0
    free = [MIDDLE, HALF, SLOPE_X, SLOPE_Y, STRAY]
    likelihood = partial(_log_likelihood, position=position, sigma=sigma, searched=searched, width=width)
    for blur in BLURS_PER_WIDTH:
        best[BLUR] = np.log(blur)
        best = improved(best, free, _units(best), likelihood)
    return improved(best, list(range(8)), _units(best), likelihood)


def _units(packed: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return by how much (8,) each packed parameter may change before the likelihood's slope does."""
    blur = float(np.exp(packed[BLUR]))
    return np.array([blur, blur, blur, blur, 0.1, 0.1, 0.3, 0.3])


def _standard_errors(
    best: NDArray[np.float64],
    position: NDArray[np.float64],
    sigma: NDArray[np.float64],
    searched: float,
    width: float,
) -> NDArray[np.float64]:
    """Return the standard errors (6,) of the unpacked parameters, from the scatter of the single particles' slopes."""
    likelihood = partial(_log_likelihood, position=position, sigma=sigma, searched=searched, width=width)
    covariance = covariance_of(best, _units(best), likelihood)
    errors = np.sqrt(np.diag(covariance))[:6]
    errors[MIDDLE] *= width
    errors[HALF] *= _unpacked(best, width)[0][HALF]
    return np.asarray(errors, dtype=np.float64)


def _unpacked(packed: NDArray[np.float64], width: float) -> tuple[NDArray[np.float64], float, float]:
    """Return middle, half width, slopes and seeding (6,), the blur in mm and the share of strays.

    Packed are the middle per width, the logarithms of width and blur per width, and the logit of the share.
    """
    parameters = packed[:6].copy()
    parameters[MIDDLE] *= width
    parameters[HALF] = 0.5 * width * np.exp(packed[HALF])
    return parameters, width * float(np.exp(packed[BLUR])), float(expit(packed[STRAY]))


def _log_likelihood(
    packed: NDArray[np.float64],
    position: NDArray[np.float64],
    sigma: NDArray[np.float64],
    searched: float,
    width: float,
) -> NDArray[np.float64]:
    """Return the logarithm (n,) of each particle's density."""
    parameters, blur, stray = _unpacked(packed, width)
    depth = position[:, 2] - position[:, :2] @ parameters[[SLOPE_X, SLOPE_Y]] - parameters[MIDDLE]
    least = LEAST_BLUR_SPACINGS * width / len(position)
    return np.log(_density(depth, parameters, np.sqrt(sigma**2 + blur**2 + least**2), stray, searched))


def _density(
    depth: NDArray[np.float64],
    parameters: NDArray[np.float64],
    edge: NDArray[np.float64],
    stray: float,
    searched: float,
) -> NDArray[np.float64]:
    """Return the share of particles per mm at depths from the mid plane, seen with errors `edge`."""
    half = parameters[HALF]
    t = np.clip(depth / half, -1.0, 1.0)
    seeding = 1.0 + parameters[LINEAR] * t + parameters[QUADRATIC] * (t * t - 1.0 / 3.0)
    between = ndtr((depth + half) / edge) - ndtr((depth - half) / edge)
    inside = np.maximum(seeding, LEAST_DENSITY) * between / (2.0 * half)
    return np.asarray((1.0 - stray) * inside + stray / searched, dtype=np.float64)
