"""Bubbles on the channel's wall (Fig. 17): what they do to the velocities beside them, and what a mask makes good."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lfpiv_cli.arrays import Flags
from lfpiv_cli.console import Console
from lfpiv_cli.files.config import load_rig
from lfpiv_cli.files.images import read_image, write_tiff
from lfpiv_cli.files.pages import Table
from lfpiv_cli.paper.parts import AS_PAPER, Drawing, Findings, Row, Work
from lfpiv_cli.paper.pictures import PAPERS_WALL, plane_figure, raw_figure, wall_profile_figure
from lfpiv_cli.paper.table4 import SEED, TINY, ChannelSize, at_best, channel_sections, simulated_duct
from lfpiv_cli.reconstruction.images import still_light
from lfpiv_cli.validation.flow import TOLERANCE, Duct, Measured, relative_errors
from lfpiv_cli.verbs.build_weights import BuildWeightsOptions, build_weights_file
from lfpiv_cli.verbs.calibrate import CalibrateOptions, calibrate_snapshot
from lfpiv_cli.verbs.correlate import correlate_files
from lfpiv_cli.verbs.reconstruct import ReconstructOptions, reconstruct_files
from lfpiv_cli.verbs.simulate import frame_names, simulate_board, simulate_particles, simulate_white
from lfpiv_cli.verbs.validate import measured_of


def beside_wall(measured: Measured, duct: Duct) -> Flags:
    """Return which windows (nz, ny, nx) lie beyond `PAPERS_WALL` of the width, of those that are judged."""
    axis = duct.across["x/D"]
    places = measured.field.grid.centres_mm()[..., axis]
    return np.asarray(measured.inside & (places > duct.position_mm(axis, PAPERS_WALL)))


def near_wall(measured: Measured, duct: Duct) -> dict[str, float]:
    """Return the figures of a duct's windows near the wall at the high end of its lateral axis, along the flow.

    Returns
    -------
    dict
        `windows`, how many; `within_25`, the share of them within a quarter of the true velocity; `mean_error` of the
        sum of velocities, a share; `within_sigma`, `mean_sigma`: by how much chance moves the two, one standard error
    """
    pairs = replace(measured, inside=beside_wall(measured, duct)).pairs
    streamwise, _ = relative_errors(pairs)
    # a duct's flow has a direction
    assert streamwise is not None
    assert pairs.direction is not None
    within = streamwise < TOLERANCE
    true, found = pairs.true @ pairs.direction, pairs.measured @ pairs.direction
    error, total = (found - true)[pairs.found], float(true[pairs.found].sum())
    count = len(within)
    return {
        "windows": count,
        "within_25": float(within.mean()),
        "mean_error": float(error.sum() / total),
        "within_sigma": float(np.sqrt(within.mean() * (1.0 - within.mean()) / count)),
        "mean_sigma": float(np.sqrt(error.size) * error.std() / total),
    }


FULL = ChannelSize(10.0, 3.2, 640, 1768, (32, 16), 200, (3, 7))
QUICK = ChannelSize(5.0, 2.4, 480, 900, (16,), 40, (3, 4))
# What the mask leaves must measure as well as a channel without bubbles in which the same pixels are hidden, but for so
# many standard errors of chance.
CHANCE_SIGMAS = 2.0
# The side of the piece of the raw image that is shown, in pixels.
SHOWN_PX = 500


@dataclass(frozen=True)
class Case:
    """One way to measure: of which images, what is left out or taken off, and by which solver."""

    words: str
    images: str
    options: Mapping[str, Any]


# What the pictures show.
SHOWN = ("clean", "paper", "bubbles", "background", "mask")
MASK = "mask.tif"


def bubbles(work: Work) -> Findings:
    """Measure a channel with bubbles on a wall, with and without a mask, and the same without them."""
    size = work.by_size(TINY, QUICK, FULL)
    diameters = work.by_size([0.3, 0.4], [0.4, 0.8], [0.4, 0.9])
    config = work.config("clean", channel_sections(size, reconstruction=at_best(size)))
    count = work.by_size(3, 3, 4)
    simulation = {"bubbles": count, "bubble_diameter_mm": diameters}
    with_bubbles = work.config("bubbles", channel_sections(size, reconstruction=at_best(size), simulation=simulation))
    work.step("images", partial(_simulated, config, with_bubbles, work))
    cases = {
        "clean": Case("no bubbles", "clean", {}),
        "hidden": Case("no bubbles, same pixels hidden", "clean", {"mask": work.folder / MASK}),
        "paper": Case("bubbles, SART", "bubbles", AS_PAPER | {"iterations": size.iterations}),
        "bubbles": Case("bubbles", "bubbles", {}),
        "background": Case("bubbles, background off", "bubbles", {"background": "minimum"}),
        "mask": Case("bubbles, mask", "bubbles", {"mask": "still"}),
    }
    found = {name: work.step(f"{name}_figures", partial(_measured, name, case, work)) for name, case in cases.items()}
    duct = simulated_duct(config)
    methods = {cases[name].words: _read(work, name) for name in SHOWN}
    return Findings(
        rows=_rows(found),
        drawings=_drawings(work, methods, duct),
        tables=(_table(cases, found),),
        text=_text(size, diameters, count),
        commands=(
            "lfpiv simulate particles work/bubbles/bubbles.yaml -o bubbles-images",
            "lfpiv reconstruct work/bubbles/weights.h5 bubbles-images/pair_a.tif bubbles-images/pair_b.tif "
            "--dark work/bubbles/still/dark.tif --mask still -o bubbles-volumes",
            "lfpiv correlate bubbles-volumes/pair_a.vtkhdf bubbles-volumes/pair_b.vtkhdf -o bubbles.vtkhdf",
            "lfpiv validate flow work/bubbles/bubbles.yaml --vectors bubbles.vtkhdf -o bubbles-report",
        ),
        seeds=(SEED,),
    )


def _simulated(clean: Path, with_bubbles: Path, work: Work) -> dict[str, Any]:
    """Simulate the same tracers without and with bubbles, calibrate and build the weights of both."""
    common: dict[str, Any] = {"overwrite": True, "console": work.console}
    still = work.folder / "still"
    simulate_white(clean, still, **common)
    simulate_board(clean, still, **common)
    for config in (clean, with_bubbles):
        simulate_particles(config, work.folder / config.stem, **common)
    calibration = work.folder / "calibration.h5"
    pictures = CalibrateOptions(white=[still / "white.tif"], dark=still / "dark.tif", board=[still / "board.tif"])
    calibrate_snapshot(clean, calibration, pictures, **common)
    build_weights_file(clean, work.folder / "weights.h5", BuildWeightsOptions(calibration=calibration), **common)
    pitch_px = float(load_rig(clean).camera_model().micro_image_lattice_px().pitch.max())
    left_out = still_light([read_image(work.folder / "bubbles" / name) for name in frame_names(2)], pitch_px)
    write_tiff(work.folder / MASK, np.where(left_out, 0, 255).astype(np.uint8), overwrite=True)
    return {"pixels_left_out": int(left_out.sum())}


def _measured(name: str, case: Case, work: Work) -> dict[str, Any]:
    """Measure the flow in one way and return its figures near the wall."""
    # images that are spoilt on purpose: the page says how badly, the terminal need not
    folder, quiet = work.folder / f"measured_{name}", Console(quiet=True)
    pair = [work.folder / case.images / image for image in frame_names(2)]
    options = ReconstructOptions(dark=work.folder / "still" / "dark.tif", **case.options)
    reported = reconstruct_files(work.folder / "weights.h5", pair, folder, options, overwrite=True, console=quiet)
    volumes = [folder / f"{image.stem}.vtkhdf" for image in pair]
    correlate_files(volumes, work.folder / f"{name}.vtkhdf", overwrite=True, console=quiet)
    figures = near_wall(_read(work, name), simulated_duct(work.folder / "clean.yaml"))
    return figures | {"excluded_pixels": reported["excluded_pixels"]}


def _read(work: Work, name: str) -> Measured:
    """Return vectors with the true flow."""
    return measured_of(work.folder / f"{name}.vtkhdf", load_rig(work.folder / "clean.yaml"), None, is_simulated=True)


def _rows(found: Mapping[str, Mapping[str, Any]]) -> tuple[Row, ...]:
    hidden = found["hidden"]
    where = f"at x/D > {PAPERS_WALL:g}"
    return (
        Row(
            f"mean velocity error {where} beside bubbles (%)",
            "Figs. 16, 17",
            100.0 * (abs(hidden["mean_error"]) + CHANCE_SIGMAS * hidden["mean_sigma"]),
            ert=100.0 * abs(found["paper"]["mean_error"]),
            best=100.0 * abs(found["mask"]["mean_error"]),
            reason="without the mask bubbles stand still and outshine the tracers, as the paper says of its own",
        ),
        Row(
            f"vectors within 25 % {where} beside bubbles (%)",
            "Figs. 16, 17",
            100.0 * (hidden["within_25"] - CHANCE_SIGMAS * hidden["within_sigma"]),
            sense="at least",
            ert=100.0 * found["paper"]["within_25"],
            best=100.0 * found["mask"]["within_25"],
        ),
    )


def _table(cases: Mapping[str, Case], found: Mapping[str, Mapping[str, Any]]) -> Table:
    rows = tuple(
        (
            case.words,
            f"{100.0 * found[name]['mean_error']:+z.1f} ± {100.0 * found[name]['mean_sigma']:.1f}",
            f"{100.0 * found[name]['within_25']:.0f} ± {100.0 * found[name]['within_sigma']:.0f}",
            f"{found[name]['excluded_pixels']}",
        )
        for name, case in cases.items()
    )
    return Table(
        f"The {found['clean']['windows']} windows at x/D > {PAPERS_WALL:g}, with one standard error of chance",
        ("measured", "mean velocity error (%)", "vectors within 25 % (%)", "pixels left out"),
        rows,
    )


def _drawings(work: Work, methods: Mapping[str, Measured], duct: Duct) -> tuple[Drawing, ...]:
    mask = read_image(work.folder / MASK) == 0.0
    # a piece around the pixels that are left out, or the first corner
    rows, columns = np.nonzero(mask)
    middle = (np.median(rows), np.median(columns)) if rows.size else (0.0, 0.0)
    starts = [int(np.clip(m - SHOWN_PX / 2, 0, max(n - SHOWN_PX, 0))) for m, n in zip(middle, mask.shape, strict=True)]
    shown = np.s_[starts[0] : starts[0] + SHOWN_PX, starts[1] : starts[1] + SHOWN_PX]
    without = methods["bubbles"]
    error = np.linalg.norm(without.field.velocity - without.truth, axis=-1)
    plane = int(np.argmax(np.where(beside_wall(without, duct), np.nan_to_num(error), 0.0).sum(axis=(1, 2))))
    depth = float((without.field.grid.axis_mm(2)[plane] - duct.position_mm(2, 0.0)) / duct.width_mm)
    return (
        Drawing.of("raw", raw_figure, read_image(work.folder / "bubbles" / frame_names(2)[0])[shown], mask[shown]),
        Drawing(
            "vectors",
            f"Vectors and errors in the plane at z/D = {depth:.2f}, in which most is spoilt beside the wall; "
            f"beyond the dashed line, x/D = {PAPERS_WALL:g}, the paper's velocities are too small. Blank: no vector.",
            plane_figure(methods, duct, plane),
        ),
        Drawing.of("profile", wall_profile_figure, methods, duct),
    )


def _text(size: ChannelSize, diameters: list[float], count: int) -> tuple[str, ...]:
    return (
        f"A short piece of the channel ({size.reported()}) with {count} bubbles of {diameters[0]:g} to "
        f"{diameters[1]:g} mm on the wall at the high end of x/D: bright discs with a saturated core that do not move "
        "between the two images. Saturated pixels are left out in any case; what spoils the velocities is the bright "
        "rim, which light gives to voxels all along its line of sight and which stands still. `lfpiv reconstruct "
        "--mask still` finds such pixels from the images alone, here the two of the pair, without knowing where the "
        "bubbles are; "
        "`--background minimum` takes off what both images have in common.",
        "Left out are pixels that in all images are brighter than what the images differ by nearly everywhere, and "
        "their neighbours within one microlens. Tracers whose light falls on these pixels cannot be measured by "
        "anybody: the limits are those of the same tracers without bubbles where the same pixels are hidden, with two "
        "standard errors of chance. All but one row are reconstructed by EM; in SART's volumes the bubbles outshine "
        "the tracers so much that nearly all windows are taken for empty and have no vector. What two images have in "
        "common is also the light of tracers that hardly move: "
        "taken off as background it leaves the faster ones, and velocities beside both walls become too large.",
    )
