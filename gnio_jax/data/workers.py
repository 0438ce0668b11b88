"""Work that is shared among processes, with its results in order."""

from __future__ import annotations

import multiprocessing
import signal
import warnings
from collections import deque
from collections.abc import Callable, Generator
from concurrent.futures import Future, wait
from itertools import islice
from typing import TypeVar

from gnio_jax.cores import usable_cores
from gnio_jax.errors import InputError
from gnio_jax.reporting import Progress, silent

Result = TypeVar("Result")
FEW = 8
"""Number of recordings up to which reading them is faster than starting processes."""


class ProcessDied(InputError):
    """A process ended without a message; most often the system has run out of memory."""


def in_processes(
    function: Callable[..., Result],
    items: list[tuple],
    workers: int | None,
    progress: Progress = silent,
) -> Generator[Result, None, None]:
    """`function(*item)` for every item, in their order, by `workers` processes; 1 starts none, and
    None chooses a useful number. A process that may have no children does the work itself.

    At most `workers` + 2 results are in progress or waiting, so that memory is bounded. `progress`
    gets the finished share. Function and items must be picklable if there is more than one process.
    After an error of an item those in progress end first, so that their files are whole; Ctrl-C and
    a caller that stops early end them at once. Raises `ProcessDied`.
    """
    if workers is None:
        workers = usable_cores() if len(items) > FEW else 1
    workers = min(workers, len(items))
    if workers <= 1 or multiprocessing.current_process().daemon:
        for number, item in enumerate(items, 1):
            result = function(*item)
            progress(number / len(items))
            yield result
        return
    from loky.process_executor import (  # it takes a fifth of a second to import
        ProcessPoolExecutor,
        TerminatedWorkerError,
    )

    # A process that uses much memory is replaced, with the same results, so the user need not act.
    warnings.filterwarnings("ignore", "A worker was restarted", UserWarning, "loky")
    # Python's own pool can wait without end for a process that died while another one started. Only
    # this process handles Ctrl-C.
    ignore = (signal.SIGINT, signal.SIG_IGN)
    pool = ProcessPoolExecutor(workers, initializer=signal.signal, initargs=ignore)
    pending, waiting = iter(items), deque[Future[Result]]()
    try:
        for number in range(1, len(items) + 1):
            new = islice(pending, workers + 2 - len(waiting))
            waiting.extend(pool.submit(function, *item) for item in new)
            result = waiting.popleft().result()
            progress(number / len(items))
            yield result
    except TerminatedWorkerError:
        problem = "a process died, perhaps because memory ran out"
        raise ProcessDied("--workers", problem, "try --workers 1") from None
    except Exception:
        wait(waiting)
        raise
    finally:
        pool.shutdown(wait=False, kill_workers=True)
