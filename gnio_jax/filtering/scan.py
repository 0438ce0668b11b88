"""The stochastic-cloning EKF as one `lax.scan` over clone intervals: with given displacements, or
with the network in the loop."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.filtering.checks import (
    FilterInputs,
    check_frame,
    checked_displacements,
    checked_inputs,
)
from gnio_jax.filtering.displacement import Displacement, scaled_displacement
from gnio_jax.filtering.filter import Filter
from gnio_jax.filtering.gaps import Imu, after_window, bridge
from gnio_jax.filtering.history import FilterHistory, StepRecord, finished_history
from gnio_jax.filtering.network import (
    MemoryStep,
    Predict,
    PredictWithMemory,
    Recall,
    first_memory,
    has_memory,
    memory_step,
    network_measurement,
    recalled_displacement,
)
from gnio_jax.filtering.propagation import (
    Transition,
    core_transition,
    integrate,
    propagate,
)
from gnio_jax.filtering.settings import DisplacementFrame
from gnio_jax.filtering.state import (
    FilterState,
    core_covariance,
    invariant_errors,
    move_anchor,
    unroll_clones,
)
from gnio_jax.filtering.update import Correction, Measurement, Outcome, Step
from gnio_jax.types import Array, Memory

T = TypeVar("T")


def run_filter(
    ekf: Filter,
    state: FilterState,
    gyro: Any,
    accel: Any,
    displacement: Any,
    covariance: Any,
    imu_valid: Any = None,
    frame: DisplacementFrame = "given",
    measurements: tuple[Measurement, ...] = (),
    variance: Any = None,
    diagnostics: Mapping[str, Any] = MappingProxyType({}),
) -> tuple[FilterState, FilterHistory]:
    """Filter K clone intervals of n IMU samples with given displacements (paper §III-G).

    It works under `jax.jit`, `jax.vmap` and `jax.grad`.

    Args:
        ekf: The filter (`Filter`, `make_filter`).
        state: The start (`initial_state`, `level_state`), or the final state of an earlier run.
        gyro: (K·n, 3) angular rate, body frame, rad/s, raw: the filter subtracts its bias.
        accel: (K·n, 3) specific force, body frame, m/s², raw.
        displacement: (K, 3) m. Row k is from clone k − W to clone k, expressed in the yaw frame of
            clone k − W (`displacements` makes such rows from a known trajectory). A row with a NaN,
            or before there are W + 1 clones, is no measurement.
        covariance: (K, 3, 3) m², before the scaling of `ekf.noise`.
        imu_valid: (K·n,) booleans, False where an IMU sample is missing. Missing samples are
            bridged (`filtering/gaps.py`), and if there is a mask also those that are not finite.
            None: the stream is complete.
        frame: The attitude that defines this yaw frame. "given" is another one than the filter's.
            "own" is the filter's, as for `FilterHistory.unscaled_displacements`, which repeat a run
            of `run_odometry` without its network. "turning" is the same with the derivatives that a
            network in the loop has (`FilterConfig.derivative_frame`). "body": the rows are
            velocities in the body at clone k, in metres per window.
        measurements: Measurements with a row for each interval, the leading axis K of their arrays.
            They are taken in their order, after the displacement and after those of `ekf`
            (`update.Measurement`).
        variance: (K·n, 6) variances of [accel, gyro], (m/s²)² and (rad/s)², in the place of the
            densities of `ekf.noise`, e.g. those of a corrector. None: the densities hold.
        diagnostics: A network's diagnostics with a row for each interval, for the measurements that
            read them: `FilterHistory.diagnostics` of the run that is repeated.

    Returns:
        The final state, from which a later call continues (and continues the clone numbers k), and
        the history.

    Raises:
        ValueError: An argument has the wrong shape or precision, values that are not finite, or a
            covariance that is not positive definite. Inside `jit` values are not known, and
            `FilterHistory.healthy` reports bad ones.
    """
    check_frame(frame)
    inputs = checked_inputs(ekf, state, gyro, accel, imu_valid, measurements, variance)
    rows = checked_displacements(displacement, covariance, inputs)
    return _run_filter(inputs, *rows, dict(diagnostics), frame)


@functools.partial(jax.jit, static_argnames="frame")
def _run_filter(
    inputs: FilterInputs,
    displacement: Array,
    covariance: Array,
    diagnostics: dict[str, Array],
    frame: DisplacementFrame,
) -> tuple[FilterState, FilterHistory]:
    rows = scaled_displacement(displacement, covariance, inputs.ekf.noise, frame)
    return _run(take_row, inputs, (rows, diagnostics))


def run_odometry(
    predict: Predict | PredictWithMemory,
    ekf: Filter,
    state: FilterState,
    gyro: Any,
    accel: Any,
    imu_valid: Any = None,
    measurements: tuple[Measurement, ...] = (),
    variance: Any = None,
) -> tuple[FilterState, FilterHistory]:
    """Filter K clone intervals with the network in the loop (paper fig. 2): its windows are cut
    with the filter's own state.

    A window spans the samples between its two clones i and j, and before them come the C samples of
    its context (`FilterConfig.context_samples`). The filter's present biases are subtracted and the
    samples rotated by R_γ(R_i)ᵀ R_m, R_m being the present estimate of clone i advanced by
    integrating gyro − b_g (paper eq. 1; backwards through the context), unless
    `FilterConfig.window_rotation` says otherwise. The displacement is expressed in the filter's own
    yaw frame and linearised accordingly (`displacement.linearise_displacement`), except with
    "tlio". Its covariance is diag(exp 2u), u raised to `log_std_min`. The network is not called in
    the first `FilterConfig.first_measured` intervals after the start, which have no whole window. A
    window in which the filter coasted through a gap is no measurement.

    A network with memory (`PredictWithMemory`) is called once in every interval, with the samples
    of this interval alone. Its memory is carried from interval to interval, and the final state has
    it. It begins anew after an interval in which the filter coasted.

    Jit it from outside. It is also differentiable in the values that `predict` closes over.

    Args:
        predict: A function from windows (1, C + N, 6) float32, N = n·W, channels [accel m/s², gyro
            rad/s], to a `Prediction` with the same leading axis; or a network with memory.
        ekf: The filter (`Filter`, `make_filter`).
        state: The start (`initial_state`, `level_state`), or the final state of an earlier run.
        gyro: (K·n, 3) angular rate, body frame, rad/s, raw: the filter subtracts its bias.
        accel: (K·n, 3) specific force, body frame, m/s², raw.
        imu_valid: (K·n,) booleans, False where an IMU sample is missing, as in `run_filter`; None:
            the stream is complete.
        measurements: Measurements with a row for each interval, as in `run_filter`.
        variance: (K·n, 6) variances of the samples, as in `run_filter`.

    Returns:
        The final state and the history, as `run_filter` does.

    Raises:
        ValueError: As `run_filter`, or `predict` returns something else.
    """
    inputs = checked_inputs(ekf, state, gyro, accel, imu_valid, measurements, variance)
    config, begun = ekf.config, inputs.state.window is not None
    if has_memory(predict):
        memory = first_memory(predict, inputs.ekf, inputs.state)
        measure_recalled = functools.partial(_measure_recalled, inputs.ekf)
        return _run(measure_recalled, inputs, None, memory_step(predict, inputs.ekf), memory)
    of_window = network_measurement(predict, inputs.ekf)

    def measure(
        number: Array, stream: Imu, _: None, state: FilterState, oldest: Array
    ) -> tuple[Displacement, dict]:
        def latest() -> Imu:
            first = (number + 1) * config.samples_per_clone
            return jax.tree.map(
                lambda signal: jax.lax.dynamic_slice_in_dim(signal, first, config.reach), stream
            )

        # In a run from a start the scan's counter decides, which is one number for the whole batch.
        # So this remains a branch under vmap. `state.step` is a number for each sequence.
        number_since_start = number + inputs.state.step if begun else number
        return of_window(number_since_start >= config.first_measured, latest, state, oldest)

    return _run(measure, inputs, None)


def _measure_recalled(
    ekf: Filter, _: Array, __: Imu, recall: Recall, state: FilterState, oldest: Array
) -> tuple[Displacement, dict]:
    return recalled_displacement(ekf, recall, state, oldest)


def _run(
    measure: Callable[..., tuple[Displacement, dict]],
    inputs: FilterInputs,
    displacement: tuple[Displacement, dict] | None,
    remember: MemoryStep | None = None,
    memory: Memory | None = None,
) -> tuple[FilterState, FilterHistory]:
    """The state and the history of `clone_steps`."""
    state, records, age = clone_steps(
        measure, inputs, displacement, lambda slot, _, record, __: record, remember, memory
    )
    config = inputs.ekf.config
    history = finished_history(records, age, inputs.state.healthy, config)
    state = state._replace(healthy=history.healthy[-1] > 0)
    return unroll_clones(state, len(age) % config.clones), history


def take_row(
    _: Array, __: Imu, row: tuple[Displacement, dict], *___: Any
) -> tuple[Displacement, dict]:
    """`measure` of `clone_steps` where the displacements and the diagnostics are known before the
    run."""
    return row


def clone_steps(
    measure: Callable[..., tuple[Displacement, dict]],
    inputs: FilterInputs,
    displacement: tuple[Displacement, dict] | None,
    keep: Callable[[Array, FilterState, StepRecord, StepTrace], T],
    remember: MemoryStep | None = None,
    memory: Memory | None = None,
) -> tuple[FilterState, T, Float[Array, "k"]]:
    """Bridge holes of the stream and take a clone step for every interval. Returns the state at the
    end, whose clones are a ring, the stacked results of `keep`, and the age of the oldest held
    sample of each interval, s.

    measure(number, stream, row, state, oldest) returns the displacement of an interval and the
    network's diagnostics. `number` counts the intervals from 0. `stream` is the whole stream with
    the `FilterConfig.reach` samples that came before it in front. `row` is the interval's row of
    `displacement`, and `oldest` the slot of the oldest clone. keep(slot, state, record, trace)
    takes the slot of the newest clone and what `clone_step` returns. A network with memory takes
    its step before the filter does: remember(memory, state, imu) returns the next memory and the
    interval's `row`.
    """
    ekf, start, config = inputs.ekf, inputs.state, inputs.ekf.config
    signals = inputs.gyro, inputs.accel, inputs.imu_valid
    stream, age, imu_memory = bridge(*signals, start.imu, config)
    stream = stream._replace(variance=inputs.variance)
    n = config.samples_per_clone
    by_interval = jax.tree.map(lambda x: x.reshape(-1, n, *x.shape[1:]), stream)
    age = age.reshape(-1, n).max(1)
    with_past, window = after_window(stream, start.window, config)

    def step(
        carry: tuple[FilterState, Memory | None], row: tuple
    ) -> tuple[tuple[FilterState, Memory | None], T]:
        (state, memory), (number, imu, displacement, measurements) = carry, row
        if remember is not None:
            memory, displacement = remember(memory, state, imu)
        measure_now = functools.partial(measure, number, with_past, displacement)
        slot = number % config.clones
        state, record, trace = clone_step(ekf, state, imu, slot, measure_now, measurements)
        return (state, memory), keep(slot, state, record, trace)

    inputs_by_interval = jnp.arange(len(age)), by_interval, displacement, inputs.measurements
    start = invariant_errors(start._replace(window=None, memory=None), config)
    lengths = config.checkpoint_every, config.truncate_every
    (state, memory), rows = blocked_scan(step, (start, memory), inputs_by_interval, *lengths)
    imu_memory = imu_memory._replace(quiet=state.imu.quiet)
    return state._replace(imu=imu_memory, window=window, memory=memory), rows, age


# One clone interval
# ------------------------------------------------------------------------------------------------

Measure = Callable[[FilterState, Array | int], tuple[Displacement, dict]]
"""From the state and the slot of its oldest clone to the displacement and the network's
diagnostics."""


class StepTrace(NamedTuple):
    """How the error changed in one clone interval, as smoothing needs it."""

    transition: Transition
    corrections: tuple[Correction, ...]
    """The updates in the order in which they were made."""


def clone_step(
    ekf: Filter,
    state: FilterState,
    imu: Imu,
    slot: Array | int,
    measure: Measure,
    measurements: tuple[Measurement, ...] = (),
) -> tuple[FilterState, StepRecord, StepTrace]:
    """One clone interval with the samples `imu`: propagate, clone into `slot` of the ring, take the
    displacement, the measurements of the filter, and then those of this interval."""
    config, noise = ekf.config, ekf.noise
    # A ring of clones: the newest clone replaces the oldest one, and the next slot then holds the
    # oldest clone. The anchor moves once in a round of the ring.
    dtype, oldest = state.offset.dtype, (slot + 1) % config.clones
    anchored = jnp.where(jnp.asarray(slot) == 0, 1.0, 0.0).astype(dtype)
    state = move_anchor(state, anchored)
    interval = _integrate(state.mean._replace(position=state.offset), imu, noise, config.dt)
    transition = core_transition(interval, ekf.decay(dtype), anchored, state.shift)
    state = _propagate(state, interval, transition, slot)

    displacement, diagnostics = measure(state, oldest)
    outcomes: dict[str, Outcome] = {}
    corrections: tuple[Correction, ...] = ()
    for measurement in (displacement, *ekf.measurements, *measurements):
        step = Step(imu, slot, oldest, config, noise, outcomes, diagnostics)
        update = jax.checkpoint(
            lambda measurement, state, step=step: measurement.update(state, step),
            policy=_keep,
            prevent_cse=False,
        )
        state, outcome, correction = update(measurement, state)
        outcomes = {**outcomes, measurement.name: outcome}
        corrections = (*corrections, correction)

    covariance = core_covariance(state, config)
    if config.history == "diagonal":
        covariance = jnp.diagonal(covariance)
    record = StepRecord(state.mean, covariance, displacement, outcomes, diagnostics)
    return state, record, StepTrace(transition, corrections)


_OTHER_FORMS = {
    *("broadcast_in_dim", "convert_element_type", "neg", "reshape", "squeeze", "transpose")
}


def _keep(primitive: Any, *_: Any, **__: Any) -> bool:
    """Whether the backward pass keeps a result: not if it is another form of one that is kept."""
    return primitive.name not in _OTHER_FORMS


# Writing and reading the numbers that a backward pass keeps costs more than computing the interval
# again.
_integrate = jax.checkpoint(integrate, static_argnums=3, prevent_cse=False)
_propagate = jax.checkpoint(propagate, policy=_keep, prevent_cse=False)


# A scan whose backward pass is bounded
# ------------------------------------------------------------------------------------------------


def blocked_scan(
    step: Callable, carry: Any, inputs: Any, checkpoint_every: int = 0, truncate_every: int = 0
) -> tuple[Any, Any]:
    """`lax.scan` with a bounded backward pass. It keeps only the carry of every
    `checkpoint_every`-th step and computes the steps between them again. After every
    `truncate_every`-th step the carry has no gradient. 0: it keeps every carry, or never cuts the
    gradient."""
    run = within = functools.partial(jax.lax.scan, step)
    rows = len(jax.tree.leaves(inputs)[0])
    if 0 < checkpoint_every < min(truncate_every or rows, rows):
        within = _in_blocks(jax.checkpoint(run, prevent_cse=False), checkpoint_every)
    if not truncate_every:
        return within(carry, inputs)

    def cut(carry: Any, block: Any) -> tuple[Any, Any]:
        carry, out = within(carry, block)
        return jax.lax.stop_gradient(carry), out

    return _in_blocks(cut, min(truncate_every, rows))(carry, inputs)


def _in_blocks(run: Callable, every: int) -> Callable:
    """A scan by `run(carry, block)` over blocks of `every` rows of its inputs, and then over the
    rows that are left over."""

    def scan(carry: Any, inputs: Any) -> tuple[Any, Any]:
        count, left_over = divmod(len(jax.tree.leaves(inputs)[0]), every)
        whole = count * every
        blocks = jax.tree.map(lambda x: x[:whole].reshape(count, every, *x.shape[1:]), inputs)
        carry, out = jax.lax.scan(run, carry, blocks)
        out = jax.tree.map(lambda y: y.reshape(whole, *y.shape[2:]), out)
        if left_over:
            carry, last = run(carry, jax.tree.map(lambda x: x[whole:], inputs))
            out = jax.tree.map(lambda y, z: jnp.concatenate([y, z]), out, last)
        return carry, out

    return scan
