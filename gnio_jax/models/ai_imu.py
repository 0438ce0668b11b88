"""AI-IMU's network (Brossard, Barrau and Bonnabel, "AI-IMU Dead-Reckoning", IEEE T-IV 2020): the
trust in the non-holonomic constraint of a car, from the samples of its IMU.

It predicts no displacement. It is trained in the filter's loop (`through_filter.learn`), where
`filtering.nonholonomic.NonHolonomic` takes its factors.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.models.airio import body_axes
from gnio_jax.models.layers import FLOAT32, checked_windows, linear
from gnio_jax.types import GRAVITY, NONHOLONOMIC_LOG_FACTOR, Prediction

SAMPLES = 17
"""Samples on which an output depends: 5, and four more steps of 3."""
FEATURES = 32
DECADES = 3.0
"""Largest logarithm to base 10 of the factor of a variance."""
MEAN = np.array([0, 0, GRAVITY, 0, 0, 0], np.float32)
STD = np.array([1.0, 1.0, 1.0, 0.1, 0.1, 0.1], np.float32)
"""What is subtracted from [accel m/s², gyro rad/s], and by what they are divided."""


class AIIMU(nn.Module):
    """Windows of 12 channels (`data.window_rotation: body_axes`) to the logarithms of the factors
    of the standard deviations of a car's velocity to the left and up.

    The samples in the body are normalised. Two convolutions of 5 samples follow, the second one
    with dilation 3, each with ReLU, then a linear layer and tanh: 6,210 parameters. A variance has
    the factor 10^(3 tanh), between 1/1000 and 1000.

    Published: an output for every sample, at 100 Hz, with edges that are repeated after each
    convolution, 4 samples on both sides. So the output of a sample depends on the 8 samples before
    it and the 8 after it, and is not causal. Ours: one output for the last 17 samples of a window,
    no padding, so it is causal, and the middle of what it sees is 8 samples before the measurement;
    the normalisation, where the published one has the statistics of the training set; samples
    without the filter's biases; zeros in the linear layer at first, with which the factors are 1
    (published: a hundredth of PyTorch's start); no dropout (published: 0.5 behind each ReLU),
    because the network runs in the filter's loop in training as in an evaluation.
    """

    channels = 12
    predicts_displacement = False

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 12"], train: bool = False) -> Prediction:
        windows = checked_windows(windows, self.channels)
        if windows.shape[1] < SAMPLES:
            samples = windows.shape[1]
            raise ValueError(f"windows must have at least {SAMPLES} samples, found {samples}")
        windows = windows[:, -SAMPLES:]
        imu = windows[..., :6].reshape(*windows.shape[:2], 2, 3)
        body = jnp.einsum("bnij,bnki->bnkj", body_axes(windows), imu)
        x = (body.reshape(*windows.shape[:2], 6) - MEAN[None, None]) / STD[None, None]
        for number, dilation in ((1, 1), (2, 3)):
            x = nn.Conv(
                FEATURES,
                (5,),
                kernel_dilation=dilation,
                padding="VALID",
                name=f"filter{number}",
                **FLOAT32,
            )(x)
            x = nn.relu(x)
        last = linear(2, "log_std", kernel_init=nn.initializers.zeros)
        log_factor = 0.5 * math.log(10) * DECADES * jnp.tanh(last(x[:, 0]))
        nothing = jnp.full((len(windows), 3), jnp.nan, jnp.float32)
        diagnostics: dict[str, jax.Array] = {NONHOLONOMIC_LOG_FACTOR: log_factor}
        return Prediction(nothing, jnp.zeros_like(nothing), diagnostics)
