"""Seeding against error, by a simulation of your own.

A corner of the sensor, tracers at random places: how many are found, and how far off they are, as they become more.
The same few lines tell the right density for your rig before the first experiment.
"""

import warnings

import matplotlib.pyplot as plt
import numpy as np
from scipy.spatial import KDTree

import lfpiv_cli as lf
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic.render import Balls, Readout, render_points

warnings.simplefilter("ignore", lf.LfpivWarning)
rig = lf.load_rig("rig.yaml").overridden("volume", shape_xyz=(10, 10, 30), reference="focal_point")
resolved = rig.resolved()
resolved["camera"]["sensor"] |= {"columns": 300, "rows": 300}
rig = type(rig).from_resolved(resolved)
weights, rng = lf.build_weights(rig), np.random.default_rng(1)
space, half_mm = ObjectSpace(rig.media_model(), None, "paraxial"), np.array([0.7, 0.7, 1.5])
densities, errors_um, recall = (0.1, 0.3, 0.8), [], []
for density in densities:  # tracers for each microlens of 0.1 mm
    places = rng.uniform(-half_mm, half_mm, (round(density * 196.0), 3))
    light = render_points(rig.camera_model(), space, Balls(places, 5e5, 0.05), rng, rays=20_000)
    found = lf.find_particles(weights, Readout(dark_level_counts=0.0).record(light, rng)).position_mm
    # The same tracer, where none other could be: depths count a tenth.
    apart, nearest = KDTree(found * (1.0, 1.0, 0.1)).query(places * (1.0, 1.0, 0.1))
    errors_um.append(1e3 * 1.483 * np.median(np.abs(found[nearest] - places)[apart < 0.05], axis=0))
    recall.append(np.mean(apart < 0.05))
figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.9), layout="constrained")
left.plot(densities, recall, "o-")
left.set(xlabel="tracers for each microlens", ylabel="share that is found", ylim=(0.0, 1.05))
for name, values in zip("xyz", np.transpose(errors_um), strict=True):
    right.plot(densities, values, "o-", label=name)
right.set(xlabel="tracers for each microlens", ylabel="error (µm)", yscale="log")
right.legend()
figure.savefig("seeding_and_error.png", dpi=150)
