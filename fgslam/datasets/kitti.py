"""KITTI odometry in its native layout (docs/datasets/kitti.md).

``sequences/NN/{image_0,image_1,calib.txt,times.txt}`` and, for the training drives,
``poses/NN.txt``: rectified grey pairs, camera 0 is the left one; or the colour pairs of image_2
and image_3.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.cameras.rig import load_rig
from fgslam.cameras.stereo_formats import pair_beside, right_of_camera_0
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import right_from_left_camera
from fgslam.core.sensors import CameraRig
from fgslam.datasets.images import (
    StereoFiles,
    check_sizes,
    list_numbered_images,
    missing_notes,
    require_folder,
)
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import KittiSettings
from fgslam.datasets.tables import read_table, require_increasing

_POSE_COLUMNS = tuple(f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3, 4))


def open_kitti(settings: KittiSettings) -> Recording:
    """Open one drive; ``settings.path`` is the folder that holds sequences/ and poses/.

    Raises:
        DatasetError: a folder or file is missing or malformed, or no frame is left.
        CalibrationError: calib.txt is missing, malformed or impossible.
    """
    folder = Path(settings.path) / "sequences" / settings.sequence
    require_folder(folder, "the KITTI sequence")
    calibration = folder / "calib.txt"
    names = _pair(calibration)
    cameras = [list_numbered_images(folder / name) for name in names]
    table = read_table(folder / "times.txt", ("time",))
    stamps = table.column(0)
    require_increasing(table, stamps)
    chosen = select_frames(len(stamps), settings)
    files = _files(folder, names, cameras, len(stamps))
    rig = _read_rig(calibration, files)
    files = StereoFiles(files.paths, rig.width, rig.height)
    check_sizes(files, folder)
    files, held = files.with_bits()
    poses = _read_poses(Path(settings.path) / "poses" / f"{settings.sequence}.txt", len(stamps))
    if poses is not None:
        poses = right_from_left_camera(poses[chosen], right_of_camera_0(calibration))
    return Recording(
        name=f"KITTI {settings.sequence}",
        rig=rig,
        timestamps=stamps[chosen],
        identity=recording_identity(
            [calibration, folder / "times.txt"],
            [path for images in cameras for path in images.values()],
        ),
        ground_truth=None if poses is None else Trajectory(stamps[chosen], poses),
        notes=held + missing_notes(files, stamps),
        indices=chosen,
        load_images=files.load,
        load_colour=files.load_colour,
    )


def _pair(calibration: Path) -> tuple[str, str]:
    """Folders of the right and the left camera, those that the calibration is read for."""
    found, folder = pair_beside(calibration), calibration.parent
    if found is not None:
        left, right = found
        return f"image_{right}", f"image_{left}"
    lacking = next(name for name in ("image_1", "image_0") if not (folder / name).is_dir())
    raise DatasetError(
        f"{folder} has no {lacking}/: both grey cameras are needed (image_0 left, image_1 right), "
        "or both colour cameras (image_2 left, image_3 right); unpack the odometry data set there"
    )


def _files(
    folder: Path, names: tuple[str, str], cameras: list[dict[int, Path]], frames: int
) -> StereoFiles:
    named = list(zip(names, cameras, strict=True))
    paths = tuple(
        tuple(images.get(k, folder / name / f"{k:06d}.png") for name, images in named)
        for k in range(frames)
    )
    return StereoFiles(paths, 0, 0)


def _read_rig(path: Path, files: StereoFiles) -> CameraRig:
    """The rig of calib.txt; the image size, which it does not state, is the first frame's."""
    images = files.first_images()
    if images is None:
        raise DatasetError(
            f"{path.parent}: not one frame of times.txt has a readable image of both cameras; "
            "check the unpacked files"
        )
    height, width = images[0].shape
    return load_rig(path, size=(width, height)).plain()


def _read_poses(path: Path, frames: int) -> FloatArray | None:
    """Left-camera poses (n, 4, 4) of poses/NN.txt, or None where there is no such file."""
    if not path.is_file():
        return None
    table = read_table(path, _POSE_COLUMNS)
    if len(table) != frames:
        raise DatasetError(
            f"{path} has {len(table)} poses but times.txt has {frames} frames; restore the file "
            "that belongs to this sequence"
        )
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, :] = table.values.reshape(-1, 3, 4)
    skewed = np.abs(np.linalg.det(poses[:, :3, :3]) - 1.0) > 1e-2
    if skewed.any():
        line = table.lines[int(np.argmax(skewed))]
        raise DatasetError(f"{path}, line {line}: not a rotation and translation; restore the file")
    return poses
