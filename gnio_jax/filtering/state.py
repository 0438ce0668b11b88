"""State of the stochastic-cloning EKF, its configuration and its start (paper §III-G, after TLIO).

The error state is δ = (θ, v, o, b_g, b_a, a, s | θ_0, o_0, θ_1, o_1, …): 21 core entries, then 6
per clone, oldest clone first. Rotation errors are world-frame and left, R ← exp(δθ) R; everything
else adds.

Positions are held as offsets o = p − a from an anchor a, a past position that moves up to the
present once in a window; s is its last move. A clone keeps the anchor that it was taken with: the
present one, or the one before. The variance of a position grows without bound, since only
differences of positions are measured; those of offsets and moves do not. So no update subtracts
large variances from each other, which is what makes the plain form (θ, v, p, …) diverge in float32.
The change of variables is linear with constant coefficients (p = a + o for the core), so the filter
is the plain one, exactly.
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
from jax.core import Tracer
from jaxtyping import Bool, Float, Int

from gnio_jax import geometry
from gnio_jax.types import GRAVITY, Array
from gnio_jax.windows import WINDOW_CUTS, WindowCut

CORE, CLONE = 21, 6
THETA, VELOCITY, OFFSET, GYRO_BIAS, ACCEL_BIAS, ANCHOR, MOVE = (
    slice(3 * i, 3 * i + 3) for i in range(7)
)
"""Where each part of the core error lies."""

_NEVER = -1


Frame = Literal["own", "given"]
"""Whose yaw frame a displacement is told in: that of the filter's own attitude of the oldest clone,
with which the network's window was cut, or that of another attitude."""


@no_type_check  # by the tests' run-time checker, that is: __post_init__ says what is wrong, and takes 0-d arrays
@dataclass(frozen=True)
class FilterConfig:
    """What is fixed when the filter is compiled. The defaults are TLIO's. Raises `ValueError`
    naming a field that makes no sense."""

    dt: float
    """Time between IMU samples, s."""
    samples_per_clone: int
    """IMU samples n in one clone interval."""
    clones_per_window: int
    """Clone intervals W in one measurement; W + 1 poses are cloned."""
    mahalanobis_fail_scale: float = 0.0
    """0 skips a rejected measurement; above 0 its covariance is multiplied by this and it is
    applied."""
    history: Literal["diagonal", "core"] = "diagonal"
    """Keep the diagonal of the core covariance at every interval, or the whole 15×15 block too."""
    measurement_scale: float = 10.0
    """Every measurement covariance is multiplied by this: overlapping windows are not independent.
    """
    log_std_min: float = -4.0
    """The network's log standard deviation is raised to at least this (`run_odometry` only)."""
    gate_threshold: float = 11.345
    """Largest rᵀ S⁻¹ r that passes, of a displacement and of a velocity at rest: 99 % of χ² with
    three degrees of freedom."""
    convergence_seconds: float = 10.0
    """The gate stays open until the oldest clone is more than this after initialisation, s."""
    success_seconds: float = 0.5
    """When the last success is older than this, the gate pauses: everything passes, s."""
    pause_seconds: float = 1.0
    """Length of such a pause, s."""
    gate_softness: float = 0.0
    """0 accepts or rejects; above 0 the gate has a slope, for training: a measurement's information
    is weighted by the logistic function of (gate_threshold − rᵀ S⁻¹ r) / gate_softness."""
    zero_velocity_std: float = 0.0
    """Standard deviation of the velocity at rest, m/s, used as a measurement while the IMU is
    quiet; 0 for no such update. Where a displacement is tried in the same interval and its gate is
    active, a rest that does not fit is refused, whatever `mahalanobis_fail_scale` and
    `gate_softness`."""
    rest_gyro: float = 0.05
    """Quiet: no |gyro − b_g| above this, rad/s …"""
    rest_accel: float = 0.3
    """… and no | |accel − b_a| − g | above this, m/s² …"""
    rest_seconds: float = 0.5
    """… for this long, s."""
    bridge_seconds: float = 0.1
    """Missing IMU samples hold the last one for this long, s; after it attitude and velocity coast,
    and windows are no measurements."""
    gap_gyro_std: float = 1.0
    """Standard deviation of the rate that a gap may hide, rad/s; of a held sample as much less as
    it is younger than `bridge_seconds`."""
    gap_accel_std: float = 3.0
    """The same of the acceleration, m/s²."""
    checkpoint_every: int = 0
    """Clone intervals between the states kept for the backward pass, all else being computed again:
    memory for time. 0 keeps everything."""
    window_rotation: Literal["per_sample", "single", "tlio"] = "per_sample"
    """Rotate each sample of the network's window with its own attitude, or all with that of the
    start (paper eq. 1 read literally), or cut and rotate it as TLIO's tracker does: one sample
    earlier, the network's input with the biases that the IMU comes with."""
    jacobians: Literal["latest", "first"] = "latest"
    """Where the filter is linearised: at the latest estimates, as TLIO's, or at the first of each
    velocity and position; these are taken anew after an update above `gate_threshold`."""
    speed_limit: float = 100.0
    """No carrier is faster, m/s: an estimate that is has diverged, and is not `healthy` from then
    on (ours)."""
    allow_float32: bool = False
    """Run in float32 where the state is, to about four digits of every standard deviation over an
    hour. Without it float32 is an error, not a surprise; smoothing and derivatives want float64
    anyway."""

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
                least = 0 if field.name == "checkpoint_every" else 1
                require(
                    isinstance(value, numbers.Integral)
                    and not isinstance(value, bool)
                    and int(value) >= least,
                    field.name,
                    f"must be a whole number of at least {least}",
                )
                object.__setattr__(self, field.name, int(value))
        require(isinstance(self.allow_float32, bool), "allow_float32", "must be True or False")
        require(self.history in ("diagonal", "core"), "history", "must be 'diagonal' or 'core'")
        require(
            self.window_rotation in tuple(WINDOW_CUTS),
            "window_rotation",
            "must be 'per_sample', 'single' or 'tlio'",
        )
        require(self.jacobians in ("latest", "first"), "jacobians", "must be 'latest' or 'first'")
        for name in ("dt", "measurement_scale", "gate_threshold", "speed_limit"):
            require(getattr(self, name) > 0, name, "must be positive")
        for name in (
            "mahalanobis_fail_scale",
            "convergence_seconds",
            "success_seconds",
            "pause_seconds",
            "gate_softness",
            "zero_velocity_std",
            "rest_gyro",
            "rest_accel",
            "rest_seconds",
            "bridge_seconds",
            "gap_gyro_std",
            "gap_accel_std",
        ):
            require(getattr(self, name) >= 0, name, "must not be negative")
        require(
            not (self.gate_softness > 0 and self.mahalanobis_fail_scale > 0),
            "gate_softness",
            "makes no sense beside mahalanobis_fail_scale",
        )

    @property
    def window(self) -> int:
        """IMU samples N = n·W in the network's window."""
        return self.samples_per_clone * self.clones_per_window

    @property
    def cut(self) -> WindowCut:
        """Of `window_rotation`."""
        return WINDOW_CUTS[self.window_rotation]

    @property
    def displacement_frame(self) -> Frame:
        """Frame in which the network's displacement is told, as the measurement's Jacobian takes it.

        TLIO's Jacobian takes a given frame, though it is the filter's own.
        """
        return "given" if self.window_rotation == "tlio" else "own"

    @property
    def reach(self) -> int:
        """IMU samples, the newest included, that a measurement depends on."""
        return self.window + self.cut.lead


class NoiseModel(NamedTuple):
    """White noise of the IMU as densities, so that it does not depend on the rate, and random walks
    of its biases. Each a scalar.

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
    def per_sample(
        cls,
        gyro_std: Any,
        accel_std: Any,
        dt: Any,
        gyro_bias_walk: Any = 1e-6,
        accel_bias_walk: Any = 1e-4,
    ) -> NoiseModel:
        """From the standard deviation of one sample, rad/s and m/s², at `dt` seconds per sample:
        density = σ √dt."""
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
    """Memory of the χ² gate. Times count IMU samples since initialisation, so that no rounding can
    move a decision."""

    converged: Bool[Array, ""]
    """Latched by the first update whose oldest clone is old enough."""
    last_success: Int[Array, ""]
    """Sample of the last measurement that was not rejected, and by as much later as there was none
    since; −1 before the first."""
    pause_end: Int[Array, ""]
    """First sample at which the gate may be active again."""


class ImuMemory(NamedTuple):
    """What one clone interval leaves of the IMU to the next."""

    gyro: Float[Array, "3"]
    """The last sample that was not missing, rad/s, raw; NaN before there was one."""
    accel: Float[Array, "3"]
    """The same, m/s²."""
    missing: Int[Array, ""]
    """Samples missing since."""
    quiet: Int[Array, ""]
    """Clone intervals in a row in which the IMU was quiet; counted where `zero_velocity_std` is
    above 0."""


class FirstEstimates(NamedTuple):
    """What was known of velocity and positions when they were first estimated, before any update at
    or after that time.

    Jacobians at these values leave the yaw of the whole trajectory as unobservable to the filter as
    it is (Huang, Mourikis and Roumeliotis 2010); at the latest values an update learns something of
    it that the measurement does not tell.

    That is for small corrections: Φ[v, θ] holds −hat(v − v_first), the last correction. Below the
    χ² threshold it is bounded by the filter's own standard deviations, as δᵀ P⁻¹ δ ≤ rᵀ S⁻¹ r;
    above it, it feeds itself: a larger Φ[v, θ], a larger variance, a larger gain, a larger
    correction. So an update above the threshold sets all of them to the latest estimates (ours).
    S is that of the update: a measurement with a weight or a scaled covariance corrects less.
    """

    velocity: Float[Array, "3"]
    offset: Float[Array, "3"]
    move: Float[Array, "3"]
    clone_offset: Float[Array, "c 3"]


class FilterState(NamedTuple):
    """Mean and covariance, clones oldest first. c = W + 1 clones; those not yet taken are zero
    (their rotations the identity)."""

    rotation: Float[Array, "3 3"]
    """Body → world."""
    velocity: Float[Array, "3"]
    """World frame, m/s."""
    offset: Float[Array, "3"]
    """World frame, from the anchor, m."""
    gyro_bias: Float[Array, "3"]
    """rad/s"""
    accel_bias: Float[Array, "3"]
    """m/s²"""
    anchor: Float[Array, "3"]
    """A past position in the world frame, m."""
    move: Float[Array, "3"]
    """From the anchor before it, m."""
    clone_rotation: Float[Array, "c 3 3"]
    """Cloned rotations."""
    clone_offset: Float[Array, "c 3"]
    """Cloned positions, from the anchor they were taken with; between runs, from the present one,
    m."""
    core_covariance: Float[Array, "21 21"]
    """θ, v, o, b_g, b_a, a, s."""
    cross_covariance: Float[Array, "21 6c"]
    """Core against the clones' θ, o."""
    clone_covariance: Float[Array, "6c 6c"]
    """Among the clones."""
    step: Int[Array, ""]
    """Clone intervals since initialisation."""
    gate: GateState
    imu: ImuMemory
    healthy: Bool[Array, ""]
    """Never False again where it once was: see `FilterHistory.healthy`."""
    first: FirstEstimates | None
    """Where `FilterConfig.jacobians` is "first"."""

    @property
    def position(self) -> Float[Array, "3"]:
        """World frame, m."""
        return self.anchor + self.offset


def core_covariance(covariance: Float[Array, "21 21"]) -> Float[Array, "15 15"]:
    """Covariance of θ, v, p, b_g, b_a from that of the core's error: p = a + o."""
    both = covariance + _onto_offset(covariance[ANCHOR], 0)
    return (both + _onto_offset(both[:, ANCHOR], 1))[: ANCHOR.start, : ANCHOR.start]


def _onto_offset(part: Array, axis: int) -> Array:
    """Padded with zeros, along `axis`, to where the offset lies."""
    around = [(0, 0), (0, 0)]
    around[axis] = (OFFSET.start, CORE - OFFSET.stop)
    return jnp.pad(part, around)


def covariance(state: FilterState) -> Float[Array, "d d"]:
    """The whole covariance of θ, v, p, b_g, b_a and the clones' θ, p from the oldest, d = 15 + 6 (W
    + 1)."""
    clones = state.clone_offset.shape[0]
    world = np.eye(CORE + CLONE * clones)  # p = a + o for the core and for every clone
    for start in [OFFSET.start, *range(CORE + 3, len(world), CLONE)]:
        world[start : start + 3, ANCHOR] = np.eye(3)
    world = np.delete(world, np.r_[ANCHOR, MOVE], axis=0).astype(state.core_covariance.dtype)
    whole = jnp.block(
        [
            [state.core_covariance, state.cross_covariance],
            [state.cross_covariance.T, state.clone_covariance],
        ]
    )
    return world @ whole @ world.T


def check(name: str, value: Any, shape: tuple[int, ...], config: FilterConfig) -> jax.Array:
    """`value` as a JAX array; `ValueError` naming it unless it has this shape and the precision
    that `config` asks for."""
    value = jnp.asarray(value)
    if value.shape != shape:
        raise ValueError(
            f"{name}: the shape must be {shape}, found {value.shape}; for a batch of sequences use jax.vmap"
        )
    if value.dtype != jnp.float64 and not (config.allow_float32 and value.dtype == jnp.float32):
        remedy = (
            "cast it"
            if jax.config.read("jax_enable_x64")
            else "call jax.config.update('jax_enable_x64', True) first"
        )
        if value.dtype == jnp.float32:
            remedy += ", or ask for FilterConfig(allow_float32=True)"
        raise ValueError(f"{name}: the filter runs in float64, found {value.dtype}; {remedy}")
    return value


def check_finite(name: str, value: jax.Array, remedy: str = "") -> None:
    """`ValueError` naming the first row of `value` that is not finite; nothing inside `jit`, where
    values are not known."""
    if isinstance(value, Tracer):
        return
    bad = ~np.isfinite(np.asarray(value)).reshape(len(value), -1).all(1)
    if bad.any():
        raise ValueError(
            f"{name}: {bad.sum()} of {len(bad)} rows are not finite, the first is row {bad.argmax()}"
            + (f"; {remedy}" if remedy else "")
        )


def check_rotation(name: str, value: jax.Array) -> None:
    """`ValueError` unless `value` is a rotation matrix, to what rounding and text files leave;
    nothing inside `jit`."""
    if not isinstance(value, Tracer):
        matrix = np.asarray(value, np.float64)
        if not (np.abs(matrix @ matrix.T - np.eye(3)).max() < 1e-3 and np.linalg.det(matrix) > 0):
            raise ValueError(f"{name}: is not a rotation matrix")


def check_not_negative(name: str, value: Any) -> None:
    """`ValueError` unless the number is finite and not negative; nothing inside `jit`."""
    if not isinstance(value, Tracer):
        number = float(np.asarray(value))
        if not (math.isfinite(number) and number >= 0):
            raise ValueError(f"{name}: must be a number that is not negative, found {number}")


def check_positive(name: str, value: jax.Array) -> None:
    """`ValueError` naming the first of the matrices (k, d, d) that is not symmetric and positive
    definite; those with a NaN pass."""
    if isinstance(value, Tracer):
        return
    matrices = np.asarray(value, np.float64)
    known = np.asarray(np.isfinite(matrices).all((1, 2)))
    clean = np.where(known[:, None, None], matrices, np.eye(matrices.shape[1]))
    asymmetric = np.abs(clean - clean.transpose(0, 2, 1)).max((1, 2)) > 1e-6 * np.abs(clean).max(
        (1, 2)
    )
    bad = asymmetric | (np.linalg.eigvalsh(clean)[:, 0] <= 0)
    if bad.any():
        raise ValueError(
            f"{name}: {bad.sum()} of {len(bad)} are not symmetric and positive definite, the first is row {bad.argmax()}"
        )


# The arguments of the doors carry no shapes for the run-time checker: a wrong one is the user's
# mistake and a ValueError.
def initial_state(
    config: FilterConfig,
    rotation: Any,
    velocity: Any,
    position: Any,
    gyro_bias: Any = 0,
    accel_bias: Any = 0,
    std: InitialStd = TLIO_STD,
) -> FilterState:
    """Start of the filter from a known pose, without clones.

    rotation (3, 3) body → world; velocity (3,) m/s and position (3,) m in the world frame;
    gyro_bias rad/s and accel_bias m/s², each (3,) or one number for all axes; std the standard
    deviations of their errors, independent of each other. Raises `ValueError` naming an argument of
    wrong shape or precision.
    """
    rotation = check("rotation", rotation, (3, 3), config)
    dtype = rotation.dtype
    velocity, position = (
        check("velocity", velocity, (3,), config),
        check("position", position, (3,), config),
    )
    biases = []
    for name, bias in [("gyro_bias", gyro_bias), ("accel_bias", accel_bias)]:
        scalar = jnp.ndim(bias) == 0
        biases.append(
            jnp.full(3, bias, dtype) if scalar else check(name, bias, (3,), config).astype(dtype)
        )
    for name, value in [
        ("velocity", velocity),
        ("position", position),
        ("gyro_bias", biases[0]),
        ("accel_bias", biases[1]),
    ]:
        check_finite(name, value)
    check_rotation("rotation", rotation)
    for name, value in std._asdict().items():
        if jnp.shape(value) != ():
            raise ValueError(f"std.{name}: must be one number, found shape {jnp.shape(value)}")
        check_not_negative(f"std.{name}", value)
    scales = jnp.stack([jnp.asarray(value, dtype) for value in std])
    # tilt twice, yaw once, velocity, no offset yet, biases, and the whole uncertainty of the
    # position in the anchor
    scales = jnp.append(scales, 0.0)[
        np.array([0, 0, 1, 2, 2, 2, 6, 6, 6, 4, 4, 4, 5, 5, 5, 3, 3, 3, 6, 6, 6])
    ]
    clones = config.clones_per_window + 1
    return FilterState(
        rotation=rotation,
        velocity=velocity.astype(dtype),
        offset=jnp.zeros(3, dtype),
        gyro_bias=biases[0],
        accel_bias=biases[1],
        anchor=position.astype(dtype),
        move=jnp.zeros(3, dtype),
        clone_rotation=jnp.tile(jnp.eye(3, dtype=dtype)[None], (clones, 1, 1)),
        clone_offset=jnp.zeros((clones, 3), dtype),
        core_covariance=jnp.diag(scales**2),
        cross_covariance=jnp.zeros((CORE, CLONE * clones), dtype),
        clone_covariance=jnp.zeros((CLONE * clones, CLONE * clones), dtype),
        step=jnp.int32(0),
        gate=GateState(
            converged=jnp.bool_(False), last_success=jnp.int32(_NEVER), pause_end=jnp.int32(0)
        ),
        imu=ImuMemory(
            jnp.full(3, jnp.nan, dtype), jnp.full(3, jnp.nan, dtype), jnp.int32(0), jnp.int32(0)
        ),
        healthy=jnp.bool_(True),
        first=None
        if config.jacobians == "latest"
        else FirstEstimates(
            velocity.astype(dtype),
            jnp.zeros(3, dtype),
            jnp.zeros(3, dtype),
            jnp.zeros((clones, 3), dtype),
        ),
    )


def level_state(
    config: FilterConfig, gyro: Any, accel: Any, std: InitialStd = TLIO_STD
) -> FilterState:
    """Start without a reference: tilt from gravity, yaw, velocity and position zero (ours).

    gyro rad/s and accel m/s² (m, 3), raw, are the first samples, of a second or so, in which the
    device should be still. Of `std`, tilt and velocity are replaced: the tilt's is what the
    accelerometer's bias and its spread leave of the mean, over half a second to an independent
    sample; the velocity's is 0.05 m/s if the samples are quiet by `rest_gyro` and `rest_accel`,
    else 1 m/s. The yaw is zero by definition, so its own is kept. Raises `ValueError` naming an
    argument of wrong shape or precision or that is not finite.
    """
    samples = jnp.shape(accel)[0] if jnp.ndim(accel) else 0
    gyro, accel = (
        check("gyro", gyro, (samples, 3), config),
        check("accel", accel, (samples, 3), config),
    )
    if samples < 2:
        raise ValueError(f"accel: at least two samples are needed, found {samples}")
    for name, value in [("gyro", gyro), ("accel", accel)]:
        check_finite(name, value)
    mean, spread = accel.mean(0), jnp.sqrt(jnp.sum(jnp.var(accel, axis=0)))
    independent = max(1.0, 2 * samples * config.dt)
    tilt = jnp.sqrt(jnp.asarray(std.accel_bias) ** 2 + spread**2 / independent) / GRAVITY
    quiet = (jnp.sqrt(jnp.sum(jnp.var(gyro, axis=0))) < config.rest_gyro) & (
        spread < config.rest_accel
    )
    velocity = jnp.where(quiet, 0.05, 1.0)
    nothing = jnp.zeros(3, accel.dtype)
    return initial_state(
        config,
        geometry.level(mean),
        nothing,
        nothing,
        std=std._replace(tilt=tilt, velocity=velocity),
    )


def admit_state(state: FilterState, config: FilterConfig) -> FilterState:
    """`state` in one precision; `ValueError` naming a field that is not as `config` wants it."""
    kind = jnp.float32 if config.allow_float32 else jnp.float64
    wanted = jax.eval_shape(
        lambda: initial_state(
            config, jnp.eye(3, dtype=kind), jnp.zeros(3, kind), jnp.zeros(3, kind)
        )
    )
    if jax.tree.structure(state) != jax.tree.structure(wanted):
        raise ValueError(
            f"state: was made for another FilterConfig than this one, with jacobians = '{config.jacobians}'"
        )

    def admit(path: Any, value: Any, like: jax.ShapeDtypeStruct) -> jax.Array:
        name = "state" + jax.tree_util.keystr(path)
        if jnp.issubdtype(like.dtype, jnp.floating):
            return check(name, value, like.shape, config).astype(state.offset.dtype)
        if jnp.shape(value) != like.shape:
            raise ValueError(
                f"{name}: the shape must be {like.shape}, found {jnp.shape(value)}; for a batch of sequences use jax.vmap"
            )
        return jnp.asarray(value, like.dtype)

    admitted = jax.tree_util.tree_map_with_path(admit, state, wanted)
    _check_state(admitted)
    return admitted


def _check_state(state: FilterState) -> None:
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(state)):
        return
    for name in (
        "velocity",
        "offset",
        "gyro_bias",
        "accel_bias",
        "anchor",
        "core_covariance",
        "cross_covariance",
        "clone_covariance",
    ):
        check_finite(f"state.{name}", getattr(state, name))
    core = np.asarray(state.core_covariance, np.float64)
    scale = np.sqrt(np.abs(np.diag(core))) + 1e-150
    if np.linalg.eigvalsh(core / np.outer(scale, scale))[0] < -1e-5 or (np.diag(core) < 0).any():
        raise ValueError("state.core_covariance: is not positive definite")
    check_rotation("state.rotation", state.rotation)


def admit_noise(noise: NoiseModel, dtype: Any) -> NoiseModel:
    """`noise` in one precision; `ValueError` naming a field that is not one number, or negative, or
    not finite."""
    for name, value in noise._asdict().items():
        if jnp.shape(value) != ():
            raise ValueError(f"noise.{name}: must be one number, found shape {jnp.shape(value)}")
        check_not_negative(f"noise.{name}", value)
    return NoiseModel(*[jnp.asarray(value, dtype) for value in noise])
