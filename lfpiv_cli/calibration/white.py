"""White images: where their bright spots are, how much light pixels pass, and whether they can serve.

Axes: positions are (column, row) in pixels, pixel centres at integers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy import ndimage
from scipy.spatial import cKDTree

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.errors import InputError
from lfpiv_cli.kernels import njit
from lfpiv_cli.neighbourhoods import largest_around, smallest_around
from lfpiv_cli.optics.camera import Lattice

# Smoothing by a sixth of the pitch leaves one maximum per lens image and does not merge neighbours.
SMOOTHING_PER_PITCH = 1.0 / 6.0
# Two maxima closer than this share of the pitch belong to one spot.
SEPARATION_PER_PITCH = 0.6
# A spot must stand out of its surroundings by this share of the typical spot: vignetted lens images count, noise not.
CONTRAST_SHARE = 0.15
# Between these shares of a spot's height above its surroundings a pixel's weight rises from 0 to 1: below lies the
# noise of the gaps, above it speckle, dust and saturation, which say nothing about where the spot's rim is.
CLIP_LOW = 0.25
CLIP_HIGH = 0.75
# Clipping an image as sharp as its pixels makes centroids beat with the pixels by 0.05 px; this smoothing halves
# it, and does not yet mix neighbouring lens images.
CENTROID_SMOOTHING_PX = 0.8
# The window follows the centroid. Each round at least halves the rest, so this reaches 1e-4 px from half a pixel.
CENTROID_ROUNDS = 30
CENTROID_TOLERANCE_PX = 1e-4
# A neighbour is taken when it lies within this share of the pitch from where the last steps predict it.
WALK_TOLERANCE = 0.25
# Share of a new step in the running prediction of the next one: follows distortion, damps the noise of one spot.
WALK_GAIN = 0.25


def find_spots(image: Floats, pitch_px: float) -> Floats:
    """Return the centres (n, 2) of the bright spots that lie wholly inside the image, in no particular order."""
    smooth = ndimage.gaussian_filter(image, SMOOTHING_PER_PITCH * pitch_px, mode="nearest")
    size = max(3, int(np.rint(SEPARATION_PER_PITCH * pitch_px)))
    row, column = np.nonzero(smooth == largest_around(smooth, size))
    base = smallest_around(smooth, int(np.ceil(pitch_px)))[row, column]
    height = smooth[row, column] - base
    if not (height > 0.0).any():
        return np.zeros((0, 2))
    strong = height > CONTRAST_SHARE * np.percentile(height[height > 0.0], 90.0)
    start = np.stack([column, row], axis=1)[strong].astype(np.float64)
    softened = ndimage.gaussian_filter(image, CENTROID_SMOOTHING_PX, mode="nearest")
    centres, good = spot_centroids(softened, start, base[strong], height[strong], 0.5 * pitch_px)
    return centres[good]


@njit(cache=True)
def spot_centroids(
    image: Floats, start: Floats, base: Floats, height: Floats, radius_px: float
) -> tuple[Floats, Flags]:
    """Return clipped centroids (n, 2) in a disc that follows them, and whether each converged inside the image."""
    rows, columns = image.shape
    centres = start.copy()
    good = np.zeros(start.shape[0], dtype=np.bool_)
    for k in range(start.shape[0]):
        low = base[k] + CLIP_LOW * height[k]
        span = (CLIP_HIGH - CLIP_LOW) * height[k]
        x, y = start[k, 0], start[k, 1]
        for _ in range(CENTROID_ROUNDS):
            if x < radius_px - 0.5 or y < radius_px - 0.5:
                break
            if x > columns - 0.5 - radius_px or y > rows - 0.5 - radius_px:
                break
            total = 0.0
            sum_x = 0.0
            sum_y = 0.0
            for row in range(max(0, int(y - radius_px)), min(rows, int(y + radius_px) + 2)):
                for column in range(max(0, int(x - radius_px)), min(columns, int(x + radius_px) + 2)):
                    distance = np.sqrt((column - x) ** 2 + (row - y) ** 2)
                    window = min(1.0, max(0.0, radius_px + 0.5 - distance))
                    weight = window * min(1.0, max(0.0, (image[row, column] - low) / span))
                    total += weight
                    sum_x += weight * column
                    sum_y += weight * row
            if total == 0.0:
                break
            moved = abs(sum_x / total - x) + abs(sum_y / total - y)
            x, y = sum_x / total, sum_y / total
            if moved < CENTROID_TOLERANCE_PX:
                good[k] = True
                break
        centres[k, 0], centres[k, 1] = x, y
    return centres, good


def index_spots(points: Floats, start: int, basis: Floats) -> tuple[Integers, Flags]:
    """Number the points by walking outward over a lattice whose vectors may change slowly on the way.

    Parameters
    ----------
    points : (n, 2)
    start : which point is lattice point (0, 0)
    basis : (2, 2) lattice vectors there, as rows

    Returns
    -------
    indices : (n, 2) lattice indices, meaningless where not reached
    reached : (n,) the walk came to this point, and first to it among those of the same index
    """
    tree = cKDTree(points)
    tolerance = WALK_TOLERANCE * float(np.min(np.hypot(basis[:, 0], basis[:, 1])))
    indices = np.zeros((len(points), 2), dtype=np.int64)
    local = np.broadcast_to(basis, (len(points), 2, 2)).copy()
    reached = np.zeros(len(points), dtype=bool)
    reached[start] = True
    front = np.array([start])
    while front.size:
        arrived = []
        for axis in (0, 1):
            for sign in (1, -1):
                distance, neighbour = tree.query(points[front] + sign * local[front, axis])
                fresh = (distance < tolerance) & ~reached[neighbour]
                neighbour, first = np.unique(neighbour[fresh], return_index=True)
                origin = front[fresh][first]
                observed = sign * (points[neighbour] - points[origin])
                indices[neighbour] = indices[origin]
                indices[neighbour, axis] += sign
                local[neighbour] = local[origin]
                local[neighbour, axis] += WALK_GAIN * (observed - local[origin, axis])
                reached[neighbour] = True
                arrived.append(neighbour)
        front = np.concatenate(arrived)
    return indices, reached & first_of_each(indices, reached)


def first_of_each(indices: Integers, chosen: Flags) -> Flags:
    """Return the mask (n,) of the first chosen point of each index."""
    where = np.nonzero(chosen)[0]
    _, first = np.unique(indices[where], axis=0, return_index=True)
    mask = np.zeros(len(indices), dtype=bool)
    mask[where[first]] = True
    return mask


# What passes less than this of the centre's light says more about noise and stray light than about the scene.
TRANSMISSION_FLOOR = 0.05
# The reference is the light in the middle of the lens images, within this share of the pitch from their centres, over
# a square of this many pixels in the middle of the sensor: wide enough for two hundred lenses of 30 px.
MIDDLE_PER_PITCH = 0.25
MIDDLE_SIDE_PX = 512
# Vignetting is smooth over the sensor: a polynomial of degree four holds cos^4 and the shadow of a barrel. It is
# fitted to the medians of this many blocks along each side, which dust and dead pixels do not move; of fewer, where a
# block would be narrower than this many lenses: some would hold no middle of a lens image, and what they border on is
# extrapolated.
VIGNETTING_DEGREE = 4
VIGNETTING_BLOCKS = 24
LENSES_PER_BLOCK = 1.5
# In narrower lens images, shares of the pitch, the middles reach the dark around: a quarter of the pitch on either side
# and a pixel's blur.
NARROWEST_LENS_IMAGE = 0.6
# A block of fewer usable middles says nothing.
FEWEST_MIDDLES = 20


def relative_transmission(white: Singles, lattice_px: Lattice) -> Singles:
    """Return the share (rows, columns) of the centre's light that each pixel passes; 0 where it cannot be used.

    Parameters
    ----------
    white : (rows, columns) white minus dark, rectified, 0 outside the sensor
    lattice_px : lens images in the same frame
    """
    part, place, index = _middle_part(white, lattice_px)
    offset = place - lattice_px.points(index)
    middle = np.hypot(offset[..., 0], offset[..., 1]) <= MIDDLE_PER_PITCH * lattice_px.pitch.min()
    relative = white / np.float32(float(np.median(part[middle])))
    return np.where(relative >= TRANSMISSION_FLOOR, relative, np.float32(0.0))


def lens_image_width(white: Singles, lattice_px: Lattice) -> float:
    """Return how wide lens images are over their pitch, around the sensor's centre: the diameter of a disc as large.

    As large as what is at least half as bright as the brightest pixel of a lens image, in the middle one of them all.
    """
    part, place, index = _middle_part(white, lattice_px)
    lens = index - index.min(axis=(0, 1))
    brightest = np.full(lens.max(axis=(0, 1)) + 1, -np.inf)
    np.maximum.at(brightest, (lens[..., 0], lens[..., 1]), part)
    lit = float(np.mean(part > 0.5 * np.median(brightest[np.isfinite(brightest)])))
    area = lit * lattice_px.cell_area
    return float(np.sqrt(4.0 / np.pi * area) / lattice_px.pitch.mean())


def fit_vignetting(transmission: Singles, lattice_px: Lattice) -> Floats | None:
    """Return what of the transmission varies slowly over the lenses, as coefficients [y power, x power]; see below.

    Only the middles of the lens images are used: their rims show the aperture, which the weights hold already. None
    where there is too little to see it by.

    Parameters
    ----------
    transmission : (rows, columns) from `relative_transmission`
    lattice_px : lens images in the same frame
    """
    rows, columns = transmission.shape
    width = LENSES_PER_BLOCK * float(lattice_px.pitch.max())
    row_edges, column_edges = (
        np.linspace(0, side, max(1, min(VIGNETTING_BLOCKS, int(side / width))) + 1).astype(int)
        for side in (rows, columns)
    )
    places, levels = [], []
    for top, bottom in pairwise(row_edges):
        for left, right in pairwise(column_edges):
            row, column = np.mgrid[top:bottom, left:right]
            place = np.stack([column, row], axis=-1).astype(np.float64)
            offset = place - lattice_px.points(lattice_px.nearest(place))
            part = transmission[top:bottom, left:right]
            middle = np.hypot(offset[..., 0], offset[..., 1]) <= MIDDLE_PER_PITCH * lattice_px.pitch.min()
            used = middle & (part > 0.0)
            if used.sum() >= FEWEST_MIDDLES:
                places.append(place[used].mean(axis=0))
                levels.append(float(np.median(part[used])))
    powers = [(i, j) for i in range(VIGNETTING_DEGREE + 1) for j in range(VIGNETTING_DEGREE + 1 - i)]
    if len(levels) < 2 * len(powers):
        return None
    half = np.array([columns, rows]) / 2.0
    x, y = ((np.array(places) - half) / half).T
    design = np.stack([x**i * y**j for i, j in powers], axis=1)
    found = np.linalg.lstsq(design, np.array(levels), rcond=None)[0]
    coefficients = np.zeros((VIGNETTING_DEGREE + 1, VIGNETTING_DEGREE + 1))
    for (i, j), coefficient in zip(powers, found, strict=True):
        coefficients[j, i] = coefficient / found[0]
    return coefficients


def vignetting_surface(coefficients: Floats, shape: tuple[int, int]) -> Singles:
    """Return the share (rows, columns) of the middle's light that passes: a polynomial in the place over the sensor.

    x and y run from -1 to 1 over the columns and the rows.
    """
    y, x = ((np.arange(n) - n / 2.0) / (n / 2.0) for n in shape)
    rows, columns = coefficients.shape
    surface = np.vander(y, rows, increasing=True) @ coefficients @ np.vander(x, columns, increasing=True).T
    return np.clip(surface, TRANSMISSION_FLOOR, 1.0 / TRANSMISSION_FLOOR).astype(np.float32)


def _middle_part(white: Singles, lattice_px: Lattice) -> tuple[Singles, Floats, Integers]:
    """Return the square around the sensor's centre, its pixels' places (..., 2) as (column, row), and their lenses."""
    rows, columns = white.shape
    top, left = max(0, (rows - MIDDLE_SIDE_PX) // 2), max(0, (columns - MIDDLE_SIDE_PX) // 2)
    part = white[top : top + MIDDLE_SIDE_PX, left : left + MIDDLE_SIDE_PX]
    row, column = np.indices(part.shape)
    place = np.stack([column + left, row + top], axis=-1).astype(np.float64)
    return part, place, lattice_px.nearest(place)


# More saturated pixels than this and the lens images have lost their brightness, which the transmission needs.
SATURATED_SHARE = 0.05
# The difference of two dark frames reaches 3.3 times the noise of one in its brightest hundredth; light reaches more.
DARK_SIGMAS = 5.0
# Cameras of these depths store their counts as they are or shifted to the top of 16 bits.
CAMERA_BITS = (8, 10, 12, 14, 16)
# Brightness of a full lens image: above it lie hot pixels, half of it is the rim.
FULL_PERCENTILE = 99.0


def checked_white(white: ArrayLike, dark: ArrayLike | None) -> Floats:
    """Return white minus dark, or say why it cannot be used."""
    raw = np.asarray(white)
    image = raw.astype(np.float64)
    if image.ndim != 2:
        raise InputError(f"the white image has {image.ndim} axes, expected one grey image of rows and columns")
    if not np.isfinite(image).all():
        raise InputError("the white image holds values that are not numbers; export it again without them")
    # The brightest value if some camera's counts end there; else the largest one that the integer type holds.
    saturation = float(raw.max())
    ends = {2**bits - 1 for bits in CAMERA_BITS} | {(2**bits - 1) << (16 - bits) for bits in CAMERA_BITS}
    if raw.dtype.kind in "iu" and saturation not in ends:
        saturation = float(np.iinfo(raw.dtype).max)
    clipped = float(np.mean(image >= saturation))
    if image.max() > image.min() and clipped > SATURATED_SHARE:
        raise InputError(
            f"{100 * clipped:.0f} % of the white image is saturated (at {saturation:g}), at most "
            f"{100 * SATURATED_SHARE:.0f} % may be; take it with less light or a shorter exposure"
        )
    if dark is not None:
        darkness = np.asarray(dark, dtype=np.float64)
        if darkness.shape != image.shape:
            raise InputError(f"the dark frame is {darkness.shape} and the white image {image.shape} (rows, columns)")
        image = image - darkness
        if np.percentile(image, 99.0) <= DARK_SIGMAS * float(darkness.std()):
            raise InputError(
                "the white image is no brighter than the dark frame; take it with more light or a longer exposure"
            )
    if image.max() <= image.min():
        raise InputError(f"the white image has one value everywhere ({raw.flat[0]}); it shows no lens images")
    return image


def by_aperture(whites: Sequence[ArrayLike], dark: ArrayLike | None = None) -> list[int]:
    """Return the order of white images from the smallest aperture, best for centres, to the widest, for vignetting.

    That is by the share of the pixels that are at least half as bright as a full lens image.
    """
    shares = []
    for white in whites:
        image = np.asarray(white, dtype=np.float64) - (0.0 if dark is None else np.asarray(dark, dtype=np.float64))
        low, high = np.percentile(image, [1.0, FULL_PERCENTILE])
        shares.append(float(np.mean(image > 0.5 * (low + high))))
    return list(np.argsort(shares, kind="stable"))
