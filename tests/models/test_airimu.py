"""AirIMU: the corrector against plain NumPy, its preintegration against small steps and finite
differences, and its loss."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.config import LossConfig
from gnio_jax.errors import InputError
from gnio_jax.models import airimu
from gnio_jax.training.losses import loss_stage, losses
from gnio_jax.types import Prediction, Windows
from tests.support.compiling import quick
from tests.support.networks import drawn
from tests.support.numpy_layers import batch_norm, conv, float64, gelu, linear, recurrence

RNG = np.random.default_rng(5)


def test_corrections_against_numpy():
    """One output holds for nine samples, and nothing is added to the first nine."""
    imu = RNG.standard_normal((1, 31, 6)).astype(np.float32)
    network = airimu.AirIMU(width=4)
    shapes = jax.eval_shape(network.init, jax.random.key(0), jnp.asarray(imu))
    variables = drawn(shapes)
    (q, s), x = float64(variables), imu[0].astype(float)
    for k in "12":
        x = conv(x, q["encoder"][f"filter{k}"]["kernel"], 3, 3) + q["encoder"][f"filter{k}"]["bias"]
        x = gelu(batch_norm(x, q["encoder"][f"norm{k}"], s["encoder"][f"norm{k}"]))
    x, _ = recurrence(x, q["gru1"], "gru")
    x, _ = recurrence(x, q["gru2"], "gru")
    head = {
        name: linear(gelu(linear(x, q[name]["fc1"])), q[name]["fc2"])
        for name in q
        if "_" in name or name in ("accel", "gyro")
    }
    correction = np.hstack([0.1 * head["accel"], np.pi / 180 * head["gyro"]])
    variance = np.exp(np.hstack([head["accel_log_variance"], head["gyro_log_variance"]]) - 5)
    output = jax.device_get(quick(network.apply)(variables, jnp.asarray(imu)))
    rows = np.arange(31) // 9
    expected = np.where(np.arange(31)[:, None] < 9, 0, correction[rows])
    np.testing.assert_allclose(output.imu[0], expected, atol=1e-5)
    np.testing.assert_allclose(output.variance[0], variance[rows], rtol=1e-4)


def start(dtype=float):
    turn = Rotation.from_rotvec([0.3, -0.2, 1.0]).as_matrix()
    velocity, position = np.array([0.5, 0.2, -0.1]), np.array([1.0, 2.0, 3.0])
    return airimu.Motion(*map(jnp.asarray, (turn, velocity, position, np.zeros((9, 9)))))


def stepped(imu, dt, parts=50):
    """The same motion in steps of dt/parts, by SciPy's rotations."""
    turn = Rotation.from_matrix(start().rotation)
    velocity, position = np.asarray(start().velocity), np.asarray(start().position)
    for accel, gyro in zip(imu[:, :3], imu[:, 3:], strict=True):
        force = turn.apply(accel) - [0, 0, 9.81]
        position = position + velocity * dt + force * dt**2 / 2
        velocity = velocity + force * dt
        for _ in range(parts):
            turn = turn * Rotation.from_rotvec(gyro * dt / parts)
    return turn, velocity, position


def test_preintegration_and_its_covariance_against_small_steps_and_differences():
    count, dt = 12, 0.02
    imu = RNG.normal([0, 0, 9.8, 0, 0, 0], [1, 1, 1, 2, 2, 2], (count, 6))
    std = RNG.uniform(0.1, 0.5, (count, 6))
    path = quick(lambda imu, v: airimu.preintegrate(start(), imu, v, dt))(imu, std**2)
    turn, velocity, position = stepped(imu, dt)
    np.testing.assert_allclose(path.rotation[-1], turn.as_matrix(), atol=1e-9)
    np.testing.assert_allclose(path.velocity[-1], velocity, atol=1e-9)
    np.testing.assert_allclose(path.position[-1], position, atol=1e-9)
    columns, step = [], 1e-6
    for k in range(count):
        for channel in range(6):
            sides = []
            for sign in (1, -1):
                other = imu.copy()
                other[k, channel] += sign * step
                moved, v, p = stepped(other, dt, 1)
                sides.append(np.concatenate([(turn.inv() * moved).as_rotvec(), v, p]))
            columns.append((sides[0] - sides[1]) / (2 * step) * std[k, channel])
    covariance = np.array(columns).T @ np.array(columns)
    np.testing.assert_allclose(path.covariance[-1], covariance, rtol=1e-4, atol=1e-9)


def windows_of(imu, dt):
    """A window of the motion of `stepped`, with the true axes and steps."""
    path = airimu.preintegrate(start(), jnp.asarray(imu), jnp.ones_like(imu), dt)
    rotation = np.concatenate([[start().rotation], path.rotation[:-1]])
    position = np.concatenate([[start().position], path.position])
    vectors = np.einsum("nij,nkj->nki", rotation, imu.reshape(-1, 2, 3)).reshape(-1, 6)
    axes = rotation[..., :2].swapaxes(1, 2).reshape(-1, 6)
    whole = np.concatenate([vectors, axes], axis=1)[None]
    steps = np.diff(position, axis=0)[None]
    return Windows(jnp.float32(whole), jnp.float32(steps.sum(1)), jnp.float32(steps))


@pytest.mark.parametrize("samples", [62, 40])
def test_the_loss_is_small_for_true_samples_and_has_a_gradient_for_every_parameter(samples):
    """A window of 40 samples is too short for the published target, and its last one is the
    target."""
    dt = 0.01
    smooth = np.cumsum(RNG.normal(0, 0.05, (samples, 6)), axis=0)
    smooth[:, 2] += 9.8
    windows = windows_of(smooth, dt)
    model = models.create("ionet", width=3, corrector="airimu")
    variables = drawn(models.variable_shapes(model, samples))
    config = LossConfig(mse_weight=0.0, nll_weight=0.0, preintegration_weight=1.0)

    def loss(params, shift=None):
        prediction = model.apply({**variables, "params": params}, windows.imu)
        if shift is not None:  # in the place of the corrector's
            corrected = jnp.float32(smooth[None] + shift)
            prediction = prediction._replace(
                diagnostics={**prediction.diagnostics, "corrected": corrected}
            )
        stage = loss_stage(config, 0, 1)
        return losses(prediction, windows, config, stage, 2, dt).total

    true, wrong = (float(quick(lambda p, s=s: loss(p, s))(variables["params"])) for s in (0, 0.3))
    assert wrong > 10 * abs(true)
    gradient = quick(jax.grad(loss))(variables["params"])
    for path, leaf in jax.tree.leaves_with_path(gradient["corrector"]):
        assert np.isfinite(leaf).all() and np.abs(leaf).max() > 1e-9, path


def test_a_corrector_learns_from_the_preintegration_alone():
    """The network's losses change no gradient of the corrector and have one for the network, and
    without the preintegration the corrector would never learn."""
    dt, samples = 0.01, 40
    windows = windows_of(np.cumsum(RNG.normal(0, 0.05, (samples, 6)), axis=0), dt)
    model = models.create("ionet", width=3, corrector="airimu")
    variables = drawn(models.variable_shapes(model, samples))

    def gradient(config):
        stage = loss_stage(config, 0, 1)

        def loss(params):
            prediction = model.apply({**variables, "params": params}, windows.imu)
            return losses(prediction, windows, config, stage, 2, dt).total

        return quick(jax.grad(loss))(variables["params"])

    alone, joint_gradient = (
        gradient(LossConfig(mse_weight=weight, nll_weight=0.0, preintegration_weight=1.0))
        for weight in (0.0, 1.0)
    )
    for path, leaf in jax.tree.leaves_with_path(alone["corrector"]):
        other = functools.reduce(lambda tree, key: tree[key.key], path, joint_gradient["corrector"])
        np.testing.assert_allclose(leaf, other, rtol=1e-5, atol=1e-7 * np.abs(leaf).max())
    of_network = [
        max(
            np.abs(leaf).max()
            for name in tree
            if name != "corrector"
            for leaf in jax.tree.leaves(tree[name])
        )
        for tree in (joint_gradient, alone)
    ]
    assert of_network[0] > 1e-3 and of_network[1] == 0
    with pytest.raises(InputError, match="is 0, and a corrector learns from the preintegration"):
        gradient(LossConfig(mse_weight=1.0))


def test_the_loss_needs_a_target():
    config = LossConfig(preintegration_weight=1.0)
    stage = loss_stage(config, 0, 1)
    resting_imu = np.tile([0, 0, 9.81, 0, 0, 0], (10, 1))
    samples = {"corrected": jnp.zeros((1, 10, 6)), "corrected_variance": jnp.ones((1, 10, 6))}
    prediction = Prediction(jnp.zeros((1, 3)), jnp.zeros((1, 3)), samples)
    with pytest.raises(InputError, match="at least 11 samples, and these have 10; raise"):
        losses(prediction, windows_of(resting_imu, 0.01), config, stage)


def test_the_network_sees_the_corrected_samples_in_its_frame():
    model, plain = (models.create("ionet", width=3, corrector=c) for c in ("airimu", "none"))
    variables = drawn(models.variable_shapes(model, 20))
    smooth = np.cumsum(RNG.normal(0, 0.05, (20, 6)), axis=0)
    windows = windows_of(smooth, 0.01)
    prediction = jax.device_get(quick(model.apply)(variables, windows.imu))
    axes = np.asarray(windows.imu[0, :, 6:]).reshape(-1, 2, 3)
    axes = np.stack([axes[:, 0], axes[:, 1], np.cross(axes[:, 0], axes[:, 1])], axis=2)
    body = prediction.diagnostics["corrected"][0].reshape(-1, 2, 3)
    corrected_windows = np.float32(np.einsum("nij,nkj->nki", axes, body).reshape(1, -1, 6))
    inner = {
        kind: {k: v for k, v in tree.items() if k != "corrector"}
        for kind, tree in variables.items()
    }
    plain_prediction = quick(plain.apply)(inner, jnp.asarray(corrected_windows))
    np.testing.assert_allclose(prediction.displacement, plain_prediction.displacement, atol=1e-5)
    # So does the filter, with the variances.
    parts = {kind: tree["corrector"] for kind, tree in variables.items()}
    accel, gyro, variance = airimu.Corrector(parts).correct(smooth[:, :3], smooth[:, 3:])
    np.testing.assert_allclose(np.hstack([accel, gyro]), body.reshape(-1, 6), atol=1e-4)
    of_windows = prediction.diagnostics["corrected_variance"][0]
    np.testing.assert_allclose(variance, of_windows, rtol=1e-3)


def test_block_by_block_a_corrector_adds_what_it_adds_to_the_whole_recording():
    network, samples = airimu.AirIMU(), 66
    windows = jax.ShapeDtypeStruct((1, samples, 6), jnp.float32)
    shapes = jax.eval_shape(network.init, jax.random.key(0), windows)
    corrector = airimu.Corrector(drawn(dict(shapes)))
    imu = np.cumsum(RNG.normal(0, 0.1, (samples, 6)), axis=0)
    accel, gyro, variance = corrector.correct(imu[:, :3], imu[:, 3:])
    added = np.hstack([accel, gyro]) - imu
    assert np.abs(added[9:]).max() > 1e-3 and not added[:9].any()
    memory, padded = corrector.begin(), np.concatenate([np.zeros((corrector.before, 6)), imu])
    for first in range(0, samples - corrector.after, corrector.block):
        width = corrector.before + 1 + corrector.after
        memory, of_block, spread = corrector.step(memory, padded[first : first + width])
        rows = slice(first, first + corrector.block)
        np.testing.assert_allclose(of_block, added[rows], atol=2e-6)
        np.testing.assert_allclose(spread, variance[rows], rtol=1e-4)


def test_a_block_begins_at_the_middle_of_the_25_samples_that_its_output_sees():
    """Sample m is within 12 of the first sample of a block, or it changes a later block only."""
    model = airimu.AirIMU(width=4)
    samples = RNG.standard_normal((1, 60, 6)).astype(np.float32)
    initialise = functools.partial(model.init, jax.random.key(0))
    apply = quick(model.apply)
    variables = drawn({"batch_stats": {}, **jax.eval_shape(initialise, samples)})
    before = np.asarray(apply(variables, samples).imu[0])
    for m in (29, 30, 31, 39, 40):
        moved = samples.copy()
        moved[0, m] += 1.0
        changed = np.abs(np.asarray(apply(variables, moved).imu[0]) - before).max(axis=1) > 1e-7
        assert int(np.argmax(changed)) == 9 * -(-(m - 12) // 9)


def test_a_corrector_is_refused_where_it_cannot_be():
    with pytest.raises(InputError, match="a corrector needs windows"):
        models.create("gru", corrector="airimu")
    with pytest.raises(InputError, match="'corrector' must be one of none, airimu"):
        models.create("gnio", corrector="airmiu")
