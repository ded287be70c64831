"""Graphs of other programs: read with the steps of their robot, solved by iSAM2 and at once.

g2o, TORO and GTSAM's own text files: poses in the plane or in space, edges, landmarks.
"""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.files import read_lines, read_text
from fgslam.core.geometry import compose_covariance
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, Measured, Odometry
from fgslam.core.types import NO_LANDMARKS, Estimate, Trajectory
from fgslam.factors.graphs import solver_parameters
from fgslam.factors.models import Height, Range, RangeBearing

_IN_SPACE = re.compile(r"^(EDGE3|VERTEX3|EDGE_SE3|VERTEX_SE3)", re.MULTILINE)
_TAGS = (
    "VERTEX", "VERTEX2", "VERTEX_SE2", "VERTEX_XY", "VERTEX3", "VERTEX_SE3:QUAT", "LANDMARK", "BR",
    "EDGE", "EDGE2", "EDGE_SE2", "ODOMETRY", "EDGE3", "EDGE_SE3:QUAT", "EQUIV", "FIX",
    "VERTEX_TRACKXYZ", "EDGE_SE3_TRACKXYZ", "PARAMS_SE3OFFSET",
)  # fmt: skip
"""What GTSAM reads; it passes over the rest."""
_LANDMARK = 1 << 56  # keys of landmarks have a character
_FIRST_SIGMA = 1e-4  # radians and metres: the first pose is the world's
_SHOWN = 40  # poses whose covariances are found
_PLANAR = np.array([3, 4, 2])  # of GTSAM's x, y, turn among [rotation, translation]
_STIFF = 1e-8  # radians and metres squared
_CITY_SIGMAS = np.array([1.0 / 30.0, 1.0 / 30.0, 1.0 / 100.0])  # GTSAM's example of this file


@dataclass(frozen=True, slots=True, eq=False)
class StepGraph:
    """Factors of a graph by the step in which they arrive.

    Attributes:
        steps: key of each pose, ascending, and the factors between it and earlier ones.
        vertices: GTSAM's values that the file gives.
        planar: poses are in the plane.
    """

    steps: dict[int, list[Any]]
    vertices: Any
    planar: bool

    @property
    def size(self) -> int:
        """Number of measurements."""
        return sum(map(len, self.steps.values()))

    def first(self, count: int | None) -> StepGraph:
        """The graph of the first so many steps; of all for None."""
        return replace(self, steps=dict(list(self.steps.items())[:count]))


@dataclass(frozen=True, slots=True, eq=False)
class SolvedGraph:
    """An answer: poses, covariances of some, chi-square, and seconds of CPU of each step."""

    values: Any
    estimate: Estimate
    chi_square: float
    step_s: FloatArray


def read_graph(path: Path) -> StepGraph:
    """The graph of a file: `.g2o`, TORO's `.graph`, GTSAM's `.txt`.

    Raises:
        DatasetError: it is missing or no graph, or its poses are not connected one after another.
    """
    text = read_text(path, remedy="give a graph: .g2o, TORO's .graph")
    in_space = bool(_IN_SPACE.search(text))
    for number, line in read_lines(path):
        if (tag := line.split()[0]) not in _TAGS:
            raise DatasetError(
                f"{path}, line {number}: {tag} is not read; leave it out, or write one of "
                f"{', '.join(_TAGS)}"
            )
    try:
        if re.search(r"^EDGE2 \d+ \d+ \d+ \d+ \d+ ", text, re.MULTILINE) and not in_space:
            graph, vertices = _city(path), gtsam.Values()
        else:
            # Of the plane GTSAM takes the numbers of an edge as covariances but in files of g2o.
            as_g2o = in_space or path.suffix == ".g2o"
            graph, vertices = (
                gtsam.readG2o(str(path), in_space) if as_g2o else gtsam.load2D(str(path))
            )
    except (RuntimeError, ValueError, IndexError) as fault:
        raise DatasetError(f"{path}: no graph ({fault}); give VERTEX and EDGE lines") from None
    steps: dict[int, list[Any]] = {}
    for k in range(graph.size()):
        one = graph.at(k)
        steps.setdefault(max(i for i in list(one.keys()) if i < _LANDMARK), []).append(one)
    if not steps:
        raise DatasetError(f"{path}: holds no edge; give a graph: .g2o, TORO's .graph")
    ordered = {key: sorted(steps[key], key=lambda one: max(one.keys()) >= _LANDMARK)
               for key in sorted(steps)}  # fmt: skip
    return StepGraph(ordered, vertices, not in_space)


def _city(path: Path) -> Any:
    """City10000 with several measurements an edge, of which the first is taken, as GTSAM does."""
    graph, noise = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.Diagonal.Sigmas(_CITY_SIGMAS)
    for _, line in read_lines(path):
        words = line.split()
        motion = gtsam.Pose2(*map(float, words[6:9]))
        graph.add(gtsam.BetweenFactorPose2(int(words[1]), int(words[3]), motion, noise))
    return graph


def solve_by_steps(graph: StepGraph) -> SolvedGraph:
    """iSAM2 with GTSAM's defaults: variables that move by 0.1 are relinearised every ten steps.

    Raises:
        DatasetError: a pose or landmark has no edge from which it could begin.
    """
    solver, known, seconds = gtsam.ISAM2(gtsam.ISAM2Params()), dict[int, Any](), []
    new, starts = gtsam.NonlinearFactorGraph(), gtsam.Values()
    first = _first(graph)
    new.add(_prior(graph, first))
    known[first] = _origin(graph, first)
    starts.insert(first, known[first])
    at = solver.calculateEstimatePose2 if graph.planar else solver.calculateEstimatePose3
    for key, factors in graph.steps.items():
        for one in factors:
            new.add(one)
            for fresh in (k for k in list(one.keys()) if k not in known):
                known[fresh] = _begun(graph, one, fresh, known)
                starts.insert(fresh, known[fresh])
        begun = time.process_time()
        solver.update(new, starts)
        known[key] = at(key)
        seconds.append(time.process_time() - begun)
        new, starts = gtsam.NonlinearFactorGraph(), gtsam.Values()
    return _solved(graph, first, solver.calculateEstimate(), solver.marginalCovariance, seconds)


def solve_at_once(graph: StepGraph, start: Any) -> SolvedGraph:
    """Levenberg-Marquardt over the whole graph from values, as those of :func:`solve_by_steps`."""
    first = min(start.keys())
    whole, begun = _whole(graph, first), time.process_time()
    found = gtsam.LevenbergMarquardtOptimizer(whole, start, solver_parameters(100, 1e-9)).optimize()
    seconds = [time.process_time() - begun]
    return _solved(graph, first, found, gtsam.Marginals(whole, found).marginalCovariance, seconds)


def motions_chained(path: Path) -> FloatArray:
    """Poses (n, 4, 4) by the edges from each pose to the next alone: of a graph without noise."""
    poses = {0: np.eye(4)}
    for key, factors in read_graph(path).steps.items():
        for one in factors:
            if list(one.keys()) == [key - 1, key]:
                poses[key] = poses[key - 1] @ _matrix(one.measured())
    return np.array(list(poses.values()))


def log_of(graph: StepGraph) -> MeasurementLog:
    """What a graph measures of landmarks in the plane, for every estimator.

    A frame for each pose that sees any, with the edges since the last one as its odometry; what a
    plane excludes is stiff.

    Raises:
        DatasetError: an edge closes a loop, which a log does not hold, or the graph is in space.
    """
    log = MeasurementLog()
    motion, noise, before = np.eye(4), np.zeros((6, 6)), _first(graph)
    for key, factors in {before: [], **graph.steps}.items():
        seen = [one for one in factors if max(one.keys()) >= _LANDMARK]
        for one in (one for one in factors if max(one.keys()) < _LANDMARK):
            if not graph.planar or list(one.keys()) != [before, key]:
                raise DatasetError(f"the edge to pose {key} closes a loop: solve it as a graph")
            added = _STIFF * np.eye(6)
            added[np.ix_(_PLANAR, _PLANAR)] = one.noiseModel().covariance()
            step, before = _matrix(one.measured()), key
            motion, noise = motion @ step, compose_covariance(step, noise, added)
        if seen or not len(log):
            found = [one.measured() for one in seen]
            values = [(z.range(), z.bearing().theta()) for z in found]
            sigmas = [one.noiseModel().sigmas()[::-1] for one in seen]
            ids = [max(one.keys()) % _LANDMARK for one in seen]
            measured = [seen_in_plane(values, sigmas, ids)] if seen else []
            odometry = Odometry(motion, noise) if len(log) else None
            log.append(Increment.of(key, float(key), odometry, measured))
            motion, noise = np.eye(4), np.zeros((6, 6))
    return log


def seen_in_plane(
    values: npt.ArrayLike, sigmas: npt.ArrayLike, landmarks: npt.ArrayLike
) -> Measured:
    """Ranges and bearings (k, 2) of landmarks as high as the sensor; their deviations alike."""
    whole = np.insert(values, 2, 0.0, axis=1)
    spread = np.insert(np.square(sigmas), 2, _STIFF, axis=1)
    return RangeBearing().measured(whole, spread[:, :, None] * np.eye(3), landmarks)


def range_in_plane(distance_m: float, sigma_m: float, landmark: int) -> tuple[Measured, Measured]:
    """A range, of a sensor whose offset and scale are unknown, of a landmark as high as it is."""
    ranges = Range(offset_sigma_m=3.0, scale_sigma=0.1)
    flat = Height().measured(0.0, [[_STIFF]], [landmark])
    return ranges.measured(distance_m, [[sigma_m**2]], [landmark]), flat


def _begun(graph: StepGraph, factor: Any, key: int, known: dict[int, Any]) -> Any:
    """Where a variable begins: at the other end of its first edge."""
    a, b = (*factor.keys(), -1)[:2]
    other = known.get(a if key == b else b)
    if other is not None and hasattr(factor, "measured"):
        z = factor.measured()
        if key < _LANDMARK:
            return other.compose(z if key == b else z.inverse())
        if hasattr(z, "bearing"):
            way = z.bearing()
            ahead = way.rotate(np.array([1.0, 0.0])) if graph.planar else way.point3()
            return other.transformFrom(z.range() * ahead)
    raise DatasetError(
        f"variable {key % _LANDMARK} has no edge to an earlier one from which it could begin; "
        "number the poses along the drive, with an edge from each to the next"
    )


def _first(graph: StepGraph) -> int:
    return int(min(min(one.keys()) for factors in graph.steps.values() for one in factors))


def _origin(graph: StepGraph, first: int) -> Any:
    known = graph.vertices
    if graph.planar:
        return known.atPose2(first) if known.exists(first) else gtsam.Pose2()
    return known.atPose3(first) if known.exists(first) else gtsam.Pose3()


def _prior(graph: StepGraph, first: int) -> Any:
    make, n = (gtsam.PriorFactorPose2, 3) if graph.planar else (gtsam.PriorFactorPose3, 6)
    noise = gtsam.noiseModel.Isotropic.Sigma(n, _FIRST_SIGMA)
    return make(first, _origin(graph, first), noise)


def _whole(graph: StepGraph, first: int) -> Any:
    whole = gtsam.NonlinearFactorGraph()
    whole.add(_prior(graph, first))
    for factors in graph.steps.values():
        for one in factors:
            whole.add(one)
    return whole


def _solved(
    graph: StepGraph, first: int, values: Any, marginal: Any, seconds: list[float]
) -> SolvedGraph:
    keys = sorted({first, *graph.steps})
    poses = np.array(
        [_matrix(values.atPose2(k) if graph.planar else values.atPose3(k)) for k in keys]
    )
    covariances = np.full((len(keys), 6, 6), np.nan)
    for row in np.unique(np.linspace(0, len(keys) - 1, _SHOWN).astype(int)):
        found = marginal(keys[row])
        covariances[row] = 0.0
        if graph.planar:
            covariances[row][np.ix_(_PLANAR, _PLANAR)] = found
        else:
            covariances[row] = found
    estimate = Estimate(Trajectory(np.array(keys, np.float64), poses), covariances, NO_LANDMARKS)
    chi_square = 2.0 * _whole(graph, first).error(values)
    return SolvedGraph(values, estimate, chi_square, np.array(seconds))


def _matrix(pose: Any) -> FloatArray:
    """(4, 4) of a pose of GTSAM, in the plane or in space."""
    return np.asarray((gtsam.Pose3(pose) if isinstance(pose, gtsam.Pose2) else pose).matrix())
