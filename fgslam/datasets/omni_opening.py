"""Opens any recording of an omnidirectional camera by its settings."""

from __future__ import annotations

from fgslam.datasets.omni_path import open_omni_path
from fgslam.datasets.omni_recording import OmniRecording
from fgslam.datasets.omni_video import open_omni_video
from fgslam.datasets.panoramas import open_panoramas
from fgslam.settings.omni_datasets import (
    OmniDatasetSettings,
    OmniPathSettings,
    OmniVideoSettings,
    PanoramasSettings,
)


def open_omni(settings: OmniDatasetSettings) -> OmniRecording:
    """Open the recording that the settings describe.

    Raises:
        DatasetError: it is missing, malformed or empty; of these CalibrationError, where the
            camera is concerned, and FrameError, where the first picture cannot be read.
    """
    match settings:
        case PanoramasSettings():
            return open_panoramas(settings)
        case OmniPathSettings():
            return open_omni_path(settings)
        case OmniVideoSettings():
            return open_omni_video(settings)
