"""Graphs of other programs: read with their steps, solved step by step and at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fgslam as fg
from fgslam.backend.step_graph import (
    log_of,
    motions_chained,
    read_graph,
    solve_at_once,
    solve_by_steps,
)
from fgslam.core.errors import DatasetError

SQUARE = "".join(
    f"EDGE_SE2 {k} {k + 1} 1.0 {0.02 * (k % 3)} {np.pi / 2} 100 0 0 100 0 400\n" for k in range(4)
)
CLOSED = SQUARE + "EDGE_SE2 4 0 0 0 0 1e6 0 0 1e6 0 1e6\n"


def written(folder: Path, text: str, name: str = "a.g2o") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def test_a_closed_square_is_closed_by_both_solvers(tmp_path: Path) -> None:
    """By hand: the closing edge is stiff, so that the last pose is the first."""
    graph = read_graph(written(tmp_path, CLOSED))
    assert list(graph.steps) == [1, 2, 3, 4]
    assert graph.size == 5
    online = solve_by_steps(graph)
    batch = solve_at_once(graph, online.values)
    for found in (online, batch):
        poses = found.estimate.trajectory.poses
        np.testing.assert_allclose(poses[4], poses[0], atol=1e-3)
    assert 0.0 < batch.chi_square <= online.chi_square + 1e-9
    assert len(online.step_s) == 4
    open_graph = solve_by_steps(read_graph(written(tmp_path, SQUARE, "open.g2o")))
    assert open_graph.chi_square == pytest.approx(0.0, abs=1e-9)


def test_covariances_are_those_of_dead_reckoning_where_nothing_closes(tmp_path: Path) -> None:
    one = written(tmp_path, "EDGE_SE2 0 1 1 0 0 100 0 0 25 0 400\n")
    found = solve_by_steps(read_graph(one)).estimate.covariances[1]
    expected = np.zeros(6)
    expected[[2, 3, 4]] = 1 / 400, 1 / 100, 1 / 25
    np.testing.assert_allclose(np.diagonal(found), expected, atol=1e-7)


def test_landmarks_in_space_begin_at_their_first_sighting(tmp_path: Path) -> None:
    text = (
        "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n"
        "VERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\nVERTEX_TRACKXYZ 2 3 1 0\n"
        "EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 100 0 0 0 0 0 100 0 0 0 0 100 0 0 0 100 0 0 100 0 100\n"
        "EDGE_SE3_TRACKXYZ 0 2 0 3 1 0 100 0 0 100 0 100\n"
        "EDGE_SE3_TRACKXYZ 1 2 0 2 1 0 100 0 0 100 0 100\n"
    )
    found = solve_by_steps(read_graph(written(tmp_path, text)))
    assert found.chi_square == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(found.estimate.trajectory.poses[1][:3, 3], [1, 0, 0], atol=1e-6)


def test_landmarks_in_the_plane_are_a_log_with_the_same_answer(tmp_path: Path) -> None:
    """The EKF's last pose is that of the whole graph; a loop's edge is no measurement of a log."""
    sightings = "".join(
        f"BR {k} {100 + n} {np.arctan2(y, x - k):.6f} {np.hypot(x - k, y):.6f} 0.02 0.05\n"
        for k in range(0, 6, 2) for n, (x, y) in enumerate([(3.0, 2.0), (4.0, -2.0), (8.0, 1.0)])
    )  # fmt: skip
    moves = "".join(
        f"ODOMETRY {k} {k + 1} 1.02 0.01 0.01 0.01 0 0 0.01 0 0.001\n" for k in range(5)
    )
    graph = read_graph(written(tmp_path, moves + sightings, "a.txt"))
    log = log_of(graph)
    assert [one.index for one in log] == [0, 2, 4]
    assert [len(one.measured[0].ids) for one in log] == [3, 3, 3]
    found = fg.replay(log, "ekf").estimate.trajectory
    whole = solve_at_once(graph, solve_by_steps(graph).values).estimate.trajectory
    np.testing.assert_allclose(found.poses[2], whole.poses[4], atol=5e-3)
    with pytest.raises(DatasetError, match="the edge to pose 4 closes a loop: solve it as a graph"):
        log_of(read_graph(written(tmp_path, CLOSED)))


def test_motions_are_chained_without_what_closes_loops(tmp_path: Path) -> None:
    poses = motions_chained(written(tmp_path, CLOSED.replace("0.02", "0.0").replace("0.04", "0.0")))
    np.testing.assert_allclose(poses[4], np.eye(4), atol=1e-9)
    np.testing.assert_allclose(poses[2][:3, 3], [1.0, 1.0, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no edge"),
        ("LANDMARK2 0 1 1 1 1 0 1\n", "line 1: LANDMARK2 is not read; leave it out"),
        ("EDGE_SE2 5 9 1 0 0 1 0 0 1 0 1\nEDGE_SE2 7 8 1 0 0 1 0 0 1 0 1\n", "has no edge to an"),
    ],
)
def test_what_is_no_graph_is_refused_in_a_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        solve_by_steps(read_graph(written(tmp_path, text)))
    with pytest.raises(DatasetError, match="cannot read"):
        read_graph(tmp_path / "absent.g2o")
