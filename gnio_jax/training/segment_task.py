"""Training a network with memory on segments of walks, with the attitude of the reference (ours).

The network sees a segment from an empty memory on and predicts the displacement over the last
window at the end of every interval. Training through the filter (`filter_task`) may follow.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax import parallel
from gnio_jax.config import TrainConfig
from gnio_jax.models.memory import NetworkWithMemory
from gnio_jax.training.losses import Losses, Stage, loss_stage, losses, switches
from gnio_jax.training.segments import join_segments
from gnio_jax.training.task import BatchLosses, Row, Task, TrainState
from gnio_jax.training.walk_segments import (
    WalkSegments,
    WalkSource,
    cut_walks,
    draw_walks,
    grid_of,
    walk_source,
)
from gnio_jax.training.walkway import unchanged_pace
from gnio_jax.training.window_task import (
    Validation,
    calibrate_uncertainty,
    has_statistics,
    predicted_axes,
)
from gnio_jax.types import Prediction, Sequence, Windows

HORIZON_WINDOWS = (5, 10, 30, 60)
"""Lengths of the displacements of the horizon loss, in windows, if the segment is long enough."""
DISTANCE_FLOOR = 1.0
"""Added in quadrature to the distance by which an error is divided, m (`filter_losses`)."""
BANDS = ((0.3, 0.8), (0.8, 1.15), (1.15, 1.5))
"""Bands of speed, m/s, in which validation moves every walk on a walkway."""
SLOWEST = 0.2
"""Mean speed below which a segment is not moved, m/s: it mostly stands."""


class SegmentTask(Task):
    """Training on the segments of a `WalkSource`."""

    unit = "segments"
    skip_above = 1000.0
    join = staticmethod(join_segments)

    @property
    def figures(self) -> tuple[str, ...]:
        return ("loss", "mse", "nll", "horizon")

    @staticmethod
    def source_of(sequences: Iterable[Sequence], config: TrainConfig, training: bool) -> WalkSource:
        return walk_source(sequences, config, training)

    @staticmethod
    def count(source: WalkSource) -> int:
        return source.earliest.shape[0]

    def description(self, state: TrainState, workdir: Path) -> Iterator[str]:
        optim, segments = self.config.optim, self.config.segments
        yield (
            f"{self.config.model.name}: {optax.tree.size(state.variables['params']):,} parameters "
            f"on {parallel.describe()}, {self.steps_per_epoch} steps of {optim.batch_size} "
            f"segments of {segments.seconds:g} s an epoch, {optim.epochs} epochs → {workdir}"
        )

    @property
    def changes(self) -> tuple[int, ...]:
        return switches(self.config.loss, self.steps_per_epoch)

    def order(self, key: PRNGKeyArray, epoch: int, source: WalkSource) -> Int[jax.Array, "p"]:
        """First rows of the segments."""
        key = jax.random.fold_in(key, epoch)
        which_key, where_key, order_key = jax.random.split(key, 3)
        which = self.select_visits(which_key, jnp.arange(self.count(source)))
        earliest, latest = jnp.asarray(source.earliest)[which], jnp.asarray(source.latest)[which]
        rows = jax.random.randint(where_key, earliest.shape, earliest, latest + 1, jnp.int32)
        return jax.random.permutation(order_key, rows)

    def draw(
        self, key: PRNGKeyArray, source: WalkSource, which: Int[jax.Array, "b"]
    ) -> tuple[WalkSegments, PRNGKeyArray]:
        change_key, dropout_key = jax.random.split(key)
        which = parallel.split(which)
        segments = draw_walks(change_key, source, which, grid_of(self.config), self.config.augment)
        return parallel.split(segments), dropout_key

    def losses(
        self,
        variables: Any,
        batch: tuple[WalkSegments, PRNGKeyArray],
        step: Int[jax.Array, ""],
    ) -> BatchLosses:
        segments, dropout_key = batch
        stage = loss_stage(self.config.loss, step, self.steps_per_epoch)
        prediction, statistics = self.predict(variables, segments, dropout_key)
        figures = self.figures_of_batch(prediction, segments, stage)
        return BatchLosses(figures, statistics, jnp.bool_(True))

    def figures_of_batch(
        self, prediction: Prediction, segments: WalkSegments, stage: Stage
    ) -> dict[str, Float[jax.Array, ""]]:
        """The losses of the displacements of single windows (`losses.losses`), and of their sums
        over longer times."""
        rows = jax.tree.map(lambda leaf: leaf.reshape(-1, *leaf.shape[2:]), prediction)
        truth = segments.displacement.reshape(-1, 3)
        windows = Windows(jnp.zeros((len(truth), 0, 6)), truth, jnp.zeros((len(truth), 0, 3)))
        values = losses(rows, windows, self.config.loss, stage, predicted_axes(self.model))
        weight, horizon = self.config.segments.horizon_weight, jnp.float32(0)
        if weight:
            error = prediction.displacement - segments.displacement
            count = grid_of(self.config).window
            error = error[..., : predicted_axes(self.model)]
            horizon = horizon_error(error, segments.moved, count)
        total = values.total + jnp.float32(weight) * horizon
        return {"loss": total, "mse": values.mse, "nll": values.nll, "horizon": horizon}

    def predict(
        self, variables: Any, segments: WalkSegments, dropout_key: PRNGKeyArray | None = None
    ) -> tuple[Prediction, Any]:
        """The predictions (b, m, 3) of all windows, and the statistics after them; with a key in
        training mode, where the memory is cut every `segments.truncate_seconds`."""
        model, grid = self.model, grid_of(self.config)
        assert isinstance(model, NetworkWithMemory)
        train, signals = dropout_key is not None, segments.signals
        seconds = self.config.segments.truncate_seconds if train else 0.0
        block = round(seconds * grid.rate) or grid.samples
        memory, parts = model.begin(len(signals)), []
        statistics = variables["batch_stats"]
        for number, first in enumerate(range(0, grid.samples, block)):
            options: dict[str, Any] = {"method": "advance"}
            if train:
                rngs = {"dropout": jax.random.fold_in(dropout_key, number)}
                options |= {"mutable": ["batch_stats"], "rngs": rngs}
            state = variables | {"batch_stats": statistics}
            arguments = memory, signals[:, first : first + block], grid.stride, train
            result: Any = model.apply(state, *arguments, **options)
            if train:
                result, changed = result
                statistics = changed.get("batch_stats", {})
            memory, prediction = result
            memory = jax.lax.stop_gradient(memory)
            parts.append(_with_bins(prediction))
        joined = jax.tree.map(lambda *leaves: jnp.concatenate(leaves, axis=1), *parts)
        return jax.tree.map(lambda leaf: leaf[:, grid.window - 1 :], joined), statistics

    def calibrate_uncertainty(
        self, state: TrainState, held_out: dict[str, WalkSource]
    ) -> TrainState:
        if not has_statistics(state, "log_std", "log_factor"):
            return state
        key, stage = jax.random.key(0), self.last_stage(state)
        plain = [validate(state, source, key, stage, task=self)[0] for source in held_out.values()]
        mean = jax.tree.map(lambda *figures: sum(figures) / len(figures), *plain)
        # The frame has any heading, so both horizontal axes have the same errors.
        axes = mean.axis_mse, mean.axis_normalised
        figures = Validation(Losses(mean.loss, mean.mse, mean.nll), *axes)
        return calibrate_uncertainty(state, figures, isotropic=True)

    def figures_of(self, state: TrainState, held_out: WalkSource, key: PRNGKeyArray) -> Row:
        """`val_mse` is the mean of the squared errors of the walks as they are and of those that a
        walkway has moved into each band of speed."""
        stage = self.last_stage(state)
        plain, *bands = jax.device_get(validate(state, held_out, key, stage, task=self))
        every = [plain, *bands]
        mse = float(sum(part.mse for part in every) / len(every))
        row: Row = {
            "val_loss": float(sum(part.loss for part in every) / len(every)),
            "val_mse": mse,
            "val_nll": float(plain.nll),
            "val_rmse": math.sqrt(mse),
            "val_horizon": float(plain.horizon),
        }
        for (low, high), part in zip(((0, 0), *BANDS), every, strict=True):
            name = f"{low:g}-{high:g}" if high else "walked"
            row[f"val_rmse/{name}"] = math.sqrt(part.mse)
            row[f"val_ratio/{name}"] = float(part.predicted / max(part.walked, 1e-6))
        normalised = zip("xyz", plain.axis_normalised, strict=True)
        return row | {f"val_normalised/{axis}": float(value) for axis, value in normalised}

    def last_stage(self, state: TrainState) -> Stage:
        """The stage of the step that led to `state`."""
        return loss_stage(self.config.loss, state.step - 1, self.steps_per_epoch)

    def remark(self, row: Row) -> str:
        names = ["walked", *(f"{low:g}-{high:g}" for low, high in BANDS)]
        bands = (
            f"{row[f'val_rmse/{name}']:.3f} ({row[f'val_ratio/{name}']:.2f})" for name in names
        )
        return f"mse {row['mse']:.4g} nll {row['nll']:.4g}  bands {' '.join(bands)}  "


def _with_bins(prediction: Prediction) -> Prediction:
    """The prediction with the diagnostics of a distribution over bins alone, for its loss."""
    says = prediction.diagnostics
    return prediction._replace(
        diagnostics={name: value for name, value in says.items() if name.startswith("bin_")}
    )


def horizon_lengths(predictions: int, window: int) -> list[int]:
    """Those of `HORIZON_WINDOWS` for which a segment is long enough, by the number of its
    predictions and of the clone intervals in a window."""
    return [length for length in HORIZON_WINDOWS if length < predictions // window]


def horizon_error(
    error: Float[jax.Array, "b m d"], moved: Float[jax.Array, "b m"], window: int
) -> Float[jax.Array, ""]:
    """Mean of ‖Σ e‖² / (distance² + floor²) over the displacements of `HORIZON_WINDOWS` windows,
    each a sum of windows that do not overlap; 0 if the segment is shorter than two of them."""
    count, lengths = error.shape[1] // window, horizon_lengths(error.shape[1], window)
    if not lengths:
        return jnp.float32(0)

    def sums(values: jax.Array) -> jax.Array:
        """Running sums over windows that do not overlap, for each phase: (b, count + 1, phase,
        ...)."""
        phases = values[:, : count * window]
        phases = phases.reshape(values.shape[0], count, window, *values.shape[2:])
        total = jnp.cumsum(phases, axis=1)
        return jnp.concatenate([jnp.zeros_like(total[:, :1]), total], axis=1)

    errors, distances, terms = sums(error), sums(moved), []
    for length in lengths:
        part = errors[:, length:] - errors[:, :-length]
        distance = distances[:, length:] - distances[:, :-length]
        terms.append(jnp.mean(jnp.sum(part**2, axis=-1) / (distance**2 + DISTANCE_FLOOR**2)))
    return jnp.mean(jnp.stack(terms))


class SegmentValidation(NamedTuple):
    """Means over every segment of a split."""

    loss: Float[jax.Array, ""]
    mse: Float[jax.Array, ""]
    """Squared error of the displacements, m²."""
    nll: Float[jax.Array, ""]
    horizon: Float[jax.Array, ""]
    axis_mse: Float[jax.Array, "3"]
    """Squared error of each axis, m²."""
    axis_normalised: Float[jax.Array, "3"]
    """(e/σ)² of each axis."""
    predicted: Float[jax.Array, ""]
    """Component of the predicted displacements along the true ones, in the plane, m."""
    walked: Float[jax.Array, ""]
    """Length of the true displacements in the plane, m."""


@functools.partial(jax.jit, static_argnames="task")
def validate(
    state: TrainState, source: WalkSource, key: PRNGKeyArray, stage: Stage, *, task: SegmentTask
) -> list[SegmentValidation]:
    """The figures of every segment at its earliest place without other changes: as it was walked,
    and moved into each of the `BANDS` by a walkway, to speeds that are drawn from `key`. A segment
    that mostly stands is not moved."""
    count = source.earliest.shape[0]
    size = min(task.config.optim.batch_size, count)
    size = -(-size // parallel.count()) * parallel.count()
    batches = -(-count // size)
    # The last batch is filled up with segments of weight zero.
    which = jnp.minimum(jnp.arange(batches * size), count - 1)
    rows = jnp.asarray(source.earliest)[which].reshape(batches, size)
    weight = (jnp.arange(batches * size) < count).astype(jnp.float32).reshape(batches, size)
    grid = grid_of(task.config)
    shares = jax.random.uniform(key, (batches * size, len(BANDS)), jnp.float32)
    shares = shares.reshape(batches, size, len(BANDS))

    def one_batch(batch: tuple[jax.Array, jax.Array, jax.Array]) -> list[SegmentValidation]:
        rows, weight, shares = batch
        pace, results = unchanged_pace(size), []
        segments = cut_walks(source, rows, pace, grid)
        speed = jnp.mean(segments.moved, axis=1) * grid.rate / (grid.window * grid.stride)
        results.append(measure(state, segments, stage, weight, task))
        for number, (low, high) in enumerate(BANDS):
            target = low + (high - low) * shares[:, number]
            factor = jnp.where(speed < SLOWEST, 1.0, target / jnp.maximum(speed, SLOWEST))
            moved = cut_walks(source, rows, pace._replace(walkway=factor), grid)
            results.append(measure(state, moved, stage, weight, task))
        return results

    sums = jax.lax.map(one_batch, (rows, weight, shares))
    return jax.tree.map(lambda x: jnp.sum(x, axis=0) / count, sums)


def measure(
    state: TrainState,
    segments: WalkSegments,
    stage: Stage,
    weight: Float[jax.Array, "b"],
    task: SegmentTask,
) -> SegmentValidation:
    """The weighted sums of a batch in inference mode."""
    prediction, _ = task.predict(state.variables, segments)

    def one(prediction: Prediction, segment: WalkSegments) -> SegmentValidation:
        prediction, segment = jax.tree.map(lambda leaf: leaf[None], (prediction, segment))
        figures = task.figures_of_batch(prediction, segment, stage)
        error = segment.displacement - prediction.displacement
        level = segment.displacement[..., :2]
        length = jnp.sqrt(jnp.sum(level**2, axis=-1) + 1e-12)
        along = jnp.sum(prediction.displacement[..., :2] * level, axis=-1) / length
        return SegmentValidation(
            **figures,
            axis_mse=jnp.mean(error**2, axis=(0, 1)),
            axis_normalised=jnp.mean(error**2 * jnp.exp(-2 * prediction.log_std), axis=(0, 1)),
            predicted=jnp.mean(along),
            walked=jnp.mean(length),
        )

    figures = jax.vmap(one)(prediction, segments)
    return jax.tree.map(lambda leaf: jnp.tensordot(weight, leaf, 1), figures)
