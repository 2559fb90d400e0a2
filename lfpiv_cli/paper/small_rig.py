"""A small piece of the paper's camera before its channel, so that a measurement takes seconds, and wrong ideas of it.

The lenses, pixels and tracers are the paper's, the sensor sees some 24 by 24 microlenses. Images are made of the rig as
it is, by Snell's law; places are measured with the rig as somebody believes it to be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import Channel, advised_move_mm
from lfpiv_cli.names import Refraction
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.microlenses import Lattice
from lfpiv_cli.optics.pupils import refocused
from lfpiv_cli.synthetic.scenes import Misalignment
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.validation.place_errors import fit_errors, pairs_of
from lfpiv_cli.validation.tracer_bench import BOARD, Rig, Search, Tracers, photograph

Points = NDArray[np.float64]
Figures = dict[str, float]

FOCAL_LENGTH_MM, PITCH_MM, PIXEL_MM = 100.0, 0.1, 0.0055
F_NUMBER = 4.0
SENSOR_PX = 448
WATER = Media(1.0, 1.49, 1.33)
CHANNEL = Channel(10.0, 5.0)
# Counts of a tracer's light: 2.5e5 photons, some 1,900 counts in a lit pixel.
LIGHT_COUNTS = 5e5
BRIGHTNESS = (0.6, 1.4)
# Tracers stand apart by this much, so that each measured place has one true one whatever is wrong, in this square and
# between these depths: within the channel, and light stays on the sensor.
APART_MM, JITTER_MM, HALF_WIDTH_MM, HALF_DEPTH_MM = 0.3, 0.05, 0.9, 4.0
# Lateral errors up to this leave no doubt about which tracer it is.
GATE_MM = 0.09
# Beside the tracers, what is searched is this much wider.
MARGIN_MM = 0.2


def sheet(f_number: float = F_NUMBER, pixels: int = SENSOR_PX) -> Camera:
    """Return the camera of the data sheet; the microlenses follow the f-number, so that lens images touch."""
    aperture = FOCAL_LENGTH_MM / f_number
    distance = PITCH_MM * 2.0 * FOCAL_LENGTH_MM / aperture
    lattice = Lattice.regular(PITCH_MM)
    return Camera(-1.0, FOCAL_LENGTH_MM, aperture, distance, distance, lattice, PIXEL_MM, pixels, pixels)


@dataclass(frozen=True, eq=False)
class Case:
    """A rig as it is and as it is believed to be, and how deep around the middle of the channel is looked."""

    true: Rig
    believed: Rig
    search_depth_mm: float = 2.0 * HALF_DEPTH_MM + 1.0


def rig(camera: Camera, media: Media = WATER, channel: Channel = CHANNEL, refraction: Refraction = "exact") -> Rig:
    """Return a rig focused on the middle of its channel."""
    return Rig(camera, media, channel, 0.0, refraction)


def aimed(true: Rig, believed: Rig, search_depth_mm: float = 2.0 * HALF_DEPTH_MM + 1.0) -> Case:
    """Return the case in which the camera was moved by what Eq. 21 advises from what is believed."""
    move = advised_move_mm(BOARD, believed.channel, believed.media)
    return Case(replace(true, channel=replace(true.channel, camera_move_mm=move)), believed, search_depth_mm)


def index_wrong(fluid: float) -> Case:
    """Return water taken for a fluid of another index."""
    camera = sheet()
    return aimed(rig(camera), rig(camera, Media(WATER.air, WATER.window, fluid)))


def wall_wrong(by_mm: float) -> Case:
    """Return a wall taken to be thicker than it is."""
    camera = sheet()
    return aimed(rig(camera), rig(camera, channel=replace(CHANNEL, wall_mm=CHANNEL.wall_mm + by_mm)))


def focus_wrong(by_mm: float) -> Case:
    """Return a lens whose plane of focus is taken to be farther away than it is, by so much in air.

    The believed plane is brought to the middle of the channel.
    """
    camera = sheet()
    focal, distance = camera.focal_length_mm, camera.focus_distance_mm - by_mm
    real = refocused(camera, -focal / (distance - focal))
    believed = camera.with_micro_images(real.micro_image_lattice_px())
    deeper = abs(by_mm) * WATER.fluid / WATER.air
    return Case(Rig(real, WATER, CHANNEL, by_mm), rig(believed), 2.0 * (HALF_DEPTH_MM + deeper))


def lattice_shifted(by_px: float) -> Case:
    """Return lens images taken to lie further along the columns than they do."""
    camera = sheet()
    return Case(rig(Misalignment(shift_px=(-by_px, 0.0)).apply(camera)), rig(camera))


def lattice_turned(by_deg: float) -> Case:
    """Return lens images taken to be turned further than they are, from the columns towards the rows."""
    camera = sheet()
    return Case(rig(Misalignment(rotation_deg=-by_deg).apply(camera)), rig(camera))


def strewn_apart(rng: np.random.Generator, depth_mm: tuple[float, float], half_width_mm: float) -> Tracers:
    """Return tracers that stand apart laterally, at any depth between two."""
    line = np.arange(-half_width_mm + 0.5 * APART_MM, half_width_mm, APART_MM)
    lateral = np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)
    lateral += rng.uniform(-JITTER_MM, JITTER_MM, lateral.shape)
    position = np.column_stack([lateral, rng.uniform(*depth_mm, len(lateral))])
    return Tracers(position, LIGHT_COUNTS * rng.uniform(*BRIGHTNESS, len(position)))


def place_figures(case: Case, tracers: Tracers, readout: Readout, rng: np.random.Generator) -> Figures:
    """Return the figures of the map from true to measured places, and the shares of tracers found and of those true.

    The map is NaN where too few are found to know it.
    """
    image = photograph(case.true, tracers, readout, rng)
    return judged(search_of(case).particles(image), tracers)


def search_of(case: Case) -> Search:
    """Return the search of a case, somewhat wider than tracers stand."""
    width = 2.0 * (HALF_WIDTH_MM + MARGIN_MM)
    return Search(case.believed, (width, width, case.search_depth_mm))


def judged(found: Points, tracers: Tracers) -> Figures:
    """Return the figures of measured places (n, 3) of tracers that stand apart."""
    pairs = pairs_of(found, tracers.position_mm, GATE_MM)
    shares = {
        "recall": len(pairs.true) / len(tracers.position_mm),
        "precision": len(pairs.found) / max(len(found), 1),
    }
    return fit_errors(tracers.position_mm[pairs.true], pairs.error_voxel).figures() | shares
