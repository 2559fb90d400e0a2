"""The corners of a chessboard or ChArUco target in sub-aperture views, by OpenCV, and where they are in the scene.

A corner's place over the views moves along a straight line, x_m = alpha X - x s_i/s_o: the slope is its defocus, which
tells the depth, the middle its lateral place. Views have one sample per microlens: squares are several of them wide.

Axes: image axes (x along the columns, y along the rows), mm; rectified pictures, whose microlenses stand upright.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats, Integers, Singles
from lfpiv_cli.calibration import views as of_views
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.rectification import turned
from lfpiv_cli.calibration.shape_fit import PointShape, ShapeFit, fit_shape, pixels_near, scene_points, scene_shares
from lfpiv_cli.calibration.views import clear_mm, described, lens_table
from lfpiv_cli.calibration.wave_shapes import WaveLight, WaveShapes, corner_strips
from lfpiv_cli.errors import InputError
from lfpiv_cli.kernels import njit
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera, undistorted
from lfpiv_cli.optics.media import Media
from lfpiv_cli.robust import MAD_TO_SIGMA
from lfpiv_cli.threads import in_threads

# What a corner of a chessboard looks like on the sensor, and the corner that explains given pixels best.
#
# A pixel's light is the share of the polygon that its microlens is, seen in the scene (see `shape_fit`), that lies in
# two opposite quadrants about the corner, exactly. With sgn u sgn v the quadrants' sign, the integral of it over a
# polygon is that of |u| sgn v dv along its edges (Green's theorem), which is summed over the parts of an edge in one
# quadrant; (u, v) run along the edges that meet in the corner.

# Steps of the fit are measured in this share of a square.
STEP_SHARE = 0.25


def corner_shape(edges_mm: Floats) -> PointShape:
    """Return the squares that meet in a corner, by their sides x and y (2, 2), those of one colour."""
    side = np.hypot(edges_mm[:, 0], edges_mm[:, 1])
    step, to_edges = STEP_SHARE * float(side.mean()), np.asarray(np.linalg.inv(edges_mm), dtype=np.float64)
    return PointShape(step, 0.5 * float(side.min()), quadrant_shares, to_edges, partial(corner_strips, edges_mm))


@njit(cache=True)
def quadrant_shares(
    middle: Floats, cell: Floats, to_edges: Floats, width: float, samples: int
) -> tuple[Floats, Floats]:
    """Return the mean share of `cell`, moved to `middle` and over a square of `width` around it, where u v > 0.

    The slopes (n, 4) are its derivatives by the middle's x and y, the logarithm of the cell's size, and the width.
    """
    edged = cell @ to_edges
    shares, slopes = np.zeros(middle.shape[0]), np.zeros((middle.shape[0], 4))
    sums = np.empty(5)
    weight = 0.5 / (samples * samples)
    for n in range(middle.shape[0]):
        for a in range(samples):
            for b in range(samples):
                off_x, off_y = (a + 0.5) / samples - 0.5, (b + 0.5) / samples - 0.5
                x, y = middle[n, 0] + width * off_x, middle[n, 1] + width * off_y
                u = x * to_edges[0, 0] + y * to_edges[1, 0]
                v = x * to_edges[0, 1] + y * to_edges[1, 1]
                quadrant_sums(u, v, edged, sums)
                mean, by_u, by_v = sums[0] / sums[4], weight * sums[1] / sums[4], weight * sums[2] / sums[4]
                by_x = by_u * to_edges[0, 0] + by_v * to_edges[0, 1]
                by_y = by_u * to_edges[1, 0] + by_v * to_edges[1, 1]
                shares[n] += weight * (1.0 + mean)
                slopes[n, 0] += by_x
                slopes[n, 1] += by_y
                slopes[n, 2] += weight * (sums[3] / sums[4] - 2.0 * mean)
                slopes[n, 3] += by_x * off_x + by_y * off_y
    return shares, slopes


@njit(cache=True)
def quadrant_sums(u: float, v: float, cell: Floats, sums: Floats) -> None:
    """Write the integral of sgn u sgn v over a polygon `cell` moved to (u, v), its slopes, and the polygon's area.

    The slopes are by u, by v and by the logarithm of the cell's size: every part of an edge sweeps an area.
    """
    sums[:] = 0.0
    cuts = np.empty(4)
    for k in range(cell.shape[0]):
        following = (k + 1) % cell.shape[0]
        u_0, v_0 = u + cell[k, 0], v + cell[k, 1]
        du, dv = cell[following, 0] - cell[k, 0], cell[following, 1] - cell[k, 1]
        cuts[0], cuts[3] = 0.0, 1.0
        first = min(max(-u_0 / du, 0.0), 1.0) if du != 0.0 else 0.0
        second = min(max(-v_0 / dv, 0.0), 1.0) if dv != 0.0 else 0.0
        cuts[1], cuts[2] = min(first, second), max(first, second)
        sums[4] += 0.5 * (u_0 * dv - v_0 * du)
        swept = cell[k, 0] * dv - cell[k, 1] * du
        for part in range(3):
            length = cuts[part + 1] - cuts[part]
            half_way = 0.5 * (cuts[part] + cuts[part + 1])
            at_u, at_v = u_0 + half_way * du, v_0 + half_way * dv
            sign = length if at_u * at_v > 0.0 else -length
            sums[0] += sign * at_u * dv
            sums[1] += sign * dv
            sums[2] -= sign * du
            sums[3] += sign * swept


# Views are enlarged by this for OpenCV's detectors, which want squares of ten pixels and modules of three.
ENLARGED = 4
# Between these percentiles of the view lie black and white.
BLACK, WHITE = 1.0, 99.0
# Below this width in microlenses a square's corners run into each other once they are out of focus.
SMALLEST_SQUARE_LENSES = 5.0
# The squares in a marker are told apart from this width on.
SMALLEST_MODULE_LENSES = 1.5
# In views a corner is refined within this share of what is clear of other things about it.
WINDOW_SHARE = 0.9
# OpenCV's refinement ends here, in samples; two edges that it sees are known to a hundredth.
REFINE = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
# Softening of the views in samples: what steps between microlenses would draw the refinement to their grid.
SOFTENING = 1.0
# Pixels at the rim of a micro-image are lit in part: views stay this many pixels inside the aperture's rim.
RIM_PIXELS = 2.0
# A sighting this many robust deviations off its corner's line is another thing.
STRAY_SIGMAS = 5.0
LINE_ROUNDS = 4
# As many views nearest the middle tell where corners are in those further out; with the slope of all of them
# the corners are looked for again.
FIRST_VIEWS = 5
VIEW_ROUNDS = 2
# Three unknowns of a line and their errors need more than a few sightings.
FEWEST_VIEWS = 8
# With fewer corners than these there is no grid.
FEWEST_CORNERS = 4


@dataclass(frozen=True, eq=False)
class Look(ABC):
    """A picture of a target and the points in it, roughly.

    Attributes
    ----------
    signal, passed : (rows, columns) light, dots bright, and the share of it that pixels pass
    medium : what the target stands in
    off_px : see `shape_fit.pixels_near`
    """

    signal: Floats
    passed: Singles
    medium: Media
    off_px: Singles | None = field(default=None, kw_only=True)

    # More pixels than these make a fit slower and hardly better: the model's own errors are larger than their noise.
    most_pixels: ClassVar[int]

    def moved(self, scale: float, depth_mm: float) -> Look:
        """Return the look with its points nearer the axis by a scale, at another depth, if it says where they are."""
        return self

    @abstractmethod
    def begun(self, camera: Camera, board: BoardGeometry) -> tuple[Floats, Integers | None, PointShape]:
        """Return first guesses (n, 3) of the points, image axes, their numbers (n, 2) if known, and what lies there."""

    @abstractmethod
    def reach_mm(self, camera: Camera, board: BoardGeometry, z_mm: float) -> float:
        """Return how far about a point at a depth the pixels see that belong to its fit."""

    def measured(
        self, camera: Camera, board: BoardGeometry, rotation_rad: float, by: WaveLight | None = None
    ) -> tuple[Floats, Floats, Integers | None]:
        """Return where points are, fitted to what pixels see about them by rays, and from there by waves.

        That is places and standard errors (n, 3), turned back to the raw sensor's axes, and numbers (n, 2) of the
        target, turned in any way; None where the grid tells.
        """
        places, numbers, shape = self.begun(camera, board)
        waves = None
        for light in [None] if by is None else [None, by]:
            if light is not None and len(places):
                # Others are no points of a board, and line responses over all depths take long to compute.
                near = np.abs(places[:, 2] - np.median(places[:, 2])) < camera.scale(self.medium).depth_mm
                places, numbers = places[near], None if numbers is None else numbers[near]
                waves = WaveShapes.of(camera, self.medium, light, places[:, 2])
            fits = in_threads(partial(self.fitted, camera=camera, board=board, shape=shape, waves=waves), places)
            numbers = None if numbers is None else numbers[[fit is not None for fit in fits]]
            places = np.array([fit.position_mm for fit in fits if fit is not None]).reshape(-1, 3)
        sigmas = np.sqrt(np.array([np.diag(fit.covariance_mm2) for fit in fits if fit is not None])).reshape(-1, 3)
        return camera.to_image_axes(turned(places, rotation_rad)), camera.to_image_axes(sigmas), numbers

    def fitted(
        self, start_mm: Floats, camera: Camera, board: BoardGeometry, shape: PointShape, waves: WaveShapes | None
    ) -> ShapeFit | None:
        """Fit a point's shape from a first guess (3,), by rays or by waves; None where that leads to none."""
        z, medium = float(start_mm[2]), self.medium
        reach = self.reach_mm(camera, board, z)
        picture = self.signal, self.passed
        near = pixels_near(picture, camera, medium, start_mm, reach, self.most_pixels, self.off_px)
        if near is None:
            return None
        # Moves that change the light alike: sideways, and in depth what moves the rim's rays as far.
        deep = shape.step_mm * camera.focus_distance_mm / (camera.aperture_radius_mm * medium.depth_ratio)
        steps, rays = np.array([shape.step_mm, shape.step_mm, deep]), near.rays
        shares_at = partial(scene_shares, rays, camera, medium, shape)
        if waves is not None:
            shares_at = partial(waves.shares_and_slopes, rays, shape.strips(waves.lens_mm), steps)
        found = fit_shape(near, start_mm, steps, scene_points(rays, camera, medium, z) - start_mm[:2], shares_at)
        # Where its pixels do not hold a point in some direction, rounding leaves variances of 0 or less.
        held = found.converged and bool((np.diag(found.covariance_mm2) > 0.0).all())
        # What is darker than the ground is no dot; of a corner's squares either two may be the dark ones.
        return found if held and (found.brightness > 0.0 or board.pattern != "dots") else None


@dataclass(frozen=True, eq=False)
class CornerLook(Look):
    """The corners of a target in the view from the main lens's middle.

    Attributes
    ----------
    numbers : (n, 2) which corner of the target, along its columns and rows
    sample : (n, 2) where, in samples (column, row) of the upright view
    """

    numbers: Integers
    sample: Floats

    most_pixels = 4_000

    def begun(self, camera: Camera, board: BoardGeometry) -> tuple[Floats, Integers, PointShape]:
        """Return where the corners' lines x_m = alpha X - x s_i/s_o have them."""
        lines, s_i = straight_lines(*self.sightings(camera, board), camera), camera.image_distance_mm
        distance = s_i / (lines[:, 2] - 1.0 + s_i / camera.focal_length_mm)
        depth = (distance - camera.focus_distance_mm) / self.medium.depth_ratio
        start = np.column_stack([-lines[:, :2] * (distance / s_i)[:, np.newaxis], depth])
        known = np.isfinite(start).all(axis=1)
        if known.sum() < FEWEST_CORNERS:
            raise InputError(
                f"only {known.sum()} of the board's corners are seen through enough of the main lens, at least "
                f"{FEWEST_CORNERS} are needed; check the exposure and that the board is in the picture"
            )
        numbers, start = self.numbers[known], start[known]
        terms = np.column_stack([np.ones(len(numbers)), numbers])
        edges = np.asarray(np.linalg.lstsq(terms, start[:, :2], rcond=None)[0][1:], dtype=np.float64)
        return start, numbers, corner_shape(edges)

    def reach_mm(self, camera: Camera, board: BoardGeometry, z_mm: float) -> float:
        """Return how far there is nothing but the corner's squares, less half a microlens."""
        return clear_mm(board) - 0.5 * float(camera.lattice.pitch.max()) / abs(camera.magnification)

    def sightings(self, camera: Camera, board: BoardGeometry) -> tuple[Floats, Floats]:
        """Return points of the main lens (views, 2) and where on the array each shows the corners (views, n, 2).

        NaN where it does not. Views are followed from the main lens's middle outward.
        """
        crossings = of_views.view_crossings(camera, RIM_PIXELS)
        crossings = crossings[np.argsort(np.hypot(crossings[:, 0], crossings[:, 1]), kind="stable")]
        grid, even = ViewGrid.of(camera), evenly_lit(self.signal, self.passed)
        clear = clear_mm(board) * abs(camera.magnification) / grid.step_mm
        half = tuple(int(max(2, np.floor(WINDOW_SHARE * n))) for n in clear)
        views = (upright_view(even, camera, grid, crossing) for crossing in crossings)
        pictures = [np.asarray(cv2.GaussianBlur(view, (0, 0), SOFTENING), dtype=np.float32) for view in views]
        inside = np.isfinite(refined(pictures[0], self.sample, half)).all(axis=1)
        middle, slope = grid.to_mm(self.sample[inside]), 0.0
        seen = np.full((len(pictures), len(middle), 2), np.nan)
        for round_ in range(VIEW_ROUNDS):
            for k, (crossing, picture) in enumerate(zip(crossings, pictures, strict=True)):
                sample = (middle + slope * crossing - grid.origin_mm) / grid.step_mm
                seen[k] = grid.to_mm(refined(picture, sample, half))
                known = len(pictures) if round_ else k + 1
                if known >= FIRST_VIEWS:
                    slope = common_slope(crossings[:known], seen[:known])
            off = seen - slope * crossings[:, np.newaxis]
            shown = np.isfinite(off).any(axis=(0, 2))
            middle[shown] = np.nanmedian(off[:, shown], axis=0)
        of_all = np.full((len(crossings), len(self.sample), 2), np.nan)
        of_all[:, inside] = seen
        return crossings, of_all


@dataclass(frozen=True, eq=False)
class ViewGrid:
    """The upright samples of a view: rows of even steps, one per microlens, also where the array is hexagonal.

    Attributes
    ----------
    lenses_mm : (rows, columns, 2) centres of the microlenses
    origin_mm, step_mm : (2,) of the samples on the array
    """

    lenses_mm: Floats
    origin_mm: Floats
    step_mm: Floats

    @classmethod
    def of(cls, camera: Camera) -> ViewGrid:
        """Return the grid of a camera's views; on hexagons, whose rows are staggered, half-way between two rows."""
        lenses = camera.lattice.points(lens_table(camera))
        left = lenses[:2, 0, 0].mean()
        step = np.array([lenses[0, 1, 0] - lenses[0, 0, 0], lenses[1, 0, 1] - lenses[0, 0, 1]])
        return cls(lenses, np.array([left, lenses[0, 0, 1]]), step)

    def to_mm(self, sample: Floats) -> Floats:
        """Return places on the array (..., 2) of samples (column, row)."""
        return np.asarray(self.origin_mm + sample * self.step_mm, dtype=np.float64)


def upright_view(image: Floats, camera: Camera, grid: ViewGrid, crossing_mm: Floats) -> Floats:
    """Return the view from a point of the main lens on the upright samples of the grid."""
    view = of_views.sub_aperture_view(image, camera, crossing_mm)
    at = grid.origin_mm[0] + np.arange(view.shape[1]) * grid.step_mm[0]
    return np.stack([np.interp(at, lenses[:, 0], row) for lenses, row in zip(grid.lenses_mm, view, strict=True)])


def refined(picture: Singles, guess: Floats, half: tuple[int, ...]) -> Floats:
    """Return corners (n, 2) to a fraction of a sample, NaN where the window leaves the picture or the corner it."""
    rows, columns = picture.shape
    margin = np.array(half) + 1.0
    inside = np.all((guess >= margin) & (guess <= np.array([columns, rows]) - 1.0 - margin), axis=1)
    found = np.full(guess.shape, np.nan)
    if inside.any():
        start = guess[inside].astype(np.float32).reshape(-1, 1, 2)
        end = cv2.cornerSubPix(picture, start.copy(), half, (-1, -1), REFINE)
        moved = np.abs(end - start).reshape(-1, 2)
        found[inside] = np.where(np.all(moved < np.array(half), axis=1)[:, np.newaxis], end.reshape(-1, 2), np.nan)
    return found


def common_slope(crossing_mm: Floats, seen_mm: Floats) -> float:
    """Return the slope of the places (views, n, 2) of all corners over the points of the main lens (views, 2)."""
    seen = seen_mm[:, np.isfinite(seen_mm).any(axis=(0, 2))]
    off = seen - np.nanmean(seen, axis=0)
    known = np.isfinite(off)
    crossing = np.where(known, crossing_mm[:, np.newaxis], 0.0)
    return float(np.sum(np.where(known, off, 0.0) * crossing) / np.sum(crossing**2))


def straight_lines(crossing_mm: Floats, seen_mm: Floats, camera: Camera) -> Floats:
    """Return for each corner the middle (x, y) and the slope alpha of its line (n, 3), NaN where few views show it.

    Parameters
    ----------
    crossing_mm : (views, 2) points of the main lens
    seen_mm : (views, n, 2) where each shows the corners on the array, NaN where it does not
    """
    lines = np.full((seen_mm.shape[1], 3), np.nan)
    for n in range(len(lines)):
        used = np.asarray(np.isfinite(seen_mm[:, n]).all(axis=1))
        for _ in range(LINE_ROUNDS):
            if used.sum() < FEWEST_VIEWS:
                lines[n] = np.nan
                break
            ideal = undistorted(seen_mm[used, n], camera.distortion_per_mm2)
            # a view is named by the ray through the lens's centre as it would go without distortion
            crossing = crossing_mm[used] + ideal - seen_mm[used, n]
            one, zero = np.ones(len(ideal)), np.zeros(len(ideal))
            terms = np.concatenate(
                [np.column_stack([one, zero, crossing[:, 0]]), np.column_stack([zero, one, crossing[:, 1]])]
            )
            lines[n] = np.linalg.lstsq(terms, ideal.T.ravel(), rcond=None)[0]
            off = np.hypot(*(ideal - lines[n, :2] - lines[n, 2] * crossing).T)
            stray = off > STRAY_SIGMAS * MAD_TO_SIGMA * np.median(off)
            if not stray.any():
                break
            used[np.flatnonzero(used)[stray]] = False
    return lines


def first_corners(image: Singles, passed: Singles, camera: Camera, board: BoardGeometry, media: Media) -> CornerLook:
    """Find the corners of a chessboard or ChArUco board in the view from the main lens's middle.

    Raises
    ------
    InputError : the squares are too small, or the board is not in the picture
    """
    per_mm = abs(camera.magnification) / float(camera.lattice.pitch.max())
    widths = {"the board's squares": (board.spacing_mm, SMALLEST_SQUARE_LENSES)}
    if board.pattern == "charuco":
        # The black border of a marker is one of its squares.
        words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        modules = int(words.markerSize) + 2
        widths["the squares in its markers"] = (board.marker_mm / modules, SMALLEST_MODULE_LENSES)
    for what, (width, least) in widths.items():
        if width * per_mm < least:
            raise InputError(
                f"{what} are {written(width * per_mm)} microlenses wide on the array, less than {least:g}; use a board "
                "with larger ones"
            )
    picture, scale = enlarged_view(evenly_lit(image, passed), camera)
    found = of_views.board_corners(picture, board)
    if found is None:
        raise InputError(
            f"{described(board)} was not found in the picture; check board.pattern, board.squares, the exposure and "
            "the focus"
        )
    numbers, place = found
    return CornerLook(image.astype(np.float64), passed, media, numbers, (place + 0.5) / scale - 0.5)


def evenly_lit(image: NDArray[np.floating], passed: Singles) -> Floats:
    """Return a picture (rows, columns) divided by the share of light that pixels pass, 0 where it is unusable."""
    usable = passed > 0.0
    return np.where(usable, image.astype(np.float64) / np.where(usable, passed, 1.0), 0.0)


def enlarged_view(signal: Floats, camera: Camera) -> tuple[NDArray[np.uint8], Floats]:
    """Return the middle's view in grey levels, enlarged, its samples square, and by how much along columns and rows."""
    grid = ViewGrid.of(camera)
    view = upright_view(signal, camera, grid, np.zeros(2))
    black, white = np.percentile(view, [BLACK, WHITE])
    grey = np.clip(255.0 * (view - black) / max(white - black, np.finfo(np.float64).tiny), 0.0, 255.0)
    size = np.rint(ENLARGED * np.array(view.shape[::-1]) * grid.step_mm / grid.step_mm[0]).astype(int)
    large = cv2.resize(grey.astype(np.float32), tuple(int(n) for n in size), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.rint(large), 0, 255).astype(np.uint8), size / np.array(view.shape[::-1])
