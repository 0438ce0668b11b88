"""GNIO: encoder, Motion Bank and gated head put together (paper §III, fig. 2), with the paper's
ablations as options."""

from __future__ import annotations

from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.heads import (
    CalibratedUncertainty,
    ConstantUncertainty,
    GatedHead,
    LinearHead,
    UncertaintyHead,
)
from gnio_jax.models.motion_bank import MotionBank
from gnio_jax.models.precision import Dtype
from gnio_jax.models.resnet import ResNet18
from gnio_jax.types import Prediction


class GNIO(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement, its uncertainty, gate and
    attention.

    The defaults are the paper's: 4,934,153 parameters, 32,768 of them the bank. `bank_size = 0`
    leaves the bank out (h = f). Widths other than 64 scale every layer, for machines without an
    accelerator. Two kinds of `uncertainty` are ours: "calibrated" multiplies the head's standard
    deviation by one factor per axis, "constant" puts one standard deviation per axis in its place;
    both make it fit the errors on the validation split.
    """

    width: int = 64
    bank_size: int = 64
    bank_heads: int = 8
    bank_std: float = 1.0
    head: Literal["gated", "linear"] = "gated"
    gate: Literal["tanh", "sigmoid"] = "tanh"
    scale: Literal["softplus", "pos_elu", "abs", "exp", "linear"] = "softplus"
    uncertainty: Literal["head", "calibrated", "constant"] = "head"
    dtype: Dtype = "float32"

    def __post_init__(self) -> None:
        if self.bank_size and (8 * self.width) % self.bank_heads:
            raise ValueError(
                f"bank_heads must divide the {8 * self.width} features, found {self.bank_heads}"
            )
        super().__post_init__()

    @nn.compact
    def __call__(
        self, windows: Float[jax.Array, "b n 6"], train: bool = False, memory: Any = None
    ) -> Prediction:
        features = ResNet18(self.width, self.dtype, name="encoder")(
            windows.astype(jnp.float32), train
        )
        h = features.mean(axis=1)
        diagnostics = {}
        if self.bank_size:
            context, diagnostics["attention"] = self._bank(name="bank")(h, memory)
            h = h + context
        head = (
            GatedHead(self.gate, self.scale, self.dtype, name="head")
            if self.head == "gated"
            else LinearHead(self.dtype, name="head")
        )
        displacement, seen = head(h)
        match self.uncertainty:
            case "head":
                log_std = UncertaintyHead(self.dtype, name="uncertainty")(h)
            case "calibrated":
                log_std = CalibratedUncertainty(self.dtype, name="uncertainty")(h, train)
            case "constant":
                log_std = ConstantUncertainty(name="uncertainty")(windows.shape[0])
        return Prediction(displacement, log_std, diagnostics | seen)

    @nn.nowrap
    def _bank(self, name: str | None = None) -> MotionBank:
        sizes = self.bank_size, self.bank_heads, 8 * self.width
        return MotionBank(*sizes, self.bank_std, self.dtype, name=name)

    @nn.nowrap
    def constants(self, variables: Any) -> dict[str, Any]:
        """Arguments of `apply` that depend on the variables alone: the bank's keys and values."""
        if not self.bank_size:
            return {}
        return {
            "memory": self._bank().apply({"params": variables["params"]["bank"]}, method="memory")
        }
