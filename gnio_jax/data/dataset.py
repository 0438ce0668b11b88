"""What a reader says of its dataset: which recordings there are, and how each is read.

Reading itself (cache, self-check, splits, processes) is `reading`'s; see `registry.load`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.errors import InputError
from gnio_jax.types import Sequence


class Refusal(InputError):
    """A recording cannot be used, though its files can be read: a ruined clock, or a reference that
    does not fit the IMU. The recording is left out with a warning, and the cache remembers why."""


class Recording(NamedTuple):
    """One recording that was found, but not yet read. Can be sent to another process."""

    name: str
    """Unique within a dataset; the name of its sequence, if it yields one."""
    read: Callable[[], list[Sequence]]
    """Makes its sequences: one, or the pieces between its gaps. They are validated and on a uniform
    clock, but not self-checked. Raises `InputError` where a file is damaged, `Refusal` where the
    recording is of no use."""
    files: tuple[Path, ...] = ()
    """The files that its sequences are made of."""
    version: str = ""
    """Not empty: `read` is slow, and its sequences are kept in the cache under the state of `files`
    and this text, which changes whenever `read` would make other sequences of the same files."""
    attributes: dict[str, Any] = {}
    """What lists and splits say of it; joins the attributes of its sequences."""
    form: str = ""
    """Which of several forms of the recording this is, as messages name it."""
    fallback: Recording | None = None
    """Another form of the same recording, read where this one is refused."""


def single(name: str, read: Callable[..., Sequence], *arguments: Any, **options: Any) -> Recording:
    """The recording that is one sequence, `read(*arguments, **options)`."""
    return Recording(name, partial(_listed, partial(read, *arguments, **options)))


def _listed(read: Callable[[], Sequence]) -> list[Sequence]:
    return [read()]


@dataclass(frozen=True)
class Dataset:
    """One dataset; every reader ends with `DATASET = Dataset(...)`."""

    name: str
    """The name of `--dataset`."""
    recordings: Callable[[Path, str], list[Recording]]
    """(root, split) -> its recordings, not yet read. The split is one that may be asked for. Raises
    `InputError`."""
    splits: tuple[str, ...]
    """Known splits."""
    rate: float
    """Native IMU rate, Hz."""
    source: str
    """Where the public set is had."""
    layout: str
    """The expected layout below the root, in one line."""
    licence: str
    """Terms of the data, as their authors state them."""
    needs_root: bool = True
    """False for a dataset that is computed, not read. Its reference is exact, so it is not
    self-checked when it is loaded."""
    pedestrian: bool = True
    """False for drones and vehicles: the self-check then finds no speed implausible."""
    min_correlation: float | None = 0.3
    """Correlation of the horizontal accelerations that the self-check asks for; None where
    positions are those of another body, or smoothed."""
    needs_reference: bool = True
    """False where recordings without any reference are of use."""
    list_splits: Callable[[Path], tuple[str, ...]] | None = None
    """root -> splits, where lists at the root name them; there may be others than `splits`."""

    def splits_at(self, root: Path) -> tuple[str, ...]:
        """The splits that may be asked for at this root."""
        return self.list_splits(root) if self.list_splits else self.splits
