"""What arrays hold, for signatures; and a sum that is the same with any number of threads."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Coordinates, sums and what is fitted.
Floats: TypeAlias = NDArray[np.float64]
# Images, volumes, weights; indices and counts; what is so and what is not.
Singles: TypeAlias = NDArray[np.float32]
Integers: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]
# A number in either precision.
Real: TypeAlias = float | np.floating[Any]
# Rows and columns of a part of an image: all.
EVERYWHERE = (slice(None), slice(None))


def root_of_squares(values: NDArray[Any]) -> float:
    """Return the root of the sum of squares, the same however many threads BLAS, which norms are taken by, has."""
    return float(np.sqrt(np.sum(np.square(values))))
