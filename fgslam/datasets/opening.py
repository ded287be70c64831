"""One function that opens any recording of files by its settings."""

from __future__ import annotations

from typing import TypeAlias

from fgslam.datasets.euroc import open_euroc
from fgslam.datasets.image_folder import open_image_folder
from fgslam.datasets.kitti import open_kitti
from fgslam.datasets.light_field import open_light_field
from fgslam.datasets.recording import Recording
from fgslam.settings.datasets import (
    EurocSettings,
    ImageFolderSettings,
    KittiSettings,
    LightFieldSettings,
    RecordedOdometrySettings,
)

FileRecordingSettings: TypeAlias = (
    ImageFolderSettings | KittiSettings | EurocSettings | LightFieldSettings
)


def open_recording(
    settings: FileRecordingSettings, odometry: RecordedOdometrySettings | None = None
) -> Recording:
    """Open the recording that the settings describe.

    Args:
        settings: one of the readers' settings.
        odometry: noise and limits of recorded odometry; None for the defaults.

    Raises:
        DatasetError: the recording is missing, malformed or empty.
        CalibrationError: its calibration is missing or impossible.
    """
    match settings:
        case ImageFolderSettings():
            return open_image_folder(settings, odometry or RecordedOdometrySettings())
        case KittiSettings():
            return open_kitti(settings)
        case EurocSettings():
            return open_euroc(settings)
        case LightFieldSettings():
            return open_light_field(settings)
