"""What loggers call the columns of an IMU, and the units in their names.

Known names are those of Arduino and ESP32 sketches, rostopic, bagpy, EuRoC, AndroSensor, Physics
Toolbox, SensorLog, GetSensorData, GnssLogger, MARS logger, RoNIN's recorder, Shimmer, Xsens and
ArduPilot, as seen in their files; only what fits once is taken.
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Container, Iterable, Mapping
from itertools import chain

GYRO = ("gyro_x", "gyro_y", "gyro_z")
ACCEL = ("accel_x", "accel_y", "accel_z")
AXES = {"gyro": GYRO, "accel": ACCEL}
REFERENCE = {
    "orientation": ("qw", "qx", "qy", "qz"),
    "position": ("px", "py", "pz"),
    "velocity": ("vx", "vy", "vz"),
}
POSES = tuple(chain.from_iterable(REFERENCE.values()))
NAMES = ("time", "accel_time", *GYRO, *ACCEL, *POSES)
"""Our names."""

_SPELLINGS = {
    "rad/s": "rad/s rads-1 rad/sec radian/s radians/s radps rps rads radpersec",
    "deg/s": "deg/s degs-1 deg/sec degree/s degrees/s °/s º/s dps degs degpersec",
    "mdps": "mdps mdeg/s millidps",
    "mrad/s": "mrad/s",
    "m/s2": "m/s2 m/s/s ms-2 ms2 mps2 m/sec2 m/(s2) m/(sec2)",
    "cm/s2": "cm/s2 cms2",
    "mm/s2": "mm/s2 mms2",
    "g": "g gs g's",
    "mg": "mg milli-g millig",
    "s": "s sec secs second seconds",
    "ms": "ms msec msecs millis millisec milliseconds msecond",
    "us": "us µs μs usec usecs micros microsec microseconds",
    "ns": "ns nsec nsecs nanosecs nanos nanosec nanoseconds",
}
"""Our names of units, and their names in headers as `unit_of` compares them."""
CLOCK_UNITS = ("s", "ms", "us", "ns")
"""Those of stamps."""
_NAMED = {name: unit for unit, names in _SPELLINGS.items() for name in names.split()}
_BRACKETS = re.compile(r"\s*[(\[]([^\[\]]*)[)\]]\s*$")
_TAIL = re.compile(
    r"(?<=[xyz])[_ .]?((rad|deg)[/_]?(s|sec|per_?sec)|[cm]?m[/_]?(s|sec)\^?2|m?dps|mps2|m?g)$",
    re.IGNORECASE,
)
"""A unit after the axis, as in gyro_x_dps."""
_AXIS = r"_?{axis}(_?(axis|cal|value|uncal|data))?"
_ALIASES = {
    "gyro": (
        r"(gyro|gyr|gyroscope)_?{axis}",
        r"(.*_)?(gyro|gyr|gyroscope)(_.*)?" + _AXIS,
        r"(w|g|omega|rot|w_rs_s)_?{axis}",
        r"(.*_)?(angular_velocity|angular_rate|ang_?vel|rotation_?rate)" + _AXIS,
        r"{axis}_?(gyro|gyr|gyroscope)",
    ),
    "accel": (
        r"(accel|acc|acce|accelerometer|acceleration)_?{axis}",
        r"(.*_)?accelerometer(_.*)?" + _AXIS,
        r"(g_?f(orce)?|a_rs_s|specific_force|total_acceleration)_?{axis}",
        r"[af]_?{axis}",
        r"(.*_)?linear_acceleration_{axis}",  # with gravity, as ROS means it
        r"(?!.*(user|linear|gravity|bias|offset))(.*_)?(accel|acc|acce|acceleration)(_.*)?" + _AXIS,
        r"{axis}_?(accel|acc|accelerometer)",
    ),
}
"""Names of the columns of a sensor, as `plain_name` writes them, the surest first."""
_ALONE = (r"(measurement|value|raw|data)?" + _AXIS, r"(v|val|value|values|data)_?{number}")
"""Names of the axes in a table of one sensor, the second ones numbered from 0 or from 1."""
_IN_UNITS = {
    "gyro": (("rad/s", "deg/s", "mdps", "mrad/s"), r"(?!.*(bias|offset))(.*_)?{axis}"),
    "accel": (
        ("m/s2", "g", "mg", "cm/s2", "mm/s2"),
        r"(?!.*(user|lin|grav|mag|field|bias|offset))(.*_)?{axis}",
    ),
}
"""Units by which the axes of a sensor are known, whatever its name is, and the names that they may
have."""
_SECOND = r"(s|sec|secs|seconds|ms|msec|millis|us|usec|micros|ns|nsec|nanos|unix)"
_TIMES = (
    r"(field_)?header_stamp",
    r"sensor_?time(_?stamp)?|elapsed_realtime_nanos|sample_time_fine",
    r"time|time_?stamp|stamp|t",
    r"(unix|epoch|utc|sys|system|host|device|log|logging|local)?_?(time|time_?stamp|stamp|t|epoch)"
    rf"(_?{_SECOND}|_txt)?",
    r"seconds_elapsed|elapsed(_time)?(_?s|_?ms)?|millis|micros|nanos|date_?time|ms|us|epoc",
    r"(?!.*(gps|frame|zone)).*time.*",
)
_NO_CLOCK = r".*(dt|delta|interval|period|duration|delay|latency|exposure).*"
"""Names of times that are no stamps."""
_NO_TIME = re.compile(r"[(\[]?(°|º|deg|m)? ?([cfkv]|celsius|kelvin|volts?)[)\]]?", re.IGNORECASE)
"""Units of what is called t and is no time: a temperature, a voltage."""
_TAGS = {"gyro": r".*(gyr|rotation_?rate)", "accel": r"(?!.*(lin|user|gravity)).*acc(?!u)"}
"""Names of files, or tags of rows, of one sensor."""
# --- units


def unit_text(label: str) -> str | None:
    """The text in round or square brackets at the end of a column's header, or a known unit after
    the axis; None if there is none."""
    match = _BRACKETS.search(label) or _TAIL.search(label)
    return match[1].strip() if match else None


def clock_unit(label: str) -> str | None:
    """The unit of a clock that its name states, as timestamp_ms and SampleTimeFine do (Xsens, 0.1
    ms); None if it states none."""
    name = plain_name(label)
    return "1e-4" if name == "sample_time_fine" else unit_of(name.rpartition("_")[2])


def unit_of(text: str | None) -> str | None:
    """Our name of a unit, such as "rad/s" for "rad s^-1"; None if it is no known unit."""
    text = (text or "").strip().translate(str.maketrans("²⁻¹", "2-1"))
    text = re.sub(r"^[(\[](.*)[)\]]$", r"\1", text)
    return _NAMED.get(re.sub(r"[\s*·^_]", "", text).lower())


def are_units(cells: Iterable[str]) -> bool:
    """Whether a line of a header names units: two of its cells do."""
    return sum(unit_of(cell) is not None for cell in cells) > 1


# --- names


def plain_name(label: str) -> str:
    """The name of a column without unit, in small letters, with words joined by _."""
    name = _TAIL.sub("", _BRACKETS.sub("", label))
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name.replace("ω", "omega"))
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def sensor_named(name: str) -> str | None:
    """gyro or accel, if the name of a file or a tag of rows means one of them."""
    sensors = [sensor for sensor, pattern in _TAGS.items() if re.match(pattern, plain_name(name))]
    return sensors[0] if len(sensors) == 1 else None


def resolve_labels(
    labels: Iterable[str],
    alone: str | None = None,
    units: Mapping[str, str | None] | None = None,
    clocks: Container[str] | None = None,
) -> dict[str, str]:
    """Our name → label of the columns whose names are known, or whose `units` (label → text; None:
    those in the labels) only one sensor or the time has. `alone` is the sensor of a table of one.
    `clocks` are the columns whose values may be stamps, if no name says which are (None: all)."""
    plain = {str(label): plain_name(str(label)) for label in labels}
    texts = {label: unit_text(label) for label in plain} | dict(units or {})

    def fitting(pattern: str, units: Container[str | None] | None = None) -> list[str]:
        names = [label for label, name in plain.items() if re.fullmatch(pattern, name)]
        return [n for n in names if units is None or unit_of(texts[n]) in units]

    names: dict[str, str] = {name: name for name in NAMES if name in plain}
    first = 0 if fitting(_ALONE[1].format(number=0)) else 1
    for sensor, axes in AXES.items():
        if alone not in (None, sensor) or set(axes) <= set(names):
            continue
        patterns = [(p, None) for p in (*_ALIASES[sensor], *(_ALONE if alone == sensor else ()))]
        known_units, pattern_of_axes = _IN_UNITS[sensor]
        for pattern, units_of_axes in (*patterns, (pattern_of_axes, known_units)):
            columns = [
                fitting(pattern.format(axis=axis, number=number), units_of_axes)
                for number, axis in enumerate("xyz", first)
            ]
            if all(len(column) == 1 for column in columns):
                names |= {axis: column[0] for axis, column in zip(axes, columns, strict=True)}
            if any(columns):
                break
    if "time" not in names or fitting(_TIMES[0]):
        pairs = [
            f"{label}+{fraction}"
            for label in fitting(r"(.*_)?secs?")
            for fraction in fitting(r"(.*_)?(nsecs?|nanosecs?|nanoseconds|usecs?)")
            if plain[label].rpartition("_")[0] == plain[fraction].rpartition("_")[0]
        ]
        timed = (
            [label for label in fitting(pattern) if not _NO_TIME.fullmatch(texts[label] or "")]
            for pattern in _TIMES
        )
        stamps = next((columns for columns in timed if columns), [])
        if len(stamps) > 1:
            stamps = [label for label in stamps if unit_of(texts[label]) in CLOCK_UNITS] or stamps
        others = fitting("ticks?") or fitting(rf"(?!{_NO_CLOCK}).*", CLOCK_UNITS)
        stamps = stamps or [label for label in others if clocks is None or label in clocks]
        stamps = pairs if pairs and not fitting(_TIMES[0]) else stamps
        names |= {"time": stamps[0]} if len(stamps) == 1 else {}
    return names


def guess_label(name: str, labels: Iterable[str]) -> str:
    """The label of a column that may be ours, in the shell's quotes if it needs them, or
    "COLUMN"."""
    sensor, _, axis = name.partition("_")
    patterns = [pattern.format(axis=axis) for pattern in _ALIASES.get(sensor, ())]
    patterns = list(_TIMES) if name.endswith("time") else patterns
    fitting = (x for x in labels for p in patterns if re.fullmatch(p, plain_name(x)))
    return shlex.quote(next(fitting, "COLUMN"))
