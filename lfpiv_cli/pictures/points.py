"""Figures of particles and tracks, lines that a reader can turn, and statistics over many pairs of these or vectors.

Axes: points (n, 3) in mm; images [row, column]; covariances (n, 6) as xx, yy, zz, xy, yz, xz. plotly is imported
inside, as it is an optional extra and slow to load; its JavaScript, 4.5 MB, goes into the page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.flow.statistics import PAIRS, STRESSES
from lfpiv_cli.flow.windows import Walls
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.pictures import style
from lfpiv_cli.pictures.vectors import PLANES, speed_unit

Arrays = Mapping[str, NDArray[Any]]
# A panel of a plane, in inches: its width, the least and largest height, and what titles and labels take.
PANEL_WIDTH, LEAST_PANEL, LARGEST_PANEL, MARGIN = 2.5, 1.2, 4.0, 0.65


@style.styled
def _plane_figure(grid: Grid, rows: Sequence[tuple[str, Sequence[str], Sequence[Floats]]]) -> Any:
    """Return rows of three maps in the middle plane that has most nodes; each row has its label and one scale."""
    plane = max(PLANES, key=lambda each: grid.shape_xyz[each.right] * grid.shape_xyz[each.up])
    left, right, low, high = plane.extent(grid)
    tall = float(np.clip(PANEL_WIDTH * (high - low) / (right - left), LEAST_PANEL, LARGEST_PANEL)) + MARGIN
    figure, axes = style.new_panels(3.0 * PANEL_WIDTH + 2.4, len(rows) * tall + 0.4, len(rows), 3, squeeze=False)
    for panels, (label, titles, maps) in zip(axes, rows, strict=True):
        shown = [plane.of(values) for values in maps]
        limit = style.symmetric_limit(*shown)
        scale: dict[str, Any] = {"cmap": style.DIVERGING, "vmin": -limit, "vmax": limit}
        if all(np.nanmin(values, initial=0.0) >= 0.0 for values in shown):
            scale = {"cmap": style.SEQUENTIAL, "vmin": 0.0, "vmax": limit}
        for panel, title, values in zip(panels, titles, shown, strict=True):
            image = panel.imshow(values, origin="lower", extent=plane.extent(grid), interpolation="nearest", **scale)
            panel.set(title=title, xlabel=f"{style.AXIS_NAMES[plane.right]} (mm)", aspect="equal")
        panels[0].set_ylabel(f"{style.AXIS_NAMES[plane.up]} (mm)")
        figure.colorbar(image, ax=panels.tolist(), label=label)
    place = grid.axis_mm(plane.normal)[grid.shape_xyz[plane.normal] // 2]
    figure.suptitle(f"plane at {style.AXIS_NAMES[plane.normal]} = {place:z.2f} mm")
    return figure


def moments_figure(grid: Grid, velocity: Floats, arrays: Arrays) -> style.Figure:
    """Mean velocity, rms of its fluctuations (noise included), and standard error of the mean, in the middle plane that
    has most vectors; each row on one scale.
    """
    factor, unit = speed_unit(velocity)
    rows = []
    for what, values in (("mean", velocity), ("rms", arrays["velocity_rms"]), ("σ of mean", arrays["velocity_sigma"])):
        maps = [factor * values[..., k] for k in range(3)]
        rows.append((f"{what} ({unit})", [f"{what} of {name}" for name in style.COMPONENT_NAMES], maps))
    return _plane_figure(grid, rows)


def stresses_figure(grid: Grid, arrays: Arrays) -> style.Figure:
    """The Reynolds stresses without noise in the middle plane that has most vectors: normal ones, then shear stresses,
    each row on one scale. Where noise was more than all scatter, a normal stress is negative.
    """
    factor, unit = speed_unit(arrays["velocity_rms"])
    rows = []
    for names in (STRESSES[:3], STRESSES[3:]):
        maps = [factor**2 * arrays[f"reynolds_stress_{name}"] for name in names]
        rows.append((f"stress ({unit})²", [f"<{name[0]}'{name[1]}'>" for name in names], maps))
    return _plane_figure(grid, rows)


@style.styled
def profile_figure(along: str, components: Sequence[str], arrays: Arrays) -> style.Figure:
    """The profile: mean velocity, normal and shear stresses, bars of one standard error. Filled marks are without
    noise, dashed lines with it.
    """
    factor, unit = speed_unit(arrays["velocity"])
    finer, small = speed_unit(arrays["velocity_rms"])
    at, stress = arrays["at_mm"], finer**2 * arrays["reynolds_stress"]
    sigma, raw = (finer**2 * arrays[f"reynolds_stress_{what}"] for what in ("sigma", "with_noise"))
    figure, axes = style.new_panels(11.0, 3.8, 1, 3)
    for k, name in enumerate(components):
        how: dict[str, Any] = {"color": style.COLOURS[k], "marker": style.MARKERS[k], "capsize": 2.0}
        mean, error = (factor * arrays[what][:, k] for what in ("velocity", "velocity_sigma"))
        axes[0].errorbar(at, mean, error, label=name, **how)
        for panel, row in ((axes[1], k), (axes[2], 3 + k)):
            known, pair = np.isfinite(stress[:, row]), [f"{components[each]}'" for each in PAIRS[row]]
            panel.errorbar(at[known], stress[known, row], sigma[known, row], label=f"<{' '.join(pair)}>", **how)
            panel.plot(at, raw[:, row], "--", color=style.COLOURS[k], linewidth=0.9)
    labels = f"mean ({unit})", f"normal stress ({small})²", f"shear stress ({small})²"
    for panel, label in zip(axes, labels, strict=True):
        panel.axhline(0.0, color=style.GREY, linewidth=0.8)
        panel.set(xlabel=f"{along} (mm)", ylabel=label)
        panel.legend()
    return figure


DECADE = 10.0


@style.styled
def convergence_figure(pairs: Integers, velocity: Floats, stress: Floats) -> style.Figure:
    """Convergence: by how much means and stresses of so many pairs scatter, rms over all places; of all pairs, the
    standard errors. Dashed: as one over the square root of the number of pairs. Groups within the flow's memory scatter
    less.
    """
    factor, unit = speed_unit(velocity)
    figure, axes = style.new_panels(8.4, 3.6, 1, 2)
    products = [f"<{name[0]}'{name[1]}'>" for name in STRESSES]
    each = (
        (axes[0], factor * velocity, style.COMPONENT_NAMES, f"scatter of means ({unit})"),
        (axes[1], factor**2 * stress, products, f"scatter of stresses ({unit})²"),
    )
    for panel, values, names, label in each:
        for k, name in enumerate(names):
            colour, marker = style.COLOURS[k], style.MARKERS[k]
            panel.plot(pairs, values[:, k], marker, color=colour, label=name, markerfacecolor="none")
            panel.plot(pairs, values[-1, k] * np.sqrt(pairs[-1] / pairs), "--", color=colour, linewidth=0.8)
        panel.set(xlabel="pairs", ylabel=label, xscale="log", yscale="log", xticks=pairs, xticklabels=pairs)
        panel.tick_params(axis="x", which="minor", bottom=False, labelbottom=False)
        panel.yaxis.set_major_formatter("{x:g}")
        low, high = panel.get_ylim()
        # Over several decades the labels between would lie on each other.
        panel.yaxis.set_minor_formatter("{x:g}" if high < DECADE * low else "")
        panel.legend(ncols=2)
    return figure


# Of an image's values: the scale ends where so many (%) lie within, single hot pixels beyond it.
IMAGE_PERCENT = 99.5
# chi2 beyond this is drawn in the last bar.
LARGEST_CHI2 = 5.0
CHI2_BARS = 50
# The area of all dots on an image, and the smallest and largest of one, in square points: many must not hide it.
DOTS_AREA, DOT_SIZES = 15_000.0, (6.0, 26.0)
# Width of pictures with an image, in inches, and the image's share of it beside labels and the bar of colours.
IMAGE_WIDTH, IMAGE_SHARE = 10.0, 0.75


def places_px(focal_point_mm: Floats, camera: Camera, media: Media, scene: CurvedSpace | None) -> Floats:
    """Return where rays through the middle of the main lens meet the sensor, (n, 2) as (column, row).

    Parameters
    ----------
    focal_point_mm : (n, 3) points, z from the nominal focal point
    scene : faces that their rays cross, NaN where one is not seen; None for plane windows, where they are paraxial
    """
    points = camera.to_image_axes(focal_point_mm)
    if scene is None:
        slopes = -points[:, :2] / equivalent_object_distance(points[:, 2:], camera.focus_distance_mm, media)
    else:
        slopes, seen = scene.slopes(camera, points, np.zeros((len(points), 2)))
        slopes[~seen] = np.nan
    return camera.mm_to_px(camera.image_distance_mm * slopes * camera.micro_image_scale)


@style.styled
def places_figure(position_mm: Floats, light_counts: Floats) -> style.Figure:
    """The particles from the front and from the side, coloured by their light."""
    from matplotlib.colors import LogNorm

    lit = light_counts > 0.0
    norm = LogNorm(*np.percentile(light_counts[lit], (2.0, 98.0))) if lit.sum() > 1 else None
    figure, panels = style.new_panels(IMAGE_WIDTH, 4.6, 1, 2)
    how: dict[str, Any] = {"s": 6, "cmap": style.SEQUENTIAL, "norm": norm, "linewidths": 0}
    for axes, up in zip(panels, (1, 2), strict=True):
        dots = axes.scatter(position_mm[lit, 0], position_mm[lit, up], c=light_counts[lit], **how)
        axes.set(xlabel="x (mm)", ylabel=f"{style.AXIS_NAMES[up]} (mm)", aspect="equal")
    style.colour_bar(figure, dots, panels[-1], "light of a particle (counts)")
    figure.suptitle(f"{len(position_mm)} particles, from the front and from the side")
    return figure


@style.styled
def image_figure(image: Floats, places: Floats, z_mm: Floats) -> style.Figure:
    """The raw image, and where rays through the middle of the main lens (as the config has it) meet the sensor.

    Places (n, 2) are (column, row).
    """
    figure, axes = _image_canvas(image)
    axes.imshow(image, cmap="gray", vmin=0.0, vmax=_bright(image), interpolation="nearest")
    size = float(np.clip(DOTS_AREA / max(len(z_mm), 1), *DOT_SIZES))
    how: dict[str, Any] = {"cmap": style.SEQUENTIAL, "edgecolors": "white", "linewidths": 0.5}
    dots = axes.scatter(places[:, 0], places[:, 1], c=z_mm, s=size, **how)
    rows, columns = image.shape
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5))
    style.colour_bar(figure, dots, axes, "depth z (mm)")
    axes.set_title(f"image and {len(z_mm)} particles (rays through the middle of the lens)")
    return figure


@style.styled
def residual_figure(residual: Floats) -> style.Figure:
    """What the particles leave of the image: red is light that none explains, blue is too much light."""
    figure, axes = _image_canvas(residual)
    limit = _bright(residual)
    shown = axes.imshow(residual, cmap=style.DIVERGING, vmin=-limit, vmax=limit, interpolation="nearest")
    style.colour_bar(figure, shown, axes, "image less particles (counts)")
    axes.set_title(f"residual, rms {written(np.sqrt(np.mean(residual**2)))} counts")
    return figure


def _image_canvas(image: Floats) -> tuple[style.Figure, Any]:
    """Return a figure of an image's shape, and its axes, which are the image's pixels."""
    rows, columns = image.shape
    figure, axes = style.new_panels(IMAGE_WIDTH, min(max(IMAGE_SHARE * IMAGE_WIDTH * rows / columns + 0.8, 3.0), 12.0))
    axes.set(xlabel="column (px)", ylabel="row (px)")
    return figure, axes


def _bright(image: Floats) -> float:
    """Return where the scale of an image ends."""
    limit = float(np.percentile(np.abs(image), IMAGE_PERCENT))
    return limit if limit > 0.0 else 1.0


@style.styled
def depths_figure(z_mm: Floats, light_counts: Floats, covariance_mm2: Floats) -> style.Figure:
    """By depth: how many particles, their light, and the standard deviations of their places.

    Light by its median and quartiles.
    """
    figure, (counts, light, sigmas) = style.new_panels(11.0, 3.6, 1, 3)
    counts.hist(z_mm, bins=style.slab_edges(z_mm), color=style.BLUE)
    counts.set(xlabel=style.DEPTH_LABEL, ylabel="particles")
    style.draw_medians(light, z_mm, {"light": light_counts}, "light of a particle (counts), median")
    (places, low), (_, high) = (style.percentiles_by_depth(z_mm, light_counts, percent) for percent in (25.0, 75.0))
    light.fill_between(places, low, high, color=style.BLUE, alpha=0.25, label="quartiles")
    light.legend()
    along = {f"along {name}": np.sqrt(covariance_mm2[:, k]) for k, name in enumerate(style.AXIS_NAMES)}
    style.draw_medians(sigmas, z_mm, along, "standard deviation (mm), median")
    return figure


@style.styled
def chi2_figure(chi2: Floats) -> style.Figure:
    """How well the particles explain the light about them: chi2 is about 1 where they explain all of it.

    What is beyond the axis is in the last bar.
    """
    figure, axes = style.new_panels(6.0, 3.6)
    axes.hist(np.minimum(chi2, LARGEST_CHI2), bins=CHI2_BARS, range=(0.0, LARGEST_CHI2), color=style.BLUE)
    axes.axvline(1.0, color=style.VERMILION, linestyle="--", label="all light explained")
    beyond = int(np.count_nonzero(chi2 > LARGEST_CHI2))
    axes.set(xlabel="chi2", ylabel="particles", title=f"median {np.median(chi2):.2f}, {beyond} beyond {LARGEST_CHI2:g}")
    axes.legend()
    return figure


# More lines than this are a solid block.
LINES_DRAWN = 1500
HISTOGRAM_BARS, PROBABILITY_BARS = 40, 25
# Of displacements: the longest drawn is this share of the whole extent, so that all are seen.
LONGEST_SHARE = 0.12


def displacement_lines(position_mm: Floats, displacement_mm: Floats) -> tuple[list[Floats], float]:
    """Return lines (2, 3) of displacements about their middles, and how many times longer than true they are.

    At most LINES_DRAWN, evenly chosen from the list.
    """
    extent = float(np.ptp(position_mm, axis=0).max()) if len(position_mm) else 0.0
    longest = float(np.linalg.norm(displacement_mm, axis=1).max()) if len(position_mm) else 0.0
    stretch = max(1.0, LONGEST_SHARE * extent / longest) if longest > 0.0 else 1.0
    half = 0.5 * stretch * displacement_mm
    return list(np.stack([position_mm - half, position_mm + half], axis=1)), stretch


def trajectory_lines(position_mm: Floats, track: Integers) -> list[Floats]:
    """Return the places (m, 3) of each track in time; rows are ordered by track, then by frame."""
    return np.split(position_mm, np.flatnonzero(np.diff(track)) + 1) if len(track) else []


@style.styled
def space_figure(lines: list[Floats], speed_m_s: Floats, what: str) -> style.Figure:
    """Return lines in space coloured by their speed, the depth to the right; many are thinned out evenly.

    Parameters
    ----------
    lines : (m, 3) each, mm
    speed_m_s : of each line
    what : for the title
    """
    from mpl_toolkits.mplot3d.art3d import Line3DCollection

    every = max(1, -(-len(lines) // LINES_DRAWN))
    chosen, speeds = lines[::every], speed_m_s[::every]
    figure = style.new_figure(8.5, 6.5)
    axes = figure.add_subplot(projection="3d")
    # (z, x, y): the light comes from the right, y points up
    drawn = Line3DCollection([line[:, [2, 0, 1]] for line in chosen], cmap=style.SEQUENTIAL, linewidths=1.0)
    drawn.set_array(speeds)
    limits = style.scale_of(speeds)
    drawn.set_clim(limits["vmin"], limits["vmax"])
    axes.add_collection3d(drawn, autolim=False)
    points = np.concatenate(lines) if lines else np.zeros((1, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    high = np.where(high > low, high, low + 1.0)
    axes.set(xlim=(low[2], high[2]), ylim=(low[0], high[0]), zlim=(low[1], high[1]))
    axes.set(xlabel="z (mm)", ylabel="x (mm)", zlabel="y (mm)")
    axes.set_box_aspect((high - low)[[2, 0, 1]])
    figure.colorbar(drawn, ax=axes, label="speed (m/s)", shrink=0.7)
    axes.set_title(what if every == 1 else f"{what}; one in {every} drawn")
    return figure


@style.styled
def velocities_figure(velocity_m_s: Floats) -> style.Figure:
    """The velocity components."""
    figure, panels = style.new_panels(10.0, 3.2, 1, 3)
    for component, axes in enumerate(panels):
        axes.hist(velocity_m_s[:, component], bins=HISTOGRAM_BARS, color=style.COLOURS[component])
        axes.set(xlabel=f"{style.COMPONENT_NAMES[component]} (m/s)", ylabel="tracks")
    return figure


@style.styled
def links_figure(link_probability: Floats) -> style.Figure:
    """How probable the links are, and how many wrong ones to expect."""
    known = link_probability[np.isfinite(link_probability)]
    figure, axes = style.new_panels(6.0, 3.6)
    axes.hist(known, bins=PROBABILITY_BARS, range=(0.0, 1.0), color=style.BLUE)
    axes.set_yscale("log")
    axes.set_title(f"{known.size} links, {float(np.sum(1.0 - known)):.1f} wrong ones expected")
    axes.set(xlabel="probability that a link is right", ylabel="links", xlim=(0.0, 1.0))
    return figure


@style.styled
def sigma_figure(z_mm: Floats, sigma_m_s: Floats) -> style.Figure:
    """Stated standard deviations of the velocity components by depth, medians."""
    figure, axes = style.new_panels(6.0, 3.6)
    along = {f"σ of {name}": sigma_m_s[:, k] for k, name in enumerate(style.COMPONENT_NAMES)}
    style.draw_medians(axes, z_mm, along, "standard deviation (m/s), median")
    return figure


@style.styled
def lengths_figure(track: Integers) -> style.Figure:
    """How many frames the trajectories span."""
    lengths = np.unique(track, return_counts=True)[1]
    figure, axes = style.new_panels(6.0, 3.6)
    most = int(lengths.max()) if lengths.size else 1
    axes.hist(lengths, bins=(np.arange(most + 1) + 0.5).tolist(), color=style.BLUE, rwidth=0.9)
    axes.set(xlabel="frames in a trajectory", ylabel="trajectories", title=f"{lengths.size} trajectories")
    return figure


# More lines make a page slow to turn.
MOST_LINES = 4000
HEIGHT_PX = 640
# Lines whose stated error is so many times the usual one are faint.
FAINT_SIGMAS, FAINT = 3.0, 0.2
# The colours of speeds reach so far (%), and few odd ones do not stretch them.
SPEED_PERCENT = (1.0, 99.0)
# Of walls: their dots along the longest side, and how far beyond the lines, in that side, they are looked for in depth.
WALL_DOTS, WALL_REACH = 40, 1.0
# Of a box, as a share of its longest side, for how far away it is seen from.
LEAST_SIDE = 0.1
# From where it is seen, as the still picture: depth to the right, y up. A box that is longer than a cube of its
# volume is seen from farther, by this power of it.
FARTHER = 0.6
EYE = np.array([-1.4, 1.05, 1.0])


def has_views() -> bool:
    """Return whether views can be made: plotly is installed."""
    return find_spec("plotly") is not None


def wall_dots(lines: Sequence[Floats], walls: Walls) -> Floats:
    """Return dots (k, 3), mm, on the walls beside lines."""
    points = np.concatenate([np.zeros((0, 3)), *lines])
    if not len(points):
        return points
    low, high = points.min(axis=0), points.max(axis=0)
    longest = float((high - low).max())
    reach = np.array([0.0, 0.0, WALL_REACH * longest])
    return walls.points(low - reach, high + reach, np.full(3, longest / WALL_DOTS))


@dataclass(frozen=True, eq=False)
class Lines:
    """Lines in space.

    Attributes
    ----------
    places_mm : (k, 3) of each
    speed_m_s : (k,) at each place of each
    sigma_m_s : (n,) stated error of each; NaN where none is stated
    """

    places_mm: Sequence[Floats]
    speed_m_s: Sequence[Floats]
    sigma_m_s: Floats


def lines_view(lines: Lines, walls: Walls | None = None, *, name: str = "view", with_script: bool = True) -> str:
    """Return a view of lines coloured by speed, a dot at the end of each, faint ones those of large stated errors.

    Parameters
    ----------
    lines : of more than `MOST_LINES`, some from all over the list are shown
    walls : of the fluid, drawn as dots
    name : unlike that of others on the page, of which the first has the script
    """
    from plotly.graph_objects import Figure, Scatter3d

    count = len(lines.places_mm)
    shown = np.linspace(0, count - 1, min(MOST_LINES, count)).astype(int)
    sigma = lines.sigma_m_s[shown]
    known = sigma[np.isfinite(sigma)]
    is_faint = sigma > FAINT_SIGMAS * (float(np.median(known)) if known.size else 0.0)
    speeds = np.concatenate([np.zeros(0), *(lines.speed_m_s[k] for k in shown)])
    speeds = speeds[np.isfinite(speeds)]
    low, high = np.percentile(speeds, SPEED_PERCENT) if speeds.size else (0.0, 1.0)
    colours = {"colorscale": "Viridis", "cmin": float(low), "cmax": float(high) if high > low else float(low) + 1.0}
    bar = {"title": {"text": "speed (m/s)", "side": "right"}, "len": 0.8, "thickness": 16}
    figure = Figure()
    gap, nothing = np.full((1, 3), np.nan), np.full(1, np.nan)
    for some, opacity in ((shown[~is_faint], 1.0), (shown[is_faint], FAINT)):
        path = np.concatenate([np.zeros((0, 3)), *(part for k in some for part in (lines.places_mm[k], gap))])
        value = np.concatenate([np.zeros(0), *(part for k in some for part in (lines.speed_m_s[k], nothing))])
        ends = np.array([lines.places_mm[k][-1] for k in some]).reshape(-1, 3)
        last = np.array([lines.speed_m_s[k][-1] for k in some])
        # A line has no colour between two places where one is NaN: there the next one's is not seen.
        along = {**colours, "color": np.nan_to_num(value), "width": 3}
        dots = {**colours, "color": last, "size": 2} | ({"colorbar": bar} if opacity == 1.0 else {})
        said = "x %{x:.2f}, y %{y:.2f}, z %{z:.2f} mm<br>%{customdata:.4g} m/s<extra></extra>"
        figure.add_traces(
            [
                Scatter3d(_along_axes(path), mode="lines", line=along, hoverinfo="skip", opacity=opacity),
                Scatter3d(_along_axes(ends), mode="markers", marker=dots, customdata=last, opacity=opacity).update(
                    hovertemplate=said
                ),
            ]
        )
    on_walls = np.zeros((0, 3))
    if walls is not None:
        dots = {"color": "grey", "size": 1.5}
        on_walls = wall_dots(lines.places_mm, walls)
        figure.add_trace(Scatter3d(_along_axes(on_walls), mode="markers", marker=dots, hoverinfo="skip"))
    sides = np.ptp(np.concatenate([*lines.places_mm, on_walls, np.zeros((1, 3))]), axis=0)
    farther = 1.0
    if sides.any():
        farther = (sides.max() / np.prod(np.maximum(sides, LEAST_SIDE * sides.max())) ** (1.0 / 3.0)) ** FARTHER
    axes = {f"{axis}axis": {"title": f"{axis} (mm)"} for axis in "xyz"}
    camera = {"up": {"x": 0, "y": 1, "z": 0}, "eye": _along_axes(farther * EYE)}
    scene = {**axes, "aspectmode": "data", "camera": camera}
    margin = {"l": 0, "r": 0, "t": 30, "b": 0}
    figure.update_layout(scene=scene, height=HEIGHT_PX, showlegend=False, margin=margin)
    how: dict[str, Any] = {"full_html": False, "include_plotlyjs": with_script, "div_id": name}
    return str(figure.to_html(**how, config={"displaylogo": False}))


def _along_axes(points: Floats) -> dict[str, Any]:
    return dict(zip("xyz", points.astype(np.float32).T, strict=True))
