"""Every layout that the loaders read, written as the known walk by the tests' own writers, in one
table."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.types import Sequence
from tests.support import (
    asl_files,
    blackbird_files,
    csv_writers,
    idol_files,
    indoor_location_files,
    kitti_files,
    known_walk,
    oxiod_files,
    ridi_files,
    ronin_files,
    tyrex_files,
)


class Layout(NamedTuple):
    """One layout of one dataset."""

    dataset: str
    split: str
    """Where `write` puts its recording."""
    write: Callable[[Path, float], None]
    """(root, seconds): one recording, with its lists."""
    shortest: float = 7.0
    """s of recording that the loader takes: over much less a turn is left in the mean acceleration,
    which the self-check minds."""
    targets: tuple[str, ...] = ()
    """Files to damage, by their paths below the root; () means all of them."""


@contextmanager
def lasting(seconds: float) -> Iterator[None]:
    """Some writers write as much as the known walk is long."""
    before, known_walk.SECONDS = known_walk.SECONDS, seconds
    try:
        yield
    finally:
        known_walk.SECONDS = before


def _tlio(root: Path, seconds: float) -> None:
    time = 1.0 + np.arange(round(seconds * 200)) / 200
    attitude = known_walk.attitude(time)
    names = {
        "ts_us(1)": np.round(time * 1e6)[:, None],
        "gyr_compensated_rotated_in_World(3)": attitude.apply(known_walk.rate(time)),
        "acc_compensated_rotated_in_World(3)": attitude.apply(known_walk.force(time)),
        "qxyzw_World_Device(4)": attitude.as_quat(),
        "pos_World_Device(3)": known_walk.position(time),
        "vel_World(3)": known_walk.velocity(time),
    }
    folder = root / "walk"
    folder.mkdir(parents=True)
    np.save(folder / "imu0_resampled.npy", np.concatenate(list(names.values()), axis=1))
    (folder / "imu0_resampled_description.json").write_text(
        json.dumps({"columns_name(width)": list(names), "t_start_us": 1e6})
    )
    (root / "test_list.txt").write_text("walk\n")


def _oxiod(write: Callable[..., None]) -> Callable[[Path, float], None]:
    def write_walk(root: Path, seconds: float) -> None:
        write(root / "handheld" / "data1", 1, oxiod_files.Truth(), seconds=seconds)
        (root / "handheld" / "Test.txt").write_text("data1/imu1.csv")

    return write_walk


def _oxiod_large_scale(root: Path, seconds: float) -> None:
    oxiod_files.write_large_scale(
        root / "large scale" / "floor1", 1, oxiod_files.Truth(), seconds=seconds
    )


def _ronin(root: Path, seconds: float) -> None:
    ronin_files.write(root / "a011_2", seconds=seconds, start_frame=100)
    (root / "lists").mkdir()
    (root / "lists" / "list_train.txt").write_text("a011_2")


def _ridi_table(root: Path, seconds: float) -> None:
    ridi_files.write_table(root, "hang_leg1", time=np.arange(int(seconds * 202.3)) / 202.3)
    (root / "list_test_publish_v2.txt").write_text("hang_leg1,leg\n")


def _ridi_text(root: Path, seconds: float) -> None:
    with lasting(seconds):
        ridi_files.write_text(root, "hang_leg1")
    (root / "list_test_publish_v2.txt").write_text("hang_leg1,leg\n")


def _idol(root: Path, seconds: float) -> None:
    idol_files.write(root, idol_files.frame(seconds))


def _asl(folder: str, mocap: bool) -> Callable[[Path, float], None]:
    def write(root: Path, seconds: float) -> None:
        mav = root / folder / "mav0"
        asl_files.write_imu(mav, seconds=seconds)
        asl_files.write_yaml(mav / "imu0" / "sensor.yaml", asl_files.Mount())
        reference = asl_files.write_mocap if mocap else asl_files.write_estimate
        reference(mav, first=0.3, last=seconds - 0.2)

    return write


_DRIVE = "2011_09_26_drive_0014"
_PACKETS = f"{_DRIVE[:10]}/{_DRIVE}_extract/oxts"


def _kitti_packets(root: Path, seconds: float) -> None:
    kitti_files.write_drive(root, _DRIVE, seconds=seconds)


def _kitti_npz(root: Path, seconds: float) -> None:
    kitti_files.write_piece(root / f"train__{_DRIVE}_extract0.npz", seconds=seconds)


def _blackbird(root: Path, seconds: float) -> None:
    blackbird_files.write(root / "clover/yawForward/maxSpeed5p0/test", seconds=seconds)
    (root / "test.txt").write_text("# flights\nclover/yawForward/maxSpeed5p0/test\n")


def _tyrex(name: str) -> Callable[[Path, float], None]:
    def write(root: Path, seconds: float) -> None:
        tyrex_files.write(root, name, seconds)

    return write


def _indoor_location(root: Path, seconds: float) -> None:
    taps = np.array([-0.1, 0.4 * seconds, 0.7 * seconds, seconds])
    indoor_location_files.write(root, indoor_location_files.lines(seconds, taps))


def _csv(root: Path, seconds: float) -> None:
    csv_writers.write_native(
        root / "walk.csv", np.arange(round(seconds * 100)) / 100, velocity=True
    )
    (root / "test.txt").write_text("walk\n")


def known_sequence(seconds: float, rate: float = 200.0) -> Sequence:
    """The known walk as the package's own value."""
    time = np.arange(round(seconds * rate)) / rate
    attitude = np.roll(known_walk.attitude(time).as_quat(), 1, axis=1)
    return Sequence(
        name="walk",
        time=time,
        gyro=known_walk.rate(time),
        accel=known_walk.force(time),
        orientation=attitude,
        position=known_walk.position(time),
        velocity=known_walk.velocity(time),
        valid=np.ones(len(time), dtype=bool),
        device_orientation=attitude,
        attributes={"dataset": "csv", "group": "walk", "start_time": 12.5},
    )


def _hdf5(root: Path, seconds: float) -> None:
    write_hdf5(root / "walk.h5", known_sequence(seconds))


LAYOUTS = {
    "tlio": Layout("tlio", "test", _tlio),
    "oxiod raw": Layout("oxiod", "test", _oxiod(oxiod_files.write_raw), shortest=20.0),
    "oxiod syn": Layout("oxiod", "test", _oxiod(oxiod_files.write_syn), shortest=20.0),
    "oxiod Nexus": Layout("oxiod", "test", _oxiod(oxiod_files.write_nexus_raw), shortest=20.0),
    "oxiod Tango": Layout("oxiod", "large_scale", _oxiod_large_scale, shortest=30.0),
    "ronin": Layout("ronin", "train", _ronin),
    "ridi table": Layout("ridi", "test", _ridi_table),
    "ridi text": Layout("ridi", "test", _ridi_text),
    "idol": Layout("idol", "known", _idol, shortest=12.0),
    "euroc": Layout("euroc", "test", _asl("MH_04_difficult", mocap=False)),
    "tumvi": Layout("tumvi", "test", _asl("dataset-room4_512_16", mocap=True)),
    "kitti packets": Layout(
        "kitti",
        "train",
        _kitti_packets,
        targets=(
            f"{_PACKETS}/timestamps.txt",
            f"{_PACKETS}/data/0000000000.txt",
            f"{_PACKETS}/data/0000000200.txt",
        ),
    ),
    "kitti npz": Layout("kitti", "train", _kitti_npz),
    "blackbird": Layout("blackbird", "test", _blackbird),
    "tyrex Nexus": Layout("tyrex", "val", _tyrex(tyrex_files.NEXUS), shortest=20.0),
    "tyrex iPhone": Layout("tyrex", "train", _tyrex(tyrex_files.IPHONE), shortest=20.0),
    "indoor_location": Layout("indoor_location", "test", _indoor_location),
    "csv": Layout("csv", "test", _csv),
    "hdf5": Layout("csv", "test", _hdf5),
}
