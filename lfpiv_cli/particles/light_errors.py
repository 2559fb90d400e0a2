"""Errors that particles share: those of their size and the sensor's charge diffusion, and those of the model of light.

They move the particles of an image all in one way: no fit shows them as noise.

Axes: image axes, mm; see `fitting`. Squares: see `diffusion`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lfpiv_cli.particles.fitting import add_all
from lfpiv_cli.particles.view import View, footprint_radius_mm, with_diffusion

# Where particles leave this share of an image's light, its noise taken off, more than at any crowd at which most are
# found, the model of light is wrong, or tracers are missing. Beyond, its errors are alike in all lenses, first in part.
MUCH_LEFT = 0.1


def changes_of_light(
    view: View, particles: NDArray[np.float64], covariance: NDArray[np.float64], depths_mm: tuple[float, float]
) -> NDArray[np.float64]:
    """Return what the light of all particles (n, 4) changes by with each independent error, (2, pixels), by waves.

    Parameters
    ----------
    covariance : (2, 2) of the squares of diameter, microlenses^2, and of diffusion, px^2
    """
    squares = np.square([2.0 * view.particle_radius_mm / view.scale.lens_mm, view.diffusion_px])

    def image(square: NDArray[np.float64]) -> NDArray[np.float64]:
        diameter, diffusion_px = np.sqrt(np.maximum(square, 0.0))
        sized = view._replace(particle_radius_mm=0.5 * float(diameter) * view.scale.lens_mm)
        lit = np.zeros(view.camera.rows * view.camera.columns)
        add_all(with_diffusion(sized, float(diffusion_px)), particles, 1.0, lit, depths_mm)
        return lit

    # Of independent errors: none is larger than what it is of. A square that is as small as its error only grows.
    sides = [(squares + error, squares - error) for error in np.linalg.cholesky(covariance).T]
    return np.stack(
        [
            0.5 * (image(more) - image(less)) if less.min() >= 0.0 else image(more) - image(squares)
            for more, less in sides
        ]
    )


def light_left(image: NDArray[np.float64], residual: NDArray[np.float64], read_counts: float) -> float:
    """Return the share of an image's light (pixels,) that particles leave, its read noise taken off."""
    light = float(np.sum(image**2))
    return float(np.sqrt(max(np.sum(residual**2) - residual.size * read_counts**2, 0.0) / light)) if light else 0.0


def grown(
    view: View, particles: NDArray[np.float64], covariance: NDArray[np.float64], left: float
) -> NDArray[np.float64]:
    """Return covariances (n, 4, 4) of particles (n, 4) that leave a share of the light, larger where it is much.

    What a model gets wrong is alike in all lenses that a particle lights: for depth and light it adds up from lens to
    lens. Sideways lenses on either side of the spot make up for each other, and as much is taken to be left as goes
    with the spot's diameter.
    """
    alike = float(np.clip((left / MUCH_LEFT) ** 2 - 1.0, 0.0, 1.0))
    radius = 0.5 * footprint_radius_mm(view, particles) / np.sqrt(view.half_x_mm * view.half_y_mm)
    # Cells that a disc touches, on the mean.
    lenses = 1.0 + 4.0 * radius + np.pi * radius**2
    deep, sideways = np.sqrt(1.0 + alike * lenses), np.sqrt(1.0 + alike * np.sqrt(lenses))
    growth = np.stack([sideways, sideways, deep, deep], axis=-1)
    return np.asarray(covariance * growth[:, :, np.newaxis] * growth[:, np.newaxis, :])
