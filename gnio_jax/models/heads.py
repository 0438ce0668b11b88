"""Prediction heads: the gated displacement with its ablations, and the uncertainty (paper §III-D,
§III-E)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.layers import linear

GATES = {"tanh": jnp.tanh, "sigmoid": nn.sigmoid}
SCALES = {
    "softplus": nn.softplus,
    "pos_elu": lambda x: nn.elu(x) + 1,
    "abs": jnp.abs,
    "exp": jnp.exp,
    "linear": lambda x: x,
}


class GatedHead(nn.Module):
    """d̂ = s ⊙ γ: a scale s = softplus(W_s h + b_s) and a gate γ = tanh(W_g h + b_g) that closes at
    rest.

    Ours: the gate starts with zero bias and a small kernel, so that an untrained network predicts
    d̂ ≈ 0.
    """

    gate: str = "tanh"
    scale: str = "softplus"

    @nn.compact
    def __call__(self, h: Float[Array, "b d"]) -> tuple[Float[Array, "b 3"], dict[str, Array]]:
        scale = SCALES[self.scale](linear(3, "scale")(h))
        small = nn.initializers.normal(1e-3)
        gate = GATES[self.gate](linear(3, "gate", kernel_init=small)(h))
        return scale * gate, {"scale": scale, "gate": gate}


class LinearHead(nn.Module):
    """d̂ = W h + b: the ablation without a gate. With two outputs the vertical is 0."""

    outputs: int = 3

    @nn.compact
    def __call__(self, h: Float[Array, "b d"]) -> tuple[Float[Array, "b 3"], dict[str, Array]]:
        return to_axes(linear(self.outputs, "displacement")(h)), {}


class UncertaintyHead(nn.Module):
    """u = W_u h + b_u, the log standard deviation per axis: Σ̂ = diag(exp 2u).

    Ours: kernel and bias start at zero, σ = 1 m. The likelihood's gradient contains e² exp(−2u),
    which is unbounded if a random kernel gives a small σ; one such step remains in Adam's second
    moment for thousands of steps.
    """

    @nn.compact
    def __call__(self, h: Float[Array, "b d"], train: bool) -> Float[Array, "b 3"]:
        return linear(3, "log_std", kernel_init=nn.initializers.zeros)(h)


class CalibratedUncertainty(nn.Module):
    """The head's standard deviation times one factor per axis.

    Inference applies the factor, and training does not. The factor (ours) is one of the
    `batch_stats`, as its logarithm. It is set after every validation, so that the squared errors on
    the validation split agree with the predicted standard deviations.
    """

    @nn.compact
    def __call__(self, h: Float[Array, "b d"], train: bool) -> Float[Array, "b 3"]:
        log_std = linear(3, "log_std", kernel_init=nn.initializers.zeros)(h)
        factor = self.variable("batch_stats", "log_factor", jnp.zeros, (3,), jnp.float32)
        return log_std if train else log_std + factor.value[None]


class ConstantUncertainty(nn.Module):
    """The log standard deviation of a network that predicts none: one constant per axis, the same
    for every window.

    It is not a parameter: it is one of the `batch_stats` and is set after every validation, so that
    it agrees with the squared errors on the validation split.
    """

    @nn.compact
    def __call__(self, h: Float[Array, "b *d"], train: bool) -> Float[Array, "b 3"]:
        constant = self.variable("batch_stats", "log_std", jnp.zeros, (3,), jnp.float32)
        return jnp.broadcast_to(constant.value[None], (h.shape[0], 3))


UNCERTAINTIES = {
    "head": UncertaintyHead,
    "calibrated": CalibratedUncertainty,
    "constant": ConstantUncertainty,
}
"""Modules of the uncertainty, by the choices of the option `uncertainty`."""


def to_axes(output: Float[Array, "b k"]) -> Float[Array, "b 3"]:
    """The displacement of a head with two or three outputs; with two, its vertical is 0."""
    return jnp.pad(output, ((0, 0), (0, 3 - output.shape[-1])))


def root_mean_square(log_std: Float[Array, "*b n 3"]) -> Float[Array, "*b 3"]:
    """log √(mean over n of exp 2u), without overflow."""
    count = jnp.float32(log_std.shape[-2])
    return 0.5 * (jax.nn.logsumexp(2 * log_std, axis=-2) - jnp.log(count))
