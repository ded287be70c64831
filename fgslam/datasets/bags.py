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
from rosbags.rosbag2 import ReaderError as ReaderError2, storage_mcap, storage_sqlite3
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore

from fgslam.cameras.formats import read_camera_info, read_camera_info_pair
from fgslam.cameras.lenses import Calibration, RawCamera
from fgslam.cameras.rig import StereoRig, at_size, implausible, in_metres, read_calibration_file
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import CalibrationError, DatasetError, FrameError, OdometryError
from fgslam.core.files import shown_in
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, inverse
from fgslam.core.sensors import CAMERA_NAMES, body_is_camera
from fgslam.core.sides import differ_in_number
from fgslam.datasets import bag_messages as messages
from fgslam.datasets.bag_messages import FrameTree, view_axes
from fgslam.datasets.bag_topics import (
    SENSOR,
    TRANSPORT,
    Chosen,
    Topic,
    choose_topics,
    is_registered,
)
from fgslam.datasets.depth import (
    DEPTH_SIGMA_M,
    MILLIMETRES,
    camera_of_file,
    depth_images,
    depth_rig,
    depth_sigma_px,
    depth_unit,
    require_one_camera,
    sample_depths,
)
from fgslam.datasets.images import (
    LEAVE_OUT,
    Depth,
    bits_held,
    both_views,
    images_of_cameras,
    mosaic_note,
    readable,
    require_size,
)
from fgslam.datasets.layouts import files_of, is_bag, is_packed_bag
from fgslam.datasets.ledger import IMAGES, TIMES, Entry
from fgslam.datasets.odometry import (
    POSE_COLUMNS,
    RATE_COLUMNS,
    SPEED_COLUMNS,
    OdometrySource,
    motions_of,
    recorded_motions,
)
from fgslam.datasets.recording import (
    Recording,
    image_recording,
    in_order,
    loaded_rig,
    looks_ahead,
    mounted,
    numbered,
    read_rig,
    rig_of_views,
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
    bag = Bag(paths_of(where))
    chosen = choose_topics(bag.topics, settings, bag.first_frame)
    bag.index(chosen)
    whole = bag.size
    placed = _rig_of_views(settings, bag, chosen)
    rig, chosen = placed.rig, placed.chosen
    views = (chosen.right, chosen.left, *chosen.views[2:])
    right_side, *sides = ("colour", "depth") if chosen.depth else CAMERA_NAMES
    others = [(s, view, bag.stamps[view]) for s, view in zip(sides, views[1:], strict=False)]
    stamps = bag.stamps[chosen.right]
    rows, unpaired, pairing = pair_stamps(stamps, others, chosen.right, right_side)
    places = np.column_stack([bag.places[v][rows[:, k]] for k, v in enumerate(views)])
    right, size = places[:, 0].tolist(), rig.image_size
    more: dict[str, Any] = {"truth_frame": "left"}
    ledger = [placed.mounting] if placed.mounting else []
    bits, held = bits_held(len(right), lambda k: bag.read(right[k], messages.stored_of))
    bag.bits = bits
    held += mosaic_note(len(right), lambda k: bag.image(right[k]))

    def image(place: int, colour: bool) -> Image:
        return require_size(bag.image(place, colour), f"message {place}", *size)

    if chosen.depth:

        def read(index: int) -> tuple[Image, Depth, str]:
            colour, depth = places[index].tolist()
            metres = bag.read(depth, messages.depth_of).astype(np.float32) / np.float32(scale)
            return image(colour, True), metres, f"message {depth}"

        seen, of_integers = sample_depths(
            where, len(places), lambda k: bag.read(int(places[k, 1]), messages.depth_of), size
        )
        stated = settings.depth_scale or bag.depth_scale(chosen.unit)
        if stated is None and of_integers and not SENSOR.match(chosen.left):
            stated = MILLIMETRES  # REP 118
        scale, reported, unit = depth_unit(where, seen, of_integers, stated)
        placed = replace(placed, notes=(*placed.notes, *reported))
        ledger.append(unit)
        load, more["load_depth"] = depth_images(read, rig, placed.cameras[1])
        more["disparity_sigma_px"] = depth_sigma_px(settings.scale * rig.fx, DEPTH_SIGMA_M)
        more["truth_frame"] = "right"  # the colour camera's
    else:

        def load(index: int, colour: bool) -> tuple[Image, ...]:
            if chosen.left == chosen.right:
                place = int(places[index, 0])
                shown = require_size(bag.image(place, colour), f"message {place}", *whole)
                return rig.rectified(both_views(shown, size))
            return images_of_cameras(
                lambda place: image(place, colour), places[index].tolist(), rig
            )

    shown = f"{chosen.left} is {'depth' if chosen.depth else 'left'}, {chosen.right} right"
    how = "--topics" if settings.topics else "types and names of topics"
    topics = Entry(IMAGES, shown, how, "--topics", chosen.guessed)
    return image_recording(
        settings,
        where.resolve().stem,
        replace(rig, remarks=()),
        NANOSECONDS * stamps[rows[:, 0]].astype(np.float64),
        load,
        ([], [file for path in bag.paths for file in _bag_files(path)]),
        (*bag.notes, *chosen.notes, *bag.stamp_notes, *unpaired, *held, *placed.notes),
        (topics, pairing, Entry(TIMES, "stamps", "headers of the messages"), *ledger),
        odometry_source=_odometry_source(chosen.motion, *bag.motions, odometry),
        **more,
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


def paths_of(given: Path) -> list[Path]:
    """What is opened: a folder that is one ROS 2 bag, or all files of a folder or pattern."""
    folder = given.parent if is_packed_bag(given) else given
    if (folder / "metadata.yaml").is_file():
        return [folder]
    found = _bag_files(given) if given.is_dir() else files_of(given)
    if packed := next(filter(is_packed_bag, found), None):
        raise DatasetError(
            f"{packed} is packed, without a metadata.yaml; unpack it: zstd -d {packed.name}"
        )
    return found


def _bag_files(path: Path) -> list[Path]:
    """The files of a folder that are bags, or the file itself."""
    if not path.is_dir():
        return [path]
    return [file for file in shown_in(path) if is_bag(file) and file.is_file()]


class Bag:
    """The files of one recording as one; a damaged one is read up to the damage.

    Images may be asked for by several threads, which ask for neighbours out of order.

    Attributes:
        paths: the files, or the folder of a ROS 2 bag.
        topics: in the order of their names.
        notes: whether a part cannot be read.
        bits: that pixels of 16 bits hold.
        places, stamps: (k,) of each image topic's messages among all, and their increasing stamps
            in nanoseconds; they and what follows once the bag is indexed.
        size: width and height of the right images.
        infos: the first camera_info of each camera, as in a file.
        frames: the frame of each topic's first message.
        tree: of tf_static.
        motions: stamps (n,) in seconds and values of the odometry.
        stamp_notes: which stamps could not be used.
    """

    size: tuple[int, int]
    motions: tuple[FloatArray, FloatArray]

    def __init__(self, paths: list[Path]) -> None:
        """Opens the files. Raises DatasetError where one of them is no bag, or has no index."""
        self.paths, self.bits = paths, 16
        self.notes: tuple[str, ...] = ()
        self.stamp_notes: list[str] = []
        self.places: dict[str, IntArray] = {}
        self.stamps: dict[str, IntArray] = {}
        self.infos: dict[str, Info] = {}
        self.frames: dict[str, str] = {}
        self.tree = FrameTree()
        try:
            self._reader = AnyReader(paths, default_typestore=get_typestore(Stores.LATEST))
            self._reader.open()
        except DAMAGED as fault:
            raise DatasetError(self._unreadable(fault)) from None
        counts: dict[tuple[str, str], int] = {}
        for each in self._reader.connections:
            key = (each.topic, each.msgtype)
            if None not in key:  # a damaged table of topics
                counts[key] = counts.get(key, 0) + each.msgcount
        self.topics = tuple(Topic(*key, count) for key, count in sorted(counts.items()))
        self._lock = threading.Lock()
        self._times: IntArray = np.empty(0, np.int64)  # of all messages that were indexed
        self._indexed: Collection[str] = ()
        self._views: Collection[str] = ()
        self._walk: Iterator[Message] = iter(())
        self._next = 0
        self._kept: OrderedDict[int, Message] = OrderedDict()

    def _unreadable(self, fault: Exception) -> str:
        """What is wrong with the bag, and the command that mends the first of its files."""
        path = self.paths[0]
        mend = {
            ".bag": f"rosbag reindex {path.name}",
            ".mcap": f"mcap recover {path.name} -o mended.mcap",
            ".db3": f"sqlite3 {path.name} .recover | sqlite3 mended.db3",
        }.get(path.suffix, f"ros2 bag reindex {path.name}")
        cause = " ".join(str(fault).split()) or type(fault).__name__
        return (
            f"{', '.join(map(str, self.paths))}: cannot be read as a ROS bag to its end ({cause}); "
            f"if its recorder was stopped its index is missing, which {mend} writes"
        )

    def _messages(self, topics: Collection[str], start: int | None = None) -> Iterator[Message]:
        """Messages of these topics in order of the bag's time. Raises DatasetError at damage."""
        wanted = [each for each in self._reader.connections if each.topic in topics]
        if wanted:
            try:
                yield from self._reader.messages(wanted, start=start)
            except DAMAGED as fault:
                raise DatasetError(self._unreadable(fault)) from None

    def _decoded(self, connection: Connection, raw: bytes, make: Callable[[Any], T]) -> T:
        """What ``make`` makes of the message. Raises FrameError where it is damaged or another."""
        where = f"a message of {connection.topic} in {self.paths[0]}"
        try:
            message = self._reader.deserialize(raw, connection.msgtype)
        except DAMAGED as fault:
            raise FrameError(f"{where} cannot be decoded ({fault}); {LEAVE_OUT}") from None
        try:
            return make(message)
        except AttributeError as fault:  # the bag's own definition of the type is not ROS's
            text = f"{where} is without a field of its type ({fault}); copy the bag again"
            raise FrameError(text) from None

    def first_frame(self, topic: Topic) -> str:
        """The frame in which a topic's first message is stated; empty where it cannot be read."""
        try:
            connection, _, raw = next(self._messages((topic.name,)))
            return self._decoded(connection, raw, lambda message: str(message.header.frame_id))
        except (StopIteration, FrameError, DatasetError):
            return ""

    def decoded(self, topic: str) -> Iterator[Any]:
        """Every message of a topic. Raises DatasetError at damage, FrameError of a message."""
        for connection, _, raw in self._messages((topic,)):
            yield self._decoded(connection, raw, lambda message: message)

    def depth_scale(self, topic: str) -> float | None:
        """Units of depth in a metre by the topic that states metres a unit; None where none does.

        Raises:
            DatasetError: the topic cannot be read.
        """
        if not topic:
            return None
        connection, _, raw = next(self._messages((topic,)))
        metres = self._decoded(connection, raw, lambda message: float(message.data))
        return round(1.0 / metres, 3) if metres > 0.0 else None

    def index(self, chosen: Chosen) -> None:
        """Once through the whole bag, for all but the images. Raises DatasetError as it opens."""
        motion = chosen.motion.name if chosen.motion else ""
        names = (*chosen.views, *chosen.infos, motion, *chosen.transforms)
        topics = frozenset(name for name in names if name)
        moved = []
        rows: list[tuple[str, int, int]] = []  # topic, the bag's time, stamp
        try:
            for connection, time, raw in self._messages(topics):
                topic, stamp = connection.topic, time
                if topic in chosen.transforms:
                    transforms = self._decoded(connection, raw, messages.transforms_of)
                    self.tree.add(transforms, static=topic.endswith("tf_static"))
                else:
                    # The header is a message's first field. ROS 1: sequence number, seconds,
                    # nanoseconds; ROS 2: encapsulation, seconds, nanoseconds.
                    big = self._reader.is2 and raw[1] == 0
                    seconds, rest = (
                        int.from_bytes(raw[k : k + 4], "big" if big else "little") for k in (4, 8)
                    )
                    stamp = 1_000_000_000 * seconds + rest
                if topic == motion or topic not in (*self.frames, *chosen.transforms):
                    decoded = partial(self._decoded, connection, raw)
                    try:
                        if topic not in self.frames:
                            self.frames[topic] = decoded(messages.frame_of)
                        if topic in chosen.infos:
                            self.infos[topic] = decoded(messages.calibration_of)
                        if topic == motion:
                            moved.append((stamp, decoded(messages.motion_of)))
                    except FrameError:
                        if topic not in chosen.views:  # else one lost frame
                            raise
                rows.append((topic, time, stamp))
        except DatasetError as fault:
            if not rows:
                raise
            self.notes = (f"{fault}; the {len(rows)} messages before the damage are used",)
        self._indexed, self._views = topics, chosen.views
        self._times, stamps = (np.array([row[k] for row in rows], np.int64) for k in (1, 2))
        self._next = len(rows)
        of_topic = np.array([row[0] for row in rows])
        for topic in sorted(set(chosen.views)):
            at = np.flatnonzero(of_topic == topic)
            if len(at) == 0:
                why = "; ".join([f"no message of {topic} can be read", *self.notes])
                raise DatasetError(f"{why}; record the bag again")
            own = stamps[at]
            if len(at) > 1 and (own == own[0]).all():
                own = self._times[at]
                self.stamp_notes.append(
                    f"{topic}: its headers have no time stamps, the bag's own times are used"
                )
            self.stamps[topic], first = np.unique(own, return_index=True)
            self.places[topic] = at[first]
            if repeated := len(at) - len(first):
                self.stamp_notes.append(
                    f"{topic}: {repeated} images repeat a stamp and are left out"
                )
        self.motions = (
            NANOSECONDS * np.array([stamp for stamp, _ in moved], np.float64),
            np.array([value for _, value in moved]),
        )
        self.frames = dict.fromkeys(topics, "") | self.frames
        self.size = self._first_size(chosen.right)

    def _first_size(self, topic: str) -> tuple[int, int]:
        faults: list[FrameError] = []
        found = readable(lambda place: self.image(place).shape, self.places[topic].tolist(), faults)
        for height, width in found:
            return width, height
        raise DatasetError(f"not one image of {topic} can be read: {faults[-1]}")

    def image(self, place: int, colour: bool = False) -> Image:
        """An image in grey, or in red, green, blue where it has colour. Raises FrameError."""
        return self.read(
            place, lambda message, where: messages.image_of(message, where, self.bits, colour)
        )

    def read(self, place: int, make: Callable[[Any, str], T]) -> T:
        """What ``make`` makes of a message by its place among all, and of its name in messages.

        Raises:
            FrameError: it is damaged.
        """
        with self._lock:
            if place not in self._kept:
                self._go_to(place)
            if place not in self._kept:
                raise FrameError(
                    f"message {place} in {self.paths[0]} is not at its index; copy the bag again"
                )
            connection, _, raw = self._kept[place]
        where = f"{self.paths[0]}, {connection.topic}"
        return self._decoded(connection, raw, lambda message: make(message, where))

    def _go_to(self, place: int) -> None:
        """Walks forward to a message; those of images that are passed are kept for a while."""
        if not 0 <= place - self._next < _WALKED:
            time = int(self._times[place])
            self._next = int(np.searchsorted(self._times, time))
            self._walk = self._messages(self._indexed, start=time)
        try:
            while self._next <= place:
                message = next(self._walk)
                if message[0].topic in self._views:
                    self._kept[self._next] = message
                self._next += 1
                if len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
        except (StopIteration, DatasetError) as fault:
            self._next = len(self._times)
            raise FrameError(
                f"message {place} in {self.paths[0]} cannot be read ({fault}); {LEAVE_OUT}"
            ) from None


def _odometry_source(
    topic: Topic | None, stamps: FloatArray, values: FloatArray, settings: RecordedOdometrySettings
) -> OdometrySource | None:
    """Body motions by a topic's stamps (n,) in seconds and values; None where there is none."""
    if topic is None or len(stamps) == 0:
        return None

    def read() -> OdometrySource:
        _, kept = np.unique(stamps, return_index=True)  # of equal stamps the first counts
        rows = np.column_stack([stamps, values])[kept]
        bad = np.flatnonzero(~np.isfinite(rows).all(axis=1))
        if len(bad):
            raise OdometryError(
                f"{topic.name}, message {kept[bad[0]] + 1}: not finite; set another odometry.kind"
            )
        names = {messages.ODOMETRY: POSE_COLUMNS, messages.IMU: RATE_COLUMNS}
        table = Table(Path(topic.name), rows, kept + 1, names.get(topic.kind, SPEED_COLUMNS))
        return motions_of(table, settings)

    return recorded_motions(read)


# --------------------------------------------------------------------------------------------
# The rig: by camera_info, tf_static or a file, and where it sits on the robot


@dataclass(frozen=True, eq=False)
class Placed:
    """A rig, its cameras left and right, the topics with sides as calibrated, what was noticed.

    ``on_body``: the file's body is another thing than a camera, as an IMU, whatever its axes.
    ``mounting``: what is guessed of its place on the body whose odometry is used.
    """

    rig: StereoRig
    cameras: tuple[RawCamera, ...]
    chosen: Chosen
    notes: tuple[str, ...] = ()
    on_body: bool = False
    mounting: Entry | None = None


def _rig_of_views(settings: BagSettings, bag: Bag, chosen: Chosen) -> Placed:
    """As :func:`rig_of_bag`; of one topic whose images show both views, of these.

    Raises:
        CalibrationError: as there, or the calibration is of no part of the images.
    """
    if chosen.depth or chosen.left != chosen.right:
        return rig_of_bag(settings, bag, chosen)

    def of_size(size: tuple[int, int], _: object) -> Placed:
        bag.size = size
        return rig_of_bag(settings, bag, chosen)

    placed, name = rig_of_views(bag.size, of_size)
    note = f"each image of {chosen.right} is taken as both views, {name}"
    return replace(placed, notes=(note, *placed.notes))


def rig_of_bag(settings: BagSettings, bag: Bag, chosen: Chosen) -> Placed:
    """The rig of the topics that are chosen, or of one of them and its depth, on the robot.

    Raises:
        CalibrationError: nothing states where the cameras are, or what does is malformed.
    """
    try:
        if chosen.depth:
            placed = _rig_of_depth(settings, bag, chosen)
        elif settings.camera_file is not None:
            placed = _rig_of_file(settings, Path(settings.camera_file), bag, chosen)
        else:
            placed = _rig_of_topics(settings, bag, chosen)
    except CalibrationError as fault:
        if settings.camera_file is not None:
            raise
        text = str(fault).removesuffix("; correct the file")
        raise CalibrationError(f"{text}; give the calibration by --camera FILE") from None
    if settings.camera_yaw_deg is not None or settings.lever_arm_m is not None:
        rig, notes = mounted(placed.rig, settings), placed.rig.remarks
    else:
        rig, reported, mounting = _on_robot(placed, bag)
        placed = replace(placed, mounting=mounting)
        notes = (*placed.rig.remarks, *reported)
    return replace(placed, rig=rig, notes=(*placed.notes, *notes))


def _rig_of_file(settings: BagSettings, file: Path, bag: Bag, chosen: Chosen) -> Placed:
    numbers = chosen.numbers
    cameras = in_metres(read_calibration_file(file, size=bag.size), settings.unit_m).cameras
    on_body = not any(np.array_equal(camera.bTc, np.eye(4)) for camera in cameras)
    if not numbers and len(cameras) > 3:
        raise CalibrationError(
            f"{file} holds {len(cameras)} cameras, and nothing states which of them {chosen.left} "
            f"and {chosen.right} are; write those two: fgslam camera convert {file.name} "
            "two.yaml --cameras 0,1"
        )
    rig = loaded_rig(settings, file, size=bag.size, cameras=numbers or None, pair=not numbers)
    order: tuple[int, ...] = (0, 1)
    if numbers:  # the topics on the sides where the calibration sees their cameras
        right, left, *top = (chosen.views[k] for k in rig.sources[: rig.cameras])
        chosen = replace(chosen, views=(left, right, *top))
        cameras = tuple(cameras[k] for k in numbers)
        rig = in_order(rig)
    else:
        rig = numbered(rig) if differ_in_number(chosen.left, chosen.right) else rig
        order = order if rig.rectifier is None else rig.rectifier.order
    right_camera, left_camera = (cameras[rig.sources[order.index(k)]] for k in (0, 1))
    return Placed(rig, (left_camera, right_camera), chosen, on_body=on_body)


def _rig_of_depth(settings: BagSettings, bag: Bag, chosen: Chosen) -> Placed:
    """The camera whose depth is recorded, by the file or its camera_info, and one made up."""
    require_one_camera(settings)
    colour, depth = (bag.frames[topic] for topic in (chosen.right, chosen.left))
    sensors = {match[1] for name in chosen.views if (match := SENSOR.match(name))}
    text = ""
    if len(sensors) == 2:  # RealSense's viewer may have recorded two, whose views differ
        text = f"{chosen.left} and {chosen.right} are of two sensors"
    elif colour and depth and colour != depth and not is_registered(chosen.left):
        text = f"{chosen.left} is in the frame {depth}, {chosen.right} in {colour}"
    if text and not settings.topics:
        raise DatasetError(
            f"{settings.path}: {text}: depth must be registered to colour; record the driver's "
            "aligned or registered depth, or choose: --topics COLOUR,DEPTH"
        )
    taken = f"{text}: it is taken as registered to colour, as it was chosen by --topics"
    if settings.camera_file is not None:
        view = chosen.right.removesuffix(TRANSPORT)
        camera = camera_of_file(settings, Path(settings.camera_file), bag.size, view)
    else:
        # Registered depth has the colour camera's calibration.
        topic = chosen.infos[1] or chosen.infos[0]
        if topic is None:
            raise CalibrationError(f"{settings.path}: no camera_info of {chosen.right}")
        values = _info_of(settings, bag, topic, _is_rectified(chosen.right))
        read = read_camera_info(Path(f"{settings.path}:{topic}"), values)
        camera = at_size(read, bag.size, settings.resized).cameras[0]
    return Placed(depth_rig(camera), (camera, camera), chosen, (taken,) if text else ())


def _rig_of_topics(settings: BagSettings, bag: Bag, chosen: Chosen) -> Placed:
    """By camera_info, and by tf_static where that has no baseline."""
    lacking = [
        view
        for view, topic in zip(chosen.views, chosen.infos, strict=False)
        if topic not in bag.infos
    ]
    if lacking:
        raise CalibrationError(
            f"{settings.path}: no camera_info belongs to {' and '.join(lacking)}, and one camera's "
            "states nothing of the other"
        )
    topics = [str(topic) for topic in chosen.infos]
    rectified = _is_rectified(chosen.left) and _is_rectified(chosen.right)
    left, right = (_info_of(settings, bag, topic, rectified) for topic in topics)
    named = (Path(f"{settings.path}:{topics[0]}"), Path(f"{settings.path}:{topics[1]}"))
    # -fx times the baseline, of the right camera; 0 where none is stated.
    shift_left, shift_right = (info["projection_matrix"]["data"][3] for info in (left, right))
    if not shift_left and not shift_right:
        return _rig_by_tree(settings, named, (left, right), bag, chosen)
    notes: tuple[str, ...] = ()
    if shift_left < 0.0 <= shift_right:
        notes = (f"by their camera_info {chosen.left} is the right camera, and is taken so",)
        left, right, named = right, left, (named[1], named[0])
        chosen = replace(chosen, views=(chosen.right, chosen.left))
    pair = read_camera_info_pair(named, (left, right))
    cameras = in_metres(pair, settings.unit_m).cameras
    return Placed(read_rig(settings, pair, bag.size), cameras, chosen, notes)


def _rig_by_tree(
    settings: BagSettings,
    named: tuple[Path, Path],
    infos: tuple[Info, Info],
    bag: Bag,
    chosen: Chosen,
) -> Placed:
    """Each camera by its own camera_info, their places by the transforms of their frames."""
    left, right = (bag.frames[topic] for topic in (chosen.left, chosen.right))
    source = f"{named[0]} and {named[1].name}"
    try:
        if left == right:
            raise CalibrationError(f"both cameras have the frame {left or 'without a name'}")
        fTc, reported = view_axes(bag.tree, left, right, "")
        apart = inverse(fTc) @ bag.tree.pose(left, right) @ fTc
    except CalibrationError as fault:
        text = f"{source}: projection_matrix has no baseline, and {fault}"
        raise CalibrationError(text) from None
    cameras = tuple(
        replace(read_camera_info(file, info).cameras[0], name=str(topic), bTc=place)
        for file, info, topic, place in zip(
            named, infos, (chosen.left, chosen.right), (apart, np.eye(4)), strict=True
        )
    )
    pair = Calibration(source, "camera_info with tf_static", cameras, sided=True)
    # A unit is that of camera_info; transforms are in metres (REP 103).
    rig = read_rig(replace(settings, unit_m=1.0), pair, bag.size)
    note = f"camera_info has no baseline: by tf_static {right} is {rig.baseline:.4g} m from {left}"
    if unlikely := implausible(source, rig.plain()):  # --unit, which that names, is another's
        note += ", which no rig has: tf_static is in metres; give the calibration by --camera FILE"
        rig = replace(rig, remarks=tuple(text for text in rig.remarks if text not in unlikely))
    return Placed(rig, cameras, chosen, (note, *filter(None, [reported])))


def _info_of(settings: BagSettings, bag: Bag, topic: str, rectified: bool) -> Info:
    """The camera_info of images as they were sent: cropped and binned as it states.

    Of ``rectified`` images it is that of the view which image_proc has made by it.

    Raises:
        CalibrationError: its numbers are 0.
    """
    info = bag.infos[topic]
    k, p, d = (
        info[name]["data"]
        for name in ("camera_matrix", "projection_matrix", "distortion_coefficients")
    )
    if not k[0] and (not p[0] or (any(d) and not rectified)):
        raise CalibrationError(
            f"{settings.path}: {topic} is of a camera that is not calibrated (its numbers are 0)"
        )
    (across, down), (x, y, width, height) = info["binning"], info["roi"]
    whole = (info["image_width"], info["image_height"])
    sent = ((width or whole[0]) // across, (height or whole[1]) // down)
    if bag.size == sent != whole:
        part = np.diag([1.0 / across, 1.0 / down, 1.0])
        part[:2, 2] = (0.5 - x) / across - 0.5, (0.5 - y) / down - 0.5
        matrices = {
            name: {"data": (part @ np.reshape(info[name]["data"], (3, -1))).ravel().tolist()}
            for name in ("camera_matrix", "projection_matrix")
        }
        info = {**info, **matrices, "image_width": sent[0], "image_height": sent[1]}
    if not rectified:
        return info
    p, k = (info[name]["data"] for name in ("projection_matrix", "camera_matrix"))
    return {
        **info,
        "distortion_model": "plumb_bob",
        "camera_matrix": {"data": [*p[0:3], *p[4:7], *p[8:11]] if p[0] else k},
        "distortion_coefficients": {"data": [0.0] * 5},
        "rectification_matrix": {"data": np.eye(3).ravel().tolist()},
    }


def _is_rectified(topic: str) -> bool:
    return "rect" in topic.removesuffix(TRANSPORT).rpartition("/")[2].split("_")


_BODIES = ("base_link", "base_footprint")
"""The robot itself, where odometry does not name its frame (REP 105)."""


def _on_robot(placed: Placed, bag: Bag) -> tuple[StereoRig, tuple[str, ...], Entry | None]:
    """The rig in the frame whose motion the odometry is, how that was known, and what is guessed.

    Where no transform leads to the camera: as calibrated, else by its frame's axes.
    """
    rig, chosen, tree = placed.rig, placed.chosen, bag.tree
    if chosen.motion is None:
        return rig, (), None
    left, right = (bag.frames[topic] for topic in (chosen.left, chosen.right))
    robot = next((body for body in _BODIES if body in tree.frames), "")
    body = bag.frames[chosen.motion.name] or robot
    # Where both have one frame it is the left camera's (CameraInfo.msg, P).
    camera, frame = (0, left) if left == right else (1, right)
    try:
        bTf = tree.pose(frame, body)
    except CalibrationError as fault:
        reason = f" ({fault})" if tree.frames else ""
        if placed.on_body or not body_is_camera(rig.bTc):
            return rig, (), None
        if "optical" in body:  # axes of a camera (REP 103), as RealSense's gyroscope has
            text = f"{body} has a camera's axes, and is taken as turned like the camera{reason}"
            return rig, (text,), None
        guess = looks_ahead(f"the robot whose odometry is used{reason}")
        return replace(rig, bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA), (guess.source,), guess
    fTc, reported = view_axes(tree, left, right, body)
    bTc = bTf @ fTc @ inverse(placed.cameras[camera].bTc) @ rig.bTc
    x, y, z = (round(float(v), 3) + 0.0 for v in bTc[:3, 3])
    note = (
        f"by tf_static the right camera is {x:g}, {y:g}, {z:g} m (x, y, z) from {body}, whose "
        f"motion {chosen.motion.name} is"
    )
    return replace(rig, bTc=bTc), (note, *filter(None, [reported])), None
