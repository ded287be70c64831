"""A folder of a mirror camera's pictures along a path (docs/datasets/mirror_images.md)."""

from __future__ import annotations

from pathlib import Path

from fgslam.cameras.omni.camera_files import make_camera
from fgslam.datasets.images import read_colour_image
from fgslam.datasets.omni.recording import OmniRecording, ids_of, no_times, pictures_in
from fgslam.datasets.omni.settings import OmniPathSettings
from fgslam.datasets.recording import recording_identity
from fgslam.datasets.selection import select_frames


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
        timestamps=no_times(len(paths)),
        poses=None,
        rooms=None,
        notes=(),
        load_image=lambda i: read_colour_image(paths[i]),
    )
    return recording.select(chosen)
