"""Measurements of the caller's own: in the filter, and as they are refused."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax import filtering
from gnio_jax.config.schema import Positive
from gnio_jax.errors import InputError
from gnio_jax.filtering import measurements
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.update import since_oldest
from tests.support.checks import unchecked
from tests.support.compiling import quick
from tests.support.random_walk import random_walk
from tests.support.whole_covariance import covariance

N, CLONES, INTERVALS, DT = 5, 4, 30, 0.02
CONFIG = filtering.FilterConfig(DT, N, CLONES, history="core", error="additive")
NOISE = filtering.NoiseModel(2e-3, 2e-2, measurement_scale=1.0)
START, GYRO, ACCEL, DISPLACEMENT, SPREAD = random_walk(
    5, n=N, clones=CLONES, intervals=INTERVALS, dt=DT, nan_rows=[9, 17]
)


class Height(NamedTuple):
    """m, above the origin of the world."""

    height: jax.Array
    std: jax.Array
    name = "height"

    def update(self, state, step):
        residual = jnp.stack([self.height - state.position[2]])
        linear = filtering.linearise(
            state, residual, self.std[None, None] ** 2, position=[[0.0, 0.0, 1.0]]
        )
        return filtering.measure(state, linear, step, threshold=10.8)


def start():
    return filtering.initial_state(filtering.Filter(CONFIG), *START)


@functools.partial(quick, static_argnames="config")
def run(state, gyro, accel, displacement, covariance, config, measurements):
    inputs = state, gyro, accel, displacement, covariance
    return filtering.run_filter(filtering.Filter(config, NOISE), *inputs, measurements=measurements)


def test_a_height_is_the_textbooks_update():
    """In the whole covariance, clones and all, for every interval; one that is 100 m off fails its
    χ² test, and a NaN is none."""
    std, state = 0.05, start()
    whole = jax.jit(covariance)
    for k in range(INTERVALS):
        rows, row = slice(N * k, N * (k + 1)), slice(k, k + 1)
        signals = GYRO[rows], ACCEL[rows], DISPLACEMENT[row], SPREAD[row]
        none = Height(np.full(1, np.nan), np.full(1, std))
        without, _ = run(state, *signals, CONFIG, (none,))
        height = np.nan if k % 3 == 0 else without.position[2] + 0.1 * np.sin(k)
        height = np.asarray(100.0 if k == 20 else height)
        state, history = run(state, *signals, CONFIG, (none._replace(height=height[None]),))
        outcome = history.outcomes["height"]
        assert outcome.present[0] == np.isfinite(height)
        assert outcome.accepted[0] == (np.isfinite(height) and k != 20)
        before = np.asarray(whole(without))
        spread, residual = before[8, 8] + std**2, height - without.position[2]
        gain = before[:, 8] / spread * float(outcome.accepted[0])
        np.testing.assert_allclose(
            whole(state), before - np.outer(gain, before[8]), rtol=1e-9, atol=1e-12
        )
        correction = gain * np.nan_to_num(residual)
        np.testing.assert_allclose(state.velocity, without.velocity + correction[3:6], atol=1e-12)
        np.testing.assert_allclose(state.position, without.position + correction[6:9], atol=1e-12)
        if outcome.present[0]:
            np.testing.assert_allclose(outcome.residual[0], [residual], atol=1e-12)
            np.testing.assert_allclose(outcome.nis[0], residual**2 / spread, rtol=1e-9)


@quick
def measured_height(state, height, threshold):
    step = filtering.Step(Imu(np.zeros((1, 3)), np.zeros((1, 3)), None), 0, 1, CONFIG, NOISE)
    residual = jnp.stack([height - state.position[2]])
    linear = filtering.linearise(state, residual, [[1.0]], position=[[0.0, 0.0, 1.0]])
    return filtering.measure(state, linear, step, threshold)[1]


def test_without_a_threshold_there_is_no_test():
    """Nor of what was not measured."""
    state = start()
    for threshold, tested in ((np.inf, False), (10.8, True)):
        for height, present in ((float(state.position[2]) + 0.01, True), (np.nan, False)):
            outcome = measured_height(state, height, threshold)
            assert bool(outcome.present) == bool(outcome.accepted) == present
            assert bool(outcome.tested) == (present and tested)


def test_rows_that_are_missing_are_refused_by_name():
    measured = (Height(np.zeros(INTERVALS - 1), np.ones(INTERVALS)),)
    with pytest.raises(ValueError, match=r"^measurements\[0\]\.height: the shape must be \(30,\)"):
        run(start(), GYRO, ACCEL, DISPLACEMENT, SPREAD, CONFIG, measured)
    with pytest.raises(ValueError, match=r"^linearise: height: is none of rotation, velocity"):
        filtering.linearise(start(), [0.0], [[1.0]], height=[[0.0, 0.0, 1.0]])


def test_shapes_that_are_none_of_a_measurement_are_refused_by_name():
    up = [[0.0, 0.0, 1.0]]
    for words, residual, spread, block in (
        (r"residual: the shape must be \(m,\), found \(\); a measurement", 0.0, [[1.0]], up),
        (r"residual: the shape must be \(m,\), found \(1, 1\); a", [[0.0]], [[1.0]], up),
        (r"covariance: the shape must be \(1, 1\), found \(1,\)", [0.0], [1.0], up),
        (r"position: the shape must be \(1, 3\), found \(3,\)", [0.0], [[1.0]], up[0]),
    ):
        with unchecked(), pytest.raises(ValueError, match=f"^linearise: {words}"):
            filtering.linearise(start(), residual, spread, position=block)


def test_rows_are_no_measurements_of_the_filter():
    """A single row, which measures the same in every interval, is one."""
    scalars, vectors = np.ones(INTERVALS), np.ones((INTERVALS, 3))
    squares = np.tile(np.eye(3), (INTERVALS, 1, 1))
    for measurement in (
        filtering.Barometer(scalars, scalars, scalars),
        filtering.Magnetometer(vectors, *4 * [scalars]),
        filtering.WheelSpeed(scalars, scalars, vectors, vectors),
        filtering.Fix(vectors, squares, *3 * [scalars]),
    ):
        name = type(measurement).__name__
        words = rf"^ekf.measurements\[0\]: {name} has rows; pass it as `measurements` of the run"
        with pytest.raises(ValueError, match=words):
            filtering.initial_state(filtering.Filter(CONFIG, measurements=(measurement,)), *START)
        row = jax.tree.map(lambda part: part[0], measurement)
        filtering.initial_state(filtering.Filter(CONFIG, measurements=(row,)), *START)


def test_a_frame_that_does_not_exist_is_refused():
    """With a word that is not known a place would be measured as if it turned with the carrier."""
    state = start()
    linear = filtering.linearise(state, np.zeros(3), np.eye(3), position=np.eye(3))
    step = filtering.Step(Imu(np.zeros((1, 3)), np.zeros((1, 3)), None), CLONES, 0, CONFIG, NOISE)
    words = r"^measure: frame must be 'carrier' or 'world', found 'World'$"
    with unchecked(), pytest.raises(ValueError, match=words):
        filtering.measure(state, linear, step, frame="World")


def test_known_displacements_are_those_of_the_filter():
    rng = np.random.default_rng(0)
    (rotation, _, _), turn = START, rng.normal(size=3)
    angles = np.arange(INTERVALS + 1)[:, None] * 0.1 * turn
    rotations = Rotation.from_rotvec(angles).as_matrix() @ rotation
    position = rng.normal(size=(INTERVALS + 1, 3))
    displacements = filtering.displacements(rotations, position, CONFIG)
    assert np.isnan(displacements[:CLONES]).all() and displacements.shape == (INTERVALS, 3)
    for k in range(CLONES, INTERVALS):
        # Clone k is taken at the end of interval k, that is at row k + 1.
        old, new = k - CLONES + 1, k + 1
        yaw = np.arctan2(rotations[old, 1, 0], rotations[old, 0, 0])
        c, s = np.cos(yaw), np.sin(yaw)
        x, y, z = position[new] - position[old]
        np.testing.assert_allclose(displacements[k], [c * x + s * y, c * y - s * x, z], atol=1e-12)
    assert np.isnan(filtering.displacements(rotations[:3], position[:3], CONFIG)).all()
    for rows in ((rotations[:0], position[:0]), (rotations[:3], position[:2])):
        with unchecked(), pytest.raises(ValueError, match=r"^rotation and position: must be \(K"):
            filtering.displacements(*rows, CONFIG)


class Ahead(NamedTuple):
    """Movement since the oldest clone along the world's x, m."""

    moved: jax.Array
    covariance: jax.Array
    name = "ahead"

    def update(self, state, step):
        block = jnp.array([[1.0, 0.0, 0.0]])
        residual = (self.moved - since_oldest(state, step.oldest)[0])[None]
        linear = filtering.linearise(
            state, residual, self.covariance[None, None], since_oldest=block
        )
        return filtering.measure(state, linear, step)


def test_a_measurement_from_the_oldest_clone_waits_until_there_is_one():
    """Without displacements: the first that is taken ends W intervals after the first clone."""
    missing = np.full((INTERVALS, 3), np.nan)
    ahead = Ahead(np.ones(INTERVALS), np.full(INTERVALS, 1e-4))
    _, history = run(start(), GYRO, ACCEL, missing, SPREAD, CONFIG, (ahead,))
    acceptance = np.asarray(history.outcomes["ahead"].accepted)
    np.testing.assert_array_equal(acceptance, np.arange(INTERVALS) >= CLONES)
    moved = np.asarray(history.position[:, 0])
    assert abs(moved[CLONES] - moved[0] - 1) < 0.2  # it was believed


def test_a_measurement_that_is_no_covariance_spoils_what_the_history_calls_healthy():
    for row, variance in ((10, -1e9), (10, np.nan)):
        spread = np.full(INTERVALS, 1e-4)
        spread[row] = variance
        ahead = Ahead(np.zeros(INTERVALS), spread)
        _, history = run(start(), GYRO, ACCEL, DISPLACEMENT, SPREAD, CONFIG, (ahead,))
        healthy = np.arange(INTERVALS) < (row if variance < 0 else INTERVALS)
        np.testing.assert_array_equal(history.healthy, healthy)
        assert bool(history.outcomes["ahead"].present[row]) == (variance < 0)


def test_measurements_have_names_of_their_own():
    height = Height(np.zeros(INTERVALS), np.ones(INTERVALS))
    ekf = filtering.Filter(CONFIG, NOISE, measurements=(filtering.ZeroVelocity(),))

    class Nameless(NamedTuple):
        height: jax.Array
        update = Height.update

    class Rest(Height):
        name = "zero_velocity"

    arguments = start(), GYRO, ACCEL, DISPLACEMENT, SPREAD
    for others, words in (
        ((height, height), r"\[1\]: the name 'height' is taken; .*class Second\(Height\)"),
        ((Nameless(height.height),), r"\[0\]: Nameless has no name; .*name = 'nameless'"),
        ((Rest(*height),), r"\[0\]: the name 'zero_velocity' is taken"),
    ):
        with unchecked(), pytest.raises(ValueError, match=f"^measurements{words}"):
            filtering.run_filter(ekf, *arguments, measurements=others)
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"^ekf\.measurements\[0\]: float has no method"),
    ):
        filtering.run_filter(filtering.Filter(CONFIG, NOISE, measurements=(0.02,)), *arguments)
    with (
        unchecked(),
        pytest.raises(ValueError, match=r"^ekf: must be a Filter, .* found FilterConfig$"),
    ):
        filtering.run_filter(CONFIG, *arguments)


def test_measurements_of_the_filter_come_before_those_of_a_run():
    """A stranger's measurement of the filter is that of a run whose every row is the same."""
    ekf = filtering.Filter(CONFIG, NOISE, measurements=(Height(2.0, 0.3),))
    signals = start(), GYRO, ACCEL, DISPLACEMENT, SPREAD
    rows = Height(np.full(INTERVALS, 2.0), np.full(INTERVALS, 0.3))
    _, expected = run(*signals, CONFIG, (rows,))
    _, history = filtering.run_filter(ekf, *signals)
    np.testing.assert_allclose(history.position, expected.position, atol=1e-12)
    smoothed = filtering.smooth(ekf, *signals)
    expected = filtering.smooth(filtering.Filter(CONFIG, NOISE), *signals, measurements=(rows,))
    np.testing.assert_allclose(smoothed.position, expected.position, atol=1e-12)
    order = []

    class Later(Ahead):
        def update(self, state, step):
            order[:] = step.before
            return super().update(state, step)

    ahead = Later(np.ones(INTERVALS), np.full(INTERVALS, 1e-2))
    _, history = filtering.run_filter(ekf, *signals, measurements=(ahead,))
    assert order == ["displacement", "height"] and history.outcomes.keys() == {"height", "ahead"}


def test_numbers_of_measurements_in_settings():
    """In their order; what cannot be is refused by name."""
    parse = functools.partial(configuration.parse, source="file.yaml")
    config = parse("filter: {measurements: {height: {std: 1}, zero_velocity: {}}}")
    filtering.register(SteadyHeight)
    try:
        ekf = filtering.make_filter(config.data, config.filter)
        assert ekf.measurements == (SteadyHeight(1.0), filtering.ZeroVelocity(0.02))
        text = configuration.to_yaml(config)
        assert parse(text) == config and text.index("height") < text.index("zero_velocity")
        changed = configuration.assign(config, ["filter.measurements.height=null"])
        changed = configuration.assign(changed, ["filter.measurements.zero_velocity.std=0.5"])
        (steady,) = filtering.make_filter(config.data, changed.filter).measurements
        assert steady == filtering.ZeroVelocity(0.5)
        other = type("Other", (SteadyHeight,), {})
        filtering.register(other)  # in the place of the first
        replaced = filtering.make_filter(config.data, config.filter).measurements
        assert [type(one) for one in replaced] == [other, filtering.ZeroVelocity]
        for numbers, words in (
            ("{heigth: {std: 1}}", "'measurements.heigth' is not known; did you mean 'height'"),
            ("{height: {}}", "'measurements.height.std' is missing; write std: NUMBER"),
            ("{height: {std: 0}}", "'measurements.height.std' must be positive and finite"),
            ("{height: {mean: 1}}", "'measurements.height.mean' is unknown; known numbers: std"),
        ):
            spoilt = parse(f"filter: {{measurements: {numbers}}}")
            with pytest.raises(InputError, match=rf"^filter: field {words}"):
                filtering.make_filter(spoilt.data, spoilt.filter)
        with pytest.raises(InputError, match=r"'filter\.measurements\.height' must be a mapping"):
            parse("filter: {measurements: {height: 1}}")
    finally:
        measurements._MEASUREMENTS.pop("height", None)
    for name, words in (
        ("zero_velocity", "is a measurement of gnio-jax"),
        (3, "is not a NamedTuple"),
    ):
        kind = type("Kind", (SteadyHeight,), {"name": name})
        with pytest.raises(InputError, match=words):
            filtering.register(kind)


class SteadyHeight(NamedTuple):
    std: Positive
    name = "height"
    update = Height.update
