"""How right the weights are, voxel by voxel: methods against each other, and the factorised form against integrals.

Columns are compared as images on the sensor: by L1 (a column sums to 1), by SSIM (Eq. 16) and by the root mean square
difference in grey levels, the brightest pixel of the reference being 255, over the pixels that either one lights.

Axes: voxels in world axes (x, y, z), z away from the camera from the nominal focal point; images [row, column].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lfpiv_cli.arrays import Floats
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.pictures.style import COLOURS, MARKERS, new_figure, styled
from lfpiv_cli.weights.build import factorise_through
from lfpiv_cli.weights.columns import operator_of, seen_share
from lfpiv_cli.weights.quadrature import (
    DEPTH_NODES,
    PAPERS_COUNT,
    REFERENCE_DEPTH_NODES,
    REFERENCE_TILES,
    TILES,
    RayCount,
    count_rays,
    integrate_columns,
    sampling_error,
)
from lfpiv_cli.weights.scene import lit_voxels
from lfpiv_cli.weights.strip_blocks import sample_lit, voxel_centres
from lfpiv_cli.weights.strips import StripOperator

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# The voxels p1 to p5 of the equivalent-ray-tracing paper (its Table 1), x, y and depth, mm.
TABLE1_MM = ((1.0, 0.0, 4.0), (1.5, 0.0, 2.0), (2.0, 0.0, 0.0), (2.5, 0.0, -2.0), (3.0, 0.0, -4.0))

# SSIM as Wang et al. (2004) define it: Gaussian windows of 11 x 11 pixels, K1 and K2, grey levels up to 255.
WINDOW_SIGMA_PX = 1.5
WINDOW_RADIUS_PX = 5
K1, K2 = 0.01, 0.03
GREY_LEVELS = 255.0

# Share of its light by which a voxel counts as wholly in view.
WHOLLY_SEEN = 0.999

# In the long count every point of a voxel sends this many rays: few enough for the points not to repeat themselves.
RAYS_PER_POINT_LONG = 100


@dataclass(frozen=True, eq=False)
class Column:
    """One voxel's column by each way of making it; images (rows, columns) cut to what is lit, None where impossible.

    Attributes
    ----------
    centre_mm : (3,) of the voxel, world axes
    images : by name
    """

    centre_mm: tuple[float, float, float]
    images: dict[str, Floats]


# What is compared: reference and judged image.
COMPARISONS = {
    "ert_to_drt_paraxial": ("drt_paraxial", "ert"),
    "ert_to_drt_exact": ("drt_exact", "ert"),
    "ert_exact_to_drt_exact": ("drt_exact", "ert_exact"),
    "factorised_to_converged": ("ert", "factorised"),
    "factorised_exact_to_converged": ("ert_exact", "factorised_exact"),
    "ray_count_to_converged": ("ert", "ray_count"),
    "on_demand_to_converged": ("ert", "on_demand"),
    "coarser_to_converged": ("ert", "coarser"),
    "factorised_to_long_count": ("long_count", "factorised"),
    "ert_exact_to_long_count": ("long_count_exact", "ert_exact"),
}


def ssim(reference: Floats, image: Floats) -> float:
    """Return the structural similarity (Eq. 16) of two images in grey levels, the mean over all local windows."""

    def local_mean(values: Floats) -> Floats:
        return ndimage.gaussian_filter(values, WINDOW_SIGMA_PX, mode="constant", radius=WINDOW_RADIUS_PX)

    c1, c2 = (K1 * GREY_LEVELS) ** 2, (K2 * GREY_LEVELS) ** 2
    mean_1, mean_2 = local_mean(reference), local_mean(image)
    variance_1 = local_mean(reference**2) - mean_1**2
    variance_2 = local_mean(image**2) - mean_2**2
    covariance = local_mean(reference * image) - mean_1 * mean_2
    above = (2.0 * mean_1 * mean_2 + c1) * (2.0 * covariance + c2)
    below = (mean_1**2 + mean_2**2 + c1) * (variance_1 + variance_2 + c2)
    return float(np.mean(above / below))


def compare_columns(reference: Floats, image: Floats) -> dict[str, float]:
    """Return SSIM, RMSE in grey levels and L1 of one column against its reference."""
    grey = GREY_LEVELS / reference.max()
    return {
        "ssim": ssim(grey * reference, grey * image),
        "rmse_grey": float(grey * np.sqrt(np.mean((image - reference) ** 2))),
        "l1": float(np.abs(image - reference).sum()),
    }


def sample_voxels(grid: Grid, count: int, rng: np.random.Generator) -> Floats:
    """Return the centres (count, 3) of random voxels of a grid, world axes."""
    indices = np.stack([rng.integers(0, n, count) for n in grid.shape_xyz], axis=1)
    return grid.voxel_to_mm(indices.astype(np.float64))


def in_view(
    camera: Camera, space: ObjectSpace, centre_mm: tuple[float, float, float], voxel_mm: tuple[float, float, float]
) -> bool:
    """Return whether all light of a voxel, world axes, meets the sensor."""
    paraxial = replace(space, refraction="paraxial", method="ert")
    return seen_share(camera, paraxial, Grid((1, 1, 1), voxel_mm, centre_mm))[0] > WHOLLY_SEEN


def make_columns(
    camera: Camera,
    space: ObjectSpace,
    centres_mm: Floats,
    voxel_mm: tuple[float, float, float],
    rng: np.random.Generator,
    long_count: NDArray[np.int64],
    progress: Callable[[int], None] | None = None,
) -> list[Column]:
    """Return the columns of voxels by every way that camera and scene allow.

    Parameters
    ----------
    centres_mm : (n, 3), world axes
    voxel_mm : their sides
    space : media and window; without a window there is no direct tracing and no exact refraction
    long_count : (n,) rays of long counts of each voxel, with equivalent points and with exact direct tracing; 0: none
    progress : called with 1 after each voxel
    """
    ways = _quadrature_ways(space)
    points, sides = camera.to_image_axes(centres_mm), camera.to_image_axes(np.asarray(voxel_mm))
    columns = []
    for centre, point, rays in zip(centres_mm, points, long_count, strict=True):
        images = {
            name: _integrated(camera, way, point, sides, tiles) for name, (way, tiles) in ways.items()
        } | _factorised(camera, space, centre, voxel_mm)
        paraxial = replace(space, refraction="paraxial", method="ert")
        images["ray_count"] = count_rays(camera, paraxial, point, sides, rng)
        if rays:
            per_point = min(RAYS_PER_POINT_LONG, int(rays))
            number = RayCount(int(rays) // per_point, per_point)
            images["long_count"] = count_rays(camera, paraxial, point, sides, rng, number)
            if space.window is not None:
                direct = replace(space, refraction="exact", method="drt")
                images["long_count_exact"] = count_rays(camera, direct, point, sides, rng, number)
        columns.append(Column((centre[0], centre[1], centre[2]), cut_to_lit(images)))
        if progress:
            progress(1)
    return columns


def weights_figures(columns: list[Column], long_count: NDArray[np.int64]) -> dict[str, Any]:
    """Return for each comparison the mean and the worst of SSIM, RMSE and L1, and the figures of each voxel."""
    voxels = []
    for column, rays in zip(columns, long_count, strict=True):
        entry: dict[str, Any] = {"centre_mm": list(column.centre_mm)}
        for name, (reference, image) in COMPARISONS.items():
            if reference in column.images and image in column.images:
                entry[name] = compare_columns(column.images[reference], column.images[image])
        converged = column.images["ert"]
        entry["pixels"] = int(np.count_nonzero(converged))
        entry["independent_rays_l1"] = sampling_error(converged, int(rays) or PAPERS_COUNT.rays)
        voxels.append(entry)
    return {name: _summary([v[name] for v in voxels if name in v]) for name in COMPARISONS} | {"voxels": voxels}


def weights_limits_missed(figures: dict[str, Any], limits: dict[str, dict[str, float | None]]) -> list[str]:
    """Return a sentence for each limit that is missed; a limit that cannot be judged is missed too.

    Limits are given by comparison and figure; those on SSIM are lower ones.
    """
    missed = []
    for comparison, each in limits.items():
        for figure, limit in each.items():
            if limit is None:
                continue
            value = (figures[comparison] or {}).get(figure)
            if value is None:
                missed.append(f"{comparison}.{figure} could not be judged")
            elif (value < limit) if figure.startswith("ssim") else (value > limit):
                missed.append(f"{comparison}.{figure} is {written(value, 4)}, the limit {limit:g}")
    return missed


def _quadrature_ways(space: ObjectSpace) -> dict[str, tuple[ObjectSpace, int]]:
    """Return the object space and the tiles of each column that is integrated on its own."""
    paraxial = replace(space, refraction="paraxial", method="ert")
    ways = {"ert": (paraxial, REFERENCE_TILES), "coarser": (paraxial, REFERENCE_TILES // 2)}
    if space.window is not None:
        ways["drt_paraxial"] = (replace(space, refraction="paraxial", method="drt"), REFERENCE_TILES)
        ways["drt_exact"] = (replace(space, refraction="exact", method="drt"), REFERENCE_TILES)
        ways["ert_exact"] = (replace(space, refraction="exact", method="ert"), REFERENCE_TILES)
    return ways


def _integrated(camera: Camera, space: ObjectSpace, point: Floats, sides: Floats, tiles: int) -> Floats:
    columns = integrate_columns(camera, space, point, sides, tiles, REFERENCE_DEPTH_NODES)
    return columns.image(0, (camera.rows, camera.columns))


def _factorised(
    camera: Camera, space: ObjectSpace, centre: Floats, voxel_mm: tuple[float, float, float]
) -> dict[str, Floats]:
    """Return the factorised columns of one voxel; none where the axes do not separate."""
    grid = Grid((1, 1, 1), voxel_mm, (centre[0], centre[1], centre[2]))
    spaces = {"factorised": replace(space, refraction="paraxial", method="ert")}
    if space.window is not None:
        spaces["factorised_exact"] = replace(space, refraction="exact", method="ert")
    images = {}
    for name, each in spaces.items():
        try:
            rows, columns, weight = factorise_through(camera, each, grid).column(0, 0, 0)
        except ConfigError:
            continue
        images[name] = np.zeros((camera.rows, camera.columns))
        images[name][rows, columns] = weight
    return images


def cut_to_lit(images: dict[str, Floats]) -> dict[str, Floats]:
    """Return the images cut to the rectangle that any of them lights."""
    lit = np.any([image > 0.0 for image in images.values()], axis=0)
    if not lit.any():
        raise ConfigError("validation: a voxel lies outside the camera's view")
    rows, columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return {name: image[part].copy() for name, image in images.items()}


def _summary(each: list[dict[str, float]]) -> dict[str, float] | None:
    if not each:
        return None
    summary = {}
    for name in ("ssim", "rmse_grey", "l1"):
        values = np.array([entry[name] for entry in each])
        summary[f"{name}_mean"] = float(values.mean())
        worst, pick = ("smallest", np.min) if name == "ssim" else ("largest", np.max)
        summary[f"{name}_{worst}"] = float(pick(values))
    return summary


# Columns behind curved faces: in strips, on demand and counted, beside converged integrals over traced rays.
#
# Axes: voxels [plane, row voxel, column voxel] of a grid; centres in world axes (x, y, z), z away from the camera
# from the nominal focal point; images [row, column].


def seen_voxels(
    camera: Camera, space: CurvedSpace, grid: Grid, count: int, rng: np.random.Generator
) -> NDArray[np.int64]:
    """Return (n, 3) random voxels of a grid that lie wholly in the fluid, at most so many.

    Raises
    ------
    ConfigError : there are none
    """
    found = sample_lit(camera, space, grid, lit_voxels(camera, space, grid), count, rng)
    if not len(found):
        raise ConfigError("validation: no voxel of the volume lies wholly in the fluid behind the scene")
    return found


def make_curved_columns(
    camera: Camera,
    space: CurvedSpace,
    grid: Grid,
    voxels: NDArray[np.int64],
    rng: np.random.Generator,
    long_count: NDArray[np.int64],
    progress: Callable[[int], None] | None = None,
) -> list[Column]:
    """Return the columns of voxels (n, 3) by every way there is behind curved faces.

    Parameters
    ----------
    long_count : (n,) rays of long counts of each voxel; 0: none
    progress : called with 1 after each voxel
    """
    operator, shape = operator_of(camera, space, grid), (camera.rows, camera.columns)
    sides = camera.to_image_axes(np.asarray(grid.spacing_mm))
    columns = []
    for voxel, point, rays in zip(voxels, voxel_centres(camera, grid, voxels), long_count, strict=True):
        integrated = partial(integrate_columns, camera, space, point, sides)
        images = {
            "ert": integrated(REFERENCE_TILES, REFERENCE_DEPTH_NODES).image(0, shape),
            "coarser": integrated(REFERENCE_TILES // 2, REFERENCE_DEPTH_NODES).image(0, shape),
            "on_demand": integrated(TILES, DEPTH_NODES).image(0, shape),
            "ray_count": count_rays(camera, space, point, sides, rng),
        }
        if isinstance(operator, StripOperator):
            images["factorised"] = np.zeros(shape)
            rows, cells, weights = operator.column(*voxel.tolist())
            images["factorised"][rows, cells] = weights
        if rays:
            per_point = min(RAYS_PER_POINT_LONG, int(rays))
            number = RayCount(int(rays) // per_point, per_point)
            images["long_count"] = count_rays(camera, space, point, sides, rng, number)
        x, y, z = camera.to_image_axes(point)
        columns.append(Column((float(x), float(y), float(z)), cut_to_lit(images)))
        if progress:
            progress(1)
    return columns


SHOWN = {
    "drt_exact": "DRT, exact",
    "ert": "ERT, converged",
    "factorised": "ERT, factorised",
    "ray_count": "ERT, 500 x 10,000 rays",
}
SHOWN_BEHIND_FACES = {
    "ert": "traced, converged",
    "on_demand": "traced, on demand",
    "factorised": "in strips",
    "ray_count": "500 x 10,000 rays",
}


@styled
def columns_figure(columns: list[Column], shown: dict[str, str] = SHOWN) -> Figure:
    """Return the columns of voxels, one row a voxel: direct tracing, equivalent points, factorised, counted.

    Behind curved faces `SHOWN_BEHIND_FACES`. A row has one scale: the brightest pixel by equivalent points, or traced.
    """
    names = [name for name in shown if any(name in column.images for column in columns)]
    figure = new_figure(2.8 * len(names) + 0.6, 2.9 * len(columns))
    axes = figure.subplots(len(columns), len(names), squeeze=False)
    for row, column in zip(axes, columns, strict=True):
        brightest = column.images["ert"].max()
        for axis, name in zip(row, names, strict=True):
            if name not in column.images:
                axis.set_axis_off()
                continue
            picture = axis.imshow(column.images[name], cmap="gray", vmin=0.0, vmax=brightest, interpolation="nearest")
            axis.set_title(f"{shown[name]}\n({', '.join(written(value) for value in column.centre_mm)}) mm", fontsize=7)
            axis.set(xlabel="column (px)", ylabel="row (px)")
        figure.colorbar(picture, ax=row.tolist(), label="weight (1)", shrink=0.8)
    return figure


@styled
def similarity_figure(figures: dict[str, Any], shown: int) -> Figure:
    """Return SSIM, RMSE and L1 of the first voxels, by comparison; each has its colour and marker."""
    figure = new_figure(12.0, 4.2)
    voxels = figures["voxels"][:shown]
    names = [name for name in figures if name != "voxels" and figures[name] is not None]
    for axis, (key, label) in zip(
        figure.subplots(1, 3), {"ssim": "SSIM", "rmse_grey": "RMSE (grey levels)", "l1": "L1"}.items(), strict=True
    ):
        for number, name in enumerate(names):
            again, k = divmod(number, len(COLOURS))
            values = [voxel.get(name, {}).get(key, np.nan) for voxel in voxels]
            axis.plot(
                np.arange(1, len(voxels) + 1),
                values,
                MARKERS[k] + ("-", "--")[again],
                color=COLOURS[k],
                markerfacecolor="none",
                label=name.replace("_", " "),
            )
        axis.set(xlabel="voxel", ylabel=label, xticks=np.arange(1, len(voxels) + 1))
        if key != "ssim":
            axis.set_ylim(bottom=0.0)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
