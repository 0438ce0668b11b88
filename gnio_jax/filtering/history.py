"""The result of a run: the filter after each clone interval."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.config import NoiseModel
from gnio_jax.filtering.displacement import Displacement
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import Mean
from gnio_jax.filtering.update import Outcome
from gnio_jax.types import Array

YAW, VELOCITY, POSITION, GYRO_BIAS = 2, slice(3, 6), slice(6, 9), slice(9, 12)
"""Rows of these in the history's covariances, which are of θ, v, p, b_g, b_a."""


class FilterHistory(NamedTuple):
    """The filter after each of K clone intervals.

    Row k is at t_0 + (k + 1)·n·dt, after its updates. The whole covariances are kept with
    `FilterConfig(history="core")` only; without it `covariance` is None.
    """

    rotation: Float[Array, "k 3 3"]
    """Body → world."""
    velocity: Float[Array, "k 3"]
    """World frame, m/s."""
    position: Float[Array, "k 3"]
    """World frame, m."""
    gyro_bias: Float[Array, "k 3"]
    """rad/s"""
    accel_bias: Float[Array, "k 3"]
    """m/s²"""
    displacement: Float[Array, "k 3"]
    """The measurement, m, in the yaw frame of the oldest clone, or the measured velocity in the
    body, in metres per window (`FilterConfig.measures`); NaN where none."""
    measurement_covariance: Float[Array, "k 3 3"]
    """Its covariance after scaling by `NoiseModel.measurement_scale` and `std_factor`, m²; NaN
    where none."""
    innovation: Float[Array, "k 3"]
    """Measured − predicted displacement, m; NaN where no measurement."""
    covariance_diagonal: Float[Array, "k 15"]
    """Variances of θ, v, p, b_g, b_a."""
    covariance: Float[Array, "k 15 15"] | None
    """The whole core block where `FilterConfig.history` is "core", else None."""
    accepted: Float[Array, "k"]
    """1 where an update was applied (also one with scaled covariance), 0 where none was (gate or
    gimbal lock), NaN where no measurement."""
    gate_passed: Float[Array, "k"]
    """1 where the χ² gate accepted the measurement unchanged, 0 where it refused it, a weight from
    0 to 1 with `gate_softness`, NaN where no measurement."""
    nis: Float[Array, "k"]
    """Normalised innovation squared, rᵀ S⁻¹ r; NaN where no measurement."""
    log_likelihood: Float[Array, "k"]
    """ln N(r; 0, S) of the innovation, r in m; NaN where no measurement. Their sum is the evidence
    for the noise model."""
    imu_gap: Float[Array, "k"]
    """Age of the oldest held IMU sample of the interval, s; 0 where none was missing. Above
    `bridge_seconds` the filter coasted."""
    healthy: Float[Array, "k"]
    """0 from the first row on whose state is not finite, has a negative variance or a speed above
    `FilterConfig.speed_limit`. The input was bad, and all rows from there on are invalid. The final
    state remembers this, and a later run from it begins with 0. `explain_failure` names the
    cause."""
    outcomes: dict[str, Outcome]
    """The outcomes of all other measurements by their names, stacked over K: of those of the
    filter, as "zero_velocity", and of those of the run, as "fix"."""
    diagnostics: dict[str, Array]
    """The network's diagnostics stacked over K, NaN where it had no window; empty without a
    network."""

    @property
    def measurement_std(self) -> Float[jax.Array, "k 3"]:
        """Standard deviations of the measurement after scaling, m; NaN where none."""
        return jnp.sqrt(jnp.diagonal(self.measurement_covariance, axis1=1, axis2=2))

    def unscaled_displacements(
        self, noise: NoiseModel
    ) -> tuple[Float[Array, "k 3"], Float[Array, "k 3 3"]]:
        """Displacements (K, 3), m, and their covariances (K, 3, 3), m², before the scaling of
        `noise`, which must be that of the run. With them `run_filter` repeats a run of
        `run_odometry` without its network, with `frame` = `FilterConfig.displacement_frame` and
        these `diagnostics`."""
        factor = jnp.stack([jnp.asarray(value) for value in noise.std_factor])
        scale = noise.measurement_scale * factor[:, None] * factor[None]
        return jnp.asarray(self.displacement), self.measurement_covariance / scale[None]


def explain_failure(history: FilterHistory, config: FilterConfig) -> str:
    """The cause of the first row that is not healthy, in words; empty if all rows of this run are
    healthy."""
    healthy = np.asarray(history.healthy) > 0
    if healthy.all():
        return ""
    row = int(np.argmin(healthy))
    mean, variances = (
        jax.tree.map(lambda rows: np.asarray(rows[row]), part)
        for part in (
            Mean(*(getattr(history, name) for name in Mean._fields)),
            history.covariance_diagonal,
        )
    )
    gaps = np.asarray(history.imu_gap)[: row + 1]
    cause = describe_failure(mean, variances, config)
    coasted = gaps > config.bridge_seconds
    if coasted.any():
        cause += f", after a hole of {gaps.max():.1f} s in the IMU's samples"
    return cause


def describe_failure(mean: Mean, variances: Float[np.ndarray, "15"], config: FilterConfig) -> str:
    """What makes an estimate impossible, in words."""
    if not all(np.isfinite(part).all() for part in (*mean, variances)):
        return "a value is not finite"
    if (variances < 0).any():
        return "a variance is below 0"
    if (speed := float(np.linalg.norm(mean.velocity))) > config.speed_limit:
        return f"a speed of {speed:.0f} m/s, above the limit of {config.speed_limit:g} m/s"
    return "an earlier estimate was impossible"


class StepRecord(NamedTuple):
    """What one clone step adds to the history, or what K steps add, stacked."""

    mean: Mean
    covariance: Array
    """Covariance of θ, v, p, b_g, b_a, or its diagonal: see `FilterConfig.history`."""
    displacement: Displacement
    outcomes: dict[str, Outcome]
    """Outcomes of the displacement and of the other measurements by their names."""
    diagnostics: dict[str, Array]


def diagonals(covariance: Array) -> Float[Array, "k 15"]:
    """The diagonals of K covariances (K, 15, 15), or of K diagonals."""
    return jnp.diagonal(covariance, axis1=1, axis2=2) if covariance.ndim == 3 else covariance


def healthy_rows(
    mean: Mean, covariance: Array, healthy: Bool[Array, ""], config: FilterConfig
) -> Bool[Array, "k"]:
    """`FilterHistory.healthy` of K means and covariances (K, 15, 15), or their diagonals, from a
    state that was `healthy` or not."""
    parts = (*mean, covariance)
    finite = [jnp.all(jnp.isfinite(part), axis=tuple(range(1, part.ndim))) for part in parts]
    possible = jnp.sum(mean.velocity**2, axis=1) <= config.speed_limit**2
    positive = jnp.all(diagonals(covariance) >= 0, axis=1)
    sound = jnp.all(jnp.stack(finite), axis=0) & positive & possible
    return healthy & (jnp.cumsum(~sound) == 0)


def finished_history(
    records: StepRecord, imu_gap: Float[Array, "k"], healthy: Bool[Array, ""], config: FilterConfig
) -> FilterHistory:
    """The history of K stacked records from a state that was `healthy` or not."""
    outcomes, covariance = dict(records.outcomes), records.covariance
    update = outcomes.pop("displacement")
    dtype, whole = covariance.dtype, config.history == "core"

    def where_present(value: Array) -> Array:
        present = update.present.reshape(-1, *[1] * (value.ndim - 1))
        return jnp.where(present, value, jnp.nan).astype(dtype)

    # S is the identity where there is no measurement, so that the logarithm has a derivative there.
    log_likelihood = -0.5 * (update.nis + 3 * math.log(2 * math.pi)) - jnp.log(update.volume)
    healthy = healthy_rows(records.mean, covariance, healthy, config)
    return FilterHistory(
        *records.mean,
        displacement=where_present(records.displacement.displacement),
        measurement_covariance=where_present(records.displacement.covariance),
        innovation=where_present(update.residual),
        covariance_diagonal=diagonals(covariance),
        covariance=covariance if whole else None,
        accepted=where_present(update.accepted),
        gate_passed=where_present(update.weight),
        nis=where_present(update.nis),
        log_likelihood=where_present(log_likelihood),
        imu_gap=imu_gap.astype(dtype),
        healthy=healthy.astype(dtype),
        outcomes=outcomes,
        diagnostics=records.diagnostics,
    )
