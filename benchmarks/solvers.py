"""How fast the solvers are: against the same iterations with a sparse matrix, and how soon momentum is as far."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from benchmarks.timing import interleaved_medians_s
from benchmarks.weights import PAPER_GRID, TABLE2, WATER, sparse_matrix
from lfpiv_cli.calibration.board_pose import BoardGeometry
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.tracing import ObjectSpace
from lfpiv_cli.reconstruction.solvers import Image, SolverSettings, Stopping, Volume, normalisers, reconstruct
from lfpiv_cli.synthetic.board import BoardPlacement, render_board
from lfpiv_cli.weights.build import factorise
from lfpiv_cli.weights.operators import FactorisedOperator

BOARD = BoardGeometry((7, 7), 1.0, 0.2)
BOARD_Z_MM, LEVEL = 4.0, 28_000.0
PAPER_ITERATIONS, MOST_ACCELERATED = 200, 60
# A size whose matrix fits into memory twice (as it is and transposed), and few iterations of it.
SPARSE_GRID = Grid.centred((40, 40, 30), (0.1, 0.1, 0.1), (0.0, 0.0, 2.0))
SPARSE_ITERATIONS, SPARSE_REPEATS = 20, 3


@dataclass(frozen=True, eq=False)
class SparseOperator:
    """Weights as a CSR matrix (pixels, voxels) and its transpose."""

    matrix: sparse.csr_matrix
    transposed: sparse.csr_matrix
    shape: tuple[int, int, int]
    image_shape: tuple[int, int]

    def forward(self, volume: Volume) -> Image:
        """Return the image of a volume."""
        return (self.matrix @ volume.ravel()).reshape(self.image_shape)

    def adjoint(self, image: Image) -> Volume:
        """Return the volume that an image is spread back to."""
        return (self.transposed @ image.ravel()).reshape(self.shape)


def bench_solvers() -> None:
    """Print SART's ratio to a sparse matrix, its time at the paper's size, and when momentum has its residual."""
    operator = factorise(TABLE2, WATER, SPARSE_GRID)
    ratio = against_sparse_matrix(operator, SPARSE_ITERATIONS, SPARSE_REPEATS)
    print(f"{SPARSE_ITERATIONS} SART iterations, 40x40x30: {ratio:.1f} times faster than scipy.sparse CSR")
    rng = np.random.default_rng(0)
    space = ObjectSpace(WATER, None, "paraxial")
    image = render_board(TABLE2, space, BOARD, BoardPlacement(BOARD_Z_MM), LEVEL, rng).astype(np.float32)
    whole = factorise(TABLE2, WATER, PAPER_GRID)
    figures = catching_up(whole, image, PAPER_ITERATIONS, MOST_ACCELERATED)
    print(
        f"80x80x240, board at {BOARD_Z_MM} mm: SART {PAPER_ITERATIONS} in {figures['plain_s']:.1f} s, residual "
        f"{figures['residual']:.4f}; with momentum in {figures['iterations']:.0f}, {figures['accelerated_s']:.1f} s"
    )


def against_sparse_matrix(operator: FactorisedOperator, iterations: int, repeats: int) -> float:
    """Return how many times faster SART is with the factorised weights than with a CSR matrix of the same columns."""
    matrix = sparse_matrix(operator)
    explicit = SparseOperator(matrix, matrix.T.tocsr(), operator.shape, operator.image_shape)
    image = operator.forward(np.random.default_rng(0).random(operator.shape, np.float32))
    sums = normalisers(operator)
    medians = interleaved_medians_s(
        {
            "factorised": lambda: reconstruct(operator, image, SolverSettings("sart", iterations), sums=sums),
            "sparse": lambda: reconstruct(explicit, image, SolverSettings("sart", iterations), sums=sums),
        },
        repeats,
    )
    return medians["sparse"] / medians["factorised"]


def catching_up(operator: FactorisedOperator, image: Image, iterations: int, most: int) -> dict[str, float]:
    """Return the time of SART, its residual, and with momentum the iterations and the time to the same residual."""
    sums = normalisers(operator)
    began = time.perf_counter()
    plain = reconstruct(operator, image, SolverSettings("sart", iterations), sums=sums)
    reached = time.perf_counter()
    limit = float(plain.residual[-1])
    until = SolverSettings("sart", most, accelerate=True, stopping=Stopping(residual=limit))
    fast = reconstruct(operator, image, until, sums=sums)
    return {
        "plain_s": reached - began,
        "residual": limit,
        "iterations": float(fast.residual.size - 1),
        "accelerated_s": time.perf_counter() - reached,
    }
