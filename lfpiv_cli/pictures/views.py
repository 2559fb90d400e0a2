"""A picture of the decoded light field: rightly calibrated, the views are alike and the board is sharp at its depth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.calibration.views import refocused_stack, views_across
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.pictures.style import new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Enough views to see vignetting and a wrong lattice at the rim, few enough to see dots in each.
VIEWS_PER_SIDE = 5
# Depths of the stack, in units over which the main lens's rim moves a point by a microlens.
STEPS = (-4.0, -2.0, 0.0, 2.0, 4.0)


@styled
def views_figure(calibration: Calibration, camera: Camera, media: Media, image: ArrayLike) -> Figure:
    """Return a figure with the views of a raw picture less its dark frame, and the same refocused about the board.

    `camera` is the data sheet's and `media` what the picture was taken in. Needs matplotlib.
    """
    measured = calibration.camera(camera)
    rectified = calibration.rectification.apply(image)
    unit = float(measured.lattice.pitch.max()) / measured.aperture_radius_mm * measured.focus_distance_mm
    middle = 0.0 if calibration.pose is None else calibration.pose.z0_mm
    depths = middle + np.array(STEPS) * unit * abs(1.0 / measured.magnification) / media.depth_ratio
    stack = refocused_stack(rectified, measured, media, depths, calibration.transmission)

    views = views_across(rectified, measured, VIEWS_PER_SIDE)
    brightest = max(float(view.max()) for _, view in views.values())
    figure = new_figure(13.0, 12.5)
    grid = figure.add_gridspec(VIEWS_PER_SIDE + 1, len(STEPS), height_ratios=(1.0,) * VIEWS_PER_SIDE + (1.3,))
    for (row, column), (point, view) in views.items():
        axis = figure.add_subplot(grid[row, column])
        axis.imshow(view, cmap="gray", vmin=0.0, vmax=brightest, interpolation="nearest")
        axis.set_title(f"X = {written(point[0], 2)}, Y = {written(point[1], 2)} mm")
        axis.set_axis_off()
    for k, (depth, picture) in enumerate(zip(depths, stack, strict=True)):
        axis = figure.add_subplot(grid[-1, k])
        axis.imshow(picture, cmap="gray", interpolation="nearest", vmin=0.0, vmax=float(stack.max()))
        axis.set_title(f"refocused at z = {depth:z.2f} mm")
        axis.set_axis_off()
    figure.suptitle("views from points (X, Y) of the main lens, one sample per microlens; below, refocused")
    return figure
