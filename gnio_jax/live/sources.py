"""Where live samples come from: lines of text, datagrams on this machine, a recording played."""

from __future__ import annotations

import queue
import socket
import threading
import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np

from gnio_jax.errors import InputError
from gnio_jax.live.pairing import paired
from gnio_jax.live.samples import LONGEST_LINE, SI, Sample, Scale, parse_line
from gnio_jax.types import Sequence

LOCALHOST = "127.0.0.1"
LONGEST_QUEUE = 100_000
"""Datagrams that wait for the filter; later ones are lost."""


class Source(NamedTuple):
    """Samples as they come."""

    samples: Iterator[Sample | None]
    """None for a line that is no sample."""
    name: str


def lines_of(stream: Iterable[str], name: str = "standard input", scale: Scale = SI) -> Source:
    """The lines of a stream, until it ends; its units are `scale`."""
    return Source(paired(parse_line(line, scale) for line in stream), name)


def datagrams(port: int, silence: float | None = None, scale: Scale = SI) -> Source:
    """Datagrams on a UDP port of this machine, with one or several lines each, until nothing comes
    for `silence` s (None: for ever); their units are `scale`.

    A thread takes them from the socket, so that none is lost while the filter is compiled. Raises
    `InputError` where the port is taken.
    """
    where = f"udp:{port}"
    inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        inbox.bind((LOCALHOST, port))
    except (OSError, OverflowError) as error:
        inbox.close()
        problem = f"cannot listen on {LOCALHOST} ({error})"
        raise InputError(where, problem, "choose another port") from None
    waiting: queue.Queue[bytes] = queue.Queue(LONGEST_QUEUE)
    threading.Thread(target=_receive, args=(inbox, waiting), daemon=True).start()
    return Source(paired(_received(inbox, waiting, silence, scale)), where)


def _receive(inbox: socket.socket, waiting: queue.Queue[bytes]) -> None:
    while True:
        try:
            message = inbox.recv(65536)
        except OSError:
            return  # the socket is closed
        if not waiting.full():
            waiting.put(message)


def _received(
    inbox: socket.socket, waiting: queue.Queue[bytes], silence: float | None, scale: Scale
) -> Iterator[Sample | None]:
    try:
        while True:
            try:
                message = waiting.get(timeout=silence)
            except queue.Empty:
                return
            for line in message.decode("utf-8", "replace").splitlines() or [""]:
                yield parse_line(line[: LONGEST_LINE + 1], scale)
    finally:
        inbox.close()


def from_recording(sequence: Sequence, speed: float) -> Source:
    """The samples of a recording, `speed` times as fast as they were taken; 0 as fast as they can
    be followed. What lies across a gap is missing."""
    return Source(_played(sequence, speed), sequence.name)


def _played(sequence: Sequence, speed: float) -> Iterator[Sample]:
    begin, first = time.monotonic(), float(sequence.time[0])
    there = sequence.imu_valid
    missing = np.zeros((len(sequence.time), 1), bool) if there is None else ~there[:, None]
    signals = (np.where(missing, np.nan, each) for each in (sequence.gyro, sequence.accel))
    for stamp, gyro, accel in zip(sequence.time, *signals, strict=True):
        if speed > 0:
            time.sleep(max(0.0, begin + (stamp - first) / speed - time.monotonic()))
        yield Sample(float(stamp), tuple(gyro.tolist()), tuple(accel.tolist()))
