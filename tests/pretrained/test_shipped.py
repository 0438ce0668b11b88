"""The network that comes with gnio-jax."""

import jax.numpy as jnp
import numpy as np
import pytest

import gnio_jax
from gnio_jax import pretrained
from gnio_jax.pretrained.finding import SHIPPED

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
    still = np.zeros((1, run.config.data.window, 6), np.float32)
    still[..., 2] = 9.81
    prediction = run.model.apply(run.variables, jnp.asarray(still))
    assert np.linalg.norm(prediction.displacement) < 0.05


def _leaves(tree):
    if hasattr(tree, "items"):
        for branch in tree.values():
            yield from _leaves(branch)
    else:
        yield np.asarray(tree)
