"""ROS 1 and ROS 2 bags as stereo recordings, without ROS (docs/datasets/bags.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fgslam.cameras.rig import StereoRig
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import DatasetError, FrameError
from fgslam.datasets.bags import messages
from fgslam.datasets.bags.calibration import Stated, file_cameras, rig_of_bag
from fgslam.datasets.bags.files import BagFiles, Message, MessagesByPlace, bag_files, paths_of
from fgslam.datasets.bags.frames import FrameTree
from fgslam.datasets.bags.motion import odometry_source
from fgslam.datasets.bags.topics import Chosen, choose_topics
from fgslam.datasets.depth_view import (
    Depth,
    DepthFrames,
    Undistorted,
    depth_sigma_px,
    in_words,
)
from fgslam.datasets.images import bits_held, mosaic_note, sized
from fgslam.datasets.pairing import NANOSECONDS, pair_all
from fgslam.datasets.recording import Recording, recording_identity, select_frames
from fgslam.datasets.settings import BagSettings, RecordedOdometrySettings, RgbdSettings

T = TypeVar("T")


def open_bag(settings: BagSettings, odometry: RecordedOdometrySettings) -> Recording:
    """Open a bag; it is read through once for the stamps, images are read when asked for.

    Raises:
        DatasetError: it is no bag, has no pair of cameras, or their images do not pair.
        CalibrationError: neither its camera_info nor a file says where the cameras are.
    """
    where = Path(settings.path)
    paths = paths_of(where)
    files = BagFiles(paths)
    cameras = file_cameras(settings)
    chosen = choose_topics(files.topics, settings.topics, str(where), cameras, files.stated_in)
    index = _indexed(files, chosen)
    source = _Images(files, index, chosen)
    height, width = source.first(chosen.right).shape
    stated = Stated(index.infos, index.frames, index.tree, (width, height))
    placed = rig_of_bag(settings, stated, chosen)
    rig, chosen = placed.rig, placed.chosen
    rows, unpaired = _paired(index, chosen, settings)
    stamps = NANOSECONDS * index.stamps[chosen.right][rows[:, 0]].astype(np.float64)
    used = select_frames(len(rows), settings)
    views = (chosen.right, chosen.left, *chosen.views[2:])
    places = np.column_stack([index.places[v][rows[:, k]] for k, v in enumerate(views)])
    held = source.use_bits(places[:, 0])
    images: _Pairs | DepthFrames = _Pairs(source, places, rig)
    sigma = None
    if chosen.depth:
        pairs = _WithDepth(source, places, rig.image_size)
        images = DepthFrames(pairs.read, rig, Undistorted.of(placed.camera))
        sigma = depth_sigma_px(settings.scale * rig.fx, RgbdSettings.depth_sigma_m)
        unpaired = tuple(map(in_words, unpaired))
    return Recording(
        name=where.resolve().stem,
        rig=rig.plain(),
        rectifier=rig.rectifier,
        timestamps=stamps[used],
        identity=recording_identity([], [f for path in paths for f in bag_files(path)]),
        ground_truth=None,
        notes=(*files.notes, *chosen.notes, *index.notes, *unpaired, *held, *placed.notes),
        indices=used,
        load_images=images.load,
        load_colour=images.load_colour,
        odometry_source=odometry_source(chosen.motion, index.motions, odometry),
        disparity_sigma_px=sigma,
    )


# --------------------------------------------------------------------------------------------
# Once through the bag


@dataclass(frozen=True, eq=False)
class _Index:
    """What was found on the way through a bag, by topic.

    Attributes:
        topics: all that were looked at.
        times: (n,) the bag's time of each of their messages, nanoseconds.
        places: (k,) of each image topic's messages among the n, by increasing stamp.
        stamps: (k,) their stamps, nanoseconds, increasing.
        infos: the first camera_info of each camera, as in a file.
        frames: of each topic the frame of its first message.
        tree: of tf_static.
        motions: stamps in seconds and values of the odometry.
        notes: which stamps could not be used.
    """

    topics: frozenset[str]
    times: IntArray
    places: dict[str, IntArray]
    stamps: dict[str, IntArray]
    infos: dict[str, dict[str, Any]]
    frames: dict[str, str]
    tree: FrameTree
    motions: tuple[FloatArray, FloatArray]
    notes: tuple[str, ...]


def _indexed(files: BagFiles, chosen: Chosen) -> _Index:
    images, infos = set(chosen.views), {chosen.left_info, chosen.right_info}
    motion = chosen.motion.name if chosen.motion else None
    topics = frozenset(name for name in (*images, *infos, motion, *chosen.transforms) if name)
    first: dict[str, dict[str, Any]] = {}
    frames: dict[str, str] = {}
    tree = FrameTree(())

    def take(message: Message) -> tuple[str, int, int, Any]:
        connection, time, raw = message
        topic, value = connection.topic, None
        if topic in chosen.transforms:
            found = messages.transforms_of(files.decoded(connection, raw))
            tree.add(found, static=topic.endswith("tf_static"))
            return topic, time, time, None
        if topic == motion or topic not in frames:
            try:
                content = files.decoded(connection, raw)
            except FrameError:
                if topic not in images:
                    raise
                return topic, time, files.stamp(raw), None  # one lost frame
            frames.setdefault(topic, messages.frame_of(content))
            if topic in infos:
                first[topic] = messages.calibration_of(content)
            if topic == motion:
                value = messages.motion_of(content)
        return topic, time, files.stamp(raw), value

    rows = files.collect(topics, take)
    names = np.array([row[0] for row in rows])
    times, stamps = (np.array([row[k] for row in rows], np.int64) for k in (1, 2))
    places, by_stamp, notes = {}, {}, []
    for topic in sorted(images):
        places[topic], by_stamp[topic], note = _in_order(topic, names, times, stamps)
        notes += note
    moved = [(row[2], row[3]) for row in rows if row[0] == motion]
    values = np.array([value for _, value in moved])
    motions = (NANOSECONDS * np.array([stamp for stamp, _ in moved], np.float64), values)
    parts = (places, by_stamp, first, dict.fromkeys(topics, "") | frames, tree, motions)
    return _Index(topics, times, *parts, tuple(notes))


def _in_order(
    topic: str, names: Any, times: IntArray, stamps: IntArray
) -> tuple[IntArray, IntArray, list[str]]:
    """Places and increasing stamps of a topic's messages, and what had to be mended."""
    places = np.flatnonzero(names == topic)
    if len(places) == 0:
        raise DatasetError(f"no message of {topic} can be read; record the bag again")
    own, notes = stamps[places], []
    if len(places) > 1 and (own == own[0]).all():
        own = times[places]
        notes.append(f"{topic}: its headers have no time stamps, the bag's own times are used")
    order = np.argsort(own, kind="stable")
    kept = order[np.concatenate([[True], np.diff(own[order]) > 0])]
    if len(kept) < len(order):
        notes.append(f"{topic}: {len(order) - len(kept)} images repeat a stamp and are left out")
    return places[kept], own[kept], notes


def _paired(
    index: _Index, chosen: Chosen, settings: BagSettings
) -> tuple[IntArray, tuple[str, ...]]:
    """Rows (n, 2 or 3) of the right, left[, top] images of one time, and notes."""
    views = zip(("left", "top"), (chosen.left, *chosen.views[2:]), strict=False)
    others = [(side, view, index.stamps[view]) for side, view in views]
    tolerance = 1e-3 * settings.pairing_tolerance_ms
    return pair_all(index.stamps[chosen.right], others, tolerance, chosen.right)


# --------------------------------------------------------------------------------------------
# Images


class _Images:
    """Images of a bag by their place."""

    def __init__(self, files: BagFiles, index: _Index, chosen: Chosen) -> None:
        self._files, self._index = files, index
        self._messages = MessagesByPlace(files, index.topics, index.times, chosen.views)
        self._bits = 16

    def use_bits(self, places: IntArray) -> tuple[str, ...]:
        """Finds how many bits images of these places hold; what to tell of them."""
        stored = lambda k: self._made(int(places[k]), messages.stored_of)  # noqa: E731 - short
        self._bits, notes = bits_held(len(places), stored)
        return (*notes, *mosaic_note(len(places), lambda k: self.load(int(places[k]))))

    def load(self, place: int) -> Image:
        """A grey image. Raises FrameError."""
        return self._made(place, partial(messages.grey_of, bits=self._bits))

    def load_colour(self, place: int) -> Image:
        """The same in red, green, blue, where it has colour. Raises FrameError."""
        return self._made(place, partial(messages.colour_of, bits=self._bits))

    def _made(self, place: int, make: Callable[[Any, str], T]) -> T:
        connection, raw = self._messages.read(place)
        where = f"{self._files.paths[0]}, {connection.topic}"
        message = self._files.decoded(connection, raw)
        try:
            return make(message, where)
        except AttributeError as fault:  # the bag's own definition of the type is not ROS's
            raise FrameError(
                f"{where}: message without a field of its type ({fault}); copy the bag again"
            ) from None

    def load_depth(self, place: int) -> Depth:
        """Depths in metres. Raises FrameError."""
        return self._made(place, messages.depth_of)

    def first(self, topic: str) -> Image:
        """The first image of a topic that can be read. Raises DatasetError without any."""
        fault: FrameError | None = None
        for place in self._index.places[topic]:
            try:
                return self.load(int(place))
            except FrameError as error:
                fault = error
        raise DatasetError(f"not one image of {topic} can be read: {fault}")


@dataclass(frozen=True, eq=False)
class _WithDepth:
    """Images of one camera and their depths by frame."""

    images: _Images
    places: IntArray
    size: tuple[int, int]

    def read(self, index: int) -> tuple[Image, Depth, str]:
        """Image, depths in metres, and the name of the depth's message. Raises FrameError."""
        colour, depth = self.places[index].tolist()
        image = sized(self.images.load_colour(colour), f"message {colour}", *self.size)
        return image, self.images.load_depth(depth), f"message {depth}"


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Images of both cameras, or of three, by frame."""

    images: _Images
    places: IntArray
    rig: StereoRig

    def load(self, index: int) -> tuple[Image, ...]:
        """Rectified (right, left[, top]). Raises FrameError: damaged or of another size."""
        return self._rectified(index, self.images.load)

    def load_colour(self, index: int) -> tuple[Image, ...]:
        """The same in red, green, blue, or grey where the cameras are."""
        return self._rectified(index, self.images.load_colour)

    def _rectified(self, index: int, load: Callable[[int], Image]) -> tuple[Image, ...]:
        size = self.rig.image_size
        places = self.places[index].tolist()
        return self.rig.rectified(tuple(sized(load(p), f"message {p}", *size) for p in places))
