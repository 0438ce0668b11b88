"""IONet (Chen et al., "IONet: Learning to Cure the Curse of Drift in Inertial Odometry", AAAI
2018): a bidirectional LSTM that predicts polar displacements, and its own integrator."""

from __future__ import annotations

from typing import Literal

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, Probability
from gnio_jax.models.bidirectional import Bidirectional
from gnio_jax.models.heads import ConstantUncertainty, to_axes
from gnio_jax.models.layers import checked_windows, linear
from gnio_jax.types import Prediction


class IONet(nn.Module):
    """Windows [accel, gyro] to a length Δl and an angle Δψ, by the final outputs of two layers of
    LSTM in both directions: 302,978 parameters, as PyTorch counts them (a gate has two biases).

    The displacement of the window is Δl (cos Δψ, sin Δψ), the vertical is 0, the uncertainty a
    constant. What Δψ is relative to depends on the frame of the windows and on the target:

    - "direction" (ours): the direction of the displacement in the window's frame, whose start has
      zero yaw. This is a displacement as the filter measures it.
    - "turn" (published): the change of the direction of motion over the window. Displacements are
      in the filter's frame only if the phone's x axis points forward. `chain` adds the angles up.

    Published: raw samples in the body, at 100 Hz, windows of 2 s. Ours: the gravity-aligned frame.
    The publication gives no initialisation, batch size, nor weight of the angle (the loss "polar"
    has one). Training needs the random stream `dropout`.
    """

    width: Count = 96
    dropout: Probability = 0.25
    angle: Literal["direction", "turn"] = "direction"
    output_dim = 2

    @property
    def takes_context(self) -> bool:
        """Whether a context may come before the window: a turn is that of all samples the network
        sees."""
        return self.angle == "direction"

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        x, last = checked_windows(windows), None
        for layer in ("lstm1", "lstm2"):
            x, last = Bidirectional(self.width, "lstm", name=layer)(x)
            x, last = (nn.Dropout(self.dropout, deterministic=not train)(y) for y in (x, last))
        polar = linear(2, "displacement")(last)
        length, angle = polar[:, 0], polar[:, 1]
        planar = length[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        log_std = ConstantUncertainty(name="uncertainty")(polar, train)
        diagnostics = {"polar" if self.angle == "direction" else "polar_turn": polar}
        return Prediction(to_axes(planar), log_std, diagnostics)


def chain(
    polar: Float[np.ndarray, "k 2"],
    windows_per_step: int,
    heading: float = 0.0,
    start: tuple[float, float] = (0.0, 0.0),
) -> Float[np.ndarray, "k+1 2"]:
    """IONet's own trajectory, m, from the lengths (m) and turns (rad) of windows that begin one
    stride apart: ψ ← ψ + Δψ, p ← p + Δl (cos ψ, sin ψ).

    A window is `windows_per_step` strides long. Ours, because the publication does not say how
    windows that overlap are chained: each stride has that share of the length and of the turn of
    the window that begins with it.
    """
    share = np.asarray(polar, float) / windows_per_step
    angle = heading + np.cumsum(share[:, 1])
    steps = share[:, :1] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([[start], start + np.cumsum(steps, axis=0)])
