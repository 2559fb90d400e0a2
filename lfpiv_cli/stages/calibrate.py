"""The stage of `calibrate-snapshot`: photographs in, the calibration file and a picture out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lfpiv_cli.calibration.white import by_aperture
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files import images as image_files
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import Target, is_kept
from lfpiv_cli.files.calibration_file import read_calibration, write_calibration
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.places import ensure_apart
from lfpiv_cli.files.provenance import record as provenance_record
from lfpiv_cli.files.provenance import with_warnings
from lfpiv_cli.interface.calibration import calibration_notices, calibration_of, ensure_pictures, photographs
from lfpiv_cli.optics.media import Media
from lfpiv_cli.reconstruction.images import light


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
    config: Path,
    output: Path,
    options: CalibrateOptions,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Find the lattice in white images and the focal plane in a snapshot of the board, or rays in boards at depths."""
    white, board, depth_mm = options.white, options.board, options.depth_mm
    picture, views = options.picture, options.views
    ensure_pictures(len(white), len(board), len(depth_mm))
    whites, boards = _numbered("white", white), _numbered("board", board)
    inputs = _inputs(config, options)
    drawings = [path for path in (picture, views) if path]
    ensure_apart([output, *drawings], inputs.values())
    for target in (output, *drawings):
        ensure_writable(target, overwrite or options.resume)
    if drawings:
        ensure_drawing()
    settings = load_config(config)
    shape = settings.image_shape()
    # Before the record, for which whole files are read: what is no image is so at once.
    frames = {name: image_files.read_reference(path, shape) for name, path in inputs.items() if name != "config"}
    record = dict(target_of(config, output, options).record)
    if options.resume:
        kept = is_kept([output], record, inputs.values(), overwrite, resume=True)
        if kept and all(path.exists() for path in drawings):
            return read_calibration(output).summary()
        overwrite = True
    camera = settings.camera_model() if views else None
    pictures = photographs(
        [frames[name] for name in whites], [frames[name] for name in boards], frames.get("dark"), depth_mm
    )
    calibration = calibration_of(settings, pictures)
    notices = calibration_notices(settings, pictures, calibration)
    console.warn(notices)
    write_calibration(output, calibration, with_warnings(record, notices), overwrite)
    if picture:
        from lfpiv_cli.pictures.calibration import calibration_figure

        shown = [frames[name] for name in whites] or [frames["board"]]
        sharpest = shown[by_aperture(shown, frames.get("dark"))[0]]
        write_picture(picture, calibration_figure(calibration, sharpest, frames.get("board")), overwrite)
    if views and camera:
        from lfpiv_cli.pictures.views import views_figure

        medium = settings.media_model() if board and settings.board.medium == "fluid" else Media()
        shown_image = light(frames["board" if board else "white"], frames.get("dark"), None)
        write_picture(views, views_figure(calibration, camera, medium, shown_image), overwrite)
    return calibration.summary()


def target_of(config: Path, output: Path, options: CalibrateOptions) -> Target:
    """Return where a calibration goes, with the record that it will carry."""
    resolved = load_config(config).resolved()
    return Target(output, partial(provenance_record, "calibrate-snapshot", resolved, _inputs(config, options)))


def _inputs(config: Path, options: CalibrateOptions) -> dict[str, Path]:
    """Return the files that a calibration is made from by their roles."""
    photographs_of = _numbered("white", options.white) | _numbered("board", options.board)
    return given(config=config, dark=options.dark) | photographs_of


def _numbered(role: str, paths: Sequence[Path]) -> dict[str, Path]:
    """Return the inputs of one role by name: `white`, `white_2`, ..."""
    return {role if k == 0 else f"{role}_{k + 1}": path for k, path in enumerate(paths)}
