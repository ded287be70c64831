"""What a smoother was given, in files: each is where it belongs, or the mend is said."""

from __future__ import annotations

import resource
import tempfile
from pathlib import Path

import numpy as np
import pytest
from simulated import RIG, Drive, assert_same_bits, simulate, tracked_at

from fgslam.backend.smoothers import recorded_inputs
from fgslam.backend.smoothers.recorded_inputs import RecordedInputs
from fgslam.core import geometry as g
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import EstimatorError, OutputError
from fgslam.core.estimates import Prediction
from fgslam.core.measurements import Increment


def test_files_that_are_not_where_they_belong_are_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorded_inputs, "BLOCK", 2)
    inputs = RecordedInputs(RIG)
    inputs.keep_in(tmp_path / "inputs")
    increments = simulate(Drive(frames=9), np.random.default_rng(1)).increments
    for increment in increments:
        pose = Prediction(np.eye(4), np.eye(6))
        inputs.append(increment, tracked_at(pose, int((~increment.observations.is_new).sum())))
    files, state = sorted((tmp_path / "inputs").iterdir()), inputs.state()
    assert len(files) == 3
    told = [increment.index for increment, _ in inputs.recalled(state)]
    assert told == [increment.index for increment in increments]
    np.testing.assert_array_equal(inputs.tracked(3).wTc, np.eye(4))
    files[1].write_bytes(files[2].read_bytes())
    with pytest.raises(OutputError, match="holds other frames than its name says"):
        list(inputs.recalled(state))
    with pytest.raises(OutputError, match="holds other frames than its name says"):
        inputs.tracked(3)
    files[1].unlink()
    for asked in (lambda: list(inputs.recalled(state)), lambda: inputs.tracked(3)):
        with pytest.raises(OutputError, match="is missing; restore the file"):
            asked()
    for place in ({}, {"folder": None}):
        other = RecordedInputs(RIG)
        other.keep_in(**place) if place else None
        with pytest.raises(EstimatorError, match="name their folder with keep_record_in"):
            list(other.recalled(state))


def filled(increments: list[Increment], folder: Path | None) -> RecordedInputs:
    inputs = RecordedInputs(RIG)
    inputs.keep_in(folder)
    for k, increment in enumerate(increments):
        pose = Prediction(g.se3_exp(np.full(6, 0.1 * k)), (1.0 + k) * np.eye(6))
        matched = int((~increment.observations.is_new).sum())
        inputs.append(increment, tracked_at(pose, matched))
    return inputs


@pytest.fixture(scope="module")
def increments() -> list[Increment]:
    return simulate(Drive(frames=9), np.random.default_rng(1)).increments


@pytest.fixture(scope="module")
def whole(increments: list[Increment]) -> StateArrays:
    """The state of inputs that are all in memory."""
    return filled(increments, None).state()


def test_without_a_folder_the_state_is_whole_and_nothing_is_left_on_disk(
    increments: list[Increment],
    whole: StateArrays,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recorded_inputs, "BLOCK", 2)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    inputs = filled(increments, None)
    assert len(inputs._last) < 5
    assert not list(tmp_path.iterdir())
    assert inputs.tracked(3).covariance[0, 0] == 4.0
    assert_same_bits(inputs.state(), whole)
    again = RecordedInputs(RIG)
    again.keep_in(None)
    for one in again.recalled(whole):
        again.append(*one)
    assert_same_bits(again.state(), whole)


@pytest.mark.parametrize("fails", ["at once", "later"])
def test_where_there_is_no_room_on_disk_all_of_it_is_in_memory(
    fails: str,
    increments: list[Increment],
    whole: StateArrays,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recorded_inputs, "BLOCK", 2)
    monkeypatch.setattr(
        tempfile, "tempdir", str(tmp_path / ("absent" if fails == "at once" else ""))
    )
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (60_000, hard))
    try:
        inputs = filled(increments, None)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert len(inputs._last) == len(increments)
    assert_same_bits(inputs.state(), whole)
