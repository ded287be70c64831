"""What is packed comes back to the bit, as the types that were asked for."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as stn

from fgslam.core.arrays import FloatArray, GrowingColumns, StateArrays
from fgslam.core.store import (
    TREE,
    Kept,
    has_state,
    pack,
    put_back,
    restore,
    snapshot,
    state_of,
    unpack,
)


class Colour(Enum):
    RED = "red"
    GREEN = "green"


class Row(NamedTuple):
    number: int
    share: float
    colour: Colour


@dataclass(frozen=True)
class Pose:
    matrix: FloatArray
    stamp: float
    name: str
    before: Pose | None = None


@dataclass(frozen=True)
class Point:
    xyz: tuple[float, float, float]


@dataclass
class Everything:
    poses: list[Pose]
    rows: tuple[Row, ...]
    shapes: list[Pose | Point]
    ragged: list[FloatArray]
    by_number: dict[int, FloatArray]
    by_name: dict[str, int | None]
    latest: deque[tuple[int, float]]
    pair: tuple[int | None, Pose | None]
    lists: list[list[int]]
    known: list[float | None]
    raw: bytes
    flag: bool


NUMBERS = st.floats(width=64)
ARRAYS = stn.arrays(np.float64, stn.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=3))
POSES = st.builds(Pose, ARRAYS, NUMBERS, st.text(max_size=5))
ROWS = st.builds(Row, st.integers(-(2**63), 2**63 - 1), NUMBERS, st.sampled_from(Colour))
POINTS = st.builds(Point, st.tuples(NUMBERS, NUMBERS, NUMBERS))
MANY = {"min_size": 0, "max_size": 20}
EVERYTHING = st.builds(
    Everything,
    st.lists(POSES, **MANY),
    st.lists(ROWS, **MANY).map(tuple),
    st.lists(st.one_of(POSES, POINTS), max_size=4),
    st.lists(ARRAYS, **MANY),
    st.dictionaries(st.integers(), ARRAYS, max_size=20),
    st.dictionaries(st.text(max_size=3, alphabet="abc"), st.none() | st.integers(), max_size=3),
    st.lists(st.tuples(st.integers(), NUMBERS), **MANY).map(lambda items: deque(items, 30)),
    st.tuples(st.none() | st.integers(), st.none() | POSES),
    st.lists(st.lists(st.integers(0, 9), max_size=3), **MANY),
    st.lists(st.none() | NUMBERS, max_size=40),
    st.binary(max_size=9),
    st.booleans(),
)


def assert_same(a: Any, b: Any) -> None:
    assert type(a) is type(b)
    if isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
    elif isinstance(a, float):
        assert (math.isnan(a) and math.isnan(b)) or (a, math.copysign(1.0, a)) == (
            b,
            math.copysign(1.0, b),
        )
    elif isinstance(a, dict):
        assert_same(list(a), list(b))
        assert_same(list(a.values()), list(b.values()))
    elif isinstance(a, list | tuple | deque):
        assert len(a) == len(b)
        for one, other in zip(a, b, strict=True):
            assert_same(one, other)
    elif hasattr(a, "__dataclass_fields__"):
        for name in a.__dataclass_fields__:
            assert_same(getattr(a, name), getattr(b, name))
    else:
        assert a == b


@given(EVERYTHING)
@settings(max_examples=25)
def test_values_come_back_as_they_were_from_a_file(
    tmp_path_factory: Any, value: Everything
) -> None:
    packed = pack(value)
    path: Path = tmp_path_factory.mktemp("store") / "value.npz"
    np.savez(path, allow_pickle=False, **packed)
    with np.load(path, allow_pickle=False) as file:
        found = unpack({name: file[name] for name in file.files}, Everything)
    assert_same(found, value)
    assert found.latest.maxlen == value.latest.maxlen
    assert_same(pack(found), packed)


def test_ten_thousand_poses_are_a_few_arrays() -> None:
    poses = [Pose(k + np.arange(16.0).reshape(4, 4), 0.1 * k, "") for k in range(10_000)]
    packed = pack(poses)
    assert len(packed) < 5
    assert packed["matrix"].shape == (10_000, 4, 4)


@pytest.mark.parametrize("value", [object(), np.array([object()]), {"a": {1, 2}}])
def test_what_is_no_data_is_refused(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be stored"):
        pack(value)


def test_of_a_union_its_own_members_alone_are_read() -> None:
    with pytest.raises(ValueError, match="holds a Pose"):
        unpack(pack(Pose(np.eye(4), 0.0, "")), Point)


class Counter:
    """A part of a part, with a number that is given and one that counts."""

    count: Kept[int]

    def __init__(self, step: int) -> None:
        self.step, self.count = step, 0


@dataclass(frozen=True)
class Known:
    """A frozen part: what is given to it stays."""

    rig: object
    values: Kept[FloatArray]


class Part:
    """A part of a run."""

    _rows: Kept[GrowingColumns]
    counters: Kept[list[Counter]]
    _known: Kept[Known]
    _pose: Kept[FloatArray | None]
    _own: Kept[Own | None]

    def __init__(self, step: int) -> None:
        self.settings = object()
        self._rows = GrowingColumns(ids=np.empty(0, np.int64))
        self.counters = [Counter(step), Counter(2 * step)]
        self._known = Known(self.settings, np.zeros(2))
        self._pose = None
        self._own = Own()
        self._square: float | None = None

    def go(self) -> None:
        self._rows.append({"ids": np.array([len(self._rows)])})
        for one in self.counters:
            one.count += one.step
        self._known = Known(self.settings, self._known.values + 1.0)
        self._pose = np.eye(4) * len(self._rows)
        assert self._own is not None
        self._own.seen += 1

    def told(self) -> tuple[Any, ...]:
        own = None if self._own is None else self._own.seen
        counts = [one.count for one in self.counters]
        return self._rows["ids"].tolist(), counts, self._known.values.tolist(), own

    def remake(self) -> None:
        self._square = float(self._known.values[0] ** 2)

    @property
    def square(self) -> float | None:
        return self._square


@dataclass
class Own:
    """A part that keeps its state in its own way, as a user's may."""

    seen: int = field(default=0)

    def state(self) -> StateArrays:
        return {"seen": np.array(self.seen)}

    def restore(self, state: StateArrays) -> None:
        self.seen = int(state["seen"])


@given(st.integers(0, 100), st.integers(0, 100))
def test_a_part_goes_on_from_its_state(before: int, after: int) -> None:
    one, other = Part(3), Part(3)
    for _ in range(before):
        one.go()
    state = state_of(one)
    counters, given_rig = list(other.counters), other.settings
    restore(other, state)
    for _ in range(after):
        one.go()
        other.go()
    assert one.told() == other.told()
    assert other.square == float(before**2)
    assert all(a is b for a, b in zip(other.counters, counters, strict=True))
    assert other._known.rig is given_rig
    assert state["rows/ids"].tolist() == list(range(before)), "later updates leave it alone"


def test_the_state_of_another_class_and_a_part_of_one_are_refused() -> None:
    part, none = Part(1), Part(1)
    none._own = None
    with pytest.raises(ValueError, match="no state of Part"):
        restore(Part(1), state_of(Counter(1)))
    with pytest.raises(ValueError, match="no state of Own"):
        restore(part, state_of(none))
    for name in state_of(part):
        if name != TREE:
            with pytest.raises(KeyError, match=name):
                restore(part, {k: v for k, v in state_of(part).items() if k != name})
    assert has_state(part)
    assert not has_state(object())


@given(st.integers(0, 20), st.integers(0, 20))
def test_a_part_is_what_it_was_at_its_snapshot(before: int, after: int) -> None:
    part, other = Part(3), Part(3)
    part._rows = other._rows = GrowingColumns(ids=np.empty(0, np.int64))  # written to in place
    for _ in range(before):
        part.go()
    told, kept = part.told()[1:], snapshot(part)
    for _ in range(after):
        part.go()
    put_back(part, kept)
    assert part.told()[1:] == told
