"""`gnio data import`: a recording as people have it, as the package's HDF5."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from gnio_jax.commands import console
from gnio_jax.commands.options import Command, sibling
from gnio_jax.commands.recording import RecordingOptions, read_recording
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


@dataclass(frozen=True)
class ImportOptions(RecordingOptions):
    """What `gnio data import` is asked for."""

    out: Path = field(kw_only=True)
    """HDF5 file to write, NAME.h5."""
    rate: float | None = None
    """Rate of the result, Hz; by default that of the faster sensor."""
    name: str | None = None
    """Name of the sequence; by default that of the file OUT."""


def import_file(options: ImportOptions, prog: str) -> None:
    """Write the file, say what was assumed and what it looks like, and what to do with it."""
    from gnio_jax.data.checking import impressions
    from gnio_jax.data.importing.kept import write_imported
    from gnio_jax.data.readers import csv_files

    if options.out.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError("--out", f"'{options.out}' is no name of an HDF5 file", "name it NAME.h5")
    if options.out.is_dir():
        raise InputError("--out", f"'{options.out}' is a folder", "name a file in it, NAME.h5")
    name = options.name or options.out.stem
    recording = read_recording(options, name, options.rate)
    write_imported(options.out, recording)
    sequence, notes = recording
    folder = options.out.parent
    lists = [split for split in csv_files.SPLITS if (folder / f"{split}.txt").is_file()]
    notes = [*notes, *impressions(sequence)]
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


COMMON = (
    "FILE",
    "--out",
    "--rate",
    "--name",
    "--accel-path",
    "--columns.time",
    "--gyro-unit",
    "--accel-unit",
    "--accel-sign",
    "--imu-topic",
    "--reference-topic",
)

COMMAND = Command(ImportOptions, import_file, DESCRIPTION, common=COMMON)
