"""Third views tell a place seen again from one that looks the same."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import IntArray
from fgslam.core.homing import OmniFeatures, TwoViewVector
from fgslam.homing.links import Answer, Link, Pair, ThirdViewConsistency, Walks
from fgslam.homing.settings import TopologicalMapSettings
from fgslam.homing.topological_map import TopologicalMap, map_of_answers
from tests.landmark_world import landmark_features

SETTINGS = TopologicalMapSettings()
COUNT, THINGS = 12, 60
WALK = Walks((COUNT,))
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
    walk = [(k, k + 1) for k in range(COUNT - 1)]
    rows = rows_of(walk) | rows_of(far, seed)
    return ThirdViewConsistency([view()] * COUNT, [link(p) for p in (*walk, *far)], rows, WALK)


NEIGHBOURS = [FAR, (1, 8), (1, 10), (2, 9), (0, 9)]


def test_features_of_a_place_come_back_in_its_neighbours() -> None:
    """Every inlier in each of the four neighbours that are linked with the other end, exactly."""
    views = checked(NEIGHBOURS, None)
    assert views.share(link(FAR)) == 4.0
    kept, seen, rejected = views.confirmed()
    assert FAR in seen
    assert FAR in {(k.a, k.b) for k in kept}
    assert rejected == {}


@pytest.mark.parametrize("seed", range(4))
def test_similar_place_matches_things_of_a_kind_at_random(seed: int) -> None:
    """As many inliers and links as before, but not the same things."""
    views = checked(NEIGHBOURS, seed)
    assert views.share(link(FAR)) < 0.5
    kept, seen, rejected = views.confirmed()
    assert set(NEIGHBOURS) == set(rejected)
    assert seen.isdisjoint(NEIGHBOURS)
    assert len(kept) == COUNT - 1
    assert "third views" in rejected[FAR]


def test_far_link_that_no_neighbour_shares_is_dropped() -> None:
    """True or not: nothing says so."""
    views = checked([FAR], None)
    assert views.share(link(FAR)) == 0.0
    assert set(views.confirmed()[2]) == {FAR}


def test_consecutive_images_confirm_links_of_a_few_steps_but_not_across_a_gap() -> None:
    """Two steps on, confirmed by nothing: believed, unless one of the steps is missing."""
    walk = [(k, k + 1) for k in range(COUNT - 1)]
    short = (4, 6)
    by_lot = rows_of([short], 1)
    for steps, believed in ((walk, True), ([p for p in walk if p != (4, 5)], False)):
        links = [link(p) for p in (*steps, short)]
        views = ThirdViewConsistency([view()] * COUNT, links, rows_of(steps) | by_lot, WALK)
        assert (short not in views.confirmed()[2]) is believed


def test_map_of_a_walk_has_confirmed_far_links_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few inliers are enough where third views confirm them; many do not help where they do not."""
    monkeypatch.setattr("fgslam.homing.links.LONE_SUPPORT", THINGS + 1)

    def built(seed: int | None) -> TopologicalMap:
        walk = [(k, k + 1) for k in range(COUNT - 1)]
        there = [*walk, *NEIGHBOURS]
        pairs = [q for a, b in there for q in ((a, b), (b, a))]
        answers: dict[Pair, Answer] = {
            (a, b): TwoViewVector(
                0.0 if a < b else np.pi, 0.0, np.eye(2) * 1e-4, np.ones(THINGS, np.bool_), 0
            )
            for a, b in pairs
        }
        rows = rows_of(walk) | rows_of(NEIGHBOURS, seed)
        images = [view()] * COUNT
        return map_of_answers(images, answers, walks=WALK, rows=rows)

    true, false = built(None), built(0)
    assert FAR in {(k.a, k.b) for k in true.links}
    assert {(k.a, k.b) for k in false.links} == {(k, k + 1) for k in range(COUNT - 1)}
    assert FAR in false.rejected
