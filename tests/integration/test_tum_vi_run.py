"""TUM-VI as published: wide lenses, 16 bits, calibration beside the images; one command maps it."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from recordings import camera_path, views
from running import Capture, Patch, main, metrics_of
from scipy.spatial.transform import Rotation

import fgslam as fg
from fgslam.backend.settings import DEFAULT_ESTIMATOR
from fgslam.cameras.lenses import RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, pose, se3_exp, se3_log

START_NS, PERIOD_NS, FRAMES = 1_520_530_308_199_447_626, 50_000_000, 8
SIZE, COEFFICIENTS = (192, 192), [0.0035, 0.0007, -0.002, 0.0002]
BASELINE = 0.101
BIAS = np.radians([1.5, -0.8, 0.6])
# Of the gyroscope in the axes of camera_path: z up, and a lever arm.
IMU = pose(
    np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, -1.0, 0.0]])
    @ Rotation.from_rotvec([0.02, 0.01, -0.03]).as_matrix(),
    np.array([0.045, -0.071, -0.045]),
)


def lens(shift: float, turn: float) -> RawCamera:
    matrix = np.array([[95.0, 0.0, 95.0], [0.0, 95.0, 97.0], [0.0, 0.0, 1.0]])
    place = se3_exp(np.array([0.0, turn, 0.01, shift, 0.002, 0.0]))
    return RawCamera(*SIZE, matrix, np.array(COEFFICIENTS), place, "lens", "equidistant")


def camchain(cameras: tuple[RawCamera, RawCamera]) -> dict[str, object]:
    chain: dict[str, object] = {}
    for k, camera in enumerate(cameras):
        m = camera.matrix
        chain[f"cam{k}"] = {
            "T_cam_imu": (inverse(camera.bTc) @ IMU).tolist(),
            "cam_overlaps": [1 - k],
            "camera_model": "pinhole",
            "distortion_coeffs": COEFFICIENTS,
            "distortion_model": "equidistant",
            "intrinsics": m[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(),
            "resolution": list(SIZE),
            "rostopic": f"/cam{k}/image_raw",
        } | ({"T_cn_cnm1": (inverse(camera.bTc) @ cameras[0].bTc).tolist()} if k else {})
    return chain


def write_rows(folder: Path, head: str, rows: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "data.csv").write_text("\n".join([head, *rows]), encoding="utf-8")


def write_tum_vi(root: Path, frames: int = FRAMES) -> Path:
    """`dataset-NAME_512_16`: mav0 with cameras, gyroscope and motion capture, dso beside it."""
    cameras = (lens(0.0, 0.0), lens(BASELINE, 0.02))
    stamps = START_NS + PERIOD_NS * np.arange(frames)
    for k in range(2):
        rows = [f"{stamp},{stamp}.png" for stamp in stamps]
        write_rows(root / "mav0" / f"cam{k}", "#timestamp [ns],filename", rows)
        (root / "mav0" / f"cam{k}" / "data").mkdir()
    for stamp, images in zip(stamps, views(cameras, frames), strict=True):
        for k, image in enumerate(images):
            path = root / "mav0" / f"cam{k}" / "data" / f"{stamp}.png"
            assert cv2.imwrite(str(path), image.astype(np.uint16) << 8)
    write_motion(root / "mav0", stamps[0] - 10_000_000, camera_path(frames))
    (root / "dso").mkdir()
    chain = yaml.safe_dump(camchain(cameras))
    (root / "dso" / "camchain.yaml").write_text(chain, encoding="utf-8")
    noise = {"gyroscope_noise_density": 8e-5, "gyroscope_random_walk": 2.2e-6, "update_rate": 200.0}
    (root / "dso" / "imu_config.yaml").write_text(yaml.safe_dump(noise), encoding="utf-8")
    return root


def write_motion(mav: Path, start_ns: int, path: FloatArray) -> None:
    """Samples of imu0 and mocap0 at 200 Hz over the whole drive, which turns evenly."""
    step = se3_log(inverse(path[0]) @ path[1])
    rate = IMU[:3, :3].T @ step[:3] / (1e-9 * PERIOD_NS) + BIAS
    gyroscope, truth = [], []
    for stamp in range(start_ns, start_ns + PERIOD_NS * len(path), 5_000_000):
        wTi = se3_exp(step * (stamp - start_ns - 10_000_000) / PERIOD_NS) @ IMU
        q = Rotation.from_matrix(wTi[:3, :3]).as_quat()[[3, 0, 1, 2]]
        gyroscope.append(",".join([str(stamp), *(f"{v:.9f}" for v in (*rate, 0.0, 0.0, 9.8))]))
        truth.append(",".join([str(stamp), *(f"{v:.9f}" for v in (*wTi[:3, 3], *q))]))
    write_rows(mav / "imu0", "#timestamp [ns],w_RS_S_x [rad s^-1],w_y,w_z,a_x,a_y,a_z", gyroscope)
    write_rows(mav / "mocap0", "#timestamp [ns], p_RS_R_x [m],p_y,p_z,q_RS_w [],q_x,q_y,q_z", truth)


@pytest.mark.usefixtures("in_this_process")
def test_tum_vi_is_mapped_by_the_bare_command(
    tmp_path: Path, monkeypatch: Patch, capfd: Capture
) -> None:
    root = write_tum_vi(tmp_path / "dataset-boards_512_16")
    quiet = ("--set", "output.pictures=false", "--set", "output.report=false")
    assert main(monkeypatch, "run", root, "--out", tmp_path / "run", *quiet) == 0
    said = capfd.readouterr().out
    first = said.splitlines()[0]
    assert "EuRoC native, 2 cameras 192x192, unrectified; 8 frames at 20 Hz" in first
    assert "a gyroscope, no odometry; truth, for evaluation only" in first
    result = metrics_of(tmp_path / "run")["estimators"][DEFAULT_ESTIMATOR]
    assert result["ate_rmse_m"] < 0.003  # of 0.28 m
    assert result["ate_first_pose_m"] < 0.006  # 0.018 by a camera that is rolled by 0.6 degrees
    bias = result["gyroscope_bias_dps"]
    off, sigmas = np.abs(bias["rates"] - np.degrees(BIAS)), np.array(bias["sigmas"])
    assert (off < 4.0 * sigmas).all()
    assert sigmas.max() < 1.0, "of 3 beforehand"
    assert "gyroscope bias, x y z" in said


def test_tum_vi_without_its_calibration_says_where_that_is(tmp_path: Path) -> None:
    root = write_tum_vi(tmp_path / "dataset-boards_512_16", frames=2)
    (root / "dso" / "camchain.yaml").unlink()
    with pytest.raises(CalibrationError, match=r"neither cam0/sensor\.yaml nor, as in TUM-VI, "):
        fg.open_recording(root)
