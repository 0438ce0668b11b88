"""Who is absent from a list is counted; folds keep groups whole and share the time fairly."""

import itertools

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.config import DataConfig, TrainConfig
from gnio_jax.data import loading
from gnio_jax.data.splits import find_list, read_list
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines
from gnio_jax.training.recordings import read_split
from gnio_jax.types import Sequence


def recording(name, seconds, **attributes):
    time = np.arange(0, seconds, 0.02)
    nothing = np.zeros((len(time), 3))
    quaternion = np.tile([1.0, 0, 0, 0], (len(time), 1))
    valid = np.ones(len(time), bool)
    sequence = Sequence(name, time, nothing, nothing, quaternion, nothing, nothing, valid)
    return sequence._replace(attributes=attributes)


def test_lists_may_lack_recordings_and_their_last_newline_but_not_everything(tmp_path):
    path = tmp_path / "lists" / "train.txt"
    path.parent.mkdir()
    (tmp_path / "b").mkdir()

    def find(entry):
        return tmp_path / entry if (tmp_path / entry).is_dir() else None

    assert find_list(tmp_path, "train.txt") == tmp_path / "train.txt"  # for messages
    path.write_text("\ufeff# mine\na\n b \n\nb\nc\nd\ne")
    assert find_list(tmp_path, "train.txt") == path
    with pytest.warns(UserWarning, match=r"train\.txt: 4 of 5 .* absent: a, c, d, \.\.\.$"):
        assert read_list(path, find, tmp_path, "any") == [tmp_path / "b"]
    path.write_text("a\n" + 5000 * "x")  # too long for a name
    with pytest.raises(InputError, match=r"none of its 2 sequences is below .*expected layout"):
        read_list(path, find, tmp_path, "any")
    path.unlink()
    with pytest.raises(InputError, match=r"train\.txt: the list cannot be read"):
        read_list(path, find, tmp_path, "any")


# Groups of 50, 40, 30, 20 and 20 s.
RECORDINGS = [
    recording("a1", 30, group="a", subject="x"),
    recording("a2", 20, group="a", subject="y"),
    recording("b1", 40, subject="b"),
    recording("c1", 10, group="c"),
    recording("c2", 20, group="c"),
    recording("lonely", 20),
    recording("other", 20),
]


def test_folds_share_the_time_and_keep_groups_whole():
    folds = data.folds(RECORDINGS, 2)
    lengths = {"a": 50, "b": 40, "c": 30, "lonely": 20, "other": 20}
    assert sum(lengths[name] for name in folds if folds[name] == 0) in (70, 80, 90)
    for order in itertools.islice(itertools.permutations(RECORDINGS), 0, 5040, 501):
        assert data.folds(order, 2) == folds


def test_a_split_may_be_a_fold_or_all_but_that_in_training_too(monkeypatch):
    """Groups are those of the loaders, else people, else each is its own."""
    groups = [data.group(sequence) for sequence in RECORDINGS]
    assert groups == ["a", "a", "b", "c", "c", "lonely", "other"]
    monkeypatch.setattr(loading, "read_split", lambda *_: iter(RECORDINGS))
    fold_of = data.folds(RECORDINGS, 3)
    for number in range(3):
        names = f"train-{number}of3", f"train+{number}of3"
        without, alone = ([s.name for s in data.load("synthetic", None, name)] for name in names)
        assert without == [s.name for s in RECORDINGS if fold_of[data.group(s)] != number]
        assert alone == [s.name for s in RECORDINGS if fold_of[data.group(s)] == number]
        assert 0 < len(alone) < len(RECORDINGS)
        config = TrainConfig(data=DataConfig(rate=50.0, train_split=names[0]))
        read = read_split(config, "synthetic", names[0], Lines(), 1, {})
        assert [s.name for s in read] == without
    assert data.parse_fold("sessions-of-4") is None


@pytest.mark.parametrize(
    ("split", "problem"),
    [
        ("train-2of2", r"split 'train-2of2': has no such fold; they are numbered 0 to 1"),
        ("trian-0of2", r"unknown split 'trian'; did you mean 'train'"),
        ("train-6of9", r"split 'train': has nothing in fold 6 of 9; there are 5 people or"),
        ("train-0of1", r"has nothing beside fold 0 of 1; there are 5 people or .* two folds or"),
        ("val-0of4", r"has nothing beside fold 0 of 4; it is of one person or session; add others"),
    ],
)
def test_a_fold_that_is_not_there_is_a_mistake(monkeypatch, split, problem):
    count = 2 if split.startswith("val") else None  # both of one session
    monkeypatch.setattr(loading, "read_split", lambda *_: iter(RECORDINGS[:count]))
    with pytest.raises(InputError, match=problem):
        data.load("synthetic", None, split)
