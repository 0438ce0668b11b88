"""A simulated walker with a phone: every part of a walk is drawn from ranges.

The plan of a walk is a smooth speed, heading and slope: standing, strolling, walking, running,
turning, climbing and descending stairs. The gait is on top of it. The amplitude and the phase of
every harmonic, the heel strike and the swing of the phone are drawn for each walk (domain
randomisation). A network can then use only what all walkers have in common: bounce and cadence grow
with the speed, and the trunk is fastest where it is lowest, which distinguishes forward from
backward. In a run it is slowest there.

The trunk follows the inverted pendulum (Zijlstra & Hof, 2003). The gains of its motion and the
strength of the heel strike in a hand, a pocket and a bag were set so that the spectra of the
simulated accelerations cover those of OxIOD's training and validation sessions; no network learns
from these sessions. `PEOPLE` takes a fifth of the widths of these ranges about the same middle, so
that a small network learns from them in a minute. All ranges are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from gnio_jax.numerics import about_z, convolve

Range = tuple[float, float]
Ranges = tuple[Range, Range, Range]
Wave = Callable[[np.ndarray], np.ndarray]


class Carrying(NamedTuple):
    """A way of carrying a phone, as ranges to draw from. Three ranges are forward, left, up, or
    roll, pitch, yaw. Accelerations and rates are root mean squares in a slow walk (`_STEP`,
    `_CADENCE`).
    """

    surge: Range
    """Gain of the trunk's fore-aft motion at step frequency."""
    surge_phase: Range
    """Mean and standard deviation of its phase relative to the inverted pendulum, rad."""
    bounce: Range
    """Gain of the trunk's vertical motion at step frequency."""
    harmonics: Range
    """Ratio of the acceleration at twice the step frequency to that at step frequency."""
    stride: Ranges
    """Acceleration at stride frequency, m/s²."""
    strike: Range
    """Acceleration of the heel strike, m/s²."""
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
    """Vector from the walker's axis to the phone, m; left is the side of the phone."""


CARRYING = {
    "handheld": Carrying(
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
"""Ways of carrying a phone, by name."""

RATE = 200.0
"""Rate at which a walk is drawn, Hz. The heel strikes are too quick for much lower ones."""
STANDING_START = 3.0
"""Time of standing at the beginning of every walk, s."""
_STEP, _CADENCE = 0.55, 1.5
"""Step length (m) and step frequency (Hz) of the slow walk for which the amplitudes are given."""


class Activity(NamedTuple):
    """An activity of a walker."""

    share: float
    """Probability that it comes next."""
    speed: Range
    """m/s."""
    seconds: Range
    """s."""
    rise: float
    """m climbed for each m walked."""
    running: float
    """0 walks, 1 runs."""


class Population(NamedTuple):
    """The ranges from which a walk is drawn."""

    activities: dict[str, Activity]
    carrying: dict[str, Carrying]
    cadence: Range
    """Gain of the step frequency at a given speed."""
    idle: Range
    """Slow wandering of the phone's position, which continues while the walker stands, m."""


def _narrow(ranges: Any, share: float) -> Any:
    """A range, or a tuple of them, with this share of its width about the same middle."""
    if isinstance(ranges[0], tuple):
        return tuple(_narrow(bounds, share) for bounds in ranges)
    low, high = 0.5 * (1 + share), 0.5 * (1 - share)
    return (low * ranges[0] + high * ranges[1], high * ranges[0] + low * ranges[1])


def _narrow_carrying(carrying: Carrying, share: float) -> Carrying:
    values = carrying._asdict()
    ranges = {name: _narrow(value, share) for name, value in values.items() if type(value) is tuple}
    # The fore-aft motion of the trunk reaches the phone in every placement, and shows the direction
    # of walking.
    mean, std = carrying.surge_phase
    ranges |= {"surge": (0.9, 1.1), "surge_phase": (mean, share * std)}
    return carrying._replace(**ranges, turned=0.0, roll=share * carrying.roll)


PEOPLE = Population(
    activities={
        "walk": Activity(0.50, (1.0, 1.6), (8.0, 20.0), 0.0, 0.0),
        "stroll": Activity(0.15, (0.5, 0.8), (6.0, 12.0), 0.0, 0.0),
        "run": Activity(0.11, (2.2, 3.2), (6.0, 10.0), 0.0, 1.0),
        "stand": Activity(0.12, (0.0, 0.0), (4.0, 8.0), 0.0, 0.0),
        "upstairs": Activity(0.06, (0.45, 0.6), (6.0, 10.0), 0.6, 0.0),
        "downstairs": Activity(0.06, (0.5, 0.65), (6.0, 10.0), -0.6, 0.0),
    },
    carrying={name: _narrow_carrying(carrying, 0.2) for name, carrying in CARRYING.items()},
    cadence=_narrow((0.86, 1.16), 0.2),
    idle=(0.001, 0.003),
)
"""People with the middles of `CARRYING` and a fifth of its widths."""


class Plan(NamedTuple):
    """The smooth plan of a walk."""

    speed: Float[np.ndarray, " n"]
    """m/s."""
    heading: Float[np.ndarray, " n"]
    """rad."""
    rise: Float[np.ndarray, " n"]
    """m climbed for each m walked."""
    running: Float[np.ndarray, " n"]
    """0 walks, 1 runs."""


class Steps(NamedTuple):
    """The walker's steps along the plan."""

    time: Float[np.ndarray, " n"]
    """s."""
    plan: Plan
    length: Float[np.ndarray, " n"]
    """Length of a step, m."""
    cadence: Float[np.ndarray, " n"]
    """Steps per second, Hz."""
    phase: Float[np.ndarray, " n"]
    """2π for each step."""

    def growth(self) -> Float[np.ndarray, "n 1"]:
        """Ratio of the amplitude of a swing to that of the slow walk."""
        return (self.length / (self.length + 0.5) * (_STEP + 0.5) / _STEP)[:, None]


class PhoneMotion(NamedTuple):
    """True motion of the phone. There is one more pose than samples, because the last sample also
    drives an interval."""

    time: Float[np.ndarray, " n"]
    """s."""
    position: Float[np.ndarray, "n 3"]
    """Position relative to the first pose, m."""
    velocity: Float[np.ndarray, "n 3"]
    """m/s."""
    attitude: Rotation
    """Phone → world."""


def draw_motion(
    rng: np.random.Generator,
    placement: str,
    time: Float[np.ndarray, " n"],
    person: int,
) -> PhoneMotion:
    """The motion of a phone at the stamps `time` (s, from 0) on a walk that is drawn from `PEOPLE`.
    `placement` is a way of `PEOPLE.carrying`.

    The gait of walker number `person` is the same in every walk. The walk is drawn at `RATE` and
    does not depend on the stamps. Position and velocity are value and derivative of one spline.
    """
    gait_rng = np.random.default_rng([7, person])
    carrying = PEOPLE.carrying[placement]
    dt = 1.0 / RATE
    clock = np.arange(math.ceil(time[-1] * RATE - 1e-6) + 1) / RATE
    plan = _plan(rng, PEOPLE.activities, clock, dt)
    walking_cadence = step_frequency(plan.speed, gait_rng.uniform(*PEOPLE.cadence))
    running_cadence = gait_rng.uniform(2.3, 2.8) + 0.1 * plan.speed
    cadence = walking_cadence + plan.running * (running_cadence - walking_cadence)
    cadence = cadence * (1.0 + 0.03 * wander(rng, clock, 1, 1.0, 0.05, 0.5)[:, 0])
    phase = 2.0 * np.pi * integral(clock, cadence) + rng.uniform(0.0, 2.0 * np.pi)
    steps = Steps(clock, plan, plan.speed / cadence, cadence, phase)
    offset = _trunk(rng, gait_rng, carrying, steps)
    offset = offset + _strides(rng, gait_rng, carrying, steps)
    offset = offset + _strikes(gait_rng, carrying, steps, dt)
    lever = np.array([rng.uniform(*bounds) for bounds in carrying.lever])
    lever[1] *= rng.choice([-1.0, 1.0])
    offset = offset + lever + wander(rng, clock, 3, rng.uniform(*PEOPLE.idle), 0.1, 0.8)
    swing = _swing(rng, gait_rng, carrying, steps)

    # The yaw of the mounting is arbitrary, so that the phone's heading does not show the direction
    # of walking.
    tilt = rng.uniform(*carrying.tilt)
    if rng.random() < carrying.turned:
        tilt = -tilt
    roll = np.clip(carrying.roll * rng.standard_normal(), -1.0, 1.0)
    mounting = Rotation.from_euler("ZXY", [rng.uniform(-np.pi, np.pi), tilt, roll])

    speed, heading, rise, _ = plan
    course = np.stack([speed * np.cos(heading), speed * np.sin(heading), speed * rise], axis=1)
    travelled = integral(clock, course) + about_z(heading).apply(offset)
    path = make_interp_spline(clock, travelled, k=5)
    position, velocity = path(time), path.derivative()(time)
    heading, swing = (make_interp_spline(clock, angle, k=5)(time) for angle in (heading, swing))
    attitude = about_z(heading) * Rotation.from_rotvec(swing) * mounting
    return PhoneMotion(time, position - position[0], velocity, attitude)


def step_frequency(speed: Float[np.ndarray, " n"], gain: float = 1.0) -> Float[np.ndarray, " n"]:
    """Steps of a walker in a second (Hz) at a speed (m/s): 1.8 at 1.3 m/s."""
    return gain * (1.1 + 0.55 * speed)


def _plan(
    rng: np.random.Generator,
    activities: dict[str, Activity],
    time: Float[np.ndarray, " n"],
    dt: float,
) -> Plan:
    """A walk through random activities, with bends and corners."""
    speed, rise, running = (np.zeros_like(time) for _ in range(3))
    names, chances = list(activities), [activity.share for activity in activities.values()]
    clock = STANDING_START
    while clock < time[-1]:
        activity = activities[rng.choice(names, p=chances)]
        end = clock + rng.uniform(*activity.seconds)
        interval = (time >= clock) & (time < end)
        speed[interval] = rng.uniform(*activity.speed)
        rise[interval], running[interval] = activity.rise, activity.running
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
    return Plan(speed, heading, smooth_steps(rise, 2.4, dt), smooth_steps(running, 1.6, dt))


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
    rng: np.random.Generator, gait_rng: np.random.Generator, carrying: Carrying, steps: Steps
) -> Float[np.ndarray, "n 3"]:
    """The part of the trunk's fore-aft and vertical motion at step frequency that reaches the
    phone, m."""
    time, plan, length, _, phase = steps
    bounce = (
        gait_rng.uniform(*carrying.bounce) * 0.28 * length**2 / (8.0 * gait_rng.uniform(0.8, 1.0))
    )
    surge = gait_rng.uniform(*carrying.surge) * 0.016 * length / 0.7
    mean, std = carrying.surge_phase
    # A walker is fastest where the trunk is lowest, a runner is slowest there.
    forward_phase = phase + mean + std * gait_rng.standard_normal() + np.pi * plan.running
    surge = surge * (1.0 - 0.4 * plan.running)
    forward = surge * _harmonics(gait_rng, carrying.harmonics, forward_phase, np.sin, 0.6)
    up = bounce * _harmonics(gait_rng, carrying.harmonics, phase, lambda x: -np.cos(x), np.pi + 0.4)
    stairs = plan.rise / 0.6
    up = up + 0.02 * stairs * np.sin(phase) + 0.006 * stairs**2 * np.cos(2 * phase)
    variation = 1.0 + 0.08 * wander(rng, time, 2, 1.0, 0.1, 1.0)
    return np.stack(
        [forward * variation[:, 0], np.zeros_like(forward), up * variation[:, 1]], axis=1
    )


def _harmonics(
    rng: np.random.Generator, ratio: Range, phase: np.ndarray, wave: Wave, second: float
) -> np.ndarray:
    """A wave at step frequency with its second and third harmonic. `ratio` is that of the
    accelerations; the phase of the second harmonic is about `second`."""
    twice, thrice = rng.uniform(*ratio), rng.uniform(*ratio) * rng.uniform(0.0, 0.6)
    second_start = second + 0.7 * rng.standard_normal()
    third_start = rng.uniform(0.0, 2.0 * np.pi)
    overtones = thrice / 9.0 * wave(3.0 * phase + third_start)
    return wave(phase) + twice / 4.0 * wave(2.0 * phase + second_start) + overtones


def _strides(
    rng: np.random.Generator, gait_rng: np.random.Generator, carrying: Carrying, steps: Steps
) -> Float[np.ndarray, "n 3"]:
    """Motion at stride frequency: the sway of the trunk, an arm or a bag that swings, m."""
    accel = np.sqrt(2.0) * np.array([gait_rng.uniform(*bounds) for bounds in carrying.stride])
    amplitude = accel / (np.pi * _CADENCE) ** 2
    start, phase = gait_rng.uniform(0.0, 2.0 * np.pi, size=3), steps.phase[:, None] / 2.0
    wave = np.sin(phase + start) * (1.0 + 0.1 * wander(rng, steps.time, 3, 1.0, 0.1, 1.0))
    return amplitude * wave * (steps.growth() * (1.0 + 0.5 * steps.plan.running[:, None]))


def _strikes(
    gait_rng: np.random.Generator, carrying: Carrying, steps: Steps, dt: float
) -> Float[np.ndarray, "n 3"]:
    """The heel strikes: an oscillation that rises and decays within a fraction of a step, m."""
    elapsed = np.mod(steps.phase, 2.0 * np.pi) / (2.0 * np.pi * steps.cadence)
    decay, frequency = gait_rng.uniform(0.02, 0.06), gait_rng.uniform(4.0, 14.0, size=3)
    angle = 2.0 * np.pi * frequency * elapsed[:, None] + gait_rng.uniform(0.0, 0.8, size=3)
    envelope = (elapsed / decay) ** 2 * np.exp(2.0 - 2.0 * elapsed / decay)
    blow = envelope[:, None] * np.sin(angle) * (steps.length / _STEP)[:, None]
    # Left and right heels differ.
    side = np.sin(np.floor(steps.phase / (2.0 * np.pi)) * np.pi + 0.5)
    blow = blow * (1.0 + gait_rng.uniform(0.0, 0.4) * side)[:, None]
    accel = np.gradient(np.gradient(blow, dt, axis=0), dt, axis=0)
    strength = gait_rng.uniform(*carrying.strike) * gait_rng.uniform(0.4, 1.0, size=3)
    return blow * strength / np.maximum(np.sqrt(np.mean(accel**2, axis=0)), 1e-9)


def _swing(
    rng: np.random.Generator, gait_rng: np.random.Generator, carrying: Carrying, steps: Steps
) -> Float[np.ndarray, "n 3"]:
    """Roll, pitch and yaw of the phone relative to the walker, rad."""
    rotation = wander(rng, steps.time, 3, rng.uniform(*carrying.grip), 0.01, 0.15)
    for ranges, rate in ((carrying.stride_rate, 0.5), (carrying.step_rate, 1.0)):
        speed = np.sqrt(2.0) * np.array([gait_rng.uniform(*bounds) for bounds in ranges])
        amplitude = speed / (2.0 * np.pi * _CADENCE * rate)
        start = gait_rng.uniform(0.0, 2.0 * np.pi, size=3)
        rotation = (
            rotation + amplitude * np.sin(steps.phase[:, None] * rate + start) * steps.growth()
        )
    return rotation


def wander(
    rng: np.random.Generator, time: np.ndarray, width: int, rms: float, low: float, high: float
) -> np.ndarray:
    """Smooth random motion (n, width): eight sinusoids between two frequencies (Hz) with a total
    root mean square of `rms`."""
    frequencies = rng.uniform(low, high, size=(8, width))
    starts = rng.uniform(0.0, 2.0 * np.pi, size=(8, width))
    motion = np.zeros((len(time), width))
    for hertz, start in zip(frequencies, starts, strict=True):
        motion += np.sin(2.0 * np.pi * time[:, None] * hertz + start)
    return motion * rms * np.sqrt(2.0 / 8.0)


def smooth_steps(values: np.ndarray, seconds: float, dt: float) -> np.ndarray:
    """Steps smoothed to ramps of `seconds` with three continuous derivatives."""
    half = round(seconds / dt / 2)
    kernel = np.hanning(2 * half + 3)[1:-1] ** 2
    return convolve(np.pad(values, half, mode="edge"), kernel / kernel.sum())


def integral(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Integral over time from the first stamp, exact for the cubic spline through the values."""
    return make_interp_spline(time, values, k=3).antiderivative()(time)
