"""Which kind of training a configuration asks for."""

from __future__ import annotations

from gnio_jax.config import TrainConfig
from gnio_jax.reporting import Reporter
from gnio_jax.training import on_windows, through_filter
from gnio_jax.training.kinds import Training


def set_up(config: TrainConfig, reporter: Reporter, workers: int = 1) -> Training:
    """Everything of a run but its state; see `on_windows.set_up` and `through_filter.set_up`."""
    kind = through_filter if config.through_filter.learn else on_windows
    return kind.set_up(config, reporter, workers)
