"""The low-pass before an IMU is taken to a lower rate.

One design for recordings (`data.resample`) and streams (`filtering.Tracker`).
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float

STOP_BAND = 70.0
"""dB by which the low-pass attenuates what it does not keep."""


def decimation_factor(native: float, rate: float) -> int:
    """The low-pass runs at so many times `rate` (Hz, of what comes out); the IMU at `native` Hz.

    1 where none is needed: the IMU is no faster, or by less than 5 %. At a multiple of `rate` the
    low-pass takes the IMU's own samples. Else it takes values interpolated twice as densely: what
    interpolation adds above the IMU's rate is then filtered out, too, instead of aliasing.
    """
    ratio = max(native / rate, 1.0)
    return round(ratio) if abs(ratio - round(ratio)) <= 0.05 else 2 * math.ceil(ratio)


def low_pass(factor: int) -> Float[np.ndarray, "taps"]:
    """Symmetric FIR that keeps what `factor` (2 or more) times fewer samples can carry, of sum 1.

    Kaiser's window: the pass band ends at 0.8 of the new Nyquist frequency, the stop band begins at
    it and is 70 dB down. The group delay is half the taps, about 22 samples of the new rate.
    """
    # Kaiser (1974), as `scipy.signal.kaiserord` has it, which takes half a second to import.
    count = math.ceil((STOP_BAND - 7.95) / (2.285 * math.pi * 0.2 / factor) + 1)
    half, beta = count // 2, 0.1102 * (STOP_BAND - 8.7)
    taps = np.sinc(0.9 / factor * np.arange(-half, half + 1)) * np.kaiser(2 * half + 1, beta)
    return taps / taps.sum()
