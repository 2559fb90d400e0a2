"""How well particles are known.

Each particle has the covariance of its place. Ellipses of 20 standard errors, seen along the optical axis and from the
side: depth is known some twenty times worse. The fifth of the particles whose depth is known worst is left out.
"""

import matplotlib.pyplot as plt
import numpy as np

import lfpiv_cli as lf
from lfpiv_cli.files.particle_file import matrices

particles = lf.open_particles("particles/a.vtkhdf")
covariance = matrices(particles.arrays["covariance_mm2"])
sure = covariance[:, 2, 2] < np.quantile(covariance[:, 2, 2], 0.8)
turn = np.linspace(0.0, 2.0 * np.pi, 40)
circle = np.stack([np.cos(turn), np.sin(turn)])
figure, axes = plt.subplots(1, 2, figsize=(7.2, 3.2), layout="constrained")
for each, plane in zip(axes, ([0, 1], [0, 2]), strict=True):
    for place, matrix in zip(particles.position_mm[sure], covariance[sure], strict=True):
        root = np.linalg.cholesky(matrix[np.ix_(plane, plane)])
        each.plot(*(place[plane, np.newaxis] + 20.0 * root @ circle), color="tab:blue", linewidth=1.1)
    each.set(xlabel="x (mm)", ylabel=f"{'xyz'[plane[1]]} (mm)", aspect="equal")
figure.savefig("covariance_ellipses.png", dpi=150)
