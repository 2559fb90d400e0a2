"""The data sheet beside itself and the measured lattice: do f-numbers and pitches agree, and what image distance is it?

The lens images are projected from the exit pupil: their pitch is that of the lenses times 1 + s_mu/s_i, s_i from that
pupil to the array.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lfpiv_cli.calibration.board_pose import BoardGeometry, BoardPose, lens_in_scene_mm, off_focus_mm, rows_unseen
from lfpiv_cli.calibration.lattice import EXPONENTS, LatticeFit
from lfpiv_cli.calibration.light_checks import LARGEST_FIELD_DEPTH, field_depth
from lfpiv_cli.errors import ConfigError, InputError
from lfpiv_cli.notice import Notice, written
from lfpiv_cli.optics.camera import Camera, real_lens, with_entrance_pupil
from lfpiv_cli.optics.media import Media

# A lattice further from the data sheet than this is another camera, a binned sensor or a slip in the sheet: the
# projection itself makes up to 4 % where the main lens is not known.
LARGEST_DIFFERENCE = 0.05
# The ratio 1 + s_mu/s_i is a few per mille above 1 and sheets give pitches to a few digits: image distances closer than
# this are no contradiction.
IMAGE_DISTANCE_TOLERANCE = 0.1
IMAGE_DISTANCE_SIGMAS = 3.0
# Focal lengths are named to a few per cent.
ENTRANCE_PUPIL_TOLERANCE = 0.03
# A board of another spacing, or in another medium, is off by a tenth or more; a lens that was focused by hand by a few
# per cent, and then all that was planned by the rig file is as far off. Boards tell magnifications to some 0.1 %.
MAGNIFICATION_TOLERANCE = 0.01
# Of a board that nearly fills the view a row may lie in the rim; more that are not seen are another board's.
MOST_ROWS_UNSEEN = 1
# The standard errors of a board's place are from how its points scatter about it; of six, a third of the true error was
# stated of the magnification.
ENOUGH_POINTS = 9
# Between the f-numbers of main lens and microlenses, towards the array. Lens images a quarter wider or narrower than
# their pitch lose or waste two fifths of the light; of three times as wide or narrow ones nine overlap, or a ninth of
# the pixels is lit.
LARGE_F_RATIO, LARGEST_F_RATIO = 1.25, 3.0


def check_pitch(fit: LatticeFit, sheet_pitch_px: float) -> None:
    """Refuse a lattice whose pitch is not the data sheet's.

    Raises
    ------
    InputError : when they differ by more than 5 %
    """
    pitch = float(fit.lattice_px.pitch.mean())
    if abs(pitch / sheet_pitch_px - 1.0) > LARGEST_DIFFERENCE:
        raise InputError(
            f"the lens images are {written(pitch, 4)} px apart and {written(sheet_pitch_px, 4)} px by the data sheet, "
            f"{100 * abs(pitch / sheet_pitch_px - 1.0):.0f} % off, at most {100 * LARGEST_DIFFERENCE:.0f} % may be; "
            "check camera.microlenses.pitch_mm, camera.sensor.pixel_um and that the sensor is not binned"
        )


def sheet_fit(camera: Camera) -> LatticeFit:
    """Return the lattice that the data sheet promises, with no lens found and nothing known about its errors."""
    lattice = camera.micro_image_lattice_px()
    coefficients = np.zeros((len(EXPONENTS), 2))
    coefficients[0], coefficients[1:3] = lattice.origin, lattice.basis
    unknown = np.full(2, np.nan)
    return LatticeFit(
        lattice_px=lattice,
        indices=np.zeros((0, 2), dtype=np.int64),
        centres_px=np.zeros((0, 2)),
        cubic_px=coefficients,
        cubic_used=False,
        residual_px=unknown,
        residual_affine_px=unknown,
        pitch_sigma_px=unknown,
        origin_sigma_px=unknown,
        rotation_sigma_rad=float("nan"),
    )


def image_distance_mm(fit: LatticeFit, camera: Camera) -> tuple[float, float] | None:
    """Return s_i from the ratio of the pitches and its standard error, the sheet's pitch taken for exact.

    None where the lens images are not further apart than the lenses, within their error: the ratio then tells nothing.
    """
    excess, sigma = _excess(fit, camera)
    if not np.isfinite(sigma) or excess <= IMAGE_DISTANCE_SIGMAS * sigma:
        return None
    distance = real_lens(camera).microlens_distance_mm / excess
    return distance, distance * sigma / excess


def image_distance_notices(fit: LatticeFit, camera: Camera) -> list[Notice]:
    """Return what speaks for another image distance than the data sheet's: the pitch of the lens images.

    Lens images as far apart as the lenses tell no distance: behind a lens that is telecentric towards the array they
    are, and a pitch given in whole pixels is often theirs.
    """
    excess, sigma = _excess(fit, camera)
    thin = camera.micro_image_scale - 1.0
    if not np.isfinite(sigma) or abs(excess) <= max(IMAGE_DISTANCE_SIGMAS * sigma, IMAGE_DISTANCE_TOLERANCE * thin):
        return []
    found, telecentric = image_distance_mm(fit, camera), camera.entrance_over_exit == 0.0
    sheet = float("inf") if telecentric else camera.image_distance_mm / camera.entrance_over_exit
    if found is not None and not telecentric:
        difference = abs(found[0] - sheet)
        if difference <= max(IMAGE_DISTANCE_TOLERANCE * sheet, IMAGE_DISTANCE_SIGMAS * found[1]):
            return []
    reported = "no image distance" if found is None else f"an image distance of {written(found[0], 4)} mm"
    ratio = 0.0 if found is None else found[0] / real_lens(camera).focal_length_mm + camera.magnification
    expected = "an infinite one" if telecentric else f"{written(sheet, 4)} mm"
    text = f"the pitch of the lens images tells {reported}, the data sheet {expected}"
    remedy = (
        "correct what is off of microlenses.pitch_mm, sensor.pixel_um, sensor.microlens_distance_mm and main_lens"
        + (f" (pupil_ratio {written(ratio)} if all else is right)" if ratio > 0.0 else "")
    )
    measured = None if found is None else found[0]
    return [Notice("image-distance", "camera.main_lens", text, remedy, measured, expected)]


def entrance_pupil_notices(found_mm: float | None, sigma_mm: float | None, camera: Camera) -> list[Notice]:
    """Return what speaks against the place of the entrance pupil that boards at several depths show."""
    sheet = camera.focus_distance_mm
    if found_mm is None or sigma_mm is None:
        return []
    if abs(found_mm - sheet) <= max(IMAGE_DISTANCE_SIGMAS * sigma_mm, ENTRANCE_PUPIL_TOLERANCE * sheet):
        return []
    inverse = with_entrance_pupil(camera, found_mm).entrance_over_exit
    ratio = written(1.0 / inverse) if inverse > 0.0 else "image_distance: infinite"
    text = (
        f"the boards show the entrance pupil {written(found_mm, 4)} mm from the focal plane, the data sheet "
        f"{written(sheet, 4)} mm"
    )
    remedy = (
        "correct what is off of main_lens.focal_length_mm, media.fluid, the boards' depths and pupil_ratio "
        f"({ratio} if all else is right)"
    )
    expected = f"{written(sheet, 4)} mm within {ENTRANCE_PUPIL_TOLERANCE:.0%}"
    return [Notice("entrance-pupil", "camera.main_lens.pupil_ratio", text, remedy, found_mm, expected)]


def board_notices(pose: BoardPose, board: BoardGeometry, camera: Camera, media: Media) -> Iterator[Notice]:
    """Say what speaks against a board as it was found, and what it shows that the data sheet has otherwise."""
    (across, down), found, dots = board.dots, pose.dots_found, board.pattern == "dots"
    depth_unit = lens_in_scene_mm(camera)[1]
    unseen, slope = rows_unseen(pose.indices, board), np.tan(np.deg2rad(pose.tilt_deg))
    off_mm = board.spacing_mm * float(np.abs(unseen * slope).sum())
    if dots and (unseen.max() > MOST_ROWS_UNSEEN or off_mm > LARGEST_FIELD_DEPTH * depth_unit):
        # Which part it is its dots do not tell.
        across_seen, down_seen = np.array(board.dots) - unseen
        text = (
            f"{across_seen} x {down_seen} of the board's {across} x {down} columns and rows were found: where its "
            f"middle lies is a guess, by its tilt {written(off_mm, 2)} mm in depth"
        )
        remedy = "correct board.dots, or bring all of the board into view"
        yield Notice("board-incomplete", "board.dots", text, remedy, float(found), f"{across * down}")
    if found < ENOUGH_POINTS:
        text = (
            f"{found} of its points were found, at least {ENOUGH_POINTS} are needed to see how well they agree: the "
            "stated errors may be three times too small"
        )
        remedy = "bring more of the board into view, or take one with smaller squares"
        yield Notice("board-few-points", "board", text, remedy, float(found), f"at least {ENOUGH_POINTS}")
    shown, sheet = pose.magnification, camera.magnification
    if abs(shown / sheet - 1.0) > MAGNIFICATION_TOLERANCE:
        expected = written(sheet, 4)
        text = f"the board shows a magnification of {written(shown, 4)}, which is used; the rig file says {expected}"
        remedy = "correct what is off of board.spacing_mm, board.medium and main_lens.magnification"
        expected += f" within {MAGNIFICATION_TOLERANCE:.0%}"
        yield Notice("magnification", "board.spacing_mm", text, remedy, shown, expected)
    depth, largest = field_depth(pose, camera), LARGEST_FIELD_DEPTH * depth_unit
    if depth is not None and depth.beyond(largest):
        text = (
            f"a flat board seems {written(abs(depth.value))} mm {'further' if depth.value > 0.0 else 'nearer'} in the "
            f"corners than in the middle (field curvature, or a bent board), at most {written(largest, 2)} mm may be: "
            "depths are off by it, as the square of the image height"
        )
        remedy = (
            "a flat board, a volume near the axis, another objective; for volumes boards at several --depth-mm and "
            "method dlfc"
        )
        yield Notice("field-curved", "board image", text, remedy, depth.value, f"within {written(largest, 2)} mm")
    # A dot's light in microlenses, at its depth from the focal plane.
    medium = board.seen_through(media)
    scale = camera.scale(medium)
    wide = board.dot_diameter_mm / scale.lens_mm + abs(pose.z0_mm) / scale.depth_mm
    if dots and wide < 1.0:
        text = (
            f"at its depth a dot's light is {written(wide, 2)} microlenses wide: where it falls into one it "
            "may lie anywhere in it, and the magnification is up to 2 % off, several of its standard errors"
        )
        remedy = (
            f"move the board by {written(off_focus_mm(board, camera, medium), 2)} mm off the focal plane, or take dots "
            "of two microlenses"
        )
        yield Notice("board-within-lenses", "board.dot_diameter_mm", text, remedy, wide, "at least 1")


def check_f_numbers(camera: Camera) -> None:
    """Refuse a main lens and microlenses whose f-numbers are so different that lens images are no use.

    Raises
    ------
    ConfigError
    """
    ratio, reported = _f_numbers(camera)
    if ratio > LARGEST_F_RATIO:
        raise ConfigError(
            f"camera.main_lens.aperture_mm: {reported}; at most a factor of {LARGEST_F_RATIO:g} may be "
            "between them; check the apertures, the focal lengths and microlens_distance_mm"
        )


def f_number_notices(camera: Camera) -> list[Notice]:
    """Return what speaks against the f-numbers of main lens and microlenses."""
    ratio, reported = _f_numbers(camera)
    if ratio <= LARGE_F_RATIO:
        return []
    turned = "stop the lens down" if camera.lens_image_width > 1.0 else "open it"
    remedy = f"correct the aperture (f_number is F_m / p_m), or {turned} until lens images just touch"
    return [Notice("f-numbers", "camera.main_lens.aperture_mm", reported, remedy, ratio, f"at most {LARGE_F_RATIO:g}")]


def _f_numbers(camera: Camera) -> tuple[float, str]:
    """Return the factor between the two f-numbers, 1 where they match, and what becomes of lens images, in words."""
    width, main = camera.lens_image_width, camera.image_distance_mm / camera.aperture_mm
    what = f"overlap, {width:.2f} of their pitch wide" if width > 1.0 else f"fill only {width:.2f} of their pitch"
    numbers = f"the main lens is f/{written(main)} towards the array and the microlenses are f/{written(main * width)}"
    return max(width, 1.0 / width), f"{numbers}: lens images {what}"


def _excess(fit: LatticeFit, camera: Camera) -> tuple[float, float]:
    """Return by what share lens images are further apart than lenses, and its standard error."""
    sheet_mm = float(np.sqrt(camera.lattice.cell_area))
    measured_mm = float(np.sqrt(fit.lattice_px.cell_area)) * real_lens(camera).pixel_mm
    sigma = float(np.hypot(*fit.pitch_sigma_px)) / 2.0 / float(fit.lattice_px.pitch.mean())
    return measured_mm / sheet_mm - 1.0, sigma
