"""Two maps of one place made into one."""

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
from fgslam.core.arrays import ByteArray, FloatArray, IntArray
from fgslam.core.errors import MapError, OutputError
from fgslam.core.saved_map import SavedMap, load_map, save_map
from fgslam.core.sensors import CameraRig
from fgslam.core.types import (
    CUT_PIXELS,
    LandmarkAppearances,
    LandmarkMap,
    LandmarkPatches,
    Trajectory,
)
from fgslam.frontend.places import merging as map_alignment
from fgslam.frontend.places.merging import Alignment, align_maps, merge_maps, tentative_pairs
from fgslam.runs.session import merge_files

# ------------------------------------------------------------------------------------------
# Two maps of one place are laid onto each other and fused; anything else is refused


LEVEL_RIG = CameraRig(320, 240, 277.1, 277.3, 159.5, 119.5, 0.1, 0.1, np.eye(4))
BTA = g.se3_exp(np.array([0.02, 0.7, -0.01, 1.5, 0.1, -2.0]))
SIGMA_M = 0.01


class World:
    """Points in a room, each with its look; two may look alike."""

    def __init__(self, rng: np.random.Generator, count: int = 400) -> None:
        self.rng = rng
        self.points = rng.uniform([-5, -1, -5], [5, 1, 5], (count, 3))
        signatures = rng.exponential(1.0, (count, 128))
        self.signatures = 512.0 * signatures / np.linalg.norm(signatures, axis=1, keepdims=True)
        self.size = rng.uniform(2.0, 8.0, count)

    def seen(self, which: IntArray, wTm: FloatArray, stamp: float = 0.0) -> SavedMap:
        """A map of these points, in a world of its own that ``wTm`` takes into this one."""
        n, rng = len(which), self.rng
        noise = SIGMA_M * rng.standard_normal((n, 3))
        positions = g.transform_to_camera(wTm, self.points[which]) + noise
        covariances = np.broadcast_to(SIGMA_M**2 * np.eye(3), (n, 3, 3)).copy()
        ids = 3 * np.arange(n) + 1
        signatures = self.signatures[which] + 8.0 * rng.standard_normal((n, 128))
        size = self.size[which] * rng.uniform(0.9, 1.1, n)
        return SavedMap(
            rig=LEVEL_RIG,
            landmarks=LandmarkMap(ids, positions, covariances),
            appearances=appearances(ids, np.clip(signatures, 0, 255).astype(np.uint8), size),
            hits=rng.integers(3, 40, n),
            misses=rng.integers(0, 10, n),
            farthest=np.linspace(1.0, 2.0, n),
            permanent=rng.random(n) < 0.3,
            colour=np.full(n, 90, np.uint8),
            trajectory=Trajectory(stamp + np.arange(5.0), np.tile(np.eye(4), (5, 1, 1))),
            about={"drives": [{"name": "drive", "frames": 5}]},
            evidence=np.sort(rng.integers(1, 2**60, 5)),
        )


def appearances(ids: IntArray, descriptors: ByteArray, size: FloatArray) -> LandmarkAppearances:
    direction = np.tile([0.0, 0.0, 1.0], (len(ids), 1))
    return LandmarkAppearances(ids, descriptors, size, np.zeros(len(ids)), direction)


@pytest.fixture
def world(rng: np.random.Generator) -> World:
    return World(rng)


def test_a_merged_map_has_colours_where_either_has(world: World) -> None:
    first, second = (world.seen(np.arange(k, 280 + k), np.eye(4), 10.0 * k) for k in (0, 120))
    alignment = align(first, second)
    assert merge_maps(first, second, alignment).colours is None
    second = replace(second, colours=np.full((280, 3), (1, 2, 3), np.uint8))
    merged = merge_maps(first, second, alignment)
    assert merged.shown[0].tolist() == [90, 90, 90]
    assert merged.shown[-1].tolist() == [1, 2, 3]


def align(a: SavedMap, b: SavedMap, seed: int = 0) -> Alignment:
    return align_maps(a, b, np.random.default_rng(seed), "a and b")


def test_two_overlapping_maps_are_aligned_within_their_noise(world: World) -> None:
    first, second = np.arange(0, 280), np.arange(180, 400)
    a, b = world.seen(first, np.eye(4)), world.seen(second, BTA)
    found = align(a, b)
    error = g.se3_log(g.inverse(BTA) @ found.aTb)
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(error) < 4.0 * sigma).all()
    assert np.linalg.norm(error[3:]) < 0.01
    assert (first[found.pairs[:, 0]] == second[found.pairs[:, 1]]).all()
    assert len(found.pairs) > 95
    assert len(np.unique(found.pairs[:, 0])) == len(np.unique(found.pairs[:, 1]))
    assert found.residual_m < 3.0 * SIGMA_M
    assert found.second < 0.2 * found.agreeing


@pytest.mark.parametrize("wrong", [0.3, 0.6, 0.8])
def test_wrong_tentative_matches_do_not_mislead(wrong: float, world: World) -> None:
    a, b = world.seen(np.arange(400), np.eye(4)), world.seen(np.arange(400), BTA)
    mixed = np.flatnonzero(world.rng.random(400) < wrong)
    descriptors = b.appearances.descriptors.copy()
    descriptors[mixed] = descriptors[np.roll(mixed, 7)]
    b = replace(b, appearances=replace(b.appearances, descriptors=descriptors))
    found = align(a, b)
    assert np.linalg.norm(g.se3_log(g.inverse(BTA) @ found.aTb)) < 0.02
    true = np.setdiff1d(np.arange(400), mixed)
    assert np.isin(found.pairs[:, 0], true).mean() > 0.95


def test_maps_of_different_places_are_refused(world: World, rng: np.random.Generator) -> None:
    a = world.seen(np.arange(300), np.eye(4))
    b = World(rng, 300).seen(np.arange(300), BTA)
    with pytest.raises(MapError, match=r"a and b: .* the maps do not overlap"):
        align(a, b)


def test_one_poster_in_common_is_no_overlap(world: World, rng: np.random.Generator) -> None:
    """Forty landmarks agree to the centimetre, and all others around them do not."""
    other = World(rng, 400)
    poster = np.arange(40)
    world.points[poster] = rng.uniform([-1, -1, 3.0], [1, 1, 3.02], (40, 3))
    for name in ("points", "signatures", "size"):
        getattr(other, name)[poster] = getattr(world, name)[poster]
    near = np.array([5.0, 1.0, 5.0]) * 0.3
    world.points[40:] *= 0.3
    other.points[40:] *= 0.3
    assert (np.abs(world.points[40:]) <= near).all()
    a = world.seen(np.arange(400), np.eye(4))
    b = other.seen(np.arange(400), g.se3_exp(np.array([0, 0.5, 0, 0.4, 0, 0.2])))
    with pytest.raises(MapError, match=r"only \d+ are found there; the maps do not overlap"):
        align(a, b)


def test_a_place_that_repeats_is_ambiguous(world: World, rng: np.random.Generator) -> None:
    """Two identical rooms in the first map, one of them in the second."""
    room = np.arange(100)
    world.points[100:200] = world.points[room] + np.array([0.0, 0.0, 12.0])
    world.signatures[100:200], world.size[100:200] = world.signatures[room], world.size[room]
    a = world.seen(np.arange(400), np.eye(4))
    b = world.seen(room, BTA)
    with pytest.raises(MapError, match=r"ambiguous|look alike"):
        align(a, b)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_hardly_any_landmark(count: int, world: World) -> None:
    a, b = world.seen(np.arange(200), np.eye(4)), world.seen(np.arange(count), BTA)
    for pair in ((a, b), (b, a)):
        with pytest.raises(MapError, match=r"landmarks look alike, 20 are needed"):
            align(*pair)


def test_all_landmarks_on_one_line_fix_no_alignment(world: World) -> None:
    world.points[:, :2] = 0.0
    a, b = world.seen(np.arange(300), np.eye(4)), world.seen(np.arange(300), BTA)
    with pytest.raises(MapError, match=r"ambiguous: 300 landmarks agree with one alignment, 300"):
        align(a, b)


def test_unconfirmed_landmarks_propose_nothing(world: World) -> None:
    a, b = world.seen(np.arange(200), np.eye(4)), world.seen(np.arange(200), BTA)
    assert len(tentative_pairs(a, b)) > 150
    seldom = replace(b, hits=np.ones(200, np.int64), permanent=np.zeros(200, np.bool_))
    assert len(tentative_pairs(a, seldom)) == 0


# --------------------------------------------------------------------------------------------
# Fusion


def test_what_both_hold_is_fused_by_covariance_and_the_rest_kept(world: World) -> None:
    first, second = np.arange(0, 280), np.arange(180, 400)
    a, b = world.seen(first, np.eye(4)), world.seen(second, BTA, stamp=100.0)
    found = align(a, b)
    merged = merge_maps(a, b, found)
    both, alone = len(found.pairs), len(b) - len(found.pairs)
    assert len(merged) == len(a) + alone
    assert (np.diff(merged.landmarks.ids) > 0).all()
    np.testing.assert_array_equal(merged.landmarks.ids[: len(a)], a.landmarks.ids)
    truth = np.concatenate([first, np.delete(second, found.pairs[:, 1])])
    error = np.linalg.norm(merged.landmarks.positions - world.points[truth], axis=1)
    assert error.max() < 0.06
    before = np.linalg.norm(a.landmarks.positions - world.points[first], axis=1)
    fused = found.pairs[:, 0]
    assert np.mean(error[fused] ** 2) < 0.75 * np.mean(before[fused] ** 2)
    covariance = merged.landmarks.covariances[fused]
    assert (np.linalg.eigvalsh(a.landmarks.covariances[fused] - covariance) > 0.0).all()
    # Twice as well known, but for what the alignment itself is uncertain, and for what the maps'
    # errors seem to share: a share that a hundred pairs tell to a tenth.
    trace = np.trace(covariance, axis1=1, axis2=2)
    assert (trace > 1.5 * SIGMA_M**2).all()
    assert (trace < 1.95 * SIGMA_M**2).all()
    assert merged.hits.sum() == a.hits.sum() + b.hits.sum()
    assert merged.misses.sum() == a.misses.sum() + b.misses.sum()
    farthest = np.maximum(a.farthest[fused], b.farthest[found.pairs[:, 1]])
    np.testing.assert_array_equal(merged.farthest[fused], farthest)
    assert merged.permanent.sum() >= max(a.permanent.sum(), b.permanent.sum())
    assert len(merged.appearances) == len(a.appearances) + len(b.appearances)
    twice = np.bincount(np.searchsorted(merged.landmarks.ids, merged.appearances.ids))
    assert (twice[fused] == 2).all()
    assert twice.sum() == len(merged) + both
    assert len(merged.trajectory) == 10
    np.testing.assert_allclose(merged.trajectory.poses[5:], np.tile(found.aTb, (5, 1, 1)))
    assert [drive["name"] for drive in merged.about["drives"]] == ["drive", "drive"]


def test_views_turn_with_their_map(world: World) -> None:
    a, b = world.seen(np.arange(200), np.eye(4)), world.seen(np.arange(100, 300), BTA)
    found = align(a, b)
    merged = merge_maps(a, b, found)
    added = merged.appearances.of(merged.landmarks.ids[len(a) :])
    np.testing.assert_allclose(added.direction - found.aTb[:3, 2], 0.0, atol=1e-12)


def test_patches_are_the_first_map_s_where_it_has_some(world: World) -> None:
    a, b = world.seen(np.arange(200), np.eye(4)), world.seen(np.arange(100, 300), BTA)
    found = align(a, b)
    assert merge_maps(a, b, found).patches is None
    grey = np.arange(len(b), dtype=np.uint8)[:, None] * np.ones(CUT_PIXELS, np.uint8)
    patched = replace(b, patches=LandmarkPatches(grey, 1.0 + np.arange(len(b))))
    own = LandmarkPatches.none(len(a))
    own.distances[:150], own.grey[:150] = 1000.0, 255
    mine, yours = found.pairs.T
    rest = np.setdiff1d(np.arange(len(b)), yours)
    for first in (a, replace(a, patches=own)):
        merged = merge_maps(first, patched, found).patches
        assert merged is not None
        expected = np.zeros(len(a)) if first is a else own.distances.copy()
        lacking = expected[mine] == 0.0
        assert lacking.any()
        expected[mine[lacking]] = 1.0 + yours[lacking]
        assert merged.distances.tolist() == [*expected, *(1.0 + rest)]
        np.testing.assert_array_equal(merged.grey[mine[lacking]], grey[yours[lacking]])
        np.testing.assert_array_equal(merged.grey[len(a) :], grey[rest])
    assert (own.distances[150:] == 0.0).all()


def test_merged_files(world: World, tmp_path: Path) -> None:
    a, b, out = tmp_path / "a", tmp_path / "b", tmp_path / "ab"
    save_map(world.seen(np.arange(250), np.eye(4)), a)
    save_map(world.seen(np.arange(150, 400), BTA), b)
    lines = merge_files(a, b, out)
    assert any("landmarks fused, residual" in line for line in lines)
    merged = load_map(out)
    assert 390 <= len(merged) <= 420
    with pytest.raises(OutputError, match="is there already"):
        merge_files(a, b, out)
    content = out.read_bytes()
    merge_files(a, b, out, overwrite=True)
    assert out.read_bytes() == content
    (tmp_path / "link").symlink_to(a)
    for lost, why in ((a, "it is read"), (b, "it is read"), (tmp_path / "link", "it is a link")):
        with pytest.raises(OutputError, match=f"{why}; choose another name"):
            merge_files(a, b, lost, overwrite=True)
    other = replace(world.seen(np.arange(50), BTA), rig=replace(LEVEL_RIG, fx=300.0))
    save_map(other, b)
    with pytest.raises(MapError, match="made with another rig"):
        merge_files(a, b, tmp_path / "c")
    assert not (tmp_path / "c").exists()


def test_landmarks_are_as_alike_as_the_nearest_of_their_views(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    which = np.arange(120)
    a, b = world.seen(which, np.eye(4)), world.seen(which, BTA)
    alone = align(a, b)
    monkeypatch.setattr(map_alignment, "AT_ONCE", 50)  # less than there are
    several = align(with_strange_views(a, 2, world.rng), with_strange_views(b, 1, world.rng))
    assert len(alone.pairs) > 100
    assert np.array_equal(several.pairs, alone.pairs)


def with_strange_views(saved: SavedMap, count: int, rng: np.random.Generator) -> SavedMap:
    """Every landmark seen ``count`` more times, each time looking like nothing else."""
    own = saved.appearances
    signatures = rng.exponential(1.0, (count * len(own), 128))
    signatures = 512.0 * signatures / np.linalg.norm(signatures, axis=1, keepdims=True)
    ids = np.concatenate([own.ids, np.tile(own.ids, count)])
    order = np.argsort(ids, kind="stable")
    descriptors = np.concatenate([own.descriptors, np.clip(signatures, 0, 255).astype(np.uint8)])
    size = np.tile(own.size, count + 1)
    return replace(saved, appearances=appearances(ids[order], descriptors[order], size[order]))


# ------------------------------------------------------------------------------------------
# What two maps both saw counts once when they are merged; what only one saw counts


POINTS = 250
HALF_BAND = (
    0.2  # each visit's own NEES per number strays from 1 by 0.1 (50 seeds), fused by as much
)


class Place:
    """Points with descriptors, along a drive that is made again and again."""

    def __init__(self, seed: int, frames: int = 12) -> None:
        self.rng = np.random.default_rng(seed)
        self.drive = Drive(frames=frames, points=POINTS)
        step = g.se3_exp(np.array(TURN_AND_GO))
        self.poses = [np.eye(4)]
        for _ in range(frames - 1):
            self.poses.append(g.reorthonormalise(self.poses[-1] @ step))
        self.points = points_in_views(self.drive, self.poses, self.rng)
        signatures = self.rng.exponential(1.0, (POINTS, 128))
        self.signatures = 512.0 * signatures / np.linalg.norm(signatures, axis=1, keepdims=True)
        self.size = self.rng.uniform(2.0, 8.0, POINTS)

    def visit(self, pTw: FloatArray, noise: float = 1.0) -> tuple[SavedMap, IntArray]:
        """A map of a drive that begins at a pose, and the point of each landmark."""
        drive = replace(self.drive, noise=noise)
        kept = Identities(drive, g.transform_to_camera(pTw, self.points))
        step = g.se3_exp(np.array(TURN_AND_GO))
        seen = [kept.increment(k, wTc, step, self.rng) for k, wTc in enumerate(self.poses)]
        simulation = Simulation(drive, np.array(self.poses), self.points, seen)
        estimate = answer(BatchSettings(), simulation.increments)
        which = kept.book.point_of_id[estimate.landmarks.ids]
        every = np.concatenate([i.observations.ids for i in seen])
        n, ids = len(which), estimate.landmarks.ids
        signatures = self.signatures[which] + 8.0 * self.rng.standard_normal((n, 128))
        return SavedMap(
            rig=RIG,
            landmarks=estimate.landmarks,
            appearances=LandmarkAppearances(
                ids,
                np.clip(signatures, 0, 255).astype(np.uint8),
                self.size[which],
                np.zeros(n),
                np.tile([0.0, 0.0, 1.0], (n, 1)),
            ),
            hits=np.array([(every == one).sum() for one in ids]),
            misses=np.zeros(n, np.int64),
            farthest=np.full(n, 3.0),
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
