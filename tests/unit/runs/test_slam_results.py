"""Truth by rendered depth, and truth laid onto a map's drive: where it is known, and how well."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import RIG

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.log import MeasurementLog
from fgslam.core.saved_map import SavedMap
from fgslam.core.sensors import Increment, Observations
from fgslam.core.types import LandmarkAppearances, LandmarkMap, Trajectory
from fgslam.frontend.settings import DatabaseSettings, FrontendSettings
from fgslam.runs.tasks.slam_results import (
    alignment_slack,
    at_edges,
    medians_of,
    points_under,
    rendered_landmark_truth,
    true_sights,
)


def test_the_point_under_a_pixel_of_a_plane_is_exact(rng: np.random.Generator) -> None:
    # Plane n . p = 2, slanted by some twenty degrees.
    normal = np.array([0.3, -0.2, 1.0])
    rows, columns = np.mgrid[0 : RIG.height, 0 : RIG.width]
    rays = np.dstack([(columns - RIG.cx) / RIG.fx, (rows - RIG.cy) / RIG.fy, np.ones(rows.shape)])
    depth = 2.0 / (rays @ normal)
    pixels = rng.uniform([5.0, 5.0], [RIG.width - 6.0, RIG.height - 6.0], (50, 2))
    points, known = points_under(RIG, depth, pixels)
    assert known.all()
    np.testing.assert_allclose(points @ normal, 2.0, atol=1e-9)
    seen = RIG.fx * points[:, 0] / points[:, 2] + RIG.cx
    np.testing.assert_allclose(seen, pixels[:, 0], atol=1e-9)


def test_at_an_edge_or_without_depth_the_point_is_not_known() -> None:
    depth = np.full((RIG.height, RIG.width), 2.0)
    depth[:, 100:] = 3.0
    depth[50, 50] = np.nan
    pixels = np.array([[99.5, 20.0], [98.5, 20.0], [49.5, 49.5], [-0.5, 3.0], [319.0, 3.0]])
    points, known = points_under(RIG, depth, pixels)
    assert known.tolist() == [False, True, False, False, False]
    assert np.isnan(points[~known]).all()
    assert points[1, 2] == pytest.approx(2.0)


def test_a_place_is_at_an_edge_where_a_patch_around_it_shows_two_surfaces() -> None:
    columns = np.tile(np.arange(RIG.width), (RIG.height, 1))
    depth = 4.0 / (1.0 + 0.1 * columns)  # slanted by up to 9 % a pixel: no edge
    depth[100:, 150:] /= 1.5  # something before it, from the pixel 150 on; it bends at 149
    depth[20, 20] = np.nan
    places = {
        (60.2, 30.0): False, (142.0, 150.0): False, (143.0, 150.0): True, (156.0, 150.0): True,
        (157.0, 150.0): False, (170.0, 92.3): False, (170.0, 93.0): True, (170.0, 110.0): False,
        (26.0, 20.0): True, (30.0, 20.0): False, (0.0, 0.0): False,
    }  # fmt: skip
    assert at_edges(depth, np.array(list(places))).tolist() == list(places.values())


def test_landmarks_mostly_seen_at_edges_have_no_truth() -> None:
    ids, points = np.repeat([7, 8, 9], [5, 4, 2]), np.zeros((11, 3))
    split = np.array([True, True, True, False, False, True, True, False, False, False, False])
    truth, _ = medians_of(ids, points, split)
    assert truth.ids.tolist() == [8]  # half of the sightings do; the last one has too few


class OneWall:
    """Three frames from one place, and something before the right half of what they see."""

    rig = RIG
    ground_truth = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))

    def depth(self, i: int) -> FloatArray:
        depth = np.full((RIG.height, RIG.width), 4.0)
        depth[:, 150:] = 2.0
        return depth


def test_rendered_truth_is_of_landmarks_on_one_surface() -> None:
    places = np.array([[60.0, 50.0, 1.0], [147.0, 50.0, 1.0], [200.0, 80.0, 1.0]])
    none = np.empty(0, np.int64)
    seen = Observations(
        np.arange(3), places, np.tile(np.eye(3), (3, 1, 1)), np.full((3, 3, 2), np.nan),
        np.zeros(3, np.bool_),
    )  # fmt: skip
    frames = [
        Increment(k, float(k), None, seen, np.zeros(3, np.bool_), none, none) for k in range(3)
    ]
    log = MeasurementLog(RIG, {}, frames)
    found = rendered_landmark_truth(OneWall(), log)  # type: ignore[arg-type]
    assert found is not None
    truth, sigma = found
    assert truth.ids.tolist() == [0, 2]
    np.testing.assert_allclose(truth.positions[:, 2], [4.0, 2.0])
    np.testing.assert_array_equal(sigma, 0.0)


def test_landmarks_in_view_are_in_every_image_and_not_hidden() -> None:
    seen_before, seen_from_behind, hidden, below_the_top_image = range(4)
    depth = np.full(4, 4.0)  # metres; the wall's right half has something before it
    pixels = np.array([[60.0, 50.0], [90.0, 80.0], [200.0, 50.0], [60.0, RIG.height - 4.0]])
    points = RIG.triangulate(np.column_stack([pixels, RIG.fx * RIG.baseline / depth]))
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    directions[seen_from_behind] *= -1.0
    ids, n = np.arange(4), len(points)
    landmarks = LandmarkMap(ids, points, np.tile(1e-4 * np.eye(3), (n, 1, 1)))
    saved = SavedMap(
        RIG,
        landmarks,
        LandmarkAppearances(
            ids, np.zeros((n, 128), np.uint8), np.full(n, 12.0), np.zeros(n), directions
        ),
        hits=np.full(n, 9),
        misses=np.zeros(n, np.int64),
        farthest=np.full(n, 9.0),
        permanent=np.zeros(n, np.bool_),
        colour=np.zeros(n, np.uint8),
        trajectory=OneWall.ground_truth,
        about={},
        evidence=np.empty(0, np.int64),
    )
    settings, found = FrontendSettings(database=DatabaseSettings(viewpoints=True)), {}
    for which in range(4):
        one = landmarks.select(np.array([which]))
        in_view = true_sights(saved, one, OneWall(), settings)  # type: ignore[arg-type]
        found[which] = in_view(0, np.eye(4))
    assert found == {
        seen_before: (1, 1), seen_from_behind: (1, 0), hidden: (0, 0), below_the_top_image: (0, 0)
    }  # fmt: skip
    assert in_view(0, np.full((4, 4), np.nan)) == (-1, -1)


def test_a_straight_drive_leaves_the_roll_open_and_a_bent_one_does_not() -> None:
    rng = np.random.default_rng(2)
    along = np.linspace(0.0, 2.0, 30)
    straight = np.column_stack([0.0 * along, 0.0 * along, along])
    bent = np.column_stack([0.5 * along**2, 0.0 * along, along])
    error = 0.002 * rng.standard_normal((30, 3))
    assert alignment_slack(straight, straight) == np.inf
    assert alignment_slack(straight + error, straight + 2e-4 * error[::-1]) > 1.0
    assert alignment_slack(bent + error, bent) < 0.05


def test_slack_is_the_angle_that_a_turn_about_the_line_leaves() -> None:
    along = np.linspace(-1.0, 1.0, 40)
    own = np.column_stack([0.05 * np.cos(40.0 * along), 0.0 * along, along])
    turn = g.pose(g.so3_exp(np.array([0.0, 0.0, 0.03])), np.zeros(3))
    assert alignment_slack(g.transform_to_world(turn, own), own) == pytest.approx(0.03, rel=0.05)
