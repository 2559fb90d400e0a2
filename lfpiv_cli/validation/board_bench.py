"""Where the boards of Section 3.3 are photographed: with an ideal camera, or with one that is as real ones are.

The ideal one is the data sheet's, its pictures free of noise and their light refracted paraxially. The real one has an
array that is turned and shifted, a main lens that distorts, a sensor with noise, and light refracted exactly; it is
calibrated from a white picture and one of a board in air, and nothing else is known of it. Weights are those of
equivalent points, or of rays fitted to the very boards (DLFC).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lfpiv_cli.calibration.dlfc import fit_rays
from lfpiv_cli.calibration.model import Photographs, Rig, calibrate
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.optics.waves import Waves
from lfpiv_cli.reconstruction.images import Image, Mask, light
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.synthetic.scenes import Misalignment, RecordingCamera, simulate_board, simulate_white
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.weights.build import factorise_through, scene_distortion
from lfpiv_cli.weights.columns import operator_of
from lfpiv_cli.weights.model import Weights

# The board that calibrates the real camera stands so far behind the focal plane, in air, where depth shows well.
CALIBRATION_BOARD_Z_MM = 0.3


@dataclass(frozen=True, eq=False)
class BoardBench:
    """A camera before which boards are held.

    Attributes
    ----------
    rig : its camera with the lattice of the weights' frame
    weights : of the volume in which boards are reconstructed
    picture : gives the picture (rows, columns) of a board in its place, in the weights' frame, dark taken off
    excluded : pixels (rows, columns) of that frame that lie off the sensor
    """

    rig: Rig
    weights: Weights
    picture: Callable[[BoardPlacement], Image]
    excluded: Mask

    def with_voxels(self, grid: Grid, assumed: ObjectSpace) -> BoardBench:
        """Return the bench with weights of equivalent points on another grid."""
        camera = self.rig.camera
        bend = None if self.weights.calibration is None else scene_distortion(camera, self.rig.media, grid)
        operator = factorise_through(camera, assumed, grid)
        weights = replace(self.weights, grid=grid, solver_operator=operator, scene_distortion_per_mm2=bend)
        return replace(self, weights=weights)

    def with_fitted_rays(self, pictures: Sequence[Image], depths_mm: Sequence[float]) -> BoardBench:
        """Return the bench with weights of rays fitted to pictures of its board at depths."""
        rays = fit_rays(pictures, depths_mm, self.rig.camera, self.rig.board, self.rig.media).rays
        operator = operator_of(self.rig.camera, rays, self.weights.grid)
        return replace(self, weights=replace(self.weights, solver_operator=operator, scene_distortion_per_mm2=None))


def ideal_bench(rig: Rig, grid: Grid, level: float, rng: np.random.Generator) -> BoardBench:
    """Return the data sheet's camera, `level` expected counts in a pixel that sees only what is bright."""
    space = ObjectSpace(rig.media, None, "paraxial")
    weights = Weights(grid, (0, 0, 0), factorise_through(rig.camera, space, grid), rig.camera.column_axis)

    def picture(placement: BoardPlacement) -> Image:
        return render_board(rig.camera, space, rig.board, placement, level, rng).astype(np.float32)

    return BoardBench(rig, weights, picture, np.zeros(weights.image_shape, np.bool_))


@dataclass(frozen=True)
class Reality:
    """How a real bench is other than its data sheets say.

    Attributes
    ----------
    misalignment : of the camera
    readout : of its sensor, with noise
    space : what lies before the lens
    waves : what light is made of; rays where there are none
    """

    misalignment: Misalignment
    readout: Readout
    space: ObjectSpace
    waves: Waves | None = None


def recorded_bench(
    rig: Rig, assumed: ObjectSpace, reality: Reality, grid: Grid, level: float, rng: np.random.Generator
) -> BoardBench:
    """Return a camera that departs from its data sheet, calibrated from pictures that it took.

    Parameters
    ----------
    rig : as the data sheets have it
    assumed : what is taken to lie before the lens, for the weights
    level : expected counts in a pixel that sees only what is bright
    """
    real = RecordingCamera(reality.misalignment.apply(rig.camera), reality.readout, reality.waves)
    dark = real.dark_frame(rng)
    white = simulate_white(real, level, rng).image
    board = replace(rig.board, medium="air")
    air = ObjectSpace(rig.media.in_air(), None, "paraxial")
    snapshot = simulate_board(real, air, board, BoardPlacement(CALIBRATION_BOARD_Z_MM), level, rng).image
    calibration = calibrate(Photographs([white], dark, snapshot), replace(rig, board=board))
    camera = calibration.camera(rig.camera)
    bend = scene_distortion(camera, rig.media, grid)
    operator = factorise_through(camera, assumed, grid)
    weights = Weights(grid, (0, 0, 0), operator, camera.column_axis, calibration, bend)

    def picture(placement: BoardPlacement) -> Image:
        recorded = simulate_board(real, reality.space, rig.board, placement, level, rng).image
        return weights.prepare(light(recorded.astype(np.float32), dark.astype(np.float32)))

    return BoardBench(replace(rig, camera=camera), weights, picture, ~calibration.rectification.inside)
