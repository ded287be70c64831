"""A dense matrix that is factored, and inverted, in its own place."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from fgslam.backend.smoothers.elimination import DenseFactor, UndeterminedError
from fgslam.core.arrays import FloatArray


def positive(rng: np.random.Generator, size: int) -> FloatArray:
    """Of rows and columns a thousand times as large as others."""
    root = rng.standard_normal((size, size)) + 3.0 * np.eye(size)
    scale = np.where(np.arange(size) % 2, 1e3, 1.0)
    return np.asarray((root @ root.T + size * np.eye(size)) * scale * scale[:, None])


def test_inverse_and_solutions_before_and_after_it(rng: np.random.Generator) -> None:
    matrix, right = positive(rng, 40), rng.standard_normal(40)
    expected = np.linalg.inv(matrix)
    deviation = np.sqrt(np.diagonal(expected))
    factor = DenseFactor(matrix.copy())
    for _ in range(2):
        off = (factor.solve(right) - expected @ right) / deviation
        np.testing.assert_allclose(off, 0.0, atol=1e-9, rtol=0.0)
        off = (factor.inverse - expected) / (deviation * deviation[:, None])
        np.testing.assert_allclose(off, 0.0, atol=1e-9, rtol=0.0)


def test_there_is_never_a_second_matrix(rng: np.random.Generator) -> None:
    matrix = positive(rng, 800)
    tracemalloc.start()
    try:
        factor = DenseFactor(matrix)
        factor.solve(np.ones(800))
        assert np.isfinite(factor.inverse).all()
        assert tracemalloc.get_traced_memory()[1] < 0.3 * matrix.nbytes
    finally:
        tracemalloc.stop()


def test_row_of_what_is_not_determined_is_named(rng: np.random.Generator) -> None:
    matrix = positive(rng, 6)
    matrix[4] = matrix[:, 4] = 0.0
    with pytest.raises(UndeterminedError) as caught:
        DenseFactor(matrix)
    assert caught.value.row == 4
