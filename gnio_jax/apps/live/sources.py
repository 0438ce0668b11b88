"""Where samples come from. Every source has one shape, and its name chooses it."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnio_jax.apps.importing import read_imported
from gnio_jax.apps.importing.loggers import REMEDIES
from gnio_jax.apps.live.checks import Nature, stated_rate
from gnio_jax.apps.live.inbox import Datagrams, Inbox, read_stream, receive_datagrams
from gnio_jax.apps.live.phyphox import Phyphox, PhyphoxRows
from gnio_jax.apps.live.samples import Arrival, Sample, Units
from gnio_jax.apps.live.sensor_logger import SensorLogger
from gnio_jax.apps.live.server import PageServer, listen
from gnio_jax.config import ImportOptions
from gnio_jax.data.physics import ImuSamples
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

STANDARD_INPUT = "standard input"


class Stated(NamedTuple):
    """What the user says about a source; None: it is as the source has it."""

    gyro_unit: str | None = None
    accel_unit: str | None = None
    accel_sign: str | None = None
    imu_rate: float | None = None
    silence: float | None = None
    """Time without a message after which a source ends, s; None: without end."""
    speed: float = 1.0
    """For a recording: how many times as fast it is played; 0: as fast as possible."""

    @property
    def units(self) -> Units:
        """The units of samples whose source does not name them."""
        return Units(self.gyro_unit or "rad/s", self.accel_unit or "m/s2")


class Source(NamedTuple):
    """Samples as they come."""

    arrivals: Iterator[Arrival]
    nature: Nature
    is_live: bool = True
    """Whether samples come when they are measured, so that the clock of this machine shows
    gaps, and samples from before the start are of no use."""
    imu_rate: float | None = None
    """Rate of the samples, Hz; None: it is measured, with units and sign."""
    remarks: tuple[str, ...] = ()
    """What was recognised, and what the user has to do."""
    server: PageServer | None = None
    """The page, if the source has a server."""
    close: Callable[[], object] = bool


def standard_input(_: str, stated: Stated) -> Source:
    """The lines of standard input."""
    if sys.stdin is None:
        remedy = "pipe samples into it, or name a source, such as udp:5555"
        raise InputError(STANDARD_INPUT, "is closed", remedy)
    nature = Nature(STANDARD_INPUT, stated.imu_rate, stated.accel_sign, gyro_unit=stated.units.gyro)
    return Source(read_stream(sys.stdin.buffer, nature.name, stated.units), nature, is_live=False)


def datagrams(name: str, stated: Stated) -> Source:
    """The lines of the datagrams of one machine at udp:PORT, which only this machine reaches, or at
    udp:ADDRESS:PORT."""
    host, _, port = name.partition(":")[2].rpartition(":")
    if not (port.isascii() and port.isdecimal() and 0 < int(port[:6]) < 2**16):
        raise InputError(name, "names no port", "write udp:5555 or udp:0.0.0.0:5555")
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiver.bind((host or "127.0.0.1", int(port)))
    except OSError as error:
        receiver.close()
        problem = f"cannot listen there ({error})"
        raise InputError(name, problem, "choose another port or address") from None
    inbox = Inbox(name, "datagrams")
    receive_datagrams(receiver, inbox)
    arrivals = inbox.arrivals(Datagrams(stated.units).decode, stated.silence)
    nature = Nature(name, stated.imu_rate, stated.accel_sign, gyro_unit=stated.units.gyro)
    return Source(arrivals, nature, close=receiver.close)


def sensor_logger(name: str, stated: Stated) -> Source:
    """The messages that Sensor Logger pushes to http:PORT or http:ADDRESS:PORT, where the page is
    too."""
    inbox = Inbox(name)
    server = listen(name.partition(":")[2], name, inbox)
    server.run()
    phone = SensorLogger(name, stated.units, stated.accel_sign)
    # What comes without a stated sign is Android's: see SensorLogger.
    nature = Nature(
        name,
        stated.imu_rate,
        stated.accel_sign or "android",
        REMEDIES["Sensor Logger"],
        stated.units.gyro,
    )
    remarks = (
        f"in Sensor Logger: Settings, Data Streaming, HTTP Push, push to {server.address}data",
    )
    if server.is_local:
        remarks = ("a phone reaches it only by http:0.0.0.0:PORT",)
    arrivals = inbox.arrivals(phone.decode, stated.silence)
    return Source(arrivals, nature, remarks=remarks, server=server, close=server.close)


def phyphox(name: str, stated: Stated) -> Source:
    """The rows of an experiment of phyphox at phyphox:ADDRESS, by its remote access."""
    phone, inbox = Phyphox(name.partition(":")[2], name), Inbox(name)
    nature = Nature(
        name,
        stated.imu_rate,
        stated.accel_sign or "android",
        REMEDIES["phyphox"],
        stated.units.gyro,
    )

    def arrivals() -> Iterator[Arrival]:
        phone.run(inbox)
        yield from inbox.arrivals(PhyphoxRows(stated.units).decode, stated.silence)

    return Source(arrivals(), nature, close=phone.close)


def recording(name: str, stated: Stated) -> Source:
    """The samples of a recording, as in `gnio track`."""
    options = ImportOptions(
        gyro_unit=stated.gyro_unit, accel_unit=stated.accel_unit, accel_sign=stated.accel_sign
    )
    sequence, notes, warnings = read_imported(Path(name), options)
    nature = Nature(sequence.name, stated.imu_rate)
    rate = stated_rate(1 / float(np.median(np.diff(sequence.time))), nature)
    arrivals = play(sequence, stated.speed)
    return Source(arrivals, nature, False, rate, (*warnings, *notes))


def play(sequence: Sequence, speed: float) -> Iterator[Arrival]:
    """The `recorded_samples` of a sequence, `speed` times as fast as they were recorded; 0: as fast
    as possible."""
    imu = recorded_samples(sequence)
    begin, first = time.monotonic(), imu.time[0]
    for stamp, gyro, accel in zip(*imu, strict=True):
        if speed > 0:
            time.sleep(max(0.0, begin + (stamp - first) / speed - time.monotonic()))
        sample = Sample(float(stamp), tuple(gyro.tolist()), tuple(accel.tolist()))
        yield Arrival(time.monotonic(), sample)


def recorded_samples(sequence: Sequence) -> ImuSamples:
    """The samples of a recording with the stamps of its own clock. Those that an import has
    interpolated across a gap are NaN."""
    time_of_start = float(sequence.attributes.get("start_time", 0.0))
    measured = True if sequence.imu_valid is None else sequence.imu_valid[:, None]
    signals = (np.where(measured, signal, np.nan) for signal in (sequence.gyro, sequence.accel))
    return ImuSamples(sequence.time + time_of_start, *signals)


SOURCES = {
    "-": standard_input,
    "udp": datagrams,
    "http": sensor_logger,
    "phyphox": phyphox,
}
"""Sources by the beginning of their names, up to a colon. Other names are those of recordings."""


def open_source(name: str, stated: Stated) -> Source:
    """The source of a name. It receives from now on. Raises `InputError`."""
    scheme, colon, _ = name.partition(":")
    is_source = scheme in SOURCES and (colon or scheme == "-")
    return (SOURCES[scheme] if is_source else recording)(name, stated)
