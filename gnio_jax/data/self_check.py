"""The physical self-check: do IMU and reference of a recording describe the same motion?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax.data.dataset import Dataset
from gnio_jax.data.physics import find_implausible
from gnio_jax.data.resampling import check_count
from gnio_jax.numerics import (
    convolve,
    integrate_gyro,
    last_true,
    midpoints,
    quaternion_product,
    quaternions,
    rotations,
    spans,
)
from gnio_jax.types import GRAVITY, Sequence

WINDOW_SECONDS = 10.0
"""Time over which the gyro is integrated, s."""
LIVELY = 0.2
"""Horizontal acceleration, m/s² rms, above which the positions must show it too."""
TRIANGLE_SECONDS = 0.1
"""Half the width of the triangles over which accelerations are compared, s."""
MOST_GRAVITY_ERROR, MOST_GYRO_DEGREES = 0.5, 5.0
"""Largest error of the mean of R·accel, m/s², and largest error of the gyro against the reference's
rotation in the median window, degrees."""
MOST_GYRO_SCALE = 0.01
"""Additional error of the gyro, as a share of the angle turned: a phone's gyro reads 1 to 3 % too
little or too much, which is 4° of the angle that a walker's hand turns in 10 s."""
FASTEST_MEDIAN, LEAST_CORRELATION = 3.0, 0.3
"""Largest median speed of a pedestrian, m/s, and smallest correlation of the horizontal
accelerations."""


class SelfCheck(NamedTuple):
    """Figures that compare IMU and reference of one sequence; NaN if they cannot be computed."""

    duration: float
    """s."""
    rate: float
    """Rate from the median interval, Hz."""
    gravity_mean: Float[np.ndarray, "3"] = np.full(3, np.nan)
    """Mean of R·accel in the world minus the mean acceleration of the reference, (v_end −
    v_start)/T, m/s², which should be (0, 0, 9.81). With waypoints its magnitude is in z."""
    gyro_consistency_degrees: float = np.nan
    """Median angle between gyro-integrated and reference rotation over 10 s windows, after one
    constant bias is removed. NaN for a sequence shorter than two windows, because the bias would
    absorb every error."""
    median_speed: float = np.nan
    """m/s."""
    accel_correlation_horizontal: float = np.nan
    """Correlation of the second difference of the position with R·accel + g, x and y together."""
    share_valid: float = np.nan
    """Share of the samples whose reference can be trusted; NaN with waypoints."""
    failures: tuple[str, ...] = ()
    """Reasons why the sequence is implausible, one sentence each; empty if it may be used."""


def self_check(sequence: Sequence, pedestrian: bool = True, correlates: bool = True) -> SelfCheck:
    """Do IMU and reference describe the same motion? `sequence` must be on a uniform clock.

    A sequence fails if the mean of R·accel, minus the reference's own mean acceleration, differs
    from (0, 0, 9.81) by more than 0.5 m/s²; if the gyro differs from the reference orientation in
    the median window by more than 5° plus 1 % of the angle turned; if the median speed of a
    pedestrian exceeds 3 m/s; or if a horizontal acceleration above 0.2 m/s² rms correlates with
    that of the positions by less than 0.3, unless the dataset says that they need not
    (`correlates`). Standing still is no failure, and neither is a recording that is too short for
    the gyro's windows. With waypoints only gravity and the speed between them can be checked.
    Raises `InputError` for a sequence of less than two samples.
    """
    check_count(sequence)
    step = float(np.median(np.diff(sequence.time)))
    check = SelfCheck(float(sequence.time[-1] - sequence.time[0]), 1.0 / step)
    strength, has_windows = 0.0, True
    if sequence.waypoints is not None:
        check = _with_waypoints(check, sequence, step)
    elif not sequence.valid.any():
        return check._replace(share_valid=0.0, failures=("no sample has a valid reference",))
    else:
        check, strength, has_windows = _with_reference(check, sequence, step)
    turned = np.degrees(float(np.linalg.norm(sequence.gyro, axis=1).mean())) * WINDOW_SECONDS
    gravity_error = float(np.linalg.norm(check.gravity_mean - [0.0, 0.0, GRAVITY]))
    correlation, degrees = check.accel_correlation_horizontal, check.gyro_consistency_degrees
    failures = []
    if not gravity_error <= MOST_GRAVITY_ERROR:
        mean = ", ".join(f"{value:.2f}" for value in check.gravity_mean)
        deviation = f"off (0, 0, 9.81) by {gravity_error:.2f}"
        clipped = float(sequence.attributes.get("accel_clipped", 0.0))
        why = f" (its accelerometer clips in {clipped:.0%} of the samples)" if clipped else ""
        failures.append(f"mean of R·accel is ({mean}) m/s², {deviation}{why}")
    window = f"window of {WINDOW_SECONDS:g} s"
    if not has_windows and check.duration >= 2.0 * WINDOW_SECONDS:
        failures.append(f"no {window} has a valid reference at its ends")
    elif degrees > MOST_GYRO_DEGREES + MOST_GYRO_SCALE * turned:
        deviation = f"off the reference orientation by {degrees:.1f}°"
        failures.append(
            f"gyro is {deviation} in the median {window}, in which it turns {turned:.0f}°"
        )
    if pedestrian and check.median_speed > FASTEST_MEDIAN:
        failures.append(f"median speed is {check.median_speed:.1f} m/s, too fast for a pedestrian")
    # The correlation is NaN if the positions do not move at all.
    if correlates and strength > LIVELY and not correlation >= LEAST_CORRELATION:
        problem = f"correlates by only {correlation:.2f} with R·accel"
        failures.append(f"horizontal acceleration of the positions {problem}")
    return check._replace(failures=tuple(failures))


def check_sequence(sequence: Sequence, dataset: Dataset) -> SelfCheck:
    """`self_check` with the requirements of the dataset.

    The attributes `check_pedestrian` and `check_correlation` of a converted recording have
    priority, because they are those of its original dataset.
    """
    attributes = sequence.attributes
    pedestrian = bool(attributes.get("check_pedestrian", dataset.pedestrian))
    check = self_check(
        sequence, pedestrian, bool(attributes.get("check_correlation", dataset.correlates))
    )
    if dataset.needs_reference or sequence.valid.any():
        return check
    return check._replace(failures=find_implausible(sequence))


def _with_reference(
    check: SelfCheck, sequence: Sequence, step: float
) -> tuple[SelfCheck, float, bool]:
    """The figures, the horizontal acceleration by the accelerometer (m/s² rms), and whether the
    gyro could be integrated over at least one window."""
    valid, velocity = sequence.valid, sequence.velocity
    force = rotations(_held_attitude(sequence)).apply(sequence.accel)
    # The reference's mean acceleration, from the velocities at the ends of its valid stretches.
    first, stop = spans(valid).T
    seconds = float((stop - 1 - first).sum()) * step
    velocity_gain = (velocity[stop - 1] - velocity[first]).sum(axis=0)
    starts, gyro_errors = gyro_windows(sequence)
    # Windows that all overlap count as one window, and one bias can explain any single window.
    independent = starts.size > 0 and float(np.ptp(starts)) > WINDOW_SECONDS - 0.5 * step
    correlation, strength = _accel_correlation(sequence, force, step)
    check = check._replace(
        gravity_mean=force[valid].mean(axis=0) - velocity_gain / max(seconds, step),
        gyro_consistency_degrees=float(np.median(gyro_errors)) if independent else np.nan,
        median_speed=float(np.median(np.linalg.norm(velocity[valid], axis=1))),
        accel_correlation_horizontal=correlation,
        share_valid=float(valid.mean()),
    )
    return check, strength, starts.size > 0


def _with_waypoints(check: SelfCheck, sequence: Sequence, step: float) -> SelfCheck:
    """The figures of a recording with waypoints instead of poses.

    The mean specific force over a window, in the frame of its gyro-integrated attitude, must have
    the magnitude of gravity, because a walker hardly changes velocity in it. Its direction is not
    known.
    """
    assert sequence.waypoints is not None
    stamps, position = sequence.waypoints
    force = integrate_gyro(sequence.gyro, step).apply(sequence.accel)
    length = min(round(WINDOW_SECONDS / step), len(force))
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(force, axis=0)])
    means = np.linalg.norm((summed[length:] - summed[:-length]) / length, axis=1)
    legs = np.linalg.norm(np.diff(position, axis=0), axis=1) / np.diff(stamps)
    gravity = np.array([0.0, 0.0, np.median(means)])
    speed = float(np.median(legs))
    return check._replace(gravity_mean=gravity, median_speed=speed)


def _held_attitude(sequence: Sequence) -> Float[np.ndarray, "n 4"]:
    """The last valid attitude at each sample. Invalid rows are left out of every mean; they only
    bridge the gyro's windows."""
    return sequence.orientation[last_true(sequence.valid)]


# --- gyro


def gyro_windows(
    sequence: Sequence, window_seconds: float = WINDOW_SECONDS
) -> tuple[Float[np.ndarray, "w"], Float[np.ndarray, "w"]]:
    """(start s, degrees) of windows that start every half window.

    The degrees are the angle between the rotation integrated from the gyro and the reference's,
    after the constant bias that explains most of them is removed. A recording shorter than a window
    is one window.
    """
    time, valid = sequence.time, sequence.valid
    step = float(np.median(np.diff(time)))
    half = max(min(round(window_seconds / step), len(time) - 1) // 2, 1)
    length = 2 * half
    starts = np.arange(0, len(time) - length, half)
    starts = starts[valid[starts] & valid[starts + length]]
    if not starts.size:
        return np.zeros(0), np.zeros(0)
    attitude = _held_attitude(sequence)
    rotation = rotations(attitude).as_matrix()
    reference = rotations(attitude[starts]).inv() * rotations(attitude[starts + length])
    # exp(J b) R ≈ rotation integrated from gyro + b, J = R_startᵀ Σ R_k dt
    summed = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(rotation * step, axis=0)])
    jacobian = np.einsum("wji,wjk->wik", rotation[starts], summed[starts + length] - summed[starts])
    # A rate sampled at the stamps is most accurate in the middle of its interval.
    middle, halves = midpoints(sequence.gyro), starts // half
    middle = middle[: len(middle) // half * half]

    def error(bias: np.ndarray) -> np.ndarray:
        turns = quaternions(Rotation.from_rotvec((middle - bias) * step))
        turned = rotations(_product(turns.reshape(-1, half, 4)))
        return (turned[halves] * turned[halves + 1] * reference.inv()).as_rotvec()

    bias = np.zeros(3)
    for _ in range(2):
        bias = bias + _bias_correction(error(bias), jacobian)
    return time[starts], np.degrees(np.linalg.norm(error(bias), axis=1))


def _product(turns: Float[np.ndarray, "w n 4"]) -> Float[np.ndarray, "w 4"]:
    """Products of n quaternions (wxyz), computed pairwise."""
    turns = np.ascontiguousarray(turns.T)
    while (count := turns.shape[1]) > 1:
        paired = quaternion_product(turns[:, : count - 1 : 2], turns[:, 1::2], axis=0)
        turns = np.concatenate([paired, turns[:, count - count % 2 :]], axis=1)
    return turns[:, 0].T


def _bias_correction(
    error: Float[np.ndarray, "w 3"], jacobian: Float[np.ndarray, "w 3 3"]
) -> Float[np.ndarray, "3"]:
    """The bias b with the smallest Σ|error − J b|. A sum of norms is used, so that one bad window
    does not change b much."""
    correction = np.zeros(3)
    for _ in range(10):
        weight = 1.0 / np.maximum(np.linalg.norm(error - jacobian @ correction, axis=1), 1e-3)
        normal = np.einsum("w,wji,wjk->ik", weight, jacobian, jacobian)
        moment = np.einsum("w,wji,wj->i", weight, jacobian, error)
        correction = np.linalg.lstsq(normal, moment, rcond=1e-9)[0]
    return correction


# --- accelerometer


def _accel_correlation(sequence: Sequence, force: np.ndarray, step: float) -> tuple[float, float]:
    """Correlation, and rms m/s² of the inertial side, of horizontal accelerations over triangles of
    ± `TRIANGLE_SECONDS`.

    The second difference of the position over ± h is exactly the acceleration weighted by the
    triangle of that width.
    """
    h = max(round(TRIANGLE_SECONDS / step), 1)
    if len(sequence.time) < 4 * h:
        return float("nan"), 0.0
    position = sequence.position[:, :2]
    geometric = (position[2 * h :] - 2.0 * position[h:-h] + position[: -2 * h]) / (h * step) ** 2
    triangle = 1.0 - np.abs(np.arange(-h, h + 1)) / h
    inertial = convolve(force[:, :2], triangle / triangle.sum())
    broken = np.concatenate([[0], np.cumsum(~sequence.valid)])
    whole = broken[2 * h + 1 :] == broken[: -2 * h - 1]
    if whole.sum() < 2 * h:
        return float("nan"), 0.0
    geometric, inertial = geometric[whole], inertial[whole]
    geometric, inertial = geometric - geometric.mean(axis=0), inertial - inertial.mean(axis=0)
    strength = float(np.sqrt((inertial**2).sum(axis=1).mean()))
    scale = float(np.sqrt((geometric**2).sum() * (inertial**2).sum()))
    if scale == 0:
        return float("nan"), strength
    return float((geometric * inertial).sum()) / scale, strength
