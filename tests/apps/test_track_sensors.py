"""`gnio track` with magnetometer, barometer and receiver: what each does for a walk that is known,
and what wrong readings do not do."""

import dataclasses
import json
import xml.etree.ElementTree as ElementTree

import jax
import numpy as np
import pytest

import gnio_jax
from gnio_jax.apps import sensors
from gnio_jax.apps.importing import Imported
from gnio_jax.apps.track import estimate_recording, track
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.errors import InputError
from gnio_jax.evaluation import SequenceEstimate, prepare
from gnio_jax.evaluation.metrics import Filtered
from gnio_jax.evaluation.trajectory import Trajectory, read_tum
from gnio_jax.filtering import magnetometer, make_filter
from gnio_jax.filtering.barometer import Barometer
from gnio_jax.networks import read_network
from gnio_jax.types import Readings
from tests.support import drawn_run, phone_walk, tiny_run
from tests.support.filter_settings import changed

CONSIDERED = {"gyro_bias": 0.003, "scale": 0.1, "heading": 0.1, "raw_gyro_bias": 0.02}
CONFIG = TrainConfig(
    data=DataConfig(rate=50.0),
    model=ModelConfig(name="tiny"),
    filter=changed(considered=CONSIDERED),
)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("home") / "runs"
    with tiny_run.registry_entry(phone_walk.Pace):
        drawn_run.save(folder / "pace", CONFIG, lambda random, kind, shape: np.ones(shape))
        sure = changed(considered=CONSIDERED, noise={"measurement_scale": 0.01})
        sure = dataclasses.replace(CONFIG, filter=sure)
        drawn_run.save(folder / "sure", sure, lambda random, kind, shape: np.ones(shape))
        yield folder


@pytest.fixture(autouse=True)
def _undrawn(monkeypatch):
    def draw(folder, *_):
        (folder / "track.png").write_bytes(b"")

    monkeypatch.setattr("gnio_jax.apps.track._draw", draw)


def tracked(runs, folder, sequence, *without, formats=(), name="pace"):
    network = read_network(runs / name)
    recording = Imported(sequence, (), ())
    return track(recording, network, folder / "track", formats, without=without)


def error_of(result):
    """Horizontal and vertical error at every row, m; without fixes in the world of the walk."""
    path = result.estimate.trajectory
    truth = phone_walk.true_position(path.time)
    if result.summary.origin is not None:
        truth = phone_walk.on_map(path.time)
        # The place of the start by the radii of curvature, as the fixes were made.
        north, east = np.zeros(3), np.zeros(3)
        base = phone_walk.degrees(np.array([[0.0, 0, 0], [1000.0, 0, 0], [0, 1000.0, 0]]))
        east, north = base[1] - base[0], base[2] - base[0]
        start = np.array(result.summary.origin) - base[0]
        truth = truth - [1000 * start[1] / east[1], 1000 * start[0] / north[0], 0.0]
    error = path.position - truth
    return np.linalg.norm(error[:, :2], axis=1), error[:, 2] - error[0, 2]


def share_of(result, sensor):
    (use,) = (use for use in result.summary.sensors if use.sensor == sensor)
    return use.accepted


def test_field_pressure_and_fixes_mend_heading_height_and_place(runs, tmp_path):
    """At fixes that the filter does not get, its path is about as good as a fix of the receiver,
    whose errors (4 m an axis) last for half a minute."""
    walk = phone_walk.walk()
    gnss = walk.readings["gnss"]
    used = np.arange(len(gnss.time)) % 40 < 30  # ten seconds are left out now and then
    part = gnss._replace(time=gnss.time[used], values=gnss.values[used], std=gnss.std[used])
    sequence = walk._replace(readings=walk.readings | {"gnss": part})
    bare, bare_height = error_of(tracked(runs, tmp_path, walk, *sensors.NAMES))
    assert bare[-1] > 60 and abs(bare_height[-1]) > 3  # the gyro's bias and the hill
    result = tracked(runs, tmp_path, sequence, formats=("gpx", "geojson"))
    error, height = error_of(result)
    left_out = np.searchsorted(result.estimate.trajectory.time, gnss.time[~used])
    assert np.sqrt((error[left_out] ** 2).mean()) < 1.2 * 4.0 * np.sqrt(2)
    assert error.max() < bare.max() / 5
    assert np.abs(height).max() < 2.0
    shares = {use.sensor: use.accepted for use in result.summary.sensors}
    assert sorted(shares) == ["barometer", "gnss", "magnetometer"] and min(shares.values()) > 0.9
    filtered = result.estimate.filtered
    std = np.sqrt(np.trace(filtered.covariance[:, :2, :2], axis1=1, axis2=2))
    assert (error < 3 * std)[50:].all() and std[-1] < 8  # it is honest
    # The exports lie on the map.
    space = "{http://www.topografix.com/GPX/1/1}"
    gpx = ElementTree.parse(tmp_path / "track" / "trajectory.gpx")
    assert gpx.findtext(f"{space}trk/{space}name") == sequence.name
    points = list(gpx.iter(f"{space}trkpt"))
    content = json.loads((tmp_path / "track" / "trajectory.geojson").read_text())
    line = np.array(content["features"][0]["geometry"]["coordinates"])
    last = np.array([float(points[-1].get("lat")), float(points[-1].get("lon"))])
    np.testing.assert_allclose(line[-1, [1, 0]], last, atol=1e-7)
    true = phone_walk.degrees(phone_walk.on_map(result.estimate.trajectory.time[-1:]))[0, :2]
    assert np.abs((last - true) * [111e3, 74e3]).max() < 8.0
    assert points[-1].find(f"{space}time").text.startswith("2023-11-14T22:1")


def test_a_map_that_is_not_written_is_said(runs, tmp_path):
    """The receiver shows fixes, but three of them place no path."""
    walk = phone_walk.walk(seconds=60.0)
    gnss = walk.readings["gnss"]
    few = gnss._replace(**{name: part[:3] for name, part in gnss._asdict().items()})
    result = tracked(runs, tmp_path, walk._replace(readings={"gnss": few}), formats=("gpx", "csv"))
    assert sorted(path.suffix for path in (tmp_path / "track").glob("trajectory.*")) == [
        *(".csv", ".txt")
    ]
    assert "gpx: not written: no fixes place the path on the map" in result.summary.warnings
    assert not any(line.startswith("csv: ") for line in result.summary.warnings)


def test_a_barometer_is_heard_beside_a_network_that_is_sure_of_level_ground(runs, tmp_path):
    """Up a hill of 6 m and down again, by displacements that are level to a centimetre."""
    walk = phone_walk.walk()
    result = tracked(runs, tmp_path, walk, "magnetometer", "gnss", name="sure")
    _, height = error_of(result)
    std = np.sqrt(result.estimate.filtered.covariance[:, 2, 2])
    assert np.abs(height).max() < 2.0 and (np.abs(height) < 3 * std)[50:].all()
    assert share_of(result, "barometer") > 0.95
    assert not any("that is drift" in line for line in result.summary.warnings)


def test_the_drift_of_a_barometer_is_added_while_there_are_pressures():
    """Two seconds of a filter at 10 Hz, of which the first and the last half second have none."""
    path = Trajectory(np.arange(21) / 10, np.zeros((21, 3)), np.tile([1.0, 0, 0, 0], (21, 1)))
    filtered = Filtered(np.tile(np.eye(3), (21, 1, 1)), np.zeros(21), np.ones(21))
    estimate = SequenceEstimate("walk", path, path, filtered=filtered)
    height = np.where((np.arange(20) < 5) | (np.arange(20) >= 15), np.nan, 0.0)
    heights = Barometer(height, np.sqrt(4.0 + np.arange(20)), np.zeros(20))
    covariance = sensors._with_offset(estimate, heights).filtered.covariance
    growth = np.concatenate([np.zeros(6), np.arange(5, 15), np.full(5, 14)])
    np.testing.assert_allclose(covariance[:, 2, 2], 1 + growth)
    np.testing.assert_array_equal(covariance[:, :2], filtered.covariance[:, :2])


def test_the_magnetometer_alone_holds_the_heading_of_a_raw_gyro(runs, tmp_path):
    walk = phone_walk.walk()
    result = tracked(runs, tmp_path, walk, "barometer", "gnss")
    error, _ = error_of(result)
    assert error.max() < 20  # of 312 m: the network's five per cent
    assert result.summary.origin is None
    text = result.summary.sensors[0].text
    assert "turned the heading at the end by" in text and "the gyro's bias is 0.58 °/s" in text


@pytest.mark.parametrize("fault", ["jump", "far", "field"])
def test_wrong_readings_change_nothing_or_are_left_out_with_a_reason(runs, tmp_path, fault):
    """A fix that jumps by a kilometre, a receiver in another town half the time, and a magnetometer
    beside a loudspeaker."""
    walk = phone_walk.walk()
    gnss, field = walk.readings["gnss"], walk.readings["magnetometer"]
    readings = dict(walk.readings)
    if fault == "jump":
        values = gnss.values.copy()
        values[[20, 90, 91, 92, 200]] += [0.01, 0.0, 0.0]
        readings["gnss"] = gnss._replace(values=values)
    elif fault == "far":
        random = np.random.default_rng(1)
        values = gnss.values + random.normal(size=(len(gnss.time), 1)) * [0.02, 0.02, 0.0]
        readings["gnss"] = gnss._replace(values=values)
    else:
        random = np.random.default_rng(1)
        values = field.values + np.repeat(40 * random.normal(size=(240, 3)), 50, axis=0)
        readings["magnetometer"] = field._replace(values=values)
    result = tracked(runs, tmp_path, walk._replace(readings=readings))
    assert result.estimate.trajectory.known.all()
    reasons = {u.sensor: u.text for u in result.summary.sensors if u.accepted is None}
    error, height = error_of(result)
    assert np.abs(height).max() < 2.0
    if fault == "jump":
        assert not reasons and error.max() < 15
        assert share_of(result, "gnss") == pytest.approx(235 / 240, abs=0.03)
    elif fault == "far":
        assert list(reasons) == ["gnss"] and result.summary.origin is None
        assert any(w.startswith("gnss: left out: ") for w in result.summary.warnings)
        assert error.max() < 20  # by the magnetometer
    else:
        assert list(reasons) == ["magnetometer"]
        assert result.summary.origin is not None and np.median(error) < 40


BAROMETER, MAGNETOMETER, FIX = "barometer", "magnetometer", "fix"


@pytest.mark.parametrize(
    "refused, sets",
    [
        ((), [(BAROMETER, MAGNETOMETER), (BAROMETER, MAGNETOMETER, FIX)]),
        # The run without fixes is the result, and nothing is run again.
        ((FIX,), [(BAROMETER, MAGNETOMETER), (BAROMETER, MAGNETOMETER, FIX)]),
        # A magnetometer that the run without fixes refuses has no part in the one with fixes.
        ((MAGNETOMETER,), [(BAROMETER, MAGNETOMETER), (BAROMETER, FIX)]),
        (
            (BAROMETER, FIX),
            [(BAROMETER, MAGNETOMETER), (MAGNETOMETER,), (MAGNETOMETER, FIX)],
        ),
        (
            (MAGNETOMETER, FIX),
            [(BAROMETER, MAGNETOMETER), (BAROMETER, FIX), (BAROMETER,)],
        ),
    ],
)
def test_every_set_of_sensors_is_run_once_and_the_field_is_fitted_once(monkeypatch, refused, sets):
    """A filter that returns the true path and refuses most measurements of some sensors."""
    walk = phone_walk.walk()
    ekf = make_filter(CONFIG.data, CONFIG.filter)
    (ready,), _ = prepare([walk], CONFIG.data, ekf, init="static", from_first=True)
    angle = phone_walk.TURN * ready.time
    zero = np.zeros_like(angle)
    turned = np.stack([np.cos(angle / 2), zero, zero, np.sin(angle / 2)], axis=1)
    path = Trajectory(ready.time, phone_walk.true_position(ready.time), turned)
    first, runs_of_the_filter, fits = SequenceEstimate("walk", path, path), [], []

    def run(ready, _):
        names = tuple(rows.name for rows in ready.measurements)
        runs_of_the_filter.append(names)
        share = {name: 0.2 if name in refused else 0.9 for name in names}
        phase = np.linspace(0, 1, len(path.time))
        return first._replace(accepted={name: 1.0 * (phase < share[name]) for name in names})

    def fit_field(*arguments, **options):
        fits.append(arguments)
        return magnetometer.fit_field(*arguments, **options)

    monkeypatch.setattr(sensors, "fit_field", fit_field)
    fused = sensors.fuse(first, ready, ekf, walk.readings, run)
    assert runs_of_the_filter == sets and len(fits) == 1
    left_out = {sensors.NAMES[use.sensor] for use in fused.uses if use.accepted is None}
    assert left_out == set(refused) and len(fused.uses) == 3
    assert set(fused.estimate.accepted) == {BAROMETER, MAGNETOMETER, FIX} - left_out
    assert (fused.origin is None) == (FIX in refused)
    assert (fused.ready.start.gyro_bias == 0).all() == (MAGNETOMETER in refused)


def test_a_recording_without_other_sensors_has_the_bytes_of_one_that_leaves_them_out(
    runs, tmp_path
):
    walk = phone_walk.walk(seconds=60.0)
    contents = []
    for sequence, without in ((walk, tuple(sensors.NAMES)), (walk._replace(readings={}), ())):
        tracked(runs, tmp_path, sequence, *without)
        folder = tmp_path / "track"
        contents.append(
            [(folder / name).read_bytes() for name in ("trajectory.txt", "summary.json")]
        )
    assert contents[0] == contents[1]
    assert b"sensors" not in contents[0][1] and b"origin" not in contents[0][1]


def test_the_screen_says_what_each_sensor_did(gnio, mistake, runs, tmp_path, monkeypatch):
    monkeypatch.chdir(runs.parent)
    walk = phone_walk.walk(seconds=60.0)
    write_hdf5(tmp_path / "walk.h5", walk)
    words = ("track", tmp_path / "walk.h5", "--network", runs / "pace", "--out", tmp_path / "t")
    output = gnio(*words, "--without", "gnss", "--without", "magnetometer")
    assert "barometer, 60 rows" in output and "% used" in output
    assert "barometer: the end is" in output and "gnss" not in output
    summary = json.loads((tmp_path / "t" / "summary.json").read_text())
    assert [use["sensor"] for use in summary["sensors"]] == ["barometer"]
    assert len(read_tum(tmp_path / "t" / "trajectory.txt").time) > 500
    assert "nose" in mistake(*words, "--without", "nose")
    refused = mistake(*words, "--without", "gnss", "--format", "gpx")
    assert "--format: gpx needs the place of the start" in refused


START = 4096.0
"""First stamp of the arrays, s. Sums with it are exact to 1e-12 s."""


@pytest.fixture(scope="module")
def arrays():
    """The walk with a smaller bias of the gyro, and its arrays. No stamp is at the end of a clone
    interval, where its rounding would decide to which interval it belongs."""
    walk = phone_walk.walk()
    walk = walk._replace(
        gyro=walk.gyro - [0.0, 0.0, 0.007],
        attributes={"start_time": START},
        readings={
            name: readings._replace(time=readings.time + 0.003)
            for name, readings in walk.readings.items()
        },
    )
    sensors = {
        name: (START + one.time, one.values, one.std)
        if name == "gnss"
        else (START + one.time, one.values)
        for name, one in walk.readings.items()
    }
    return walk, (START + walk.time, walk.gyro, walk.accel), sensors


@pytest.mark.parametrize(
    "names, tolerance",
    [
        # Stamps that are rounded to 1e-13 s change the float32 network's path by 0.05 mm.
        (("magnetometer", "barometer"), 1e-3),
        # That decides by how many of the first fixes the path is placed.
        (("magnetometer", "barometer", "gnss"), 0.5),
    ],
)
def test_arrays_of_other_sensors_give_the_track_of_a_recording_with_them(
    runs, arrays, names, tolerance
):
    walk, samples, readings = arrays
    chosen = {name: readings[name] for name in names}
    odometry = gnio_jax.track(*samples, network=runs / "pace", sensors=chosen)
    with jax.enable_x64(True):
        same = {name: walk.readings[name] for name in names}
        expected = estimate_recording(walk, same, read_network(runs / "pace"))
    position = expected.estimate.trajectory.position
    np.testing.assert_allclose(odometry.position, position, atol=tolerance)
    used = [note for note in odometry.notes if "% of its measurements used" in note]
    assert sorted(note.partition(":")[0] for note in used) == sorted(names)
    if "gnss" in names:
        np.testing.assert_allclose(odometry.origin, expected.origin, rtol=0, atol=1e-5)
        truth = phone_walk.on_map(odometry.time - START)
        assert np.median(np.linalg.norm((odometry.position - truth)[:, :2], axis=1)) < 15
    else:
        assert odometry.origin is None


def test_arrays_of_a_barometer_alone_in_any_order_give_the_height(runs, arrays):
    _, samples, readings = arrays
    time, pressure = (part[::-1] for part in readings["barometer"])
    alone = {"barometer": (time, pressure[:, 0])}
    odometry = gnio_jax.track(*samples, network=runs / "pace", sensors=alone)
    truth = phone_walk.true_position(odometry.time - START)[:, 2]
    assert odometry.origin is None and np.abs(odometry.position[:, 2] - truth).max() < 2.0


def part_of(readings, name, change):
    time, values, *_ = readings[name]
    return {name: change(time, values)}


WRONG = {
    "sensors: unknown sensor 'nose'": lambda r: {"nose": r["barometer"]},
    "is no tuple of arrays": lambda r: {"barometer": r["barometer"][1]},
    "too many or too few; give (time, values)": lambda r: {"barometer": r["gnss"]},
    "shapes (240,), (240, 1), expected (f,) and (f, 3)": lambda r: {"magnetometer": r["barometer"]},
    "no array of numbers": lambda r: {"barometer": (["x"], [1e5])},
    "sensors['barometer']: field 'barometer' has a median": (
        lambda r: part_of(r, "barometer", lambda time, values: (time, values / 100))
    ),
    "sensors['magnetometer']: field 'magnetometer' has a median": (
        lambda r: part_of(r, "magnetometer", lambda time, values: (time, values / 100))
    ),
    "share nothing with the IMU's": (
        lambda r: part_of(r, "barometer", lambda time, values: (time - 2 * START, values))
    ),
    "field 'gnss' is NaN or Inf in row 1": (
        lambda r: part_of(r, "gnss", lambda time, values: (time, np.nan * values))
    ),
}
"""The message -> what is wrong with the readings."""


@pytest.mark.parametrize("message", WRONG)
def test_arrays_of_other_sensors_that_are_wrong_are_refused_before_any_run(message, arrays):
    _, samples, readings = arrays
    with pytest.raises(InputError) as error:
        gnio_jax.track(*samples, network="no network", sensors=WRONG[message](readings))
    assert message in str(error.value)


def test_fixes_of_a_phone_that_stands_show_no_heading():
    walk = phone_walk.walk(seconds=60.0)
    gnss = walk.readings["gnss"]
    time = np.arange(0, 60, 0.1)
    level = np.tile([1.0, 0, 0, 0], (len(time), 1))
    path = Trajectory(time, np.zeros((len(time), 3)), level)
    still = SequenceEstimate("still", path, path)
    with pytest.raises(InputError, match=r"the fixes show the heading to .* only.*go farther"):
        sensors.place_on_map(gnss, still, 60.0)
    with pytest.raises(InputError, match="2 fixes are within the recording, and 4 are needed"):
        few = gnss._replace(time=gnss.time[:2], values=gnss.values[:2], std=gnss.std[:2])
        sensors.place_on_map(few, still, 60.0)


def test_fixes_on_both_sides_of_the_antimeridian_are_one_place():
    """Half of the fixes have longitudes of 180 degrees, half of them of -180."""
    time = np.arange(0, 100.0)
    position = np.column_stack([time - 50.0, 20.0 * np.sin(time / 15.0), 0 * time])
    level = np.tile([1.0, 0, 0, 0], (len(time), 1))
    path = Trajectory(time, position, level)
    rows = slice(1, 99)
    metre = 1.0 / 111_319.49  # degrees, at the equator
    longitude = 180.0 + (position[rows, 0] + 0.5) * metre
    longitude[longitude > 180.0] -= 360.0
    assert np.median(longitude) == 0.0
    values = np.column_stack([position[rows, 1] / 110_574.3, longitude, 0 * longitude])
    fixes = Readings(time[rows], values, np.full((98, 3), 3.0))
    placement = sensors.place_on_map(fixes, SequenceEstimate("ferry", path, path), 1e9)
    assert placement.distance < 0.05 and abs(placement.yaw) < 1e-3
    assert abs(abs(placement.origin.longitude) - 180.0) < 2 * metre
    assert abs(placement.origin.latitude) < metre
