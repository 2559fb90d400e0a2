"""A velocity profile, measured twice, beside the truth.

The sample is a shear in depth: u = 0.12 m/s + 30/s z. Volumes see particles that are long in depth, which levels the
slope off at the ends; tracks do not. Bars are standard errors of the means over the planes.
"""

import matplotlib.pyplot as plt
import numpy as np

import lfpiv_cli as lf

figure, axes = plt.subplots(figsize=(5.4, 3.4), layout="constrained")
z_mm = np.linspace(-2.0, 2.0, 50)
axes.plot(z_mm, 0.12 + 0.030 * z_mm, color="black", label="truth")
for name, words in (("vectors", "correlation of volumes"), ("tracks_grid", "tracks of particles")):
    field = lf.open_vectors(f"{name}.vtkhdf")
    u, depths_mm = field.velocity[..., 0].reshape(field.flag.shape[0], -1), field.grid.axis_mm(2)
    error = np.nanstd(u, axis=1) / np.sqrt(np.isfinite(u).sum(axis=1))
    axes.errorbar(depths_mm, np.nanmean(u, axis=1), error, fmt="o--", capsize=2, markersize=4, label=words)
axes.set(xlabel="z (mm)", ylabel="u (m/s), mean over the plane")
axes.legend()
figure.savefig("profile.png", dpi=150)
