"""Mistakes that are planted in an otherwise good measurement, and the figures that give them away.

A pair of images of tracers that stand apart, in a flow with all three components, is measured: particles of both
images, joined to tracks. Middles of tracks are held against true places, their displacements against true ones. Each
figure may be off by `LIMIT_SIGMAS` standard errors of a measurement without a mistake, made with other tracers.

The tracers stand off the focal plane: what lights a single microlens may lie anywhere in it, so that a few such tracers
would be off by more than all others together, and their number would make the limits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from lfpiv_cli.files.pages import Table
from lfpiv_cli.notice import written
from lfpiv_cli.paper import small_rig
from lfpiv_cli.paper.parts import Drawing, Findings, Row, Work
from lfpiv_cli.paper.small_rig import HALF_DEPTH_MM, READOUT, Case, Figures, Image, Points
from lfpiv_cli.particles.rounds import ROUNDS
from lfpiv_cli.pictures.style import Figure, new_panels, styled
from lfpiv_cli.validation.volume import fit_errors, pairs_of

# Shown from a tenth of the limit to a thousand times it.
DECADES = (-1.0, 3.0)


@styled
def faults_figure(over: Mapping[str, Mapping[str, float]], words: Mapping[str, str]) -> Figure:
    """How far each figure of a measurement is off, over its limit, without a mistake and with a planted one. Numbers
    above 1 miss it.

    A row for each measurement, a column for each figure.
    """
    names = list(words)
    table = np.array([[each[name] for name in names] for each in over.values()])
    shade = np.clip(np.log10(np.maximum(table, 10.0 ** DECADES[0])), *DECADES)
    figure, axes = new_panels(10.0, 1.9 + 0.38 * len(table))
    image = axes.imshow(shade, cmap="cividis", vmin=DECADES[0], vmax=DECADES[1], aspect="auto")
    for (row, column), value in np.ndenumerate(table):
        missed = not value <= 1.0
        colour = "black" if shade[row, column] > 1.0 else "white"
        weight = "bold" if missed else "normal"
        reported = f"{value:.0e}".replace("e+0", "e") if value >= 1000.0 else f"{value:.{0 if value >= 9.95 else 1}f}"
        axes.text(column, row, reported, ha="center", va="center", fontsize=8, color=colour, fontweight=weight)
    axes.set_xticks(range(len(names)), [words[name] for name in names], rotation=40, ha="right", fontsize=8)
    axes.set_yticks(range(len(table)), list(over), fontsize=8)
    bar = figure.colorbar(image, ax=axes, ticks=range(int(DECADES[0]), int(DECADES[1]) + 1))
    bar.ax.set_yticklabels([f"{10.0**k:g}" for k in range(int(DECADES[0]), int(DECADES[1]) + 1)], fontsize=8)
    bar.set_label("error / limit (bold: missed)", fontsize=8)
    return figure


SEED_OF_LIMITS, SEED = 100, 1
# Of some fifteen figures of a good measurement one is off by five standard errors once in a hundred thousand times.
LIMIT_SIGMAS = 5.0
WRONG_INDEX = 1.30
SHIFT_PX, TURN_DEG = 0.5, 0.02
COMPONENTS = ("u", "v", "w")
# From here on a tracer lights two microlenses or more, wherever it stands: its light widens by a tenth of the distance.
OFF_FOCUS_MM = 0.7
# Tracers that stand apart are found in the first round; the last one refines them.
FEW_ROUNDS = (ROUNDS[0], ROUNDS[-1])

# Figures of each mistake in the table.
WORST = 3

Pair = tuple[Image, Image]


@dataclass(frozen=True)
class Words:
    """What a figure is called, and in which unit it is shown."""

    text: str
    factor: float
    unit: str

    def shown(self, value: float) -> str:
        """Return a value with its unit."""
        return f"{written(self.factor * value)} {self.unit}"


WORDS = {
    **{f"offset_{name}": Words(f"offset in {name}", 1e3, "um") for name in "xyz"},
    **{f"stretch_{name}": Words(f"error of the scale of {name}", 100.0, "%") for name in "xyz"},
    **{f"slant_{name}": Words(f"slant of {name} over depth", 1e3, "um/mm") for name in "xy"},
    "turn": Words("turn about the axis", float(np.rad2deg(1.0)), "deg"),
    "twist": Words("growth of the turn in depth", float(np.rad2deg(1.0)), "deg/mm"),
    **{f"spread_{name}": Words(f"spread of {name}", 1e3, "um") for name in "xyz"},
    **{f"slope_{name}": Words(f"error of the slope of {name}", 100.0, "%") for name in COMPONENTS},
}


@dataclass(frozen=True)
class Limit:
    """Between which values a figure may lie: about a centre, or only not above."""

    centre: float
    half_width: float
    only_above: bool

    def over(self, value: float) -> float:
        """Return how far a value lies from the centre, over what is allowed; infinite for what is not known."""
        off = value - self.centre
        off = max(off, 0.0) if self.only_above else abs(off)
        return float(off / self.half_width) if np.isfinite(off) else float("inf")


@dataclass(frozen=True)
class Fault:
    """A mistake: what is believed of the rig, what is done to the pair of images, and what to the places found."""

    name: str
    case: Callable[[], Case]
    images: Callable[[Pair], Pair] = lambda pair: pair
    signs: tuple[float, float, float] = (1.0, 1.0, 1.0)


def good() -> Case:
    """Return the rig as it is."""
    known = small_rig.Rig(small_rig.sheet())
    return Case(known, known)


NONE = Fault("none", good)
FAULTS = (
    Fault("index 1.30 for 1.33", partial(small_rig.index_wrong, WRONG_INDEX)),
    Fault("z of the wrong sign", good, signs=(1.0, 1.0, -1.0)),
    Fault("images half a pixel off", partial(small_rig.lattice_shifted, SHIFT_PX)),
    Fault("lattice turned by 0.02 degrees", partial(small_rig.lattice_turned, TURN_DEG)),
    Fault("column axis mirrored", good, lambda pair: (pair[0][:, ::-1].copy(), pair[1][:, ::-1].copy())),
    Fault("pair swapped", good, lambda pair: (pair[1], pair[0])),
)


def faults(work: Work) -> Findings:
    """Plant each mistake and tell which figures miss their limits."""
    known = {seed: work.step(f"none_{seed}", partial(measured, NONE, seed)) for seed in (SEED_OF_LIMITS, SEED)}
    limits, good_figures = limits_of(known[SEED_OF_LIMITS]), known[SEED]
    planted = work.by_size(FAULTS[-1:], FAULTS, FAULTS)
    figures = {
        each.name: work.step(each.name.replace(" ", "_").replace(".", ""), partial(measured, each, SEED))
        for each in planted
    }
    over = {name: over_limits(each, limits) for name, each in {"no mistake": good_figures, **figures}.items()}
    return Findings(
        rows=fault_rows(figures, good_figures, limits),
        drawings=(Drawing.of("faults", faults_figure, over, {name: words.text for name, words in WORDS.items()}),),
        tables=(fault_table(figures, good_figures, limits),),
        text=(
            f"{len(planted)} mistakes are planted, each in a measurement that is good otherwise: a pair of images of "
            f"some tens of tracers that stand apart and {OFF_FOCUS_MM:g} mm off the focal plane or more, taken by a "
            "corner of the paper's camera before its channel, with noise and Snell's law. Particles of both images are "
            "found and joined to tracks. What the tracks say is held against the truth: a map is fitted from true to "
            "measured places (offsets, scales, slants of the lateral axes over depth, turn about the axis and its "
            "growth in depth, and what scatters about it), and a slope for each velocity component.",
            f"The limits are {LIMIT_SIGMAS:g} standard errors of the same figures in a good measurement of other "
            "tracers; of spreads, above their value there. A validation fails, as `lfpiv validate` does with exit code "
            "8, where a figure misses its limit. A swapped pair leaves all places as they are, as they are those of "
            "the middle of the pair: velocities alone tell.",
        ),
        seeds=(SEED_OF_LIMITS, SEED),
    )


def measured(fault: Fault, seed: int) -> Figures:
    """Return the figures of a measurement with a mistake, `name` and `name_sigma`."""
    rng = np.random.default_rng([seed, 5])
    case = fault.case()
    tracers = small_rig.strewn_apart(rng)
    # they fill the depths but those near the focal plane
    x, y, z = tracers.position_mm.T
    off = np.copysign(OFF_FOCUS_MM + (1.0 - OFF_FOCUS_MM / HALF_DEPTH_MM) * np.abs(z), z)
    tracers = replace(tracers, position_mm=np.column_stack([x, y, off]))
    moves = small_rig.displacement(tracers.position_mm)
    first, second = (small_rig.photograph(case.true, tracers.moved(sign * moves), READOUT, rng) for sign in (-0.5, 0.5))
    search, signs = replace(case, rounds=FEW_ROUNDS), np.array(fault.signs)
    found = [search.particles(image) * signs for image in fault.images((first, second))]
    middle, moved = small_rig.tracks_between(found[0], found[1], case.believed)
    return place_and_velocity_figures(middle, moved, tracers.position_mm, moves)


def place_and_velocity_figures(middle: Points, moved: Points, true_places: Points, true_moves: Points) -> Figures:
    """Return figures of tracks against the truth, and standard errors.

    Which track is which tracer is told by the signs of the axes that pair most of them.
    """
    mirrorings = (1.0 - 2.0 * np.array(signs) for signs in np.ndindex(2, 2, 2))
    # many pairs, then near in depth
    paired = (pairs_of(middle * signs, true_places, small_rig.GATE_MM) for signs in mirrorings)
    pairs = max(paired, key=lambda each: (len(each.found), -float(np.sum(np.abs(each.error_voxel)))))
    places, moves = middle[pairs.found], moved[pairs.found]
    true, expected = true_places[pairs.true], true_moves[pairs.true]
    figures, sigma = fit_errors(true, places - true)
    for axis, name in enumerate(COMPONENTS):
        power = np.sum(expected[:, axis] ** 2)
        slope = np.sum(moves[:, axis] * expected[:, axis]) / power
        left = moves[:, axis] - slope * expected[:, axis]
        figures[f"slope_{name}"] = float(slope - 1.0)
        sigma[f"slope_{name}"] = float(np.sqrt(np.mean(left**2) / power))
    return figures | {f"{name}_sigma": value for name, value in sigma.items()}


def limits_of(good_figures: Figures) -> dict[str, Limit]:
    """Return the limits that a good measurement's standard errors give: about 0, of spreads above their own."""
    sigma = {name.removesuffix("_sigma"): value for name, value in good_figures.items() if name.endswith("_sigma")}
    spreads = {name for name in sigma if name.startswith("spread")}
    return {
        name: Limit(good_figures[name] if name in spreads else 0.0, LIMIT_SIGMAS * value, name in spreads)
        for name, value in sigma.items()
    }


def over_limits(figures: Figures, limits: Mapping[str, Limit]) -> dict[str, float]:
    """Return how far figures are off, over their limits: missed above 1."""
    return {name: limit.over(figures[name]) for name, limit in limits.items()}


def missed_limits(figures: Figures, limits: Mapping[str, Limit]) -> list[str]:
    """Return the figures that miss their limits, the worst first."""
    over = over_limits(figures, limits)
    return sorted((name for name, value in over.items() if not value <= 1.0), key=lambda name: -over[name])


def allowed(name: str, limits: Mapping[str, Limit]) -> str:
    """Return the limit of a figure in words."""
    limit, words = limits[name], WORDS[name]
    if limit.only_above:
        return f"up to {words.shown(limit.centre + limit.half_width)}"
    return f"\N{PLUS-MINUS SIGN}{words.shown(limit.half_width)}"


def said_to(figures: Figures, limits: Mapping[str, Limit]) -> str:
    """Return what a validation with these limits says to a measurement; empty where it says nothing."""
    values = {name: (WORDS[name].text, WORDS[name].shown(figures[name])) for name in missed_limits(figures, limits)}
    return "; ".join(f"{text} is {value}, allowed {allowed(name, limits)}" for name, (text, value) in values.items())


def fault_rows(figures: Mapping[str, Figures], good_figures: Figures, limits: Mapping[str, Limit]) -> tuple[Row, ...]:
    """Return a row for each mistake with the figure that gives it away, and one for alarms without a mistake."""
    rows = []
    for fault, each in figures.items():
        over, said = over_limits(each, limits), said_to(each, limits)
        # by how many times its limit the worst figure of a mistake is off: it is to fail
        worst = max(over, key=over.__getitem__)
        row = Row(
            f"{fault}: {WORDS[worst].text}, over its limit",
            "planted mistake",
            1.0,
            sense="at least",
            best=over[worst] if said else 0.0,
            reason="" if said else "validation does not fail: no figure misses its limit",
        )
        rows.append(row)
    none = Row(
        "no mistake: figures that miss their limit",
        "good measurement",
        0.0,
        best=float(len(missed_limits(good_figures, limits))),
        reason=said_to(good_figures, limits),
    )
    return (*rows, none)


def fault_table(figures: Mapping[str, Figures], good_figures: Figures, limits: Mapping[str, Limit]) -> Table:
    """Return the figures that give each mistake away, the three worst, and a line for no mistake."""
    rows = [
        (fault, WORDS[name].text, WORDS[name].shown(each[name]), allowed(name, limits), "missed")
        for fault, each in figures.items()
        for name in missed_limits(each, limits)[:WORST]
    ]
    over = over_limits(good_figures, limits)
    worst = max(over, key=lambda name: over[name])
    verdict = "met" if over[worst] <= 1.0 else "missed"
    none = ("no mistake", WORDS[worst].text, WORDS[worst].shown(good_figures[worst]), allowed(worst, limits), verdict)
    head = ("mistake", "figure", "value", "limit", "verdict")
    return Table("What gives planted mistakes away, the worst three figures of each", head, (none, *rows))
