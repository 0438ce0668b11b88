"""PedLocData: a known walk must come back, whole recordings are held out, and wrong slices are
named."""

import h5py
import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import pedlocdata
from gnio_jax.errors import InputError
from tests.support import known_walk
from tests.support import pedlocdata_files as files

NUMBERS = [f"lab{person:02d}_{piece:03d}" for person in range(40) for piece in range(3)]


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6, 1e-9])
def test_a_walk_comes_back(tmp_path, unit):
    path = files.write(tmp_path, unit=unit)
    (walk,) = pedlocdata.read(path, files.SLICE)
    assert walk.name == "train_lab07_003" and data.self_check(walk).failures == ()
    assert walk.attributes["recorded_rate"] == files.RATE
    assert walk.attributes["start_time"] == pytest.approx(files.START)
    known_walk.compare(walk, walk.time, speed=2e-2)


def test_all_slices_of_a_recording_are_in_one_split(tmp_path):
    """The authors' groups are ignored, because slices of one recording are in several."""
    groups = ("train", "valid", "test")
    names = [f"{groups[number % 3]}/{name}" for number, name in enumerate(NUMBERS)]
    files.write(tmp_path / "a", names, seconds=2.0)
    splits = {split: pedlocdata.recordings(tmp_path, split) for split in pedlocdata.DATASET.splits}
    people = {
        split: {source.attributes["group"] for source in sources}
        for split, sources in splits.items()
    }
    assert sum(map(len, splits.values())) == len(NUMBERS)
    assert sum(map(len, people.values())) == 40  # nobody is in two splits
    assert all(people.values()) and len(people["train"]) > 20
    assert "lab07" in people["train"] | people["val"] | people["test"]


@pytest.mark.parametrize(
    "name, recording",
    [("lab07_003", "lab07"), ("s-12", "s"), ("walk 4", "walk"), ("12", "12"), ("hall", "hall")],
)
def test_a_slice_belongs_to_what_its_name_begins_with(name, recording):
    assert pedlocdata.recording_of(name) == recording


def test_a_slice_whose_name_is_not_utf8_is_listed(tmp_path):
    with h5py.File(tmp_path / "pedloc.h5", "w") as file:
        file.create_group("train").create_group(b"caf\xe9_3")
    (source,) = pedlocdata.find_slices(tmp_path / "pedloc.h5")
    assert source.attributes["group"] == r"caf\xe9"
    with pytest.raises(InputError, match="is missing"):
        source.read()


def turn_the_reference(fields):
    fields["qua"] = fields["qua"][:, [0, 2, 1, 3]]


def test_a_slice_that_contradicts_its_gyro_is_left_out(tmp_path):
    split = pedlocdata.split_of("lab07")
    files.write(tmp_path / "good")
    assert len(data.load("pedlocdata", tmp_path, split)) == 1
    files.write(tmp_path / "good", change=turn_the_reference)
    with (
        pytest.warns(UserWarning, match="train_lab07_003: .*gyro"),
        pytest.raises(InputError, match="none of 1 sequences passes the physical self-check"),
    ):
        data.load("pedlocdata", tmp_path, split)


def in_g(fields):
    fields["acc"] /= 9.81


def without_norm(fields):
    fields["qua"] *= 2.0


def in_no_unit(fields):
    fields["ts"] = files.START + (fields["ts"] - files.START) * 30.0


DAMAGED = [
    (in_g, "'train/lab07_003/acc' has a median length of 1"),
    (without_norm, "'train/lab07_003/qua' is not a unit quaternion"),
    (in_no_unit, "'train/lab07_003/ts' runs at 3.333 samples per unit"),
    (lambda fields: fields.pop("pos"), "'train/lab07_003/pos' is missing"),
    (lambda fields: fields.update(gyr=fields["gyr"][:-1]), "gyr' has shape"),
]


@pytest.mark.parametrize("change, words", DAMAGED)
def test_damaged_slices_are_refused(tmp_path, change, words):
    path = files.write(tmp_path, change=change)
    with pytest.raises(InputError, match=words):
        pedlocdata.read(path, files.SLICE)


def test_a_file_without_slices_has_none_and_a_foreign_one_is_named(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["walks"] = np.zeros(3)
    assert pedlocdata.recordings(tmp_path, "train") == []
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["train"] = np.zeros(3)
    with pytest.raises(InputError, match=r"other\.h5: 'train' is no group of slices"):
        pedlocdata.recordings(tmp_path, "train")
    (tmp_path / "other.h5").unlink()
    (tmp_path / "text.hdf5").write_text("no file of this kind")
    with pytest.raises(InputError, match=r"text\.hdf5"):
        pedlocdata.recordings(tmp_path, "train")


def test_a_split_for_which_no_recording_is_drawn_is_named(tmp_path):
    files.write(tmp_path)
    other = next(split for split in ("val", "test") if split != pedlocdata.split_of("lab07"))
    with pytest.raises(InputError, match=f"none of its 1 recordings is drawn for .*'{other}'"):
        pedlocdata.recordings(tmp_path, other)
