"""A corrected calibration is written and read back, and undoes what was wrong with the images."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fgslam.cameras.corrected import rectifier_of, write_corrected
from fgslam.cameras.rig import StereoRig, load_rig
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.rig_correction import (
    SHARED,
    RigCorrection,
    camera_displacements,
    shared_displacements,
    term_names,
)
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


def test_a_correction_of_older_files_has_none_of_the_later_terms(tmp_path: Path) -> None:
    path = tmp_path / "camera.json"
    write_corrected(path, knocked(PAIR))
    content = json.loads(path.read_text())
    for name in ("left.decentring_x_outer", "left.decentring_y_outer", "all.radial"):
        del content["corrections"][name]
    path.write_text(json.dumps(content))
    back, expected = StereoRig.load(path).rectifier, rectifier_of(PAIR, knocked(PAIR).values)
    assert back is not None
    np.testing.assert_array_equal(back.maps[1], expected.maps[1])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"left.yew": 0.1}, "has 'left.yew', which is no term; known: left.column"),
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


@pytest.mark.parametrize("rig", [PAIR, THREE], ids=["two cameras", "three cameras"])
def test_a_frame_that_shows_nothing_is_displaced_by_nothing(rig: CameraRig) -> None:
    found = shared_displacements(rig, np.empty((0, rig.cameras, 2)))
    assert found.shape == (0, 2 * rig.cameras, len(SHARED))
