"""Whether a picture's light lies on the calibrated lens images, and how far beside them.

A tracer, or any other small thing, lights the main lens's aperture evenly, through however many microlenses: folded
onto one cell of the lattice, all light of a picture shows the lens image of uniform light. Its rims tell how far the
lens images have moved, modulo the lattice. Things may be brighter to one side and stand before an even background: the
folded light may be a lens image times a linear function, plus a constant.

Parts of the picture err on their own, and how they differ tells how well the result is known: a picture of too few
tracers says so by its standard error.

Axes: (column, row) in pixels; parts row by row.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import ndtr, ndtri

from lfpiv_cli.arrays import Floats, Integers, Singles
from lfpiv_cli.calibration.lattice import LatticeFit
from lfpiv_cli.calibration.rectification import Rectification
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.robust import number_below
from lfpiv_cli.threads import share_out

# Parts of a picture along each side.
PARTS = 6
# Bins along a cell's side: about one a pixel, as pixels sample it; more than these would tell no more.
FEWEST_BINS, MOST_BINS = 6, 24
# Light is what stands out of the background by so many standard deviations of its noise.
LIGHT_SIGMAS = 3.0
# So many pixels tell what lies one and two standard deviations below the middle of a normal distribution to a per cent.
ENOUGH = 60_000
# Standard error of the middle by these two, in the noise of one pixel over the root of their number.
LEVEL_ERROR = 3.3
# Of noise alone this share of a standard deviation stands above three of them, on average; light is ten times of it.
NOISE_LIGHT, TIMES_NOISE = 3.8e-4, 10.0
# Gauss-Newton from the best of the bins settles to a thousandth of a pixel.
ROUNDS = 2
# Pixels that get no more than this share of what a lens image's brightest ones do lie between lens images.
DARK_SHARE = 0.02
# Of a tracer's light: how unevenly at least it fills its lens images, so that no part outweighs all others.
UNEVENNESS = 0.1
# With fewer parts that tell of the shift its error is not known; with these it may grow along the sides. It is told
# where a part tells this share of what the best one does.
FEWEST_PARTS, PARTS_FOR_SLOPES, WELL_LIT = 3.0, 10.0, 0.3
# Keeps a share of no light from being one of nothing.
TINY = float(np.finfo(np.float64).tiny)


class Cells(NamedTuple):
    """The lens images of a picture, for kernels.

    Attributes
    ----------
    off : (nj, ni, 2) how far their centres are off the plain lattice, in shares of its basis; entry [j, i] is lens
        (first_i + i, first_j + j)
    origin_px, inverse_basis : (2,), (2, 2) of the plain lattice
    """

    off: Floats
    first_i: int
    first_j: int
    origin_px: Floats
    inverse_basis: Floats

    @classmethod
    def of(cls, lattice_px: Lattice, shape: tuple[int, int], fit: LatticeFit | None = None) -> Cells:
        """Return the cells of a picture (rows, columns) on a plain lattice, or on the one that was fitted."""
        corners = [(column, row) for column in (0, shape[1] - 1) for row in (0, shape[0] - 1)]
        found = np.rint(lattice_px.coordinates(corners)).astype(np.int64)
        (low_i, low_j), (high_i, high_j) = found.min(axis=0) - 1, found.max(axis=0) + 1
        indices = np.stack(np.meshgrid(np.arange(low_i, high_i + 1), np.arange(low_j, high_j + 1)), axis=-1)
        off = np.zeros(indices.shape) if fit is None else lattice_px.coordinates(fit.centres(indices)) - indices
        inverse = np.ascontiguousarray(np.linalg.inv(lattice_px.basis))
        return cls(np.ascontiguousarray(off), int(low_i), int(low_j), lattice_px.origin, inverse)


class Place(NamedTuple):
    """How far beside its lens images the light lies somewhere, (2,) pixels, and the standard error along that."""

    shift_px: Floats
    sigma_px: float


class Beside(NamedTuple):
    """Where a picture's light lies.

    Attributes
    ----------
    places : in the middles of parts that are well lit
    following, following_sigma : share of the light that follows the lens images, 1 of a good picture
    lit : whether there is more light than noise makes
    """

    places: tuple[Place, ...]
    following: float
    following_sigma: float
    lit: bool


@dataclass(frozen=True, eq=False)
class LensImages:
    """What pictures are held against.

    Attributes
    ----------
    lattice_px : plain lattice of raw pictures
    cells : their lens images
    area : (parts, bins, bins) pixels that fall into each bin
    pattern : (parts, bins, bins) uniform light on a cell, entry [v, u] at shares u, v of the basis from a lens image's
        centre
    between : some pixels between the lens images, by their number in a picture that is read row by row
    """

    lattice_px: Lattice
    cells: Cells
    area: Floats
    pattern: Floats
    between: Integers

    @classmethod
    def of(cls, rectification: Rectification, transmission: Singles | None, lens_image_width: float) -> LensImages:
        """Return the lens images of a calibration: by its transmission, or discs of a width in pitches without one."""
        lattice, shape = rectification.fit.lattice_px, rectification.image_shape
        cells = Cells.of(lattice, shape, rectification.fit)
        bins = int(np.clip(np.rint(lattice.pitch.mean()), FEWEST_BINS, MOST_BINS))
        if transmission is None:
            # A pixel's rim is soft.
            rim = 0.5 * lens_image_width * float(lattice.pitch.mean()) + 0.5
            discs = np.asarray(sum(np.clip(rim - distance, 0.0, 1.0) for distance in _distances(bins, lattice)))
            pattern = np.repeat(discs[np.newaxis], PARTS**2, axis=0)
        else:
            upright, inside = Cells.of(rectification.lattice_px, shape), rectification.inside
            light, lit = (folded(np.where(inside, each, 0.0), 0.0, upright, bins) for each in (transmission, 1.0))
            pattern = _over(light, lit)
        area = folded(np.ones(shape), 0.0, cells, bins)

        # Enough pixels all over a picture that uniform light leaves dark; all if it leaves none.
        number = np.arange(0, shape[0] * shape[1], shape[0] * shape[1] // ENOUGH + 1)
        share = (np.column_stack([number % shape[1], number // shape[1]]) - cells.origin_px) @ cells.inverse_basis
        i, j = np.rint(share).astype(np.int64).T
        share = share - cells.off[j - cells.first_j, i - cells.first_i]
        column, row = np.rint(bins * share).astype(np.int64).T % bins
        uniform = pattern.sum(axis=0)
        between = number[uniform[row, column] <= max(DARK_SHARE * uniform.max(), uniform.min())]
        return cls(lattice, cells, area, pattern, between)

    def beside(self, picture: NDArray[np.floating]) -> Beside:
        """Return where the light of a raw picture (rows, columns) less its dark image lies; unusable pixels are NaN."""
        middle, noise = self.background(picture)
        light = folded(picture, middle + LIGHT_SIGMAS * noise, self.cells, self.pattern.shape[-1])
        light = _over(light, self.area)

        # To a bin it is where the pattern correlates best with the light.
        first, second = (np.fft.fft2(each.sum(axis=0) - each.sum(axis=0).mean()) for each in (light, self.pattern))
        alike = np.fft.ifft2(first * np.conj(second)).real
        row, column = np.unravel_index(int(np.argmax(alike)), alike.shape)
        share = np.array([column, row]) / len(alike)
        system, unknowns = self._settled(light, (share - np.rint(share)) @ self.lattice_px.basis)
        if system.alike >= PARTS_FOR_SLOPES:
            system, unknowns = self._settled(light, np.concatenate([unknowns, np.zeros(4)]))

        # Standard errors are by how parts differ (the sandwich estimate), and by bins.
        inverse = np.linalg.inv(system.matrix.sum(axis=0))
        freedom = system.alike / max(system.alike - (0.5 * len(unknowns) + 1.0), 1.0)
        covariance = freedom * (inverse @ (system.pull.T @ system.pull) @ inverse + inverse)
        places, known = [], system.alike > FEWEST_PARTS
        for lever in _levers(part_middles()[system.reported >= WELL_LIT * system.reported.max()])[..., : len(unknowns)]:
            shift, spread = lever @ unknowns, lever @ covariance @ lever.T
            along = shift / max(float(np.hypot(*shift)), TINY)
            places.append(Place(shift, float(np.sqrt(along @ spread @ along)) if known else np.inf))
        level = light.mean(axis=(1, 2))
        total = max(float(level.sum()), TINY)
        following = float(system.amount.sum()) / total
        # One part agrees with itself, as where a single pixel is bright.
        lit = total**2 / max(float(np.sum(level**2)), TINY)
        apart = float(np.sqrt(np.sum((system.amount - following * level) ** 2))) / total
        sigma = apart if lit > FEWEST_PARTS else np.inf
        return Beside(tuple(places), following, sigma, float(light.mean()) > TIMES_NOISE * NOISE_LIGHT * noise)

    def rim_width_px(self, white: NDArray[np.floating]) -> float:
        """Return how wide the rims of the lens images of a white image (rows, columns) less its dark one are.

        The standard deviation of the Gaussian that blurs discs: sharp ones have that of pixels and bins.
        """
        bins, pitch = self.pattern.shape[-1], float(self.lattice_px.pitch.mean())
        seen = _over(folded(white, 0.0, self.cells, bins).sum(axis=0), self.area.sum(axis=0)).ravel()
        distance = np.stack(list(_distances(bins, self.lattice_px)))

        def rest(unknowns: Floats) -> Floats:
            radius, width = unknowns
            discs = np.sum(ndtr((radius - distance) / width), axis=0).ravel()
            return np.asarray(seen - discs * (discs @ seen) / max(float(discs @ discs), TINY))

        bounds = (0.2 * pitch, 0.1), (0.7 * pitch, 0.5 * pitch)
        return float(least_squares(rest, (0.47 * pitch, 0.1 + 0.05 * pitch), bounds=bounds).x[1])

    def background(self, picture: NDArray[np.floating]) -> tuple[float, float]:
        """Return level and noise of a picture's background: what darker pixels between lens images vary about."""
        return dark_level(picture.ravel()[self.between])

    def _settled(self, light: Floats, unknowns: Floats) -> tuple[System, Floats]:
        """Return the last normal equations, and the unknowns (2,) or (6,) by Gauss-Newton from first values of them."""
        lattice, parts, bins = self.lattice_px, len(light), light.shape[-1]
        inverse, lever = np.linalg.inv(lattice.basis), _levers(part_middles())[..., : len(unknowns)]
        cell = Lattice(np.zeros(2), lattice.basis / lattice.pitch.mean(), lattice.layout)
        seen = light.reshape(parts, -1, 1)
        for _ in range(ROUNDS):
            moved, slope = _moved(self.pattern, lever @ unknowns @ inverse)
            across = (cell_places(bins) @ lattice.basis - unknowns[:2]) / lattice.pitch.mean()
            across -= cell.points(cell.nearest(across))
            free = np.stack([moved, moved * across[..., 0], moved * across[..., 1], np.ones_like(moved)], axis=-1)
            kept, upper = np.linalg.qr(free.reshape(parts, -1, 4))
            factor = np.linalg.solve(upper, np.swapaxes(kept, 1, 2) @ seen)[:, 0]
            amount = factor[:, 0] * moved.mean(axis=(1, 2))
            design = np.maximum(factor, 0.0)[:, :1, np.newaxis] * (slope.reshape(parts, -1, 2) @ inverse.T)
            rest, design = (each - kept @ (np.swapaxes(kept, 1, 2) @ each) for each in (seen, design))
            variance = np.sum(rest[..., 0] ** 2, axis=1) / (bins**2 - 4) + (UNEVENNESS * amount) ** 2
            weight = 1.0 / np.maximum(variance, TINY)[:, np.newaxis, np.newaxis]
            design = design @ lever
            matrix = weight * (np.swapaxes(design, 1, 2) @ design)
            # nothing is known beyond half a pitch: parts without light leave the rest as it is
            matrix += np.eye(len(unknowns)) / (parts * (0.5 * float(lattice.pitch.mean())) ** 2)
            system = System(matrix, (weight * (np.swapaxes(design, 1, 2) @ rest))[..., 0], amount)
            unknowns = unknowns + np.linalg.inv(matrix.sum(axis=0)) @ system.pull.sum(axis=0)
        return system, unknowns


def _distances(bins: int, lattice_px: Lattice) -> Iterator[Floats]:
    """Yield how far the bins of a cell (bins, bins) are from each of the lens images around, px."""
    place, steps = cell_places(bins), range(-2, 4)
    return (np.linalg.norm((place - (i, j)) @ lattice_px.basis, axis=-1) for i in steps for j in steps)


def dark_level(pixels: NDArray[np.floating]) -> tuple[float, float]:
    """Return level and noise of what darker ones of pixels vary about; those that are not numbers do not count."""
    known = pixels[np.isfinite(pixels)]
    if not known.size:
        return 0.0, 0.0
    edges, below = number_below(known)
    two, one = np.interp((-2.0, -1.0), ndtri(np.minimum(below, known.size - 0.5) / known.size), edges)
    return float(2.0 * one - two), float(one - two)


def level_error(noise: float, pixels: int) -> float:
    """Return the standard error of the level that `dark_level` finds by so many pixels of normal noise."""
    return LEVEL_ERROR * noise / float(np.sqrt(max(pixels, 1)))


def folded(picture: NDArray[np.floating], level: float, cells: Cells, bins: int) -> Floats:
    """Return the light above a level on one cell (parts, bins, bins), summed over each part of a picture.

    Pixels that are not numbers have none.
    """
    # Beyond the last bin comes the first one again; rounding may reach one further.
    total = np.zeros((PARTS**2, bins + 2, bins + 2))
    share_out(fold_strips, PARTS, np.ascontiguousarray(picture, dtype=np.float32), level, cells, total)
    total[:, :2] += total[:, bins:]
    total[:, :, :2] += total[:, :, bins:]
    return total[:, :bins, :bins]


@njit(cache=True, nogil=True)
def fold_strips(strips: tuple[int, int], picture: Singles, level: float, cells: Cells, total: Floats) -> None:
    """Add the light of strips of parts to `total`; a pixel's is shared by the four bins around it."""
    (rows, columns), bins = picture.shape, total.shape[1] - 2
    inverse = cells.inverse_basis
    for row in range(-(-strips[0] * rows // PARTS), -(-strips[1] * rows // PARTS)):
        y = row - cells.origin_px[1]
        for part in range(PARTS):
            here = total[(row * PARTS // rows) * PARTS + part]
            for column in range(-(-part * columns // PARTS), -(-(part + 1) * columns // PARTS)):
                light = picture[row, column] - level
                if not light > 0.0:
                    continue
                x = column - cells.origin_px[0]
                u = x * inverse[0, 0] + y * inverse[1, 0]
                v = x * inverse[0, 1] + y * inverse[1, 1]
                i, j = int(np.rint(u)) - cells.first_i, int(np.rint(v)) - cells.first_j
                u, v = u - cells.off[j, i, 0], v - cells.off[j, i, 1]
                right, down = (u - np.floor(u)) * bins, (v - np.floor(v)) * bins
                left, top = int(right), int(down)
                right, down = right - left, down - top
                here[top, left] += light * (1.0 - right) * (1.0 - down)
                here[top, left + 1] += light * right * (1.0 - down)
                here[top + 1, left] += light * (1.0 - right) * down
                here[top + 1, left + 1] += light * right * down


class System(NamedTuple):
    """Normal equations of where the light lies: unknowns are a shift, and perhaps how it grows along each side.

    Attributes
    ----------
    matrix, pull : (parts, k, k), (parts, k) what each part adds, in inverse variances; k is 2 or 6
    amount : (parts,) light that follows the lens images
    """

    matrix: Floats
    pull: Floats
    amount: Floats

    @property
    def reported(self) -> Floats:
        """(parts,) how much each part tells of the shift."""
        return np.asarray(np.trace(self.matrix[:, :2, :2], axis1=1, axis2=2))

    @property
    def alike(self) -> float:
        """How many parts that tell as much as each other would tell what they do."""
        return float(self.reported.sum() ** 2 / np.sum(self.reported**2))


def _moved(pattern: Floats, shift: Floats) -> tuple[Floats, Floats]:
    """Return the pattern moved by a shift (parts, 2) in cells, and its slopes (parts, bins, bins, 2) with the shift."""
    bins = pattern.shape[-1]
    frequency = np.fft.fftfreq(bins, 1.0 / bins)
    below = np.abs(frequency) < 0.5 * bins
    wave = -2j * np.pi * np.stack(np.meshgrid(frequency, frequency), axis=-1)
    turn = np.exp(wave @ shift[:, np.newaxis, :, np.newaxis])[..., 0]
    spectrum = np.fft.fft2(pattern) * np.outer(below, below) * turn
    slope = [np.fft.ifft2(spectrum * wave[..., axis]).real for axis in range(2)]
    return np.fft.ifft2(spectrum).real, np.stack(slope, axis=-1)


def _levers(places: Floats) -> Floats:
    """Return the matrices (n, 2, 6) from the unknowns to the shift at places (n, 2), from -1 to 1 along each side."""
    terms = np.column_stack([np.ones(len(places)), places])
    return np.asarray(np.einsum("nk,ab->nakb", terms, np.eye(2)).reshape(len(places), 2, 6))


def part_middles() -> Floats:
    """Return the middles (parts, 2) of the parts, from -1 to 1 along each side."""
    side = (2.0 * np.arange(PARTS) + 1.0) / PARTS - 1.0
    return np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)


def cell_places(bins: int) -> Floats:
    """Return the places (bins, bins, 2) of the bins in shares of the basis."""
    share = np.arange(bins) / bins
    return np.stack(np.meshgrid(share, share), axis=-1)


def _over(light: Floats, area: Floats) -> Floats:
    """Return the mean light (parts, bins, bins) of pixels, 0 in bins without any."""
    return np.asarray(light / np.where(area > 0.0, area, 1.0))
