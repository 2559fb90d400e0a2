"""The stage of `build-weights`: how every voxel of the configured volume lights every pixel."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record, with_warnings
from lfpiv_cli.files.weights_file import write_weights
from lfpiv_cli.interface.weights import plan_of, weights_of
from lfpiv_cli.names import Method, Refraction, Sampling


@dataclass(frozen=True, kw_only=True)
class BuildWeightsOptions:
    """What `build_weights` is given besides the config.

    Attributes
    ----------
    calibration : file of `calibrate_snapshot`; None: the data sheet is believed
    method, refraction, sampling : in place of the config's, see its section `weights`
    """

    calibration: Path | None = None
    method: Method | None = None
    refraction: Refraction | None = None
    sampling: Sampling | None = None


NO_OPTIONS = BuildWeightsOptions()


def build_weights(
    config: Path,
    output: Path,
    options: BuildWeightsOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Calculate the weights of the configured volume, for the calibrated camera where there is a calibration."""
    inputs = given(config=config, calibration=options.calibration)
    ensure_writable(output, overwrite, inputs.values())
    settings = load_config(config).overridden_by("weights", options)
    found = read_calibration(options.calibration) if options.calibration else None
    plan = plan_of(settings, found)
    console.warn(plan.notices)
    provenance = with_warnings(record("build-weights", settings.resolved(), inputs), plan.notices)
    content = weights_of(plan, provenance, console)
    write_weights(output, content, overwrite)
    weights = content.weights
    return {
        "voxels_xyz": list(weights.grid.shape_xyz),
        "voxel_mm": list(weights.grid.spacing_mm),
        "padding_xyz": list(weights.padding_xyz),
        **content.reference.attributes(),
        "frame": weights.frame,
        "method": settings.weights.method,
        "refraction": settings.weights.refraction,
        "file_bytes": output.stat().st_size,
    }
