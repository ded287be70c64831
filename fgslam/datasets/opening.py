"""Functions that open any recording by its settings: of images, of measurements, for homing.

A reader is imported when its kind is opened: what one needs takes others a second to load.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

from fgslam.core.recordings import MeasurementRecording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import (
    BagSettings,
    EurocSettings,
    FileRecordingSettings,
    ImageFolderSettings,
    KittiRawSettings,
    LooseImagesSettings,
    MeasurementDatasetSettings,
    MeasurementFilesSettings,
    OdometrySettings,
    RecordedOdometrySettings,
    RgbdSettings,
    SimulatedMeasurementsSettings,
    StereoTracksSettings,
    VideoSettings,
)

if TYPE_CHECKING:
    from fgslam.datasets.omni_recording import OmniRecording
    from fgslam.datasets.omni_settings import OmniDatasetSettings


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
    found = _opened(settings, odometry or RecordedOdometrySettings())
    found = _judged(found) if found.unrectified else found
    if settings.scale == 1.0:
        return found
    from fgslam.datasets.smaller import smaller

    return smaller(found, settings.scale)


def _judged(recording: Recording) -> Recording:
    """With a note where its calibration does not fit its images."""
    from fgslam.datasets.checks.fit import fit_notes

    notes = fit_notes(lambda i: recording.frame(i).images, len(recording))
    return replace(recording, notes=(*notes, *recording.notes))


def _opened(settings: FileRecordingSettings, odometry: RecordedOdometrySettings) -> Recording:
    if isinstance(settings, _WithOdometry):
        return _open_with_odometry(settings, odometry)
    if isinstance(settings, _FilmOrDepth):
        return _open_film_or_depth(settings, odometry)
    from fgslam.datasets.kitti import open_kitti

    return open_kitti(settings)


_FilmOrDepth: TypeAlias = VideoSettings | RgbdSettings


def _open_film_or_depth(settings: _FilmOrDepth, odometry: RecordedOdometrySettings) -> Recording:
    if isinstance(settings, VideoSettings):
        from fgslam.datasets.stereo_video import open_video

        return open_video(settings)
    from fgslam.datasets.rgbd import open_rgbd

    return open_rgbd(settings, odometry)


_WithOdometry: TypeAlias = (
    ImageFolderSettings | LooseImagesSettings | EurocSettings | KittiRawSettings | BagSettings
)


def _open_with_odometry(settings: _WithOdometry, odometry: RecordedOdometrySettings) -> Recording:
    match settings:
        case ImageFolderSettings():
            from fgslam.datasets.image_folder import open_image_folder

            return open_image_folder(settings, odometry)
        case LooseImagesSettings():
            from fgslam.datasets.loose_images import open_loose_images

            return open_loose_images(settings, odometry)
        case EurocSettings():
            from fgslam.datasets.euroc import open_euroc

            return open_euroc(settings, odometry)
        case KittiRawSettings():
            from fgslam.datasets.kitti_raw import open_kitti_raw

            return open_kitti_raw(settings, odometry)
        case BagSettings():
            from fgslam.datasets.bags.reader import open_bag

            return open_bag(settings, odometry)


def open_measurements(
    settings: MeasurementDatasetSettings, seed: int, odometry: OdometrySettings | None = None
) -> MeasurementRecording:
    """Open or simulate the measurements that the settings describe.

    Args:
        settings: one of the kinds without images.
        seed: of what is simulated; real measurements do not depend on it.
        odometry: what predicts the motion; None for the recording's own, with the default
            constant velocity over its gaps.

    Raises:
        DatasetError: the recording is missing, malformed or empty.
        ConfigError: a simulated drive cannot be driven, or synthetic odometry is asked for.
    """
    odometry = odometry or RecordedOdometrySettings()
    match settings:
        case SimulatedMeasurementsSettings():
            from fgslam.datasets.simulated_measurements import open_simulated_measurements

            return open_simulated_measurements(settings, seed, odometry)
        case StereoTracksSettings():
            from fgslam.datasets.stereo_tracks import open_stereo_tracks

            return open_stereo_tracks(settings, odometry)
        case MeasurementFilesSettings():
            from fgslam.datasets.measurement_files import open_measurement_files

            return open_measurement_files(settings, odometry)


def open_omni(settings: OmniDatasetSettings) -> OmniRecording:
    """Open the recording of an omnidirectional camera that the settings describe.

    Raises:
        DatasetError: it is missing, malformed or empty; of these CalibrationError, where the
            camera is concerned, and FrameError, where the first picture cannot be read.
    """
    if settings.kind == "panoramas":
        from fgslam.datasets.panoramas import open_panoramas

        return open_panoramas(settings)
    from fgslam.datasets.mirror_images import open_omni_path, open_omni_video

    return open_omni_path(settings) if settings.kind == "omni_path" else open_omni_video(settings)
