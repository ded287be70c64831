"""Loads frames and finds their features ahead of the loop, on all cores."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice, zip_longest
from typing import Protocol, TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, Float32, Image
from fgslam.core.errors import ConfigError, FrameError, OneImageError
from fgslam.core.log import Frame, ImageSequence, clearance
from fgslam.core.sensors import CAMERA_NAMES
from fgslam.core.types import Features
from fgslam.frontend.features.sift import as_bytes

# Frames in work at once. Three images on two cores leave one idle at the end of each frame;
# the next frame's images fill the gap.
_FRAMES_AHEAD = 3
# Of a feature's scale: so far around it reaches the Gaussian that finds it.
_SUPPORT = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class FeatureFrame:
    """A frame with its features, or the reason why it has none.

    Where SIFT runs on key frames only, a frame has none until it is found to be one.

    Attributes:
        i: position in the sequence.
        frame: the images, or None when they could not be read.
        features: of right alone, or of right, left[, top]; empty when there is no image.
        problem: what was wrong with the frame, in words; empty when nothing was.
        load_ms: time spent reading, in its own thread.
        sift_ms: the images' SIFT times, added up over threads.
        refused: it had images, but a camera's were not of this moment.
    """

    i: int
    frame: Frame | None
    features: tuple[Features, ...]
    problem: str
    load_ms: float
    sift_ms: float
    refused: bool = False

    @property
    def whole(self) -> Frame | None:
        """The frame, where the images of all cameras are to be used; else None."""
        return None if self.frame is None or self.frame.alone is not None else self.frame


class FeatureExtractor(Protocol):
    """Finds the features of an image: an extension point, any callable of this form will do.

    It is called from several threads at once, and must give the same features for the same image.
    """

    def __call__(self, image: Image, /) -> Features:
        """Features of a grey image (height, width), uint8.

        Returns:
            n features: ``xy`` (n, 2) (column, row) in pixels, ``scale`` (n,) in pixels,
            ``orientation`` (n,) in radians from x axis to y axis, in [0, 2 pi), ``descriptors``
            (n, d) of any kind. Of uint8, 128 are taken as they are, with a norm of about 512 as
            SIFT's; others are packed bits, as ORB's, compared by Hamming distance. Other numbers
            are vectors, compared by the angle between them.
        """
        ...


class FrameDescriber:
    """Finds the features of single frames, the images of each in parallel threads."""

    def __init__(self, extract: FeatureExtractor, reference_only: bool = False) -> None:
        """Takes any extractor; threads start with the first frame.

        With ``reference_only`` no other image's features are found: patches tell the rest.
        """
        self._extract = extract
        self._reference_only = reference_only
        self._pool = ThreadPoolExecutor(len(CAMERA_NAMES))
        self._reference: tuple[Frame, _Timed] | None = None

    def describe(self, i: int, frame: Frame | None) -> FeatureFrame:
        """Frame ``i`` with its features; without images (None) it has none."""
        return self.complete(undescribed(i, frame))

    def complete(self, found: FeatureFrame) -> FeatureFrame:
        """The frame with its features, found now unless it has them."""
        frame = found.frame
        if frame is None or found.features:
            return found
        if frame.alone is not None:
            features, ms = _timed(self._extract, *list(_views(frame))[frame.alone])
            return replace(found, features=(features,), sift_ms=ms)
        if self._reference_only:
            return self.of_reference(found)
        timed, known = partial(_timed, self._extract), self._known(frame)
        views = list(_views(frame))[len(known) :]
        tasks = [*known, *(self._pool.submit(timed, *view) for view in views)]
        return _Pending(found.i, frame, "", found.load_ms, tasks).finish()

    def of_reference(self, found: FeatureFrame) -> FeatureFrame:
        """The frame with the features of its reference image alone, unless it has any."""
        if found.frame is None or found.features:
            return found
        if not self._known(found.frame):
            done = _Timed()
            done.set_result(_timed(self._extract, *next(iter(_views(found.frame)))))
            self._reference = found.frame, done
        ((features, ms),) = (known.result() for known in self._known(found.frame))
        return replace(found, features=(features,), sift_ms=ms)

    def begin(self, frame: Frame | None) -> None:
        """Starts to find, in a thread, the features that :meth:`of_reference` gives of a frame."""
        if frame is not None and frame.alone is None:
            view = next(iter(_views(frame)))
            self._reference = frame, self._pool.submit(_timed, self._extract, *view)

    def _known(self, frame: Frame) -> list[_Timed]:
        """The features of a frame's reference image, where no other was asked for since."""
        return [self._reference[1]] if self._reference and self._reference[0] is frame else []

    def close(self) -> None:
        """Ends the threads."""
        self._pool.shutdown()


def undescribed(i: int, frame: Frame | None) -> FeatureFrame:
    """Frame ``i`` before its features are found."""
    return FeatureFrame(i, frame, (), "" if frame else "no images were given", 0.0, 0.0)


class FeatureStream:
    """Iterates over a sequence's frames in order, features found in parallel ahead of time."""

    def __init__(
        self,
        sequence: ImageSequence,
        extract: FeatureExtractor | None,
        reference_only: bool = False,
    ) -> None:
        """Takes any extractor; it must be safe to call from several threads. None: only images.

        With ``reference_only`` no other image's features are found: patches tell the rest.
        """
        self._sequence = sequence
        self._extract = extract
        self._images = 1 if reference_only else None
        self._found: deque[_Pending] = deque()  # loaded, to come next

    def upcoming(self) -> Frame | None:
        """Images of the frame after the one that came last; None where there are none."""
        return self._found[0].frame if self._found else None

    def __call__(self, start: int = 0) -> Generator[FeatureFrame, None, None]:
        """Yields frames ``start`` and after; stops its threads when closed."""
        pool = ThreadPoolExecutor(os.cpu_count() or 1)
        waiting: deque[tuple[int, Future[tuple[Frame | None, str, float]]]] = deque()
        self._found = found = deque[_Pending]()
        upcoming = iter(range(start, len(self._sequence)))
        try:
            while True:
                for i in upcoming:
                    waiting.append((i, pool.submit(self._load, i)))
                    if len(waiting) + len(found) > _FRAMES_AHEAD:
                        break
                while waiting and len(found) < _FRAMES_AHEAD:
                    i, loading = waiting.popleft()
                    found.append(self._start(i, *loading.result(), pool))
                if not found:
                    return
                yield found.popleft().finish()
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    def _load(self, i: int) -> tuple[Frame | None, str, float]:
        start, frame, fault = time.perf_counter(), None, ""
        try:
            frame = self._sequence.frame(i)
        except OneImageError as error:
            frame = error.frame
            fault = f"{error}; the {CAMERA_NAMES[error.frame.alone]} image alone is used"
        except FrameError as error:
            fault = str(error)
        return frame, fault, 1e3 * (time.perf_counter() - start)

    def _start(
        self, i: int, frame: Frame | None, fault: str, load_ms: float, pool: ThreadPoolExecutor
    ) -> _Pending:
        if frame is None or fault or self._extract is None:
            return _Pending(i, frame, fault, load_ms, [])
        timed = partial(_timed, self._extract)
        tasks = [pool.submit(timed, *view) for view in islice(_views(frame), self._images)]
        return _Pending(i, frame, "", load_ms, tasks)


_Timed: TypeAlias = Future[tuple[Features, float]]
"""An image's features, and how long it took to find them."""


def _views(frame: Frame) -> Iterable[tuple[Image, Float32 | None]]:
    """Each image with its margins; None where it is full."""
    return zip_longest(frame.images, frame.margins)


def _timed(
    extract: FeatureExtractor, image: Image, margin: Float32 | None
) -> tuple[Features, float]:
    start = time.perf_counter()
    found = _checked(extract(image))
    if margin is not None:
        found = found.select(_clear(found, margin))
    return found, 1e3 * (time.perf_counter() - start)


def _clear(found: Features, margin: Float32) -> BoolArray:
    """Which features (n,) are clear of what shows nothing: that would be seen in every image."""
    return np.asarray(clearance(margin, found.xy) > _SUPPORT * found.scale)


def _checked(found: Features) -> Features:
    """Features of an extractor, checked for form; raises ConfigError."""
    if not isinstance(found, Features):
        raise ConfigError(
            f"features: the extractor returned {type(found).__name__}; return fgslam.Features"
        )
    for name in ("xy", "scale", "orientation", "descriptors"):
        value: object = getattr(found, name)
        if not isinstance(value, np.ndarray):
            raise ConfigError(f"features: {name} is a {type(value).__name__}; give an array")
    n = found.scale.size
    shapes = {"xy": (n, 2), "scale": (n,), "orientation": (n,)}
    for name, shape in shapes.items():
        if np.shape(getattr(found, name)) != shape:
            raise ConfigError(
                f"features: {name} has shape {np.shape(getattr(found, name))}, not {shape}; {n} "
                "features were found"
            )
    descriptors = as_bytes(found.descriptors)
    if len(descriptors) != n:
        raise ConfigError(
            f"features: {len(descriptors)} descriptors of {n} features; give each one"
        )
    return replace(found, descriptors=descriptors)


@dataclass(frozen=True, slots=True, eq=False)
class _Pending:
    i: int
    frame: Frame | None
    problem: str
    load_ms: float
    tasks: list[_Timed]

    def finish(self) -> FeatureFrame:
        results = [task.result() for task in self.tasks]
        features = tuple(found for found, _ in results)
        sift_ms = sum(ms for _, ms in results)
        return FeatureFrame(self.i, self.frame, features, self.problem, self.load_ms, sift_ms)
