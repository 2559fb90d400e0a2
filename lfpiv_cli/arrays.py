"""What arrays hold, for signatures."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

# Coordinates, sums and what is fitted.
Floats: TypeAlias = NDArray[np.float64]
# Images, volumes, weights; indices and counts; what is so and what is not.
Singles: TypeAlias = NDArray[np.float32]
Integers: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]
