"""Stereo films: side by side, over and under, two files or three (docs/datasets/video.md)."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np

from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import Image, IntArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.sides import differ_in_number
from fgslam.datasets.calibrated import calibrated_rig, numbered
from fgslam.datasets.film_times import moments_of
from fgslam.datasets.images import sized
from fgslam.datasets.layouts import films_in
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import VideoSettings
from fgslam.datasets.video_frames import VideoFrames

_VIEWS: dict[str, tuple[int, int]] = {"side_by_side": (2, 1), "over_under": (1, 2)}
"""Views beside each other and above each other."""

_USUAL_SHAPE = 1.5  # width over height of a camera's image


def open_video(settings: VideoSettings) -> Recording:
    """Open a film of both views, or the films of a left and a right camera, and of a third one.

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
            "names (left.mp4 and right.mp4, with a third camera top.mp4); check dataset.path"
        )
    frames = [VideoFrames(film) for film in films]
    rate = settings.fps or frames[0].rate
    if not 0.0 < rate < np.inf:
        raise DatasetError(f"{films[0]} states no frame rate; say it: --fps RATE")
    views, rig, said = _views(settings, frames, films[0].parent)
    moments = moments_of(
        frames, rate, settings.fps is not None, 1e-3 * settings.pairing_tolerance_ms
    )
    chosen = select_frames(len(moments.times), settings)
    return Recording(
        name=given.stem if len(films) == 1 else given.resolve().name.replace("*", ""),
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=moments.times[chosen],
        identity=recording_identity([], films),
        ground_truth=None,
        notes=(
            *rig.remarks,
            *(note for each in frames for note in each.notes),
            *said,
            *moments.notes,
        ),
        indices=chosen,
        load_images=_Film(views, moments.numbers, rig, grey=True).load,
        load_colour=_Film(views, moments.numbers, rig, grey=False).load,
    )


Views = Callable[..., tuple[Image, ...]]
"""Right, left[, top] view (height, width, 3) in R, G, B, by numbers in the films; or FrameError."""


def _views(
    settings: VideoSettings, frames: list[VideoFrames], folder: Path
) -> tuple[Views, StereoRig, tuple[str, ...]]:
    """What gives the views of a frame, the rig that they fit, and what was assumed."""
    height, width = frames[0].load(0).shape[:2]
    if len(frames) > 1:
        rig, told = _rig(settings, folder, (width, height), (1, 1), pair=len(frames) == 2)
        by_number = differ_in_number(frames[0].name, frames[1].name)
        if len(frames) == 3:
            rig, order = _of_three(rig, folder, by_number)
        else:
            rig, order = numbered(rig) if by_number else rig, (1, 0)
        return _Films(frames, order).load, rig, told
    film = frames[0]
    fault: CalibrationError | None = None
    for name in [settings.views] if settings.views else _by_shape(width, height):
        columns, rows = _VIEWS[name]
        try:
            rig, told = _rig(settings, folder, (width // columns, height // rows), (columns, rows))
        except CalibrationError as error:
            fault = fault or error
            continue
        said = () if settings.views else (f"the film is taken as {name.replace('_', ' ')}",)
        return _Halves(film, columns, rows).load, rig, (*told, *said)
    _refuse_one_view(settings, folder, film.name, (width, height))
    raise fault or DatasetError(f"{folder}: no film")


def _of_three(rig: StereoRig, where: Path, by_number: bool) -> tuple[StereoRig, tuple[int, ...]]:
    """The rig, and which of left, right and third film its right, left[, top] camera's is.

    Films with numbers are those of the file's cameras in its order, and so are all of a file that
    calls its cameras left and right. Else the names say what the geometry must agree with.

    Raises:
        CalibrationError: it is of two cameras.
    """
    known = None if rig.rectifier is None else rig.rectifier.calibration
    in_line = rig.cameras == 2 and known is not None and len(known.cameras) == 3
    by_file = by_number or (known is not None and known.sided)
    if rig.cameras == 2 and not (in_line and by_file):
        raise CalibrationError(
            f"{where} has films of three cameras, but the calibration knows two; give one of all "
            "three, --camera FILE, or move the third film elsewhere"
        )
    order = rig.sources if by_file else (1, 0, 2)
    if rig.rectifier is not None:
        kept = tuple(range(rig.cameras))
        rig = replace(rig, rectifier=replace(rig.rectifier, order=kept))
    return rig, order


def _rig(
    settings: VideoSettings,
    folder: Path,
    size: tuple[int, int],
    views: tuple[int, int],
    pair: bool = True,
) -> tuple[StereoRig, tuple[str, ...]]:
    """The rig of views of a size, or of a column or row more, and what was assumed then.

    Most encoders take even sizes only, and leave out the last of an odd number; ``views`` are those
    beside and above each other: of two the film's size is even.
    """
    try:
        return calibrated_rig(settings, folder, size, pair), ()
    except CalibrationError:
        columns, rows = (
            (one, one + 1) if count == 1 and one % 2 == 0 else (one,)
            for one, count in zip(size, views, strict=True)
        )
        for whole in list(product(columns, rows))[1:]:
            with suppress(CalibrationError):
                rig = calibrated_rig(settings, folder, whole, pair)
                return rig, (
                    f"the film's views are {size[0]}x{size[1]}, calibrated for "
                    f"{whole[0]}x{whole[1]}: its encoder is taken to have left out the last column "
                    "or row of an odd number",
                )
        raise


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
class _Films:
    """A film of each camera; ``order``: whose are the right, left[, top] views."""

    films: list[VideoFrames]
    order: tuple[int, ...]

    def load(self, *numbers: int) -> tuple[Image, ...]:
        return tuple(self.films[k].load(numbers[k]) for k in self.order)


@dataclass(frozen=True, eq=False)
class _Film:
    """Rectified images of a film by number."""

    views: Views
    numbers: IntArray
    rig: StereoRig
    grey: bool

    def load(self, index: int) -> tuple[Image, ...]:
        """(right, left[, top]). Raises FrameError."""
        images = self.views(*self.numbers[index].tolist())
        if self.grey:
            images = tuple(map(_grey, images))
        size = self.rig.image_size
        whole = (_with_last(image, size) for image in images)
        return self.rig.rectified(tuple(sized(i, f"frame {index}", *size) for i in whole))


def _with_last(image: Image, size: tuple[int, int]) -> Image:
    """The image with the last column and row again that its encoder has left out."""
    columns, rows = size[0] - image.shape[1], size[1] - image.shape[0]
    if (columns, rows) not in ((1, 0), (0, 1), (1, 1)):
        return image
    return np.asarray(cv2.copyMakeBorder(image, 0, rows, 0, columns, cv2.BORDER_REPLICATE))


def _grey(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.uint8)
