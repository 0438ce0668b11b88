"""How a person walks and how a phone hangs on them: a seeded model of plan, gait and swing.

A plan is a smooth speed, heading and slope (standing, strolling, walking, running, turning,
climbing and descending stairs). The gait is on top of it: cadence and amplitudes grow with the
speed, and fore-aft, lateral and vertical motion keep a fixed phase to each other, so that speed
*and* direction of travel can be read from one second of IMU.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

from gnio_jax.numerics import convolved


class Person(NamedTuple):
    """What differs between walkers; gains are 1 for the average one."""

    leg_length: float
    """m."""
    cadence: float
    """Gain of the step frequency at a given speed."""
    bounce: float
    """Gain of the vertical motion at step frequency."""
    surge: float
    """Gain of the fore-aft motion at step frequency."""
    sway: float
    """Gain of the lateral motion at stride frequency."""
    limp: float
    """Share of the bounce that differs between left and right."""


class Placement(NamedTuple):
    """How a phone hangs on the walker. Swings are those of a step of 0.7 m, in the frame forward,
    left, up."""

    tilt: tuple[float, float]
    """Range of the fixed rotation about the phone's x axis (its short side), rad: 0 is screen up,
    π/2 upright."""
    roll: float
    """Standard deviation of the fixed rotation about the phone's y axis, rad."""
    lever: tuple[float, float, float]
    """From the walker's axis to the phone, m."""
    stride_pitch: float
    """Pitch at stride frequency, rad: a leg swings, a chest does not."""
    step_pitch: float
    """Pitch at step frequency, rad."""
    stride_roll: float
    """Roll at stride frequency, rad."""
    stride_yaw: float
    """Yaw at stride frequency, rad."""
    stride_surge: float
    """Fore-aft motion at stride frequency against the trunk, m."""


# The x axis stays away from the vertical everywhere: the yaw of the gravity-aligned frame is that
# of x.
PLACEMENTS = {
    "handheld": Placement((0.3, 0.8), 0.08, (0.30, 0.0, 0.1), 0.01, 0.03, 0.02, 0.03, 0.004),
    "pocket": Placement((1.2, 1.9), 0.10, (0.05, 0.15, -0.3), 0.35, 0.05, 0.06, 0.12, 0.06),
    "bag": Placement((0.9, 1.6), 0.25, (-0.15, 0.1, -0.1), 0.05, 0.04, 0.10, 0.06, 0.012),
    "chest": Placement((1.3, 1.6), 0.05, (0.12, 0.0, 0.2), 0.01, 0.03, 0.04, 0.06, 0.003),
}
"""Placement by name."""

_ACTIVITIES = {
    "walk": (0.50, (1.0, 1.6), (8.0, 20.0), 0.0),
    "stroll": (0.15, (0.5, 0.8), (6.0, 12.0), 0.0),
    "run": (0.11, (2.2, 3.2), (6.0, 10.0), 0.0),
    "stand": (0.12, (0.0, 0.0), (4.0, 8.0), 0.0),
    "upstairs": (0.06, (0.45, 0.6), (6.0, 10.0), 0.6),
    "downstairs": (0.06, (0.5, 0.65), (6.0, 10.0), -0.6),
}
"""(probability, speed range m/s, duration range s, rise per metre)."""

STANDING_START = 3.0
"""s that every walk begins with."""


def step_frequency(speed: Float[np.ndarray, "n"], cadence: float = 1.0) -> Float[np.ndarray, "n"]:
    """Steps per second (Hz) at a speed (m/s): 1.8 at 1.3 m/s, 2.8 at 3 m/s."""
    return cadence * (1.1 + 0.55 * speed)


def person(seed: int) -> Person:
    """The walker of that number."""
    rng = np.random.default_rng([7, seed])
    return Person(
        leg_length=float(rng.uniform(0.82, 1.0)),
        cadence=float(rng.uniform(0.96, 1.04)),
        bounce=float(rng.uniform(0.9, 1.1)),
        surge=float(rng.uniform(0.9, 1.1)),
        sway=float(rng.uniform(0.8, 1.2)),
        limp=float(rng.uniform(0.0, 0.15)),
    )


class Plan(NamedTuple):
    """Where a person goes, smoothly."""

    speed: Float[np.ndarray, " n"]
    """m/s."""
    heading: Float[np.ndarray, " n"]
    """rad."""
    rise: Float[np.ndarray, " n"]
    """m climbed per m walked."""


def plan(rng: np.random.Generator, time: Float[np.ndarray, " n"], dt: float) -> Plan:
    """A walk through random activities; `time` (s) is uniform with the step `dt`."""
    speed, rise, turn_rate = np.zeros_like(time), np.zeros_like(time), np.zeros_like(time)
    names = list(_ACTIVITIES)
    chances = np.array([_ACTIVITIES[name][0] for name in names])
    clock, previous = STANDING_START, "stand"
    while clock < time[-1]:
        name = names[rng.choice(len(names), p=chances / chances.sum())]
        if name == previous:
            continue
        previous = name
        _, speeds, durations, slope = _ACTIVITIES[name]
        target, end = rng.uniform(*speeds), clock + rng.uniform(*durations)
        during = (time >= clock) & (time < end)
        speed[during], rise[during] = target, slope
        # Turns: some on the way, few on stairs, one in place at most.
        starts = clock + 1.0 + np.cumsum(rng.uniform(2.5, 9.0, size=8))
        most = 1 if name == "stand" else 0 if slope else len(starts)
        for start in starts[:most][starts[:most] < end - 2.0]:
            turn_rate += _turn(rng, time, start, target)
        clock = end
    speed = smooth_steps(speed, 2.4, dt) * (1.0 + 0.04 * wander(rng, time, 1, 1.0, 0.05, 0.3)[:, 0])
    turn_rate = smooth_steps(turn_rate, 0.8, dt)
    turn_rate = turn_rate + 0.1 * speed * wander(rng, time, 1, 1.0, 0.05, 0.3)[:, 0]
    heading = integral(time, turn_rate) + rng.uniform(-np.pi, np.pi)
    return Plan(speed, heading, smooth_steps(rise, 2.4, dt))


def _turn(
    rng: np.random.Generator, time: Float[np.ndarray, " n"], start: float, speed: float
) -> Float[np.ndarray, " n"]:
    """Turn rate (rad/s) of one turn by about 45, 90 or 180°, to either side, at a speed (m/s)."""
    side, quarters = rng.choice([-1.0, 1.0]), rng.choice([0.5, 1.0, 1.0, 2.0])
    angle = side * quarters * np.pi / 2 * rng.uniform(0.8, 1.2)
    # At most 1.8 rad/s, and 2.5 m/s² sideways.
    seconds = max(1.0, abs(angle) / 1.8, abs(angle) * speed / 2.5)
    return np.where((time >= start) & (time < start + seconds), angle / seconds, 0.0)


def gait(
    rng: np.random.Generator,
    walker: Person,
    carried: Placement,
    time: Float[np.ndarray, " n"],
    planned: Plan,
    phase: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Position of the phone against the steadily moving walker (m) and its swing as a rotation
    vector, both (n, 3) forward, left, up.

    All three directions hang on one phase, and the harmonics of a heel strike are not symmetric in
    time: seen backwards or mirrored the pattern is another one, which makes the sign of the
    direction of travel observable.
    """
    speed = planned.speed
    length = speed / step_frequency(speed, walker.cadence)
    # An inverted pendulum, softened by knee and ankle.
    bounce = walker.bounce * 0.28 * length**2 / (8.0 * walker.leg_length)
    surge = walker.surge * 0.016 * length / 0.7
    sway = walker.sway * 0.025 * speed / (speed + 0.4)
    stride = phase / 2.0
    stairs = planned.rise / 0.6
    side = rng.choice([0.0, np.pi])  # which leg, which shoulder
    swinging = 1.7 * length / (length + 0.5)

    forward = surge * (
        np.sin(phase) + 0.16 * np.sin(2 * phase + 0.6) + 0.03 * np.sin(3 * phase + 1.0)
    )
    forward = forward + carried.stride_surge * swinging * np.sin(stride + side)
    left = sway * (np.sin(stride) + 0.10 * np.sin(3 * stride + 0.5))
    up = bounce * (
        -np.cos(phase)
        + 0.12 * np.cos(2 * phase + 0.4)
        + 0.03 * np.cos(3 * phase + 0.8)
        + walker.limp * np.cos(stride)
    )
    up = up + 0.02 * stairs * np.sin(phase) + 0.006 * stairs**2 * np.cos(2 * phase)
    lever = np.array([1.0, np.cos(side), 1.0]) * carried.lever
    offset = np.stack([forward, left, up], axis=1) + lever + wander(rng, time, 3, 0.002, 0.1, 0.6)
    swing = _swing(carried, swinging, phase, side)
    return offset, swing + wander(rng, time, 3, np.radians(1.5), 0.05, 0.6)


def _swing(
    carried: Placement,
    swinging: Float[np.ndarray, " n"],
    phase: Float[np.ndarray, " n"],
    side: float,
) -> Float[np.ndarray, "n 3"]:
    """Roll, pitch and yaw (rad) of a phone that swings with the strides of one side."""
    stride = phase / 2.0
    roll = carried.stride_roll * swinging * np.cos(stride + side)
    pitch = swinging * (
        carried.stride_pitch * np.cos(stride + side) + carried.step_pitch * np.sin(phase + 0.5)
    )
    yaw = carried.stride_yaw * swinging * np.sin(stride + side + 0.7)
    return np.stack([roll, pitch, yaw], axis=1)


def wander(
    rng: np.random.Generator,
    time: np.ndarray,
    width: int,
    rms: float,
    lowest: float,
    highest: float,
) -> np.ndarray:
    """Smooth aimless motion (n, width): eight sinusoids between two frequencies (Hz) with a root
    mean square of `rms` together."""
    frequency = rng.uniform(lowest, highest, size=(8, width))
    start = rng.uniform(0.0, 2.0 * np.pi, size=(8, width))
    result = np.zeros((len(time), width))
    for f, s in zip(frequency, start, strict=True):
        result += np.sin(2.0 * np.pi * time[:, None] * f + s)
    return result * rms * np.sqrt(2.0 / 8.0)


def smooth_steps(values: np.ndarray, seconds: float, dt: float) -> np.ndarray:
    """Steps turned into ramps of `seconds` with three continuous derivatives."""
    half = round(seconds / dt / 2)
    kernel = np.hanning(2 * half + 3)[1:-1] ** 2
    return convolved(np.pad(values, half, mode="edge"), kernel / kernel.sum())


def integral(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Integral over time from the first stamp, exact for the cubic spline through the values."""
    return make_interp_spline(time, values, k=3).antiderivative()(time)
