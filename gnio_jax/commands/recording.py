"""A recording as people have it: the options that say what it does not say of itself."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

Sign = Annotated[
    Literal["android", "ios", "detect"] | None, tyro.conf.arg(metavar="{android,ios,detect}")
]


@dataclass(frozen=True)
class Columns:
    """Names of a CSV's columns, or their places from 0 without a header; "a+b" is a sum."""

    time: str | None = None
    """Stamps."""
    accel_time: str | None = None
    """Stamps of the accelerometer, where they are another column."""
    gyro_x: str | None = None
    """Angular rate."""
    gyro_y: str | None = None
    """Angular rate."""
    gyro_z: str | None = None
    """Angular rate."""
    accel_x: str | None = None
    """Acceleration, gravity included."""
    accel_y: str | None = None
    """Acceleration, gravity included."""
    accel_z: str | None = None
    """Acceleration, gravity included."""


@dataclass(frozen=True)
class RecordingOptions:
    """Where a recording is, and what it does not say of itself."""

    file: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FILE")]]
    """The recording: a file or folder; of two CSVs the gyro's."""
    accel_path: Path | None = None
    """The accelerometer's CSV."""
    columns: Columns = field(default_factory=Columns)
    """What the columns of a CSV are called; those not given are looked up by our own names: time,
    gyro_x, ..."""
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    """Unit of the stamps; that of the format, or detected, by default."""
    gyro_unit: Literal["rad/s", "deg/s"] | None = None
    """Unit of the gyro; that of the format or header, or detected, by default."""
    accel_unit: Literal["m/s2", "g", "mg"] | None = None
    """Unit of the accelerometer; that of the format or header, or detected, by default."""
    accel_sign: Sign = None
    """At rest, level, the up axis reads +1 g (android) or −1 g (ios); detect assumes that the
    screen points up. That of the format by default, android for a CSV."""
    order: Literal["sort", "refuse"] = "sort"
    """Rows out of order are sorted, or refused."""
    separator: str | None = None
    """Separator of a CSV's columns; detected by default."""
    imu_topic: str | None = None
    """Topic of sensor_msgs/Imu in a bag that has several."""
    accel_topic: str | None = None
    """The accelerometer's topic, where it has one of its own."""
    reference_topic: str | None = None
    """Topic of poses, odometry or transforms in a bag that has several; /tf:CHILD_FRAME for TF."""


def read_recording(
    options: RecordingOptions, name: str | None = None, rate: float | None = None
) -> Any:
    """The recording as an `importing.Imported`, whose notes have the warnings too."""
    from gnio_jax.data.importing import import_recording

    columns = dataclasses.asdict(options.columns)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = import_recording(
            options.file,
            {name: column for name, column in columns.items() if column is not None},
            accel_path=options.accel_path,
            time_unit=options.time_unit,
            gyro_unit=options.gyro_unit,
            accel_unit=options.accel_unit,
            accel_sign=options.accel_sign,
            order=options.order,
            rate=rate,
            separator=options.separator,
            name=name,
            imu_topic=options.imu_topic,
            accel_topic=options.accel_topic,
            reference_topic=options.reference_topic,
        )
    warned = (str(warning.message) for warning in caught)
    return found._replace(notes=(*found.notes, *warned))


def read_any(options: RecordingOptions) -> Any:
    """An `importing.Imported` of the file; our own HDF5 is read as it is."""
    if options.file.suffix.lower() not in (".h5", ".hdf5"):
        return read_recording(options)
    from gnio_jax.data.importing.kept import read_imported

    return read_imported(options.file)
