"""Writes the known walk as the loggers of phones export it: members of a zip, by name.

Gyroscope and accelerometer have stamps of their own, as on a phone.
"""

import io
import zipfile
from pathlib import Path

import numpy as np
import openpyxl
import xlwt

from tests.support import known_walk

EPOCH = 1_700_000_000_123_456_789
RATE = 100.0
SECONDS = 8.0
DELAY = 0.003
"""s by which the accelerometer's stamps follow the gyro's."""
METADATA = "version,device name,recording epoch time,platform,sampleRateMs,standardisation"


def clock(seconds=SECONDS):
    return np.arange(round(seconds * RATE)) / RATE


def gravity(time):
    """What an accelerometer reads at rest in the walk's attitude, m/s²."""
    return known_walk.attitude(time).inv().apply([0.0, 0.0, known_walk.GRAVITY])


def sensor_table(time, values):
    """A CSV of Sensor Logger."""
    lines = ["time,seconds_elapsed,z,y,x"]
    for stamp, (x, y, z) in zip(time, values, strict=True):
        whole = EPOCH + round(stamp * 1e9)
        lines.append(f"{whole},{stamp:.9f},{z:.9f},{y:.9f},{x:.9f}")
    return "\n".join(lines) + "\n"


def metadata(platform, standardised):
    return f"{METADATA}\n3,phone,{EPOCH},{platform},10,{str(standardised).lower()}\n"


def sensor_logger(platform="android", standardised=False, seconds=SECONDS):
    """Every sensor that the app writes on a system."""
    time = clock(seconds)
    later = time + DELAY
    sign = -1.0 if platform == "ios" and not standardised else 1.0
    down, force = gravity(later), known_walk.force(later)
    unit = 1 / 9.80665 if sign < 0 else 1.0
    members = {
        "Gyroscope.csv": sensor_table(time, known_walk.rate(time)),
        "Accelerometer.csv": sensor_table(later, sign * (force - down)),
        "Gravity.csv": sensor_table(later, sign * down),
        "AccelerometerUncalibrated.csv": sensor_table(later, sign * unit * force),
        "Magnetometer.csv": sensor_table(time, 0 * force + 40.0),
        "Annotation.csv": "time,seconds_elapsed,text\n",
        "Metadata.csv": metadata(platform, standardised),
    }
    if platform == "android":
        members["TotalAcceleration.csv"] = sensor_table(later, force)
    return members


def phyphox_table(time, values, labels, separator=",", decimal="."):
    """A CSV of phyphox: quoted names, numbers as 1.234567890E0, NaN where a column is shorter."""
    lines = [separator.join(f'"{label}"' for label in ("Time (s)", *labels))]
    for row in np.column_stack([time, values]):
        cells = [f"{cell:.9E}" for cell in row]
        lines.append(separator.join(cells).replace(".", decimal))
    lines.append(separator.join(["NaN"] * (1 + len(labels))))
    return "\n".join(lines) + "\n"


def axes(name, unit):
    return [f"{name} {axis} ({unit})".strip() for axis in "xyz"]


def phyphox_sets(seconds=SECONDS):
    """Set -> (stamps, values, labels) of an experiment of gyroscope and accelerometer."""
    time = clock(seconds)
    later = time + DELAY
    return {
        "Gyroscope": (time, known_walk.rate(time), axes("Gyroscope", "rad/s")),
        "Accelerometer": (later, known_walk.force(later), axes("Acceleration", "m/s^2")),
    }


def phyphox(separator=",", decimal=".", sets=None):
    members = {
        f"{name}.csv": phyphox_table(*entry, separator, decimal)
        for name, entry in (sets or phyphox_sets()).items()
    }
    members["meta/time.csv"] = '"event","experiment time","system time","system time text"\n'
    return members


def zipped(path, members):
    if isinstance(path, Path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in members.items():
            archive.writestr(name, text)
    return path


def workbooks(folder, sets):
    """walk.xlsx and walk.xls of phyphox, with a sheet of metadata."""
    new, old = openpyxl.Workbook(), xlwt.Workbook()
    new.remove(new.active)
    tables = {
        name: [["Time (s)", *labels], *np.column_stack([time, values]).tolist(), ["NaN"] * 4]
        for name, (time, values, labels) in sets.items()
    }
    for name, rows in (tables | {"Metadata Device": [["property", "value"]]}).items():
        sheet, other = new.create_sheet(name), old.add_sheet(name)
        for number, row in enumerate(rows):
            sheet.append(row)
            for column, cell in enumerate(row):
                other.write(number, column, cell)
    new.save(folder / "walk.xlsx")
    old.save(str(folder / "walk.xls"))


def unpacked(folder, members):
    for name, text in members.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    return folder


def lying_zip(members, name, announced):
    """A zip one of whose members says that it has `announced` bytes."""
    buffer = io.BytesIO()
    zipped(buffer, members)
    data, size = buffer.getvalue(), len(members[name].encode()).to_bytes(4, "little")
    assert data.count(size) == 2  # in the member's own header and in the directory
    return data.replace(size, announced.to_bytes(4, "little"))
