"""The covariances of a spline field's gradients, from the blocks of its coefficients' covariance.

Axes: a gradient's elements (component, direction) in C order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.fields.lattice import SUPPORT
from lfpiv_cli.fields.spline_field import SplineField
from lfpiv_cli.fields.stencils import rows_of

Floats = NDArray[np.float64]
COMPONENTS = 3


def gradient_covariance_at(field: SplineField, points_mm: Floats) -> Floats:
    """Return the covariances (m, 9, 9) of a field's gradients at points, per mm^2 of squared displacements."""
    parts = [rows_of(field.lattice, points_mm, axis) for axis in range(3)]
    columns, slopes = parts[0][0], np.stack([values for _, values in parts], axis=1)
    plane = int(np.prod(field.lattice.shape[1:]))
    found = np.empty((len(points_mm), COMPONENTS, 3, COMPONENTS, 3))
    firsts = columns[:, 0] // plane
    for first in np.unique(firsts):
        whole = _of_planes(field, int(first), plane)
        here = np.flatnonzero(firsts == first)
        cells, which = np.unique(columns[here], axis=0, return_inverse=True)
        for number, cell in enumerate(cells):
            at = here[which.ravel() == number]
            within = cell - first * plane
            rows = (within // plane * COMPONENTS + np.arange(COMPONENTS)[:, np.newaxis]) * plane + within % plane
            of_cell = whole[rows[:, :, np.newaxis, np.newaxis], rows]
            found[at] = np.einsum("mdk,ckbl,mel->mcdbe", slopes[at], of_cell, slopes[at], optimize=True)
    return found.reshape(len(points_mm), COMPONENTS * 3, COMPONENTS * 3)


def _of_planes(field: SplineField, first: int, plane: int) -> Floats:
    """Return the covariance of the coefficients of four planes of x, which lie in one block or in two."""
    diagonal, below = field.covariance
    length = len(diagonal[0])
    start, size = first * COMPONENTS * plane, SUPPORT * COMPONENTS * plane
    block = start // length
    if start + size <= block * length + len(diagonal[block]):
        whole = diagonal[block]
    else:
        whole = np.block([[diagonal[block], below[block].T], [below[block], diagonal[block + 1]]])
    inside = slice(start - block * length, start - block * length + size)
    return whole[inside, inside]
