"""Work on many recordings by several processes, where a caller asks for them."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TypeVar

from gnio_jax.cores import usable_cores
from gnio_jax.errors import InputError

Result = TypeVar("Result")


class ProcessDied(InputError):
    """A process ended without a word; most often the system has run out of memory."""


FEW = 8
"""Recordings up to here are quicker read than processes are started."""


def suggested_workers(recordings: int) -> int:
    """Processes that are worth starting for so many recordings: a core each, or this one alone."""
    return usable_cores() if recordings > FEW else 1


def map_in_processes(
    function: Callable[..., Result],
    items: list[tuple],
    workers: int,
    done: Callable[[float], None] = lambda share: None,
) -> Iterator[Result]:
    """`function(*item)` of every item, in their order, by `workers` processes; 1 starts none.

    `done` is told the share that is finished. Function and items must survive pickling when there
    is more than one process, and the script that asks for them needs its `if __name__ ==
    "__main__"`. Raises `ProcessDied`.
    """
    workers = min(workers, len(items))
    if workers <= 1:
        for index, item in enumerate(items):
            result = function(*item)
            done((index + 1) / len(items))
            yield result
        return
    # Processes are spawned: a fork after JAX has started its threads can hang. Ctrl-C is this
    # process's to answer.
    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),
    )
    with pool:
        try:
            futures = _submitted(pool, function, items)
            for finished, _ in enumerate(as_completed(futures), 1):
                done(finished / len(items))
            for future in futures:
                yield future.result()
        except BrokenProcessPool:
            raise ProcessDied(
                "--workers", "a process died, perhaps for want of memory", "try --workers 1"
            ) from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


def _submitted(
    pool: ProcessPoolExecutor, function: Callable[..., Result], items: list[tuple]
) -> list[Future[Result]]:
    """Every item's future. Raises `BrokenProcessPool`.

    A process that dies while the next one is started closes the pipes between them, and Python
    meets a closed pipe.
    """
    try:
        return [pool.submit(function, *item) for item in items]
    except OSError as error:
        raise BrokenProcessPool(str(error)) from error
