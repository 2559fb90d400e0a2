"""Compiled functions: those that kernels call, and those that Python calls."""

import gc

import numpy as np
import pytest
from numba import config

from lfpiv_cli.arrays import Floats
from lfpiv_cli.kernels import njit


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
def test_errors_come_out_of_what_kernels_call() -> None:
    assert half_of_share(9, 2) == 2
    with pytest.raises(ZeroDivisionError):
        half_of_share(9, 0)
