"""`gnio data import`: a recording as people have it, as the package's HDF5."""

from __future__ import annotations

import dataclasses
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from gnio_jax.commands import console
from gnio_jax.commands.options import Command, sibling
from gnio_jax.errors import InputError

DESCRIPTION = """A recording of a phone or robot as the package's HDF5.

  {prog} walk.zip --out recordings/walk.h5      (Sensor Logger, phyphox)
  {prog} walk.bag --imu-topic /imu --out recordings/walk.h5      (or MCAP)
  {prog} V1_01_easy --out recordings/walk.h5    (a folder of EuRoC's layout)
  {prog} walk.csv --out recordings/walk.h5
  {prog} Gyroscope.csv --accel-path Accelerometer.csv --columns.time "Time (s)" \\
      --columns.gyro-x "X (rad/s)" --columns.gyro-y "Y (rad/s)" --columns.gyro-z "Z (rad/s)" \\
      --columns.accel-x "X (m/s^2)" --columns.accel-y "Y (m/s^2)" --columns.accel-z "Z (m/s^2)" \\
      --out recordings/walk.h5
  {prog} ios.csv --accel-sign ios --gyro-unit deg/s --rate 100 --out recordings/ios.h5

The format is told by the content, units by the format, the header or the data; what was assumed is
said. A recording without a reference is evaluated with --init static."""

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
class ImportOptions:
    """What `gnio data import` is asked for."""

    file: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FILE")]]
    """The recording: a file or folder; of two CSVs the gyro's."""
    out: Path
    """HDF5 file to write, NAME.h5."""
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
    rate: float | None = None
    """Rate of the result, Hz; by default that of the faster sensor."""
    separator: str | None = None
    """Separator of a CSV's columns; detected by default."""
    imu_topic: str | None = None
    """Topic of sensor_msgs/Imu in a bag that has several."""
    accel_topic: str | None = None
    """The accelerometer's topic, where it has one of its own."""
    reference_topic: str | None = None
    """Topic of poses, odometry or transforms in a bag that has several; /tf:CHILD_FRAME for TF."""
    name: str | None = None
    """Name of the sequence; by default that of the file OUT."""


def import_file(options: ImportOptions, prog: str) -> None:
    """Write the file, say what was assumed and what it looks like, and what to do with it."""
    from gnio_jax.data import importing
    from gnio_jax.data.checking import impressions
    from gnio_jax.data.hdf5 import write_hdf5
    from gnio_jax.data.readers import csv_files

    if options.out.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError("--out", f"'{options.out}' is no name of an HDF5 file", "name it NAME.h5")
    if options.out.is_dir():
        raise InputError("--out", f"'{options.out}' is a folder", "name a file in it, NAME.h5")
    columns = dataclasses.asdict(options.columns)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sequence, notes = importing.import_recording(
            options.file,
            {name: column for name, column in columns.items() if column is not None},
            accel_path=options.accel_path,
            time_unit=options.time_unit,
            gyro_unit=options.gyro_unit,
            accel_unit=options.accel_unit,
            accel_sign=options.accel_sign,
            order=options.order,
            rate=options.rate,
            separator=options.separator,
            name=options.name or options.out.stem,
            imu_topic=options.imu_topic,
            accel_topic=options.accel_topic,
            reference_topic=options.reference_topic,
        )
    write_hdf5(options.out, sequence)
    folder = options.out.parent
    lists = [split for split in csv_files.SPLITS if (folder / f"{split}.txt").is_file()]
    notes = [*notes, *(str(warning.message) for warning in caught), *impressions(sequence)]
    if lists:
        line = f"add the line {options.out.stem} to {lists[-1]}.txt, or it is not read"
        notes.append(f"{folder} has lists: {line}")
    evaluate = f"{sibling(prog, 'evaluate')} --dataset csv --data-root {folder} --split test"
    start = "" if sequence.valid.any() else " --init static"
    output = console.stdout()
    output.print(f"{options.out}: {sequence.name}", soft_wrap=True)
    for note in notes:
        output.print(f"  {note}", soft_wrap=True)
    output.print(f"next: {evaluate}{start}", soft_wrap=True)


COMMAND = Command(ImportOptions, import_file, DESCRIPTION)
