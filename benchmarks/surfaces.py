"""Rays a second through the two cylinders of a pipe, beside plane layers, on one core."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.timing import interleaved_medians_s
from lfpiv_cli.optics.camera import Camera, Lattice
from lfpiv_cli.optics.curved_space import CurvedSpace, Face, aim_all
from lfpiv_cli.optics.media import Media
from lfpiv_cli.optics.surfaces import Cylinder
from lfpiv_cli.optics.tracing import disc_points, exact_slope

CAMERA = Camera(-1.0, 100.0, 25.0, 0.8, 0.8, Lattice.regular(0.1, "square"), 5.5e-3, 2352, 1768)
ALONG_X = (1.0, 0.0, 0.0)
# An acrylic tube of 10 mm inner diameter and 2 mm wall, full of water; and its wall laid flat.
TUBE = CurvedSpace(
    Media(1.0, 1.49, 1.33),
    (Face(Cylinder((0.0, 0.0, 0.0), ALONG_X, 7.0), 1.49), Face(Cylinder((0.0, 0.0, 0.0), ALONG_X, 5.0), 1.33)),
)
INSIDE_MM = 4.9
LAYERS_MM, INDICES = np.array([194.9, 2.0, 5.0]), np.array([1.0, 1.49, 1.33])


def bench_surfaces() -> None:
    """Print how many rays a second each way takes."""
    for name, rate in rates(rays=200_000, repeats=5).items():
        print(f"{name}: {rate / 1e6:.2f} million rays/s on one core")


def rates(rays: int, repeats: int) -> dict[str, float]:
    """Return the rays a second of each way, from points all over a tube through all of the main lens."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-6, 6, (rays, 1)), disc_points(rays, INSIDE_MM, rng)], axis=1)
    crossing = disc_points(rays, CAMERA.aperture_radius_mm, rng)
    faces = TUBE.for_kernels(CAMERA)
    ways: dict[str, Callable[[], object]] = {
        "from points in the tube, aimed at places of the lens": lambda: aim_all(faces, points, crossing),
        "the same through plane layers": lambda: _aimed_through_layers(points, crossing),
    }
    return {name: rays / taken for name, taken in interleaved_medians_s(ways, repeats).items()}


@njit
def _aimed_through_layers(points: NDArray[np.float64], crossing: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the slopes (n, 2) of the rays, by Newton's iteration on Snell's invariant."""
    slopes, layers = np.empty(crossing.shape), LAYERS_MM.copy()
    for i in range(len(points)):
        layers[2] = 5.0 + points[i, 2]
        slopes[i] = exact_slope(crossing[i, 0] - points[i, 0], crossing[i, 1] - points[i, 1], layers, INDICES)
    return slopes
