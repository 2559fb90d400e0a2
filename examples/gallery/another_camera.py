"""Another camera in a few lines.

What a rig file says is all that there is of a camera. A hexagonal array at half magnification, and what its pixels see
of one voxel in water, beside the sample's.
"""

import matplotlib.pyplot as plt
import numpy as np

import lfpiv_cli as lf

with open("other.yaml", "w") as file:
    file.write("""
camera:
  main_lens:   {magnification: -0.5, focal_length_mm: 60.0, aperture_mm: 12.0}
  microlenses: {pitch_mm: 0.1, focal_length_mm: 0.75, layout: hexagonal}
  sensor:      {pixel_um: 5.5, columns: 400, rows: 400}
media: {air: 1.0, window: 1.49, fluid: 1.33}
volume: {shape_xyz: [5, 5, 9], voxel_mm: 0.2, centre_mm: [0, 0, 3]}
""")
rigs = {"the sample's": lf.open_weights("weights.h5"), "another": lf.build_weights(lf.load_rig("other.yaml"))}
figure, axes = plt.subplots(1, 2, figsize=(6.0, 3.1), layout="constrained")
for each, (name, weights) in zip(axes, rigs.items(), strict=True):
    rows, columns, share = weights.column(*(n // 2 for n in weights.shape))
    image = np.zeros(weights.image_shape)
    image[rows, columns] = share
    middle = slice(rows.min() - 10, rows.max() + 10), slice(columns.min() - 10, columns.max() + 10)
    each.imshow(np.sqrt(image[middle]))
    each.set(title=f"{name}: {rows.size} pixels", xticks=[], yticks=[])
figure.savefig("another_camera.png", dpi=150)
