"""Stereo films: side by side, over and under, or two files (docs/datasets/video.md)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.datasets.calibrated import calibrated_rig, numbered
from fgslam.datasets.images import sized
from fgslam.datasets.layouts import films_in
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import VideoSettings
from fgslam.datasets.sides import differ_in_number
from fgslam.datasets.video_frames import VideoFrames

_VIEWS: dict[str, tuple[int, int]] = {"side_by_side": (2, 1), "over_under": (1, 2)}
"""Views beside each other and above each other."""

_UNEVEN = 0.1  # of the time of a frame: less is the rounding of files that count milliseconds
_USUAL_SHAPE = 1.5  # width over height of a camera's image


def open_video(settings: VideoSettings) -> Recording:
    """Open a film of both views, or the films of a left and a right camera.

    Raises:
        DatasetError: there is no film, it holds no frame, or is of one camera.
        CalibrationError: there is no calibration, or it is of images of another size.
        FrameError: the first frame cannot be decoded.
    """
    given = Path(settings.path)
    films = films_in(given)
    if not films:
        raise DatasetError(
            f"{given}: neither one film nor one of a left and one of a right camera, by their "
            "names (left.mp4 and right.mp4); check dataset.path"
        )
    frames = [VideoFrames(film) for film in films]
    rate = settings.fps or frames[0].rate
    if not 0.0 < rate < np.inf:
        raise DatasetError(f"{films[0]} states no frame rate; say it: --fps RATE")
    views, rig, said = _views(settings, frames, films[0].parent)
    count = min(each.count for each in frames)
    chosen = select_frames(count, settings)
    times, told = _times(frames, count, rate, settings.fps is not None)
    return Recording(
        name=given.stem if len(films) == 1 else given.resolve().name.replace("*", ""),
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=times[chosen],
        identity=recording_identity([], films),
        ground_truth=None,
        notes=(*rig.remarks, *(note for each in frames for note in each.notes), *said, *told),
        indices=chosen,
        load_images=_Film(views, rig, grey=True).load,
        load_colour=_Film(views, rig, grey=False).load,
    )


def _times(
    frames: list[VideoFrames], count: int, rate: float, stated: bool
) -> tuple[FloatArray, tuple[str, ...]]:
    """Seconds (n,) of the frames by the rate, or each by its own; and what was found, in words."""
    even = np.arange(count, dtype=np.int64) / rate
    if stated or count < 2:
        return even, ()
    own = [found[:count] for film in frames if (found := film.stamps()) is not None]
    if len(own) < len(frames):
        return even, ()
    notes: tuple[str, ...] = ()
    if len(own) > 1 and (apart := float(np.abs(own[0] - own[1]).max())) > _UNEVEN / rate:
        notes = (f"frames of one number differ in time by up to {1e3 * apart:.0f} ms in the films",)
    if np.abs(own[0] - even).max() <= _UNEVEN / rate:
        return even, notes
    steps = 1e3 * np.diff(own[0])
    note = f"frames are {steps.min():.0f} to {steps.max():.0f} ms apart: each has its own time"
    return own[0], (note, *notes)


Views = Callable[[int], tuple[Image, Image]]
"""Right and left view (height, width, 3) in R, G, B by number; raises FrameError."""


def _views(
    settings: VideoSettings, frames: list[VideoFrames], folder: Path
) -> tuple[Views, StereoRig, tuple[str, ...]]:
    """What gives the views of a frame, the rig that they fit, and what was assumed."""
    height, width = frames[0].load(0).shape[:2]
    if len(frames) == 2:
        left, right = frames
        rig = calibrated_rig(settings, folder, (width, height))
        if differ_in_number(left.name, right.name):
            rig = numbered(rig)
        return lambda k: (right.load(k), left.load(k)), rig, _differences(left, right)
    film = frames[0]
    fault: CalibrationError | None = None
    for name in [settings.views] if settings.views else _by_shape(width, height):
        columns, rows = _VIEWS[name]
        try:
            rig = calibrated_rig(settings, folder, (width // columns, height // rows))
        except CalibrationError as error:
            fault = fault or error
            continue
        said = () if settings.views else (f"the film is taken as {name.replace('_', ' ')}",)
        return _Halves(film, columns, rows).load, rig, said
    _refuse_one_view(settings, folder, film.name, (width, height))
    raise fault or DatasetError(f"{folder}: no film")


def _refuse_one_view(
    settings: VideoSettings, folder: Path, name: str, size: tuple[int, int]
) -> None:
    """Raises DatasetError where the whole film is of the size of one calibrated view."""
    try:
        calibrated_rig(settings, folder, size)
    except CalibrationError:
        return
    raise DatasetError(
        f"{name} is {size[0]}x{size[1]}, as large as the calibrated image of one camera: a film of "
        "one camera alone cannot be used; one that shows both squeezed must be stretched back to "
        "twice the width (side by side) or height"
    )


def _by_shape(width: int, height: int) -> list[str]:
    """Both arrangements, first that which gives the views a usual shape."""

    def unusual(name: str) -> float:
        columns, rows = _VIEWS[name]
        return abs(math.log(width * rows / (height * columns) / _USUAL_SHAPE))

    return sorted(_VIEWS, key=unusual)


def _differences(left: VideoFrames, right: VideoFrames) -> tuple[str, ...]:
    """What two films that should run together differ in."""
    notes = ["frames of the two films are paired by their number: both must begin at one time"]
    if left.count != right.count:
        notes.append(f"the left film has {left.count} frames, the right one {right.count}")
    if abs(left.rate - right.rate) > 1e-3 * left.rate:
        notes.append(f"the left film has {left.rate:g} frames a second, the right {right.rate:g}")
    return tuple(notes)


@dataclass(frozen=True, eq=False)
class _Halves:
    """Both views in one film."""

    film: VideoFrames
    columns: int
    rows: int

    def load(self, index: int) -> tuple[Image, Image]:
        image = self.film.load(index)
        height, width = image.shape[0] // self.rows, image.shape[1] // self.columns
        return image[-height:, -width:], image[:height, :width]


@dataclass(frozen=True, eq=False)
class _Film:
    """Rectified images of a film by number."""

    views: Views
    rig: StereoRig
    grey: bool

    def load(self, index: int) -> tuple[Image, ...]:
        """(right, left). Raises FrameError."""
        images = self.views(index)
        if self.grey:
            images = (_grey(images[0]), _grey(images[1]))
        size = self.rig.image_size
        return self.rig.rectified(tuple(sized(i, f"frame {index}", *size) for i in images))


def _grey(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8)
