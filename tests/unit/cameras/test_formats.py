"""Calibration files of each tool: what they say, and what is said of wrong ones."""

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

from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import load_rig, read_calibration_file
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import pose, so3_exp
from fgslam.runs.calibrating import read_calibration, show_calibration

# --------------------------------------------------------------------------------------------
# Files that people have; facts are those of the SOURCE.md next to them, found by other programs


@pytest.fixture
def files(shared_data: Path) -> Path:
    folder = shared_data / "cameras"
    if not folder.is_dir():
        pytest.skip(f"no calibrations at {folder}")
    return folder


def read(path: Path, size: tuple[int, int] | None = None) -> Calibration:
    return read_calibration_file(path, size=size)


def baseline(calibration: Calibration) -> float:
    return float(np.linalg.norm(calibration.offset(1, 0)[:3, 3]))


def fan(widest_deg: float) -> FloatArray:
    """Unit rays (n, 3) up to an angle from the axis."""
    angle, around = np.meshgrid(
        np.radians(np.linspace(0.0, widest_deg, 31)), np.linspace(0.0, 2.0 * np.pi, 48)
    )
    level = np.sin(angle.ravel())
    return np.column_stack(
        [
            level * np.cos(around.ravel()),
            level * np.sin(around.ravel()),
            np.cos(angle.ravel()),
        ]
    )


def apart(a: Calibration, b: Calibration, widest_deg: float, camera: int = 0) -> FloatArray:
    """Distances in pixels between where two calibrations of one camera see the same rays."""
    rays = fan(widest_deg)
    pixels = [one.cameras[camera].project(rays) for one in (a, b)]
    inside = np.all((pixels[0] >= 0) & (pixels[0] <= np.array(a.cameras[camera].size) - 1), axis=1)
    assert inside.sum() > 500
    return np.asarray(np.linalg.norm(pixels[0] - pixels[1], axis=1)[inside])


EUROC = 0.11008
BASELINES = {
    "kalibr/msckf_vio/camchain-imucam-euroc.yaml": EUROC,
    "kalibr/kimera_vio_ros/euroc_camchain.yaml": 0.11007,
    "kalibr/whyscience_t265_omni": 0.06380,
    "calibrations/openvins/euroc_mav/kalibr_imucam_chain.yaml": EUROC,
    "calibrations/openvins/tum_vi/kalibr_imucam_chain.yaml": 0.10109,
    "calibrations/basalt/euroc_ds_calib.json": 0.11023,
    "calibrations/vins_fusion/euroc/euroc_stereo_imu_config.yaml": EUROC,
    "calibrations/kimera_vio/Euroc": EUROC,
    "calibrations/kitti/calib_cam_to_cam.txt": 0.53715,
    "camera_info/side_x_side_stereo/2022-12-15-16-50-41-camchain.yaml": 0.0591,
    "camera_info/side_x_side_stereo/left.yaml": 0.05489,
    "camera_info/tp_vision": 0.11184,
    "camera_info/emmanuelmess": 0.05966,
    "camera_info/uby56_imx219_stereo": 0.0631,
    "camera_info/zed/zed-cam-sn-1010.conf": 0.120,
    "camera_info/oak/depthai_calib.json": 0.073789,
    "stereo_fisheye/mystereocalib.yml": 0.10996,
    "stereo_chessboard/opencv": 3.343,  # squares
    "stereo_chessboard/barry": 92.05,  # millimetres
}


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.data
def test_the_baseline_of_every_tools_file(files: Path, name: str) -> None:
    expected = BASELINES[name]
    assert baseline(read(files / name)) == pytest.approx(expected, rel=6e-4)


@pytest.mark.data
def test_a_swapped_pair_of_ros_files_is_said_when_shown(files: Path) -> None:
    lines = show_calibration(read_calibration(files / "camera_info/uby56_imx219_stereo"), None)
    assert any(line.startswith("rig: right = left.yaml, left = right.yaml") for line in lines)
    assert any(
        "left and right are swapped: left.yaml, the left one by its name" in x for x in lines
    )


SEVEN = {
    "ds-none": 0.08042,
    "eucm-none": 0.08042,
    "pinhole-fov": 0.08041,
    "pinhole-equi": 0.08044,
    "pinhole-radtan": 0.08050,
    "omni-none": 0.08019,
    "omni-radtan": 0.08071,
}
AWAY = {  # from double sphere, up to 50 degrees: median and largest, pixels
    "eucm-none": (0.13, 0.25),
    "pinhole-equi": (0.15, 0.21),
    "pinhole-fov": (0.31, 0.69),
    "omni-radtan": (2.27, 2.43),
    "omni-none": (2.88, 4.5),
}


@pytest.mark.parametrize("model", SEVEN)
@pytest.mark.data
def test_one_rig_in_seven_models(files: Path, model: str) -> None:
    root = files / "kalibr" / "torrescguo_stereo_all_models"
    found = read(root / model / "visio-camchain.yaml")
    assert baseline(found) == pytest.approx(SEVEN[model], abs=6e-6)
    if model not in AWAY:
        return
    distances = apart(read(root / "ds-none" / "visio-camchain.yaml"), found, 50.0)
    middle, largest = AWAY[model]
    # The table was made with another set of rays.
    assert np.median(distances) == pytest.approx(middle, abs=0.05 + 0.05 * middle)
    assert distances.max() == pytest.approx(largest, abs=0.05 + 0.1 * largest)


@pytest.mark.data
def test_basalt_and_openvins_see_tum_vi_alike(files: Path) -> None:
    calibrations = files / "calibrations"
    distances = apart(
        read(calibrations / "basalt" / "tumvi_512_ds_calib.json"),
        read(calibrations / "openvins" / "tum_vi" / "kalibr_imucam_chain.yaml"),
        60.0,
    )
    assert np.median(distances) == pytest.approx(0.14, abs=0.05)
    assert distances.max() <= 0.45


@pytest.mark.data
def test_camodocals_and_kalibrs_file_of_one_camera_agree(files: Path) -> None:
    folder = files / "kalibr" / "whyscience_t265_omni"
    mei, chain = read(folder / "fisheye1_mei.yaml"), read(folder)
    assert apart(mei, chain, 70.0).max() < 1e-4  # eight digits there


@pytest.mark.data
def test_the_oak_rectifies_as_its_memory_says(files: Path) -> None:
    """OpenCV reproduced the stored rotations to 2.6e-8 from the same numbers."""
    path = files / "camera_info" / "oak" / "depthai_calib.json"
    left, right = read(path).cameras
    step = np.linalg.inv(right.bTc) @ left.bTc
    rotations = cv2.stereoRectify(
        left.matrix,
        left.distortion,
        right.matrix,
        right.distortion,
        left.size,
        step[:3, :3],
        step[:3, 3:],
    )[:2]
    stored = json.loads(path.read_text())["stereoRectificationData"]
    for found, key in zip(rotations, ("Left", "Right"), strict=True):
        expected = np.array(stored[f"rectifiedRotation{key}"])
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=3e-8)


@pytest.mark.data
def test_omnidir_and_ocamcalib_are_single_cameras(files: Path) -> None:
    omni = read(files / "camera_info" / "opencv_omnidir" / "out_camera_omni.xml").cameras
    assert (len(omni), omni[0].model, omni[0].size) == (1, "omni", (3008, 3008))
    assert omni[0].distortion[0] == pytest.approx(0.9545891840860713, abs=1e-15)
    for path in sorted((files / "camera_info" / "ocamcalib").glob("*.txt")):
        (camera,) = read(path).cameras
        pixels = camera.matrix[:2, 2] + np.array([[100.0, 0.0], [0.0, 60.0], [-80.0, 40.0]])
        rays = camera.unproject(pixels)
        np.testing.assert_allclose(camera.project(rays), pixels, rtol=0.0, atol=1e-6)
        # Columns grow to the right and rows down, in front of the camera.
        assert rays[0, 0] > 0.0 < rays[1, 1]
        assert rays[0, 2] > 0.0


# --------------------------------------------------------------------------------------------
# One pair of cameras in files of further tools: each gives the rig of OpenCV's own files


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
@pytest.mark.parametrize(("ending", "messages"), [("yaml", 1), ("txt", 3)])
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
        ("cameras.bin", "as text: colmap model_converter"),
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


# --------------------------------------------------------------------------------------------
# Intrinsics of one camera as RealSense, Open3D and people write them


K_ROWS = [[600.0, 0.0, 320.0], [0.0, 601.0, 240.0], [0.0, 0.0, 1.0]]
RS2 = {"fx": 600.0, "fy": 601.0, "ppx": 320.0, "ppy": 240.0}
PLAIN = {"fx": 600.0, "fy": 601.0, "cx": 320.0, "cy": 240.0}
LENS = [0.1, -0.2, 0.001, 0.002, 0.05]


def read_intrinsics(folder: Path, **values: Any) -> RawCamera:
    path = folder / "intrinsics.json"
    path.write_text(json.dumps({"width": 640, "height": 480, **values}), encoding="utf-8")
    return read_calibration_file(path).cameras[0]


@pytest.mark.parametrize(
    "matrix", [K_ROWS, np.ravel(K_ROWS).tolist(), np.ravel(K_ROWS, "F").tolist()]
)
def test_a_matrix_by_rows_or_by_columns(tmp_path: Path, matrix: list[Any]) -> None:
    assert np.array_equal(read_intrinsics(tmp_path, intrinsic_matrix=matrix).matrix, K_ROWS)


def test_a_matrix_that_is_none_of_a_camera(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match="must end with the row 0 0 1"):
        read_intrinsics(tmp_path, intrinsic_matrix=[*np.ravel(K_ROWS)[:8].tolist(), 2.0])


@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("Brown Conrady", "radtan"),
        ("RS2_DISTORTION_MODIFIED_BROWN_CONRADY", "radtan"),
        ("Kannala Brandt4", "equidistant"),
        (5, "equidistant"),
    ],
)
def test_lenses_by_the_model_that_is_stated(tmp_path: Path, model: object, lens: str) -> None:
    camera = read_intrinsics(tmp_path, **RS2, model=model, coeffs=LENS)
    assert camera.model == lens
    assert camera.distortion.tolist() == LENS[: 4 if lens == "equidistant" else 5]


@pytest.mark.parametrize("model", ["F-Theta", 2])
def test_lenses_that_are_not_known(tmp_path: Path, model: object) -> None:
    assert not read_intrinsics(tmp_path, **RS2, model=model, coeffs=[0.0] * 5).distortion.any()
    with pytest.raises(CalibrationError, match="is not known with coefficients other than 0"):
        read_intrinsics(tmp_path, **RS2, model=model, coeffs=LENS)


@pytest.mark.parametrize(
    "lens", [dict(zip(("k1", "k2", "p1", "p2", "k3"), LENS, strict=True)), {"distortion": LENS}]
)
def test_the_lens_beside_plain_numbers_is_read(tmp_path: Path, lens: dict[str, Any]) -> None:
    assert read_intrinsics(tmp_path, **PLAIN, **lens).distortion.tolist() == LENS


def test_a_fisheye_by_single_numbers_must_say_so(tmp_path: Path) -> None:
    four = {f"k{k}": 0.01 * k for k in (1, 2, 3, 4)}
    with pytest.raises(CalibrationError, match="without p1, p2 need"):
        read_intrinsics(tmp_path, **PLAIN, **four)
    camera = read_intrinsics(tmp_path, **PLAIN, **four, model="fisheye")
    assert (camera.model, camera.distortion.tolist()) == ("equidistant", list(four.values()))


# --------------------------------------------------------------------------------------------
# ORB-SLAM's settings files: both generations of keys, all types of cameras, and wrong ones


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


def read_settings(folder: Path, *parts: str, kind: str = "PinHole") -> Calibration:
    file = folder / "settings.yaml"
    file.write_text(HEAD.format(kind=kind) + "".join(parts), encoding="utf-8")
    return read_calibration_file(file)


def test_orb_slam3_pinhole_pair(tmp_path: Path) -> None:
    parts = (FIRST, TANGENTIAL.format(n=1), SECOND, TANGENTIAL.format(n=2), STEP)
    found = read_settings(tmp_path, *parts)
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
    found = read_settings(tmp_path, plain, "Stereo.b: 0.11007\n", kind="Rectified")
    assert len(found.cameras) == 2
    np.testing.assert_array_equal(found.cameras[0].matrix, found.cameras[1].matrix)
    assert not found.cameras[0].distortion.any()
    np.testing.assert_allclose(found.offset(1, 0)[:3, 3], [0.11007, 0.0, 0.0], atol=1e-12)


def test_orb_slam3_fisheyes(tmp_path: Path) -> None:
    terms = "Camera{n}.k3: -0.00203\nCamera{n}.k4: 0.0002\n"
    parts = (FIRST, terms.format(n=1), SECOND, terms.format(n=2), STEP)
    found = read_settings(tmp_path, *parts, kind="KannalaBrandt8")
    assert [camera.model for camera in found.cameras] == ["equidistant"] * 2
    np.testing.assert_array_equal(
        found.cameras[0].distortion, [-0.28340811, 0.07395907, -0.00203, 0.0002]
    )


def test_orb_slam2_pair_by_focal_length_times_baseline(tmp_path: Path) -> None:
    old = FIRST.replace("Camera1.", "Camera.") + "Camera.bf: 50.45194\n"
    found = read_settings(tmp_path, old)
    assert len(found.cameras) == 2
    assert found.offset(1, 0)[0, 3] == pytest.approx(0.11, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "kind", "words"),
    [
        (FIRST, "Omni", "Camera.type omni is not known; known: pinhole, perspective, rectified"),
        (FIRST.replace("Camera1.cy: 248.375\n", ""), "PinHole", "Camera1.cy"),
        (FIRST.replace("458.654", "-458.654"), "PinHole", "must be positive"),
    ],
)
def test_wrong_settings_are_refused(tmp_path: Path, text: str, kind: str, words: str) -> None:
    with pytest.raises(CalibrationError, match=words):
        read_settings(tmp_path, text, kind=kind)


# --------------------------------------------------------------------------------------------
# Variants of known tools, and files that hold no pair


EUROC_LENS = "-0.2834 0.0740 0.0002 0.00002"
RIGS = (
    "# RIG_ID, NUM_SENSORS, REF_SENSOR_TYPE, REF_SENSOR_ID, SENSORS[]\n"
    "1 3 CAMERA 1 IMU 1 0 CAMERA 2 1 1 0 0 0 -0.11 0 0\n"
)


def colmap(root: Path, *models: str) -> Path:
    lines = [f"{k} {model}" for k, model in enumerate(models, start=1)]
    (root / "cameras.txt").write_text("# Camera list\n" + "\n".join(lines), encoding="utf-8")
    return root / "cameras.txt"


@pytest.mark.parametrize(
    ("line", "model", "numbers", "focal"),
    [
        (f"OPENCV 752 480 458 457 367 248 {EUROC_LENS}", "radtan", 4, (458.0, 457.0)),
        (f"FULL_OPENCV 752 480 458 457 367 248 {EUROC_LENS} 0 0 0 0", "radtan", 8, (458.0, 457.0)),
        ("SIMPLE_RADIAL 752 480 458 367 248 -0.28", "radtan", 4, (458.0, 458.0)),
        ("OPENCV_FISHEYE 752 480 458 457 367 248 0.1 0 0 0", "equidistant", 4, (458.0, 457.0)),
        ("FOV 752 480 458 457 367 248 0.9", "fov", 1, (458.0, 457.0)),
    ],
)
def test_cameras_of_colmap(
    tmp_path: Path, line: str, model: str, numbers: int, focal: tuple[float, float]
) -> None:
    camera = read(colmap(tmp_path, line)).cameras[0]
    assert (camera.model, len(camera.distortion)) == (model, numbers)
    assert tuple(camera.intrinsics) == (*focal, 367.0, 248.0)


def test_a_rig_of_colmap_needs_its_rigs_file(tmp_path: Path) -> None:
    path = colmap(tmp_path, *["PINHOLE 752 480 458 457 367 248"] * 2)
    with pytest.raises(CalibrationError, match=r"holds 2 cameras, .* put the rigs\.txt"):
        read(path)
    (tmp_path / "rigs.txt").write_text(RIGS, encoding="utf-8")
    assert load_rig(tmp_path).baseline == pytest.approx(0.11, abs=1e-12)
    with pytest.raises(CalibrationError, match=r"camera 2: model THIN is not known; known: SIMPLE"):
        read(colmap(tmp_path, "PINHOLE 752 480 458 457 367 248", "THIN 752 480 1 2"))
    with pytest.raises(CalibrationError, match=r"camera 1: FOV has 5 parameters"):
        read(colmap(tmp_path, "FOV 752 480 458 457 367 248"))


STELLA = {
    "setup": "stereo",
    "model": "perspective",
    "fx": 500.0,
    "fy": 500.0,
    "cx": 320.0,
    "cy": 240.0,
    "cols": 640,
    "rows": 480,
    "focal_x_baseline": 60.0,
}


def test_settings_of_stella_vslam_nested_flat_and_side_by_side(tmp_path: Path) -> None:
    path = tmp_path / "stella.yaml"
    for values in ({"Camera": STELLA}, {f"Camera.{key}": v for key, v in STELLA.items()}):
        path.write_text(yaml.safe_dump(values), encoding="utf-8")
        rig = load_rig(path)
        assert (rig.width, rig.fx, rig.baseline) == (640, 500.0, pytest.approx(0.12, abs=1e-12))
    matrix, turn = [510.0, 0.0, 321.0, 0.0, 510.0, 241.0, 0.0, 0.0, 1.0], np.eye(3).ravel().tolist()
    values = {"K": matrix, "D": [-0.1, 0.02, 0.0, 0.0], "R": turn}
    sides = {f"{name}_{side}": its for side in ("left", "right") for name, its in values.items()}
    both = {"Camera": STELLA | {"cols": 1280}, "StereoRectifier": sides}
    path.write_text(yaml.safe_dump(both), encoding="utf-8")
    rig = load_rig(path)
    assert (rig.image_size, rig.baseline) == ((640, 480), pytest.approx(0.12, abs=1e-12))
    assert "1280 columns are both views side by side, and halved" in rig.remarks[0]


def test_files_of_vins_from_another_machine_lie_next_to_it(tmp_path: Path) -> None:
    camera = {
        "model_type": "PINHOLE",
        "image_width": 640,
        "image_height": 480,
        "distortion_parameters": dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "projection_parameters": {"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0},
    }
    (tmp_path / "cam.yaml").write_text(yaml.safe_dump(camera), encoding="utf-8")
    places = (np.eye(4), pose(np.eye(3), np.array([0.1, 0.0, 0.0])))
    values = {f"cam{k}_calib": "/home/me/config/cam.yaml" for k in range(2)}
    values |= {f"body_T_cam{k}": place.ravel().tolist() for k, place in enumerate(places)}
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    assert load_rig(path).baseline == pytest.approx(0.1, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("map.xml", "<?xml version='1.0'?><opencv_storage><stereoMapL_x type_id='opencv-matrix'>"
         "<rows>1</rows><cols>1</cols><dt>f</dt><data>1</data></stereoMapL_x></opencv_storage>",
         "rectification maps of OpenCV, no camera: rectify the images by them"),
        ("camera.txt", "0.34 0.43 0.49 0.49 0.93\n1280 1024\ncrop\n640 480\n", "of DSO"),
        ("camera.txt", "RadTan 458 457 367 248 0 0 0 0\n752 480\ncrop\n640 480\n", "of DSO"),
        ("results-cam.txt", "Calibration results\n===\nNormalized Residuals\n", r"camchain\.yaml"),
        ("transforms.json", '{"camera_angle_x": 0.7, "frames": []}', "nerfstudio"),
        ("stereo.edex", '[{"version": "0.9", "cameras": [{"intrinsics": {}}]}]', "cuVSLAM"),
        ("scene.sfm", '{"version": [1], "intrinsics": [{"intrinsicId": "1"}]}', "AliceVision"),
        ("notes.yaml", "hello: 1\n", "not a calibration that is known; known: calib.json"),
    ],
)  # fmt: skip
def test_files_of_no_pair_are_named(tmp_path: Path, name: str, text: str, words: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=words) as raised:
        read(tmp_path / name)
    assert "\n" not in str(raised.value)


def test_a_baseline_in_squares_of_the_board_is_doubted(tmp_path: Path) -> None:
    matrix = [[600.0, 0.0, 320.0], [0.0, 600.0, 240.0], [0.0, 0.0, 1.0]]
    values = {"image_size": [640, 480], "R": np.eye(3).tolist(), "T": [-2.41, 0.0, 0.0]}
    values |= {f"M{k}": matrix for k in (1, 2)} | {f"D{k}": [0.1, 0, 0, 0, 0] for k in (1, 2)}
    path = tmp_path / "squares.json"
    path.write_text(json.dumps(values), encoding="utf-8")
    assert any("the side of a square" in remark for remark in load_rig(path).remarks)
    assert load_rig(path, unit_m=0.025).remarks == ()
