"""What two maps both saw counts once when they are merged; what only one saw counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated import (
    RIG,
    TURN_AND_GO,
    Drive,
    Identities,
    Simulation,
    points_in_views,
)
from smoothing import answer

from fgslam.backend.settings import BatchSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.saved_map import SavedMap, load_map, save_map
from fgslam.core.types import LandmarkAppearances, LandmarkMap
from fgslam.frontend.places.merging import align_maps, merge_maps
from fgslam.runs.session import merge_files

POINTS = 250
HALF_BAND = (
    0.2  # each visit's own NEES per number strays from 1 by 0.1 (50 seeds), fused by as much
)


class Place:
    """Points with looks, along a drive that is made again and again."""

    def __init__(self, seed: int, frames: int = 12) -> None:
        self.rng = np.random.default_rng(seed)
        self.drive = Drive(frames=frames, points=POINTS)
        step = g.se3_exp(np.array(TURN_AND_GO))
        self.poses = [np.eye(4)]
        for _ in range(frames - 1):
            self.poses.append(g.reorthonormalise(self.poses[-1] @ step))
        self.points = points_in_views(self.drive, self.poses, self.rng)
        looks = self.rng.exponential(1.0, (POINTS, 128))
        self.looks = 512.0 * looks / np.linalg.norm(looks, axis=1, keepdims=True)
        self.size = self.rng.uniform(2.0, 8.0, POINTS)

    def visit(self, pTw: FloatArray, noise: float = 1.0) -> tuple[SavedMap, IntArray]:
        """A map of a drive that begins at a pose, and the point of each landmark."""
        drive = replace(self.drive, noise=noise)
        book = Identities(drive, g.transform_to_camera(pTw, self.points))
        step = g.se3_exp(np.array(TURN_AND_GO))
        seen = [book.increment(k, wTc, step, self.rng) for k, wTc in enumerate(self.poses)]
        simulation = Simulation(drive, np.array(self.poses), self.points, seen)
        estimate = answer(BatchSettings(), simulation.increments)
        which = book.book.point_of_id[estimate.landmarks.ids]
        every = np.concatenate([i.observations.ids for i in seen])
        n, ids = len(which), estimate.landmarks.ids
        looks = self.looks[which] + 8.0 * self.rng.standard_normal((n, 128))
        return SavedMap(
            rig=RIG,
            landmarks=estimate.landmarks,
            appearances=LandmarkAppearances(
                ids,
                np.clip(looks, 0, 255).astype(np.uint8),
                self.size[which],
                np.zeros(n),
                np.tile([0.0, 0.0, 1.0], (n, 1)),
            ),
            hits=np.array([(every == one).sum() for one in ids]),
            misses=np.zeros(n, np.int64),
            permanent=np.zeros(n, np.bool_),
            colour=np.zeros(n, np.uint8),
            trajectory=estimate.trajectory,
            about={"drives": [{"name": "visit"}]},
            evidence=np.sort(self.rng.integers(1, 2**60, len(seen))),
        ), which


def merged(a: SavedMap, b: SavedMap) -> tuple[SavedMap, IntArray]:
    found = align_maps(a, b, np.random.default_rng(0), "a and b")
    return merge_maps(a, b, found), found.pairs


def nees(landmarks: LandmarkMap, truth: FloatArray) -> float:
    """Mean normalised squared error of one number: 1 where the covariances are right."""
    error = landmarks.positions - truth
    information = np.linalg.inv(landmarks.covariances)
    return float(np.einsum("ni,nij,nj->n", error, information, error).mean() / 3.0)


def of_independent_visits(seed: int, frames: int) -> tuple[float, float, float]:
    """NEES of the two visits' landmarks, and of what is fused of both."""
    place = Place(seed, frames)
    a, true_a = place.visit(np.eye(4))
    b, true_b = place.visit(place.poses[3])
    both, pairs = merged(a, b)
    mine = pairs[:, 0]
    assert (true_a[mine] == true_b[pairs[:, 1]]).mean() > 0.95
    assert (np.linalg.det(both.landmarks.covariances[mine]) < det(a, mine)).all()
    fused = LandmarkMap(
        a.landmarks.ids[mine],
        both.landmarks.positions[mine],
        both.landmarks.covariances[mine],
    )
    local_b = g.transform_to_camera(place.poses[3], place.points[true_b])
    return (
        nees(a.landmarks, place.points[true_a]),
        nees(b.landmarks, local_b),
        nees(fused, place.points[true_a[mine]]),
    )


def det(saved: SavedMap, rows: IntArray) -> FloatArray:
    return np.asarray(np.linalg.det(saved.landmarks.covariances[rows]))


def test_independent_visits_fused_are_as_uncertain_as_they_say() -> None:
    found = np.array([of_independent_visits(seed, 12) for seed in range(2)])
    assert abs(found[:, 2].mean() - 1.0) < HALF_BAND


@pytest.mark.slow
@pytest.mark.parametrize("frames", [12, 40])
def test_fifty_independent_visits_fused_are_as_uncertain_as_they_say(frames: int) -> None:
    """Short drives, whose landmarks' own noise prevails, and long ones, in which drift does."""
    found = np.array([of_independent_visits(seed, frames) for seed in range(50)])
    print(f"NEES of the visits {found[:, :2].mean(axis=0)}, fused {found[:, 2].mean():.3f}")
    assert abs(found[:, 2].mean() - 1.0) < HALF_BAND
    assert abs(found[:, 2].mean() - found[:, :2].mean()) < HALF_BAND


def test_a_map_merged_with_itself_stays_as_it_is(tmp_path: Path) -> None:
    saved, _ = Place(0).visit(np.eye(4))
    save_map(saved, tmp_path / "a.fgmap")
    lines = merge_files(tmp_path / "a.fgmap", tmp_path / "a.fgmap", tmp_path / "b.fgmap")
    assert "all 12 frames" in lines[0]
    assert "count once" in lines[0]
    assert (tmp_path / "b.fgmap").read_bytes() == (tmp_path / "a.fgmap").read_bytes()
    assert merged(saved, saved)[0] is saved


def grown(place: Place, before: SavedMap) -> SavedMap:
    """A map that holds all of another's frames and those of one more visit."""
    more, _ = place.visit(np.eye(4))
    assert before.evidence is not None
    assert more.evidence is not None
    both = merged(before, more)[0]
    assert both.evidence is not None
    assert len(both.evidence) == len(before.evidence) + len(more.evidence)
    return both


def test_maps_that_grew_from_one_another_count_what_they_share_once() -> None:
    place = Place(1)
    seed, true = place.visit(np.eye(4))
    one, other = grown(place, seed), grown(place, seed)
    both, pairs = merged(one, other)
    mine = pairs[:, 0]
    assert len(pairs) > 200
    # No fusion of unknown correlation is better than the better of the two.
    least = np.minimum(det(one, mine), det(other, pairs[:, 1]))
    assert (det(both, mine) > 0.95 * least).all()
    known = mine < len(seed)
    rows = mine[known]
    fused = LandmarkMap(
        one.landmarks.ids[rows],
        both.landmarks.positions[rows],
        both.landmarks.covariances[rows],
    )
    assert nees(fused, place.points[true[rows]]) < 1.0 + HALF_BAND
    assert both.hits[mine].max() <= max(one.hits.max(), other.hits.max())
    back = merged(other, seed)[0]
    assert back is other


@pytest.mark.parametrize(("start", "counted_once"), [(1.6e9, True), (0.0, False)])
def test_one_recording_read_in_two_ways_counts_once(
    start: float, counted_once: bool, tmp_path: Path
) -> None:
    """Told by the moments, where they are of the world's clock: its images differ."""
    saved, _ = Place(0).visit(np.eye(4))
    drive = replace(saved.trajectory, timestamps=start + saved.trajectory.timestamps)
    one = replace(saved, trajectory=drive)
    assert saved.evidence is not None
    save_map(one, tmp_path / "a.fgmap")
    save_map(replace(one, evidence=saved.evidence + 1), tmp_path / "b.fgmap")
    lines = merge_files(tmp_path / "a.fgmap", tmp_path / "b.fgmap", tmp_path / "both.fgmap")
    assert any("12 poses of" in line and "count once" in line for line in lines) == counted_once
    hits = load_map(tmp_path / "both.fgmap").hits
    assert np.array_equal(hits, saved.hits if counted_once else 2 * saved.hits)
