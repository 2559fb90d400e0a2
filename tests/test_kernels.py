"""Compiled functions; the vectorised inner loops against their plain twins; the benchmarks at a tiny size."""

import gc

import numpy as np
import pytest
from numba import config
from numba import njit as numba_njit

from benchmarks.simd import gains
from benchmarks.weights import against_sparse_matrix, share_of_matrix_product_rate
from lfpiv_cli import simd
from lfpiv_cli.arrays import Floats
from lfpiv_cli.grid import Grid
from lfpiv_cli.kernels import njit
from lfpiv_cli.optics.media import Media
from lfpiv_cli.simd import COEFFICIENTS, GROUP, LANES, TILE, combine_reference, lanes_of
from lfpiv_cli.weights.build import factorise


@njit()
def total(values: Floats) -> float:
    return float(values[0] + values[1])


@njit()
def share(value: int, of: int) -> int:
    return value // of


@njit()
def half_of_share(value: int, of: int) -> int:
    return share(value, of) // 2


@njit()
def twice(values: Floats) -> float:
    return 2.0 * total(values)


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_a_function_is_compiled_for_python_where_python_calls_it() -> None:
    assert twice(np.array([1.0, 2.0])) == 6.0
    assert len(twice.signatures) == len(total.inward.signatures) == 1
    assert len(twice.inward.signatures) == len(total.signatures) == 0
    assert total(np.array([1.0, 2.0])) == 3.0
    assert len(total.signatures) == 1
    assert gc.isenabled()


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_a_function_that_takes_anothers_decorator_is_refused() -> None:
    with pytest.raises(TypeError, match="total: compiled twice"):
        njit()(total)


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
def test_errors_come_out_of_what_kernels_call() -> None:
    assert half_of_share(9, 2) == 2
    with pytest.raises(ZeroDivisionError):
        half_of_share(9, 0)


def compiled(name, arguments):
    """Return a compiled function that calls an intrinsic with so many arguments: they are of kernels alone."""
    names = ", ".join("abcdefghi"[:arguments])
    scope = {"intrinsic": getattr(simd, name)}
    exec(f"def call({names}): intrinsic({names})", scope)
    return numba_njit(scope["call"])


@pytest.mark.thorough
@pytest.mark.parametrize("onto", [0, 3])
@pytest.mark.parametrize("count", [0, 1, 7])
@pytest.mark.parametrize(
    ("name", "shape"), [("combine_long", (GROUP, TILE)), ("combine_line", (1, TILE)), ("combine_vector", (1, LANES))]
)
@pytest.mark.parametrize(("term_step", "line_step"), [(GROUP, 1), (1, 11)])
def test_combine_equals_its_reference(rng, name, shape, onto, count, term_step, line_step):
    source = rng.standard_normal(12 * TILE, np.float32)
    share = rng.standard_normal(100, np.float32)
    line = rng.integers(0, 10, 9).astype(np.int32)
    start = rng.standard_normal((TILE + 3) * GROUP + 5, np.float32)
    expected, found = start.copy(), start.copy()
    places = ((5, shape[1] + 3, onto), source, line, (TILE, TILE - 3, 2, count), share, (4, term_step, line_step))
    combine_reference(shape, expected, *places)
    compiled(name, 7)(found, *places)
    # a fused multiply-add rounds once where the twin rounds twice
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.thorough
@pytest.mark.parametrize("count", [0, 1, 3])
def test_turned_sums_and_those_with_varying_shares_equal_their_references(rng, count):
    step, places = LANES + 3, np.linspace(-1.0, 1.0, LANES + 5).astype(np.float32)
    source = rng.standard_normal(12 * step, np.float32)
    line = rng.integers(0, 8, LANES + 2).astype(np.int32)
    share = rng.standard_normal(4 * COEFFICIENTS * LANES, np.float32)  # of either sign: some weights are cut to 0
    expected = rng.standard_normal(step * LANES, np.float32)
    found = expected.copy()
    one = source, line, (1, step, 2, count), share, LANES
    varying = *one, places, 3
    for name, onto, arguments in (
        ("combine_turned", (2, step), one),
        ("combine_turned_varying", (2, step), varying),
        ("combine_varying", 7, varying),
    ):
        getattr(simd, f"{name}_reference")(expected, onto, *arguments)
        compiled(name, 2 + len(arguments))(found, onto, *arguments)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)


def test_turn_equals_its_reference_in_lanes_of_the_processor(rng):
    step = LANES + 3
    source, expected = rng.standard_normal((2, step * LANES), np.float32)
    found = expected.copy()
    simd.turn_reference(expected, (2, step), source, (1, step))
    compiled("turn", 4)(found, (2, step), source, (1, step))
    np.testing.assert_array_equal(found, expected)
    assert lanes_of("+avx2,-avx512vl,+avx512f") == 16
    assert lanes_of("+avx2,-avx512f") == lanes_of("") == 8


@pytest.mark.thorough
def test_benchmarks_run_at_a_tiny_size(water: Media, table2):
    operator = factorise(table2, water, Grid.centred((3, 3, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 0.0)))
    assert share_of_matrix_product_rate(operator, 1e6, side=32, repeats=1)["share"] > 0.0
    assert against_sparse_matrix(Grid.centred((3, 2, 2), (0.1, 0.1, 0.1), (0.0, 0.0, 1.0)), repeats=1)["bytes"] > 1.0
    assert gains(calls=1, repeats=1, names=["turn"])["turn"] > 0.0
