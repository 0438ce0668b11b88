"""What is wrong in a recording is refused in one line that names its file and field.

One table over all layouts, of what users may get wrong and of what once was wrong. Each entry
changes one file of the layout's known walk; `None` takes it away.
"""

import io
import json
import os
import pickle
import zipfile

import numpy as np
import pytest
from scipy.io import loadmat, savemat

from gnio_jax.errors import InputError
from tests.support.damage import BILLIONS, GALAXY, NO_DATE, Damage, after, packed, unpacked
from tests.support.damaged_recordings import check, outcome, written
from tests.support.indoor_location_files import START

# --- changes: (file, content) -> content


def text(change):
    return lambda _, content: change(content.decode()).encode()


def replaced(old, new):
    return text(lambda whole: whole.replace(old, new, 1))


def lines(change):
    return text(lambda whole: "\n".join(change(whole.splitlines())))


def cells(change):
    """Of a table as an array of texts, its header among them."""

    def of_lines(rows):
        table = np.array([row.split(",") for row in rows], dtype=object)
        return [",".join(row) for row in change(table)]

    return lines(of_lines)


def cell(row, column, value, separator=","):
    """One cell or several; `row` counts from 0 with the header, `column` may be its name."""

    def change(rows):
        entries = rows[row].split(separator)
        position = rows[0].split(separator).index(column) if isinstance(column, str) else column
        places = range(len(entries))[position] if isinstance(position, slice) else [position]
        for index in places:
            entries[index] = value
        return [*rows[:row], separator.join(entries), *rows[row + 1 :]]

    return lines(change)


def scaled(columns, factor):
    """Columns of numbers, or the one of this name in the header."""

    def change(table):
        named = isinstance(columns, str)
        position = list(table[0]).index(columns) if named else columns
        table[named:, position] = table[named:, position].astype(float) * factor
        return table.astype(str)

    return cells(change)


def without(name):
    return cells(lambda table: table[:, table[0] != name])


def fields(change):
    def apply(file, content):
        arrays, attributes = unpacked(file, content)
        arrays = {name: values.copy() for name, values in arrays.items()}
        change(arrays)
        return packed(file, arrays, attributes)

    return apply


def put(name, rows, value):
    return fields(lambda arrays: arrays[name].__setitem__(rows, value))


def times(prefix, factor):
    """The fields whose names begin with `prefix`."""

    def change(arrays):
        arrays.update({name: arrays[name] * factor for name in arrays if name.startswith(prefix)})

    return fields(change)


def info(**changes):
    """Entries of a JSON; `None` takes one away."""

    def change(whole):
        others = {name: value for name, value in json.loads(whole).items() if name not in changes}
        replacements = {name: value for name, value in changes.items() if value is not None}
        return json.dumps(others | replacements)

    return text(change)


def described(*names):
    return text(lambda _: json.dumps({"columns_name(width)": names}))


def written_as(whole):
    return text(lambda _: whole)


def array(change):
    """Of an array of NumPy whose file has no suffix."""

    def apply(_, content):
        out = io.BytesIO()
        np.save(out, change(np.load(io.BytesIO(content))))
        return out.getvalue()

    return apply


def in_zip(old, new):
    """In the text of the only file of a zip."""

    def apply(_, content):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            (name,) = archive.namelist()
            whole = archive.read(name).decode().replace(old, new)
        out = io.BytesIO()
        with zipfile.ZipFile(out, "w") as archive:
            archive.writestr(name, whole)
        return out.getvalue()

    return apply


def track(change):
    """Of the struct in a MATLAB file."""

    def apply(_, content):
        variables = loadmat(io.BytesIO(content), simplify_cells=True)
        name = next(name for name in variables if not name.startswith("__"))
        change(variables[name])
        out = io.BytesIO()
        savemat(out, {name: variables[name]}, long_field_names=True)
        return out.getvalue()

    return apply


def body(name, change):
    def apply(struct):
        struct["RigidBodies"][name] = change(struct["RigidBodies"][name])

    return track(apply)


def mirrored(values):
    values[6:, 20] *= -1.0  # the third column of frame 21
    return values


def of_kind(kind, old, new):
    """In the lines of this kind."""
    return lines(lambda rows: [x.replace(old, new) if kind in x else x for x in rows])


def once(what, where=0.5, much=0.1, token=None):
    """A damage that fuzzing has met."""
    return lambda file, content: after(content, Damage(file, what, where, much, token))


TLIO = ["ts_us(1)", "gyr_compensated_rotated_in_World(3)", "acc_compensated_rotated_in_World(3)"]
TLIO += ["qxyzw_World_Device(4)", "pos_World_Device(3)", "vel_World(3)"]
WIDER = [TLIO[0], *TLIO[2:], "gyr_compensated_rotated_in_World(4)"]
NAMES = lines(lambda rows: ["time" + ",name" * 15, *rows])


def few_poses(table):
    table[4:, 3] = "nan"
    return table


HALF_POSE = f"T_BS: [{', '.join(['0.5'] * 16)}]\n"
HALF = text(lambda whole: whole[: len(whole) // 2])
HALF_BYTES = lambda _, content: content[: len(content) // 2]  # noqa: E731
BLANK_STAMPS = lines(lambda rows: ["" for _ in rows[1:]] + rows[:1])
NARROWER = cells(lambda table: table[:, :-1])
NO_CELL = lines(lambda rows: rows[:1] + [row[: row.rindex(" ")] for row in rows[1:]])
NO_GYRO = lines(lambda rows: [row for row in rows if "GYRO" not in row])
MONTH = str(START)[:7], "1574999"
LONG_NAME = once("stray line", 1.0, token="x" * 5000)
THREE = "81205.0 0.1 0.2\n81205.1 0.1 0.2\n"
ANOTHER_PHONE = lines(
    lambda rows: [f"{float(row.split(' ')[0]) - 9e3:.4f} {row.partition(' ')[2]}" for row in rows]
)
TRUTH, YAML = "state_groundtruth_estimate0/data.csv", "sensor.yaml"
PACKET = "data/0000000200.txt"

BAD = {
    "tlio": [
        (".npy", put("", (7, 0), 0.0), "'time'", "does not increase"),
        (".npy", put("", (8, slice(7, 11)), 0.0), "'qxyzw_World_Device'", "row 9"),
        (".npy", fields(lambda x: x.update({"": x[""][:0]})), "shape (0, 17)"),
        ("description.json", written_as("{}"), "'columns_name(width)'"),
        ("description.json", described("ts_us 1", *TLIO[1:]), "ts_us 1"),
        ("description.json", described(*TLIO[:-1]), "'vel_World' is missing"),
        ("description.json", described(*WIDER), "width 4, expected 3"),
        ("description.json", once("deep"), "is no JSON"),
        ("list.txt", LONG_NAME, "1 of 2 listed sequences are absent"),
    ],
    "oxiod raw": [("Test.txt", once("deep"), "entry '[[[")],
    "oxiod syn": [
        ("imu1.csv", NARROWER, "has 15 columns, expected 16"),
        ("imu1.csv", NAMES, "'time' holds 'time' in its row 1, no number"),
        ("imu1.csv", scaled(slice(7, 13), 9.8), "'gravity' has length 9.8, expected 1 G"),
        ("imu1.csv", scaled(slice(4, 7), 57.3), "'gyro' looks like deg/s"),
        ("imu1.csv", lines(lambda rows: rows[:300]), "holds 300 rows"),
        ("vi1.csv", scaled(slice(2, 5), 1e3), "looks like mm"),
        ("vi1.csv", scaled(8, 0.3), "hold a pose"),
    ],
    "oxiod Tango": [("imu1.csv", once("cell", 0.5, 0.5, "9" * 400), "")],
    "ronin": [
        (".hdf5", put("synced/game_rv", 10, 0.0), "'synced/game_rv'", "not a unit quaternion"),
        (".hdf5", once("type", 0.45, token="S8"), "field 'synced/game_rv' holds"),
        (".hdf5", once("value", 0.6, 0.73, 1e9), "field 'gyro' is beyond 100 rad/s in 1 rows"),
        (".json", info(imu_init_gyro_bias=[10**400, 0, 0]), "'imu_init_gyro_bias'"),
        (".json", info(start_calibration=[1, 1, 0, 0]), "'start_calibration' is not a unit"),
        (".json", info(start_frame=1400), "'start_frame' is 1400, the recording has 1400 rows"),
        (".json", info(start_frame="late"), "'start_frame' is not a number"),
        (".json", info(grv_ori_error=None), "'grv_ori_error' is missing"),
    ],
    "ridi table": [
        (".csv", scaled("time", 0.0), "'time'", "only 1 different stamps"),
        (".csv", cell(61, "rv_x", "3.0"), "'rv_x'", "not a unit quaternion", "row 62"),
        (".csv", scaled("time", 1e-6), "expected 10 to 2000 Hz"),
    ],
    "ridi text": [
        ("/pose.txt", cell(91, 7, "2.0", " "), "not a unit quaternion"),
        ("/pose.txt", once("scale column", 0.0, 0.0, 1e-9), "field 'time' (-"),
        ("gyro.txt", once("scale column", 0.0, 0.0, 1e-3), "check the unit of the stamps"),
        ("gyro.txt", once("cell", 0.5, 0.0, "-1e30"), "field 'time' goes over"),
        ("acce.txt", once("scale column", 0.0, 0.0, 1e-9), "field 'time' gives"),
    ],
    "idol": [
        (".feather", times("timestamp", 0.0), "'timestamp' holds only 1 different stamps"),
        (".feather", times("iphoneAcc", 9.8), "'iphoneAcc' have a median length of 9.8", "1 (G)"),
        (".feather", put("orientW", 60, 3.0), "not a unit quaternion in 1 rows"),
        (".feather", times("processedPosX", np.nan), "hold a pose in only 0 of 1200 rows"),
        (".feather", times("stencilAcc", np.nan), "'stencilAcc' hold numbers in only 0 rows"),
    ],
    "euroc": [
        (TRUTH, cells(few_poses), "holds 3 poses"),
        (TRUTH, cell(8, slice(4, 8), "0.0"), "'q_rs_w', 'q_rs_x'", "not a unit quater", "row 9"),
        (TRUTH, cells(lambda x: x[::40]), "field 'time'", "5 Hz, too slow for a reference"),
        ("imu0/data.csv", replaced("w_RS_S_y", "w_RS_S_q"), "'w_rs_s_y' is missing", "w_RS_S_q"),
        ("imu0/data.csv", once("stray line", 0.5, 0.5, "9" * 400), ""),
        (YAML, written_as("T_BS:\n  data: [1, 2, 3]\n"), "'T_BS' is not a pose"),
        (YAML, written_as(HALF_POSE), "its rotation is none"),
        (YAML, written_as("a: [\n"), "cannot be read as YAML"),
        (YAML, once("content", token=NO_DATE), "cannot be read as YAML"),
        (YAML, once("content", token=BILLIONS), "field 'T_BS' is not a pose"),
        (YAML, once("content", token=GALAXY), "field 'T_BS' is not a pose"),
    ],
    "tumvi": [("mocap0/data.csv", once("column", 0.5, 0.2, "1e300"), "'position' is beyond")],
    "kitti packets": [
        (PACKET, cell(0, 17, "nan", " "), "'wx'"),
        (PACKET, cell(0, 0, "1e300", " "), "field 'lat' is 1e+300"),
        (PACKET, HALF, "expected 30", "cut short"),
        (PACKET, replaced(" ", " x"), "is not a number"),
        ("timestamps.txt", lines(lambda x: x[:-3]), "holds 397 stamps, but there is a packet 399"),
        ("timestamps.txt", once("stray line", token="now"), "line 201 ('now') is not a stamp"),
        ("timestamps.txt", BLANK_STAMPS, "gives 1 packets a stamp"),
    ],
    "kitti npz": [(".npz", times("t", 10), "field 'time'", "10 Hz", "_extract")],
    "comma2k19": [
        ("gyro/value", array(lambda x: x[:-1]), "rows, but there are"),
        ("gyro/value", array(lambda x: x[:, :2]), "expected (n, 3)"),
        ("gyro/value", None, "no such file"),
        ("accelerometer/t", array(lambda x: x * np.nan), "row 0 is not finite"),
        ("frame_positions", array(lambda x: 0.5 * x), "not near the earth's surface"),
        ("frame_orientations", array(lambda x: 2 * x), "not of length 1"),
        ("frame_times", array(lambda x: x.astype(str)), "expected (n,)"),
    ],
    "onavdata": [
        ("position.csv.zip", in_zip("Latitude", "Lat"), "'Latitude' is missing"),
        ("position.csv.zip", in_zip(",0.78", ",45.78"), "is not an angle in rad"),
        ("position.csv.zip", None, "no such file"),
        ("velocity.csv.zip", HALF_BYTES, "cannot be read as a zip"),
        ("attitude.csv.zip", in_zip(",4.0", ",1.0"), "holds 0 rows with a stamp"),
    ],
    "blackbird": [
        (".hdf5", put("traj_target", (7, slice(3, 7)), 0.0), "not a unit quaternion", "row 8"),
        ("imu.txt", lines(lambda rows: rows[:-5]), "'ts'", "695 and 700 rows"),
        ("imu.txt", lines(lambda rows: [rows[0], *rows[2:], rows[1]]), "'ts'"),
        ("imu.txt", NO_CELL, "has 10 columns"),
        ("imu.txt", cell(5, 10, "nan", " "), "column '10' is NaN", "row 6"),
        ("imu.txt", once("column", 0.5, 0.9, "1e30"), "field 'velocity'"),
    ],
    "tyrex Nexus": [
        (".mat", track(lambda struct: struct.pop("RigidBodies")), "'RigidBodies'", "QTM"),
        (".mat", track(lambda struct: struct.update(FrameRate=0.0)), "'FrameRate' is 0.0 Hz"),
        (".mat", body("Positions", lambda x: x[:2]), "'Positions'", ", 3)"),
        (".mat", body("Positions", lambda x: x * 1e-3), "'Positions' spans", "give it in mm"),
        (".mat", body("Positions", lambda x: x * np.nan), "only 0 of", "frames hold a pose"),
        (
            ".mat",
            body("Rotations", mirrored),
            "'Rotations' is not a rotation in 1 frames",
            "frame 21",
        ),
        (".mat", lambda _, content: content[:3000], "MATLAB 5"),
        (".mat", None, "no such file"),
    ],
    "tyrex iPhone": [
        ("description.txt", written_as("[Time]\n"), "'BootTime' is missing"),
        ("description.txt", written_as("BootTime = 12.5"), "gyroscope.txt: field 'time'"),
        ("timeAlignment.txt", written_as("later"), "holds 'later'", "seconds"),
        ("gyroscope.txt", written_as(THREE), "3 columns, expected 4"),
        ("accelerometer.txt", ANOTHER_PHONE, "(column 0) begins", "s after the r", "one phone"),
        ("accelerometer.txt", once("scale column", 0, 0, 1.03), "(column 0) ends 2.46e+03 s after"),
    ],
    "indoor_location": [
        (".txt", lines(lambda rows: [*rows[:99], rows[99][:-20]]), "is cut short", "in line 100"),
        (".txt", lines(lambda rows: rows + rows), "'startTime' is there 2 times"),
        (".txt", NO_GYRO, "'TYPE_GYROSCOPE' holds 0"),
        (".txt", of_kind("WAYPOINT", *MONTH), "'TYPE_WAYPOINT' has 4 of 4 stamps", "one phone"),
        (".txt", of_kind("GYRO", "\t0.", "\tnan\t0."), "'TYPE_GYROSCOPE' holds NaN"),
    ],
    "csv": [
        ("walk.csv", without("qx"), "column 'qx' is missing while 'qw' is there"),
        ("walk.csv", cell(8, "time", "0.0"), "field 'time'", "does not increase", "row 9"),
        ("walk.csv", cell(9, "qw", "3.0"), "'qw', 'qx', 'qy', 'qz'", "not a unit quater", "row 10"),
        ("walk.csv", scaled("time", 1e3), "field 'time'", "look like ms: divide them by 1000"),
        ("walk.csv", scaled("time", 20.0), "field 'time'", "expected 10 to 2000 Hz"),
        ("walk.csv", once("hole", 0.3, 0.3), ""),
        ("walk.csv", once("cell", 0.5, 0.99, "1e30"), "'accel' is beyond 1000 m/s² in 1 rows"),
        ("test.txt", LONG_NAME, "1 of 2 listed sequences are absent"),
    ],
    "hdf5": [
        (".h5", fields(lambda arrays: arrays.pop("accel")), "field 'accel' is missing"),
        (".h5", fields(lambda x: x.update(velocity=b"fast")), "'velocity' is not an array of num"),
        (".h5", once("type", 0.17, token="bool"), "'device_orientation' is not an array"),
        (".h5", once("scale field", 0.7, token=1e9), "field 'time' runs at"),
    ],
}
GOOD = {
    "oxiod raw": [("vi1.csv", once("cell", 0.0, 0.0, "1e300"))],  # a pose of another time
    "tlio": [("list.txt", once("BOM"))],
    "csv": [
        ("walk.csv", once("BOM")),
        ("walk.csv", once("cell", 0.5, 0.01, "1e30")),  # contradicts the position: not valid
        ("walk.csv", once("cell", 0.5, 0.5, "9" * 400)),  # infinite: not valid
    ],
    "hdf5": [(".h5", once("type", 0.28, token="<f4"))],
    "kitti packets": [(PACKET, cell(0, 25, "nan", " "))],  # nothing that is used
    "tumvi": [("mocap0/data.csv", once("cell", 0.5, 0.2, "1e300"))],  # a pose that is lost
}


def cases_of(table):
    cases = [(layout, *entry) for layout, entries in table.items() for entry in entries]
    return pytest.mark.parametrize("case", cases, ids=lambda case: "-".join(map(str, case[::3])))


def changed(layout, ending, change):
    """(the damage, all of its file's path)."""
    (file,) = (file for file in written(layout) if file.endswith(ending))
    if change is None:
        return Damage(file, "delete"), file
    return Damage(file, "content", token=change(file, written(layout)[file])), file


@cases_of(BAD)
def test_a_bad_file_is_refused_by_file_and_field(case):
    layout, ending, change, *words = case
    damage, file = changed(layout, ending, change)
    result, log = outcome(layout, [damage])
    assert isinstance(result, InputError) or "absent" in words[0], log
    assert (": " in words[0] or f"{file}: " in log) and all(word in log for word in words), log


@cases_of(GOOD)
def test_what_is_harmless_is_read(case):
    damage, _ = changed(*case)
    result, log = check(case[0], [damage])
    assert not isinstance(result, InputError) and len(result) == 1 and log == "", log


# --- what would execute when it is loaded: pickles in NumPy's files, tags of YAML


class Bomb:
    """Whoever unpickles it makes a folder."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def of_numpy(bomb):
    out = io.BytesIO()
    np.save(out, np.array([bomb], dtype=object), allow_pickle=True)
    return out.getvalue()


def of_numpy_zip(bomb):
    """The gyro and accelerometer of an otherwise sound piece."""
    arrays, _ = unpacked(".npz", *written("kitti npz").values())
    return packed(".npz", arrays | {"u": np.array([bomb], dtype=object)}, {})


def of_yaml(bomb):
    return f"T_BS: !!python/object/apply:os.mkdir ['{bomb.folder}']\n".encode()


@pytest.mark.parametrize(
    ("layout", "ending", "make"),
    [
        ("tlio", ".npy", pickle.dumps),
        ("tlio", ".npy", of_numpy),
        ("kitti npz", ".npz", of_numpy_zip),
        ("euroc", "imu0/sensor.yaml", of_yaml),
    ],
)
def test_what_would_execute_is_refused_unexecuted(tmp_path, layout, ending, make):
    (file,) = (file for file in written(layout) if file.endswith(ending))
    content = make(Bomb(tmp_path / "trap"))
    result, log = check(layout, [Damage(file, "content", token=content)])
    assert isinstance(result, InputError) and file in log
    assert not (tmp_path / "trap").exists(), "it was executed"
    if make is not of_yaml:  # were pickles loaded, this would have seen it
        loaded = np.load(io.BytesIO(content), allow_pickle=True)
        _ = loaded["u"] if make is of_numpy_zip else loaded
        assert (tmp_path / "trap").exists()
