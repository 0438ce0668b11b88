"""A network with memory in the filter's scan: its memory goes wherever the filter's state goes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering, models
from gnio_jax.filtering import Tracker
from gnio_jax.models import Network
from tests.support.compiling import quick
from tests.support.networks import SMALL, drawn

N, W, INTERVALS, DT = 10, 3, 16, 0.01
CONFIG = filtering.FilterConfig(
    dt=DT, samples_per_clone=N, clones_per_window=W, history="core", log_std_min=-2.0
)
EKF = filtering.Filter(CONFIG)
SEES_DEVICE = filtering.Filter(dataclasses.replace(CONFIG, window_rotation="body_axes"))


def filter_for(equivariance):
    return SEES_DEVICE if equivariance == "device_heading" else EKF


@functools.cache
def network(name="gru", equivariance="none"):
    model = models.create(name, **SMALL[name], equivariance=equivariance)
    variables = drawn({"batch_stats": {}, **models.variable_shapes(model, N)}, size=0.2)
    return Network.of(model, variables)


def recording(seed=0):
    rng = np.random.default_rng(seed)
    t = np.arange(N * INTERVALS) * DT
    gyro = np.sin(t[:, None] * rng.uniform(2, 5, 3) + rng.uniform(0, 6, 3))
    accel = 2 * np.cos(t[:, None] * rng.uniform(2, 9, 3)) + [0, 0, 9.81]
    return gyro, accel


def start(turn=0.0, ekf=EKF):
    turned = Rotation.from_euler("z", turn)
    rotation = turned * Rotation.from_euler("xyz", [0.1, -0.2, 1.0])
    vectors = turned.apply([[0.5, 0.0, 0.0], [3.0, -2.0, 1.0]])
    return filtering.initial_state(
        ekf, rotation.as_matrix(), *vectors, np.array([0.02, -0.01, 0.03]), np.full(3, 0.1)
    )


@functools.cache
def program(ekf=EKF, name="gru", equivariance="none"):
    predict = network(name, equivariance).predict()
    return quick(functools.partial(filtering.run_odometry, predict, ekf))


@functools.cache
def run(equivariance="none"):
    ekf = filter_for(equivariance)
    return program(ekf, equivariance=equivariance)(start(ekf=ekf), *recording())


def assert_close(result, expected, rtol=1e-5, atol=1e-5):
    jax.tree.map(
        lambda x, y: np.testing.assert_allclose(x, y, rtol=rtol, atol=atol), result, expected
    )


def test_it_measures_in_the_yaw_frame_of_the_oldest_clone():
    """What the network predicts for the whole recording at once, turned by SciPy; nothing is
    corrected, since every measurement is refused."""
    config = dataclasses.replace(CONFIG, gate_threshold=1e-9, convergence_seconds=0.0)
    config = dataclasses.replace(config, success_seconds=1e3)
    gyro, accel = recording()
    _, history = program(filtering.Filter(config))(start(), gyro, accel)
    assert not np.nanmax(history.accepted[W + 1 :])
    rotation = start().rotation
    attitudes = [Rotation.from_matrix(rotation)]
    for rate in gyro - [0.02, -0.01, 0.03]:
        attitudes.append(attitudes[-1] * Rotation.from_rotvec(rate * DT))
    yaws = np.array([np.arctan2(*attitude.as_matrix()[1::-1, 0]) for attitude in attitudes])
    to_frame = Rotation.from_euler("z", -yaws[0])
    signals = [
        np.concatenate([(to_frame * attitude).apply(x) for x in (force - 0.1, rate)])
        for attitude, force, rate in zip(attitudes, accel, gyro - [0.02, -0.01, 0.03], strict=False)
    ]
    model, (variables, constants) = network().apply.model, network().variables
    arguments = model.begin(1), jnp.asarray(signals, jnp.float32)[None], N
    _, at_once = model.apply(variables, *arguments, method="advance", **constants)
    for k in range(W, INTERVALS):
        turn = Rotation.from_euler("z", yaws[0] - yaws[(k - W + 1) * N])
        expected = turn.apply(np.array(at_once.displacement[0, k]))
        np.testing.assert_allclose(history.displacement[k], expected, atol=2e-5)
        std = np.exp(np.maximum(at_once.log_std[0, k], -2.0))
        matrix = turn.as_matrix()
        covariance = 10 * matrix @ np.diag(std**2) @ matrix.T
        np.testing.assert_allclose(history.measurement_covariance[k], covariance, rtol=2e-4)
    assert np.isnan(history.displacement[:W]).all()


def test_the_variances_of_a_network_of_ones_own_may_be_along_other_axes():
    """As those of a network on windows: all axes turn about z, so the covariance does, too. Nothing
    is corrected."""
    turn = Rotation.from_euler("z", 0.7).as_matrix()

    class AlongAxes:
        begin = network().predict().begin

        @staticmethod
        def step(*arguments):
            memory, prediction = network().predict().step(*arguments)
            return memory, prediction._replace(axes=jnp.asarray(turn[:2, 0], jnp.float32))

    config = dataclasses.replace(CONFIG, gate_threshold=1e-9, convergence_seconds=0.0)
    ekf = filtering.Filter(dataclasses.replace(config, success_seconds=1e3))
    _, plain = program(ekf)(start(), *recording())
    _, along = quick(functools.partial(filtering.run_odometry, AlongAxes(), ekf))(
        start(), *recording()
    )
    rows = plain.measurement_covariance[W + 1 :]
    assert np.abs(rows[:, 0, 0] / rows[:, 1, 1] - 1).max() > 0.01
    np.testing.assert_allclose(
        along.measurement_covariance[W + 1 :], turn @ np.array(rows) @ turn.T, rtol=1e-5, atol=1e-9
    )


@pytest.mark.parametrize("equivariance", ["none", "device_heading"])
def test_a_turned_world_turns_all_that_comes_of_it(equivariance):
    _, history = run(equivariance)
    ekf = filter_for(equivariance)
    _, turned = program(ekf, equivariance=equivariance)(start(2.0, ekf), *recording())
    turn = Rotation.from_euler("z", 2.0)
    for name in ("position", "velocity"):
        plain, other = getattr(history, name), getattr(turned, name)
        np.testing.assert_allclose(other, turn.apply(np.array(plain)), atol=2e-5)
    np.testing.assert_allclose(turned.displacement, history.displacement, atol=2e-5)
    moved = history.position[-1] - start().position
    assert np.linalg.norm(moved[:2]) > 0.1 and np.nanmin(history.accepted) == 1


def test_a_run_in_two_calls_is_one_run():
    state, history = run()
    gyro, accel = recording()
    middle = 7 * N
    program = functools.partial(filtering.run_odometry, network().predict(), EKF)
    half, first = quick(program)(start(), gyro[:middle], accel[:middle])
    end, second = quick(program)(half, gyro[middle:], accel[middle:])
    joined = jax.tree.map(lambda x, y: np.concatenate([x, y]), first, second)
    assert_close(joined, history)
    assert_close(end.memory, state.memory)
    assert int(state.memory.intervals) == INTERVALS
    # Without its memory the second half is another one.
    _, empty = quick(program)(half._replace(memory=None), gyro[middle:], accel[middle:])
    assert np.nanmax(np.abs(empty.displacement - second.displacement)) > 1e-3


def test_the_heading_of_the_device_is_seen_until_it_is_hidden():
    """The same walk with the axes of the body hidden is that of zeros in their place."""
    hidden = dataclasses.replace(CONFIG, window_rotation="hidden_axes")
    _, history = run("device_heading")
    _, other = program(filtering.Filter(hidden), equivariance="device_heading")(
        start(), *recording()
    )
    assert np.nanmax(np.abs(other.displacement - history.displacement)) > 1e-3

    class Blind:
        """The network with zeros in the place of the axes."""

        channels = 12

        def __init__(self):
            self.predict = network(equivariance="device_heading").predict()
            self.begin = self.predict.begin

        def step(self, memory, samples, attitude):
            return self.predict.step(memory, samples.at[:, 6:].set(0.0), attitude)

    blind = quick(functools.partial(filtering.run_odometry, Blind(), SEES_DEVICE))
    assert_close(other.displacement, blind(start(ekf=SEES_DEVICE), *recording())[1].displacement)


@pytest.mark.parametrize("equivariance", ["none", "four_headings", "device_heading"])
def test_the_tracker_carries_it_too(equivariance):
    end, history = run(equivariance)
    gyro, accel = recording()
    predict, ekf = network(equivariance=equivariance).predict(), filter_for(equivariance)
    tracker = Tracker(predict, ekf, start(ekf=ekf))
    poses = []
    for k, (rate, force) in enumerate(zip(gyro, accel, strict=True)):
        pose = tracker.push(k * DT, rate, force)
        poses += [pose] if pose is not None else []
    assert len(poses) == INTERVALS
    for name in ("position", "velocity", "gyro_bias", "nis"):
        rows = [getattr(pose, name) for pose in poses]
        np.testing.assert_allclose(rows, getattr(history, name), rtol=1e-4, atol=1e-5)
    state = tracker.filter_state()
    assert_close(state.memory, end.memory)
    later = Tracker(predict, ekf, state)
    assert_close(later.filter_state().memory, end.memory)


def test_a_batch_has_a_memory_for_each_of_its_sequences():
    sequences = [recording(seed) for seed in (0, 1)]
    gyro, accel = (np.stack(part) for part in zip(*sequences, strict=True))
    states = jax.tree.map(lambda x: jnp.stack([x, x]), start())
    predict = network().predict()
    many = filtering.over_sequences(functools.partial(filtering.run_odometry, predict, EKF))
    ends, histories = quick(many)(states, gyro, accel)
    for i, signals in enumerate(sequences):
        end, history = program()(start(), *signals)
        assert_close(histories.position[i], history.position)
        assert_close(jax.tree.map(lambda x, i=i: x[i], ends.memory), end.memory)


def test_an_interval_in_which_the_filter_coasts_empties_it():
    """A window after that there is a measurement again, and by then a run that knew nothing of the
    time before predicts the same."""
    gyro, accel = recording()
    valid = np.ones(len(gyro), bool)
    valid[4 * N + 2 : 6 * N + 5] = False  # more than `bridge_seconds`: intervals 5 and 6 coast
    _, history = program()(start(), gyro, accel, valid)
    measured = np.isfinite(history.displacement).all(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(measured), [3, 4, *range(6 + W, INTERVALS)])
    other = np.where((np.arange(len(gyro)) < 6 * N)[:, None], accel + np.array([3, 1, 0]), accel)
    end, _ = program()(start(), gyro, accel, valid)
    other_end, _ = program()(start(), gyro, other, valid)
    assert int(end.memory.intervals) == INTERVALS - 7
    assert np.abs(end.velocity - other_end.velocity).max() > 0.1
    # Attitude and biases differ a little, so the memories do.
    assert np.abs(end.memory.network.hidden - other_end.memory.network.hidden).max() < 0.05


def test_a_run_can_be_repeated_and_smoothed_without_the_network():
    _, history = run()
    gyro, accel = recording()
    rows = history.unscaled_displacements(EKF.noise)
    end, repeated = quick(functools.partial(filtering.run_filter, EKF, frame="own"))(
        start(), gyro, accel, *rows
    )
    np.testing.assert_allclose(repeated.position, history.position, atol=1e-9)
    assert end.memory is None  # which this run could not continue
    smoothed = quick(functools.partial(filtering.smooth, EKF, frame="own"))(
        start(), gyro, accel, *rows
    )
    np.testing.assert_allclose(smoothed.position[-1], history.position[-1], atol=1e-9)
    assert np.abs(smoothed.position[W] - history.position[W]).max() > 1e-6


def end_of_path(variables, config):
    model = network().apply.model
    predict = Network.of(model, variables).predict()
    ekf = filtering.Filter(config)
    return jnp.sum(filtering.run_odometry(predict, ekf, start(), *recording())[1].position[-1])


def test_gradients_go_through_filter_and_memory():
    """By central differences along one direction of all parameters."""
    variables = network().variables.variables
    gradient = quick(jax.grad(end_of_path), static_argnums=1)(variables, CONFIG)
    rng = np.random.default_rng(3)
    direction = jax.tree.map(
        lambda x: jnp.asarray(rng.standard_normal(x.shape), jnp.float32), variables
    )
    slope = sum(
        float(np.sum(np.float64(a) * b))
        for a, b in zip(jax.tree.leaves(gradient), jax.tree.leaves(direction), strict=True)
    )
    value = quick(end_of_path, static_argnums=1)
    step = 1e-3

    def at(distance):
        moved = jax.tree.map(lambda x, d: x + jnp.float32(distance) * d, variables, direction)
        return float(value(moved, CONFIG))

    assert slope == pytest.approx((at(step) - at(-step)) / (2 * step), rel=2e-2)
    # Of a memory that is cut, the first intervals have no part in it.
    short = dataclasses.replace(CONFIG, truncate_every=4)
    cut = quick(jax.grad(end_of_path), static_argnums=1)(variables, short)
    kernels = (tree["params"]["conv1"]["kernel"] for tree in (gradient, cut))
    assert np.abs(np.subtract(*kernels)).max() > 1e-4


def test_gradients_are_finite_where_there_is_no_measurement():
    """Before the first whole window and behind a hole; by the first bias they are those of central
    differences."""
    model, variables = network().apply.model, network().variables.variables
    gyro, accel = recording()
    valid = np.ones(len(gyro), bool)
    valid[5 * N + 2 : 7 * N + 5] = False

    def end(bias, variables):
        predict = Network.of(model, variables).predict()
        state = start()._replace(gyro_bias=bias)
        history = filtering.run_odometry(predict, EKF, state, gyro, accel, valid)[1]
        return jnp.sum(history.position[-1])

    bias = jnp.array([0.02, -0.01, 0.03])
    gradient, of_network = quick(jax.grad(end, argnums=(0, 1)))(bias, variables)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(of_network))
    # The float32 numbers of the network bound the precision of differences.
    value, step = quick(end), 1e-3 * np.array([0.6, -0.5, 0.6])
    difference = float(value(bias + step, variables) - value(bias - step, variables))
    assert 2 * float(gradient @ step) == pytest.approx(difference, rel=2e-2)


def test_a_memory_of_another_network_is_refused():
    state, _ = run()
    other = models.create("gru", width=6)
    variables = drawn({"batch_stats": {}, **models.variable_shapes(other, N)})
    predict = Network.of(other, variables).predict()
    with pytest.raises(ValueError, match=r"^state\.memory: is the memory of another network$"):
        filtering.run_odometry(predict, EKF, state, *recording())
    single = filtering.Filter(dataclasses.replace(CONFIG, window_rotation="single"))
    with pytest.raises(ValueError, match=r"^ekf\.config\.window_rotation: this network with"):
        filtering.run_odometry(network().predict(), single, start(), *recording())


@pytest.mark.parametrize(
    "equivariance, ekf, remedy",
    [
        ("none", SEES_DEVICE, "it must be 'per_sample'"),
        ("four_headings", SEES_DEVICE, "it must be 'per_sample'"),
        ("device_heading", EKF, "it must be 'body_axes' or 'hidden_axes'"),
    ],
)
def test_samples_that_a_memory_does_not_see_are_refused(equivariance, ekf, remedy):
    predict = network(equivariance=equivariance).predict()
    with pytest.raises(ValueError, match=rf"^ekf\.config\.window_rotation: .* {remedy}$"):
        filtering.run_odometry(predict, ekf, start(ekf=ekf), *recording())


class Shapeless:
    """A network with memory that predicts two axes."""

    def begin(self, dtype=float):
        return network().predict().begin(dtype)

    def step(self, memory, samples, attitude):
        after, prediction = network().predict().step(memory, samples, attitude)
        return after, prediction._replace(displacement=prediction.displacement[:2])


def test_a_prediction_of_another_shape_is_refused():
    with pytest.raises(ValueError, match=r"^predict: displacement must be"):
        filtering.run_odometry(Shapeless(), EKF, start(), *recording())
