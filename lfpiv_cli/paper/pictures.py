"""Pictures of the report: boards (Figs. 8 to 13), the channel (Figs. 15, 16 and 18), bubbles (Fig. 17).

Functions take a mapping from the name of a way to measure, as it is to be read, to what was measured by it; all are
drawn on one scale, in colours that people with any kind of colour vision tell apart; marks and lines differ as well,
for print in grey. Lengths in the channel are shares of its width from its low wall. The report's flow runs along x; the
paper's x is our y, the other lateral axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Singles
from lfpiv_cli.grid import Grid
from lfpiv_cli.pictures import style
from lfpiv_cli.pictures.vectors import mean_of_known
from lfpiv_cli.validation.flow import PAPER_SLICES, TOLERANCE, Duct, Measured, cumulative_distribution
from lfpiv_cli.validation.methods import slice_at

BOARD_STYLES: tuple[dict[str, Any], ...] = (
    {"color": style.VERMILION, "marker": "s", "linestyle": "--"},
    {"color": style.BLUE, "marker": "o", "linestyle": "-"},
    {"color": style.GREEN, "marker": "^", "linestyle": "-."},
)
BAND = {"color": "#BBBBBB", "alpha": 0.5, "linewidth": 0.0}
# Of a board in three dimensions voxels are shown that are brighter than this share of the brightest: 1/e, as for e_z.
SHOWN_SHARE = float(1.0 / np.e)
# A board is shown in this many times the depth that its dots reach.
SHOWN_DEPTHS = 2.0
# Numbers kept of pictures: as many as a printed page shows.
DECIMALS = 3


def board_view(volume: Singles, grid: Grid) -> dict[str, Floats]:
    """Return a reconstructed board [z, y, x] as it is seen, its brightest voxel 1, rounded as a page shows it.

    Returns
    -------
    dict
        `front` (y, x), the maximum along z; `side` (z, x), the maximum along y; `bounds_mm` (3, 2) of the volume along
        x, y and z; `bright_mm` (n, 3), where voxels are brighter than `SHOWN_SHARE`
    """
    shares = volume / volume.max()
    inside = np.argwhere(shares > SHOWN_SHARE)
    view = {"front": shares.max(axis=0), "side": shares.max(axis=1)}
    view["bounds_mm"] = np.array([grid.bounds_mm(axis) for axis in range(3)])
    view["bright_mm"] = np.stack([grid.axis_mm(axis)[inside[:, 2 - axis]] for axis in range(3)], axis=1)
    return {name: np.asarray(each, np.float64).round(DECIMALS) for name, each in view.items()}


@style.styled
def views_figure(views: Mapping[str, Mapping[str, Floats]]) -> style.Figure:
    """The board in the focal plane (after Fig. 8): the largest intensity along z and along y, and the voxels that are
    brighter than 1/e of the brightest. One scale of intensity.

    A row for each method.
    """
    figure = style.new_figure(11.0, 3.7 * len(views))
    # as much of the depth for each as shows the longest dots and their surroundings
    reach = SHOWN_DEPTHS * max(float(np.abs(view["bright_mm"][:, 2]).max()) for view in views.values())
    for row, (label, view) in enumerate(views.items()):
        x, y, z = ((low, high) for low, high in view["bounds_mm"])
        front, side = (figure.add_subplot(len(views), 3, 3 * row + column) for column in (1, 2))
        drawn = front.imshow(view["front"], origin="lower", extent=(*x, *y), cmap=style.SEQUENTIAL, vmin=0.0, vmax=1.0)
        front.set(title=f"{label}: maximum along z", xlabel="x (mm)", ylabel="y (mm)")
        side.imshow(
            view["side"], origin="lower", extent=(*x, *z), cmap=style.SEQUENTIAL, vmin=0.0, vmax=1.0, aspect="auto"
        )
        side.set(title=f"{label}: maximum along y", xlabel="x (mm)", ylabel="z (mm)", ylim=(-reach, reach))
        space: Any = figure.add_subplot(len(views), 3, 3 * row + 3, projection="3d")
        look: dict[str, Any] = {"cmap": style.SEQUENTIAL, "s": 1.5, "linewidths": 0.0, "rasterized": True}
        space.scatter(*view["bright_mm"].T, c=view["bright_mm"][:, 2], **look)
        space.set(title=f"{label}: brighter than 1/e", xlabel="x (mm)", ylabel="y (mm)", zlabel="z (mm)")
        space.set(zlim=(-reach, reach))
        space.set_box_aspect((1.0, 1.0, 1.2), zoom=0.85)
        _tidy(space)
    figure.colorbar(drawn, ax=figure.axes, shrink=0.5, label="intensity / largest", location="bottom")
    return figure


@style.styled
def elongation_figure(
    methods: Mapping[str, Mapping[str, Any]], paper_mm: tuple[float, float], paper_sigma_mm: float
) -> style.Figure:
    """Return the elongation of dots and its spread by depth (Figs. 9 and 12).

    Parameters
    ----------
    methods : what `board_figures` returns
    paper_mm : lowest and highest elongation that the paper has
    paper_sigma_mm : what its spread stays below
    """
    figure, (length, spread) = style.new_panels(10.0, 3.8, 1, 2)
    length.axhspan(*paper_mm, label=f"paper: {paper_mm[0]:g} to {paper_mm[1]:g} mm", **BAND)
    spread.axhspan(0.0, paper_sigma_mm, label=f"paper: below {paper_sigma_mm:g} mm", **BAND)
    for (label, figures), look in zip(methods.items(), BOARD_STYLES, strict=False):
        table = figures["by_depth"]
        length.plot(table["depth_mm"], table["elongation_mm"], label=label, **look)
        spread.plot(table["depth_mm"], table["elongation_sigma_mm"], label=label, **look)
    length.set(title="mean over the dots", ylabel="elongation $e_z$ (mm)", ylim=(0.0, None))
    spread.set(title="standard deviation over the dots", ylabel=r"$\sigma$ (mm)", ylim=(0.0, None))
    _finish(length, spread)
    for panel in (length, spread):
        panel.legend(fontsize=8)
    return figure


@style.styled
def location_figure(
    methods: Mapping[str, Mapping[str, Any]], spacing_mm: float, paper_steps_mm: tuple[float, float] | None
) -> style.Figure:
    """Return lateral and depth separations and their errors by depth (Figs. 11 and 13).

    Parameters
    ----------
    methods : what `board_figures` returns
    spacing_mm : x_g of Eq. 19
    paper_steps_mm : shortest and longest depth separation that the paper has, where it says
    """
    figure, ((lateral, depth), (lateral_error, depth_error)) = style.new_panels(10.0, 6.6, 2, 2)
    lateral.axhline(spacing_mm, color="black", linewidth=0.8, label="true")
    depth.axhline(1.0, color="black", linewidth=0.8, label="true")
    if paper_steps_mm is not None:
        depth.axhspan(*paper_steps_mm, label="paper: separations of {:g} to {:g} mm".format(*paper_steps_mm), **BAND)
    for (label, figures), look in zip(methods.items(), BOARD_STYLES, strict=False):
        table = figures["by_depth"]
        at, spacing = np.array(table["depth_mm"]), np.array(table["spacing_mm"])
        middle, steps = 0.5 * (at[1:] + at[:-1]), np.diff(table["centre_mm"]) / np.diff(at)
        lateral.plot(at, spacing, label=label, **look)
        depth.plot(middle, steps, label=label, **look)
        lateral_error.plot(at, 100.0 * np.abs(spacing - spacing_mm) / spacing_mm, label=label, **look)
        depth_error.plot(middle, 100.0 * np.abs(steps - 1.0), label=label, **look)
    # a spacing that is right within a hundredth of a per cent is to look so
    reach = max(0.01 * spacing_mm, 1.2 * float(np.abs(np.subtract(lateral.get_ylim(), spacing_mm)).max()))
    lateral.set(title="lateral spacing", ylabel="mm", ylim=(spacing_mm - reach, spacing_mm + reach))
    depth.set(title="separation of neighbouring boards in depth", ylabel="measured / true")
    lateral_error.set(title=r"lateral error $\delta_x$", ylabel="%", ylim=(0.0, None))
    depth_error.set(title=r"depth error $\delta_z$", ylabel="%", ylim=(0.0, None))
    _finish(lateral, depth, lateral_error, depth_error)
    # below the panels: in them it would hide the largest errors
    figure.legend(*depth.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure


@style.styled
def centres_figure(centres_mm: Mapping[str, Floats]) -> style.Figure:
    """Centres of all dots of all boards (after Fig. 10).

    Centres are (n, 3) for each method, coloured by depth.
    """
    figure = style.new_figure(5.2 * len(centres_mm) + 0.8, 4.2)
    deepest = max(float(np.abs(each[:, 2]).max()) for each in centres_mm.values())
    for number, (label, each) in enumerate(centres_mm.items(), start=1):
        space: Any = figure.add_subplot(1, len(centres_mm), number, projection="3d")
        # depth along the page, as the boards were moved
        look: dict[str, Any] = {"cmap": style.SEQUENTIAL, "vmin": -deepest, "vmax": deepest, "s": 6.0}
        drawn = space.scatter(each[:, 2], each[:, 0], each[:, 1], c=each[:, 2], **look)
        space.set(title=label, xlabel="z (mm)", ylabel="x (mm)", zlabel="y (mm)")
        space.set_box_aspect((2.0, 1.0, 1.0), zoom=1.1)
        _tidy(space)
    figure.colorbar(drawn, ax=figure.axes, shrink=0.6, label="measured depth z (mm)", location="bottom")
    return figure


def _finish(*panels: style.Axes) -> None:
    for panel in panels:
        panel.set_xlabel("z (mm)")
        panel.grid(alpha=0.3)


def _tidy(space: Any) -> None:
    """Keep the numbers of a three-dimensional drawing readable."""
    space.tick_params(labelsize=7, pad=0)
    space.locator_params(nbins=5)


WAY_STYLES = ((style.VERMILION, "s", "--"), (style.BLUE, "o", "-."), (style.GREEN, "^", "-"), (style.PURPLE, "v", ":"))


@style.styled
def slice_maps_figure(methods: Mapping[str, Measured], duct: Duct) -> style.Figure:
    """Size of the velocity in the paper's slices (after Fig. 15), one colour scale: across the depth at z/D = 0.3,
    0.54, 0.78, and across x at x/D = 0.24, 0.48, 0.72. Columns are slices, rows are ways to measure.

    The first row is the truth.
    """
    first = next(iter(methods.values()))
    rows = {"true": (first, first.truth)} | {name: (m, m.field.velocity) for name, m in methods.items()}
    highest = max(float(np.linalg.norm(m.truth[m.inside], axis=-1).max()) for m in methods.values())
    figure, axes = style.new_panels(13.0, 2.3 * len(rows) + 0.6, len(rows), 6, squeeze=False, sharey=True)
    look: dict[str, Any] = {"vmin": 0.0, "vmax": highest, "cmap": style.SEQUENTIAL, "aspect": "auto"}
    for row, (name, (measured, velocity)) in zip(axes, rows.items(), strict=True):
        low, high = measured.field.grid.bounds_mm(0)
        speed = np.where(measured.inside, np.linalg.norm(velocity, axis=-1), np.nan)
        places = [(k, axis, share) for k, axis in duct.across.items() for share in PAPER_SLICES[k]]
        for panel, (key, axis, share) in zip(row, places, strict=True):
            # of what is left of [z, y, x] the flow's axis goes up, as the paper has it, counted from the first window
            shown = slice_at(speed, measured.field.grid.axis_mm(axis), duct.position_mm(axis, share), axis).T
            ends = _as_shares(np.array(measured.field.grid.bounds_mm(3 - axis)), duct, 3 - axis)
            extent = (float(ends[0]), float(ends[1]), 0.0, (high - low) / duct.width_mm)
            image = panel.imshow(shown, origin="lower", extent=extent, **look)
            panel.set(xlabel=f"{'z' if axis == 1 else 'x'}/D", title=f"{key} = {share}")
        row[0].set_ylabel(f"{name}\ny/D, along the flow")
    figure.colorbar(image, ax=axes, label="size of the velocity (m/s)", shrink=0.8)
    return figure


@style.styled
def cumulative_figure(methods: Mapping[str, Measured]) -> style.Figure:
    """Share of all vectors that err by less than what the axis says (after Fig. 18): in the velocity along the flow, as
    the paper has it, and in the whole vector, depth included.
    """
    figure, panels = style.new_panels(10.0, 4.2, 1, 2, sharey=True)
    for (name, m), (colour, _, line) in zip(methods.items(), WAY_STYLES, strict=False):
        shares = cumulative_distribution(m.pairs)
        errors = 100.0 * np.array(shares["relative_error"])
        for axes, key in zip(panels, ("streamwise_share", "vector_share"), strict=True):
            axes.plot(errors, 100.0 * np.array(shares[key], dtype=np.float64), line, color=colour, label=name)
    panels[0].plot([100.0 * TOLERANCE], [75.0], "k*", markersize=9, label="paper: more than 75 %")
    for axes, what in zip(panels, ("the velocity along the flow", "the whole vector"), strict=True):
        axes.axvline(100.0 * TOLERANCE, color="0.4", linewidth=0.8)
        axes.set(xlabel=f"relative error of {what} (%)", xlim=(0.0, 100.0), ylim=(0.0, 101.0))
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("share of the vectors (%)")
    panels[0].legend(loc="lower right")
    return figure


def _as_shares(places_mm: Floats, duct: Duct, axis: int) -> Floats:
    """Return places along an axis as shares of the width from the low wall."""
    return np.asarray((places_mm - duct.position_mm(axis, 0.0)) / duct.width_mm)


# The paper sees velocities that are too small beyond this share of the channel's width.
PAPERS_WALL = 0.8
CASE_STYLES = ((style.BLUE, "o"), (style.VERMILION, "s"), (style.GREEN, "^"), (style.PURPLE, "v"), (style.ORANGE, "D"))


@style.styled
def raw_figure(image: Singles, mask: Flags) -> style.Figure:
    """A piece of a raw image with bubbles on the wall (after Fig. 17), and what the mask leaves out: pixels that are in
    both images brighter than anything that moves, and those within one microlens of them.
    """
    figure, panels = style.new_panels(10.0, 10.0 * 0.5 * image.shape[0] / image.shape[1] + 1.0, 1, 2)
    highest = float(np.percentile(image[~mask], 99.9)) if not mask.all() else float(image.max())
    for axes, title in zip(panels, ("raw image", "left out by the mask"), strict=True):
        shown = axes.imshow(np.sqrt(np.clip(image, 0.0, highest)), cmap="gray", vmin=0.0, interpolation="nearest")
        axes.set(xlabel="column (px)", ylabel="row (px)", title=title)
    axes.imshow(np.where(mask, 1.0, np.nan), cmap="autumn", alpha=0.6, interpolation="nearest")
    bar = figure.colorbar(shown, ax=figure.axes, shrink=0.8, label="counts, root scale")
    ticks = np.linspace(0.0, np.sqrt(highest), 4)
    bar.set_ticks(list(ticks), labels=[f"{tick**2:.0f}" for tick in ticks])
    return figure


@style.styled
def plane_figure(methods: Mapping[str, Measured], duct: Duct, plane: int) -> style.Figure:
    """Return vectors and the error of the velocity along the flow in one x-y plane of windows, by way to measure."""
    axis = duct.across["x/D"]
    highest = float(next(iter(methods.values())).truth[..., 0].max())
    figure, axes = style.new_panels(
        3.2 * len(methods) + 1.0, 8.2, 2, len(methods), squeeze=False, sharex=True, sharey=True
    )
    for column, (name, m) in zip(axes.T, methods.items(), strict=True):
        along, across = np.meshgrid(*(m.field.grid.axis_mm(k) for k in (0, axis)))
        shares = _as_shares(across, duct, axis)
        u, v = m.field.velocity[plane][..., 0], m.field.velocity[plane][..., axis]
        look: dict[str, Any] = {
            "cmap": style.SEQUENTIAL,
            "clim": (0.0, highest),
            "scale": 12.0 * highest,
            "width": 0.008,
        }
        arrows = column[0].quiver(along, shares, u, v, u, **look)
        error, reach = u - m.truth[plane][..., 0], 0.5 * highest
        image = column[1].pcolormesh(along, shares, error, cmap=style.DIVERGING, vmin=-reach, vmax=reach)
        column[0].set(title=name)
        column[1].set(xlabel="x, along the flow (mm)")
        for panel in column:
            panel.axhline(PAPERS_WALL, color="0.4", linewidth=0.8, linestyle="--")
    for panel in axes[:, 0]:
        panel.set_ylabel("x/D")
    figure.colorbar(arrows, ax=axes[0], label="velocity along the flow (m/s)")
    figure.colorbar(image, ax=axes[1], label="measured - true (m/s)")
    return figure


@style.styled
def wall_profile_figure(methods: Mapping[str, Measured], duct: Duct) -> style.Figure:
    """Means over flow and depth of the velocity along the flow (after Fig. 16a), and their errors; grey is where the
    paper's velocities are too small.
    """
    figure, (left, right) = style.new_panels(10.0, 4.2, 1, 2)
    axis = duct.across["x/D"]
    first = next(iter(methods.values()))
    true = _mean_over(first.truth[..., 0], first.inside, axis)
    left.plot(_as_shares(first.field.grid.axis_mm(axis), duct, axis), true, color="black", label="analytic")
    for (name, m), (colour, marker) in zip(methods.items(), CASE_STYLES, strict=False):
        found, places = _mean_over(m.field.velocity[..., 0], m.inside, axis), m.field.grid.axis_mm(axis)
        shares = _as_shares(places, duct, axis)
        left.plot(shares, found, marker, color=colour, markerfacecolor="none", label=name)
        own = _mean_over(m.truth[..., 0], m.inside, axis)
        right.plot(shares, 100.0 * (found / own - 1.0), marker + "-", color=colour, label=name)
    left.set(xlabel="x/D", ylabel="velocity along the flow, mean of the plane (m/s)")
    right.set(xlabel="x/D", ylabel="its error (%)")
    right.axhline(0.0, color="0.6", linewidth=0.8)
    for panel in (left, right):
        panel.axvspan(PAPERS_WALL, 1.0, color="0.9", zorder=0)
        panel.grid(alpha=0.3)
    left.legend(fontsize=8)
    return figure


def _mean_over(values: Floats, inside: Flags, axis: int) -> Floats:
    """Return the means (n,) over planes across an axis (0 for x) of values [z, y, x], of what is known inside."""
    return mean_of_known(np.where(inside, values, np.nan), tuple(k for k in range(3) if k != 2 - axis))
