"""Frames of one rendered drive sought in the map of another: exact truth, what is in view."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgslam.runs.config import make_experiment
from fgslam.runs.engine import run_task
from fgslam.runs.tasks.localisation import open_localisation

RIG = {"width": 160, "height": 120}
VALUES: dict[str, Any] = {
    "task": "localisation",
    "name": "little_lab",
    "map": {
        "made_from": {
            "dataset": {"kind": "rendered_lab", "rig": RIG, "start": 2, "stop": 7},
        }
    },
    # The same way at half the speed: poses between those of the map's drive.
    "dataset": {
        "kind": "rendered_lab",
        "rig": RIG,
        "drive": {"frames": 498},
        "start": 9,
        "stop": 11,
    },
    "frontend": {"ego_motion": {"dof": 3}, "database": {"viewpoints": True}},
    "localisation": {"frames": [1, 2]},
    "output": {"pictures": False, "report": False},
}


@pytest.mark.slow
@pytest.mark.usefixtures("open3d")
def test_poses_between_those_of_the_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path / "cache"))
    result = run_task(open_localisation, make_experiment(VALUES, "test"), tmp_path / "run")
    assert result.asked.alignment == "truth in the world of the map's first frame, exactly"
    with (tmp_path / "run" / "localisation.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [(row["frame"], row["frames"]) for row in rows] == [("10", "1"), ("10", "2")]
    for row in rows:
        assert row["verdict"] == "found"
        # The map began at the third frame of a drive, so its world is not the recording's.
        assert float(row["error_m"]) < 0.02
        assert float(row["error_deg"]) < 0.3
        visible, familiar = int(row["visible"]), int(row["familiar"])
        assert int(row["inliers"]) <= visible
        assert 0.8 * visible < familiar <= visible  # from the same side
        assert visible <= len(result.asked.landmarks)
    single, submap = (attempt.found for attempt in result.asked.attempts)
    assert single is not None
    assert submap is not None
    assert np.trace(submap.covariance[3:, 3:]) < np.trace(single.covariance[3:, 3:])
