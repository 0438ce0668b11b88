"""The one shape of what is imported: what the reader of each format gives of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gnio_jax.data.importing.streams import SensorFile
from gnio_jax.data.reference import Poses


class Units(NamedTuple):
    """What a format says of its numbers. None: it does not say, and the data must tell."""

    time: str | None = None
    """s, ms, us or ns."""
    gyro: str | None = None
    """rad/s or deg/s."""
    accel: str | None = None
    """m/s2, g or mg."""
    sign: str | None = None
    """Of the accelerometer: android or ios (see `units.signed`)."""
    sign_is_assumed: bool = False
    """Nothing says that the sign is this one."""


class Track(NamedTuple):
    """A reference trajectory, on the clock of the IMU's stamps."""

    path: Path
    """Where it comes from, for messages."""
    name: str
    """The file or topic, as the sequence's attribute `truth` has it."""
    start: float
    """The stamp from which `poses.time` counts, s."""
    poses: Poses
    """Of the IMU in a z-up world."""
    named: bool = False
    """The user asked for it: what is wrong with it is an error, and else a note."""


class Source(NamedTuple):
    """A recording as a reader gives it, before units, clocks and rates."""

    path: Path
    """As the user named it."""
    gyro: SensorFile
    accel: SensorFile
    units: Units = Units()
    track: Track | None = None
    notes: tuple[str, ...] = ()
    """What was recognised, chosen or left out, one sentence each."""
