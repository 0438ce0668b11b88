"""Names, roots and splits."""

import dataclasses

import pytest

from gnio_jax import data
from gnio_jax.data import registry
from gnio_jax.errors import InputError


def test_every_dataset_says_what_a_user_must_know():
    assert data.names() == sorted(data.names()) and {"oxiod", "synthetic", "tlio"} <= set(
        data.names()
    )
    for name in data.names():
        dataset = data.get(name)
        assert dataset.name == name and dataset.splits and dataset.rate > 0
        assert callable(dataset.recordings)
        assert dataset.source and dataset.layout and dataset.licence


def test_unknown_names_and_splits_list_the_known_ones():
    with pytest.raises(
        InputError,
        match=r"unknown name 'tloi'; did you mean 'tlio'\? known datasets: .*synthetic, tlio",
    ):
        data.load("tloi")
    with pytest.raises(
        InputError,
        match=r"dataset tlio: unknown split 'vel'; "
        r"did you mean 'val'\? known splits: train, val, test",
    ):
        data.load("tlio", split="vel")


def test_the_root_is_the_argument_then_the_environment_then_the_working_folder(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GNIO_DATA", raising=False)
    with pytest.raises(InputError) as error:
        data.find_root("tlio")
    text = str(error.value)
    assert (
        text.startswith("data/tlio")
        and data.get("tlio").source in text
        and data.get("tlio").layout in text
        and "--data-root" in text
    )

    here = tmp_path / "data" / "tlio"
    here.mkdir(parents=True)
    assert data.find_root("tlio").resolve() == here
    elsewhere = tmp_path / "elsewhere"
    monkeypatch.setenv("GNIO_DATA", str(elsewhere))
    assert data.find_root("tlio").resolve() == here
    (elsewhere / "tlio_layout").mkdir(parents=True)
    assert data.find_root("tlio") == elsewhere / "tlio_layout"
    (elsewhere / "tlio").mkdir()
    assert data.find_root("tlio") == elsewhere / "tlio"
    assert data.find_root("tlio", str(here)) == here
    with pytest.raises(InputError, match=r"nowhere: no folder of dataset 'tlio'"):
        data.find_root("tlio", tmp_path / "nowhere")


def test_a_split_without_a_sequence_is_an_error(tmp_path, monkeypatch):
    empty = dataclasses.replace(data.get("tlio"), recordings=lambda root, split: [])
    monkeypatch.setitem(registry._DATASETS, "tlio", empty)
    with pytest.raises(InputError, match="split 'test' of dataset 'tlio' holds no sequence"):
        data.load("tlio", tmp_path)


def test_the_computed_set_needs_no_folder(monkeypatch, tmp_path):
    monkeypatch.delenv("GNIO_DATA", raising=False)
    monkeypatch.chdir(tmp_path)
    assert len(data.load("synthetic", split="val")) == 4
