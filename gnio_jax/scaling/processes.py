"""Processes that train together: how they meet, what they agree on, how they part.

Every process runs the same program on its own devices. What differs between them is named here: the
first process alone writes files and lines, and what only one of them knows (a signal, a clock, a
failure, a file) is told to the others. With one process the functions give back what they are
given.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import jax
import numpy as np
from jax.experimental import multihost_utils

from gnio_jax.errors import InputError
from gnio_jax.scaling import endings
from gnio_jax.scaling.gathering import gather
from gnio_jax.scaling.meeting import Meeting, check, launched, wait_for

Tree = TypeVar("Tree")

LOST = re.compile(r"Gloo|NCCL|coordination service|Connection (reset|closed)|Socket closed", re.I)
"""What errors of JAX say where another process has gone; they have no type of their own."""
SHUTDOWN_SECONDS = 15
"""Longest time that a process which has ended waits for the others."""


def meet(meeting: Meeting, run: str = "") -> None:
    """Meet the other processes of the run `run`, if there are any, and once; before JAX's first
    computation.

    From then on a process that loses the others ends with one line (`endings`). Raises `InputError`
    for options that do not fit together, where the coordinator does not answer in time, and as
    `gathering.gather` where processes meet that do not belong together.
    """
    check(meeting)
    alone = meeting.processes == 1 or (meeting.coordinator is None and not launched())
    if alone or jax.distributed.is_initialized():
        return
    endings.speak_for_the_runtime(
        f"{meeting.coordinator or 'the processes'}: did not all meet within {meeting.patience} s; "
        "every one needs the same --coordinator and --processes, and a --process-id of its own",
        status=2,
    )
    if meeting.coordinator is not None:
        gather(meeting, run)
        if meeting.process_id:
            wait_for(meeting.coordinator, meeting.patience)  # for JAX's own
    jax.config.update("jax_cpu_collectives_implementation", "gloo")
    try:
        jax.distributed.initialize(
            meeting.coordinator,
            meeting.processes,
            meeting.process_id,
            initialization_timeout=meeting.patience,
            heartbeat_timeout_seconds=meeting.patience,
            shutdown_timeout_seconds=SHUTDOWN_SECONDS,
        )
    except (RuntimeError, ValueError) as error:
        problem = f"the processes cannot meet ({' '.join(str(error).split())[:150]})"
        remedy = "give --coordinator, --processes and --process-id"
        raise InputError(meeting.coordinator or "launcher", problem, remedy) from None
    endings.speak_for_the_runtime(
        f"process {jax.process_index()} of {jax.process_count()}: another process has ended or "
        "cannot be reached; start all of them again with --resume",
        status=1,
    )


@contextmanager
def running() -> Iterator[None]:
    """What the processes of a command do together: one that fails says itself why, and one that
    loses the others leaves with one line."""
    try:
        yield
    except BaseException as error:
        if several() and LOST.search(str(error)):
            endings.leave()
        endings.leave_in_silence(2 if isinstance(error, InputError | OSError) else 1)
        raise


def is_first() -> bool:
    """Whether this is the process that writes files and lines."""
    return jax.process_index() == 0


def several() -> bool:
    """Whether there are other processes."""
    return jax.process_count() > 1


def agreed(*numbers: int) -> tuple[int, ...]:
    """The largest of what the processes say, number by number."""
    if not several():
        return numbers
    said = multihost_utils.process_allgather(np.array(numbers, np.int32))
    return tuple(int(each) for each in said.max(axis=0))


def from_first(tree: Tree) -> Tree:
    """What the first process has; the others give arrays of the same shapes. On the host."""
    return multihost_utils.broadcast_one_to_all(tree) if several() else tree


def on_host(tree: Tree) -> Tree:
    """The whole of what a compiled program over all devices gives, in every process's memory."""
    if not several():
        return jax.device_get(tree)
    return multihost_utils.process_allgather(tree, tiled=True)


def text_from_first(text: str) -> str:
    """The text that the first process has."""
    if not several():
        return text
    own = np.frombuffer(text.encode(), np.uint8)
    (length,) = agreed(len(own) if is_first() else 0)
    padded = np.zeros(length, np.uint8)
    padded[: len(own)] = own[:length]
    return bytes(np.asarray(from_first(padded))).decode()


@contextmanager
def all_or_none() -> Iterator[None]:
    """What is done here succeeds in every process, or all raise.

    For what may fail in one process alone, e.g. reading and writing files: without this the others
    would wait for it. Those that did not fail themselves raise `InputError` naming one that did.
    """
    if not several():
        yield
        return
    try:
        yield
    except BaseException:
        multihost_utils.process_allgather(np.int32(1))
        raise
    failed = np.flatnonzero(multihost_utils.process_allgather(np.int32(0)))
    if failed.size:
        raise InputError(f"process {failed[0]}", "could not go on", "its own line says why")


def require_same(what: str, digest: bytes, remedy: str) -> None:
    """Raise `InputError` unless all processes give the first one's digest."""
    if not several():
        return
    own = np.frombuffer(digest[:8], np.int32)
    said: Any = multihost_utils.process_allgather(own)
    differing = np.flatnonzero((said != said[0]).any(axis=1))
    if differing.size:
        raise InputError(f"process {differing[0]}", f"has other {what} than process 0", remedy)
