"""Particles behind faces that no axis of the array follows: found in the columns on demand, fitted with exact rays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import KDTree

from lfpiv_cli.cli.main import cli
from lfpiv_cli.files.particle_file import open_particles
from lfpiv_cli.files.particles import read_particles

RIG = """\
camera:
  main_lens:   {{magnification: -1.0, focal_length_mm: 100.0, aperture_mm: 25.0}}
  microlenses: {{focal_length_mm: 0.8, pitch_mm: 0.1, columns: 252, rows: 252, layout: square}}
  sensor:      {{pixel_um: 5.5, columns: 460, rows: 420, microlens_distance_mm: 0.8}}
media: {{air: 1.0, window: 1.52, fluid: 1.33}}
scene:
  - {{{outer}, behind: window}}
  - {{{inner}, behind: fluid}}
volume: {{shape_xyz: [14, 12, 30], voxel_mm: 0.1, centre_mm: [{centre}]}}
reconstruction: {{solver: particles, particle_diameter_mm: 0.05}}
correlation:    {{windows: [8], overlap: 0.5, dt_s: 0.001}}
simulation:
  flow: {{kind: uniform, velocity_m_s: [0.06, -0.04, 0.09]}}
  particles: 24
  particle_diameter_mm: 0.05
  seed: {seed}
"""
TILTED = "kind: tilted_plane, normal: [0.3, 0.12, 1], point_mm: [0, 0, {z}]"
BOWL = "kind: sphere, centre_mm: [2, -1, 8], radius_mm: {radius}"
SCENES = {
    # Oblique water moves what is in view to the side.
    "tilted": (TILTED.format(z=-8), TILTED.format(z=-5), "1.0, 0.4, 2.7"),
    "bowl": (BOWL.format(radius=15), BOWL.format(radius=13), "0, 0, 2.7"),
}
# Of one particle in x, y and z, several of their errors.
NEAR_MM = np.array([0.03, 0.03, 0.15])


def run(*words: object) -> None:
    cli.main([str(word) for word in words], standalone_mode=False)


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_tracers_are_found_where_they_are(tmp_path: Path, scene: str) -> None:
    outer, inner, centre = SCENES[scene]
    rig = tmp_path / "rig.yaml"
    rig.write_text(RIG.format(outer=outer, inner=inner, centre=centre, seed=8140))
    run("simulate", "particles", rig, "-o", tmp_path / "sim")
    run("simulate", "white", rig, "-o", tmp_path / "white")
    run("build-weights", rig, "-o", tmp_path / "weights.h5")
    images, dark = (tmp_path / "sim" / f"pair_{k}.tif" for k in "ab"), tmp_path / "white" / "dark.tif"
    run("reconstruct", tmp_path / "weights.h5", *images, "--dark", dark, "-o", tmp_path / "parts")
    truth = read_particles(tmp_path / "sim" / "particles.npz").frame_positions_mm
    middle, inside = np.array([float(each) for each in centre.split(",")]), np.array([0.7, 0.6, 1.5])
    there, found = [], []
    for k, name in enumerate(("pair_a", "pair_b")):
        here = truth[k][np.all(np.abs(truth[k] - middle) < inside, axis=1)]
        points = open_particles(tmp_path / "parts" / f"{name}.vtkhdf").position_mm
        points_here = points[np.all(np.abs(points - middle) < inside, axis=1)]
        there.append(KDTree(points / NEAR_MM).query(here / NEAR_MM)[0] < 1.0)
        found.append(KDTree(truth[k] / NEAR_MM).query(points_here / NEAR_MM)[0] < 1.0)
    # All of it lies on one side of the focus, where light tells depth; an edge of the volume may still cut some off.
    assert np.concatenate(there).mean() >= 0.95
    assert np.concatenate(found).mean() >= 0.95
