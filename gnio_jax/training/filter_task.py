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
from jaxtyping import Bool, Float, Int, PRNGKeyArray

from gnio_jax import models, parallel
from gnio_jax.config import FilterSettings, TrainConfig
from gnio_jax.filtering import (
    FilterConfig,
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
from gnio_jax.training import optimizer
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
    joined,
    random_starts,
    segment_source,
    start_rotation,
    turned_segment,
)
from gnio_jax.training.task import BatchLosses, Progress, Row, Task, Trainable, TrainState, size_of
from gnio_jax.types import Sequence

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


def intervals(config: TrainConfig) -> int:
    """Clone intervals in a segment."""
    return round(config.through_filter.piece_seconds / config.data.stride_seconds)


# Validation
# ------------------------------------------------------------------------------------------------


@functools.partial(jax.jit, static_argnames="task")
def validate(
    state: TrainState, source: SegmentSource, key: PRNGKeyArray, *, task: FilterTask
) -> Filtered:
    """Means over the segments of `source`, each at its earliest place, with the gate that
    evaluation has. The errors of the starts depend on `key` alone. `healthy`: all were."""
    config, count = task.config, source.earliest.shape[0]
    size = min(config.optim.batch_size, count)
    batches = -(-count // size)
    # The last batch is filled up with segments of weight zero.
    which = jnp.minimum(jnp.arange(batches * size), count - 1)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float64) / count
    ekf = filter_setup(config.data, config.filter).config
    segments, errors = task.segments(key, source, jnp.asarray(source.earliest)[which])

    def one_batch(batch: tuple[Segment, StartErrors, jax.Array]) -> Filtered:
        found = task.filtered(state.variables, batch[0], batch[1], ekf)
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
    """Training through the filter, on segments, which a `SegmentSource` holds."""

    unit = "segments"
    figures = ("loss", "mse", "displacement", "yaw", "innovation", "state")
    skip_above = 1000.0

    @staticmethod
    def source_of(
        sequences: Iterable[Sequence], config: TrainConfig, training: bool
    ) -> SegmentSource:
        return segment_source(sequences, intervals(config) * config.data.stride)

    joined = staticmethod(joined)

    @staticmethod
    def count(source: SegmentSource) -> int:
        return source.earliest.shape[0]

    def description(self, state: TrainState, workdir: FilePath) -> Iterator[str]:
        optim, learn = self.config.optim, self.config.through_filter.learn
        yield (
            f"{self.config.model.name} in the filter's loop: {' and '.join(learn)} learn, "
            f"{size_of(self.trainable(state.variables)):,} numbers, on "
            f"{jax.devices()[0].platform}, {self.steps_per_epoch} steps of {optim.batch_size} "
            f"segments an epoch, {optim.epochs} epochs → {workdir}"
        )

    def filter_numbers(self) -> dict[str, Any]:
        return filter_numbers(self.config.filter)

    def trainable(self, variables: Any) -> Trainable:
        return trainable(variables, self.config.through_filter.learn)

    def order(self, key: PRNGKeyArray, epoch: int, source: SegmentSource) -> Int[jax.Array, "p"]:
        """First rows of the segments."""
        key = jax.random.fold_in(key, epoch)
        which = self.weighted(key, jnp.arange(self.count(source)))
        return random_starts(
            key,
            source._replace(
                earliest=jnp.asarray(source.earliest)[which],
                latest=jnp.asarray(source.latest)[which],
            ),
        )

    def draw(
        self, key: PRNGKeyArray, source: SegmentSource, which: Int[jax.Array, "b"]
    ) -> tuple[Segment, StartErrors]:
        """`segments`, with `augment.yaw` each turned by a random yaw: the filter finds the same
        path but for the turn, and the network sees windows of another heading."""
        segments, errors = self.segments(key, source, which)
        if self.config.augment.yaw:
            count, key = which.shape[0], jax.random.fold_in(key, 1)
            angles = jax.random.uniform(key, (count,), jnp.float64, -jnp.pi, jnp.pi)
            segments = jax.vmap(turned_segment)(segments, angles)
        return segments, errors

    def losses(
        self, variables: Any, batch: tuple[Segment, StartErrors], step: Int[jax.Array, ""]
    ) -> BatchLosses:
        """Means over the segments, those of several horizons over these too."""
        segments, errors = batch
        chex.assert_type([segments.gyro, segments.accel], jnp.float64)
        found = self.filtered(variables, segments, errors, self.softened())
        means = {name: jnp.mean(each) for name, each in found.losses._asdict().items()}
        figures = {"loss": means.pop("total"), "mse": means.pop("window"), **means}
        return BatchLosses(figures, variables["batch_stats"], jnp.all(found.healthy))

    def softened(self) -> FilterConfig:
        """The filter in training: its gate has a slope, and its gradient is cut."""
        return dataclasses.replace(
            filter_setup(self.config.data, self.config.filter).config,
            gate_softness=GATE_SOFTNESS,
            checkpoint_every=CHECKPOINT_EVERY,
            truncate_every=round(TRUNCATE_SECONDS / self.config.data.stride_seconds),
        )

    def segments(
        self, key: PRNGKeyArray, source: SegmentSource, starts: Int[jax.Array, "b"]
    ) -> tuple[Segment, StartErrors]:
        """The segments that begin at rows `starts`, and how wrong the filter starts in each."""
        count, stride = intervals(self.config), self.config.data.stride
        segments = jax.vmap(lambda start: cut_segment(source, start, count, stride))(starts)
        std, keys = self.config.filter.start, jax.random.split(key, starts.shape[0])
        return segments, jax.vmap(lambda key: draw_start_errors(key, std, START_SPREAD))(keys)

    def filtered(
        self, variables: Any, segments: Segment, errors: StartErrors, ekf: FilterConfig
    ) -> Filtered:
        """What becomes of each of a batch of segments, with the network in the filter's loop; they
        are shared out among the devices."""
        network = {name: tree for name, tree in variables.items() if name != "filter"}
        frozen = models.inference_variables(self.model, network)

        def one(program: Any, segment: Segment, errors: StartErrors) -> Filtered:
            frozen, numbers = program
            settings, truth = with_free_parameters(self.config.filter, numbers), segment.truth
            start = initial_state(
                ekf,
                start_rotation(truth, errors),
                truth.velocity[0] + errors.velocity,
                truth.position[0] + errors.position,
                errors.gyro_bias,
                errors.accel_bias,
                settings.start,
            )
            predict = functools.partial(models.Inference(self.model), frozen)
            signals = segment.gyro, segment.accel
            _, history = run_odometry(predict, start, *signals, ekf, settings.noise)
            path = Path(
                jnp.concatenate([start.rotation[None], history.rotation]),
                jnp.concatenate([start.velocity[None], history.velocity]),
                jnp.concatenate([start.position[None], history.position]),
            )
            found = filter_losses(path, truth, history, ekf, self.config.through_filter)
            assert history.covariance is not None  # for type checkers
            error = truth.position[1:] - history.position
            squares = normalised_squares(error, history.covariance[:, POSITION, POSITION])
            nis = jnp.nanmean(history.nis) / 3
            return Filtered(found, history.healthy[-1] > 0, nis, jnp.mean(squares) / 3)

        return over_sequences(one, shared=1)((frozen, variables["filter"]), segments, errors)

    def take_steps(self, *given: Any) -> tuple[TrainState, Progress]:
        state, progress = super().take_steps(*given)
        if len(jax.devices()) > 1:
            # Where the segments were shared out, the state now lies on all devices, and the next
            # step would be compiled once more for that.
            state = jax.tree.map(parallel.fresh_copy, state)
        return state, progress

    def figures_of(self, state: TrainState, held_out: SegmentSource, key: PRNGKeyArray) -> Row:
        """The loss is infinite where the filter diverges."""
        found = validate(state, held_out, key, task=self)
        losses = jax.device_get(found.losses)
        sound = bool(found.healthy) and math.isfinite(losses.total)
        row: Row = {
            "val_loss": float(losses.total) if sound else math.inf,
            "val_mse": float(losses.window),
            "val_rmse": math.sqrt(losses.window),
            "val_innovation": float(losses.innovation),
            "val_state": float(losses.state),
        }
        # Roots of the squared errors of each horizon: shares of the distance, rad per metre.
        for name in ("displacement", "yaw"):
            for seconds, square in zip(HORIZON_SECONDS, getattr(losses, name), strict=False):
                row[f"val_{name}_error/{seconds:g}s"] = math.sqrt(square)
        return row | {"val_nis": float(found.nis), "val_nees": float(found.nees)}

    def remark(self, row: Row) -> str:
        skipped = f"{row['skipped']} skipped  " if row["skipped"] else ""
        return f"nis/3 {row['val_nis']:.2f}  nees/3 {row['val_nees']:.2f}  {skipped}"
