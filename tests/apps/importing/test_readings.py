"""The sensors beside the IMU in logs of every format, and what is wrong with them in one line."""

import numpy as np
import pytest

from tests.support import bag_files, known_walk, logger_files
from tests.support.importing import imported
from tests.support.logger_files import EPOCH, phyphox_sets, phyphox_table, sensor_logger, zipped

NORTH = np.array([20.0, 5.0, -40.0])
SLOW = np.arange(0.2, 7.5, 1.0)
TIME = np.arange(800) / 100


def field(time):
    """What a magnetometer in the walk's attitude reads, µT."""
    return known_walk.attitude(time).inv().apply(NORTH)


def pressure(time):
    """Pa."""
    return 101325.0 - 12.0 * known_walk.position(time)[:, 2]


def coordinates(time):
    return 45.0 + 1e-5 * time, 6.0 + 2e-5 * time, 300.0 + 0.1 * time


def logger_table(time, **columns):
    """A CSV of Sensor Logger."""
    lines = [",".join(["time", "seconds_elapsed", *columns])]
    for stamp, *cells in zip(time, *columns.values(), strict=True):
        numbers = ",".join(f"{cell:.9f}" for cell in cells)
        lines.append(f"{EPOCH + round(stamp * 1e9)},{stamp:.9f},{numbers}")
    return "\n".join(lines) + "\n"


def location(time, accuracy=4.0, **changes):
    latitude, longitude, altitude = coordinates(time)
    columns = {
        "verticalAccuracy": 0 * time + 6.0,
        "horizontalAccuracy": 0 * time + accuracy,
        "speed": 0 * time + 1.0,
        "altitude": altitude,
        "longitude": longitude,
        "latitude": latitude,
    }
    return logger_table(time, **(columns | changes))


def logger_members(**changes):
    time = logger_files.clock()
    members = sensor_logger() | {
        "Magnetometer.csv": logger_files.sensor_table(time, field(time)),
        "MagnetometerUncalibrated.csv": logger_files.sensor_table(time, field(time) + 9.0),
        "Barometer.csv": logger_table(
            SLOW, relativeAltitude=0 * SLOW, pressure=pressure(SLOW) / 100
        ),
        "Location.csv": location(SLOW),
    }
    return members | {name.replace("_", "."): text for name, text in changes.items()}


def compare(recording, shift=0.01, sensors=("barometer", "gnss", "magnetometer")):
    """The readings are those of the walk, whose IMU begins `shift` s after its log."""
    readings = recording.sequence.readings
    assert sorted(readings) == sorted(sensors)
    for sensor, (time, values, std) in readings.items():
        time = time + shift
        if sensor == "magnetometer":
            np.testing.assert_allclose(values, field(time), atol=1e-5)
            assert len(time) > 500
        elif sensor == "barometer":
            np.testing.assert_allclose(values[:, 0], pressure(time), atol=1e-3)
        else:
            np.testing.assert_allclose(values, np.stack(coordinates(time), axis=1), atol=1e-6)
            np.testing.assert_allclose(std, np.tile([4.0, 4.0, 6.0], (len(time), 1)))
        if sensor != "magnetometer":
            np.testing.assert_allclose(time, SLOW, atol=1e-6)


def test_sensor_logger_has_field_pressure_and_place(tmp_path):
    recording = imported(zipped(tmp_path / "walk.zip", logger_members()))
    compare(recording)
    notes = " | ".join(recording.notes)
    assert "Barometer.csv: barometer with 8 rows (1 a second)" in notes
    assert "Location.csv: gnss with 8 rows" in notes and recording.warnings == ()
    alone = logger_members()
    del alone["Magnetometer.csv"]
    uncalibrated = imported(zipped(tmp_path / "other.zip", alone)).sequence.readings
    time = uncalibrated["magnetometer"].time + 0.01
    np.testing.assert_allclose(uncalibrated["magnetometer"].values, field(time) + 9.0, atol=1e-5)


def test_phyphox_has_field_pressure_and_place_by_units_in_any_language(tmp_path):
    time = logger_files.clock()
    latitude, longitude, altitude = coordinates(SLOW)
    of_place = [latitude, longitude, altitude, 1 + 0 * SLOW, 2 + 0 * SLOW]
    of_place += [4 + 0 * SLOW, 6 + 0 * SLOW]
    names = ["Breite (°)", "Länge (°)", "Höhe (m)", "Geschw. (m/s)", "Richtung (°)"]
    names += ["Horizontale Genauigkeit (m)", "Vertikale Genauigkeit (m)"]
    fields = [f"Magnetfeld {axis} (µT)" for axis in "xyz"]
    sets = phyphox_sets() | {
        "Magnetometer": (time, field(time), fields),
        "Pressure": (SLOW, pressure(SLOW)[:, None] / 100, ["Druck (hPa)"]),
        "Location": (SLOW, np.stack(of_place, axis=1), names),
    }
    recording = imported(zipped(tmp_path / "walk.zip", logger_files.phyphox(sets=sets)))
    compare(recording)
    assert recording.warnings == ()


def table_columns(time=TIME):
    """A table of any names. Receiver and barometer have a value in every hundredth row, and are
    empty in the others."""
    rows = np.isin(np.round(time, 2), np.round(SLOW, 2))
    latitude, longitude, altitude = coordinates(time)
    return {
        "Timestamp": time,
        **{f"Gyr_{axis}": known_walk.rate(time)[:, k] for k, axis in enumerate("XYZ")},
        **{f"Acc_{axis}": known_walk.force(time)[:, k] for k, axis in enumerate("XYZ")},
        **{f"Mag_{axis}": field(time)[:, k] / 100 for k, axis in enumerate("XYZ")},
        "Baro": np.where(rows, pressure(time) / 100, np.nan),
        "GPS_LAT": np.where(rows, latitude, np.nan),
        "GPS_Lon": np.where(rows, longitude, np.nan),
        "gps_altitude": np.where(rows, altitude, np.nan),
        "HAcc": np.where(rows, 4.0, np.nan),
        "vAcc": np.where(rows, 6.0, np.nan),
    }


def write_table(path, columns):
    lines = [",".join(columns)]
    for cells in zip(*columns.values(), strict=True):
        lines.append(",".join("" if np.isnan(cell) else f"{cell:.9f}" for cell in cells))
    path.write_text("\n".join(lines))
    return path


def import_table(path, table, /, **stated):
    return imported(write_table(path / "walk.csv", table), gyro_unit="rad/s", **stated)


def test_a_table_of_any_names_has_them_beside_the_imu_in_rows_of_their_own(tmp_path):
    recording = import_table(tmp_path, table_columns())
    compare(recording, 0.0)
    notes = " | ".join(recording.notes)
    assert "magnetometer taken as gauss (median 0.45" in notes
    assert "barometer taken as hPa (median 1013" in notes


@pytest.mark.parametrize("period", [1000, 4096])
def test_readings_have_the_repaired_clock_of_their_rows(tmp_path, period):
    """A clock in ms wraps after a second, or at 12 bits."""
    columns = table_columns()
    columns["Timestamp"] = np.round(TIME * 1000) % period
    recording = import_table(tmp_path, columns, time_unit="ms")
    assert "the clock of gyro wrapped" in " | ".join(recording.notes)
    compare(recording, 0.0)


def test_readings_between_the_rows_of_the_imu_have_its_repaired_clock(tmp_path):
    """The receiver has rows of its own, one of them between two rows around a wrap."""
    columns = table_columns()
    rows = np.flatnonzero(np.isfinite(columns["GPS_LAT"]))
    stamps = np.insert(np.round(TIME * 1000), rows, np.round(TIME[rows] * 1000) - 5)
    for name, cells in columns.items():
        is_fix = name.startswith(("GPS", "gps", "HAcc", "vAcc"))
        fix_cells = np.where(is_fix, cells[rows], np.nan)
        columns[name] = np.insert(np.where(is_fix, np.nan, cells), rows, fix_cells)
    # The fourth fix has the stamp 4095, and the row after it 4.
    columns["Timestamp"] = (stamps + 900) % 4096
    recording = import_table(tmp_path, columns, time_unit="ms")
    time, values, _ = recording.sequence.readings["gnss"]
    np.testing.assert_allclose(time, SLOW - 0.005, atol=1e-6)
    np.testing.assert_allclose(values[:, 0], coordinates(SLOW)[0], atol=1e-8)


def test_readings_after_another_start_of_the_clock_are_left_out(tmp_path):
    columns = table_columns()
    columns["Timestamp"] = np.where(TIME < 7, TIME, TIME - 7 + 1.003)
    recording = import_table(tmp_path, columns)
    time, values, _ = recording.sequence.readings["gnss"]
    np.testing.assert_allclose(time, SLOW[:-1], atol=1e-6)
    np.testing.assert_allclose(values[:, 0], coordinates(SLOW[:-1])[0], atol=1e-8)
    assert "1 rows of gnss have no time on this clock" in " | ".join(recording.notes)


def test_a_table_of_its_own_whose_clock_starts_again_is_left_out(tmp_path):
    write_table(tmp_path / "imu.csv", {n: c for n, c in list(table_columns().items())[:7]})
    stamps = np.where(TIME < 4, TIME, TIME - 4 + 0.003)
    fields = {f"mag_{axis}": field(TIME)[:, k] for k, axis in enumerate("xyz")}
    write_table(tmp_path / "mag.csv", {"time": stamps} | fields)
    recording = imported(tmp_path, gyro_unit="rad/s")
    (warning,) = recording.warnings
    assert recording.sequence.readings == {}
    assert "mag.csv: the clock of magnetometer wraps, starts again or was set back" in warning


@pytest.mark.parametrize(
    ("factors", "names"),
    [
        (
            {"GPS_LAT": np.pi / 180, "gps_altitude": 1 / 0.3048, "HAcc": 1e3, "Baro": 1 / 33.8639},
            {
                "GPS_LAT": "GPS_LAT (rad)",
                "gps_altitude": "gps_altitude [ft]",
                "HAcc": "HAcc (mm)",
                "Baro": "Baro (inHg)",
            },
        ),
        (
            {"GPS_Lon": 1e7, "gps_altitude": 1e-3, "Baro": 1 / 1.33322}
            | dict.fromkeys(["Mag_X", "Mag_Y", "Mag_Z"], 1e3),
            {
                "GPS_Lon": "GPS_Lon (degE7)",
                "gps_altitude": "gps_altitude_km",
                "Baro": "Baro (mmHg)",
                **{f"Mag_{axis}": f"Mag_{axis} (mG)" for axis in "XYZ"},
            },
        ),
    ],
)
def test_a_unit_in_the_header_of_another_sensor_counts(tmp_path, factors, names):
    columns = table_columns()
    columns = {names.get(n, n): factors.get(n, 1.0) * cells for n, cells in columns.items()}
    recording = import_table(tmp_path, columns)
    time, values, _ = recording.sequence.readings["barometer"]
    np.testing.assert_allclose(values[:, 0], pressure(time), rtol=2e-6)
    time, values, std = recording.sequence.readings["gnss"]
    np.testing.assert_allclose(values, np.stack(coordinates(time), axis=1), rtol=1e-8)
    np.testing.assert_allclose(std[:, 0], 4.0)
    time, values, _ = recording.sequence.readings["magnetometer"]
    np.testing.assert_allclose(values, field(time), atol=1e-5)


def test_a_row_of_units_counts_for_another_sensor(tmp_path):
    columns = table_columns() | {"GPS_LAT": np.radians(table_columns()["GPS_LAT"])}
    path = write_table(tmp_path / "walk.csv", columns)
    header, rows = path.read_text().split("\n", 1)
    units = "s,rad/s,rad/s,rad/s,m/s2,m/s2,m/s2,G,G,G,hPa,rad,°,m,m,m"
    path.write_text(f"{header}\n{units}\n{rows}")
    compare(imported(path), 0.0)


@pytest.mark.parametrize(
    ("name", "unit", "sensor"),
    [
        ("gps_altitude", "fathom", "gnss"),
        ("GPS_LAT", "gon", "gnss"),
        ("Baro", "C", "barometer"),
        ("Mag_Y", "LSB", "magnetometer"),
    ],
)
def test_an_unknown_unit_in_the_header_of_another_sensor_is_no_reading(
    tmp_path, name, unit, sensor
):
    columns = {f"{n} ({unit})" if n == name else n: c for n, c in table_columns().items()}
    recording = import_table(tmp_path, columns)
    (warning,) = recording.warnings
    assert warning.startswith(f"{sensor}: it is left out: ")
    assert f"column '{name} ({unit})' is in '{unit}', no known unit; convert it" in warning
    compare(recording, 0.0, {"barometer", "gnss", "magnetometer"} - {sensor})


@pytest.mark.parametrize(("tick", "of_imu"), [(1.0, 1000), (1000, 1.0), (1e6, 1000)])
def test_a_table_of_its_own_has_its_own_unit_of_time(tmp_path, tick, of_imu):
    columns = table_columns()
    imu = {name: columns[name] for name in list(columns)[:7]}
    write_table(tmp_path / "imu.csv", imu | {"Timestamp": TIME * of_imu})
    latitude, longitude, altitude = coordinates(SLOW)
    fixes = {"lat": latitude, "lon": longitude, "altitude": altitude}
    accuracies = {"accuracy": 4 + 0 * SLOW, "vertical_accuracy": 6 + 0 * SLOW}
    write_table(tmp_path / "gps.csv", {"time": SLOW * tick} | fixes | accuracies)
    compare(imported(tmp_path, gyro_unit="rad/s"), 0.0, ("gnss",))
    write_table(tmp_path / "imu.csv", {name: imu[name] for name in list(imu)[1:]})
    stated = {"gyro_unit": "rad/s", "sample_rate": 100.0}
    compare(imported(tmp_path, **stated), 0.0, ("gnss",))
    write_table(tmp_path / "gps.csv", {"time": (SLOW + 50) * tick} | fixes | accuracies)
    (warning,) = imported(tmp_path, **stated).warnings
    assert "gps.csv: the stamps of field 'gnss' (" in warning
    assert "do not fit the 7.99 s of the IMU in any unit; give the stamps of both by" in warning


def test_a_folder_of_tables_has_the_place_in_a_table_of_its_own(tmp_path):
    time = np.arange(800) / 100
    for name, values in (("gyro", known_walk.rate(time)), ("accel", known_walk.force(time))):
        table = np.column_stack([time, values])
        text = {"header": "time,x,y,z", "comments": "", "delimiter": ","}
        np.savetxt(tmp_path / f"{name}.csv", table, **text)
    table = np.column_stack([SLOW, *coordinates(SLOW), 4 + 0 * SLOW, 6 + 0 * SLOW])
    header = "time,lat,lng,height,accuracy,vertical_accuracy"
    np.savetxt(tmp_path / "gps.csv", table, header=header, comments="", delimiter=",")
    compare(imported(tmp_path, gyro_unit="rad/s"), 0.0, ("gnss",))


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_bag_has_them_as_messages_and_a_field_in_the_axes_of_the_imu(tmp_path, kind):
    """The magnetometer is turned by a quarter about z against the IMU."""
    from scipy.spatial.transform import Rotation

    make, turn = bag_files.Maker(kind), Rotation.from_euler("z", 90, degrees=True)
    names = {n: f"sensor_msgs/msg/{n}" for n in ("MagneticField", "FluidPressure", "NavSatFix")}

    def magnetic(time):
        values = turn.inv().apply(field(np.array([time]))[0]) * 1e-6
        header = make.header(time, "mag")
        return make.new(names["MagneticField"], header, make.vector(values), np.zeros(9))

    def fluid(time):
        header, value = make.header(time, "imu_link"), float(pressure(np.array([time]))[0])
        return make.new(names["FluidPressure"], header, value, 0.0)

    def fix(time):
        status = make.new("sensor_msgs/msg/NavSatStatus", 0 if time < 5 else -1, 1)
        spread = np.diag([16.0, 16.0, 36.0]).ravel()
        header, values = make.header(time, "gps"), map(float, coordinates(time))
        return make.new(names["NavSatFix"], header, status, *values, spread, 2)

    entries = bag_files.imu(make, seconds=8.0)
    static = make.static("imu_link", "mag", turn, [0.0, 0.0, 0.0])
    entries += bag_files.rows("/tf_static", "tf2_msgs/msg/TFMessage", [0.0], lambda _: static)
    entries += bag_files.rows("/mag", names["MagneticField"], bag_files.clock(100.0, 8), magnetic)
    entries += bag_files.rows("/baro", names["FluidPressure"], SLOW, fluid)
    entries += bag_files.rows("/fix", names["NavSatFix"], SLOW, fix)
    recording = imported(bag_files.write(tmp_path, kind, entries))
    readings = recording.sequence.readings
    assert len(readings["gnss"].time) == 5  # those with a fix
    without_fix = dict(readings)
    del without_fix["gnss"]
    remainder = recording._replace(sequence=recording.sequence._replace(readings=without_fix))
    compare(remainder, 0.0, ("barometer", "magnetometer"))
    np.testing.assert_allclose(readings["gnss"].std[0], [4.0, 4.0, 6.0])


@pytest.mark.parametrize(
    ("changes", "sensor", "words"),
    [
        (
            {"Barometer_csv": logger_table(SLOW, pressure=pressure(SLOW))},
            "barometer",
            "Barometer.csv: field 'barometer' has a median of 1.0131e+07, expected 30000 to",
        ),
        (
            {"Magnetometer_csv": logger_files.sensor_table(SLOW, field(SLOW) / 100)},
            "magnetometer",
            "Magnetometer.csv: field 'magnetometer' has a median of 0.45",
        ),
        (
            {"Location_csv": location(SLOW, latitude=0 * SLOW + 95.0)},
            "gnss",
            "Location.csv: column 'latitude' of field 'gnss' reaches 95, beyond ±90; give it in",
        ),
        (
            {"Location_csv": location(SLOW + 5000.0)},
            "gnss",
            "by the clock of the IMU",
        ),
        (
            {"Location_csv": location(SLOW, accuracy=-1.0)},
            "gnss",
            "no row of field 'gnss' has a reading; switch the sensor on",
        ),
    ],
)
def test_a_sensor_that_cannot_be_used_is_left_out_with_a_remedy(tmp_path, changes, sensor, words):
    recording = imported(zipped(tmp_path / "walk.zip", logger_members(**changes)))
    (warning,) = recording.warnings
    assert warning.startswith(f"{sensor}: it is left out: ") and words in warning
    assert "\n" not in warning and "walk.zip" in warning
    compare(recording, sensors={"barometer", "gnss", "magnetometer"} - {sensor})


def test_missing_late_repeated_and_damaged_rows_are_left_out_and_counted(tmp_path):
    """A receiver repeats its last fix, writes zeros before its first one, loses the height once,
    and a row comes late."""
    latitude, longitude, altitude = (np.array(x) for x in coordinates(SLOW))
    time = np.concatenate([SLOW, SLOW[5:6] + 0.5, [0.01]])
    rows = [0, 1, 2, 4, 3, 5, 6, 7]  # two of them exchanged

    def column(values, first):
        return np.concatenate([values[rows], values[5:6], [first]])

    changed = altitude.copy()
    changed[2] = np.nan
    time[:8] = SLOW[rows]
    text = location(
        time,
        latitude=column(latitude, 0.0),
        longitude=column(longitude, 0.0),
        altitude=column(changed, 0.0),
    )
    recording = imported(zipped(tmp_path / "walk.zip", logger_members(Location_csv=text)))
    (stamps, values, _), notes = recording.sequence.readings["gnss"], " | ".join(recording.notes)
    np.testing.assert_allclose(stamps + 0.01, SLOW, atol=1e-6)
    np.testing.assert_allclose(values[:, 0], latitude, atol=1e-8)
    assert np.flatnonzero(np.isnan(values[:, 2])).tolist() == [2]
    assert "1 rows of gnss repeat the one before and are left out" in notes


def test_a_log_whose_other_sensors_are_empty_is_read_without_them(tmp_path):
    members = logger_members(
        Location_csv="time,seconds_elapsed,latitude,longitude\n",
        Barometer_csv="time,seconds_elapsed,relativeAltitude,pressure\n",
    )
    recording = imported(zipped(tmp_path / "walk.zip", members))
    compare(recording, sensors=("magnetometer",))
    assert recording.warnings == ()
    notes = [note for note in recording.notes if "left out" in note]
    assert all("holds no row" in note for note in notes) and len(notes) == 2


def test_a_log_whose_other_sensors_lack_a_column_is_read_without_them_with_a_warning(tmp_path):
    members = logger_members(
        Barometer_csv="time,seconds_elapsed,relativeAltitude\n1,0.1,2.0\n2,0.2,2.0\n",
        Location_csv=location(SLOW).replace("longitude", "lon"),
    )
    recording = imported(zipped(tmp_path / "walk.zip", members))
    compare(recording, sensors=("magnetometer",))
    text = " | ".join(recording.warnings)
    assert "barometer: it is left out: " in text and "column 'pressure' is missing" in text
    assert "gnss: it is left out: " in text and "column 'longitude' is missing" in text


def test_a_phyphox_table_may_have_several_other_sensors(tmp_path):
    sets, (latitude, longitude, altitude) = phyphox_sets(), coordinates(TIME)
    of_place = [latitude, longitude, altitude, 1 + 0 * TIME, 4 + 0 * TIME, 6 + 0 * TIME]
    names = ["Latitude (°)", "Longitude (°)", "Height (m)", "Velocity (m/s)"]
    names += ["Horizontal Accuracy (m)", "Vertical Accuracy (m)"]
    values = [*field(TIME).T, pressure(TIME) / 100, *of_place]
    labels = [f"Magnetic field {axis} (µT)" for axis in "xyz"] + ["Pressure (hPa)", *names]
    members = logger_files.phyphox(sets=sets | {"All": (TIME, np.stack(values, axis=1), labels)})
    recording = imported(zipped(tmp_path / "walk.zip", members))
    readings = recording.sequence.readings
    assert sorted(readings) == ["barometer", "gnss", "magnetometer"]
    time = readings["gnss"].time + 0.01
    np.testing.assert_allclose(readings["gnss"].values[:, 0], coordinates(time)[0], atol=1e-7)
    np.testing.assert_allclose(readings["gnss"].std[0], [4.0, 4.0, 6.0])
    assert recording.warnings == ()


def test_a_phyphox_table_without_stamps_has_no_readings(tmp_path):
    sets = phyphox_sets()
    members = logger_files.phyphox(sets=sets)
    members["Pressure.csv"] = phyphox_table(SLOW, pressure(SLOW)[:, None], ["p (hPa)"]).replace(
        "Time (s)", "Index"
    )
    recording = imported(zipped(tmp_path / "walk.zip", members))
    assert recording.sequence.readings == {}
    (warning,) = recording.warnings
    assert "barometer: it is left out: " in warning and "column 'Time (s)' is missing" in warning


def test_what_is_beside_a_pressure_is_no_pressure(tmp_path):
    """A temperature of the barometer alone is no barometer, and beside it no second one."""
    columns = table_columns() | {"baro_temp (C)": 31 + 0.01 * TIME, "baro_temp": 31 + 0.01 * TIME}
    compare(import_table(tmp_path, columns), 0.0)
    del columns["Baro"]
    recording = import_table(tmp_path, columns)
    compare(recording, 0.0, ("gnss", "magnetometer"))
    assert recording.warnings == ()


def test_the_status_of_a_sensor_is_no_accuracy_of_a_receiver(tmp_path):
    columns = table_columns() | {"accuracy": 3 + 0 * TIME}
    del columns["HAcc"]
    recording = import_table(tmp_path, columns)
    assert np.isnan(recording.sequence.readings["gnss"].std[:, 0]).all()
    assert "column 'accuracy' is Android's status" in " | ".join(recording.notes)
    rows = np.isfinite(columns["GPS_LAT"])
    recording = import_table(tmp_path, columns | {"accuracy": np.where(rows, 3.0, np.nan)})
    np.testing.assert_allclose(recording.sequence.readings["gnss"].std[:, 0], 3.0)


def test_columns_that_exchange_the_axes_leave_the_magnetometer_out(tmp_path):
    """The table is of a body that is turned by a quarter about z."""
    columns = table_columns()
    names = {f"Gyr_{a}": f"u{n}" for n, a in enumerate("YXZ")}
    names |= {f"Acc_{a}": f"v{n}" for n, a in enumerate("YXZ")}
    for sensor in ("Gyr", "Acc"):
        columns[f"{sensor}_X"] = -columns[f"{sensor}_X"]
    columns = {names.get(name, name): cells for name, cells in columns.items()}
    words = {"gyro_x": "-u1", "gyro_y": "u0", "gyro_z": "u2"}
    words |= {axis.replace("gyro", "accel"): name.replace("u", "v") for axis, name in words.items()}
    recording = import_table(tmp_path, columns, columns=words)
    compare(recording, 0.0, ("barometer", "gnss"))
    (warning,) = recording.warnings
    assert (
        "magnetometer: it is left out: " in warning and "--columns gives the gyro other" in warning
    )
    plain = {f"gyro_{a.lower()}": f"Gyr_{a}" for a in "XYZ"}
    compare(import_table(tmp_path, table_columns(), columns=plain), 0.0)
    accel = {f"accel_{a.lower()}": f"-Acc_{a}" for a in "XYZ"}  # iOS's sign has the same axes
    columns = table_columns() | {f"Acc_{a}": -table_columns()[f"Acc_{a}"] for a in "XYZ"}
    compare(import_table(tmp_path, columns, columns=accel), 0.0)
    cyclic = {"Gyr_X": "Gyr_Y", "Gyr_Y": "Gyr_Z", "Gyr_Z": "Gyr_X"}
    cyclic |= {
        name.replace("Gyr", "Acc"): other.replace("Gyr", "Acc") for name, other in cyclic.items()
    }
    columns = {cyclic.get(name, name): cells for name, cells in table_columns().items()}
    words = {"gyro_x": "Gyr_Y", "gyro_y": "Gyr_Z", "gyro_z": "Gyr_X"}
    words |= {f"accel_{axis[-1]}": name.replace("Gyr", "Acc") for axis, name in words.items()}
    compare(import_table(tmp_path, columns, columns=words), 0.0, ("barometer", "gnss"))


@pytest.mark.parametrize("header", ["# MAGN;AppTime(s);time(s);Mag_X(uT);Mag_Y(uT);Mag_Z(uT)", ""])
def test_rows_that_name_another_sensor_are_read_or_warned_of(tmp_path, header):
    lines = [header] if header else []
    values = known_walk.force(TIME), known_walk.rate(TIME), field(TIME)
    for row, time in enumerate(TIME):
        for tag, vectors in zip(("ACCE", "GYRO", "MAGN"), values, strict=True):
            cells = ";".join(f"{value:.9f}" for value in vectors[row])
            lines.append(f"{tag};{time:.3f};{time:.3f};{cells}")
    (tmp_path / "log.txt").write_text("\n".join(lines))
    recording = imported(tmp_path / "log.txt", gyro_unit="rad/s")
    if header:
        compare(recording, 0.0, ("magnetometer",))
        assert recording.warnings == ()
    else:
        (warning,) = recording.warnings
        assert "magnetometer: it is left out: " in warning and "MAGN: has no header with" in warning
        assert "it is a comment, # MAGN, ..." in warning


@pytest.mark.parametrize("delay", [18.0, -0.05])
def test_a_fix_that_is_stamped_by_another_clock_has_that_of_the_bag(tmp_path, delay):
    """A receiver that stamps in the time of GPS, and one that is late as receivers are."""
    make, name = bag_files.Maker("mcap"), "sensor_msgs/msg/NavSatFix"

    def fix(time):
        status = make.new("sensor_msgs/msg/NavSatStatus", 0, 1)
        header, values = make.header(time + delay, "gps"), map(float, coordinates(time))
        return make.new(name, header, status, *values, np.zeros(9), 0)

    entries = bag_files.imu(make, seconds=8.0) + bag_files.rows("/fix", name, SLOW, fix)
    recording = imported(bag_files.write(tmp_path, "mcap", entries))
    shift = delay if delay < 0 else 0.0
    np.testing.assert_allclose(recording.sequence.readings["gnss"].time, SLOW + shift, atol=1e-6)
    text = "the headers of /fix are +18.00 s from the IMU's, by the bag's clock, whose stamps are"
    assert [text in warning for warning in recording.warnings] == [True] * (delay > 0)
