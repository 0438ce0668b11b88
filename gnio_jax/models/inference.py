"""Variables prepared for inference: quantities that depend only on the parameters are computed once
per run instead of once per window.

With one window per call, as in the filter's loop, the Motion Bank's keys and values need as many
products as the whole encoder.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models import memory as with_memory
from gnio_jax.models.layers import EPSILON
from gnio_jax.types import Array, Memory, Prediction


class InferenceVariables(NamedTuple):
    """A network's variables with batch normalisations folded into the convolutions."""

    variables: Any
    constants: dict[str, Any]
    """Further arguments of its `apply`."""


@dataclass(frozen=True)
class Inference:
    """`Inference(model)(ready, windows)` is `model.apply(variables, windows)` to rounding. It is
    hashable, so it can be a static argument of `jit`."""

    model: nn.Module

    def __call__(self, ready: InferenceVariables, windows: jax.Array) -> Prediction:
        return self.model.apply(ready.variables, windows, **ready.constants)  # type: ignore[return-value]

    @property
    def has_memory(self) -> bool:
        """Whether the network carries a memory from interval to interval (`models.memory`)."""
        return isinstance(self.model, with_memory.NetworkWithMemory)


@dataclass(frozen=True, eq=False)
class Stepwise:
    """A network with memory and its variables, as the filter takes it
    (`filtering.network.PredictWithMemory`)."""

    model: with_memory.NetworkWithMemory
    ready: InferenceVariables
    select: Callable[[Prediction], Prediction]
    """A function of every prediction, which may leave out some of its diagnostics."""

    @property
    def channels(self) -> int:
        """Channels of the samples."""
        return self.model.channels

    def begin(self, dtype: Any = float) -> Memory:
        """An empty memory."""
        return with_memory.begin(self.model, self.ready.variables, dtype)

    def step(
        self, memory: Memory, samples: Float[Array, "n c"], attitude: Float[Array, "3 3 n+1"]
    ) -> tuple[Memory, Prediction]:
        """See `models.memory.step`."""
        variables, constants = self.ready
        after, prediction = with_memory.step(
            self.model, variables, memory, samples, attitude, **constants
        )
        return after, self.select(prediction)


class Network(NamedTuple):
    """A network with its parameters."""

    apply: Callable[[Any, Any], Prediction]
    """(variables, windows (b, N, 6) float32) -> `Prediction`; hashable, as a Flax module's `apply`
    is."""
    variables: Any

    @classmethod
    def of(cls, model: nn.Module, variables: Any) -> Network:
        """A network prepared for inference: quantities that depend only on its parameters are
        computed here, once."""
        return cls(Inference(model), inference_variables(model, variables))

    @property
    def has_memory(self) -> bool:
        """Whether the network carries a memory from interval to interval."""
        return isinstance(self.apply, Inference) and self.apply.has_memory

    def predict(
        self, select: Callable[[Prediction], Prediction] = lambda prediction: prediction
    ) -> Any:
        """The network as the filter takes it: a function of windows, or a network with memory.
        `select` is applied to every prediction."""
        apply, variables = self
        if self.has_memory:
            assert isinstance(apply, Inference)
            assert isinstance(apply.model, with_memory.NetworkWithMemory)
            return Stepwise(apply.model, variables, select)
        return lambda windows: select(apply(variables, windows))


@functools.partial(jax.jit, static_argnames="model")
def inference_variables(model: nn.Module, variables: Any) -> InferenceVariables:
    """Variables with every batch normalisation folded into its convolution, and the result of
    `model.constants`, if the model has it."""
    folded = {**variables, **_fold(variables["params"], variables.get("batch_stats", {}))}
    constants = getattr(model, "constants", None)
    return InferenceVariables(folded, constants(folded) if constants else {})


def _fold(params: Any, statistics: Any) -> dict[str, Any]:
    """Fold each normalisation into the convolution before it.

    (x − μ)/√(σ² + ε)·γ + β = a x + (β − a μ) with a = γ/√(σ² + ε): the kernel becomes w·a, and the
    normalisation becomes a shift. A normalisation `…bn…` follows the convolution `…conv…` (without
    bias) of the same module; one without such a convolution stays as it is.
    """
    params, statistics = dict(params), dict(statistics)
    for name, moments in list(statistics.items()):
        if name not in params:
            continue  # a constant uncertainty, not a normalisation
        convolution_name = name.replace("bn", "conv")
        if "mean" not in moments:
            inner = _fold(params[name], moments)
            params[name], statistics[name] = inner["params"], inner["batch_stats"]
        elif convolution_name != name and convolution_name in params:
            norm, convolution = params[name], dict(params[convolution_name])
            factor = norm["scale"] / jnp.sqrt(moments["var"] + EPSILON)
            convolution["kernel"] = convolution["kernel"] * factor[None, None]
            params[convolution_name] = convolution
            params[name] = {
                "scale": jnp.ones_like(factor),
                "bias": norm["bias"] - factor * moments["mean"],
            }
            statistics[name] = {
                "mean": jnp.zeros_like(factor),
                "var": jnp.full_like(factor, 1 - EPSILON),
            }
    return {"params": params, "batch_stats": statistics}
