"""The vectorised inner loop against its plain twin, and the benchmarks at a tiny size."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from benchmarks.weights import against_sparse_matrix, share_of_matrix_product_rate
from lfpiv_cli.grid import Grid
from lfpiv_cli.optics.media import Media
from lfpiv_cli.simd.combine import GROUP, TILE, combine, combine_onto, combine_reference
from lfpiv_cli.weights.build import factorise


@njit
def set_lines(out, at, out_step, source, source_at, line, first, count, share, share_at, term_step, row_step):
    combine(out, at, out_step, source, source_at, line, first, count, share, share_at, term_step, row_step)


@njit
def add_lines(out, at, out_step, source, source_at, line, first, count, share, share_at, term_step, row_step):
    combine_onto(out, at, out_step, source, source_at, line, first, count, share, share_at, term_step, row_step)


@pytest.mark.parametrize(("compiled", "accumulate"), [(set_lines, False), (add_lines, True)])
@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize(("term_step", "row_step"), [(GROUP, 1), (1, 11)])
def test_combine_equals_its_reference(rng, compiled, accumulate, count, term_step, row_step):
    source = rng.standard_normal(12 * TILE, np.float32)
    share = rng.standard_normal(60, np.float32)
    line = rng.integers(0, 10, 9).astype(np.int32)
    start = rng.standard_normal(6 * TILE * GROUP, np.float32)
    expected, found = start.copy(), start.copy()
    places = (5, TILE + 3, source, TILE, line, 2, count, share, 4, term_step, row_step)
    combine_reference(expected, *places, accumulate=accumulate)
    compiled(found, *places)
    # a fused multiply-add rounds once where the twin rounds twice
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_benchmarks_run_at_a_tiny_size(water: Media, table2):
    operator = factorise(table2, water, Grid.centred((3, 3, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)))
    assert share_of_matrix_product_rate(operator, 1e6, side=32, repeats=1)["share"] > 0.0
    assert against_sparse_matrix(Grid.centred((3, 2, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 1.0)), repeats=1)["bytes"] > 1.0
