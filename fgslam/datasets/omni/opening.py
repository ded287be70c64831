"""Opens any recording of an omnidirectional camera by its settings."""

from __future__ import annotations

from fgslam.datasets.omni.image_path import open_omni_path
from fgslam.datasets.omni.panoramas import open_panoramas
from fgslam.datasets.omni.recording import OmniRecording
from fgslam.datasets.omni.settings import (
    OmniDatasetSettings,
    OmniPathSettings,
    OmniVideoSettings,
    PanoramasSettings,
)
from fgslam.datasets.omni.video import open_omni_video


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
