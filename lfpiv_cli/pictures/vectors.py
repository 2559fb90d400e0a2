"""Figures of what lives on a grid: a vector field, none of which needs to know the true flow, a volume, and weights.

Velocities are drawn in m/s or mm/s, whichever reads better; fields without a time as displacements in voxels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Integers, Singles
from lfpiv_cli.flow import field as of_field
from lfpiv_cli.flow.field import MM_TO_M, REJECTED, VALID, VectorField, derived_fields
from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures import style

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

    def of(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return the middle plane of an array [z, y, x, ...] as [up, right, ...]."""
        along = 2 - self.normal
        return values.take(values.shape[along] // 2, axis=along)

    def extent(self, grid: Grid) -> tuple[float, float, float, float]:
        """Return the outer faces: left, right, bottom, top, mm."""
        return (*grid.bounds_mm(self.right), *grid.bounds_mm(self.up))


PLANES = (Plane(0, 1), Plane(0, 2), Plane(1, 2))


def plane_panels(grid: Grid, rows: int = 1) -> tuple[style.Figure, NDArray[Any]]:
    """Return a figure with rows of three panels, one for each plane, as wide as their parts of the grid."""
    sizes = [high - low for low, high in map(grid.bounds_mm, range(3))]
    widths = [sizes[plane.right] for plane in PLANES]
    tallest = ROW_WIDTH * max(sizes[plane.up] for plane in PLANES) / sum(widths)
    height = MARGIN_HEIGHT + min(max(tallest, LEAST_HEIGHT), LARGEST_HEIGHT)
    return style.new_panels(ROW_WIDTH + MARGIN_WIDTH, rows * height, rows, 3, squeeze=False, width_ratios=widths)


def draw_maps(
    row: Sequence[style.Axes], grid: Grid, maps: Sequence[NDArray[Any]], titles: Sequence[str], **scale: Any
) -> Any:
    """Draw the middle planes of three arrays [z, y, x] (of one, given three times), or planes, as maps on one scale.

    Titles tell what is shown and where a middle plane lies. Returns the last image, for the scale; unknown values stay
    blank.
    """
    for axes, plane, values, title in zip(row, PLANES, maps, titles, strict=True):
        extent, place, right, up = plane.extent(grid), "", style.AXIS_NAMES[plane.right], style.AXIS_NAMES[plane.up]
        if values.ndim > 2:
            values = plane.of(values)
            middle = grid.axis_mm(plane.normal)[grid.shape_xyz[plane.normal] // 2]
            place = f"{right}-{up} at {style.AXIS_NAMES[plane.normal]} = {middle:z.2f} mm"
        image = axes.imshow(values, origin="lower", extent=extent, interpolation="nearest", **scale)
        axes.set(
            xlabel=f"{right} (mm)",
            ylabel=f"{up} (mm)",
            title="\n".join(each for each in (title, place) if each),
            xlim=extent[:2],
            ylim=extent[2:],
            aspect="equal",
        )
        if style.NARROW * (extent[1] - extent[0]) < extent[3] - extent[2]:
            axes.locator_params(axis="x", nbins=1, min_n_ticks=1)
    return image


@dataclass(frozen=True, eq=False)
class MapRow:
    """A row of maps: an array [z, y, x] for each plane, its title, what the colours are called, and their scale."""

    maps: Sequence[NDArray[Any]]
    titles: Sequence[str]
    label: str
    scale: dict[str, Any]


@style.styled
def maps_figure(grid: Grid, rows: Sequence[MapRow]) -> style.Figure:
    """Return rows of maps in the three middle planes, each with the bar of its colours."""
    figure, axes = plane_panels(grid, rows=len(rows))
    for panels, row in zip(axes, rows, strict=True):
        style.colour_bar(figure, draw_maps(panels, grid, row.maps, row.titles, **row.scale), panels[-1], row.label)
    return figure


FLAG_COLOURS = {
    VALID: style.BLUE,
    of_field.SECOND_PEAK: style.SKY_BLUE,
    of_field.REPLACED: style.ORANGE,
    REJECTED: style.VERMILION,
    of_field.MASKED: "0.85",
}
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


def planes_figure(field: VectorField) -> style.Figure:
    """Vectors in the three middle planes. Arrows show the components in the plane, colour the one across it; both have
    one scale in all three. Crosses are vectors that are missing.
    """
    quantity = shown(field)
    return compared_figure(field.grid, {"": quantity.values}, quantity.unit)


@style.styled
def compared_figure(grid: Grid, fields: Mapping[str, Floats], unit: str) -> style.Figure:
    """Return vectors (nz, ny, nx, 3) in the three middle planes, a row for each field, by its name.

    Arrows show the components in the plane and colour the one across it; both have one scale in all. Crosses are
    missing vectors.
    """
    figure, axes = plane_panels(grid, rows=len(fields))
    across = {name: [values[..., plane.normal] for plane in PLANES] for name, values in fields.items()}
    scale = middle_scale(*across.values())
    longest = style.symmetric_limit(
        *(plane.of(values)[..., [plane.right, plane.up]] for values in fields.values() for plane in PLANES)
    )
    step = [-(-n // MOST_ARROWS) for n in grid.shape_xyz]
    spacing = max(spacing * n for spacing, n in zip(grid.spacing_mm, step, strict=True))
    how: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": longest / (ARROW_REACH * spacing)}
    how |= {"units": "inches", "width": ARROW_WIDTH, "pivot": "mid"}
    for row, (name, values) in zip(axes, fields.items(), strict=True):
        components = [style.COMPONENT_NAMES[plane.normal] for plane in PLANES]
        titles = [f"{name}: {component}" if name else component for component in components]
        image = draw_maps(row, grid, across[name], titles, **scale)
        style.colour_bar(figure, image, row[-1], f"component across the plane ({unit})")
        for panel, plane in zip(row, PLANES, strict=True):
            chosen = (slice(None, None, step[plane.up]), slice(None, None, step[plane.right]))
            of_plane = plane.of(values)[chosen]
            right, up = np.meshgrid(grid.axis_mm(plane.right)[chosen[1]], grid.axis_mm(plane.up)[chosen[0]])
            known = np.isfinite(of_plane).all(axis=-1)
            panel.plot(right[~known], up[~known], "x", color=style.GREY, markersize=3)
            along, across_mm = of_plane[known, plane.right], of_plane[known, plane.up]
            arrows = panel.quiver(right[known], up[known], along, across_mm, **how)
    figure.suptitle(" ")  # room for the arrow that shows the scale
    length = float(f"{0.7 * longest:.1g}")
    place = 1.0 - 0.25 / figure.get_figheight()
    axes[0, 0].quiverkey(arrows, 0.96, place, length, f"{length:g} {unit}", coordinates="figure", labelpos="W")
    return figure


def speed_unit(*velocities_m_s: Floats) -> tuple[float, str]:
    """Return the unit in which velocities read well: what m/s are multiplied by, and its name."""
    known = any(np.isfinite(each).any() for each in velocities_m_s)
    return (1.0 / MM_TO_M, "mm/s") if known and style.symmetric_limit(*velocities_m_s) < SLOW_M_S else (1.0, "m/s")


def components_figure(field: VectorField) -> style.Figure:
    """Each velocity component in the three middle planes, a row and a scale for each."""
    quantity = shown(field)
    each = [(name, [quantity.values[..., component]] * 3) for component, name in enumerate(style.COMPONENT_NAMES)]
    rows = [MapRow(maps, [name] * 3, f"{name} ({quantity.unit})", middle_scale(maps)) for name, maps in each]
    return maps_figure(field.grid, rows)


def middle_scale(*rows: Sequence[Floats]) -> dict[str, Any]:
    """Return the colours of rows of three maps, see `style.scale_of`: by what the middle planes show."""
    return style.scale_of(*(plane.of(values) for maps in rows for plane, values in zip(PLANES, maps, strict=True)))


@style.styled
def profiles_figure(field: VectorField) -> style.Figure:
    """Means of each component over the planes across each axis. The band is the stated standard deviation of one vector
    to both sides.

    The band is an rms over the plane, drawn where it is known.
    """
    quantity = shown(field)
    figure, axes = style.new_panels(10.0, 7.5, 3, 3, sharey="row", sharex="col")
    for (component, axis), panel in np.ndenumerate(axes):
        others = tuple(k for k in range(3) if k != 2 - axis)
        places, colour = field.grid.axis_mm(axis), style.COLOURS[component]
        mean = mean_of_known(quantity.values[..., component], others)
        panel.axhline(0.0, color=style.GREY, linewidth=0.8)
        panel.plot(places, mean, "o-", color=colour)
        if quantity.sigma is not None:
            sigma = np.sqrt(mean_of_known(quantity.sigma[..., component] ** 2, others))
            band: dict[str, Any] = {"color": colour, "alpha": 0.25, "linewidth": 0.0}
            panel.fill_between(places, mean - sigma, mean + sigma, label="± σ of one vector", **band)
    for k in range(3):
        axes[k, 0].set_ylabel(f"{style.COMPONENT_NAMES[k]} ({quantity.unit}), mean over the plane")
        axes[-1, k].set_xlabel(f"{style.AXIS_NAMES[k]} (mm)")
    if quantity.sigma is not None:
        axes[0, 0].legend()
    return figure


@style.styled
def series_figure(names: Sequence[str], mean_m_s: Floats, sigma_m_s: Floats) -> style.Figure:
    """The mean velocity of each pair in their order. The band is the usual stated standard deviation of one vector to
    both sides.

    `mean_m_s` and `sigma_m_s` (n, 3) are of `names`, the first and the last of which are told.
    """
    figure, panels = style.new_panels(10.0, 5.5, 3, 1, sharex=True)
    numbers = np.arange(1, len(names) + 1)
    for component, panel in enumerate(panels):
        mean, sigma, colour = mean_m_s[:, component], sigma_m_s[:, component], style.COLOURS[component]
        panel.plot(numbers, mean, "o-", color=colour)
        panel.fill_between(numbers, mean - sigma, mean + sigma, color=colour, alpha=0.25, linewidth=0.0, label="± σ")
        panel.set_ylabel(f"{style.COMPONENT_NAMES[component]} (m/s)")
    panels[0].legend()
    panels[-1].xaxis.get_major_locator().set_params(integer=True)
    panels[-1].set_xlabel(f"pair, from {names[0]} to {names[-1]}")
    return figure


def mean_of_known(values: Floats, axes: tuple[int, ...]) -> Floats:
    """Return means over axes of what is finite, NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=axes)
    mean = np.full(count.shape, np.nan)
    np.divide(np.where(known, values, 0.0).sum(axis=axes), count, out=mean, where=count > 0)
    return mean


def sigma_figure(field: VectorField) -> style.Figure:
    """Stated standard deviation of each component in the three middle planes, all on one logarithmic scale.

    Outer ones take the colours of the scale's ends.

    Raises
    ------
    ValueError : the field does not know it
    """
    from matplotlib.colors import LogNorm

    quantity = shown(field)
    if quantity.sigma is None:
        raise ValueError("the field states no uncertainty")
    known = quantity.sigma[np.isfinite(quantity.sigma) & (quantity.sigma > 0.0)]
    low, high = np.percentile(known, SCALE_PERCENT) if known.size else (0.1, 1.0)
    if low == high:
        low, high = 0.5 * low, 2.0 * high
    label = f"stated standard deviation ({quantity.unit})"
    scale = {"cmap": style.SEQUENTIAL, "norm": LogNorm(low, high)}
    rows = [
        MapRow([quantity.sigma[..., component]] * 3, [f"σ of {name}"] * 3, label, scale)
        for component, name in enumerate(style.COMPONENT_NAMES)
    ]
    return maps_figure(field.grid, rows)


@style.styled
def flags_figure(field: VectorField) -> style.Figure:
    """Where vectors are valid, taken from a second peak, replaced by their neighbours, rejected or masked."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.patches import Patch

    figure, axes = plane_panels(field.grid)
    colours = ListedColormap([FLAG_COLOURS[flag] for flag in sorted(FLAG_COLOURS)])
    norm = BoundaryNorm(np.arange(len(FLAG_COLOURS) + 1) - 0.5, len(FLAG_COLOURS))
    draw_maps(axes[0], field.grid, [field.flag] * 3, [""] * 3, cmap=colours, norm=norm)
    counts = field.flag_counts
    patches = [
        Patch(facecolor=FLAG_COLOURS[flag], edgecolor="0.3", label=f"{name}: {counts[name]}")
        for flag, name in of_field.FLAG_NAMES.items()
        if counts[name]
    ]
    figure.legend(handles=patches, loc="outside lower center", ncols=len(patches), title="vectors in the whole field")
    return figure


def quality_figure(field: VectorField, names: dict[str, Floats]) -> style.Figure:
    """Return maps of quantities [z, y, x] that tell how good vectors are (rows), each on its own scale."""
    each = ((name, [values] * 3) for name, values in names.items())
    return maps_figure(field.grid, [MapRow(maps, [""] * 3, name, middle_scale(maps)) for name, maps in each])


@style.styled
def displacements_figure(field: VectorField, lens_mm: float | None = None) -> style.Figure:
    """Displacements of the valid vectors, and what they are beyond whole voxels and, where the camera is known, whole
    microlenses: crowded about zero where they lock.

    Volumes lock to whole microlenses: `lens_mm` is their width in the scene.
    """
    units = {"voxels": np.ones(3)}
    if lens_mm is not None:
        units["microlenses"] = lens_mm / np.asarray(field.voxel_mm)
    figure, axes = style.new_panels(10.0, 2.6 * (1 + len(units)), 1 + len(units), 3)
    valid = field.displacement_voxel[field.flag == VALID]
    for component, column in enumerate(axes.T):
        values = valid[np.isfinite(valid[:, component]), component]
        name, colour = style.COMPONENT_NAMES[component], style.COLOURS[component]
        column[0].hist(values, bins=HISTOGRAM_BARS, color=colour)
        column[0].set(xlabel=f"displacement {name} (voxel)", ylabel="valid vectors")
        for panel, (unit, size) in zip(column[1:], units.items(), strict=True):
            parts = values / size[component]
            panel.hist(parts - np.round(parts), bins=PART_BARS, range=(-0.5, 0.5), color=colour)
            panel.axhline(parts.size / PART_BARS, color="black", linestyle="--", linewidth=0.9, label="evenly spread")
            panel.set(xlabel=f"{name} beyond whole {unit} ({unit})", ylabel="valid vectors", xlim=(-0.5, 0.5))
            panel.legend()
    return figure


def gradients_figure(field: VectorField) -> style.Figure:
    """Vorticity across the three middle planes, and the divergence, which is zero in a liquid: what it shows is the
    noise of gradients. One scale for both.

    Raises
    ------
    ValueError : the field has no time
    """
    if field.dt_s is None:
        raise ValueError("rates need a time between the frames")
    derived = derived_fields(field)
    across = [derived.vorticity[..., plane.normal] for plane in PLANES]
    names = [f"vorticity along {style.AXIS_NAMES[plane.normal]}" for plane in PLANES]
    # One scale for both: the divergence, which should be zero, tells how much of the vorticity is noise.
    scale = middle_scale(across, [derived.divergence] * 3)
    rows = [(across, names), ([derived.divergence] * 3, ["divergence"] * 3)]
    return maps_figure(field.grid, [MapRow(maps, titles, "1/s", scale) for maps, titles in rows])


# A reconstructed volume [z, y, x], and weights: where a voxel's light falls, and how much by depth.

# The scale of projections ends where so many (%) of their values lie within.
BRIGHT_PERCENT = 99.8


@style.styled
def column_figure(pixels: tuple[Integers, Integers], weights: Singles, pixel_mm: float, title: str) -> style.Figure:
    """Return one voxel's column as the sensor would see it, against pixels' numbers and mm on the sensor.

    Parameters
    ----------
    pixels : rows and columns of the pixels that the voxel lights, one weight each
    """
    rows, columns = pixels
    picture = np.zeros((int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1))
    picture[rows - rows.min(), columns - columns.min()] = weights
    left, right, top, bottom = columns.min() - 0.5, columns.max() + 0.5, rows.min() - 0.5, rows.max() + 0.5
    figure, axis = style.new_panels(6.8, 6.0)
    image = axis.imshow(picture, cmap="gray", extent=(left, right, bottom, top), interpolation="nearest")
    figure.colorbar(image, ax=axis, label="weight (share of the voxel's light)", location="bottom", shrink=0.8)
    axis.set(xlabel="column (px)", ylabel="row (px)")
    beside = "mm, from the first pixel lit"
    axis.secondary_xaxis("top", functions=_to_mm(left, pixel_mm)).set_xlabel(beside)
    axis.secondary_yaxis("right", functions=_to_mm(top, pixel_mm)).set_ylabel(beside)
    figure.suptitle(title)
    return figure


def _to_mm(first_px: float, pixel_mm: float) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    """Return the conversions from pixels to mm from a place, and back."""
    return lambda px: (px - first_px) * pixel_mm, lambda mm: mm / pixel_mm + first_px


@style.styled
def light_figure(z_mm: Floats, sums: Mapping[str, Floats]) -> style.Figure:
    """Return by depth how much of a voxel's light meets the sensor, for voxels at some lateral places."""
    figure, axes = style.new_panels(6.5, 3.8)
    for (name, values), colour, marker in zip(sums.items(), style.COLOURS, style.MARKERS, strict=False):
        axes.plot(z_mm, values, f"{marker}-", color=colour, markerfacecolor="none", label=name)
    highest = max((float(values.max()) for values in sums.values()), default=1.0)
    axes.set(xlabel=style.DEPTH_LABEL, ylabel="sum of a voxel's weights (1)", ylim=(0.0, 1.05 * highest or 1.0))
    axes.legend()
    return figure


@style.styled
def projections_figure(volume: Singles, grid: Grid) -> style.Figure:
    """The brightest voxel along each line of sight, in the three directions, on one scale."""
    figure, axes = plane_panels(grid)
    # Along an axis that a plane is across, nothing is left but the plane.
    seen = [volume.max(axis=2 - plane.normal) for plane in PLANES]
    limit = float(np.percentile(np.concatenate([each.ravel() for each in seen]), BRIGHT_PERCENT)) or 1.0
    titles = [f"largest along {style.AXIS_NAMES[plane.normal]}" for plane in PLANES]
    image = draw_maps(axes[0], grid, seen, titles, cmap="inferno", vmin=0.0, vmax=limit)
    style.colour_bar(figure, image, axes[0, -1], "intensity (1)", extend="max")
    return figure


@style.styled
def depths_figure(volume: Singles, grid: Grid) -> style.Figure:
    """The mean intensity of each plane by depth."""
    figure, axes = style.new_panels(6.0, 3.6)
    axes.plot(grid.axis_mm(2), volume.mean(axis=(1, 2), dtype=np.float64))
    axes.set(xlabel=style.DEPTH_LABEL, ylabel="mean intensity of the plane (1)", ylim=(0.0, None))
    return figure
