"""How windows come to the device: all of them once, or part after part from the disk.

Both give the same windows in the same order, and the steps draw the same random numbers: a step
does not know where its windows come from. Grain reads the parts ahead. What it gives is a function
of the order and the step, so that a checkpoint holds nothing of it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np
from jaxtyping import Int

from gnio_jax.config import TrainConfig
from gnio_jax.data import cache, windows
from gnio_jax.data.on_disk import bytes_of, source_on_disk
from gnio_jax.data.windows import WindowSource, excerpt
from gnio_jax.scaling import devices
from gnio_jax.types import Array, Sequence

PART_BYTES = 2**25
"""Size of a part that is read and brought to the device at once, unless a step needs more."""
AHEAD = 2
"""Parts that are read ahead."""


class Part(NamedTuple):
    """Steps whose windows are on the device."""

    source: WindowSource
    order: Int[jax.Array, "m"]
    first: int
    """Number of the first step in `order`."""
    count: int


@runtime_checkable
class Epoch(Protocol):
    """What an epoch visits, in order."""

    def parts(self, first: int, count: int) -> Iterator[Part]:
        """`count` steps of the epoch from its step `first` on."""
        ...


@runtime_checkable
class Supply(Protocol):
    """How windows come to the device."""

    def epoch(self, source: WindowSource, order: Int[Array, "m"]) -> Epoch:
        """The windows of an epoch, in this order."""
        ...

    def windows(self, source: WindowSource, order: Int[Array, "m"]) -> tuple[WindowSource, Any]:
        """A source on the device that has these windows, and their order in it."""
        ...

    def sources(self, source: WindowSource) -> Iterator[WindowSource]:
        """Sources on the device that have all visited windows between them."""
        ...


def stored(
    config: TrainConfig, sequences: Iterable[Sequence], stride: int, shift: int
) -> WindowSource:
    """The windows of recordings on the host: in memory if they will lie on the device, else mapped
    from files in the cache's folder."""
    if config.data.residency == "device":
        return windows.window_source(sequences, config.data, stride, shift)
    parts = windows.window_parts(sequences, config.data, stride, shift)
    return source_on_disk(parts, cache.folder())


def supplied(
    config: TrainConfig, source: WindowSource, held_out: WindowSource
) -> tuple[Supply, WindowSource, WindowSource]:
    """The supply that `config.data.residency` asks for, and the sources where it wants them."""
    size = bytes_of(source) + bytes_of(held_out)
    fits = config.data.residency == "auto" and size <= _memory() // 2
    if config.data.residency == "device" or fits:
        return OnDevice(), devices.everywhere(source), devices.everywhere(held_out)
    length, shift = config.data.seen, config.augment.shift_samples
    return FromHost(config.optim.batch_size, length, shift), source, held_out


def _memory() -> int:
    """Bytes of the first device of this process; of the machine, where a CPU is the device."""
    limits = jax.local_devices()[0].memory_stats() or {}
    return limits.get("bytes_limit") or os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


# Everything on the device
# ------------------------------------------------------------------------------------------------


class OnDevice(NamedTuple):
    """A `Supply`: the sources lie on the device."""

    def epoch(self, source: WindowSource, order: Int[Array, "m"]) -> Epoch:
        return _EpochOnDevice(source, order)

    def windows(self, source: WindowSource, order: Int[Array, "m"]) -> tuple[WindowSource, Any]:
        return source, order

    def sources(self, source: WindowSource) -> Iterator[WindowSource]:
        yield source


class _EpochOnDevice(NamedTuple):
    source: WindowSource
    order: Int[Array, "m"]

    def parts(self, first: int, count: int) -> Iterator[Part]:
        yield Part(self.source, self.order, first, count)


# Part after part from the disk
# ------------------------------------------------------------------------------------------------


class FromHost(NamedTuple):
    """A `Supply`: the sources lie on the host's disk, and parts of them come to the device."""

    batch_size: int
    length: int
    """Samples of a window."""
    shift: int
    """Samples by which training may shift it."""

    def epoch(self, source: WindowSource, order: Int[Array, "m"]) -> Epoch:
        return _EpochFromHost(source, np.asarray(order), self)

    def windows(self, source: WindowSource, order: Int[Array, "m"]) -> tuple[WindowSource, Any]:
        part = excerpt(source, np.asarray(order), self.length, self.shift)
        on_device = devices.everywhere(part)
        return on_device, on_device.visited

    def sources(self, source: WindowSource) -> Iterator[WindowSource]:
        given = _Excerpts(
            source, source.visited, self.batches() * self.batch_size, self._replace(shift=0)
        )
        for part in _read_ahead(given, 0):
            yield devices.everywhere(part)

    def batches(self) -> int:
        """Batches of a part."""
        rows, windows = self.length + 2 * self.shift, 1 + 2 * self.shift
        # Bytes of an excerpt: imu and step of a row; start, rotation, displacement, unyaw, number
        # of a window.
        size = self.batch_size * (36 * rows + 64 * windows)
        return max(1, PART_BYTES // size)


class _Excerpts(NamedTuple):
    """Excerpts of `count` windows each, in order: a data source for Grain."""

    source: WindowSource
    order: Int[np.ndarray, "m"]
    count: int
    supply: FromHost

    def __getitem__(self, number: int) -> WindowSource:
        which = self.order[number * self.count : (number + 1) * self.count]
        return excerpt(self.source, which, self.supply.length, self.supply.shift)


class _EpochFromHost:
    """Parts of an epoch. Those that follow the last one are being read meanwhile."""

    def __init__(self, source: WindowSource, order: Int[np.ndarray, "m"], supply: FromHost):
        self._steps = min(supply.batches(), len(order) // supply.batch_size)
        count = self._steps * supply.batch_size
        # Parts of one size, and one compilation: the last one is filled up with the first windows.
        filled = np.resize(order, -(-len(order) // count) * count)
        self._excerpts = _Excerpts(source, filled, count, supply)
        self._ahead: Iterator[WindowSource] = iter(())
        self._last: tuple[int, WindowSource] | None = None

    def parts(self, first: int, count: int) -> Iterator[Part]:
        while count:
            number, inside = divmod(first, self._steps)
            taken = min(count, self._steps - inside)
            source = self._part(number)
            yield Part(source, source.visited, inside, taken)
            first, count = first + taken, count - taken

    def _part(self, number: int) -> WindowSource:
        """The part of that number: the last one again, the next one, or any."""
        last, source = self._last or (None, None)
        if source is not None and last == number:
            return source
        if last is None or number != last + 1:
            self._ahead = _read_ahead(self._excerpts, number)
        source = devices.everywhere(next(self._ahead))
        self._last = number, source
        return source


def _read_ahead(excerpts: _Excerpts, first: int) -> Iterator[Any]:
    """Excerpts from number `first` on, read by threads: copying rows holds no lock of Python."""
    import grain  # a second, which most runs need not wait for

    count = -(-len(excerpts.order) // excerpts.count)
    options = grain.ReadOptions(num_threads=AHEAD, prefetch_buffer_size=AHEAD)
    read = grain.MapDataset.range(first, count).map(excerpts.__getitem__)
    return iter(read.to_iter_dataset(options))
