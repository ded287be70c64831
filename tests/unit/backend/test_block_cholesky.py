"""Sparse systems of poses: solved and inverted as the dense matrix is, however they are linked."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import bsr_matrix, csr_matrix

from fgslam.backend.smoothers.elimination import BlockCholesky, groups_of, least_degree
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import EstimatorError


def drive(n: int, loops: int, rng: np.random.Generator) -> BoolArray:
    """Which of n poses are linked: neighbours, and some that meet again."""
    links = np.eye(n, dtype=np.bool_) | np.eye(n, k=1, dtype=np.bool_)
    for one, other in rng.integers(n, size=(loops, 2)):
        links[one, other] = True
    return np.asarray(links | links.T)


def information(links: BoolArray, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A matrix (6n, 6n) with those blocks, and the scale of its rows, from 1e-3 to 1e3."""
    n = len(links)
    matrix = 1e-2 * np.eye(6 * n)
    for one, other in np.argwhere(np.triu(links, 1)):
        rows = np.concatenate([6 * one + np.arange(6), 6 * other + np.arange(6)])
        jacobian = rng.standard_normal((6, 12))
        matrix[np.ix_(rows, rows)] += jacobian.T @ jacobian
    scale = 10.0 ** rng.uniform(-3, 3, 6 * n)
    return matrix * scale[:, None] * scale, scale


@pytest.mark.parametrize(("n", "loops"), [(1, 0), (2, 0), (9, 0), (9, 5), (60, 0), (60, 25)])
def test_solution_and_inverse_are_those_of_the_dense_matrix(
    n: int, loops: int, rng: np.random.Generator
) -> None:
    links = drive(n, loops, rng)
    matrix, scale = information(links, rng)
    factor = BlockCholesky(bsr_matrix(matrix, blocksize=(6, 6)))
    plain = matrix / scale[:, None] / scale
    right = rng.standard_normal((6 * n, 3))
    solved = factor.solve(right * scale[:, None]) * scale[:, None]
    np.testing.assert_allclose(solved, np.linalg.solve(plain, right), rtol=0, atol=1e-9)
    row, column = np.nonzero(links)
    found = factor.inverse_blocks(row, column)
    found *= scale.reshape(n, 6)[row][:, :, None] * scale.reshape(n, 6)[column][:, None, :]
    expected = np.linalg.inv(plain).reshape(n, 6, n, 6)[row, :, column, :]
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def test_a_long_drive_with_rounds_fills_little_more_than_its_links() -> None:
    """A chain of 400 takes less than a tenth of the matrix; ten rounds of 40 less than half."""
    n = 400
    near = np.abs(np.subtract.outer(np.arange(n) % 40, np.arange(n) % 40))
    links = csr_matrix(np.minimum(near, 40 - near) <= 1)
    chain = csr_matrix(np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 2)
    groups = groups_of(chain, least_degree(chain))
    assert sum(len(g.front) ** 2 for g in groups) < 0.1 * n**2
    assert sorted(k for g in groups for k in range(g.start, g.stop)) == list(range(n))
    rounds = groups_of(links, least_degree(links))
    assert sum(len(g.front) * (g.stop - g.start) for g in rounds) < 0.5 * n**2
    for number, group in enumerate(rounds):
        assert (group.rows >= group.stop).all()
        assert group.parent == -1 or group.parent > number


def test_what_is_not_positive_definite_is_refused(rng: np.random.Generator) -> None:
    matrix, _ = information(drive(9, 3, rng), rng)
    for spoilt in (matrix - 2.0 * np.diag(np.diagonal(matrix)), matrix + 0.0):
        spoilt[3, 4] = spoilt[4, 3] = 10.0 * np.sqrt(abs(spoilt[3, 3] * spoilt[4, 4]))
        with pytest.raises(EstimatorError, match="do not determine all variables"):
            BlockCholesky(bsr_matrix(spoilt, blocksize=(6, 6)))
