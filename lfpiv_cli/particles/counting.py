"""How many tracers there are for each microlens, told by how unevenly they light the microlenses, without finding them.

Tracers lie at random: the light of a microlens is the sum over those that light it, and the fewer they are, the more it
differs from one microlens to the next. mean^2 / variance goes with their number (Campbell's theorem), by a factor that
depends on how many microlenses share a tracer's light. It is taken from an image of tracers of known number, at random
places in the same volume. Crowded tracers, of which single ones cannot be told any more, are counted as well as few.

Axes: raw images [row, column].
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.special import ndtri

from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.noise import read_noise
from lfpiv_cli.particles.search import Task
from lfpiv_cli.particles.view import View
from lfpiv_cli.reconstruction.haze import Lenses

# Tracers for each microlens in the image that others are held against, and by how much their light differs: that of 0.6
# to 1.4 of its mean. The light of real tracers often differs more, and they are then taken for fewer.
KNOWN_NUMBER, LIGHT_SPREAD = 1.0, 0.23
# Seeding and illumination change over an image: microlenses are compared with those in a field of so many along each
# side around them. A tracer lights some five of them side by side at the ends of usual volumes.
FIELD_LENSES = 24
# A microlens counts that has this share of a whole one's pixels, and of them before the volume.
LEAST_PIXELS = 0.9
# So many microlenses tell the variance to a third; of the known tracers as many images are made as show so many.
FEWEST_LENSES, LENSES_OF_KNOWN = 50, 4000
# Darker pixels than this percentile lie between lens images, and show what is left of a background: by so many
# standard deviations of the read noise too little, which beside a faint tracer would be light that all share.
BACKGROUND_PERCENTILE = 1.0
BELOW_SIGMAS = float(-ndtri(0.01 * BACKGROUND_PERCENTILE))


class Seeded(NamedTuple):
    """Where tracers are and what sees them.

    Attributes
    ----------
    around, volume : grids: as far as light from beside the volume reaches, and the volume
    depths_mm : between which tracers may lie
    """

    view: View
    camera: Camera
    around: Grid
    volume: Grid
    depths_mm: tuple[float, float]


def tracers_per_lens(task: Task, lattice_px: Lattice) -> float | None:
    """Return the tracers for each microlens of the volume in the scene; None where too little of it is seen to tell.

    Parameters
    ----------
    lattice_px : of the lens images, (column, row) in the raw image
    """
    shape = task.prepared.shape
    weights = task.weights
    seeded = Seeded(task.view, task.camera, weights.padded.grid, weights.grid, task.depths_mm)
    return tracers_in_image(seeded, task.light.reshape(shape), task.usable.reshape(shape), lattice_px)


def tracers_in_image(
    seeded: Seeded, picture: NDArray[np.float64], usable_pixels: NDArray[np.bool_], lattice_px: Lattice
) -> float | None:
    """Return what `tracers_per_lens` does of a picture (rows, columns), of which pixels are usable."""
    lenses = Lenses.of(lattice_px, (picture.shape[0], picture.shape[1]))
    counts, usable = picture.ravel(), usable_pixels.ravel()
    # Pixels before the volume, as the focal plane is seen.
    camera, lateral, volume = seeded.camera, seeded.around, seeded.volume
    corners = camera.to_image_axes(np.array([volume.bounds_mm(axis) for axis in range(2)]).T)
    ends = camera.mm_to_px(camera.magnification * corners)
    (left, top), (right, bottom) = ends.min(axis=0), ends.max(axis=0)
    row, column = np.indices(picture.shape)
    before = ((column >= left) & (column <= right) & (row >= top) & (row <= bottom)).ravel()
    whole = lenses.sums(np.ones(counts.size))
    counted = lenses.sums(usable) > LEAST_PIXELS * np.median(whole)
    counted &= lenses.sums(before) > LEAST_PIXELS * whole
    seen = int(np.count_nonzero(counted))
    if seen < FEWEST_LENSES:
        return None
    dark = counts[usable]
    background = np.percentile(dark, BACKGROUND_PERCENTILE) + BELOW_SIGMAS * read_noise(dark)
    found = _unevenness(lenses.sums(np.where(usable, counts - background, 0.0)), counted)

    # As real ones, the known tracers are around the volume, too, as far as their light reaches it.
    low, high = np.array([lateral.bounds_mm(0), lateral.bounds_mm(1), volume.bounds_mm(2)]).T
    area_mm2 = camera.lattice.cell_area / camera.magnification**2
    number = round(KNOWN_NUMBER * float(np.prod((high - low)[:2])) / area_mm2)
    rng, known = np.random.default_rng(0), []
    for _ in range(-(-LENSES_OF_KNOWN // seen)):
        image = np.zeros(counts.size)
        places = camera.to_image_axes(rng.uniform(low, high, (number, 3)))
        tracers = np.column_stack([places, rng.normal(1.0, LIGHT_SPREAD, number).clip(0.0)])
        add_all(seeded.view, tracers, 1.0, image, seeded.depths_mm)
        known.append(_unevenness(lenses.sums(np.where(usable, image, 0.0)), counted))
    return KNOWN_NUMBER * float(np.mean(known)) / found if found > 0.0 else None


def _unevenness(light: NDArray[np.float64], counted: NDArray[np.bool_]) -> float:
    """Return variance / mean^2 of the light of microlenses, each compared with those near it; 0 without light."""
    share = ndimage.uniform_filter(counted.astype(np.float64), FIELD_LENSES, mode="constant")
    total = ndimage.uniform_filter(np.where(counted, light, 0.0), FIELD_LENSES, mode="constant")
    some = share > 0.5 / FIELD_LENSES**2
    near = np.divide(total, share, out=np.zeros_like(total), where=some)[counted]
    return float(np.mean((light[counted] - near) ** 2) / np.mean(near**2)) if np.any(near > 0.0) else 0.0
