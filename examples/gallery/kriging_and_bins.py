"""Kriging beside binning.

The depth component along a line through turbulence. Means of tracks in bins level off what is smaller than a bin; the
field that is fitted to the same tracks follows it, and says how well it is known.
"""

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import binned_statistic

from lfpiv_cli.fields.fit import fit_field
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.synthetic.flows import random_modes

rng, sigma_mm = np.random.default_rng(5), np.array([0.01, 0.01, 0.03])
turbulence = random_modes(0.1, longest_mm=8.0, shortest_mm=1.0, seed=4)  # displacements in mm
points = rng.uniform((-4.0, -1.0, -1.0), (4.0, 1.0, 1.0), (700, 3))
moved = turbulence(points) + sigma_mm * rng.normal(size=points.shape)
samples = Samples(points, moved, np.tile(np.diag(sigma_mm**2), (700, 1, 1)), np.ones(700))
x = np.linspace(-4.0, 4.0, 200)
line = np.stack([x, 0.0 * x, 0.0 * x], axis=1)
value, variance = fit_field(samples, points.min(axis=0), points.max(axis=0)).estimate_at(line)
near, edges = np.all(np.abs(points[:, 1:]) < 0.4, axis=1), np.linspace(-4.0, 4.0, 11)
mean = binned_statistic(points[near, 0], moved[near, 2], "mean", edges).statistic
figure, axes = plt.subplots(figsize=(6.4, 3.0), layout="constrained")
axes.plot(x, turbulence(line)[:, 2], color="black", label="truth")
axes.stairs(mean, edges, color="tab:orange", baseline=None, label="means of tracks in bins of 0.8 mm")
low, high = (value[:, 2] + sign * np.sqrt(variance[:, 2]) for sign in (-1.0, 1.0))
axes.fill_between(x, low, high, color="tab:blue", alpha=0.25, linewidth=0.0)
axes.plot(x, value[:, 2], color="tab:blue", label="fitted field, and its standard error")
axes.set(xlabel="x (mm)", ylabel="displacement in depth (mm)")
axes.legend(fontsize=7)
figure.savefig("kriging_and_bins.png", dpi=150)
