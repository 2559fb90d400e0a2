"""The paper's discussion in figures: how well depth can be told, and how many tracers there may be."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.pages import Table
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.paper.parts import Drawing, Findings, Work
from lfpiv_cli.paper.rig import sections
from lfpiv_cli.reconstruction.solvers import SolverSettings
from lfpiv_cli.synthetic.sensor import Readout
from lfpiv_cli.validation.depth_pictures import depth_resolution_figure, seeding_bound_figure
from lfpiv_cli.validation.depth_resolution import (
    LIGHT_COUNTS,
    elongations_mm,
    geometric_depth_mm,
    smallest_errors_crowded_mm,
    smallest_errors_mm,
)

SEED = 11
PAPERS_PPP = 0.002
# Depths of the paper's boards.
DEEPEST_MM = 8.0
# Half the channel's depth.
SLAB_MM = 5.0
# Pixels along a side of sensors that hold the light of a tracer 8 mm from the focal plane, and of enough of a crowd.
SIDE_PX, CROWD_SIDE_PX = 500, 260


def discussion(work: Work) -> Findings:
    """Compare how long reconstructed tracers are with what the views' geometry and the light allow."""
    config = work.config("camera", sections(camera={"sensor": {"columns": SIDE_PX, "rows": SIDE_PX}}))
    settings = load_config(config)
    camera, media = settings.camera_model(), settings.media_model()
    told = work.step("depth", partial(_by_depth, work, camera, media))
    crowd = work.step("seeding", partial(_by_seeding, work, camera, media))
    geometric = geometric_depth_mm(camera, media)
    per_pixel = (camera.pixel_mm / float(camera.lattice.pitch[0])) ** 2
    sigma = np.array(told["sigma_mm"])
    return Findings(
        drawings=(
            Drawing(
                "depth",
                "What depth can be told to, over depth: the length of a tracer reconstructed by SART, the depth in "
                "which the outermost views move by one microlens, and the Cramer-Rao bound of a tracer's place.",
                depth_resolution_figure(told, geometric, float(camera.scale(media).lens_mm)),
            ),
            Drawing(
                "seeding",
                "The Cramer-Rao bound of a tracer among others that are to be found as well, median, over how many "
                "there are; the line is the paper's seeding.",
                seeding_bound_figure(crowd, PAPERS_PPP / per_pixel),
            ),
        ),
        tables=(_table(told),),
        text=(
            f"The outermost views of the paper's camera move against each other by one microlens in {geometric:.2f} mm "
            f"of depth: that is why a tracer reconstructed by SART ({told['iterations']} iterations) is "
            f"{np.nanmin(told['elongation_mm']):.1f} to {np.nanmax(told['elongation_mm']):.1f} mm long (the "
            "paper's dots, four times as wide: 3.1 to 3.9 mm). Length is not error: the light of one tracer "
            f"({LIGHT_COUNTS:g} counts) tells its depth to "
            f"{1e3 * sigma[:, 2].min():.0f} µm at best and its place across to {1e3 * sigma[:, 0].min():.1f} µm, "
            "without noise of others. Near the focal plane all light lies within one or two microlenses and says least "
            "of depth.",
            f"The paper's {PAPERS_PPP} tracers per pixel are {PAPERS_PPP / per_pixel:.2f} per microlens: tracers are "
            "told apart by microlenses, so that the number per microlens counts, not per pixel. How the errors of "
            "whole measurements grow with it is in the part on what matters.",
        ),
        seeds=(SEED,),
    )


def _by_depth(work: Work, camera: Camera, media: Media) -> dict[str, Any]:
    depths = np.linspace(-DEEPEST_MM, DEEPEST_MM, work.by_size(3, 17, 33)).tolist()
    coarse = np.linspace(-DEEPEST_MM, DEEPEST_MM, work.by_size(1, 5, 9)).tolist()
    iterations = work.by_size(2, 30, 200)
    return {
        "depth_mm": depths,
        "sigma_mm": smallest_errors_mm(camera, media, depths, Readout()).tolist(),
        "iterations": iterations,
        "elongation_depth_mm": coarse,
        "elongation_mm": elongations_mm(camera, media, coarse, SolverSettings("sart", iterations)).tolist(),
    }


def _by_seeding(work: Work, camera: Camera, media: Media) -> dict[str, Any]:
    seedings = work.by_size((0.1, 0.7), (0.05, 0.2, 0.67), (0.05, 0.1, 0.2, 0.4, 0.67, 1.0, 1.3))
    crowded = replace(camera, columns=CROWD_SIDE_PX, rows=CROWD_SIDE_PX)
    rng = np.random.default_rng(SEED)
    sigma = [smallest_errors_crowded_mm(crowded, media, each, SLAB_MM, Readout(), rng).tolist() for each in seedings]
    return {"per_lens": list(seedings), "sigma_mm": sigma}


def _table(told: Mapping[str, Any]) -> Table:
    """Return elongation and bound at the depths that have both."""
    sigma = np.array(told["sigma_mm"])
    rows = []
    for depth, length in zip(told["elongation_depth_mm"], told["elongation_mm"], strict=True):
        x, _, z = (float(np.interp(depth, told["depth_mm"], each)) for each in sigma.T)
        rows.append((f"{depth:+.0f}", f"{length:.2f}", f"{1e3 * x:.2f}", f"{1e3 * z:.1f}"))
    return Table(
        "By depth behind the focal plane",
        ("depth (mm)", "length by SART (mm)", "smallest error across (µm)", "smallest error in depth (µm)"),
        tuple(rows),
    )
