"""A corrected calibration is written and read back, and undoes what was wrong with the images."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from fgslam.cameras.calib_json import raw_values, write_corrected
from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rectify import rectifier_of
from fgslam.cameras.rig import (
    StereoRig,
    load_rig,
    read_calibration_file,
)
from fgslam.cameras.write_formats import write_calibration
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import (
    RigCorrection,
    camera_displacements,
    term_names,
)
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, se3_exp
from fgslam.core.sensors import CameraRig

PAIR = CameraRig(160, 120, 130.0, 131.0, 79.5, 59.5, 0.1, None, np.diag([-1.0, 1.0, -1.0, 1.0]))
THREE = CameraRig(160, 120, 130.0, 131.0, 79.5, 59.5, 0.1, 0.12, np.eye(4))


def knocked(rig: CameraRig) -> RigCorrection:
    values = np.zeros(len(term_names(rig)))
    for name, value in {"left.yaw": 0.01, "left.roll": 0.02, "left.focal": 0.005}.items():
        values[term_names(rig).index(name)] = value
    return RigCorrection(rig, values, 1e-6 * np.eye(len(values)))


def marks(places: FloatArray, rig: CameraRig) -> FloatArray:
    """An image with a bright spot at each place."""
    column, row = np.meshgrid(np.arange(rig.width), np.arange(rig.height))
    spots = [np.exp(-((column - x) ** 2 + (row - y) ** 2) / 8.0) for x, y in places]
    return np.asarray(255.0 * np.sum(spots, axis=0)).astype(np.uint8)


def centre_of(image: FloatArray, around: FloatArray) -> FloatArray:
    x, y = np.round(around).astype(int)
    part = image[y - 7 : y + 8, x - 7 : x + 8].astype(float)
    off_x, off_y = np.meshgrid(np.arange(-7, 8), np.arange(-7, 8))
    return np.array([(part * off_x).sum(), (part * off_y).sum()]) / part.sum() + [x, y]


@pytest.mark.parametrize("rig", [PAIR, THREE], ids=["two cameras", "three cameras"])
def test_it_is_read_back(rig: CameraRig, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    write_corrected(path, knocked(rig))
    back = StereoRig.load(path)
    for name in CameraRig.__dataclass_fields__:
        np.testing.assert_array_equal(getattr(back, name), getattr(rig, name), err_msg=name)
    assert back.rectifier is not None
    expected = rectifier_of(rig, knocked(rig).values)
    for found, wanted in zip(back.rectifier.maps, expected.maps, strict=True):
        np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize("rig", [PAIR, THREE], ids=["two cameras", "three cameras"])
def test_another_unit_of_length_leaves_the_correction(rig: CameraRig, tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    write_corrected(path, knocked(rig))
    metres, half = StereoRig.load(path), load_rig(path, unit_m=0.5)
    assert half.baseline == 0.5 * metres.baseline
    assert half.rectifier is not None
    assert metres.rectifier is not None
    assert half.rectifier.rig.baseline == half.baseline
    np.testing.assert_array_equal(half.rectifier.maps, metres.rectifier.maps)
    with pytest.raises(CalibrationError, match="as one camera"):
        load_rig(path, unit_m=1e-3)


def test_images_are_corrected_to_where_an_exact_rig_sees() -> None:
    exact = np.array([[30.0, 30.0], [120.0, 40.0], [40.0, 95.0], [130.0, 90.0]])
    wrong = knocked(PAIR)
    seen = exact + camera_displacements(PAIR, 1, exact) @ wrong.values
    assert np.abs(seen - exact).max() > 1.0
    straight = rectifier_of(PAIR, wrong.values).rectify(1, marks(seen, PAIR))
    for place in exact:
        np.testing.assert_allclose(centre_of(straight, place), place, rtol=0.0, atol=0.05)
    right = marks(exact, PAIR)
    np.testing.assert_array_equal(rectifier_of(PAIR, wrong.values).rectify(0, right), right)


def test_a_rig_without_correction_needs_no_rectifier(tmp_path: Path) -> None:
    write_corrected(tmp_path / "camera.json", RigCorrection.none(PAIR))
    assert StereoRig.load(tmp_path / "camera.json").rectifier is None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"left.yew": 0.1}, "has 'left.yew', no term; known: left.column"),
        ({"left.yaw": "much"}, "left.yaw is 'much', not a finite number"),
    ],
)
def test_what_is_no_correction_is_refused(
    change: dict[str, object], words: str, tmp_path: Path
) -> None:
    path = tmp_path / "camera.json"
    write_corrected(path, knocked(PAIR))
    values = json.loads(path.read_text())
    values["corrections"] |= change
    path.write_text(json.dumps(values))
    with pytest.raises(CalibrationError, match=words):
        StereoRig.load(path)
    path.write_text(json.dumps(values | {"corrections": [1.0]}))
    with pytest.raises(CalibrationError, match="must be an object"):
        StereoRig.load(path)


# --------------------------------------------------------------------------------------------
# Of cameras that are not rectified


def raw_pair(tmp_path: Path) -> Path:
    """A calibration of two cameras with lenses, turned against each other."""
    matrix = np.array([[130.0, 0.0, 79.5], [0.0, 130.0, 59.5], [0.0, 0.0, 1.0]])
    bends = (np.array([-0.2, 0.05, 1e-3, -1e-3]), np.array([-0.18, 0.04, 0.0, 5e-4]))
    places = (np.eye(4), se3_exp(np.array([0.01, -0.02, 0.005, 0.1, 0.001, 0.0])))
    cameras = tuple(
        RawCamera(160, 120, matrix, bend, place, name)
        for bend, place, name in zip(bends, places, ("left", "right"), strict=True)
    )
    path = tmp_path / "raw.json"
    path.write_text(json.dumps(raw_values(Calibration("made", "made", cameras, sided=True))))
    return path


def test_raw_cameras_without_a_correction_keep_their_view(tmp_path: Path) -> None:
    before = load_rig(raw_pair(tmp_path), fov_deg=50.0)
    write_corrected(tmp_path / "same.json", RigCorrection.none(before.plain()), before.rectifier)
    after = load_rig(tmp_path / "same.json")
    assert after.angles_deg == pytest.approx(before.angles_deg)


def test_a_cylindrical_view_of_earlier_versions_is_refused(tmp_path: Path) -> None:
    before = load_rig(raw_pair(tmp_path))
    path = tmp_path / "of_raw.json"
    write_corrected(path, RigCorrection.none(before.plain()), before.rectifier)
    values = json.loads(path.read_text())
    values["rectified_view"]["kind"] = "cylindrical"
    path.write_text(json.dumps(values))
    rectified = tmp_path / "calib.json"
    numbers = {"width": 160, "height": 120, "fx": 130, "fy": 130, "cx": 79.5, "cy": 59.5}
    rectified.write_text(json.dumps(numbers | {"baseline_m": 0.1, "view": "cylindrical"}))
    for file in (path, rectified):
        with pytest.raises(CalibrationError, match="only perspective views are read"):
            load_rig(file)


@pytest.mark.parametrize("asked", [{}, {"fov_deg": 50.0}], ids=str)
def test_a_correction_of_raw_cameras_is_undone_in_their_raw_images(
    asked: dict[str, Any], tmp_path: Path
) -> None:
    before = load_rig(raw_pair(tmp_path), **asked)
    wrong = knocked(before.plain())
    assert before.rectifier is not None
    write_corrected(tmp_path / "better.json", wrong, before.rectifier)
    after = load_rig(tmp_path / "better.json")
    assert after.rectifier is not None
    for name in CameraRig.__dataclass_fields__:
        found, expected = getattr(after, name), getattr(before, name)
        if isinstance(expected, float | int | np.ndarray):
            np.testing.assert_allclose(found, expected, atol=1e-12)
    exact = np.array([[40.0, 30.0], [75.0, 60.0], [110.0, 50.0]])
    seen = (exact + camera_displacements(before, 1, exact) @ wrong.values).astype(np.float32)
    columns, rows = exact.astype(int).T
    for of_before, of_after in zip(before.rectifier.maps[1], after.rectifier.maps[1], strict=True):
        expected = cv2.remap(of_before, seen[None], None, cv2.INTER_LINEAR)[0]
        np.testing.assert_allclose(of_after[rows, columns], expected, atol=0.02)
    np.testing.assert_allclose(after.rectifier.maps[0], before.rectifier.maps[0], atol=1e-4)


@pytest.mark.parametrize("raw", [True, False], ids=["raw", "rectified"])
def test_a_second_correction_is_added_to_the_first(raw: bool, tmp_path: Path) -> None:
    rig = load_rig(raw_pair(tmp_path))
    path, rectifier = tmp_path / "better.json", rig.rectifier if raw else None
    for times in (1, 2):
        write_corrected(path, knocked(rig.plain()), rectifier)
        values = json.loads(path.read_text())["corrections"]
        assert values["left.yaw"] == pytest.approx(0.01 * times)
        rectifier = load_rig(path).rectifier


def test_raw_cameras_are_written_as_they_were_mounted(tmp_path: Path) -> None:
    rig = load_rig(raw_pair(tmp_path))
    mounted = replace(rig.plain(), bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA)
    write_corrected(tmp_path / "better.json", knocked(mounted), rig.rectifier)
    back = load_rig(tmp_path / "better.json")
    np.testing.assert_allclose(back.bTc, mounted.bTc, atol=1e-12)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"fov_deg": 60.0}, "has corrections, .*another view"),
        ({"size": (320, 240), "scale": True}, "has corrections, .*320x240"),
        ({"cameras": (1, 0)}, "has corrections, .*some of its cameras"),
    ],
)
@pytest.mark.parametrize("raw", [True, False], ids=["raw", "rectified"])
def test_what_would_lose_a_correction_is_refused(
    raw: bool, given: dict[str, Any], words: str, tmp_path: Path
) -> None:
    rig = load_rig(raw_pair(tmp_path))
    path = tmp_path / "better.json"
    write_corrected(path, knocked(rig.plain()), rig.rectifier if raw else None)
    if not raw and "cameras" in given:
        return  # they are left and right by name
    with pytest.raises(CalibrationError, match=words):
        load_rig(path, **given)
    with pytest.raises(CalibrationError, match="Kalibr cannot hold them"):
        write_calibration(read_calibration_file(path), tmp_path / "chain.yaml")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"rotations": [np.ones((3, 3)).tolist()] * 2}, "no rotation"),
        ({"rotations": [np.eye(3).tolist()]}, "expected 18 finite numbers"),
        ({"width": 0}, "width and height are 0"),
    ],
)
def test_a_stated_view_that_is_none_is_refused(
    change: dict[str, Any], words: str, tmp_path: Path
) -> None:
    rig = load_rig(raw_pair(tmp_path))
    path = tmp_path / "better.json"
    write_corrected(path, knocked(rig.plain()), rig.rectifier)
    values = json.loads(path.read_text())
    path.write_text(json.dumps(values | {"rectified_view": values["rectified_view"] | change}))
    with pytest.raises(CalibrationError, match=words):
        load_rig(path)
    del values["rectified_view"]
    path.write_text(json.dumps(values))
    with pytest.raises(CalibrationError, match="rectified_view is missing"):
        load_rig(path)
