"""Damaged and odd inputs are read or refused in one line: a short run of `make fuzz`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

import fgslam as fg
from scripts.fuzz import values
from scripts.fuzz.cases import KINDS, Kind, faults, outcome
from scripts.fuzz.damage import written
from scripts.fuzz.texts import CALIBRATION


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_odd_inputs_are_read_or_refused_in_one_line(kind: Kind) -> None:
    counts, lines = faults(kind, range(12))
    assert lines == []
    assert counts.total() == 12


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_hundreds_of_odd_inputs_are_read_or_refused_in_one_line(kind: Kind) -> None:
    assert faults(kind, range(1000, 1400))[1] == []


MENDED = [
    ("bag", 17), ("bag", 1178), ("bag", 1358), ("bag", 7001015), ("omni_camera", 39),
    ("omni_camera", 1401), ("calibration_digit", 7000755),
]  # fmt: skip


@pytest.mark.parametrize(("name", "seed"), MENDED)
def test_cases_that_were_faults_once(name: str, seed: int) -> None:
    (kind,) = (kind for kind in KINDS if kind.name == name)
    assert outcome(kind, seed) in ("read", "refused")


def test_what_is_looked_for_is_found() -> None:
    def spoil(rng: np.random.Generator, folder: object) -> int:
        return int(rng.integers(9))

    def stumble(given: int) -> None:
        raise KeyError(given)

    named = KINDS[0]
    silent = Kind(named.name, spoil, lambda given: given, lambda found: False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scripts.fuzz.cases.KINDS", (silent, stumbling := Kind("x", spoil, stumble)))
        assert outcome(silent, 0) == "other values without a word"
        assert outcome(stumbling, 0).startswith("KeyError: ")


def test_a_changed_digit_that_is_read_as_another_value_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rig's focal length is read half a pixel off."""
    rng = np.random.default_rng(5)
    text = "a: 12.5\nb: [3, x4]\n"
    changed = {values.digit_changed(rng, text) for _ in range(200)}
    assert text not in changed
    assert {sum(a != b for a, b in zip(text, one, strict=True)) for one in changed} == {1}
    assert all("x4" in one for one in changed)

    calibration = json.loads(CALIBRATION)
    given = (written(tmp_path / "calib.json", json.dumps(calibration)), None)
    assert values.is_as_written(values.read_calibration(given))
    read = fg.load_rig(given[0])
    monkeypatch.setattr("fgslam.load_rig", lambda path: dataclasses.replace(read, fx=200.5))
    assert not values.is_as_written(values.read_calibration(given))
