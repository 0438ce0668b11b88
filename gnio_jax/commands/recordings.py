"""`gnio data import`, `gnio data export`: files from and for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from gnio_jax.commands import console, options
from gnio_jax.config import ImportOptions
from gnio_jax.config.schema import UNNAMED, NewFile, Rate
from gnio_jax.errors import InputError
from gnio_jax.files import HDF5


@dataclass(frozen=True)
class ImportFile:
    file: Annotated[Path, UNNAMED]
    """The recording, a file or a folder. If each sensor has its own CSV, give the gyro's."""
    out: NewFile
    """HDF5 file to write, NAME.h5."""
    rate: Rate | None = None
    """Rate of the result, Hz; by default that of the faster sensor."""
    name: str | None = None
    """Name of the sequence; by default that of the file OUT."""
    recording: Annotated[ImportOptions, UNNAMED] = ImportOptions()  # noqa: RUF009 - it is frozen


@dataclass(frozen=True)
class ExportFile:
    trajectory: Annotated[Path, UNNAMED]
    """File in TUM format."""
    out: Annotated[NewFile, UNNAMED]
    """File to write. Its ending chooses the format: .mcap, .csv or .tum."""


def import_file(request: ImportFile, _call: options.Call) -> None:
    """Import a recording of a phone or robot as the package's HDF5.

    The format is recognised by the content: a zip or folder of Sensor Logger or phyphox, a ROS bag
    or MCAP, a folder of EuRoC's layout, a CSV. Units are those of the format or of a header, or
    they are detected; assumptions are printed. A recording without a reference is evaluated with
    --init static.

    examples:
      {prog} walk.zip --out recordings/walk.h5
      {prog} walk.bag --imu-topic /imu --out recordings/walk.h5
      {prog} robot.csv --columns time=stamp gyro_x=wx gyro_y=wy gyro_z=wz accel_x=ax \\
          accel_y=ay accel_z=az --time-unit ms --out recordings/robot.h5
      {prog} Gyroscope.csv --accel-path Accelerometer.csv --columns "time=Time (s)" \\
          "gyro_x=X (rad/s)" "gyro_y=Y (rad/s)" "gyro_z=Z (rad/s)" "accel_x=X (m/s^2)" \\
          "accel_y=Y (m/s^2)" "accel_z=Z (m/s^2)" --out recordings/walk.h5
      {prog} ios.csv --accel-sign ios --gyro-unit deg/s --rate 100 --out recordings/ios.h5
    """
    if request.out.suffix.lower() not in HDF5:
        raise InputError(
            "--out", f"'{request.out}' is not the name of an HDF5 file", "name it NAME.h5"
        )
    from gnio_jax.apps import importing  # late: mistakes do not wait for JAX
    from gnio_jax.data.readers import csv_files

    name, folder = request.name or request.out.stem, request.out.parent
    recording = importing.import_recording(
        request.file, request.recording, rate=request.rate, name=name
    )
    importing.write_imported(request.out, recording)
    sequence = recording.sequence
    lines = [*recording.notes, *_impressions(sequence)]
    following = f"gnio track {request.out}"
    if sequence.valid.any():
        following = f"gnio evaluate --network pedestrian --dataset csv --data-root {folder} "
        following += "--split test"
    lists = [split for split in csv_files.SPLITS if (folder / f"{split}.txt").is_file()]
    neighbours = [path for path in csv_files.files_of(folder) if path.name != request.out.name]
    others = [
        path
        for path in neighbours
        if path.suffix.lower() not in HDF5 or path.stem == request.out.stem
    ]
    if lists:
        line = f"add the line {request.out.name} to {lists[-1]}.txt"
        lines.append(
            f"{folder} has lists of its splits: {line}, otherwise this recording is not read"
        )
    elif others:
        following = f"gnio track {request.out}"
        lines.append(
            f"{folder} holds {others[0].name} too, which gnio evaluate would read as a recording; "
            "write the imported ones to a folder of their own"
        )
    console.say(f"{request.out}: {sequence.name}")
    for line in lines:
        console.say(f"  {line}")
    for warning in recording.warnings:
        console.say(f"warning: {warning}")
    console.say(f"next: {following}")


def _impressions(sequence: Any) -> list[str]:
    """Lines that a person can compare with the recording: length, magnitudes, rest."""
    import numpy as np

    time = sequence.time
    step = float(np.median(np.diff(time)))
    accel, gyro = (np.linalg.norm(field, axis=1) for field in (sequence.accel, sequence.gyro))
    lines = [
        f"{time[-1] - time[0]:.1f} s at {1.0 / step:.4g} Hz",
        f"|accel| {np.median(accel):.2f} m/s² in the median, up to {accel.max():.2f}",
        f"|gyro| {np.median(gyro):.2f} rad/s in the median, up to {gyro.max():.2f}",
    ]
    span = max(round(0.5 / step), 1)
    if count := len(accel) // span:
        accel, gyro = (norm[: count * span].reshape(count, span) for norm in (accel, gyro))
        still = (accel.std(axis=1) < 0.2) & (gyro.mean(axis=1) < 0.1)
        lines.append(f"it rests {still.mean():.0%} of the time")
    return lines


def export_file(request: ExportFile, _call: options.Call) -> None:
    """Write a trajectory of gnio evaluate or gnio track in the format of another program.

    examples:
      {prog} trajectories/walk.txt walk.mcap        Foxglove, ROS 2
      {prog} trajectories/walk.txt walk.csv
    """
    from gnio_jax.apps.export import export  # late: mistakes do not wait for JAX
    from gnio_jax.evaluation.trajectory import read_tum

    trajectory = read_tum(request.trajectory)
    count = export(request.out, trajectory)
    seconds = trajectory.time[-1] - trajectory.time[0]
    console.say(f"{request.out}: {count} poses, {seconds:.1f} s")
