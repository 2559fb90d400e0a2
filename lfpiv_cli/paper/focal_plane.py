"""The focal plane from one snapshot of a board on the wall (Eq. 21), against where it truly is."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.console import Console
from lfpiv_cli.files.pages import Table
from lfpiv_cli.paper.parts import Drawing, Findings, Row, Work
from lfpiv_cli.paper.rig import BOARD, MISALIGNED, sections
from lfpiv_cli.stages.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.stages.simulate import simulate_board, simulate_white
from lfpiv_cli.validation.paper_pictures import focal_plane_figure

if TYPE_CHECKING:
    from pathlib import Path

SEED = 21
# How far the camera may be focused in front of the wall or behind it, mm.
LARGEST_MM = 2.0
# Half a voxel of the paper's: a volume that lies further off than that is another volume.
LIMIT_MM = 0.05
# Stated errors are those of Gaussian noise; of some ten boards none is expected beyond so many of them.
LIMIT_SIGMAS = 4.0
SMALL = {
    "camera": {"microlenses": {"columns": None, "rows": None}, "sensor": {"columns": 600, "rows": 448}},
    "board": {"dots": [5, 4], "spacing_mm": 0.5, "dot_diameter_mm": 0.15},
}


def focal_plane(work: Work) -> Findings:
    """Photograph a board before and behind the focal plane and measure where the channel's mid plane comes to lie."""
    errors_mm = np.linspace(-LARGEST_MM, LARGEST_MM, work.by_size(2, 5, 9))
    whites = work.folder / "white"
    base = _config(work, "white", 0.0)
    simulate_white(base, whites, overwrite=True, console=work.console)
    found = [work.step(f"board_{error:+g}mm", partial(_measured, work, whites, float(error))) for error in errors_mm]
    measured, sigma, true = (np.array([each[name] for each in found]) for name in ("mid_mm", "sigma_mm", "true_mm"))
    off = measured - true
    return Findings(
        rows=(
            Row(
                quantity="place of the mid plane, largest error (mm)",
                source="Eq. 21",
                limit=LIMIT_MM,
                best=float(np.abs(off).max()),
            ),
            Row(
                quantity="the same, in stated standard errors",
                source="Eq. 21",
                limit=LIMIT_SIGMAS,
                best=float(np.abs(off / sigma).max()),
            ),
        ),
        drawings=(
            Drawing(
                "mid_plane",
                "Where one snapshot puts the mid plane of the channel, less where it is, over how far the camera was "
                "focused away from the board (Eq. 21). Bars: the stated standard error.",
                focal_plane_figure(errors_mm, off, sigma),
            ),
        ),
        tables=(_table(errors_mm, measured, true, sigma),),
        text=(
            "The board lies on the outer wall of the channel and the camera is meant to be focused on it. Here it is "
            f"focused up to {LARGEST_MM:g} mm before and behind it; the snapshot alone tells by how much, and Eq. 21 "
            "where the mid plane of the channel comes to lie once the board is taken away and the camera moved. The "
            "array is turned and shifted, the board tilted, and light and sensor have their noise. The paper gives no "
            f"figure; the limit is half of its voxels. {_size(work)}",
        ),
        commands=(
            "lfpiv simulate white work/focal-plane/white.yaml -o work/focal-plane/white --overwrite",
            "lfpiv simulate board work/focal-plane/board_+2mm.yaml -o work/focal-plane/board_+2mm --overwrite",
            "lfpiv calibrate-snapshot work/focal-plane/board_+2mm.yaml --white work/focal-plane/white/white.tif "
            "--dark work/focal-plane/white/dark.tif --board work/focal-plane/board_+2mm/board.tif "
            "-o work/focal-plane/board_+2mm/calibration.h5 --overwrite",
        ),
        seeds=(SEED,),
    )


def _config(work: Work, name: str, error_mm: float) -> Path:
    small = work.by_size(SMALL, SMALL, {})
    return work.config(
        name,
        sections(
            camera=small.get("camera", {}),
            board=BOARD | {"medium": "air"} | small.get("board", {}),
            channel={"width_mm": 10.0, "wall_mm": 5.0},
            window=None,
            simulation=MISALIGNED | {"seed": SEED, "board_z_mm": float(error_mm)},
        ),
    )


def _measured(work: Work, whites: Path, error_mm: float) -> dict[str, float]:
    """Return where a snapshot puts the mid plane, and where it is, mm from the focal plane."""
    name = f"board_{error_mm:+g}mm"
    config, folder = _config(work, name, error_mm), work.folder / name
    quiet = Console(only_warnings=True)
    simulate_board(config, folder, overwrite=True, console=quiet)
    pictures = CalibrateOptions(white=[whites / "white.tif"], dark=whites / "dark.tif", board=[folder / "board.tif"])
    told = calibrate_snapshot(config, folder / "calibration.h5", pictures, overwrite=True, console=quiet)
    # after the move of Eq. 21 the focal plane is as far off the mid plane as it was off the board, times n_w
    return {
        "mid_mm": told["mid_plane_z_mm"],
        "sigma_mm": told["mid_plane_z_mm_sigma"],
        "true_mm": error_mm * sections()["media"]["fluid"],
    }


def _table(
    errors_mm: NDArray[np.float64], measured: NDArray[np.float64], true: NDArray[np.float64], sigma: NDArray[np.float64]
) -> Table:
    rows = zip(errors_mm, true, measured, sigma, strict=True)
    return Table(
        "Mid plane from the focal plane (mm)",
        ("board behind the focal plane", "true", "measured", "stated standard error"),
        tuple((f"{a:+z.2f}", f"{b:+z.3f}", f"{c:+z.3f}", f"{d:.4f}") for a, b, c, d in rows),
    )


def _size(work: Work) -> str:
    corner = "A corner of the sensor, 20 dots half a millimetre apart."
    return work.by_size(corner, corner, "Full sensor, 49 dots.")
