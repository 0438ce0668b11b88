"""Real recordings of every dataset that may be had must be physical: one table of bounds."""

import warnings
from typing import NamedTuple

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.self_check import check_sequence
from gnio_jax.numerics import rotations


class Bounds(NamedTuple):
    """What the self-check may find, and what the attributes say within a margin."""

    correlation: float  # of the horizontal accelerations, at least
    degrees: float  # of the gyro in 10 s, at most
    speed: tuple[float, float]  # of the median, m/s
    gravity: float  # m/s² by which the mean of R·accel may be off
    valid: float  # share of the samples, at least
    seconds: tuple[float, float]
    attributes: dict[str, tuple[float, float]] = {}


HALL = Bounds(0.92, 1.8, (0.5, 1.2), 0.12, 0.95, (20.0, 500.0))
ROOM = Bounds(0.9, 1.0, (0.3, 1.3), 0.15, 0.88, (80.0, 150.0))
GOLDEN = ROOM._replace(correlation=0.8, gravity=0.08)
FLIGHT = Bounds(0.99, 1.5, (2.0, 3.5), 0.3, 0.9, (29.9, 91.1), {})
DRIVE = Bounds(0.6, 1.0, (5.0, 16.0), 0.03, 0.95, (30.0, 60.0))
HELD = Bounds(0.9, 3.0, (0.2, 3.0), 0.5, 0.5, (115.0, 125.0), {"lag": (0.0, 0.05)})


def carried(yaw: float, lever: float) -> Bounds:
    """The phone on the marker body of OxIOD."""
    attributes = {"extrinsic_yaw_degrees": (yaw, 1.0), "lever_y": (lever, 0.01)}
    return HALL._replace(attributes=attributes | {"accel_residual": (0.06, 0.06)})


REAL = {
    ("oxiod", "sessions_train", "handheld_data1_7", "raw"): carried(-169, 0.062),
    ("oxiod", "sessions_train", "multi-users_user3_5", "syn"): carried(-174.7, 0.106),
    ("oxiod", "sessions_test", "multi-devices_nexus-5_7", "raw"): carried(-173.6, 0.056),
    ("euroc", "train", "V1_01_easy", ""): ROOM,
    ("euroc", "val", "V1_02_medium", ""): ROOM._replace(correlation=0.98),
    ("euroc", "test", "MH_04_difficult", ""): ROOM._replace(correlation=0.6),
    ("euroc", "unseen", "V2_01_easy", ""): ROOM,
    ("tumvi", "val", "room3", ""): ROOM._replace(correlation=0.98),
    ("tumvi", "test", "room4", ""): ROOM._replace(correlation=0.98),
    ("tlio", "train", "room1", ""): GOLDEN,
    ("tlio", "val", "V2_01_easy", ""): GOLDEN,
    ("tlio", "test", "MH_04_difficult", ""): GOLDEN._replace(correlation=0.65),
    **{
        ("blackbird", split, f"clover_yawForward_maxSpeed5p0_{split}", ""): FLIGHT
        for split in ("train", "val", "test")
    },
    ("kitti", "train", "2011_09_26_drive_0014_extract0", ""): DRIVE,
    ("kitti", "train", "2011_09_26_drive_0036_extract2", ""): DRIVE,
    ("kitti", "test", "2011_09_26_drive_0051_extract0", ""): DRIVE,
    ("tyrex", "all", "Guillaume_Nexus5_Dist_AR", ""): HELD,
    ("tyrex", "all", "Thibaud_iPhone5_NoDist_RunningHand", ""): HELD,
    ("ridi", "all", "01", ""): Bounds(0.55, 2.0, (1.2, 1.6), 0.1, 0.99, (54.7, 54.9)),
}
"""(dataset, split, recording, form) -> what it must show."""
FOLDERS = {"ridi": "kiod", "tlio": "tlio_layout"}


def cases():
    """One of every dataset is among the quick tests."""
    quick = {real[0]: real for real in reversed(REAL)}
    for real in REAL:
        yield pytest.param(real, marks=() if quick[real[0]] == real else pytest.mark.slow)


@pytest.mark.recordings
@pytest.mark.parametrize("real", [*cases()], ids="-".join)
def test_a_real_recording_is_physical(recordings, real):
    name, split, walk, form = real
    root, dataset, bounds = recordings / FOLDERS.get(name, name), data.get(name), REAL[real]
    if not root.is_dir():
        pytest.skip(f"real recordings: no {root.name}/")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        recording = {source.name: source for source in dataset.recordings(root, split)}[walk]
        if form == "syn":
            recording = recording.fallback or recording  # some walks have this form alone
        pieces = recording.read()
    checks = [check_sequence(piece, dataset) for piece in pieces]
    assert [check.failures for check in checks] == [()] * len(pieces)
    sequence, check = max(zip(pieces, checks, strict=True), key=lambda pair: pair[1].duration)
    assert check.rate == pytest.approx(dataset.rate, rel=1e-3)
    assert bounds.seconds[0] < check.duration < bounds.seconds[1]
    np.testing.assert_allclose(check.gravity_mean, [0, 0, 9.81], atol=bounds.gravity)
    assert check.gyro_consistency_degrees < bounds.degrees
    assert check.accel_correlation_horizontal > bounds.correlation
    assert bounds.speed[0] < check.median_speed < bounds.speed[1]
    assert check.share_valid > bounds.valid
    for attribute, (value, margin) in bounds.attributes.items():
        assert sequence.attributes[attribute] == pytest.approx(value, abs=margin)
    valid = sequence.valid
    # A runner's hand is too fast for differences of 100 Hz, a phone's own odometry and a satellite
    # receiver step, and the files of TLIO have velocities of their own.
    if name not in ("tyrex", "ridi", "tlio", "kitti"):
        # The velocities are those of the positions.
        whole = valid[2:] & valid[1:-1] & valid[:-2]
        differenced = (sequence.position[2:] - sequence.position[:-2]) * check.rate / 2
        error = np.linalg.norm(differenced - sequence.velocity[1:-1], axis=1)[whole]
        assert np.percentile(error, 99) < 0.05
    slower = check_sequence(data.resample(sequence, check.rate / 2), dataset)
    assert slower.failures == () and slower.rate == pytest.approx(check.rate / 2, rel=1e-3)
    turned = check.gyro_consistency_degrees
    assert slower.gyro_consistency_degrees == pytest.approx(turned, abs=0.1)
    if sequence.device_orientation is not None:
        # Delayed or mirrored truth would show here: the phone's up is that of the reference.
        device, reference = sequence.device_orientation[valid], sequence.orientation[valid]
        up, device_up = (
            rotations(attitude).inv().apply([0.0, 0.0, 1.0]) for attitude in (reference, device)
        )
        angle = np.degrees(np.arccos(np.clip((device_up * up).sum(axis=1), -1, 1)))
        assert np.median(angle) < 4


@pytest.mark.recordings
def test_a_real_walk_with_waypoints_is_physical(recordings):
    root, dataset = recordings / "indoor_location", data.get("indoor_location")
    if not root.is_dir():
        pytest.skip("real recordings: no indoor_location/")
    for recording in dataset.recordings(root, "val")[:5]:
        (sequence,) = recording.read()
        check = check_sequence(sequence, dataset)
        assert check.failures == () and 0.3 < check.median_speed < 1.6
        assert np.linalg.norm(check.gravity_mean) == pytest.approx(9.81, abs=0.3)
