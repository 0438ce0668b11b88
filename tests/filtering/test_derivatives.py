"""Derivatives of the whole filter, the network in its loop: of one program with everything that a
run may have, against central differences, and finite where input is hostile."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering.scan import blocked_scan
from gnio_jax.types import Prediction
from tests.support.compiling import quick
from tests.support.odometry import DT, INTERVALS, PARAMETERS, N, recording, start

CLONES, HALF = 4, INTERVALS // 2
CONFIG = filtering.FilterConfig(
    DT,
    N,
    CLONES,
    convergence_seconds=0.1,
    rest_seconds=0.1,
    gate_softness=2.0,
    gate_threshold=8.0,
    bridge_seconds=0.05,
    truncate_every=HALF,
    checkpoint_every=HALF // 2,
)
FIX = filtering.fixes_on_intervals(
    [0.1, 0.5, 0.75], np.eye(3)[:, :2], np.tile(0.3 * np.eye(2), (3, 1, 1)), INTERVALS, CONFIG
)
"""In the first half."""
KNOCK = 100.0
"""m/s²: above it the network takes a window for a leap."""


class Around(NamedTuple):
    """What nothing is differentiated by."""

    rows: np.ndarray
    """(K,): 1 where the history is felt, else 0."""
    valid: np.ndarray
    """Of the IMU's samples."""
    share: float = 0.0
    """Of what the network makes of its window, which is rounded to float32; the rest hangs on its
    parameters alone."""


ROWS = np.arange(INTERVALS)
EARLY, LATE = (
    Around(1.0 * rows, np.ones(N * INTERVALS, bool)) for rows in (ROWS < HALF, ROWS >= HALF)
)
WHOLE = EARLY._replace(rows=np.ones(INTERVALS))
WEIGHTS = np.random.default_rng(3).standard_normal((INTERVALS, 3))


def loss(x, around):
    """A scalar that feels every part of the history, and the history. x: noise (4,) log factors,
    correlation (2,) share and seconds, factor (3,) of the axes, std (6,) log factors of the
    start's, state (12,) added to the start, gyro, accel, network (6, 3), fix (4,): a shift, changes
    of the covariance, of the moment and of its spread."""

    def network(windows):
        ramp = jnp.linspace(0.5, 1.5, N * CLONES)[None, :, None]
        response = jnp.mean(ramp * windows.astype(jnp.float64), axis=1) @ x["network"]
        pooled = around.share * response + (1 - around.share) * jnp.tanh(x["network"].sum(0))[None]
        leap = jnp.where(jnp.max(jnp.abs(windows[:, :, :3])) > KNOCK, 50.0, 0.0)
        return Prediction(pooled + leap, -2.0 + 0.1 * pooled)

    noise = filtering.NoiseModel(
        *(jnp.array([1e-2, 1e-1, 1e-2, 1e-1]) * jnp.exp(x["noise"])),
        std_factor=tuple(x["factor"]),
        correlation=filtering.CorrelatedError(*x["correlation"]),
    )
    std = filtering.InitialStd(*(jnp.array(filtering.InitialStd()) * jnp.exp(x["std"])))
    first = start(CONFIG).mean
    moved = (
        part + change for part, change in zip(first[1:], jnp.split(x["state"], 4), strict=True)
    )
    zero_velocity = filtering.ZeroVelocity(0.01)
    ekf = filtering.Filter(CONFIG, noise, std, measurements=(zero_velocity,))
    state = filtering.initial_state(ekf, first.rotation, *moved)
    shift, larger, later, spread_of_time = x["fix"]
    fix = filtering.Fix(
        jnp.asarray(FIX.position) + shift,
        jnp.asarray(FIX.covariance) * (1 + larger),
        jnp.asarray(FIX.before_end) + later,
        jnp.asarray(FIX.time_std) + spread_of_time,
        FIX.threshold,
    )
    inputs = state, x["gyro"], x["accel"], around.valid, (fix,)
    _, history = filtering.run_odometry(network, ekf, *inputs)
    of_rows = (
        jnp.sum(WEIGHTS * history.position, axis=1)
        + jnp.sum(history.rotation[:, 0] + history.velocity, axis=1)
        + 10 * jnp.sum(history.gyro_bias + history.accel_bias, axis=1)
        + 0.01 * jnp.nan_to_num(history.nis)
        + 0.1 * jnp.nan_to_num(history.log_likelihood)
        + jnp.sum(jnp.log(history.covariance_diagonal), axis=1)
    )
    return jnp.sum(around.rows * of_rows), history


BATCH = 8
GRADIENT = quick(jax.vmap(jax.value_and_grad(loss, has_aux=True)))
"""The one program. Under the vmap, as in training, both branches of every condition are taken, and
neither may spoil the gradient of the other."""


def at(points, around=EARLY):
    """Values, histories and gradients at all of these points, what is around them the same or of
    each."""
    around = around if isinstance(around, list) else [around] * len(points)
    batches = []
    for first in range(0, len(points), BATCH):
        some = list(zip(points, around, strict=True))[first : first + BATCH]
        some += [some[-1]] * (BATCH - len(some))
        batches.append(GRADIENT(*jax.tree.map(lambda *leaves: np.stack(leaves), *some)))
    joined = jax.tree.map(lambda *parts: np.concatenate(parts)[: len(points)], *batches)
    (value, history), gradient = joined
    return value, history, gradient


def point():
    gyro, accel = recording(2)
    return dict(
        noise=np.zeros(4),
        correlation=np.array([0.6, 0.3]),
        factor=np.array([1.5, 0.7, 1.2]),
        std=np.zeros(6),
        state=np.zeros(12),
        gyro=gyro,
        accel=accel,
        network=PARAMETERS,
        fix=np.array([0.0, 0.0, 0.0, 0.1]),
    )


def assert_slopes(x, around, names, rows=slice(None), step=1e-4, rtol=1e-5):
    """Along two random directions for each of the names, every entry of the rows as far."""
    gradient = at([x], around)[2]
    rng, points, slopes = np.random.default_rng(0), [], []
    for name in 2 * names:
        direction, size = np.zeros_like(x[name]), x[name][rows].shape
        direction[rows] = rng.uniform(0.5, 1.5, size) * rng.choice([-1.0, 1.0], size)
        points += [{**x, name: x[name] + sign * step * direction} for sign in (1, -1)]
        slopes.append(np.sum(gradient[name][0] * direction))
    ahead, behind = at(points, around)[0].reshape(-1, 2).T
    expected = (ahead - behind) / (2 * step)
    np.testing.assert_allclose(slopes, expected, rtol=rtol, err_msg=str(names))
    assert (np.abs(expected) > 1e-6).all()


HOLES = (*range(5, 10), 25)
"""Of samples: a long one, whose windows are no measurements, and a short one, which is bridged."""


def test_gradient_against_differences():
    """With respect to all that a run is given, holes and fixes in it; through the windows, which
    are cut with the state, as far as differences can say. Of the correlated errors it is finite
    where they have no size."""
    x, broken = point(), EARLY._replace(valid=~np.isin(np.arange(N * INTERVALS), HOLES))
    _, history, _ = at([x], broken)
    weight, nis = history.gate_passed[0, CLONES:], history.nis[0, CLONES:]
    assert np.isnan(nis[: HALF - CLONES]).any() and (weight < 0.999).any()
    expected_weight = np.where(weight < 1, 1 / (1 + np.exp((nis - 8.0) / 2.0)), weight)
    np.testing.assert_allclose(weight, expected_weight, rtol=1e-9)
    assert (history.accepted[0, CLONES:][np.isfinite(nis)] == 1).all()
    assert_slopes(x, broken, ["noise", "correlation", "factor", "std", "state", "network", "fix"])
    present_samples = np.delete(np.arange(HALF * N), HOLES)
    assert_slopes(x, broken, ["gyro", "accel"], present_samples)
    assert_slopes(x, EARLY._replace(share=1.0), ["network"], step=1e-3, rtol=1e-3)
    _, _, without = at([x | {"correlation": np.array([0.0, 0.3])}])
    assert all(np.isfinite(leaf).all() for leaf in without.values())


def test_a_truncated_gradient_takes_the_state_for_given():
    x, samples = point(), slice(HALF * N, None)
    _, _, gradient = at([x], LATE)
    for name in ("std", "state", "fix"):
        assert not gradient[name].any(), name
    for name in ("gyro", "accel"):
        assert not gradient[name][0, : HALF * N].any()
        assert_slopes(x, LATE, [name], samples)
    assert all(gradient[name].any() for name in ("noise", "correlation", "factor", "network"))


def test_gradients_are_finite_for_hostile_input():
    """At rest every norm in the filter is at its singular point; a knock is a leap to the network;
    on the nose there is no yaw."""
    x, samples = point(), N * INTERVALS
    still = {"gyro": np.zeros((samples, 3)), "accel": np.tile([0.0, 0.0, 9.81], (samples, 1))}
    turning = {"gyro": np.tile([0.0, np.pi / (samples * DT), 0.0], (samples, 1))}
    knock = x["accel"].copy()
    knock[45] = 2 * KNOCK
    lost = np.ones(samples, bool)
    lost[30:60] = False
    points = {"rest": x | still, "rejected": x | {"accel": knock}, "lost": x, "nose": x | turning}
    around = [WHOLE._replace(valid=lost) if kind == "lost" else WHOLE for kind in points]
    value, history, gradient = at(list(points.values()), around)
    assert np.isfinite(value).all() and history.outcomes["zero_velocity"].accepted[0].any()
    assert np.nanmin(history.gate_passed[1]) < 1e-6 and np.isnan(history.nis[2, HALF:]).any()
    for name, leaf in gradient.items():
        for kind, slope in zip(points, leaf, strict=True):
            assert np.isfinite(slope).all() and np.abs(slope).max() > 0, (kind, name)


def scanned(scan, start, inputs):
    def step(carry, x):
        carry = jnp.tanh(carry @ (jnp.eye(2) + x["turn"])) + x["push"]
        return carry, {"square": carry**2, "first": carry[0]}

    carry, out = scan(step, start, inputs)
    squares = jnp.sum(jnp.arange(1.0, 14)[:, None] * out["square"])
    return jnp.sum(carry) + squares + jnp.sum(out["first"])


def cut_by_hand(every):
    def scan(step, carry, inputs):
        rows = []
        for first in range(0, 13, every):
            block = jax.tree.map(lambda x, f=first: x[f : f + every], inputs)
            carry, out = jax.lax.scan(step, carry, block)
            carry, rows = jax.lax.stop_gradient(carry), [*rows, out]
        return carry, jax.tree.map(lambda *parts: jnp.concatenate(parts), *rows)

    return scan


RANDOM = np.random.default_rng(2)
ARGUMENTS = (
    np.array([0.3, -0.2]),
    {
        "turn": 0.3 * RANDOM.standard_normal((13, 2, 2)),
        "push": 0.3 * RANDOM.standard_normal((13, 2)),
    },
)


def derivatives(scan):
    return quick(jax.value_and_grad(functools.partial(scanned, scan), (0, 1)))(*ARGUMENTS)


@functools.cache
def derivatives_by_hand(cut):
    return derivatives(cut_by_hand(cut) if cut else jax.lax.scan)


@pytest.mark.parametrize("every, cut", [(4, 0), (50, 0), (0, 5), (2, 5), (3, 20)])
def test_checkpoints_and_cuts_of_any_scan(every, cut):
    """Whole blocks or not: checkpoints change no number, and cuts none but the gradient."""
    blocked = functools.partial(blocked_scan, checkpoint_every=every, truncate_every=cut)
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12),
        derivatives(blocked),
        derivatives_by_hand(cut),
    )
    text = str(jax.make_jaxpr(jax.grad(functools.partial(scanned, blocked)))(*ARGUMENTS))
    assert ("remat" in text or "checkpoint" in text) == (0 < every < (min(cut, 13) or 13))


def test_checkpoints_bound_the_memory():
    def temporary(every):
        def value(start):
            carry, out = blocked_scan(
                lambda x, push: (jnp.tanh(x @ x) + push, x[0, 0]), start, jnp.ones(1040), every
            )
            return jnp.sum(carry) + jnp.sum(out)

        lowered = jax.jit(jax.grad(value)).lower(jnp.zeros((20, 20)))
        return lowered.compile().memory_analysis().temp_size_in_bytes

    assert temporary(32) < temporary(0) / 4
