"""The files of a bag, whole or cut off: which topics, their messages in order, one again by place.

Nothing but places and stamps is held in memory.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rosbags.highlevel import AnyReader, AnyReaderError
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader as Reader2
from rosbags.typesys import Stores, get_typestore

from fgslam.core.arrays import IntArray
from fgslam.core.errors import DatasetError, FrameError
from fgslam.core.files import shown_in
from fgslam.datasets.bags.cut import BROKEN, CutBag, CutDatabase, CutMcap, Message
from fgslam.datasets.layouts import files_of, is_bag, is_packed_bag

T = TypeVar("T")
ANY_BROKEN = (AnyReaderError, *BROKEN)
_KEPT = 16  # raw messages: the two images of the frames that threads ask for ahead of each other
_WALKED = 512  # messages that are passed over rather than looked up anew


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: its name, message type ``package/msg/Type`` and number of messages."""

    name: str
    kind: str
    count: int


class BagFiles:
    """The files of one recording as one; what cannot be read whole is read as far as it goes.

    Attributes:
        paths: the files, or the folder of a ROS 2 bag.
        topics: in the order of their names.
        notes: what was cut off.
    """

    def __init__(self, paths: list[Path]) -> None:
        """Opens the files. Raises DatasetError where one of them is no bag, or holds nothing."""
        self.paths = paths
        self.notes: tuple[str, ...] = ()
        try:
            self._reader = _open(paths, cut=False)
        except ANY_BROKEN as fault:
            self._reader = self._open_cut(fault)
        counts: dict[tuple[str, str], int] = {}
        for each in self._reader.connections:
            key = (each.topic, each.msgtype)
            if None in key:  # a damaged table of topics
                continue
            counts[key] = counts.get(key, 0) + each.msgcount
        self.topics = tuple(Topic(*key, count) for key, count in sorted(counts.items()))

    def _open_cut(self, fault: Exception) -> AnyReader:
        files = [file for path in self.paths for file in bag_files(path)]
        try:
            reader = _open(files, cut=True)
            readable = sum(each.msgcount for each in reader.connections)
        except ANY_BROKEN:
            readable = 0
        if not readable:
            names = ", ".join(map(str, self.paths))
            cause = " ".join(str(fault).split()) or type(fault).__name__
            raise DatasetError(
                f"{names}: no message can be read from it as a ROS bag ({cause}); record or copy "
                "it again"
            )
        self.notes = (
            "the bag is cut off or damaged, or its recorder was stopped: the "
            f"{readable} messages before that are used",
        )
        return reader

    def collect(self, topics: Collection[str], take: Callable[[Message], T]) -> list[T]:
        """What ``take`` makes of every message of these topics; once through the whole bag.

        Raises:
            DatasetError: a message cannot be read.
        """
        try:
            return [take(each) for each in self.messages(topics)]
        except ANY_BROKEN as fault:
            if self.notes:
                raise DatasetError(
                    f"{self.paths[0]}: damaged in its middle ({fault}); copy it again"
                ) from None
            self._reader = self._open_cut(fault)  # the index was whole, what it names is not
            return self.collect(topics, take)

    def messages(self, topics: Collection[str], start: int | None = None) -> Iterator[Message]:
        """(connection, bag time in ns, raw bytes) of these topics in order of the bag's time."""
        wanted = [each for each in self._reader.connections if each.topic in topics]
        return self._reader.messages(wanted, start=start) if wanted else iter(())

    def stated_in(self, topic: Topic) -> str:
        """The frame in which a topic's first message is stated; empty where it cannot be read."""
        try:
            connection, _, raw = next(self.messages((topic.name,)))
            return str(self.decoded(connection, raw).header.frame_id)
        except (StopIteration, FrameError, *ANY_BROKEN):
            return ""

    def decoded(self, connection: Connection, raw: bytes) -> Any:
        """The message's fields. Raises FrameError where they are damaged."""
        try:
            return self._reader.deserialize(raw, connection.msgtype)
        except ANY_BROKEN as fault:
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
    found = bag_files(given) if given.is_dir() else files_of(given)
    if packed := next(filter(is_packed_bag, found), None):
        raise DatasetError(
            f"{packed} is compressed as a whole, and no metadata.yaml is beside it; unpack it: "
            f"zstd -d {packed.name}"
        )
    return found


def bag_files(path: Path) -> list[Path]:
    """The files of a folder that are bags, or the file itself."""
    if not path.is_dir():
        return [path]
    return [file for file in shown_in(path) if is_bag(file) and file.is_file()]


def _open(paths: list[Path], cut: bool) -> AnyReader:
    reader = AnyReader(paths, default_typestore=get_typestore(Stores.LATEST))
    if cut:
        reader.readers = [_cut_reader(path) for path in paths]  # type: ignore[assignment]
    reader.open()
    return reader


def _cut_reader(path: Path) -> CutBag | Reader2:
    if path.suffix == ".bag":
        return CutBag(path)
    reader = Reader2(path)
    reader.storage = CutMcap(path) if path.suffix == ".mcap" else CutDatabase(path)
    return reader


# --------------------------------------------------------------------------------------------
# Messages again


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
        except (StopIteration, *ANY_BROKEN) as fault:
            self._next = len(self._times)
            raise FrameError(
                f"message {place} in {self._files.paths[0]} cannot be read ({fault}); leave the "
                "frame out with dataset.start/stop/stride"
            ) from None
