"""What a calibration leaves.

Where the lens images were found in the white image, less where the fitted lattice has them. What is left should be
noise: arrows that point the same way in a part of the image speak of a lens that the model does not know.
"""

import matplotlib.pyplot as plt
import numpy as np

import lfpiv_cli as lf

fit = lf.open_calibration("calibration.h5").fit
left_px = fit.centres_px - fit.centres(fit.indices)
figure, (map_, histogram) = plt.subplots(1, 2, figsize=(7.2, 3.0), layout="constrained", width_ratios=(3, 2))
long = {"angles": "xy", "scale_units": "xy", "scale": 1e-3, "width": 0.003}
arrows = map_.quiver(*fit.centres_px.T, *left_px.T, np.hypot(*left_px.T), **long)
map_.set(xlabel="column (px)", ylabel="row (px)", aspect="equal")
map_.invert_yaxis()
figure.colorbar(arrows, ax=map_, label="px, drawn 1000 times as long", shrink=0.8)
for name, values in zip(("columns", "rows"), left_px.T, strict=True):
    histogram.hist(values, 30, histtype="step", label=f"{name}: rms {values.std():.4f} px")
histogram.set(xlabel="residual (px)", ylabel="lens images")
histogram.margins(y=0.3)
histogram.legend(fontsize=7, loc="upper right")
figure.savefig("calibration_residuals.png", dpi=150)
