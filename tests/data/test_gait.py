"""The seconds in which somebody walks, of computed signals and of all real recordings."""

import warnings
from functools import partial

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.gait import NO_WALK, detect_gait
from tests.support import known_walk

GRAVITY = 9.81


def noise(time, seed, accel, gyro):
    """White noise on a device at rest."""
    random = np.random.default_rng(seed)
    force = np.array([0.0, 0.0, GRAVITY]) + random.normal(0.0, accel, (len(time), 3))
    return random.normal(0.0, gyro, (len(time), 3)), force


def walk(time):
    return known_walk.rate(time), known_walk.force(time)


def ride(time):
    """A car: bends and thrusts of some seconds each, on a road that shakes at random."""
    gyro, accel = noise(time, 1, 0.4, 0.03)
    phases = np.random.default_rng(2).uniform(0, 2 * np.pi, 12)
    slow = sum(np.sin(2 * np.pi * time / (4 + 3 * k) + phase) for k, phase in enumerate(phases))
    gyro[:, 2] += 0.1 * slow
    accel[:, 0] += 0.7 * slow
    return gyro, accel


def vibration(time, hertz, size=3.0):
    """A shaft that shakes and turns the device, always in the same way."""
    gyro, accel = noise(time, 3, 0.05, 0.01)
    wave = np.sin(2 * np.pi * hertz * time)[:, None]
    return gyro + 0.5 * wave, accel + size * wave


def run(time):
    gyro, accel = walk(time)
    return gyro, accel * (1.0 + 0.9 * np.sin(2 * np.pi * 2.8 * time))[:, None]


KINDS = {
    "walk": (walk, 1.0, 0.0, 0.0),
    "run": (run, 1.0, 1.0, 0.0),
    "ride": (ride, 0.0, 0.0, 0.0),
    "table": (partial(noise, seed=4, accel=0.02, gyro=0.002), 0.0, 0.0, 1.0),
    "hand": (partial(noise, seed=5, accel=0.2, gyro=0.1), 0.0, 0.0, 0.0),
    "shaken at random": (partial(noise, seed=6, accel=6.0, gyro=1.0), 0.0, 0.0, 0.0),
    "shaft of 4 Hz": (partial(vibration, hertz=4.0), 0.0, 0.0, 0.0),
    "shaft of 9 Hz": (partial(vibration, hertz=9.0), 0.0, 0.0, 0.0),
}
"""Signals, and the shares of the seconds that are within a walk, run, and quiet."""


@pytest.mark.parametrize("name", KINDS)
def test_the_kind_of_motion_is_told_at_any_rate_and_on_any_side(name):
    signals, *shares = KINDS[name]
    for rate in (50.0, 100.0, 203.0):
        gyro, accel = signals(np.arange(0.0, 40.0, 1 / rate))
        turned = Rotation.from_rotvec([0.4, -1.3, 2.0])
        for axes in (Rotation.identity(), turned):
            gait = detect_gait(axes.apply(gyro), axes.apply(accel), rate)
            assert [np.shape(seconds) for seconds in gait] == 3 * [(40,)]
            assert [seconds.mean() for seconds in gait] == pytest.approx(shares, abs=0.03)
            assert gait.has_steps == (shares[0] > 0)


def test_a_step_shakes_and_turns_the_device():
    """A device that only bounces, and one of which one sensor alone repeats itself, do not walk."""
    time = np.arange(0.0, 40.0, 0.01)
    wave = np.sin(2 * np.pi * 1.8 * time)[:, None] * [1.0, 0.0, 0.0]
    turning, force = noise(time, 7, 2.0, 0.7)
    steady = noise(time, 8, 0.05, 0.02)
    bounce = steady[1] + 2.0 * wave[:, [1, 2, 0]]
    assert detect_gait(steady[0] + wave, bounce, 100.0).walking.all()
    assert not detect_gait(steady[0] + 0.08 * wave, bounce, 100.0).walking.any()
    assert not detect_gait(turning + wave, force, 100.0).walking.any()
    assert not detect_gait(turning, force + 3.0 * wave, 100.0).walking.any()


def test_a_slow_logger_shows_steps_too():
    gait = detect_gait(*walk(np.arange(0.0, 40.0, 0.1)), rate=10.0)
    assert gait.walking.all() and not detect_gait(*ride(np.arange(0.0, 40.0, 0.1)), 10.0).has_steps


def test_a_walk_between_two_rides_is_found_within_ten_seconds():
    time = np.arange(0.0, 60.0, 0.01)
    parts = zip(ride(time), walk(time), ride(time), strict=True)
    walking = detect_gait(*(np.concatenate(part) for part in parts), rate=100.0).walking
    assert walking[65:115].all() and not walking[:50].any() and not walking[130:].any()


def test_what_was_not_measured_shows_no_steps():
    time = np.arange(0.0, 60.0, 0.01)
    (gyro, accel), valid = walk(time), np.ones(len(time), bool)
    valid[2000:4500] = False
    assert detect_gait(gyro, accel, 100.0).walking.all()
    walking = detect_gait(gyro, accel, 100.0, valid).walking
    assert walking[:20].all() and walking[45:].all() and not walking[30:35].any()


def test_a_recording_of_less_than_a_window_is_not_judged():
    gait = detect_gait(*ride(np.arange(0.0, 3.9, 0.01)), rate=100.0)
    assert not len(gait.walking) and gait.has_steps


def share(gyro, accel, rate, valid=None):
    """Of the seconds that are within a walk."""
    return float(detect_gait(gyro, accel, rate, valid).walking.mean())


READ = {
    ("brisk", "ridi", "all", ""): (0.95, 1.0),
    ("kiod", "ridi", "all", ""): (0.95, 1.0),
    ("indoor_location", "indoor_location", "test", ""): (0.7, 1.0),
    ("tumvi", "tumvi", "val", ""): (NO_WALK, 1.0),  # in a room, with a rig in both hands
    ("kitti", "kitti", "test", ""): (0.0, 0.0),
    ("euroc", "euroc", "test", ""): (0.0, 0.05),
    ("euroc", "euroc", "val", ""): (0.0, 0.05),
    ("blackbird", "blackbird", "train", ""): (0.0, NO_WALK),
    ("tyrex", "tyrex", "all", "Thibaud_Nexus5_NoDist_Texting"): (0.9, 1.0),
    ("tyrex", "tyrex", "all", "Thibaud_Nexus5_NoDist_Phoning"): (0.9, 1.0),
    ("tyrex", "tyrex", "all", "Guillaume_iPhone5_NoDist_FrontPocket"): (0.8, 1.0),
    ("tyrex", "tyrex", "all", "Guillaume_Nexus5_NoDist_BackPocket"): (0.8, 1.0),
    ("tyrex", "tyrex", "all", "Guillaume_iPhone4S_NoDist_Swinging"): (0.9, 1.0),
    ("tyrex", "tyrex", "all", "Thibaud_iPhone5_NoDist_AR"): (0.0, 0.05),  # stands
}
"""(folder, dataset, split, recording) -> the least and the largest share within a walk."""
SHORTEST = 8.0
"""s: shorter pieces of a drive show little of it."""


@pytest.mark.recordings
@pytest.mark.parametrize("real", READ, ids=" ".join)
def test_people_walk_and_vehicles_do_not(recordings, real):
    folder, name, split, recording = real
    if not (recordings / folder).is_dir():
        pytest.skip(f"real recordings: no {folder}/")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        sources = data.get(name).recordings(recordings / folder, split)
        chosen = [source for source in sources if recording in (source.name, "")][:6]
        sequences = [sequence for source in chosen for sequence in source.read()]
    shares = {
        sequence.name: share(
            sequence.gyro,
            sequence.accel,
            1.0 / float(np.median(np.diff(sequence.time))),
            sequence.imu_valid,
        )
        for sequence in sequences
        if np.ptp(sequence.time) > SHORTEST
    }
    low, high = READ[real]
    assert shares and all(low <= value <= high for value in shares.values()), shares


CARRIED = {
    "handheld": (0.95, 1.0),
    "pocket": (0.95, 1.0),
    "multi users": (0.95, 1.0),
    "large scale": (0.95, 1.0),
    "running": (0.95, 1.0),
    "trolley": (0.0, 0.0),
}
"""Folder of OxIOD -> the least and the largest share within a walk."""


@pytest.mark.recordings
@pytest.mark.parametrize("folder", CARRIED)
def test_every_way_of_carrying_shows_steps_and_a_trolley_does_not(recordings, folder):
    paths = sorted(recordings.glob(f"oxiod/*/{folder}/*/syn/imu*.csv"))
    if not paths:
        pytest.skip(f"real recordings: no oxiod/*/{folder}")
    low, high = CARRIED[folder]
    for path in paths:
        table = pd.read_csv(path, header=None).to_numpy(float)  # 100 Hz, rad/s and g
        accel = 9.81 * (table[:, 7:10] + table[:, 10:13])
        assert low <= share(table[:, 4:7], accel, 100.0) <= high, path


@pytest.mark.recordings
@pytest.mark.parametrize(("hand", "runs"), [("RunningHand", True), ("Texting", False)])
def test_who_runs_is_told_from_who_walks(recordings, hand, runs):
    if not (recordings / "tyrex").is_dir():
        pytest.skip("real recordings: no tyrex/")
    name = f"Thibaud_Nexus5_NoDist_{hand}"
    sources = {s.name: s for s in data.get("tyrex").recordings(recordings / "tyrex", "all")}
    sequence = max(sources[name].read(), key=lambda piece: len(piece.time))
    rate = 1.0 / float(np.median(np.diff(sequence.time)))
    running = detect_gait(sequence.gyro, sequence.accel, rate, sequence.imu_valid).running.mean()
    assert running > 0.9 if runs else running < 0.01


@pytest.mark.recordings
def test_a_phone_in_a_car_has_no_steps(recordings):
    folders = [*recordings.glob("comma2k19/**/processed_log/IMU")]
    if not folders:
        pytest.skip("real recordings: no comma2k19/")
    streams = [
        (np.load(folders[0] / name / "t"), np.load(folders[0] / name / "value"))
        for name in ("gyro", "accelerometer")
    ]
    time = np.arange(max(t[0] for t, _ in streams), min(t[-1] for t, _ in streams), 0.01)
    gyro, accel = (
        np.stack([np.interp(time, t, axis) for axis in values.T], axis=1) for t, values in streams
    )
    assert share(gyro, accel, 100.0) == 0.0
