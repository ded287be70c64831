"""Bags without an index, as a recorder leaves them that was stopped: what is whole is found again.

Each takes the place of the reader of rosbags for files that this refuses, and reads such a file
from its beginning up to its last whole message.
"""

from __future__ import annotations

import bz2
import heapq
import os
import struct
from collections import defaultdict
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import suppress
from io import BytesIO
from operator import itemgetter
from typing import BinaryIO, Protocol, TypeAlias

import apsw
from backports import zstd
from lz4.frame import LZ4FrameDecompressor
from rosbags.interfaces import Connection, ConnectionExtRosbag2, MessageDefinition
from rosbags.interfaces import MessageDefinitionFormat as Format
from rosbags.rosbag1 import reader as ros1
from rosbags.rosbag2 import storage_mcap as mcap
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError

Message: TypeAlias = tuple[Connection, int, bytes]

BROKEN = (
    ros1.ReaderError,
    ReaderError,
    apsw.Error,
    zstd.ZstdError,
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,  # a length that is none
    OSError,
    RuntimeError,
    SerdeError,
    TypeError,
    TypesysError,
    ValueError,
    struct.error,
)
"""What the readers of rosbags raise where a file is damaged."""


class _Stream(Protocol):
    def decompress(self, data: bytes, /) -> bytes: ...


_STREAMS: dict[str, Callable[[], _Stream]] = {
    "bz2": bz2.BZ2Decompressor,
    "lz4": LZ4FrameDecompressor,
    "zstd": zstd.ZstdDecompressor,
}
_PIECE = 1 << 14


def as_far_as_possible(data: bytes, compression: str) -> bytes:
    """What the beginning of a compressed chunk decompresses to."""
    if compression not in _STREAMS:
        return data
    stream, out = _STREAMS[compression](), []
    for at in range(0, len(data), _PIECE):
        try:
            out.append(stream.decompress(data[at : at + _PIECE]))
        except (EOFError, OSError, RuntimeError, ValueError, zstd.ZstdError):
            break
    return b"".join(out)


# --------------------------------------------------------------------------------------------
# ROS 1


class CutBag(ros1.Reader):
    """A .bag whose index is missing or damaged."""

    def open(self) -> None:
        """Reads the whole file once. Raises ReaderError where it is no bag."""
        self.bio = self._file = self.path.open("rb")
        if self._file.readline() != b"#ROSBAG V2.0\n":
            raise ros1.ReaderError("File magic is invalid.")
        self._seen: dict[int, Connection] = {}
        indexes: dict[int, list[ros1.IndexData]] = defaultdict(list)
        for start, header, at, size in self._records(self._file):
            if header.get_uint8("op") == ros1.RecordType.CHUNK:
                self._take_chunk(start, header.get_string("compression"), at, size, indexes)
        self.indexes = {number: sorted(found) for number, found in indexes.items()}
        self.connections = [
            each._replace(msgcount=len(self.indexes.setdefault(each.id, [])))
            for each in self._seen.values()
        ]

    @staticmethod
    def _records(source: BinaryIO) -> Iterator[tuple[int, ros1.Header, int, int]]:
        """Start, header, place and stated length of the data of each record; the last may lack."""
        end = source.seek(0, os.SEEK_END)
        source.seek(len(b"#ROSBAG V2.0\n") if not isinstance(source, BytesIO) else 0)
        while (start := source.tell()) < end:
            try:
                header, size = ros1.Header.read(source), ros1.read_uint32(source)
            except ros1.ReaderError:
                return
            at = source.tell()
            yield start, header, at, size
            source.seek(at + size)

    def _take_chunk(
        self,
        start: int,
        compression: str,
        at: int,
        size: int,
        indexes: dict[int, list[ros1.IndexData]],
    ) -> None:
        self._file.seek(at)
        packed = self._file.read(size)
        content = BytesIO(as_far_as_possible(packed, compression))
        length = len(content.getbuffer())
        times = []
        for place, header, data, extent in self._records(content):
            operation = header.get_uint8("op")
            if data + extent > length:
                break
            if operation == ros1.RecordType.CONNECTION:
                self._take_connection(content, place)
            elif operation == ros1.RecordType.MSGDATA:
                entry = ros1.IndexData(header.get_time("time"), start, place)
                indexes[header.get_uint32("conn")].append(entry)
                times.append(entry.time)
        self.chunks[start] = ros1.Chunk(
            len(packed), at, lambda raw: as_far_as_possible(raw, compression)
        )
        if times:
            self.chunk_infos.append(ros1.ChunkInfo(start, min(times), max(times) + 1, {}))

    def _take_connection(self, content: BytesIO, place: int) -> None:
        content.seek(place)
        self.bio = content  # where the parent reads from
        try:
            found = self.read_connection()
        finally:
            self.bio = self._file
        self._seen.setdefault(found.id, found)


# --------------------------------------------------------------------------------------------
# MCAP


class CutMcap(mcap.McapReader):
    """A .mcap without its end: chunks are indexed, those of a chunk that is cut off are kept."""

    def _open(self) -> None:
        self._file = bio = self.path.open("rb")
        if bio.read(8) != b"\x89MCAP0\r\n":
            raise ReaderError("File magic is invalid.")
        self._loose: list[tuple[int, int, bytes]] = []
        for start, operation, at, size, whole in _mcap_records(bio):
            if operation == _CHUNK:
                self._take_chunk(start, at, size, whole)
            elif whole:
                bio.seek(at)
                self._take_record(operation, bio.read(size))
        counts = self._counts()
        self.connections = [each._replace(msgcount=counts[each.id]) for each in self.connections]

    def _take_chunk(self, start: int, at: int, size: int, whole: bool) -> None:
        self._file.seek(at)
        record = BytesIO(self._file.read(size))
        first, last, length, _ = mcap.deserialize_qqqi(mcap.read_exact(record, 28))
        compression = mcap.read_string(record)
        (packed,) = mcap.deserialize_uint64(mcap.read_exact(record, 8))
        content = as_far_as_possible(record.read(packed), compression)
        counts: dict[int, int] = defaultdict(int)
        loose = []
        for _, operation, place, extent, complete in _mcap_records(BytesIO(content)):
            body = content[place : place + extent]
            if complete and operation == _MESSAGE:
                channel, _, time, _ = mcap.deserialize_hiqq(body[:22])
                counts[channel] += 1
                loose.append((time, channel, b"" if whole else body[22:]))
            elif complete:
                self._take_record(operation, body)
        if whole:
            info = mcap.ChunkInfo(
                first, last, start, size + 9, {}, 0, compression, packed, length, dict(counts)
            )
            self.chunks.append(info)
        else:
            self._loose += loose

    def _take_record(self, operation: int, body: bytes) -> None:
        """A schema, a channel or a message outside of chunks."""
        record = BytesIO(body)
        if operation == _SCHEMA:
            (key,) = mcap.deserialize_uint16(record.read(2))
            texts = (mcap.read_string(record) for _ in range(3))
            self.schemas.setdefault(key, mcap.Schema(key, *texts))
        elif operation == _CHANNEL:
            (key,), (kind,) = (mcap.deserialize_uint16(record.read(2)) for _ in range(2))
            if key not in {each.id for each in self.connections}:
                topic, encoding = mcap.read_string(record), mcap.read_string(record)
                schema = self.schemas[kind]
                about = ConnectionExtRosbag2(encoding, [])
                self.connections.append(
                    Connection(key, topic, schema.name, mcap.get_msgdef(schema), "", 0, about, self)
                )
        elif operation == _MESSAGE:
            channel, _, time, _ = mcap.deserialize_hiqq(body[:22])
            self._loose.append((time, channel, body[22:]))

    def _counts(self) -> dict[int, int]:
        counts: dict[int, int] = defaultdict(int)
        for chunk in self.chunks:
            for channel, count in chunk.channel_count.items():
                counts[channel] += count
        for _, channel, _ in self._loose:
            counts[channel] += 1
        return counts

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[Message, None, None]:
        """As the parent's, in order of time."""
        by_id = {each.id: each for each in connections}
        inside = (
            (by_id[channel], time, data)
            for time, channel, data in sorted(self._loose, key=itemgetter(0))
            if channel in by_id
            and (start is None or time >= start)
            and (stop is None or time < stop)
        )
        indexed = super().messages(connections, start, stop) if self.chunks else iter(())
        yield from heapq.merge(indexed, inside, key=itemgetter(1))


_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 0x03, 0x04, 0x05, 0x06


def _mcap_records(source: BinaryIO) -> Iterator[tuple[int, int, int, int, bool]]:
    """Start, operation, place and length of the content, and whether it is whole."""
    at = source.tell()
    end = source.seek(0, os.SEEK_END)
    while at + 9 <= end:
        source.seek(at)
        head = source.read(9)
        size = int.from_bytes(head[1:], "little")
        yield at, head[0], at + 9, min(size, end - at - 9), at + 9 + size <= end
        at += 9 + size


# --------------------------------------------------------------------------------------------
# SQLite


class CutDatabase(Sqlite3Reader):
    """A .db3 that is shorter than it says: its rows are read one by one up to the damage."""

    def open(self) -> None:
        """Reads the whole file once. Raises apsw.Error where it is no data base."""
        uri = f"file:{self.path}?immutable=1"
        self.dbconn = self._data = apsw.Connection(
            uri, flags=apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        )
        self._data.execute("PRAGMA writable_schema=ON")  # else a file cut short is refused whole
        self._rows: list[tuple[int, int, int]] = []
        rows = self._data.execute("SELECT id, topic_id, timestamp, data FROM messages ORDER BY id")
        with suppress(apsw.CorruptError, apsw.IOError):
            for number, topic, time, data in rows:
                if not (isinstance(data, bytes) and isinstance(time, int)):
                    break
                self._rows.append((time, topic, number))
        # SQLite reads what is beyond the end as zeros: those of the last row cannot be told.
        self._rows = self._rows[:-1]
        self._rows.sort()
        self.connections = self._topics()

    def _topics(self) -> list[Connection]:
        found = []
        definitions = self._definitions()
        query = "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        for number, name, kind, form in self._data.execute(query):
            count = sum(topic == number for _, topic, _ in self._rows)
            definition = definitions.get(kind, MessageDefinition(Format.NONE, ""))
            about = ConnectionExtRosbag2(form, [])
            found.append(Connection(number, name, kind, definition, "", count, about, self))
        return found

    def _definitions(self) -> dict[str, MessageDefinition]:
        """Definitions of the message types, by name, where the file holds some."""
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
        forms = {"ros2msg": Format.MSG, "ros2idl": Format.IDL}
        try:
            rows = list(self._data.execute(query))
        except apsw.Error:
            return {}
        return {
            name: MessageDefinition(forms[form], text) for name, form, text in rows if form in forms
        }

    def messages(
        self,
        connections: Collection[Connection],
        start: int | None = None,
        stop: int | None = None,
    ) -> Generator[Message, None, None]:
        """As the parent's, of the rows that can be read."""
        by_id = {each.id: each for each in connections}
        for time, topic, number in self._rows:
            if topic not in by_id or (stop is not None and time >= stop):
                continue
            if start is None or time >= start:
                query = "SELECT data FROM messages WHERE id = ?"
                ((data,),) = self._data.execute(query, (number,))
                yield by_id[topic], time, data
