"""Every layout that the loaders read, written as the known walk by the tests' own writers, in one
table."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnio_jax.data.hdf5 import write_hdf5
from gnio_jax.types import Sequence
from tests.support import (
    asl_files,
    blackbird_files,
    comma_files,
    csv_writers,
    idol_files,
    indoor_location_files,
    kitti_files,
    known_walk,
    onav_files,
    oxiod_files,
    pedlocdata_files,
    ridi_files,
    ronin_files,
    tlio_files,
    tyrex_files,
)


class Layout(NamedTuple):
    """One layout of one dataset."""

    dataset: str
    split: str
    """Where the recording is."""
    recording: Callable[[Path, float], object]
    """(root, seconds): writes one. TLIO's is of 12 s."""
    lists: dict[str, str] = {}
    """The texts of the lists that name it, by their paths below the root."""
    shortest: float = 7.0
    """s of recording that the loader takes: over much less a turn is left in the mean acceleration,
    which the self-check minds."""
    targets: tuple[str, ...] = ()
    """Files to damage, by their paths below the root; () means all of them."""

    def write(self, root: Path, seconds: float) -> None:
        self.recording(root, seconds)
        for path, text in self.lists.items():
            (root / path).parent.mkdir(parents=True, exist_ok=True)
            (root / path).write_text(text)


DRIVE, FLIGHT = "2011_09_26_drive_0014", "clover/yawForward/maxSpeed5p0/test"
PACKETS = f"{DRIVE[:10]}/{DRIVE}_extract/oxts"
STAMPS, PACKET = f"{PACKETS}/timestamps.txt", f"{PACKETS}/data/0000000{{}}.txt"
TLIO_TABLE, OF_RIDI = "walk/imu0_resampled", {"list_test_publish_v2.txt": "hang_leg1,leg\n"}


def _oxiod(write: Callable[..., None]) -> Layout:
    def recording(root: Path, seconds: float) -> None:
        write(root / "handheld" / "data1", 1, oxiod_files.Truth(), seconds)

    lists = {"handheld/Test.txt": "data1/imu1.csv"}
    return Layout("oxiod", "test", recording, lists, shortest=20.0)


def _tango(root: Path, seconds: float) -> None:
    folder = root / "large scale" / "floor1"
    oxiod_files.write_large_scale(folder, 1, oxiod_files.Truth(), seconds)


def _asl(dataset: str, folder: str, reference: Callable[..., None]) -> Layout:
    def recording(root: Path, seconds: float) -> None:
        mav = root / folder / "mav0"
        asl_files.write_imu(mav, seconds=seconds)
        asl_files.write_yaml(mav / "imu0" / "sensor.yaml", asl_files.Mount())
        reference(mav, first=0.3, last=seconds - 0.2)

    return Layout(dataset, "test", recording)


def _tyrex(split: str, name: str) -> Layout:
    def recording(root: Path, seconds: float) -> None:
        tyrex_files.write(root, name, seconds)

    return Layout("tyrex", split, recording, shortest=20.0)


def _indoor_location(root: Path, seconds: float) -> None:
    taps = np.array([-0.1, 0.4 * seconds, 0.7 * seconds, seconds])
    indoor_location_files.write(root, indoor_location_files.lines(seconds, taps))


def _csv(root: Path, seconds: float) -> None:
    time = np.arange(round(seconds * 100)) / 100
    csv_writers.write_native(root / "walk.csv", time, velocity=True)


def _ridi(root: Path, seconds: float) -> None:
    ridi_files.write_table(root, "hang_leg1", np.arange(int(seconds * 202.3)) / 202.3)


def _hdf5(root: Path, seconds: float) -> None:
    time = np.arange(round(seconds * 200.0)) / 200.0
    attitude = known_walk.attitude(time).as_quat(scalar_first=True)
    position, valid = known_walk.position(time), np.ones(len(time), dtype=bool)
    signals = known_walk.rate(time), known_walk.force(time)
    walk = Sequence("walk", time, *signals, attitude, position, known_walk.velocity(time), valid)
    attributes = {"dataset": "csv", "group": "walk", "start_time": 12.5}
    write_hdf5(root / "walk.h5", walk._replace(device_orientation=attitude, attributes=attributes))


LAYOUTS = {
    "tlio": Layout(
        "tlio",
        "test",
        lambda root, _: tlio_files.write_sequence(root / "walk"),
        {"test_list.txt": "walk\n"},
        shortest=12.0,
        targets=(f"{TLIO_TABLE}.npy", f"{TLIO_TABLE}_description.json", "test_list.txt"),
    ),
    "oxiod raw": _oxiod(oxiod_files.write_raw),
    "oxiod syn": _oxiod(oxiod_files.write_syn),
    "oxiod Nexus": _oxiod(oxiod_files.write_nexus_raw),
    "oxiod Tango": Layout("oxiod", "large_scale", _tango, shortest=30.0),
    "ronin": Layout(
        "ronin",
        "train",
        lambda root, seconds: ronin_files.write(root / "a011_2", seconds, start_frame=100),
        {"lists/list_train.txt": "a011_2"},
    ),
    "ridi table": Layout("ridi", "test", _ridi, OF_RIDI),
    "ridi text": Layout(
        "ridi",
        "test",
        lambda root, seconds: ridi_files.write_text(root, "hang_leg1", seconds=seconds),
        OF_RIDI,
    ),
    "idol": Layout(
        "idol",
        "known",
        lambda root, seconds: idol_files.write(root, idol_files.frame(seconds)),
        shortest=12.0,
    ),
    "euroc": _asl("euroc", "MH_04_difficult", asl_files.write_estimate),
    "tumvi": _asl("tumvi", "dataset-room4_512_16", asl_files.write_mocap),
    "kitti packets": Layout(
        "kitti",
        "train",
        lambda root, seconds: kitti_files.write_drive(root, DRIVE, seconds),
        shortest=4.0,
        targets=(STAMPS, PACKET.format("000"), PACKET.format("200")),
    ),
    "kitti npz": Layout(
        "kitti",
        "train",
        lambda root, s: kitti_files.write_piece(root / f"train__{DRIVE}_extract0.npz", seconds=s),
    ),
    "blackbird": Layout(
        "blackbird",
        "test",
        lambda root, seconds: blackbird_files.write(root / FLIGHT, seconds=seconds),
        {"test.txt": f"# flights\n{FLIGHT}\n"},
    ),
    "comma2k19": Layout("comma2k19", "train", comma_files.write),
    "onavdata": Layout("onavdata", "test", onav_files.write),
    "pedlocdata": Layout(
        "pedlocdata",
        "train",
        lambda root, seconds: pedlocdata_files.write(root, seconds=seconds),
    ),
    "tyrex Nexus": _tyrex("val", tyrex_files.NEXUS),
    "tyrex iPhone": _tyrex("train", tyrex_files.IPHONE),
    "indoor_location": Layout("indoor_location", "test", _indoor_location),
    "csv": Layout("csv", "test", _csv, {"test.txt": "walk\n"}),
    "hdf5": Layout("csv", "test", _hdf5),
}
