"""The stereo rig: checked numbers, and calibration files of several formats."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import (
    BODY_FORWARD_LEFT_UP_FROM_CAMERA,
    inverse,
    pose,
    se3_exp,
    so3_exp,
)
from fgslam.core.sensors import vertical_of

WIDTH, HEIGHT = 160, 120
INTRINSICS = ([150.0, 151.0, 78.0, 61.0], [149.0, 150.5, 81.0, 58.0])
DISTORTION = ([-0.28, 0.07, 2e-4, 2e-5], [-0.27, 0.06, -1e-4, -3e-5])
RIGHT_FROM_LEFT = pose(so3_exp(np.array([0.01, -0.02, 0.005])), np.array([-0.11, 0.001, 0.002]))
"""Takes points from the left camera's axes to the right one's."""


def numbers(**changes: Any) -> dict[str, Any]:
    values = {"width": 640, "height": 480, "fx": 500, "fy": 500, "cx": 319.5, "cy": 239.5}
    return values | {"baseline": 0.12} | changes


def matrix(k: int) -> FloatArray:
    fx, fy, cx, cy = INTRINSICS[k]
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


# --------------------------------------------------------------------------------------------
# Numbers


def test_a_rig_needs_seven_numbers() -> None:
    rig = StereoRig(**numbers())
    assert rig.cameras == 2
    np.testing.assert_array_equal(rig.bTc, np.eye(4))
    assert StereoRig(**numbers(vertical_baseline=0.1)).cameras == 3


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"baseline": 0.0}, "baseline is 0.0, .*one camera alone cannot measure depth"),
        ({"vertical_baseline": -0.1}, "vertical_baseline is -0.1"),
        ({"fx": float("inf")}, "fx is inf"),
        ({"fy": True}, "fy is True"),
        ({"cx": -700.0}, "cx is -700.0, far from the image"),
        ({"bTc": np.diag([1.0, 1.0, -1.0, 1.0])}, "bTc must be a rigid motion"),
    ],
)
def test_impossible_numbers_are_refused_by_name(change: dict[str, Any], words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        StereoRig(**numbers(**change))


def test_a_changed_rig_is_checked_too() -> None:
    with pytest.raises(CalibrationError, match="fx"):
        dataclasses.replace(StereoRig(**numbers()), fx=-1.0)


# --------------------------------------------------------------------------------------------
# Files: one pair of cameras, written in each format


def write_euroc(root: Path) -> Path:
    for k, bTc in enumerate((np.eye(4), inverse(RIGHT_FROM_LEFT))):
        folder = root / "mav0" / f"cam{k}"
        folder.mkdir(parents=True)
        values = {
            "T_BS": {"cols": 4, "rows": 4, "data": bTc.ravel().tolist()},
            "resolution": [WIDTH, HEIGHT],
            "intrinsics": INTRINSICS[k],
            "distortion_model": "radial-tangential",
            "distortion_coefficients": DISTORTION[k],
        }
        (folder / "sensor.yaml").write_text("%YAML:1.0\n" + yaml.safe_dump(values))
    return root


def camchain() -> dict[str, dict[str, Any]]:
    cameras: dict[str, dict[str, Any]] = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "distortion_model": "radtan",
            "distortion_coeffs": DISTORTION[k],
            "intrinsics": INTRINSICS[k],
            "resolution": [WIDTH, HEIGHT],
        }
        for k in (0, 1)
    }
    cameras["cam1"]["T_cn_cnm1"] = RIGHT_FROM_LEFT.tolist()
    return cameras


def write_camchain(root: Path, **changes: Any) -> Path:
    values = camchain()
    values["cam1"] |= changes
    path = root / "drive-camchain.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def write_opencv(root: Path) -> Path:
    for name, items in {
        "intrinsics.yml": {
            "M1": matrix(0),
            "D1": np.array([DISTORTION[0]]),
            "M2": matrix(1),
            "D2": np.array([DISTORTION[1]]),
        },
        "extrinsics.yml": {"R": RIGHT_FROM_LEFT[:3, :3], "T": RIGHT_FROM_LEFT[:3, 3:]},
    }.items():
        storage = cv2.FileStorage(str(root / name), cv2.FILE_STORAGE_WRITE)
        for key, value in items.items():
            storage.write(key, np.ascontiguousarray(value))
        storage.release()
    return root / "extrinsics.yml"


def write_camera_info(root: Path, **changes: Any) -> Path:
    """As ROS' own calibrator would, by OpenCV's rectification."""
    rotations = cv2.stereoRectify(
        matrix(0),
        np.array(DISTORTION[0]),
        matrix(1),
        np.array(DISTORTION[1]),
        (WIDTH, HEIGHT),
        RIGHT_FROM_LEFT[:3, :3],
        RIGHT_FROM_LEFT[:3, 3:],
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=0.0,
    )
    for k, name in enumerate(("left", "right")):
        values = {
            "image_width": WIDTH,
            "image_height": HEIGHT,
            "camera_matrix": {"data": matrix(k).ravel().tolist()},
            "distortion_model": "plumb_bob",
            "distortion_coefficients": {"data": [*DISTORTION[k], 0.0]},
            "rectification_matrix": {"data": rotations[k].ravel().tolist()},
            "projection_matrix": {"data": rotations[2 + k].ravel().tolist()},
        }
        (root / f"{name}.yaml").write_text(yaml.safe_dump(values | changes))
    return root


WRITERS = {
    "kalibr": (write_camchain, None),
    "folder with a camchain": (lambda root: write_camchain(root).parent, None),
    "opencv": (write_opencv, (WIDTH, HEIGHT)),
}


@pytest.mark.parametrize("kind", WRITERS)
def test_one_pair_in_every_format_is_one_rig(kind: str, tmp_path: Path) -> None:
    expected = StereoRig.load(write_euroc(tmp_path / "euroc"))
    write, size = WRITERS[kind]
    (tmp_path / "other").mkdir()
    found = StereoRig.load(write(tmp_path / "other"), size)
    for name in ("width", "height", "fx", "fy", "cx", "cy", "baseline"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), abs=1e-9), name
    assert found.baseline == pytest.approx(np.linalg.norm(RIGHT_FROM_LEFT[:3, 3]), abs=1e-9)
    image = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    pairs = zip(found.rectified((image, image)), expected.rectified((image, image)), strict=True)
    for a, b in pairs:
        np.testing.assert_array_equal(a, b)
        assert (a != image).any()


OF_OPENCV_5 = """%YAML 1.2
---
K1: !!opencv-matrix { rows: 3, cols: 3, dt: d, data: [ 30., 0, 15.5, 0, 30., 11.5, 0, 0, 1. ] }
D1: !!opencv-nd-matrix { sizes: [ 4 ], dt: d, data: [ 0.01, 0., -0.02, 0. ] }
K2: !!opencv-nd-matrix { sizes: [ 3, 3 ], dt: d, data: [ 30., 0, 15.5, 0, 30., 11.5, 0, 0, 1. ] }
D2: !!opencv-nd-matrix { sizes: [ 4 ], dt: d, data: [ 0.01, 0., -0.02, 0. ] }
R: !!opencv-matrix { rows: 3, cols: 3, dt: d, data: [ 1., 0., 0., 0., 1., 0., 0., 0., 1. ] }
T: !!opencv-nd-matrix { sizes: [ 3 ], dt: d, data: [ -0.2, 0., 0. ] }
"""


def test_rows_of_numbers_as_opencv_5_writes_them(tmp_path: Path) -> None:
    """The only file of a folder may have any name; where it cannot be read, that is said."""
    path = tmp_path / "rig_of_tuesday.yml"
    path.write_text(OF_OPENCV_5, encoding="utf-8")
    rig = StereoRig.load(tmp_path, (WIDTH, HEIGHT))
    assert rig.baseline == pytest.approx(0.2, abs=1e-12)
    assert any("taken as equidistant; if they are radtan" in remark for remark in rig.remarks)
    path.write_text(OF_OPENCV_5.replace("sizes: [ 3 ]", "sizes: [ 4 ]"), encoding="utf-8")
    with pytest.raises(CalibrationError, match=r"_of_tuesday\.yml: T must be a matrix of 4 "):
        StereoRig.load(tmp_path, (WIDTH, HEIGHT))


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"K1": [[3e9, 0.0, 80.0], [0.0, 30.0, 60.0], [0.0, 0.0, 1.0]]}, "nearly square"),
        ({"K1": [[30.0, 80.0, 0.0], [0.0, 30.0, 60.0], [0.0, 0.0, 1.0]]}, "nearly right angles"),
        ({"K1": [[3e9, 0.0, 80.0], [0.0, 3e9, 60.0], [0.0, 0.0, 1.0]]}, "show 3.* degrees in 160x"),
        (
            {"K1": [[200.0, 0.0, -1e300], [0.0, 200.0, 60.0], [0.0, 0.0, 1.0]]},
            r"principal point \(-1e\+300, 60\) is far from the image of 160x",
        ),
        ({"D1": [1e4, 0.0, 0.0, 0.0, 0.0]}, "lens model show .* degrees in 160x"),
        ({"T": [-1e300, 0.0, 0.0]}, "it is 1e[+]300 m from"),
        ({"size": [1e12, 120]}, "no image is 1000000000000x120 pixels large"),
    ],
)
def test_numbers_that_no_camera_has_are_refused(
    tmp_path: Path, wrong: dict[str, list[float]], words: str
) -> None:
    """A transposed matrix, lost points of numbers, millimetres of a wrong power."""
    plain = np.array([[30.0, 0.0, 80.0], [0.0, 30.0, 60.0], [0.0, 0.0, 1.0]])
    whole = {"K1": plain, "K2": plain, "D1": np.zeros(5), "D2": np.zeros(5), "R": np.eye(3)}
    values = whole | {"T": [-0.1, 0.0, 0.0], "size": [160, 120]} | wrong
    text = json.dumps(values, default=lambda array: array.tolist())
    (tmp_path / "rig.json").write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=words):
        StereoRig.load(tmp_path / "rig.json")


def test_camera_info_is_rectified_as_it_says(tmp_path: Path) -> None:
    rig = StereoRig.load(write_camera_info(tmp_path))
    stated = yaml.safe_load((tmp_path / "right.yaml").read_text())["projection_matrix"]["data"]
    projection = np.array(stated).reshape(3, 4)
    assert (rig.fx, rig.cx, rig.cy) == (projection[0, 0], projection[0, 2], projection[1, 2])
    assert rig.baseline == pytest.approx(np.linalg.norm(RIGHT_FROM_LEFT[:3, 3]), abs=1e-9)
    np.testing.assert_allclose(rig.bTc, np.eye(4), rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("write", [write_camchain, write_camera_info])
def test_rectified_rows_agree(write: Callable[[Path], Path], tmp_path: Path) -> None:
    """A point far off the axis falls on one row of both rectified images, by the disparity."""
    rig = StereoRig.load(write(tmp_path))
    assert rig.rectifier is not None
    point = np.array([0.3, -0.2, 2.0])  # in the left camera's axes
    raw = [
        cv2.projectPoints(p[None], np.zeros(3), np.zeros(3), matrix(k), np.array(DISTORTION[k]))[0]
        for k, p in enumerate((point, (RIGHT_FROM_LEFT @ [*point, 1.0])[:3]))
    ]
    found = []
    for (columns, rows), at in zip(rig.rectifier.maps, reversed(raw), strict=True):
        near = np.hypot(columns - at[0, 0, 0], rows - at[0, 0, 1])
        found.append(np.unravel_index(near.argmin(), near.shape))
    (right_row, right_column), (left_row, left_column) = found
    assert abs(int(right_row) - int(left_row)) <= 1
    depth = rig.fx * rig.baseline / (int(left_column) - int(right_column))
    assert depth == pytest.approx(2.0, abs=0.3)  # disparities of whole pixels


def test_our_own_and_kittis_files_need_no_rectification(tmp_path: Path) -> None:
    ours = {"width": 320, "height": 240, "fx": 200.0, "fy": 200.0, "cx": 160.0, "cy": 120.0}
    (tmp_path / "calib.json").write_text(
        json.dumps(ours | {"baseline_m": 0.1, "vertical_baseline_m": 0.2})
    )
    rig = StereoRig.load(tmp_path)
    assert (rig.cameras, rig.vertical_baseline, rig.rectifier) == (3, 0.2, None)
    kitti = tmp_path / "kitti.txt"
    kitti.write_text(
        "P0: 700 0 600 0 0 700 180 0 0 0 1 0\nP1: 700 0 600 -378 0 700 180 0 0 0 1 0\n"
    )
    with pytest.raises(CalibrationError, match=r"size=\(width, height\)"):
        StereoRig.load(kitti)
    assert StereoRig.load(kitti, (1226, 370)).baseline == pytest.approx(0.54)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"distortion_model": "kb9"}, "cam1.camera_model pinhole with distortion_model kb9 is not"),
        ({"T_cn_cnm1": None}, "T_cn_cnm1"),
        ({"T_cn_cnm1": np.diag([2.0, 1, 1, 1]).tolist()}, "not a rigid motion"),
        ({"resolution": [80, 60]}, "one resolution"),
    ],
)
def test_what_a_camchain_lacks_is_named(tmp_path: Path, changes: Any, words: str) -> None:
    path = write_camchain(tmp_path, **changes)
    with pytest.raises(CalibrationError, match=words):
        StereoRig.load(path)


def test_camera_info_of_no_pair_is_refused(tmp_path: Path) -> None:
    write_camera_info(tmp_path, distortion_model="mystery")
    with pytest.raises(CalibrationError, match="mystery is not known"):
        StereoRig.load(tmp_path)
    write_camera_info(tmp_path, projection_matrix={"data": [1.0, 0, 0, 0] * 3})
    with pytest.raises(CalibrationError, match="states no baseline"):
        StereoRig.load(tmp_path / "left.yaml")


@pytest.mark.parametrize("name", ["nothing.yaml", "", "other.yaml", "binary.yaml"])
def test_what_is_no_calibration_is_refused_with_what_is_known(tmp_path: Path, name: str) -> None:
    (tmp_path / "other.yaml").write_text("a: 1\n")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    words = "cannot read" if name == "nothing.yaml" else "known: calib.json"
    with pytest.raises(CalibrationError, match=words):
        StereoRig.load(tmp_path / name)


@pytest.mark.parametrize(
    "text", ["%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: [", "P_rect_00: 1\nS_rect_00: wide\n"]
)
def test_a_malformed_calibration_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "calib.yml").write_text(text)
    with pytest.raises(CalibrationError, match=r"calib\.yml") as caught:
        StereoRig.load(tmp_path / "calib.yml")
    assert "\n" not in str(caught.value)


def test_a_size_that_is_none_is_refused(tmp_path: Path) -> None:
    no_size: Any = 640
    with pytest.raises(CalibrationError, match=r"give \(width, height\)"):
        StereoRig.load(tmp_path, no_size)


def test_the_vertical_is_the_body_s_and_of_a_camera_alone_the_image_s() -> None:
    np.testing.assert_allclose(vertical_of(BODY_FORWARD_LEFT_UP_FROM_CAMERA), [0.0, -1.0, 0.0])
    np.testing.assert_allclose(vertical_of(np.eye(4)), [0.0, -1.0, 0.0])
    rectified = se3_exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(vertical_of(rectified), [0.0, -1.0, 0.0], rtol=0, atol=1e-12)
    tilted = BODY_FORWARD_LEFT_UP_FROM_CAMERA @ se3_exp(np.array([0.3, 0.0, 0.0, 1.0, 2.0, 3.0]))
    up = [0.0, -np.cos(0.3), np.sin(0.3)]
    np.testing.assert_allclose(vertical_of(tilted), up, rtol=0, atol=1e-12)
