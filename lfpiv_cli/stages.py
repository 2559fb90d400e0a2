"""One function per subcommand: read, call the core, write, return the summary.

Every stage refuses outputs that it could not write before it computes, and leaves a provenance record in what it
writes. Units stand in the names of the figures.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.calibration.model import Calibration
from lfpiv_cli.console import Console
from lfpiv_cli.errors import ConfigError, InputError, LimitMissedError, UsageError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.batch import Target, output_paths, pending, prepare_folder
from lfpiv_cli.files.calibration_file import read_calibration
from lfpiv_cli.files.config import Config, carried_config, load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.particles import read_particles
from lfpiv_cli.files.pictures import ensure_drawing, write_picture
from lfpiv_cli.files.provenance import record as provenance_record
from lfpiv_cli.files.weights_file import WeightsFile, write_weights
from lfpiv_cli.flow.correlation import correlate as correlate_volumes
from lfpiv_cli.flow.correlation import count_passes
from lfpiv_cli.flow.field import REJECTED, VectorField
from lfpiv_cli.grid import Grid
from lfpiv_cli.stages_weights import make_operator, ray_source
from lfpiv_cli.validation.flow import flow_figures, limits_missed, truth_at_points
from lfpiv_cli.validation.pictures import flow_figure
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
    bend = scene_distortion(camera, media, grid) if isinstance(operator, FactorisedOperator) else None
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


def correlate(
    volumes: Sequence[Path],
    config: Path | None,
    dt_s: float | None,
    windows: str | None,
    overlap: float | None,
    pairing: str | None,
    resume: bool,
    output: Path,
    overwrite: bool,
    console: Console,
) -> dict[str, Any]:
    """Measure the displacements between pairs of volumes."""
    pairs = _pairs(volumes, pairing)
    paths = output_paths(output, [first.stem for first, _ in pairs])
    prepare_folder(paths)
    told = load_config(config) if config else None
    sizes = [_window(text) for text in windows.split(",")] if windows else None
    rejected = total = 0
    settings_of = []
    for first, _ in pairs:
        settings = told or carried_config(vtkhdf.read_header(first).provenance, first)
        settings_of.append(settings.overridden("correlation", dt_s=dt_s, windows=sizes, overlap=overlap))
    targets = [
        Target(path, _record("correlate", settings, given(config=config, volume_a=pair[0], volume_b=pair[1])))
        for path, pair, settings in zip(paths, pairs, settings_of, strict=True)
    ]
    inputs = [*volumes, *filter(None, [config])]
    for number in pending(targets, inputs, overwrite, resume, _record_of):
        volume_a, volume_b = (vtkhdf.open_volume(path) for path in pairs[number])
        _ensure_alike(pairs[number], volume_a, volume_b)
        chosen = settings_of[number].correlation
        grid = volume_a.grid
        sizes_xyz = settings_of[number].windows_voxel(grid.spacing_mm)
        with console.progress(count_passes(sizes_xyz), "correlate") as advance:
            field = correlate_volumes(
                volume_a.array,
                volume_b.array,
                grid,
                sizes_xyz,
                settings_of[number].overlap(grid.spacing_mm),
                chosen.dt_s,
                progress=advance,
                exponent=settings_of[number].correlation_exponent(),
            )
        vtkhdf.write_vectors(
            targets[number].path,
            field,
            provenance=targets[number].record,
            attributes={name: volume_a.attributes[name] for name in ("reference", "reference_z_mm")},
            overwrite=overwrite,
        )
        rejected += int(np.count_nonzero(field.flag >= REJECTED))
        total += field.flag.size
    return {"pairs": len(pairs), "vectors": total, "rejected": rejected}


def validate_flow(
    config: Path, vectors: Path, particles: Path | None, output: Path, overwrite: bool, console: Console
) -> dict[str, Any]:
    """Judge a vector field by an analytic flow or by true particles."""
    inputs = given(config=config, vectors=vectors, particles=particles)
    figures_path, picture_path = output / "flow.json", output / "flow.png"
    prepare_folder([figures_path])
    for target in (figures_path, picture_path):
        ensure_writable(target, overwrite, inputs.values())
    ensure_drawing()
    settings = load_config(config)
    field = vtkhdf.open_vectors(vectors)
    if field.dt_s is None:
        raise InputError(f"{vectors}: holds displacements without a time; correlate again with --dt-s")
    centres = _window_centres_mm(field)
    if particles:
        truth, inside = _truth_of_particles(
            particles, centres, vtkhdf.read_header(vectors).attributes["reference_z_mm"]
        )
    else:
        truth = settings.true_flow()(centres.reshape(-1, 3)).reshape(centres.shape)
        inside = np.asarray(truth.any(axis=-1))
    figures = flow_figures(field, truth, inside)
    record = _record("validate flow", settings, inputs)
    missed = limits_missed(figures, settings.validation.limits.model_dump())
    write_json(figures_path, {"figures": figures, "limits_missed": missed, "provenance": record}, overwrite)
    write_picture(picture_path, flow_figure(field, truth, inside), overwrite)
    if missed:
        raise LimitMissedError(f"{figures_path}: {'; '.join(missed)}")
    return {name: value for name, value in figures.items() if not isinstance(value, (list, dict))}


def _record(command: str, settings: Config, inputs: dict[str, Path]) -> dict[str, Any]:
    return provenance_record(command, settings.resolved(), inputs)


def _window_centres_mm(field: VectorField) -> NDArray[np.float64]:
    """Return the window centres (nz, ny, nx, 3) in the coordinates of the file."""
    z, y, x = np.meshgrid(*(field.grid.axis_mm(axis) for axis in (2, 1, 0)), indexing="ij")
    return np.stack([x, y, z], axis=-1)


def _truth_of_particles(
    path: Path, centres_mm: NDArray[np.float64], reference_z_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the true velocities at the window centres, and which of these lie among the particles."""
    particles = read_particles(path)
    centres = centres_mm + np.array([0.0, 0.0, reference_z_mm])
    low, high = particles.positions_mm.min(axis=0), particles.positions_mm.max(axis=0)
    inside = np.all((centres >= low) & (centres <= high), axis=-1)
    return truth_at_points(particles.positions_mm, particles.velocities_m_s, centres), inside


def _record_of(path: Path) -> dict[str, Any]:
    return vtkhdf.read_header(path).provenance


def _reference_z_mm(settings: Config, found: Calibration | None) -> float:
    """Return where the origin of the volume's coordinates lies, z from the nominal focal point."""
    if settings.volume.reference == "focal_point":
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


def _pairs(volumes: Sequence[Path], pairing: str | None) -> list[tuple[Path, Path]]:
    """Return the pairs to correlate: (1, 2), (3, 4) ... for `ab`, (1, 2), (2, 3) ... for `sequence`."""
    if len(volumes) < 2 or (pairing != "sequence" and len(volumes) % 2):
        raise UsageError(f"correlate needs pairs of volumes, got {len(volumes)}")
    if len(volumes) > 2 and pairing is None:
        raise UsageError(
            f"{len(volumes)} volumes need --pairing: ab for separate pairs or sequence for each with the next"
        )
    step = 1 if pairing == "sequence" else 2
    return [(volumes[k], volumes[k + 1]) for k in range(0, len(volumes) - 1, step)]


def _window(text: str) -> int | list[int]:
    """Return a window given as 32 or 32x32x16."""
    try:
        sizes = [int(part) for part in text.lower().split("x")]
    except ValueError as error:
        raise UsageError(f"--windows: {text!r} is neither a number of voxels nor three of them as 32x32x16") from error
    return sizes[0] if len(sizes) == 1 else sizes


def _ensure_alike(paths: tuple[Path, Path], first: vtkhdf.Volume, second: vtkhdf.Volume) -> None:
    """Refuse two volumes that were not made alike."""
    if first.grid != second.grid:
        raise InputError(f"{paths[1]}: its grid {second.grid} differs from that of {paths[0]}, {first.grid}")
    if first.attributes["reference"] != second.attributes["reference"]:
        raise InputError(f"{paths[1]}: its coordinates have another origin than those of {paths[0]}")
    if first.provenance.get("config") != second.provenance.get("config"):
        raise InputError(f"{paths[1]}: was made with another config than {paths[0]}")
