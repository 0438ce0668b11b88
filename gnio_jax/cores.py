"""The number of usable cores."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress


def usable_cores() -> int:
    """The number of cores that this process may run on.

    A batch system or `taskset` may have limited it to some of them.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def one_core() -> Iterator[None]:
    """Let all threads of this process run on one of its cores only, where the system can do this
    (Linux)."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    _run_threads_on({min(cores)})
    try:
        yield
    finally:
        _run_threads_on(cores)


def _run_threads_on(cores: set[int]) -> None:
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # it has ended
            os.sched_setaffinity(int(thread), cores)
