"""One pair of cameras in files of further tools: each gives the rig of OpenCV's own files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from fgslam.cameras.rig import load_rig, read_calibration_file
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import pose, so3_exp

SIZE = (64, 48)
K = [np.array([[40.0 + k, 0, 31.0 - k], [0, 40.5, 23.0 + k], [0, 0, 1.0]]) for k in (0, 1)]
D = [np.array([-0.2, 0.05, 1e-3, -5e-4, 0.01]), np.array([-0.21, 0.06, -1e-3, 5e-4, 0.0])]
RIGHT_FROM_LEFT = pose(so3_exp(np.array([0.005, 0.01, -0.003])), np.array([-0.12, 0.001, -5e-4]))
R, T = RIGHT_FROM_LEFT[:3, :3], RIGHT_FROM_LEFT[:3, 3]


def storage(path: Path, **values: FloatArray) -> Path:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        file.write(key, np.ascontiguousarray(value))
    file.release()
    return path


def as_json(path: Path, **values: Any) -> Path:
    plain = json.dumps(values, default=lambda array: array.tolist())
    path.write_text(plain, encoding="utf-8")
    return path


def two_files(root: Path) -> Path:
    """Names that are not those of OpenCV's sample program; the folder holds both."""
    storage(root / "camera_intrinsics.xml", M1=K[0], D1=D[0], M2=K[1], D2=D[1])
    storage(root / "camera_extrinsics.xml", R=R, T=T)
    return root


FILES: dict[str, Callable[[Path], Path]] = {
    "two files of other names": two_files,
    "one of the two": lambda root: two_files(root) / "camera_extrinsics.xml",
    "words before": lambda root: storage(
        root / "s.yml",
        leftCameraMatrix=K[0],
        leftDistCoeffs=D[0],
        rightCameraMatrix=K[1],
        rightDistCoeffs=D[1],
        R=R,
        T=T,
    ),
    "letters behind": lambda root: as_json(
        root / "s.json", mtxL=K[0], distL=[D[0]], mtxR=K[1], distR=[D[1]], rot=R, trans=T[:, None]
    ),
    "parts": lambda root: as_json(
        root / "s.json", left={"K": K[0], "D": D[0]}, right={"K": K[1], "D": D[1]}, R=R, T=T
    ),
}


@pytest.mark.parametrize("name", FILES)
def test_every_file_gives_the_same_rig(tmp_path: Path, name: str) -> None:
    (tmp_path / "other").mkdir()
    storage(tmp_path / "s.yml", M1=K[0], D1=D[0], M2=K[1], D2=D[1], R=R, T=T)
    expected = load_rig(tmp_path / "s.yml", size=SIZE)
    found = load_rig(FILES[name](tmp_path / "other"), size=SIZE)
    for key in ("width", "height", "fx", "fy", "cx", "cy", "baseline"):
        assert getattr(found, key) == pytest.approx(getattr(expected, key), abs=1e-6), key
    assert found.remarks == ()


# --------------------------------------------------------------------------------------------
# ROS


def camera_info(k: int, lens: FloatArray) -> dict[str, Any]:
    return {
        "width": SIZE[0],
        "height": SIZE[1],
        "distortion_model": "plumb_bob" if len(lens) else "",
        "d": lens.tolist(),
        "k": K[k].ravel().tolist(),
        "r": np.eye(3).ravel().tolist(),
        "p": [40.0, 0, 31.0, -40.0 * 0.12 * k, 0, 40.0, 23.0, 0, 0, 0, 1.0, 0],
    }


def as_calibrator(info: dict[str, Any]) -> dict[str, Any]:
    keys = {"k": "camera_matrix", "d": "distortion_coefficients", "r": "rectification_matrix"}
    rows = {"k": 3, "d": 1, "r": 3, "p": 3}
    named = {
        name: {"rows": rows[key], "cols": len(info[key]) // rows[key], "data": info[key]}
        for key, name in {**keys, "p": "projection_matrix"}.items()
    }
    size = {"image_width": info["width"], "image_height": info["height"]}
    return {**size, **named, "distortion_model": info["distortion_model"]}


@pytest.mark.parametrize("letters", ["small, ROS 2", "capital, ROS 1"])
@pytest.mark.parametrize(("ending", "messages"), [("yaml", 1), ("txt", 1), ("txt", 3)])
def test_an_echo_of_the_topic_is_a_file(
    tmp_path: Path, letters: str, ending: str, messages: int
) -> None:
    for k, name in enumerate(("left", "right")):
        info = camera_info(k, D[k])
        (tmp_path / f"{name}.yaml").write_text(yaml.safe_dump(as_calibrator(info)))
        if letters.startswith("capital"):
            info = {key.upper() if len(key) == 1 else key: value for key, value in info.items()}
        echo = {"header": {"frame_id": name}, **info, "binning_x": 0}
        text = messages * (yaml.safe_dump(echo) + "---\n")
        (tmp_path / f"echo_{name}.{ending}").write_text(text)
    expected = load_rig(tmp_path / "left.yaml", tmp_path / "right.yaml")
    found = load_rig(tmp_path / f"echo_right.{ending}")
    assert (found.fx, found.cx, found.baseline) == (expected.fx, expected.cx, expected.baseline)
    assert found.baseline == pytest.approx(0.12)


def test_files_named_by_the_side_belong_together_and_no_lens_is_one(tmp_path: Path) -> None:
    for k, name in enumerate(("left", "right")):
        values = as_calibrator(camera_info(k, np.zeros(0)))
        (tmp_path / f"bumblebee_{name}.yaml").write_text(yaml.safe_dump(values))
    for given in (tmp_path, tmp_path / "bumblebee_right.yaml"):
        assert load_rig(given).baseline == pytest.approx(0.12)
    shutil.copy(tmp_path / "bumblebee_left.yaml", tmp_path / "spare_left.yaml")
    with pytest.raises(CalibrationError, match=r"spare_left\.yaml: one camera alone"):
        load_rig(tmp_path / "spare_left.yaml")


# --------------------------------------------------------------------------------------------
# Others


def zed(lens: str, apart: bool) -> str:
    lines = []
    for side in ("LEFT", "RIGHT"):
        lines += [f"[{side}_CAM_SVGA]", "fx=370", "fy=370", "cx=480", "cy=300"]
        lines += [f"[{side}_DISTO]"] if apart else []
        lines += lens.split()
    return "\n".join([*lines, "[STEREO]", "Baseline=120", *["CV_SVGA=0", "RX_SVGA=0", "RZ_SVGA=0"]])


@pytest.mark.parametrize("apart", [False, True])
def test_all_terms_of_a_zeds_lens_count(tmp_path: Path, apart: bool) -> None:
    """ZED X has eight, in a part of their own; five were read, and that part was not."""
    lens = "k1=0.9 k2=-0.3 p1=0.001 p2=0.002 k3=0.02 k4=1.2 k5=-0.1 k6=0.05"
    (tmp_path / "SN1.conf").write_text(zed(lens, apart), encoding="utf-8")
    found = read_calibration_file(tmp_path / "SN1.conf", size=(960, 600))
    assert found.cameras[1].bTc[0, 3] == pytest.approx(0.12)
    expected = [0.9, -0.3, 0.001, 0.002, 0.02, 1.2, -0.1, 0.05]
    assert all(camera.distortion.tolist() == expected for camera in found.cameras)


def test_a_camchain_that_contradicts_itself_is_told(tmp_path: Path) -> None:
    step = RIGHT_FROM_LEFT.copy()
    chain = {
        f"cam{k}": {
            "camera_model": "pinhole",
            "distortion_model": "radtan",
            "distortion_coeffs": D[k][:4].tolist(),
            "intrinsics": [40.0, 40.0, 31.0, 23.0],
            "resolution": list(SIZE),
            "T_cam_imu": (step if k else np.eye(4)).tolist(),
        }
        for k in (0, 1)
    }
    chain["cam1"]["T_cn_cnm1"] = step.tolist()
    file = tmp_path / "camchain.yaml"
    file.write_text(yaml.safe_dump(chain), encoding="utf-8")
    assert load_rig(file).remarks == ()
    step[0, 3] = -0.1
    chain["cam1"]["T_cn_cnm1"] = step.tolist()
    file.write_text(yaml.safe_dump(chain), encoding="utf-8")
    rig = load_rig(file)
    assert rig.baseline == pytest.approx(0.1, abs=1e-4)
    assert "T_cn_cnm1 and T_cam_imu contradict each other by 0.020 m" in rig.remarks[0]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("stereoParams.mat", "stereoParametersToOpenCV"),
        ("calib.pkl", "a pickle may run programs; write a .json of M1"),
        ("calib.npz", "write its arrays to a .json of M1"),
        ("calib.yaml", r"baseline, fx are keys of fgslam's calib\.json; write it so"),
    ],
)
def test_what_is_not_read_says_what_to_do(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / name).write_text("fx: 40\nbaseline: 0.1\n", encoding="utf-8")
    with pytest.raises(CalibrationError, match=words):
        load_rig(tmp_path / name)


# --------------------------------------------------------------------------------------------
# Published with recordings


def test_drivingstereo_numbers_its_cameras_otherwise(tmp_path: Path) -> None:
    lines = ["calib_time: 2018-07-09", "S_rect_101: 64 48", "S_rect_103: 64 48"]
    for number, shift in ((101, 0.0), (103, -40.0 * 0.54)):
        lines.append(f"P_rect_{number}: 40 0 31 {shift} 0 40 23 0 0 0 1 0")
    (tmp_path / "2018-07-09.txt").write_text("\n".join(lines), encoding="utf-8")
    rig = load_rig(tmp_path / "2018-07-09.txt")
    assert (rig.image_size, rig.cx, rig.baseline) == (SIZE, 31.0, pytest.approx(0.54))


ONE = {
    "cam_params.json": json.dumps(
        {"camera": {"w": 64, "h": 48, "fx": 40, "fy": 40.5, "cx": 31, "cy": 23, "scale": 6553.5}}
    ),
    "splatam.yaml": "camera_params: {image_width: 64, image_height: 48, fx: 40, fy: 40.5, "
    "cx: 31, cy: 23, png_depth_scale: 5000}",
}


@pytest.mark.parametrize("name", ONE)
def test_one_camera_beside_its_depth(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(ONE[name], encoding="utf-8")
    found = read_calibration_file(tmp_path / name, size=SIZE).cameras
    assert len(found) == 1
    assert found[0].matrix.tolist() == [[40.0, 0.0, 31.0], [0.0, 40.5, 23.0], [0.0, 0.0, 1.0]]
    assert found[0].size == SIZE
    assert not found[0].distortion.any()


def test_a_text_that_is_no_calibration(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1 0 0 0.1\n0 1 0 0\n0 0 1 0\n0 0 0 1", encoding="utf-8")
    with pytest.raises(CalibrationError, match="holds no keys and values"):
        read_calibration_file(tmp_path / "a.txt", size=SIZE)
