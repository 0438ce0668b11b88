"""A network of your own: GNIO with two layers in the place of its gated head.

    python examples/deeper.py train --config quickstart --model.name deeper --workdir runs/deeper
    python examples/deeper.py evaluate --network runs/deeper

Every command of gnio is there, and knows the network.
"""

from flax import linen as nn

from gnio_jax import models
from gnio_jax.commands import app
from gnio_jax.models.gnio import GNIO


class TwoLayers(nn.Module):
    """d̂ = W₂ ReLU(W₁ h + b₁) + b₂."""

    @nn.compact
    def __call__(self, h):
        hidden = nn.relu(nn.Dense(64, name="hidden")(h))
        return nn.Dense(3, name="displacement")(hidden), {}


class Deeper(GNIO):
    """GNIO with two layers in the place of the gated head."""

    @nn.nowrap
    def displacement_head(self):
        return TwoLayers(name="head")


models.register("deeper", Deeper)

if __name__ == "__main__":
    app.main()
