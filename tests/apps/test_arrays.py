"""From samples in memory to a trajectory: `gnio_jax.track`."""

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gnio_jax
from gnio_jax import networks
from gnio_jax.apps.importing import import_recording
from gnio_jax.apps.track import track
from gnio_jax.config import DataConfig, ImportOptions, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from tests.support import known_walk, tiny_run
from tests.support.checks import unchecked

CONFIG = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig(name="tiny"))
EPOCH = 1.7e9
ROWS = np.delete(np.arange(600), np.s_[560:580])
TIME = EPOCH + ROWS / 100
"""Six seconds of unix time with a hole of 0.2 s, s."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """`walker` predicts something for each window, `mute` zero, give or take a metre."""
    folder = tmp_path_factory.mktemp("runs")
    with tiny_run.registry_entry():
        tiny_run.save(folder / "walker", CONFIG)
        tiny_run.save(folder / "mute", CONFIG, size=0.0)
        yield folder


@pytest.fixture(scope="module")
def samples():
    return TIME, known_walk.rate(ROWS / 100), known_walk.force(ROWS / 100)


@pytest.fixture(scope="module")
def odometry(runs, samples):
    return gnio_jax.track(*samples, network=runs / "walker")


def test_it_is_the_trajectory_of_gnio_track(odometry, runs, samples, tmp_path, monkeypatch):
    """To the last bit, from a file with the same samples."""
    monkeypatch.setattr("gnio_jax.apps.track._draw", lambda *_: None)
    header = "time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"
    rows = [",".join(map(repr, row)) for row in np.column_stack(samples).tolist()]
    (tmp_path / "walk.csv").write_text("\n".join([header, *rows]), encoding="utf-8")
    stated = ImportOptions(
        time_unit="s", gyro_unit="rad/s", accel_unit="m/s2", accel_sign="android"
    )
    recording = import_recording(tmp_path / "walk.csv", stated)
    tracked = track(recording, networks.load(runs / "walker"), tmp_path / "track")
    estimate = tracked.estimate
    path, filtered, states = estimate.trajectory, estimate.filtered, estimate.states
    assert filtered is not None and states is not None
    np.testing.assert_array_equal(odometry.position, path.position)
    np.testing.assert_array_equal(odometry.orientation, path.orientation)
    np.testing.assert_array_equal(odometry.velocity, states.velocity)
    np.testing.assert_array_equal(odometry.covariance, filtered.covariance)
    np.testing.assert_allclose(odometry.time, EPOCH + path.time, atol=1e-6)
    assert np.isfinite(odometry.position).all() and np.ptp(odometry.position[:, 0]) > 0.1
    for text in (*tracked.summary.warnings, *tracked.summary.notes):
        assert text.replace("walk.csv", "samples") in odometry.notes
    assert any(note.startswith("gaps: samples are missing") for note in odometry.notes)


def test_its_rows(odometry):
    """One at the first sample, one every 0.1 s, from the origin with yaw zero."""
    np.testing.assert_allclose(odometry.time, EPOCH + 0.1 * np.arange(60), atol=1e-6)
    np.testing.assert_array_equal(odometry.position[0], 0.0)
    np.testing.assert_array_equal(odometry.velocity[0], 0.0)
    np.testing.assert_allclose(np.linalg.norm(odometry.orientation, axis=1), 1.0, atol=1e-12)
    first = Rotation.from_quat(odometry.orientation[0], scalar_first=True)
    assert abs(first.as_euler("ZYX")[0]) < 1e-9
    variances = np.linalg.eigvalsh(odometry.covariance)
    assert (variances > 0).all() and variances[-1].max() > variances[0].max()


def test_rows_in_any_order_and_lists_whatever_the_precision_of_jax(odometry, runs, samples):
    """JAX keeps its own setting."""
    order = np.r_[100:580, 0:100]
    mixed = [values[order].tolist() for values in samples]
    with jax.enable_x64(False):
        again = gnio_jax.track(*mixed, network=str(runs / "walker"))
        assert not jax.config.read("jax_enable_x64")
    np.testing.assert_allclose(again.position, odometry.position, atol=1e-9)
    np.testing.assert_allclose(again.covariance, odometry.covariance, rtol=1e-6)
    assert any("rows were sorted" in note for note in again.notes)


def test_a_phone_on_a_table_stays_there(runs):
    """It lies tilted, which gravity shows, and its gyro has a bias, which the rest shows."""
    time, random = ROWS / 100, np.random.default_rng(0)
    gyro = random.normal([0.01, -0.02, 0.015], 1e-3, (len(time), 3))
    accel = random.normal([0.0, 4.0, 8.96], 0.01, (len(time), 3))
    odometry = gnio_jax.track(time, gyro, accel, runs / "mute")
    assert np.linalg.norm(odometry.position, axis=1).max() < 0.2
    attitude = Rotation.from_quat(odometry.orientation, scalar_first=True)
    upward = attitude.apply(np.array([0.0, 4.0, 8.96]) / 9.81)
    np.testing.assert_allclose(upward, np.tile([0.0, 0.0, 1.0], (len(upward), 1)), atol=5e-3)
    assert (attitude[0].inv() * attitude[-1]).magnitude() < np.radians(0.5)
    assert any("mean of 5 s of rest" in note for note in odometry.notes)
    assert any(note.startswith("rest: it lies still") for note in odometry.notes)


def nan_row(values):
    return np.where(np.arange(len(values))[:, None] == 7, np.nan, values)


WRONG = {
    "time: has shape (580, 1), expected (n,)": lambda t, g, a: (t[:, None], g, a),
    "gyro: has shape (3, 580), expected (580, 3): x, y, z for each of the stamps; give gyro.T": (
        lambda t, g, a: (t, g.T, a)
    ),
    "accel: has shape (579, 3), expected (580, 3)": lambda t, g, a: (t, g, a[1:]),
    "gyro: has shape (580,), expected (580, 3)": lambda t, g, a: (t, g[:, 0], a),
    "accel: is not an array of numbers": lambda t, g, a: (t, g, [["1", "2", "x"]] * len(t)),
    "time: is NaN or infinite in 1 of 580 rows, the first is row 3": lambda t, g, a: (
        np.where(np.arange(len(t)) == 3, np.nan, t),
        g,
        a,
    ),
    "gyro: is NaN or infinite in 1 of 580 rows, the first is row 7": lambda t, g, a: (
        t,
        nan_row(g),
        a,
    ),
    "gyro: looks like deg/s (by the turning of gravity": lambda t, g, a: (t, np.degrees(g), a),
    "expected rad/s; convert it: numpy.radians(gyro)": lambda t, g, a: (t, np.degrees(g), a),
    "gyro: looks like deg/s (it reaches 60, and no phone measures more than 35 rad/s)": (
        lambda t, g, a: (t, 0.0 * g + [0, 0, 60.0], 0.0 * a + [0, 0, 9.81])
    ),
    "gyro: is too small to be in rad/s (by the turning of gravity": lambda t, g, a: (
        t,
        np.radians(g),
        a,
    ),
    "field 'accel' looks like G": lambda t, g, a: (t, g, a / 9.81),
    "field 'accel' has no gravity in it": lambda t, g, a: (t, g, 0.3 * a),
    "they look like ms: divide them by 1000": lambda t, g, a: (t * 1e3, g, a),
    "goes over": lambda t, g, a: (np.append(t[:-1], t[-1] + 1e8), g, a),
    "field 'time' has a gap of 4.01": lambda t, g, a: (t + 4.0 * (t > EPOCH + 3.0), g, a),
    "were recorded for 0.49 s": lambda t, g, a: (t[:50], g[:50], a[:50]),
    "too short for a window and a stride; record for longer": (
        lambda t, g, a: (t[:105], g[:105], a[:105])
    ),
}
"""The message -> what is wrong with the samples."""


@pytest.mark.parametrize("message", WRONG)
def test_what_is_refused(message, runs, samples):
    with pytest.raises(InputError) as error:
        gnio_jax.track(*WRONG[message](*samples), network=runs / "walker")
    assert message in str(error.value) and isinstance(error.value, ValueError)


def test_a_network_that_does_not_exist_or_sees_no_heading(runs, samples):
    with pytest.raises(InputError, match="did you mean 'pedestrian'"):
        gnio_jax.track(*samples, network="pedestrain")
    network = networks.load(runs / "walker")
    with unchecked(), pytest.raises(InputError, match=r"^network: is a TrainedNetwork; give its"):
        gnio_jax.track(*samples, network=network)
    with unchecked(), pytest.raises(InputError, match=r"^sensors: is a NoneType; give a dict"):
        gnio_jax.track(*samples, network=runs / "walker", sensors=None)
    with pytest.raises(InputError, match=r"heading gait: walker does not use the heading"):
        gnio_jax.track(*samples, network=runs / "walker", heading="gait")
