"""Which format a calibration has, and its rig."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from fgslam.cameras.asl import read_camera
from fgslam.cameras.calibration import read_calibration, read_json_object
from fgslam.cameras.kitti_calibration import read_projections
from fgslam.cameras.rectification import Rectifier, rectifier, right_and_left
from fgslam.cameras.rig_files.camera_info import read_camera_info_pair
from fgslam.cameras.rig_files.kalibr import read_camchain
from fgslam.cameras.rig_files.opencv import read_opencv_pair
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines
from fgslam.core.sensors import CameraRig

Size: TypeAlias = tuple[int, int]
_KITTI_RAW = ("P_rect_00", "P_rect_01")


@dataclass(frozen=True, eq=False)
class RigFile:
    """What a calibration says: the rectified rig, and how raw images become rectified ones."""

    rig: CameraRig
    rectifier: Rectifier | None = None

    @staticmethod
    def raw(rectifier: Rectifier) -> RigFile:
        """Of raw images."""
        return RigFile(rectifier.rig, rectifier)


def read_rig(path: Path, size: Size | None = None) -> RigFile:
    """The rig of a calibration file or folder, its format recognised by its content.

    Args:
        path: see :meth:`fgslam.cameras.rig.StereoRig.load`.
        size: width and height of the images, for formats that do not state it.

    Raises:
        CalibrationError: the format is unknown, of one camera only, or a value is impossible.
    """
    if size is not None and not (isinstance(size, Sequence) and len(size) == 2):
        raise CalibrationError(f"size is {size!r}; give (width, height) of the images in pixels")
    if path.is_dir():
        return _of_folder(path, size)
    text = _text(path)
    for mark, read in _MARKS:
        if mark in text:
            return read(path, size)
    raise CalibrationError(f"{path}: not a calibration of a stereo rig that is known; {_KNOWN}")


_KNOWN = (
    "known: calib.json of fgslam, Kalibr's camchain.yaml, OpenCV's stereo files (M1, D1, M2, D2, "
    "R, T), a folder with left.yaml and right.yaml of ROS camera_info, KITTI's calib.txt, a EuRoC "
    "folder with cam0/sensor.yaml"
)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except OSError as cause:
        raise CalibrationError(
            f"calibration {path} cannot be read: {cause.strerror}; check the path"
        ) from cause
    except UnicodeDecodeError:
        raise CalibrationError(f"{path} is not a text file; {_KNOWN}") from None


def _of_folder(folder: Path, size: Size | None) -> RigFile:
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if (root / "cam0" / "sensor.yaml").is_file():
        pair = (read_camera(root / name / "sensor.yaml") for name in ("cam0", "cam1"))
        return RigFile.raw(rectifier(*right_and_left(*pair)))
    if (folder / "left.yaml").is_file():
        return RigFile.raw(read_camera_info_pair(folder / "left.yaml", folder / "right.yaml"))
    for pattern in ("calib.json", "*camchain.yaml", "calib.txt", "intrinsics.yml"):
        found = sorted(folder.glob(pattern))
        if len(found) == 1:
            return read_rig(found[0], size)
    raise CalibrationError(f"{folder}: holds no calibration of a stereo rig; {_KNOWN}")


def _ours(path: Path, _: Size | None) -> RigFile:
    three = "vertical_baseline_m" in read_json_object(path)
    return RigFile(read_calibration(path, three))


def _camera_info(path: Path, _: Size | None) -> RigFile:
    left, right = path.with_name("left.yaml"), path.with_name("right.yaml")
    if path.name not in (left.name, right.name):
        raise CalibrationError(
            f"{path}: one camera_info alone knows one camera; give the folder that holds left.yaml "
            "and right.yaml"
        )
    return RigFile.raw(read_camera_info_pair(left, right))


def _kitti(path: Path, size: Size | None) -> RigFile:
    return RigFile(read_projections(path).rig(*_known_size(path, size)))


def _kitti_raw(path: Path, size: Size | None) -> RigFile:
    size = _stated_size(path) if size is None else size
    return RigFile(read_projections(path, _KITTI_RAW).rig(*_known_size(path, size)))


def _stated_size(path: Path) -> Size | None:
    """Width and height by the line S_rect_00, if there is one."""
    for number, text in read_lines(path):
        if text.startswith("S_rect_00:"):
            try:
                width, height = map(float, text.split()[1:])
                return round(width), round(height)
            except (ValueError, OverflowError):
                raise CalibrationError(
                    f"{path}, line {number}: S_rect_00 must be width and height; restore the file"
                ) from None
    return None


def _kalibr(path: Path, _: Size | None) -> RigFile:
    return RigFile.raw(rectifier(*right_and_left(*read_camchain(path))))


def _opencv(path: Path, size: Size | None) -> RigFile:
    pair = read_opencv_pair(path, size)
    return RigFile.raw(rectifier(*right_and_left(*pair)))


def _known_size(path: Path, size: Size | None) -> Size:
    if size is None:
        raise CalibrationError(f"{path} does not state the images' size; give size=(width, height)")
    return size


_MARKS: tuple[tuple[str, Callable[[Path, Size | None], RigFile]], ...] = (
    ('"baseline_m"', _ours),
    ("opencv-matrix", _opencv),
    ("projection_matrix:", _camera_info),
    ("P_rect_00:", _kitti_raw),
    ("P0:", _kitti),
    ("camera_model:", _kalibr),
)
"""Texts that tell a format, and its reader; the first that is found counts."""
