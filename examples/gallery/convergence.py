"""How statistics converge.

Sixty fields of one flow: the mean that the sample's tracks show, with turbulence and errors of measurement that are new
in each. Means and stresses of more and more pairs scatter less; the last ones' scatter is their standard error.
"""

from dataclasses import replace

import numpy as np

import lfpiv_cli as lf
from lfpiv_cli.synthetic.flows import random_modes

mean, rng = lf.open_vectors("tracks_grid.vtkhdf"), np.random.default_rng(3)
voxels = 1e3 * mean.dt_s / np.asarray(mean.voxel_mm)  # of 1 m/s
fields = []
for number in range(60):
    waves = random_modes(0.015, longest_mm=4.0, seed=number)(mean.grid.centres_mm().reshape(-1, 3))
    moved = mean.displacement_voxel + voxels * waves.reshape(mean.velocity.shape)
    moved += mean.uncertainty_voxel * rng.normal(size=moved.shape)
    fields.append(replace(mean, displacement_voxel=moved))
statistics = lf.statistics(*fields)
print(statistics)
print(statistics.summary()["reynolds_stresses_m2_s2"], "m^2/s^2")
statistics.plot("convergence").savefig("convergence.png", dpi=130)
