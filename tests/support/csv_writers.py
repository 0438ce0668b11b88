"""Recordings as CSV."""

import numpy as np

from tests.support import known_walk

AXES = ("gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z")

SECONDS = 14.0


def imu(time):
    return np.concatenate([known_walk.rate(time), known_walk.force(time)], axis=1)


def pose(time):
    x, y, z, w = known_walk.attitude(time).as_quat().T
    return np.concatenate([np.stack([w, x, y, z], axis=1), known_walk.position(time)], axis=1)


def write(path, names, columns, separator=",", head="", style="%.9f"):
    """Columns of numbers; integers are written as such, NaN as nothing."""

    def text(value):
        return ("" if value != value else style % value) if isinstance(value, float) else str(value)

    path.parent.mkdir(parents=True, exist_ok=True)
    rows = zip(*(np.asarray(column).tolist() for column in columns), strict=True)
    lines = [separator.join(names), *(separator.join(map(text, row)) for row in rows)]
    path.write_text(head + "\n".join(lines) + "\n")
    return path


def write_native(path, time=None, reference=True, spoil=None, drop=(), velocity=False):
    """`spoil(columns)` may damage the columns by name; `drop` leaves some out."""
    time = np.arange(round(SECONDS * 100)) / 100 if time is None else time
    columns = {
        "time": time + 100.0,
        "temperature": 0 * time + 30.0,
        **dict(zip(AXES, imu(time).T, strict=True)),
    }
    if reference:
        columns |= dict(zip(("qw", "qx", "qy", "qz", "px", "py", "pz"), pose(time).T, strict=True))
    if velocity:
        columns |= dict(zip(("vx", "vy", "vz"), known_walk.velocity(time).T, strict=True))
    if spoil:
        spoil(columns)
    names = [name for name in sorted(columns, reverse=True) if name not in drop]
    return write(path, names, [columns[name] for name in names])


def compare_imu(sequence, start=0.0, atol=1e-3):
    """The IMU is that of the known walk, which began at `start` s."""
    reference = imu(sequence.time + start)
    np.testing.assert_allclose(sequence.gyro, reference[:, :3], atol=atol)
    np.testing.assert_allclose(sequence.accel, reference[:, 3:], atol=atol)
