"""iMoT (Nguyen et al., "iMoT: Inertial Motion Transformer for Inertial Navigation", AAAI 2025,
arXiv 2412.12190), written from the text of the publication."""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import Array, Float

from gnio_jax.config.schema import Count, Positive, Probability
from gnio_jax.models.heads import ConstantUncertainty, to_axes
from gnio_jax.models.layers import (
    attend,
    attention,
    checked_windows,
    layer_norm,
    linear,
    repeat_ends,
)
from gnio_jax.types import Prediction

TREND_SPANS = (9, 3)
"""Numbers of samples of the two successive moving averages that make the trend."""
MODALITIES = 2
"""Acceleration and angular rate, three channels each."""
PARTS = 3
"""Tokens of every channel: itself, its trend, its season."""


class IMoT(nn.Module):
    """Windows [accel, gyro] in the gravity-aligned frame to displacement, the weighted sum of
    particles; the uncertainty is a constant.

    A token is the whole series of a channel: T samples in a window of T. In the encoder the six
    channels, their trends and their seasons attend to one another. The decoder moves particles,
    which are velocities that start as parameters, by attention to these tokens. Published:
    horizontal velocities, `output_dim = 2`. Ours: velocities are in metres per duration of the
    window (m/s for the publication's 1 s), so that their sum is the displacement, m, along three
    axes unless two are asked for; then the vertical one is 0.

    The publication's 14.49 M parameters contradict its two encoder and two decoder layers. This
    class has four and four, with 4.58 T hidden units in the feed-forward parts, which gives
    14,492,810 parameters for T = 200 and two axes. `IMoTText` has the layers of the text and
    7,137,482 parameters. A third axis adds 329 at T = 200, in the particles and their last layer.

    Ours, where the publication gives no details, and chosen to give these numbers: T features
    everywhere, 2 T inside the attentions to the tokens; GELU in the spatial blocks, else ReLU; sums
    normalised after every part; dropout 0.1 before every sum; positions by sinusoids over the
    tokens' numbers, or over a particle's coordinates. `heads` is the largest number of heads: the
    largest divisor of T up to it is taken, 8 for 200 samples and 5 for 100. Training needs the
    random stream `dropout`.

    Diagnostics: `particles` (b, p, output_dim), metres per duration of the window, and
    `particle_weights` (b, p), which sum to 1.
    """

    encoder_layers: Count = 4
    decoder_layers: Count = 4
    ffn_ratio: Positive = 4.58
    heads: Count = 8
    particles: Count = 128
    dropout: Probability = 0.1
    output_dim: Literal[2, 3] = 3

    @nn.compact
    def __call__(self, windows: Float[Array, "b n 6"], train: bool = False) -> Prediction:
        channels = checked_windows(windows).transpose(0, 2, 1)
        batch, _, samples = channels.shape
        heads, ffn = head_count(samples, self.heads), max(round(self.ffn_ratio * samples), 1)
        tokens = positions = channels  # the first layer replaces both
        for layer in range(self.encoder_layers):
            encoder = EncoderLayer(heads, ffn, self.dropout, name=f"encoder_{layer + 1}")
            tokens, positions = encoder(channels, train)
            # The three parts of a channel become one series again. A layer that changes nothing
            # would leave this series as it was.
            parts = tokens.reshape(batch, MODALITIES, PARTS, 3, samples)
            channels = parts.sum(axis=2).reshape(batch, 6, samples) / 2

        start = self.param(
            "particles", nn.initializers.normal(1.0), (self.particles, self.output_dim), jnp.float32
        )
        particles = jnp.broadcast_to(start[None], (batch, *start.shape))
        content = jnp.zeros((batch, self.particles, samples), jnp.float32)
        locate = Perceptron((samples, samples), name="particle_positions")
        refine = Perceptron((samples, self.output_dim), name="refinement")
        for layer in range(self.decoder_layers):
            coordinates = locate(sinusoids_of(particles, samples))
            decoder = ParticleDecoderLayer(heads, ffn, self.dropout, name=f"decoder_{layer + 1}")
            content = decoder(content, coordinates, tokens, positions, train)
            particles = particles + refine(content)
        weights = AttentionScores(name="scores")(content)
        velocity = jnp.einsum("bp,bpk->bk", weights, particles)
        log_std = ConstantUncertainty(name="uncertainty")(windows, train)
        diagnostics = {"particles": particles, "particle_weights": weights}
        return Prediction(to_axes(velocity), log_std, diagnostics)


class IMoTText(IMoT):
    """iMoT as its text describes it: two encoder and two decoder layers, 4 T hidden units.
    7,137,482 parameters for T = 200 and two axes."""

    encoder_layers: Count = 2
    decoder_layers: Count = 2
    ffn_ratio: Positive = 4.0


class EncoderLayer(nn.Module):
    """Six channels to their eighteen tokens, acceleration's nine first, and the tokens' adaptive
    positions.

    Attention with queries and keys x + e and values x, then a feed-forward part. The input to which
    each is added passes a spatial block first.
    """

    heads: int
    ffn: int
    dropout: float

    @nn.compact
    def __call__(
        self, channels: Float[Array, "b c n"], train: bool
    ) -> tuple[Float[Array, "b k n"], Float[Array, "b k n"]]:
        drop = nn.Dropout(self.dropout, deterministic=not train)
        x = decouple(channels)
        samples = x.shape[-1]
        sinusoid_positions = sinusoids(jnp.arange(x.shape[1], dtype=jnp.float32), samples)
        e = Perceptron((samples, samples), name="positions")(x) * sinusoid_positions[None]
        y = attention(self.heads, "attention")(x + e, x + e, x)
        spatial = SpatialBlock(name="attention_spatial")(x)
        x = layer_norm("attention_norm")(spatial + drop(y))
        y = Perceptron((self.ffn, samples), name="ffn")(x)
        spatial = SpatialBlock(name="ffn_spatial")(x)
        return layer_norm("ffn_norm")(spatial + drop(y)), e


class SpatialBlock(nn.Module):
    """Acceleration's and angular rate's tokens side by side in time, mixed over three neighbouring
    tokens, gated, and mixed again.

    A convolution over three tokens with 2 T channels, times the sigmoid of its mean over the
    tokens, then a 1×1 convolution and GELU.
    """

    @nn.compact
    def __call__(self, x: Float[Array, "b k n"]) -> Float[Array, "b k n"]:
        features = 2 * x.shape[-1]
        y = jnp.concatenate(jnp.split(x, MODALITIES, axis=1), axis=2)
        padded = jnp.pad(y, ((0, 0), (1, 1), (0, 0)))
        three = jnp.concatenate([padded[:, :-2], y, padded[:, 2:]], axis=2)
        y = linear(features, "conv3")(three)
        y = y * nn.sigmoid(y.mean(axis=1, keepdims=True))
        y = nn.gelu(linear(features, "conv1")(y), approximate=False)
        return jnp.concatenate(jnp.split(y, MODALITIES, axis=2), axis=1)


class ParticleDecoderLayer(nn.Module):
    """Content of the particles: attention to one another, to acceleration's tokens and to angular
    rate's, both fused, feed-forward.

    In the attention among particles, queries and keys are the sum of a projected content and a
    projected position. In the attention to the tokens they are content and position side by side
    (conditional attention), and values are contents alone.
    """

    heads: int
    ffn: int
    dropout: float

    @nn.compact
    def __call__(
        self,
        content: Float[Array, "b p n"],
        coordinates: Float[Array, "b p n"],
        tokens: Float[Array, "b k n"],
        positions: Float[Array, "b k n"],
        train: bool,
    ) -> Float[Array, "b p n"]:
        drop = nn.Dropout(self.dropout, deterministic=not train)
        samples = content.shape[-1]
        attended = ParticleAttention(self.heads, name="self")(content, coordinates)
        x = layer_norm("self_norm")(content + drop(attended))
        contexts = []
        halves = (jnp.split(pair, MODALITIES, axis=1) for pair in (tokens, positions))
        for name, token, position in zip(("accel", "gyro"), *halves, strict=True):
            query = jnp.concatenate([x, coordinates], axis=-1)
            key = jnp.concatenate([token, position], axis=-1)
            y = attention(self.heads, name, samples)(query, key, token)
            contexts.append(layer_norm(f"{name}_norm")(x + drop(y)))
        x = Perceptron((samples, samples), name="fusion")(jnp.concatenate(contexts, axis=-1))
        y = Perceptron((self.ffn, samples), name="ffn")(x)
        return layer_norm("ffn_norm")(x + drop(y))


class ParticleAttention(nn.Module):
    """Self-attention whose queries and keys are W_c content + W_p position, and whose values are
    projected contents."""

    heads: int

    @nn.compact
    def __call__(
        self, content: Float[Array, "b p n"], coordinates: Float[Array, "b p n"]
    ) -> Float[Array, "b p n"]:
        features = content.shape[-1]
        project = partial(linear, features)
        query, key = (
            project(f"{name}_content")(content) + project(f"{name}_position")(coordinates)
            for name in ("query", "key")
        )
        query, key, value = (
            x.reshape(*x.shape[:2], self.heads, -1) for x in (query, key, project("value")(content))
        )
        context = attend(query, key, value)
        return project("output")(context.reshape(content.shape))


class AttentionScores(nn.Module):
    """Weights of the particles: for every feature two linear layers from all particles to all
    particles, then the mean over features and a softmax."""

    @nn.compact
    def __call__(self, content: Float[Array, "b p n"]) -> Float[Array, "b p"]:
        particles = content.shape[1]
        scores = Perceptron((particles, particles), name="mlp")(content.transpose(0, 2, 1))
        return nn.softmax(scores.mean(axis=1), axis=-1)


class Perceptron(nn.Module):
    """Linear, ReLU, linear."""

    features: tuple[int, int]

    @nn.compact
    def __call__(self, x: Float[Array, "*b n"]) -> Float[Array, "*b d"]:
        inside, outside = self.features
        hidden = nn.relu(linear(inside, "hidden")(x))
        return linear(outside, "output")(hidden)


def decouple(channels: Float[Array, "b c n"]) -> Float[Array, "b k n"]:
    """For each modality its three channels, their trends MA3(MA9(x)) and their seasons x − trend:
    (b, 6, n) to (b, 18, n)."""
    trend = channels
    for span in TREND_SPANS:
        trend = moving_average(trend, span)
    parts = jnp.stack([channels, trend, channels - trend], axis=1)
    batch, _, _, samples = parts.shape
    by_modality = parts.reshape(batch, PARTS, MODALITIES, 3, samples).swapaxes(1, 2)
    return by_modality.reshape(batch, PARTS * MODALITIES * 3, samples)


def moving_average(x: Float[Array, "b c n"], span: int) -> Float[Array, "b c n"]:
    """Centred mean over an odd number of samples; the first and the last sample are repeated beyond
    the ends (ours)."""
    padded = repeat_ends(x, span // 2, span // 2, axis=2)
    terms = [padded[..., i : i + x.shape[-1]] for i in range(span)]
    return sum(terms[1:], terms[0]) / span


def sinusoids(x: Float[Array, "*b"], features: int) -> Float[Array, "*b d"]:
    """sin(x ω_i), then cos(x ω_i), with ω from 1 down towards 1e-4 in equal ratios; an odd last
    feature is 0."""
    half = features // 2
    frequencies = jnp.exp(-jnp.log(jnp.float32(1e4)) * jnp.arange(half, dtype=jnp.float32) / half)
    angles = jnp.einsum("...,i->...i", x, frequencies)
    return _pad_features(jnp.concatenate([jnp.sin(angles), jnp.cos(angles)], axis=-1), features)


def sinusoids_of(points: Float[Array, "b p k"], features: int) -> Float[Array, "b p d"]:
    """The sinusoids of 2π times every coordinate, side by side; features that do not divide evenly
    are 0."""
    axis_features = 2 * (features // (2 * points.shape[-1]))
    values = sinusoids(2 * jnp.pi * points, axis_features)
    return _pad_features(values.reshape(*points.shape[:2], -1), features)


def head_count(features: int, most: int) -> int:
    """The largest number of heads up to `most` that divides the features."""
    return max(heads for heads in range(1, most + 1) if features % heads == 0)


def _pad_features(x: Float[Array, "*b k"], features: int) -> Float[Array, "*b d"]:
    return jnp.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, features - x.shape[-1])])
