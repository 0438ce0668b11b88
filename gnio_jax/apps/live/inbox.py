"""Messages that wait for the filter, and the readers of standard input and of datagrams.

Threads receive messages from the beginning, so that nothing is lost while the filter is compiled.
What waits is bounded in number and in bytes. What is lost is counted and reported.
"""

from __future__ import annotations

import math
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

from gnio_jax.apps.live.samples import (
    LONGEST_LINE,
    NO_SAMPLE,
    Arrival,
    Sample,
    Units,
    is_missing,
    parse_lines,
)

TICK = 0.25
"""Time after which a source says that nothing has come, s."""
MOST_MESSAGES, MOST_BYTES = 100_000, 32_000_000
"""Messages that wait for the filter, at most, and their size, bytes."""
CHUNK = 65536
"""Bytes that are read at once, and largest datagram."""
TAKEN_OVER = 2.0
"""Silence after which the datagrams of another sender are read, s."""
RUNS = 8
"""Number of successive runs of samples from one port each that show several senders (ours)."""


class Inbox:
    """A queue of messages of a source `name`; `kind` is what messages are called."""

    def __init__(self, name: str, kind: str = "messages"):
        self.name, self._kind = name, kind
        self._waiting: deque[tuple[float, Any, int]] = deque()
        self._change = threading.Condition()
        self._bytes, self._lost, self._told = 0, 0, 0
        self._notices: deque[str] = deque(maxlen=10)

    def put(self, message: Any, size: int) -> bool:
        """Add a message of `size` bytes. False if it is lost, because too much waits already."""
        with self._change:
            full = len(self._waiting) >= MOST_MESSAGES or self._bytes + size > MOST_BYTES
            if full:
                self._lost += 1
            else:
                self._waiting.append((time.monotonic(), message, size))
                self._bytes += size
                self._change.notify()
        return not full

    def add_notice(self, notice: str) -> None:
        """Add a message for the user."""
        with self._change:
            self._notices.append(notice)
            self._change.notify()

    def arrivals(
        self, decode: Callable[[Any], Iterable[Sample | str]], silence: float | None = None
    ) -> Iterator[Arrival]:
        """What `decode` makes of the messages, until nothing comes for `silence` s after the first
        one (None: without end)."""
        latest = time.monotonic()
        begun = False
        while True:
            with self._change:
                if not self._waiting and not self._notices:
                    self._change.wait(TICK if silence is None else min(TICK, silence))
                notices = [self._notices.popleft() for _ in range(len(self._notices))]
                clock, message, size = (
                    self._waiting.popleft() if self._waiting else (time.monotonic(), None, 0)
                )
                self._bytes -= size
                lost, self._told = self._lost - self._told, self._lost
            if lost:
                notices.append(f"{lost} {self._kind} are lost: they came faster than they are used")
            yield from (Arrival(clock, notice=notice) for notice in notices)
            if message is not None:
                begun, latest = True, clock
                yield from _arrivals(clock, decode(message))
                continue
            quiet = clock - latest
            if begun and silence is not None and quiet >= silence:
                return
            yield Arrival(
                clock, waiting=f"samples: nothing has come on {self.name} for {quiet:.0f} s"
            )


def receive_datagrams(receiver: socket.socket, inbox: Inbox) -> None:
    """Put the datagrams of a UDP socket into the inbox, in a thread: (content, address of the
    machine that sent it, its port)."""

    def receive() -> None:
        while True:
            try:
                content, (machine, port) = receiver.recvfrom(CHUNK)
            except OSError:
                return  # the socket is closed
            inbox.put((content, machine, port), len(content))

    threading.Thread(target=receive, daemon=True).start()


class Datagrams:
    """Reads the datagrams of one sender, until it is silent for `TAKEN_OVER` seconds: it may have
    got another address. Two IMUs at one port would make one path of both.

    A machine may send each sample, or each sensor, from a port of its own, and a program that
    starts again has another one. Two senders of a machine show by ports that take turns: `RUNS`
    runs of samples of the gyro from at most half as many ports. Then the first one is followed, and
    whatever comes from another port with a gyro is refused.
    """

    def __init__(self, stated: Units):
        self._stated = stated
        self._machine: str | None = None
        self._port: int | None = None
        """The port that is followed, if several take turns."""
        self._refused = set[int]()
        """Other ports with a gyro, since one is followed."""
        self._runs = deque[int](maxlen=RUNS)
        """Ports of the newest runs of samples with a gyro."""
        self._heard = -math.inf
        """Time at which its newest sample was read, s by this machine."""

    def decode(self, datagram: tuple[bytes, str, int]) -> Iterator[Sample | str]:
        """The samples of a datagram (content, machine, port), or why a line, or a sample of another
        sender, is refused."""
        content, machine, port = datagram
        for sample in parse_lines(content, self._stated):
            is_sample, now = isinstance(sample, Sample), time.monotonic()
            if is_sample and now - self._heard > TAKEN_OVER:
                self._machine, self._port = machine, None
                self._runs.clear()
                self._refused.clear()
            if self._machine not in (None, machine):
                yield f"comes from {machine}, and the samples before it from {self._machine}"
                continue
            # A port that sends the accelerometer alone is no second sender.
            has_gyro = isinstance(sample, Sample) and not is_missing(sample.gyro)
            if has_gyro:
                self._note_port(port)
            if is_sample and port in self._refused:
                earlier = f"the samples before it from port {self._port}"
                yield f"comes from port {port} of {machine}, and {earlier}"
                continue
            if has_gyro or (is_sample and self._port is None):
                self._heard = now
            yield sample

    def _note_port(self, port: int) -> None:
        """Choose a port if several take turns, and refuse the others."""
        if self._port is None and (not self._runs or self._runs[-1] != port):
            self._runs.append(port)
            if len(self._runs) == RUNS and len(set(self._runs)) <= RUNS // 2:
                self._port = self._runs[0]
        if self._port not in (None, port):
            self._refused.add(port)


def read_stream(stream: Any, name: str, stated: Units) -> Iterator[Arrival]:
    """The lines of a binary stream, until it ends. Of a line without end the beginning is kept."""
    try:
        number = stream.fileno()
    except OSError:  # it is no file of the system
        number, read = None, partial(stream.read, CHUNK)
    else:
        read = partial(os.read, number, CHUNK)
    heard, tail = time.monotonic(), b""
    while True:
        if number is not None and not select.select([number], [], [], TICK)[0]:
            clock = time.monotonic()
            yield Arrival(
                clock, waiting=f"samples: nothing has come on {name} for {clock - heard:.0f} s"
            )
            continue
        piece, heard = read(), time.monotonic()
        lines, mark, end = (tail + piece).rpartition(b"\n")
        tail = end[: LONGEST_LINE + 1]
        yield from _arrivals(heard, parse_lines(lines + mark, stated))
        if len(tail) > LONGEST_LINE:
            yield Arrival(heard, refusal=NO_SAMPLE)
        if not piece:
            yield from _arrivals(heard, parse_lines(tail, stated))
            return


def _arrivals(clock: float, parsed: Iterable[Sample | str]) -> Iterator[Arrival]:
    for sample in parsed:
        if isinstance(sample, str):
            yield Arrival(clock, refusal=sample)
        else:
            yield Arrival(clock, sample)
