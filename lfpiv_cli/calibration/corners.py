"""The corners of a chessboard or ChArUco target in sub-aperture views, by OpenCV, and where they are in the scene.

A corner's place over the views moves along a straight line, x_m = alpha X - x s_i/s_o: the slope is its defocus, which
tells the depth, the middle its lateral place. Views have one sample per microlens: squares are several of them wide.

Axes: image axes (x along the columns, y along the rows), mm; rectified pictures, whose microlenses stand upright.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.calibration.corner_model import fit_corner, step_mm
from lfpiv_cli.calibration.dot_model import undistorted
from lfpiv_cli.calibration.measured_points import MeasuredPoints, measured_points
from lfpiv_cli.calibration.near_pixels import pixels_near
from lfpiv_cli.calibration.shape_fit import ShapeFit
from lfpiv_cli.calibration.target_detection import (
    charuco_corners,
    chessboard_corners,
    clear_mm,
    described,
    marker_modules,
)
from lfpiv_cli.calibration.views import lens_table, sub_aperture_view, view_crossings
from lfpiv_cli.calibration.wave_shapes import WaveLight, WaveShapes, corner_strips, together
from lfpiv_cli.errors import InputError
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.robust import MAD_TO_SIGMA

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
# More pixels than these make a corner's fit slower and hardly better.
MOST_PIXELS = 4_000


@dataclass(frozen=True, eq=False)
class CornerLook:
    """The corners of a target in the view from the main lens's middle.

    Attributes
    ----------
    image, passed : (rows, columns) light, and the share of it that pixels pass
    medium : what the target stands in
    numbers : (n, 2) which corner of the target, along its columns and rows
    sample : (n, 2) where, in samples (column, row) of the upright view
    light : waves that the target sends; None: rays
    """

    image: NDArray[np.float64]
    passed: NDArray[np.float32]
    medium: Media
    numbers: NDArray[np.int64]
    sample: NDArray[np.float64]
    light: WaveLight | None = None

    def moved(self, scale: float, depth_mm: float) -> CornerLook:
        """Return what is seen under another magnification: the same."""
        return self

    def by_waves(self, light: WaveLight) -> CornerLook:
        """Return the look with corners that are fitted by waves, from where rays have them."""
        return replace(self, light=light)

    def measured(self, camera: Camera, board: BoardGeometry) -> MeasuredPoints:
        """Fit a corner to the pixels that see each one's surroundings, from where its line has it."""
        start = in_scene(straight_lines(*self.sightings(camera, board), camera), camera, self.medium)
        known = np.isfinite(start).all(axis=1)
        if known.sum() < FEWEST_CORNERS:
            raise InputError(
                f"only {known.sum()} of the board's corners are seen through enough of the main lens, at least "
                f"{FEWEST_CORNERS} are needed; check the exposure and that the board is in the picture"
            )
        numbers, start = self.numbers[known], start[known]
        terms = np.column_stack([np.ones(len(numbers)), numbers])
        edges = np.asarray(np.linalg.lstsq(terms, start[:, :2], rcond=None)[0][1:], dtype=np.float64)
        reach = clear_mm(board) - 0.5 * float(camera.lattice.pitch.max()) / abs(camera.magnification)
        fits = [self._fit(place, edges, reach, camera) for place in start]
        found = measured_points(fits, numbers)
        if self.light is None or not len(found.places_mm) or found.numbers is None:
            return found
        near = together(found.places_mm[:, 2], camera, self.medium)
        numbers, start = found.numbers[near], found.places_mm[near]
        waves = WaveShapes.of(camera, self.medium, self.light, start[:, 2])
        return measured_points([self._fit(place, edges, reach, camera, waves) for place in start], numbers)

    def _fit(
        self,
        start_mm: NDArray[np.float64],
        edges_mm: NDArray[np.float64],
        reach_mm: float,
        camera: Camera,
        waves: WaveShapes | None = None,
    ) -> ShapeFit | None:
        """Fit one corner to the pixels that see its surroundings; None where the sensor ends."""
        x, y, z = (float(value) for value in start_mm)
        near = pixels_near((self.image, self.passed), camera, self.medium, (x, y, z), reach_mm, MOST_PIXELS)
        if near is None or waves is None:
            return None if near is None else fit_corner(near, start_mm, edges_mm, camera, self.medium)
        return waves.fit(near, start_mm, step_mm(edges_mm), corner_strips(edges_mm, waves.lens_mm))

    def sightings(self, camera: Camera, board: BoardGeometry) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points of the main lens (views, 2) and where on the array each shows the corners (views, n, 2)."""
        step = camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
        crossings = view_crossings(camera.aperture_radius_mm - RIM_PIXELS * step, step)
        crossings = crossings[np.argsort(np.hypot(crossings[:, 0], crossings[:, 1]), kind="stable")]
        grid = ViewGrid.of(camera)
        clear = clear_mm(board) * abs(camera.magnification) / grid.step_mm
        half = tuple(int(max(2, np.floor(WINDOW_SHARE * n))) for n in clear)
        even = evenly_lit(self.image, self.passed)
        pictures = [softened(upright_view(even, camera, grid, crossing)) for crossing in crossings]
        inside = np.isfinite(refined(pictures[0], self.sample, half)).all(axis=1)
        seen = np.full((len(crossings), len(self.sample), 2), np.nan)
        middle = grid.to_mm(self.sample[inside])
        seen[:, inside] = followed(pictures, crossings, middle, grid, half)
        return crossings, seen


@dataclass(frozen=True, eq=False)
class ViewGrid:
    """The upright samples of a view: rows of even steps, one per microlens, also where the array is hexagonal.

    Attributes
    ----------
    lenses_mm : (rows, columns, 2) centres of the microlenses
    origin_mm, step_mm : (2,) of the samples on the array
    """

    lenses_mm: NDArray[np.float64]
    origin_mm: NDArray[np.float64]
    step_mm: NDArray[np.float64]

    @classmethod
    def of(cls, camera: Camera) -> ViewGrid:
        """Return the grid of a camera's views; on hexagons, whose rows are staggered, half-way between two rows."""
        lenses = camera.lattice.points(lens_table(camera))
        left = lenses[:2, 0, 0].mean()
        step = np.array([lenses[0, 1, 0] - lenses[0, 0, 0], lenses[1, 0, 1] - lenses[0, 0, 1]])
        return cls(lenses, np.array([left, lenses[0, 0, 1]]), step)

    def to_mm(self, sample: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return places on the array (..., 2) of samples (column, row)."""
        return np.asarray(self.origin_mm + sample * self.step_mm, dtype=np.float64)

    def to_sample(self, place_mm: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return samples (column, row) of places on the array (..., 2)."""
        return np.asarray((place_mm - self.origin_mm) / self.step_mm, dtype=np.float64)


def followed(
    pictures: list[NDArray[np.float32]],
    crossings_mm: NDArray[np.float64],
    middle_mm: NDArray[np.float64],
    grid: ViewGrid,
    half: tuple[int, ...],
) -> NDArray[np.float64]:
    """Return where on the array each view shows corners (views, n, 2), NaN where it does not.

    Parameters
    ----------
    pictures, crossings_mm : (views,) and (views, 2), from the main lens's middle outward
    middle_mm : (n, 2) where the first view shows them
    """
    middle, slope = middle_mm, 0.0
    seen = np.full((len(pictures), len(middle), 2), np.nan)
    for round_ in range(VIEW_ROUNDS):
        for k, (crossing, picture) in enumerate(zip(crossings_mm, pictures, strict=True)):
            seen[k] = grid.to_mm(refined(picture, grid.to_sample(middle + slope * crossing), half))
            known = len(pictures) if round_ else k + 1
            if known >= FIRST_VIEWS:
                slope = common_slope(crossings_mm[:known], seen[:known])
        off = seen - slope * crossings_mm[:, np.newaxis]
        shown = np.isfinite(off).any(axis=(0, 2))
        middle = middle.copy()
        middle[shown] = np.nanmedian(off[:, shown], axis=0)
    return seen


def upright_view(
    image: NDArray[np.float64], camera: Camera, grid: ViewGrid, crossing_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the view from a point of the main lens on the upright samples of the grid."""
    view = sub_aperture_view(image, camera, crossing_mm)
    at = grid.origin_mm[0] + np.arange(view.shape[1]) * grid.step_mm[0]
    return np.stack([np.interp(at, lenses[:, 0], row) for lenses, row in zip(grid.lenses_mm, view, strict=True)])


def softened(picture: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return a view as OpenCV refines corners in it."""
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), SOFTENING), dtype=np.float32)


def refined(picture: NDArray[np.float32], guess: NDArray[np.float64], half: tuple[int, ...]) -> NDArray[np.float64]:
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


def common_slope(crossing_mm: NDArray[np.float64], seen_mm: NDArray[np.float64]) -> float:
    """Return the slope of the places (views, n, 2) of all corners over the points of the main lens (views, 2)."""
    seen = seen_mm[:, np.isfinite(seen_mm).any(axis=(0, 2))]
    off = seen - np.nanmean(seen, axis=0)
    known = np.isfinite(off)
    crossing = np.where(known, crossing_mm[:, np.newaxis], 0.0)
    return float(np.sum(np.where(known, off, 0.0) * crossing) / np.sum(crossing**2))


def straight_lines(
    crossing_mm: NDArray[np.float64], seen_mm: NDArray[np.float64], camera: Camera
) -> NDArray[np.float64]:
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


def in_scene(lines: NDArray[np.float64], camera: Camera, media: Media) -> NDArray[np.float64]:
    """Return the places (n, 3) of points whose lines x_m = alpha X - x s_i/s_o are known."""
    s_i = camera.image_distance_mm
    distance = s_i / (lines[:, 2] - 1.0 + s_i / camera.focal_length_mm)
    depth = (distance - camera.focus_distance_mm) / media.depth_ratio
    return np.column_stack([-lines[:, :2] * (distance / s_i)[:, np.newaxis], depth])


def first_corners(
    image: NDArray[np.float32],
    camera: Camera,
    board: BoardGeometry,
    media: Media,
    transmission: NDArray[np.float32] | None = None,
) -> CornerLook:
    """Find the corners of a chessboard or ChArUco board in the view from the main lens's middle.

    Raises
    ------
    InputError : the squares are too small, or the board is not in the picture
    """
    refuse_small(board, camera)
    passed = np.ones(image.shape, dtype=np.float32) if transmission is None else transmission
    picture, scale = enlarged_view(evenly_lit(image, passed), camera)
    found = charuco_corners(picture, board) if board.pattern == "charuco" else chessboard_corners(picture, board)
    if found is None:
        raise InputError(
            f"{described(board)} was not found in the picture; check board.pattern, board.squares, the exposure and "
            "the focus"
        )
    numbers, place = found
    medium = media.in_air() if board.medium == "air" else media
    return CornerLook(image.astype(np.float64), passed, medium, numbers, (place + 0.5) / scale - 0.5)


def refuse_small(board: BoardGeometry, camera: Camera) -> None:
    """Raise where the microlenses cannot resolve the target."""
    per_mm = abs(camera.magnification) / float(camera.lattice.pitch.max())
    widths = {"the board's squares": (board.spacing_mm, SMALLEST_SQUARE_LENSES)}
    if board.pattern == "charuco":
        widths["the squares in its markers"] = (board.marker_mm / marker_modules(board), SMALLEST_MODULE_LENSES)
    for what, (width, least) in widths.items():
        if width * per_mm < least:
            raise InputError(
                f"{what} are {written(width * per_mm)} microlenses wide on the array, less than {least:g}; use a board "
                "with larger ones"
            )


def evenly_lit(image: NDArray[np.floating], passed: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return a picture (rows, columns) divided by the share of light that pixels pass, 0 where it is unusable."""
    usable = passed > 0.0
    return np.where(usable, image.astype(np.float64) / np.where(usable, passed, 1.0), 0.0)


def enlarged_view(signal: NDArray[np.float64], camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Return the middle's view in grey levels, enlarged, its samples square, and by how much along columns and rows."""
    grid = ViewGrid.of(camera)
    view = upright_view(signal, camera, grid, np.zeros(2))
    black, white = np.percentile(view, [BLACK, WHITE])
    grey = np.clip(255.0 * (view - black) / max(white - black, np.finfo(np.float64).tiny), 0.0, 255.0)
    size = np.rint(ENLARGED * np.array(view.shape[::-1]) * grid.step_mm / grid.step_mm[0]).astype(int)
    large = cv2.resize(grey.astype(np.float32), tuple(int(n) for n in size), interpolation=cv2.INTER_CUBIC)
    return np.clip(np.rint(large), 0, 255).astype(np.uint8), size / np.array(view.shape[::-1])
