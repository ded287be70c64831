"""ROS 1 and ROS 2 bags as stereo recordings, without ROS (docs/datasets/bags.md)."""

from __future__ import annotations

import struct
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag1 import ReaderError as ReaderError1
from rosbags.rosbag2 import ReaderError as ReaderError2
from rosbags.rosbag2 import storage_mcap, storage_sqlite3
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore

from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import StereoRig, at_size, implausible, in_metres, read_calibration_file
from fgslam.cameras.stereo_formats import read_camera_info, read_camera_info_pair
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import CalibrationError, DatasetError, FrameError, OdometryError
from fgslam.core.files import shown_in
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, inverse
from fgslam.core.sensors import body_is_camera
from fgslam.core.sides import differ_in_number
from fgslam.datasets import bag_messages as messages
from fgslam.datasets.bag_messages import FrameTree, view_axes
from fgslam.datasets.bag_topics import (
    SENSOR,
    TRANSPORT,
    Chosen,
    Topic,
    choose_topics,
    file_cameras,
    is_registered,
)
from fgslam.datasets.depth import (
    DEPTH_SIGMA_M,
    Depth,
    camera_of_file,
    colour_and_depth_notes,
    depth_images,
    depth_rig,
    depth_sigma_px,
    require_one_camera,
)
from fgslam.datasets.images import bits_held, mosaic_note, require_size
from fgslam.datasets.layouts import files_of, is_bag, is_packed_bag
from fgslam.datasets.odometry import (
    POSE_COLUMNS,
    RATE_COLUMNS,
    SPEED_COLUMNS,
    OdometrySource,
    motions_of,
    recorded_motions,
)
from fgslam.datasets.recording import (
    LOOKS_AHEAD,
    Recording,
    image_recording,
    loaded_rig,
    mounted,
    numbered,
    read_rig,
    recording_identity,
)
from fgslam.datasets.settings import BagSettings, RecordedOdometrySettings
from fgslam.datasets.times import NANOSECONDS, Table, pair_stamps

T = TypeVar("T")

Message: TypeAlias = tuple[Connection, int, bytes]
"""Connection, the bag's time in nanoseconds, raw bytes."""

Info: TypeAlias = dict[str, Any]
"""A camera_info with the keys of camera_calibration's files."""


def open_bag(settings: BagSettings, odometry: RecordedOdometrySettings) -> Recording:
    """Open a bag; it is read through once for the stamps, images are read when asked for.

    Raises:
        DatasetError: it is no bag, has no pair of cameras, or their images do not pair.
        CalibrationError: neither its camera_info nor a file states where the cameras are.
    """
    where = Path(settings.path)
    paths = paths_of(where)
    files = BagFiles(paths)
    cameras = file_cameras(settings)
    chosen = choose_topics(files.topics, settings.topics, str(where), cameras, files.stated_in)
    index = _index_of(files, chosen)
    images = _Images(files, index, chosen.views)
    stated = Stated(index.infos, index.frames, index.tree, images.first_size(chosen.right))
    placed = rig_of_bag(settings, stated, chosen)
    rig, chosen = placed.rig, placed.chosen
    views = (chosen.right, chosen.left, *chosen.views[2:])
    others = [
        (side, view, index.stamps[view])
        for side, view in zip(("left", "top"), views[1:], strict=False)
    ]
    tolerance = 1e-3 * settings.pairing_tolerance_ms
    rows, unpaired = pair_stamps(index.stamps[chosen.right], others, tolerance, chosen.right)
    places = np.column_stack([index.places[v][rows[:, k]] for k, v in enumerate(views)])
    held = images.use_bits(places[:, 0])
    load, size, sigma = images.rectified(places, rig), rig.image_size, None
    if chosen.depth:

        def read(index: int) -> tuple[Image, Depth, str]:
            colour, depth = places[index].tolist()
            image = require_size(images.load(colour, True), f"message {colour}", *size)
            return image, images.load_depth(depth), f"message {depth}"

        load = depth_images(read, rig, placed.cameras[1])
        sigma = depth_sigma_px(settings.scale * rig.fx, DEPTH_SIGMA_M)
        unpaired = colour_and_depth_notes(unpaired)
    recording = image_recording(
        settings,
        where.resolve().stem,
        replace(rig, remarks=()),
        NANOSECONDS * index.stamps[chosen.right][rows[:, 0]].astype(np.float64),
        load,
        recording_identity([], [file for path in paths for file in _bag_files(path)]),
        (*files.notes, *chosen.notes, *index.notes, *unpaired, *held, *placed.notes),
    )
    return replace(
        recording,
        odometry_source=_odometry_source(chosen.motion, index.motions, odometry),
        disparity_sigma_px=sigma,
    )


# --------------------------------------------------------------------------------------------
# The files of a bag: which topics, their messages in order, one again by place. Nothing but places
# and stamps is held in memory.


DAMAGED = (
    *(AnyReaderError, ReaderError1, ReaderError2, SerdeError, TypesysError),
    storage_sqlite3.apsw.Error,  # type: ignore[attr-defined]
    storage_mcap.zstd.ZstdError,  # type: ignore[attr-defined]
    *(ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, OSError),
    *(MemoryError, RuntimeError, TypeError, ValueError, struct.error),
)
"""What rosbags and its libraries raise where a file is damaged."""

_KEPT = 16  # raw messages: the two images of the frames that threads ask for ahead of each other
_WALKED = 512  # messages that are passed over rather than looked up again


class BagFiles:
    """The files of one recording as one; a damaged one is read up to the damage.

    Attributes:
        paths: the files, or the folder of a ROS 2 bag.
        topics: in the order of their names.
        notes: whether a part cannot be read.
    """

    def __init__(self, paths: list[Path]) -> None:
        """Opens the files. Raises DatasetError where one of them is no bag, or has no index."""
        self.paths = paths
        self.notes: tuple[str, ...] = ()
        try:
            self._reader = AnyReader(paths, default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
        except DAMAGED as fault:
            raise DatasetError(_unreadable(paths, fault)) from None
        counts: dict[tuple[str, str], int] = {}
        for each in self._reader.connections:
            key = (each.topic, each.msgtype)
            if None in key:  # a damaged table of topics
                continue
            counts[key] = counts.get(key, 0) + each.msgcount
        self.topics = tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def collect(self, topics: Collection[str], take: Callable[[Message], T]) -> list[T]:
        """What ``take`` makes of every message of these topics; once through the whole bag."""
        rows: list[T] = []
        try:
            for message in self.messages(topics):
                rows.append(take(message))
        except DatasetError as fault:
            if not rows:
                raise
            self.notes = (f"{fault}; the {len(rows)} messages before the damage are used",)
        return rows

    def messages(self, topics: Collection[str], start: int | None = None) -> Iterator[Message]:
        """Messages of these topics in order of the bag's time. Raises DatasetError at damage."""
        wanted = [each for each in self._reader.connections if each.topic in topics]
        if wanted:
            try:
                yield from self._reader.messages(wanted, start=start)
            except DAMAGED as fault:
                raise DatasetError(_unreadable(self.paths, fault)) from None

    def stated_in(self, topic: Topic) -> str:
        """The frame in which a topic's first message is stated; empty where it cannot be read."""
        try:
            connection, _, raw = next(self.messages((topic.name,)))
            return str(self.decoded(connection, raw).header.frame_id)
        except (StopIteration, FrameError, DatasetError):
            return ""

    def decoded(self, connection: Connection, raw: bytes) -> Any:
        """The message's fields. Raises FrameError where they are damaged."""
        try:
            return self._reader.deserialize(raw, connection.msgtype)
        except DAMAGED as fault:
            raise FrameError(
                f"a message of {connection.topic} in {self.paths[0]} cannot be decoded ({fault}); "
                "leave the frame out with dataset.start/stop/stride"
            ) from None

    def stamp(self, raw: bytes) -> int:
        """Nanoseconds by the header of a stamped message: its first field in both versions."""
        # ROS 1: sequence number, seconds, nanoseconds; ROS 2: encapsulation, seconds, nanoseconds.
        order = "big" if self._reader.is2 and raw[1] == 0 else "little"
        seconds, rest = (int.from_bytes(raw[k : k + 4], order) for k in (4, 8))  # type: ignore[arg-type]
        return 1_000_000_000 * seconds + rest


def paths_of(given: Path) -> list[Path]:
    """What is opened: a folder that is one ROS 2 bag, or all files of a folder or pattern."""
    folder = given.parent if is_packed_bag(given) else given
    if (folder / "metadata.yaml").is_file():
        return [folder]
    found = _bag_files(given) if given.is_dir() else files_of(given)
    if packed := next(filter(is_packed_bag, found), None):
        raise DatasetError(
            f"{packed} is compressed as a whole, and no metadata.yaml is next to it; unpack it: "
            f"zstd -d {packed.name}"
        )
    return found


def _bag_files(path: Path) -> list[Path]:
    """The files of a folder that are bags, or the file itself."""
    if not path.is_dir():
        return [path]
    return [file for file in shown_in(path) if is_bag(file) and file.is_file()]


def _unreadable(paths: list[Path], fault: Exception) -> str:
    """What is wrong with a bag, and the command that mends the first of its files."""
    path = paths[0]
    mend = {
        ".bag": f"rosbag reindex {path.name}",
        ".mcap": f"mcap recover {path.name} -o mended.mcap",
        ".db3": f"sqlite3 {path.name} .recover | sqlite3 mended.db3",
    }.get(path.suffix, f"ros2 bag reindex {path.name}")
    cause = " ".join(str(fault).split()) or type(fault).__name__
    names = ", ".join(map(str, paths))
    return (
        f"{names}: cannot be read as a ROS bag to its end ({cause}); if its recorder was stopped "
        f"its index is missing, which {mend} writes"
    )


class MessagesByPlace:
    """Messages by their place in the bag's order, walked through forward.

    Safe to be asked by several threads, which ask for neighbours out of order.
    """

    def __init__(
        self, files: BagFiles, topics: Collection[str], times: IntArray, kept: Collection[str]
    ) -> None:
        """Takes what is asked for.

        Args:
            files: the bag.
            topics: all topics that were indexed.
            times: (n,) the bag's times of all their messages, in its order.
            kept: the topics whose messages are asked for.
        """
        self._files, self._topics, self._times = files, topics, times
        self._wanted = kept
        self._lock = threading.Lock()
        self._walk: Iterator[Message] = iter(())
        self._next = len(times)
        self._kept: OrderedDict[int, Message] = OrderedDict()

    def read(self, place: int) -> tuple[Connection, bytes]:
        """Connection and bytes of a message. Raises FrameError where it is damaged."""
        with self._lock:
            if place not in self._kept:
                self._go_to(place)
            if place not in self._kept:
                raise FrameError(
                    f"message {place} in {self._files.paths[0]} is not where the index names it; "
                    "copy the bag again"
                )
            connection, _, raw = self._kept[place]
            return connection, raw

    def _go_to(self, place: int) -> None:
        if not 0 <= place - self._next < _WALKED:
            time = int(self._times[place])
            self._next = int(np.searchsorted(self._times, time))
            self._walk = self._files.messages(self._topics, start=time)
        try:
            while self._next <= place:
                message = next(self._walk)
                if message[0].topic in self._wanted:
                    self._kept[self._next] = message
                self._next += 1
                if len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
        except (StopIteration, DatasetError) as fault:
            self._next = len(self._times)
            raise FrameError(
                f"message {place} in {self._files.paths[0]} cannot be read ({fault}); leave the "
                "frame out with dataset.start/stop/stride"
            ) from None


# --------------------------------------------------------------------------------------------
# Once through the bag


@dataclass(frozen=True, eq=False)
class _Index:
    """What was found on the way through a bag, by topic.

    Attributes:
        topics: all that were read.
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
    infos: dict[str, Info]
    frames: dict[str, str]
    tree: FrameTree
    motions: tuple[FloatArray, FloatArray]
    notes: tuple[str, ...]


def _index_of(files: BagFiles, chosen: Chosen) -> _Index:
    motion = chosen.motion.name if chosen.motion else None
    wanted = (*chosen.views, chosen.left_info, chosen.right_info, motion, *chosen.transforms)
    topics = frozenset(name for name in wanted if name)
    infos: dict[str, Info] = {}
    frames: dict[str, str] = {}
    tree = FrameTree()

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
                if topic not in chosen.views:
                    raise
                return topic, time, files.stamp(raw), None  # one lost frame
            frames.setdefault(topic, messages.frame_of(content))
            if topic in (chosen.left_info, chosen.right_info):
                infos[topic] = messages.calibration_of(content)
            if topic == motion:
                value = messages.motion_of(content)
        return topic, time, files.stamp(raw), value

    rows = files.collect(topics, take)
    names = np.array([row[0] for row in rows])
    times, stamps = (np.array([row[k] for row in rows], np.int64) for k in (1, 2))
    places, by_stamp, notes = {}, {}, []
    for topic in sorted(set(chosen.views)):
        places[topic], by_stamp[topic], note = _in_order(topic, names, times, stamps)
        notes += note
    moved = [(row[2], row[3]) for row in rows if row[0] == motion]
    values = np.array([value for _, value in moved])
    motions = (NANOSECONDS * np.array([stamp for stamp, _ in moved], np.float64), values)
    frames = dict.fromkeys(topics, "") | frames
    return _Index(topics, times, places, by_stamp, infos, frames, tree, motions, tuple(notes))


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


class _Images:
    """Images of a bag by their place."""

    def __init__(self, files: BagFiles, index: _Index, views: Collection[str]) -> None:
        self._files, self._index = files, index
        self._messages = MessagesByPlace(files, index.topics, index.times, views)
        self._bits = 16

    def use_bits(self, places: IntArray) -> tuple[str, ...]:
        """Finds how many bits images of these places hold; what was noticed."""
        count, at = len(places), places.tolist()
        self._bits, notes = bits_held(count, lambda k: self._made(at[k], messages.stored_of))
        return (*notes, *mosaic_note(count, lambda k: self.load(at[k])))

    def load(self, place: int, colour: bool = False) -> Image:
        """An image in grey, or in red, green, blue where it has colour. Raises FrameError."""
        make = messages.colour_of if colour else messages.grey_of
        return self._made(place, partial(make, bits=self._bits))

    def load_depth(self, place: int) -> Depth:
        """Depths in metres. Raises FrameError."""
        return self._made(place, messages.depth_of)

    def rectified(
        self, places: IntArray, rig: StereoRig
    ) -> Callable[[int, bool], tuple[Image, ...]]:
        """What reads the rectified (right, left[, top]) of a frame, at those places (n, 2 or 3)."""
        size = rig.image_size

        def load(index: int, colour: bool) -> tuple[Image, ...]:
            at = places[index].tolist()
            images = (require_size(self.load(k, colour), f"message {k}", *size) for k in at)
            return rig.rectified(tuple(images))

        return load

    def first_size(self, topic: str) -> tuple[int, int]:
        """Width and height of a topic's first readable image. Raises DatasetError without any."""
        fault: FrameError | None = None
        for place in self._index.places[topic].tolist():
            try:
                height, width = self.load(place).shape
            except FrameError as error:
                fault = error
                continue
            return width, height
        raise DatasetError(f"not one image of {topic} can be read: {fault}")

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


# --------------------------------------------------------------------------------------------
# Odometry


def _odometry_source(
    topic: Topic | None,
    recorded: tuple[FloatArray, FloatArray],
    settings: RecordedOdometrySettings,
) -> OdometrySource | None:
    """Body motions by a topic's stamps (n,) in seconds and values; None where there is none."""
    stamps, values = recorded
    if topic is None or len(stamps) == 0:
        return None

    def read() -> OdometrySource:
        order = np.argsort(stamps, kind="stable")  # of equal stamps the first counts
        kept = order[np.concatenate([[True], np.diff(stamps[order]) > 0.0])]
        rows = np.column_stack([stamps, values])[kept]
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(bad):
            raise OdometryError(
                f"{topic.name}, message {kept[bad[0]] + 1}: not finite; record it again, or choose "
                "another odometry.kind"
            )
        names = {messages.ODOMETRY: POSE_COLUMNS, messages.IMU: RATE_COLUMNS}
        table = Table(Path(topic.name), rows, kept + 1, names.get(topic.kind, SPEED_COLUMNS))
        return motions_of(table, settings)

    return recorded_motions(topic.name, read)


# --------------------------------------------------------------------------------------------
# The rig: by camera_info, tf_static or a file, and where it sits on the robot


@dataclass(frozen=True, eq=False)
class Stated:
    """What a bag states of its cameras.

    Attributes:
        infos: by topic of camera_info its first message, as in a file.
        frames: by topic the frame of its first message.
        tree: of tf_static.
        size: width and height of the images.
    """

    infos: dict[str, Info]
    frames: dict[str, str]
    tree: FrameTree
    size: tuple[int, int]


@dataclass(frozen=True, eq=False)
class Placed:
    """A rig, its cameras left and right, the topics with sides as calibrated, what was noticed.

    ``on_body``: the file's body is another thing than a camera, as an IMU, whatever its axes.
    """

    rig: StereoRig
    cameras: tuple[RawCamera, ...]
    chosen: Chosen
    notes: tuple[str, ...] = ()
    on_body: bool = False


def rig_of_bag(settings: BagSettings, stated: Stated, chosen: Chosen) -> Placed:
    """The rig of the topics that are chosen, or of one of them and its depth, on the robot.

    Raises:
        CalibrationError: nothing states where the cameras are, or what does is malformed.
    """
    if chosen.depth:
        found = _rig_of_depth(settings, stated, chosen)
    elif settings.camera_file is not None:
        found = _rig_of_file(settings, Path(settings.camera_file), stated, chosen)
    else:
        found = _rig_of_topics(settings, stated, chosen)
    rig, notes = found.rig, (*found.notes, *found.rig.remarks)
    if settings.camera_yaw_deg is not None or settings.lever_arm_m is not None:
        rig = mounted(rig, settings)
    else:
        rig, reported = _on_robot(found, stated)
        notes = (*notes, *reported)
    return replace(found, rig=rig, notes=notes)


def _rig_of_file(settings: BagSettings, file: Path, stated: Stated, chosen: Chosen) -> Placed:
    numbers = chosen.numbers
    cameras = in_metres(read_calibration_file(file, size=stated.size), settings.unit_m).cameras
    on_body = not any(np.array_equal(camera.bTc, np.eye(4)) for camera in cameras)
    if not numbers and len(cameras) > 3:
        raise CalibrationError(
            f"{file} holds {len(cameras)} cameras, and nothing states which of them {chosen.left} "
            f"and {chosen.right} are; write those two: fgslam camera convert {file.name} "
            "two.yaml --cameras 0,1"
        )
    rig = loaded_rig(settings, file, size=stated.size, cameras=numbers or None, pair=not numbers)
    if numbers:  # the topics on the sides where the calibration sees their cameras
        right, left, *top = (chosen.views[k] for k in rig.sources[: rig.cameras])
        chosen = replace(chosen, views=(left, right, *top))
        cameras = tuple(cameras[k] for k in numbers)
        if rig.rectifier is not None:
            kept = tuple(range(rig.cameras))
            rig = replace(rig, rectifier=replace(rig.rectifier, order=kept))
        order: tuple[int, ...] = (0, 1)
    else:
        rig = numbered(rig) if differ_in_number(chosen.left, chosen.right) else rig
        order = (0, 1) if rig.rectifier is None else rig.rectifier.order
    right_camera, left_camera = (cameras[rig.sources[order.index(k)]] for k in (0, 1))
    return Placed(rig, (left_camera, right_camera), chosen, on_body=on_body)


def _rig_of_depth(settings: BagSettings, stated: Stated, chosen: Chosen) -> Placed:
    """The camera whose depth is recorded, by the file or its camera_info, and one made up."""
    require_one_camera(settings)
    notes = _unregistered(settings, stated, chosen)
    if settings.camera_file is not None:
        camera = camera_of_file(Path(settings.camera_file), stated.size, settings.resized)
        return Placed(depth_rig(camera), (camera, camera), chosen, notes)
    # Registered depth has the colour camera's calibration.
    topic = chosen.right_info or chosen.left_info
    if topic is None:
        raise CalibrationError(
            f"{settings.path}: no camera_info belongs to {chosen.right}; give its calibration by "
            "--camera FILE"
        )
    values = _info_of(settings, stated, topic)
    values = _without_distortion(values) if _is_rectified(chosen.right) else values
    found = read_camera_info(Path(f"{settings.path}:{topic}"), values)
    camera = at_size(found, stated.size, settings.resized).cameras[0]
    return Placed(depth_rig(camera), (camera, camera), chosen, notes)


def _unregistered(settings: BagSettings, stated: Stated, chosen: Chosen) -> tuple[str, ...]:
    """A note where depth may not be registered. Raises CalibrationError: it was not chosen."""
    colour, depth = (stated.frames[topic] for topic in (chosen.right, chosen.left))
    # RealSense's viewer may have recorded two sensors, whose views differ.
    sensors = [match[1] for name in chosen.views if (match := SENSOR.match(name))]
    if len(set(sensors)) == 2:
        text = f"{chosen.left} and {chosen.right} are of two sensors"
    elif not colour or not depth or colour == depth or is_registered(chosen.left):
        return ()
    else:
        text = f"{chosen.left} is in the frame {depth}, {chosen.right} in {colour}"
    if settings.topics:
        return (f"{text}: it is taken as registered to colour, as it was chosen by --topics",)
    raise CalibrationError(
        f"{settings.path}: {text}: depth must be registered to colour; record the driver's aligned "
        "or registered depth, or choose: --topics COLOUR,DEPTH"
    )


# By camera_info, and by tf_static where that has no baseline


def _rig_of_topics(settings: BagSettings, stated: Stated, chosen: Chosen) -> Placed:
    topics = (chosen.left_info, chosen.right_info)
    lacking = [
        view
        for view, topic in zip(chosen.views, topics, strict=False)
        if topic is None or topic not in stated.infos
    ]
    if lacking:
        raise CalibrationError(
            f"{settings.path}: no camera_info belongs to {' and '.join(lacking)}, and one camera's "
            "states nothing of the other; give the calibration of both by --camera FILE"
        )
    left, right = (_info_of(settings, stated, str(topic)) for topic in topics)
    if all(_is_rectified(topic) for topic in (chosen.left, chosen.right)):
        left, right = _without_distortion(left), _without_distortion(right)
    named = (Path(f"{settings.path}:{topics[0]}"), Path(f"{settings.path}:{topics[1]}"))
    # -fx times the baseline, of the right camera; 0 where none is stated.
    shift_left, shift_right = (info["projection_matrix"]["data"][3] for info in (left, right))
    if not shift_left and not shift_right:
        return _rig_by_tree(settings, named, (left, right), stated, chosen)
    notes: tuple[str, ...] = ()
    if shift_left < 0.0 <= shift_right:
        notes = (f"by their camera_info {chosen.left} is the right camera, and is taken so",)
        left, right, named = right, left, (named[1], named[0])
        chosen = replace(
            chosen,
            views=(chosen.right, chosen.left),
            left_info=chosen.right_info,
            right_info=chosen.left_info,
        )
    found = read_camera_info_pair(named, (left, right))
    cameras = in_metres(found, settings.unit_m).cameras
    return Placed(read_rig(settings, found, stated.size), cameras, chosen, notes)


def _rig_by_tree(
    settings: BagSettings,
    named: tuple[Path, Path],
    infos: tuple[Info, Info],
    stated: Stated,
    chosen: Chosen,
) -> Placed:
    """Each camera by its own camera_info, their places by the transforms of their frames."""
    left, right = (stated.frames[topic] for topic in (chosen.left, chosen.right))
    try:
        if left == right:
            raise CalibrationError(f"both cameras have the frame {left or 'without a name'}")
        fTc, reported = view_axes(stated.tree, left, right, "")
        apart = inverse(fTc) @ stated.tree.pose(left, right) @ fTc
    except CalibrationError as fault:
        raise CalibrationError(
            f"{named[0]} and {named[1].name}: projection_matrix states no baseline, and {fault}; "
            "give the calibration of both by --camera FILE"
        ) from None
    cameras = [
        replace(read_camera_info(file, info).cameras[0], name=str(topic), bTc=place)
        for file, info, topic, place in zip(
            named, infos, (chosen.left, chosen.right), (apart, np.eye(4)), strict=True
        )
    ]
    source, form = f"{named[0]} and {named[1].name}", "camera_info with tf_static"
    pair = Calibration(source, form, tuple(cameras), sided=True)
    # A unit is that of camera_info; transforms are in metres (REP 103).
    rig = read_rig(replace(settings, unit_m=1.0), pair, stated.size)
    note = f"camera_info has no baseline: by tf_static {right} is {rig.baseline:.4g} m from {left}"
    if unlikely := implausible(source, rig.plain()):  # --unit, which that names, is another's
        note += ", which no rig has: tf_static is in metres; give the calibration by --camera FILE"
        rig = replace(rig, remarks=tuple(text for text in rig.remarks if text not in unlikely))
    return Placed(rig, pair.cameras, chosen, (note, *filter(None, [reported])))


def _info_of(settings: BagSettings, stated: Stated, topic: str) -> Info:
    """The camera_info of images as they were sent: cropped and binned as it states.

    Raises:
        CalibrationError: its numbers are 0.
    """
    info = stated.infos[topic]
    if not info["camera_matrix"]["data"][0]:
        raise CalibrationError(
            f"{settings.path}: {topic} is of a camera that is not calibrated (its numbers are 0); "
            "calibrate it, and give the calibration of all cameras by --camera FILE"
        )
    (across, down), (x, y, width, height) = info["binning"], info["roi"]
    full = (width or info["image_width"], height or info["image_height"])
    size = stated.size
    if size == (info["image_width"], info["image_height"]):
        return info
    if size != (full[0] // across, full[1] // down):
        return info
    sent = np.array(
        [
            [1.0 / across, 0.0, (0.5 - x) / across - 0.5],
            [0.0, 1.0 / down, (0.5 - y) / down - 0.5],
            [0.0, 0.0, 1.0],
        ]
    )
    matrices = {
        name: {"data": (sent @ np.reshape(info[name]["data"], (3, -1))).ravel().tolist()}
        for name in ("camera_matrix", "projection_matrix")
    }
    return {**info, **matrices, "image_width": size[0], "image_height": size[1]}


def _is_rectified(topic: str) -> bool:
    return "rect" in topic.removesuffix(TRANSPORT).rpartition("/")[2].split("_")


def _without_distortion(values: Info) -> Info:
    """The camera_info of the image that image_proc has rectified by it."""
    p = values["projection_matrix"]["data"]
    return {
        **values,
        "distortion_model": "plumb_bob",
        "camera_matrix": {"data": [*p[0:3], *p[4:7], *p[8:11]]},
        "distortion_coefficients": {"data": [0.0] * 5},
        "rectification_matrix": {"data": np.eye(3).ravel().tolist()},
    }


# On the robot


_BODIES = ("base_link", "base_footprint")
"""The robot itself, where odometry does not name its frame (REP 105)."""


def _on_robot(found: Placed, stated: Stated) -> tuple[StereoRig, tuple[str, ...]]:
    """The rig in the frame whose motion the odometry is, and how that was known."""
    motion, tree = found.chosen.motion, stated.tree
    if motion is None:
        return found.rig, ()
    left, right = (stated.frames[topic] for topic in (found.chosen.left, found.chosen.right))
    robot = next((body for body in _BODIES if body in tree.frames), "")
    body = stated.frames[motion.name] or robot
    # Where both have one frame it is the left camera's (CameraInfo.msg, P).
    camera, frame = (0, left) if left == right else (1, right)
    try:
        bTf = tree.pose(frame, body)
    except CalibrationError as fault:
        return _unconnected(found, tree, body, f" ({fault})" if tree else "")
    fTc, reported = view_axes(tree, left, right, body)
    bTc = bTf @ fTc @ inverse(found.cameras[camera].bTc) @ found.rig.bTc
    x, y, z = (round(float(v), 3) + 0.0 for v in bTc[:3, 3])
    note = (
        f"by tf_static the right camera is {x:g}, {y:g}, {z:g} m (x, y, z) from {body}, whose "
        f"motion {motion.name} is"
    )
    return replace(found.rig, bTc=bTc), (*tree.notes, note, *filter(None, [reported]))


def _unconnected(
    found: Placed, tree: FrameTree, body: str, reason: str
) -> tuple[StereoRig, tuple[str, ...]]:
    """The same where no transform leads to the camera: as calibrated, else by its frame's axes."""
    if found.on_body or not body_is_camera(found.rig.bTc):
        return found.rig, ()
    if "optical" in body:  # axes of a camera (REP 103), as RealSense's gyroscope has
        reported = f"{body} has a camera's axes, and is taken as turned like the camera{reason}"
        return found.rig, (*tree.notes, reported)
    unknown = "nothing states where the camera sits on the robot whose odometry is used"
    ahead = replace(found.rig, bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA)
    return ahead, (*tree.notes, f"{unknown}{reason}: {LOOKS_AHEAD}")
