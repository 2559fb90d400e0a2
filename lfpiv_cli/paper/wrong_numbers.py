"""Influences that displace places: a number of the rig that is believed and wrong."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from lfpiv_cli.paper import small_rig
from lfpiv_cli.paper.influences import Influence, Sensitivity, around
from lfpiv_cli.paper.small_rig import CHANNEL, HALF_DEPTH_MM, PIXEL_MM, WATER, Case, Figures, sheet
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.validation.sensitivity_pictures import Panel, Series

# Where errors that grow from the middle are told: so deep from the mid plane, and so far from the axis, the paper's
# volume.
DEEP_MM, ASIDE_MM = HALF_DEPTH_MM, 5.0
DEEP_TEXT, ASIDE_TEXT = "4 mm from the mid plane", "5 mm beside the axis"
SHEET = sheet()
# A lens image that is misplaced by so much moves the place on the main lens by this many times as much; a ray's place
# in the fluid moves by that over the lens's distance, for each millimetre from the focal plane.
LEVER = SHEET.image_distance_mm / SHEET.microlens_distance_mm
SLANT_PER_MM = LEVER / SHEET.focus_distance_mm * WATER.depth_ratio
TURN_PER_DEG = float(np.deg2rad(1.0))

DEPTH = Panel("error of depth (mm)", (Series("offset_z", "in the middle of the channel", 1.0, True),))
SCALES = (Series("stretch_z", "along the depth", 100.0, True), Series("stretch_x", "lateral", 100.0, True))
VELOCITY = Panel("error of velocities (%)", SCALES, at_least=1.0)
# With the focal plane 2 mm off, tracers from deeper than this are believed to be in the wall.
SHALLOW_MM = 2.0
INDEX_TEXT = "0.005: temperature or solution not measured"


def in_places(case: Callable[[float], Case], value: float, seed: int, half_depth_mm: float = HALF_DEPTH_MM) -> Figures:
    """Return how measured places of a case are displaced."""
    rng = np.random.default_rng([seed, 3])
    tracers = small_rig.strewn_apart(rng, (-half_depth_mm, half_depth_mm), small_rig.HALF_WIDTH_MM)
    return small_rig.place_figures(case(value), tracers, Readout(), rng)


INDEX = Influence(
    name="index",
    label="index of the fluid that is believed (true: 1.33)",
    values=around(0.03, WATER.fluid),
    measure=partial(in_places, small_rig.index_wrong),
    panels=(DEPTH, VELOCITY),
    sensitivities=(
        Sensitivity(
            "offset_z",
            "depth in the middle of a 10 mm channel",
            "mm per 0.01",
            0.01,
            0.005,
            INDEX_TEXT,
            reach_text="in the middle",
            expected=0.5 * CHANNEL.width_mm / WATER.fluid,
        ),
        Sensitivity(
            "stretch_z",
            "depths and velocities along the depth",
            "% per 0.01",
            1.0,
            0.005,
            INDEX_TEXT,
            DEEP_MM,
            DEEP_TEXT,
            expected=1.0 / WATER.fluid,
        ),
    ),
    advice="Measure the index of the fluid at its temperature: 0.005 puts depths off by {error}, more with the "
    "distance from the inner wall, and velocities along the depth by as much as it is of the index.",
)

FOCUS = Influence(
    name="focus",
    label="focal plane believed to lie farther than it does (mm in air)",
    values=around(2.0),
    measure=partial(in_places, small_rig.focus_wrong, half_depth_mm=SHALLOW_MM),
    panels=(DEPTH, VELOCITY),
    sensitivities=(
        Sensitivity(
            "offset_z",
            "depth",
            "mm per mm",
            1.0,
            0.1,
            "0.1 mm: focused by eye",
            expected=WATER.fluid / WATER.air,
            tolerance=0.03,
        ),
        Sensitivity(
            "stretch_x",
            "lateral places and velocities",
            "% per mm",
            100.0,
            0.1,
            "0.1 mm: focused by eye",
            ASIDE_MM,
            ASIDE_TEXT,
            expected=1.0 / SHEET.focal_length_mm,
        ),
        Sensitivity(
            "stretch_z",
            "velocities along the depth",
            "% per mm",
            100.0,
            0.1,
            "0.1 mm: focused by eye",
            DEEP_MM,
            DEEP_TEXT,
            expected=2.0 / SHEET.focal_length_mm,
            # so near the focal plane the slope has a standard error of 2 %
            tolerance=0.1,
        ),
    ),
    advice="Measure where the focal plane lies by a snapshot of a board, and do not touch the focus afterwards: 0.1 mm "
    "puts all depths off by {error}.",
)

WALL = Influence(
    name="wall",
    label="wall believed to be thicker than it is (mm)",
    values=around(1.0),
    measure=partial(in_places, small_rig.wall_wrong),
    panels=(DEPTH, VELOCITY),
    sensitivities=(
        Sensitivity(
            "offset_z",
            "depth",
            "mm per mm",
            1.0,
            0.3,
            "0.3 mm: the tolerance of a 5 mm sheet of acrylic",
            expected=-WATER.fluid / WATER.window,
            tolerance=0.03,
        ),
    ),
    advice="Measure the wall that the board lies on with a calliper, as sheets are not as thick as they are "
    "sold: 0.3 mm puts all depths off by {error}, and leaves velocities alone but where the wall of the flow "
    "is.",
)

SHIFT = Influence(
    name="lattice-shift",
    label="lens images believed to lie farther along x (pixels)",
    values=((-0.3, 0.3), (-0.3, 0.0, 0.3), (-1.0, -0.5, -0.2, 0.0, 0.2, 0.5, 1.0)),
    measure=partial(in_places, small_rig.lattice_shifted),
    panels=(
        Panel("slant of x over depth (um/mm)", (Series("slant_x", "x per depth, w into u", 1e3, True),)),
        Panel("found of the tracers", (Series("recall", "found"), Series("precision", "of those found, true"))),
    ),
    sensitivities=(
        Sensitivity(
            "slant_x",
            "lateral place for each mm from the focal plane",
            "um/mm per 0.1 px",
            100.0,
            0.05,
            "0.05 px: an older white image",
            DEEP_MM,
            DEEP_TEXT,
            expected=-PIXEL_MM * SLANT_PER_MM,
        ),
    ),
    advice="Take the white image on the day of the measurement: lens images 0.05 px off slant lateral places "
    "by {error}, and a whole pixel off hardly a tracer is found.",
)

TURN = Influence(
    name="lattice-turn",
    label="lattice believed to be turned further (degrees)",
    values=around(0.15),
    measure=partial(in_places, small_rig.lattice_turned),
    panels=(
        Panel(
            "turn of lateral places",
            (
                Series("turn", "in the focal plane (degrees)", 1.0 / TURN_PER_DEG, True),
                Series("twist", "more for each mm of depth (degrees/mm)", 1.0 / TURN_PER_DEG, True),
            ),
        ),
        Panel("found of the tracers", (Series("recall", "found"), Series("precision", "of those found, true"))),
    ),
    sensitivities=(
        Sensitivity(
            "twist",
            "turn about the axis for each mm from the focal plane",
            "deg/mm per deg",
            1.0 / TURN_PER_DEG,
            0.005,
            "0.005 degrees: an older white image",
            DEEP_MM * ASIDE_MM,
            f"{DEEP_TEXT}, {ASIDE_TEXT}",
            expected=TURN_PER_DEG * SLANT_PER_MM,
        ),
    ),
    advice="Take the white image with the camera as it measures: a lattice turned by 0.005 degrees twists places by "
    "{error}, and what it hides grows with the distance from the axis.",
)
