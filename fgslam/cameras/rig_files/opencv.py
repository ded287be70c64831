"""OpenCV's stereo calibration: M1, D1, M2, D2, R, T, in one file or in two beside each other."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.rectification import RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, is_rigid

_BESIDE = ("intrinsics.yml", "extrinsics.yml")
"""Files that OpenCV's sample program stereo_calib writes."""

_SHAPES = {"M1": (3, 3), "M2": (3, 3), "R": (3, 3), "T": (3, 1)}
_DISTORTIONS = (4, 5, 8, 12, 14)


def read_opencv_pair(path: Path, size: tuple[int, int] | None) -> tuple[RawCamera, RawCamera]:
    """The two cameras; the body is the first one.

    ``R`` and ``T`` take points from the first camera's axes to the second's, in the unit of the
    calibration target: metres, if its squares were given in metres.

    Args:
        path: a file of OpenCV's FileStorage.
        size: width and height of the images, where the file has no image_width and image_height.

    Raises:
        CalibrationError: a matrix or the size is missing, or not what it should be.
    """
    files = [path, *(path.with_name(name) for name in _BESIDE if path.name in _BESIDE)]
    found = {name: _matrix(files, name) for name in (*_SHAPES, "D1", "D2")}
    width, height = size or _size(path, files)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = found["R"], found["T"][:, 0]
    if not is_rigid(pose):
        raise CalibrationError(f"{path}: R is not a rotation; calibrate again")
    first, second = (
        RawCamera(width, height, found[m], np.ravel(found[d]), bTc, f"{path.name}: {m}")
        for m, d, bTc in (("M1", "D1", np.eye(4)), ("M2", "D2", inverse(pose)))
    )
    return first, second


def _matrix(files: list[Path], name: str) -> FloatArray:
    for file in files:
        matrix = _read(file, name)
        if matrix is not None:
            break
    else:
        raise CalibrationError(
            f"{files[0]} has no matrix {name}; a stereo pair needs M1, D1, M2, D2, R and T "
            "(intrinsics.yml and extrinsics.yml beside each other will do)"
        )
    good = matrix.size in _DISTORTIONS if name in ("D1", "D2") else matrix.shape == _SHAPES[name]
    if not good or not np.isfinite(matrix).all():
        raise CalibrationError(f"{files[0]}: {name} has shape {matrix.shape}; calibrate again")
    return matrix


def _opened(file: Path) -> cv2.FileStorage:
    try:
        return cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
    except (cv2.error, SystemError) as error:  # its constructor wraps the one in the other
        cause = " ".join(str(error.__cause__ or error).split())
        raise CalibrationError(f"{file} is malformed: {cause}; write the file again") from None


def _read(file: Path, name: str) -> FloatArray | None:
    if not file.is_file():
        return None
    storage = _opened(file)
    try:
        matrix = storage.getNode(name).mat()
    except cv2.error:
        return None
    finally:
        storage.release()
    return None if matrix is None else np.asarray(matrix, np.float64)


def _size(path: Path, files: list[Path]) -> tuple[int, int]:
    for file in files:
        if file.is_file():
            storage = _opened(file)
            width, height = (storage.getNode(n).real() for n in ("image_width", "image_height"))
            storage.release()
            if width > 0.0 and height > 0.0:
                return int(width), int(height)
    raise CalibrationError(f"{path} does not state the images' size; give size=(width, height)")
