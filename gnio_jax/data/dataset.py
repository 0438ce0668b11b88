"""What a reader gives: the description of its dataset, and recordings that are not yet read."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.errors import InputError
from gnio_jax.types import Sequence


class Refusal(InputError):
    """A recording cannot be used, although its files can be read: its clock is destroyed, or its
    reference does not fit the IMU. The recording is left out with a warning, and the cache
    remembers the reason."""

    def __init__(self, where: object, problem: str, remedy: str = "leave it out"):
        super().__init__(where, problem, remedy)


class RecordingSource(NamedTuple):
    """A recording that a reader has found, but not yet read. It can be sent to another process."""

    name: str
    """Name that is unique within a dataset, and that of its sequence, if there is only one."""
    read: Callable[[], list[Sequence]]
    """A function that makes its sequences: one, or the segments between its gaps. They are
    validated and on a uniform clock, but not self-checked. It raises `InputError` for a damaged
    file, and `Refusal` if the recording cannot be used."""
    files: tuple[Path, ...] = ()
    """The files from which its sequences are made; some may be absent. A folder stands for all that
    is in it."""
    slow: bool = False
    """Whether `read` is slow. Then processes share the work, and where there are `files` the cache
    keeps its result until one of them, or the module of `read`, changes."""
    attributes: dict[str, Any] = {}
    """Attributes from lists and splits, which are added to those of its sequences."""
    form: str = ""
    """Name of this form in messages, if the recording has several."""
    fallback: RecordingSource | None = None
    """Another form of the same recording, which is read if this one is refused."""


@dataclass(frozen=True)
class Dataset:
    """The description of a dataset, with the function that finds its recordings."""

    name: str
    """The name of `--dataset`."""
    recordings: Callable[[Path, str], list[RecordingSource]]
    """(root, split) -> recordings, not yet read. The split must be a possible one. The result is
    empty if there is nothing of the dataset; `InputError` is raised if only the split is
    missing."""
    splits: tuple[str, ...]
    """Known splits."""
    rate: float
    """Native IMU rate, Hz."""
    source: str
    """Location of the public set."""
    layout: str
    """The expected layout below the root, in one line."""
    licence: str
    """Terms of the data, as their authors state them."""
    needs_root: bool = True
    """False for a dataset that is computed. Its reference is exact, so it is not self-checked when
    it is loaded."""
    pedestrian: bool = True
    """False for drones and vehicles: the self-check then finds no speed implausible."""
    correlates: bool = True
    """False if the horizontal accelerations of the positions need not correlate with the
    accelerometer's, because the positions are those of another body, or smoothed."""
    needs_reference: bool = True
    """False if recordings without any reference can be used."""
    list_splits: Callable[[Path], tuple[str, ...]] | None = None
    """root -> splits, if lists at the root define them; these may differ from `splits`."""
    folders: tuple[str, ...] = ()
    """Possible names of its folder; by default the dataset's own name."""

    def splits_at(self, root: Path) -> tuple[str, ...]:
        """The splits that may be asked for at this root."""
        return self.list_splits(root) if self.list_splits else self.splits

    def with_origin(self, sequence: Sequence) -> Sequence:
        """A sequence with the name and licence of its dataset; a converted one keeps its own."""
        attributes = {"dataset": self.name, "licence": self.licence}
        return sequence._replace(attributes=attributes | sequence.attributes)
