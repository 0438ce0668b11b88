"""Networks with memory: interval by interval they predict what they predict for a whole recording,
and their frame turns with the world."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import models
from gnio_jax.config import ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.models import Network
from gnio_jax.models.memory import turned_heading
from gnio_jax.models.state_space import decimate, linear_recurrence
from gnio_jax.types import Memory
from tests.support.comparing import assert_close_in_size
from tests.support.compiling import quick
from tests.support.networks import SMALL, drawn
from tests.support.numpy_layers import softmax

N, INTERVALS, DT = 10, 30, 0.01
WITH_MEMORY = ["gru", "ronin_lstm", "ronin_tcn", "state_space"]


def network(name, **options):
    model = models.create(name, **SMALL[name], **options)
    variables = {"batch_stats": {}, **models.variable_shapes(model, N)}
    return Network.of(model, drawn(variables))


def walk(seed=0):
    """Rates, forces and attitudes of a body, each attitude by SciPy."""
    rng = np.random.default_rng(seed)
    t = np.arange(N * INTERVALS) * DT
    gyro = np.sin(t[:, None] * rng.uniform(2, 5, 3) + rng.uniform(0, 6, 3))
    accel = 3 * np.sin(t[:, None] * rng.uniform(5, 20, 3)) + [0, 0, 9.81]
    attitude = [Rotation.from_euler("xyz", [0.3, -0.2, 1.0])]
    for turn in gyro * DT:
        attitude.append(attitude[-1] * Rotation.from_rotvec(turn))
    return gyro, accel, np.stack([rotation.as_matrix() for rotation in attitude])


def whole(net, signals):
    """The network over a whole recording, (t, 6) in one frame, at once."""
    model, ready = net.apply.model, net.variables

    def run(signals):
        start = model.apply(ready.variables, 1, method="begin")
        arguments = start, signals[None], N
        return model.apply(ready.variables, *arguments, method="advance", **ready.constants)[1]

    return jax.device_get(quick(run)(jnp.asarray(signals, jnp.float32)))


def stepwise(net, gyro, accel, attitude, axes=None):
    """The same interval by interval, from the body; with its axes, e.g. those that are hidden."""
    predict = net.predict()
    step, memory, rows = quick(predict.step), predict.begin(), []
    for k in range(INTERVALS):
        samples = slice(k * N, k * N + N)
        poses = jnp.asarray(attitude[k * N : k * N + N + 1]).transpose(1, 2, 0)
        signals = np.concatenate([accel[samples], gyro[samples]], axis=1)
        if axes is not None:
            signals = np.concatenate([signals, np.tile(np.ravel(axes), (N, 1))], axis=1)
        memory, prediction = step(memory, jnp.asarray(signals), poses)
        rows.append(jax.device_get((prediction, memory.heading)))
    return memory, rows


def in_frame(gyro, accel, attitude, heading):
    to_frame = Rotation.from_euler("z", -heading).as_matrix() @ attitude[:-1]
    return np.concatenate([np.einsum("tij,tj->ti", to_frame, x) for x in (accel, gyro)], axis=1)


@pytest.mark.parametrize("name", WITH_MEMORY)
@pytest.mark.parametrize(
    "options", [{}, {"bank_size": 3, "head": "gated"}, {"equivariance": "four_headings"}]
)
def test_steps_predict_what_the_whole_recording_predicts_at_once(name, options):
    net, signals = network(name, **options), walk()
    memory, rows = stepwise(net, *signals)
    first = signals[2][0]
    at_once = whole(net, in_frame(*signals, np.arctan2(first[1, 0], first[0, 0])))
    predictions = jax.tree.map(lambda *leaves: np.stack(leaves)[None], *(row[0] for row in rows))
    jax.tree.map(lambda steps, row: assert_close_in_size(steps, row, 1e-5), predictions, at_once)
    spread = np.ptp(predictions.displacement[0], axis=0)
    assert (spread > 1e-4).all() and int(memory.intervals) == INTERVALS


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_the_first_interval_is_remembered_after_one_second(name):
    """What is predicted depends on it, and so does the memory."""
    net, (gyro, accel, attitude) = network(name), walk()
    other = accel.copy()
    other[:N] += [2.0, -1.0, 0.5]
    (_, rows), (_, changed) = (stepwise(net, gyro, x, attitude) for x in (accel, other))
    difference = np.abs(rows[11][0].displacement - changed[11][0].displacement).max()
    assert difference > 1e-7


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_windows_begin_with_an_empty_memory(name):
    net, signals = network(name), walk()
    windows = in_frame(*signals, 0.4).reshape(5, -1, 6)
    rows = jax.device_get(quick(net.apply)(net.variables, jnp.asarray(windows, jnp.float32)))
    for row, window in zip(rows.displacement, windows, strict=True):
        assert_close_in_size(row, whole(net, window).displacement[0, -1], 1e-5)


def test_the_frame_turns_with_the_attitude_that_the_filter_corrects():
    """By the yaw of the correction alone. A turn of 50° between two intervals changes no
    prediction, and the heading by 50°; so does a turn of the whole walk."""
    net, (gyro, accel, attitude) = network("gru"), walk()
    _, rows = stepwise(net, gyro, accel, attitude)
    turn = Rotation.from_euler("z", 50, degrees=True).as_matrix()
    predict, after = net.predict(), []
    step, memory = quick(predict.step), predict.begin()
    for k in range(INTERVALS):
        samples = slice(k * N, k * N + N)
        poses = attitude[k * N : k * N + N + 1]
        poses = turn @ poses if k >= 12 else poses
        signals = jnp.asarray(np.concatenate([accel[samples], gyro[samples]], axis=1))
        memory, prediction = step(memory, signals, jnp.asarray(poses).transpose(1, 2, 0))
        after.append(jax.device_get((prediction, memory.heading)))
    _, turned = stepwise(net, gyro, accel, turn @ attitude)
    for k, (plain, corrected, other) in enumerate(zip(rows, after, turned, strict=True)):
        for x in (corrected, other):
            assert_close_in_size(x[0].displacement, plain[0].displacement, 1e-5)
        before = np.append(plain[1], 0)
        np.testing.assert_allclose(np.append(other[1], 0), turn @ before, atol=1e-12)
        expected = turn @ before if k >= 12 else before
        np.testing.assert_allclose(np.append(corrected[1], 0), expected, atol=1e-12)


def test_a_corrected_tilt_turns_the_frame_of_no_walk():
    """Whatever its horizontal axis is, and so whatever the heading of the walk is; a correction of
    the yaw besides it turns the frame by this yaw."""
    attitude = Rotation.from_euler("zyx", [0.7, 0.3, -1.2])
    heading = np.array([np.cos(0.2), np.sin(0.2)])
    memory = Memory({}, jnp.asarray(heading), jnp.asarray(attitude.as_matrix()), jnp.int32(5))
    for direction in np.linspace(0, 2 * np.pi, 7):
        tilt = Rotation.from_rotvec([0.3 * np.cos(direction), 0.3 * np.sin(direction), 0.0])
        for yaw in (0.0, -0.9):
            corrected = Rotation.from_euler("z", yaw) * tilt * attitude
            turned = turned_heading(memory, jnp.asarray(corrected.as_matrix()))
            np.testing.assert_allclose(
                turned, [np.cos(0.2 + yaw), np.sin(0.2 + yaw)], atol=1e-12, err_msg=str(direction)
            )


def test_a_memory_has_gradients_at_its_beginning():
    """Where its heading is not yet defined."""
    net, (gyro, accel, attitude) = network("gru"), walk()
    predict, samples = net.predict(), np.concatenate([accel[:N], gyro[:N]], axis=1)

    def loss(samples, attitude):
        return jnp.sum(predict.step(predict.begin(), samples, attitude)[1].displacement)

    poses = jnp.asarray(attitude[: N + 1]).transpose(1, 2, 0)
    gradients = quick(jax.grad(loss, argnums=(0, 1)))(jnp.asarray(samples), poses)
    assert all(np.isfinite(x).all() and np.abs(x).max() > 0 for x in jax.device_get(gradients))


def test_intervals_that_do_not_fit_the_strides_are_refused():
    model = models.create("gru")
    variables = models.variable_shapes(model, N)
    for every in (15, 20):
        with pytest.raises(ValueError, match=r"^intervals must be multiples of 10 samples, found"):
            model.apply(
                drawn(variables), model.begin(1), jnp.zeros((1, 30, 6)), every, method="advance"
            )


def about_z(degrees):
    return Rotation.from_euler("z", degrees, degrees=True).as_matrix()


def bins_turned_back(shares, degrees):
    """Shares of symmetric bins, (..., 3, n), of a window that was turned by quarter turns."""
    (x, y, z), back = np.moveaxis(shares, -2, 0), np.round(about_z(-degrees)[:2, :2])
    turned = []
    for row in back:  # one entry of a row is 1 or −1
        axis = (x, y)[int(np.flatnonzero(row)[0])]
        turned.append(axis if row.sum() > 0 else np.flip(axis, -1))
    return np.stack([*turned, z], axis=-2)


@pytest.mark.parametrize(
    "name, options", [*((name, {}) for name in WITH_MEMORY), ("gru", {"head": "bins"})]
)
def test_four_memories_are_the_mean_over_four_headings(name, options):
    """Against one memory after the other, on two walks in one batch. Each has its heading."""
    one, four = network(name, **options), network(name, **options, equivariance="four_headings")
    walks = [np.float32(in_frame(*walk(seed), 0.0)) for seed in (0, 1)]
    means, variances, at_zero = [], [], []
    for signals in walks:
        at_zero.append(whole(one, signals).diagnostics)
        displacements, covariances, shares = [], [], []
        for degrees in (0, 90, 180, 270):
            turn = about_z(degrees)
            turned = np.einsum("ij,tkj->tki", turn, signals.reshape(-1, 2, 3)).reshape(-1, 6)
            prediction = whole(one, turned)
            displacements.append(prediction.displacement[0] @ turn)
            squares = np.exp(2 * np.float64(prediction.log_std[0]))[..., None] * np.eye(3)
            covariances.append(np.diagonal(turn.T @ squares @ turn, axis1=1, axis2=2))
            if options:
                logits = np.float64(prediction.diagnostics["bin_logits"])
                shares.append(bins_turned_back(softmax(logits), degrees))
        if options:  # the mean of the distributions, with the mean of the displacements
            at_zero[-1]["bin_logits"] = np.log(np.mean(shares, axis=0))
        means.append(np.mean(displacements, axis=0))
        variances.append(np.mean(covariances, axis=0))
    model, ready = four.apply.model, four.variables

    def run(signals):
        start = model.apply(ready.variables, 2, method="begin")
        return model.apply(ready.variables, start, signals, N, method="advance")[1]

    prediction = jax.device_get(quick(run)(jnp.asarray(np.stack(walks))))
    assert_close_in_size(prediction.displacement, means, 2e-6)
    np.testing.assert_allclose(np.exp(2 * prediction.log_std), variances, rtol=1e-4)
    for row, diagnostics in enumerate(at_zero):
        for name, value in diagnostics.items():
            np.testing.assert_allclose(
                prediction.diagnostics[name][row], value[0], rtol=1e-3, atol=1e-3
            )


def test_an_error_that_is_constant_in_the_frame_of_the_memory_cancels_at_four_headings():
    """An output that is off by the same vector everywhere, e.g. by the bias of the last layer."""
    signals = in_frame(*walk(), 0.0)
    for equivariance, share in (("none", 1.0), ("four_headings", 0.0)):
        net = network("gru", equivariance=equivariance)
        params = dict(net.variables.variables["params"])
        layer = params["head"]["displacement"]
        error = np.float32([0.3, -0.2, 0.1])
        off = {**layer, "bias": layer["bias"] + error}
        params["head"] = {**params["head"], "displacement": off}
        variables = {**net.variables.variables, "params": params}
        shifted = net._replace(variables=net.variables._replace(variables=variables))
        change = whole(shifted, signals).displacement - whole(net, signals).displacement
        expected = np.broadcast_to(error * [share, share, 1.0], change.shape)
        np.testing.assert_allclose(change, expected, atol=1e-5)


def test_training_has_one_of_four_memories():
    """The steps of a segment go on from the memory of the heading that was seen."""
    model = models.create("gru", **SMALL["gru"], equivariance="four_headings")
    plain = models.create("gru", **SMALL["gru"])
    variables = drawn({"batch_stats": {}, **models.variable_shapes(plain, N)})
    signals = jnp.asarray(np.float32(in_frame(*walk(), 0.0)))[None]
    middle = N * INTERVALS // 2
    rows = []
    for network_in_training in (plain, model):
        state = network_in_training.begin(1)
        for part in (signals[:, :middle], signals[:, middle:]):
            arguments = state, part, N, True
            state, prediction = network_in_training.apply(variables, *arguments, method="advance")
        rows.append(prediction)
    jax.tree.map(np.testing.assert_array_equal, *rows)


@pytest.mark.parametrize("name", WITH_MEMORY)
def test_the_heading_of_the_device_is_seen_beside_the_samples(name):
    """Against four memories of a network of nine channels, whose last three are made here: the
    direction of the device's x axis along the ground, and 1, while its screen faces up. The walk
    turns the screen away for a part of the time."""
    gyro, accel, attitude = walk()
    faces_up = attitude[:-1, 2, 2] > np.cos(np.radians(30))
    assert faces_up.any() and not faces_up.all()
    signals = in_frame(gyro, accel, attitude, heading := np.arctan2(*attitude[0, 1::-1, 0]))
    x_axis = (about_z(-np.degrees(heading)) @ attitude[:-1])[:, :2, 0]
    length = np.linalg.norm(x_axis, axis=1, keepdims=True)
    channels = faces_up[:, None] * np.c_[x_axis / length, np.ones(len(length))]
    net = network(name, equivariance="device_heading", largest_tilt=30.0)
    nine = models.create(name, **SMALL[name], equivariance="four_headings")
    nine = nine.clone(network=nine.network.clone(inputs=9))
    expected = whole(Network.of(nine, net.variables.variables), np.c_[signals, channels])
    hidden = whole(Network.of(nine, net.variables.variables), np.c_[signals, 0 * channels])
    _, rows = stepwise(net, gyro, accel, attitude, np.eye(2, 3))
    _, without = stepwise(net, gyro, accel, attitude, np.zeros((2, 3)))
    for k in range(INTERVALS):
        for prediction, whole_prediction in ((rows, expected), (without, hidden)):
            assert_close_in_size(
                prediction[k][0].displacement, whole_prediction.displacement[0, k], 1e-5
            )
    assert np.abs(expected.displacement - hidden.displacement).max() > 1e-3
    turned = stepwise(net, gyro, accel, about_z(115) @ attitude, np.eye(2, 3))[1]
    for plain, other in zip(rows, turned, strict=True):
        assert_close_in_size(other[0].displacement, plain[0].displacement, 1e-5)


def test_a_device_on_its_edge_has_finite_gradients():
    """Its x axis is vertical, so it has no direction along the ground; nor have hidden axes."""
    net = network("gru", equivariance="device_heading")
    model, (variables, constants) = net.apply.model, net.variables
    for axes in (np.float32([0, 0, 1, 0, 1, 0]), np.zeros(6, np.float32)):

        def moved(axes):
            signals = jnp.concatenate([jnp.ones((1, N, 6)), jnp.tile(axes, (1, N, 1))], axis=2)
            arguments = model.begin(1), signals, N
            prediction = model.apply(variables, *arguments, method="advance", **constants)[1]
            return prediction.displacement.sum()

        assert np.isfinite(jax.grad(moved)(jnp.asarray(axes))).all()


def test_other_equivariance_around_a_memory_is_refused():
    problem = "turns with the world already, by its memory's frame; known with it: none, four_head"
    for equivariance in ("canonical_frame", "o2_frame"):
        with pytest.raises(InputError, match=problem):
            models.create("gru", equivariance=equivariance)
    with pytest.raises(InputError, match="output_dim must be 3 with the head gated, found 2"):
        models.create("ronin_lstm", head="gated", output_dim=2)


@pytest.mark.parametrize(
    "section, equivariance, rotation, problem",
    [
        ("data", "none", "single", "is single, and gru rotates every sample with its own attitude"),
        ("filter", "none", "tlio", "is tlio, and gru rotates every sample with its own attitude"),
        ("data", "four_headings", "body_axes", "is body_axes, which gru does not see"),
        ("data", "device_heading", "per_sample", "must be body_axes or hidden_axes: gru"),
    ],
)
def test_windows_that_a_memory_does_not_see_are_refused(section, equivariance, rotation, problem):
    config = TrainConfig(model=ModelConfig("gru", equivariance=equivariance))
    settings = dataclasses.replace(getattr(config, section), window_rotation=rotation)
    config = dataclasses.replace(config, **{section: settings})
    with pytest.raises(InputError, match=rf"{section}.window_rotation.* {problem}"):
        models.from_experiment(config)


def test_a_network_of_two_axes_has_no_vertical():
    net = network("ronin_tcn", output_dim=2)
    displacement = whole(net, in_frame(*walk(), 0.0)).displacement
    assert not displacement[..., 2].any() and displacement[..., :2].all()


def test_a_linear_recurrence_is_its_loop():
    rng = np.random.default_rng(1)
    factor = 0.9 * np.exp(1j * rng.uniform(0, 3, 4))
    inputs = rng.standard_normal((2, 13, 4)) + 1j * rng.standard_normal((2, 13, 4))
    x = start = rng.standard_normal((2, 4)) + 1j * rng.standard_normal((2, 4))
    rows = []
    for k in range(13):
        x = factor * x + inputs[:, k]
        rows.append(x)
    pairs = [
        (jnp.asarray(z.real), jnp.asarray(z.imag)) for z in (factor[None, None], inputs, start)
    ]
    real, imaginary = quick(linear_recurrence)(*pairs)
    np.testing.assert_allclose(real + 1j * imaginary, np.stack(rows, axis=1), rtol=1e-12)


def test_a_decimated_signal_does_not_alias():
    """What is above half the new rate is weaker by 30 dB and more, and a constant stays."""
    factor, rate = 5, 100.0
    t = np.arange(400) / rate
    for hertz, largest in ((10.0, 1e-3), (13.0, 0.03), (17.0, 0.03), (30.0, 0.03)):
        signal = jnp.asarray(np.repeat(np.sin(2 * np.pi * hertz * t)[None, :, None], 6, 2))
        past, rows = decimate(jnp.zeros((1, 3 * factor, 6)), signal, factor)
        assert rows.shape == (1, 80, 6) and np.abs(rows[:, 4:]).max() < largest, hertz
        np.testing.assert_array_equal(past, signal[:, -3 * factor :])
    _, rows = decimate(jnp.ones((1, 3 * factor, 6)), jnp.ones((1, 20, 6)), factor)
    np.testing.assert_allclose(rows, 1.0, rtol=1e-6)
