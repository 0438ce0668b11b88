"""GNIO: encoder, Motion Bank and gated head (paper §III, fig. 2), with the paper's ablations as
options."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, NonNegativeCount, Positive
from gnio_jax.models.bins import BinHead
from gnio_jax.models.heads import UNCERTAINTIES, GatedHead, LinearHead
from gnio_jax.models.layers import checked_windows
from gnio_jax.models.motion_bank import MotionBank
from gnio_jax.models.resnet import ResNet18
from gnio_jax.types import Prediction


class GNIO(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement, its uncertainty, gate and
    attention.

    The defaults are the paper's: 4,934,153 parameters, 32,768 of them the bank. `bank_size = 0`
    leaves the bank out (h = f). Widths other than 64 scale every layer, for machines without an
    accelerator. Two choices of `uncertainty` are ours: "calibrated" multiplies the head's standard
    deviation by one factor per axis, "constant" uses one standard deviation per axis in its place.
    Both are fitted to the errors on the validation split. The head "bins" (VeloBins') has the
    uncertainty of its distribution over bins from −`reach` to `reach` m, in the place of
    `uncertainty`.

    A network with a head of its own overrides `displacement_head` or `uncertainty_head`.
    """

    width: Count = 64
    bank_size: NonNegativeCount = 64
    bank_std: Positive = 1.0
    head: Literal["gated", "linear", "bins"] = "gated"
    gate: Literal["tanh", "sigmoid"] = "tanh"
    scale: Literal["softplus", "pos_elu", "abs", "exp", "linear"] = "softplus"
    uncertainty: Literal["head", "calibrated", "constant"] = "head"
    reach: Positive = 3.0
    winograd: bool = False

    @nn.compact
    def __call__(
        self, windows: Float[Array, "b n 6"], train: bool = False, memory: Any = None
    ) -> Prediction:
        encoder = ResNet18(self.width, self.winograd, name="encoder")
        h, diagnostics = encoder(checked_windows(windows), train).mean(axis=1), {}
        if self.bank_size:
            context, diagnostics["attention"] = self._bank(name="bank")(h, memory)
            h = h + context
        displacement, head_diagnostics = self.displacement_head()(h)
        if "log_std" in head_diagnostics:
            log_std = head_diagnostics.pop("log_std")
        else:
            log_std = self.uncertainty_head()(h, train)
        return Prediction(displacement, log_std, diagnostics | head_diagnostics)

    @nn.nowrap
    def displacement_head(self) -> nn.Module:
        """A module named "head" that maps h (b, 8·width) to the displacement (b, 3), m, and a dict
        of diagnostics, each with b rows."""
        gated, bins = partial(GatedHead, self.gate, self.scale), partial(BinHead, reach=self.reach)
        return {"gated": gated, "linear": LinearHead, "bins": bins}[self.head](name="head")

    @nn.nowrap
    def uncertainty_head(self) -> nn.Module:
        """A module named "uncertainty" that maps h (b, 8·width) and `train` to the logarithms of
        the standard deviations (b, 3), m."""
        return UNCERTAINTIES[self.uncertainty](name="uncertainty")

    @nn.nowrap
    def _bank(self, name: str | None = None) -> MotionBank:
        return MotionBank(self.bank_size, width=8 * self.width, std=self.bank_std, name=name)

    @nn.nowrap
    def constants(self, variables: Any) -> dict[str, Any]:
        """Arguments of `apply` that depend on the variables alone: the bank's keys and values."""
        if not self.bank_size:
            return {}
        return {
            "memory": self._bank().apply({"params": variables["params"]["bank"]}, method="memory")
        }
