"""How right the weights are, voxel by voxel: methods against each other, and the factorised form against integrals.

Columns are compared as images on the sensor: by L1 (a column sums to 1), by SSIM (Eq. 16) and by the root mean square
difference in grey levels, the brightest pixel of the reference being 255, over the pixels that either one lights.

Axes: voxels in world axes (x, y, z), z away from the camera from the nominal focal point; images [row, column].
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.pictures.style import COLOURS, MARKERS, Figure, new_panels, styled
from lfpiv_cli.weights import quadrature
from lfpiv_cli.weights.build import factorise_through
from lfpiv_cli.weights.columns import operator_of, seen_share
from lfpiv_cli.weights.quadrature import PAPERS_COUNT, integrate_columns
from lfpiv_cli.weights.scene import lit_voxels
from lfpiv_cli.weights.strip_blocks import sample_lit, voxel_centres
from lfpiv_cli.weights.strips import StripOperator

Space = ObjectSpace | CurvedSpace

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
# What columns are compared by, and which of their voxels is the worst.
WORST = (("ssim", "smallest", np.min), ("rmse_grey", "largest", np.max), ("l1", "largest", np.max))


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


def sample_voxels(grid: Grid, count: int, rng: np.random.Generator) -> Floats:
    """Return the centres (count, 3) of random voxels of a grid, world axes."""
    indices = np.stack([rng.integers(0, n, count) for n in grid.shape_xyz], axis=1)
    return grid.voxel_to_mm(indices.astype(np.float64))


def judged_voxels(
    camera: Camera, space: Space, grid: Grid, sample: int, rng: np.random.Generator
) -> tuple[Floats, Flags]:
    """Return the centres (n, 3), world axes, of voxels that are compared, and of which (n,) rays are counted for long.

    These are the paper's that are in view, with `sample` random ones of the grid. Behind curved faces all are random
    ones that lie wholly in the fluid, as many.

    Raises
    ------
    ConfigError : there are none in the fluid
    """
    if isinstance(space, CurvedSpace):
        lit, count = lit_voxels(camera, space, grid), len(TABLE1_MM) + sample
        found = sample_lit(camera, space, grid, lit, count, rng)
        if not len(found):
            raise ConfigError("validation: no voxel of the volume lies wholly in the fluid behind the scene")
        centres, known = camera.to_image_axes(voxel_centres(camera, grid, found)), len(TABLE1_MM)
    else:
        paraxial = replace(space, refraction="paraxial", method="ert")
        alone = ((centre, Grid((1, 1, 1), grid.spacing_mm, centre)) for centre in TABLE1_MM)
        papers = [centre for centre, voxel in alone if seen_share(camera, paraxial, voxel)[0] > WHOLLY_SEEN]
        centres = np.concatenate([np.array(papers).reshape(-1, 3), sample_voxels(grid, sample, rng)])
        known = len(papers)
    return centres, np.arange(len(centres)) < known


def make_columns(
    camera: Camera,
    space: Space,
    grid: Grid,
    centres_mm: Floats,
    rng: np.random.Generator,
    long_count: Integers,
    progress: Callable[[int], None] | None = None,
) -> list[Column]:
    """Return the columns of voxels by every way that camera and scene allow.

    Parameters
    ----------
    space : media and window, without which there is no direct tracing and no exact refraction; or curved faces, behind
        which columns are made in strips and on demand
    grid : whose voxels are compared; behind plane layers only their sides count
    centres_mm : (n, 3), world axes
    long_count : (n,) rays of long counts of each voxel, with equivalent points (or traced through the faces) and with
        exact direct tracing; 0: none
    progress : called with 1 after each voxel
    """
    fine = quadrature.REFERENCE_TILES, quadrature.REFERENCE_DEPTH_NODES
    coarse = quadrature.REFERENCE_TILES // 2, quadrature.REFERENCE_DEPTH_NODES
    in_use: dict[str, ObjectSpace] = {}
    if isinstance(space, CurvedSpace):
        ways: dict[str, tuple[Space, tuple[int, int]]] = {
            "on_demand": (space, (quadrature.TILES, quadrature.DEPTH_NODES))
        }
        counted: dict[str, Space] = {"long_count": space}
        strips = operator_of(camera, space, grid)
    else:
        strips = None
        in_use["factorised"] = paraxial = replace(space, refraction="paraxial", method="ert")
        ways, counted = {}, {"long_count": paraxial}
        if space.window is not None:
            in_use["factorised_exact"] = exact = replace(space, refraction="exact", method="ert")
            counted["long_count_exact"] = direct = replace(space, refraction="exact", method="drt")
            ways["drt_paraxial"] = (replace(space, refraction="paraxial", method="drt"), fine)
            ways |= {"drt_exact": (direct, fine), "ert_exact": (exact, fine)}
    ways |= {"ert": (counted["long_count"], fine), "coarser": (counted["long_count"], coarse)}
    shape, sides = (camera.rows, camera.columns), camera.to_image_axes(np.asarray(grid.spacing_mm))
    columns = []
    for centre, rays in zip(centres_mm, long_count, strict=True):
        point, place = camera.to_image_axes(centre), (float(centre[0]), float(centre[1]), float(centre[2]))
        images = {
            name: integrate_columns(camera, way, point, sides, *nodes).image(0, shape)
            for name, (way, nodes) in ways.items()
        }
        columns_in_use = {}
        if isinstance(strips, StripOperator):
            column, row, plane = np.rint(camera.to_image_axes(grid.mm_to_voxel(centre))).astype(int).tolist()
            columns_in_use["factorised"] = strips.column(plane, row, column)
        for name, each in in_use.items():
            # none where the axes do not separate
            with suppress(ConfigError):
                voxel = Grid((1, 1, 1), grid.spacing_mm, place)
                columns_in_use[name] = factorise_through(camera, each, voxel).column(0, 0, 0)
        for name, (rows, cells, weights) in columns_in_use.items():
            images[name] = np.zeros(shape)
            images[name][rows, cells] = weights
        images["ray_count"] = quadrature.count_rays(camera, counted["long_count"], point, sides, rng)
        if rays:
            per_point = min(RAYS_PER_POINT_LONG, int(rays))
            number = quadrature.RayCount(int(rays) // per_point, per_point)
            images |= {
                name: quadrature.count_rays(camera, each, point, sides, rng, number) for name, each in counted.items()
            }
        # cut to the rectangle that any of them lights
        lit = np.any([image > 0.0 for image in images.values()], axis=0)
        if not lit.any():
            raise ConfigError("validation: a voxel lies outside the camera's view")
        lit_rows, lit_columns = np.flatnonzero(lit.any(axis=1)), np.flatnonzero(lit.any(axis=0))
        part = np.s_[lit_rows[0] : lit_rows[-1] + 1, lit_columns[0] : lit_columns[-1] + 1]
        columns.append(Column(place, {name: image[part].copy() for name, image in images.items()}))
        if progress:
            progress(1)
    return columns


def weights_figures(columns: list[Column], long_count: Integers) -> dict[str, Any]:
    """Return for each comparison the mean and the worst of SSIM, RMSE and L1, and the figures of each voxel."""
    voxels = []
    for column, rays in zip(columns, long_count, strict=True):
        entry: dict[str, Any] = {"centre_mm": list(column.centre_mm)}
        for name, pair in COMPARISONS.items():
            if not column.images.keys() >= set(pair):
                continue
            reference, image = (column.images[each] for each in pair)
            grey = GREY_LEVELS / reference.max()
            entry[name] = {
                "ssim": ssim(grey * reference, grey * image),
                "rmse_grey": float(grey * np.sqrt(np.mean((image - reference) ** 2))),
                "l1": float(np.abs(image - reference).sum()),
            }
        converged = column.images["ert"]
        entry["pixels"] = int(np.count_nonzero(converged))
        entry["independent_rays_l1"] = quadrature.sampling_error(converged, int(rays) or PAPERS_COUNT.rays)
        voxels.append(entry)
    figures: dict[str, Any] = {}
    for name in COMPARISONS:
        known = [voxel[name] for voxel in voxels if name in voxel]
        summary: dict[str, float] = {}
        for key, worst, pick in WORST if known else ():
            values = np.array([each[key] for each in known])
            summary |= {f"{key}_mean": float(values.mean()), f"{key}_{worst}": float(pick(values))}
        figures[name] = summary or None
    return figures | {"voxels": voxels}


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
    size = 2.8 * len(names) + 0.6, 2.9 * len(columns)
    figure, axes = new_panels(*size, len(columns), len(names), squeeze=False)
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
    figure, axes = new_panels(12.0, 4.2, 1, 3)
    voxels = figures["voxels"][:shown]
    names = [name for name in figures if name != "voxels" and figures[name] is not None]
    labels = {"ssim": "SSIM", "rmse_grey": "RMSE (grey levels)", "l1": "L1"}
    for axis, (key, label) in zip(axes, labels.items(), strict=True):
        for number, name in enumerate(names):
            again, k = divmod(number, len(COLOURS))
            values = [voxel.get(name, {}).get(key, np.nan) for voxel in voxels]
            look = {"color": COLOURS[k], "markerfacecolor": "none", "label": name.replace("_", " ")}
            axis.plot(np.arange(1, len(voxels) + 1), values, MARKERS[k] + ("-", "--")[again], **look)
        axis.set(xlabel="voxel", ylabel=label, xticks=np.arange(1, len(voxels) + 1))
        if key != "ssim":
            axis.set_ylim(bottom=0.0)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure
