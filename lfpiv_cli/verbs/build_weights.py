"""`build-weights`: how every voxel of the configured volume lights every pixel."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files.atomic import ensure_writable
from lfpiv_cli.files.batch import Target, is_kept
from lfpiv_cli.files.calibration_file import open_calibration
from lfpiv_cli.files.config import Config, load_rig
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.provenance import record, with_warnings
from lfpiv_cli.files.weights_file import WeightsFile, open_weights, write_weights
from lfpiv_cli.grid import Grid, Reference
from lfpiv_cli.names import Method, Refraction, Sampling
from lfpiv_cli.notice import Notice, warn_of, written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.curved_space import CurvedSpace
from lfpiv_cli.optics.tracing import ObjectSpace, PolynomialRays
from lfpiv_cli.verbs import weights_cost
from lfpiv_cli.weights.build import default_padding, scene_distortion
from lfpiv_cli.weights.columns import ColumnOperator, OnDemandOperator, operator_of, seen_share
from lfpiv_cli.weights.model import Weights
from lfpiv_cli.weights.operators import FactorisedOperator, WeightsOperator
from lfpiv_cli.weights.quadrature import RayCount, count_columns
from lfpiv_cli.weights.scene import Source, aimed_misfit_mm, curved_padding
from lfpiv_cli.weights.strips import StripOperator

# Told where the voxels were left to the program, and where the axes do not separate.
VOXELS_CHOSEN = (
    "voxels of {} x {} x {} mm were chosen: a third of a microlens wide, because particles lock to "
    "wider ones and their motion in depth is lost, and six times as deep, as fine as the views tell depths apart"
)
ON_DEMAND = "array or rays do not separate into axes; columns are made on demand, for what is lit"
# Below this share of its light on the sensor a voxel counts as out of view.
LEAST_SEEN = 0.01
# Of the volume's length, at either end: the paper's volume is 0.06 mm longer than its sensor sees.
RIM_SHARE = 0.01
# Cubic polynomials are good to a third of their range beyond it: the paper's volume reaches a quarter beyond boards.
FARTHEST_BEYOND = 0.3
# Weights of traced rays are off by 0.005 to 0.02 in L1 themselves, the 5 million rays of the paper by 0.045.
LARGEST_MISFIT_L1 = 0.04


def build_weights(rig: Config, calibration: Calibration | None = None, **settings: Any) -> WeightsFile:
    """Calculate how every voxel of the rig's volume lights every pixel.

    Parameters
    ----------
    rig : Config
        From `load_rig`.
    calibration : Calibration, optional
        From `calibrate` or `open_calibration`; without it the data sheet is believed.
    **settings
        Keys of the rig's section `weights`, in their place: method, refraction, sampling and so on.

    Returns
    -------
    WeightsFile
        `shape` (z, y, x) of the volume and `image_shape` (rows, columns); `forward` gives the image of a volume,
        `adjoint` the volume that an image is spread back to, `column` the pixels that one voxel lights.

    Raises
    ------
    ConfigError
        The rig or the settings are not possible, or need a calibration that is not there.
    """
    chosen = rig.overridden("weights", **settings).with_scene_of(calibration)
    made = record("build-weights", chosen.resolved(), {})
    plan = plan_of(chosen, calibration)
    found = weights_of(plan, made, Console(quiet=True))
    warn_of(plan.notices)
    return found.behind_vignetting()


@dataclass(frozen=True, eq=False)
class Plan:
    """Weights that are to be made.

    Attributes
    ----------
    settings, found : the config, and the calibration or None
    camera : calibrated, in the frame that the weights work in
    reference, grid : the origin of the volume's coordinates, and the volume, z from the focal point
    padding : voxels (x, y, z) solved for beyond each side of it
    source : how rays are found
    notices : what speaks against the weights
    """

    settings: Config
    found: Calibration | None
    camera: Camera
    reference: Reference
    grid: Grid
    padding: tuple[int, int, int]
    source: Source
    notices: list[Notice]


def plan_of(settings: Config, found: Calibration | None) -> Plan:
    """Return what is to be made for the configured volume, for the calibrated camera where there is a calibration.

    Raises
    ------
    ConfigError, InputError
        Rig and settings are not possible, or need another calibration.
    """
    # Fitted rays count z from the origin that the boards' depths were told from.
    reference = Reference(settings.volume.reference, 0.0)
    if reference.name != "focal_point" and settings.weights.method != "dlfc":
        if found is None or found.mid_plane_z_mm is None:
            raise ConfigError(
                "volume.reference: mid_plane needs a calibration with a board or with --depth-mm, and the section "
                "channel: they say where the mid plane lies"
            )
        reference = Reference(reference.name, found.mid_plane_z_mm)
    notices = weights_cost.check_rig(settings, found)
    source, grid, sheet = settings.ray_source(found), settings.grid(reference), settings.camera_model()
    camera, padding = found.camera(sheet) if found else sheet, settings.reconstruction.padding_voxel
    # What may lie out of view without a word, and what the sensor sees of the voxels' light within it.
    x, y, z = (-math.ceil(RIM_SHARE * n) if n > 2 else 0 for n in grid.shape_xyz)
    smallest, largest = seen_share(camera, source, grid.padded((x, y, z)))
    if largest < LEAST_SEEN:
        bounds = [grid.bounds_mm(axis) for axis in range(3)]
        spans = ", ".join(
            f"{axis} {written(low, 4)} to {written(high, 4)}" for axis, (low, high) in zip("xyz", bounds, strict=True)
        )
        raise ConfigError(f"volume: none of it ({spans} mm) lies in the camera's view")
    if not padding and isinstance(source, CurvedSpace):
        padding = curved_padding(camera, source, grid)
    padding = padding or default_padding(camera, settings.media_model(), grid)
    weights_cost.check_rays(settings, source, grid.padded(padding))
    beyond = _reach_notices(settings, found, grid)
    notices += weights_cost.ray_notices(settings, found, camera, source, grid)
    if smallest < LEAST_SEEN:
        text = "a part of it lies outside the camera's view, where nothing will be found"
        remedy = "a smaller volume, or another centre_mm"
        expected = f"at least {LEAST_SEEN:g} of each voxel's light on the sensor"
        notices.append(Notice("volume-out-of-view", "volume", text, remedy, float(smallest), expected))
    return Plan(settings, found, camera, reference, grid, padding, source, notices + beyond)


def weights_of(plan: Plan, provenance: dict[str, Any], console: Console) -> WeightsFile:
    """Return the weights of a plan: factorised where the axes separate, else on demand; or counted where asked for."""
    settings, camera, grid, found = plan.settings, plan.camera, plan.grid, plan.found
    if settings.volume.size_mm is not None:
        console.say(VOXELS_CHOSEN.format(*map(written, grid.spacing_mm)))
    padded, chosen = grid.padded(plan.padding), settings.weights
    operator: WeightsOperator
    if chosen.sampling == "exact" or isinstance(plan.source, PolynomialRays):
        operator = operator_of(camera, plan.source, padded)
        if isinstance(operator, OnDemandOperator):
            console.say(ON_DEMAND)
    else:
        layout = OnDemandOperator(camera, plan.source, padded)
        voxels, count = math.prod(layout.shape), RayCount(chosen.points, chosen.rays_per_point)
        centres, rng = layout.centres_mm(np.arange(voxels)), np.random.default_rng(chosen.seed)
        with console.progress(voxels, "count rays") as advance:
            columns = count_columns(camera, plan.source, centres, layout.sides_mm, rng, count, advance)
        operator = ColumnOperator(layout.shape, layout.image_shape, np.arange(voxels), columns)
    traced = isinstance(plan.source, ObjectSpace) and isinstance(operator, FactorisedOperator)
    bend = scene_distortion(camera, settings.media_model(), grid) if traced else None
    weights = Weights(grid, plan.padding, operator, camera.column_axis, found, bend)
    vignetting = found.vignetting() if found else None
    return WeightsFile(weights, camera, plan.reference, provenance, vignetting)


def curved_summary(content: WeightsFile) -> dict[str, Any]:
    """Return what is to be told of weights behind curved faces: nothing where there are none.

    That is how many voxels lie outside the fluid, and how far columns of a sample are from those of traced rays, in L1,
    or rays, rms on the array, from traced ones.
    """
    operator, outside = content.weights.solver_operator, {"voxels_outside_fluid": content.weights.voxels_outside_fluid}
    if isinstance(operator, StripOperator):
        misfit = operator.misfit_l1
        middle_and_worst = (
            {"column_misfit_l1_median": float(np.median(misfit)), "column_misfit_l1_largest": float(misfit.max())}
            if misfit.size
            else {}
        )
        return middle_and_worst | outside
    if isinstance(operator, OnDemandOperator) and isinstance(operator.source, CurvedSpace):
        return {"ray_misfit_mm": aimed_misfit_mm(content.camera, operator.source, content.weights.grid), **outside}
    return {}


def misfit_notices(content: WeightsFile) -> list[Notice]:
    """Return whether weights in strips are farther from traced rays than they should be."""
    operator = content.weights.solver_operator
    if not isinstance(operator, StripOperator) or not operator.misfit_l1.size:
        return []
    largest = float(operator.misfit_l1.max())
    if largest <= LARGEST_MISFIT_L1:
        return []
    text = (
        f"the weights behind the scene are off by {largest:.3f} in L1 for the worst of {operator.misfit_l1.size} "
        f"voxels that were held against traced rays, {np.median(operator.misfit_l1):.3f} for the middle one; "
        f"at most {LARGEST_MISFIT_L1:g} was expected"
    )
    remedy = (
        "a volume that stays away from the window's sides, or smaller voxels; "
        "`lfpiv validate weights` shows the columns"
    )
    return [Notice("weights-inexact", "volume", text, remedy, largest, f"at most {LARGEST_MISFIT_L1:g}")]


def _reach_notices(settings: Config, found: Calibration | None, grid: Grid) -> list[Notice]:
    """Return where a volume reaches far beyond the boards that its rays were fitted to."""
    if settings.weights.method != "dlfc" or found is None or found.ray_fit is None:
        return []
    fit, notices = found.ray_fit, []
    lateral = fit.reach_mm if settings.camera_model().column_axis == "x" else fit.reach_mm[:, ::-1]
    for axis, (low, high) in enumerate([*lateral.T, (fit.depths_mm.min(), fit.depths_mm.max())]):
        beyond, most = (
            max(low - grid.bounds_mm(axis)[0], grid.bounds_mm(axis)[1] - high),
            FARTHEST_BEYOND * (high - low),
        )
        if beyond > most:
            text = (
                f"reaches {written(beyond)} mm beyond the dots along {'xyz'[axis]}, at most {written(most)} mm "
                "without harm: the fitted rays are a guess there"
            )
            remedy = "a smaller volume, or boards that reach further"
            notices.append(
                Notice("beyond-boards", "volume", text, remedy, float(beyond), f"at most {written(most)} mm")
            )
    return notices


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


def build_weights_file(
    config: Path,
    output: Path,
    options: BuildWeightsOptions = BuildWeightsOptions(),
    *,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Calculate the weights of the configured volume, for the calibrated camera where there is a calibration.

    What speaks against the work's size is no fault of the result, and not kept with it.
    """
    inputs = given(config=config, calibration=options.calibration)
    ensure_writable(output, overwrite or options.resume, inputs.values())
    found = open_calibration(options.calibration) if options.calibration else None
    settings = load_rig(config).overridden_by("weights", options).with_scene_of(found)
    if not options.dry_run:
        weights_cost.ensure_volume_fits(settings, by_volumes=False)
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
    if options.resume and is_kept([output], made, inputs.values(), overwrite):
        return summary | {"frame": open_weights(output).frame, "file_bytes": output.stat().st_size}
    cost = weights_cost.cost_of(settings, plan.camera, plan.source, plan.grid.padded(plan.padding))
    console.warn([*plan.notices, *weights_cost.cost_notices(cost)])
    if options.dry_run:
        return summary | cost.summary()
    weights_cost.ensure_fits(cost, output)
    console.detail(f"about {written(cost.weights_core_s, 2)} s of a core and {written(cost.weights_bytes / 1e9, 2)} GB")
    content = weights_of(plan, made, console)
    found_out = misfit_notices(content)
    console.warn(found_out)
    content = replace(content, provenance=with_warnings(made, [*plan.notices, *found_out]))
    write_weights(output, content, overwrite)
    return summary | curved_summary(content) | {"frame": content.weights.frame, "file_bytes": output.stat().st_size}


def target_of(config: Path, output: Path, options: BuildWeightsOptions) -> Target:
    """Return where weights go, with the record that they will carry by a calibration that knows of no scene's place."""
    resolved = load_rig(config).overridden_by("weights", options).resolved()
    inputs = given(config=config, calibration=options.calibration)
    return Target(output, partial(record, "build-weights", resolved, inputs))
