"""Folds: groups stay whole, the time is shared fairly, and training lacks what is left out."""

import dataclasses
import itertools

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.config import DataConfig, TrainConfig, validate
from gnio_jax.errors import InputError
from gnio_jax.reporting import Lines
from gnio_jax.training import kinds
from gnio_jax.types import Sequence


def recording(name, seconds, **attributes):
    time = np.arange(0, seconds, 0.02)
    nothing = np.zeros((len(time), 3))
    quaternion = np.tile([1.0, 0, 0, 0], (len(time), 1))
    valid = np.ones(len(time), bool)
    found = Sequence(name, time, nothing, nothing, quaternion, nothing, nothing, valid)
    return found._replace(attributes=attributes)


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


def test_groups_are_the_loaders_else_people_else_each_its_own():
    assert [data.group(each) for each in RECORDINGS] == ["a", "a", "b", "c", "c", "lonely", "other"]


def test_folds_share_the_time_and_keep_groups_whole():
    found = data.folds(RECORDINGS, 2)
    lengths = {"a": 50, "b": 40, "c": 30, "lonely": 20, "other": 20}
    times = [sum(lengths[g] for g in found if found[g] == fold) for fold in (0, 1)]
    assert sorted(times) == [70, 90] or times == [80, 80]
    for order in itertools.islice(itertools.permutations(RECORDINGS), 0, 5040, 501):
        assert data.folds(order, 2) == found


@pytest.mark.parametrize("left_out", [0, 1, 2])
def test_training_lacks_the_fold_that_is_left_out(monkeypatch, left_out):
    monkeypatch.setattr(data, "load_each", lambda *_: iter(RECORDINGS))
    config = TrainConfig(data=DataConfig(rate=50.0, folds=3, left_out=left_out))
    read = [s.name for s in kinds.read_split(config, "train", Lines(), 1)]
    fold_of = data.folds(RECORDINGS, 3)
    assert read == [s.name for s in RECORDINGS if fold_of[data.group(s)] != left_out]
    assert 0 < len(read) < len(RECORDINGS)
    # Validation has a split of its own.
    assert len(list(kinds.read_split(config, "val", Lines(), 1))) == len(RECORDINGS)


def test_a_fold_that_is_not_there_is_a_mistake():
    config = TrainConfig(data=DataConfig(folds=2, left_out=2))
    with pytest.raises(InputError, match=r"data.left_out.* below data.folds, which is 2, found 2"):
        validate(dataclasses.replace(config), "here")
