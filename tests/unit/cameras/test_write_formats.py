"""Calibrations are written in four formats, and read back as they were."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import implausible, read_calibration_file
from fgslam.cameras.write_formats import write_calibration
from fgslam.core.errors import CalibrationError, FgslamError
from fgslam.core.geometry import pose, so3_exp
from fgslam.core.sensors import CameraRig
from fgslam.runs.calibrating import convert_calibration, read_calibration, show_calibration

SIZE = (64, 48)
STEP = pose(so3_exp(np.array([0.013, -0.021, 0.007])), np.array([0.1101, 0.0012, -0.0023]))
PARAMETERS = {
    "radtan": [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
    "equidistant": [0.0034823894022493434, 1e-5, -0.0020532361418706202, 1 / 3],
    "fov": [0.9345470015437782],
    "ds": [-0.27856548233709977, 0.5607322658242858],
    "eucm": [0.5799120978961041, 1.1833251897523838],
    "omni": [1.5104155252441331, -0.26467296958997405, 0.4245068935022319, -0.00375, -0.0022],
    "ocam": [-209.2, 0.0, 0.00213741670953883, -4.2203617319086e-06],
}


def calibration(model: str = "radtan", parameters: list[float] | None = None) -> Calibration:
    matrix = np.array([[50.0 / 0.3, 0.0, 31.1], [0.0, 166.7, 23.3], [0.0, 0.0, 1.0]])
    values = np.array(PARAMETERS[model] if parameters is None else parameters)
    cameras = tuple(
        RawCamera(*SIZE, matrix + k * np.diag([1, 1, 0]), values * (1.0 - 0.1 * k), bTc, "c", model)
        for k, bTc in enumerate((np.eye(4), STEP))
    )
    return Calibration("made", "made", cameras, sided=True)


WRITTEN = [
    *(("a.json", None, model) for model in PARAMETERS),
    *(("a.yaml", None, model) for model in PARAMETERS if model != "ocam"),
    *((name, form, model)
      for name, form in (("a.yml", None), ("a.xml", None), ("a.json", "opencv"))
      for model in ("radtan", "equidistant", "omni")),
]  # fmt: skip


@pytest.mark.parametrize(("name", "form", "model"), WRITTEN)
def test_what_is_written_is_read_back(
    name: str, form: str | None, model: str, tmp_path: Path
) -> None:
    expected = calibration(model)
    write_calibration(expected, tmp_path / name, form=form)
    found = read_calibration_file(tmp_path / name)
    for a, b in zip(found.cameras, expected.cameras, strict=True):
        assert (a.model, a.size) == (b.model, b.size)
        np.testing.assert_array_equal(a.matrix, b.matrix)
        np.testing.assert_array_equal(a.distortion, b.distortion)
    np.testing.assert_allclose(found.offset(1, 0), STEP, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("model", "count"), [("radtan", 5), ("radtan", 8), ("equidistant", 4)], ids=str
)
def test_a_pair_for_ros_is_read_back(model: str, count: int, tmp_path: Path) -> None:
    parameters = [*PARAMETERS[model], 0.01, 0.02, 0.03, 0.04][:count]
    write_calibration(calibration(model, parameters), tmp_path / "a.json")
    convert_calibration(read_calibration(tmp_path / "a.json"), tmp_path / "ros")
    found = read_calibration_file(tmp_path / "ros")
    for k, camera in enumerate(found.cameras):
        np.testing.assert_array_equal(camera.distortion, np.array(parameters) * (1.0 - 0.1 * k))
    np.testing.assert_allclose(found.offset(1, 0), STEP, rtol=0.0, atol=1e-12)


def test_images_of_two_sizes_have_no_place_in_a_file_of_one(tmp_path: Path) -> None:
    left, right = calibration().cameras
    given = Calibration("made", "made", (left, replace(right, width=80)), sided=True)
    with pytest.raises(CalibrationError, match="64x48 and 80x48, but OpenCV's file has one size"):
        write_calibration(given, tmp_path / "a.yml")
    assert not (tmp_path / "a.yml").exists()
    write_calibration(given, tmp_path / "a.json")
    found = read_calibration_file(tmp_path / "a.json")
    assert [camera.size for camera in found.cameras] == [(64, 48), (80, 48)]


def test_five_formats_one_after_another(tmp_path: Path) -> None:
    write_calibration(calibration(), tmp_path / "0.yaml")
    names = ("0.yaml", "1.yml", "2.xml", "3", "4.json", "5.yaml")
    for before, after in pairwise(names):
        convert_calibration(read_calibration(tmp_path / before), tmp_path / after)
    first, last = (read_calibration_file(tmp_path / name) for name in (names[0], names[-1]))
    np.testing.assert_array_equal(first.cameras[1].distortion, last.cameras[1].distortion)
    np.testing.assert_array_equal(first.cameras[1].matrix, last.cameras[1].matrix)
    np.testing.assert_allclose(last.offset(1, 0), STEP, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("given", "name", "form", "words"),
    [
        (calibration("ds"), "a.yml", None, "OpenCV has no model ds; write calib.json"),
        (calibration(parameters=[0.1] * 5), "a.yaml", None, "no radial-tangential model of 5"),
        (calibration(), "a.csv", None, "no format ends like that; known: .json"),
        (calibration(), "a.txt", "kalibr", "is written as .yaml or .yml"),
        (calibration(), "a.yaml", "okvis", "format 'okvis' is not known; use fgslam, opencv"),
    ],
)
def test_what_a_format_cannot_hold_is_refused(
    given: Calibration, name: str, form: str | None, words: str, tmp_path: Path
) -> None:
    with pytest.raises(CalibrationError, match=words):
        write_calibration(given, tmp_path / name, form=form)
    assert not (tmp_path / name).exists()


# --------------------------------------------------------------------------------------------
# Shown


def test_a_calibration_in_words_and_as_a_picture(tmp_path: Path) -> None:
    write_calibration(calibration(), tmp_path / "a.json")
    lines = show_calibration(read_calibration(tmp_path / "a.json"), tmp_path / "a.png")
    assert "calib.json of fgslam, 2 cameras" in lines[0]
    assert [line.split()[0] for line in lines[1:4]] == ["camera", "0:", "1:"]
    length = 1e3 * float(np.linalg.norm(STEP[:3, 3]))
    assert f"right = c, left = c; baseline {length:.2f} mm" in lines[4]
    assert "the cameras overlap in 100.0 % of it" in lines[5]
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_black_borders_are_counted(tmp_path: Path) -> None:
    write_calibration(calibration(), tmp_path / "a.json")
    lines = show_calibration(read_calibration(tmp_path / "a.json"), None, 60.0)
    share = float(lines[5].split(" % of it")[0].rpartition(" ")[2])
    assert share < 50.0


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"size": "wide"}, "--size wide: give whole numbers, as --size 640x480"),
        ({"size": "128x96"}, "is for images of 64x48 pixels, the images have 128x96"),
        ({"cameras": "0"}, "give two or three of 0 to 1"),
        ({"fov": 190.0}, "perspective view takes 0 to 170"),
    ],
)
def test_wrong_options(asked: dict[str, object], words: str, tmp_path: Path) -> None:
    write_calibration(calibration(), tmp_path / "a.json")
    with pytest.raises(FgslamError, match=words):
        show_calibration(read_calibration(tmp_path / "a.json", **asked), None)  # type: ignore[arg-type]


def test_numbers_of_another_resolution_are_noticed() -> None:
    size, half = (640, 480), np.array([160.0, 120.0])
    for (cx, cy), said in ((half, 1), (2.0 * half, 0), (half * (2.0, 1.0), 0)):
        rig = CameraRig(*size, 300.0, 300.0, cx, cy, 0.1, None, np.eye(4))
        assert len(implausible("a.json", rig)) == said
    assert (
        "the middle of images 0.50 times as large as these"
        in implausible("a.json", CameraRig(*size, 300.0, 300.0, *half, 0.1, None, np.eye(4)))[0]
    )


def test_millimetres_are_noticed_and_mended(tmp_path: Path) -> None:
    cameras = list(calibration().cameras)
    far = pose(STEP[:3, :3], 1e3 * STEP[:3, 3])
    cameras[1] = RawCamera(*SIZE, cameras[1].matrix, cameras[1].distortion, far, "c")
    write_calibration(Calibration("made", "made", tuple(cameras)), tmp_path / "a.yaml")
    said = show_calibration(read_calibration(tmp_path / "a.yaml"), None)
    assert "the baseline is 110.1 m; if its unit is not the metre, give it" in said[-1]
    mended = show_calibration(read_calibration(tmp_path / "a.yaml", unit=0.001), None)
    assert "baseline 110.13 mm" in mended[4]
    assert len(mended) == len(said) - 1


def test_one_camera_has_no_rig(tmp_path: Path) -> None:
    alone = Calibration("made", "made", calibration().cameras[:1])
    write_calibration(alone, tmp_path / "a.json")
    lines = show_calibration(read_calibration(tmp_path / "a.json"), None)
    assert "1 camera" in lines[0]
    assert len(lines) == 3
