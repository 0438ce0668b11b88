"""Segments of recordings: where they may begin, what they hold, and how wrong a start is."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.config import AugmentConfig
from gnio_jax.filtering import InitialStd
from gnio_jax.training import segments
from gnio_jax.types import Sequence

SAMPLES = 20


def sequence(length, seed=0, invalid=()):
    rng = np.random.default_rng(seed)
    draw = lambda columns: rng.standard_normal((length, columns))  # noqa: E731
    valid = np.ones(length, bool)
    valid[list(invalid)] = False
    orientation = Rotation.random(length, random_state=seed).as_quat(scalar_first=True)
    time = np.arange(length) / 50
    walk = Sequence("s", time, draw(3), draw(3), orientation, draw(3), draw(3), valid)
    lost = np.where(valid[:, None], 0.0, np.nan)
    return walk._replace(position=walk.position + lost, orientation=orientation + lost)


def test_segments_lie_in_trusted_stretches_and_cover_them_over_epochs():
    broken = sequence(150, invalid=[45, 46, 110])
    parts = [sequence(SAMPLES), broken, sequence(SAMPLES + 1, 1)]
    source = segments.segment_source(parts, SAMPLES)
    # Stretches of 45, 63 and 39 samples, one short of 20, and one that just suffices.
    assert len(source.earliest) == 2 + 3 + 1 + 0 + 1
    # A gap of the IMU is as little trusted.
    holed = sequence(150)._replace(imu_valid=broken.valid)
    alike = [segments.segment_source([part], SAMPLES) for part in (holed, broken)]
    np.testing.assert_array_equal(*(twin.earliest for twin in alike))
    np.testing.assert_array_equal(*(twin.latest for twin in alike))

    keys = jax.vmap(jax.random.key)(jnp.arange(400))
    starts = jax.vmap(segments.random_starts, in_axes=(0, None))(keys, source)
    starts = np.sort(starts, axis=1)
    valid = np.concatenate([parts[1].valid, parts[2].valid])
    for start in np.unique(starts):
        rows = np.arange(start, start + SAMPLES + 1)
        assert valid[rows].all() and (rows < 150).all() | (rows >= 150).all()
    possible = [s for s in range(171 - SAMPLES) if valid[s : s + SAMPLES + 1].all()]
    possible = [s for s in possible if not s < 150 <= s + SAMPLES]
    assert set(np.unique(starts)) == set(possible)
    # An epoch is a function of its key, and its order is not that of the rows.
    again = segments.random_starts(jax.random.key(3), source)
    np.testing.assert_array_equal(np.sort(again), starts[3])
    assert (np.asarray(again) != starts[3]).any()


def test_a_segment_holds_its_samples_and_the_truth_at_its_clones():
    whole = sequence(150, seed=2)
    source = segments.segment_source([whole], SAMPLES)
    segment = jax.jit(lambda start: segments.cut_segment(source, start, 5, 4))(jnp.int32(7))
    np.testing.assert_array_equal(segment.gyro, whole.gyro[7:27])
    np.testing.assert_array_equal(segment.accel, whole.accel[7:27])
    ends = np.arange(7, 28, 4)
    np.testing.assert_array_equal(segment.truth.velocity, whole.velocity[ends])
    np.testing.assert_array_equal(segment.truth.position, whole.position[ends])
    rotation = Rotation.from_quat(whole.orientation[ends], scalar_first=True).as_matrix()
    np.testing.assert_allclose(segment.truth.rotation, rotation, atol=1e-12)


def test_a_turn_segment_is_the_same_walk_in_a_turned_world():
    source = segments.segment_source([sequence(150, seed=2)], SAMPLES)
    segment = segments.cut_segment(source, jnp.int32(7), 5, 4)
    turned_segment = jax.jit(segments.turn_segment)(segment, jnp.float64(0.7))
    turn = Rotation.from_euler("z", 0.7).as_matrix()
    np.testing.assert_array_equal(turned_segment.gyro, segment.gyro)
    np.testing.assert_array_equal(turned_segment.accel, segment.accel)
    np.testing.assert_allclose(
        turned_segment.truth.rotation, turn @ segment.truth.rotation, atol=1e-12
    )
    for name in ("velocity", "position"):
        expected = np.asarray(getattr(segment.truth, name)) @ turn.T
        np.testing.assert_allclose(getattr(turned_segment.truth, name), expected, atol=1e-12)


def test_a_low_passed_segment_has_smaller_high_frequencies_and_the_same_truth():
    """Sines of whole periods in the segment: the filter changes only their size, in both sensors
    alike, away from the ends."""
    rate, samples = 50.0, 200
    source = segments.segment_source([sequence(samples + 1)], samples)
    sine = np.sin(2 * np.pi * 5.0 * np.arange(samples + 1)[:, None] / rate)
    source = source._replace(accel=9.81 + sine * [1.0, 2.0, 3.0], gyro=sine * [3.0, 1.0, 2.0])
    one = segments.cut_segment(source, jnp.int32(0), 10, samples // 10)
    batch = jax.tree.map(lambda leaf: jnp.stack([leaf] * 60), one)
    half = AugmentConfig(low_pass_share=0.5, low_pass_hertz=(4.0, 4.0))
    smoothed_batch = segments.low_pass_segments(jax.random.key(2), batch, half, rate)
    assert smoothed_batch.gyro.dtype == smoothed_batch.accel.dtype == np.float64
    others = (group._replace(gyro=0, accel=0) for group in (batch, smoothed_batch))
    jax.tree.map(np.testing.assert_array_equal, *others)
    one, smoothed_batch = jax.device_get((one, smoothed_batch))
    inner = slice(25, -25)
    sizes = np.einsum("bnc,nc->b", smoothed_batch.gyro[:, inner], one.gyro[inner])
    sizes = sizes / np.sum(one.gyro[inner] ** 2)
    of_orders = 1 / (1 + (5.0 / 4.0) ** (2 * np.array([0, 1, 2, 3])))
    of_orders[0] = 1.0  # not low-passed
    which = np.abs(sizes[:, None] - of_orders).argmin(axis=1)
    np.testing.assert_allclose(sizes, of_orders[which], atol=0.01)
    assert np.mean(which == 0) == pytest.approx(0.5, abs=0.2) and set(which) == {0, 1, 2, 3}
    for signal, whole in (
        (smoothed_batch.gyro, one.gyro),
        (smoothed_batch.accel - 9.81, one.accel - 9.81),
    ):
        expected = sizes[:, None, None] * whole[None, inner]
        np.testing.assert_allclose(signal[:, inner], expected, atol=0.03)
    assert segments.low_pass_segments(jax.random.key(2), batch, AugmentConfig(), rate) is batch

    ramp = np.linspace(-1.0, 1.0, samples)[:, None] * np.ones(3)  # the ends are no neighbours
    batch = batch._replace(gyro=batch.gyro * 0 + ramp[None], accel=batch.accel * 0 + 9.81)
    smoothed_batch = segments.low_pass_segments(jax.random.key(2), batch, half, rate)
    np.testing.assert_allclose(smoothed_batch.accel, 9.81, atol=1e-9)
    np.testing.assert_allclose(smoothed_batch.gyro, np.tile(ramp, (60, 1, 1)), atol=0.1)


def test_a_start_is_off_the_truth_by_the_priors_deviations():
    std = InitialStd(0.001, 0.002, 0.3, 0.4, 0.5, 0.6)
    source = segments.segment_source([sequence(40, seed=3)], SAMPLES)
    truth = segments.cut_segment(source, jnp.int32(0), 5, 4).truth
    keys = jax.random.split(jax.random.key(0), 20_000)
    draw = jax.jit(jax.vmap(lambda key: segments.draw_start(key, truth, std, 2.0)))
    rotation, velocity, position, gyro_bias, accel_bias = map(np.asarray, draw(keys))
    error = Rotation.from_matrix(rotation @ np.asarray(truth.rotation[0]).T).as_rotvec()
    np.testing.assert_allclose(error.std(0), [0.002, 0.002, 0.004], rtol=0.03)
    for samples, centre, value in (
        (velocity, truth.velocity[0], 0.3),
        (position, truth.position[0], 0.4),
        (gyro_bias, np.zeros(3), 0.5),
        (accel_bias, np.zeros(3), 0.6),
    ):
        np.testing.assert_allclose(samples.std(0), 3 * [2 * value], rtol=0.03)
        np.testing.assert_allclose(samples.mean(0), centre, atol=0.06)
