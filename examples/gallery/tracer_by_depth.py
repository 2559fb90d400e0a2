"""A tracer's image by its depth.

The light of one tracer of 50 µm under the microlenses, rendered by rays. In the focal plane one lens has all of it;
behind and before, the lens images show which way the rays came, so that the sign of the depth is known, too.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import lfpiv_cli as lf
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.synthetic.render import Balls, render_points

rig = lf.load_rig("rig.yaml")
camera, space = replace(rig.camera_model(), rows=130, columns=130), ObjectSpace(rig.media_model(), None, "paraxial")
figure, axes = plt.subplots(2, 4, figsize=(7.2, 3.9), layout="constrained")
for each, z_mm in zip(axes.ravel(), (-4.0, -2.0, -1.0, -0.4, 0.4, 1.0, 2.0, 4.0), strict=True):
    tracer = Balls([[0.02, -0.03, z_mm]], 1e6, 0.05)
    light = render_points(camera, space, tracer, np.random.default_rng(1), rays=400_000)
    each.imshow(np.sqrt(light))
    each.set(title=f"z = {z_mm:g} mm", xticks=[], yticks=[])
figure.savefig("tracer_by_depth.png", dpi=150)
