"""Calibration files that people have: what each tool's file says, and what is said of wrong ones.

Facts are those of the SOURCE.md beside the files, found by other programs.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fgslam.cameras.lenses import Calibration
from fgslam.cameras.rig import read_calibration_file
from fgslam.core.arrays import FloatArray
from fgslam.runs.calibrating import Asked, show_calibration

pytestmark = pytest.mark.data


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
    "kalibr/msckf_vio/camchain-imucam-fla.yaml": 0.20006,
    "kalibr/kimera_vio_ros/euroc_camchain.yaml": 0.11007,
    "kalibr/whyscience_t265_omni": 0.06380,
    "calibrations/openvins/euroc_mav/kalibr_imucam_chain.yaml": EUROC,
    "calibrations/openvins/tum_vi/kalibr_imucam_chain.yaml": 0.10109,
    "calibrations/openvins/kaist/kalibr_imucam_chain.yaml": 0.47515,
    "calibrations/basalt/euroc_ds_calib.json": 0.11023,
    "calibrations/vins_fusion/euroc/euroc_stereo_imu_config.yaml": EUROC,
    "calibrations/kimera_vio/Euroc": EUROC,
    "calibrations/kitti/calib_cam_to_cam.txt": 0.53715,
    "camera_info/side_x_side_stereo/2022-12-15-16-50-41-camchain.yaml": 0.0591,
    "camera_info/side_x_side_stereo/left.yaml": 0.05489,
    "camera_info/tp_vision": 0.11184,
    "camera_info/i3dr": 0.08833,
    "camera_info/ps4eye": 0.07857,
    "camera_info/trebladev": 0.06337,
    "camera_info/emmanuelmess": 0.05966,
    "camera_info/uby56_imx219_stereo": 0.0631,
    "camera_info/zed/zed-cam-sn-1010.conf": 0.120,
    "camera_info/oak/depthai_calib.json": 0.073789,
    "stereo_fisheye/mystereocalib.yml": 0.10996,
    "stereo_chessboard/opencv": 3.343,  # squares
    "stereo_chessboard/barry": 92.05,  # millimetres
}


@pytest.mark.parametrize("name", BASELINES)
def test_the_baseline_of_every_tools_file(files: Path, name: str) -> None:
    expected = BASELINES[name]
    assert baseline(read(files / name)) == pytest.approx(expected, rel=6e-4)


def test_a_swapped_pair_of_ros_files_is_said_when_shown(files: Path) -> None:
    lines = show_calibration(Asked(files / "camera_info/uby56_imx219_stereo"), None)
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


@pytest.mark.parametrize("name", ["euroc", "tumvi_512"])
def test_basalts_two_models_see_the_same(files: Path, name: str) -> None:
    folder = files / "calibrations" / "basalt"
    ds, eucm = (read(folder / f"{name}_{model}_calib.json") for model in ("ds", "eucm"))
    for camera in (0, 1):
        assert round(float(apart(ds, eucm, 60.0, camera).max()), 2) <= 0.04


def test_basalt_and_openvins_see_tum_vi_alike(files: Path) -> None:
    calibrations = files / "calibrations"
    distances = apart(
        read(calibrations / "basalt" / "tumvi_512_ds_calib.json"),
        read(calibrations / "openvins" / "tum_vi" / "kalibr_imucam_chain.yaml"),
        60.0,
    )
    assert np.median(distances) == pytest.approx(0.14, abs=0.05)
    assert distances.max() <= 0.45


def test_camodocals_and_kalibrs_file_of_one_camera_agree(files: Path) -> None:
    folder = files / "kalibr" / "whyscience_t265_omni"
    mei, chain = read(folder / "fisheye1_mei.yaml"), read(folder)
    assert apart(mei, chain, 70.0).max() < 1e-4  # eight digits there


def test_vins_pinhole_and_mei_of_euroc_agree(files: Path) -> None:
    folder = files / "calibrations" / "vins_fusion" / "euroc"
    mei, pinhole = (read(folder / f"cam1_{kind}.yaml") for kind in ("mei", "pinhole"))
    assert np.median(apart(pinhole, mei, 35.0)) < 1.5  # two calibrations: cx is 1.0 px apart


def test_the_oak_rectifies_as_its_memory_says(files: Path) -> None:
    """OpenCV reproduced the stored rotations to 2.6e-8 from the same numbers."""
    import json

    import cv2

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
