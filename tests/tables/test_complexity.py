"""What the networks cost, on paper and measured."""

import math

import jax
import pytest
from flax import linen as nn

from gnio_jax import models
from gnio_jax.models.layers import linear
from gnio_jax.reporting import Lines
from gnio_jax.tables import make
from gnio_jax.types import Prediction


class Flat(nn.Module):
    """One product of every sample with 16 rows."""

    @nn.compact
    def __call__(self, windows, train=False):
        outputs = linear(16, "all")(windows.reshape(windows.shape[0], -1))
        return Prediction(outputs[:, :3], outputs[:, 3:6])


def test_cost_of_a_network_by_hand(monkeypatch):
    monkeypatch.setattr(models, "create", lambda name: Flat())
    complexity = make.measure("flat", batches=(2, 1), seconds=0.01)
    assert complexity.parameters == 1200 * 16 + 16
    assert 1e9 * complexity.gflops == pytest.approx(2 * 1200 * 16, rel=0.01)
    assert len(complexity.latency) == 2 and min(complexity.latency) > 0
    # A compiler that counts nothing leaves the figure out.
    monkeypatch.setattr(jax.stages.Compiled, "cost_analysis", lambda self: {"bytes": 1.0})
    assert math.isnan(make.measure("flat", batches=(1,), seconds=0.01).gflops)


def test_the_table_names_every_network(tmp_path, monkeypatch):
    monkeypatch.setattr(make, "measure", lambda name: make.Complexity(5, float("nan"), [2.0, 0.5]))
    text = make.make_complexity(tmp_path, Lines())
    assert "| gnio | 5 | – | – | 2.00 | 0.50 | 4.90 M | 0.08 |" in text
    assert set(make.NETWORKS) == set(models.names())
    assert "| tlio in o2_frame | 5 |" in text
    for options in make.VARIANTS.values():
        models.create(**options)
    assert (tmp_path / "complexity.md").read_text(encoding="utf-8") in text
