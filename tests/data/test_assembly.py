"""Streams become sequences on one clock, and nothing that holds a window is lost in silence."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import evaluation
from gnio_jax.config import DataConfig
from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.validation import validate
from gnio_jax.errors import InputError
from gnio_jax.training import windows
from gnio_jax.types import Waypoints
from tests.support import known_walk as walk


def imu(gyro_time, accel_time, **options):
    """The known walk by a gyro and an accelerometer with these stamps."""
    return Streams(
        "walk",
        "walk.csv",
        Samples(gyro_time, walk.rate(gyro_time), "gyro.csv"),
        Samples(accel_time, walk.force(accel_time), "accel.csv"),
        **options,
    )


def tracked(stamps, **options):
    position = walk.position(stamps)
    return Poses(stamps, walk.attitude(stamps), position, source="poses.csv", **options)


def test_a_slow_recording_comes_at_the_rate_that_is_asked_for():
    time = np.arange(800) / 40.0
    (sequence,) = assemble(imu(time, time, poses=tracked(time)), 200.0)
    np.testing.assert_allclose(np.diff(sequence.time), 1 / 200.0, rtol=1e-9)
    assert sequence.valid.all()


def test_at_ten_hertz_jitter_is_no_hole():
    """At 10.5 Hz two samples of a jittering clock lie more than 0.1 s apart half of the time."""
    rng = np.random.default_rng(3)
    time = np.arange(300) / 10.5 + rng.uniform(-0.02, 0.02, 300)
    (sequence,) = assemble(imu(time, time), 10.0)
    assert sequence.imu_valid is None
    holed = np.delete(time, np.s_[100:104])
    (sequence,) = assemble(imu(holed, holed), 10.0)
    assert sequence.imu_valid is not None and 2 <= (~sequence.imu_valid).sum() <= 6


CLOCK = np.arange(2000) / 100.0
GOOD = imu(CLOCK, CLOCK, poses=tracked(CLOCK))
AGAIN = np.concatenate([CLOCK[:1000], CLOCK[:1000] + 4.995])
COARSE = np.floor(CLOCK * 50) / 50
LEAP = np.where(CLOCK[:, None] == 3.0, 1e3, GOOD.gyro.values)


@pytest.mark.parametrize(
    ("streams", "words"),
    [
        (imu(20 * CLOCK, 20 * CLOCK), "gyro.csv: .* runs at 5 Hz, expected 10 to 2000 Hz"),
        (imu(AGAIN, CLOCK), r"gyro.csv: field 'time' jumps back by 5\.0\d s after"),
        (
            GOOD._replace(accel=GOOD.accel._replace(time=COARSE)),
            "accel.csv: field 'time' gives 1000 of 2000 rows",
        ),
        (GOOD._replace(accel=GOOD.accel._replace(time=CLOCK + 99.0)), "accel.csv: field"),
        (GOOD._replace(poses=tracked(CLOCK - 99.0)), "poses.csv: field"),
        (
            GOOD._replace(gyro=GOOD.gyro._replace(values=LEAP)),
            "gyro.csv: field 'gyro' is beyond 100 rad/s in 1 rows, first 3.000 s after the start",
        ),
    ],
)
def test_a_stream_that_cannot_be_is_refused_by_its_file(streams, words):
    with pytest.raises(InputError, match=f"^{words}"):
        assemble(streams, 100.0)


def test_samples_on_the_clock_stay_to_the_bit_and_who_contradicts_itself_is_not_valid():
    """A pose that contradicts its velocity spoils no neighbour."""
    time = np.round(5.0 + 0.99995 * np.arange(2000) / 100.0, 6)  # a clock that is a little fast
    velocity = walk.velocity(time)
    velocity[300] = 1e3
    streams = imu(time, time, poses=tracked(time, velocity=velocity))
    (sequence,) = assemble(streams, 100.0)
    np.testing.assert_array_equal(sequence.gyro, streams.gyro.values)
    np.testing.assert_array_equal(sequence.accel, streams.accel.values)
    valid = sequence.valid
    np.testing.assert_array_equal(np.flatnonzero(~valid), [300])
    np.testing.assert_array_equal(sequence.position[valid], walk.position(time)[valid])
    np.testing.assert_array_equal(sequence.velocity[valid], velocity[valid])


def test_waypoints_stand_in_the_place_of_poses_and_are_refused_where_a_pose_is_needed():
    time, tapped = np.arange(1500) / 50.0, np.array([2.0, 9.0, 17.0, 25.0])
    taps = Samples(tapped, walk.position(tapped)[:, :2], "taps")
    streams = imu(1.0 + time, 1.0 + time, waypoints=taps)
    (sequence,) = assemble(streams)
    assert sequence.waypoints is not None
    np.testing.assert_allclose(sequence.waypoints.time, [1.0, 8.0, 16.0, 24.0])
    np.testing.assert_array_equal(sequence.waypoints.position, taps.values)
    assert not sequence.valid.any()
    with pytest.raises(InputError, match=r"^walk: has waypoints, no poses"):
        windows.window_source([sequence], DataConfig(rate=50.0), 10)
    few = taps._replace(time=taps.time[:2], values=taps.values[:2])
    with pytest.raises(Refusal):
        assemble(streams._replace(waypoints=few))
    for wrong, problem in (
        ([1.0, 2.0], "are 2, at least 3"),
        ([1.0, 2.0, 2.0], "do not increase"),
        ([1.0, np.nan, 2.0], "not all finite"),
        ([1.0, 2.0, 99.0], "not all on the IMU's clock"),
    ):
        waypoints = Waypoints(np.array(wrong), np.zeros((len(wrong), 2)))
        with pytest.raises(InputError, match=f"^file: field 'waypoints' .*{problem}"):
            validate(sequence._replace(waypoints=waypoints), "file")


def level(time, tracked_at=None):
    """Somebody who walks straight on, with a pose wherever `tracked_at` is."""
    poses, velocity = None, np.array([1.0, 0.5, 0.0])
    if tracked_at is not None:
        position, same = np.outer(tracked_at, velocity), np.tile(velocity, (len(tracked_at), 1))
        poses = Poses(tracked_at, Rotation.identity(len(tracked_at)), position, same)
    still, up = np.zeros((len(time), 3)), np.tile([0, 0, 9.81], (len(time), 1))
    streams = Streams.of_imu("walk", "walk.csv", time, still, up)
    return streams._replace(attributes={"group": "someone"}, start=100.0, poses=poses)


def stamps(*spans):
    rows = (np.arange(round(100 * first), round(100 * last) + 1) for first, last in spans)
    return np.concatenate(list(rows)) / 100


def test_every_piece_with_a_window_is_kept_and_named():
    time = stamps((0, 5), (7, 7.5), (9, 10), (12, 20), (30, 34))
    # No whole window of the last piece has a reference.
    pose_time = time[(time < 30) | (time % 0.5 > 0.15)]
    with pytest.warns(UserWarning) as caught:
        pieces = assemble(level(time, np.append(pose_time, 34.0)), 100.0, divide=True)
    (message,) = (str(warning.message) for warning in caught)
    assert message.startswith("walk.csv: field 'time' has gaps longer than 1 s (4, up to 10.0 s)")
    assert "14.0 of 34.0 s, 3 of 5 pieces" in message
    assert [piece.name for piece in pieces] == ["walk_piece1", "walk_piece2", "walk_piece3"]
    config = DataConfig(rate=100.0)
    for piece, first, last in zip(pieces, (0, 9, 12), (5, 10, 20), strict=True):
        count = round(100 * (last - first)) + 1
        np.testing.assert_allclose(piece.time, np.arange(count) / 100, atol=1e-9)
        np.testing.assert_allclose(piece.position[:, 0], first + piece.time, atol=1e-9)
        start = pytest.approx(100.0 + first)
        attributes = {"group": "someone", "start_time": start, "recorded_rate": 100.0}
        assert piece.attributes == attributes
        # It holds at least the one window it was kept for.
        assert len(windows.window_source([piece], config, stride=10).start) >= 1
    # No estimate runs through a hole.
    prepared, short = evaluation.prepare(pieces, config)
    assert [sequence.name for sequence in prepared] == ["walk_piece1", "walk_piece3"]
    assert list(short) == ["walk_piece2"]
    assert all(np.diff(sequence.time).max() < 0.11 for sequence in prepared)
    with pytest.raises(InputError, match=r"^walk\.csv: field 'time' has a gap of 2\.000 s after 5"):
        assemble(level(time, time), 100.0)


@pytest.mark.filterwarnings("error")
def test_a_recording_without_a_long_gap_stays_one_and_without_a_window_is_refused():
    """In a hole of the IMU nothing is valid, although the tracker has poses there."""
    time = stamps((0, 5), (5.9, 9))
    (sequence,) = assemble(level(time, stamps((0, 9))), 100.0, divide=True)
    assert sequence.name == "walk" and len(sequence.time) == 901
    inside = (sequence.time > 5.001) & (sequence.time < 5.899)
    np.testing.assert_array_equal(sequence.imu_valid, ~inside)
    np.testing.assert_array_equal(sequence.valid, ~inside)
    # What nothing bridges, 0.9 s here, parts a window as a long gap does.
    time = stamps((0, 0.6), (1.5, 2.1), (5, 5.5))
    with pytest.raises(Refusal, match=r"^walk\.csv: .*\(1, up to 2\.9 s\), and no piece"):
        assemble(level(time, time), 100.0, divide=True)
    with pytest.raises(Refusal, match=r"^walk\.csv: no 1 s of it have an IMU and a reference"):
        assemble(level(stamps((0, 0.9))), 100.0)
