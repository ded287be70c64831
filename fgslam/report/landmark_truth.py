"""True landmark positions as a table: ground_truth_landmarks.csv."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.files import write_text
from fgslam.core.recordings import LandmarkTruth

LANDMARK_TRUTH_FILE = "ground_truth_landmarks.csv"
_HEADER = "id,x,y,z,sigma_m"


def write_landmark_truth(path: Path, truth: LandmarkTruth, sigma_m: FloatArray) -> None:
    """Write id, x, y, z (m, the world of ground_truth.tum) and sigma_m: the truth's own error.

    Args:
        path: the file, written atomically.
        truth: n positions.
        sigma_m: (n,) standard error of each; 0 where it is exact.

    Raises:
        OutputError: the file cannot be written.
    """
    lines = [_HEADER]
    for landmark, (x, y, z), sigma in zip(truth.ids, truth.positions + 0.0, sigma_m, strict=True):
        lines.append(f"{landmark},{x:.9f},{y:.9f},{z:.9f},{sigma:.9f}")
    write_text(path, "\n".join(lines) + "\n")


def read_landmark_truth(path: Path) -> tuple[LandmarkTruth, FloatArray]:
    """The positions, ids ascending, and their own standard errors (n,).

    Raises:
        DatasetError: the file is missing or is no such table; the message names the line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read {path} ({error}); run the experiment again") from error
    if not lines or lines[0] != _HEADER:
        raise DatasetError(f"{path}, line 1: not '{_HEADER}'; run the experiment again")
    ids, values = np.empty(len(lines) - 1, np.int64), np.empty((len(lines) - 1, 4))
    for k, line in enumerate(lines[1:]):
        try:
            first, *numbers = line.split(",")
            ids[k], values[k] = int(first), [float(number) for number in numbers]
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {k + 2}: {error}; run the experiment again"
            ) from error
    if not (np.isfinite(values).all() and (np.diff(ids) > 0).all()):
        raise DatasetError(
            f"{path}: ids do not increase or a number is not finite; run the experiment again"
        )
    return LandmarkTruth(ids, values[:, :3].copy()), values[:, 3].copy()
