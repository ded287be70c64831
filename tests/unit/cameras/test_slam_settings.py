"""ORB-SLAM's settings files: both generations of keys, all types of cameras, and wrong ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fgslam.cameras.lenses import Calibration
from fgslam.cameras.rig import read_calibration_file
from fgslam.core.errors import CalibrationError

HEAD = """%YAML:1.0
---
File.version: "1.0"
Camera.type: "{kind}"
Camera.width: 752
Camera.height: 480
Camera.fps: 20
"""
FIRST = """Camera1.fx: 458.654
Camera1.fy: 457.296
Camera1.cx: 367.215
Camera1.cy: 248.375
Camera1.k1: -0.28340811
Camera1.k2: 0.07395907
"""
TANGENTIAL = """Camera{n}.p1: 0.00019359
Camera{n}.p2: 1.76187114e-05
"""
SECOND = """Camera2.fx: 457.587
Camera2.fy: 456.134
Camera2.cx: 379.999
Camera2.cy: 255.238
Camera2.k1: -0.28368365
Camera2.k2: 0.07451284
"""
STEP = """Stereo.T_c1_c2: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data: [1.0, 0.0, 0.0, 0.11007, 0.0, 1.0, 0.0, -0.00016, 0.0, 0.0, 1.0, 0.00089, 0, 0, 0, 1.0]
"""


def read(folder: Path, *parts: str, kind: str = "PinHole") -> Calibration:
    file = folder / "settings.yaml"
    file.write_text(HEAD.format(kind=kind) + "".join(parts), encoding="utf-8")
    return read_calibration_file(file)


def test_orb_slam3_pinhole_pair(tmp_path: Path) -> None:
    parts = (FIRST, TANGENTIAL.format(n=1), SECOND, TANGENTIAL.format(n=2), STEP)
    found = read(tmp_path, *parts)
    assert found.format == "ORB-SLAM settings"
    assert [(c.model, c.size) for c in found.cameras] == [("radtan", (752, 480))] * 2
    left, right = found.cameras
    np.testing.assert_array_equal(left.distortion[:2], [-0.28340811, 0.07395907])
    np.testing.assert_array_equal(left.distortion[2:], [0.00019359, 1.76187114e-05])
    np.testing.assert_array_equal(
        right.matrix, [[457.587, 0.0, 379.999], [0.0, 456.134, 255.238], [0.0, 0.0, 1.0]]
    )
    np.testing.assert_allclose(found.offset(1, 0)[:3, 3], [0.11007, -0.00016, 0.00089], atol=1e-9)


def test_orb_slam3_rectified_pair_by_its_baseline(tmp_path: Path) -> None:
    plain = FIRST.replace("-0.28340811", "0.0").replace("0.07395907", "0.0")
    found = read(tmp_path, plain, "Stereo.b: 0.11007\n", kind="Rectified")
    assert len(found.cameras) == 2
    np.testing.assert_array_equal(found.cameras[0].matrix, found.cameras[1].matrix)
    assert not found.cameras[0].distortion.any()
    np.testing.assert_allclose(found.offset(1, 0)[:3, 3], [0.11007, 0.0, 0.0], atol=1e-12)


def test_orb_slam3_fisheyes(tmp_path: Path) -> None:
    terms = "Camera{n}.k3: -0.00203\nCamera{n}.k4: 0.0002\n"
    parts = (FIRST, terms.format(n=1), SECOND, terms.format(n=2), STEP)
    found = read(tmp_path, *parts, kind="KannalaBrandt8")
    assert [camera.model for camera in found.cameras] == ["equidistant"] * 2
    np.testing.assert_array_equal(
        found.cameras[0].distortion, [-0.28340811, 0.07395907, -0.00203, 0.0002]
    )


def test_orb_slam2_pair_by_focal_length_times_baseline(tmp_path: Path) -> None:
    old = FIRST.replace("Camera1.", "Camera.") + "Camera.bf: 50.45194\n"
    found = read(tmp_path, old)
    assert len(found.cameras) == 2
    assert found.offset(1, 0)[0, 3] == pytest.approx(0.11, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "kind", "words"),
    [
        (FIRST, "Omni", "Camera.type omni is not known; known: pinhole, kannalabrandt8, rectified"),
        (FIRST.replace("Camera1.cy: 248.375\n", ""), "PinHole", "Camera1.cy"),
        (FIRST.replace("458.654", "-458.654"), "PinHole", "must be positive"),
    ],
)
def test_wrong_settings_are_refused(tmp_path: Path, text: str, kind: str, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        read(tmp_path, text, kind=kind)
