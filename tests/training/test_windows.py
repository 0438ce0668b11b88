"""The gather against a brute-force window cutter that goes sample by sample with SciPy."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal, stats
from scipy.spatial.transform import Rotation

from gnio_jax.config import AugmentConfig, DataConfig
from gnio_jax.errors import InputError
from gnio_jax.training import windows
from gnio_jax.types import Sequence, Windows

KEY = jax.random.key(3)
CONFIG = DataConfig(rate=20.0, window_seconds=1.0, stride_seconds=0.1)

# One program each, in place of one for every operation.
gather = jax.jit(windows.gather, static_argnums=(2, 3))
shift_windows = jax.jit(windows.shift_windows, static_argnums=3)
augment = jax.jit(windows.augment, static_argnums=2)
low_pass = jax.jit(windows.low_pass, static_argnums=(2, 3))
OFF = AugmentConfig(gyro_bias=0.0, accel_bias=0.0, tilt_degrees=0.0, yaw=False)


def tumbling(count, seed, invalid=()):
    rng = np.random.default_rng(seed)
    valid = np.ones(count, bool)
    valid[list(invalid)] = False
    # Far away: float32 positions would lose millimetres.
    position = np.cumsum(rng.standard_normal((count, 3)), axis=0) + 1e4
    return Sequence(
        name=f"s{seed}",
        time=np.arange(count) / 20.0,
        gyro=rng.standard_normal((count, 3)),
        accel=rng.standard_normal((count, 3)),
        orientation=Rotation.random(count, random_state=seed).as_quat(scalar_first=True),
        position=position,
        velocity=rng.standard_normal((count, 3)),
        valid=valid,
    )


def cut(sequences, rotation, stride, context=0):
    imu, target, steps = [], [], []
    for s in sequences:
        attitude = Rotation.from_quat(s.orientation, scalar_first=True)
        for i in range(0, len(s.time), stride):
            end, after_context = i + context + 20, i + context
            if end >= len(s.time) or not all(s.valid[j] for j in range(i, end + 1)):
                continue
            heading = attitude[after_context].as_matrix()[:2, 0]
            back = Rotation.from_euler("z", -np.arctan2(heading[1], heading[0]))
            rows = []
            for j in range(i, end):
                turn = back * attitude[j if rotation == "per_sample" else after_context]
                rows.append(np.concatenate([turn.apply(s.accel[j]), turn.apply(s.gyro[j])]))
            imu.append(rows)
            target.append(back.apply(s.position[end] - s.position[after_context]))
            steps.append([back.apply(s.position[j + 1] - s.position[j]) for j in range(i, end)])
    return np.array(imu), np.array(target), np.array(steps)


@pytest.mark.parametrize(
    "rotation, stride, context", [("single", 2, 0), ("per_sample", 1, 0), ("per_sample", 2, 6)]
)
def test_gather_against_a_brute_force_cutter(rotation, stride, context):
    sequences = [tumbling(57, 1), tumbling(61, 2, invalid=[0, 33])]
    sequences += [tumbling(15, 3), tumbling(21, 4), tumbling(20, 5)]
    config = DataConfig(rate=20.0, window_rotation=rotation, context_seconds=context / 20)
    source = windows.window_source(sequences, config, stride)
    imu, target, steps = cut(sequences, rotation, stride, context)
    assert source.start.shape == (len(target),)
    order = np.random.default_rng(0).permutation(len(target)).astype(np.int32)
    selection = gather(jax.device_put(source), order, config.input_samples)
    np.testing.assert_allclose(selection.imu, imu[order], atol=1e-5)
    np.testing.assert_allclose(selection.displacement, target[order], atol=1e-5)
    np.testing.assert_allclose(selection.steps, steps[order], atol=1e-5)
    assert (
        selection.imu.dtype == selection.displacement.dtype == selection.steps.dtype == jnp.float32
    )
    np.testing.assert_array_equal(source.visited, np.arange(len(target)))


def test_shifted_windows_are_those_of_the_neighbouring_samples_in_the_same_recording():
    sequences = [tumbling(57, 1), tumbling(61, 2, invalid=[33]), tumbling(31, 3)]
    source = windows.window_source(sequences, CONFIG, 4, shift=3)
    plain = windows.window_source(sequences, CONFIG, 4)
    np.testing.assert_array_equal(source.start[source.visited], plain.start)
    which, start = np.tile(source.visited, 200), np.asarray(source.start)
    source, which = jax.device_put((source, which))
    neighbours = np.asarray(shift_windows(KEY, source, which, 3))
    moved = start[neighbours] - start[which]
    assert set(moved) == set(range(-3, 4))
    recording = np.searchsorted([57, 118], start, side="right")
    np.testing.assert_array_equal(recording[neighbours], recording[which])
    # The first window of all cannot begin earlier: 3 of 7 draws leave it where it is.
    first = which == 0
    assert moved[first].min() == 0 and np.mean(moved[first] == 0) == pytest.approx(4 / 7, abs=0.12)
    np.testing.assert_array_equal(windows.shift_windows(KEY, source, which, 0), which)


def test_windows_have_a_pose_after_them_and_lie_across_no_gap():
    with pytest.raises(InputError, match="no window of 1 s"):
        windows.window_source([tumbling(20, 0)], CONFIG, 2)
    assert windows.window_source([tumbling(21, 0)], CONFIG, 2).start.shape == (1,)
    imu_valid = np.ones(60, bool)
    imu_valid[[0, 33]] = False  # of the IMU: the reference sees through it
    source = windows.window_source([tumbling(60, 0)._replace(imu_valid=imu_valid)], CONFIG, 1)
    starts = [i for i in range(40) if imu_valid[i : i + 20].all()]
    np.testing.assert_array_equal(source.start, starts)
    # Samples without a reference may hold NaN.
    sequence = tumbling(60, 0, invalid=range(25, 30))
    for field in (sequence.orientation, sequence.position):
        field[25:30] = np.nan
    source = windows.window_source([sequence], CONFIG, 2)
    which = np.arange(source.start.shape[0], dtype=np.int32)
    selection = gather(jax.device_put(source), which, 20)
    assert all(np.isfinite(field).all() for field in selection)


def batch(count=4000, length=5):
    rng = np.random.default_rng(7)
    draw = lambda *shape: rng.standard_normal(shape).astype(np.float32)  # noqa: E731
    return Windows(draw(count, length, 6), draw(count, 3), draw(count, length, 3))


def augmented(before, **options):
    """With these changes alone."""
    return jax.device_get(augment(KEY, before, dataclasses.replace(OFF, **options)))


def test_bias_and_scale_are_uniform_over_windows_and_noise_has_its_deviation():
    """A bias is constant in a window, a scale common to the axes of a sensor; the target is
    spared."""
    before = batch()
    biased = augmented(before, gyro_bias=0.05, accel_bias=0.2)
    offset = np.asarray(biased.imu - before.imu)
    np.testing.assert_allclose(offset, np.broadcast_to(offset[:, :1], offset.shape), atol=1e-6)
    scaled = augmented(before, scale=(0.01, 0.03))
    for sensor, most, largest in [(slice(0, 3), 0.2, 0.03), (slice(3, 6), 0.05, 0.01)]:
        drawn = offset[:, 0, sensor]
        assert np.abs(drawn).max() <= most + 1e-6
        np.testing.assert_allclose(drawn.std(axis=0), most / np.sqrt(3), rtol=0.05)
        np.testing.assert_allclose(drawn.mean(axis=0), 0, atol=0.05 * most)
        old, new = np.asarray(before.imu)[..., sensor], np.asarray(scaled.imu)[..., sensor]
        error = np.einsum("bnc,bnc->b", new, old) / np.einsum("bnc,bnc->b", old, old) - 1
        np.testing.assert_allclose(new, old * (1 + error[:, None, None]), atol=1e-5)
        assert stats.kstest(error / largest, "uniform", (-1, 2)).pvalue > 1e-3
    noisy = augmented(before, noise=(0.01, 0.1))
    difference = np.asarray(noisy.imu - before.imu)
    np.testing.assert_allclose(difference.std(axis=(0, 1)), [0.1] * 3 + [0.01] * 3, rtol=0.02)
    for after in (biased, scaled, noisy):
        np.testing.assert_array_equal(after.displacement, before.displacement)


def turns(before, after):
    """The rotation vectors between two sets of windows, by SciPy's solution of Wahba's problem."""
    vectors = []
    for old, new in zip(before.imu, np.asarray(after.imu), strict=True):
        rotation, residual = Rotation.align_vectors(new.reshape(-1, 3), old.reshape(-1, 3))
        assert residual < 1e-4
        vectors.append(rotation.as_rotvec())
    return np.array(vectors)


def test_tilt_is_about_a_horizontal_axis_and_yaw_turns_the_target_too():
    """Both turn gyro and accelerometer by the same angle, whose direction is uniform."""
    before = batch(300)
    after = augmented(before, tilt_degrees=5.0)
    vectors = turns(before, after)
    angle = np.degrees(np.linalg.norm(vectors, axis=1))
    assert np.abs(vectors[:, 2]).max() < 1e-4 and angle.max() <= 5.01
    assert angle.mean() == pytest.approx(2.5, abs=0.3)
    assert abs(np.exp(1j * np.arctan2(vectors[:, 1], vectors[:, 0])).mean()) < 0.15
    np.testing.assert_array_equal(after.displacement, before.displacement)
    after = augmented(before, yaw=True)
    vectors = turns(before, after)
    assert np.abs(vectors[:, :2]).max() < 2e-3
    turn = Rotation.from_rotvec(vectors)
    np.testing.assert_allclose(turn.apply(before.displacement), after.displacement, atol=2e-3)
    np.testing.assert_allclose(turn.apply(before.steps[:, 2]), after.steps[:, 2], atol=2e-3)
    assert abs(np.exp(1j * vectors[:, 2]).mean()) < 0.15


def test_a_window_at_rest_has_gravity_alone_and_no_displacement():
    """The axes of the body stay."""
    before = batch()
    axes = np.float32(np.random.default_rng(4).normal(size=(*before.imu.shape[:2], 6)))
    before = before._replace(imu=np.concatenate([before.imu, axes], axis=-1))
    after = augmented(before, rest_share=0.2)
    lies = np.asarray((after.displacement == 0).all(axis=1))
    assert 0.17 < lies.mean() < 0.23
    still = np.broadcast_to(np.float32([0, 0, 9.81, 0, 0, 0]), after.imu[lies][..., :6].shape)
    np.testing.assert_array_equal(after.imu[lies][..., :6], still)
    first = np.broadcast_to(axes[lies][:, :1], axes[lies].shape)
    np.testing.assert_array_equal(after.imu[lies][..., 6:], first)
    assert not after.steps[lies].any()
    for new, old in zip(after, before, strict=True):
        np.testing.assert_array_equal(new[~lies], old[~lies])


def test_the_axes_of_a_share_of_the_windows_are_hidden():
    before = batch()
    axes = np.float32(np.random.default_rng(4).normal(size=(*before.imu.shape[:2], 6)))
    before = before._replace(imu=np.concatenate([before.imu, axes], axis=-1))
    after = augmented(before, hidden_axes_share=0.2)
    hidden = np.asarray((after.imu[..., 6:] == 0).all(axis=(1, 2)))
    assert 0.17 < hidden.mean() < 0.23
    np.testing.assert_array_equal(after.imu[~hidden], before.imu[~hidden])
    np.testing.assert_array_equal(after.imu[hidden, :, :6], before.imu[hidden, :, :6])
    np.testing.assert_array_equal(after.displacement, before.displacement)


def simulated_phone(mirrored):
    """Samples in the world, and positions, of a phone that moves and turns along smooth curves,
    from finite differences; behind the mirror x → −x if `mirrored`."""
    dt, time = 1e-4, 1e-4 * np.arange(4000)[:, None]
    rng = np.random.default_rng(3)
    size, rate, phase = rng.uniform(0.5, 3, (3, 3, 6))
    waves = (size[None] * np.sin(rate[None] * 4 * time[:, :, None] + phase[None])).sum(axis=2)
    position, turns = waves, 0.2 * np.roll(waves, 1, axis=1)
    attitude = Rotation.from_rotvec(turns).as_matrix()
    if mirrored:
        mirror = np.diag([-1.0, 1.0, 1.0])
        position, attitude = position @ mirror, mirror @ attitude @ mirror
    accel = np.diff(position, 2, axis=0) / dt**2 + [0, 0, 9.81]
    steps = attitude[1:] @ attitude[:-1].transpose(0, 2, 1)
    gyro = Rotation.from_matrix(steps).as_rotvec() / dt
    axes = attitude[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)
    return np.concatenate([accel, gyro[:-1], axes[:-2]], axis=1), position


def test_a_mirrored_window_is_that_of_a_phone_behind_the_mirror():
    (imu, position), (expected, reflected) = simulated_phone(False), simulated_phone(True)
    assert np.abs(imu - expected).max() > 1.0
    moved, moved_behind = position[-1] - position[0], reflected[-1] - reflected[0]
    count = 400
    before = Windows(
        np.broadcast_to(imu[::400].astype(np.float32), (count, 10, 12)),
        np.broadcast_to(moved.astype(np.float32), (count, 3)),
        np.broadcast_to(
            np.diff(position[::400], axis=0)[None, :9].astype(np.float32), (count, 9, 3)
        ),
    )
    after = augmented(before, mirror_share=0.25)
    mirrored = np.abs(after.displacement - moved).max(axis=1) > 1e-3
    assert 0.15 < mirrored.mean() < 0.35
    for which, samples, way, path in (
        (mirrored, expected[::400], moved_behind, reflected),
        (~mirrored, imu[::400], moved, position),
    ):
        steps = np.diff(path[::400], axis=0)[:9]
        target = np.broadcast_to(steps, after.steps[which].shape)
        np.testing.assert_allclose(after.steps[which], target, atol=1e-5)
        target = np.broadcast_to(samples, after.imu[which].shape)
        np.testing.assert_allclose(after.imu[which], target, atol=2e-4)
        target = np.broadcast_to(way, after.displacement[which].shape)
        np.testing.assert_allclose(after.displacement[which], target, atol=1e-5)


def test_a_phone_that_looks_ahead_does_so_behind_the_mirror():
    """In a window's frame the x axis of the phone looks along x, and y is ahead of a phone that is
    held flat in front of its walker."""
    drift = np.tile(np.float32([0.3, 1.2, 0.0]), (400, 1))  # ahead, and a little to the right
    before = batch(400)._replace(displacement=drift)
    after = augmented(before, mirror_share=0.5).displacement
    np.testing.assert_array_equal(after[:, 1], drift[:, 1])
    assert set(np.sign(after[:, 0])) == {-1.0, 1.0}


def test_a_phone_that_rocks_otherwise_measures_the_same_forces():
    """One turn about the vertical and one factor for a window's horizontal rates; nothing else."""
    before = batch()
    after = augmented(before, rocking_share=0.75)
    np.testing.assert_array_equal(after.imu[..., [0, 1, 2, 5]], before.imu[..., [0, 1, 2, 5]])
    np.testing.assert_array_equal(after.displacement, before.displacement)
    old, new = (x.imu[..., 3] + 1j * x.imu[..., 4] for x in (before, after))
    factor = new / old
    np.testing.assert_allclose(factor, np.broadcast_to(factor[:, :1], factor.shape), rtol=1e-3)
    changed = np.abs(factor[:, 0] - 1) > 1e-4
    assert 0.7 < changed.mean() < 0.8
    size, angle = np.abs(factor[changed, 0]), np.angle(factor[changed, 0])
    assert stats.kstest(size / 1.25, "uniform").pvalue > 1e-3
    assert stats.kstest(angle / np.pi, "uniform", (-1, 2)).pvalue > 1e-3


def test_another_bounce_moves_a_window_as_far():
    """With the accelerations of the changed window and some vertical velocity at its start, a
    double integration gives the same displacement, and the height's swing is the factor's."""
    before = batch(500, 100)
    after = augmented(before, vertical_gain=(0.25, 1.5))
    np.testing.assert_array_equal(after.imu[..., [0, 1, 3, 4, 5]], before.imu[..., [0, 1, 3, 4, 5]])
    np.testing.assert_array_equal(after.displacement, before.displacement)

    def swing(windows):
        """Heights about the curve of constant acceleration that ends where they end."""
        accel = np.asarray(windows.imu, float)[..., 2]
        time = np.linspace(0, 1, accel.shape[1] + 1)[None]
        velocity = np.pad(np.cumsum(accel, axis=1), ((0, 0), (1, 0)))
        height = np.cumsum(velocity, axis=1)
        curve = accel.mean(axis=1, keepdims=True) * np.cumsum(
            np.arange(accel.shape[1] + 1, dtype=float)
        )
        deviation = height - curve
        return deviation - deviation[:, -1:] * time

    factor = np.std(swing(after), axis=1) / np.std(swing(before), axis=1)
    np.testing.assert_allclose(swing(after), factor[:, None] * swing(before), atol=1e-3)
    share = (np.log(factor) - np.log(0.25)) / np.log(6.0)
    assert stats.kstest(share, "uniform").pvalue > 1e-3


def magnitude(order, cutoff, frequency):
    """Of an analog Butterworth, by SciPy."""
    return abs(signal.freqs(*signal.butter(order, cutoff, analog=True), worN=frequency)[1])


def test_low_pass_draws_order_and_cutoff_for_each_window_and_both_sensors_alike():
    """Sines of whole periods in a window and its margins: a filter changes their size alone. The
    ratio of two of them gives order and cut-off away, and SciPy has their sizes for those."""
    config = dataclasses.replace(OFF, low_pass_share=0.6, low_pass_hertz=(4.0, 25.0))
    time, frequency = np.arange(100) / 100, np.array([10, 20, 0, 20, 10, 0])
    sines = np.sin(2 * np.pi * frequency * time[:, None] + 1)
    imu = np.tile(sines.astype(np.float32), (3000, 1, 1))
    before = Windows(imu, np.ones((3000, 3), np.float32), np.ones((3000, 50, 3), np.float32))
    after = low_pass(KEY, before, config, 100.0)
    np.testing.assert_array_equal(after.displacement, before.displacement)
    inner = sines[25:-25]
    size = np.einsum("bnc,nc->bc", after.imu, inner) / np.sum(inner**2, axis=0)
    np.testing.assert_allclose(after.imu, size[:, None] * inner, atol=1e-5)  # no phase
    np.testing.assert_allclose(size[:, :3], size[:, [4, 3, 5]], atol=1e-5)
    np.testing.assert_allclose(size[:, 2], 1, atol=1e-5)  # gravity
    size = size[size[:, 1] < 0.9999, :2]
    assert len(size) / 3000 == pytest.approx(0.6, abs=0.03)
    odds = 1 / size - 1  # (f / cut-off)^(2 order)
    order = np.round(np.log2(odds[:, 1] / odds[:, 0]) / 2)
    cutoff = 20 / odds[:, 1] ** (1 / (2 * order))
    np.testing.assert_allclose(
        np.bincount(order.astype(int))[1:] / len(order), [1 / 3] * 3, atol=0.04
    )
    assert stats.kstest(np.log(cutoff / 4) / np.log(25 / 4), "uniform").pvalue > 1e-3
    for i in range(10):
        expected = magnitude(order[i], cutoff[i], [10.0, 20.0]) ** 2
        np.testing.assert_allclose(size[i], expected, rtol=1e-2)


def test_low_pass_of_a_window_is_that_of_its_whole_recording():
    """Its neighbours in the recording belong to the filter, those of another recording do not."""
    level = np.tile([1.0, 0.0, 0.0, 0.0], (90, 1))
    parts = [tumbling(90, seed)._replace(orientation=level) for seed in range(2)]
    parts[1] = parts[1]._replace(accel=parts[1].accel + 100)
    source = jax.device_put(windows.window_source(parts, CONFIG, 2))
    which = np.arange(len(source.start), dtype=np.int32)
    config = dataclasses.replace(OFF, low_pass_share=0.999999, low_pass_hertz=(4.0, 4.0))
    margin = windows.low_pass_margin(config, 20.0)
    window_batch = low_pass(KEY, gather(source, which, 20, margin), config, 20.0)
    np.testing.assert_array_equal(window_batch.displacement, source.displacement)
    expected = []
    for order in (1, 2, 3):
        rows = []
        for part in parts:
            imu = np.pad(np.hstack([part.accel, part.gyro]), ((50, 50), (0, 0)), "edge")
            size = magnitude(order, 4.0, np.maximum(np.fft.rfftfreq(190, 1 / 20), 1e-9)) ** 2
            smooth = np.fft.irfft(size[:, None] * np.fft.rfft(imu, axis=0), 190, axis=0)[50:-50]
            rows += [smooth[i : i + 20] for i in range(0, 70, 2)]
        expected.append(rows)
    error = np.abs(np.asarray(window_batch.imu) - np.array(expected)).max(axis=(2, 3))
    assert error.min(axis=0).max() < 0.1 and len(set(error.argmin(axis=0))) == 3


def test_the_margin_of_the_low_pass_ends_where_the_reference_does():
    """A phone upright at rest: what it measures, seen in the world, is gravity up to the edge."""
    before, still = 150, np.zeros((400, 3))
    upright = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (400, 1))  # wxyz, 90° about x
    upright[:before] = np.nan
    phone = tumbling(400, 0, invalid=range(before))._replace(
        gyro=still, accel=np.tile([0.0, 9.81, 0.0], (400, 1)), orientation=upright, position=still
    )
    source = windows.window_source([phone], CONFIG, 10)
    margin = windows.low_pass_margin(AugmentConfig(low_pass_share=1.0), 20.0)
    which = np.arange(len(source.start), dtype=np.int32)
    selection = gather(jax.device_put(source), which, 20, margin)
    assert source.start[0] == before and selection.imu.shape[1] == 20 + 2 * margin
    expected = np.broadcast_to(np.float32([0, 0, 9.81, 0, 0, 0]), selection.imu.shape)
    np.testing.assert_allclose(selection.imu, expected, atol=1e-5)


def test_switched_off_augmentation_changes_nothing_and_draws_depend_on_the_key_alone():
    before = batch(10)
    np.testing.assert_array_equal(augment(KEY, before, OFF).imu, before.imu)
    np.testing.assert_array_equal(low_pass(KEY, before, AugmentConfig(), 100.0).imu, before.imu)
    keys = KEY, KEY, jax.random.key(4)
    first, again, other = (augment(key, before, AugmentConfig()) for key in keys)
    np.testing.assert_array_equal(first.imu, again.imu)
    assert not np.allclose(first.imu, other.imu, atol=1e-3)
