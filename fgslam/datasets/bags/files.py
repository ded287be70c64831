"""The files of a bag: which topics, their messages in order, one again by place.

Nothing but places and stamps is held in memory.
"""

from __future__ import annotations

import struct
import threading
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
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

from fgslam.core.arrays import IntArray
from fgslam.core.errors import DatasetError, FrameError
from fgslam.core.files import shown_in
from fgslam.datasets.layouts import files_of, is_bag, is_packed_bag

T = TypeVar("T")
Message: TypeAlias = tuple[Connection, int, bytes]
"""Connection, the bag's time in nanoseconds, raw bytes."""

DAMAGED = (
    *(AnyReaderError, ReaderError1, ReaderError2, SerdeError, TypesysError),
    storage_sqlite3.apsw.Error,  # type: ignore[attr-defined]
    storage_mcap.zstd.ZstdError,  # type: ignore[attr-defined]
    *(ArithmeticError, AssertionError, AttributeError, EOFError, LookupError, OSError),
    *(MemoryError, RuntimeError, TypeError, ValueError, struct.error),
)
"""What rosbags and its libraries raise where a file is damaged."""

_KEPT = 16  # raw messages: the two images of the frames that threads ask for ahead of each other
_WALKED = 512  # messages that are passed over rather than looked up anew


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: its name, message type ``package/msg/Type`` and number of messages."""

    name: str
    kind: str
    count: int


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
        except (StopIteration, DatasetError) as fault:
            self._next = len(self._times)
            raise FrameError(
                f"message {place} in {self._files.paths[0]} cannot be read ({fault}); leave the "
                "frame out with dataset.start/stop/stride"
            ) from None
