"""What locking near the focal plane adds to the stated uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lfpiv_cli.flow.correlation import correlate
from lfpiv_cli.flow.peaks import LOCKING_LENSES, with_locking
from lfpiv_cli.flow.windows import CorrelationSettings
from lfpiv_cli.grid import Grid
from lfpiv_cli.reference import Reference
from lfpiv_cli.scale import Scale

SCALE = Scale(lens_mm=0.1, depth_mm=1.0)


def test_lateral_uncertainty_grows_in_the_focal_plane_alone(rng: np.random.Generator) -> None:
    grid = Grid((16, 16, 48), (0.05, 0.1, 0.2), (0.0, 0.0, -2.0))
    volume = rng.random(grid.shape_zyx).astype(np.float32)
    field = correlate([(volume, volume)], grid, CorrelationSettings([(8, 8, 8)], (0.5, 0.5, 0.5)))
    field = replace(field, uncertainty_voxel=np.zeros_like(field.uncertainty_voxel))
    # The focal plane lies at -1.2 mm in the volume's coordinates.
    stated = with_locking(field, Reference("mid_plane", 1.2), SCALE).uncertainty_voxel
    assert stated is not None
    assert np.all(stated[..., 2] == 0.0)
    np.testing.assert_allclose(stated[..., 0] * 0.05, stated[..., 1] * 0.1)
    depth = field.grid.axis_mm(2) + 1.2
    np.testing.assert_allclose(stated[:, 0, 0, 0] * 0.05, LOCKING_LENSES * 0.1 * np.exp(-0.5 * depth**2), rtol=1e-12)
