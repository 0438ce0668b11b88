"""Operations of the networks against a count by hand."""

import math

import jax
import pytest

from gnio_jax import models
from gnio_jax.reporting import Lines
from gnio_jax.tables import make
from tests.support.tiny_network import Tiny


def multiply_adds(convolutions, dense, padding):
    """By hand: every output of a convolution costs its kernel, with or without its taps in the
    padding, every dense layer its matrix."""
    total = sum(i * o for i, o in dense)
    for length, stride, size, i, o in convolutions:
        for output in range(-(-length // stride)):
            first = output * stride - size // 2
            total += sum(padding or 0 <= first + tap < length for tap in range(size)) * i * o
    return total


def encoder():
    """(length of the input, stride, kernel, channels in, out) of each convolution; 200 samples."""
    layers, before, length = [(200, 2, 7, 6, 64)], 64, 50
    for group, width in enumerate((64, 128, 256, 512)):
        stride = 2 if group else 1
        layers.append((length, stride, 3, before, width))
        if group:
            layers.append((length, stride, 1, before, width))
        length = -(-length // stride)
        layers += [(length, 1, 3, width, width)] * 3
        before = width
    return layers


def test_complexity_of_gnio_against_a_hand_count():
    dense = [(512, 512), (512, 64), (512, 64), (512, 512), *[(512, 3)] * 3]
    padded, by_hand = (multiply_adds(encoder(), dense, padding) for padding in (True, False))
    assert padded == pytest.approx(37.4e6, rel=2e-3)
    found = make.measure("gnio", batches=(1,), seconds=0.05)
    assert found.parameters == 4_934_153
    # Additions, ReLUs and the like besides.
    assert 1e9 * found.gflops == pytest.approx(2 * by_hand, rel=0.02)
    assert found.latency[0] > 0


def test_a_compiler_that_counts_nothing_leaves_the_figure_out(monkeypatch):
    monkeypatch.setattr(jax.stages.Compiled, "cost_analysis", lambda self: {"bytes": 1.0})
    monkeypatch.setattr(models, "create", lambda name: Tiny())
    assert math.isnan(make.measure("tiny", batches=(1,), seconds=0.05).gflops)


def test_the_table_names_every_network(tmp_path, monkeypatch):
    monkeypatch.setattr(make, "measure", lambda name: make.Complexity(5, float("nan"), [2.0, 0.5]))
    text = make.make_complexity(tmp_path, Lines())
    assert "| gnio | 5 | – | 2.00 | 0.50 | 4.90 M | 0.08 |" in text
    assert set(make.NETWORKS) == set(models.names())
    assert (tmp_path / "complexity.md").read_text(encoding="utf-8") in text
