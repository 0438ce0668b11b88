"""`gnio track` of a car: what a drive shows of itself, the path without and with fixes, and what it
says where it knows too little."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax.apps import drive
from gnio_jax.apps.importing import Imported
from gnio_jax.apps.track import track
from gnio_jax.data.geodesy import Place, geodetic
from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.data.resampling import resample
from gnio_jax.errors import InputError
from gnio_jax.evaluation.trajectory import read_tum
from gnio_jax.filtering import make_filter
from gnio_jax.types import Readings, Sequence
from tests.support import cars

CONFIG = configuration.load("drive")
ORIGIN = Place(48.0, 9.0, 300.0)


def recording(first=0.0, fixes=None, mounting=(0.5, 0.1, -0.2)):
    """A drive without a reference. `fixes` says at which whole seconds there is one, with an error
    of 2 m that changes in 20 s."""
    time, gyro, accel, _, position = cars.city_drive(mounting, first)
    readings = {}
    if fixes is not None:
        stamps = np.arange(1.0, time[-1])
        stamps = stamps[[fixes(stamp) for stamp in stamps]]
        random, error = np.random.default_rng(1), [np.zeros(2)]
        for _ in stamps[1:]:
            error.append(0.95 * error[-1] + 2.0 * np.sqrt(1 - 0.95**2) * random.normal(size=2))
        true = np.stack([np.interp(stamps, time, axis) for axis in position.T], axis=1)
        true[:, :2] += error
        values = geodetic(true, ORIGIN)
        readings["gnss"] = Readings(stamps, values, np.full_like(values, 3.0))
    unknown = np.full((len(time), 3), np.nan)
    return Sequence(
        name="drive",
        time=time,
        gyro=gyro,
        accel=accel,
        orientation=np.full((len(time), 4), np.nan),
        position=unknown,
        velocity=unknown,
        valid=np.zeros(len(time), dtype=bool),
        attributes={},
        readings=readings,
    )


@pytest.fixture(autouse=True)
def _undrawn(undrawn):
    """Without pictures."""


def tracked(sequence, folder):
    return track(Imported(sequence, (), ()), CONFIG, folder / "track")


def truth(time, first=0.0):
    stamps, *_, position = cars.city_drive(first=first)
    return np.stack([np.interp(time, stamps, axis) for axis in position.T], axis=1)


def test_stops_and_bias_are_seen_through_the_shaking_of_an_engine():
    sequence = recording()
    stops = drive.find_stops(sequence, cars.RATE, make_filter(CONFIG.data, CONFIG.filter))
    standing = [second < 8 or 40 <= second < 46 for second in range(len(stops.still))]
    assert np.array_equal(stops.still, standing)
    np.testing.assert_allclose(stops.gyro_bias, cars.BIAS, atol=2e-3)
    moving = recording(first=15.0)
    moving = moving._replace(**{part: getattr(moving, part)[:2000] for part in ("time", "gyro")})
    moving = moving._replace(accel=moving.accel[:2000])
    stops = drive.find_stops(moving, cars.RATE, make_filter(CONFIG.data, CONFIG.filter))
    assert not stops.still.any() and not stops.gyro_bias.any()


def test_a_hole_of_the_imu_is_no_stop():
    """The samples on a line across it look like rest."""
    sequence = recording()
    measured = np.ones(len(sequence.time), dtype=bool)
    measured[150:270] = False
    ekf = make_filter(CONFIG.data, CONFIG.filter)
    stops = drive.find_stops(sequence._replace(imu_valid=measured), cars.RATE, ekf)
    assert np.array_equal(np.flatnonzero(stops.still[:8]), [0, 3, 4, 5, 6, 7])


def test_stops_are_seen_at_rates_that_are_no_multiple_of_ten(tmp_path):
    """All but the first second, whose first samples have no mean over the engine's period."""
    sequence = recording(fixes=lambda stamp: True)
    unshaken = dict(zip(("gyro", "accel"), averaged(sequence), strict=True))
    result = tracked(resample(sequence._replace(**unshaken), 52.0), tmp_path)
    assert any(note.startswith("car: it stands for 13 s") for note in result.summary.notes)
    assert result.summary.warnings == ()


@pytest.mark.parametrize("rate", [52.0, 33.3, 9.5, 8.0])
def test_seconds_of_stops_are_those_of_the_clock_at_any_rate(rate):
    """Also where a tenth of a second is no whole number of samples, or less than one."""
    sequence = recording()
    unshaken = dict(zip(("gyro", "accel"), averaged(sequence), strict=True))
    ekf = make_filter(CONFIG.data, CONFIG.filter)
    slow = resample(sequence._replace(**unshaken), rate)
    stops = drive.find_stops(slow, rate, ekf)
    assert len(stops.still) == int(len(slow.time) / rate)
    standing = np.flatnonzero(stops.still)
    inside = {*range(1, 7), *range(41, 45)}
    assert inside <= set(standing) <= inside | {0, 7, 40, 45}
    np.testing.assert_allclose(stops.gyro_bias, cars.BIAS, atol=2e-3)
    measured = np.arange(len(slow.time)) != round(3.5 * rate)
    without = drive.find_stops(slow._replace(imu_valid=measured), rate, ekf)
    assert set(standing) - set(np.flatnonzero(without.still)) == {3}
    short = slow._replace(**{part: getattr(slow, part)[:5] for part in ("time", "gyro", "accel")})
    assert not drive.find_stops(short, rate, ekf).still.any()


def averaged(sequence):
    """Gyro and accelerometer without the shaking of the engine, whose period is four samples."""
    mean = np.full(4, 0.25)
    return (
        np.apply_along_axis(np.convolve, 0, np.pad(signal, ((2, 1), (0, 0)), "edge"), mean, "valid")
        for signal in (sequence.gyro, sequence.accel)
    )


def test_a_drive_from_rest_has_its_path_and_no_error_without_fixes(tmp_path):
    result = tracked(recording(), tmp_path)
    path, summary = result.estimate.trajectory, result.summary
    true = truth(path.time)
    way = np.linalg.norm(np.diff(true, axis=0), axis=1).sum()
    # The world's yaw is that of the phone at the start, which is turned in the car.
    turn = Rotation.from_euler("ZYX", [0.5, 0.1, -0.2]).inv().as_matrix()
    yaw = np.arctan2(turn[1, 0], turn[0, 0])
    aligned = Rotation.from_euler("z", yaw).apply(path.position)
    error = np.linalg.norm((aligned - true)[:, :2], axis=1)
    assert way > 350 and error[-1] < 0.03 * way
    assert np.isnan(summary.expected_error) and summary.carrier == "car"
    assert summary.warnings[0].startswith("car: no fixes are used, so no error can be stated")
    assert summary.at_rest == pytest.approx(14 / 70, abs=0.04)
    assert any(note.startswith("mounting: yaw 2") for note in summary.notes)
    written = json.loads((result.folder / "summary.json").read_text(encoding="utf-8"))
    assert written["carrier"] == "car" and "expected_error" not in written


def test_fixes_lead_through_their_gap_and_give_the_start_of_a_moving_car(tmp_path):
    """The second drive begins at 11 m/s."""
    for first, gap in ((0.0, (22.0, 36.0)), (15.0, (15.0, 24.0))):
        folder = tmp_path / f"{first:g}"
        folder.mkdir()
        fixes = lambda stamp, gap=gap: not gap[0] < stamp < gap[1]  # noqa: E731
        result = tracked(recording(first, fixes), folder)
        path, summary = result.estimate.trajectory, result.summary
        true = truth(path.time, first)[:, :2]
        east_north = path.position[:, :2] + true[0] - path.position[0, :2]
        error = np.linalg.norm(east_north - true, axis=1)
        hidden = (path.time > gap[0]) & (path.time < gap[1])
        assert error.max() < 12.0 and error[hidden].max() < 12.0
        assert 1.0 < summary.expected_error < 10.0 and summary.warnings == ()
        (use,) = summary.sensors
        assert use.sensor == "gnss" and use.accepted > 0.95
        if first:
            (note,) = (note for note in summary.notes if "its first fixes show" in note)
            assert float(note.split()[-2]) == pytest.approx(11.0, abs=5.0)


def test_a_moving_car_without_fixes_says_that_its_speed_is_unknown(tmp_path):
    summary = tracked(recording(first=15.0), tmp_path).summary
    assert any("nothing shows its speed, so the path is wrong" in text for text in summary.warnings)


def test_a_drive_that_shows_no_mounting_needs_fixes(tmp_path):
    """It goes straight on at one speed."""
    time, still = np.arange(0.0, 60.0, 0.01), recording()
    shape = (len(time), 3)
    straight = still._replace(
        time=time,
        gyro=np.zeros(shape),
        accel=np.tile([0.0, 0.0, 9.81], (len(time), 1)),
        orientation=np.full((len(time), 4), np.nan),
        position=np.full(shape, np.nan),
        velocity=np.full(shape, np.nan),
        valid=np.zeros(len(time), dtype=bool),
    )
    with pytest.raises(InputError, match="drive: "):
        tracked(straight, tmp_path)
    assert not (tmp_path / "track").exists()
    with pytest.raises(InputError, match="give --carrier FILE"):
        tracked(first_seconds(still, 12.0), tmp_path)


def first_seconds(sequence, seconds):
    rows = sequence.time < seconds
    parts = {k: v[rows] for k, v in sequence._asdict().items() if isinstance(v, np.ndarray)}
    return sequence._replace(**parts)


def test_a_mounting_of_the_settings_is_taken(tmp_path):
    """12 s are too short to find it. Roll is not stated, so it is zero."""
    angles = "filter.measurements.nonholonomic={lateral_std: 1.0, yaw: 0.5, pitch: 0.1}"
    config = configuration.assign(CONFIG, [angles])
    short = first_seconds(recording(mounting=(0.5, 0.1, 0.0)), 12.0)
    result = track(Imported(short, (), ()), config, tmp_path / "track")
    assert "mounting: yaw 29°, pitch 6°, roll 0° (of the settings)" in result.summary.notes
    path = result.estimate.trajectory
    way = np.linalg.norm(truth(path.time)[-1])
    assert np.linalg.norm(path.position[-1]) == pytest.approx(way, rel=0.1)


def test_a_fix_kilometres_off_does_not_give_the_speed_of_the_start(tmp_path):
    sequence = recording(first=15.0, fixes=lambda stamp: True)
    fixes = sequence.readings["gnss"]
    right = drive.first_speed(fixes, 0.0)
    assert right == pytest.approx(11.0, abs=5.0)
    for row in range(5):
        values = fixes.values.copy()
        values[row, 0] += 0.05
        speed = drive.first_speed(fixes._replace(values=values), 0.0)
        assert speed == pytest.approx(right, abs=7.0)
    two = Readings(fixes.time[:3:2], values[3:5], fixes.std[:2])
    assert drive.first_speed(two, 0.0) is None


def test_only_a_path_without_fixes_is_wrong_for_its_unknown_speed(tmp_path):
    summary = tracked(recording(15.0, lambda stamp: stamp > 8), tmp_path).summary
    assert any("nothing shows its speed" in note for note in summary.notes)
    assert np.isfinite(summary.expected_error) and summary.warnings == ()


def test_a_car_that_never_stands_says_that_nothing_shows_the_bias(tmp_path):
    """Its gyro is raw, so the bias may be large."""
    moving = first_seconds(recording(15.0, lambda stamp: stamp < 24), 24.0)
    moving = moving._replace(attributes={"imu_compensated": "no"})
    moving = moving._replace(gyro=moving.gyro - cars.BIAS)
    result = tracked(moving, tmp_path)
    assert any(text.startswith("gyro: no stop") for text in result.summary.warnings)
    assert result.summary.expected_error > 5.0


def test_a_drive_is_recognised_by_its_fixes_alone():
    with_fixes = recording(fixes=lambda stamp: True)
    assert drive.is_drive(with_fixes, with_fixes.readings)
    assert not drive.is_drive(with_fixes, {})
    slow = with_fixes.readings["gnss"]._replace(time=6 * with_fixes.readings["gnss"].time)
    assert not drive.is_drive(with_fixes, {"gnss": slow})
    fixes = with_fixes.readings["gnss"]
    still = np.tile(fixes.values[0], (len(fixes.time), 1))
    still[20, 0] += 0.05
    assert not drive.is_drive(with_fixes, {"gnss": fixes._replace(values=still)})
    noise = np.random.default_rng(2).normal(size=(600, 3)) * 3.0
    often = Readings(np.arange(1.0, 61.0, 0.1), geodetic(noise, ORIGIN), np.full((600, 3), 3.0))
    assert not drive.is_drive(with_fixes, {"gnss": often})
    steps = np.arange(0.0, 30.0, 0.01)
    walk = with_fixes._replace(
        time=steps,
        gyro=np.sin(2 * np.pi * 0.9 * steps)[:, None] * [0.5, 1.0, 0.3],
        accel=[0.0, 0.0, 9.81] + np.sin(2 * np.pi * 1.8 * steps)[:, None] * [0.5, 1.0, 3.0],
    )
    assert not drive.is_drive(walk, with_fixes.readings)


def test_the_command_takes_a_car_or_recognises_it(tmp_path, gnio, mistake):
    file, settings = tmp_path / "drive.hdf5", tmp_path / "van.yaml"
    write_hdf5(file, recording(fixes=lambda stamp: True))
    out = tmp_path / "out"
    output = gnio("track", file, "--out", out, "--format", "geojson")
    assert "tracked as a car" in output and "by no network" in output
    assert (
        "expected error at the end" in output
        and "start: " not in output
        and "warning" not in output
    )
    assert (out / "trajectory.geojson").exists() and len(read_tum(out / "trajectory.txt").time)
    settings.write_text("data: {rate: 100.0, window_seconds: 0.2}\nfilter: {rest_gyro: -1}\n")
    assert "rest_gyro" in mistake("track", file, "--carrier", settings, "--out", tmp_path / "b")
    message = mistake("track", file, "--carrier", "boat", "--out", tmp_path / "b")
    assert message.startswith("--carrier: 'boat' is neither person nor car, and no such file; give")
    message = mistake("track", file, "--carrier", "pedestrian", "--out", tmp_path / "b")
    assert "no filter of a car; write it as configs/drive.yaml" in message
    message = mistake("track", file, "--carrier", "car", "--network", "pedestrian")
    assert "leave it out with --carrier car" in message
    assert not (tmp_path / "b").exists()


def angle_between(a, b):
    return np.degrees(np.arccos(np.clip(a @ b / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def test_the_start_of_a_standing_car_is_that_of_its_stop():
    start = drive.estimate_drive(recording(), {}, CONFIG).ready.start
    assert start.std.velocity == drive.STOP_SPEED and start.std.gyro_bias == drive.STOP_BIAS
    assert start.std.tilt == pytest.approx(CONFIG.filter.start.accel_bias / 9.80665, rel=0.01)
    np.testing.assert_allclose(start.gyro_bias, cars.BIAS, atol=2e-3)
    up = Rotation.from_quat(cars.city_drive()[3][0], scalar_first=True).as_matrix()[2]
    assert angle_between(start.rotation[2], up) < 0.5 and not start.velocity.any()


@pytest.mark.parametrize("raw, std", [("no", 0.1), ("yes", CONFIG.filter.start.gyro_bias)])
def test_the_start_of_a_moving_car_is_level_by_its_mounting(raw, std, monkeypatch):
    """In a bend, where the mean force leans; the yaw of the world is that of the phone, and the
    velocity is ahead."""
    moving = first_seconds(recording(15.0, lambda stamp: stamp < 24), 24.0)
    readings = {"gnss": moving.readings["gnss"]}
    moving = moving._replace(attributes={"imu_compensated": raw}, gyro=moving.gyro - cars.BIAS)
    starts = []

    def fuse(first, ready, *others):
        starts.append((ready, others))
        raise InterruptedError

    monkeypatch.setattr(drive.sensors, "fuse", fuse)
    with pytest.raises(InterruptedError):
        drive.estimate_drive(moving, readings, CONFIG)
    ((ready, (*_, first_fixes)),) = starts
    start = ready.start
    assert first_fixes == drive.FIRST_FIXES
    assert start.std.gyro_bias == std and start.std.tilt == drive.ROAD_STD
    body = Rotation.from_quat(cars.city_drive(first=15.0)[3][0], scalar_first=True).as_matrix()
    assert angle_between(start.rotation[2], body[2]) < 2 * np.degrees(drive.ROAD_STD)
    assert abs(np.arctan2(start.rotation[1, 0], start.rotation[0, 0])) < 1e-6
    car = body @ Rotation.from_euler("ZYX", (0.5, 0.1, -0.2)).as_matrix()
    assert angle_between(start.rotation.T @ start.velocity, body.T @ car[:, 0]) < 3.0


def test_a_hole_that_is_too_long_is_refused_before_anything_is_written(tmp_path):
    whole = recording()
    measured = np.ones(len(whole.time), dtype=bool)
    measured[2000:2500] = False
    with pytest.raises(InputError, match="gap of 5"):
        tracked(whole._replace(imu_valid=measured), tmp_path)
    assert not (tmp_path / "track").exists()


def test_a_magnetometer_in_a_car_is_left_out_once():
    whole = recording()
    time = whole.time[::10]
    field = Readings(time, np.tile([20.0, 0, -40], (len(time), 1)), np.full((len(time), 3), np.nan))
    (use,) = drive.estimate_drive(whole, {"magnetometer": field}, CONFIG).uses
    assert use.accepted is None and "its steel" in use.text
