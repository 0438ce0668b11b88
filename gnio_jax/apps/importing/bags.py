"""Recordings of robots, as one interface: rosbag1, rosbag2 (a folder, or its .db3) and MCAP.

The library `rosbags` reads both kinds of bag and decodes messages, `mcap` reads MCAP; both are in
the extra `bags`. Messages are decoded by their standard definitions (ROS 1 Noetic, ROS 2 Humble),
which are those of all distributions for the types that are read here; what a bag says of its own
types is not needed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.data.parsing.tables import parsed_as, shortened
from gnio_jax.errors import InputError, require_packages

LARGEST_CHUNK = 1 << 30
"""Bytes to which a chunk of an MCAP may unpack; recorders cut them at some MiB (ours)."""
_MCAP = b"\x89MCAP0\r\n"
"""First and last bytes of a whole MCAP (mcap.dev/spec)."""
KINDS = {"rosbag1": "a ROS 1 bag", "rosbag2": "a ROS 2 bag", "mcap": "an MCAP"}


class Topic(NamedTuple):
    """A topic of a bag."""

    name: str
    type: str
    """As in ROS 2: sensor_msgs/msg/Imu."""
    count: int
    """Messages."""


class Message(NamedTuple):
    """A message, decoded."""

    topic: str
    log_time: int
    """When it was recorded, ns."""
    content: Any


class Bag(NamedTuple):
    """An open recording."""

    path: Path
    topics: tuple[Topic, ...]
    messages: Callable[[Iterable[str]], Iterator[Message]]
    """Those of some topics."""


@contextmanager
def opened(path: Path, kind: str) -> Iterator[Bag]:
    """The recording, while it is open; `kind` is one of `KINDS`. What fails within, where it is
    damaged, is an `InputError`."""
    require_packages(path, "bags", "rosbags", "mcap")
    with parsed_as(path, KINDS[kind]), ExitStack() as stack:
        yield _mcap(path, stack) if kind == "mcap" else _rosbag(path, kind, stack)


def listed(topics: Iterable[Topic]) -> str:
    """Topics and their types, for messages."""
    names = [f"{topic.name} ({topic.type.replace('/msg/', '/')})" for topic in topics]
    return shortened(", ".join(names) or "none", 400)


def _rosbag(path: Path, kind: str, stack: ExitStack) -> Bag:
    from rosbags import rosbag1, rosbag2

    reader = stack.enter_context((rosbag1 if kind == "rosbag1" else rosbag2).Reader(path))
    decode = _decoder("ros1" if kind == "rosbag1" else "cdr")

    def messages(names: Iterable[str]) -> Iterator[Message]:
        wanted = set(names)
        chosen = [one for one in reader.connections if one.topic in wanted]
        for connection, time, data in reader.messages(connections=chosen) if chosen else ():
            yield Message(connection.topic, time, decode(data, connection.msgtype))

    found = {}
    for one in reader.connections:
        count = one.msgcount + (found[one.topic].count if one.topic in found else 0)
        found[one.topic] = Topic(one.topic, one.msgtype, count)
    return Bag(path, tuple(found.values()), messages)


def _mcap(path: Path, stack: ExitStack) -> Bag:
    from mcap.reader import make_reader

    file = stack.enter_context(path.open("rb"))
    file.seek(-min(len(_MCAP), path.stat().st_size), os.SEEK_END)
    if file.read() != _MCAP:
        raise InputError(path, "is cut short, its end is missing", "mend it with mcap recover")
    file.seek(0)
    reader = make_reader(file, validate_crcs=True)
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        raise InputError(path, "has no summary of its topics", "write one with mcap recover")
    if any(chunk.uncompressed_size > LARGEST_CHUNK for chunk in summary.chunk_indexes):
        raise InputError(path, "holds a chunk that unpacks to gigabytes", "record it anew")
    counts = summary.statistics.channel_message_counts
    topics, encodings = {}, {}
    for number, channel in summary.channels.items():
        schema = summary.schemas.get(channel.schema_id)
        count = counts.get(number, 0) + (
            topics[channel.topic].count if channel.topic in topics else 0
        )
        name = _ros2_name(schema.name if schema else "")
        topics[channel.topic] = Topic(channel.topic, name, count)
        encodings[channel.topic] = channel.message_encoding

    def messages(names: Iterable[str]) -> Iterator[Message]:
        wanted = [name for name in names if name in topics]
        for name in wanted:
            if encodings[name] not in ("cdr", "ros1"):
                raise InputError(
                    path,
                    f"topic {name} is encoded as {encodings[name] or 'nothing known'}",
                    "record it as ROS 2 (cdr) or ROS 1 messages",
                )
        decoders = {name: _decoder(encodings[name]) for name in wanted}
        for _, channel, message in reader.iter_messages(wanted) if wanted else ():
            topic = channel.topic
            content = decoders[topic](message.data, topics[topic].type)
            yield Message(topic, message.log_time, content)

    return Bag(path, tuple(topics.values()), messages)


def _ros2_name(name: str) -> str:
    """`sensor_msgs/msg/Imu` of ROS 1's `sensor_msgs/Imu`."""
    package, _, rest = name.partition("/")
    return f"{package}/msg/{rest}" if rest and "/" not in rest else name


def _decoder(encoding: str) -> Callable[[bytes, str], Any]:
    from rosbags.typesys import Stores, get_typestore

    if encoding == "ros1":
        return get_typestore(Stores.ROS1_NOETIC).deserialize_ros1
    return get_typestore(Stores.ROS2_HUMBLE).deserialize_cdr
