"""EuRoC MAV in its native (ASL) layout, rectified on reading (docs/datasets/euroc.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse
from fgslam.core.sensors import CameraRig
from fgslam.datasets.asl_files import (
    NANOSECONDS,
    AslCamera,
    pair_frames,
    read_body_truth,
    read_camera,
    read_camera_frames,
)
from fgslam.datasets.recording import Recording, recording_identity
from fgslam.datasets.selection import select_frames
from fgslam.datasets.settings import EurocSettings
from fgslam.datasets.stereo_files import StereoFiles, check_sizes, missing_notes, require_folder
from fgslam.datasets.trajectories import trajectory_at_frames

MapArray: TypeAlias = npt.NDArray[np.float32]

CAMERA_FOLDERS = ("cam0", "cam1")
_MAX_TRUTH_GAP_S = 0.1
# Cosine of 45 degrees: beyond, a common image plane would stretch the views out of use.
_LEAST_BASELINE_M = 1e-3  # below it two cameras are one, up to rounding
_LEAST_COMMON_VIEW = 0.707


@dataclass(frozen=True, eq=False)
class Rectifier:
    """Remaps raw images of a stereo pair to rectified ones; maps are computed once.

    Attributes:
        rig: the rectified rig, reference = right camera.
        maps: per camera (right, left) the columns and rows (h, w) to sample, float32.
    """

    rig: CameraRig
    maps: tuple[tuple[MapArray, MapArray], ...]

    def rectify(self, camera: int, image: Image) -> Image:
        """Rectified image (h, w) of camera 0 (right) or 1 (left), bilinear."""
        columns, rows = self.maps[camera]
        return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR), np.uint8)


def rectifier(right: AslCamera, left: AslCamera, alpha: float) -> Rectifier:
    """Rectify a pair (Bouguet's method as in OpenCV; ``alpha`` 0 crops to valid pixels).

    Raises:
        CalibrationError: the cameras lie above each other, or look in different directions.
    """
    _require_side_by_side(inverse(left.bTc) @ right.bTc)
    rTl = inverse(right.bTc) @ left.bTc
    size = (right.width, right.height)
    r_left, r_right, _, p_right, *_ = cv2.stereoRectify(
        left.matrix,
        left.distortion,
        right.matrix,
        right.distortion,
        size,
        rTl[:3, :3],
        rTl[:3, 3:],
        flags=cv2.CALIB_ZERO_DISPARITY,
        alpha=alpha,
    )
    new_matrix = np.asarray(p_right[:, :3], np.float64)
    maps = tuple(
        _sampling_maps(camera, np.asarray(rotation, np.float64), new_matrix)
        for camera, rotation in ((right, r_right), (left, r_left))
    )
    fx, fy, cx, cy = (float(p_right[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
    raw_from_rectified = np.eye(4)
    raw_from_rectified[:3, :3] = r_right.T
    rig = CameraRig(
        width=right.width,
        height=right.height,
        fx=fx,
        fy=fy,
        cx=cx,
        cy=cy,
        baseline=-float(p_right[0, 3]) / fx,
        vertical_baseline=None,
        bTc=right.bTc @ raw_from_rectified,
    )
    return Rectifier(rig, maps)


def _sampling_maps(
    camera: AslCamera, rotation: FloatArray, new_matrix: FloatArray
) -> tuple[MapArray, MapArray]:
    """Columns and rows (h, w) of the raw image at which each rectified pixel looks."""
    columns, rows = cv2.initUndistortRectifyMap(
        camera.matrix,
        camera.distortion,
        rotation,
        new_matrix,
        (camera.width, camera.height),
        cv2.CV_32FC1,
    )
    return np.asarray(columns, np.float32), np.asarray(rows, np.float32)


def _require_side_by_side(lTr: FloatArray) -> None:
    """Raises CalibrationError unless the right camera, at ``lTr``, is to the left one's right."""
    offset = lTr[:3, 3]
    if np.abs(offset[0]) < max(2.0 * np.hypot(offset[1], offset[2]), _LEAST_BASELINE_M):
        x, y, z = offset
        raise CalibrationError(
            f"cam0 and cam1 are not side by side (offset {x:.3f}, {y:.3f}, {z:.3f} m along x, y, z)"
            "; a horizontal stereo pair is needed, check T_BS in their sensor.yaml"
        )
    if lTr[2, 2] < _LEAST_COMMON_VIEW:
        raise CalibrationError(
            "cam0 and cam1 look more than 45 degrees apart; check T_BS in their sensor.yaml"
        )


@dataclass(frozen=True, eq=False)
class RawPairs:
    """Pairs of raw images, rectified when read."""

    files: StereoFiles
    rectifier: Rectifier

    def load(self, index: int) -> tuple[Image, ...]:
        """Rectified (right, left) images of a pair. Raises FrameError as StereoFiles does."""
        raw = self.files.load(index)
        return tuple(self.rectifier.rectify(k, image) for k, image in enumerate(raw))


def open_euroc(settings: EurocSettings) -> Recording:
    """Open a recording; ``settings.path`` is the folder mav0 or the one that holds it.

    Raises:
        DatasetError: a folder or file is missing or malformed, or no frame is left.
        CalibrationError: a sensor.yaml is missing, not finite or impossible.
    """
    root = Path(settings.path)
    root = root / "mav0" if (root / "mav0").is_dir() else root
    folders = [root / name for name in CAMERA_FOLDERS]
    for folder in folders:
        require_folder(folder, "a stereo pair needs two cameras, but the folder")
    right, left, right_folder, left_folder = _right_and_left(folders)
    raw = rectifier(right, left, settings.rectify_alpha)
    stamps, files, notes = _pairs(right_folder, left_folder, right, settings)
    chosen = select_frames(len(stamps), settings)
    check_sizes(files, root)
    return Recording(
        name=root.resolve().parent.name if root.name == "mav0" else root.resolve().name,
        rig=raw.rig,
        timestamps=stamps[chosen],
        identity=_identity(folders, files),
        ground_truth=_true_poses(root, raw.rig, stamps[chosen]),
        notes=notes + missing_notes(files, stamps),
        indices=chosen,
        load_images=RawPairs(files, raw).load,
        odometry_source=None,
    )


def _right_and_left(folders: list[Path]) -> tuple[AslCamera, AslCamera, Path, Path]:
    """Cameras and folders, right first: the left camera is the one that sees the other at +x."""
    first, second = (read_camera(folder / "sensor.yaml") for folder in folders)
    if (first.width, first.height) != (second.width, second.height):
        raise CalibrationError(
            f"{folders[0]} is {first.width}x{first.height} but {folders[1].name} is "
            f"{second.width}x{second.height}; both must have one resolution"
        )
    if (inverse(first.bTc) @ second.bTc)[0, 3] > 0.0:
        return second, first, folders[1], folders[0]
    return first, second, folders[0], folders[1]


def _pairs(
    right_folder: Path, left_folder: Path, camera: AslCamera, settings: EurocSettings
) -> tuple[FloatArray, StereoFiles, tuple[str, ...]]:
    """Stamps (n,) in seconds of the right images, files of the pairs, and notes."""
    right, left = read_camera_frames(right_folder), read_camera_frames(left_folder)
    (rows, partners), notes = pair_frames(right, left, 1e-3 * settings.pairing_tolerance_ms)
    paths = tuple((right.paths[i], left.paths[j]) for i, j in zip(rows, partners, strict=True))
    files = StereoFiles(paths, camera.width, camera.height)
    stamps = right.stamps[rows].astype(np.float64) * NANOSECONDS
    return stamps, files, notes


def _identity(folders: list[Path], files: StereoFiles) -> str:
    defining = [folder / name for folder in folders for name in ("sensor.yaml", "data.csv")]
    images = [path for pair in files.paths for path in pair if path.is_file()]
    return recording_identity(defining, images)


def _true_poses(root: Path, rig: CameraRig, frames: FloatArray) -> Trajectory | None:
    """True poses of the rectified right camera, interpolated at the frames' stamps (n,)."""
    body = read_body_truth(root / "state_groundtruth_estimate0")
    if body is None:
        return None
    at_frames = trajectory_at_frames(body, frames, _MAX_TRUTH_GAP_S)
    return Trajectory(at_frames.timestamps, at_frames.poses @ rig.bTc)
