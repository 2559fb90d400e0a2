"""What arrays hold, for signatures."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

# Coordinates, sums and what is fitted.
Floats: TypeAlias = NDArray[np.float64]
