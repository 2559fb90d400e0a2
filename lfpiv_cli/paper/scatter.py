"""Influences that scatter places and velocities, the camera being known: aperture, noise, depth, number of tracers."""

from __future__ import annotations

from lfpiv_cli.paper import small_scenes
from lfpiv_cli.paper.influences import Influence, Sensitivity
from lfpiv_cli.paper.small_rig import F_NUMBER, sheet
from lfpiv_cli.validation.sensitivity_pictures import Panel, Series

# The paper's 0.002 tracers a pixel.
PAPER_PER_PIXEL = 0.002
PAPER_PER_LENS = float(PAPER_PER_PIXEL * sheet().micro_image_lattice_px().pitch[0] ** 2)

F_NUMBERS = Influence(
    name="f-number",
    label="f-number of the main lens",
    values=((4.0, 8.0), (2.8, 4.0, 8.0), (2.8, 3.3, 4.0, 4.8, 5.6, 6.7, 8.0)),
    measure=small_scenes.at_f_number,
    panels=(
        Panel(
            "error of depth behind 134 mm of water (mm)",
            (
                Series("paraxial_offset_z", "rays taken as paraxial", 1.0, True, power=-2.0),
                Series("exact_offset_z", "rays by Snell's law"),
            ),
        ),
        Panel(
            "spread of depth (um)",
            (
                Series("paraxial_spread_z", "rays taken as paraxial", 1e3),
                Series("exact_spread_z", "rays by Snell's law", 1e3),
            ),
        ),
    ),
    sensitivities=(
        Sensitivity(
            "paraxial_offset_z",
            "depth by paraxial rays, behind 134 mm of water",
            "mm over the square of the f-number",
            1.0,
            F_NUMBER**-2,
            "f/4, paraxial",
            expected=-small_scenes.spherical_aberration_mm(1.0),
            power=-2.0,
        ),
    ),
    advice="Bend rays by Snell's law behind much fluid: paraxial ones put depths off by {error} behind 134 mm "
    "of water at f/4, less as the square of the f-number and in proportion to the fluid.",
)

# Read noise over light at which scatter is told and held against its bound: the fit knows neither noise nor light, and
# tracers overlap.
FAINT, LARGEST_OVER_BOUND = 0.1, 1.5

NOISE = Influence(
    name="noise",
    label="read noise over the light of a lit pixel",
    values=((0.0, 0.1), (0.0, 0.1, 0.2), (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)),
    measure=small_scenes.in_noise,
    panels=(
        Panel(
            "spread of depth (um)",
            (Series("spread_z", "measured", 1e3), Series("bound_z", "Cramer-Rao bound (median)", 1e3)),
        ),
        Panel(
            "spread of x (um)",
            (Series("spread_x", "measured", 1e3), Series("bound_x", "Cramer-Rao bound (median)", 1e3)),
        ),
    ),
    sensitivities=(
        Sensitivity(
            "spread_z", "spread of depth where noise is a tenth", "um", 1e3, 1.0, "a tenth: faint tracers", at=FAINT
        ),
        Sensitivity(
            "spread_x", "spread of x where noise is a tenth", "um", 1e3, 1.0, "a tenth: faint tracers", at=FAINT
        ),
    ),
    advice="Give tracers light: where read noise is a tenth of what a lit pixel holds, depths scatter by "
    "{error}, and a velocity by that, times 1.4, over the time between the images.",
    repeats=2,
)

DISTANCE = Influence(
    name="depth",
    label="distance of the tracers from the focal plane (mm)",
    values=((1.0, 5.0), (0.25, 3.0, 10.0), (0.25, 1.0, 2.0, 3.5, 5.0, 7.5, 10.0)),
    measure=small_scenes.at_depth,
    panels=(
        Panel(
            "error of depth (um)",
            (Series("spread_z", "typical (1.48 times the median)", 1e3), Series("rms_z", "rms", 1e3)),
            logarithmic=True,
        ),
        Panel(
            "error of x (um)",
            (Series("spread_x", "typical (1.48 times the median)", 1e3), Series("rms_x", "rms", 1e3)),
            logarithmic=True,
        ),
    ),
    sensitivities=(
        Sensitivity("rms_z", "rms error of depth", "um", 1e3, 1.0, "at 0.25 mm", reach_text="at 0.25 mm", at=0.25),
        Sensitivity("spread_z", "typical error of depth", "um", 1e3, 1.0, "at 10 mm", reach_text="at 10 mm", at=10.0),
    ),
    advice="Keep the focal plane out of what matters most: within a quarter of a millimetre of it depths are wrong by "
    "{error} rms, as light stays within a lens and the side of the plane is hard to tell.",
    repeats=2,
)

SEEDING = Influence(
    name="seeding",
    label="tracers for each microlens",
    values=((0.1, 0.3), (0.1, 0.67, 1.2), (0.1, 0.25, 0.67, 1.2, 2.0, 4.0)),
    measure=small_scenes.crowded,
    panels=(
        Panel(
            "share, and slope of w",
            (
                Series("recall", "tracers found"),
                Series("precision", "of those found, true"),
                Series("tracks_slope_w", "slope of w, particles"),
                Series("volumes_slope_w", "slope of w, volumes"),
            ),
        ),
        Panel(
            "rms error (mm)",
            (
                Series("rms_z", "depth of a tracer"),
                Series("tracks_rms_w", "displacement in depth, particles"),
                Series("volumes_rms_w", "displacement in depth, volumes"),
                Series("tracks_rms_u", "lateral displacement, particles"),
                Series("volumes_rms_u", "lateral displacement, volumes"),
            ),
            logarithmic=True,
        ),
    ),
    sensitivities=(
        Sensitivity(
            "tracks_rms_w",
            "displacement in depth by particles",
            "um",
            1e3,
            1.0,
            "the paper's seeding",
            reach_text="at 0.67 a microlens",
            at=0.67,
        ),
        Sensitivity(
            "volumes_rms_w",
            "displacement in depth by volumes",
            "um",
            1e3,
            1.0,
            "the paper's seeding",
            reach_text="at 0.67 a microlens",
            at=0.67,
        ),
    ),
    advice="Take particles rather than volumes where the depth component matters, and seed no more than they "
    "bear: at the paper's seeding volumes have a displacement in depth wrong by {error} rms.",
    logarithmic=True,
)
