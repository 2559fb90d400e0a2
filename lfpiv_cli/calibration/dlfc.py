"""Direct light-field calibration: where rays go, from boards seen at several known depths (Hall et al. 2018).

Each dot is looked for in every sub-aperture view: a place in the scene, a point of the main lens, and where between the
microlenses its image falls there. Polynomials through all of these sightings take the place of main lens, window and
fluid. The data sheet's camera only says where to look for the dots.

Axes: image axes of the rectified frame (x along the columns), mm, z away from the camera, from where the depths of the
boards are counted.
The boards are taken to stand square to the optical axis and to have moved along it; their common place and turn are
those under which they are seen, on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from lfpiv_cli.arrays import Flags, Floats, Integers, Singles
from lfpiv_cli.calibration.board import dot_signal, first_dots
from lfpiv_cli.calibration.board_pose import BoardGeometry, on_the_grid
from lfpiv_cli.calibration.corners import evenly_lit
from lfpiv_cli.calibration.rectification import turn_matrix
from lfpiv_cli.calibration.shape_fit import RIM_PER_PATCH
from lfpiv_cli.calibration.views import lens_table, sub_aperture_view, view_crossings
from lfpiv_cli.errors import InputError
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.camera import Camera, with_entrance_pupil
from lfpiv_cli.optics.media import Media, equivalent_object_distance
from lfpiv_cli.optics.tracing import LARGEST_DEGREE, PolynomialRays, complete_exponents, polynomial_terms
from lfpiv_cli.robust import MAD_TO_SIGMA

# Where the entrance pupil lies, by how a board shrinks on the array as it moves away.
#
# A board at a distance s before the entrance pupil is shown beta = L / s times as large (see `thin_lens`): 1/beta
# grows by 1/L for each millimetre in air. At the focal plane, where its pictures through all points of the pupil
# coincide, beta is -M, and the distance of that plane is L / |M| = F_m (1/P - 1/M). One board alone cannot tell it;
# of several, the scale of the crossings does not matter.

# Two make a line whatever they are.
FEWEST_BOARDS = 3
# What all dots of a board have in common does not show in their scatter: rendered ones were shown up to this share too
# large or too small.
COMMON_SHARE = 1e-4


def shown(z_mm: float, plate_mm: Floats, dot: Integers, crossing_mm: Floats, array_mm: Floats) -> Floats:
    """Return depth, alpha, beta and its error (4,) of x_m = alpha X - beta x, fitted to what was seen of a board.

    The board is turned and placed as it is. Alpha is by how much its picture on the array moves per length between
    crossings of the main lens, and beta how large it is shown.

    Parameters
    ----------
    z_mm : depth of the board, from any origin
    plate_mm : (dots, 2) of the dots on it
    dot, crossing_mm, array_mm : (n,), (n, 2), (n, 2) of sightings: which dot, through where, and its picture's place
    """
    x, y = plate_mm[dot].T
    zero, one = np.zeros(len(dot)), np.ones(len(dot))
    along = np.column_stack([crossing_mm[:, 0], -x, y, one, zero])
    terms = np.concatenate([along, np.column_stack([crossing_mm[:, 1], -y, -x, zero, one])])
    values = array_mm.T.ravel()
    found = np.linalg.lstsq(terms, values, rcond=None)[0]
    off = (values - terms @ found).reshape(2, -1)
    # Sightings of a dot err together, by its phase against the microlenses.
    count = np.bincount(dot, minlength=len(plate_mm))
    seen = count > 0
    mean = np.array([np.bincount(dot, each, minlength=len(plate_mm)) for each in off])[:, seen] / count[seen]
    spread = plate_mm[seen] - plate_mm[seen].mean(axis=0)
    sigma = np.sqrt(np.sum(mean**2) / max(mean.size - 4, 1) / np.sum(spread**2))
    beta = float(np.hypot(found[1], found[2]))
    return np.array([z_mm, found[0], beta, np.hypot(sigma, COMMON_SHARE * beta)])


def entrance_pupil_mm(boards: Sequence[Floats], depth_ratio: float) -> tuple[float, float] | None:
    """Return how far the entrance pupil lies from the focal plane, in air, and the standard error.

    None where the boards do not tell it: fewer than three, or none that is shown the larger the nearer it is.

    Parameters
    ----------
    boards : (4,) each from `shown`, at different depths
    depth_ratio : apparent depth in air of a unit of the boards' depths
    """
    if len(boards) < FEWEST_BOARDS:
        return None
    z, alpha, beta, sigma = np.array(boards).T
    weight = (beta**2 / sigma) ** 2  # of 1/beta
    from_mean = z - np.average(z, weights=weight)
    spread = np.sum(weight * from_mean**2)
    per_mm = np.sum(weight * from_mean / beta) / spread
    spreading, unfocused = np.polyfit(beta, alpha, 1)
    if per_mm <= 0.0 or spreading <= 0.0 or unfocused >= 0.0:
        return None
    distance = depth_ratio / per_mm * spreading / -unfocused
    relative = np.hypot(1.0 / np.sqrt(spread) / per_mm, 1.0 / np.sqrt(np.sum((beta / sigma) ** 2)))
    return float(distance), float(distance * relative)


# A polynomial of degree k needs k + 1 depths, and as many rows and columns of dots.
SMALLEST_DEGREE = 2
# A dot's light in a view reaches as far as the dot and a microlens beyond; the second one is for a wrong first guess.
MARGIN_LENSES = 2.0
# The window is centred on the dot by its own centroid; it starts within half a microlens.
CENTROID_ROUNDS = 3
# A dot must stand out of its surroundings by this share of what most do.
CONTRAST_SHARE = 0.3
# Sightings off the polynomials by this many robust deviations are strays; what is left is looked at once more.
OUTLIER_SIGMAS = 6.0
FIT_ROUNDS = 3
# The place of the entrance pupil that boards show replaces the data sheet's when it differs by more standard errors
# than chance explains.
ENTRANCE_PUPIL_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class RayFit:
    """Polynomials and how well they tell what was seen.

    Attributes
    ----------
    rays : the polynomials
    depths_mm : (boards,) that they were fitted to
    reach_mm : (2, 2) lowest and highest x and y of the dots
    sightings : dots times views that the fit rests on
    residual_mm : (boards, 2) root mean square misfit on the array, along columns and rows
    entrance_pupil_mm, entrance_pupil_sigma_mm : how far the main lens's entrance pupil lies from the focal plane, in
        air, or None
    """

    rays: PolynomialRays
    depths_mm: Floats
    reach_mm: Floats
    sightings: int
    residual_mm: Floats
    entrance_pupil_mm: float | None = None
    entrance_pupil_sigma_mm: float | None = None

    def behind_its_pupil(self, camera: Camera) -> Camera:
        """Return a camera with the entrance pupil where the boards show it, if that is another place than it has."""
        found, sigma = self.entrance_pupil_mm, self.entrance_pupil_sigma_mm
        if found is None or sigma is None or abs(found - camera.focus_distance_mm) <= ENTRANCE_PUPIL_SIGMAS * sigma:
            return camera
        return with_entrance_pupil(camera, found)


class Sightings(NamedTuple):
    """A board's dots in views: which dot (n,), crossings (n, 2) of the main lens, places (n, 2) on the array."""

    dot: Integers
    crossing_mm: Floats
    array_mm: Floats


@dataclass(frozen=True, eq=False)
class SeenBoard:
    """The dots of one board as a first look has them.

    Attributes
    ----------
    signal : (rows, columns), dots bright, divided by the share of light that pixels pass
    z_mm : depth of the board, as told, from any origin
    alpha, forward : of x_m = alpha X - forward x at the depth where the data sheet's camera sees it
    place_mm : (n, 2) of the dots as the data sheet's camera sees them
    index : (n, 2) which dots they are
    """

    signal: Floats
    z_mm: float
    alpha: float
    forward: float
    place_mm: Floats
    index: Integers


def fit_rays(
    images: Sequence[ArrayLike],
    depths_mm: Sequence[float],
    camera: Camera,
    board: BoardGeometry,
    media: Media,
    transmission: Singles | None = None,
) -> RayFit:
    """Fit the polynomials to pictures of a board at several depths.

    They count where rays cross the main lens as the camera does. Where the boards show its entrance pupil elsewhere
    they are fitted once more, with the camera that `RayFit.behind_its_pupil` gives.

    Parameters
    ----------
    images : (rows, columns) each, rectified, less the dark frame
    depths_mm : of the boards
    camera : with the lattice of the rectified frame
    transmission : (rows, columns) share of light that pixels pass, rectified; default: all the same

    Raises
    ------
    InputError : fewer than three different depths or lines of dots, or a board whose dots are not found
    """
    if board.pattern != "dots":
        raise InputError(f"polynomials are fitted to boards of dots, and board.pattern is {board.pattern}")
    first = _fit_as_seen_by(camera, images, depths_mm, board, media, transmission)
    better = first.behind_its_pupil(camera)
    if better is camera:
        return first
    better = better.with_micro_images(camera.micro_image_lattice_px())
    again = _fit_as_seen_by(better, images, depths_mm, board, media, transmission)
    pupil_mm, sigma_mm = first.entrance_pupil_mm, first.entrance_pupil_sigma_mm
    return replace(again, entrance_pupil_mm=pupil_mm, entrance_pupil_sigma_mm=sigma_mm)


def _fit_as_seen_by(
    camera: Camera,
    images: Sequence[ArrayLike],
    depths_mm: Sequence[float],
    board: BoardGeometry,
    media: Media,
    transmission: Singles | None,
) -> RayFit:
    """Fit the polynomials with a camera believed as it is; parameters and errors are those of `fit_rays`."""
    depths = np.asarray(depths_mm, dtype=np.float64)
    different = np.unique(depths).size
    if different <= SMALLEST_DEGREE:
        raise InputError(f"boards at {different} different depths, polynomials need at least {SMALLEST_DEGREE + 1}")
    passed = np.ones((camera.rows, camera.columns), np.float32) if transmission is None else transmission
    if camera.column_axis == "y":
        board = replace(board, dots=board.dots[::-1])
    seen_boards = [seen_board(image, z, camera, board, media, passed) for image, z in zip(images, depths, strict=True)]
    boards = aligned(seen_boards, board)
    lines = [np.unique(np.concatenate([each.index[:, axis] for each in boards])).size for axis in (0, 1)]
    degree = min(LARGEST_DEGREE, different - 1, lines[0] - 1, lines[1] - 1)
    if degree < SMALLEST_DEGREE:
        raise InputError(
            f"{lines[0]} x {lines[1]} dots were found in a board, polynomials need at least {SMALLEST_DEGREE + 1} "
            "along each axis"
        )
    seen = [sightings_of(each, camera, board) for each in boards]
    # Where the dots stand, (dots along x, dots along y, 2): turned and placed as the boards are on average.
    places = [_similarity(settled(*pair), board) for pair in zip(boards, seen, strict=True)]
    turn, middle = turn_matrix(float(np.mean([turn for turn, _ in places]))), np.mean([at for _, at in places], axis=0)
    grid = _plate(np.moveaxis(np.indices(board.dots), 0, -1), board) @ turn.T + middle
    starts = []
    for one, sightings in zip(boards, seen, strict=True):
        lateral = grid[tuple(one.index[sightings.dot].T)]
        starts.append(np.column_stack([lateral, np.full(len(lateral), one.z_mm)]))
    start = np.concatenate(starts)
    _, crossing, array = (np.concatenate(each) for each in zip(*seen, strict=True))
    rays, residual, used = polynomial_fit(start, crossing, array, degree, camera)
    reach = np.stack([start[used, :2].min(axis=0), start[used, :2].max(axis=0)])
    number = np.repeat(np.arange(len(seen)), [len(each.dot) for each in seen])
    rms = [np.sqrt(np.mean(residual[used & (number == k)] ** 2, axis=0)) for k in range(len(seen))]
    # In views that no neighbouring lens's image reaches, where the aperture is a little wide.
    step = camera.pixel_mm * camera.image_distance_mm / camera.microlens_distance_mm
    next_image = float(camera.lattice.pitch.min()) / camera.pixel_mm * step
    clear, sizes = next_image - camera.aperture_radius_mm - RIM_PER_PATCH * step, []
    for one, each in zip(boards, seen, strict=True):
        alone = np.hypot(*each.crossing_mm.T) <= clear
        if alone.any():
            sizes.append(shown(one.z_mm, _plate(one.index, board), *(values[alone] for values in each)))
    pupil = entrance_pupil_mm(sizes, media.depth_ratio) or (None, None)
    return RayFit(rays, depths, reach, int(used.sum()), np.array(rms), *pupil)


def seen_board(
    image: ArrayLike, z_mm: float, camera: Camera, board: BoardGeometry, media: Media, passed: Singles
) -> SeenBoard:
    """Find and number the dots of one board in the picture refocused to where they are sharpest."""
    signal = dot_signal(np.asarray(image, dtype=np.float32), passed, board)
    try:
        place, seen_z = first_dots(signal, camera, board, media)
        kept, index = on_the_grid(np.column_stack([place, np.full(len(place), z_mm)]), board)
    except InputError as error:
        raise InputError(f"the board at {z_mm:g} mm: {error}") from error
    distance = float(equivalent_object_distance(seen_z, camera.focus_distance_mm, media))
    alpha, forward = float(camera.defocus(distance)), camera.image_distance_mm / distance
    return SeenBoard(evenly_lit(signal, passed), z_mm, alpha, forward, place[kept], index)


def aligned(boards: list[SeenBoard], board: BoardGeometry) -> list[SeenBoard]:
    """Return the boards with the same number for the same dot: they move by less than half a spacing sideways."""
    middles = np.array([_similarity(each, board)[1] for each in boards])
    steps = np.rint((middles - np.median(middles, axis=0)) / board.spacing_mm).astype(np.int64)
    result = []
    for each, step in zip(boards, steps, strict=True):
        index = each.index + step
        kept = ((index >= 0) & (index < np.array(board.dots))).all(axis=1)
        result.append(replace(each, place_mm=each.place_mm[kept], index=index[kept]))
    return result


def _plate(index: Integers, board: BoardGeometry) -> Floats:
    """Return places (..., 2) about the board's middle of dots given by their numbers."""
    return board.spacing_mm * (index - (np.array(board.dots) - 1) / 2)


def _similarity(seen: SeenBoard, board: BoardGeometry) -> tuple[float, Floats]:
    """Return turn (rad) and middle (2,) of a board, its scale about the axis taken out."""
    plate = _plate(seen.index, board)
    zero, one = np.zeros(len(plate)), np.ones(len(plate))
    along = np.column_stack([plate[:, 0], -plate[:, 1], one, zero])
    across = np.column_stack([plate[:, 1], plate[:, 0], zero, one])
    terms, values = np.concatenate([along, across]), np.concatenate([seen.place_mm[:, 0], seen.place_mm[:, 1]])
    cosine, sine, x, y = np.linalg.lstsq(terms, values, rcond=None)[0]
    return float(np.arctan2(sine, cosine)), np.array([x, y]) / np.hypot(cosine, sine)


def settled(seen: SeenBoard, sightings: Sightings) -> SeenBoard:
    """Return a board with its dots where all their sightings together have them, for the data sheet's camera."""
    place = (seen.alpha * sightings.crossing_mm - sightings.array_mm) / seen.forward
    counts = np.bincount(sightings.dot, minlength=len(seen.index))
    sums = np.stack([np.bincount(sightings.dot, values, minlength=counts.size) for values in place.T], axis=1)
    found = counts > 0
    return replace(seen, place_mm=sums[found] / counts[found, np.newaxis], index=seen.index[found])


def sightings_of(seen: SeenBoard, camera: Camera, board: BoardGeometry) -> Sightings:
    """Look for the dots of a board in every view that the aperture gives wholly."""
    window = 0.5 * board.dot_diameter_mm * seen.forward + MARGIN_LENSES * float(camera.lattice.pitch.max())
    reach = max(0.5 * board.spacing_mm * seen.forward, window)
    lenses = camera.lattice.points(lens_table(camera))
    crossings = view_crossings(camera, RIM_PER_PATCH)
    found, heights = np.empty((len(crossings), len(seen.index), 2)), np.empty((len(crossings), len(seen.index)))
    for k, crossing in enumerate(crossings):
        view = sub_aperture_view(seen.signal, camera, crossing)
        guess = seen.alpha * crossing - seen.forward * seen.place_mm
        found[k], heights[k] = dot_centroids(view, lenses, guess, window, reach)
    clear = heights > CONTRAST_SHARE * np.nanmedian(heights)
    view_of, dot = np.nonzero(clear & np.isfinite(found).all(axis=-1))
    return Sightings(dot, crossings[view_of], found[view_of, dot])


@njit(cache=True)
def dot_centroids(view: Floats, lenses: Floats, guess: Floats, window: float, reach: float) -> tuple[Floats, Floats]:
    """Return centroids (n, 2) and heights above the ground (n,) of dots in a view; NaN at its border.

    The ground is the median within `reach` of the guess; the light above it is weighed within `window` of the centroid.
    Lenses (rows, columns, 2) stand upright: a row has one y and even steps of x.
    """
    rows, columns = view.shape
    pitch_x = lenses[0, 1, 0] - lenses[0, 0, 0]
    pitch_y = lenses[1, 0, 1] - lenses[0, 0, 1]
    centroids, heights = np.full(guess.shape, np.nan), np.full(guess.shape[0], np.nan)
    for n in range(guess.shape[0]):
        top = int(np.ceil((guess[n, 1] - reach - lenses[0, 0, 1]) / pitch_y))
        bottom = int(np.floor((guess[n, 1] + reach - lenses[0, 0, 1]) / pitch_y))
        if top < 0 or bottom >= rows:
            continue
        left = int(np.ceil((guess[n, 0] - reach - lenses[top : bottom + 1, 0, 0].min()) / pitch_x))
        right = int(np.floor((guess[n, 0] + reach - lenses[top : bottom + 1, 0, 0].max()) / pitch_x))
        if left < 0 or right >= columns:
            continue
        part = view[top : bottom + 1, left : right + 1]
        ground = np.median(part)
        heights[n] = part.max() - ground
        x, y = guess[n, 0], guess[n, 1]
        for _ in range(CENTROID_ROUNDS):
            total, sum_x, sum_y = 0.0, 0.0, 0.0
            for row in range(top, bottom + 1):
                for column in range(left, right + 1):
                    dx, dy = lenses[row, column, 0] - x, lenses[row, column, 1] - y
                    if dx * dx + dy * dy <= window * window:
                        light = view[row, column] - ground
                        total += light
                        sum_x += light * dx
                        sum_y += light * dy
            if total <= 0.0:
                break
            x, y = x + sum_x / total, y + sum_y / total
        if total > 0.0 and abs(x - guess[n, 0]) < reach and abs(y - guess[n, 1]) < reach:
            centroids[n, 0], centroids[n, 1] = x, y
    return centroids, heights


def polynomial_fit(
    start_mm: Floats, crossing_mm: Floats, array_mm: Floats, degree: int, camera: Camera
) -> tuple[PolynomialRays, Floats, Flags]:
    """Return the complete polynomials through rays from (n, 3) through (n, 2) to (n, 2), and how well they fit.

    That is the misfit (n, 2) in mm, and which rays were used (n,).
    """
    variables = np.concatenate([start_mm, crossing_mm], axis=1)
    scale = np.maximum(np.abs(variables).max(axis=0), float(camera.lattice.pitch.min()))
    exponents = complete_exponents(degree)
    terms = np.ascontiguousarray(polynomial_terms(variables / scale, exponents))
    used = np.ones(len(terms), dtype=bool)
    for _ in range(FIT_ROUNDS):
        coefficients = np.asarray(np.linalg.lstsq(terms[used], array_mm[used], rcond=None)[0], dtype=np.float64)
        residual = array_mm - terms @ coefficients
        off = np.abs(residual)
        good = np.all(off <= OUTLIER_SIGMAS * MAD_TO_SIGMA * np.median(off[used], axis=0), axis=1)
        if np.array_equal(good, used):
            break
        used = good
    return PolynomialRays(scale, exponents, coefficients), residual, used
