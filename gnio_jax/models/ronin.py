"""RoNIN's ResNet (Herath, Yan and Furukawa, "RoNIN: Robust Neural Inertial Navigation in the Wild",
ICRA 2020)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Float

from gnio_jax.models.heads import ConstantUncertainty, to_axes
from gnio_jax.models.layers import check_dropout, check_output_dim
from gnio_jax.models.precision import Dtype
from gnio_jax.models.resnet import ResNet18
from gnio_jax.models.tlio import FullyConnectedHead
from gnio_jax.types import Prediction


class DisplacementRegressor(nn.Module):
    """Features of a window to its displacement by TLIO's fully connected head; the uncertainty is a
    constant. A network of this kind says which `features`.

    `width` scales every layer. Training needs the random stream `dropout`.
    """

    width: int = 64
    dropout: float = 0.5
    output_dim: int = 3
    dtype: Dtype = "float32"

    def __post_init__(self) -> None:
        check_dropout(self.dropout)
        check_output_dim(self.output_dim)
        super().__post_init__()

    @nn.compact
    def __call__(self, windows: Float[jax.Array, "b n 6"], train: bool = False) -> Prediction:
        features = self.features(windows.astype(jnp.float32), train)
        sizes = self.width, self.output_dim, self.dropout
        output = FullyConnectedHead(*sizes, self.dtype, name="displacement")(features, train)
        return Prediction(
            to_axes(output), ConstantUncertainty(name="uncertainty")(windows.shape[0])
        )

    def features(self, windows: Float[jax.Array, "b n 6"], train: bool) -> jax.Array:
        """Feature maps (b, m, 8·width)."""
        raise NotImplementedError


class RoNINResNet(DisplacementRegressor):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement; the uncertainty is a
    constant.

    Encoder and head as TLIO's, which took them from here. Published: the mean horizontal velocity
    over the window, `output_dim = 2` (4,634,882 parameters for windows of 200 samples), from [gyro,
    accel]. Ours: the displacement, which is that velocity in a window of 1 s, along three axes
    (4,635,395) unless two are asked for; then the vertical one is 0.
    """

    def features(self, windows: Float[jax.Array, "b n 6"], train: bool) -> jax.Array:
        return ResNet18(self.width, self.dtype, name="encoder")(windows, train)
