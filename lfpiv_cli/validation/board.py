"""Reconstructed boards: how long the dots are in depth and where they lie (the paper's Section 3.3, Eqs. 17 to 20).

Axes: volumes [z, y, x] on a grid in mm. The dots' places in the plane tell which voxels belong to which dot; everything
else is measured.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from lfpiv_cli.arrays import Floats, Singles
from lfpiv_cli.calibration.dlfc import fit_rays
from lfpiv_cli.calibration.model import Rig
from lfpiv_cli.errors import InputError
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import written
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.pictures.style import Figure, new_panels, styled
from lfpiv_cli.reconstruction.images import Image, Mask
from lfpiv_cli.reconstruction.solvers import Reconstruction
from lfpiv_cli.synthetic.board import BoardPlacement, dot_centres
from lfpiv_cli.weights.build import factorise_through, scene_distortion
from lfpiv_cli.weights.columns import operator_of
from lfpiv_cli.weights.model import Weights


@styled
def board_figure(figures: dict[str, Any], volume: Singles, grid: Grid) -> Figure:
    """Return a figure of a board (its light in the plane and from the side) and of the errors by depth.

    `volume` [z, y, x] is the reconstruction of the board nearest the focal plane; `figures` are `board_figures`.
    """
    figure, panels = new_panels(13.0, 8.0, 2, 3)
    axes = panels.ravel()
    bounds = [grid.bounds_mm(axis) for axis in range(3)]
    axes[0].imshow(volume.max(axis=0), origin="lower", extent=(*bounds[0], *bounds[1]))
    axes[0].set(title="board nearest the focal plane, maximum along z", xlabel="x (mm)", ylabel="y (mm)")
    axes[1].imshow(volume.max(axis=1), origin="lower", extent=(*bounds[0], *bounds[2]), aspect="auto")
    axes[1].set(title="the same, maximum along y", xlabel="x (mm)", ylabel="z (mm)")
    table = figures["by_depth"]
    depth = np.array(table["depth_mm"])
    axes[2].errorbar(depth, table["elongation_mm"], table["elongation_sigma_mm"], fmt="o-", capsize=3)
    axes[2].set(title="elongation and its spread", xlabel="z (mm)", ylabel="mm", ylim=(0, None))
    axes[3].plot(depth, np.array(table["centre_mm"]) - depth, "o-", label="Gaussian")
    axes[3].plot(depth, np.array(table["centre_mass_mm"]) - depth, "s--", label="centre of mass")
    axes[3].set(title="centres, measured less true", xlabel="z (mm)", ylabel="mm")
    axes[3].legend()
    middle = 0.5 * (depth[1:] + depth[:-1])
    axes[4].plot(middle, np.diff(table["centre_mm"]) / np.diff(depth), "o-")
    axes[4].set(title="separation of neighbouring depths over the true one", xlabel="z (mm)")
    axes[5].plot(depth, table["spacing_mm"], "o-")
    axes[5].set(title="lateral spacing", xlabel="z (mm)", ylabel="mm")
    return figure


# At what depth a reconstructed dot lies: definitions, all of which find the middle of a long, even dot.
#
# Eq. 20 needs a depth and the paper says no more of it than "Gaussian peak fittings". Dots next to the focal plane
# are not even: there definitions differ by tenths of a millimetre.

Depths = Floats
Profile = Floats

# Below this share of the peak of a depth profile lies what is left of other dots' light.
SHARE = float(1.0 / np.e)
# Height, centre and width.
GAUSSIAN_PARAMETERS = 3


class DepthDefinition(NamedTuple):
    """A definition of the depth of a dot: from the planes' depths and what of each, its sum or maximum, in a column."""

    words: str
    profile: Literal["sum", "maximum"]
    depth_mm: Callable[[Depths, Profile], float]


def width_ends_mm(z_mm: Depths, profile: Profile, peak: int | None = None) -> tuple[float, float]:
    """Return where a profile around a peak, by default its highest, falls to 1/e of it.

    Between samples the profile is taken as linear.
    """
    peak = int(np.argmax(profile)) if peak is None else peak
    limit = profile[peak] * SHARE
    ends = []
    for at, step in zip(_run_above(profile, peak, limit), (-1, 1), strict=True):
        if 0 <= at + step < z_mm.size:
            share = (profile[at] - limit) / (profile[at] - profile[at + step])
            ends.append(float(z_mm[at] + share * (z_mm[at + step] - z_mm[at])))
        else:
            ends.append(float(z_mm[at]))
    return ends[0], ends[1]


def _run_above(profile: Profile, peak: int, limit: float) -> tuple[int, int]:
    """Return the first and last sample of the run around the peak that is above the limit."""
    low = np.flatnonzero(profile[:peak] <= limit)
    high = np.flatnonzero(profile[peak + 1 :] <= limit)
    return int(low[-1]) + 1 if low.size else 0, peak + int(high[0]) if high.size else profile.size - 1


def gaussian_centre_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the centre of the least-squares Gaussian through a profile, its peak where no fit is found."""
    peak = int(np.argmax(profile))
    if z_mm.size < GAUSSIAN_PARAMETERS:
        return float(z_mm[peak])
    ends = width_ends_mm(z_mm, profile)
    width = max((ends[1] - ends[0]) / (2.0 * np.sqrt(2.0)), float(z_mm[1] - z_mm[0]))

    def misfit(values: Floats) -> Floats:
        height, centre, sigma = values
        return np.asarray(height * np.exp(-0.5 * ((z_mm - centre) / sigma) ** 2) - profile)

    found = least_squares(misfit, (profile[peak], z_mm[peak], width), method="lm")
    return float(found.x[1] if found.success else z_mm[peak])


def gaussian_peak_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the centre of the least-squares Gaussian through the run of a profile above 1/e of its peak."""
    peak = int(np.argmax(profile))
    first, last = _run_above(profile, peak, profile[peak] * SHARE)
    run = slice(max(first - 1, 0), last + 2)
    return gaussian_centre_mm(z_mm[run], profile[run])


def three_point_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the peak of the Gaussian through the highest sample and its neighbours; at the ends, that sample."""
    peak = int(np.argmax(profile))
    near = profile[max(peak - 1, 0) : peak + 2]
    if near.size < 3 or near.min() <= 0.0:
        return float(z_mm[peak])
    before, top, after = np.log(near)
    bend = before - 2.0 * top + after
    return float(z_mm[peak] + (0.5 * (before - after) / bend * (z_mm[1] - z_mm[0]) if bend < 0.0 else 0.0))


def mass_centre_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the centre of mass of a profile where it exceeds 1/e of its peak."""
    high = profile > profile.max() * SHARE
    return float(profile[high] @ z_mm[high] / profile[high].sum())


def middle_mm(z_mm: Depths, profile: Profile) -> float:
    """Return the middle between the depths where a profile falls to 1/e of its peak: that of the elongation."""
    return float(np.mean(width_ends_mm(z_mm, profile)))


DEPTH_DEFINITIONS = {
    "gaussian": DepthDefinition("Gaussian through the sum of each plane, all depths", "sum", gaussian_centre_mm),
    "gaussian_peak": DepthDefinition(
        "Gaussian through the sum of each plane, where it exceeds 1/e", "sum", gaussian_peak_mm
    ),
    "three_point": DepthDefinition("Gaussian through three samples at the peak of that sum", "sum", three_point_mm),
    "mass": DepthDefinition("centre of mass of that sum where it exceeds 1/e", "sum", mass_centre_mm),
    "middle": DepthDefinition("middle of where that sum exceeds 1/e", "sum", middle_mm),
    "maximum_gaussian": DepthDefinition(
        "Gaussian through the maximum of each plane, all depths", "maximum", gaussian_centre_mm
    ),
    "maximum_mass": DepthDefinition("centre of mass of that maximum where it exceeds 1/e", "maximum", mass_centre_mm),
    "maximum_middle": DepthDefinition("middle of the elongation", "maximum", middle_mm),
}
# What the paper's words, "Gaussian peak fittings", are taken to mean.
THE_PAPERS = "gaussian"

# The paper's boards: seventeen depths, a millimetre apart.
DEPTHS_MM = tuple(float(z) for z in range(-8, 9))
# What Table 3 has of its simulated boards and of those of its experiment, by method. Eqs. 17 to 20.
MEASURES = ("elongation_mm", "elongation_sigma_mm", "lateral_error", "depth_error")
PAPER = {
    ("ideal", "ert"): dict(zip(MEASURES, (3.54, 0.08, 0.0009, 0.0263), strict=True)),
    ("ideal", "dlfc"): dict(zip(MEASURES, (3.59, 0.07, 0.0003, 0.0260), strict=True)),
    ("recorded", "ert"): dict(zip(MEASURES, (3.65, 0.27, 0.0063, 0.0560), strict=True)),
    ("recorded", "dlfc"): dict(zip(MEASURES, (3.61, 0.25, 0.0011, 0.0495), strict=True)),
}


@dataclass(frozen=True, eq=False)
class DotFigures:
    """What was measured of the dots of one board, an entry for each dot, mm.

    Attributes
    ----------
    elongation_mm : depth over which the in-plane maximum exceeds 1/e of its peak, interpolated
    depth_mm : by each definition of `DEPTH_DEFINITIONS`
    lateral_mm : (n, 2) centre of mass in the plane
    """

    elongation_mm: Floats
    depth_mm: dict[str, Floats]
    lateral_mm: Floats

    @classmethod
    def from_plain(cls, values: Mapping[str, Any]) -> DotFigures:
        """Return the figures that lists of numbers hold."""
        depths = {name: np.array(each) for name, each in values["depth_mm"].items()}
        return cls(np.array(values["elongation_mm"]), depths, np.array(values["lateral_mm"]))


def measure_dots(volume: Singles, grid: Grid, centres_mm: Floats, reach_mm: float) -> DotFigures:
    """Measure each dot in the column of voxels within `reach_mm` of its centre (n, 2) in x and y.

    Raises
    ------
    InputError : a dot's column lies outside the volume or holds no light.
    """
    x, y, z = (grid.axis_mm(axis) for axis in range(3))
    elongations, lateral = [], []
    depths: dict[str, list[float]] = {name: [] for name in DEPTH_DEFINITIONS}
    for centre in centres_mm:
        near_x, near_y = np.abs(x - centre[0]) < reach_mm, np.abs(y - centre[1]) < reach_mm
        part = volume[np.ix_(np.arange(z.size), near_y, near_x)].astype(np.float64)
        if not part.size or part.max() <= 0.0:
            place = f"{written(centre[0])}, {written(centre[1])}"
            raise InputError(f"no light was reconstructed within {reach_mm} mm of the dot at {place}")
        profiles = {"sum": part.sum(axis=(1, 2)), "maximum": part.max(axis=(1, 2))}
        plane = part[profiles["sum"] > profiles["sum"].max() / np.e].sum(axis=0)
        lateral.append((plane.sum(axis=0) @ x[near_x] / plane.sum(), plane.sum(axis=1) @ y[near_y] / plane.sum()))
        elongations.append(elongation_mm(z, profiles["maximum"]))
        for name, each in DEPTH_DEFINITIONS.items():
            depths[name].append(each.depth_mm(z, profiles[each.profile]))
    by_definition = {name: np.array(each) for name, each in depths.items()}
    return DotFigures(np.array(elongations), by_definition, np.array(lateral))


def elongation_mm(z_mm: Floats, height: Floats, peak: int | None = None) -> float:
    """Return the depth over which a profile around a peak, by default its highest, exceeds 1/e of it."""
    near, far = width_ends_mm(z_mm, height, peak)
    return far - near


def board_figures(
    dots: list[DotFigures], depths_mm: tuple[float, ...], shape: tuple[int, int], spacing_mm: float
) -> dict[str, Any]:
    """Return Table 3's figures and the table by depth.

    Parameters
    ----------
    dots : of each board; the dots in rows along x, `shape` of them along x and y
    depths_mm : where the boards truly stood
    spacing_mm : x_g of Eq. 19

    Returns
    -------
    dict
        `elongation_mm` and `elongation_sigma_mm` (Eqs. 17, 18, averaged over the depths), `lateral_error` (Eq. 19) and
        `depth_error` (Eq. 20, averaged over the steps; `depth_error_mass` by centres of mass), and `by_depth`. Of each
        of the `depth_definitions`: `error`, and `shortest` and `longest` step over the true one.
    """
    lateral = [each.lateral_mm[:, 0].reshape(shape[1], shape[0]) for each in dots]
    places = place_figures(lateral, [each.depth_mm[THE_PAPERS] for each in dots], depths_mm, spacing_mm)
    mass, definitions = np.array([each.depth_mm["mass"].mean() for each in dots]), {}
    for name in DEPTH_DEFINITIONS:
        centres = np.array([each.depth_mm[name].mean() for each in dots])
        steps = np.diff(centres) / np.diff(depths_mm)
        ends = {"shortest": float(steps.min()), "longest": float(steps.max())}
        definitions[name] = {"error": depth_error(centres, depths_mm)} | ends
    return places | {
        "elongation_mm": float(np.mean([each.elongation_mm.mean() for each in dots])),
        "elongation_sigma_mm": float(np.mean([each.elongation_mm.std() for each in dots])),
        "depth_error_mass": depth_error(mass, depths_mm),
        "depth_definitions": definitions,
        "by_depth": places["by_depth"]
        | {
            "elongation_mm": [float(each.elongation_mm.mean()) for each in dots],
            "elongation_sigma_mm": [float(each.elongation_mm.std()) for each in dots],
            "centre_mass_mm": mass.tolist(),
        },
    }


def place_figures(
    x_mm: Sequence[Floats], depth_mm: Sequence[Floats], depths_mm: tuple[float, ...], spacing_mm: float
) -> dict[str, Any]:
    """Return the errors of place (Eqs. 19, 20) and the table by depth; dots that were not found are NaN.

    Parameters
    ----------
    x_mm : of each board, (dots along y, dots along x)
    depth_mm : of the dots of each board, any shape
    """
    spacing = [float(np.nanmean(np.diff(each, axis=1))) for each in x_mm]
    centre = [float(np.nanmean(each)) for each in depth_mm]
    return {
        "lateral_error": float(np.mean(np.abs(np.array(spacing) - spacing_mm)) / spacing_mm),
        "depth_error": depth_error(centre, depths_mm),
        "by_depth": {"depth_mm": list(depths_mm), "spacing_mm": spacing, "centre_mm": centre},
    }


def depth_error(centre_mm: Sequence[float] | Floats, depths_mm: Sequence[float]) -> float:
    """Return Eq. 20 averaged over the steps between neighbouring depths."""
    return float(np.mean(np.abs(np.diff(centre_mm) / np.diff(depths_mm) - 1.0)))


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


BoardSolver = Callable[[Singles, Callable[[int], None]], Reconstruction]


def board_in(
    bench: BoardBench, solve: BoardSolver, picture: Singles, placement: BoardPlacement, advance: Callable[[int], None]
) -> tuple[DotFigures, Singles, float]:
    """Return what is measured of the board in a picture, its volume [z, y, x], and the solver's last residual."""
    board, result = bench.rig.board, solve(picture, advance)
    volume = bench.weights.to_world(result.volume)
    centres = dot_centres(board, placement)[:, :2]
    dots = measure_dots(volume, bench.weights.grid, centres, 0.5 * board.spacing_mm)
    return dots, volume, float(result.residual[-1])
