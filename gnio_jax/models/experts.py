"""Experts for low and high speed, weighted by a router that sees the spectrum of the window
(ours)."""

from __future__ import annotations

from typing import Annotated

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Bound, Count
from gnio_jax.models.heads import LinearHead, UncertaintyHead
from gnio_jax.models.layers import checked_windows, fourier_waves, linear
from gnio_jax.models.resnet import ResNet18
from gnio_jax.types import Prediction

FREQUENCIES = 16
"""Frequencies of the window that the router sees, from 0 on."""
ROUTER = 32
"""Hidden features of the router."""


class Experts(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to a mixture of the displacements of its
    experts: a ResNet-18 each, with a linear head and an uncertainty.

    The router sees the logarithms of the power of |accel| and |gyro| at the lowest frequencies of
    the window, which do not change if the phone or the world is turned. Displacement and variance
    are those of the mixture: d̂ = Σ p d, σ² = Σ p (σ_k² + (d_k − d̂)²). `loss.balance_weight` keeps
    the shares of the experts near each other (`training.network_losses.balance`), because otherwise
    one expert may take every window. The networks learn which expert has which speed.

    `width`: channels of the first group of every expert.
    """

    width: Count = 32
    experts: Annotated[int, Bound(lambda value: 2 <= value <= 64, "must be from 2 to 64")] = 2
    winograd: bool = False

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        windows = checked_windows(windows)
        hidden = nn.relu(linear(ROUTER, "router_hidden")(spectrum(windows)))
        shares = nn.softmax(linear(self.experts, "router")(hidden), axis=-1)
        displacements, log_stds = [], []
        for number in range(self.experts):
            encoder = ResNet18(self.width, self.winograd, name=f"expert{number + 1}")
            h = encoder(windows, train).mean(axis=1)
            displacements.append(LinearHead(name=f"expert{number + 1}_displacement")(h)[0])
            log_stds.append(UncertaintyHead(name=f"expert{number + 1}_log_std")(h, train))
        of_experts, u = jnp.stack(displacements, axis=1), jnp.stack(log_stds, axis=1)
        mean = jnp.einsum("bk,bki->bi", shares, of_experts)
        spread = jnp.log((of_experts - mean[:, None]) ** 2 + 1e-12)
        logs = jnp.logaddexp(2 * u, spread) + jnp.log(shares + 1e-12)[..., None]
        return Prediction(mean, 0.5 * jax.nn.logsumexp(logs, axis=1), {"router": shares})


def spectrum(windows: Float[Array, "b n 6"]) -> Float[Array, "b f"]:
    """Logarithms of the power of |accel| and |gyro|, a mean per sample, at the lowest frequencies.
    Shorter windows have zeros where there is no frequency."""
    squared = jnp.sum(windows.reshape(*windows.shape[:2], 2, 3) ** 2, axis=-1)
    size = jnp.sqrt(jnp.maximum(squared, 1e-12))
    cosines, sines = (waves[:, :FREQUENCIES] for waves in fourier_waves(windows.shape[1]))
    real, imaginary = (
        jnp.einsum("bnk,nf->bfk", size, waves) / windows.shape[1] for waves in (cosines, sines)
    )
    power = jnp.log(real**2 + imaginary**2 + 1e-6)
    power = jnp.pad(power, ((0, 0), (0, FREQUENCIES - power.shape[1]), (0, 0)))
    return power.reshape(len(windows), -1)
