"""Many sequences at once: batches of similar lengths, vmapped, and divided among the devices of all
processes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Bool, Float

from gnio_jax.cores import usable_cores
from gnio_jax.numerics import filled_up
from gnio_jax.parallel import cpu_devices
from gnio_jax.types import Array

T = TypeVar("T")


class Batch(NamedTuple):
    """Recordings that are filtered side by side."""

    members: list[int]
    """Numbers of the recordings; the last one is repeated where they do not fill the batch."""
    intervals: int
    """Number of clone intervals to which all are padded."""


COMPILED_INTERVALS = 1_000
"""Clone intervals by which batches are padded, in all, before another length is compiled (ours). On
one core of an AMD EPYC beside other work a batch of 16 with a network of a quarter of the width
takes 44 s to compile and 14 ms for an interval; a wider one takes longer for an interval."""


def batches(intervals: Sequence[int], most: int) -> list[Batch]:
    """Batches of recordings of similar lengths, the longest first: as few as possible with at most
    `most` members, and of one size.

    intervals: length of each recording in clone intervals. Every length of a batch is a
    compilation. So a batch keeps the length of the one before it, until this has lengthened the
    batches by more than `COMPILED_INTERVALS` in all. Then it has that of its longest member.
    """
    count = max(1, math.ceil(len(intervals) / most))
    size = max(1, math.ceil(len(intervals) / count))
    longest_first = sorted(range(len(intervals)), key=lambda i: -intervals[i])
    parts = [longest_first[i : i + size] for i in range(0, len(intervals), size)]
    filled = [part + part[-1:] * (size - len(part)) for part in parts]
    length, padding, result = max(intervals, default=0), 0, []
    for part in filled:
        longest = intervals[part[0]]
        padding += length - longest
        if padding > COMPILED_INTERVALS:
            length, padding = longest, 0
        result.append(Batch(part, length))
    return result


def padded_signals(
    recordings: Iterable[tuple[Float[Array, "_ 3"], Float[Array, "_ 3"]]], samples: int
) -> tuple[Float[np.ndarray, "b n 3"], Float[np.ndarray, "b n 3"]]:
    """Gyro and accel of recordings, each with `samples` rows.

    The rows that are appended have no rotation and the last specific force. They come after the
    recording and change nothing before it.
    """
    gyro, accel = zip(*recordings, strict=True)
    turns = [filled_up(signal[:samples], samples, 0.0) for signal in gyro]
    return np.stack(turns), np.stack([filled_up(signal[:samples], samples) for signal in accel])


def padded_masks(
    masks: Iterable[Bool[np.ndarray, "_"] | None], samples: int
) -> Bool[np.ndarray, "b n"] | None:
    """The masks `imu_valid` of `run_filter` for recordings, each with `samples` rows; None where no
    recording lacks a sample. Rows that are appended are valid."""
    masks = list(masks)
    if all(mask is None for mask in masks):
        return None
    filled = np.ones((len(masks), samples), bool)
    for row, mask in zip(filled, masks, strict=True):
        if mask is not None:
            row[: len(mask)] = mask[:samples]
    return filled


def over_sequences(function: Callable[..., T], shared: int = 0) -> Callable[..., T]:
    """`jax.vmap(function)` whose sequences are divided among all devices of all processes. The
    result should be jitted, and it is differentiable.

    The first `shared` arguments (parameters, noise) are the same for every sequence; the leaves of
    all others, and of the result, have the sequences as their leading axis. A number of sequences
    that does not divide evenly is filled up with the last one, whose additional results are
    dropped. With one device it is `jax.vmap`. On a device with one sequence it is the function
    itself. JAX refuses arguments that are bound to a device by `jax.device_put(x, device)`
    (ValueError). In several processes (`jax.distributed`) each of them gives all sequences, and
    `parallel.on_host` gives each of them all results.

    On a machine without a GPU JAX sees one device, whatever the number of cores, and the filter's
    operations are too small for XLA to split each among cores: call `cores_as_devices` first.
    """

    def run_batch(*arguments: object) -> T:
        sequences = arguments[shared:]
        if jax.tree.leaves(sequences)[0].shape[0] > 1:
            in_axes = (None,) * shared + (0,) * len(sequences)
            return jax.vmap(function, in_axes=in_axes)(*arguments)
        # A single walk without vmap is traced in half the time, and the network runs only where
        # there is a window: vmap would take both branches.
        only = jax.tree.map(lambda leaf: leaf[0], sequences)
        result = function(*arguments[:shared], *only)
        return jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], result)

    def run_shared(*arguments: object) -> T:
        sequences = arguments[shared:]
        lengths = [jnp.shape(leaf)[:1] for leaf in jax.tree.leaves(sequences)]
        if not lengths or len(set(lengths)) > 1 or lengths[0] in ((), (0,)):
            problem = "arguments must have the sequences as their leading axis, at least one"
            sizes = ", ".join(str(length[0]) if length else "none" for length in lengths)
            remedy = f"`shared` ({shared}) counts those at the front that have none"
            raise ValueError(f"over_sequences: {problem}, found {sizes or 'none'}; {remedy}")
        count = lengths[0][0]
        # Every process takes part, even if there are fewer sequences than devices.
        devices = jax.devices() if jax.process_count() > 1 else jax.devices()[:count]
        if len(devices) == 1:
            return run_batch(*arguments)
        times = -count % len(devices)
        filled = jax.tree.map(
            lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[-1:], times, axis=0)]), sequences
        )
        everywhere, shared_out = PartitionSpec(), PartitionSpec("sequence")
        spread = jax.shard_map(
            run_batch,
            mesh=Mesh(np.array(devices), ("sequence",)),
            in_specs=(everywhere,) * shared + (shared_out,) * len(sequences),
            out_specs=shared_out,
            check_vma=False,
        )
        return jax.tree.map(lambda leaf: leaf[:count], spread(*arguments[:shared], *filled))

    return run_shared


def cores_as_devices() -> None:
    """Let JAX see every core that this process may use as a device of its own, unless a number of
    CPU devices is set already.

    Programs that are not divided among devices still run on the first device, with all cores.
    Raises RuntimeError after JAX's first computation, when their number can no longer change.
    """
    cpu_devices(usable_cores())
