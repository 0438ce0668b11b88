"""One's own recordings: CSV and HDF5 folders, and phone loggers' files, must tell of the known walk
again; what is ambiguous is refused."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.data.plausibility import self_check
from gnio_jax.data.readers import csv_files as csv
from gnio_jax.numerics import rotations
from gnio_jax.types import InputError
from tests.support import known_walk
from tests.support.csv_writers import AXES, SECONDS, imu, write, write_native

G = 9.80665


def compare_imu(sequence, start=0.0, atol=1e-3):
    known = imu(sequence.time + start)
    np.testing.assert_allclose(sequence.gyro, known[:, :3], atol=atol)
    np.testing.assert_allclose(sequence.accel, known[:, 3:], atol=atol)


def compare_reference(sequence, start=0.0):
    time, valid = (sequence.time + start)[sequence.valid], sequence.valid
    turn = (rotations(sequence.orientation[valid]).inv() * known_walk.attitude(time)).magnitude()
    assert np.degrees(turn).max() < 0.1
    assert np.linalg.norm(sequence.position[valid] - known_walk.position(time), axis=1).max() < 1e-3
    assert np.abs(sequence.velocity[valid] - known_walk.velocity(time)).max() < 5e-3


# --- the folder
# ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [50.0, 100.0, 202.3])
@pytest.mark.parametrize("velocity", [False, True])
def test_a_recording_with_a_reference_comes_back_at_its_own_rate(tmp_path, rate, velocity):
    jitter = np.random.default_rng(0).uniform(-1e-4, 1e-4, round(SECONDS * rate))
    time = np.arange(round(SECONDS * rate)) / rate + jitter
    sequence = csv.read_recording(write_native(tmp_path / "walk.csv", time, velocity=velocity))
    intervals = np.diff(sequence.time)
    assert (
        np.ptp(intervals) < 1e-9
        and 1 / intervals[0] == pytest.approx(rate, rel=2e-2)
        and sequence.name == "walk"
    )
    assert sequence.time[0] == pytest.approx(100.0 + time[0], abs=1e-8)
    compare_imu(sequence, start=-100.0)
    compare_reference(sequence, start=-100.0)
    assert sequence.valid.all() and self_check(sequence).failures == ()


def test_a_recording_without_a_reference_is_read_and_passes_no_check(tmp_path):
    write_native(tmp_path / "bare.csv", reference=False)
    write_native(tmp_path / "turned.csv", drop=("px", "py", "pz"))
    bare, turned = data.load("csv", tmp_path, "test")
    for sequence in (bare, turned):
        compare_imu(sequence, start=-100.0)
        assert (
            not sequence.valid.any()
            and np.isnan(sequence.position).all()
            and np.isnan(sequence.velocity).all()
        )
    assert (
        np.isnan(bare.orientation).all() and np.isfinite(turned.orientation).all()
    )  # an attitude alone is no reference, but is kept
    assert bare.attributes["truth"] == "none"


def test_rows_without_a_reference_are_not_valid(tmp_path):
    def hole(columns):
        for name in ("px", "py", "pz"):
            columns[name][500:620] = np.nan

    sequence = csv.read_recording(write_native(tmp_path / "walk.csv", spoil=hole))
    assert (
        not sequence.valid[500:620].any()
        and sequence.valid[:500].all()
        and sequence.valid[620:].all()
    )
    compare_reference(sequence, start=-100.0)


def test_lists_name_files_with_or_without_suffix(tmp_path):
    for name in ("a.csv", "b.csv", "c.csv"):
        write_native(tmp_path / name)
    write_hdf5(tmp_path / "d.h5", csv.read_recording(tmp_path / "a.csv")._replace(name="d"))
    (tmp_path / "notes.md").write_text("# mine")
    assert [s.name for s in data.load("csv", tmp_path, "test")] == ["a", "b", "c", "d"]
    with pytest.raises(
        InputError,
        match=r"has no list train\.txt; without lists every recording is in split 'test'",
    ):
        data.load("csv", tmp_path, "train")

    (tmp_path / "train.txt").write_text("# mine\na\nb.csv\ngone.csv")
    (tmp_path / "test.txt").write_text("d\n")
    with pytest.warns(
        UserWarning, match=r"train\.txt: 1 of 3 listed sequences are absent: gone\.csv"
    ):
        assert [s.name for s in data.load("csv", tmp_path, "train")] == ["a", "b"]
    (from_hdf5,) = data.load("csv", tmp_path, "test")
    compare_imu(from_hdf5, start=-100.0)
    compare_reference(from_hdf5, start=-100.0)
    with pytest.raises(InputError, match=r"val\.txt: the list cannot be read"):
        data.load("csv", tmp_path, "val")
    with pytest.raises(InputError, match="unknown split 'seen'"):
        data.load("csv", tmp_path, "seen")


def test_a_reference_that_contradicts_the_imu_is_left_out(tmp_path):
    write_native(tmp_path / "good.csv")
    write_native(tmp_path / "bare.csv", reference=False)
    write_native(
        tmp_path / "turned.csv",
        spoil=lambda columns: columns.update(px=-columns["px"], py=-columns["py"]),
    )
    with pytest.warns(UserWarning, match="turned: left out by the self-check"):
        assert [s.name for s in data.load("csv", tmp_path, "test")] == ["bare", "good"]
    (tmp_path / "good.csv").unlink()
    with pytest.warns(UserWarning, match="turned: left out by the self-check"):
        assert [s.name for s in data.load("csv", tmp_path, "test")] == ["bare"]
    (tmp_path / "bare.csv").unlink()
    with (
        pytest.warns(UserWarning, match="turned: left out"),
        pytest.raises(InputError, match="none of 1 sequences passes"),
    ):
        data.load("csv", tmp_path, "test")


def set_value(name, row, value):
    def change(columns):
        columns[name] = columns[name].astype(
            object if isinstance(value, str) else columns[name].dtype
        )
        columns[name][row] = value

    return change


def scale(names, factor):
    def change(columns):
        for name in names:
            columns[name] = columns[name] * factor

    return change


def hole_of(seconds):
    def change(columns):
        columns["time"] = np.where(
            np.arange(len(columns["time"])) < 600, columns["time"], columns["time"] + seconds
        )

    return change


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"drop": ("gyro_y",)}, ("column 'gyro_y' is missing", "found: ")),
        ({"drop": ("time",)}, ("column 'time' is missing",)),
        ({"drop": ("qx",)}, ("column 'qx' is missing while 'qw' is there",)),
        ({"drop": ("pz",)}, ("column 'pz' is missing",)),
        ({"spoil": set_value("accel_x", 5, np.nan)}, ("field 'accel'", "row 5")),
        ({"spoil": set_value("gyro_x", 6, np.inf)}, ("field 'gyro'", "row 6")),
        ({"spoil": set_value("time", 7, 0.0)}, ("field 'time'", "does not increase", "row 7")),
        (
            {"spoil": set_value("qw", 8, 3.0)},
            ("field 'orientation'", "not a unit quaternion", "row 8"),
        ),
        ({"spoil": hole_of(2.0)}, ("field 'time'", "gap of 2.01")),
        (
            {"spoil": scale(["time"], 1e3)},
            ("field 'time'", "not in seconds", "looks like ms: divide it by 1000"),
        ),
        ({"spoil": scale(["time"], 1e9)}, ("field 'time'", "looks like ns: divide it by 1e+09")),
        (
            {"spoil": scale(["time"], 20.0)},
            ("field 'time'", "not in seconds", "an IMU runs at 10 to 2000 Hz"),
        ),
        ({"spoil": scale(AXES[3:], 1 / G)}, ("field 'accel'", "looks like G")),
        ({"spoil": scale(AXES[:3], 180 / np.pi)}, ("field 'gyro'", "looks like deg/s")),
    ],
)
def test_a_bad_file_is_refused_by_name_and_field(tmp_path, options, words):
    path = write_native(tmp_path / "walk.csv", **options)
    with pytest.raises(InputError) as error:
        csv.read_recording(path)
    text = str(error.value)
    assert (
        text.startswith(f"{path}: ") and "\n" not in text and all(word in text for word in words)
    ), text


def test_damaged_files_and_empty_folders_are_refused(tmp_path):
    with pytest.raises(InputError, match="holds no recording"):
        data.load("csv", tmp_path, "test")
    path = tmp_path / "a.h5"
    write_hdf5(path, csv.read_recording(write_native(tmp_path / "a.csv")))
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(InputError, match=r"a\.h5: cannot be read as HDF5, it may be cut short"):
        csv.read_recording(path)
    text = (tmp_path / "a.csv").read_text().splitlines()
    (tmp_path / "a.csv").write_text("\n".join([*text[:9], "three" + text[9]]))
    with pytest.raises(InputError, match=r"a\.csv: column 'time' holds .*three.* in its row 9"):
        csv.read_recording(tmp_path / "a.csv")


# --- import
# ----------------------------------------------------------------------------------------------------------

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
    sequence, notes = csv.import_recording(path, MAPPED)
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
    sequence, notes = csv.import_recording(
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
        ({"time_unit": "hours"}, "unknown value 'hours'; known: s, ms, us, ns"),
        ({"gyro_unit": "rpm"}, "unknown value 'rpm'"),
        ({"accel_sign": "up"}, "unknown value 'up'"),
        ({"order": "shuffle"}, "unknown value 'shuffle'"),
        ({"rate": 0.0}, "rate: 0 Hz"),
    ):
        with pytest.raises(InputError, match=words):
            csv.import_recording(path, MAPPED, **options)
    with pytest.raises(
        InputError, match=r"columns: unknown name 'gyro'; known names: accel_time, accel_x"
    ):
        csv.import_recording(path, {"gyro": "wx"})
    with pytest.raises(
        InputError, match=r"phone\.csv: column 'accel_x' is missing; found: Timestamp"
    ):
        csv.import_recording(
            path, {name: column for name, column in MAPPED.items() if name != "accel_x"}
        )
    with pytest.raises(InputError, match=r"gone\.csv: cannot be read"):
        csv.import_recording(tmp_path / "gone.csv")


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
        sequence, notes = csv.import_recording(path)
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
        csv.import_recording(path)
    sequence, _ = csv.import_recording(path, gyro_unit="deg/s")
    assert np.abs(sequence.gyro).max() < 0.01


def test_a_rate_or_a_magnitude_of_no_unit_is_refused(tmp_path):
    time = np.arange(500) / 5.0
    path = write(tmp_path / "slow.csv", ["time", *AXES], [time, *imu(time).T])
    with pytest.raises(
        InputError,
        match=r"slow\.csv: the unit of field 'time' is ambiguous \(in seconds gyro would run at 5 Hz\)",
    ):
        csv.import_recording(path)
    path = write_logger(tmp_path / "linear.csv", accel=0.3)
    with pytest.raises(
        InputError, match=r"linear\.csv: the unit of field 'accel' is ambiguous .*gravity included"
    ):
        csv.import_recording(path, MAPPED)


def test_signs_are_turned_when_stated_or_asked_for(tmp_path):
    time = np.arange(2800) / 200
    upright = Rotation.from_euler("y", 90, degrees=True)
    for sign, factor in (("android", 1.0), ("ios", -1.0)):
        path = write_logger(tmp_path / f"{sign}.csv", accel=factor / G)
        stated, notes = csv.import_recording(path, MAPPED, accel_sign=sign)
        compare_imu(stated)
        assert any("negated" in note for note in notes) == (sign == "ios")
        detected, notes = csv.import_recording(path, MAPPED, accel_sign="detect")
        compare_imu(detected)
        assert any("assuming that the screen points up" in note for note in notes)
    left, notes = csv.import_recording(tmp_path / "ios.csv", MAPPED)  # neither stated nor asked for
    np.testing.assert_allclose(left.accel, -known_walk.force(left.time), atol=1e-3)
    values = imu(time)
    columns = [time, *upright.apply(values[:, :3]).T, *upright.apply(values[:, 3:]).T]
    path = write(tmp_path / "upright.csv", ["time", *AXES], columns)
    with pytest.raises(
        InputError, match=r"the sign of field 'accel' is ambiguous .*; state it: android or ios"
    ):
        csv.import_recording(path, accel_sign="detect")


def test_gravity_and_user_acceleration_apart_are_summed(tmp_path):
    time = np.arange(2800) / 200
    values, gravity = imu(time), known_walk.attitude(time).inv().apply([0.0, 0.0, 1.0])
    user = values[:, 3:] / G - gravity
    names = ["time", *AXES[:3], *(f"gravity{a}" for a in "XYZ"), *(f"user{a}" for a in "XYZ")]
    path = write(tmp_path / "phone.csv", names, [time, *values[:, :3].T, *-gravity.T, *-user.T])
    sums = {f"accel_{a}": f"gravity{a.upper()} + user{a.upper()}" for a in "xyz"}
    sequence, _ = csv.import_recording(path, sums, accel_sign="ios")
    compare_imu(sequence)
    with pytest.raises(InputError, match="column 'userQ' is missing"):
        csv.import_recording(path, sums | {"accel_x": "gravityX+userQ"})


def shuffle(columns):
    order = np.arange(len(columns["Timestamp"]))
    order[[100, 140]] = order[[140, 100]]
    order = np.delete(np.insert(order, 700, order[700]), [1000, 1001])
    return {name: values[order] for name, values in columns.items()}


def test_rows_out_of_order_are_sorted_or_refused(tmp_path):
    path = write_logger(tmp_path / "phone.csv", spoil=shuffle)
    sequence, notes = csv.import_recording(path, MAPPED)
    compare_imu(sequence)
    text = " | ".join(notes)
    assert (
        "gyro had 2 steps back in time; its rows were sorted" in text
        and "1 rows of accel repeat a stamp and were dropped" in text
    )
    with pytest.raises(
        InputError, match=r"phone\.csv: field 'time' does not increase in 3 rows, first in row 101"
    ):
        csv.import_recording(path, MAPPED, order="refuse")


def test_a_clock_too_coarse_and_gaps_are_told(tmp_path):
    coarse = write_logger(
        tmp_path / "coarse.csv", spoil=lambda c: c | {"Timestamp": c["Timestamp"] // 10**7 * 10**7}
    )
    with pytest.raises(
        InputError,
        match=r"coarse\.csv: field 'time' repeats in 1400 of 2800 rows of gyro; give stamps fine enough",
    ):
        csv.import_recording(coarse, MAPPED)
    keep = np.delete(np.arange(2800), np.arange(1000, 1079))
    path = write_logger(
        tmp_path / "holes.csv", spoil=lambda c: {name: values[keep] for name, values in c.items()}
    )
    _, notes = csv.import_recording(path, MAPPED)
    assert any("gyro lacks samples 1 times, for up to 0.40 s" in note for note in notes)
    keep = np.delete(np.arange(2800), np.arange(1000, 1280))
    path = write_logger(
        tmp_path / "lost.csv", spoil=lambda c: {name: values[keep] for name, values in c.items()}
    )
    with pytest.raises(InputError, match=r"lost\.csv: field 'time' has a gap of 1\.405 s"):
        csv.import_recording(path, MAPPED)


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
    sequence, notes = csv.import_recording(gyro, columns, accel_path=accel, rate=100.0, name="walk")
    assert np.allclose(np.diff(sequence.time), 0.01) and sequence.name == "walk"
    faster = gyro_time if gyro_rate > accel_rate else accel_time
    start = faster[(faster >= 0.2 - 1e-9)][0]
    # The joint clock starts where both sensors run, at a sample of the faster one.
    inner = slice(20, -20)  # the low-pass towards 100 Hz mirrors at the ends
    known = imu(sequence.time + start)
    np.testing.assert_allclose(sequence.gyro[inner], known[inner, :3], atol=1e-3)
    np.testing.assert_allclose(sequence.accel[inner], known[inner, 3:], atol=1e-3)
    assert sequence.time[-1] == pytest.approx(SECONDS - 0.3 - start, abs=0.03)
    moved = "accel" if gyro_rate > accel_rate else "gyro"
    assert any(
        f"stamps of their own: {moved} interpolated" in note and "1.0" in note for note in notes
    )

    # One clock, but another unit in the other file.
    accel = write(
        tmp_path / "Accelerometer.csv",
        ["t", *head[1:]],
        [stamps_of(accel_time, "us"), *imu(accel_time)[:, 5:2:-1].T, np.full(len(accel_time), 3)],
    )
    same, _ = csv.import_recording(gyro, columns, accel_path=accel, rate=100.0)
    np.testing.assert_allclose(same.accel[inner], known[inner, 3:], atol=1e-3)
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
        csv.import_recording(gyro, columns, accel_path=later)


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
    sequence, _ = csv.import_recording(
        tmp_path / "gyro.txt", columns, accel_path=tmp_path / "acce.txt"
    )
    compare_imu(sequence)
    with pytest.raises(InputError, match=r"gyro\.txt: column '4' is missing; found: 0, 1, 2, 3"):
        csv.import_recording(
            tmp_path / "gyro.txt", columns | {"gyro_z": "4"}, accel_path=tmp_path / "acce.txt"
        )


def test_rows_of_one_sensor_each_are_told_apart(tmp_path):
    """A merged table: a row is of the gyro or of the accelerometer, the other's columns are empty."""
    gyro_time, accel_time = np.arange(0, SECONDS, 0.01), np.arange(0, SECONDS, 0.01) + 0.004
    time = np.concatenate([gyro_time, accel_time])
    values = imu(time)
    values[: len(gyro_time), 3:] = np.nan
    values[len(gyro_time) :, :3] = np.nan
    order = np.argsort(time)
    path = write(tmp_path / "merged.csv", ["time", *AXES], [time[order], *values[order].T])
    sequence, notes = csv.import_recording(path)
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
        csv.import_recording(path)


def test_a_byte_order_mark_and_quoted_names_do_no_harm(tmp_path):
    path = write_logger(tmp_path / "phone.csv")
    lines = path.read_text().splitlines()
    quoted = ",".join(f'"{name}"' for name in lines[0].split(","))
    path.write_text("\ufeff" + "\n".join([quoted, *lines[1:]]), encoding="utf-8")
    sequence, _ = csv.import_recording(path, MAPPED)
    compare_imu(sequence)


def test_an_accelerometer_out_of_calibration_is_told_and_one_without_gravity_refused(tmp_path):
    path = write_logger(tmp_path / "high.csv", accel=1.08)
    _, notes = csv.import_recording(path, MAPPED)
    assert any("off gravity by +" in note and "calibration" in note for note in notes)
    path = write_logger(tmp_path / "far.csv", accel=0.75)
    with pytest.raises(
        InputError,
        match=r"far\.csv: field 'accel' reads 7\.\d+ m/s² in its quietest second, far from gravity",
    ):
        csv.import_recording(path, MAPPED)


def test_an_import_goes_through_the_package_s_own_file(tmp_path):
    sequence, _ = csv.import_recording(
        write_logger(tmp_path / "phone" / "log.csv"), MAPPED, rate=100.0
    )
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
    sequence, notes = csv.import_recording(
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
