"""What the weights' verbs are given, checked before compiled loops read it: these know no bounds."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.errors import InputError


def real_array(given: object, shape: tuple[int, ...], what: str) -> NDArray[Any]:
    """Return an array of real numbers of a shape, as it is given.

    Raises
    ------
    InputError : it has another shape, to which nothing is stretched or cut, or holds no real numbers
    """
    array = np.asarray(given)
    if array.dtype.kind not in "fiub":
        raise InputError(f"{what} of {array.dtype}: expected real numbers")
    if array.shape != shape:
        raise InputError(f"{what} of the shape {array.shape} does not fit weights made for {shape}")
    return array


def voxel_index(index: tuple[Any, ...], shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return the indices of a voxel; none is counted from the end.

    Raises
    ------
    IndexError : it lies outside the volume
    TypeError : it is no whole number
    """
    whole = tuple(operator.index(number) for number in index)
    if not all(0 <= number < count for number, count in zip(whole, shape, strict=True)):
        raise IndexError(f"voxel {whole} lies outside a volume of the shape {shape}")
    return whole
