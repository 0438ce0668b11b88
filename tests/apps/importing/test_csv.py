"""Tables of numbers must tell of the known walk again; what is ambiguous is refused."""

import os
import threading

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.apps.importing import read_imported, write_imported
from gnio_jax.data.labels import unit_of, unit_text
from gnio_jax.data.readers import csv_files
from tests.support import known_walk
from tests.support.csv_writers import AXES, SECONDS, compare_imu, imu, write, write_native
from tests.support.importing import import_recording, imported, refused

G = 9.80665
NAMES = ("Timestamp", "wx", "wy", "wz", "ax", "ay", "az")
MAPPED = dict(zip(("time", *AXES), NAMES, strict=True))
UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
UNIX = 1_700_000_000_123_456_789


def stamps_of(time, unit):
    """As loggers write them: whole numbers but for seconds, of unix time."""
    nanoseconds = UNIX + np.round(time * 1e9).astype(np.int64)
    return nanoseconds / 1e9 if unit == "s" else nanoseconds // round(1e9 / UNITS[unit])


def write_logger(path, unit="ns", gyro=1.0, accel=1.0, separator=",", spoil=None, rows=None):
    """14 s at 200 Hz, of which the `rows` are kept."""
    time = np.arange(round(SECONDS * 200)) / 200
    values = imu(time)
    columns = {"Timestamp": stamps_of(time, unit), "steps": np.zeros(len(time), dtype=int)}
    columns |= dict(zip(NAMES[3:0:-1], (values[:, 2::-1] * gyro).T, strict=True))
    columns |= dict(zip(NAMES[:3:-1], (values[:, 5:2:-1] * accel).T, strict=True))
    if spoil:
        columns = spoil(columns)
    rows = slice(None) if rows is None else rows
    return write(path, list(columns), [column[rows] for column in columns.values()], separator)


def test_rows_are_those_that_an_editor_shows(tmp_path):
    """Behind comments, the header, a blank line and rows of another sensor, whatever is wrong. One
    damaged row is left out and named, many are refused."""
    path = write_native(tmp_path / "walk.csv", reference=False)
    header, *rows = path.read_text().splitlines()
    names = header.split(",")
    other = ["100.001", *[""] * (len(names) - 1)]
    lines = ["# mine", "", header, *rows[:20], ",".join(other), "", "# pause", *rows[20:]]
    first = lines.index(rows[41])
    for column, value in (("gyro_y", "three"), ("accel_z", "inf"), ("time", "")):
        spoiled = [line.split(",") for line in lines]
        for count, words in ((1, "left out"), (40, rf"row {first + 1}\b")):
            for cells in spoiled[first : first + 2 * count : 2]:
                cells[names.index(column)] = value
            path.write_text("\n".join(map(",".join, spoiled)))
            if count > 1:
                refused(path, words)
            else:
                sequence, notes = import_recording(path)
                compare_imu(sequence)
                assert any(words in note and f"row {first + 1}" in note for note in notes)


# --- units and signs


@pytest.mark.parametrize(
    ("unit", "gyro", "accel", "separator"),
    [
        ("s", 1.0, 1.0, ","),
        ("ms", 180 / np.pi, 1 / G, ";"),
        ("us", 1.0, 1000 / G, ","),
        ("ns", 180 / np.pi, 1.0, "\t"),
    ],
)
def test_units_and_separators_are_detected_and_reported(tmp_path, unit, gyro, accel, separator):
    path = write_logger(tmp_path / "phone.csv", unit, gyro, accel, separator)
    sequence, notes = import_recording(path, MAPPED)
    compare_imu(sequence)
    # Milliseconds of a 200 Hz clock are exact; unix seconds in a float are good to 0.25 µs.
    assert sequence.time[0] == 0.0 and np.allclose(np.diff(sequence.time), 0.005, atol=1e-6)
    assert np.isnan(sequence.orientation).all() and not sequence.valid.any()
    assert sequence.name == "phone"
    text = " | ".join(notes)
    assert f"time of gyro taken as {unit}, by which it runs at 200 Hz" in text
    assert f"gyro taken as {'rad/s' if gyro == 1.0 else 'deg/s'}" in text
    assert f"accel taken as {'m/s2' if accel == 1.0 else 'g' if accel < 1 else 'mg'}" in text
    assert "uniform clock of 200 Hz" in text and "quietest second accel reads" in text


def test_units_that_are_stated_are_taken_unless_the_data_contradict_them(tmp_path):
    """They are not reported as detected."""
    path = write_logger(tmp_path / "phone.csv")
    stated = {"time_unit": "ns", "gyro_unit": "rad/s", "accel_unit": "m/s2"}
    sequence, notes = import_recording(path, MAPPED, **stated)
    compare_imu(sequence)
    assert not any(" taken as " in note for note in notes) and len(notes) >= 2
    refused(path, "field 'time' makes gyro run at 0.0002 Hz with", MAPPED, time_unit="ms")
    refused(path, "field 'accel'", MAPPED, accel_unit="g")
    refused(path, "rate: 0 Hz", MAPPED, rate=0.0)


def test_slow_turns_tell_their_unit_by_the_turning_of_gravity(tmp_path):
    """A turntable tips by 20°/s at most: as numbers 20 is possible in both units."""
    time = np.arange(2000) / 100
    angle = np.radians(40.0) * np.sin(2 * np.pi * time / 13.0)
    rate = np.gradient(angle, time)
    force = [0 * time, 9.81 * np.sin(angle), 9.81 * np.cos(angle)]
    for unit, factor in (("deg/s", 180 / np.pi), ("rad/s", 1.0)):
        columns = [time, rate * factor, 0 * time, 0 * time, *force]
        path = write(tmp_path / "table.csv", ["time", *AXES], columns)
        sequence, notes = import_recording(path)
        np.testing.assert_allclose(sequence.gyro[:, 0], rate, atol=1e-6)
        assert any(f"gyro taken as {unit} (gravity turns by" in note for note in notes)


def test_what_no_unit_explains_is_refused_until_it_is_stated(tmp_path):
    noise = np.random.default_rng(1)
    time = np.arange(1000) / 100
    force = [noise.normal(mean, 0.02, 1000) for mean in (0.0, 0.0, 9.8)]
    columns = [time, *noise.normal(0, 0.05, (3, 1000)), *force]
    still = write(tmp_path / "still.csv", ["time", *AXES], columns)
    refused(still, "the unit of field 'gyro' is ambiguous .*; state it: rad/s or deg/s")
    sequence, _ = import_recording(still, gyro_unit="deg/s")
    assert np.abs(sequence.gyro).max() < 0.01
    time = np.arange(500) / 5.0
    slow = write(tmp_path / "slow.csv", ["time", *AXES], [time, *imu(time).T])
    refused(slow, r"field 'time' is ambiguous \(in seconds gyro would run at 5 Hz\)")
    linear = write_logger(tmp_path / "linear.csv", accel=0.3)
    refused(linear, "the unit of field 'accel' is ambiguous .*gravity included", MAPPED)
    _, notes = import_recording(write_logger(tmp_path / "high.csv", accel=1.08), MAPPED)
    assert any("off gravity by +" in note and "calibration" in note for note in notes)
    far = write_logger(tmp_path / "far.csv", accel=0.75)
    refused(far, r"'accel' reads 7\.\d+ m/s² in its quietest second, far from gravity", MAPPED)


def test_a_header_tells_the_unit(tmp_path):
    """A phone that hardly turns: the numbers alone would be ambiguous."""
    time = np.arange(300) / 100
    rows = np.random.default_rng(4).normal([0.1, -0.2, 0.1, 0.0, 0.0, 9.81], 0.01, (300, 6)).T
    names = {name: f"g{name[-1]} [deg/s]" for name in AXES[:3]}
    path = write(tmp_path / "still.csv", ["time", *names.values(), *AXES[3:]], [time, *rows])
    sequence, notes = import_recording(path, names)
    np.testing.assert_allclose(sequence.gyro, np.radians(rows[:3].T), atol=1e-9)
    assert "still.csv: gyro in deg/s, by its header" in notes
    path.write_text(path.read_text().replace(" [deg/s]", ""))
    plain = {name: label.split()[0] for name, label in names.items()}
    refused(path, "the unit of field 'gyro' is ambiguous", plain)
    labels = ["w_RS_S_x [rad s^-1]", "X (°/s)", "a_RS_S_x [m s^-2]", "#timestamp [ns]", "a (g)"]
    assert [unit_of(unit_text(label)) for label in labels] == ["rad/s", "deg/s", "m/s2", "ns", "g"]
    assert not any(unit_of(unit_text(label)) for label in ("Magnetic field x (µT)", "gyro_x", "g"))


def test_signs_are_turned_when_stated_or_asked_for(tmp_path):
    for sign, factor in (("android", 1.0), ("ios", -1.0)):
        path = write_logger(tmp_path / f"{sign}.csv", accel=factor / G)
        stated, notes = import_recording(path, MAPPED, accel_sign=sign)
        compare_imu(stated)
        assert any("negated" in note for note in notes) == (sign == "ios")
        detected, notes = import_recording(path, MAPPED, accel_sign="detect")
        compare_imu(detected)
        assert any("assuming that the screen points up" in note for note in notes)
    time = np.arange(2800) / 200
    # Gravity on -z is a warning unless the sign is stated.
    recording = imported(path, MAPPED)
    (warning,) = recording.warnings
    assert warning.startswith("sign: gravity reads on -z in ios.csv: ")
    assert warning.endswith("compare with --accel-sign ios")
    write_imported(tmp_path / "ios.h5", recording)
    assert read_imported(tmp_path / "ios.h5").warnings == recording.warnings
    assert imported(path, MAPPED, accel_sign="android").warnings == ()
    assert imported(path, MAPPED, accel_sign="ios").warnings == ()
    assert imported(write_native(tmp_path / "walk.csv")).warnings == ()
    upright = Rotation.from_euler("y", 90, degrees=True)
    values = imu(time)
    columns = [time, *upright.apply(values[:, :3]).T, *upright.apply(values[:, 3:]).T]
    path = write(tmp_path / "upright.csv", ["time", *AXES], columns)
    words = "the sign of field 'accel' is ambiguous .*; state it: android or ios"
    refused(path, words, accel_sign="detect")


# --- columns


def test_gravity_and_user_acceleration_apart_are_summed(tmp_path):
    """Below a byte order mark, a comment and quoted names, with decimal commas."""
    time = np.arange(2800) / 200
    values, gravity = imu(time), known_walk.attitude(time).inv().apply([0.0, 0.0, 1.0])
    user = values[:, 3:] / G - gravity
    names = ["time", *AXES[:3], *(f"gravity{a}" for a in "XYZ"), *(f"user{a}" for a in "XYZ")]
    quoted = [f'"{name}"' for name in names]
    columns = [time, *values[:, :3].T, *-gravity.T, *-user.T]
    path = write(tmp_path / "phone.csv", quoted, columns, ";", "\ufeff# of Monday, a, b\n\n")
    first, *rows = path.read_text().replace(".", ",").splitlines()
    rows[2] = ";".join(cell.split(",")[0] for cell in rows[2].split(";"))  # whole numbers first
    path.write_bytes("\r\n".join([first, *rows]).encode())
    sums = {f"accel_{a}": f"gravity{a.upper()} + user{a.upper()}" for a in "xyz"}
    sequence, _ = import_recording(path, sums, accel_sign="ios")
    np.testing.assert_allclose(sequence.accel[1:], imu(sequence.time[1:])[:, 3:], atol=1e-3)
    refused(path, "column 'userQ' is missing", sums | {"accel_x": "gravityX+userQ"})
    refused(path, "columns: unknown name 'gyro'; known names: time, accel_time", {"gyro": "wx"})
    refused(path, "columns: 'time=' names no column; write gyro_x=NAME", {"time": ""})
    del sums["accel_x"]
    words = "column 'accel_x' is missing; found: time, .*; name them: --columns accel_x="
    refused(path, words, sums)


def test_files_without_a_header_are_read_by_the_places_of_their_columns(tmp_path):
    """Blanks between the columns, and a comment where a header would stand."""
    time = np.arange(2800) / 200
    paths = [tmp_path / "gyro.txt", tmp_path / "acce.txt"]
    for path, part in zip(paths, np.split(imu(time), 2, axis=1), strict=True):
        rows = zip(stamps_of(time, "ns"), *part.T, strict=True)
        lines = [f"{stamp} {x:.9f}  {y:.9f} {z:.9f}" for stamp, x, y, z in rows]
        path.write_text("\n".join(["# Created at Wed Dec 27 22:30:22 GMT 2023", *lines]) + "\n")
    columns = {"time": "0"} | {name: "123"[n % 3] for n, name in enumerate(AXES)}
    sequence, _ = import_recording(paths[0], columns, accel_path=paths[1])
    compare_imu(sequence)
    stated = {"accel_path": paths[1], "gyro_unit": "rad/s"}
    summed, _ = import_recording(paths[0], columns | {"gyro_x": "1+2"}, **stated)
    np.testing.assert_allclose(summed.gyro[:, 0], sequence.gyro[:, :2].sum(axis=1), atol=1e-9)
    # A table of one sensor needs no names: stamps that increase, then three axes.
    compare_imu(import_recording(paths[0], accel_path=paths[1])[0])
    compare_imu(import_recording(paths[0])[0])  # the other sensor's file is beside it
    words = "has 4 columns of numbers and no header; .*gyro_x=0 .*accel_z=5 --sample-rate HZ$"
    refused(paths[0].rename(tmp_path / "board.txt"), words)


def test_rows_of_one_sensor_each_are_told_apart(tmp_path):
    """A merged table: a row is of one sensor, and the other's columns are empty."""
    time = np.arange(0, SECONDS, 0.01)
    time = np.concatenate([time, time + 0.004])
    values, order, half = imu(time), np.argsort(time), len(time) // 2
    values[:half, 3:] = np.nan
    values[half:, :3] = np.nan
    path = write(tmp_path / "merged.csv", ["time", *AXES], [time[order], *values[order].T])
    sequence, notes = import_recording(path)
    compare_imu(sequence, start=0.01)  # the first sample of the gyro that both cover
    assert sum("rows have no" in note for note in notes) == 2
    values[5, 1] = np.nan
    path = write(tmp_path / "torn.csv", ["time", *AXES], [time[order], *values[order].T])
    _, notes = import_recording(path)
    assert any("field 'gyro' is NaN or Inf in 1 rows" in note for note in notes)
    values[np.flatnonzero(np.isfinite(values[:, 0]))[::9], 1] = np.nan
    path = write(tmp_path / "torn.csv", ["time", *AXES], [time[order], *values[order].T])
    refused(path, r"torn\.csv: a stamp or a value of field 'gyro' is NaN or Inf in 157 rows")


# --- stamps


def test_what_is_repaired_of_the_stamps_is_noted(tmp_path):
    order = np.arange(2800)
    order[[100, 140]] = order[[140, 100]]
    order = np.delete(np.insert(order, 700, order[700]), [1000, 1001])
    sequence, notes = import_recording(write_logger(tmp_path / "mixed.csv", rows=order), MAPPED)
    compare_imu(sequence)
    assert "mixed.csv: gyro had 2 steps back in time; its rows were sorted" in notes
    assert "mixed.csv: 1 rows of accel repeat a stamp and were dropped" in notes
    moved = np.r_[1000:1600, 0:1000, 1600:2800]  # a block in the wrong place
    compare_imu(import_recording(write_logger(tmp_path / "moved.csv", rows=moved), MAPPED)[0])
    path = write_logger(tmp_path / "holes.csv", rows=np.r_[0:1000, 1079:2800])
    _, notes = import_recording(path, MAPPED)
    assert "holes.csv: gyro lacks samples 1 times, for up to 0.40 s; bridged linearly" in notes


def test_one_file_per_sensor_is_joined_on_one_clock(tmp_path):
    """Android writes every sensor's events with stamps of their own, from when it was switched on
    to when it was switched off."""
    noise = np.random.default_rng(2)
    gyro_time = np.arange(0.0, SECONDS, 1 / 208.0) + 0.2
    accel_time = np.arange(0.0, SECONDS, 1 / 100.0) - 0.3
    accel_time = accel_time + noise.uniform(-2e-4, 2e-4, len(accel_time))
    axes = ["z", "y", "x"]

    def accelerometer(unit="ns", later=0.0, rows=slice(None)):
        values = [stamps_of(accel_time + later, unit), *imu(accel_time)[:, 5:2:-1].T]
        return write(tmp_path / "accel.csv", ["t", *axes], [column[rows] for column in values])

    values = [stamps_of(gyro_time, "ns"), *imu(gyro_time)[:, 2::-1].T]
    gyro = write(tmp_path / "gyro.csv", ["time", *axes], values)
    columns = {name: name[-1] for name in AXES} | {"time": "time", "accel_time": "t"}
    options = {"accel_path": accelerometer(), "rate": 100.0, "name": "walk"}
    sequence, notes = import_recording(gyro, columns, **options)
    assert np.allclose(np.diff(sequence.time), 0.01) and sequence.name == "walk"
    # The joint clock starts where both sensors run, at a sample of the gyro.
    start = gyro_time[gyro_time >= accel_time[0]][0]
    inner = slice(20, -20)  # the low-pass towards 100 Hz mirrors at the ends
    expected = imu(sequence.time + start)
    np.testing.assert_allclose(sequence.gyro[inner], expected[inner, :3], atol=1e-3)
    np.testing.assert_allclose(sequence.accel[inner], expected[inner, 3:], atol=1e-3)
    assert sequence.time[-1] == pytest.approx(SECONDS - 0.3 - start, abs=0.03)
    assert sequence.imu_valid is None
    assert sequence.attributes["start_time"] == pytest.approx(UNIX * 1e-9 + start, abs=2e-6)
    assert any("both are interpolated to one clock, and 1.0" in note for note in notes), notes

    # In another unit, and it stops for a while: what is there of the other is no whole sample.
    accelerometer("us", rows=(accel_time < 4.0) | (accel_time > 4.5))
    holed, _ = import_recording(gyro, columns, **options)
    early = slice(20, 350)
    np.testing.assert_allclose(holed.accel[early], expected[early, 3:], atol=1e-3)
    missing = holed.time[~holed.imu_valid] + start
    assert len(missing) == pytest.approx(50, abs=3)
    assert missing[[0, -1]] == pytest.approx([4.0, 4.5], abs=0.02)
    accelerometer(later=3600.0)
    words = r"gyro\.csv: both sensors were recorded for 0\.00 s, less than the network's w"
    refused(gyro, words, columns, **options)


def test_a_pipe_is_refused_in_one_true_line(tmp_path):
    """It is read more than once, which a pipe is not."""
    pipe = tmp_path / "walk.csv"
    os.mkfifo(pipe)
    # Without a writer, whoever opens the pipe waits for ever.
    threading.Thread(target=lambda: pipe.open("w").close(), daemon=True).start()
    refused(pipe, "walk.csv: can be read only once, as a pipe can; save the recording as a file")


# --- references


def test_the_reference_of_the_package_s_own_form_is_kept_unless_it_is_none(tmp_path):
    path = write_native(tmp_path / "walk.csv", velocity=True)
    (by_dataset,) = csv_files.read(path)
    recording = imported(path)
    assert by_dataset.valid.all() and recording.sequence.valid.all()
    assert "reference from given, 100% of the time" in recording.notes
    for field in ("orientation", "position", "velocity"):
        expected = getattr(by_dataset, field)
        np.testing.assert_allclose(getattr(recording.sequence, field), expected, atol=1e-6)
    write_imported(tmp_path / "mine" / "walk.h5", recording)
    (again,) = data.load("csv", tmp_path / "mine", "test")
    np.testing.assert_array_equal(again.gyro, recording.sequence.gyro)

    def tilted(columns):
        columns["qw"], columns["qx"] = columns["qx"], columns["qw"]

    for changes, words in (
        ({"spoil": tilted}, "the reference given does not fit the IMU"),
        ({"drop": ("py",)}, "column 'py' is missing while 'px' is there"),
    ):
        sequence, notes = import_recording(write_native(path, **changes))
        assert not sequence.valid.any() and sequence.attributes["truth"] == "none"
        (note,) = (note for note in notes if note.startswith("no reference is taken: "))
        assert words in note
