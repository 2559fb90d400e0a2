"""Several measurements of one flow side by side: their figures, and which of them errs less."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from itertools import cycle
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.flow.field import VectorField
from lfpiv_cli.flow.windows import RoundWall
from lfpiv_cli.pictures import style
from lfpiv_cli.pictures.vectors import MapRow, compared_figure, maps_figure, mean_of_known, middle_scale, speed_unit
from lfpiv_cli.validation.flow import INNER, PAPER_SLICES, TOLERANCE, Duct, Measured, cumulative_distribution, table_4


@style.styled
def radius_figure(fields: Mapping[str, VectorField], pipe: RoundWall, mean_velocity_m_s: float) -> style.Figure:
    """Return each component of vectors over their distance from the axis, beside Poiseuille's parabola."""
    figure, panels = style.new_panels(11.0, 4.0, 1, 3)
    radius = np.linspace(0.0, pipe.radius_mm, 101)
    for component, panel in enumerate(panels):
        for (name, field), colour, marker in zip(
            fields.items(), cycle(style.COLOURS), cycle(style.MARKERS), strict=False
        ):
            distance = pipe.distances_mm(field.grid.centres_mm())
            seen = np.isfinite(field.velocity[..., component]) & (distance < pipe.radius_mm)
            values = field.velocity[seen][:, component]
            panel.plot(distance[seen], values, marker, color=colour, markersize=2.0, label=name)
        axial = 2.0 * mean_velocity_m_s * (1.0 - (radius / pipe.radius_mm) ** 2)
        panel.plot(
            radius, axial if component == pipe.along else 0.0 * radius, color=style.BLACK, label="true, analytic"
        )
        panel.axvline(INNER * pipe.radius_mm, color=style.GREY, linewidth=0.8)
        panel.set(xlabel="distance from the axis (mm)", ylabel=f"{style.COMPONENT_NAMES[component]} (m/s)")
    figure.axes[0].legend()
    return figure


# Figures that are compared, by what they are without an error.
WITHOUT_ERROR = {
    0.0: ("streamwise_mean_error", "slice_mean_error", "rms_u_voxel", "rms_v_voxel", "rms_w_voxel"),
    1.0: (
        "within_25_percent_streamwise",
        "within_25_percent_vector",
        "within_25_percent_vector_inner",
        "slope_u",
        "slope_v",
        "slope_w",
    ),
}


def lower_error(methods: Mapping[str, Measured], figures: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the method with the lower error: by figure, and (`whole_vector`) by the rms over windows all have found.

    Left out is a figure that a method does not know, or in which all err alike.
    """
    common = np.all([m.found for m in methods.values()], axis=0)
    rms: dict[str, float | None] = dict.fromkeys(methods)
    if common.any():
        for method, m in methods.items():
            rms[method] = float(np.sqrt(np.mean(np.sum((m.field.velocity - m.truth)[common] ** 2, axis=-1))))
    errors = {"whole_vector": rms}
    for expected, names in WITHOUT_ERROR.items():
        for name in names:
            values = {method: found.get(name) for method, found in figures.items()}
            errors[name] = {
                method: None if value is None else abs(expected - value) for method, value in values.items()
            }
    better = {}
    for name, by_method in errors.items():
        known = {method: error for method, error in by_method.items() if error is not None}
        if len(known) == len(by_method) and len(set(known.values())) > 1:
            better[name] = min(known, key=known.__getitem__)
    return better


# Pictures of a measured flow beside the true one, all components of it in three planes.
#
# What is compared has one scale. The truth is a line where the flow is analytic; of true particles only its values at
# the windows are known, as fits to the nearest ones, and are drawn as such.

# Profiles show at least this share of the largest true speed to both sides of zero: less is noise of no account.
LEAST_RANGE = 0.02
# Letters of a line above a panel.
TITLE_WIDTH = 60
# Points of the lines of an analytic flow.
LINE_POINTS = 101


def flow_figure(methods: Mapping[str, Measured]) -> style.Figure:
    """Return the true vectors and those of each method, at least one, in three middle planes on one scale.

    The fields have one grid; what is not judged is left out.
    """
    first = next(iter(methods.values()))
    fields = {"true": first.truth} | {name: m.field.velocity for name, m in methods.items()}
    factor, unit = speed_unit(first.judged(first.truth))
    rows = {name: factor * methods.get(name, first).judged(values) for name, values in fields.items()}
    return compared_figure(first.field.grid, rows, unit)


def errors_figure(methods: Mapping[str, Measured]) -> style.Figure:
    """Return measured less true velocities in three middle planes: rows of methods, on one scale a component."""
    errors = {name: m.judged(m.field.velocity - m.truth) for name, m in methods.items()}
    factor, unit = speed_unit(*errors.values())
    rows = []
    for component, letter in enumerate(style.COMPONENT_NAMES):
        maps = {name: [factor * error[..., component]] * 3 for name, error in errors.items()}
        label, scale = f"{letter}, measured less true ({unit})", middle_scale(*maps.values())
        rows += [MapRow(each, [f"{name}: error of {letter}"] * 3, label, scale) for name, each in maps.items()]
    return maps_figure(next(iter(methods.values())).field.grid, rows)


@style.styled
def profiles_figure(methods: Mapping[str, Measured]) -> style.Figure:
    """Return means of each component over the planes across each axis, and how many vectors err by how much.

    Means are over the windows that all methods have found; the true ones over the same.
    """
    first = next(iter(methods.values()))
    factor, unit = speed_unit(first.judged(first.truth))
    figure, axes = style.new_panels(11.0, 11.0, 4, 3, sharey="row")
    grid, found_by_all = first.field.grid, np.all([m.found for m in methods.values()], axis=0)
    curves = {"true, at the windows": first.truth} | {name: m.field.velocity for name, m in methods.items()}
    styles = list(zip((style.BLACK, *style.COLOURS), ("+", *style.MARKERS), strict=True))
    least = LEAST_RANGE * factor * style.symmetric_limit(first.judged(first.truth))
    for component, row in enumerate(axes[:3]):
        for axis, panel in enumerate(row):
            panel.axhline(0.0, color=style.GREY, linewidth=0.8)
            if first.flow is not None:
                # on planes across the axis, at the lateral places of the windows
                places = np.linspace(*grid.bounds_mm(axis), LINE_POINTS)
                lateral = np.unique(np.delete(grid.centres_mm()[first.inside], axis, axis=1), axis=0)
                points = np.tile(lateral, (places.size, 1))
                on_planes = first.flow(np.insert(points, axis, np.repeat(places, len(lateral)), axis=1))
                true = on_planes.reshape(places.size, len(lateral), 3)[..., component].mean(axis=1)
                panel.plot(places, factor * true, color=style.BLACK, label="true, analytic")
            for (label, values), (colour, marker) in zip(curves.items(), styles, strict=False):
                known = np.where(found_by_all, values[..., component], np.nan)
                mean = mean_of_known(known, tuple(k for k in range(3) if k != 2 - axis))
                look = {"color": colour, "markerfacecolor": "none", "label": label}
                panel.plot(grid.axis_mm(axis), factor * mean, marker, **look)
            panel.set_xlabel(f"{style.AXIS_NAMES[axis]} (mm)")
            panel.set_ylabel(f"{style.COMPONENT_NAMES[component]} ({unit}), mean over the plane")
        low, high = row[0].get_ylim()
        row[0].set_ylim(min(low, -least), max(high, least))
    shares = {name: cumulative_distribution(m.pairs) for name, m in methods.items()}
    reported = {"streamwise_share": "along the mean flow", "vector_share": "of the whole vector"}
    for panel, (key, what) in zip(axes[3], reported.items(), strict=False):
        for (name, found), colour in zip(shares.items(), cycle(style.COLOURS), strict=False):
            if found[key] is not None:
                panel.plot(found["relative_error"], found[key], color=colour, label=name)
        panel.axvline(TOLERANCE, color=style.GREY, linewidth=0.8)
        panel.set(xlabel=f"relative error {what}", ylabel="share of the vectors", xlim=(0.0, 1.0), ylim=(0.0, 1.01))
    axes[3, 2].set_axis_off()
    axes[3, 2].legend(*axes[0, 0].get_legend_handles_labels(), loc="center", title="in all pictures")
    return figure


@style.styled
def slices_figure(methods: Mapping[str, Measured], duct: Duct) -> style.Figure:
    """Return streamwise profiles across six slices of a duct, those of the paper's Fig. 16, and their errors.

    Profiles are means along the flow, over the planes of windows on both sides of a slice. The paper's errors (Table 4)
    stand beside ours only where the duct is the paper's.
    """
    figure, axes = style.new_panels(12.0, 7.0, 2, 3)
    first = next(iter(methods.values()))
    curves = {"true, at the windows": first.judged(first.truth)} if first.flow is None else {}
    curves |= {name: m.judged(m.field.velocity) for name, m in methods.items()}
    tables = {name: table_4(m, duct) for name, m in methods.items()}
    main = style.AXIS_NAMES.index(duct.axis)
    for row, (name, axis) in zip(axes, duct.across.items(), strict=True):
        # of what a slice leaves of [z, y, x], the one that the flow follows
        along, other = [k for k in (2, 1, 0) if k != axis].index(main), 3 - axis - main
        for panel, (share, (_, paper_ert)) in zip(row, PAPER_SLICES[name].items(), strict=True):
            position = duct.position_mm(axis, share)
            panel.axhline(0.0, color=style.GREY, linewidth=0.8)
            if first.flow is not None:
                # as far as the walls
                places = np.linspace(duct.position_mm(other, 0.0), duct.position_mm(other, 1.0), LINE_POINTS)
                points = np.tile(duct.centre_mm, (LINE_POINTS, 1))
                points[:, axis], points[:, other] = position, places
                panel.plot(places, first.flow(points)[:, main], color=style.BLACK, label="true, analytic")
            for (label, values), colour, marker in zip(curves.items(), style.COLOURS, style.MARKERS, strict=False):
                of_slice = slice_at(values[..., main], first.field.grid.axis_mm(axis), position, axis)
                look = {"color": colour, "markerfacecolor": "none", "label": label}
                panel.plot(first.field.grid.axis_mm(other), mean_of_known(of_slice, (along,)), marker, **look)
            ours = {method: table[f"{name} {share}"]["ours_percent"] for method, table in tables.items()}
            errors = [f"{method} unknown" if e is None else f"{method} {e:.2f} %" for method, e in ours.items()]
            reported = textwrap.fill(f"mean error: {', '.join(errors)}", TITLE_WIDTH)
            beside = f" (paper {paper_ert:.2f} %)" if duct.is_the_papers else ""
            panel.set_title(f"{name} = {share}{beside}\n{reported}")
            panel.set(xlabel=f"{style.AXIS_NAMES[other]} (mm)", ylabel=f"{style.COMPONENT_NAMES[main]} (m/s)")
    axes[0, 0].legend()
    return figure


def slice_at(values: Floats, places: Floats, position: float, axis: int) -> Floats:
    """Return a slice across one axis (0 for x) of values [z, y, x], interpolated between planes at `places`."""
    at = float(np.clip(np.interp(position, places, np.arange(places.size)), 0, places.size - 1))
    low = min(int(at), max(0, places.size - 2))
    high = min(low + 1, places.size - 1)
    planes = np.moveaxis(values, 2 - axis, 0)
    return np.asarray((1.0 - (at - low)) * planes[low] + (at - low) * planes[high])
