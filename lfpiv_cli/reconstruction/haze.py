"""Haze: light that is smooth over the sensor and lies on all lens images, as scattered light does, beside the tracers'.

Behind a microlens haze has the profile of uniform light, and what of it no tracer outshines is the darkest of a lens
image. Where haze alone is, pixels differ by its noise, each by its own; where tracers crowd, so that no pixel is
without their light, the darkest differ by texture, which pixels side by side have in common. So one is known from the
other, and light is taken for haze only where it is.

Axes: raw images [row, column], counts; lenses [j, i].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.ndimage import distance_transform_edt

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.optics.camera import Lattice, nearest_on_grid
from lfpiv_cli.robust import HALF_NORMAL_MEDIAN

# Pixels that get this share of what their lens image's brightest ones do tell of haze: at rims the profile is less
# certain. The brightest is the usual one of so many lenses along each side, whose resampling rings.
PLATEAU, ALIKE_LENSES = 0.8, 5
# A microlens tells that shows this share of the plateau's usual pixels.
WHOLE = 0.5
# The search begins with what this percentile of a microlens's pixels is, at this percentile of the microlenses in a
# field of so many along each side: of one tracer for each microlens an eighth of the pixels is dark.
DARK_PERCENTILE, BRIGHTER_PERCENTILE, DARK_LENS_PERCENTILE, FIELD_LENSES = 5.0, 25.0, 20.0, 9
# It moves to the mean of the pixels within this many standard deviations, smoothed over this many microlenses
# (standard deviation); after so many rounds it moves by less than a hundredth of one.
CORE_SIGMAS, SMOOTH_LENSES, ROUNDS = 1.5, 2.0, 12
# Its error is so many times that of the mean of as many pixels, as the core moves with them: 1.4 by normal noise alone,
# up to 2.4 on drawn rigs with tracers.
CORE_ERROR = 2.0
# At first haze is known to this share, by how uneven it is over a field; from round to round the standard deviation
# falls to this share of itself at most.
UNEVENNESS, COOLING = 0.15, 0.7
# Microlenses of which fewer pixels are dark do not tell; haze has at least so many standard deviations of its noise:
# of 1.3 to 1.9 tracers for each microlens, without haze, few pixels are dark, and what they have is up to 1.3. Where
# more than a share of all pixels is dark, as of 0.8 tracers and fewer, it is up to 0.3. Of what is less than a pixel's
# noise the pixels that a tracer lights have much: with 2 standard deviations depths were 8 % too small.
LEAST_DARK, LEAST_SIGMAS = 0.05, 2.5
MUCH_DARK, LEAST_SIGMAS_OF_DARK = 0.15, 0.4
# Of fewer counts rounding leaves nothing or a whole one, and two standard errors of what it makes are as much; a dark
# level that drifts is that of pixels between the lens images, too. Whole counts are steps: the search begins no finer,
# and texture is looked at as far as the next count.
LEAST_COUNTS, STEP_COUNTS, NEXT_COUNT = 0.6, 1.0, 1.1
# Rounding hides so much of the level between lens images, above which haze is (standard error).
ROUNDING_COUNTS = 0.29
# Where few pixels lie between lens images haze may be their level's error: it is above this many of it.
CERTAIN_SIGMAS = 3.0
# How far below it noise is looked at, and how far to either side texture.
BELOW_SIGMAS, NEAR_SIGMAS = 4.0, 2.0
# Share of the variance that pixels side by side have in common: of haze of 50 to 5,000 counts, with up to 0.65 tracers
# of 2,000 counts for each microlens, up to 0.4, of 1,500 with one, 0.3; of two tracers and more without haze 0.96.
LARGEST_TEXTURE = 0.4
# Fewer pairs of pixels tell nothing.
FEWEST_PAIRS = 1000
# Keeps a mean over no pixels from being a division by zero.
LEAST_PIXELS = 1e-6


class Lenses(NamedTuple):
    """Which microlens each pixel of an image belongs to: its number (pixels,), of so many, rows times columns.

    The first one has the indices `first` (i, j) on the lattice.
    """

    number: Integers
    shape: tuple[int, int]
    first: Integers

    @classmethod
    def of(cls, lattice_px: Lattice, image_shape: tuple[int, int]) -> Lenses:
        """Return them for an image (rows, columns) on a lattice of lens images (column, row)."""
        rows, columns = (np.arange(n, dtype=np.float64) for n in image_shape)
        indices = nearest_on_grid(columns, rows, lattice_px.origin, lattice_px.basis).reshape(2, -1)
        least = indices.min(axis=1).astype(np.int64)
        i, j = indices - least[:, np.newaxis]
        ni, nj = int(i.max()) + 1, int(j.max()) + 1
        return cls(j * ni + i, (nj, ni), least)

    def sums(self, values: NDArray[Any]) -> Floats:
        """Return the sum of pixels' values over each microlens (nj, ni)."""
        return self.of_some(slice(None), values)

    def of_some(self, pixels: NDArray[Any] | slice, values: NDArray[Any] | None = None) -> Floats:
        """Return the sum of some pixels' values over each microlens (nj, ni), or their number."""
        total = np.bincount(self.number[pixels], values, math.prod(self.shape)).astype(np.float64)
        return total.reshape(self.shape)


@dataclass(frozen=True, eq=False)
class Haze:
    """Haze of an image.

    Attributes
    ----------
    image : (rows, columns) its light, counts
    level_counts : in the middle of lens images, the median over the sensor
    """

    image: Singles
    level_counts: float


@dataclass(frozen=True, eq=False)
class White:
    """Uniform light as the raw image shows it.

    Attributes
    ----------
    light : (rows, columns) share of the light in the middle of the sensor
    lenses : whose lens image a pixel is in
    places : (2, pixels) where it lies among the lenses: (j, i) as fractions
    plateau : (pixels,) in the middle of a lens image
    """

    light: Singles
    lenses: Lenses
    places: Singles
    plateau: Flags

    def haze_in(
        self, picture: Singles, usable: Flags, background: tuple[float, float], level_error: float
    ) -> tuple[Haze | None, float]:
        """Return the haze in a raw picture (rows, columns) less its dark image, and its standard error in counts.

        None where there is none for certain: what may be haze, and is too faint to take off, is an error. Where hardly
        a pixel is dark nothing is known of it, and the error is 0.

        Parameters
        ----------
        background : level and noise between the lens images, counts: haze is what is above
        level_error : standard error of that level, counts
        """
        level, noise = background
        pixels = np.flatnonzero(usable.ravel() & self.plateau)
        places = self.places[:, pixels]
        light = (picture.ravel()[pixels].astype(np.float64) - level) / self.light.ravel()[pixels]
        found = self._darkest(pixels, light)
        if found is None:
            return None, 0.0
        haze, sigma = found[0], max(found[1], noise, UNEVENNESS * float(np.median(found[0])), STEP_COUNTS)
        rest, whole = light - _between(haze, places), self._smoothed(pixels)
        for _ in range(ROUNDS):
            # To the next count at least: haze between two that are further apart than the noise would be one of them.
            core = np.abs(rest) < max(CORE_SIGMAS * sigma, NEXT_COUNT)
            total, count = self._smoothed(pixels[core], rest[core]), self._smoothed(pixels[core])
            haze = haze + total / np.maximum(count, LEAST_PIXELS)
            # Where hardly a pixel is dark it is as in the nearest microlenses where some are.
            hidden = count < LEAST_DARK * whole
            if hidden.all():
                return None, 0.0
            haze = haze[tuple(distance_transform_edt(hidden, return_distances=False, return_indices=True))]
            rest = light - _between(haze, places)
            below = rest[(rest < 0.0) & (rest > -BELOW_SIGMAS * sigma)]
            least = float(np.median(-below)) / HALF_NORMAL_MEDIAN if below.size else 0.0
            sigma = max(least, COOLING * sigma, 0.5 * noise)
        middle = float(np.median(haze[self.lenses.of_some(pixels) > 0.0]))
        # Noise alone is below the haze as often as above.
        dark = 2.0 * float(np.mean(rest < 0.0)) > MUCH_DARK
        told_by = 4.0 * np.pi * SMOOTH_LENSES**2 * float(np.median(count))
        error = math.hypot(CORE_ERROR * sigma / math.sqrt(max(told_by, 1.0)), ROUNDING_COUNTS, level_error)
        least = max((LEAST_SIGMAS_OF_DARK if dark else LEAST_SIGMAS) * sigma, LEAST_COUNTS)
        faint = middle <= max(least, CERTAIN_SIGMAS * level_error)
        near = np.full(picture.shape, np.nan)
        near.ravel()[pixels] = np.where(np.abs(rest) < NEAR_SIGMAS * sigma + STEP_COUNTS, rest, np.nan)
        if faint or _in_common(near) > LARGEST_TEXTURE:
            return None, math.hypot(middle, error) if faint and dark else 0.0
        lit = np.maximum(_between(haze, self.places), 0.0).reshape(picture.shape) * self.light
        return Haze(lit.astype(np.float32), middle), error

    def _smoothed(self, pixels: Integers, values: Floats | None = None) -> Floats:
        """Return the sum of some pixels' values over microlenses (nj, ni), or their number, smoothed."""
        return np.asarray(ndimage.gaussian_filter(self.lenses.of_some(pixels, values), SMOOTH_LENSES, mode="constant"))

    def _darkest(self, pixels: Integers, light: Floats) -> tuple[Floats, float] | None:
        """Return what dark pixels of the microlenses (nj, ni) have, and how far those differ that may be alike."""
        if not pixels.size:
            return None
        number, count = self.lenses.number[pixels], self.lenses.of_some(pixels).ravel()
        whole = count > WHOLE * np.median(count[count > 0.0])
        # One sort of all, microlens by microlens.
        lowest, span = float(light.min()), float(np.ptp(light)) + 1.0
        ordered = np.sort(number * span + (light - lowest))
        first = np.cumsum(count) - count
        dark, brighter = (
            ordered[(first + 0.01 * percentile * count).astype(np.int64)[whole]] - np.flatnonzero(whole) * span + lowest
            for percentile in (DARK_PERCENTILE, BRIGHTER_PERCENTILE)
        )
        known, of_all = whole.reshape(self.lenses.shape), np.zeros(count.size)
        of_all[whole] = dark
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        of_all = of_all.reshape(self.lenses.shape)[tuple(nearest)]
        haze = ndimage.percentile_filter(of_all, DARK_LENS_PERCENTILE, FIELD_LENSES, mode="nearest")
        return haze, float(np.percentile(brighter - dark, DARK_LENS_PERCENTILE))


@lru_cache(maxsize=1)
def white_of(calibration: Calibration) -> White | None:
    """Return the white image of a calibration, which all its frames share; None where it has none."""
    light, lattice_px = calibration.white, calibration.fit.lattice_px
    if light is None:
        return None
    lenses = Lenses.of(lattice_px, (light.shape[0], light.shape[1]))
    row, column = np.indices(light.shape)
    places = lattice_px.coordinates(np.stack([column, row], axis=-1)).reshape(-1, 2) - lenses.first
    brightest = np.zeros(math.prod(lenses.shape))
    np.maximum.at(brightest, lenses.number, light.ravel())
    usual = ndimage.median_filter(brightest.reshape(lenses.shape), ALIKE_LENSES).ravel()
    plateau = (light.ravel() > PLATEAU * usual[lenses.number]) & (light.ravel() > 0.0)
    return White(light, lenses, np.ascontiguousarray(places.T[::-1], np.float32), plateau)


def _between(of_lenses: Floats, places: NDArray[np.floating]) -> Floats:
    """Return what pixels (n,) have at places (2, n) among lenses, of which (nj, ni) are known: linearly between."""
    return np.asarray(ndimage.map_coordinates(of_lenses, places, order=1, mode="nearest"))


def _in_common(rest: Floats) -> float:
    """Return the share of the variance (rows, columns) that pixels side by side have in common; NaN does not count."""
    pairs = [(rest[1:], rest[:-1]), (rest[:, 1:], rest[:, :-1])]
    one, other = (np.concatenate([each[k].ravel() for each in pairs]) for k in (0, 1))
    both = np.isfinite(one) & np.isfinite(other)
    one, other = one[both], other[both]
    squares = 0.5 * float(np.sum(one**2 + other**2))
    return float(np.sum(one * other)) / squares if one.size >= FEWEST_PAIRS and squares > 0.0 else np.inf
