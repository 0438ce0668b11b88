"""Phone loggers' files must tell of the known walk again; what is ambiguous is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.apps import importing
from gnio_jax.config import ImportOptions
from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.errors import InputError
from tests.support import known_walk
from tests.support.csv_writers import AXES, SECONDS, compare_imu, imu, write
from tests.support.importing import import_recording

G = 9.80665


MAPPED = {
    "time": "Timestamp",
    "gyro_x": "wx",
    "gyro_y": "wy",
    "gyro_z": "wz",
    "accel_x": "ax",
    "accel_y": "ay",
    "accel_z": "az",
}
UNITS = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}
UNIX = 1_700_000_000_123_456_789


def stamps_of(time, unit):
    """As loggers write them: whole numbers but for seconds, unix time but for a clock that starts
    with the recording."""
    nanoseconds = UNIX + np.round(time * 1e9).astype(np.int64)
    return nanoseconds / 1e9 if unit == "s" else nanoseconds // round(1e9 / UNITS[unit])


def write_logger(path, time=None, unit="ns", gyro=1.0, accel=1.0, separator=",", spoil=None):
    time = np.arange(round(SECONDS * 200)) / 200 if time is None else time
    values = imu(time)
    columns = {"Timestamp": stamps_of(time, unit), "steps": np.zeros(len(time), dtype=int)}
    columns |= dict(zip(("wz", "wy", "wx"), (values[:, 2::-1] * gyro).T, strict=True))
    columns |= dict(zip(("az", "ay", "ax"), (values[:, 5:2:-1] * accel).T, strict=True))
    if spoil:
        columns = spoil(columns)
    return write(path, list(columns), list(columns.values()), separator)


_FACTORS = [(1.0, 1.0), (180 / np.pi, 1 / G), (1.0, 1000 / G)]


@pytest.mark.parametrize(
    ("unit", "gyro", "accel", "separator"),
    [
        *((unit, gyro, accel, ",") for unit in UNITS for gyro, accel in _FACTORS),
        ("ns", 1.0, 1.0, ";"),
        ("ns", 1.0, 1.0, "\t"),
    ],
)
def test_units_and_separators_are_detected_and_reported(tmp_path, unit, gyro, accel, separator):
    path = write_logger(
        tmp_path / "phone.csv", unit=unit, gyro=gyro, accel=accel, separator=separator
    )
    sequence, notes = import_recording(path, MAPPED)
    # Milliseconds of a 200 Hz clock are exact; unix seconds in a float are good to a quarter of a
    # microsecond.
    compare_imu(sequence)
    assert (
        sequence.time[0] == 0.0
        and np.allclose(np.diff(sequence.time), 0.005, atol=1e-6)
        and not sequence.valid.any()
    )
    assert np.isnan(sequence.orientation).all() and sequence.name == "phone"
    text = " | ".join(notes)
    assert f"time of gyro taken as {unit}, by which it runs at 200 Hz" in text
    assert f"gyro taken as {'rad/s' if gyro == 1.0 else 'deg/s'}" in text
    assert f"accel taken as {'m/s2' if accel == 1.0 else 'g' if accel < 1 else 'mg'}" in text
    assert "uniform clock of 200 Hz" in text and "quietest second accel reads" in text


@pytest.mark.parametrize("name", ["gyro_unit", "accel_unit", "time_unit"])
def test_a_stated_unit_is_taken_and_not_reported_as_detected(tmp_path, name):
    path = write_logger(tmp_path / "phone.csv", gyro=180 / np.pi, accel=1 / G)
    sequence, notes = import_recording(
        path, MAPPED, **{name: {"gyro_unit": "deg/s", "accel_unit": "g", "time_unit": "ns"}[name]}
    )
    compare_imu(sequence)
    start = f"phone.csv: {name.removesuffix('_unit')}"
    assert (
        not any(
            note.startswith((f"{start} taken as", f"{start} of gyro taken as")) for note in notes
        )
        and len(notes) >= 4
    )


def test_a_wrong_statement_is_refused_by_what_it_makes_of_the_data(tmp_path):
    path = write_logger(tmp_path / "phone.csv")
    for options, words in (
        ({"time_unit": "ms"}, "field 'time' makes gyro run at"),
        ({"accel_unit": "g"}, "field 'accel'"),
        ({"rate": 0.0}, "rate: 0 Hz"),
    ):
        with pytest.raises(InputError, match=words):
            import_recording(path, MAPPED, **options)
    for name, value, words in (
        ("time_unit", "hours", "unknown value 'hours'; known: s, ms, us, ns"),
        ("gyro_unit", "rpm", "unknown value 'rpm'"),
        ("accel_sign", "up", "unknown value 'up'"),
    ):
        stated = ImportOptions()
        object.__setattr__(stated, name, value)  # the tests' type checks refuse it at once
        with pytest.raises(InputError, match=words):
            importing.import_recording(path, stated)
    with pytest.raises(
        InputError, match=r"columns: unknown name 'gyro'; known names: time, accel_time, gyro_x"
    ):
        import_recording(path, {"gyro": "wx"})
    with pytest.raises(
        InputError, match=r"phone\.csv: column 'accel_x' is missing; found: Timestamp"
    ):
        import_recording(
            path, {name: column for name, column in MAPPED.items() if name != "accel_x"}
        )
    with pytest.raises(InputError, match=r"gone\.csv: cannot be read"):
        import_recording(tmp_path / "gone.csv")


def test_slow_turns_tell_their_unit_by_the_turning_of_gravity(tmp_path):
    """A turntable tips by 20°/s at most: as numbers 20 is possible in both units."""
    time = np.arange(2000) / 100
    angle = np.radians(40.0) * np.sin(2 * np.pi * time / 13.0)
    rate = np.radians(40.0) * 2 * np.pi / 13.0 * np.cos(2 * np.pi * time / 13.0)
    force = np.stack([0 * time, 9.81 * np.sin(angle), 9.81 * np.cos(angle)], axis=1)
    for unit, factor in (("deg/s", 180 / np.pi), ("rad/s", 1.0)):
        path = write(
            tmp_path / "table.csv",
            ["time", *AXES],
            [time, rate * factor, 0 * time, 0 * time, *force.T],
        )
        sequence, notes = import_recording(path)
        np.testing.assert_allclose(sequence.gyro[:, 0], rate, atol=1e-6)
        assert any(f"gyro taken as {unit} (gravity turns by" in note for note in notes)


def test_what_lies_still_is_ambiguous_until_its_unit_is_stated(tmp_path):
    noise = np.random.default_rng(1)
    time = np.arange(1000) / 100
    force = [noise.normal(mean, 0.02, 1000) for mean in (0.0, 0.0, 9.8)]
    path = write(
        tmp_path / "still.csv", ["time", *AXES], [time, *noise.normal(0, 0.05, (3, 1000)), *force]
    )
    with pytest.raises(
        InputError,
        match=r"still\.csv: the unit of field 'gyro' is ambiguous .*; state it: rad/s or deg/s",
    ):
        import_recording(path)
    sequence, _ = import_recording(path, gyro_unit="deg/s")
    assert np.abs(sequence.gyro).max() < 0.01


def test_a_rate_or_a_magnitude_of_no_unit_is_refused(tmp_path):
    time = np.arange(500) / 5.0
    path = write(tmp_path / "slow.csv", ["time", *AXES], [time, *imu(time).T])
    with pytest.raises(
        InputError,
        match=r"slow\.csv: the unit of field 'time' is ambiguous "
        r"\(in seconds gyro would run at 5 Hz\)",
    ):
        import_recording(path)
    path = write_logger(tmp_path / "linear.csv", accel=0.3)
    with pytest.raises(
        InputError, match=r"linear\.csv: the unit of field 'accel' is ambiguous .*gravity included"
    ):
        import_recording(path, MAPPED)


def test_signs_are_turned_when_stated_or_asked_for(tmp_path):
    time = np.arange(2800) / 200
    upright = Rotation.from_euler("y", 90, degrees=True)
    for sign, factor in (("android", 1.0), ("ios", -1.0)):
        path = write_logger(tmp_path / f"{sign}.csv", accel=factor / G)
        stated, notes = import_recording(path, MAPPED, accel_sign=sign)
        compare_imu(stated)
        assert any("negated" in note for note in notes) == (sign == "ios")
        detected, notes = import_recording(path, MAPPED, accel_sign="detect")
        compare_imu(detected)
        assert any("assuming that the screen points up" in note for note in notes)
    left, notes = import_recording(tmp_path / "ios.csv", MAPPED)  # neither stated nor asked for
    np.testing.assert_allclose(left.accel, -known_walk.force(left.time), atol=1e-3)
    values = imu(time)
    columns = [time, *upright.apply(values[:, :3]).T, *upright.apply(values[:, 3:]).T]
    path = write(tmp_path / "upright.csv", ["time", *AXES], columns)
    with pytest.raises(
        InputError, match=r"the sign of field 'accel' is ambiguous .*; state it: android or ios"
    ):
        import_recording(path, accel_sign="detect")


def test_gravity_and_user_acceleration_apart_are_summed(tmp_path):
    time = np.arange(2800) / 200
    values, gravity = imu(time), known_walk.attitude(time).inv().apply([0.0, 0.0, 1.0])
    user = values[:, 3:] / G - gravity
    names = ["time", *AXES[:3], *(f"gravity{a}" for a in "XYZ"), *(f"user{a}" for a in "XYZ")]
    path = write(tmp_path / "phone.csv", names, [time, *values[:, :3].T, *-gravity.T, *-user.T])
    sums = {f"accel_{a}": f"gravity{a.upper()} + user{a.upper()}" for a in "xyz"}
    sequence, _ = import_recording(path, sums, accel_sign="ios")
    compare_imu(sequence)
    with pytest.raises(InputError, match="column 'userQ' is missing"):
        import_recording(path, sums | {"accel_x": "gravityX+userQ"})


def shuffle(columns):
    order = np.arange(len(columns["Timestamp"]))
    order[[100, 140]] = order[[140, 100]]
    order = np.delete(np.insert(order, 700, order[700]), [1000, 1001])
    return {name: values[order] for name, values in columns.items()}


def test_rows_out_of_order_are_sorted(tmp_path):
    path = write_logger(tmp_path / "phone.csv", spoil=shuffle)
    sequence, notes = import_recording(path, MAPPED)
    compare_imu(sequence)
    text = " | ".join(notes)
    assert (
        "gyro had 2 steps back in time; its rows were sorted" in text
        and "1 rows of accel repeat a stamp and were dropped" in text
    )


def test_a_clock_that_is_set_back_is_refused(tmp_path):
    """Sorted, the samples of two times would lie among each other: noise of twice the rate. A
    block in the wrong place only has to be moved."""

    def back(columns):
        later = np.arange(2800) >= 1500
        return columns | {"Timestamp": columns["Timestamp"] - later * 2_003_000_000}

    path = write_logger(tmp_path / "back.csv", spoil=back)
    problem = r"back\.csv: gyro: field 'time' jumps back by 2\.00 s after 7\.495.* s, .*overlaps"
    with pytest.raises(InputError, match=problem):
        import_recording(path, MAPPED)
    moved = np.r_[1000:1600, 0:1000, 1600:2800]
    path = write_logger(
        tmp_path / "moved.csv", spoil=lambda c: {name: values[moved] for name, values in c.items()}
    )
    compare_imu(import_recording(path, MAPPED).sequence)


def test_decimal_commas_are_seen_behind_whole_numbers(tmp_path):
    path = write_logger(tmp_path / "phone.csv", unit="ms", separator=";")
    first, *rows = path.read_text().replace(".", ",").splitlines()
    rows[0] = ";".join(cell.split(",")[0] for cell in rows[0].split(";"))
    path.write_bytes("\r\n".join(["\ufeff" + first, *rows]).encode())
    sequence, _ = import_recording(path, MAPPED)
    np.testing.assert_allclose(
        sequence.accel[100:110], imu(sequence.time[100:110])[:, 3:], atol=1e-3
    )


def test_a_clock_too_coarse_and_gaps_are_told(tmp_path):
    coarse = write_logger(
        tmp_path / "coarse.csv", spoil=lambda c: c | {"Timestamp": c["Timestamp"] // 10**7 * 10**7}
    )
    with pytest.raises(
        InputError,
        match=r"coarse\.csv: gyro: field 'time' gives 1400 of 2800 rows the stamp of another .*; "
        r"give stamps fine enough",
    ):
        import_recording(coarse, MAPPED)
    keep = np.delete(np.arange(2800), np.arange(1000, 1079))
    path = write_logger(
        tmp_path / "holes.csv", spoil=lambda c: {name: values[keep] for name, values in c.items()}
    )
    _, notes = import_recording(path, MAPPED)
    assert any("gyro lacks samples 1 times, for up to 0.40 s" in note for note in notes)
    keep = np.delete(np.arange(2800), np.arange(1000, 1280))
    path = write_logger(
        tmp_path / "lost.csv", spoil=lambda c: {name: values[keep] for name, values in c.items()}
    )
    with pytest.raises(InputError, match=r"lost\.csv: field 'time' has a gap of 1\.405 s"):
        import_recording(path, MAPPED)


@pytest.mark.parametrize(("gyro_rate", "accel_rate"), [(208.0, 100.0), (100.0, 197.0)])
def test_one_file_per_sensor_is_joined_on_one_clock(tmp_path, gyro_rate, accel_rate):
    """Android writes every sensor's events with stamps of their own, from when it was switched on
    to when it was switched off."""
    noise = np.random.default_rng(2)
    gyro_time = np.arange(0.0, SECONDS, 1 / gyro_rate) + 0.2
    accel_time = np.arange(0.0, SECONDS, 1 / accel_rate) - 0.3
    accel_time = accel_time + noise.uniform(-2e-4, 2e-4, len(accel_time))
    head = ["time", "z", "y", "x", "accuracy"]
    gyro = write(
        tmp_path / "Gyroscope.csv",
        head,
        [stamps_of(gyro_time, "ns"), *imu(gyro_time)[:, 2::-1].T, np.full(len(gyro_time), 3)],
    )
    accel = write(
        tmp_path / "Accelerometer.csv",
        ["t", *head[1:]],
        [stamps_of(accel_time, "ns"), *imu(accel_time)[:, 5:2:-1].T, np.full(len(accel_time), 3)],
    )
    columns = {f"{sensor}_{axis}": axis for sensor in ("gyro", "accel") for axis in "xyz"} | {
        "time": "time",
        "accel_time": "t",
    }
    sequence, notes = import_recording(gyro, columns, accel_path=accel, rate=100.0, name="walk")
    assert np.allclose(np.diff(sequence.time), 0.01) and sequence.name == "walk"
    start = gyro_time[(gyro_time >= accel_time[0])][0]
    # The joint clock starts where both sensors run, at a sample of the gyro.
    inner = slice(20, -20)  # the low-pass towards 100 Hz mirrors at the ends
    known = imu(sequence.time + start)
    np.testing.assert_allclose(sequence.gyro[inner], known[inner, :3], atol=1e-3)
    np.testing.assert_allclose(sequence.accel[inner], known[inner, 3:], atol=1e-3)
    assert sequence.time[-1] == pytest.approx(SECONDS - 0.3 - start, abs=0.03)
    assert sequence.imu_valid is None
    assert any("stamps of their own: both are interpolated, 1.0" in note for note in notes), notes

    # One clock, but another unit in the other file.
    accel = write(
        tmp_path / "Accelerometer.csv",
        ["t", *head[1:]],
        [stamps_of(accel_time, "us"), *imu(accel_time)[:, 5:2:-1].T, np.full(len(accel_time), 3)],
    )
    same, _ = import_recording(gyro, columns, accel_path=accel, rate=100.0)
    np.testing.assert_allclose(same.accel[inner], known[inner, 3:], atol=1e-3)

    # One of them stops for half a second: what is there of the other is no whole sample either.
    kept = (accel_time < 4.0) | (accel_time > 4.5)
    rows = [stamps_of(accel_time, "us"), *imu(accel_time)[:, 5:2:-1].T, np.full(len(kept), 3)]
    accel = write(tmp_path / "Accelerometer.csv", ["t", *head[1:]], [row[kept] for row in rows])
    holed, _ = import_recording(gyro, columns, accel_path=accel, rate=100.0)
    missing = holed.time[~holed.imu_valid] + start
    assert len(missing) == pytest.approx(50, abs=3)
    assert missing[0] == pytest.approx(4.0, abs=0.02) and missing[-1] == pytest.approx(
        4.5, abs=0.02
    )
    assert same.attributes["start_time"] == pytest.approx(UNIX * 1e-9 + start, abs=2e-6)

    later = write(
        tmp_path / "later.csv",
        ["t", *head[1:]],
        [
            stamps_of(accel_time + 3600, "ns"),
            *imu(accel_time)[:, 5:2:-1].T,
            np.full(len(accel_time), 3),
        ],
    )
    with pytest.raises(
        InputError,
        match=r"later\.csv: field 'time' overlaps by 0 s with that of gyro in Gyroscope\.csv",
    ):
        import_recording(gyro, columns, accel_path=later)


def test_files_without_a_header_are_read_by_the_places_of_their_columns(tmp_path):
    """Blanks between the columns, and a comment where a header would stand."""
    time = np.arange(2800) / 200
    values = imu(time)
    for name, part in (("gyro", values[:, :3]), ("acce", values[:, 3:])):
        rows = [
            f"{stamp} {x:.9f}  {y:.9f} {z:.9f}"
            for stamp, (x, y, z) in zip(stamps_of(time, "ns"), part, strict=True)
        ]
        (tmp_path / f"{name}.txt").write_text(
            "\n".join(["# Created at Wed Dec 27 22:30:22 GMT 2023", *rows]) + "\n"
        )
    columns = {"time": "0"} | {
        f"{sensor}_{axis}": str(place)
        for sensor in ("gyro", "accel")
        for place, axis in enumerate("xyz", 1)
    }
    sequence, _ = import_recording(tmp_path / "gyro.txt", columns, accel_path=tmp_path / "acce.txt")
    compare_imu(sequence)
    with pytest.raises(InputError, match=r"gyro\.txt: column '4' is missing; found: 0, 1, 2, 3"):
        import_recording(
            tmp_path / "gyro.txt", columns | {"gyro_z": "4"}, accel_path=tmp_path / "acce.txt"
        )


def test_rows_of_one_sensor_each_are_told_apart(tmp_path):
    """A merged table: a row is of one sensor, and the other's columns are empty."""
    gyro_time, accel_time = np.arange(0, SECONDS, 0.01), np.arange(0, SECONDS, 0.01) + 0.004
    time = np.concatenate([gyro_time, accel_time])
    values = imu(time)
    values[: len(gyro_time), 3:] = np.nan
    values[len(gyro_time) :, :3] = np.nan
    order = np.argsort(time)
    path = write(tmp_path / "merged.csv", ["time", *AXES], [time[order], *values[order].T])
    sequence, notes = import_recording(path)
    start = (
        0.01
        if np.allclose(sequence.gyro[0], known_walk.rate(np.array([0.01]))[0], atol=1e-4)
        else 0.004
    )
    compare_imu(sequence, start=start)
    assert sum("have no" in note or "rows have no" in note for note in notes) >= 2
    values[5, 1] = np.nan
    path = write(tmp_path / "torn.csv", ["time", *AXES], [time[order], *values[order].T])
    with pytest.raises(InputError, match=r"torn\.csv: field 'gyro' is NaN or Inf in 1 rows"):
        import_recording(path)


def test_a_byte_order_mark_and_quoted_names_do_no_harm(tmp_path):
    path = write_logger(tmp_path / "phone.csv")
    lines = path.read_text().splitlines()
    quoted = ",".join(f'"{name}"' for name in lines[0].split(","))
    path.write_text("\ufeff" + "\n".join([quoted, *lines[1:]]), encoding="utf-8")
    sequence, _ = import_recording(path, MAPPED)
    compare_imu(sequence)


def test_an_accelerometer_out_of_calibration_is_told_and_one_without_gravity_refused(tmp_path):
    path = write_logger(tmp_path / "high.csv", accel=1.08)
    _, notes = import_recording(path, MAPPED)
    assert any("off gravity by +" in note and "calibration" in note for note in notes)
    path = write_logger(tmp_path / "far.csv", accel=0.75)
    with pytest.raises(
        InputError,
        match=r"far\.csv: field 'accel' reads 7\.\d+ m/s² in its quietest second, far from gravity",
    ):
        import_recording(path, MAPPED)


def test_an_import_goes_through_the_package_s_own_file(tmp_path):
    sequence, _ = import_recording(write_logger(tmp_path / "phone" / "log.csv"), MAPPED, rate=100.0)
    write_hdf5(tmp_path / "mine" / "log.h5", sequence)
    (again,) = data.load("csv", tmp_path / "mine", "test")
    np.testing.assert_array_equal(again.gyro, sequence.gyro)
    assert not again.valid.any()


@pytest.mark.recordings
def test_a_real_logger_s_files_are_imported(recordings):
    """An Android phone's raw text, one file per sensor at 388 Hz."""
    folder = recordings / "kiod" / "01"
    if not folder.is_dir():
        pytest.skip("real recordings: no kiod/")
    columns = {"time": "0"} | {
        f"{sensor}_{axis}": str(place)
        for sensor in ("gyro", "accel")
        for place, axis in enumerate("xyz", 1)
    }
    sequence, notes = import_recording(
        folder / "gyro.txt", columns, accel_path=folder / "acce.txt", rate=200.0
    )
    assert 100 < sequence.time[-1] < 110 and np.median(
        np.linalg.norm(sequence.accel, axis=1)
    ) == pytest.approx(9.8, abs=0.2)
    text = " | ".join(notes)
    for detected in (
        "time of gyro taken as ns, by which it runs at 388 Hz",
        "gyro taken as rad/s",
        "accel taken as m/s2",
    ):
        assert detected in text
