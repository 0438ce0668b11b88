"""Drop-outs of the IMU: short ones are bridged with the last sample, long ones coasted through, and
both cost certainty.

All of this file is ours; the paper and TLIO take a complete stream for granted. A held sample is
wrong by something that grows with its age and stays of one sign over a gap, so its error is taken
as fully correlated: a gap's samples get variances that add up to the square of the summed standard
deviations. Beyond `bridge_seconds` nothing is held: attitude and velocity stay as they are.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from gnio_jax.filtering.state import FilterConfig, ImuMemory
from gnio_jax.types import Array


class Gap(NamedTuple):
    """What is to be known of n samples beside their values."""

    gyro_variance: Float[Array, "*n"]
    """To be added to that of the white noise, (rad/s)²."""
    accel_variance: Float[Array, "*n"]
    """The same, (m/s²)²."""
    used: Float[Array, "*n"]
    """1, or 0 where the filter coasts."""


class Imu(NamedTuple):
    """A stream of raw samples without holes."""

    gyro: Float[Array, "*n 3"]
    """rad/s"""
    accel: Float[Array, "*n 3"]
    """m/s²"""
    gap: Gap | None
    """None where the stream is complete."""


def bridge(
    gyro: Float[Array, "n 3"],
    accel: Float[Array, "n 3"],
    valid: Bool[Array, "n"] | None,
    memory: ImuMemory,
    config: FilterConfig,
) -> tuple[Imu, Float[Array, "n"], ImuMemory]:
    """The stream with its holes filled, the age of each held sample in s (0 for one's own), and the
    memory after it.

    A sample is missing where `valid` is False or a value is not finite. Without `valid` the stream
    is taken to be complete.
    """
    n = gyro.shape[0]
    if valid is None:
        after = memory._replace(
            gyro=gyro[-1], accel=accel[-1], missing=jnp.zeros_like(memory.missing)
        )
        return Imu(gyro, accel, None), jnp.zeros(n, gyro.dtype), after
    valid = valid & jnp.all(jnp.isfinite(gyro), axis=1) & jnp.all(jnp.isfinite(accel), axis=1)
    # The stream with what is remembered before it, as sample 0; every sample points to the last
    # that is there.
    last = jax.lax.cummax(jnp.where(valid, jnp.arange(1, n + 1), 0))
    age = jnp.where(last == 0, memory.missing + jnp.arange(1, n + 1), jnp.arange(1, n + 1) - last)
    known = jnp.all(jnp.isfinite(memory.gyro)) | (last > 0)

    def held(before: Array, samples: Array) -> Array:
        clean = jnp.where(valid[:, None], samples, 0.0)
        return jnp.concatenate([jnp.where(jnp.isfinite(before), before, 0.0)[None], clean])[last]

    limit = max(round(config.bridge_seconds / config.dt), 1)
    coasting = (age > limit) | ~known
    variance = _variance(jnp.where(known, age, limit + 1), limit).astype(gyro.dtype)
    gyro, accel = held(memory.gyro, gyro), held(memory.accel, accel)
    gap = Gap(
        variance * config.gap_gyro_std**2,
        variance * config.gap_accel_std**2,
        jnp.where(coasting, 0.0, 1.0).astype(gyro.dtype),
    )
    any_yet = known[-1]
    after = memory._replace(
        gyro=jnp.where(any_yet, gyro[-1], jnp.nan),
        accel=jnp.where(any_yet, accel[-1], jnp.nan),
        missing=age[-1].astype(memory.missing.dtype),
    )
    return Imu(gyro, accel, gap), (age * config.dt).astype(gyro.dtype), after


def _variance(age: Int[Array, "n"], limit: int) -> Float[Array, "n"]:
    """Of a sample held for `age` samples, in units of the gap's own, so that sums over a gap have
    the standard deviation Σ e_j, where e_j = min(j / limit, 1) is the error of the j-th."""

    def total(j: Array) -> Array:
        ramp = jnp.minimum(j, limit)
        return ramp * (ramp + 1) / (2 * limit) + (j - ramp)

    return total(age) ** 2 - total(age - 1) ** 2
