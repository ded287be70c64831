"""Maps of homings: links that agree, false ones that do not, routes, localisation."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import textured_room
from landmark_world import landmark_features, match_landmarks, numbers

import fgslam as fg
from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.bearings import OmniFeatures, Refusal, RefusalReason, TwoViewVector
from fgslam.core.errors import CalibrationError, StoredMapError
from fgslam.core.geometry import between, wrap
from fgslam.frontend.homing.vector import estimate_homing_vector
from fgslam.frontend.settings import HomingVectorSettings
from fgslam.homing.links import (
    LONE_SUPPORT,
    MIN_SUPPORT,
    MUTUAL_DEG,
    ONE_WAY_SUPPORT,
    Answer,
    Link,
    LinkConsistency,
    Pair,
    ThirdViewConsistency,
    VisualWords,
    Walks,
    between_misfit,
    candidate_pairs,
    heading_residuals,
    link_pair,
)
from fgslam.homing.places import Localiser, transition_along
from fgslam.homing.settings import LocalisationSettings, TopologicalMapSettings
from fgslam.homing.topological_map import (
    RouteMap,
    TopologicalMap,
    map_candidates,
    map_of_answers,
    route_of,
)

SETTINGS = TopologicalMapSettings()
NONE = Refusal(RefusalReason.TOO_FEW_MATCHES, "3 matches, of 8 needed")


def vector(direction: float, rotation: float, support: int = 60) -> TwoViewVector:
    """With a deviation of a degree."""
    covariance = np.eye(2) * np.deg2rad(1.0) ** 2
    return TwoViewVector(direction, rotation, covariance, np.ones(support, dtype=np.bool_), 0)


def true_vector(one: FloatArray, other: FloatArray, support: int = 60) -> TwoViewVector:
    """From one pose to another."""
    way = between(one, other)
    return vector(float(np.arctan2(way[1], way[0])), float(way[2]), support)


def true_link(poses: FloatArray, a: int, b: int, support: int = 60) -> Link:
    """As both directions' answers make it."""
    there, back = true_vector(poses[a], poses[b], support), true_vector(poses[b], poses[a], support)
    link = link_pair((a, b), there, back)
    assert isinstance(link, Link)
    return link


def turned(link: Link, rotation: float = 0.0, direction: float = 0.0) -> Link:
    """The same, wrong by so much, there and back alike, as of a place that looks like another."""
    return Link(
        link.a, link.b, link.direction + direction, link.rotation + rotation,
        link.back + direction - rotation, link.covariance, link.back_covariance, link.support,
    )  # fmt: skip


def random_poses(seed: int, count: int) -> FloatArray:
    """In a hall of 10 m."""
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(0, 10, (count, 2)), rng.uniform(-np.pi, np.pi, count)])


# --------------------------------------------------------------------------------------------
# Links


def test_answers_that_disagree_are_no_link() -> None:
    """Rotation not opposite; direction not where one came from; a refusal; few inliers."""
    a, b = random_poses(1, 2)
    there, back = true_vector(a, b), true_vector(b, a)
    assert isinstance(link_pair((0, 1), there, back), Link)
    off = np.deg2rad(MUTUAL_DEG + 1.0)
    for wrong in (
        vector(back.direction, back.rotation + off),
        vector(back.direction + off, back.rotation),
    ):
        assert "disagree" in str(link_pair((0, 1), there, wrong))
    assert "3 matches" in str(link_pair((0, 1), there, NONE))
    assert "3 matches" in str(link_pair((0, 1), NONE, NONE))
    few = true_vector(b, a, MIN_SUPPORT - 1)
    assert "inliers" in str(link_pair((0, 1), there, few))


def test_ambiguous_in_one_direction_is_decided_by_the_other() -> None:
    """With enough inliers, and the same link whichever direction it was."""
    a, b = random_poses(2, 2)
    there, back = true_vector(a, b), true_vector(b, a)
    unsure = Refusal(RefusalReason.AMBIGUOUS, "30 inliers, 29 for a different solution")
    one, other = (link_pair((0, 1), *pair) for pair in ((there, unsure), (unsure, back)))
    assert isinstance(one, Link)
    assert isinstance(other, Link)
    gap = [one.direction - other.direction, one.rotation - other.rotation, one.back - other.back]
    assert np.abs(wrap(np.array(gap))).max() < 1e-12
    few = true_vector(a, b, ONE_WAY_SUPPORT - 1)
    assert "one way" in str(link_pair((0, 1), few, unsure))


def test_one_place_is_linked_by_its_turn() -> None:
    """No direction, but a rotation that both must tell alike."""
    here = Refusal(RefusalReason.AT_TARGET, "parallax 0.1 deg", 0.7)
    back = Refusal(RefusalReason.AT_TARGET, "parallax 0.1 deg", -0.7)
    link = link_pair((0, 1), here, back)
    assert isinstance(link, Link)
    assert np.isnan(link.direction)
    assert link.rotation == pytest.approx(0.7)
    assert "disagree" in str(link_pair((0, 1), here, here))


@pytest.mark.parametrize("seed", range(3))
def test_true_triangles_hold(seed: int) -> None:
    """The long side lies between the steps; rotations add up to zero."""
    poses = random_poses(seed, 3)
    ab, bc, ac = (true_link(poses, *pair) for pair in ((0, 1), (1, 2), (0, 2)))
    assert abs(wrap(np.array(ab.rotation + bc.rotation - ac.rotation))) < 1e-12
    assert between_misfit(ab.direction, ab.rotation + bc.direction, ac.direction) < 1e-12
    assert between_misfit(0.0, 1.0, -0.2) == pytest.approx(0.2)
    assert between_misfit(0.0, 1.0, 1.3) == pytest.approx(0.3)
    assert between_misfit(1.0, 0.0, 0.5) == 0.0
    # There and almost straight back: the side is a matter of noise.
    for back in (3.1, -3.1):
        assert between_misfit(0.0, back, 1.0, slack=0.1) == 0.0
        assert between_misfit(0.0, back, -1.0, slack=0.1) == 0.0
    assert between_misfit(0.0, -3.0, 1.0, slack=0.1) == pytest.approx(1.0)


def all_links(poses: FloatArray, reach: float = 5.0) -> list[Link]:
    """Of all poses within reach of each other."""
    pairs = itertools.combinations(range(len(poses)), 2)
    return [
        true_link(poses, a, b) for a, b in pairs if np.hypot(*(poses[a, :2] - poses[b, :2])) < reach
    ]


@pytest.mark.parametrize("seed", range(3))
def test_false_links_are_found_and_true_ones_kept(seed: int) -> None:
    """A tenth of the links is turned or points elsewhere: all of them go, and nothing else."""
    rng = np.random.default_rng(seed)
    links = all_links(random_poses(seed, 16))
    wrong = set(rng.permutation(len(links))[: len(links) // 10].tolist())
    spoiled = [
        turned(link, *rng.uniform(0.6, 2.5, 2) * rng.choice([-1, 1], 2)) if k in wrong else link
        for k, link in enumerate(links)
    ]
    believed, rejected = LinkConsistency(16, spoiled).accepted()
    false = {(links[k].a, links[k].b) for k in wrong}
    assert false == set(rejected)
    assert len(believed) == len(links) - len(false)


def test_long_link_between_similar_places_needs_a_third_view() -> None:
    """A chain of places in order, and a link from one end to the other that nothing confirms."""
    poses = np.column_stack([np.arange(8.0), np.zeros(8), np.zeros(8)])
    chain = [true_link(poses, k, k + 1, 20) for k in range(7)]
    long = turned(true_link(poses, 1, 6, LONE_SUPPORT - 1), 0.0, 1.0)
    believed, rejected = LinkConsistency(8, [*chain, long], Walks((8,))).accepted()
    assert [(k.a, k.b) for k in believed] == [(k, k + 1) for k in range(7)]
    assert "no third image" in rejected[1, 6]
    unordered, _ = LinkConsistency(8, chain).accepted()
    assert unordered == []  # nothing but their order confirmed it


def test_strong_lone_link_that_is_turned_breaks_a_loop() -> None:
    """Enough inliers to stand alone, but its rotation is not that of the way around."""
    angle = np.arange(10) * 2.0 * np.pi / 10.0
    poses = np.column_stack([4.0 * np.cos(angle), 4.0 * np.sin(angle), angle])
    ring = [true_link(poses, *sorted((k, (k + 1) % 10)), 120) for k in range(10)]
    across = turned(true_link(poses, 2, 7, 110), np.deg2rad(90.0))
    believed, rejected = LinkConsistency(10, [*ring, across], Walks((10,))).accepted()
    assert set(rejected) == {(2, 7)}
    assert "off all other rotations" in rejected[2, 7]
    assert len(believed) == 10


def test_headings_fit_true_rotations_across_the_wrap() -> None:
    """Residuals vanish although rotations pass 180 degrees; one wrong one keeps its own error."""
    poses = random_poses(3, 12)
    links = all_links(poses, 20.0)
    pairs = [(k.a, k.b) for k in links]
    rotations = np.array([k.rotation for k in links])
    weights = np.ones(len(links))
    assert np.abs(heading_residuals(12, pairs, rotations, weights)).max() < 1e-9
    rotations[5] += 1.0
    residuals = heading_residuals(12, pairs, rotations, weights)
    assert np.argmax(np.abs(residuals)) == 5
    assert residuals[5] == pytest.approx(1.0, abs=0.05)


# --------------------------------------------------------------------------------------------
# Maps over a world of landmarks


PLACES = 16
SIGMA = np.deg2rad(0.4)


def hall_points() -> FloatArray:
    """(n, 3) landmarks around a round way of 2.7 m radius."""
    rng = np.random.default_rng(1)
    ring, radius = rng.uniform(-np.pi, np.pi, 250), rng.uniform(0.7, 5.0, 250)
    return np.column_stack(
        [radius * np.cos(ring), radius * np.sin(ring), rng.uniform(0.3, 1.2, 250)]
    )


def hall() -> tuple[FloatArray, list[OmniFeatures]]:
    """A round of places a metre apart that see 2.5 m far; the last is beside the first."""
    angle = np.arange(PLACES) * 2.0 * np.pi / PLACES
    poses = np.column_stack([2.7 * np.cos(angle), 2.7 * np.sin(angle), angle + np.pi / 2])
    rng, points = np.random.default_rng(1), hall_points()
    return poses, [landmark_features(points, pose, 2.5, SIGMA, rng) for pose in poses]


def link_by_landmarks(a: OmniFeatures, b: OmniFeatures) -> Answer:
    """The program's homing vector from matches by identity, a tenth of them wrong."""
    rng = np.random.default_rng(len(a.sift) * 1000 + len(b.sift))
    matches, _ = match_landmarks(a, b, 0.1, rng)
    return estimate_homing_vector(matches, HomingVectorSettings(), rng)


def map_of_all(images: Sequence[OmniFeatures], settings: TopologicalMapSettings) -> TopologicalMap:
    """The map of images that follow each other: every candidate pair is tried both ways."""
    answers: dict[Pair, Answer] = {}
    walks = Walks((len(images),))
    for a, b in map_candidates(images, settings, np.random.default_rng(0), walks):
        answers[a, b] = link_by_landmarks(images[a], images[b])
        answers[b, a] = link_by_landmarks(images[b], images[a])
    return map_of_answers(images, answers, walks=walks)


@pytest.fixture(scope="module")
def built() -> tuple[FloatArray, TopologicalMap]:
    """The hall's map, from candidates by retrieval."""
    poses, images = hall()
    return poses, map_of_all(images, TopologicalMapSettings(candidates=5))


def hops(a: int, b: int) -> int:
    """Steps between two places of the round."""
    return min((a - b) % PLACES, (b - a) % PLACES)


def test_map_is_connected_and_its_links_are_true(built: tuple[FloatArray, TopologicalMap]) -> None:
    """Every link is near its truth, none is long, and the round is closed."""
    poses, topology = built
    assert [len(c) for c in topology.components()] == [PLACES]
    for link in topology.links:
        truth = true_vector(poses[link.a], poses[link.b])
        assert abs(wrap(np.array(link.direction - truth.direction))) < np.deg2rad(10.0)
        assert abs(wrap(np.array(link.rotation - truth.rotation))) < np.deg2rad(5.0)
        assert hops(link.a, link.b) <= 4
    assert any(hops(link.a, link.b) < link.b - link.a for link in topology.links)
    assert np.all(topology.costs > 1.0)


def test_route_takes_the_short_way_round(built: tuple[FloatArray, TopologicalMap]) -> None:
    """From place 2 to place 14 back over the start, not forward through half the round."""
    topology = built[1]
    way = topology.route(2, 14)
    assert (way[0], way[-1]) == (2, 14)
    assert all(hops(k, 0) <= 2 for k in way)
    assert topology.route(5, 5) == (5,)
    memory = topology.path(way)
    assert memory.names == tuple(str(k) for k in way)
    for one, other in itertools.pairwise(way):
        assert other in topology.neighbours(one)


def test_impossible_routes_are_refused() -> None:
    """Another part of the map; a node that is none."""
    _, images = hall()
    poses = hall()[0]
    answers: dict[tuple[int, int], Answer] = {
        pair: true_vector(poses[pair[0]], poses[pair[1]], LONE_SUPPORT)
        for pair in ((0, 1), (1, 0), (2, 3), (3, 2), (4, 5))
    }
    topology = map_of_answers(images[:6], answers)
    assert [len(c) for c in topology.components()] == [2, 2, 1, 1]
    with pytest.raises(StoredMapError, match="no way from 0 to 3"):
        topology.route(0, 3)
    for node in (-1, 6):
        with pytest.raises(StoredMapError, match=f"no node {node}"):
            topology.route(0, node)


def test_map_survives_its_file(built: tuple[FloatArray, TopologicalMap], tmp_path: Path) -> None:
    """Links to the bit; damage is refused."""
    topology = built[1]
    path = tmp_path / "map.npz"
    kilobytes = topology.save(path)
    assert kilobytes == pytest.approx(path.stat().st_size / (1000.0 * PLACES))
    again = TopologicalMap.load(path)
    assert again.names == topology.names
    assert np.array_equal(again.costs, topology.costs)
    for one, other in zip(again.links, topology.links, strict=True):
        assert (one.a, one.b, one.direction, one.rotation, one.back, one.support) == (
            other.a, other.b, other.direction, other.rotation, other.back, other.support,
        )  # fmt: skip
        assert np.array_equal(one.covariance, other.covariance)
    assert again.route(2, 14) == topology.route(2, 14)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(StoredMapError, match="truncated"):
        TopologicalMap.load(path)


def test_candidates_by_retrieval_are_the_near_ones() -> None:
    """Places that share landmarks look alike, and hardly any true neighbour is passed over."""
    _, images = hall()
    words = VisualWords(images, np.random.default_rng(0))
    likeness = words.likenesses()
    assert np.allclose(likeness, likeness.T)
    assert np.allclose(np.diag(likeness), 1.0)
    pairs = candidate_pairs(likeness, 5)
    near = {p for p in itertools.combinations(range(PLACES), 2) if hops(*p) <= 2}
    found = {(int(a), int(b)) for a, b in pairs}
    assert len(near & found) >= 0.95 * len(near)
    assert len(found) < PLACES * (PLACES - 1) / 3
    assert len(candidate_pairs(likeness, 0)) == PLACES * (PLACES - 1) / 2


def test_images_without_features_are_like_none() -> None:
    """Empty images, and a set of nothing else."""
    _, images = hall()
    empty = landmark_features(np.empty((0, 3)), np.zeros(3), 1.0, 0.01, np.random.default_rng(0))
    words = VisualWords([*images[:5], empty], np.random.default_rng(0))
    assert np.all(words.likeness(empty) == 0.0)
    nothing = VisualWords([empty, empty], np.random.default_rng(0))
    assert nothing.likenesses().tolist() == [[0.0, 0.0], [0.0, 0.0]]
    topology = map_of_all([empty, empty], SETTINGS)
    assert topology.links == ()


# --------------------------------------------------------------------------------------------
# Localisation


def localiser(topology: TopologicalMap, settings: LocalisationSettings) -> Localiser:
    """With a vocabulary of the map's own images."""
    words = VisualWords(topology.images, np.random.default_rng(0))

    def linked(image: OmniFeatures, nodes: Iterable[int]) -> dict[int, Answer]:
        return {k: link_by_landmarks(image, topology.images[k]) for k in nodes}

    return Localiser(transition_along(topology.graph()), words, linked, settings)


def views_at(places: Iterable[float]) -> list[OmniFeatures]:
    """Images between the hall's places, by number of place, taken another time."""
    rng, points = np.random.default_rng(2), hall_points()
    angles = np.array(list(places)) * 2.0 * np.pi / PLACES
    poses = [np.array([2.6 * np.cos(t), 2.6 * np.sin(t), t]) for t in angles]
    return [landmark_features(points, pose, 2.5, SIGMA, rng) for pose in poses]


def test_localisation_converges_from_unknown(built: tuple[FloatArray, TopologicalMap]) -> None:
    """Uniform at first; after a few images of a drive the nearest place leads clearly."""
    topology = built[1]
    here = localiser(topology, LocalisationSettings(candidates=8))
    assert here.belief == pytest.approx(np.full(PLACES, 1.0 / PLACES))
    for view, place in zip(views_at([7.2, 8.1, 9.0, 10.2]), (7, 8, 9, 10), strict=True):
        belief = here.update(view)
        assert belief.sum() == pytest.approx(1.0)
        assert hops(here.best()[0], place) <= 1
    near = sum(belief[k] for k in range(PLACES) if hops(k, 10) <= 2)
    assert near > 0.8


def test_image_that_matches_nothing_leaves_belief_near_where_it_was(
    built: tuple[FloatArray, TopologicalMap],
) -> None:
    """A dark image spreads the belief along edges; it is no evidence for any place."""
    here = localiser(built[1], LocalisationSettings(candidates=6))
    for view in views_at([5.0, 5.1]):
        here.update(view)
    dark = landmark_features(np.empty((0, 3)), np.zeros(3), 1.0, 0.01, np.random.default_rng(0))
    before = here.belief
    after = here.update(dark)
    assert after.max() < before.max()
    assert hops(here.best()[0], 5) <= 1
    assert numbers(dark).size == 0


# --------------------------------------------------------------------------------------------
# Third views tell a place seen again from one that looks the same


THIRD_COUNT, THINGS = 12, 60
WALK = Walks((THIRD_COUNT,))
FAR = (1, 9)


def view() -> OmniFeatures:
    """All things of the world in their order; the same view at each place is enough here."""
    rng = np.random.default_rng(0)
    ring = np.linspace(-3.1, 3.1, THINGS)
    points = np.column_stack([2.0 * np.cos(ring), 2.0 * np.sin(ring), np.full(THINGS, 0.5)])
    features = landmark_features(points, np.zeros(3), 5.0, 0.0, rng)
    assert len(features.sift) == THINGS
    return features


def link(pair: Pair, support: int = THINGS) -> Link:
    """Straight ahead."""
    covariance = np.eye(2) * 1e-4
    return Link(*pair, 0.0, 0.0, np.pi, covariance, covariance, support)


def rows_of(pairs: list[Pair], seed: int | None = None) -> dict[Pair, IntArray]:
    """Each thing with itself; with a seed, with another one of its kind, by lot."""
    out = {}
    for pair in pairs:
        other = np.arange(THINGS)
        if seed is not None:
            other = np.random.default_rng((seed, *pair)).permutation(THINGS)
        out[pair] = np.column_stack([np.arange(THINGS), other])
    return out


def checked(far: list[Pair], seed: int | None) -> ThirdViewConsistency:
    """A walk, and links from one end of it to the other whose matches are true or by lot."""
    walk = [(k, k + 1) for k in range(THIRD_COUNT - 1)]
    rows = rows_of(walk) | rows_of(far, seed)
    return ThirdViewConsistency(
        [view()] * THIRD_COUNT, [link(p) for p in (*walk, *far)], rows, WALK
    )


NEIGHBOURS = [FAR, (1, 8), (1, 10), (2, 9), (0, 9)]


def test_features_of_a_place_come_back_in_its_neighbours() -> None:
    """Every inlier in each of the four neighbours that are linked with the other end, exactly."""
    views = checked(NEIGHBOURS, None)
    assert views.share(link(FAR)) == 4.0
    kept, seen, rejected = views.confirmed()
    assert FAR in seen
    assert FAR in {(k.a, k.b) for k in kept}
    assert rejected == {}


@pytest.mark.parametrize("seed", range(2))
def test_similar_place_matches_things_of_a_kind_at_random(seed: int) -> None:
    """As many inliers and links as before, but not the same things."""
    views = checked(NEIGHBOURS, seed)
    assert views.share(link(FAR)) < 0.5
    kept, seen, rejected = views.confirmed()
    assert set(NEIGHBOURS) == set(rejected)
    assert seen.isdisjoint(NEIGHBOURS)
    assert len(kept) == THIRD_COUNT - 1
    assert "third views" in rejected[FAR]


def test_far_link_that_no_neighbour_shares_is_dropped() -> None:
    """True or not: nothing says so."""
    views = checked([FAR], None)
    assert views.share(link(FAR)) == 0.0
    assert set(views.confirmed()[2]) == {FAR}


def test_consecutive_images_confirm_links_of_a_few_steps_but_not_across_a_gap() -> None:
    """Two steps on, confirmed by nothing: believed, unless one of the steps is missing."""
    walk = [(k, k + 1) for k in range(THIRD_COUNT - 1)]
    short = (4, 6)
    by_lot = rows_of([short], 1)
    for steps, believed in ((walk, True), ([p for p in walk if p != (4, 5)], False)):
        links = [link(p) for p in (*steps, short)]
        views = ThirdViewConsistency([view()] * THIRD_COUNT, links, rows_of(steps) | by_lot, WALK)
        assert (short not in views.confirmed()[2]) is believed


def test_map_of_a_walk_has_confirmed_far_links_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few inliers are enough where third views confirm them; many do not help where they do not."""
    monkeypatch.setattr("fgslam.homing.links.LONE_SUPPORT", THINGS + 1)

    def built(seed: int | None) -> TopologicalMap:
        walk = [(k, k + 1) for k in range(THIRD_COUNT - 1)]
        there = [*walk, *NEIGHBOURS]
        pairs = [q for a, b in there for q in ((a, b), (b, a))]
        answers: dict[Pair, Answer] = {
            (a, b): TwoViewVector(
                0.0 if a < b else np.pi, 0.0, np.eye(2) * 1e-4, np.ones(THINGS, np.bool_), 0
            )
            for a, b in pairs
        }
        rows = rows_of(walk) | rows_of(NEIGHBOURS, seed)
        images = [view()] * THIRD_COUNT
        return map_of_answers(images, answers, walks=WALK, rows=rows)

    true, false = built(None), built(0)
    assert FAR in {(k.a, k.b) for k in true.links}
    assert {(k.a, k.b) for k in false.links} == {(k, k + 1) for k in range(THIRD_COUNT - 1)}
    assert FAR in false.rejected


# --------------------------------------------------------------------------------------------
# Routes taught on their own: where they are joined, where not, the way, the place of an image


FINE = textured_room.CAMERA
CAMERA = Equirectangular(301, 91, FINE.top_elevation, FINE.bottom_elevation)
"""Every other pixel of the room's."""
POSTER = slice(150, 250), slice(60, 130)  # of the texture: 1.75 m wide, on one wall


def picture(x: float, y: float, heading: float = 0.0) -> Image:
    pose = np.array([x, y, heading + 1e-3])  # no ray along a wall
    return np.ascontiguousarray(textured_room.picture(pose)[::2, ::2])


def taught(places: Sequence[tuple[float, float]], heading: float) -> fg.PathMemory:
    return fg.teach([picture(x, y, heading) for x, y in places], CAMERA)


def other_texture() -> FloatArray:
    """Another room's walls, but for one poster that hangs in both."""
    shifted = np.roll(textured_room.TEXTURE[::-1, ::-1], 333, axis=1)
    shifted[POSTER] = textured_room.TEXTURE[POSTER]
    return shifted


ROUTE_COUNT = 5
EAST = [(x, 0.1) for x in np.linspace(-2.0, 2.0, ROUTE_COUNT)]
NORTH = [(0.2, y) for y in np.linspace(-2.0, 2.0, ROUTE_COUNT)]


@pytest.fixture(scope="module")
def routes() -> dict[str, fg.PathMemory]:
    """Two that cross in the middle of one room, and a third in another room."""
    there = {"east": taught(EAST, 0.0), "north": taught(NORTH, np.pi / 2)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(textured_room, "TEXTURE", other_texture())
        return {**there, "elsewhere": taught(EAST[1:], 0.0)}


@pytest.fixture(scope="module")
def joined(routes: dict[str, fg.PathMemory]) -> RouteMap:
    return RouteMap.join(routes)


def test_routes_that_cross_are_joined_by_true_links(joined: RouteMap) -> None:
    poses = np.array([(x, y, 0.0) for x, y in EAST] + [(x, y, np.pi / 2) for x, y in NORTH])
    between = [link for link in joined.links if link.a < ROUTE_COUNT <= link.b < 2 * ROUTE_COUNT]
    assert len(between) >= 3
    for link in between:
        way = poses[link.b, :2] - poses[link.a, :2]
        off = np.exp(1j * (link.direction - np.arctan2(way[1], way[0])))
        assert np.hypot(*way) < 0.3 or abs(np.angle(off)) < np.deg2rad(6.0)
        assert link.rotation == pytest.approx(np.pi / 2, abs=np.deg2rad(3.0))
    assert {"east/2", "north/2"} <= set(joined.crossroads)


def test_rooms_that_share_a_poster_are_not_joined(joined: RouteMap) -> None:
    assert [len(part) for part in joined.components()] == [
        2 * ROUTE_COUNT,
        ROUTE_COUNT - 1,
    ]
    with pytest.raises(StoredMapError, match="no way from east/0 to elsewhere/3"):
        joined.way("east/0", "elsewhere")


def test_the_way_turns_off_at_the_crossroads_and_leads_back(joined: RouteMap) -> None:
    way = joined.way("east/0", "north")
    assert (way.names[0], way.names[-1]) == ("east/0", "north/4")
    kinds = [route_of(name) for name in way.names]
    assert kinds == sorted(kinds)  # once from one to the other
    assert len(way) <= 8
    assert joined.way("north", "east/0").names == way.names[::-1]
    assert way.camera == CAMERA
    follower = fg.PathFollower(CAMERA, way, by="looks")
    command = follower.step(picture(-2.0, 0.1), 0.0)
    assert command.place is not None
    assert command.place.nearest == 0


def test_an_image_finds_its_place_and_its_way(joined: RouteMap) -> None:
    place = joined.locate(picture(-1.5, 0.0, 0.7))
    assert place
    assert place.name in ("east/0", "east/1")
    assert place.inliers >= 50
    assert all(link.back_covariance[0, 0] < np.deg2rad(5.0) ** 2 for link in place.links)
    assert joined.way(place, "east/2").names[-1] == "east/2"
    assert joined.way(place, "north").names[-1] == "north/4"


def test_an_image_from_nowhere_is_refused(joined: RouteMap) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (91, 301, 3), np.uint8)
    assert not joined.locate(noise)
    black = joined.locate(np.zeros((91, 301, 3), np.uint8))
    assert not black
    assert "grey" in black.details


def test_a_gap_in_a_route_is_a_way_of_last_resort(routes: dict[str, fg.PathMemory]) -> None:
    """Two rooms on one route: nothing in common there, but somebody drove it."""
    one, other = routes["east"], routes["elsewhere"]
    through = fg.PathMemory(one.images[:3] + other.images[:3], tuple("abcdef"), CAMERA)
    joined = RouteMap.join({"through": through})
    link = joined.link("through/c", "through/d")
    assert link.support == 0
    assert np.isnan(link.direction)
    assert joined.way("through/a", "through").names[-1] == "through/f"
    assert joined.costs.max() > 20.0


def test_wrong_routes_and_places_are_refused(
    joined: RouteMap, routes: dict[str, fg.PathMemory]
) -> None:
    with pytest.raises(StoredMapError, match="no route"):
        RouteMap.join({})
    with pytest.raises(StoredMapError, match="no place cellar; its routes are east, north"):
        joined.way("east/0", "cellar")
    with pytest.raises(StoredMapError, match="slash"):
        RouteMap.join({"a/b": routes["east"]})
    alike = fg.PathMemory(routes["east"].images, ("0",) * ROUTE_COUNT, CAMERA)
    with pytest.raises(StoredMapError, match="two path images are called a/0"):
        RouteMap.join({"a": alike})
    few = fg.PathMemory(routes["east"].images[:2], ("0", "1"), None)
    mixed = RouteMap.join({"a": few, "b": fg.PathMemory(few.images, few.names, CAMERA)})
    with pytest.raises(CalibrationError, match="give the image's"):
        mixed.locate(picture(0.0, 0.0))


def test_values_that_no_map_has_are_refused(joined: RouteMap, tmp_path: Path) -> None:
    topology, path = joined, tmp_path / "bad.fgmap"
    first, *others = topology.links

    def with_first(**values: Any) -> TopologicalMap:
        return replace(topology, links=(replace(first, **values), *others))

    for other, words in (
        (with_first(rotation=np.inf), "angles of a link: a number is not finite"),
        (with_first(support=-1), "a link has fewer inliers than none"),
        (with_first(covariance=-np.eye(2)), "covariances of a link: number 0 is no covariance"),
        (replace(topology, links=(first, first, *others[1:])), "two links join the same places"),
        (replace(topology, costs=np.inf * topology.costs), "costs: a number is not finite"),
        (replace(topology, links=(topology.links[0].reversed(),)), "a link leads to no place"),
        (replace(topology, costs=-topology.costs), "not one cost a link"),
        (replace(topology, costs=topology.costs[1:]), "not one cost a link"),
    ):
        other.save(path)
        with pytest.raises(StoredMapError, match=words):
            RouteMap.load(path)


def test_places_of_one_name_are_refused(joined: RouteMap, tmp_path: Path) -> None:
    replace(joined, names=("a/0",) * len(joined)).save(tmp_path / "bad.fgmap")
    with pytest.raises(StoredMapError, match="two places have one name"):
        RouteMap.load(tmp_path / "bad.fgmap")
