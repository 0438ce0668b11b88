"""The remote access of phyphox, which is asked for new rows ten times a second.

Facts, from its wiki (phyphox.org/wiki, Remote-interface communication) and from its sources
(github.com/phyphox/phyphox-android, RemoteServer.java):

- `/config` lists the inputs of the experiment: `source` (accelerometer, gyroscope,
  linear_acceleration, gravity) and `outputs`, the names of the buffers of x, y, z and t.
- `/get?t=5|t&x=5|t` gives the rows of the buffers t and x where t exceeds 5; `/get?t` gives the
  last value. `status` says whether it is `measuring`. Numbers have eight digits.
- `/control?cmd=start` and `cmd=stop` press its buttons.
- All sensors share one clock, s since the start, which stands still while the experiment is paused.
- It closes each connection; kept ones break it (seen by others).
- The accelerometer includes gravity, with Android's sign on iOS too (`importing.loggers`).
"""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import threading
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

from gnio_jax.apps.live.batches import PARTS, Batches
from gnio_jax.apps.live.inbox import Inbox
from gnio_jax.apps.live.samples import Sample, Units, Vector, is_finite, number
from gnio_jax.errors import InputError

SOURCES = {
    "gyroscope": "gyro",
    "accelerometer": "accel",
    "linear_acceleration": "linear",
    "gravity": "gravity",
}
"""Inputs of an experiment, and the kinds of their rows."""
PORT, LONGEST_ANSWER = 80, 16_000_000
"""Port of iOS, which Android's addresses name, and largest answer, bytes."""
EVERY, TIMEOUT = 0.1, 3.0
"""Times between two questions and to an answer, s."""
MOST_FAILURES, MOST_EMPTY = 3, 20
"""Numbers of questions without an answer after which a message says so, and without a row after
which the newest stamp is asked for."""
AXES = ("t", "x", "y", "z")
Rows = dict[str, list[tuple[float, Vector]]]


class Phyphox:
    """An experiment that runs on a phone. Raises `InputError` if it cannot be reached, or lacks a
    sensor."""

    def __init__(self, address: str, name: str):
        host, _, port = address.partition(":")
        if not re.fullmatch(r"[A-Za-z0-9.-]+", host) or not re.fullmatch(r"\d{0,5}", port):
            raise InputError(name, "is not an address", "write phyphox:192.168.0.10:8080")
        self.name, self._host, self._port = name, host, int(port or PORT)
        try:
            self._buffers = self._find_buffers(self.request("/config"))
            status, newest = self._read_status()
        except (OSError, http.client.HTTPException, KeyError, TypeError, ValueError) as error:
            problem = f"does not answer ({error or type(error).__name__})"
            remedy = "switch on Allow remote access in the experiment's menu, and give its address"
            raise InputError(name, problem, remedy) from None
        self._newest = newest
        """The newest stamp of each sensor."""
        self._added = 0.0
        """Time of all pauses, s."""
        self._paused_at: float | None = None
        self._is_running, self._starts, self._empty = status, not status, 0
        self._stopping = threading.Event()

    def run(self, inbox: Inbox) -> None:
        """Start the experiment if it does not measure yet, and put its rows into the inbox, in a
        thread."""
        threading.Thread(target=self._poll, args=(inbox,), daemon=True).start()

    def close(self) -> None:
        """Stop asking, and stop the experiment if it was started here."""
        self._stopping.set()
        if self._starts:
            with contextlib.suppress(OSError, http.client.HTTPException, ValueError):
                self.request("/control?cmd=stop")

    def request(self, path: str) -> dict[str, Any]:
        """The answer to a question."""
        connection = http.client.HTTPConnection(self._host, self._port, timeout=TIMEOUT)
        with contextlib.closing(connection):
            connection.request("GET", path, headers={"Connection": "close"})
            answer = connection.getresponse()
            content = answer.read(LONGEST_ANSWER + 1)
            if answer.status != 200 or len(content) > LONGEST_ANSWER:
                raise ValueError(f"status {answer.status}, {len(content)} bytes")
        parsed = json.loads(content)
        if not isinstance(parsed, dict):
            raise ValueError("no JSON object")
        return parsed

    def _find_buffers(self, config: dict[str, Any]) -> dict[str, tuple[str, ...]]:
        """Names of the buffers of t, x, y and z, by the kind of their rows."""
        buffers = {}
        for entry in config["inputs"]:
            outputs = {
                axis: name for pair in entry.get("outputs", []) for axis, name in pair.items()
            }
            if entry.get("source") in SOURCES and set(AXES) <= outputs.keys():
                buffers[SOURCES[entry["source"]]] = tuple(str(outputs[axis]) for axis in AXES)
        parts = next((parts for parts in PARTS if set(parts) <= buffers.keys()), ())
        if "gyro" not in buffers or not parts:
            shown = ", ".join(buffers) or "neither"
            problem = (
                f"its experiment lacks the gyroscope or the accelerometer with g (has {shown})"
            )
            remedy = "make one of both: +, Add simple experiment"
            raise InputError(self.name, problem, remedy)
        return {kind: buffers[kind] for kind in ("gyro", *parts)}

    def _read_status(self) -> tuple[bool, dict[str, float]]:
        """Whether it measures, and the newest stamp of each sensor."""
        names = {kind: names[0] for kind, names in self._buffers.items()}
        answer = self.request("/get?" + "&".join(quote(name) for name in names.values()))
        newest = {kind: answer["buffer"][name]["buffer"] for kind, name in names.items()}
        stamps = {
            kind: float(values[-1] or 0.0) if values else 0.0 for kind, values in newest.items()
        }
        return bool(answer["status"]["measuring"]), stamps

    def _poll(self, inbox: Inbox) -> None:
        failures, is_started = 0, not self._starts
        while not self._stopping.wait(EVERY):
            try:
                if not is_started:
                    self.request("/control?cmd=start")
                    is_started = True
                rows = self._read_rows(inbox)
                failures = 0
            except (OSError, http.client.HTTPException, KeyError, TypeError, ValueError) as error:
                failures += 1
                if failures == MOST_FAILURES:
                    inbox.add_notice(
                        f"{self.name} does not answer ({error or type(error).__name__})"
                    )
                continue
            if rows:
                inbox.put(rows, 64 * sum(map(len, rows.values())))

    def _read_rows(self, inbox: Inbox) -> Rows:
        """The rows since the last question. Their stamps do not stand still in a pause."""
        words = []
        for kind, names in self._buffers.items():
            condition = f"{self._newest[kind]!r}|{names[0]}"
            words += [f"{quote(name)}={quote(condition)}" for name in names]
        answer, now = self.request("/get?" + "&".join(words)), time.monotonic()
        rows: Rows = {}
        for kind, names in self._buffers.items():
            columns = [answer["buffer"][name]["buffer"] for name in names]
            for t, x, y, z in zip(*columns, strict=False):
                stamp, vector = number(t), (number(x), number(y), number(z))
                if stamp != self._newest[kind] and is_finite((stamp, *vector)):
                    rows.setdefault(kind, []).append((stamp, vector))
        self._note_pause(bool(answer["status"]["measuring"]), now, inbox)
        self._empty = 0 if rows else self._empty + 1
        if self._empty == MOST_EMPTY:  # the data may have been cleared on the phone
            self._empty, self._newest = 0, self._read_status()[1]
        for kind, readings in rows.items():
            self._newest[kind] = readings[-1][0]
            rows[kind] = [(stamp + self._added, vector) for stamp, vector in readings]
        return rows

    def _note_pause(self, is_measuring: bool, now: float, inbox: Inbox) -> None:
        if not is_measuring and self._is_running and self._paused_at is None:
            self._paused_at = now
            inbox.add_notice(f"{self.name} is paused: press play on the phone")
        elif is_measuring and self._paused_at is not None:
            self._added += now - self._paused_at
            self._paused_at = None
        self._is_running = self._is_running or is_measuring


class PhyphoxRows:
    """Samples of the rows that `Phyphox` has read."""

    def __init__(self, stated: Units):
        self._batches = Batches(stated)

    def decode(self, rows: Rows) -> Iterator[Sample | str]:
        """The samples that the rows complete."""
        for kind, readings in rows.items():
            self._batches.add(kind, readings)
        yield from self._batches.samples()
