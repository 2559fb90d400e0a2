"""Figures of the particles found behind one image.

Axes: points (n, 3) in mm; images [row, column]; covariances (n, 6) as xx, yy, zz, xy, yz, xz.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.pictures.depths import DEPTH_LABEL, draw_medians, percentiles_by_depth, slab_edges
from lfpiv_cli.pictures.style import (
    AXIS_NAMES,
    BLUE,
    DIVERGING,
    SEQUENTIAL,
    VERMILION,
    new_figure,
    styled,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of an image's values: the scale ends where so many (%) lie within, single hot pixels beyond it.
IMAGE_PERCENT = 99.5
# chi2 beyond this is drawn in the last bar.
LARGEST_CHI2 = 5.0
CHI2_BARS = 50
# The area of all dots on an image, and the smallest and largest of one, in square points: many must not hide it.
DOTS_AREA, DOT_SIZES = 15_000.0, (6.0, 26.0)
# Width of pictures with an image, in inches.
IMAGE_WIDTH = 10.0


def places_px(focal_point_mm: NDArray[np.float64], camera: Camera, media: Media) -> NDArray[np.float64]:
    """Return where rays through the middle of the main lens meet the sensor, (n, 2) as (column, row).

    Parameters
    ----------
    focal_point_mm : (n, 3) points, z from the nominal focal point; their rays are taken for paraxial
    """
    points = camera.to_image_axes(focal_point_mm)
    distance = equivalent_object_distance(points[:, 2], camera.focus_distance_mm, media)
    on_array = -camera.image_distance_mm / distance[:, np.newaxis] * points[:, :2]
    return camera.mm_to_px(on_array * camera.micro_image_scale)


@styled
def places_figure(position_mm: NDArray[np.float64], light_counts: NDArray[np.float64]) -> Figure:
    """Return the particles from the front and from the side, coloured by their light (logarithmic)."""
    from matplotlib.colors import LogNorm

    figure = new_figure(IMAGE_WIDTH, 4.6)
    lit = light_counts > 0.0
    norm = LogNorm(*np.percentile(light_counts[lit], (2.0, 98.0))) if lit.sum() > 1 else None
    panels = figure.subplots(1, 2)
    for axes, up in zip(panels, (1, 2), strict=True):
        dots = axes.scatter(
            position_mm[lit, 0],
            position_mm[lit, up],
            c=light_counts[lit],
            s=6,
            cmap=SEQUENTIAL,
            norm=norm,
            linewidths=0,
        )
        axes.set(xlabel="x (mm)", ylabel=f"{AXIS_NAMES[up]} (mm)", aspect="equal")
    figure.colorbar(dots, ax=panels.tolist(), label="light of a particle (counts)")
    figure.suptitle(f"{len(position_mm)} particles, from the front and from the side")
    return figure


@styled
def image_figure(image: NDArray[np.float64], places: NDArray[np.float64], z_mm: NDArray[np.float64]) -> Figure:
    """Return a raw image in grey with the particles' places (n, 2) as (column, row), coloured by their depth."""
    figure = _image_canvas(image)
    (axes,) = figure.axes
    axes.imshow(image, cmap="gray", vmin=0.0, vmax=_bright(image), interpolation="nearest")
    size = float(np.clip(DOTS_AREA / max(len(z_mm), 1), *DOT_SIZES))
    dots = axes.scatter(places[:, 0], places[:, 1], c=z_mm, s=size, cmap=SEQUENTIAL, edgecolors="white", linewidths=0.5)
    rows, columns = image.shape
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    figure.colorbar(dots, ax=axes, label="depth z (mm)", shrink=0.7)
    axes.set_title(f"image and the places of {len(z_mm)} particles (rays through the middle of the lens)")
    return figure


@styled
def residual_figure(residual: NDArray[np.float64]) -> Figure:
    """Return what the particles leave of an image: light that none explains, red, and too much light, blue."""
    figure = _image_canvas(residual)
    (axes,) = figure.axes
    limit = _bright(residual)
    shown = axes.imshow(residual, cmap=DIVERGING, vmin=-limit, vmax=limit, interpolation="nearest")
    figure.colorbar(shown, ax=axes, label="image less particles (counts)", shrink=0.7)
    axes.set_title(f"residual, rms {written(np.sqrt(np.mean(residual**2)))} counts")
    return figure


def _image_canvas(image: NDArray[np.float64]) -> Figure:
    """Return a figure of an image's shape, with axes that are its pixels."""
    rows, columns = image.shape
    figure = new_figure(IMAGE_WIDTH, min(max(0.8 * IMAGE_WIDTH * rows / columns + 0.8, 3.0), 12.0))
    figure.subplots().set(xlabel="column (px)", ylabel="row (px)")
    return figure


def _bright(image: NDArray[np.float64]) -> float:
    """Return where the scale of an image ends."""
    limit = float(np.percentile(np.abs(image), IMAGE_PERCENT))
    return limit if limit > 0.0 else 1.0


@styled
def depths_figure(
    z_mm: NDArray[np.float64], light_counts: NDArray[np.float64], covariance_mm2: NDArray[np.float64]
) -> Figure:
    """Return by depth: how many particles, their light (median and quartiles), and their standard deviations."""
    figure = new_figure(11.0, 3.6)
    counts, light, sigmas = figure.subplots(1, 3)
    counts.hist(z_mm, bins=slab_edges(z_mm), color=BLUE)
    counts.set(xlabel=DEPTH_LABEL, ylabel="particles")
    draw_medians(light, z_mm, {"light": light_counts}, "light of a particle (counts), median")
    places, low = percentiles_by_depth(z_mm, light_counts, 25.0)
    light.fill_between(
        places, low, percentiles_by_depth(z_mm, light_counts, 75.0)[1], color=BLUE, alpha=0.25, label="quartiles"
    )
    light.legend()
    along = {f"along {name}": np.sqrt(covariance_mm2[:, k]) for k, name in enumerate(AXIS_NAMES)}
    draw_medians(sigmas, z_mm, along, "standard deviation (mm), median")
    return figure


@styled
def chi2_figure(chi2: NDArray[np.float64]) -> Figure:
    """Return chi2, about 1 where particles explain all light; what is beyond the axis is in the last bar."""
    figure = new_figure(6.0, 3.6)
    axes = figure.subplots()
    axes.hist(np.minimum(chi2, LARGEST_CHI2), bins=CHI2_BARS, range=(0.0, LARGEST_CHI2), color=BLUE)
    axes.axvline(1.0, color=VERMILION, linestyle="--", label="all light explained")
    beyond = int(np.count_nonzero(chi2 > LARGEST_CHI2))
    axes.set(xlabel="chi2", ylabel="particles", title=f"median {np.median(chi2):.2f}, {beyond} beyond {LARGEST_CHI2:g}")
    axes.legend()
    return figure
