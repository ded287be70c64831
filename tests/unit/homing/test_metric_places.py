"""Metres on a route whose images carry poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fgslam as fg
from fgslam.core.errors import StoredMapError
from fgslam.core.geometry import pose, so3_exp
from fgslam.homing.places import LEFT_SIGMA, metric_place
from fgslam.homing.route import MetricPoses, PathMemory


def three_poses(sigma: float = 0.1) -> MetricPoses:
    """2 m apart along x, the last one unknown."""
    poses = np.stack(
        [pose(so3_exp(np.array([0.0, k, 0.0])), [2.0 * k, 0.0, 1.0]) for k in range(3)]
    )
    poses[2] = np.nan
    return MetricPoses(poses, np.repeat(sigma**2 * np.eye(6)[None], 3, axis=0))


def test_part_of_a_leg_becomes_metres_with_its_deviation() -> None:
    place = metric_place(three_poses(), 1, 0.25)
    assert place is not None
    np.testing.assert_allclose(place.position, [1.5, 0.0, 1.0], rtol=0, atol=1e-12)
    assert place.to_target == pytest.approx(0.5)
    assert place.sigma == pytest.approx(np.sqrt((2.0 * LEFT_SIGMA) ** 2 + 3 * 0.1**2))


@pytest.mark.parametrize(("target", "left"), [(0, 0.5), (1, np.nan), (2, 0.5)])
def test_what_is_not_known_has_no_metres(target: int, left: float) -> None:
    assert metric_place(three_poses(), target, left) is None
    assert metric_place(None, target, left) is None


def test_poses_survive_the_route_s_file_and_damage_is_refused(tmp_path: Path) -> None:
    from tests.landmark_world import landmark_features

    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-3, 3, (60, 2)), np.full(60, 0.5)])
    images = tuple(landmark_features(points, np.zeros(3), 5.0, 0.0, rng) for _ in range(3))
    memory = PathMemory(images, ("a", "b", "c"), None, three_poses())
    memory.save(tmp_path / "r.fgpath")
    again = fg.PathMemory.load(tmp_path / "r.fgpath")
    assert again.metric is not None
    np.testing.assert_array_equal(again.metric.poses, three_poses().poses)
    np.testing.assert_array_equal(again.metric.covariances, three_poses().covariances)
    with np.load(tmp_path / "r.fgpath") as file:
        arrays = dict(file)
    for name, value in (("metric_poses", 2.0), ("metric_covariances", -1.0)):
        spoiled = {**arrays, name: value * arrays[name]}
        np.savez(tmp_path / "bad.npz", **spoiled)
        with pytest.raises(StoredMapError, match=f"array {name}"):
            PathMemory.load(tmp_path / "bad.npz")
    np.savez(tmp_path / "bad.npz", **{**arrays, "metric_poses": arrays["metric_poses"][:2]})
    with pytest.raises(StoredMapError, match="metric_poses"):
        PathMemory.load(tmp_path / "bad.npz")
