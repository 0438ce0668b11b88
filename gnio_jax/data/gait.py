"""Whether somebody walks with the IMU: the steps in a recording (`gait`).

A network reads a walk from its steps. Without them, in a car, on a trolley or on skis, its
displacements are those of no motion that it has learnt, and no covariance shows this.

A step shakes the IMU and turns it, again and again in the same way. The test asks for this: over
four seconds, specific force and angular rate must both agree with themselves a step or a stride
later.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from gnio_jax.types import GRAVITY

RATE = 25.0
"""Rate at which the steps are looked for, Hz."""
SMOOTH, SLOW = 0.022, 0.4
"""Standard deviations of the two Gaussians, s, whose difference keeps about 0.3 to 6 Hz."""
WINDOW = 4.0
"""Length of a window, s; one begins at each second."""
PERIODS = 0.3, 2.0
"""Period of a step or a stride, s: from a run to a slow walk with the phone in a pocket."""
AGREEMENT = 0.48
"""Mean of the correlations of specific force and of angular rate with themselves a period later,
from which they repeat (ours)."""
SHAKEN, TURNED = 0.25, 0.1
"""Standard deviation of |accel|, m/s², and root mean square of the angular rate, rad/s, that a
window with steps has at least, in the band of steps (ours). A car turns a phone by 0.005 to
0.05 rad/s, a trolley by 0.06, and a walker by 0.2 to 3.6."""
REACH, SHARE = 7.5, 0.25
"""A second belongs to a walk if this share of the windows around it, up to so many seconds away,
have steps (ours)."""
MEASURED = 0.75
"""Share of the samples of a window or a second that must be measured for it to count (ours)."""
RUNNING = 5.0
"""Root mean square of |accel| − g over a second, m/s², above which the person may run (ours). Runs
have 92 % or more of such seconds (Tyrex). Walks have at most 1 % on Tyrex and OxIOD, for every way
of carrying, and up to 31 % in Indoor Location's mall. OxIOD's runs are as soft as walks."""
QUIET_ACCEL, QUIET_GYRO = 0.15, 0.04
"""Standard deviations over a second of |accel|, m/s², and of the angular rate, rad/s, below which
the IMU is quieter than in a hand (ours): it lies, or rides smoothly."""
NO_WALK = 0.15
"""A recording whose seconds within a walk are fewer than this share is none (ours). Cars and
trolleys have 0, drones up to 8 %. Walks have 82 to 100 % in a hand, in pockets and swinging. Of 23
slow ones while texting or at the ear, in Tyrex's small room, three are below it."""


class Gait(NamedTuple):
    """What the steps of a recording show, for each of its k whole seconds."""

    walking: Bool[np.ndarray, "k"]
    """Seconds within a walk or a run."""
    running: Bool[np.ndarray, "k"]
    """Those of them in which it is shaken as in a run."""
    quiet: Bool[np.ndarray, "k"]
    """Seconds in which it is quieter than in a hand."""

    @property
    def has_steps(self) -> bool:
        """Whether it is a walk, for a part of the time at least; also where it is too short to
        show steps."""
        return not len(self.walking) or bool(self.walking.mean() >= NO_WALK)


def detect_gait(
    gyro: Float[np.ndarray, "n 3"],
    accel: Float[np.ndarray, "n 3"],
    rate: float,
    valid: Bool[np.ndarray, "n"] | None = None,
) -> Gait:
    """Find the seconds in which somebody walks with the IMU.

    It needs neither attitude nor bias, and takes milliseconds for a minute. It cannot tell a walk
    from a phone that is swung as regularly as a walker's arm, or from one on a cyclist's leg.

    Args:
        gyro: Angular rate, body frame, rad/s, on a uniform clock.
        accel: Specific force, body frame, m/s², with gravity.
        rate: Samples per second, at least 10 Hz.
        valid: False where samples are missing and were interpolated; None if none is.

    Returns:
        A row for each whole second; none if there are less than `WINDOW` seconds.
    """
    seconds = int(len(gyro) / rate + 1e-6)
    if seconds < WINDOW:
        return Gait(*(np.zeros(0, dtype=bool) for _ in Gait._fields))
    size = np.linalg.norm(accel, axis=1)
    starts, clock = np.arange(seconds - int(WINDOW) + 1), np.arange(0.0, seconds, 1 / RATE)
    signals = np.column_stack([accel, gyro, size])
    smooth, slow = (gaussian_filter1d(signals, width * rate, axis=0) for width in (SMOOTH, SLOW))
    present = np.ones(len(gyro)) if valid is None else valid.astype(float)
    columns = [*(smooth - slow).T, present]
    band = np.stack([np.interp(clock * rate, np.arange(len(gyro)), x) for x in columns], axis=1)
    windows = band[(starts[:, None] * RATE + np.arange(WINDOW * RATE)).astype(int)]
    force, turning = windows[..., :3], windows[..., 3:6]
    shaken = windows[..., 6].std(axis=1) > SHAKEN
    shaken &= np.sum(turning**2, axis=2).mean(axis=1) > TURNED**2
    steps = shaken & _repeats((_agreement(force) + _agreement(turning)) / 2)
    distance = np.abs(np.arange(seconds)[:, None] + 0.5 - (starts + WINDOW / 2))
    near = ((distance <= REACH) & (windows[..., 7].mean(axis=1) >= MEASURED)).astype(float)
    walking = (near @ steps >= SHARE * near.sum(axis=1)) & (near @ steps > 0)
    running, quiet = np.zeros((2, seconds), dtype=bool)
    for second in range(seconds):
        rows = slice(round(second * rate), round((second + 1) * rate))
        if present[rows].mean() < MEASURED:
            continue
        running[second] = np.mean((size[rows] - GRAVITY) ** 2) > RUNNING**2
        quiet[second] = gyro[rows].var(axis=0).sum() < QUIET_GYRO**2
        quiet[second] &= size[rows].std() < QUIET_ACCEL
    return Gait(walking, walking & running, quiet)


def _agreement(windows: Float[np.ndarray, "w n 3"]) -> Float[np.ndarray, "w l"]:
    """Correlation of windows with themselves after each lag of whole samples, up to the longest
    period and a sample more."""
    centred = windows - windows.mean(axis=1, keepdims=True)
    correlations = []
    for lag in range(1, round(PERIODS[1] * RATE) + 2):
        early, later = centred[:, :-lag], centred[:, lag:]
        power = np.sum(early**2, axis=(1, 2)) * np.sum(later**2, axis=(1, 2))
        product = np.sum(early * later, axis=(1, 2))
        correlations.append(product / np.sqrt(np.maximum(power, 1e-12)))
    return np.stack(correlations, axis=1)


def _repeats(agreement: Float[np.ndarray, "w l"]) -> Bool[np.ndarray, "w"]:
    """Which windows agree with themselves by more than `AGREEMENT` after the period of a step or a
    stride, and by less than four fifths of it after a shorter period, as in a vibration."""
    inner = agreement[:, 1:-1]
    is_peak = (inner >= agreement[:, :-2]) & (inner > agreement[:, 2:])
    peaks = np.where(is_peak, inner, -1.0)
    first = round(PERIODS[0] * RATE) - 2  # the lag of the first peak is two samples
    of_steps, of_vibration = peaks[:, first:].max(axis=1), peaks[:, :first].max(axis=1)
    return (of_steps > AGREEMENT) & (of_vibration < 0.8 * of_steps)
