"""The two lengths in which a light-field camera sees its scene: what tracers are sought and followed by counts in them.

A length in millimetres that suits one camera is wrong for the next. What limits how near two tracers may be, how well
they are known and how far a fit may err is the microlens as the main lens shows it in the scene, and the depth over
which a point's light spreads by one lens.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class Scale(NamedTuple):
    """A camera's lengths in the scene. Table 2's: 0.1 mm and 1.064 mm.

    Attributes
    ----------
    lens_mm : a microlens in the scene, p_l / |M|
    depth_mm : the depth in the fluid over which a point's light spreads by one lens, (n_w / n_a) p_l N / M^2 with
        N = s_i / p_m of the main lens
    """

    lens_mm: float
    depth_mm: float

    @property
    def depth_ratio(self) -> float:
        """Depth over lateral length, 10.64 in Table 2."""
        return self.depth_mm / self.lens_mm

    def box_mm(self, lenses: float, depths: float) -> NDArray[np.float64]:
        """Return lengths (3,) along x, y and z: so many microlenses laterally, so many depths of one lens."""
        return np.array([lenses * self.lens_mm, lenses * self.lens_mm, depths * self.depth_mm])
