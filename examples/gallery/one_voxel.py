"""One voxel's light.

A column of the weights is a voxel's point-spread function: which pixels see it, and what share of its light each gets.
The farther a voxel lies from the focal plane, the more microlenses share its light. Depths are counted from the
channel's mid plane, which lies 2.9 mm behind the focal plane.
"""

import matplotlib.pyplot as plt
import numpy as np

import lfpiv_cli as lf

weights = lf.open_weights("weights.h5")
depths_mm = weights.reference.grid_from_focal_point(weights.weights.grid).axis_mm(2)
figure, axes = plt.subplots(1, 3, figsize=(7.2, 2.7), layout="constrained")
for each, iz in zip(axes, (0, 20, 39), strict=True):
    rows, columns, share = weights.column(iz, 11, 15)
    image = np.zeros(weights.image_shape)
    image[rows, columns] = share
    each.imshow(np.sqrt(image[120:320, 190:390]))
    each.set(title=f"z = {depths_mm[iz]:.1f} mm: {rows.size} pixels", xticks=[], yticks=[])
figure.savefig("one_voxel.png", dpi=150)
