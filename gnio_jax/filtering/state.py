"""State of the stochastic-cloning EKF, its configuration and its start (paper §III-G, after TLIO).

The error state is δ = (θ, v, p, b_g, b_a | θ_0, p_0, θ_1, p_1, …): 15 core entries, then 6 per clone, oldest clone first.
Rotation errors are world-frame and left, R ← exp(δθ) R; everything else adds.
"""

from __future__ import annotations

import dataclasses
import math
import numbers
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax.types import Array

CORE, CLONE = 15, 6
THETA, VELOCITY, POSITION, GYRO_BIAS, ACCEL_BIAS = (slice(3 * i, 3 * i + 3) for i in range(5))
"""Where each part of the core error lies."""

_NEVER = -1


@no_type_check  # by the tests' run-time checker, that is: __post_init__ says what is wrong, and takes 0-d arrays
@dataclass(frozen=True)
class FilterConfig:
    """What is fixed when the filter is compiled. The defaults are TLIO's. Raises `ValueError` naming a field that makes no sense."""

    dt: float
    """Time between IMU samples, s."""
    samples_per_clone: int
    """IMU samples n in one clone interval."""
    clones_per_window: int
    """Clone intervals W in one measurement; W + 1 poses are cloned."""
    mahalanobis_fail_scale: float = 0.0
    """0 skips a rejected measurement; above 0 its covariance is multiplied by this and it is applied."""
    history: Literal["diagonal", "core"] = "diagonal"
    """Keep the diagonal of the core covariance at every interval, or the whole 15×15 block too."""
    measurement_scale: float = 10.0
    """Every measurement covariance is multiplied by this: overlapping windows are not independent."""
    log_std_min: float = -4.0
    """The network's log standard deviation is raised to at least this (`run_odometry` only)."""
    gate_threshold: float = 11.345
    """Largest rᵀ S⁻¹ r that passes: 99 % of χ² with three degrees of freedom."""
    convergence_seconds: float = 10.0
    """The gate stays open until the oldest clone is more than this after initialisation, s."""
    success_seconds: float = 0.5
    """When the last success is older than this, the gate pauses: everything passes, s."""
    pause_seconds: float = 1.0
    """Length of such a pause, s."""
    window_rotation: Literal["per_sample", "single"] = "per_sample"
    """Rotate each sample of the network's window with its own attitude, or all with that of the start (paper eq. 1 read literally)."""
    allow_float32: bool = False
    """Run in float32 where the state is. Variances of position grow without bound while measurements are of their
    differences: after some minutes float32 has no digits left for those, and the filter diverges."""

    def __post_init__(self) -> None:
        def require(condition: bool, name: str, problem: str) -> None:
            if not condition:
                raise ValueError(f"{name} {problem}, found {getattr(self, name)!r}")

        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type == "float":
                try:  # 0-d arrays, as NumPy files give them, are welcome
                    number = float("nan") if isinstance(value, bool | str) else float(value)
                except (TypeError, ValueError):
                    number = float("nan")
                require(math.isfinite(number), field.name, "must be a finite number")
                object.__setattr__(self, field.name, number)
            elif field.type == "int":
                if isinstance(value, np.ndarray) and value.ndim == 0:
                    value = value.item()
                require(isinstance(value, numbers.Integral) and not isinstance(value, bool) and int(value) >= 1, field.name,
                        "must be a whole number of at least 1")
                object.__setattr__(self, field.name, int(value))
        require(isinstance(self.allow_float32, bool), "allow_float32", "must be True or False")
        require(self.history in ("diagonal", "core"), "history", "must be 'diagonal' or 'core'")
        require(self.window_rotation in ("per_sample", "single"), "window_rotation", "must be 'per_sample' or 'single'")
        for name in ("dt", "measurement_scale", "gate_threshold"):
            require(getattr(self, name) > 0, name, "must be positive")
        for name in ("mahalanobis_fail_scale", "convergence_seconds", "success_seconds", "pause_seconds"):
            require(getattr(self, name) >= 0, name, "must not be negative")

    @property
    def window(self) -> int:
        """IMU samples N = n·W in the network's window."""
        return self.samples_per_clone * self.clones_per_window


class NoiseModel(NamedTuple):
    """White noise of the IMU as densities, so that it does not depend on the rate, and random walks of its biases. Each a scalar.

    The defaults are TLIO's per-sample values, tuned at about 1 kHz, as densities.
    """

    gyro_density: Float[Array, ""] | float = 3.16e-4
    """rad/s/√Hz"""
    accel_density: Float[Array, ""] | float = 1.0e-3
    """m/s²/√Hz"""
    gyro_bias_walk: Float[Array, ""] | float = 1e-6
    """rad/s/√s"""
    accel_bias_walk: Float[Array, ""] | float = 1e-4
    """m/s²/√s"""

    @classmethod
    def per_sample(cls, gyro_std: Any, accel_std: Any, dt: Any, gyro_bias_walk: Any = 1e-6, accel_bias_walk: Any = 1e-4) -> NoiseModel:
        """From the standard deviation of one sample, rad/s and m/s², at `dt` seconds per sample: density = σ √dt."""
        root = jnp.sqrt(jnp.asarray(dt))
        return cls(gyro_std * root, accel_std * root, gyro_bias_walk, accel_bias_walk)


class InitialStd(NamedTuple):
    """Standard deviations at the start, each a scalar; the defaults are TLIO's."""

    tilt: Float[Array, ""] | float = math.radians(1.0)
    """Rotation about the world's x and y, rad."""
    yaw: Float[Array, ""] | float = math.radians(0.1)
    """Rotation about the world's z, rad."""
    velocity: Float[Array, ""] | float = 1.0
    """m/s"""
    position: Float[Array, ""] | float = 1e-3
    """m"""
    gyro_bias: Float[Array, ""] | float = 1e-4
    """rad/s"""
    accel_bias: Float[Array, ""] | float = 0.02
    """m/s²"""


TLIO_STD = InitialStd()


class GateState(NamedTuple):
    """Memory of the χ² gate. Times count IMU samples since initialisation, so that no rounding can move a decision."""

    converged: Bool[Array, ""]
    """Latched by the first update whose oldest clone is old enough."""
    last_success: Int[Array, ""]
    """Sample of the last measurement that was not rejected; −1 for none."""
    pause_end: Int[Array, ""]
    """First sample at which the gate may be active again."""


class FilterState(NamedTuple):
    """Mean and covariance, clones oldest first. c = W + 1 clones; those not yet taken are zero (their rotations the identity)."""

    rotation: Float[Array, "3 3"]
    """Body → world."""
    velocity: Float[Array, "3"]
    """World frame, m/s."""
    position: Float[Array, "3"]
    """World frame, m."""
    gyro_bias: Float[Array, "3"]
    """rad/s"""
    accel_bias: Float[Array, "3"]
    """m/s²"""
    clone_rotation: Float[Array, "c 3 3"]
    """Cloned rotations."""
    clone_position: Float[Array, "c 3"]
    """Cloned positions, m."""
    core_covariance: Float[Array, "15 15"]
    """θ, v, p, b_g, b_a."""
    cross_covariance: Float[Array, "15 6c"]
    """Core against the clones' θ, p."""
    clone_covariance: Float[Array, "6c 6c"]
    """Among the clones."""
    step: Int[Array, ""]
    """Clone intervals since initialisation."""
    gate: GateState


def covariance(state: FilterState) -> Float[Array, "d d"]:
    """The whole covariance, d = 15 + 6 (W + 1): core, then clones from the oldest."""
    return jnp.block([[state.core_covariance, state.cross_covariance], [state.cross_covariance.T, state.clone_covariance]])


def check(name: str, value: Any, shape: tuple[int, ...], config: FilterConfig) -> jax.Array:
    """`value` as a JAX array; `ValueError` naming it unless it has this shape and the precision that `config` asks for."""
    value = jnp.asarray(value)
    if value.shape != shape:
        raise ValueError(f"{name}: the shape must be {shape}, found {value.shape}; for a batch of sequences use jax.vmap")
    if value.dtype != jnp.float64 and not (config.allow_float32 and value.dtype == jnp.float32):
        remedy = "cast it" if jax.config.read("jax_enable_x64") else "call jax.config.update('jax_enable_x64', True) first"
        if value.dtype == jnp.float32:
            remedy += ", or ask for FilterConfig(allow_float32=True)"
        raise ValueError(f"{name}: the filter runs in float64, found {value.dtype}; {remedy}")
    return value


# The arguments of the doors carry no shapes for the run-time checker: a wrong one is the user's mistake and a ValueError.
def initial_state(config: FilterConfig, rotation: Any, velocity: Any, position: Any, gyro_bias: Any = 0, accel_bias: Any = 0,
                  std: InitialStd = TLIO_STD) -> FilterState:
    """Start of the filter from a known pose, without clones.

    rotation (3, 3) body → world; velocity (3,) m/s and position (3,) m in the world frame; gyro_bias rad/s and accel_bias m/s²,
    each (3,) or one number for all axes; std the standard deviations of their errors, independent of each other.
    Raises `ValueError` naming an argument of wrong shape or precision.
    """
    rotation = check("rotation", rotation, (3, 3), config)
    dtype = rotation.dtype
    velocity, position = check("velocity", velocity, (3,), config), check("position", position, (3,), config)
    biases = []
    for name, bias in [("gyro_bias", gyro_bias), ("accel_bias", accel_bias)]:
        scalar = jnp.ndim(bias) == 0
        biases.append(jnp.full(3, bias, dtype) if scalar else check(name, bias, (3,), config).astype(dtype))
    for name, value in std._asdict().items():
        if jnp.shape(value) != ():
            raise ValueError(f"std.{name}: must be one number, found shape {jnp.shape(value)}")
    scales = jnp.stack([jnp.asarray(value, dtype) for value in std])
    # tilt twice, yaw once, then three of each
    scales = scales[np.array([0, 0, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5])]
    clones = config.clones_per_window + 1
    return FilterState(
        rotation=rotation, velocity=velocity.astype(dtype), position=position.astype(dtype), gyro_bias=biases[0], accel_bias=biases[1],
        clone_rotation=jnp.tile(jnp.eye(3, dtype=dtype)[None], (clones, 1, 1)), clone_position=jnp.zeros((clones, 3), dtype),
        core_covariance=jnp.diag(scales**2), cross_covariance=jnp.zeros((CORE, CLONE * clones), dtype),
        clone_covariance=jnp.zeros((CLONE * clones, CLONE * clones), dtype), step=jnp.int32(0),
        gate=GateState(converged=jnp.bool_(False), last_success=jnp.int32(_NEVER), pause_end=jnp.int32(0)),
    )
