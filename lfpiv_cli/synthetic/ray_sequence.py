"""Where rays of small glowing balls start, cross the lens and end: evenly spread sequences, shifted for each ball."""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.special import ndtri

from lfpiv_cli.arrays import Floats
from lfpiv_cli.optics.camera import Camera

# Additive recurrence in four dimensions (aperture and ball): powers of the inverse of the root of x^5 = x + 1, whose
# multiples fill the unit cube more evenly than random points do.
SEQUENCE_ROOT = 1.1673039782614187
SEQUENCE = SEQUENCE_ROOT ** -np.arange(1.0, 5.0)

# Another one, by the root of x^7 = x + 1, for what moves a ray's end: it goes with none of the numbers above.
BLUR_SEQUENCE = 1.1127756842787 ** -np.arange(1.0, 7.0)
# Pairs of ends that rays take in turn, opposite to each other: a blur moves no light as a whole.
BLUR_PAIRS = 8_192


@njit(cache=True)
def ray_places(shifts: Floats, i: int, k: int) -> tuple[float, float, float, float]:
    """Return ray k of ball i as `on_disc` and `in_ball` take it, the first two numbers and the last ones."""
    return (
        shifts[i, 0] + k * SEQUENCE[0],
        shifts[i, 1] + k * SEQUENCE[1],
        shifts[i, 2] + k * SEQUENCE[2],
        shifts[i, 3] + k * SEQUENCE[3],
    )


@njit(cache=True)
def on_disc(radius: float, radial: float, turn: float) -> tuple[float, float]:
    """Return the point of an evenly filled disc for two numbers, evenly spread between any integers."""
    r = radius * np.sqrt(radial % 1.0)
    return r * np.cos(2.0 * np.pi * turn), r * np.sin(2.0 * np.pi * turn)


@njit(cache=True)
def in_ball(radius: float, radial: float, turn: float) -> tuple[float, float]:
    """Return a point of an evenly filled ball, seen along the axis: the share 1 - (1 - r^2/R^2)^(3/2) lies within r."""
    r = radius * np.sqrt(1.0 - (radial % 1.0) ** (2.0 / 3.0))
    return r * np.cos(2.0 * np.pi * turn), r * np.sin(2.0 * np.pi * turn)


@njit(cache=True)
def blur_place(shifts: Floats, i: int, k: int, count: int) -> int:
    """Return which of `count` places ray k of ball i takes beside where it would end."""
    return (int(shifts[i, 0] * count) + k) % count


def diffused_mm(camera: Camera) -> Floats:
    """Return places (n, 2) on the sensor beside a ray's end to which charge diffuses: one, 0, where it does not."""
    if camera.diffusion_px == 0.0:
        return np.zeros((1, 2))
    return in_pairs(camera.diffusion_px * camera.pixel_mm * ndtri(blur_numbers()[:, :2]))


def blur_numbers() -> Floats:
    """Return numbers (`BLUR_PAIRS`, 6) that fill the open unit cube evenly."""
    return ((np.arange(BLUR_PAIRS) + 0.5)[:, np.newaxis] * BLUR_SEQUENCE) % 1.0


def in_pairs(places: Floats) -> Floats:
    """Return places (n, 2), each followed by the opposite one."""
    return np.stack([places, -places], axis=1).reshape(-1, 2)
