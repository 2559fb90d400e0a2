"""The solvers' benchmark at a tiny size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.solvers import SparseOperator, against_sparse_matrix, catching_up
from benchmarks.weights import sparse_matrix
from lfpiv_cli.grid import Grid
from lfpiv_cli.reconstruction.solvers import SolverSettings, reconstruct
from lfpiv_cli.weights.build import factorise


@pytest.fixture
def operator(table2, water):
    camera = replace(table2, columns=220, rows=200)
    return factorise(camera, water, Grid.centred((6, 5, 4), (0.1, 0.1, 0.5), (0.0, 0.0, 2.0)))


@pytest.mark.thorough
def test_both_weights_give_one_volume(operator, rng):
    matrix = sparse_matrix(operator)
    explicit = SparseOperator(matrix, matrix.T.tocsr(), operator.shape, operator.image_shape)
    image = operator.forward(rng.random(operator.shape, np.float32))
    volumes = [reconstruct(weights, image, SolverSettings("sart", 5)).volume for weights in (operator, explicit)]
    np.testing.assert_allclose(*volumes, rtol=1e-3)
    assert against_sparse_matrix(operator, 1, 1) > 0.0


@pytest.mark.thorough
def test_momentum_catches_up(operator, rng):
    image = operator.forward(rng.random(operator.shape, np.float32))
    figures = catching_up(operator, image, 40, 40)
    assert 0 < figures["iterations"] < 30
    assert figures["plain_s"] > 0.0
