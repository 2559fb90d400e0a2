"""The camera: its numbers (Table 2), weights (Table 1, Figs. 5 and 6) and focus (Eq. 21), and what depth it tells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.arrays import Floats
from lfpiv_cli.console import Console
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.pages import Table
from lfpiv_cli.grid import Grid
from lfpiv_cli.notice import written
from lfpiv_cli.optics.camera import Camera
from lfpiv_cli.optics.media import Media
from lfpiv_cli.paper.parts import BOARD, MISALIGNED, Drawing, Findings, Row, Work, sections
from lfpiv_cli.particles.view import raw_view
from lfpiv_cli.pictures.style import BLUE, GREEN, ORANGE, VERMILION, Figure, new_panels, styled
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.synthetic.render import Readout
from lfpiv_cli.validation import weights
from lfpiv_cli.validation.board import elongation_mm
from lfpiv_cli.validation.planning import cramer_rao_bound, errors_alone_mm, expected_image, pixel_variance, slopes
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.verbs.simulate import simulate_board, simulate_white
from lfpiv_cli.weights.build import default_padding, factorise
from lfpiv_cli.weights.quadrature import PAPERS_COUNT

SEED = 5
# Fig. 6: similarity is "approximately 1", and the difference smaller than 2.5 grey levels.
PAPERS_SSIM, PAPERS_RMSE_GREY = 0.99, 2.5
CHANCE = "the count differs from the integral that it estimates by chance; the integrals are alike to rounding"
# Rays traced through the layers by Snell's law and from equivalent points by Snell's law are the same integral.
LIMIT_EXACT = 1e-6
COMPARED = {
    "ert_to_drt_paraxial": "equivalent points against direct tracing, paraxial, integrals",
    "ert_exact_to_drt_exact": "equivalent points against direct tracing, Snell's law, integrals",
    "ert_to_drt_exact": "paraxial equivalent points against direct tracing by Snell's law",
    "ray_count_to_converged": "the paper's count of rays against the integral",
    "factorised_to_converged": "the weights in use (factors by axis) against the integral",
    "factorised_exact_to_converged": "the same by Snell's law",
    "factorised_to_long_count": "the weights in use against a count of 1e8 rays",
}


def table1(work: Work) -> Findings:
    """Compare the columns of the paper's voxels, and of random ones, made in different ways."""
    config = work.config("table1", sections(validation={"weights": {"seed": SEED, "long_count_rays": 100_000_000}}))
    settings = load_rig(config)
    camera, grid, rng = settings.camera_model(), settings.grid(), np.random.default_rng(SEED)
    space = replace(settings.plane_space("comparing ways to make weights"), window=settings.window_model())
    paper = np.array(weights.TABLE1_MM)[: work.by_size(1, 5, 5)]
    centres = np.concatenate([paper, weights.sample_voxels(grid, work.by_size(0, 3, 20), rng)])
    long_count = np.zeros(len(centres), np.int64)
    long_count[: len(paper)] = work.by_size(0, 0, 100_000_000)
    with work.console.progress(len(centres), "weights") as advance:
        columns = weights.make_columns(camera, space, grid, centres, rng, long_count, advance)
    figures = weights.weights_figures(columns, long_count)
    return Findings(
        rows=_rows(figures, len(paper)),
        drawings=(
            Drawing(
                "columns",
                "The weights of the paper's voxels as the sensor would see them (after Fig. 5): traced directly by "
                "Snell's law, integrated over equivalent points, as they are in use, and counted as the paper did. A "
                "row a voxel, one grey scale in each.",
                weights.columns_figure(columns[: len(paper)]),
            ),
            Drawing(
                "similarity",
                "SSIM, RMSE and absolute difference by voxel (after Fig. 6).",
                weights.similarity_figure(figures, len(paper)),
            ),
        ),
        tables=(_table(figures),),
        text=(
            f"{len(paper)} voxels of the paper and {len(centres) - len(paper)} random ones of its volume. As the paper "
            f"did it: {PAPERS_COUNT.points} random points of a voxel and {PAPERS_COUNT.rays_per_point} rays from each, "
            "from their equivalent points, against rays traced through water, window and air (Eq. 14), as many as it "
            "takes. At its best: the integrals that such counts estimate. The weights in use factorise along the two "
            "axes of the image; how far they are from the integral is compared with how far the paper's own count is "
            "from it by chance.",
        ),
        commands=("lfpiv validate weights work/table1/table1.yaml -o weights-report",),
        seeds=(SEED,),
    )


def _rows(figures: dict[str, Any], paper: int) -> tuple[Row, ...]:
    # equivalent points and direct tracing give the same integral, which the count is held against
    counted = [voxel["ray_count_to_converged"] for voxel in figures["voxels"][:paper]]
    same, exact = figures["ert_to_drt_paraxial"], figures["ert_exact_to_drt_exact"]
    chance, used = figures["ray_count_to_converged"]["l1_mean"], figures["factorised_to_converged"]["l1_mean"]
    return (
        Row(
            "similarity (SSIM) of ERT and DRT weights, smallest",
            "Fig. 6",
            PAPERS_SSIM,
            sense="at least",
            paper_ert=1.0,
            ert=min(each["ssim"] for each in counted),
            best=same["ssim_smallest"],
            reason=CHANCE,
        ),
        Row(
            "difference of ERT and DRT weights, largest RMSE (grey levels of 255)",
            "Fig. 6",
            PAPERS_RMSE_GREY,
            paper_ert=PAPERS_RMSE_GREY,
            ert=max(each["rmse_grey"] for each in counted),
            best=same["rmse_grey_largest"],
        ),
        Row(
            "ERT against DRT by Snell's law, largest share of a voxel's light",
            "Section 3.2",
            LIMIT_EXACT,
            ert=figures["ert_to_drt_exact"]["l1_largest"],
            best=exact["l1_largest"],
        ),
        Row("weights in use against the integral, mean share of light", "Eq. 13", chance, ert=chance, best=used),
    )


def _table(figures: dict[str, Any]) -> Table:
    rows = [
        (
            words,
            f"{each['ssim_smallest']:.5f}",
            written(each["rmse_grey_largest"]),
            written(each["l1_mean"], 2),
            written(each["l1_largest"], 2),
        )
        for name, words in COMPARED.items()
        if (each := figures[name]) is not None
    ]
    return Table(
        "Columns of the weights, all voxels",
        ("compared", "SSIM, smallest", "RMSE (grey levels), largest", "share of light, mean", "largest"),
        tuple(rows),
    )


# Derived quantities as Table 2 and Section 3.1 have them: the paper's value, and what it is called.
PAPER = {
    "f-number of the main lens": 4.0,
    "f-number of the microlenses": 8.0,
    "main lens to microlenses (mm)": 200.0,
    "aperture of the main lens (mm)": 25.0,
    "microlens pitch (mm)": 0.1,
    "pixel pitch (µm)": 5.5,
}
# The numbers are exact; only rounding in doubles is let through.
LARGEST_DEVIATION = 1e-9


def table2(work: Work) -> Findings:
    """Return the camera's derived quantities beside the paper's."""
    settings = load_rig(work.config("table2", sections()))
    camera, scale = settings.camera_model(), settings.camera_model().scale(settings.media_model())
    pitch = float(camera.lattice.pitch.mean())
    f_numbers = camera.focal_length_mm / camera.aperture_mm, camera.microlens_focal_length_mm / pitch
    lengths = camera.image_distance_mm, camera.aperture_mm, pitch, 1e3 * camera.pixel_mm
    ours = dict(zip(PAPER, (*f_numbers, *lengths), strict=True))
    deviation = max(abs(ours[name] / value - 1.0) for name, value in PAPER.items())
    lenses = (f"{n * camera.pixel_mm / pitch / camera.micro_image_scale:.0f}" for n in (camera.columns, camera.rows))
    derived = {
        "width of a lens image (pixels)": f"{pitch * camera.micro_image_scale / camera.pixel_mm:.3f}",
        "lens images on the sensor": f"{' x '.join(lenses)} (the array has 252 x 252)",
        "microlens in the scene (mm)": f"{scale.lens_mm:.3f}",
        "depth over which a point spreads by one microlens (mm)": f"{scale.depth_mm:.3f}",
    }
    rows = [(name, f"{value:g}", f"{ours[name]:g}") for name, value in PAPER.items()]
    return Findings(
        rows=(Row("largest relative deviation from Table 2", "Table 2", LARGEST_DEVIATION, best=deviation),),
        tables=(
            Table(
                "Optical parameters",
                ("quantity", "paper", "ours"),
                (*rows, *((name, "–", value) for name, value in derived.items())),
            ),
        ),
        text=(
            "All parts work with this camera. At a magnification of -1 the main lens stands twice its focal length "
            f"from the array and works at f/{camera.image_distance_mm / camera.aperture_mm:g}, as the microlenses do: "
            f"lens images are {camera.lens_image_width:.2f} pitches wide and just touch.",
        ),
        commands=("lfpiv build-weights work/table2/table2.yaml -o weights.h5",),
    )


@styled
def focal_plane_figure(focal_error_mm: NDArray, off_mm: NDArray, sigma_mm: NDArray) -> Figure:
    """Where one snapshot puts the mid plane of the channel, less where it is, over how far the camera was focused away
    from the board (Eq. 21). Bars: the stated standard error.

    Arrays (n,), mm.
    """
    figure, axes = new_panels(6.5, 3.6)
    axes.errorbar(focal_error_mm, 1e3 * off_mm, 1e3 * sigma_mm, fmt="o", color=BLUE, capsize=3)
    axes.axhline(0.0, color="0.6", linewidth=0.8)
    axes.set(xlabel="board behind the focal plane (mm)", ylabel="mid plane, measured - true (µm)")
    return figure


SEED_OF_FOCUS = 21
# How far the camera may be focused in front of the wall or behind it, mm.
LARGEST_MM = 2.0
# Half a voxel of the paper's: a volume that lies further off than that is another volume.
LIMIT_MM = 0.05
# Stated errors are those of Gaussian noise; of some ten boards none is expected beyond so many of them.
LIMIT_SIGMAS = 4.0
DEPTHS_HEAD = ("board behind the focal plane", "true", "measured", "stated standard error")
SMALL = {
    "camera": {"microlenses": {"columns": None, "rows": None}, "sensor": {"columns": 600, "rows": 448}},
    "board": {"dots": [5, 4], "spacing_mm": 0.5, "dot_diameter_mm": 0.15},
}


def focal_plane(work: Work) -> Findings:
    """Photograph a board before and behind the focal plane and measure where the channel's mid plane comes to lie."""
    errors_mm = np.linspace(-LARGEST_MM, LARGEST_MM, work.by_size(2, 5, 9))
    whites = work.folder / "white"
    base = _config(work, "white", 0.0)
    simulate_white(base, whites, overwrite=True, console=work.console)
    found = [work.step(f"board_{error:+g}mm", partial(_mid_plane, work, whites, float(error))) for error in errors_mm]
    measured, sigma, true = (np.array([each[name] for each in found]) for name in ("mid_mm", "sigma_mm", "true_mm"))
    each = zip(errors_mm, true, measured, sigma, strict=True)
    rows = tuple((f"{a:+z.2f}", f"{b:+z.3f}", f"{c:+z.3f}", f"{d:.4f}") for a, b, c, d in each)
    off, corner = measured - true, "A corner of the sensor, 20 dots half a millimetre apart."
    return Findings(
        rows=(
            Row("place of the mid plane, largest error (mm)", "Eq. 21", LIMIT_MM, best=float(np.abs(off).max())),
            Row("the same, in stated standard errors", "Eq. 21", LIMIT_SIGMAS, best=float(np.abs(off / sigma).max())),
        ),
        drawings=(Drawing.of("mid_plane", focal_plane_figure, errors_mm, off, sigma),),
        tables=(Table("Mid plane from the focal plane (mm)", DEPTHS_HEAD, rows),),
        text=(
            "The board lies on the outer wall of the channel and the camera is meant to be focused on it. Here it is "
            f"focused up to {LARGEST_MM:g} mm before and behind it; the snapshot alone tells by how much, and Eq. 21 "
            "where the mid plane of the channel comes to lie once the board is taken away and the camera moved. The "
            "array is turned and shifted, the board tilted, and light and sensor have their noise. The paper gives no "
            f"figure; the limit is half of its voxels. {work.by_size(corner, corner, 'Full sensor, 49 dots.')}",
        ),
        commands=(
            "lfpiv simulate white work/focal-plane/white.yaml -o work/focal-plane/white --overwrite",
            "lfpiv simulate board work/focal-plane/board_+2mm.yaml -o work/focal-plane/board_+2mm --overwrite",
            "lfpiv calibrate-snapshot work/focal-plane/board_+2mm.yaml --white work/focal-plane/white/white.tif "
            "--dark work/focal-plane/white/dark.tif --board work/focal-plane/board_+2mm/board.tif "
            "-o work/focal-plane/board_+2mm/calibration.h5 --overwrite",
        ),
        seeds=(SEED_OF_FOCUS,),
    )


def _config(work: Work, name: str, error_mm: float) -> Path:
    small = work.by_size(SMALL, SMALL, {})
    return work.config(
        name,
        sections(
            camera=small.get("camera", {}),
            board=BOARD | {"medium": "air"} | small.get("board", {}),
            channel={"width_mm": 10.0, "wall_mm": 5.0},
            window=None,
            simulation=MISALIGNED | {"seed": SEED_OF_FOCUS, "board_z_mm": float(error_mm)},
        ),
    )


def _mid_plane(work: Work, whites: Path, error_mm: float) -> dict[str, float]:
    """Return where a snapshot puts the mid plane, and where it is, mm from the focal plane."""
    name = f"board_{error_mm:+g}mm"
    config, folder = _config(work, name, error_mm), work.folder / name
    quiet = Console(only_warnings=True)
    simulate_board(config, folder, overwrite=True, console=quiet)
    pictures = CalibrateOptions(white=[whites / "white.tif"], dark=whites / "dark.tif", board=[folder / "board.tif"])
    reported = calibrate_snapshot(config, folder / "calibration.h5", pictures, overwrite=True, console=quiet)
    # after the move of Eq. 21 the focal plane is as far off the mid plane as it was off the board, times n_w
    return {
        "mid_mm": reported["mid_plane_z_mm"],
        "sigma_mm": reported["mid_plane_z_mm_sigma"],
        "true_mm": error_mm * sections()["media"]["fluid"],
    }


# The paper's discussion in figures: how well depth can be told, and how many tracers there may be.
#
# Axes: z away from the camera from the nominal focal point, mm in the fluid.


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


def smallest_errors_crowded_mm(
    camera: Camera, media: Media, per_lens: float, deepest_mm: float, rng: np.random.Generator
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
        bound = cramer_rao_bound(slope, pixel_variance(expected_image(slope, particles), Readout()))
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


SEED_OF_DISCUSSION = 11
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
    rows = []
    for depth, length in zip(reported["elongation_depth_mm"], reported["elongation_mm"], strict=True):
        x, _, z = (float(np.interp(depth, reported["depth_mm"], each)) for each in sigma.T)
        rows.append((f"{depth:+.0f}", f"{length:.2f}", f"{1e3 * x:.2f}", f"{1e3 * z:.1f}"))
    return Findings(
        drawings=(
            Drawing.of("depth", depth_resolution_figure, reported, geometric, float(camera.scale(media).lens_mm)),
            Drawing.of("seeding", seeding_bound_figure, crowd, PAPERS_PPP / per_pixel),
        ),
        tables=(
            Table(
                "By depth behind the focal plane",
                ("depth (mm)", "length by SART (mm)", "smallest error across (µm)", "smallest error in depth (µm)"),
                tuple(rows),
            ),
        ),
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
        seeds=(SEED_OF_DISCUSSION,),
    )


def _by_depth(work: Work, camera: Camera, media: Media) -> dict[str, Any]:
    depths = np.linspace(-DEEPEST_MM, DEEPEST_MM, work.by_size(3, 17, 33)).tolist()
    coarse = np.linspace(-DEEPEST_MM, DEEPEST_MM, work.by_size(1, 5, 9)).tolist()
    particles = np.array([[*BESIDE_MM, depth, LIGHT_COUNTS] for depth in depths])
    sigma = errors_alone_mm(raw_view(camera, media, RADIUS_MM), particles, Readout())
    iterations = work.by_size(2, 30, 200)
    return {
        "depth_mm": depths,
        "sigma_mm": sigma.tolist(),
        "iterations": iterations,
        "elongation_depth_mm": coarse,
        "elongation_mm": elongations_mm(camera, media, coarse, SolverSettings("sart", iterations)).tolist(),
    }


def _by_seeding(work: Work, camera: Camera, media: Media) -> dict[str, Any]:
    seedings = work.by_size((0.1, 0.7), (0.05, 0.2, 0.67), (0.05, 0.1, 0.2, 0.4, 0.67, 1.0, 1.3))
    crowded = replace(camera, columns=CROWD_SIDE_PX, rows=CROWD_SIDE_PX)
    rng = np.random.default_rng(SEED_OF_DISCUSSION)
    sigma = [smallest_errors_crowded_mm(crowded, media, each, SLAB_MM, rng).tolist() for each in seedings]
    return {"per_lens": list(seedings), "sigma_mm": sigma}
