"""What matters, and how much: errors over seeding, f-number, focal plane, wall, index, lattice, noise and depth."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.files.pages import Table
from lfpiv_cli.notice import written
from lfpiv_cli.paper import influences
from lfpiv_cli.paper.influences import INFLUENCES, NOISE, PAPER_PER_LENS, SEEDING, Influence, Sensitivity
from lfpiv_cli.paper.parts import Drawing, Findings, Row, Work
from lfpiv_cli.pictures.style import BLUE, GREEN, ORANGE, PURPLE, VERMILION, new_panels, styled

# Colours that colour-blind people tell apart, and marks that a print in grey keeps apart.
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE)
MARKS, DASHES = ("o", "s", "^", "D", "v"), ("-", "--", "-.", ":", (0, (5, 1, 1, 1)))

# Names of so many curves find room among them.
ROOM = 3

# Tracers crowd where fewer than this share is found.
SEEN_SHARE = 0.9
# Letters of a line above a panel.
NOTE_WIDTH = 64
# The sentences on what to take care of.
SENTENCES = 3
# Of the influences at the tiny size, which only tries the code.
TINY = ("index",)


@dataclass(frozen=True, eq=False)
class Measured:
    """An influence and what was measured of it: figures (values, realisations) by name."""

    influence: Influence
    values: Floats
    figures: Mapping[str, Floats]

    def median(self, name: str) -> Floats:
        """Return the median (n,) over the realisations of a figure; NaN where none has it."""
        table = self.figures[name]
        known = np.isfinite(table).any(axis=1)
        result = np.full(len(table), np.nan)
        result[known] = np.nanmedian(table[known], axis=1)
        return result

    def line(self, of: Sensitivity) -> tuple[float, float]:
        """Return offset and slope of the straight line through a sensitivity's known figures; NaN without two."""
        x, y = self.values**of.power, self.median(of.figure)
        known = np.isfinite(y)
        if np.count_nonzero(known) < 2:
            return np.nan, np.nan
        offset, slope = np.polynomial.polynomial.polyfit(x[known], y[known], 1)
        return float(offset), float(slope)

    def value(self, of: Sensitivity) -> float:
        """Return a sensitivity as the slope is, or the value at the stated place."""
        if of.at is None:
            return self.line(of)[1]
        return self.at(of.figure, of.at)

    def at(self, figure: str, value: float) -> float:
        """Return the median of a figure at the nearest value of the influence."""
        nearest = int(np.argmin(np.abs(self.values - value)))
        return float(self.median(figure)[nearest])

    def error_mm(self, of: Sensitivity) -> float:
        """Return the error of places that typically follows."""
        return abs(self.value(of)) * self.influence.typical[0] * of.reach[0]

    def largest_error_mm(self) -> float:
        """Return the largest of these errors that is known, 0 where none is."""
        return max(np.nan_to_num([self.error_mm(each) for each in self.influence.sensitivities]))

    def reported(self, of: Sensitivity) -> str:
        """Return a sensitivity with its unit."""
        place = f", {of.reach[1]}" if of.at is not None and of.reach[1] != "everywhere" else ""
        return f"{of.text}{place}: {written(of.factor * self.value(of))} {of.unit}"


def sensitivities(work: Work) -> Findings:
    """Vary each influence, draw the errors that follow and tell how much matters."""
    chosen = [each for each in INFLUENCES if work.size != "tiny" or each.name in TINY]
    found = [measured(work, each) for each in chosen]
    harmful = sorted(found, key=lambda each: -each.largest_error_mm())[:SENTENCES]
    advice = [each.influence.advice.format(error=f"{written(each.largest_error_mm(), 2)} mm") for each in harmful]
    return Findings(
        rows=tuple(row for each in found for row in rows_of(each)),
        drawings=tuple(drawing_of(each) for each in found),
        tables=(table_of(found),),
        text=(
            "A corner of the paper's camera, 24 by 24 microlenses, before the paper's channel of 10 mm behind a wall "
            "of 5 mm. Images are made of the rig as it is, by Snell's law and with noise; particles are found with one "
            "number wrong. Tracers stand apart (0.1 for each microlens) but where seeding is varied. What the wrong "
            "number does to places is fitted by a map: an offset and a scale for each axis, slants and turns; "
            "velocities, which are differences of places, have its scales and slants. Each influence is varied in "
            f"{work.by_size('two', 'three', 'six or seven')} steps.",
            "A wrong wall or index acts through Eq. 21, which says by how much the camera is moved from the board on "
            "the outer wall, through the ratio of depths (Eq. 9) and through Snell's law; depths are counted from "
            "where the mid plane is believed to be. A focal plane is wrong where the lens is focused elsewhere than "
            "believed, and the believed plane was brought to the middle of the channel. A depth that is wrong by an "
            "index is right at the inner face of the wall and grows from there.",
            f"What to take care of, the most harmful first. {' '.join(advice)}",
            *(crowding(each) for each in found if each.influence is SEEDING),
        ),
        seeds=tuple(range(1, 1 + max(work.by_size(1, 1, each.repeats) for each in chosen))),
    )


def measured(work: Work, influence: Influence) -> Measured:
    """Measure an influence at all its values."""
    values = work.by_size(*influence.values)
    seeds = range(1, 1 + work.by_size(1, 1, influence.repeats))
    points = [
        [work.step(f"{influence.name}_{value:.3g}_{seed}", partial(influence.measure, value, seed)) for seed in seeds]
        for value in values
    ]
    # JSON has null for what is not known, and an array of floats NaN
    tables = {name: np.array([[p[name] for p in row] for row in points], np.float64) for name in points[0][0]}
    return Measured(influence, np.array(values), tables)


def rows_of(found: Measured) -> tuple[Row, ...]:
    """Return a row for each sensitivity that theory tells: how far the measured one is from it.

    Of noise there is the scatter, which no measurement without bias can have below its bound.
    """
    rows = []
    if found.influence is NOISE:
        spread, bound = (found.at(f"{figure}_z", influences.FAINT) for figure in ("spread", "bound"))
        quantity = "noise a tenth of the light: spread of depth over the Cramer-Rao bound"
        rows = [Row(quantity, "bound by theory", influences.LARGEST_OVER_BOUND, best=spread / bound)]
    for each in found.influence.sensitivities:
        if each.expected is not None:
            quantity = f"{found.influence.name}: {each.text}, off theory (%)"
            off, limit = 100.0 * abs(found.value(each) / each.expected - 1.0), 100.0 * each.tolerance
            rows.append(Row(quantity, "sensitivity by theory", limit, best=off))
    return tuple(rows)


@styled
def drawing_of(found: Measured) -> Drawing:
    """Return the picture of an influence, in two panels: its series, and its sensitivities in words above them."""
    from matplotlib.ticker import LogLocator, NullFormatter

    influence = found.influence
    lines = {each.figure: each for each in influence.sensitivities if each.at is None}
    figure, both = new_panels(9.0, 3.8, 1, 2)
    for axes, panel in zip(both, influence.panels, strict=True):
        for number, (figure_name, label) in enumerate(panel.series.items()):
            # medians, the range over realisations, and the straight line or the points joined
            colour, dash, of = COLOURS[number], DASHES[number], lines.get(figure_name)
            middle, table = panel.factor * found.median(figure_name), panel.factor * found.figures[figure_name]
            offset, slope = (np.nan, np.nan) if of is None else found.line(of)
            style = dash if of is None or not np.isfinite(slope) else ""
            axes.plot(found.values, middle, MARKS[number], color=colour, ls=style, ms=5, label=label)
            if table.shape[1] > 1:
                axes.vlines(found.values, table.min(axis=1), table.max(axis=1), color=colour, lw=1.5)
            if of is not None and np.isfinite(slope):
                known = found.values[np.isfinite(middle)]
                x = np.linspace(known.min(), known.max(), 50)
                axes.plot(x, panel.factor * (offset + slope * x**of.power), ls=dash, color=colour, lw=1.2)
        axes.set_xlabel(influence.label, fontsize=9)
        axes.set_ylabel(panel.label, fontsize=9)
        axes.tick_params(labelsize=8)
        if panel.logarithmic:
            axes.set_yscale("log")
            axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.yaxis.set_major_formatter("{x:g}")
            axes.yaxis.set_minor_formatter(NullFormatter())
        if panel.at_least:
            low, high = axes.get_ylim()
            axes.set_ylim(min(low, -panel.at_least), max(high, panel.at_least))
        if influence.logarithmic:
            axes.set_xscale("log")
            axes.set_xticks(found.values, [f"{value:g}" for value in found.values])
            axes.minorticks_off()
        axes.grid(alpha=0.3)
        reported = [found.reported(each) for each in influence.sensitivities if each.figure in panel.series]
        axes.set_title("\n".join(textwrap.fill(each, NOTE_WIDTH) for each in reported), fontsize=8, loc="left")
        if len(panel.series) > ROOM:
            axes.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.17), ncols=2)
        else:
            axes.legend(fontsize=8)
    bars = " Medians; bars: all realisations." if found.values.size and influence.repeats > 1 else ""
    return Drawing(influence.name, f"Errors over the {influence.label}.{bars}", figure)


def table_of(found: Sequence[Measured]) -> Table:
    """Return the sensitivities, the most harmful first."""
    each = [(one, of) for one in found for of in one.influence.sensitivities]
    each.sort(key=lambda pair: -np.nan_to_num(pair[0].error_mm(pair[1])))
    rows = [
        {
            "influence": one.influence.name,
            "of what": of.text,
            "sensitivity": written(of.factor * one.value(of)),
            "by theory": "" if of.expected is None else written(of.factor * of.expected),
            "unit": of.unit,
            "typical uncertainty": one.influence.typical[1] or of.reach[1],
            "resulting error (mm)": written(one.error_mm(of), 2),
            "where": of.reach[1],
        }
        for one, of in each
    ]
    caption = "Sensitivities, by the error of places that typically follows"
    return Table(caption, tuple(rows[0]), tuple(tuple(row.values()) for row in rows))


def crowding(found: Measured) -> str:
    """Return the paper's seeding in tracers for each microlens, and where errors begin to rise."""
    values, recall = found.values, found.median("recall")
    beyond = values[recall < SEEN_SHARE]
    reported = f"from {beyond[0]:g} on" if beyond.size else "at none"
    rms = {name: found.at(f"{name}_rms_w", PAPER_PER_LENS) for name in ("tracks", "volumes")}
    better = values[found.median("tracks_rms_w") > found.median("volumes_rms_w")]
    turned = f", and from {better[0]:g} on volumes do better" if better.size else ""
    few, many = (found.at("tracks_rms_w", value) for value in (values[0], values[-1]))
    return (
        f"The paper seeds {influences.PAPER_PER_PIXEL:g} tracers for each pixel, which are {PAPER_PER_LENS:.2f} for "
        f"each microlens, over the 10 mm of its channel. There {found.at('recall', PAPER_PER_LENS):.0%} of the tracers "
        f"are found, and a displacement in depth is wrong by {written(rms['tracks'], 2)} mm rms by particles and by "
        f"{written(rms['volumes'], 2)} mm by volumes. Of the seedings tried, fewer than {SEEN_SHARE:.0%} are found "
        f"{reported}: neighbours are taken for one another, and the error of a particle's displacement in depth rises "
        f"from {written(few, 2)} mm at {values[0]:g} for each microlens to {written(many, 2)} mm at "
        f"{values[-1]:g}{turned}. That of volumes is not one of neighbours: light is smeared over millimetres of depth "
        "at any seeding."
    )
