"""The smallest network with the parts that the others have: it compiles at once."""

import jax.numpy as jnp
from flax import linen as nn

from gnio_jax.models.heads import CalibratedUncertainty, UncertaintyHead
from gnio_jax.models.layers import FLOAT32, MOMENTUM, linear
from gnio_jax.types import Prediction


class Tiny(nn.Module):
    width: int = 4
    uncertainty: str = "head"

    @nn.compact
    def __call__(self, windows, train=False):
        # A bias would cancel in the normalisation: its gradient is rounding, which Adam makes whole
        # steps of, and two machines, or two orders of a sum, would not agree on it.
        mean = windows.mean(axis=1)
        h = linear(self.width, "encoder", use_bias=False)(mean)
        norm = nn.BatchNorm(not train, momentum=MOMENTUM, name="norm", **FLOAT32)
        h = jnp.tanh(norm(h))
        displacement = linear(3, "head")(h)
        if self.uncertainty == "calibrated":
            log_std = CalibratedUncertainty(name="uncertainty")(h, train)
        else:
            log_std = UncertaintyHead(name="uncertainty")(h, train)
        return Prediction(displacement, log_std, {})
