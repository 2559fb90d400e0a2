"""Figures of a vector field, none of which needs to know the true flow.

Velocities are drawn in m/s or mm/s, whichever reads better; fields without a time as displacements in voxels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.flow.field import (
    FLAG_NAMES,
    MASKED,
    MM_TO_M,
    REJECTED,
    REPLACED,
    SECOND_PEAK,
    VALID,
    VectorField,
    derived_fields,
)
from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures.style import (
    AXIS_NAMES,
    BLUE,
    COLOURS,
    COMPONENT_NAMES,
    DIVERGING,
    GREY,
    ORANGE,
    SEQUENTIAL,
    SKY_BLUE,
    VERMILION,
    new_figure,
    styled,
    symmetric_limit,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The three middle planes of what lives on a grid, side by side at one length per mm.
#
# Axes: arrays [z, y, x], vectors (u, v, w) along (x, y, z) last; in pictures the first axis of a plane points right,
# the second up. An even number of cells has no middle one: the next after the middle is shown, and the title says
# where.

# The width of the three planes together, and the least and largest height of a row of them, in inches.
ROW_WIDTH, LEAST_HEIGHT, LARGEST_HEIGHT = 9.0, 1.9, 4.2
# What titles, labels and scales take beside the planes, in inches.
MARGIN_WIDTH, MARGIN_HEIGHT = 2.2, 0.9


class Plane(NamedTuple):
    """A plane by its axes (0 for x): the one that points right, and the one that points up."""

    right: int
    up: int

    @property
    def normal(self) -> int:
        """The axis that the plane lies across."""
        return 3 - self.right - self.up

    @property
    def name(self) -> str:
        """Its axes' names, for instance x-z."""
        return f"{AXIS_NAMES[self.right]}-{AXIS_NAMES[self.up]}"

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the middle plane of an array [z, y, x, ...] as [up, right, ...]."""
        along = 2 - self.normal
        return values.take(values.shape[along] // 2, axis=along)

    def place_mm(self, grid: Grid) -> float:
        """Return where the middle plane lies on its normal."""
        return float(grid.axis_mm(self.normal)[grid.shape_xyz[self.normal] // 2])

    def extent(self, grid: Grid) -> tuple[float, float, float, float]:
        """Return the outer faces: left, right, bottom, top, mm."""
        return (*grid.bounds_mm(self.right), *grid.bounds_mm(self.up))


PLANES = (Plane(0, 1), Plane(0, 2), Plane(1, 2))


def plane_panels(grid: Grid, rows: int = 1) -> tuple[Figure, NDArray[Any]]:
    """Return a figure with rows of three panels, one for each plane, as wide as their parts of the grid."""
    sizes = [high - low for low, high in map(grid.bounds_mm, range(3))]
    widths = [sizes[plane.right] for plane in PLANES]
    tallest = ROW_WIDTH * max(sizes[plane.up] for plane in PLANES) / sum(widths)
    height = MARGIN_HEIGHT + min(max(tallest, LEAST_HEIGHT), LARGEST_HEIGHT)
    figure = new_figure(ROW_WIDTH + MARGIN_WIDTH, rows * height)
    return figure, figure.subplots(rows, 3, squeeze=False, width_ratios=widths)


def label_plane(axes: Axes, grid: Grid, plane: Plane, what: str = "") -> None:
    """Name a panel's axes, and in its title what it shows and where the plane lies."""
    place = f"{plane.name} at {AXIS_NAMES[plane.normal]} = {plane.place_mm(grid):z.2f} mm"
    left, right, bottom, top = plane.extent(grid)
    axes.set(
        xlabel=f"{AXIS_NAMES[plane.right]} (mm)",
        ylabel=f"{AXIS_NAMES[plane.up]} (mm)",
        title=f"{what}\n{place}" if what else place,
        xlim=(left, right),
        ylim=(bottom, top),
        aspect="equal",
    )


def draw_maps(
    row: Sequence[Axes], grid: Grid, maps: Sequence[NDArray[Any]], titles: Sequence[str], **scale: Any
) -> Any:
    """Draw the middle planes of three arrays [z, y, x] (of one, given three times) as maps on one scale.

    Returns the last image, for the scale; unknown values stay blank.
    """
    for axes, plane, values, title in zip(row, PLANES, maps, titles, strict=True):
        image = axes.imshow(
            plane.of(values), origin="lower", extent=plane.extent(grid), interpolation="nearest", **scale
        )
        label_plane(axes, grid, plane, title)
    return image


FLAG_COLOURS = {VALID: BLUE, SECOND_PEAK: SKY_BLUE, REPLACED: ORANGE, REJECTED: VERMILION, MASKED: "0.85"}
# More arrows than this along an axis hide each other.
MOST_ARROWS = 32
# Flows slower than this are told in mm/s.
SLOW_M_S = 0.1
# The longest arrow reaches so many distances of arrows.
ARROW_REACH = 1.2
# Of arrows' shafts, in inches.
ARROW_WIDTH = 0.015
# Shares (%) of the known values between which a logarithmic scale reaches: few odd ones do not stretch it.
SCALE_PERCENT = (2.0, 98.0)
HISTOGRAM_BARS, PART_BARS = 40, 20


@dataclass(frozen=True, eq=False)
class Shown:
    """What is drawn of a field: `values` and `sigma` (nz, ny, nx, 3) in `unit`; NaN where unknown, sigma or None."""

    values: Floats
    sigma: Floats | None
    unit: str


def shown(field: VectorField) -> Shown:
    """Return the velocities in a unit that reads well; displacements where the time is not known."""
    if field.dt_s is None:
        values, scale, unit = field.displacement_voxel, np.ones(3), "voxel"
        values = np.where((field.flag >= REJECTED)[..., np.newaxis], np.nan, values)
    else:
        factor, unit = speed_unit(field.velocity)
        values, scale = factor * field.velocity, factor * np.asarray(field.voxel_mm) * MM_TO_M / field.dt_s
    known = np.isfinite(values).all(axis=-1, keepdims=True)
    sigma = field.uncertainty_voxel
    return Shown(values, None if sigma is None else np.where(known, sigma * scale, np.nan), unit)


def planes_figure(field: VectorField) -> Figure:
    """Return the vectors in the three middle planes, see `compared_figure`."""
    told = shown(field)
    return compared_figure(field.grid, {"": told.values}, told.unit)


@styled
def compared_figure(grid: Grid, fields: Mapping[str, Floats], unit: str) -> Figure:
    """Return vectors (nz, ny, nx, 3) in the three middle planes, a row for each field, by its name.

    Arrows show the components in the plane and colour the one across it; both have one scale in all. Crosses are
    missing vectors.
    """
    figure, axes = plane_panels(grid, rows=len(fields))
    across = {name: [values[..., plane.normal] for plane in PLANES] for name, values in fields.items()}
    scale = signed_scale(*across.values())
    longest = symmetric_limit(
        *(plane.of(values)[..., [plane.right, plane.up]] for values in fields.values() for plane in PLANES)
    )
    step = [-(-n // MOST_ARROWS) for n in grid.shape_xyz]
    spacing = max(spacing * n for spacing, n in zip(grid.spacing_mm, step, strict=True))
    for row, (name, values) in zip(axes, fields.items(), strict=True):
        components = [COMPONENT_NAMES[plane.normal] for plane in PLANES]
        titles = [f"{name}: {component}" if name else component for component in components]
        image = draw_maps(row, grid, across[name], titles, **scale)
        for panel, plane in zip(row, PLANES, strict=True):
            arrows = _draw_arrows(panel, grid, plane, values, (step, longest / (ARROW_REACH * spacing)))
    length = float(f"{0.7 * longest:.1g}")
    place = 1.0 - 0.25 / figure.get_figheight()
    axes[0, 0].quiverkey(arrows, 0.96, place, length, f"{length:g} {unit}", coordinates="figure", labelpos="W")
    figure.colorbar(image, ax=axes.ravel().tolist(), label=f"component across the plane ({unit})", shrink=0.75)
    return figure


def _draw_arrows(axes: Axes, grid: Grid, plane: Plane, values: Floats, arrows: tuple[Sequence[int], float]) -> Any:
    """Draw a plane's arrows, so many vectors apart along x, y, z, and so long that a mm stands for a speed."""
    step, speed_per_mm = arrows
    chosen = (slice(None, None, step[plane.up]), slice(None, None, step[plane.right]))
    of_plane = plane.of(values)[chosen]
    right, up = np.meshgrid(grid.axis_mm(plane.right)[chosen[1]], grid.axis_mm(plane.up)[chosen[0]])
    known = np.isfinite(of_plane).all(axis=-1)
    axes.plot(right[~known], up[~known], "x", color=GREY, markersize=3)
    return axes.quiver(
        right[known],
        up[known],
        of_plane[known, plane.right],
        of_plane[known, plane.up],
        angles="xy",
        scale_units="xy",
        scale=speed_per_mm,
        units="inches",
        width=ARROW_WIDTH,
        pivot="mid",
    )


def speed_unit(*velocities_m_s: Floats) -> tuple[float, str]:
    """Return the unit in which velocities read well: what m/s are multiplied by, and its name."""
    known = any(np.isfinite(each).any() for each in velocities_m_s)
    return (1.0 / MM_TO_M, "mm/s") if known and symmetric_limit(*velocities_m_s) < SLOW_M_S else (1.0, "m/s")


@styled
def components_figure(field: VectorField) -> Figure:
    """Return maps of each component (rows) in the three middle planes, on one scale a component."""
    told = shown(field)
    figure, axes = plane_panels(field.grid, rows=3)
    for component, row in enumerate(axes):
        values = told.values[..., component]
        name = COMPONENT_NAMES[component]
        image = draw_maps(row, field.grid, [values] * 3, [name] * 3, **signed_scale([values] * 3))
        figure.colorbar(image, ax=row.tolist(), label=f"{name} ({told.unit})")
    return figure


def signed_scale(*rows: Sequence[Floats]) -> dict[str, Any]:
    """Return the colours of rows of three maps with a sign, symmetric about zero: by what the middle planes show."""
    limit = symmetric_limit(*(plane.of(values) for maps in rows for plane, values in zip(PLANES, maps, strict=True)))
    return {"cmap": DIVERGING, "vmin": -limit, "vmax": limit}


@styled
def profiles_figure(field: VectorField) -> Figure:
    """Return the mean of each component (rows) over the planes across each axis (columns).

    The band is the standard deviation of one vector (rms over the plane) to both sides, where it is known.
    """
    told = shown(field)
    figure = new_figure(10.0, 7.5)
    axes = figure.subplots(3, 3, sharey="row", sharex="col")
    for component, row in enumerate(axes):
        for axis, panel in enumerate(row):
            _draw_profile(panel, field, told, component, axis)
        row[0].set_ylabel(f"{COMPONENT_NAMES[component]} ({told.unit}), mean over the plane")
    for axis, panel in enumerate(axes[-1]):
        panel.set_xlabel(f"{AXIS_NAMES[axis]} (mm)")
    if told.sigma is not None:
        axes[0, 0].legend()
    return figure


def _draw_profile(axes: Axes, field: VectorField, told: Shown, component: int, axis: int) -> None:
    others = tuple(k for k in range(3) if k != 2 - axis)
    places = field.grid.axis_mm(axis)
    mean = mean_of_known(told.values[..., component], others)
    colour = COLOURS[component]
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    axes.plot(places, mean, "o-", color=colour)
    if told.sigma is not None:
        sigma = np.sqrt(mean_of_known(told.sigma[..., component] ** 2, others))
        axes.fill_between(
            places, mean - sigma, mean + sigma, color=colour, alpha=0.25, linewidth=0.0, label="± σ of one vector"
        )


def mean_of_known(values: Floats, axes: tuple[int, ...]) -> Floats:
    """Return means over axes of what is finite, NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=axes)
    mean = np.full(count.shape, np.nan)
    np.divide(np.where(known, values, 0.0).sum(axis=axes), count, out=mean, where=count > 0)
    return mean


@styled
def sigma_figure(field: VectorField) -> Figure:
    """Return maps of the stated standard deviation of each component (rows), on one logarithmic scale.

    Raises
    ------
    ValueError : the field does not know it
    """
    told = shown(field)
    if told.sigma is None:
        raise ValueError("the field states no uncertainty")
    figure, axes = plane_panels(field.grid, rows=3)
    scale = logarithmic_scale(told.sigma)
    for component, row in enumerate(axes):
        title = f"σ of {COMPONENT_NAMES[component]}"
        image = draw_maps(row, field.grid, [told.sigma[..., component]] * 3, [title] * 3, **scale)
    figure.colorbar(image, ax=axes.ravel().tolist(), label=f"stated standard deviation ({told.unit})", shrink=0.6)
    return figure


def logarithmic_scale(values: Floats) -> dict[str, Any]:
    """Return the colours of positive values over several orders; outer ones take the colours of the ends."""
    from matplotlib.colors import LogNorm

    known = values[np.isfinite(values) & (values > 0.0)]
    low, high = np.percentile(known, SCALE_PERCENT) if known.size else (0.1, 1.0)
    if low == high:
        low, high = 0.5 * low, 2.0 * high
    return {"cmap": SEQUENTIAL, "norm": LogNorm(low, high)}


@styled
def flags_figure(field: VectorField) -> Figure:
    """Return the flags in the three middle planes, with how many vectors of the whole field have each."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    figure, axes = plane_panels(field.grid)
    colours = ListedColormap([FLAG_COLOURS[flag] for flag in sorted(FLAG_COLOURS)])
    norm = BoundaryNorm(np.arange(len(FLAG_COLOURS) + 1) - 0.5, len(FLAG_COLOURS))
    draw_maps(axes[0], field.grid, [field.flag] * 3, [""] * 3, cmap=colours, norm=norm)
    counts = field.flag_counts
    patches = [
        Patch(facecolor=FLAG_COLOURS[flag], edgecolor="0.3", label=f"{name}: {counts[name]}")
        for flag, name in FLAG_NAMES.items()
        if counts[name]
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), title="vectors in the whole field")
    return figure


@styled
def quality_figure(field: VectorField, names: dict[str, Floats]) -> Figure:
    """Return maps of quantities [z, y, x] that tell how good vectors are (rows), each on its own scale from zero."""
    figure, axes = plane_panels(field.grid, rows=len(names))
    for row, (name, values) in zip(axes, names.items(), strict=True):
        image = draw_maps(row, field.grid, [values] * 3, [""] * 3, vmin=0.0, vmax=symmetric_limit(values))
        figure.colorbar(image, ax=row.tolist(), label=name)
    return figure


@styled
def displacements_figure(field: VectorField, lens_mm: float | None = None) -> Figure:
    """Return histograms of the displacements of valid vectors, and of what they are beyond whole voxels.

    Parts that crowd about zero tell of locking. Volumes lock to whole microlenses: with their width in the scene,
    `lens_mm`, a third row shows what displacements are beyond these.
    """
    units = {"voxels": np.ones(3)}
    if lens_mm is not None:
        units["microlenses"] = lens_mm / np.asarray(field.voxel_mm)
    figure = new_figure(10.0, 2.6 * (1 + len(units)))
    axes = figure.subplots(1 + len(units), 3)
    valid = field.displacement_voxel[field.flag == VALID]
    for component, column in enumerate(axes.T):
        values = valid[np.isfinite(valid[:, component]), component]
        name, colour = COMPONENT_NAMES[component], COLOURS[component]
        column[0].hist(values, bins=HISTOGRAM_BARS, color=colour)
        column[0].set(xlabel=f"displacement {name} (voxel)", ylabel="valid vectors")
        for panel, (unit, size) in zip(column[1:], units.items(), strict=True):
            _draw_parts(panel, values / size[component], f"{name} beyond whole {unit} ({unit})", colour)
    return figure


def _draw_parts(axes: Axes, displacements: Floats, what: str, colour: str) -> None:
    """Draw a histogram of parts from -1/2 to 1/2, and the line that evenly spread ones would follow."""
    axes.hist(displacements - np.round(displacements), bins=PART_BARS, range=(-0.5, 0.5), color=colour)
    axes.axhline(displacements.size / PART_BARS, color="black", linestyle="--", linewidth=0.9, label="evenly spread")
    axes.set(xlabel=what, ylabel="valid vectors", xlim=(-0.5, 0.5))
    axes.legend()


@styled
def gradients_figure(field: VectorField) -> Figure:
    """Return the vorticity across the three middle planes, and below it the divergence, zero in a liquid, in 1/s.

    Raises
    ------
    ValueError : the field has no time
    """
    if field.dt_s is None:
        raise ValueError("rates need a time between the frames")
    derived = derived_fields(field)
    figure, axes = plane_panels(field.grid, rows=2)
    across = [derived.vorticity[..., plane.normal] for plane in PLANES]
    names = [f"vorticity along {AXIS_NAMES[plane.normal]}" for plane in PLANES]
    # One scale for both: the divergence, which should be zero, tells how much of the vorticity is noise.
    scale = signed_scale(across, [derived.divergence] * 3)
    draw_maps(axes[0], field.grid, across, names, **scale)
    image = draw_maps(axes[1], field.grid, [derived.divergence] * 3, ["divergence"] * 3, **scale)
    figure.colorbar(image, ax=axes.ravel().tolist(), label="1/s", shrink=0.7)
    return figure
