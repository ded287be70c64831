"""What a smoother was given, in files: each is where it belongs, or the mend is said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from simulated import RIG, Drive, simulate, tracked_at

from fgslam.backend.smoothers import recorded_inputs
from fgslam.backend.smoothers.recorded_inputs import RecordedInputs
from fgslam.core.errors import EstimatorError, OutputError
from fgslam.core.estimates import Prediction


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
    with pytest.raises(EstimatorError, match="name their folder with keep_record_in"):
        list(RecordedInputs(RIG).recalled(state))
