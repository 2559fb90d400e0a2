"""`calibrate-snapshot`: photographs in, the calibration file and a picture out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.calibration import light_checks, model, sheet
from lfpiv_cli.calibration.lens_light import LensImages
from lfpiv_cli.calibration.model import Calibration, DataSheet, Photographs
from lfpiv_cli.calibration.white import by_aperture, lens_image_width
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError, UsageError
from lfpiv_cli.files import atomic, calibration_file, pages
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.batch import Target, is_kept
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record as provenance_record
from lfpiv_cli.files.provenance import with_warnings
from lfpiv_cli.notice import Notice, warn_of
from lfpiv_cli.optics.media import Media
from lfpiv_cli.reconstruction.images import light

NO_WHITE_IMAGE = Notice(
    "no-white-image",
    "--white",
    "there is none: the microlenses are believed to lie as the data sheet says, and the standard errors know nothing "
    "of how far that is wrong",
    "give a white image, of uniform light",
)

NO_BOARD = Notice(
    "no-board",
    "--board",
    "there is none: magnification and focus are believed as the data sheet has them, and all lengths with them",
    "give a picture of a calibration board; of one at several depths, to see the depth scale too",
)

MOVED_SINCE_WHITE = "take white image and board one after the other, with the camera as it is"

Pictures = ArrayLike | Sequence[ArrayLike] | None


def calibrate(
    white: Pictures, board: Pictures, rig: Config, *, dark: ArrayLike | None = None, depth_mm: Sequence[float] = ()
) -> Calibration:
    """Find the microlenses in a white image and the focal plane in a snapshot of the calibration target.

    Parameters
    ----------
    white : (rows, columns) counts
        Raw image of uniform light, or a sequence of two, one stopped down and one not. None: the microlenses are
        believed to lie as the data sheet says.
    board : (rows, columns) counts
        Raw image of the calibration target; or a sequence of boards in the fluid, each with its depth. None: only the
        microlenses are sought.
    rig : Config
        From `load_rig`.
    dark : (rows, columns) counts, optional
        Raw image taken with the cap on.
    depth_mm : sequence of float, optional
        Depths of several boards in the fluid, mm away from the camera from the focal plane, for weights of the method
        dlfc. Without a board: the one depth of the channel's mid plane, for a camera whose focus is known.

    Returns
    -------
    Calibration
        Its `summary()` has the figures and their standard errors, units in their names.

    Raises
    ------
    UsageError
        There is no picture, or boards and depths do not belong together.
    InputError
        A picture cannot serve; the message says why.
    ConfigError
        The rig lacks a section that is needed.
    """
    whites, boards = _each(white), _each(board)
    ensure_pictures(len(whites), len(boards), len(depth_mm))
    shape = rig.image_shape()
    for picture in (*whites, *boards, *_each(dark)):
        if picture.shape != shape:
            raise UsageError(f"a picture of {picture.shape} pixels; the rig's sensor has {shape} (rows, columns)")
    pictures = photographs(whites, boards, dark, depth_mm)
    found = calibration_of(rig, pictures)
    warn_of(calibration_notices(rig, pictures, found))
    return replace(found, provenance=provenance_record("calibrate-snapshot", rig.resolved(), {}))


def photographs(
    whites: Sequence[ArrayLike], boards: Sequence[ArrayLike], dark: ArrayLike | None, depth_mm: Sequence[float]
) -> Photographs:
    """Return pictures (rows, columns) as they are calibrated from: one board alone, several at depths, or a depth."""
    if len(depth_mm) and not boards:
        return Photographs(whites, dark, mid_plane_z_mm=depth_mm[0])
    if len(depth_mm):
        return Photographs(whites, dark, None, boards, depth_mm)
    return Photographs(whites, dark, boards[0] if boards else None)


def calibration_of(rig: Config, pictures: Photographs) -> Calibration:
    """Return the calibration that pictures of the rig give."""
    if pictures.mid_plane_z_mm is not None:
        if not np.isfinite(pictures.mid_plane_z_mm):
            raise UsageError(f"a depth of {pictures.mid_plane_z_mm:g} mm, expected a number")
        if rig.channel is None:
            raise ConfigError(
                "a depth without a board is the mid plane's of a channel; the section `channel` is missing"
            )
    camera = rig.camera.model() if pictures.whites else rig.camera_model()
    if camera is not None:
        sheet.check_f_numbers(camera)
    reported = DataSheet(rig.camera.microlenses.layout, rig.micro_image_pitch_px(), camera)
    has_board = pictures.board is not None or len(pictures.depth_boards) > 0
    if has_board and rig.board.medium == "fluid":
        rig.ensure_plane_layers("calibrating by a board in the fluid")
    return model.calibrate(pictures, rig.rig() if has_board else None, reported)


def calibration_notices(rig: Config, pictures: Photographs, found: Calibration) -> list[Notice]:
    """Return what speaks against a calibration and the pictures that it is from."""
    camera = rig.camera.model()
    notices = [] if camera is None else sheet.f_number_notices(camera)
    if found.pose is not None and camera is not None:
        notices += sheet.board_notices(found.pose, rig.rig().board, camera, rig.media_model())
    if found.ray_fit is not None and camera is not None:
        rays = found.ray_fit
        notices += sheet.entrance_pupil_notices(rays.entrance_pupil_mm, rays.entrance_pupil_sigma_mm, camera)
    if camera is not None and found.pose is None and found.ray_fit is None:
        notices.append(NO_BOARD)
    notices += light_notices(rig, pictures, found)
    if not pictures.whites:
        return [*notices, NO_WHITE_IMAGE]
    order = by_aperture(pictures.whites, pictures.dark)
    first, widest = (pictures.less_dark(pictures.whites[order[place]]) for place in (0, -1))
    width = lens_image_width(found.rectification.apply(widest), found.rectification.lattice_px)
    notices += light_checks.white_notices(first, found.fit, width, None if camera is None else camera.lens_image_fill)
    return notices if camera is None else notices + sheet.image_distance_notices(found.fit, camera)


def light_notices(rig: Config, pictures: Photographs, found: Calibration) -> list[Notice]:
    """Return what the light of boards and of the dark image says against the lens images, and what these say."""
    camera = rig.camera.model()
    boards = [*([] if pictures.board is None else [pictures.board]), *pictures.depth_boards]
    if found.transmission is None and camera is None:
        return []
    width = 1.0 if camera is None else camera.lens_image_fill
    images = LensImages.of(found.rectification, found.transmission, width)
    notices = (
        [] if pictures.dark is None else light_checks.dark_notices(images, np.asarray(pictures.dark, dtype=np.float64))
    )
    if found.white is not None and camera is not None:
        notices += light_checks.blur_notices(images, found.white, camera)
    if found.transmission is not None:
        notices += light_checks.shape_notices(light_checks.shapes_of(images, found.rectification.image_shape))
    for number, board in enumerate(boards, 1):
        name = "board image" if len(boards) == 1 else f"board image {number}"
        notices += light_checks.position_notices(images, pictures.less_dark(board), name, MOVED_SINCE_WHITE)
    return notices


def ensure_pictures(whites: int, boards: int, depths: int) -> None:
    """Refuse numbers of pictures and depths that make no calibration (UsageError)."""
    if not whites and not boards:
        raise UsageError("calibrate-snapshot needs a picture: --white, --board or both")
    if depths not in (0, max(boards, 1)) or (boards > 1 and not depths):
        raise UsageError(
            f"{boards} --board and {depths} --depth-mm; give one board alone, or each with its depth, or without a "
            "board the depth of the channel's mid plane"
        )


def _each(pictures: Pictures) -> list[NDArray[Any]]:
    """Return one picture or several as a list."""
    if pictures is None:
        return []
    if isinstance(pictures, (list, tuple)) and np.ndim(pictures[0]) > 1:
        return [np.asarray(picture) for picture in pictures]
    array = np.asarray(pictures)
    return [array] if array.ndim == 2 else list(array)


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """What `calibrate_snapshot` is given besides the config.

    Attributes
    ----------
    white : images of uniform light, one stopped down and one not where there are two
    dark : image taken with the cap on
    board : snapshot of the calibration target; or several, each with its depth
    depth_mm : depths of the boards in the fluid, for fitted rays; empty for a single snapshot; without a board the one
        of the channel's mid plane
    picture, views : pictures to write: lattice and board; views and refocused depths
    resume : keep what is complete and made from the same inputs with the same settings
    """

    white: Sequence[Path] = ()
    dark: Path | None = None
    board: Sequence[Path] = ()
    depth_mm: Sequence[float] = ()
    picture: Path | None = None
    views: Path | None = None
    resume: bool = False


def calibrate_snapshot(
    config: Path, output: Path, options: CalibrateOptions, *, overwrite: bool = False, console: Console = CONSOLE
) -> dict[str, Any]:
    """Find the lattice in white images and the focal plane in a snapshot of the board, or rays in boards at depths."""
    white, board, depth_mm = options.white, options.board, options.depth_mm
    picture, views = options.picture, options.views
    ensure_pictures(len(white), len(board), len(depth_mm))
    whites, boards = _numbered("white", white), _numbered("board", board)
    inputs = _inputs(config, options)
    drawings = [path for path in (picture, views) if path]
    atomic.ensure_apart([output, *drawings], inputs.values())
    for target in (output, *drawings):
        atomic.ensure_writable(target, overwrite or options.resume)
    if drawings:
        pages.ensure_drawing()
    settings = load_rig(config)
    shape = settings.image_shape()
    # Before the record, for which whole files are read: what is no image is so at once.
    frames = {name: image_files.read_reference(path, shape) for name, path in inputs.items() if name != "config"}
    record = dict(target_of(config, output, options).record)
    if options.resume:
        kept = is_kept([output], record, inputs.values(), overwrite)
        if kept and all(path.exists() for path in drawings):
            return calibration_file.open_calibration(output).summary()
        overwrite = True
    camera = settings.camera_model() if views else None
    pictures = photographs(
        [frames[name] for name in whites], [frames[name] for name in boards], frames.get("dark"), depth_mm
    )
    calibration = calibration_of(settings, pictures)
    notices = calibration_notices(settings, pictures, calibration)
    console.warn(notices)
    calibration_file.write_calibration(output, calibration, with_warnings(record, notices), overwrite)
    if picture:
        from lfpiv_cli.pictures.calibration import calibration_figure

        shown = [frames[name] for name in whites] or [frames["board"]]
        sharpest = shown[by_aperture(shown, frames.get("dark"))[0]]
        pages.write_picture(picture, calibration_figure(calibration, sharpest, frames.get("board")), overwrite)
    if views and camera:
        from lfpiv_cli.pictures.calibration import views_figure

        medium = settings.media_model() if board and settings.board.medium == "fluid" else Media()
        shown_image = light(frames["board" if board else "white"], frames.get("dark"), None)
        pages.write_picture(views, views_figure(calibration, camera, medium, shown_image), overwrite)
    return calibration.summary()


def target_of(config: Path, output: Path, options: CalibrateOptions) -> Target:
    """Return where a calibration goes, with the record that it will carry."""
    resolved = load_rig(config).resolved()
    return Target(output, partial(provenance_record, "calibrate-snapshot", resolved, _inputs(config, options)))


def _inputs(config: Path, options: CalibrateOptions) -> dict[str, Path]:
    """Return the files that a calibration is made from by their roles."""
    photographs_of = _numbered("white", options.white) | _numbered("board", options.board)
    return given(config=config, dark=options.dark) | photographs_of


def _numbered(role: str, paths: Sequence[Path]) -> dict[str, Path]:
    """Return the inputs of one role by name: `white`, `white_2`, ..."""
    return {role if k == 0 else f"{role}_{k + 1}": path for k, path in enumerate(paths)}
