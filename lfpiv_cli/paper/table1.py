"""Weights of the voxels p1 to p5 (Table 1, Figs. 5 and 6): equivalent ray tracing against direct ray tracing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from lfpiv_cli.files.config import load_config
from lfpiv_cli.files.pages import Table
from lfpiv_cli.notice import written
from lfpiv_cli.paper.parts import Drawing, Findings, Row, Work
from lfpiv_cli.paper.rig import sections
from lfpiv_cli.validation.weights import (
    TABLE1_MM,
    Column,
    make_columns,
    sample_voxels,
    weights_figures,
)
from lfpiv_cli.validation.weights_pictures import columns_figure, similarity_figure
from lfpiv_cli.weights.rays import PAPERS_COUNT

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
    settings = load_config(config)
    camera, grid, rng = settings.camera_model(), settings.grid(), np.random.default_rng(SEED)
    space = replace(settings.plane_space("comparing ways to make weights"), window=settings.window_model())
    paper = np.array(TABLE1_MM)[: work.by_size(1, 5, 5)]
    centres = np.concatenate([paper, sample_voxels(grid, work.by_size(0, 3, 20), rng)])
    long_count = np.zeros(len(centres), np.int64)
    long_count[: len(paper)] = work.by_size(0, 0, 100_000_000)
    with work.console.progress(len(centres), "weights") as advance:
        columns = make_columns(camera, space, centres, grid.spacing_mm, rng, long_count, advance)
    figures = weights_figures(columns, long_count)
    return Findings(
        rows=_rows(figures, len(paper)),
        drawings=_drawings(columns[: len(paper)], figures),
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
            quantity="similarity (SSIM) of ERT and DRT weights, smallest",
            source="Fig. 6",
            limit=PAPERS_SSIM,
            sense="at least",
            paper_ert=1.0,
            ert=min(each["ssim"] for each in counted),
            best=same["ssim_smallest"],
            reason=CHANCE,
        ),
        Row(
            quantity="difference of ERT and DRT weights, largest RMSE (grey levels of 255)",
            source="Fig. 6",
            limit=PAPERS_RMSE_GREY,
            paper_ert=PAPERS_RMSE_GREY,
            ert=max(each["rmse_grey"] for each in counted),
            best=same["rmse_grey_largest"],
        ),
        Row(
            quantity="ERT against DRT by Snell's law, largest share of a voxel's light",
            source="Section 3.2",
            limit=LIMIT_EXACT,
            ert=figures["ert_to_drt_exact"]["l1_largest"],
            best=exact["l1_largest"],
        ),
        Row(
            quantity="weights in use against the integral, mean share of light",
            source="Eq. 13",
            limit=chance,
            ert=chance,
            best=used,
        ),
    )


def _drawings(columns: list[Column], figures: dict[str, Any]) -> tuple[Drawing, ...]:
    return (
        Drawing(
            "columns",
            "The weights of the paper's voxels as the sensor would see them (after Fig. 5): traced directly by Snell's "
            "law, integrated over equivalent points, as they are in use, and counted as the paper did. A row a voxel, "
            "one grey scale in each.",
            columns_figure(columns),
        ),
        Drawing(
            "similarity",
            "SSIM, RMSE and absolute difference by voxel (after Fig. 6).",
            similarity_figure(figures, len(columns)),
        ),
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
