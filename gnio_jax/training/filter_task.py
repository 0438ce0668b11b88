"""Training through the filter: segments of recordings, with the network in the filter's loop
(ours).

The filter runs in float64 (JAX's x64 must be on); the trained variables and the optimizer are in
float32.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Int, PRNGKeyArray

from gnio_jax import models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.filtering import (
    FilterConfig,
    initial_state,
    make_filter,
    over_sequences,
    run_odometry,
)
from gnio_jax.filtering.settings import filter_config, with_free_parameters
from gnio_jax.training.filter_losses import HORIZON_SECONDS, FilterLosses, filter_losses
from gnio_jax.training.segments import (
    MotionPath,
    Segment,
    SegmentSource,
    StartEstimate,
    cut_segment,
    draw_start,
    join_segments,
    low_pass_segments,
    random_starts,
    segment_source,
    turn_segment,
)
from gnio_jax.training.task import BatchLosses, DispatchSums, Row, Task, TrainState
from gnio_jax.types import Sequence

CHECKPOINT_EVERY = 20
"""Clone intervals between the states that the backward pass keeps."""
GATE_SOFTNESS = 2.0
"""Slope of the χ² gate in training (`FilterConfig.gate_softness`); validation has the gate of
evaluation."""
LOSS_PARTS = ("displacement", "yaw", "innovation", "state", "translation", "waypoints")
"""Parts of the loss that are figures of a batch (`FilterLosses`)."""


class FilterTask(Task):
    """Training through the filter on the segments of a `SegmentSource`."""

    unit = "segments"
    skip_above = 1000.0
    join = staticmethod(join_segments)

    @property
    def figures(self) -> tuple[str, ...]:
        return ("loss", "mse", *LOSS_PARTS)

    @staticmethod
    def source_of(
        sequences: Iterable[Sequence], config: TrainConfig, training: bool
    ) -> SegmentSource:
        return segment_source(sequences, intervals(config) * config.data.stride)

    @staticmethod
    def count(source: SegmentSource) -> int:
        return source.earliest.shape[0]

    def description(self, state: TrainState, workdir: Path) -> Iterator[str]:
        optim, learn = self.config.optim, self.config.through_filter.learn
        yield (
            f"{self.config.model.name} in the filter's loop: {' and '.join(learn)} learn, "
            f"{optax.tree.size(self.trainable(state.variables)):,} numbers, on "
            f"{jax.devices()[0].platform}, {self.steps_per_epoch} steps of {optim.batch_size} "
            f"segments an epoch, {optim.epochs} epochs → {workdir}"
        )

    def order(self, key: PRNGKeyArray, epoch: int, source: SegmentSource) -> Int[jax.Array, "p"]:
        """First rows of the segments."""
        key = jax.random.fold_in(key, epoch)
        # `random_starts` splits `key`, whose parts are those of the indices 0 and 1.
        visit_key = jax.random.fold_in(key, 2)
        which = self.select_visits(visit_key, jnp.arange(self.count(source)))
        earliest, latest = jnp.asarray(source.earliest)[which], jnp.asarray(source.latest)[which]
        return random_starts(key, source._replace(earliest=earliest, latest=latest))

    def draw(
        self, key: PRNGKeyArray, source: SegmentSource, which: Int[jax.Array, "b"]
    ) -> tuple[Segment, StartEstimate]:
        augment, rate = self.config.augment, self.config.data.rate
        segment_key, pass_key = jax.random.split(key)
        segments, starts = self.segments(segment_key, source, which, augment.yaw)
        return low_pass_segments(pass_key, segments, augment, rate), starts

    def losses(
        self, variables: Any, batch: tuple[Segment, StartEstimate], step: Int[jax.Array, ""]
    ) -> BatchLosses:
        """Means over the segments, and over the horizons of losses that have several."""
        chex.assert_type([batch[0].gyro, batch[0].accel], jnp.float64)
        losses = self.filter_segments(variables, *batch, self.training_filter())
        means = {name: jnp.mean(getattr(losses, name)) for name in LOSS_PARTS}
        figures = {"loss": jnp.mean(losses.total), "mse": jnp.mean(losses.window), **means}
        return BatchLosses(figures, variables["batch_stats"], jnp.all(losses.healthy))

    def training_filter(self) -> FilterConfig:
        """The settings of the filter in training: its gate has a slope, and its gradient is
        cut."""
        return dataclasses.replace(
            filter_config(self.config.data, self.config.filter),
            gate_softness=GATE_SOFTNESS,
            checkpoint_every=CHECKPOINT_EVERY,
            truncate_every=round(
                self.config.through_filter.truncate_seconds / self.config.data.stride_seconds
            ),
        )

    def segments(
        self, key: PRNGKeyArray, source: SegmentSource, rows: Int[jax.Array, "b"], turned: bool
    ) -> tuple[Segment, StartEstimate]:
        """The segments that begin at these rows, and the start of the filter in each. `turned`:
        each segment is turned by a random yaw. The filter finds the same path, turned, and the
        network sees windows of another heading."""
        count, stride = intervals(self.config), self.config.data.stride
        segments = jax.vmap(lambda row: cut_segment(source, row, count, stride))(rows)
        turn_key, start_key = jax.random.split(key)
        if turned:
            angles = jax.random.uniform(turn_key, rows.shape, jnp.float64, -jnp.pi, jnp.pi)
            segments = jax.vmap(turn_segment)(segments, angles)
        std, spread = self.config.filter.start, self.config.through_filter.start_spread
        start = jax.vmap(lambda key, truth: draw_start(key, truth, std, spread))
        return segments, start(jax.random.split(start_key, rows.shape[0]), segments.truth)

    def filter_segments(
        self, variables: Any, segments: Segment, starts: StartEstimate, config: FilterConfig
    ) -> FilterLosses:
        """The losses of each segment of a batch, with the network in the filter's loop; the
        segments are divided among the devices."""
        network = {name: tree for name, tree in variables.items() if name != "filter"}
        frozen = models.inference_variables(self.model, network)

        def one(program: Any, segment: Segment, start: StartEstimate) -> FilterLosses:
            frozen, numbers = program
            settings = with_free_parameters(self.config.filter, numbers)
            ekf = dataclasses.replace(make_filter(self.config.data, settings), config=config)
            first = initial_state(ekf, *start)
            predict = models.Network(models.Inference(self.model), frozen).predict()
            _, history = run_odometry(predict, ekf, first, segment.gyro, segment.accel)
            path = MotionPath(
                *(
                    jnp.concatenate([getattr(first, name)[None], getattr(history, name)])
                    for name in MotionPath._fields
                )
            )
            return filter_losses(path, segment, history, config, self.config.through_filter)

        return over_sequences(one, shared=1)((frozen, variables["filter"]), segments, starts)

    def take_steps(self, *arguments: Any) -> tuple[TrainState, DispatchSums]:
        state, sums = super().take_steps(*arguments)
        if len(jax.devices()) > 1:
            # If the segments were divided, the state is now on all devices, and the next step would
            # be compiled again for this placement.
            state = jax.tree.map(parallel.fresh_copy, state)
        return state, sums

    def figures_of(self, state: TrainState, held_out: SegmentSource, key: PRNGKeyArray) -> Row:
        """The loss is infinite where the filter diverges."""
        losses = jax.device_get(validate(state, held_out, key, task=self))
        sound = bool(losses.healthy) and math.isfinite(losses.total)
        row: Row = {
            "val_loss": float(losses.total) if sound else math.inf,
            "val_mse": float(losses.window),
            "val_innovation": float(losses.innovation),
            "val_state": float(losses.state),
        }
        if models.predicts_displacement(self.model):
            row["val_rmse"] = math.sqrt(losses.window)
        if held_out.tapped.any():
            row["val_waypoint_error"] = math.sqrt(losses.waypoints)
        if self.config.through_filter.translation_weight and losses.long_enough:
            row["val_t_rel"] = 100 * float(losses.translation / losses.long_enough)
        # Roots of the squared errors of each horizon: relative to the distance, and in rad per
        # metre.
        for name in ("displacement", "yaw"):
            for seconds, square in zip(HORIZON_SECONDS, getattr(losses, name), strict=False):
                row[f"val_{name}_error/{seconds:g}s"] = math.sqrt(square)
        if math.isfinite(losses.nis):  # there were displacements
            row["val_nis"] = float(losses.nis)
        return row | {"val_nees": float(losses.nees)}

    def remark(self, row: Row) -> str:
        parts = [f"t_rel {row['val_t_rel']:.2f} %"] if "val_t_rel" in row else []
        parts += [f"nis/3 {row['val_nis']:.2f}"] if "val_nis" in row else []
        parts += [f"nees/3 {row['val_nees']:.2f}"]
        parts += [f"{row['skipped']} skipped"] if row["skipped"] else []
        return "".join(f"{part}  " for part in parts)


def intervals(config: TrainConfig) -> int:
    """Clone intervals in a segment."""
    return round(config.through_filter.piece_seconds / config.data.stride_seconds)


@functools.partial(jax.jit, static_argnames="task")
def validate(
    state: TrainState, source: SegmentSource, key: PRNGKeyArray, *, task: FilterTask
) -> FilterLosses:
    """Means over the segments of `source`, each at its earliest place, with the gate of evaluation.
    The errors of the starts depend on `key` alone. `healthy` is True if the filter was healthy in
    all of them."""
    count = source.earliest.shape[0]
    size = min(task.config.optim.batch_size, count)
    batches = -(-count // size)
    # The last batch is filled up with segments of weight zero.
    which = jnp.minimum(jnp.arange(batches * size), count - 1)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float64) / count
    config = filter_config(task.config.data, task.config.filter)
    drawn = task.segments(key, source, jnp.asarray(source.earliest)[which], turned=False)

    def one_batch(batch: tuple[Segment, StartEstimate, jax.Array]) -> FilterLosses:
        losses = task.filter_segments(state.variables, batch[0], batch[1], config)
        losses = losses._replace(healthy=losses.healthy.astype(jnp.float64))
        return jax.tree.map(lambda values: jnp.tensordot(batch[2], values, 1), losses)

    in_batches = jax.tree.map(
        lambda leaf: leaf.reshape(batches, size, *leaf.shape[1:]), (*drawn, weight)
    )
    means = jax.tree.map(lambda leaf: jnp.sum(leaf, axis=0), jax.lax.map(one_batch, in_batches))
    return means._replace(healthy=means.healthy > 1 - 0.5 / count)
