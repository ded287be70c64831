"""Which frames of a recording are used: ``start``, ``stop``, ``stride``, as a Python slice."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.settings import FrameSelection
from fgslam.datasets.settings import RecordingSettings


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
