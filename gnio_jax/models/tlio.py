"""TLIO's network (Liu et al., "TLIO: Tight Learned Inertial Odometry", IEEE RA-L 2020), and the
fully connected head that it shares."""

from __future__ import annotations

from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, Probability
from gnio_jax.models.layers import Normalisation, checked_windows, conv_norm, linear
from gnio_jax.models.resnet import ResNet18
from gnio_jax.types import Prediction

SMALL = nn.initializers.normal(0.01)


class TLIO(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement and log standard
    deviation, each by a head of its own.

    It has the encoder of `gnio_jax.models.resnet`, without pooling, and 5,424,646 parameters for
    windows of 200 samples, 5,031,430 for 100. Training needs the random stream `dropout`. TLIO's
    own channel order is [gyro, accel]; `gnio_jax.interop` reads its weights.
    """

    width: Count = 64
    dropout: Probability = 0.5
    winograd: bool = False

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        encoder = ResNet18(self.width, self.winograd, name="encoder")
        features = encoder(checked_windows(windows), train)
        displacement, log_std = (
            FullyConnectedHead(self.width, 3, self.dropout, name=name)(features, train)
            for name in ("displacement", "log_std")
        )
        return Prediction(displacement, log_std)


class FullyConnectedHead(nn.Module):
    """Feature maps (b, m, 8·width) to `outputs` numbers per window: 1×1 convolution and
    normalisation, flattening, three linear layers.

    This is the head of TLIO and RoNIN. Its sizes (128 channels, 512 features) are given only in
    their code; other widths than 64 scale both, for small machines. The maps are flattened channel
    by channel, as in PyTorch, so that weights trained there fit. Linear kernels start at N(0,
    0.01), biases at 0. The number of parameters depends on m, and so on the length of the window.
    """

    width: int
    outputs: int
    dropout: float
    normalisation: Normalisation = "batch"

    @nn.compact
    def __call__(self, features: Float[Array, "b m d"], train: bool) -> Float[Array, "b k"]:
        x = conv_norm(features, 2 * self.width, 1, 1, train, "neck_conv", self.normalisation)
        x = x.transpose(0, 2, 1).reshape(x.shape[0], -1)
        for name in ("fc1", "fc2"):
            x = nn.relu(linear(8 * self.width, name, kernel_init=SMALL)(x))
            x = nn.Dropout(self.dropout, deterministic=not train)(x)
        return linear(self.outputs, "fc3", kernel_init=SMALL)(x)
