"""A liquid's divergence, and the pressure.

Noisy tracks through Taylor-Green vortices, their depth known fifteen times worse than the rest. That a liquid has no
divergence makes the depth component better; the pressure of the steady flow follows from the same field of splines.
"""

import matplotlib.pyplot as plt
import numpy as np

import lfpiv_cli as lf
from lfpiv_cli.fields.fit import fit_field
from lfpiv_cli.fields.structure import Samples
from lfpiv_cli.synthetic.flows import taylor_green
from lfpiv_cli.verbs.field import pressure_of_steady_flow

dt_s, rng, sigma_mm, half_mm = 1e-3, np.random.default_rng(7), np.array([0.004, 0.004, 0.06]), np.array([3.0] * 3)
flow = taylor_green(0.1, 6.0)  # m/s: in a millisecond as many 1e-3 m, that is mm
rig = lf.load_rig("rig.yaml").overridden("media", fluid_density_kg_m3=998.2, fluid_viscosity_pa_s=1e-3)
rig = rig.overridden("volume", shape_xyz=(60, 60, 60)).overridden("correlation", windows=((10, 10, 10),), dt_s=dt_s)
points = rng.uniform(-half_mm, half_mm, (700, 3))
moved = 1e3 * dt_s * flow(points) + sigma_mm * rng.normal(size=points.shape)
samples = Samples(points, moved, np.tile(np.diag(sigma_mm**2), (700, 1, 1)), np.ones(700))
fits = {kind: fit_field(samples, -half_mm, half_mm, kind) for kind in ("off", "penalised")}
pressed = pressure_of_steady_flow(fits["penalised"], dt_s, rig)
centres, middle = pressed.grid.centres_mm(), pressed.grid.shape_xyz[1] // 2
plane = centres[:, middle].reshape(-1, 3)
true = flow.pressure(centres.reshape(-1, 3), 998.2).reshape(pressed.pressure_pa.shape)
drawn = {"w (mm/s): truth": 1e3 * flow(plane)[:, 2]}
drawn |= {f"divergence {kind}": fit.value_at(plane)[:, 2] / dt_s for kind, fit in fits.items()}
drawn |= {"pressure (Pa): truth": (true - true.mean())[:, middle], "found": pressed.pressure_pa[:, middle]}
figure, axes = plt.subplots(1, 5, figsize=(10.0, 2.6), layout="constrained", sharey=True)
for number, (each, (name, values)) in enumerate(zip(axes, drawn.items(), strict=True)):
    limit, picture = (120.0, 4.0)[number > 2], values.reshape(pressed.grid.shape_zyx[0], -1)
    mesh = each.pcolormesh(*(pressed.grid.axis_mm(k) for k in (0, 2)), picture, cmap="RdBu_r", vmin=-limit, vmax=limit)
    off = np.std(picture - list(drawn.values())[3 * (number > 2)].reshape(picture.shape))
    each.set_title(name + (f"\noff by {off:.2g} (rms)" if off else "\n"), fontsize=9)
    each.set(xlabel="x (mm)", aspect="equal")
    if number in (2, 4):
        figure.colorbar(mesh, ax=each)
axes[0].set_ylabel("z (mm)")
figure.savefig("divergence_and_pressure.png", dpi=150)
