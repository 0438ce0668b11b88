"""Bags and MCAP as topics and messages: rosbag1, rosbag2 (a folder, or its .db3), MCAP.

The library `rosbags` reads both kinds of bag and decodes messages, `mcap` reads MCAP, of ROS 1 too;
both are in the extra `bags`. Messages are decoded by their standard definitions (ROS 1 Noetic, ROS
2 Humble), which are the same in all distributions for the types that are read, so the definitions
inside a bag are not needed. What is compressed is unpacked here, up to a size that recorders do not
exceed, because a small file may unpack to any size.
"""

from __future__ import annotations

import bz2
import contextlib
import dataclasses
import heapq
import os
import re
import sqlite3
import urllib.parse
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from gnio_jax.data.parsing.tables import parsing_as
from gnio_jax.errors import InputError, require_packages

KINDS = {"rosbag1": "a ROS 1 bag", "rosbag2": "a ROS 2 bag", "mcap": "an MCAP"}
MCAP_MAGIC = b"\x89MCAP0\r\n"
"""First and last bytes of a whole MCAP (mcap.dev/spec)."""
LARGEST_CHUNK = 1 << 28
"""Largest unpacked size of a chunk or of a compressed message, bytes; recorders limit chunks to
some MiB (ours)."""
SMALL_CHUNK, LARGEST_RATIO = 1 << 24, 100
"""Unpacked size up to which a chunk may be compressed at any ratio, bytes, and the largest ratio of
larger ones (ours)."""
TABLES = ("messages", "topics", "schema", "metadata", "message_definitions")
"""Tables of a ROS 2 bag in SQLite."""


class Topic(NamedTuple):
    """A topic of a recording."""

    name: str
    type: str
    """As in ROS 2: sensor_msgs/msg/Imu."""
    count: int
    """Number of its messages."""


class Bag(NamedTuple):
    """An open recording."""

    path: Path
    topics: dict[str, Topic]
    messages: Callable[[Collection[str]], Iterator[tuple[str, int, Any]]]
    """A function from names to (topic, time of recording ns, decoded message) of each message. A
    failure inside a library is an `InputError`."""


@contextmanager
def open_bag(path: Path, kind: str) -> Iterator[Bag]:
    """Open a recording of one of `KINDS`. Raises `InputError`, also for one that would unpack to
    more than recorders write."""
    require_packages(path, "bags", "rosbags", "mcap")
    with ExitStack() as stack:
        with _reading(path, kind):
            if kind == "mcap":
                bag = _mcap(path, stack)
            elif kind == "rosbag1":
                bag = _rosbag1(path, stack)
            else:
                bag = _folder(path, stack) if path.is_dir() else _sqlite(path, stack)
        yield bag


@contextmanager
def _reading(path: Path, kind: str) -> Iterator[None]:
    """Report errors of the libraries as damage of the file, for which rosbags uses assertions
    too."""
    with parsing_as(path, KINDS[kind]):
        try:
            yield
        except AssertionError as error:
            raise ValueError(f"unexpected content {error}".strip()) from error
        except Exception as error:
            if "not indexed" in str(error):
                problem = "has no index, because its recorder was killed"
                raise InputError(path, problem, f"make one: rosbag reindex {path.name}") from None
            raise


# --- bounds


def _unpack(data: bytes, compression: str, path: Path) -> bytes:
    """The content of a chunk or message. Raises `InputError` if it is larger than recorders
    write."""
    import lz4.frame
    import zstandard

    most = min(LARGEST_CHUNK, SMALL_CHUNK + LARGEST_RATIO * len(data))
    match compression:
        case "" | "none":
            content = data
        case "bz2":
            content = bz2.BZ2Decompressor().decompress(data, most + 1)
        case "lz4":
            content = lz4.frame.LZ4FrameDecompressor().decompress(data, most + 1)
        case "zstd":
            content = zstandard.ZstdDecompressor().stream_reader(data).read(most + 1)
        case _:
            raise InputError(path, f"is compressed as '{compression}'", "record it again")
    if len(content) > most:
        raise InputError(path, "holds a chunk that unpacks to gigabytes", "record it again")
    return content


def _check_tables(path: Path) -> None:
    """Raise `InputError` if a SQLite file holds anything else than tables and indexes: a view or a
    computed column may compute for any time."""
    if set("%?#") & set(str(path)):  # SQLite would open another file
        raise InputError(path, "has %, ? or # in its name", "rename it, or its folder")
    address = f"file:{urllib.parse.quote(str(path.absolute()))}?immutable=1"
    with contextlib.closing(sqlite3.connect(address, uri=True)) as connection:
        rows = connection.execute("SELECT type, name, sql FROM sqlite_master").fetchall()
        odd = [name for kind, name, _ in rows if kind not in ("table", "index")]
        odd += [name for _, name, sql in rows if re.match(r"\s*create\s+virtual", sql or "", re.I)]
        for table in TABLES:
            columns = connection.execute(f"PRAGMA table_xinfo({table})").fetchall()
            odd += [f"{table}.{name}" for _, name, *_, hidden in columns if hidden]
    if odd:
        problem = f"holds '{odd[0]}', which no recorder writes"
        raise InputError(path, problem, "record it again, or convert it to MCAP")


# --- the formats


def _rosbag1(path: Path, stack: ExitStack) -> Bag:
    from rosbags import rosbag1

    reader = stack.enter_context(rosbag1.Reader(path))
    names = {function: name for name, function in rosbag1.reader.decompressors.items()}
    for start, chunk in reader.chunks.items():
        compression = names[chunk.decompressor]
        bounded = partial(_unpack, compression=compression, path=path)
        reader.chunks[start] = chunk._replace(decompressor=bounded)
    decode = _decoder("ros1")

    def messages(names: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        with _reading(path, "rosbag1"):
            chosen = [one for one in reader.connections if one.topic in names]
            for connection, time, data in reader.messages(connections=chosen):
                yield connection.topic, time, decode(data, connection.msgtype)

    connections = ((one.topic, one.msgtype, one.msgcount) for one in reader.connections)
    return Bag(path, _join_connections(connections), messages)


def _folder(path: Path, stack: ExitStack) -> Bag:
    """A rosbag2 of one file or several, which are read one after the other."""
    content = (path / "metadata.yaml").read_text(encoding="utf-8")
    facts = yaml.safe_load(content)["rosbag2_bagfile_information"]
    mode, form = (
        str(facts.get(f"compression_{name}") or "none").lower() for name in ("mode", "format")
    )
    if mode == "file":
        # The library would unpack its files to the disk, at any size.
        remedy = "unpack its file (zstd -d FILE.zstd) and import that"
        raise InputError(path, "is compressed as a whole (compression_mode FILE)", remedy)
    unpack = partial(_unpack, compression=form if mode == "message" else "", path=path)
    readers = {"mcap": _mcap, "sqlite3": _sqlite}
    read = readers[facts["storage_identifier"]]
    bags = [read(path / Path(name).name, stack, unpack) for name in facts["relative_file_paths"]]
    topics = _join_connections(
        (one.name, one.type, one.count) for bag in bags for one in bag.topics.values()
    )

    def messages(names: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        for bag in bags:
            yield from bag.messages([name for name in names if name in bag.topics])

    return Bag(path, topics, messages)


def _sqlite(path: Path, stack: ExitStack, unpack: Callable[[bytes], bytes] = bytes) -> Bag:
    from rosbags import rosbag2

    _check_tables(path)
    reader = stack.enter_context(rosbag2.Reader(path))
    decode = _decoder("cdr")

    def messages(names: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        with _reading(path, "rosbag2"):
            chosen = [one for one in reader.connections if one.topic in names]
            for connection in chosen:
                encoding = getattr(connection.ext, "serialization_format", "")
                _check_encoding(connection.topic, encoding, path)
            for connection, time, data in reader.messages(connections=chosen):
                yield connection.topic, time, decode(unpack(data), connection.msgtype)

    connections = ((one.topic, one.msgtype, one.msgcount) for one in reader.connections)
    return Bag(path, _join_connections(connections), messages)


def _mcap(path: Path, stack: ExitStack, unpack: Callable[[bytes], bytes] = bytes) -> Bag:
    from mcap.reader import SeekingReader

    file = stack.enter_context(path.open("rb"))
    file.seek(-min(len(MCAP_MAGIC), path.stat().st_size), os.SEEK_END)
    if file.read() != MCAP_MAGIC:
        raise InputError(path, "is cut short, its end is missing", "repair it with mcap recover")
    file.seek(0)
    summary = SeekingReader(file, record_size_limit=LARGEST_CHUNK).get_summary()
    if summary is None or summary.statistics is None:
        raise InputError(path, "has no summary of its topics", "write one with mcap recover")
    counts = summary.statistics.channel_message_counts
    names = {0: ""} | {number: schema.name for number, schema in summary.schemas.items()}
    topics = _join_connections(
        (channel.topic, names[channel.schema_id], counts.get(number, 0))
        for number, channel in summary.channels.items()
    )
    channels = summary.channels
    encodings = {channel.topic: channel.message_encoding for channel in channels.values()}

    def messages(names: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        for name in names:
            _check_encoding(name, encodings[name], path)
        decoders = {name: _decoder(encodings[name]) for name in names}
        chosen = {number for number, channel in channels.items() if channel.topic in names}
        with _reading(path, "mcap"):
            for message in _mcap_messages(file, summary.chunk_indexes, chosen, path):
                topic = channels[message.channel_id].topic
                decoded = decoders[topic](unpack(message.data), topics[topic].type)
                yield topic, message.log_time, decoded

    return Bag(path, topics, messages)


def _mcap_messages(file: Any, indexes: list[Any], chosen: set[int], path: Path) -> Iterator[Any]:
    """The messages of these channels in the order in which they were logged; those outside chunks
    as they are in the file."""
    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message
    from mcap.stream_reader import StreamReader, breakup_chunk

    def inside(chunk: Chunk) -> Iterator[Message]:
        content = _unpack(chunk.data, chunk.compression, path)
        chunk = dataclasses.replace(chunk, compression="", data=content)
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Message) and record.channel_id in chosen:
                yield record

    if not indexes:
        file.seek(0)
        reader = StreamReader(file, emit_chunks=True, record_size_limit=LARGEST_CHUNK)
        for record in reader.records:
            if isinstance(record, Chunk):
                yield from inside(record)
            elif isinstance(record, Message) and record.channel_id in chosen:
                yield record
        return
    pending: list[tuple[int, int, int, Message]] = []
    for number, index in enumerate(sorted(indexes, key=lambda index: index.message_start_time)):
        if index.message_index_offsets and not chosen & index.message_index_offsets.keys():
            continue
        while pending and pending[0][0] < index.message_start_time:
            yield heapq.heappop(pending)[-1]
        file.seek(index.chunk_start_offset + 1 + 8)  # its kind and its length
        for row, message in enumerate(inside(Chunk.read(ReadDataStream(file)))):
            heapq.heappush(pending, (message.log_time, number, row, message))
    while pending:
        yield heapq.heappop(pending)[-1]


def _check_encoding(topic: str, encoding: str, path: Path) -> None:
    if encoding not in ("cdr", "ros1"):
        problem = f"topic {topic} is encoded as {encoding or 'nothing known'}"
        raise InputError(path, problem, "record it as ROS 2 (cdr) or ROS 1 messages")


def _join_connections(connections: Iterable[tuple[str, str, int]]) -> dict[str, Topic]:
    """The topics of connections or channels, each (topic, type, messages). A topic may have
    several."""
    topics: dict[str, Topic] = {}
    for topic, kind, count in connections:
        kind = re.sub("^([^/]+)/([^/]+)$", r"\1/msg/\2", kind)
        count += topics[topic].count if topic in topics else 0
        topics[topic] = Topic(topic, kind, count)
    return topics


def _decoder(encoding: str) -> Callable[[bytes, str], Any]:
    from rosbags.typesys import Stores, get_typestore

    if encoding == "ros1":
        return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
