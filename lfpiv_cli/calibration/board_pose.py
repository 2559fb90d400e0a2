"""The pose of a flat board from the places of its dots.

Axes: world axes, those of the raw sensor: x, y lateral, z away from the camera from the focal plane, in the medium the
board stands in. Lengths in mm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Flags, Floats, Integers
from lfpiv_cli.calibration.white import first_of_each
from lfpiv_cli.errors import InputError
from lfpiv_cli.names import Medium, Pattern, Polarity
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.robust import MAD_TO_SIGMA

# The distortion acts on the microlens array, r' = r (1 + k1 r^2); seen through an ideal camera it moves a dot sideways
# by the same share.

# A dot whose place or depth is this many robust deviations off the common board is dirt.
OUTLIER_SIGMAS = 6.0
# Terms of which one is this close to a sum of the others, each scaled to 1, cannot be separated.
LEAST_RANK = 1e-6
# Six numbers place the board sideways, a seventh is the distortion; with fewer dots than these it has little check.
FEWEST_DOTS_FOR_DISTORTION = 12


@dataclass(frozen=True, eq=False)
class FlatFit:
    """A flat regular board through dots.

    Attributes
    ----------
    coefficients : (3, 3) rows: the centre, and the change of (x, y, z) per mm along the board's rows and columns
    residual_mm : (n, 3) dots less the board
    sigma : (3, 3) standard errors of the coefficients
    half_span_mm : rms distance of the dots from their middle
    k1_per_mm2, k1_sigma_per_mm2 : the distortion and its standard error; None where it was left out
    """

    coefficients: Floats
    residual_mm: Floats
    sigma: Floats
    half_span_mm: float
    k1_per_mm2: float | None = None
    k1_sigma_per_mm2: float | None = None


def flat_fit(dots_mm: Floats, indices: Integers, board: BoardGeometry, radius_mm: Floats | None) -> FlatFit:
    """Fit a flat regular board, and the distortion where the dots can tell it from the magnification.

    Parameters
    ----------
    radius_mm : (n,) of the dots' pictures on the array, from the axis; None: without distortion

    Raises
    ------
    InputError : when the dots stand in one line
    """
    count = len(indices)
    along = (indices - (np.array(board.dots) - 1) / 2.0) * board.spacing_mm
    terms = np.column_stack([np.ones(count), along])
    sideways, values = np.asarray(np.kron(np.eye(2), terms), dtype=np.float64), dots_mm[:, :2].T.ravel()
    bent = None
    if radius_mm is not None and count >= FEWEST_DOTS_FOR_DISTORTION:
        bending = dots_mm[:, :2] * radius_mm[:, np.newaxis] ** 2
        try:
            bent = least_squares(np.column_stack([sideways, bending.T.ravel()]), values)
        except InputError:
            bent = None  # it looks like a board
    places, place_sigma, shifts = bent or least_squares(sideways, values)
    depths, depth_sigma, rises = least_squares(terms, dots_mm[:, 2])
    return FlatFit(
        coefficients=np.column_stack([places[0:3], places[3:6], depths]),
        residual_mm=np.column_stack([shifts.reshape(2, count).T, rises]),
        sigma=np.column_stack([place_sigma[0:3], place_sigma[3:6], depth_sigma]),
        half_span_mm=float(np.sqrt(np.sum(np.var(along, axis=0)))),
        k1_per_mm2=None if bent is None else float(places[6]),
        k1_sigma_per_mm2=None if bent is None else float(place_sigma[6]),
    )


def least_squares(terms: Floats, values: Floats) -> tuple[Floats, Floats, Floats]:
    """Return coefficients, their standard errors by the scatter of the values, and the residuals."""
    scale = np.abs(terms).max(axis=0)
    if np.any(scale == 0.0) or np.linalg.matrix_rank(terms / scale, tol=LEAST_RANK * len(terms)) < terms.shape[1]:
        raise InputError("the board's dots that were found stand in one line; a plane needs more of the board in view")
    scaled = terms / scale
    coefficients = np.asarray(np.linalg.lstsq(scaled, values, rcond=None)[0] / scale, dtype=np.float64)
    residual = values - terms @ coefficients
    variance = float(residual @ residual) / max(1, len(values) - terms.shape[1])
    sigma = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled)) * variance) / scale
    return coefficients, sigma, residual


# The plane, the spacing and their errors need more than their own unknowns.
FEWEST_DOTS = 6
# Bright spots of any picture fit a part of a grid by chance; a board shows most of its dots. The corners of a ChArUco
# board are known each by itself, so that a part of it will do.
LEAST_SHARE = 0.5
# Dots of a board lie within a few thousandths of the spacing from its grid and of the depth over which light spreads by
# one microlens from its plane. Other things lie anywhere within the tolerance below, a fifth of the spacing root mean
# square, and spread in depth as the scene does; of few of them some are near a grid by chance.
LARGEST_SCATTER = 0.05
LARGEST_SCATTER_OF_LENS_DEPTH = 0.1
# Dots off the common board are left out; without them others may turn out to be off, and a third look settles it.
OUTLIER_ROUNDS = 3
# What all dots have in common does not show in their scatter. On rendered boards it was 1 to 10 um of depth, two
# thousandths of the depth over which the main lens's rim moves a dot by a microlens, and more behind microlenses of few
# pixels, which see the main lens in coarse patches: as the inverse square of their width below this many pixels.
# Sideways it was up to 0.1 um, a half thousandth of a microlens, and 3e-5 of the magnification.
COMMON_SHARE_OF_LENS_DEPTH = 2e-3
COARSE_LENS_PX = 18.0
COMMON_SHARE_OF_LENS = 5e-4
COMMON_SCALE = 3e-5
# A tilt is seen from so many of its standard errors on: of 3 +- 11 degrees, which were 1, the magnification was 0.2 %
# too large. Boards stand upright by eye to this slope, 1 degree: where it is not seen, it may be 2e-4 too small.
TILT_SIGMAS, UPRIGHT = 3.0, 0.02
# A distortion that chance explains is reported and not applied: few dots know their scatter badly.
DISTORTION_SIGMAS = 4.5
# Dots within this share of the spacing from the grid's points are on it; strays are not, save one in five.
GRID_TOLERANCE = 0.25
# The grid is first fitted to a dot's neighbours; a neighbour or two may be missing.
FIRST_REACH = 2.3
# A start that is a stray finds no grid; of these many some are not.
STARTS = 8
AIR = Media()


@dataclass(frozen=True)
class BoardGeometry:
    """A flat calibration target with a square grid of points: round dots, or the inner corners of a chessboard.

    Attributes
    ----------
    dots : number of dots or inner corners along x and y, the squares less one
    spacing_mm : of the dots or corners, the side of a square
    dot_diameter_mm : of the dots
    thickness_mm : of the board, t_b of Eq. 21
    polarity : whether the dots are brighter or darker than the board
    medium : what is in front of it
    pattern : what is on it
    marker_mm, dictionary : of a ChArUco board: the side of its markers and OpenCV's name of their dictionary
    """

    dots: tuple[int, int]
    spacing_mm: float
    dot_diameter_mm: float
    thickness_mm: float = 0.0
    polarity: Polarity = "bright"
    medium: Medium = "air"
    pattern: Pattern = "dots"
    marker_mm: float = 0.0
    dictionary: str = "DICT_4X4_50"

    def seen_through(self, media: Media) -> Media:
        """Return what is in front of it."""
        return media.in_air() if self.medium == "air" else media


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Where a board was seen, in world axes.

    Attributes
    ----------
    indices : (n, 2) int, which dot of the grid, from 0, growing with world x and y
    dots_mm, dots_sigma_mm : (n, 3) measured places of the dots and their standard errors
    residual_mm : (n, 3) measured less the flat regular board
    dots_px : (n, 2) where the light through the middle of the main lens shows them on the raw sensor, (column, row)
    z0_mm : depth of the board's centre
    tilt_deg : (a, b) with z = z0 + tan a (x - x0) + tan b (y - y0)
    rotation_deg : of the board's rows from x towards y
    offset_mm : (x0, y0), the board's centre
    magnification : of the main lens, from the spacing of the dots
    k1_per_mm2 : radial distortion at the array, r' = r (1 + k1 r^2); None where the dots cannot tell it
    ..._sigma... : standard errors
    """

    indices: Integers
    dots_mm: Floats
    dots_sigma_mm: Floats
    residual_mm: Floats
    dots_px: Floats
    z0_mm: float
    z0_sigma_mm: float
    tilt_deg: Floats
    tilt_sigma_deg: Floats
    rotation_deg: float
    rotation_sigma_deg: float
    offset_mm: Floats
    offset_sigma_mm: Floats
    magnification: float
    magnification_sigma: float
    k1_per_mm2: float | None = None
    k1_sigma_per_mm2: float | None = None

    @property
    def dots_found(self) -> int:
        """How many dots or corners the pose rests on."""
        return len(self.indices)

    @property
    def distortion_per_mm2(self) -> float:
        """The distortion to reckon with: k1 where it is more than chance, else 0."""
        if self.k1_per_mm2 is None or self.k1_sigma_per_mm2 is None:
            return 0.0
        return self.k1_per_mm2 if abs(self.k1_per_mm2) > DISTORTION_SIGMAS * self.k1_sigma_per_mm2 else 0.0


def pose_of_dots(
    dots_mm: Floats,
    sigma_mm: Floats,
    array_mm: Floats,
    camera: Camera,
    board: BoardGeometry,
    numbers: Integers | None = None,
    medium: Media = AIR,
) -> BoardPose:
    """Fit a flat regular board to dots or corners.

    Parameters
    ----------
    dots_mm, sigma_mm : (n, 3) places of dots, world axes, in any order, and their standard errors
    array_mm : (n, 2) where an ideal main lens would show them on the microlens array, image axes
    camera : that these places were computed with
    numbers : (n, 2) which point of the board each is, the board turned in any way; default: not known
    medium : what the board stands in

    Raises
    ------
    InputError : when too few dots lie on a common grid, or they scatter about it
    """
    if numbers is None:
        kept, indices = on_the_grid(dots_mm, board)
    else:
        indices, board = upright_numbers(numbers, dots_mm[:, :2], board)
        kept = np.arange(len(indices))
        refuse_few(len(kept), board)
    radius = np.hypot(array_mm[:, 0], array_mm[:, 1])
    for round_ in range(OUTLIER_ROUNDS + 1):
        fit = flat_fit(dots_mm[kept], indices, board, radius[kept])
        off = np.stack([np.hypot(fit.residual_mm[:, 0], fit.residual_mm[:, 1]), np.abs(fit.residual_mm[:, 2])], axis=1)
        far = off > OUTLIER_SIGMAS * MAD_TO_SIGMA * np.median(off, axis=0)
        good = ~(far.any(axis=1) & (off > 0.0).any(axis=1))
        if round_ == OUTLIER_ROUNDS or good.all():
            break
        kept, indices = kept[good], indices[good]
        refuse_few(len(kept), board)
    refuse_scattered(fit, board, camera, medium)
    # What the camera already had and what the fit adds.
    k1, k1_sigma = fit.k1_per_mm2, fit.k1_sigma_per_mm2
    k1 = None if k1 is None else camera.distortion_per_mm2 + k1
    proven = k1 is not None and k1_sigma is not None and abs(k1) > DISTORTION_SIGMAS * k1_sigma
    if not proven:
        fit = flat_fit(dots_mm[kept], indices, board, None)
    shown = array_mm[kept] * (1.0 + (k1 if proven and k1 else 0.0) * radius[kept, np.newaxis] ** 2)
    # The errors of single dots come from the scatter of their pixels, which does not know how well a rendering can fit.
    freedom = len(kept) / max(1, len(kept) - 3)
    scatter = np.sqrt(freedom * np.mean((fit.residual_mm / sigma_mm[kept]) ** 2, axis=0))
    return BoardPose(
        indices=indices,
        dots_mm=dots_mm[kept],
        dots_sigma_mm=sigma_mm[kept] * np.maximum(1.0, scatter),
        residual_mm=fit.residual_mm,
        dots_px=camera.mm_to_px(camera.micro_image_scale * shown),
        k1_per_mm2=k1,
        k1_sigma_per_mm2=k1_sigma,
        **lengths_and_angles(fit, camera, np.zeros(2) if numbers is not None else middle_doubt_mm(indices, board)),
    )


def rows_unseen(indices: Integers, board: BoardGeometry) -> Integers:
    """Return how many columns and rows (2,) of a board's dots are none of those found (n, 2), on one side or both."""
    return np.asarray(np.array(board.dots) - np.ptp(indices, axis=0) - 1, dtype=np.int64)


def middle_doubt_mm(indices: Integers, board: BoardGeometry) -> Floats:
    """Return how far (2,) the board's middle may be from where it is taken to be along its rows and columns, rms.

    No dot shows on which side the unseen ones lie; `best_window` shares it between both.
    """
    off = [np.arange(unseen + 1) - unseen // 2 for unseen in rows_unseen(indices, board).tolist()]
    return board.spacing_mm * np.array([np.sqrt(np.mean(each**2)) for each in off])


def lens_in_scene_mm(camera: Camera) -> tuple[float, float]:
    """Return a microlens's width in the focal plane, and the depth over which the rim's rays move by it."""
    lens = float(camera.lattice.pitch.max()) / abs(camera.magnification)
    return lens, lens / camera.aperture_radius_mm * camera.focus_distance_mm


def off_focus_mm(board: BoardGeometry, camera: Camera, medium: Media) -> float:
    """Return how far from the focal plane a dot's light is two microlenses wide.

    From rim to rim of the aperture light spreads by one more over each depth unit; a ray of the rim moves from the
    axis by half of that.
    """
    scale = camera.scale(medium)
    return (2.0 - board.dot_diameter_mm / scale.lens_mm) * scale.depth_mm


def on_the_grid(dots_mm: Floats, board: BoardGeometry) -> tuple[Integers, Integers]:
    """Return which dots belong to the board (m,) and their indices on it (m, 2); dots may be missing."""
    refuse_few(len(dots_mm), board)
    lateral = dots_mm[:, :2]
    best = np.zeros(len(lateral), dtype=bool)
    numbers = np.zeros((len(lateral), 2), dtype=np.int64)
    for start in np.argsort(np.hypot(*(lateral - np.median(lateral, axis=0)).T), kind="stable")[:STARTS]:
        found, on_grid = numbered_dots(lateral, int(start), board.spacing_mm)
        if on_grid.sum() > best.sum():
            best, numbers = on_grid, found
    kept = np.nonzero(best)[0]
    indices = numbers[kept]
    corner, within = best_window(indices, board.dots)
    count, (across, down) = int(within.sum()), board.dots
    turned = 0 if across == down else int(best_window(indices, (down, across))[1].sum())
    # Outside of a board that is told as it is lie strays, and not most of a row as long as its shorter side.
    if turned - count > 0.5 * min(across, down):
        raise InputError(
            f"{turned} of the dots are those of a board of {down} x {across} along x and y, and {count} those of "
            f"one of {across} x {down}; correct board.dots, or camera.sensor.column_axis"
        )
    refuse_few(count, board)
    return kept[within], indices[within] - corner


def numbered_dots(lateral: Floats, start: int, spacing_mm: float) -> tuple[Integers, Flags]:
    """Number the dots by a grid through one of them, which grows outward and adapts: (n, 2), and which are on it (n,).

    Missing dots leave gaps that a walk from neighbour to neighbour could not cross.
    """
    # The nearest dot about one spacing away tells the direction, up to quarter turns: the first vector is near world x.
    offset = np.delete(lateral - lateral[start], start, axis=0)
    nearest = offset[np.argmin(np.abs(np.hypot(offset[:, 0], offset[:, 1]) - spacing_mm))]
    angle = np.arctan2(nearest[1], nearest[0])
    angle -= np.pi / 2.0 * np.rint(angle / (np.pi / 2.0))
    cosine, sine = np.cos(angle), np.sin(angle)
    basis, origin = spacing_mm * np.array([[cosine, sine], [-sine, cosine]]), lateral[start]
    farthest = float(np.hypot(*(lateral - origin).T).max())
    reach = FIRST_REACH * spacing_mm
    while True:
        places = (lateral - origin) @ np.linalg.inv(basis)
        indices = np.rint(places).astype(np.int64)
        off = np.hypot(*(places - indices).T)
        order = np.argsort(off, kind="stable")
        good = np.zeros(len(lateral), dtype=bool)
        good[order] = first_of_each(indices[order], (off < GRID_TOLERANCE)[order])
        if reach > farthest:
            return indices, good
        near = good & (np.hypot(*(lateral - lateral[start]).T) <= reach)
        terms = np.column_stack([np.ones(near.sum()), indices[near]])
        if np.linalg.matrix_rank(terms) == terms.shape[1]:
            solution = np.linalg.lstsq(terms, lateral[near], rcond=None)[0]
            origin, basis = solution[0], solution[1:]
        reach *= 2.0


def refuse_few(count: int, board: BoardGeometry) -> None:
    """Raise when too few dots are left."""
    across, down = board.dots
    share = 0.0 if board.pattern == "charuco" else LEAST_SHARE
    needed = max(FEWEST_DOTS, int(np.ceil(share * across * down)))
    if count < needed:
        points = "dots" if board.pattern == "dots" else "corners"
        raise InputError(
            f"only {count} of the board's {across} x {down} {points} were found, {board.spacing_mm:g} mm apart, "
            f"at least {needed} are needed; check the section board, the exposure and the focus"
        )


def refuse_scattered(fit: FlatFit, board: BoardGeometry, camera: Camera, medium: Media) -> None:
    """Raise when what was found lies about a grid and not on it, or in front of and behind its plane.

    The scatter is that of one point, by the misfit and how many numbers were fitted.
    """
    freedom = 2 * len(fit.residual_mm) - (6 if fit.k1_per_mm2 is None else 7)
    sideways = float(np.sqrt(2.0 * np.sum(fit.residual_mm[:, :2] ** 2) / max(1, freedom)))
    lens, lens_depth = lens_in_scene_mm(camera)
    if sideways > LARGEST_SCATTER * board.spacing_mm:
        dot = board.dot_diameter_mm / lens
        check = "board.spacing_mm and that the picture shows the board"
        if board.pattern == "dots" and dot < 1.0 and sideways < lens:
            check = (
                f"the focus first: dots {written(dot, 2)} microlenses wide may lie anywhere in their lenses near the "
                f"focal plane; move the board by {written(off_focus_mm(board, camera, medium), 2)} mm off it, "
                f"or take dots of two microlenses, {written(2.0 * lens, 2)} mm; then {check}"
            )
        raise InputError(
            f"what was found lies {written(sideways)} mm rms off a grid of {board.spacing_mm:g} mm, at most "
            f"{written(LARGEST_SCATTER * board.spacing_mm)} mm is a board's; check {check}"
        )
    deep = float(np.sqrt(np.sum(fit.residual_mm[:, 2] ** 2) / max(1, len(fit.residual_mm) - 3)))
    flat = LARGEST_SCATTER_OF_LENS_DEPTH * lens_depth
    if deep > flat:
        raise InputError(
            f"what was found lies {written(deep)} mm rms in front of and behind one plane, at most {written(flat)} mm "
            "is a board's; check the section board and that the picture shows the board"
        )


def upright_numbers(numbers: Integers, lateral_mm: Floats, board: BoardGeometry) -> tuple[Integers, BoardGeometry]:
    """Return numbers (n, 2) of a board's points that grow with x and y, and the board as it is then seen."""
    terms = np.column_stack([np.ones(len(numbers)), numbers])
    along = np.linalg.lstsq(terms, lateral_mm, rcond=None)[0][1:]
    if abs(along[0, 0]) + abs(along[1, 1]) < abs(along[0, 1]) + abs(along[1, 0]):
        numbers, along = numbers[:, ::-1], along[::-1]
        board = replace(board, dots=board.dots[::-1])
    last = np.array(board.dots) - 1
    return np.where(np.diag(along) < 0.0, last - numbers, numbers), board


def best_window(indices: Integers, dots: tuple[int, int]) -> tuple[Integers, Flags]:
    """Return the first index (2,) of the window of so many dots that holds most, and which (n,) these are.

    Of windows that hold as many it is the most central one: the dots' mean index is nearest the window's middle, so
    that lost rows are shared between the two sides.
    """
    size = np.array(dots)
    low, high = indices.min(axis=0), indices.max(axis=0)
    ends = np.stack([low, high - size + 1])
    first, last = ends.min(axis=0), ends.max(axis=0)
    best, best_rank = low, (-1, 0.0)
    for corner in first + np.moveaxis(np.indices(last - first + 1), 0, -1).reshape(-1, 2):
        count = int(((indices >= corner) & (indices < corner + size)).all(axis=1).sum())
        off = float(np.hypot(*(corner + (size - 1) / 2.0 - indices.mean(axis=0))))
        if (count, -off) > best_rank:
            best, best_rank = corner, (count, -off)
    return best, ((indices >= best) & (indices < best + size)).all(axis=1)


def lengths_and_angles(fit: FlatFit, camera: Camera, doubt_mm: Floats) -> dict[str, Any]:
    """Return the fitted centre and step vectors as the lengths and angles of `BoardPose` with their standard errors.

    What the dots have in common may differ from one side of the board to the other as well: it counts for the tilt.
    `doubt_mm` (2,) is how far along rows and columns the centre may be from where it is taken to be.
    """
    lens, lens_depth = lens_in_scene_mm(camera)
    coarse = max(1.0, COARSE_LENS_PX * camera.pixel_mm / float(camera.lattice.pitch.min())) ** 2
    common_mm, common_depth_mm = COMMON_SHARE_OF_LENS * lens, COMMON_SHARE_OF_LENS_DEPTH * coarse * lens_depth
    centre, steps = fit.coefficients[0], fit.coefficients[1:]
    common_slope = common_depth_mm / fit.half_span_mm
    slope_error = np.hypot(fit.sigma[1:, 2], common_slope)
    slope = np.linalg.solve(steps[:, :2], steps[:, 2])
    centre_error = np.sqrt(fit.sigma[0] ** 2 + doubt_mm**2 @ steps**2)
    step_error = float(np.mean(fit.sigma[1:, :2])) / float(np.sqrt(2.0))
    # A tilt shortens the dots' spacing by half its slope's square; one that may be an error alone is not reckoned with.
    risen2, unsure2 = steps[:, 2] ** 2, (TILT_SIGMAS * slope_error) ** 2
    tilted2 = np.where(risen2 > unsure2, risen2, 0.0)
    stretch = np.sqrt(np.sum(steps[:, :2] ** 2, axis=1) + tilted2)
    hidden2 = np.where(risen2 > unsure2, 0.0, np.minimum(np.maximum(risen2, UPRIGHT**2), unsure2))
    scale_error = [step_error, COMMON_SCALE, np.sqrt(np.mean(tilted2 * slope_error**2 + 0.25 * hidden2**2))]
    turn = np.array([np.arctan2(steps[0, 1], steps[0, 0]), np.arctan2(-steps[1, 0], steps[1, 1])])
    return {
        "z0_mm": float(centre[2]),
        "z0_sigma_mm": float(np.hypot(centre_error[2], common_depth_mm)),
        "tilt_deg": np.rad2deg(np.arctan(slope)),
        "tilt_sigma_deg": np.rad2deg(slope_error / (1.0 + slope**2)),
        "rotation_deg": float(np.rad2deg(turn.mean())),
        "rotation_sigma_deg": float(np.rad2deg(step_error)),
        "offset_mm": centre[:2],
        "offset_sigma_mm": np.hypot(centre_error[:2], common_mm),
        "magnification": camera.magnification * float(stretch.mean()),
        "magnification_sigma": abs(camera.magnification) * float(np.linalg.norm(scale_error)),
    }
