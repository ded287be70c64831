"""The one implementation of the Sequence protocol that all readers of files return.

Which frames are used: ``start``, ``stop``, ``stride``, as a Python slice.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from fgslam.cameras.rectify import Rectifier
from fgslam.core.arrays import Brief, FloatArray, Image, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Frame
from fgslam.core.sensors import CameraRig
from fgslam.core.settings import FrameSelection
from fgslam.datasets.settings import RecordingSettings

ImageLoader: TypeAlias = Callable[[int], tuple[Image, ...]]
"""Images (right, left[, top]) of one of the recording's own frames; raises FrameError."""

OdometrySource: TypeAlias = Callable[[FloatArray], tuple[Odometry | None, ...]]
"""Body motions between consecutive stamps (n,): n - 1 of them, None where nothing was recorded."""


@dataclass(frozen=True, eq=False, repr=False)
class Recording(Brief):
    """Selected frames of a recording on disk; images are read when asked for.

    Attributes:
        name: short name for titles.
        rig: the rectified cameras.
        timestamps: (n,) seconds of the selected frames, strictly increasing.
        identity: hexadecimal digest of the recording.
        ground_truth: true poses of the reference camera at the selected frames, or None.
        notes: what was tolerated when opening.
        indices: (n,) the recording's own numbers of the selected frames.
        load_images: reads the images of one of the recording's own frames.
        load_colour: reads them in red, green, blue; None where they are grey anyway.
        disparity_sigma_px: noise of the disparity where a depth camera gives it, or None.
        odometry_source: where the body's motions come from, or None. Asked once, when first
            needed, so that a bad odometry file hurts only who uses it.
        rectifier: what makes the images its own that the cameras gave; None where they are stored
            rectified.
        margins: of frames, in place of the rectifier's.
    """

    name: str
    rig: CameraRig
    timestamps: FloatArray
    identity: str
    ground_truth: Trajectory | None
    notes: tuple[str, ...]
    indices: IntArray
    load_images: ImageLoader
    odometry_source: OdometrySource | None = None
    load_colour: ImageLoader | None = None
    rectifier: Rectifier | None = None
    margins: tuple[npt.NDArray[np.float32], ...] = ()
    disparity_sigma_px: float | None = None

    @property
    def unrectified(self) -> bool:
        """Whether the images are rectified when they are read."""
        return self.rectifier is not None and bool(self.rectifier.maps)

    def __len__(self) -> int:
        return len(self.indices)

    def frame(self, i: int) -> Frame:
        """Images of frame ``i``, 0 <= i < len. Raises FrameError when missing or corrupt."""
        self._check_index(i, 0)
        index = int(self.indices[i])
        margins = self.margins
        if self.rectifier is not None:
            margins = margins or self.rectifier.margins
        return Frame(index, float(self.timestamps[i]), self.load_images(index), margins)

    def colour(self, i: int) -> tuple[Image, ...]:
        """Images of frame ``i`` in red, green, blue, or grey where the recording is. FrameError."""
        self._check_index(i, 0)
        return (self.load_colour or self.load_images)(int(self.indices[i]))

    def odometry(self, i: int) -> Odometry | None:
        """Body motion from frame ``i - 1`` to ``i``, 1 <= i < len; None where none was recorded.

        Raises:
            OdometryError: the recording's odometry is malformed.
        """
        self._check_index(i, 1)
        steps = self._steps
        return None if steps is None else steps[i - 1]

    @cached_property
    def _steps(self) -> tuple[Odometry | None, ...] | None:
        return None if self.odometry_source is None else self.odometry_source(self.timestamps)

    def _check_index(self, i: int, least: int) -> None:
        if not least <= i < len(self):
            raise IndexError(f"frame {i} of {self.name}: expected {least} to {len(self) - 1}")


def recording_identity(contents: Iterable[Path], listed: Iterable[Path]) -> str:
    """SHA-256 over the bytes of ``contents`` and the names and sizes of ``listed`` files."""
    digest = hashlib.sha256()
    for path in contents:
        digest.update(f"{path.name}\0".encode())
        digest.update(path.read_bytes())
    for path in sorted(listed):
        digest.update(f"{path.parent.name}/{path.name}\0{path.stat().st_size}\0".encode())
    return digest.hexdigest()


# --------------------------------------------------------------------------------------------
# Which frames are used


def select_frames(count: int, settings: RecordingSettings) -> IntArray:
    """:func:`select_of` the frames in a recording's folder."""
    return select_of(count, settings, settings.path)


def select_of(count: int, settings: FrameSelection, name: str) -> IntArray:
    """Indices (m,) of the chosen ones of ``count`` frames, increasing, at least one.

    ``name`` is what messages call the recording.

    Raises:
        DatasetError: the recording is empty, or the range leaves no frame.
    """
    if count == 0:
        raise DatasetError(
            f"{name} has no frame at all: check that the path is the recording's folder "
            "and that its list of times is not empty"
        )
    if settings.start >= count:
        raise DatasetError(
            f"dataset.start is {settings.start} but {name} has only the frames 0 to "
            f"{count - 1}: choose a smaller start"
        )
    if settings.stop is not None and settings.stop <= settings.start:
        raise DatasetError(
            f"dataset.stop ({settings.stop}) is not beyond dataset.start ({settings.start}), which "
            f"leaves no frame of {name}: choose a larger stop"
        )
    stop = count if settings.stop is None else min(settings.stop, count)
    return np.arange(settings.start, stop, settings.stride, dtype=np.int64)
