"""Learn the filter of a trained run: python examples/learn_filter.py --workdir runs/mine. Network
and filter are one program."""

import dataclasses
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.spatial.transform import Rotation

from gnio_jax import config as configuration
from gnio_jax.commands import console as cli
from gnio_jax.types import InputError

DESCRIPTION = """Fit the noise model and the uncertainty head of a trained run through its own filter.

  python examples/learn_filter.py                       (the newest run below runs/)
  python examples/learn_filter.py --workdir runs/mine --steps 200 --test-split unseen

The network was trained window by window; what the filter makes of its uncertainties it never saw. Here pieces of the training
split, a few seconds each and started from the reference, run through gnio_jax.filtering.run_odometry, network in the loop. The loss
is the negative log likelihood of the true velocity and displacement under the filter's own estimate and covariance, so that both
the errors and what the filter says of them count. Its gradient reaches the densities of the noise model and, through every update
and every window, the head that says how sure the network is. The encoder and the displacement are left as they are.

Before and after, the whole test split is estimated: ate (m), and NIS and NEES over their degrees of freedom, which are 1 for a
filter that knows how wrong it is. Left behind are <workdir>/learnt_filter.npz and, with --out, a table in Markdown."""


@dataclass(frozen=True)
class Learn:
    workdir: str | None = None
    """Folder of the run; without it the newest below runs/."""
    data_root: str | None = None
    """Folder of its dataset; without it the run's own."""
    train_split: str | None = None
    """Split to learn from; without it the run's own."""
    test_split: str = "test"
    """Split to report on."""
    seconds: float = 8.0
    """Length of a piece, s: the gradient is truncated at its ends."""
    batch_size: int = 8
    """Pieces in a step."""
    steps: int = 120
    """Steps of Adam."""
    learning_rate: float = 0.03
    """Of the logarithms of the noise densities; the head's is a tenth."""
    seed: int = 0
    """Which pieces."""
    out: str | None = None
    """Where a table of the result goes, as Markdown."""


class Pieces(NamedTuple):
    """Starts and IMU of pieces of recordings, and where they went: axis 0 the piece."""

    rotation: Any
    velocity: Any
    position: Any
    gyro: Any
    accel: Any
    true_velocity: Any
    true_position: Any


def cut(prepared: list, intervals: int, stride: int) -> Pieces:
    """All pieces of `intervals` strides, one after the other, in which the reference can be trusted
    throughout."""
    length, found = intervals * stride, []
    for each in prepared:
        s = each.sequence
        for begin in range(0, len(s.time) - length, length):
            ends = begin + stride * np.arange(1, intervals + 1)
            if (
                s.valid[begin : begin + length + 1].all()
                and np.isfinite(s.velocity[begin : begin + length + 1]).all()
            ):
                rotation = Rotation.from_quat(s.orientation[begin], scalar_first=True).as_matrix()
                samples = slice(begin, begin + length)
                found.append(
                    Pieces(
                        rotation,
                        s.velocity[begin],
                        s.position[begin],
                        s.gyro[samples],
                        s.accel[samples],
                        s.velocity[ends],
                        s.position[ends],
                    )
                )
    return (
        Pieces(*(np.stack(column) for column in zip(*found, strict=True)))
        if found
        else Pieces(*[np.zeros((0,))] * 7)
    )


def objective(model, filter_config, std, variables):
    """The loss of (learnt, pieces): learnt holds the logarithms of the noise densities and the
    uncertainty head's parameters."""
    from gnio_jax import filtering, models

    def loss(learnt, pieces):
        with_head = {**variables, "params": {**variables["params"], "uncertainty": learnt["head"]}}
        frozen, apply = models.freeze(model, with_head), models.Inference(model)
        noise = filtering.NoiseModel(*jnp.exp(learnt["noise"]))

        def one(piece):
            state = filtering.initial_state(
                filter_config, piece.rotation, piece.velocity, piece.position, std=std
            )
            _, history = filtering.run_odometry(
                lambda windows: apply(frozen, windows)._replace(diagnostics={}),
                state,
                piece.gyro,
                piece.accel,
                filter_config,
                noise,
            )
            error = jnp.concatenate(
                [piece.true_velocity - history.velocity, piece.true_position - history.position],
                axis=1,
            )
            root = jnp.linalg.cholesky(history.covariance[:, 3:9, 3:9])
            white = jax.vmap(lambda r, e: jax.scipy.linalg.solve_triangular(r, e, lower=True))(
                root, error
            )
            return jnp.mean(
                0.5 * jnp.sum(white**2, axis=1)
                + jnp.sum(jnp.log(jnp.diagonal(root, axis1=1, axis2=2)), axis=1)
            )

        return jnp.mean(jax.vmap(one)(pieces))

    return loss


def scored(model, variables, options, prepared, config, groups, progress, what):
    """ate, NIS and NEES of the test split, averaged over its sequences."""
    from gnio_jax import evaluation, models

    network = evaluation.Network(models.Inference(model), models.freeze(model, variables))
    estimates = evaluation.estimate(
        prepared, network, config.data, options, progress=lambda share: progress(what, share)
    )
    sequences = evaluation.score(estimates, groups).sequences.values()
    return {
        name: float(np.mean([m.values[name] for m in sequences if m.values.get(name) is not None]))
        for name in ("ate", "nis", "nees")
    }


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    options = cli.parse(Learn, description=DESCRIPTION)
    if options.steps < 1 or options.batch_size < 1:
        raise InputError("--steps and --batch-size", "must be at least 1")

    from gnio_jax import data, evaluation
    from gnio_jax.files import replacing
    from gnio_jax.training import checkpoint

    workdir = Path(options.workdir) if options.workdir else configuration.newest_run()
    run = checkpoint.load_run(workdir)
    config, root = run.config, options.data_root or run.config.data_root
    parts = {}
    for split in (options.train_split or config.data.train_split, options.test_split):
        sequences = data.load(config.dataset, root, split)
        parts[split] = (
            evaluation.prepare(sequences, config.data)[0],
            {s.name: str(s.attributes.get("group", s.name)) for s in sequences},
        )
    (learning, _), (testing, groups) = (
        parts[options.train_split or config.data.train_split],
        parts[options.test_split],
    )

    the_filter = evaluation.filter_setup(config.data, config.filter)
    soft = dataclasses.replace(the_filter.config, gate_softness=2.0, checkpoint_every=20)
    intervals = round(options.seconds / config.data.stride_seconds)
    pieces = cut(learning, intervals, config.data.stride)
    if len(pieces.rotation) < options.batch_size:
        raise InputError(
            "--seconds",
            f"gives {len(pieces.rotation)} pieces, fewer than --batch-size {options.batch_size}",
            "make them shorter",
        )
    names = the_filter.noise._fields
    learnt = {
        "noise": jnp.log(jnp.array(the_filter.noise)),
        "head": run.variables["params"]["uncertainty"],
    }
    optimizer = optax.chain(
        optax.clip_by_global_norm(10.0),
        optax.multi_transform(
            {
                "noise": optax.adam(options.learning_rate),
                "head": optax.adam(0.1 * options.learning_rate),
            },
            {"noise": "noise", "head": "head"},
        ),
    )
    loss = objective(run.model, soft, the_filter.initial_std, run.variables)

    @jax.jit
    def step(learnt, state, batch):
        value, gradient = jax.value_and_grad(loss)(learnt, batch)
        updates, state = optimizer.update(gradient, state, learnt)
        return optax.apply_updates(learnt, updates), state, value

    rng, state, values = np.random.default_rng(options.seed), optimizer.init(learnt), []
    with cli.progress() as progress:
        before = scored(
            run.model,
            run.variables,
            config.filter,
            testing,
            config,
            groups,
            progress,
            "estimating as it was",
        )
        for index in range(options.steps):
            chosen = rng.choice(len(pieces.rotation), options.batch_size, replace=False)
            batch = Pieces(*(part[chosen] for part in pieces))
            learnt, state, value = step(learnt, state, batch)
            values.append(float(value))
            if not np.isfinite(values[-1]):
                raise InputError(
                    workdir,
                    f"the loss is not finite at step {index}",
                    "give a smaller --learning-rate",
                )
            progress(f"learning, loss {np.mean(values[-10:]):.2f}", (index + 1) / options.steps)
        found = dict(zip(names, np.exp(np.asarray(learnt["noise"])).tolist(), strict=True))
        variables = {
            **run.variables,
            "params": {**run.variables["params"], "uncertainty": learnt["head"]},
        }
        after = scored(
            run.model,
            variables,
            dataclasses.replace(config.filter, **found),
            testing,
            config,
            groups,
            progress,
            "estimating as learnt",
        )

    rows = [f"| {name} | {before[name]:.3g} | {after[name]:.3g} |" for name in before]
    rows += [
        f"| {name} | {getattr(the_filter.noise, name):.3g} | {found[name]:.3g} |" for name in names
    ]
    table = "\n".join(
        [
            f"| {config.dataset} {options.test_split}, n = {len(testing)} | before | after |",
            "|---|---|---|",
            *rows,
        ]
    )
    tenth = max(1, len(values) // 10)
    print(table)
    print(
        f"loss: {np.mean(values[:tenth]):.3f} at first, {np.mean(values[-tenth:]):.3f} at last ({len(pieces.rotation)} pieces)"
    )
    head = {
        "uncertainty" + jax.tree_util.keystr(path, simple=True, separator="."): np.asarray(leaf)
        for path, leaf in jax.tree.leaves_with_path({"": learnt["head"]})
    }
    with replacing(workdir / "learnt_filter.npz") as temporary, open(temporary, "wb") as file:
        np.savez(file, **found, **head)
    print(f"kept: {workdir / 'learnt_filter.npz'}")
    if options.out:
        with replacing(options.out) as temporary:
            temporary.write_text(table + "\n", encoding="utf-8")


if __name__ == "__main__":
    cli.run(main)
