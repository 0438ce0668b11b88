"""The stream of the IMU as the filter takes it: without holes, and without the low-pass of the IMU.

The filter holds the last sample through short drop-outs and coasts through long ones, and both
increase the covariance.

All of this file is ours; the paper and TLIO take a complete stream for granted. The error of a held
sample grows with its age and keeps its sign over a gap, so it is taken as fully correlated: the
variances of a gap's samples add up to the square of the summed standard deviations. Beyond
`bridge_seconds` no sample is held: attitude and velocity stay constant.

Some IMUs pass their output through a low-pass. In a first-order one with the time constant τ the
output x follows the true signal u by u = x + τ dx/dt. A rate that lags by τ makes the attitude lag
by τ ω in every turn.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import ImuMemory
from gnio_jax.types import Array


class Gap(NamedTuple):
    """The additional uncertainty of n samples."""

    gyro_variance: Float[Array, "*n"]
    """Added to the variance of the white noise, (rad/s)²."""
    accel_variance: Float[Array, "*n"]
    """The same of the accelerometer, (m/s²)²."""
    used: Float[Array, "*n"]
    """1, or 0 where the filter coasts."""
    missing: Bool[Array, "*n"]
    """Whether the filter holds an older sample or coasts. The variances do not tell it, because the
    settings may make them 0."""


class Imu(NamedTuple):
    """A stream of raw samples without holes: no bias is subtracted from them."""

    gyro: Float[Array, "*n 3"]
    """rad/s"""
    accel: Float[Array, "*n 3"]
    """m/s²"""
    gap: Gap | None
    """None where the stream is complete."""
    variance: Float[Array, "*n 6"] | None = None
    """Variances of the errors of [accel, gyro] in the place of the filter's densities, (m/s²)² and
    (rad/s)², of corrected samples; None: the densities hold."""
    output: tuple[Float[Array, "*n 3"], Float[Array, "*n 3"]] | None = None
    """Gyro and accel as the IMU gave them, where its low-pass was undone in those above; else
    None."""


def no_gap(n: int, dtype: np.dtype) -> Gap:
    """The gap of n samples where none is missing."""
    zeros = np.zeros(n, dtype)
    return Gap(zeros, zeros, np.ones(n, dtype), np.zeros(n, bool))


def after_window(
    stream: Imu, window: Float[Array, "r 7"] | None, config: FilterConfig
) -> tuple[Imu, Float[Array, "r 7"]]:
    """The samples of `FilterState.window` (zeros if there are none yet) with the stream after them,
    and the last samples of the two together, which are the window of a later run."""
    used = np.ones(len(stream.gyro)) if stream.gap is None else stream.gap.used
    dtype, reach = stream.gyro.dtype, config.reach
    used = jnp.asarray(used, dtype)[:, None]
    before = jnp.zeros((reach, 7), dtype) if window is None else window
    rows = jnp.concatenate([before, jnp.concatenate([stream.gyro, stream.accel, used], axis=1)])
    gap = None
    if window is not None or stream.gap is not None:
        # Only `used` of the samples before the stream is remembered, and windows read nothing else.
        gap = no_gap(len(rows), dtype)._replace(used=rows[:, 6])
    return Imu(rows[:, :3], rows[:, 3:6], gap), rows[-reach:]


def bridge(
    gyro: Float[Array, "n 3"],
    accel: Float[Array, "n 3"],
    valid: Bool[Array, "n"] | None,
    memory: ImuMemory,
    config: FilterConfig,
) -> tuple[Imu, Float[Array, "n"], ImuMemory]:
    """The stream with its holes filled, the age of each held sample in s (0 for a sample that is
    present), and the memory after it.

    A sample is missing where `valid` is False or a value is not finite. Without `valid` the stream
    is taken to be complete. The low-pass of the IMU is undone in the stream and not in the memory,
    which has raw samples (`FilterConfig.low_pass_seconds`).
    """
    n = gyro.shape[0]
    if valid is None:
        nothing_missing = jnp.zeros_like(memory.missing)
        after = memory._replace(gyro=gyro[-1], accel=accel[-1], missing=nothing_missing)
        age, begun = jnp.zeros(n, memory.missing.dtype), jnp.ones(n, bool)
        imu = without_low_pass(Imu(gyro, accel, None), memory, begun, age, config)
        return imu, jnp.zeros(n, gyro.dtype), after
    valid = valid & jnp.all(jnp.isfinite(gyro), axis=1) & jnp.all(jnp.isfinite(accel), axis=1)
    # The remembered sample is number 0, before the stream; `last` is the number of the last sample
    # that is present.
    number = jnp.arange(1, n + 1)
    last = jax.lax.cummax(jnp.where(valid, number, 0))
    age = jnp.where(last == 0, memory.missing + number, number - last)
    begun = jnp.all(jnp.isfinite(memory.gyro)) | (last > 0)  # there is a sample to hold

    gyro = _hold(gyro, memory.gyro, valid, last)
    accel = _hold(accel, memory.accel, valid, last)
    limit = max(round(config.bridge_seconds / config.dt), 1)
    coasting = (age > limit) | ~begun
    variance = _variance(jnp.where(begun, age, limit + 1), limit).astype(gyro.dtype)
    gap = Gap(
        gyro_variance=variance * config.gap_gyro_std**2,
        accel_variance=variance * config.gap_accel_std**2,
        used=jnp.where(coasting, 0.0, 1.0).astype(gyro.dtype),
        missing=age > 0,
    )
    after = memory._replace(
        gyro=jnp.where(begun[-1], gyro[-1], jnp.nan),
        accel=jnp.where(begun[-1], accel[-1], jnp.nan),
        missing=age[-1].astype(memory.missing.dtype),
    )
    imu = without_low_pass(Imu(gyro, accel, gap), memory, begun, age, config)
    return imu, (age * config.dt).astype(gyro.dtype), after


def without_low_pass(
    imu: Imu,
    memory: ImuMemory,
    begun: Bool[Array, "n"],
    age: Int[Array, "n"],
    config: FilterConfig,
) -> Imu:
    """The samples x of a stream without holes as x + τ dx/dt, with the difference from the sample
    before.

    Args:
        imu: The stream.
        memory: The memory before it.
        begun: Whether there was a sample at or before each row.
        age: Age of each row's sample, in samples. The first sample after a hole differs from one
            that is older than a step, and its difference is divided by that time.
        config: The filter's settings.
    """
    if config.low_pass_seconds == 0:
        return imu
    begun = jnp.concatenate([jnp.all(jnp.isfinite(memory.gyro))[None], begun[:-1]])
    steps = 1 + jnp.concatenate([memory.missing[None], age[:-1]])

    def undone(samples: Float[Array, "n 3"], last: Float[Array, "3"]) -> Float[Array, "n 3"]:
        last = jnp.where(jnp.isfinite(last), last, 0.0)
        step = jnp.diff(jnp.concatenate([last[None], samples]), axis=0)
        slope = jnp.where(begun[:, None], step, 0.0) / (steps * config.dt)[:, None]
        return samples + config.low_pass_seconds * slope.astype(samples.dtype)

    gyro, accel = undone(imu.gyro, memory.gyro), undone(imu.accel, memory.accel)
    return Imu(gyro, accel, imu.gap, output=(imu.gyro, imu.accel))


def _hold(
    samples: Float[Array, "n 3"],
    remembered: Float[Array, "3"],
    valid: Bool[Array, "n"],
    last: Int[Array, "n"],
) -> Float[Array, "n 3"]:
    """Each sample, or the last one that is present where it is missing."""
    clean = jnp.where(valid[:, None], samples, 0.0)
    before = jnp.where(jnp.isfinite(remembered), remembered, 0.0)
    return jnp.concatenate([before[None], clean])[last]


def _variance(age: Int[Array, "n"], limit: int) -> Float[Array, "n"]:
    """Variance of a sample held for `age` samples, in units of the gap's own variance. Sums over a
    gap have the standard deviation Σ e_j, where e_j = min(j / limit, 1) is the error of the j-th
    sample."""

    def summed_error(j: Array) -> Array:
        ramp = jnp.minimum(j, limit)
        return ramp * (ramp + 1) / (2 * limit) + (j - ramp)

    return summed_error(age) ** 2 - summed_error(age - 1) ** 2
