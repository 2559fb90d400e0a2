"""From a white image to the lattice of lens images: pitch, rotation, origin, distortion, and how well each is known.

Axes: positions are (column, row) in pixels, pixel centres at integers; angles from the columns towards the rows. The
pitch is measured, never taken from a data sheet: lens images are projected from the exit pupil, so it differs.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import fft, ndimage
from scipy.spatial import cKDTree
from scipy.special import fdtrc

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.calibration import white as of_white
from lfpiv_cli.calibration.white import find_spots, vignetting_surface
from lfpiv_cli.errors import InputError
from lfpiv_cli.names import Layout
from lfpiv_cli.neighbourhoods import largest_around, with_neighbours
from lfpiv_cli.optics.camera import Lattice
from lfpiv_cli.robust import MAD_TO_SIGMA

# The pitch and direction of a lens lattice, from the spectrum of a white image: a guess that needs no data sheet.
# Frequencies are (column, row), in cycles per pixel.

# Below 6 px a lens image has no shape left to measure; the upper end leaves room beyond the 60 px of any known camera.
SMALLEST_PITCH_PX = 6.0
LARGEST_PITCH_PX = 90.0
# A part of the image this wide holds at least eleven lenses in a row; distortion smears the peaks of a larger one.
SIDE_PX = 1024
# Spectral lines weaker than this share of the strongest are noise or speckle. Touching discs put 0.1 of the power of
# their first line into the others.
RELEVANT_SHARE = 0.05
# A lattice lights its two basic lines alike; round lens images and lens errors leave them within this ratio.
PARTNER_SHARE = 0.1
# A spectral line stands out of the noise around it: the median of a noisy spectrum's power is far below its peaks.
LINE_ABOVE_MEDIAN = 50.0
# Peaks are compared with their partner, turned by 90 or 60 degrees, within this many frequency bins.
BIN_TOLERANCE = 2
# A line's place is read from the bins this far around its strongest one; the window spreads it over two.
REFINE_BINS = 2


def lattice_vectors(image: Floats) -> tuple[Floats, Layout]:
    """Return two basis vectors (2, 2) of the lattice of bright spots, the first nearest the columns, and its layout.

    The slowest line that has a partner tells the layout by where this stands: at 90 degrees on squares, at 60 on
    hexagons, which have no line as slow at 90. The second vector is turned from the first towards the rows.

    Parameters
    ----------
    image : (rows, columns) white image

    Raises
    ------
    InputError : when the spectrum holds no such lattice with a pitch of 6 to 90 px
    """
    power, step, lines = spectral_lines(image)
    turns: dict[Layout, float] = {"square": np.pi / 2.0, "hexagonal": np.pi / 3.0}
    for first in lines:
        partner = {layout: line_power(power, step, rotated(first, turn)) for layout, turn in turns.items()}
        layout: Layout = "square" if partner["square"] >= partner["hexagonal"] else "hexagonal"
        if partner[layout] >= PARTNER_SHARE * line_power(power, step, first):
            break
    else:
        raise InputError(
            f"no lattice of lens images with a pitch of {SMALLEST_PITCH_PX:g} to {LARGEST_PITCH_PX:g} px is visible in "
            "the white image; check the exposure, and that it is a white image"
        )
    # The vectors are the rows of the inverse transpose of the frequencies.
    frequencies = []
    for line in (first, rotated(first, turns[layout])):
        # To a fraction of a bin: the centroid of the power about the strongest one.
        near, columns, rows = bins_around(power, step, line, BIN_TOLERANCE)
        row, column = np.unravel_index(np.argmax(near), near.shape)
        peak = np.array([columns[0, column], rows[row, 0]]) * step
        near, columns, rows = bins_around(power, step, peak, REFINE_BINS)
        frequencies.append(np.array([(near * columns).sum() / near.sum(), (near * rows).sum() / near.sum()]) * step)
    a, b = np.linalg.inv(np.stack(frequencies)).T
    if layout == "hexagonal":
        # Frequencies at 60 degrees make vectors at 120; the sum of these stands at 60 to the first.
        b = b + a
    around = np.array([a, b, -a, -b] if layout == "square" else [a, b, b - a, -a, -b, a - b])
    nearest = int(np.argmin(np.abs(np.arctan2(around[:, 1], around[:, 0]))))
    return np.stack([around[nearest], around[(nearest + 1) % len(around)]]), layout


def spectral_lines(image: Floats) -> tuple[Floats, Floats, list[Floats]]:
    """Return the power spectrum of the image's middle, its frequency step along (columns, rows), and its lines.

    The power is indexed [row frequency, column frequency >= 0]; slow illumination is taken off first. Lines are the
    strong local maxima as frequencies (column, row), the slowest first.
    """
    rows, columns = image.shape
    top, left = max(0, (rows - SIDE_PX) // 2), max(0, (columns - SIDE_PX) // 2)
    part = image[top : top + SIDE_PX, left : left + SIDE_PX]
    slow = ndimage.gaussian_filter(part, LARGEST_PITCH_PX / 3, mode="reflect")
    window = np.outer(np.hanning(part.shape[0]), np.hanning(part.shape[1]))
    size = [fft.next_fast_len(2 * n) for n in part.shape]
    power = np.abs(fft.rfft2((part - slow) * window, s=size)) ** 2
    step = np.array([1.0 / size[1], 1.0 / size[0]])
    frequency = np.hypot(*np.meshgrid(step[0] * np.arange(power.shape[1]), fft.fftfreq(power.shape[0])))
    in_range = (frequency >= 1.0 / LARGEST_PITCH_PX) & (frequency <= 1.0 / (SMALLEST_PITCH_PX * np.sqrt(0.75)))
    masked = np.where(in_range, power, 0.0)
    floor = max(RELEVANT_SHARE * masked.max(), LINE_ABOVE_MEDIAN * np.median(power[in_range]))
    around = largest_around(np.pad(masked, BIN_TOLERANCE, mode="wrap"), 2 * BIN_TOLERANCE + 1)
    strongest = around[BIN_TOLERANCE:-BIN_TOLERANCE, BIN_TOLERANCE:-BIN_TOLERANCE]
    row, column = np.nonzero((masked == strongest) & (masked > floor))
    lines = np.stack([step[0] * column, fft.fftfreq(power.shape[0])[row]], axis=1)
    return power, step, list(lines[np.argsort(np.hypot(lines[:, 0], lines[:, 1]), kind="stable")])


def rotated(vector: Floats, angle_rad: float) -> Floats:
    """Return the vector turned from the columns towards the rows."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])


def bins_around(power: Floats, step: Floats, line: Floats, reach: int) -> tuple[Floats, Integers, Integers]:
    """Return the power near a frequency and its column and row bin numbers; the half-plane is mirrored where needed."""
    column, row = np.rint(line / step).astype(np.int64)
    columns = np.arange(column - reach, column + reach + 1)[np.newaxis, :]
    rows = np.arange(row - reach, row + reach + 1)[:, np.newaxis]
    mirror = np.where(columns < 0, -1, 1)
    return power[(rows * mirror) % power.shape[0], np.abs(columns)], columns, rows


def line_power(power: Floats, step: Floats, line: Floats) -> float:
    """Return the strongest power within the tolerance around a frequency."""
    return float(bins_around(power, step, line, BIN_TOLERANCE)[0].max())


# Fewer lenses leave the cubic's ten coefficients per axis without a check.
FEWEST_LENSES = 30
# Of the spots found, the walk must reach this share; else it started on dirt and another start is tried.
REACHED_SHARE = 0.5
STARTS = 20
# Centroids beat with the pixels, by 0.05 px where lens images are small; where their rows are nearly whole pixels apart
# that turns the lattice. Each round leaves a third of it, until no lens image moves by more than a thousandth.
BEAT_ROUNDS = 5
BEAT_TOLERANCE_PX = 1.0e-3
# The light of a lens image is known in rings of this width, far below a pixel: rounding to them must move no rim. It
# bends little within a fifth of a pixel, as pixels do not show more.
RING_PX = 0.025
STIFFNESS = (0.1 / RING_PX) ** 4
# A speck's shadow is seen in the middles of lens images, above this share of their light, as a mean over so many pixels
# (standard deviation): it lacks this share and is no chance, of some millions. It reaches further than it is seen.
SHADOW_INNER, SHADOW_PX = 0.85, 1.0
SHADOW_LEAST, SHADOW_SIGMAS, MOST_SHADOWED = 0.05, 6.0, 0.05
# Rows of pixels that are taken at once, for their memory.
ROWS_AT_ONCE = 128
# Light that varies by less over a white image moves the pitch by less than its standard error, some 2e-6.
EVEN_LIGHT = 0.01
# Tukey's biweight: the usual constant for 95 % efficiency on a normal distribution, and enough rounds to settle.
TUKEY = 4.685
TUKEY_ROUNDS = 10
# Standard deviation along each axis over the median distance, for normal errors: 1/sqrt(2 ln 2).
MEDIAN_DISTANCE_TO_SIGMA = 0.8493
# Errors of lenses near each other are alike (dust, centroids that beat with the pixels); those of this many parts of
# the image along each side are taken for independent.
PARTS_PER_SIDE = 8
# The cubic is believed when chance would do as well less than once in 1e6, and it explains this share of the residual's
# variance and this much of it: what is left of centroids' beat with the pixels would pass for a little distortion.
CUBIC_CHANCE = 1e-6
CUBIC_GAIN = 0.2
CUBIC_LEAST_PX = 0.018
# Exponents (i, j) of the cubic polynomial in the indices; the first three are the affine lattice.
EXPONENTS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))


@dataclass(frozen=True, eq=False)
class LatticeFit:
    """The lens images of a white image and the lattice through them.

    Attributes
    ----------
    lattice_px : best plain lattice; index (0, 0) is the lens image nearest the image's centre
    indices : (n, 2) int, the lenses that were found
    centres_px : (n, 2) their measured centres, (column, row)
    cubic_px : (10, 2) coefficients of the cubic polynomial in the indices, in the order of `EXPONENTS`
    cubic_used : whether the cubic is significantly better than the plain lattice
    residual_px, residual_affine_px : (2,) rms along columns and rows, of the cubic and of the plain lattice
    pitch_sigma_px, origin_sigma_px : (2,) standard errors
    rotation_sigma_rad : standard error
    """

    lattice_px: Lattice
    indices: Integers
    centres_px: Floats
    cubic_px: Floats
    cubic_used: bool
    residual_px: Floats
    residual_affine_px: Floats
    pitch_sigma_px: Floats
    origin_sigma_px: Floats
    rotation_sigma_rad: float

    @property
    def lenses(self) -> int:
        """Number of lens images found."""
        return len(self.indices)

    @property
    def coefficients_px(self) -> Floats:
        """Coefficients (10, 2) of the chosen model, in the order of `EXPONENTS`."""
        if self.cubic_used:
            return self.cubic_px
        plain = np.zeros((len(EXPONENTS), 2))
        plain[0], plain[1:3] = self.lattice_px.origin, self.lattice_px.basis
        return plain

    def centres(self, indices: ArrayLike) -> Floats:
        """Return the modelled centres of lens images, (column, row), indices of shape (..., 2)."""
        return polynomial_terms(indices) @ self.coefficients_px

    def shifted(self, shift_px: Floats) -> LatticeFit:
        """Return the lattice with all lens images moved by a shift (2,), (columns, rows)."""
        cubic = self.cubic_px.copy()
        cubic[0] += shift_px
        return replace(
            self,
            lattice_px=self.lattice_px.transformed(np.eye(2), shift_px),
            centres_px=self.centres_px + shift_px,
            cubic_px=cubic,
        )


def fit_lattice(white: ArrayLike, dark: ArrayLike | None = None, layout: Layout | None = None) -> LatticeFit:
    """Find the lens images of a white image and fit a lattice and its cubic distortion.

    Parameters
    ----------
    white, dark : (rows, columns) photographs of uniform light and of none
    layout : of the microlens array, to be checked; default: what the image shows

    Raises
    ------
    InputError : when the image is too dark, saturated or shows no lattice
    """
    image = of_white.checked_white(white, dark)
    fit = _lattice_of(image, layout)

    # Light that falls towards the corners pulls the centroids of lens images to the middle, in proportion to the image
    # height: as another pitch would.
    even = image.astype(np.float32)
    if of_white.lens_image_width(even, fit.lattice_px) >= of_white.NARROWEST_LENS_IMAGE:
        coefficients = of_white.fit_vignetting(of_white.relative_transmission(even, fit.lattice_px), fit.lattice_px)
        passed = None if coefficients is None else vignetting_surface(coefficients, image.shape)
        if passed is not None and np.ptp(passed) > EVEN_LIGHT:
            image = image / passed
            fit = _lattice_of(image, layout)

    centroids, middle = fit.centres_px, (np.array(image.shape[::-1]) - 1.0) / 2.0
    for _ in range(BEAT_ROUNDS):
        before, errors = fit, centroid_errors(image, fit)
        fit = lattice_through(fit.indices, centroids - errors, middle, fit.lattice_px.layout)
        if np.abs(fit.centres(fit.indices) - before.centres(before.indices)).max() < BEAT_TOLERANCE_PX:
            break
    return fit


def _lattice_of(image: Floats, layout: Layout | None) -> LatticeFit:
    """Return the lattice through the centroids of the lens images of a white image less the dark one.

    These are the spots that a walk from the middle of the image reaches.
    """
    basis, seen = lattice_vectors(image)
    if layout is not None and seen != layout:
        raise InputError(
            f"the white image shows a {seen} array, and microlenses.layout is {layout}; correct it, or is it not white?"
        )
    points = find_spots(image, float(np.mean(np.hypot(basis[:, 0], basis[:, 1]))))
    centre = (np.array(image.shape[::-1]) - 1.0) / 2.0
    best, indices = np.zeros(len(points), dtype=bool), np.zeros((len(points), 2), dtype=np.int64)
    for start in np.argsort(np.hypot(*(points - centre).T), kind="stable")[:STARTS]:
        found, reached = of_white.index_spots(points, int(start), basis)
        if reached.sum() > best.sum():
            best, indices = reached, found
        if best.sum() >= REACHED_SHARE * len(points):
            break
    if best.sum() < FEWEST_LENSES:
        raise InputError(
            f"only {int(best.sum())} lens images of the white image form a lattice, at least {FEWEST_LENSES} are "
            "needed; check microlenses.layout, the exposure, and that it is a white image"
        )
    indices, points = without_strays(indices[best], points[best], float(np.hypot(*basis[0])))
    return lattice_through(indices, points, centre, seen)


def centroid_errors(image: Floats, fit: LatticeFit) -> Floats:
    """Return by how much the centroids (n, 2) of the lens images err that lie where the fit puts them, in px.

    Found in an image of lens images that are all alike and round, as those of the image are in the mean. There the
    truth is known, and what centroids miss is what pixels do to them.
    """
    centres = fit.centres(fit.indices)
    spots = find_spots(of_alike(image, fit), float(fit.lattice_px.pitch.mean()))
    away, spot = cKDTree(spots).query(centres)
    # Lens images cut by the image's edge may give no spot.
    known = away < of_white.WALK_TOLERANCE * fit.lattice_px.pitch.min()
    return np.where(known[:, np.newaxis], spots[np.minimum(spot, len(spots) - 1)] - centres, 0.0)


def of_alike(image: Floats, fit: LatticeFit) -> Floats:
    """Return the image (rows, columns) of lens images that are all alike and round: the mean of those in the image."""
    # A pixel between two lens images has light of both.
    near, second = (np.empty(image.shape, dtype=np.int64) for _ in range(2))
    ways = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]) @ fit.lattice_px.basis
    for top in range(0, len(image), ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        row, column = np.indices(image[rows].shape)
        place = np.stack([column, row + top], axis=-1)
        straight = fit.lattice_px.nearest(place)
        index = fit.lattice_px.nearest(place - fit.centres(straight) + fit.lattice_px.points(straight))
        x, y = np.moveaxis(place - fit.centres(index), -1, 0)
        near[rows] = np.rint(np.hypot(x, y) / RING_PX)
        squares = ((x - step_x) ** 2 + (y - step_y) ** 2 for step_x, step_y in ways)
        second[rows] = np.rint(np.sqrt(functools.reduce(np.minimum, squares)) / RING_PX)
    rings = int(max(near.max(), second.max())) + 1
    pairs = np.bincount((near * rings + second).ravel(), minlength=rings**2).reshape(rings, rings)
    light = sum(np.bincount(each.ravel(), image.ravel(), rings) for each in (near, second))
    bend = np.diff(np.eye(rings), 2, axis=0)
    stiff = np.diff(np.pad(bend, ((2, 2), (0, 0))), 2, axis=0)
    normal = np.diag(pairs.sum(axis=0) + pairs.sum(axis=1)) + pairs + pairs.T
    of_ring = np.linalg.solve(normal + STIFFNESS * image.size / rings * stiff, light)
    return np.asarray(of_ring[near] + of_ring[second])


def shadowed(white: Floats | Singles, fit: LatticeFit, passed: Floats | Singles) -> Flags:
    """Return the pixels (rows, columns) that lie in the shadow of a speck: darker than other lens images show them.

    Parameters
    ----------
    white : (rows, columns) raw, less the dark image
    passed : (rows, columns) what of the light varies slowly over the sensor
    """
    even = np.asarray(white / passed, np.float64)
    alike = of_alike(even, fit)
    inner = alike > SHADOW_INNER * np.percentile(alike, of_white.FULL_PERCENTILE)
    missing = np.where(inner, 1.0 - even / np.where(inner, alike, 1.0), 0.0)
    around = ndimage.gaussian_filter(inner.astype(np.float64), SHADOW_PX)
    missing = ndimage.gaussian_filter(missing, SHADOW_PX) / np.where(inner, around, 1.0)
    noise = MAD_TO_SIGMA * float(np.median(np.abs(missing[inner])))
    dark = inner & (missing > max(SHADOW_SIGMAS * noise, SHADOW_LEAST))
    # Lens images that differ otherwise, as where the aperture is cut, are no shadows.
    return with_neighbours(dark & (np.count_nonzero(dark) <= MOST_SHADOWED * np.count_nonzero(inner)))


def polynomial_terms(indices: ArrayLike, count: int = len(EXPONENTS)) -> Floats:
    """Return the first `count` monomials of the indices, shape (..., count)."""
    index = np.asarray(indices, dtype=np.float64)
    return np.stack([index[..., 0] ** a * index[..., 1] ** b for a, b in EXPONENTS[:count]], axis=-1)


def robust_fit(terms: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return coefficients (terms, 2) by least squares with Tukey's weights, and these weights (n,)."""
    scale = np.abs(terms).max(axis=0)
    weights = np.ones(len(points))
    for _ in range(TUKEY_ROUNDS):
        root = np.sqrt(weights)[:, np.newaxis]
        coefficients = np.linalg.lstsq(root * terms / scale, root * points, rcond=None)[0] / scale[:, np.newaxis]
        distance = np.hypot(*(points - terms @ coefficients).T)
        spread = MEDIAN_DISTANCE_TO_SIGMA * float(np.median(distance))
        if spread == 0.0:
            break
        weights = np.clip(1.0 - (distance / (TUKEY * spread)) ** 2, 0.0, None) ** 2
    return coefficients, weights


def without_strays(indices: Integers, points: Floats, pitch_px: float) -> tuple[Integers, Floats]:
    """Drop the spots that lie more than a quarter of the pitch off the cubic: dirt between the lenses."""
    terms = polynomial_terms(indices)
    coefficients, _ = robust_fit(terms, points)
    kept = np.hypot(*(points - terms @ coefficients).T) < 0.25 * pitch_px
    return indices[kept], points[kept]


def lattice_through(indices: Integers, points: Floats, centre: Floats, layout: Layout) -> LatticeFit:
    """Fit the plain lattice and the cubic to numbered lens images and judge whether the cubic is worth it."""
    first, _ = robust_fit(polynomial_terms(indices, 3), points)
    indices = indices - Lattice(first[0], first[1:3], layout).nearest(centre)
    terms = polynomial_terms(indices)
    affine, affine_weights = robust_fit(terms[:, :3], points)
    cubic, cubic_weights = robust_fit(terms, points)
    affine_residual = points - terms[:, :3] @ affine
    cubic_residual = points - terms @ cubic
    cubic_used = cubic_is_significant(terms, points, np.minimum(affine_weights, cubic_weights))
    residual, weights = (cubic_residual, cubic_weights) if cubic_used else (affine_residual, affine_weights)
    spread = coefficient_sigmas(terms[:, :3], residual, weights, points)
    # Standard errors of the pitch, along the vectors, and of the rotation, across them.
    length2 = np.sum(affine[1:3] ** 2, axis=1)
    along2, across2 = (np.sum((each * spread[1:3]) ** 2, axis=1) / length2 for each in (affine[1:3], affine[1:3, ::-1]))
    # Dirt on a lens, which has no weight, is not the fit's error.
    rms, rms_affine = (
        np.sqrt(np.mean(off[weight > 0.0] ** 2, axis=0))
        for off, weight in ((cubic_residual, cubic_weights), (affine_residual, affine_weights))
    )
    origin_sigma = coefficient_sigmas(terms, residual, weights, points)[0] if cubic_used else spread[0]
    return LatticeFit(
        lattice_px=Lattice(affine[0], affine[1:3], layout),
        indices=indices,
        centres_px=points,
        cubic_px=cubic,
        cubic_used=cubic_used,
        residual_px=rms,
        residual_affine_px=rms_affine,
        pitch_sigma_px=np.sqrt(along2),
        origin_sigma_px=origin_sigma,
        rotation_sigma_rad=float(np.sqrt(np.sum(across2 / length2)) / 2.0),
    )


def cubic_is_significant(terms: Floats, points: Floats, weights: Floats) -> bool:
    """Tell by an F-test whether the seven further coefficients per axis do enough, and more than chance."""
    kept = weights > 0.0
    scale = np.abs(terms).max(axis=0)
    squares = []
    for count in (3, terms.shape[1]):
        design = (terms / scale)[kept, :count]
        residual = points[kept] - design @ np.linalg.lstsq(design, points[kept], rcond=None)[0]
        squares.append(float(np.sum(residual**2)))
    more = 2 * (terms.shape[1] - 3)
    rest = 2 * (int(kept.sum()) - terms.shape[1])
    explained = (squares[0] - squares[1]) / (2 * int(kept.sum()))
    if squares[1] >= (1.0 - CUBIC_GAIN) * squares[0] or explained < CUBIC_LEAST_PX**2:
        return False
    if squares[1] == 0.0:
        return True
    ratio = (squares[0] - squares[1]) / more / (squares[1] / rest)
    # The chance of so large a ratio; scipy.stats has it, too, and takes a second to import.
    return bool(fdtrc(more, rest, ratio) < CUBIC_CHANCE)


def coefficient_sigmas(terms: Floats, residual: Floats, weights: Floats, places: Floats) -> Floats:
    """Return standard errors (terms, 2) of coefficients fitted with weights, errors being alike in parts of the image.

    The sandwich estimate over parts: what the residuals of each part pull at the coefficients counts as one error.
    Where the parts happen to cancel, what independent errors would give stands.
    """
    kept = weights > 0.0
    scale = np.abs(terms).max(axis=0)
    design, weight = (terms / scale)[kept], weights[kept]
    low, high = places[kept].min(axis=0), places[kept].max(axis=0)
    cell = np.minimum((places[kept] - low) / (high - low) * PARTS_PER_SIDE, PARTS_PER_SIDE - 1).astype(np.int64)
    part = cell[:, 0] * PARTS_PER_SIDE + cell[:, 1]
    inverse = np.linalg.inv(design.T @ (weight[:, np.newaxis] * design))
    freedom = kept.sum() / max(1, kept.sum() - terms.shape[1])
    sigmas = []
    for axis in range(2):
        pull = design * (weight * residual[kept, axis])[:, np.newaxis]
        pulls = np.stack([np.bincount(part, column, minlength=PARTS_PER_SIDE**2) for column in pull.T], axis=1)
        together, apart = (inverse @ (each.T @ each) @ inverse for each in (pulls, pull))
        sigmas.append(np.sqrt(freedom * np.maximum(np.diag(together), np.diag(apart))) / scale)
    return np.stack(sigmas, axis=1)
