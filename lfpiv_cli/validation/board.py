"""Reconstructed boards: how long the dots are in depth and where they lie (the paper's Section 3.3, Eqs. 17 to 20).

Axes: volumes [z, y, x] on a grid in mm. The dots' places in the plane tell which voxels belong to which dot; everything
else is measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from lfpiv_cli.errors import InputError
from lfpiv_cli.grid import Grid

# The paper's boards: seventeen depths, a millimetre apart.
DEPTHS_MM = tuple(float(z) for z in range(-8, 9))
# What Table 3 has of its simulated boards and of those of its experiment, by method. Eqs. 17 to 20.
MEASURES = ("elongation_mm", "elongation_sigma_mm", "lateral_error", "depth_error")
PAPER = {
    ("ideal", "ert"): dict(zip(MEASURES, (3.54, 0.08, 0.0009, 0.0263), strict=True)),
    ("ideal", "dlfc"): dict(zip(MEASURES, (3.59, 0.07, 0.0003, 0.0260), strict=True)),
    ("recorded", "ert"): dict(zip(MEASURES, (3.65, 0.27, 0.0063, 0.0560), strict=True)),
    ("recorded", "dlfc"): dict(zip(MEASURES, (3.61, 0.25, 0.0011, 0.0495), strict=True)),
}


@dataclass(frozen=True, eq=False)
class DotFigures:
    """What was measured of the dots of one board, an entry for each dot, mm.

    Attributes
    ----------
    elongation_mm : depth over which the in-plane maximum exceeds 1/e of its peak, interpolated
    depth_mm : centre of a Gaussian through the depth profile of the in-plane sum
    mass_depth_mm : centre of mass of that profile where it exceeds 1/e of its peak
    lateral_mm : (n, 2) centre of mass in the plane
    """

    elongation_mm: NDArray[np.float64]
    depth_mm: NDArray[np.float64]
    mass_depth_mm: NDArray[np.float64]
    lateral_mm: NDArray[np.float64]


def measure_dots(
    volume: NDArray[np.float32], grid: Grid, centres_mm: NDArray[np.float64], reach_mm: float
) -> DotFigures:
    """Measure each dot in the column of voxels within `reach_mm` of its centre (n, 2) in x and y.

    Raises
    ------
    InputError : a dot's column lies outside the volume or holds no light.
    """
    rows = [_measure_dot(volume, grid, centre, reach_mm) for centre in centres_mm]
    values = np.array(rows)
    return DotFigures(values[:, 0], values[:, 1], values[:, 2], values[:, 3:])


def _measure_dot(
    volume: NDArray[np.float32], grid: Grid, centre: NDArray[np.float64], reach_mm: float
) -> tuple[float, float, float, float, float]:
    x, y, z = (grid.axis_mm(axis) for axis in range(3))
    column = np.ix_(np.arange(z.size), np.abs(y - centre[1]) < reach_mm, np.abs(x - centre[0]) < reach_mm)
    part = volume[column].astype(np.float64)
    if not part.size or part.max() <= 0.0:
        raise InputError(
            f"no light was reconstructed within {reach_mm} mm of the dot at {centre[0]:.3g}, {centre[1]:.3g}"
        )
    profile = part.sum(axis=(1, 2))
    plane = part[profile > profile.max() / np.e].sum(axis=0)
    own_x, own_y = x[np.abs(x - centre[0]) < reach_mm], y[np.abs(y - centre[1]) < reach_mm]
    lateral = plane.sum(axis=0) @ own_x / plane.sum(), plane.sum(axis=1) @ own_y / plane.sum()
    high = profile > profile.max() / np.e
    mass = float(profile[high] @ z[high] / profile[high].sum())
    return elongation_mm(z, part.max(axis=(1, 2))), gaussian_centre_mm(z, profile), mass, *lateral


def elongation_mm(z_mm: NDArray[np.float64], height: NDArray[np.float64], peak: int | None = None) -> float:
    """Return the depth over which a profile around a peak, by default its highest, exceeds 1/e of it.

    Between samples the profile is taken as linear.
    """
    peak = int(np.argmax(height)) if peak is None else peak
    limit = height[peak] / np.e
    ends = []
    for step in (-1, 1):
        at = peak
        while 0 <= at + step < z_mm.size and height[at + step] > limit:
            at += step
        beyond = at + step
        if 0 <= beyond < z_mm.size:
            share = (height[at] - limit) / (height[at] - height[beyond])
            ends.append(z_mm[at] + share * (z_mm[beyond] - z_mm[at]))
        else:
            ends.append(z_mm[at])
    return float(ends[1] - ends[0])


def gaussian_centre_mm(z_mm: NDArray[np.float64], profile: NDArray[np.float64]) -> float:
    """Return the centre of the least-squares Gaussian through a profile, its peak where no fit is found."""
    peak = int(np.argmax(profile))
    width = max(elongation_mm(z_mm, profile) / (2.0 * np.sqrt(2.0)), float(z_mm[1] - z_mm[0]))

    def gaussian(z: NDArray[np.float64], height: float, centre: float, sigma: float) -> NDArray[np.float64]:
        return height * np.exp(-0.5 * ((z - centre) / sigma) ** 2)

    try:
        fitted, _ = curve_fit(gaussian, z_mm, profile, p0=(profile[peak], z_mm[peak], width))
    except RuntimeError:
        return float(z_mm[peak])
    return float(fitted[1])


def board_figures(
    dots: list[DotFigures], depths_mm: tuple[float, ...], shape: tuple[int, int], spacing_mm: float
) -> dict[str, Any]:
    """Return Table 3's figures and the table by depth.

    Parameters
    ----------
    dots : of each board; the dots in rows along x, `shape` of them along x and y
    depths_mm : where the boards truly stood
    spacing_mm : x_g of Eq. 19

    Returns
    -------
    dict
        `elongation_mm` and `elongation_sigma_mm` (Eqs. 17, 18, averaged over the depths), `lateral_error` (Eq. 19) and
        `depth_error` (Eq. 20, averaged over the steps; `depth_error_mass` by centres of mass), and `by_depth`.
    """
    lateral = [each.lateral_mm[:, 0].reshape(shape[1], shape[0]) for each in dots]
    places = place_figures(lateral, [each.depth_mm for each in dots], depths_mm, spacing_mm)
    mass = np.array([each.mass_depth_mm.mean() for each in dots])
    steps = np.diff(depths_mm)
    return places | {
        "elongation_mm": float(np.mean([each.elongation_mm.mean() for each in dots])),
        "elongation_sigma_mm": float(np.mean([each.elongation_mm.std() for each in dots])),
        "depth_error_mass": float(np.mean(np.abs(np.diff(mass) - steps) / steps)),
        "by_depth": places["by_depth"]
        | {
            "elongation_mm": [float(each.elongation_mm.mean()) for each in dots],
            "elongation_sigma_mm": [float(each.elongation_mm.std()) for each in dots],
            "centre_mass_mm": mass.tolist(),
        },
    }


def place_figures(
    x_mm: Sequence[NDArray[np.float64]],
    depth_mm: Sequence[NDArray[np.float64]],
    depths_mm: tuple[float, ...],
    spacing_mm: float,
) -> dict[str, Any]:
    """Return the errors of place (Eqs. 19, 20) and the table by depth; dots that were not found are NaN.

    Parameters
    ----------
    x_mm : of each board, (dots along y, dots along x)
    depth_mm : of the dots of each board, any shape
    """
    spacing = [float(np.nanmean(np.diff(each, axis=1))) for each in x_mm]
    centre = [float(np.nanmean(each)) for each in depth_mm]
    steps = np.diff(depths_mm)
    return {
        "lateral_error": float(np.mean(np.abs(np.array(spacing) - spacing_mm)) / spacing_mm),
        "depth_error": float(np.mean(np.abs(np.diff(centre) - steps) / steps)),
        "by_depth": {"depth_mm": list(depths_mm), "spacing_mm": spacing, "centre_mm": centre},
    }
