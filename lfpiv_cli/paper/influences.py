"""What a measurement is sensitive to: each influence, how it is varied, and which numbers a user wants of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from lfpiv_cli.paper import small_rig
from lfpiv_cli.paper.small_rig import CHANNEL, F_NUMBER, HALF_DEPTH_MM, PIXEL_MM, WATER, Case, Figures, sheet

Values = tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]


@dataclass(frozen=True)
class Panel:
    """A panel of a picture; where a sensitivity is a slope, the straight line of its figure is drawn as well.

    Attributes
    ----------
    series : the figures that its curves show, and what they are called
    factor : gives figures the panel's unit
    at_least : its axis shows errors of this size, so that noise alone does not fill it
    """

    label: str
    series: Mapping[str, str]
    factor: float = 1.0
    logarithmic: bool = False
    at_least: float = 0.0


@dataclass(frozen=True)
class Sensitivity:
    """A number that a user can use.

    Attributes
    ----------
    figure : whose straight line over the influence has the sensitivity as its slope, or whose value is taken
    text, unit, factor : of what, in which unit, and what turns the slope or value into that
    reach : what turns the figure into an error of places, mm, and where that holds
    at : take the value there in place of a slope; None: the slope
    expected, tolerance : by theory, as the slope is; and by which share the measured one may differ; None: no theory
    power : of the influence in which the figure is a straight line
    """

    figure: str
    text: str
    unit: str
    factor: float
    reach: tuple[float, str] = (1.0, "everywhere")
    at: float | None = None
    expected: float | None = None
    tolerance: float = 0.05
    power: float = 1.0


@dataclass(frozen=True)
class Influence:
    """Something that makes errors.

    Attributes
    ----------
    label : of the horizontal axis
    values : at which it is measured: tiny, quick, full
    measure : figures at a value, by seed
    typical : how wrong the influence typically is, in its own unit, and in words; "": where a sensitivity holds
    advice : what to take care of; {error} is the error that typically follows
    repeats : realisations in full, where scatter matters
    """

    name: str
    label: str
    values: Values
    measure: Callable[[float, int], Figures]
    panels: tuple[Panel, ...]
    typical: tuple[float, str]
    sensitivities: tuple[Sensitivity, ...]
    advice: str
    repeats: int = 1
    logarithmic: bool = False


def around(largest: float, middle: float = 0.0) -> Values:
    """Return values on both sides of a middle: 2, 3 and 7."""
    tiny, quick, full = (tuple(float(middle + x) for x in np.linspace(-largest, largest, n)) for n in (2, 3, 7))
    return tiny, quick, full


# Influences that scatter places and velocities, the camera being known: aperture, noise, depth, number of tracers.

# The paper's 0.002 tracers a pixel.
PAPER_PER_PIXEL = 0.002
PAPER_PER_LENS = float(PAPER_PER_PIXEL * sheet().micro_image_lattice_px().pitch[0] ** 2)

BY_RAYS = {"paraxial": "rays taken as paraxial", "exact": "rays by Snell's law"}
F_NUMBERS = Influence(
    "f-number",
    "f-number of the main lens",
    ((4.0, 8.0), (2.8, 4.0, 8.0), (2.8, 3.3, 4.0, 4.8, 5.6, 6.7, 8.0)),
    small_rig.at_f_number,
    (
        Panel(
            "error of depth behind 134 mm of water (mm)", {f"{rays}_offset_z": words for rays, words in BY_RAYS.items()}
        ),
        Panel("spread of depth (um)", {f"{rays}_spread_z": words for rays, words in BY_RAYS.items()}, 1e3),
    ),
    typical=(F_NUMBER**-2, "f/4, paraxial"),
    sensitivities=(
        Sensitivity(
            "paraxial_offset_z",
            "depth by paraxial rays, behind 134 mm of water",
            "mm over the square of the f-number",
            1.0,
            expected=-small_rig.spherical_aberration_mm(1.0),
            power=-2.0,
        ),
    ),
    advice="Bend rays by Snell's law behind much fluid: paraxial ones put depths off by {error} behind 134 mm "
    "of water at f/4, less as the square of the f-number and in proportion to the fluid.",
)

# Read noise over light at which scatter is told and held against its bound: the fit knows neither noise nor light, and
# tracers overlap.
FAINT, LARGEST_OVER_BOUND = 0.1, 1.5

DEPTH_AND_X = {"z": "depth", "x": "x"}

NOISE = Influence(
    "noise",
    "read noise over the light of a lit pixel",
    ((0.0, 0.1), (0.0, 0.1, 0.2), (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)),
    small_rig.in_noise,
    tuple(
        Panel(
            f"spread of {what} (um)", {f"spread_{name}": "measured", f"bound_{name}": "Cramer-Rao bound (median)"}, 1e3
        )
        for name, what in DEPTH_AND_X.items()
    ),
    typical=(1.0, "a tenth: faint tracers"),
    sensitivities=tuple(
        Sensitivity(f"spread_{name}", f"spread of {what} where noise is a tenth", "um", 1e3, at=FAINT)
        for name, what in DEPTH_AND_X.items()
    ),
    advice="Give tracers light: where read noise is a tenth of what a lit pixel holds, depths scatter by "
    "{error}, and a velocity by that, times 1.4, over the time between the images.",
    repeats=2,
)
DISTANCE = Influence(
    "depth",
    "distance of the tracers from the focal plane (mm)",
    ((1.0, 5.0), (0.25, 3.0, 10.0), (0.25, 1.0, 2.0, 3.5, 5.0, 7.5, 10.0)),
    small_rig.at_depth,
    tuple(
        Panel(
            f"error of {what} (um)",
            {f"spread_{name}": "typical (1.48 times the median)", f"rms_{name}": "rms"},
            1e3,
            logarithmic=True,
        )
        for name, what in DEPTH_AND_X.items()
    ),
    typical=(1.0, ""),
    sensitivities=(
        Sensitivity("rms_z", "rms error of depth", "um", 1e3, (1.0, "at 0.25 mm"), at=0.25),
        Sensitivity("spread_z", "typical error of depth", "um", 1e3, (1.0, "at 10 mm"), at=10.0),
    ),
    advice="Keep the focal plane out of what matters most: within a quarter of a millimetre of it depths are wrong by "
    "{error} rms, as light stays within a lens and the side of the plane is hard to tell.",
    repeats=2,
)
SEEDING = Influence(
    "seeding",
    "tracers for each microlens",
    ((0.1, 0.3), (0.1, 0.67, 1.2), (0.1, 0.25, 0.67, 1.2, 2.0, 4.0)),
    small_rig.crowded,
    (
        Panel(
            "share, and slope of w",
            {
                "recall": "tracers found",
                "precision": "of those found, true",
                "tracks_slope_w": "slope of w, particles",
                "volumes_slope_w": "slope of w, volumes",
            },
        ),
        Panel(
            "rms error (mm)",
            {
                "rms_z": "depth of a tracer",
                "tracks_rms_w": "displacement in depth, particles",
                "volumes_rms_w": "displacement in depth, volumes",
                "tracks_rms_u": "lateral displacement, particles",
                "volumes_rms_u": "lateral displacement, volumes",
            },
            logarithmic=True,
        ),
    ),
    typical=(1.0, "the paper's seeding"),
    sensitivities=tuple(
        Sensitivity(figure, f"displacement in depth by {by}", "um", 1e3, (1.0, "at 0.67 a microlens"), at=0.67)
        for figure, by in (("tracks_rms_w", "particles"), ("volumes_rms_w", "volumes"))
    ),
    advice="Take particles rather than volumes where the depth component matters, and seed no more than they "
    "bear: at the paper's seeding volumes have a displacement in depth wrong by {error} rms.",
    logarithmic=True,
)

# Influences that displace places: a number of the rig that is believed and wrong.

# Where errors that grow from the middle are told: so deep from the mid plane, and so far from the axis, the paper's
# volume.
DEEP, ASIDE = (HALF_DEPTH_MM, "4 mm from the mid plane"), (5.0, "5 mm beside the axis")
SHEET = sheet()
# A lens image that is misplaced by so much moves the place on the main lens by this many times as much; a ray's place
# in the fluid moves by that over the lens's distance, for each millimetre from the focal plane.
LEVER = SHEET.image_distance_mm / SHEET.microlens_distance_mm
SLANT_PER_MM = LEVER / SHEET.focus_distance_mm * WATER.depth_ratio
TURN_PER_DEG = float(np.deg2rad(1.0))

DEPTH = Panel("error of depth (mm)", {"offset_z": "in the middle of the channel"})
FOUND = Panel("found of the tracers", {"recall": "found", "precision": "of those found, true"})
VELOCITY = Panel(
    "error of velocities (%)", {"stretch_z": "along the depth", "stretch_x": "lateral"}, 100.0, at_least=1.0
)
# With the focal plane 2 mm off, tracers from deeper than this are believed to be in the wall.
SHALLOW_MM = 2.0


def in_places(case: Callable[[float], Case], value: float, seed: int, half_depth_mm: float = HALF_DEPTH_MM) -> Figures:
    """Return how measured places of a case are displaced."""
    rng = np.random.default_rng([seed, 3])
    tracers = small_rig.strewn_apart(rng, (-half_depth_mm, half_depth_mm))
    return small_rig.place_figures(case(value), tracers, rng)


INDEX = Influence(
    "index",
    "index of the fluid that is believed (true: 1.33)",
    around(0.03, WATER.fluid),
    partial(in_places, small_rig.index_wrong),
    (DEPTH, VELOCITY),
    typical=(0.005, "0.005: temperature or solution not measured"),
    sensitivities=(
        Sensitivity(
            "offset_z",
            "depth in the middle of a 10 mm channel",
            "mm per 0.01",
            0.01,
            (1.0, "in the middle"),
            expected=0.5 * CHANNEL.width_mm / WATER.fluid,
        ),
        Sensitivity(
            "stretch_z", "depths and velocities along the depth", "% per 0.01", 1.0, DEEP, expected=1.0 / WATER.fluid
        ),
    ),
    advice="Measure the index of the fluid at its temperature: 0.005 puts depths off by {error}, more with the "
    "distance from the inner wall, and velocities along the depth by as much as it is of the index.",
)
FOCUS = Influence(
    "focus",
    "focal plane believed to lie farther than it does (mm in air)",
    around(2.0),
    partial(in_places, small_rig.focus_wrong, half_depth_mm=SHALLOW_MM),
    (DEPTH, VELOCITY),
    typical=(0.1, "0.1 mm: focused by eye"),
    sensitivities=(
        Sensitivity("offset_z", "depth", "mm per mm", 1.0, expected=WATER.fluid / WATER.air, tolerance=0.03),
        Sensitivity(
            "stretch_x", "lateral places and velocities", "% per mm", 100.0, ASIDE, expected=1.0 / SHEET.focal_length_mm
        ),
        # so near the focal plane the slope has a standard error of 2 %
        Sensitivity(
            "stretch_z",
            "velocities along the depth",
            "% per mm",
            100.0,
            DEEP,
            expected=2.0 / SHEET.focal_length_mm,
            tolerance=0.1,
        ),
    ),
    advice="Measure where the focal plane lies by a snapshot of a board, and do not touch the focus afterwards: 0.1 mm "
    "puts all depths off by {error}.",
)
WALL = Influence(
    "wall",
    "wall believed to be thicker than it is (mm)",
    around(1.0),
    partial(in_places, small_rig.wall_wrong),
    (DEPTH, VELOCITY),
    typical=(0.3, "0.3 mm: the tolerance of a 5 mm sheet of acrylic"),
    sensitivities=(
        Sensitivity("offset_z", "depth", "mm per mm", 1.0, expected=-WATER.fluid / WATER.window, tolerance=0.03),
    ),
    advice="Measure the wall that the board lies on with a calliper, as sheets are not as thick as they are "
    "sold: 0.3 mm puts all depths off by {error}, and leaves velocities alone but where the wall of the flow "
    "is.",
)
SHIFT = Influence(
    "lattice-shift",
    "lens images believed to lie farther along x (pixels)",
    ((-0.3, 0.3), (-0.3, 0.0, 0.3), (-1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0)),
    partial(in_places, small_rig.lattice_shifted),
    (Panel("slant of x over depth (um/mm)", {"slant_x": "x per depth, w into u"}, 1e3), FOUND),
    typical=(0.05, "0.05 px: an older white image"),
    sensitivities=(
        Sensitivity(
            "slant_x",
            "lateral place for each mm from the focal plane",
            "um/mm per 0.1 px",
            100.0,
            DEEP,
            expected=-PIXEL_MM * SLANT_PER_MM,
        ),
    ),
    advice="Take the white image on the day of the measurement: lens images 0.05 px off slant lateral places "
    "by {error}, and a whole pixel off hardly a tracer is found.",
)
TURN = Influence(
    "lattice-turn",
    "lattice believed to be turned further (degrees)",
    around(0.15),
    partial(in_places, small_rig.lattice_turned),
    (
        Panel(
            "turn of lateral places",
            {"turn": "in the focal plane (degrees)", "twist": "more for each mm of depth (degrees/mm)"},
            1.0 / TURN_PER_DEG,
        ),
        FOUND,
    ),
    typical=(0.005, "0.005 degrees: an older white image"),
    sensitivities=(
        Sensitivity(
            "twist",
            "turn about the axis for each mm from the focal plane",
            "deg/mm per deg",
            1.0 / TURN_PER_DEG,
            (DEEP[0] * ASIDE[0], f"{DEEP[1]}, {ASIDE[1]}"),
            expected=TURN_PER_DEG * SLANT_PER_MM,
        ),
    ),
    advice="Take the white image with the camera as it measures: a lattice turned by 0.005 degrees twists places by "
    "{error}, and what it hides grows with the distance from the axis.",
)

INFLUENCES = (SEEDING, F_NUMBERS, FOCUS, WALL, INDEX, SHIFT, TURN, NOISE, DISTANCE)
