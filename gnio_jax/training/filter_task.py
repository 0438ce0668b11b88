"""Training through the filter: segments of recordings, with the network in the filter's loop
(ours).

The filter runs in float64 (JAX's x64 must be on); what is trained, and the optimizer, are float32.
The filter's settings are trained as numbers without bounds (`filtering.settings`), which lie
beside the network's variables as the collection "filter".
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path as FilePath
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import linen as nn
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from gnio_jax import models, parallel
from gnio_jax.config import FilterSettings, TrainConfig
from gnio_jax.filtering import (
    FilterConfig,
    FilterHistory,
    initial_state,
    over_sequences,
    run_odometry,
)
from gnio_jax.filtering.history import POSITION
from gnio_jax.filtering.settings import (
    filter_setup,
    free_parameters,
    is_below,
    with_free_parameters,
    with_written_parameters,
)
from gnio_jax.reporting import Reporter
from gnio_jax.training import optimizer, window_task
from gnio_jax.training.filter_losses import (
    HORIZON_SECONDS,
    FilterLosses,
    filter_losses,
    normalised_squares,
)
from gnio_jax.training.segments import (
    Path,
    Segment,
    SegmentSource,
    StartErrors,
    cut_segment,
    draw_start_errors,
    random_starts,
    segment_source,
    start_rotation,
    turned_segment,
)
from gnio_jax.training.window_task import Progress, Row, Task, TrainState

CHECKPOINT_EVERY = 20
"""Clone intervals between the states that the backward pass keeps."""
TRUNCATE_SECONDS = 10.0
"""The filter's state is carried on without gradient after every so many seconds."""
START_SPREAD = 1.0
"""Each segment starts off the reference by errors drawn from the filter's initial standard
deviations times this."""
GATE_SOFTNESS = 2.0
"""Slope of the χ² gate in training (`FilterConfig.gate_softness`); validation has the gate that
evaluation has."""
SKIP_ABOVE = 1000.0
"""A step is skipped, and counted in the log, when the norm of its gradient is above this, or
anything in it is not finite, or the filter diverged."""


# What is trained
# ------------------------------------------------------------------------------------------------

FILTER_PARTS = {
    "noise": (
        "noise.gyro_density",
        "noise.accel_density",
        "noise.gyro_bias_walk",
        "noise.accel_bias_walk",
    ),
    "measurement": ("noise.measurement_scale", "noise.std_factor", "noise.correlation"),
    "start": ("start",),
}
"""Numbers of `FilterSettings` that each part of the filter has, by their paths."""
DIGITS = 5
"""That float32 keeps of a value whose logarithm it holds."""
HEADS = ("head", "displacement")
"""Names of the networks' modules from which the displacement comes."""

Trainable = dict[str, dict[str, Any]]
"""Variables that are trained, by collection: "params" and "filter"; none of them empty."""


def filter_numbers(settings: FilterSettings) -> dict[str, Float[jax.Array, ""]]:
    """The collection "filter": a number for each setting that is not switched off."""
    paths = [path for of_part in FILTER_PARTS.values() for path in of_part]
    return {name: jnp.float32(each) for name, each in free_parameters(settings, paths).items()}


def trained_settings(settings: FilterSettings, numbers: dict[str, Any]) -> FilterSettings:
    """The filter's settings with the values that were trained, as five digits."""
    return with_written_parameters(settings, numbers, DIGITS)


def trainable(variables: Any, learn: Iterable[str]) -> Trainable:
    """The variables that the parts `learn` consist of, out of the network's and the filter's."""
    parts = set(learn)
    if "all" in parts:
        parts = {*FILTER_PARTS, "uncertainty", "head", "encoder"}
    paths = [path for part in parts for path in FILTER_PARTS.get(part, ())]
    params, numbers = variables["params"], variables["filter"]
    found = {
        "params": {name: leaf for name, leaf in params.items() if module_part(name) in parts},
        "filter": {
            name: number
            for name, number in numbers.items()
            if any(is_below(name, path) for path in paths)
        },
    }
    return {collection: tree for collection, tree in found.items() if tree}


def module_part(module: str) -> str:
    """The part of the network that one of its modules belongs to."""
    if module in optimizer.UNCERTAINTY:
        return "uncertainty"
    return "head" if module in HEADS else "encoder"


def merged(variables: Any, trained: Trainable) -> Any:
    """All variables, with those that are trained in their places."""
    return {
        collection: {**tree, **trained.get(collection, {})}
        for collection, tree in variables.items()
    }


# The filter over segments
# ------------------------------------------------------------------------------------------------


class Filtered(NamedTuple):
    """What became of a segment."""

    losses: FilterLosses
    healthy: Bool[jax.Array, ""]
    """Whether the filter never diverged."""
    nis: Float[jax.Array, ""]
    """Mean normalised innovation squared over its degrees of freedom."""
    nees: Float[jax.Array, ""]
    """Mean normalised error squared of the position over its degrees of freedom."""


def filter_config(config: TrainConfig, training: bool) -> FilterConfig:
    """The filter of a segment: in training with a gate that has a slope and a gradient that is cut,
    else as evaluation has it."""
    ekf = filter_setup(config.data, config.filter).config
    if not training:
        return ekf
    return dataclasses.replace(
        ekf,
        gate_softness=GATE_SOFTNESS,
        checkpoint_every=CHECKPOINT_EVERY,
        truncate_every=round(TRUNCATE_SECONDS / config.data.stride_seconds),
    )


def intervals(config: TrainConfig) -> int:
    """Clone intervals in a segment."""
    return round(config.through_filter.piece_seconds / config.data.stride_seconds)


def run_segment(
    program: tuple[models.InferenceVariables, dict[str, Any]],
    segment: Segment,
    errors: StartErrors,
    model: nn.Module,
    config: TrainConfig,
    ekf: FilterConfig,
) -> tuple[Path, FilterHistory]:
    """The filter over one segment with the network in its loop: its path, the start included.

    program: the network's variables as inference takes them, and free parameters of the filter.
    """
    variables, numbers = program
    settings = with_free_parameters(config.filter, numbers)
    truth = segment.truth
    start = initial_state(
        ekf,
        start_rotation(truth, errors),
        truth.velocity[0] + errors.velocity,
        truth.position[0] + errors.position,
        errors.gyro_bias,
        errors.accel_bias,
        settings.start,
    )
    predict = functools.partial(models.Inference(model), variables)
    _, history = run_odometry(predict, start, segment.gyro, segment.accel, ekf, settings.noise)
    path = Path(
        jnp.concatenate([start.rotation[None], history.rotation]),
        jnp.concatenate([start.velocity[None], history.velocity]),
        jnp.concatenate([start.position[None], history.position]),
    )
    return path, history


def filter_segments(
    variables: Any,
    segments: Segment,
    errors: StartErrors,
    model: nn.Module,
    config: TrainConfig,
    ekf: FilterConfig,
) -> Filtered:
    """What becomes of each of a batch of segments, shared out among the devices."""
    network = {name: tree for name, tree in variables.items() if name != "filter"}
    program = models.inference_variables(model, network), variables["filter"]

    def one(program: Any, segment: Segment, errors: StartErrors) -> Filtered:
        path, history = run_segment(program, segment, errors, model, config, ekf)
        found = filter_losses(path, segment.truth, history, ekf, config.through_filter)
        error = segment.truth.position[1:] - history.position
        assert history.covariance is not None  # for type checkers
        squares = normalised_squares(error, history.covariance[:, POSITION, POSITION])
        nis = jnp.nanmean(history.nis) / 3
        return Filtered(found, history.healthy[-1] > 0, nis, jnp.mean(squares) / 3)

    return over_sequences(one, shared=1)(program, segments, errors)


def draw_segments(
    key: PRNGKeyArray, source: SegmentSource, starts: Int[jax.Array, "b"], config: TrainConfig
) -> tuple[Segment, StartErrors]:
    """The segments that begin at rows `starts`, and how wrong the filter starts in each."""
    count, stride = intervals(config), config.data.stride
    segments = jax.vmap(lambda start: cut_segment(source, start, count, stride))(starts)
    std = config.filter.start
    keys = jax.random.split(key, starts.shape[0])
    return segments, jax.vmap(lambda key: draw_start_errors(key, std, START_SPREAD))(keys)


def training_segments(
    key: PRNGKeyArray, source: SegmentSource, starts: Int[jax.Array, "b"], config: TrainConfig
) -> tuple[Segment, StartErrors]:
    """`draw_segments`, with `augment.yaw` each turned by a random yaw: the filter finds the same
    path but for the turn, and the network sees windows of another heading."""
    segments, errors = draw_segments(key, source, starts, config)
    if config.augment.yaw:
        count, key = starts.shape[0], jax.random.fold_in(key, 1)
        angles = jax.random.uniform(key, (count,), jnp.float64, -jnp.pi, jnp.pi)
        segments = jax.vmap(turned_segment)(segments, angles)
    return segments, errors


# The step
# ------------------------------------------------------------------------------------------------


@functools.partial(
    jax.jit, static_argnames=("model", "config", "steps_per_epoch"), donate_argnames="state"
)
def train_steps(
    state: TrainState,
    source: SegmentSource,
    order: Int[jax.Array, "p"],
    first: Int[jax.Array, ""],
    count: Int[jax.Array, ""],
    factor: Float[jax.Array, ""],
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    config: TrainConfig,
    steps_per_epoch: int,
) -> tuple[TrainState, Progress]:
    """Take `count` steps of an epoch, whose segments begin at the rows `order`, from its step
    number `first` on; see `window_task.train_steps`."""
    size = config.optim.batch_size
    chex.assert_rank(order, 1)
    chex.assert_axis_dimension_gteq(order, 0, size)
    chex.assert_shape([first, count, factor, state.step], ())
    adam = optimizer.adam_through_filter(config.optim)
    ratio = config.through_filter.filter_learning_rate / config.optim.learning_rate
    learning_rates = {
        "params": optimizer.schedule(config.optim, steps_per_epoch),
        "filter": optimizer.schedule(config.optim, steps_per_epoch, ratio),
    }

    def one_step(i: jax.Array, carry: tuple[TrainState, Progress]) -> tuple[TrainState, Progress]:
        state, progress = carry
        starts = jax.lax.dynamic_slice(order, ((first + i) * size,), (size,))
        batch = training_segments(jax.random.fold_in(key, state.step), source, starts, config)
        variables = state.variables
        trained = trainable(variables, config.through_filter.learn)
        gradient, losses, healthy = gradient_of_segments(variables, trained, *batch, model, config)

        direction: Any
        direction, opt_state = adam.update(gradient, state.opt_state, trained)
        for name, tree in direction.items():
            rate = -jnp.float32(learning_rates[name](state.step))
            direction[name] = optax.tree.scale(factor, optax.tree.scale(rate, tree))
        taken = merged(variables, optax.apply_updates(trained, direction))

        tame = optax.tree.norm(gradient) <= SKIP_ABOVE  # false for NaN
        tame = tame & healthy & jnp.isfinite(losses.total)
        variables, opt_state = jax.tree.map(
            lambda new, old: jnp.where(tame, new, old),
            (taken, opt_state),
            (variables, state.opt_state),
        )
        figures = named_means(losses) | gradient_norms(gradient)
        figures = {name: jnp.where(tame, each, 0.0) for name, each in figures.items()}
        figures["skipped"] = jnp.where(tame, 0.0, 1.0)
        progress = progress._replace(sums=jax.tree.map(jnp.add, progress.sums, figures))
        network = variables["params"], variables["batch_stats"]
        state = TrainState(jnp.add(state.step, 1), *network, opt_state, variables["filter"])
        return state, progress

    losses = FilterLosses(*[jnp.float64(0)] * len(FilterLosses._fields))
    norms = gradient_norms(trainable(state.variables, config.through_filter.learn))
    sums = named_means(losses) | jax.tree.map(jnp.zeros_like, norms) | {"skipped": jnp.float64(0)}
    start = (state, Progress(sums, jnp.int32(-1)))
    return jax.lax.fori_loop(jnp.int32(0), count, one_step, start)


def gradient_of_segments(
    variables: Any,
    trained: Trainable,
    segments: Segment,
    errors: StartErrors,
    model: nn.Module,
    config: TrainConfig,
) -> tuple[Trainable, FilterLosses, Bool[jax.Array, ""]]:
    """Gradient of the mean loss of the segments by what is trained, the mean losses, and whether
    the filter diverged in none of them."""
    chex.assert_type([segments.gyro, segments.accel], jnp.float64)
    ekf = filter_config(config, training=True)

    def objective(trained: Trainable) -> tuple[jax.Array, tuple[FilterLosses, jax.Array]]:
        found = filter_segments(merged(variables, trained), segments, errors, model, config, ekf)
        losses = jax.tree.map(lambda each: jnp.mean(each, axis=0), found.losses)
        return losses.total, (losses, jnp.all(found.healthy))

    gradient, (losses, healthy) = jax.grad(objective, has_aux=True)(trained)
    chex.assert_trees_all_equal_structs(gradient, trained)
    return gradient, losses, healthy


def named_means(losses: FilterLosses) -> dict[str, Float[jax.Array, ""]]:
    """The losses under the names of the log, those of several horizons as their mean."""
    names = {"total": "loss", "window": "mse"}
    return {names.get(name, name): jnp.mean(each) for name, each in losses._asdict().items()}


def gradient_norms(gradient: Trainable) -> dict[str, Float[jax.Array, ""]]:
    """Norm of the gradient by each part that is trained: modules of the network
    (`gradient_norm/head`), numbers of the filter (`gradient_norm/filter/noise.gyro_density`)."""
    named = dict(gradient.get("params", {}))
    named |= {f"filter/{name}": leaf for name, leaf in gradient.get("filter", {}).items()}
    return {f"gradient_norm/{name}": optax.tree.norm(part) for name, part in named.items()}


@functools.partial(jax.jit, static_argnames=("model", "config"))
def validate(
    state: TrainState,
    source: SegmentSource,
    key: PRNGKeyArray,
    *,
    model: nn.Module,
    config: TrainConfig,
) -> Filtered:
    """Means over the segments of `source`, each at its earliest place, with the gate that
    evaluation has. The errors of the starts depend on `key` alone. `healthy`: all were."""
    count = source.earliest.shape[0]
    size = min(config.optim.batch_size, count)
    batches = -(-count // size)
    # The last batch is filled up with segments of weight zero.
    which = jnp.minimum(jnp.arange(batches * size), count - 1)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float64) / count
    ekf = filter_config(config, training=False)
    segments, errors = draw_segments(key, source, jnp.asarray(source.earliest)[which], config)

    def one_batch(batch: tuple[Segment, StartErrors, jax.Array]) -> Filtered:
        found = filter_segments(state.variables, batch[0], batch[1], model, config, ekf)
        found = found._replace(healthy=found.healthy.astype(jnp.float64))
        return jax.tree.map(lambda each: jnp.tensordot(batch[2], each, 1), found)

    in_batches = jax.tree.map(
        lambda each: each.reshape(batches, size, *each.shape[1:]), (segments, errors, weight)
    )
    found = jax.lax.map(one_batch, in_batches)
    means = jax.tree.map(lambda each: jnp.sum(each, axis=0), found)
    return means._replace(healthy=means.healthy > 1 - 0.5 / count)


# The task
# ------------------------------------------------------------------------------------------------


class FilterTask(Task):
    """Training through the filter: `source` and `held_out` are `SegmentSource`s. See
    `window_task.WindowTask` for what each method means to the loop."""

    unit = "segments"

    def initial_state(self, start: Any | None) -> TrainState:
        window = self.config.data.seen
        state = window_task.initial_state(self.model, self.keys.init, window)
        state = state._replace(filter=filter_numbers(self.config.filter))
        if start is not None:
            # The filter is that of the settings, not that of the run. Copies: the steps take the
            # memory of their state, and another seed starts from the same weights.
            start = jax.tree.map(parallel.fresh_copy, {**start, "filter": {}})
            found = window_task.overlaid(state.variables, start)
            state = state._replace(params=found["params"], batch_stats=found["batch_stats"])
        trained = trainable(state.variables, self.config.through_filter.learn)
        chex.assert_type(jax.tree.leaves(trained), jnp.float32)
        adam = optimizer.adam_through_filter(self.config.optim)
        return state._replace(opt_state=adam.init(trained))

    def description(self, state: TrainState, workdir: FilePath) -> Iterator[str]:
        optim, through = self.config.optim, self.config.through_filter
        trained = window_task.size_of(trainable(state.variables, through.learn))
        yield (
            f"{self.config.model.name} in the filter's loop: {' and '.join(through.learn)} learn, "
            f"{trained:,} numbers, on {jax.devices()[0].platform}, {self.steps_per_epoch} steps of "
            f"{optim.batch_size} segments an epoch, {optim.epochs} epochs → {workdir}"
        )

    def order(self, epoch: int) -> Int[jax.Array, "p"]:
        return random_starts(jax.random.fold_in(self.keys.order, epoch), self.source)

    def take_steps(
        self, state: TrainState, order: Int[jax.Array, "p"], first: int, count: int, factor: float
    ) -> tuple[TrainState, Progress]:
        state, progress = train_steps(
            state,
            self.source,
            order,
            jnp.int32(first),
            jnp.int32(count),
            jnp.float32(factor),
            self.keys.step,
            **self.compiled_for,
            steps_per_epoch=self.steps_per_epoch,
        )
        if len(jax.devices()) > 1:
            # Where the segments were shared out, the state now lies on all devices, and the next
            # step would be compiled once more for that.
            state = jax.tree.map(parallel.fresh_copy, state)
        return state, progress

    def with_statistics(self, state: TrainState) -> TrainState:
        """As it is: the statistics of batch normalisation are frozen."""
        return state

    def validate(self, state: TrainState, step: int) -> tuple[TrainState, Row]:
        """The loss is infinite where the filter diverges."""
        found = validate(state, self.held_out, self.keys.statistics, **self.compiled_for)
        losses = jax.device_get(found.losses)
        sound = bool(found.healthy) and math.isfinite(losses.total)
        return state, {
            "val_loss": float(losses.total) if sound else math.inf,
            "val_mse": float(losses.window),
            "val_rmse": math.sqrt(losses.window),
            "val_innovation": float(losses.innovation),
            "val_state": float(losses.state),
            **_by_horizon("val_displacement_error", losses.displacement),
            **_by_horizon("val_yaw_error", losses.yaw),
            "val_nis": float(found.nis),
            "val_nees": float(found.nees),
        }

    def remark(self, row: Row) -> str:
        skipped = f"{row['skipped']} skipped  " if row["skipped"] else ""
        return f"nis/3 {row['val_nis']:.2f}  nees/3 {row['val_nees']:.2f}  {skipped}"


def _by_horizon(name: str, squares: np.ndarray) -> Row:
    """Roots of the squared errors of each horizon: shares of the distance, rad per metre."""
    seconds = HORIZON_SECONDS[: len(squares)]
    both = zip(seconds, squares, strict=True)
    return {f"{name}/{each:g}s": math.sqrt(square) for each, square in both}


def set_up(config: TrainConfig, reporter: Reporter, workers: int = 1) -> FilterTask:
    """Load the recordings and find the segments in them.

    Raises `InputError` for options that the network does not have, missing data, recordings that
    are too short, and a batch that is larger than the split. `workers` processes read recordings
    that are slow to read.
    """
    model = window_task.create_model(config)  # mistakes in its options do not wait for the data
    train, val = config.data.train_split, config.data.val_split
    reporter.line(f"reading {config.dataset}: {train} and {val}")

    def segments(split: str) -> tuple[SegmentSource, list[str]]:
        samples: dict[str, int] = {}
        sequences = window_task.read_split(config, split, reporter, workers, samples)
        source = segment_source(sequences, intervals(config) * config.data.stride)
        contents = f"{source.earliest.shape[0]:,} segments"
        reporter.line(window_task.described_split(config, split, samples, contents))
        return jax.device_put(source), list(samples)

    source, trained = segments(train)
    held_out, validated = segments(val)
    splits = {train: trained, val: validated}
    steps = window_task.steps_in_epoch(source.earliest.shape[0], "segments", config)
    return FilterTask(config, model, source, held_out, splits, steps)
