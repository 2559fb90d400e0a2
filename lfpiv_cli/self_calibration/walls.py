"""The walls of a channel from the particles between them: where these begin and end in depth.

Evenly seeded water ends at the two walls, so the depths of the particles show where the channel lies from the focal
plane, how it is tilted, and by their extent whether depths have the right scale. The particles' own images cannot: a
point nearer to the focal plane and a camera focused further away look the same.

Axes: world axes of the raw sensor, z from the nominal focal point; lengths in mm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, ndtr

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import InputError

# Steps of the numerical slopes, in units of the parameters.
SLOPE_STEP = 1e-4
# Packed parameters, of which any number is possible, are what says where the walls are, changes of the seeding, the
# logarithm of the edges' blur per width or radius, and the logit of the strays' share.
BLUR, STRAY = -2, -1

LogLikelihood = Callable[[Floats], Floats]
"""The logarithm (n,) of each particle's density, from packed parameters."""


def most_likely(
    best: Floats,
    first: list[int],
    free: list[int],
    places: int,
    blurs: tuple[float, ...],
    log_likelihood: LogLikelihood,
) -> tuple[Floats, Floats]:
    """Return the packed parameters (n,) that make the particles of a flow most likely, and their covariance (n, n).

    The first ones are sought with edges of each blur, coarse to fine, then all that are free; the others are left as
    they are, and have no variance. The covariance is from the scatter of the single particles' slopes.

    Raises
    ------
    InputError
        Something that is sought makes no particle likelier than another does: they end at no walls.
    """
    for blur, sought in [*((blur, first) for blur in blurs), (None, free)]:
        if blur is not None:
            best[BLUR] = np.log(blur)
        unit = _units(best, places)[sought]

        def cost(change: Floats, start: Floats = best, sought: list[int] = sought, unit: Floats = unit) -> float:
            packed = start.copy()
            packed[sought] += change * unit
            return -float(np.mean(log_likelihood(packed)))

        found, best = minimize(cost, np.zeros(len(sought)), method="BFGS"), best.copy()
        best[sought] += found.x * unit
    step = SLOPE_STEP * np.where(np.isin(np.arange(len(best)), free), _units(best, places), 0.0)
    slopes = [(log_likelihood(best + change) - log_likelihood(best - change)) / 2.0 for change in np.diag(step)]
    design = np.stack(slopes, axis=1)
    covariance = np.asarray(np.linalg.pinv(design.T @ design) * np.outer(step, step), dtype=np.float64)
    if not (np.diag(covariance)[free] > 0.0).all():
        raise InputError("where the particles end shows no walls; are they tracers, and is the whole depth seeded?")
    return best, covariance


def _units(packed: Floats, places: int) -> Floats:
    """Return by how much each packed parameter may change before the likelihood's slope does; so many are of places."""
    return np.array([float(np.exp(packed[BLUR]))] * places + [0.1] * (len(packed) - places - 2) + [0.3] * 2)


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

MIDDLE, HALF, SLOPE_X, SLOPE_Y, LINEAR, QUADRATIC = range(6)


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
    slope: Floats
    slope_sigma: Floats
    width_mm: float
    width_sigma_mm: float
    linear: float
    quadratic: float
    blur_mm: float
    stray_share: float

    def density(self, depth_mm: Floats, searched_mm: float) -> Floats:
        """Return the share of the particles per mm at depths (n,) behind the mid plane."""
        parameters = np.array([0.0, 0.5 * self.width_mm, 0.0, 0.0, self.linear, self.quadratic])
        edges = np.full(depth_mm.shape, self.blur_mm)
        return _density(depth_mm, parameters, edges, self.stray_share, searched_mm)


def find_walls(
    position_mm: Floats, depth_sigma_mm: Floats, depths_mm: tuple[float, float], width_mm: float, frames: int = 1
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
    low, high = np.quantile(position_mm[:, 2], (FIRST_TAIL, 1.0 - FIRST_TAIL))
    best = np.zeros(8)
    best[MIDDLE] = 0.5 * (low + high) / width_mm
    best[HALF] = np.log((high - low) / (1.0 - 2.0 * FIRST_TAIL) / width_mm)
    best[STRAY] = -4.0
    likelihood = partial(_log_likelihood, position=position_mm, sigma=depth_sigma_mm, searched=searched, width=width_mm)
    first = [MIDDLE, HALF, SLOPE_X, SLOPE_Y, STRAY]
    best, covariance = most_likely(best, first, list(range(8)), 4, BLURS_PER_WIDTH, likelihood)
    parameters, blur, stray = _unpacked(best, width_mm)
    sigma = np.sqrt(np.diag(covariance))[:6]
    sigma[MIDDLE] *= width_mm
    sigma[HALF] *= parameters[HALF]
    sigma *= np.sqrt(frames)
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
    return walls


def refuse_few(count: int) -> None:
    """Raise where too few particles were found."""
    if count < FEWEST_PARTICLES:
        raise InputError(
            f"only {count} particles were found; at least {FEWEST_PARTICLES} are needed to see where they end at the "
            "walls"
        )


def _unpacked(packed: Floats, width: float) -> tuple[Floats, float, float]:
    """Return middle, half width, slopes and seeding (6,), the blur in mm and the share of strays.

    Packed are the middle per width, the logarithms of width and blur per width, and the logit of the share.
    """
    parameters = packed[:6].copy()
    parameters[MIDDLE] *= width
    parameters[HALF] = 0.5 * width * np.exp(packed[HALF])
    return parameters, width * float(np.exp(packed[BLUR])), float(expit(packed[STRAY]))


def _log_likelihood(packed: Floats, position: Floats, sigma: Floats, searched: float, width: float) -> Floats:
    """Return the logarithm (n,) of each particle's density."""
    parameters, blur, stray = _unpacked(packed, width)
    depth = position[:, 2] - position[:, :2] @ parameters[[SLOPE_X, SLOPE_Y]] - parameters[MIDDLE]
    least = LEAST_BLUR_SPACINGS * width / len(position)
    return np.log(_density(depth, parameters, np.sqrt(sigma**2 + blur**2 + least**2), stray, searched))


def _density(depth: Floats, parameters: Floats, edge: Floats, stray: float, searched: float) -> Floats:
    """Return the share of particles per mm at depths from the mid plane, seen with errors `edge`."""
    half = parameters[HALF]
    t = np.clip(depth / half, -1.0, 1.0)
    seeding = 1.0 + parameters[LINEAR] * t + parameters[QUADRATIC] * (t * t - 1.0 / 3.0)
    between = ndtr((depth + half) / edge) - ndtr((depth - half) / edge)
    inside = np.maximum(seeding, LEAST_DENSITY) * between / (2.0 * half)
    return np.asarray((1.0 - stray) * inside + stray / searched, dtype=np.float64)


# The wall of a round pipe from the particles in it: where they end, seen from near its axis.
#
# Along each direction from the axis, at angle a and at s along it, the wall is at
#
#     r = R + (d_1 + t_1 s) cos a + (d_2 + t_2 s) sin a
#
# with d the shift and t the tilt of the true axis, small against R. Only the outer ring of the pipe's section is
# looked at, and each particle's distance for its own angle: where the wall cannot be seen, at a sensor's sides,
# particles are left out, and a seeding that grows across the pipe does no harm.
#
# Axes: the pipe's frame (along, across, away), see `nuisances.MovableScene`; lengths in mm.

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

# Packed: shifts over R, tilts times the rms of s over R, the logarithm of R over the nominal one, and the change of the
# seeding over the ring, alike at all angles and with the cosine and sine.
RADIUS, EVEN, COSINE, SINE = range(4, 8)
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
    """

    axis: Floats
    covariance: Floats
    radius_mm: float
    radius_sigma_mm: float
    blur_mm: float
    stray_share: float
    particles: int


def find_round_wall(
    place_mm: Floats, sigma_mm: Floats, radius_mm: float, searched_mm: float, frames: int = 1
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
    distance = np.hypot(place_mm[:, 1], place_mm[:, 2])
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
        _log_likelihood_of_round_wall,
        place=place,
        sigma=np.hypot(sigma, least),
        nominal=radius_mm,
        searched=searched_mm,
        span=span,
    )
    best = np.zeros(PARAMETERS)
    best[STRAY] = -4.0
    of_axis = list(range(OF_AXIS)) if span > LEAST_SPAN_SHARE * radius_mm else [0, 1]
    free = [*of_axis, *range(OF_AXIS, PARAMETERS)]
    best, covariance = most_likely(best, [*of_axis, RADIUS, STRAY], free, OF_AXIS + 1, BLURS_PER_RADIUS, likelihood)
    covariance *= frames
    unit = radius_mm * np.array([1.0, 1.0, 1.0 / span, 1.0 / span])
    axis, radius, blur, stray = _unpacked_of_round_wall(best, radius_mm, span)
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
        particles=len(place),
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
            f"{found.particles} particles near the pipe's wall tell where its axis lies to {sigma[0]:.3f} mm "
            f"across and {sigma[1]:.3f} mm in depth, not to {LARGEST_SIGMA_SHARE * radius_mm:g} mm: more of the wall "
            "has to be in view, and seeded"
        )


def _unpacked_of_round_wall(packed: Floats, nominal: float, span: float) -> tuple[Floats, float, float, float]:
    """Return the axis (4,), the radius and the blur in mm, and the share of strays."""
    axis = nominal * packed[:OF_AXIS] / np.array([1.0, 1.0, span, span])
    blur, strays = nominal * float(np.exp(packed[BLUR])), float(expit(packed[STRAY]))
    return axis, nominal * float(np.exp(packed[RADIUS])), blur, strays


def _log_likelihood_of_round_wall(
    packed: Floats, place: Floats, sigma: Floats, nominal: float, searched: float, span: float
) -> Floats:
    """Return the logarithm (n,) of each particle's density along its direction from the axis."""
    axis, radius, blur, stray = _unpacked_of_round_wall(packed, nominal, span)
    along, angle, distance = place[:, 0], np.arctan2(place[:, 2], place[:, 1]), np.hypot(place[:, 1], place[:, 2])
    inner = RING_FROM * nominal
    middle, half = 0.5 * (inner + nominal), 0.5 * (nominal - inner)
    across, away = axis[0] + axis[2] * along, axis[1] + axis[3] * along
    wall = radius + across * np.cos(angle) + away * np.sin(angle)
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
