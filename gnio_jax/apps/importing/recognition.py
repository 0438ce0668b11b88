"""Which format a recording has, by what it holds: names of files lie."""

from __future__ import annotations

import zipfile
from pathlib import Path

from gnio_jax.apps.importing import archives
from gnio_jax.apps.importing.phyphox import is_phyphox
from gnio_jax.apps.importing.recording import table_layout
from gnio_jax.apps.importing.sensor_logger import is_sensor_logger
from gnio_jax.data.parsing.tables import parsed_as
from gnio_jax.errors import InputError

FORMATS = ("csv", "sensor_logger", "phyphox", "rosbag1", "rosbag2", "mcap", "euroc")

_MAGIC = {
    b"#ROSBAG V2.0": "rosbag1",  # wiki.ros.org/Bags/Format/2.0
    b"SQLite format 3\x00": "rosbag2",  # sqlite.org/fileformat.html
    b"\x89MCAP0\r\n": "mcap",  # mcap.dev/spec
    b"\xd0\xcf\x11\xe0": "phyphox",  # an OLE file: .xls
    b"\x89HDF\r\n\x1a\n": "hdf5",
    b"PK": "zip",
}
_KNOWN = (
    "known: CSV, Sensor Logger, phyphox, ROS bags, MCAP and EuRoC folders; "
    "a CSV of other columns needs --columns"
)


def recognise(path: Path) -> str:
    """The format of a file or folder, one of `FORMATS`.

    Text that is neither logger's is "csv", whose columns the user may name. Raises `InputError` for
    a path that is not there or holds nothing that is known.
    """
    if path.is_dir():
        return _of_folder(path)
    head = _head(path)
    found = next((name for magic, name in _MAGIC.items() if head.startswith(magic)), None)
    if found == "zip":
        return _of_zip(path)
    if found == "hdf5":
        raise InputError(
            path, "is HDF5 already", "check it with gnio data check FOLDER --dataset csv"
        )
    if found is not None:
        return found
    labels = table_layout(path).labels
    return "phyphox" if is_phyphox([labels]) else "csv"


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(16)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from None


def _of_folder(path: Path) -> str:
    if any((folder / "imu0" / "data.csv").is_file() for folder in (path, path / "mav0")):
        return "euroc"
    if (path / "metadata.yaml").is_file():
        return "rosbag2"
    return _of_tables(path)


def _of_zip(path: Path) -> str:
    with parsed_as(path, "a zip"), zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    # The parts of a workbook: ECMA-376, part 2.
    return "phyphox" if "xl/workbook.xml" in names else _of_tables(path)


def _of_tables(path: Path) -> str:
    """The logger that wrote the CSV files of a zip or folder."""
    names = [name for group in archives.csv_names(path).values() for name in group]
    labels = [archives.labels(path, name) for name in names]
    if is_sensor_logger(labels):
        return "sensor_logger"
    if is_phyphox(labels):
        return "phyphox"
    found = ", ".join(names[:8]) or "no CSV file"
    raise InputError(path, f"has the layout of no known recording (found: {found})", _KNOWN)
