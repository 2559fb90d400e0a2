"""The paper's discussion in figures: how well depth can be told, and how many tracers there may be.

Axes: z away from the camera from the nominal focal point, mm in the fluid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Floats
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.pages import Table
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.paper.parts import Drawing, Findings, Work, sections
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.pictures.style import BLUE, GREEN, ORANGE, VERMILION, Figure, new_panels, styled
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.render import Readout
from lfpiv_cli.validation.board import elongation_mm
from lfpiv_cli.validation.planning import cramer_rao_bound, errors_alone_mm, expected_image, pixel_variance, slopes
from lfpiv_cli.weights.build import default_padding, factorise


@styled
def depth_resolution_figure(reported: Mapping[str, Any], geometric_mm: float, lens_mm: float) -> Figure:
    """What depth can be told to, over depth: the length of a tracer reconstructed by SART, the depth in which the
    outermost views move by one microlens, and the Cramer-Rao bound of a tracer's place.

    Parameters
    ----------
    reported : `elongation_mm` (m,) at `elongation_depth_mm`, and the bound `sigma_mm` (n, 3) of x, y, z at `depth_mm`
    geometric_mm, lens_mm : depth in which views move by one microlens, and its width in the scene
    """
    figure, axes = new_panels(7.5, 4.6)
    sigma = np.array(reported["sigma_mm"])
    axes.semilogy(
        reported["elongation_depth_mm"], reported["elongation_mm"], "s-", color=VERMILION, label="length by SART"
    )
    axes.axhline(geometric_mm, color=ORANGE, linestyle="--", label="depth that moves views by a microlens")
    axes.axhline(lens_mm, color="0.4", linestyle=":", label="microlens in the scene")
    axes.semilogy(reported["depth_mm"], sigma[:, 2], "-", color=BLUE, label="smallest error in depth")
    axes.semilogy(reported["depth_mm"], sigma[:, 0], "-.", color=GREEN, label="smallest error across")
    axes.set(xlabel="depth behind the focal plane (mm)", ylabel="mm")
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.14))
    return figure


@styled
def seeding_bound_figure(reported: Mapping[str, Any], papers_per_lens: float) -> Figure:
    """The Cramer-Rao bound of a tracer among others that are to be found as well, median, over how many there are; the
    line is the paper's seeding.

    `sigma_mm` is (n, 3), `per_lens` (n,).
    """
    figure, axes = new_panels(6.5, 3.8)
    sigma = 1e3 * np.array(reported["sigma_mm"])
    axes.loglog(reported["per_lens"], sigma[:, 2], "o-", color=BLUE, label="depth")
    axes.loglog(reported["per_lens"], sigma[:, 0], "^-.", color=GREEN, label="across")
    axes.axvline(papers_per_lens, color="0.4", linestyle="--", label="the paper's seeding")
    axes.set(xlabel="tracers per microlens", ylabel="smallest standard error (µm)")
    axes.set_xticks(reported["per_lens"], labels=[f"{each:g}" for each in reported["per_lens"]])
    axes.minorticks_off()
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    return figure


# Counts of a whole tracer, as `simulate particles` has them.
LIGHT_COUNTS = 500_000.0
RADIUS_MM = 0.025
# A tracer beside the middle of a lens, as most are.
BESIDE_MM = (0.023, -0.017)
VOXEL_MM = 0.1
# Room for a reconstructed point before and behind it, mm: half of the paper's longest dots and as much again.
ROOM_MM = 4.0
POINT_VOXELS = 5
# A median of so many is right to a sixth of their spread.
FEWEST_TRACERS = 40


def geometric_depth_mm(camera: Camera, media: Media) -> float:
    """Return the depth over which the views from opposite ends of the aperture move by one microlens, mm."""
    scale = camera.scale(media)
    return float(scale.lens_mm * camera.focus_distance_mm / (2.0 * camera.aperture_radius_mm) / media.depth_ratio)


def smallest_errors_mm(camera: Camera, media: Media, depths_mm: Sequence[float], readout: Readout) -> Floats:
    """Return the Cramer-Rao bound (n, 3) of x, y and z of a tracer alone, by its depth."""
    particles = np.array([[*BESIDE_MM, depth, LIGHT_COUNTS] for depth in depths_mm])
    return errors_alone_mm(raw_view(camera, media, RADIUS_MM), particles, readout)


def smallest_errors_crowded_mm(
    camera: Camera, media: Media, per_lens: float, deepest_mm: float, readout: Readout, rng: np.random.Generator
) -> Floats:
    """Return the median bound (3,) of x, y and z of a tracer among others that are to be found as well.

    Parameters
    ----------
    per_lens : tracers per microlens, in a slab up to `deepest_mm` before and behind the focal plane
    """
    view = raw_view(camera, media, RADIUS_MM)
    scale = camera.scale(media)
    side = np.array([camera.columns, camera.rows]) * camera.pixel_mm * scale.lens_mm / float(camera.lattice.pitch[0])
    count = max(round(per_lens * float(np.prod(side)) / scale.lens_mm**2), 1)
    errors: list[Floats] = []
    while len(errors) < FEWEST_TRACERS:
        places = rng.uniform([*(-0.5 * side), -deepest_mm], [*(0.5 * side), deepest_mm], (count, 3))
        particles = np.column_stack([places, np.full(count, LIGHT_COUNTS)])
        slope = slopes(view, particles)
        bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, particles), readout))
        # whose light lies on the sensor
        inner = np.all(np.abs(places[:, :2]) < 0.25 * side, axis=1)
        errors.extend(bound.sigma_mm(joint=True)[inner])
    return np.asarray(np.median(errors, axis=0))


def elongations_mm(camera: Camera, media: Media, depths_mm: Sequence[float], settings: SolverSettings) -> Floats:
    """Return how long a reconstructed tracer is in depth (n,), each alone in an image without noise."""
    view = raw_view(camera, media, RADIUS_MM)
    found = []
    for depth in depths_mm:
        particle = np.array([[*BESIDE_MM, depth, LIGHT_COUNTS]])
        image = expected_image(slopes(view, particle), particle).reshape(camera.rows, camera.columns)
        cells = round(2.0 * ROOM_MM / VOXEL_MM)
        grid = Grid.centred((POINT_VOXELS, POINT_VOXELS, cells), (VOXEL_MM,) * 3, (0.0, 0.0, float(depth)))
        padding = default_padding(camera, media, grid)
        padded = grid.padded(padding)
        volume = reconstruct(factorise(camera, media, padded), image.astype(np.float32), settings).volume
        found.append(elongation_mm(padded.axis_mm(2), volume.max(axis=(1, 2)).astype(np.float64)))
    return np.array(found)


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
    settings = load_rig(config)
    camera, media = settings.camera_model(), settings.media_model()
    reported = work.step("depth", partial(_by_depth, work, camera, media))
    crowd = work.step("seeding", partial(_by_seeding, work, camera, media))
    geometric = geometric_depth_mm(camera, media)
    per_pixel = (camera.pixel_mm / float(camera.lattice.pitch[0])) ** 2
    sigma = np.array(reported["sigma_mm"])
    return Findings(
        drawings=(
            Drawing.of("depth", depth_resolution_figure, reported, geometric, float(camera.scale(media).lens_mm)),
            Drawing.of("seeding", seeding_bound_figure, crowd, PAPERS_PPP / per_pixel),
        ),
        tables=(_table(reported),),
        text=(
            f"The outermost views of the paper's camera move against each other by one microlens in {geometric:.2f} mm "
            f"of depth: that is why a tracer reconstructed by SART ({reported['iterations']} iterations) is "
            f"{np.nanmin(reported['elongation_mm']):.1f} to {np.nanmax(reported['elongation_mm']):.1f} mm long (the "
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


def _table(reported: Mapping[str, Any]) -> Table:
    """Return elongation and bound at the depths that have both."""
    sigma = np.array(reported["sigma_mm"])
    rows = []
    for depth, length in zip(reported["elongation_depth_mm"], reported["elongation_mm"], strict=True):
        x, _, z = (float(np.interp(depth, reported["depth_mm"], each)) for each in sigma.T)
        rows.append((f"{depth:+.0f}", f"{length:.2f}", f"{1e3 * x:.2f}", f"{1e3 * z:.1f}"))
    return Table(
        "By depth behind the focal plane",
        ("depth (mm)", "length by SART (mm)", "smallest error across (µm)", "smallest error in depth (µm)"),
        tuple(rows),
    )
