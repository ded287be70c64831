"""Laws of candidate pairs and of the choice among them, against brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, strategies as st
from hypothesis.extra import numpy as hnp

from fgslam.frontend.features import matching
from fgslam.frontend.features.matching import (
    alike,
    choose,
    pairs_within,
    unambiguous,
)
from fgslam.frontend.settings import AppearanceSettings

# Halves and quarters: sums and differences are exact, so borders are met exactly.
quarters = st.integers(-40, 40).map(lambda n: n / 4.0)
values = hnp.arrays(np.float64, st.integers(0, 25), elements=quarters)
pairs = st.lists(st.tuples(st.integers(0, 7), st.integers(0, 7)), max_size=30, unique=True).map(
    sorted
)


@given(values, values, st.data())
def test_pairs_within_is_brute_force(center, others, data) -> None:
    reach = data.draw(hnp.arrays(np.float64, len(center), elements=st.integers(0, 12)))
    i, j = pairs_within(center, reach, others)
    expected = {
        (a, b)
        for a in range(len(center))
        for b in range(len(others))
        if abs(others[b] - center[a]) <= reach[a]
    }
    found = list(zip(i.tolist(), j.tolist(), strict=True))
    assert len(found) == len(set(found))
    assert set(found) == expected
    assert (np.diff(i) >= 0).all()


@given(pairs)
def test_unambiguous_pairs_are_those_without_competing_candidates(found) -> None:
    i = np.array([a for a, _ in found], np.int64)
    j = np.array([b for _, b in found], np.int64)
    expected = [
        sum(x == a for x, _ in found) == 1 and sum(y == b for _, y in found) == 1 for a, b in found
    ]
    assert unambiguous(i, j).tolist() == expected


@given(pairs, st.integers(0, 2**32 - 1))
def test_the_mutually_closest_win(found, seed) -> None:
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 256, (8, 128)).astype(np.uint8)
    second = rng.integers(0, 256, (8, 128)).astype(np.uint8)
    i = np.array([a for a, _ in found], np.int64)
    j = np.array([b for _, b in found], np.int64)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(matching, "MAX_DISTANCE", 1e4)
        patch.setattr(matching, "RATIO", 0.99)
        a, b = choose(i, j, (first, second), AppearanceSettings(mode="descriptor"))

    def cost(x: int, y: int) -> float:
        return float(np.linalg.norm(first[x].astype(float) - second[y].astype(float)))

    expected = set()
    for x, y in found:
        competing = [cost(p, q) for p, q in found if (p == x) != (q == y)]
        if all(cost(x, y) <= 0.99 * other for other in competing):
            expected.add((x, y))
    assert set(zip(a.tolist(), b.tolist(), strict=True)) == expected


@given(
    st.floats(0.5, 50.0),
    st.floats(0.5, 50.0),
    st.floats(-10.0, 10.0),
    st.floats(-10.0, 10.0),
)
def test_alike_is_symmetric_and_periodic(s1, s2, o1, o2) -> None:
    def arrays(*x: float) -> tuple[np.ndarray, ...]:
        return tuple(np.array([v]) for v in x)

    there = alike(arrays(s1, s2), arrays(o1, o2), 1.5, 0.3)
    back = alike(arrays(s2, s1), arrays(o2, o1), 1.5, 0.3)
    gap = abs((o1 - o2 + np.pi) % (2 * np.pi) - np.pi)
    if abs(gap - 0.3) > 1e-9:  # rounding decides on the border itself
        assert there == back == [max(s1, s2) <= 1.5 * min(s1, s2) and gap <= 0.3]
