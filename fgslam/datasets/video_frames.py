"""Frames of a film by number."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import DatasetError, FrameError

_AS_STORED = -1  # packets of the file instead of decoded frames
_KEPT = 10  # decoded frames: threads ask for neighbours out of order


class VideoFrames:
    """Frames of a video by number, exactly: decoded from the start, never by seeking.

    A decoder's seeking may land on a neighbour. Going backward by more than the last few frames
    therefore starts over; going forward costs what is skipped. No frame is decoded twice on the
    way. Safe to be asked by several threads.

    Attributes:
        name: of the file.
        count: frames that can be read.
        rate: frames a second, as the file states it.
        notes: what was cut off; how the frames are turned.
    """

    def __init__(self, path: Path) -> None:
        """Opens the file. Raises DatasetError where it is absent, no video, or without a frame."""
        self._path, self.name = path, path.name
        self._lock = threading.Lock()
        self._capture = self._open()
        stated = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self.rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.count = stated if stated > 0 and self._reaches(stated) else self._counted()
        if self.count < 1:
            raise DatasetError(f"{path} holds no frame; give a video file")
        self.notes: tuple[str, ...] = tuple(self._noticed(stated))
        self._next = 0
        self._kept: OrderedDict[int, Image] = OrderedDict()

    def load(self, index: int) -> Image:
        """Frame (height, width, 3) in R, G, B. Raises FrameError where it cannot be decoded."""
        with self._lock:
            if index not in self._kept:
                self._go_to(index)
            return self._kept[index].copy()

    def stamps(self) -> FloatArray | None:
        """Seconds (count,) from the first frame on, each as the file states it; None without.

        Nothing is decoded. Frames are stored in another order than they are shown.
        """
        capture, found = self._open(), []
        if capture.set(cv2.CAP_PROP_FORMAT, _AS_STORED):
            while capture.grab():
                found.append(1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC))
        capture.release()
        times = np.sort(np.array(found, np.float64))[: self.count]
        if len(times) < self.count or np.any(np.diff(times) <= 0.0):
            return None
        return np.asarray(times - times[0])

    def even(self) -> FloatArray | None:
        """Seconds (count,) from the first frame on by the stated rate; None without a rate."""
        return np.arange(self.count) / self.rate if 0.0 < self.rate < np.inf else None

    def _go_to(self, index: int) -> None:
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
            if index - self._next < _KEPT:
                self._keep(self._next - 1, index)

    def _keep(self, number: int, wanted: int) -> None:
        decoded, frame = self._capture.retrieve()
        if decoded and frame is not None:
            self._kept[number] = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        elif number == wanted:
            raise FrameError(
                f"video {self._path}: frame {number} cannot be decoded; leave it out with "
                "dataset.start, stop or stride"
            )

    def _noticed(self, stated: int) -> Iterator[str]:
        if self.count < stated:
            yield f"{self.name} is cut off: {self.count} of {stated} frames can be read"
        if turn := round(self._capture.get(cv2.CAP_PROP_ORIENTATION_META)):
            yield (
                f"{self.name} states that it is to be turned by {turn} degrees, and is read so: "
                "the calibration must be of images turned so"
            )

    def _reaches(self, stated: int) -> bool:
        """Whether the last frame that the file states is there."""
        capture = self._open()
        try:
            capture.set(cv2.CAP_PROP_POS_FRAMES, stated - 1)
            return bool(capture.grab())
        finally:
            capture.release()

    def _counted(self) -> int:
        """How many frames can be read, by reading them."""
        capture, count = self._open(), 0
        while capture.grab():
            count += 1
        capture.release()
        return count

    def _open(self) -> cv2.VideoCapture:
        if not self._path.is_file():
            raise DatasetError(
                f"video {self._path} does not exist; check dataset.path, or say where it is: "
                "--set dataset.path=FILE"
            )
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            raise DatasetError(
                f"{self._path} cannot be opened as a video: it is damaged, holds no frame or is of "
                "an unknown format; restore or convert it"
            )
        return capture
