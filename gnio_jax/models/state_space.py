"""A diagonal state-space encoder (after S5: Smith, Warrington and Linderman, "Simplified State
Space Layers for Sequence Modeling", ICLR 2023; sizes and stem ours).

A layer is linear in its memory x, P complex numbers that decay and turn, each by its own λ:

    x' = exp(λ Δ) x + B̄ u,   y = 2 Re(C x') + D ⊙ u,   B̄ = (exp(λ Δ) − 1) / λ · B.

So a recording needs one `associative_scan`, and a step of the filter's loop a few products. Complex
numbers are pairs of real ones, because memories and exported programs hold real numbers.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, PRNGKeyArray

from gnio_jax.config.schema import Count
from gnio_jax.models.layers import layer_norm, linear
from gnio_jax.models.memory import NetworkWithMemory

STEPS = (1e-3, 1e-1)
"""Range of the time steps Δ before training, as in S4 and S5."""


class StateSpaceMemory(NamedTuple):
    """The memory of a `StateSpaceNetwork`."""

    samples: Float[Array, "b p c"]
    """The samples that the low-pass needs again."""
    layers: Float[Array, "b l 2 p"]
    """Real and imaginary parts of every layer's memory."""


class StateSpaceNetwork(NetworkWithMemory):
    """A low-pass, of whose output every `decimation`-th sample is kept, and `layers` state-space
    layers of `width` features, each with a memory of `state` complex numbers.

    At 100 Hz and the default decimation of 5 a layer makes 20 steps a second. The low-pass is a
    Hann window of four steps, whose first zero is half the new rate; it delays the signal by two
    steps. Ours: a layer normalises its input, and its output passes GELU and a gate before it is
    added to the input (the form of S5).
    """

    width: Count = 96
    state: Count = 64
    layers: Count = 3
    decimation: Count = 5

    @property
    def features(self) -> int:
        return self.width

    @property
    def multiple(self) -> int:
        return self.decimation

    def begin(self, batch: int) -> StateSpaceMemory:
        past = 3 * self.decimation
        return StateSpaceMemory(
            jnp.zeros((batch, past, self.inputs), jnp.float32),
            jnp.zeros((batch, self.layers, 2, self.state), jnp.float32),
        )

    def encode(
        self, state: StateSpaceMemory, signals: Float[Array, "b t c"], train: bool
    ) -> tuple[StateSpaceMemory, Float[Array, "b m d"]]:
        samples, x = decimate(state.samples, signals, self.decimation)
        x = linear(self.width, "input")(x)
        memories = []
        for i in range(self.layers):
            layer = StateSpaceLayer(self.state, name=f"layer{i + 1}")
            memory, x = layer(state.layers[:, i], x)
            memories.append(memory)
        return StateSpaceMemory(samples, jnp.stack(memories, axis=1)), layer_norm("norm")(x)


def decimate(
    past: Float[Array, "b p c"], signals: Float[Array, "b t c"], factor: int
) -> tuple[Float[Array, "b p c"], Float[Array, "b m c"]]:
    """The last 3 `factor` samples, which the next call needs, and the signals after a low-pass at
    every `factor`-th sample. The low-pass is a Hann window of 4 `factor` samples."""
    window = np.sin(np.pi * (np.arange(4 * factor) + 0.5) / (4 * factor)) ** 2
    window = (window / window.sum()).astype(np.float32).reshape(4, factor)
    x = jnp.concatenate([past, signals], axis=1)
    batch, samples, channels = x.shape
    blocks = x.reshape(batch, samples // factor, factor, channels)
    count = blocks.shape[1] - 3
    parts = [
        jnp.einsum("f,bmfc->bmc", window[i], blocks[:, i : i + count]) for i in range(len(window))
    ]
    return x[:, samples - past.shape[1] :], sum(parts[1:], parts[0])


class StateSpaceLayer(nn.Module):
    """One layer: its memory (b, 2, p) after the signal, and u + gate ⊙ GELU(y)."""

    state: int

    @nn.compact
    def __call__(
        self, memory: Float[Array, "b 2 p"], u: Float[Array, "b m d"]
    ) -> tuple[Float[Array, "b 2 p"], Float[Array, "b m d"]]:
        width, size = u.shape[-1], self.state
        x = layer_norm("norm")(u)
        # Decays of ½ and frequencies π n (S4D-Lin; Gu et al. 2022).
        rate = self.param("log_rate", nn.initializers.constant(math.log(0.5)), (size,), jnp.float32)
        turn = self.param("frequency", _frequencies, (size,), jnp.float32)
        log_step = self.param("log_step", _log_steps, (size,), jnp.float32)
        real, imaginary = -jnp.exp(rate), turn
        step = jnp.exp(log_step)
        length = jnp.exp(real * step)
        real, imaginary, step, length = (
            part[None, None] for part in (real, imaginary, step, length)
        )
        factor = length * jnp.cos(imaginary * step), length * jnp.sin(imaginary * step)
        # (exp(λ Δ) − 1) / λ = (a − 1) λ* / |λ|².
        square = real**2 + imaginary**2
        gain = _product((factor[0] - 1, factor[1]), (real / square, -imaginary / square))
        driven = _product(
            gain, (linear(size, "real", use_bias=False)(x), linear(size, "imag", use_bias=False)(x))
        )
        states = linear_recurrence(factor, driven, (memory[:, 0], memory[:, 1]))
        y = 2 * linear(width, "out")(jnp.concatenate(states, axis=-1))
        through = self.param("through", nn.initializers.normal(1.0), (width,), jnp.float32)
        y = nn.gelu(y + x * through[None, None])
        last = jnp.stack([part[:, -1] for part in states], axis=1)
        return last, u + y * jax.nn.sigmoid(linear(width, "gate")(y))


FEW = 8
"""Steps up to which a recurrence is a loop."""
Pair = tuple[Array, Array]
"""Real and imaginary part."""


def linear_recurrence(factor: Pair, inputs: Pair, start: Pair) -> Pair:
    """x_k = factor x_{k−1} + inputs_k along the second axis, x_{−1} = start: (b, m, p) of complex
    numbers as pairs. The factor (1, 1, p) is constant."""
    first = _product(factor, (start[0][:, None], start[1][:, None]))
    real, imaginary = (
        jnp.concatenate([part[:, :1] + begin, part[:, 1:]], axis=1)
        for part, begin in zip(inputs, first, strict=True)
    )
    inputs = real, imaginary
    if real.shape[1] <= FEW:  # as in an interval of the filter; ONNX has no associative scan
        rows = [(real[:, 0], imaginary[:, 0])]
        for number in range(1, real.shape[1]):
            carried = _product((factor[0][:, 0], factor[1][:, 0]), rows[-1])
            rows.append((carried[0] + real[:, number], carried[1] + imaginary[:, number]))
        real, imaginary = (jnp.stack(parts, axis=1) for parts in zip(*rows, strict=True))
        return real, imaginary
    factors = tuple(jnp.broadcast_to(part, real.shape) for part in factor)

    def combine(before: tuple, after: tuple) -> tuple:
        (a, x), (b, y) = before, after
        carried = _product(b, x)
        return _product(a, b), (carried[0] + y[0], carried[1] + y[1])

    return jax.lax.associative_scan(combine, (factors, inputs), axis=1)[1]


def _product(a: Any, b: Any) -> Pair:
    return a[0] * b[0] - a[1] * b[1], a[0] * b[1] + a[1] * b[0]


def _frequencies(_: PRNGKeyArray, shape: tuple[int], dtype: Any) -> Array:
    return math.pi * jnp.arange(shape[0], dtype=dtype)


def _log_steps(key: PRNGKeyArray, shape: tuple[int], dtype: Any) -> Array:
    low, high = (jnp.asarray(math.log(step), dtype) for step in STEPS)
    return jax.random.uniform(key, shape, dtype, low, high)
