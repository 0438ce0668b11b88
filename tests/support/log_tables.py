"""Tables as boards, phones and their apps write them, of the known walk: 14 s at 100 Hz.

`table` gives the text of one; what is not stated is ours: s, rad/s, m/s², commas, our names.
"""

import numpy as np

from tests.support.csv_writers import AXES, imu

COUNT = 1400
TIME = np.arange(COUNT) / 100
ROWS = np.arange(COUNT)
WALK = imu(TIME)
HEADER = ("time", *AXES)
G = 9.80665


def table(
    stamps=None,
    header=HEADER,
    gyro=1.0,
    accel=1.0,
    separator=",",
    values=None,
    digits=6,
    order=None,
):
    """A header (none if it is empty) and a row for each of the `stamps`, which are written as they
    are. `order` gives the columns of the IMU in the file, `values` other ones than the walk's."""
    stamps = [f"{stamp:.3f}" for stamp in TIME] if stamps is None else stamps
    values = (WALK if values is None else values) * np.repeat([gyro, accel], 3)
    values = values[:, order] if order is not None else values
    rows = [
        separator.join([str(stamp), *(f"{value:.{digits}f}" for value in row)])
        for stamp, row in zip(stamps, values, strict=True)
    ]
    return lines(*([separator.join(header)] if header else []), *rows)


def lines(*parts):
    return "\n".join(parts) + "\n"


def rows(text):
    """The lines of a table: its header, its rows."""
    header, *others = text.splitlines()
    return header, others


def by_sensor(name, stamps, values, separator=","):
    """Rows of one sensor that begin with its `name`."""
    return [
        separator.join([name, *stamp, *(f"{value:.6f}" for value in row)])
        for stamp, row in zip(stamps, values, strict=True)
    ]


def interleaved(*groups):
    """The rows of several sensors in turn."""
    return [row for step in zip(*groups, strict=True) for row in step]


def clock_text(milliseconds, pattern):
    """Times of day, such as "{h:02d}:{m:02d}:{s:02d}.{ms:03d}"."""
    texts = []
    for stamp in milliseconds:
        seconds, ms = divmod(int(stamp), 1000)
        h, m, s = seconds // 3600 % 24, seconds // 60 % 60, seconds % 60
        texts.append(pattern.format(h=h, m=m, s=s, ms=ms, minutes=seconds // 60))
    return texts
