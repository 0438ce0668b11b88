"""Training through the filter: which parts learn, from which pieces, by which losses."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gnio_jax.config.bounds import NonNegative, Positive
from gnio_jax.errors import InputError

Part = Literal["noise", "measurement", "start", "uncertainty", "head", "encoder", "all"]
"""A part of network and filter that can learn."""


@dataclass(frozen=True)
class ThroughFilter:
    """Training with the network in the filter's loop (ours), from the weights of `init_from`. The
    section `optim` counts pieces instead of windows; `loss` is for windows alone, and so is
    `augment` but for its `yaw`."""

    learn: tuple[Part, ...] = ()
    """Parts that learn; none: the network is trained on windows. noise: the filter's densities and
    bias walks; measurement: the factors of the network's covariance and the errors that last;
    start: the standard deviations at the start; uncertainty, head, encoder: the network's; all:
    everything. A filter option that is 0 stays 0."""
    piece_seconds: Positive = 60.0
    """Length of the pieces of recordings that are filtered, s."""
    truncate_seconds: Positive = 10.0
    """The filter's state is carried on without gradient after every so many seconds."""
    start_spread: NonNegative = 1.0
    """Each piece starts off the reference by errors drawn from the filter's initial standard
    deviations times this; 0 starts at the reference."""
    gate_softness: NonNegative = 2.0
    """Slope of the χ² gate in training (`FilterConfig.gate_softness`); validation has the gate that
    evaluation has."""
    filter_learning_rate: Positive = 0.03
    """Peak learning rate of the logarithms of the filter's options; the network's is
    optim.learning_rate. Both have its schedule."""
    skip_above: Positive = 1000.0
    """A step is skipped, and counted in the log, when the norm of its gradient is above this, or
    anything in it is not finite, or the filter diverged."""
    displacement_weight: NonNegative = 100.0
    """Weight of the relative error of displacements over 1, 5, 10, 30 and 60 s."""
    yaw_weight: NonNegative = 1000.0
    """Weight of the relative error of yaw over the same times."""
    innovation_weight: NonNegative = 0.1
    """Weight of the negative log-likelihood of the innovations."""
    state_weight: NonNegative = 0.1
    """Weight of the negative log-likelihood of the true velocity and position under the filter's
    covariance."""
    window_weight: NonNegative = 100.0
    """Weight of the squared error of each window's displacement."""

    def check(self, prefix: str, source: str) -> None:
        """Truncation divides the piece."""
        ratio = self.piece_seconds / self.truncate_seconds
        if abs(ratio - round(ratio)) >= 1e-6 or ratio < 1:
            problem = f"must divide the piece of {self.piece_seconds:g} s"
            raise InputError(source, f"field '{prefix}truncate_seconds' {problem}")
