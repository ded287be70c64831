"""Fisheyes of more than 180 degrees: one command maps them in the cylindrical view.

Images are large enough for patches of 15 pixels beside their rim.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from recordings import camera_path, views, write_tum
from running import Capture, Patch, main, metrics_of

import fgslam as fg
from fgslam.cameras.formats.own import raw_values
from fgslam.cameras.raw_cameras import Calibration, RawCamera
from fgslam.core.geometry import inverse, se3_exp

SIZE, FOCAL, FRAMES = (300, 225), 90.0, 6
# A wall that fills the view to 70 degrees on either side, and a board before it.
BOARDS = ((0.0, 0.0, 1.6, 9.0, 7.0), (0.5, -0.3, 1.2, 0.7, 0.6))
PLANE = (100.0, 1100, 800)
QUIET = ("--set", "output.pictures=false", "--set", "output.report=false")


def lens(x: float, turn: float, name: str) -> RawCamera:
    """190 x 143 degrees."""
    middle = 0.5 * (np.array(SIZE) - 1.0)
    matrix = np.array([[FOCAL, 0.0, middle[0]], [0.0, FOCAL, middle[1]], [0.0, 0.0, 1.0]])
    place = se3_exp(np.array([0.0, turn, 0.01, x, 0.002, 0.0]))
    return RawCamera(*SIZE, matrix, np.zeros(4), place, name, "equidistant")


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("fisheyes")
    cameras = (lens(0.0, 0.01, "left"), lens(0.1, -0.02, "right"))
    seen = views(cameras, FRAMES, boards=BOARDS, plane=PLANE)
    for name in ("left", "right"):
        (root / name).mkdir()
    for k, images in enumerate(seen):
        for camera, image in zip(cameras, images, strict=True):
            assert cv2.imwrite(str(root / camera.name / f"{k:06d}.png"), image)
    calibration = Calibration("made", "made", cameras, sided=True)
    (root / "calib.json").write_text(json.dumps(raw_values(calibration)), encoding="utf-8")
    stamps = np.arange(FRAMES) * 0.1
    times = "".join(f"{k:06d} {t:.6f}\n" for k, t in enumerate(stamps))
    (root / "times.txt").write_text(times, encoding="utf-8")
    bTc = fg.load_rig(root / "calib.json", view="cylindrical").bTc
    write_tum(root / "gt_right_cam.txt", stamps, inverse(bTc) @ camera_path(FRAMES) @ bTc)
    return root


@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_fisheyes_are_mapped_in_the_cylindrical_view(
    recording: Path, tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    run = tmp_path / "run"
    better = tmp_path / "better.json"
    given = ("run", recording, "--view", "cylindrical", "--out", run, *QUIET)
    assert main(monkeypatch, *given, "--camera-out", better) == 0
    assert "of 191 x 143 degrees the rectified view shows 160 x 143" in capfd.readouterr().out
    result = metrics_of(run)["estimators"]["isam2"]
    assert result["ate_first_pose_m"] < 0.006  # of 0.2 m
    log = fg.MeasurementLog.load(run / "measurements.npz")
    assert log.rig.view == "cylindrical"
    columns = np.concatenate([frame.kept.measurement[:, 0] for frame in log])
    beyond = np.abs(columns - log.rig.cx) / log.rig.fx > np.radians(60.0)
    assert beyond.sum() > 100  # beyond what the perspective view shows
    assert main(monkeypatch, "export", run, "--images", tmp_path / "model") == 2
    assert "images are cylindrical" in capfd.readouterr().err
    again = ("run", recording, "--camera", better, "--out", tmp_path / "again", *QUIET)
    assert main(monkeypatch, *again) == 0  # the file is of the raw cameras, and says the view
    assert "unrectified" in capfd.readouterr().out
    assert metrics_of(tmp_path / "again")["estimators"]["isam2"]["ate_first_pose_m"] < 0.006
