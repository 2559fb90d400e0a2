"""How much memory a correlation takes, from the size of its volumes and its windows.

Measured on two threads, with the program's 0.25 GB: 0.30 GB for 80 x 80 x 120 voxels, 0.41 for 128 x 128 x 160 and
0.75 for 240 x 200 x 160 with windows of 24 and 12 voxels; 1.63 for the first with windows of 16 and 8 and an overlap of
0.75, of which 0.8 are the moments of the cells.
"""

from __future__ import annotations

import math

from lfpiv_cli.flow.correlation import CorrelationSettings, Pass, plan
from lfpiv_cli.flow.moments import cells_of
from lfpiv_cli.flow.windows import Triple
from lfpiv_cli.simd.block_sums import MOMENTS

# Two volumes, their splines, and both of them deformed, with what is made in between.
VOXEL_BYTES = 34
# Of each window and shift the products and their sum, the two maps, and twice the energies of two volumes.
SHIFT_BYTES = 40
MOMENT_BYTES = 8


def held_bytes(shape_xyz: Triple, settings: CorrelationSettings) -> float:
    """Return what a correlation of two volumes holds in memory at once, in bytes, without the program."""
    passes = plan(shape_xyz, settings.windows, settings.overlap)
    return float(VOXEL_BYTES * math.prod(shape_xyz) + max(map(_pass_bytes, passes)))


def _pass_bytes(step: Pass) -> int:
    """Return what a pass holds besides the volumes; moments are those of the last one, and of few others."""
    shifts = (2 * step.radius + 1) ** 3
    cells = math.prod(starts.size for starts in cells_of(step.layout).start) if step.is_last else 0
    return SHIFT_BYTES * shifts * math.prod(step.layout.count) + MOMENT_BYTES * MOMENTS * cells
