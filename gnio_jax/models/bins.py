"""VeloBins' head (arXiv 2608.29720, 2026): the distribution of each axis over bins, whose mean is
the displacement and whose variance is its uncertainty."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.layers import FLOAT32, linear

CODE, EMBEDDING = 64, 32
"""Numbers of a bin's code and of its embedding."""
LOWEST, HIGHEST = 0.5, 32.0
"""Lowest and highest frequency of the code over half the range, rad (ours)."""


class BinHead(nn.Module):
    """h to a softmax over N bins for each of three axes.

    The embedding of a bin is a linear layer of sin(γ ⊙ code of its centre), with trainable γ; an
    axis has a query, a linear layer of h; logits are inner products. 64 + 32·65 + 3·32·(d + 1)
    parameters for d features, 6,848 for 48, whatever N is.

    Published: velocities in [−R, R], R = 1.1 times the largest training speed, N = 512. Ours:
    displacements in m, R an option, the frequencies of the code. Truths beyond R count as R.
    """

    bins: int = 512
    reach: float = 3.0

    @nn.compact
    def __call__(self, h: Float[Array, "b d"]) -> tuple[Float[Array, "b 3"], dict[str, Array]]:
        reach = jnp.float32(self.reach)
        centres = centres_of(reach, self.bins)
        frequency = np.geomspace(LOWEST, HIGHEST, CODE // 2).astype(np.float32)
        phase = (centres / reach)[:, None] * frequency[None]
        code = jnp.concatenate([jnp.sin(phase), jnp.cos(phase)], axis=1)
        gamma = self.param("code_scale", nn.initializers.ones, (CODE,), FLOAT32["param_dtype"])
        embedding = linear(EMBEDDING, "embedding")(jnp.sin(gamma[None] * code))
        query = linear(3 * EMBEDDING, "query")(h).reshape(-1, 3, EMBEDDING)
        logits = jnp.einsum("bad,nd->ban", query, embedding)
        shares = jax.nn.softmax(logits, axis=-1)
        mean = shares @ centres
        variance = jnp.sum(shares * (centres[None, None] - mean[..., None]) ** 2, axis=-1)
        log_std = 0.5 * jnp.log(variance + (centres[1] - centres[0]) ** 2 / 12)  # within a bin
        far = jnp.broadcast_to(reach, (h.shape[0],))
        return mean, {"log_std": log_std, "bin_logits": logits, "bin_reach": far}


def centres_of(reach: Float[Array, ""], count: int) -> Float[Array, "n"]:
    """Centres of `count` equal bins in [−reach, reach], m."""
    return reach * (2 * jnp.arange(count, dtype=jnp.float32) + 1 - count) / count


def mean_of_quarter_turns(logits: Float[Array, "4 *b 3 n"]) -> Float[Array, "*b 3 n"]:
    """Logits of the mean of four distributions, whose windows were turned by 0, 90, 180 and 270°
    and which are turned back. This is exact, because the bins are symmetric about zero."""
    parts = []
    for quarters, log_shares in enumerate(jax.nn.log_softmax(logits, axis=-1)):
        x, y, z = jnp.moveaxis(log_shares, -2, 0)
        for _ in range(quarters):
            x, y = y, mirror(x)  # back by 90°: (x, y) → (y, −x)
        parts.append(jnp.stack([x, y, z], axis=-2))
    return jax.nn.logsumexp(jnp.stack(parts), axis=0) - jnp.log(jnp.float32(len(parts)))


def mirror(logits: Float[Array, "*b n"]) -> Float[Array, "*b n"]:
    """The distribution of the opposite displacement."""
    return logits[..., ::-1]
