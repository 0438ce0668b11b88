"""What the sensors of an IMU say about each other: dead, hung and contradicting sensors. `gnio data
import`, `track`, `live` and `data check csv` ask the same questions.

Gravity is the witness. Over two seconds the specific force, turned back by the gyro, points to the
same side, because the velocity of a body hardly changes on average. A wrong unit, sign, axis or
clock of the gyro smears it. The limits are ours: they pass 42 recordings of phones, drones and cars
and 220 pieces of 10 s of them, and find a negated gyro in every second piece.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.errors import InputError
from gnio_jax.numerics import quaternion_product, spans
from gnio_jax.types import Sequence

DEGREE = np.pi / 180.0
WINDOW = 2.0
"""Time over which the specific force is turned back, s."""
MOST_WINDOWS, MOST_STEPS, LEAST_WINDOWS, LEAST_STEPS = 48, 64, 5, 8
"""Bounds of the number of windows, and of rotation steps in each."""
MANY = 10_000
"""Number of samples from which a median is good enough."""
LEAST_TURN = 0.1
"""Change of the mean force between the halves of a window, m/s² rms, if gravity has turned."""
LEAST_CONTRAST, CLEAR_CONTRAST, CLEAR_ERROR = 2.0, 4.0, 0.3
"""A gyro is supported if the opposite rotation leaves an error larger by the first factor; beyond
the second one, with an error below the third number, no other reading is tried."""
DOUBT, PROOF, SHORT_DOUBT = 2.0, 4.0, 3.0
"""Another reading that leaves an error smaller by these factors is warned of, or is proof; other
axes, of which there are many, need the last one in a short recording."""
SHORTEST, SHORT = 5.0, 8.0
"""Durations of a recording below which nothing is warned of, or proven, s."""
CLOCKS = (1e-3, 1e-2, 1e-1, 1e1, 1e2, 1e3)
"""Wrong clocks: true seconds in a second of the stamps."""
NEAR_CLOCKS, CLEARLY = (0.2, 0.4, 0.5, 2.0, 2.5, 5.0), 0.7
"""Clocks for which a counter may be taken, likewise, and the share of the error that decides."""
SCALES = {"deg/s": DEGREE, "rad/s": 1 / DEGREE}
"""Units for which another one may have been taken, relative to it."""
COUNTS_OF_DEGREE = (131.0, 65.5, 32.8, 16.4)
"""Raw counts of usual 16-bit gyros in 1 deg/s, which may have been read as deg/s, or as rad/s."""
LONGEST_HOLD, MOST_HELD, HELD_SHARE, FINE_SHARE = 0.2, 10, 0.3, 0.5
"""A sensor hangs if it repeats its values for this time, s, in so many rows; it is slower than its
rows if this share repeats; rows may only be called repeated if all axes change in the last share of
the changes."""
MOST_REPEATED = 0.1
"""Share of repeated rows from which a recording cannot be believed."""
REST_STD = 0.3
"""Standard deviation of the specific force, m/s², below which a gyro may read 0."""
_SIGNED = np.array(
    [
        np.diag(signs) @ np.eye(3)[list(order)]
        for order in itertools.permutations(range(3))
        for signs in itertools.product((1.0, -1.0), repeat=3)
    ]
)
"""The 48 ways in which axes can be permuted and mirrored."""


class ImuSamples(NamedTuple):
    """Both sensors of an IMU at the same stamps."""

    time: Float[np.ndarray, " n"]
    """s, increasing."""
    gyro: Float[np.ndarray, "n 3"]
    """rad/s, or the unit in question."""
    accel: Float[np.ndarray, "n 3"]
    """m/s²."""


# --- the turning of gravity


def agreement(imu: ImuSamples, scale: float = 1.0, clock: float = 1.0) -> tuple[float, float]:
    """How well the gyro, times `scale`, on a clock of which a second lasts `clock` s, explains the
    turning of gravity: (error, contrast), and (inf, 1) if the samples do not show it.

    The error is the mean square change of the force turned back relative to that of the force
    itself, the contrast the error of the opposite rotation relative to it.
    """
    seconds = _window(imu) if clock == 1.0 else WINDOW / clock
    errors = _errors(imu, seconds, scale * clock * np.stack([np.eye(3), -np.eye(3)]))
    return (np.inf, 1.0) if errors is None else (float(errors[0]), float(errors[1] / errors[0]))


def is_supported(error: float, contrast: float) -> bool:
    """Whether an agreement shows that the gyro explains the turning of gravity."""
    return bool(error < 1.0 and contrast > LEAST_CONTRAST)


def is_clock_supported(imu: ImuSamples) -> bool:
    """Whether the gyro explains the turning of gravity, and no clock of `NEAR_CLOCKS` does so
    clearly better: a test for clocks that are in doubt anyway, which fails for some good ones."""
    error, contrast = agreement(imu)
    others = [agreement(imu, clock=clock)[0] for clock in NEAR_CLOCKS]
    return is_supported(error, contrast) and min(others) > CLEARLY * error


def contradiction(imu: ImuSamples, read_as: str | None = None) -> tuple[float, str, str] | None:
    """The axes, sign, unit or clock by which the gyro explains the turning of gravity best, if it
    leaves an error smaller by `DOUBT`: (factor, problem, remedy). `read_as` is the unit as which
    the gyro was read, rad/s or deg/s; None: any other."""
    (error, contrast), span = agreement(imu), float(np.ptp(imu.time))
    is_clear = error < CLEAR_ERROR and contrast > CLEAR_CONTRAST
    if is_clear or not np.isfinite(error) or span < SHORTEST:
        return None
    readings = []
    for clock in CLOCKS:
        factor, word = (1 / clock, "faster") if clock < 1 else (clock, "slower")
        problem = f"by the turning of gravity its samples come {factor:g} times {word} than its"
        remedy = "the clock is wrong: give --time-unit (s per stamp) or --sample-rate (Hz)"
        readings.append((*agreement(imu, clock=clock), f"{problem} stamps say", remedy))
    looks = [
        (agreement(imu, scale), unit, unit) for unit, scale in SCALES.items() if unit != read_as
    ]
    # One count in 65.5 is almost 1 deg/s, so it matters as what they were read.
    degree = DEGREE if read_as == "rad/s" else 1.0
    by_counts = {n: agreement(imu, degree / n) for n in COUNTS_OF_DEGREE}
    best_counts = min(by_counts, key=lambda n: by_counts[n][0])
    best_error = by_counts[best_counts][0]
    likely = [f"{n:g}" for n, (other, _) in by_counts.items() if other <= DOUBT * best_error]
    unit = f"{best_counts:g}/deg/s"
    if len(likely) > 1:  # gravity does not tell them apart
        unit += f" (or another of {' and '.join(likely)}, by the sensor's data sheet)"
    looks.append((by_counts[best_counts], f"raw counts, {' or '.join(likely)} in 1 deg/s,", unit))
    for agreed, words, unit in looks:
        problem = f"its gyro looks like {words} by the turning of gravity, and not as it was read"
        remedy = f"state the unit of the gyro, as by --gyro-unit {unit}"
        readings.append((*agreed, problem, remedy))
    errors = _errors(imu, _window(imu), _SIGNED)
    assert errors is not None  # as for the stated reading
    best = _SIGNED[np.argmin(errors)]
    opposite = errors[(_SIGNED == -best).all(axis=(1, 2))][0]
    if (best == -np.eye(3)).all() or span >= SHORT or error > SHORT_DOUBT * errors.min():
        readings.append((errors.min(), opposite / errors.min(), *_of_axes(best)))
    factors = [
        (error / other, problem, remedy)
        for other, contrast, problem, remedy in readings
        if is_supported(other, contrast) and error > DOUBT * other
    ]
    return max(factors, default=None)


def check_turning(
    imu: ImuSamples,
    source: object,
    adapt: Callable[[str], str] = str,
    read_as: str | None = None,
) -> list[str]:
    """Warnings about a gyro that gravity may contradict. Raises `InputError` where it certainly
    does. `imu` is in SI units; `adapt` gives the remedy that the format of the recording allows;
    `read_as` as in `contradiction`."""
    factor, problem, remedy = contradiction(imu, read_as) or (0.0, "", "")
    remedy = adapt(remedy)
    if factor > PROOF and np.ptp(imu.time) >= SHORT:
        raise InputError(source, problem, remedy)
    return [f"sensors: {problem}; {remedy}"] if factor else []


def _of_axes(turn: Float[np.ndarray, "3 3"]) -> tuple[str, str]:
    """Problem and remedy of a `turn` that maps the gyro's axes to those of the accelerometer."""
    signed = [f"{'-' if row.sum() < 0 else ''}{{}}{'xyz'[np.abs(row).argmax()]}" for row in turn]
    named = zip("xyz", signed, strict=True)
    words = " ".join(f"gyro_{axis}={name.format('gyro_')}" for axis, name in named)
    if (turn == -np.eye(3)).all():
        problem = "gravity turns against the gyro: its sign is wrong, or the axes are left-handed"
        return problem, f"exchange two axes of both sensors, or --columns {words}"
    axes = ", ".join(name.format("") for name in signed)
    problem = "gravity does not turn as the gyro says: the sensors contradict each other, and the"
    problem += f" accelerometer's axes seem to be ({axes}) of the gyro"
    return problem, f"give both sensors the same axes, as by --columns {words}"


def _window(imu: ImuSamples) -> float:
    """Length of the windows, s, shorter in a recording of less than two of them."""
    return min(WINDOW, float(np.ptp(imu.time)) / 2)


def _errors(
    imu: ImuSamples, seconds: float, turns: Float[np.ndarray, "k 3 3"]
) -> Float[np.ndarray, " k"] | None:
    """Error of the force turned back by the gyro times each of `turns`, over windows of `seconds`
    (see `agreement`); None if too few windows have no gap, or if gravity has not turned. The bias
    is zero or the median, whichever is better."""
    some = slice(None, None, max(len(imu.time) // MANY, 1))
    step = float(np.median(np.diff(imu.time)[some]))
    count = round(seconds / step)
    starts = np.arange(0, len(imu.time) - count + 1, max(count // 4, 1))
    if count < LEAST_STEPS or not len(starts):
        return None
    thinning = max(count // MOST_STEPS, 1)
    count -= count % (2 * thinning)
    chosen = np.linspace(0, len(starts) - 1, min(len(starts), MOST_WINDOWS)).astype(int)
    rows = starts[chosen, None] + np.arange(count)
    rows = rows[imu.time[rows[:, -1]] - imu.time[rows[:, 0]] < 1.5 * seconds]
    if len(rows) < LEAST_WINDOWS:
        return None
    gyro, force = (
        values[rows].reshape(len(rows), -1, thinning, 3).mean(axis=2)
        for values in (imu.gyro, imu.accel)
    )
    half = force.shape[1] // 2
    halves = np.stack([force[:, :half].mean(axis=1), force[:, half:].mean(axis=1)])
    strength, unturned = _relative_change(np.moveaxis(halves, -1, 1))
    if strength < LEAST_TURN**2:
        return None
    biases = np.stack([np.zeros(3), np.median(imu.gyro[some], axis=0)])
    rates = np.einsum("kij,bwnj->nikbw", turns, gyro - biases[:, None, None])
    angles = 0.25 * step * thinning * (rates[1:] + rates[:-1])  # half of each turn
    size = np.linalg.norm(angles, axis=1, keepdims=True)
    steps = np.concatenate([np.cos(size), angles * np.sinc(size / np.pi)], axis=1)
    attitude = np.zeros_like(steps[0])
    attitude[0] = 1.0
    turned = np.zeros((2, *attitude[1:].shape))
    for index in range(2 * half):
        axis, pull = attitude[1:], force[:, index].T[:, None, None]
        side = 2.0 * np.cross(axis, pull, axis=0)
        turned[index // half] += pull + attitude[0] * side + np.cross(axis, side, axis=0)
        if index + 1 < 2 * half:
            attitude = quaternion_product(attitude, steps[index], axis=0)
    return np.maximum(_relative_change(turned / half)[1].min(axis=1) / unturned, 1e-12)


def _relative_change(halves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean square change between the halves (2, 3, ..., w) of windows, and the same relative to
    their mean square, because a force that is spun round has a small mean and a small change."""
    change = np.asarray(((halves[1] - halves[0]) ** 2).sum(axis=0).mean(axis=-1))
    return change, np.asarray(change / (halves**2).sum(axis=1).mean(axis=(0, -1)))


# --- dead and hung sensors


def check_alive(values: Float[np.ndarray, "n 3"], name: str, source: object) -> list[str]:
    """Warnings about an axis that always reads the same. Raises `InputError` if all do."""
    still = np.ptp(values, axis=0) == 0.0
    if still.all():
        problem = f"field '{name}' reads ({', '.join(f'{x:g}' for x in values[0])}) throughout"
        remedy = f"the sensor was off or is missing: record with a {name} that works"
        raise InputError(source, problem, remedy)
    axes = [f"{name}_{axis} reads {values[0, i]:g}" for i, axis in enumerate("xyz") if still[i]]
    return [f"sensors: {' and '.join(axes)} throughout: this axis is dead"] if axes else []


def repeats(
    time: Float[np.ndarray, " n"], values: Float[np.ndarray, "n 3"]
) -> tuple[Bool[np.ndarray, " n"], bool]:
    """Rows that repeat the row before and are not samples, and whether that is because the sensor
    is slower than its rows; otherwise it hung. A sensor so coarse that equal rows may be measured
    repeats none."""
    same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    changes = np.diff(values, axis=0)[~same[1:]]
    hung = np.zeros(len(time), dtype=bool)
    if not len(changes) or (changes != 0).all(axis=1).mean() < FINE_SHARE:
        return hung, False
    for start, stop in spans(same):
        if stop - start >= MOST_HELD and time[stop - 1] - time[start - 1] >= LONGEST_HOLD:
            hung[start:stop] = True
    is_slower = bool(same[~hung].mean() > HELD_SHARE)
    return (same, True) if is_slower else (hung, False)


def find_rest(imu: ImuSamples, hung: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Which of the `hung` rows of a gyro read 0 while the accelerometer rests: some gyros suppress
    small rates."""
    still = hung & (imu.gyro == 0.0).all(axis=1)
    for start, stop in spans(still):
        still[start:stop] = (imu.accel[start:stop].std(axis=0) < REST_STD).all()
    return still


def find_implausible(sequence: Sequence) -> tuple[str, ...]:
    """Reasons why the sensors of a recording on a uniform clock cannot be believed, one sentence
    each."""
    valid = np.ones(len(sequence.time), bool) if sequence.imu_valid is None else sequence.imu_valid
    imu = ImuSamples(*(field[valid] for field in (sequence.time, sequence.gyro, sequence.accel)))
    reasons = [] if imu.gyro.any() else ["the gyro reads 0 throughout"]
    for name, values in (("gyro", imu.gyro), ("accel", imu.accel)):
        rows = repeats(imu.time, values)[0]
        share = (rows & ~find_rest(imu, rows & (name == "gyro"))).mean()
        if share > MOST_REPEATED:
            reasons.append(f"{name} repeats its values in {share:.0%} of the samples")
    try:
        check_turning(imu, sequence.name)
    except InputError as error:
        reasons.append(error.parts[1])
    return tuple(reasons)
