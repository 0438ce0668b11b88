"""Damaged files of every layout end in a plausible sequence or in one line that names the file,
never in anything else.

A short recording is written once per layout; each example copies it and does to one or two of its
files what copying, editing, converting or an attacker may do to them.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gnio_jax.errors import InputError
from tests.support.damage import Damage, damages
from tests.support.damage_values import YAMLS
from tests.support.damaged_recordings import check, remove_copies, written
from tests.support.layouts import LAYOUTS
from tests.support.tyrex_files import IPHONE


@pytest.fixture(scope="module", autouse=True)
def _copies_are_removed() -> Iterator[None]:
    yield
    remove_copies()


FEW = 6
"""Examples of every layout among the quick tests."""
EXAMPLES = {
    "oxiod raw": 12,
    "oxiod syn": 12,
    "oxiod Nexus": 12,
    "oxiod Tango": 8,
    "idol": 40,
    "euroc": 40,
    "tumvi": 40,
    "kitti packets": 40,
    "tyrex Nexus": 24,
    "tyrex iPhone": 24,
}
"""Among the slow tests, of the slower layouts; 60 of the others."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_an_undamaged_recording_is_read(name):
    result, said = check(name, [])
    assert not isinstance(result, InputError), said
    (sequence,) = result
    assert (sequence.valid.mean() > 0.9 or sequence.waypoints is not None) and said == ""


@pytest.mark.parametrize("few", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", LAYOUTS)
def test_a_damaged_recording_is_plausible_or_refused_by_name(name, few):
    layout = LAYOUTS[name]
    files = list(layout.targets or written(name))
    one = damages(files)

    @settings(
        max_examples=FEW if few else EXAMPLES.get(name, 60),
        derandomize=True,
        database=None,
        deadline=None,  # `check` has one of its own
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(one, min_size=1, max_size=2))
    def run(happened: list[Damage]) -> None:
        check(name, happened)

    run()


# What was wrong once. Each is (layout, damages, what must be said; None: it must be read, and
# plausible).
_EURO = "MH_04_difficult/mav0/imu0"
_MARKER = "dataset-room4_512_16/mav0/mocap0/data.csv"
_OXTS = LAYOUTS["kitti packets"].targets
_FLIGHT = "clover/yawForward/maxSpeed5p0/test/stamped_groundtruth_imu.txt"
ONCE_WRONG = {
    "stamps of another phone": (
        "tyrex iPhone",
        [Damage(f"datasets/ios/{IPHONE}/accelerometer.txt", "scale column", 0.0, 0.0, 1.03)],
        "accelerometer.txt: field 'time' (column 0) ends 2.46e+03 s after the record's start",
    ),
    "gyro that begins before the world": (
        "ridi text",
        [Damage("hang_leg1/gyro.txt", "cell", 0.5, 0.0, "-1e30")],
        "gyro.txt: field 'time' goes over",
    ),
    "gyro of another unit": (
        "ridi text",
        [Damage("hang_leg1/gyro.txt", "scale column", 0.0, 0.0, 1e9)],
        "gyro.txt: field 'time' goes over",
    ),
    "nested JSON, tlio": (
        "tlio",
        [Damage("walk/imu0_resampled_description.json", "deep")],
        "imu0_resampled_description.json: is no JSON",
    ),
    "nested JSON, ronin": ("ronin", [Damage("a011_2/info.json", "deep")], "info.json: is no JSON"),
    "nested JSON, idol": (
        "idol",
        [Damage("building1/known/metadata.json", "deep")],
        "metadata.json: is no JSON",
    ),
    "nested YAML": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "deep")],
        "sensor.yaml: cannot be read as YAML",
    ),
    "YAML of no date": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "content", token=YAMLS[0])],
        "sensor.yaml: cannot be read as YAML",
    ),
    "YAML of billions": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "content", token=YAMLS[-1])],
        "sensor.yaml: field 'T_BS' is no pose",
    ),
    "lever of a galaxy": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "content", token=YAMLS[12])],
        "sensor.yaml: field 'T_BS' is no pose",
    ),
    "long name, tlio": (
        "tlio",
        [Damage("test_list.txt", "stray line", 1.0, token="x" * 5000)],
        "test_list.txt: 1 of 2 listed sequences are absent",
    ),
    "long name, csv": (
        "csv",
        [Damage("test.txt", "stray line", 1.0, token="x" * 5000)],
        "test.txt: 1 of 2 listed sequences are absent",
    ),
    "long entry, oxiod": (
        "oxiod raw",
        [Damage("handheld/Test.txt", "deep")],
        "Test.txt: entry '[[[",
    ),
    "marked list": ("tlio", [Damage("test_list.txt", "BOM")], None),
    "marked table": ("csv", [Damage("walk.csv", "BOM")], None),
    "hole in a table": ("csv", [Damage("walk.csv", "hole", 0.3, 0.3)], "walk.csv: "),
    "stamp of no time": (
        "kitti packets",
        [Damage(_OXTS[0], "stray line", 0.5, token="now")],
        "timestamps.txt: line 351 ('now') is no stamp",
    ),
    "hole in stamps": (
        "kitti packets",
        [Damage(_OXTS[0], "hole", 0.001, 0.12)],
        "timestamps.txt: line 1 ('2011-09-26",
    ),
    "integer without end": (
        "ronin",
        [Damage("a011_2/info.json", "json value", 0.99, token=10**400)],
        "info.json: field 'ekf_ori_error' is no number",
    ),
    "vector without end": (
        "ronin",
        [Damage("a011_2/info.json", "json value", 0.15, token=10**400)],
        "info.json: field 'imu_init_gyro_bias'",
    ),
    "text for numbers": (
        "ronin",
        [Damage("a011_2/data.hdf5", "type", 0.35, token="S8")],
        "data.hdf5: field 'synced/game_rv' holds",
    ),
    "gyro beyond range": (
        "ronin",
        [Damage("a011_2/data.hdf5", "value", 0.6, 0.73, 1e9)],
        "data.hdf5: field 'gyro' is beyond 100 rad/s in 1 rows",
    ),
    "accel beyond range": (
        "csv",
        [Damage("walk.csv", "cell", 0.5, 0.99, "1e30")],
        "walk.csv: field 'accel' is beyond 1000 m/s² in 1 rows",
    ),
    "velocity beyond all": (
        "csv",
        [Damage("walk.csv", "cell", 0.5, 0.01, "1e30")],
        None,
    ),  # it contradicts the position, hence not valid
    "position that jumps": ("csv", [Damage("walk.csv", "cell", 0.5, 0.5, "1e6")], None),
    "position far away": (
        "csv",
        [Damage("walk.csv", "column", 0.5, 0.5, "1e30")],
        "walk.csv: field 'position' is beyond",
    ),
    "marker at no place": (
        "tumvi",
        [Damage(_MARKER, "cell", 0.5, 0.2, "1e300")],
        None,
    ),  # left out as a pose that the tracker lost
    "marker of no place": (
        "tumvi",
        [Damage(_MARKER, "column", 0.5, 0.2, "1e300")],
        "mocap0/data.csv: field 'position' is beyond",
    ),
    "velocity of a flight": (
        "blackbird",
        [Damage(_FLIGHT, "column", 0.5, 0.9, "1e30")],
        "stamped_groundtruth_imu.txt: field 'velocity'",
    ),
    "position of a car": (
        "kitti packets",
        [Damage(_OXTS[2], "cell", 0.0, 0.0, "1e300")],
        "0000000200.txt: field 'lat' is 1e+300",
    ),
    "NaN of a car": (
        "kitti packets",
        [Damage(_OXTS[2], "cell", 0.0, 0.4, "NaN")],
        "0000000200.txt: field 'ay' is nan",
    ),
    "device of booleans": (
        "hdf5",
        [Damage("walk.h5", "type", 0.17, token="bool")],
        "walk.h5: field 'device_orientation' is not an array of numbers",
    ),
    "single precision": ("hdf5", [Damage("walk.h5", "type", 0.28, token="<f4")], None),
    "hours as seconds": (
        "hdf5",
        [Damage("walk.h5", "scale field", 0.7, token=1e9)],
        "walk.h5: field 'time' is not in seconds",
    ),
    "stamps of no clock": (
        "ridi text",
        [Damage("hang_leg1/acce.txt", "scale column", 0.0, 0.0, 1e-9)],
        "acce.txt: field 'time' gives",
    ),
    "attitudes of no clock": (
        "ridi text",
        [Damage("hang_leg1/orientation.txt", "scale column", 0.0, 0.0, 1e-9)],
        "orientation.txt: field 'time' gives",
    ),
    "poses of no clock": (
        "ridi text",
        [Damage("hang_leg1/pose.txt", "scale column", 0.0, 0.0, 1e-9)],
        "pose.txt: field 'time' (-",
    ),
    "position without end": (
        "csv",
        [Damage("walk.csv", "cell", 0.5, 0.5, "9" * 400)],
        None,
    ),  # infinite, hence not valid
    "row without end": (
        "euroc",
        [Damage(f"{_EURO}/data.csv", "stray line", 0.5, 0.5, "9" * 400)],
        f"{_EURO}/data.csv: ",
    ),
    "cell without end, oxiod": (
        "oxiod Tango",
        [Damage("large scale/floor1/syn/imu1.csv", "cell", 0.5, 0.5, "9" * 400)],
        "imu1.csv: ",
    ),
    "another recording": (
        "ridi text",
        [Damage("hang_leg1/acce.txt", "scale column", 0.0, 0.0, 0.5)],
        "acce.txt: field 'time'",
    ),
}


@pytest.mark.parametrize("once", ONCE_WRONG)
def test_what_was_wrong_once(once):
    name, happened, expected = ONCE_WRONG[once]
    result, said = check(name, happened)
    if expected is None:
        assert not isinstance(result, InputError) and len(result) == 1 and said == "", said
    else:
        assert expected in said, said
