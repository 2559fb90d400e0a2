"""One function per subcommand: read, call the core, write, return the summary.

Every stage refuses outputs that it could not write before it computes, and leaves a provenance record in what it
writes. Units stand in the names of the figures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numba

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.config import Config, load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record as provenance_record
from lfpiv_cli.files.weights_file import WeightsFile, write_weights
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.object_space import ObjectSpace
from lfpiv_cli.stages_weights import make_operator, ray_source
from lfpiv_cli.weights.build import default_padding, scene_distortion
from lfpiv_cli.weights.columns import seen_share
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.operators import FactorisedOperator

# Said where the voxels were left to the program.
VOXELS_CHOSEN = (
    "lfpiv: voxels of {:.3g} x {:.3g} x {:.3g} mm were chosen: a third of a microlens wide, because particles lock to "
    "wider ones and their motion in depth is lost, and six times as deep, as fine as the views tell depths apart"
)
# Below this share of its light on the sensor a voxel counts as out of view.
LEAST_SEEN = 0.01


def use_threads(threads: int) -> None:
    """Use at most `threads` threads from here on."""
    numba.set_num_threads(min(threads, numba.config.NUMBA_NUM_THREADS))


def build_weights(
    config: Path,
    calibration: Path | None,
    method: str | None,
    refraction: str | None,
    sampling: str | None,
    output: Path,
    overwrite: bool,
    console: Console,
) -> dict[str, Any]:
    """Calculate the weights of the configured volume, for the calibrated camera where there is a calibration."""
    inputs = given(config=config, calibration=calibration)
    ensure_writable(output, overwrite, inputs.values())
    settings = load_config(config).overridden("weights", method=method, refraction=refraction, sampling=sampling)
    found = read_calibration(calibration) if calibration else None
    camera = settings.camera_model()
    if found:
        camera = found.camera(camera)
    reference_z = _reference_z_mm(settings, found)
    grid = settings.grid(origin_z_mm=reference_z)
    if settings.volume.size_mm is not None:
        console.say(VOXELS_CHOSEN.format(*grid.spacing_mm))
    media = settings.media_model()
    padding = settings.reconstruction.padding_voxel or default_padding(camera, media, grid)
    source = ray_source(settings, found, grid, console)
    _judge_view(*seen_share(camera, source, grid), grid, console)
    operator = make_operator(settings.weights, camera, source, grid.padded(padding), console)
    traced = isinstance(source, ObjectSpace) and isinstance(operator, FactorisedOperator)
    bend = scene_distortion(camera, media, grid) if traced else None
    weights = Weights(grid, padding, operator, camera.column_axis, found, bend)
    record = _record("build-weights", settings, inputs)
    vignetting = found.vignetting() if found else None
    content = WeightsFile(weights, camera, settings.volume.reference, reference_z, record, vignetting)
    write_weights(output, content, overwrite)
    return {
        "voxels_xyz": list(grid.shape_xyz),
        "voxel_mm": list(grid.spacing_mm),
        "padding_xyz": list(padding),
        "reference": settings.volume.reference,
        "reference_z_mm": reference_z,
        "frame": weights.frame,
        "method": settings.weights.method,
        "refraction": settings.weights.refraction,
        "file_bytes": output.stat().st_size,
    }


def _record(command: str, settings: Config, inputs: dict[str, Path]) -> dict[str, Any]:
    return provenance_record(command, settings.resolved(), inputs)


def _reference_z_mm(settings: Config, found: Calibration | None) -> float:
    """Return where the origin of the volume's coordinates lies, z from the nominal focal point.

    Fitted rays count z from the origin that the boards' depths were told from.
    """
    if settings.volume.reference == "focal_point" or settings.weights.method == "dlfc":
        return 0.0
    if found is None or found.mid_plane_z_mm is None:
        raise ConfigError(
            "volume.reference: mid_plane needs a calibration with a board, and the section `channel`, to say where the "
            "mid plane lies"
        )
    return found.mid_plane_z_mm


def _judge_view(smallest: float, largest: float, grid: Grid, console: Console) -> None:
    """Refuse a volume that the sensor does not see and warn of one that it sees in part."""
    if largest < LEAST_SEEN:
        bounds = [grid.bounds_mm(axis) for axis in range(3)]
        spans = ", ".join(f"{axis} {low:.4g} to {high:.4g}" for axis, (low, high) in zip("xyz", bounds, strict=True))
        raise ConfigError(f"volume: none of it ({spans} mm) lies in the camera's view")
    if smallest < LEAST_SEEN:
        console.say("lfpiv: a part of the volume lies outside the camera's view; nothing will be found there")
