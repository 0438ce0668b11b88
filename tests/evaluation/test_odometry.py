"""Estimators against plain loops over samples and windows, and against what they must give with
perfect inputs."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.data.readers import synthetic
from gnio_jax.evaluation import metrics, odometry, report
from gnio_jax.evaluation.odometry import Network, Setup
from gnio_jax.types import InputError, Prediction

RATE = 50.0
CONFIG = DataConfig(rate=RATE)
OPTIONS = FilterOptions()
INTEGRATE = Setup("integrate")
LOOSE = Setup(coupling="loose")


def sensed(variables, windows):
    """A "network" that shows what it was given: the means of its channels."""
    means = windows.mean(axis=1)
    diagnostics = {
        "gate": jnp.tanh(means[:, 3:]),
        "attention": jnp.zeros((windows.shape[0], 8, 64)),
    }
    return Prediction(
        variables["gain"] * means[:, :3], means[:, 3:] + variables["log_std"], diagnostics
    )


NETWORK = Network(sensed, {"gain": jnp.float32(0.05), "log_std": jnp.float32(-3.0)})


@pytest.fixture(scope="module")
def walks():
    # Lengths that share one compiled filter (a fifth is the most that is padded), but for the
    # shortest.
    lengths = {1: 18.0, 2: 11.3, 3: 16.0}
    return [
        synthetic.pedestrian(seed, synthetic.person(seed), "handheld", seconds, RATE)
        for seed, seconds in lengths.items()
    ]


@pytest.fixture(scope="module")
def clean():
    return synthetic.pedestrian(5, synthetic.person(5), "pocket", 18.0, RATE, imu_errors=False)


def rotations(wxyz):
    return Rotation.from_quat(wxyz, scalar_first=True)


def unyaw(matrix):
    yaw = np.arctan2(matrix[1, 0], matrix[0, 0])
    return np.array([[np.cos(yaw), np.sin(yaw), 0], [-np.sin(yaw), np.cos(yaw), 0], [0, 0, 1.0]])


def test_imu_only_is_strap_down_integration(walks):
    (recording,), _ = odometry.prepare(walks[:1], CONFIG, Setup("imu_only"))
    (found,) = odometry.estimate([recording], None, CONFIG, OPTIONS, Setup("imu_only"))
    rotation, velocity, position = (
        rotations(walks[0].orientation[0]).as_matrix(),
        walks[0].velocity[0],
        walks[0].position[0],
    )
    dt, gravity, path, attitudes = 1 / RATE, np.array([0, 0, -9.81]), [position], [rotation]
    for k in range(len(recording.sequence.time) - 1):
        step = rotation @ walks[0].accel[k] * dt
        position = position + velocity * dt + 0.5 * step * dt + 0.5 * gravity * dt**2
        velocity = velocity + step + gravity * dt
        rotation = rotation @ Rotation.from_rotvec(walks[0].gyro[k] * dt).as_matrix()
        if (k + 1) % CONFIG.stride == 0:
            path.append(position)
            attitudes.append(rotation)
    np.testing.assert_allclose(found.trajectory.position, path, atol=1e-9)
    np.testing.assert_allclose(
        rotations(found.trajectory.orientation).as_matrix(), attitudes, atol=1e-10
    )
    np.testing.assert_array_equal(
        found.trajectory.time, walks[0].time[:: CONFIG.stride][: len(path)]
    )
    np.testing.assert_array_equal(
        found.reference.position, walks[0].position[:: CONFIG.stride][: len(path)]
    )
    assert np.isnan(found.accepted).all() and found.std.shape == (len(path), 15)


@pytest.mark.parametrize("reading", ["per_sample", "single"])
def test_windows_are_cut_with_the_given_attitude(walks, reading):
    config = DataConfig(rate=RATE, window_rotation=reading)
    recordings, _ = odometry.prepare(walks[:2], config, INTEGRATE)
    attitudes = [odometry.attitude(r, config, "reference") for r in recordings]
    predictions = odometry.predict_windows(NETWORK, recordings, attitudes, config)
    for walk, prediction, recording in zip(walks[:2], predictions, recordings, strict=True):
        turns = rotations(walk.orientation).as_matrix()
        starts = range(0, len(recording.sequence.time) - config.window, config.stride)
        assert len(prediction.displacement) == len(starts)
        for row, i in list(enumerate(starts))[::17]:
            rows = range(i, i + config.window)
            means = [
                np.mean(
                    [
                        unyaw(turns[i]) @ turns[j if reading == "per_sample" else i] @ signal[j]
                        for j in rows
                    ],
                    axis=0,
                )
                for signal in (walk.accel, walk.gyro)
            ]
            np.testing.assert_allclose(prediction.displacement[row], 0.05 * means[0], atol=2e-6)
            np.testing.assert_allclose(prediction.log_std[row], means[1] - 3, atol=1e-5)
        assert set(prediction.diagnostics) == {"gate"}


def test_integration_against_a_loop(walks):
    (recording,), _ = odometry.prepare(walks[:1], CONFIG, INTEGRATE)
    (found,) = odometry.estimate([recording], NETWORK, CONFIG, OPTIONS, INTEGRATE)
    turns = rotations(walks[0].orientation).as_matrix()
    (prediction,) = odometry.predict_windows(
        NETWORK, [recording], [turns[: len(recording.sequence.time)]], CONFIG
    )
    strides = (len(recording.sequence.time) - 1) // CONFIG.stride
    position, path = walks[0].position[0], [walks[0].position[0]]
    for stride in range(strides):
        covering = [i for i in range(len(prediction.displacement)) if i <= stride < i + 10]
        moves = [
            unyaw(turns[i * CONFIG.stride]).T
            @ prediction.displacement[i]
            * CONFIG.stride
            / CONFIG.window
            for i in covering
        ]
        position = position + np.mean(moves, axis=0)
        path.append(position)
    np.testing.assert_allclose(found.trajectory.position, path, atol=1e-9)
    np.testing.assert_allclose(found.displacement[10:], prediction.displacement)
    assert np.isnan(found.displacement[:10]).all() and found.std is None


def test_a_stride_without_a_window_goes_on_as_before():
    steps = np.array(
        [[1.0, 0, 0], [1.0, 0, 0], [np.nan] * 3, [np.nan] * 3, [np.nan] * 3, [2.0, 0, 0]]
    )
    moved = odometry._mean_over_cover(steps, 7, 2)[:, 0]
    np.testing.assert_allclose(moved, [1, 1, 1, 1, 1, 2, 2])


@pytest.mark.parametrize(
    "setup, ate",
    [
        (Setup(), 0.03),
        (LOOSE, 0.03),
        (INTEGRATE, 0.1),
        (Setup("integrate", orientation="filter"), 0.1),
        (Setup("imu_only"), 0.03),
        (Setup(init="static"), 0.1),
        (Setup("integrate", orientation="device"), 0.3),
    ],
)
def test_perfect_displacements_leave_little_error(walks, setup, ate):
    recordings, _ = odometry.prepare(walks[::2], CONFIG, setup._replace(gyro_bias="reference"))
    for found in odometry.perfect_displacements(recordings, CONFIG, OPTIONS, setup):
        values = metrics.measure(found.trajectory, found.reference).values
        assert values["ate"] < ate and values["path_length_ratio"] == pytest.approx(1, abs=0.03)


def test_integration_is_neither_ahead_nor_behind(clean):
    (recording,), _ = odometry.prepare([clean], CONFIG, INTEGRATE)
    (found,) = odometry.perfect_displacements([recording], CONFIG, OPTIONS, INTEGRATE)
    path, truth = found.trajectory.position, found.reference.position
    errors = {
        shift: metrics.ate(path[10:-10], truth[10 + shift : len(truth) - 10 + shift])
        for shift in range(-3, 4)
    }
    assert min(errors, key=errors.get) == 0


def same(a, b, tolerance):
    assert a.name == b.name
    for field, one, other in zip(a._fields, a, b, strict=True):
        if isinstance(one, np.ndarray):
            np.testing.assert_allclose(one, other, atol=tolerance, err_msg=field)


def test_batches_change_nothing(walks):
    recordings, _ = odometry.prepare(walks[::2], CONFIG)
    together = odometry.estimate(recordings, NETWORK, CONFIG, OPTIONS)
    for recording, in_batch in zip(recordings, together, strict=True):
        (alone,) = odometry.estimate([recording], NETWORK, CONFIG, OPTIONS, batch_size=1)
        same(alone, in_batch, 1e-5)
        np.testing.assert_allclose(
            alone.trajectory.position, in_batch.trajectory.position, atol=1e-6
        )
        np.testing.assert_allclose(
            alone.diagnostics["gate"], in_batch.diagnostics["gate"], atol=1e-6
        )


@pytest.mark.parametrize(
    "disturbed, factor, row", [(slice(450, 451), 1e5, 91), (slice(None), 1e3, 1)]
)
def test_what_the_filter_calls_void_has_diverged(walks, disturbed, factor, row):
    """One leap of the accelerometer, or a wrong unit: all numbers stay finite."""
    accel = walks[0].accel.copy()
    accel[disturbed] *= factor
    recordings, _ = odometry.prepare([walks[0]._replace(accel=accel), walks[2]], CONFIG)
    void, whole = odometry.estimate(recordings, NETWORK, CONFIG, OPTIONS)
    assert np.isfinite(void.velocity).all()
    assert np.argmax(np.linalg.norm(void.velocity, axis=1) > 100) == row
    for field in void.trajectory[1:]:
        assert np.isfinite(field[:row]).all() and np.isnan(field[row:]).all()
    words = f"filter: not healthy from {row / 10:.1f} s on, and all after it is void"
    assert void.notes == (words,) and whole.notes == ()
    scores = report.score([void, whole], {e.name: e.name for e in (void, whole)})
    assert scores.diverged == [void.name]
    assert scores.summary.mean["ate"] == scores.sequences[whole.name].values["ate"]


def test_many_batches_of_unlike_lengths(walks):
    """The ladder of padded lengths, a batch that is filled up, the order of the answers, the
    progress."""
    recordings, _ = odometry.prepare(walks, CONFIG)
    together, told = odometry.perfect_displacements(recordings, CONFIG, OPTIONS), []
    pairs = odometry.perfect_displacements(
        recordings, CONFIG, OPTIONS, batch_size=2, progress=told.append
    )
    for recording, a, b in zip(recordings, together, pairs, strict=True):
        assert a.name == recording.sequence.name and len(a.trajectory.time) == len(
            recording.sequence.time[:: CONFIG.stride]
        )
        same(a, b, 1e-9)
    assert told == sorted(told) and len(told) == 2 and told[-1] == 1.0


def test_tight_and_loose_see_the_same_windows(clean):
    """With an exact IMU the filter's attitude is the reference's, as long as no measurement
    disturbs it."""
    network = Network(sensed, {"gain": jnp.float32(0.05), "log_std": jnp.float32(4.0)})
    found = []
    for setup in (Setup(), LOOSE):
        recordings, _ = odometry.prepare([clean], CONFIG, setup)
        found += odometry.estimate(recordings, network, CONFIG, OPTIONS, setup, batch_size=1)
    tight, loose = found
    assert np.isnan(tight.displacement[:11]).all() and np.isfinite(tight.displacement[11:]).all()
    np.testing.assert_array_equal(np.isnan(tight.displacement), np.isnan(loose.displacement))
    np.testing.assert_allclose(tight.displacement[11:], loose.displacement[11:], atol=2e-3)
    np.testing.assert_allclose(tight.displacement_std[11:], loose.displacement_std[11:], rtol=2e-2)
    np.testing.assert_allclose(
        tight.diagnostics["gate"][11:], loose.diagnostics["gate"][11:], atol=2e-2
    )
    np.testing.assert_allclose(tight.trajectory.position, loose.trajectory.position, atol=2e-2)
    assert (
        np.std(tight.displacement[11:], axis=0).max() > 0.01
    )  # else the agreement would say nothing


def test_loose_measurements_have_the_same_least_std(clean):
    network = Network(sensed, {"gain": jnp.float32(0.0), "log_std": jnp.float32(-90.0)})
    recordings, _ = odometry.prepare([clean], CONFIG, LOOSE)
    (found,) = odometry.estimate(recordings, network, CONFIG, OPTIONS, LOOSE, batch_size=1)
    np.testing.assert_allclose(found.displacement_std[11:], np.exp(-4) * np.sqrt(10), rtol=1e-6)


def test_the_first_gyro_bias_is_taken_off_the_windows_and_the_attitude(clean):
    (recording,), _ = odometry.prepare([clean], CONFIG, INTEGRATE)
    bias = np.array([0.1, -0.05, 0.02])
    biased = recording._replace(
        sequence=recording.sequence._replace(gyro=recording.sequence.gyro + bias), gyro_bias=bias
    )
    attitudes = [odometry.attitude(r, CONFIG, "filter") for r in (recording, biased)]
    np.testing.assert_allclose(*attitudes, atol=1e-9)
    a, b = odometry.predict_windows(NETWORK, [recording, biased], attitudes, CONFIG)
    np.testing.assert_allclose(a.log_std, b.log_std, atol=1e-5)


def test_start_is_the_first_trusted_sample(walks):
    hidden = walks[0]._replace(valid=np.arange(len(walks[0].time)) >= 137)
    (recording,), _ = odometry.prepare([hidden], CONFIG)
    assert recording.sequence.time[0] == walks[0].time[137]
    np.testing.assert_array_equal(recording.position, walks[0].position[137])
    np.testing.assert_allclose(
        recording.rotation, rotations(walks[0].orientation[137]).as_matrix(), atol=1e-12
    )
    assert (len(recording.sequence.time) - 1) % CONFIG.stride == 0


def test_static_start_is_level(clean):
    (recording,), _ = odometry.prepare([clean], CONFIG, Setup(init="static"))
    truth = rotations(clean.orientation[0]).as_matrix()
    assert np.degrees(np.arccos(recording.rotation[2] @ truth[2])) < 3.0  # it sways
    assert abs(np.arctan2(recording.rotation[1, 0], recording.rotation[0, 0])) < 1e-12
    assert not recording.velocity.any() and not recording.position.any() and not recording.notes
    moving = clean._replace(valid=np.arange(len(clean.time)) > 300)
    (recording,), _ = odometry.prepare([moving], CONFIG, Setup(init="static"))
    assert "not standing still" in recording.notes[0]


def test_gyro_bias_from_reference_and_from_rest(walks, clean):
    true = np.array([walks[0].attributes[f"gyro_bias_{axis}"] for axis in "xyz"])
    biased = walks[0]._replace(gyro=walks[0].gyro + np.array([0.004, -0.02, 0.01]))
    (recording,), _ = odometry.prepare([biased], CONFIG, Setup(gyro_bias="reference"))
    np.testing.assert_allclose(
        recording.gyro_bias, true + np.array([0.004, -0.02, 0.01]), atol=1e-4
    )
    assert "10 s against the reference" in recording.notes[0]

    (recording,), _ = odometry.prepare([clean], CONFIG, Setup(gyro_bias="rest"))
    assert not recording.gyro_bias.any() and "no rest" in recording.notes[0]
    random, bias = np.random.default_rng(0), np.array([0.01, -0.02, 0.005])
    resting = clean._replace(gyro=clean.gyro.copy(), accel=clean.accel.copy())
    resting.gyro[:120] = bias + random.normal(0, 1e-3, (120, 3))
    resting.accel[:120] = clean.accel[:120].mean(0) + random.normal(0, 0.01, (120, 3))
    (recording,), _ = odometry.prepare([resting], CONFIG, Setup(gyro_bias="rest"))
    np.testing.assert_allclose(recording.gyro_bias, bias, atol=5e-4)
    assert "2 s of rest" in recording.notes[0]
    (found,) = odometry.perfect_displacements([recording], CONFIG, OPTIONS, batch_size=1)
    np.testing.assert_allclose(found.gyro_bias[0], recording.gyro_bias)


def test_attitudes(walks):
    (recording,), _ = odometry.prepare(walks[:1], CONFIG, Setup("integrate", orientation="device"))
    count = len(recording.sequence.time)
    device = odometry.attitude(recording, CONFIG, "device")
    own = rotations(walks[0].device_orientation[:count]).as_matrix()
    turn = device[0] @ own[0].T
    np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(device, turn @ own, atol=1e-12)
    start = walks[0].orientation[:1]
    np.testing.assert_allclose(
        metrics.yaw(
            rotations(Rotation.from_matrix(device[:1]).as_quat(scalar_first=True)).as_quat(
                scalar_first=True
            )
        ),
        metrics.yaw(start),
        atol=1e-12,
    )

    gap = walks[0]._replace(orientation=walks[0].orientation.copy(), valid=walks[0].valid.copy())
    gap.orientation[200:260], gap.valid[190:260] = np.nan, False
    (recording,), _ = odometry.prepare([gap], CONFIG, INTEGRATE)
    bridged = odometry.attitude(recording, CONFIG, "reference")
    truth = rotations(walks[0].orientation[:count]).as_matrix()
    np.testing.assert_allclose(bridged[:190], truth[:190], atol=1e-12)
    np.testing.assert_allclose(bridged[260:], truth[260:], atol=1e-12)
    np.testing.assert_allclose(
        bridged[190:260], truth[190:260], atol=0.03
    )  # 1.4 s of gyro with its bias


def test_no_reference_is_fine_with_a_static_start(walks):
    nowhere = walks[0]._replace(
        valid=np.zeros(len(walks[0].time), bool),
        position=np.full_like(walks[0].position, np.nan),
        orientation=np.full_like(walks[0].orientation, np.nan),
    )
    setup = Setup("integrate", orientation="filter", init="static")
    recordings, _ = odometry.prepare([nowhere], CONFIG, setup)
    (found,) = odometry.estimate(recordings, NETWORK, CONFIG, OPTIONS, setup)
    assert np.isfinite(found.trajectory.position).all() and np.isnan(found.reference.position).all()
    for bad, remedy in [
        (Setup(), "--init static"),
        (Setup(init="static", gyro_bias="reference"), "--gyro-bias zero"),
        (Setup("integrate", init="static"), "--orientation filter"),
    ]:
        with pytest.raises(InputError, match=remedy):
            odometry.prepare([nowhere], CONFIG, bad)


def test_setups_that_make_no_sense(walks):
    for setup in (Setup(orientation="reference"), Setup("imu_only", orientation="device")):
        with pytest.raises(InputError, match="leave it out"):
            odometry.resolve(setup)
    assert (
        odometry.resolve(Setup()).orientation == "filter"
        and odometry.resolve(LOOSE).orientation == "reference"
    )
    with pytest.raises(InputError, match="no device orientation"):
        odometry.prepare(
            [walks[0]._replace(device_orientation=None)],
            CONFIG,
            Setup("integrate", orientation="device"),
        )


def test_short_sequences_are_left_out_by_name(walks):
    short = walks[0]._replace(
        name="short", valid=np.arange(len(walks[0].time)) > len(walks[0].time) - 52
    )
    recordings, left_out = odometry.prepare([short, walks[1]], CONFIG)
    assert [r.sequence.name for r in recordings] == [walks[1].name]
    assert left_out == {
        "short": "1.02 s from its first trusted sample on, too short for a window and a stride"
    }


def test_never_moves(walks):
    recordings, _ = odometry.prepare(walks[:1], CONFIG, INTEGRATE)
    (still,) = odometry.never_moves(
        odometry.perfect_displacements(recordings, CONFIG, OPTIONS, INTEGRATE)
    )
    assert (still.trajectory.position == walks[0].position[0]).all() and still.displacement is None
    assert metrics.measure(still.trajectory, still.reference).values["path_length_ratio"] == 0


def test_other_rates_are_resampled():
    walk = synthetic.pedestrian(1, synthetic.person(1), "handheld", 6.0, 200.0)
    (recording,), _ = odometry.prepare([walk], CONFIG)
    assert np.median(np.diff(recording.sequence.time)) == pytest.approx(1 / RATE)
