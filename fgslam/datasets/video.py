"""Stereo films: one of both views, or one a camera (docs/datasets/images.md).

Frames are decoded by number, those of several films are paired by number or by time.
"""

from __future__ import annotations

import errno
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import islice, product
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image as Pillow

from fgslam.cameras.rig import StereoRig
from fgslam.cameras.rings import find_mirror_circle
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import CalibrationError, DatasetError, FrameError, OutputError
from fgslam.core.files import remove_left_behind, replacing
from fgslam.core.sides import differ_in_number
from fgslam.datasets.images import LEAVE_OUT, both_views, require_size
from fgslam.datasets.layouts import films_in
from fgslam.datasets.ledger import IMAGES, PAIRING, TIMES, Entry
from fgslam.datasets.recording import (
    Recording,
    calibrated_rig,
    image_recording,
    in_order,
    numbered,
    rig_of_views,
)
from fgslam.datasets.settings import RecordedOdometrySettings, VideoSettings
from fgslam.datasets.times import NANOSECONDS, pair_stamps

Views: TypeAlias = Callable[..., tuple[Image, ...]]
"""Right, left[, top] view (height, width, 3) in R, G, B, by numbers in the films; or FrameError."""


def open_video(settings: VideoSettings, _: RecordedOdometrySettings) -> Recording:
    """Open a film of both views, or the films of a left and a right camera, and of a third one.

    Raises:
        DatasetError: there is no film, it holds no frame, or is of one camera.
        CalibrationError: there is no calibration, or it is of images of another size.
        FrameError: the first frame cannot be decoded.
    """
    given = Path(settings.path)
    paths = films_in(given)
    if not paths:
        raise DatasetError(
            f"{given}: neither one film nor one of a left and one of a right camera, by their "
            "names (left.mp4 and right.mp4, with a third camera top.mp4); check dataset.path"
        )
    films = [VideoFrames(path) for path in paths]
    rate = settings.fps or films[0].rate
    views, rig, assumed = _views(settings, films, paths[0].parent)
    shown, times, timed, pairing = moments_of(films, rate, settings.fps is not None)
    size = rig.image_size

    def load(index: int, colour: bool) -> tuple[Image, ...]:
        images = views(*shown[index].tolist())
        if not colour:
            images = tuple(
                np.asarray(cv2.cvtColor(np.ascontiguousarray(i), cv2.COLOR_RGB2GRAY), np.uint8)
                for i in images
            )
        whole = [_with_last(image, size) for image in images]
        return rig.rectified(tuple(require_size(i, f"frame {index}", *size) for i in whole))

    notes = (*(note for film in films for note in film.notes), *assumed, *timed)
    name = given.stem if len(films) == 1 else given.resolve().name.replace("*", "")
    sides = Entry(IMAGES, ", ".join(film.name for film in films), "names of the films")
    timing = Entry(TIMES, f"{rate:g} Hz", "--fps" if settings.fps else paths[0].name, "--fps")
    ledger = (sides, timing, pairing)
    return image_recording(settings, name, rig, times, load, ([], paths), notes, ledger)


def _with_last(image: Image, size: tuple[int, int]) -> Image:
    """The image with the last column and row again that its encoder has left out."""
    columns, rows = size[0] - image.shape[1], size[1] - image.shape[0]
    if (columns, rows) not in ((1, 0), (0, 1), (1, 1)):
        return image
    return np.asarray(cv2.copyMakeBorder(image, 0, rows, 0, columns, cv2.BORDER_REPLICATE))


# --------------------------------------------------------------------------------------------
# Where the views of a frame are, and the rig that they fit


def _views(
    settings: VideoSettings, films: list[VideoFrames], folder: Path
) -> tuple[Views, StereoRig, tuple[str, ...]]:
    """What gives the views of a frame, the rig that they fit, and what was assumed."""
    height, width = films[0].load(0).shape[:2]
    if len(films) > 1:
        rig, assumed = _rig(settings, folder, (width, height), (1, 1), pair=len(films) == 2)
        rig, order = _films_of_cameras(rig, films, folder)
        return lambda *numbers: tuple(films[k].load(numbers[k]) for k in order), rig, assumed
    film = films[0]
    try:
        (rig, assumed, size), name = rig_of_views(
            (width, height), lambda size, views: (*_rig(settings, folder, size, views), size)
        )
        note = f"the film is taken as {name}"
        return lambda number: both_views(film.load(number), size), rig, (*assumed, note)
    except CalibrationError as error:
        fault = error
    with suppress(CalibrationError):
        calibrated_rig(settings, folder, (width, height))
        raise DatasetError(
            f"{film.name} is {width}x{height}, as large as the calibrated image of one camera: a "
            "film of one camera alone cannot be used; one that shows both squeezed must be "
            "stretched back to twice the width (side by side) or height"
        )
    with suppress(CalibrationError):
        find_mirror_circle(film.load(0), np.random.default_rng(0))
        raise DatasetError(
            f"{film.name} shows the round picture of one mirror or fisheye, no stereo pair; routes "
            f"of such a camera: fgslam teach {settings.path} --camera FILE --out ROUTE"
        )
    raise fault


def _films_of_cameras(
    rig: StereoRig, films: list[VideoFrames], where: Path
) -> tuple[StereoRig, tuple[int, ...]]:
    """The rig, and which film is that of its right, left[, top] camera.

    Films with numbers are those of the file's cameras in its order, and so are all of a file that
    calls its cameras left and right. Else the names say what the geometry must agree with.

    Raises:
        CalibrationError: it is of two cameras, and the films are of three.
    """
    by_number = differ_in_number(films[0].name, films[1].name)
    if len(films) == 2:
        return numbered(rig) if by_number else rig, (1, 0)
    known = None if rig.rectifier is None else rig.rectifier.calibration
    in_line = rig.cameras == 2 and known is not None and len(known.cameras) == 3
    by_file = by_number or (known is not None and known.sided)
    if rig.cameras == 2 and not (in_line and by_file):
        raise CalibrationError(
            f"{where} has films of three cameras, but the calibration knows two; give one of all "
            "three, --camera FILE, or move the third film elsewhere"
        )
    return in_order(rig), rig.sources if by_file else (1, 0, 2)


def _rig(
    settings: VideoSettings,
    folder: Path,
    size: tuple[int, int],
    views: tuple[int, int],
    pair: bool = True,
) -> tuple[StereoRig, tuple[str, ...]]:
    """The rig of views of a size, or of a column or row more, and what was assumed then.

    Most encoders take even sizes only, and leave out the last of an odd number; ``views`` are those
    next to and above each other: of two the film's size is even.
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


# --------------------------------------------------------------------------------------------
# When frames of films are shown, and which belong together


_UNEVEN = 0.1  # of the time of a frame: less is the rounding of files that count milliseconds

_LASTING = 15  # frames over which films part, not only jitter: at most half of the film


Moments: TypeAlias = tuple[IntArray, FloatArray, tuple[str, ...], Entry]
"""Numbers (n, films) of the frames of each film that are shown at one time, these times (n,) in
seconds from the first film's beginning on, and notes on how they were found and how that is."""


def moments_of(films: list[VideoFrames], rate: float, stated: bool) -> Moments:
    """Frames of one film, or of several those of one number, or of one time where that is another.

    Args:
        films: one, or those of the left and of the right camera, and of a third one.
        rate: frames a second of the first.
        stated: that rate is the user's, in place of each film's own times.

    Raises:
        DatasetError: no two frames are shown at one time.
    """
    own = [None if stated else film.stamps() for film in films]
    if len(films) == 1:
        return _by_number(films, own, rate)
    either = (film.even() if its is None else its for film, its in zip(films, own, strict=True))
    known = [times for times in either if times is not None]
    if stated or len(known) < len(films) or not any(_part(known[0], its) for its in known[1:]):
        how, (numbers, times, reported, entry) = "number", _by_number(films, own, rate)
    else:  # of the frames that are each other's nearest
        how = "time"
        left, right, *third = (np.rint(each / NANOSECONDS).astype(np.int64) for each in known)
        sides = zip(("left", "third"), (films[0], *films[2:]), (left, *third), strict=False)
        others = [(side, film.name, stamps) for side, film, stamps in sides]
        rows, reported, entry = pair_stamps(right, others, films[1].name)
        numbers = rows[:, [1, 0, *range(2, len(films))]]
        times = known[0][numbers[:, 0]]
    count, all_ = ("two", "both") if len(films) == 2 else ("three", "all")
    notes = [
        f"frames of the {count} films are paired by their {how}: {all_} must begin at one time"
    ]
    first = films[0]
    for film, side in zip(films[1:], ("right", "third"), strict=False):
        if first.count != film.count:
            notes.append(f"the left film has {first.count} frames, the {side} one {film.count}")
        if abs(first.rate - film.rate) > 1e-3 * first.rate:
            text = f"the left film has {first.rate:g} frames a second, the {side} {film.rate:g}"
            notes.append(text)
    return numbers, times, (*notes, *reported), entry._replace(source=notes[0], guessed=True)


def _part(left: FloatArray, right: FloatArray) -> bool:
    """Whether frames of one number come to lie nearer to frames of another one, and stay there.

    Single frames may be late: by the time alone they would lose their partners.
    """
    count = min(len(left), len(right))
    if count < 2:
        return False
    apart = sliding_window_view(left[:count] - right[:count], min(_LASTING, count // 2))
    step = min(times[-1] / (len(times) - 1) for times in (left, right))
    return bool(np.abs(np.median(apart, axis=1)).max() > 0.5 * step)


def _by_number(films: list[VideoFrames], own: list[FloatArray | None], rate: float) -> Moments:
    """Frames at the rate, or each at its time in the first film where these are uneven."""
    count = min(film.count for film in films)
    even = np.arange(count, dtype=np.int64) / rate
    numbers = np.repeat(np.arange(count, dtype=np.int64)[:, None], len(films), axis=1)
    shown = [times[:count] for times in own if times is not None]
    entry = Entry(PAIRING, "by number" if len(films) > 1 else "in one image", "the film")
    if count < 2 or len(shown) < len(films):
        return numbers, even, (), entry
    notes: tuple[str, ...] = ()
    apart = max((float(np.abs(shown[0] - its).max()) for its in shown[1:]), default=0.0)
    if apart > _UNEVEN / rate:
        notes = (f"frames of one number differ in time by up to {1e3 * apart:.0f} ms in the films",)
    if np.abs(shown[0] - even).max() <= _UNEVEN / rate:
        return numbers, even, notes, entry
    steps = 1e3 * np.diff(shown[0])
    note = f"frames are {steps.min():.0f} to {steps.max():.0f} ms apart: each has its own time"
    return numbers, shown[0], (note, *notes), entry


# --------------------------------------------------------------------------------------------
# Frames of a film by number


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
        capture = self._open()
        capture.set(cv2.CAP_PROP_POS_FRAMES, stated - 1)
        self.count = stated if stated > 0 and capture.grab() else 0
        capture.release()
        if not self.count:  # the last frame that the file states is not there: how many are
            capture = self._open()
            while capture.grab():
                self.count += 1
            capture.release()
        if self.count < 1:
            raise DatasetError(f"{path} holds no frame; give a video file")
        notes = []
        if self.count < stated:
            notes.append(f"{path.name} is cut off: {self.count} of {stated} frames can be read")
        if turn := round(self._capture.get(cv2.CAP_PROP_ORIENTATION_META)):
            notes.append(
                f"{path.name} states that it is to be turned by {turn} degrees, and is read so: "
                "the calibration must be of images turned so"
            )
        self.notes = tuple(notes)
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

    def even(self) -> FloatArray:
        """Seconds (count,) from the first frame on by the stated rate, which OpenCV has of any."""
        return np.arange(self.count) / self.rate

    def _go_to(self, index: int) -> None:
        if index < self._next:
            self._capture.release()
            self._capture, self._next = self._open(), 0
        while self._next <= index:
            if not self._capture.grab():
                raise FrameError(
                    f"video {self._path} ends after {self._next} frames, frame {index} of "
                    f"{self.count} is missing: it is truncated; restore it, or {LEAVE_OUT}"
                )
            self._next += 1
            if index - self._next >= _KEPT:
                continue
            decoded, frame = self._capture.retrieve()
            if decoded and frame is not None:
                image = np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2RGB), np.uint8)
                self._kept[self._next - 1] = image
                while len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
            elif self._next > index:
                raise FrameError(
                    f"video {self._path}: frame {index} cannot be decoded; {LEAVE_OUT}"
                )

    def _open(self) -> cv2.VideoCapture:
        capture = cv2.VideoCapture(str(self._path))
        if not capture.isOpened():
            raise DatasetError(
                f"{self._path} cannot be opened as a video: it is damaged, holds no frame or is of "
                "an unknown format; restore or convert it"
            )
        return capture


# ------------------------------------------------------------------------------------------
# Films as files: written frame by frame, MP4 or GIF

_GIF_FPS = 10.0  # what viewers show at least; more only makes the file larger
_GIF_WIDTHS = (720, 560, 440, 360)
GIF_BYTES = 3_000_000  # what pages and READMEs take: a larger one is made narrower


def require_film_suffix(path: Path) -> None:
    """Raises OutputError unless the file's name ends in .mp4 or .gif."""
    if path.suffix.lower() not in (".mp4", ".gif"):
        raise OutputError(
            f"cannot write {path}: unknown film format '{path.suffix}'; use .mp4 or .gif"
        )


def write_film(path: Path, frames: Iterable[Image], fps: float, width: int | None = None) -> int:
    """Writes a film whole or not at all; how many frames it has.

    A .gif has every so-maniest frame, so that it shows at most ten a second, and is at
    most 720 pixels wide, or narrower to stay below 3 MB.

    Args:
        path: the file, .mp4 or .gif.
        frames: (height, width, 3) red, green, blue, uint8, all of one even size.
        fps: frames a second.
        width: to which frames are made smaller or larger, pixels; None: as they are.

    Raises:
        OutputError: another ending, no frame at all, or writing failed.
    """
    require_film_suffix(path)
    write = _write_gif if path.suffix.lower() == ".gif" else _write_mp4
    remove_left_behind(path)
    sized = frames if width is None else (_of_width(frame, width) for frame in frames)
    with replacing(path) as partial:
        count = write(partial, sized, fps)
        if not count:
            raise OutputError(f"cannot write {path}: there is no frame to show")
    return count


def _of_width(frame: Image, width: int) -> Image:
    """A frame of that width and an even height: encoders know no other."""
    height = 2 * round(0.5 * width * frame.shape[0] / frame.shape[1])
    size = 2 * (width // 2), height
    return np.asarray(cv2.resize(frame, size, interpolation=cv2.INTER_AREA), np.uint8)


def _write_mp4(path: Path, frames: Iterable[Image], fps: float) -> int:
    """Raises OSError or OutputError; OpenCV itself reports no file that it cannot write."""
    count, writer = 0, None
    path.write_bytes(b"\0")
    try:
        for frame in frames:
            if writer is None:
                size = (frame.shape[1], frame.shape[0])
                writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
                if not writer.isOpened():
                    raise OutputError("cannot write films as MP4: no encoder for them; use .gif")
            writer.write(cv2.cvtColor(frame, cv2.COLOR_RGB2BGR))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    if count:  # its table of frames is written last: where the disk is full it lacks some
        film = cv2.VideoCapture(str(path))
        found = round(film.get(cv2.CAP_PROP_FRAME_COUNT)) if film.isOpened() else 0
        film.release()
        if found != count:
            raise OSError(errno.ENOSPC, f"of {count} frames {found} were written")
    return count


def _write_gif(path: Path, frames: Iterable[Image], fps: float) -> int:
    step = max(1, round(fps / _GIF_FPS))
    frames = islice(frames, 0, None, step)
    pages = [Pillow.fromarray(_of_width(f, min(f.shape[1], _GIF_WIDTHS[0]))) for f in frames]
    for width in _GIF_WIDTHS if pages else ():
        height = round(width * pages[0].height / pages[0].width)
        smaller = [page.resize((width, height)) for page in pages if width < page.width] or pages
        # A palette each: a few hundred kilobytes in all.
        first, *rest = (page.quantize(64) for page in smaller)
        duration = round(1000.0 * step / fps)
        first.save(path, "GIF", save_all=True, append_images=rest, duration=duration, loop=0)
        if path.stat().st_size < GIF_BYTES:
            break
    return len(pages)
