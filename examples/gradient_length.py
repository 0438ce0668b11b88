"""How far back a gradient through the filter reaches, and how it grows with the length of a piece.

    python examples/gradient_length.py [--out gradient_length.png] [--seconds 5 10 20 40 80]

Left: norm of the derivative of the last position with respect to each displacement, over the time
between both. Right: norm of the gradient of the mean squared error of the positions of a piece,
with respect to the logarithms of the noise model, over the length of the piece, with and without
truncation. One synthetic walk; its displacements are the true ones with 5 cm of white noise.
"""

import argparse
import dataclasses

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

jax.config.update("jax_enable_x64", True)
from gnio_jax import data, filtering, geometry  # noqa: E402

CONFIG = filtering.FilterConfig(
    dt=1 / 100, samples_per_clone=10, clones_per_window=10, checkpoint_every=50
)
N, CLONES, SIGMA = CONFIG.samples_per_clone, CONFIG.clones_per_window, 0.05
TRUNCATED = dataclasses.replace(CONFIG, truncate_every=100)
"""Cut after every 10 s."""


def walk_of(seconds: float) -> tuple[tuple, np.ndarray, np.ndarray, np.ndarray]:
    """The true start, the IMU's signals (n, 6), displacements (k, 3), true positions (k, 3)."""
    walk = data.resample(data.load("synthetic", split="test")[0], 100.0)
    ends = np.arange(1, round(seconds * 10) + 1) * N
    quaternions = jnp.asarray(walk.orientation[::N])
    rotation = jax.vmap(geometry.matrix_from_quaternion)(quaternions)
    forward = np.asarray(jax.vmap(geometry.yaw_rotation)(rotation))  # yaw frame → world
    displacement = np.full((len(ends), 3), np.nan)
    starts = np.arange(len(ends) - CLONES + 1)
    displacement_in_world = walk.position[starts * N + CLONES * N] - walk.position[starts * N]
    displacement[CLONES - 1 :] = np.einsum("kji,kj->ki", forward[starts], displacement_in_world)
    displacement += SIGMA * np.random.default_rng(0).standard_normal(displacement.shape)
    signals = np.concatenate([walk.gyro, walk.accel], axis=1)[: ends[-1]]
    start = (rotation[0], walk.velocity[0], walk.position[0])
    return start, signals, displacement, walk.position[ends]


def filter_positions(log_noise, start, signals, displacement, config):
    """Positions after each interval, (k, 3)."""
    noise = filtering.NoiseModel(*jnp.exp(log_noise))
    state = filtering.initial_state(filtering.Filter(config), *start)
    covariance = jnp.tile(SIGMA**2 * jnp.eye(3), (len(displacement), 1, 1))
    measurements = signals[:, :3], signals[:, 3:], displacement, covariance
    return filtering.run_filter(filtering.Filter(config, noise), state, *measurements)[1].position


def norms_by_lag(seconds: float, config: filtering.FilterConfig) -> np.ndarray:
    """Norm of the derivative of the last position with respect to each displacement."""
    start, signals, displacement, _ = walk_of(seconds)
    measured = np.isfinite(displacement).all(1)

    def last_position(values):
        displacements = jnp.where(measured[:, None], values, jnp.nan)
        return filter_positions(LOG_NOISE, start, signals, displacements, config)[-1]

    jacobian = jax.jit(jax.jacrev(last_position))(np.nan_to_num(displacement))
    return np.linalg.norm(np.asarray(jacobian), axis=(0, 2))


def norm_of_piece(seconds: float, config: filtering.FilterConfig) -> float:
    """Norm of the gradient of the mean squared error of the positions of a piece."""
    start, signals, displacement, truth = walk_of(seconds)

    def loss(log_noise):
        position = filter_positions(log_noise, start, signals, displacement, config)
        return jnp.mean(jnp.sum((position - truth) ** 2, axis=1))

    return float(jnp.linalg.norm(jax.jit(jax.grad(loss))(LOG_NOISE)))


LOG_NOISE = jnp.log(jnp.array(filtering.NoiseModel()[:4]))
KINDS = {"whole gradient": CONFIG, "cut after every 10 s": TRUNCATED}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", default="gradient_length.png", help="the picture")
    parser.add_argument("--seconds", type=float, nargs="+", default=[5, 10, 20, 40, 80])
    arguments = parser.parse_args()
    figure, (lag_axes, length_axes) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    for name, config in KINDS.items():
        norms = norms_by_lag(arguments.seconds[-1], config)
        lag = 0.1 * np.arange(len(norms))[::-1]
        lag_axes.plot(lag[norms > 0], norms[norms > 0], label=name)
        by_length = [norm_of_piece(seconds, config) for seconds in arguments.seconds]
        length_axes.plot(arguments.seconds, by_length, "o-", label=name)
        pairs = zip(arguments.seconds, by_length, strict=True)
        print(name, *(f"{seconds:g} s: {norm:.3g}" for seconds, norm in pairs))
    lag_axes.set(xlabel="time before the last position, s", ylabel="|∂ position / ∂ displacement|")
    length_axes.set(
        xlabel="length of the piece, s", ylabel="|∂ loss / ∂ log noise|, m²", xscale="log"
    )
    lag_axes.set_ylim(bottom=0)
    length_axes.set_yscale("log")
    length_axes.set_xticks(arguments.seconds, [f"{seconds:g}" for seconds in arguments.seconds])
    length_axes.minorticks_off()
    length_axes.legend()
    figure.savefig(arguments.out, dpi=130)


if __name__ == "__main__":
    main()
