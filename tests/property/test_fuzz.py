"""Damaged and odd inputs are read or refused in one line: a short run of `make fuzz`."""

from __future__ import annotations

import numpy as np
import pytest

from scripts.fuzz import KINDS, Kind, faults, outcome


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_odd_inputs_are_read_or_refused_in_one_line(kind: Kind) -> None:
    counts, lines = faults(kind, range(12))
    assert lines == []
    assert counts.total() == 12


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_hundreds_of_odd_inputs_are_read_or_refused_in_one_line(kind: Kind) -> None:
    assert faults(kind, range(1000, 1400))[1] == []


def test_what_is_looked_for_is_found() -> None:
    def spoil(rng: np.random.Generator, folder: object) -> int:
        return int(rng.integers(9))

    def stumble(given: int) -> None:
        raise KeyError(given)

    named = KINDS[0]
    silent = Kind(named.name, spoil, lambda given: given, lambda found: False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scripts.fuzz.KINDS", (silent, stumbling := Kind("x", spoil, stumble)))
        assert outcome(silent, 0) == "other values without a word"
        assert outcome(stumbling, 0).startswith("KeyError: ")
