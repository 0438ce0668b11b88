"""The network in the loop against windows cut by brute force."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.filtering.state import Mean
from gnio_jax.types import Prediction
from tests.support import scekf_numpy
from tests.support.odometry import DT, INTERVALS, PARAMETERS, N, recording, start

CLONES = 4
CONFIG = filtering.FilterConfig(
    DT, N, CLONES, convergence_seconds=0.6, context_samples=6, error="additive"
)
FIRST = 5
"""Interval that ends with a measurement: the first with its context."""
NOISE = filtering.NoiseModel(measurement_scale=2.0, std_factor=(1.5, 0.5, 2.0))
FACTOR = np.array(NOISE.std_factor)
ROOT_SCALE = np.sqrt(2.0) * FACTOR


BASE, SLOPE = np.full(3, -2.0, np.float32), np.float32(0.1)


def predict(windows, base=BASE, slope=SLOPE):
    """A network of one layer, whose output depends on the order of samples and channels. `base` and
    `slope` make its log standard deviation."""
    assert windows.shape[::2] == (1, 6) and windows.dtype == jnp.float32
    ramp = jnp.linspace(0.5, 1.5, windows.shape[1], dtype=jnp.float32)[None, :, None]
    pooled = jnp.mean(ramp * windows, axis=1) @ jnp.asarray(PARAMETERS, jnp.float32)
    return Prediction(
        pooled,
        base[None] + slope * pooled,
        {"gate": jnp.tanh(pooled), "attention": jnp.ones((1, 2, 3), jnp.float32)},
    )


@functools.cache
def program(config):
    """(state, gyro, accel, base, slope) -> final state and history, with the network above."""

    def run(state, gyro, accel, base, slope):
        network = functools.partial(predict, base=base, slope=slope)
        return filtering.run_odometry(network, filtering.Filter(config, NOISE), state, gyro, accel)

    return jax.jit(run)


def predict_numpy(window):
    pooled = (np.linspace(0.5, 1.5, len(window))[:, None] * window).mean(0) @ PARAMETERS
    return pooled, np.diag(FACTOR**2 * np.exp(2 * np.maximum(-2.0 + 0.1 * pooled, -4.0)))


CUTS = {"per_sample": (0, True, False), "single": (0, True, False), "tlio": (1, False, True)}
"""By how many samples windows begin early, whether they are without biases, and whether a sample is
turned by its own rate or by that of the one before."""


def by_hand(config, cut, gyro, accel):
    (lead, corrected, own_rate), context = cut, config.context_samples

    def measure(k, clone_rotation, gyro_bias, accel_bias):
        if k < config.first_measured:
            return np.full(3, np.nan), np.eye(3)
        samples = slice((k - CLONES + 1) * N - context - lead, (k + 1) * N - lead)
        rates, forces = gyro[samples] - gyro_bias, accel[samples] - accel_bias
        signals = (rates, forces) if corrected else (gyro[samples], accel[samples])
        turns = Rotation.from_rotvec(rates * DT).as_matrix()
        unyaw, R, rows = scekf_numpy.yaw_matrix(clone_rotation).T, clone_rotation, []
        for turn in turns[:context][::-1]:
            R = R @ turn.T
        for j, (w, a) in enumerate(zip(*signals, strict=True)):
            if j and config.window_rotation != "single":
                R = R @ turns[j if own_rate else j - 1]
            rows.append(np.concatenate([unyaw @ R @ a, unyaw @ R @ w]))
        return predict_numpy(np.array(rows))

    options = {"measure": measure, "frame": config.displacement_frame}
    return scekf_numpy.run_from(start(config), NOISE, config, gyro, accel, **options)


@pytest.mark.parametrize(
    "window_rotation, context, first",
    [("per_sample", 6, FIRST), ("single", 0, CLONES), ("tlio", 0, CLONES)],
)
def test_windows_are_cut_with_the_state_of_the_filter(window_rotation, context, first):
    gyro, accel = recording(0)
    config = dataclasses.replace(CONFIG, window_rotation=window_rotation, context_samples=context)
    assert config.first_measured == first
    state, history = program(config)(start(config), gyro, accel, BASE, SLOPE)
    later, _ = program(config)(state, gyro, accel, BASE, SLOPE)
    assert program(config)._cache_size() == 2  # a state that a run leaves has a window …
    program(config)(later, gyro, accel, BASE, SLOPE)
    assert program(config)._cache_size() == 2  # … and all of these share a program
    reference = by_hand(config, CUTS[window_rotation], gyro, accel)
    assert np.nansum(reference["accepted"]) > 5
    for name in ("accepted", "gate_passed"):
        np.testing.assert_array_equal(getattr(history, name), reference[name])
    for name in ("displacement", *Mean._fields, "innovation"):
        np.testing.assert_allclose(
            getattr(history, name), reference[name], atol=3e-6, err_msg=name
        )  # the network is float32
    std = ROOT_SCALE * np.exp(np.maximum(-2.0 + 0.1 * reference["displacement"], -4.0))
    np.testing.assert_allclose(history.measurement_std, std, rtol=1e-5)
    gate, attention = (np.asarray(history.diagnostics[name]) for name in ("gate", "attention"))
    np.testing.assert_allclose(gate, np.tanh(reference["displacement"]), atol=3e-6)
    assert np.isnan(attention[:first]).all() and (attention[first:] == 1).all()
    if window_rotation == "tlio":  # each of the three differences is large enough to be seen
        for cut in [(0, False, True), (1, True, True), (1, False, False)]:
            other = by_hand(config, cut, gyro, accel)["displacement"]
            assert np.nanmax(np.abs(other - reference["displacement"])) > 1e-4


@pytest.mark.parametrize("cut", [3, 11, 16])
def test_a_run_in_two_calls_is_one_run(cut):
    """The windows of the second call begin in the first, before and after there is a measurement;
    with missing samples just before the cut, and with a gap that the filter coasts through."""
    gyro, accel = recording(2)
    valid = np.ones(len(gyro), bool)
    valid[N * cut - 3 : N * cut - 1] = valid[N * 12 + 2 : N * 13 + 4] = False
    ekf = filtering.Filter(CONFIG, NOISE, measurements=(filtering.ZeroVelocity(),))

    @jax.jit
    def run(state, gyro, accel, valid):
        return filtering.run_odometry(predict, ekf, state, gyro, accel, valid)

    final, history = run(start(CONFIG), gyro, accel, valid)
    parts, state = [], start(CONFIG)
    for rows in (slice(0, N * cut), slice(N * cut, None)):
        state, part = run(state, gyro[rows], accel[rows], valid[rows])
        parts.append(part)
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    assert np.isfinite(history.nis[max(cut, FIRST) :]).any()
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), joined, history)
    np.testing.assert_allclose(state.position, final.position, atol=1e-10)
    np.testing.assert_array_equal(state.window, final.window)


def test_where_it_coasted_no_window_is_a_measurement():
    """Nor where it coasted in the context before the window."""
    config = dataclasses.replace(CONFIG, bridge_seconds=2 * DT)
    gyro, accel = recording(0)
    valid = np.ones(len(gyro), bool)
    valid[32:40] = False  # the first two of these are held
    _, history = filtering.run_odometry(
        predict, filtering.Filter(config, NOISE), start(config), gyro, accel, imu_valid=valid
    )
    measured = np.isfinite(np.asarray(history.displacement)).all(axis=1)
    for k in range(INTERVALS):
        first, stop = (k - CLONES + 1) * N - config.context_samples, (k + 1) * N
        coasted = first < 40 and stop > 34
        assert measured[k] == (k >= FIRST and not coasted), k


def test_given_its_own_measurements_the_filter_repeats_itself_and_is_smoothed():
    """With `history.unscaled_displacements`, which takes the factors of the axes off again. The
    network's log standard deviation is raised to a floor."""
    gyro, accel = recording(1)
    final, history = program(CONFIG)(start(CONFIG), gyro, accel, BASE, SLOPE)
    fixed = None, CONFIG.displacement_frame
    inputs = (
        filtering.Filter(CONFIG, NOISE),
        start(CONFIG),
        gyro,
        accel,
        *history.unscaled_displacements(NOISE),
    )
    again_final, again = filtering.run_filter(*inputs, *fixed)
    assert again.diagnostics == {}
    for original, repetition in [(history._replace(diagnostics={}), again), (final, again_final)]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), original, repetition)
    smoothed = filtering.smooth(*inputs, *fixed)
    np.testing.assert_allclose(smoothed.position[-1], final.position, atol=1e-10)
    variances = history.covariance_diagonal[-1]
    np.testing.assert_allclose(smoothed.covariance_diagonal[-1], variances, rtol=1e-6)
    assert np.abs(smoothed.position[FIRST] - history.position[FIRST]).max() > 1e-6
    sure = np.array([-9.0, -4.5, 1.0], np.float32), np.float32(0.0)
    _, history = program(CONFIG)(start(CONFIG), gyro, accel, *sure)
    floor = np.exp([-4.0, -4.0, 1.0])
    np.testing.assert_allclose(history.measurement_std[-1], ROOT_SCALE * floor, rtol=1e-12)


def test_under_a_vmap_the_network_is_asked_no_earlier_and_says_the_same():
    signals, calls = [np.stack([signal, signal]) for signal in recording(0)], []

    def counting(windows):
        jax.debug.callback(lambda: calls.append(1))
        return predict(windows)

    def run(gyro, accel):
        return filtering.run_odometry(
            counting, filtering.Filter(CONFIG, NOISE), start(CONFIG), gyro, accel
        )

    many = jax.device_get(jax.jit(jax.vmap(run))(*signals))
    jax.effects_barrier()
    # Once a step, or once a sequence, and never before there is a window.
    assert len(calls) in (INTERVALS - FIRST, 2 * (INTERVALS - FIRST))
    one = program(CONFIG)(start(CONFIG), *recording(0), BASE, SLOPE)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a[1], b, atol=3e-6), many, one)


def test_predict_is_asked_for_what_it_must_return():
    gyro, accel = recording(0)
    good = predict(jnp.zeros((1, CONFIG.input_samples, 6), jnp.float32))
    for bad in (
        (good.displacement, good.log_std),
        good._replace(displacement=good.displacement[0]),
        good._replace(log_std=jnp.zeros((1, 2))),
        good._replace(diagnostics={"gate": jnp.zeros(3)}),
    ):
        with pytest.raises(ValueError, match=r"^predict: "):
            filtering.run_odometry(
                lambda _, bad=bad: bad, filtering.Filter(CONFIG, NOISE), start(CONFIG), gyro, accel
            )
