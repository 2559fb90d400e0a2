"""Moments of a flow over many pairs: mean, Reynolds stresses, skewness, kinetic energy, each with its standard error.

What was measured counts at places: nodes of a grid, where each pair has a vector at most, or bins that each pair's
tracks fall into (ensemble particle tracking). In a bin a linear trend is fitted to the velocities, whose value at the
bin's middle is the mean, so that a gradient across the bin is no fluctuation. With residuals r of n samples and p terms
of the trend (1 of a node, 4 of a bin) the stresses are <u_i' u_j'> = sum(r_i r_j) / (n - p), less the mean covariance
of the samples' stated errors: noise is independent of the flow. What is left may be negative by chance, and is kept.

Standard errors are by the moving block bootstrap (Kuensch 1989; circular, Politis and Romano 1992) over pairs, whose
samples are drawn together, as they have the flow of their time in common. Pairs in a time-resolved sequence are alike
for some time: with the autocorrelation rho of the fluctuations, tau = 1 + 2 sum(rho) pairs are worth one, twice the
integral time. Blocks have the length that errs least for a memory phi^k of the same tau (Politis and White 2004), and
one pair where pairs are independent; by what blocks of that length still miss of it, errors are widened.

Axes: values (u, v, w) in m/s, or any unit of a velocity; symmetric tensors as xx, yy, zz, xy, yz, xz.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from threadpoolctl import threadpool_limits

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.threads import blocks

# Replicates of the bootstrap: standard errors scatter by 1 / sqrt(2 R), 3.5 %.
REPLICATES = 400
SEED = 20
# The integral time settles within so many steps, of which each is a correction to the one before.
ITERATIONS = 4
# The sum over lags ends at so many integral times: beyond are noise and, of exp(-t/T), less than 2 %.
LAGS_SUMMED = 4.0
# A direction along which offsets scatter by less than this share of the largest has no trend.
SMALLEST_SCATTER = 1e-8
# No block is longer than this share of all pairs: fewer blocks tell no scatter.
LARGEST_BLOCK = 1.0 / 3.0
# Convergence is shown by groups of 2, 4, 8, ... pairs, up to so many of each, and four at least.
MOST_GROUPS, FEWEST_GROUPS = 64, 4
# Sums of so many bytes are in memory at once.
SUMS_BYTES = 2**26

# The components of symmetric tensors, and how stresses are called.
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))
STRESSES = ("uu", "vv", "ww", "uv", "vw", "uw")
FULL = [[0, 3, 5], [3, 1, 4], [5, 4, 2]]
# The columns of what is computed for each place, and the components that each is a product of.
MEAN, STRESS, RMS, SKEWNESS, ENERGY = slice(0, 3), slice(3, 9), slice(9, 12), slice(12, 15), slice(15, 16)
FACTORS = ((0,), (1,), (2,), *PAIRS, *PAIRS[:3], *((k, k, k) for k in range(3)), (0, 0))


@dataclass(frozen=True, eq=False)
class Ensemble:
    """What was measured in many pairs, in any order.

    Attributes
    ----------
    places, frames : how many places and pairs there are
    place, frame : (n,) of each sample, from 0; pairs are numbered in the order of time
    value : (n, 3) velocity
    noise : (n, 6) covariance of its error; NaN where it is not known
    offset : (n, 3) from the middle of its bin, in sides of the bin; (n, 0) of nodes
    """

    places: int
    frames: int
    place: Integers
    frame: Integers
    value: Floats
    noise: Floats
    offset: Floats

    @cached_property
    def samples(self) -> Integers:
        """How many samples each place has."""
        return np.bincount(self.place, minlength=self.places)


class Profile(NamedTuple):
    """Which places are averaged for each point of a profile, and along which axes their components count.

    Attributes
    ----------
    name : where it lies
    components : what the three are called
    at_mm : (k,) where the points are
    point : (places,) the point that a place belongs to, -1: none
    turn : (places, 3, 3) rows are the axes along which components are taken, or None: x, y, z
    """

    name: str
    components: tuple[str, str, str]
    at_mm: Floats
    point: Integers
    turn: Floats | None = None


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments with their standard errors, at places or points of a profile (n, ...).

    Attributes
    ----------
    values, sigma : (n, 16): mean, stresses, rms, skewness and kinetic energy, noise included; of profiles the rms and
        skewness is NaN
    noise : (n, 6) what the stated errors add to the stresses; NaN where they state none
    samples : (n,) number of samples
    """

    values: Floats
    sigma: Floats
    noise: Floats
    samples: Integers

    @property
    def stress(self) -> Floats:
        """The Reynolds stresses (n, 6) without noise."""
        return self.values[:, STRESS] - self.noise

    @property
    def energy(self) -> Floats:
        """The kinetic energy of the fluctuations (n,), without noise."""
        return 0.5 * self.stress[:, :3].sum(axis=1)


@dataclass(frozen=True, eq=False)
class Statistics:
    """Statistics of an ensemble.

    Attributes
    ----------
    moments : at all places, NaN where there are too few samples
    tau : (3,) how many pairs are worth one, of each component
    block : length of the bootstrap's blocks, pairs
    pairs : (m,) numbers of pairs
    spread : (m, 16) rms over places by which moments of so many pairs scatter; those of all pairs by standard errors
    profile : moments at its points, None where none is asked for
    """

    moments: Moments
    tau: Floats
    block: int
    pairs: Integers
    spread: Floats
    profile: Moments | None


def statistics_of(ensemble: Ensemble, fewest: int = 1, profile: Profile | None = None) -> Statistics:
    """Return the statistics of an ensemble; places with fewer samples than `fewest` have none."""
    frames = ensemble.frames
    mean, terms, columns = _detrended(ensemble)
    enough = ensemble.samples >= max(fewest, 1)
    mean[~enough] = np.nan
    order = np.argsort(ensemble.place, kind="stable")
    begins = np.concatenate([[0], np.cumsum(ensemble.samples)])

    def sums(part: slice) -> Floats:
        """Return the sums (frames, places, columns) over the samples of a part of the places."""
        rows, width = order[begins[part.start] : begins[part.stop]], part.stop - part.start
        cell = ensemble.frame[rows] * width + ensemble.place[rows] - part.start
        each = [np.bincount(cell, column, frames * width) for column in columns[rows].T]
        return np.asarray(np.stack(each, axis=-1), dtype=np.float64).reshape(frames, width, -1)

    at_once = max(SUMS_BYTES // (8 * max(frames, REPLICATES) * columns.shape[1]), 1)
    parts = blocks(ensemble.places, at_once)
    tau = decorrelation((sums(part) for part in parts), frames)
    block = block_length(float(tau.max()), frames)
    widened = widening(tau, block)
    weights, groups = _weights(frames, block)
    values, sigma = np.full((2, ensemble.places, len(FACTORS)), np.nan)
    squares, known = np.zeros((2, len(groups), len(FACTORS)))
    points = 0 if profile is None else len(profile.at_mm)
    lines, averaged = np.zeros((len(weights), points, len(FACTORS))), np.zeros(points)
    with threadpool_limits(limits=1, user_api="blas"), np.errstate(divide="ignore", invalid="ignore"):
        for part in parts:
            found = sums(part)
            each = _moments(np.tensordot(weights, found, axes=1), mean[part], terms[part])
            values[part] = each[0]
            drawn = block / np.count_nonzero(found[..., 0], axis=0)
            sigma[part] = _scatter(each, drawn[:, np.newaxis])
            sigma[part, MEAN] = _error_of_means(found, drawn[:, np.newaxis], block)
            sigma[part] *= widened
            for number, (pairs, rows) in enumerate(groups):
                off2 = (each[rows] - each[0]) ** 2 / (1.0 - pairs / frames)
                squares[number] += np.nansum(off2, axis=(0, 1))
                known[number] += np.isfinite(off2).sum(axis=(0, 1))
            if profile is not None:
                turned, inside = _turned(each, profile, part)
                # The share of each place in the sums of the points.
                shares = (profile.point[part] == np.arange(points)[:, np.newaxis]) & inside
                lines += np.einsum(
                    "kp,rpc->rkc", shares.astype(np.float64), np.where(inside[:, np.newaxis], turned, 0.0)
                )
                averaged += shares.sum(axis=1)
        there = np.isfinite(sigma)
        usual2 = np.where(there, sigma**2, 0.0).sum(axis=0) / there.sum(axis=0)
        spread = np.sqrt(np.append(squares / known, usual2[np.newaxis], axis=0))
        moments = Moments(values, sigma, _mean_noise(ensemble, enough), ensemble.samples)
        line = None
        if profile is not None:
            line = _averaged(lines / averaged[:, np.newaxis], widened, block / frames, profile, moments)
    return Statistics(moments, tau, block, np.array([*(pairs for pairs, _ in groups), frames]), spread, line)


def _detrended(ensemble: Ensemble) -> tuple[Floats, Integers, Floats]:
    """Return the means (places, 3), the numbers of terms of the trends (places,), and what is summed of each sample.

    That is (n, 16): 1, the residuals, their products, their cubes, and their influence on the mean.
    """
    terms = np.concatenate([np.ones((len(ensemble.place), 1)), ensemble.offset], axis=1)
    count = terms.shape[1]

    def sums(values: Floats) -> Floats:
        return np.stack([np.bincount(ensemble.place, each, ensemble.places) for each in values.T], axis=-1)

    matrix = sums((terms[:, :, np.newaxis] * terms[:, np.newaxis]).reshape(-1, count**2)).reshape(-1, count, count)
    right = sums((terms[:, :, np.newaxis] * ensemble.value[:, np.newaxis]).reshape(-1, 3 * count))
    scatter, axes = np.linalg.eigh(matrix)
    used = scatter > SMALLEST_SCATTER * scatter[:, -1:]
    inverse = (axes * np.divide(1.0, scatter, out=np.zeros_like(scatter), where=used)[:, np.newaxis]) @ axes.swapaxes(
        1, 2
    )
    trend = inverse @ right.reshape(-1, count, 3)
    r = ensemble.value - np.einsum("np,npc->nc", terms, trend[ensemble.place])
    influence = ensemble.samples[ensemble.place] * np.einsum("np,np->n", terms, inverse[ensemble.place, 0])
    products = np.stack([r[:, i] * r[:, j] for i, j in PAIRS], axis=1)
    columns = np.concatenate([terms[:, :1], r, products, r**3, influence[:, np.newaxis] * r], axis=1)
    return trend[:, 0].copy(), used.sum(axis=1), columns


def _moments(total: Floats, mean: Floats, terms: Integers) -> Floats:
    """Return the moments (rows, places, 16) of what was summed (rows, places, 16), over all samples in the first row.

    Residuals are about the trend of all, which takes all its terms from these; those of some lose their mean besides.
    """
    n = total[..., :1]
    each = total / np.where(n > 0.0, n, np.nan)
    off = each[..., 1:4]
    second = each[..., 4:10] - np.stack([off[..., i] * off[..., j] for i, j in PAIRS], axis=-1)
    third = each[..., 10:13] - 3.0 * off * each[..., 4:7] + 2.0 * off**3
    free, all_free = n - 1.0, n[0] - terms[:, np.newaxis]
    stress = second * np.where((free > 0.0) & (all_free > 0.0), n / free * (n[0] - 1.0) / all_free, np.nan)
    normal = np.maximum(stress[..., :3], 0.0)
    energy = 0.5 * normal.sum(axis=-1, keepdims=True)
    skewness = third / np.where(second[..., :3] > 0.0, second[..., :3], np.nan) ** 1.5
    found = np.concatenate([mean + each[..., 13:16], stress, np.sqrt(normal), skewness, energy], axis=-1)
    return np.where(np.isfinite(mean[:, :1]), found, np.nan)


def _scatter(each: Floats, drawn: Floats | float) -> Floats:
    """Return the standard deviation over the bootstrap's replicates, of which blocks are a share `drawn` of all pairs.

    A replicate's moments are about its own mean: without that share the deviations are too small.
    """
    replicates = each[1 : 1 + REPLICATES]
    known = np.isfinite(replicates)
    mean = np.where(known, replicates, 0.0).sum(axis=0) / known.sum(axis=0)
    variance = np.where(known, (replicates - mean) ** 2, 0.0).sum(axis=0) / known.sum(axis=0)
    return np.asarray(np.sqrt(np.where(drawn < 1.0, variance / (1.0 - np.minimum(drawn, 1.0)), np.nan)))


def _error_of_means(found: Floats, drawn: Floats, block: int) -> Floats:
    """Return the standard errors of means (places, 3) that the bootstrap tends to: s / sqrt(n) of single pairs."""
    influence = found[..., 13:16] / found[..., 0].sum(axis=0)[:, np.newaxis]
    summed = sum(np.roll(influence, step, axis=0) for step in range(block))
    variance = (np.asarray(summed) ** 2).sum(axis=0) / block
    return np.asarray(np.sqrt(np.where(drawn < 1.0, variance / (1.0 - np.minimum(drawn, 1.0)), np.nan)))


def decorrelation(parts: Iterable[Floats], frames: int) -> Floats:
    """Return how many pairs are worth one, tau (3,), by the sums (frames, places, 16) of all parts of the places.

    Fluctuations are about the mean of these very pairs, by which each rho is about tau / frames too small.
    """
    powers = []
    for found in parts:
        # The spectra in time of the fluctuations, and of how many there are.
        each = np.stack([found[..., 1:4], np.broadcast_to(found[..., :1], found[..., 1:4].shape)])
        powers.append((np.abs(np.fft.rfft(each, 2 * frames, axis=1)) ** 2).sum(axis=2))
    products, counts = np.fft.irfft(np.sum(powers, axis=0), 2 * frames, axis=1)[:, :frames]
    known = counts > 0.5
    correlation = np.divide(products, counts, out=np.zeros_like(products), where=known)
    rho = np.divide(correlation, correlation[0], out=np.zeros_like(correlation), where=correlation[0] > 0.0)[1:]
    tau = np.ones(3)
    for _ in range(ITERATIONS):
        total = 1.0 + 2.0 * np.cumsum((rho + tau / frames) / (1.0 + tau / frames), axis=0)
        long = 2.0 * np.arange(1, frames)[:, np.newaxis] >= LAGS_SUMMED * total
        if frames > 1:
            last = np.where(long.any(axis=0), long.argmax(axis=0), frames - 2)
            tau = np.clip(total[last, np.arange(3)], 1.0, frames)
    return tau


def block_length(tau: float, frames: int) -> int:
    """Return the length of blocks that makes the mean square error of the variance of means the smallest."""
    longest = max(int(LARGEST_BLOCK * frames), 1)
    return int(np.clip(round((1.5 * ((tau**2 - 1.0) / (2.0 * tau)) ** 2 * frames) ** (1.0 / 3.0)), 1, longest))


def widening(tau: Floats, block: int) -> Floats:
    """Return the factor (16,) by which blocks of pairs with a memory of tau (3,) state errors too small."""
    phi = (tau - 1.0) / (tau + 1.0)
    memory = np.array([np.prod([phi[k] for k in factors]) for factors in FACTORS])
    memory[ENERGY] = phi.max() ** 2
    missed = 2.0 * memory * (1.0 - memory**block) / (block * (1.0 - memory**2))
    return np.asarray(1.0 / np.sqrt(1.0 - missed))


def _weights(frames: int, block: int) -> tuple[Floats, list[tuple[int, slice]]]:
    """Return how often each pair is in all, in each replicate and in groups of some pairs (rows, frames); and these."""
    starts = np.random.default_rng(SEED).integers(frames, size=(REPLICATES, -(-frames // block)))
    drawn = (starts[:, :, np.newaxis] + np.arange(block)).reshape(REPLICATES, -1)[:, :frames] % frames
    rows = [np.ones((1, frames)), np.stack([np.bincount(each, minlength=frames) for each in drawn])]
    groups, pairs, begin = [], 2, 1 + REPLICATES
    while frames // pairs >= FEWEST_GROUPS:
        count = min(frames // pairs, MOST_GROUPS)
        first = pairs * np.linspace(0, frames // pairs - 1, count).round().astype(np.int64)
        number = np.arange(frames) - first[:, np.newaxis]
        rows.append(((number >= 0) & (number < pairs)).astype(np.float64))
        groups.append((pairs, slice(begin, begin + count)))
        pairs, begin = 2 * pairs, begin + count
    return np.concatenate(rows), groups


def _mean_noise(ensemble: Ensemble, enough: Flags) -> Floats:
    """Return the mean covariances of the samples' errors (places, 6), NaN where none is known."""
    known = np.isfinite(ensemble.noise).all(axis=1)
    place = ensemble.place[known]
    sums = [np.bincount(place, each, ensemble.places) for each in ensemble.noise[known].T]
    count = np.bincount(place, minlength=ensemble.places)
    return np.asarray(np.where(enough, np.stack(sums) / np.where(count > 0, count, np.nan), np.nan).T)


def turned_tensors(tensors: Floats, turn: Floats) -> Floats:
    """Return symmetric tensors (..., places, 6) along other axes, the rows of `turn` (places, 3, 3)."""
    full: Floats = turn @ tensors[..., np.array(FULL)] @ turn.swapaxes(1, 2)
    return np.stack([full[..., i, j] for i, j in PAIRS], axis=-1)


def _turned(each: Floats, profile: Profile, part: slice) -> tuple[Floats, Flags]:
    """Return moments along the axes of a profile, and which places have them and belong to it."""
    inside = (profile.point[part] >= 0) & np.isfinite(each[0, :, STRESS]).all(axis=-1)
    turned = np.where(np.isfinite(each), each, each[0])
    if profile.turn is not None:
        turn = profile.turn[part]
        turned[..., MEAN] = np.einsum("pij,rpj->rpi", turn, turned[..., MEAN])
        turned[..., STRESS] = turned_tensors(turned[..., STRESS], turn)
    return turned, inside


def _averaged(lines: Floats, widened: Floats, drawn: float, profile: Profile, moments: Moments) -> Moments:
    """Return the moments of a profile by the averages over its places (rows, k, 16)."""
    lines[..., RMS], lines[..., SKEWNESS] = np.sqrt(lines[..., STRESS][..., :3]), np.nan
    inside = (profile.point >= 0) & np.isfinite(moments.values[:, STRESS]).all(axis=1)
    point, noise = profile.point[inside], moments.noise[inside]
    if profile.turn is not None:
        noise = turned_tensors(noise, profile.turn[inside])
    count = len(profile.at_mm)
    sums = np.stack([np.bincount(point, each, count) for each in noise.T], axis=-1)
    samples = np.bincount(point, moments.samples[inside], count).astype(np.int64)
    noise = sums / np.bincount(point, minlength=count)[:, np.newaxis]
    return Moments(lines[0], widened * _scatter(lines, drawn), noise, samples)
