"""Grid samples as a corrector corrects them, block by block while they come."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from gnio_jax.filtering.resampler import ACCEL, GYRO, Stream


@runtime_checkable
class SampleCorrector(Protocol):
    """A corrector of samples that works on blocks of them, each with some samples around it."""

    block: int
    """Samples of a block."""
    before: int
    """Samples before the first one of a block that it sees."""
    after: int
    """Samples from the first one of a block on that it sees, itself not counted."""

    def begin(self) -> Any:
        """The memory before the first block."""
        ...

    def step(
        self, memory: Any, samples: Float[np.ndarray, "w 6"]
    ) -> tuple[Any, Float[np.ndarray, "n 6"], Float[np.ndarray, "n 6"]]:
        """The memory after a block, what is added to its samples [accel, gyro], and the variances
        of the corrected ones. The samples are those of the block and around it; zeros before the
        start."""
        ...


class CorrectedStream:
    """A `Stream` whose rows are corrected and have the variances [accel, gyro] as six more columns.

    A missing sample is held for the corrector, and remains missing.
    """

    def __init__(self, stream: Stream, corrector: SampleCorrector):
        self._stream, self._corrector = stream, corrector
        self._memory = corrector.begin()
        self._seen = np.zeros((corrector.before, 6))
        """Samples [accel, gyro] that came and are still needed, from those before the next block
        on."""
        self._raw = np.zeros((0, 7))
        """Rows of the stream from the next block on."""
        self._rows = np.zeros((0, 13))
        """Corrected rows that were not taken."""
        self._taken = 0

    @property
    def grid(self) -> Any:
        """The grid of the stream."""
        return self._stream.grid

    @property
    def origin(self) -> float:
        """The first stamp, s."""
        return self._stream.origin

    @property
    def newest(self) -> float:
        """The newest stamp, s, as `Stream.newest`."""
        return self._stream.newest

    @property
    def taken(self) -> int:
        """Number of rows that were taken."""
        return self._taken

    @property
    def delay(self) -> float:
        """Time by which a row is known after its own, at most, s."""
        return self._stream.delay + self._corrector.after * self._stream.grid.dt

    @property
    def ready(self) -> int:
        """Number of the next rows that are corrected."""
        return len(self._rows)

    def push(self, time: float, sample: tuple[float, ...]) -> None:
        """Take a sample, as `Stream.push` does."""
        self._stream.push(time, sample)
        if count := self._stream.ready:
            rows = self._stream.rows(count)
            self._stream.take(count)
            self._raw = np.concatenate([self._raw, rows])
            samples = list(self._seen)
            for row in np.concatenate([rows[:, ACCEL], rows[:, GYRO]], axis=1):
                held = samples[-1] if samples else np.zeros(6)
                samples.append(np.where(np.isfinite(row), row, held))
            self._seen = np.array(samples)
        self._correct_blocks()

    def rows(self, count: int) -> Float[np.ndarray, "count 13"]:
        """The next corrected rows, at most `ready`. They are read, not taken."""
        return self._rows[:count]

    def take(self, count: int) -> None:
        """Take the next `count` rows."""
        self._rows, self._taken = self._rows[count:], self._taken + count

    def _correct_blocks(self) -> None:
        """Correct every block whose samples have come."""
        corrector = self._corrector
        block, width = corrector.block, corrector.before + corrector.after + 1
        while len(self._seen) >= width and len(self._raw) >= block:
            self._memory, added, variance = corrector.step(self._memory, self._seen[:width])
            rows = self._raw[:block].copy()
            rows[:, ACCEL] += added[:, :3]
            rows[:, GYRO] += added[:, 3:]
            self._rows = np.concatenate([self._rows, np.concatenate([rows, variance], axis=1)])
            self._seen, self._raw = self._seen[block:], self._raw[block:]
