"""From a white image to the lattice of lens images: pitch, rotation, origin, distortion, and how well each is known.

Axes: positions are (column, row) in pixels, pixel centres at integers; angles from the columns towards the rows. The
pitch is measured, never taken from a data sheet: lens images are projected from the exit pupil, so it differs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc

from lfpiv_cli.calibration.spectrum import lattice_vectors
from lfpiv_cli.calibration.spots import find_spots, index_spots
from lfpiv_cli.calibration.transmission import (
    NARROWEST_LENS_IMAGE,
    fit_vignetting,
    lens_image_width,
    relative_transmission,
    vignetting_surface,
)
from lfpiv_cli.calibration.white import checked_white
from lfpiv_cli.errors import InputError
from lfpiv_cli.names import Layout
from lfpiv_cli.optics.microlenses import Lattice

# Fewer lenses leave the cubic's ten coefficients per axis without a check.
FEWEST_LENSES = 30
# Of the spots found, the walk must reach this share; else it started on dirt and another start is tried.
REACHED_SHARE = 0.5
STARTS = 20
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
# variance and this much of it: the pixels' own error of a centroid beats slowly with the pitch and would pass for a
# little distortion.
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
    indices: NDArray[np.int64]
    centres_px: NDArray[np.float64]
    cubic_px: NDArray[np.float64]
    cubic_used: bool
    residual_px: NDArray[np.float64]
    residual_affine_px: NDArray[np.float64]
    pitch_sigma_px: NDArray[np.float64]
    origin_sigma_px: NDArray[np.float64]
    rotation_sigma_rad: float

    @property
    def lenses(self) -> int:
        """Number of lens images found."""
        return len(self.indices)

    @property
    def coefficients_px(self) -> NDArray[np.float64]:
        """Coefficients (10, 2) of the chosen model, in the order of `EXPONENTS`."""
        if self.cubic_used:
            return self.cubic_px
        plain = np.zeros((len(EXPONENTS), 2))
        plain[0], plain[1:3] = self.lattice_px.origin, self.lattice_px.basis
        return plain

    def centres(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Return the modelled centres of lens images, (column, row), indices of shape (..., 2)."""
        return polynomial_terms(indices) @ self.coefficients_px

    def shifted(self, shift_px: NDArray[np.float64]) -> LatticeFit:
        """Return the lattice with all lens images moved by a shift (2,), (columns, rows)."""
        cubic = self.cubic_px.copy()
        cubic[0] += shift_px
        return replace(
            self,
            lattice_px=self.lattice_px.transformed(np.eye(2), shift_px),
            centres_px=self.centres_px + shift_px,
            cubic_px=cubic,
        )


def fit_lattice(
    white: ArrayLike, dark: ArrayLike | None = None, layout: Layout | None = None, saturation: float | None = None
) -> LatticeFit:
    """Find the lens images of a white image and fit a lattice and its cubic distortion.

    Parameters
    ----------
    white, dark : (rows, columns) photographs of uniform light and of none
    layout : of the microlens array, to be checked; default: what the image shows
    saturation : level at which the camera saturates; default: that of its bits

    Raises
    ------
    InputError
        when the image is too dark, saturated or shows no lattice
    """
    image = checked_white(white, dark, saturation)
    fit = _lattice_of(image, layout)
    falloff = _falloff(image, fit.lattice_px)
    return fit if falloff is None else _lattice_of(image / falloff, layout)


def _lattice_of(image: NDArray[np.float64], layout: Layout | None) -> LatticeFit:
    """Return the lattice through the centroids of the lens images of a white image less the dark one."""
    basis, seen = lattice_vectors(image)
    if layout is not None and seen != layout:
        raise InputError(
            f"the white image shows a {seen} array, and microlenses.layout is {layout}; correct it, or is it not white?"
        )
    points = find_spots(image, float(np.mean(np.hypot(basis[:, 0], basis[:, 1]))))
    centre = (np.array(image.shape[::-1]) - 1.0) / 2.0
    indices, points = indexed_from_centre(points, basis, centre)
    indices, points = without_strays(indices, points, float(np.hypot(*basis[0])))
    return lattice_through(indices, points, centre, seen)


def _falloff(image: NDArray[np.float64], lattice_px: Lattice) -> NDArray[np.float32] | None:
    """Return the share (rows, columns) of light that passes, smooth over the lenses; None where that moves no centroid.

    Light that falls towards the corners pulls the centroids of lens images to the middle, in proportion to the image
    height: as another pitch would.
    """
    white = image.astype(np.float32)
    if lens_image_width(white, lattice_px) < NARROWEST_LENS_IMAGE:
        return None
    coefficients = fit_vignetting(relative_transmission(white, lattice_px), lattice_px)
    if coefficients is None:
        return None
    passed = vignetting_surface(coefficients, image.shape)
    return passed if np.ptp(passed) > EVEN_LIGHT else None


def indexed_from_centre(
    points: NDArray[np.float64], basis: NDArray[np.float64], centre: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return lattice indices and positions of the spots that a walk from the middle of the image reaches."""
    best = np.zeros(len(points), dtype=bool)
    best_indices = np.zeros((len(points), 2), dtype=np.int64)
    for start in np.argsort(np.hypot(*(points - centre).T), kind="stable")[:STARTS]:
        indices, reached = index_spots(points, int(start), basis)
        if reached.sum() > best.sum():
            best, best_indices = reached, indices
        if best.sum() >= REACHED_SHARE * len(points):
            break
    if best.sum() < FEWEST_LENSES:
        raise InputError(
            f"only {int(best.sum())} lens images of the white image form a lattice, at least {FEWEST_LENSES} are "
            "needed; check microlenses.layout, the exposure, and that it is a white image"
        )
    return best_indices[best], points[best]


def polynomial_terms(indices: ArrayLike, count: int = len(EXPONENTS)) -> NDArray[np.float64]:
    """Return the first `count` monomials of the indices, shape (..., count)."""
    index = np.asarray(indices, dtype=np.float64)
    return np.stack([index[..., 0] ** a * index[..., 1] ** b for a, b in EXPONENTS[:count]], axis=-1)


def robust_fit(
    terms: NDArray[np.float64], points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def without_strays(
    indices: NDArray[np.int64], points: NDArray[np.float64], pitch_px: float
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Drop the spots that lie more than a quarter of the pitch off the cubic: dirt between the lenses."""
    terms = polynomial_terms(indices)
    coefficients, _ = robust_fit(terms, points)
    kept = np.hypot(*(points - terms @ coefficients).T) < 0.25 * pitch_px
    return indices[kept], points[kept]


def lattice_through(
    indices: NDArray[np.int64], points: NDArray[np.float64], centre: NDArray[np.float64], layout: Layout
) -> LatticeFit:
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
    pitch_sigma, rotation_sigma = affine_errors(affine[1:3], spread[1:3])
    origin_sigma = coefficient_sigmas(terms, residual, weights, points)[0] if cubic_used else spread[0]
    return LatticeFit(
        lattice_px=Lattice(affine[0], affine[1:3], layout),
        indices=indices,
        centres_px=points,
        cubic_px=cubic,
        cubic_used=cubic_used,
        residual_px=weighted_rms(cubic_residual, cubic_weights),
        residual_affine_px=weighted_rms(affine_residual, affine_weights),
        pitch_sigma_px=pitch_sigma,
        origin_sigma_px=origin_sigma,
        rotation_sigma_rad=rotation_sigma,
    )


def weighted_rms(residual: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rms (2,) of the residuals whose weight is not zero: dirt on a lens is not the fit's error."""
    return np.sqrt(np.mean(residual[weights > 0.0] ** 2, axis=0))


def cubic_is_significant(terms: NDArray[np.float64], points: NDArray[np.float64], weights: NDArray[np.float64]) -> bool:
    """Tell by an F-test whether the seven further coefficients per axis do enough, and more than chance.

    What a centroid's place within its pixel explains is the pixels' own error: behind a telecentric lens, where lens
    images may be whole pixels apart, it changes so slowly over the image that a cubic follows it.
    """
    kept = weights > 0.0
    scale = np.abs(terms).max(axis=0)
    phase = 2.0 * np.pi * points
    beat = np.concatenate([np.sin(phase), np.cos(phase)], axis=1)
    squares = []
    for count in (3, terms.shape[1]):
        design = np.concatenate([(terms / scale)[:, :count], beat], axis=1)[kept]
        residual = points[kept] - design @ np.linalg.lstsq(design, points[kept], rcond=None)[0]
        squares.append(float(np.sum(residual**2)))
    more = 2 * (terms.shape[1] - 3)
    rest = 2 * (int(kept.sum()) - terms.shape[1] - beat.shape[1])
    explained = (squares[0] - squares[1]) / (2 * int(kept.sum()))
    if squares[1] >= (1.0 - CUBIC_GAIN) * squares[0] or explained < CUBIC_LEAST_PX**2:
        return False
    if squares[1] == 0.0:
        return True
    ratio = (squares[0] - squares[1]) / more / (squares[1] / rest)
    # The chance of so large a ratio; scipy.stats has it, too, and takes a second to import.
    return bool(fdtrc(more, rest, ratio) < CUBIC_CHANCE)


def coefficient_sigmas(
    terms: NDArray[np.float64], residual: NDArray[np.float64], weights: NDArray[np.float64], places: NDArray[np.float64]
) -> NDArray[np.float64]:
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


def affine_errors(basis: NDArray[np.float64], sigma: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Return the standard errors of the pitch (2,) px and the rotation (rad) from those of the basis (2, 2)."""
    length2 = np.sum(basis**2, axis=1)
    along = np.sqrt(np.sum((basis * sigma) ** 2, axis=1) / length2)
    across2 = np.sum((basis[:, ::-1] * sigma) ** 2, axis=1) / length2
    return along, float(np.sqrt(np.sum(across2 / length2)) / 2.0)
