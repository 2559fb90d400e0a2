"""The stage of `validate volume`: a reconstructed volume against the particles that were there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.errors import ConfigError
from lfpiv_cli.files import vtkhdf
from lfpiv_cli.files.atomic import ensure_writable, write_json
from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.inputs import given
from lfpiv_cli.files.particles import MM_PER_M, read_particles
from lfpiv_cli.files.provenance import record
from lfpiv_cli.names import Moment
from lfpiv_cli.validation.volume import volume_figures

# When the frames of a pair are taken, in units of the time between them, counted from the middle of the pair.
MOMENTS: dict[Moment, float] = {"a": -0.5, "middle": 0.0, "b": 0.5}


def validate_volume(
    config: Path,
    output: Path,
    *,
    volume: Path,
    particles: Path,
    frame: Moment,
    overwrite: bool = False,
    console: Console = CONSOLE,
) -> dict[str, Any]:
    """Judge a volume by the true particles, which are known at the middle of a pair."""
    inputs = given(config=config, volume=volume, particles=particles)
    report = output / "volume.json"
    ensure_writable(report, overwrite, inputs.values())
    settings = load_config(config)
    found, true = vtkhdf.open_volume(volume), read_particles(particles)
    dt_s = settings.correlation.dt_s
    if MOMENTS[frame] and dt_s is None:
        raise ConfigError(f"{config}: correlation.dt_s: is missing, and --frame {frame} needs it")
    moved = MOMENTS[frame] * (dt_s or 0.0) * MM_PER_M * true.velocities_m_s
    position = found.reference.points_from_focal_point(true.positions_mm + moved)
    camera = settings.camera_model()
    microlens_mm = float(camera.lattice.pitch.mean()) / abs(camera.magnification)
    figures = volume_figures(found.array, found.grid, position, true.brightness, microlens_mm) | {
        "residual": found.attributes["residual"][-1],
        "iterations": len(found.attributes["residual"]) - 1,
    }
    provenance = record(f"validate volume, frame {frame}", settings.resolved(), inputs)
    write_json(report, {"figures": figures, "provenance": provenance}, overwrite)
    return figures
