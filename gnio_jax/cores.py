"""The cores of the processor."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

THREADS = Path("/proc/self/task")
"""A folder for each thread of this process (Linux)."""
CPU_INFO = Path("/proc/cpuinfo")
"""The properties of every core (Linux)."""


def processor_name() -> str:
    """The name of the processor, or its architecture where the system gives no name."""
    with suppress(OSError):
        for line in CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name" and value.strip():
                return value.strip()
    return platform.processor() or platform.machine()


def usable_cores() -> int:
    """The number of cores that this process may run on.

    A batch system or `taskset` may have limited it to some of them.
    """
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def can_choose_cores() -> bool:
    """Whether the system lets a process choose the cores of its threads. Linux does, unless a
    container forbids it; macOS does not."""
    if not hasattr(os, "sched_setaffinity") or not THREADS.is_dir():
        return False
    try:
        os.sched_setaffinity(0, os.sched_getaffinity(0))
    except OSError:
        return False
    return True


@contextmanager
def one_core() -> Iterator[None]:
    """Let all threads of this process run on one of its cores only, where the system can do this
    (`can_choose_cores`)."""
    if not can_choose_cores():
        yield
        return
    cores = os.sched_getaffinity(0)
    _run_threads_on({min(cores)})
    try:
        yield
    finally:
        _run_threads_on(cores)


def _run_threads_on(cores: set[int]) -> None:
    for thread in THREADS.iterdir():
        with suppress(ProcessLookupError):  # it has ended
            os.sched_setaffinity(int(thread.name), cores)
