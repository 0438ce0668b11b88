"""The low-pass before an IMU is resampled to a lower rate.

One design for recordings (`data.resample`) and streams (`filtering.Tracker`).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

STOP_BAND = 70.0
"""Attenuation of the stop band, dB."""


def decimation_factor(native: float, rate: float) -> int:
    """Ratio of the rate of the low-pass input to `rate` (Hz), for an IMU at `native` Hz.

    1 means that no low-pass is needed: the IMU is no faster than `rate`, or by less than 5 %. If
    `native` is a multiple of `rate`, the low-pass takes the samples themselves. Otherwise it takes
    values that are interpolated twice as densely, so that errors of the interpolation above the
    IMU's rate are filtered out and do not alias.
    """
    ratio = max(native / rate, 1.0)
    return round(ratio) if abs(ratio - round(ratio)) <= 0.05 else 2 * math.ceil(ratio)


def low_pass(factor: int) -> Float[np.ndarray, "taps"]:
    """Symmetric FIR with sum 1 for a rate that is lower by `factor` (2 or more).

    Kaiser's window: the pass band ends at 0.8 of the new Nyquist frequency, the stop band begins at
    it and is 70 dB down. The group delay is half the taps, about 22 samples of the new rate.
    """
    # Kaiser (1974). `scipy.signal.kaiserord` gives the same; importing it takes half a second.
    count = math.ceil((STOP_BAND - 7.95) / (2.285 * math.pi * 0.2 / factor) + 1)
    half, beta = count // 2, 0.1102 * (STOP_BAND - 8.7)
    taps = np.sinc(0.9 / factor * np.arange(-half, half + 1)) * np.kaiser(2 * half + 1, beta)
    return taps / taps.sum()
