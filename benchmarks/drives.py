"""A car's filter on recorded drives: the states of its mounting, and the way through a gap of its
fixes.

    python -m benchmarks.drives --data-root DIR [--dataset onavdata] [--axes 0 0 3.1416]
        [--gap 30] [--before 30] [--draws 3] [--only states gap]

Neither part has a network, and nothing is fitted.

- "states": `t_rel` of every drive with the filter of `configs/drive.yaml` and other states of the
  mounting and the lever. With the reference's pose and velocity at the start and the bounds of rest
  and the biases of `START` and `REST`, once with the axes of `--axes` (yaw, pitch and roll of the
  IMU in the car, rad) and once with the mounting of `find_mounting`; and as `gnio track --carrier
  car` estimates it, without the reference.
- "gap": fixes are made of the reference, one a second, with errors of `FIX_STD` on each axis that
  change in `FIX_SECONDS`. Those of one gap are left out: of the gap with the longest way that
  begins at least `--before` seconds after the start. Printed is the error at its end of the way
  through it, the mean of some draws, and without a gap the median distance to the truth after a
  shift.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from gnio_jax import data  # noqa: E402
from gnio_jax.apps.drive import estimate_drive, load_filter  # noqa: E402
from gnio_jax.config import TrainConfig  # noqa: E402
from gnio_jax.data.geodesy import Place, geodetic  # noqa: E402
from gnio_jax.data.sensors import GNSS  # noqa: E402
from gnio_jax.errors import InputError  # noqa: E402
from gnio_jax.evaluation import estimate, no_displacements, prepare  # noqa: E402
from gnio_jax.evaluation.metrics import t_rel  # noqa: E402
from gnio_jax.filtering import find_mounting, make_filter  # noqa: E402
from gnio_jax.types import Readings  # noqa: E402
from gnio_jax.types import Sequence as Recording  # noqa: E402

KITTI_STATES = {"mounting_std": 0.005, "mounting_seconds": 20.0, "lever_std": 0.5}
"""The states that KITTI's drives show, with all of their numbers (`configs/drive.yaml`)."""
STATES: dict[str, dict[str, float]] = {
    "no states": {},
    "mounting of 0.01 rad, constant": {"mounting_std": 0.01},
    "lever of 1 m": {"lever_std": 1.0},
    "both": {"mounting_std": 0.01, "lever_std": 1.0},
    "mounting of 0.005 rad over 20 s, lever of 0.5 m": KITTI_STATES,
}
"""States of the mounting and the lever: rad, s and m."""
START = {"tilt": 0.0034, "velocity": 0.08, "gyro_bias": 1.1e-4, "accel_bias": 0.06}
"""Standard deviations of a start at the reference: rad, m/s, rad/s and m/s²."""
REST = {"rest_gyro": 0.002, "rest_accel": 0.1, "rest_seconds": 1.0}
"""Bounds of rest there: rad/s, m/s² and s."""
FIX_STD, FIX_SECONDS = 3.0, 20.0
"""Standard deviation of a fix on each axis, m, and the time constant of its errors, s."""
ORIGIN = Place(45.0, -93.0, 250.0)
"""Where the drives are put on the earth."""


def with_states(config: TrainConfig, states: dict[str, float], **others: float) -> TrainConfig:
    """The configuration of a car's filter with these states, and with other numbers of the
    constraint."""
    constraint = config.filter.measurements["nonholonomic"] or {}
    numbers = {name: value for name, value in constraint.items() if name not in KITTI_STATES}
    changed = {"nonholonomic": {**numbers, **states, **others}}
    measurements = {**config.filter.measurements, **changed}
    settings = dataclasses.replace(config.filter, measurements=measurements)
    return dataclasses.replace(config, filter=settings)


def error_from_reference(drive: Recording, config: TrainConfig) -> float:
    """`t_rel` of a drive, %, from the reference's pose and velocity at its start."""
    start = config.filter.start._replace(**START)
    settings = dataclasses.replace(config.filter, start=start, **REST)
    ekf = make_filter(config.data, settings)
    (ready,), _ = prepare([drive], config.data, ekf)
    (path,) = estimate([ready], [no_displacements(ready)], config.data, ekf, 1)
    return t_rel(path.trajectory, path.reference, config.data.stride_seconds)


def tracked_error(drive: Recording, config: TrainConfig) -> float:
    """`t_rel` of a drive, %, as `gnio track --carrier car` estimates it without fixes."""
    path = estimate_drive(drive, {}, config).estimate
    return t_rel(path.trajectory, path.reference, config.data.stride_seconds)


def make_fixes(drive: Recording, seed: int) -> Readings:
    """One fix a second of the trusted reference, with errors that last."""
    rng = np.random.default_rng(seed)
    time = np.arange(np.ceil(drive.time[0]), drive.time[-1])
    rows = np.searchsorted(drive.time, time)
    time, rows = time[drive.valid[rows]], rows[drive.valid[rows]]
    memory = np.exp(-1.0 / FIX_SECONDS)
    error = FIX_STD * rng.standard_normal((len(time), 3))
    for i in range(1, len(time)):
        error[i] = memory * error[i - 1] + np.sqrt(1 - memory**2) * error[i]
    places = geodetic(drive.position[rows] + error, ORIGIN)
    return Readings(time, places, np.full(places.shape, FIX_STD))


class Gap(NamedTuple):
    """A time without fixes."""

    seconds: float
    before: float
    """Time before it at least, s."""


def longest_gap(drive: Recording, fixes: Readings, gap: Gap) -> tuple[int, int]:
    """The last fix before the gap with the longest way, and the first one after it."""
    position = drive.position[np.searchsorted(drive.time, fixes.time)]
    travelled = np.cumsum(np.linalg.norm(np.diff(position, axis=0, prepend=position[:1]), axis=1))
    first = np.flatnonzero(fixes.time >= drive.time[0] + gap.before)
    last = np.searchsorted(fixes.time, fixes.time[first] + gap.seconds)
    first, last = first[last < len(fixes.time)], last[last < len(fixes.time)]
    if not len(first):
        problem = f"is too short for a gap of {gap.seconds:g} s after {gap.before:g} s"
        raise InputError(drive.name, problem, "give a smaller --gap or --before")
    longest = int(np.argmax(travelled[last] - travelled[first]))
    return int(first[longest]), int(last[longest])


def error_through_gap(
    drive: Recording, config: TrainConfig, gap: Gap, seed: int
) -> tuple[float, float]:
    """The error of the way through the longest gap and the length of the way, m."""
    fixes = make_fixes(drive, seed)
    first, last = longest_gap(drive, fixes, gap)
    outside = np.r_[: first + 1, last : len(fixes.time)]
    readings = Readings(*(column[outside] for column in fixes))
    path = estimate_drive(drive, {GNSS: readings}, config).estimate
    time = path.trajectory.time
    # The path ends in the last row before the next fix, which corrects it.
    ends = np.searchsorted(time, fixes.time[[first, last]])
    ends[1] -= 1
    estimated, true = (
        np.diff(trajectory.position[ends], axis=0)[0]
        for trajectory in (path.trajectory, path.reference)
    )
    between = slice(ends[0], ends[1] + 1)
    steps = np.linalg.norm(np.diff(path.reference.position[between], axis=0), axis=1)
    return float(np.linalg.norm((estimated - true)[:2])), float(steps.sum())


def distance_without_gap(drive: Recording, config: TrainConfig, seed: int) -> float:
    """Median distance in the plane to the truth with all fixes, after the best shift, m."""
    path = estimate_drive(drive, {GNSS: make_fixes(drive, seed)}, config).estimate
    error = (path.trajectory.position - path.reference.position)[:, :2]
    error = error[np.isfinite(error).all(1)]
    return float(np.median(np.linalg.norm(error - error.mean(0), axis=1)))


def print_states(drives: Sequence[Recording], config: TrainConfig, axes: Sequence[float]) -> None:
    print(f"t_rel, %: with the axes {tuple(axes)}, with those of find_mounting, and as a track")
    for drive in drives:
        rate = 1.0 / float(np.median(np.diff(drive.time)))
        mounting = find_mounting(drive.gyro, drive.accel, rate, drive.name)
        for name, states in STATES.items():
            errors = [
                error_from_reference(
                    drive, with_states(config, states, yaw=yaw, pitch=pitch, roll=roll)
                )
                for yaw, pitch, roll in (axes, mounting[:3])
            ]
            errors.append(tracked_error(drive, with_states(config, states)))
            print(f"{drive.name}: {name}: {', '.join(f'{e:.2f}' for e in errors)}", flush=True)


def print_gaps(drives: Sequence[Recording], config: TrainConfig, gap: Gap, draws: int) -> None:
    print(f"way through a gap of {gap.seconds:g} s; without a gap: median distance; {draws} draws")
    for drive in drives:
        for name, settings in (("states", config), ("no states", with_states(config, {}))):
            rows = [error_through_gap(drive, settings, gap, seed) for seed in range(draws)]
            errors, length = np.array([row[0] for row in rows]), rows[0][1]
            words = f"{errors.mean():.1f} m ({errors.min():.1f} to {errors.max():.1f})"
            share = f"{100 * errors.mean() / length:.1f} % of {length:.0f} m"
            distance = np.mean([distance_without_gap(drive, settings, s) for s in range(draws)])
            print(f"{drive.name}: {name}: {words}, {share}; {distance:.1f} m", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--dataset", default="onavdata")
    parser.add_argument("--data-root", help="its folder, as for gnio evaluate")
    parser.add_argument("--split", default="test")
    parser.add_argument("--axes", type=float, nargs=3, default=[0.0, 0.0, np.pi])
    parser.add_argument("--gap", type=float, default=30.0, help="length of the gap, s")
    parser.add_argument("--before", type=float, default=30.0, help="least time before it, s")
    parser.add_argument("--draws", type=int, default=3, help="draws of the fixes' errors")
    parser.add_argument("--only", nargs="+", choices=["states", "gap"], default=["states", "gap"])
    arguments = parser.parse_args()
    config = load_filter("car")
    drives = list(data.load(arguments.dataset, arguments.data_root, arguments.split))
    if "states" in arguments.only:
        print_states(drives, config, arguments.axes)
    if "gap" in arguments.only:
        print_gaps(drives, config, Gap(arguments.gap, arguments.before), arguments.draws)


if __name__ == "__main__":
    main()
