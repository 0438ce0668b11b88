"""Waypoints turned into poses: against computed walks whose truth is known, and taps that err."""

import numpy as np
import pytest

from gnio_jax.config import DataConfig, TrainConfig
from gnio_jax.data import loading
from gnio_jax.data.dataset import Refusal
from gnio_jax.data.waypoints import level_attitude, with_poses
from gnio_jax.numerics import rotations
from gnio_jax.reporting import Lines
from gnio_jax.training.recordings import read_split
from gnio_jax.training.windows import window_source
from gnio_jax.types import Waypoints
from tests.support.surveyor import RATE, survey


def off_truth(sequence, truth):
    """(angle, position, velocity) errors where the poses are valid: degrees, m, m/s."""
    valid = sequence.valid
    error = rotations(sequence.orientation[valid]) * rotations(truth.orientation[valid]).inv()
    flat = slice(None), slice(0, 2)
    return (
        np.degrees(error.magnitude()),
        np.linalg.norm((sequence.position - truth.position)[valid][flat], axis=1),
        np.linalg.norm((sequence.velocity - truth.velocity)[valid][flat], axis=1),
    )


@pytest.mark.parametrize("seed", range(2))
def test_taps_give_the_attitude_and_the_path(seed):
    walk = survey(seed)
    sequence = with_poses(walk.tapped(np.zeros(9)))
    angle, distance, speed = off_truth(sequence, walk.truth)
    # The phone is aimed up to some degrees beside the path, and the yaw is off by as much.
    assert np.median(angle) < 7.0 and angle.max() < 12.0
    # The surveyor's legs are bent, and the speed changes on them.
    assert np.sqrt((distance**2).mean()) < 0.9 and np.sqrt((speed**2).mean()) < 0.5
    inside = (sequence.time >= walk.ends[0]) & (sequence.time <= walk.ends[-1])
    assert (sequence.valid != inside).mean() < 0.01
    assert np.isnan(sequence.position[~sequence.valid]).all() and sequence.waypoints is not None
    assert sequence.attributes["yaw_residual_degrees"] < 6.0
    # A walker comes 1.1 m in a second that a tap is early or late, and 0.64 m (rms) in one that is
    # drawn uniformly.
    noisy_sequence = with_poses(walk.tapped(np.random.default_rng(seed).uniform(-1.0, 1.0, 9)))
    angle, distance, speed = off_truth(noisy_sequence, walk.truth)
    assert np.median(angle) < 9.0
    assert np.sqrt((distance**2).mean()) < 1.1 and np.sqrt((speed**2).mean()) < 0.6


def test_waypoints_that_nobody_walks_between_are_not_valid():
    """A tap that follows another after 0.2 s, 40 m away and back."""
    walk = survey(7)
    tapped = walk.tapped(np.zeros(9))
    time, position = tapped.waypoints
    time, position = (
        np.insert(time, 4, time[4] - 0.2),
        np.insert(position, 4, position[4] + 40.0, axis=0),
    )
    sequence = with_poses(tapped._replace(waypoints=Waypoints(time, position)))
    assert not sequence.valid[
        (sequence.time > time[3] + 0.05) & (sequence.time < time[5] - 0.05)
    ].any()
    _, distance, speed = off_truth(sequence, walk.truth)
    assert distance.max() < 2.0 and speed.max() < 2.0


def test_gravity_levels_a_gyro_that_drifts():
    truth = survey(5).truth
    biased = truth.gyro + np.array([0.01, -0.008, 0.0])  # 20° over the walk
    attitude = level_attitude(biased, truth.accel, 1 / RATE)
    up, true_up = (r.inv().apply([0.0, 0.0, 1.0]) for r in (attitude, rotations(truth.orientation)))
    tilt = np.degrees(np.arccos(np.clip((up * true_up).sum(axis=1), -1.0, 1.0)))
    assert np.median(tilt) < 1.5 and tilt.max() < 5.0


def test_a_tap_again_where_the_surveyor_stands_is_no_leg():
    """Nor has a sample a pose that was not measured."""
    walk = survey(6, pause=6.0)
    lost = (walk.truth.time > 5.0) & (walk.truth.time < 5.5)
    ends = np.sort(np.concatenate([walk.ends, walk.ends[[3, 6]] - 6.0]))
    tapped = walk._replace(ends=ends).tapped(np.zeros(11))
    sequence = with_poses(tapped._replace(imu_valid=~lost))
    assert not sequence.valid[lost].any()
    standing = (sequence.time > ends[3] + 0.05) & (sequence.time < ends[4] - 0.05)
    assert standing.any() and not sequence.valid[standing].any()
    angle, distance, _ = off_truth(sequence, walk.truth)
    assert np.median(angle) < 9.0 and distance.max() < 2.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda position: position[:, ::-1], "y axis is .*° off the median leg"),
        (lambda position: position * 10.0, "walked 0 of its 8 legs"),
    ],
)
def test_a_walk_whose_legs_do_not_fit_the_phone_is_refused(change, words):
    tapped = survey(2).tapped(np.zeros(9))
    waypoints = tapped.waypoints._replace(position=change(tapped.waypoints.position))
    with pytest.raises(Refusal, match=f"^survey 2: .*{words}"):
        with_poses(tapped._replace(waypoints=waypoints))


def test_training_cuts_windows_from_such_walks_and_leaves_out_the_others(monkeypatch, capsys):
    good, bad = (survey(seed).tapped(np.zeros(9)) for seed in (0, 1))
    time, position = bad.waypoints
    bad = bad._replace(waypoints=Waypoints(time, 0.0 * position))
    monkeypatch.setattr(loading, "read_split", lambda *_: iter([bad, good]))
    config, samples = TrainConfig(data=DataConfig(rate=100.0)), {}
    (read,) = read_split(config, "synthetic", "train", Lines(), 1, samples)
    assert read.name == "survey 0" and [*samples] == ["survey 0"]
    assert "warning: survey 1: somebody walked 0 of its 8 legs" in capsys.readouterr().err
    source = window_source([read], config.data, 100)
    assert len(source.start) > 30
    # A second of walking, in the frame of each window.
    far = np.linalg.norm(source.displacement[:, :2], axis=1) * 100 / config.data.window
    assert 0.8 < np.median(far) < 1.5
