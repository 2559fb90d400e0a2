"""The weights' operators against the machine's matrix-product rate and a sparse matrix of the same columns."""

from __future__ import annotations

import os
import time

import numpy as np
from scipy import sparse

from benchmarks.timing import interleaved_medians_s
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.media import Media
from lfpiv_cli.weights.build import factorise
from lfpiv_cli.weights.operators import FactorisedOperator

TABLE2 = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1), 0.0055, 2352, 1768)
WATER = Media(1.0, 1.49, 1.33)
PAPER_GRID = Grid.centred((80, 80, 240), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0))
# Multiply-adds of one forward and one adjoint at the paper's size, whatever is executed.
PAPER_PAIR_MULTIPLY_ADDS = 2.2e9


def bench_weights() -> None:
    """Print build time, the share of the float32 matrix-product rate, and the ratios to a sparse matrix."""
    start = time.perf_counter()
    operator = factorise(TABLE2, WATER, PAPER_GRID)
    print(f"build 80x80x240: {time.perf_counter() - start:.2f} s (first call, compilation included where not cached)")
    share = share_of_matrix_product_rate(operator, PAPER_PAIR_MULTIPLY_ADDS, side=2048, repeats=9)
    print(f"forward + adjoint 80x80x240: {share['pair_s']:.3f} s, {100 * share['share']:.1f} % of the sgemm rate")
    print(f"  sgemm {share['sgemm_gflops']:.0f} GFLOP/s on {os.cpu_count()} cores, {share['repeats']} runs in turn")
    ratios = against_sparse_matrix(Grid.centred((40, 40, 30), (0.1, 0.1, 0.1), (0.0, 0.0, 2.0)), repeats=7)
    times, smaller = ratios["times_faster"], ratios["bytes"]
    print(f"40x40x30 against scipy.sparse CSR: {times:.1f} times faster, {smaller:.0f} times smaller")


def share_of_matrix_product_rate(
    operator: FactorisedOperator, multiply_adds: float, side: int, repeats: int
) -> dict[str, float]:
    """Return the rate of a forward and an adjoint, counted as `multiply_adds`, over that of a float32 product."""
    rng = np.random.default_rng(0)
    volume, image = rng.random(operator.shape, np.float32), rng.random(operator.image_shape, np.float32)
    matrix = rng.random((side, side), np.float32)
    medians = interleaved_medians_s(
        {
            "pair": lambda: (operator.forward(volume), operator.adjoint(image)),
            "sgemm": lambda: matrix @ matrix,
        },
        repeats,
    )
    sgemm_rate = side**3 / medians["sgemm"]
    return {
        "pair_s": medians["pair"],
        "share": multiply_adds / medians["pair"] / sgemm_rate,
        "sgemm_gflops": 2e-9 * sgemm_rate,
        "repeats": repeats,
    }


def against_sparse_matrix(grid: Grid, repeats: int) -> dict[str, float]:
    """Return how many times faster and smaller than a CSR matrix of identical columns the factorised form is."""
    operator = factorise(TABLE2, WATER, grid)
    matrix = sparse_matrix(operator)
    transposed = matrix.T.tocsr()
    rng = np.random.default_rng(0)
    volume, image = rng.random(operator.shape, np.float32), rng.random(operator.image_shape, np.float32)
    medians = interleaved_medians_s(
        {
            "factorised": lambda: (operator.forward(volume), operator.adjoint(image)),
            "sparse": lambda: (matrix @ volume.ravel(), transposed @ image.ravel()),
        },
        repeats,
    )
    explicit = matrix.data.nbytes + matrix.indices.nbytes + matrix.indptr.nbytes
    axes = (operator.columns, operator.rows)
    factorised = sum(axis.start.nbytes + axis.cell.nbytes + axis.share.nbytes for axis in axes)
    return {"times_faster": medians["sparse"] / medians["factorised"], "bytes": explicit / factorised}


def sparse_matrix(operator: FactorisedOperator) -> sparse.csr_matrix:
    """Return the weights as an explicit matrix (pixels, voxels)."""
    planes, height, width = operator.shape
    rows, columns, values, start = [], [], [], [0]
    for plane in range(planes):
        for row_voxel in range(height):
            for column_voxel in range(width):
                row, column, weight = operator.column(plane, row_voxel, column_voxel)
                rows.append(row)
                columns.append(column)
                values.append(weight)
                start.append(start[-1] + weight.size)
    pixel = np.concatenate(rows) * operator.image_shape[1] + np.concatenate(columns)
    shape = (operator.image_shape[0] * operator.image_shape[1], planes * height * width)
    by_voxel = sparse.csc_matrix((np.concatenate(values), pixel, np.asarray(start)), shape=shape)
    return by_voxel.tocsr()
