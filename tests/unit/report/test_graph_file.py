"""The .g2o file, read back by a parser of its own and by GTSAM; conventions by residuals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import gtsam
import numpy as np
import pytest
from simulated import Drive, simulate

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import OutputError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse, pose, rotation_from_quaternion, se3_exp
from fgslam.core.measurement_log import MeasurementLog
from fgslam.report.formats import (
    EXACT_SIGMA,
    PoseLandmarkGraph,
    g2o_information,
    information_of,
    write_g2o,
)
from fgslam.runs.export import build_graph

Lines = dict[str, list[list[float]]]


def parse(path: Path) -> Lines:
    """Numbers of each line by its tag; comments left out."""
    out: Lines = {}
    for line in path.read_text(encoding="ascii").splitlines():
        tag, *cells = line.split()
        if tag != "#":
            out.setdefault(tag, []).append([float(cell) for cell in cells])
    return out


def from_upper(values: list[float], n: int) -> FloatArray:
    out = np.zeros((n, n))
    out[np.triu_indices(n)] = values
    return out + np.triu(out, 1).T


def pose_of(seven: list[float]) -> FloatArray:
    return pose(rotation_from_quaternion(np.array(seven[3:])), np.array(seven[:3]))


def exact_graph(
    rng: np.random.Generator, noise: float = 0.0
) -> tuple[PoseLandmarkGraph, MeasurementLog, IntArray]:
    """Of a simulated drive, started at the truth; the log; the landmarks that the map holds."""
    drive = dataclasses.replace(Drive(), frames=8, points=60, noise=noise, prune_after=3)
    simulation = simulate(drive, rng)
    log = MeasurementLog(drive.rig, {}, simulation.increments)
    stamps = np.array([increment.timestamp for increment in log])
    held = np.arange(0, len(simulation.points_by_id), 2)
    trajectory = Trajectory(stamps, simulation.poses)
    return build_graph(log, trajectory, held, simulation.points_by_id[held]), log, held


def test_every_measurement_agrees_with_the_truth_in_the_file(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Noise-free: from each edge's own vertices follows exactly what the edge measured."""
    graph, log, _ = exact_graph(rng)
    path = tmp_path / "exact.g2o"
    write_g2o(path, graph, ["a remark"])
    lines = parse(path)
    poses = {int(row[0]): pose_of(row[1:]) for row in lines["VERTEX_SE3:QUAT"]}
    points = {int(row[0]): np.array(row[1:]) for row in lines["VERTEX_TRACKXYZ"]}
    assert lines["FIX"] == [[0.0]]
    assert lines["PARAMS_SE3OFFSET"] == [[0, 0, 0, 0, 0, 0, 0, 1]]
    assert not poses.keys() & points.keys()
    assert len(lines["EDGE_SE3:QUAT"]) == len(log) - 1
    for a, b, *numbers in lines["EDGE_SE3:QUAT"]:
        between = inverse(poses[int(a)]) @ poses[int(b)]
        np.testing.assert_allclose(between, pose_of(numbers[:7]), atol=1e-10)
    assert len(lines["EDGE_SE3_TRACKXYZ"]) == sum(len(s.observations) for s in log)
    for a, b, offset, *numbers in lines["EDGE_SE3_TRACKXYZ"]:
        assert offset == 0
        local = inverse(poses[int(a)]) @ np.append(points[int(b)], 1.0)
        np.testing.assert_allclose(local[:3], numbers[:3], atol=1e-8)
        assert np.linalg.eigvalsh(from_upper(numbers[3:], 3)).min() > 0.0


def test_information_weighs_a_motion_as_our_covariance_does(rng: np.random.Generator) -> None:
    """g2o's error (translation, quaternion's vector part) of a small motion, by its own matrix."""
    root = rng.standard_normal((6, 6)) * np.array([0.01, 0.02, 0.01, 0.1, 0.2, 0.05])[:, None]
    covariance = root @ root.T
    information = g2o_information(covariance[None])[0]
    for _ in range(5):
        xi = 1e-5 * rng.standard_normal(6)
        error = se3_exp(xi)
        quaternion = gtsam.Rot3(error[:3, :3]).toQuaternion()
        vector = np.array([quaternion.x(), quaternion.y(), quaternion.z()])
        theirs = np.concatenate([error[:3, 3], vector])
        ours = xi @ np.linalg.solve(covariance, xi)
        assert theirs @ information @ theirs == pytest.approx(ours, rel=1e-4)


def test_an_exact_direction_gets_a_tiny_sigma() -> None:
    covariance = np.diag([0.0, 4.0, 0.25])[None]
    expected = np.diag([EXACT_SIGMA**-2, 0.25, 4.0])
    np.testing.assert_allclose(information_of(covariance)[0], expected, rtol=1e-12)


def test_gtsam_reads_poses_and_motions(tmp_path: Path, rng: np.random.Generator) -> None:
    graph, _, _ = exact_graph(rng, noise=1.0)
    path = tmp_path / "graph.g2o"
    write_g2o(path, graph)
    factors, values = gtsam.readG2o(str(path), True)
    # It turns a seen point into bearing and range, after all motions.
    assert factors.size() == len(graph.motions) + len(graph.points)
    for row, wTc in enumerate(graph.poses):
        np.testing.assert_allclose(values.atPose3(row).matrix(), wTc, atol=1e-10)
    for row in range(len(graph.motions)):
        factor = factors.at(row)
        assert list(factor.keys()) == [graph.motion_from[row], graph.motion_to[row]]
        np.testing.assert_allclose(factor.measured().matrix(), graph.motions[row], atol=1e-10)
        # It takes the quaternion's vector part for the whole rotation vector: four times.
        theirs = factor.noiseModel().information()
        ours = np.linalg.inv(graph.motion_covariances[row])
        np.testing.assert_allclose(theirs[:3, :3], 4.0 * ours[:3, :3], rtol=1e-6, atol=1e-3)
        np.testing.assert_allclose(theirs[3:, 3:], ours[3:, 3:], rtol=1e-6, atol=1e-3)
    for row in range(len(graph.motions), factors.size()):
        at, landmark = factors.at(row).keys()
        which = gtsam.Symbol(landmark).index() - len(graph.poses)
        seen = graph.points[(graph.seen_from == at) & (graph.seen == which)][0]
        assert factors.at(row).measured().range() == pytest.approx(np.linalg.norm(seen), rel=1e-9)


def test_landmarks_start_on_the_map_or_where_first_seen(rng: np.random.Generator) -> None:
    graph, log, held = exact_graph(rng, noise=1.0)
    ids = np.unique(np.concatenate([increment.observations.ids for increment in log]))
    first = {}
    for row, which, point in zip(graph.seen_from, graph.seen, graph.points, strict=True):
        first.setdefault(which, graph.poses[row, :3, :3] @ point + graph.poses[row, :3, 3])
    forgotten = np.flatnonzero(~np.isin(ids, held))
    assert len(forgotten) > 5
    for which in forgotten:
        np.testing.assert_allclose(graph.landmarks[which], first[which], atol=1e-12)
    mapped = np.flatnonzero(np.isin(ids, held))
    assert not np.allclose(graph.landmarks[mapped], [first[which] for which in mapped], atol=1e-3)


def test_rejected_and_placeless_observations_and_gaps_are_left_out(
    rng: np.random.Generator,
) -> None:
    _, log, held = exact_graph(rng)
    increments = list(log)
    seen = increments[3].observations
    rejected = np.zeros(len(seen), np.bool_)
    rejected[:2] = True
    measurement = seen.measurement.copy()
    measurement[2, 2] = -1.0  # a wrong match: the point would be behind the camera
    increments[3] = dataclasses.replace(
        increments[3],
        rejected=rejected,
        odometry=None,
        observations=dataclasses.replace(seen, measurement=measurement),
    )
    increments[5] = dataclasses.replace(increments[5], relocalised=True)  # it was carried there
    spoilt = MeasurementLog(log.rig, {}, increments)
    stamps = np.array([s.timestamp for s in log])[:-1]  # the last frame has no pose
    trajectory = Trajectory(stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    graph = build_graph(spoilt, trajectory, held, np.zeros((len(held), 3)))
    everything = sum(len(s.observations) for s in increments[:-1])
    assert len(graph.points) == everything - 3
    assert graph.motion_to.tolist() == [1, 2, 4, 6]


def test_an_empty_log_has_a_graph(tmp_path: Path, rng: np.random.Generator) -> None:
    _, log, _ = exact_graph(rng)
    nothing = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    empty = MeasurementLog(log.rig, {}, [])
    graph = build_graph(empty, nothing, np.empty(0, np.int64), np.empty((0, 3)))
    write_g2o(tmp_path / "empty.g2o", graph)
    assert parse(tmp_path / "empty.g2o").keys() == {"PARAMS_SE3OFFSET"}


def test_refusals_name_the_fix(tmp_path: Path, rng: np.random.Generator) -> None:
    graph, _, _ = exact_graph(rng)
    with pytest.raises(OutputError, match=r"unknown graph format '\.txt'; use \.g2o"):
        write_g2o(tmp_path / "graph.txt", graph)
    landmarks = graph.landmarks.copy()
    landmarks[4, 1] = np.nan
    with pytest.raises(OutputError, match="landmarks 4 is not finite"):
        write_g2o(tmp_path / "graph.g2o", dataclasses.replace(graph, landmarks=landmarks))
    assert list(tmp_path.iterdir()) == []
