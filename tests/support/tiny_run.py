"""Runs of the smallest network, as `gnio train` leaves them."""

import contextlib

import pytest

from gnio_jax.models import registry
from tests.support import drawn_run
from tests.support.tiny_network import Tiny


@contextlib.contextmanager
def known():
    """The registry of networks has `tiny`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(registry._MODELS, "tiny", Tiny)
        yield


def save(folder, config, size=0.2):
    """A run with parameters of about `size`."""

    def draw(random, kind, shape):
        statistics = kind == "batch_stats"
        return random.uniform(0.5, 1.5, shape) if statistics else random.normal(0, size, shape)

    return drawn_run.save(folder, config, draw)
