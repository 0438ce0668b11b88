"""Writes the known walk as KITTI's native files: OXTS packets with the traps of the published
drives, and npz pieces.

The earth is the sphere of KITTI's own projection; a few metres from the origin east and north are
arcs on it to a micrometre, whatever the projection.
"""

import numpy as np

from tests.support import known_walk

RADIUS = 6378137.0
HOME = (49.015, 8.434, 116.4)
START = np.datetime64("2011-09-26T13:02:25.594360375", "ns")


def packets(time):
    """(n, 30) values of the packets at times (s)."""
    position = known_walk.position(time)
    latitude = HOME[0] + np.degrees(position[:, 1] / RADIUS)
    longitude = HOME[1] + np.degrees(position[:, 0] / (RADIUS * np.cos(np.radians(HOME[0]))))
    yaw, pitch, roll = known_walk.attitude(time).as_euler("ZYX").T
    east, north, up = known_walk.velocity(time).T
    heading = np.stack([np.cos(yaw), np.sin(yaw)])
    forward, left_speed = (
        heading[0] * east + heading[1] * north,
        heading[0] * north - heading[1] * east,
    )
    # Accelerations and rates in the level frame: not what is asked for.
    level = np.full((3, len(time)), 7.7)
    accuracy = np.tile([[0.05], [0.01], [4], [9], [4], [4], [0]], len(time))
    rows = [latitude, longitude, HOME[2] + position[:, 2], roll, pitch, yaw]
    rows += [north, east, forward, left_speed, up, *known_walk.force(time).T, *level]
    return np.stack([*rows, *known_walk.rate(time).T, *level, *accuracy], axis=1)


def stamp(seconds):
    return str(START + np.timedelta64(round(seconds * 1e9), "ns")).replace("T", " ")


def write_rows(oxts, stamps, values):
    (oxts / "data").mkdir(parents=True)
    (oxts / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    style = " ".join(["%.15g"] * values.shape[1]) + "\n"
    for row, line in enumerate(values.tolist()):
        (oxts / "data" / f"{row:010d}.txt").write_text(style % tuple(line))
    return oxts


def write_drive(root, drive, seconds=12.0, export="extract", rate=100.0):
    """A drive without traps."""
    time = np.arange(round(seconds * rate)) / rate
    oxts = root / drive[:10] / f"{drive}_{export}" / "oxts"
    return write_rows(oxts, [stamp(t) for t in time], packets(time))


def write_published(root, drive):
    """A drive of 16 s with every trap; returns its folder and the times at which its two pieces
    begin and end.

    Stamps jitter by a millisecond; rows change places; one row is there twice; one carries the
    stamp of its predecessor; single packets are lost; one packet has no stamp; 0.3 s are missing
    after 6 s, and 0.2 s before a last piece of 1.5 s.
    """
    noise = np.random.default_rng(5)
    time = np.arange(1600) / 100 + noise.uniform(-1e-3, 1e-3, 1600)
    time[0] = 0.0
    time = np.delete(time, [*range(600, 630), 200, 900, *range(1430, 1450)])
    first = time[0], time[time < 5.995].max()
    pieces = np.array([*first, time[time > 6.1].min(), time[time < 14.295].max()])
    written = time.copy()
    written[301] = written[300]  # its values are its own, its stamp is not
    order = np.arange(len(time))
    for row in range(50, len(time) - 5, 110):
        order[[row, row + 3]] = order[[row + 3, row]]
    order = np.insert(order, 400, order[400])
    stamps = [stamp(t) for t in written[order]]
    stamps[700] = ""
    oxts = root / drive[:10] / f"{drive}_extract" / "oxts"
    return write_rows(oxts, stamps, packets(time[order])), pieces


def write_piece(path, spoil=None, first=25.0, seconds=12.0):
    """An npz piece in single precision; `spoil(arrays)` may damage the arrays."""
    time = first + np.arange(round(seconds * 100)) / 100
    yaw, pitch, roll = known_walk.attitude(time).as_euler("ZYX").T
    arrays = {"t": time, "t0": np.array(first), "ang_gt": np.stack([roll, pitch, yaw], axis=1)}
    arrays |= {"p_gt": known_walk.position(time), "v_gt": known_walk.velocity(time)}
    arrays["u"] = np.concatenate([known_walk.rate(time), known_walk.force(time)], axis=1)
    arrays = {name: values.astype(np.float32) for name, values in arrays.items()}
    if spoil:
        spoil(arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, allow_pickle=True, **arrays)
    return path
