"""The stage of `build-weights`: how every voxel of the configured volume lights every pixel."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import Target, is_kept
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record, with_warnings
from lfpiv_cli.files.weights_file import open_weights, write_weights
from lfpiv_cli.interface.weights import curved_summary, misfit_notices, plan_of, weights_of
from lfpiv_cli.interface.weights_cost import cost_notices, cost_of, ensure_fits, ensure_volume_fits
from lfpiv_cli.names import Method, Refraction, Sampling
from lfpiv_cli.notice import written


@dataclass(frozen=True, kw_only=True)
class BuildWeightsOptions:
    """What `build_weights` is given besides the config.

    Attributes
    ----------
    calibration : file of `calibrate_snapshot`; None: the data sheet is believed
    method, refraction, sampling : in place of the config's, see its section `weights`
    dry_run : check everything and estimate the work, make nothing
    resume : keep what is complete and made from the same inputs with the same settings
    """

    calibration: Path | None = None
    method: Method | None = None
    refraction: Refraction | None = None
    sampling: Sampling | None = None
    dry_run: bool = False
    resume: bool = False


NO_OPTIONS = BuildWeightsOptions()


def build_weights(
    config: Path,
    output: Path,
    options: BuildWeightsOptions = NO_OPTIONS,
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Calculate the weights of the configured volume, for the calibrated camera where there is a calibration.

    What speaks against the work's size is no fault of the result, and not kept with it.
    """
    inputs = given(config=config, calibration=options.calibration)
    ensure_writable(output, overwrite or options.resume, inputs.values())
    found = read_calibration(options.calibration) if options.calibration else None
    settings = load_config(config).overridden_by("weights", options).with_scene_of(found)
    if not options.dry_run:
        ensure_volume_fits(settings, by_volumes=False)
    plan = plan_of(settings, found)
    summary = {
        "voxels_xyz": list(plan.grid.shape_xyz),
        "voxel_mm": list(plan.grid.spacing_mm),
        "padding_xyz": list(plan.padding),
        **plan.reference.attributes(),
        "method": settings.weights.method,
        "refraction": settings.refraction(),
    }
    made = record("build-weights", settings.resolved(), inputs)
    if options.resume and is_kept([output], made, inputs.values(), overwrite, resume=True):
        return summary | {"frame": open_weights(output).frame, "file_bytes": output.stat().st_size}
    cost = cost_of(settings, plan.camera, plan.source, plan.grid.padded(plan.padding))
    console.warn([*plan.notices, *cost_notices(cost)])
    if options.dry_run:
        return summary | cost.summary()
    ensure_fits(cost, output)
    console.detail(f"about {written(cost.weights_core_s, 2)} s of a core and {written(cost.weights_bytes / 1e9, 2)} GB")
    content = weights_of(plan, made, console)
    found_out = misfit_notices(content)
    console.warn(found_out)
    content = replace(content, provenance=with_warnings(made, [*plan.notices, *found_out]))
    write_weights(output, content, overwrite)
    return summary | curved_summary(content) | {"frame": content.weights.frame, "file_bytes": output.stat().st_size}


def target_of(config: Path, output: Path, options: BuildWeightsOptions) -> Target:
    """Return where weights go, with the record that they will carry by a calibration that knows of no scene's place."""
    resolved = load_config(config).overridden_by("weights", options).resolved()
    inputs = given(config=config, calibration=options.calibration)
    return Target(output, partial(record, "build-weights", resolved, inputs))
