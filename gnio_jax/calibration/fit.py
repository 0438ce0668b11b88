"""The fits of a calibration: the factors of the axes, the filter's noises by the likelihood of its
innovations, and its consider covariance by the errors of its positions."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import minimize

from gnio_jax.config import CorrelatedError, DataConfig, FilterSettings, flatten
from gnio_jax.errors import InputError
from gnio_jax.evaluation import SequenceEstimate
from gnio_jax.evaluation.estimate import BatchInputs
from gnio_jax.evaluation.prepare import Start
from gnio_jax.evaluation.trajectory import Trajectory, relative_yaw
from gnio_jax.filtering import (
    ConsideredStd,
    Filter,
    FilterHistory,
    FilterState,
    considered_covariance,
    make_filter,
    over_sequences,
    run_filter,
    sensitivity,
)
from gnio_jax.filtering.history import POSITION, YAW
from gnio_jax.filtering.settings import (
    DisplacementFrame,
    free_parameters,
    with_free_parameters,
    with_written_parameters,
)
from gnio_jax.filtering.state import arc_of, yaw_lever
from gnio_jax.numerics import matrix_from_quaternion, rotation_z, yaw_rotation
from gnio_jax.training.filter_losses import gaussian_nll, normalised_squares
from gnio_jax.training.optimizer import FILTER_PARTS
from gnio_jax.types import Array

GROUPS = {
    "measurement": ("noise.measurement_scale",),
    "noise": FILTER_PARTS["noise"],
    "start": ("start.gyro_bias", "start.accel_bias"),
    "window": ("noise.correlation",),
}
"""The settings in each group of `--fit`."""
CONSIDERED = ConsideredStd(
    gyro_bias=1e-3, scale=0.05, heading=math.radians(5.0), slope=0.02, raw_gyro_bias=0.01
)
"""The start of the fit of the consider covariance (ours)."""
PHYSICAL = {
    "noise.gyro_density": (1e-6, 0.1),
    "noise.accel_density": (1e-5, 1.0),
    "noise.gyro_bias_walk": (0.0, 0.01),
    "noise.accel_bias_walk": (0.0, 0.3),
    "noise.measurement_scale": (0.01, 100.0),
    "noise.correlation.share": (0.0, 0.99),
    "noise.correlation.seconds": (0.05, 60.0),
    "start.gyro_bias": (0.0, 0.2),
    "start.accel_bias": (0.0, 2.0),
}
"""Smallest and largest plausible values for sensors of phones and headsets and for errors of
networks, with a margin on both sides (ours). A fitted value outside was not determined by the
recordings."""
PRIOR_STD = 2.0
"""Prior standard deviation of each fitted number about its start, in its logarithm or logit (ours).
For numbers that the recordings determine it has almost no effect; other numbers keep their
start."""
DIGITS = 4
"""Number of digits that are written to the settings."""
LARGEST_SENSITIVITY = 1e6
"""Largest derivative of a position by an error that is not estimated, m for one unit of it."""
CHECKPOINT_EVERY = 50
"""Clone intervals between the states that the backward pass keeps."""
LEAST_GAIN = 1e-4
"""Gain of the negative log-likelihood per innovation below which no new search is begun."""
FAILED = 1e6
"""The objective where the filter fails, so that the search turns back."""
NO_GATE = 1e9
"""Threshold of a χ² gate that accepts everything: a gate that rejects would favour a noise so small
that everything is rejected."""
TAIL = 4.0
"""Degrees of freedom of the t distribution of heights (ours): a recording on which the filter is
lost counts, but it does not decide the slope of all others."""
TAIL_VARIANCE = 0.690567
"""Squared scale of that distribution for normally distributed heights of variance 1: the c with
E[(ν + 1) x² / (ν c + x²)] = 1. Then heights without outliers get their own slope."""
LEAST_WINDOWS = 100
"""Smallest number of windows with a reference for which factors of the axes are fitted (ours)."""
LEAST_FACTOR = 1e-3
"""Smallest factor of an axis (ours)."""


def true_displacements(estimate: SequenceEstimate, windows: DataConfig) -> Float[np.ndarray, "m 3"]:
    """The true displacements of the windows that end at the last m rows of an estimate, m, in the
    yaw frame of the filter at their starts, turned there by the error of its yaw; NaN without a
    reference.

    The displacements of the network are expressed in this frame. The yaw frame of the reference is
    another one where the x axis of the device is steep: a tilt of the filter turns it by far more
    than the tilt, and that is no error of the network.
    """
    clones = windows.window // windows.stride
    path, reference = (
        Trajectory(*(part[:-clones] for part in trajectory))
        for trajectory in (estimate.trajectory, estimate.reference)
    )
    moved = estimate.reference.position[clones:] - reference.position
    turn = rotation_z(relative_yaw(path.orientation, reference.orientation))
    to_frame = np.swapaxes(yaw_rotation(matrix_from_quaternion(path.orientation)), 1, 2)
    return np.einsum("kij,kjl,kl->ki", to_frame, turn, moved)


def fit_std_factors(
    estimates: list[SequenceEstimate], truths: list[Float[np.ndarray, "m 3"]]
) -> Float[np.ndarray, "3"]:
    """Root mean square of error over standard deviation, for each axis, over all windows.

    `truths` are the true displacements of the windows (`true_displacements`), or the true
    velocities in the body. Raises `ValueError` if too few windows have both.
    """
    errors = []
    for estimate, truth in zip(estimates, truths, strict=True):
        displacements = estimate.displacements
        assert displacements is not None
        last = slice(len(displacements.value) - len(truth), None)
        errors.append((displacements.value[last] - truth) / displacements.std[last])
    normalised = np.concatenate(errors)
    normalised = normalised[np.isfinite(normalised).all(1)]
    if len(normalised) < LEAST_WINDOWS:
        raise ValueError(f"{len(normalised)} windows have a reference, {LEAST_WINDOWS} are needed")
    return np.maximum(np.sqrt(np.mean(normalised**2, axis=0)), LEAST_FACTOR)


class InnovationFit(NamedTuple):
    """The settings with the largest likelihood of the innovations."""

    settings: FilterSettings
    before: float
    """−log-likelihood per innovation at the start of the fit, with the factors of the axes."""
    after: float
    """The same with `settings`."""
    steps: int
    warnings: tuple[str, ...] = ()
    """Reasons why the settings may not be the best ones, each in one sentence."""


def start_of_fit(settings: FilterSettings, paths: Sequence[str]) -> FilterSettings:
    """The start of the fit of these paths: the settings, with a correlation if it was off.

    Raises `InputError` for a number that is 0, because it has no logarithm.
    """
    correlation = settings.noise.correlation
    if "noise.correlation" in paths and not (correlation and correlation.share):
        noise = settings.noise._replace(correlation=CorrelatedError())
        settings = dataclasses.replace(settings, noise=noise)
    values = flatten(settings)
    for path in paths:
        if values.get(path) == 0:
            remedy = "leave its group out of --fit, or give the run a small value"
            raise InputError(f"filter.{path}", "is 0 and cannot be fitted", remedy)
    return settings


def fit_innovations(
    walks: BatchInputs,
    windows: DataConfig,
    settings: FilterSettings,
    paths: Sequence[str],
    progress: Callable[[int], None],
    most_steps: int = 60,
) -> InnovationFit:
    """The settings that make the innovations most likely, by L-BFGS from `settings`; `paths` names
    those that are fitted.

    A step to values at which the filter fails counts as very unlikely, and the search turns back.
    Raises `InputError` if the filter fails with `settings`.
    """
    free = free_parameters(settings, paths)
    names, start = tuple(free), np.array(list(free.values()))
    on_device = jax.device_put((walks, start, settings))
    nlls: list[float] = []
    """The −log-likelihood per innovation at each call, the first of which is at the start."""

    def evaluate(vector: np.ndarray) -> tuple[float, np.ndarray]:
        call = _value_and_gradient(vector, *on_device, names=names, windows=windows)
        (value, nll), gradient = jax.device_get(call)
        sound = np.isfinite(value) and np.isfinite(gradient).all()
        nlls.append(float(nll) if sound else FAILED)
        progress(len(nlls))
        if not sound:
            return FAILED, np.zeros_like(vector)
        return float(value), np.asarray(gradient, float)

    point, least, steps, converged = start, math.inf, 0, False
    # After a trial step to a point with an exploding gradient (4e126 occurred, for a value of 0.4)
    # the step of the line search becomes almost zero, which counts as convergence. A new search
    # from there continues, if the objective can still decrease.
    while True:
        limits = {"maxiter": most_steps - steps, "ftol": 1e-7}
        result = minimize(evaluate, point, jac=True, method="L-BFGS-B", options=limits)
        gain, point, least = least - result.fun, result.x, result.fun
        steps += int(result.nit)
        converged = result.success or (converged and gain < LEAST_GAIN)
        if nlls[0] == FAILED:
            problem = "fails on these recordings with the settings of the run"
            raise InputError("the filter", problem)
        if gain < LEAST_GAIN or steps >= most_steps:
            break
    fitted = with_written_parameters(settings, dict(zip(names, point, strict=True)), DIGITS)
    before = nlls[0]
    evaluate(np.array(list(free_parameters(fitted, names).values())))
    warnings = []
    if steps >= most_steps and gain >= LEAST_GAIN:
        limit = f"the fit stopped after {most_steps} steps"
        warnings.append(
            f"{limit}, before it had found the best settings; give fewer groups to --fit"
        )
    elif not converged:
        warnings.append(
            f"the fit stopped after {steps} steps, because no step along the gradient made the "
            "innovations more likely; the settings are the best ones that it found"
        )
    warnings += find_implausible(fitted, names)
    return InnovationFit(fitted, before, nlls[-1], steps, tuple(warnings))


def find_implausible(settings: FilterSettings, names: tuple[str, ...]) -> list[str]:
    """A sentence for each of these settings that is outside its plausible range."""
    values, lines = flatten(settings), []
    for name in (name for name in names if name in PHYSICAL):
        low, high = PHYSICAL[name]
        if not low <= values[name] <= high:
            lines.append(
                f"filter.{name} came out as {values[name]:.4g}, outside {low:g} to {high:g}: "
                "these recordings do not determine it"
            )
    return lines


def innovation_filter(windows: DataConfig, settings: FilterSettings) -> Filter:
    """The filter whose innovations are evaluated: its gate accepts everything."""
    ekf = make_filter(windows, settings)
    config = dataclasses.replace(
        ekf.config,
        gate_threshold=NO_GATE,
        history="diagonal",
        checkpoint_every=CHECKPOINT_EVERY,
    )
    return dataclasses.replace(ekf, config=config)


def innovation_objective(
    free: Float[Array, "u"],
    walks: BatchInputs,
    start: Float[Array, "u"],
    settings: FilterSettings,
    *,
    names: tuple[str, ...],
    windows: DataConfig,
) -> tuple[Array, Array]:
    """The objective to be minimised, as a function of the free parameters `names` of the settings,
    and its part that is the −log-likelihood of all innovations divided by their number. The rest is
    the prior about `start`, which keeps parameters in place that the walks do not determine."""
    chex.assert_equal_shape([free, start])

    def of_walk(settings: FilterSettings, walk: BatchInputs) -> Array:
        ekf = innovation_filter(windows, settings)
        run, displacement = _make_run(walk, ekf, ekf.config.displacement_frame)
        history = run(_wide_start(walk, settings).state(ekf), displacement)
        # The padding of the walk comes after its last displacement, where the filter may diverge.
        present = jnp.isfinite(displacement).all(axis=1)
        healthy = jnp.all((history.healthy > 0) | ~present)
        return jnp.where(healthy, jnp.nansum(history.log_likelihood), jnp.nan)

    settings = with_free_parameters(settings, dict(zip(names, free, strict=True)))
    log_likelihood = jnp.sum(over_sequences(of_walk, shared=1)(settings, walks))
    assert walks.displacements is not None
    count = jnp.isfinite(walks.displacements.value).all(axis=2).sum()
    return (_prior(free, start) - log_likelihood) / count, -log_likelihood / count


_value_and_gradient = jax.jit(
    jax.value_and_grad(innovation_objective, has_aux=True), static_argnames=("names", "windows")
)


def apply_start_settings(start: Start, settings: FilterSettings) -> Start:
    """The start of a recording with the uncertainty that an evaluation gives it, if it starts from
    its reference."""
    level = settings.start.gyro_bias
    if settings.raw_gyro_bias is not None:
        level = jnp.where(start.raw_gyro, settings.raw_gyro_bias, level)
    return start._replace(std=settings.start, level_gyro_bias=level)


def _wide_start(walk: BatchInputs, settings: FilterSettings) -> Start:
    """The start with all components of a raw gyro's bias uncertain (ours). Otherwise the fit would
    explain an unknown vertical component by noise."""
    start = apply_start_settings(walk.start, settings)
    return start._replace(std=start.std._replace(gyro_bias=start.level_gyro_bias))


def _make_run(
    walk: BatchInputs, ekf: Filter, frame: DisplacementFrame
) -> tuple[Callable[[FilterState, Array], FilterHistory], Array]:
    """The function that runs the filter over one walk, given a start and displacements in `frame`,
    and the displacements of the walk."""
    assert walk.displacements is not None
    value, covariance, _ = walk.displacements

    def run(state: FilterState, displacement: Array) -> FilterHistory:
        rows = displacement, covariance, walk.imu_valid, frame
        return run_filter(ekf, state, walk.gyro, walk.accel, *rows, variance=walk.variance)[1]

    return run, jnp.asarray(value)


def _prior(free: Float[Array, "u"], start: Float[Array, "u"]) -> Float[Array, ""]:
    """−log density of the free parameters, up to a constant."""
    return 0.5 * jnp.sum(((free - start) / PRIOR_STD) ** 2)


class ConsiderFit(NamedTuple):
    """The standard deviations of the errors that the filter does not estimate."""

    settings: FilterSettings
    before: float
    """Mean over all positions of eᵀ P⁻¹ e / 3 without them."""
    after: float
    """The same with `settings`."""


class PositionErrors(NamedTuple):
    """The errors of all positions with a reference, in rows over all recordings."""

    error: Float[np.ndarray, "k 3"]
    """Truth − estimate, m."""
    covariance: Float[np.ndarray, "k 3 3"]
    """The filter's covariance, m²."""
    sensitivity: Float[np.ndarray, "k 3 6"]
    """S of the position."""
    with_yaw: Float[np.ndarray, "k 3"]
    """The filter's covariance of the position with the yaw, m·rad; 0 with additive errors, where
    no covariance has an arc."""
    yaw_sensitivity: Float[np.ndarray, "k 6"]
    """S of the yaw; 0 with additive errors."""
    raw_axis: Float[np.ndarray, "k 3"]
    """As `considered_covariance` takes it."""
    recording: Int[np.ndarray, "k"]
    """Number of the recording."""


def fit_considered(positions: PositionErrors, settings: FilterSettings) -> ConsiderFit:
    """Most likely consider standard deviations, given the errors of positions.

    The search always begins at `CONSIDERED`. Recordings with a raw gyro determine only the slope
    and the further error of raw gyros, because the yaw that they lose would be attributed to the
    displacements. If every recording has one, they determine the other errors, and `raw_gyro_bias`
    is 0. The slope is fitted last, to the heights of all recordings, which do not depend on the yaw
    (all ours). Raises `InputError` if no position has a reference, or if there is no likelihood.
    """
    if not len(positions.error):
        raise InputError("the filter", "is not healthy where these recordings have a reference")
    raw = positions.raw_axis.any(axis=1)
    mixed = raw.any() and not raw.all()
    others = PositionErrors(*(part[~raw] for part in positions)) if mixed else positions
    initial = CONSIDERED._replace(raw_gyro_bias=0.0)
    fitted = _fit_below("considered", others, initial, settings, gaussian_nll)
    if mixed:
        initial = fitted.considered._replace(raw_gyro_bias=CONSIDERED.raw_gyro_bias)
        path = "considered.raw_gyro_bias"
        fitted = _fit_below(path, positions, initial, settings, gaussian_nll)
    initial = fitted.considered._replace(slope=CONSIDERED.slope)
    fitted = _fit_below("considered.slope", positions, initial, settings, _height_nll)
    with_fitted = _add_considered(positions, fitted.considered)
    before, after = (
        float(jnp.mean(normalised_squares(positions.error, covariance))) / 3
        for covariance in (positions.covariance, with_fitted)
    )
    return ConsiderFit(fitted, before, after)


def _fit_below(
    path: str,
    positions: PositionErrors,
    initial: ConsideredStd,
    settings: FilterSettings,
    nll: Callable[[Array, Array], Array],
) -> FilterSettings:
    """`settings` with the most likely values of the numbers below `path`, from `initial`. `nll`
    gives the mean −log-likelihood of errors and covariances.

    Each of these errors is constant while a recording lasts, so the positions of a recording count
    together as one observation beside the prior.
    """
    settings = dataclasses.replace(settings, considered=initial)
    free = free_parameters(settings, [path])
    names, start = tuple(free), np.array(list(free.values()))
    recordings = len(np.unique(positions.recording))

    def objective(free: Float[Array, "u"]) -> Array:
        std = with_free_parameters(settings, dict(zip(names, free, strict=True))).considered
        likelihood = nll(positions.error, _add_considered(positions, std))
        return likelihood + _prior(free, start) / recordings

    compiled = jax.jit(jax.value_and_grad(objective))
    search = minimize(
        lambda free: jax.device_get(compiled(free)), start, jac=True, method="L-BFGS-B"
    )
    if not np.isfinite(search.fun):
        raise InputError("the filter", "has no positive definite covariance on these recordings")
    return with_written_parameters(settings, dict(zip(names, search.x, strict=True)), DIGITS)


def _height_nll(
    error: Float[Array, "k 3"], covariance: Float[Array, "k 3 3"]
) -> Float[jax.Array, ""]:
    """Mean of −ln t(e_z; 0, c P_zz) with `TAIL` degrees of freedom and c of `TAIL_VARIANCE`,
    without its constant."""
    variance = TAIL_VARIANCE * covariance[:, 2, 2]
    normalised = error[:, 2] ** 2 / (TAIL * variance)
    return jnp.mean((TAIL + 1) / 2 * jnp.log1p(normalised) + 0.5 * jnp.log(variance))


def _add_considered(positions: PositionErrors, std: ConsideredStd) -> Array:
    """The covariances of the positions, with the consider covariance as `with_considered` adds
    it."""
    rows = jnp.concatenate([positions.yaw_sensitivity[:, None], positions.sensitivity], axis=1)
    added = considered_covariance(rows, std, positions.raw_axis)
    covariance = positions.covariance + added[:, 1:, 1:]
    arc, arc_before = (
        arc_of(yaw_lever(with_yaw))
        for with_yaw in (positions.with_yaw + added[:, 0, 1:], jnp.asarray(positions.with_yaw))
    )
    return covariance + arc - arc_before


def compare_positions(
    walks: BatchInputs,
    truth: Float[np.ndarray, "w k 3"],
    windows: DataConfig,
    settings: FilterSettings,
) -> PositionErrors:
    """Compare the positions of a filter over the walks with the true ones, where it is healthy.

    `truth` has the true positions after each stride, m; NaN where there is none. Positions on
    which an error that is not estimated acts more than `LARGEST_SENSITIVITY` are left out: there
    the filter amplifies it from update to update, and no covariance is that large.
    """
    results = jax.device_get(_run_walks(walks, settings, windows=windows))
    healthy, position, covariance, sensitivity, *parts = results
    error = truth - position
    compared = np.isfinite(error).all(axis=2) & (healthy > 0)
    compared &= np.abs(sensitivity).max(axis=(2, 3)) < LARGEST_SENSITIVITY
    recording = np.broadcast_to(np.arange(len(error))[:, None], compared.shape)
    rows = error, covariance, sensitivity, *parts, recording
    return PositionErrors(*(part[compared] for part in rows))


@functools.partial(jax.jit, static_argnames="windows")
def _run_walks(
    walks: BatchInputs, settings: FilterSettings, *, windows: DataConfig
) -> tuple[Array, ...]:
    """For every walk: where the filter is healthy, its positions, and the other parts of
    `PositionErrors`."""

    def of_walk(settings: FilterSettings, walk: BatchInputs) -> tuple[Any, ...]:
        ekf = make_filter(windows, settings)
        start = apply_start_settings(walk.start, settings)
        state = start.state(ekf)
        run, displacement = _make_run(walk, ekf, ekf.config.derivative_frame)
        history = run(state, displacement)
        rotation = history.rotation if ekf.config.measures == "velocity" else None
        derivatives = sensitivity(run, state, displacement, rotation)
        assert history.covariance is not None
        covariance = history.covariance[:, POSITION, POSITION]
        of_position = covariance, derivatives[:, POSITION]
        of_yaw = history.covariance[:, POSITION, YAW], derivatives[:, YAW]
        if not ekf.config.invariant:
            of_yaw = jax.tree.map(jnp.zeros_like, of_yaw)
        axis = jnp.tile(start.raw_axis[None], (len(covariance), 1))
        return history.healthy, history.position, *of_position, *of_yaw, axis

    return over_sequences(of_walk, shared=1)(settings, walks)
