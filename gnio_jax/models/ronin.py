"""RoNIN's ResNet (Herath, Yan and Furukawa, "RoNIN: Robust Neural Inertial Navigation in the Wild",
ICRA 2020), and what DeepILS shares with it."""

from __future__ import annotations

from typing import Literal

from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, Probability
from gnio_jax.models.heads import ConstantUncertainty, to_axes
from gnio_jax.models.layers import Normalisation, checked_windows
from gnio_jax.models.resnet import ResNet18
from gnio_jax.models.tlio import FullyConnectedHead
from gnio_jax.types import Prediction


class DisplacementRegressor(nn.Module):
    """A network that maps features of a window to its displacement by TLIO's fully connected head;
    the uncertainty is a constant. Each such network has its own `features`.

    `width` scales every layer. Training needs the random stream `dropout`.
    """

    width: Count = 64
    dropout: Probability = 0.5
    output_dim: Literal[2, 3] = 3

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        features = self.features(checked_windows(windows), train)
        displacement = to_axes(self.head(name="displacement")(features, train))
        log_std = ConstantUncertainty(name="uncertainty")(features, train)
        return Prediction(displacement, log_std)

    def features(self, windows: Float[Array, "b n 6"], train: bool) -> Array:
        """Feature maps (b, m, 8·width)."""
        raise NotImplementedError

    def head(self, name: str) -> FullyConnectedHead:
        """The head, which the network calls `name`."""
        return FullyConnectedHead(self.width, self.output_dim, self.dropout, name=name)


class RoNINResNet(DisplacementRegressor):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement; the uncertainty is a
    constant.

    Encoder and head are those of TLIO, which took them from RoNIN. Published: the mean horizontal
    velocity over the window, `output_dim = 2` (4,634,882 parameters for windows of 200 samples),
    from [gyro, accel]. Ours: the displacement, which is that velocity in a window of 1 s, along
    three axes (4,635,395) unless two are asked for; then the vertical one is 0.

    `normalisation` "group" is the network of RIO (Cao et al., CVPR 2022), of as many parameters.
    Its number of groups is not published; ours is `layers.MOST_GROUPS`.
    """

    winograd: bool = False
    normalisation: Normalisation = "batch"

    def features(self, windows: Float[Array, "b n 6"], train: bool) -> Array:
        encoder = ResNet18(self.width, self.winograd, self.normalisation, name="encoder")
        return encoder(windows, train)

    def head(self, name: str) -> FullyConnectedHead:
        options = self.width, self.output_dim, self.dropout, self.normalisation
        return FullyConnectedHead(*options, name=name)
