"""Recordings: of images, as a sequence of frames, and of measurements, as a finished log."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image, IntArray, Rows
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.files import write_text
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Odometry
from fgslam.core.sensors import CameraRig


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """The images of one instant, in the order right, left[, top]; grey, uint8, (height, width).

    ``index`` counts the recording's own frames (before ``start``/``stop``/``stride``). ``margins``
    are (height, width) of each camera: how far a pixel is from what shows nothing, a black border
    or what a mask hides, in pixels; empty where all images are full.
    """

    index: int
    timestamp: float
    images: tuple[Image, ...]
    margins: tuple[npt.NDArray[np.float32], ...] = ()

    def digest(self) -> int:
        """64 bits of the images' contents: by them a frame is known again in any recording."""
        content = hashlib.blake2b(digest_size=8)
        for image in self.images:
            content.update(np.ascontiguousarray(image).data)
        return int.from_bytes(content.digest(), "little", signed=True)


def clearance(margin: npt.NDArray[np.float32], places: FloatArray) -> FloatArray:
    """How far (n,) places (n, 2) (column, row) are from what shows nothing, pixels.

    Args:
        margin: (height, width) of the image, as in :class:`Frame`.
        places: those outside the image are judged by its nearest pixel.
    """
    height, width = margin.shape
    column, row = np.rint(places).astype(np.int64).T
    return np.asarray(margin[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)])


@runtime_checkable
class Sequence(Protocol):
    """A recording: calibrated frames in time order, perhaps with odometry and ground truth.

    Indices ``i`` run over the *selected* frames (after start, stop and stride), from 0.
    """

    @property
    def name(self) -> str:
        """Short name for titles."""
        ...

    @property
    def rig(self) -> CameraRig:
        """The calibrated cameras, rectified."""
        ...

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds, strictly increasing."""
        ...

    @property
    def identity(self) -> str:
        """Hexadecimal digest of what defines the recording, for the run folder."""
        ...

    def __len__(self) -> int: ...

    def frame(self, i: int) -> Frame:
        """Images of frame ``i``. Raises FrameError when they are missing or corrupt."""
        ...

    def odometry(self, i: int) -> Odometry | None:
        """Body motion from frame ``i - 1`` to ``i``, or None where none was recorded."""
        ...

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses ``wTc`` of the reference camera in a world of the recording's choice."""
        ...

    @property
    def notes(self) -> tuple[str, ...]:
        """What was tolerated when opening the recording, in words (missing frames and the like)."""
        ...


@dataclass(frozen=True, eq=False)
class LandmarkTruth(Rows):
    """True landmark positions, in the frame of the ground-truth trajectory.

    Attributes:
        ids: (n,) identities as in the log, ascending.
        positions: (n, 3) metres.
    """

    ids: IntArray
    positions: FloatArray


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


@dataclass(frozen=True, eq=False)
class MeasurementRecording:
    """Measurements with identities, replayable by any estimator without a front-end.

    Attributes:
        name: short name for titles.
        identity: hexadecimal digest of what defines the recording.
        log: sensor, motion model and one increment a frame.
        ground_truth: true ``wTc`` of the reference camera or sensor, in a world of the
            recording's choice; None where there is none.
        landmark_truth: true landmark positions in that same world, or None. A landmark that moves
            during the recording is not in it.
        notes: what was tolerated, left out or simulated, in words.
    """

    name: str
    identity: str
    log: MeasurementLog
    ground_truth: Trajectory | None
    landmark_truth: LandmarkTruth | None
    notes: tuple[str, ...]
