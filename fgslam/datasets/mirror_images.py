"""Pictures of a mirror camera: a folder along a path, a video (docs/datasets/mirror_images.md)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.cameras.omni.camera_files import make_camera
from fgslam.core.errors import DatasetError
from fgslam.datasets.film_times import moments_of
from fgslam.datasets.images import read_colour_image
from fgslam.datasets.omni_recording import OmniRecording, ids_of, pictures_in, times_of
from fgslam.datasets.omni_settings import OmniPathSettings, OmniVideoSettings
from fgslam.datasets.recording import recording_identity, select_frames
from fgslam.datasets.video_frames import VideoFrames


def open_omni_path(settings: OmniPathSettings) -> OmniRecording:
    """Open a folder of mirror images, in the order of the numbers in their names.

    Raises:
        DatasetError: the folder is absent or holds no such picture.
        CalibrationError: the camera is impossible, or calibrated for another size.
        FrameError: the first picture cannot be read.
    """
    root = Path(settings.path)
    paths = pictures_in(root, settings.pattern)
    chosen = select_frames(len(paths), settings)
    first = read_colour_image(paths[int(chosen[0])])
    recording = OmniRecording(
        name=root.resolve().name,
        identity=recording_identity([], paths),
        camera=make_camera(settings.camera, (first.shape[1], first.shape[0]), root),
        ids=ids_of([path.stem for path in paths]),
        names=tuple(path.name for path in paths),
        timestamps=times_of(paths, root),
        load_image=lambda i: read_colour_image(paths[i]),
    )
    return recording.select(chosen)


# --------------------------------------------------------------------------------------------
# Video


def open_omni_video(settings: OmniVideoSettings) -> OmniRecording:
    """Open a video file; times come from its rate or its frames, the first of which is at 0 s.

    Raises:
        DatasetError: the file is absent, no video, or without a frame rate.
        CalibrationError: the camera is impossible, or calibrated for another size.
        FrameError: the first frame cannot be decoded.
    """
    path = Path(settings.path)
    frames = VideoFrames(path)
    rate = settings.frame_rate_hz or frames.rate
    if not 0.0 < rate < np.inf:
        raise DatasetError(f"{path} states no frame rate; give dataset.frame_rate_hz")
    chosen = select_frames(frames.count, settings)
    first = frames.load(int(chosen[0]))
    moments = moments_of([frames], rate, settings.frame_rate_hz is not None)
    recording = OmniRecording(
        name=path.stem,
        identity=recording_identity([path], []),
        camera=make_camera(settings.camera, (first.shape[1], first.shape[0]), path.parent),
        ids=moments.numbers[:, 0],
        names=tuple(f"frame {k}" for k in range(frames.count)),
        timestamps=moments.times,
        notes=(*frames.notes, *moments.notes),
        load_image=frames.load,
    )
    return recording.select(chosen)
