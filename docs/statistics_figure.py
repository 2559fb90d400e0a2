"""The figure of statistics in a turbulent channel: what sixty pairs of tracks tell, and what is true."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.particle_file import Points, symmetric
from lfpiv_cli.flow.statistics import PAIRS
from lfpiv_cli.grid import FOCAL_POINT
from lfpiv_cli.pictures.points import profile_figure
from lfpiv_cli.synthetic.flows import random_modes
from lfpiv_cli.verbs.moments import of_tracks

COUNT, TRACKS, SIDES_MM = 60, 200, (3.0, 2.2, 0.4)
HALF_MM, SIGMA_MM = np.array([1.45, 1.05, 1.95]), np.array([0.003, 0.003, 0.02])
RMS_M_S, CENTRE_M_S, WALL_MM, SLOPE = 0.015, 0.12, 2.0, 0.6


def mixed(fluctuation: NDArray[np.float64], z_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return fluctuations that die at the walls and carry momentum towards them."""
    found = fluctuation * (1.0 - (z_mm / WALL_MM) ** 2)[..., np.newaxis]
    found[..., 2] -= SLOPE * found[..., 0] * z_mm / WALL_MM
    return found


def truth(z_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return mean velocity and stresses at depths: means of products of what isotropic waves are mixed into."""
    columns = [mixed(np.tile(np.eye(3)[k], (len(z_mm), 1)), z_mm) for k in range(3)]
    stress = RMS_M_S**2 * sum(np.einsum("zi,zj->zij", each, each) for each in columns)
    mean = np.stack([CENTRE_M_S * (1.0 - (z_mm / WALL_MM) ** 2), 0.0 * z_mm, 0.0 * z_mm], axis=1)
    return mean, np.stack([stress[:, i, j] for i, j in PAIRS], axis=1)


def write_figure(config: Path, target: Path) -> None:
    """Write the figure."""
    rig, rng = load_rig(config), np.random.default_rng(4)
    dt_s, pairs = float(rig.correlation.dt_s or 1e-3), []
    for number in range(COUNT):
        places = rng.uniform(-HALF_MM, HALF_MM, (TRACKS, 3))
        waves = random_modes(RMS_M_S, longest_mm=4.0, seed=number)(places)
        velocity = truth(places[:, 2])[0] + mixed(waves, places[:, 2])
        moved = 1e3 * dt_s * velocity + SIGMA_MM * rng.standard_normal(places.shape)
        arrays = {
            "displacement_mm": moved,
            "displacement_covariance_mm2": symmetric(np.tile(np.diag(SIGMA_MM**2), (TRACKS, 1, 1))),
            "link_probability": np.ones(TRACKS),
        }
        attributes = FOCAL_POINT.attributes() | {"dt_s": dt_s}
        pairs.append(Points(places, arrays, FOCAL_POINT, attributes, {"config": rig.resolved()}))
    found = of_tracks(pairs, SIDES_MM, 20, "z")
    table = {name: array for name, (array, _) in found.tables()["profile"].items()}
    figure = profile_figure("z", ("u", "v", "w"), table)
    z_mm = np.linspace(-HALF_MM[2], HALF_MM[2], 60)
    mean, stress = truth(z_mm)
    for panel, values in zip(figure.axes, (mean, 1e6 * stress[:, :3], 1e6 * stress[:, 3:]), strict=True):
        panel.plot(z_mm, values, color="black", linewidth=0.9)
    figure.savefig(target, dpi=110)
