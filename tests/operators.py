"""What every operator of weights has to hold, and columns as images."""

import numpy as np
import pytest

from lfpiv_cli.arrays import Floats
from lfpiv_cli.weights.model import Weights


def column_image(operator: Weights, *index: int) -> Floats:
    """Return the image that the column of a voxel makes."""
    image = np.zeros(operator.image_shape)
    rows, columns, weights = operator.column(*index)
    image[rows, columns] = weights
    return image


def assert_adjoint(operator: Weights, rng: np.random.Generator) -> None:
    """The dot test: <A x, y> = <x, A* y>, to what float32 sums of some thousand terms leave."""
    volume, image = rng.random(operator.shape, np.float32), rng.random(operator.image_shape, np.float32)
    left = np.vdot(operator.forward(volume).astype(np.float64), image)
    assert left == pytest.approx(np.vdot(volume.astype(np.float64), operator.adjoint(image)), rel=1e-5)
