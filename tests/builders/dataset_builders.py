"""Small recordings on disk with known content, for the readers' tests."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import FloatArray, Image
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import LooseImagesSettings, RecordedOdometrySettings

WIDTH, HEIGHT = 32, 24
CALIBRATION = {
    "width": WIDTH,
    "height": HEIGHT,
    "fx": 30.0,
    "fy": 31.0,
    "cx": 15.5,
    "cy": 11.5,
    "baseline_m": 0.2,
}


def picture(code: int, width: int = WIDTH, height: int = HEIGHT) -> Image:
    """An image that tells by its corner pixel which one it is; the rest is reproducible noise."""
    image = np.random.default_rng(code).integers(0, 255, (height, width), dtype=np.uint8)
    image[0, 0] = code % 256
    return image


def save(path: Path, image: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def write_calibration(root: Path, **changes: object) -> None:
    values = {**CALIBRATION, **changes}
    (root / "calib.json").write_text(json.dumps(values), encoding="utf-8")


def loose(
    root: Path, names: Callable[[int], tuple[str, str]], numbers: Iterable[int] = range(3)
) -> Path:
    """Frame i of the numbers has corner pixels 10 + i (right) and 60 + i (left)."""
    for i, k in enumerate(numbers):
        left, right = names(k)
        save(root / left, picture(60 + i))
        save(root / right, picture(10 + i))
    write_calibration(root)
    return root


def opened_loose(root: Path, **settings: Any) -> Recording:
    return open_recording(
        LooseImagesSettings(path=str(root), **settings), RecordedOdometrySettings()
    )


def codes(recording: Recording) -> list[tuple[int, ...]]:
    frames = [recording.frame(i).images for i in range(len(recording))]
    return [tuple(int(image[0, 0]) for image in images) for images in frames]


def write_tum(path: Path, stamps: FloatArray, poses: FloatArray) -> None:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    rows = np.column_stack([stamps, poses[:, :3, 3], quaternions])
    np.savetxt(path, rows, fmt="%.9f", header="t x y z qx qy qz qw")


def curve(count: int, step: float = 0.5) -> FloatArray:
    """Poses (n, 4, 4) of a camera that moves and turns about all axes."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    angles = np.outer(np.arange(count), [0.02, 0.1, -0.03])
    poses[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    poses[:, :3, 3] = np.outer(np.arange(count), [0.1, -0.05, step])
    return poses


def image_folder(root: Path, frames: int = 6, period: float = 0.1, top: bool = False) -> Path:
    """Frame k has corner pixels 10 + k (right), 60 + k (left), 110 + k (top)."""
    root.mkdir(parents=True, exist_ok=True)
    cameras = {"right": 10, "left": 60, **({"top": 110} if top else {})}
    for name, code in cameras.items():
        for k in range(frames):
            save(root / name / f"{k:06d}.png", picture(code + k))
    times = "".join(f"{k:06d} {k * period:.6f}\n" for k in range(frames))
    (root / "times.txt").write_text(times, encoding="utf-8")
    write_calibration(root, **({"vertical_baseline_m": 0.15} if top else {}))
    return root


def kitti(root: Path, frames: int = 5, sequence: str = "06") -> tuple[Path, FloatArray]:
    """A drive, and the poses of its left camera. Baseline 0.4 m at fx 30."""
    folder = root / "sequences" / sequence
    for name, code in (("image_0", 60), ("image_1", 10)):
        for k in range(frames):
            save(folder / name / f"{k:06d}.png", picture(code + k))
    rows = {"P0": 0.0, "P1": -12.0}
    text = "".join(
        f"{key}: 30.0 0 15.5 {shift} 0 31.0 11.5 0 0 0 1 0\n" for key, shift in rows.items()
    )
    (folder / "calib.txt").write_text(text, encoding="utf-8")
    np.savetxt(folder / "times.txt", 0.1 * np.arange(frames), fmt="%.6e")
    poses = curve(frames)
    (root / "poses").mkdir()
    np.savetxt(root / "poses" / f"{sequence}.txt", poses[:, :3].reshape(frames, 12), fmt="%.9e")
    return root, poses


START_NS = 1_403_715_273_262_142_976
PERIOD_NS = 50_000_000
EUROC_SIZE = (64, 48)


def sensor_yaml(bTc: FloatArray, focal: float = 40.0) -> dict[str, object]:
    return {
        "sensor_type": "camera",
        "T_BS": {"cols": 4, "rows": 4, "data": bTc.ravel().tolist()},
        "resolution": list(EUROC_SIZE),
        "distortion_model": "radial-tangential",
        "intrinsics": [focal, focal + 0.5, 31.0, 23.0],
        "distortion_coefficients": [-0.28, 0.07, 2e-4, -1e-4],
    }


def euroc(root: Path, mountings: tuple[FloatArray, FloatArray], frames: int = 4) -> Path:
    """A recording with cam0 and cam1 mounted as given, cam1's stamps 1 ms late, without truth."""
    for camera, bTc in enumerate(mountings):
        folder = root / "mav0" / f"cam{camera}"
        lines = ["#timestamp [ns],filename"]
        for k in range(frames):
            stamp = START_NS + k * PERIOD_NS + camera * 1_000_000
            save(folder / "data" / f"{stamp}.png", picture(50 * camera + k, *EUROC_SIZE))
            lines.append(f"{stamp},{stamp}.png")
        (folder / "data.csv").write_text("\n".join(lines), encoding="utf-8")
        text = "%YAML:1.0\n" + yaml.safe_dump(sensor_yaml(bTc))
        (folder / "sensor.yaml").write_text(text, encoding="utf-8")
    return root


def write_euroc_truth(root: Path, stamps_ns: list[int], poses: FloatArray, bTs: FloatArray) -> None:
    """Truth of the sensor at ``bTs`` on the body; velocities and biases follow as in EuRoC."""
    folder = root / "mav0" / "state_groundtruth_estimate0"
    folder.mkdir(parents=True)
    q = Rotation.from_matrix(poses[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    lines = ["#timestamp, p x, p y, p z, q w, q x, q y, q z, v x"]
    for stamp, pose, quaternion in zip(stamps_ns, poses, q, strict=True):
        numbers = ",".join(f"{x:.12f}" for x in (*pose[:3, 3], *quaternion, 0.0))
        lines.append(f"{stamp},{numbers}")
    (folder / "data.csv").write_text("\n".join(lines), encoding="utf-8")
    text = yaml.safe_dump({"T_BS": {"cols": 4, "rows": 4, "data": bTs.ravel().tolist()}})
    (folder / "sensor.yaml").write_text(text, encoding="utf-8")
