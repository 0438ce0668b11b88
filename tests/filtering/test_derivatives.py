"""Derivatives of the history: forward, reverse, batched, checkpointed, behind a gate with a slope;
finite where input is hostile."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering.scan import blocked_scan
from gnio_jax.filtering.state import with_correlated_error
from gnio_jax.types import Prediction
from tests.support.compiling import quick
from tests.support.odometry import (
    CLONES,
    DT,
    INTERVALS,
    PARAMETERS,
    WEIGHTS,
    N,
    central,
    recording,
    start,
)

MEASURED = 0.1 * np.random.default_rng(4).standard_normal((INTERVALS, 3))
PLAIN = filtering.FilterConfig(DT, N, CLONES)
FIX = filtering.fixes_on_intervals(
    [0.1, 0.5, 0.93], np.eye(3)[:, :2], np.tile(0.3 * np.eye(2), (3, 1, 1)), INTERVALS, PLAIN
)
"""In the first half."""


class Felt(NamedTuple):
    """What of a history is felt."""

    weights: np.ndarray
    """(K, 3) of the positions."""
    rows: np.ndarray
    """(K,): 1 where innovations are felt, else 0."""
    end: np.ndarray
    """(K,): 1 in the row after which the state is felt, else 0."""


WHOLE = Felt(WEIGHTS, np.ones(INTERVALS), np.eye(INTERVALS)[-1])


def of_history(history, felt=WHOLE):
    """A scalar that feels every part of the history."""
    weights, rows, end = map(jnp.asarray, felt)
    return (
        jnp.sum(weights * history.position)
        + jnp.sum(end[:, None] * history.rotation[:, 0])
        + 0.01 * jnp.nansum(rows * history.nis)
        + jnp.sum(end[:, None] * history.velocity)
        + 10 * jnp.sum(end[:, None] * (history.gyro_bias + history.accel_bias))
        + 0.1 * jnp.nansum(rows * history.log_likelihood)
        + jnp.sum(end[:, None] * jnp.log(history.covariance_diagonal))
    )


class Carried(NamedTuple):
    """A state to begin with, where it is `taken`."""

    taken: bool
    state: filtering.FilterState


def loss(x, felt=WHOLE, carried=None, config=PLAIN):
    """The scalar and the history. x: noise (4,) log factors, correlation (2,) share and seconds,
    factor (3,) of the axes, std (6,) log factors of the start's, state (12,) added to the start,
    measured (K, 3), gyro, accel, fix (4,): a shift, changes of the covariance, of the moment and of
    its spread."""
    noise = filtering.NoiseModel(
        *(jnp.array([1e-2, 1e-1, 1e-2, 1e-1]) * jnp.exp(x["noise"])),
        std_factor=tuple(x["factor"]),
        correlation=filtering.CorrelatedError(*x["correlation"]),
    )
    std = filtering.InitialStd(*(jnp.array(filtering.InitialStd()) * jnp.exp(x["std"])))
    first, (velocity, position, *biases) = start(), jnp.split(x["state"], 4)
    state = filtering.initial_state(
        config,
        first.rotation,
        first.velocity + velocity,
        first.position + position,
        first.gyro_bias + biases[0],
        first.accel_bias + biases[1],
        std,
    )
    if carried is not None:
        choose = functools.partial(jnp.where, carried.taken)
        state = jax.tree.map(choose, carried.state, with_correlated_error(state))
    spread = jnp.tile(0.01 * jnp.eye(3)[None], (INTERVALS, 1, 1))
    shift, larger, later, spread_of_time = x["fix"]
    fix = filtering.Fix(
        jnp.asarray(FIX.position) + shift,
        jnp.asarray(FIX.covariance) * (1 + larger),
        jnp.asarray(FIX.before_end) + later,
        jnp.asarray(FIX.time_std) + spread_of_time,
        FIX.threshold,
    )
    given = state, x["gyro"], x["accel"], x["measured"], spread, config, noise
    _, history = filtering.run_filter(*given, measurements=(fix,))
    return of_history(history, felt), history


def point(measured=MEASURED):
    gyro, accel = recording(2)
    return dict(
        noise=np.zeros(4),
        correlation=np.array([0.6, 0.3]),
        factor=np.array([1.5, 0.7, 1.2]),
        std=np.zeros(6),
        state=np.zeros(12),
        measured=measured,
        gyro=gyro,
        accel=accel,
        fix=np.array([0.0, 0.0, 0.0, 0.1]),
    )


BATCH = 3
GRADIENT = quick(jax.vmap(jax.value_and_grad(loss, has_aux=True), in_axes=(0, None, None)))


def gradients(points, felt=WHOLE, carried=None):
    """Values and gradients at all of the points, from one program for batches."""
    if carried is None:
        carried = Carried(False, with_correlated_error(start()))
    found = []
    for first in range(0, len(points), BATCH):
        some = points[first : first + BATCH]
        some = some + [some[-1]] * (BATCH - len(some))
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *some)
        (value, _), gradient = jax.device_get(GRADIENT(stacked, felt, carried))
        found.append((value, gradient))
    return jax.tree.map(lambda *parts: np.concatenate(parts)[: len(points)], *found)


def differences(x, name, step, row=...):
    """Central ones of the loss in every entry of x[name][row]."""
    shape, points = x[name][row].shape, []
    for change in step * np.eye(int(np.prod(shape))):
        for sign in (1, -1):
            moved = x[name].copy()
            moved[row] += sign * change.reshape(shape)
            points.append({**x, name: moved})
    ahead, behind = gradients(points)[0].reshape(-1, 2).T
    return ((ahead - behind) / (2 * step)).reshape(shape)


def test_gradient_against_differences():
    """Over a run with missing rows and fixes, with respect to everything but the network; of the
    correlated errors also where they have no size."""
    measured = MEASURED.copy()
    measured[[7, 8]] = np.nan
    x = point(measured)
    _, found = gradients([x])
    for name in ("noise", "correlation", "factor", "std", "state", "fix"):
        expected = differences(x, name, 1e-5 if name == "correlation" else 1e-4)
        np.testing.assert_allclose(
            found[name][0], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max(), err_msg=name
        )
        assert (np.abs(expected) > 0).all()
    for name, k in (
        ("measured", CLONES),
        ("measured", INTERVALS - 1),
        ("gyro", 3),
        ("accel", 3),
        ("accel", -1),
    ):
        np.testing.assert_allclose(
            found[name][0][k], differences(x, name, 1e-5, k), rtol=1e-5, atol=1e-8
        )
    _, without = gradients([x | {"correlation": np.array([0.0, 0.3])}])
    assert all(np.isfinite(leaf).all() for leaf in without.values())


def scanned(scan, start, inputs):
    """A scalar of a scan's carry and of all that it returns."""

    def step(carry, x):
        carry = jnp.tanh(carry @ (jnp.eye(2) + x["turn"])) + x["push"]
        return carry, {"square": carry**2, "first": carry[0]}

    carry, out = scan(step, start, inputs)
    return (
        jnp.sum(carry)
        + jnp.sum(jnp.arange(1.0, 14)[:, None] * out["square"])
        + jnp.sum(out["first"])
    )


@functools.cache
def of_a_plain_scan():
    """The arguments of `scanned`, its value and its gradients."""
    rng = np.random.default_rng(2)
    arguments = (
        jnp.array([0.3, -0.2]),
        {"turn": 0.3 * rng.standard_normal((13, 2, 2)), "push": 0.3 * rng.standard_normal((13, 2))},
    )
    plain = functools.partial(scanned, jax.lax.scan)
    return arguments, quick(jax.value_and_grad(plain, (0, 1)))(*arguments)


@pytest.mark.parametrize("every", [0, 4, 5, 13, 50])
def test_checkpoints_change_nothing(every):
    """Of any scan, whole blocks or not; the filter's own is differentiated through checkpoints with
    the network below."""
    arguments, wanted = of_a_plain_scan()
    ours = functools.partial(scanned, functools.partial(blocked_scan, checkpoint_every=every))
    found = quick(jax.value_and_grad(ours, (0, 1)))(*arguments)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12), found, wanted
    )
    text = str(jax.make_jaxpr(jax.grad(ours))(*arguments))
    assert ("remat" in text or "checkpoint" in text) == (0 < every < 13)


def test_checkpoints_bound_the_memory():
    def temporary(every):
        def value(start):
            carry, out = blocked_scan(
                lambda x, push: (jnp.tanh(x @ x) + push, x[0, 0]), start, jnp.ones(1040), every
            )
            return jnp.sum(carry) + jnp.sum(out)

        return (
            jax.jit(jax.grad(value))
            .lower(jnp.zeros((20, 20)))
            .compile()
            .memory_analysis()
            .temp_size_in_bytes
        )

    assert temporary(32) < temporary(0) / 4


# One program for all of it, since compiling is what these tests cost.
HOSTILE = quick(
    jax.value_and_grad(
        functools.partial(
            loss,
            config=filtering.FilterConfig(
                DT,
                N,
                CLONES,
                convergence_seconds=0.1,
                zero_velocity_std=0.01,
                rest_seconds=0.1,
                gate_softness=2.0,
                gate_threshold=8.0,
            ),
        ),
        has_aux=True,
    )
)


def hostile(kind):
    x = point(MEASURED.copy())
    if kind == "rest":
        # Nothing turns, nothing moves, every innovation is small: each norm in the filter is at its
        # singular point.
        x |= dict(
            gyro=np.zeros_like(x["gyro"]),
            accel=np.tile([0.0, 0.0, 9.81], (len(x["gyro"]), 1)),
            measured=np.zeros_like(MEASURED),
        )
    elif kind == "rejected":
        x["measured"][12:18] = 50.0
    elif kind == "missing":
        x["measured"][10:14] = np.nan
    else:
        x["gyro"] = np.tile([0.0, np.pi / (len(x["gyro"]) * DT), 0.0], (len(x["gyro"]), 1))
    return x


def test_gradients_are_finite_for_hostile_input():
    for kind in ("rest", "rejected", "missing", "gimbal"):
        (value, _), gradient = HOSTILE(hostile(kind))
        assert np.isfinite(value), kind
        for name, leaf in gradient.items():
            assert np.isfinite(leaf).all(), (kind, name)
            assert np.abs(leaf).max() > 0, (kind, name)


def test_a_gate_with_a_slope_lets_the_gradient_through():
    measured = MEASURED.copy()
    measured[14, 0] += 1.2

    def at(value):
        rows = measured.copy()
        rows[14, 0] += float(value)
        return HOSTILE(point(rows))

    (_, history), gradient = at(0.0)
    slope = float(gradient["measured"][14, 0])
    np.testing.assert_allclose(
        slope, central(lambda x: float(at(x)[0][0]), np.zeros(()), 1e-5), rtol=1e-5
    )
    assert abs(slope) > 0  # behind the hard gate it would be zero where the row is rejected
    weights, nis = np.asarray(history.gate_passed), np.asarray(history.nis)
    watched = weights < 1
    np.testing.assert_allclose(
        weights[watched], 1 / (1 + np.exp((nis[watched] - 8.0) / 2.0)), rtol=1e-9
    )
    assert (np.asarray(history.accepted)[CLONES:] == 1).all() and watched.sum() > 5


def test_gradient_reaches_the_network():
    """Of its own parameters to 1e-5; through the windows, which are cut with the state, as far as
    differences can say, since the window is rounded to float32. `share` is that of what the network
    makes of its window."""
    gyro, accel = recording(0)
    config = filtering.FilterConfig(DT, N, CLONES, checkpoint_every=INTERVALS // 2)
    assert INTERVALS % 2 == 0  # no step is left over, which would be compiled once more

    def value(parameters, share):
        def network(windows):
            ramp = jnp.linspace(0.5, 1.5, N * CLONES)[None, :, None]
            seen = jnp.mean(ramp * windows.astype(jnp.float64), axis=1) @ parameters
            pooled = share * seen + (1 - share) * jnp.tanh(parameters.sum(0))[None]
            return Prediction(pooled, -2.0 + 0.1 * pooled)

        _, history = filtering.run_odometry(
            network, start(config), gyro, accel, config, filtering.NoiseModel()
        )
        return of_history(history)

    both = quick(jax.value_and_grad(value))
    expected = central(lambda p: float(both(p, 0.0)[0]), PARAMETERS, 1e-4)
    np.testing.assert_allclose(both(PARAMETERS, 0.0)[1], expected, rtol=1e-5, atol=1e-7)
    coarse, fine = (
        central(lambda p: float(both(p, 1.0)[0]), PARAMETERS, step) for step in (1e-2, 5e-3)
    )
    expected = (4 * fine - coarse) / 3
    np.testing.assert_allclose(
        both(PARAMETERS, 1.0)[1], expected, rtol=2e-3, atol=2e-3 * np.abs(expected).max()
    )


def test_a_truncated_gradient_is_that_of_two_runs():
    """Values are those of one run; the second half starts from a state that counts as given."""
    half, x = INTERVALS // 2, point()
    truncated = functools.partial(
        loss, config=filtering.FilterConfig(DT, N, CLONES, truncate_every=half)
    )
    (value, _), gradient = quick(jax.value_and_grad(truncated, has_aux=True))(x)

    # Runs of full length, of which the first half alone is felt.
    rows, samples = slice(half), slice(half * N)
    first = 1.0 * (np.arange(INTERVALS) < half)
    felt = Felt(WEIGHTS * first[:, None], first, np.zeros(INTERVALS))
    one, of_one = gradients([x], felt)
    noise = filtering.NoiseModel(
        *(1e-2, 1e-1, 1e-2, 1e-1),
        std_factor=tuple(x["factor"]),
        correlation=filtering.CorrelatedError(*x["correlation"]),
    )
    spread = np.tile(0.01 * np.eye(3), (half, 1, 1))
    given = x["gyro"][samples], x["accel"][samples], MEASURED[rows], spread, PLAIN, noise
    fix = jax.tree.map(lambda leaf: leaf[rows], FIX._replace(time_std=FIX.time_std + 0.1))
    state, _ = filtering.run_filter(start(), *given, measurements=(fix,))
    turned = {name: np.roll(x[name], -half * N, axis=0) for name in ("gyro", "accel")}
    no_fix = np.array([np.nan, 0.0, 0.0, 0.1])
    later = x | turned | {"measured": np.roll(MEASURED, -half, axis=0), "fix": no_fix}
    end = np.eye(INTERVALS)[half - 1]
    felt = Felt(np.roll(WEIGHTS, -half, axis=0) * first[:, None], first, end)
    other, of_other = gradients([later], felt, Carried(True, state))

    np.testing.assert_allclose(value, one[0] + other[0], rtol=1e-12)
    wanted = {"noise": of_one["noise"][0] + of_other["noise"][0]}
    wanted |= {name: of_one[name][0] for name in ("std", "state")}
    for name, part in (("measured", rows), ("gyro", samples), ("accel", samples)):
        wanted[name] = np.concatenate([of_one[name][0][part], of_other[name][0][part]])
    for name in wanted:
        size = np.abs(wanted[name]).max()
        np.testing.assert_allclose(
            gradient[name], wanted[name], rtol=1e-9, atol=1e-12 * size, err_msg=name
        )
    _, whole = gradients([x])
    assert np.abs(whole["noise"][0] / gradient["noise"] - 1).max() > 0.01
