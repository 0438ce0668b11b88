"""RIDI (Yan, Shan and Furukawa, "RIDI: Robust IMU Double Integration", ECCV 2018): support vectors
for each placement of the phone. `training.support_vectors` fits them; this module predicts."""

from __future__ import annotations

import itertools

import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count
from gnio_jax.models.heads import ConstantUncertainty, to_axes
from gnio_jax.models.layers import checked_windows, repeat_ends
from gnio_jax.types import GRAVITY, Prediction

SMOOTHING = 2.0
"""Standard deviation of the Gaussian that smooths the samples, in samples."""


class RIDI(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to the horizontal displacement, by ε-SVR
    with a Gaussian kernel for each placement and axis, the placement by C-SVC; the uncertainty is a
    constant.

    The features are all smoothed samples of the window, gravity taken off: 1,200 for 200 samples,
    and γ is their number's inverse. `supports` and `class_supports` are the rows of each machine,
    of which those that are not needed have the weight 0; their values are fitted.

    Published: velocities in a frame with gravity on one axis and the device's yaw, at every tenth
    sample; ours: the displacement over the window, in the frame of its start.
    """

    placements: Count = 1
    supports: Count = 1000
    class_supports: Count = 1
    output_dim = 2
    trained_by = "support_vectors"
    fitted_options = ("placements", "supports", "class_supports")

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        x = features(checked_windows(windows))
        vectors = self._part("support", (self.placements, 2, self.supports, x.shape[1]))
        weights = self._part("weight", (self.placements, 2, self.supports))
        offset = self._part("offset", (self.placements, 2))
        kernels = kernel(x, vectors.reshape(-1, x.shape[1])).reshape(len(x), *weights.shape)
        of_placements = jnp.einsum("bpas,pas->bpa", kernels, weights) + offset[None]
        of_class = jnp.ones((len(x), 1), jnp.float32)
        if self.placements > 1:
            pairs = list(itertools.combinations(range(self.placements), 2))
            rows = self._part("class_support", (self.class_supports, x.shape[1]))
            pair_weights = self._part("class_weight", (len(pairs), self.class_supports))
            pair_offset = self._part("class_offset", (len(pairs),))
            decision = kernel(x, rows) @ pair_weights.T + pair_offset[None]
            winners = jnp.where(decision > 0, *np.array(pairs).T[:, None])
            votes = (winners[..., None] == np.arange(self.placements)[None, None]).sum(axis=1)
            of_class = nn.one_hot(jnp.argmax(votes, axis=1), self.placements, dtype=jnp.float32)
        displacement = to_axes(jnp.einsum("bp,bpa->ba", of_class, of_placements))
        log_std = ConstantUncertainty(name="uncertainty")(displacement, train)
        return Prediction(displacement, log_std, {"placement": of_class})

    @nn.nowrap
    def _part(self, name: str, shape: tuple[int, ...]) -> Array:
        return self.param(name, nn.initializers.normal(1.0), shape, jnp.float32)


def features(windows: Float[Array, "b n 6"]) -> Float[Array, "b f"]:
    """All samples, gravity taken off, smoothed; beyond its ends a window repeats its first and last
    sample."""
    reach = int(4 * SMOOTHING)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / SMOOTHING) ** 2)
    weights = np.float32(weights / weights.sum())
    x = windows - jnp.array([0, 0, GRAVITY, 0, 0, 0], jnp.float32)[None, None]
    wide, samples = repeat_ends(x, reach, reach, axis=1), windows.shape[1]
    smooth = sum(weight * wide[:, k : k + samples] for k, weight in enumerate(weights))
    return jnp.asarray(smooth).reshape(len(windows), -1)


def kernel(x: Float[Array, "b f"], rows: Float[Array, "s f"]) -> Float[Array, "b s"]:
    """exp(−γ ‖x − row‖²), γ the inverse of the number of features."""
    squared = jnp.sum(x**2, axis=1)[:, None] + jnp.sum(rows**2, axis=1)[None] - 2 * x @ rows.T
    return jnp.exp(-jnp.maximum(squared, 0) / x.shape[1])
