"""The messages that Sensor Logger pushes.

Facts, from its documentation (github.com/tszheichoi/awesome-sensor-logger, PUSHING.md, UNITS.md):

- Each message is a JSON object with `messageId`, which counts messages, `sessionId`, which is that
  of a recording, `deviceId` and `payload`, a list of readings. A reading has `name`, `time` (ns
  since 1970, UTC) and, of a sensor of motion, `values` with x, y and z.
- The names are those of the files of an export, in small letters (seen in servers of others:
  `accelerometer`, `gyroscope`, `gravity`, `totalacceleration`, `accelerometeruncalibrated`).
- Units, kinds and signs are those of the export (`importing.loggers`). The platform is not in a
  message, but only Android has `totalacceleration`.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Iterator
from typing import Any

from gnio_jax.apps.importing.loggers import SENSORS
from gnio_jax.apps.live.batches import Batches
from gnio_jax.apps.live.samples import Sample, Units, Vector, is_finite, number
from gnio_jax.errors import InputError

KINDS = {name.lower(): kind for name, (kind, _) in SENSORS.items()}
HELD_MESSAGES = 3
"""Number of newer messages that wait for a late one (ours)."""
NO_MESSAGE = "is not a message of Sensor Logger: a JSON object with payload is expected"

NO_READING = "is not a reading of Sensor Logger: name, time and values x, y, z are expected"


class SensorLogger:
    """Reads the messages of one phone: each once, in their order.

    `sign` is the stated sign of the accelerometer; None: only Android's `totalacceleration` is
    taken.
    """

    def __init__(self, name: str, stated: Units, sign: str | None):
        self._name, self._sign = name, sign
        self._batches, self._is_calibrated = Batches(stated), False
        self._device: str | None = None
        self._session: object = None
        self._past = deque[object](maxlen=100)
        """Earlier recordings, whose late messages are refused."""
        self._next = 0
        """Number of the message that comes next."""
        self._held: dict[int, list[dict[str, Any]]] = {}
        """Payloads of newer messages, by their numbers."""

    def decode(self, body: bytes) -> Iterator[Sample | str]:
        """The samples of a message and of those that waited for it, or why it, or a reading, is
        refused. Raises `InputError` if the sign of the accelerometer is not known."""
        try:
            message = json.loads(body)
            payload = [row for row in message["payload"] if row["name"] in KINDS]
            turn, session = int(message.get("messageId", self._next)), message.get("sessionId")
            device = message.get("deviceId")
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
            yield NO_MESSAGE
            return
        if payload and self._device is None:
            self._device = device
        if self._device not in (None, device):
            yield "comes from another phone than the first message"
            return
        if session != self._session and session not in self._past:
            self._past.append(self._session)
            self._session, self._next = session, turn
            self._held.clear()
        if session != self._session or turn < self._next or turn in self._held:
            yield f"message {turn} of Sensor Logger came twice or too late"
            return
        self._held[turn] = payload
        while self._held and (self._next in self._held or len(self._held) > HELD_MESSAGES):
            oldest = min(self._held)
            self._next = oldest + 1
            yield from self._read(self._held.pop(oldest))

    def _read(self, payload: list[dict[str, Any]]) -> Iterator[Sample | str]:
        rows: dict[str, list[tuple[float, Vector]]] = {}
        refused = 0
        names = {reading["name"] for reading in payload}
        self._is_calibrated = self._is_calibrated or "gyroscope" in names
        for reading in payload:
            name = reading["name"]
            if name == "gyroscopeuncalibrated" and self._is_calibrated:
                continue
            try:
                values = reading["values"]
                x, y, z = (number(values[axis]) for axis in "xyz")
                stamp = number(reading["time"]) / 1e9
            except (KeyError, TypeError, ValueError, OverflowError):
                refused += 1
                continue
            if is_finite((stamp, x, y, z)):
                rows.setdefault(KINDS[name], []).append((stamp, (x, y, z)))
        for kind, readings in rows.items():
            refused += self._batches.add(kind, readings)
        yield from [NO_READING] * refused
        if self._sign is None and self._batches.parts not in ((), ("accel",)):
            problem = "the sign of the acceleration depends on the phone's system"
            remedy = "give --accel-sign ios, or android if Standardise Units & Frames is on"
            raise InputError(self._name, problem, remedy)
        yield from self._batches.samples()
