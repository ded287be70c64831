"""`fgslam camera`: every option of a calibration file reaches what reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import read_calibration_file
from fgslam.cameras.write_formats import write_calibration
from fgslam.cli.main import app
from fgslam.core.geometry import pose

MATRIX = np.array([[160.0, 0.0, 64.0], [0.0, 160.0, 48.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Two cameras a tenth of a metre apart; written in millimetres."""
    places = np.eye(4), pose(np.eye(3), np.array([100.0, 0.0, 0.0]))
    cameras = tuple(
        RawCamera(128, 96, MATRIX, np.zeros(4), bTc, name, "radtan")
        for name, bTc in zip(("left", "right"), places, strict=True)
    )
    path = tmp_path / "rig.yaml"
    write_calibration(Calibration("made", "made", cameras, sided=True), path)
    return path


def test_a_calibration_is_shown_with_the_options_that_were_given(file: Path) -> None:
    options = ["--unit", "0.001", "--fov", "40", "--size", "64x48", "--scale", "--cameras", "0,1"]
    found = CliRunner().invoke(app, ["camera", "show", str(file), *options])
    assert found.exit_code == 0, found.exception
    assert "baseline 100.00 mm" in found.stdout
    assert "64x48" in found.stdout
    assert "40 x " in found.stdout


def test_a_calibration_is_converted_with_the_options_that_were_given(
    file: Path, tmp_path: Path
) -> None:
    out = tmp_path / "rig.yml"
    given = ["camera", "convert", str(file), str(out), "--unit", "0.001", "--format", "opencv"]
    found = CliRunner().invoke(app, given)
    assert found.exit_code == 0, found.exception
    assert read_calibration_file(out).offset(1, 0)[0, 3] == pytest.approx(0.1)
