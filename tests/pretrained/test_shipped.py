"""The network that comes with gnio-jax."""

import dataclasses

import jax
import numpy as np
import pytest

import gnio_jax
from gnio_jax import config as configuration
from gnio_jax import pretrained
from gnio_jax.commands import app
from gnio_jax.errors import InputError
from gnio_jax.pretrained.finding import SHIPPED
from gnio_jax.training import checkpoint
from gnio_jax.training.run_folder import initial_run
from tests.support.compiling import quick

MAXIMUM = 5e6
"""Bytes."""


@pytest.fixture(scope="module")
def about():
    return pretrained.about(SHIPPED / "pedestrian")


def test_it_is_the_default_and_small(about, monkeypatch):
    monkeypatch.delenv("GNIO_WEIGHTS", raising=False)
    assert pretrained.default() == SHIPPED / "pedestrian"
    whole = sum(file.stat().st_size for file in (SHIPPED / "pedestrian").iterdir())
    assert about.bytes <= whole < MAXIMUM
    assert "randomised" in about.data and "Apache-2.0" in about.license


def test_its_card_says_how_it_was_made_what_it_reached_and_where_it_fails():
    card = (SHIPPED / "pedestrian" / "README.md").read_text()
    for part in ("Recipe", "Figures", "Where it fails", "Storage", "oxiod_sessions_test"):
        assert part in card
    assert "seed 0" in card and "gnio calibrate" in card


def test_it_loads_and_answers(about):
    run = gnio_jax.load_pretrained("pedestrian")
    assert run.config.dataset == "randomised" and run.config.model.name == about.network
    assert all(np.isfinite(leaf).all() for leaf in _leaves(run.variables))
    # A phone that lies still goes nowhere, by the network alone.
    still = np.zeros((1, run.config.data.seen, 6), np.float32)
    still[..., 2] = 9.81
    prediction = quick(run.model.apply)(run.variables, still)
    assert np.linalg.norm(prediction.displacement) < 0.05


def test_a_run_of_it_is_the_same_network(tmp_path, capsys):
    out = tmp_path / "runs" / "pedestrian"
    app.main(["weights", "pedestrian", "--out", str(out)])
    assert f"gnio evaluate --workdir {out}" in capsys.readouterr().out
    found, packed = checkpoint.load_run(out), gnio_jax.load_pretrained("pedestrian")
    assert found.config == dataclasses.replace(packed.config, workdir=str(out))
    assert (found.epoch, found.step) == (packed.epoch, packed.step)
    jax.tree.map(np.testing.assert_array_equal, found.variables, packed.variables)
    with pytest.raises(InputError, match="is there already; name another folder"):
        pretrained.write_run("pedestrian", out)


def test_its_card_is_shown(tmp_path, capsys):
    app.main(["weights", "pedestrian"])
    assert capsys.readouterr().out.strip() == pretrained.card_of("pedestrian").strip()
    with pytest.raises(SystemExit) as leaving:
        app.main(["weights", "--out", str(tmp_path / "run")])
    assert leaving.value.code == 2
    assert "is for one package; name it before --out" in capsys.readouterr().err


def _leaves(tree):
    if hasattr(tree, "items"):
        for branch in tree.values():
            yield from _leaves(branch)
    else:
        yield np.asarray(tree)


def test_training_starts_from_it_by_its_name():
    config = configuration.load("pedestrian")
    config = dataclasses.replace(config, init_from="pedestrian")
    run = initial_run(config, gnio_jax.load_pretrained)
    assert run is not None and run.step > 0
    other = dataclasses.replace(config, model=dataclasses.replace(config.model, width=8))
    with pytest.raises(InputError, match=r"pedestrian: its model.width is 16.* describe the same"):
        initial_run(other, gnio_jax.load_pretrained)
