"""EuRoC MAV in its native (ASL) layout, rectified on reading (docs/datasets/euroc.md)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.cameras.calibration_formats import read_asl_camera
from fgslam.cameras.rectification import RawCamera, Rectifier, rectifier, right_and_left
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.estimates import Trajectory
from fgslam.core.sensors import CameraRig
from fgslam.datasets.asl_files import (
    NANOSECONDS,
    pair_frames,
    read_body_truth,
    read_camera_frames,
)
from fgslam.datasets.recording import Recording, recording_identity
from fgslam.datasets.selection import select_frames
from fgslam.datasets.settings import EurocSettings
from fgslam.datasets.stereo_files import StereoFiles, check_sizes, missing_notes, require_folder
from fgslam.datasets.trajectories import trajectory_at_frames

CAMERA_FOLDERS = ("cam0", "cam1")
_MAX_TRUTH_GAP_S = 0.1


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


def _right_and_left(folders: list[Path]) -> tuple[RawCamera, RawCamera, Path, Path]:
    """Cameras and folders, right first."""
    first, second = (read_asl_camera(folder / "sensor.yaml") for folder in folders)
    right, left = right_and_left(first, second)
    swapped = right is second
    return right, left, folders[swapped], folders[not swapped]


def _pairs(
    right_folder: Path, left_folder: Path, camera: RawCamera, settings: EurocSettings
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
