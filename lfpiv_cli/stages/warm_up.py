"""The stage of `warm-up`: every step once on a small simulated experiment, so that all kernels are compiled."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

from lfpiv_cli.console import CONSOLE, Console
from lfpiv_cli.files.atomic import write_text
from lfpiv_cli.files.config import load_config
from lfpiv_cli.stages.run import RunOptions, run
from lfpiv_cli.stages.simulate import frame_names, simulate_board, simulate_particles, simulate_white

# A corner of the paper's sensor and a thin channel, as small as every step still works on.
RIG = """\
camera:
  main_lens:   {magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}
  microlenses: {focal_length_mm: 0.8, pitch_mm: 0.1, layout: square}
  sensor:      {pixel_um: 5.5, columns: 450, rows: 448, microlens_distance_mm: 0.8, column_axis: x}
media:   {air: 1.0, window: 1.49, fluid: 1.33}
channel: {width_mm: 3.0, wall_mm: 2.0}
board:   {dots: [4, 4], spacing_mm: 0.5, dot_diameter_mm: 0.15, thickness_mm: 0.0}
volume:  {shape_xyz: [20, 20, 28], voxel_mm: 0.1, centre_mm: [0, 0, 0], reference: mid_plane}
reconstruction: {solver: em, iterations: 4}
correlation:    {windows: [16, 10], overlap: 0.5, dt_s: 0.002}
simulation:
  flow: {kind: shear, along: x, across: z, rate_per_s: 30.0, velocity_m_s: [0.12, 0.0, 0.0]}
  particles: 80
  particle_diameter_mm: 0.05
  frames: 4
  board_z_mm: 2.2
  distortion_per_mm2: 2.0e-5
  seed: 3
"""
STEPS = 3


def warm_up(*, console: Console = CONSOLE) -> dict[str, Any]:
    """Compile all kernels into numba's folder, by simulating a small experiment and measuring it each way."""
    quiet = Console(quiet=True)
    with tempfile.TemporaryDirectory() as name, console.progress(STEPS, "warm-up") as advance:
        folder = Path(name)
        config = folder / "rig.yaml"
        write_text(config, RIG, overwrite=False)
        for simulate in (simulate_white, simulate_board, simulate_particles):
            simulate(config, folder, console=quiet)
        advance(1)
        images = [folder / frame for frame in frame_names(load_config(config).simulation.frames)]
        recording = RunOptions(
            images=images[:2],
            white=(folder / "white.tif",),
            dark=folder / "dark.tif",
            board=(folder / "board.tif",),
            report=False,
        )
        run(config, folder / "pair", replace(recording, method="both", combine=True), console=quiet)
        advance(1)
        run(config, folder / "sequence", replace(recording, images=images, follow=True), console=quiet)
        advance(1)
    return {"steps": STEPS}
