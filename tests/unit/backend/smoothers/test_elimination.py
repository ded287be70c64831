"""Elimination: block Cholesky and marginals."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from factor_checks import assert_near, random_covariance, random_pose
from factor_specifications import RawPixelFactors
from scipy.sparse import bsr_matrix, csr_matrix
from simulated import RIG, points_in_view

from benchmarks.gtsam_graphs import in_arrays
from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.bundle import PLAIN
from fgslam.backend.smoothers.elimination import (
    BlockCholesky,
    GraphMarginals,
    SolvedSystem,
    UndeterminedError,
    from_cholesky,
    groups_of,
    least_degree,
    reduced,
    scaled_cholesky,
)
from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Odometry
from fgslam.core.types import Floor, Prediction
from fgslam.factors.graphs import landmark_key, pose_key
from fgslam.factors.landmark import StereoFactors
from fgslam.factors.motion import floor_factors, odometry_factor, pose_prior
from fgslam.factors.noise import Whitening

# ------------------------------------------------------------------------------------------
# Sparse systems of poses: solved and inverted as the dense matrix is, however they are linked


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


# ------------------------------------------------------------------------------------------
# Marginals of whole graphs, both orders of elimination and the dense one, against GTSAM's own


BOTH = [True, False]  # whether landmarks are eliminated first
PITCHED = g.so3_exp(np.array([0.3, 0.0, 0.1])) @ np.array([0.0, 1.0, 0.0])
RELATIVE = 1e-8


def whole(first: bool, graph: Any, values: Any, kernel: KernelSettings = PLAIN) -> GraphMarginals:
    system, state = in_arrays(graph, values, kernel)
    return GraphMarginals.of(system.linear(state), first)


class Problem:
    """A chain of poses that see landmarks, some seen once; variables off the optimum."""

    def __init__(
        self,
        rng: np.random.Generator,
        poses: int = 4,
        landmarks: int = 7,
        kernel: Whitening | None = None,
        floor: Floor | None = None,
    ) -> None:
        self.graph, self.values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        start = np.eye(4) if floor else random_pose(rng)
        points = g.transform_to_world(start, points_in_view(RIG, landmarks, (2.0, 5.0), rng))
        factors = StereoFactors(RIG, kernel or Whitening())
        for frame in range(poses):
            shift = g.se3_exp(0.02 * rng.standard_normal(6))
            wTc = floor.constrain(start @ shift) if floor else start @ shift
            # Frame numbers and variables with gaps, as after a landmark was taken out.
            self.pose(3 * frame, wTc, rng)
            for n, point in enumerate(points):
                if n == 0 and frame > 0:
                    continue
                seen = RIG.predict(g.transform_to_camera(wTc, point[None, :]))[0]
                measured = seen + 0.3 * rng.standard_normal(3)
                covariance = random_covariance(rng, 3, 0.3)
                key = landmark_key(2 * n)
                self.graph.add(factors.factor(pose_key(3 * frame), key, measured, covariance))
            if floor is not None:
                for factor in floor_factors(pose_key(3 * frame), floor, wTc):
                    self.graph.add(factor)
        for n, point in enumerate(points):
            self.values.insert(landmark_key(2 * n), point + 0.01 * rng.standard_normal(3))
        self.poses = [pose_key(3 * frame) for frame in range(poses)]
        self.landmarks = [landmark_key(2 * n) for n in range(landmarks)]

    def pose(self, frame: int, wTc: FloatArray, rng: np.random.Generator) -> None:
        key = pose_key(frame)
        self.values.insert(key, gtsam.Pose3(wTc))
        if frame == 0:
            self.graph.add(pose_prior(key, Prediction(wTc, random_covariance(rng, 6, 0.01))))
        else:
            motion = g.se3_exp(0.02 * rng.standard_normal(6))
            odometry = Odometry(motion, random_covariance(rng, 6, 0.05))
            self.graph.add(odometry_factor(pose_key(frame - 3), key, odometry))

    def reference(self) -> Any:
        return gtsam.Marginals(self.graph, self.values)


def either(graph: Any, values: Any) -> SolvedSystem:
    system, state = in_arrays(graph, values)
    return reduced(system.linear(state))


def assert_same(found: FloatArray, expected: FloatArray) -> None:
    """Equal relative to the deviations of row and column."""
    sigma = np.sqrt(np.diagonal(expected))
    assert_near(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), RELATIVE)


# --------------------------------------------------------------------------------------------
# Equal to GTSAM's


def problems() -> dict[str, Callable[[np.random.Generator], Problem]]:
    return {
        "few poses": lambda rng: Problem(rng, 3, 12),
        "many poses": lambda rng: Problem(rng, 15, 3),
        "poses cut into segments": lambda rng: Problem(rng, 12, 24),
        "one pose": lambda rng: Problem(rng, 1, 4),
        "no landmarks": lambda rng: Problem(rng, 5, 0),
        "robust": lambda rng: Problem(rng, 4, 7, Whitening("cauchy", 0.5)),
        "soft floor": lambda rng: Problem(rng, floor=Floor(3, PITCHED, False, 0.02, 0.01)),
    }


@pytest.mark.parametrize("first", BOTH)
@pytest.mark.parametrize("name", problems())
def test_marginals_of_all_variables(name: str, first: bool, rng: np.random.Generator) -> None:
    problem = problems()[name](rng)
    reference = problem.reference()
    kernel = KernelSettings("cauchy", 0.5) if name == "robust" else PLAIN
    graph, state = in_arrays(problem.graph, problem.values, kernel)
    system = graph.linear(state)
    assert system.pose_keys.tolist() == problem.poses
    assert system.landmark_keys.tolist() == problem.landmarks
    found = GraphMarginals.of(system, first)
    poses, landmarks = found.poses(), found.landmarks()
    assert poses.shape == (len(problem.poses), 6, 6)
    assert landmarks.shape == (len(problem.landmarks), 3, 3)
    for key, covariance in zip(problem.poses, poses, strict=True):
        assert_same(covariance, reference.marginalCovariance(key))
    for key, covariance in zip(problem.landmarks, landmarks, strict=True):
        assert_same(covariance, reference.marginalCovariance(key))


def test_the_larger_group_is_eliminated_first(rng: np.random.Generator) -> None:
    for poses, landmarks, landmarks_first in ((3, 12, True), (15, 3, False)):
        problem = Problem(rng, poses, landmarks)
        found = either(problem.graph, problem.values)
        assert isinstance(found, GraphMarginals)
        assert (found.inverse is not None) is landmarks_first


# --------------------------------------------------------------------------------------------
# Refused


@pytest.mark.parametrize("first", BOTH)
def test_a_graph_without_a_prior_is_refused(first: bool, rng: np.random.Generator) -> None:
    problem = Problem(rng)
    problem.graph.remove(0)
    loose = gtsam.NonlinearFactorGraph()
    for row in range(problem.graph.size()):
        if problem.graph.exists(row):
            loose.add(problem.graph.at(row))
    with pytest.raises(EstimatorError, match="determine"):
        whole(first, loose, problem.values).poses()


@pytest.mark.parametrize("first", BOTH)
def test_a_landmark_seen_once_by_one_camera_is_refused(
    first: bool, rng: np.random.Generator
) -> None:
    """Two numbers for three unknowns: its distance is open."""
    problem = Problem(rng)
    key = landmark_key(99)
    wTc = problem.values.atPose3(problem.poses[0]).matrix()
    problem.values.insert(key, g.transform_to_world(wTc, np.array([[0.13, 0.21, 3.1]]))[0])
    top = RawPixelFactors(RIG, 0.37, Whitening()).top(
        problem.poses[0], key, np.array([171.0, 147.0])
    )
    problem.graph.add(top)
    with pytest.raises(EstimatorError, match="determine"):
        whole(first, problem.graph, problem.values).poses()


def test_landmarks_that_depend_on_each_other_are_refused(rng: np.random.Generator) -> None:
    """Only by the elimination of landmarks first; that of poses first takes them."""
    problem = Problem(rng)
    between = gtsam.BetweenFactorPoint3(
        problem.landmarks[1],
        problem.landmarks[2],
        np.array([0.1, 0.2, 0.3]),
        gtsam.noiseModel.Isotropic.Sigma(3, 0.1),
    )
    problem.graph.add(between)
    with pytest.raises(EstimatorError, match="depend on each other"):
        whole(True, problem.graph, problem.values)
    reference = problem.reference()
    chain = whole(False, problem.graph, problem.values).landmarks()
    for n, key in enumerate(problem.landmarks):
        assert_same(chain[n], reference.marginalCovariance(key))


@pytest.mark.parametrize("ends", [[(0, 3)], [(0, 2), (2, 4)], [(1, 4), (0, 4), (0, 2)]])
def test_poses_that_close_loops(rng: np.random.Generator, ends: list[tuple[int, int]]) -> None:
    """The elimination of poses first keeps those led back to for last."""
    problem = Problem(rng, poses=6)
    for before, after in ends:
        loop = Odometry(g.se3_exp(0.02 * rng.standard_normal(6)), random_covariance(rng, 6, 0.05))
        problem.graph.add(odometry_factor(problem.poses[before], problem.poses[after], loop))
    reference = problem.reference()
    for first in BOTH:
        found = whole(first, problem.graph, problem.values)
        for k, key in enumerate(problem.poses):
            assert_same(found.poses()[k], reference.marginalCovariance(key))
        for n, key in enumerate(problem.landmarks):
            assert_same(found.landmarks()[n], reference.marginalCovariance(key))


def test_what_is_not_determined_is_refused(rng: np.random.Generator) -> None:
    root = rng.standard_normal((6, 6))
    matrix = root @ root.T + np.eye(6)
    matrix[4] = matrix[:, 4] = 0.0
    with pytest.raises(UndeterminedError, match="determine"):
        scaled_cholesky(matrix)


def test_nothing_is_inverted_without_a_word_on_the_terminal(
    capfd: pytest.CaptureFixture[str],
) -> None:
    assert from_cholesky(*scaled_cholesky(np.zeros((0, 0)))).shape == (0, 0)
    written = capfd.readouterr()
    assert written.out + written.err == ""
