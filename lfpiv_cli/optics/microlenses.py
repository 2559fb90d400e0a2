"""The microlens array as a plane lattice: an origin and two basis vectors.

Lattice point (i, j) lies at origin + i * basis[0] + j * basis[1]. The same class describes the array itself (mm about
the optical axis) and the centres of its micro-images (pixels, column and row); each holder says which. Components are
always (image x, image y), that is along the columns first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from lfpiv_cli.names import Layout


@dataclass(frozen=True, eq=False)
class Lattice:
    """A plane lattice.

    Attributes
    ----------
    origin : (2,) position of point (0, 0)
    basis : (2, 2) the two basis vectors as rows, the first one nearest to the direction of the columns
    layout : square (vectors at 90 degrees) or hexagonal (at 60 degrees)
    """

    origin: NDArray[np.float64]
    basis: NDArray[np.float64]
    layout: Layout = "square"

    @classmethod
    def regular(
        cls, pitch: float, layout: Layout = "square", rotation_rad: float = 0.0, origin: ArrayLike = (0.0, 0.0)
    ) -> Lattice:
        """Return an ideal lattice, rotated from the columns (image x) towards the rows (image y)."""
        second = (0.0, 1.0) if layout == "square" else (0.5, np.sqrt(0.75))
        cosine, sine = np.cos(rotation_rad), np.sin(rotation_rad)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        return cls(np.asarray(origin, dtype=np.float64), pitch * np.array([(1.0, 0.0), second]) @ turn, layout)

    @property
    def rotation_rad(self) -> float:
        """Angle of the lattice, from the columns towards the rows: the mean over the basis vectors."""
        ideal = Lattice.regular(1.0, self.layout).basis
        turns = np.arctan2(self.basis[:, 1], self.basis[:, 0]) - np.arctan2(ideal[:, 1], ideal[:, 0])
        return float(np.mean(np.arctan2(np.sin(turns), np.cos(turns))))

    @property
    def pitch(self) -> NDArray[np.float64]:
        """Lengths of the two basis vectors, shape (2,)."""
        return np.hypot(self.basis[:, 0], self.basis[:, 1])

    @property
    def cell_area(self) -> float:
        """Area of the plane for each point."""
        return abs(float(np.linalg.det(self.basis)))

    def points(self, indices: ArrayLike) -> NDArray[np.float64]:
        """Return the positions of lattice points, indices of shape (..., 2)."""
        return self.origin + np.asarray(indices, dtype=np.float64) @ self.basis

    def coordinates(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return the fractional indices of positions, shape (..., 2)."""
        return (np.asarray(points, dtype=np.float64) - self.origin) @ np.linalg.inv(self.basis)

    def nearest(self, points: ArrayLike) -> NDArray[np.int64]:
        """Return the indices of the lattice point nearest to each position, shape (..., 2).

        Rounding the oblique coordinates is right on squares and names the wrong neighbour for one point in six on
        hexagons, so the neighbours are compared.
        """
        points = np.asarray(points, dtype=np.float64)
        rounded = np.rint(self.coordinates(points)).astype(np.int64)
        steps = np.array([(i, j) for i in (0, -1, 1) for j in (0, -1, 1)])
        candidates = rounded[..., np.newaxis, :] + steps
        distance2 = np.sum((self.points(candidates) - points[..., np.newaxis, :]) ** 2, axis=-1)
        best = np.argmin(distance2, axis=-1)
        return np.take_along_axis(candidates, best[..., np.newaxis, np.newaxis], axis=-2)[..., 0, :]

    def scaled(self, factor: float) -> Lattice:
        """Return the lattice with all lengths multiplied by `factor` about the coordinate origin."""
        return Lattice(self.origin * factor, self.basis * factor, self.layout)

    def transformed(self, matrix: ArrayLike, shift: ArrayLike = (0.0, 0.0)) -> Lattice:
        """Return the lattice of the points `matrix @ p + shift`."""
        matrix = np.asarray(matrix, dtype=np.float64)
        return Lattice(matrix @ self.origin + np.asarray(shift), self.basis @ matrix.T, self.layout)


@njit(cache=True)
def nearest_point(x: float, y: float, origin: NDArray[np.float64], basis: NDArray[np.float64]) -> tuple[float, float]:
    """Return the position of the lattice point nearest to (x, y): `Lattice.nearest` for kernels."""
    dx = x - origin[0]
    dy = y - origin[1]
    determinant = basis[0, 0] * basis[1, 1] - basis[0, 1] * basis[1, 0]
    i0 = np.rint((dx * basis[1, 1] - dy * basis[1, 0]) / determinant)
    j0 = np.rint((dy * basis[0, 0] - dx * basis[0, 1]) / determinant)
    best = np.inf
    best_x = 0.0
    best_y = 0.0
    for di in (0.0, -1.0, 1.0):
        for dj in (0.0, -1.0, 1.0):
            px = (i0 + di) * basis[0, 0] + (j0 + dj) * basis[1, 0]
            py = (i0 + di) * basis[0, 1] + (j0 + dj) * basis[1, 1]
            distance2 = (px - dx) ** 2 + (py - dy) ** 2
            if distance2 < best:
                best = distance2
                best_x = px
                best_y = py
    return origin[0] + best_x, origin[1] + best_y
