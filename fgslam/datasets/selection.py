"""Which frames of a recording are used: ``start``, ``stop``, ``stride``, as a Python slice."""

from __future__ import annotations

import numpy as np

from fgslam.errors import DatasetError
from fgslam.settings.datasets import RecordingSettings
from fgslam.types import IntArray


def select_frames(count: int, settings: RecordingSettings) -> IntArray:
    """Indices (m,) of the chosen ones of ``count`` frames, increasing, at least one.

    Raises:
        DatasetError: the recording is empty, or the range leaves no frame.
    """
    if count == 0:
        raise DatasetError(
            f"{settings.path} has no frame at all: check that the path is the recording's folder "
            "and that its list of times is not empty"
        )
    if settings.start >= count:
        raise DatasetError(
            f"dataset.start is {settings.start} but {settings.path} has only the frames 0 to "
            f"{count - 1}: choose a smaller start"
        )
    if settings.stop is not None and settings.stop <= settings.start:
        raise DatasetError(
            f"dataset.stop ({settings.stop}) is not beyond dataset.start ({settings.start}), which "
            f"leaves no frame of {settings.path}: choose a larger stop"
        )
    stop = count if settings.stop is None else min(settings.stop, count)
    return np.arange(settings.start, stop, settings.stride, dtype=np.int64)
