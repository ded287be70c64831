"""Functions that open any recording by its settings: of images, of measurements, for homing.

A reader is imported when its kind is opened: what one needs takes others a second to load.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from importlib import import_module
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from fgslam.core.arrays import Image
from fgslam.core.errors import DatasetError
from fgslam.core.log import MeasurementRecording
from fgslam.datasets.fit import fit_notes
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import (
    FileRecordingSettings,
    MeasurementDatasetSettings,
    OdometrySettings,
    OmniDatasetSettings,
    OmniHouseSettings,
    RecordedOdometrySettings,
    SimulatedBearingsSettings,
)

if TYPE_CHECKING:
    from fgslam.datasets.omni import OmniRecording
    from fgslam.worlds.house import OmniWorld as OmniWorld
    from fgslam.worlds.simulated_bearings import SimulatedHoming

READERS: Mapping[str, Callable[[], Any]] = {
    "image_folder": lambda: import_module("fgslam.datasets.folders").open_image_folder,
    "loose_images": lambda: import_module("fgslam.datasets.folders").open_loose_images,
    "video": lambda: import_module("fgslam.datasets.video").open_video,
    "rgbd": lambda: import_module("fgslam.datasets.depth").open_rgbd,
    "bag": lambda: import_module("fgslam.datasets.bags").open_bag,
    "kitti": lambda: import_module("fgslam.datasets.published").open_kitti,
    "kitti_raw": lambda: import_module("fgslam.datasets.published").open_kitti_raw,
    "euroc": lambda: import_module("fgslam.datasets.published").open_euroc,
}
"""By kind of the settings what reads a recording: ``(settings, odometry) -> Recording``."""


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
    found: Recording = READERS[settings.kind]()(settings, odometry or RecordedOdometrySettings())
    if found.unrectified:
        misfit = fit_notes(lambda i: found.frame(i).images, len(found))
        found = replace(found, notes=(*misfit, *found.notes))
    return found if settings.scale == 1.0 else smaller(found, settings.scale)


_SMALLEST_PX = 8  # SIFT finds nothing in less


def smaller(recording: Recording, scale: float) -> Recording:
    """The recording with rectified images smaller by a factor ``scale``, the calibration with them.

    Pixels are averaged over what they cover. Noise that the recording states is in pixels of the
    images it gives.

    Raises:
        DatasetError: nothing would be left of the images.
    """
    rig = recording.rig
    size = (max(round(scale * rig.width), 1), max(round(scale * rig.height), 1))
    if min(size) < _SMALLEST_PX:
        raise DatasetError(
            f"dataset.scale {scale:g} makes images of {size[0]}x{size[1]} pixels of "
            f"{rig.width}x{rig.height}; choose a larger one"
        )
    x, y = size[0] / rig.width, size[1] / rig.height
    margins = () if recording.rectifier is None else recording.rectifier.margins

    def load(index: int, colour: bool) -> tuple[Image, ...]:
        return tuple(
            np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
            for image in recording.load_images(index, colour)
        )

    return replace(
        recording,
        rig=replace(
            rig,
            width=size[0],
            height=size[1],
            fx=x * rig.fx,
            fy=y * rig.fy,
            # Whole pixels are at their centres: the image reaches from -0.5.
            cx=x * (rig.cx + 0.5) - 0.5,
            cy=y * (rig.cy + 0.5) - 0.5,
        ),
        margins=tuple(
            scale * cv2.resize(m, size, interpolation=cv2.INTER_NEAREST) for m in margins
        ),
        load_images=load,
        notes=(
            f"images of {rig.width}x{rig.height} are made {size[0]}x{size[1]}",
            *recording.notes,
        ),
    )


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
    from fgslam.datasets import measured

    if settings.kind == "stereo_tracks":
        return measured.open_stereo_tracks(settings, odometry)
    if settings.kind == "measurements":
        return measured.open_measurement_files(settings, odometry)
    return measured.open_simulated_measurements(settings, seed, odometry)


def open_omni(settings: OmniDatasetSettings) -> OmniRecording:
    """Open the recording of an omnidirectional camera that the settings describe.

    Raises:
        DatasetError: it is missing, malformed or empty; of these CalibrationError, where the
            camera is concerned, and FrameError, where the first picture cannot be read.
    """
    from fgslam.datasets import omni

    if settings.kind == "panoramas":
        return omni.open_panoramas(settings)
    if settings.kind == "omni_path":
        return omni.open_omni_path(settings)
    return omni.open_omni_video(settings)


def open_checked(settings: OmniDatasetSettings) -> OmniRecording:
    """The same, with a note where its pictures cannot be of the stated camera."""
    from fgslam.datasets.omni import camera_notes

    recording = open_omni(settings)
    return replace(recording, notes=recording.notes + camera_notes(recording))


def open_simulated_homing(
    settings: SimulatedBearingsSettings, outliers: float, rng: np.random.Generator
) -> SimulatedHoming:
    """Matches, tracks and truth of one homing.

    Args:
        settings: the room, the drive and the noise.
        outliers: part of the matches, and of the bearings tracked at the drive's end, that is
            wrong.
        rng: source of everything random.
    """
    from fgslam.worlds.simulated_bearings import HomingOutliers, simulate_homing

    return simulate_homing(settings, rng, HomingOutliers.of_all(outliers))


def open_house(settings: OmniHouseSettings, seed: int) -> OmniWorld:
    """The house as a world to act in, with the wheelchair at the start of its reference path.

    Raises:
        DatasetError: no reference path of that kind is found.
        MissingDependencyError: Open3D cannot be loaded.
    """
    from fgslam.worlds.house import OmniWorld

    return OmniWorld(settings, seed)
