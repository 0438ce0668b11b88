"""Training on segments of walks: how they are cut and changed, their losses, and whole runs."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data, models
from gnio_jax.config import (
    AugmentConfig,
    DataConfig,
    LossConfig,
    ModelConfig,
    SegmentTraining,
    ThroughFilter,
)
from gnio_jax.errors import InputError
from gnio_jax.networks import TrainedNetwork, read_network
from gnio_jax.reporting import Silence
from gnio_jax.training import initial, loop
from gnio_jax.training.losses import loss_stage
from gnio_jax.training.recordings import set_up
from gnio_jax.training.segment_task import BANDS, SegmentTask, horizon_error, measure, validate
from gnio_jax.training.task import TrainState, gradient_of
from gnio_jax.training.walk_segments import (
    SegmentGrid,
    cut_walks,
    draw_walks,
    grid_of,
    walk_source,
    with_errors,
)
from gnio_jax.training.walkway import unchanged_pace
from gnio_jax.types import Prediction, Sequence
from tests.support import tiny_run
from tests.support.tiny_run import assert_same_runs, rows
from tests.support.tlio_files import write_splits

RATE, N, W = 50.0, 10, 5
OFF = AugmentConfig(gyro_bias=0.0, accel_bias=0.0, tilt_degrees=0.0, yaw=False)
WINDOWS = DataConfig(rate=RATE, stride_seconds=0.2)


def experiment(root, workdir, **changes):
    changes = {
        "data": WINDOWS,
        "model": ModelConfig("gru", width=2, uncertainty="calibrated"),
        "segments": SegmentTraining(4.0),
        "augment": OFF,
        "batch_size": 2,
    } | changes
    return tiny_run.config(root, workdir, **changes)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return write_splits(tmp_path_factory.mktemp("walks") / "tlio")


def walk(samples=700, seed=0):
    """A sequence whose motion is drawn, with a hole in its reference."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / RATE

    def waves(size):
        return size * np.sin(t[:, None] * rng.uniform(0.5, 6, 3) + rng.uniform(0, 6, 3))

    attitude = Rotation.from_rotvec(waves(0.7)).as_quat()[:, [3, 0, 1, 2]]
    valid = np.ones(samples, bool)
    valid[300:310] = False
    position = np.where(valid[:, None], waves(2.0), np.nan)
    accel = waves(3.0) + np.array([0, 0, 9.81])
    return Sequence("w", t, waves(1.0), accel, attitude, position, position, valid)


def reference_segment(sequence, row, intervals):
    """Samples and displacements of a segment in the frame of its first attitude, by SciPy."""
    wxyz = np.where(sequence.valid[:, None], sequence.orientation, [1.0, 0, 0, 0])
    attitude = Rotation.from_quat(wxyz[:, [1, 2, 3, 0]])
    first = attitude[row].as_matrix()
    to_frame = Rotation.from_euler("z", -np.arctan2(first[1, 0], first[0, 0]))
    inside = slice(row, row + intervals * N)
    signals = [(to_frame * attitude[inside]).apply(x[inside]) for x in sequence[3:1:-1]]
    ends = sequence.position[row : row + intervals * N + 1 : N]
    return np.concatenate(signals, axis=1), to_frame.apply(ends[W:] - ends[:-W])


def test_segments_are_cut_with_the_attitude_of_the_reference():
    sequence, config = walk(), experiment(None, "unused")
    source = walk_source([sequence, sequence], config, training=True)
    intervals = 20
    for earliest, latest in zip(source.earliest, source.latest, strict=True):
        for row in (earliest, latest):
            inside = np.tile(sequence.valid, 2)[row : row + intervals * N + 1]
            assert inside.all() and row // 700 == (row + intervals * N) // 700
    assert len(source.earliest) == 4  # one of 4 s before and behind each hole
    chosen = jnp.array([source.earliest[0], source.latest[3]], np.int32)
    grid = grid_of(config)
    assert grid == SegmentGrid(N, intervals, W, RATE)
    cut = jax.device_get(cut_walks(jax.device_put(source), chosen, unchanged_pace(2), grid))
    for i, row in enumerate(chosen):
        signals, displacement = reference_segment(sequence, row % 700, intervals)
        np.testing.assert_allclose(cut.signals[i], signals, atol=2e-5)
        np.testing.assert_allclose(cut.displacement[i], displacement, atol=2e-5)


def test_a_segment_may_end_at_the_last_row_of_all():
    sequence = walk(20 * N + 1)._replace(valid=np.ones(20 * N + 1, bool))
    sequence = sequence._replace(position=np.nan_to_num(sequence.position))
    source = walk_source([sequence], experiment(None, "unused"), training=False)
    np.testing.assert_array_equal(source.earliest, [0])
    grid = SegmentGrid(N, 20, W, RATE)
    source, rows = jax.device_put(source), jnp.zeros(1, jnp.int32)
    cut = jax.device_get(cut_walks(source, rows, unchanged_pace(1), grid))
    _, displacement = reference_segment(sequence, 0, 20)
    np.testing.assert_allclose(cut.displacement[0], displacement, atol=2e-5)


def test_the_ratio_of_predicted_and_walked_is_that_in_the_plane(prepared):
    """On stairs, too: a perfect prediction has a ratio of 1."""
    task, held, _ = prepared
    segments = cut_walks(
        held.source, held.source.earliest[:2], unchanged_pace(2), grid_of(task.config)
    )
    climbed = segments.displacement.at[..., 2].set(2.0)
    segments = segments._replace(displacement=climbed)
    prediction = Prediction(climbed, jnp.zeros_like(climbed))

    class Perfect(SegmentTask):
        def predict(self, variables, segments, dropout_key=None):
            return prediction, {}

    perfect = Perfect(task.model, task.config, 1)
    state = TrainState(jnp.int32(1), {}, None)
    figures = measure(state, segments, perfect.last_stage(state), jnp.ones(2), perfect)
    assert float(figures.predicted / figures.walked) == pytest.approx(1.0, rel=1e-5)


def test_a_segment_that_does_not_fit_is_refused():
    config = experiment(None, "unused", segments=SegmentTraining(10.0))
    with pytest.raises(InputError, match=r"no segment of 10 s .* lower segments.seconds"):
        walk_source([walk()], config, training=False)


@pytest.mark.parametrize("error", [{"gyro_bias": 0.5}, {"scale": (0.3, 0.0)}])
def test_a_frame_drifts_as_its_gyro_says(error):
    """The displacement is turned by the integral of what the gyro shows too much until the window
    begins, and so are the samples."""
    config, sequence = dataclasses.replace(OFF, **error), walk()
    source = jax.device_put(walk_source([sequence], experiment(None, "unused"), training=False))
    row, grid = source.earliest[:1], SegmentGrid(N, 20, W, RATE)
    plain, drifted = (
        jax.device_get(draw_walks(jax.random.key(2), source, row, grid, augment))
        for augment in (OFF, config)
    )
    extra = drifted.signals[0, :, 5] - plain.signals[0, :, 5]
    angle = np.concatenate([[0], np.cumsum(extra) / RATE])[: 20 * N : N]
    turns = Rotation.from_euler("z", angle[:, None])
    assert np.abs(angle).max() > 0.05
    expected = turns[: 20 - W + 1].apply(plain.displacement[0])
    np.testing.assert_allclose(drifted.displacement[0], expected, atol=1e-4)
    for k in (0, 7, 19):
        samples = slice(k * N, k * N + N)
        forces = turns[k].apply(plain.signals[0, samples, :3])
        np.testing.assert_allclose(drifted.signals[0, samples, :3], forces, atol=1e-4)


def test_a_mirrored_segment_is_that_of_a_mirrored_walk():
    """The walk behind the mirror x → −x, cut as any other."""
    sequence, config = walk(), dataclasses.replace(OFF, mirror_share=1.0)
    w, x, y, z = sequence.orientation.T
    behind = sequence._replace(
        accel=sequence.accel * [-1, 1, 1],
        gyro=sequence.gyro * [1, -1, -1],
        orientation=np.stack([w, x, -y, -z], axis=1),
        position=sequence.position * [-1, 1, 1],
    )
    grid = SegmentGrid(N, 20, W, RATE, "body_axes")
    source, expected = (
        jax.device_put(walk_source([walked], experiment(None, "unused"), training=False))
        for walked in (sequence, behind)
    )
    row = source.earliest[:1]
    mirrored = jax.device_get(draw_walks(jax.random.key(2), source, row, grid, config))
    plain = jax.device_get(draw_walks(jax.random.key(2), expected, row, grid, OFF))
    np.testing.assert_allclose(mirrored.signals, plain.signals, atol=1e-4)
    np.testing.assert_allclose(mirrored.displacement, plain.displacement, atol=1e-5)
    np.testing.assert_allclose(mirrored.moved, plain.moved, atol=1e-5)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_axes_of_the_body_come_after_the_samples(mirrored):
    """They are those of the attitude in the frame of the segment, by SciPy; behind the mirror those
    of the mirrored walk, whose x axis points to the other side. Where the gyro has a bias, they
    turn with the frame that drifts by what the gyro shows too much, as the samples do."""
    sequence, grid = walk(), SegmentGrid(N, 20, W, RATE, "body_axes")
    source = jax.device_put(walk_source([sequence], experiment(None, "unused"), training=False))
    row, first = source.earliest[:1], int(source.earliest[0])
    rotation = Rotation.from_quat(sequence.orientation[:, [1, 2, 3, 0]])[first : first + 20 * N]
    signs = np.array([-1.0, 1, 1]) if mirrored else np.ones(3)
    expected = signs[:, None] * rotation.as_matrix() * signs
    expected = expected[:, :, :2].transpose(0, 2, 1).reshape(-1, 6)
    augment = dataclasses.replace(OFF, mirror_share=float(mirrored))
    cut = jax.device_get(draw_walks(jax.random.key(2), source, row, grid, augment))
    np.testing.assert_allclose(cut.signals[0, :, 6:], expected, atol=1e-5)
    with_bias = dataclasses.replace(augment, gyro_bias=0.5)
    drifted = jax.device_get(draw_walks(jax.random.key(2), source, row, grid, with_bias))
    turned = np.angle(
        np.dot(drifted.signals[0, -1, 6:8], [1, 1j]) / np.dot(expected[-1, :2], [1, 1j])
    )
    extra = drifted.signals[0, : 19 * N, 5] - cut.signals[0, : 19 * N, 5]
    assert np.isclose(np.exp(1j * turned), np.exp(1j * extra.sum() / RATE), atol=1e-3)
    forces = (np.dot(x.signals[0, -1, :2], [1, 1j]) for x in (drifted, cut))
    assert abs(turned) > 0.05 and np.isclose(np.exp(1j * turned), np.divide(*forces), atol=1e-3)


def test_the_axes_of_the_body_change_nothing_else_whatever_is_drawn():
    """Samples and displacements are the same to the bit without the axes, with them, and where they
    are hidden. Shown axes stay orthonormal, and hidden ones zero in the whole segment."""
    augment = AugmentConfig(
        gyro_bias=0.2,
        accel_bias=0.2,
        tilt_degrees=5.0,
        noise=(0.1, 0.3),
        scale=(0.1, 0.1),
        low_pass_share=0.5,
        low_pass_hertz=(3.0, 20.0),
        rest_share=0.2,
        mirror_share=0.5,
        rocking_share=0.5,
        walkway_share=0.5,
        vertical_gain=(0.5, 1.2),
        time_stretch=(0.9, 1.1),
    )
    config = experiment(None, "unused", augment=augment)
    source = jax.device_put(walk_source([walk(1400)], config, training=True))
    rows = jnp.repeat(jnp.asarray(source.earliest[:1]), 60)

    def draw(rotation, share=0.0):
        changes = dataclasses.replace(augment, hidden_axes_share=share)
        grid = SegmentGrid(N, 20, W, RATE, rotation)
        return jax.device_get(draw_walks(jax.random.key(3), source, rows, grid, changes))

    plain, shown = draw("per_sample"), draw("body_axes")
    some, none = draw("body_axes", 0.5), draw("hidden_axes")
    for cut in (shown, some, none):
        np.testing.assert_array_equal(cut.signals[..., :6], plain.signals)
        np.testing.assert_array_equal(cut.displacement, plain.displacement)
    x_axis, y_axis = shown.signals[..., 6:9], shown.signals[..., 9:]
    for one, other, product in ((x_axis, x_axis, 1), (y_axis, y_axis, 1), (x_axis, y_axis, 0)):
        np.testing.assert_allclose((one * other).sum(axis=2), product, atol=1e-5)
    assert not none.signals[..., 6:].any()
    hidden = ~some.signals[..., 6:].any(axis=(1, 2))
    assert 15 < hidden.sum() < 45
    np.testing.assert_array_equal(some.signals[~hidden], shown.signals[~hidden])


def test_an_error_of_gravitys_direction_turns_the_axes_of_the_body_with_the_samples():
    sequence, grid = walk(), SegmentGrid(N, 20, W, RATE, "body_axes")
    source = jax.device_put(walk_source([sequence], experiment(None, "unused"), training=False))
    with_tilt = dataclasses.replace(OFF, tilt_degrees=30.0)
    plain, tilted = (
        jax.device_get(draw_walks(jax.random.key(2), source, source.earliest[:1], grid, augment))
        for augment in (OFF, with_tilt)
    )
    vectors, turned = (cut.signals[0].reshape(-1, 4, 3) for cut in (plain, tilted))
    tilt, _ = Rotation.align_vectors(turned[:, :2].reshape(-1, 3), vectors[:, :2].reshape(-1, 3))
    assert np.radians(3) < tilt.magnitude() < np.radians(30)
    np.testing.assert_allclose(tilt.as_rotvec()[2], 0, atol=1e-5)
    for new, old in zip(turned[:, 2:], vectors[:, 2:], strict=True):
        np.testing.assert_allclose(new, tilt.apply(old), atol=1e-5)


def test_the_axes_of_a_phone_at_rest_stay():
    sequence, grid = walk(), SegmentGrid(N, 20, W, RATE, "body_axes")
    source = jax.device_put(walk_source([sequence], experiment(None, "unused"), training=False))
    row, at_rest = source.earliest[:1], dataclasses.replace(OFF, rest_share=1.0)
    plain, standstill = (
        jax.device_get(draw_walks(jax.random.key(2), source, row, grid, augment))
        for augment in (OFF, at_rest)
    )
    assert np.abs(plain.signals[0, -1, 6:] - plain.signals[0, 0, 6:]).max() > 0.1
    expected = np.concatenate([np.float32([0, 0, 9.81, 0, 0, 0]), plain.signals[0, 0, 6:]])
    np.testing.assert_array_equal(standstill.signals[0], np.tile(expected, (20 * N, 1)))
    assert not standstill.displacement.any() and not standstill.moved.any()


def test_the_axes_of_the_body_are_hidden_in_a_share_of_the_segments():
    sequence, grid = walk(), SegmentGrid(N, 20, W, RATE, "body_axes")
    source = jax.device_put(walk_source([sequence], experiment(None, "unused"), training=False))
    rows, key = jnp.repeat(jnp.asarray(source.earliest[:1]), 400), jax.random.key(3)
    config = dataclasses.replace(OFF, hidden_axes_share=0.3)
    hidden, shown = (
        jax.device_get(draw_walks(key, source, rows, grid, augment).signals)
        for augment in (config, OFF)
    )
    blank = ~hidden[:, :, 6:].any(axis=(1, 2))
    assert 0.22 < blank.mean() < 0.38
    np.testing.assert_array_equal(hidden[..., :6], shown[..., :6])
    np.testing.assert_array_equal(hidden[~blank], shown[~blank])
    never = jax.device_get(
        draw_walks(key, source, rows[:2], grid._replace(window_rotation="hidden_axes"), OFF).signals
    )
    assert not never[..., 6:].any() and never.shape[2] == 12


def test_a_bias_is_constant_in_the_body_behind_the_mirror():
    sequence = walk()
    source = jax.device_put(walk_source([sequence], experiment(None, "unused"), training=False))
    row, grid = source.earliest[:1], SegmentGrid(N, 20, W, RATE)
    plain, biased = (
        np.asarray(draw_walks(jax.random.key(2), source, row, grid, augment).signals, float)
        for augment in (
            dataclasses.replace(OFF, mirror_share=1.0, accel_bias=bias) for bias in (0.0, 0.4)
        )
    )
    w, x, y, z = sequence.orientation[int(row[0]) : int(row[0]) + 20 * N].T
    behind = Rotation.from_quat(np.stack([x, -y, -z, w], axis=1))
    bias = behind.inv().apply((biased - plain)[0, :, :3])
    np.testing.assert_allclose(bias, np.tile(bias[:1], (20 * N, 1)), atol=1e-5)
    assert np.abs(bias[0]).min() > 0.01


def test_a_segment_of_a_phone_that_rocks_otherwise_has_the_same_forces():
    source = jax.device_put(walk_source([walk()], experiment(None, "unused"), training=False))
    row, grid = source.earliest[:1], SegmentGrid(N, 20, W, RATE)
    plain, rocked = (
        jax.device_get(draw_walks(jax.random.key(2), source, row, grid, augment)).signals
        for augment in (OFF, dataclasses.replace(OFF, rocking_share=1.0))
    )
    np.testing.assert_allclose(rocked[..., [0, 1, 2, 5]], plain[..., [0, 1, 2, 5]], atol=1e-6)
    factor = (rocked[..., 3] + 1j * rocked[..., 4]) / (plain[..., 3] + 1j * plain[..., 4])
    np.testing.assert_allclose(factor, np.full_like(factor, factor[0, 0]), rtol=1e-3)
    assert np.abs(factor[0, 0] - 1) > 0.05


def test_biases_are_constant_in_the_body():
    rng = np.random.default_rng(0)
    imu = jnp.asarray(rng.standard_normal((3, 40, 6)), jnp.float32)
    rotation = Rotation.from_rotvec(rng.standard_normal((120, 3))).as_matrix().reshape(3, 40, 3, 3)
    config = dataclasses.replace(OFF, gyro_bias=0.1, accel_bias=0.4)
    changed, drift = with_errors(jax.random.key(0), imu, jnp.asarray(rotation, jnp.float32), config)
    error = np.asarray(changed - imu).reshape(3, 40, 2, 3)
    body = np.einsum("bsji,bskj->bski", rotation, error)
    np.testing.assert_allclose(body, np.tile(body[:, :1], (1, 40, 1, 1)), atol=1e-5)
    assert (np.abs(body[:, 0]).max((0, 2)) < [0.4, 0.1]).all()
    assert (np.abs(body[:, 0]).min(0) > 0).all()
    np.testing.assert_allclose(drift, error[..., 1, 2], atol=1e-6)


def test_time_is_stretched_and_yaw_and_rest_are_drawn():
    config = dataclasses.replace(OFF, time_stretch=(1.5, 1.5), yaw=True, rest_share=0.4)
    sequence = walk()
    training = experiment(None, "unused", augment=config, segments=SegmentTraining(2.0))
    source = walk_source([sequence], training, training=True)
    row, grid = jnp.asarray(source.earliest[:1]), grid_of(training)
    assert (np.asarray(source.latest) + 150 < 700).all()
    drawn = [
        jax.device_get(draw_walks(jax.random.key(i), jax.device_put(source), row, grid, config))
        for i in range(20)
    ]
    still = np.tile([0, 0, 9.81, 0, 0, 0], (grid.samples, 1))
    at_rest = [np.allclose(segments.signals[0], still) for segments in drawn]
    assert 3 <= sum(at_rest) <= 13
    wxyz = sequence.orientation[:, [1, 2, 3, 0]]
    for segments, rests in zip(drawn, at_rest, strict=True):
        if rests:
            assert not segments.displacement.any() and not segments.moved.any()
            continue
        start = int(row[0])
        ends = start + 15 * np.arange(grid.intervals + 1)
        moved = sequence.position[ends[W:]] - sequence.position[ends[:-W]]
        lengths = np.linalg.norm(moved[:, :2], axis=1)
        norms = np.linalg.norm(segments.displacement[0, :, :2], axis=1)
        np.testing.assert_allclose(norms, lengths, atol=1e-4)
        # The second sample is half a sample beyond the first one after the start.
        force = np.einsum(
            "tij,tj->ti",
            Rotation.from_quat(wxyz[start + 1 : start + 3]).as_matrix(),
            sequence.accel[start + 1 : start + 3],
        ).mean(0)
        expected = 9.81 + 1.5**2 * (force[2] - 9.81)
        assert segments.signals[0, 1, 2] == pytest.approx(expected, abs=1e-3)
    walks = [segments for segments, rests in zip(drawn, at_rest, strict=True) if not rests]
    angles = [np.arctan2(*segments.displacement[0, 0, 1::-1]) for segments in walks]
    assert np.std(angles) > 0.5


def test_the_horizon_error_is_its_loop():
    rng = np.random.default_rng(0)
    error, moved = rng.standard_normal((2, 37, 3)), rng.uniform(0, 2, (2, 37))
    window, count, terms = 3, 12, []
    for length in (5, 10):
        squares = []
        for b in range(2):
            for phase in range(window):
                for first in range(count - length + 1):
                    rows = phase + window * np.arange(first, first + length)
                    total = error[b, rows].sum(0)
                    squares.append(total @ total / (moved[b, rows].sum() ** 2 + 1))
        terms.append(np.mean(squares))
    with jax.enable_x64(True):
        value = horizon_error(jnp.asarray(error), jnp.asarray(moved), window)
    assert float(value) == pytest.approx(np.mean(terms), rel=1e-9)
    assert float(horizon_error(jnp.ones((2, 9, 3)), jnp.ones((2, 9)), 3)) == 0


@pytest.fixture(scope="module")
def prepared(root):
    config = experiment(root, "unused", loss=LossConfig(nll_weight=1.0))
    task, held = set_up(SegmentTask, config, Silence())
    return task, held, task.initial_state(jax.random.key(0), None)


def test_validation_is_a_loop_over_segments(root, prepared):
    task, held, state = prepared
    (source,) = held.held_out.values()
    stage = loss_stage(task.config.loss, 0, 1)
    plain, *bands = jax.device_get(validate(state, source, jax.random.key(1), stage, task=task))
    sequence = data.resample(data.load("tlio", root, "val")[0], RATE)
    squares, along, lengths = [], [], []
    for row in np.asarray(source.earliest):
        signals, displacement = reference_segment(sequence, row, 20)
        arguments = task.model.begin(1), jnp.asarray(signals, jnp.float32)[None], N
        prediction = task.model.apply(state.variables, *arguments, method="advance")[1]
        predicted = np.asarray(prediction.displacement)[0, W - 1 :]
        squares.append(((displacement - predicted) ** 2).sum(1))
        lengths.append(np.linalg.norm(displacement[:, :2], axis=1))
        along.append((displacement * predicted)[:, :2].sum(1) / lengths[-1])
    assert float(plain.mse) == pytest.approx(np.mean(squares), rel=1e-4)
    assert float(plain.walked) == pytest.approx(np.mean(lengths), rel=1e-4)
    assert float(plain.predicted) == pytest.approx(np.mean(along), rel=1e-3)
    for (low, high), band in zip(BANDS, bands, strict=True):
        assert 0.95 * low < float(band.walked) < 1.05 * high


def test_a_cut_memory_changes_the_gradient_and_not_the_loss(prepared):
    task, held, state = prepared
    batch = task.draw(jax.random.key(0), held.source, held.source.earliest[:2])
    cut = dataclasses.replace(task.config, segments=SegmentTraining(4.0, truncate_seconds=1.0))
    results = []
    for config in (task.config, cut):
        changed = dataclasses.replace(task, config=config)
        trained = changed.trainable(state.variables)
        results.append(
            jax.jit(gradient_of, static_argnames="task")(
                trained, state.variables, batch, state.step, task=changed
            )
        )
    (whole, losses), (short, cut_losses) = jax.device_get(results)
    for name, value in losses.figures.items():
        assert value == pytest.approx(cut_losses.figures[name], rel=1e-4), name
    kernels = [tree["params"]["recurrent_kernel"] for tree in (whole, short)]
    assert np.abs(np.subtract(*kernels)).max() > 1e-3 * np.abs(kernels[0]).max()


def test_a_run_learns_is_resumed_to_the_bit_and_goes_on_through_the_filter(root, tmp_path):
    augment = AugmentConfig(low_pass_share=0.5, walkway_share=0.5, time_stretch=(0.9, 1.1))
    config = experiment(root, tmp_path / "a", augment=augment, epochs=3, learning_rate=1e-2)
    loop.train(config, reporter=Silence())
    first, _, last = rows(tmp_path / "a")
    assert last["val_mse"] < first["val_mse"] and last["step"] == 3 * first["step"]
    assert {"val_rmse/walked", "val_ratio/1.15-1.5", "val_normalised/z", "horizon"} <= set(last)
    other = dataclasses.replace(config, workdir=str(tmp_path / "b"))
    with tiny_run.stopped_at(first["step"] + 1):
        loop.train(other, reporter=Silence())
    loop.train(other, resume=True, reporter=Silence())
    assert_same_runs(tmp_path / "a", tmp_path / "b")
    through = experiment(
        root,
        tmp_path / "c",
        init_from=str(tmp_path / "a"),
        through_filter=ThroughFilter(("all",), piece_seconds=3.0, truncate_seconds=1.0),
        segments=SegmentTraining(),
        epochs=1,
    )
    loop.train(through, reporter=Silence())
    before, after = (read_network(tmp_path / name) for name in "ac")
    moved = jax.tree.map(
        lambda x, y: float(np.abs(x - y).max()),
        before.variables["params"],
        after.variables["params"],
    )
    assert min(jax.tree.leaves(moved["conv1"])) > 0 and moved["recurrent_kernel"] > 0


def test_a_network_with_another_limit_of_a_screen_that_faces_up_is_no_start(monkeypatch):
    model = ModelConfig("gru", width=2, equivariance="device_heading")
    first = experiment(None, "unused", model=model, init_from="first")
    network = TrainedNetwork(first, models.from_config(model), None, epoch=0, step=0)
    monkeypatch.setattr(initial.networks, "load", lambda _: network)
    assert initial.load_initial_network(first).config is first
    steeper = dataclasses.replace(model, largest_tilt=65.0)
    with pytest.raises(InputError, match=r"model\.largest_tilt is 60\.0, and here it is 65\.0"):
        initial.load_initial_network(dataclasses.replace(first, model=steeper))


def test_settings_that_do_not_fit_are_refused(root, tmp_path):
    for changes, problem in (
        ({"model": ModelConfig("tiny")}, "segments.seconds: is for a network with memory, and"),
        ({"data": DataConfig(rate=RATE)}, "data.stride_seconds: is 5 samples; 'gru' takes 10; "),
        ({"segments": SegmentTraining(1.0)}, "segments.seconds' must be at least two windows"),
        ({"segments": SegmentTraining(4.1)}, "segments.seconds' is not a whole number of strides"),
        (
            {"data": dataclasses.replace(WINDOWS, context_seconds=1.0)},
            "segments' are for networks whose windows have no context",
        ),
    ):
        with tiny_run.registry_entry(), pytest.raises(InputError, match=problem):
            loop.train(experiment(root, tmp_path / "x", **changes), reporter=Silence())
