"""TLIO's network (Liu et al., "TLIO: Tight Learned Inertial Odometry", IEEE RA-L 2020), and the
fully connected head that it shares."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.layers import check_dropout, linear
from gnio_jax.models.precision import Dtype
from gnio_jax.models.resnet import ResNet18, batch_norm, conv
from gnio_jax.types import Prediction

SMALL = nn.initializers.normal(0.01)


class FullyConnectedHead(nn.Module):
    """Feature maps (b, m, 8·width) to `outputs` numbers a window: 1×1 convolution and
    normalisation, flattened, three linear layers.

    TLIO's and RoNIN's, whose sizes (128 channels, 512 features) the papers leave to their code;
    other widths than 64 scale both, for small machines. Flattened channel by channel, as PyTorch
    does, so that weights trained there fit. Linear kernels start at N(0, 0.01), biases at 0. The
    number of parameters depends on m, and so on the length of the window.
    """

    width: int
    outputs: int
    dropout: float
    dtype: Dtype = "float32"

    @nn.compact
    def __call__(self, features: Float[jax.Array, "b m d"], train: bool) -> Float[jax.Array, "b k"]:
        neck = conv(2 * self.width, 1, 1, train, "neck_conv", self.dtype)
        x = batch_norm(train, "neck_bn")(neck(features))
        x = x.transpose(0, 2, 1).reshape(x.shape[0], -1)
        for name in ("fc1", "fc2"):
            x = nn.relu(linear(8 * self.width, name, self.dtype, kernel_init=SMALL)(x))
            x = nn.Dropout(self.dropout, deterministic=not train)(x)
        return linear(self.outputs, "fc3", self.dtype, kernel_init=SMALL)(x)


class TLIO(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement and log standard
    deviation, each by a head of its own.

    The encoder of `gnio_jax.models.resnet`, not pooled. 5,424,646 parameters for windows of 200
    samples, 5,031,430 for 100. Training needs the random stream `dropout`. TLIO's own channel order
    is [gyro, accel]; `gnio_jax.interop` reads its weights.
    """

    width: int = 64
    dropout: float = 0.5
    dtype: Dtype = "float32"

    def __post_init__(self) -> None:
        check_dropout(self.dropout)
        super().__post_init__()

    @nn.compact
    def __call__(self, windows: Float[jax.Array, "b n 6"], train: bool = False) -> Prediction:
        features = ResNet18(self.width, self.dtype, name="encoder")(
            windows.astype(jnp.float32), train
        )
        displacement, log_std = (
            FullyConnectedHead(self.width, 3, self.dropout, self.dtype, name=name)(features, train)
            for name in ("displacement", "log_std")
        )
        return Prediction(displacement, log_std)
