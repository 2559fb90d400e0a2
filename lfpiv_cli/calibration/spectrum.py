"""The pitch and direction of a lens lattice, from the spectrum of a white image: a guess that needs no data sheet.

Axes: vectors are (column, row); frequencies in cycles per pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lfpiv_cli.errors import InputError
from lfpiv_cli.names import Layout
from lfpiv_cli.neighbourhoods import largest_around

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


def lattice_vectors(image: NDArray[np.float64]) -> tuple[NDArray[np.float64], Layout]:
    """Return two basis vectors (2, 2) of the lattice of bright spots, the first nearest the columns, and its layout.

    The slowest line that has a partner tells the layout by where this stands: at 90 degrees on squares, at 60 on
    hexagons, which have no line as slow at 90.

    Parameters
    ----------
    image : (rows, columns) white image

    Raises
    ------
    InputError
        when the spectrum holds no such lattice with a pitch of 6 to 90 px
    """
    power, step = centre_spectrum(image)
    for first in spectral_lines(power, step):
        turns: dict[Layout, float] = {"square": np.pi / 2.0, "hexagonal": np.pi / 3.0}
        partner = {layout: line_power(power, step, rotated(first, turn)) for layout, turn in turns.items()}
        layout: Layout = "square" if partner["square"] >= partner["hexagonal"] else "hexagonal"
        if partner[layout] >= PARTNER_SHARE * line_power(power, step, first):
            second = rotated(first, turns[layout])
            return column_first(first_basis(power, step, first, second, layout), layout), layout
    raise InputError(
        f"no lattice of lens images with a pitch of {SMALLEST_PITCH_PX:g} to {LARGEST_PITCH_PX:g} px is visible in the "
        "white image; check the exposure, and that it is a white image"
    )


def centre_spectrum(image: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the power spectrum of the image's middle and its frequency step along (columns, rows).

    The power is indexed [row frequency, column frequency >= 0]; slow illumination is taken off first.
    """
    rows, columns = image.shape
    top, left = max(0, (rows - SIDE_PX) // 2), max(0, (columns - SIDE_PX) // 2)
    part = image[top : top + SIDE_PX, left : left + SIDE_PX]
    slow = ndimage.gaussian_filter(part, LARGEST_PITCH_PX / 3, mode="reflect")
    window = np.outer(np.hanning(part.shape[0]), np.hanning(part.shape[1]))
    size = [fft.next_fast_len(2 * n) for n in part.shape]
    power = np.abs(fft.rfft2((part - slow) * window, s=size)) ** 2
    return power, np.array([1.0 / size[1], 1.0 / size[0]])


def spectral_lines(power: NDArray[np.float64], step: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the strong local maxima of the spectrum as frequencies (column, row), the slowest first."""
    frequency = np.hypot(*np.meshgrid(step[0] * np.arange(power.shape[1]), fft.fftfreq(power.shape[0])))
    in_range = (frequency >= 1.0 / LARGEST_PITCH_PX) & (frequency <= 1.0 / (SMALLEST_PITCH_PX * np.sqrt(0.75)))
    masked = np.where(in_range, power, 0.0)
    floor = max(RELEVANT_SHARE * masked.max(), LINE_ABOVE_MEDIAN * np.median(power[in_range]))
    around = largest_around(np.pad(masked, BIN_TOLERANCE, mode="wrap"), 2 * BIN_TOLERANCE + 1)
    strongest = around[BIN_TOLERANCE:-BIN_TOLERANCE, BIN_TOLERANCE:-BIN_TOLERANCE]
    row, column = np.nonzero((masked == strongest) & (masked > floor))
    lines = np.stack([step[0] * column, fft.fftfreq(power.shape[0])[row]], axis=1)
    return list(lines[np.argsort(np.hypot(lines[:, 0], lines[:, 1]), kind="stable")])


def rotated(vector: NDArray[np.float64], angle_rad: float) -> NDArray[np.float64]:
    """Return the vector turned from the columns towards the rows."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([cosine * vector[0] - sine * vector[1], sine * vector[0] + cosine * vector[1]])


def bins_around(
    power: NDArray[np.float64], step: NDArray[np.float64], line: NDArray[np.float64], reach: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Return the power near a frequency and its column and row bin numbers; the half-plane is mirrored where needed."""
    column, row = np.rint(line / step).astype(np.int64)
    columns = np.arange(column - reach, column + reach + 1)[np.newaxis, :]
    rows = np.arange(row - reach, row + reach + 1)[:, np.newaxis]
    mirror = np.where(columns < 0, -1, 1)
    return power[(rows * mirror) % power.shape[0], np.abs(columns)], columns, rows


def line_power(power: NDArray[np.float64], step: NDArray[np.float64], line: NDArray[np.float64]) -> float:
    """Return the strongest power within the tolerance around a frequency."""
    return float(bins_around(power, step, line, BIN_TOLERANCE)[0].max())


def refined_line(
    power: NDArray[np.float64], step: NDArray[np.float64], line: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the frequency of a line to a fraction of a bin: the centroid of its power about the strongest bin."""
    near, columns, rows = bins_around(power, step, line, BIN_TOLERANCE)
    peak_row, peak_column = np.unravel_index(np.argmax(near), near.shape)
    peak = np.array([columns[0, peak_column], rows[peak_row, 0]]) * step
    near, columns, rows = bins_around(power, step, peak, REFINE_BINS)
    total = near.sum()
    return np.array([(near * columns).sum() / total, (near * rows).sum() / total]) * step


def first_basis(
    power: NDArray[np.float64],
    step: NDArray[np.float64],
    first: NDArray[np.float64],
    second: NDArray[np.float64],
    layout: Layout,
) -> NDArray[np.float64]:
    """Return lattice vectors from two neighbouring lines: the rows of the inverse transpose of the frequencies.

    On hexagons the frequencies stand at 60 degrees and the vectors at 120; the sum of these stands at 60 to the first.
    """
    frequencies = np.stack([refined_line(power, step, first), refined_line(power, step, second)])
    basis = np.asarray(np.linalg.inv(frequencies).T, dtype=np.float64)
    if layout == "hexagonal":
        basis[1] += basis[0]
    return basis


def column_first(basis: NDArray[np.float64], layout: Layout) -> NDArray[np.float64]:
    """Return the same lattice with the first vector nearest the columns, the second turned from it towards the rows."""
    if layout == "square":
        around = np.array([basis[0], basis[1], -basis[0], -basis[1]])
    else:
        around = np.array([basis[0], basis[1], basis[1] - basis[0], -basis[0], -basis[1], basis[0] - basis[1]])
    angle = np.arctan2(around[:, 1], around[:, 0])
    first = int(np.argmin(np.abs(angle)))
    return np.stack([around[first], around[(first + 1) % len(around)]])
