"""The tracers' size by their images, and what is found with it: three sizes, sparse to crowded, two cameras.

Pairs are simulated by command, with a camera that is as its data sheet says, behind a window by Snell's law; nothing is
said of the tracers. Each line has the size that is measured and the one taken, the tracers for each microlens as
counted, what is found of the first frame, and the codes of all warnings.
"""

from __future__ import annotations

import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import yaml

import lfpiv_cli as lf
from benchmarks.rigs import run_command
from lfpiv_cli.validation.volume import particle_figures

Tree = dict[str, Any]
CROWDS, SIZES_MM = (0.1, 0.3, 0.65, 1.2, 2.0, 4.0), (0.03, 0.05, 0.1)
# Sensor in microlenses (columns, rows); the volume leaves some at its sides to tracers that are lit in part.
LENSES, AT_SIDES = (40, 36), 3
# Depth of the volume, in depths over which light spreads by one lens.
DEPTHS = 9.4
# Table 2's, and one of wider microlenses before a lens of shorter focal length.
CAMERAS: dict[str, Tree] = {
    "table 2": {
        "main_lens": {"magnification": -1.0, "focal_length_mm": 100.0, "aperture_mm": 25.0},
        "microlenses": {"focal_length_mm": 0.8, "pitch_mm": 0.1},
        "sensor": {"pixel_um": 5.5, "microlens_distance_mm": 0.8},
    },
    "M -0.8": {
        "main_lens": {"magnification": -0.8, "focal_length_mm": 75.0, "aperture_mm": 16.5},
        "microlenses": {"focal_length_mm": 1.0, "pitch_mm": 0.125},
        "sensor": {"pixel_um": 5.5, "microlens_distance_mm": 1.0},
    },
}
SEED = 0


def bench_tracer_sizes() -> None:
    """Print a line for each camera, number of tracers for each microlens and size."""
    for camera in CAMERAS:
        for crowd in CROWDS:
            for size_mm in SIZES_MM:
                print_line(camera, crowd, size_mm, LENSES, SEED)


def print_line(name: str, crowd: float, size_mm: float, lenses: tuple[int, int], seed: int) -> None:
    """Print what is found of so many tracers for each microlens before a sensor of so many microlenses."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        rig = folder / "rig.yaml"
        rig.write_text(yaml.safe_dump(experiment(name, crowd, size_mm, lenses, seed)))
        step = run_command("simulate", "particles", rig, "-o", folder)
        if step.exit_code:
            raise SystemExit(step.error)
        settings = lf.load_rig(rig)
        image, true = lf.read_image(folder / "pair_a.tif"), np.load(folder / "particles.npz")["position_mm"]
    dark = np.full_like(image, settings.simulation.dark_level_counts)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        found = lf.find_particles(lf.build_weights(settings), image, dark=dark)
    codes = sorted({str(each.message).rpartition("[")[2].rstrip("]") for each in said})
    grid = settings.grid()
    low, high = np.array([grid.bounds_mm(axis) for axis in range(3)]).T
    sigma = np.sqrt(found.arrays["covariance_mm2"][:, :3])
    figures = particle_figures(found.position_mm, true, low, high, float(grid.spacing_mm[0]), sigma)
    measured = {
        key: found.attributes.get(key, np.nan) for key in ("particle_diameter_mm", "particle_diameter_sigma_mm")
    }
    size, error = measured.values()
    counted = found.attributes.get("tracers_per_lens", found.attributes["particles_per_lens"])
    text = "  ".join(f"{key} {value:.4f}" for key, value in figures.items())
    print(
        f"{name}, {crowd:g} per microlens, {size_mm:g} mm: taken {size:.4f} ± {error:.4f} mm, counted {counted:.3g}, "
        f"residual {found.attributes['residual']:.3f}, {text}: {', '.join(codes) or 'no warning'}",
        flush=True,
    )


def experiment(name: str, crowd: float, size_mm: float, lenses: tuple[int, int], seed: int) -> Tree:
    """Return the rig and its tracers, which stand still."""
    camera = {part: dict(values) for part, values in CAMERAS[name].items()}
    lens, sensor = camera["main_lens"], camera["sensor"]
    pitch, m = camera["microlenses"]["pitch_mm"], abs(lens["magnification"])
    sensor["columns"], sensor["rows"] = (round(number * pitch / (1e-3 * sensor["pixel_um"])) for number in lenses)
    lens_mm = pitch / m
    depth_mm = 1.33 * lens_mm * lens["focal_length_mm"] * (1.0 + m) / lens["aperture_mm"] / m
    shape = [lenses[0] - 2 * AT_SIDES, lenses[1] - 2 * AT_SIDES, round(DEPTHS * depth_mm / lens_mm)]
    return {
        "camera": camera,
        "media": {"air": 1.0, "window": 1.49, "fluid": 1.33},
        "window": {"distance_mm": 100.0, "thickness_mm": 5.0},
        "volume": {"shape_xyz": shape, "voxel_mm": lens_mm},
        "correlation": {"dt_s": 0.001},
        "simulation": {
            "flow": {"kind": "uniform", "velocity_m_s": [0.0, 0.0, 0.0]},
            "particles": round(crowd * shape[0] * shape[1]),
            "particle_diameter_mm": size_mm,
            "seed": seed,
        },
    }
