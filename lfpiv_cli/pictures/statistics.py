"""Figures of statistics over many pairs: means and fluctuations in a plane, profiles with error bars, convergence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Integers
from lfpiv_cli.flow.statistics import PAIRS, STRESSES
from lfpiv_cli.grid import Grid
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
    each = (
        (axes[0], factor * velocity, style.COMPONENT_NAMES, f"scatter of means ({unit})"),
        (
            axes[1],
            factor**2 * stress,
            [f"<{name[0]}'{name[1]}'>" for name in STRESSES],
            f"scatter of stresses ({unit})²",
        ),
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
