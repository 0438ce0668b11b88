"""Pedestrians that are computed, not recorded: the demo and the tests need no file, and every
figure has a known truth.

A walk is a smooth speed, heading and slope (standing, strolling, walking, running, turning,
climbing and descending stairs), a gait on top of it, and a phone that hangs on the walker
somewhere. Cadence and amplitudes grow with the speed, and fore-aft, lateral and vertical motion
keep a fixed phase to each other, so that speed *and* direction of travel can be read from one
second of IMU, while the heading of the phone says nothing about them (its mounting is drawn per
sequence).

Position, velocity and attitude are values and derivatives of one spline. Sample k of the IMU is the
mean over the interval it drives, gyro_k = log(R_kᵀ R_{k+1}) / dt and accel_k = R_kᵀ ((v_{k+1} −
v_k) / dt − g), so that integrating the noise-free IMU sample by sample returns the trajectory.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from scipy.signal import fftconvolve
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset, Recording, single
from gnio_jax.numerics import quaternions
from gnio_jax.types import GRAVITY, Sequence


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

# (probability, speed range m/s, duration range s, rise per metre)
_ACTIVITIES = {
    "walk": (0.50, (1.0, 1.6), (8.0, 20.0), 0.0),
    "stroll": (0.15, (0.5, 0.8), (6.0, 12.0), 0.0),
    "run": (0.11, (2.2, 3.2), (6.0, 10.0), 0.0),
    "stand": (0.12, (0.0, 0.0), (4.0, 8.0), 0.0),
    "upstairs": (0.06, (0.45, 0.6), (6.0, 10.0), 0.6),
    "downstairs": (0.06, (0.5, 0.65), (6.0, 10.0), -0.6),
}

# A phone's IMU: white noise and random walk as densities, constant biases by their length.
GYRO_DENSITY = 9e-5
"""rad/s/√Hz."""
ACCEL_DENSITY = 1.5e-3
"""m/s²/√Hz."""
GYRO_BIAS_WALK = 1e-6
"""rad/s/√s."""
ACCEL_BIAS_WALK = 1e-4
"""m/s²/√s."""
GYRO_BIAS = (1e-4, 4e-4)
"""Range of the length of the gyro bias, rad/s: what is left after a rest-period calibration."""
ACCEL_BIAS = (0.05, 0.10)
"""Range of the length of the accelerometer bias, m/s²."""

# split: (first seed of its sequences, first person, number of people, number of sequences,
# seconds); no person is in two splits.
_SPLITS = {
    "train": (1000, 0, 12, 24, 120.0),
    "val": (2000, 100, 4, 4, 60.0),
    "test": (3000, 200, 6, 6, 120.0),
}


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


def pedestrian(
    seed: int,
    walker: Person,
    placement: str = "handheld",
    seconds: float = 120.0,
    rate: float = 200.0,
    imu_errors: bool = True,
) -> Sequence:
    """A walk of `seconds` at `rate` Hz with everything but the walker drawn from `seed`; starts
    with 3 s of standing.

    Without `imu_errors` the IMU has neither bias nor noise. The true biases, at the start, are
    among the attributes.
    """
    rng = np.random.default_rng([seed])
    dt = 1.0 / rate
    count = round(seconds * rate)
    time = (
        np.arange(count + 1) * dt
    )  # one more pose than samples: the last sample drives an interval, too
    carried = PLACEMENTS[placement]

    speed, heading, rise = _plan(rng, time, dt)
    phase = 2.0 * np.pi * _integral(time, step_frequency(speed, walker.cadence)) + rng.uniform(
        0.0, 2.0 * np.pi
    )
    offset, swing = _gait(rng, walker, carried, time, speed, rise, phase)

    base = _integral(
        time, np.stack([speed * np.cos(heading), speed * np.sin(heading), speed * rise], axis=1)
    )
    turn = Rotation.from_rotvec(heading[:, None] * np.array([0.0, 0.0, 1.0]))
    path = make_interp_spline(time, base + turn.apply(offset), k=5)
    position, velocity = path(time), path.derivative()(time)
    position = position - position[0]

    # The mounting's yaw is anything: where the phone points is no hint of where its owner goes.
    mounting = Rotation.from_euler(
        "ZXY",
        [
            rng.uniform(-np.pi, np.pi),
            rng.uniform(*carried.tilt),
            carried.roll * rng.standard_normal(),
        ],
    )
    attitude = turn * Rotation.from_rotvec(swing) * mounting

    gyro = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / dt
    accel = (
        attitude[:-1].inv().apply(np.diff(velocity, axis=0) / dt + np.array([0.0, 0.0, GRAVITY]))
    )
    # Drawn in any case, so that a seed is the same walk with and without.
    gyro_bias, gyro_error = _sensor_error(rng, count, dt, GYRO_BIAS, GYRO_DENSITY, GYRO_BIAS_WALK)
    accel_bias, accel_error = _sensor_error(
        rng, count, dt, ACCEL_BIAS, ACCEL_DENSITY, ACCEL_BIAS_WALK
    )
    if imu_errors:
        gyro, accel = gyro + gyro_error, accel + accel_error
    else:
        gyro_bias, accel_bias = np.zeros(3), np.zeros(3)

    # The phone's own attitude: a yaw from anywhere that drifts by some degrees, a degree of tilt
    # error.
    drift = np.cumsum(rng.standard_normal(count)) * np.radians(0.4) * np.sqrt(dt) + rng.uniform(
        -np.pi, np.pi
    )
    tilt_error = np.concatenate(
        [_wander(rng, time[:-1], 2, np.radians(0.7), 0.01, 0.05), np.zeros((count, 1))], axis=1
    )
    own = (
        Rotation.from_rotvec(drift[:, None] * np.array([0.0, 0.0, 1.0]))
        * Rotation.from_rotvec(tilt_error)
        * attitude[:-1]
    )

    attributes = {
        "dataset": "synthetic",
        "device": "simulated phone",
        "placement": placement,
        "truth": "simulated",
        "seed": seed,
        "licence": DATASET.licence,
        "gyro_density": GYRO_DENSITY * imu_errors,
        "accel_density": ACCEL_DENSITY * imu_errors,
    }
    for axis, letter in enumerate("xyz"):
        attributes[f"gyro_bias_{letter}"] = float(gyro_bias[axis])
        attributes[f"accel_bias_{letter}"] = float(accel_bias[axis])
    return Sequence(
        name=_name(placement, seed),
        time=time[:-1],
        gyro=gyro,
        accel=accel,
        orientation=quaternions(attitude[:-1]),
        position=position[:-1],
        velocity=velocity[:-1],
        valid=np.ones(count, dtype=bool),
        device_orientation=quaternions(own),
        attributes=attributes,
    )


def recordings(root: Path | None, split: str) -> list[Recording]:
    """The walks of a split, not yet computed."""
    del root
    seed, first_person, people, count, seconds = _SPLITS[split]
    placements = list(PLACEMENTS)
    walks = []
    for index in range(count):
        who = first_person + index % people
        # Shifted by one per round of people, so that nobody carries the phone in one place only.
        where = placements[(index + index // people) % len(placements)]
        walks.append(single(_name(where, seed + index), _walk, seed + index, who, where, seconds))
    return walks


def _name(placement: str, seed: int) -> str:
    return f"synthetic_{seed}_{placement}"


def _walk(seed: int, who: int, where: str, seconds: float) -> Sequence:
    sequence = pedestrian(seed, person(who), where, seconds)
    return sequence._replace(attributes={**sequence.attributes, "subject": f"person {who}"})


def _plan(
    rng: np.random.Generator, time: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth speed (m/s), heading (rad) and rise per metre of a walk through random activities."""
    speed, rise, turn_rate = np.zeros_like(time), np.zeros_like(time), np.zeros_like(time)
    names = list(_ACTIVITIES)
    chances = np.array([_ACTIVITIES[name][0] for name in names])
    clock, previous = 3.0, "stand"
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
        turns = clock + 1.0 + np.cumsum(rng.uniform(2.5, 9.0, size=8))
        if name == "stand":
            turns = turns[:1]
        elif slope:
            turns = turns[:0]
        for start in turns[turns < end - 2.0]:
            angle = (
                rng.choice([-1.0, 1.0])
                * rng.choice([0.5, 1.0, 1.0, 2.0])
                * np.pi
                / 2
                * rng.uniform(0.8, 1.2)
            )
            lasting = max(
                1.0, abs(angle) / 1.8, abs(angle) * target / 2.5
            )  # at most 1.8 rad/s and 2.5 m/s² sideways
            turn_rate[(time >= start) & (time < start + lasting)] += angle / lasting
        clock = end
    speed = _smooth(speed, 2.4, dt) * (1.0 + 0.04 * _wander(rng, time, 1, 1.0, 0.05, 0.3)[:, 0])
    turn_rate = (
        _smooth(turn_rate, 0.8, dt) + 0.1 * speed * _wander(rng, time, 1, 1.0, 0.05, 0.3)[:, 0]
    )
    return speed, _integral(time, turn_rate) + rng.uniform(-np.pi, np.pi), _smooth(rise, 2.4, dt)


def _gait(
    rng: np.random.Generator,
    walker: Person,
    carried: Placement,
    time: np.ndarray,
    speed: np.ndarray,
    rise: np.ndarray,
    phase: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Position of the phone against the steadily moving walker (m) and its swing as a rotation
    vector, both (n, 3) forward, left, up.

    All three directions hang on one phase, and the harmonics of a heel strike are not symmetric in
    time: seen backwards or mirrored the pattern is another one, which makes the sign of the
    direction of travel observable.
    """
    length = speed / step_frequency(speed, walker.cadence)
    bounce = (
        walker.bounce * 0.28 * length**2 / (8.0 * walker.leg_length)
    )  # an inverted pendulum, softened by knee and ankle
    surge = walker.surge * 0.016 * length / 0.7
    sway = walker.sway * 0.025 * speed / (speed + 0.4)
    stride = phase / 2.0
    stairs = rise / 0.6
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
    offset = np.stack([forward, left, up], axis=1) + lever + _wander(rng, time, 3, 0.002, 0.1, 0.6)

    roll = carried.stride_roll * swinging * np.cos(stride + side)
    pitch = swinging * (
        carried.stride_pitch * np.cos(stride + side) + carried.step_pitch * np.sin(phase + 0.5)
    )
    yaw = carried.stride_yaw * swinging * np.sin(stride + side + 0.7)
    return offset, np.stack([roll, pitch, yaw], axis=1) + _wander(
        rng, time, 3, np.radians(1.5), 0.05, 0.6
    )


def _sensor_error(
    rng: np.random.Generator,
    count: int,
    dt: float,
    length: tuple[float, float],
    density: float,
    walk: float,
) -> tuple[np.ndarray, np.ndarray]:
    """(constant bias (3,), its sum with random walk and white noise (count, 3))."""
    direction = rng.standard_normal(3)
    bias = direction / np.linalg.norm(direction) * rng.uniform(*length)
    walked = np.cumsum(rng.standard_normal((count, 3)), axis=0) * walk * np.sqrt(dt)
    return bias, bias + walked + rng.standard_normal((count, 3)) * density / np.sqrt(dt)


def _wander(
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


def _smooth(values: np.ndarray, seconds: float, dt: float) -> np.ndarray:
    """Steps turned into ramps of `seconds` with three continuous derivatives."""
    half = round(seconds / dt / 2)
    kernel = np.hanning(2 * half + 3)[1:-1] ** 2
    return fftconvolve(np.pad(values, half, mode="edge"), kernel / kernel.sum(), mode="valid")


def _integral(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Integral over time from the first stamp, exact for the cubic spline through the values."""
    return make_interp_spline(time, values, k=3).antiderivative()(time)


DATASET = Dataset(
    name="synthetic",
    recordings=recordings,
    splits=tuple(_SPLITS),
    rate=200.0,
    source="computed by gnio_jax.data.readers.synthetic",
    layout="no files are needed",
    licence="Apache-2.0, as this package",
    needs_root=False,
)
