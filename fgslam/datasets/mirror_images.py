"""Pictures of a mirror camera: a folder along a path, a video (docs/datasets/mirror_images.md)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.omni.camera_files import make_camera
from fgslam.core.arrays import Image
from fgslam.core.errors import DatasetError, FrameError
from fgslam.datasets.images import read_colour_image
from fgslam.datasets.omni_recording import OmniRecording, ids_of, no_times, pictures_in
from fgslam.datasets.omni_settings import OmniPathSettings, OmniVideoSettings
from fgslam.datasets.recording import recording_identity, select_frames


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
        load_image=lambda i: read_colour_image(paths[i]),
    )
    return recording.select(chosen)


# --------------------------------------------------------------------------------------------
# Video


def open_omni_video(settings: OmniVideoSettings) -> OmniRecording:
    """Open a video file; times come from its frame rate, the first frame is at 0 s.

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
    numbers = np.arange(frames.count, dtype=np.int64)
    recording = OmniRecording(
        name=path.stem,
        identity=recording_identity([path], []),
        camera=make_camera(settings.camera, (first.shape[1], first.shape[0]), path.parent),
        ids=numbers,
        names=tuple(f"frame {k}" for k in range(frames.count)),
        timestamps=numbers / rate,
        load_image=frames.load,
    )
    return recording.select(chosen)


class VideoFrames:
    """Frames of a video by number, exactly: decoded from the start, never by seeking.

    A decoder's seeking may land on a neighbour. Going backward therefore starts over; going forward
    costs what is skipped. The next frame and the present one cost nothing extra.
    """

    def __init__(self, path: Path) -> None:
        """Opens the file. Raises DatasetError where it is absent or no video."""
        self._path = path
        self._capture = self._open()
        self.count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        if self.count < 1:
            raise DatasetError(f"{path} holds no frame; give a video file")
        self._next = 0
        self._last: tuple[int, Image] | None = None

    def load(self, index: int) -> Image:
        """Frame (height, width, 3) in R, G, B. Raises FrameError where it cannot be decoded."""
        if self._last is not None and self._last[0] == index:
            return self._last[1].copy()
        if index < self._next:
            self._capture.release()
            self._capture, self._next = self._open(), 0
        while self._next <= index:
            if not self._capture.grab():
                raise FrameError(
                    f"video {self._path} ends after {self._next} frames, frame {index} of "
                    f"{self.count} is missing: it is truncated; restore it, or set dataset.stop"
                )
            self._next += 1
        decoded, frame = self._capture.retrieve()
        if not decoded or frame is None:
            raise FrameError(
                f"video {self._path}: frame {index} cannot be decoded; leave it out with "
                "dataset.start, stop or stride"
            )
        image = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)
        self._last = (index, image)
        return image.copy()

    def _open(self) -> cv2.VideoCapture:
        if not self._path.is_file():
            raise DatasetError(
                f"video {self._path} does not exist; check dataset.path, or say where it is: "
                "--set dataset.path=FILE"
            )
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            raise DatasetError(
                f"{self._path} cannot be opened as a video: it is damaged or of an unknown format; "
                "restore or convert it"
            )
        return capture
