"""How far a pixel may lie from the model: read noise, light's own noise, what the optics model gets wrong.

Light that is not explained yet is no noise: it lies above the model, and counts for little until it is found. Variances
are in counts squared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.special import ndtr

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import COUNT_NO_REFERENCES, njit
from lfpiv_cli.robust import HALF_NORMAL_MEDIAN, spread_below_zero
from lfpiv_cli.threads import share_out

# The optics model of a pixel's light is trusted to this share until what it leaves has been seen.
MODEL_ERROR = 0.03
# Photons of a typical tracer. Only the ratio of bright to dark pixels' weights depends on it, and positions hardly do:
# a fourth or four times of it leaves their spread the same.
PHOTONS_PER_PARTICLE = 2.5e5
# Rounding to whole counts alone makes this standard deviation.
ROUNDING_COUNTS = 0.29
# Of as many counts to either side noise may make one; of less noise it is as of this.
ROUNDING_STEPS, LEAST_SIGMA = 3, 1e-3
# While particles are sought, dark pixels are not trusted beyond this share of what a typical particle's pixels hold: a
# candidate a third of a microlens off lights dark pixels, and must not go out for it in an image with hardly any noise.
LEAST_SHARE_OF_LIT = 0.003
# Pixels are lit above this many standard deviations of the read noise. What lies further than so many from the model
# counts as no further: light that was not found, about a few particles, tells nothing of the errors of all others.
LIT_SIGMAS, USUAL_SIGMAS = 3.0, 1.0
# Distances in pixels at which errors are compared: from where white noise has ended to within a micro-image.
LAGS_PX = range(1, 9)
# Lit pixels are sorted by brightness into so many classes, of at least so many pixels, to see how their errors grow. A
# single tracer lights enough for the fewest classes that tell light's own noise from the model's error.
CLASSES, FEWEST_CLASSES, SMALLEST_CLASS = 32, 3, 100
# Of more pixels than twice so many some tell as well as all: medians of classes to 1.5 %.
ENOUGH_PIXELS = 200_000
# Multiples of the golden section lie evenly between whole numbers, however many.
GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
# Pixels whose brightness differs by a smaller share differ by rounding.
ALIKE = 1e-6


@dataclass(frozen=True)
class Noise:
    """Variance of a pixel: read^2 + gain M + (model_error M)^2 + min(edge, M)^2.

    With the model M, the gain in counts per photon, and what edges of lens images are wrong by, a share of the light
    beside: it does not grow with a pixel's own light, and is no more than that.
    """

    read_counts: float
    gain_counts: float
    model_error: float = MODEL_ERROR
    edge_counts: float = 0.0

    def weights(self, model: Floats, residual: Floats, unexplained: float) -> Floats:
        """Return 1/variance of each pixel; light above the model adds `unexplained` times its square."""
        model = np.maximum(model, 0.0)
        variance = self.read_counts**2 + self.gain_counts * model + (self.model_error * model) ** 2
        variance += np.minimum(self.edge_counts, model) ** 2
        return 1.0 / (variance + unexplained * np.maximum(residual, 0.0) ** 2)

    def of_dark(self, haze: Floats | None) -> float:
        """Return the standard deviation of pixels without a particle's light: the rms over haze (pixels,)."""
        if haze is None or not haze.size:
            return self.read_counts
        return float(np.sqrt(np.mean(1.0 / self.weights(haze, np.zeros_like(haze), 0.0))))


def pixel_weights(
    noise: Noise, image: Floats, residual: Floats, usable: NDArray[np.bool_], unexplained: float
) -> Floats:
    """Return `Noise.weights` (pixels,) of an image and what the model leaves of it; 0 where it is not usable."""
    weight = np.empty_like(image)
    numbers = (noise.read_counts, noise.gain_counts, noise.model_error, noise.edge_counts, unexplained)
    share_out(_fill_weights, image.size, numbers, image, residual, usable, weight)
    return weight


@njit(cache=True, nogil=True, error_model="numpy", **COUNT_NO_REFERENCES)
def _fill_weights(
    part: tuple[int, int],
    numbers: tuple[float, float, float, float, float],
    image: Floats,
    residual: Floats,
    usable: NDArray[np.bool_],
    weight: Floats,
) -> None:
    """Do the work of `pixel_weights` for some pixels."""
    read, gain, model_error, edge_counts, unexplained = numbers
    for k in range(part[0], part[1]):
        model, rest = max(image[k] - residual[k], 0.0), max(residual[k], 0.0)
        error, edge = model_error * model, min(edge_counts, model)
        variance = read * read + gain * model + error * error + edge * edge + unexplained * (rest * rest)
        weight[k] = 1.0 / variance if usable[k] else 0.0


class Correlation(NamedTuple):
    """How alike the errors of two pixels are: share * decay^(|di| + |dj|), and 1 for a pixel and itself."""

    share: float
    decay: float


WHITE = Correlation(0.0, 0.0)


def error_correlation(model: Floats, residual: Floats, weight: Floats, noise: Noise) -> Correlation:
    """Return the correlation of what is left of an image (rows, columns) where the model lights it.

    `weight` (rows, columns) is each pixel's 1/variance, 0 where it is not usable. A geometric series is fitted to the
    correlations along rows and columns.
    """
    error = residual * np.sqrt(weight)
    lit = (model > LIT_SIGMAS * noise.read_counts) & (weight > 0.0)
    usual = float(np.median(np.abs(error[lit]))) / HALF_NORMAL_MEDIAN if lit.any() else 0.0
    if usual == 0.0:
        return WHITE
    error = np.where(lit, np.clip(error / usual, -USUAL_SIGMAS, USUAL_SIGMAS), 0.0)
    variance = np.sum(error**2) / np.count_nonzero(lit)
    found = np.array([0.5 * (_at_lag(error, lit, lag, 0) + _at_lag(error, lit, lag, 1)) for lag in LAGS_PX]) / variance
    decay = float(np.sum(found[1:] * found[:-1]) / np.sum(found[:-1] ** 2))
    if not 0.0 < decay < 1.0:
        return WHITE
    series = decay ** np.array(LAGS_PX)
    return Correlation(float(np.clip(np.sum(series * found) / np.sum(series**2), 0.0, 1.0)), decay)


def _at_lag(error: Floats, lit: NDArray[np.bool_], lag: int, axis: int) -> float:
    """Return the mean product of errors `lag` pixels apart along an axis; `error` is 0 where not `lit`."""
    ahead, behind = (slice(lag, None), slice(-lag)) if axis == 0 else (np.s_[:, lag:], np.s_[:, :-lag])
    pairs = np.count_nonzero(lit[ahead] & lit[behind])
    return float(np.einsum("ij,ij->", error[ahead], error[behind])) / pairs if pairs else 0.0


def measured_noise(
    model: Floats,
    residual: Floats,
    usable: NDArray[np.bool_],
    noise: Noise,
    columns: int | None = None,
    *,
    rims: bool = False,
) -> Noise:
    """Return noise whose gain and errors are those that a fit leaves of an image.

    Light that was not found does not count: the median of the squares in each class of brightness is taken.

    Parameters
    ----------
    model, residual, usable : (pixels,)
    noise : taken for the read noise, and as it is where too little is lit
    columns : of the image whose residual counts as `beside_neighbours` has it; None: as it is
    rims : whether edges of lens images have noise of their own; in crowds light that was not found looks like theirs
    """
    lit = np.flatnonzero(usable & (model > LIT_SIGMAS * noise.read_counts))
    lit = lit[:: max(lit.size // ENOUGH_PIXELS, 1)]
    number = min(CLASSES, lit.size // SMALLEST_CLASS)
    if number < 1:
        return noise
    # Whole counts are spread over what was rounded to them: a median of few steps is one of these.
    spread = ROUNDING_COUNTS * np.sqrt(12.0) * ((GOLDEN * np.arange(lit.size)) % 1.0 - 0.5)
    light, left = model[lit], spread + (residual[lit] if columns is None else beside_neighbours(residual, lit, columns))

    # As many pixels in each class as may be. Where light fills a micro-image its pixels are alike but for rounding: it
    # must not tell where they belong, and classes that are left with few pixels by that say nothing.
    ends = np.cumsum([len(part) for part in np.array_split(light, number)])[:-1]
    edges = np.partition(light, ends)[ends] * (1.0 - ALIKE)
    member = np.searchsorted(edges, light, side="right").astype(np.int16)
    # Small integers are sorted in one pass.
    parts = np.split(np.argsort(member, kind="stable"), np.cumsum(np.bincount(member, minlength=number))[:-1])
    classes = [part for part in parts if 2 * part.size >= SMALLEST_CLASS]
    if not classes:
        return noise
    brightness = np.array([np.mean(light[members]) for members in classes])
    squares = np.array([np.median(left[members] ** 2) for members in classes]) / HALF_NORMAL_MEDIAN**2
    variance = squares - ROUNDING_COUNTS**2
    terms = np.column_stack([brightness, brightness**2, np.full_like(brightness, rims)])
    if len(classes) < FEWEST_CLASSES:
        terms[:, 1:] = 0.0
    # A variance is as sure as it is large.
    (gain, error2, edge2), _ = nnls(terms / variance[:, np.newaxis], 1.0 - noise.read_counts**2 / variance)
    return Noise(noise.read_counts, float(gain), float(np.sqrt(error2)), float(np.sqrt(edge2)))


def beside_neighbours(residual: Floats, pixels: NDArray[np.intp], columns: int) -> Floats:
    """Return what some pixels (n,) have beside the mean of both neighbours in their row, as large as noise is.

    Light that was not found is nearly alike in them, and noise is not. First and last of a row have nothing.

    Parameters
    ----------
    residual : (rows * columns,)
    """
    left, right = (residual.take(pixels + step, mode="clip") for step in (-1, 1))
    column = pixels % columns
    return np.where((column > 0) & (column < columns - 1), (2.0 * residual[pixels] - left - right) / np.sqrt(6.0), 0.0)


def mean_whole(counts: Floats, sigma: Floats) -> Floats:
    """Return the mean of whole counts that are recorded of these (pixels,) with noise of standard deviation sigma."""
    lowest = np.floor(counts) - ROUNDING_STEPS
    steps = np.arange(2 * ROUNDING_STEPS + 1)[:, np.newaxis]
    return np.asarray(lowest + ndtr((counts - lowest - steps - 0.5) / np.maximum(sigma, LEAST_SIGMA)).sum(axis=0))


def read_noise(image: Floats) -> float:
    """Return the read noise of a dark-subtracted image: its spread below zero, where no light hides it.

    Where pixels below a threshold were set to zero, as by who removes noise, most are zero and the faintest of the
    others shows the threshold: up to there zero says nothing.
    """
    read = spread_below_zero(image)
    lit = image[image > 0.0]
    if 0 < lit.size < np.count_nonzero(image == 0.0):
        read = max(read, (float(lit.min()) - 0.5) / np.sqrt(3.0))
    return max(read, ROUNDING_COUNTS)
