"""What a stream does not say about itself: its rate, the unit and the sign of its accelerometer,
whether its gyro and its accelerometer belong together, and whether somebody walks."""

from __future__ import annotations

import itertools
import re
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.apps.importing import units
from gnio_jax.apps.live.clock import LONGEST_INTERVAL
from gnio_jax.apps.live.samples import Arrival, Sample, is_missing
from gnio_jax.data import physics
from gnio_jax.data.gait import detect_gait
from gnio_jax.data.parsing.stamps import RATES, is_rate
from gnio_jax.errors import InputError

FIRST_SECONDS = 1.0
"""The rate of a stream is measured over this time, s."""
FIRST_SAMPLES = 21
"""Smallest number of samples from which the rate is measured, and the units of accelerometer and
stamps are recognised (ours)."""
MOST_HELD = 20_000
"""Number of samples after which the first second must be over, at any rate of an IMU."""
SECONDS_WITHOUT_A_SENSOR = 10.0
"""Time from the start without a sample of both sensors after which one of them counts as not sent,
or as sent by another name, s (ours)."""
RATE_SHARE = 0.75
"""Smallest ratio of a stated rate to the measured one, and of the measured one to it (ours)."""
TURNING_SECONDS = (8.0, 16.0, 32.0, 64.0)
"""Times after which the rotation of gravity is compared with the gyro, s (ours)."""

GAIT_SECONDS, GAIT_EVERY = 40.0, 10.0
"""Steps are looked for in the newest 40 s, every 10 s (ours)."""
GAIT_RATE = 50.0
"""Rate at which the samples are given to `detect_gait`, Hz."""
MOSTLY_QUIET = 0.5
"""Share of quiet seconds from which a stream without steps is a rest (ours)."""


class Nature(NamedTuple):
    """What is known about the samples of a source."""

    name: str
    imu_rate: float | None = None
    """Stated rate, Hz."""
    sign: str | None = None
    """Sign of the accelerometer: android, ios or detect (`units.with_sign`); None: Android's is
    assumed."""
    needs: str = "send the gyro (gyro) and the accelerometer (accel)"
    """What to do if one sensor does not come."""
    gyro_unit: str = "rad/s"
    """Unit as which the gyro was read."""


def with_measured_rate(
    arrivals: Iterator[Arrival], nature: Nature, begin: Callable[[float], None]
) -> Iterator[Arrival]:
    """Hold back the samples of the first second, measure their rate, Hz, and call `begin` with it;
    then pass all samples on, with Android's sign.

    Raises `InputError` while it runs, if the stamps are not in seconds, if the stated rate is
    wrong, if the accelerometer of a device at rest does not read gravity, or if after eight
    seconds, or later, gravity does not turn as the gyro does. Where there is only a doubt, it
    yields a notice, and so it does where a moving device shows no steps, and where they return.
    """
    held: list[Arrival] = []
    samples: list[Sample] = []
    complete = 0
    for arrival in arrivals:
        if arrival.sample is None:
            yield arrival
            continue
        held.append(arrival)
        samples.append(arrival.sample)
        complete += arrival.sample.whole
        seconds = samples[-1].time - samples[0].time
        if seconds >= FIRST_SECONDS and complete >= FIRST_SAMPLES:
            break
        if seconds >= SECONDS_WITHOUT_A_SENSOR or len(samples) >= MOST_HELD:
            break
        yield Arrival(arrival.clock, waiting=_first_second(samples, seconds, nature))
    whole = [sample for sample in samples if sample.whole]
    sign, notices = 1.0, list[str]()
    if len(samples) >= FIRST_SAMPLES:
        begin(_rate_of(np.array([sample.time for sample in samples]), nature))
    if len(whole) >= FIRST_SAMPLES:
        sign = _sign_of(np.array([sample.accel for sample in whole]), nature, notices)
    for notice in notices:
        yield Arrival(held[-1].clock, notice=notice)
    watches = _Turning(nature), _Steps()
    for arrival in itertools.chain(held, arrivals):
        if (sample := arrival.sample) is not None:
            x, y, z = (sign * axis for axis in sample.accel)
            arrival = arrival._replace(sample=sample._replace(accel=(x, y, z)))
            for watch in watches:
                yield from watch.notices(arrival)
        yield arrival


def _first_second(samples: list[Sample], seconds: float, nature: Nature) -> str:
    """What is needed before the rate and the units are known."""
    if seconds < FIRST_SECONDS:
        return f"a second of samples: {seconds:.1f} s have come"
    has_gyro = not all(is_missing(sample.gyro) for sample in samples)
    has_accel = not all(is_missing(sample.accel) for sample in samples)
    if has_gyro and has_accel:
        return "samples with both sensors"
    return f"the {'accelerometer' if has_gyro else 'gyro'}: {nature.needs}"


def _rate_of(stamps: Float[np.ndarray, " n"], nature: Nature) -> float:
    interval = float(np.median(np.diff(stamps)))
    problem = f"its samples come {interval:g} s apart by their stamps"
    if interval > LONGEST_INTERVAL:
        raise InputError(nature.name, problem, "stamps must be in seconds, not in ms")
    rate = 1 / interval if interval > 0 else np.inf
    if not is_rate(rate):
        problem = f"its samples come at {rate:.4g} Hz by their stamps"
        remedy = f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz: stamps must be in seconds"
        raise InputError(nature.name, problem, remedy)
    return stated_rate(rate, nature)


def stated_rate(rate: float, nature: Nature) -> float:
    """The stated rate, or else the `rate` of the stamps, Hz. Raises `InputError` if both differ."""
    stated = nature.imu_rate
    if stated and not RATE_SHARE < stated / rate < 1 / RATE_SHARE:
        problem = f"its samples come at {rate:.4g} Hz by their stamps"
        raise InputError(nature.name, problem, f"leave out --imu-rate {stated:g}: it is measured")
    return stated or rate


def _sign_of(accel: Float[np.ndarray, "n 3"], nature: Nature, notices: list[str]) -> float:
    """1, or −1 for iOS's sign. Raises `InputError` if gravity is not in m/s²."""
    size = float(np.median(np.linalg.norm(accel, axis=1)))
    ranges = units.GRAVITY_RANGES.items()
    looks = [unit for unit, (least, most) in ranges if least <= size <= most]
    if looks != ["m/s2"]:
        problem = f"its accelerometer reads {size:.3g} m/s² at the start, and gravity is 9.81"
        names = ", ".join(units.TO_METRES_PER_SECOND_SQUARED)
        remedy = f"give --accel-unit {looks[0]}" if looks else f"give its --accel-unit: {names}"
        raise InputError(nature.name, problem, f"{remedy}; gravity must be in it")
    sign = nature.sign or "android"
    signed = units.with_sign(accel, sign, Path(nature.name), notices)
    gravity = np.median(signed, axis=0)
    if nature.sign is None and np.argmin(gravity) == 2 and gravity[2] < -np.abs(gravity[:2]).max():
        problem = "gravity reads on -z: the screen points down, or this is iOS's sign and the path"
        notices.append(f"warning: sign: {problem} is wrong: compare with --accel-sign ios")
    return -1.0 if (signed * accel).sum() < 0 else 1.0


def _for_streams(remedy: str) -> str:
    """The remedy for a recording without the options of an import, which a stream does not have."""
    remedy = re.sub(r",? (or|as by) --columns.*", "", remedy)
    remedy = re.sub(r"give --time-unit.*", "stamps must be in seconds", remedy)
    return re.sub(r" as by --gyro-unit (?!deg/s$).*", " or send it in rad/s", remedy)


class _Turning:
    """Compares the rotation of gravity with the gyro, until it is certain or a minute is over."""

    def __init__(self, nature: Nature):
        self._nature, self._due = nature, list(TURNING_SECONDS)
        self._rows = list[tuple[float, ...]]()

    def notices(self, arrival: Arrival) -> Iterator[Arrival]:
        """Warnings, after each of `TURNING_SECONDS`. Raises `InputError` for a contradiction."""
        sample = arrival.sample
        if not self._due or sample is None or not sample.whole:
            return
        self._rows.append((sample.time, *sample.gyro, *sample.accel))
        if sample.time - self._rows[0][0] < self._due[0]:
            return
        self._due.pop(0)
        rows = np.array(self._rows)
        imu = physics.ImuSamples(rows[:, 0] - rows[0, 0], rows[:, 1:4], rows[:, 4:7])
        name, unit = self._nature.name, self._nature.gyro_unit
        warnings = physics.check_turning(imu, name, _for_streams, unit)
        yield from (Arrival(arrival.clock, notice=f"warning: {text}") for text in warnings)
        if warnings or physics.is_supported(*physics.agreement(imu)):
            self._due.clear()
        if not self._due:
            self._rows.clear()


class _Steps:
    """Looks for steps in the newest samples. A network reads the path from them."""

    def __init__(self) -> None:
        self._rows, self._due, self._walks = deque[tuple[float, ...]](), np.nan, True

    def notices(self, arrival: Arrival) -> Iterator[Arrival]:
        """A warning where a moving device no longer shows steps, and a message where it does
        again."""
        sample = arrival.sample
        if sample is None or not sample.whole:
            return
        self._rows.append((sample.time, *sample.gyro, *sample.accel))
        while sample.time - self._rows[0][0] > GAIT_SECONDS:
            self._rows.popleft()
        if np.isnan(self._due):
            self._due = sample.time + GAIT_SECONDS
        if sample.time < self._due:
            return
        self._due = sample.time + GAIT_EVERY
        walks = _walks(np.array(self._rows))
        if self._walks and not walks:
            problem = f"no steps in the last {GAIT_SECONDS:.0f} s. In a vehicle or on a trolley the"
            text = f"warning: no walk: {problem} path is wrong, and no covariance shows it"
            yield Arrival(arrival.clock, notice=text)
        elif walks and not self._walks:
            yield Arrival(arrival.clock, notice="there are steps again")
        self._walks = walks


def _walks(rows: Float[np.ndarray, "n 7"]) -> bool:
    """Whether somebody walks or rests: rows of time (s), gyro and accel."""
    grid = np.arange(rows[0, 0], rows[-1, 0], 1 / GAIT_RATE)
    signals = np.stack([np.interp(grid, rows[:, 0], signal) for signal in rows[:, 1:].T], axis=1)
    gait = detect_gait(signals[:, :3], signals[:, 3:], GAIT_RATE)
    return gait.has_steps or bool(gait.quiet.mean() > MOSTLY_QUIET)
