"""Learn the filter of a trained run: network and filter are one differentiable program.

python examples/learn_filter.py --workdir runs/mine
"""

import dataclasses
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax.commands import console
from gnio_jax.commands.options import parse
from gnio_jax.data.importing import InputError

DESCRIPTION = """Fit the noise model and the uncertainty head of a trained run through its own
filter.

  python examples/learn_filter.py                       (the newest run below runs/)
  python examples/learn_filter.py --workdir runs/mine --steps 200 --test-split unseen

Training looks at one window at a time. It never sees what the filter makes of the predicted
uncertainties. This example cuts the training split into pieces of a few seconds. Each piece starts
from the reference and runs through gnio_jax.filtering.run_odometry, network in the loop. The loss
is the negative log likelihood of the true velocity and displacement under the filter's estimate
and covariance, so that it counts both the errors and how well the filter knows them. The gradient
reaches the densities of the noise model and, through every update and every window, the
uncertainty head of the network. The encoder and the displacement stay as they are.

Before and after, the whole test split is estimated. The table gives ate (m), and NIS and NEES over
their degrees of freedom: 1 for a filter that knows its errors. The results are
<workdir>/learnt_filter.npz and, with --out, the table in Markdown."""

NOISE = ("gyro_density", "accel_density", "gyro_bias_walk", "accel_bias_walk")
"""The densities that are learnt: fields of the filter's options and of `NoiseModel`."""


@dataclass(frozen=True)
class Learn:
    workdir: str | None = None
    """Folder of the run. Default: the newest below runs/."""
    data_root: str | None = None
    """Folder of its dataset. Default: the run's own."""
    train_split: str | None = None
    """Split to learn from. Default: the run's own."""
    test_split: str = "test"
    """Split to report on."""
    seconds: float = 8.0
    """Length of a piece, s. The gradient is truncated at its ends."""
    batch_size: int = 8
    """Pieces in a step."""
    steps: int = 120
    """Steps of Adam."""
    learning_rate: float = 0.03
    """Learning rate of the logarithms of the noise densities; a tenth of it for the head."""
    seed: int = 0
    """Seed of the draw of the pieces."""
    out: str | None = None
    """Markdown file for a table of the result."""


class Pieces(NamedTuple):
    """Initial state, IMU and true path of pieces of recordings. Axis 0 of each field: the piece."""

    rotation: Any
    """(p, 3, 3) body to world, at the start"""
    velocity: Any
    """(p, 3) m/s, at the start"""
    position: Any
    """(p, 3) m, at the start"""
    gyro: Any
    """(p, n, 3) rad/s"""
    accel: Any
    """(p, n, 3) m/s²"""
    true_velocity: Any
    """(p, k, 3) m/s, at the end of each clone interval"""
    true_position: Any
    """(p, k, 3) m, at the end of each clone interval"""


def cut(prepared: list, intervals: int, stride: int) -> Pieces:
    """Consecutive pieces of `intervals` strides. The reference is valid throughout each."""
    length, found = intervals * stride, []
    for each in prepared:
        s = each.sequence
        for begin in range(0, len(s.time) - length, length):
            with_end = slice(begin, begin + length + 1)
            if not (s.valid[with_end].all() and np.isfinite(s.velocity[with_end]).all()):
                continue
            samples = slice(begin, begin + length)
            ends = begin + stride * np.arange(1, intervals + 1)
            rotation = Rotation.from_quat(s.orientation[begin], scalar_first=True)
            found.append(
                Pieces(
                    rotation.as_matrix(),
                    s.velocity[begin],
                    s.position[begin],
                    s.gyro[samples],
                    s.accel[samples],
                    s.velocity[ends],
                    s.position[ends],
                )
            )
    if not found:
        return Pieces(*[np.zeros((0,))] * len(Pieces._fields))
    return Pieces(*(np.stack(column) for column in zip(*found, strict=True)))


def with_head(variables: dict, head: Any) -> dict:
    """The network's variables with other parameters of the uncertainty head."""
    return {**variables, "params": {**variables["params"], "uncertainty": head}}


def negative_log_likelihood(error: jax.Array, covariance: jax.Array) -> jax.Array:
    """Mean over k of −log N(error_k; 0, covariance_k) without its constant; (k, d), (k, d, d)."""
    root = jnp.linalg.cholesky(covariance)

    def whiten(root, error):
        return jax.scipy.linalg.solve_triangular(root, error, lower=True)

    squares = jnp.sum(jax.vmap(whiten)(root, error) ** 2, axis=1)
    log_determinant = jnp.sum(jnp.log(jnp.diagonal(root, axis1=1, axis2=2)), axis=1)
    return jnp.mean(0.5 * squares + log_determinant)


def objective(model, filter_config, std, variables) -> Callable[[dict, Pieces], jax.Array]:
    """The loss of (learnt, pieces).

    `learnt` holds the logarithms of the noise densities and the uncertainty head's parameters.
    """
    from gnio_jax import filtering, models

    apply = models.Inference(model)

    def loss(learnt, pieces):
        frozen = models.inference_variables(model, with_head(variables, learnt["head"]))
        noise = filtering.NoiseModel(*jnp.exp(learnt["noise"]))

        def predict(windows):
            return apply(frozen, windows)._replace(diagnostics={})

        def loss_of_piece(piece):
            start = (piece.rotation, piece.velocity, piece.position)
            state = filtering.initial_state(filter_config, *start, std=std)
            _, history = filtering.run_odometry(
                predict, state, piece.gyro, piece.accel, filter_config, noise
            )
            velocity_error = piece.true_velocity - history.velocity
            position_error = piece.true_position - history.position
            error = jnp.concatenate([velocity_error, position_error], axis=1)
            velocity_and_position = history.covariance[:, 3:9, 3:9]
            return negative_log_likelihood(error, velocity_and_position)

        return jnp.mean(jax.vmap(loss_of_piece)(pieces))

    return loss


class TestSplit(NamedTuple):
    """Recordings to report on, and the group of each sequence."""

    prepared: list
    groups: dict[str, str]


def score(
    model, variables, filter_options, data_config, test: TestSplit, progress
) -> dict[str, float]:
    """ate, NIS and NEES of the test split, averaged over its sequences."""
    from gnio_jax import evaluation, models

    network = evaluation.Network(
        models.Inference(model), models.inference_variables(model, variables)
    )
    estimates = evaluation.estimate(
        test.prepared, network, data_config, filter_options, progress=progress
    )
    sequences = evaluation.score(estimates, test.groups).sequences.values()
    means = {}
    for name in ("ate", "nis", "nees"):
        values = [m.values[name] for m in sequences if m.values.get(name) is not None]
        means[name] = float(np.mean(values))
    return means


def create_optimizer(learning_rate: float) -> optax.GradientTransformation:
    """Adam with clipped gradients; the head learns at a tenth of the rate."""
    rates = {
        "noise": optax.adam(learning_rate),
        "head": optax.adam(0.1 * learning_rate),
    }
    by_part = optax.multi_transform(rates, {"noise": "noise", "head": "head"})
    return optax.chain(optax.clip_by_global_norm(10.0), by_part)


def learn(loss, learnt: dict, pieces: Pieces, options: Learn, workdir: Path, progress):
    """Take the steps; returns what was learnt and the loss of each step."""
    optimizer = create_optimizer(options.learning_rate)

    @jax.jit
    def step(learnt, state, batch):
        value, gradient = jax.value_and_grad(loss)(learnt, batch)
        updates, state = optimizer.update(gradient, state, learnt)
        return optax.apply_updates(learnt, updates), state, value

    rng, state, values = np.random.default_rng(options.seed), optimizer.init(learnt), []
    for index in range(options.steps):
        chosen = rng.choice(len(pieces.rotation), options.batch_size, replace=False)
        batch = Pieces(*(part[chosen] for part in pieces))
        learnt, state, value = step(learnt, state, batch)
        values.append(float(value))
        if not np.isfinite(values[-1]):
            problem = f"the loss is not finite at step {index}"
            raise InputError(workdir, problem, "give a smaller --learning-rate")
        progress(f"learning, loss {np.mean(values[-10:]):.2f}", (index + 1) / options.steps)
    return learnt, values


def load(options: Learn, run) -> tuple[list, TestSplit]:
    """Recordings to learn from, and the test split."""
    from gnio_jax import data, evaluation

    config, root = run.config, options.data_root or run.config.data_root
    learning = data.load(config.dataset, root, options.train_split or config.data.train_split)
    testing = data.load(config.dataset, root, options.test_split)
    groups = {s.name: str(s.attributes.get("group", s.name)) for s in testing}
    return (
        evaluation.prepare(learning, config.data)[0],
        TestSplit(evaluation.prepare(testing, config.data)[0], groups),
    )


def save(path: Path, noise: dict[str, float], head: Any) -> None:
    """Write the densities and the head's parameters as one .npz."""
    from gnio_jax.files import replacing

    leaves = {
        "uncertainty" + jax.tree_util.keystr(key, simple=True, separator="."): np.asarray(leaf)
        for key, leaf in jax.tree.leaves_with_path({"": head})
    }
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **noise, **leaves)


def render(title: str, before: dict[str, float], after: dict[str, float]) -> str:
    """A table in Markdown: one row for each figure."""
    rows = [f"| {name} | {before[name]:.3g} | {after[name]:.3g} |" for name in before]
    return "\n".join([f"| {title} | before | after |", "|---|---|---|", *rows])


def prepare(options: Learn, run) -> tuple[Callable, Pieces, TestSplit]:
    """The loss, the pieces to learn from and the test split."""
    from gnio_jax.evaluation import filter_setup

    config = run.config
    prepared, test = load(options, run)
    intervals = round(options.seconds / config.data.stride_seconds)
    pieces = cut(prepared, intervals, config.data.stride)
    if len(pieces.rotation) < options.batch_size:
        raise InputError(
            "--seconds",
            f"gives {len(pieces.rotation)} pieces, fewer than --batch-size {options.batch_size}",
            "make them shorter",
        )
    # The soft gate gives the χ² test a slope; the checkpoints bound the gradient's memory.
    ekf = filter_setup(config.data, config.filter)
    differentiable = dataclasses.replace(ekf.config, gate_softness=2.0, checkpoint_every=20)
    loss = objective(run.model, differentiable, ekf.initial_std, run.variables)
    return loss, pieces, test


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    options = parse(Learn, description=DESCRIPTION)
    if options.steps < 1 or options.batch_size < 1:
        raise InputError("--steps and --batch-size", "must be at least 1")

    from gnio_jax.files import replacing
    from gnio_jax.training import checkpoint

    workdir = Path(options.workdir) if options.workdir else configuration.newest_run()
    run = checkpoint.load_run(workdir)
    config = run.config
    loss, pieces, test = prepare(options, run)
    noise = {name: getattr(config.filter, name) for name in NOISE}
    learnt = {
        "noise": jnp.log(jnp.array(list(noise.values()))),
        "head": run.variables["params"]["uncertainty"],
    }
    with console.terminal() as terminal:
        progress = terminal.progress

        def estimate(what, variables, filter_options):
            tell = partial(progress, what)
            return score(run.model, variables, filter_options, config.data, test, tell)

        before = estimate("estimating as it was", run.variables, config.filter) | noise
        learnt, values = learn(loss, learnt, pieces, options, workdir, progress)
        noise = dict(zip(NOISE, np.exp(np.asarray(learnt["noise"])).tolist(), strict=True))
        variables = with_head(run.variables, learnt["head"])
        filter_options = dataclasses.replace(config.filter, **noise)
        after = estimate("estimating as learnt", variables, filter_options) | noise

    title = f"{config.dataset} {options.test_split}, n = {len(test.prepared)}"
    table = render(title, before, after)
    print(table)
    tenth = max(1, len(values) // 10)
    first, last = np.mean(values[:tenth]), np.mean(values[-tenth:])
    print(f"loss: {first:.3f} at first, {last:.3f} at last ({len(pieces.rotation)} pieces)")
    save(workdir / "learnt_filter.npz", noise, learnt["head"])
    print(f"kept: {workdir / 'learnt_filter.npz'}")
    if options.out:
        with replacing(options.out) as temporary:
            temporary.write_text(table + "\n", encoding="utf-8")


if __name__ == "__main__":
    console.run(main)
