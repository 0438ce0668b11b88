"""The exports of phone loggers must tell of the known walk again, or be refused in one line."""

import datetime
import zipfile

import numpy as np
import openpyxl
import pytest

from gnio_jax.apps.importing import files
from tests.support import known_walk, logger_files
from tests.support.importing import import_recording, refused
from tests.support.logger_files import (
    EPOCH,
    axes,
    lying_zip,
    phyphox,
    phyphox_sets,
    phyphox_table,
    sensor_logger,
    sensor_table,
    unpacked,
    workbooks,
    zipped,
)


def compare(sequence):
    """Both sensors are those of the walk; what was interpolated has a spline's error at its ends.

    The sequence begins with the first sample that both sensors cover.
    """
    time = sequence.time + 0.01
    inner = slice(20, -20)
    force, rate = known_walk.force(time), known_walk.rate(time)
    np.testing.assert_allclose(sequence.gyro[inner], rate[inner], atol=1e-4)
    np.testing.assert_allclose(sequence.accel[inner], force[inner], atol=5e-3)
    assert len(time) > 700 and not sequence.valid.any()


def without(members, *names):
    return {name: text for name, text in members.items() if name not in names}


SUM = "Accelerometer.csv + Gravity.csv in m/s2"
RAW = "AccelerometerUncalibrated.csv: accel taken as"


@pytest.mark.parametrize(
    ("platform", "standardised", "dropped", "words"),
    [
        ("android", False, (), "(Android); time in ns, Gyroscope.csv in rad/s, TotalAcceleration."),
        ("ios", False, (), f"(iOS); time in ns, Gyroscope.csv in rad/s, {SUM}"),
        ("ios", False, ("Accelerometer.csv",), f"{RAW} g"),
        ("ios", True, ("Accelerometer.csv",), f"{RAW} m/s2"),
    ],
)
def test_sensor_logger(tmp_path, platform, standardised, dropped, words):
    members = without(sensor_logger(platform, standardised), *dropped)
    sequence, notes = import_recording(zipped(tmp_path / "walk.zip", members))
    compare(sequence)
    # The same as a folder, or packed as macOS packs one.
    extra = {f"walk/{name}": text for name, text in members.items()}
    extra["__MACOSX/walk/._Gyroscope.csv"] = "\0"
    for path in (zipped(tmp_path / "inside.zip", extra), unpacked(tmp_path / "walk", members)):
        other, _ = import_recording(path)
        np.testing.assert_array_equal(other.accel, sequence.accel)
        np.testing.assert_array_equal(other.gyro, sequence.gyro)
    text = " | ".join(notes)
    assert words in text and sequence.name == "walk"
    assert ("negated (iOS's sign)" in text) == (platform == "ios" and not standardised)
    assert sequence.attributes["start_time"] - EPOCH * 1e-9 == pytest.approx(0.01, abs=1e-6)


@pytest.mark.parametrize("delay, words", [(0.0, False), (0.3, True)])
def test_a_note_has_the_time_of_one_sensor_alone_if_it_is_worth_telling(tmp_path, delay, words):
    members = sensor_logger()
    header, *rows = members["TotalAcceleration.csv"].splitlines()
    rows = rows[round(100 * delay) :]
    members["TotalAcceleration.csv"] = "\n".join([header, *rows]) + "\n"
    _, notes = import_recording(zipped(tmp_path / "walk.zip", members))
    (note,) = (note for note in notes if "different stamps" in note)
    assert ("s that only one of them covers are cut off" in note) == words


def test_the_metadata_tell_the_sign_or_it_must_be_stated(tmp_path):
    unknown = "the sign of field 'accel' depends on the phone's system.*android, ios or detect"
    path = zipped(tmp_path / "walk.zip", without(sensor_logger("ios"), "Metadata.csv"))
    refused(path, unknown)
    sequence, notes = import_recording(path, accel_sign="ios")
    compare(sequence)
    assert any("unknown system" in note for note in notes)
    members = sensor_logger("ios")
    members["Metadata.csv"] = (  # of an early release
        "version,device name,recording time,platform,appVersion,device id,sensors,sampleRateMs\n"
        "3,iPhone 12 mini,2022-09-12_11-36-02,ios,1.10.4,id,Accelerometer|Gravity,10|10"
    )
    # Of a gyro whose bias is its own the sequence says so, where there is no other.
    members["GyroscopeUncalibrated.csv"] = members["Gyroscope.csv"]
    for raw in (None, "no"):
        sequence, notes = import_recording(zipped(path, members))
        compare(sequence)
        assert ("GyroscopeUncalibrated.csv" in " ".join(notes)) == (raw == "no")
        assert sequence.attributes.get("imu_compensated") == raw
        members.pop("Gyroscope.csv", None)
    members["Metadata.csv"] = "platform,standardisation\nios,perhaps\n"
    refused(zipped(path, members), unknown)


@pytest.mark.parametrize(
    ("members", "words"),
    [
        (without(sensor_logger(), "Gyroscope.csv"), "has no gyro .found: Accelerometer.csv, .*; "),
        (
            without(sensor_logger("ios"), "Gravity.csv", "AccelerometerUncalibrated.csv"),
            "walk.zip: holds acceleration without gravity .Accelerometer.csv.; switch .* Gravity",
        ),
        (
            {f"{day}/{name}": text for day in "ab" for name, text in sensor_logger().items()},
            "walk.zip: holds 2 recordings: a, b; give one",
        ),
        (
            sensor_logger() | {"TotalAcceleration.csv": "time,seconds_elapsed,z,y\n1,2,3,4\n"},
            "TotalAcceleration.csv: column 'x' is missing",
        ),
        (sensor_logger(seconds=0.5), "walk.zip: both sensors were recorded for 0.49 s, less than"),
        ({"notes.md": "hello"}, "layout of no known recording .found: no CSV file.; known"),
        (sensor_logger() | {"../../etc/Gyroscope.csv": "x"}, r"2 recordings: ., \.\./\.\./etc"),
        ({f"{number}.csv": "" for number in range(201)}, "walk.zip: holds 201 CSV files"),
    ],
)
def test_what_is_wrong_with_a_zip_is_one_line(tmp_path, members, words):
    """And nothing is unpacked, wherever its members want to go."""
    refused(zipped(tmp_path / "deep" / "er" / "walk.zip", members), words)
    assert [path.name for path in tmp_path.rglob("*")] == ["deep", "er", "walk.zip"]


def test_degrees_where_the_format_says_radians_are_refused(tmp_path):
    """A phone that turns slowly, in deg/s: no number is too large for rad/s."""
    time = np.arange(2000) / 100
    angle = 0.7 * np.sin(2 * np.pi * time / 13.0)
    rate = 0.7 * 2 * np.pi / 13.0 * np.cos(2 * np.pi * time / 13.0)
    turning = np.stack([rate, 0 * time, 0 * time], axis=1)
    force = 9.81 * np.stack([0 * time, np.sin(angle), np.cos(angle)], axis=1)
    members = {"TotalAcceleration.csv": sensor_table(time, force)}
    degrees = members | {"Gyroscope.csv": sensor_table(time, np.degrees(turning))}
    path = zipped(tmp_path / "walk.zip", degrees)
    refused(path, "its gyro looks like deg/s by the turning .* state the unit")
    sequence, _ = import_recording(path, gyro_unit="deg/s")
    np.testing.assert_allclose(sequence.gyro, turning, atol=1e-6)
    members["Gyroscope.csv"] = sensor_table(time, turning)
    sequence, _ = import_recording(zipped(path, members))
    np.testing.assert_allclose(sequence.gyro, turning, atol=1e-6)


def test_a_zip_cut_short_or_with_a_member_that_lies_about_its_size_is_one_line(tmp_path):
    whole = zipped(tmp_path / "walk.zip", sensor_logger()).read_bytes()
    for fraction in (0.02, 0.5, 0.99):
        (tmp_path / "walk.zip").write_bytes(whole[: int(fraction * len(whole))])
        refused(tmp_path / "walk.zip", "walk.zip: cannot be read as a zip, it may be cut short")
    path = tmp_path / "bomb.zip"
    path.write_bytes(lying_zip(sensor_logger(), "Gyroscope.csv", 3 * 2**30))
    refused(path, "Gyroscope.csv: unpacks to 3072 MiB; no table may exceed 512 MiB")
    path.write_bytes(lying_zip(sensor_logger(), "Gyroscope.csv", 5000))
    refused(path, "bomb.zip: cannot be read as a zip, it may be cut short")


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", ",")])
def test_phyphox_as_text(tmp_path, separator, decimal):
    sequence, notes = import_recording(zipped(tmp_path / "w.zip", phyphox(separator, decimal)))
    compare(sequence)
    text = "phyphox; time in s, Gyroscope.csv in rad/s, Accelerometer.csv in m/s2"
    assert f"w.zip: {text}" in notes


def test_phyphox_in_one_file(tmp_path):
    """The columns tell, whatever the file is called; a file of ours has names of ours."""
    time = logger_files.clock()
    values = np.concatenate([known_walk.rate(time), known_walk.force(time), time[:, None]], axis=1)
    labels = [*axes("Gyroscope", "rad/s"), *axes("Acceleration", "m/s^2"), "Absolute (m/s^2)"]
    (tmp_path / "Raw Data.csv").write_text(phyphox_table(time, values, labels))
    sequence, _ = import_recording(tmp_path / "Raw Data.csv")
    np.testing.assert_allclose(sequence.gyro, known_walk.rate(sequence.time), atol=1e-8)
    np.testing.assert_allclose(sequence.accel, known_walk.force(sequence.time), atol=1e-8)
    (tmp_path / "gyro.csv").write_text(phyphox()["Gyroscope.csv"])
    refused(
        tmp_path / "gyro.csv",
        "gyro.csv: has no accelerometer .found: gyro.csv.; record the gyroscope and",
    )
    refused(tmp_path / "gyro.csv", "gyro.csv: has no topics", imu_topic="/imu")


def test_phyphox_as_a_workbook(tmp_path, monkeypatch):
    workbooks(tmp_path, phyphox_sets())
    for name in ("walk.xlsx", "walk.xls"):
        sequence, notes = import_recording(tmp_path / name)
        compare(sequence)
        assert f"{name}: phyphox; time in s, Gyroscope in rad/s, Accelerometer in m/s2" in notes[0]
    monkeypatch.setattr(files, "LARGEST", 2**15)
    refused(tmp_path / "walk.xlsx", "walk.xlsx: unpacks to 0 MiB; no table may exceed 0 MiB")
    (tmp_path / "cut.xls").write_bytes((tmp_path / "walk.xls").read_bytes()[:3000])
    refused(tmp_path / "cut.xls", "cut.xls: cannot be read as a workbook")


def test_a_workbook_that_unpacks_to_more_than_a_logger_writes_is_refused(tmp_path, monkeypatch):
    """A cell far out makes all cells before it, and a row far down all rows."""
    for cell, words in (
        ("XFD2", "sheet 'far' has a cell in column 16384 of row 2, which is too far out; export"),
        ("A1048577", "sheet 'far' has a cell in column 1 of row 1048577, which is too far out"),
    ):
        book = openpyxl.Workbook()
        sheet = book.create_sheet("far")
        sheet.append(["time", *"xyz"])
        sheet["A2"] = 1.0
        book.save(tmp_path / "near.xlsx")
        with zipfile.ZipFile(tmp_path / "near.xlsx") as near:
            members = {name: near.read(name).decode() for name in near.namelist()}
        name = "xl/worksheets/sheet2.xml"
        row = cell.lstrip("ABCDEFGHIJKLMNOPQRSTUVWXYZ")
        assert '<row r="2"><c r="A2"' in members[name]
        members[name] = members[name].replace(
            '<row r="2"><c r="A2"', f'<row r="{row}"><c r="{cell}"'
        )
        refused(zipped(tmp_path / "far.xlsx", members), f"far.xlsx: {words}")
    workbooks(tmp_path, phyphox_sets())
    monkeypatch.setattr(files, "MOST_CELLS", 1000)
    refused(tmp_path / "walk.xlsx", "has a cell in column 4 of row 201")


def test_cells_of_a_workbook_are_what_they_show(tmp_path):
    """An error and an empty cell have no value; rows may end early."""
    book = openpyxl.Workbook()
    book.active.append(["time", "a", "b"])
    book.active.append([datetime.datetime(2024, 5, 3, 9, 15, 2, 250000), 1, 2.5])
    book.active.append([3, "#N/A"])
    book.active.append([])
    book.active.append([True, None, "x"])
    book.save(tmp_path / "walk.xlsx")
    (log,) = files.files_of(tmp_path / "walk.xlsx")
    text = "time,a,b\n2024-05-03 09:15:02.250000,1,2.5\n3,,\n,,\nTrue,,x\n"
    assert log.content().decode() == text


def test_a_zip_with_two_files_of_one_name_is_refused(tmp_path):
    members = sensor_logger("android", False)
    path = zipped(tmp_path / "walk.zip", members)
    with zipfile.ZipFile(path, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("Gyroscope.csv", members["Gyroscope.csv"])
    refused(path, "walk.zip: holds Gyroscope.csv twice; leave one of them")


@pytest.mark.parametrize("name", ["Gyroscope.csv", "Accelerometer.csv", "Metadata.csv"])
def test_a_table_of_sensor_logger_that_is_there_twice_is_refused(tmp_path, name):
    """Which of them is meant, its name does not say."""
    members = sensor_logger("android", False)
    members[name.replace(".csv", ".txt")] = members[name]
    words = rf"holds a sensor twice \(.*{name.partition('.')[0]}\.txt.*\); leave one of them"
    refused(zipped(tmp_path / "walk.zip", members), words)


def test_phyphox_that_was_paused_is_refused(tmp_path):
    """Its clock stands meanwhile: the samples show no hole."""
    events = [("START", 0.0, 100.0), ("PAUSE", 4.0, 104.0), ("START", 4.0, 107.5)]
    lines = [f'"{event}",{time:.9E},{system:.3f},"x"' for event, time, system in events]
    members = phyphox()
    header = members["meta/time.csv"]
    words = r"walk\w*\.?[a-z]*: was paused 1 times, for up to 3\.5 s"
    members["meta/time.csv"] = header + "\n".join(lines) + "\n"
    refused(unpacked(tmp_path / "walk", members), words)
    deep = {f"deep/{name}": text for name, text in members.items()}
    refused(zipped(tmp_path / "walk.zip", deep), words)
    members["meta/time.csv"] = header + "\n".join(lines[:2]) + "\n"
    compare(import_recording(zipped(tmp_path / "walk.zip", members))[0])
    workbooks(tmp_path, phyphox_sets())
    book = openpyxl.load_workbook(tmp_path / "walk.xlsx")
    sheet = book.create_sheet("Metadata Time")
    for row in [("event", "experiment time", "system time", "system time text"), *events]:
        sheet.append(row)
    book.save(tmp_path / "walk.xlsx")
    refused(tmp_path / "walk.xlsx", words)


def test_phyphox_of_an_earlier_release_in_another_language_in_degrees(tmp_path):
    time, rate, _ = phyphox_sets()["Gyroscope"]
    later, force, _ = phyphox_sets()["Accelerometer"]
    down = logger_files.gravity(later)
    sets = {
        "Gyroscope": (time, np.degrees(rate), axes("", "°/s")),
        "Beschleunigung": (later, force, axes("Beschleunigung", "m/s²")),
        "Linear Accelerometer": (later, force - down, axes("", "m/s^2")),
    }
    path = tmp_path / "walk.zip"
    sequence, notes = import_recording(zipped(path, phyphox(sets=sets)))
    compare(sequence)
    assert "Gyroscope.csv in deg/s" in notes[0]
    second = {"Second": (time, rate, axes("Gyroscope", "rad/s"))}
    words = "holds 2 sets of a sensor: .*; leave the table of one of them in it"
    refused(zipped(path, phyphox(sets=sets | second)), words)
    del sets["Beschleunigung"]
    words = "walk.zip: holds acceleration without gravity .Linear Accelerometer.csv.; record the"
    refused(zipped(path, phyphox(sets=sets)), words)
    # Gravity is found by its stamps, in any order.
    for rows in (slice(None), np.random.default_rng(0).permutation(len(later))):
        sets["Gravity"] = (later[rows], down[rows], axes("Gravity", "m/s^2"))
        compare(import_recording(zipped(path, phyphox(sets=sets)))[0])
