"""Logs of any board or phone tell of the known walk again, or are refused or warned of in one true
sentence."""

import gzip
import re
import time
import zipfile

import numpy as np
import openpyxl
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.apps.importing import units
from gnio_jax.data.labels import resolve_labels
from gnio_jax.errors import InputError
from tests.support.csv_writers import AXES, compare_imu, imu
from tests.support.importing import import_recording, imported, refused
from tests.support.log_tables import (
    COUNT,
    HEADER,
    ROWS,
    TIME,
    WALK,
    G,
    by_sensor,
    clock_text,
    interleaved,
    lines,
    rows,
    table,
)

NS = 1_714_720_502_250_000_000 + ROWS * 10**7
DEGREES = 180 / np.pi


def put(folder, content, name="walk.csv", encoding="utf-8"):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else content.encode(encoding))
    return path


def check(path, words="", atol=2e-3, options=None, inner=slice(None)):
    """The file is the known walk to `atol` (and its values have no more than 3 digits of error
    elsewhere), from its first sample on, and a note or warning has the `words`."""
    recording = imported(path, **(options or {}))
    text = " | ".join([*recording.notes, *recording.warnings])
    assert re.search(words, text), text
    compare_imu(
        recording.sequence._replace(
            time=recording.sequence.time[inner],
            gyro=recording.sequence.gyro[inner],
            accel=recording.sequence.accel[inner],
        ),
        atol=atol,
    )
    return recording.sequence


# --- preamble, header, units, rows

UNITS = "s,mdps,mdps,mdps,mg,mg,mg"
XSENS = ("PacketCounter", "SampleTimeFine", *(f"{n}_{a}" for n in ("Gyr", "Acc") for a in "XYZ"))
SHIMMER = ("Timestamp", *(f"{n} {a}" for n in ("Gyroscope", "Accelerometer") for a in "XYZ"))
HEADS = {
    "a line of the device": "gyroscope-imu1,vendor,2024-05-03\n" + table(),
    "sep=": "sep=;\n" + table(separator=";"),
    "sep= in quotes": '"sep=\t"\n' + table(separator="\t"),
    "slashes": "// General information:\n//  Rate: 100.0Hz\n" + table(separator="\t"),
    "percent, as MATLAB and rostopic": "% logger\n% " + table(),
    "a count": f"{COUNT}\n" + table(),
    "as many words as columns": "Monday,3 May,by Anna,in Bern,with phone,in hand,fast\n" + table(),
    "more lines than are searched at first": lines(*(f"{n}: value" for n in range(500))) + table(),
    "two commas end every row": table().replace("\n", ",,\n").replace(",,\n", "\n", 1),
    "a hundred lines": lines(*(f"Device line {n},value {n}" for n in range(100))) + table(),
    "a row of units": table().replace("\n", f"\n{UNITS}\n", 1).replace(",", ","),
    "bars": table(separator="|"),
    "blanks": table(separator=" "),
    "a comma ends every row": table().replace("\n", ",\n").replace(",\n", "\n", 1),
    "a comma ends some rows": "\n".join(
        row + "," * (n % 2) for n, row in enumerate(table().splitlines())
    ),
    "blank lines": table().replace("\n", "\n\n"),
}


@pytest.mark.parametrize("name", HEADS)
def test_what_stands_above_the_rows(tmp_path, name):
    scales = {"gyro": DEGREES * 1e3, "accel": 1e3 / G}
    text = HEADS[name]
    if name == "a row of units":
        text = table(**scales).replace("\n", f"\n{UNITS}\n", 1)
    check(put(tmp_path, text))


def test_several_header_rows_and_units_in_their_last(tmp_path):
    text = table(TIME * 1e3, SHIMMER, gyro=DEGREES, separator="\t")
    marks = [["Shimmer_5E77"] * 7, ["CAL"] * 7, ["mSecs", *["deg/s"] * 3, *["m/(s^2)"] * 3]]
    device, kind, unit = ("\t".join(cells) for cells in marks)
    header, others = rows(text)
    check(put(tmp_path, lines('"sep=\t"', device, header, kind, unit, *others)), "deg/s, by its h")


def test_the_tick_of_a_clock_known_by_its_name(tmp_path):
    stamps = [f"{n % 65536}\t{917352 + n * 100}" for n in range(60000, 60000 + COUNT)]
    check(put(tmp_path, table(stamps, XSENS, separator="\t"), "walk.txt"))


def test_gcsv_states_its_scales(tmp_path):
    head = ("GYROFLOW IMU LOG", "version,1.1", "tscale,0.001", "gscale,0.0001", "ascale,0.00005")
    text = table(ROWS * 10, ("t", "gx", "gy", "gz", "ax", "ay", "az"), 1e4, 2e4 / G, digits=0)
    check(put(tmp_path, lines(*head, "orientation,XYZ") + text, "clip.gcsv"), "gcsv with the units")


# --- encodings and containers


def test_any_encoding_and_decimal_mark(tmp_path):
    header = ("Zeit (s)", *(f"Gyro {a} (°/s)" for a in "XYZ"), *(f"Acc {a} (m/s²)" for a in "XYZ"))
    degrees = table(header=header, gyro=DEGREES)
    quoted = [
        ",".join(f'"{c.replace(".", ",")}"' for c in row.split(",")) for row in rows(table())[1]
    ]
    whole = [row.replace(".", ",") for row in rows(table(separator=";"))[1]]
    whole[:500] = [re.sub(r",(\d+)", "", row) for row in whole[:500]]  # the first have no fraction
    for text, encoding in (
        (degrees.replace("Zeit", "time"), "latin-1"),
        (table(), "utf-16"),
        (table(separator="\t"), "utf-16-le"),
        (lines(",".join(HEADER), *quoted), "utf-8"),
        (table(separator=";").replace(".", ","), "utf-8"),
    ):
        check(put(tmp_path, text, encoding=encoding))
    path = put(tmp_path, lines(";".join(HEADER), *whole))
    sequence, _ = import_recording(path)
    np.testing.assert_allclose(sequence.gyro[501:], WALK[501:, :3], atol=2e-3)
    check(put(tmp_path, table().replace("-", "\u2212")))  # the minus of typesetting
    stamps = [f"{n * 10:,}".replace(",", ".") for n in ROWS]  # 1.010 is a thousand and ten
    text = [row.replace(".", ",") for row in rows(table(separator=";"))[1]]
    text = [";".join([s, *row.split(";")[1:]]) for s, row in zip(stamps, text, strict=True)]
    check(put(tmp_path, lines(";".join(HEADER), *text)), "taken as ms")


def test_one_table_in_any_container_is_that_table(tmp_path):
    text = table()
    with zipfile.ZipFile(tmp_path / "walk.zip", "w") as archive:
        archive.writestr("walk/walk.csv", text)
        archive.writestr("walk/readme.txt", "A walk.\nOn a Monday\n")
    put(tmp_path / "folder", text)
    book = openpyxl.Workbook()
    sheet = book.active
    assert sheet is not None
    for row in [HEADER, *np.column_stack([TIME, WALK]).tolist()]:
        sheet.append(row)
    book.save(tmp_path / "walk.xlsx")
    put(tmp_path, gzip.compress(text.encode()), "walk.csv.gz")
    for name in ("walk.zip", "folder", "walk.xlsx", "walk.csv.gz"):
        check(tmp_path / name)
    for name in ("csv.zip", "csv.gz", "csv.xz"):  # names may be wrong
        check(put(tmp_path, text, name))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (
            "version https://git-lfs.github.com/spec/v1\noid sha256:4d\nsize 12\n",
            "is a pointer of Git LFS",
        ),
        ("<!DOCTYPE html>\n<html><body>no entry</body></html>\n", "is a web page"),
        ('[{"sensor":"Gyroscope","time":"1","x":"0.1"}]', "is JSON; export the recording as CSV"),
        ('{\n "a": 1}', "is JSON"),
        (b"\x89PNG\r\n\x1a\n" + bytes(range(256)) * 20, "is no text"),
    ],
)
def test_what_is_no_table_is_told_by_its_beginning(tmp_path, content, words):
    for name in ("walk.csv", "walk.zip", "walk.bag"):
        refused(put(tmp_path, content, name), f"{re.escape(name)}: {words}")
    if isinstance(content, str):  # a folder of such files, a zip of one
        put(tmp_path / "folder", content, "Gyroscope.csv")
        put(tmp_path / "folder", content, "Accelerometer.csv")
        refused(tmp_path / "folder", f"Accelerometer.csv: {words}")
        with zipfile.ZipFile(tmp_path / "log.zip", "w") as archive:
            archive.writestr("log.json", content)
        refused(tmp_path / "log.zip", f"log.json: {words}")


# --- damaged rows

DAMAGE = {
    "a boot message": lambda r: [*r[:400], "ets Jul 29 2019 12:21:46 rst:0x1", *r[400:]],
    "a repeated header": lambda r: [*r[:700], ",".join(HEADER), *r[700:]],
    "a text at the end": lambda r: [*r, "", "stopped after 14 s", f"{COUNT} rows, no error"],
    "a short row": lambda r: [*r[:300], "3.000,0.1", *r[301:]],
    "two rows in one": lambda r: [*r[:300], r[300] + r[301], *r[302:]],
    "a reboot": lambda r: [*r[:400], *(f"load:0x3fff00{n},len:{n}" for n in range(9)), *r[400:]],
    "an open quote": lambda r: [*r[:300], '"', *r[300:]],
    "infinity": lambda r: [*r[:300], re.sub(",[^,]*", ",inf", r[300], count=1), *r[301:]],
    "NaN": lambda r: [*r[:300], re.sub(",[^,]*", ",NaN", r[300], count=1), *r[301:]],
    "zeros at the end": lambda r: [*r, "\0" * 60],
    "a cut last row": lambda r: [*r[:-1], r[-1][:-20]],
}


@pytest.mark.parametrize("name", DAMAGE)
def test_a_few_damaged_rows_are_left_out_and_named(tmp_path, name):
    header, others = rows(table())
    path = put(tmp_path, "\n".join([header, *DAMAGE[name](others)]))
    assert len(check(path, r"row \d+", atol=2e-2).time) >= COUNT - 3


def test_rows_of_other_times_are_left_out(tmp_path):
    """The first stamp before the clock was set; what was buffered before the start."""
    first = [0, *(NS // 10**6)[1:].tolist()]
    recording = imported(put(tmp_path, table(first)))
    np.testing.assert_allclose(recording.sequence.gyro, WALK[1:, :3], atol=1e-5)
    buffered = np.where(ROWS < 5, TIME - 100.0, TIME)
    path = put(tmp_path, table([f"{stamp + 200:.3f}" for stamp in buffered]))
    sequence, notes = import_recording(path)
    np.testing.assert_allclose(sequence.gyro, WALK[5:, :3], atol=1e-5)
    assert any("5 rows of gyro are left out, whose stamps are far" in note for note in notes)


def test_many_damaged_rows_are_refused_by_line_and_cells(tmp_path):
    header, others = rows(table())
    words = r"walk\.csv: row 3 is not a row of 7 numbers: it has 2 cells .'error,x'., as 139 others"
    broken = [row for n, r in enumerate(others) for row in ([r] if n % 10 else [r, "error, x"])]
    refused(put(tmp_path, lines(header, *broken)), words)
    # Rows with a position between the sensors are of another kind: their cells are others.
    longer = [row + ",1.0,52.1,4.3" if n in (40, 80) else row for n, row in enumerate(others)]
    refused(
        put(tmp_path, lines(header, *longer)), r"row 42 is not a row of 7 numbers: it has 10 cel"
    )


# --- names

ROS = [f"{n}.{a}" for n in ("angular_velocity", "linear_acceleration") for a in "xyz"]
NAMES = {
    "Arduino": ("millis", "gx", "gy", "gz", "ax", "ay", "az"),
    "ESP32": ("timestamp_ms", *(f"{n}{a}" for n in ("Gyro", "Acc") for a in "XYZ")),
    "Kaggle": ("Timestamp", *(f"{n}_{a}" for n in ("gyro", "acc") for a in "XYZ")),
    "a unit behind the axis": (
        "time_ms",
        *(f"gyro_{a}_rad_s" for a in "xyz"),
        *(f"acc_{a}_ms2" for a in "xyz"),
    ),
    "the axis first": ("ms", *(f"{a}{n}" for n in ("gyro", "_acc") for a in "xyz")),
    "specific force": ("t", *(f"{n}_{a}" for n in ("omega", "f") for a in "xyz")),
    "wx": ("t", "wx", "wy", "wz", "ax", "ay", "az"),
    "EuRoC": ("#timestamp", *(f"{n}_RS_S_{a}" for n in "wa" for a in "xyz")),
    "Core Motion": ("time", *(f"{n}{a}" for n in ("rotationRate", "acceleration") for a in "XYZ")),
    "a letter of physics": ("t", *(f"{n}_{a}" for n in ("ω", "a") for a in "xyz")),
    "a tick": ("tick", *AXES),
    "units of one sensor alone": (
        "Ankunft [ms]",
        *(f"Drehrate {a} (rad/s)" for a in "XYZ"),
        *(f"Beschleunigung {a} (m/s²)" for a in "XYZ"),
    ),
}


@pytest.mark.parametrize("name", NAMES)
def test_known_names_are_found_and_noted(tmp_path, name):
    path = put(tmp_path, table(ROWS * 10, NAMES[name]))
    check(path, "columns taken by their names: ")


def test_units_name_a_sensor_only_where_nothing_else_can_be_meant():
    gyro = [f"Drehrate {axis} (deg/s)" for axis in "XYZ"]
    for name in ("linear", "Magnetfeld", "gravity", "user"):
        others = [f"{name} {axis} (mG)" for axis in "XYZ"]
        assert {*resolve_labels(["Dauer (s)", *gyro, *others])} == {"time", *AXES[:3]}
    twice = [f"rechts {axis} (deg/s)" for axis in "XYZ"]
    assert "gyro_x" not in resolve_labels(["time", *gyro, *twice])
    assert "time" not in resolve_labels(["exposure (ms)", *gyro])
    assert "time" not in resolve_labels(["Ankunft (s)", "Abfahrt (s)", *gyro])
    names = resolve_labels(["Time(s)", *gyro, "T (°C)", "T (V)"])
    assert names["time"] == "Time(s)"  # the others are a temperature and a voltage


def test_a_duration_and_a_count_of_a_wheel_are_no_clock_beside_one(tmp_path):
    """A unit says less than a date, and a name less than values that never increase."""
    dates = clock_text(33_302_250 + ROWS * 10, "2024-05-03 {h:02d}:{m:02d}:{s:02d}.{ms:03d}")
    jitter = np.random.default_rng(2).integers(400, 900, COUNT) / 100
    header, others = rows(table(dates, ("Uhrzeit", *AXES)))
    for name, values in (("Zyklus (ms)", jitter), ("ticks", 7 * ROWS), ("Leistung (mS)", ROWS)):
        whole = [f"{row},{value}" for row, value in zip(others, values, strict=True)]
        check(put(tmp_path, lines(f"{header},{name}", *whole)), "time=Uhrzeit")
    named = [f"{row},{7 * n}" for n, row in enumerate(rows(table(ROWS * 10))[1])]
    check(put(tmp_path, lines(",".join(("millis", *AXES, "ticks")), *named)), "time=millis")
    bare = [f"{value},{row.partition(',')[2]}" for value, row in zip(jitter, others, strict=True)]
    path = put(tmp_path, lines(",".join(("Zyklus (ms)", *AXES)), *bare))
    refused(path, "'time' .*missing.*--sample-rate")


@pytest.mark.parametrize("unit", ["°C", "degC", "V", "mV", "K"])
def test_t_is_no_time_in_a_unit_of_something_else(unit):
    assert "time" not in resolve_labels([f"T ({unit})", *AXES])
    assert resolve_labels([f"T ({unit})", "Zeit (ms)", *AXES])["time"] == "Zeit (ms)"
    units = {"T": f"[{unit}]", "Zeit": "[ms]"} | dict.fromkeys(AXES)
    assert resolve_labels(units, units=units)["time"] == "Zeit"


@pytest.mark.parametrize("unit", ["s", "ms", "hh:mm:ss", "UTC"])
def test_t_is_a_time_in_a_unit_of_time(unit):
    assert resolve_labels([f"t ({unit})", *AXES])["time"] == f"t ({unit})"


def test_files_with_the_names_of_the_sensors_come_before_a_table_with_their_units(tmp_path):
    cells = [row.split(",") for row in rows(table())[1]]
    for name, first in (("gyro", 1), ("accel", 4)):
        part = [",".join([c[0], *c[first : first + 3]]) for c in cells]
        put(tmp_path / "log", lines("time,x,y,z", *part), f"{name}.csv")
    units = [f"model {a} ({unit})" for unit in ("rad/s", "m/s2") for a in "xyz"]
    put(tmp_path / "log", table(header=("time", *units), gyro=2.0), "fused.csv")
    check(tmp_path / "log")


def test_a_row_of_units_names_the_sensors(tmp_path):
    header = ("when", *(f"{n} {a}" for n in ("Rotation", "Beschleunigung") for a in "XYZ"))
    units = "[µs],[°/s],[°/s],[°/s],[g],[g],[g]"
    header, others = rows(table(ROWS * 10_000, header, gyro=DEGREES, accel=1 / G))
    check(put(tmp_path, lines(header, units, *others)), "gyro in deg/s, by its header")


def test_names_of_sensors_above_those_of_their_axes(tmp_path):
    header, others = rows(table(ROWS * 10, ("ms", *"xyzxyz")))
    for upper in ("Time,Gyroscope,,,Accelerometer,,", "Time" + 3 * ",Gyro" + 3 * ",Acc"):
        check(put(tmp_path, lines(upper, header, *others)), "gyro_x=Gyro")
    refused(put(tmp_path, lines(header, *others)), "'gyro_x', .* are missing; found: ms, x, y, z")


def test_a_title_over_a_column_that_is_written_twice_is_no_sensor(tmp_path):
    header, others = rows(table(ROWS * 10, ("time", *AXES)))
    twice = [f"{row},{row.partition(',')[0]}" for row in others]
    title = "Subject: Bob,,,,Date: Monday,,,"
    check(put(tmp_path, lines(title, f"{header},time", *twice)))


def test_sensors_of_two_boards_under_the_same_names_are_refused(tmp_path):
    _, others = rows(table(ROWS * 10))
    cells = [row.split(",") for row in others]
    board_rows = [",".join([*c, *(f"{2 * float(x):.6f}" for x in c[1:])]) for c in cells]
    upper = "Time" + 2 * ",Gyro,,,Acc,,"
    refused(
        put(tmp_path, lines(upper, "ms" + 4 * ",x,y,z", *board_rows)),
        "'Gyro x' is there 2 times; leave one",
    )


def test_columns_without_a_name_do_not_matter(tmp_path):
    for tail in ("{n},{m}", "{n},no"):
        others = [f"{row},{tail.format(n=n, m=-n)}" for n, row in enumerate(rows(table())[1])]
        check(put(tmp_path, lines(",".join((*HEADER, "", "")), *others)))


def test_stamps_of_robots(tmp_path):
    """Those of the header are taken, in one column or two, and not those of the arrival."""
    arrivals = NS + 40_000_000 + np.random.default_rng(3).integers(0, 10**6, COUNT)
    one = ("%time", "field.header.seq", "field.header.stamp", *(f"field.{n}" for n in ROS))
    stamps = [f"{a},{n},{b}" for n, (a, b) in enumerate(zip(arrivals, NS, strict=True))]
    check(put(tmp_path, table(stamps, one)), "time=field.header.stamp")
    two = ("Time", "header.stamp.secs", "header.stamp.nsecs", "header.frame_id", *ROS)
    stamps = [
        f"{a / 1e9:.6f},{b // 10**9},{b % 10**9},imu" for a, b in zip(arrivals, NS, strict=True)
    ]
    sequence = check(put(tmp_path, table(stamps, two)), r"time=header\.stamp\.secs\+header")
    assert sequence.attributes["start_time"] == pytest.approx(NS[0] / 1e9, abs=1e-6)
    names = {"time": "header.stamp.secs+header.stamp.nsecs"}
    compare_imu(import_recording(tmp_path / "walk.csv", names)[0])


def test_a_column_that_is_written_twice_is_one(tmp_path):
    header = (
        "Unix time[nanosec]",
        *(
            f"{n}[{u}]"
            for n, u in zip(
                ("gx", "gy", "gz", "ax", "ay", "az"), ["rad/s"] * 3 + ["m/s^2"] * 3, strict=True
            )
        ),
    )
    text = table(NS, header)
    double = [f"{row},{row.split(',')[0]}" for row in text.splitlines()]
    check(put(tmp_path, lines(*double), "gyro_accel.csv"))


def test_what_fits_twice_is_not_taken():
    assert "gyro_x" not in resolve_labels(
        ["time", *(f"imu{n}_gyro_{a}" for n in (0, 1) for a in "xyz")]
    )
    labels = ["t", "ACCELEROMETER X (m/s²)", "LINEAR ACCELERATION X (m/s²)", "GRAVITY X (m/s²)"]
    labels += [label.replace(" X ", f" {axis} ") for label in labels[1:] for axis in "YZ"]
    assert resolve_labels(labels)["accel_x"] == "ACCELEROMETER X (m/s²)"
    assert "accel_x" not in resolve_labels(
        ["time", *(f"userAcceleration.{axis}" for axis in "xyz")]
    )


def test_a_sign_and_a_reference_can_be_named(tmp_path):
    header = ("time", "up", "left", "ahead", *AXES[3:])
    values = WALK * [1, -1, 1, 1, 1, 1]
    path = put(tmp_path, table(header=header, values=values))
    names = {"gyro_x": "up", "gyro_y": "-left", "gyro_z": "ahead"}
    compare_imu(import_recording(path, names)[0])
    poses = [f"{row},{n / 100},0,0,1,0,0,0" for n, row in enumerate(rows(table())[1])]
    header = (*HEADER, "pos_x", "pos_y", "pos_z", "ori_w", "ori_x", "ori_y", "ori_z")
    path = put(tmp_path, lines(",".join(header), *poses))
    names = dict(zip(("px", "py", "pz", "qw", "qx", "qy", "qz"), header[7:], strict=True))
    _, notes = import_recording(path, names)
    assert any("the reference given does not fit the IMU" in note for note in notes)
    refused(path, "column 'pos_X' is missing; .* --columns px=COLUMN", names | {"px": "pos_X"})
    _, notes = import_recording(path, dict(list(names.items())[:3]))
    assert any("has no orientation, or no position; a reference has qw" in note for note in notes)


def test_a_folder_or_one_of_its_files_is_the_recording(tmp_path):
    """RoNIN's recorder, OpenCamera, EuRoC's layout."""
    ronin = tmp_path / "ronin"
    sensors = {"gyro": slice(0, 3), "acce": slice(3, 6), "magnet": slice(0, 3)}
    for name, axes in (sensors | {"gyro_uncalib": slice(3, 6)}).items():
        text = [
            f"{stamp} " + " ".join(f"{v:.6f}" for v in row)
            for stamp, row in zip(NS, WALK[:, axes], strict=True)
        ]
        put(ronin, lines("# Created at Wed Dec 27", *text), f"{name}.txt")
        if name not in sensors:  # RoNIN's recorder has an uncalibrated gyro too
            continue
        camera = [
            f"{row[0]:.6f},{row[1]:.6f},{row[2]:.6f},{stamp}"
            for stamp, row in zip(NS, WALK[:, axes], strict=True)
        ]
        header = "X-data,Y-data,Z-data,timestamp (ns)"
        put(tmp_path / "camera", lines(header, *camera), f"v_{name}.csv")
        put(tmp_path / "bare", lines(*camera), f"v_{name}.csv")  # axes first, no header
    names = [f"w_RS_S_{a} [rad s^-1]" for a in "xyz"] + [f"a_RS_S_{a} [m s^-2]" for a in "xyz"]
    put(tmp_path / "mav0" / "imu0", table(NS, ("#timestamp [ns]", *names)), "data.csv")
    for path in (
        ronin,
        ronin / "gyro.txt",
        tmp_path / "camera",
        tmp_path / "camera" / "v_acce.csv",
        tmp_path / "bare" / "v_gyro.csv",
    ):
        check(path)
    check(tmp_path / "mav0" / "imu0" / "data.csv", "EuRoC's layout")


def test_rows_without_stamps_need_a_rate(tmp_path):
    bare = lines(*(row.partition(",")[2] for row in table().splitlines()))
    path = put(tmp_path, bare)
    refused(path, "if it has no column of time, give --sample-rate HZ; name them: --columns time=")
    check(path, options={"sample_rate": 100.0})
    refused(path, "sample_rate: 0 Hz is out of range", sample_rate=0.0)
    path = put(tmp_path, bare.partition("\n")[2])
    refused(path, "has 6 columns of numbers and no header; .*accel_z=5 --sample-rate HZ$")


# --- clocks

SHARED = "rounded to|share the stamp"


def test_bursts_and_shared_stamps_are_spread_evenly(tmp_path):
    jitter = np.random.default_rng(5).integers(0, 4, COUNT // 5)[ROWS // 5]
    for stamps, words, atol in (
        (ROWS // 4 * 40 + ROWS % 4, "share the stamp of a burst", 1e-3),
        (ROWS // 25 * 250 + ROWS % 25, "share the stamp of a burst", 1e-3),
        (ROWS // 2 * 20, SHARED, 1e-2),
        (ROWS // 7 * 70, SHARED, 1e-1),
        (np.where(ROWS % 4, "", ROWS * 10), "without a stamp share the last one", 1e-1),
        (ROWS // 5 * 50 + jitter + ROWS % 5, "share the stamp of a burst", 2.0),
        (clock_text(ROWS * 10, "{h:02d}:{m:02d}:{s:02d}"), SHARED, 1e-1),
        (1_714_720_502 + ROWS // 100, SHARED, 1e-1),
    ):
        path = put(tmp_path, table(stamps))
        sequence = check(path, words, atol=atol)
        assert np.median(np.diff(sequence.time)) == pytest.approx(0.01, rel=2e-3)
        assert sequence.time[-1] == pytest.approx(TIME[-1], abs=0.03)


def test_a_burst_before_a_hole_is_not_spread_over_it(tmp_path):
    remaining_rows = (TIME < 5.0 - 1e-9) | (TIME > 5.8 - 1e-9)
    stamps = [f"{stamp:.3f}" for stamp in (ROWS // 4 * 4 / 100)[remaining_rows]]
    sequence, notes = import_recording(put(tmp_path, table(stamps, values=WALK[remaining_rows])))
    assert any("gyro lacks samples 1 times, for up to 0.79 s" in note for note in notes)
    before = np.round(sequence.time * 100).astype(int)[:500]
    np.testing.assert_allclose(sequence.accel[:500], WALK[before, 3:], atol=0.5)


def test_a_delay_of_every_second_row_is_no_rate(tmp_path):
    """1 and 19 ms in turn: 100 samples a second."""
    sequence, _ = import_recording(
        put(tmp_path, table(np.where(ROWS % 2, ROWS * 10 + 9, ROWS * 10)))
    )
    np.testing.assert_allclose(np.diff(sequence.time), 0.01, atol=1e-9)
    np.testing.assert_allclose(sequence.gyro[2:-2], WALK[1:-3, :3], atol=0.2)


def test_rounded_stamps_do_not_change_the_rate(tmp_path):
    """400 Hz in whole ms, 208 Hz in hundredths of a second."""
    for rate, unit in ((400, 1000), (208, 100)):
        stamps = np.floor(ROWS / rate * unit).astype(int) * (1000 // unit)
        sequence, notes = import_recording(put(tmp_path, table(stamps)))
        assert 1 / np.diff(sequence.time)[0] == pytest.approx(rate, rel=1e-3)
        assert any("are rounded to" in note for note in notes)


def test_a_clock_that_drifts_may_be_rounded(tmp_path):
    """Half an hour at 400 Hz in whole ms, with a crystal that warms up."""
    index = np.arange(40_000)
    stamps = np.floor(index * 2.5 * (1 + 1e-4 * index / len(index))).astype(int)
    values = np.tile(WALK, (40, 1))[: len(index)]
    path = put(tmp_path, table(stamps, values=values))
    sequence, notes = import_recording(path, gyro_unit="rad/s")
    assert any("are rounded to 0.001 s" in note for note in notes)
    assert np.median(np.diff(sequence.time)) == pytest.approx(0.0025, rel=2e-4)
    assert sequence.time[-1] == pytest.approx((stamps[-1] - stamps[0]) / 1000, abs=0.01)


def test_lost_samples_are_told(tmp_path):
    header, others = rows(table())
    third = put(tmp_path, lines(header, *(row for n, row in enumerate(others) if n % 4 != 3)))
    check(third, r"75\.04 samples a second, but its usual step is that of 100 Hz", 0.2)
    lasting = np.random.default_rng(1).random(COUNT) < 0.75
    path = put(
        tmp_path,
        lines(header, *(r for r, presence in zip(others, lasting, strict=True) if presence)),
    )
    sequence = check(path, r"7\d\.\d+ samples a second, but its usual step is that of 100 Hz", 0.2)
    assert sequence.time[-1] == pytest.approx(TIME[-1], abs=0.05)


@pytest.mark.parametrize(
    ("stamps", "period"),
    [
        ((2**32 - 4_000_000 + ROWS * 10_000) % 2**32, "us"),
        ((64_000 + ROWS * 10) % 2**16, "ms"),
        ((2**24 - 10**6 + ROWS * 10_000) % 2**24, "us"),
        ((ROWS * 10_000) % 2**16, "us"),
        (((2**31 - 4_000_000 + ROWS * 10_000) + 2**31) % 2**32 - 2**31, "us"),
        (np.round((4294.967296 - 5 + TIME) % 4294.967296, 6), "s"),
        ((ROWS * 10) % 2**12, "ms"),
        ((ROWS * 10) % 1000, "ms"),
        (np.round((57.0 + TIME) % 60.0, 2), "s"),
    ],
)
def test_a_clock_that_wraps_goes_on(tmp_path, stamps, period):
    path = put(tmp_path, table(stamps))
    check(path, rf"the clock of gyro wrapped \d+ times.*time of gyro taken as {period}\b")


def test_a_clock_that_starts_again_is_never_mixed_in(tmp_path):
    def again(first):
        return put(
            tmp_path, table([f"{t:.3f}" for t in np.where(ROWS < first, TIME, TIME - first / 100)])
        )

    for first in (COUNT - 4, COUNT - 100):
        recording = imported(again(first))
        np.testing.assert_allclose(recording.sequence.gyro, WALK[:first, :3], atol=1e-5)
        lost = COUNT - first
        target = recording.notes if lost < 15 else recording.warnings
        assert any(
            f"starts again or was set back near row {first + 2}: {lost} rows" in t for t in target
        )
    refused(again(700), "starts again .* 700 rows overlap others; cut the recording there")
    stamps = np.where(ROWS == 500, TIME - 0.005, TIME)  # a row that is late, and of uneven steps
    order = np.r_[:500, 501:510, 500, 510:COUNT]
    path = put(tmp_path, table([f"{t:.3f}" for t in stamps[order]], values=imu(stamps[order])))
    notes = " | ".join(imported(path).notes)
    assert "its rows were sorted" in notes
    assert "starts again" not in notes
    back = put(tmp_path, table([f"{t:.3f}" for t in np.where(ROWS < 900, TIME, TIME - 3.0)]))
    refused(back, "starts again or was set back near row 902")


@pytest.mark.parametrize(
    ("stamps", "words"),
    [
        (5000 + ROWS, "counts samples: its steps are 1; give --sample-rate"),
        (ROWS % 256, "counts samples"),
        (ROWS // 4, "counts samples"),
        (ROWS * 2, "makes it run at 500 Hz, which may be wrong; if that is right, state its unit"),
        (1000 + ROWS * 4, "makes it run at 250 Hz, which may be wrong"),
        (917352 + ROWS * 100, "samples come 10 times faster .* give --time-unit"),
        (133 * 10**15 + ROWS * 10**5, "samples come 10 times faster"),
        ([f"{t / 60:.8f}" for t in TIME], "unit of field 'time' is ambiguous .* --time-unit"),
        ([f"{739375.4 + t / 86400:.10f}" for t in TIME], "unit of field 'time' is ambiguous"),
        (["1.71472E+18"] * COUNT, "same stamp 1.71472e.18; a spreadsheet may have cut its digits"),
    ],
)
def test_what_is_no_stamp_is_asked_for(tmp_path, stamps, words):
    refused(put(tmp_path, table(stamps)), words)


def test_a_clock_may_have_any_unit_that_is_stated(tmp_path):
    for stamps, unit in (
        (917352 + ROWS * 100, "1e-4"),
        (133 * 10**15 + ROWS * 10**5, "1e-7"),
        (5000 + ROWS, "0.01"),
        (ROWS, "1/100"),
        ([f"{t / 60:.9f}" for t in TIME], "60"),
    ):
        check(put(tmp_path, table(stamps)), options={"time_unit": unit})
    refused(tmp_path / "walk.csv", "time_unit: unknown value 'h'; known: s, ms", time_unit="h")


def test_a_rate_at_the_edge_is_believed_if_gravity_turns_as_the_gyro_says(tmp_path):
    """10 Hz, by a phone; 1000 Hz, of a table that lies still."""
    time = np.arange(600) / 10
    slow = np.stack([np.zeros(600), 0.3 * np.cos(0.5 * time), np.zeros(600)], axis=1)
    angle = 0.6 * np.sin(0.5 * time)
    force = 9.81 * np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    noise = np.random.default_rng(0).normal(0, 0.01, (600, 6))
    values = np.hstack([slow, force]) + noise
    path = put(tmp_path, table(np.arange(600) * 100, values=values))
    sequence, _ = import_recording(path)
    assert sequence.time[-1] == pytest.approx(59.9)
    still = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (600, 1)) + noise
    path = put(tmp_path, table([f"{t:.4f}" for t in np.arange(600) / 10], values=still))
    refused(path, "makes it run at 10 Hz, which may be wrong", gyro_unit="rad/s")
    import_recording(path, gyro_unit="rad/s", time_unit="s")


@pytest.mark.parametrize(
    ("pattern", "start"),
    [
        ("{h:02d}:{m:02d}:{s:02d}:{ms:03d}", 33_302_250),
        ("{h}:{m:02d}:{s:02d},{ms:03d}", 33_302_250),
        ("{minutes}:{s:02d}.{ms:03d}", 902_250),
        ("{m:02d}:{s:02d}.{ms:03d}", 3_600_000 - 5_000),
        ("{h:02d}:{m:02d}:{s:02d} {ms:03d}", 33_302_250),
        ("2024-05-03_{h:02d}:{m:02d}:{s:02d}.{ms:03d}", 33_302_250),
        ("{h:02d}:{m:02d}:{s:02d}.{ms:03d}", 86_400_000 - 5_000),
        ("2024-05-03 {h:02d}:{m:02d}:{s:02d}.{ms:03d}000", 33_302_250),
        ("2024-05-03T{h:02d}:{m:02d}:{s:02d}.{ms:03d}Z", 33_302_250),
        ("2024-05-03T{h:02d}:{m:02d}:{s:02d}.{ms:03d}+02:00", 33_302_250),
        ("20240503_{h:02d}{m:02d}{s:02d}.{ms:03d}", 33_302_250),
        ("20240503T{h:02d}{m:02d}{s:02d}.{ms:03d}Z", 33_302_250),
        ("2024-05-03-{h:02d}-{m:02d}-{s:02d}-{ms:03d}", 33_302_250),
        ("2024-05-03 {h:02d}:{m:02d}:{s:02d}.{ms:03d}-0430", 33_302_250),
        ("3.5.2024 {h:02d}:{m:02d}:{s:02d}.{ms:03d}", 33_302_250),
        ("5/3/2024 {h:02d}:{m:02d}:{s:02d}.{ms:03d} AM", 33_302_250),
    ],
)
def test_times_of_day_are_stamps(tmp_path, pattern, start):
    texts = clock_text(start + ROWS * 10, pattern)
    mark = ";" if "," in pattern else ","
    check(put(tmp_path, table(texts, separator=mark)))


def test_half_days_end_at_noon_and_midnight(tmp_path):
    for start, texts in ((43_195_000, ("AM", "PM")), (86_395_000, ("PM", "AM"))):
        clock = clock_text(start + ROWS * 10, "{h:02d}:{m:02d}:{s:02d}.{ms:03d}")
        hours = [f"{(int(text[:2]) + 11) % 12 + 1:02d}{text[2:]}" for text in clock]
        check(put(tmp_path, table([f"{h} {texts[n >= 500]}" for n, h in enumerate(hours)])))


def test_an_index_of_times_without_a_name_is_the_time(tmp_path):
    stamps = clock_text(33_302_250 + ROWS * 10, "2024-05-03 {h:02d}:{m:02d}:{s:02d}.{ms:03d}000")
    check(put(tmp_path, table(stamps, ("", *AXES))))


def test_the_time_that_a_console_puts_before_each_line(tmp_path):
    pattern = "{h:02d}:{m:02d}:{s:02d}.{ms:03d} -> "
    texts = clock_text(86_400_000 - 5_000 + ROWS * 10, pattern)
    for separator in (",", "\t", " "):
        header, others = rows(table(ROWS * 10, ("millis", *AXES), separator=separator))
        whole = [before + row for before, row in zip(texts, others, strict=True)]
        check(put(tmp_path, lines(texts[0] + header, *whole)), "a serial console.*time=millis")
        bare = [
            before + row.partition(separator)[2] for before, row in zip(texts, others, strict=True)
        ]
        path = put(tmp_path, lines(*bare))
        places = {name: str(index) for index, name in enumerate(HEADER)}
        compare_imu(import_recording(path, places)[0])
    path = put(tmp_path, lines(texts[0] + ",".join(AXES), *bare).replace(" -> ", "  > "))
    with pytest.raises(InputError):  # no console writes this
        imported(path)


def test_names_that_a_board_prints_before_its_numbers(tmp_path):
    names = ("t", *(f"{sensor}{axis}" for sensor in "ga" for axis in "xyz"))
    texts = clock_text(33_302_250 + ROWS * 10, "{h:02d}:{m:02d}:{s:02d}.{ms:03d} -> ")
    for form, separator in (("{}:{}", ","), ("{} = {}", "  "), ("{}:{}", "\t")):
        cells = [row.split(",") for row in rows(table(ROWS * 10))[1]]
        named = [
            separator.join(form.format(n, c) for n, c in zip(names, row, strict=True))
            for row in cells
        ]
        boot = "ets Jul 29 2019 12:21:46"
        words = r"row 701 .*1 such rows are left out.* serial console.*time=t gyro_x=gx"
        check(put(tmp_path, lines(*named[:700], boot, *named[700:])), words)
        console_lines = [
            before + row.split(separator, 1)[1] for before, row in zip(texts, named, strict=True)
        ]
        check(put(tmp_path, lines(*console_lines)), "time=console_time gyro_x=gx")


def test_a_clock_that_the_board_prints_comes_before_that_of_the_console(tmp_path):
    """Whatever it is called; the console's stamps are those of the arrival."""
    arrivals = 33_302_250 + ROWS * 10 + np.random.default_rng(1).integers(0, 9, COUNT)
    texts = clock_text(np.sort(arrivals), "{h:02d}:{m:02d}:{s:02d}.{ms:03d} -> ")
    for clock in ("time", "t", "millis"):
        names = (clock, *AXES)
        named = [
            " ".join(f"{n}:{c}" for n, c in zip(names, row.split(","), strict=True))
            for row in rows(table(ROWS * 10))[1]
        ]
        whole = [before + row for before, row in zip(texts, named, strict=True)]
        whole[500] = named[500]  # a line without its stamp is no row, nor is it cut
        sequence = check(put(tmp_path, lines(*whole)), "row 501 .*1 such rows are left out")
        assert len(sequence.time) == COUNT


def test_no_number_without_a_name_is_lost(tmp_path):
    """A word before three numbers names no column."""
    cells = [row.split(",") for row in rows(table(ROWS * 10))[1]]
    named = [" ".join(["T:", c[0], "G:", *c[1:4], "A:", *c[4:]]) for c in cells]
    places = ("1", "3", "4", "5", "7", "8", "9")
    path = put(tmp_path, lines(*named))
    sequence, _ = import_recording(path, dict(zip(("time", *AXES), places, strict=True)))
    compare_imu(sequence, atol=2e-3)
    names = ("gx", "gy", "gz", "ax", "ay", "az")
    for first in ("{}", "T:12:00:{}"):  # the time would be lost, or be the hour
        timed_lines = [
            " ".join([first.format(c[0]), *(f"{n}:{v}" for n, v in zip(names, c[1:], strict=True))])
            for c in cells
        ]
        with pytest.raises(InputError):
            imported(put(tmp_path, lines(*timed_lines)), sample_rate=100.0)
    forms = [f"t={{}}, {', '.join(f'{n}={{}} rad/s' for n in names[:3])}"]
    forms += [f"{n}={{}} m/s^2" for n in names[3:]]
    with_units = [", ".join(forms).format(*c) for c in cells]
    check(put(tmp_path, lines(*with_units)), "serial console")


def test_a_long_word_takes_no_longer_than_a_table(tmp_path):
    start = time.process_time()
    for word in ("a" * 100_000, "1a" * 50_000, "a_" * 50_000 + ":"):
        refused(put(tmp_path, word), "holds no row")
    assert time.process_time() - start < 10.0


def test_a_date_and_a_time_are_one_stamp(tmp_path):
    texts = clock_text(86_400_000 - 5_000 + ROWS * 10, "{h:02d}:{m:02d}:{s:02d}.{ms:03d}")
    dates = np.where(ROWS < 500, "2024-05-03", "2024-05-04")
    stamps = [f"{date},{text}" for date, text in zip(dates, texts, strict=True)]
    path = put(tmp_path, table(stamps, ("date", *HEADER)))
    check(path)
    sequence, _ = import_recording(path, {"time": "date+time"})
    compare_imu(sequence)
    assert sequence.attributes["start_time"] == pytest.approx(1_714_780_795.0)


@pytest.mark.parametrize(
    ("date", "words"),
    [
        ("2024-05-03", "to be in UTC$"),
        ("20240503", "to be in UTC$"),
        ("03.05.2024", "to be in UTC, with the day before the month"),
        ("3.5.2024", "to be in UTC, with the day before the month"),
        ("05/03/2024", "to be in UTC, with the month before the day"),
    ],
)
def test_a_date_is_the_same_in_a_column_of_its_own(tmp_path, date, words):
    texts = clock_text(33_302_250 + ROWS * 10, "{h:02d}:{m:02d}:{s:02d}.{ms:03d}")
    path = put(tmp_path, table([f"{date},{text}" for text in texts], ("date", *HEADER)))
    sequence, notes = import_recording(path, {"time": "date+time"})
    assert sequence.attributes["start_time"] == pytest.approx(1_714_727_702.25)
    assert any(re.search(words, note) for note in notes)
    if len(date) != 8 or "." in date:  # a number of eight digits is no date beside others
        joined, notes = import_recording(put(tmp_path, table([f"{date} {x}" for x in texts])))
        assert joined.attributes["start_time"] == pytest.approx(1_714_727_702.25)
        assert sum(bool(re.search(words, note)) for note in notes) == 1


def test_a_first_number_above_twelve_is_a_day_and_what_is_no_date_is_refused(tmp_path):
    texts = clock_text(86_400_000 - 5_000 + ROWS * 10, "{h:02d}:{m:02d}:{s:02d}.{ms:03d}")
    dates = np.where(ROWS < 500, "12/05/2024", "13/05/2024")
    stamps = [f"{date},{text}" for date, text in zip(dates, texts, strict=True)]
    path = put(tmp_path, table(stamps, ("date", *HEADER)))
    sequence, _ = import_recording(path, {"time": "date+time"})
    compare_imu(sequence)
    assert sequence.attributes["start_time"] == pytest.approx(1_715_558_395.0)
    path = put(tmp_path, table([f"Monday,{text}" for text in texts], ("date", *HEADER)))
    words = "column 'date' holds 'Monday', no date; write dates as 2024-05-03"
    refused(path, words, {"time": "date+time"})


# --- units


def test_units_of_a_header_and_counts(tmp_path):
    names = [f"g_{a} [mdps]" for a in "xyz"] + [f"a_{a} [cm/s^2]" for a in "xyz"]
    check(put(tmp_path, table(header=("time [s]", *names), gyro=DEGREES * 1e3, accel=100.0)))
    names = [f"g_{a} (deg/s)" for a in "xyz"] + [f"a_{a} (LSB)" for a in "xyz"]
    path = put(tmp_path, table(header=("time", *names), gyro=DEGREES, accel=16384 / G))
    refused(path, "column 'a_x .LSB.' is in 'LSB', .* raw counts: --accel-unit 16384/g")
    check(path, options={"accel_unit": "16384/g"})
    path = put(tmp_path, table(gyro=DEGREES * 131, accel=16384 / G, digits=0))
    refused(path, "raw counts. 16384 per g is the scale of ±2 g: --accel-unit 16384/g$")
    count_units = {"accel_unit": "16384/g", "gyro_unit": "131/deg/s"}
    check(path, options=count_units, atol=5e-3)
    check(path, options=count_units | {"accel_unit": "0.06103515625*mg"}, atol=5e-3)
    path = put(tmp_path, table(gyro=DEGREES * 1e3))
    refused(path, "beyond any gyro's range in rad/s and deg/s; state its unit: mdps, or raw counts")
    path = put(tmp_path, table(accel=100.0))
    (warning,) = imported(path).warnings
    assert "gravity in mg (1000) as well as in cm/s² (981), which is ambiguous" in warning
    check(path, options={"accel_unit": "cm/s2"})
    path = put(tmp_path, table())
    (warning,) = imported(path, gyro_unit="mdps").warnings
    assert "the gyro never exceeds 0.00" in warning and "check its unit, mdps" in warning
    for option, value in (("gyro_unit", "rpm"), ("accel_unit", "0/g"), ("accel_unit", "x/g")):
        refused(path, f"{option}: unknown value '{value}'; known: ", **{option: value})


def test_a_scale_is_a_unit_counts_in_it_or_the_size_of_one():
    for text, value in (
        ("rad/s", 1.0),
        ("131/deg/s", np.pi / 180 / 131),
        ("0.07*deg/s", 0.07 * np.pi / 180),
    ):
        assert units.scale_of(text, "gyro") == pytest.approx(value)
    for text in ("", "deg", "131", "-1/deg/s", "1e400*deg/s", "nan*deg/s"):
        with pytest.raises(InputError, match="gyro_unit: unknown value"):
            units.scale_of(text, "gyro")


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_what_the_refusal_of_a_unit_names_is_taken(sensor):
    with pytest.raises(InputError, match=f"{sensor}_unit: unknown value 'rpm'") as caught:
        units.scale_of("rpm", sensor)
    names, examples = str(caught.value).split("known: ")[1].split(", counts in one as ")
    for remedy in (*names.split(", "), *examples.split(", or their size as ")):
        assert units.scale_of(remedy, sensor) > 0


# --- rows of several sensors


def test_rows_that_name_their_sensor(tmp_path):
    """GetSensorData, GnssLogger, and a column of names behind the stamp."""
    stamps = [(f"{t + 0.001:.3f}", f"{3600 + t:.3f}") for t in TIME]
    header = "% ACCE;AppTimestamp(s);SensorTimestamp(s);Acc_X(m/s^2);Acc_Y(m/s^2);Acc_Z(m/s^2)"
    accel, gyro = WALK[:, 3:], WALK[:, :3]
    sensor_rows = interleaved(
        by_sensor("ACCE", stamps, accel, ";"), by_sensor("GYRO", stamps, gyro, ";")
    )
    sensor_rows[100:100] = ["WIFI;0.500;1.0;SSID;aa:bb;-70;2412;3"]
    check(put(tmp_path, lines("% LogFile", header, *sensor_rows), "ipin.txt"))
    stamps = [(str(n // 10**6), str(n)) for n in NS]
    header = [
        f"# Uncal{n},utcTimeMillis,elapsedRealtimeNanos,Uncal{n}X{u},Uncal{n}Y{u},Uncal{n}Z{u}"
        for n, u in (("Accel", "Mps2"), ("Gyro", "RadPerSec"))
    ]
    sensor_rows = interleaved(
        by_sensor("UncalAccel", stamps, accel), by_sensor("UncalGyro", stamps, gyro)
    )
    check(
        put(tmp_path, lines("# Version: v3", "# Raw,a,b", *header, *sensor_rows), "gnss.txt"),
        "elapsedR",
    )
    stamps = [(f"{t:.3f}",) for t in TIME]
    sensor_rows = interleaved(
        by_sensor("accelerometer", stamps, accel), by_sensor("gyroscope", stamps, gyro)
    )
    cells = [row.split(",") for row in sensor_rows]
    swapped = [",".join([c[1], c[0], *c[2:]]) for c in cells]
    check(put(tmp_path, lines("time,sensor,x,y,z", *swapped)))
    check(put(tmp_path, lines("time,x,y,z,sensor", *(",".join([*c[1:], c[0]]) for c in cells))))
    head = [  # Indoor Location's recorder describes the chips above its rows
        f"#\ttype:{n}\tname:BMI160 {name}\tversion:2062600"
        for n, name in ((1, "Accelerometer"), (4, "Gyroscope"), (35, "Accelerometer Uncalibrated"))
    ]
    kinds = {"accelerometer": "TYPE_ACCELEROMETER", "gyroscope": "TYPE_GYROSCOPE"}
    typed = ["\t".join([c[1], kinds[c[0]], *c[2:], "3"]) for c in cells]
    typed[50:50] = ["0.250\tTYPE_WIFI\tssid\tbssid\t-60\t2412"]
    check(put(tmp_path, lines("#\tstartTime:1574658290986", *head, *typed), "site.txt"))
    for first in (0, 1):  # values by their numbers
        names = ",".join(f"v{n + first}" for n in range(3))
        check(put(tmp_path, lines(f"time,sensor,{names}", *swapped)))
    android = {"accelerometer": "android.sensor.accelerometer", "gyroscope": "x.sensor.gyroscope"}
    check(put(tmp_path, lines("s,time,x,y,z", *(",".join([android[c[0]], *c[1:]]) for c in cells))))
    types = {"accelerometer": "1", "gyroscope": "4"}
    check(
        put(tmp_path, lines("type,time,x,y,z", *(",".join([types[c[0]], *c[1:]]) for c in cells)))
    )


def test_rows_of_two_imus_are_chosen_by_a_column(tmp_path):
    header, others = rows(table([f"{n * 10000},0" for n in ROWS], ("TimeUS", "I", *AXES)))
    second = rows(table([f"{n * 10000},1" for n in ROWS], values=WALK + 0.1))[1]
    path = put(tmp_path, lines(header, *interleaved(others, second)))
    refused(path, "rows of several sensors: column 'I' holds 0, 1 in turn; choose one: --where I=0")
    check(path, options={"where": "I=0"})
    refused(path, "has no row with I=7; there are: 0, 1", where="I=7")
    refused(path, "has no row with J=0; there are: TimeUS, I, gyro_x", where="J=0")
    path = put(tmp_path, lines(header, *others, *second))  # one after the other
    refused(path, "rows of several sensors: column 'I' holds 0, 1 in turn; choose one: --where I=0")
    check(path, options={"where": "I=0"})


@pytest.mark.parametrize("delay", [0, 4, 5])
def test_two_devices_in_turn_without_a_column_are_refused(tmp_path, delay):
    """The other one is held otherwise, and has the same stamps or those between."""
    turn = Rotation.from_euler("zx", [90, 20], degrees=True)
    turned = turn.apply(WALK.reshape(-1, 3)).reshape(-1, 6)
    header, others = rows(table([f"{n * 10}" for n in ROWS]))
    second = rows(table([f"{n * 10 + delay}" for n in ROWS], values=turned))[1]
    path = put(tmp_path, lines(header, *interleaved(others, second)))
    refused(
        path, "two sensors in turn: .* far more from the next .*; keep the samples of one sensor"
    )
    check(put(tmp_path, lines(header, *interleaved(others, second)[::2])))


def test_a_part_that_vibrates_at_half_of_the_rate_is_no_second_device(tmp_path):
    vibration = np.cos(2 * np.pi * 0.45 * ROWS)[:, None] * np.repeat([1.0, 5.0], 3)
    path = put(tmp_path, table([f"{n * 10}" for n in ROWS], values=WALK + vibration))
    assert any("it vibrates at about half of its rate" in w for w in imported(path).warnings)


# --- sensors that contradict each other


@pytest.mark.parametrize(
    ("turn", "words"),
    [
        ([0, 1, 2, 3, 4, 5], ""),
        (["-", 0, 1, 2, 3, 4, 5], "gravity turns against the gyro: its sign is wrong, or the axes"),
        (
            [1, 0, 2, 4, 3, 5],
            "gravity turns against the gyro: its sign is wrong, or the axes are l",
        ),
        (
            [0, 1, 2, 4, 3, 5],
            r"gravity does not turn as the gyro says.* \(-y, -x, -z\) of the gyro",
        ),
        ([1, 2, 0, 3, 4, 5], r"the sensors contradict each other.* \(z, x, y\) of the gyro"),
    ],
)
def test_gravity_tells_signs_and_axes(tmp_path, turn, words):
    sign = [-1 if turn[0] == "-" else 1] * 3 + [1] * 3
    order = [column for column in turn if column != "-"]
    path = put(tmp_path, table(values=(WALK * sign)[:, order]))
    if words:
        refused(path, words)
        refused(path, words, gyro_unit="rad/s")  # stated or not
    else:
        check(path)


def test_a_unit_in_doubt_tells_what_gravity_says(tmp_path):
    """Of a phone that is turned without steps about two axes, by a gyro with the wrong sign."""
    angles = np.stack([0.6 * np.sin(0.9 * TIME), 0.5 * np.sin(0.7 * TIME)], axis=1)
    rotation = Rotation.from_euler("YX", angles)
    force = rotation.inv().apply([0, 0, 9.81])
    turns = (rotation[:-1].inv() * rotation[1:]).as_rotvec() / np.diff(TIME)[:, None]
    gyro = -np.concatenate([turns, turns[-1:]])
    values = np.hstack([gyro, force]) + np.random.default_rng(0).normal(0, 0.01, WALK.shape)
    words = "unit of field 'gyro' is ambiguous .* in rad/s gravity turns against the gyro"
    refused(put(tmp_path, table(values=values)), words)
    right = put(tmp_path, table(values=values * [-1, -1, -1, 1, 1, 1]))
    assert any("gyro taken as rad/s" in note for note in import_recording(right)[1])


def test_the_remedy_for_wrong_axes_works(tmp_path):
    """The message gives the words that repair it."""
    path = put(tmp_path, table(values=WALK[:, [1, 0, 2, 3, 4, 5]] * [1, -1, 1, 1, 1, 1]))
    with pytest.raises(InputError, match="--columns gyro_x=") as caught:
        import_recording(path)
    words = re.findall(r"(gyro_[xyz])=(-?gyro_[xyz])", str(caught.value))
    compare_imu(import_recording(path, dict(words))[0])


def test_dead_sensors_are_refused(tmp_path):
    for values, words in (
        (
            WALK * [0, 0, 0, 1, 1, 1],
            r"field 'gyro' reads \(0, 0, 0\) throughout; the sensor was off",
        ),
        (
            WALK * [1, 1, 1, 0, 0, 0] + [0, 0, 0, 0, 0, 9.8],
            "field 'accel' reads .0, 0, 9.8. throughou",
        ),
    ):
        refused(put(tmp_path, table(values=values)), words)
    recording = imported(put(tmp_path, table(values=WALK * [1, 0, 1, 1, 1, 1])))
    assert any("gyro_y reads 0 throughout: this axis is dead" in w for w in recording.warnings)


def test_rows_that_a_hung_sensor_repeats_are_missing_samples(tmp_path):
    noisy = WALK + np.random.default_rng(2).normal(0, 0.01, WALK.shape)

    def stuck(first, last, axes=slice(0, 6)):
        values = noisy.copy()
        values[first:last, axes] = noisy[first, axes]
        return put(tmp_path, table(values=values))

    recording = imported(stuck(1200, COUNT))
    assert recording.sequence.time[-1] == pytest.approx(12.0)
    assert any("gyro repeats the same values in 199 of 1400 rows" in w for w in recording.warnings)
    for axes in (slice(0, 6), slice(3, 6)):
        recording = imported(stuck(600, 660, axes))
        valid = recording.sequence.imu_valid
        assert valid is not None and not valid[610:650].any() and valid[:600].all()
        assert any("accel repeats the same values in 59 of 1400" in w for w in recording.warnings)
    refused(stuck(400, 700), "repeats the same values for 3.00 s after 4.00 s: it was stuck; cut")


def test_a_gyro_may_read_zero_at_rest(tmp_path):
    """Some suppress small rates."""
    noise = np.random.default_rng(2).normal(0, 0.02, WALK.shape)
    values = WALK + noise
    values[:300] = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (300, 1)) + noise[:300] * [
        0,
        0,
        0,
        1,
        1,
        1,
    ]
    recording = imported(put(tmp_path, table(values=values)), gyro_unit="rad/s")
    assert recording.sequence.imu_valid is None and not any(
        "repeats" in w for w in recording.warnings
    )
    values = WALK + noise
    values[600:660, :3] = 0.0  # while it is shaken, a gyro that reads 0 hangs
    recording = imported(put(tmp_path, table(values=values)), gyro_unit="rad/s")
    assert any("gyro repeats the same values in 59 of 1400 rows" in w for w in recording.warnings)
    valid = recording.sequence.imu_valid
    assert valid is not None and not valid[610:650].any() and valid[:600].all()


def test_a_sensor_slower_than_its_rows_runs_at_its_own_rate(tmp_path):
    slow = WALK[ROWS // 5 * 5]
    sequence, notes = import_recording(put(tmp_path, table(values=slow)), gyro_unit="rad/s")
    assert np.median(np.diff(sequence.time)) == pytest.approx(0.05)
    assert any("they are not samples, and it runs at 20 Hz" in note for note in notes)
    half = np.hstack([WALK[:, :3], WALK[ROWS // 2 * 2, 3:]])
    sequence, notes = import_recording(put(tmp_path, table(values=half)))
    np.testing.assert_allclose(
        sequence.accel[20:-20], WALK[20:-20, 3:][: len(sequence.time) - 40], atol=0.05
    )
    assert any("accel repeats the same values" in n and "50 Hz" in n for n in notes)
