"""Walks of everybody: gait and carrying are drawn from wide ranges (domain randomisation).

`gait` has a few people who walk by one formula. A network that has learnt from them alone fails on
a real hand, where arm and grip damp the harmonics of the trunk. Here the amplitude and the phase of
every harmonic, the blow of the heel and the swing of the phone are drawn for each walk. What is
left for a network to rely on is what all walkers share: bounce and cadence grow with the speed, and
the trunk is fastest where it is lowest, which tells forward from backward. In a run it is slowest
there.

The ranges are ours. The trunk follows the inverted pendulum (Zijlstra & Hof, 2003). How much of its
motion reaches a hand, a pocket and a bag, and how hard the heel strikes there, was set so that the
spectra of the simulated accelerations cover those of OxIOD's training and validation sessions. No
network learns from these.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.readers.gait import (
    STANDING_START,
    Plan,
    integral,
    smooth_steps,
    step_frequency,
    wander,
)
from gnio_jax.data.readers.simulated_phone import Motion, SensorErrors, motion

Range = tuple[float, float]
Ranges = tuple[Range, Range, Range]
Wave = Callable[[np.ndarray], np.ndarray]


class Carrying(NamedTuple):
    """How a phone is carried, as ranges to draw from. Three ranges are forward, left, up, or roll,
    pitch, yaw. Accelerations and rates are root mean squares in a slow walk (`_STEP`, `_CADENCE`).
    """

    share: float
    """Probability."""
    surge: Range
    """Gain of the trunk's fore-aft motion at step frequency."""
    surge_phase: Range
    """Mean and standard deviation of its phase against the inverted pendulum, rad."""
    bounce: Range
    """Gain of the trunk's vertical motion at step frequency."""
    harmonics: Range
    """Acceleration at twice the step frequency against that at step frequency."""
    stride: Ranges
    """Acceleration at stride frequency, m/s²."""
    strike: Range
    """Acceleration of the blow of the heel, m/s²."""
    stride_rate: Ranges
    """Angular rate at stride frequency, rad/s."""
    step_rate: Ranges
    """Angular rate at step frequency, rad/s."""
    grip: Range
    """Slow wandering of the attitude, rad."""
    tilt: Range
    """Rotation about the phone's x axis (its short side), rad: 0 is screen up, π/2 upright."""
    turned: float
    """Probability that the tilt is the negative one (upside down in a pocket)."""
    roll: float
    """Standard deviation of the rotation about the phone's y axis, rad."""
    lever: Ranges
    """From the walker's axis to the phone, m; left is the side of the phone."""


CARRYING = {
    "handheld": Carrying(
        share=0.4,
        surge=(0.4, 1.1),
        surge_phase=(-0.2, 0.25),
        bounce=(0.7, 1.6),
        harmonics=(0.05, 0.5),
        stride=((0.05, 0.35), (0.2, 0.6), (0.02, 0.2)),
        strike=(0.05, 0.4),
        stride_rate=((0.02, 0.3), (0.02, 0.3), (0.02, 0.3)),
        step_rate=((0.02, 0.25), (0.02, 0.3), (0.02, 0.15)),
        grip=(0.03, 0.15),
        tilt=(-0.1, 1.3),
        turned=0.0,
        roll=0.2,
        lever=((0.1, 0.4), (-0.1, 0.2), (0.0, 0.3)),
    ),
    "pocket": Carrying(
        share=0.25,
        surge=(0.8, 2.2),
        surge_phase=(-0.2, 0.35),
        bounce=(0.6, 1.7),
        harmonics=(0.3, 0.9),
        stride=((0.1, 0.6), (0.2, 0.7), (0.05, 0.35)),
        strike=(0.3, 2.2),
        stride_rate=((0.1, 0.7), (0.3, 1.2), (0.1, 0.8)),
        step_rate=((0.05, 0.5), (0.1, 0.6), (0.05, 0.5)),
        grip=(0.01, 0.06),
        tilt=(1.0, 2.1),
        turned=0.5,
        roll=0.35,
        lever=((-0.1, 0.15), (0.1, 0.2), (-0.3, 0.0)),
    ),
    "bag": Carrying(
        share=0.2,
        surge=(0.05, 1.2),
        surge_phase=(0.0, 1.0),
        bounce=(0.7, 1.7),
        harmonics=(0.1, 0.9),
        stride=((0.1, 1.0), (0.1, 0.6), (0.05, 0.5)),
        strike=(0.1, 1.5),
        stride_rate=((0.05, 0.6), (0.05, 0.8), (0.05, 0.6)),
        step_rate=((0.02, 0.4), (0.02, 0.4), (0.02, 0.3)),
        grip=(0.02, 0.12),
        tilt=(-3.1, 3.1),
        turned=0.0,
        roll=0.5,
        lever=((-0.2, 0.1), (0.05, 0.3), (-0.5, 0.1)),
    ),
    "chest": Carrying(
        share=0.15,
        surge=(0.7, 1.2),
        surge_phase=(-0.1, 0.2),
        bounce=(0.8, 1.4),
        harmonics=(0.2, 0.8),
        stride=((0.03, 0.2), (0.15, 0.5), (0.02, 0.15)),
        strike=(0.1, 1.0),
        stride_rate=((0.02, 0.3), (0.02, 0.2), (0.05, 0.4)),
        step_rate=((0.02, 0.2), (0.02, 0.3), (0.02, 0.2)),
        grip=(0.01, 0.04),
        tilt=(1.2, 1.8),
        turned=0.2,
        roll=0.15,
        lever=((0.05, 0.2), (-0.1, 0.1), (0.1, 0.3)),
    ),
}
"""How phones are carried, by name."""

_STEP, _CADENCE = 0.55, 1.5
"""Step length (m) and step frequency (Hz) of the slow walk that the amplitudes belong to."""

_ACTIVITIES = {
    "walk": (0.60, (0.5, 1.7), (5.0, 25.0), 0.0, 0.0),
    "stroll": (0.08, (0.2, 0.5), (4.0, 10.0), 0.0, 0.0),
    "run": (0.12, (1.0, 3.2), (5.0, 15.0), 0.0, 1.0),
    "stand": (0.10, (0.0, 0.0), (3.0, 8.0), 0.0, 0.0),
    "upstairs": (0.05, (0.4, 0.65), (5.0, 10.0), 0.6, 0.0),
    "downstairs": (0.05, (0.45, 0.7), (5.0, 10.0), -0.6, 0.0),
}
"""(probability, speed range m/s, duration range s, rise per metre, share of a run)."""


class _Course(NamedTuple):
    planned: Plan
    running: Float[np.ndarray, " n"]
    """0 walks, 1 runs."""


def random_motion(
    rng: np.random.Generator, carried: Carrying, time: Float[np.ndarray, " n"], dt: float
) -> Motion:
    """The motion of a phone on a walk of which everything is drawn; `time` (s) is uniform with the
    step `dt`."""
    planned, running = _course(rng, time, dt)
    walking = step_frequency(planned.speed, rng.uniform(0.86, 1.16))
    hurried = rng.uniform(2.3, 2.8) + 0.1 * planned.speed
    cadence = walking + running * (hurried - walking)
    cadence = cadence * (1.0 + 0.03 * wander(rng, time, 1, 1.0, 0.05, 0.5)[:, 0])
    phase = 2.0 * np.pi * integral(time, cadence) + rng.uniform(0.0, 2.0 * np.pi)
    length = planned.speed / cadence
    offset = _trunk(rng, carried, time, planned, running, length, phase)
    offset = offset + _strides(rng, carried.stride, time, running, length, phase)
    offset = offset + _strikes(rng, carried, dt, length, cadence, phase)
    lever = np.array([rng.uniform(*each) for each in carried.lever])
    lever[1] *= rng.choice([-1.0, 1.0])
    idle = wander(rng, time, 3, rng.uniform(0.001, 0.006), 0.1, 0.8)
    swing = _swing(rng, carried, time, length, phase)
    return motion(time, planned, offset + lever + idle, swing, _mounting(rng, carried))


def random_errors(rng: np.random.Generator) -> SensorErrors:
    """The errors of a phone's IMU, from a good one to a poor one."""
    return SensorErrors(
        gyro_density=_log_uniform(rng, 5e-5, 4e-4),
        accel_density=_log_uniform(rng, 1e-3, 5e-3),
        gyro_bias_walk=_log_uniform(rng, 1e-6, 3e-5),
        accel_bias_walk=_log_uniform(rng, 5e-5, 5e-4),
        gyro_bias=(0.0, 0.01),
        accel_bias=(0.0, 0.25),
    )


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _mounting(rng: np.random.Generator, carried: Carrying) -> Rotation:
    """Phone → forward, left, up. Its yaw is anything: where the phone points is no hint of where
    its owner goes."""
    tilt = rng.uniform(*carried.tilt)
    if rng.random() < carried.turned:
        tilt = -tilt
    roll = np.clip(carried.roll * rng.standard_normal(), -1.0, 1.0)
    return Rotation.from_euler("ZXY", [rng.uniform(-np.pi, np.pi), tilt, roll])


def _course(rng: np.random.Generator, time: Float[np.ndarray, " n"], dt: float) -> _Course:
    """A walk through random activities, round bends and corners."""
    speed, rise, running = (np.zeros_like(time) for _ in range(3))
    names = list(_ACTIVITIES)
    chances = [_ACTIVITIES[name][0] for name in names]
    clock = STANDING_START
    while clock < time[-1]:
        _, speeds, durations, slope, run = _ACTIVITIES[rng.choice(names, p=chances)]
        end = clock + rng.uniform(*durations)
        during = (time >= clock) & (time < end)
        speed[during], rise[during], running[during] = rng.uniform(*speeds), slope, run
        clock = end
    speed = smooth_steps(speed, rng.uniform(1.6, 3.0), dt)
    speed = speed * (1.0 + 0.06 * wander(rng, time, 1, 1.0, 0.05, 0.4)[:, 0])
    turn_rate = smooth_steps(_turn_rate(rng, time), 0.8, dt)
    # At most 2.5 m/s² sideways.
    most = 2.5 / np.maximum(speed, 0.5)
    turn_rate = most * np.tanh(turn_rate / most)
    turn_rate = (
        turn_rate + 0.15 * np.minimum(speed, 1.0) * wander(rng, time, 1, 1.0, 0.05, 0.4)[:, 0]
    )
    heading = integral(time, turn_rate) + rng.uniform(-np.pi, np.pi)
    planned = Plan(speed, heading, smooth_steps(rise, 2.4, dt))
    return _Course(planned, smooth_steps(running, 1.6, dt))


def _turn_rate(rng: np.random.Generator, time: Float[np.ndarray, " n"]) -> np.ndarray:
    """Straight stretches, bends and corners, rad/s."""
    rate = np.zeros_like(time)
    clock = STANDING_START
    while clock < time[-1]:
        side, kind = rng.choice([-1.0, 1.0]), rng.choice(3, p=[0.35, 0.45, 0.2])
        value = (0.0, rng.uniform(0.1, 0.9), rng.uniform(0.8, 1.8))[kind]
        end = clock + (rng.uniform(2.0, 8.0), rng.uniform(2.0, 12.0), rng.uniform(0.8, 2.0))[kind]
        rate[(time >= clock) & (time < end)] = side * value
        clock = end
    return rate


def _trunk(
    rng: np.random.Generator,
    carried: Carrying,
    time: Float[np.ndarray, " n"],
    planned: Plan,
    running: Float[np.ndarray, " n"],
    length: Float[np.ndarray, " n"],
    phase: Float[np.ndarray, " n"],
) -> Float[np.ndarray, "n 3"]:
    """What reaches the phone of the trunk's fore-aft and vertical motion at step frequency, m."""
    bounce = rng.uniform(*carried.bounce) * 0.28 * length**2 / (8.0 * rng.uniform(0.8, 1.0))
    surge = rng.uniform(*carried.surge) * 0.016 * length / 0.7
    mean, std = carried.surge_phase
    # A walker is fastest where the trunk is lowest, a runner is slowest there.
    forward_phase = phase + mean + std * rng.standard_normal() + np.pi * running
    surge = surge * (1.0 - 0.4 * running)
    forward = surge * _harmonics(rng, carried.harmonics, forward_phase, np.sin, 0.6)
    up = bounce * _harmonics(rng, carried.harmonics, phase, lambda x: -np.cos(x), np.pi + 0.4)
    stairs = planned.rise / 0.6
    up = up + 0.02 * stairs * np.sin(phase) + 0.006 * stairs**2 * np.cos(2 * phase)
    varied = 1.0 + 0.08 * wander(rng, time, 2, 1.0, 0.1, 1.0)
    return np.stack([forward * varied[:, 0], np.zeros_like(forward), up * varied[:, 1]], axis=1)


def _harmonics(
    rng: np.random.Generator, ratio: Range, phase: np.ndarray, wave: Wave, second: float
) -> np.ndarray:
    """A wave at step frequency with its second and third harmonic. `ratio` is that of the
    accelerations; the phase of the second harmonic is about `second`."""
    twice, thrice = rng.uniform(*ratio), rng.uniform(*ratio) * rng.uniform(0.0, 0.6)
    start = second + 0.7 * rng.standard_normal()
    anywhere = rng.uniform(0.0, 2.0 * np.pi)
    return (
        wave(phase)
        + twice / 4.0 * wave(2.0 * phase + start)
        + thrice / 9.0 * wave(3.0 * phase + anywhere)
    )


def _growth(length: np.ndarray) -> np.ndarray:
    """Amplitude of a swing against that of the slow walk."""
    return length / (length + 0.5) * (_STEP + 0.5) / _STEP


def _strides(
    rng: np.random.Generator,
    ranges: Ranges,
    time: np.ndarray,
    running: np.ndarray,
    length: np.ndarray,
    phase: np.ndarray,
) -> Float[np.ndarray, "n 3"]:
    """Motion at stride frequency: the sway of the trunk, an arm or a bag that swings, m."""
    accel = np.sqrt(2.0) * np.array([rng.uniform(*each) for each in ranges])
    amplitude = accel / (np.pi * _CADENCE) ** 2
    start = rng.uniform(0.0, 2.0 * np.pi, size=3)
    wave = np.sin(phase[:, None] / 2.0 + start) * (1.0 + 0.1 * wander(rng, time, 3, 1.0, 0.1, 1.0))
    return amplitude * wave * (_growth(length) * (1.0 + 0.5 * running))[:, None]


def _strikes(
    rng: np.random.Generator,
    carried: Carrying,
    dt: float,
    length: np.ndarray,
    cadence: np.ndarray,
    phase: np.ndarray,
) -> Float[np.ndarray, "n 3"]:
    """The blow of each heel: an oscillation that rises and dies within a fraction of a step, m."""
    since = np.mod(phase, 2.0 * np.pi) / (2.0 * np.pi * cadence)
    decay, frequency = rng.uniform(0.02, 0.06), rng.uniform(4.0, 14.0, size=3)
    angle = 2.0 * np.pi * frequency * since[:, None] + rng.uniform(0.0, 0.8, size=3)
    envelope = (since / decay) ** 2 * np.exp(2.0 - 2.0 * since / decay)
    blow = envelope[:, None] * np.sin(angle) * (length / _STEP)[:, None]
    # Left and right heels differ.
    blow = (
        blow
        * (1.0 + rng.uniform(0.0, 0.4) * np.sin(np.floor(phase / (2.0 * np.pi)) * np.pi + 0.5))[
            :, None
        ]
    )
    accel = np.gradient(np.gradient(blow, dt, axis=0), dt, axis=0)
    strength = rng.uniform(*carried.strike) * rng.uniform(0.4, 1.0, size=3)
    return blow * strength / np.maximum(np.sqrt(np.mean(accel**2, axis=0)), 1e-9)


def _swing(
    rng: np.random.Generator,
    carried: Carrying,
    time: np.ndarray,
    length: np.ndarray,
    phase: np.ndarray,
) -> Float[np.ndarray, "n 3"]:
    """Roll, pitch and yaw of the phone against the walker, rad."""
    total = wander(rng, time, 3, rng.uniform(*carried.grip), 0.01, 0.15)
    for ranges, rate in ((carried.stride_rate, 0.5), (carried.step_rate, 1.0)):
        speed = np.sqrt(2.0) * np.array([rng.uniform(*each) for each in ranges])
        amplitude = speed / (2.0 * np.pi * _CADENCE * rate)
        start = rng.uniform(0.0, 2.0 * np.pi, size=3)
        total = total + amplitude * np.sin(phase[:, None] * rate + start) * _growth(length)[:, None]
    return total
